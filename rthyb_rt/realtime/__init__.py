"""A hybrid test in real time: the tick thread, and all that Python does around it.

A `Session` owns what one test needs: ring, station, wire, link, loop, and a thread that keeps every
record and gives the sign of life. `run` conducts a whole test, from the first reading back to rest.
With the stepped clock the same test runs tick by tick on the caller's word, which is not real time.
"""

from rthyb_rt.realtime.conducting import FEEDBACK_S, Operator, no_feedback, run
from rthyb_rt.realtime.endings import TIMING_CAUSES, RefusedError, TimingError, end_reason
from rthyb_rt.realtime.keeper import LOOK_BACK_TICKS, RECORDER_PERIOD_S, follows
from rthyb_rt.realtime.replaying import first_cause, replay
from rthyb_rt.realtime.session import NEEDED, SET_REFUSED, Session, histogram, link_delay

__all__ = [
    "FEEDBACK_S",
    "LOOK_BACK_TICKS",
    "NEEDED",
    "RECORDER_PERIOD_S",
    "SET_REFUSED",
    "TIMING_CAUSES",
    "Operator",
    "RefusedError",
    "Session",
    "TimingError",
    "end_reason",
    "first_cause",
    "follows",
    "histogram",
    "link_delay",
    "no_feedback",
    "replay",
    "run",
]
