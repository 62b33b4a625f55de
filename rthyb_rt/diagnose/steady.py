"""Whether the parameters of a set are the same in every part of a recording.

A law has one set of parameters. Laws that replace one outside the catalogue imitate its force with
different parameters early and late, or in fast and slow motion, and the residual may be small
enough to pass for noise nevertheless. The rows of a recording are therefore divided by time and by
motion, each part gets parameters of its own, and the gain is compared with chance (Chow,
Econometrica 28 (1960) 591). The right law is only approximate, too: its `form.neighbours` are
included, as large as a form may be off, and what they also explain is no evidence; those of a law
that wears with travel are functions of the travel as well, else its form would differ between early
and late motion, and a law whose forms are no functions of the motion may be any of its kin. Nor is
a slight warming or wear of the specimen: parameters may differ by some per cent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import fitted, instants
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.form import neighbours
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, ResidualProblem
from rthyb_rt.diagnose.refinement import design_of, inflation, priors_of, unfiltered_slopes


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

    For a fit in the force balance; none if it has no parameters, or was refined elsewhere. No gain
    if a change explains less than the form of the least of its laws may.
    """
    slopes = _slopes(problem, fit)
    if slopes is None:
        return ()
    # The nuisance parameters are the same for the entire recording.
    own = unfiltered_slopes(problem, fit)
    seen = _resolved(problem, fit)
    own = own[:, seen]
    design, prior = _beside(*with_forms(problem, fit, slopes), _kin(problem, fit))
    design, prior = instants.with_readings(problem, fit, design, prior)
    shapes = sum(len(m.trial.theta) for m in fit.members)
    # Change of each parameter: for shapes, of the logarithm.
    numbers = np.abs(np.concatenate([np.ones(shapes), *fit.betas]))[seen]
    held = np.diag(np.maximum(POLICY.changed_within * numbers, 1e-150) ** -2.0)
    common = _Common.of(design, prior, fit.residual)
    by_form = POLICY.form_alone * _least_of_one(problem, fit)

    def fall(share: Floats) -> float:
        # A force that changes within a part of the rows is filtered like any other. The rows of a
        # filtered force would be something else: where friction reverses, half of the filter's
        # response, which compares the instant of the reversal, and not the friction.
        changed = [problem.seen(column) for column in (share[:, None] * own).T]
        before, after, rest = common.with_columns(np.column_stack(changed), held)
        # A change that explains so little beside a law may be due to the law's form.
        return 0.0 if common.least - after < by_form else float((before - after) / inflation(rest))

    return tuple(
        Change(part, min(map(fall, shares)), own.shape[1]) for part, shares in _parts(problem)
    )


def _least_of_one(problem: ResidualProblem, fit: Fit) -> float:
    """Return the least that a member of a set explains beside the others, in chi-squared."""
    forces = [problem.seen(fitted.contribution(problem, fit, i)) for i in range(len(fit.members))]

    def alone(which: int) -> float:
        others = forces[:which] + forces[which + 1 :]
        design = np.column_stack([*others, problem.base])
        prior = priors_of(problem, (), len(others), design.shape[1])
        return left(design, prior, forces[which])[0]

    return min(map(alone, range(len(forces))), default=0.0)


def differs(problem: ResidualProblem, fit: Fit) -> bool:
    """Return whether a set's parameters differ in a part of the recording, beyond chance."""
    return any(c.deviations > POLICY.changed_numbers for c in changes(problem, fit))


def _resolved(problem: ResidualProblem, fit: Fit) -> NDArray[np.bool_]:
    """Return which parameters of a set, (p,), more than single readings depend on.

    The width of a step over velocity that the motion passes between two rows is none: it only sets
    the readings in which the force jumps, which are left open anyway, and the force at rest, which
    dry friction does not determine.
    """
    v = problem.ctx.v
    turns = np.flatnonzero(v[:-1] * v[1:] < 0.0)
    passed = float(np.median(np.abs(np.diff(v)[turns]))) if turns.size else 0.0
    out = []
    for member in fit.members:
        effect, trial = member.effect, member.trial
        wider = effect.rounded(trial, passed)
        alike = wider.variant == trial.variant and len(wider.theta) == len(trial.theta)
        out += [not alike or a == b for a, b in zip(trial.theta, wider.theta, strict=False)]
    return np.array(out + [True] * sum(b.size for b in fit.betas))


