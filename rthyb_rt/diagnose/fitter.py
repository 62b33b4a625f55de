"""Sets of effects, each refined once along the measured motion, and what is tried with them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from rthyb_rt.diagnose import modulation, redundant
from rthyb_rt.diagnose.effects import catalogue
from rthyb_rt.diagnose.effects.base import Effect, Floats, Trial
from rthyb_rt.diagnose.evidence import held_out_gain
from rthyb_rt.diagnose.fitted import bent, cost
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, compatible
from rthyb_rt.diagnose.refinement import refine

LEADING = 3
"""Number of sets examined more closely."""


JOINT = "+"
"""Ends the key of a set with a joint law."""


class SetFitter:
    """Refines each set once."""

    def __init__(self, problem: ResidualProblem) -> None:
        self.problem = problem
        self.known: dict[tuple[tuple[str, str, tuple[float, ...]], ...], Fit | None] = {}
        self.by_names: dict[tuple[str, ...], Fit] = {}
        self.stated = {n.name for n in problem.nuisances if n.sigma is not None}
        self.exact = problem.estimate.exact
        self.rows = problem.y.size * problem.estimate.share
        self.judged: Literal["force", "motion", "rig"] = "force"
        self.testimony: Callable[[Fit], float] = lambda _: 0.0
        self.witnessed = False

    @property
    def ranked(self) -> list[Fit]:
        """The best fit of each set, the best set first, by chi-squared and price."""
        return sorted(self.by_names.values(), key=self.score)

    @property
    def leading(self) -> Fit | None:
        """The best of them; None if there are none."""
        return min(self.by_names.values(), key=self.score, default=None)

    def fit(self, members: Iterable[Member], driving: bool = False) -> Fit | None:
        """Refine a set; None if it is not a physical law.

        ``driving``: it may have relaxation beside a dashpot that would drive fast motion.
        """
        members = tuple(members)
        key = tuple(sorted((m.name, m.trial.variant, m.trial.theta) for m in members))
        if key not in self.known or (driving and self.known[key] is None):
            found = refine(self.problem, members)
            if found is not None and not self.problem.sensible(found, driving):
                found = None
            if found is not None and not modulation.holds(self.problem, found):
                found = None
            self.known[key] = found
            if found is not None:
                found.chi2 += self.testimony(found)
                self.keep(found)
        return self.known[key]

    def keep(self, found: Fit) -> None:
        """Keep a refined set if it is better than the one with the same names.

        Of two forms of a law, the one with more parameters must earn them. A joint law and single
        ones with its names are two sets: what is said against the one is not true of the other.
        """
        key = (
            (*found.names, JOINT) if any(m.effect.complete for m in found.members) else found.names
        )
        old = self.by_names.get(key)
        if old is None or self.score(found) < self.score(old):
            self.by_names[key] = found

    def hear(self, known: redundant.Witness, members: Sequence[Member], null: Fit) -> Fit:
        """Include redundant channels that show the load cell's errors; return the null as well.

        Args:
            known: the redundant channels.
            members: effects in the shapes to try first.
            null: nuisance parameters only.
        """
        ranked = self.ranked[:LEADING]
        culprit = redundant.accused(known, members)
        for fit in (null, *ranked):
            if culprit is not None and culprit.name not in fit.names:
                beside = (*fit.members, culprit)
                if compatible(beside):
                    self.fit(beside)
        kept = [f for f in (*self.known.values(), *self.by_names.values()) if f is not None]
        fits = list({id(f): f for f in kept}.values())
        self.testimony = redundant.testimony(known, [null, *fits])
        self.witnessed = True
        self.by_names = {}
        for fit in fits:
            fit.chi2 += self.testimony(fit)
            self.keep(fit)
        return replace(null, chi2=null.chi2 + self.testimony(null))

    def held(self, null: Fit) -> Callable[[Fit], float]:
        """Return how much of a set's gain is confirmed on rows to which it was not fitted."""
        against = self.testimony(null)

        def share(fit: Fit) -> float:
            # No set is fitted to the rows of redundant channels.
            if against - self.testimony(fit) > self.price(fit):
                return 1.0
            return held_out_gain(self.problem, fit)

        return share

    def exchange(self) -> None:
        """Give each law of the best sets of each size the form that it has in a leading set.

        A set is refined in one form of each law, the nearest on the grid or by another measure: of
        two sets with the same law, one could otherwise win by that law's form.
        """
        ranked = self.ranked
        sizes = [[f for f in ranked if len(f.members) == size][:LEADING] for size in (1, 2, 3)]
        for fit in [f for own in sizes for f in own]:
            for i, own in enumerate(fit.members):
                forms = {
                    m.trial.variant: (m, b)
                    for f in ranked[:LEADING][::-1]
                    for m, b in zip(f.members, f.betas, strict=True)
                    if m.name == own.name and m.trial.variant != own.trial.variant
                }
                for member, beta in forms.values():
                    self._in_form(fit, i, member, beta)

    def _in_form(self, fit: Fit, which: int, member: Member, beta: Floats) -> None:
        """Try a set with another form, and coefficients, of one of its laws."""
        self.fit((*fit.members[:which], member, *fit.members[which + 1 :]))

    def relieve(self) -> None:
        """Give the best sets the effect that they replace by straining a stated value.

        As a nuisance parameter, the shift costs a few hundred at most, little beside a large
        misfit. Also the best single effects: sets that all contain the wrong one may come first.

        If a set reaches the noise only by that shift, the effect is named even if, beside
        relaxation, it drives fast motion: the shift does so as well, and would go untold.
        """
        at_noise = (1.0 + POLICY.excess_as_noise) * self.rows
        by_name = {e.name: e for e in self.problem.effects}
        for _ in range(2):
            ranked = self.ranked
            alone = [f for f in ranked if len(f.members) == 1][:LEADING]
            strained = {f.names: f for f in (*ranked[:LEADING], *alone) if len(f.members) < 3}
            for fit in strained.values():
                for name in bent(self.problem, fit) - set(fit.names):
                    if name not in by_name or tuple(sorted((*fit.names, name))) in self.by_names:
                        continue
                    members = (*fit.members, Member(by_name[name], Trial()))
                    if compatible(members):
                        self.fit(members, driving=fit.chi2 < at_noise)

    def price(self, fit: Fit) -> float:
        """Return what the parameters of a set must earn, in chi-squared."""
        return cost(self.problem, fit)

    def score(self, fit: Fit) -> float:
        """Return chi-squared and price."""
        return fit.chi2 + self.price(fit)


def without(problem: ResidualProblem, fit: Fit, member: int) -> Fit:
    """Return a set without one effect, whose part of a stated value is returned to that value."""
    gone, beta = fit.members[member], fit.betas[member]
    shift = [float(beta[0]) if n.effect == gone.name else 0.0 for n in problem.nuisances]
    return replace(
        fit,
        members=fit.members[:member] + fit.members[member + 1 :],
        betas=fit.betas[:member] + fit.betas[member + 1 :],
        nuisance=fit.nuisance + np.array(shift),
    )


def plainer_friction() -> dict[str, str]:
    """Return the friction laws that contain a simpler one as a special case, each with that one."""
    return {n: e.plainer for n, e in catalogue().items() if e.dry and e.plainer}


def in_place(problem: ResidualProblem, dry: Effect, own: Member) -> Trial | None:
    """Return dry friction in the shape of a richer law; None if it has no such shape."""
    trial = dry.like(own.trial)
    return trial if possible(problem, dry, trial) else None


def possible(problem: ResidualProblem, effect: Effect, trial: Trial) -> bool:
    """Return whether a shape is within its limits."""
    limits = effect.limits(problem.ctx, trial)
    return all(a <= q <= b for q, (a, b) in zip(trial.theta, limits, strict=True))
