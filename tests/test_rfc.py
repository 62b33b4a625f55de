"""Restoring-force compensator: Eqn 3.1-3.3 written again in numpy, and closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
from kernels import FS_HZ, Floats, H, smooth_motion

from rthyb_rt import config, core
from rthyb_rt.lab import experiment, virtual_time

ROOT = Path(__file__).resolve().parents[1]
K_E = 1e6


def rfc(**settings: Any) -> core.Rfc:
    return core.Rfc(core.RfcConfig(**({"k_e_n_per_m": K_E, "window": 20} | settings)))


def softening(x: Floats) -> Floats:
    """A force whose slope runs from K_E down to almost nothing."""
    return np.asarray(K_E * 0.004 * np.tanh(x / 0.004))


def printed_tangent(x_m: Floats, f: Floats, window: int, divisor: str, end: int) -> Floats:
    """Eqn 3.3 with its three stages, term by term."""
    dx, df = np.diff(x_m, prepend=0.0), np.diff(f, prepend=0.0)
    ratio = np.empty_like(x_m)
    last = K_E
    for n in range(x_m.size):
        last = ratio[n] = df[n] / dx[n] if dx[n] != 0.0 else last
    k = np.full_like(x_m, K_E)
    terms = window if divisor == "printed" else window + 1
    for n in range(2 * window + 1, min(end, x_m.size)):
        k[n] = min(max(np.sum(ratio[n - window : n + 1]) / terms, 0.0), K_E)
    return k


def motion_with_command(seed: int) -> tuple[Floats, Floats, Floats]:
    x_c = smooth_motion(4.0, seed)
    x_m = np.interp(np.arange(x_c.size) - 10.0, np.arange(x_c.size), x_c)
    return x_c, x_m, softening(x_m)


@pytest.mark.parametrize("window", [1, 2, 20, 51, 1024])
@pytest.mark.parametrize("divisor", ["printed", "terms"])
def test_tangent_is_eqn_3_3_in_its_three_stages(window: int, divisor: str) -> None:
    x_c, x_m, f = motion_with_command(1)
    end = 3500
    force, k = rfc(window=window, divisor=divisor, end_tick=end).run(x_c, x_m, f)
    expected = printed_tangent(x_m, f, window, divisor, end)
    np.testing.assert_allclose(k, expected, rtol=0, atol=1e-9 * K_E)
    np.testing.assert_allclose(force, f + expected * (x_c - x_m), rtol=0, atol=1e-6)
    assert np.all(k[: 2 * window + 1] == K_E)
    assert np.all(k[end:] == K_E)


@pytest.mark.parametrize("window", [1, 2, 3, 20, 51, 200])
def test_least_squares_tangent_is_the_regression_line_of_the_window(window: int) -> None:
    x_c, x_m, f = motion_with_command(2)
    f = f + np.random.default_rng(3).normal(scale=5.0, size=f.size)
    _, k = rfc(window=window, tangent="least-squares").run(x_c, x_m, f)
    for n in range(2 * window + 60, x_m.size, 37):
        rows = slice(n - window, n + 1)
        slope = np.polyfit(x_m[rows] - x_m[n], f[rows] - f[n], 1)[0]
        assert k[n] == pytest.approx(np.clip(slope, 0.0, K_E), abs=1e-7 * K_E)


def test_printed_divisor_is_high_by_one_in_t0_and_the_other_is_exact() -> None:
    x = smooth_motion(2.0, 4)
    k_true = 0.5 * K_E
    _, printed = rfc(window=20).run(x, x, k_true * x)
    _, terms = rfc(window=20, divisor="terms").run(x, x, k_true * x)
    _, slope = rfc(window=20, tangent="least-squares").run(x, x, k_true * x)
    np.testing.assert_allclose(printed[41:], k_true * 21.0 / 20.0, rtol=1e-6)
    np.testing.assert_allclose(terms[41:], k_true, rtol=1e-6)
    np.testing.assert_allclose(slope[41:], k_true, rtol=1e-6)


@pytest.mark.parametrize("tangent", ["mean-of-ratios", "least-squares"])
def test_tangent_stays_between_zero_and_the_elastic_stiffness(tangent: str) -> None:
    rng = np.random.default_rng(5)
    x, f = rng.normal(scale=1e-5, size=3000), rng.normal(scale=100.0, size=3000)
    _, k = rfc(tangent=tangent).run(x, x, f)
    assert k.min() == 0.0
    assert k.max() == K_E
    _, falling = rfc(tangent=tangent).run(x, x, -K_E * x)
    assert np.all(falling[41:] == 0.0)
    _, stiffer = rfc(tangent=tangent).run(x, x, 3.0 * K_E * x)
    assert np.all(stiffer == K_E)


@pytest.mark.parametrize("tangent", ["mean-of-ratios", "least-squares"])
def test_elastic_specimen_with_its_own_stiffness_makes_the_compensation_an_identity(
    tangent: str,
) -> None:
    x_c, x_m, _ = motion_with_command(6)
    force, k = rfc(tangent=tangent, divisor="printed").run(x_c, x_m, K_E * x_m)
    np.testing.assert_allclose(k, K_E, rtol=1e-6)
    np.testing.assert_allclose(force, K_E * x_c, rtol=0, atol=0.02)


@pytest.mark.parametrize("tangent", ["mean-of-ratios", "least-squares"])
def test_specimen_that_moves_not_at_all_leaves_the_tangent_where_it_was(tangent: str) -> None:
    x_c = smooth_motion(2.0, 7)
    x_m, f = np.zeros_like(x_c), np.zeros_like(x_c)
    force, k = rfc(tangent=tangent, divisor="terms").run(x_c, x_m, f)
    np.testing.assert_allclose(k, K_E, rtol=1e-12)
    np.testing.assert_allclose(force, K_E * x_c, rtol=1e-12)


@pytest.mark.parametrize("tangent", ["mean-of-ratios", "least-squares"])
def test_specimen_that_stops_keeps_the_last_tangent_and_goes_on_afterwards(tangent: str) -> None:
    x = smooth_motion(3.0, 8, peak_m=0.002)
    stopped = x.copy()
    stopped[1500:2500] = x[1500]
    stopped[2500:] = x[2500:] - x[2500] + x[1500]
    f = 0.4 * K_E * stopped
    _, k = rfc(tangent=tangent, divisor="terms").run(stopped, stopped, f)
    np.testing.assert_allclose(k[41:], 0.4 * K_E, rtol=1e-6)


def test_frozen_tangent_waits_and_then_sees_the_whole_window_again() -> None:
    x_c, x_m, f = motion_with_command(9)
    kernel, free = rfc(), rfc()
    held = 0.0
    for n in range(2500):
        frozen = 1000 <= n < 1100
        kernel.step(x_c[n], x_m[n], f[n], frozen)
        free.step(x_c[n], x_m[n], f[n])
        if n == 999:
            held = kernel.k_n_per_m
        if frozen:
            assert kernel.k_n_per_m == held
        else:
            assert kernel.k_n_per_m == free.k_n_per_m


def test_switched_off_passes_the_measured_force() -> None:
    x_c, x_m, f = motion_with_command(10)
    force, k = rfc(enabled=False).run(x_c, x_m, f)
    np.testing.assert_array_equal(force, f)
    np.testing.assert_allclose(k, printed_tangent(x_m, f, 20, "printed", 10**9), atol=1e-9 * K_E)


def test_least_squares_holds_through_noise_at_rest_where_the_mean_of_ratios_chatters() -> None:
    rng = np.random.default_rng(11)
    x = smooth_motion(6.0, 12, peak_m=0.002)
    x[3072:] = x[3072]
    k_true = 0.6 * K_E
    x_m = x + rng.normal(scale=2e-6, size=x.size)
    f = k_true * x + rng.normal(scale=2.0, size=x.size)
    settings = {"window": 51, "rest_noise_m": 2e-6}
    _, ratios = rfc(**settings).run(x, x_m, f)
    _, slope = rfc(tangent="least-squares", **settings).run(x, x_m, f)
    at_rest = slice(3200, None)
    assert np.mean(ratios[at_rest] == 0.0) > 0.2
    assert np.ptp(slope[at_rest]) == 0.0
    assert slope[-1] == pytest.approx(k_true, rel=0.25)


def test_start_away_from_zero_gives_no_false_first_ratio() -> None:
    config = core.RfcConfig(k_e_n_per_m=K_E, window=1)
    kernel = core.Rfc(config, x0_m=0.01, f0_n=5000.0)
    force, code = kernel.step(0.01, 0.01, 5000.0)
    assert (force, code, kernel.k_n_per_m) == (5000.0, 0, K_E)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"window": 0}, "T0"),
        ({"window": core.WINDOW_MAX + 1}, "T0"),
        ({"k_e_n_per_m": 0.0}, "k_e"),
        ({"k_e_n_per_m": -1.0}, "k_e"),
        ({"k_e_n_per_m": np.nan}, "k_e"),
        ({"k_e_n_per_m": np.inf}, "k_e"),
        ({"rest_noise_m": -1e-9}, "noise"),
        ({"rest_noise_m": np.nan}, "noise"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(core.CoreError, match=message):
        rfc(**settings)


def test_window_below_zero_is_refused_like_any_other_window() -> None:
    with pytest.raises(core.CoreError, match="T0"):
        rfc(window=-1)


@pytest.mark.parametrize(("x0_m", "f0_n"), [(np.nan, 0.0), (0.0, np.nan), (np.inf, 0.0)])
def test_senseless_start_is_refused(x0_m: float, f0_n: float) -> None:
    with pytest.raises(core.CoreError):
        core.Rfc(core.RfcConfig(k_e_n_per_m=K_E), x0_m, f0_n)


# ---- low-pass and lateness ----------------------------------------------------------------------


@pytest.mark.parametrize(("cutoff_hz", "period_s"), [(60.0, H), (10.0, H), (60.0, H / 4)])
def test_difference_of_the_displacements_goes_through_a_butterworth_low_pass(
    cutoff_hz: float, period_s: float
) -> None:
    x_c, x_m, f = motion_with_command(13)
    force, k = rfc(cutoff_hz=cutoff_hz, period_s=period_s).run(x_c, x_m, f)
    top, bottom = scipy.signal.butter(2, cutoff_hz, fs=1.0 / period_s)
    apart = scipy.signal.lfilter(top, bottom, x_c - x_m)
    np.testing.assert_allclose(force, f + k * apart, rtol=0, atol=1e-6)
    _, full_band = rfc().run(x_c, x_m, f)
    np.testing.assert_array_equal(k, full_band)


def test_low_pass_keeps_the_noise_of_the_displacement_out_of_the_force() -> None:
    rng = np.random.default_rng(14)
    x = smooth_motion(4.0, 15)
    x_m = x + rng.normal(scale=1e-5, size=x.size)
    settings = {"tangent": "least-squares", "rest_noise_m": 1e-5}
    wide, _ = rfc(**settings).run(x, x_m, K_E * x)
    narrow, _ = rfc(cutoff_hz=60.0, **settings).run(x, x_m, K_E * x)
    assert np.std(narrow - K_E * x) < 0.4 * np.std(wide - K_E * x)


@pytest.mark.parametrize("late_s", [0.5 * H, 1.5 * H, -H])
def test_force_that_is_late_is_the_force_at_the_command_again(late_s: float) -> None:
    """An elastic specimen that tracks its command, and a load cell that is late behind that."""
    t = np.arange(round(6.0 * FS_HZ)) * H
    w = 2.0 * np.pi * 3.0
    x, v = 0.01 * np.sin(w * t), 0.01 * w * np.cos(w * t)
    f = K_E * 0.01 * np.sin(w * (t - late_s))
    settings = {"tangent": "least-squares", "window": 34, "lateness_s": late_s}
    force, k = rfc(**settings).run(x, x, f, v)
    np.testing.assert_allclose(force, f + k * late_s * v, rtol=0, atol=1e-6)
    settled = slice(1000, None)
    before = np.std((f - K_E * x)[settled])
    assert np.std((force - K_E * x)[settled]) < 0.1 * before


def test_motion_along_a_path_keeps_the_low_pass_up_to_date() -> None:
    x_c, x_m, f = motion_with_command(16)
    watched, free = rfc(cutoff_hz=20.0), rfc(cutoff_hz=20.0)
    for n in range(1500):
        watched.follow(x_c[n], x_m[n], f[n])
        free.step(x_c[n], x_m[n], f[n])
    held, _ = watched.step(x_c[1500], x_m[1500], f[1500])
    expected = scipy.signal.lfilter(*scipy.signal.butter(2, 20.0, fs=FS_HZ), x_c - x_m)[1500]
    assert held == pytest.approx(f[1500] + K_E * expected, abs=1e-6)
    assert watched.k_n_per_m == K_E  # nothing was learnt on the way


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, -1e300])
@pytest.mark.parametrize("place", range(4))
def test_senseless_sample_is_named_and_leaves_no_trace(bad: float, place: int) -> None:
    kernel, spared = (rfc(cutoff_hz=60.0, lateness_s=H) for _ in range(2))
    good = (1e-3, 1e-3, 900.0, 0.1)
    for _ in range(100):
        kernel.step(*good[:3], v_c_m_per_s=good[3])
        spared.step(*good[:3], v_c_m_per_s=good[3])
    met = [*good]
    met[place] = bad
    force, code = kernel.step(*met[:3], v_c_m_per_s=met[3])
    assert core.status_names(code) in (["not_finite"], ["out_of_range"])
    assert (force, 0) == spared.step(*good[:3], v_c_m_per_s=good[3])
    kernel.follow(*met[:3] if place < 3 else good[:3])
    spared.follow(*good[:3])
    assert kernel.step(*good[:3]) == spared.step(*good[:3])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cutoff_hz": -1.0}, "cut-off"),
        ({"cutoff_hz": np.nan}, "cut-off"),
        ({"cutoff_hz": np.inf}, "cut-off"),
        ({"cutoff_hz": 512.0}, "cut-off"),
        ({"cutoff_hz": 60.0, "period_s": 0.0}, "period"),
        ({"lateness_s": np.nan}, "limit"),
        ({"lateness_s": 1.1}, "limit"),
        ({"lateness_s": -1e300}, "limit"),
    ],
)
def test_senseless_filter_and_lateness_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(core.CoreError, match=message):
        rfc(**settings)


def test_frame_whose_force_comes_late_answers_rightly_again() -> None:
    """The benchmark's unit delay and hold, on the frame of three storeys."""
    text = (ROOT / "examples" / "frame-three-storeys.toml").read_text(encoding="utf-8")
    rig = config.load_rig(config.shipped_rig("rths-benchmark"))
    wanted = {
        "numerical.matrices.integrator": "rk4",
        "numerical.matrices.force_delay_samples": "1",
        "controller.w1": "2.088",  # both poles of the lead at 60 Hz
        "controller.w2": "-2.890",
        "limits.force_n": "8.9 kN",
        "ground_motion.duration_s": "10",
        "test.free_vibration_s": "0",
    }
    errors = {}
    for late_s in (0.0, 1.5 * H):
        more = wanted | {"controller.rfc.force_lateness_s": repr(late_s)}
        test = config.parse_test(text, "frame", more)
        setup = experiment.prepare(test, rig)
        rows = virtual_time.run(setup).samples
        x = rows["x_num_m"][rows["state"] == core.RUNNING][: setup.ticks]
        reference = setup.reference["x_ref_m"]
        errors[late_s] = np.std(x - reference) / np.std(reference)
    assert errors[0.0] > 0.05
    assert errors[1.5 * H] < 0.1 * errors[0.0]
