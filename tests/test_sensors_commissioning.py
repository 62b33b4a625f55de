"""Sensors without an actuator before a test: commissioning with every axis, jogs, certificates."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axes_bench import NAMES
from command_line import Rthyb
from test_sensors_in_real_time import (
    DEFAULTS,
    MOST,
    NO_NUMBER,
    SENSORS,
    Change,
    assert_replays,
    at_lines,
    between,
)
from test_sensors_without_actuator import WITH_BOTH, quiet, read

from rthyb_rt import config as files
from rthyb_rt import core
from rthyb_rt.cli import connecting
from rthyb_rt.config import AxesRig
from rthyb_rt.core import loop, wire
from rthyb_rt.errors import InputError
from rthyb_rt.lab import beside, experiment
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.commissioning import certificate, guide, jogging
from rthyb_rt.rig.commissioning.guided_motion import (
    GuidedMotion,
    Reach,
    carry_out,
    eased,
    with_rests,
)
from rthyb_rt.rig.links import opening

LIMITS = ("link", "polarity")
EVERY = pytest.mark.parametrize("axis", NAMES)
EACH = pytest.mark.parametrize("name", SENSORS)
WIRE = "along = { first = 1, second = 0.5 }"
CELL = "along = { first = 0.4 }"
PER_AXIS = np.linalg.inv([[1.0, 0.0], [1.0, 1.0]])
"""Motion of the interface for a unit of each axis."""
STIFFNESS = np.array([[8e6, -1e6], [-1e6, 6e6]])


def expected_wire(first: float, second: float, axis: str) -> float:
    """Change of a displacement sensor for 1 mm of one axis, m."""
    return float([first, second] @ PER_AXIS[:, NAMES.index(axis)]) * 1e-3


def expected_cell(share: float, axis: str) -> float:
    """Change of a load cell with a share of the force along `first` for 1 mm of one axis, N."""
    return float(share * (STIFFNESS @ PER_AXIS)[0, NAMES.index(axis)]) * 1e-3


def commissioned(
    axis: str,
    theirs: str = DEFAULTS,
    ours: str = DEFAULTS,
    steps: tuple[str, ...] = LIMITS,
    distance_m: float = 1e-3,
) -> certificate.Certificate:
    """Commission one axis of a rig whose drives, and sensors, are as in another file."""
    with ExitStack() as owned:
        ends, drives_ends = map(owned.enter_context, opening.socket_pairs(NAMES))
        drives = owned.enter_context(virtual_rig.in_step(read(theirs), drives_ends))
        alone = ends.alone(NAMES.index(axis))
        connection = Reach(read(ours).of_axis(axis), alone, "stepped", drives.tick)
        plan = guide.CommissioningSettings(steps, distance_m)
        return guide.commission(connection, plan, axis=axis)


def changed(text: str, *pairs: tuple[str, str]) -> str:
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


def fitting(weight: float, share: float, matrix: Any = ((1, 0), (1, 1))) -> str:
    """``forces`` for a load cell with a share of the force along `first`, and its weight there."""
    of_axes = np.diag([1.0 - weight * share, 1.0]) @ np.array(matrix, dtype=float).T
    return f"forces = {np.hstack([of_axes, [[weight], [0.0]]]).tolist()}"


FORCES = "forces = [[0.5, 0.5, 1.25], [0, 1, 0]]"


# ---- a rig that is as its file says -------------------------------------------------------------


@pytest.mark.parametrize("axis", NAMES)
def test_every_axis_is_compared_with_every_sensor_in_whichever_frames_it_is_read(axis: str) -> None:
    found = commissioned(axis)
    assert [found.steps[step].passed for step in LIMITS] == [True, True], found.as_json()
    rest = found.steps["link"].figures["sensors"]
    assert rest["wire"]["noise"] == pytest.approx(2e-6, rel=0.1)
    assert rest["column"]["noise"] == pytest.approx(10.0, rel=0.1)
    assert abs(rest["wire"]["reading"]) < 5e-6
    moved = found.steps["polarity"].figures["sensors"]
    wanted = {"wire": expected_wire(1.0, 0.5, axis), "column": expected_cell(0.4, axis)}
    for name, value in wanted.items():
        # Noise of a mean over 256 rows, of force and displacement: below .1 %.
        assert moved[name]["change"] == pytest.approx(value, rel=0.02)
        assert moved[name]["expected"] == pytest.approx(value, rel=0.02)
        assert moved[name]["expected"] == pytest.approx(moved[name]["change"], rel=0.01)


def test_what_is_expected_of_a_load_cell_does_not_depend_on_the_specimen_as_drawn() -> None:
    """Forces of all axes are read: a specimen half as stiff changes neither verdict nor ratio."""
    soft = changed(DEFAULTS, ("[[8e6, -1e6], [-1e6, 6e6]]", "[[4e6, 1e6], [1e6, 3e6]]"))
    found = commissioned("left", soft).steps["polarity"]
    assert found.passed, found.faults
    column = found.figures["sensors"]["column"]
    assert column["change"] == pytest.approx(0.4 * (4e6 - 1e6) * 1e-3, rel=0.02)
    assert column["expected"] == pytest.approx(column["change"], rel=0.01)


def test_a_sensor_may_be_connected_to_a_drive_that_does_not_move_it() -> None:
    """The wire follows the left axis alone, and is read with the frames of the right one."""
    text = changed(DEFAULTS, (WIRE, "along = { first = 1 }"))
    left, right = (commissioned(axis, text, text).steps["polarity"] for axis in NAMES)
    assert left.passed, left.faults
    assert right.passed, right.faults
    assert left.figures["sensors"]["wire"]["expected"] == pytest.approx(1e-3, rel=0.02)
    assert left.figures["sensors"]["wire"]["conclusive"] is True
    assert abs(right.figures["sensors"]["wire"]["change"]) < 5e-6
    assert right.figures["sensors"]["wire"]["conclusive"] is False


def test_a_sensor_mounted_two_degrees_out_of_line_passes() -> None:
    """It reads 3.5 % of a motion that its row does not mention."""
    text = changed(DEFAULTS, (WIRE, "along = { first = 1 }"))
    askew = changed(DEFAULTS, (WIRE, "along = { first = 1, second = 0.035 }"))
    for axis in NAMES:
        found = commissioned(axis, askew, text).steps["polarity"]
        assert found.passed, found.faults


# ---- ways of wiring and configuring it wrongly --------------------------------------------------

WRONG: dict[str, tuple[str, tuple[tuple[str, str], ...], dict[str, tuple[float, str]]]] = {
    # sensor, what is different at the rig, and at which axes it is refused: change, and words
    "wire of the wrong sign": (
        "wire",
        ((WIRE, "along = { first = -1, second = -0.5 }"),),
        {
            "left": (-0.5e-3, "moved against what its along says: −0.500 mm when the axis moved"),
            "right": (-0.5e-3, "moved against what its along says: −0.500 mm when the axis moved"),
        },
    ),
    "wire in half millimetres": (
        "wire",
        ((WIRE, "along = { first = 2, second = 1 }"),),
        {
            "left": (
                1e-3,
                "where 0.500 mm was expected from the displacement sensors of the axes (left "
                "1.00 mm, right 0 mm), a ratio of 2; from 0.8 to 1.2 is allowed",
            ),
            "right": (1e-3, "a ratio of 2; from 0.8 to 1.2 is allowed"),
        },
    ),
    "wire in inches": (
        "wire",
        ((WIRE, "along = { first = 25.4, second = 12.7 }"),),
        {"left": (12.7e-3, "a ratio of 25.4"), "right": (12.7e-3, "a ratio of 25.4")},
    ),
    "wire at the wrong place, seen by the axis that does not carry its frames": (
        "wire",
        ((WIRE, "along = { first = 2, second = 0.5 }"),),
        {"left": (1.5e-3, "a ratio of 3")},
    ),
    "one direction of the wire reversed": (
        "wire",
        ((WIRE, "along = { first = 1, second = -0.5 }"),),
        {"left": (1.5e-3, "a ratio of 3"), "right": (-0.5e-3, "moved against")},
    ),
    "directions of the wire interchanged": (
        "wire",
        ((WIRE, "along = { first = 0.5, second = 1 }"),),
        {"left": (-0.5e-3, "moved against"), "right": (1e-3, "a ratio of 2")},
    ),
    "wire not mounted": (
        "wire",
        ((WIRE, "along = { first = 1e-9 }"),),
        {
            "left": (0.0, "did not respond when the axis moved by"),
            "right": (0.0, "connected to the drive of axis right as its channel wire_end?"),
        },
    ),
    "cell of the wrong sign": (
        "column",
        ((CELL, "along = { first = -0.4 }"), (FORCES, fitting(-1.25, -0.4))),
        {"left": (-3600.0, "moved against what its along says: −3600 N"), "right": (400.0, "")},
    ),
    "cell with half a bridge": (
        "column",
        ((CELL, "along = { first = 0.2 }"), (FORCES, fitting(1.25, 0.2))),
        {"left": (1800.0, "a ratio of 0.5; from 0.707 to 1.41 is allowed"), "right": (-200.0, "")},
    ),
    "cell with twice the gain": (
        "column",
        ((CELL, "along = { first = 0.8 }"), (FORCES, fitting(1.25, 0.8))),
        {"left": (7200.0, "a ratio of 2; from 0.707 to 1.41 is allowed"), "right": (-800.0, "")},
    ),
    "cell in pounds": (
        "column",
        (
            (CELL, "along = { first = 0.08992 }"),
            (FORCES, fitting(1.25, 0.08992)),
        ),
        {"left": (809.3, "a ratio of 0.225"), "right": (-89.9, "")},
    ),
    "cell below the specimen in the other direction": (
        "column",
        ((CELL, "along = { second = 0.4 }"), (FORCES, "forces = [[1, 1, 0], [0, 1, 0]]")),
        {"left": (-2800.0, "moved against"), "right": (2400.0, "moved against")},
    ),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_is_refused_with_what_was_measured_and_what_was_expected(mistake: str) -> None:
    name, different, refused = WRONG[mistake]
    theirs = changed(DEFAULTS, *different)
    seen = 0
    for axis in NAMES:
        found = commissioned(axis, theirs).steps["polarity"]
        if axis not in refused:
            assert found.passed, found.faults
            continue
        change, said = refused[axis]
        figures = found.figures["sensors"][name]
        wanted = expected_wire(1, 0.5, axis) if name == "wire" else expected_cell(0.4, axis)
        assert figures["expected"] == pytest.approx(wanted, rel=0.02)
        assert figures["change"] == pytest.approx(change, rel=0.02, abs=2e-6 + 5e-3 * abs(wanted))
        if found.passed and not said:
            continue  # too close to what the other axis already shows
        assert found.passed is False
        (fault,) = found.faults
        assert fault.startswith(f"sensor {name}: ")
        assert said in fault
        seen += 1
    assert seen > 0


@EVERY
@pytest.mark.parametrize(
    ("different", "said"),
    [
        # Millimetres for metres: it jumps.
        ((WIRE, "along = { first = 1000, second = 500 }"), "of sensor wire: the displacement"),
        # 100 times too large: the end of the range is reached on the way.
        ((WIRE, "along = { first = 200, second = 100 }"), "no usable reading of sensor wire"),
    ],
)
def test_a_sensor_whose_own_limit_ends_the_motion_is_named_and_the_specimen_brought_back(
    axis: str, different: tuple[str, str], said: str
) -> None:
    theirs = read(changed(DEFAULTS, different))
    ends, drives_ends = opening.socket_pairs(NAMES)
    with ends, drives_ends, virtual_rig.in_step(theirs, drives_ends) as drives:
        rig = read(DEFAULTS).of_axis(axis)
        connection = Reach(rig, ends.alone(NAMES.index(axis)), "stepped", drives.tick)
        plan = guide.CommissioningSettings(LIMITS, 1e-3)
        found = guide.commission(connection, plan, axis=axis)
        still = GuidedMotion("still", np.zeros(300), with_sensors=False)
        moved = carry_out(dataclasses.replace(connection, resets=True), still)
    step = found.steps["polarity"]
    assert step.passed is False
    assert step.faults[0].startswith("the motion did not finish: ")
    assert said in step.faults[0]
    assert all("sensor wire" in fault for fault in step.faults)
    began_m = found.steps["link"].figures["displacement_m"]
    assert abs(moved.start_m - began_m) < 20e-6


TWO_WIRES = changed(
    DEFAULTS,
    ("[[sensor]]\nkind = \"displacement\"", '[[sensor]]\nkind = "displacement"\nname = "string"\n'
     'extra = "string_end"\nalong = { first = 1 }\nnoise_std_m = 2e-6\nrange_m = "80 mm"\n'
     '[[sensor]]\nkind = "displacement"'),
    ('name = "wire_end"\nunit = "m"\nwire_step = 1e-9\n',
     'name = "wire_end"\nunit = "m"\nwire_step = 1e-9\n[[axis.sensors.extra]]\n'
     'name = "string_end"\nunit = "m"\nwire_step = 1e-9\n'),
)  # fmt: skip


def test_interchanged_cables_are_recognised() -> None:
    theirs = changed(
        TWO_WIRES,
        ('extra = "wire_end"', 'extra = "?"'),
        ('extra = "string_end"', 'extra = "wire_end"'),
        ('extra = "?"', 'extra = "string_end"'),
    )
    for axis in NAMES:
        good = commissioned(axis, TWO_WIRES, TWO_WIRES).steps["polarity"]
        assert good.passed, good.faults
        found = commissioned(axis, theirs, TWO_WIRES).steps["polarity"]
        assert found.passed is False
        assert [fault.split(":")[0] for fault in found.faults] == ["sensor string", "sensor wire"]
        for fault, other in zip(found.faults, ("wire", "string"), strict=True):
            assert other in fault
            assert "their cables, or their extra keys, are interchanged" in fault


def test_interchanged_rows_of_the_kinematics_are_refused_by_the_sensors() -> None:
    """The file says that the left axis moves both directions, but it is the right one."""
    matrix = ((1, 1), (1, 0))
    ours = changed(
        DEFAULTS,
        ("matrix = [[1, 0], [1, 1]]", "matrix = [[1, 1], [1, 0]]"),
        (FORCES, fitting(1.25, 0.4, matrix)),
        (WIRE, "along = { first = 1, second = 0.2 }"),
    )
    theirs = changed(DEFAULTS, (WIRE, "along = { first = 1, second = 0.2 }"))
    for axis in NAMES:
        found = commissioned(axis, theirs, ours).steps["polarity"]
        assert found.passed is False
        assert any(fault.startswith("sensor wire: ") for fault in found.faults)


def test_a_channel_scale_that_is_negative_is_told_with_its_axis() -> None:
    ours = changed(DEFAULTS, ('name = "wire_end"\n', 'name = "wire_end"\nscale = -1\n'))
    for axis in NAMES:
        (fault,) = commissioned(axis, DEFAULTS, ours).steps["polarity"].faults
        assert "reverse scale = -1 of its channel wire_end (axis right)" in fault


@pytest.mark.parametrize("axis", NAMES)
@pytest.mark.parametrize(
    ("name", "theirs", "said"),
    [
        (
            "column",
            ("noise_std_n = 10\nrange", "noise_std_n = 10\nbias_n = 30000\nrange"),
            "N at rest, but zeroing accepts at most 14400 N",
        ),
        (
            "wire",
            ("noise_std_m = 2e-6\nrange", "noise_std_m = 2e-6\nbias_m = 0.09\nrange"),
            "at or beyond the end of its range of 80.0 mm (range_m in the rig file)",
        ),
    ],
)
def test_a_zero_that_is_off_fails_the_link_check_of_every_axis(
    axis: str, name: str, theirs: tuple[str, str], said: str
) -> None:
    found = commissioned(axis, changed(DEFAULTS, theirs)).steps["link"]
    assert found.passed is False
    (fault,) = found.faults
    assert f"sensor {name}: " in fault
    assert said in fault


def test_a_motion_that_the_noise_of_a_sensor_hides_is_not_judged() -> None:
    noisy = changed(DEFAULTS, ("noise_std_m = 2e-6\nrange", "noise_std_m = 2e-3\nrange"))
    found = commissioned("right", noisy, noisy).steps["polarity"]
    assert found.passed is False
    assert "which its noise hides" in found.faults[0]


def checked_through(axis: str, name: str, change: Change) -> certificate.CheckedStep:
    """The polarity check while the number of a sensor is changed on its way, from the beginning."""
    with between(DEFAULTS) as (opened, way):
        way.axis, way.change, way.begun = NAMES.index(SENSORS[name][0]), change, 0
        rig = read(DEFAULTS).of_axis(axis)
        connection = Reach(rig, opened.alone(NAMES.index(axis)), "stepped", way.tick)
        found = guide.commission(connection, guide.CommissioningSettings(LIMITS), axis=axis)
    assert found.steps["link"].passed, found.steps["link"].faults
    return found.steps["polarity"]


def low_pass(tau_s: float, noise: int) -> Change:
    """A filter of the first order before a converter with the noise of the sensor."""
    rng, share, state = np.random.default_rng(7), -np.expm1(-1 / (1024 * tau_s)), list[float]()

    def change(_: int, raw: int) -> int:
        last = state[-1] if state else float(raw)
        state[:] = [last + share * (raw - last)]
        return round(state[0] + rng.normal(scale=noise))

    return change


@pytest.mark.parametrize(("name", "noise"), [("wire", 2000), ("column", 10_000)])
@pytest.mark.parametrize("tau_s", [0.002, 0.01, 0.05, 0.3])
def test_a_slow_filter_is_refused_with_its_delay_in_ms(name: str, noise: int, tau_s: float) -> None:
    """The mean delay of a filter of the first order is its time constant.

    Allowed: a quarter of the delay of the axis, 11 ms and what its link adds, and two samples.
    """
    found = checked_through("left", name, low_pass(tau_s, noise))
    figures = found.figures["sensors"][name]
    assert 11e-3 / 4 + 2 / 1024 < figures["lag_most_s"] < 14e-3 / 4 + 2 / 1024
    if tau_s < 0.1:  # slower, it has not come to rest when the motion is judged
        assert figures["lag_s"] == pytest.approx(tau_s, rel=0.05, abs=1e-3)
    assert found.passed is (tau_s < 0.004)
    if not found.passed:
        (fault,) = found.faults
        assert re.match(rf"sensor {name}: reads \d+(\.\d+)? ms late while the axis moves", fault)
        assert re.search(r"at most 4\.\d+ ms is allowed, 25 % of the delay of the axis", fault)


@pytest.mark.parametrize(("name", "noise"), [("wire", 2000), ("column", 10_000)])
def test_a_sensor_that_reads_the_same_on_both_sides_is_refused(name: str, noise: int) -> None:
    """A rectified signal changes as it should on one of them."""
    rng = np.random.default_rng(9)
    found = checked_through("left", name, lambda _, raw: abs(raw) + round(rng.normal(scale=noise)))
    (fault,) = found.faults
    assert fault.startswith(f"sensor {name}: did not respond when the axis moved by −2.00 mm")


def test_a_drive_that_is_switched_off_is_named() -> None:
    """The left drive sends nothing while the right axis is commissioned."""
    text = changed(DEFAULTS, (CELL + "\n", CELL + "\n"))
    with between(text) as (opened, way):
        way.axis, way.whole = 0, lambda _, frame: None
        rig = read(text).of_axis("right")
        connection = Reach(rig, opened.alone(1), "stepped", way.tick)
        found = guide.commission(connection, guide.CommissioningSettings(("link",)), axis="right")
    assert found.steps["link"].passed is False
    assert "sensor column: no usable reading" in found.steps["link"].faults[0]


def test_frames_that_a_link_loses_are_told_as_such_and_not_as_readings_that_a_sensor_lacks() -> (
    None
):
    """The left line loses one frame of 25 while the right axis is commissioned."""
    rng = np.random.default_rng(3)

    def lossy(now: int, frame: bytes) -> bytes | None:
        return None if now >= 0 and rng.random() < 1 / 25 else frame

    with between(DEFAULTS) as (opened, way):
        way.axis, way.whole = 0, lossy
        rig = read(DEFAULTS).of_axis("right")
        connection = Reach(rig, opened.alone(1), "stepped", way.tick)
        found = guide.commission(connection, guide.CommissioningSettings(("link",)), axis="right")
    step = found.steps["link"]
    assert step.passed is False
    (fault,) = step.faults
    assert fault.startswith("axis left: its drive, which receives no commands, sent displacement")
    assert step.figures["fresh_share"] == 1.0
    assert step.figures["sensors"]["column"]["seen_share"] == 1.0


# ---- jogs ---------------------------------------------------------------------------------------


def jogged(
    axis: str,
    name: str,
    change: Change = lambda _, raw: raw,
    text: str = DEFAULTS,
    whole: Callable[[int, bytes], bytes | None] = lambda _, frame: frame,
) -> jogging.Jogged:
    """Jog one axis by 1 mm while the number of a sensor is changed on its way."""
    with between(text) as (opened, way):
        way.axis, way.change, way.whole = NAMES.index(SENSORS[name][0]), change, whole
        rig = read(text).of_axis(axis)
        connection = Reach(rig, opened.alone(NAMES.index(axis)), "stepped", way.tick)
        return jogging.jog(connection, 1e-3)


@EVERY
def test_a_jog_shows_what_the_sensors_read_and_should_read(axis: str) -> None:
    found = jogged(axis, "wire")
    assert (found.cause, found.faults) == ("completed", ())
    assert found.sensors["wire"]["change"] == pytest.approx(expected_wire(1, 0.5, axis), rel=0.02)
    assert found.sensors["column"]["change"] == pytest.approx(expected_cell(0.4, axis), rel=0.02)


@EVERY
def test_a_jog_shows_a_sensor_of_the_wrong_sign(axis: str) -> None:
    found = jogged(axis, "wire", lambda _, raw: -raw)
    assert found.cause == "completed"
    (fault,) = found.faults
    assert fault.startswith("sensor wire: moved against what its along says")


@EVERY
@EACH
@pytest.mark.parametrize(
    ("number", "cause"), [(MOST, "sensor_lost"), (-MOST, "sensor_lost"), (NO_NUMBER, "not_finite")]
)
def test_a_jog_trips_when_a_sensor_has_no_usable_reading(
    axis: str, name: str, number: int, cause: str
) -> None:
    found = jogged(axis, name, lambda now, raw: number if now >= 600 else raw)
    assert (found.state, found.cause) == ("TRIPPED", cause)
    assert found.end_reason.endswith(f"of sensor {name}")
    assert found.moved_m < 0.1e-3
    assert all(f"sensor {name}" in fault for fault in found.faults)


@EVERY
@EACH
def test_a_jog_trips_when_the_drive_with_the_frames_of_a_sensor_goes_silent(
    axis: str, name: str
) -> None:
    found = jogged(axis, name, whole=lambda now, frame: None if now >= 600 else frame)
    own = SENSORS[name][0] == axis
    assert found.state == "TRIPPED"
    assert found.cause == ("link_lost" if own else "sensor_lost")


@EVERY
@EACH
def test_lost_frames_of_either_drive_do_not_end_a_jog(axis: str, name: str) -> None:
    """Each frame is lost with a probability of 1 in 30, so one pair of fifteen is not complete."""
    rng = np.random.default_rng(11)

    def lossy(now: int, frame: bytes) -> bytes | None:
        return None if now >= 0 and rng.random() < 1 / 30 else frame

    found = jogged(axis, name, whole=lossy)
    assert found.cause == "completed"
    assert found.faults == ()
    assert found.sensors[name]["change"] == pytest.approx(
        expected_wire(1, 0.5, axis) if name == "wire" else expected_cell(0.4, axis), rel=0.02
    )


@EVERY
@EACH
def test_a_jog_ends_when_a_sensor_jumps_or_freezes(axis: str, name: str) -> None:
    by = {"wire": 5_000_000, "column": 9_000_000}[name]  # 5 mm, 9 kN
    found = jogged(axis, name, lambda now, raw: raw + by if now >= 600 else raw)
    assert found.cause == {"wire": "sensor_jump", "column": "force_jump"}[name]
    assert found.end_reason == f"ramped out: jump of the reading of sensor {name}"
    held: list[int] = []

    def frozen(now: int, raw: int) -> int:
        if now >= 600:
            held.append(raw)
        return held[0] if held else raw

    found = jogged(axis, name, frozen)
    assert found.cause == {"wire": "sensor_stuck", "column": "force_stuck"}[name]
    assert found.end_reason == f"ramped out: frozen reading of sensor {name}"


@EVERY
@pytest.mark.parametrize("number", [None, MOST, NO_NUMBER])
def test_a_motion_of_one_axis_with_sensors_is_replayed_bit_for_bit(
    axis: str, number: int | None
) -> None:
    with between(DEFAULTS) as (opened, way):
        way.axis = NAMES.index("right")
        way.change = lambda now, raw: raw if number is None or now < 600 else number
        rig = read(DEFAULTS).of_axis(axis)
        connection = Reach(rig, opened.alone(NAMES.index(axis)), "stepped", way.tick)
        moved = carry_out(connection, GuidedMotion("motion", with_rests(eased(1e-3, 1e-3, 0.1))))
    assert_replays(moved.recording)
    assert (moved.cause == "completed") is (number is None)


@EVERY
def test_limits_of_a_sensor_in_the_rig_file_act_in_a_jog(axis: str) -> None:
    text = changed(
        DEFAULTS,
        ('name = "wire"\n', 'name = "wire"\njump_m = { value = "1 mm", action = "trip" }\n'),
    )
    found = jogged(axis, "wire", lambda now, raw: raw + (2_000_000 if now >= 600 else 0), text)
    assert (found.state, found.cause) == ("TRIPPED", "sensor_jump")


@EVERY
def test_a_jog_does_not_begin_with_a_sensor_at_the_end_of_its_range(axis: str) -> None:
    with pytest.raises(InputError, match="sensor wire") as caught:
        jogged(axis, "wire", lambda _, raw: MOST)
    assert "range_m in the rig file" in str(caught.value)


def test_a_jog_of_a_rig_at_serial_lines_hears_the_other_line() -> None:
    text = at_lines(DEFAULTS)
    with ExitStack() as owned:
        lines = [virtual_rig.pty_line()[0] for _ in NAMES]
        for k, line in enumerate(lines):
            owned.callback(line.close)
            text = text.replace(f"LINE{k}", line.name)
        links = [loop.Link(line.kind, line.fd) for line in lines]
        for link in links:
            owned.callback(link.close)
        given = read(text)
        drives = virtual_rig.drives_of(
            given, [line.codec for line in lines], links, virtual_rig.RigPlan()
        )
        opened = owned.enter_context(opening.open_axes(given, "controller"))
        alone = opened.alone(0)
        assert alone.name == opened.all[0].name
        connection = Reach(given.of_axis("left"), alone, "stepped", drives.tick)
        found = jogging.jog(connection, 1e-3)
        assert drives.drives[1].received_state != "RUNNING"
    assert found.cause == "completed"
    assert found.sensors["wire"]["change"] == pytest.approx(0.5e-3, rel=0.02)


def test_drives_that_are_only_heard_receive_nothing() -> None:
    with between(DEFAULTS) as (opened, way):
        rig = read(DEFAULTS).of_axis("right")
        jogging.jog(Reach(rig, opened.alone(1), "stepped", way.tick), 1e-3)
        assert set(way.commands) == {1}
        assert way.commands[1] > 1000


# ---- the station of one axis with sensors beside it ---------------------------------------------

PATH_M = 1e-3 * np.sin(np.linspace(0.0, 6.0, 2000)) * np.sin(np.linspace(0.0, np.pi, 2000)) ** 2


class OneAxis:
    """The station of one axis, with or without the sensors of the rig."""

    def __init__(self, *, sensors: bool = True) -> None:
        bare = experiment.prescribed(read(DEFAULTS).of_axis("left"), "one", PATH_M)
        setup = beside.with_sensors(bare) if sensors else bare
        config = beside.with_watches(setup, experiment.station_config(setup, real=True))
        # Without noise, every reading at rest repeats.
        config = dataclasses.replace(
            config,
            watches={},
            sensors=tuple(
                dataclasses.replace(one, stuck=None, frozen_ticks=0) for one in config.sensors
            ),
        )
        self.config, self.station = config, core.Station(config, PATH_M)
        self.count = 2 if sensors else 0
        self.rows: list[np.ndarray] = []
        self.sent: list[float] = []
        self.readings: list[list[float]] = []

    def step(self, command: core.Command = "none", **faults: Any) -> None:
        x = self.sent[-1] if self.sent else 0.0
        given: list[float | None] = [0.5 * x, 3.6e6 * x][: self.count]
        for name, value in faults.items():
            given[("wire", "column").index(name)] = value
        tick = self.station.tick(x, 16e6 * x, command=command, sensors=given)
        self.readings.append([0.0 if v is None else v for v in given])
        self.rows.append(tick.records.copy())
        self.sent.append(tick.x_cmd_m)

    def running(self, ticks: int = 400) -> OneAxis:
        self.step()
        self.step("zero")
        while self.station.state != "ZEROED":
            self.step()
        self.step("arm")
        self.step("start")
        while self.station.state != "RUNNING":
            self.step()
        for _ in range(ticks):
            self.step()
        assert self.station.state == "RUNNING"
        return self


def test_sensors_beside_an_axis_leave_its_commands_bit_for_bit() -> None:
    with_them, without = OneAxis().running(1500), OneAxis(sensors=False).running(1500)
    assert with_them.sent == without.sent
    assert np.ptp(with_them.sent) > 1e-4


@pytest.mark.parametrize("name", ["wire", "column"])
@pytest.mark.parametrize("absurd", [np.nan, np.inf, -np.inf])
def test_no_number_beside_an_axis_trips_at_once(name: str, absurd: float) -> None:
    one = OneAxis().running()
    one.step(**{name: absurd})
    number = ("wire", "column").index(name)
    assert (one.station.state, one.station.cause) == ("TRIPPED", "not_finite")
    assert one.station.cause_sensor == number
    placed = core.placed_cause(int(one.rows[-1]["cause"][-1]))
    assert placed == (core.CAUSES.index("not_finite"), None, None, number)
    assert np.isfinite(one.sent).all()


@pytest.mark.parametrize("name", ["wire", "column"])
@pytest.mark.parametrize("absurd", [1e300, -1e300, 1e13, None])
def test_no_reading_beside_an_axis_trips_after_twenty_ticks(
    name: str, absurd: float | None
) -> None:
    one = OneAxis().running()
    for _ in range(core.LOST_TICKS):
        assert one.station.state == "RUNNING"
        one.step(**{name: absurd})
    assert (one.station.state, one.station.cause) == ("TRIPPED", "sensor_lost")
    assert np.isfinite(one.sent).all()
    rows = np.concatenate(one.rows)
    again = core.Station(one.config, PATH_M).replay(
        rows, sensors=np.array(one.readings), codec=None
    )
    assert again.tobytes() == rows.tobytes()


def test_more_drives_than_links_are_refused() -> None:
    one = OneAxis()
    ours, theirs = opening.socket_pairs(NAMES)
    with ours, theirs:
        at = loop.Link(ours.all[0].kind, ours.all[0].fd)
        way = loop.LoopAxis(wire.Wire(wire.can()), at)
        with pytest.raises(core.CoreError, match="there may be up to 4 together"):
            loop.Loop(one.station, way.wire, at, sensors=[(1, 0), (0, 0)], heard=[way] * 4)
        at.close()


def test_a_sensor_in_the_file_of_one_axis_is_told_to_need_several() -> None:
    text = files.shipped_rig("first-order-5hz").read_text(encoding="utf-8")
    with pytest.raises(InputError, match=r"sensor: not available here: .* rig of several axes"):
        files.parse_any_rig(text + '\n[[sensor]]\nkind = "force"\nname = "column"\n', "one.toml")


# ---- certificates -------------------------------------------------------------------------------


def hashes(text: str) -> dict[str, str]:
    rig = read(text)
    return {name: certificate.rig_hash(rig.of_axis(name), name) for name in rig.names}


SAME_POSE = 'interface = ["first", "second"]\nmatrix = [[1, 0], [1, 1]]'


@pytest.mark.parametrize(
    "pairs",
    [
        ((WIRE, "along = { first = 1, second = 0.6 }"),),
        (('range_n = "70 kN"', 'range_n = "60 kN"'),),
        # Names of the columns exchanged: the same text of the matrix means other directions.
        ((SAME_POSE, SAME_POSE.replace('"first", "second"', '"second", "first"')),
         (CELL, "along = { second = 0.4 }")),
        # Rows of the axes exchanged.
        (("matrix = [[1, 0], [1, 1]]", "matrix = [[1, 1], [1, 0]]"),
         (FORCES, fitting(1.25, 0.4, ((1, 1), (1, 0))))),
        (("matrix = [[1, 0]", "matrix = [[1, 0.001]"),
         (FORCES, fitting(1.25, 0.4, ((1, 0.001), (1, 1))))),
        # Only the weights of the load cells.
        ((FORCES, fitting(1.0, 0.4)),),
        # The channel of a sensor, whichever drive sends it.
        (('name = "wire_end"\n', 'name = "wire_end"\nscale = 2\n'),),
        (('name = "cell"\n', 'name = "cell"\noffset = 1\n'),),
        # Another sensor beside them.
        ((DEFAULTS, TWO_WIRES),),
    ],
)  # fmt: skip
def test_whatever_changes_the_meaning_of_a_reading_invalidates_every_axis(
    pairs: tuple[tuple[str, str], ...],
) -> None:
    held, now = hashes(DEFAULTS), hashes(changed(DEFAULTS, *pairs))
    for name in NAMES:
        assert now[name] != held[name], pairs


def test_names_of_axes_are_part_of_the_certificate() -> None:
    """The axes' names exchanged: each row of the matrix then belongs to the other drive."""
    exchanged = changed(
        DEFAULTS,
        ('name = "left"', 'name = "?"'), ('name = "right"', 'name = "left"'),
        ('name = "?"', 'name = "right"'),
    )  # fmt: skip
    held, now = hashes(DEFAULTS), hashes(exchanged)
    assert not set(held.values()) & set(now.values())


