"""The force channel: effects of the specimen, or of its load cell, missing from the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from rthyb_rt.diagnose import decay, modulation, noise, onset, redundant
from rthyb_rt.diagnose.decide import Ruling
from rthyb_rt.diagnose.effects import catalogue, having, of_number
from rthyb_rt.diagnose.effects.base import Effect, Floats, Trial
from rthyb_rt.diagnose.evidence import Gathered, held_out_gain
from rthyb_rt.diagnose.fitted import bent, cost, count
from rthyb_rt.diagnose.freebody import Body
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.select import (
    Dictionary,
    Fit,
    Member,
    ResidualProblem,
    Solved,
    compatible,
    inflation,
    names_of,
    refine,
    solve,
)

POOL = 6
"""Number of sets, and of single effects, whose motion is simulated."""
LEADING = 3
"""Number of sets examined more closely."""
SEEDS = 8
"""Number of sets with which a search with less evidence begins."""
SETTLED = 0.01
"""Fraction of a misfit by which a further fit of a motion must improve it."""
PARTS = 150
"""Simulations reserved for subsets of the best sets: three fits of a set of two."""
RIVALS = 6
"""Number of sets kept for display beside the one that is named."""
AGAIN = 3
"""Largest number of times that such a fit is restarted."""
NUMBERS = ("k", "c", "moving_mass")
"""Numbers of the model whose effects are always candidates: at one frequency, a missing effect may
look like them."""


@dataclass
class Search:
    """Result of a search.

    Attributes:
        null: nuisance parameters only.
        fits: refined sets, best first.
        best: the set that is named; without members if nothing is missing.
        equal: other sets that fit equally well.
        excess_before, excess_after: misfit beyond noise, per row, in units of the noise.
        gain: what `best` earns beyond its price.
        held_gain: reduction of the misfit on blocks held out, relative to that on all blocks.
        scale: factor by which evidence was scaled down for coloured noise.
        moved: whether the simulated motion was evaluated, see `freebody`.
        balance: result from the force balance, if it was not accepted.
        pool: the best sets before evidence was scaled, whether or not they were rejected later.
        quiet: whether the residual of a simulated motion is within the displacement's data sheet.
        ledger: what each rule of `decide` did.
    """

    problem: ResidualProblem
    null: Fit
    fits: list[Fit]
    best: Fit
    equal: list[Fit]
    excess_before: float
    excess_after: float
    gain: float
    held_gain: float
    scale: float
    rivals: list[Fit] = field(default_factory=list)
    forms: list[Fit] = field(default_factory=list)
    moved: bool = False
    balance: Search | None = None
    pool: list[Fit] = field(default_factory=list)
    quiet: bool = False
    ledger: tuple[Ruling, ...] = ()


class _Fitter:
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

        Of two forms of a law, the one with more parameters must earn them.
        """
        old = self.by_names.get(found.names)
        if old is None or self.score(found) < self.score(old):
            self.by_names[found.names] = found

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
        return cost(self.problem, fit)

    def score(self, fit: Fit) -> float:
        return fit.chi2 + self.price(fit)


