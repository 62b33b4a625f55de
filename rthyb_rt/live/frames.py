"""The binary frames of the live view: a page's request, and the bytes that it receives.

A frame, little-endian::

    0    4 bytes "RLV1"
    4    u8 kind: 0 more columns, 1 all columns anew, 2 overview of the whole test
    5    u8 state of the newest row, 255 without one
    6    u16 channels
    8    u32 columns, u32 ticks per column, u32 points of the loop, u32 0
    24   f64 first column, position of the row whose values follow, position of time zero,
         oldest and newest position available
    64   f32 values of that row, one per channel
    then f32 smallest and largest value, for each channel, for each column
    then f32 position after the first column, displacement, force, for each point of the loop
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config.axesfile import AXES_MAX
from rthyb_rt.live.shown_rows import CHANNELS, Floats, History, Positions, columns, loop_points

MORE, ANEW, OUTLINE = 0, 1, 2
NO_STATE: Final = 255
HEADER: Final = struct.Struct("<4sBBH4I5d")
_MAGIC: Final = b"RLV1"

COLUMNS: Final = (16, 4096)
SECONDS: Final = (0.25, 120.0)
LOOP_CELLS: Final = 400
LOOP_POINTS: Final = 6000
_LARGEST: Final = 2.0**52
_LONGEST: Final = 2.0**31


@dataclass(frozen=True)
class View:
    """The view shown on a page.

    Attributes:
        columns: number of pixels across a chart.
        ticks: length of the view.
        first: first position; None: the view ends with the newest row, and follows it.
        outline: whether to include an overview of the whole test.
        axis: index of the axis shown, from 0.
    """

    columns: int
    ticks: int
    first: int | None = None
    outline: bool = False
    axis: int = 0

    @property
    def column_ticks(self) -> int:
        """Ticks per column."""
        return max(1, -(-self.ticks // self.columns))


def view_of(asked: Any, fs_hz: float) -> View:
    """Return the view that a page requests.

    Raises:
        ValueError: the request is invalid.
    """
    if not isinstance(asked, dict):
        raise ValueError("a view must be an object")
    wide = round(_number(asked, "columns", *COLUMNS))
    axis = round(_number({"axis": 0, **asked}, "axis", 0, AXES_MAX - 1))
    if asked.get("follow") is True:
        return View(wide, round(_number(asked, "seconds", *SECONDS) * fs_hz), axis=axis)
    first = math.floor(_number(asked, "first", -_LARGEST, _LARGEST))
    last = math.ceil(_number(asked, "last", first + 1.0, first + _LONGEST))
    return View(wide, last - first, first, asked.get("outline") is True, axis)


def _number(asked: dict[str, Any], name: str, least: float, most: float) -> float:
    value: Any = asked.get(name)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not least <= value <= most:
        raise ValueError(f"{name}: found {value!r}; must be from {least:g} to {most:g}")
    return float(value)


class Framer:
    """Creates the frames of one page, each with what the page does not have yet.

    Args:
        history: the available rows.
        fs_hz: ticks per second.
    """

    def __init__(self, history: History, fs_hz: float) -> None:
        self._history, self.fs_hz = history, fs_hz
        self._view: View | None = None
        self._sent: int | None = None

    def show(self, asked: Any) -> None:
        """Change to another view.

        Raises:
            ValueError: the request is invalid.
        """
        self._view = view_of(asked, self.fs_hz)
        self._sent = None

    def next(self, zero: int) -> list[bytes]:
        """Return the frames that update the page; none if it is up to date.

        Args:
            zero: position of time zero.
        """
        view, history = self._view, self._history
        if view is None or not history.size:
            return []
        if view.first is not None:
            if self._sent is not None:
                return []
            self._sent = history.last
            frames = [self._frame(ANEW, view.first, view.first + view.ticks, zero)]
            return [*frames, self._outline(view, zero)] if view.outline else frames
        if self._sent is not None and self._sent == history.last:
            return []
        kind, first = self._next_frame(view)
        self._sent = history.last
        return [self._frame(kind, first, history.last + 1, zero)]

    def _next_frame(self, view: View) -> tuple[int, int]:
        """Return the kind and first position of the next frame."""
        begin = self._history.last + 1 - view.ticks
        if self._sent is None or self._sent < begin:
            return ANEW, begin
        # The last column sent was not complete.
        return MORE, self._sent // view.column_ticks * view.column_ticks

    def _frame(self, kind: int, first: int, end: int, zero: int) -> bytes:
        assert self._view is not None
        wide = self._view.column_ticks
        column = first // wide
        count = max(0, -(-end // wide) - column)
        at, values, states = self._rows(column * wide, end)
        extremes = columns(at, values, column, count, wide)
        thin = self._stride()
        # Every n-th position, not row: the selection remains the same in later frames.
        kept = at % thin == 0
        points = loop_points(at[kept], values[:, kept], LOOP_CELLS, LOOP_POINTS)
        if points.size:
            points[:, 0] += at[kept][0] - column * wide
        if not at.size:
            at, values, states = self._rows(self._history.last, self._history.last + 1)
        return self._bytes(
            kind, wide, column, extremes, zero, points, int(at[-1]), int(states[-1]), values[:, -1]
        )

    def _rows(self, first: int, end: int) -> tuple[Positions, Floats, NDArray[np.uint8]]:
        """Return `History.rows` with the channels of the axis shown."""
        assert self._view is not None
        at, values, states = self._history.rows(first, end)
        # If the axis no longer exists, nothing is shown in its place.
        axis = self._view.axis if self._view.axis < self._history.axes else 0
        return at, values[axis * len(CHANNELS) : (axis + 1) * len(CHANNELS)], states

    def _stride(self) -> int:
        assert self._view is not None
        return max(1, -(-self._view.ticks // LOOP_POINTS))

    def _outline(self, view: View, zero: int) -> bytes:
        """Return the frame with the overview of the whole test."""
        history = self._history
        wide = max(1, -(-(history.last + 1 - history.first) // view.columns))
        column = history.first // wide
        count = history.last // wide + 1 - column
        at, values, states = self._rows(history.first, history.last + 1)
        extremes = columns(at, values, column, count, wide)
        none = np.zeros((0, 3), dtype=np.float32)
        return self._bytes(
            OUTLINE, wide, column, extremes, zero, none, int(at[-1]), int(states[-1]), values[:, -1]
        )

    def _bytes(
        self,
        kind: int,
        wide: int,
        column: int,
        extremes: Floats,
        zero: int,
        points: Floats,
        at: int,
        state: int,
        values: Floats,
    ) -> bytes:
        header = HEADER.pack(
            _MAGIC,
            kind,
            state,
            len(CHANNELS),
            extremes.shape[1],
            wide,
            len(points),
            0,
            column,
            at,
            zero,
            self._history.first,
            self._history.last,
        )
        return b"".join((header, values.tobytes(), extremes.tobytes(), points.tobytes()))
