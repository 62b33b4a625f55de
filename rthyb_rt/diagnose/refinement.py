"""Least squares of a set of effects: its coefficients, its shapes, and their covariance."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np

from rthyb_rt.diagnose.effects.base import Floats, Trial
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, columns_of
from rthyb_rt.diagnose.spectral import fast_length

STRETCHES = 24
"""Number of stretches of a recording whose misfits scatter independently."""


def solve(
    problem: ResidualProblem, members: Sequence[Member], blocks: Sequence[Floats]
) -> Fit | None:
    """Solve for the linear coefficients of effects with given evaluated columns."""
    base = problem.beside(members)
    design = np.column_stack([*blocks, base]) if blocks else base
    y = problem.y
    if design.shape[1] == 0:
        return Fit((), (), float(y @ y), 0, residual=y)
    scale = np.sqrt(np.mean(design**2, axis=0))
    scale[scale == 0] = 1.0
    design = design / scale
    found = _solved(problem, members, design.T @ design, design.T @ y, scale)
    if found is None:
        return None
    real, inverse, chi2 = found
    ends = np.cumsum([0, *(b.shape[1] for b in blocks)])
    return Fit(
        tuple(members),
        tuple(real[i:k] for i, k in pairwise(ends)),
        chi2,
        sum(m.effect.settings(problem.ctx, m.trial)[1] for m in members),
        nuisance=real[ends[-1] :],
        residual=y - design @ (real * scale),
        covariance=inverse / np.outer(scale, scale),
    )


def _solved(
    problem: ResidualProblem, members: Sequence[Member], gram: Floats, right: Floats, scale: Floats
) -> tuple[Floats, Floats, float] | None:
    """Return coefficients, inverse and chi-squared of the normal equations of scaled columns.

    None if they have no solution, or a sign that no law permits.
    """
    extra, signs, j = 0.0, "", 0
    for member in members:
        (sign, pinned), _ = member.effect.settings(problem.ctx, member.trial)
        signs += sign[: len(pinned)]
        for sigma in pinned:
            if sigma is not None:
                gram[j, j] += 1.0 / (sigma * scale[j]) ** 2
                right[j] += 1.0 / (sigma**2 * scale[j])
                extra += 1.0 / sigma**2
            j += 1
    for nuisance in problem.nuisances:
        if nuisance.sigma is not None:
            gram[j, j] += 1.0 / (nuisance.sigma * scale[j]) ** 2
        j += 1
    gram[np.diag_indices_from(gram)] *= 1.0 + 1e-11
    try:
        inverse = np.linalg.inv(gram)
    except np.linalg.LinAlgError:
        return None
    beta = inverse @ right
    real = beta / scale
    if any(s == "+" and real[i] < 0 for i, s in enumerate(signs)):
        return None
    return real, np.asarray(inverse), float(problem.y @ problem.y + extra - beta @ right)


class Scan:
    """Chi-squared of a set in which only the last effect changes its shape.

    The products of the other columns are computed in advance.
    """

    def __init__(self, problem: ResidualProblem, members: Sequence[Member]) -> None:
        self.problem, self.rest = problem, list(members[:-1])
        self.blocks = problem.blocks(members)
        self.alone = not members[-1].effect.carries
        if self.alone:
            self.fixed = np.column_stack([*self.blocks[:-1], problem.beside(members)])
            self.before = sum(b.shape[1] for b in self.blocks[:-1])
            self.gram, self.right = self.fixed.T @ self.fixed, self.fixed.T @ problem.y

    def chi2(self, last: Member) -> float | None:
        """Return chi-squared with this shape of the last effect; None if it cannot be solved."""
        problem, members = self.problem, [*self.rest, last]
        blocks = problem.changed(members, self.blocks, len(self.rest))
        if not self.alone:
            fit = solve(problem, members, blocks)
            return None if fit is None else fit.chi2
        block, at = blocks[-1], self.before
        size = at + block.shape[1]
        order = np.r_[np.arange(at), np.arange(len(self.gram), len(self.gram) + size - at),
                      np.arange(at, len(self.gram))]  # fmt: skip
        cross = self.fixed.T @ block
        gram = np.block([[self.gram, cross], [cross.T, block.T @ block]])[np.ix_(order, order)]
        right = np.r_[self.right, block.T @ problem.y][order]
        scale = np.sqrt(gram.diagonal() / problem.y.size)
        scale[scale == 0] = 1.0
        found = _solved(problem, members, gram / np.outer(scale, scale), right / scale, scale)
        return None if found is None else found[2]


def refine(problem: ResidualProblem, members: Sequence[Member], steps: int = 8) -> Fit | None:
    """Fit the shape parameters as well, starting from the given shapes.

    Damped Gauss-Newton in their logarithms.
    """
    members = list(members)
    blocks = problem.blocks(members)
    fit = solve(problem, members, blocks)
    if fit is None or not any(m.trial.theta for m in members):
        return fit
    places = [(i, j) for i, m in enumerate(members) for j in range(len(m.trial.theta))]
    carried = any(m.effect.carries for m in members)
    damping = 1e-3
    for _ in range(steps):
        design = _design(problem, members, blocks, places, fit)
        gram = design.T @ design
        prior = priors_of(problem, members, len(places), gram.shape[0])
        # Units must not matter: columns are scaled to the same norm.
        unit = 1.0 / np.sqrt(np.maximum(gram.diagonal() + prior.diagonal(), 1e-300))
        held = np.r_[np.zeros(len(places)), *fit.betas, fit.nuisance]
        aim = np.zeros(held.size)
        aim[len(places) : held.size - fit.nuisance.size] = 1.0
        right = design.T @ fit.residual + prior.diagonal() * (aim - held)
        gram += prior
        improved = False
        for _ in range(4):
            damped = gram + damping * np.diag(
                np.r_[gram.diagonal()[: len(places)], np.zeros(gram.shape[0] - len(places))]
            )
            damped *= np.outer(unit, unit)
            damped[np.diag_indices_from(damped)] += 1e-12
            try:
                delta = (unit * np.linalg.solve(damped, unit * right))[: len(places)]
            except np.linalg.LinAlgError:
                break
            delta = np.clip(delta, -0.5, 0.5)
            trial_members = _stepped(problem, members, places, delta)
            trial_blocks = problem.blocks(trial_members) if carried else [
                problem.columns(m) if m.trial.theta else b
                for m, b in zip(trial_members, blocks, strict=True)
            ]  # fmt: skip
            attempt = solve(problem, trial_members, trial_blocks)
            if attempt is not None and attempt.chi2 < fit.chi2:
                gain = fit.chi2 - attempt.chi2
                members, blocks, fit = trial_members, trial_blocks, attempt
                damping = max(damping * 0.2, 1e-6)
                improved = True
                break
            damping *= 8.0
        if not improved:  # the slopes are still valid
            return _with_covariance(problem, members, design, len(places), fit)
        if gain < 1e-5 * fit.chi2 + 0.02:
            break
    design = _design(problem, members, blocks, places, fit)
    return _with_covariance(problem, members, design, len(places), fit)


def priors_of(problem: ResidualProblem, members: Sequence[Member], first: int, size: int) -> Floats:
    """Return the inverse variances of the priors on a set's parameters, (size, size).

    Args:
        problem: the problem.
        members: the set; its coefficients begin at ``first``, those of the nuisance follow.
        first: number of parameters before them.
        size: number of all parameters.
    """
    extra = np.zeros((size, size))
    j = first
    for m in members:
        (_, pinned), _ = m.effect.settings(problem.ctx, m.trial)
        for sigma in pinned:
            if sigma is not None:
                extra[j, j] = 1.0 / sigma**2
            j += 1
    for nuisance in problem.nuisances:
        if nuisance.sigma is not None:
            extra[j, j] = 1.0 / nuisance.sigma**2
        j += 1
    return extra


def _moved(problem: ResidualProblem, member: Member, j: int, step: float) -> Member | None:
    theta = list(member.trial.theta)
    low, high = member.effect.limits(problem.ctx, member.trial)[j]
    value = theta[j] * float(np.exp(step))
    if not low <= abs(value) <= high:
        return None
    theta[j] = value
    return Member(member.effect, Trial(tuple(theta), member.trial.variant))


def _stepped(
    problem: ResidualProblem,
    members: Sequence[Member],
    places: Sequence[tuple[int, int]],
    delta: Floats,
) -> list[Member]:
    out = list(members)
    for (i, j), d in zip(places, delta, strict=True):
        member = out[i]
        theta = list(member.trial.theta)
        low, high = member.effect.limits(problem.ctx, member.trial)[j]
        value = theta[j] * float(np.exp(d))
        theta[j] = float(np.copysign(np.clip(abs(value), low, high), value))
        out[i] = Member(member.effect, Trial(tuple(theta), member.trial.variant))
    return out


def design_of(problem: ResidualProblem, fit: Fit) -> Floats:
    """Return the slopes of the rows to (log shapes, coefficients, nuisance), (rows, p)."""
    blocks = problem.blocks(fit.members)
    places = [(i, j) for i, m in enumerate(fit.members) for j in range(len(m.trial.theta))]
    return _design(problem, fit.members, blocks, places, fit)


def unfiltered_slopes(problem: ResidualProblem, fit: Fit) -> Floats:
    """Return the slopes of the force itself to (log shapes, coefficients), (n, p), at every row."""
    bare = copy(problem)
    bare.estimate = replace(problem.estimate, whiten=lambda force: force, pieces=None)
    bare.rows, bare.pieces, bare.cut_hz, bare.loudness = (
        np.arange(len(problem.ctx.x)),
        None,
        None,
        1.0,
    )
    bare.y, bare._blocks, bare._kept = np.zeros(bare.rows.size), OrderedDict(), None
    places = [(i, j) for i, m in enumerate(fit.members) for j in range(len(m.trial.theta))]
    blocks = bare.blocks(fit.members)
    return np.column_stack([*slopes_of(bare, fit.members, blocks, places, fit), *blocks])


def _design(
    problem: ResidualProblem,
    members: Sequence[Member],
    blocks: Sequence[Floats],
    places: Sequence[tuple[int, int]],
    fit: Fit,
) -> Floats:
    slopes = slopes_of(problem, members, blocks, places, fit)
    return np.column_stack([*slopes, *blocks, problem.beside(members)])


def slopes_of(
    problem: ResidualProblem,
    members: Sequence[Member],
    blocks: Sequence[Floats],
    places: Sequence[tuple[int, int]],
    fit: Fit,
) -> list[Floats]:
    """Return the slopes of the evaluated rows to the logarithm of each shape parameter."""
    jacobian = []
    for i, j in places:
        step = members[i].effect.steps(problem.ctx, members[i].trial)[j]
        moved = _moved(problem, members[i], j, step)
        if moved is None:
            step = -step
            moved = _moved(problem, members[i], j, step)
        slope = np.zeros(problem.y.size)
        if moved is not None and moved.effect.carries:
            # It changes every block: their sum is whitened in one pass.
            now_all = columns_of(problem.ctx, [*members[:i], moved, *members[i + 1 :]])
            pairs = zip(fit.betas, now_all, strict=True)
            force = sum(b * c for beta, own in pairs for b, c in zip(beta, own, strict=True))
            before = sum(old @ beta for old, beta in zip(blocks, fit.betas, strict=True))
            slope = (problem.seen(np.asarray(force)) - before) / step
        elif moved is not None:
            now = problem.changed([*members[:i], moved, *members[i + 1 :]], blocks, i)
            for new, old, beta in zip(now, blocks, fit.betas, strict=True):
                if new is not old:
                    slope += (new - old) @ beta / step
        jacobian.append(slope)
    return jacobian


def _with_covariance(
    problem: ResidualProblem, members: Sequence[Member], design: Floats, shapes: int, fit: Fit
) -> Fit:
    """Add the joint covariance of (log shapes, coefficients, nuisance)."""
    gram = design.T @ design + priors_of(problem, members, shapes, design.shape[1])
    scale = np.sqrt(np.maximum(gram.diagonal(), 1e-300))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    fit.covariance = inverse / np.outer(scale, scale)
    return fit


def clustered(design: Floats, residual: Floats, inverse: Floats) -> Floats:
    """Return the covariance of least squares from the residual itself, (p, p).

    Errors in the form of a law are correlated over a stretch of the recording and count there as
    one observation, not one per row: the sums of ``design * residual`` over stretches are taken as
    independent (Liang and Zeger, Biometrika 73 (1986) 13, with the factor g / (g - 1)).

    Args:
        design: slopes of the evaluated rows, (rows, p).
        residual: whitened, (rows,).
        inverse: inverse of the normal matrix including the priors, (p, p).
    """
    cuts = np.linspace(0, residual.size, STRETCHES + 1).astype(np.int64)
    scores = np.stack([design[i:j].T @ residual[i:j] for i, j in pairwise(cuts)])
    scores = (scores - scores.mean(axis=0)) @ inverse
    return np.asarray(scores.T @ scores * STRETCHES / (STRETCHES - 1))


def inflation(residual: Floats) -> float:
    """Return the inflation of evidence by a residual's colour and size (1 for unit white noise).

    The variance of a mean over many rows relative to that of unit white noise: variance times
    correlation length.
    """
    n = residual.size
    if n < 32:
        return max(1.0, float(np.mean(residual**2)))
    # Long enough that no lag considered wraps around in the transform.
    size = fast_length(n + n // 4)
    spectrum = np.abs(np.fft.rfft(residual - residual.mean(), size)) ** 2
    correlation = np.fft.irfft(spectrum, size)[: n // 4] / (n - np.arange(n // 4))
    variance = float(correlation[0])
    if variance <= 0:
        return 1.0
    rho = correlation / variance
    alone = rho < POLICY.hangs_together
    cut = int(np.argmax(alone)) if alone.any() else rho.size
    tau = 1.0 + 2.0 * float(np.sum(rho[1:cut]))
    return max(1.0, float(np.mean(residual**2)) * max(tau, 1.0))


def inflated(covariance: Floats, prior: Floats | None, by: float) -> Floats:
    """Return the covariance of parameters if rows are less informative than their number, (p, p).

    With the evidence of the rows, A, and of the priors, P, ``C = (A + P)^-1``: errors of the rows
    with ``by`` times the power give ``C (by A + P) C``. A stated tolerance does not grow with them.

    Args:
        covariance: C, (p, p).
        prior: P, (p, p); None: not known, so that everything grows.
        by: power of the errors relative to that assumed for A.
    """
    stated = np.zeros_like(covariance) if prior is None else covariance @ prior @ covariance
    return np.asarray(stated + by * (covariance - stated))
