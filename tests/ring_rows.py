"""Rows for a telemetry ring, in a module that a process killed at once can import quickly."""

from __future__ import annotations

import numpy as np

from rthyb_rt import core
from rthyb_rt.core import STATES, RecordArray

CYCLE = 200_000
"""Number of ticks after which the rows of a producer at full speed repeat."""


def rows(first: int, count: int, state: int = STATES.index("RUNNING")) -> RecordArray:
    """Records in which every field shows its tick."""
    tick = np.arange(first, first + count)
    records = np.zeros(count, dtype=core.RECORD_DTYPE)
    for name in core.RECORD_DTYPE.names or ():
        records[name] = tick.astype(core.RECORD_DTYPE[name])
    records["flags"] = core.FLAGS["fresh"]
    records["state"] = state
    return records
