"""The recorder: a separate process that writes the rings of the service's tests into recordings.

It reads the ring of the tick thread at its own pace, and nothing waits for it. If it is killed and
restarted, it continues at the first tick that is not in the file; rows that the ring no longer has
by then are stated as missing. If the disk is full, it waits while the ring keeps the last 64 s. It
writes its status to `STATUS_NAME` beside the rings four times a second.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config
from rthyb_rt.core import RUNNING, STATES
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.record import recording, ring
from rthyb_rt.record.recording import BLOCK_ROWS, FILE_NAME, RecordedTest
from rthyb_rt.service import disk
from rthyb_rt.service.growing import (
    DAMAGED_NAME,
    PART_NAME,
    REFUSED,
    DiskFaultError,
    GrowingFile,
    NoRoomError,
)

STATUS_NAME: Final = "recorder.json"
INDEX_NAME: Final = "index.jsonl"
SCHEMA: Final = "rthyb-recorder/1"
TURN_S: Final = 0.06
FRESH_S: Final = 2.0
"""Age of the status above which the recorder is considered dead."""

_LOCK: Final = "recorder.lock"
_SYNC_S: Final = 1.0
_STATUS_S: Final = 0.25
_SLOW_S: Final = (1, 3, 10, 30)
"""A disk operation that takes as long is reported while it lasts, and `_SLOW_FOR_S` longer."""
_SLOW_FOR_S: Final = 10.0
_STUCK_S: Final = 10.0
"""The ring keeps 64 s, so a disk that is merely slow does not prevent a test."""
_RETRY_S: Final = 0.5
_PATIENCE_S: Final = 10.0
_CHUNK: Final = 4096
_MOST_BYTES: Final = 10**6

log = logging.getLogger("rthyb.recorder")


# ---- status -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Status:
    """Status of the recorder.

    Attributes:
        pid: its process.
        at_s: time of the status, on CLOCK_MONOTONIC.
        runs: folder of the recordings.
        free_bytes: free space on its disk.
        run_id, folder, rows, missing_rows: of the newest test that it records, "" and 0 if none.
        behind_rows: rows of that test that have not been written yet.
        fault: the fault in words, or "".
        hinders: whether the fault prevents another test; it does not if it concerns only the past,
            such as a file of an earlier test that cannot be repaired.
    """

    pid: int
    at_s: float
    runs: str
    free_bytes: int
    run_id: str = ""
    folder: str = ""
    rows: int = 0
    behind_rows: int = 0
    missing_rows: list[list[int]] = field(default_factory=list)
    fault: str = ""
    hinders: bool = False

    @property
    def alive(self) -> bool:
        """Whether the status is recent."""
        return time.monotonic() - self.at_s < FRESH_S


def read_status(folder: Path) -> Status | None:
    """Return the last status of the recorder of a ring folder; None if there is none."""
    try:
        with (folder / STATUS_NAME).open("rb") as file:
            document = json.loads(file.read(_MOST_BYTES))
        if document.pop("schema") != SCHEMA:
            return None
        return Status(**document)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _write_status(folder: Path, status: Status) -> None:
    document = {"schema": SCHEMA, **asdict(status)}
    # A full tmpfs prevents only the status, not the recording.
    with contextlib.suppress(RthybError), recording.replacing(folder / STATUS_NAME) as temporary:
        temporary.write_text(json.dumps(document), encoding="utf-8")


class _Patience:
    """Reports a slow disk, from a separate thread, while it is slow and a little longer.

    Args:
        folder: folder for `STATUS_NAME`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._status: Status | None = None
        self._doing, self._since_s = "", 0.0
        self._slow, self._step_s, self._slow_until_s = "", 0, 0.0
        self._lock, self._over = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="patience", daemon=True)
        self._thread.start()

    def say(self, status: Status) -> None:
        """Publish the status of the recorder."""
        with self._lock:
            self._status = status
            slow = self._slow if time.monotonic() < self._slow_until_s else ""
            _write_status(self._folder, replace(status, fault=_both(slow, status.fault)))

    @contextlib.contextmanager
    def of(self, doing: str) -> Iterator[None]:
        """Measure the time of an operation."""
        with self._lock:
            self._doing, self._since_s = doing, time.monotonic()
        try:
            yield
        finally:
            with self._lock:
                self._look()
                self._doing = ""

    def _look(self) -> float:
        """Return the duration of the current operation if it takes long; otherwise 0."""
        now = time.monotonic()
        passed = [step_s for step_s in _SLOW_S if now - self._since_s >= step_s]
        if not self._doing or not passed:
            return 0.0
        # One line of the journal, not one for each of many slow writes.
        self._step_s = max(passed[-1], self._step_s if now < self._slow_until_s else 0)
        self._slow = f"{self._doing} has taken over {self._step_s} s: is the disk slow or stuck?"
        self._slow_until_s = now + _SLOW_FOR_S
        return now - self._since_s

    def _run(self) -> None:
        while not self._over.wait(_STATUS_S):
            with self._lock:
                took_s = self._look()
                if self._status is None or not took_s:
                    continue
                late = replace(
                    self._status,
                    at_s=time.monotonic(),
                    fault=_both(self._slow, self._status.fault),
                    hinders=self._status.hinders or took_s >= _STUCK_S,
                )
                _write_status(self._folder, late)

    def close(self) -> None:
        """End the reports and remove the status."""
        self._over.set()
        self._thread.join()
        (self._folder / STATUS_NAME).unlink(missing_ok=True)


