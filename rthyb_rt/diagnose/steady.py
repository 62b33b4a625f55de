"""Whether the parameters of a set are the same in every part of a recording.

A law has one set of parameters. Laws that replace one outside the catalogue imitate its force with
different parameters early and late, or in fast and slow motion, and the residual may be small
enough to pass for noise nevertheless. The rows of a recording are therefore divided by time and by
motion, each part gets parameters of its own, and the gain is compared with chance (Chow,
Econometrica 28 (1960) 591). The right law is only approximate, too: its `form.neighbours` are
included, as large as a form may be off, and what they also explain is no evidence; those of a law
that wears with travel are functions of the travel as well, else its form would differ between early
and late motion. Nor is a slight warming or wear of the specimen: parameters may differ by some per
cent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import evidence
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.form import neighbours
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.select import Fit, ResidualProblem, design_of, inflation, priors_of


@dataclass(frozen=True)
class Change:
    """Gain of a set from separate parameters in a part of the recording.

    Attributes:
        part: the rows, in words.
        fall: reduction of chi-squared, divided by the inflation due to correlated rows.
        count: number of parameters.
    """

    part: str
    fall: float
    count: int

    @property
    def deviations(self) -> float:
        """Deviation from chance, in standard deviations of a normal distribution.

        By the cube root of chi-squared per parameter (Wilson and Hilferty, PNAS 17 (1931) 684).
        """
        spread = 2.0 / (9.0 * self.count)
        root = float(np.cbrt(max(self.fall, 0.0) / self.count))
        return (root - (1.0 - spread)) / float(np.sqrt(spread))


def changes(problem: ResidualProblem, fit: Fit) -> tuple[Change, ...]:
    """Return the gain of a set from separate parameters in parts of the recording.

    For a fit in the force balance; none if it has no parameters, or was refined elsewhere.
    """
    slopes = _slopes(problem, fit)
    if slopes is None:
        return ()
    # The nuisance parameters are the same for the entire recording.
    own = slopes[:, : slopes.shape[1] - fit.nuisance.size]
    design, prior = with_forms(problem, fit, slopes)
    shapes = sum(len(m.trial.theta) for m in fit.members)
    # Change of each parameter: for shapes, of the logarithm.
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


def standing(problem: ResidualProblem, fit: Fit) -> tuple[float, float] | None:
    """Return a set's residual with free forms of its laws, and its price, in chi-squared.

    The third value is the inflation due to correlated rows. None if it has no slopes here.
    """
    slopes = _slopes(problem, fit)
    if slopes is None:
        return None
    least, rest = left(*with_forms(problem, fit, slopes), fit.residual)
    return least + evidence.cost(problem, fit), inflation(rest)


def _slopes(problem: ResidualProblem, fit: Fit) -> Floats | None:
    """Return the slopes of a set, (rows, p); None for no set, or one refined elsewhere."""
    slopes = design_of(problem, fit) if fit.members else np.zeros((0, 0))
    return slopes if slopes.shape[0] == fit.residual.size > 0 else None


def with_forms(problem: ResidualProblem, fit: Fit, slopes: Floats) -> tuple[Floats, Floats]:
    """Return the slopes of a set together with its laws' neighbours, and the priors of all.

    Args:
        problem: the problem.
        fit: the set.
        slopes: from `design_of`, (rows, p).

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


def _near(problem: ResidualProblem, fit: Fit) -> Floats:
    """Return the neighbours of the laws of a set, whitened, (rows, m)."""
    ctx = problem.ctx
    over = [(ctx.x, ctx.x_range), (ctx.v, ctx.v_range)]
    # Whether wear follows the travel, the work or the number of cycles is its form.
    half = 0.5 * float(ctx.travel[-1]) or 1.0
    worn = [*over, (ctx.travel - half, half)]
    columns = [
        problem.seen(column)
        for i, member in enumerate(fit.members)
        if not member.effect.sensor
        for column in neighbours(
            evidence.contribution(problem, fit, i), worn if member.effect.wears else over
        )
    ]
    return np.column_stack(columns) if columns else np.zeros((fit.residual.size, 0))


def _parts(problem: ResidualProblem) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return divisions of the evaluated rows into two parts: name and one part, (rows,)."""
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
    """Return chi-squared of least squares with its priors, and the residual, (rows,)."""
    gram = design.T @ design + prior
    unit = 1.0 / np.sqrt(np.maximum(gram.diagonal(), 1e-300))
    right = unit * (design.T @ residual)
    beta = unit * np.linalg.lstsq(gram * np.outer(unit, unit), right, rcond=1e-10)[0]
    rest = residual - design @ beta
    return float(rest @ rest + beta @ prior @ beta), rest
