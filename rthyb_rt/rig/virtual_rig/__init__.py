"""The virtual rig as a separate process: actuator controller and load cell at the wire.

It exchanges real frames, has its own clock and watchdog, and keeps running while controllers
connect and disconnect. `serve` runs one in this process; `Companion` starts one beside a
controller, at the other end of a socket pair.
"""

from rthyb_rt.rig.virtual_rig.companion import Companion
from rthyb_rt.rig.virtual_rig.faulty import parse_mishaps
from rthyb_rt.rig.virtual_rig.faulty import run as run_faulty
from rthyb_rt.rig.virtual_rig.lines import (
    Line,
    OpenedLine,
    inherited_line,
    line_of,
    lines_of,
    pty_line,
)
from rthyb_rt.rig.virtual_rig.plan import DRIFT_MAX_PPM, FAULT_KINDS, POWER_CUT, Plan, parse_faults
from rthyb_rt.rig.virtual_rig.serving import (
    LOG_SECONDS,
    LOG_SUFFIXES,
    Result,
    Stop,
    drive_of,
    drives_of,
    in_step,
    serve,
    write_log,
)

__all__ = [
    "DRIFT_MAX_PPM",
    "FAULT_KINDS",
    "LOG_SECONDS",
    "LOG_SUFFIXES",
    "POWER_CUT",
    "Companion",
    "Line",
    "OpenedLine",
    "Plan",
    "Result",
    "Stop",
    "drive_of",
    "drives_of",
    "in_step",
    "inherited_line",
    "line_of",
    "lines_of",
    "parse_faults",
    "parse_mishaps",
    "pty_line",
    "run_faulty",
    "serve",
    "write_log",
]
