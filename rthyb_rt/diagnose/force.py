"""The force channel: which effects the specimen, or its load cell, has beside the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Trial
from rthyb_rt.diagnose.select import (
    Dictionary,
    Fit,
    Member,
    Problem,
    compatible,
    inflation,
    price,
    refine,
    solve,
)

AMBIGUOUS = 9.0
"""Sets that differ by less in chi-squared cannot be told apart."""
DEARER = 1.5
"""Price of one more parameter in a rival, in the same: a law that goes over into a simpler one fits
as well by its nature, and is a rival only where its parameter brings something."""
NEEDED = {1: 0.0, 2: 4e-3, 3: 2.5e-2}
"""Least part of what a set of two or three explains that each of its effects has to explain alone:
less may be the form of the other one's law. More than twice that where the motion is estimated."""
SMALLEST = 1e-3
"""Least size of an effect, as part of the force: less is not a finding."""
NESTED = 1e-3
"""Least part of what dry friction explains that a Stribeck peak or bristles have to add to it."""
FORM = 0.03
"""Part of what a law explains by which another form of it may do worse and still be thinkable."""
FOLD_S = 0.25
FOLDS = 4


@dataclass
class Search:
    """What a search came to.

    Attributes:
        null: nothing but nuisance.
        fits: refined sets, best first.
        best: the set that is named; without members when nothing is missing.
        equal: other sets that fit as well.
        excess_before, excess_after: misfit beyond noise, per row, in units of the noise.
        gain: what `best` earns beyond its price.
        held_gain: drop of the misfit on blocks left out, as part of the drop on all.
        scale: by how much evidence was scaled down for coloured noise.
    """

    problem: Problem
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