@dataclass(frozen=True)
class _Common:
    """What several fits share, solved once: the parameters that all of them have.

    Attributes:
        design: slopes to them, (rows, q).
        root: square root of the inverse of their normal matrix, (q, k).
        residual: before any of them changes, (rows,).
        seen: what they explain of it, (k,), by the root.
    """

    design: Floats
    root: Floats
    residual: Floats
    seen: Floats

    @staticmethod
    def of(design: Floats, prior: Floats, residual: Floats) -> _Common:
        """Solve for a design, (rows, q), with a prior, (q, q)."""
        gram = design.T @ design + prior
        unit = 1.0 / np.sqrt(np.maximum(gram.diagonal(), 1e-300))
        values, vectors = np.linalg.eigh(gram * np.outer(unit, unit))
        known = values > 1e-10 * values[-1]
        root = unit[:, None] * vectors[:, known] / np.sqrt(values[known])
        return _Common(design, root, residual, root.T @ (design.T @ residual))

    @property
    def least(self) -> float:
        """Chi-squared, with the priors, if no other parameter changes."""
        return float(self.residual @ self.residual - self.seen @ self.seen)

    @property
    def rest(self) -> Floats:
        """The residual then, (rows,)."""
        return np.asarray(self.residual - self.design @ (self.root @ self.seen))

    def with_columns(self, more: Floats, held: Floats) -> tuple[float, float, Floats]:
        """Return chi-squared with further columns that have a prior, and that are free.

        Args:
            more: the columns, (rows, p).
            held: their prior, (p, p).

        Returns:
            chi-squared with the prior, without it, and the residual without it, (rows,).
        """
        cross = self.root.T @ (self.design.T @ more)
        right = more.T @ self.residual - cross.T @ self.seen
        gram = more.T @ more - cross.T @ cross
        size = (more**2).sum(axis=0)
        falls, free = [], np.zeros(right.size)
        for prior in (held, np.zeros_like(held)):
            unit = 1.0 / np.sqrt(np.maximum(size + prior.diagonal(), 1e-300))
            scaled = (gram + prior) * np.outer(unit, unit)
            free = unit * np.linalg.lstsq(scaled, unit * right, rcond=1e-10)[0]
            falls.append(float(free @ right))
        rest = self.rest - more @ free + self.design @ (self.root @ (cross @ free))
        return self.least - falls[0], self.least - falls[1], rest


def standing(problem: ResidualProblem, fit: Fit) -> tuple[float, float] | None:
    """Return a set's residual with free forms of its laws, and its price, in chi-squared.

    The third value is the inflation due to correlated rows. None if it has no slopes here.
    """
    slopes = _slopes(problem, fit)
    if slopes is None:
        return None
    least, rest = left(*with_forms(problem, fit, slopes), fit.residual)
    return least + fitted.cost(problem, fit), inflation(rest)


def past_forms(problem: ResidualProblem, fit: Fit, more: Fit) -> float:
    """Return what one more effect earns if the laws beside it may take other forms.

    As a reduction of chi-squared. Those forms are the neighbours of the laws of the smaller set,
    with and without the effect. Infinite if one of the sets has no slopes here.

    Args:
        problem: the problem.
        fit: the set without the effect.
        more: the set with it.
    """
    near = np.column_stack([_near(problem, fit), *_kin(problem, fit)])
    alone, both = (_least_beside(problem, f, near) for f in (fit, more))
    return float("inf") if alone is None or both is None else alone - both


