"""The virtual rig of several axes: one axis as the rig of one, two against scipy, a plant against
its equations, pins and virtual work, sensors of each axis, and commands that are none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from kernels import Floats

from rthyb_rt import config as config_module
from rthyb_rt import core
from rthyb_rt.core import CoreError, ElementConfig, RigConfig, SensorConfig, ServoConfig, element
from rthyb_rt.core.coupled_rig import CoupledRig, CoupledRigConfig, StateSpace, held_step
from rthyb_rt.core.kinematics import Kinematics, Pin
from rthyb_rt.core.library import STATUS
from rthyb_rt.lab import axes_rig

H = 1.0 / 1024.0
TABLE = ServoConfig(
    kind="servo-hydraulic",
    kp_per_s=63.5,
    ki_per_s2=6.0,
    valve_time_constant_s=0.0018,
    stall_force_n=16000.0,
    flow_limit_m_per_s=1.0,
    oil_stiffness_n_per_m=2e7,
    oil_damping_n_s_per_m=1.2e4,
    moving_mass_kg=45.0,
    friction_n=80.0,
    friction_width_m_per_s=0.01,
    viscous_n_s_per_m=600.0,
    substeps=32,
)
OTHERS = {
    "pure-delay": ServoConfig(kind="pure-delay", delay_samples=6.0),
    "first-order": ServoConfig(kind="first-order", roll_off_hz=8.0, delay_samples=2.0),
    "second-order": ServoConfig(
        kind="second-order",
        natural_frequency_hz=20.0,
        damping_ratio=0.7,
        gain=0.98,
        delay_samples=3.25,
    ),
}
SIDES = np.array([[1.0, 0.2], [1.0, -0.3]])
K = np.array([[8e5, 2e4], [2e4, 6e4]])
C = np.array([[900.0, 30.0], [30.0, 70.0]])
M = np.array([[25.0, 1.0], [1.0, 3.0]])
NONE = np.zeros((2, 2))


def config(**settings: Any) -> CoupledRigConfig:
    given: dict[str, Any] = {
        "kinematics": Kinematics(SIDES),
        "stiffness": K,
        "damping": C,
        "mass": M,
        "servos": (TABLE, replace(TABLE, kp_per_s=50.0, moving_mass_kg=30.0)),
    }
    return CoupledRigConfig(**given | settings)


def commands(n: int = 2048) -> Floats:
    t = np.arange(n) * H
    return np.stack([5e-3 * np.sin(9 * t) * np.sin(t), 4e-3 * np.sin(13 * t + 0.4) * t / 4], axis=1)


@pytest.mark.parametrize("load_cell", ["actuator-end", "specimen"])
@pytest.mark.parametrize("kind", ["servo-hydraulic", *OTHERS])
def test_a_rig_of_one_axis_is_the_rig_of_one_axis(kind: str, load_cell: core.LoadCell) -> None:
    servo = OTHERS.get(kind, TABLE)
    x_sensor, f_sensor = SensorConfig(2e-6, 1e-6, 1e-4, 0.004), SensorConfig(5.0, 1.0, 20.0, 3e3)
    column = element("hysteresis", k_n_per_m=4e5, post_yield_ratio=0.1, a=1, b=2e5, c=2e5, eta=2)
    known = (column, element("stiffness", k_n_per_m=3e5))
    mass = 20.0 if kind == "servo-hydraulic" else 0.0
    u = commands()[:, 0]
    alone = core.VirtualRig(
        RigConfig(
            servo,
            (*known, element("inertia", m_kg=mass)),
            x_sensor, f_sensor, load_cell, seed=9,
        )
    )  # fmt: skip
    x, f = alone.run(u)
    among = CoupledRig(
        CoupledRigConfig(
            Kinematics([[1.0]]), np.array([[3e5]]), np.zeros((1, 1)), np.array([[mass]]), (servo,),
            elements=((0, column),), displacement=(x_sensor,), force=(f_sensor,),
            load_cell=load_cell, seed=9,
        )
    )  # fmt: skip
    y, g = among.run(u[:, None])
    assert np.abs(y[:, 0] - x).max() <= 1.1e-6
    assert np.abs(g[:, 0] - f).max() <= 1.1
    assert np.mean(y[:, 0] == x) > 0.99
    assert np.mean(g[:, 0] == f) > 0.99
    assert np.abs(x).max() > 0.003


def joint_motion(
    rig: CoupledRigConfig, u: Floats, per_sample: int = 1, led: Any = None
) -> tuple[Floats, Floats]:
    """Integrate the equations of hydraulic axes at one specimen with scipy, command by command.

    ``led``: motion (x, v, a) of axis 1 by time, which then has no table.
    """
    back = np.linalg.inv(SIDES)
    k, c, m = (back.T @ matrix @ back for matrix in (rig.stiffness, rig.damping, rig.mass))
    free = [0] if led else [0, 1]

    def own(name: str) -> Floats:
        return np.array([getattr(rig.servos[i], name) for i in free])

    kp, ki, tau, stall, flow = (
        own(name)
        for name in ("kp_per_s", "ki_per_s2", "valve_time_constant_s", "stall_force_n",
                     "flow_limit_m_per_s")
    )  # fmt: skip
    oil, damping, table = (
        own(name) for name in ("oil_stiffness_n_per_m", "oil_damping_n_s_per_m", "moving_mass_kg")
    )
    dry, width, viscous = (
        own(name) for name in ("friction_n", "friction_width_m_per_s", "viscous_n_s_per_m")
    )
    size = len(free)
    joint = m[np.ix_(free, free)] + np.diag(table)

    def rate(t: float, y: Floats, command: Floats) -> Floats:
        x, v, piston, valve, integral = y.reshape(5, size)
        error = command - x
        through = np.clip(valve, -flow, flow)
        # The load is that of the oil column at the same instant.
        speed = through * np.ones(size)
        for _ in range(60):
            force = oil * (piston - x) + damping * (speed - v)
            speed = through * np.sqrt(np.clip(1 - np.sign(through) * force / stall, 0, 2))
        force = oil * (piston - x) + damping * (speed - v)
        whole_x, whole_v, whole_a = np.zeros(2), np.zeros(2), np.zeros(2)
        whole_x[free], whole_v[free] = x, v
        if led:
            whole_x[1], whole_v[1], whole_a[1] = led(t)
        asked = (k @ whole_x + c @ whole_v + m @ whole_a)[free]
        a = np.linalg.solve(joint, force - asked - viscous * v - dry * np.tanh(v / width))
        return np.concatenate([v, a, speed, (kp * error + ki * integral - valve) / tau, error])

    y, rows, forces = np.zeros(5 * size), [], []
    for n, row in enumerate(u):
        rows.append(y[:size].copy())
        forces.append(y.copy())
        y = scipy.integrate.solve_ivp(
            rate, (n * H, (n + 1) * H), y, args=(row[free],), rtol=1e-9, atol=1e-13, method="LSODA"
        ).y[:, -1]
    return np.array(rows), np.array(forces)


@pytest.mark.long
def test_two_tables_at_one_specimen_move_as_their_joint_equations_say() -> None:
    u = commands(700)[300:]
    weak = {"stall_force_n": 12000.0, "oil_stiffness_n_per_m": 6e6}
    strong = {"stiffness": 8 * K, "damping": 8 * C, "mass": 8 * M}
    servos = tuple(replace(one, **weak) for one in config().servos)
    fine = config(**strong, servos=tuple(replace(one, substeps=512) for one in servos))
    wanted, _ = joint_motion(fine, u)
    x, _ = CoupledRig(fine).run(u)
    coarse, _ = CoupledRig(config(**strong, servos=servos)).run(u)
    alone = {name: np.diag(np.diag(matrix)) for name, matrix in strong.items()}
    apart, _ = CoupledRig(config(**alone, servos=servos)).run(u)
    felt = np.abs(apart - wanted).max()
    assert felt > 0.01 * np.abs(wanted).max()
    assert np.abs(x - wanted).max() < 1e-3 * felt
    assert np.abs(coarse - wanted).max() < 0.02 * felt


@pytest.mark.long
def test_a_table_beside_an_axis_that_is_led_feels_where_it_goes() -> None:
    u = commands(400)
    servo = ServoConfig(kind="second-order", natural_frequency_hz=12.0, damping_ratio=0.6)
    fine = config(servos=(replace(TABLE, substeps=512), servo))
    w, zeta = 2 * np.pi * 12.0, 0.6
    alone = core.VirtualRig(RigConfig(servo)).motion(u[:, 1])

    def led(t: float) -> tuple[float, float, float]:
        n = min(int(t / H + 1e-9), 398)
        y = scipy.linalg.expm(
            np.array([[0, 1, 0], [-(w**2), -2 * zeta * w, w**2], [0, 0, 0]]) * (t - n * H)
        ) @ [alone[0][n], alone[1][n], u[n, 1]]
        return y[0], y[1], w**2 * (u[n, 1] - y[0]) - 2 * zeta * w * y[1]

    wanted, _ = joint_motion(fine, u[:200], led=led)
    x, _ = CoupledRig(fine).run(u[:200])
    assert np.array_equal(x[:, 1], core.VirtualRig(RigConfig(servo)).run(u[:200, 1])[0])
    assert np.abs(x[:, 0] - wanted[:, 0]).max() < 2e-3 * np.abs(wanted).max()


def test_at_rest_under_a_held_command_the_load_cells_carry_the_specimen() -> None:
    held = np.tile([3e-3, -2e-3], (8000, 1))
    rig = CoupledRig(config(servos=tuple(replace(s, friction_n=0.0) for s in config().servos)))
    x, f = rig.run(held)
    q = np.linalg.solve(SIDES, x[-1])
    assert np.allclose(f[-1], np.linalg.solve(SIDES.T, K @ q), rtol=1e-6)
    # Virtual work: what the axes do is what the specimen takes.
    assert math.isclose(f[-1] @ x[-1], q @ K @ q, rel_tol=1e-6)


def test_led_axes_are_asked_for_stiffness_damping_and_mass_along_the_interface() -> None:
    servo = OTHERS["second-order"]
    u = commands()
    x, f = CoupledRig(config(servos=(servo, replace(servo, gain=1.0)))).run(u)
    both = [
        core.VirtualRig(RigConfig(replace(servo, gain=g))).motion(u[:, i])
        for i, g in enumerate((0.98, 1.0))
    ]
    back = np.linalg.inv(SIDES)
    q, v, a = (np.stack([both[0][k], both[1][k]], axis=1) @ back.T for k in range(3))
    wanted = (q @ K.T + v @ C.T + a @ M.T) @ back
    assert np.array_equal(x, np.stack([both[0][0], both[1][0]], axis=1))
    assert np.abs(f - wanted).max() < 1e-10 * np.abs(wanted).max()


def test_an_element_acts_along_its_own_direction() -> None:
    servos = (OTHERS["first-order"],) * 2
    law = element("cubic", k3_n_per_m3=4e9)
    x, f = CoupledRig(
        config(servos=servos, stiffness=NONE, damping=NONE, mass=NONE, elements=((1, law),))
    ).run(commands())
    turn = np.linalg.solve(SIDES, x.T)[1]
    wanted = np.outer(4e9 * turn**3, np.linalg.inv(SIDES)[1])
    assert np.abs(f - wanted).max() < 1e-12 * np.abs(wanted).max()
    assert np.abs(wanted).max() > 1.0


# ---- pins ----------------------------------------------------------------------------------------


def pins() -> Kinematics:
    return Kinematics(
        pins=(Pin((0.3, 0.13), (1.6, 0.13)), Pin((0.3, -0.13), (1.6, -0.13))),
        coordinates=("x", "theta"),
    )


def test_at_pins_forces_do_the_work_of_the_specimen_at_large_rotations() -> None:
    """dW = f dx = F dq along a closed-form path, 60 mm and 80 mrad."""
    t = np.arange(4000) * H
    q = np.stack([0.06 * np.sin(t) ** 2, 0.08 * np.sin(1.3 * t)], axis=1)
    axes, _ = pins().axes(q)
    stiff = config(
        kinematics=pins(), servos=(ServoConfig(kind="pure-delay"),) * 2, damping=NONE, mass=NONE
    )
    x, f = CoupledRig(stiff).run(axes)
    assert np.array_equal(x, axes)
    wanted = 0.5 * np.einsum("ni,ij,nj->n", q, K, q)
    work = np.cumsum(0.5 * (f[1:] + f[:-1]) * np.diff(x, axis=0), axis=0).sum(axis=1)
    assert np.abs(work - (wanted[1:] - wanted[0])).max() < 2e-6 * wanted.max()


def test_at_pins_a_mass_is_accelerated_by_the_acceleration_of_the_pose() -> None:
    t = np.arange(3000) * H
    q = np.stack([0.05 * np.sin(7 * t), 0.08 * np.sin(11 * t)], axis=1)
    pose_a = np.stack([-0.05 * 49 * np.sin(7 * t), -0.08 * 121 * np.sin(11 * t)], axis=1)
    axes, _ = pins().axes(q)
    heavy = config(
        kinematics=pins(), servos=(ServoConfig(kind="pure-delay"),) * 2, stiffness=NONE,
        damping=NONE,
    )  # fmt: skip
    rig = CoupledRig(heavy)
    found, crude = [], []
    axis_a = np.diff(axes, 2, axis=0, prepend=np.zeros((2, 2))) / H**2
    for row, a in zip(axes, axis_a, strict=True):
        _, f, _ = rig.step(row)
        tie = pins()
        tie.pose(row)
        tie.pose(row)
        found.append(tie.jacobian().T @ f)
        crude.append(M @ np.linalg.solve(tie.jacobian(), a))
    # Backward differences are a sample late.
    wanted = (pose_a @ M.T)[4:-1]
    off = np.abs(np.array(found)[5:] - wanted).max()
    assert off < 2e-3 * np.abs(wanted).max()
    assert off < 0.1 * np.abs(np.array(crude)[5:] - wanted).max()


# ---- a plant of its own --------------------------------------------------------------------------


def plant() -> StateSpace:
    k = np.array([[9e3, -2e3], [-2e3, 7e3]])
    c = np.array([[90.0, -8.0], [-8.0, 80.0]])
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-k, -c]])
    b = np.vstack([np.zeros((2, 2)), k @ np.array([[0.9, 0.1], [0.05, 0.95]])])
    return StateSpace(a, b, np.hstack([np.eye(2), np.zeros((2, 2))]), (0.03, 0.03))


def test_a_step_with_a_held_command_is_the_exponential() -> None:
    own = plant()
    z = np.zeros((6, 6))
    z[:4, :4], z[:4, 4:] = own.a * H, own.b * H
    assert np.abs(held_step(own.a, own.b, H) - scipy.linalg.expm(z)).max() < 1e-13
    stiff = own.a * 300.0
    z[:4, :4] = stiff * H
    assert np.allclose(held_step(stiff, own.b, H), scipy.linalg.expm(z), rtol=1e-9, atol=1e-12)


def test_a_plant_moves_and_pushes_as_its_equations_say() -> None:
    own, u = plant(), commands()
    x, f = CoupledRig(config(servos=(), plant=own)).run(u)
    state, rows = np.zeros(4), []
    z = np.zeros((6, 6))
    z[:4, :4], z[:4, 4:] = own.a * H, own.b * H
    step = scipy.linalg.expm(z)
    held = np.zeros(2)
    for row in u:
        rate = own.a @ state + own.b @ held
        rows.append(np.concatenate([state[:2], state[2:], rate[2:]]))
        state = step[:4, :4] @ state + step[:4, 4:] @ row
        held = row
    true = np.array(rows)
    assert np.abs(x - true[:, :2]).max() < 1e-14
    back = np.linalg.inv(SIDES)
    q, v, a = (true[:, 2 * i : 2 * i + 2] @ back.T for i in range(3))
    wanted = (q @ K + v @ C + a @ M) @ back
    assert np.abs(f - wanted).max() < 1e-11 * np.abs(wanted).max()


def test_a_plants_command_ends_at_its_stroke() -> None:
    short = replace(plant(), stroke_m=(0.003, 0.03))
    u = commands()
    x, _ = CoupledRig(config(servos=(), plant=short)).run(u)
    y, _ = CoupledRig(config(servos=(), plant=plant())).run(np.clip(u, [-0.003, -1], [0.003, 1]))
    assert np.array_equal(x, y)
    assert np.abs(u[:, 0]).max() > 0.004


# ---- sensors, and what must not happen -----------------------------------------------------------


def test_each_axis_has_sensors_of_its_own() -> None:
    sensors = {
        "displacement": (SensorConfig(2e-5), SensorConfig(0.0, 1e-4, 0.0, 2e-3)),
        "force": (SensorConfig(0.0, 0.0, 50.0), SensorConfig(30.0)),
    }
    clean = CoupledRig(config())
    x, f = clean.run(commands(4096))
    noisy = CoupledRig(config(**sensors, seed=3))
    y, g = noisy.run(commands(4096))
    assert 1.9e-5 < np.std(y[:, 0] - x[:, 0]) < 2.1e-5
    assert np.abs(y[:, 1]).max() == 2e-3
    assert np.allclose(y[:, 1] / 1e-4, np.round(y[:, 1] / 1e-4), atol=1e-9)
    assert np.allclose(g[:, 0] - f[:, 0], 50.0)
    assert 28.0 < np.std(g[:, 1] - f[:, 1]) < 32.0
    assert np.array_equal(CoupledRig(config(**sensors, seed=3)).run(commands(4096))[0], y)
    noisy.reseed()
    again = [noisy.step([0.0, 0.0])[0][0] - noisy.true_m[0] for _ in range(20)]
    assert np.allclose(again, (y - x)[:20, 0])


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("kind", ["servos", "plant"])
def test_a_command_that_is_none_leaves_the_one_before(kind: str, absurd: float) -> None:
    settings: dict[str, Any] = {} if kind == "servos" else {"servos": (), "plant": plant()}
    rig, other = CoupledRig(config(**settings)), CoupledRig(config(**settings))
    wanted = STATUS["out_of_range"] if math.isfinite(absurd) else STATUS["not_finite"]
    u = commands(600)
    for k, row in enumerate(u):
        bad = k % 50 == 25
        x, f, code = rig.step([absurd, row[1]] if bad else row)
        y, g, _ = other.step([u[k - 1][0], row[1]] if bad else row)
        assert bool(code & wanted) == bad
        assert np.array_equal(x, y)
        assert np.array_equal(f, g)


def test_a_rig_that_runs_off_stays_finite() -> None:
    wild = config(
        stiffness=-50 * K, servos=tuple(replace(s, kp_per_s=4000) for s in config().servos)
    )
    x, f = CoupledRig(wild).run(100 * commands(4096))
    assert np.isfinite(x).all()
    assert np.isfinite(f).all()


STIFF = ElementConfig("inertia", (3.0,))


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"stiffness": np.array([[1.0, 2.0], [3.0, 4.0]])}, "a size of the virtual plant"),
        ({"mass": np.array([[np.nan, 0.0], [0.0, 1.0]])}, "a size of the virtual plant"),
        ({"stiffness": np.eye(3)}, r"must be \(2, 2\)"),
        ({"servos": (TABLE,)}, "there must be 2 actuators"),
        ({"plant": plant()}, "there must be 2 actuators"),
        ({"displacement": (SensorConfig(),)}, "there must be 2 actuators"),
        ({"elements": ((0, STIFF),)}, "an unknown kind"),
        ({"elements": ((2, element("cubic", k3_n_per_m3=1.0)),)}, "an unknown kind"),
        ({"servos": (TABLE, ServoConfig(kind="servo-valve"))}, "a setting of the actuator model"),
        ({"servos": (TABLE, replace(TABLE, period_s=1e-3))}, "the sampling period"),
        ({"stiffness": 1e6 * K}, "too stiff for its mass and substeps"),
        ({"servos": (), "plant": replace(plant(), a=plant().a * np.nan)}, "not finite"),
        ({"servos": (), "plant": replace(plant(), stroke_m=(0.0, 1.0))}, "a size of the virtual"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(settings: dict[str, Any], why: str) -> None:
    with pytest.raises(CoreError, match=why):
        CoupledRig(config(**settings))


def test_axes_on_one_line_are_refused() -> None:
    with pytest.raises(CoreError, match="do not determine every coordinate"):
        Kinematics([[1.0, 0.2], [1.0, 0.2]])


def test_the_shipped_frame_is_a_rig_whose_axes_feel_one_another() -> None:
    frame = config_module.load_any_rig(config_module.shipped_rig("two-axis-frame"))
    assert isinstance(frame, config_module.AxesRig)
    rig = axes_rig.virtual_rig(frame)
    held = np.zeros((6000, 2))
    held[500:, 0] = 2e-4
    x, f = rig.run(held)
    # The upper axis moves; the frame pushes the lower one, which holds against it.
    assert x[-500:, 0].mean() == pytest.approx(2e-4, abs=2e-5)
    assert abs(x[-500:, 1].mean()) < 2e-5
    wanted = frame.along_axes() @ x[-500:].mean(axis=0)
    assert np.allclose(f[-500:].mean(axis=0), wanted, rtol=0.01)
    assert abs(wanted[1]) > 0.2 * abs(wanted[0])