def test_a_channel_moved_to_another_drive_invalidates_every_axis() -> None:
    channel = '[[axis.sensors.extra]]\nname = "wire_end"\nunit = "m"\nwire_step = 1e-9\n'
    moved = changed(DEFAULTS, (channel, ""))
    at = moved.index("[[axis.sensors.extra]]")
    held, now = hashes(DEFAULTS), hashes(moved[:at] + channel + moved[at:])
    for name in NAMES:
        assert now[name] != held[name]


SERIAL = at_lines(DEFAULTS).replace("LINE", "/dev/line").replace(", virtual = true", "")
"""At real drives."""


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('channel = "/dev/line1"', 'channel = "/dev/line9"'),
        ('channel = "/dev/line1"', 'channel = "/dev/line1", bitrate = 460800'),
        ('channel = "/dev/line1"', 'channel = "/dev/line1", stop_decel_m_per_s2 = 2'),
        (
            'name = "right"',
            'name = "right"\ncalibration = { displacement = { polarity = -1 } }',
        ),
        ('name = "right"', 'name = "right"\ncalibration = { force = { polarity = -1 } }'),
        ("displacement = { noise_std_m = 5e-6 }", "displacement = { noise_std_m = 4e-6 }"),
        (
            "displacement = { noise_std_m = 5e-6 }",
            "displacement = { noise_std_m = 5e-6, range_m = 0.05 }",
        ),
        (
            "wire_step = 1e-9\n",
            'wire_step = 1e-9\n[[axis.sensors.extra]]\nname = "acc"\nunit = "g"\n',
        ),
    ],
)
def test_another_drive_or_calibration_of_one_axis_invalidates_every_axis(
    old: str, new: str
) -> None:
    """By what one axis reads, the check of the other computed what was expected of a sensor."""
    at = SERIAL.index('name = "right"')
    edited = SERIAL[:at] + changed(SERIAL[at:], (old, new))
    held, now = hashes(SERIAL), hashes(edited)
    for name in NAMES:
        assert now[name] != held[name]


