"""Numerical parts of any size: against the printed matrix form written again in numpy, closed
forms, scipy's integrator and OpenSees; through controller and station; with senseless readings."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from courses import course, departure
from frames import shear_building, space_frame
from kernels import Floats, opensees
from rthyb_rt._core import ffi, lib

from rthyb_rt import core
from rthyb_rt.core.numerical_parts import DensePart, SparsePart
from rthyb_rt.core.sparse import (
    GROUND,
    Joint,
    Response,
    SparseConfig,
    Symmetric,
    initial_stiffness,
)

H = 1.0 / 1024.0
K_E = 3e7
N = 12
M, K = shear_building(2e4 * (1.0 + 0.5 * np.sin(np.arange(N))), 3e7 * np.ones(N))
FIRST = (((0, 1.0),),)
RAYLEIGH = {"by_mass_per_s": 0.3, "by_stiffness_s": 2e-4}


def building(m: Floats = M, k: Floats = K, **settings: Any) -> SparseConfig:
    """Storeys whose lowest is driven by the actuator; `settings` as of the part."""
    given: dict[str, Any] = {"interfaces": FIRST, "k_e_n_per_m": (K_E,), "load_kg": np.diag(m)}
    given |= settings
    return SparseConfig(Symmetric.of(m), Symmetric.of(k), **given)


Force = Callable[[int, Floats], Floats]


def printed(config: SparseConfig, ag: Floats, force: Force) -> Floats:
    """Kolay & Ricles (2014) as it is printed, with its three integration matrices: (n, degrees)."""
    rho, h = config.rho_inf, config.period_s
    alpha_m, alpha_f = (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0)
    gamma = 0.5 - alpha_m + alpha_f
    beta = 0.25 * (0.5 + gamma) ** 2
    m, own = config.mass_kg.matrix().toarray(), config.stiffness_n_per_m.matrix().toarray()
    n = len(m)
    b = np.zeros((len(config.interfaces), n))
    for row, terms in zip(b, config.interfaces, strict=True):
        for at, by in terms:
            row[at] = by
    between = np.array(config.k_e_between) if config.k_e_between else 0.0
    whole = own + b.T @ (np.diag(config.k_e_n_per_m) + between) @ b
    c = config.damping_times(np.eye(n))
    step = m + gamma * h * c + beta * h * h * whole
    one = np.linalg.solve(step, m)
    two = (0.5 + gamma) * one
    three = np.linalg.solve(
        step, alpha_m * m + alpha_f * gamma * h * c + alpha_f * beta * h * h * whole
    )
    x = v = x1 = v1 = load1 = np.zeros(n)
    a = np.zeros(n)
    found = []
    for i, excitation in enumerate(ag):
        found.append(x)
        load = -config.load_kg * excitation - b.T @ force(i, b @ x)
        if i == 0:
            a = np.linalg.solve(m, load)
        else:
            now, before = 1.0 - alpha_f, alpha_f
            rhs = now * load + before * load1 - c @ (now * v + before * v1)
            rhs -= own @ (now * x + before * x1) + m @ three @ a
            a = np.linalg.solve(m @ (np.eye(n) - three), rhs)
        load1, x1, v1 = load, x, v
        x, v = x + h * v + h * h * two @ a, v + h * one @ a
    return np.array(found)


def run(config: SparseConfig, ag: Floats, force: Force) -> Floats:
    part, found = SparsePart(config), []
    at = np.zeros(len(config.interfaces))
    for i, excitation in enumerate(ag):
        found.append(part.displacements())
        at, code = part.answer_all(float(excitation), list(force(i, at)))
        assert code == 0
        assert part.advance() == 0
    return np.array(found)


def elastic(i: int, at: Floats) -> Floats:
    return np.asarray(0.9 * K_E * at + 100.0 * np.sin(i / 50.0))


def worst(found: Floats, expected: Floats) -> float:
    """Largest difference of any degree of freedom, relative to its own peak."""
    return float((np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)).max())


AG = np.random.default_rng(1).standard_normal(3000)


@pytest.mark.parametrize("rho_inf", [1.0, 0.8, 0.5, 0.0])
def test_one_sparse_solve_is_the_printed_method(rho_inf: float) -> None:
    config = building(rho_inf=rho_inf, **RAYLEIGH)
    assert worst(run(config, AG, elastic), printed(config, AG, elastic)) < 1e-12


def modal_shapes(m: Floats, k: Floats, ratios: list[float]) -> Floats:
    w2, phi = scipy.linalg.eigh(k, m)
    r = len(ratios)
    return np.asarray(m @ phi[:, :r] * np.sqrt(2.0 * np.array(ratios) * np.sqrt(w2[:r])))


@pytest.mark.parametrize("rho_inf", [1.0, 0.5])
def test_modal_damping_by_a_rank_update_is_the_printed_method(rho_inf: float) -> None:
    whole = building().whole_stiffness().toarray()
    shapes = modal_shapes(M, whole, [0.02, 0.03, 0.05])
    config = building(rho_inf=rho_inf, modal=shapes)
    assert worst(run(config, AG, elastic), printed(config, AG, elastic)) < 1e-12


def test_dampers_beside_the_matrices_are_the_printed_method() -> None:
    extra = Symmetric.of(1e-4 * building().whole_stiffness().toarray())
    config = building(damping_n_s_per_m=extra, by_mass_per_s=0.2)
    assert worst(run(config, AG, elastic), printed(config, AG, elastic)) < 1e-12


def test_two_actuators_at_a_storey_and_at_a_drift_are_the_printed_method() -> None:
    rows = (((2, 1.0),), ((7, 1.0), (6, -1.0)))
    config = building(interfaces=rows, k_e_n_per_m=(K_E, 0.5 * K_E), rho_inf=0.8, **RAYLEIGH)

    def force(i: int, at: Floats) -> Floats:
        return np.asarray([0.8 * K_E, 0.4 * K_E] * at + 50.0 * np.cos(i / 30.0))

    assert worst(run(config, AG, force), printed(config, AG, force)) < 1e-12


def test_a_specimen_that_couples_two_actuators_is_the_printed_method() -> None:
    rows = (((2, 1.0),), ((7, 1.0), (6, -1.0)))
    coupled = np.array([[K_E, 0.4 * K_E], [0.4 * K_E, 0.5 * K_E]])
    config = building(
        interfaces=rows,
        k_e_n_per_m=tuple(np.diag(coupled).tolist()),
        k_e_between=((0.0, 0.4 * K_E), (0.4 * K_E, 0.0)),
        rho_inf=0.8,
        **RAYLEIGH,
    )

    def force(i: int, at: Floats) -> Floats:
        return np.asarray(0.8 * coupled @ at + 50.0 * np.cos(i / 30.0))

    found = run(config, AG, force)
    assert worst(found, printed(config, AG, force)) < 1e-12
    assert worst(found, run(replace(config, k_e_between=()), AG, force)) > 1e-6
    assert np.array_equal(run(SparseConfig.of_plain(config.plain()), AG, force), found)


@pytest.mark.parametrize(("columns", "storeys", "widest"), [((2, 2), 3, 24), ((5, 4), 6, 100)])
def test_the_solve_by_panels_of_a_space_frame_is_scipys(
    columns: tuple[int, int], storeys: int, widest: int
) -> None:
    mass, stiffness, _, corner = space_frame(columns, storeys)
    m, k = mass.toarray(), stiffness.toarray()
    config = building(m, k, interfaces=(((corner[0], 1.0),),), rho_inf=0.8)
    settings, layout = config.struct()
    panels = np.frombuffer(ffi.buffer(settings.panel, 4 * (settings.panels + 1)), np.int32)
    assert np.diff(panels).max() >= widest, "nothing here that a panel could be"
    w = layout.weights
    rhs = np.random.default_rng(2).standard_normal(len(m))
    in_step = w.beta * config.period_s**2 * config.whole_stiffness().toarray()
    s = (1.0 - w.alpha_m) * m + (1.0 - w.alpha_f) * in_step
    for known in (settings.panels, 0):
        settings.panels = known
        values = ffi.new("double[]", rhs[layout.order].tolist())
        lib.rthyb_sparse_solve(settings, values)
        found = np.empty(len(m))
        found[layout.order] = list(values)
        assert np.abs(s @ found - rhs).max() < 1e-12 * (np.abs(s) @ np.abs(found)).max()
        assert found == pytest.approx(
            np.linalg.solve(s, rhs), rel=1e-8, abs=1e-12 * abs(found).max()
        )


def test_it_is_the_method_of_chen_and_ricles_for_a_small_structure() -> None:
    m, k = shear_building(np.array([900.0, 800.0, 700.0]), np.array([2e6, 1.5e6, 1e6]))
    c = 0.2 * m + 1e-4 * k
    rows = [tuple(map(tuple, one.tolist())) for one in (m, c, k)]
    dense = DensePart(core.DenseConfig("cr", *rows, tuple(np.diag(m)), at=1, k_e_n_per_m=4e5))
    sparse = SparsePart(
        building(
            m,
            k,
            interfaces=(((1, 1.0),),),
            k_e_n_per_m=(4e5,),
            damping_n_s_per_m=Symmetric.of(c),
            integrator="cr",
        )
    )
    x, expected = [0.0], [0.0]
    for i, ag in enumerate(AG):
        expected.append(dense.step(float(ag), 4e5 * expected[-1] + 9.0 * np.sin(i / 9.0))[0])
        x.append(sparse.step(float(ag), 4e5 * x[-1] + 9.0 * np.sin(i / 9.0))[0])
    assert np.abs(np.array(x) - expected).max() < 1e-11 * np.abs(expected).max()
    assert sparse.look().v == pytest.approx(dense.look().v, rel=1e-9)
    assert sparse.look().a == pytest.approx(dense.look().a, rel=1e-9)


def test_the_central_difference_where_there_is_mass() -> None:
    config = building(integrator="central-difference", **RAYLEIGH)
    found = run(config, AG, elastic)
    m, own = M, config.stiffness_n_per_m.matrix().toarray()
    c = config.damping_times(np.eye(N))
    implicit = m + 0.5 * H * c
    x1 = x = np.zeros(N)
    expected = []
    for i, ag in enumerate(AG):
        expected.append(x)
        net = -config.load_kg * ag - own @ x
        net[0] -= elastic(i, x[:1])[0]
        moved = (m - 0.5 * H * c) @ (x - x1) + H * H * net
        x, x1 = x + np.linalg.solve(implicit, moved), x
    assert worst(found, np.array(expected)) < 1e-12


def test_degrees_of_freedom_without_mass_follow_the_others() -> None:
    mass, stiffness, _, corner = space_frame((2, 2), 3)
    n = mass.shape[0]
    load = np.zeros(n)
    load[0::6] = mass.diagonal()[0::6]
    first = (((corner[0], 1.0),),)
    whole = SparseConfig(
        Symmetric.of(mass), Symmetric.of(stiffness), load, first, (K_E,), by_mass_per_s=0.3,
        rho_inf=0.8,
    )  # fmt: skip
    with_mass = np.flatnonzero(mass.diagonal())
    without = np.setdiff1d(np.arange(n), with_mass)
    k = stiffness.toarray()
    inner = np.linalg.solve(k[np.ix_(without, without)], k[np.ix_(without, with_mass)])
    condensed = k[np.ix_(with_mass, with_mass)] - k[np.ix_(with_mass, without)] @ inner
    at = int(np.flatnonzero(with_mass == corner[0])[0])
    small = replace(
        whole,
        mass_kg=Symmetric.of(mass.toarray()[np.ix_(with_mass, with_mass)]),
        stiffness_n_per_m=Symmetric.of(condensed),
        load_kg=load[with_mass],
        interfaces=(((at, 1.0),),),
    )
    moving = np.flatnonzero(load)
    in_small = np.searchsorted(with_mass, moving)
    found, expected = run(whole, AG, elastic), run(small, AG, elastic)
    assert worst(found[:, moving], expected[:, in_small]) < 1e-9


def test_two_modes_swing_freely_as_they_should() -> None:
    config = building(k_e_n_per_m=(0.0,))
    w2, phi = scipy.linalg.eigh(K, M)
    w = np.sqrt(w2[:2])
    x0 = 0.01 * phi[:, 0] / phi[-1, 0] + 0.003 * phi[:, 1] / phi[-1, 1]
    part = SparsePart(replace(config, first_x_m=x0))
    found = []
    for _ in range(4096):
        found.append(part.displacements())
        part.step(0.0, 0.0)
    t = np.arange(4096) * H
    expected = np.outer(np.cos(w[0] * t), 0.01 * phi[:, 0] / phi[-1, 0])
    expected += np.outer(np.cos(w[1] * t), 0.003 * phi[:, 1] / phi[-1, 1])
    # KR-alpha with rho 1 has the periods of the average acceleration: longer by (w h)^2 / 12.
    allowed = 2.0 * t[-1] * w[1] * (w[1] * H) ** 2 / 12.0
    assert worst(np.array(found), expected) < allowed
    v0 = 0.2 * phi[:, 0] / phi[-1, 0]
    part = SparsePart(replace(config, first_v_m_per_s=v0))
    found = []
    for _ in range(4096):
        found.append(part.displacements())
        part.step(0.0, 0.0)
    expected = np.outer(np.sin(w[0] * t) / w[0], v0)
    assert worst(np.array(found), expected) < 2.0 * t[-1] * w[0] * (w[0] * H) ** 2 / 12.0 + 1e-5


# ---- elements -----------------------------------------------------------------------------------

BOUC_WEN = core.element(
    "hysteresis", k_n_per_m=K_E, post_yield_ratio=0.05, a=1.0, b=100.0, c=100.0, eta=1.0
)
DRY = core.element("coulomb", fc_n=2e4, width_m_per_s=1e-4)


def test_an_element_in_the_part_does_what_the_same_one_does_at_the_actuator() -> None:
    ag = 3.0 * np.sin(np.arange(3000) / 90.0)
    inside = building(joints=(Joint(GROUND, 0, BOUC_WEN, K_E),), k_e_n_per_m=(0.0,), **RAYLEIGH)
    outside = building(**RAYLEIGH)
    x = SparsePart(inside).joined([], ag, 0)[0]
    expected = SparsePart(outside).joined([BOUC_WEN], ag, 0)[0]
    assert np.abs(expected).max() > 0.01  # it yields
    assert np.abs(x - expected).max() < 1e-12 * np.abs(expected).max()


def test_weight_on_a_storey_is_a_negative_stiffness() -> None:
    pulls = core.element("p_delta", gravity_load_n=4e6, height_m=3.0)
    slope = initial_stiffness(pulls)
    assert slope == pytest.approx(-4e6 / 3.0, rel=1e-6)
    joined = building(joints=(Joint(3, 4, pulls, -4e6 / 3.0),), **RAYLEIGH)
    k = K.copy()
    k[np.ix_([3, 4], [3, 4])] += -4e6 / 3.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    expected = run(building(k=k, **RAYLEIGH), AG, elastic)
    assert worst(run(joined, AG, elastic), expected) < 1e-10


def test_a_yielding_storey_of_ten_is_what_scipy_says() -> None:
    """Beside it the drift's velocity matters: a viscous damper is an element as well."""
    n, k = 10, 3e7
    m, stiffness = shear_building(2e4 * np.ones(n), np.append(k * np.ones(4), 0.0)[[0, 1, 4, 2, 3] +
                                  [0] * 5])  # fmt: skip
    # The third storey is Bouc-Wen alone.
    dashpot = core.element("viscous", c_n_s_per_m=4e5)
    part = SparseConfig(
        Symmetric.of(m),
        Symmetric.of(stiffness),
        np.diag(m).copy(),
        (((0, 1.0),),),
        (0.0,),
        by_mass_per_s=0.3,
        joints=(Joint(1, 2, BOUC_WEN, K_E), Joint(4, 5, dashpot)),
        responses=(
            Response("drift", "m", displacements=((2, 1.0), (1, -1.0))),
            Response("shear", "N", joints=((0, 1.0),)),
        ),
    )
    t = np.arange(6 * 1024) * H
    ag = 3.0 * np.sin(6.0 * t) * np.exp(-0.2 * t)
    drift = SparsePart(part).joined([], ag, 2)[3]

    def rate(now: float, s: Floats) -> Floats:
        x, v, z = s[:n], s[n : 2 * n], s[2 * n]
        moved, speed = x[2] - x[1], v[2] - v[1]
        shear = K_E * (0.05 * moved + 0.95 * z)
        force = -np.diag(m) * 3.0 * np.sin(6.0 * now) * np.exp(-0.2 * now)
        force = force - stiffness @ x - 0.3 * m @ v
        force[2] -= shear
        force[1] += shear
        damper = 4e5 * (v[5] - v[4])
        force[5] -= damper
        force[4] += damper
        dz = speed - 100.0 * abs(speed) * z - 100.0 * speed * abs(z)
        return np.concatenate([v, force / np.diag(m), [dz]])

    solved = scipy.integrate.solve_ivp(
        rate, (0.0, t[-1]), np.zeros(2 * n + 1), "DOP853", t, rtol=1e-9, atol=1e-12, max_step=0.005
    )
    expected = solved.y[2] - solved.y[1]
    assert np.abs(expected).max() > 0.01
    assert np.abs(drift[:, 0] - expected).max() < 0.003 * np.abs(expected).max()
    shear = K_E * (0.05 * expected + 0.95 * solved.y[2 * n])
    assert np.abs(drift[:, 1] - shear).max() < 0.003 * np.abs(shear).max()