class _Mover(_Fitter):
    """Refines sets by the motion that they simulate."""

    def __init__(self, problem: ResidualProblem, body: Body, first: _Fitter) -> None:
        super().__init__(problem)
        self.body, self.first = body, first
        self.tried: list[Fit] = []
        self.scale = 1.0
        # A simulated motion is no estimate, but two accurate simulators differ slightly.
        self.exact, self.rows = True, float(body.rows.size)
        self.judged = "rig" if body.whole_rig else "motion"

    def complete(self, enough: float) -> None:
        """Try each number of the model beside the best set that can be larger.

        If it leaves more than ``enough``: one that came to the front last, by the subsets of a
        wrong one, has not been extended.
        """
        fit = next((f for f in self.ranked if len(f.names) < self.body.largest), None)
        if fit is None or fit.chi2 < enough:
            return
        self.body.runs = max(self.body.runs, PARTS)
        for effect in self.problem.effects:
            members = (*fit.members, Member(effect, Trial()))
            if effect.number and compatible(members) and names_of(members) not in self.by_names:
                self.fit(members)

    def move(self, fit: Fit) -> Fit | None:
        """Refine a set that was found in the force balance; the better of its shapes is kept.

        A set that reproduces the motion cannot be improved from another start, and one that has an
        effect twice is the same as without the second.
        """
        if not self.body.distinct(fit):
            return None
        known = self.by_names.get(fit.names)
        if known is not None and known.chi2 < POLICY.motion_met_alone * self.rows:
            return known
        return self._simulated(fit)

    def _simulated(self, fit: Fit) -> Fit | None:
        found = self.body.settled(self.problem, fit)
        if found is None:
            return None
        self._scaled(found)
        self.tried.append(found)
        old = self.by_names.get(fit.names)
        if old is None or found.chi2 < old.chi2:
            self.by_names[fit.names] = found
        return self.by_names[fit.names]

    def fit(self, members: Iterable[Member], driving: bool = False) -> Fit | None:
        begun = self.first.fit(members, driving)
        return self.move(begun) if begun is not None else None

    def rescale(self, scale: float, plain: Fit) -> None:
        """Scale down the evidence of rows in all simulations, past and future.

        Coloured noise makes rows less informative; the tolerances of the model are unaffected.
        """
        self.scale = scale
        for fit in (plain, *self.tried):
            self._scaled(fit)

    def _scaled(self, fit: Fit) -> None:
        own = float(fit.residual @ fit.residual)
        fit.chi2 += own / self.scale - own

    def pointless(self, names: tuple[str, ...]) -> bool:
        """Return whether a set need not be simulated: if without one or more of its effects, or
        with fewer others, the noise is reached and no stated value leaves its tolerance.

        For a whole rig, a set with one more effect is simulated nevertheless: its force may be
        small.
        """
        met = [f for f in self.by_names.values() if f.chi2 < POLICY.motion_met_alone * self.rows]
        return any(
            len(f.names) + (self.body.whole_rig and set(f.names) < set(names)) < len(names)
            for f in met
            if not bent(self.problem, f)
        )

    def plain_friction(self) -> None:
        """Replace a more complex friction by dry friction in the best sets.

        They contain it as a special case, and a rig that is reproduced with one may be without it.
        """
        plainer = _plainer_friction()
        for fit in self.ranked[:LEADING]:
            rich = [i for i, m in enumerate(fit.members) if m.name in plainer]
            if len(rich) != 1 or plainer[fit.members[rich[0]].name] in fit.names:
                continue
            name = plainer[fit.members[rich[0]].name]
            dry = next((e for e in self.problem.effects if e.name == name), None)
            if dry is None:
                continue
            own = fit.members[rich[0]]
            sheared = _in_place(self.problem, dry, own) if own.effect.slides else None
            members, betas = list(fit.members), list(fit.betas)
            members[rich[0]] = Member(dry, sheared or Trial())
            betas[rich[0]] = fit.betas[rich[0]][:1]
            twin = replace(fit, members=tuple(members), betas=tuple(betas), covariance=None)
            known = self.by_names.get(twin.names)
            # It may have been tried as a step, which fits worse than a contact that shears.
            if known is None or (sheared is not None and known.chi2 > (1.0 + SETTLED) * fit.chi2):
                self.move(twin)

    def springs(self) -> None:
        """Try the best sets with each form of their elastic springs, and each form alone.

        The spring is nearly all of the force of a free decay, and the balance, along an estimated
        motion, can prefer a form with which the motion cannot be simulated. Beside a friction that
        imitates the damping, the right form may fit no better.
        """
        alone: set[Member] = set()
        for fit in self.ranked[:LEADING]:
            for i, own in enumerate(fit.members):
                trials = own.effect.trials(self.problem.ctx) if own.effect.elastic else ()
                forms = {t.variant: t for t in reversed(trials) if t.variant != own.trial.variant}
                for trial in forms.values():
                    other = replace(own, trial=trial)
                    self.fit((*fit.members[:i], other, *fit.members[i + 1 :]))
                    if len(fit.members) > 1 and other not in alone:
                        alone.add(other)
                        self.fit((other,))

    def _in_form(self, fit: Fit, which: int, member: Member, beta: Floats) -> None:
        members = (*fit.members[:which], member, *fit.members[which + 1 :])
        betas = (*fit.betas[:which], beta, *fit.betas[which + 1 :])
        self.move(replace(fit, members=members, betas=betas, covariance=None))

    def settle(self) -> None:
        """Continue with the best sets until they no longer change, then with their subsets.

        A set with one more law may have found the optimum that its subset has missed.
        """
        for fit in self.ranked[:LEADING]:
            self._refine(fit)
        # Regardless of the number of simulations so far: a subset that was not evaluated must not
        # count as one that fails.
        self.body.runs = max(self.body.runs, PARTS)
        done: set[tuple[str, ...]] = set()
        for _ in range(2):
            ahead = self.ranked[:LEADING]
            for fit in [f for f in ahead if len(f.members) > 1 and f.names not in done]:
                done.add(fit.names)
                for i in range(len(fit.members)):
                    part = _without(self.problem, fit, i)
                    # If the rig is reproduced, only the misfit of the subsets is needed.
                    met = self.body.whole_rig and fit.chi2 < POLICY.motion_met_alone * self.rows
                    if not (met and part.names in self.by_names):
                        self.move(part)

    def elsewhere(self) -> None:
        """Refine the best set again from where larger sets left its laws, if its friction sticks.

        The misfit of such a motion has many minima, nearly as deep as one another. The deepest one
        counts, and their scatter is part of the interval, see `_forms`.
        """
        best = self.leading
        if best is None or not any(m.effect.dry for m in best.members):
            return
        larger = [
            f
            for f in self.ranked
            if len(f.members) == len(best.members) + 1 and set(best.names) < set(f.names)
        ]
        for fit in larger[:LEADING]:
            added = [i for i, m in enumerate(fit.members) if m.name not in best.names]
            part = _without(self.problem, fit, added[0])
            if part.names == best.names and self.body.distinct(part):
                self._simulated(part)

    def _refine(self, fit: Fit) -> None:
        for _ in range(AGAIN):
            before = fit.chi2
            if before < POLICY.motion_met_alone * self.rows:
                break
            found = self.move(fit)
            if found is None or found.chi2 > (1.0 - SETTLED) * before:
                break
            fit = found


