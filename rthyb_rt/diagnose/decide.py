"""Which set of effects is named: rules over evidence, which never see the recording itself.

What `evidence` gathers of each set stands in `Hypothesis`, of the recording in `Setting`. Some of
it costs a fit or a simulation and is asked for few sets: where a rule needs what is not known yet,
the answer is a `Need`, whoever asked gathers that and asks again. The same evidence has the same
answer, in whatever order it comes, and each rule says in the ledger what it has done.
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
"""Sets, best first, whose bristles are tried as yielding."""
What = Literal[
    "part", "yielding", "beyond forms", "drift", "driven", "size", "held out", "zero"
]  # fmt: skip


# ---- evidence -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """One effect of a set.

    Attributes:
        name: of its law.
        names: in the answer.
        price, count: what it has to earn, in chi-squared, and its parameters.
        late: it begins in mid-record.
        stated: it only moves a stated number.
        sensor, carries, dissipates: as its law declares.
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


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects, and what is known of it at once.

    Attributes:
        parts: its effects; none: the model alone, its stated numbers within their tolerance.
        chi2: what it leaves, in units of the noise, and what its priors cost.
        bent: effects in whose place it moves a stated number out of its tolerance.
        offset_sd: the time offset that it takes, in standard deviations of its tolerance.
        held_n_per_m, lost_n_per_m: stiffness of its bristles, and what its spring lacks.
        relaxes_rad: longest time of relaxation, times the motion's angular frequency; 0: none.
    """

    parts: tuple[Part, ...]
    chi2: float
    bent: frozenset[str] = frozenset()
    offset_sd: float = 0.0
    held_n_per_m: float = 0.0
    lost_n_per_m: float = 0.0
    relaxes_rad: float = 0.0

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Sorted names as in the answer."""
        return tuple(sorted(n for p in self.parts for n in p.names))

    @property
    def price(self) -> float:
        """What it has to earn."""
        return sum(p.price for p in self.parts)

    @property
    def count(self) -> int:
        """Parameters."""
        return sum(p.count for p in self.parts)

    @cached_property
    def score(self) -> float:
        """Chi-squared and price: less is better."""
        return self.chi2 + self.price

    @property
    def late(self) -> bool:
        """Whether one of its effects begins in mid-record."""
        return any(p.late for p in self.parts)

    def without(self, which: int) -> tuple[str, ...]:
        """Return its names less one effect's."""
        rest = (p for i, p in enumerate(self.parts) if i != which)
        return tuple(sorted(n for p in rest for n in p.names))


@dataclass(frozen=True)
class Laws:
    """What laws declare of one another, by name.

    Attributes:
        plainer: richer dry friction, with the law that it goes over into.
        relaxing: what relaxes, with what it is where that is over at once.
        slow_as: what a slow motion does not tell from a plainer law, with that.
        also: what is another law by name beside a spring of free stiffness, with that.
        sliders: sliders in a row, of which any number is a form of one.
        wanders, zeros: zeros of the load cell that do not stay, and that do.
        stiffness: what moves the model's stiffness.
    """

    plainer: Mapping[str, str]
    relaxing: Mapping[str, str]
    slow_as: Mapping[str, str]
    also: Mapping[str, str]
    sliders: frozenset[str]
    wanders: frozenset[str]
    zeros: frozenset[str]
    stiffness: str

    @staticmethod
    def of(catalogue: Mapping[str, Effect]) -> Laws:
        """Return what a catalogue of laws declares."""
        laws = list(catalogue.items())
        return Laws(
            {n: e.plainer for n, e in laws if e.dry and e.plainer},
            {n: e.plainer for n, e in laws if e.relaxes},
            {n: e.slow_as for n, e in laws if e.slow_as},
            {e.also: n for n, e in laws if e.also},
            frozenset(n for n, e in laws if e.slides),
            frozenset(n for n, e in laws if e.wanders),
            frozenset(n for n, e in laws if e.zero),
            next((n for n, e in laws if e.number == "k"), ""),
        )


