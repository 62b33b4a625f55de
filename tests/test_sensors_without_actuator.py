"""Displacement sensors and load cells that belong to no axis: kinematics, rig, station, tests."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import service_bench
from axes_bench import NAMES, SIDES, SPECIMEN, Bench, config, rig, shaking, structure
from command_line import Rthyb
from kernels import Floats
from test_axes_redundant import TEST

from rthyb_rt import config as files
from rthyb_rt import core
from rthyb_rt.analysis import several_axes as analysis
from rthyb_rt.analysis import structure_balance
from rthyb_rt.config import AxesRig
from rthyb_rt.core import AxisReading, CoreError, loop, wire
from rthyb_rt.core.group import AxisConfig, SensorWatches
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.core.library import STATUS
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import axes_experiment, virtual_time, zeroing
from rthyb_rt.lab.realtime import station_replay
from rthyb_rt.record import mat_csv
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig import identify_axes, virtual_rig
from rthyb_rt.rig.links import opening

READS = np.array([[1.0, 0.45], [0.3, -0.2]])
"""What two displacement sensors read for x (m) and theta (rad)."""
CARRIES = np.array([[0.4, 0.0]])
"""Share of the specimen's force that a load cell below one of its columns carries."""
FORCES = np.array([[0.5, 0.5, 1.25], [0.2, -0.3, 0.0]])
"""Half of the force along x from the axes' load cells, half from the column's."""
BOTH = Kinematics(SIDES, forces=FORCES, reads=READS, carries=CARRIES)


# ---- kinematics ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("n", "m", "p"), [(2, 2, 1), (2, 2, 4), (3, 2, 1), (4, 3, 2), (2, 1, 3)])
def test_the_pose_is_the_least_squares_one_of_all_displacements(
    n: int, m: int, p: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    matrix, reads = rng.uniform(-1, 1, (n, m)) + np.eye(n, m), rng.uniform(-1, 1, (p, m))
    x, s = rng.uniform(-0.05, 0.05, (20, n)), rng.uniform(-0.05, 0.05, (20, p))
    found = Kinematics(matrix, reads=reads).measured_pose(x, s)
    wanted = np.linalg.lstsq(np.vstack([matrix, reads]), np.hstack([x, s]).T, rcond=None)[0].T
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)


def test_given_displacements_weigh_all_sensors() -> None:
    # The lower axis' own sensor is not used: x and theta from the upper axis and the first wire.
    rows = np.vstack([SIDES[0], READS[0]])
    chosen = np.linalg.inv(rows) @ np.array([[1.0, 0, 0], [0, 0, 1]])
    tie = Kinematics(SIDES, displacements=chosen, reads=READS[:1])
    pose = np.array([[0.01, -0.02], [0.003, 0.0]])
    x = pose @ SIDES.T
    x[:, 1] += 0.7  # has no weight
    np.testing.assert_allclose(tie.measured_pose(x, pose @ READS[:1].T), pose, atol=1e-15)
    # Axes alone determine where the axes are, whatever sensors measure the pose.
    np.testing.assert_allclose(tie.pose(pose @ SIDES.T)[0], pose, atol=1e-15)
    np.testing.assert_allclose(np.hstack(tie.shares()), chosen, atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("n", "m"), [(2, 2), (3, 2), (4, 1)])
def test_forces_of_axes_and_cells_do_the_work_of_the_interface(n: int, m: int, seed: int) -> None:
    """Virtual work: interface forces along any motion, against axes and shares of the specimen."""
    rng = np.random.default_rng(40 + seed)
    matrix, carries = rng.uniform(-1, 1, (n, m)) + np.eye(n, m), rng.uniform(0.2, 0.6, (1, m))
    back = np.linalg.pinv(matrix)
    weight = rng.uniform(0.1, 0.9, (m, 1))
    # From the axes what the cell does not measure, by their transposed matrix.
    forces = np.hstack([(np.eye(m) - weight @ carries) @ matrix.T, weight])
    tie = Kinematics(matrix, forces=forces, carries=carries)
    force, moved = rng.uniform(-1e5, 1e5, (20, m)), rng.uniform(-0.05, 0.05, (20, m))
    found = tie.measured_forces(force @ back, force @ carries.T)
    axes, _ = tie.axes(moved)
    np.testing.assert_allclose(
        np.sum(found * moved, axis=1), np.sum(force @ back * axes, axis=1), rtol=1e-11, atol=1e-9
    )
    np.testing.assert_allclose(tie.readings(moved, force), force @ carries.T)


def test_a_description_is_restored_and_one_without_sensors_has_no_further_keys() -> None:
    assert Kinematics.of(BOTH.plain()).plain() == BOTH.plain()
    assert set(Kinematics(SIDES).plain()) == {"matrix", "pins", "coordinates"}
    assert BOTH.sensors == 3
    np.testing.assert_allclose(BOTH.weights(), np.linalg.inv(SIDES), atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"reads": np.ones((5, 2))}, r"reads: found shape \(5, 2\)"),
        ({"reads": [[1.0]]}, r"reads: found shape \(1, 1\)"),
        ({"reads": [[1.0, math.nan]]}, "do not determine"),
        ({"carries": CARRIES}, "found 1 load cells without an actuator, but no forces"),
        ({"carries": CARRIES, "forces": FORCES[:, :2]}, r"forces: found shape \(2, 2\)"),
        ({"carries": CARRIES, "forces": 2 * FORCES}, "do not determine"),
        ({"carries": [[math.inf, 0.0]], "forces": FORCES}, "do not determine"),
        ({"carries": [[0.4, 0.1]], "forces": FORCES}, "do not determine"),
        ({"reads": READS, "displacements": np.linalg.inv(SIDES)}, "displacements: found shape"),
        ({"reads": READS[:1], "displacements": np.ones((2, 3))}, "do not determine"),
    ],
)
def test_matrices_that_do_not_give_the_interface_are_refused(
    wrong: dict[str, Any], said: str
) -> None:
    with pytest.raises(CoreError, match=said):
        Kinematics(SIDES, **wrong)


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("which", range(3))
def test_a_senseless_reading_is_replaced_by_the_last_good_one(absurd: float, which: int) -> None:
    tie = Kinematics.of(BOTH.plain())
    pose, force = np.array([[0.01, 0.002]]), np.array([[4e3, 100.0]])
    x, f, s = pose @ SIDES.T, force @ np.linalg.inv(SIDES), tie.readings(pose, force)
    good = tie.measured_pose(x, s), tie.measured_forces(f, s)
    np.testing.assert_allclose(np.hstack(good), np.hstack([pose, force]), rtol=1e-12)
    s[0, which] = absurd
    assert np.array_equal(tie.measured_pose(x, s), good[0])
    assert np.array_equal(tie.measured_forces(f, s), good[1])


# ---- the virtual rig ----------------------------------------------------------------------------


def test_the_virtual_rig_reads_the_pose_and_the_forces_of_its_specimen() -> None:
    plant = rig(BOTH, servos=(core.ServoConfig("pure-delay", delay_samples=0.0),) * 2)
    for pose in ([1e-3, 2e-3], [-4e-3, 0.0], [0.0, 0.01]):
        x = SIDES @ pose
        plant.run(np.array([x]))
        force = np.array(plant.run(np.array([x]))[1][0]) @ SIDES
        np.testing.assert_allclose(force, SPECIMEN @ pose, rtol=1e-12)
        wanted = [*(READS @ pose), *(CARRIES @ force)]
        np.testing.assert_allclose(plant.sensors, wanted, rtol=1e-12, atol=1e-15)


def test_sensors_leave_the_noise_of_the_axes_as_it_is() -> None:
    noisy = (core.SensorConfig(1e-5),) * 2, (core.SensorConfig(10.0),) * 2
    errors = (core.SensorConfig(2e-5), core.SensorConfig(0.0, 1e-4), core.SensorConfig(5.0, 0, 9.0))
    bare = rig(displacement=noisy[0], force=noisy[1])
    beside = rig(BOTH, displacement=noisy[0], force=noisy[1], sensors=errors)
    told = 1e-3 * np.stack([shaking(2.0)] * 2, axis=1)
    read, truth = [], []
    for row in told:
        a, b = bare.step(row), beside.step(row)
        assert np.array_equal(a[0], b[0])
        assert np.array_equal(a[1], b[1])
        read.append(beside.sensors)
        truth.append(BOTH.readings([beside.pose], [SPECIMEN @ beside.pose])[0])
    off = np.array(read) - np.array(truth)
    assert off[:, 0].std() == pytest.approx(2e-5, rel=0.05)
    assert np.abs(off[:, 1]).max() <= 0.5e-4 * (1 + 1e-9)
    assert off[:, 2].mean() == pytest.approx(9.0, abs=0.5)
    assert off[:, 2].std() == pytest.approx(5.0, rel=0.05)


