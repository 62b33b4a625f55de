"""Whether the numbers of a set are the same in every part of a recording.

A law has one set of numbers. Laws that stand in for one which is in no catalogue take up its force
with other numbers early than late, or in fast motion than in slow, and what they leave may be small
enough to pass for noise all the same. So the rows of a recording are parted by time and by the
motion, each part is given numbers of its own, and what that earns is held against chance (Chow,
Econometrica 28 (1960) 591). The law of a right name is only near, too: beside it stand its
`form.neighbours`, no larger than a form may be off, and what they explain as well is no evidence.
Nor is it that a specimen warms or wears a little: numbers may be others by some per cent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import evidence
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.form import neighbours
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.select import Fit, Problem, design_of, inflation, priors_of


@dataclass(frozen=True)
class Change:
    """What numbers of its own in a part of the recording earn a set.

    Attributes:
        part: of which rows, in words.
        fall: of chi-squared, over what rows that hang together overstate it.
        count: how many numbers.
    """

    part: str
    fall: float
    count: int

    @property
    def deviations(self) -> float:
        """How far that is beyond chance, in standard deviations of a normal distribution.

        By the cube root of chi-squared a number (Wilson and Hilferty, PNAS 17 (1931) 684).
        """
        spread = 2.0 / (9.0 * self.count)
        root = float(np.cbrt(max(self.fall, 0.0) / self.count))
        return (root - (1.0 - spread)) / float(np.sqrt(spread))


def changes(problem: Problem, fit: Fit) -> tuple[Change, ...]:
    """Return what a set's numbers earn by being others in parts of the recording.

    Of a fit in the balance of forces; none where it has no numbers, or was refined elsewhere.
    """
    slopes = _slopes(problem, fit)
    if slopes is None:
        return ()
    # The nuisance is one for all of the recording.
    own = slopes[:, : slopes.shape[1] - fit.nuisance.size]
    design, prior = with_forms(problem, fit, slopes)
    shapes = sum(len(m.trial.theta) for m in fit.members)
    # By how much each number is another: of shapes the logarithm is fitted.
    free = np.pad(prior, (0, own.shape[1]))
    held = free.copy()
    numbers = np.abs(np.concatenate([np.ones(shapes), *fit.betas]))
    at = np.arange(design.shape[1], free.shape[0])
    held[at, at] = np.maximum(POLICY.changed_within * numbers, 1e-150) ** -2.0
    out = []
    for part, rows in _parts(problem):
        apart = np.column_stack([design, np.where(rows[:, None], own, 0.0)])
        before = left(apart, held, fit.residual)[0]
        after, rest = left(apart, free, fit.residual)
        out.append(Change(part, (before - after) / inflation(rest), own.shape[1]))
    return tuple(out)


def standing(problem: Problem, fit: Fit) -> tuple[float, float] | None:
    """Return what a set leaves with the form of its laws left free, and its price, in chi-squared.

    Beside it by how much rows that hang together overstate that. None where it has no slopes here.
    """
    slopes = _slopes(problem, fit)
    if slopes is None:
        return None
    least, rest = left(*with_forms(problem, fit, slopes), fit.residual)
    return least + evidence.cost(problem, fit), inflation(rest)


def _slopes(problem: Problem, fit: Fit) -> Floats | None:
    """Return the slopes of a set, (rows, p); None of no set, or of one refined elsewhere."""
    slopes = design_of(problem, fit) if fit.members else np.zeros((0, 0))
    return slopes if slopes.shape[0] == fit.residual.size > 0 else None


def with_forms(problem: Problem, fit: Fit, slopes: Floats) -> tuple[Floats, Floats]:
    """Return the slopes of a set with its laws' neighbours beside them, and the priors of all.

    Args:
        problem: what is judged.
        fit: the set.
        slopes: as `design_of` has them, (rows, p).

    Returns:
        Design, (rows, q), and prior, (q, q): a neighbour is no larger than a form may be off.
    """
    design = np.column_stack([slopes, _near(problem, fit)])
    prior = np.zeros((design.shape[1],) * 2)
    shapes = sum(len(m.trial.theta) for m in fit.members)
    known = slopes.shape[1]
    prior[:known, :known] = priors_of(problem, fit.members, shapes, known)
    at = np.arange(known, design.shape[1])
    prior[at, at] = POLICY.form_error**-2
    return design, prior


def _near(problem: Problem, fit: Fit) -> Floats:
    """Return the neighbours of the laws of a set as they are judged, (rows, m)."""
    ctx = problem.ctx
    over = [(ctx.x, ctx.x_range), (ctx.v, ctx.v_range)]
    columns = [
        problem.seen(column)
        for i, member in enumerate(fit.members)
        if not member.effect.sensor
        for column in neighbours(evidence.contribution(problem, fit, i), over)
    ]
    return np.column_stack(columns) if columns else np.zeros((fit.residual.size, 0))


def _parts(problem: Problem) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return one of two parts of the judged rows each, (rows,), in which numbers may be others."""
    x, v = problem.ctx.x[problem.rows], problem.ctx.v[problem.rows]
    far, fast, row = np.abs(x), np.abs(v), np.arange(x.size)
    return [
        ("the second half of the recording", row >= x.size // 2),
        ("large displacements", far > float(np.median(far))),
        ("fast motion", fast > float(np.median(fast))),
        ("displacements to one side", x > float(np.median(x))),
        ("motion in one direction", v > 0.0),
    ]


def left(design: Floats, prior: Floats, residual: Floats) -> tuple[float, Floats]:
    """Return chi-squared of least squares with its priors, and what is left, (rows,)."""
    gram = design.T @ design + prior
    unit = 1.0 / np.sqrt(np.maximum(gram.diagonal(), 1e-300))
    right = unit * (design.T @ residual)
    beta = unit * np.linalg.lstsq(gram * np.outer(unit, unit), right, rcond=1e-10)[0]
    rest = residual - design @ beta
    return float(rest @ rest + beta @ prior @ beta), rest