@dataclass(frozen=True)
class Setting:
    """What is the same for all sets of a recording.

    Attributes:
        rows: independent rows that are judged.
        judged: the "force" along a motion, the "motion" that each set simulates, or the "rig".
        naive: whether the model states no tolerance of its stiffness.
        exact: whether the motion is known without the noise of an estimate.
        swings: whether it is the free decay of a naive model, see `decay`.
        k_free: whether the stiffness is refitted beside each set.
        k_sigma_n_per_m: standard deviation of the stated stiffness.
        returns: whether the noise of the load cell moves the specimen: a closed loop.
        witnessed: whether an accelerometer shows what the load cell does, see `redundant`.
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


@dataclass(frozen=True)
class Drift:
    """A drift by the two halves of a recording.

    Attributes:
        whole: its rate, of any unit.
        within: the same by the slopes within each half, whatever level it has there.
        sigma: standard deviation of that.
    """

    whole: float
    within: float
    sigma: float


@dataclass(frozen=True)
class Need:
    """Evidence that a rule asks for and that is not known yet.

    Attributes:
        what: "part", the set of some of its effects, as they are in it (Hypothesis, None where that
            is no physical law); "yielding", the set with yielding in the place of its bristles
            (the same); "beyond forms", what an effect of the load cell earns beside its other laws
            in any smooth form (chi-squared); "drift", its drift by halves (`Drift`); "driven",
            what each effect earns by the motion that a test makes (chi-squared, a number for each;
            none where nothing moves); "size", of its
            force as a part of the recorded one; "held out", the part of its gain that is there on
            rows that it was not fitted to; "zero", how far a constant force moves a free body, in
            standard deviations of the displacement's noise by its data sheet.
        of: of which set.
        which: of which of its effects.
    """

    what: What
    of: Hypothesis
    which: tuple[int, ...] = ()


@dataclass(frozen=True)
class Evidence:
    """All that is known when a set is to be named.

    Attributes:
        null: the model alone.
        sets: those to choose from.
        beside: those that are only compared with.
        known: answers to what was asked for.
    """

    setting: Setting
    null: Hypothesis
    sets: tuple[Hypothesis, ...]
    beside: tuple[Hypothesis, ...] = ()
    known: Mapping[Need, Any] = field(default_factory=dict)


# ---- answer -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ruling:
    """What a rule has done to one set.

    Attributes:
        rule: its name.
        names: the set.
        part: the effect that it turned on; empty: the set as a whole.
        found, wanted: the figure that decided and what it would have had to be; of a rule that
            compares sets the scores of both.
        against: names of the other set, where it was compared with one.
    """

    rule: str
    names: tuple[str, ...]
    part: str = ""
    found: float = float("nan")
    wanted: float = float("nan")
    against: tuple[str, ...] = ()


@dataclass(frozen=True)
class Choice:
    """What was decided.

    Attributes:
        best: the set that is named; the null where none is.
        ranked: sets that no rule refused, the best first.
        equal: others that fit as well.
        held: part of the gain of the first set that is there on rows left out.
        ledger: what each rule has done.
    """

    best: Hypothesis
    ranked: tuple[Hypothesis, ...]
    equal: tuple[Hypothesis, ...]
    held: float
    ledger: tuple[Ruling, ...]


class _Unknown(Exception):
    def __init__(self, need: Need) -> None:
        self.need = need


def times_price(policy: Policy, laws: int) -> float:
    """Return how many times its price an effect of a set of so many laws has to earn."""
    return policy.several_price if laws > 1 else 1.0


class Court:
    """Evidence as the rules read it, and their ledger."""

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
            raise _Unknown(need)
        return self.evidence.known[need]

    def refuse(self, rule: str, of: Hypothesis, **figures: Any) -> bool:
        """Write down what refused a set; return False."""
        self.ledger.append(Ruling(rule, of.names, **figures))
        return False

    @property
    def blurred(self) -> float:
        """By how much more a share has to be where the motion is estimated."""
        return 1.0 if self.setting.exact else self.policy.estimated_motion

    def share(self, of: Hypothesis) -> float:
        """Return the part of what a set explains that each of its effects has to explain alone."""
        return of_size(self.policy.needed_share, len(of.names)) * self.blurred

    def explained(self, of: Hypothesis, which: int) -> float:
        """Return the misfit that a set explains of the kind that one of its effects is to explain.

        A fall of chi-squared: for a law of damping in a free decay, of all such laws of the set.
        """
        whole = self.null.chi2 - of.chi2
        if not (self.setting.swings and of.parts[which].dissipates):
            return whole
        spring = tuple(i for i, p in enumerate(of.parts) if not p.dissipates)
        without = self.ask("part", of, spring) if spring else self.null
        return whole if without is None else without.chi2 - of.chi2

    def less(self, of: Hypothesis, which: int) -> Hypothesis | None:
        """Return a set without one of its effects; None where that is no physical law."""
        if len(of.parts) == 1:
            return self.null
        known = self.by_names.get(of.without(which))
        if known is not None:
            return known
        found: Hypothesis | None = self.ask(
            "part", of, tuple(i for i in range(len(of.parts)) if i != which)
        )
        return found

    def times(self, of: Hypothesis) -> float:
        """Return how many times its price an effect of a set has to earn."""
        return times_price(self.policy, len(of.parts))

    def strained(self, of: Hypothesis) -> bool:
        """Return whether a set takes a time offset that is no nuisance any more."""
        return of.offset_sd > self.policy.strained_offset

    def ends_at_noise(self, one: Hypothesis, other: Hypothesis) -> bool:
        """Return whether a set leaves little beyond the noise where another one leaves more."""
        policy, n = self.policy, self.setting.rows
        seen = {"force": policy.form_seen, "motion": policy.form_moved, "rig": policy.form_of_rig}
        left = other.chi2 - n
        at_noise = one.chi2 - n < policy.noise_reached * left
        return left > seen[self.setting.judged] * n and at_noise


# ---- rules that refuse a set --------------------------------------------------------------------


def needed(court: Court, of: Hypothesis) -> bool:
    """Each effect has to earn its price beside the others, and to be no form of theirs."""
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
        least = court.share(of) * court.explained(of, i)
        # What moves a stated number is seen against its tolerance, not in the residual.
        by_force = part.stated and court.setting.judged == "force"
        stated = by_force or (not part.late and part.name in less.bent)
        if own >= least or stated or _no_form(court, of, i, less):
            continue
        # Unless a time offset beyond what is normal would have to stand in for it. Beside a naive
        # model that says nothing: there an offset takes up what the form of a law leaves.
        if court.setting.naive or court.strained(of) or not court.strained(less):
            return court.refuse("share", of, part=part.name, found=own, wanted=least)
    return True


def _no_form(court: Court, of: Hypothesis, which: int, less: Hypothesis) -> bool:
    """Return whether an effect that explains little is more than the form of another's law."""
    return (
        _completes(court, of, less)
        or _of_no_form(court, of, which)
        or _before_a_dashpot(court, of, which)
    )


