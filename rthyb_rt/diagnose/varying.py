"""Whether a stiffness or damping that changes periodically with time explains more than a set.

No law of the catalogue knows the time. A damper that is switched, a valve that another system
drives, a spring whose load comes and goes: the coefficient of each is a periodic function of time
(Hill's equation; Nayfeh and Mook, Nonlinear Oscillations, 1979, ch. 5). Two or three laws of the
catalogue may stand in for it down to the noise. So a named set is held against such a coefficient:
k(t) x or c(t) v, with a constant part and three harmonics of a period that is looked for. It has no
name; where it explains more than the set does, the set is not the answer. As in `steady`, the form
of a law is only near the true one: the neighbours of the set's laws stand beside it.
"""

from __future__ import annotations

import numpy as np

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.select import Fit, Problem, penalty
from rthyb_rt.diagnose.steady import standing

HARMONICS = 3
LINES = 192
"""Frequencies that are tried at most, harmonics included."""
PERIODS = 2
"""Least periods in a recording: what changes more slowly has a name (wear, drift, an onset)."""
VALUES = 8_000_000
"""Values of cosines and sines that are computed at most: a long recording has fewer lines, and
where they are fewer than `FEWEST` none is tried."""
FEWEST = 24


def gain(problem: Problem, fit: Fit) -> float:
    """Return what the best periodic coefficient explains more than a set, in chi-squared.

    Prices counted, those of the set and the coefficient's, and over what rows that hang together
    overstate; minus infinity where a set has no slopes, or a recording is too long.
    """
    own = standing(problem, fit)
    if own is None:
        return -np.inf
    rival = min(_least(problem, column) for column in (problem.ctx.x, problem.ctx.v))
    # A constant part, two for each harmonic, and the period.
    return (own[0] - rival - penalty(problem.ln_n, 2 + 2 * HARMONICS)) / own[1]


def _least(problem: Problem, column: Floats) -> float:
    """Return the least chi-squared of any periodic coefficient of a column, (n,)."""
    lines = _lines(problem)
    if lines.size < FEWEST:
        return np.inf
    # Cosine and sine in turn, so that a harmonic's two stand side by side.
    angle = 2.0 * np.pi * (problem.ctx.t - problem.ctx.t[0])
    waves = [w for f in lines for w in (np.cos(f * angle), np.sin(f * angle))]
    base = problem.base
    known = base.shape[1] + 1
    seen = [problem.seen(column), *(problem.seen(column * w) for w in waves)]
    design = np.column_stack([base, *seen])
    prior = np.zeros(design.shape[1])
    prior[: base.shape[1]] = [0.0 if n.sigma is None else n.sigma**-2.0 for n in problem.nuisances]
    gram, right = design.T @ design + np.diag(prior), design.T @ problem.y
    whole, best = float(problem.y @ problem.y), np.inf
    slowest = int(np.ceil(PERIODS / (problem.ctx.t.size * problem.ctx.dt * lines[0])))
    for first in range(slowest, lines.size // HARMONICS + 1):
        at = [known + 2 * (k * first - 1) + i for k in range(1, HARMONICS + 1) for i in (0, 1)]
        use = np.r_[np.arange(known), at]
        part = gram[np.ix_(use, use)]
        unit = 1.0 / np.sqrt(np.maximum(part.diagonal(), 1e-300))
        scaled = unit * right[use]
        found = np.linalg.lstsq(part * np.outer(unit, unit), scaled, rcond=1e-10)[0]
        best = min(best, whole - float(found @ scaled))
    return best


def _lines(problem: Problem) -> Floats:
    """Return multiples of one frequency up to the harmonics of twice the motion's, Hz, (m,).

    Twice that is where a changing spring feeds a motion most; they lie half a line apart.
    """
    t, v = problem.ctx.t, problem.ctx.v
    power = np.cumsum(np.abs(np.fft.rfft(v)) ** 2)
    f_hz = np.fft.rfftfreq(t.size, problem.ctx.dt)
    top = 2.0 * HARMONICS * float(f_hz[int(np.searchsorted(power, 0.5 * power[-1]))])
    most = min(LINES, VALUES // (2 * t.size))
    count = int(min(most, top * 2.0 * t.size * problem.ctx.dt))
    return np.asarray(top / max(count, 1) * np.arange(1, count + 1), dtype=np.float64)
