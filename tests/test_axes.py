"""Several axes at one specimen: two tests in one, any geometry, one state, limits of each, a lost
pair, paths in interface coordinates, replay, and readings that are none on either axis."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from axes_bench import (
    DELAY,
    FLAGS,
    NAMES,
    OFFSET_M,
    SIDES,
    SPECIMEN,
    Bench,
    H,
    column,
    columns,
    config,
    controller,
    rig,
    shaking,
    structure,
    watched,
)
from kernels import Floats

from rthyb_rt import core
from rthyb_rt.core import (
    AxisConfig,
    AxisParameters,
    AxisReading,
    InterfaceConfig,
    Parameters,
    Watch,
)
from rthyb_rt.core.coupled_rig import CoupledRig, CoupledRigConfig
from rthyb_rt.core.kinematics import Kinematics, Pin
from rthyb_rt.core.matrix_lead import MatrixLeadConfig
from rthyb_rt.core.matrix_rfc import MatrixRfcConfig
from rthyb_rt.core.sparse import SparseConfig, Symmetric

EITHER = pytest.mark.parametrize("axis", [0, 1], ids=NAMES)
BAD = {"NaN": math.nan, "inf": math.inf, "-inf": -math.inf, "huge": 1e300, "-huge": -1e300}


def run_virtual(
    station: core.Station, plant: CoupledRig | core.VirtualRig, ticks: int = 6000, width: int = 0
) -> tuple[np.ndarray, Floats]:
    """A whole test in virtual time; its rows and their channels."""
    test = core.Virtual(station, plant)
    count = station.config.controller.axis_count
    rows, values, command = [], [], "none"
    for _ in range(20):
        part = np.zeros(ticks, core.record_dtype(count))
        beside = np.zeros((ticks, width))
        done = test.run(part, command, beside if width else None)  # type: ignore[arg-type]
        rows.append(part[:done])
        values.append(beside[:done])
        command = {"IDLE": "zero", "ZEROED": "arm", "ARMED": "start"}.get(station.state, "none")
        if station.state == "IDLE" and station.cause == "completed":
            break
    return np.concatenate(rows), np.concatenate(values)


# ---- what they come to --------------------------------------------------------------------------


def one_mass(k: float, mass: float, load: float) -> SparseConfig:
    return SparseConfig(
        Symmetric.of(np.array([[mass]])), Symmetric.zero(1), np.array([load]), (((0, 1.0),),), (k,),
        by_mass_per_s=0.5,
    )  # fmt: skip


def test_two_axes_that_do_not_feel_one_another_are_two_tests() -> None:
    """Without coupling each axis does to the last digit what it does alone."""
    k, masses, loads = np.diag([6e5, 9e5]), (4220.0, 300.0), (4220.0, 60.0)
    law = core.LawConfig("robust", {"alpha0": 2.0})
    both = config(
        {
            "law": law,
            "kinematics": None,
            "numerical": replace(
                structure(k), load_kg=np.array(loads),
                mass_kg=Symmetric.of(np.diag(masses)),
            ),
            "interfaces": tuple(
                InterfaceConfig(name, core.RfcConfig(k_e_n_per_m=k[i, i], window=51))
                for i, name in enumerate(NAMES)
            ),
        }
    )  # fmt: skip
    servo = core.ServoConfig("pure-delay", delay_samples=3.0)
    plant = CoupledRig(
        CoupledRigConfig(
            Kinematics(np.eye(2)), k, np.zeros((2, 2)), np.zeros((2, 2)), servos=(servo, servo)
        )
    )
    rows, _ = run_virtual(core.Station(both, shaking(2.0)), plant)
    for axis in (0, 1):
        alone = core.StationConfig(
            controller=core.ControllerConfig(
                law=law,
                rfc=core.RfcConfig(k_e_n_per_m=k[axis, axis], window=51),
                motion=core.MotionConfig("cr", mass_kg=1.0, k_e_n_per_m=1.0),
                velocity_limit_m_per_s=0.5,
                numerical=one_mass(k[axis, axis], masses[axis], loads[axis]),
            ),
            tare_ticks=64,
            ramp_in_ticks=256,
            armed_ticks=500,
        )
        one = core.VirtualRig(
            core.RigConfig(servo, (core.element("stiffness", k_n_per_m=k[axis, axis]),))
        )
        single, _ = run_virtual(core.Station(alone, shaking(2.0)), one)
        running = single["state"] == core.RUNNING
        assert running.sum() > 2000
        assert (rows["state"] == core.RUNNING).sum() == running.sum()
        for name in ("x_cmd_m", "x_meas_m", "f_meas_n"):
            own = column(rows[rows["state"] == core.RUNNING], name, axis)
            np.testing.assert_allclose(
                own, single[name][running], rtol=1e-12, atol=1e-12 * abs(own).max()
            )


def test_where_the_actuators_stand_changes_nothing_of_the_structure() -> None:
    """With ideal actuators the motion of the structure is that of the joined structure."""
    found = []
    for sides in (SIDES, np.array([[1.0, 0.5], [0.6, -0.4]])):
        kinematics = Kinematics(sides)
        settings = config({"kinematics": kinematics})
        settings = replace(settings, axis_channel=0, axis_channel_count=5)
        station = core.Station(settings, shaking(2.0))
        rows, beside = run_virtual(station, rig(Kinematics(sides)), width=5)
        running = rows["state"] == core.RUNNING
        found.append(np.stack([rows["x_num_m"][running], beside[running, 0]], axis=1))
    peak = abs(found[0]).max(axis=0)
    assert (peak > 1e-3).all()
    assert (abs(found[0] - found[1]).max(axis=0) < 1e-9 * peak).all()


def test_channels_say_what_the_record_says_of_the_first_axis() -> None:
    settings = config({"law": core.LawConfig("robust", {"alpha0": 2.0})})
    names = [one.name for one in core.axis_channels(settings.controller)]
    assert names == ["x_num_m_1", "k_t_n_per_m_1", "x_plc_m_1", "alpha_1", "beta_1"]
    station = core.Station(replace(settings, axis_channel=2, axis_channel_count=5), shaking(1.0))
    rows, beside = run_virtual(station, rig(), width=7)
    running = rows["state"] == core.RUNNING
    pose = np.stack([rows["x_num_m"], beside[:, 2]], axis=1)[running]
    sent = columns(rows[running], "x_cmd_m")
    assert (beside[:, :2] == 0.0).all()
    # What is sent for t_n is the target led by two samples; slow motion: target + 2 steps of it.
    target = pose @ SIDES.T
    ahead = target[1:] + DELAY * np.diff(target, axis=0)
    assert abs(ahead - sent[1:]).max() < 2e-3 * abs(sent).max()
    assert abs(beside[running, 4] - sent[:, 1]).max() < 1e-12  # nothing is limited
    assert (beside[running, 5] > 1.0).all()
    assert (beside[running, 3] >= 0.0).all()
    assert (beside[running, 3] <= SPECIMEN[1, 1]).all()
    assert beside[running, 3].max() > 0.9 * SPECIMEN[1, 1]


def test_pins_move_the_axes_along_their_own_geometry() -> None:
    pins = (Pin((0.267, 0.127), (1.6, 0.127)), Pin((0.267, -0.127), (1.6, -0.127)))

    def kinematics() -> Kinematics:
        return Kinematics(pins=pins, coordinates=("x", "theta"))

    settings = config({"kinematics": kinematics(), "lead_enabled": False})
    station = core.Station(replace(settings, axis_channel=0, axis_channel_count=5), shaking(2.0))
    rows, beside = run_virtual(station, rig(kinematics()), width=5)
    running = rows["state"] == core.RUNNING
    pose = np.stack([rows["x_num_m"], beside[:, 0]], axis=1)[running]
    assert abs(pose).max() > 5e-3
    axes, _ = kinematics().axes(pose)
    np.testing.assert_allclose(columns(rows[running], "x_cmd_m"), axes, atol=1e-15)


# ---- a pair that one axis lacks -----------------------------------------------------------------


@EITHER
def test_a_pair_lost_on_one_axis_is_made_up_for_all(axis: int) -> None:
    bench = Bench().running(400)
    before = bench.rows()[-1:]
    station = bench.station._c.controller
    step = [station.axis[k].target - station.axis[k].target1 for k in (0, 1)]
    bench.step(faults={axis: {"lost": True}})
    row = bench.records[-1][-1:]
    assert row["flags"][0] & FLAGS["predicted"]
    assert row["flags"][0] & FLAGS["lost"]
    for k in (0, 1):
        assert column(row, "missing", k)[0] == (k == axis)
        assert math.isnan(column(row, "x_read_m", k)[0]) == (k == axis)
        went = column(row, "x_meas_m", k)[0] - column(before, "x_meas_m", k)[0]
        assert went == pytest.approx(step[k], rel=1e-9)
    # Along the tangent stiffness: the specimen's own, since it is elastic and without coupling of
    # its directions in the compensator.
    k_axes = np.linalg.inv(SIDES).T @ np.diag(np.diag(SPECIMEN)) @ np.linalg.inv(SIDES)
    change = [column(row, "f_meas_n", k)[0] - column(before, "f_meas_n", k)[0] for k in (0, 1)]
    np.testing.assert_allclose(change, k_axes @ step, rtol=0.02, atol=1.0)
    bench.step()
    assert bench.records[-1]["flags"][-1] & FLAGS["fresh"]


@EITHER
def test_twenty_ticks_without_a_pair_of_one_axis_trip_all(axis: int) -> None:
    bench = Bench().running()
    for _ in range(19):
        assert bench.step(faults={axis: {"lost": True}}).state == "RUNNING"
    assert bench.step(faults={axis: {"lost": True}}).state == "TRIPPED"
    assert bench.station.cause == "link_lost"
    assert bench.station.cause_axis == axis
    assert core.placed_cause(int(bench.rows()["cause"][-1]))[1:] == (axis, None, None)
    sent = len(bench.sent)
    for _ in range(10):
        bench.step()
    assert len(bench.sent) - sent == 2  # of three frames the first left with the trip
    assert bench.sent[-1] == bench.sent[-3]


# ---- one state, limits of each ------------------------------------------------------------------

LIMITS = {
    "position": 1e-4,
    "velocity": 1e-4,
    "increment": 1e-7,
    "force": 10.0,
    "tracking": 1e-7,
    "rig_position": 1e-4,
    "rig_force": 5.0,
}


@EITHER
@pytest.mark.parametrize("name", LIMITS)
def test_a_limit_of_one_axis_trips_all_and_is_named(name: str, axis: int) -> None:
    settings = config(watched(axis, name, LIMITS[name], "trip"))
    bench = Bench(settings)
    for command in ("none", "zero"):
        bench.step(command)  # type: ignore[arg-type]
    for _ in range(70):
        bench.step()
    if name == "rig_position":  # the drives stand beyond it, and nothing may begin
        assert bench.step("arm").refused
        assert bench.station.refusal[0] == name
        return
    if name != "rig_force":  # which is beyond it at rest
        bench.step("arm")
        bench.step("start")
        for _ in range(2000):
            bench.step()
    assert bench.station.cause == name
    assert bench.station.state == "TRIPPED"
    assert bench.station.cause_axis == axis
    assert abs(bench.station.cause_value) > LIMITS[name] == bench.station.cause_limit


SENSORS: dict[str, tuple[str, float, dict[str, float]]] = {
    "sensor_jump": ("x_m", 1e-3, {"x_m": 0.5}),
    "force_jump": ("f_n", 1e4, {"f_n": 9e5}),
}


@EITHER
@pytest.mark.parametrize("name", SENSORS)
def test_a_leap_of_one_sensor_is_taken_of_no_axis(name: str, axis: int) -> None:
    _, most, leap = SENSORS[name]
    bench = Bench(config(watched(axis, name, most, "trip"))).running()
    bench.step(faults={axis: leap})
    assert bench.station.cause == name
    assert bench.station.cause_axis == axis
    other = Bench(config(watched(1 - axis, name, most, "trip"))).running()
    other.step(faults={axis: leap})
    assert other.station.cause == "none"  # it has no such limit


@EITHER
@pytest.mark.parametrize("name", ["sensor_stuck", "force_stuck"])
def test_a_sensor_of_one_axis_that_repeats_itself(name: str, axis: int) -> None:
    bench = Bench(config(watched(axis, name, 30.0, "ramp-out"))).running(500)
    stuck = bench.read()[axis]
    half = {"x_m": stuck.x_m} if name == "sensor_stuck" else {"f_n": stuck.f_n}
    for _ in range(80):
        bench.step(faults={axis: half})
    assert bench.station.cause == name
    assert bench.station.cause_axis == axis
    assert bench.station.state == "RAMP_OUT"


@pytest.mark.parametrize("interface", [0, 1], ids=["x", "theta"])
@pytest.mark.parametrize("name", ["position", "force"])
def test_a_limit_of_an_interface_direction_is_named(name: str, interface: int) -> None:
    # Quick enough that the force neither grows by half while it brakes nor stays for .25 s.
    most = {"position": (2e-3, 1e-3), "force": (4e3, 550.0)}[name][interface]
    base = controller()
    interfaces = tuple(
        replace(one, watches={name: Watch(most, "ramp-out")} if k == interface else {})
        for k, one in enumerate(base.interfaces)
    )
    quick = {"path_velocity_m_per_s": 0.25, "path_acceleration_m_per_s2": 5.0}
    bench = Bench(config({"interfaces": interfaces}, **quick))
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    bench.step("start")
    bench.until("RAMP_OUT")
    assert (bench.station.cause, bench.station.cause_axis) == (name, None)
    assert bench.station.cause_interface == interface
    assert abs(bench.station.cause_value) > most
    row = core.placed_cause(int(bench.rows()["cause"][-1]))
    assert row == (core.CAUSES.index(name), None, interface, None)
    bench.until("IDLE")


@EITHER
@pytest.mark.parametrize(
    ("fault", "cause"), [("link_down", "link_down"), ("drive_stopped", "drive_stopped")]
)
def test_a_link_or_a_drive_of_one_axis_trips_all(fault: str, cause: str, axis: int) -> None:
    bench = Bench().running()
    assert bench.step(faults={axis: {fault: True}}).state == "TRIPPED"
    assert (bench.station.cause, bench.station.cause_axis) == (cause, axis)
    again = core.Station(bench.settings, shaking(2.0)).replay(bench.rows())
    assert again.tobytes() == bench.rows().tobytes()


@EITHER
def test_drives_whose_counts_come_apart_trip_after_twenty_ticks(axis: int) -> None:
    bench = Bench().running()
    for _ in range(19):
        assert bench.step(apart=axis).state == "RUNNING"
    bench.step()
    for _ in range(19):
        assert bench.step(apart=axis).state == "RUNNING"
    assert bench.step(apart=axis).state == "TRIPPED"
    assert (bench.station.cause, bench.station.cause_axis) == ("apart", axis)
    assert bench.rows()["flags"][-1] & FLAGS["apart"]
    again = core.Station(bench.settings, shaking(2.0)).replay(bench.rows())
    assert again.tobytes() == bench.rows().tobytes()


@EITHER
def test_a_moving_axis_spoils_the_tare_of_all(axis: int) -> None:
    bench = Bench()
    bench.step()
    bench.step("zero")
    bench.step(faults={axis: {"x_m": bench.read()[axis].x_m + 1e-3}})
    assert bench.station.zeroing_failed
    assert bench.station.state == "IDLE"


@EITHER
def test_a_reset_needs_both_axes_at_rest(axis: int) -> None:
    bench = Bench().running()
    bench.step("trip")
    for k in range(60):
        bench.step(faults={axis: {"x_m": 0.01 + 1e-3 * (k % 2)}})
    bench.step("reset", faults={axis: {"x_m": 0.01}})
    assert bench.station.state == "TRIPPED"
    for _ in range(60):
        bench.step()
    bench.step("reset")
    assert bench.station.state == "IDLE"


def test_parameters_of_each_axis_come_in_force() -> None:
    bench = Bench().running()
    given = Parameters.of(bench.settings)
    narrow = replace(given.axes[1], watches={"position": Watch(1e-5, "ramp-out")})
    station = bench.station._c
    lib_set = replace(given, axes=(given.axes[0], narrow)).struct(7)
    from rthyb_rt._core import lib

    assert lib.rthyb_parameters_check(lib_set) == 0
    assert lib.rthyb_station_adopt(station, lib_set) == 1
    bench.step()
    bench.step()
    assert (bench.station.cause, bench.station.cause_axis) == ("position", 1)
    off = replace(given, axes=(AxisParameters(), given.axes[1])).struct(8)
    assert lib.rthyb_station_adopt(station, off) == 0  # would switch off a limit of one axis


# ---- paths --------------------------------------------------------------------------------------


def test_all_directions_set_off_and_arrive_together() -> None:
    """HOLD and RESUME of two directions: a brake and a quintic of one duration each."""
    settings = config({"lead_enabled": False})
    settings = replace(settings, axis_channel=0, axis_channel_count=5)
    bench = Bench(settings).running(500)
    poses: list[Floats] = []

    def step(command: core.Command = "none") -> None:
        bench.step(command)
        one = bench.station._c.controller.interface
        poses.append(np.array([one[0].x_num, one[1].x_num]))

    for _ in range(5):
        step()
    left = len(poses)
    step("hold")
    while bench.station._c.leg != 1:
        step()
    held = np.array(poses[left - 1 :])
    moves = np.diff(held, axis=0) != 0.0
    last = [np.flatnonzero(moves[:, j])[-1] for j in (0, 1)]
    assert last[0] == last[1]
    for _ in range(50):
        step()
    goal = np.array([list(row) for row in bench.station._c.resume])[:2]
    step("resume")
    path = bench.station._c.path
    ticks = int(path[0].ticks)
    assert ticks == path[1].ticks > 8
    begun = poses[-2]
    while bench.station.state == "HOLD":
        step()
    way = np.array(poses[-ticks:])
    u = np.arange(1, ticks + 1) / ticks
    for j in (0, 1):
        own = quintic(u, ticks * H, begun[j], goal[j])
        np.testing.assert_allclose(
            way[:, j], own, rtol=0, atol=1e-12 * abs(way[:, j]).max() + 1e-15
        )


def quintic(u: Floats, seconds: float, begin: float, goal: Floats) -> Floats:
    """The polynomial with these states at its ends, from its six equations."""
    rows = [[0**0 if i == 0 else 0 for i in range(6)]]
    rows.append([0, 1, 0, 0, 0, 0])
    rows.append([0, 0, 2, 0, 0, 0])
    rows.append([1] * 6)
    rows.append(list(range(6)))
    rows.append([i * (i - 1) for i in range(6)])
    right = [begin, 0.0, 0.0, goal[0], goal[1] * seconds, goal[2] * seconds**2]
    return np.asarray(np.polynomial.polynomial.polyval(u, np.linalg.solve(rows, right)))


def test_a_path_keeps_to_the_limits_of_the_slowest_axis() -> None:
    axes = (AxisConfig("left"), AxisConfig("right", velocity_limit_m_per_s=0.004))
    limits = {"path_velocity_m_per_s": 0.02, "path_acceleration_m_per_s2": 0.5}
    settings = config({"axes": axes, "lead_enabled": False}, **limits)
    bench = Bench(settings).running(600)
    since = len(bench.sent)
    bench.step("stop")
    bench.until("IDLE")
    speed = abs(np.diff(bench.commands(since), axis=0)).max(axis=0) / H
    # What was left at speed is braked first; on the way home the slow axis decides.
    home = abs(np.diff(bench.commands(since + 300), axis=0)).max(axis=0) / H
    assert home[1] <= 0.004 * (1 + 1e-9)
    assert home[0] <= 0.02
    assert speed[0] > 0.0
    assert abs(bench.commands()[-1]).max() < 2e-6


def test_ramps_of_all_axes_are_one_wave() -> None:
    bench = Bench()
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    bench.step("start")
    path = bench.station._c.path
    assert path[0].ticks == path[1].ticks >= 256


# ---- again, bit by bit --------------------------------------------------------------------------


@EITHER
@pytest.mark.parametrize("half", ["x_m", "f_n"])
@pytest.mark.parametrize("value", BAD.values(), ids=BAD)
def test_a_reading_that_is_none_on_either_axis(value: float, half: str, axis: int) -> None:
    bench = Bench().running(100)
    finite = math.isfinite(value)
    bench.step(faults={axis: {half: value}})
    assert bench.station.state == ("RUNNING" if finite else "TRIPPED")
    for pause in (1, 3, 40):
        bench.step(faults={axis: {half: value}})
        for _ in range(pause):
            bench.step()
    for _ in range(25):
        bench.step(faults={axis: {half: value}})
    assert bench.station.state == "TRIPPED"
    assert bench.station.cause == ("link_lost" if finite else "not_finite")
    assert bench.station.cause_axis == axis
    rows = bench.rows()
    for name in ("x_cmd_m", "x_meas_m", "f_meas_n"):
        assert np.isfinite(columns(rows, name)).all()
    assert abs(columns(rows, "x_cmd_m")).max() < 0.1
    again = core.Station(bench.settings, shaking(2.0)).replay(rows)
    assert again.tobytes() == rows.tobytes()


def test_a_troubled_test_replays_to_the_last_bit() -> None:
    bench = Bench(config(watched(1, "tracking", 5e-3, "indicate"))).running(50)
    random = np.random.default_rng(5)
    for n in range(900):
        axis = int(random.integers(2))
        kind = int(random.integers(40))
        faults: dict[int, dict[str, Any]] = {}
        if kind == 0:
            faults = {axis: {"lost": True}}
        if kind == 1:
            faults = {axis: {"x_m": 1e300}}
        if kind == 2:
            faults = {0: {"lost": True}, 1: {"lost": True}}
        command: core.Command = "hold" if n == 300 else "resume" if n == 700 else "none"
        bench.step(command, faults, skipped=int(kind == 3) * 2, apart=axis if kind == 4 else None)
    rows = bench.rows()
    assert {"HOLD", "RUNNING"} <= {core.STATES[s] for s in rows["state"]}
    again = core.Station(bench.settings, shaking(2.0)).replay(rows)
    assert again.tobytes() == rows.tobytes()
    spoilt = rows.copy()
    spoilt["x_read_m.1"][600] += 1e-9
    assert core.Station(bench.settings, shaking(2.0)).replay(spoilt).tobytes() != rows.tobytes()


def test_settings_of_several_axes_are_written_down_and_read_again() -> None:
    lead = MatrixLeadConfig(rest_noise_m=(1e-6, 2e-6))
    rfc = MatrixRfcConfig(SPECIMEN, (1e-6, 1e-6))
    axes = (
        AxisConfig("left", law=core.LawConfig("none"), watches={"force": Watch(3.0, "trip")}),
        AxisConfig("right", velocity_limit_m_per_s=0.1),
    )
    settings = config({"axes": axes, "matrix_lead": lead, "matrix_rfc": rfc})
    plain = settings.plain()
    again = core.StationConfig.of(plain)
    assert again.plain() == plain
    first = core.Station(settings, shaking(1.0))
    second = core.Station(again, shaking(1.0))
    a, _ = run_virtual(first, rig())
    b, _ = run_virtual(second, rig())
    assert a.tobytes() == b.tobytes()


def test_counts_that_do_not_go_together_are_refused() -> None:
    with pytest.raises(core.CoreError, match=r"2 axes, interfaces for 1"):
        core.Station(config({"interfaces": (InterfaceConfig("x"),)}), shaking(1.0))
    with pytest.raises(core.CoreError, match="kinematics for 3"):
        core.Station(config({"kinematics": Kinematics(np.eye(3))}), shaking(1.0))
    with pytest.raises(core.CoreError, match="two axes or two interfaces with the name 'one'"):
        core.Station(config({"axes": (AxisConfig("one"), AxisConfig("one"))}), shaking(1.0))
    with pytest.raises(core.CoreError, match="no quantity to watch is called energy"):
        core.Station(config(watched(0, "energy", 1.0, "trip")), shaking(1.0))
    with pytest.raises(core.CoreError, match="found 1 readings"):
        core.Station(config(), shaking(1.0)).tick(0.0, 0.0)
    one = core.VirtualRig(core.RigConfig(core.ServoConfig("pure-delay", delay_samples=1.0)))
    station = core.Station(config(), shaking(1.0))
    with pytest.raises(core.CoreError, match="the station has 2 axes, but the virtual rig has 1"):
        core.Virtual(station, one)


# ---- where the sensors have no pose --------------------------------------------------------------

WIDE = 0.4
"""m: a sensor's zero is anywhere. Two pins 0.254 m apart have no pose with 0.8 m between them."""


