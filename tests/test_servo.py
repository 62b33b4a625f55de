"""Actuator models: against scipy.signal for the linear ones, and against the servo-hydraulic
equations written again and solved by scipy.integrate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from kernels import FS_HZ, HYDRAULIC, K_PLATE, Floats, H, rms, smooth_motion, time_s

from rthyb_rt import core


def measured(command: Floats, **servo: Any) -> Floats:
    x, _ = core.VirtualRig(core.RigConfig(core.ServoConfig(**servo))).run(command)
    return x


def later(x: Floats, samples: int) -> Floats:
    return np.concatenate([np.zeros(samples), x])[: x.size]


# --- linear actuators ----------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [0, 1, 10, 17, 1024])
def test_pure_delay_gives_the_command_of_d_samples_ago(samples: int) -> None:
    command = np.random.default_rng(1).normal(scale=1e-3, size=3000)
    found = measured(command, kind="pure-delay", delay_samples=samples)
    np.testing.assert_array_equal(found, later(command, samples))


def test_first_order_lag_is_the_papers_plant_of_section_4_1() -> None:
    command = np.random.default_rng(2).normal(scale=1e-3, size=500)
    found = measured(command, kind="first-order", roll_off_hz=31.42 / (2 * np.pi))
    discrete = scipy.signal.cont2discrete(([31.42], [1.0, 31.42]), H, "zoh")
    np.testing.assert_allclose(discrete[1], [1.0, -0.9698], atol=5e-5)
    np.testing.assert_allclose(np.ravel(discrete[0]), [0.0, 0.03022], atol=5e-6)
    expected = scipy.signal.lfilter(np.ravel(discrete[0]), discrete[1], command)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-16)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("samples", [0, 1, 7])
def test_first_order_lag_with_transport_is_scipys_lag_of_the_delayed_command(
    hold: str, samples: int
) -> None:
    command = smooth_motion(1.0, 3)
    found = measured(command, kind="first-order", roll_off_hz=8.0, delay_samples=samples, hold=hold)
    lag = scipy.signal.lti([16 * np.pi], [1.0, 16 * np.pi])
    expected = dense_response(lag, command, float(samples), hold)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def dense_response(
    system: Any, command: Floats, delay_samples: float, hold: str, parts: int = 16
) -> Floats:
    """scipy's exact response on a grid of 16 instants a sample, read at the samples.

    Exact as long as the delay is a multiple of the grid: the command bends at its instants alone.

    Row n of the command acts from t_n on: held (zoh), or run up to from the one before (foh).
    """
    assert (delay_samples * parts).is_integer()
    fine = np.arange(command.size * parts) / parts - delay_samples
    padded = np.concatenate([np.zeros(2), command])
    if hold == "zoh":
        index = np.floor(fine + 1e-9).astype(int)
        u = padded[np.maximum(index, -1) + 2]
    else:
        u = np.interp(fine, np.arange(command.size) + 1.0, command, left=0.0)
        begin = (fine > 0.0) & (fine < 1.0)
        u[begin] = command[0] * fine[begin]
    state = system.to_ss()
    a, b, c, d, _ = scipy.signal.cont2discrete(
        (state.A, state.B, state.C, state.D), H / parts, hold
    )
    y = np.asarray(scipy.signal.dlsim((a, b, c, d, H / parts), u)[1])[:, 0]
    return y[::parts]


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("delay_samples", [0.0, 1.0, 0.25, 3.6875])
@pytest.mark.parametrize(
    ("frequency_hz", "zeta"), [(29.8, 0.896), (15.0, 0.3), (15.0, 1.0), (15.0, 2.5), (40.0, 0.0)]
)
def test_second_order_actuator_with_a_fractional_delay_is_scipys(
    hold: str, delay_samples: float, frequency_hz: float, zeta: float
) -> None:
    w, gain = 2 * np.pi * frequency_hz, 0.97
    command = smooth_motion(0.5, 4)
    command[100:] += 0.002  # and a step in it
    found = measured(
        command,
        kind="second-order",
        natural_frequency_hz=frequency_hz,
        damping_ratio=zeta,
        gain=gain,
        delay_samples=delay_samples,
        hold=hold,
    )
    system = scipy.signal.lti([gain * w**2], [1.0, 2 * zeta * w, w**2])
    expected = dense_response(system, command, delay_samples, hold)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.max(np.abs(expected)))


# --- the servo-hydraulic actuator ----------------------------------------------------------------


def hydraulic_by_scipy(command: Floats, hold: str, k_specimen: float, **change: Any) -> Any:
    """The same physics as a set of differential equations, one solve_ivp a sample.

    Returns displacement and force of the oil column at the samples. The oil column's force and the
    piston's velocity decide each other: q = u sqrt(1 - s F / F_stall), F = a + c q, solved for the
    root exactly.
    """
    p = HYDRAULIC | change
    k, c, stall = p["oil_stiffness_n_per_m"], p["oil_damping_n_s_per_m"], p["stall_force_n"]

    def oil(y: Floats) -> tuple[float, float]:
        x, v, piston, valve = y[:4]
        valve = min(max(valve, -p["flow_limit_m_per_s"]), p["flow_limit_m_per_s"])
        sign, a = np.copysign(1.0, valve), k * (piston - x) - c * v
        b = c * abs(valve)
        root = b * b + 4.0 * stall * (stall - sign * a)
        opening = (np.sqrt(root) - b) / (2.0 * stall) if root > b * b else 0.0
        flow = valve * min(opening, np.sqrt(2.0))
        return a + c * flow, flow

    def slope(t: float, y: Floats, start: float, end: float) -> list[float]:
        force, flow = oil(y)
        x, v, _, valve, integral = y
        error = start + (end - start) * t / H - x
        wanted = p["kp_per_s"] * error + p["ki_per_s2"] * integral
        friction = p["friction_n"] * np.tanh(v / p["friction_width_m_per_s"])
        net = force - k_specimen * x - friction - p["viscous_n_s_per_m"] * v
        mass = p["moving_mass_kg"]
        return [v, net / mass, flow, (wanted - valve) / p["valve_time_constant_s"], error]

    y = np.zeros(5)
    x, f = np.zeros_like(command), np.zeros_like(command)
    transport = int(p["delay_samples"])
    late = later(command, transport)
    for n in range(command.size):
        x[n], f[n] = y[0], oil(y)[0]
        start = (late[n - 1] if n > 0 else 0.0) if hold == "foh" else late[n]
        solution = scipy.integrate.solve_ivp(
            slope, (0.0, H), y, "RK45", args=(start, late[n]), rtol=1e-7, atol=1e-10
        )
        y = solution.y[:, -1]
    return x, f


def hydraulic(command: Floats, k_specimen: float = K_PLATE, **change: Any) -> Any:
    specimen = (core.element("stiffness", k_n_per_m=k_specimen),)
    servo = core.ServoConfig(**(HYDRAULIC | change))
    return core.VirtualRig(core.RigConfig(servo, specimen)).run(command)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_servo_hydraulic_actuator_is_its_equations_solved_by_scipy(hold: str) -> None:
    command = smooth_motion(0.4, 5, peak_m=0.006)
    x_exact, f_exact = hydraulic_by_scipy(command, hold, K_PLATE)
    errors = []
    for substeps in (16, 64):
        x, f = hydraulic(command, hold=hold, substeps=substeps)
        errors.append(rms(x - x_exact) / rms(x_exact))
        assert rms(f - f_exact) < 0.02 * rms(f_exact)
    assert errors[0] < 0.005
    assert errors[1] < 0.4 * errors[0]


def test_flow_limit_and_stall_force_bound_the_actuator_as_by_scipy() -> None:
    command = np.full(220, 0.02)  # a step: the valve opens fully
    change = {"flow_limit_m_per_s": 0.15, "stall_force_n": 9000.0}
    x, f = hydraulic(command, substeps=64, **change)
    x_exact, f_exact = hydraulic_by_scipy(command, "zoh", K_PLATE, **change)
    assert rms(x - x_exact) < 0.005 * rms(x_exact)
    assert np.max(np.diff(x)) * FS_HZ <= 0.15 * 1.3
    assert rms(f - f_exact) < 0.02 * rms(f_exact)
    assert 8500.0 < f[-1] < 9050.0


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_halving_the_substeps_changes_the_response_by_less_than_a_thousandth(hold: str) -> None:
    command = smooth_motion(10.0, 6, peak_m=0.006)
    sixteen, _ = hydraulic(command, hold=hold, substeps=16)
    eight, _ = hydraulic(command, hold=hold, substeps=8)
    assert rms(eight - sixteen) < 1e-3 * rms(sixteen)


def test_identified_delay_of_the_papers_rig_is_17_samples() -> None:
    t = time_s(10.0)
    command = 0.002 * np.sin(2 * np.pi * 2.0 * t)
    x, _ = hydraulic(command)
    steady = slice(5 * 1024, 10 * 1024)
    turn = np.exp(-2j * np.pi * 2.0 * t[steady])
    ratio = np.sum(x[steady] * turn) / np.sum(command[steady] * turn)
    assert -np.angle(ratio) / (2 * np.pi * 2.0) * FS_HZ == pytest.approx(17.0, abs=0.3)
    assert abs(ratio) == pytest.approx(0.98, abs=0.01)


def test_integral_action_brings_the_table_onto_a_held_command() -> None:
    x, f = hydraulic(np.full(60 * 1024, 0.004), friction_n=0.0)
    assert x[-1] == pytest.approx(0.004, rel=1e-3)
    assert f[-1] == pytest.approx(K_PLATE * x[-1], rel=1e-3)


def test_mass_of_the_specimen_rides_on_the_table() -> None:
    command = smooth_motion(2.0, 7, peak_m=0.004)
    plate = core.element("stiffness", k_n_per_m=K_PLATE)
    heavy_table, _ = hydraulic(command, moving_mass_kg=145.0)
    on_specimen = core.VirtualRig(
        core.RigConfig(core.ServoConfig(**HYDRAULIC), (plate, core.element("inertia", m_kg=100.0)))
    )
    x, _ = on_specimen.run(command)
    np.testing.assert_array_equal(x, heavy_table)


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "servo",
    [
        {"kind": "pure-delay", "delay_samples": -1},
        {"kind": "pure-delay", "delay_samples": 1.5},
        {"kind": "pure-delay", "delay_samples": core.DELAY_MAX + 1},
        {"kind": "pure-delay", "delay_samples": np.nan},
        {"kind": "pure-delay", "period_s": 0.0},
        {"kind": "pure-delay", "period_s": np.nan},
        {"kind": "first-order", "roll_off_hz": 0.0},
        {"kind": "first-order", "roll_off_hz": -5.0},
        {"kind": "first-order", "roll_off_hz": np.inf},
        {"kind": "first-order", "roll_off_hz": 5.0, "delay_samples": 0.5},
        {"kind": "second-order", "natural_frequency_hz": 0.0},
        {"kind": "second-order", "natural_frequency_hz": 5.0, "damping_ratio": -0.1},
        {"kind": "second-order", "natural_frequency_hz": 5.0, "gain": np.nan},
        {"kind": "second-order", "natural_frequency_hz": np.nan},
    ],
    ids=str,
)
def test_actuator_setting_out_of_range_is_refused(servo: dict[str, Any]) -> None:
    with pytest.raises(core.CoreError):
        core.VirtualRig(core.RigConfig(core.ServoConfig(**servo)))


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", [name for name in HYDRAULIC if name != "kind"])
def test_hydraulic_setting_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(core.CoreError):
        core.VirtualRig(core.RigConfig(core.ServoConfig(**(HYDRAULIC | {name: value}))))


@pytest.mark.parametrize("substeps", [0, 4097])
def test_substeps_out_of_range_are_refused(substeps: int) -> None:
    with pytest.raises(core.CoreError):
        core.VirtualRig(core.RigConfig(core.ServoConfig(**HYDRAULIC, substeps=substeps)))