def test_what_does_not_change_a_reading_keeps_the_certificate() -> None:
    held = hashes(DEFAULTS)
    for old, new in (
        ("stiffness = [[8e6", "stiffness = [[7e6"),
        ('name = "floor"', 'name = "storey"'),
        ("identified = { alpha = 11.0", "identified = { alpha = 12.0"),
    ):
        assert hashes(changed(DEFAULTS, (old, new))) == held


def test_rigs_without_sensors_keep_the_certificate_that_they_have() -> None:
    """Hashes of version 0.4, before sensors without an actuator were commissioned."""
    bare = quiet(WITH_BOTH)
    rig = read(bare)
    assert all(not rig.of_axis(name).one_of.sensors for name in NAMES)  # type: ignore[union-attr]
    assert isinstance(rig, AxesRig)
    narrow = bare.replace('range_n = "70 kN"', 'range_n = "60 kN"')
    assert hashes(narrow) == hashes(bare)


def real_rig() -> AxesRig:
    return read(SERIAL)


@pytest.fixture(name="held")
def _held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A rig file whose axes have passed every check."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path = tmp_path / "floor.toml"
    path.write_text(DEFAULTS, encoding="utf-8")
    for axis in NAMES:
        one = commissioned(axis)
        own = dataclasses.replace(
            one, rig_hash=certificate.rig_hash(real_rig().of_axis(axis), axis)
        )
        for step in certificate.STEPS:
            if step not in own.steps:
                own = own.with_step(dataclasses.replace(one.steps["link"], name=step))
        certificate.write(certificate.place(path, axis), own)
    return path


