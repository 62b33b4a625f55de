"""Sensors without an actuator at a coupler with pins: wires whose length follows from the pose, at
any size of the motion, and load cells that correct the forces of the axes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from kernels import Floats
from test_kinematics import COUPLER, TRIPOD, lengths, motion
from test_sensors_without_actuator import (
    LINKED,
    NAMES,
    TEST,
    completed,
    over_links,
    quiet,
    read,
    station_replay,
)

from rthyb_rt import config as files
from rthyb_rt.analysis import several_axes as analysis
from rthyb_rt.checking.examined_rig import examine_rig
from rthyb_rt.core import CoreError
from rthyb_rt.core.coupled_rig import CoupledRig
from rthyb_rt.core.kinematics import Kinematics, Pin
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_rig

WIRES = (
    Pin((0.25, 0.05), (1.1, -0.35)),
    Pin((-0.1, 0.2), (-0.3, 0.9), pulls=True),
    Pin((0.0, -0.15), (-0.5, 1.0), far=True),
)
"""Oblique wires of .94 and .73 m, and a laser far away."""


def tripod(*wires: Pin, **more: Any) -> Kinematics:
    return Kinematics(
        pins=TRIPOD, coordinates=["theta", "x", "y"], sensor_pins=wires or WIRES, **more
    )


def exact(pins: tuple[Pin, ...], pose: Floats) -> Floats:
    """Lengths in extended precision; a laser measures along its direction."""
    found = lengths(tuple(pins), pose)
    x, y, t = np.asarray(pose, dtype=np.longdouble).T
    for i, pin in enumerate(pins):
        if pin.far:
            p, e = (np.array(v, np.longdouble) for v in (pin.pin_m, pin.base_m))
            e = e / np.hypot(*e)
            moved = (x + np.cos(t) * p[0] - np.sin(t) * p[1] - p[0]) * e[0]
            moved += (y + np.sin(t) * p[0] + np.cos(t) * p[1] - p[1]) * e[1]
            found[:, i] = (-moved if pin.pulls else moved).astype(np.float64)
    return found


# ---- geometry -----------------------------------------------------------------------------------


def test_wires_read_their_exact_change_of_length_at_sixty_millimetres_and_eighty_milliradians() -> (
    None
):
    pose = motion()
    assert np.abs(pose).max(axis=0) == pytest.approx([0.06, 0.03, 0.08], rel=0.01)
    found = tripod().readings(pose[:, [2, 0, 1]], np.zeros_like(pose))
    assert np.abs(found - exact(WIRES, pose)).max() < 1e-12
    # Their constant rows at rest are wrong by millimetres there.
    linear = pose[:, [2, 0, 1]] @ tripod().reads().T
    assert np.abs(linear - found).max() > 1e-3


@pytest.mark.parametrize("count", [1, 2, 3])
def test_two_steps_find_the_pose_of_all_readings_within_1e_12_m(count: int) -> None:
    pose, wires = motion(), WIRES[:count]
    found = tripod(*wires).measured_pose(lengths(TRIPOD, pose), exact(wires, pose))
    assert np.abs(found - pose[:, [2, 0, 1]]).max() < 1e-12
    two = Kinematics(pins=COUPLER, coordinates=["x", "theta"], sensor_pins=wires)
    flat = pose * [1, 0, 1]
    found = two.measured_pose(lengths(COUPLER, flat), exact(wires, flat))
    assert np.abs(found - flat[:, [0, 2]]).max() < 1e-12


def test_readings_with_noise_give_the_least_squares_pose() -> None:
    """Against SciPy's own search for the least squares of the exact lengths, sample by sample."""
    from scipy.optimize import least_squares

    pose = motion()[::64]
    rng = np.random.default_rng(4)
    axes = lengths(TRIPOD, pose) + rng.normal(scale=1e-4, size=(len(pose), 3))
    wires = exact(WIRES, pose) + rng.normal(scale=1e-4, size=(len(pose), 3))
    errors = []
    for x, s, near in zip(axes, wires, pose, strict=True):
        tie = tripod()
        for _ in range(4):
            found = tie.measured_pose([x], [s])[0]

        def left(q: Floats, x: Floats = x, s: Floats = s) -> Floats:
            at = np.array([q])
            return np.concatenate([lengths(TRIPOD, at)[0] - x, exact(WIRES, at)[0] - s])

        wanted = least_squares(left, near, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        assert np.abs(found - wanted[[2, 0, 1]]).max() < 1e-8
        alone = tripod()
        for _ in range(4):
            by_axes, _ = alone.pose(x)
        errors.append([found - near[[2, 0, 1]], by_axes - near[[2, 0, 1]]])
    # Six readings know it better than three, in every direction.
    of_all, of_axes = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (of_all < 0.9 * of_axes).all()


def test_a_slope_of_the_readings_is_that_of_their_lengths() -> None:
    tie = tripod()
    here = motion()[777]
    for _ in range(3):
        tie.measured_pose(lengths(TRIPOD, here[None]), exact(WIRES, here[None]))
    slopes, step = tie.reads(), 1e-6
    for j, column in enumerate((2, 0, 1)):
        by = step * np.eye(3)[column]
        ahead, back = (exact(WIRES, (here + sign * by)[None])[0] for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, j], (ahead - back) / (2 * step), atol=1e-9)
    own, further = tie.shares()
    np.testing.assert_allclose(own @ tie.jacobian() + further @ slopes, np.eye(3), atol=1e-12)
    weights = own + further @ slopes @ tie.back()
    np.testing.assert_allclose(tie.weights(), weights, atol=1e-13)


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300, 1e4])
@pytest.mark.parametrize("which", range(4))
def test_a_senseless_reading_is_replaced_by_the_last_good_one(absurd: float, which: int) -> None:
    share = np.array([[0.1, 0.5, 0.0]])
    tie = tripod(carries=share, forces=[[0.2], [1.0], [0.3]])
    pose, force = motion()[777:778], np.array([[40.0, 3e3, -2e3]])
    x = lengths(TRIPOD, pose)
    s = tie.readings(pose[:, [2, 0, 1]], force)
    for _ in range(3):
        good = tie.measured_pose(x, s)
    f = np.linalg.solve(tie.jacobian().T, force[0])[None]
    pushed = tie.measured_forces(f, s)
    s[0, which] = absurd if which < 3 or absurd != 1e4 else 1e13
    np.testing.assert_allclose(tie.measured_pose(x, s), good, rtol=0, atol=1e-15)
    assert np.array_equal(tie.measured_forces(f, s), pushed)


