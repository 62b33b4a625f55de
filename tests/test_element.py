"""The catalogue of specimen elements: against closed forms and scipy.integrate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from kernels import Floats, H, smooth_motion, time_s

from rthyb_rt import core

K = 4737410.0
SECTION_4_2 = {"k_n_per_m": K, "post_yield_ratio": 0.02, "a": 1.0, "b": 300.0, "c": 200.0}
LUGRE = {
    "fc_n": 80.0,
    "fs_n": 120.0,
    "vs_m_per_s": 2e-3,
    "sigma0_n_per_m": 4e5,
    "sigma1_n_s_per_m": 500.0,
    "sigma2_n_s_per_m": 60.0,
}
ONE_OF_EACH = {
    "stiffness": {"k_n_per_m": 1e5},
    "viscous": {"c_n_s_per_m": 600.0},
    "coulomb": {"fc_n": 80.0, "width_m_per_s": 5e-4},
    "stribeck": {"fc_n": 80.0, "fs_n": 120.0, "vs_m_per_s": 2e-3, "width_m_per_s": 5e-4},
    "lugre": LUGRE,
    "quad_damping": {"c2_n_s2_per_m2": 900.0},
    "inertia": {"m_kg": 45.0},
    "gap": {"k_n_per_m": 1e6, "gap_m": 1e-3},
    "cubic": {"k3_n_per_m3": 1e10},
    "quadratic": {"k2_n_per_m2": 1e7},
    "stopper": {"ks_n_per_m": 1e7, "xs_m": 8e-3},
    "hysteresis": SECTION_4_2 | {"eta": 1.5},
    "pinching": SECTION_4_2 | {"eta": 1.5, "depth": 0.7, "width_ratio": 0.3},
    "degradation": SECTION_4_2 | {"eta": 1.5, "loss": 0.4, "travel_m": 0.5},
    "maxwell": {"km_n_per_m": 2e5, "tau_s": 0.05},
    "second_mode": {"m2_kg": 20.0, "f2_hz": 12.0, "zeta2": 0.02},
    "p_delta": {"gravity_load_n": 5e4, "height_m": 0.63},
    "gap_friction": {
        "k_n_per_m": 7e6, "gap_m": 2.7e-3, "fc_up_n": 14e3, "fc_down_n": 18e3, "seat_m": 1e-3,
    },
    "coulomb_uneven": {"fc_up_n": 80.0, "fc_down_n": 120.0, "width_m_per_s": 5e-4},
    "gap_uneven": {
        "k_up_n_per_m": 1e6, "gap_up_m": 1e-3, "k_down_n_per_m": 4e5, "gap_down_m": 4e-3,
    },
    "power_damping": {
        "force_n": 900.0, "at_m_per_s": 0.2, "exponent": 0.35, "width_m_per_s": 1e-4,
    },
    "rocking": {"k_n_per_m": 1e6, "uplift_m": 4e-3, "post_uplift_ratio": -0.1},
    "power_spring": {"force_n": 3e3, "at_m": 5e-3, "exponent": 1.7, "width_m": 1e-6},
    "pendulum": {"weight_n": 4e4, "length_m": 0.05},
    "friction_pendulum": {
        "weight_n": 4e4, "radius_m": 1.5, "mu_slow": 0.03, "mu_fast": 0.07,
        "mu_rate_s_per_m": 30.0, "xy_m": 5e-4,
    },
    "iwan": {"k_n_per_m": 1e6, "post_yield_ratio": 0.05, "xy_m": 4e-3, "spread": 0.8},
    "menegotto_pinto": {
        "k_n_per_m": 1e6, "post_yield_ratio": 0.03, "xy_m": 4e-3, "r0": 20.0, "cr1": 0.925,
        "cr2": 0.15,
    },
    "chaboche": {
        "k_n_per_m": 1e6, "fy_n": 3e3, "kinematic_n_per_m": 3e5, "recovery_per_m": 150.0,
        "isotropic_n": 1500.0, "isotropic_rate_per_m": 12.0,
    },
    "rc_column": {
        "k_n_per_m": 1e6, "post_yield_ratio": 0.04, "xy_m": 5e-3, "eta": 2.0, "pivot": 4.0,
        "ultimate_m": 0.05, "strength_lost_at_ultimate": 0.3, "energy_j": 800.0,
        "strength_lost_with_energy": 0.2, "stiffness_lost_with_energy": 0.3, "slip": 0.2,
        "slip_level": 0.3, "slip_width": 0.2,
    },
    "peak_oriented": {
        "k_up_n_per_m": 1e6, "k_down_n_per_m": 8e5, "reach_m": 0.02, "exponent": 2.2,
        "backbone": 0.6, "start_m": 2e-4,
    },
    "takeda": {
        "k_n_per_m": 1e6, "post_yield_ratio": 0.05, "xy_m": 5e-3, "sharpness": 8.0,
        "unloading_exponent": 0.4, "pinching": 0.6, "pinching_level": 0.3, "energy_j": 2e3,
        "strength_down_over_up": 0.8, "corner_on_line": 0.7,
    },
    "nonlinear_maxwell": {
        "km_n_per_m": 4e5, "force_n": 900.0, "at_m_per_s": 0.2, "exponent": 0.35,
    },
}  # fmt: skip


def make(kind: str) -> core.CoreElement:
    return core.CoreElement(core.element(kind, **ONE_OF_EACH[kind]))


def derivatives(x: Floats) -> tuple[Floats, Floats]:
    v = np.gradient(x, H)
    return v, np.gradient(v, H)


def run(kind: str, x: Floats, **params: float) -> Floats:
    v, a = derivatives(x)
    return core.CoreElement(core.element(kind, **(params or ONE_OF_EACH[kind]))).run(x, v, a)


# --- laws without memory -------------------------------------------------------------------------

FORMULA: dict[str, Callable[[Floats, Floats, Floats], Floats]] = {
    "stiffness": lambda x, v, a: 1e5 * x,
    "viscous": lambda x, v, a: 600.0 * v,
    "coulomb": lambda x, v, a: 80.0 * np.tanh(v / 5e-4),
    "stribeck": lambda x, v, a: (80.0 + 40.0 * np.exp(-((v / 2e-3) ** 2))) * np.tanh(v / 5e-4),
    "quad_damping": lambda x, v, a: 900.0 * v * np.abs(v),
    "inertia": lambda x, v, a: 45.0 * a,
    "gap": lambda x, v, a: 1e6 * (x - np.clip(x, -1e-3, 1e-3)),
    "cubic": lambda x, v, a: 1e10 * x**3,
    "quadratic": lambda x, v, a: 1e7 * x**2,
    "stopper": lambda x, v, a: 1e7 * np.sign(x) * np.maximum(np.abs(x) - 8e-3, 0.0),
    "p_delta": lambda x, v, a: -5e4 / 0.63 * x,
    "coulomb_uneven": lambda x, v, a: np.where(v > 0, 80.0, 120.0) * np.tanh(v / 5e-4),
    "gap_uneven": lambda x, v, a: 1e6 * np.maximum(x - 1e-3, 0.0) + 4e5 * np.minimum(x + 4e-3, 0.0),
    "power_damping": lambda x, v, a: 4500.0 * v * ((v / 0.2) ** 2 + 2.5e-7) ** -0.325,
    "rocking": lambda x, v, a: 1e6 * np.clip(x, -4e-3, 4e-3) - 1e5 * (x - np.clip(x, -4e-3, 4e-3)),
    "power_spring": lambda x, v, a: 6e5 * x * ((x / 5e-3) ** 2 + 4e-8) ** 0.35,
    "pendulum": lambda x, v, a: 4e4 * np.sin(x / 0.05),
}


@pytest.mark.parametrize("kind", FORMULA)
def test_law_without_memory_is_its_formula(kind: str) -> None:
    x = smooth_motion(3.0, 1, peak_m=0.02)
    v, a = derivatives(x)
    expected = FORMULA[kind](x, v, a)
    np.testing.assert_allclose(
        run(kind, x), expected, rtol=1e-12, atol=1e-12 * np.max(np.abs(expected))
    )


@pytest.mark.parametrize("exponent", [0.5, 0.7, 1.0, 2.0, 2.5])
def test_a_peak_of_friction_has_the_exponent_of_the_rig_file(exponent: float) -> None:
    x = smooth_motion(3.0, 1, peak_m=0.02)
    v, _ = derivatives(x)
    peak = np.exp(-(np.abs(v / 2e-3) ** exponent))
    expected = (80.0 + 40.0 * peak) * np.tanh(v / 5e-4)
    found = run("stribeck", x, **ONE_OF_EACH["stribeck"], exponent=exponent)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("exponent", [0.04, 11.0])
def test_a_peak_of_friction_with_an_exponent_beyond_those_of_a_file_is_refused(
    exponent: float,
) -> None:
    with pytest.raises(core.CoreError):
        core.CoreElement(core.element("stribeck", **ONE_OF_EACH["stribeck"], exponent=exponent))


@pytest.mark.parametrize("kind", ["stopper", "gap_uneven"])
def test_a_stop_that_loses_energy_pushes_harder_inwards_and_never_pulls(kind: str) -> None:
    x = smooth_motion(3.0, 1, peak_m=0.02)
    v, a = derivatives(x)
    elastic = FORMULA[kind](x, v, a)
    loss = 2.0 / np.max(np.abs(v))
    expected = elastic * np.maximum(1.0 + loss * v * np.sign(x), 0.0)
    assert np.any((expected == 0.0) & (elastic != 0.0)), "nowhere fast enough to let go"
    found = run(kind, x, **ONE_OF_EACH[kind], loss_s_per_m=loss)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-6)
    assert np.sum(found * v) > 0.0  # energy is taken up


def test_friction_far_from_zero_velocity_is_the_coulomb_level_with_its_sign() -> None:
    friction = make("coulomb")
    assert friction.force(0.0, 1.0, 0.0, H) == 80.0
    assert friction.force(0.0, -1.0, 0.0, H) == -80.0
    assert friction.force(0.0, 0.0, 0.0, H) == 0.0


# --- Bouc-Wen, Eqn 4.1-4.2 -----------------------------------------------------------------------


def bouc_wen_by_scipy(
    motion: Callable[[float], tuple[float, float]],
    t: Floats,
    eta: float,
    shape: Callable[[float], float] = lambda z: 1.0,
) -> Floats:
    """z of Eqn 4.2 as it is printed, B, C and A of Section 4.2."""

    def slope(time: float, y: Floats) -> list[float]:
        v, z = motion(time)[1], y[0]
        rate = v - 300.0 * abs(v) * abs(z) ** (eta - 1.0) * z - 200.0 * v * abs(z) ** eta
        return [rate * shape(z)]

    solution = scipy.integrate.solve_ivp(
        slope, (0.0, t[-1]), [0.0], "DOP853", t_eval=t, rtol=1e-9, atol=1e-12, max_step=0.01
    )
    return np.asarray(solution.y[0])


def two_sines(time: float) -> tuple[float, float]:
    """Displacement and velocity of a motion that runs well past yield."""
    a, b = 2.0 * np.pi * 1.1, 2.0 * np.pi * 2.7
    x = 0.02 * np.sin(a * time) + 0.012 * np.sin(b * time)
    return x, 0.02 * a * np.cos(a * time) + 0.012 * b * np.cos(b * time)


@pytest.mark.parametrize("eta", [1.0, 1.5, 2.0, 3.3])
def test_hysteresis_is_eqn_4_1_and_4_2_by_scipy(eta: float) -> None:
    t = time_s(3.0)
    x = np.array([two_sines(time)[0] for time in t])
    expected = 0.02 * K * x + 0.98 * K * bouc_wen_by_scipy(two_sines, t, eta)
    found = core.CoreElement(core.element("hysteresis", **SECTION_4_2, eta=eta)).run(x)
    assert np.max(np.abs(found - expected)) < 1e-3 * np.max(np.abs(expected))


def test_pinching_slackens_the_loop_near_zero_as_by_scipy() -> None:
    t = time_s(3.0)
    x = np.array([two_sines(time)[0] for time in t])
    ultimate = (1.0 / 500.0) ** (1.0 / 1.5)
    z = bouc_wen_by_scipy(
        two_sines, t, 1.5, lambda z: 1.0 - 0.7 * np.exp(-((z / (0.3 * ultimate)) ** 2))
    )
    expected = 0.02 * K * x + 0.98 * K * z
    assert np.max(np.abs(run("pinching", x) - expected)) < 2e-3 * np.max(np.abs(expected))


def test_degradation_takes_strength_away_with_the_distance_travelled() -> None:
    t = time_s(3.0)
    x = np.array([two_sines(time)[0] for time in t])
    z = bouc_wen_by_scipy(two_sines, t, 1.5)
    travel = np.cumsum(np.abs(np.diff(x, prepend=0.0)))
    strength = 1.0 - 0.4 * (1.0 - np.exp(-travel / 0.5))
    expected = 0.02 * K * x + 0.98 * K * strength * z
    found = run("degradation", x)
    assert np.max(np.abs(found - expected)) < 1e-3 * np.max(np.abs(expected))
    assert strength[-1] < 0.8


ELASTIC = {
    "k_n_per_m": K, "post_yield_ratio": 0.0, "a": 1.0, "b": 1e-15, "c": 0.0, "eta": 1.0,
    "loss": 0.4,
}  # fmt: skip
"""A loop that does not yield within the displacements of a test."""


@pytest.mark.parametrize("cycles", [1, 5])
@pytest.mark.parametrize(
    "of",
    [
        {"travel_m": 0.3},
        {"travel_m": 0.0, "work_j": 2000.0},
        {"travel_m": 0.0, "amplitude_m": 0.02},
        {"travel_m": 0.3, "work_j": 2000.0, "amplitude_m": 0.02},
    ],
)
def test_cycles_of_one_amplitude_wear_a_loop_by_travel_work_and_amplitude(
    of: dict[str, float], cycles: int
) -> None:
    amplitude = 0.01
    turns = np.arange(500 * cycles + 26) / 500.0  # ends on the way up, beyond the last full cycle
    x = amplitude * np.sin(2 * np.pi * turns)
    element = core.CoreElement(core.element("degradation", **ELASTIC, **of))
    force = element.run(x)
    full = 500 * cycles
    travel, work = 4 * amplitude * cycles, 4 * cycles * K * amplitude**2 / 2
    measures = {"travel_m": travel + x[-1], "work_j": work + K * x[-1] ** 2 / 2}
    worn = sum(measures.get(key, amplitude) / scale for key, scale in of.items() if scale)
    assert abs(force[full]) < 1e-9 * K * amplitude  # unloaded: what is lost is strength, not work
    assert force[-1] == pytest.approx(K * x[-1] * (1 - 0.4 * (1 - np.exp(-worn))), rel=1e-9)
    found = [float(value) for value in element.state()[2:5]]
    assert found == pytest.approx([measures["travel_m"], measures["work_j"], amplitude], rel=1e-9)


def test_a_loop_that_yields_loses_strength_with_the_work_it_has_done() -> None:
    t = time_s(3.0)
    x = np.array([two_sines(time)[0] for time in t])
    z = bouc_wen_by_scipy(two_sines, t, 1.5)
    work = np.abs(z) * np.abs(np.gradient(x, t))  # of the loop that is not worn
    work = K * scipy.integrate.cumulative_trapezoid(work, t, initial=0.0)
    largest = np.maximum.accumulate(np.abs(x))
    strength = 1.0 - 0.4 * (1.0 - np.exp(-work / 4e4 - largest / 0.1))
    shape = SECTION_4_2 | {"eta": 1.5, "loss": 0.4, "travel_m": 0.0}
    found = run("degradation", x, **shape, work_j=4e4, amplitude_m=0.1)
    expected = 0.02 * K * x + 0.98 * K * strength * z
    assert np.max(np.abs(found - expected)) < 1e-3 * np.max(np.abs(expected))
    assert strength[-1] < 0.8


def test_the_work_of_a_loop_does_not_depend_on_the_samples_of_the_motion() -> None:
    shape = SECTION_4_2 | {"eta": 1.5, "loss": 0.4, "travel_m": 0.0, "work_j": 2e4}
    corners = np.array([0.0, 0.03, -0.03, 0.02, 0.0])
    coarse, fine = (core.CoreElement(core.element("degradation", **shape)) for _ in range(2))
    coarse.run(corners)
    fine.run(np.interp(np.arange(0.0, 4.0, 1e-3), np.arange(5), corners))
    assert coarse.state()[3] == pytest.approx(fine.state()[3], rel=5e-3)


def test_degradation_with_travel_alone_is_what_it_was() -> None:
    x = smooth_motion(3.0, 1, peak_m=0.02)
    plain = SECTION_4_2 | {"eta": 1.5, "post_yield_ratio": 0.0}
    loop = core.CoreElement(core.element("hysteresis", **plain)).run(x)
    travel = np.cumsum(np.abs(np.diff(x, prepend=0.0)))
    worn = core.CoreElement(core.element("degradation", **plain, loss=0.4, travel_m=0.5)).run(x)
    np.testing.assert_allclose(worn, loop * (1.0 + 0.4 * np.expm1(-travel / 0.5)), rtol=1e-13)


def test_travel_and_work_of_a_wild_motion_end_at_their_ceilings() -> None:
    shape = ELASTIC | {"k_n_per_m": 1e15, "loss": 1.0, "travel_m": 0.0, "work_j": 1.0}
    element = core.CoreElement(core.element("degradation", **shape))
    for x in [999.0, np.nan, np.inf, 1e300, -999.0, -np.inf] * 2000:
        assert np.isfinite(element.force(x, 0.0, 0.0, H))
    assert list(element.state()[2:5]) == [1e6, 1e15, 999.0]


@pytest.mark.parametrize(
    "of",
    [
        {"travel_m": 0.0},
        {"travel_m": 0.0, "work_j": 0.0, "amplitude_m": 0.0},
        {"travel_m": 0.5, "work_j": 1e-300},
        {"travel_m": 0.5, "amplitude_m": 1e-300},
        {"travel_m": 1e-300, "work_j": 1.0},
    ],
)
def test_degradation_with_nothing_or_over_next_to_nothing_is_refused(of: dict[str, float]) -> None:
    with pytest.raises(core.CoreError):
        core.CoreElement(core.element("degradation", **SECTION_4_2, eta=1.5, loss=0.4, **of))


def test_first_loading_with_eta_1_is_an_exponential_and_unloading_another() -> None:
    u = np.linspace(0.0, 0.02, 2001)
    plastic = SECTION_4_2 | {"post_yield_ratio": 0.0, "eta": 1.0}
    element = core.CoreElement(core.element("hysteresis", **plastic))
    loading = element.run(u)
    np.testing.assert_allclose(loading, K / 500.0 * -np.expm1(-500.0 * u), rtol=1e-5, atol=1e-2)
    back = u[::-1][1:180]  # while z > 0, du < 0: dz/du = A + (B - C) z
    z0 = loading[-1] / K
    expected = K * ((z0 + 0.01) * np.exp(100.0 * (back - u[-1])) - 0.01)
    np.testing.assert_allclose(element.run(back), expected, rtol=0, atol=1e-5 * K * 0.002)


def test_first_loading_with_eta_2_is_a_hyperbolic_tangent() -> None:
    u = np.linspace(0.0, 0.1, 1001)
    plastic = SECTION_4_2 | {"post_yield_ratio": 0.0, "eta": 2.0}
    found = core.CoreElement(core.element("hysteresis", **plastic)).run(u)
    ultimate = np.sqrt(1.0 / 500.0)
    np.testing.assert_allclose(found, K * ultimate * np.tanh(u / ultimate), rtol=2e-6, atol=1e-6)


@pytest.mark.parametrize("kind", ["hysteresis", "pinching", "degradation"])
def test_loop_does_not_depend_on_the_rate(kind: str) -> None:
    x = smooth_motion(2.0, 2, peak_m=0.03)
    slow, fast = make(kind).run(x, dt_s=0.5), make(kind).run(x, 5.0, 100.0, dt_s=1e-4)
    np.testing.assert_array_equal(slow, fast)
    dense = np.interp(np.arange(0.0, x.size - 1, 0.125), np.arange(x.size), x)
    finely = make(kind).run(dense)[::8]
    assert np.max(np.abs(finely - slow[: finely.size])) < 1e-3 * np.max(np.abs(slow))


@pytest.mark.parametrize("kind", ["hysteresis", "pinching", "degradation"])
def test_closed_loop_dissipates_and_never_passes_the_ultimate_strength(kind: str) -> None:
    x = 0.04 * np.sin(2 * np.pi * np.linspace(0.0, 3.0, 6001))
    f = run(kind, x)
    hysteretic = f - 0.02 * K * x
    ultimate = 0.98 * K * (1.0 / 500.0) ** (1.0 / 1.5)
    assert np.max(np.abs(hysteretic)) <= ultimate * (1.0 + 1e-12)
    cycle = slice(4000, 6001)
    assert scipy.integrate.trapezoid(f[cycle], x[cycle]) > 0.5 * ultimate * 0.04


def test_small_steps_start_at_the_elastic_stiffness() -> None:
    assert make("hysteresis").force(1e-9, 0.0, 0.0, H) == pytest.approx(K * 1e-9, rel=1e-6)


def test_one_jump_across_the_whole_loop_lands_where_many_small_steps_land() -> None:
    jump, walk = make("hysteresis"), make("hysteresis")
    walk.run(np.linspace(0.0, 0.04, 4000))
    jump.force(0.04, 0.0, 0.0, H)
    assert jump.state()[1] == pytest.approx(walk.state()[1], rel=1e-3)
    assert jump.force(-0.04, 0.0, 0.0, H) == pytest.approx(
        walk.run(np.linspace(0.04, -0.04, 8000))[-1], rel=1e-3
    )


# --- LuGre, Maxwell, second mode -----------------------------------------------------------------


def test_lugre_at_constant_velocity_builds_up_by_the_closed_form() -> None:
    friction = make("lugre")
    v = 1.5e-3
    level = 80.0 + 40.0 * np.exp(-((v / 2e-3) ** 2))
    rate = 4e5 * v / level
    t = (1.0 + np.arange(4000)) * H
    z = level / 4e5 * -np.expm1(-rate * t)
    expected = 4e5 * z + 500.0 * (v - rate * z) + 60.0 * v
    found = friction.run(v * t, v)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert found[-1] == pytest.approx(level + 60.0 * v, rel=1e-3)


def test_friction_behind_a_gap_converges_to_a_slider_that_creeps() -> None:
    """The slider's place by an equation of its own, the seat as springs whose gaps differ."""
    k, gap, up, down, seat = ONE_OF_EACH["gap_friction"].values()
    x = smooth_motion(3.0, 4, peak_m=0.02)
    gaps = gap + seat * (2.0 * (np.arange(400) + 0.5) / 400 - 1.0)
    bent = np.linspace(0.0, 0.008, 4001)
    held = k * np.mean(np.maximum(bent[:, None] - gaps, 0.0), axis=1)
    # Sides slip where their springs together hold no more.
    ahead, behind = (np.interp(level, held, bent) for level in (up, down))
    place, force = 0.0, np.empty_like(x)
    creep = 0.5
    for i, now in enumerate(x):
        for _ in range(40):
            way = now - place
            place += creep * (max(way - ahead, 0.0) + min(way + behind, 0.0))
        way = now - place
        force[i] = np.sign(way) * np.interp(abs(way), bent, held)
    found = run("gap_friction", x)
    assert found.max() == pytest.approx(up, rel=1e-9)
    assert found.min() == pytest.approx(-down, rel=1e-9)
    np.testing.assert_allclose(found, force, atol=2e-3 * down)


