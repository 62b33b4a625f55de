"""Whether a stiffness or damping that changes periodically with time explains more than a set.

No law of the catalogue depends on time. A switched damper, a valve driven by another system, a
spring with a changing load: each coefficient is a periodic function of time (Hill's equation;
Nayfeh and Mook, Nonlinear Oscillations, 1979, ch. 5). Two or three laws of the catalogue may
imitate it down to the noise. A named set is therefore compared with such a coefficient: k(t) x or
c(t) v, with a constant part and three harmonics of a fitted period. It has no name; if it explains
more than the set, the set is not the answer. As in `steady`, the form of a law is only approximate:
the neighbours of the set's laws are included.
"""

from __future__ import annotations

import numpy as np

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.problem import Fit, ResidualProblem, penalty
from rthyb_rt.diagnose.refinement import priors_of
from rthyb_rt.diagnose.steady import standing

HARMONICS = 3
LINES = 192
"""Largest number of trial frequencies, including harmonics."""
PERIODS = 2
"""Least number of periods in a recording: slower changes have names (wear, drift, an onset)."""
VALUES = 8_000_000
"""Largest number of cosines and sines to compute: a long recording has fewer lines, and none if
that is fewer than `FEWEST`."""
FEWEST = 24


def gain(problem: ResidualProblem, fit: Fit) -> float:
    """Return the additional gain of the best periodic coefficient over a set, in chi-squared.

    Including the prices of both, and divided by the inflation due to correlated rows; minus
    infinity if a set has no slopes, or a recording is too long.
    """
    own = standing(problem, fit)
    if own is None:
        return -np.inf
    rival = min(_least(problem, column) for column in (problem.ctx.x, problem.ctx.v))
    # A constant part, two for each harmonic, and the period.
    return (own[0] - rival - penalty(problem.ln_n, 2 + 2 * HARMONICS)) / own[1]


def _least(problem: ResidualProblem, column: Floats) -> float:
    """Return the least chi-squared of any periodic coefficient of a column, (n,)."""
    lines = _lines(problem)
    if lines.size < FEWEST:
        return np.inf
    # Cosine and sine alternate, so that the two of a harmonic are adjacent.
    angle = 2.0 * np.pi * (problem.ctx.t - problem.ctx.t[0])
    waves = [w for f in lines for w in (np.cos(f * angle), np.sin(f * angle))]
    base = problem.base
    known = base.shape[1] + 1
    seen = [problem.seen(column), *(problem.seen(column * w) for w in waves)]
    design = np.column_stack([base, *seen])
    gram = design.T @ design + priors_of(problem, (), 0, design.shape[1])
    right = design.T @ problem.y
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


def _lines(problem: ResidualProblem) -> Floats:
    """Return multiples of one frequency up to the harmonics of twice the motion's, Hz, (m,).

    At twice that frequency a changing spring adds most energy; they are half a line apart.
    """
    t, v = problem.ctx.t, problem.ctx.v
    power = np.cumsum(np.abs(np.fft.rfft(v)) ** 2)
    f_hz = np.fft.rfftfreq(t.size, problem.ctx.dt)
    top = 2.0 * HARMONICS * float(f_hz[int(np.searchsorted(power, 0.5 * power[-1]))])
    most = min(LINES, VALUES // (2 * t.size))
    count = int(min(most, top * 2.0 * t.size * problem.ctx.dt))
    return np.asarray(top / max(count, 1) * np.arange(1, count + 1), dtype=np.float64)
