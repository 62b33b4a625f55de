"""Sources of the live view's rows: a service, the ring of a test, or a recording."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core, numbers
from rthyb_rt.analysis import several_axes, summary
from rthyb_rt.analysis.attention import WINDOW_S, AxesJudge, Judge
from rthyb_rt.analysis.notices import attention_in_words, axis_attention_in_words
from rthyb_rt.config import AxesRig
from rthyb_rt.core import RUNNING, STATES, Channel, mapped_ring
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import realtime
from rthyb_rt.lab.end_reasons import in_words, shown_of
from rthyb_rt.live.shown_rows import CHANNELS, History, Tally, channels
from rthyb_rt.record import recording, ring
from rthyb_rt.record.recording import RecordedTest, open_run
from rthyb_rt.service.control import SOCKET, Client, Refusal, UnreachableError
from rthyb_rt.service.peers import Peer, Rights, Role

KEPT_ROWS: Final = 2 * mapped_ring.CAPACITY
"""128 s: a test that has just ended remains visible."""

_CHUNK: Final = 2048
_TRIPPED: Final = STATES.index("TRIPPED")
_OFF_COURSE: Final = ("HOLD", "RAMP_OUT", "TRIPPED")
_STILL_S: Final = 1.0
"""Longest delay of a process on a machine that is suitable for a test."""
_ANSWER_S: Final = 2.0


class PageSource(Protocol):
    """A source for a page.

    Attributes:
        history: the available rows.
        zero: position of time zero: the first RUNNING row.
        fs_hz: rows per second.
        state: state of the newest row, "" without one.
        socket: control socket of the service that accepts HOLD and STOP, or None.
        past: whether no further rows will come.
    """

    history: History
    zero: int
    fs_hz: float
    socket: Path | None
    past: bool

    @property
    def state(self) -> str:
        """Name of the newest row's state."""

    def poll(self) -> None:
        """Read new rows."""

    def look(self) -> None:
        """Do slow look-ups; may be called from any thread."""

    def status(self) -> dict[str, Any]:
        """Return everything to display besides the rows."""

    def close(self) -> None:
        """Close files and sockets."""


def open_source(where: Path | None, service: Path) -> PageSource:
    """Return the source that a user specified.

    Args:
        where: a recording or the folder of a run, a ring, a folder of rings, a control socket;
            None: the service, or the newest ring of this user.
        service: the control socket to use then.

    Raises:
        InputError: no such source exists.
    """
    if where is None:
        return _of_user(service)
    # The service may be started later.
    if where.is_socket() or where.name == SOCKET.name:
        return LiveSource(where.parent, where)
    if where.is_dir():
        return _of_folder(where)
    if where.name.startswith("ring.") and where.suffix != ".h5":
        with ring.RingReader(where):
            return LiveSource(where, None)
    return PastSource(open_run(where))


def _of_user(service: Path) -> PageSource:
    if service.is_socket():
        return LiveSource(service.parent, service)
    folder = ring.trusted(ring.default_folder())
    if ring.find(folder):
        return LiveSource(folder, None)
    raise InputError(
        f"no service answers at {service} and there is no ring (telemetry buffer of a running "
        f"test) in {folder}; start rthyb serve or rthyb run --realtime, or give a recording"
    )


def _of_folder(folder: Path) -> PageSource:
    """Return the service, the newest ring or the recording of a folder."""
    socket = folder / SOCKET.name
    if socket.is_socket():
        return LiveSource(folder, socket)
    if ring.find(folder):
        return LiveSource(folder, None)
    return PastSource(open_run(folder))


# ---- a running test -----------------------------------------------------------------------------

_Identity = tuple[int, int]
"""Device and inode of a ring: a new one may get the same name, the lowest free number."""


def _identity(path: Path) -> _Identity | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


class _Evaluator(Protocol):
    """Evaluates the running test, with one axis or several."""

    def add(self, rows: NDArray[np.void], reference: NDArray[np.float64] | None) -> None:
        """Add rows of the test proper, in order, with the reference simulation at these rows."""

    def in_words(self, *, over: bool) -> list[str]:
        """Return the problems found so far, in sentences."""


