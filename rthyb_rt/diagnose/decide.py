"""Which set of effects is named: rules on evidence, independent of the recording itself.

`evidence` gathers what is known of each set into `Hypothesis`, and of the recording into `Setting`.
Some evidence requires a fit or a simulation and is gathered for few sets only: if a rule needs
more, `choose` returns a `Need`; the caller gathers it and calls again. The same evidence gives the
same answer, in whatever order it is gathered, and each rule records in the ledger what it has done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from rthyb_rt.diagnose.effects import Effect
from rthyb_rt.diagnose.policy import Policy, of_size

CLOSER = 3
"""Number of sets, best first, for which yielding is tried in place of bristles."""
What = Literal[
    "part", "yielding", "beyond forms", "drift", "driven", "driven together", "driven more", "size",
    "own size", "left", "held out", "zero", "slow noise", "near noise", "rounding",
]  # fmt: skip


# ---- evidence -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class SetMember:
    """One effect of a set.

    Attributes:
        name: name of its law.
        names: names in the answer.
        price, count: what it must earn, in chi-squared, and its number of parameters.
        late: it begins in mid-recording.
        stated: it only changes a stated value.
        sensor, carries, dissipates: as declared by its law.
        offset_s: by how much it shifts the load cell's rows in time, together with the fitted time
            offset; 0: it does not.
        settles_rad: the time against which it acts like a simpler law in slower motion, times the
            motion's angular frequency; 0: none.
        complete: it is the whole law of a damaged or slack member; no formula renders it exactly.
    """

    name: str
    names: tuple[str, ...]
    price: float
    count: int
    late: bool = False
    stated: bool = False
    sensor: bool = False
    carries: bool = False
    dissipates: bool = False
    offset_s: float = 0.0
    settles_rad: float = 0.0
    complete: bool = False

    @property
    def additive(self) -> bool:
        """Whether the load cell adds it to the force of the specimen."""
        return self.sensor and not self.carries


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects, with the evidence that is always available.

    Attributes:
        parts: its effects; none: the model alone, with stated values within tolerance.
        chi2: residual in units of the noise, including the cost of its priors.
        bent: effects that it replaces by moving a stated value out of its tolerance.
        offset_sd: fitted time offset, in standard deviations of its tolerance.
        held_n_per_m, lost_n_per_m: stiffness of its bristles, and loss of its spring.
        strained: effects of the stated values that it moves farther than the model may be wrong.
    """

    parts: tuple[SetMember, ...]
    chi2: float
    bent: frozenset[str] = frozenset()
    offset_sd: float = 0.0
    held_n_per_m: float = 0.0
    lost_n_per_m: float = 0.0
    strained: frozenset[str] = frozenset()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Sorted names as in the answer."""
        return tuple(sorted(n for p in self.parts for n in p.names))

    @property
    def price(self) -> float:
        """What it must earn."""
        return sum(p.price for p in self.parts)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return sum(p.count for p in self.parts)

    @cached_property
    def score(self) -> float:
        """Chi-squared plus price: less is better."""
        return self.chi2 + self.price

    @property
    def late(self) -> bool:
        """Whether one of its effects begins in mid-recording."""
        return any(p.late for p in self.parts)

    def without(self, which: int) -> tuple[str, ...]:
        """Return its names without those of one effect."""
        rest = (p for i, p in enumerate(self.parts) if i != which)
        return tuple(sorted(n for p in rest for n in p.names))


@dataclass(frozen=True)
class Laws:
    """What laws declare about one another, by name.

    Attributes:
        plainer: friction laws, with the simpler law that each contains as a special case.
        settling: laws that act like a simpler law in motion slow enough, with that law.
        limits: laws that slow, or fast, motion cannot distinguish from other ones, with those.
        also: laws equivalent to another law in parallel with a free spring, with that law.
        sliders: sliders in series, any number of which is a form of the same effect.
        wanders, zeros: zeros of the load cell that change with time, and constant ones.
        lines: effects with a single frequency of their own.
        stiffness: effects that change the model's stiffness.
    """

    plainer: Mapping[str, str]
    settling: Mapping[str, str]
    limits: Mapping[str, frozenset[str]]
    also: Mapping[str, str]
    sliders: frozenset[str]
    wanders: frozenset[str]
    lines: frozenset[str]
    zeros: frozenset[str]
    stiffness: str

    @staticmethod
    def of(catalogue: Mapping[str, Effect]) -> Laws:
        """Return what a catalogue of laws declares."""
        laws = list(catalogue.items())
        return Laws(
            {n: e.plainer for n, e in laws if e.dry and e.plainer},
            {n: e.plainer for n, e in laws if e.settles},
            {n: frozenset({e.slow_as, e.fast_as}) - {""} for n, e in laws},
            {e.also: n for n, e in laws if e.also},
            frozenset(n for n, e in laws if e.slides),
            frozenset(n for n, e in laws if e.wanders),
            frozenset(n for n, e in laws if e.line),
            frozenset(n for n, e in laws if e.zero),
            next((n for n, e in laws if e.number == "k"), ""),
        )


@dataclass(frozen=True)
class Setting:
    """What is the same for all sets of a recording.

    Attributes:
        rows: number of independent rows evaluated.
        judged: "force" along a motion, "motion" simulated with each set, or "rig".
        naive: whether the model states no tolerance of its stiffness.
        exact: whether the motion is free of estimation noise.
        swings: whether it is a free decay and the model is naive, see `decay`.
        k_free: whether the stiffness is refitted with each set.
        k_sigma_n_per_m: standard deviation of the stated stiffness.
        returns: whether one noise is in force and motion: the load cell's moves the specimen in a
            closed loop; without a load cell, the force of a body is inferred from its motion.
        witnessed: whether an accelerometer verifies the load cell, see `redundant`.
        coarse: whether the load cell is evaluated only where it changes its reading, see `coarse`.
    """

    laws: Laws
    rows: float
    judged: Literal["force", "motion", "rig"] = "force"
    naive: bool = False
    exact: bool = True
    swings: bool = False
    k_free: bool = False
    k_sigma_n_per_m: float = 0.0
    returns: bool = False
    witnessed: bool = False
    coarse: bool = False


@dataclass(frozen=True)
class DriftRates:
    """A drift in the two halves of a recording.

    Attributes:
        whole: its rate, in any unit.
        within: its rate from the slopes within each half, with separate offsets.
        sigma: standard deviation of ``within``.
        cycles: cycles of the motion in the half that has fewer; infinite for one that rests.
    """

    whole: float
    within: float
    sigma: float
    cycles: float


@dataclass(frozen=True)
class Need:
    """Evidence that a rule requires and that is not yet known.

    Attributes:
        what: "part", the set of some of its effects, as they are in it (Hypothesis, None if it is
            not a physical law); "yielding", the set with yielding in place of its bristles
            (likewise); "beyond forms", what an effect earns if the other laws may take other forms,
            for an effect of the load cell any smooth form (chi-squared); "drift", its drift by
            halves (`DriftRates`); "driven", what each effect earns by the motion that the test
            imposes (chi-squared, a number for each; empty if nothing moves); "driven together",
            what those of ``which`` earn together (likewise, one number); "driven more", what the
            one in ``which`` earns beyond its simpler law (likewise); "size", its force relative
            to the recorded force; "own size", that of one effect; "left", the rms difference from
            the recorded force with the set, as a multiple of that of the model as given; "held
            out", the fraction of its gain that is confirmed on rows to which it was not fitted;
            "zero", how far a constant force or a drift deflects the spring, in standard deviations
            of the displacement noise in its data sheet; "slow noise", the power of the slowest
            lines of what it leaves, as a multiple of the noise power; "near noise", that of the
            lines next to that of the effect; "rounding", how improbable the readings of a coarse
            load cell are with it, each as an interval (-2 ln).
        of: the set.
        which: indices of the effects concerned.
    """

    what: What
    of: Hypothesis
    which: tuple[int, ...] = ()


@dataclass(frozen=True)
class Evidence:
    """Everything known when a set is to be named.

    Attributes:
        null: the model alone.
        sets: sets to choose from.
        beside: sets used for comparison only.
        known: answers to earlier needs.
    """

    setting: Setting
    null: Hypothesis
    sets: tuple[Hypothesis, ...]
    beside: tuple[Hypothesis, ...] = ()
    known: Mapping[Need, Any] = field(default_factory=dict)


# ---- answer -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ruling:
    """What a rule did to one set.

    Attributes:
        rule: its name.
        names: the set.
        part: the effect that was decisive; empty: the set as a whole.
        found, wanted: the decisive figure and its required value; for a rule that compares sets,
            the scores of both.
        against: names of the set with which it was compared.
    """

    rule: str
    names: tuple[str, ...]
    part: str = ""
    found: float = float("nan")
    wanted: float = float("nan")
    against: tuple[str, ...] = ()


@dataclass(frozen=True)
class Choice:
    """The decision.

    Attributes:
        best: the set that is named; the null if there is none.
        ranked: sets that no rule rejected, the best first.
        equal: other sets that fit equally well.
        held: fraction of the first set's gain that is confirmed on rows held out.
        ledger: what each rule did.
    """

    best: Hypothesis
    ranked: tuple[Hypothesis, ...]
    equal: tuple[Hypothesis, ...]
    held: float
    ledger: tuple[Ruling, ...]


class _UnknownNeed(Exception):
    def __init__(self, need: Need) -> None:
        self.need = need


def times_price(policy: Policy, laws: int) -> float:
    """Return the multiple of its price that an effect must earn in a set of several laws."""
    return policy.several_price if laws > 1 else 1.0


class Court:
    """The evidence as seen by the rules, and their ledger."""

    def __init__(self, evidence: Evidence, policy: Policy) -> None:
        self.evidence, self.policy = evidence, policy
        self.setting, self.laws = evidence.setting, evidence.setting.laws
        self.null = evidence.null
        self.by_names = {h.names: h for h in (*evidence.sets, *evidence.beside)}
        self.ledger: list[Ruling] = []

    def ask(self, what: What, of: Hypothesis, which: tuple[int, ...] = ()) -> Any:
        """Return evidence that is gathered on demand."""
        need = Need(what, of, which)
        if need not in self.evidence.known:
            raise _UnknownNeed(need)
        return self.evidence.known[need]

    def refuse(self, rule: str, of: Hypothesis, **figures: Any) -> bool:
        """Record the rejection of a set; return False."""
        self.ledger.append(Ruling(rule, of.names, **figures))
        return False

    @property
    def blurred(self) -> float:
        """Factor by which a share must be larger if the motion is estimated."""
        return 1.0 if self.setting.exact else self.policy.estimated_motion

    @property
    def noisy_motion(self) -> bool:
        """Whether laws are functions of a motion that was estimated from noisy channels."""
        return self.setting.judged == "force" and not self.setting.exact and not self.setting.naive

    def together(self, of: Hypothesis, other: Hypothesis) -> Hypothesis | None:
        """Return the set with the effects of both, if it was fitted."""
        return self.by_names.get(tuple(sorted((*of.names, *other.names))))

    def share(self, of: Hypothesis) -> float:
        """Return the fraction of the explained misfit that each effect must explain alone."""
        return of_size(self.policy.needed_share, len(of.names)) * self.blurred

    def whole(self, of: Hypothesis, which: int) -> float:
        """Return the misfit explained by a set, as a reduction of chi-squared.

        For damping in a free decay, that of all damping laws in the set.
        """
        if not (self.setting.swings and of.parts[which].dissipates):
            return self._beyond(of, ())
        return self._beyond(of, tuple(i for i, p in enumerate(of.parts) if not p.dissipates))

    def explained(self, of: Hypothesis, which: int) -> float:
        """Return the misfit explained by a set, of the kind that one of its effects can explain.

        What a law leaves because of its form is in proportion to its own force, and a force that
        the load cell adds depends on time or on another channel: what it explains is no measure for
        the share of another effect.
        """
        apart = tuple(i for i, p in enumerate(of.parts) if p.additive and i != which)
        if self.setting.judged != "force" or not apart:
            return self.whole(of, which)
        return self._beyond(of, apart)

    def _beyond(self, of: Hypothesis, apart: tuple[int, ...]) -> float:
        """Return what a set explains that some of its effects, if physical alone, do not."""
        without = self.of(of, apart)
        return (self.null if without is None else without).chi2 - of.chi2

    def of(self, of: Hypothesis, which: tuple[int, ...]) -> Hypothesis | None:
        """Return a set of some effects of another one; None if that is not a physical law.

        Richer friction contains dry friction, which takes its place where it fits better: then the
        richer one was refined elsewhere.
        """
        if not which:
            return self.null
        names = sorted(n for i in which for n in of.parts[i].names)
        found: Hypothesis | None = self.by_names.get(tuple(names))
        if found is None:
            found = self.ask("part", of, which)
        plain = self.by_names.get(tuple(sorted(self.laws.plainer.get(n, n) for n in names)))
        if found is not None and plain is not None and plain.chi2 < found.chi2:
            return plain
        return found

    def less(self, of: Hypothesis, which: int) -> Hypothesis | None:
        """Return a set without one of its effects; None if that is not a physical law."""
        return self.of(of, tuple(i for i in range(len(of.parts)) if i != which))

    def times(self, of: Hypothesis) -> float:
        """Return the multiple of its price that an effect of a set must earn."""
        return times_price(self.policy, len(of.parts))

    def relieves(self, of: Hypothesis, less: Hypothesis, beyond_form: bool = True) -> bool:
        """Return whether a set needs no abnormal time offset or stated value that another needs.

        It must fit clearly better than the other set together with that change of a stated value,
        and by more than the form of a law may leave: damping makes up for that, a time does not.
        """
        if of.offset_sd <= self.policy.strained_offset < less.offset_sd:
            return True
        for name in less.strained - of.strained - set(less.names) if beyond_form else ():
            changed = self.by_names.get(tuple(sorted((*less.names, name))))
            if changed is None or of.score + self.policy.same_evidence < changed.score:
                return True
        return False

    def ends_at_noise(self, one: Hypothesis, other: Hypothesis) -> bool:
        """Return whether a set reaches the noise and another one leaves more."""
        policy, n = self.policy, self.setting.rows
        seen = {"force": policy.form_seen, "motion": policy.form_moved, "rig": policy.form_of_rig}
        left = other.chi2 - n
        at_noise = one.chi2 - n < policy.noise_reached * left
        return left > seen[self.setting.judged] * n and at_noise


# ---- rules that reject a set --------------------------------------------------------------------


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


# ---- rules that compare sets --------------------------------------------------------------------

Sets = list[Hypothesis]


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
    refined that set in another form of yielding, and then it is replaced.
    """
    also, names = court.laws.also, {h.names: h for h in sets}
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
    return sorted(names.values(), key=_order)


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
        same = of.names == best.names or _one_joint_law(of, best)
        if not same and worse < policy.same_evidence:
            out.append(of)
    return out


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
    return sorted(found, key=_order)


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
    except _UnknownNeed as unknown:
        return unknown.need


def _order(of: Hypothesis) -> tuple[float, tuple[str, ...]]:
    return of.score, of.names


def _choose(court: Court, gone: set[str]) -> Choice:
    sets = sorted(court.evidence.sets, key=_order)
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