def _completes(court: Court, of: Hypothesis, less: Hypothesis) -> bool:
    """Return whether nothing but noise is left with an effect where without it there is more.

    What one law leaves of another's form is not all taken up by a third.
    """
    sliders = court.laws.sliders
    more = sliders.issubset(of.names) and not sliders.issubset(less.names)
    return court.setting.exact and not more and court.ends_at_noise(of, less)


def _of_no_form(court: Court, of: Hypothesis, which: int) -> bool:
    """Return whether an effect of the load cell is no form of the laws beside it.

    Where nothing but noise is left, and it earns its price still with each of those laws free to be
    itself times any smooth function of displacement and of velocity: no law follows what a load
    cell does by itself.
    """
    part, policy, n = of.parts[which], court.policy, court.setting.rows
    at_noise = of.chi2 - n < policy.excess_as_noise * n
    if not part.sensor or part.carries or court.setting.judged != "force":
        return False
    if not at_noise or court.setting.naive:
        return False
    return bool(court.ask("beyond forms", of, (which,)) > court.times(of) * part.price)


def _before_a_dashpot(court: Court, of: Hypothesis, which: int) -> bool:
    """Return whether an effect does better than a dashpot in its place that would be named.

    The dashpot moves a stated number and is excused from the share; what it only looks like is not
    to lose to it by that.
    """
    dashpot = court.laws.slow_as.get(of.parts[which].name)
    if dashpot is None:
        return False
    other = court.by_names.get(tuple(sorted((dashpot, *of.without(which)))))
    if other is None or of.score + court.policy.same_evidence > other.score:
        return False
    return needed(court, other)


