"""Numerical parts of several degrees of freedom: against exact solutions, written again in numpy,
through the controller with hold and resume, and with senseless readings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from courses import course, departure
from kernels import Floats

from rthyb_rt import core
from rthyb_rt.core.numerical_parts import DensePart

# The benchmark's frame (Silva et al. 2020), case 4, whole.
K = 1e7 * np.array(
    [
        [2.6054884, -2.3133939, 0.5937035],
        [-2.3133939, 3.2560774, -1.4419971],
        [0.5937035, -1.4419971, 0.9267276],
    ]
)
M = 1000.0 * np.eye(3)
SPECIMEN = (29.13, 114.2, 1.19e6)
FS_HZ = 4096.0


def modal_damping(m: Floats, k: Floats, ratio: float) -> Floats:
    w2, phi = scipy.linalg.eigh(k, m)
    c: Floats = m @ phi @ np.diag(2.0 * ratio * np.sqrt(w2)) @ phi.T @ m
    return c


C = modal_damping(M, K, 0.03)


def rows(a: Floats) -> core.Matrix:
    return tuple(tuple(float(v) for v in row) for row in a)


def frame(integrator: Any, *, taken_out: bool = False, **settings: Any) -> core.DenseConfig:
    """The frame at 4096 Hz, whole or without its specimen at the first storey."""
    m, c, k = M.copy(), C.copy(), K.copy()
    if taken_out:
        for matrix, own in zip((m, c, k), SPECIMEN, strict=True):
            matrix[0, 0] -= own
        known = zip(
            ("specimen_mass_kg", "specimen_damping_n_s_per_m", "k_e_n_per_m"),
            SPECIMEN,
            strict=True,
        )
        settings = dict(known) | settings
    load = tuple(float(v) for v in M.sum(axis=1))
    period_s = settings.pop("period_s", 1.0 / FS_HZ)
    return core.DenseConfig(
        integrator, rows(m), rows(c), rows(k), load, period_s=period_s, **settings
    )


def system(config: core.DenseConfig) -> tuple[Floats, Floats, Floats]:
    """x' = A x + b_f force + b_a ag of the part."""
    m, c, k = (
        np.array(getattr(config, name))
        for name in ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")
    )
    n = len(m)
    inverse = np.linalg.inv(m)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ k, -inverse @ c]])
    unit = np.eye(n)[config.at]
    zero = np.zeros(n)
    by_force = np.concatenate([zero, -inverse @ unit])
    return a, by_force, np.concatenate([zero, -inverse @ np.array(config.load_kg)])


def run(config: core.DenseConfig, ag: Floats, force: Floats) -> Floats:
    part = DensePart(config)
    out = np.zeros((ag.size, len(config.load_kg)))
    for n in range(ag.size):
        x, code = part.step(ag[n], force[n])
        assert code == 0
        out[n] = part.displacements()
        assert out[n, config.at] == x
    return out