def test_errors_for_another_number_of_sensors_are_refused() -> None:
    with pytest.raises(CoreError, match="errors of 1 sensors without an actuator"):
        rig(BOTH, sensors=(core.SensorConfig(),))


# ---- the station --------------------------------------------------------------------------------

OFFSETS = (0.02, -0.01, 700.0)
"""Readings of the three sensors at the rig's zero."""


@dataclass
class Beside(Bench):
    """The two axes with three sensors beside them."""

    def step(
        self, command: core.Command = "none", faults: Any = None, **common: Any
    ) -> core.StationTick:
        """One tick; ``faults`` replaces readings, by sensor."""
        readings = self.read()
        sensors: list[float | None] = [
            a + b for a, b in zip(self.plant.sensors, OFFSETS, strict=True)
        ]
        for k, value in (faults or {}).items():
            sensors[k] = value
        tick = self.station.tick(command=command, axes=readings, sensors=sensors, **common)
        self.records.append(tick.records.copy())
        self.channels.append(np.array(list(self.station._c.channel[0:6])))
        if tick.sent:
            self.sent.append(tick.commands_m)
            self.at_drive = tick.commands_m
        return tick


TRIP = core.Watch(0.0, "trip")
WATCHES = (
    SensorWatches("wire", 0.2, replace(TRIP, value=30.0), replace(TRIP, value=0.004)),
    SensorWatches("string"),
    SensorWatches("column", 2e4, replace(TRIP, value=30.0), replace(TRIP, value=4e3)),
)


def bench(seconds: float = 2.0, **changes: Any) -> Beside:
    tie = Kinematics.of(BOTH.plain())
    own = {"sensors": WATCHES, "lone_channel": 0, "lone_channel_count": 6, **changes}
    return Beside(config({"kinematics": tie}, **own), seconds, plant=rig(tie))


def test_tare_and_pose_follow_all_sensors() -> None:
    """The motion equals that of the same rig without further sensors, which are redundant here."""
    beside, bare = bench().running(900), Bench(config()).running(900)
    assert beside.station.sensor_tares == pytest.approx(OFFSETS)
    assert len(beside.sent) == len(bare.sent)
    own, wanted = np.array(beside.sent), np.array(bare.sent)
    np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-9 * np.ptp(wanted))
    assert np.ptp(wanted) > 1e-3
    used, read = np.array(beside.channels)[-1, :3], np.array(beside.channels)[-1, 3:]
    np.testing.assert_allclose(used, read - OFFSETS, atol=1e-12)


def test_every_reading_enters_pose_and_force_by_its_column() -> None:
    one, other = bench().running(), bench().running()
    by = (1e-3, -2e-3, 1e3)
    for k in range(3):
        one.step()
        other.step(faults={k: one.channels[-1][3 + k] + by[k]})
        pose, force = (
            [
                getattr(each.station._c.controller.interface[j], name)
                for each in (other, one)
                for j in range(2)
            ]
            for name in ("x_m", "f")
        )
        moved, pushed = np.subtract(pose[:2], pose[2:]), np.subtract(force[:2], force[2:])
        wanted = BOTH.shares()[1][:, k] * by[k] if k < 2 else np.zeros(2)
        np.testing.assert_allclose(moved, wanted, atol=1e-8)
        np.testing.assert_allclose(pushed, FORCES[:, 2] * by[k] if k == 2 else 0.0, atol=1.0)
        one, other = bench().running(), bench().running()


@pytest.mark.parametrize("k", range(3))
def test_a_sensor_without_readings_is_predicted_and_then_trips(k: int) -> None:
    one = bench().running()
    for _ in range(5):
        tick = one.step(faults={k: None})
        assert tick.records["flags"][-1] & core.FLAGS["predicted"]
        assert not tick.records["missing"][-1]
    assert one.station.state == "RUNNING"
    assert math.isnan(one.channels[-1][3 + k])
    one.step()
    assert one.rows()["flags"][-1] & core.FLAGS["fresh"]
    for n in range(core.LOST_TICKS):
        assert one.station.state == "RUNNING", n
        one.step(faults={k: None})
    assert one.station.state == "TRIPPED"
    assert (one.station.cause, one.station.cause_sensor) == ("sensor_lost", k)
    assert one.station.cause_axis is None
    assert one.station.cause_value == core.LOST_TICKS
    placed = core.placed_cause(int(one.rows()["cause"][-1]))
    assert placed == (core.CAUSES.index("sensor_lost"), None, None, k)


def test_a_lost_reading_is_predicted_from_the_command() -> None:
    """The specimen follows its command, apart from the delay of two samples."""
    whole, gaps = bench().running(500), bench().running(500)
    for n in range(300):
        whole.step()
        gaps.step(faults={n % 3: None} if n % 10 < 3 else None)
    a, b = np.array(whole.channels)[-300:, :3], np.array(gaps.channels)[-300:, :3]
    for k in range(3):
        # Held instead of predicted, it would be off by the motion of three ticks.
        held = np.abs(a[3:, k] - a[:-3, k]).max()
        assert np.abs(b[:, k] - a[:, k]).max() < 0.1 * held


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf])
def test_a_reading_that_is_no_number_trips_at_once(k: int, absurd: float) -> None:
    one = bench().running()
    one.step(faults={k: absurd})
    assert one.station.state == "TRIPPED"
    assert (one.station.cause, one.station.cause_sensor) == ("not_finite", k)
    assert all(math.isfinite(v) for v in one.sent[-1])


@pytest.mark.parametrize(("k", "value"), [(0, 0.2), (0, -0.3), (2, 2e4), (1, 1e300)])
def test_a_reading_out_of_range_is_not_used_and_trips_like_a_lost_one(k: int, value: float) -> None:
    one = bench().running()
    for _ in range(core.LOST_TICKS):
        assert one.station.state == "RUNNING"
        tick = one.step(faults={k: value})
        assert tick.records["code"][-1] & STATUS["out_of_range"]
    assert one.station.state == "TRIPPED"
    assert (one.station.cause, one.station.cause_sensor) == ("sensor_lost", k)
    assert one.channels[-1][3 + k] == value


LOSSES = {"watches": {"lost_pairs": core.Watch(0.1, "ramp-out")}}


def now_and_then(one: Beside, fault: Callable[[int], dict[str, Any]]) -> None:
    """Ticks with a fault, until the test ends for its share of lost pairs."""
    for n in range(1200):
        one.step(**fault(n))
        if one.station.state != "RUNNING":
            return


@pytest.mark.parametrize("k", [0, 2])
@pytest.mark.parametrize("last_good", [True, False])
def test_a_sensor_that_is_at_the_end_of_its_range_now_and_then_is_the_cause_of_lost_pairs(
    k: int, last_good: bool
) -> None:
    one = bench(**LOSSES).running(200)
    beyond = (0.2, 0.0, -2.5e4)[k]
    ticks = 10 if last_good else 19
    now_and_then(one, lambda n: {"faults": {k: beyond} if n % 20 < ticks else {}})
    assert (one.station.state, one.station.cause_sensor) == ("RAMP_OUT", k)
    assert one.station.cause == ("sensor_range" if k == 0 else "force_range")
    assert one.station.cause_value == beyond
    assert one.station.cause_limit == (0.2 if k == 0 else 2e4)
    placed = core.placed_cause(int(one.rows()["cause"][-1]))
    assert placed == (core.CAUSES.index(one.station.cause), None, None, k)
    assert one.rows()["code"][-1] & STATUS["lost_rate"]


def test_the_sensor_that_made_most_of_the_lost_pairs_is_named_and_otherwise_none() -> None:
    """Two sensors by turns, frames that are lost, and frames that are lost beside one sensor."""
    both = bench(**LOSSES).running(200)
    now_and_then(
        both, lambda n: {"faults": {2: 2e4} if n % 10 < 3 else {0: 0.2} if n % 10 < 4 else {}}
    )
    assert (both.station.cause, both.station.cause_sensor) == ("force_range", 2)
    frames = bench(**LOSSES).running(200)
    now_and_then(
        frames, lambda n: {"faults": {0: None} if n % 10 < 2 else {0: 0.2} if n % 10 < 4 else {}}
    )
    assert (frames.station.cause, frames.station.cause_sensor) == ("lost_pairs", None)
    assert frames.station.cause_value == pytest.approx(103 / 1024)