def goes_on(court: Court, of: Hypothesis) -> bool:
    """A drift beside a naive model has to go on within the halves of the recording.

    What the forms of the other laws leave differs between early and late by chance of what was
    moved when, and a constant has a slope as well where it is taken to begin at nothing. A wander
    is there within each half, whatever level it has there, if the half can show it at all.
    """
    if court.laws.wanders.isdisjoint(of.names) or not court.setting.naive:
        return True
    drift: Drift = court.ask("drift", of)
    unsure = drift.sigma > court.policy.drift_unsure * abs(drift.whole)
    within, wanted = drift.within / drift.whole, court.policy.drift_in_halves
    if unsure or within > wanted:
        return True
    return court.refuse("drift goes on", of, found=within, wanted=wanted)


def off_zero(court: Court, of: Hypothesis) -> bool:
    """A constant force on a free body has to move it by more than its sensor's zero may be off.

    A displacement is set to zero by a reading at rest, which has the sensor's noise.
    """
    setting = court.setting
    if setting.naive or setting.judged != "motion":
        return True
    times = court.times(of)
    for i, part in enumerate(of.parts):
        if part.name not in court.laws.zeros:
            continue
        found, wanted = court.ask("zero", of, (i,)) ** 2, times * part.price
        if found < wanted:
            return court.refuse("off zero", of, part=part.name, found=found, wanted=wanted)
    return True


# ---- rules that compare sets --------------------------------------------------------------------

Sets = list[Hypothesis]


def worth_their_size(court: Court, sets: Sets) -> Sets:
    """Beside a naive model a set has to do better than the best of fewer laws.

    Its misfit is one of form, and two laws in a bad form leave to a third what another pair does.
    """
    if not court.setting.naive:
        return sets
    out = []
    for of in sets:
        fewer = [h.chi2 for h in sets if len(h.parts) < len(of.parts)]
        own = min(fewer, default=np.inf) - of.chi2
        # What the last of them is to explain; of a decay the damping, see there.
        wanted = court.share(of) * min(court.explained(of, i) for i in range(len(of.parts)))
        if own >= wanted or court.refuse("more laws", of, found=own, wanted=wanted):
            out.append(of)
    return out


def one_of_a_kind(court: Court, sets: Sets) -> Sets:
    """Bristles with another stiffness are left out where they are yielding by another name.

    k (alpha x + (1 - alpha) z) is a weaker spring and a slider on a spring: the same force. So is
    yielding beside a spring that is wrong as well; there the better one of the two stays. Of a
    model whose stiffness is free another one stands beside every set.
    """
    if court.setting.k_free:
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
    """Return the sets with those that have yielding in the place of the best ones' bristles."""
    also, names = court.laws.also, {h.names for h in sets}
    found = []
    for of in sets[:CLOSER]:
        bristles = next((n for n in also if n in of.names), "")
        if not bristles or also[bristles] in of.names:
            continue
        if tuple(sorted(also.get(n, n) if n == bristles else n for n in of.names)) not in names:
            yielded = court.ask("yielding", of)
            if yielded is not None and needed(court, yielded):
                found.append(yielded)
    return sorted([*sets, *found], key=lambda h: h.score)


