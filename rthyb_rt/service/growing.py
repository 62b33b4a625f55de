"""A recording that grows while its test runs, and survives whatever happens to its process.

Only whole blocks are added, each at the end and each written once; after every one the file is
flushed. What a killed process leaves is an HDF5 file that opens as any other, with every row up to
the last flush. The name of the finished recording appears when it is finished.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import recording
from rthyb_rt.errors import RthybError
from rthyb_rt.recording import BLOCK_ROWS, FILE_NAME, Recording
from rthyb_rt.service import disk

PART_NAME: Final = "recording.part.h5"
_DAMAGED: Final = "recording.damaged.h5"
_GAPS: Final = "missing_rows"

Rows = NDArray[np.void]


class NoRoomError(RthybError):
    """The disk is full; nothing was written."""


class GrowingFile:
    """The file of one test, in the folder of its run; begun, or taken up again.

    Args:
        folder: of the run; made if it is missing.
        session: the recording without samples; its ``meta["service"]["run_id"]`` tells it from
            others.

    Attributes:
        folder: as given.
        rows: how many it holds.
        missing: ranges [first, last] of ring rows that it lacks; they come before its next row.
        resumed: it was there already.

    Raises:
        NoRoomError: the disk is full.
        RthybError: the folder cannot be written.
    """

    def __init__(self, folder: Path, session: Recording) -> None:
        self.folder = folder
        self._path = folder / PART_NAME
        self._file: Any = None
        self._fd = -1
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.resumed = self._path.exists() and self._take_up()
            if not self.resumed:
                self._begin(session)
        except OSError as error:
            self.close()
            raise RthybError(
                f"{folder}: cannot be written ({error.strerror or error}); check its permissions"
            ) from error

    def _begin(self, session: Recording) -> None:
        import h5py

        if disk.free_bytes(self.folder) < disk.KEPT_FREE_BYTES:
            raise NoRoomError(f"{self.folder}: the disk is full")
        hidden = self._path.with_name(f".{PART_NAME}")
        with h5py.File(hidden, "w") as file:
            recording.fill(file, session, growing=True)
        _sync(hidden)
        hidden.replace(self._path)
        self._open()
        self.missing: list[list[int]] = []

    def _open(self) -> None:
        import h5py

        self._file = h5py.File(self._path, "r+")
        self._samples = self._file["samples"]
        self._fd = os.open(self._path, os.O_RDWR | os.O_CLOEXEC)

    def _take_up(self) -> bool:
        """Go on where another process ended; False: the file is damaged, and was put aside."""
        try:
            self._open()
            self.missing = self._gaps()
            self._drop_damaged_blocks()
            return True
        except (OSError, KeyError, RuntimeError, ValueError):
            self.close()
            self._path.replace(self.folder / _DAMAGED)
            return False

    def _gaps(self) -> list[list[int]]:
        found = recording.plain(self._file.attrs.get(_GAPS, "[]"))
        return [[int(first), int(last)] for first, last in found]

    def _drop_damaged_blocks(self) -> None:
        """Let the file end with its last block that is whole."""
        while len(self._samples):
            begin = (len(self._samples) - 1) // BLOCK_ROWS * BLOCK_ROWS
            try:
                tick = self._samples[begin:]["tick"].astype(np.int64)
                if (np.diff(tick) > 0).all() and (begin == 0 or tick[0] > 0):
                    return
            except OSError:
                pass
            self._samples.resize((begin,))

    @property
    def rows(self) -> int:
        """How many rows it holds."""
        return len(self._samples)

    @property
    def next_row(self) -> int:
        """Number of the ring's row that comes next."""
        return self.rows + sum(last - first + 1 for first, last in self.missing)

    @property
    def last_tick(self) -> int:
        """Tick of its last row; -1 without one."""
        return int(self._samples[-1]["tick"]) if self.rows else -1

    def note_gap(self, first: int, last: int) -> None:
        """State that rows of the ring are lost, before any later one is added.

        Raises:
            NoRoomError: the disk is full.
        """
        self._need_room()
        self.missing.append([first, last])
        recording.set_attributes(self._file, {_GAPS: self.missing})
        self._file.flush()

    def add(self, rows: Rows) -> None:
        """Add rows and have them in the system's hands.

        Args:
            rows: (n,); but for the last time whole blocks of `BLOCK_ROWS`.

        Raises:
            NoRoomError: the disk is full; nothing was added.
        """
        most = 32 * BLOCK_ROWS
        for at in range(0, len(rows), most):
            part = rows[at : at + most]
            self._need_room()
            begin = self.rows
            self._samples.resize((begin + len(part),))
            self._samples[begin:] = part
            self._file.flush()

    def _need_room(self) -> None:
        if not disk.has_room(self._fd, self.folder):
            raise NoRoomError(f"{self.folder}: the disk is full")

    def sync(self) -> None:
        """Have what was added on the disk itself."""
        if self._fd >= 0:
            os.fsync(self._fd)

    def all_rows(self, name: str) -> NDArray[Any]:
        """Return one field of every row, (n,), block by block."""
        step = 64 * BLOCK_ROWS
        parts = [self._samples[at : at + step][name] for at in range(0, self.rows, step)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def finish(self, session: Recording) -> Path:
        """Complete the recording, under its final name; return that.

        Args:
            session: replay data and ``meta`` as they are in the end; ``reference`` None takes the
                file's away.

        Raises:
            NoRoomError: the disk is full; all rows stay under the name of before.
        """
        self._need_room()
        self.close()
        final = self.folder / FILE_NAME
        copy = self.folder / f".{FILE_NAME}.part"
        try:
            if disk.free_bytes(self.folder) < 2 * self._path.stat().st_size + disk.KEPT_FREE_BYTES:
                # No room for two: what follows is a matter of milliseconds.
                copy = self._path
            else:
                shutil.copyfile(self._path, copy)
            _complete(copy, session)
            _sync(copy)
            copy.replace(final)
        except OSError as error:
            with contextlib.suppress(OSError):
                if copy != self._path:
                    copy.unlink()
            self._open()
            raise NoRoomError(
                f"{self.folder}: cannot be finished ({error.strerror or error})"
            ) from error
        self._path.unlink(missing_ok=True)
        return final

    def discard(self) -> None:
        """Delete it and its folder."""
        self.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def close(self) -> None:
        """Let go of the file; twice does no harm."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError, RuntimeError):
                file.close()
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


def _complete(path: Path, session: Recording) -> None:
    import h5py

    with h5py.File(path, "r+") as file:
        recording.fill_replay(file, session.replay)
        recording.set_attributes(file, session.meta)
        if session.reference is None and "reference" in file:
            del file["reference"]


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