def _without(problem: ResidualProblem, fit: Fit, member: int) -> Fit:
    """Return a set without one effect, whose part of a stated value is returned to that value."""
    gone, beta = fit.members[member], fit.betas[member]
    shift = [float(beta[0]) if n.effect == gone.name else 0.0 for n in problem.nuisances]
    return replace(
        fit,
        members=fit.members[:member] + fit.members[member + 1 :],
        betas=fit.betas[:member] + fit.betas[member + 1 :],
        nuisance=fit.nuisance + np.array(shift),
    )


def _remaining(problem: ResidualProblem, fit: Fit, member: int) -> Fit:
    """Return a set without one effect, as a part to which another one is added.

    Alone, the rest might have signs that no law permits: then with the coefficients of the set.
    """
    rest = fit.members[:member] + fit.members[member + 1 :]
    alone = solve(problem, rest, problem.blocks(rest))
    return _without(problem, fit, member) if alone is None else alone


def _stiff(problem: ResidualProblem) -> ResidualProblem:
    """Return a problem with tight tolerances, so that an effect begins with all the misfit."""
    out = copy(problem)
    out.nuisances = [
        n if n.sigma is None else replace(n, sigma=1e-3 * n.sigma) for n in problem.nuisances
    ]
    return out


def _linear(
    problem: ResidualProblem, body: Body, fitter: _Fitter, null: Fit
) -> tuple[Fit, _Mover] | None:
    """Evaluate nothing and each linear effect by its motion; None if that diverges.

    A set that contains one of them must be compared with it.
    """
    plain = body.refined(problem, null)
    if plain is None:
        return None
    mover = _Mover(problem, body, fitter)
    by_name = {e.name: e for e in problem.effects}
    stiff = _stiff(problem)
    for name in map(of_number, NUMBERS):
        if name in by_name and body.linear:
            member = Member(by_name[name], Trial())
            begun = solve(stiff, [member], [stiff.columns(member)])
            if begun is not None:
                mover.move(begun)
    return _nothing(problem, body, mover, plain), mover


def _nothing(problem: ResidualProblem, body: Body, mover: _Mover, plain: Fit) -> Fit:
    """Return nuisance parameters only, started from the best effect if it reproduces the motion.

    The balance may start them too far off: then an effect of zero size would explain the
    difference. If the motion is not reproduced from there either, an effect of some size is needed.
    """
    best = min(mover.by_names.values(), key=lambda f: f.chi2, default=plain)
    if len(best.members) != 1 or best.chi2 >= plain.chi2 or plain.chi2 < body.met * mover.rows:
        return plain
    again = body.refined(problem, _without(problem, best, 0))
    return again if again is not None and again.chi2 < body.met * mover.rows else plain


def _met(plain: Fit, mover: _Mover) -> bool:
    """Return whether a linear effect reproduces the displacement to its noise, and is needed.

    What a displacement does not show at all is left to the force balance.
    """
    return any(
        inflation(f.residual) < POLICY.white_residual and mover.score(f) < plain.chi2
        for f in mover.by_names.values()
    )


def _plainer_friction() -> dict[str, str]:
    """Return the friction laws that contain a simpler one as a special case, each with that one."""
    return {n: e.plainer for n, e in catalogue().items() if e.dry and e.plainer}


def _slow_as() -> dict[str, str]:
    """Return the effects that slow motion cannot distinguish from a simpler one, with that one."""
    return {n: e.slow_as for n, e in catalogue().items() if e.slow_as}


