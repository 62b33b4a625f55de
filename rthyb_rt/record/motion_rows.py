"""Which instants of the ground motion the rows of a recording belong to.

A recording may lack the first rows of its test, because they were overwritten in the ring before
they were read. Each row has the ground acceleration of its instant, identical to the bit with that
in the ground motion of the recording, so that the other rows show where they belong.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]

_SPREAD: Final = 64
"""Rows compared with all places at once, before any place is compared with every row."""


def first_instant(rec: RecordedTest) -> int | None:
    """Return the instant of the first row of the test proper, counted from the start of the motion.

    None if the rows do not tell: some between them are missing, the ground is at rest during all of
    them, or the motion repeats itself. Rows with a reference begin with the test, unless their
    ground motion contradicts this, or does not show where those after missing ones belong.
    """
    rows = np.flatnonzero(rec.running())
    seen = np.asarray(rec.samples["ag_mps2"][rows], dtype=np.float64)
    unbroken = _after_gaps(rec.samples["tick"][rows], rows)
    shown = not unbroken or bool(seen[unbroken:].any())
    if shown and rec.reference is not None and np.array_equal(seen, rec.ag_mps2[: seen.size]):
        return 0
    if not rows.size or unbroken:
        return None
    return _only_place(seen, rec.ag_mps2)


def _after_gaps(tick: NDArray[np.uint64], rows: NDArray[np.intp]) -> int:
    """Return how many of the rows come before the last tick that is missing between them."""
    gaps = np.flatnonzero(np.diff(tick.astype(np.int64)) != np.diff(rows))
    return int(gaps[-1]) + 1 if gaps.size else 0


def _only_place(part: Floats, whole: Floats) -> int | None:
    """Return where a part of a signal begins, if it fits in one place only."""
    anchor = int(np.argmax(np.abs(part)))
    if part[anchor] == 0.0:
        return None
    places = np.flatnonzero(whole == part[anchor]) - anchor
    places = places[(places >= 0) & (places <= whole.size - part.size)]
    for at in np.linspace(0, part.size - 1, _SPREAD).astype(np.intp):
        places = places[whole[places + at] == part[at]]
    found: int | None = None
    for place in places.tolist():
        if np.array_equal(whole[place : place + part.size], part):
            if found is not None:
                return None
            found = place
    return found
