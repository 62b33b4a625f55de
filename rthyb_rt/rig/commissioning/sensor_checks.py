"""Are the sensors without an actuator connected, of the right sign and of the right scale?

Every axis is commissioned by its own slow motion while the others stand still, and every such
sensor is compared with it, whether or not the axis moves it: with the readings of all axes, from
which its own follows by the kinematics. A sensor is thus checked in each direction of the
interface, and one that is connected in place of another does not pass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config import RigFile, defaults
from rthyb_rt.config.lonesensors import OneOfSeveral, SensorOfAxes
from rthyb_rt.lab import beside
from rthyb_rt.numbers import quantity
from rthyb_rt.rig.commissioning import sensor_lag, sensor_noise
from rthyb_rt.rig.commissioning.guided_motion import Floats, MotionResult, Rows
from rthyb_rt.rig.commissioning.polarity import SLOPE_TOLERANCE
from rthyb_rt.rig.commissioning.sensor_lag import SensorLag

FORCE_FACTOR: Final = defaults.FORCE_FACTOR
ASKEW: Final = defaults.ASKEW
LEAST_SEEN: Final = 0.98
"""Least share of the frames in which the channel has a number, as for pairs on the link."""


def at_rest(rig: RigFile, moved: MotionResult) -> tuple[dict[str, Any], list[str]]:
    """Judge the readings while nothing moves.

    Returns:
        Reading and noise of each sensor by its name, m or N, and what is wrong, with the remedy;
        also of the other drives, whose readings are compared with those of the sensors.
    """
    common, rows = rig.one_of, moved.running
    if common is None:
        return {}, []
    figures, faults = {}, _silent_drives(common, rows)
    for one in common.sensors:
        name, frames = one.sensor.name, rows[_arrived(common, one.axis, rows)]
        read = _numbers(frames, f"{name}_read")
        # Frames that do not arrive are the fault of their link, which is told by its own name.
        share = read.size / frames.size if frames.size else 1.0
        reading = float(read.mean()) if read.size else None
        noise = float(read.std()) if read.size else None
        figures[name] = {
            "reading": reading,
            "noise": noise,
            "unit": "N" if one.is_cell else "m",
            "seen_share": share,
        }
        if share < LEAST_SEEN:
            faults.append(
                f"sensor {name}: the channel {one.channel.name} of axis {one.axis} had a number in "
                f"{100 * share:.1f} % of its frames; at least {100 * LEAST_SEEN:g} % must have "
                "one: is the sensor connected, its amplifier on, and its reading within the range "
                "of the signal?"
            )
        elif reading is not None and 0.0 < one.tare_most < abs(reading):
            faults.append(
                f"sensor {name}: reads {_shown(one, reading)} at rest, but zeroing accepts at most "
                f"{_shown(one, one.tare_most)} (limits.tare_share_most): relieve the specimen, or "
                f"correct the zero of the sensor, its own or the offset in {_scale(one)}"
            )
        elif noise is not None:
            faults += _of_noise(rig, one, noise)
    return figures, faults


def _of_noise(rig: RigFile, one: SensorOfAxes, noise: float) -> list[str]:
    """Return what is wrong with the noise that is stated, from which the limits follow."""
    step, link = beside.step_of(rig, one), rig.link
    found = sensor_noise.implausible(one.sensor, step, noise)
    if not found and link is not None and not link.virtual:
        found = sensor_noise.unwatched(one.sensor, step, noise)
    return [f"sensor {one.sensor.name}: {found}"] if found else []


def _arrived(common: OneOfSeveral, axis: str, rows: Rows) -> NDArray[np.bool_]:
    """Return the rows in which a pair of an axis arrived, (n,)."""
    own = axis == common.name
    column: Floats = rows["x_read_m" if own else beside.heard_names(common, axis)[0]]
    return np.isfinite(column)


def _silent_drives(common: OneOfSeveral, rows: Rows) -> list[str]:
    faults = []
    for axis in common.others:
        share = float(_arrived(common, axis, rows).mean()) if rows.size else 0.0
        if share < LEAST_SEEN:
            faults.append(
                f"axis {axis}: its drive, which receives no commands, sent displacement and force "
                f"in {100 * share:.1f} % of the ticks; at least {100 * LEAST_SEEN:g} % must have "
                "both, because the sensors without an actuator are compared with them: is the "
                "drive switched on and connected?"
            )
    return faults


def both_ways(there: dict[str, Any], back: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of two motions in opposite directions as those of one.

    A sensor was judged only if both would have shown its mistakes.
    """
    return {
        name: {
            **one,
            "conclusive": one["conclusive"] and back[name]["conclusive"],
            "change_back": back[name]["change"],
            "expected_back": back[name]["expected"],
            "lag_s": back[name]["lag_s"],
            "lag_most_s": back[name]["lag_most_s"],
        }
        for name, one in there.items()
    }