def test_friction_behind_a_gap_is_nothing_in_the_gap_and_elastic_before_it_slips() -> None:
    k, gap, up, down, seat = ONE_OF_EACH["gap_friction"].values()
    out = np.linspace(0.0, 0.03, 3001)
    back = 0.03 - np.linspace(0.0, 0.03, 3001)
    force = run("gap_friction", np.concatenate((out, back)))[3001:]
    way = up / k + gap - (0.03 - back)
    clear = np.abs(way) < gap - seat
    assert np.all(force[clear] == 0.0)
    sprung = way > gap + seat
    np.testing.assert_allclose(force[sprung], k * (way - gap)[sprung], rtol=1e-9)
    assert force[-1] == pytest.approx(-down)


def test_lugre_in_motion_converges_to_scipy() -> None:
    def velocity(time: float) -> float:
        return float(0.004 * np.sin(7.0 * time) + 0.002 * np.sin(19.0 * time))

    def slope(time: float, y: Floats) -> list[float]:
        v = velocity(time)
        level = 80.0 + 40.0 * np.exp(-((v / 2e-3) ** 2))
        return [v - 4e5 * abs(v) / level * y[0]]

    t = np.arange(0.0, 2.0, H)
    z = scipy.integrate.solve_ivp(
        slope, (0.0, 2.0), [0.0], "LSODA", t_eval=t, rtol=1e-8, atol=1e-12, max_step=0.005
    ).y[0]
    v = np.array([velocity(time) for time in t])
    z_rate = np.array([slope(time, np.array([y]))[0] for time, y in zip(t, z, strict=True)])
    expected = 4e5 * z + 500.0 * z_rate + 60.0 * v
    errors = []
    for factor in (1, 4, 16):
        fine = np.arange(t.size * factor) * H / factor
        v_fine = 0.004 * np.sin(7.0 * fine) + 0.002 * np.sin(19.0 * fine)
        found = make("lugre").run(np.zeros_like(fine), v_fine, dt_s=H / factor)[::factor]
        errors.append(np.max(np.abs(found - expected)) / 120.0)
    assert errors[0] < 0.15
    assert errors[1] < 0.4 * errors[0]
    assert errors[2] < 0.4 * errors[1]