def coupler() -> Kinematics:
    pins = (Pin((0.267, 0.127), (1.6, 0.127)), Pin((0.267, -0.127), (1.6, -0.127)))
    return Kinematics(pins=pins, coordinates=("x", "theta"))


def pinned(**changes: Any) -> core.StationConfig:
    return config({"kinematics": coupler()}, **changes)


def test_before_zero_the_axes_stay_where_they_are_though_that_is_no_pose() -> None:
    station = core.Station(pinned(), shaking(1.0))
    raw = [AxisReading(WIDE, 45.0), AxisReading(-WIDE, -20.0)]
    for _ in range(40):
        tick = station.tick(axes=raw)
        assert tick.commands_m == (WIDE, -WIDE)
        assert station.state == "IDLE"
    station.tick(command="zero", axes=raw)
    for _ in range(70):
        assert station.tick(axes=raw).commands_m == pytest.approx((WIDE, -WIDE), abs=1e-12)
    assert station.state == "ZEROED"
    station.tick(command="arm", axes=raw)
    station.tick(command="start", axes=raw)
    for _ in range(50):
        assert station.tick(axes=raw).commands_m == pytest.approx((WIDE, -WIDE), abs=1e-9)
    assert station.state == "RAMP_IN"


def test_zero_is_refused_where_what_it_leaves_is_no_pose() -> None:
    """The drives stay where they were told first, and the readings wander off before ZERO."""
    station = core.Station(pinned(), shaking(1.0))
    station.tick(axes=[AxisReading(0.0), AxisReading(0.0)])
    away = [AxisReading(WIDE), AxisReading(-WIDE)]
    for _ in range(5):
        station.tick(axes=away)
    station.tick(command="zero", axes=away)
    for _ in range(80):
        station.tick(axes=away)
    assert station.state == "IDLE"
    assert station.zeroing_failed
    assert not station.tare_too_large
    assert station.refusal == ("no_pose", 0.0, 0.0)
    assert station.tares == ((0.0, 0.0), (0.0, 0.0))


