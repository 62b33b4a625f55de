"""More actuators than directions: the kinematics, the virtual rig, the station and whole tests."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import service_bench
from axes_bench import SIDES, SPECIMEN, column, columns, controller, rig, shaking
from command_line import Rthyb
from kernels import Floats
from numpy.typing import NDArray
from scipy.signal import cont2discrete
from station_courses import Courses
from test_axes import run_virtual
from test_axes_roots import growth_of

from rthyb_rt import config, core
from rthyb_rt.analysis import axes_roots, loop_stability
from rthyb_rt.analysis import several_axes as analysis
from rthyb_rt.config import AxesRig
from rthyb_rt.config.deriving_axes import derive_axes
from rthyb_rt.config.rate import STANDARD
from rthyb_rt.core import AxisConfig, AxisReading, CoreError
from rthyb_rt.core.coupled_rig import CoupledRig, CoupledRigConfig
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.core.library import STATUS
from rthyb_rt.core.matrix_lead import MatrixLeadConfig
from rthyb_rt.core.matrix_rfc import MatrixRfcConfig
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, virtual_time
from rthyb_rt.lab.realtime import station_replay
from rthyb_rt.record import axis_export
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig import identify_axes, virtual_rig

Complexes = NDArray[np.complex128]

THREE = np.array([[1.0, 0.2], [1.0, 0.1], [1.0, -0.3]])
"""Three axes from x (m) and theta (rad)."""
NAMES = ("left", "middle", "right")
ATTACHED = 4e8
SHAPES = [(2, 1), (3, 1), (4, 1), (3, 2), (4, 2), (4, 3)]


def some_matrix(n: int, m: int, seed: int) -> Floats:
    """Axes of comparable effect on every direction, one of which may be a rotation."""
    rng = np.random.default_rng(seed)
    while True:
        found = rng.uniform(-1, 1, (n, m)) * np.where(np.arange(m) == m - 1, 0.3, 1.0)
        if np.linalg.cond(found) < 20:
            return found


# ---- kinematics ---------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", range(5))
def test_axes_and_interface_do_the_same_virtual_work(shape: tuple[int, int], seed: int) -> None:
    matrix = some_matrix(*shape, seed)
    rng = np.random.default_rng(100 + seed)
    body = Kinematics(matrix)
    for _ in range(20):
        force, pose = rng.uniform(-1e5, 1e5, shape[0]), rng.uniform(-0.05, 0.05, shape[1])
        axes, code = body.axes(pose)
        met, _ = body.forces(force)
        assert code == 0
        assert force @ axes == pytest.approx(met @ pose, rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", range(5))
def test_pose_and_pushes_are_the_least_squares_inverses(shape: tuple[int, int], seed: int) -> None:
    matrix = some_matrix(*shape, seed)
    rng = np.random.default_rng(200 + seed)
    body, back = Kinematics(matrix), np.linalg.pinv(matrix)
    x, force = rng.uniform(-0.05, 0.05, (30, shape[0])), rng.uniform(-1e5, 1e5, (30, shape[1]))
    poses, code = body.pose(x)
    assert code == 0
    np.testing.assert_allclose(poses, x @ back.T, rtol=1e-10, atol=1e-14)
    pushed = body.pushes(force)
    np.testing.assert_allclose(pushed, force @ back, rtol=1e-10, atol=1e-8)
    resultant = np.array([body.forces(one)[0] for one in pushed])
    np.testing.assert_allclose(resultant, force, rtol=1e-10, atol=1e-7)
    np.testing.assert_allclose(body.back(), back, rtol=1e-12)
    np.testing.assert_allclose(body.weights(), back, rtol=1e-10, atol=1e-14)


def test_given_matrices_take_the_place_of_the_inverse_and_of_the_transposed() -> None:
    displacements = np.linalg.inv(THREE[[0, 2]]) @ np.array([[1.0, 0, 0], [0, 0, 1.0]])
    forces = np.array([[1.0, 1.0, 1.0], [0.15, 0.0, -0.25]])
    body = Kinematics(THREE, forces=forces, displacements=displacements)
    x, f = np.array([0.01, 0.9, -0.02]), np.array([100.0, 50.0, -70.0])
    # The sensor of the middle axis has no weight.
    np.testing.assert_allclose(body.pose(x)[0], np.linalg.solve(THREE[[0, 2]], x[[0, 2]]))
    np.testing.assert_allclose(body.forces(f)[0], forces @ f, rtol=1e-14)
    np.testing.assert_allclose(body.pushes([3.0, 2.0]), np.linalg.pinv(forces) @ [3.0, 2.0])
    np.testing.assert_allclose(body.weights(), displacements, atol=1e-15)
    again = Kinematics.of(body.plain())
    assert again.plain() == body.plain()
    assert np.array_equal(again.forces(f)[0], body.forces(f)[0])


def test_as_many_axes_as_directions_are_described_as_before() -> None:
    """A recording of an earlier version has no further keys, and its replay needs none."""
    plain = Kinematics(SIDES).plain()
    assert set(plain) == {"matrix", "pins", "coordinates"}
    square = Kinematics.of(plain)
    assert np.array_equal(square.weights(), np.linalg.inv(SIDES))
    assert not square.has_forces


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"matrix": THREE.T}, "no more columns than rows"),
        ({"matrix": np.ones((5, 2))}, "1 to 4 axes"),
        ({"matrix": [[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]]}, "do not determine"),
        ({"matrix": [[1.0, 0.0], [1.0, 0.0], [1.0, 1e-9]]}, "do not determine"),
        ({"matrix": [[1.0, 0.0], [1.0, math.nan], [1.0, 1.0]]}, "do not determine"),
        ({"matrix": [[1.0, 0.0], [1.0, 1e300], [1.0, 1.0]]}, "do not determine"),
        ({"matrix": THREE, "forces": THREE}, r"forces: found shape \(3, 2\)"),
        ({"matrix": THREE, "forces": np.zeros((2, 3))}, "do not determine"),
        ({"matrix": THREE, "forces": np.full((2, 3), math.inf)}, "do not determine"),
        ({"matrix": THREE, "displacements": np.ones((2, 2))}, r"displacements: found shape"),
        ({"matrix": THREE, "displacements": THREE.T}, "do not determine"),
        ({"matrix": THREE, "displacements": np.full((2, 3), math.nan)}, "do not determine"),
        ({"matrix": SIDES, "displacements": np.eye(2)}, "do not determine"),
    ],
)
def test_matrices_that_leave_a_direction_open_are_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(CoreError, match=said):
        Kinematics(**wrong)


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("which", range(3))
def test_a_senseless_value_of_an_axis_is_replaced_by_its_last_good_one(
    absurd: float, which: int
) -> None:
    body = Kinematics(THREE)
    x, f = body.axes([0.01, 0.02])[0], np.array([10.0, 20.0, -5.0])
    pose, force = body.pose(x)[0], body.forces(f)[0]
    for run, given, good in ((body.pose, x, pose), (body.forces, f, force)):
        broken = given.copy()
        broken[which] = absurd
        found, code = run(broken)
        assert code & (STATUS["not_finite"] | STATUS["out_of_range"])
        assert np.array_equal(found, good)


# ---- the virtual rig ----------------------------------------------------------------------------


def three(kinematics: Kinematics | None = None, **changes: Any) -> CoupledRig:
    given: dict[str, Any] = {
        "servos": (core.ServoConfig("pure-delay", delay_samples=2.0),) * 3,
        "attachment_n_per_m": ATTACHED,
    }
    return rig(kinematics or Kinematics(THREE), **given | changes)


def test_actuators_that_disagree_push_against_each_other_through_their_attachments() -> None:
    """Against the minimum of the energy of specimen and attachments, which are 600 times stiffer.

    Its pose follows from the stiffness of both; the rig takes the limit of stiff attachments.
    """
    servos = (core.ServoConfig("pure-delay", delay_samples=0.0),) * 3
    plant = three(servos=servos)
    for x in ([1e-3, 1e-3, 1e-3], [2e-3, 1e-3, 1.2e-3], [0.0, 5e-5, 0.0]):
        plant.run(np.array([x]))
        found = plant.run(np.array([x]))[1][0]
        joined = ATTACHED * THREE.T @ THREE + SPECIMEN
        pose = np.linalg.solve(joined, ATTACHED * THREE.T @ x)
        wanted = ATTACHED * (x - THREE @ pose)
        assert np.abs(found - wanted).max() < 0.01 * np.abs(wanted).max()
        # The specimen receives what it resists with, however the actuators oppose each other.
        at = np.linalg.pinv(THREE) @ x
        np.testing.assert_allclose(THREE.T @ found, SPECIMEN @ at, rtol=1e-9, atol=1e-6)


def test_equal_hydraulic_actuators_side_by_side_share_the_specimen() -> None:
    """Against one of them with a third of the specimen."""
    servo = core.ServoConfig(
        "servo-hydraulic", kp_per_s=60.0, valve_time_constant_s=0.002, stall_force_n=6e4,
        flow_limit_m_per_s=1.0, oil_stiffness_n_per_m=5e7, oil_damping_n_s_per_m=1e4,
        moving_mass_kg=60.0, friction_n=80.0, friction_width_m_per_s=0.01,
        viscous_n_s_per_m=600.0, substeps=32,
    )  # fmt: skip
    found = []
    for n in (1, 3):
        k, c, m = (np.array([[value * n]]) for value in (1e6, 2e3, 200.0))
        one = CoupledRig(
            CoupledRigConfig(
                Kinematics(np.ones((n, 1))), k, c, m, (servo,) * n,
                attachment_n_per_m=1e8 if n > 1 else 0.0,
            )
        )  # fmt: skip
        found.append(one.run(np.repeat(0.01 * shaking(1.0)[:, None], n, axis=1)))
    (x, f), (x3, f3) = found
    assert np.abs(x).max() > 5e-4
    for k in range(3):
        np.testing.assert_allclose(x3[:, k], x[:, 0], rtol=0, atol=1e-9 * np.abs(x).max())
        np.testing.assert_allclose(f3[:, k], f[:, 0], rtol=0, atol=1e-9 * np.abs(f).max())


def test_attachments_too_stiff_for_the_substeps_are_refused() -> None:
    servo = core.ServoConfig(
        "servo-hydraulic", kp_per_s=60.0, stall_force_n=6e4, flow_limit_m_per_s=1.0,
        oil_stiffness_n_per_m=5e7, oil_damping_n_s_per_m=1e4, moving_mass_kg=60.0, substeps=32,
    )  # fmt: skip
    with pytest.raises(CoreError):
        three(servos=(servo,) * 3, attachment_n_per_m=1e13)
    for absurd in (-1.0, math.nan, math.inf, 1e300):
        with pytest.raises(CoreError):
            three(attachment_n_per_m=absurd)


def test_load_cells_elsewhere_measure_the_specimen_and_nothing_else() -> None:
    forces = np.array([[1.0, 1.0, 1.0], [0.5, 0.0, -0.5]])
    plant = three(
        kinematics=Kinematics(THREE, forces=forces),
        servos=(core.ServoConfig("pure-delay", delay_samples=0.0),) * 3,
    )
    x = np.array([2e-3, 1e-3, 1.2e-3])
    plant.run(x[None])
    _, f = plant.run(x[None])
    np.testing.assert_allclose(forces @ f[0], SPECIMEN @ np.linalg.pinv(THREE) @ x, rtol=1e-9)
    np.testing.assert_allclose(f[0], np.linalg.pinv(forces) @ forces @ f[0], rtol=1e-9)


# ---- the station --------------------------------------------------------------------------------


def settings(control: dict[str, Any] | None = None, **changes: Any) -> core.StationConfig:
    base: dict[str, Any] = {"tare_ticks": 64, "ramp_in_ticks": 256, "armed_ticks": 500}
    given = {"axes": tuple(AxisConfig(n) for n in NAMES), "kinematics": Kinematics(THREE)}
    return core.StationConfig(controller=controller(**given | (control or {})), **base | changes)


def test_a_third_actuator_changes_nothing_of_the_structure() -> None:
    """With ideal actuators, the motion of the structure is that with two of them."""
    found = []
    for one, plant in (
        (settings({"kinematics": Kinematics(SIDES),
                   "axes": tuple(AxisConfig(n) for n in NAMES[:2])}), rig()),
        (settings(), three()),
    ):  # fmt: skip
        count = len(core.axis_channels(one.controller))
        one = replace(one, axis_channel=0, axis_channel_count=count)
        rows, beside = run_virtual(core.Station(one, shaking(2.0)), plant, width=count)
        running = rows["state"] == core.RUNNING
        found.append(np.stack([rows["x_num_m"][running], beside[running, 0]], axis=1))
        if plant.axes == 3:
            sent = columns(rows[running], "x_cmd_m", (0, 1, 2))
            forces = columns(rows[running], "f_meas_n", (0, 1, 2))
    assert (np.abs(found[0]).max(axis=0) > 1e-3).all()
    assert (np.abs(found[0] - found[1]).max(axis=0) < 1e-9 * np.abs(found[0]).max(axis=0)).all()
    # All three commands are those of one pose, so no actuator opposes another.
    apart = np.eye(3) - THREE @ np.linalg.pinv(THREE)
    assert np.abs(sent @ apart).max() < 1e-12 * np.abs(sent).max()
    assert np.abs(forces @ apart).max() < 1e-9 * np.abs(forces).max()


@dataclasses.dataclass
class Bench(Courses):
    """Three axes whose sensors disagree at rest, and a log of what their drives received."""

    settings: core.StationConfig = dataclasses.field(default_factory=settings)
    plant: CoupledRig = dataclasses.field(default_factory=three)
    stands_m: tuple[float, ...] = (0.0123, -0.004, 0.02)
    records: list[np.ndarray] = dataclasses.field(default_factory=list)
    sent: list[tuple[float, ...]] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        self.station = core.Station(self.settings, shaking(3.0))
        self.at_drive = self.stands_m

    def step(
        self, command: core.Command = "none", faults: dict[int, dict[str, Any]] | None = None
    ) -> core.StationTick:
        told = np.array([np.subtract(self.at_drive, self.stands_m)])
        x, f = self.plant.run(told)
        readings = [AxisReading(x[0, k] + self.stands_m[k], f[0, k]) for k in range(3)]
        for axis, other in (faults or {}).items():
            readings[axis] = replace(readings[axis], **other)
        tick = self.station.tick(command=command, axes=readings)
        self.records.append(tick.records.copy())
        if tick.sent:
            self.sent.append(tick.commands_m)
            self.at_drive = tick.commands_m
        return tick


def test_actuators_that_stand_at_no_common_pose_are_not_moved_there() -> None:
    """Before ZERO, the readings of three sensors correspond to no pose: each drive stays."""
    bench = Bench()
    for _ in range(50):
        bench.step()
    assert np.array(bench.sent) == pytest.approx(np.tile(bench.stands_m, (50, 1)), abs=1e-15)
    bench.running(600)
    sent = np.array(bench.sent)
    # Never a jump: no more than the velocity limit of .5 m/s, and no opposing displacement.
    assert np.abs(np.diff(sent, axis=0)).max() < 0.5 / core.FS_HZ
    apart = np.eye(3) - THREE @ np.linalg.pinv(THREE)
    assert np.abs((sent - bench.stands_m) @ apart).max() < 1e-12


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("field", ["x_m", "f_n"])
def test_a_senseless_reading_of_any_axis_is_predicted_for_all(
    which: int, absurd: float, field: str
) -> None:
    bench = Bench().running(400)
    before = bench.rows()[-1:]
    bench.step(faults={which: {field: absurd}})
    row = bench.records[-1][-1:]
    assert row["flags"][0] & core.FLAGS["predicted"]
    for k in range(3):
        for name in ("x_cmd_m", "x_meas_m", "f_meas_n"):
            assert math.isfinite(column(row, name, k)[0])
        went = column(row, "x_meas_m", k)[0] - column(before, "x_meas_m", k)[0]
        assert abs(went) < 0.5 / core.FS_HZ
    assert all(math.isfinite(value) for value in bench.sent[-1])


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize(("name", "most"), [("force", 30.0), ("position", 2e-4)])
def test_a_limit_of_any_axis_ends_the_test_for_all(which: int, name: str, most: float) -> None:
    own = {name: core.Watch(most, "trip")}
    axes = tuple(AxisConfig(n, watches=own if k == which else {}) for k, n in enumerate(NAMES))
    bench = Bench(settings({"axes": axes}))
    for command in ("none", "zero"):
        bench.step(command)  # type: ignore[arg-type]
    bench.until("ZEROED")
    bench.step("arm")
    bench.step("start")
    bench.until("TRIPPED")
    assert (bench.station.cause, bench.station.cause_axis) == (name, which)
    assert abs(bench.station.cause_value) > most


@pytest.mark.parametrize("which", range(2))
def test_a_limit_of_a_direction_ends_the_test(which: int) -> None:
    interfaces = tuple(
        core.InterfaceConfig(
            one, rfc=core.RfcConfig(k_e_n_per_m=SPECIMEN[k, k], window=51),
            watches={"force": core.Watch(10.0, "trip")} if k == which else {},
        )
        for k, one in enumerate(("x", "theta"))
    )  # fmt: skip
    bench = Bench(settings({"interfaces": interfaces}))
    for command in ("none", "zero"):
        bench.step(command)  # type: ignore[arg-type]
    bench.until("ZEROED")
    bench.step("arm")
    bench.step("start")
    bench.until("TRIPPED")
    assert (bench.station.cause, bench.station.cause_interface) == ("force", which)


def test_a_velocity_limit_of_one_axis_holds_back_all_by_one_factor() -> None:
    """The commands stay those of one pose, so no actuator works against the others."""
    slow = AxisConfig("right", velocity_limit_m_per_s=0.01)
    axes = (AxisConfig("left"), AxisConfig("middle"), slow)
    bench = Bench(settings({"axes": axes, "lead_enabled": False}))
    bench.running(1500)
    limited = bench.rows()["flags"] & core.FLAGS["limited"] != 0
    assert limited.sum() > 50
    sent = np.array(bench.sent)
    apart = np.eye(3) - THREE @ np.linalg.pinv(THREE)
    assert np.abs((sent - bench.stands_m) @ apart).max() < 1e-9 * np.abs(sent).max()
    assert np.abs(np.diff(sent[:, 2])).max() < 0.01 / core.FS_HZ * (1 + 1e-9)


def test_counts_that_do_not_match_are_refused() -> None:
    for wrong in (
        {"axes": (AxisConfig("left"), AxisConfig("right"))},
        {"interfaces": (core.InterfaceConfig("x"),)},
        {"interfaces": tuple(core.InterfaceConfig(n) for n in NAMES)},
        {"kinematics": None},
        {"kinematics": Kinematics(SIDES)},
        {"matrix_rfc": MatrixRfcConfig(np.eye(3), (0.0,) * 3)},
    ):
        with pytest.raises(CoreError, match="found"):
            core.Station(settings(wrong), shaking(1.0))
    lead = MatrixLeadConfig((1e-6,) * 3, first=np.zeros((3, 3, 3)))
    with pytest.raises(CoreError, match="do not move independently"):
        core.Station(settings({"matrix_lead": lead}), shaking(1.0))


# ---- files --------------------------------------------------------------------------------------

AXIS = """[[axis]]
name = "{name}"
actuator = {{ kind = "second-order", natural_frequency_hz = {hz}, damping_ratio = 0.7 }}
limits = {{ command_position_m = "30 mm", force_n = "60 kN" }}
sensors = {{ displacement = {{ noise_std_m = 5e-6 }}, force = {{ noise_std_n = 20 }} }}
identified = {{ alpha = 11.0, delay_s = 0.011 }}
"""
RIG = (
    """schema = "rthyb-rig/1"
