"""Delay estimator: Eqn 2.6-2.11 written again, scipy's filters, numpy's least squares, and the
closed forms of what each law converges to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
from kernels import FS_HZ, Floats, H, smooth_motion, time_s

import rthyb_rt as rt
from rthyb_rt import core

Plant = Callable[[complex], complex]


def estimator(law: Any, w1: float = 3.0, w2: float = 2.0, **settings: Any) -> core.Estimator:
    return core.Estimator(core.EstimatorConfig(law=law, **settings), w1=w1, w2=w2)


def delayed(x: Floats, samples: int) -> Floats:
    return np.concatenate([np.zeros(samples), x[: x.size - samples]])


def regressors(x_p: Floats, x_m: Floats, w1: float = 3.0, w2: float = 2.0) -> tuple[Floats, ...]:
    """mu, phi (Eqn 2.8) and the curvature regressor, from displacements in mm."""
    s = w1 + w2 + 1.0
    weights = [w1, w2, 1.0]
    mu = scipy.signal.lfilter(weights, 1.0, x_p) - scipy.signal.lfilter(weights, 1.0, x_m)
    phi = scipy.signal.lfilter([s, -s], 1.0, x_m)
    return mu, phi, scipy.signal.lfilter([s, -2.0 * s, s], 1.0, x_m)


def least_squares_alpha(
    plant: Plant, frequency_hz: float, w1: float = 3.0, w2: float = 2.0
) -> float:
    """Re{W (1/H - 1) conj(S (1 - 1/z))} / |S (1 - 1/z)|^2 at one frequency."""
    z = complex(np.exp(2j * np.pi * frequency_hz / FS_HZ))
    s = w1 + w2 + 1.0
    phi = s * (1.0 - 1.0 / z)
    mu = (w1 + w2 / z + 1.0 / z**2) * (1.0 / plant(z) - 1.0)
    return (mu * np.conj(phi)).real / abs(phi) ** 2


def low_pass(x: Floats) -> Floats:
    """Second-order Butterworth at 25 Hz, at rest before the first sample."""
    return np.asarray(scipy.signal.lfilter(*scipy.signal.butter(2, 25.0, fs=FS_HZ), x))


def in_band(x: Floats) -> Floats:
    """What each signal of the pair passes, the first sample taken for rest: the low-pass less its
    mean so far, which from 3.2 s on forgets with that time constant."""
    low = low_pass(x - x[0])
    level, out = 0.0, np.zeros_like(low)
    for n in range(low.size):
        level += (low[n] - level) * max(1.0 / (n + 1), H / 3.2)
        out[n] = low[n] - level
    return out


def unit_noise(std_m: float) -> Floats:
    """One sample of noise at rest, in mm, and what the filter makes of it."""
    impulse = np.zeros(8192)
    impulse[0] = 1e3 * std_m
    low, share = low_pass(impulse), H / 3.2
    return np.asarray(low - scipy.signal.lfilter([share], [1.0, share - 1.0], low))


# --- the law as printed --------------------------------------------------------------------------


@pytest.mark.parametrize(("w1", "w2"), [(3.0, 2.0), (2.0, -0.5), (-4.0, 1.0)])
def test_printed_law_is_eqn_2_6_to_2_11_in_millimetres(w1: float, w2: float) -> None:
    rng = np.random.default_rng(1)
    x_p, x_m = rng.normal(scale=1e-4, size=2000), rng.normal(scale=1e-4, size=2000)
    mu, phi, curvature = regressors(1e3 * x_p, 1e3 * x_m, w1, w2)
    alpha, expected, gain, beta = 5.0, np.zeros(2000), 0.7, 3.0
    for n in range(2000):
        epsilon = (mu[n] - alpha * phi[n] - beta * curvature[n]) / (1.0 + phi[n] ** 2)
        alpha += gain * epsilon * phi[n]
        expected[n] = alpha
    found, held = estimator("gradient", gain=gain, alpha0=5.0, beta0=beta, w1=w1, w2=w2).run(
        x_p, x_m
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert np.all(held == beta)


def test_reference_displacement_is_the_unit_of_the_gain() -> None:
    x_p = smooth_motion(3.0, 2)
    x_m = delayed(x_p, 12)
    in_mm, _ = estimator("gradient", gain=0.3).run(x_p, x_m)
    scaled, _ = estimator("gradient", gain=0.3, reference_m=1e-2).run(10 * x_p, 10 * x_m)
    in_m, _ = estimator("gradient", gain=0.3, reference_m=1.0).run(x_p, x_m)
    np.testing.assert_allclose(scaled, in_mm, rtol=1e-9)
    assert np.ptp(in_mm) > 5.0
    assert np.ptp(in_m) < 1e-2


@pytest.mark.parametrize("frequency_hz", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("samples", [1, 5, 17])
def test_small_gain_settles_on_the_least_squares_value_of_a_pure_delay(
    frequency_hz: float, samples: int
) -> None:
    expected = least_squares_alpha(lambda z: z**-samples, frequency_hz)
    angle = 2 * np.pi * frequency_hz
    x_p = 1e-4 * np.sin(angle * time_s(100.0))
    x_m = 1e-4 * np.sin(angle * (time_s(100.0) - samples / FS_HZ))
    gain = 4e-4 / (6.0 * 0.1 * angle / FS_HZ) ** 2  # time constant 5000 samples
    alpha, _ = estimator("gradient", gain=gain, alpha0=expected + 1.0).run(x_p, x_m)
    assert np.mean(alpha[-10 * 1024 :]) == pytest.approx(expected, abs=0.01)


def test_estimate_on_the_papers_own_plant_is_its_alpha_exactly() -> None:
    # x_m from Eqn 2.6 with alpha = 21.5: no model error is left, whatever the motion.
    x_p, alpha, s = smooth_motion(40.0, 3), 21.5, 6.0
    x_m = scipy.signal.lfilter([3.0, 2.0, 1.0], [3.0 + alpha * s, 2.0 - alpha * s, 1.0], x_p)
    found, _ = estimator("gradient", gain=0.3).run(x_p, x_m)
    assert found[-1] == pytest.approx(alpha, abs=1e-6)
    robust, _ = estimator("robust", gain=0.05).run(x_p, x_m)
    assert robust[-1] == pytest.approx(alpha, abs=1e-4)
    rls, beta = estimator("rls", estimate_beta=True, memory_samples=1000.0).run(x_p, x_m)
    assert rls[-1] == pytest.approx(alpha, abs=1e-4)
    assert beta[-1] == pytest.approx(0.0, abs=1e-2)


def test_noise_alone_takes_the_printed_law_to_minus_one_twelfth() -> None:
    noise = np.random.default_rng(4).normal(scale=2e-6, size=200_000)
    alpha, _ = estimator("gradient", gain=1.0, alpha0=3.0).run(np.zeros_like(noise), noise)
    assert np.mean(alpha[50_000:]) == pytest.approx(-1.0 / 12.0, abs=0.01)


def test_noise_on_the_measurement_biases_the_printed_law_low_by_the_closed_form() -> None:
    t, std = time_s(200.0), 10e-6
    x_p = 1e-3 * np.sin(2 * np.pi * t)
    clean = 1e-3 * np.sin(2 * np.pi * (t - 17.0 / FS_HZ))
    x_m = clean + np.random.default_rng(5).normal(scale=std, size=t.size)
    power = np.mean(np.square(6e3 * np.diff(clean)))
    noise = (1e3 * std) ** 2
    free = least_squares_alpha(lambda z: z**-17, 1.0)
    expected = (free * power - 6.0 * noise) / (power + 72.0 * noise)
    alpha, _ = estimator("gradient", gain=0.02).run(x_p, x_m)
    assert expected < 15.0
    assert np.mean(alpha[t.size // 2 :]) == pytest.approx(expected, rel=0.05)


# --- the robust law ------------------------------------------------------------------------------


def robust_law(x_p: Floats, x_m: Floats, gain: float, gate_power: float, alpha: float) -> Floats:
    """The printed law behind scipy's filter pair, power normalised, gated, in mm."""
    mu, phi, _ = regressors(1e3 * in_band(x_p), 1e3 * in_band(x_m))
    power = short = 0.0
    out = np.zeros_like(mu)
    for n in range(mu.size):
        short += (phi[n] ** 2 - short) * H / 0.2
        if short > max(gate_power, 1e-18):
            power += (phi[n] ** 2 - power) * H / 2.0
            step = gain * (mu[n] - alpha * phi[n]) * phi[n] / max(power, phi[n] ** 2)
            alpha = min(max(alpha + step, 0.0), 60.0)
        out[n] = alpha
    return out