@pytest.mark.parametrize(("half", "range_"), [("x_m", "x_range_m"), ("f_n", "f_range_n")])
def test_an_axis_at_the_end_of_a_range_now_and_then_is_the_cause_of_lost_pairs(
    half: str, range_: str
) -> None:
    """Of an axis without a limit on its position or force, which would end the test at once."""
    most = {"x_m": 0.3, "f_n": 3e5}[half]
    axes = tuple(AxisConfig(name, **{range_: most}) for name in NAMES)
    one = bench(**LOSSES)
    settings = replace(one.settings, controller=replace(one.settings.controller, axes=axes))
    one = Beside(settings, 2.0, plant=rig(Kinematics.of(BOTH.plain()))).running(200)
    for n in range(1200):
        axes_read = one.read()
        if n % 20 < 5:
            axes_read[1] = replace(axes_read[1], **{half: -most})
        sensors = [a + b for a, b in zip(one.plant.sensors, OFFSETS, strict=True)]
        one.at_drive = one.station.tick(axes=axes_read, sensors=sensors).commands_m
        if one.station.state != "RUNNING":
            break
    station = one.station
    assert (station.state, station.cause_axis, station.cause_sensor) == ("RAMP_OUT", 1, None)
    assert station.cause == ("sensor_range" if half == "x_m" else "force_range")
    assert (station.cause_value, station.cause_limit) == (-most, most)


@pytest.mark.parametrize("value", [2e4, -2e4, 1e13, -1e300])
def test_a_load_cell_beyond_its_range_is_beyond_the_force_limit_however_large(value: float) -> None:
    """A number that no load cell can measure does not count as a missing reading first."""
    limited = tuple(
        replace(one, watches={"force": core.Watch(1e6, "trip")})
        for one in config().controller.interfaces
    )
    tie = Kinematics.of(BOTH.plain())
    own = {"sensors": WATCHES, "lone_channel": 0, "lone_channel_count": 6}
    settings = config({"kinematics": tie, "interfaces": limited}, **own)
    one = Beside(settings, 2.0, plant=rig(tie)).running()
    one.step(faults={2: value})
    assert one.station.state == "TRIPPED"
    assert (one.station.cause, one.station.cause_sensor) == ("force", 2)
    assert one.station.cause_value == value


@pytest.mark.parametrize(("k", "cause"), [(0, "sensor_stuck"), (2, "force_stuck")])
def test_a_stuck_sensor_trips_by_name(k: int, cause: str) -> None:
    one = bench().running(400)
    held = one.channels[-1][3 + k]
    until = len(one.records)
    while one.station.state == "RUNNING" and len(one.records) < until + 200:
        one.step(faults={k: held})
    assert one.station.state == "TRIPPED"
    assert (one.station.cause, one.station.cause_sensor) == (cause, k)
    assert len(one.records) - until >= 30


@pytest.mark.parametrize("least", range(2))
def test_a_sensor_is_stuck_once_any_axis_has_moved_more_than_it_may_at_rest(least: int) -> None:
    """The other axis may vary by more than it ever moves here, the first of the two or not."""
    tie = Kinematics.of(BOTH.plain())
    axes = tuple(
        replace(one, rest_spread_m=1e-4 if i == least else 1.0)
        for i, one in enumerate(config().controller.axes)
    )
    settings = config({"kinematics": tie, "axes": axes}, sensors=WATCHES)
    one = Beside(settings, plant=rig(tie)).running(400)
    held = one.station._c.lone[0].reading
    for _ in range(200):
        one.step(faults={0: held})
    assert (one.station.cause, one.station.cause_sensor) == ("sensor_stuck", 0)


def test_a_sensor_that_does_not_respond_to_the_motion_is_not_stuck() -> None:
    """A load cell along theta repeats 0 N while only x moves."""
    carries, k = np.array([[0.0, 0.4]]), np.diag([6e5, 4e4])
    forces = np.array([[1.0, 1.0, 0.0], [0.1, -0.15, 1.25]])
    tie = Kinematics(SIDES, forces=forces, carries=carries)
    watches = (SensorWatches("moment", 0.0, core.Watch(5.0, "trip")),)
    load = np.array([4220.0, 0.0])

    part = structure(k, load_kg=load)
    one = core.Station(
        config({"kinematics": tie, "numerical": part}, sensors=watches), shaking(1.0)
    )
    plant = rig(tie, stiffness=k)
    at = (0.0, 0.0)
    script = {0: "none", 1: "zero", 70: "arm", 71: "start"}
    for n in range(1300):
        x, f = plant.run(np.array([at]))
        readings = [AxisReading(x[0, i], f[0, i]) for i in range(2)]
        command: Any = script.get(n, "none")
        tick = one.tick(command=command, axes=readings, sensors=plant.sensors)
        at = tick.commands_m if tick.sent else at
        assert one.state != "TRIPPED", one.cause
    assert np.ptp(x) >= 0


@pytest.mark.parametrize(("k", "by", "cause"), [(0, 0.01, "sensor_jump"), (2, 9e3, "force_jump")])
def test_a_jump_trips_by_name(k: int, by: float, cause: str) -> None:
    one = bench().running()
    one.step(faults={k: one.channels[-1][3 + k] + by})
    assert one.station.state == "TRIPPED"
    assert (one.station.cause, one.station.cause_sensor) == (cause, k)
    assert one.station.cause_value == pytest.approx(by, rel=0.2)


def test_arm_is_refused_while_a_sensor_is_off_its_scale() -> None:
    one = bench()
    one.step()
    one.step("zero")
    one.until("ZEROED")
    assert one.step("arm", faults={2: 2.5e4}).refused is False
    # ARM looks at the readings of the tick before.
    one.step("stop")
    one.step("zero")
    one.until("ZEROED")
    one.step(faults={2: 2.5e4})
    assert one.step("arm", faults={2: 2.5e4}).refused
    assert one.station.refusal == ("force", 2.5e4, 2e4)
    assert (one.station.refusal_sensor, one.station.refusal_axis) == (2, None)


LIMITED = (
    SensorWatches("wire", 0.2, rest_spread=1e-3, tare_most=0.05),
    SensorWatches("string", rest_spread=1e-3, tare_most=0.05),
    SensorWatches("column", 2e4, tare_most=5e3),
)


def zero(faults: Callable[[int], Any], sensors: tuple[SensorWatches, ...] = LIMITED) -> Beside:
    """Zero with readings replaced by the number of the tick, until it ends either way."""
    one = bench(sensors=sensors)
    one.step(faults=faults(0))
    one.step("zero", faults=faults(1))
    for n in range(2, 300):
        if one.station.state == "ZEROED" or one.station.zeroing_failed:
            break
        one.step(faults=faults(n))
    return one


def test_zero_waits_for_a_reading_of_every_sensor() -> None:
    one = zero(lambda n: {1: None} if n % core.LOST_TICKS else {})
    assert one.station.state == "IDLE"
    assert not one.station.zeroing_failed
    one.until("ZEROED", most=200)
    assert one.station.sensor_tares == pytest.approx(OFFSETS)


@pytest.mark.parametrize("k", range(3))
def test_zero_ends_and_names_a_sensor_that_gives_no_reading(k: int) -> None:
    one = zero(lambda n: {k: None} if n >= 10 else {})
    assert len(one.records) == 10 + core.LOST_TICKS
    assert one.station.state == "IDLE"
    assert one.station.zeroing_failed
    assert not one.station.tare_too_large
    assert one.station.refusal == ("sensor_lost", core.LOST_TICKS, core.LOST_TICKS)
    assert (one.station.refusal_sensor, one.station.refusal_axis) == (k, None)
    one.step("zero")
    one.until("ZEROED", most=200)


@pytest.mark.parametrize(
    ("k", "value", "found"), [(0, -0.25, ("position", -0.25, 0.2)), (2, 3e4, ("force", 3e4, 2e4))]
)
def test_zero_names_a_sensor_at_the_end_of_its_range(k: int, value: float, found: Any) -> None:
    one = zero(lambda _: {k: value})
    assert one.station.zeroing_failed
    assert (one.station.refusal, one.station.refusal_sensor) == (found, k)


@pytest.mark.parametrize("k", range(2))
def test_zero_is_refused_if_a_displacement_sensor_moves(k: int) -> None:
    one = zero(lambda n: {k: OFFSETS[k] + 1e-4 * n})
    assert one.station.state == "IDLE"
    assert one.station.zeroing_failed
    assert not one.station.tare_too_large
    cause, spread, allowed = one.station.refusal
    assert (cause, allowed, one.station.refusal_sensor) == ("none", 1e-3, k)
    assert 1e-3 < spread < 1.15e-3
    # The same way down, within what is allowed, over the 64 readings of the tare.
    still = zero(lambda n: {k: OFFSETS[k] - 1.4e-5 * n})
    assert still.station.state == "ZEROED"