def test_wires_that_fit_no_pose_leave_the_last_one() -> None:
    tie = Kinematics(pins=COUPLER, coordinates=["x", "theta"], sensor_pins=WIRES[:1])
    pose = motion()[777:778] * [1, 0, 1]
    x, s = lengths(COUPLER, pose), exact(WIRES[:1], pose)
    for _ in range(3):
        good = tie.measured_pose(x, s)
    assert np.array_equal(tie.measured_pose(np.array([[0.9, -0.9]]), s), good)
    assert np.abs(tie.measured_pose(x, s) - good).max() < 1e-15


# ---- forces -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_cells_of_axes_and_specimen_give_its_force_at_every_pose(seed: int) -> None:
    """Whatever the weight of the cells, if both measure the same force; and the work is right."""
    rng = np.random.default_rng(seed)
    carries, weight = rng.uniform(0.2, 0.6, (2, 3)), rng.uniform(-0.9, 0.9, (3, 2))
    tie = tripod(WIRES[0], carries=carries, forces=weight)
    for at in motion()[::500]:
        force = rng.uniform(-1e5, 1e5, 3)
        for _ in range(3):
            wire = np.column_stack([exact(WIRES[:1], at[None]), np.zeros((1, 2))])
            tie.measured_pose(lengths(TRIPOD, at[None]), wire)
        pushes = np.linalg.solve(tie.jacobian().T, force)
        read = tie.readings(at[None, [2, 0, 1]], force[None])
        np.testing.assert_allclose(read[0, 1:], carries @ force, rtol=1e-14)
        found = tie.measured_forces(pushes[None], read)[0]
        np.testing.assert_allclose(found, force, rtol=1e-11)
        # A newton more at a cell acts by its column alone.
        read[0, 2] += 1.0
        more = tie.measured_forces(pushes[None], read)[0] - found
        np.testing.assert_allclose(more, weight[:, 1], atol=1e-9)
        np.testing.assert_allclose(tie.pushes(force), pushes, rtol=1e-10)


