"""The verdict on a recording: rules on the residuals of the named set and of the model alone.

As in `decide`, the rules do not see the recording. What requires a simulation is requested only if
it is decisive, and each rule that changed the verdict is recorded in the ledger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from rthyb_rt.diagnose.court import Ruling
from rthyb_rt.diagnose.policy import SIDES, Policy, of_size

CURVES = 3
"""Number of functions of one variable whose sum follows almost any other."""

Said = Literal["none", "explained", "ambiguous", "unknown"]
Names = tuple[str, ...]
Asked = Literal[
    "sheet", "simulated", "reproduced", "strength", "changes", "varying", "stroke", "memory"
]  # fmt: skip


# ---- evidence -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Left:
    """Residuals of the best set, and of the model alone, in the force.

    Attributes:
        names: names of the best set; none: nothing was found.
        equal: names of others that fit equally well.
        laws: number of laws of the best set; a joint law of several effects counts as one.
        curves: number of them that are functions of the displacement alone.
        before, after: misfit of the model alone and of the set, beyond noise, in noise power.
        scale: factor by which evidence was scaled down.
        part_before, part_after: the same misfits, rms, relative to the force; 0 if a model with
            stated tolerances has a motion that is free of estimation noise.
        bent, bent_after: largest change of a stated value by model and set, in standard deviations.
        stated: effects that only change a stated value.
        price: what the set must earn, in chi-squared.
        naive: whether the model states no tolerance of its stiffness.
        exact: whether the motion is free of estimation noise.
        coloured: whether the noise has a colour that was determined from the recording.
        moved: whether the motion was evaluated, simulated with each set.
        quiet: whether the residual of a simulated motion is within the displacement's data sheet.
        late: whether a law of the set begins in mid-recording.
        cell: whether a load cell measures the force.
        loud: whether the model alone leaves more of it than its data sheet permits for noise.
        of_force: fraction of the power of the model's residual beyond the data sheet's noise that
            the set leaves, in the force as it is.
    """

    names: Names = ()
    equal: tuple[Names, ...] = ()
    laws: int = 0
    curves: int = 0
    before: float = 0.0
    after: float = 0.0
    scale: float = 1.0
    part_before: float = 0.0
    part_after: float = 0.0
    bent: float = 0.0
    bent_after: float = 0.0
    stated: frozenset[str] = frozenset()
    price: float = 0.0
    naive: bool = False
    exact: bool = True
    coloured: bool = False
    moved: bool = False
    quiet: bool = False
    late: bool = False
    cell: bool = True
    loud: bool = False
    of_force: float = 1.0

    @property
    def size(self) -> int:
        """Number of effects of the best set."""
        return len(self.names)

    @property
    def share(self) -> float:
        """Fraction of the misfit that the best set leaves.

        For a naive model in coloured noise, measured in the force itself.
        """
        if self.naive and self.coloured:
            return self.of_force
        return self.after / max(self.before, 1e-12)

    def coloured_noise(self, policy: Policy) -> bool:
        """Return whether the best set's residual may be noise of a colour determined from it."""
        return self.coloured and self.after < policy.excess_as_noise


@dataclass(frozen=True)
class Moved:
    """Result for the actuator.

    Attributes:
        names, equal: names of the best set and of others that fit equally well.
        known: whether its residual may be noise, or due to the form of a law.
        exact: whether its effects have no other form than that of the formula.
    """

    names: Names = ()
    equal: tuple[Names, ...] = ()
    known: bool = True
    exact: bool = True


@dataclass(frozen=True)
class Rounded:
    """A coarse load cell, and how much its quantisation explains.

    Attributes:
        name: name in the answer.
        share: fraction of the power of the model's residual that rounding explains.
        gain: what the best set earns beyond its price, in chi-squared.
        beyond: fraction of rows with a residual of the model beyond rounding and noise.
        beyond_best: the same for the best set.
        exact: whether the force was evaluated where the reading changes, without rounding.
    """

    name: str
    share: float = 1.0
    gain: float = 0.0
    beyond: float = 0.0
    beyond_best: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class Simulated:
    """A free body's motion by the model alone, with its parameters fitted within reason.

    Attributes:
        k_off, c_off: how far they had to be moved, in standard deviations.
        nrmse: error of the displacement.
        noise: noise of its sensor, likewise.
    """

    k_off: float
    c_off: float
    nrmse: float
    noise: float