@pytest.mark.parametrize(
    ("k", "cause", "limit"), [(0, "rig_position", 0.05), (1, "rig_position", 0.05),
                              (2, "rig_force", 5e3)],
)  # fmt: skip
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_zero_is_refused_if_the_tare_of_a_sensor_is_too_large(
    k: int, cause: str, limit: float, sign: float
) -> None:
    one = zero(lambda _: {k: sign * 1.01 * limit})
    assert one.station.state == "IDLE"
    assert one.station.tare_too_large
    assert one.station.refusal == (cause, pytest.approx(sign * 1.01 * limit), limit)
    assert (one.station.refusal_sensor, one.station.refusal_axis) == (k, None)
    assert one.station.sensor_tares == (0.0, 0.0, 0.0)
    assert zero(lambda _: {k: sign * 0.99 * limit}).station.state == "ZEROED"


FROZEN = {0: "sensor_stuck", 1: "sensor_stuck", 2: "force_stuck"}


def noisy(n: int, k: int) -> dict[int, float]:
    """A reading of one sensor that never repeats the one before."""
    return {k: OFFSETS[k] + 1e-5 * (n % 2)}


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("since", [0, 30])
def test_zero_is_refused_if_a_reading_is_frozen(k: int, since: int) -> None:
    """From the beginning of the tare, or in the middle of it."""
    watched = tuple(replace(one, frozen_ticks=24 * (i == k)) for i, one in enumerate(LIMITED))
    one = zero(lambda n: {k: OFFSETS[k]} if n >= since else noisy(n, k), watched)
    assert one.station.state == "IDLE"
    assert one.station.zeroing_failed
    assert not one.station.tare_too_large
    assert one.station.refusal == (FROZEN[k], 24.0, 24.0)
    assert (one.station.refusal_sensor, one.station.refusal_axis) == (k, None)
    # The tare begins with the tick of the command.
    assert len(one.records) == 24 + max(since, 1)
    assert one.station.sensor_tares == (0.0, 0.0, 0.0)
    # One reading less, and then another one.
    whole = zero(lambda n: {k: OFFSETS[k]} if n % 24 else noisy(1, k), watched)
    assert whole.station.state == "ZEROED"
    # A sensor of which nothing is known is zeroed with what it reads.
    assert zero(lambda n: {k: OFFSETS[k]}).station.state == "ZEROED"


@pytest.mark.parametrize("cause", ["sensor_stuck", "force_stuck"])
def test_zero_is_refused_if_a_reading_of_an_axis_is_frozen(cause: str) -> None:
    own = {"x_frozen_ticks": 24} if cause == "sensor_stuck" else {"f_frozen_ticks": 24}
    axes = (AxisConfig(NAMES[0]), AxisConfig(NAMES[1], **own))
    one = Bench(config({"axes": axes}))

    def ends(faults: Callable[[int], Any]) -> str:
        one.step(faults=faults(0))
        one.step("zero", faults=faults(1))
        for n in range(2, 300):
            if one.station.state == "ZEROED" or one.station.zeroing_failed:
                break
            one.step(faults=faults(n))
        return one.station.state

    at = one.read()[1]
    still = {"x_m": at.x_m, "f_n": at.f_n}
    moving = {
        half: {**still, half: still[half] + size} for half, size in (("x_m", 1e-6), ("f_n", 1.0))
    }
    half = "x_m" if cause == "sensor_stuck" else "f_n"
    assert ends(lambda n: {1: moving[half] if n % 2 else still}) == "ZEROED"
    assert ends(lambda _: {1: still}) == "IDLE"
    assert one.station.refusal == (cause, 24.0, 24.0)
    assert (one.station.refusal_axis, one.station.refusal_sensor) == (1, None)
    again = core.Station(one.settings, shaking(2.0))
    made = again.replay(np.concatenate(one.records))
    wanted = np.ascontiguousarray(core.rows.as_records(np.concatenate(one.records)))
    assert made.tobytes() == wanted.tobytes()
    assert again.refusal == one.station.refusal


def test_start_and_reset_name_a_sensor_without_a_reading() -> None:
    one = bench()
    one.step()
    one.step("zero")
    one.until("ZEROED")
    one.step("arm")
    for _ in range(3):
        one.step(faults={1: None})
    assert one.step("start", faults={1: None}).refused
    assert (one.station.refusal, one.station.refusal_sensor) == (("sensor_lost", 3.0, 20.0), 1)
    one.step("trip")
    for _ in range(40):
        one.step(faults={0: None})
    assert one.step("reset", faults={0: None}).refused
    assert (one.station.refusal, one.station.refusal_sensor) == (("sensor_lost", 41.0, 20.0), 0)
    assert one.step("reset", faults={2: 3e4}).refused
    assert (one.station.refusal, one.station.refusal_sensor) == (("force", 3e4, 2e4), 2)
    for _ in range(40):
        one.step()
    assert not one.step("reset").refused


@pytest.mark.parametrize("which", ["none", "sensor", "axis"])
def test_the_command_of_a_stopped_drive_follows_its_axis_without_the_sensors(which: str) -> None:
    """Otherwise a drive that is released would jump back to where it stood before."""
    one = bench(sensors=(SensorWatches("wire"), SensorWatches("string"), SensorWatches("column")))

    def tick(x_m: float, *, missing: bool, **own: Any) -> core.StationTick:
        lost = missing and which == "axis"
        axes = [AxisReading(x_m, 0.0, lost=lost, **own), AxisReading(0.01, 0.0)]
        wire = None if missing and which == "sensor" else 0.0
        return one.station.tick(axes=axes, sensors=(wire, 0.0, 0.0))

    for _ in range(5):
        tick(0.01, missing=False)
    for n in range(60):
        tick(0.01 + 1e-4 * n, missing=True, drive_stopped=True)
    told = tick(0.01 + 1e-4 * 59, missing=True)
    assert told.sent
    assert told.commands_m == pytest.approx((0.01 if which == "axis" else 0.0159, 0.01))


@pytest.mark.parametrize("k", range(3))
def test_readings_with_faults_are_replayed_bit_for_bit(k: int) -> None:
    one = bench().running()
    for n in range(60):
        one.step(faults={k: None} if n % 7 < 3 else {k: 1e7} if n % 11 == 0 else None)
    one.step(faults={k: math.nan})
    for _ in range(5):
        one.step(faults={k: None})
    rows, channels = one.rows(), np.array(one.channels)
    again = core.Station(one.settings, shaking(2.0))
    made = again.replay(rows, sensors=channels[:, 3:])
    assert made.tobytes() == np.ascontiguousarray(core.rows.as_records(rows)).tobytes()
    assert (again.cause, again.cause_sensor) == (one.station.cause, one.station.cause_sensor)


def test_a_test_that_a_range_ended_is_replayed_bit_for_bit() -> None:
    one = bench(**LOSSES).running(200)
    now_and_then(one, lambda n: {"faults": {2: 2e4} if n % 20 < 9 else {}})
    one.until("IDLE", most=5000)
    rows, channels = one.rows(), np.array(one.channels)
    again = core.Station(one.settings, shaking(2.0))
    made = again.replay(rows, sensors=channels[:, 3:])
    assert made.tobytes() == np.ascontiguousarray(core.rows.as_records(rows)).tobytes()
    assert (again.cause, again.cause_sensor) == ("force_range", 2)


def test_numbers_of_sensors_that_do_not_match_are_refused() -> None:
    one = bench()
    with pytest.raises(CoreError, match="one for each of 3"):
        one.station.tick(axes=[AxisReading(), AxisReading()])
    with pytest.raises(CoreError, match="settings of 1 sensors"):
        bench(sensors=WATCHES[:1])
    with pytest.raises(CoreError, match="sensors without an actuator"):
        core.Virtual(one.station, rig())
    settings = core.StationConfig.of(one.settings.plain())
    assert settings.plain() == one.settings.plain()


# ---- files --------------------------------------------------------------------------------------

AXIS = """[[axis]]
name = "{name}"
actuator = {{ kind = "second-order", natural_frequency_hz = {hz}, damping_ratio = 0.7 }}
limits = {{ command_position_m = "30 mm", force_n = "90 kN" }}
sensors = {{ displacement = {{ noise_std_m = 5e-6 }}, force = {{ noise_std_n = 20 }} }}
identified = {{ alpha = 11.0, delay_s = 0.011 }}
"""
WIRE = """[[sensor]]
kind = "displacement"
name = "wire"
along = { first = 1, second = 0.5 }
noise_std_m = 2e-6
range_m = "80 mm"
"""
COLUMN = """[[sensor]]
kind = "force"
name = "column"
along = { first = 0.4 }
noise_std_n = 10
range_n = "70 kN"
stuck_s = 0.2
jump_n = "20 kN"
"""
HALVES = "forces = [[0.5, 0.5, 1.25], [0, 1, 0]]\n"
HEAD = """schema = "rthyb-rig/1"
[rig]
name = "floor"
seed = 5
"""
RIG = (
    HEAD
    + "".join(AXIS.format(name=n, hz=hz) for n, hz in zip(NAMES, (20, 22), strict=True))
    + "#sensors\n"
    + """[kinematics]
kind = "matrix"
interface = ["first", "second"]
matrix = [[1, 0], [1, 1]]
#forces
[specimen]
stiffness = [[8e6, -1e6], [-1e6, 6e6]]
[limits]
ramp_in_s = 1.5
"""
)
MATRIX = np.array([[1.0, 0.0], [1.0, 1.0]])
STIFFNESS = np.array([[8e6, -1e6], [-1e6, 6e6]])
WITH_WIRE = RIG.replace("#sensors\n", WIRE)
WITH_CELL = RIG.replace("#sensors\n", COLUMN).replace("#forces\n", HALVES)
WITH_BOTH = WITH_CELL.replace("[kinematics]", WIRE + "[kinematics]")