# ---- dry friction -------------------------------------------------------------------------------

FLOORS = 4
LIGHT, SHEARS = shear_building(np.full(FLOORS, 2700.0), np.full(FLOORS, 4.7e6))
PULSE = (3.0, 8.0, 0.3)


def pulse(t: Floats | float) -> Any:
    size, omega, decay = PULSE
    return size * np.sin(omega * t) * np.exp(-decay * t)


Law = Callable[[float], float]
FRICTION: dict[str, tuple[core.ElementConfig, Law]] = {
    "coulomb": (
        core.element("coulomb", fc_n=2000.0, width_m_per_s=5e-4),
        lambda v: 2000.0 * np.tanh(v / 5e-4),
    ),
    "coulomb, almost a step": (
        core.element("coulomb", fc_n=2000.0, width_m_per_s=1e-5),
        lambda v: 2000.0 * np.tanh(v / 1e-5),
    ),
    "coulomb_uneven": (
        core.element("coulomb_uneven", fc_up_n=3000.0, fc_down_n=1000.0, width_m_per_s=5e-4),
        lambda v: (1000.0 if v < 0.0 else 3000.0) * np.tanh(v / 5e-4),
    ),
    "stribeck": (
        core.element("stribeck", fc_n=1500.0, fs_n=2500.0, vs_m_per_s=0.05, width_m_per_s=5e-4),
        lambda v: (1500.0 + 1000.0 * np.exp(-((v / 0.05) ** 2))) * np.tanh(v / 5e-4),
    ),
    "stribeck, exponent 1.5": (
        core.element(
            "stribeck",
            fc_n=1500.0, fs_n=2500.0, vs_m_per_s=0.05, width_m_per_s=5e-4, exponent=1.5,
        ),
        lambda v: (1500.0 + 1000.0 * np.exp(-(np.abs(v / 0.05) ** 1.5))) * np.tanh(v / 5e-4),
    ),
    "power_damping": (
        core.element(
            "power_damping", force_n=2000.0, at_m_per_s=0.1, exponent=0.2, width_m_per_s=2e-4
        ),
        lambda v: 2000.0 * (v / 0.1) * ((v / 0.1) ** 2 + (2e-4 / 0.1) ** 2) ** -0.4,
    ),
}  # fmt: skip


