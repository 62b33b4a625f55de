"""Which set of effects is named: rules on evidence, independent of the recording itself.

`evidence` gathers what is known of each set into `Hypothesis`, and of the recording into `Setting`.
Some evidence requires a fit or a simulation and is gathered for few sets only: if a rule needs
more, `choose` returns a `Need`; the caller gathers it and calls again. The same evidence gives the
same answer, in whatever order it is gathered, and each rule records in the ledger what it has done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from rthyb_rt.diagnose.court import Choice, Court, Ruling, UnknownNeed
from rthyb_rt.diagnose.hypotheses import Evidence, Hypothesis, Need, Sets
from rthyb_rt.diagnose.policy import Policy
from rthyb_rt.diagnose.rules_between_sets import (
    by_score,
    driven,
    one_of_a_kind,
    plainest,
    simplest_first,
    within_the_steps,
    worth_their_size,
)
from rthyb_rt.diagnose.rules_for_a_set import (
    above_near_noise,
    above_slow_noise,
    goes_on,
    more_than_normal,
    needed,
    off_zero,
)


def each(rule: Callable[[Court, Hypothesis], bool]) -> Callable[[Court, Sets], Sets]:
    """Return a rule for all sets from a rule for one set."""
    return lambda court, sets: [h for h in sets if rule(court, h)]


RANKING: dict[str, Callable[[Court, Sets], Sets]] = {
    "needed": each(needed),
    "normal offset": each(more_than_normal),
    "off zero": each(off_zero),
    "slow noise": each(above_slow_noise),
    "near noise": each(above_near_noise),
    "drift goes on": each(goes_on),
    "driven": each(driven),
    "rounding": within_the_steps,
    "more laws": worth_their_size,
    "yielding": one_of_a_kind,
    "plainest": plainest,
    "simplest first": simplest_first,
}
"""Rules that reject or reorder sets, in this order."""


# ---- rules for the set that remains first -------------------------------------------------------


def earns(court: Court, of: Hypothesis) -> bool:
    """The set must be worth its price; with several effects, there are many sets to choose from."""
    gain = court.null.chi2 - of.chi2
    wanted = of.price * court.times(of)
    return gain > wanted or court.refuse("earns", of, found=gain, wanted=wanted)


def is_a_finding(court: Court, of: Hypothesis) -> bool:
    """Its force must have a minimum size."""
    size = court.ask("size", of)
    wanted = court.policy.least_force
    return size > wanted or court.refuse("size", of, found=size, wanted=wanted)


def closer(court: Court, of: Hypothesis) -> bool:
    """With it, the model must be closer to the force of a load cell than without it.

    Chi-squared weighs frequencies by the noise spectrum read from the recording. A law may win by
    what it does where the noise is weak, such as undoing the smoothing of an estimated motion, and
    yet add more error than it removes.
    """
    setting = court.setting
    if setting.judged != "force" or setting.returns:
        return True
    left = court.ask("left", of)
    return left <= 1.0 or court.refuse("closer", of, found=left, wanted=1.0)


def holds(court: Court, of: Hypothesis) -> bool:
    """It must be confirmed on rows to which it was not fitted."""
    held = court.ask("held out", of)
    wanted = court.policy.held_out_share
    return held >= wanted or court.refuse("held out", of, found=held, wanted=wanted)


NAMING: dict[str, Callable[[Court, Hypothesis], bool]] = {
    "earns": earns,
    "size": is_a_finding,
    "closer": closer,
    "held out": holds,
}
"""Requirements on the first set to be named; see `_named` for what may take its place."""


# ---- sets that fit equally well -----------------------------------------------------------------


def alike(court: Court, best: Hypothesis, sets: Sets) -> Sets:
    """Sets that differ by less than the evidence can resolve, counting additional parameters."""
    policy = court.policy
    out = []
    for of in sets:
        extra = max(0, of.count - best.count)
        worse = of.chi2 - best.chi2 + policy.dearer_rival * policy.same_evidence * extra
        same = of.names == best.names or _one_joint_law(of, best) or _contains(court, of, best)
        if not same and worse < policy.same_evidence:
            out.append(of)
    return out


def _contains(court: Court, of: Hypothesis, best: Hypothesis) -> bool:
    """Return whether a set has the best one's laws, one of them with a free exponent.

    That it then fits a little better is no other explanation.
    """
    more, less = set(of.names) - set(best.names), set(best.names) - set(of.names)
    if len(of.names) != len(best.names) or len(more) != 1:
        return False
    return less <= court.laws.contained.get(next(iter(more)), frozenset())


def _one_joint_law(of: Hypothesis, best: Hypothesis) -> bool:
    """Return whether one set has the names of the other and more, by a form of its joint law.

    Yielding that degrades, and that pinches as well: sets that contain each other are no two
    explanations, and which names a joint law has follows from the form that fits better.
    """
    joint, beside = zip(*(_joint_and_rest(h) for h in (of, best)), strict=True)
    nested = joint[0] <= joint[1] or joint[1] <= joint[0]
    return nested and all(joint) and beside[0] == beside[1]


def _joint_and_rest(of: Hypothesis) -> tuple[frozenset[str], frozenset[str]]:
    """Return the names of a set's joint laws, and those of its other effects."""
    joint = frozenset(n for p in of.parts if p.complete for n in p.names)
    return joint, frozenset(of.names) - joint


