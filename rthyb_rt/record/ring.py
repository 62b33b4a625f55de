"""The telemetry ring: the last 64 s of a test in a file in memory that outlives its process.

The tick thread writes one record per tick and never waits. Recorder, live view and `recover` read
the same ring, each through a read-only mapping. Beside the ring is its session file, a recording
without samples; together they form a complete recording (`recover`), even after ``kill -9``.
A ring does not survive a reboot.

Layout of the file, every number with its low byte first::

    0        header, see rthyb_ring_header in csrc/rthyb_ring.h; from byte 128 the status page
    4096     description as JSON: fields with type, offset and unit, versions, boot, process
    then     the slots, at a whole page: a stamp and the record's words
"""

from __future__ import annotations

import datetime
import fcntl
import json
import mmap
import os
import stat
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import __version__
from rthyb_rt.core import (
    FLAGS,
    RUNNING,
    STATES,
    Channel,
    RecordArray,
    as_records,
    row_dtype,
)
from rthyb_rt.core.mapped_ring import (
    CAPACITY,
    HEADER_BYTES,
    LAYOUT,
    RingConsumer,
    RingProducer,
    header_of,
    ring_bytes,
)
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.record import recording, signal_units
from rthyb_rt.record.motion_rows import first_instant
from rthyb_rt.record.recording import RecordedTest

_MODE = 0o640
_SESSION = ".session.h5"
_PRIVATE = 0o700

_SERVICE = Path("/run/rthyb")
_SHARED = Path("/dev/shm")
_OTHER_VERSION = "use the version of rthyb_rt that wrote it"


class OtherVersionError(InputError):
    """A ring that was written by another version of the program."""


_OTHER_LAYOUT: Final = "other_layout"
_OTHER_RECORD: Final = "other_record"
_REFUSED: Final = {
    "foreign": "not a telemetry ring; give a file ring.* of a real-time test",
    "unfinished": "the ring was not completely set up, so no tick was ever recorded",
    _OTHER_RECORD: f"the records have a different size; {_OTHER_VERSION}",
    "truncated": "the file is truncated; copy it again",
    "damaged": "the header is damaged: its sizes are inconsistent; copy the ring again",
}


def default_folder() -> Path:
    """Return the default folder of rings: in memory, and writable for this user.

    ``/run/rthyb`` if the installed service gave it to this user, otherwise the user's runtime
    folder, otherwise a folder of the user in ``/dev/shm``.
    """
    # Root may write there too, but the service's recorder may not read the rings of root.
    with suppress(OSError):
        if _SERVICE.is_dir() and _SERVICE.stat().st_uid == os.geteuid():
            return _SERVICE
    return folders()[1]


def folders() -> list[Path]:
    """Return every possible folder of rings, whether it exists or not; the service's first."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    own = [Path(runtime) / "rthyb"] if runtime else []
    return [_SERVICE, *own, _SHARED / f"rthyb-{os.geteuid()}"]


def claim(folder: Path) -> Path:
    """Return a folder of rings; if it is missing, it is created for this user only.

    Raises:
        RthybError: it cannot be created, or is not trustworthy; see `trusted`.
    """
    try:
        folder.mkdir(mode=_PRIVATE, parents=True, exist_ok=True)
    except OSError as error:
        raise _not_made(folder, error) from error
    return trusted(folder)


def _not_made(folder: Path, error: OSError) -> RthybError:
    return RthybError(
        f"no telemetry ring can be created here ({error.strerror or error}); "
        "check the folder's permissions",
        where=str(folder),
    )


def trusted(folder: Path) -> Path:
    """Return a folder of rings, unless another user may have created it or may write to it.

    Where everybody may create files, as in ``/dev/shm``, the folder must belong to this user and
    give no rights to others: another user could otherwise redirect this user's files or
    impersonate the service. A missing folder is accepted.

    Raises:
        RthybError: it is not trustworthy; the message states its owner and what to do.
    """
    try:
        around, found = folder.parent.stat(), folder.lstat()
    except FileNotFoundError:
        return folder
    if not around.st_mode & stat.S_IWOTH:
        return folder
    if not stat.S_ISDIR(found.st_mode):
        why = "is not a folder but a link; check what it is, and remove it"
    elif found.st_uid != os.geteuid():
        why = (
            f"belongs to user {found.st_uid}, not to user {os.geteuid()}; ask that user or an "
            "administrator to remove it"
        )
    elif found.st_mode & 0o077:
        why = f"has the mode {found.st_mode & 0o777:o}; run chmod 700 {folder}"
    else:
        return folder
    raise RthybError(
        f"everyone may write in {folder.parent}, and this {why}, or set XDG_RUNTIME_DIR",
        where=str(folder),
    )


def session_path(ring: Path) -> Path:
    """Return the name of the session file that belongs to a ring."""
    return ring.with_name(ring.name + _SESSION)


def delete(ring: Path) -> None:
    """Delete a ring and its session.

    The session is deleted first: once the ring is deleted, a new ring may use the same name.
    """
    for path in (session_path(ring), ring):
        path.unlink(missing_ok=True)


def find(folder: Path) -> list[Path]:
    """Return the rings in a folder, newest last."""
    made_s = {}
    for path in folder.glob("ring.*"):
        # A ring may be deleted while they are inspected.
        with suppress(FileNotFoundError):
            if _is_ring_name(path.name):
                made_s[path] = path.stat().st_mtime
    return sorted(made_s, key=made_s.__getitem__)


def _is_ring_name(name: str) -> bool:
    return len(name.split(".")) == 3 and name.rsplit(".", 1)[1].isdigit()


# ---- the producer's side ------------------------------------------------------------------------


class Ring:
    """A ring that this process writes; made by `create`.

    The object owns the memory to which the tick thread writes, so it must outlive that thread.

    Attributes:
        path: the ring's file.
        locked: whether the ring is locked in memory.
        in_memory: whether the ring is on tmpfs. Elsewhere, writing back to the disk can delay the
            producer.
    """

    def __init__(
        self, path: Path, owned: ExitStack, producer: RingProducer, dtype: np.dtype[np.void]
    ) -> None:
        """Take over what `create` made."""
        self.dtype = dtype
        self.path = path
        self.locked, self.in_memory = producer.locked, producer.in_memory
        self._owned = owned
        self._producer: RingProducer | None = producer

    @classmethod
    def create(cls, folder: Path, session: RecordedTest, capacity: int = CAPACITY) -> Ring:
        """Create a ring and its session file; all memory is allocated, locked and written once.

        Args:
            folder: folder of the ring; created for this user only if it is missing.
            session: the recording without its samples.
            capacity: number of records, a power of two.

        Raises:
            RthybError: the folder cannot be written, has no room or is not `trusted`; nothing is
                left behind.
            ValueError: ``capacity`` is not a power of two.
        """
        if capacity < 1 or capacity & (capacity - 1):
            raise ValueError(f"found a capacity of {capacity} rows; it must be a power of two")
        dtype = row_dtype(session.channels, session.axis_count)
        about = json.dumps(_description(session)).encode()
        count = len(session.channels)
        size = ring_bytes(capacity, len(about), session.axis_count, count)
        with ExitStack() as undo:
            path, fd = _reserve(folder)
            undo.callback(path.unlink, missing_ok=True)
            owned = undo.enter_context(ExitStack())
            owned.callback(os.close, fd)
            memory = _take_memory(fd, path, size)
            owned.callback(memory.close)
            producer = RingProducer(memory, fd, about, capacity, session.axis_count, count)
            owned.callback(producer.release)
            undo.callback(session_path(path).unlink, missing_ok=True)
            # Written last: a process that finds a session finds a ring beside it.
            _write_session(path, session)
            ring = cls(path, owned.pop_all(), producer, dtype)
            undo.pop_all()
        return ring

    @property
    def pointer(self) -> Any:
        """``rthyb_ring *`` for the tick thread.

        Raises:
            RthybError: the ring is closed.
        """
        return self._writing.pointer

    @property
    def _writing(self) -> RingProducer:
        if self._producer is None:
            raise RthybError(f"{self.path}: the ring is closed")
        return self._producer

    def push(self, records: RecordArray) -> None:
        """Write rows of ``dtype``, or only their records, (n,), as the tick thread does in C.

        For exchange threads in Python; only one thread may call it at a time.
        """
        source, channels = as_records(records), None
        names = (self.dtype.names or ())[len(as_records(records[:0]).dtype.names or ()) :]
        if names and records.dtype == self.dtype:
            channels = np.stack([records[name] for name in names], axis=-1)
        self._writing.push(source, channels)

    def renew_session(self, session: RecordedTest) -> None:
        """Replace the session file atomically, with new tares, commands and parameters.

        Raises:
            RthybError: it cannot be written; the previous file remains.
        """
        _write_session(self.path, session)

    def close(self) -> None:
        """Mark the ring as ended in good order, and close the file; a second call has no effect.

        The tick thread must have ended.
        """
        if self._producer is not None:
            self._producer.close()
            self._producer = None
            self._owned.close()

    def remove(self) -> None:
        """Close the ring and delete it with its session, once the recording is complete."""
        self.close()
        delete(self.path)


def _description(session: RecordedTest) -> dict[str, Any]:
    return {
        "rthyb_version": __version__,
        "fields": _fields(
            session.channels,
            session.axis_count,
            first_turns=signal_units.turns(session)[:1] == (True,),
        ),
        "channels": [asdict(channel) for channel in session.channels],
        "record_bytes": row_dtype(session.channels, session.axis_count).itemsize,
        "fs_hz": session.fs_hz,
        "boot_id": _boot_id(),
        "pid": os.getpid(),
        "started_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _fields(
    channels: Sequence[Channel], axis_count: int = 1, *, first_turns: bool = False
) -> list[dict[str, Any]]:
    fields: Mapping[str, Any] = row_dtype(channels, axis_count).fields or {}
    units = signal_units.units_of(axis_count, first_turns=first_turns)
    units |= {channel.name: channel.unit for channel in channels}
    return [
        {"name": name, "type": field[0].str, "offset": field[1], "unit": units[name]}
        for name, field in fields.items()
    ]


def _boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return "unknown"


def _reserve(folder: Path) -> tuple[Path, int]:
    """Create and lock an empty file with a new name."""
    stem = f"ring.{_boot_id()[:8]}"
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    claim(folder)
    try:
        number = 1
        while True:
            path = folder / f"{stem}.{number}"
            with suppress(FileExistsError):
                fd = os.open(path, flags, _MODE)
                break
            number += 1
        # The lock ends with the process, however it ends, so readers know whether it is alive.
        fcntl.flock(fd, fcntl.LOCK_EX)
        os.fchmod(fd, _MODE)
    except OSError as error:
        raise _not_made(folder, error) from error
    return path, fd


def _take_memory(fd: int, path: Path, size: int) -> mmap.mmap:
    """Allocate every block now: on a full tmpfs the tick thread would be killed by SIGBUS."""
    try:
        os.posix_fallocate(fd, 0, size)
        return mmap.mmap(fd, size)
    except OSError as error:
        free = os.fstatvfs(fd)
        raise RthybError(
            f"no room for the telemetry ring ({error.strerror or error}): "
            f"{size / 1e6:.1f} MB needed, {free.f_bavail * free.f_frsize / 1e6:.1f} MB free; "
            "delete the rings of tests that have been recovered (ring.*)",
            where=str(path.parent),
        ) from error


def _write_session(ring: Path, session: RecordedTest) -> None:
    bare = replace(
        session, samples=np.zeros(0, dtype=row_dtype(session.channels, session.axis_count))
    )
    recording.write(session_path(ring), bare)
    session_path(ring).chmod(_MODE)


# ---- readers ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rows:
    """Consecutive records without a gap.

    Attributes:
        first: number of the first of them; the ring's first record ever has number 0.
        samples: the records, shape (n,).
    """

    first: int
    samples: RecordArray


class RingReader:
    """A reader of a ring, at its own pace; it starts with the oldest record.

    Attributes:
        path: the ring's file.
        about: the description in the file: fields, versions, boot, process.
        dtype: of a row.

    Raises:
        InputError: the file is missing, not a ring, truncated, damaged or of another version.
    """

    def __init__(self, path: str | Path) -> None:
        """Map the ring read-only."""
        self.path = Path(path)
        with ExitStack() as owned:
            self._fd = _open(self.path)
            owned.callback(os.close, self._fd)
            if os.fstat(self._fd).st_size < HEADER_BYTES:
                raise InputError(
                    "too short for a telemetry ring; give a file ring.* of a real-time test",
                    str(path),
                )
            memory = mmap.mmap(self._fd, 0, access=mmap.ACCESS_READ)
            owned.callback(memory.close)
            self._rows = RingConsumer(memory)
            owned.callback(self._rows.release)
            self.about, self.dtype = _about(memory, self.path, self._rows.refusal)
            self._owned = owned.pop_all()

    def __enter__(self) -> RingReader:
        """Return the reader itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file; the reader can no longer be used."""
        self._owned.close()

    @property
    def next(self) -> int:
        """Number of the next record to be read."""
        return self._rows.next

    @property
    def lost(self) -> int:
        """Number of records that were overwritten before they were read, or were incomplete."""
        return self._rows.lost

    @property
    def pushed(self) -> int:
        """Number of records written to the ring so far."""
        return self._rows.pushed

    @property
    def frozen(self) -> bool:
        """Whether the ring is frozen after a TRIP."""
        return self._rows.frozen

    @property
    def closed(self) -> bool:
        """Whether the producer ended in good order."""
        return self._rows.closed

    @property
    def alive(self) -> bool:
        """Whether a process still has the ring open for writing."""
        try:
            fcntl.flock(self._fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._fd, fcntl.LOCK_UN)
        return False

    def read(self, most: int = 8192) -> Rows:
        """Return the next records, at most the given number, without waiting.

        Records that were overwritten in the meantime are skipped: `Rows.first` is then greater than
        the previous ``next``. An empty result means that there is nothing new.
        """
        buffer = np.empty(most, dtype=self.dtype)
        count = self._rows.read_into(buffer)
        return Rows(self.next - count, buffer[:count])

    def newest(self) -> np.void | None:
        """Return the record of the last tick, even of a frozen ring, or None before the first."""
        buffer = np.empty(1, dtype=self.dtype)
        return buffer[0] if self._rows.newest_into(buffer) else None


def _open(path: Path) -> int:
    if path.is_dir():
        rings = find(path)
        hint = f"; did you mean {rings[-1]}?" if rings else ""
        raise InputError(f"is a folder; give a ring in it (ring.*){hint}", str(path))
    if not path.is_file():
        raise InputError(
            "no such file; rings do not survive a reboot; rthyb recover lists those that exist",
            str(path),
        )
    try:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise InputError(
            f"cannot be opened ({error.strerror}); only its owner and its group may read it",
            str(path),
        ) from error


def _about(memory: mmap.mmap, path: Path, refused: str) -> tuple[dict[str, Any], np.dtype[np.void]]:
    """Return the description and the type of a row, or refuse the ring with the reason."""
    if refused and refused != _OTHER_LAYOUT:
        other = refused == _OTHER_RECORD
        raise (OtherVersionError if other else InputError)(_REFUSED[refused], str(path))
    layout, about = _description_in(memory)
    version = about.get("rthyb_version")
    writer = f" of rthyb_rt {version}" if version else ""
    if refused:
        raise OtherVersionError(
            f"the ring{writer} has layout {layout}, but this version reads layout {LAYOUT}; "
            + _OTHER_VERSION,
            str(path),
        )
    if not about:
        raise InputError(f"the description in the ring is damaged; {_OTHER_VERSION}", str(path))
    row_bytes = header_of(memory).row_bytes
    with suppress(KeyError, TypeError, ValueError):
        channels = tuple(Channel(**one) for one in about.get("channels", ()))
        axis_count = _axes_of(about)
        dtype = row_dtype(channels, axis_count)
        known = [_fields(channels, axis_count, first_turns=turns) for turns in (False, True)]
        if about.get("fields") in known and dtype.itemsize == row_bytes:
            return about, dtype
    raise OtherVersionError(f"the ring{writer} has different fields; {_OTHER_VERSION}", str(path))


def _axes_of(about: Mapping[str, Any]) -> int:
    """Return the number of axes in the rows of a ring, by its description."""
    return sum(str(field["name"]).partition(".")[0] == "x_cmd_m" for field in about["fields"]) or 1


def _description_in(memory: mmap.mmap) -> tuple[int, dict[str, Any]]:
    """Return layout and description of a ring of any layout; empty if it cannot be read."""
    header = header_of(memory)
    with suppress(ValueError):
        about = json.loads(memory[header.about_at : header.about_at + header.about_bytes].decode())
        return header.layout, about if isinstance(about, dict) else {}
    return header.layout, {}


@dataclass(frozen=True)
class Sight:
    """Summary of a ring.

    Attributes:
        path: path of the ring.
        test_name: name in the session file; "" if that cannot be read.
        pid: process that created it; 0 if unknown.
        started_utc: time of its creation; "" if unknown.
        age_s: time since then.
        rows: records written so far; some of them may have been overwritten.
        ticks: ticks up to the newest record.
        state: state in the newest record; "" before the first.
        alive: whether a process has it open for writing.
        fault: why it cannot be read or recovered; "" if it can.
    """

    path: Path
    test_name: str = ""
    pid: int = 0
    started_utc: str = ""
    age_s: float | None = None
    rows: int = 0
    ticks: int = 0
    state: str = ""
    alive: bool = False
    fault: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return all values by name."""
        return {**self.__dict__, "path": str(self.path)}


