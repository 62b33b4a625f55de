"""Adaptive time series (Chae et al. 2013): against numpy's least squares and exact inverses."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.signal
from kernels import FS_HZ, Floats, H, smooth_motion, time_s

from rthyb_rt import config, core
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time

LOOSE = {
    "ats.a0_rate_per_s": 1e3,
    "ats.a1_rate_s_per_s": 1e3,
    "ats.a2_rate_s2_per_s": 1e3,
    "ats.threshold_m": 0.0,
}


def ats(period_s: float = H, **settings: float) -> core.Law:
    own = {f"ats.{key}": value for key, value in settings.items()}
    return core.Law(core.LawConfig("ats", LOOSE | own), period_s=period_s)


def terms(x: Floats, h: float = H) -> Floats:
    """x and its backward differences of first and second order, (n, 3); at rest before."""
    before = np.concatenate([[x[0], x[0]], x])
    slope = np.diff(before)[1:] / h
    curvature = np.diff(before, 2) / h**2
    return np.column_stack([x, slope, curvature])


def lagged(command: Floats, a: tuple[float, float, float], h: float = H) -> Floats:
    """What an actuator with the inverse a0 m + a1 m' + a2 m'' makes of a command, by lfilter."""
    a0, a1, a2 = a
    bottom = np.array([a0 + a1 / h + a2 / h**2, -a1 / h - 2.0 * a2 / h**2, a2 / h**2])
    return np.asarray(scipy.signal.lfilter([1.0], bottom, command))


def learn(law: core.Law, sent: Floats, came: Floats) -> dict[str, Floats]:
    return law.follow(np.zeros_like(sent), sent, came)[1]


@pytest.mark.parametrize("fs_hz", [256.0, 1024.0, 4096.0])
@pytest.mark.parametrize("a", [(1.0, 0.017, 0.0), (1.06, 0.02, 2e-4), (0.93, 0.009, 8e-5)])
def test_a_lag_of_its_own_form_is_found_and_inverted_exactly(
    a: tuple[float, float, float], fs_hz: float
) -> None:
    h = 1.0 / fs_hz
    t = np.arange(round(6.0 * fs_hz)) * h
    sent = 0.01 * (np.sin(9.0 * t) + 0.6 * np.sin(23.0 * t)) * (1 - np.exp(-((t / 0.3) ** 3)))
    law = ats(h)
    found = learn(law, sent, lagged(sent, a, h))
    for name, value in zip(("a0", "a1", "a2"), a, strict=True):
        assert found[name][-1] == pytest.approx(value, rel=1e-6, abs=1e-9)
    assert found["alpha"][-1] == pytest.approx(a[1] * fs_hz, rel=1e-6)
    assert found["beta"][-1] == pytest.approx(a[2] * fs_hz**2, rel=1e-5, abs=1e-4)
    wanted = np.asarray(smooth_motion(3.0, 7)) if fs_hz == FS_HZ else sent[: round(3 * fs_hz)]
    held = core.Law(core.LawConfig("ats", LOOSE), period_s=h)
    held.restore(law.save())
    held.rest(0.0)
    reached = lagged(held.run(wanted), a, h)
    assert np.max(np.abs(reached - wanted)) < 1e-6 * np.max(np.abs(wanted))


def test_of_a_pure_delay_what_is_left_is_of_second_order() -> None:
    """a2 = a1^2 / 2 is the series of a delay; that backward differences are half a sample late
    leaves a1 h / 2 times the acceleration: half the frequency, a quarter to an eighth."""
    delay, left = 8, []
    for frequency_hz in (2.0, 1.0):
        t = time_s(8.0)
        x = np.sin(2 * np.pi * frequency_hz * t)
        led = ats(a1_s=delay * H).run(x)
        error = np.concatenate([np.zeros(delay), led[:-delay]]) - x
        back = np.exp(-2j * np.pi * frequency_hz * H)
        exact = (1 + delay * (1 - back) + delay**2 / 2 * (1 - back) ** 2) * back**delay - 1
        left.append(np.max(np.abs(error[t > 2.0])))
        assert left[-1] == pytest.approx(abs(exact), rel=1e-3)
    assert 4.0 < left[0] / left[1] < 8.0


@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_coefficients_are_numpys_least_squares_over_the_window(fs_hz: float) -> None:
    """On a plant of another form, with noise: scipy's Butterworth, numpy's lstsq, the same rows."""
    h, spacing = 1.0 / fs_hz, round(fs_hz / 256)
    rng = np.random.default_rng(5)
    t = np.arange(round(3.0 * fs_hz)) * h
    sent = 0.008 * (np.sin(11.0 * t) + 0.5 * np.sin(31.0 * t + 1.0))
    sent -= sent[0]
    late = round(0.012 * fs_hz)
    came = 0.96 * np.concatenate([np.zeros(late), sent[:-late]]) + 2e-6 * rng.normal(size=t.size)
    found = learn(ats(h, a0_max=10.0), sent, came)
    sections = scipy.signal.butter(6, 20.0, fs=fs_hz, output="sos")

    def smooth(x: Floats) -> Floats:
        rest = scipy.signal.sosfilt_zi(sections) * x[0]
        return np.asarray(scipy.signal.sosfilt(sections, x, zi=rest)[0])

    m, u = terms(smooth(came), h), smooth(sent)
    for end in (round(1.4 * fs_hz), round(2.3 * fs_hz), t.size):
        last = end - end % spacing
        rows = np.arange(last - 256 * spacing, last, spacing) + spacing - 1
        expected = np.linalg.lstsq(m[rows], u[rows], rcond=None)[0]
        got = [found[name][last - 1] for name in ("a0", "a1", "a2")]
        np.testing.assert_allclose(got, expected, rtol=2e-6)