def _lasting(fit: Fit) -> Fit:
    """Return a set whose effects act throughout: those of a simulated body have no onset.

    Along an estimated motion, an onset may have only absorbed what the estimate lacks.
    """
    members = tuple(onset.lasting(m) for m in fit.members)
    return fit if members == fit.members else replace(fit, members=members, covariance=None)


def _seen_only(members: Iterable[Member]) -> bool:
    """Return whether a set contains a load cell effect, which moves nothing."""
    return any(m.effect.sensor for m in members)


def _simplest(dictionary: Dictionary, body: Body, mover: _Mover, singles: Sequence[Fit]) -> None:
    """Add laws of one parameter to the best set of them, one after the other.

    They need the fewest simulations. A law of many parameters that imitates several of them needs
    the most, and would leave none for them.
    """
    for fit in [f for f in singles if count(mover.problem, f) == 1][:LEADING]:
        mover.move(fit)
    for _ in range(1, body.largest):
        best = mover.leading
        if best is None or best.chi2 < body.met * mover.rows:
            break
        for members in _beside(dictionary, best, POOL):
            added, names = members[-1], names_of(members)
            simple = added.effect.settings(mover.problem.ctx, added.trial)[1] == 1
            if simple and names not in mover.by_names:
                mover.fit(members)


def _moved(
    dictionary: Dictionary, body: Body, fitter: _Fitter, named: Fit, plain: Fit, mover: _Mover
) -> Search | None:
    """Evaluate the most promising sets by simulated motion; None if none reproduces it."""
    problem = dictionary.problem
    ranked = [_lasting(f) for f in fitter.ranked]
    ranked = [f for f in ranked if body.quick(f) and body.distinct(f)]
    # Effects seen only by the load cell do not move the body.
    ranked = [f for f in ranked if not body.held or not _seen_only(f.members)]
    singles = [f for f in ranked if len(f.members) == 1]
    # The set named by the balance and its first set, after their subsets: the number of simulations
    # is limited. Alone, a law is among the singles, unless it is slow to simulate.
    felt = [f for f in (_lasting(named), *ranked[:1]) if not body.held or not _seen_only(f.members)]
    several = range(2, body.largest + 1)
    leading = [
        f
        for f in {f.names: f for f in felt}.values()
        if len(f.members) in several or (len(f.members) == 1 and not body.quick(f))
    ]
    parts = [f for f in singles if any(set(f.names) < set(whole.names) for whole in leading)]
    first = body.first(ranked)
    for fit in first:
        mover.move(fit)
    if problem.decays:
        mover.springs()
    # If those explain the motion, only similar sets are examined.
    enough = any(
        f.chi2 < POLICY.moved_decisive * plain.chi2 for f in mover.by_names.values() if first
    )
    if body.whole_rig:
        _simplest(dictionary, body, mover, singles)
    pool = [f for f in ranked if body.plain(f.members)] if enough else ranked
    for fit in [*([] if enough else (*parts, *leading, *singles[:POOL])), *pool[:POOL]]:
        if fit.names not in mover.by_names and not mover.pointless(fit.names):
            mover.move(fit)
    n = float(body.rows.size)
    grown: set[tuple[str, ...]] = set()
    for _ in range(2):
        best = min((plain, *mover.by_names.values()), key=mover.score)
        if best.chi2 < body.met * n:
            break
        mover.relieve()
        ahead = mover.ranked[:LEADING]
        for fit in [f for f in ahead if len(f.names) < body.largest and f.names not in grown]:
            grown.add(fit.names)
            for members in _beside(dictionary, fit, POOL):
                if (body.held and _seen_only(members)) or (enough and not body.plain(members)):
                    continue
                if names_of(members) not in mover.by_names:
                    mover.fit(members)
    mover.relieve()
    mover.plain_friction()
    if problem.decays:
        mover.exchange()
    mover.settle()
    # A subset that now leads may strain a stated value, or have a simpler friction.
    body.runs = max(body.runs, PARTS)
    mover.relieve()
    mover.plain_friction()
    mover.elsewhere()
    mover.complete(body.met * n)
    best = min((plain, *mover.by_names.values()), key=mover.score)
    scale, before = inflation(best.residual), plain.chi2
    mover.rescale(scale, plain)
    found = _decide(problem, mover, plain, (before, n), scale, lambda _: 1.0)
    found.quiet = body.quiet(found.best)
    left = found.excess_after / max(found.excess_before, 1e-12)
    met = found.quiet or found.excess_after < POLICY.moved_excess or left < POLICY.moved_decisive
    return found if met else None


