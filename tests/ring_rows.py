"""Rows for a telemetry ring, light enough to import for a process that is killed at once."""

from __future__ import annotations

import numpy as np

from rthyb_rt import core
from rthyb_rt.core import STATES, RecordArray

CYCLE = 200_000
"""Ticks after which the rows of a producer at full speed begin again."""


def rows(first: int, count: int, state: int = STATES.index("RUNNING")) -> RecordArray:
    """Records that show in every field which tick they are of."""
    tick = np.arange(first, first + count)
    records = np.zeros(count, dtype=core.RECORD_DTYPE)
    for name in core.RECORD_DTYPE.names or ():
        records[name] = tick.astype(core.RECORD_DTYPE[name])
    records["flags"] = core.FLAGS["fresh"]
    records["state"] = state
    return records