def test_nothing_is_learnt_below_the_threshold_nor_before_the_window_is_full() -> None:
    sent = smooth_motion(6.0, 2, peak_m=2e-4)
    came = lagged(sent, (1.0, 0.017, 0.0))
    quiet = learn(core.Law(core.LawConfig("ats", {})), sent, came)
    assert set(quiet["a1"]) == {0.02}
    loud = learn(core.Law(core.LawConfig("ats", {})), 100 * sent, 100 * came)
    first = np.flatnonzero(loud["a1"] != 0.02)[0]
    assert first == pytest.approx(FS_HZ, abs=4)


def test_one_sine_alone_does_not_throw_the_coefficients_about() -> None:
    """x'' is a multiple of x there: what it does not tell apart stays within the bounds."""
    t = time_s(10.0)
    sent = 0.01 * np.sin(12.0 * t)
    found = learn(core.Law(core.LawConfig("ats", {})), sent, lagged(sent, (1.0, 0.017, 0.0)))
    assert 0.7 <= found["a0"].min() <= found["a0"].max() <= 1.3
    led = found["a0"] - found["a2"] * 144.0  # the part in phase, all that a sine shows
    assert led[-1] == pytest.approx(1.0, abs=0.01)
    assert found["a1"][-1] == pytest.approx(0.017, rel=0.01)


def test_bounds_and_rates_of_change_hold_whatever_comes_back() -> None:
    rng = np.random.default_rng(1)
    sent = smooth_motion(6.0, 3)
    came = rng.normal(size=sent.size) * 0.02
    found = learn(core.Law(core.LawConfig("ats", {})), sent, came)
    for name, low, high, rate in (
        ("a0", 0.7, 1.3, 2.0),
        ("a1", 0.0, 0.08, 0.05),
        ("a2", 0.0, 0.0032, 0.001),
    ):
        values = found[name]
        assert low <= values.min() <= values.max() <= high
        steps = np.abs(np.diff(values))
        assert steps.max() <= rate / 256 * (1 + 1e-9)
        assert steps.max() > 0.0


def test_it_begins_with_a_share_of_the_squared_delay_as_curvature() -> None:
    for share in (0.0, 0.2, 0.5):
        first = ats(a1_s=0.02, a2_share=share).report()
        assert (first["a0"], first["a1"]) == (1.0, 0.02)
        assert first["a2"] == pytest.approx(share * 4e-4)


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("window_s = 2", "must be from 4 to 288 times spacing_s"),
        ("spacing_s = 0.5", "window_s = 1 s, its default; must be from 4 to 288 times spacing_s"),
        ("a1_s = 0.09", "a1_max_s = 0.08"),
        ("a2_max_s2 = 1e-6", "a2_share times the square of a1_s"),
        ("a2_share = 1.5", "must be"),
        ("a0_min = 0", "above 0"),
        ("window_s = 0", "above 0"),
    ],
)
def test_settings_that_do_not_fit_are_named(line: str, complaint: str) -> None:
    text = """schema = "rthyb-test/1"
test = { name = "a" }
numerical = { period_s = 0.5, damping_ratio = 0.02 }
controller = { type = "ats", ats = { a1_s = 0.02, %s } }
"""
    if line.startswith("a1_s"):
        text = text.replace("a1_s = 0.02, ", "")
    with pytest.raises(InputError) as caught:
        config.parse_test(text % line, "test.toml")
    assert complaint in str(caught.value)


def test_a_setting_changed_on_the_command_line_is_not_blamed_for_the_value_of_another() -> None:
    """The error is told at the option, which has not the value that is out of bounds."""
    changes = {"controller.type": "ats", "controller.ats.spacing_s": "1e-9"}
    with pytest.raises(InputError) as caught:
        config.load_test(config.builtin_test_path(), changes)
    assert str(caught.value).startswith(
        "--set controller.ats.spacing_s: found window_s = 1 s, its default; must be from 4 to 288 "
        "times spacing_s = 1e-09 s"
    )


def test_the_delay_of_the_rig_is_what_its_bound_is_held_against() -> None:
    """A rig of 16.6 ms: a1 starts from there, so its bound may be below the default of 20 ms."""
    rig = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    for most, fits in (("0.018", True), ("0.015", False)):
        changes = {"controller.type": "ats", "controller.ats.a1_max_s": most}
        test = config.load_test(config.builtin_test_path(), changes)
        if fits:
            assert config.derive(test, rig).law_settings["ats.a1_s"] < float(most)
            continue
        with pytest.raises(InputError, match=r"gives identified\.delay_s = .*a1_max_s = 0\.015"):
            config.derive(test, rig)


def test_the_shaking_table_follows_within_one_percent() -> None:
    """The shipped rig and El Centro; without compensation the same test diverges."""
    test = config.load_test(config.builtin_test_path(), {"controller.type": "ats"})
    rig = config.load_rig(config.find_rig(test.rig))
    setup = experiment.prepare(test, rig)
    rec = virtual_time.run(setup)
    assert rec.meta["end_reason"] == "completed"
    rows = rec.samples[rec.running()]
    error = rows["x_meas_m"] - rows["x_num_m"]
    assert math.sqrt(np.mean(error**2) / np.mean(rows["x_num_m"] ** 2)) < 0.01
    assert rows["alpha"][-1] == pytest.approx(17.0, abs=2.0)
