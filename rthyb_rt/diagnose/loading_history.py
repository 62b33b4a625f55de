"""The loading history of a specimen with a memory before a recording begins.

A closed play, a displaced slider or a partly yielded loop: a second recording starts in that state,
and its first rows of force show it. The history is modelled as a single excursion, out and back to
the first displacement; its size is the one that best reproduces those rows.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.policy import POLICY

HEAD = 0.15
"""Fraction of a recording whose force may show its history: files of inputs provide this much."""
LEAST = 8
"""Least number of these rows."""
ROWS = 400
"""Number of rows of each way of the excursion, and of the rest after it, for relaxation to end."""
FARTHEST = 33
"""Number of excursions tried first, evenly over the displacements of the fitted recording."""
CLOSER = 2
"""Number of refinements between the neighbours of the best one."""

Force = Callable[[ComputedMotion, Floats, dict[str, Floats]], Floats]


def force_after(
    force: Force, case: Case, motion: ComputedMotion, other: dict[str, Floats], reach_m: float
) -> Floats:
    """Return the force along a motion, given the first recorded rows of force, (n,), N.

    Args:
        force: function of a motion, its times and other channels, from a virgin state.
        case: the recording; `f_meas` may contain its first rows only.
        motion: the motion, each (n,).
        other: further channels, each (n,).
        reach_m: largest displacement of the history in either direction.
    """
    plain = force(motion, case.t, other)
    f_meas = case.channels.get("f_meas")
    if f_meas is None or not np.isfinite(f_meas[0]):
        return plain
    known = np.isfinite(f_meas)
    end = int(min(np.argmin(known) if not known.all() else known.size, HEAD * known.size))
    if end < LEAST:
        return plain

    def begun(top: float, rows: int) -> Floats:
        past = _excursion(top, float(motion.x[0]))
        n = past.size
        x = np.concatenate((past, motion.x[:rows]))
        v = np.concatenate((np.gradient(past) * case.fs_hz, motion.v[:rows]))
        a = np.concatenate((np.zeros(n), motion.a[:rows]))
        t = np.concatenate((case.t[0] - np.arange(n, 0, -1) * case.dt, case.t[:rows]))
        more = {k: np.concatenate((np.full(n, u[0]), u[:rows])) for k, u in other.items()}
        return force(ComputedMotion(x, v, a), t, more)[n:]

    def off(made: Floats) -> float:
        return float(np.sqrt(np.mean((made[:end] - f_meas[:end]) ** 2)))

    best, span = 0.0, reach_m
    for _ in range(1 + CLOSER):
        tops = np.linspace(best - span, best + span, FARTHEST)
        best = float(tops[np.argmin([off(begun(float(top), end)) for top in tops])])
        span *= 2.0 / (FARTHEST - 1)
    if off(begun(best, end)) > POLICY.past_better * off(plain):
        return plain
    return begun(best, case.t.size)


def _excursion(top: float, first: float) -> Floats:
    """Return displacements from zero to ``top`` and back to the first, and a rest there, m."""
    way = np.linspace(0.0, 1.0, ROWS)
    return np.concatenate((top * way, top + (first - top) * way, np.full(ROWS, first)))