class _OfOne:
    """Evaluates a test with one axis."""

    def __init__(self, given: summary.SummarySettings, fs_hz: float) -> None:
        self._given, self._judge = given, Judge(summary.subject(given, fs_hz))
        self.add = self._judge.add

    def in_words(self, *, over: bool) -> list[str]:
        found = self._judge.findings(over=over)
        return [attention_in_words(one, self._given, found) for one in found]


class _OfSeveral:
    """Evaluates a test with several axes."""

    def __init__(self, judge: AxesJudge, controller: str) -> None:
        self._judge, self._controller = judge, controller
        self.add = judge.add

    def in_words(self, *, over: bool) -> list[str]:
        found = self._judge.findings(over=over)
        return [axis_attention_in_words(axis, one, self._controller) for axis, one in found]


@dataclass(frozen=True)
class _Session:
    """Data for the evaluation of a ring's test.

    Attributes:
        identity: identity of the ring.
        evaluator: creates the evaluation.
        reference: the reference simulation, empty without one: shape (n,), or (n, axes).
        extras: extra channels of the rig, and its sensors without an actuator.
        axes: names of the axes, if several.
        directions: names of the directions, with the unit of their stiffness, if several.
        tie: kinematics from the interface to the axes.
    """

    identity: _Identity
    evaluator: Callable[[], _Evaluator]
    reference: NDArray[np.float64]
    extras: tuple[Channel, ...] = ()
    axes: tuple[str, ...] = ()
    directions: tuple[dict[str, str], ...] = ()
    tie: Kinematics | None = None

    @classmethod
    def of(cls, rec: RecordedTest, identity: _Identity) -> _Session:
        """Return the data from the session file beside the ring."""
        if rec.axis_names:
            rig, test = several_axes.files(rec)
            reference = several_axes.reference(rec, rig, test)
            return cls(
                identity,
                lambda: _OfSeveral(
                    several_axes.axes_judge(rig, reference, rec.fs_hz), test.controller.type
                ),
                reference.axis_m,
                rec.extras() + rec.lone_sensors(),
                axes=rec.axis_names,
                directions=_directions(rig),
                tie=rig.core_kinematics(),
            )
        given = summary.setup(rec)
        x_ref_m = np.zeros(0) if rec.reference is None else rec.reference["x_ref_m"]
        return cls(identity, lambda: _OfOne(given, rec.fs_hz), x_ref_m, rec.extras())


