"""A recording that grows while its test runs, and remains readable if its process is killed.

Only complete blocks are added, each at the end and each written once; after every block the file is
flushed, in an order that leaves it valid after each write. After its process was killed, the HDF5
file opens as usual, with every row up to the last flush. The file gets the name of a finished
recording only when it is complete.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.errors import RthybError
from rthyb_rt.record import recording
from rthyb_rt.record.recording import BLOCK_ROWS, FILE_NAME, RecordedTest
from rthyb_rt.service import disk
from rthyb_rt.service.ordered import OrderedFile

PART_NAME: Final = "recording.part.h5"
DAMAGED_NAME: Final = "recording.damaged.h5"
_GAPS: Final = "missing_rows"
_TRIES: Final = ".taken-up"
_TRIES_MOST: Final = 3
"""Maximum of processes that may end while they continue a file: HDF5 may crash on a damaged one."""
REFUSED: Final = (
    *(errno.EACCES, errno.EPERM, errno.EAGAIN),
    *(errno.EMFILE, errno.ENFILE, errno.ENOMEM),
)
"""Errors of the system that do not show that the file is damaged."""

Rows = NDArray[np.void]


class NoRoomError(RthybError):
    """The disk is full; nothing was written."""


class DiskFaultError(RthybError):
    """Written data did not reach the disk. The system reports this only once."""


class GrowingFile:
    """The file of one test, in the folder of its run; newly created, or continued.

    Args:
        folder: folder of the run; created if it is missing.
        session: the recording without samples; its ``meta["service"]["run_id"]`` identifies it.

    Attributes:
        folder: as given.
        rows: number of rows in the file.
        missing: ranges [first, last] of ring rows that are lost; they precede its next row.
        resumed: the file already existed.

    Raises:
        NoRoomError: the disk is full.
        DiskFaultError: the disk has a fault.
        RthybError: the folder cannot be written.
    """

    def __init__(self, folder: Path, session: RecordedTest) -> None:
        self.folder = folder
        self._path = folder / PART_NAME
        self._file: Any = None
        self._disk: OrderedFile | None = None
        self.missing: list[list[int]] = []
        self._tries = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._count_try()
            self.resumed = self._path.exists() and self._take_up()
            if not self.resumed:
                self._begin(session)
                self._save()
        except (NoRoomError, DiskFaultError):
            # A disk that is temporarily full does not count as a try in which a process died.
            self.close()
            raise
        except OSError as error:
            self.close()
            raise RthybError(
                f"cannot be written ({error.strerror or error}); check its permissions",
                where=str(folder),
            ) from error

    def _begin(self, session: RecordedTest) -> None:
        import h5py

        if disk.free_bytes(self.folder) < disk.KEPT_FREE_BYTES:
            raise NoRoomError(f"{self.folder}: the disk is full")
        hidden = self._path.with_name(f".{PART_NAME}")
        with h5py.File(hidden, "w") as file:
            recording.fill(file, session, growing=True)
        _sync(hidden)
        hidden.replace(self._path)
        self._open()

    def _open(self) -> None:
        import h5py

        # Without HDF5's lock, so that reading the file while it grows does not block the recorder.
        # That there is only one recorder is ensured elsewhere.
        self._disk = OrderedFile(self._path)
        self._file = h5py.File(self._disk, "r+")
        self._samples = self._file["samples"]

    def _take_up(self) -> bool:
        """Continue where another process ended; False: the file is damaged, and was renamed."""
        try:
            if self._tries > _TRIES_MOST:
                raise ValueError("every process that tried to continue it has ended early")
            self._open()
            self.missing = self._gaps()
            self._drop_damaged_blocks()
            self._flush()
            return True
        except (OSError, KeyError, RuntimeError, ValueError) as error:
            self.close()
            if isinstance(error, OSError) and error.errno in REFUSED:
                raise
            self._path.replace(self.folder / DAMAGED_NAME)
            return False

    def _count_try(self) -> None:
        """Count the processes that start with this file and do not reach its next row."""
        path = self.folder / _TRIES
        try:
            self._tries = int(path.read_text(encoding="ascii")) + 1
        except (FileNotFoundError, ValueError):
            self._tries = 1
        # A full disk must not prevent a process from continuing.
        with contextlib.suppress(OSError):
            path.write_text(str(self._tries), encoding="ascii")

    def _well_begun(self) -> None:
        """Restart the count, because the file is valid."""
        if self._tries:
            self._tries = 0
            with contextlib.suppress(OSError):
                (self.folder / _TRIES).unlink(missing_ok=True)

    def _save(self) -> None:
        """Copy what is readable from a renamed file: the ring may no longer have it."""
        import h5py

        damaged = self.folder / DAMAGED_NAME
        if not damaged.exists() or self._tries > 2 * _TRIES_MOST:
            return
        parts, gaps = [], []
        unreadable = (OSError, KeyError, RuntimeError, ValueError)
        with contextlib.suppress(*unreadable), h5py.File(damaged, "r", locking=False) as file:
            gaps = _gaps_of(file)
            samples = file["samples"]
            for at in range(0, len(samples), BLOCK_ROWS):
                rows = samples[at : at + BLOCK_ROWS]
                whole = rows.dtype == self._samples.dtype and len(rows) == BLOCK_ROWS
                if not whole or not _in_order(rows["tick"], at):
                    break
                parts.append(rows)
        if parts:
            self.add(np.concatenate(parts))
            self._keep_gaps(gaps)

    def _keep_gaps(self, gaps: list[list[int]]) -> None:
        """Store the gaps before the last row of the file; later gaps are added with rows."""
        kept: list[list[int]] = []
        end = self.rows
        for first, last in gaps:
            if first >= end:
                break
            kept.append([first, last])
            end += last - first + 1
        if kept != self.missing:
            self.missing = kept
            recording.set_attributes(self._file, {_GAPS: kept})
            self._flush()

    def _gaps(self) -> list[list[int]]:
        return _gaps_of(self._file)

    def _drop_damaged_blocks(self) -> None:
        """Truncate the file after its last complete block."""
        before = len(self._samples)
        while len(self._samples):
            begin = (len(self._samples) - 1) // BLOCK_ROWS * BLOCK_ROWS
            with contextlib.suppress(OSError):
                if _in_order(self._samples[begin:]["tick"], begin):
                    break
            self._samples.resize((begin,))
        if len(self._samples) < before:
            self._keep_gaps(self.missing)

    def _flush(self) -> None:
        """Pass all data of HDF5 to the operating system.

        Raises:
            NoRoomError: the disk is full nevertheless; it is tried again with the next rows.
        """
        assert self._disk is not None
        self._file.flush()
        try:
            self._disk.commit()
        except OSError as error:
            if error.errno not in disk.FULL:
                raise
            raise NoRoomError(f"{self.folder}: the disk is full") from error

    def _commit_all(self) -> None:
        """Pass to the operating system what an earlier commit could not.

        Raises:
            NoRoomError: the disk is still full.
        """
        try:
            self._flush()
        except OSError as error:
            raise NoRoomError(
                f"{self.folder}: cannot be written ({error.strerror or error})"
            ) from error

    @property
    def rows(self) -> int:
        """Number of rows in the file."""
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
        """Note that rows of the ring are lost, before any later one is added.

        Raises:
            NoRoomError: the disk is full.
        """
        self._need_room()
        self.missing.append([first, last])
        recording.set_attributes(self._file, {_GAPS: self.missing})
        self._flush()

    def add(self, rows: Rows) -> None:
        """Add rows and pass them to the operating system.

        Args:
            rows: (n,); complete blocks of `BLOCK_ROWS`, except in the last call.

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
            self._flush()
            self._well_begun()

    def _need_room(self) -> None:
        assert self._disk is not None
        if not disk.has_room(self._disk.fd, self._disk.end, self.folder):
            raise NoRoomError(f"{self.folder}: the disk is full")

    def sync(self) -> None:
        """Write the added rows to the disk itself.

        Raises:
            NoRoomError: the disk is full after all.
            DiskFaultError: the disk has a fault.
        """
        if self._disk is not None:
            _fsync(self._disk.fd, self.folder)

    def all_rows(self, name: str) -> NDArray[Any]:
        """Return one field of every row, (n,), block by block."""
        step = 64 * BLOCK_ROWS
        # A view would keep every whole row in memory.
        parts = [self._samples[at : at + step][name].copy() for at in range(0, self.rows, step)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def finish(self, session: RecordedTest) -> Path:
        """Complete the recording under its final name; return the path.

        Args:
            session: final replay data and ``meta``; ``reference`` None removes that of the file.

        Raises:
            NoRoomError: the disk is full; all rows remain under the previous name.
            DiskFaultError: the disk has a fault; likewise.
        """
        self._need_room()
        self._commit_all()
        self.close()
        final = self.folder / FILE_NAME
        copy = self.folder / f".{FILE_NAME}.part"
        try:
            if disk.free_bytes(self.folder) < 2 * self._path.stat().st_size + disk.KEPT_FREE_BYTES:
                # There is no room for two files; what follows takes milliseconds.
                copy = self._path
            else:
                shutil.copyfile(self._path, copy)
            _complete(copy, session)
            _sync(copy)
            copy.replace(final)
        except (OSError, RthybError) as error:
            with contextlib.suppress(OSError):
                if copy != self._path:
                    copy.unlink()
            self._open()
            if isinstance(error, RthybError):
                raise
            raise NoRoomError(
                f"{self.folder}: cannot be finished ({error.strerror or error})"
            ) from error
        self._path.unlink(missing_ok=True)
        return final

    def discard(self) -> None:
        """Delete the file and its folder; a renamed damaged file is kept, and its folder too."""
        self.close()
        if (self.folder / DAMAGED_NAME).exists():
            self._path.unlink(missing_ok=True)
        else:
            shutil.rmtree(self.folder, ignore_errors=True)

    def close(self) -> None:
        """Close the file; a second call has no effect."""
        file, self._file = self._file, None
        with contextlib.suppress(OSError, RuntimeError):
            if file is not None:
                file.close()
        under, self._disk = self._disk, None
        if under is not None:
            with contextlib.suppress(OSError):
                under.commit()
            with contextlib.suppress(OSError):
                under.close()
        # A process that reaches this point has not died of the file.
        self._well_begun()


def _complete(path: Path, session: RecordedTest) -> None:
    import h5py

    with contextlib.closing(OrderedFile(path)) as under:
        with h5py.File(under, "r+") as file:
            recording.fill_replay(file, session.replay)
            recording.set_attributes(file, session.meta)
            if session.reference is None and "reference" in file:
                del file["reference"]
        under.commit()


def _gaps_of(file: Any) -> list[list[int]]:
    found = recording.plain(file.attrs.get(_GAPS, "[]"))
    return [[int(first), int(last)] for first, last in found]


def _in_order(ticks: NDArray[Any], at: int) -> bool:
    """Whether the block from a row on was written, and is not the fill of a gap."""
    found = ticks.astype(np.int64)
    return bool((np.diff(found) > 0).all() and (at == 0 or found[0] > 0))


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        _fsync(fd, path.parent)
    finally:
        os.close(fd)


def _fsync(fd: int, folder: Path) -> None:
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno in disk.FULL:
            raise NoRoomError(f"{folder}: the disk is full") from error
        raise DiskFaultError(
            f"{folder}: the disk has reported an error ({error.strerror}): rows may be missing "
            "there; check dmesg, and restart the recorder"
        ) from error