def with_friction(element: core.ElementConfig, **settings: Any) -> SparseConfig:
    """Four light storeys, the lower three with friction, where an explicit force would chatter."""
    given: dict[str, Any] = {
        "k_e_n_per_m": (0.0,),
        "by_mass_per_s": 0.5,
        "rho_inf": 0.8,
        "joints": tuple(Joint(i - 1, i, element) for i in range(3)),
        "responses": (Response("force", "N", joints=((1, 1.0),)),),
    }
    return building(LIGHT, SHEARS, **(given | settings))


def of_radau(
    law: Law, t: Floats, rtol: float = 1e-7, atol: float = 1e-10, factor: float = 1.0
) -> Floats:
    """Displacements of the floors of `with_friction`, (n, floors)."""
    m = np.diag(LIGHT)

    def rate(now: float, s: Floats) -> Floats:
        x, v = s[:FLOORS], s[FLOORS:]
        force = -m * factor * pulse(now) - SHEARS @ x - 0.5 * m * v
        slip = np.diff(v, prepend=0.0)[:3]
        friction = np.array([law(u) for u in slip])
        force[:3] -= friction
        force[:2] += friction[1:]
        return np.concatenate([v, force / m])

    solved = scipy.integrate.solve_ivp(
        rate, (0.0, t[-1]), np.zeros(2 * FLOORS), "Radau", t, rtol=rtol, atol=atol, max_step=0.004
    )
    return np.asarray(solved.y[:FLOORS].T)


