"""Integrators of the equation of motion: written again in Python, against scipy.integrate, and by
the poles of their free decay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.integrate
from kernels import FS_HZ, Floats, H, damping_ratio, resonance, time_s

from rthyb_rt import core

MASS, DAMPING, K_E = 30000.0, 15080.0, 4737410.0  # Section 4.2
INTEGRATORS = ("central-difference", "forward-euler", "cr", "kr-alpha")


def motion(integrator: Any, **settings: Any) -> core.MotionConfig:
    values = {"mass_kg": MASS, "damping_n_s_per_m": DAMPING, "k_e_n_per_m": K_E}
    return core.MotionConfig(integrator, **(values | settings))


# --- the same integrators in plain Python --------------------------------------------------------
# Each takes configuration, ground acceleration and a function x -> force, and returns x.


def central_difference(c: core.MotionConfig, ag: Floats, force: Callable[[float], float]) -> Floats:
    m, h = c.mass_kg + c.added_mass_kg, c.period_s
    x = np.zeros(ag.size + 1)
    for n in range(ag.size):
        before = x[n - 1] if n > 0 else 0.0
        load = -c.mass_kg * ag[n] - c.stiffness_n_per_m * x[n] - force(x[n])
        right = load + m * (2.0 * x[n] - before) / h**2 + c.damping_n_s_per_m * before / (2 * h)
        x[n + 1] = right / (m / h**2 + c.damping_n_s_per_m / (2.0 * h))
    return x[1:]


def forward_euler(c: core.MotionConfig, ag: Floats, force: Callable[[float], float]) -> Floats:
    m, h = c.mass_kg + c.added_mass_kg, c.period_s
    y = np.zeros(2)
    x = np.zeros(ag.size)
    for n in range(ag.size):
        load = -c.mass_kg * ag[n] - c.stiffness_n_per_m * y[0] - force(y[0])
        y = y + h * np.array([y[1], (load - c.damping_n_s_per_m * y[1]) / m])
        x[n] = y[0]
    return x


def cr(c: core.MotionConfig, ag: Floats, force: Callable[[float], float]) -> Floats:
    m, h, k = c.mass_kg + c.added_mass_kg, c.period_s, c.stiffness_n_per_m + c.k_e_n_per_m
    weight = 4.0 * m / (4.0 * m + 2.0 * c.damping_n_s_per_m * h + k * h**2)
    position = velocity = 0.0
    x = np.zeros(ag.size)
    for n in range(ag.size):
        load = -c.mass_kg * ag[n] - c.stiffness_n_per_m * position - force(position)
        acceleration = (load - c.damping_n_s_per_m * velocity) / m
        position += h * velocity + weight * h**2 * acceleration
        velocity += weight * h * acceleration
        x[n] = position
    return x


def kr_alpha(c: core.MotionConfig, ag: Floats, force: Callable[[float], float]) -> Floats:
    """Kolay & Ricles (2014), Eqn 6-13, with one degree of freedom."""
    m, h, k = c.mass_kg + c.added_mass_kg, c.period_s, c.stiffness_n_per_m + c.k_e_n_per_m
    rho, d = c.rho_inf, c.damping_n_s_per_m
    alpha_f, alpha_m = rho / (1.0 + rho), (2.0 * rho - 1.0) / (rho + 1.0)
    gamma = 0.5 - alpha_m + alpha_f
    beta = 0.25 * (0.5 + gamma) ** 2
    common = 1.0 / (m + gamma * h * d + beta * h**2 * k)
    a1 = common * m
    a2 = (0.5 + gamma) * a1
    a3 = common * (alpha_m * m + alpha_f * gamma * h * d + alpha_f * beta * h**2 * k)
    x = np.zeros(ag.size)
    position = velocity = acceleration = old_velocity = old_load = 0.0
    for n in range(ag.size):
        load = -c.mass_kg * ag[n] - c.stiffness_n_per_m * position - force(position)
        inertia = (
            (1.0 - alpha_f) * (load - d * velocity) + alpha_f * (old_load - d * old_velocity)
        ) / m
        acceleration = (inertia - a3 * acceleration) / (1.0 - a3)
        old_load, old_velocity = load, velocity
        position += h * velocity + h**2 * a2 * acceleration
        velocity += h * a1 * acceleration
        x[n] = position
    return x


WRITTEN_AGAIN = {
    "central-difference": central_difference,
    "forward-euler": forward_euler,
    "cr": cr,
    "kr-alpha": kr_alpha,
}


def run(config: core.MotionConfig, ag: Floats, force: Callable[[float], float]) -> Floats:
    kernel = core.Motion(config)
    position, out = 0.0, np.zeros(ag.size)
    for n in range(ag.size):
        position, code = kernel.step(ag[n], force(position))
        assert code == 0
        out[n] = position
    return out


@pytest.mark.parametrize("rho_inf", [1.0, 0.5, 0.0])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_integrator_equals_its_published_formulas(integrator: str, rho_inf: float) -> None:
    config = motion(integrator, stiffness_n_per_m=8e5, added_mass_kg=2500.0, rho_inf=rho_inf)
    ag = np.random.default_rng(1).normal(size=3000)

    def force(x: float) -> float:
        return 0.8 * K_E * x + 3e9 * x**3

    expected = WRITTEN_AGAIN[integrator](config, ag, force)
    found = run(config, ag, force)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)))


# --- against scipy.integrate ---------------------------------------------------------------------


def smooth_shaking(t: Floats) -> Floats:
    return np.asarray(1.5 * np.sin(3.0 * t) ** 3 * np.exp(-0.2 * t))


def exact_response(c: core.MotionConfig, t: Floats) -> Floats:
    m = c.mass_kg + c.added_mass_kg

    def slope(time: float, y: Floats) -> list[float]:
        force = (K_E + c.stiffness_n_per_m) * y[0] + 5e8 * y[0] ** 3
        load = -c.mass_kg * float(smooth_shaking(np.float64(time))) - c.damping_n_s_per_m * y[1]
        return [y[1], (load - force) / m]

    solution = scipy.integrate.solve_ivp(
        slope, (0.0, t[-1]), [0.0, 0.0], "DOP853", t_eval=t, rtol=1e-11, atol=1e-14
    )
    return np.asarray(solution.y[0])


@pytest.mark.parametrize(("integrator", "order"), zip(INTEGRATORS, (2, 1, 2, 2), strict=True))
def test_halving_the_period_converges_to_scipy_in_the_order_of_the_integrator(
    integrator: str, order: int
) -> None:
    errors = []
    elements = [
        core.element("stiffness", k_n_per_m=K_E),
        core.element("cubic", k3_n_per_m3=5e8),
    ]
    for factor in (1, 2, 4):
        config = motion(
            integrator, period_s=H / factor, added_mass_kg=3000.0, stiffness_n_per_m=5e5
        )
        t = np.arange(4096 * factor) * config.period_s
        x, _, _ = core.Motion(config).reference(elements, smooth_shaking(t))
        errors.append(np.max(np.abs(x[::factor] - exact_response(config, t[::factor]))))
    observed = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(observed, order, atol=0.1)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_reference_gives_velocity_and_force_at_the_same_instant_as_displacement(
    integrator: str,
) -> None:
    t = time_s(4.0)
    x, v, f = core.Motion(motion(integrator)).reference(
        [core.element("stiffness", k_n_per_m=K_E)], smooth_shaking(t)
    )
    np.testing.assert_allclose(f, K_E * x, rtol=1e-14)
    # x and f are good to second order (forward Euler: first), so v has to be as well.
    central = (x[2:] - x[:-2]) / (2.0 * H)
    tolerance = 0.01 if integrator == "forward-euler" else 2e-4
    assert np.max(np.abs(v[1:-1] - central)) < tolerance * np.max(np.abs(v))


# --- stability and damping -----------------------------------------------------------------------


def free_decay(config: core.MotionConfig, stiffness: float, samples: int) -> Floats:
    ag = np.zeros(samples)
    ag[0] = 1.0
    x, _, _ = core.Motion(config).reference([core.element("stiffness", k_n_per_m=stiffness)], ag)
    return x[1:]


def poles(integrator: str, omega_h: float, zeta: float, **settings: Any) -> Floats:
    """Poles of one step for a linear specimen, from the core's own free decay."""
    omega = omega_h * FS_HZ
    config = core.MotionConfig(
        integrator,  # type: ignore[arg-type]
        mass_kg=1.0,
        damping_n_s_per_m=2.0 * zeta * omega,
        k_e_n_per_m=omega**2,
        **settings,
    )
    order = 3 if integrator == "kr-alpha" and settings.get("rho_inf", 1.0) != 1.0 else 2
    return resonance(free_decay(config, omega**2, 40), order)


