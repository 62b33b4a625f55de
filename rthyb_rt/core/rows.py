"""A row of a recording: the record of the core, followed by named channels."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import CoreError, FloatArray, RecordArray, members, words

_PLACES: Final = ("command_bit", "unsent_bit", "stopped_bit")
FLAGS: Final = {
    name: bit for name, bit in words("rthyb_flag", "RTHYB_F_").items() if name not in _PLACES
}
"""Bits of the field ``flags``, written into every file; bits 24 to 31 are the number of the
operator's command of that tick, 0 for none."""
FLAG_NAMES: Final = tuple(FLAGS)
COMMAND_BIT: Final[int] = lib.RTHYB_F_COMMAND_BIT
UNSENT_BIT: Final[int] = lib.RTHYB_F_UNSENT_BIT
"""Several axes: this bit and those above it mark the axes whose command was not sent."""
STOPPED_BIT: Final[int] = lib.RTHYB_F_STOPPED_BIT
"""Several axes: this bit and those above it mark the axes whose drive stopped on its own."""


class PlacedCause(NamedTuple):
    """A row's ``cause``: its number, and the axis, interface or sensor without an actuator that it
    belongs to, each counted from 0, or None.
    """

    cause: int
    axis: int | None
    interface: int | None
    sensor: int | None


def placed_cause(cause: int) -> PlacedCause:
    """Return what a row's ``cause`` says."""
    number, sensor = cause >> lib.RTHYB_PLACE_BIT & 7, cause >> lib.RTHYB_PLACE_SENSOR_BIT & 15
    place = number - 1 if number else None
    interface = bool(cause & lib.RTHYB_PLACE_INTERFACE)
    return PlacedCause(
        cause & 255,
        None if interface else place,
        place if interface else None,
        sensor - 1 if sensor else None,
    )


STATES: Final = tuple(members("rthyb_state", "RTHYB_"))
"""Names of the values of the field ``state``, written into every file."""
RUNNING: Final = STATES.index("RUNNING")

_NUMPY_NAME: Final[dict[str, str]] = {
    "uint16_t": "<u2",
    "uint32_t": "<u4",
    "int32_t": "<i4",
    "uint64_t": "<u8",
    "int64_t": "<i8",
    "double": "<f8",
}


def _flat(ctype: Any, offset: int = 0, suffix: str = "") -> list[tuple[str, str, int]]:
    """Return name, type and offset of every number in a struct; axis 1 has "x_cmd_m.1" etc."""
    found = []
    for name, f in ctype.fields:
        at = offset + f.offset
        if f.type.kind == "array":
            size = ffi.sizeof(f.type.item)
            for k in range(f.type.length):
                found += _flat(f.type.item, at + k * size, f".{k}" if k else "")
        else:
            found.append((name + suffix, _NUMPY_NAME[f.type.cname], at))
    return found


def dtype_of(struct: str, size: int | None = None) -> np.dtype[np.void]:
    """Return the dtype of a struct of the core, or of its first ``size`` bytes."""
    size = ffi.sizeof(struct) if size is None else size
    numbers = [one for one in _flat(ffi.typeof(struct)) if one[2] < size]
    return np.dtype(
        {
            "names": [name for name, _, _ in numbers],
            "formats": [kind for _, kind, _ in numbers],
            "offsets": [at for _, _, at in numbers],
            "itemsize": size,
        }
    )


@cache
def record_dtype(axis_count: int = 1) -> np.dtype[np.void]:
    """Return the dtype of a record with this number of axes; axis 1 has "x_cmd_m.1" etc."""
    return dtype_of("rthyb_record", int(lib.rthyb_record_bytes(axis_count)))


RECORD_DTYPE: Final = record_dtype(1)
CHANNELS_MAX: Final[int] = lib.RTHYB_CHANNELS_MAX
"""Largest number of named values in a row in addition to its record."""

CHANNEL_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,31}")
"""Form of the name of a channel."""