@pytest.mark.parametrize("kind", FRICTION)
def test_storeys_with_dry_friction_move_as_scipy_says(kind: str) -> None:
    element, law = FRICTION[kind]
    t = np.arange(2048) * H
    config, still = with_friction(element), lambda i, at: np.zeros(1)
    expected = of_radau(law, t)
    found = run(config, pulse(t), still)
    explicit = tuple(replace(joint, solved=False) for joint in config.joints)
    before = run(replace(config, joints=explicit), pulse(t), still)
    assert worst(found, expected) < 0.001
    assert worst(before, expected) > 5.0 * worst(found, expected)


@pytest.mark.parametrize("exponent", [1.0, 0.7])
def test_the_error_of_a_steep_stribeck_curve_is_that_of_the_step(exponent: float) -> None:
    """From 2048 Hz on, it falls with the square of the step, as for other elements."""
    element = core.element(
        "stribeck",
        fc_n=1500.0, fs_n=2500.0, vs_m_per_s=0.05, width_m_per_s=5e-4, exponent=exponent,
    )  # fmt: skip

    def law(v: float) -> float:
        level = 1500.0 + 1000.0 * np.exp(-(abs(v / 0.05) ** exponent))
        return float(level * np.tanh(v / 5e-4))

    t, error = np.arange(1024) * H, []
    expected = of_radau(law, t, rtol=1e-9, atol=1e-12)
    for times in (2, 4, 8):
        config = with_friction(element, period_s=H / times)
        ag = pulse(np.arange(1024 * times) * H / times)
        found = run(config, ag, lambda i, at: np.zeros(1))
        error.append(worst(found[::times], expected))
    assert error[0] < 3e-4
    assert error[1] == pytest.approx(error[0] / 4.0, rel=0.5)
    assert error[2] == pytest.approx(error[1] / 4.0, rel=0.1)


def test_friction_that_holds_a_storey_does_not_change_its_sign_at_every_sample() -> None:
    """Held by more than can move it, a storey stands, and the force is what it has to carry."""
    t = np.arange(2048) * H
    part = SparsePart(with_friction(core.element("coulomb", fc_n=1e6, width_m_per_s=1e-6)))
    force, x = [], []
    for ag in pulse(t):
        part.answer(float(ag), 0.0)
        force.append(float(part.responses()[0]))
        part.advance()
        x.append(part.displacements())
    moved = np.array(x)
    assert np.abs(moved[:, 1]).max() < 1e-3 * np.abs(moved[:, 3]).max()
    carried = 4.7e6 * (moved[:, 3] - moved[:, 2]) - 2.0 * 2700.0 * pulse(t)
    late = slice(300, None)
    scale = np.abs(carried).max()
    assert np.abs(np.diff(force)[late]).max() < 0.02 * scale
    assert np.abs(np.array(force) - carried)[late].max() < 0.02 * scale


def test_a_brake_that_holds_in_one_direction_only_holds_there() -> None:
    """Almost no friction upwards, and so much downwards that 30 halvings do not find it."""
    brake = core.element(
        "coulomb_uneven", fc_up_n=1e-3, fc_down_n=1e8, width_m_per_s=2.5e-7
    )  # fmt: skip
    one = np.array([[4.1]])
    part = SparsePart(
        building(one, np.array([[1.0]]), k_e_n_per_m=(0.0,), joints=(Joint(GROUND, 0, brake),))
    )
    for ag in (1e4, 10.0, 1e-3):
        for _ in range(300):
            part.answer(ag, 0.0)
            assert part.advance() == 0
    assert -1e-8 < float(part.displacements()[0]) < 0.0
    for _ in range(300):
        part.answer(-1.0, 0.0)
        part.advance()
    assert float(part.displacements()[0]) == pytest.approx(0.5 * (300 * H) ** 2, rel=0.02)


@pytest.mark.parametrize("integrator", ["cr", "central-difference"])
def test_friction_is_solved_for_with_every_integrator(integrator: str) -> None:
    element, law = FRICTION["coulomb"]
    t = np.arange(1024) * H
    config = with_friction(element, integrator=integrator)
    found = run(config, pulse(t), lambda i, at: np.zeros(1))
    assert worst(found, of_radau(law, t)) < 0.001


def test_a_recording_made_before_friction_was_solved_for_is_replayed_as_it_was() -> None:
    config = with_friction(FRICTION["coulomb"][0])
    plain = json.loads(json.dumps(config.plain()))
    again = SparseConfig.of_plain(plain)
    old = dict(plain, joints=[joint[:5] for joint in plain["joints"]])
    explicit = replace(config, joints=tuple(replace(j, solved=False) for j in config.joints))
    ag, still = pulse(np.arange(500) * H), lambda i, at: np.zeros(1)
    assert np.array_equal(run(again, ag, still), run(config, ag, still))
    assert np.array_equal(run(SparseConfig.of_plain(old), ag, still), run(explicit, ag, still))
    assert not np.array_equal(run(explicit, ag, still), run(config, ag, still))


RECORDED = {
    "stribeck": (FRICTION["stribeck"][0], 4),
    "stopper": (core.element("stopper", ks_n_per_m=5e6, xs_m=1e-4), 2),
    "gap_uneven": (
        core.element(
            "gap_uneven", k_up_n_per_m=5e6, gap_up_m=1e-4, k_down_n_per_m=3e6, gap_down_m=2e-4
        ),
        4,
    ),
    "degradation": (
        core.element(
            "degradation",
            k_n_per_m=2e6,
            post_yield_ratio=0.1,
            a=1.0,
            b=2e4,
            c=1e4,
            eta=1.5,
            loss=0.6,
            travel_m=0.01,
        ),
        8,
    ),
}


