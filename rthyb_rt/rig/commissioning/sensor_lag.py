"""Does a sensor without an actuator read what the axes read at the same time, or later?

A filter between sensor and frames leaves every reading at rest as it should be, and delays those of
a motion. What such a sensor adds to position or force is then too late, and a delay of position or
force in a hybrid test takes damping from the structure (Horiuchi et al., EESD 28 (1999) 1121).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config import Rate, defaults
from rthyb_rt.rig.commissioning.guided_motion import Floats, MotionResult, Rows

SHARE: Final = defaults.LAG_SHARE
"""Largest lag as a share of the delay from the command of the moving axis to its reading.

At the frequency at which the axis is one radian late, its sensor then is a quarter of a radian
late; at a tenth of it, where tests are made, the damping ratio of a sensor that alone determines
the position is wrong by half of .025, or 1.25 % (omega tau / 2, Horiuchi).
"""
SAMPLES: Final = defaults.LAG_SAMPLES
SETTLED_S: Final = 0.25
"""How long after the end of the command both signals are followed."""


@dataclass(frozen=True)
class Lag:
    """By how much one signal follows another one.

    Attributes:
        seconds: mean delay; negative: it leads.
        certain: the smallest delay that is significant against the noise, s.
    """

    seconds: float
    certain: float


@dataclass(frozen=True)
class SensorLag:
    """By how much a sensor follows what the axes read.

    Attributes:
        found: the lag.
        most: the largest one that is allowed, s.
    """

    found: Lag
    most: float

    @property
    def seen(self) -> bool:
        """Whether a lag that is not allowed would have been seen."""
        return self.found.certain <= self.most

    @property
    def too_large(self) -> bool:
        """Whether it follows, or leads, by more than is allowed."""
        return self.seen and abs(self.found.seconds) > self.most


def of_sensor(
    moved: MotionResult, expected: Callable[[Rows], Floats], reading: str
) -> SensorLag | None:
    """Return by how much a sensor follows what the axes read, or None if nothing was read.

    Args:
        moved: a motion of one axis that has come to rest.
        expected: from rows, what the sensor should read by the readings of all axes, (n,).
        reading: the channel of the sensor.
    """
    own = _between(moved, lambda rows: rows["x_cmd_m"], lambda rows: rows["x_read_m"])
    found = _between(moved, expected, lambda rows: rows[reading])
    if own is None or found is None:
        return None
    hz = Rate(moved.recording.fs_hz).hz
    return SensorLag(found, SHARE * max(own.seconds, 0.0) + SAMPLES / hz)


def _between(
    moved: MotionResult, first: Callable[[Rows], Floats], then: Callable[[Rows], Floats]
) -> Lag | None:
    """Return by how much the second signal follows the first one, in a motion from rest to rest.

    Both are scaled to the same change. Between them, times that change, is the mean delay: for
    y = h * x, the integral of (x - y) dt / change is the first moment of h, whatever its shape.
    """
    rate = Rate(moved.recording.fs_hz)
    before, rows = _before_and_moving(moved, rate)
    after = moved.rests()[1]
    means = [[_mean(signal(rows)) for rows in (before, after)] for signal in (first, then)]
    if not np.isfinite(means).all():
        return None
    (x_0, x_1), (y_0, y_1) = means
    if x_1 == x_0 or y_1 == y_0:
        return None

    def apart(rows: Rows) -> tuple[Floats, NDArray[np.bool_]]:
        """Difference of both as a share of their change, and where both are known."""
        share = (first(rows) - x_0) / (x_1 - x_0) - (then(rows) - y_0) / (y_1 - y_0)
        known = np.isfinite(share)
        return share[known], known

    share, known = apart(rows)
    still, _ = apart(before)
    if share.size < 2 or not still.size:
        return None
    times = np.flatnonzero(known) / rate.hz
    # Six standard deviations of what noise adds: to the integral, and by the mean at rest.
    certain = 6.0 * float(still.std()) * math.sqrt(1.0 / still.size + 1.0 / share.size)
    return Lag(float(np.trapezoid(share, times)), certain * float(times[-1] - times[0]))


def _before_and_moving(moved: MotionResult, rate: Rate) -> tuple[Rows, Rows]:
    """Return the rows of the motion before its command moves, and from there on until its end.

    It has begun to move after a thousandth of its way. The end is `SETTLED_S` after the last change
    of the command.
    """
    rows = moved.running
    command: Floats = rows["x_cmd_m"]
    if rows.size < 2:
        return rows[:0], rows[:0]
    begun = np.abs(command - command[0]) > 1e-3 * np.abs(command[-1] - command[0])
    first, last = int(np.argmax(begun)), int(np.flatnonzero(np.diff(command))[-1:].sum())
    return rows[:first], rows[first : last + 1 + rate.ticks(SETTLED_S)]


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan
