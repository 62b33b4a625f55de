"""A telemetry ring in the memory of a mapped file: its header, its producer, its readers.

`rthyb_rt.record.ring` creates, finds and describes the files.
"""

from __future__ import annotations

import mmap
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import FloatArray, RecordArray, doubles, members, reading

CAPACITY: Final[int] = lib.RTHYB_RING_CAPACITY
AFTER_TRIP: Final[int] = lib.RTHYB_RING_AFTER_TRIP
LAYOUT: Final[int] = lib.RTHYB_RING_LAYOUT
HEADER_BYTES: Final[int] = ffi.sizeof("rthyb_ring_header")

REFUSALS: Final = {
    value: name.lower() for name, value in members("rthyb_ring_refusal", "RTHYB_RING_").items()
}
"""Reasons for which a mapping is not read as a ring."""


def ring_bytes(capacity: int, about_bytes: int, axis_count: int, channel_count: int) -> int:
    """Return the size of a ring's file; ``capacity`` is a power of two."""
    return int(lib.rthyb_ring_bytes(capacity, about_bytes, axis_count, channel_count))


class RingProducer:
    """The producer of a ring that this process has mapped for writing.

    Args:
        memory: the whole file, of `ring_bytes`, its blocks allocated.
        fd: the file.
        about: the description.
        capacity: number of rows, a power of two.
        axis_count, channel_count: axes and channels of each row.

    Attributes:
        locked: whether the memory cannot be paged out.
        in_memory: whether the file is on tmpfs.
    """

    def __init__(
        self,
        memory: mmap.mmap,
        fd: int,
        about: bytes,
        capacity: int,
        axis_count: int,
        channel_count: int,
    ) -> None:
        self._view = ffi.from_buffer(memory, require_writable=True)
        facts = lib.rthyb_ring_settle(fd, self._view, len(memory))
        self.locked = bool(facts & lib.RTHYB_RING_LOCKED)
        self.in_memory = bool(facts & lib.RTHYB_RING_IN_MEMORY)
        start = lib.rthyb_ring_about_at()
        memory[start : start + len(about)] = about
        self._c = ffi.new("rthyb_ring *")
        lib.rthyb_ring_init(self._c, self._view, capacity, len(about), axis_count, channel_count)

    @property
    def pointer(self) -> Any:
        """``rthyb_ring *`` for the tick thread."""
        return self._c

    def push(self, records: RecordArray, channels: FloatArray | None) -> None:
        """Write records, (n,), each with its channels, (n, channels), or with NaN."""
        rows = ffi.cast("rthyb_record *", ffi.from_buffer(records))
        values = ffi.NULL if channels is None else reading(doubles(channels))
        lib.rthyb_ring_push_run(self._c, rows, records.size, values)

    def close(self) -> None:
        """Mark the ring as ended in good order."""
        lib.rthyb_ring_close(self._c)

    def release(self) -> None:
        """Give the memory back, so that its mapping can be closed."""
        ffi.release(self._view)


class RingHeader(NamedTuple):
    """What the header of a ring of any layout states."""

    layout: int
    row_bytes: int
    about_at: int
    about_bytes: int


def header_of(memory: mmap.mmap) -> RingHeader:
    """Return the header at the beginning of a mapping of at least `HEADER_BYTES`."""
    header = ffi.from_buffer("rthyb_ring_header *", memory)
    found = (header.layout, header.record_bytes, header.about_at, header.about_bytes)
    ffi.release(header)
    return RingHeader(*(int(number) for number in found))


class RingConsumer:
    """A reader of a mapped ring, positioned before the oldest row.

    Attributes:
        refusal: why the memory is not a ring that can be read, one of `REFUSALS`; "" if it is.
    """

    def __init__(self, memory: mmap.mmap) -> None:
        self._view = ffi.from_buffer(memory)
        self._c = ffi.new("rthyb_ring_reader *")
        refused = lib.rthyb_ring_attach(self._c, self._view, len(memory))
        self.refusal = REFUSALS[refused] if refused else ""

    def release(self) -> None:
        """Give the memory back, so that its mapping can be closed."""
        ffi.release(self._view)

    @property
    def next(self) -> int:
        """Number of the next row to be read."""
        return int(self._c.next)

    @property
    def lost(self) -> int:
        """Number of rows that were overwritten before they were read, or were incomplete."""
        return int(self._c.lost)

    @property
    def pushed(self) -> int:
        """Number of rows written to the ring so far."""
        return int(lib.rthyb_ring_pushed(self._c))

    @property
    def frozen(self) -> bool:
        """Whether the ring is frozen after a TRIP."""
        return bool(lib.rthyb_ring_phase(self._c) & lib.RTHYB_RING_FROZEN)

    @property
    def closed(self) -> bool:
        """Whether the producer ended in good order."""
        return bool(lib.rthyb_ring_phase(self._c) & lib.RTHYB_RING_CLOSED)

    def read_into(self, rows: NDArray[np.void]) -> int:
        """Read the next rows, at most as many as there is room for; return their number."""
        return int(lib.rthyb_ring_read(self._c, ffi.from_buffer(rows), len(rows)))

    def newest_into(self, row: NDArray[np.void]) -> bool:
        """Read the row of the last tick, even of a frozen ring; return whether there is one."""
        return bool(lib.rthyb_ring_newest(self._c, ffi.from_buffer(row)))
