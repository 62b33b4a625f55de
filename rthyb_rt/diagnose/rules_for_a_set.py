"""Rules that reject a set of effects for what it says itself."""

from __future__ import annotations

from typing import Literal

from rthyb_rt.diagnose.court import Court
from rthyb_rt.diagnose.hypotheses import DriftRates, Hypothesis


def needed(court: Court, of: Hypothesis, in_any_form: bool = True) -> bool:
    """Each effect must earn its price in addition to the others, and not be a form of theirs.

    Args:
        court: the evidence.
        of: the set.
        in_any_form: whether a small effect must also earn its price beside other forms of the laws.
    """
    for i, part in enumerate(of.parts):
        less = court.less(of, i)
        if less is None:
            continue
        several, own = len(of.parts) > 1, less.chi2 - of.chi2
        wanted = part.price * court.times(of)
        if own < wanted:
            return court.refuse("needed", of, part=part.name, found=own, wanted=wanted)
        if not several:
            continue
        if not _large_enough(court, of, i):
            return False
        least = court.share(of) * court.explained(of, i)
        # A change of a stated value shows against its tolerance, not in the residual.
        by_force = part.stated and court.setting.judged == "force"
        stated = by_force or (not part.late and part.name in less.bent)
        # Except if an abnormal time offset or stated value would otherwise have to compensate. For
        # a naive model this is no evidence: there an offset absorbs errors in the form of a law.
        by_form = court.policy.form_alone * court.explained(of, i)
        relieves = not court.setting.naive and court.relieves(of, less, own >= by_form)
        exempt = own >= least or stated or _no_form(court, of, i, less) or relieves
        if not exempt or (own < least and _beside_a_joint_law(of, i)):
            return court.refuse("share", of, part=part.name, found=own, wanted=least)
        if own < least and _a_harmonic(court, of, i):
            return court.refuse("harmonic", of, part=part.name, found=own, wanted=least)
        if in_any_form and not _past_forms(court, of, i, own):
            return False
    return _needed_together(court, of)


def _beside_a_joint_law(of: Hypothesis, which: int) -> bool:
    """Return whether another effect is the whole law of a member, which is never exact."""
    return any(p.complete for i, p in enumerate(of.parts) if i != which)


def _needed_together(court: Court, of: Hypothesis) -> bool:
    """Return whether any two effects of three earn the price of both beside the third one.

    Two that cancel, such as a spring and a mass at one frequency, each seem to earn a great deal:
    without one of them, the other one is far too large.
    """
    for i, part in enumerate(of.parts if len(of.parts) > 2 else ()):
        alone = court.of(of, (i,))
        if alone is None:
            continue
        own = alone.chi2 - of.chi2
        wanted = court.times(of) * (of.price - part.price)
        if own < wanted:
            return court.refuse("together", of, found=own, wanted=wanted, against=part.names)
    return True


def _large_enough(court: Court, of: Hypothesis, which: int) -> bool:
    """Return whether an effect beside others is as large as one must be that is reported alone.

    A tiny one may earn its price at a low noise: the error of a formula, or of a simulation.
    """
    if court.setting.judged != "force":
        return True
    size, least = court.ask("own size", of, (which,)), court.policy.least_force
    part = of.parts[which].name
    return size > least or court.refuse("small", of, part=part, found=size, wanted=least)


def _no_form(court: Court, of: Hypothesis, which: int, less: Hypothesis) -> bool:
    """Return whether an effect with a small share is more than the form of another's law."""
    return (
        _completes(court, of, less)
        or _of_no_form(court, of, which)
        or _before_a_stated_value(court, of, which)
        or _beside_a_plainer(court, of, which)
    )


def _past_forms(court: Court, of: Hypothesis, which: int, own: float) -> bool:
    """Return whether an effect is large, or earns its price beside other forms of the other laws.

    A small effect may stand for the error of such a form. Along a simulated motion no force is
    compared; and the laws of a naive model are all approximate.
    """
    policy, setting = court.policy, court.setting
    if setting.judged != "force" or setting.naive:
        return True
    if own >= policy.other_form * court.whole(of, which):
        return True
    part, found = of.parts[which], court.ask("beyond forms", of, (which,))
    wanted = part.price * court.times(of)
    return found > wanted or court.refuse("form", of, part=part.name, found=found, wanted=wanted)