def read(text: str) -> AxesRig:
    found = files.parse_any_rig(text, "floor.toml")
    assert isinstance(found, AxesRig)
    return found


def test_columns_are_axes_then_sensors_in_the_order_of_the_file() -> None:
    second = WIRE.replace('"wire"', '"string"').replace("first = 1, second = 0.5", "second = 1")
    tie = read(WITH_BOTH.replace("[kinematics]", second + "[kinematics]")).core_kinematics()
    pose, force = np.array([[0.01, 0.03]]), np.array([[1e3, 2e3]])
    np.testing.assert_allclose(tie.readings(pose, force), [[0.025, 0.03, 400.0]])
    assert (tie.displacement_sensors, tie.force_sensors) == (2, 1)


def test_a_file_is_written_and_read_again() -> None:
    rig_file = read(WITH_BOTH)
    assert read(files.dump(rig_file)) == rig_file
    assert "sensor = " not in files.dump(read(RIG))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "force"', 'kind = "strain"', 'sensor.column.kind: found "strain"'),
        ("along = { first = 0.4 }", "along = { third = 0.4 }", 'column: found along = "third"'),
        ("along = { first = 0.4 }", "along = { first = nan }", "found nan"),
        ("along = { first = 0.4 }", "along = { first = 0 }", "for a unit along each direction"),
        ("along = { first = 0.4 }", "along = {}", "found no direction"),
        ("along = { first = 0.4 }\n", "", "column.along: missing; add along = { name = value"),
        ('name = "column"', 'name = "wire"', 'sensors 1 and 2 are both called "wire"'),
        ('name = "column"', 'name = "Column 1"', 'sensor.Column 1.name: found "Column 1"'),
        (
            HALVES,
            "",
            "forces is missing; with the load cell column, which belongs to no axis",
        ),
        (
            HALVES,
            "forces = [[1, 1], [0, 1]]\n",
            "of 3 numbers, one for each axis (left, right) and each sensor of kind force (column)",
        ),
        (
            HALVES,
            "forces = [[1, 1, 1.25], [0, 1, 0]]\n",
            "give [1.5, 0]; [0, 1]; must be the identity",
        ),
        (
            HALVES,
            HALVES + "displacements = [[1, 0], [-1, 1]]\n",
            "each sensor of kind displacement (wire)",
        ),
        (
            HALVES,
            HALVES + "displacements = [[1, 0, 1], [-1, 1, 0]]\n",
            "displacements: found rows that times matrix with the sensors' along below it give "
            "[2, 0.5]; [0, 1]",
        ),
        ('range_n = "70 kN"', "range_n = -1", "sensor.column.range_n: found -1"),
        ("noise_std_n = 10\nrange", "noise_std_m = 10\nrange", "noise_std_m"),
    ],
)
def test_a_fault_is_told_with_file_key_and_value(old: str, new: str, said: str) -> None:
    assert old in WITH_BOTH
    with pytest.raises(InputError) as caught:
        read(WITH_BOTH.replace(old, new, 1))
    problems = [str(one) for one in caught.value.problems]
    assert any(said in one for one in problems), problems
    assert all(one.startswith("floor.toml:") for one in problems)


@pytest.mark.parametrize("cell", ["", COLUMN])
def test_sensors_that_blur_the_position_are_named_as_the_reason(cell: str) -> None:
    """Alone, the axes determine the position, although they are nearly side by side."""
    near = RIG.replace("matrix = [[1, 0], [1, 1]]", "matrix = [[1, 1], [1, 1.001]]")
    read(near)
    text = near.replace("#sensors\n", WIRE.replace("second = 0.5", "second = 1") + cell)
    if cell:
        # Half of the force along first from the axes, half from the column: no fault of theirs.
        rows = "[[0.5, 0.5, 1.25], [1, 1.001, 0]]"
        text = text.replace("#forces\n", f"forces = {rows}\n")
    with pytest.raises(InputError) as caught:
        read(text)
    (said,) = (str(one) for one in caught.value.problems)
    assert "kinematics: matrix: found the rows [1, 1]; [1, 1.001], and below them" in said
    assert "displacement sensors (along) [1, 1]" in said


def test_pins_of_a_sensor_do_not_go_with_a_matrix_nor_along_with_pins() -> None:
    pins = """[kinematics]
kind = "pins"
interface = ["x", "theta"]
pins_m = { left = [0, 0.1], right = [0, -0.1] }
directions = { left = [1, 0], right = [1, 0] }
"""
    text = (
        WITH_WIRE[: WITH_WIRE.index("[kinematics]")]
        .replace("first", "x")
        .replace("second = 0.5", "theta = 0.5")
    )
    text += pins + "[specimen]\nstiffness = [[8e6, 0], [0, 6e6]]\n"
    with pytest.raises(InputError, match=r'wire: found along, which goes with a matrix; .*"pins"'):
        read(text)
    by_pins = WITH_WIRE.replace("along = { first = 1, second = 0.5 }", "pin_m = [0, 1]")
    with pytest.raises(InputError, match=r"wire: found pin_m, which goes with pins; .* with along"):
        read(by_pins)
    without = WITH_WIRE.replace("along = { first = 1, second = 0.5 }\n", "")
    with pytest.raises(InputError, match=r"wire.along: missing; add along = \{ name = value"):
        read(without)


def test_a_key_is_set_by_the_name_of_the_sensor(tmp_path: Path) -> None:
    path = tmp_path / "floor.toml"
    path.write_text(WITH_BOTH, encoding="utf-8")
    found = files.load_any_rig(path, {"rig.sensor.wire.noise_std_m": "3 um"})
    assert isinstance(found, AxesRig)
    assert [one.noise_std_m for one in found.lone_sensors if one.kind == "displacement"] == [3e-6]
    with pytest.raises(InputError, match=r"sensor has the entries 0 to 1 \(column, wire\)"):
        files.load_any_rig(path, {"rig.sensor.5.noise_std_m": "3 um"})


def test_too_many_sensors_of_a_kind_are_refused() -> None:
    more = "".join(WIRE.replace('"wire"', f'"wire{k}"') for k in range(5))
    with pytest.raises(InputError, match=r"found 5 sensors of kind = .displacement.*up to 4"):
        read(RIG.replace("#sensors\n", more))


REDUNDANT = (
    HEAD
    + "".join(AXIS.format(name=n, hz=20) for n in ("left", "middle", "right"))
    + COLUMN
    + """[kinematics]
kind = "matrix"
interface = ["first", "second"]
matrix = [[1, 0], [1, 1], [1, 1]]
forces = FORCES
[specimen]
stiffness = [[8e6, -1e6], [-1e6, 6e6]]
attachment_stiffness_n_per_m = 1e8
"""
)


def test_forces_by_which_redundant_actuators_oppose_each_other_are_no_force_of_the_specimen() -> (
    None
):
    """Middle and right push on the same line: what both of them count alike has no resultant."""
    tie = read(
        REDUNDANT.replace("FORCES", "[[0.5, 0.5, 0.5, 1.25], [0, 1, 1, 0]]")
    ).core_kinematics()
    pushing = np.array([[0.0, 7e3, -7e3]])
    np.testing.assert_allclose(tie.measured_forces(pushing, [[0.0]]), 0.0, atol=1e-9)
    for rows, said in (
        # Right for the shares that the axes have of a force of the specimen, 1/2 each.
        ("[[0.5, 1, 0, 1.25], [0, 1, 1, 0]]", "forces: found the row [0.5, 1, 0, 1.25] for first"),
        ("[[0.5, 0.5, 0.5, 1.25], [0, 2, 0, 0]]", "found the row [0, 2, 0, 0] for second, which"),
    ):
        with pytest.raises(InputError) as caught:
            read(REDUNDANT.replace("FORCES", rows))
        (problem,) = (str(one) for one in caught.value.problems)
        assert said in problem
        assert "left 0 N, middle" in problem
        assert "only push against each other" in problem


