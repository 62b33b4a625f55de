"""A hybrid test in real time: the tick thread, and all that Python does around it.

A `LiveRun` is a station with its ring and the book of its records. A `Conductor` has wire, link,
loop and the run that ticks: it begins, commands, waits, publishes parameters, accounts and ends. A
`Session` is one for a single test, with a thread that keeps every record and gives the sign of
life; the service's engine is one that goes from test to test. `run` conducts a whole test, from
the first reading back to rest. With the stepped clock the same test runs tick by tick on the
caller's word, which is not real time.
"""

from rthyb_rt.lab.end_reasons import TIMING_CAUSES, RefusedError, TimingError, end_reason
from rthyb_rt.lab.realtime.collector import RECORDER_PERIOD_S
from rthyb_rt.lab.realtime.conducting import run
from rthyb_rt.lab.realtime.conductor import FEEDBACK_S, NEEDED, Conductor, link_delay
from rthyb_rt.lab.realtime.live_run import LiveRun
from rthyb_rt.lab.realtime.replaying import first_cause, first_cause_in_words, replay
from rthyb_rt.lab.realtime.session import Session
from rthyb_rt.lab.sequence import Operator

__all__ = [
    "FEEDBACK_S",
    "NEEDED",
    "RECORDER_PERIOD_S",
    "TIMING_CAUSES",
    "Conductor",
    "LiveRun",
    "Operator",
    "RefusedError",
    "Session",
    "TimingError",
    "end_reason",
    "first_cause",
    "first_cause_in_words",
    "link_delay",
    "replay",
    "run",
]
