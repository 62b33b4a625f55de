"""Confidence intervals of the parameters found.

The interval of a parameter includes the effect of noise, by its colour or by how parts of the
recording scatter; of errors in the law's form (`form`); of the uncertainty of the simulated motion;
and the results of other forms of the law, or of other interpretations of the same force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects, fitted, force
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.effects.base import Context, Param, Trial
from rthyb_rt.diagnose.form import neighbours, of_form
from rthyb_rt.diagnose.policy import POLICY, SIDES
from rthyb_rt.diagnose.problem import Fit, ResidualProblem, whole
from rthyb_rt.diagnose.refinement import clustered, design_of, inflated, inflation, priors_of

STEP = 1e-4
Intervals = dict[str, list[float]]


class Sure:
    """The parameters of a search's best set with their intervals."""

    def __init__(
        self, search: force.Search, ctx: Context, motions: Sequence[ComputedMotion] = ()
    ) -> None:
        """Compute the covariances.

        Args:
            search: the search.
            ctx: the quantities on which the laws depend.
            motions: one standard deviation away from that motion each.
        """
        self.search, self.ctx = search, ctx
        best = search.best
        self.noise = best.covariance
        if best.covariance is not None:
            shapes = sum(len(m.trial.theta) for m in best.members)
            size = shapes + sum(map(len, best.betas)) + best.nuisance.size
            # A fit to a simulated motion has other priors, and no covariance of stated values.
            known = best.covariance.shape[0] == size and best.scatter is None
            prior = priors_of(search.problem, best.members, shapes, size) if known else None
            self.noise = inflated(best.covariance, prior, inflation(best.residual))
        self.shown, self.more = best.scatter, None
        if best.scatter is not None or best.covariance is None or not best.members:
            return
        slopes = design_of(search.problem, best)
        if slopes.shape != (best.residual.size, best.covariance.shape[0]):
            return
        self.shown = clustered(slopes, best.residual, best.covariance)
        self.more = self._of_forms(slopes, best.covariance)
        self.more += self._of_motion(slopes, best.covariance, motions)

    def _of_forms(self, slopes: Floats, inverse: Floats) -> Floats:
        """Return the covariance due to the laws' forms, (p, p)."""
        problem, best, ctx = self.search.problem, self.search.best, self.ctx
        out = np.zeros_like(inverse)
        over = [(ctx.x, ctx.x_range), (ctx.v, ctx.v_range)]
        for i, member in enumerate(best.members):
            if member.effect.sensor:
                continue
            own = fitted.contribution(problem, best, i)
            near = np.column_stack([problem.seen(n) for n in neighbours(own, over)])
            out += of_form(slopes, best.residual, inverse, near)
        return out

    def _of_motion(
        self, slopes: Floats, inverse: Floats, motions: Sequence[ComputedMotion]
    ) -> Floats:
        """Return the covariance due to the motion's uncertainty, (p, p).

        The entire force follows the motion: the part that resembles the laws changes their
        parameters.
        """
        problem, best = self.search.problem, self.search.best
        out = np.zeros_like(inverse)
        plain = whole(problem, best, self.ctx)
        for motion in motions:
            along = replace(self.ctx, motion=motion, ranges=self.ctx.all_ranges)
            moved = problem.seen(whole(problem, best, along) - plain)
            shift = inverse @ (slopes.T @ moved)
            out += np.outer(shift, shift)
        return out

    def of(self, member: int) -> tuple[dict[str, float], Intervals]:
        """Return the parameters of one effect and their 95 % intervals."""
        params, ci = self._in_this_form(member)
        known = self.search.best.members[member].effect.params
        ci = possible(known, params, ci)
        self._widen(ci, params, member)
        return params, within(known, params, ci)

    def strength(self, member: int) -> float | None:
        """Return the squared ratio of an effect's size to its standard deviation; None: no size.

        Other forms of the laws count if they find a smaller size, or the opposite sign: that one
        finds a much larger size widens the interval, but does not make the effect weak.
        """
        fit = self.search.best
        params, ends = self._in_this_form(member)
        own = fit.members[member]
        gone = own.effect.report(self.ctx, own.trial, 0.0 * fit.betas[member])
        forms = self._in_other_forms(own.name)
        sizes = []
        for k, e in ends.items():
            # Its strength, not its location: a frequency is precise however weak the hum.
            if _half(e) > 0.0 and gone[k] == 0.0:
                size, sign = abs(params[k]), np.sign(params[k])
                below = max((size - sign * form[k] for form in forms), default=0.0)
                sizes.append(size / (max(_half(e), below) / SIDES))
        return float(max(sizes)) ** 2 if sizes else None

    def _in_this_form(self, member: int) -> tuple[dict[str, float], Intervals]:
        """Return parameters and intervals as if the laws had no form but that of the best set."""
        best = self.search.best
        params, noise = _symmetric(replace(best, covariance=self.noise), member, self.ctx)
        shown = _symmetric(replace(best, covariance=self.shown), member, self.ctx)[1]
        more = _symmetric(replace(best, covariance=self.more), member, self.ctx)[1]
        ci = {}
        for k, v in params.items():
            if k in noise:
                half = max(_half(noise[k]), _half(shown.get(k, [v, v])))
                half = float(np.hypot(half, _half(more.get(k, [v, v]))))
                ci[k] = [v - half, v + half]
        return params, ci

    def _in_other_forms(self, name: str) -> list[dict[str, float]]:
        """Return the parameters of an effect in the other forms of the laws found."""
        search = self.search
        # A strained stated value that replaces an effect does not show how large the effect is.
        stands = [f for f in search.forms if name not in fitted.bent(search.problem, f)]
        return [
            m.effect.report(self.ctx, m.trial, beta)
            for fit in stands
            for m, beta in zip(fit.members, fit.betas, strict=True)
            if m.name == name
        ]

    def _widen(self, ci: Intervals, params: dict[str, float], member: int) -> None:
        """Extend intervals to the results of other forms of a law, any of which may be true.

        These are not all possible forms either: a law with a shape has a least half-width.
        """
        search, name = self.search, self.search.best.members[member].name
        shaped = any(
            m.name == name and m.trial.theta and not m.effect.sensor for m in search.best.members
        )
        exact = search.problem.estimate.exact
        least = POLICY.interval_simulated if exact else POLICY.interval_estimated
        for other in self._in_other_forms(name):
            for k, v in other.items():
                across = opposite(v, params[k])
                ci[k] = [min(ci[k][0], v, across), max(ci[k][1], v, across)]
        for k, v in params.items():
            half = max(least, POLICY.interval_of_form if shaped else 0.0) * abs(v)
            ci[k] = [min(ci[k][0], v - half), max(ci[k][1], v + half)]