class _Fitter:
    """Refines sets once each."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.known: dict[tuple[tuple[str, str, tuple[float, ...]], ...], Fit | None] = {}
        self.by_names: dict[tuple[str, ...], Fit] = {}
        self.stated = {n.name for n in problem.nuisances if n.sigma is not None}

    def fit(self, members: Iterable[Member]) -> Fit | None:
        members = tuple(members)
        key = tuple(sorted((m.name, m.trial.variant, m.trial.theta) for m in members))
        if key not in self.known:
            found = refine(self.problem, members)
            if found is not None and not self.problem.sensible(found):
                found = None
            self.known[key] = found
            if found is not None:
                names = found.names
                old = self.by_names.get(names)
                if old is None or found.chi2 < old.chi2:
                    self.by_names[names] = found
        return self.known[key]

    def price(self, fit: Fit) -> float:
        ctx = self.problem.ctx
        return sum(
            price(self.problem, m.effect, m.effect.settings(ctx, m.trial)[1]) for m in fit.members
        )

    def score(self, fit: Fit) -> float:
        return fit.chi2 + self.price(fit)


def count(problem: Problem, fit: Fit) -> int:
    """Return how many parameters a set has."""
    return sum(m.effect.settings(problem.ctx, m.trial)[1] for m in fit.members)


def search(problem: Problem, progress: Callable[[str], None] = lambda _: None) -> Search:
    """Find the set of effects that explains the force residual."""
    null = solve(problem, [], [])
    if null is None:
        raise ValueError("the nuisance cannot be solved")
    plain_null, n = null.chi2, problem.y.size * problem.estimate.share
    dictionary = Dictionary(problem, progress)
    fitter, scale = _Fitter(problem), 1.0
    _sweep(dictionary, fitter)
    progress("onset")
    if problem.case.model.k_tol is not None:
        # A naive model is refitted as a whole: what it lacks does not begin anywhere.
        _late(dictionary, fitter, null, n)
    plain_best = plain_null
    if fitter.by_names:
        best = min(fitter.by_names.values(), key=fitter.score)
        plain_best = best.chi2
        scale = inflation(best.residual)
        if scale > 1.3:
            seeds = [f.members for f in sorted(fitter.by_names.values(), key=fitter.score)[:8]]
            problem.rescale(scale)
            dictionary.grams /= scale
            null = solve(problem, [], []) or null
            fitter = _Fitter(problem)
            _sweep(dictionary, fitter, seeds)
        else:
            scale = 1.0
    progress("gate")
    return _decide(problem, fitter, null, (plain_null, plain_best, n), scale)


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
    best = min((chi2 for chi2, _ in singles), default=null)
    pairs = _promising(dictionary, dictionary.pairs(), null)
    # A pair has to do better than its better half before its shapes are worth fitting.
    pairs = [p for p in pairs if p[0] < best - 4.0 or len(singles) == 0]
    leading = dictionary.best(pairs, 12)
    for group in members(leading[:10]):
        fitter.fit(group)
    _grow(dictionary, fitter)
    reached = min((f.chi2 for f in fitter.by_names.values()), default=best)
    rows = dictionary.problem.y.size * dictionary.problem.estimate.share
    if reached > 1.03 * rows:
        triples = _promising(dictionary, dictionary.extended(leading), null)
        for group in members(dictionary.best(triples, 6)):
            fitter.fit(group)
    for group in seeds:
        fitter.fit(group)
    # Parts of what was refined must be there to be compared with.
    for fit in list(fitter.by_names.values()):
        for i in range(len(fit.members) if len(fit.members) > 1 else 0):
            rest = tuple(m for j, m in enumerate(fit.members) if j != i)
            names = tuple(sorted(n for m in rest for n in m.effect.names))
            if names not in fitter.by_names:
                fitter.fit(rest)


def _grow(dictionary: Dictionary, fitter: _Fitter) -> None:
    """Put every other effect beside the best sets in their refined shapes, and refine the best.

    The dictionary's shapes lie on a grid: what stands beside one of them makes up for the grid
    before it shows what is missing.
    """
    done: set[tuple[str, ...]] = set()
    for _ in range(2):
        ranked = sorted(fitter.by_names.values(), key=fitter.score)
        leading = [f for f in ranked[:3] if f.names not in done and len(f.names) < 3]
        for fit in leading:
            done.add(fit.names)
            beside = dictionary.beside(fit)
            others = [
                (g,)
                for g, group in enumerate(dictionary.groups)
                if not set(group.member.effect.names) & set(fit.names)
            ]
            found = [
                (chi2, groups)
                for chi2, groups in dictionary.sets(others, beside)
                if beside[2] - chi2 > 0.5 * dictionary.penalty(groups)
            ]
            for groups in dictionary.best(found, 4):
                extra = tuple(dictionary.groups[g].member for g in groups)
                if compatible([*fit.members, *extra]):
                    fitter.fit((*fit.members, *extra))


def _promising(
    dictionary: Dictionary, found: list[tuple[float, tuple[int, ...]]], null: float
) -> list[tuple[float, tuple[int, ...]]]:
    """Leave out sets that earn so little that no fitting of shapes could make up for it."""
    return [
        (chi2, groups) for chi2, groups in found if null - chi2 > 0.3 * dictionary.penalty(groups)
    ]


def _late(dictionary: Dictionary, fitter: _Fitter, null: Fit, n: float) -> None:
    """Try effects that begin in mid-record, where nothing that acts throughout explains enough."""
    problem = fitter.problem
    fits = fitter.by_names.values()
    best = min(fits, key=fitter.score) if fits else None
    if null.chi2 < 1.05 * n:
        return
    left = (best.chi2 - n) / (null.chi2 - n) if best is not None else 1.0
    if best is not None and (left < 0.02 or inflation(best.residual) < 1.5):
        return
    found = []
    for begin, reduced in dictionary.begun():
        for chi2, groups in dictionary.sets([(g,) for g in range(len(dictionary.groups))], reduced):
            found.append((chi2 + dictionary.penalty(groups), begin, groups[0]))
    found.sort()
    tried: dict[str, int] = {}
    for _, begin, g in found:
        member = dictionary.groups[g].member
        if member.effect.sensor or member.effect.complete or tried.get(member.name, 0) >= 2:
            continue
        if len(tried) >= 8 and member.name not in tried:
            continue
        if len(tried) > 4 and member.name in tried:
            continue
        tried[member.name] = tried.get(member.name, 0) + 1
        t0 = float(problem.ctx.t[problem.rows[begin]])
        late = Late(member.effect)
        span = float(problem.ctx.t[-1] - problem.ctx.t[0]) / 16
        at = t0
        for steps in (np.linspace(-1.0, 1.0, 17), np.linspace(-0.1, 0.1, 21)):
            solved = []
            for d in steps:
                if at + d * span <= problem.ctx.t[0]:
                    continue
                m = Member(late, Trial((*member.trial.theta, at + d * span), member.trial.variant))
                fit = solve(problem, [m], [problem.columns(m)])
                if fit is not None:
                    solved.append((fit.chi2, m.trial.theta[-1], m))
            if not solved:
                break
            at = min(solved, key=lambda s: s[0])[1]
        if solved:
            fitter.fit([min(solved, key=lambda s: s[0])[2]])


class Late(Effect):
    """An effect that begins in mid-record."""

    def __init__(self, effect: Effect) -> None:
        self.effect = effect
        self.name = effect.name
        self.params = effect.params
        self.signs = effect.signs
        self.pinned = effect.pinned
        self.equation = f"{effect.equation}, from t0 on"
        self.fingerprint = f"{effect.fingerprint}, from a moment on"
        self.shown_by = effect.shown_by

    @staticmethod
    def _inner(trial: Trial) -> Trial:
        return Trial(trial.theta[:-1], trial.variant)

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the effect's own, switched on within a few rows."""
        step = 0.5 * (1.0 + np.tanh((ctx.t - trial.theta[-1]) / 0.005))
        return [c * step for c in self.effect.columns(ctx, self._inner(trial))]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the effect's own parameters."""
        return self.effect.report(ctx, self._inner(trial), beta)

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return the effect's own judgement."""
        return self.effect.sensible(ctx, self._inner(trial), beta)

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return the effect's own, and the beginning as one more parameter."""
        own, count = self.effect.settings(ctx, self._inner(trial))
        return own, count + 1

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Return the effect's own, and the recording's length."""
        return [
            *self.effect.limits(ctx, self._inner(trial)),
            (max(float(ctx.t[0]), 1e-3), float(ctx.t[-1])),
        ]


def _needed(fitter: _Fitter, fit: Fit, null: Fit) -> bool:
    """Return whether no effect of a set can be left out."""
    explained = null.chi2 - fit.chi2
    for i, member in enumerate(fit.members):
        rest = [m for j, m in enumerate(fit.members) if j != i]
        names = tuple(sorted(n for m in rest for n in m.effect.names))
        without = fitter.by_names.get(names) if rest else null
        if without is None and rest:
            without = fitter.fit(rest)
        if without is None:
            continue
        own = without.chi2 - fit.chi2
        n = member.effect.settings(fitter.problem.ctx, member.trial)[1]
        cost = price(fitter.problem, member.effect, n)
        if own < cost * (1.25 if rest else 1.0):
            return False
        # What moves a stated number is seen against its tolerance, not in the residual.
        least = NEEDED[min(len(fit.names), 3)] * (1.0 if fitter.problem.estimate.exact else 2.5)
        if rest and own < least * explained and member.name not in fitter.stated:
            return False
    return True


def _decide(
    problem: Problem, fitter: _Fitter, null: Fit, plain: tuple[float, float, float], scale: float
) -> Search:
    n = plain[2]
    fits = sorted(fitter.by_names.values(), key=fitter.score)
    fits = [f for f in fits if _needed(fitter, f, null)]
    fits = _one_of_a_kind(fitter, fits)
    fits = _plainest(fitter, fits, null)
    best = null
    if fits and fitter.score(fits[0]) < null.chi2 and _size(problem, fits[0]) > SMALLEST:
        best = fits[0]
    held = held_out_gain(problem, best) if best.members else 0.0
    if best.members and held < 0.3:
        best = null
    equal = []
    if best.members:
        own = count(problem, best)
        for fit in fits:
            extra = max(0, count(problem, fit) - own)
            worse = fit.chi2 - best.chi2 + DEARER * AMBIGUOUS * extra
            if fit.names != best.names and worse < AMBIGUOUS and held_out_gain(problem, fit) > 0.3:
                equal.append(fit)
    after = best.chi2 * scale if best.members else plain[0]
    return Search(
        problem,
        null,
        fits,
        best,
        equal,
        plain[0] / n - 1.0,
        after / n - 1.0,
        null.chi2 - fitter.score(best) if best.members else 0.0,
        held,
        scale,
        [f for f in fits if f is not best][:6],
        _forms(fitter, best, null),
    )


def _one_of_a_kind(fitter: _Fitter, fits: list[Fit]) -> list[Fit]:
    """Leave out bristle friction with another stiffness where it is yielding by another name.

    k (alpha x + (1 - alpha) z) is a weaker spring and a slider on a spring: the same force.
    """
    out = list(fits)
    for fit in fits:
        if "lugre" in fit.names and "stiffness" in fit.names:
            rest = [n for n in fit.names if n not in ("lugre", "stiffness")]
            same = tuple(sorted([*rest, "hysteresis"]))
            twin = next((f for f in fits if f.names == same), None)
            if twin is not None and fitter.score(twin) < fitter.score(fit) + 25.0:
                out.remove(fit)
    return out


def _plainest(fitter: _Fitter, fits: list[Fit], null: Fit) -> list[Fit]:
    """Leave out richer friction that does no better than dry friction in its place.

    Both go over into it; what they gain then is the form of the jump.
    """
    share = NESTED * (1.0 if fitter.problem.estimate.exact else 2.5)
    out = []
    for fit in fits:
        richer = {"stribeck", "lugre"} & set(fit.names)
        plain = None
        if len(richer) == 1 and "coulomb" not in fit.names:
            names = [n if n not in richer else "coulomb" for n in fit.names]
            plain = next((f for f in fits if f.names == tuple(sorted(names))), None)
        gain = plain.chi2 - fit.chi2 if plain is not None else np.inf
        if gain > fitter.price(fit) - (fitter.price(plain) if plain else 0.0) + max(
            12.0, share * (null.chi2 - fit.chi2)
        ):
            out.append(fit)
    return out


def _forms(fitter: _Fitter, best: Fit, null: Fit) -> list[Fit]:
    """Return fits of the same effects by other forms of their laws that do nearly as well."""
    explained = null.chi2 - best.chi2
    return [
        f
        for f in fitter.known.values()
        if f is not None and f is not best and f.names == best.names
        and f.chi2 - best.chi2 < FORM * explained
    ]  # fmt: skip


def contribution(problem: Problem, fit: Fit, member: int) -> Floats:
    """Return the force of one effect of a fit along the recording, (n,), N."""
    m = fit.members[member]
    columns = m.effect.columns(problem.ctx, m.trial)
    parts = [b * c for b, c in zip(fit.betas[member], columns, strict=True)]
    return np.asarray(np.sum(parts, axis=0))


def _size(problem: Problem, fit: Fit) -> float:
    total = sum(contribution(problem, fit, i) for i in range(len(fit.members)))
    rows = problem.rows
    force = problem.estimate.force[rows]
    return float(np.std(np.asarray(total)[rows]) + abs(np.mean(np.asarray(total)[rows]))) / max(
        float(np.sqrt(np.mean(force**2))), 1e-300
    )


def held_out_gain(problem: Problem, fit: Fit) -> float:
    """Return how much of a set's gain is there on blocks that it was not fitted to.

    Blocks of a quarter of a second go round the folds, so that what happens once is in all of them.
    """
    blocks = [problem.columns(m) for m in fit.members]
    design = np.column_stack([*blocks, problem.base])
    width = sum(b.shape[1] for b in blocks)
    scale = np.sqrt(np.mean(design**2, axis=0))
    scale[scale == 0] = 1.0
    design = design / scale
    ridge = np.zeros(design.shape[1])
    pin = np.zeros(design.shape[1])
    j = 0
    for m in fit.members:
        (_, pinned), _ = m.effect.settings(problem.ctx, m.trial)
        for sigma in pinned:
            if sigma is not None:
                ridge[j] = 1.0 / (sigma * scale[j]) ** 2
                pin[j] = 1.0 / (sigma**2 * scale[j])
            j += 1
    for nuisance in problem.nuisances:
        if nuisance.sigma is not None:
            ridge[j] = 1.0 / (nuisance.sigma * scale[j]) ** 2
        j += 1
    block = (problem.rows / max(FOLD_S * problem.case.fs_hz, 4.0)).astype(int)
    before = after = 0.0
    y = problem.y
    for fold in range(FOLDS):
        out = block % FOLDS == fold
        for use in (True, False):
            part = slice(0 if use else width, None)
            d = design[:, part]
            gram = d[~out].T @ d[~out] + np.diag(ridge[part] + 1e-9 * y.size)
            right = d[~out].T @ y[~out] + pin[part]
            beta = np.linalg.solve(gram, right) if gram.size else np.zeros(0)
            rest = y[out] - d[out] @ beta
            # The prior counts as well: moving a stated number costs what it costs.
            prior = float(np.sum(np.where(pin[part] > 0, 0.0, ridge[part] * beta**2))) / FOLDS
            if use:
                after += float(rest @ rest) + prior
            else:
                before += float(rest @ rest) + prior
    whole = solve(problem, [], [])
    gain = (whole.chi2 if whole else before) - fit.chi2
    return (before - after) / gain if gain > 0 else 0.0