def look(path: Path) -> Sight:
    """Inspect a ring without disturbing its users; faults are returned, never raised."""
    try:
        with RingReader(path) as reader:
            newest = reader.newest()
            started = str(reader.about.get("started_utc", ""))
            seen = Sight(
                path=path,
                pid=int(reader.about.get("pid", 0)),
                started_utc=started,
                age_s=_age_s(started),
                rows=reader.pushed,
                ticks=0 if newest is None else int(newest["tick"]) + 1,
                state="" if newest is None else STATES[newest["state"]],
                alive=reader.alive,
                fault="" if newest is not None else "its process has not reached its first tick",
            )
    except InputError as error:
        return Sight(path, fault=error.problems[0].message)
    try:
        return replace(seen, test_name=str(_session(path).meta.get("test_name", "")))
    except RthybError as error:
        return replace(seen, fault=error.problems[0].message)


def _age_s(started_utc: str) -> float | None:
    with suppress(ValueError, TypeError):
        began = datetime.datetime.fromisoformat(started_utc)
        return (datetime.datetime.now(datetime.UTC) - began).total_seconds()
    return None


# ---- from the ring to a recording ---------------------------------------------------------------


@dataclass(frozen=True)
class RecoveredRecording:
    """Recording that was recovered from a ring and its session.

    Attributes:
        recording: rows from the oldest record that the ring still had. Its ``meta`` also contains
            the other attributes.
        rows: first and last ring row held, counted from the ring's start.
        missing_rows: ranges [first, last] of ring rows that were overwritten or incomplete.
        missing_ticks: ranges [first, last] of ticks between two rows: of missing rows, or of the
            time during which the ring was frozen.
        alive: the test was still running.
    """

    recording: RecordedTest
    rows: tuple[int, int]
    missing_rows: list[list[int]]
    missing_ticks: list[list[int]]
    alive: bool