def search(
    problem: ResidualProblem,
    progress: Callable[[str], None] = lambda _: None,
    body: Body | None = None,
    doubtful: Callable[[Search], bool] = lambda _: False,
    seeds: Sequence[tuple[Member, ...]] = (),
) -> Search:
    """Find the set of effects that explains the force residual.

    Args:
        problem: the residual and the effects.
        progress: receives the name of each effect and stage.
        body: a freely moving body, whose sets can be evaluated by their motion.
        doubtful: whether the result of the force balance must be evaluated in this way.
        seeds: sets to refine as well, from the given shapes.
    """
    null = solve(problem, [], [])
    if null is None:
        raise ValueError("the nuisance cannot be solved")
    plain_null, n = null.chi2, problem.y.size * problem.estimate.share
    dictionary = Dictionary(problem, progress)
    fitter, scale = _Fitter(problem), 1.0
    _sweep(dictionary, fitter, seeds)
    progress("onset")
    if problem.case.model.k_tol is not None:
        # A naive model is refitted as a whole: what it lacks has no onset.
        _begun(dictionary, fitter)
    pool = fitter.ranked[: noise.TRIED]
    if fitter.by_names:
        fitter, null, scale = _scaled_down(dictionary, fitter, null)
    known = redundant.witness(problem.case, problem.ctx, problem.estimate)
    if known is not None:
        progress("redundant channels")
        null = fitter.hear(known, [g.member for g in dictionary.groups], null)
        plain_null += fitter.testimony(null)
    progress("gate")
    done = _decide(problem, fitter, null, (plain_null, n), scale, fitter.held(null))
    done.pool = pool
    if body is None:
        return done
    doubted = doubtful(done) or _refused(fitter, done)
    if doubted or done.best.members:
        progress("motion")
        begun = _linear(problem, body, fitter, null)
        # If one linear effect simulates the motion to the noise, the balance cannot improve on it.
        if begun is not None and (doubted or _met(*begun)):
            by_motion = _moved(dictionary, body, fitter, done.best, *begun)
            return replace(by_motion, balance=done) if by_motion is not None else done
    return done


def _begun(dictionary: Dictionary, fitter: _Fitter) -> None:
    """Try effects with an onset, others in combination, and then their onsets again."""
    for fit in onset.propose(dictionary, fitter)[:LEADING]:
        for members in _beside(dictionary, fit, 4) if len(fit.members) < 3 else ():
            fitter.fit(members)
    onset.settle(fitter, LEADING)


def _sure_of_its_beginning(fitter: _Fitter) -> Fit:
    """Return the best set; one with an onset only if noise cannot explain it.

    A law with a free onset absorbs slow noise from some time on: its gain must be scaled down for
    correlated rows before its residual shows how much.
    """
    fits = fitter.by_names.values()
    best = min(fits, key=fitter.score)
    throughout = [f for f in fits if not any(m.effect.late for m in f.members)]
    if best in throughout or not throughout:
        return best
    plain = min(throughout, key=fitter.score)
    gain = (plain.chi2 - best.chi2) / inflation(plain.residual)
    return best if gain > fitter.price(best) - fitter.price(plain) else plain


def _refused(fitter: _Fitter, done: Search) -> bool:
    """Return whether one more effect earns its price many times, but was rejected for its share.

    Such an effect does not absorb noise; whether it absorbs the error of the estimated motion is
    shown by its simulation.
    """
    best = done.best
    if not best.members or done.excess_after < POLICY.refused_excess:
        return False
    return any(
        len(f.names) == len(best.names) + 1
        and set(best.names) < set(f.names)
        and best.chi2 - f.chi2 > POLICY.refused_price * (fitter.price(f) - fitter.price(best))
        for f in fitter.by_names.values()
    )


def _scaled_down(dictionary: Dictionary, fitter: _Fitter, null: Fit) -> tuple[_Fitter, Fit, float]:
    """Repeat the search with less evidence per row if the best set leaves correlated rows.

    A set that is found only then may leave much less than the one whose residual set the scale: the
    search is repeated from it once more.

    Returns:
        The sets found, the model alone, and the factor by which their evidence was divided.
    """
    problem, scale = dictionary.problem, 1.0
    best = _sure_of_its_beginning(fitter)
    seeds = [f.members for f in fitter.ranked[:SEEDS]]
    for turn in range(2):
        found = inflation(np.sqrt(scale) * best.residual)
        found = found if found > POLICY.coloured_evidence else 1.0
        if found == scale or (turn and found * POLICY.coloured_evidence > scale):
            break
        problem.rescale(found / scale)
        dictionary.grams *= scale / found
        null, fitter, scale = solve(problem, [], []) or null, _Fitter(problem), found
        _sweep(dictionary, fitter, seeds)
        if not fitter.by_names:
            break
        best = fitter.ranked[0]
        seeds = [best.members, *seeds]
    return fitter, null, scale