@dataclass(frozen=True)
class Channel:
    """A named value that rows contain in addition to the fields of the record.

    Attributes:
        name: name of its field in the samples.
        unit: unit of the value.
        scale: factor from the stored number to this unit.
    """

    name: str
    unit: str
    scale: float = 1.0


def check_channels(channels: Sequence[Channel]) -> None:
    """Check that a row can contain these channels.

    Raises:
        ValueError: naming the first error found.
    """
    if len(channels) > CHANNELS_MAX:
        raise ValueError(f"found {len(channels)} channels; a row has room for {CHANNELS_MAX}")
    taken = set(RECORD_DTYPE.names or ())
    for channel in channels:
        if not CHANNEL_NAME.fullmatch(channel.name):
            raise ValueError(
                f"channel {channel.name!r}: a name has up to 32 of a-z 0-9 _ and starts with a "
                "letter"
            )
        if channel.name in taken:
            raise ValueError(f"channel {channel.name!r}: a field of this name already exists")
        if not (math.isfinite(channel.scale) and channel.scale):
            raise ValueError(
                f"channel {channel.name!r}: found the scale {channel.scale}, which is not a "
                "valid factor"
            )
        taken.add(channel.name)


def row_dtype(channels: Sequence[Channel], axis_count: int = 1) -> np.dtype[np.void]:
    """Return the dtype of a row of a recording or a ring: a record and its channels.

    Raises:
        CoreError: there are too many channels, or two have the same name.
    """
    try:
        check_channels(channels)
    except ValueError as error:
        raise CoreError(str(error)) from error
    record = record_dtype(axis_count)
    if not channels:
        return record
    fields: Mapping[str, Any] = record.fields or {}
    size, count = record.itemsize, len(channels)
    return np.dtype(
        {
            "names": [*fields, *(channel.name for channel in channels)],
            "formats": [*(f[0] for f in fields.values()), *["<f8"] * count],
            "offsets": [*(f[1] for f in fields.values()), *(size + 8 * k for k in range(count))],
            "itemsize": size + 8 * count,
        }
    )


def rows_of(records: RecordArray, channels: Sequence[Channel], values: FloatArray) -> RecordArray:
    """Return rows, (n,), from records, (n,), and the values of their channels, (n, count)."""
    rows = np.zeros(records.shape, dtype=row_dtype(channels, axes_in(records.dtype)))
    for name in records.dtype.names or ():
        rows[name] = records[name]
    for k, channel in enumerate(channels):
        rows[channel.name] = values[:, k]
    return rows


def as_records(rows: RecordArray) -> RecordArray:
    """Return the core's records from rows whose fields may be more, or in another order."""
    dtype = record_dtype(axes_in(rows.dtype))
    if rows.dtype == dtype:
        return np.ascontiguousarray(rows)
    records = np.zeros(rows.shape, dtype=dtype)
    for name in dtype.names or ():
        records[name] = rows[name]
    return records


def axes_in(dtype: np.dtype[Any]) -> int:
    """Return the number of axes in rows of this dtype."""
    return sum(name.partition(".")[0] == "x_cmd_m" for name in dtype.names or ()) or 1


def copy_records(records: Any, count: int, axis_count: int) -> RecordArray:
    """Return a copy of the first records of a C array as rows with this number of axes."""
    dtype = record_dtype(axis_count)
    size = ffi.sizeof("rthyb_record")
    raw = np.frombuffer(bytes(ffi.buffer(records, count * size)), np.uint8).reshape(count, size)
    return np.ascontiguousarray(raw[:, : dtype.itemsize]).view(dtype).reshape(count)


def records_pointer(array: RecordArray, axis_count: int = 1) -> Any:
    if array.dtype != record_dtype(axis_count) or not array.flags.c_contiguous:
        raise CoreError(f"records must be a contiguous array of record_dtype({axis_count})")
    return ffi.cast("rthyb_record *", ffi.from_buffer(array))


class RingMemory(Protocol):
    """The part of a telemetry ring that a thread of the core needs: its memory."""

    @property
    def pointer(self) -> Any:
        """``rthyb_ring *``."""