@dataclass(frozen=True)
class Reproduced:
    """A free body's motion by a set from the force balance, fitted to its displacement.

    Attributes:
        before, after: misfit of the model alone and of the set, beyond noise, in noise power;
            infinite if the motion diverges.
        bent: largest change of a stated value by the model alone, in standard deviations.
        quiet_before, quiet: whether that misfit is within the displacement's data sheet.
    """

    before: float
    after: float
    bent: float = 0.0
    quiet_before: bool = False
    quiet: bool = False


@dataclass(frozen=True)
class Seen:
    """Everything known for the verdict.

    Attributes:
        known: answers to what was asked: "sheet", whether the residual of the set is within the
            load cell's data sheet; "simulated" and "reproduced", None if the motion is not
            decisive; "strength", the least squared ratio of an effect's size to its standard
            deviation; None if no motion is known; "changes", how far beyond chance
            the set's parameters differ in a part of the recording, by the description of that part,
            in standard deviations; "varying", the additional gain of a coefficient that changes
            periodically with time, in chi-squared; "stroke" and "memory", the same for a mass whose
            own spring changes with its stroke, and for a force with fractional memory.
    """

    force: Left | None = None
    actuator: Moved | None = None
    rounding: Rounded | None = None
    known: Mapping[Asked, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """The verdict.

    Attributes:
        names: effects, the actuator's first.
        sets: for an ambiguous verdict, all sets that fit equally well.
        force, actuator: whether the best set of the channel is named.
        rounding: whether rounding is named.
        ledger: rules that changed the verdict.
    """

    said: Said
    names: Names = ()
    sets: tuple[Names, ...] = ()
    force: bool = False
    actuator: bool = False
    rounding: bool = False
    ledger: tuple[Ruling, ...] = ()


class _UnknownAnswer(Exception):
    def __init__(self, asked: Asked) -> None:
        self.asked = asked


class _Court:
    def __init__(self, seen: Seen, policy: Policy) -> None:
        self.seen, self.policy = seen, policy
        self.ledger: list[Ruling] = []

    def ask(self, what: Asked) -> Any:
        if what not in self.seen.known:
            raise _UnknownAnswer(what)
        return self.seen.known[what]

    def rules(self, rule: str, names: Names, found: float, wanted: float, part: str = "") -> None:
        """Record a rule that changed the verdict, and the part of the data that it used."""
        self.ledger.append(Ruling(rule, names, part, found, wanted))


# ---- whether the residual contains nothing more -------------------------------------------------


def small(left: Left, part: float, policy: Policy) -> bool:
    """Return whether a misfit is within the accuracy of an estimated motion."""
    return not left.exact and part < blur_of(left, policy)


def blur_of(left: Left, policy: Policy) -> float:
    """Return the misfit in the force that an estimated motion may cause."""
    return policy.blur_cell if left.cell else policy.blur_free


def within(bent: float, policy: Policy) -> bool:
    """Return whether a fit stays within the stated tolerances."""
    return bent < policy.within_tolerance


def allowed(left: Left, policy: Policy) -> float:
    """Return the fraction of the misfit that may be due to the form of a set's laws."""
    if left.moved:
        return of_size(policy.left_moved, left.size)
    # A free onset can absorb much: the residual is then not attributed to the estimate.
    blurred = 1.0 if left.exact or left.late else policy.estimated_motion
    return blurred * of_form(left.naive, left.size, policy)


def of_form(naive: bool, size: int, policy: Policy) -> float:
    """Return the fraction of a misfit that may be due to the form of this many laws."""
    return policy.left_naive if naive else of_size(policy.left_stated, size)


def understood(left: Left, policy: Policy, sheet: Callable[[], bool]) -> bool:
    """Return whether the residual of what was found may be due to the form of a law.

    Args:
        left: the residual.
        policy: the thresholds.
        sheet: returns whether it is within the load cell's data sheet.
    """
    at_noise = left.after < policy.excess_as_noise
    share = left.after / max(left.before, 1e-12)
    if left.moved and (left.quiet or at_noise):
        # If the motion is as measured, with or without a named set, the force is explained.
        return True
    if left.moved and left.names:
        return share < allowed(left, policy)
    if left.coloured and sheet():
        return True
    if not left.names:
        # A small colour for which no law earns its price is not a finding.
        nothing = left.before < policy.excess_as_noise + policy.excess_of_nothing
        blurred = small(left, left.part_before, policy) and within(left.bent, policy)
        refitted = left.naive and left.part_before < policy.naive_nothing
        return not left.coloured and (nothing or refitted or blurred)
    above = left.scale < policy.colourless and left.after < policy.colourless_excess
    if left.coloured and left.naive:
        # The residual of a naive model is due to form, of which noise with a free colour has
        # absorbed what it could: the force itself shows how much is left.
        return left.of_force < allowed(left, policy)
    if left.coloured_noise(policy):
        # Noise with a free colour has absorbed only what is within the data sheet, or what is so
        # small beside a clear finding that the form of a law leaves more.
        little = left.loud and left.of_force < policy.form_alone
        return little and left.bent_after < policy.bent_number
    if (at_noise or above) and not left.coloured:
        # At the noise, or above it but white: the data sheet understates the noise. Noise with a
        # free colour must be within the data sheet, and without bursts.
        return True
    # Coloured noise weighs most what lies where it is weak; what a set leaves of the force as it is
    # counts as well.
    of_force = left.coloured and left.loud and left.of_force < allowed(left, policy)
    return small(left, left.part_after, policy) or share < allowed(left, policy) or of_force


def needs_nothing(left: Left, policy: Policy) -> bool:
    """Return whether the model alone leaves no more than noise, within its tolerances.

    What a set then explains beside it may be doubtful, but no law is missing for that reason.
    """
    alone = left.before < policy.excess_as_noise and not left.loud
    return alone and within(left.bent, policy)


def simulates(made: Simulated | None, policy: Policy) -> bool:
    """Return whether the model alone, adjusted within tolerance, reproduces the motion.

    Without a load cell this decides: a force that the displacement does not show is the smoother's.
    """
    if made is None or max(made.k_off, made.c_off) > policy.within_tolerance:
        return False
    unseen = made.nrmse**2 - made.noise**2
    return made.nrmse < policy.simulated_nrmse and unseen < policy.simulated_unseen**2


# ---- rules that withdraw the set of the force ---------------------------------------------------

Turn = tuple[bool, bool]
"""Whether the set is named, and whether the residual of the force is explained."""


def blur(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """If the model alone is within the accuracy of an estimated motion, no law is needed.

    Unless the motion itself shows that the model lacks something: a force within that accuracy
    moves a body near resonance by far more than the noise of the displacement.
    """
    if left.moved or not small(left, left.part_before, court.policy):
        return named, known
    if named and within(left.bent, court.policy) and not set(left.names) <= left.stated:
        made: Simulated | None = court.ask("simulated")
        if made is not None and not simulates(made, court.policy):
            return named, known
        court.rules("blur", left.names, left.part_before, blur_of(left, court.policy))
        return False, known
    return named, known


def motion(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """If the model alone reproduces the motion of a free body, nothing is missing."""
    if left.moved or not (named or not known):
        return named, known
    made: Simulated | None = court.ask("simulated")
    if made is None or not simulates(made, court.policy):
        return named, known
    court.rules("motion", left.names, made.nrmse, court.policy.simulated_nrmse)
    return False, True


def reproduced(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """A set that the force balance names must reproduce the motion of a body without load cell.

    Its force was inferred from that motion: the balance proposes, the simulation decides. A set
    that leaves more of the motion than the form of its laws may is at most part of the answer.
    """
    policy = court.policy
    if left.moved or not named:
        return named, known
    made: Reproduced | None = court.ask("reproduced")
    if made is None:
        return named, known

    def met(excess: float, quiet: bool) -> bool:
        return quiet or excess < policy.motion_met - 1.0

    share, most = made.after / max(made.before, 1e-12), of_size(policy.left_moved, left.size)
    if met(made.after, made.quiet) or share < most:
        return named, known
    court.rules("reproduced", left.names, share, most)
    return False, met(made.before, made.quiet_before) and within(made.bent, policy)


def chance(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """A single effect beside noise is no finding if noise of this colour may produce it.

    If the colour of the noise was determined from the recording itself, evidence counted by rows is
    only as reliable as that colour. The effect's interval includes more, such as the scatter
    between parts of the recording: by this measure, too, the effect must earn its price. Not if the
    noise without it would exceed the data sheet.
    """
    noise = left.before < court.policy.excess_as_noise and left.coloured and not left.loud
    if not named or not noise or left.laws != 1 or left.moved:
        return named, known
    strength: float | None = court.ask("strength")
    if strength is None or strength >= left.price:
        return named, known
    court.rules("chance", left.names, strength, left.price)
    return False, known


def leftover(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """Beside an inexact effect of the actuator, a force must explain most of what may be noise.

    The force was evaluated along a motion simulated with that effect, such as a delay that grows
    with velocity. The error of its formula shows in the force, and something in the catalogue
    absorbs a part of it.
    """
    actuator, policy = court.seen.actuator, court.policy
    if not named or left.moved or actuator is None or actuator.exact:
        return named, known
    noise = left.before < policy.excess_as_noise + policy.excess_of_nothing
    if not noise or left.loud or left.share <= policy.leftover_share:
        return named, known
    court.rules("leftover", left.names, left.share, policy.leftover_share)
    return False, within(left.bent, policy)


def weak(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """Each effect of a set must have a size: one that may be zero is a substitute.

    Where the rest explains the recording, that effect has been omitted, see
    `remainder.without_unsure`; here it stands for what no effect explains. Not if other sets fit as
    well, which is a result of its own, nor for a naive model or a simulated motion. For a single
    effect see `chance`.
    """
    if not named or left.size == 1 or left.equal or left.naive or left.moved:
        return named, known
    strength: float | None = court.ask("strength")
    if strength is None or strength >= SIDES**2:
        return named, known
    court.rules("weak", left.names, strength, SIDES**2)
    return False, needs_nothing(left, court.policy)


def steady(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """A law has the same parameters in every part of a recording; a substitute does not.

    A substitute stands for a law that is not known, unless the model alone leaves only noise.
    Not for a naive model, whose laws are all approximate, nor for a simulated motion, which is
    fitted as a whole.
    """
    if not named or left.naive or left.moved:
        return named, known
    changes: Mapping[str, float] = court.ask("changes")
    part = max(changes, key=changes.__getitem__, default="")
    if not part or changes[part] <= court.policy.changed_numbers:
        return named, known
    court.rules("steady", left.names, changes[part], court.policy.changed_numbers, part)
    return False, needs_nothing(left, court.policy)


def curves(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """Three functions of the displacement that leave more than noise only fit the curve of one.

    The sum of three of them follows almost any function, so that little is left of a spring that is
    not in the catalogue. Not for a naive model, whose springs are all approximate.
    """
    noise = court.policy.excess_as_noise
    if not named or left.naive or left.curves < CURVES or left.quiet or left.after < noise:
        return named, known
    court.rules("curves", left.names, left.after, noise)
    return False, needs_nothing(left, court.policy)


def beside_nameless(
    what: Literal["varying", "stroke", "memory"], least_laws: int
) -> Callable[[_Court, Left, bool, bool], Turn]:
    """Return the rule by which a set is withdrawn if a law outside the catalogue explains more.

    For the same sets as `steady`, with a minimum number of laws. "varying": a coefficient that
    changes periodically with time; "stroke": one mass on a softening spring instead of a second
    mode, alone or together with another law; "memory": a fractional derivative instead of
    relaxation and its limits.
    """

    def rule(court: _Court, left: Left, named: bool, known: bool) -> Turn:
        if not named or left.naive or left.moved or left.laws < least_laws:
            return named, known
        gain: float = court.ask(what)
        if gain <= court.policy.same_evidence:
            return named, known
        court.rules(what, left.names, gain, court.policy.same_evidence)
        return False, needs_nothing(left, court.policy)

    return rule


def steps(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """If the model leaves only what rounding explains, no force law is missing.

    Not if this requires leaving its tolerances, nor if the set found stays closer.
    """
    rounded, policy = court.seen.rounding, court.policy
    if rounded is None or rounded.exact or not within(left.bent, policy):
        return named, known
    most = policy.rounded_rows
    if rounded.beyond <= most and left.names:
        if rounded.gain > policy.rounded_gain and left.after < policy.rounded_excess:
            return named, known
        most = policy.rounded_outside + policy.rounded_as_best * rounded.beyond_best
        if rounded.beyond >= most:
            return named, known
    if rounded.beyond > most:
        return named, known
    court.rules("steps", left.names, rounded.beyond, most)
    return False, True


TURNS: dict[str, Callable[[_Court, Left, bool, bool], Turn]] = {
    "blur": blur, "motion": motion, "reproduced": reproduced, "chance": chance,
    "leftover": leftover, "weak": weak, "steady": steady,
    "curves": curves, "varying": beside_nameless("varying", 0),
    "stroke": beside_nameless("stroke", 1), "memory": beside_nameless("memory", 1),
    "steps": steps,
}  # fmt: skip
"""Rules that withdraw the set of the force, or declare its residual explained, in order."""


def lost_in_form(seen: Seen, policy: Policy) -> bool:
    """Return whether, for a naive model, rounding explains less than an additional law must."""
    left, rounded = seen.force, seen.rounding
    if rounded is None or left is None or not left.naive or not left.names:
        return False
    return rounded.share < of_size(policy.needed_share, left.size + 1)


# ---- all rules ----------------------------------------------------------------------------------


def judge(seen: Seen, policy: Policy, less: Iterable[str] = ()) -> Verdict | Asked:
    """Return the verdict, or what must be known for it.

    Args:
        seen: what is known.
        policy: the thresholds.
        less: names of rules of `TURNS` to omit, to show the effect of each.
    """
    court, gone = _Court(seen, policy), set(less)
    try:
        return _judged(court, gone)
    except _UnknownAnswer as unknown:
        return unknown.asked


def _judged(court: _Court, gone: set[str]) -> Verdict:
    left, moved, rounding = court.seen.force, court.seen.actuator, court.seen.rounding
    known, named = True, False
    if left is not None:
        known = understood(left, court.policy, lambda: court.ask("sheet")) or court.ask("sheet")
        named = bool(left.names) and known
        for name, turn in TURNS.items():
            named, known = (named, known) if name in gone else turn(court, left, named, known)
    of_actuator = moved.names if moved is not None and moved.known else ()
    of_force = left.names if left is not None and named else ()
    extra = (rounding.name,) if rounding is not None else ()
    names, ledger = of_actuator + of_force + extra, tuple(court.ledger)
    if not known or (moved is not None and not moved.known):
        return Verdict("unknown", (), (), named, bool(of_actuator), bool(extra), ledger)
    sets: list[Names] = []
    if left is not None and named and left.equal:
        sets += [of_actuator + n + extra for n in (left.names, *left.equal)]
    if moved is not None and of_actuator and moved.equal:
        sets += [n + of_force + extra for n in (moved.names, *moved.equal)]
    unique = tuple(dict.fromkeys(tuple(sorted(s)) for s in sets))
    said: Said = "ambiguous" if unique else "explained" if names else "none"
    return Verdict(said, names, unique, named, bool(of_actuator), bool(extra), ledger)


# ---- sets within rounding -----------------------------------------------------------------------


@dataclass(frozen=True)
class Coarse:
    """A set that was considered for a load cell with coarse resolution.

    Attributes:
        names: names of its effects.
        count, chi2: its number of parameters and its residual.
        beyond: fraction of rows with a residual beyond rounding and noise.
    """

    names: Names
    count: int
    chi2: float
    beyond: float


def within_rounding(
    sets: tuple[Coarse, ...], equal: tuple[Names, ...], policy: Policy
) -> tuple[Names, tuple[Names, ...]]:
    """Return the set that stays within rounding if the best one does not, and its equals.

    Least squares takes rounding for noise, and its colour for a law; the right law is never off by
    more than half a step.

    Args:
        sets: sets that were considered, the best first.
        equal: names of those that fit as well as the best.
        policy: the thresholds.
    """
    best = sets[0]
    among = [s for s in sets if s.names in equal]
    inside = [s for s in sets if s.beyond < policy.rounded_better * best.beyond]
    if best.beyond > policy.rounded_outside and inside:
        best = inside[0]
        among = [
            s
            for s in inside[1:]
            if s.count <= best.count and s.chi2 - best.chi2 < policy.same_evidence
        ]

    def enough(one: Coarse) -> bool:
        return one.beyond < policy.rounded_outside + policy.rounded_alike * best.beyond

    # Nor is another law confirmed by absorbing part of the rounding.
    parts = [s for s in sets if s.names and set(s.names) < set(best.names) and enough(s)]
    if parts:
        return min(parts, key=lambda s: (len(s.names), s.chi2)).names, ()
    return best.names, tuple(s.names for s in among if enough(s))