# ---- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"sensor_pins": [Pin((0.2, 0.1), (0.2, 0.1))]}, "do not determine"),
        ({"sensor_pins": [Pin((0.2, 0.1), (0.0, 0.0), far=True)]}, "do not determine"),
        ({"sensor_pins": [Pin((math.nan, 0.1), (1.0, 0.0))]}, "do not determine"),
        ({"sensor_pins": [Pin((0.2, 0.1), (math.inf, 0.0))]}, "do not determine"),
        ({"sensor_pins": WIRES[:1] * 5}, "at most 4"),
        ({"reads": [[1.0, 0.0]]}, "with a matrix only"),
        ({"carries": [[0.4, 0.0]]}, "forces: found none with pins and 1 load cells"),
        ({"forces": [[1.0], [0.0]]}, r"forces: found shape \(2, 1\) with pins and 0 load cells"),
        ({"carries": [[0.4, 0.0]], "forces": [[math.nan], [0.0]]}, "do not determine"),
    ],
)
def test_sensors_that_cannot_be_used_are_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(CoreError, match=said):
        Kinematics(pins=COUPLER, coordinates=["x", "theta"], **wrong)


def test_sensor_pins_do_not_go_with_a_matrix_and_a_description_is_restored() -> None:
    with pytest.raises(CoreError, match="they go with pins only"):
        Kinematics(np.eye(2), sensor_pins=WIRES)
    tie = tripod(carries=[[0.1, 0.5, 0.0]], forces=[[0.2], [1.0], [0.3]])
    again = Kinematics.of(tie.plain())
    assert again.plain() == tie.plain()
    pose = motion()[:50, [2, 0, 1]]
    assert np.array_equal(again.readings(pose, pose), tie.readings(pose, pose))
    assert set(Kinematics(pins=COUPLER, coordinates=["x", "theta"]).plain()) == {
        "matrix", "pins", "coordinates"
    }  # fmt: skip


# ---- a rig file ---------------------------------------------------------------------------------

PINS = """[kinematics]
kind = "pins"
interface = ["x", "theta"]
pins_m = { left = [0.3, 0.25], right = [0.3, -0.25] }
bases_m = { left = [-1.2, 0.25], right = [-1.2, -0.25] }
cell_forces = [[1.25], [0]]
[specimen]
stiffness = [[8e6, 2e5], [2e5, 1e6]]
[limits]
ramp_in_s = 1.5
"""


def with_pins(text: str) -> str:
    """The rig of `test_sensors_without_actuator`, with its wire and its column at a coupler."""
    text = text[: text.index("[kinematics]")]
    text = text.replace(
        "along = { first = 1, second = 0.5 }", "pin_m = [0.1, 0.05]\nbase_m = [-0.7, 0.2]"
    )
    return text.replace("first", "x") + PINS


RIG = with_pins(LINKED)
OWN_TEST = TEST.replace('"first"', '"x"').replace('"second"', '"theta"')