def _sweep(
    dictionary: Dictionary, fitter: _Fitter, seeds: Iterable[tuple[Member, ...]] = ()
) -> None:
    """Refine the most promising singles, pairs and triples."""
    groups = dictionary.groups

    def members(found: list[tuple[int, ...]]) -> list[tuple[Member, ...]]:
        return [tuple(groups[g].member for g in gs) for gs in found]

    null = dictionary.reduced()[2]
    singles = _promising(dictionary, dictionary.singles(), null)
    for group in members(dictionary.best(singles, 8, 4)):
        fitter.fit(group)
    best = float(singles.chi2.min(initial=np.inf)) if len(singles) else null
    pairs = _promising(dictionary, dictionary.pairs(), null)
    # A pair must be better than its better member before its shapes are worth fitting.
    if len(singles):
        pairs = pairs.where(pairs.chi2 < best - POLICY.promising_pair)
    leading = dictionary.best(pairs, 12)
    for group in members(leading[:10]):
        fitter.fit(group)
    _grow(dictionary, fitter)
    _damped(dictionary, fitter)
    _modulated(fitter)
    reached = min((f.chi2 for f in fitter.by_names.values()), default=best)
    rows = dictionary.problem.y.size * dictionary.problem.estimate.share
    if reached > POLICY.search_ends * rows:
        triples = _promising(dictionary, dictionary.extended(leading), null)
        for group in members(dictionary.best(triples, 6)):
            fitter.fit(group)
    for group in seeds:
        fitter.fit(group)
    _dashpots(dictionary, fitter)
    fitter.relieve()
    formed = _reformed(dictionary, fitter)
    fitter.exchange()
    _with_dry_friction(fitter)
    _nested(dictionary, fitter)
    _replaced(dictionary, fitter)
    # Subsets of refined sets must be present for comparison.
    for fit in list(fitter.by_names.values()):
        for i in range(len(fit.members) if len(fit.members) > 1 else 0):
            rest = tuple(m for j, m in enumerate(fit.members) if j != i)
            names = names_of(rest)
            if names not in fitter.by_names:
                fitter.fit(rest)
    # The parts of the best sets once more, from the shapes that they have there: another form would
    # require the effect left out, and a part that was refined into another minimum would, too.
    ranked = fitter.ranked
    for fit in [f for f in ranked[:2] if len(f.members) > 1]:
        for i in range(len(fit.members)):
            fitter.fit(fit.members[:i] + fit.members[i + 1 :])
    if fitter.leading is not None and fitter.leading.names != formed:
        # What stands beside another law now may take another form there.
        _reformed(dictionary, fitter)


def _reformed(dictionary: Dictionary, fitter: _Fitter) -> tuple[str, ...] | None:
    """Try the other forms of the laws of the best sets; return the names of the best one before.

    A set that reaches the noise by straining a stated value may stand for another law of friction.
    """
    problem = fitter.problem
    first = fitter.leading
    if first is None:
        return None
    strained = bool(bent(problem, first) - set(first.names))
    rows = problem.y.size * problem.estimate.share
    _reform(dictionary, fitter, strained or first.chi2 > POLICY.search_ends * rows)
    return first.names


def _with_dry_friction(fitter: _Fitter) -> None:
    """Refine the best sets with dry friction in place of a richer law, which must be compared.

    On the grid of shapes, the richer law may be so much nearer that dry friction was not tried
    beside these others.
    """
    by_name, plainer = {e.name: e for e in fitter.problem.effects}, _plainer_friction()
    for fit in fitter.ranked[:LEADING]:
        for i, own in enumerate(fit.members):
            dry = by_name.get(plainer.get(own.name, ""))
            rest = fit.members[:i] + fit.members[i + 1 :]
            if dry is None or {dry.name, *(m.name for m in rest)} in map(set, fitter.by_names):
                continue
            trial = _in_place(fitter.problem, dry, own)
            if trial is not None and compatible((*rest, Member(dry, trial))):
                fitter.fit((*rest, Member(dry, trial)))


def _in_place(problem: ResidualProblem, dry: Effect, own: Member) -> Trial | None:
    """Return dry friction in the shape of a richer law; None if it has no such shape."""
    trial = dry.like(own.trial)
    return trial if _possible(problem, dry, trial) else None


def _possible(problem: ResidualProblem, effect: Effect, trial: Trial) -> bool:
    """Return whether a shape is within its limits."""
    limits = effect.limits(problem.ctx, trial)
    return all(a <= q <= b for q, (a, b) in zip(trial.theta, limits, strict=True))