def _both(*faults: str) -> str:
    return "; ".join(filter(None, faults))


# ---- one test -----------------------------------------------------------------------------------


class Tape:
    """Transfers one ring into one file.

    Args:
        path: the ring of a test.
        folder: of the run.
        session: the recording without samples, from the session file of the ring.

    Raises:
        InputError: the ring cannot be read, or is not that of the file.
        NoRoomError: the disk is full.
        RthybError: the folder cannot be written.
    """

    def __init__(self, path: Path, folder: Path, session: RecordedTest) -> None:
        self.path, self.run_id = path, str(session.meta["service"]["run_id"])
        self.reader = ring.RingReader(path)
        try:
            self.file = GrowingFile(folder, session)
            self._pending: list[ring.Rows] = []
            self._seek()
        except BaseException:
            self.reader.close()
            raise
        self._moved = self._has_moved(self.file.all_rows("state"))

    def _seek(self) -> None:
        """Advance to the next row of the ring; rows that it no longer has become a gap."""
        while self.reader.next < self.file.next_row:
            rows = self.reader.read(min(self.file.next_row - self.reader.next, _CHUNK))
            if not rows.samples.size:
                raise InputError(
                    "the file contains rows that its ring never contained", str(self.path)
                )
            if self.reader.next == self.file.next_row:
                _require_same(rows.samples[-1:], self.file, self.path)

    @property
    def behind(self) -> int:
        """Number of rows in the ring that are not yet in the file."""
        return max(self.reader.pushed - self.file.next_row, 0)

    def turn(self, last: bool = False) -> None:
        """Write new rows to the file; with ``last``, also an incomplete block.

        Raises:
            NoRoomError: the disk is full; nothing that the ring still has is lost.
        """
        # With a slow disk, new rows would keep arriving while it writes.
        end = self.reader.pushed
        while True:
            self._write(last=False)
            if self.reader.next >= end:
                break
            rows = self.reader.read(_CHUNK)
            if not rows.samples.size:
                break
            self._pending.append(rows)
        if last:
            self._write(last=True)

    def _write(self, last: bool) -> None:
        while self._pending:
            rows = self._pending[0]
            expected = self.file.next_row
            if rows.first > expected:
                self.file.note_gap(expected, rows.first - 1)
                log.warning("%s: rows %d to %d are lost", self.path.name, expected, rows.first - 1)
            elif rows.first < expected:
                # Some of them were written before the disk was full.
                self._pending[0] = ring.Rows(expected, rows.samples[expected - rows.first :])
            rows = self._joined()
            followed = len(self._pending) > 1
            count = rows.samples.size if last or followed else self._whole(rows.samples.size)
            # First: rows that a full disk did not accept are in the file; do not add them again.
            self._moved = self._moved or self._has_moved(rows.samples["state"][:count])
            self.file.add(rows.samples[:count])
            left = rows.samples[count:]
            self._pending[:1] = [ring.Rows(rows.first + count, left)] if left.size else []
            if left.size:
                return

    def _joined(self) -> ring.Rows:
        """Join the first waiting rows and all that follow without a gap."""
        first = self._pending[0]
        parts, end = [first.samples], first.first + first.samples.size
        while len(parts) < len(self._pending) and self._pending[len(parts)].first == end:
            parts.append(self._pending[len(parts)].samples)
            end += parts[-1].size
        joined = ring.Rows(first.first, ring.joined(parts))
        self._pending[: len(parts)] = [joined]
        return joined

    def _whole(self, waiting: int) -> int:
        """Return how many rows fill complete blocks, also after a gap."""
        to_fill = -self.file.rows % BLOCK_ROWS
        full = waiting - to_fill
        return 0 if full < 0 else to_fill + full // BLOCK_ROWS * BLOCK_ROWS

    @staticmethod
    def _has_moved(states: NDArray[Any]) -> bool:
        return bool((states > STATES.index("ARMED")).any())

    @property
    def over(self) -> bool:
        """Whether the ring receives no more rows, because its test or its process has ended."""
        return self.reader.closed or not self.reader.alive

    def finish(self) -> dict[str, Any] | None:
        """Complete the recording and delete the ring; return its line of the index.

        None: nothing moved, so no recording is kept.

        Raises:
            NoRoomError: the disk is full.
        """
        closed = self.reader.closed
        self.turn(last=True)
        if not self._moved:
            self.close()
            self.file.discard()
            ring.delete(self.path)
            return None
        session = _session(self.path)
        final = self._completed(session, closed)
        place = self.file.finish(final)
        _write_settings(self.file.folder, session)
        entry = _entry(self.run_id, place, final, self._ticks, self.file.missing)
        self.reader.close()
        return entry

    def _completed(self, session: RecordedTest, closed: bool) -> RecordedTest:
        states = self.file.all_rows("state")
        self._ticks = self.file.all_rows("tick")
        meta = dict(session.meta)
        if not closed:
            tripped = states.size and states[-1] == STATES.index("TRIPPED")
            meta["end_reason"] = "tripped" if tripped else "its process ended early"
        meta["interrupted"] = bool((states == STATES.index("HOLD")).any())
        meta["missing_rows"] = self.file.missing
        if isinstance(meta.get("real_time"), dict):
            meta["real_time"] = meta["real_time"] | {"missed_rows": self.file.missing}
        whole = not self.file.missing and bool((states == RUNNING).any())
        return replace(
            session,
            replay=replace(session.replay, skips=_skips(self.file)),
            # Row k of the reference belongs to the k-th row of the test.
            reference=session.reference if whole else None,
            meta=meta,
        )

    def close(self) -> None:
        """Close ring and file."""
        self.reader.close()
        self.file.close()