@pytest.mark.parametrize("command", ["arm", "start"])
def test_nothing_begins_where_the_readings_have_become_no_pose(command: core.Command) -> None:
    settings = pinned()
    axes = tuple(replace(axis, rest_spread_m=1.0) for axis in settings.controller.axes)
    settings = replace(settings, controller=replace(settings.controller, axes=axes))
    station = core.Station(settings, shaking(1.0))
    here, away = [AxisReading(), AxisReading()], [AxisReading(WIDE), AxisReading(-WIDE)]
    station.tick(command="none", axes=here)
    station.tick(command="zero", axes=here)
    while station.state != "ZEROED":
        station.tick(axes=here)
    if command == "start":
        station.tick(command="arm", axes=here)
    station.tick(axes=away)
    assert station.tick(command=command, axes=away).refused
    assert station.refusal[0] == "no_pose"
    for _ in range(3):  # what is missing now is back
        station.tick(axes=here)
    assert not station.tick(command=command, axes=here).refused


def test_readings_that_become_no_pose_during_a_test_are_not_taken_and_then_trip() -> None:
    bench = Bench(pinned(), plant=rig(coupler())).running(200)
    away = {0: {"x_m": OFFSET_M[0] + WIDE}, 1: {"x_m": OFFSET_M[1] - WIDE}}
    bench.step(faults=away)
    row = bench.records[-1][-1:]
    assert row["flags"][0] & FLAGS["predicted"]
    assert abs(columns(row, "x_meas_m")).max() < 0.02
    bench.step()
    assert bench.records[-1]["flags"][-1] & FLAGS["fresh"]
    for _ in range(20):
        assert bench.station.state == "RUNNING"
        bench.step(faults=away)
    assert bench.station.state == "TRIPPED"
    assert (bench.station.cause, bench.station.cause_axis) == ("no_pose", None)
    assert abs(np.diff(bench.commands(), axis=0)).max() < 1e-3
    again = core.Station(bench.settings, shaking(2.0)).replay(bench.rows())
    assert again.tobytes() == bench.rows().tobytes()
