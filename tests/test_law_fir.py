"""Inverses of four samples: recursive least squares (rls-fir) and Kalman's filter (kf-adc)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.signal
from kernels import Floats, H, smooth_motion

from rthyb_rt import config, core
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time

NAMES = ("th0", "th1", "th2", "th3")
both = pytest.mark.parametrize("name", ["rls-fir", "kf-adc"])


def law(name: str, period_s: float = H, **settings: float) -> core.Law:
    own = {f"{name.replace('-', '_')}.{key}": value for key, value in settings.items()}
    return core.Law(core.LawConfig(name, own), period_s=period_s)


def taps(x: Floats, apart: int = 1) -> Floats:
    """x now and one, two, three times `apart` ago, (n, 4); at rest before."""
    before = np.concatenate([np.full(3 * apart, x[0]), x])
    return np.column_stack([before[(3 - i) * apart :][: x.size] for i in range(4)])


def smooth(x: Floats, h: float) -> Floats:
    sections = scipy.signal.butter(4, 20.0, fs=1.0 / h, output="sos")
    return np.asarray(
        scipy.signal.sosfilt(sections, x, zi=scipy.signal.sosfilt_zi(sections) * x[0])[0]
    )


def polynomials() -> Floats:
    """Columns: orthonormal polynomials of degree 0 to 3 over four points, by Gram-Schmidt."""
    q, r = np.linalg.qr(np.vander(np.arange(4.0), 4, increasing=True))
    return np.asarray(q * np.sign(np.diag(r)))


def first(delay_s: float, apart_s: float) -> Floats:
    """The shortest coefficients with sum 1 and that delay: numpy's least norm."""
    rows = np.array([np.ones(4), -np.arange(4.0)])
    return np.asarray(np.linalg.lstsq(rows, np.array([1.0, delay_s / apart_s]), rcond=None)[0])


def late(x: Floats, samples: int) -> Floats:
    return np.concatenate([np.full(samples, x[0]), x[:-samples]])


def signals(fs_hz: float) -> tuple[Floats, Floats]:
    t = np.arange(round(4.0 * fs_hz)) / fs_hz
    sent = 0.004 * (np.sin(11.0 * t) + 0.5 * np.sin(31.0 * t)) * (1 - np.exp(-((t / 0.3) ** 3)))
    came = 0.95 * late(sent, round(0.018 * fs_hz))
    return sent, came + 5e-6 * np.random.default_rng(4).normal(size=t.size)


