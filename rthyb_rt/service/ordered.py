"""An HDF5 file that remains readable after each of its writes.

HDF5 performs the writes of a flush in an arbitrary order: if a process is killed in between, a
length may exceed what the index covers, or the index may point beyond the end of the file. Here all
writes of a flush are buffered until it is complete, and then performed in a safe order: first data
that nothing refers to yet, then the end of the file, then the index from its root, and finally the
object headers, which contain the lengths. After each of these writes, everything that is reachable
is valid.
"""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path
from typing import Final

_SUPERBLOCK: Final = b"\x89HDF\r\n\x1a\n"
_END_AT: Final = {0: 40, 1: 44, 2: 28, 3: 28}
"""Position of the end-of-file address in a superblock, by its version; addresses of eight bytes."""
_INDEX: Final = b"TREE"
_LEVEL_AT: Final = 5
_COUNT_AT: Final = 6
_PAGE: Final = 4096


class OrderedFile:
    """A file object for h5py. Nothing is written to the system before `commit`.

    Args:
        path: path of the file.
        new: create it; otherwise it must exist.

    Attributes:
        fd: its descriptor.
        end: end of the file according to HDF5; anything beyond is reserve.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path, *, new: bool = False) -> None:
        flags = os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT | os.O_TRUNC if new else 0)
        self.fd = os.open(path, flags, 0o666)
        self.end = os.fstat(self.fd).st_size
        self._at = 0
        self._pending: dict[int, bytes] = {}
        self._reached = _end_of(os.pread(self.fd, 64, 0)) or self.end

    # ---- called by h5py -------------------------------------------------------------------------

    def seek(self, at: int, whence: int = os.SEEK_SET) -> int:
        """Set the position and return it."""
        self._at = at + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self.end}[whence]
        return self._at

    def tell(self) -> int:
        """Return the position."""
        return self._at

    def readinto(self, into: memoryview) -> int:
        """Read from buffer and file; return the number of bytes."""
        view = memoryview(into).cast("B")
        at, size = self._at, len(view)
        data = bytearray(os.pread(self.fd, size, at).ljust(size, b"\0"))
        for begin, piece in self._pending.items():
            first, last = max(begin, at), min(begin + len(piece), at + size)
            if first < last:
                data[first - at : last - at] = piece[first - begin : last - begin]
        view[:] = data
        self._at += size
        return size

    def read(self, size: int) -> bytes:
        """Read from buffer and file; h5py recognises a file object by this method."""
        data = bytearray(size)
        self.readinto(memoryview(data))
        return bytes(data)

    def write(self, data: memoryview) -> int:
        """Buffer data; return the number of bytes."""
        piece = bytes(data)
        begin, size = self._at, len(piece)
        self._at += size
        for other in [
            b for b, p in self._pending.items() if b < begin + size and b + len(p) > begin
        ]:
            if other == begin and len(self._pending[other]) == size:
                continue
            begin, piece = _joined(other, self._pending.pop(other), begin, piece)
        self._pending[begin] = piece
        self.end = max(self.end, begin + len(piece))
        return size

    def truncate(self, size: int) -> int:
        """Set the end of the file, as of the next commit."""
        self.end = size
        return size

    def flush(self) -> None:
        """Do nothing: a flush by HDF5 is not always complete."""

    # ---- called by the owner --------------------------------------------------------------------

    def commit(self) -> None:
        """Write everything that is buffered to the operating system.

        Raises:
            OSError: the disk is full, or gone; what was not written remains buffered.
        """
        for begin in sorted(self._pending, key=self._rank):
            piece = self._pending[begin]
            if begin == 0 and os.fstat(self.fd).st_size < self.end:
                os.ftruncate(self.fd, self.end)
            if begin >= self._reached:
                _write(self.fd, piece, begin)
            else:
                _rewrite(self.fd, piece, begin, shrinks=self._shrinks(piece, begin))
            if begin == 0:
                self._reached = _end_of(piece) or self.end
        self._pending.clear()

    def _shrinks(self, piece: bytes, begin: int) -> bool:
        """Whether an index node has fewer entries than before: it was split, or is the root of an
        additional level."""
        before = os.pread(self.fd, _COUNT_AT + 2, begin)
        if not (piece.startswith(_INDEX) and before.startswith(_INDEX)):
            return False
        now, then = (
            int.from_bytes(one[_COUNT_AT : _COUNT_AT + 2], "little") for one in (piece, before)
        )
        return now < then

    def _rank(self, begin: int) -> tuple[int, int, int]:
        piece = self._pending[begin]
        if begin >= self._reached:
            return 0, 0, begin
        if begin == 0:
            return 1, 0, 0
        if piece.startswith(_INDEX):
            return 2, -piece[_LEVEL_AT], begin
        return 3, 0, begin

    def close(self) -> None:
        """Close the file without its reserve and buffer; a second call has no effect."""
        fd, self.fd = self.fd, -1
        if fd < 0:
            return
        try:
            if not self._pending and os.fstat(fd).st_size > self._reached:
                os.ftruncate(fd, self._reached)
        finally:
            os.close(fd)


def _end_of(superblock: bytes) -> int:
    """Return the end of the file according to a superblock; 0: unknown."""
    if not superblock.startswith(_SUPERBLOCK):
        return 0
    at = _END_AT.get(superblock[len(_SUPERBLOCK)], 0)
    return int.from_bytes(superblock[at : at + 8], "little") if at else 0


def _joined(begin: int, piece: bytes, at: int, newer: bytes) -> tuple[int, bytes]:
    """Return two overlapping pieces as one, in which the newer one takes precedence."""
    first, last = min(begin, at), max(begin + len(piece), at + len(newer))
    data = bytearray(last - first)
    data[begin - first : begin - first + len(piece)] = piece
    data[at - first : at - first + len(newer)] = newer
    return first, bytes(data)


def _rewrite(fd: int, piece: bytes, at: int, *, shrinks: bool) -> None:
    """Overwrite data in use page by page: a kill may occur between two pages, but not within one.

    Begins with the last page, so that the entries counted in the head of an index node are present
    when the head is written. If the count shrinks, begins with the first page, because entries
    beyond the count are ignored.
    """
    end = at + len(piece)
    cuts = [at, *range(at // _PAGE * _PAGE + _PAGE, end, _PAGE), end]
    pages = list(pairwise(cuts))
    for begin, close in pages if shrinks else reversed(pages):
        _write(fd, piece[begin - at : close - at], begin)


def _write(fd: int, piece: bytes, at: int) -> None:
    view = memoryview(piece)
    while view:
        done = os.pwrite(fd, view, at)
        view, at = view[done:], at + done