def opposite(value: float, center: float) -> float:
    """Return what lies as far from the center as the value, on its other side.

    The true form of a law may differ from that found as much as another form does, in the other
    direction. Twice as large is opposite to half as large: a size does not change its sign.
    """
    if value * center > center**2:
        return center**2 / value
    return 2.0 * center - value


def possible(known: Sequence[Param], params: dict[str, float], ci: Intervals) -> Intervals:
    """Return intervals that end where a parameter's meaning does.

    A strength may be zero. A size that cannot (a length, a time, a frequency) is as many times
    larger than the lower end as the upper end is larger than the size.
    """
    least = {p.name: p.low for p in known}
    out = {}
    for k, (low, high) in ci.items():
        is_size = params[k] > 0.0 and least.get(k, -np.inf) > 0.0
        out[k] = [opposite(high, params[k]) if is_size else low, high]
    return within(known, params, out)


def _half(ends: list[float]) -> float:
    return 0.5 * (ends[1] - ends[0])


def of_the_spring_there_is(
    problem: ResidualProblem,
    fit: Fit,
    name: str,
    params: dict[str, float],
    ci: dict[str, list[float]],
) -> None:
    """Express the loss of a spring relative to the stiffness found if the model's was wrong.

    Whether as a finding or within the model's tolerance.
    """
    stiffer = sum(
        float(b[0])
        for m, b in zip(fit.members, fit.betas, strict=True)
        if m.name == effects.of_number("k")
    )
    law = effects.catalogue().get(name)
    key = law.of_spring if law is not None else ""
    found = stiffer != 0.0
    # A loop's spring is not the model's if that is only a line through the loop.
    if key != "alpha":
        stiffer += sum(
            float(b)
            for b, nuisance in zip(fit.nuisance, problem.nuisances, strict=True)
            if nuisance.number == "k"
        )
    if key not in params or not stiffer > -POLICY.spring_gone:
        return

    # Only the product of stiffness and gap is observed beyond the gap.
    seen = 1.0
    if key == "gap_m":
        seen = next(
            float(b[0]) for m, b in zip(fit.members, fit.betas, strict=True) if m.name == name
        )

    def counted(value: float) -> float:
        if key == "alpha":
            return 1.0 - (1.0 - value) / (1.0 + stiffer)
        return seen * value / (1.0 + stiffer)

    # If the model's spring is too stiff, the same force results from less slack in the whole spring
    # and more in a part: a recording does not show which part is in series.
    apart = [params[key]] if found else []
    params[key] = counted(params[key])
    ends = [*map(counted, ci[key]), *(seen * v for v in apart)]
    assert law is not None
    ci |= within(law.params, params, {key: [min(ends), max(ends)]})