@pytest.mark.parametrize("omega_h", [0.003, 0.1, 1.0, 2.0, 5.0, 30.0, 300.0])
@pytest.mark.parametrize("zeta", [0.0, 0.02, 0.5])
def test_cr_and_kr_alpha_are_stable_for_any_period_of_a_linear_structure(
    omega_h: float, zeta: float
) -> None:
    for integrator, settings in (
        ("cr", {}),
        ("kr-alpha", {"rho_inf": 1.0}),
        ("kr-alpha", {"rho_inf": 0.7}),
        ("kr-alpha", {"rho_inf": 0.0}),
    ):
        x = free_decay(
            core.MotionConfig(
                integrator,  # type: ignore[arg-type]
                mass_kg=1.0,
                damping_n_s_per_m=2.0 * zeta * omega_h * FS_HZ,
                k_e_n_per_m=(omega_h * FS_HZ) ** 2,
                **settings,
            ),
            (omega_h * FS_HZ) ** 2,
            20_000,
        )
        assert np.max(np.abs(x[10_000:])) <= np.max(np.abs(x[:10_000])) * (1.0 + 1e-6)


def test_explicit_integrators_leave_the_stable_region_where_theory_says() -> None:
    assert np.max(np.abs(poles("central-difference", 1.99, 0.0))) == pytest.approx(1.0, abs=1e-6)
    assert np.max(np.abs(poles("central-difference", 2.01, 0.0))) > 1.05
    zeta = 0.02  # forward Euler: |z|^2 = 1 - 2 zeta w h + (w h)^2
    for omega_h in (0.9 * 2 * zeta, 1.1 * 2 * zeta):
        radius = np.abs(poles("forward-euler", omega_h, zeta))
        expected = np.sqrt(1.0 - 2.0 * zeta * omega_h + omega_h**2)
        np.testing.assert_allclose(radius, expected, rtol=1e-7)