@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_recursion_is_the_least_squares_of_all_samples_with_the_first_as_prior(
    fs_hz: float,
) -> None:
    """Without forgetting it is Tikhonov's: numpy's normal equations over everything so far."""
    h, apart = 1.0 / fs_hz, round(fs_hz / 1024)
    sent, came = signals(fs_hz)
    found = law("rls-fir", h, delay_s=0.02).follow(np.zeros_like(sent), sent, came)[1]
    base = polynomials()
    p0 = base @ np.diag([5e7, 6.8e10, 1.46e11, 1.46e11]) @ base.T
    start, u, phi = first(0.02, 1 / 1024), smooth(sent, h), taps(smooth(came, h), apart)
    for end in (sent.size // 3, sent.size):
        information = np.linalg.inv(p0) + phi[:end].T @ phi[:end]
        right = np.linalg.inv(p0) @ start + phi[:end].T @ u[:end]
        expected = np.linalg.solve(information, right)
        got = [found[name][end - 1] for name in NAMES]
        np.testing.assert_allclose(got, expected, rtol=1e-4)


@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_kalmans_filter_is_numpys_step_by_step(fs_hz: float) -> None:
    h, apart = 1.0 / fs_hz, round(fs_hz / 1024)
    sent, came = signals(fs_hz)
    found = law("kf-adc", h, delay_s=0.02).follow(np.zeros_like(sent), sent, came)[1]
    theta, p = first(0.02, 1 / 1024), 100.0 * np.eye(4)
    u, rows = smooth(sent, h), taps(smooth(came, h), apart)
    expected = np.empty((sent.size, 4))
    for n, phi in enumerate(rows):
        gain = p @ phi / (1e-8 + phi @ p @ phi)
        theta = theta + gain * (u[n] - theta @ phi)
        p = p - np.outer(gain, phi @ p)
        p = p + np.diag(np.where(np.diag(p) < 100.0, 1e-4 * h, 0.0))
        expected[n] = theta
    for i, name in enumerate(NAMES):
        np.testing.assert_allclose(found[name], expected[:, i], rtol=0, atol=1e-5)
    assert np.ptp(found["th0"]) > 0.1


@both
def test_the_first_inverse_has_the_identified_delay_and_the_least_noise(name: str) -> None:
    for apart_s in (1 / 1024, 4 / 1024):
        report = law(name, delay_s=0.017, apart_s=apart_s).report()
        got = [report[key] for key in NAMES]
        np.testing.assert_allclose(got, first(0.017, apart_s), rtol=1e-12)
        assert report["alpha"] == pytest.approx(0.017 * 1024)


@both
def test_the_command_is_the_sum_of_four_of_its_samples(name: str) -> None:
    x = smooth_motion(2.0, 3)
    x -= x[0]
    for apart in (1, 5, 64):
        expected = taps(x, apart) @ first(0.017, apart / 1024)
        np.testing.assert_allclose(
            law(name, delay_s=0.017, apart_s=apart / 1024).run(x), expected, atol=1e-13
        )


@both
def test_what_an_actuator_does_is_inverted(name: str) -> None:
    """An actuator whose inverse is exactly of this form is found to a thousandth."""
    true = np.array([4.0, 1.0, -1.5, -2.55])
    t = np.arange(8 * 1024) * H
    sent = 0.004 * (np.sin(9.0 * t) + 0.6 * np.sin(47.0 * t) + 0.4 * np.sin(83.0 * t))
    sent *= 1 - np.exp(-((t / 0.3) ** 3))
    came = np.asarray(scipy.signal.lfilter([1.0], true, sent))
    found = law(name, delay_s=0.01, **({"noise_m": 1e-7} if name == "kf-adc" else {}))
    values = found.follow(np.zeros_like(sent), sent, came)[1]
    z = np.exp(-2j * np.pi * np.array([1.5, 4.0, 8.0]) / 1024)
    got = np.array([values[key][-1] for key in NAMES])
    response = np.polyval(got[::-1], z) / np.polyval(true[::-1], z)
    np.testing.assert_allclose(response, 1.0, atol=3e-3)


@both
def test_nothing_that_comes_back_makes_the_recursion_run_off(name: str) -> None:
    rng = np.random.default_rng(1)
    sent = smooth_motion(6.0, 3, peak_m=0.02)
    for came in (rng.normal(size=sent.size) * 1e-9, np.zeros(sent.size), 1e3 * np.sign(sent)):
        found = law(name).follow(np.zeros_like(sent), sent, came)[1]
        for key in NAMES:
            assert np.isfinite(found[key]).all()
            assert np.abs(found[key]).max() <= 1000.0


@both
@pytest.mark.parametrize(
    ("line", "complaint"),
    [("apart_s = 0.1", "at most 64 samples"), ("cutoff_hz = 0.2", "must be"),
     ("theta_max = 0.5", "must be")],
)  # fmt: skip
def test_settings_that_do_not_fit_are_named(name: str, line: str, complaint: str) -> None:
    text = f"""schema = "rthyb-test/1"
test = {{ name = "a" }}
numerical = {{ period_s = 0.5, damping_ratio = 0.02 }}
controller = {{ type = "{name}", {name.replace("-", "_")} = {{ delay_s = 0.02, {line} }} }}
"""
    with pytest.raises(InputError) as caught:
        config.parse_test(text, "test.toml")
    assert complaint in str(caught.value)


@both
def test_the_shaking_table_follows(name: str) -> None:
    """The shipped rig and El Centro; without compensation the same test diverges."""
    test = config.load_test(config.builtin_test_path(), {"controller.type": name})
    setup = experiment.prepare(test, config.load_rig(config.find_rig(test.rig)))
    rec = virtual_time.run(setup)
    assert rec.meta["end_reason"] == "completed"
    rows = rec.samples[rec.running()]
    error = rows["x_meas_m"] - rows["x_num_m"]
    tracking = math.sqrt(np.mean(error**2) / np.mean(rows["x_num_m"] ** 2))
    assert tracking < 0.03
