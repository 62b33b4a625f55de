"""The limiter of several axes: every axis within its limits, all of them by one factor; and
matrices in the place of laws and stiffnesses of each axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from axes_bench import DELAY, NAMES, SPECIMEN, Bench, columns, config, controller, rig
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels import Floats

from rthyb_rt import core
from rthyb_rt.core import AxisConfig, Controller
from rthyb_rt.core.coupled_rig import StateSpace
from rthyb_rt.core.matrix_lead import MatrixInverse, MatrixLeadConfig
from rthyb_rt.core.matrix_rfc import MatrixRfcConfig

H = core.PERIOD_S
LIMIT = st.one_of(st.just(0.0), st.floats(1e-3, 0.5))
CLAMP = st.one_of(st.just(0.0), st.floats(1e-4, 5e-3))
FORCES = st.lists(st.tuples(st.floats(-4e4, 4e4), st.floats(-2e4, 2e4)), min_size=30, max_size=120)


class Pushed:
    """Two axes whose structure is pushed about by forces, and what the limiter makes of that."""

    def __init__(self, axes: tuple[AxisConfig, ...]) -> None:
        made = controller(
            axes=axes, kinematics=None, lead_enabled=False, velocity_limit_m_per_s=0.0
        )
        self.controller = Controller(made)
        self.wanted: list[Floats] = []
        self.sent = [np.zeros(2)]

    def push(self, forces: tuple[float, float]) -> None:
        state = self.controller._c
        pairs = [(state.axis[k].target, force) for k, force in enumerate(forces)]
        self.controller.step_axes(pairs, 0.0)
        self.wanted.append(np.array([state.axis[k].x_plc for k in (0, 1)]))
        self.sent.append(np.array(self.controller.commands_m))

    def steps(self) -> Floats:
        return np.diff(np.array(self.sent), axis=0)


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(velocity=st.tuples(LIMIT, LIMIT), clamp=st.tuples(CLAMP, CLAMP), forces=FORCES)
def test_without_acceleration_limits_every_step_leads_straight_to_what_is_wanted(
    velocity: tuple[float, float], clamp: tuple[float, float], forces: list[tuple[float, float]]
) -> None:
    lab = Pushed(
        tuple(
            AxisConfig(name, velocity_limit_m_per_s=v, clamp_m=c)
            for name, v, c in zip(NAMES, velocity, clamp, strict=True)
        )
    )
    for force in forces:
        lab.push(force)
    for k, step in enumerate(lab.steps()):
        way = lab.wanted[k] - lab.sent[k]
        size = np.hypot(*way) * np.hypot(*step)
        assert abs(way[0] * step[1] - way[1] * step[0]) <= 1e-9 * size + 1e-18
        assert way @ step >= -1e-12 * size
        assert np.hypot(*step) <= np.hypot(*way) * (1 + 1e-12)
        for axis in (0, 1):
            if velocity[axis]:
                assert abs(step[axis]) <= velocity[axis] * H * (1 + 1e-9)
            if clamp[axis]:
                assert abs(lab.sent[k + 1][axis]) <= clamp[axis] * (1 + 1e-12)


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(
    velocity=st.tuples(LIMIT, LIMIT),
    acceleration=st.tuples(st.floats(0.5, 20.0), st.floats(0.5, 20.0)),
    forces=FORCES,
)
def test_with_acceleration_limits_every_axis_keeps_to_its_own(
    velocity: tuple[float, float],
    acceleration: tuple[float, float],
    forces: list[tuple[float, float]],
) -> None:
    lab = Pushed(
        tuple(
            AxisConfig(name, velocity_limit_m_per_s=v, acceleration_limit_m_per_s2=a)
            for name, v, a in zip(NAMES, velocity, acceleration, strict=True)
        )
    )
    for force in forces:
        lab.push(force)
    steps = lab.steps()
    changes = np.diff(np.concatenate([np.zeros((1, 2)), steps]), axis=0)
    for axis in (0, 1):
        most = acceleration[axis] * H * H
        assert abs(changes[:, axis]).max() <= most * (1 + 1e-9) + 1e-15
        if velocity[axis]:
            assert abs(steps[:, axis]).max() <= velocity[axis] * H * (1 + 1e-9)


def test_an_axis_that_stays_behind_holds_the_others_on_the_straight_way() -> None:
    """From rest, pushed one way: both axes go in the ratio that is wanted of them."""
    axes = (
        AxisConfig("left", velocity_limit_m_per_s=0.002),
        AxisConfig("right", velocity_limit_m_per_s=0.5),
    )
    lab = Pushed(axes)
    for _ in range(40):
        lab.push((-3e4, -3e4))
    steps = lab.steps()[-1]
    way = lab.wanted[-1] - lab.sent[-2]
    assert abs(steps[0]) == pytest.approx(0.002 * H)
    assert steps[1] / steps[0] == pytest.approx(way[1] / way[0])
    assert abs(steps[1]) < 0.5 * H


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(
    velocity=st.tuples(LIMIT, LIMIT),
    acceleration=st.tuples(st.one_of(st.just(0.0), st.floats(0.5, 20.0)), st.floats(0.5, 20.0)),
    clamp=st.tuples(CLAMP, CLAMP),
    forces=FORCES,
)
def test_an_axis_at_its_position_limit_makes_no_other_axis_leap(
    velocity: tuple[float, float],
    acceleration: tuple[float, float],
    clamp: tuple[float, float],
    forces: list[tuple[float, float]],
) -> None:
    lab = Pushed(
        tuple(
            AxisConfig(name, velocity_limit_m_per_s=v, acceleration_limit_m_per_s2=a, clamp_m=c)
            for name, v, a, c in zip(NAMES, velocity, acceleration, clamp, strict=True)
        )
    )
    for force in forces:
        lab.push(force)
    changes = np.diff(np.concatenate([np.zeros((1, 2)), lab.steps()]), axis=0)
    for axis in (0, 1):
        sent = abs(np.array(lab.sent[1:])[:, axis])
        within = sent < clamp[axis] * (1 - 1e-9) if clamp[axis] else np.full(len(sent), True)
        if clamp[axis]:
            assert sent.max() <= clamp[axis] * (1 + 1e-12)
        if acceleration[axis]:
            most = acceleration[axis] * H * H
            assert (abs(changes[within, axis]) <= most * (1 + 1e-9) + 1e-15).all()


def test_a_limit_met_at_once_stops_the_other_axis_as_fast_as_it_brakes() -> None:
    """One axis, free to brake at once, runs into its clamp; the other is far from its own."""
    axes = (
        AxisConfig("left", clamp_m=1e-4),
        AxisConfig("right", acceleration_limit_m_per_s2=1.0, clamp_m=0.1),
    )
    lab = Pushed(axes)
    for _ in range(200):
        lab.push((-3e4, -1e4))
    assert max(abs(sent[0]) for sent in lab.sent) == pytest.approx(1e-4)
    right = np.diff(lab.steps()[:, 1])
    assert abs(right).max() <= 1.0 * H * H * (1 + 1e-9)
    assert abs(lab.sent[-1][1]) < 0.1


# ---- matrices ------------------------------------------------------------------------------------

COUPLED = np.array([[0.9, 0.12], [0.15, 0.93]])
POLE_PER_S = 60.0


def feeling() -> StateSpace:
    """Two coupled first-order actuators, including their gains."""
    a = -POLE_PER_S * np.eye(2)
    return StateSpace(a, POLE_PER_S * np.eye(2), COUPLED, (0.1, 0.1))


def lead(inverse: bool) -> MatrixLeadConfig:
    # Their exact inverse at rest; what moves is left to delay and curvature.
    first = np.zeros((3, 2, 2))
    first[1] = np.eye(2) / POLE_PER_S
    own = MatrixInverse((), np.linalg.inv(COUPLED)[None]) if inverse else None
    return MatrixLeadConfig(rest_noise_m=(1e-6, 1e-6), first=first, inverse=own)


def tracked(control: dict[str, object]) -> Floats:
    """Largest error of each axis after a second of the test, of its largest displacement."""
    settings_ = config(control, axis_channel=0, axis_channel_count=5)
    bench = Bench(settings_, plant=rig(servos=(), plant=feeling()), seconds=3.0)
    targets: list[Floats] = []
    bench.running(0)
    since = len(bench.records)
    while bench.station.state == "RUNNING":
        state = bench.station._c.controller.axis
        targets.append(np.array([state[0].target, state[1].target]))
        bench.step()
    measured = columns(np.concatenate(bench.records[since:]), "x_meas_m")
    wanted = np.array(targets)
    errors = abs(measured - wanted)[1024:].max(axis=0)
    return np.asarray(errors / abs(wanted).max(axis=0))


def test_a_matrix_lead_follows_actuators_that_feel_one_another() -> None:
    alone = tracked(
        {"law": core.LawConfig("paper", {"alpha0": 1.0 / (POLE_PER_S * H)}, adapts=False)}
    )
    together = tracked({"matrix_lead": lead(True)})
    assert (alone > 0.1).all()
    assert (together < 0.02).all()


def test_what_the_matrix_lead_learns_is_in_the_record() -> None:
    settings_ = config({"matrix_lead": lead(True)}, axis_channel=0, axis_channel_count=5)
    bench = Bench(settings_, plant=rig(servos=(), plant=feeling())).running(800)
    used = bench.station._c.controller.matrix_lead.used
    rows = bench.rows()
    assert rows["alpha"][-1] == used[1][0][0]
    assert rows["beta"][-1] == used[2][0][0]
    assert bench.station._c.channel[3] == used[1][1][1]
    assert abs(used[1][0][0] - 1.0 / (POLE_PER_S * H)) < 5.0


def test_a_matrix_of_tangent_stiffness_takes_the_place_of_one_a_direction() -> None:
    rfc = MatrixRfcConfig(SPECIMEN, (1e-7, 1e-7), memory_s=0.1)
    bench = Bench(config({"matrix_rfc": rfc, "lead_enabled": False})).running(1200)
    k = np.array([list(row)[:2] for row in bench.station._c.controller.matrix_rfc.k])[:2]
    # The specimen is elastic: what is learnt is what it is, with its coupling.
    np.testing.assert_allclose(k, SPECIMEN, rtol=0.02, atol=0.02 * SPECIMEN[1, 1])
    assert bench.rows()["k_t_n_per_m"][-1] == k[0, 0]


def test_the_matrix_of_stiffness_brings_the_response_nearer_to_that_without_delay() -> None:
    def response(delay: float, control: dict[str, object]) -> Floats:
        servos = (core.ServoConfig("pure-delay", delay_samples=delay),) * 2
        bench = Bench(
            config({"lead_enabled": False} | control, axis_channel=0, axis_channel_count=5),
            plant=rig(servos=servos),
        ).running(0)
        found = []
        while bench.station.state == "RUNNING":
            bench.step()
            both = bench.station._c.controller.interface
            found.append([both[0].x_num, both[1].x_num])
        return np.array(found)[:1800]

    off = {"rfc": core.RfcConfig(k_e_n_per_m=SPECIMEN[0, 0], enabled=False, window=51)}
    base = controller(**off)
    plain = {
        **off,
        "interfaces": tuple(replace(one, rfc=None) for one in base.interfaces),
    }
    exact = response(0.0, plain)
    matrix = MatrixRfcConfig(SPECIMEN, (1e-7, 1e-7), memory_s=0.1)
    late = abs(response(float(2 * DELAY), plain) - exact).max(axis=0)
    mended = abs(response(float(2 * DELAY), {"matrix_rfc": matrix}) - exact).max(axis=0)
    assert (mended < 0.2 * late).all()
