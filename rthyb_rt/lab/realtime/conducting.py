"""A whole test, from the first reading back to rest, whatever happens in between."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rthyb_rt import core
from rthyb_rt.core.loop import Clock
from rthyb_rt.errors import InputError
from rthyb_rt.lab import zeroing
from rthyb_rt.lab.end_reasons import RefusedError
from rthyb_rt.lab.experiment import Progress, Setup
from rthyb_rt.lab.realtime.collector import RECORDER_PERIOD_S
from rthyb_rt.lab.realtime.conductor import FEEDBACK_S
from rthyb_rt.lab.realtime.messenger import Messenger
from rthyb_rt.lab.realtime.session import Session
from rthyb_rt.lab.sequence import Operator, Sequence
from rthyb_rt.record.recording import RecordedTest

if TYPE_CHECKING:
    from rthyb_rt.rig.links.opened import Opened

_LOCK_S = 20.0
_STANDS_S = 2.0
"""Time after which a drive that receives commands but does not follow is considered stopped."""
_STANDS_RESET_S = 0.25
"""The same if it may be reset: a premature reset is harmless."""


def run(
    setup: Setup,
    opened: Opened,
    *,
    clock: Clock = "host",
    folder: Path | None = None,
    before_tick: Callable[[], None] | None = None,
    progress: Progress | None = None,
    operator: Operator | None = None,
    hold_s: float = math.inf,
    require_realtime: bool = False,
    warn: Callable[[str], None] = lambda _: None,
    save: Callable[[RecordedTest], None] | None = None,
    station: core.StationConfig | None = None,
    facts: Mapping[str, Any] | None = None,
    resets: bool = False,
    answered: Callable[[Session], None] = lambda _: None,
    zeroed: Callable[[Session], None] = lambda _: None,
) -> RecordedTest:
    """Conduct a test: zero, arm, start, and back to rest, whatever happens in between.

    Args:
        setup: the test.
        opened: the link to the drive, which remains the caller's.
        clock, folder, before_tick: as in `Session`.
        progress: called with (ticks done, ticks of the test) now and then.
        operator: requests of the operator.
        hold_s: time after which a held test is stopped.
        require_realtime: refuse to run without `NEEDED`.
        warn: called with a sentence for the user while the test runs.
        save: stores the recording; only then is the ring deleted.
        station, facts: as in `Session`.
        resets: reset a drive that has stopped by itself, at the operator's request or because it is
            the caller's own virtual rig.
        answered: called with the session once the drive answers, before anything moves.
        zeroed: called with the session between the tare and ARM, before anything moves; an
            exception ends the test there.

    Returns:
        The recording, all rows from the first tick on. ``meta["real_time"]`` has the statistics.

    Raises:
        TimingError: a privilege that ``require_realtime`` requires is missing; nothing moved.
        InputError: no feedback or no reading of a sensor arrives, or the drive does not follow;
            nothing moved.
        RefusedError: the drive has stopped by itself and was not reset; nothing moved.
        RthybError: something else failed. Any motion is stopped, and the message names the ring
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
            hint = "run rthyb jitter to see how to obtain them"
            session.check_privileges(warn, required=require_realtime, hint=hint)
            messenger = Messenger(progress or _no_progress, warn, at_once=clock == "stepped")
            try:
                sequence = Sequence(
                    session,
                    operator,
                    hold_s=hold_s,
                    progress=messenger.progress,
                    warn=messenger.warn,
                )
                session.attended()
                _await_drive(session, sequence, resets)
                answered(session)
                sequence.conduct(lambda: _judge(session, zeroed))
                session.close()
            finally:
                messenger.close()
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


def _judge(session: Session, zeroed: Callable[[Session], None]) -> None:
    zeroed(session)
    if session.clock != "stepped":
        # The caller may have taken long: send a heartbeat before anything moves.
        session.wait(2 * RECORDER_PERIOD_S)


def _say_where(session: Session, error: BaseException) -> None:
    """Keep a ring that contains records, and mention it in the error."""
    if not session.run.moved:
        session.discard()
        return
    path = session.run.ring.path
    error.add_note(
        f"what was recorded is in {path}; to make a recording from it: rthyb recover {path}"
    )


def _await_drive(session: Session, sequence: Sequence, resets: bool) -> None:
    sequence.until(session.follows, _STANDS_RESET_S if resets else _STANDS_S)
    if session.stays_stopped() and not sequence.stopped:
        # No command is sent without readings of all sensors, so a drive that was just switched on
        # has received none yet.
        if zeroing.silent_sensors(session.run):
            raise InputError(session.no_feedback(), session.opened.name)
        if not resets:
            raise RefusedError(session.no_feedback(), where=session.opened.name)
        session.command("reset")
    if not sequence.until(session.follows, FEEDBACK_S) and not sequence.stopped:
        why = session.other_rate() or session.no_feedback()
        raise InputError(why, session.opened.name)
    locked = session.clock != "link" or sequence.until(lambda: session.loop.locked, _LOCK_S)
    if not locked and not sequence.stopped and session.state != "TRIPPED":
        sequence.warn(
            "the ticks do not keep step with the drive's samples: its clock is off by more than "
            "200 ppm, or its frames arrive irregularly"
        )