def plainest(court: Court, sets: Sets) -> Sets:
    """Richer friction has to do better than dry friction in its place.

    Both go over into it; what they gain then is the form of the jump. So does relaxation that is
    over at once: it is a dashpot.
    """
    policy, out = court.policy, []
    share = policy.richer_friction_share * court.blurred
    for of in sets:
        plain = _plainer_of(court, of, sets)
        gain = plain.chi2 - of.chi2 if plain is not None else np.inf
        least = max(policy.richer_friction_gain, share * (court.null.chi2 - of.chi2))
        wanted = of.price - (plain.price if plain is not None else 0.0) + least
        against = plain.names if plain is not None else ()
        if gain > wanted or court.refuse(
            "plainest", of, found=gain, wanted=wanted, against=against
        ):
            out.append(of)
    return out


def _plainer_of(court: Court, of: Hypothesis, sets: Sets) -> Hypothesis | None:
    friction, relaxing = court.laws.plainer, court.laws.relaxing
    richer = {n for n in of.names if n in friction}

    def among(plainer: Mapping[str, str]) -> Hypothesis | None:
        names = tuple(sorted(plainer.get(n, n) for n in of.names))
        return next((h for h in sets if h.names == names), None)

    plain = None
    if len(richer) == 1 and not {friction[n] for n in richer} & set(of.names):
        plain = among(friction)
    alone = set(relaxing.values()).isdisjoint(of.names)
    quick = 0.0 < of.relaxes_rad < court.policy.quick_relaxation
    return among(relaxing) if plain is None and quick and alone else plain


def simplest_first(court: Court, sets: Sets) -> Sets:
    """The set of fewest parameters goes first among those that differ by a law's form only."""
    if not sets:
        return sets
    best = sets[0]
    form = court.policy.form_alone * (court.null.chi2 - best.chi2)
    # One that begins in mid-record has been chosen among as many moments, whatever its law.
    simple = [
        h
        for h in sets
        if len(h.names) == len(best.names)
        and h.count < best.count
        and (best.late or (len(best.names) > 1 and set(h.names) & set(best.names)))
        and h.score - best.score < form
        and not court.ends_at_noise(best, h)
    ]
    if not simple:
        return sets
    first = min(simple, key=lambda h: h.score)
    court.refuse("simplest first", best, found=best.score, wanted=first.score, against=first.names)
    return [first, *[h for h in sets if h is not first]]


def driven(court: Court, of: Hypothesis) -> bool:
    """In a closed loop each effect has to earn its price by the motion that the test makes.

    Above the band of that the noise of the load cell is all that moves the specimen, and a law can
    have that noise back out of the motion that it made: see `feedback`. A late load cell has to in
    any recording: beside an offset of its channel it filters that noise, moved or not. But where an
    accelerometer shows how late it is, that is evidence of its own.
    """
    setting = court.setting
    alone = setting.judged == "force" and not setting.naive and not setting.witnessed
    late = alone and any(p.carries for p in of.parts)
    if not setting.returns and not late:
        return True
    times = court.times(of)
    for part, own in zip(of.parts, court.ask("driven", of), strict=False):
        # What a load cell does by itself, as hum, is no function of the motion.
        follows = part.carries or (setting.returns and not part.sensor)
        wanted = times * part.price
        if follows and own < wanted:
            return court.refuse("driven", of, part=part.name, found=own, wanted=wanted)
    return True


def each(rule: Callable[[Court, Hypothesis], bool]) -> Callable[[Court, Sets], Sets]:
    """Return a rule that judges one set after the other as one that judges all."""
    return lambda court, sets: [h for h in sets if rule(court, h)]


RANKING: dict[str, Callable[[Court, Sets], Sets]] = {
    "needed": each(needed),
    "off zero": each(off_zero),
    "drift goes on": each(goes_on),
    "driven": each(driven),
    "more laws": worth_their_size,
    "yielding": one_of_a_kind,
    "plainest": plainest,
    "simplest first": simplest_first,
}
"""Rules that refuse or order sets, in turn."""


# ---- rules for the one that is left first -------------------------------------------------------