def recover(path: str | Path) -> RecoveredRecording:
    """Make a recording from a ring and the session beside it, whether or not its process is alive.

    Nothing is changed or deleted, and a running test is not disturbed.

    Args:
        path: the ring.

    Raises:
        InputError: one of the two cannot be read, or the ring has no record.
    """
    path = Path(path)
    with RingReader(path) as reader:
        alive = reader.alive
        parts = _read_all(reader)
        ended = _end_reason(reader, parts, alive)
    if not parts:
        raise InputError(
            "the ring has no record: its process ended before the first tick", str(path)
        )
    samples = joined([part.samples for part in parts])
    found = RecoveredRecording(
        recording=_join(_session(path), samples, parts[0].first),
        rows=(parts[0].first, parts[-1].first + len(parts[-1].samples) - 1),
        missing_rows=_missing_rows(parts),
        missing_ticks=_missing_ticks(samples["tick"]),
        alive=alive,
    )
    now = datetime.datetime.now(datetime.UTC)
    found.recording.meta |= {
        "end_reason": f"{ended} (recovered from the telemetry ring)",
        "recovered_from": path.name,
        "recovered_utc": now.isoformat(timespec="seconds"),
        "recovered_rows": list(found.rows),
        "missing_rows": found.missing_rows,
        "missing_ticks": found.missing_ticks,
    }
    return found