class LiveSource:
    """Rows of a ring as they arrive, and of the rings that follow it.

    Args:
        place: the ring, or the folder in which the newest one is used.
        socket: the service's control socket, or None.
    """

    past = False
    fs_hz: float = core.FS_HZ

    def __init__(self, place: Path, socket: Path | None) -> None:
        self.history, self.zero = History(KEPT_ROWS), 0
        self.socket = socket
        self._place = place
        self._tally = Tally()
        self._wanted: Path | None = None
        self._seen: _Identity | None = None
        self._reader: ring.RingReader | None = None
        # While this file is mapped, no other file can have the same identity.
        self._held: _Identity | None = None
        self._at_rest = False
        self._offset: int | None = None
        self._began = False
        self._came_s = self._polled_s = time.monotonic()
        self._shut = self._unanswered = ""
        self._client: Client | None = None
        self._service: dict[str, Any] | None = None
        self._cause: tuple[_Identity | None, str] = (None, "")
        self._session: _Session | None = None
        self._newest: NDArray[np.void] | None = None
        self._evaluator: _Evaluator | None = None
        self._whole, self._judged = False, 0
        self._attended: tuple[float, list[str]] = (-WINDOW_S, [])
        self.look()

    # ---- rows -----------------------------------------------------------------------------------

    def poll(self) -> None:
        """Read new rows; change to another ring if there is one."""
        self._drain()
        if self._wanted is not None and (self._reader is None or self._replaced()):
            self._turn_to(self._wanted, self._seen)
            self._drain()
        self._polled_s = time.monotonic()
        if not self._due():
            self._came_s = self._polled_s

    def _due(self) -> bool:
        """Whether rows are expected: from a process with a test, from a service also at rest."""
        reader = self._reader
        if reader is not None and reader.frozen and not self._replaced():
            return False
        if self.socket is not None:
            return self._service is not None
        return reader is not None and reader.alive and reader.pushed > 0

    def _replaced(self) -> bool:
        """Whether the desired ring exists and differs from the one being read."""
        return self._seen is not None and self._seen != self._held

    def _turn_to(self, path: Path, seen: _Identity | None) -> None:
        try:
            reader = ring.RingReader(path)
        except (InputError, OSError) as error:
            # It may have disappeared again; the next look-up shows.
            self._shut = str(error)
            return
        if _identity(path) != seen:
            # The result of the last look-up belongs to another ring.
            reader.close()
            return
        if self._reader is not None:
            self._reader.close()
        self._reader, self._held, self._shut, self._offset = reader, seen, "", None
        self._came_s = time.monotonic()
        service = self._service
        self._at_rest = service is not None and not service["run_id"]
        if not self._at_rest:
            self._tally, self._began = Tally(), False
            session = self._session
            self._evaluator = None
            if session is not None and session.identity == seen:
                self._evaluator = session.evaluator()
            # From the first row on; otherwise the rows of the reference could not be assigned.
            self._whole, self._judged = reader.next == 0, 0
            self._attended = (-WINDOW_S, [])
        elif self.history.size:
            # Only the most recent rest before the finished test is relevant.
            while reader.read(_CHUNK).samples.size:
                pass

    def _drain(self) -> None:
        reader = self._reader
        if reader is None:
            return
        while (rows := reader.read(_CHUNK).samples).size:
            self._came_s = time.monotonic()
            self._newest = rows[-1:].copy()
            if self._at_rest:
                # A trip remains on the screen until it is reset.
                rows = rows[rows["state"] != _TRIPPED]
            else:
                self._tally.add(rows)
                self._evaluate(rows)
            self._take(rows)

    def _evaluate(self, rows: NDArray[np.void]) -> None:
        """Evaluate the rows of the test proper, with its reference unless rows were missed."""
        evaluator, session, reader = self._evaluator, self._session, self._reader
        if evaluator is None or session is None or reader is None:
            return
        running = rows[rows["state"] == RUNNING]
        self._whole = self._whole and reader.lost == 0
        reference = session.reference[self._judged : self._judged + running.size]
        evaluator.add(running, reference if self._whole else None)
        self._judged += running.size

    def _take(self, rows: NDArray[np.void]) -> None:
        """Append rows; another station counts its ticks from zero."""
        tick = rows["tick"].astype(np.int64)
        for part in np.split(np.arange(tick.size), np.flatnonzero(np.diff(tick) <= 0) + 1):
            if part.size:
                self._append(rows[part], tick[part])

    def _append(self, rows: NDArray[np.void], tick: NDArray[np.int64]) -> None:
        last = self.history.last
        if self._offset is None or not last < tick[0] + self._offset <= last + KEPT_ROWS:
            self._offset = last + 1 - int(tick[0])
            if not self._began:
                self.zero = last + 1
        at = tick + self._offset
        running = np.flatnonzero(rows["state"] == RUNNING)
        if running.size and not self._began:
            self.zero, self._began = int(at[running[0]]), True
        session = self._session
        tie = session.tie if session is not None and session.identity == self._held else None
        self.history.append(at, channels(rows, tie), rows["state"])

    # ---- slow look-ups
    # ------------------------------------------------------------------------------

    def look(self) -> None:
        """Query the service, find the newest ring, and the cause of an interrupted test."""
        self._service = self._ask() if self.socket is not None else None
        if self._service is not None:
            self._wanted = Path(self._service["ring"])
        elif self._place.is_dir():
            # A ring may disappear meanwhile.
            with contextlib.suppress(OSError, InputError):
                self._wanted = _newest(self._place, self._wanted, self._held)
        else:
            self._wanted = self._place
        if self._wanted is not None and (self.socket is None or self._service is not None):
            self._seen = _identity(self._wanted)
            self._find_session(self._wanted, self._seen)
        if self._service is None:
            self._find_cause()

    def _ask(self) -> dict[str, Any] | None:
        assert self.socket is not None
        try:
            if self._client is None:
                self._client = Client(self.socket, _ANSWER_S)
            found: dict[str, Any] = self._client.call("GetStatus")["status"]
            return found
        except (UnreachableError, Refusal) as error:
            self._hang_up()
            self._unanswered = str(error)
            return None

    def _hang_up(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def _find_session(self, path: Path, seen: _Identity | None) -> None:
        """Read the data for evaluating a ring's test."""
        if seen is None or (self._session is not None and self._session.identity == seen):
            return
        # It may be unreadable, or may have disappeared: then nothing is evaluated.
        with contextlib.suppress(RthybError, OSError):
            rec = recording.read(ring.session_path(path), rows=False)
            self._session = _Session.of(rec, seen)
            self.fs_hz = rec.fs_hz

    def _find_cause(self) -> None:
        """Determine what the rows do not contain: which limit was the cause."""
        path, held, (known, cause) = self._wanted, self._held, self._cause
        if path is None or self.state not in _OFF_COURSE or (known == held and cause):
            return
        if self._seen != held:
            return
        # Its process may still be writing the file; the next look-up will find it.
        with contextlib.suppress(RthybError):
            cause = realtime.first_cause_in_words(ring.recover(path).recording)
            self._cause = (held, cause)

    @property
    def state(self) -> str:
        """Name of the newest row's state."""
        return _state_of(self.history)

    # ---- words ----------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """Return everything to display besides the rows."""
        service = self._service
        # Rows that arrived since the last poll have not been read yet.
        still_s = max(self._polled_s - self._came_s, 0.0)
        found = _nothing() if service is None else _of_service(service)
        if self.socket is None:
            known, cause = self._cause
            found |= {
                "state": self.state,
                "cause": cause if known == self._held else "",
                "test": "" if self._wanted is None else self._wanted.name,
                "ended": self._reader is not None and not self._reader.alive,
                "end_reason": self._end(),
            }
            newest = None if self._reader is None else self._reader.newest()
            found["axes"] = list(self._axes())
            found["now"] = None if newest is None else self._now(newest)
        session = self._session
        if session is not None and session.identity == self._held:
            found["directions"] = list(session.directions)
        return found | {
            "mode": "ring" if self.socket is None else "service",
            "reachable": self.socket is None or service is not None,
            "trouble": self._unanswered if self.socket and service is None else self._shut,
            "flows": still_s < _STILL_S,
            "still_s": still_s,
            "role": "" if self.socket is None else _role(self.socket),
            "attention": self._attention(),
            "counters": [*_counters(self._tally), *found["counters"], *self._extras()],
            "wake": _wake(self._tally),
        }

    def _axes(self) -> tuple[str, ...]:
        """Return the names of the axes of the ring that is read, if several."""
        session = self._session
        return session.axes if session is not None and session.identity == self._held else ()

    def _now(self, newest: np.void) -> list[float | None]:
        """Return the channels of the newest record of the ring."""
        row = np.array([newest], dtype=newest.dtype)
        tie = self._session.tie if self._axes() and self._session is not None else None
        return _plain(channels(row, tie)[:, 0])

    def _extras(self) -> list[dict[str, Any]]:
        """Return the newest readings of the rig's extra channels."""
        session = self._session
        if session is None or self._newest is None or session.identity != self._held:
            return []
        return _readings(session.extras, self._newest)

    def _attention(self) -> list[str]:
        """Return the problems found in the test so far, in sentences."""
        evaluator = self._evaluator
        if evaluator is None:
            return []
        # Figures that change four times a second are unreadable, also for screen readers.
        now, (since, sentences) = time.monotonic(), self._attended
        if now - since >= WINDOW_S:
            sentences = evaluator.in_words(over=self.state in ("IDLE", "TRIPPED"))
            self._attended = (now, sentences)
        return sentences

    def _end(self) -> str:
        reader = self._reader
        if reader is None or reader.alive:
            return ""
        return "the test is over" if reader.closed else "its process ended early"

    def close(self) -> None:
        """Close ring and socket."""
        self._hang_up()
        if self._reader is not None:
            self._reader.close()


def _newest(folder: Path, present: Path | None, held: _Identity | None) -> Path | None:
    """Return the newest ring in use, else the newest; ``present`` if none is newer.

    Args:
        folder: folder of the rings.
        present: the ring used so far.
        held: the ring being read; another one under the name of ``present`` is newer.

    Raises:
        OSError, InputError: a ring disappeared, or is incomplete.
    """
    rings = ring.find(folder)
    if not rings or (rings[-1] == present and _identity(present) == held):
        return present
    for path in reversed(rings):
        with ring.RingReader(path) as reader:
            if reader.alive:
                return path
    return present or rings[-1]


def _state_of(history: History) -> str:
    if not history.size:
        return ""
    number = int(history.rows(history.last, history.last + 1)[2][0])
    return STATES[number] if number < len(STATES) else ""


def _nothing() -> dict[str, Any]:
    return {
        "state": "",
        "cause": "",
        "allowed": [],
        "rig": "",
        "test": "",
        "link": "",
        "progress": None,
        "indicated": [],
        "attention": [],
        "armed_by": "",
        "tare": "",
        "last": None,
        "counters": [],
        "now": None,
        "axes": [],
        "directions": [],
        "ended": False,
        "end_reason": "",
    }


def _directions(rig: AxesRig) -> tuple[dict[str, str], ...]:
    """Return name and unit of stiffness of each direction, as plotted: a millionth of SI units."""
    return tuple(
        {"name": name, "unit": "MN m/rad" if turns else "kN/mm"}
        for name, turns in zip(rig.directions, rig.kinematics.turns(), strict=True)
    )


def _of_service(found: dict[str, Any]) -> dict[str, Any]:
    test, cause = found["test"], found["cause"]
    progress, rate_hz = found["progress"], found["sample_rate_hz"]
    return _nothing() | {
        "state": found["state"],
        "cause": "" if cause in ("none", "completed") else shown_of(found),
        "allowed": found["allowed"],
        "rig": found["rig"],
        "test": "" if test is None else test["name"],
        "digest": "" if test is None else test["digest"],
        "link": found["link"],
        "follows": found["follows"],
        "progress": None
        if test is None or not found["run_id"]
        else [progress["ticks"] / rate_hz, progress["of"] / rate_hz],
        "indicated": found["indicated"],
        "armed_by": found["armed_by"],
        "tare": numbers.tare_of_status(found["tare"]),
        "last": found["last"],
        "counters": list(_recorder(found["recorder"])),
        "axes": list(found.get("axes") or ()),
        "now": None if found["newest"] is None else _now_of(found),
    }


def _now_of(found: dict[str, Any]) -> list[float | None]:
    """Return the channels of the newest record, axis by axis, as reported by the service.

    The tangent stiffness of several axes is that of the direction of the same number.
    """
    newest = found["newest"]
    axes = (found.get("axes") or {}).values()
    stiff = [one.get("k_t") for one in (found.get("directions") or {}).values()]
    stiff += [None] * (len(axes) - len(stiff))
    each = [
        {**newest, "k_t_n_per_m": k_t, **own} for k_t, own in zip(stiff, axes, strict=False)
    ] or [newest]
    return [value for one in each for value in _now(one)]


def _now(newest: dict[str, Any]) -> list[float | None]:
    """Return the channels that the service reports for one axis."""
    names = {c.field for c in CHANNELS} | {c.less for c in CHANNELS if c.less is not None}
    row = np.zeros(1, dtype=[(name, np.float64) for name in sorted(names)])
    for name in names:
        value = newest[name]
        row[name] = np.nan if value is None else value
    return _plain(channels(row)[:, 0])


def _plain(values: NDArray[np.float32]) -> list[float | None]:
    return [None if np.isnan(value) else float(value) for value in values]


def _counter(label: str, value: object, alarm: bool = False) -> dict[str, Any]:
    return {"label": label, "value": str(value), "alarm": alarm}


def _readings(extras: Iterable[Channel], row: NDArray[np.void]) -> list[dict[str, Any]]:
    """Return extra channels of one row, (1,), by name and in their unit."""
    found = []
    for one in extras:
        if one.name in (row.dtype.names or ()):
            value = numbers.number(one.scale * float(row[one.name][0]), 4)
            found.append(_counter(one.name, f"{value} {one.unit}".strip()))
    return found


def _counters(tally: Tally) -> Iterable[dict[str, Any]]:
    yield _counter("Ticks", tally.rows)
    yield _counter("Skipped", tally.skipped, tally.skipped > 0)
    for name, label in (
        ("lost", "Pairs lost"),
        ("predicted", "Predicted"),
        ("slip", "Slips"),
        ("not_sent", "Not sent"),
        ("limited", "Limited"),
    ):
        count = tally.flags[name]
        yield _counter(label, count, count > 0 and name != "limited")


def _recorder(found: dict[str, Any]) -> Iterable[dict[str, Any]]:
    if not found["wanted"]:
        yield _counter("Recorder", "none")
        return
    if not found["alive"] or found["fault"]:
        yield _counter("Recorder", found.get("fault") or "does not respond", True)
        return
    lost = sum(last - first + 1 for first, last in found["missing_rows"])
    yield _counter("Recorded", found["rows"] if found["run_id"] else "ready")
    yield _counter("Rows lost", lost, lost > 0)
    yield _counter("Disk free", f"{found['free_bytes'] / 1e9:.1f} GB")


def _wake(tally: Tally) -> dict[str, Any]:
    return {
        "counts": tally.counts.tolist(),
        "p50_us": tally.percentile_us(50.0),
        "p99_us": tally.percentile_us(99.0),
        "max_us": tally.longest_ns * 1e-3,
    }


def _role(socket: Path) -> str:
    """Return what this process may do, for the page; the service makes its own decision."""
    try:
        owner = socket.stat().st_uid
    except OSError:
        return "none"
    groups = Rights.of_system()
    me = Peer(os.getpid(), os.geteuid(), frozenset((os.getegid(), *os.getgroups())))
    return Rights(groups.lookers, groups.operators, owner).role(me).name.lower()


MAY_HOLD: Final = tuple(role.name.lower() for role in (Role.LOOK, Role.OPERATE))


# ---- a recorded test ----------------------------------------------------------------------------


class PastSource:
    """All rows of a recording at once.

    Args:
        rec: the recording.

    Raises:
        InputError: it has no rows.
    """

    past = True

    def __init__(self, rec: RecordedTest) -> None:
        samples = rec.samples
        self.socket: Path | None = None
        if not samples.size:
            raise InputError("the recording has no rows, so there is nothing to show")
        self.fs_hz = rec.fs_hz
        self.history = History(samples.size)
        at = _positions(samples["tick"])
        rig = several_axes.files(rec)[0] if rec.axis_names else None
        self._directions = () if rig is None else _directions(rig)
        tie = None if rig is None else rig.core_kinematics()
        self.history.append(at, channels(samples, tie), samples["state"].astype(np.uint8))
        self.zero = int(at[np.argmax(rec.running())])
        self._tally = Tally()
        self._tally.add(samples)
        if not isinstance(rec.meta.get("real_time"), dict):
            # No thread woke for these ticks: they were computed.
            self._tally.forget_waking()
        self._rec = rec
        self._cause, self._alarms = "", list[str]()
        # For several axes the cause is part of the end reason.
        if rec.axis_names:
            if rec.running().any():
                notices = several_axes.notices(several_axes.summarize(rec))
                self._alarms = [n.text for n in notices if n.level == "alarm"]
        else:
            found = summary.summarize(rec)
            cause = "" if found.ended_by is None else found.ended_by.cause
            self._cause = found.ending or (in_words(cause) if cause else "")
            self._alarms = [n.text for n in summary.notices(found) if n.level == "alarm"]

    def poll(self) -> None:
        """Do nothing: no rows arrive."""

    def look(self) -> None:
        """Do nothing: no look-ups are needed."""

    def close(self) -> None:
        """Do nothing: no resources are open."""

    @property
    def state(self) -> str:
        """Name of the newest row's state."""
        return _state_of(self.history)

    def status(self) -> dict[str, Any]:
        """Return everything to display besides the rows."""
        meta = self._rec.meta
        found = _nothing() | {
            "state": self.state,
            "cause": self._cause,
            "axes": list(self._rec.axis_names),
            "directions": list(self._directions),
            "attention": self._alarms,
            "test": str(meta.get("test_name", "")),
            "ended": True,
            "end_reason": str(meta.get("end_reason", "")),
            "created_utc": str(meta.get("created_utc", "")),
            "counters": [
                *_counters(self._tally),
                *_readings(self._rec.extras() + self._rec.lone_sensors(), self._rec.samples[-1:]),
            ],
        }
        return found | {
            "mode": "past",
            "reachable": True,
            "trouble": "",
            "flows": True,
            "still_s": 0.0,
            "role": "",
            "wake": _wake(self._tally),
        }


def _positions(tick: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return the ticks as positions; if they do not increase, the row numbers."""
    if tick.size and int(tick.max()) < 2**52:
        at = tick.astype(np.int64)
        if np.all(np.diff(at) > 0):
            return at
    return np.arange(tick.size, dtype=np.int64)
