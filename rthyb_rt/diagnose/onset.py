"""Effects on the force, of the specimen or of the load cell, that begin in mid-recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Protocol

import numpy as np

from rthyb_rt.diagnose.dictionary import BLOCKS, Dictionary
from rthyb_rt.diagnose.effects.base import SWITCH_S, Context, Effect, Floats, Trial
from rthyb_rt.diagnose.gaps import Rows
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, compatible, names_of
from rthyb_rt.diagnose.refinement import Scan, inflated, inflation, priors_of, refine, solve

FEW = 2
"""Number of effects in a set that is considered no more complex than one onset."""
SINGLES = 3
"""Number of single effects with which onsets are combined; the best pair is one more."""
MOST = 5
"""Number of effects examined more closely in addition to one set."""
PART_OF_ROW = 0.25
"""Distance between the onset times that are tried for an effect that begins at once, in rows."""
NEAR = 25
"""Number of onset times tried between the blocks around the best one."""


class Late(Effect):
    """An effect that begins in mid-recording.

    Its last shape parameter is the onset time, in seconds since the first row.
    """

    late = True

    def __init__(self, effect: Effect, at_once: bool = False) -> None:
        """Set the effect, and whether it begins within a row instead of smoothly."""
        self.effect, self.at_once = effect, at_once
        self.name = effect.name
        self.params = effect.params
        self.signs = effect.signs
        self.pinned = effect.pinned
        self.sensor = effect.sensor
        self.carries, self.sprung = effect.carries, effect.sprung
        self.zero, self.foretold, self.needs = effect.zero, effect.foretold, effect.needs
        self.equation = f"{effect.equation}, from t0 on"
        self.fingerprint = f"{effect.fingerprint}, from a moment on"
        self.shown_by = effect.shown_by
        self._kept: tuple[Context, Trial, list[Floats]] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the effect itself."""
        return self.effect.names

    @property
    def number_at_last(self) -> str:
        """The number that the effect changes after its onset."""
        return self.effect.number

    @staticmethod
    def inner(trial: Trial) -> Trial:
        """Return the shape of the effect itself."""
        return Trial(trial.theta[:-1], trial.variant)

    def whole(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the effect's own columns, cached while only the onset changes."""
        inner, kept = self.inner(trial), self._kept
        if kept is None or kept[0] is not ctx or kept[1] != inner:
            self._kept = kept = (ctx, inner, self.effect.columns(ctx, inner))
        return kept[2]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the effect's columns from its onset on."""
        whole, first_s = self.whole(ctx, trial), ctx.first_s + trial.theta[-1]
        if self.at_once:
            switch = np.clip((ctx.t - first_s) / ctx.dt + 0.5, 0.0, 1.0)
            return [c * switch for c in whole]
        return self.effect.begun(ctx, whole, first_s)

    def reading(
        self, ctx: Context, trial: Trial, forces: Callable[[Context], list[Floats]]
    ) -> list[Floats]:
        """Return forces unchanged before the onset, and as the sensor shows them afterwards."""
        plain, shown = forces(ctx), self.effect.reading(ctx, self.inner(trial), forces)
        changes = [late - force for late, force in zip(shown, plain, strict=True)]
        begun = Effect.begun(self.effect, ctx, changes, ctx.first_s + trial.theta[-1])
        return [force + change for force, change in zip(plain, begun, strict=True)]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the effect's own parameters."""
        return self.effect.report(ctx, self.inner(trial), beta)

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the effect's own law."""
        start = ctx.first_s + trial.theta[-1]
        return f"{self.effect.form(ctx, self.inner(trial))}, from {start:.5g} s on"

    def holds_n_per_m(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the effect's own stiffness."""
        return self.effect.holds_n_per_m(ctx, self.inner(trial), beta)

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return the effect's own verdict."""
        return self.effect.sensible(ctx, self.inner(trial), beta)

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return the effect's settings, with the onset as one more parameter."""
        own, count = self.effect.settings(ctx, self.inner(trial))
        return own, count + 1

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Return the effect's limits, and the length of the recording."""
        length = float(ctx.t[-1] - ctx.t[0])
        return [*self.effect.limits(ctx, self.inner(trial)), (ctx.dt, length)]

    def settling_s(self, trial: Trial) -> float:
        """Return the effect's own time."""
        return self.effect.settling_s(self.inner(trial))

    def steps(self, ctx: Context, trial: Trial) -> list[float]:
        """Return the effect's steps, and that of its onset."""
        own = self.effect.steps(ctx, self.inner(trial))
        return [*own, PART_OF_ROW * ctx.dt / trial.theta[-1] if self.at_once else 1e-3]


class _Before(Effect):
    """The force that an effect would have before its onset, of free size."""

    sensor = True  # already as the load cell shows it

    def __init__(self, late: Late, count: int) -> None:
        self.late_one = late
        self.signs = "*" * count

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the part that the onset removes."""
        late = self.late_one
        pairs = zip(late.whole(ctx, trial), late.columns(ctx, trial), strict=True)
        return [whole - later for whole, later in pairs]


def lasting(member: Member) -> Member:
    """Return an effect as at the end of the recording, and as it continues afterwards."""
    if not isinstance(member.effect, Late):
        return member
    return Member(member.effect.effect, Late.inner(member.trial))


class OnsetFitter(Protocol):
    """Refines sets of effects, see `fitter`."""

    problem: ResidualProblem

    @property
    def ranked(self) -> list[Fit]:
        """The best fit of each set, the best set first."""

    def keep(self, fit: Fit) -> None:
        """Keep a refined set if it is better than the one with the same names."""

    def score(self, fit: Fit) -> float:
        """Return chi-squared and price."""


def propose(dictionary: Dictionary, fitter: OnsetFitter, changing: bool) -> list[Fit]:
    """Fit effects that begin in mid-recording, alone and in combination with the best sets.

    Args:
        dictionary: the effects.
        fitter: the sets without onset.
        changing: whether the best of them is not the same law in every part of the recording.

    Returns:
        The best sets with one onset, best first; they may lack other effects.
    """
    problem = fitter.problem
    ranked = fitter.ranked
    null = solve(problem, [], [])
    if null is None:
        return []
    best = ranked[0] if ranked else null
    # A residual that three laws turn into noise may be due to one onset, which has no more
    # parameters.
    if (
        not changing
        and len(best.members) <= FEW
        and inflation(best.residual) < POLICY.white_residual
    ):
        return []
    singles = [f for f in ranked if len(f.members) == 1][:SINGLES]
    pair = [f for f in ranked if len(f.members) == 2][:1]
    found: dict[tuple[str, ...], Fit] = {}
    for base in [null, *singles, *pair]:
        for fit in _beside(dictionary, fitter, base):
            found[fit.names] = min(fit, found.get(fit.names, fit), key=fitter.score)
    return sorted(found.values(), key=fitter.score)


def settle(fitter: OnsetFitter, most: int) -> None:
    """Search for the onset in the best sets again; one found alone may belong to another effect.

    And one found beside other effects is that of the effect alone, or beside fewer of them: before
    the noise was known, they may have been needed for its slow part.
    """
    ranked = fitter.ranked
    done: set[tuple[str, ...]] = set()
    for fit in ranked[:most]:
        late = [m for m in fit.members if m.effect.late]
        rest = [m for m in fit.members if not m.effect.late]
        for member in late if len(fit.members) > 1 else ():
            _begun(fitter, [*(m for m in fit.members if m is not member), member])
        if len(late) == 1:
            for size in range(len(rest)):
                for fewer in combinations(rest, size):
                    members = [*fewer, *late]
                    if names_of(members) not in done:
                        done.add(names_of(members))
                        _begun(fitter, members)


def _beside(dictionary: Dictionary, fitter: OnsetFitter, base: Fit) -> list[Fit]:
    """Fit the most promising effects with an onset, each added to a set."""
    problem, groups = fitter.problem, dictionary.groups
    promising: dict[str, tuple[float, float, int]] = {}
    free = [
        (g,)
        for g, group in enumerate(groups)
        if group.member.effect.begins
        and not group.member.effect.complete
        and not set(group.member.effect.names) & set(base.names)
        and compatible([*base.members, group.member])
    ]

    def promises(chi2: float, start: float, g: int, without: float) -> None:
        name = groups[g].member.name
        score = chi2 + dictionary.penalty((g,)) + problem.ln_n
        if score < min(without, promising.get(name, (np.inf,))[0]):
            promising[name] = (score, start, g)

    def look(rows: Rows) -> None:
        for row, products in zip(rows, dictionary.begun(base, rows), strict=True):
            start = float(problem.ctx.t[problem.rows[row]] - problem.ctx.t[0])
            found = dictionary.sets(switched, products)
            scores = found.chi2 + dictionary.penalties(found.groups) + problem.ln_n
            for chi2, (g,) in found.where(scores < products[2]):
                promises(chi2, start, g, products[2])

    switched = [g for g in free if _switched(groups[g[0]].member.effect)]
    look(dictionary.cuts[1:-1])
    if promising:
        # From distant rows, most effects look equally promising; near the onset, the right one
        # leads.
        start = min(promising.values())[1]
        near = int(np.searchsorted(problem.ctx.t[problem.rows] - problem.ctx.t[0], start))
        reach = problem.y.size // BLOCKS
        rows = np.linspace(near - reach, near + reach, NEAR).astype(np.int64)
        look(np.unique(rows[(rows > 0) & (rows < problem.y.size - 1)]))
    # An effect that grows from its onset is not a truncated column of the dictionary.
    length = float(problem.ctx.t[-1] - problem.ctx.t[0])
    for (g,) in free:
        if not _switched(groups[g].member.effect):
            members = _with(base.members, groups[g].member, 0.5 * length)
            for chi2, start in _scan(problem, members, np.linspace(0.0, length, 2 * BLOCKS)[1:-1]):
                promises(chi2, start, g, base.chi2)
    tried = []
    for _, start, g in sorted(promising.values())[:MOST]:
        member = groups[g].member
        for trial in member.effect.forms_begun(problem.ctx, member.trial):
            own = Member(member.effect, trial)
            tried.append(_begun(fitter, _with(base.members, own, start)))
    return [fit for fit in tried if fit is not None]


def _switched(effect: Effect) -> bool:
    return type(effect).begun is Effect.begun


def _with(beside: Sequence[Member], member: Member, start: float) -> list[Member]:
    """Return a set with an additional effect from a time since the first row on."""
    trial = Trial((*member.trial.theta, start), member.trial.variant)
    return [*beside, Member(Late(member.effect), trial)]


def _scan(
    problem: ResidualProblem, members: Sequence[Member], starts: Floats
) -> list[tuple[float, float]]:
    """Return (chi-squared, onset) of a set for each onset of its last effect."""
    scan, out = Scan(problem, members), []
    for start in starts:
        theta = (*members[-1].trial.theta[:-1], float(start))
        chi2 = scan.chi2(Member(members[-1].effect, Trial(theta, members[-1].trial.variant)))
        if chi2 is not None:
            out.append((chi2, float(start)))
    return out


def _begun(fitter: OnsetFitter, members: list[Member]) -> Fit | None:
    """Fit a set whose last effect begins about then; None if it is also present before."""
    problem, effect = fitter.problem, members[-1].effect
    assert isinstance(effect, Late)
    members = [*members[:-1], Member(Late(effect.effect), members[-1].trial)]
    t, trial = problem.ctx.t, members[-1].trial
    length = float(t[-1] - t[0])
    start = trial.theta[-1]
    for reach, steps in ((length / BLOCKS, 17), (0.1 * length / BLOCKS, 21)):
        starts = start + np.linspace(-reach, reach, steps)
        found = _scan(problem, members, starts[(starts > problem.ctx.dt) & (starts < length)])
        start = min(found)[1] if found else start
    shape = Trial((*trial.theta[:-1], start), trial.variant)
    smooth = refine(problem, [*members[:-1], Member(members[-1].effect, shape)])
    if smooth is None:
        return None
    both = [f for f in (smooth, _at_once(problem, smooth)) if f is not None]
    kept = [f for f in both if problem.sensible(f) and absent_before(problem, f)]
    if not kept:
        return None
    fit = min(kept, key=lambda f: f.chi2)
    fitter.keep(fit)
    return fit


def _at_once(problem: ResidualProblem, fit: Fit) -> Fit | None:
    """Return a set whose last effect begins within a row, about when it does smoothly.

    A strong law that begins at once is far from its smooth start, which moves the others.
    """
    effect, trial = fit.members[-1].effect, fit.members[-1].trial
    assert isinstance(effect, Late)
    if effect.effect.carries or not _switched(effect.effect):
        return None
    dt_s, start = problem.ctx.dt, trial.theta[-1]
    length = float(problem.ctx.t[-1] - problem.ctx.t[0])
    late = Late(effect.effect, at_once=True)
    members = [*fit.members[:-1], Member(late, trial)]
    for reach, step in ((2.0 * SWITCH_S, max(1.0, 0.1 * SWITCH_S / dt_s)), (dt_s, PART_OF_ROW)):
        starts = start + np.arange(-reach, reach + dt_s * step, dt_s * step)
        found = _scan(problem, members, starts[(starts > dt_s) & (starts < length)])
        if not found:
            return None
        start = min(found)[1]
    shape = Trial((*trial.theta[:-1], start), trial.variant)
    return refine(problem, [*members[:-1], Member(late, shape)])


def absent_before(problem: ResidualProblem, fit: Fit) -> bool:
    """Return whether the last effect of a set, which has an onset, is absent before it.

    With its force before the onset left free in size, this must be less than half of its later
    size, and its standard error must be small enough to establish that.
    """
    member, beta = fit.members[-1], fit.betas[-1]
    assert isinstance(member.effect, Late)
    before = Member(_Before(member.effect, beta.size), member.trial)
    members = [*fit.members, before]
    blocks = [*problem.blocks(fit.members), problem.columns(before)]
    both = solve(problem, members, blocks)
    if both is None or both.covariance is None:
        return False
    shown = blocks[-1] @ beta
    size = float(shown @ shown)
    if size == 0.0:
        return False
    # Its size before the onset relative to its later size, and the standard error.
    weights = np.zeros(both.covariance.shape[0])
    first = sum(b.size for b in both.betas[:-1])
    weights[first : first + beta.size] = blocks[-1].T @ shown / size
    # A stated value is fitted as well. If it is the law's own, that is its size before the onset.
    own = member.effect.whole(problem.ctx, member.trial)[0]
    for j, nuisance in enumerate(problem.nuisances, first + beta.size):
        same = nuisance.name == member.name and np.array_equal(nuisance.column, own)
        weights[j] = 1.0 / float(beta[0]) if same else 0.0
    part = float(weights @ np.r_[(*both.betas, both.nuisance)])
    prior = priors_of(problem, members, 0, weights.size)
    covariance = inflated(both.covariance, prior, inflation(both.residual))
    width = float(weights @ covariance @ weights)
    return part + POLICY.absent_sure * float(np.sqrt(max(width, 0.0))) < POLICY.absent_before