@pytest.mark.parametrize("kind", RECORDED)
def test_a_recording_made_before_an_element_had_all_its_parameters_is_replayed(kind: str) -> None:
    element, count = RECORDED[kind]
    config = with_friction(element)
    old = json.loads(json.dumps(config.plain()))
    old["joints"] = [
        [*ends, name, params[:count], k] for *ends, name, params, k, _ in old["joints"]
    ]
    explicit = replace(config, joints=tuple(replace(j, solved=False) for j in config.joints))
    ag, still = pulse(np.arange(500) * H), lambda i, at: np.zeros(1)
    assert np.array_equal(run(SparseConfig.of_plain(old), ag, still), run(explicit, ag, still))


def test_a_recording_with_too_few_parameters_of_an_element_is_refused() -> None:
    damaged = json.loads(json.dumps(with_friction(FRICTION["stribeck"][0]).plain()))
    damaged["joints"][0][3] = damaged["joints"][0][3][:3]
    with pytest.raises(core.CoreError, match="number of parameters"):
        SparsePart(SparseConfig.of_plain(damaged))


@pytest.mark.parametrize(
    ("force_n", "exponent", "solved"), [(2e3, 0.9, True), (2e3, 1.0, False), (-2e3, 0.5, False)]
)
def test_a_damper_is_solved_for_where_it_is_steep_at_rest_and_opposes_the_motion(
    force_n: float, exponent: float, solved: bool
) -> None:
    damper = core.element(
        "power_damping", force_n=force_n, at_m_per_s=0.1, exponent=exponent, width_m_per_s=2e-4
    )
    assert with_friction(damper).with_dry_friction() == ([0, 1, 2] if solved else [])


MANY = lib.RTHYB_SLIDERS_MAX
TALL, TALL_SHEARS = shear_building(np.full(MANY, 2700.0), np.full(MANY, 4.7e6))
STEEP: dict[str, tuple[core.ElementConfig, Callable[[Floats], Floats]]] = {
    "coulomb": (
        core.element("coulomb", fc_n=2e4, width_m_per_s=1e-6),
        lambda v: 2e4 * np.tanh(v / 1e-6),
    ),
    "stribeck": (
        core.element(
            "stribeck",
            fc_n=1.5e4, fs_n=2.4e4, vs_m_per_s=0.05, width_m_per_s=1e-6, exponent=1.3,
        ),
        lambda v: (1.5e4 + 9e3 * np.exp(-(np.abs(v / 0.05) ** 1.3))) * np.tanh(v / 1e-6),
    ),
    "power_damping": (
        core.element(
            "power_damping", force_n=2e4, at_m_per_s=0.1, exponent=0.2, width_m_per_s=1e-6
        ),
        lambda v: 2e4 * (v / 0.1) * ((v / 0.1) ** 2 + 1e-10) ** -0.4,
    ),
}  # fmt: skip


def tall(element: core.ElementConfig) -> SparseConfig:
    """As many floors as there may be solved friction, each held by more than a tick moves it."""
    return building(
        TALL, TALL_SHEARS, k_e_n_per_m=(0.0,), by_mass_per_s=0.5, integrator="cr",
        joints=tuple(Joint(i - 1, i, element) for i in range(MANY)),
    )  # fmt: skip


def rough(n: int) -> Floats:
    """An excitation that makes many floors slip and stop in the same tick."""
    noise = np.random.default_rng(3).standard_normal(n)
    return np.asarray(10.0 * np.sin(0.02 * np.arange(n)) + 6.0 * noise)


@pytest.mark.parametrize("kind", STEEP)
def test_floors_that_slip_all_at_once_cost_the_command_a_limited_amount_of_work(kind: str) -> None:
    """What the limit leaves stays within the friction itself, and the structure has none of it."""
    element, law = STEEP[kind]
    config = tall(element)
    part, work = SparsePart(config), []
    moved, sent = [part.displacements()], []
    ag = rough(1500)
    for one in ag:
        sent.append(part.answer(float(one), 0.0)[0])
        work.append(part.friction_effort())
        assert part.advance() == 0
        moved.append(part.displacements())
    passes, changes, law_cost, settled = np.array(work).T
    # The limit is checked before each element; its two evaluations cost at most 8.
    assert passes.max() == 3
    assert changes.max() <= 8
    assert law_cost.max() < 144 + 8
    assert 0.0 < 1.0 - settled.mean() < 0.05  # the limit is reached, but hardly ever
    x = np.array(moved)
    late = np.abs(np.array(sent) - x[1:, 0])
    assert late[settled == 1].max() < 2e-9
    assert late.max() < 2.0 * 2.4e4 * H * H / 2700.0  # friction of the wrong sign at one floor
    # The equation of motion at t_n, with the velocities of the same instant (cr: x' = v + h q / 2).
    v = np.diff(x, axis=0, prepend=x[:1]) / H
    u, q = 0.5 * (v[1:] + v[:-1]), np.diff(v, axis=0) / H
    slip = np.diff(u, axis=1, prepend=0.0)
    friction = law(slip)
    friction[:, :-1] -= friction[:, 1:]
    c = config.damping_times(np.eye(MANY))
    implicit = TALL + 0.25 * H * H * TALL_SHEARS + 0.5 * H * c
    forces = q @ implicit + v[:-1] @ c + x[:-1] @ TALL_SHEARS + np.outer(ag, np.diag(TALL))
    wrong = np.abs(forces + friction)[1:].max(axis=1) / 2e4
    assert wrong.max() < 2e-5


def test_more_friction_than_is_solved_for_is_evaluated_at_the_previous_velocity() -> None:
    n = lib.RTHYB_SLIDERS_MAX + 1
    m, k = shear_building(np.full(n, 2700.0), np.full(n, 4.7e6))
    element = FRICTION["coulomb"][0]
    many = building(m, k, joints=tuple(Joint(i - 1, i, element) for i in range(n)))
    few = replace(many, joints=many.joints[1:])
    assert (many.struct()[0].sliders, few.struct()[0].sliders) == (0, n - 1)
    at, steep = many.steepest_friction()
    # From the ground, one mass moves with a spring on either side of it; between floors two do.
    assert at > 0
    assert steep == pytest.approx(2.0 * 2000.0 * H / (5e-4 * 2700.0), rel=0.05)


# ---- as a part of a test ------------------------------------------------------------------------