def _skips(file: GrowingFile) -> NDArray[np.int64]:
    """Return `ring.skips` of every row, without loading whole rows: an hour would be a gigabyte."""
    ticks, flags = file.all_rows("tick"), file.all_rows("flags")
    rows = np.empty(ticks.size, dtype=[("tick", ticks.dtype), ("flags", flags.dtype)])
    rows["tick"], rows["flags"] = ticks, flags
    return ring.skips(rows)


class _NotOursError(InputError):
    """A ring that does not belong to a test of the service, and is not to be recorded."""


def _session(path: Path) -> RecordedTest:
    place = ring.session_path(path)
    if not place.is_file():
        raise InputError("the session file is missing beside the ring", str(path))
    session = recording.read(place)
    about = session.meta.get("service")
    if not isinstance(about, dict) or about.get("purpose") != "test":
        raise _NotOursError("not a test of the service", str(path))
    return session


def _require_same(row: NDArray[np.void], file: GrowingFile, path: Path) -> None:
    if int(row["tick"][0]) != file.last_tick:
        raise InputError(
            f"the file ends with tick {file.last_tick}, but the ring has tick "
            f"{int(row['tick'][0])} in that place",
            str(path),
        )


def _folder(runs: Path, session: RecordedTest) -> Path:
    """Return the folder of a run: the one that has its file, or a new one."""
    made = datetime.datetime.fromisoformat(str(session.meta["created_utc"]))
    name = f"{session.meta['test_name']}-{made:%Y%m%dT%H%M%SZ}"
    run_id = session.meta["service"]["run_id"]
    number = 1
    while True:
        folder = runs / (name if number == 1 else f"{name}-{number}")
        if not folder.exists() or _run_id(folder) in (run_id, None):
            return folder
        number += 1


