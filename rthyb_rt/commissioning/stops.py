"""The drive's own stop: when commands cease, and when it is told TRIPPED.

Both are provoked at rest. What the drive does is read from its own frames: the bit by which it says
that it has stopped, the command that it had applied by then, and its count of samples. A PC that is
late changes none of these.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np

from rthyb_rt import core, realtime
from rthyb_rt.commissioning.moving import (
    ATTEMPTS,
    Connection,
    Motion,
    Rows,
    command_numbers,
    fresh,
    setup_of,
    station_of,
)
from rthyb_rt.errors import InputError
from rthyb_rt.links.wire import DEVICE_STOPPED, VERDICTS, Feedback
from rthyb_rt.loop import WATCHDOG_TICKS
from rthyb_rt.realtime import Session
from rthyb_rt.recording import FLAGS, STATES

TRIP_TICKS: Final = 1
"""Of the drive, from the command that says TRIPPED to the beginning of its stop."""

_SILENCE_TICKS: Final = 4 * WATCHDOG_TICKS
"""Of the drive without a command; then its watchdog has not worked."""
_SILENCE_S: Final = 2.0
_AFTER_TRIP_S: Final = 0.25
_REST_S: Final = 0.25
_BYTE: Final = 0x100
_PAIR: Final = VERDICTS["pair"]


@dataclass(frozen=True)
class Stop:
    """What a drive did.

    Attributes:
        stopped: it said that it stopped.
        ticks: of its own, from its last command, or from the first that said TRIPPED, to its
            saying so; None where its frames do not tell.
        gap: frames are missing there, so that it may have been fewer.
        seen_again: it still said so when the next connection began; None where none was made.
    """

    stopped: bool
    ticks: int | None = None
    gap: bool = False
    seen_again: bool | None = None


def _without_gap(attempt: Callable[[], Stop]) -> Stop:
    """Try until no frames are missing where it counts; at most `ATTEMPTS` times."""
    stop = Stop(False)
    for _ in range(ATTEMPTS):
        stop = attempt()
        if not stop.gap:
            break
    return stop


def watchdog(connection: Connection) -> Stop:
    """Fall silent, without a farewell, and see the drive stop by itself; then connect again.

    Raises:
        InputError: no feedback comes.
        RthybError: the system refused what is needed.
    """
    return _without_gap(lambda: _in_silence(connection))


def trip(connection: Connection) -> Stop:
    """Trip at rest, and see the drive stop by the word of it.

    Raises:
        InputError: no feedback comes.
        RthybError: the system refused what is needed.
    """
    return _without_gap(lambda: _by_trip(connection))


@contextmanager
def at_rest(connection: Connection) -> Iterator[Session]:
    """Give a session in IDLE, of a drive that follows.

    Raises:
        InputError: no feedback comes, or the drive does not follow.
        RthybError: the system refused what is needed.
    """
    motion = Motion("at-rest", np.zeros(1))
    setup = setup_of(connection.rig, motion)
    with Session(
        setup,
        connection.opened,
        clock=connection.clock,
        before_tick=connection.before_tick,
        station=station_of(setup, motion),
    ) as session:
        try:
            session.start()
            _await_following(session)
            yield session
        finally:
            session.close()
            session.discard()


def _await_following(session: Session) -> None:
    waited_s, begun_s = 0.0, time.monotonic()
    while not session.follows():
        session.wait(realtime.RECORDER_PERIOD_S)
        waited_s += realtime.RECORDER_PERIOD_S
        passed_s = waited_s if session.clock == "stepped" else time.monotonic() - begun_s
        if passed_s > realtime.FEEDBACK_S:
            raise InputError(realtime.no_feedback(session), session.opened.name)
    session.wait(_REST_S)


# ---- silence ------------------------------------------------------------------------------------


def _in_silence(connection: Connection) -> Stop:
    with at_rest(connection) as session:
        session.loop.stop()
        stop = _first_stop(connection, session)
    if not stop.stopped:
        return stop
    with at_rest(connection) as again:
        pass
    said = again.loop.counters()["stopped"] > 0
    return Stop(stop.stopped, stop.ticks, stop.gap, said)


def _first_stop(connection: Connection, session: Session) -> Stop:
    """Read the drive's samples, which nobody answers any more, until it says that it stopped."""
    # With the link clock, what comes between two ticks has been taken in already.
    newest = session.wire.take()
    before = newest.samples
    first = before if newest.delay == 0 else None
    gap = False
    for pair in _pairs(connection, session):
        missing, before = pair.samples != before + 1, pair.samples
        # Without an echo the first sample heard is the nearest to the last command.
        if first is None and pair.delay in (0, None):
            first, gap = pair.samples, missing
        if pair.status & DEVICE_STOPPED:
            if first is None or pair.delay is None:
                return Stop(True)
            return Stop(True, pair.samples - first, gap or missing)
        if first is not None and pair.samples - first > _SILENCE_TICKS:
            break
    return Stop(False)


def _pairs(connection: Connection, session: Session) -> Iterator[Feedback]:
    """Give every sample of the drive that comes while the tick thread is no more."""
    if connection.before_tick is not None:
        for _ in range(3 * _SILENCE_TICKS):
            connection.before_tick()
            yield from _arrived(session)
        return
    end_s = time.monotonic() + _SILENCE_S
    while time.monotonic() < end_s:
        yield from _arrived(session)
        time.sleep(0.5 * core.PERIOD_S)


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

    ``before``: as in `rthyb_rt.commissioning.moving.command_numbers`.
    """
    told = (rows["state"] == STATES.index("TRIPPED")) & ((rows["flags"] & FLAGS["not_sent"]) == 0)
    numbers = command_numbers(rows, before)
    heard = rows[fresh(rows)]
    stopped = (heard["flags"] & FLAGS["stopped"]) != 0
    # Stopped from before its first command on; what counts is what comes after it followed.
    begun = int(np.flatnonzero(~stopped)[0]) if (~stopped).any() else heard.size
    stops = np.flatnonzero(stopped[begun:]) + begun
    if not stops.size or not told.any():
        return Stop(False)
    at = int(stops[0])
    first = int(numbers[np.flatnonzero(told)[0]]) + 1
    applied = (heard["echo"][begun:].astype(np.int64) - first) % _BYTE < _BYTE // 2
    if not heard["echo"].any():
        return Stop(True)
    if not applied[: at - begun + 1].any():
        return Stop(True, None, gap=True)
    taken = begun + int(np.flatnonzero(applied)[0])
    steps = int(heard["count"][at]) - int(heard["count"][taken])
    gap = at > 0 and (int(heard["count"][at]) - int(heard["count"][at - 1])) % _BYTE > 1
    return Stop(True, steps % _BYTE, gap)
