"""The drive's own stop: when commands cease, and when it is sent TRIPPED.

Both are provoked at rest. The reaction is read from the drive's own frames: the status bit that
reports the stop, the command that had been applied by then, and the sample counter. Being late does
not affect any of these, so the result does not depend on the PC.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rthyb_rt import core
from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.core.loop import WATCHDOG_TICKS
from rthyb_rt.core.wire import DEVICE_STOPPED, VERDICTS, Feedback
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.lab.realtime import FEEDBACK_S, RefusedError, Session
from rthyb_rt.rig.commissioning.guided_motion import (
    ATTEMPTS,
    Connection,
    GuidedMotion,
    Rows,
    command_numbers,
    fresh,
    station_of,
)

TRIP_TICKS: Final = 1
"""Samples of the drive from the command with TRIPPED to the beginning of its stop."""

_SILENCES: Final = 4
"""Multiple of the watchdog time without a command after which the watchdog has failed."""
_SILENCE_S: Final = 2.0
_AFTER_TRIP_S: Final = 0.25
_REST_S: Final = 0.25
_STANDS_S: Final = 0.5
"""A drive that stays stopped for this long although commands arrive counts as latched."""
_BYTE: Final = 0x100
_PAIR: Final = VERDICTS["pair"]


@dataclass(frozen=True)
class Stop:
    """How a drive stopped.

    Attributes:
        stopped: whether it reported a stop.
        ticks: its samples from the last command, or from the first with TRIPPED, to the report;
            None if its frames do not show that.
        gap: frames are missing there, so that the true number may be smaller.
        seen_again: it still reported the stop when the next connection began; None without one.
        stays: it kept reporting the stop, although commands arrived, until it was reset.
        released: it followed again after a reset; None if its frames have no reset command.
    """

    stopped: bool
    ticks: int | None = None
    gap: bool = False
    seen_again: bool | None = None
    stays: bool | None = None
    released: bool | None = None


def watchdog_ticks(connection: Connection) -> int:
    """Return the drive's samples after which its watchdog should stop it: 19.5 ms."""
    return connection.rig.rate.ticks(WATCHDOG_TICKS / core.FS_HZ)


def _without_gap(attempt: Callable[[], Stop]) -> Stop:
    """Repeat until no frames are missing where it matters; at most `ATTEMPTS` times."""
    stop = Stop(False)
    for _ in range(ATTEMPTS):
        stop = attempt()
        if not stop.gap:
            break
    return stop


def watchdog(connection: Connection) -> Stop:
    """Stop sending without notice, observe the drive's own stop, then connect again.

    Raises:
        InputError: there is no feedback.
        RthybError: the system denied what is needed.
    """
    return _without_gap(lambda: _in_silence(connection))


def trip(connection: Connection) -> Stop:
    """Trip at rest and observe whether the drive stops on that command.

    Raises:
        InputError: there is no feedback.
        RthybError: the system denied what is needed.
    """
    return _without_gap(lambda: _by_trip(connection))


def release(connection: Connection) -> bool:
    """Reset a drive that has stopped by itself; return False if it had not stopped.

    Raises:
        InputError: there is no feedback.
        RefusedError: the drive is not at rest, or does not follow after the reset.
        RthybError: the system denied what is needed.
    """
    with _begun(connection) as session:
        if _await(session, session.follows, _STANDS_S):
            return False
        if not session.stays_stopped():
            raise InputError(session.no_feedback(), session.opened.name)
        session.command("reset")
        _await(session, session.follows, _STANDS_S)
        return True


@contextmanager
def at_rest(connection: Connection) -> Iterator[Session]:
    """Yield a session in IDLE, with a drive that follows.

    Raises:
        InputError: there is no feedback, or the drive does not follow.
        RthybError: the system denied what is needed.
    """
    with _begun(connection) as session:
        _await(session, lambda: session.follows() or session.stays_stopped(), FEEDBACK_S)
        if connection.resets and session.stays_stopped():
            session.command("reset")
        if not _await(session, session.follows, FEEDBACK_S):
            raise InputError(session.no_feedback(), session.opened.name)
        session.wait(_REST_S)
        yield session


@contextmanager
def _begun(connection: Connection) -> Iterator[Session]:
    motion = GuidedMotion("at-rest", np.zeros(1))
    setup = experiment.prescribed(connection.rig, motion.name, motion.path_m)
    with Session(
        setup,
        connection.opened,
        clock=connection.clock,
        before_tick=connection.before_tick,
        station=station_of(setup, motion),
    ) as session:
        try:
            session.start()
            yield session
        finally:
            session.close()
            session.discard()


def _await(session: Session, done: Callable[[], bool], most_s: float) -> bool:
    begun_s = session.now_s
    while not done():
        if session.now_s - begun_s > most_s:
            return False
        session.wait(realtime.RECORDER_PERIOD_S)
    return True