def test_maxwell_under_a_ramp_follows_the_closed_form_and_then_relaxes() -> None:
    t = H * (1.0 + np.arange(300))
    element = make("maxwell")
    ramp = element.run(0.02 * t)
    np.testing.assert_allclose(ramp, 2e5 * 0.05 * 0.02 * -np.expm1(-t / 0.05), rtol=1e-12)
    held = element.run(np.full(300, 0.02 * t[-1]))
    np.testing.assert_allclose(held, ramp[-1] * np.exp(-t / 0.05), rtol=1e-12)


def test_maxwell_in_motion_is_the_linear_system_of_scipy() -> None:
    x = smooth_motion(3.0, 3)
    system = scipy.signal.lti([2e5 * 0.05, 0.0], [0.05, 1.0])
    _, expected, _ = scipy.signal.lsim(system, x, time_s(3.0))
    np.testing.assert_allclose(run("maxwell", x), expected, rtol=0, atol=1e-9 * 2e5 * 0.01)


def test_second_mode_is_a_mass_on_a_spring_by_scipy() -> None:
    # From the specimen's acceleration to m2 times the absolute acceleration of the second mass.
    def acceleration(t: Floats) -> Floats:
        return 3.0 * np.sin(2 * np.pi * 3.0 * t) * (1.0 - np.exp(-((t / 0.3) ** 3)))

    w, zeta, m2 = 2 * np.pi * 12.0, 0.02, 20.0
    system = scipy.signal.lti([m2 * 2 * zeta * w, m2 * w**2], [1.0, 2 * zeta * w, w**2])
    dense = np.arange(4096 * 32) * H / 32
    expected = scipy.signal.lsim(system, acceleration(dense), dense)[1][::32]
    errors = []
    for factor in (1, 4):
        a = acceleration(np.arange(4096 * factor) * H / factor)
        found = make("second_mode").run(np.zeros_like(a), 0.0, a, dt_s=H / factor)[::factor]
        errors.append(np.max(np.abs(found - expected)) / np.max(np.abs(expected)))
    assert errors[0] < 5e-3
    assert errors[1] < 0.1 * errors[0]