def filtered_noise_power(std_m: float) -> float:
    """Mean phi^2 that white noise leaves behind the pair, mm^2."""
    return float(np.sum(np.square(6.0 * np.diff(unit_noise(std_m), prepend=0.0))))


def test_robust_law_is_the_printed_one_behind_the_25_hz_pair() -> None:
    x_p = smooth_motion(6.0, 6, peak_m=5e-4)
    x_m = delayed(x_p, 9) + np.random.default_rng(7).normal(scale=1e-6, size=x_p.size)
    gate = 10.0 * filtered_noise_power(1e-6)
    found, _ = estimator("robust", gain=0.01, alpha0=4.0, rest_noise_m=1e-6).run(x_p, x_m)
    np.testing.assert_allclose(found, robust_law(x_p, x_m, 0.01, gate, 4.0), rtol=0, atol=1e-8)


def test_robust_law_does_not_ask_in_which_unit_the_motion_is() -> None:
    x_p = 5e-3 * np.sin(2 * np.pi * 2.0 * time_s(4.0) + 1.0)
    x_m = delayed(x_p, 12)
    small, _ = estimator("robust", gain=0.01).run(0.01 * x_p, 0.01 * x_m)
    large, _ = estimator("robust", gain=0.01).run(x_p, x_m)
    np.testing.assert_allclose(small, large, rtol=1e-9)