def test_commissioned_sensors_may_be_used_on_real_drives(held: Path) -> None:
    known = certificate.demand(real_rig(), held)["commissioning"]
    assert known["demanded"] is True
    assert set(known["axes"]) == set(NAMES)
    changed_rig = read(
        changed(
            SERIAL,
            (WIRE, "along = { first = 1, second = 0.55 }"),
        )
    )
    with pytest.raises(RefusedError) as told:
        certificate.demand(changed_rig, held)
    for axis in NAMES:
        assert f"axis {axis}: link, calibration, actuator, sensors, [[sensor]]" in str(told.value)


def test_a_sensor_that_no_axis_moves_enough_is_not_used_on_real_drives(held: Path) -> None:
    for axis in NAMES:
        own = certificate.read(certificate.place(held, axis))
        step = own.steps["polarity"]
        figures = {**step.figures, "sensors": dict(step.figures["sensors"])}
        figures["sensors"]["column"] = {**figures["sensors"]["column"], "conclusive": False}
        again = own.with_step(dataclasses.replace(step, figures=figures))
        certificate.write(certificate.place(held, axis), again)
    with pytest.raises(RefusedError, match="sensor column: no axis moved it enough"):
        certificate.demand(real_rig(), held)


def test_a_virtual_rig_beside_a_real_drive_does_not_replace_the_check_of_a_sensor(
    held: Path,
) -> None:
    """The virtual axis needs no certificate and has none; the real one does not move the wire."""
    mixed = read(
        changed(SERIAL, ('channel = "/dev/line0"', 'channel = "/dev/line0", virtual = true'))
    )
    certificate.place(held, "left").unlink()
    own = certificate.read(certificate.place(held, "right"))
    own = dataclasses.replace(own, rig_hash=certificate.rig_hash(mixed.of_axis("right"), "right"))
    certificate.write(certificate.place(held, "right"), own)
    with pytest.raises(RefusedError, match="sensor column: no axis moved it enough") as told:
        certificate.demand(mixed, held)
    assert "sensor wire" not in str(told.value)


