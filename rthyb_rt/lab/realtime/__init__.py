"""A hybrid test in real time: the tick thread, and everything that Python does around it.

A `LiveRun` is a station with its ring and the log of its records. A `Conductor` owns wire, link,
loop and the active run: it starts the ticks, commands, waits, publishes parameters, collects
statistics and ends. A `Session` is a conductor for a single test, with a thread that collects every
record and sends the heartbeat; the service's engine is one for many tests. `run` conducts a
complete test, from the first reading to rest. With the stepped clock the same test runs tick by
tick when the caller asks for it, which is not real time.
"""

from rthyb_rt.lab.end_reasons import TIMING_CAUSES, RefusedError, TimingError, end_reason
from rthyb_rt.lab.realtime.collector import RECORDER_PERIOD_S
from rthyb_rt.lab.realtime.conducting import run
from rthyb_rt.lab.realtime.conductor import FEEDBACK_S, NEEDED, Conductor, link_delay
from rthyb_rt.lab.realtime.live_run import LiveRun
from rthyb_rt.lab.realtime.session import Session
from rthyb_rt.lab.realtime.station_replay import first_cause, first_cause_in_words, replay
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