@pytest.mark.parametrize("axes", [2, 3, 4])
def test_four_sensors_of_each_kind_fit_beside_any_number_of_axes(axes: int) -> None:
    names = [f"a{k}" for k in range(axes)]
    along = ", ".join(f"d{k} = {0.5 + 0.1 * k:g}" for k in range(axes))
    of = {
        kind: "".join(
            text.replace(f'"{name}"', f'"{name}{n}"').replace(old, f"along = {{ {along} }}")
            for n in range(4)
        )
        for kind, text, name, old in (
            ("m", WIRE, "wire", "along = { first = 1, second = 0.5 }"),
            ("N", COLUMN, "column", "along = { first = 0.4 }"),
        )
    }
    eye = np.eye(axes)
    text = (
        HEAD
        + "".join(AXIS.format(name=name, hz=20) for name in names)
        + of["m"]
        + of["N"]
        + f"""[kinematics]
kind = "matrix"
interface = {[f"d{k}" for k in range(axes)]}
matrix = {eye.tolist()}
forces = {np.hstack([eye, np.zeros((axes, 4))]).tolist()}
[specimen]
stiffness = {(6e6 * eye).tolist()}
"""
    )
    storeys = "".join(f'[[interface]]\nname = "d{k}"\nstorey = {k + 1}\n' for k in range(axes))
    test = TEST[: TEST.index("[[interface]]")] + storeys + '[controller]\ntype = "paper"\n'
    test = test.replace("count = 3", f"count = {axes + 1}").replace('"6 s"', '"1 s"')
    test = test.replace("0.1 g", "0.02 g")
    test = test.replace(
        "[1, 2]\n[numerical.damping]", f"{[*range(1, axes + 1)]}\n[numerical.damping]"
    )
    setup = axes_experiment.prepare(files.parse_test(test, "test.toml"), read(text))
    names = [one.name for one in setup.channels]
    assert len(names) == 5 * (axes - 1) + 16 + 2 * (axes + 1)  # and drifts and shears
    done = virtual_time.run(setup)
    assert done.meta["end_reason"] == "completed"
    for name in ("wire0_read", "wire3", "column0", "column3_read"):
        assert np.ptp(done.samples[name][done.running()]) > 0
    assert station_replay.replay(done).identical


@pytest.mark.parametrize("name", ["x_true_m_1", "x_num_m_1", "state"])
def test_a_name_that_a_recording_has_already_is_refused(name: str) -> None:
    test = files.parse_test(TEST, "test.toml")
    with pytest.raises(InputError, match=f'found "{name}", but a recording of this test already'):
        axes_experiment.prepare(test, read(WITH_WIRE.replace('"wire"', f'"{name}"')))


def test_the_name_of_a_variable_of_exported_files_is_refused(
    bare: RecordedTest, tmp_path: Path
) -> None:
    mat_csv.to_mat(bare, tmp_path / "bare.mat")
    own = {name for name, _, _ in scipy.io.whosmat(tmp_path / "bare.mat")}
    beside = own - set(bare.samples.dtype.names or ()) - {"ag_mps2"}
    assert beside >= {"x_ref_m", "t_s", "meta"}
    test = files.parse_test(TEST, "test.toml")
    for name in beside:
        with pytest.raises(InputError, match=f'exported files have a variable "{name}"'):
            axes_experiment.prepare(test, read(WITH_WIRE.replace('"wire"', f'"{name}"')))


@pytest.mark.parametrize("name", ["wire", "wire_read"])
def test_the_name_of_an_extra_sensor_is_refused_where_the_sensor_has_it(name: str) -> None:
    text = WITH_WIRE.replace(
        "sensors = { ", f'sensors = {{ extra = [{{ name = "{name}", unit = "m" }}], ', 1
    )
    with pytest.raises(InputError) as caught:
        axes_experiment.prepare(files.parse_test(TEST, "test.toml"), read(text))
    (said,) = (str(one) for one in caught.value.problems)
    assert f'found "wire", but axis left has an extra sensor "{name}"' in said
    assert said.split(": ")[1].startswith("sensor.")


# ---- zeroing ------------------------------------------------------------------------------------


def watches_of(text: str, test: str = TEST) -> dict[str, SensorWatches]:
    setup = axes_experiment.prepare(files.parse_test(test, "test.toml"), read(text))
    assert setup.group is not None
    return {one.name: one for one in axes_experiment.station_config(setup, setup.group).sensors}


def test_a_tare_may_be_what_the_limits_of_the_axes_give_a_sensor() -> None:
    """A fifth of 30 mm and 90 kN at each axis: first = x, second = x2 - x1; first = f1 + f2."""
    found = watches_of(WITH_BOTH)
    assert found["wire"].tare_most == pytest.approx(0.5 * 6e-3 + 0.5 * 6e-3)
    assert found["column"].tare_most == pytest.approx(0.4 * (18e3 + 18e3))
    assert watches_of(
        WITH_BOTH.replace("along = { first = 1, second = 0.5 }", "along = { second = 2 }")
    )["wire"].tare_most == pytest.approx(2 * (6e-3 + 6e-3))
    # An axis without a limit: none for a cell that carries its force.
    free = watches_of(WITH_BOTH.replace(', force_n = "90 kN"', "", 1))
    assert (free["column"].tare_most, free["wire"].tare_most) == (0.0, found["wire"].tare_most)


def test_a_displacement_sensor_may_vary_as_the_axes_may_or_by_its_noise() -> None:
    stated = TEST + '\n[limits]\nrest_spread_m = "0.2 mm"\n'
    noisy = WITH_BOTH.replace("noise_std_m = 2e-6", "noise_std_m = 2e-5")
    coarse = WITH_BOTH.replace("noise_std_m = 2e-6", "lsb_m = 1e-4")
    assert watches_of(WITH_BOTH)["wire"].rest_spread == pytest.approx(1e-4)
    assert watches_of(WITH_BOTH, stated)["wire"].rest_spread == pytest.approx(2e-4)
    assert watches_of(noisy)["wire"].rest_spread == pytest.approx(20 * 2e-5)
    assert watches_of(noisy, stated)["wire"].rest_spread == pytest.approx(20 * 2e-5)
    assert watches_of(coarse)["wire"].rest_spread == pytest.approx(20 * 1e-4 / math.sqrt(12))
    assert watches_of(noisy)["column"].rest_spread == 0.0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "noise_std_m = 2e-6",
            "bias_m = 9e-3",
            "the tare of the displacement of sensor wire would be 9 mm, but at most 6 mm is",
        ),
        (
            "noise_std_n = 10\n",
            'bias_n = "-20 kN"\n',
            "the tare of the force of sensor column would be -20 kN, but at most 14.4 kN",
        ),
        ("noise_std_m = 2e-6", "bias_m = 0.09", "sensor wire: displacement 80.0 mm (limit 80 mm)"),
        ("noise_std_n = 10\n", "bias_n = -8e4\n", "sensor column: force 70.0 kN (limit 70 kN)"),
    ],
)
def test_a_test_that_cannot_be_zeroed_names_the_sensor(old: str, new: str, said: str) -> None:
    assert old in WITH_BOTH
    with pytest.raises(RthybError, match=re.escape(said)):
        completed(WITH_BOTH.replace(old, new, 1))


def test_a_sensor_that_moves_during_the_tare_is_named() -> None:
    setup = axes_experiment.prepare(files.parse_test(TEST, "test.toml"), read(WITH_BOTH))
    assert setup.group is not None
    found = axes_experiment.station_config(setup, setup.group)
    # Its noise has a span of some 13 um.
    sensors = tuple(replace(one, rest_spread=one.rest_spread / 20) for one in found.sensors)
    one = virtual_time.Bench(setup, config=replace(found, sensors=sensors))
    with pytest.raises(
        RthybError,
        match=r"not at rest: the displacement of sensor wire moved by 0\.\d+ mm during the tare of "
        r"1 s, but at most 0\.005 mm is allowed \(limits\.rest_spread_m\)",
    ):
        virtual_time.conduct(one)


def test_a_sensor_without_readings_is_named_among_what_is_silent() -> None:
    text = WITH_BOTH.replace("noise_std_n = 10\n", "bias_n = -8e4\n")
    one = virtual_time.Bench(
        axes_experiment.prepare(files.parse_test(TEST, "test.toml"), read(text))
    )
    assert not zeroing.silent_sensors(one.run)
    one.advance(25)
    assert zeroing.silent_sensors(one.run) == (
        "sensor column: no usable reading for 25 ticks, because it reads −70.00 kN, at or beyond "
        "the end of its range of 70.0 kN (range_n in the rig file)"
    )