NO_NOISE = (
    ("noise_std_m = 2e-6\nrange", "range"),
    ("noise_std_n = 10\nrange", "range"),
)
"""Both sensors without what their limits follow from."""
WATCHED = 'stuck_s = "0.2 s"\njump_{unit} = {most}\nrange_{unit}'


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        (
            NO_NOISE[:1],
            "sensor wire: noise_std_m and stuck_s and jump_m are missing, so that a reading that "
            "repeats itself or jumps would not end a test",
        ),
        (NO_NOISE[1:], "sensor column: noise_std_n and stuck_s and jump_n are missing"),
        (
            (NO_NOISE[0], ('name = "wire"\n', 'name = "wire"\nstuck_s = 0.2\n')),
            "sensor wire: noise_std_m and jump_m are missing",
        ),
        (
            (("noise_std_m = 2e-6\nrange", "noise_std_m = 2e-6\nlsb_m = 1e-5\nrange"),),
            "sensor wire: noise_std_m is 2.00 um, less than half of the step of its readings, "
            "10.0 um, so that no limit on repeated readings can be derived: state stuck_s",
        ),
        (
            (('name = "wire"\n', 'name = "wire"\njump_m = { value = 1e-3, enable = false }\n'),),
            "sensor wire: jump_m must not be switched off on a real drive",
        ),
        (
            (
                (
                    'name = "column"\n',
                    'name = "column"\ndisagreement_n = { value = 1, action = "none" }\n',
                ),
            ),
            "sensor column: disagreement_n must not be switched off on a real drive",
        ),
    ],
)
def test_a_sensor_of_which_nothing_watches_the_readings_is_not_used_on_real_drives(
    held: Path, pairs: tuple[tuple[str, str], ...], said: str
) -> None:
    with pytest.raises(RefusedError) as told:
        certificate.demand(read(changed(SERIAL, *pairs)), held)
    assert said in str(told.value)