def _run_id(folder: Path) -> str | None:
    """Return the run to which a folder belongs; None if it is empty."""
    import h5py

    for name in (PART_NAME, FILE_NAME):
        try:
            with h5py.File(folder / name, "r") as file:
                about = recording.plain(file.attrs["service"])
                return str(about["run_id"])
        except FileNotFoundError:
            continue
        except (OSError, KeyError, TypeError, RuntimeError):
            return ""
    return None if not any(folder.iterdir()) else ""


def _write_settings(folder: Path, session: RecordedTest) -> None:
    """Write the test and rig files that were used; the test refers to the rig file beside it."""
    # The recording contains both; on a full disk that must suffice.
    with contextlib.suppress(OSError, InputError):
        test = config.parse_test(session.test_toml, "session")
        text = config.dump(test.model_copy(update={"rig": "rig.toml"}))
        (folder / "test.toml").write_text(text, encoding="utf-8")
        (folder / "rig.toml").write_text(session.rig_toml, encoding="utf-8")


def _entry(
    run_id: str, place: Path, rec: RecordedTest, ticks: NDArray[Any], missing: list[list[int]]
) -> dict[str, Any]:
    return {
        "run_id": run_id,
        "test_name": rec.meta["test_name"],
        "created_utc": rec.meta["created_utc"],
        "end_reason": rec.meta["end_reason"],
        "folder": place.parent.name,
        "rows": int(ticks.size),
        "ticks": [int(ticks[0]), int(ticks[-1])],
        "missing_rows": missing,
    }


# ---- the index ----------------------------------------------------------------------------------


def read_index(runs: Path) -> list[dict[str, Any]]:
    """Return every recorded test, oldest first; an incomplete line after a crash is skipped."""
    found: dict[str, dict[str, Any]] = {}
    try:
        lines = (runs / INDEX_NAME).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return []
    for line in lines:
        with contextlib.suppress(ValueError, KeyError, TypeError):
            entry = json.loads(line)
            found[entry["run_id"]] = entry
    return list(found.values())


def _append_to_index(runs: Path, entry: dict[str, Any]) -> None:
    line = json.dumps(entry, ensure_ascii=False).encode() + b"\n"
    fd = os.open(runs / INDEX_NAME, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o640)
    try:
        # After an incomplete line from a crash, start a new line.
        os.write(fd, b"\n" + line if _ends_torn(runs / INDEX_NAME) else line)
        os.fsync(fd)
    finally:
        os.close(fd)


def _ends_torn(path: Path) -> bool:
    with path.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return False
        file.seek(-1, os.SEEK_END)
        return file.read(1) != b"\n"


# ---- all of them --------------------------------------------------------------------------------


