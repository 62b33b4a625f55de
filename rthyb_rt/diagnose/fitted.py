"""Quantities of a fitted set: its price, its forces, and what it does to stated values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.court import times_price
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Nuisance, ResidualProblem, columns_of, leaning, price


def count(problem: ResidualProblem, fit: Fit) -> int:
    """Return the number of parameters of a set."""
    return sum(m.effect.settings(problem.ctx, m.trial)[1] for m in fit.members)


def cost(problem: ResidualProblem, fit: Fit) -> float:
    """Return the price of a set."""
    return sum(
        price(problem, m.effect, m.effect.settings(problem.ctx, m.trial)[1]) for m in fit.members
    )


def to_earn(problem: ResidualProblem, fit: Fit) -> float:
    """Return what a set must earn to be named."""
    return times_price(POLICY, len(fit.members)) * cost(problem, fit)


def bent(problem: ResidualProblem, fit: Fit) -> set[str]:
    """Return the effects that a fit replaces by moving a stated value out of its tolerance."""
    return {n.effect for n in _moved(problem, fit, POLICY.bent_number) if n.effect}


def strained(problem: ResidualProblem, fit: Fit) -> set[str]:
    """Return the effects of stated values that a fit moves farther than the model may be wrong.

    The mass that makes up for an estimated acceleration is none.
    """
    return {n.effect for n in _moved(problem, fit, POLICY.within_tolerance) if n.number}


def _moved(problem: ResidualProblem, fit: Fit, most: float) -> list[Nuisance]:
    """Return what a fit moves by more than a number of standard deviations of its prior."""
    pairs = zip(fit.nuisance, problem.nuisances, strict=True)
    return [n for b, n in pairs if n.sigma is not None and abs(float(b)) > most * n.sigma]


def offset_s(problem: ResidualProblem, fit: Fit) -> float:
    """Return a fit's time offset between the channels, s; positive: the load cell is late."""
    pairs = zip(fit.nuisance, problem.nuisances, strict=True)
    return sum(float(b) for b, n in pairs if n.name == "skew")


def offset_sd(problem: ResidualProblem, fit: Fit) -> float:
    """Return the size of that offset, in standard deviations."""
    sigmas = [n.sigma for n in problem.nuisances if n.name == "skew" and n.sigma is not None]
    return abs(offset_s(problem, fit)) / sigmas[0] if sigmas else 0.0


def contribution(problem: ResidualProblem, fit: Fit, member: int) -> Floats:
    """Return the force of one effect of a fit along the recording, (n,), N."""
    cells = [m for m in fit.members if m.effect.carries and m is not fit.members[member]]
    columns = columns_of(problem.ctx, [fit.members[member], *cells])[0]
    parts = [b * c for b, c in zip(fit.betas[member], columns, strict=True)]
    return np.asarray(np.sum(parts, axis=0))


def force_of(problem: ResidualProblem, fit: Fit) -> Floats:
    """Return the force by the model with a set, as the load cell shows it, (n,), N."""
    out = problem.ctx.total + leaning(problem, fit)
    for i in range(len(fit.members)):
        out = out + contribution(problem, fit, i)
    return np.asarray(out)


def change(problem: ResidualProblem, fit: Fit, error: ComputedMotion) -> Floats:
    """Return by how much the force of a set changes if the motion errs by this, (n,), N.

    Not finite if a law diverges.
    """
    ctx = problem.ctx
    x, v, a = (ctx.x + error.x, ctx.v + error.v, ctx.a + error.a)
    beside = replace(ctx, motion=ComputedMotion(x, v, a), ranges=ctx.all_ranges)
    out = np.zeros(ctx.t.size)
    # A law may diverge along the motion with the error.
    with np.errstate(over="ignore", invalid="ignore"):
        for along, sign in ((beside, 1.0), (ctx, -1.0)):
            for betas, columns in zip(fit.betas, columns_of(along, fit.members), strict=True):
                for beta, column in zip(betas, columns, strict=True):
                    out += sign * beta * column
    return out


def size(problem: ResidualProblem, fit: Fit, which: Sequence[int] | None = None) -> float:
    """Return the size of a set, or of some of its effects, relative to the recorded force."""
    some = range(len(fit.members)) if which is None else which
    total = sum(contribution(problem, fit, i) for i in some)
    rows = problem.rows
    force = problem.estimate.force[rows]
    return float(np.std(np.asarray(total)[rows]) + abs(np.mean(np.asarray(total)[rows]))) / max(
        float(np.sqrt(np.mean(force**2))), 1e-300
    )


def left(problem: ResidualProblem, fit: Fit) -> float:
    """Return the rms difference from the recorded force with a set, relative to that without it."""
    rows = problem.estimate.rows
    force = problem.estimate.force
    before, after = force - problem.ctx.total, force - force_of(problem, fit)
    return float(np.std(after[rows])) / max(float(np.std(before[rows])), 1e-300)
