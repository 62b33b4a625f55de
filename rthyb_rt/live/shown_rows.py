"""The rows that the live view can show: channels at increasing positions.

With several axes, the channels of each axis follow one another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core import FLAGS, STATES, axes_in
from rthyb_rt.core.kinematics import Kinematics

Floats = NDArray[np.float32]
Positions = NDArray[np.int64]


@dataclass(frozen=True)
class PlottedChannel:
    """A quantity that is plotted.

    Attributes:
        name: label with unit.
        field: field of a record.
        factor: factor from the record's unit to that of the label.
        less: another field that is subtracted first.
    """

    name: str
    field: str
    factor: float
    less: str | None = None


CHANNELS: Final[tuple[PlottedChannel, ...]] = (
    PlottedChannel("x_num_mm", "x_num_m", 1e3),
    PlottedChannel("x_cmd_mm", "x_cmd_m", 1e3),
    PlottedChannel("x_meas_mm", "x_meas_m", 1e3),
    PlottedChannel("tracking_mm", "x_meas_m", 1e3, less="x_num_m"),
    PlottedChannel("force_kn", "f_meas_n", 1e-3),
    PlottedChannel("alpha", "alpha", 1.0),
    PlottedChannel("k_t_kn_per_mm", "k_t_n_per_m", 1e-6),
    PlottedChannel("energy_error_j", "energy_error_j", 1.0),
)
X_MEAS: Final = 2
FORCE: Final = 4


def channels(samples: NDArray[np.void], tie: Kinematics | None = None) -> Floats:
    """Return the plotted channels of records, shape (axes * channels, n); nan if not finite.

    Args:
        samples: the records, with their channels, (n,).
        tie: for several axes, the kinematics from the interface to the axes; None: the axes'
            commands from the numerical part are unknown.
    """
    axes = axes_in(samples.dtype)
    fields: list[Any] = [samples] if axes == 1 else _of_axes(samples, axes, tie)
    out = np.empty((axes * len(CHANNELS), samples.size), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for k, own in enumerate(fields):
            for row, channel in zip(out[k * len(CHANNELS) :], CHANNELS, strict=False):
                value = own[channel.field]
                if channel.less is not None:
                    value = value - own[channel.less]
                row[:] = value * channel.factor
    out[~np.isfinite(out)] = np.nan
    return out


def _of_axes(
    samples: NDArray[np.void], axes: int, tie: Kinematics | None
) -> list[dict[str, NDArray[np.float64]]]:
    """Return the plotted fields of each axis, under the names used for a single axis."""
    names = samples.dtype.names or ()
    nothing = np.full(samples.size, np.nan)

    def numbered(field: str, k: int, mark: str) -> NDArray[np.float64]:
        name = f"{field}{mark}{k}" if k else field
        return samples[name] if name in names else nothing

    directions = axes if tie is None else tie.directions
    asked = np.column_stack([numbered("x_num_m", j, "_") for j in range(directions)])
    wanted = np.full((samples.size, axes), np.nan)
    known = np.isfinite(asked).all(axis=1)
    if tie is not None and tie.size == axes and known.any():
        wanted[known] = tie.axes(asked[known])[0]
    return [
        {
            "x_num_m": wanted[:, k],
            **{name: numbered(name, k, ".") for name in ("x_cmd_m", "x_meas_m", "f_meas_n")},
            "alpha": numbered("alpha", k, "_"),
            # The tangent stiffness is that of a direction: with axis k, that of direction k.
            "k_t_n_per_m": numbered("k_t_n_per_m", k, "_") if k < directions else nothing,
            "energy_error_j": samples["energy_error_j"],
        }
        for k in range(axes)
    ]


class History:
    """The newest rows, each at its position: a tick, counted continuously across rings.

    Args:
        capacity: least number of rows kept; there is space for twice as many.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._at = np.empty(2 * capacity, dtype=np.int64)
        self._values = np.empty((len(CHANNELS), 2 * capacity), dtype=np.float32)
        self._states = np.empty(2 * capacity, dtype=np.uint8)
        self._size = 0

    def append(self, at: Positions, values: Floats, states: NDArray[np.uint8]) -> None:
        """Append rows.

        Args:
            at: their positions, shape (n,), increasing.
            values: their channels, shape (axes * channels, n); axes that existed before get no
                values.
            states: their states, shape (n,).

        Raises:
            ValueError: the positions do not increase.
        """
        if at.size and (np.any(np.diff(at) <= 0) or (self._size and at[0] <= self.last)):
            raise ValueError("positions must increase")
        lacking = values.shape[0] - self._values.shape[0]
        if lacking > 0:
            further = np.empty((lacking, self._at.size), dtype=np.float32)
            further[:, : self._size] = np.nan
            self._values = np.vstack([self._values, further])
        kept = slice(-self.capacity, None)
        at, values, states = at[kept], values[:, kept], states[kept]
        if self._size + at.size > self._at.size:
            old = slice(self._size - self.capacity, self._size)
            for whole in (self._at, self._values, self._states):
                whole[..., : self.capacity] = whole[..., old].copy()
            self._size = self.capacity
        end = self._size + at.size
        new = slice(self._size, end)
        self._at[new], self._states[new] = at, states
        self._values[: len(values), new], self._values[len(values) :, new] = values, np.nan
        self._size = end

    @property
    def axes(self) -> int:
        """Number of axes."""
        return self._values.shape[0] // len(CHANNELS)

    @property
    def size(self) -> int:
        """Number of rows."""
        return self._size

    @property
    def first(self) -> int:
        """Position of the oldest row, 0 if there is none."""
        return int(self._at[0]) if self._size else 0

    @property
    def last(self) -> int:
        """Position of the newest row, -1 if there is none."""
        return int(self._at[self._size - 1]) if self._size else -1

    def rows(self, first: int, end: int) -> tuple[Positions, Floats, NDArray[np.uint8]]:
        """Return views of the rows from position ``first`` up to, but not including, ``end``."""
        low, high = np.searchsorted(self._at[: self._size], (first, end))
        part = slice(int(low), int(high))
        return self._at[part], self._values[:, part], self._states[part]


