"""The search for sets of effects in the force balance, from the dictionary to refined sets."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rthyb_rt.diagnose import decay, modulation
from rthyb_rt.diagnose.dictionary import Dictionary, Solved
from rthyb_rt.diagnose.effects import catalogue, having
from rthyb_rt.diagnose.fitted import bent
from rthyb_rt.diagnose.fitter import (
    LEADING,
    SetFitter,
    in_place,
    plainer_friction,
    possible,
    without,
)
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, compatible, names_of
from rthyb_rt.diagnose.refinement import solve


def _remaining(problem: ResidualProblem, fit: Fit, member: int) -> Fit:
    """Return a set without one effect, as a part to which another one is added.

    Alone, the rest might have signs that no law permits: then with the coefficients of the set.
    """
    rest = fit.members[:member] + fit.members[member + 1 :]
    alone = solve(problem, rest, problem.blocks(rest))
    return without(problem, fit, member) if alone is None else alone


def _slow_as() -> dict[str, str]:
    """Return the effects that slow motion cannot distinguish from a simpler one, with that one."""
    return {n: e.slow_as for n, e in catalogue().items() if e.slow_as}


def sweep(
    dictionary: Dictionary, fitter: SetFitter, seeds: Iterable[tuple[Member, ...]] = ()
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


def _reformed(dictionary: Dictionary, fitter: SetFitter) -> tuple[str, ...] | None:
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


def _with_dry_friction(fitter: SetFitter) -> None:
    """Refine the best sets with dry friction in place of a richer law, which must be compared.

    On the grid of shapes, the richer law may be so much nearer that dry friction was not tried
    beside these others.
    """
    by_name, plainer = {e.name: e for e in fitter.problem.effects}, plainer_friction()
    for fit in fitter.ranked[:LEADING]:
        for i, own in enumerate(fit.members):
            dry = by_name.get(plainer.get(own.name, ""))
            rest = fit.members[:i] + fit.members[i + 1 :]
            if dry is None or {dry.name, *(m.name for m in rest)} in map(set, fitter.by_names):
                continue
            trial = in_place(fitter.problem, dry, own)
            if trial is not None and compatible((*rest, Member(dry, trial))):
                fitter.fit((*rest, Member(dry, trial)))


def _nested(dictionary: Dictionary, fitter: SetFitter) -> None:
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


def _reform(dictionary: Dictionary, fitter: SetFitter, dry: bool) -> None:
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
    if shape == other.trial or not possible(problem, other.effect, shape):
        return [other]
    return [other, Member(other.effect, shape)]


def _replaced(dictionary: Dictionary, fitter: SetFitter) -> None:
    """Replace each law of the best set of three or more by each other one, while that improves it.

    Such a set is built up from its best subset: a law that stood there for one that was still
    missing would otherwise remain. Pairs are all compared in `sweep`.
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


def _dashpots(dictionary: Dictionary, fitter: SetFitter) -> None:
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


def _grow(dictionary: Dictionary, fitter: SetFitter) -> None:
    """Add every other effect to the best sets in their refined shapes, and refine the best."""
    done: set[tuple[str, ...]] = set()
    for _ in range(2):
        ranked = fitter.ranked
        for fit in [f for f in ranked[:LEADING] if f.names not in done and len(f.names) < 3]:
            done.add(fit.names)
            for members in larger(dictionary, fit, 4):
                fitter.fit(members)


def _damped(dictionary: Dictionary, fitter: SetFitter) -> None:
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


def _modulated(fitter: SetFitter) -> None:
    """Let channels unknown to the model modulate the laws of the best sets, one at a time."""
    done: set[int] = set()
    for _ in range(3 if fitter.problem.case.further else 0):
        for fit in fitter.ranked[:LEADING]:
            if id(fit) not in done:
                done.add(id(fit))
                for members in modulation.modulated(fitter.problem, fit):
                    fitter.fit(members)


def larger(dictionary: Dictionary, fit: Fit, most: int) -> list[tuple[Member, ...]]:
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