def _completes(court: Court, of: Hypothesis, less: Hypothesis) -> bool:
    """Return whether a set leaves only noise, but more without one of its effects.

    A third law does not absorb all that one law leaves because of the form of another.
    """
    sliders = court.laws.sliders
    more = sliders.issubset(of.names) and not sliders.issubset(less.names)
    return court.setting.exact and not more and court.ends_at_noise(of, less)


def _of_no_form(court: Court, of: Hypothesis, which: int) -> bool:
    """Return whether a load cell effect is independent of the form of the laws beside it.

    This is so if only noise is left, and the effect still earns its price if each of those laws may
    be multiplied by any smooth function of displacement and of velocity: no law can imitate a
    disturbance of the load cell itself.
    """
    part, policy, n = of.parts[which], court.policy, court.setting.rows
    at_noise = of.chi2 - n < policy.excess_as_noise * n
    if not part.additive or court.setting.judged != "force":
        return False
    if not at_noise or court.setting.naive:
        return False
    return bool(court.ask("beyond forms", of, (which,)) > court.times(of) * part.price)


def _a_harmonic(court: Court, of: Hypothesis, which: int) -> bool:
    """Return whether a line of the load cell is at a frequency that the other laws have as well.

    A law makes harmonics of a sine; what its formula lacks of them is a line at the same frequency,
    as steady as the motion.
    """
    if of.parts[which].name not in court.laws.lines:
        return False
    return bool(court.ask("line of others", of, (which,)) > court.policy.hum_apart)


def _before_a_stated_value(court: Court, of: Hypothesis, which: int) -> bool:
    """Return whether an effect is better than a changed stated value that would be named instead.

    Such a change is exempt from the share; an effect should not lose to its imitation for that
    reason: relaxation to the dashpot that it is in slow motion, or the spring in fast motion.
    """
    rest = of.without(which)
    limits = court.laws.limits.get(of.parts[which].name, frozenset()) - set(rest)
    others = (court.by_names.get(tuple(sorted((name, *rest)))) for name in sorted(limits))
    return any(
        other is not None
        and any(p.stated and p.name in limits for p in other.parts)
        and _named_though_worse(court, of, other)
        for other in others
    )


def _beside_a_plainer(court: Court, of: Hypothesis, which: int) -> bool:
    """Return whether an effect is named beside the plainer law that another one contains.

    What the form of dry friction does not explain, that of friction with one more property explains
    no better; and the set with the plainer law would be named although it fits worse.
    """
    friction = court.laws.plainer
    others = [n for n in of.without(which) if n in friction]
    if len(others) != 1 or friction[others[0]] in of.names:
        return False
    names = tuple(sorted(friction[n] if n in others else n for n in of.names))
    plain = court.by_names.get(names)
    return plain is not None and _named_though_worse(court, of, plain)


def _named_though_worse(court: Court, of: Hypothesis, other: Hypothesis) -> bool:
    """Return whether another set fits clearly worse, and each of its effects earns its share."""
    worse = of.score + court.policy.same_evidence <= other.score
    return worse and needed(court, other, in_any_form=False)


def goes_on(court: Court, of: Hypothesis) -> bool:
    """For a naive model, a drift must continue within the halves of the recording.

    Errors in the form of other laws may differ by chance between early and late motion, and a
    constant also has a slope if it is assumed to begin at zero. A real drift is present within each
    half, whatever its offset there, if the half is long enough to show it. Motion that does not
    repeat within a half never returns to a force that could have drifted.
    """
    if court.laws.wanders.isdisjoint(of.names) or not court.setting.naive:
        return True
    drift: DriftRates = court.ask("drift", of)
    least = court.policy.drift_cycles
    if drift.cycles < least:
        return court.refuse("drift repeats", of, found=drift.cycles, wanted=least)
    if drift.sigma > court.policy.drift_unsure * abs(drift.whole):
        return _more_than_an_offset(court, of)
    within, wanted = drift.within / drift.whole, court.policy.drift_in_halves
    return within > wanted or court.refuse("drift goes on", of, found=within, wanted=wanted)


