"""Are the sensors without an actuator connected, of the right sign and of the right scale?

They are read with the frames of an axis, and checked with that axis: at rest, and by its slow
motion while the others hold still.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from rthyb_rt.config import RigFile
from rthyb_rt.config.lonesensors import LoneForce, ReadWithAxis
from rthyb_rt.config.rigfile import ExtraSensor
from rthyb_rt.lab import extra_frames
from rthyb_rt.numbers import quantity
from rthyb_rt.rig.commissioning.guided_motion import (
    Connection,
    Floats,
    MotionResult,
    Rows,
    fresh,
)
from rthyb_rt.rig.commissioning.polarity import SLOPE_TOLERANCE

FORCE_FACTOR: Final = math.sqrt(2.0)
"""Allowed ratio of the change of a load cell to the one expected, either way.

The share of a force depends on the specimen's stiffness as drawn, which may be off by some tens of
percent. The least mistake of a scale is a factor of 2, of a bridge or an amplifier: the limit is as
far from the one as from the other.
"""
LEAST_SEEN: Final = 0.98
"""Least share of the frames in which the channel has a number, as for pairs on the link."""


def at_rest(rig: RigFile, moved: MotionResult) -> tuple[dict[str, Any], list[str]]:
    """Judge the readings while nothing moves.

    Returns:
        Reading and noise of each sensor by its name, m or N, and what is wrong, with the remedy.
    """
    figures, faults = {}, []
    rows = moved.running[fresh(moved.running)]
    for one in rig.read_along:
        name, read = one.sensor.name, _readings(rows, one)
        share = read.size / max(rows.size, 1)
        reading = float(read.mean()) if read.size else None
        figures[name] = {
            "reading": reading,
            "noise": float(read.std()) if read.size else None,
            "unit": "N" if isinstance(one.sensor, LoneForce) else "m",
            "seen_share": share,
        }
        if share < LEAST_SEEN or reading is None:
            faults.append(
                f"sensor {name}: the channel {one.sensor.extra} had a number in "
                f"{100 * share:.1f} % of the frames; at least {100 * LEAST_SEEN:g} % must have "
                "one: is the sensor connected, its amplifier on, and its reading within the range "
                "of the signal?"
            )
        elif float(np.abs(read).max()) >= (reach := _range(one)):
            faults.append(
                f"sensor {name}: reads {_shown(one, reading)} at rest, at the end of its range "
                f"({_shown(one, reach)}): check its wiring, its zero, and {_scale(rig, one)}"
            )
        elif 0.0 < one.tare_most < abs(reading):
            faults.append(
                f"sensor {name}: reads {_shown(one, reading)} at rest, but zeroing accepts at most "
                f"{_shown(one, one.tare_most)} (limits.tare_share_most): relieve the specimen, or "
                f"correct the zero of the sensor, its own or the offset in {_scale(rig, one)}"
            )
    return figures, faults


def by_motion(connection: Connection, moved: MotionResult) -> tuple[dict[str, Any], list[str]]:
    """Judge the change of the readings after a slow motion that has come to rest.

    Returns:
        Change of each sensor and the one expected, by its name, m or N, and what is wrong, with the
        remedy.
    """
    figures, faults = {}, []
    rig = connection.rig
    codec = extra_frames.codec_of(rig, connection.opened.codec)
    for one in rig.read_along:
        of_force = isinstance(one.sensor, LoneForce)
        expected = one.per_n * moved.change_n if of_force else one.per_m * moved.moved_m
        step = codec.extra_step(rig.sensors.extra.index(_channel(rig, one)))
        change, certain = _change(one, moved, step)
        figures[one.sensor.name] = {"change": change, "expected": expected}
        fault = _fault(rig, one, moved, change, expected, certain)
        if fault:
            faults.append(f"sensor {one.sensor.name}: {fault}")
    return figures, faults


def _fault(
    rig: RigFile,
    one: ReadWithAxis,
    moved: MotionResult,
    change: float | None,
    expected: float,
    certain: float,
) -> str:
    after = f"when the axis moved by {quantity(moved.moved_m, 'mm', 1e3)}"
    if change is None:
        return f"gave no number before or after the motion: check the channel {one.sensor.extra}"
    if abs(expected) <= certain:
        return (
            f"should change by {_shown(one, expected)} {after}, which its noise hides "
            f"({_shown(one, certain)} can be seen): choose a larger --distance"
        )
    if abs(change) <= certain:
        return (
            f"did not respond {after}: {_shown(one, change)} where {_shown(one, expected)} was "
            "expected; is it connected to the drive of this axis, and mounted?"
        )
    if change * expected < 0.0:
        return (
            f"moved against what its along says: {_shown(one, change)} {after}, where "
            f"{_shown(one, expected)} was expected; reverse {_scale(rig, one)}, or correct the "
            "sign of along"
        )
    ratio = change / expected
    low, high = (
        (1.0 / FORCE_FACTOR, FORCE_FACTOR)
        if isinstance(one.sensor, LoneForce)
        else (1.0 - SLOPE_TOLERANCE, 1.0 + SLOPE_TOLERANCE)
    )
    if low <= ratio <= high:
        return ""
    stiffness = ""
    if isinstance(one.sensor, LoneForce):
        stiffness = ", the stiffness of the specimen, by which the axis loads it"
    return (
        f"changed by {_shown(one, change)} {after}, where {_shown(one, expected)} was expected, a "
        f"ratio of {ratio:.3g}; from {low:.3g} to {high:.3g} is allowed: check "
        f"{_scale(rig, one)}, along{stiffness}, and which sensor is connected"
    )


def _readings(rows: Rows, one: ReadWithAxis) -> Floats:
    """Return the numbers that the channel had, as read: a channel has no tare."""
    values: Floats = rows[str(one.sensor.extra)]
    return values[np.isfinite(values)]


def _change(one: ReadWithAxis, moved: MotionResult, step: float) -> tuple[float | None, float]:
    """Return the change from rest to rest, and the smallest one that is significant.

    The latter is as for displacement and force of the axis: six standard deviations of the
    difference of two means, and two steps of the wire.
    """
    before, after = (_readings(rows, one) for rows in moved.rests())
    if not (before.size and after.size):
        return None, math.inf
    certain = 6.0 * float(before.std()) * math.sqrt(2.0 / before.size) + 2.0 * step
    return float(after.mean() - before.mean()), certain


def _channel(rig: RigFile, one: ReadWithAxis) -> ExtraSensor:
    return next(each for each in rig.sensors.extra if each.name == one.sensor.extra)


def _range(one: ReadWithAxis) -> float:
    sensor = one.sensor
    found = sensor.range_n if isinstance(sensor, LoneForce) else sensor.range_m
    assert found is not None
    return found


def _scale(rig: RigFile, one: ReadWithAxis) -> str:
    channel = _channel(rig, one)
    return f"scale = {channel.scale:g} of its channel {channel.name}"


def _shown(one: ReadWithAxis, value: float) -> str:
    of_force = isinstance(one.sensor, LoneForce)
    return quantity(value, "N") if of_force else quantity(value, "mm", 1e3)