def _session(ring: Path) -> RecordedTest:
    path = session_path(ring)
    if not path.is_file():
        raise InputError(
            f"the session file {path.name} is not beside the ring; copy both to the same folder",
            str(ring),
        )
    return recording.read(path)


def _join(session: RecordedTest, samples: RecordArray, first_row: int) -> RecordedTest:
    """Return the session with its samples, and without data that no longer match them."""
    held = bool((samples["state"] == STATES.index("HOLD")).any())
    return replace(
        session,
        samples=samples,
        reference=_reference_of(session, samples, first_row),
        replay=replace(session.replay, skips=skips(samples)),
        meta=session.meta | {"interrupted": held},
    )


def _read_all(reader: RingReader) -> list[Rows]:
    """Return all rows so far; a running test may continue meanwhile."""
    end = reader.pushed + 1  # a process may have died between a record and its count
    parts = []
    while reader.next < end:
        rows = reader.read(end - reader.next)
        if not rows.samples.size:
            break
        parts.append(rows)
    return parts


def _end_reason(reader: RingReader, parts: list[Rows], alive: bool) -> str:
    if parts and parts[-1].samples["state"][-1] == STATES.index("TRIPPED"):
        return "tripped"
    if alive:
        return "still running"
    return "closed" if reader.closed else "its process ended early"