def _nested(dictionary: Dictionary, fitter: _Fitter) -> None:
    """Refine again, from its best subset, each set that fits worse than that subset.

    A set contains its subset as a special case and cannot fit worse: it has been refined into
    another minimum. The effect that the subset lacks begins in its refined shape, and in the most
    promising one of the dictionary beside the subset.
    """
    for part in fitter.ranked[:LEADING]:
        worse = [
            f
            for f in fitter.by_names.values()
            if len(f.members) == len(part.members) + 1
            and set(part.names) < set(f.names)
            and f.chi2 > part.chi2
        ]
        if not worse:
            continue
        products = dictionary.beside(part)
        for fit in worse:
            added = [m for m in fit.members if not set(m.effect.names) <= set(part.names)]
            if len(added) != 1:
                continue
            own = [(g,) for g, group in enumerate(dictionary.groups)
                   if group.member.name == added[0].name]  # fmt: skip
            for (g,) in dictionary.best(dictionary.sets(own, products), 1):
                added.append(dictionary.groups[g].member)
            for member in added:
                if compatible([*part.members, member]):
                    fitter.fit((*part.members, member))


def _reform(dictionary: Dictionary, fitter: _Fitter, dry: bool) -> None:
    """Try the other forms of each law of the best sets together with the refined rest.

    The sweep refines only one form of a set, the nearest on the grid. If requested, laws of dry
    friction are treated as forms of one another; one that contains dry friction also begins with
    the step that dry friction has beside the rest.
    """
    problem, groups = fitter.problem, dictionary.groups
    friction = having(lambda e: e.dry)
    ranked = [f for f in fitter.ranked if len(f.members) > 1]
    leading = ranked[:2]
    if dry:  # the best set with each other law of friction as well
        of_each = [next((f for f in ranked if n in f.names), None) for n in sorted(friction)]
        leading += [f for f in of_each if f is not None and f not in leading]
    for fit in leading:
        for i, member in enumerate(fit.members):
            like = friction if dry and member.name in friction else frozenset((member.name,))
            others = [
                (g,)
                for g, group in enumerate(groups)
                if group.member.name in like
                and (group.member.name, group.member.trial.variant)
                != (member.name, member.trial.variant)
            ]
            rest = fit.members[:i] + fit.members[i + 1 :]
            if not others or like & {n for m in rest for n in m.effect.names}:
                continue
            found = dictionary.sets(others, dictionary.beside(_remaining(problem, fit, i)))
            # All, if the form of friction is in doubt: on the grid, a smoother jump leads.
            for (g,) in dictionary.best(found, len(like), len(others) if dry else 2):
                for other in _begun_from(problem, groups[g].member, member):
                    if compatible([*rest, other]):
                        fitter.fit((*rest, other))


def _begun_from(problem: ResidualProblem, other: Member, plain: Member) -> list[Member]:
    """Return a law as in the dictionary, and with the step of the simpler law that it contains."""
    if other.effect.plainer != plain.name:
        return [other]
    shape = other.effect.beyond(plain.trial, other.trial)
    if shape == other.trial or not _possible(problem, other.effect, shape):
        return [other]
    return [other, Member(other.effect, shape)]


def _replaced(dictionary: Dictionary, fitter: _Fitter) -> None:
    """Replace each law of the best set of three or more by each other one, while that improves it.

    Such a set is built up from its best subset: a law that stood there for one that was still
    missing would otherwise remain. Pairs are all compared in `_sweep`.
    """
    problem = fitter.problem
    done: set[tuple[str, ...]] = set()
    for _ in range(LEADING):
        first = fitter.leading
        if first is None or len(first.members) < 3 or first.names in done:
            return
        done.add(first.names)
        for i in range(len(first.members)):
            rest = _remaining(problem, first, i)
            others = [(g,) for g, group in enumerate(dictionary.groups)
                      if not set(group.member.effect.names) & set(first.names)]  # fmt: skip
            found = dictionary.sets(others, dictionary.beside(rest))
            for (g,) in dictionary.best(found, 2):
                members = (*rest.members, dictionary.groups[g].member)
                if compatible(members):
                    fitter.fit(members)


def _dashpots(dictionary: Dictionary, fitter: _Fitter) -> None:
    """Replace laws by a dashpot if slow motion cannot distinguish them."""
    slow_as = _slow_as()
    for fit in list(fitter.by_names.values()):
        for i, member in enumerate(fit.members):
            name = slow_as.get(member.name)
            plain = next((g.member for g in dictionary.groups if g.member.name == name), None)
            if plain is None or name in fit.names:
                continue
            twin = (*fit.members[:i], plain, *fit.members[i + 1 :])
            if names_of(twin) not in fitter.by_names:
                fitter.fit(twin)