def exactly(config: core.DenseConfig, ag: Floats, force: Floats) -> Floats:
    """Displacements at t_n+1 with both inputs held, by the matrix exponential."""
    a, by_force, by_ag = system(config)
    n = a.shape[0]
    augmented = np.zeros((n + 2, n + 2))
    augmented[:n, :n], augmented[:n, n], augmented[:n, n + 1] = a, by_force, by_ag
    step = scipy.linalg.expm(augmented * config.period_s)
    s, out = np.zeros(n), np.zeros((ag.size, n // 2))
    for i in range(ag.size):
        s = step[:n, :n] @ s + step[:n, n] * force[i] + step[:n, n + 1] * ag[i]
        out[i] = s[: n // 2]
    return out


def cr_again(config: core.DenseConfig, ag: Floats, force: Floats) -> Floats:
    """Chen & Ricles (2008) as printed, with many degrees of freedom."""
    m, c, k = (
        np.array(getattr(config, name))
        for name in ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")
    )
    unit, h = np.eye(len(m))[config.at], config.period_s
    place = np.outer(unit, unit)
    m_hat = m + config.specimen_mass_kg * place
    c_hat = c + config.specimen_damping_n_s_per_m * place
    k_hat = k + config.k_e_n_per_m * place
    alpha = np.linalg.solve(4.0 * m_hat + 2.0 * h * c_hat + h * h * k_hat, 4.0 * m_hat)
    x, v = np.zeros(len(m)), np.zeros(len(m))
    out = np.zeros((ag.size, len(m)))
    for i in range(ag.size):
        load = -np.array(config.load_kg) * ag[i] - unit * force[i]
        acceleration = np.linalg.solve(m, load - c @ v - k @ x)
        x = x + h * v + h * h * alpha @ acceleration
        v = v + h * alpha @ acceleration
        out[i] = x
    return out


def rk4_again(config: core.DenseConfig, ag: Floats, force: Floats) -> Floats:
    """The classical method, stage by stage."""
    a, by_force, by_ag = system(config)
    h, s, out = config.period_s, np.zeros(len(a)), np.zeros((ag.size, len(a) // 2))
    for i in range(ag.size):
        late = i - config.force_delay
        held = by_force * (force[late] if late >= 0 else 0.0) + by_ag * ag[i]
        k1 = a @ s + held
        k2 = a @ (s + 0.5 * h * k1) + held
        k3 = a @ (s + 0.5 * h * k2) + held
        k4 = a @ (s + h * k3) + held
        s = s + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        out[i] = s[: out.shape[1]]
    return out


@pytest.fixture(scope="module")
def inputs() -> tuple[Floats, Floats]:
    random = np.random.default_rng(3)
    return random.normal(size=8192), 500.0 * random.normal(size=8192)


@pytest.mark.parametrize(
    ("integrator", "again", "settings"),
    [
        ("cr", cr_again, {}),
        ("cr", cr_again, {"at": 1}),
        ("rk4", rk4_again, {}),
        ("rk4", rk4_again, {"at": 2}),
        ("rk4", rk4_again, {"force_delay": 1}),
    ],
)
def test_integrator_equals_its_formulas_written_again(
    integrator: str, again: Any, settings: dict[str, int], inputs: tuple[Floats, Floats]
) -> None:
    config = frame(integrator, taken_out=True, **settings)
    expected = again(config, *inputs)
    found = run(config, *inputs)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_one_degree_of_freedom_is_what_it_has_always_been() -> None:
    mass, damping, stiffness, k_e = 4220.0, 2121.0, 1e5, 666400.0
    old = core.Motion(core.MotionConfig("cr", mass, damping, stiffness, k_e))
    new = DensePart(
        core.DenseConfig("cr", ((mass,),), ((damping,),), ((stiffness,),), (mass,), k_e_n_per_m=k_e)
    )
    ag = np.random.default_rng(5).normal(size=20000)
    x = np.zeros(ag.size + 1)
    for n in range(ag.size):
        force = 0.9 * k_e * x[n]
        x[n + 1], _ = old.step(ag[n], force)
        again, _ = new.step(ag[n], force)
        assert abs(again - x[n + 1]) <= 1e-13 * np.abs(x).max() + 1e-18


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_free_vibration_of_each_mode_is_the_exact_one(mode: int) -> None:
    # From rest, two seconds of a resonant push, then six of freedom.
    config = frame("rk4")
    w2, _ = scipy.linalg.eigh(K, M)
    t = np.arange(int(8 * FS_HZ)) / FS_HZ
    force = np.where(t < 2.0, 100.0 * np.sin(np.sqrt(w2[mode]) * t), 0.0)
    expected = exactly(config, np.zeros(t.size), force)
    found = run(config, np.zeros(t.size), force)
    # By the amplitude errors of the highest mode that is in it: (w h)^5 / 120 a step.
    tolerance = {0: 1e-8, 1: 1e-7, 2: 1e-5}[mode] * 8.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def pulse(t: Floats) -> Floats:
    """A smooth push of half a second."""
    return np.where(t < 0.5, 1000.0 * np.sin(2.0 * np.pi * t) ** 4, 0.0)


def test_the_error_of_rk4_falls_with_the_fourth_power_of_the_step() -> None:
    errors = []
    for fs_hz in (256, 512, 1024):
        config = frame("rk4", period_s=1.0 / fs_hz)
        n = np.arange(2 * fs_hz)
        # Held as the integrator holds it, and ended at an instant that all rates have.
        force = np.where(n < fs_hz, 1000.0, 0.0)
        expected = exactly(config, np.zeros(n.size), force)
        found = run(config, np.zeros(n.size), force)
        errors.append(np.abs(found - expected)[-fs_hz // 2 :, 0].max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.25)


def test_the_error_of_cr_falls_with_the_square_of_the_step() -> None:
    errors = []
    for fs_hz in (512, 1024, 2048):
        config = frame("cr", period_s=1.0 / fs_hz)
        times = fs_hz // 16  # finer: the exact solution with the force of each interval's middle
        finer = replace(config, period_s=config.period_s / 16)
        fine = (np.arange(32 * fs_hz) + 0.5) * finer.period_s
        expected = exactly(finer, np.zeros(fine.size), pulse(fine))[15::16]
        force = pulse(np.arange(2 * fs_hz) / fs_hz)
        found = run(config, np.zeros(force.size), force)
        errors.append(np.abs(found - expected)[times:].max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.2)


def test_energy_of_an_undamped_frame_stays() -> None:
    undamped = replace(frame("cr"), damping_n_s_per_m=rows(np.zeros((3, 3))))
    part = DensePart(undamped)
    peaks = []
    for n in range(60 * 4096):
        x, _ = part.step(0.0, 1000.0 if n < 400 else 0.0)
        peaks.append(abs(x))
    quarters = np.array(peaks[400:]).reshape(-1, len(peaks[400:]) // 4)[:, :].max(axis=1)
    assert quarters[-1] == pytest.approx(quarters[0], rel=2e-2)


@pytest.mark.parametrize("stiffer", [1.0, 1e3, 1e6])
def test_cr_stays_stable_whatever_the_step(stiffer: float) -> None:
    config = replace(frame("cr"), stiffness_n_per_m=rows(stiffer * K))
    part = DensePart(config)
    for n in range(20000):
        x, code = part.step(1.0 if n < 100 else 0.0, 0.0)
        assert code == 0
    assert abs(x) < 1.0


def test_what_was_saved_goes_on_as_if_nothing_had_happened(inputs: tuple[Floats, Floats]) -> None:
    part, other = DensePart(frame("rk4")), DensePart(frame("rk4"))
    for ag, force in zip(*(one[:500] for one in inputs), strict=True):
        part.step(ag, force)
    other.restore(part.save())
    for ag, force in zip(*(one[500:1000] for one in inputs), strict=True):
        assert part.step(ag, force) == other.step(ag, force)
    with pytest.raises(core.CoreError, match="of 3 bytes"):
        other.restore(b"abc")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("integrator", ["cr", "rk4"])
def test_a_senseless_force_or_excitation_is_not_taken(integrator: str, bad: float) -> None:
    part, good = (DensePart(frame(integrator, taken_out=True)) for _ in range(2))
    for n in range(2000):
        wrong = n % 7 == 3
        x, code = part.step(bad if wrong and n % 2 else 0.5, bad if wrong and not n % 2 else 300.0)
        expected, _ = good.step(0.5, 300.0)
        assert x == expected
        wanted = core.STATUS["out_of_range" if np.isfinite(bad) else "not_finite"]
        assert code == (wanted if wrong else 0)


def test_a_part_that_grows_ends_at_the_edge_of_what_is_sensible() -> None:
    config = replace(frame("rk4"), stiffness_n_per_m=rows(-K))
    part = DensePart(config)
    codes = set()
    for _ in range(4000):
        x, code = part.step(1.0, 0.0)
        codes.add(code)
        assert np.isfinite(part.displacements()).all()
        assert abs(x) <= 1e3
    assert core.STATUS["out_of_range"] in codes


@pytest.mark.parametrize(
    "changed",
    [
        {"mass_kg": rows(np.diag([1000.0, 0.0, 1000.0]))},
        {"mass_kg": rows(np.diag([1000.0, -5.0, 1000.0]))},
        {"mass_kg": rows(np.full((3, 3), 5.0))},
        {"stiffness_n_per_m": rows(np.triu(K))},
        {"stiffness_n_per_m": rows(K * np.nan)},
        {"damping_n_s_per_m": rows(np.full((3, 3), np.inf))},
        {"load_kg": (1.0, np.nan, 1.0)},
        {"at": 3},
        {"at": -1},
        {"force_delay": 2},
        {"period_s": 0.0},
        {"k_e_n_per_m": -1.0},
    ],
)
def test_a_part_that_means_nothing_is_refused(changed: dict[str, Any]) -> None:
    with pytest.raises(core.CoreError):
        DensePart(replace(frame("cr"), **changed))


@pytest.mark.parametrize("n", [0, 9])
def test_a_part_of_another_size_is_refused(n: int) -> None:
    square = rows(np.eye(n)) if n else ()
    with pytest.raises(core.CoreError, match="the same size, from 1 to 8"):
        DensePart(core.DenseConfig("cr", square, square, square, (1.0,) * n))


# --- behind the controller -----------------------------------------------------------------------


def controller(numerical: core.DenseConfig, **settings: Any) -> core.ControllerConfig:
    h = numerical.period_s
    return core.ControllerConfig(
        law=core.LawConfig(),
        rfc=core.RfcConfig(k_e_n_per_m=SPECIMEN[2], enabled=False),
        motion=core.MotionConfig("cr", mass_kg=1000.0, period_s=h),
        lead_enabled=False,
        period_s=h,
        numerical=numerical,
        **settings,
    )


def test_the_controller_moves_the_interface_as_the_part_says(
    inputs: tuple[Floats, Floats],
) -> None:
    config = frame("rk4", taken_out=True, force_delay=1)
    one, part = core.Controller(controller(config)), DensePart(config)
    for ag, force in zip(*(v[:2000] for v in inputs), strict=True):
        expected, _ = part.step(ag, force)
        assert one.step(one.x_cmd_m, force, ag).x_cmd_next_m == expected


def test_a_prescribed_motion_has_no_numerical_part() -> None:
    config = replace(
        controller(frame("cr")), motion=core.MotionConfig("prescribed", period_s=1.0 / FS_HZ)
    )
    one = core.Controller(config)
    assert one.step(0.0, 0.0, 0.003).x_cmd_next_m == 0.003


def station(config: core.DenseConfig, ag: Floats) -> core.Station:
    settings = core.StationConfig(
        controller=controller(config), tare_ticks=20, ramp_in_ticks=20, path_velocity_m_per_s=10.0,
        path_acceleration_m_per_s2=1e3,
    )  # fmt: skip
    return core.Station(settings, ag)


def test_a_hold_stops_the_time_of_every_storey() -> None:
    config = frame("rk4", taken_out=True, force_delay=1, period_s=core.PERIOD_S)
    ag = 0.5 * np.sin(np.arange(4000) * 0.02)
    with_hold, without = station(config, ag), station(config, ag)
    held, straight = (
        course(one, SPECIMEN[2], at) for one, at in ((with_hold, 1500), (without, None))
    )
    assert with_hold.interrupted
    assert not without.interrupted
    assert min(held.size, straight.size) > 3900
    assert departure(held, straight, 1700) < 1e-3


def test_a_recording_knows_the_part_again() -> None:
    settings = core.StationConfig(controller=controller(frame("cr", taken_out=True)))
    import json

    assert core.StationConfig.of(json.loads(json.dumps(settings.plain()))) == settings
