"""Rules that compare sets of effects with one another."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rthyb_rt.diagnose.court import Court
from rthyb_rt.diagnose.hypotheses import Hypothesis, SetMember, Sets
from rthyb_rt.diagnose.rules_for_a_set import needed

CLOSER = 3
"""Number of sets, best first, for which yielding is tried in place of bristles."""


def within_the_steps(court: Court, sets: Sets) -> Sets:
    """Of a coarse load cell, a set must also be compatible with the readings between changes.

    Where a reading changes, the force is half-way between two readings. A law that keeps the force
    there explains every change, and none of the readings before and after it.
    """
    if not court.setting.coarse:
        return sets
    odds = {h.names: float(court.ask("rounding", h)) for h in (court.null, *sets)}
    most = court.policy.coarse_odds * min(odds.values()) + court.policy.same_evidence
    return [
        h
        for h in sets
        if odds[h.names] <= most or court.refuse("rounding", h, found=odds[h.names], wanted=most)
    ]


def worth_their_size(court: Court, sets: Sets) -> Sets:
    """For a naive model, a set must be better than the best set with fewer laws.

    Its misfit is due to form: if two laws have the wrong form, a third can absorb what another pair
    would explain. But a law of two parameters or more is no simpler than two of one each.
    """
    if not court.setting.naive:
        return sets
    out = []
    for of in sets:
        pair = len(of.parts) == of.count == 2
        simpler = [h for h in sets if not pair or h.count < of.count]
        fewer = [h.chi2 for h in simpler if len(h.parts) < len(of.parts)]
        own = min(fewer, default=np.inf) - of.chi2
        # What the last law can explain; in a decay, the damping, see above.
        wanted = court.share(of) * min(court.explained(of, i) for i in range(len(of.parts)))
        if own >= wanted or court.refuse("more laws", of, found=own, wanted=wanted):
            out.append(of)
    return out


def one_of_a_kind(court: Court, sets: Sets) -> Sets:
    """Bristles with a changed stiffness are omitted if they are yielding by another name.

    k (alpha x + (1 - alpha) z) is a weaker spring and a slider on a spring: the same force. So is
    yielding together with a wrong spring; the better of the two remains. If the model's stiffness
    is free, every set contains a changed spring.
    """
    sets = _with_yielding(court, sets)
    by_names = {h.names: h for h in sets}
    return [h for h in sets if not _yields(court, h, by_names)]


def _yields(court: Court, of: Hypothesis, by_names: Mapping[tuple[str, ...], Hypothesis]) -> bool:
    also, stiffness, policy = court.laws.also, court.laws.stiffness, court.policy
    bristles = next((n for n in also if n in of.names), "")
    if not bristles or not (court.setting.k_free or stiffness in of.names):
        return False
    rest = [n for n in of.names if n not in (bristles, stiffness)]
    twin = by_names.get(tuple(sorted([*rest, also[bristles]])))
    other = by_names.get(tuple(sorted([*rest, also[bristles], stiffness])))
    margin = policy.yielding_gain
    reach = policy.bristles_as_lost * of.held_n_per_m
    reach += policy.bristles_as_lost_tolerance * court.setting.k_sigma_n_per_m
    if of.held_n_per_m > 0.0 and abs(of.held_n_per_m - of.lost_n_per_m) < reach:
        margin = max(margin, policy.form_alone * (court.null.chi2 - of.chi2))
    for rival, more in ((twin, margin), (other, 0.0)):
        if rival is not None and rival.score < of.score + more:
            court.refuse("yielding", of, found=of.score, wanted=rival.score, against=rival.names)
            return True
    return False


def _with_yielding(court: Court, sets: Sets) -> Sets:
    """Return the sets, and the best ones with bristles also with yielding in their place.

    Beside a stated stiffness, in place of bristles and the changed spring; the search may have
    refined that set in another form of yielding, and then it is replaced. Of a joint law and single
    ones with its names, the better set remains.
    """
    also, names = court.laws.also, {h.names: h for h in reversed(sets)}
    stiffness = "" if court.setting.k_free else court.laws.stiffness
    for of in sets[:CLOSER]:
        bristles = next((n for n in also if n in of.names), "")
        if not bristles or also[bristles] in of.names or (stiffness and stiffness not in of.names):
            continue
        rest = [n for n in of.names if n not in (bristles, stiffness)]
        twin = tuple(sorted([*rest, also[bristles]]))
        there = names.get(twin)
        if there is None or (stiffness and there.chi2 > of.chi2 + court.policy.yielding_gain):
            yielded = court.ask("yielding", of)
            better = yielded is not None and (there is None or yielded.score < there.score)
            if better and needed(court, yielded):
                names[yielded.names] = yielded
    return sorted(names.values(), key=by_score)


def plainest(court: Court, sets: Sets) -> Sets:
    """More complex friction must be better than dry friction in its place.

    Both contain it as a special case; what they then gain is the form of the jump, which is a share
    of what friction explains, not of what the other laws do. The same applies to relaxation with a
    negligible time, which is a dashpot, and to a second mass on a spring that is far too stiff for
    the motion, which is a moving mass: these also gain from the form of the other laws. Along an
    estimated motion they must gain it by the motion that the test imposes: what distinguishes them
    is fast, and there the estimate contains the load cell's noise, which a filter reduces.
    """
    policy, out = court.policy, []
    share = policy.richer_friction_share * court.blurred
    for of in sets:
        plain = _plainer_of(court, of, sets)
        gain = plain.chi2 - of.chi2 if plain is not None else np.inf
        slow = [i for i, p in enumerate(of.parts) if _settles(court, p)]
        if plain is not None and slow and court.noisy_motion:
            gain = min(gain, court.ask("driven more", of, (slow[0],)))
        least = max(policy.richer_friction_gain, share * _explained_by_richer(court, of, plain))
        wanted = of.price - (plain.price if plain is not None else 0.0) + least
        against = plain.names if plain is not None else ()
        if (
            gain > wanted
            or (plain is not None and _imitated(court, of, plain, sets))
            or court.refuse("plainest", of, found=gain, wanted=wanted, against=against)
        ):
            out.append(of)
    return out


def _explained_by_richer(court: Court, of: Hypothesis, plain: Hypothesis | None) -> float:
    """Return what more complex friction explains beside the other laws; all, if there is none."""
    names = () if plain is None else plain.names
    own = [
        i for i, p in enumerate(of.parts) if p.name in court.laws.plainer and p.name not in names
    ]
    less = court.less(of, own[0]) if plain is not None and own else None
    return (court.null if less is None else less).chi2 - of.chi2


def _imitated(court: Court, of: Hypothesis, plain: Hypothesis, sets: Sets) -> bool:
    """Return whether the plainer law would be named with one more effect, which fits worse.

    Then what the richer law explains is more than the form of a jump, for that effect as well.
    Not if the richer law moves the stated value that this effect changes: it needs it as much.
    """
    return any(
        len(h.parts) == len(plain.parts) + 1
        and set(plain.names) < set(h.names)
        and not set(h.names) - set(plain.names) <= of.bent
        and of.score + court.policy.same_evidence < h.score < plain.score
        for h in sets
    )


def _plainer_of(court: Court, of: Hypothesis, sets: Sets) -> Hypothesis | None:
    friction = court.laws.plainer
    settling = {p.name: court.laws.settling[p.name] for p in of.parts if _settles(court, p)}
    richer = {n for n in of.names if n in friction}

    def among(plainer: Mapping[str, str]) -> Hypothesis | None:
        names = tuple(sorted(plainer.get(n, n) for n in of.names))
        return next((h for h in sets if h.names == names), None)

    plain = None
    if len(richer) == 1 and not {friction[n] for n in richer} & set(of.names):
        plain = among(friction)
    alone = set(settling.values()).isdisjoint(of.names)
    return among(settling) if plain is None and settling and alone else plain


def _settles(court: Court, part: SetMember) -> bool:
    """Return whether the motion is so slow that an effect acts like its simpler law.

    Along a noisy motion it need not be as slow for the difference to be one of noise.
    """
    policy = court.policy
    most = policy.quick_beside_noise if court.noisy_motion else policy.quick_relaxation
    return 0.0 < part.settles_rad < most and part.name in court.laws.settling


def simplest_first(court: Court, sets: Sets) -> Sets:
    """Of sets that differ only by the form of a law, the one with fewest parameters is first.

    Likewise of any sets of equally many effects, if the additional parameters of the others are
    hardly worth their price.
    """
    if not sets:
        return sets
    best = sets[0]
    form = court.policy.form_alone * (court.null.chi2 - best.chi2)
    # An onset was chosen among equally many times, whatever its law.
    simple = [
        h
        for h in sets
        if len(h.names) == len(best.names)
        and h.count < best.count
        and (
            best.late
            or (len(best.names) > 1 and set(h.names) & set(best.names))
            or h.score - best.score < court.policy.same_evidence
        )
        and h.score - best.score < form
        and not court.ends_at_noise(best, h)
    ]
    if not simple:
        return sets
    first = min(simple, key=lambda h: h.score)
    court.refuse("simplest first", best, found=best.score, wanted=first.score, against=first.names)
    return [first, *[h for h in sets if h is not first]]


def driven(court: Court, of: Hypothesis) -> bool:
    """If one noise is in force and motion, effects must earn their price by the imposed motion.

    Above its band, a closed loop is moved only by the load cell's noise, and the motion of a body
    without a load cell is noise that its inertia turns into force: a law can recover or subtract
    it, see `feedback`. A delayed load cell must do so in any
    recording: together with an offset of its channel it filters that noise, moved or not. However,
    if an accelerometer shows its delay, that is evidence of its own. And a law that acts like its
    simpler one in the motion of the test acts otherwise in noise: a stiff second mode beside a
    negative mass takes mass off the noise of an estimated motion, and hardly any off the motion.

    They must also earn it together: of two that cancel, each is needed beside the other, and what
    is left of them filters the noise.
    """
    setting = court.setting
    alone = setting.judged == "force" and not setting.naive and not setting.witnessed
    late = alone and any(p.carries for p in of.parts)
    quick = court.noisy_motion and any(_settles(court, p) for p in of.parts)
    if not setting.returns and not late and not quick:
        return True
    times, earned = court.times(of), court.ask("driven", of)
    # Disturbances of the load cell itself, such as hum, are no function of the motion.
    follows = tuple(
        i
        for i, p in enumerate(of.parts)
        if p.carries or ((setting.returns or quick) and not p.sensor)
    )
    if not earned or not follows:
        return True
    for i in follows:
        wanted = times * of.parts[i].price
        if earned[i] < wanted:
            return court.refuse("driven", of, part=of.parts[i].name, found=earned[i], wanted=wanted)
    if len(follows) == 1:
        return True
    wanted = times * sum(of.parts[i].price for i in follows)
    found = court.ask("driven together", of, follows)
    return found >= wanted or court.refuse("driven together", of, found=found, wanted=wanted)


def by_score(of: Hypothesis) -> tuple[float, tuple[str, ...]]:
    """Return what sets are sorted by: their score, and their names where that is equal."""
    return of.score, of.names