def _grow(dictionary: Dictionary, fitter: _Fitter) -> None:
    """Add every other effect to the best sets in their refined shapes, and refine the best."""
    done: set[tuple[str, ...]] = set()
    for _ in range(2):
        ranked = fitter.ranked
        for fit in [f for f in ranked[:LEADING] if f.names not in done and len(f.names) < 3]:
            done.add(fit.names)
            for members in _beside(dictionary, fit, 4):
                fitter.fit(members)


def _damped(dictionary: Dictionary, fitter: _Fitter) -> None:
    """Try two damping laws with the best spring of a freely decaying body, and the best law.

    Of several elastic laws, one compensates for the form of another; such combinations are not
    simulated with two damping laws.
    """
    problem = fitter.problem
    if not problem.decays or problem.case.model.k_tol is not None:
        return
    springs = [f for f in fitter.by_names.values() if decay.conservative(f) == f.members]
    best = {min(own, key=fitter.score).names: min(own, key=fitter.score)
            for own in (springs, [f for f in springs if len(f.members) == 1]) if own}  # fmt: skip
    for spring in best.values():
        for members in decay.damped_twice(dictionary, spring):
            fitter.fit(members)


def _modulated(fitter: _Fitter) -> None:
    """Let channels unknown to the model modulate the laws of the best sets, one at a time."""
    done: set[int] = set()
    for _ in range(3 if fitter.problem.case.further else 0):
        for fit in fitter.ranked[:LEADING]:
            if id(fit) not in done:
                done.add(id(fit))
                for members in modulation.modulated(fitter.problem, fit):
                    fitter.fit(members)


def _beside(dictionary: Dictionary, fit: Fit, most: int) -> list[tuple[Member, ...]]:
    """Return a set with each of the most promising effects added.

    The dictionary's shapes lie on a grid: an effect added to one of them would first compensate for
    the grid. Here the set has its refined shapes.
    """
    beside = dictionary.beside(fit)
    others = [
        (g,)
        for g, group in enumerate(dictionary.groups)
        if not set(group.member.effect.names) & set(fit.names)
    ]
    found = dictionary.sets(others, beside)
    earned = beside[2] - found.chi2
    costs = dictionary.penalties(found.groups)
    found = found.where(earned > POLICY.promising_price_beside * costs)
    out = []
    for groups in dictionary.best(found, most):
        members = (*fit.members, *(dictionary.groups[g].member for g in groups))
        if compatible(members):
            out.append(members)
    return out


def _promising(dictionary: Dictionary, found: Solved, null: float) -> Solved:
    """Omit sets whose gain is so small that fitting shapes could not compensate."""
    costs = dictionary.penalties(found.groups)
    return found.where(null - found.chi2 > POLICY.promising_price * costs)


def _decide(
    problem: ResidualProblem,
    fitter: _Fitter,
    null: Fit,
    plain: tuple[float, float],
    scale: float,
    held_out: Callable[[Fit], float],
) -> Search:
    n = plain[1]
    evidence = Gathered(fitter, null, held_out)
    choice = evidence.choose()
    best, fits = evidence.fit(choice.best), [evidence.fit(h) for h in choice.ranked]
    moved = isinstance(fitter, _Mover)
    after = unscaled(best, scale, moved) if best.members else plain[0]
    return Search(
        problem,
        null,
        fits,
        best,
        [evidence.fit(h) for h in choice.equal],
        plain[0] / n - 1.0,
        after / n - 1.0,
        null.chi2 - fitter.score(best) if best.members else 0.0,
        choice.held,
        scale,
        [f for f in fits if f is not best][:RIVALS],
        _forms(fitter, best, null),
        moved,
        ledger=choice.ledger,
    )


def unscaled(fit: Fit, scale: float, moved: bool = False) -> float:
    """Return the chi-squared of a set whose rows were scaled down; tolerances were not.

    The residual of a simulated motion has its own rows; that of the balance is scaled like its
    problem.
    """
    rest = float(fit.residual @ fit.residual) * (1.0 if moved else scale)
    return rest + fit.chi2 - rest / scale


def _forms(fitter: _Fitter, best: Fit, null: Fit) -> list[Fit]:
    """Return fits of the same effects that are nearly as good.

    With other forms of their laws; for a simulated motion, from other local minima: if a body
    sticks, the noise of the next row decides which of many minima that is.
    """
    others: Iterable[Fit | None] = fitter.known.values()
    share = POLICY.other_form
    if isinstance(fitter, _Mover):
        others, share = fitter.tried, POLICY.form_alone
    reach = share * (null.chi2 - best.chi2)
    return [
        f
        for f in others
        if f is not None and f is not best and f.names == best.names and f.chi2 - best.chi2 < reach
    ]