def test_second_mode_rides_along_as_plain_mass_when_the_motion_is_slow() -> None:
    t = time_s(20.0)
    a = 0.5 * np.sin(2 * np.pi * 0.2 * t)
    found = make("second_mode").run(np.zeros_like(a), 0.0, a)
    steady = slice(15 * 1024, None)
    assert np.max(np.abs(found[steady] - 20.0 * a[steady])) < 0.03 * 20.0 * 0.5


# --- every element -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", core.ELEMENT_PARAMS)
def test_element_that_moves_not_at_all_gives_no_force(kind: str) -> None:
    element = make(kind)
    for _ in range(2000):
        assert element.force(0.0, 0.0, 0.0, H) == 0.0
    assert all(value == 0.0 for value in element.state())


@pytest.mark.parametrize("kind", core.ELEMENT_PARAMS)
def test_wild_motion_leaves_force_and_history_finite(kind: str) -> None:
    rng = np.random.default_rng(4)
    element = make(kind)
    sizes = 10.0 ** rng.uniform(-320.0, 300.0, (3, 4000)) * rng.choice([-1.0, 0.0, 1.0], (3, 4000))
    assert np.all(np.isfinite(element.run(*sizes)))
    assert np.all(np.isfinite(element.state()))


@pytest.mark.parametrize("kind", core.ELEMENT_PARAMS)
@pytest.mark.parametrize("dt_s", [0.0, -1.0, np.nan, np.inf, 5e-324])
def test_time_step_without_sense_counts_as_no_time(kind: str, dt_s: float) -> None:
    element = make(kind)
    for x in (0.0, 0.003, -0.002):
        assert np.isfinite(element.force(x, 0.01, 1.0, dt_s))
    assert np.all(np.isfinite(element.state()))