def columns(at: Positions, values: Floats, first: int, count: int, ticks: int) -> Floats:
    """Return the smallest and the largest value of each pixel column.

    Column c starts at position c * ticks, so that the same rows are always in the same column and a
    moving curve does not flicker.

    Args:
        at: positions, shape (n,), increasing, within the columns.
        values: shape (channels, n); nan means no value.
        first: the first column.
        count: number of columns.
        ticks: positions per column.

    Returns:
        shape (channels, count, 2); nan where a column has no value.
    """
    out = np.full((values.shape[0], count, 2), np.nan, dtype=np.float32)
    if not at.size:
        return out
    column = at // ticks - first
    starts = np.flatnonzero(np.concatenate([[True], column[1:] != column[:-1]]))
    out[:, column[starts], 0] = np.fmin.reduceat(values, starts, axis=1)
    out[:, column[starts], 1] = np.fmax.reduceat(values, starts, axis=1)
    return out


def loop_points(at: Positions, values: Floats, cells: int, most: int) -> NDArray[np.float32]:
    """Return the force-displacement curve without points in the same pixel as the previous one.

    Args:
        at: positions, shape (n,).
        values: shape (channels, n).
        cells: number of pixels across the curve in either direction.
        most: largest number of points; if exceeded, coarser pixels are used.

    Returns:
        position after the first one, displacement in mm, force in kN; shape (points, 3).
    """
    x, f = values[X_MEAS], values[FORCE]
    good = np.isfinite(x) & np.isfinite(f)
    points = np.column_stack([(at - at[:1])[good], x[good], f[good]]).astype(np.float32)
    while len(points) > 1:
        span = np.maximum(np.ptp(points[:, 1:], axis=0), np.finfo(np.float32).tiny)
        # In double precision: the quotient of a tiny span would overflow.
        pixel = np.floor(points[:, 1:] * (cells / span.astype(np.float64)))
        moved = np.ones(len(points), dtype=np.bool_)
        moved[1:] = np.any(np.diff(pixel, axis=0) != 0.0, axis=1)
        moved[-1] = True
        if np.count_nonzero(moved) <= most or cells < 2:
            return points[moved][:most]
        cells //= 2
    return points


class Tally:
    """Counts of a test's ticks, and a histogram of their wake-up latency."""

    EDGES_US: Final = np.logspace(0.0, 5.0, 61)
    """Bounds of the histogram's bars; the first and last ones include everything beyond."""

    def __init__(self) -> None:
        self.rows = self.skipped = self.longest_ns = 0
        self.flags = dict.fromkeys(("lost", "predicted", "slip", "limited", "not_sent"), 0)
        self.counts = np.zeros(self.EDGES_US.size - 1, dtype=np.int64)

    def add(self, samples: NDArray[np.void]) -> None:
        """Count records."""
        flags = samples["flags"]
        blind = (flags & FLAGS["blind"]) != 0
        self.rows += samples.size
        self.skipped += int(np.count_nonzero(blind))
        # After a trip nothing is sent, and no reply is expected.
        at_work = flags[samples["state"] != STATES.index("TRIPPED")]
        for name in self.flags:
            self.flags[name] += int(np.count_nonzero(at_work & FLAGS[name]))
        # No thread woke for a skipped row.
        late_ns = samples["wake_late_ns"][~blind]
        if late_ns.size:
            bar = np.searchsorted(self.EDGES_US, late_ns * 1e-3, side="right") - 1
            bar = np.clip(bar, 0, self.counts.size - 1)
            self.counts += np.bincount(bar, minlength=self.counts.size)
            self.longest_ns = max(self.longest_ns, int(late_ns.max()))

    def forget_waking(self) -> None:
        """Clear the histogram, for rows in virtual time."""
        self.counts[:], self.longest_ns = 0, 0

    def percentile_us(self, percent: float) -> float:
        """Return the upper edge of the bar that contains a percentile, 0 without any tick."""
        whole = int(self.counts.sum())
        if not whole:
            return 0.0
        bar = int(np.searchsorted(np.cumsum(self.counts), percent / 100.0 * whole))
        return float(self.EDGES_US[bar + 1])