def test_the_tares_of_the_sensors_are_told_by_name() -> None:
    text = quiet(WITH_BOTH).replace("range_m", "bias_m = 2e-3\nrange_m")
    setup = axes_experiment.prepare(
        files.parse_test(TEST, "test.toml"), read(text.replace("range_n", "bias_n = -5e3\nrange_n"))
    )
    one = virtual_time.Bench(setup)
    one.command("zero")
    one.advance(2 * one.config.tare_ticks)
    assert one.state == "ZEROED"
    found = zeroing.tares(one.run)["sensors"]
    assert found["wire"] == {"displacement_m": pytest.approx(2e-3)}
    assert found["column"] == {"force_n": pytest.approx(-5e3)}
    said = zeroing.in_words(one.run)
    assert said.startswith("left tare ")
    assert said.endswith("wire tare 2.000 mm; column tare -5.000 kN")
    assert "sensors" not in zeroing.tares(virtual_time.Bench(
        axes_experiment.prepare(files.parse_test(TEST, "test.toml"), read(RIG))
    ).run)  # fmt: skip


# ---- whole tests --------------------------------------------------------------------------------


def completed(text: str, test: str = TEST) -> RecordedTest:
    rec = virtual_time.run(axes_experiment.prepare(files.parse_test(test, "test.toml"), read(text)))
    assert rec.meta["end_reason"] == "completed"
    return rec


@pytest.fixture(scope="module")
def bare() -> RecordedTest:
    return completed(RIG)


@pytest.fixture(scope="module")
def celled() -> RecordedTest:
    return completed(WITH_CELL)


@pytest.fixture(scope="module")
def wired() -> RecordedTest:
    return completed(WITH_WIRE)


def axes_of(rec: RecordedTest, key: str) -> Floats:
    return np.column_stack([rec.axis(n)[key][rec.running()] for n in NAMES])


@pytest.mark.parametrize("which", ["celled", "wired"])
def test_a_test_follows_its_reference(which: str, request: pytest.FixtureRequest) -> None:
    found = analysis.summarize(request.getfixturevalue(which))
    assert [one.name for one in found.directions] == ["first", "second"]
    for direction in found.directions:
        assert direction.peak > 2e-3
        assert direction.response_nrmse < 0.05


def test_the_force_at_the_interface_is_the_sum_of_all_cells(celled: RecordedTest) -> None:
    """Against the elastic specimen; the column carries 0.4 of the force along x."""
    rows = celled.running()
    f, pose = axes_of(celled, "f_meas_n"), axes_of(celled, "x_meas_m") @ np.linalg.inv(MATRIX).T
    column_n = celled.samples["column"][rows]
    wanted = pose @ STIFFNESS
    found = np.column_stack([f, column_n]) @ np.array([[0.5, 0.5, 1.25], [0.0, 1.0, 0.0]]).T
    # Noise of 5 um times the stiffness, and of the load cells.
    assert np.abs(found - wanted).max() < 0.02 * np.abs(wanted).max()
    assert np.abs(column_n - 0.4 * wanted[:, 0]).max() < 0.02 * np.abs(wanted[:, 0]).max()


def test_three_readings_give_two_directions_by_least_squares(wired: RecordedTest) -> None:
    """Without noise all agree; with it, the pose of all three is what the summary judges."""
    rows = wired.running()
    x, wire = axes_of(wired, "x_meas_m"), wired.samples["wire"][rows]
    pose = np.linalg.lstsq(
        np.vstack([MATRIX, [1.0, 0.5]]), np.column_stack([x, wire]).T, rcond=None
    )[0].T
    np.testing.assert_allclose(wire, pose @ [1.0, 0.5], atol=5e-5)
    found = analysis.summarize(wired)
    for j, direction in enumerate(found.directions):
        own = wired.samples["x_num_m_1" if j else "x_num_m"][rows]
        error = np.sqrt(np.mean((pose[:, j] - own) ** 2) / np.mean(own**2))
        assert direction.tracking_nrmse == pytest.approx(error, rel=1e-9)
    # The axes alone measure another pose, by their own noise.
    alone = x @ np.linalg.inv(MATRIX).T
    assert np.abs(alone - pose).max() > 1e-6


def test_the_results_have_the_peak_of_each_sensor_and_what_the_others_say_of_it(
    celled: RecordedTest, wired: RecordedTest
) -> None:
    (cell,), (wire,) = (analysis.summarize(rec).sensors for rec in (celled, wired))
    assert (cell.name, cell.of_force, wire.name, wire.of_force) == ("column", True, "wire", False)
    for rec, one in ((celled, cell), (wired, wire)):
        values = rec.samples[one.name][rec.running()]
        assert one.peak == pytest.approx(np.abs(values).max(), rel=1e-12)
        assert 0 < one.residual < 0.05 * one.peak
    rows = wired.running()
    x = np.column_stack([axes_of(wired, "x_meas_m"), wired.samples["wire"][rows]])
    stacked = np.vstack([MATRIX, [1.0, 0.5]])
    left = x - x @ np.linalg.pinv(stacked).T @ stacked.T
    assert wire.residual == pytest.approx(np.abs(left[:, 2]).max(), rel=1e-6)
    assert "sensors" not in analysis.summarize(completed(RIG)).as_json()


@pytest.mark.parametrize("which", ["celled", "wired"])
def test_the_energies_of_the_structure_add_up(
    which: str, bare: RecordedTest, request: pytest.FixtureRequest
) -> None:
    """The recording has no force of the interface: it follows from all load cells again."""
    found, wanted = (
        structure_balance.of_axes(rec, analysis.summarize(rec).structure)
        for rec in (request.getfixturevalue(which), bare)
    )
    assert found is not None
    assert wanted is not None
    assert found.gap < 1e-4
    assert found.input_j[-1] == pytest.approx(wanted.input_j[-1], rel=1e-3)
    assert found.strain_j.max() == pytest.approx(wanted.strain_j.max(), rel=1e-3)


@pytest.mark.parametrize("which", ["celled", "wired"])
def test_the_recording_is_replayed_bit_for_bit(which: str, request: pytest.FixtureRequest) -> None:
    rec = request.getfixturevalue(which)
    result = station_replay.replay(rec)
    assert result.identical
    assert result.rows > 6 * 1024


def quiet(text: str) -> str:
    """The same rig without noise."""
    return re.sub(r"noise_std_(m|n) = [-0-9e]+", r"noise_std_\1 = 0", text)


@pytest.mark.parametrize("text", [WITH_CELL, WITH_WIRE, WITH_BOTH])
def test_without_noise_redundant_sensors_change_nothing(text: str) -> None:
    """The bias of a sensor neither: it is part of the tare."""
    off = text.replace('range_n = "70 kN"', "bias_n = 5e3").replace(
        'range_m = "80 mm"', "bias_m = 2e-3"
    )
    one, wanted = completed(quiet(off)), completed(quiet(RIG))
    for name in ("x_num_m", "x_num_m_1"):
        a, b = one.samples[name][one.running()], wanted.samples[name][wanted.running()]
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * np.ptp(b))


def test_a_rig_without_sensors_is_recorded_as_before(bare: RecordedTest) -> None:
    assert "sensor = " not in bare.rig_toml
    station = bare.replay.parameters[0]["values"]["station"]
    assert not {"sensors", "lone_channel", "lone_channel_count"} & set(station)
    assert station_replay.replay(bare).identical


# ---- over links ---------------------------------------------------------------------------------

LINKED = WITH_BOTH
for _of, _extra, _unit in (("left", "cell", "N"), ("right", "wire_end", "m")):
    _before = f'[[axis]]\nname = "{_of}"\n'
    _after = LINKED.index("identified", LINKED.index(_before))
    _line = LINKED.index("\n", _after) + 1
    LINKED = (
        LINKED[:_line]
        + f'[[axis.sensors.extra]]\nname = "{_extra}"\nunit = "{_unit}"\n'
        + LINKED[_line:]
    )
LINKED = LINKED.replace('name = "column"\n', 'name = "column"\nextra = "cell"\n').replace(
    'name = "wire"\n', 'name = "wire"\nextra = "wire_end"\n'
)
# An inline table cannot be continued by [[axis.sensors.extra]].
LINKED = re.sub(
    r"sensors = \{ displacement = (\{.*?\}), force = (\{.*?\}) \}\n(identified.*\n)",
    r"\3[axis.sensors]\ndisplacement = \1\nforce = \2\n",
    LINKED,
)
LINKED = LINKED.replace('unit = "N"\n', 'unit = "N"\nwire_step = 1e-3\n').replace(
    'unit = "m"\n', 'unit = "m"\nwire_step = 1e-9\n'
)


def over_links(text: str, faults: Any = (), test: str = TEST) -> RecordedTest:
    setup = axes_experiment.prepare(files.parse_test(test, "test.toml"), read(text))
    mishaps = virtual_rig.parse_mishaps(faults, NAMES) if faults else ()
    return virtual_rig.run_faulty(setup, mishaps)