def joined(parts: Sequence[RecordArray]) -> RecordArray:
    """Return records of several arrays in one, shape (n,), padding and all."""
    # np.concatenate would take the padding out of the records.
    samples = np.zeros(sum(part.size for part in parts), dtype=parts[0].dtype)
    done = 0
    for part in parts:
        samples[done : done + part.size] = part
        done += part.size
    return samples


def _missing_rows(parts: list[Rows]) -> list[list[int]]:
    missing, wanted = [], 0
    for part in parts:
        if part.first > wanted:
            missing.append([wanted, part.first - 1])
        wanted = part.first + len(part.samples)
    return missing


def _missing_ticks(tick: NDArray[np.uint64]) -> list[list[int]]:
    at = np.flatnonzero(tick[1:] > tick[:-1] + np.uint64(1))
    return [[int(tick[i]) + 1, int(tick[i + 1]) - 1] for i in at]


def _reference_of(
    session: RecordedTest, samples: RecordArray, first_row: int
) -> NDArray[np.void] | None:
    """Return the part of the reference simulation that belongs to the rows; None: not known."""
    if session.reference is None or not (samples["state"] == RUNNING).any():
        return None
    if _reference_fits(samples, first_row):
        return session.reference
    first = first_instant(replace(session, samples=samples, reference=None))
    return None if first is None else session.reference[first:]


def _reference_fits(samples: RecordArray, first_row: int) -> bool:
    """Whether the first RUNNING row is the test's first, and no tick is missing from there on."""
    running = np.flatnonzero(samples["state"] == RUNNING)
    if not running.size:
        return False
    begin = int(running[0])
    return (begin > 0 or first_row == 0) and not _missing_ticks(samples["tick"][begin:])


def skips(samples: RecordArray) -> NDArray[np.int64]:
    """Return first tick and length of every run of blind rows, shape (n, 2)."""
    blind = (samples["flags"] & FLAGS["blind"]) != 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], blind, [False]]).astype(np.int8)))
    first, end = edges[::2], edges[1::2]
    tick = samples["tick"].astype(np.int64)
    return (
        np.stack([tick[first], end - first], axis=1) if first.size else np.zeros((0, 2), np.int64)
    )