@pytest.mark.parametrize("law", ["robust", "rls"])
def test_noise_at_rest_does_not_move_the_estimate(law: str) -> None:
    std = 5e-6
    noise = np.random.default_rng(9).normal(scale=std, size=60_000)
    kernel = estimator(law, gain=0.05, alpha0=17.0, rest_noise_m=std)
    alpha, _ = kernel.run(np.zeros_like(noise), noise)
    assert np.all(alpha == 17.0)
    assert not kernel.gate_open
    x_p = smooth_motion(1.0, 10)
    kernel.run(x_p, delayed(x_p, 12))
    assert kernel.gate_open


def test_filter_pair_keeps_noise_from_pulling_the_estimate_down() -> None:
    t, std = time_s(60.0), 10e-6
    x_p = 2e-3 * np.sin(2 * np.pi * 2.0 * t)
    x_m = 2e-3 * np.sin(2 * np.pi * 2.0 * (t - 17.0 / FS_HZ))
    x_m += np.random.default_rng(11).normal(scale=std, size=t.size)
    printed, _ = estimator("gradient", gain=0.03, alpha0=17.0).run(x_p, x_m)
    for law, settings in (("robust", {"gain": 0.01}), ("rls", {})):
        alpha, _ = estimator(law, alpha0=17.0, rest_noise_m=std, **settings).run(x_p, x_m)
        assert np.mean(alpha[-10_240:]) == pytest.approx(16.85, abs=0.25)
    assert np.mean(printed[-10_240:]) < 16.0


@pytest.mark.parametrize("law", ["robust", "rls"])
def test_estimate_is_projected_onto_its_bounds(law: str) -> None:
    x_p = smooth_motion(6.0, 12)
    settings = {"gain": 0.5, "alpha0": 10.0, "alpha_min": 8.0, "alpha_max": 14.0}
    slow, _ = estimator(law, **settings).run(x_p, delayed(x_p, 30))
    fast, _ = estimator(law, **settings).run(x_p, delayed(x_p, 2))
    assert slow[-1] == 14.0
    assert fast[-1] == 8.0
    assert min(slow.min(), fast.min()) >= 8.0
    assert max(slow.max(), fast.max()) <= 14.0


# --- recursive least squares ---------------------------------------------------------------------