# --- refusals ------------------------------------------------------------------------------------

MUST_BE_POSITIVE = [
    ("coulomb", "width_m_per_s"),
    ("stribeck", "vs_m_per_s"),
    ("stribeck", "width_m_per_s"),
    ("stribeck", "exponent"),
    ("lugre", "fc_n"),
    ("lugre", "fs_n"),
    ("lugre", "vs_m_per_s"),
    ("lugre", "sigma0_n_per_m"),
    ("hysteresis", "k_n_per_m"),
    ("hysteresis", "a"),
    ("hysteresis", "eta"),
    ("pinching", "width_ratio"),
    ("degradation", "travel_m"),
    ("maxwell", "tau_s"),
    ("second_mode", "f2_hz"),
    ("p_delta", "height_m"),
    ("gap_friction", "k_n_per_m"),
    ("coulomb_uneven", "width_m_per_s"),
    ("power_damping", "at_m_per_s"),
    ("power_damping", "exponent"),
    ("power_damping", "width_m_per_s"),
    ("rocking", "k_n_per_m"),
    ("rocking", "uplift_m"),
    ("power_spring", "at_m"),
    ("power_spring", "width_m"),
    ("pendulum", "length_m"),
    ("friction_pendulum", "weight_n"),
    ("friction_pendulum", "radius_m"),
    ("friction_pendulum", "xy_m"),
    ("iwan", "xy_m"),
    ("menegotto_pinto", "xy_m"),
    ("menegotto_pinto", "r0"),
    ("menegotto_pinto", "cr2"),
    ("chaboche", "k_n_per_m"),
    ("chaboche", "fy_n"),
    ("rc_column", "xy_m"),
    ("rc_column", "energy_j"),
    ("rc_column", "slip_width"),
    ("peak_oriented", "reach_m"),
    ("peak_oriented", "start_m"),
    ("peak_oriented", "exponent"),
    ("takeda", "k_n_per_m"),
    ("takeda", "xy_m"),
    ("takeda", "sharpness"),
    ("takeda", "energy_j"),
    ("takeda", "strength_down_over_up"),
    ("nonlinear_maxwell", "km_n_per_m"),
    ("nonlinear_maxwell", "force_n"),
    ("nonlinear_maxwell", "at_m_per_s"),
    ("nonlinear_maxwell", "exponent"),
]
NOT_NEGATIVE = [
    ("coulomb", "fc_n"),
    ("stribeck", "fs_n"),
    ("lugre", "sigma1_n_s_per_m"),
    ("inertia", "m_kg"),
    ("gap", "k_n_per_m"),
    ("gap", "gap_m"),
    ("stopper", "xs_m"),
    ("stopper", "loss_s_per_m"),
    ("gap_uneven", "loss_s_per_m"),
    ("hysteresis", "post_yield_ratio"),
    ("pinching", "depth"),
    ("degradation", "loss"),
    ("degradation", "work_j"),
    ("degradation", "amplitude_m"),
    ("maxwell", "km_n_per_m"),
    ("second_mode", "m2_kg"),
    ("second_mode", "zeta2"),
    ("p_delta", "gravity_load_n"),
    ("gap_friction", "gap_m"),
    ("gap_friction", "fc_up_n"),
    ("gap_friction", "seat_m"),
    ("coulomb_uneven", "fc_up_n"),
    ("gap_uneven", "k_down_n_per_m"),
    ("gap_uneven", "gap_up_m"),
    ("friction_pendulum", "mu_slow"),
    ("friction_pendulum", "mu_rate_s_per_m"),
    ("iwan", "post_yield_ratio"),
    ("iwan", "spread"),
    ("menegotto_pinto", "post_yield_ratio"),
    ("menegotto_pinto", "cr1"),
    ("chaboche", "kinematic_n_per_m"),
    ("chaboche", "recovery_per_m"),
    ("chaboche", "isotropic_n"),
    ("chaboche", "isotropic_rate_per_m"),
    ("rc_column", "pivot"),
    ("rc_column", "strength_lost_at_ultimate"),
    ("rc_column", "slip"),
    ("peak_oriented", "k_up_n_per_m"),
    ("peak_oriented", "k_down_n_per_m"),
    ("peak_oriented", "backbone"),
    ("takeda", "unloading_exponent"),
    ("takeda", "pinching"),
    ("takeda", "pinching_level"),
    ("takeda", "corner_on_line"),
]
NOT_ABOVE = [
    ("power_damping", "exponent", 11.0),
    ("power_spring", "exponent", 11.0),
    ("rocking", "post_uplift_ratio", 1.0),
    ("rocking", "post_uplift_ratio", -1.0),
    ("iwan", "post_yield_ratio", 1.1),
    ("iwan", "spread", 1.1),
    ("menegotto_pinto", "post_yield_ratio", 1.0),
    ("menegotto_pinto", "r0", 60.0),
    ("menegotto_pinto", "cr1", 1.0),
    ("rc_column", "post_yield_ratio", 1.1),
    ("rc_column", "eta", 60.0),
    ("rc_column", "xy_m", 0.05),
    ("rc_column", "strength_lost_at_ultimate", 1.0),
    ("rc_column", "strength_lost_with_energy", 1.0),
    ("rc_column", "stiffness_lost_with_energy", 1.0),
    ("rc_column", "slip", 0.6),
    ("rc_column", "slip_level", -1.1),
    ("rc_column", "slip_width", 11.0),
    ("peak_oriented", "exponent", 11.0),
    ("peak_oriented", "start_m", 0.02),
    ("peak_oriented", "exponent", 0.9),
    ("peak_oriented", "backbone", 1.1),
    ("takeda", "post_yield_ratio", 1.0),
    ("takeda", "post_yield_ratio", -1.0),
    ("takeda", "sharpness", 0.9),
    ("takeda", "sharpness", 1001.0),
    ("takeda", "unloading_exponent", 1.1),
    ("takeda", "pinching", 1.1),
    ("takeda", "pinching_level", 1.0),
    ("takeda", "corner_on_line", 1.1),
    ("nonlinear_maxwell", "exponent", 11.0),
    ("nonlinear_maxwell", "exponent", 0.04),
]