@pytest.mark.parametrize("integrator", ["central-difference", "cr", "kr-alpha"])
@pytest.mark.parametrize("omega_h", [0.01, 0.1, 0.5])
def test_undamped_structure_neither_gains_nor_loses(integrator: str, omega_h: float) -> None:
    np.testing.assert_allclose(np.abs(poles(integrator, omega_h, 0.0)), 1.0, atol=1e-9)


@pytest.mark.parametrize("rho_inf", [0.3, 0.6, 0.9])
def test_kr_alpha_damps_the_highest_frequencies_to_its_spectral_radius(rho_inf: float) -> None:
    fast = poles("kr-alpha", 1e4, 0.0, rho_inf=rho_inf)
    assert np.max(np.abs(fast)) == pytest.approx(rho_inf, abs=0.01)
    slow = poles("kr-alpha", 0.01, 0.0, rho_inf=rho_inf)
    oscillating = slow[np.abs(slow.imag) > 1e-6]
    assert damping_ratio(oscillating[0]) == pytest.approx(0.0, abs=1e-5)


# --- energy --------------------------------------------------------------------------------------


def test_central_difference_conserves_its_discrete_energy() -> None:
    config = core.MotionConfig("central-difference", mass_kg=2.0)
    x = free_decay(config, 5000.0, 5000)
    kinetic = 0.5 * 2.0 * ((x[1:] - x[:-1]) * FS_HZ) ** 2
    strain = 0.5 * 5000.0 * x[1:] * x[:-1]
    energy = kinetic + strain
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