def within(known: Sequence[Param], params: dict[str, float], ci: Intervals) -> Intervals:
    """Return intervals that end at the limits of a parameter, if it is within them itself."""
    limits = {p.name: (p.low, p.high) for p in known}
    out = {}
    for k, (low, high) in ci.items():
        (least, most), value = limits.get(k, (-np.inf, np.inf)), params[k]
        out[k] = [
            max(low, least) if value >= least else low,
            min(high, most) if value <= most else high,
        ]
    return out


def intervals(fit: Fit, member: int, ctx: Context) -> tuple[dict[str, float], Intervals]:
    """Return the parameters of one effect and their 95 % intervals."""
    params, ci = _symmetric(fit, member, ctx)
    return params, possible(fit.members[member].effect.params, params, ci)


def _symmetric(fit: Fit, member: int, ctx: Context) -> tuple[dict[str, float], Intervals]:
    """Return the same, as the covariance alone gives it."""
    m = fit.members[member]
    params = m.effect.report(ctx, m.trial, fit.betas[member])
    if fit.covariance is None:
        return params, {}
    shapes = [len(f.trial.theta) for f in fit.members]
    widths = [len(b) for b in fit.betas]
    has_shapes = fit.covariance.shape[0] == sum(shapes) + sum(widths) + fit.nuisance.size
    first_shape = sum(shapes[:member])
    first_beta = (sum(shapes) if has_shapes else 0) + sum(widths[:member])
    index = [first_shape + j for j in range(shapes[member])] if has_shapes else []
    index += [first_beta + j for j in range(widths[member])]
    cov = fit.covariance[np.ix_(index, index)]
    gradient: dict[str, list[float]] = {k: [] for k in params}

    for j in range(shapes[member] if has_shapes else 0):
        theta = list(m.trial.theta)
        theta[j] *= np.exp(1e-4)
        moved = m.effect.report(ctx, Trial(tuple(theta), m.trial.variant), fit.betas[member])
        for k in params:
            gradient[k].append((moved[k] - params[k]) / 1e-4)
    for j in range(widths[member]):
        beta = fit.betas[member].copy()
        step = 1e-4 * (abs(beta[j]) or 1e-12)
        beta[j] += step
        moved = m.effect.report(ctx, m.trial, beta)
        for k in params:
            gradient[k].append((moved[k] - params[k]) / step)
    ci = {}
    for k, value in params.items():
        g = np.array(gradient[k])
        half = SIDES * float(np.sqrt(max(g @ cov @ g, 0.0)))
        ci[k] = [value - half, value + half]
    return params, ci