def test_sensors_are_read_from_the_extra_channels_of_the_links() -> None:
    """Frames, drives and loop as on a rig, against the same rig called directly."""
    one, direct = over_links(quiet(LINKED)), completed(quiet(LINKED))
    assert one.meta["end_reason"] == "completed"
    a, b = one.samples[one.running()], direct.samples[direct.running()]
    for name, step in (("wire", 1e-9), ("column", 1e-3)):
        # The wire rounds the commands as well, to 1 um of the axes.
        np.testing.assert_allclose(a[name], b[name], rtol=0, atol=3e-3 * np.ptp(b[name]))
        other = {"wire": "wire_end", "column": "cell"}[name]
        np.testing.assert_array_equal(a[f"{name}_read"], a[other])
        np.testing.assert_allclose(a[other] / step, np.rint(a[other] / step), atol=1e-5)
    assert np.ptp(a["wire"]) > 5e-3
    result = station_replay.replay(one)
    assert result.identical


def test_lost_frames_leave_their_sensors_without_a_reading() -> None:
    one = over_links(LINKED, ["left.drop:p=0.02,from=1,to=5"])
    assert one.meta["end_reason"] == "completed"
    rows = one.samples[one.running()]
    # The cell is read with the frames of the left axis, the wire with those of the right one.
    lost = np.isnan(rows["x_read_m"])
    assert 40 < lost.sum() < 160
    np.testing.assert_array_equal(np.isnan(rows["column_read"]), lost)
    assert not np.isnan(rows["wire_read"]).any()
    assert np.isfinite(rows["column"]).all()
    assert station_replay.replay(one).identical


def test_silence_of_a_link_trips_and_is_replayed() -> None:
    one = over_links(LINKED, ["right.silence:from=2"])
    assert one.meta["end_reason"] == "tripped: link lost of axis right"
    assert station_replay.replay(one).identical


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('extra = "cell"', 'extra = "cel"', 'column: found extra = "cel"'),
        ('extra = "cell"', 'extra = "wire_end"', 'with the unit "m"; a sensor of kind force'),
        (
            "[kinematics]",
            COLUMN.replace('"column"', '"other"').replace("along", 'extra = "cell"\nalong')
            + "[kinematics]",
            "sensors column and other both name the extra channel cell",
        ),
        ('extra = "cell"\n', "extra = 5\n", "sensor.column.extra: found 5"),
    ],
)
def test_an_extra_channel_that_does_not_fit_is_told(old: str, new: str, said: str) -> None:
    assert old in LINKED
    with pytest.raises(InputError) as caught:
        read(LINKED.replace(old, new, 1))
    problems = [str(one) for one in caught.value.problems]
    assert any(said in one for one in problems), problems


def test_every_sensor_of_a_linked_rig_names_its_extra_channel() -> None:
    linked = LINKED
    for n, name in enumerate(NAMES):
        linked = linked.replace(
            f'name = "{name}"\n',
            f'name = "{name}"\nlink = {{ kind = "serial", channel = "/dev/ttyS{n}" }}\n',
        )
    assert read(linked).link is not None
    with pytest.raises(InputError, match="wire: extra is missing; axis left has a link"):
        read(linked.replace('extra = "wire_end"\n', ""))


def test_a_loop_refuses_places_that_no_frame_has() -> None:
    one = bench()
    ours, theirs = opening.socket_pairs(NAMES)
    with ours, theirs:
        ways = [loop.LoopAxis(wire.Wire(at.codec), loop.Link(at.kind, at.fd)) for at in ours.all]
        given: Any = (one.station, ways[0].wire, ways[0].link)
        for places, said in (
            ((), "places of 0 sensors"),
            (((0, 0), (1, 0), (1, 1)), "the number of an extra channel"),
            (((0, 0), (1, 0), (7, 0)), "the number of an extra channel"),
        ):
            with pytest.raises(CoreError, match=said):
                loop.Loop(*given, further=ways[1:], sensors=places)
        for way in ways:
            way.link.close()


def test_the_service_holds_the_rig_and_names_the_sensor_that_ended_a_test(tmp_path: Path) -> None:
    short = TEST.replace('"6 s"', '"3 s"')
    small = LINKED.replace('"70 kN"', '"8 kN"')
    with service_bench.bench(
        tmp_path / "rings",
        faults=(),
        rig=read(small),
        test_of=lambda changes: files.parse_test(short, "test.toml", changes or {}),
    ) as lab:
        for pga, ended in (("0.01", "completed"), ("0.1", "tripped: force limit of sensor column")):
            lab.loaded({"ground_motion.pga_g": pga})
            lab.reach("RUNNING")
            lab.until("IDLE" if ended == "completed" else "TRIPPED", 60.0)
            lab.engine.wait(2.0)
            assert lab.engine.last is not None
            assert lab.engine.last["end_reason"] == ended
    recordings = service_bench.left(tmp_path / "rings")
    assert len(recordings) == 2
    for rec in recordings:
        assert station_replay.replay(rec).identical
    assert np.nanmax(np.abs(recordings[0].samples["column"])) > 500


NOT_SUPPORTED: dict[str, Callable[[AxesRig], object]] = {
    "a test in real time": lambda floor: axes_experiment.prepare(
        files.parse_test(TEST, "test.toml"), floor, real_time=True
    ),
    "real time": axes_experiment.at_rest,
}


@pytest.mark.parametrize("what", NOT_SUPPORTED)
def test_real_time_without_extra_channels_is_refused_by_name(what: str) -> None:
    said = (
        'sensor: rig "floor" has sensors without an actuator that name no extra channel (column, '
        f"wire); {what}"
    )
    with pytest.raises(InputError, match=re.escape(said)):
        NOT_SUPPORTED[what](read(WITH_BOTH))
    NOT_SUPPORTED[what](read(LINKED))


def test_identification_finds_the_same_with_and_without_sensors() -> None:
    sweep = identify_axes.sweep_of(amplitude_m=1e-3)
    plain, beside = (
        identify_axes.identify_rig(read(quiet(text)), sweep) for text in (RIG, WITH_BOTH)
    )
    np.testing.assert_array_equal(plain.response.response, beside.response.response)
    np.testing.assert_array_equal(plain.stiffness, beside.stiffness)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # Saturated, the force in its direction is unknown, which counts as beyond the limit.
        (WITH_CELL.replace('"70 kN"', '"5 kN"'), "tripped: force limit of sensor column"),
        (WITH_WIRE.replace('"80 mm"', '"3 mm"'), "tripped: no usable reading of sensor wire"),
    ],
)
def test_a_trip_names_the_sensor_in_words(
    text: str, said: str, rthyb: Rthyb, tmp_path: Path
) -> None:
    """The range of a sensor is smaller than the test needs."""
    (tmp_path / "floor.toml").write_text(text, encoding="utf-8")
    path = tmp_path / "test.toml"
    path.write_text(TEST, encoding="utf-8")
    done = rthyb("run", str(path), "--out", str(tmp_path / "run"))
    assert said in done.out + done.err


@pytest.mark.parametrize("command", ["jog", "commission", "serve", "rig"])
def test_commands_over_a_link_refuse_a_rig_whose_sensors_it_does_not_read(
    command: str, rthyb: Rthyb, tmp_path: Path
) -> None:
    path = tmp_path / "floor.toml"
    path.write_text(WITH_BOTH, encoding="utf-8")
    more = {"jog": ["0.5 mm", "--axis", "left"], "rig": ["--pty"]}.get(command, [])
    done = rthyb(command, str(path), *more)
    assert done.code == InputError.exit_code
    assert "sensors without an actuator that name no extra channel (column, wire)" in done.err


def test_commands_show_the_sensors_and_refuse_what_they_cannot(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    (tmp_path / "floor.toml").write_text(WITH_BOTH, encoding="utf-8")
    path, out = tmp_path / "test.toml", tmp_path / "run"
    path.write_text(TEST, encoding="utf-8")
    assert rthyb("check", str(path)).code == 0
    done = rthyb("run", str(path), "--out", str(out))
    assert done.code == 0, done.err
    assert "Sensor wire: peak" in done.out
    assert "Sensor column: peak" in done.out
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Sensor column" in page
    recording = out / "recording.h5"
    assert rthyb("replay", str(recording)).code == 0
    assert rthyb("export", str(recording), "--csv", "--axis", "left").code == 0
    for refused in (
        ["run", str(path), "--realtime"],
        ["run", str(path), "--fault", "left.silence:from=5"],
    ):
        done = rthyb(*refused)
        assert done.code == InputError.exit_code, (refused, done.out, done.err)
        assert "that name no extra channel (column, wire)" in done.err