def twins(court: Court, best: Hypothesis, sets: Sets) -> Sets:
    """Single effects equivalent to a single best one that were rejected for their higher price.

    Changing a stated value is cheap, but if the recording shows no difference at all, a lower price
    is no evidence.
    """
    if len(best.parts) != 1 or not best.parts[0].stated:
        return []
    known = {h.names for h in sets}
    found = [
        h
        for h in court.by_names.values()
        if len(h.parts) == 1
        and h.names not in known
        and h.count <= best.count
        and h.chi2 - best.chi2 < court.policy.twin_evidence
    ]
    return sorted(found, key=by_score)


ALIKE: dict[str, Callable[[Court, Hypothesis, Sets], Sets]] = {"alike": alike, "twins": twins}
"""Rules that find sets indistinguishable from the one that is named."""


# ---- all rules ----------------------------------------------------------------------------------


def choose(evidence: Evidence, policy: Policy, less: Iterable[str] = ()) -> Choice | Need:
    """Return which set is named and which fit equally well, or what must be known first.

    Args:
        evidence: what is known.
        policy: the thresholds.
        less: names of rules to omit, to show the effect of each.
    """
    court, gone = Court(evidence, policy), set(less)
    try:
        return _choose(court, gone)
    except UnknownNeed as unknown:
        return unknown.need


def _choose(court: Court, gone: set[str]) -> Choice:
    sets = sorted(court.evidence.sets, key=by_score)
    for name, rule in RANKING.items():
        sets = sets if name in gone else rule(court, sets)
    best = _named(court, sets, gone)
    if best is None:
        return Choice(court.null, tuple(sets), (), 0.0, tuple(court.ledger))
    held = court.ask("held out", best)
    equal = []
    for name, find in ALIKE.items():
        for of in [] if name in gone else _equals(court, best, sets, find):
            if court.ask("held out", of) > court.policy.held_out_share:
                equal.append(of)
                court.ledger.append(
                    Ruling(name, of.names, "", of.chi2 - best.chi2, against=best.names)
                )
    return Choice(best, tuple(sets), tuple(equal), held, tuple(court.ledger))


def _equals(
    court: Court, best: Hypothesis, sets: Sets, find: Callable[[Court, Hypothesis, Sets], Sets]
) -> Sets:
    """Return what a rule of `ALIKE` finds.

    What fits far better than a set that is named in another one's place is no equal.
    """
    if best is sets[0]:
        return find(court, best, sets)
    if find is alike:
        return alike(court, best, _of_stated(sets))
    least = best.chi2 - court.policy.twin_evidence
    return [of for of in find(court, best, sets) if of.chi2 > least]


def _of_stated(sets: Sets) -> Sets:
    """Return the sets after the first that consist of stated values alone."""
    return [of for of in sets[1:] if all(p.stated for p in of.parts)]


def _named(court: Court, sets: Sets, gone: set[str]) -> Hypothesis | None:
    """Return the set to be named; None if there is none.

    It is the first, or, where that is too small to be reported, the first of stated values alone:
    a tiny law is no reason to leave unsaid that a stated value is off by many of its tolerances,
    unless it explains that as well.
    """
    asked = [ask for name, ask in NAMING.items() if name not in gone]
    if not sets or all(ask(court, sets[0]) for ask in asked):
        return next(iter(sets), None)
    stated = next(iter(_of_stated(sets)), None)
    if court.ledger[-1].rule != "size" or stated is None:
        return None
    named = _off_beside(court, stated, sets[0]) and all(ask(court, stated) for ask in asked)
    return stated if named else None


def _off_beside(court: Court, of: Hypothesis, tiny: Hypothesis) -> bool:
    """Return whether stated values are off beside a set that is too small to be reported as well.

    Where both were fitted together. If not, they only stand for it: a force that it does not need.
    """
    both = court.together(of, tiny)
    if both is None:
        return True
    own, wanted = tiny.chi2 - both.chi2, court.times(both) * of.price
    return own >= wanted or court.refuse(
        "beside tiny", of, found=own, wanted=wanted, against=tiny.names
    )


def gathered(
    evidence: Evidence,
    policy: Policy,
    answer: Callable[[Need], Any],
    beside: Callable[[], Sequence[Hypothesis]] = tuple,
) -> Choice:
    """Return the decision, with evidence gathered as the rules require it.

    Args:
        evidence: what is known initially.
        policy: the thresholds.
        answer: gathers what is needed.
        beside: returns further sets that became known meanwhile, for comparison.
    """
    while isinstance(done := choose(evidence, policy), Need):
        known = {**evidence.known, done: answer(done)}
        evidence = replace(evidence, known=known, beside=tuple(beside()))
    return done