def by_motion(
    rig: RigFile, moved: MotionResult, *, must_show: bool = True, timely: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Judge the change of the readings after a slow motion that has come to rest.

    Args:
        rig: the axis that moved.
        moved: its motion.
        must_show: whether it is a fault that the motion is too small to judge a sensor.
        timely: whether it was fast enough to see which sensors read too late, and these are judged.

    Returns:
        Change of each sensor and the one expected, by its name, m or N, and what is wrong, with the
        remedy.
    """
    common = rig.one_of
    if common is None:
        return {}, []
    seen = [_compared(rig, one, moved, timely=timely) for one in common.sensors]
    figures = {one.of.sensor.name: one.as_json() for one in seen}
    faults = [(one, _fault(one, moved)) for one in seen if must_show or not one.hidden]
    wrong = [one for one, fault in faults if fault]
    return figures, [
        f"sensor {one.of.sensor.name}: {fault}{_other_cells(one, common.name)}"
        f"{_instead(one, wrong)}"
        for one, fault in faults
        if fault
    ]


# ---- what a sensor should read ------------------------------------------------------------------


@dataclass(frozen=True)
class _Compared:
    """The change of a reading from rest to rest, and what it should be, m or N.

    Attributes:
        of: the sensor.
        change: as read; None: no number.
        by_axis: change of what the sensors of each axis read, by its name.
        expected: by these.
        less, more: by how much the change may be less or more than expected, in its direction.
        certain: the smallest difference of the two that is significant against the noise.
        moves: whether the axis moves the sensor by more than a mounting by eye leaves undetermined.
        timely: whether it must be seen that the sensor does not read too late.
        lag: by how much it does; None: not known.
    """

    of: SensorOfAxes
    change: float | None
    by_axis: dict[str, float]
    expected: float
    less: float
    more: float
    certain: float
    moves: bool
    timely: bool
    lag: SensorLag | None

    def as_json(self) -> dict[str, Any]:
        """Return what a certificate has of it, as plain values."""
        lag = self.lag
        late = {
            "lag_s": None if lag is None else lag.found.seconds,
            "lag_most_s": None if lag is None else lag.most,
        }
        return {
            "change": self.change,
            "expected": self.expected,
            "unit": "N" if self.of.is_cell else "m",
            "conclusive": self.conclusive,
            **(late if self.timely else {}),
        }

    def fits(self, change: float | None) -> bool:
        """Return whether a change is one that this sensor may have."""
        if change is None:
            return False
        off = (change - self.expected) * (1.0 if self.expected >= 0.0 else -1.0)
        rounding = 0.0 if self.moves else self.certain
        return -max(self.less, rounding) <= off <= max(self.more, rounding)

    @property
    def hidden(self) -> bool:
        """Whether noise hides what must be seen."""
        return self.moves and self.certain > min(self.less, self.more)

    @property
    def conclusive(self) -> bool:
        """Whether the least mistakes of a sign or a scale, and a lag, would have been seen."""
        mistakes = (-1.0, 0.5, 2.0)
        if self.timely and (self.lag is None or not self.lag.seen):
            return False
        return self.moves and not any(self.fits(by * self.expected) for by in mistakes)


def _compared(rig: RigFile, one: SensorOfAxes, moved: MotionResult, *, timely: bool) -> _Compared:
    """Compare a sensor with all axes: r = a u, or r = a F, as in the kinematics.

    It may be off by a share of what is expected, or, if that is little, by a small share of the
    terms of that sum: where they cancel, each of them may still be inexact.
    """
    common = rig.one_of
    assert common is not None
    axes = [_change(moved, _column(common, name, one)) for name in common.names]
    by_axis = np.array([change or 0.0 for change, _ in axes])
    change, noise = _change(moved, f"{one.sensor.name}_read")
    expected = float(np.array(one.by_axis) @ by_axis)
    sizes = np.abs(by_axis)
    askew = ASKEW * max(float(np.array(one.terms) @ sizes), max(one.terms) * float(sizes.max()))
    low, high = (1.0 / FORCE_FACTOR, FORCE_FACTOR) if one.is_cell else _SLOPES
    moves = abs(expected) > askew

    def of_axes(rows: Rows) -> Floats:
        read: Floats = np.array(one.by_axis) @ [rows[_column(common, k, one)] for k in common.names]
        return read

    return _Compared(
        one,
        change,
        dict(zip(common.names, by_axis.tolist(), strict=True)),
        expected,
        max((1.0 - low) * abs(expected), askew),
        max((high - 1.0) * abs(expected), askew),
        noise
        + 2.0 * beside.step_of(rig, one)
        + float(np.abs(one.by_axis) @ np.array([noise for _, noise in axes])),
        moves,
        timely,
        sensor_lag.of_sensor(moved, of_axes, f"{one.sensor.name}_read")
        if timely and moves
        else None,
    )


_SLOPES: Final = (1.0 - SLOPE_TOLERANCE, 1.0 + SLOPE_TOLERANCE)


def _column(common: OneOfSeveral, axis: str, one: SensorOfAxes) -> str:
    """Return the channel with what the sensors of an axis read of the kind of a sensor."""
    if axis == common.name:
        # As received: at rest, the tare falls within the rows that are averaged.
        return "f_read_n" if one.is_cell else "x_read_m"
    return beside.heard_names(common, axis)[one.is_cell]


def _numbers(rows: Rows, channel: str) -> Floats:
    values: Floats = rows[channel]
    return values[np.isfinite(values)]


def _change(moved: MotionResult, channel: str) -> tuple[float | None, float]:
    """Return the change from rest to rest, and the smallest one that is significant.

    The latter is as for displacement and force of the axis: six standard deviations of the
    difference of two means.
    """
    before, after = (_numbers(rows, channel) for rows in moved.rests())
    if not (before.size and after.size):
        return None, math.inf
    certain = 6.0 * float(before.std()) * math.sqrt(2.0 / before.size)
    return float(after.mean() - before.mean()), certain


# ---- in words -----------------------------------------------------------------------------------


def _fault(one: _Compared, moved: MotionResult) -> str:
    """Return what is wrong with a sensor, with what was expected and the remedy; "" if nothing."""
    after = f"when the axis moved by {quantity(moved.moved_m, 'mm', 1e3)}"
    if one.change is None:
        return f"gave no number before or after the motion: check {_channel(one.of)}"
    expected = _shown(one.of, _unless_tiny(one.expected, one.change))
    wanted = f"{expected} was expected from {_axes(one)}"
    if one.hidden:
        return (
            f"should change by {expected} {after}, which its noise hides "
            f"({_shown(one.of, one.certain)} can be seen, and "
            f"{_shown(one.of, min(one.less, one.more))} must be): choose a larger --distance"
        )
    if one.fits(one.change):
        return _late(one)
    found = _shown(one.of, _unless_tiny(one.change, one.expected))
    if not one.moves:
        return (
            f"changed by {found} {after}, where {wanted} by its along: correct its along, or check "
            f"how it is mounted, and which sensor is connected to {_channel(one.of)}"
        )
    if abs(one.change) <= max(one.certain, ASKEW * abs(one.expected)):
        return (
            f"did not respond {after}: {found} where {wanted}; is it mounted, and connected to the "
            f"drive of axis {one.of.axis} as its {_channel(one.of)}?"
        )
    if one.change * one.expected < 0.0:
        return (
            f"moved against what its along says: {found} {after}, where {wanted}; reverse "
            f"{_scale(one.of)}, or correct the sign of along"
        )
    low, high = (1.0 + way / abs(one.expected) for way in (-one.less, one.more))
    share = ", the share of the force that passes through it" if one.of.is_cell else ""
    return (
        f"changed by {found} {after}, where {wanted}, a ratio of "
        f"{one.change / one.expected:.3g}; from {low:.3g} to {high:.3g} is allowed: check "
        f"{_scale(one.of)}, along{share}, and which sensor is connected"
    )


def _late(one: _Compared) -> str:
    """Return that a sensor reads too late or too early, in words; "" if it does not."""
    if one.lag is None or not one.lag.too_large:
        return ""
    lag_s = one.lag.found.seconds
    late = "late" if lag_s > 0.0 else "early"
    return (
        f"reads {quantity(abs(lag_s), 'ms', 1e3)} {late} while the axis moves, compared with "
        f"the {_what(one)} of the axes; at most {quantity(one.lag.most, 'ms', 1e3)} is allowed, "
        f"{100 * sensor_lag.SHARE:g} % of the delay of the axis and {sensor_lag.SAMPLES:g} "
        "samples: look for a filter in the amplifiers of the sensor and of the axes, for a slow "
        "converter, or for play or friction, which shows less with a smaller --distance"
    )


def _what(one: _Compared) -> str:
    return "load cells" if one.of.is_cell else "displacement sensors"


def _axes(one: _Compared) -> str:
    """Return the readings of the axes from which something was expected, in words."""
    most = max(map(abs, one.by_axis.values()))
    read = ", ".join(
        f"{axis} {_shown(one.of, _unless_tiny(value, most))}" for axis, value in one.by_axis.items()
    )
    return f"the {_what(one)} of the axes ({read})"


def _unless_tiny(value: float, beside: float) -> float:
    """Return a value for a message, or 0 if it is mere noise beside another one."""
    return value if abs(value) > 1e-3 * abs(beside) else 0.0


def _other_cells(one: _Compared, moved_axis: str) -> str:
    """Return that a load cell of another axis may be the cause, in words; "" if it cannot be."""
    most = max(map(abs, one.by_axis.values()))
    others = [
        axis
        for axis, value in one.by_axis.items()
        if axis != moved_axis and one.of.is_cell and abs(value) > ASKEW * most
    ]
    if not others:
        return ""
    return (
        f"; if axis {' or '.join(others)} has not passed its own check yet, its load cell may be "
        "the cause"
    )


def _instead(one: _Compared, wrong: Sequence[_Compared]) -> str:
    """Return the other wrong sensor whose reading this one has, in words; "" if there is none."""
    for other in wrong:
        same_kind = other is not one and other.of.is_cell == one.of.is_cell
        if same_kind and other.fits(one.change) and one.fits(other.change):
            return (
                f"; each of the sensors {one.of.sensor.name} and {other.of.sensor.name} reads what "
                "is expected of the other: their cables, or their extra keys, are interchanged"
            )
    return ""


def _channel(one: SensorOfAxes) -> str:
    return f"channel {one.channel.name}"


def _scale(one: SensorOfAxes) -> str:
    return f"scale = {one.channel.scale:g} of its channel {one.channel.name} (axis {one.axis})"


def _shown(one: SensorOfAxes, value: float) -> str:
    return quantity(value, "N") if one.is_cell else quantity(value, "mm", 1e3)