# ---- silence ------------------------------------------------------------------------------------


def _in_silence(connection: Connection) -> Stop:
    with at_rest(connection) as session:
        session.fall_silent()
        stop = _first_stop(connection, session)
    unseen = not connection.opened.codec.has_status
    return _with_another_controller(connection, stop) if stop.stopped or unseen else stop


def _with_another_controller(connection: Connection, stop: Stop) -> Stop:
    """Resume commands, as a controller does that is restarted after a crash; then reset."""
    with _begun(connection) as again:
        _await(again, lambda: again.follows() or again.stays_stopped(), FEEDBACK_S)
        again.wait(_STANDS_S)
        said, stays = again.loop.counters()["stopped"] > 0, again.stays_stopped()
        released = None
        if stays and again.opened.codec.has_reset:
            try:
                again.command("reset")
                released = True
            except RefusedError:
                released = False
    return replace(stop, seen_again=said, stays=stays, released=released)


def _first_stop(connection: Connection, session: Session) -> Stop:
    """Read the drive's unanswered samples until it reports that it has stopped."""
    # With the link clock, frames that arrive between two ticks have already been received.
    newest = session.wire.take()
    before, silence = newest.samples, _SILENCES * watchdog_ticks(connection)
    first = before if newest.delay == 0 else None
    gap = False
    for pair in _pairs(connection, session):
        missing, before = pair.samples != before + 1, pair.samples
        # Without an echo the first sample received is the closest to the last command.
        if first is None and pair.delay in (0, None):
            first, gap = pair.samples, missing
        if pair.status & DEVICE_STOPPED:
            if first is None or pair.delay is None:
                return Stop(True)
            return Stop(True, pair.samples - first, gap or missing)
        if first is not None and pair.samples - first > silence:
            break
    return Stop(False)


def _pairs(connection: Connection, session: Session) -> Iterator[Feedback]:
    """Yield every sample of the drive that arrives after the tick thread has ended."""
    if connection.before_tick is not None:
        for _ in range(3 * _SILENCES * watchdog_ticks(connection)):
            connection.before_tick()
            yield from _arrived(session)
        return
    end_s = time.monotonic() + _SILENCE_S
    while time.monotonic() < end_s:
        yield from _arrived(session)
        time.sleep(0.5 * connection.rig.rate.period_s)


def _arrived(session: Session) -> Iterator[Feedback]:
    while (frame := session.link.receive()) is not None:
        if not session.wire.codec.is_serial:
            if session.wire.receive(frame) & _PAIR:
                yield session.wire.take()
            continue
        for byte in frame.data:
            if session.wire.feed(bytes([byte])) & _PAIR:
                yield session.wire.take()


# ---- TRIPPED ------------------------------------------------------------------------------------


def _by_trip(connection: Connection) -> Stop:
    with at_rest(connection) as session:
        session.command("trip")
        session.wait(_AFTER_TRIP_S)
    rec = session.recording()
    return after_trip(rec.samples, rec.meta["real_time"]["commands_before"])


def after_trip(rows: Rows, before: int = 0) -> Stop:
    """Return what the drive did after a trip, from all rows of a session, (n,).

    ``before``: as in `rthyb_rt.rig.commissioning.guided_motion.command_numbers`.
    """
    tripped = (rows["state"] == STATES.index("TRIPPED")) & (
        (rows["flags"] & FLAGS["not_sent"]) == 0
    )
    numbers = command_numbers(rows, before)
    places = np.flatnonzero(fresh(rows))
    received = rows[places]
    stopped = (received["flags"] & FLAGS["stopped"]) != 0
    # It may report a stop before its first command; only what follows its first motion counts.
    begun = int(np.flatnonzero(~stopped)[0]) if (~stopped).any() else received.size
    stops = np.flatnonzero(stopped[begun:]) + begun
    if not stops.size or not tripped.any():
        return Stop(False)
    at = int(stops[0])
    tripped_at = int(np.flatnonzero(tripped)[0])
    first = int(numbers[tripped_at]) + 1
    # What came before TRIPPED was sent cannot echo it: the counter repeats after 256 commands.
    since = places[begun:] > tripped_at
    applied = since & ((received["echo"][begun:].astype(np.int64) - first) % _BYTE < _BYTE // 2)
    if not received["echo"].any():
        return Stop(True)
    if not applied[: at - begun + 1].any():
        return Stop(True, None, gap=True)
    taken = begun + int(np.flatnonzero(applied)[0])
    steps = int(received["count"][at]) - int(received["count"][taken])
    gap = at > 0 and (int(received["count"][at]) - int(received["count"][at - 1])) % _BYTE > 1
    return Stop(True, steps % _BYTE, gap)