def test_a_sensor_with_limits_of_its_own_needs_no_noise_on_real_drives(held: Path) -> None:
    text = changed(
        SERIAL,
        ("noise_std_m = 2e-6\nrange_m", WATCHED.format(unit="m", most=1e-3)),
        ("noise_std_n = 10\nrange_n", WATCHED.format(unit="n", most=5e3)),
    )
    rig = read(text)
    for axis in NAMES:
        own = certificate.read(certificate.place(held, axis))
        own = dataclasses.replace(own, rig_hash=certificate.rig_hash(rig.of_axis(axis), axis))
        certificate.write(certificate.place(held, axis), own)
    assert certificate.demand(rig, held)["commissioning"]["demanded"] is True
    # Without them, the noise that commissioning has measured is proposed.
    bare = read(changed(SERIAL, *NO_NOISE))
    for axis in NAMES:
        own = certificate.read(certificate.place(held, axis))
        own = dataclasses.replace(own, rig_hash=certificate.rig_hash(bare.of_axis(axis), axis))
        certificate.write(certificate.place(held, axis), own)
    with pytest.raises(RefusedError) as told:
        certificate.demand(bare, held)
    assert re.search(r"2\.0\d um was measured at rest: state noise_std_m = 2e-06", str(told.value))
    assert re.search(r"(9\.\d\d|10\.\d) N was measured at rest", str(told.value))