def test_a_saved_part_goes_on_as_if_nothing_had_been() -> None:
    config = building(joints=(Joint(2, 3, BOUC_WEN, K_E), Joint(3, 4, DRY)), **RAYLEIGH)
    one, other = SparsePart(config), SparsePart(config)
    for i in range(500):
        one.step(float(AG[i]), 1e4)
    other.restore(one.save())
    assert one.save() == other.save()
    for i in range(500, 900):
        assert one.step(float(AG[i]), 2e4) == other.step(float(AG[i]), 2e4)
    with pytest.raises(core.CoreError, match="a state of 3 bytes, which does not belong"):
        one.restore(b"abc")


def test_a_saved_part_keeps_what_its_storeys_have_lost() -> None:
    worn = core.element(
        "degradation",
        k_n_per_m=K_E, post_yield_ratio=0.1, a=1.0, b=300.0, c=200.0, eta=1.5, loss=0.6,
        travel_m=0.0, work_j=200.0, amplitude_m=0.01,
    )  # fmt: skip
    config = building(joints=(Joint(2, 3, worn, K_E),), **RAYLEIGH)
    one, other = SparsePart(config), SparsePart(config)
    whole = SparsePart(building(joints=(Joint(2, 3, BOUC_WEN, K_E),), **RAYLEIGH))
    for i in range(500):
        one.step(float(AG[i]), 1e4)
        whole.step(float(AG[i]), 1e4)
    other.restore(one.save())
    found = [one.step(float(AG[i]), 2e4) for i in range(500, 900)]
    assert found == [other.step(float(AG[i]), 2e4) for i in range(500, 900)]
    assert found != [whole.step(float(AG[i]), 2e4) for i in range(500, 900)]


def test_a_path_has_time_stand_still() -> None:
    one = SparsePart(building(**RAYLEIGH))
    for i in range(100):
        one.step(float(AG[i]), 0.0)
    before = one.save()
    one.freeze(1e5)
    assert one.save() == before


def test_settings_come_back_from_a_recording_to_the_last_bit() -> None:
    config = building(
        modal=modal_shapes(M, K, [0.02]),
        damping_n_s_per_m=Symmetric.of(1e-5 * K),
        joints=(Joint(GROUND, 0, BOUC_WEN, K_E),),
        responses=(Response("drift_2", "m", ((1, 1.0), (0, -1.0)), ((0, 2.0),), ((0, 1.0),)),),
        first_x_m=np.linspace(0.0, 1e-3, N),
        rho_inf=0.7,
    )
    again = SparseConfig.of_plain(json.loads(json.dumps(config.plain())))
    one, other = SparsePart(config), SparsePart(again)
    for ag in AG[:300]:
        assert one.step(float(ag), 3e3) == other.step(float(ag), 3e3)
        assert list(one.responses()) == list(other.responses())
    assert one.save() == other.save()


def controller(numerical: SparseConfig) -> core.ControllerConfig:
    return core.ControllerConfig(
        law=core.LawConfig(),
        rfc=core.RfcConfig(K_E, enabled=False),
        motion=core.MotionConfig("cr", mass_kg=1.0, k_e_n_per_m=K_E),
        lead_enabled=False,
        numerical=numerical,
    )


def station(config: SparseConfig, ag: Floats) -> core.StationConfig:
    return core.StationConfig(
        controller(config), tare_ticks=20, ramp_in_ticks=20, path_velocity_m_per_s=10.0,
        path_acceleration_m_per_s2=1e3,
    )  # fmt: skip


def test_a_hold_stops_the_time_of_every_storey() -> None:
    ag = 0.5 * np.sin(np.arange(4000) * 0.02)
    settings = station(building(**RAYLEIGH), ag)
    again = core.StationConfig.of(json.loads(json.dumps(settings.plain())))
    with_hold, without, replayed = (core.Station(one, ag) for one in (settings, settings, again))
    held, straight = course(with_hold, K_E, 1500), course(without, K_E, None)
    assert with_hold.interrupted
    assert min(held.size, straight.size) > 3900
    assert departure(held, straight, 1700) < 1e-3
    assert np.array_equal(course(replayed, K_E, None), straight)
    part, expected = SparsePart(building(**RAYLEIGH)), [0.0]
    for one in ag[:3000]:
        expected.append(part.step(float(one), K_E * expected[-1])[0])
    assert np.abs(straight[:3000]).max() > 1e-4
    assert np.array_equal(straight[:3000], np.array(expected)[1:])


def test_more_than_one_interface_is_not_for_a_controller_of_one_actuator() -> None:
    two = building(interfaces=(((0, 1.0),), ((1, 1.0),)), k_e_n_per_m=(K_E, K_E))
    with pytest.raises(core.CoreError):
        core.Controller(controller(two))
    with pytest.raises(core.CoreError, match="with 2 interfaces"):
        SparsePart(two).joined([], AG, 0)


# ---- senseless readings and settings ------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e13])
@pytest.mark.parametrize("what", ["force", "excitation"])
@pytest.mark.parametrize("joints", [(), (Joint(2, 3, DRY), Joint(3, 4, DRY))])
def test_a_senseless_value_is_told_and_not_taken(
    value: float, what: str, joints: tuple[Joint, ...]
) -> None:
    part = SparsePart(building(joints=joints, **RAYLEIGH))
    good, x = (2e4, 0.3), 0.0
    for i in range(300):
        force, ag = good
        if i % 7 == 3:
            force, ag = (value, ag) if what == "force" else (force, value)
        x, code = part.step(ag, force)
        assert (code != 0) == (i % 7 == 3)
        assert np.isfinite(x)
    expected = SparsePart(building(joints=joints, **RAYLEIGH))
    for _ in range(300):
        last = expected.step(good[1], good[0])[0]
    assert x == last  # the last good value stood in