def _more_than_an_offset(court: Court, of: Hypothesis) -> bool:
    """Return whether a drift is better than an offset in its place by what an effect must earn.

    A load cell is zeroed at a time that the recording does not show, so that a drift begins with an
    offset. With an offset of its own it contains a constant as a special case, and its rate is one
    more effect; a drift that is assumed to be zero in the first row is not told from it by that.
    """
    which = next(i for i, p in enumerate(of.parts) if p.name in court.laws.wanders)
    places = (tuple(sorted((zero, *of.without(which)))) for zero in sorted(court.laws.zeros))
    offset = next((h for names in places if (h := court.by_names.get(names)) is not None), None)
    if offset is None:
        return True
    part = of.parts[which]
    own, wanted = offset.chi2 - of.chi2, court.times(of) * part.price
    return own >= wanted or court.refuse(
        "drift or offset", of, part=part.name, found=own, wanted=wanted, against=offset.names
    )


def off_zero(court: Court, of: Hypothesis) -> bool:
    """A constant force must be larger than the zero error of the displacement sensor makes it.

    A displacement is zeroed by a reading at rest, which contains the sensor's noise, and slow noise
    moves the zero by as much during the recording: through the spring a constant force, along a
    measured motion as on a free body. So does a drift move a free body. Nor is another law a
    finding for explaining what such a constant explains.
    """
    setting, zeros = court.setting, court.laws.zeros
    if setting.naive or setting.judged == "rig":
        return True
    constant = zeros | court.laws.wanders if setting.judged == "motion" else zeros
    times = court.times(of)
    for i, part in enumerate(of.parts):
        if part.name not in constant:
            continue
        found, wanted = court.ask("zero", of, (i,)) ** 2, times * part.price
        if found < wanted:
            return court.refuse("off zero", of, part=part.name, found=found, wanted=wanted)
    alone = next((h for n in sorted(zeros) if (h := court.by_names.get((n,))) is not None), None)
    if alone is None or not zeros.isdisjoint(of.names):
        return True
    if court.ask("zero", alone, (0,)) ** 2 >= alone.price:
        return True
    # Where a constant is there and only too small to report, a law explains what it leaves.
    beside = court.together(of, alone) or of
    own, wanted = alone.chi2 - min(of.chi2, beside.chi2), times * of.price
    return own >= wanted or court.refuse("beside zero", of, found=own, wanted=wanted)


def more_than_normal(court: Court, of: Hypothesis) -> bool:
    """A time offset of the load cell must be larger than is normal between two channels.

    Where friction jumps, a normal one shows clearly, and no stated value absorbs it there.
    """
    least = court.policy.offset_normal_s
    for part in of.parts:
        if 0.0 < abs(part.offset_s) < least:
            found = abs(part.offset_s)
            return court.refuse("normal offset", of, part=part.name, found=found, wanted=least)
    return True


def above_slow_noise(court: Court, of: Hypothesis) -> bool:
    """A constant force or a drift must stand out among the slow noise that a set leaves.

    Both are slow: their evidence is what they earn relative to the noise at such frequencies, not
    to that of all rows. A line read among noise that swells towards slow motion is part of it.
    """
    return _above_noise(court, of, court.laws.zeros | court.laws.wanders, "slow noise")


def above_near_noise(court: Court, of: Hypothesis) -> bool:
    """A line must stand out among its neighbours, by as much as from noise of an even spectrum.

    The noise of a load cell may swell around a frequency, and any line there fits part of it.
    """
    return _above_noise(court, of, court.laws.lines, "near noise")


def _above_noise(
    court: Court, of: Hypothesis, names: frozenset[str], what: Literal["slow noise", "near noise"]
) -> bool:
    setting = court.setting
    if setting.naive or setting.judged != "force":
        return True
    for i, part in enumerate(of.parts):
        without = court.by_names.get(of.without(i), court.null if len(of.parts) == 1 else None)
        if part.name not in names or without is None:
            continue
        power = court.ask(what, of) if what == "slow noise" else court.ask(what, of, (i,))
        if power < court.policy.slow_lines_power:
            continue
        found, wanted = without.chi2 - of.chi2, power * court.times(of) * part.price
        if found < wanted:
            return court.refuse(what, of, part=part.name, found=found, wanted=wanted)
    return True