def _least_beside(problem: ResidualProblem, fit: Fit, near: Floats) -> float | None:
    """Return chi-squared of a set beside other forms of some laws; None without slopes.

    The cost of its stated values is included: one more row for each of them.
    """
    slopes = _slopes(problem, fit)
    if slopes is None:
        return None
    shapes, size = sum(len(m.trial.theta) for m in fit.members), slopes.shape[1]
    weights = np.sqrt(priors_of(problem, fit.members, shapes, size).diagonal())
    off = np.r_[np.zeros(shapes), *(b - 1.0 for b in fit.betas), fit.nuisance]
    design, held = _beside(slopes, np.zeros((size, size)), [near])
    cost = np.pad(np.diag(weights), ((0, 0), (0, near.shape[1])))
    return left(np.vstack([design, cost]), held, np.r_[fit.residual, -off * weights])[0]


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
    shapes = sum(len(m.trial.theta) for m in fit.members)
    prior = priors_of(problem, fit.members, shapes, slopes.shape[1])
    return _beside(slopes, prior, [_near(problem, fit)])


def _beside(design: Floats, prior: Floats, forms: list[Floats]) -> tuple[Floats, Floats]:
    """Return design and prior with columns that are no larger than a form may be off."""
    more = np.column_stack([design, *forms])
    wider = np.pad(prior, (0, more.shape[1] - design.shape[1]))
    at = np.arange(design.shape[1], more.shape[1])
    wider[at, at] = POLICY.form_error**-2
    return more, wider


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
            fitted.contribution(problem, fit, i), worn if member.effect.wears else over
        )
    ]
    return np.column_stack(columns) if columns else np.zeros((fit.residual.size, 0))


def _kin(problem: ResidualProblem, fit: Fit) -> list[Floats]:
    """Return how the forces of the laws with a memory differ in its other forms, each (rows,).

    No function of displacement and velocity turns one into another. By the whole difference, since
    the true form may be either, or between them: the prior of the neighbours is `form_error`.
    """
    out = []
    for i, member in enumerate(fit.members):
        own = fitted.contribution(problem, fit, i)
        for trial in member.effect.kin(member.trial):
            other = np.column_stack(member.effect.columns(problem.ctx, trial))
            made = other @ np.linalg.lstsq(other, own, rcond=None)[0]
            out.append(problem.seen(made - own) / POLICY.form_error)
    return out


def _parts(problem: ResidualProblem) -> list[tuple[str, tuple[Floats, ...]]]:
    """Return divisions of the recording that halve its evaluated rows: name, and one part.

    A part is a share from 0 to 1 of every row, (n,); of several, a change must show in each.
    """
    x, v = problem.ctx.x, problem.ctx.v
    judged = problem.rows

    def upper(values: Floats, least: float) -> Floats:
        return np.where(values > least, 1.0, 0.0)

    def half(values: Floats) -> tuple[Floats]:
        return (upper(values, float(np.median(values[judged]))),)

    # Where the motion reverses, friction changes anyway: a part that ends there also compares the
    # instants of these changes, one that fades out with the velocity also their neighbourhood.
    typical = float(np.median(np.abs(v[judged]))) or 1e-300
    one_way = (upper(v, 0.0), 0.5 + 0.5 * v / np.hypot(v, typical))
    return [
        (
            "the second half of the recording",
            (upper(np.arange(float(x.size)), judged[judged.size // 2] - 0.5),),
        ),
        ("large displacements", half(np.abs(x))),
        ("fast motion", half(np.abs(v))),
        ("motion that slows down", (upper(-v * problem.ctx.a, 0.0),)),
        ("displacements to one side", half(x)),
        ("motion in one direction", one_way),
    ]


def left(design: Floats, prior: Floats, residual: Floats) -> tuple[float, Floats]:
    """Return chi-squared of least squares with its priors, and the residual, (rows,)."""
    found = _Common.of(design, prior, residual)
    return found.least, found.rest
