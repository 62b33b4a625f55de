"""A whole test, from the first reading back to rest, whatever happens on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core, ring
from rthyb_rt.errors import InputError
from rthyb_rt.experiment import Progress, Setup
from rthyb_rt.links.wire import Wire
from rthyb_rt.loop import Clock, Link
from rthyb_rt.realtime.endings import WORDS, RefusedError, TimingError
from rthyb_rt.realtime.keeper import RECORDER_PERIOD_S, SILENCE_S
from rthyb_rt.realtime.session import LOOK_S, NEEDED, Session
from rthyb_rt.realtime.telling import Teller
from rthyb_rt.recording import FLAGS, Recording

if TYPE_CHECKING:
    from rthyb_rt.links.opened import Opened

FEEDBACK_S: Final = 10.0
"""How long good pairs of a drive that follows are waited for."""

_LOCK_S = 20.0
_AFTER_S = 0.1
_TARE_MARGIN_S = 2.0
_ATTEMPTS = 10


@dataclass
class Operator:
    """What the operator wants; another thread, or a signal handler, may set it.

    Attributes:
        stops: how often a stop was asked for: the first one ramps out, a second one trips.
    """

    stops: int = 0

    def stop(self) -> None:
        """Ask for a stop."""
        self.stops += 1


def run(
    setup: Setup,
    opened: Opened,
    *,
    clock: Clock = "host",
    folder: Path | None = None,
    before_tick: Callable[[], None] | None = None,
    progress: Progress | None = None,
    operator: Operator | None = None,
    require_realtime: bool = False,
    warn: Callable[[str], None] = lambda _: None,
    save: Callable[[Recording], None] | None = None,
    station: core.StationConfig | None = None,
    facts: Mapping[str, Any] | None = None,
    heard: Callable[[Session], None] = lambda _: None,
    zeroed: Callable[[Session], None] = lambda _: None,
) -> Recording:
    """Conduct a test: zero, arm, start, and back to rest, whatever happens on the way.

    Args:
        setup: the test.
        opened: the link to the drive; stays the caller's.
        clock, folder, before_tick: as in `Session`.
        progress: called with (ticks done, ticks of the test) now and then.
        operator: asks for a stop.
        require_realtime: refuse to run without `NEEDED`.
        warn: takes a sentence that the user should read while the test runs.
        save: puts the recording in its place; only then is the ring deleted.
        station, facts: as in `Session`.
        heard: called with the session once the drive answers, before anything moves.
        zeroed: called with the session between the tare and ARM, when nothing has moved; what it
            raises ends the test there.

    Returns:
        The recording, all rows from the first tick on. ``meta["real_time"]`` says how it went.

    Raises:
        TimingError: a privilege is missing that ``require_realtime`` demands; nothing moved.
        InputError: no feedback comes, or the drive does not follow; nothing moved.
        RthybError: something else failed. What moved is stopped, and the message names the ring
            that has the records.
    """
    with Session(
        setup,
        opened,
        clock=clock,
        folder=folder,
        before_tick=before_tick,
        station=station,
        facts=facts,
    ) as session:
        try:
            session.start()
            _check_privileges(session, require_realtime, warn)
            teller = Teller(progress or _no_progress, warn, at_once=clock == "stepped")
            try:
                conductor = _Conductor(session, operator or Operator(), teller)
                _hear(session, conductor)
                heard(session)
                _conduct(session, conductor, zeroed)
                session.close()
            finally:
                teller.close()
            rec = session.recording()
            if operator is not None and operator.stops and session.loop.cause == "none":
                rec.meta["end_reason"] = "stopped by the operator before it began"
            if save is not None:
                save(rec)
        except BaseException as error:
            session.close()
            _say_where(session, error)
            raise
        session.discard()
        return rec


def _no_progress(_: int, __: int) -> None:
    pass


def _say_where(session: Session, error: BaseException) -> None:
    """Leave the ring where it is worth something, and say so in the error."""
    if not session.has_moved:
        session.discard()
        return
    path = session.ring.path
    error.add_note(f"what was recorded is in {path}; make a recording of it: rthyb recover {path}")


def _check_privileges(session: Session, required: bool, warn: Callable[[str], None]) -> None:
    if session.clock == "stepped":
        return
    if not session.opened.real_time:
        warn(f"{session.opened.name}: a Python thread exchanges its frames, which is not real time")
    end = time.monotonic() + SILENCE_S
    # They are known once the thread, which locks memory first, has come to its first tick.
    while not session.loop.counts.elapsed and time.monotonic() < end:
        session.wait(LOOK_S)
    missing = [name.replace("_", " ") for name in NEEDED if name not in session.privileges]
    if not missing:
        return
    lacking = {"fifo": "real-time priority", "memory locked": "locked memory"}
    words = " and ".join(lacking[name] for name in missing)
    hint = "rthyb jitter says how to obtain them"
    if required:
        raise TimingError(
            f"the tick thread did not obtain {words}, which require_realtime demands; {hint}"
        )
    warn(f"the tick thread did not obtain {words}: ticks may be late or skipped; {hint}")


class AtLink(Protocol):
    """Whoever has a link open, with its end of the frames."""

    @property
    def opened(self) -> Opened: ...
    @property
    def wire(self) -> Wire: ...
    @property
    def link(self) -> Link: ...
    @property
    def recent_flags(self) -> NDArray[np.uint32]: ...


class _Conductor:
    """Waits for states, and lets the operator in meanwhile."""

    def __init__(
        self,
        session: Session,
        operator: Operator,
        teller: Teller,
    ) -> None:
        self._session, self._operator = session, operator
        self._progress, self.warn = teller.progress, teller.warn
        session.attended()
        self._given = 0
        self._held = False

    @property
    def stopped(self) -> bool:
        return self._given > 0

    def until(self, done: Callable[[], bool], most_s: float | None = None) -> bool:
        """Return True once ``done`` is, False when time or the operator's patience is over."""
        ticks = 0
        end = None if most_s is None else round(most_s * core.FS_HZ)
        begun_s = time.monotonic()
        while not done():
            if end is not None and self._passed(begun_s, ticks) >= end:
                return False
            self._session.wait(RECORDER_PERIOD_S)
            ticks += round(RECORDER_PERIOD_S * core.FS_HZ)
            self._progress(
                min(self._session.running_ticks, self._session.setup.ticks),
                self._session.setup.ticks,
            )
            self._tell_of_hold()
            if self._obey() and self._session.state in ("IDLE", "TRIPPED"):
                return done()
        return True

    def _tell_of_hold(self) -> None:
        held = self._session.state == "HOLD"
        if held and not self._held:
            words = WORDS.get(self._session.loop.cause, self._session.loop.cause)
            self.warn(f"held: {words}; the specimen stands until Ctrl-C brings it back to zero")
        self._held = held

    def _passed(self, begun_s: float, ticks: int) -> float:
        stepped = self._session.clock == "stepped"
        return ticks if stepped else (time.monotonic() - begun_s) * core.FS_HZ

    def _obey(self) -> bool:
        """Pass on what the operator asked for; True if that was ever anything."""
        asked = min(self._operator.stops, 2)
        while self._given < asked:
            self._given += 1
            with suppress(RefusedError):
                self._session.command("stop" if self._given == 1 else "trip")
        return self._given > 0