@pytest.mark.parametrize("integrator", ["central-difference", "cr", "kr-alpha"])
def test_energy_put_in_is_stored_or_dissipated(integrator: str) -> None:
    t = time_s(12.0)
    ag = smooth_shaking(t)
    specimen = core.element(
        "hysteresis", k_n_per_m=K_E, post_yield_ratio=0.02, a=1, b=300, c=200, eta=1.5
    )
    x, _, f = core.Motion(motion(integrator)).reference([specimen], ag)
    v = np.gradient(x, H)
    put_in = -MASS * scipy.integrate.cumulative_trapezoid(ag * v, t)
    viscous = DAMPING * scipy.integrate.cumulative_trapezoid(v**2, t)
    specimen_work = scipy.integrate.cumulative_trapezoid(f, x)
    kinetic = 0.5 * MASS * v[1:] ** 2
    assert specimen_work[-1] > 0.1 * put_in.max()
    balance = put_in - viscous - specimen_work - kinetic
    assert np.max(np.abs(balance)) < 2e-4 * np.max(put_in)


# --- the rest of the contract --------------------------------------------------------------------


def test_prescribed_motion_is_the_excitation_itself() -> None:
    kernel = core.Motion(core.MotionConfig("prescribed"))
    for x in (0.001, -0.02, 0.0):
        assert kernel.step(x, 1e6) == (x, 0)


def test_ground_motion_acts_on_the_numerical_mass_alone() -> None:
    # The first acceleration from rest is -ag m / (m + m_added).
    config = motion("central-difference", added_mass_kg=MASS, damping_n_s_per_m=0.0)
    x, _ = core.Motion(config).step(1.0, 0.0)
    assert x == pytest.approx(-0.5 * H**2, rel=1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_structure_at_rest_stays_at_rest(integrator: str) -> None:
    x, v, f = core.Motion(motion(integrator)).reference(
        [core.element("stiffness", k_n_per_m=K_E)], np.zeros(500)
    )
    for signal in (x, v, f):
        assert np.all(signal == 0.0)


@pytest.mark.parametrize("integrator", ["central-difference", "forward-euler"])
def test_unstable_structure_ends_at_the_guard_and_says_so(integrator: str) -> None:
    kernel = core.Motion(core.MotionConfig(integrator, mass_kg=1e-3))  # type: ignore[arg-type]
    x, seen = 1e-3, 0
    for _ in range(3000):
        x, code = kernel.step(0.0, np.clip(1e9 * x, -1e12, 1e12) + 1.0)
        seen |= code
        assert abs(x) <= 1e3
    assert seen & core.STATUS["out_of_range"]


@pytest.mark.parametrize(
    "setting",
    [
        {"mass_kg": 0.0},
        {"mass_kg": -1.0},
        {"mass_kg": np.nan},
        {"mass_kg": np.inf},
        {"added_mass_kg": -1.0},
        {"added_mass_kg": np.nan},
        {"damping_n_s_per_m": -1.0},
        {"damping_n_s_per_m": np.nan},
        {"stiffness_n_per_m": np.nan},
        {"stiffness_n_per_m": np.inf},
        {"k_e_n_per_m": -1.0},
        {"k_e_n_per_m": np.nan},
        {"rho_inf": 1.1},
        {"rho_inf": -0.1},
        {"rho_inf": np.nan},
        {"period_s": 0.0},
        {"period_s": np.nan},
        {"period_s": 2.0},
    ],
    ids=str,
)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_setting_out_of_range_is_refused(integrator: str, setting: dict[str, float]) -> None:
    with pytest.raises(core.CoreError):
        core.Motion(motion(integrator, **setting))


@pytest.mark.parametrize("integrator", ["cr", "kr-alpha"])
def test_negative_stiffness_that_makes_the_step_singular_is_refused(integrator: str) -> None:
    # 4 m + k h^2 = 0: the effective mass of the step vanishes.
    with pytest.raises(core.CoreError):
        core.Motion(
            core.MotionConfig(
                integrator,  # type: ignore[arg-type]
                mass_kg=1.0,
                stiffness_n_per_m=-4.0 * FS_HZ**2,
            )
        )


@pytest.mark.parametrize("x0_m", [np.nan, np.inf, 1e300])
def test_senseless_start_position_is_refused(x0_m: float) -> None:
    with pytest.raises(core.CoreError):
        core.Motion(motion("cr"), x0_m)