def test_the_link_check_of_a_real_drive_proposes_the_noise_that_it_measured() -> None:
    ours = changed(SERIAL, NO_NOISE[0])
    (fault,) = commissioned("left", DEFAULTS, ours, ("link",)).steps["link"].faults
    assert re.search(r"sensor wire: noise_std_m and .* state noise_std_m = 2e-06 or", fault)


@EVERY
@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (
            "noise_std_m = 2e-5",
            r"sensor wire: noise_std_m is 20\.0 um, but its noise at rest is (1\.9\d|2\.0\d) um; "
            "a factor of 3 is allowed: limits on repeated readings and jumps, which follow from it,"
            " would not act",
        ),
        ("noise_std_m = 2e-7", "limits on jumps, which follow from it, would end good tests"),
        ("noise_std_m = 5e-6", ""),
        ("noise_std_m = 8e-7", ""),
    ],
)
def test_a_noise_that_is_not_that_of_the_sensor_at_rest_is_refused(
    axis: str, stated: str, said: str
) -> None:
    ours = changed(DEFAULTS, ("noise_std_m = 2e-6\nrange", f"{stated}\nrange"))
    found = commissioned(axis, DEFAULTS, ours, ("link",)).steps["link"]
    assert found.passed is (not said), found.faults
    assert not said or re.search(said, found.faults[0])