class Recorder:
    """Looks for rings of tests and records them; one for each folder of rings.

    Args:
        rings: folder of the rings; created if it is missing.
        runs: folder for the recordings.
        patience_s: time to wait for another recorder to end.

    Raises:
        RthybError: another recorder is running there, or a folder cannot be written.
    """

    def __init__(self, rings: Path, runs: Path, patience_s: float = 0.0) -> None:
        self.rings, self.runs = rings, runs
        ring.claim(rings)
        try:
            runs.mkdir(parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            self._lock = os.open(rings / _LOCK, flags, 0o600)
            # A user who could open the lock could hold it, and nothing would be recorded.
            os.fchmod(self._lock, 0o600)
        except OSError as error:
            raise RthybError(
                f"cannot be written ({error.strerror})", where=str(error.filename)
            ) from error
        if not _locked(self._lock, patience_s):
            os.close(self._lock)
            raise RthybError(f"{rings}: another recorder is already running here; stop it first")
        self._tapes: dict[Path, Tape] = {}
        self._passed: dict[Path, tuple[int, int]] = {}
        self._synced_s = self._said_s = 0.0
        self._faults: dict[Path, str] = {}
        self._given_up: dict[Path, str] = {}
        self._broken = ""
        self._again_s: dict[Path, float] = {}
        self._known = self._runs_with_ring()
        self._orphans = set(self.runs.glob(f"*/{PART_NAME}"))
        self._patience = _Patience(rings)
        self._patience.say(self.status())
        with self._patience.of("completing recordings that a reboot interrupted"):
            self._finish_orphans()

    def _runs_with_ring(self) -> set[str]:
        found = set()
        for path in ring.find(self.rings):
            with contextlib.suppress(InputError):
                found.add(str(_session(path).meta["service"]["run_id"]))
        return found

    # A test whose ring was lost in a reboot: what was written is its recording.
    def _finish_orphans(self) -> None:
        for part in sorted(self._orphans):
            if time.monotonic() >= self._again_s.get(part, 0.0):
                with self._faulty(part):
                    self._finish_orphan(part)
                    self._orphans.remove(part)

    def _finish_orphan(self, part: Path) -> None:
        """Complete a file that has no ring, as far as it is readable.

        Raises:
            OSError, RthybError: it is not possible now, and is tried again later.
        """
        place = part.with_name(FILE_NAME)
        if place.exists():
            try:
                self._tidy(part.parent)
            except (InputError, KeyError, TypeError) as error:
                self._give_up(place, f"{error}; {part.name} beside it may be intact")
            return
        # A file that this user cannot open is not damaged.
        part.open("rb").close()
        try:
            session = recording.read(part, rows=False)
            run_id = str(session.meta["service"]["run_id"])
            _ = session.meta["test_name"], session.meta["created_utc"]
        except (InputError, KeyError, TypeError) as error:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno in REFUSED:
                raise
            aside = part.with_name(DAMAGED_NAME)
            part.replace(aside)
            self._give_up(aside, f"{error}; it cannot be repaired, and was renamed to {aside.name}")
            return
        if run_id not in self._known:
            with contextlib.closing(GrowingFile(part.parent, session)) as file:
                self._finish_without_ring(file, session)

    def _finish_without_ring(self, file: GrowingFile, session: RecordedTest) -> None:
        # Checked here, because opening the file truncated it to its last complete block.
        states, ticks = file.all_rows("state"), file.all_rows("tick")
        if not file.resumed:
            aside = file.folder / DAMAGED_NAME
            self._give_up(aside, f"{aside}: damaged; {ticks.size} of its rows could be read")
        if not (states > STATES.index("ARMED")).any():
            file.discard()
            return
        meta = session.meta | {
            "end_reason": "its process ended early; the ring is gone",
            "interrupted": bool((states == STATES.index("HOLD")).any()),
            "missing_rows": file.missing,
        }
        final = replace(session, meta=meta, replay=replace(session.replay, skips=_skips(file)))
        place = file.finish(final if not file.missing else replace(final, reference=None))
        _write_settings(file.folder, session)
        run_id = str(session.meta["service"]["run_id"])
        _append_to_index(self.runs, _entry(run_id, place, final, ticks, file.missing))
        log.warning("%s: completed without its ring, %d rows", place, ticks.size)

    def _give_up(self, path: Path, why: str) -> None:
        """Report a fault that cannot be corrected here; it remains as long as the path exists."""
        log.error("%s", why)
        self._given_up[path] = why

    def turn(self) -> None:
        """Look for new rings, write new rows, complete ended tests, publish the status."""
        with self._patience.of("writing"):
            self._finish_orphans()
        with self._patience.of("beginning"):
            self._find()
        for path, tape in tuple(self._tapes.items()):
            with self._faulty(path):
                over = tape.over
                with self._patience.of("writing"):
                    tape.turn()
                if over:
                    self._finish(path, tape)
        now = time.monotonic()
        if now - self._synced_s >= _SYNC_S:
            self._synced_s = now
            for tape in self._tapes.values():
                with self._patience.of("writing"):
                    self._sync(tape)
        if now - self._said_s >= _STATUS_S:
            self._said_s = now
            self._patience.say(self.status())

    def _sync(self, tape: Tape) -> None:
        # A full disk is reported with the next rows.
        with contextlib.suppress(NoRoomError, DiskFaultError), self._broken_disk():
            tape.file.sync()

    @contextlib.contextmanager
    def _broken_disk(self) -> Iterator[None]:
        """Remember a disk fault, because the system reports it only once."""
        try:
            yield
        except DiskFaultError as error:
            if not self._broken:
                log.error("%s", error)
            self._broken = self._broken or str(error)
            raise

    def _find(self) -> None:
        found = ring.find(self.rings)
        for path in found:
            identity = _identity(path)
            known = path in self._tapes or self._passed.get(path) == identity
            if known or identity is None or time.monotonic() < self._again_s.get(path, 0.0):
                continue
            with self._faulty(path):
                # A ring that is being created has no session yet: that is written last.
                whole = ring.session_path(path).is_file()
                try:
                    self._begin(path)
                    self._given_up.pop(path, None)
                except _NotOursError:
                    self._passed[path] = identity
                except InputError as error:
                    if whole and path.exists():
                        self._passed[path] = identity
                        self._give_up(path, f"this test is not being recorded: {_remedied(error)}")
        for path in set(self._faults) - set(found) - self._orphans:
            del self._faults[path]
        for path in tuple(self._given_up):
            if not path.exists():
                del self._given_up[path]

    def _begin(self, path: Path) -> None:
        session = _session(path)
        folder = _folder(self.runs, session)
        if (folder / FILE_NAME).exists():
            self._tidy(folder)
            ring.delete(path)
            return
        tape = self._tapes[path] = Tape(path, folder, session)
        how = f"continued at row {tape.file.next_row}" if tape.file.resumed else "recording"
        log.info("%s: %s, %s", path.name, how, folder)
        if (folder / DAMAGED_NAME).exists():
            log.error("%s: damaged; the rest is taken from the ring", folder / DAMAGED_NAME)

    # The previous process completed the recording, but not the steps after that.
    def _tidy(self, folder: Path) -> None:
        import h5py

        place = folder / FILE_NAME
        rec = recording.read(place, rows=False)
        with h5py.File(place, "r") as file:
            ticks = file["samples"].fields("tick")[()]
        run_id = str(rec.meta["service"]["run_id"])
        missing = rec.meta.get("missing_rows", [])
        _append_to_index(self.runs, _entry(run_id, place, rec, ticks, missing))
        (folder / PART_NAME).unlink(missing_ok=True)

    @contextlib.contextmanager
    def _faulty(self, path: Path) -> Any:
        try:
            with self._broken_disk():
                yield
            self._faults.pop(path, None)
        except (RthybError, OSError, RuntimeError) as error:
            if self._faults.get(path) != str(error):
                log.error("%s: %s", path.name, error)
            self._faults[path] = str(error)
            self._again_s[path] = time.monotonic() + _RETRY_S

    def _finish(self, path: Path, tape: Tape) -> None:
        with self._patience.of(f"completing {tape.file.folder.name}"):
            entry = tape.finish()
        del self._tapes[path]
        if entry is None:
            log.info("%s: nothing moved, so no recording is kept", path.name)
            return
        _append_to_index(self.runs, entry)
        ring.delete(path)
        log.info("%s: %s, %d rows", entry["folder"], entry["end_reason"], entry["rows"])

    def status(self) -> Status:
        """Return the current status."""
        try:
            free = disk.free_bytes(self.runs)
        except OSError:
            free = 0
        status = Status(
            pid=os.getpid(),
            at_s=time.monotonic(),
            runs=str(self.runs.resolve()),
            free_bytes=free,
            fault=_both(self._broken, *self._faults.values(), *self._given_up.values()),
            hinders=bool(self._faults or self._broken),
        )
        if not self._tapes:
            return status
        tape = list(self._tapes.values())[-1]
        return replace(
            status,
            run_id=tape.run_id,
            folder=str(tape.file.folder),
            rows=tape.file.rows,
            behind_rows=tape.behind,
            missing_rows=tape.file.missing,
        )

    @property
    def busy(self) -> bool:
        """Whether a recording is incomplete."""
        return bool(self._tapes)

    def close(self) -> None:
        """Close everything; the next recorder continues unfinished recordings."""
        for tape in self._tapes.values():
            ending = self._patience.of("writing")
            with contextlib.suppress(RthybError, OSError, RuntimeError), ending:
                tape.turn()
            tape.close()
        self._tapes.clear()
        self._patience.close()
        os.close(self._lock)


def _locked(lock: int, patience_s: float) -> bool:
    end = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= end:
                return False
            time.sleep(TURN_S)


def _remedied(error: InputError) -> str:
    if isinstance(error, ring.OtherVersionError):
        return f"{error}: restart rthyb-recorder whenever rthyb is restarted"
    return str(error)


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_ctime_ns


def run(rings: Path, runs: Path, done: Callable[[Recorder], bool]) -> None:
    """Record until ``done``.

    Args:
        rings, runs: as in `Recorder`.
        done: called before every turn; True ends the loop.

    Raises:
        RthybError: as `Recorder`.
    """
    recorder = Recorder(rings, runs, _PATIENCE_S)
    try:
        while not done(recorder):
            recorder.turn()
            time.sleep(TURN_S)
        # A PC that shuts down signals the daemon first: its test may just have ended, and the ring
        # does not survive the shutdown.
        recorder.turn()
    finally:
        recorder.close()
