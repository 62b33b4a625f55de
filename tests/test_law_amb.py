"""Adaptive model-based compensation (Galmez and Fermandois 2022): against numpy, step by step."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.signal
from kernels import FS_HZ, Floats, H, smooth_motion

from rthyb_rt import config, core
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time

GAINS = 10.0 ** np.array([8.4, 6.2, 2.1, 0.8])
NAMES = ("a0", "a1", "a2", "a3")


def amb(period_s: float = H, **settings: float) -> core.Law:
    own = {f"amb.{key}": value for key, value in settings.items()}
    return core.Law(core.LawConfig("amb", own), period_s=period_s)


def terms(x: Floats, h: float) -> Floats:
    """x and its backward differences up to the third, (n, 4); at rest before."""
    before = np.concatenate([np.full(3, x[0]), x])
    return np.column_stack([np.diff(before, i)[3 - i :] / h**i for i in range(4)])


def first(a1: float) -> Floats:
    return np.array([1.0, a1, 0.214 * a1**2, 0.0254 * a1**3])


def formulated(sent: Floats, came: Floats, h: float, a: Floats) -> Floats:
    """The coefficients after each sample, by numpy and scipy's Butterworth."""
    sections = scipy.signal.butter(4, 20.0, fs=1.0 / h, output="sos")

    def smooth(x: Floats) -> Floats:
        rest = scipy.signal.sosfilt_zi(sections) * x[0]
        return np.asarray(scipy.signal.sosfilt(sections, x, zi=rest)[0])

    phi, u, found = terms(smooth(came), h), smooth(sent), np.empty((sent.size, 4))
    for n, row in enumerate(phi):
        error = (u[n] - a @ row) / (1.0 + row @ row)
        a = np.maximum(a + h * GAINS * error * row, 0.0)
        found[n] = a
    return found


def late(x: Floats, samples: int) -> Floats:
    return np.concatenate([np.full(samples, x[0]), x[:-samples]])


@pytest.mark.parametrize("fs_hz", [256.0, 1024.0, 4096.0])
def test_it_learns_what_the_published_equations_say(fs_hz: float) -> None:
    h = 1.0 / fs_hz
    t = np.arange(round(4.0 * fs_hz)) * h
    sent = 0.004 * (np.sin(11.0 * t) + 0.5 * np.sin(31.0 * t)) * (1 - np.exp(-((t / 0.3) ** 3)))
    came = 0.95 * late(sent, round(0.018 * fs_hz))
    came += 5e-6 * np.random.default_rng(4).normal(size=t.size)
    found = amb(h).follow(np.zeros_like(sent), sent, came)[1]
    expected = formulated(sent, came, h, first(0.01986))
    for i, name in enumerate(NAMES):
        scale = np.abs(expected[:, i]).max()
        np.testing.assert_allclose(found[name], expected[:, i], rtol=0, atol=1e-6 * scale)
    assert found["alpha"][-1] == pytest.approx(found["a1"][-1] * fs_hz)
    assert found["beta"][-1] == pytest.approx(found["a2"][-1] * fs_hz**2)
    assert abs(found["a1"][-1] - 0.01986) > 1e-4


def test_the_command_is_the_sum_of_its_derivatives() -> None:
    x = smooth_motion(2.0, 3)
    x -= x[0]
    np.testing.assert_allclose(
        amb(a1_s=0.017).run(x), terms(x, H) @ first(0.017), rtol=0, atol=1e-12
    )


def test_an_actuator_of_third_order_is_followed() -> None:
    """Closed on a lag of three equal poles, whose inverse has the shares 1/3 and 1/27."""
    law, tau = amb(), 0.016 / 3.0
    pole = math.exp(-H / tau)
    x = smooth_motion(30.0, 8, peak_m=0.006)
    sent, y, error = 0.0, np.zeros(4), np.zeros(x.size)
    for n, wanted in enumerate(x):
        error[n] = y[3] - wanted if n else 0.0
        law.observe(sent, y[3])
        y[0] = sent
        for i in (1, 2, 3):
            y[i] = pole * y[i] + (1.0 - pole) * y[i - 1]
        sent, _ = law.lead(x[min(n + 1, x.size - 1)])
    early, end = error[: x.size // 10], error[-x.size // 4 :]
    assert np.sqrt(np.mean(end**2)) < 0.01 * np.sqrt(np.mean(x**2))
    assert np.sqrt(np.mean(end**2)) < 0.3 * np.sqrt(np.mean(early**2))


def test_coefficients_keep_to_their_bounds_whatever_comes_back() -> None:
    rng = np.random.default_rng(1)
    sent = smooth_motion(4.0, 3, peak_m=0.02)
    for came in (rng.normal(size=sent.size) * 0.02, -sent, 1e3 * np.sign(sent)):
        law = amb(a0_max=1.5, a1_max_s=0.05)
        found = law.follow(np.zeros_like(sent), sent, came)[1]
        for name, most in zip(NAMES, (1.5, 0.05, 0.1, 0.01), strict=True):
            assert 0.0 <= found[name].min() <= found[name].max() <= most
            assert np.isfinite(found[name]).all()


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("cutoff_hz = 0.1", "the cut-off of the low-pass pair must be"),
        ("a1_max_s = 0.01", "which a1_s and the shares begin with"),
        ("a2_max_s2 = 1e-6", "which a1_s and the shares begin with"),
        ("a3_max_s3 = 1e-9", "which a1_s and the shares begin with"),
        ("log_gain0 = 13", "must be"),
        ("a0_max = 0.5", "must be"),
    ],
)
def test_settings_that_do_not_fit_are_named(line: str, complaint: str) -> None:
    text = f"""schema = "rthyb-test/1"
test = {{ name = "a" }}
numerical = {{ period_s = 0.5, damping_ratio = 0.02 }}
controller = {{ type = "amb", amb = {{ a1_s = 0.02, {line} }} }}
"""
    with pytest.raises(InputError) as caught:
        config.parse_test(text, "test.toml")
    assert complaint in str(caught.value)


def test_the_shaking_table_follows_within_one_percent() -> None:
    """The shipped rig and El Centro, with gains for its 7 mm: those of 2 mm throw it about."""
    lower = {f"controller.amb.log_gain{i}": np.log10(GAINS[i]) - 1.0 for i in range(4)}
    test = config.load_test(config.builtin_test_path(), {"controller.type": "amb"} | lower)
    setup = experiment.prepare(test, config.load_rig(config.find_rig(test.rig)))
    rec = virtual_time.run(setup)
    assert rec.meta["end_reason"] == "completed"
    rows = rec.samples[rec.running()]
    error = rows["x_meas_m"] - rows["x_num_m"]
    assert math.sqrt(np.mean(error**2) / np.mean(rows["x_num_m"] ** 2)) < 0.01
    assert rows["alpha"][-1] / FS_HZ == pytest.approx(0.0166, abs=0.004)
