"""A recording that grows while its test runs, and survives whatever happens to its process.

Only whole blocks are added, each at the end and each written once; after every one the file is
flushed, in an order that leaves it whole after each write. What a killed process leaves is an HDF5
file that opens as any other, with every row up to the last flush. The name of the finished
recording appears when it is finished.
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
from rthyb_rt.record.recording import BLOCK_ROWS, FILE_NAME, Recording
from rthyb_rt.service import disk
from rthyb_rt.service.ordered import OrderedFile

PART_NAME: Final = "recording.part.h5"
DAMAGED_NAME: Final = "recording.damaged.h5"
_GAPS: Final = "missing_rows"
_TRIES: Final = ".taken-up"
_TRIES_MOST: Final = 3
"""So often may a process end in the middle of taking a file up: HDF5 can come to grief over one."""
REFUSED: Final = (
    *(errno.EACCES, errno.EPERM, errno.EAGAIN),
    *(errno.EMFILE, errno.ENFILE, errno.ENOMEM),
)
"""What the system refuses just now says nothing about the file."""

Rows = NDArray[np.void]


class NoRoomError(RthybError):
    """The disk is full; nothing was written."""


class DiskFaultError(RthybError):
    """What was written did not get to the disk. The system says so once, and good then."""


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
        DiskFaultError: the disk has a fault.
        RthybError: the folder cannot be written.
    """

    def __init__(self, folder: Path, session: Recording) -> None:
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
            # A disk that is full for a while is no try that somebody died of.
            self.close()
            raise
        except OSError as error:
            self.close()
            raise RthybError(
                f"cannot be written ({error.strerror or error}); check its permissions",
                where=str(folder),
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

    def _open(self) -> None:
        import h5py

        # No lock of HDF5's: whoever reads the file must not keep the recorder from it, and may do
        # so while it grows. That there is one recorder only is settled elsewhere.
        self._disk = OrderedFile(self._path)
        self._file = h5py.File(self._disk, "r+")
        self._samples = self._file["samples"]

    def _take_up(self) -> bool:
        """Go on where another process ended; False: the file is damaged, and was put aside."""
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
        """Count the processes that begin with this file and do not come to its next row."""
        path = self.folder / _TRIES
        try:
            self._tries = int(path.read_text(encoding="ascii")) + 1
        except (FileNotFoundError, ValueError):
            self._tries = 1
        # A full disk must not keep anybody from going on.
        with contextlib.suppress(OSError):
            path.write_text(str(self._tries), encoding="ascii")

    def _well_begun(self) -> None:
        """Begin to count anew: the file is good."""
        if self._tries:
            self._tries = 0
            with contextlib.suppress(OSError):
                (self.folder / _TRIES).unlink(missing_ok=True)

    def _save(self) -> None:
        """Take over what can be read of a file that was put aside: the ring may have it no more."""
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
        """State the gaps that lie before the end of what there is; the others come with rows."""
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
        """Let the file end with its last block that is whole."""
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
        """Have all that HDF5 knows in the system's hands.

        Raises:
            NoRoomError: the disk is full all the same; it is tried again with the next rows.
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
        """Have in the system's hands what a commit before could not bring there.

        Raises:
            NoRoomError: it cannot now either.
        """
        try:
            self._flush()
        except OSError as error:
            raise NoRoomError(
                f"{self.folder}: cannot be written ({error.strerror or error})"
            ) from error

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
        self._flush()

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
            self._flush()
            self._well_begun()

    def _need_room(self) -> None:
        assert self._disk is not None
        if not disk.has_room(self._disk.fd, self._disk.end, self.folder):
            raise NoRoomError(f"{self.folder}: the disk is full")

    def sync(self) -> None:
        """Have what was added on the disk itself.

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

    def finish(self, session: Recording) -> Path:
        """Complete the recording, under its final name; return that.

        Args:
            session: replay data and ``meta`` as they are in the end; ``reference`` None takes the
                file's away.

        Raises:
            NoRoomError: the disk is full; all rows stay under the name of before.
            DiskFaultError: the disk has a fault; so they do.
        """
        self._need_room()
        self._commit_all()
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
        """Delete it and its folder; one that was put aside stays, and the folder with it."""
        self.close()
        if (self.folder / DAMAGED_NAME).exists():
            self._path.unlink(missing_ok=True)
        else:
            shutil.rmtree(self.folder, ignore_errors=True)

    def close(self) -> None:
        """Let go of the file; twice does no harm."""
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
        # Whoever comes here has lived.
        self._well_begun()


def _complete(path: Path, session: Recording) -> None:
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
    """Whether a block from a row on is one that was written, and not what fills a gap."""
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
