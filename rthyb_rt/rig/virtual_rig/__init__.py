"""The virtual rig as a separate process: actuator controller and load cell at the wire.

It exchanges real frames, has its own clock and watchdog, and keeps running while controllers
connect and disconnect. `serve` runs one in this process; `Companion` starts one beside a
controller, at the other end of a socket pair.
"""

from rthyb_rt.rig.virtual_rig.companion import Companion
from rthyb_rt.rig.virtual_rig.faulty import parse_mishaps
from rthyb_rt.rig.virtual_rig.faulty import run as run_faulty
from rthyb_rt.rig.virtual_rig.rig_plan import (
    DRIFT_MAX_PPM,
    FAULT_KINDS,
    POWER_CUT,
    RigPlan,
    parse_faults,
)
from rthyb_rt.rig.virtual_rig.serving import (
    LOG_SECONDS,
    LOG_SUFFIXES,
    RigResult,
    StopRequest,
    drive_of,
    drives_of,
    in_step,
    serve,
    write_log,
)
from rthyb_rt.rig.virtual_rig.wire_ends import (
    OpenedLine,
    WireEnd,
    inherited_line,
    line_of,
    lines_of,
    pty_line,
)

__all__ = [
    "DRIFT_MAX_PPM",
    "FAULT_KINDS",
    "LOG_SECONDS",
    "LOG_SUFFIXES",
    "POWER_CUT",
    "Companion",
    "OpenedLine",
    "RigPlan",
    "RigResult",
    "StopRequest",
    "WireEnd",
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