@pytest.mark.parametrize(("kind", "name"), MUST_BE_POSITIVE)
def test_parameter_that_divides_must_be_positive(kind: str, name: str) -> None:
    for value in (0.0, -1.0):
        with pytest.raises(core.CoreError):
            core.CoreElement(core.element(kind, **(ONE_OF_EACH[kind] | {name: value})))


@pytest.mark.parametrize(("kind", "name"), NOT_NEGATIVE)
def test_parameter_that_cannot_be_negative_is_refused(kind: str, name: str) -> None:
    core.CoreElement(core.element(kind, **(ONE_OF_EACH[kind] | {name: 0.0})))
    with pytest.raises(core.CoreError):
        core.CoreElement(core.element(kind, **(ONE_OF_EACH[kind] | {name: -1.0})))


@pytest.mark.parametrize(("kind", "name", "value"), NOT_ABOVE)
def test_shape_that_the_law_cannot_have_is_refused(kind: str, name: str, value: float) -> None:
    with pytest.raises(core.CoreError):
        core.CoreElement(core.element(kind, **(ONE_OF_EACH[kind] | {name: value})))


@pytest.mark.parametrize("kind", core.ELEMENT_PARAMS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_no_parameter_may_be_without_end_or_sense(kind: str, value: float) -> None:
    for name in core.ELEMENT_PARAMS[kind]:
        with pytest.raises(core.CoreError):
            core.CoreElement(core.element(kind, **(ONE_OF_EACH[kind] | {name: value})))


def test_hysteresis_that_never_yields_or_is_too_sharp_is_refused_or_bounded() -> None:
    for eta in (0.05, 150.0):
        with pytest.raises(core.CoreError):
            core.CoreElement(core.element("hysteresis", **SECTION_4_2, eta=eta))
    endless = core.CoreElement(core.element("hysteresis", **(SECTION_4_2 | {"b": -200.0}), eta=1.5))
    assert np.all(np.isfinite(endless.run(np.linspace(0.0, 900.0, 5000))))


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("lugre", {"fc_n": 1e-300, "fs_n": 1e-300}),
        ("p_delta", {"height_m": 1e-300}),
        ("hysteresis", {"b": 1e15, "c": -1e15, "eta": 100.0}),
        ("degradation", {"k_n_per_m": 1e15, "work_j": 1e-15, "amplitude_m": 1e-15}),
        ("degradation", {"k_n_per_m": 1e15, "b": 0.0, "c": 0.0, "travel_m": 0.0, "work_j": 1e15}),
        ("power_damping", {"force_n": 1e15, "at_m_per_s": 1e-15, "exponent": 10.0}),
        ("power_damping", {"width_m_per_s": 1e-15, "at_m_per_s": 1e15, "exponent": 0.05}),
        ("power_spring", {"force_n": -1e15, "at_m": 1e-15, "exponent": 10.0}),
        ("pendulum", {"weight_n": 1e15, "length_m": 1e-15}),
        ("rocking", {"k_n_per_m": 1e15, "uplift_m": 1e-15}),
        ("friction_pendulum", {"weight_n": 1e15, "radius_m": 1e-15, "xy_m": 1e-15}),
        ("friction_pendulum", {"mu_slow": 1e15, "mu_fast": 0.0, "mu_rate_s_per_m": 1e15}),
        ("iwan", {"k_n_per_m": 1e15, "xy_m": 1e15}),
        ("iwan", {"xy_m": 1e-15}),
        ("menegotto_pinto", {"k_n_per_m": 1e15, "xy_m": 1e-15, "r0": 50.0}),
        ("menegotto_pinto", {"xy_m": 1e-15, "r0": 1.0, "cr1": 0.99, "cr2": 1e-15}),
        ("menegotto_pinto", {"k_n_per_m": 1e-15, "xy_m": 1e15, "post_yield_ratio": 0.99}),
        ("chaboche", {"k_n_per_m": 1e15, "fy_n": 1e-15, "recovery_per_m": 1e15}),
        ("chaboche", {"k_n_per_m": 1e-15, "isotropic_n": 1e15, "isotropic_rate_per_m": 1e15}),
        ("chaboche", {"kinematic_n_per_m": 1e15, "recovery_per_m": 1e-15}),
        ("rc_column", {"k_n_per_m": 1e15, "xy_m": 1e-15, "ultimate_m": 1e15, "slip": 0.5}),
        ("rc_column", {"xy_m": 1e-15, "energy_j": 1e-15, "slip_width": 0.01, "pivot": 1e15}),
        ("nonlinear_maxwell", {"km_n_per_m": 1e15, "force_n": 1e-15, "exponent": 0.05}),
        ("nonlinear_maxwell", {"km_n_per_m": 1e-15, "force_n": 1e15, "exponent": 10.0}),
        ("nonlinear_maxwell", {"km_n_per_m": 1e15, "force_n": 1e-15, "at_m_per_s": 1e15}),
        ("nonlinear_maxwell", {"at_m_per_s": 1e-15, "exponent": 10.0}),
        ("takeda", {"k_n_per_m": 1e15, "xy_m": 1e-15, "energy_j": 1e-15, "sharpness": 1.0}),
        ("takeda", {"k_n_per_m": 1e-15, "xy_m": 1e15, "sharpness": 1000.0, "pinching": 1.0}),
        ("takeda", {"xy_m": 1e-15, "unloading_exponent": 1.0, "strength_down_over_up": 1e-15}),
        ("takeda", {"post_yield_ratio": -0.99, "pinching_level": 0.0, "pinching": 1.0}),
        ("takeda", {"post_yield_ratio": 0.99, "pinching_level": 0.99, "pinching": 1.0}),
        ("takeda", {"post_yield_ratio": 0.99, "pinching_level": 0.99, "corner_on_line": 0.0}),
        ("takeda", {"corner_on_line": 0.0, "pinching": 0.0}),
        ("peak_oriented", {"reach_m": 2e-15, "start_m": 1e-15, "exponent": 10.0}),
        ("peak_oriented", {"k_up_n_per_m": 1e15, "reach_m": 1e15, "start_m": 1e-15, "backbone": 0}),
        (
            "rc_column",
            {
                "strength_lost_at_ultimate": 0.99,
                "strength_lost_with_energy": 0.99,
                "pivot": 0.0,
                "stiffness_lost_with_energy": 0.99,
                "eta": 50.0,
                "energy_j": 1e-15,
            },
        ),
    ],
)
def test_parameters_at_the_end_of_what_is_accepted_still_give_finite_forces(
    kind: str, change: dict[str, float]
) -> None:
    try:
        element = core.CoreElement(core.element(kind, **(ONE_OF_EACH[kind] | change)))
    except core.CoreError:
        return  # refusing them is as good
    for x in (0.0, 1.0, -900.0, 900.0, 0.0):
        assert np.isfinite(element.force(x, 1e5 * x, 0.0, H))
    assert np.all(np.isfinite(element.state()))