def test_a_file_is_written_and_read_again() -> None:
    given = read(RIG)
    assert read(files.dump(given)) == given
    tie = given.core_kinematics()
    (pin,) = tie.plain()["sensor_pins"]
    assert (list(pin["pin_m"]), list(pin["base_m"])) == ([0.1, 0.05], [-0.7, 0.2])
    length, reach = math.hypot(0.8, 0.15), np.array([0.8, -0.15])
    slopes = [reach[0] / length, (0.1 * reach[1] - 0.05 * reach[0]) / length]
    np.testing.assert_allclose(given.along(given.lone_sensors[0]), slopes, rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("base_m = [-0.7, 0.2]", "base_m = [0.1, 0.05]", "wire: has its pin at its own base"),
        ("base_m = [-0.7, 0.2]", "direction = [0, 0]", "wire: found direction = [0, 0]"),
        ("base_m = [-0.7, 0.2]", "direction = [1e-7, 0]", "wire: found direction = [1e-07, 0]"),
        (
            "pin_m = [0.1, 0.05]\nbase_m = [-0.7, 0.2]",
            "pin_m = [0, 0.2]\ndirection = [0, 1]",
            "wire: found pin_m = [0, 0.2] and direction = [0, 1]; with these its reading at rest",
        ),
        (
            "pin_m = [0.1, 0.05]\nbase_m = [-0.7, 0.2]",
            "pin_m = [0, 0.05]\nbase_m = [0, 0.4]",
            "responds to none of the directions x, theta",
        ),
        ("base_m = [-0.7, 0.2]\n", "", "wire: found pin_m; with kinematics of kind"),
        ("pin_m = [0.1, 0.05]\n", "", "wire: found base_m; with kinematics of kind"),
        ("base_m = [-0.7, 0.2]", "base_m = [-0.7, inf]", "found inf"),
        ("base_m = [-0.7, 0.2]", "base_m = [-0.7, 0.2]\nalong = { x = 1 }", "goes with a matrix"),
        ("cell_forces = [[1.25], [0]]\n", "", "cell_forces: is missing; must be 2 rows"),
        ("cell_forces = [[1.25], [0]]", "cell_forces = [[1.25, 0]]", "found 1 rows of 2 numbers"),
    ],
)
def test_a_fault_is_told_with_sensor_value_and_what_is_allowed(
    old: str, new: str, said: str
) -> None:
    assert old in RIG
    with pytest.raises(InputError) as caught:
        read(RIG.replace(old, new, 1))
    problems = [str(one) for one in caught.value.problems]
    assert any(said in one for one in problems), problems
    assert all(one.startswith("floor.toml:") for one in problems)


def test_a_load_cell_with_an_unusual_correction_is_said_by_check() -> None:
    """By a wrong sign, or newtons per kilonewton; half of the correction is usual."""
    for entry, share in ((1.25, None), (2.5, None), (0, None), (-1.25, -0.5), (1250, 500)):
        rig = read(RIG.replace("cell_forces = [[1.25], [0]]", f"cell_forces = [[{entry}], [0]]"))
        texts = examine_rig(rig, None, stiffness_stated=True).warnings
        texts = [text for text in texts if "cell_forces" in text]
        assert len(texts) == (share is not None)
        if share is not None:
            assert f"found {entry:g} for load cell column along x" in texts[0]
            assert f"is a correction of {share:g}; usual is 0" in texts[0]


def test_the_virtual_rig_reads_exact_lengths_far_from_rest() -> None:
    given = read(quiet(RIG))
    plant = CoupledRig(axes_rig.rig_config(given))
    tie = given.core_kinematics()
    for pose in ([0.02, 0.03], [-0.025, -0.04]):
        x = tie.axes(pose)[0]
        for _ in range(3000):
            plant.run(np.array([x]))
        wire = exact((Pin((0.1, 0.05), (-0.7, 0.2)),), np.array([[pose[0], 0.0, pose[1]]]))[0, 0]
        assert plant.sensors[0] == pytest.approx(wire, abs=1e-9)


def test_a_test_with_pins_and_sensors_follows_its_reference_and_is_replayed() -> None:
    rec = completed(RIG, OWN_TEST)
    for direction in analysis.summarize(rec).directions:
        assert direction.response_nrmse < 0.2
    rows, tie = rec.running(), read(RIG).core_kinematics()
    x = np.column_stack([rec.axis(name)["x_meas_m"][rows] for name in NAMES])
    sensors = np.column_stack([rec.samples["wire"][rows], rec.samples["column"][rows]])
    wanted = tie.readings(tie.measured_pose(x, sensors), np.zeros((rows.sum(), 2)))[:, 0]
    assert np.abs(wanted).max() > 2e-3
    assert np.abs(wanted - sensors[:, 0]).max() < 6e-5
    assert station_replay.replay(rec).identical


def test_over_links_with_lost_frames_it_completes_and_is_replayed() -> None:
    rec = over_links(RIG, ["right.drop:p=0.02,from=1,to=5"], OWN_TEST)
    assert rec.meta["end_reason"] == "completed"
    rows = rec.samples[rec.running()]
    assert np.isnan(rows["wire_read"]).sum() > 30
    assert np.isfinite(rows["wire"]).all()
    # What is made up in between follows the command: it does not leap.
    assert np.abs(np.diff(rows["wire"])).max() < 1e-3
    assert station_replay.replay(rec).identical