[rig]
name = "floor"
load_cell = "specimen"
seed = 5
"""
    + "".join(AXIS.format(name=n, hz=hz) for n, hz in zip(NAMES, (20, 22, 20), strict=True))
    + """[kinematics]
kind = "matrix"
interface = ["first", "second"]
matrix = [[1, 0], [1, 1], [1, 1]]
[specimen]
stiffness = [[8e6, -1e6], [-1e6, 6e6]]
attachment_stiffness_n_per_m = 1e8
[limits]
ramp_in_s = 1.5
"""
)
TEST = """schema = "rthyb-test/1"
rig = "floor.toml"
[test]
name = "redundant"
[ground_motion]
pga_g = "0.1 g"
duration_s = "6 s"
[numerical.storeys]
count = 3
mass_kg = "20 t"
stiffness_n_per_m = "8 MN/m"
specimen = [1, 2]
[numerical.damping]
ratio = 0.05
modes = [1, 2]
[[interface]]
name = "first"
storey = 1
limits = { position_m = "25 mm", force_n = "150 kN" }
[[interface]]
name = "second"
storey = 2
[controller]
type = "paper"
"""


def read(text: str = RIG) -> AxesRig:
    found = config.parse_any_rig(text, "floor.toml")
    assert isinstance(found, AxesRig)
    return found


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[1, 1], [1, 1]]", "[1, 1]]", "kinematics: found 2 rows; must be 3, one for each axis"),
        (
            "[[1, 0], [1, 1], [1, 1]]",
            "[[1], [1], [1]]",
            "kinematics: found rows of 1 numbers; each must have 2, one for each direction "
            "(first, second)",
        ),
        ("[[1, 0], [1, 1], [1, 1]]", "[[1, 1], [1, 1], [1, 1]]", "must not be singular"),
        ("[[1, 0],", "[[1, nan],", "kinematics.matrix: found nan in row 1, column 2"),
        ("[[1, 0],", "[[1, 1e300],", "kinematics.matrix: found 1e+300 in row 1, column 2"),
        (
            '["first", "second"]',
            '["first", "second", "third", "fourth"]',
            "kinematics: found 4 directions (first, second, third, fourth) and 3 axes",
        ),
        (
            "[specimen]",
            "forces = [[1, 1], [0, 1]]\n[specimen]",
            "kinematics: forces: found 2 rows of 2 numbers; must be 2 rows, one for each direction "
            "(first, second), of 3 numbers, one for each axis (left, middle, right)",
        ),
        (
            "[specimen]",
            "forces = [[1, 1, 1], [2, 2, 2]]\n[specimen]",
            "kinematics: forces: found the rows [1, 1, 1]; [2, 2, 2], one of which",
        ),
        (
            "[specimen]",
            "displacements = [[1, 0, 0], [0, 0.5, 0.5]]\n[specimen]",
            "kinematics: displacements: found rows that times matrix give [1, 0]; [1, 1]; must be "
            "the identity",
        ),
        (
            "[specimen]",
            "displacements = [[1, 0, 0]]\n[specimen]",
            "kinematics: displacements: found 1 rows of 3 numbers; must be 2 rows",
        ),
        (
            'load_cell = "specimen"\n',
            "",
            None,
        ),
        (
            "attachment_stiffness_n_per_m = 1e8\n",
            "",
            "specimen: attachment_stiffness_n_per_m is missing; with 3 axes for 2 directions",
        ),
        ("= 1e8", "= nan", "specimen.attachment_stiffness_n_per_m: found nan"),
        ("= 1e8", "= -5", "specimen.attachment_stiffness_n_per_m: found -5"),
        (
            "stiffness = [[8e6, -1e6], [-1e6, 6e6]]",
            "stiffness = [[8e6]]",
            "specimen: found a stiffness of 1 directions; kinematics has 2: first, second",
        ),
        (
            "[kinematics]",
            '[axis.link]\nkind = "serial"\nchannel = "/dev/ttyS0"\n[kinematics]',
            "redundant actuators are supported with virtual drives only, because commissioning",
        ),
    ],
)
def test_a_fault_is_told_with_file_key_and_value(old: str, new: str, said: str | None) -> None:
    assert old in RIG
    text = RIG.replace(old, new, 1)
    if said is None:  # load cells at the actuators' ends are fine without a matrix of forces
        assert read(text).is_redundant
        said = "forces: found a matrix, with rig.load_cell"
        text = text.replace("[specimen]", "forces = [[1, 1, 1], [0, 1, 1]]\n[specimen]")
    with pytest.raises(InputError) as caught:
        read(text)
    problems = [str(one) for one in caught.value.problems]
    assert any(said in one for one in problems), problems
    assert all(one.startswith("floor.toml:") for one in problems)


def test_pins_and_equal_counts_take_no_keys_of_redundant_actuators() -> None:
    square = RIG.replace(AXIS.format(name="middle", hz=22), "")
    square = square.replace(", [1, 1], [1, 1]]", ", [1, 1]]")
    with pytest.raises(InputError, match="it applies only if there are more axes than directions"):
        read(square)
    assert not read(square.replace("attachment_stiffness_n_per_m = 1e8\n", "")).is_redundant


def test_the_matrix_law_is_refused_with_the_reason() -> None:
    test = config.parse_test(TEST.replace('"paper"', '"matrix"'), "test.toml")
    with pytest.raises(InputError, match=r"controller.type: found .matrix.*undetermined") as caught:
        derive_axes(test, read())
    assert str(caught.value.problems[0]).startswith("test.toml:")


# ---- whole tests --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tested() -> RecordedTest:
    setup = axes_experiment.prepare(config.parse_test(TEST, "test.toml"), read())
    rec = virtual_time.run(setup)
    assert rec.meta["end_reason"] == "completed"
    return rec


def test_a_test_follows_its_reference_and_says_how_the_actuators_oppose_each_other(
    tested: RecordedTest,
) -> None:
    found = analysis.summarize(tested)
    assert [one.name for one in found.axes] == list(NAMES)
    assert [one.name for one in found.directions] == ["first", "second"]
    for direction in found.directions:
        assert direction.peak > 2e-3
        assert direction.response_nrmse < 0.05
    rows = tested.running()
    f = np.column_stack([tested.axis(n)["f_meas_n"][rows] for n in NAMES])
    matrix = np.array([[1.0, 0], [1, 1], [1, 1]])
    opposing = f - f @ matrix @ np.linalg.pinv(matrix)
    # Middle and right move the same floor: what one pushes, the other holds.
    assert np.abs(opposing[:, 0]).max() < 1e-6 * np.abs(f).max()
    np.testing.assert_allclose(opposing[:, 1], -opposing[:, 2], atol=1e-6 * np.abs(f).max())
    for k, axis in enumerate(found.axes):
        assert axis.peak_opposing_n == pytest.approx(np.abs(opposing[:, k]).max(), abs=1e-3)
    labels = [row.label for row in analysis.table(found)]
    assert "Axis middle: peak of the opposing force" in labels


def test_its_recording_is_replayed_bit_for_bit(tested: RecordedTest) -> None:
    setup = axes_experiment.prepare(config.parse_test(TEST, "test.toml"), read())
    assert tested.interface_names == ("first", "second")
    result = station_replay.replay(tested)
    assert result.identical
    assert len(tested.samples) > 6 * 1024
    assert setup.group is not None


def test_the_resultant_of_the_load_cells_is_the_force_on_the_specimen(tested: RecordedTest) -> None:
    """Energy: load cells and their axes do the work that the specimen stores; it is elastic."""
    rows = tested.running()
    x, f = (
        np.column_stack([tested.axis(n)[key][rows] for n in NAMES])
        for key in ("x_meas_m", "f_meas_n")
    )
    matrix = np.array([[1.0, 0], [1, 1], [1, 1]])
    pose = x @ np.linalg.pinv(matrix).T
    wanted = pose @ np.array([[8e6, -1e6], [-1e6, 6e6]])
    # Noise of 5 um times the stiffness, and of the load cells.
    assert np.abs(f @ matrix - wanted).max() < 0.02 * np.abs(wanted).max()


NOT_SUPPORTED: dict[str, Callable[[AxesRig], object]] = {
    "identification": identify_axes.identify_rig,
    "the model of an axis by itself": lambda floor: axis_export.alone(floor, "left"),
}


@pytest.mark.parametrize("what", NOT_SUPPORTED)
def test_what_is_not_supported_is_refused_with_counts_and_names(what: str) -> None:
    said = (
        'kinematics: rig "floor" has 3 axes (left, middle, right) for 2 directions (first, '
        f"second); {what}"
    )
    with pytest.raises(InputError, match=re.escape(said)):
        NOT_SUPPORTED[what](read())


@pytest.mark.parametrize("command", ["jog", "commission", "identify", "identify --realtime"])
def test_commands_that_move_a_rig_refuse_it_before_anything_moves(
    command: str, rthyb: Rthyb, tmp_path: Path
) -> None:
    path = tmp_path / "floor.toml"
    path.write_text(RIG, encoding="utf-8")
    more = {"jog": ["0.5 mm", "--axis", "left"]}.get(command, [])
    command, *options = command.split()
    done = rthyb(command, str(path), *more, *options)
    assert done.code == InputError.exit_code
    assert "3 axes (left, middle, right) for 2 directions" in done.err
    assert "not supported with redundant actuators" in done.err


# ---- on links to virtual drives ------------------------------------------------------------------

SHORT = TEST.replace('name = "redundant"', 'name = "redundant"\nduration_s = 4')


def over_links(*faults: str) -> RecordedTest:
    setup = axes_experiment.prepare(config.parse_test(SHORT, "test.toml"), read(), real_time=True)
    return virtual_rig.run_faulty(setup, virtual_rig.parse_mishaps(faults, NAMES))


def test_over_links_three_axes_go_where_they_go_in_virtual_time() -> None:
    rec = over_links()
    assert rec.meta["end_reason"] == "completed"
    plain = virtual_time.run(axes_experiment.prepare(config.parse_test(SHORT, "test.toml"), read()))
    for name in NAMES:
        a, b = (one.axis(name)["x_meas_m"][one.running()] for one in (rec, plain))
        assert np.abs(a - b).max() < 0.02 * np.abs(b).max()
    opposing = [axis.peak_opposing_n for axis in analysis.summarize(rec).axes]
    assert min(opposing) > 0.0
    assert station_replay.replay(rec).identical


FAULTS = {
    "drop:p=0.05,from=1.5,to=3": "completed",
    "reorder:from=1.5,to=2": "ramped out: too many lost pairs",
    "duplicate:from=1.5,to=2": "completed",
    "silence:from=2": "tripped: link lost of axis {axis}",
    "drop:from=2": "tripped: link lost of axis {axis}",
    "drop-force:from=2": "tripped: link lost of axis {axis}",
    "corrupt:from=2": "tripped: link lost of axis {axis}",
    "drop-command:from=2": "tripped: drive stopped of axis {axis}",
    "not-finite:from=2": "tripped: ",
    "force:n=2e5,from=2": "tripped: force limit of the rig of axis {axis}",
    "stuck:from=2": "ramped out: sensor stuck of axis {axis}",
    "jump:m=0.02,from=2": "tripped: sensor jump of axis {axis}",
}


@pytest.mark.long
@pytest.mark.parametrize("axis", NAMES)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_one_of_three_drives_ends_the_test_for_all_or_for_none(
    fault: str, axis: str
) -> None:
    rec = over_links(f"{axis}.{fault}")
    said = FAULTS[fault].format(axis=axis)
    assert rec.meta["end_reason"].startswith(said), rec.meta["end_reason"]
    if "axis" in FAULTS[fault] or fault.startswith("not"):
        assert axis in rec.meta["end_reason"]
    assert station_replay.replay(rec).identical
    x = np.column_stack([rec.axis(name)["x_cmd_m"] for name in NAMES])
    # Whatever one drive suffers, the commands stay finite, and those of one position.
    matrix = np.array([[1.0, 0], [1, 1], [1, 1]])
    apart = x @ (np.eye(3) - matrix @ np.linalg.pinv(matrix)).T
    assert np.isfinite(x).all()
    assert np.abs(apart).max() < 0.2 * np.abs(x).max()


def test_the_service_holds_three_virtual_drives_and_runs_a_test(tmp_path: Path) -> None:
    short = TEST.replace('"6 s"', '"3 s"')
    with service_bench.bench(
        tmp_path / "rings",
        faults=(),
        rig=read(),
        test_of=lambda changes: config.parse_test(short, "test.toml", changes or {}),
    ) as lab:
        lab.loaded({})
        lab.reach("RUNNING")
        lab.until("IDLE", 60.0)
        lab.engine.wait(2.0)
        assert lab.engine.last is not None
        assert lab.engine.last["end_reason"] == "completed"
    (rec,) = service_bench.left(tmp_path / "rings")
    assert rec.axis_names == NAMES
    assert station_replay.replay(rec).identical


def test_one_of_three_real_drives_is_enough_to_refuse_the_file() -> None:
    text = RIG
    for name in NAMES:
        link = f'[axis.link]\nkind = "serial"\nchannel = "/dev/{name}"\nvirtual = true\n'
        after = text.index("identified", text.index(f'name = "{name}"'))
        line = text.index("\n", after) + 1
        text = text[:line] + link + text[line:]
    assert read(text).is_redundant
    real = text.replace('"/dev/middle"\nvirtual = true', '"/dev/middle"')
    with pytest.raises(InputError, match="axis middle has a link to a real drive"):
        read(real)


def test_two_actuators_in_parallel_move_one_storey() -> None:
    """One direction; the delays differ, so the actuators oppose each other."""
    one = (
        RIG.replace(AXIS.format(name="middle", hz=22), "")
        .replace('["first", "second"]', '["first"]')
        .replace("[[1, 0], [1, 1], [1, 1]]", "[[1], [1]]")
        .replace("[[8e6, -1e6], [-1e6, 6e6]]", "[[8e6]]")
        .replace("natural_frequency_hz = 20, damping", "natural_frequency_hz = 24, damping", 1)
    )
    text = TEST.replace("specimen = [1, 2]", "specimen = 1")
    text = text.replace('[[interface]]\nname = "second"\nstorey = 2\n', "")
    rec = virtual_time.run(axes_experiment.prepare(config.parse_test(text, "test.toml"), read(one)))
    assert rec.meta["end_reason"] == "completed"
    found = analysis.summarize(rec)
    (direction,) = found.directions
    assert direction.response_nrmse < 0.05
    left, right = (axis.peak_opposing_n for axis in found.axes)
    assert left == pytest.approx(right, rel=1e-9)
    assert left is not None
    assert left > 100.0
    assert station_replay.replay(rec).identical


SWEPT_HZ = np.array([0.5, 1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 40])
H = 1.0 / core.FS_HZ


def second_order(hz: float) -> Complexes:
    """Closed form of an actuator with a damping ratio of 0.7 whose commands are held, (k,)."""
    w = 2 * np.pi * hz
    free, driven = np.array([[0.0, 1.0], [-w * w, -1.4 * w]]), np.array([[0.0], [w * w]])
    a, b, c, *_ = cont2discrete((free, driven, np.array([[1.0, 0.0]]), np.zeros((1, 1))), H)
    at = np.exp(2j * np.pi * SWEPT_HZ * H)
    return np.array([(c @ np.linalg.solve(z * np.eye(2) - a, b))[0, 0] for z in at])


def swept(extra: str = "") -> str:
    """The rig with the response of every actuator, and more keys of its kinematics."""
    text = RIG
    for hz in (20, 22, 20):
        g = second_order(hz)
        late = -np.unwrap(np.angle(g)) / (2 * np.pi * SWEPT_HZ)
        known = (
            f"identified = {{ alpha = {late[1] / H:.6g}, delay_s = {late[1]:.6g}, "
            f"frequency_hz = {SWEPT_HZ.tolist()}, amplitude = {np.abs(g).tolist()}, "
            f"delay_at_frequency_s = {late.tolist()} }}"
        )
        text = text.replace("identified = { alpha = 11.0, delay_s = 0.011 }", known, 1)
    return text.replace("[specimen]", f"{extra}\n[specimen]")


@pytest.mark.long
@pytest.mark.parametrize(
    "extra", ["", "forces = [[1, 0.3, 0.7], [0, 0.4, 0.6]]", "displacements = GIVEN"]
)
def test_motion_decays_as_the_largest_root_of_redundant_actuators_says(extra: str) -> None:
    weights = [[1, 0, 0], [-1, 0.2, 0.8]]
    rig = read(swept(extra.replace("GIVEN", str(weights))))
    text = TEST.replace("ratio = 0.05", "ratio = 0.1").replace('"paper"', '"none"')
    text = text.replace('"0.1 g"', '"0.05 g"').replace('"6 s"', '"4 s"')
    text = text.replace('name = "redundant"', 'name = "redundant"\nfree_vibration_s = 20')
    setup = axes_experiment.prepare(config.parse_test(text, "test.toml"), rig)
    verdict = loop_stability.judge(setup)
    assert verdict is not None
    assert not verdict.unstable
    grown = growth_of(setup, verdict.frequency_hz)
    assert grown - 1.0 == pytest.approx(verdict.radius - 1.0, rel=0.05)


def test_responses_of_redundant_axes_are_those_of_each_in_parallel() -> None:
    rig = read(swept())
    axes = axes_roots.each_alone(rig, STANDARD)
    assert axes is not None
    found = axes.system.response(np.exp(2j * np.pi * SWEPT_HZ * H))
    each = np.stack([second_order(hz) for hz in (20, 22, 20)], axis=-1)
    matrix = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 1.0]])
    moved = np.linalg.pinv(matrix) * each[:, None, :]
    np.testing.assert_allclose(found[:, :2], moved, atol=2e-3)
    np.testing.assert_allclose(found[:, 2:], np.array(rig.k_e) @ moved, atol=2e-3 * 8e6)


def test_check_shows_roots_of_redundant_actuators_or_says_what_is_missing(
    tmp_path: Path, rthyb: Rthyb
) -> None:
    (tmp_path / "test.toml").write_text(TEST, encoding="utf-8")
    shown = []
    for text in (RIG, swept()):
        (tmp_path / "floor.toml").write_text(text, encoding="utf-8")
        done = rthyb("check", str(tmp_path / "test.toml"))
        assert done.code == 0, done.err
        shown.append(" ".join(done.out.split()))
    assert "Largest root not computed the rig file has no identified response" in shown[0]
    assert "Axis middle" in shown[0]
    assert re.search(r"Largest root [01]\.\d{5} at .* rig known up to 40 Hz", shown[1])