@pytest.mark.parametrize(
    "figures", [{}, {"sensors": None}, {"sensors": {"wire": 1}}, {"sensors": [1]}]
)
def test_a_certificate_without_figures_of_the_sensors_does_not_count(
    held: Path, figures: dict[str, Any]
) -> None:
    for axis in NAMES:
        own = certificate.read(certificate.place(held, axis))
        step = dataclasses.replace(own.steps["polarity"], figures=figures)
        certificate.write(certificate.place(held, axis), own.with_step(step))
    with pytest.raises(RefusedError, match="sensor wire: no axis moved it enough"):
        certificate.demand(real_rig(), held)


@pytest.mark.long
def test_the_commands_commission_and_jog_with_the_sensors_of_all_axes(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connecting, "clock_of", lambda _: "stepped")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path = tmp_path / "floor.toml"
    path.write_text(DEFAULTS, encoding="utf-8")
    done = rthyb("commission", path, "--yes", "--steps", "link,polarity", "--json")
    assert done.code == 0, done.err
    for axis in NAMES:
        steps = done.json["axes"][axis]["steps"]
        assert set(steps["polarity"]["figures"]["sensors"]) == {"wire", "column"}
    assert "Not commissioned" not in done.err
    done = rthyb("jog", path, "0.5 mm", "--axis", "left")
    assert done.code == 0, done.err
    (wire_row,) = [line for line in done.out.splitlines() if line.startswith("wire")]
    assert "by its along" in wire_row
    assert float(wire_row.split()[1]) == pytest.approx(0.25, abs=0.01)


# ---- room for the motions -----------------------------------------------------------------------


def test_a_distance_whose_way_to_the_other_side_is_beyond_the_limit_is_refused_in_words() -> None:
    limit = read(DEFAULTS).of_axis("left").limits.command_position_m
    assert limit is not None
    room_m = limit.value
    with pytest.raises(RefusedError) as caught:
        commissioned("left", distance_m=0.8 * room_m)
    shown = f"{800.0 * room_m:g} mm"
    assert f"moves from {shown} on one side to {shown} on the other" in str(caught.value)
    assert f"choose a distance of at most {500.0 * room_m:g} mm" in str(caught.value)
    with pytest.raises(RefusedError, match=r"more than limits\.command_position_m"):
        commissioned("left", distance_m=1.1 * room_m)
    # Without the comparison of the sensors, there is no motion to the other side.
    assert commissioned("left", steps=("link",), distance_m=0.8 * room_m).steps["link"].passed