def test_unknown_kind_and_wrong_names_are_refused_by_name() -> None:
    with pytest.raises(core.CoreError, match="rubber"):
        core.element("rubber", k_n_per_m=1.0)
    with pytest.raises(core.CoreError, match="the parameters are k_n_per_m"):
        core.element("stiffness", k=1.0)
    for wrong in (
        core.ElementConfig("rubber", (1.0,)),
        core.ElementConfig("stiffness", (1.0, 2.0)),
    ):
        with pytest.raises(core.CoreError):
            core.CoreElement(wrong)


def test_reference_structure_carries_a_specimen_as_the_sum_of_its_elements() -> None:
    t = time_s(2.0)
    ag = np.sin(9.0 * t)
    motion = core.MotionConfig("central-difference", mass_kg=1000.0, damping_n_s_per_m=300.0)
    one, _, f_one = core.Motion(motion).reference([core.element("stiffness", k_n_per_m=3e5)], ag)
    parts = [core.element("stiffness", k_n_per_m=k) for k in (1e5, 1.5e5, 0.5e5)]
    sum_of_parts, _, f_sum = core.Motion(motion).reference(parts, ag)
    np.testing.assert_allclose(sum_of_parts, one, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(f_sum, f_one, rtol=1e-9, atol=1e-9)