def _hear(session: Session, conductor: _Conductor) -> None:
    if not conductor.until(session.follows, FEEDBACK_S) and not conductor.stopped:
        raise InputError(no_feedback(session), session.opened.name)
    locked = session.clock != "link" or conductor.until(lambda: session.loop.locked, _LOCK_S)
    if not locked and not conductor.stopped and session.state != "TRIPPED":
        conductor.warn(
            "the ticks do not keep step with the drive's samples: its clock is off by more than "
            "200 ppm, or its frames come irregularly"
        )


def _conduct(session: Session, conductor: _Conductor, zeroed: Callable[[Session], None]) -> None:
    commands: tuple[core.Command, ...] = ("zero", "arm", "start")
    for command in commands:
        if conductor.stopped or session.state == "TRIPPED":
            break
        _lead(session, conductor, command)
        if session.state == "ZEROED":
            zeroed(session)
            if session.clock != "stepped":
                # It may have taken its time: a sign of life before anything moves.
                session.wait(2 * RECORDER_PERIOD_S)
    conductor.until(lambda: session.state in ("IDLE", "TRIPPED"))
    # After a trip the black box: a second of what came then.
    rest_s = 1.1 * ring.AFTER_TRIP / core.FS_HZ if session.state == "TRIPPED" else _AFTER_S
    for _ in range(round(rest_s / RECORDER_PERIOD_S)):
        session.wait(RECORDER_PERIOD_S)