def earns(court: Court, of: Hypothesis) -> bool:
    """It has to be worth its price; of several effects there are many to choose from."""
    gain = court.null.chi2 - of.chi2
    wanted = of.price * court.times(of)
    return gain > wanted or court.refuse("earns", of, found=gain, wanted=wanted)


def is_a_finding(court: Court, of: Hypothesis) -> bool:
    """Its force has to be of some size."""
    size = court.ask("size", of)
    wanted = court.policy.least_force
    return size > wanted or court.refuse("size", of, found=size, wanted=wanted)


def holds(court: Court, of: Hypothesis) -> bool:
    """It has to hold on rows that it was not fitted to."""
    held = court.ask("held out", of)
    wanted = court.policy.held_out_share
    return held >= wanted or court.refuse("held out", of, found=held, wanted=wanted)


NAMING: dict[str, Callable[[Court, Hypothesis], bool]] = {
    "earns": earns,
    "size": is_a_finding,
    "held out": holds,
}
"""What the first set has to be to be named; no other one takes its place."""


# ---- sets that fit alike ------------------------------------------------------------------------


def alike(court: Court, best: Hypothesis, sets: Sets) -> Sets:
    """Sets that differ by less than evidence can tell, a further parameter counted."""
    policy = court.policy
    out = []
    for of in sets:
        extra = max(0, of.count - best.count)
        worse = of.chi2 - best.chi2 + policy.dearer_rival * policy.same_evidence * extra
        if of.names != best.names and worse < policy.same_evidence:
            out.append(of)
    return out


def twins(court: Court, best: Hypothesis, sets: Sets) -> Sets:
    """Single effects that do the same as a single best one and were refused for their price.

    To move a stated number is cheap, but where the recording shows no difference at all, being the
    cheaper one is no evidence.
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
"""Rules that find what cannot be told apart from the set that is named."""


# ---- all of them --------------------------------------------------------------------------------


def choose(evidence: Evidence, policy: Policy, less: Iterable[str] = ()) -> Choice | Need:
    """Return which set is named and which fit as well, or what has to be known for that.

    Args:
        evidence: what is known.
        policy: the thresholds.
        less: rules, by name, that are left out: to see what each is there for.
    """
    court, gone = Court(evidence, policy), set(less)
    try:
        return _choose(court, gone)
    except _Unknown as unknown:
        return unknown.need


def _order(of: Hypothesis) -> tuple[float, tuple[str, ...]]:
    return of.score, of.names


def _choose(court: Court, gone: set[str]) -> Choice:
    sets = sorted(court.evidence.sets, key=_order)
    for name, rule in RANKING.items():
        sets = sets if name in gone else rule(court, sets)
    best = sets[0] if sets else court.null
    named = bool(sets) and all(ask(court, best) for n, ask in NAMING.items() if n not in gone)
    held = court.ask("held out", best) if named else 0.0
    if not named:
        return Choice(court.null, tuple(sets), (), held, tuple(court.ledger))
    equal = []
    for name, find in ALIKE.items():
        for of in [] if name in gone else find(court, best, sets):
            if court.ask("held out", of) > court.policy.held_out_share:
                equal.append(of)
                court.ledger.append(
                    Ruling(name, of.names, "", of.chi2 - best.chi2, against=best.names)
                )
    return Choice(best, tuple(sets), tuple(equal), held, tuple(court.ledger))


def gathered(
    evidence: Evidence,
    policy: Policy,
    answer: Callable[[Need], Any],
    beside: Callable[[], Sequence[Hypothesis]] = tuple,
) -> Choice:
    """Return what is decided with evidence gathered as the rules ask for it.

    Args:
        evidence: what is known at first.
        policy: the thresholds.
        answer: gathers what is needed.
        beside: gives the sets that have become known on the way, to be compared with.
    """
    while isinstance(done := choose(evidence, policy), Need):
        known = {**evidence.known, done: answer(done)}
        evidence = replace(evidence, known=known, beside=tuple(beside()))
    return done