@pytest.mark.parametrize(
    "joints",
    [(), (Joint(2, 3, BOUC_WEN, K_E),), (Joint(2, 3, DRY), Joint(4, 5, BOUC_WEN, K_E))],
)
def test_a_part_that_runs_off_comes_to_rest_at_the_edge(joints: tuple[Joint, ...]) -> None:
    k = K.copy()
    k[5, 5] -= 2e9
    part = SparsePart(building(k=k, joints=joints, k_e_n_per_m=(0.0,)))
    seen = 0
    for i in range(20000):
        _, code = part.step(1e4 * (-1.0) ** (i // 100), 1e12)
        seen |= code
        assert np.all(np.isfinite(part.displacements()))
    assert seen & core.STATUS["out_of_range"]
    assert np.abs(part.displacements()).max() <= 1e3
    assert np.isfinite(part.look().v)
    assert np.isfinite(part.look().a)


SENSELESS: dict[str, Callable[[Any], object]] = {
    "no degree of freedom": lambda c: setattr(c, "size", 0),
    "too many": lambda c: setattr(c, "size", lib.RTHYB_SPARSE_MAX + 1),
    "no interface": lambda c: setattr(c, "interfaces", 0),
    "nine interfaces": lambda c: setattr(c, "interfaces", 9),
    "elements below none": lambda c: setattr(c, "joints", -1),
    "too many modes": lambda c: setattr(c, "modes", 65),
    "too many responses": lambda c: setattr(c, "responses", 33),
    "no period": lambda c: setattr(c, "period_s", 0.0),
    "period NaN": lambda c: setattr(c, "period_s", np.nan),
    "alpha_f": lambda c: setattr(c, "alpha_f", 0.7),
    "alpha_m": lambda c: setattr(c, "alpha_m", np.inf),
    "gamma": lambda c: setattr(c, "gamma", np.nan),
    "beta": lambda c: setattr(c, "beta", 1e300),
    "Rayleigh": lambda c: setattr(c, "by_mass_per_s", np.nan),
    "mass NaN": lambda c: c.mass_kg.diagonal.__setitem__(3, np.nan),
    "stiffness 1e300": lambda c: c.stiffness_n_per_m.value.__setitem__(0, 1e300),
    "starts below": lambda c: c.stiffness_n_per_m.start.__setitem__(2, -1),
    "starts not at 0": lambda c: c.factor.start.__setitem__(0, 1),
    "place beyond": lambda c: c.stiffness_n_per_m.at.__setitem__(0, N),
    "place below the diagonal": lambda c: c.factor.at.__setitem__(5, 0),
    "panels do not begin at 0": lambda c: c.panel.__setitem__(0, 1),
    "panels end before the last": lambda c: c.panel.__setitem__(c.panels, N - 1),
    "panels end beyond the last": lambda c: c.panel.__setitem__(c.panels, N + 1),
    "a panel of nothing": lambda c: c.panel.__setitem__(1, 0),
    "a panel too wide": lambda c: c.panel.__setitem__(1, 3),
    "fewer than no panels": lambda c: setattr(c, "panels", -1),
    "panels nowhere": lambda c: setattr(c, "panel", ffi.NULL),
    "factor inf": lambda c: c.factor.diagonal.__setitem__(0, np.inf),
    "load": lambda c: c.load_kg.__setitem__(0, np.nan),
    "no load": lambda c: setattr(c, "load_kg", ffi.NULL),
    "no start": lambda c: setattr(c.mass_kg, "start", ffi.NULL),
    "force column": lambda c: c.by_force.__setitem__(1, np.nan),
    "k_e": lambda c: c.k_e_n_per_m.__setitem__(0, np.inf),
    "interface beyond": lambda c: c.interface.at.__setitem__(0, N),
    "interface below": lambda c: c.interface.at.__setitem__(0, -1),
    "response beyond": lambda c: c.response.at.__setitem__(0, N + 3),
    "element on itself": lambda c: setattr(c.joint[0], "below", c.joint[0].above),
    "element beyond": lambda c: setattr(c.joint[0], "above", N),
    "element unknown": lambda c: setattr(c.joint[0].element, "kind", 99),
    "element stiffness": lambda c: setattr(c.joint[0], "stiffness_n_per_m", np.nan),
    "no elements": lambda c: setattr(c, "joint", ffi.NULL),
    "start x": lambda c: c.first_x.__setitem__(0, np.nan),
    "half a start": lambda c: setattr(c, "first_v", ffi.NULL),
    "runs off at once": lambda c: c.first_v.__setitem__(0, 1e12),
    "modal": lambda c: c.modal.__setitem__(0, np.nan),
    "too many sliders": lambda c: setattr(c, "sliders", lib.RTHYB_SLIDERS_MAX + 1),
    "fewer than no sliders": lambda c: setattr(c, "sliders", -1),
    "sliders nowhere": lambda c: setattr(c, "slider", ffi.NULL),
    "slider beyond": lambda c: c.slider.__setitem__(0, 2),
    "slider that is no friction": lambda c: c.slider.__setitem__(0, 0),
    "slider response": lambda c: c.slider_w.__setitem__(N - 1, np.inf),
    "slider velocity": lambda c: c.slider_g.__setitem__(0, np.nan),
    "slider velocity negative": lambda c: c.slider_g.__setitem__(0, -1.0),
    "slider interface": lambda c: setattr(c, "slider_x", ffi.NULL),
}


@pytest.mark.parametrize("fault", SENSELESS)
def test_senseless_settings_are_refused_before_anything_runs(fault: str) -> None:
    config = building(
        joints=(Joint(1, 2, BOUC_WEN, K_E), Joint(3, 4, DRY)),
        responses=(Response("roof", "m", ((N - 1, 1.0),)),),
        modal=modal_shapes(M, K, [0.02]),
        first_x_m=np.zeros(N),
    )
    settings, kept = config.struct()
    assert kept
    mutable = ffi.new("rthyb_sparse_config *", settings[0])
    state = ffi.new("double[]", 4096)
    part = ffi.new(
        "rthyb_numerical *",
        {"kind": lib.RTHYB_NUMERICAL_SPARSE, "cfg": mutable, "state": state},
    )
    assert lib.rthyb_numerical_init(part, 0.0) == 0
    assert lib.rthyb_numerical_init(part, 0.1) == lib.RTHYB_E_LIMIT
    _writable(mutable)
    SENSELESS[fault](mutable)
    assert lib.rthyb_numerical_init(part, 0.0) != 0


def _writable(settings: Any) -> None:
    """Have every array that a fault may be written into be one of its own."""
    for path, count in (
        ("mass_kg.diagonal", N), ("stiffness_n_per_m.value", N), ("stiffness_n_per_m.start", N + 1),
        ("stiffness_n_per_m.at", N), ("factor.start", N + 1), ("factor.at", N),
        ("factor.diagonal", N), ("load_kg", N), ("by_force", N), ("k_e_n_per_m", 1),
        ("interface.at", 1), ("response.at", 1), ("panel", settings.panels + 1),
        ("first_x", N), ("first_v", N), ("modal", N), ("slider", 1), ("slider_w", N),
        ("slider_g", 1),
    ):  # fmt: skip
        *above, name = path.split(".")
        owner = settings
        for part in above:
            owner = getattr(owner, part)
        old = getattr(owner, name)
        kind = "int32_t[]" if "int" in ffi.typeof(old).cname else "double[]"
        own = ffi.new(kind, [old[i] for i in range(count)])
        _KEPT.append(own)
        setattr(owner, name, own)


_KEPT: list[Any] = []


def test_a_structure_that_nothing_holds_and_that_weighs_nothing_is_refused() -> None:
    m = M.copy()
    m[4, 4] = 0.0
    with pytest.raises(core.CoreError, match="some motion has neither mass nor stiffness"):
        SparsePart(building(m, k=np.diag(np.where(np.arange(N) == 4, 0.0, np.diag(K)))))
    with pytest.raises(core.CoreError, match="singular"):
        SparsePart(building(m, integrator="central-difference"))


# ---- against OpenSees ---------------------------------------------------------------------------


def frame_in_opensees(ops: Any, storeys: int, bays: int) -> int:
    """A plane frame with mass in all three directions of every node; how many nodes move."""
    ops.wipe()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    for s in range(storeys + 1):
        for b in range(bays + 1):
            tag = 100 * s + b + 1
            ops.node(tag, 6.0 * b - 0.5 * b * b, 3.2 * s)
            if s:
                ops.mass(tag, 2e4, 2e4, 3e3)
            else:
                ops.fix(tag, 1, 1, 1)
    ops.geomTransf("Linear", 1)
    element = 1
    for s in range(1, storeys + 1):
        for b in range(bays + 1):
            ops.element("elasticBeamColumn", element, 100 * s - 99 + b, 100 * s + b + 1, 0.02, 2e11,
                        4e-4, 1)  # fmt: skip
            element += 1
        for b in range(bays):
            ops.element("elasticBeamColumn", element, 100 * s + b + 1, 100 * s + b + 2, 0.01, 2e11,
                        3e-4, 1)  # fmt: skip
            element += 1
    return storeys * (bays + 1)


@pytest.mark.parametrize(
    ("integrator", "rho_inf", "most"),
    [
        (("KRAlphaExplicit", 1.0), 1.0, 1e-10),
        (("KRAlphaExplicit", 0.5), 0.5, 1e-10),
        (("Newmark", 0.5, 0.25), 1.0, 1e-3),
    ],
)
def test_every_degree_of_freedom_is_where_opensees_has_it(
    integrator: tuple[Any, ...], rho_inf: float, most: float
) -> None:
    ops = opensees()
    storeys, bays, steps = 6, 2, 20 * 1024
    n = 3 * frame_in_opensees(ops, storeys, bays)
    a, b = 0.4, 3e-4
    ops.rayleigh(a, 0.0, b, 0.0)  # by the initial stiffness
    ag = 2.0 * np.sin(9.0 * np.arange(steps + 1) * H) * np.sin(np.arange(steps + 1) * H / 3.0)
    ops.timeSeries("Path", 1, "-dt", H, "-values", *ag.tolist())
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    matrices, place = [], []

    def prepare(*integrator: object) -> None:
        ops.wipeAnalysis()
        for command, kind in (
            ("constraints", "Plain"), ("numberer", "Plain"), ("system", "FullGeneral"),
            ("algorithm", "Linear"),
        ):  # fmt: skip
            getattr(ops, command)(kind)
        ops.integrator(*integrator)
        ops.analysis("Transient")

    for which in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        prepare("GimmeMCK", *which)
        ops.analyze(1, 0.0)
        matrices.append(np.array(ops.printA("-ret")).reshape(n, n))
        place = [
            (tag, d) for tag in ops.getNodeTags() for d in range(3) if ops.nodeDOFs(tag)[d] >= 0
        ]
        place.sort(key=lambda one: ops.nodeDOFs(one[0])[one[1]])
    ops.setTime(0.0)
    prepare(*integrator)
    expected = np.zeros((steps, n))
    for i in range(1, steps):
        assert ops.analyze(1, H) == 0
        expected[i] = [ops.nodeDisp(tag, d + 1) for tag, d in place]
    ops.wipe()
    m, k = matrices
    k = 0.5 * (k + k.T)
    influence = np.array([1.0 if d == 0 else 0.0 for _, d in place])
    config = SparseConfig(
        Symmetric.of(m), Symmetric.of(k), m @ influence, (((0, 1.0),),), (0.0,), by_mass_per_s=a,
        by_stiffness_s=b, rho_inf=rho_inf,
    )  # fmt: skip
    part, found = SparsePart(config), np.zeros((steps, n))
    for i in range(steps):
        found[i] = part.displacements()
        part.step(float(ag[i]), 0.0)
    assert worst(found, expected) < most
    print(f"largest difference of any degree of freedom {worst(found, expected):.2g} of its peak")


def test_a_yielding_storey_of_ten_moves_as_in_opensees() -> None:
    ops = opensees()
    n, steps, by_mass_per_s = 10, 8 * 1024, 0.3
    ag = 3.0 * np.sin(6.0 * np.arange(steps + 1) * H) * np.exp(-0.2 * np.arange(steps + 1) * H)
    ops.wipe()
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.uniaxialMaterial("Elastic", 1, K_E)
    ops.uniaxialMaterial("BoucWen", 2, 0.05, K_E, 1.0, 100.0, 100.0, 1.0, 0.0, 0.0, 0.0)
    ops.node(0, 0.0)
    ops.fix(0, 1)
    for storey in range(1, n + 1):
        ops.node(storey, 0.0)
        ops.mass(storey, 2e4)
        ops.element("zeroLength", storey, storey - 1, storey, "-mat", 2 if storey == 3 else 1,
                    "-dir", 1)  # fmt: skip
    ops.rayleigh(by_mass_per_s, 0.0, 0.0, 0.0)
    ops.timeSeries("Path", 1, "-dt", H, "-values", *ag.tolist())
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("FullGeneral")
    ops.test("NormUnbalance", 1e-3, 50)
    ops.algorithm("Newton")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    expected = np.zeros((steps, n))
    for i in range(1, steps):
        assert ops.analyze(1, H) == 0
        expected[i] = [ops.nodeDisp(storey, 1) for storey in range(1, n + 1)]
    ops.wipe()
    stiffness_n_per_m = K_E * np.ones(n)
    stiffness_n_per_m[2] = 0.0
    m, k = shear_building(2e4 * np.ones(n), stiffness_n_per_m)
    part = SparsePart(
        SparseConfig(
            Symmetric.of(m), Symmetric.of(k), np.diag(m).copy(), (((0, 1.0),),), (0.0,),
            by_mass_per_s=by_mass_per_s, joints=(Joint(1, 2, BOUC_WEN, K_E),),
        )
    )  # fmt: skip
    found = np.zeros((steps, n))
    for i in range(steps):
        found[i] = part.displacements()
        part.step(float(ag[i]), 0.0)
    drift = expected[:, 2] - expected[:, 1]
    assert np.abs(drift).max() > 2.0 * 0.005  # far beyond yielding
    assert worst(found, expected) < 0.01
    print(f"largest difference of any storey {100 * worst(found, expected):.3f} % of its peak")