def _lead(session: Session, conductor: _Conductor, command: core.Command) -> None:
    """Give a command; after "zero" wait for the end of the tare."""
    for attempt in range(_ATTEMPTS):
        try:
            session.command(command)
            break
        except RefusedError as error:
            if session.state == "TRIPPED" or conductor.stopped:
                return
            # A tick without a fresh pair is none to start in; the next one may be.
            if attempt == _ATTEMPTS - 1:
                raise RefusedError(f"{error}: {_why_refused(session)}") from error
            session.wait(RECORDER_PERIOD_S)
    if command != "zero":
        session.renew()
        return
    tare_s = session.config.tare_ticks / core.FS_HZ
    zeroed = conductor.until(lambda: session.state != "IDLE", tare_s + _TARE_MARGIN_S)
    if not zeroed and not conductor.stopped:
        raise InputError(_not_zeroed(session, tare_s), session.opened.name)
    session.renew()


def _why_refused(session: Session) -> str:
    limit = session.config.watches.get("position")
    x_m = session.displacement_m
    if limit is None or abs(x_m) <= limit.value:
        return "the drive does not answer in every tick, or has stopped by itself"
    return (
        f"the specimen stands at {x_m * 1e3:.3g} mm, beyond the position limit of "
        f"{limit.value * 1e3:g} mm; bring it back to its middle"
    )


def _not_zeroed(session: Session, tare_s: float) -> str:
    if not session.follows():
        return f"the feedback stopped while it was zeroed; {no_feedback(session)}"
    x_m = session.spread(session.config.tare_ticks)
    return (
        f"the rig is not at rest: the displacement moved by {x_m * 1e3:.3g} mm during the tare of "
        f"{tare_s:g} s, allowed is {session.config.rest_spread_m * 1e3:.3g} mm "
        "(limits.rest_spread_m); let it come to rest, or look at its sensor"
    )


def _no_more(recent: NDArray[np.uint32]) -> str:
    """Return in words why pairs that came do not count any more."""
    if (recent & FLAGS["stopped"]).any():
        return (
            "the drive reports that it has stopped, and does not follow; release it at its own "
            "panel, and look why it stopped"
        )
    if (recent & FLAGS["fresh"]).any():
        return "the feedback was interrupted a moment ago; try again"
    return (
        "the drive has gone silent: no pair of displacement and force comes any more; is it "
        "switched on, and its cable in place?"
    )


def no_feedback(session: AtLink) -> str:
    """Return in words why good pairs of a drive that follows do not come."""
    if session.opened.failure is not None:
        return f"the thread that exchanges its frames gave up: {session.opened.failure}"
    counters, pieces = session.wire.counters(), session.link.counters()["pieces_in"]
    if session.link.down != "up":
        return f"the link is down ({session.link.down}); check cable, power and interface"
    if counters["pairs"]:
        return _no_more(session.recent_flags)
    if counters["frames"] or pieces:
        bad = {k: n for k, n in counters.items() if n and k not in ("sent", "frames", "stale")}
        told = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in bad.items())
        return (
            f"{counters['frames']} frames came in {FEEDBACK_S:g} s, but no pair of displacement "
            f"and force ({told or 'none was complete'}); check the DBC, or the drive's frames"
        )
    return (
        f"nothing came in {FEEDBACK_S:g} s; is the drive switched on, and does it send "
        "displacement and force 1024 times a second?"
    )
