"""A real-time recording in the time of the drive, by its sample count and the commands it followed.

A row of a recording holds the pair that had arrived in its tick. Where this PC missed ticks, a pair
was lost, or two clocks run freely, successive pairs are not one period apart in the time of the
specimen, and a command is followed by one sample more or less than before. Derivatives of such a
motion are wrong, and a model of the actuator has another delay from there on. The drive sends the
number of its sample and that of the command it followed with each pair: both place the readings and
the commands where they were.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core import FLAGS
from rthyb_rt.diagnose.case import Floats

Rows = NDArray[np.intp]


def made_up(samples: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return the rows of a recording of this program without a pair of their own, (n,)."""
    return np.asarray((samples["flags"] & (FLAGS["predicted"] | FLAGS["blind"])) != 0)


MOST = 0.05
"""Fraction of the pairs from which a count that differs from that of the ticks does not number the
drive's samples: a clock of a PC is accurate to 1e-4, and a test ends if one tick in 20 is missed.
"""
STRAY = 0.01
"""Fraction of the pairs below which a delay of the commands is taken for a fault of the frames."""


@dataclass(frozen=True)
class DriveClock:
    """Rows of a recording as the drive experienced them.

    Attributes:
        measured: for each sample of the drive, the row with its pair; -1: none arrived, (m,).
        commanded: the row of the command that it followed, (m,).
        shifts: how often its count shifted against the ticks.
    """

    measured: Rows
    commanded: Rows
    shifts: int

    def of_pairs(self, values: Floats) -> Floats:
        """Return what arrived with the pairs, (n,), for the drive's samples, (m,); else NaN."""
        return np.where(self.measured < 0, np.nan, values[np.maximum(self.measured, 0)])

    def of_commands(self, values: Floats) -> Floats:
        """Return what was sent or computed with the commands, (n,), for its samples, (m,)."""
        return values[self.commanded]


def drive_clock(
    tick: NDArray[np.int64],
    count: NDArray[np.int64],
    echo: NDArray[np.int64],
    arrived: NDArray[np.bool_],
    sent: NDArray[np.bool_],
) -> DriveClock | None:
    """Return the time of the drive; None if it is that of the ticks, or not known.

    Args:
        tick: number of the tick, (n,).
        count: low bits of the drive's sample count, (n,).
        echo: low bits of the number of the command that it followed, (n,).
        arrived: whether the row has a pair of its own, (n,).
        sent: whether its command was sent, (n,); only those are numbered.
    """
    live = np.flatnonzero(arrived)
    if live.size < 2 or not np.any(count[live]):
        return None
    ticks = np.diff(tick[live])
    samples = _steps(count[live], ticks)
    if samples is None or np.array_equal(samples, ticks):
        return None
    kept = np.r_[True, samples > 0]  # the same sample twice is one reading
    place = live[0] + np.r_[0, np.cumsum(samples)]
    ahead = np.r_[live[0], tick.size - 1 - live[-1]]
    measured = np.full(place[-1] + 1 + ahead[1], -1, dtype=np.intp)
    measured[place[kept]] = live[kept]
    followed = _followed(echo, live, sent)
    at = np.arange(measured.size)
    own = np.interp(at, place[kept], followed[kept])
    own = np.where(at < place[0], followed[0] + at - place[0], own)
    own = np.where(at > place[-1], followed[-1] + at - place[-1], own)
    commanded = np.clip(np.floor(own), 0, tick.size - 1).astype(np.intp)
    return DriveClock(measured, commanded, int(np.count_nonzero(samples != ticks)))


def _steps(low: NDArray[np.int64], ticks: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return the increments of a count of which the low bits are known, (n - 1,).

    They are the ones nearest to those of the ticks. None if it does not count the same.
    """
    period = 1 << int(low.max()).bit_length()
    steps = ticks + (np.diff(low) - ticks + period // 2) % period - period // 2
    return None if np.mean(steps != ticks) > MOST else steps


def _followed(echo: NDArray[np.int64], live: Rows, sent: NDArray[np.bool_]) -> Floats:
    """Return the row of the command that each live row followed, where it is latest the row itself.

    So it is in a recording without shifts, whose commands remain where they are. Afterwards, the
    drive may follow older commands that wait in a queue, never one that has not been sent.
    """
    number = np.cumsum(sent)
    own = np.diff(number[live])
    steps = _steps(echo[live], own) if np.any(echo[live]) else None
    if steps is None:
        return live.astype(np.float64)
    late = number[live] - (number[live[0]] + np.r_[0, np.cumsum(steps)])
    values, often = np.unique(late, return_counts=True)
    least = values[often > STRAY * late.size].min()
    wanted = number[live] - np.maximum(late - least, 0)
    # Of rows whose commands were not sent, the drive kept the command before.
    rows = np.clip(np.searchsorted(number, wanted), 0, number.size - 1)
    return np.asarray(rows, dtype=np.float64)