@pytest.mark.parametrize("estimate_beta", [False, True])
@pytest.mark.parametrize("std", [0.0, 3e-6])
def test_recursive_least_squares_equals_the_batch_solution_of_numpy(
    estimate_beta: bool, std: float
) -> None:
    memory, alpha0, beta0 = 2000.0, 12.0, 40.0
    x_p = smooth_motion(5.0, 13, peak_m=2e-3)
    x_m = delayed(x_p, 15) + np.random.default_rng(14).normal(scale=std, size=x_p.size)
    kernel = estimator(
        "rls",
        estimate_beta=estimate_beta,
        memory_samples=memory,
        alpha0=alpha0,
        beta0=beta0,
        rest_noise_m=std,
        gate_factor=0.0,
    )
    alpha, beta = kernel.run(x_p, x_m)

    mu, phi1, phi2 = regressors(1e3 * in_band(x_p), 1e3 * in_band(x_m))
    learning = np.cumsum(phi1**2) > 0.0
    short = scipy.signal.lfilter([H / 0.2], [1.0, H / 0.2 - 1.0], phi1**2)
    learning &= short > 1e-18
    weight = np.where(learning, (1.0 - 1.0 / memory) ** np.arange(mu.size)[::-1], 0.0)
    # Noise on x_m enters mu and phi through the same filters; its products per sample.
    noise = np.array(regressors(np.zeros(8192), unit_noise(std)))
    spurious = noise @ noise.T * np.sum(weight)
    rows = np.vstack([mu, phi1, phi2])
    moments = (rows * weight) @ rows.T
    share = np.minimum(np.diag(spurious), [np.inf, *(0.5 * np.diag(moments)[1:])])
    moments -= spurious + np.diag(share - np.diag(spurious))
    # The start weighs like measurements that put alpha within 1 + alpha0/4; the filtered noise of
    # half a period of the cut-off counts once. No sensor is taken for quieter than 1 um there.
    quiet = np.array(regressors(np.zeros(8192), unit_noise(max(std, 1e-6))))
    residual = quiet[0] - alpha0 * quiet[1] - beta0 * quiet[2]
    spread = 1.0 + 0.25 * alpha0
    ridge = 0.5 * FS_HZ / 25.0 * np.sum(residual**2) / np.array([spread**2, spread**4])
    ridge = np.maximum(ridge, [1e-9, 1e-12])
    if estimate_beta:
        left = moments[1:, 1:] + np.diag(ridge)
        right = moments[1:, 0] + ridge * [alpha0, beta0]
        expected = np.linalg.solve(left, right)
    else:
        right = moments[1, 0] - beta0 * moments[1, 2] + ridge[0] * alpha0
        expected = np.array([right / (moments[1, 1] + ridge[0]), beta0])
    assert [alpha[-1], beta[-1]] == pytest.approx(list(expected), rel=1e-6)


def test_alpha_and_beta_of_a_pure_delay_are_those_of_its_taylor_series() -> None:
    # exp(s D) - 1 to second order over the weights: beta = (D^2 + D)/2 - D (W2 + 2)/S.
    t = time_s(40.0)
    phase = 2 * np.pi * (0.2 * t + 0.5 * (1.5 - 0.2) / 40.0 * t**2)
    x_p = 5e-3 * np.sin(phase)
    alpha, beta = estimator("rls", estimate_beta=True, memory_samples=20_000).run(
        x_p, delayed(x_p, 17)
    )
    assert alpha[-1] == pytest.approx(17.0, abs=0.1)
    assert beta[-1] == pytest.approx(0.5 * (17.0**2 + 17.0) - 17.0 * 4.0 / 6.0, rel=0.02)


def test_motion_that_cannot_tell_alpha_from_beta_leaves_both_where_they_are_known() -> None:
    # Along one growing exponential the two regressors are proportional: the equations are singular.
    x_p = 1e-10 * np.exp(0.05 * np.arange(450.0))
    kernel = estimator(
        "rls",
        estimate_beta=True,
        memory_samples=30.0,
        alpha0=10.0,
        beta0=50.0,
        reference_m=1e-9,
        gate_factor=0.0,
    )
    alpha, beta = kernel.run(x_p, delayed(x_p, 10))
    assert np.all((alpha >= 0.0) & (alpha <= 60.0))
    assert np.all(np.abs(beta) <= 1800.0)
    assert np.all(np.isfinite(list(kernel.state().values())))


def test_least_squares_forgets_an_old_delay_after_its_memory() -> None:
    x_p = 5e-3 * np.sin(2 * np.pi * time_s(60.0))
    x_m = delayed(x_p, 8)
    x_m[20_480:] = delayed(x_p, 20)[20_480:]
    alpha, _ = estimator("rls", memory_samples=2048.0).run(x_p, x_m)
    before, after = (least_squares_alpha(lambda z, d=d: z**-d, 1.0) for d in (8, 20))
    assert alpha[20_000] == pytest.approx(before, abs=0.02)
    assert alpha[20_480 + 2048] == pytest.approx(after - (after - before) / np.e, abs=0.5)
    assert np.mean(alpha[-1024:]) == pytest.approx(after, abs=0.02)


# --- holding and refusing ------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["gradient", "robust", "rls"])
def test_frozen_estimator_listens_but_does_not_learn(law: str) -> None:
    x_p = smooth_motion(6.0, 16)
    x_m = delayed(x_p, 10)
    kernel = estimator(law, gain=0.01, alpha0=3.0, estimate_beta=True)
    for n in range(2000):
        kernel.step(x_p[n], x_m[n])
    held = kernel.alpha, kernel.beta
    for n in range(2000, 2500):
        kernel.step(x_p[n], x_m[n], frozen=True)
        assert (kernel.alpha, kernel.beta) == held
    for n in range(2500, x_p.size):
        kernel.step(x_p[n], x_m[n])
    assert kernel.alpha != held[0]
    assert np.isfinite(kernel.alpha)


def test_robust_law_that_sees_its_first_motion_while_frozen_stays_finite() -> None:
    # The gate opens on the frozen samples; the first sample that may learn shows no motion at all.
    kernel = estimator("robust", gain=0.01, alpha0=17.0)
    for x in 1e-3 * np.sin(2 * np.pi * 2.0 * time_s(1.125)):
        kernel.step(x, x, frozen=True)
    for _ in range(2000):
        kernel.step(7e-4, 7e-4, frozen=True)
    for _ in range(10):
        kernel.step(7e-4, 7e-4)
        assert 0.0 <= kernel.alpha <= 60.0


def test_fixed_law_never_moves() -> None:
    x_p = smooth_motion(2.0, 17)
    alpha, beta = estimator("fixed", alpha0=17.0, beta0=100.0).run(x_p, delayed(x_p, 3))
    assert np.all(alpha == 17.0)
    assert np.all(beta == 100.0)


@pytest.mark.parametrize("law", ["gradient", "robust", "rls"])
def test_start_away_from_zero_is_no_motion(law: str) -> None:
    kernel = core.Estimator(core.EstimatorConfig(law=law, gain=0.5, alpha0=9.0), x0_m=0.02)
    for _ in range(100):
        kernel.step(0.02, 0.02)
    assert kernel.alpha == 9.0


BASE = core.EstimatorConfig(law="robust", gain=0.01)


@pytest.mark.parametrize(
    "setting",
    [
        {"period_s": 0.0},
        {"period_s": -H},
        {"period_s": np.nan},
        {"alpha0": np.nan},
        {"alpha0": 1e6},
        {"beta0": np.inf},
        {"reference_m": 0.0},
        {"reference_m": np.nan},
        {"gain": -0.1},
        {"gain": np.nan},
        {"cutoff_hz": 0.0},
        {"cutoff_hz": 512.0},
        {"cutoff_hz": np.nan},
        {"alpha_min": 61.0},
        {"alpha_max": np.inf},
        {"alpha_min": np.nan},
        {"rest_noise_m": -1e-6},
        {"rest_noise_m": np.nan},
        {"gate_factor": -1.0},
        {"gate_factor": np.nan},
        {"law": "rls", "memory_samples": 0.5},
        {"law": "rls", "memory_samples": np.nan},
    ],
    ids=str,
)
def test_setting_out_of_range_is_refused(setting: dict[str, Any]) -> None:
    core.Estimator(BASE)
    with pytest.raises(core.CoreError):
        core.Estimator(replace(BASE, **setting))


@pytest.mark.parametrize("law", ["gradient", "robust", "rls"])
@pytest.mark.parametrize("x0_m", [np.nan, np.inf, 1e300])
def test_senseless_start_position_is_refused(law: str, x0_m: float) -> None:
    with pytest.raises(core.CoreError):
        core.Estimator(core.EstimatorConfig(law=law, gain=0.01), x0_m)


@pytest.mark.parametrize("law", ["gradient", "robust", "rls"])
@pytest.mark.parametrize("weights", [(0.5, 2.0), (3.0, 9.0), (np.nan, 2.0), (1e300, 2.0)], ids=str)
def test_weights_that_the_compensator_refuses_are_refused_here_too(
    law: str, weights: tuple[float, float]
) -> None:
    with pytest.raises(core.CoreError, match="W1 and W2"):
        estimator(law, *weights, gain=0.01)


def test_on_a_rig_that_states_no_noise_the_first_nanometres_do_not_move_the_estimate() -> None:
    """Within three standard deviations of the prior, 1 sample and a quarter of the delay."""
    path = Path(__file__).resolve().parents[1] / "examples" / "ten-storeys.toml"
    rec = rt.run(rt.Test(path))
    alpha = rec["alpha"][rec.running]
    assert rec.rig["sensors.displacement.noise_std_m"] == 0.0
    assert np.abs(alpha - 10.0).max() < 3.0 * (1.0 + 0.25 * 10.0)
    assert np.ptp(alpha) > 0.1
