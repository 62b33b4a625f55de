"""What is said of a recording: rules over what the named set, and the model alone, leave of it.

As in `decide` the rules see no recording. What costs a simulation is asked for only where it turns
the answer, and each rule that turned it stands in the ledger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from rthyb_rt.diagnose.decide import Ruling
from rthyb_rt.diagnose.policy import Policy, of_size

Said = Literal["none", "explained", "ambiguous", "unknown"]
Names = tuple[str, ...]
Asked = Literal["sheet", "simulated", "strength", "changes", "varying", "stroke"]


# ---- evidence -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Left:
    """What the best set, and the model alone, leave of the force.

    Attributes:
        names: of the best set; none: nothing was found.
        equal: of others that fit as well.
        laws: of the best set; a joint law of several effects is one.
        before, after: misfit of the model alone and of the set, beyond noise, in noise power.
        scale: by how much evidence was scaled down.
        part_before, part_after: the same misfits, rms, as parts of the force.
        bent, bent_after: how far model and set move a stated number, in standard deviations.
        stated: effects that only move a stated number.
        price: what the set has to earn, in chi-squared.
        naive: whether the model states no tolerance of its stiffness.
        exact: whether the motion is known without the noise of an estimate.
        coloured: whether noise has a colour that was read off the recording.
        moved: whether it is the motion that was judged, simulated with each set.
        quiet: whether what a simulated motion leaves is within the displacement's data sheet.
        late: whether a law of the set begins in mid-record.
        cell: whether a load cell tells the force.
        loud: whether the model alone leaves more of it than its data sheet allows for noise.
    """

    names: Names = ()
    equal: tuple[Names, ...] = ()
    laws: int = 0
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

    @property
    def size(self) -> int:
        """Effects of the best set."""
        return len(self.names)

    def coloured_noise(self, policy: Policy) -> bool:
        """Return whether the best set leaves what may be noise of a colour read off it."""
        return self.coloured and self.after < policy.excess_as_noise


@dataclass(frozen=True)
class Moved:
    """What was found of the actuator.

    Attributes:
        names, equal: of the best set and of others that fit as well.
        known: whether it leaves no more than noise, or the form of a law.
    """

    names: Names = ()
    equal: tuple[Names, ...] = ()
    known: bool = True


@dataclass(frozen=True)
class Rounded:
    """A coarse load cell, and what its steps explain.

    Attributes:
        name: in the answer.
        share: of what the model alone leaves, the power that rounding explains.
        gain: what the best set brings beyond its price, in chi-squared.
        beyond: rows that the model alone leaves by more than rounding and noise can, as a part.
        beyond_best: the same of the best set.
    """

    name: str
    share: float = 1.0
    gain: float = 0.0
    beyond: float = 0.0
    beyond_best: float = 0.0


@dataclass(frozen=True)
class Simulated:
    """A free body's motion by the model alone, its numbers fitted within reason.

    Attributes:
        k_off, c_off: how far they had to be moved, in standard deviations.
        nrmse: of the displacement.
        noise: that of its sensor, in the same.
    """

    k_off: float
    c_off: float
    nrmse: float
    noise: float


@dataclass(frozen=True)
class Seen:
    """All that is known when it is said what is missing.

    Attributes:
        known: answers to what was asked: "sheet", whether what the set leaves is within the load
            cell's data sheet; "simulated", None where the motion does not decide; "strength", the
            set's one effect over the standard deviation of its interval, squared; None where it
            has no size; "changes", how far beyond chance the set's numbers are others in a part
            of the recording, by that part in words, in standard deviations; "varying", what a
            coefficient that changes periodically with time explains more, in chi-squared; "stroke",
            the same of a mass whose own spring changes with its stroke.
    """

    force: Left | None = None
    actuator: Moved | None = None
    rounding: Rounded | None = None
    known: Mapping[Asked, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """What is said.

    Attributes:
        names: effects, the actuator's first.
        sets: of an ambiguous verdict, all that fit alike.
        force, actuator: whether the best set of the channel is named.
        rounding: whether rounding is.
        ledger: rules that turned the answer.
    """

    said: Said
    names: Names = ()
    sets: tuple[Names, ...] = ()
    force: bool = False
    actuator: bool = False
    rounding: bool = False
    ledger: tuple[Ruling, ...] = ()


class _Unknown(Exception):
    def __init__(self, asked: Asked) -> None:
        self.asked = asked


class _Court:
    def __init__(self, seen: Seen, policy: Policy) -> None:
        self.seen, self.policy = seen, policy
        self.ledger: list[Ruling] = []

    def ask(self, what: Asked) -> Any:
        if what not in self.seen.known:
            raise _Unknown(what)
        return self.seen.known[what]

    def rules(self, rule: str, names: Names, found: float, wanted: float, part: str = "") -> None:
        """Write down a rule that has turned the answer, and the part of the data that it read."""
        self.ledger.append(Ruling(rule, names, part, found, wanted))


# ---- whether what is left is known to be nothing more -------------------------------------------


def small(left: Left, part: float, policy: Policy) -> bool:
    """Return whether a misfit is within what an estimated motion can tell of the force."""
    return not left.exact and part < blur_of(left, policy)


def blur_of(left: Left, policy: Policy) -> float:
    """Return what an estimated motion may leave of the force."""
    return policy.blur_cell if left.cell else policy.blur_free


def within(bent: float, policy: Policy) -> bool:
    """Return whether a fit stays within the stated tolerances."""
    return bent < policy.within_tolerance


def allowed(left: Left, policy: Policy) -> float:
    """Return which part of the misfit a set may leave as the form of its laws."""
    if left.moved:
        return of_size(policy.left_moved, left.size)
    # A moment at which a law begins can be moved to meet much: what is left then is no blur.
    blurred = 1.0 if left.exact or left.late else policy.estimated_motion
    return blurred * of_form(left.naive, left.size, policy)


def of_form(naive: bool, size: int, policy: Policy) -> float:
    """Return the part of a misfit that the forms of so many laws may leave."""
    return policy.left_naive if naive else of_size(policy.left_stated, size)


def understood(left: Left, policy: Policy, sheet: Callable[[], bool]) -> bool:
    """Return whether what was found leaves no more than the form of a law.

    Args:
        left: what it leaves.
        policy: the thresholds.
        sheet: tells whether that is within the load cell's data sheet.
    """
    at_noise = left.after < policy.excess_as_noise
    share = left.after / max(left.before, 1e-12)
    if left.moved and (left.quiet or at_noise):
        # What is moved as it was measured, by what is named or by nothing, has the force for it.
        return True
    if left.moved and left.names:
        return share < allowed(left, policy)
    if left.coloured and sheet():
        return True
    if not left.names:
        # Small colour that no law earns its price for is not a finding.
        nothing = left.before < policy.excess_as_noise + policy.excess_of_nothing
        blurred = small(left, left.part_before, policy) and within(left.bent, policy)
        return not left.coloured and (nothing or left.naive or blurred)
    above = left.scale < policy.colourless and left.after < policy.colourless_excess
    if left.coloured_noise(policy):
        # Noise that takes any colour has taken up what stays within the sheet, and that alone.
        return False
    if (at_noise or above) and not left.coloured:
        # At the noise, or above it without colour: the data sheet's figure is low. Noise that takes
        # any colour to fit is to be as large as the sheet says, and no event.
        return True
    return small(left, left.part_after, policy) or share < allowed(left, policy)


def simulates(made: Simulated | None, policy: Policy) -> bool:
    """Return whether the model alone, its parameters adjusted within tolerance, simulates it.

    Without a load cell this decides: a force that the displacement does not show is the smoother's.
    """
    if made is None or max(made.k_off, made.c_off) > policy.within_tolerance:
        return False
    unseen = made.nrmse**2 - made.noise**2
    return made.nrmse < policy.simulated_nrmse and unseen < policy.simulated_unseen**2


# ---- rules that take the force's set back -------------------------------------------------------

Turn = tuple[bool, bool]
"""Whether the set is named, and whether what the force leaves is known."""


def blur(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """Where the model alone is within what an estimated motion tells, only its numbers count."""
    if left.moved or not small(left, left.part_before, court.policy):
        return named, known
    if named and within(left.bent, court.policy) and not set(left.names) <= left.stated:
        court.rules("blur", left.names, left.part_before, blur_of(left, court.policy))
        return False, known
    return named, known


def motion(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """Where the model alone simulates the motion of a free body, nothing is missing."""
    if left.moved or not (named or not known):
        return named, known
    made: Simulated | None = court.ask("simulated")
    if made is None or not simulates(made, court.policy):
        return named, known
    court.rules("motion", left.names, made.nrmse, court.policy.simulated_nrmse)
    return False, True


def chance(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """One effect beside nothing but noise is no finding where noise of such a colour may do it.

    Where the noise has a colour that was read off the recording itself, evidence counted row by row
    is worth what that colour is known by. The effect's interval knows of more, how the parts of the
    recording scatter among it: by that, too, the effect has to earn its price. Not where without it
    the noise would have to be larger than the data sheet allows.
    """
    noise = left.before < court.policy.excess_as_noise and left.coloured and not left.loud
    if not named or not noise or left.laws != 1 or left.moved:
        return named, known
    strength: float | None = court.ask("strength")
    if strength is None or strength >= left.price:
        return named, known
    court.rules("chance", left.names, strength, left.price)
    return False, known


def steady(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """A law has the same numbers in every part of a recording; one that stands in for it has not.

    Not beside a naive model, whose laws are all of some other form, nor of a simulated motion,
    which is fitted as a whole.
    """
    if not named or left.naive or left.moved:
        return named, known
    changes: Mapping[str, float] = court.ask("changes")
    part = max(changes, key=changes.__getitem__, default="")
    if not part or changes[part] <= court.policy.changed_numbers:
        return named, known
    court.rules("steady", left.names, changes[part], court.policy.changed_numbers, part)
    return False, False


def beside_nameless(
    what: Literal["varying", "stroke"], least_laws: int
) -> Callable[[_Court, Left, bool, bool], Turn]:
    """Return the rule that a set is not named where a law in no catalogue explains more.

    Of the same sets as `steady`, with at least so many laws. "varying": a coefficient that changes
    periodically with time; "stroke": one mass on a spring that softens, in place of a second mode
    beside another law.
    """

    def rule(court: _Court, left: Left, named: bool, known: bool) -> Turn:
        if not named or left.naive or left.moved or left.laws < least_laws:
            return named, known
        gain: float = court.ask(what)
        if gain <= court.policy.same_evidence:
            return named, known
        court.rules(what, left.names, gain, court.policy.same_evidence)
        return False, False

    return rule


def steps(court: _Court, left: Left, named: bool, known: bool) -> Turn:
    """Where all that the model leaves is what rounding leaves, no force law is missing.

    Not where it has to leave its tolerances for that, nor where what was found stays within closer.
    """
    rounded, policy = court.seen.rounding, court.policy
    if rounded is None or not within(left.bent, policy):
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
    "blur": blur, "motion": motion, "chance": chance, "steady": steady,
    "varying": beside_nameless("varying", 0), "stroke": beside_nameless("stroke", 2),
    "steps": steps,
}  # fmt: skip
"""Rules that take the set of the force back, or say that what it leaves is known, in turn."""


def lost_in_form(seen: Seen, policy: Policy) -> bool:
    """Return whether beside a naive model rounding explains less than a further law has to."""
    left, rounded = seen.force, seen.rounding
    if rounded is None or left is None or not left.naive or not left.names:
        return False
    return rounded.share < of_size(policy.needed_share, left.size + 1)


# ---- all of them --------------------------------------------------------------------------------


def judge(seen: Seen, policy: Policy, less: Iterable[str] = ()) -> Verdict | Asked:
    """Return what is said, or what has to be known for that.

    Args:
        seen: what is known.
        policy: the thresholds.
        less: rules of `TURNS` that are left out: to see what each is there for.
    """
    court, gone = _Court(seen, policy), set(less)
    try:
        return _judged(court, gone)
    except _Unknown as unknown:
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


# ---- sets of which one stays within rounding ----------------------------------------------------


@dataclass(frozen=True)
class Coarse:
    """A set that was weighed, beside a load cell with coarse resolution.

    Attributes:
        names: of its effects.
        count, chi2: its parameters and what it leaves.
        beyond: rows that it leaves by more than rounding and noise can, as a part.
    """

    names: Names
    count: int
    chi2: float
    beyond: float


def within_rounding(
    sets: tuple[Coarse, ...], equal: tuple[Names, ...], policy: Policy
) -> tuple[Names, tuple[Names, ...]]:
    """Return the set that stays within rounding, where the best one does not, and its equals.

    Least squares takes rounding for noise, and its colour for a law; a right law is never off by
    more than half a step.

    Args:
        sets: those that were weighed, the best first.
        equal: names of those that fit as well as that.
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

    # Nor does what one more law takes up of the rounding make it a law.
    parts = [s for s in sets if s.names and set(s.names) < set(best.names) and enough(s)]
    if parts:
        return min(parts, key=lambda s: (len(s.names), s.chi2)).names, ()
    return best.names, tuple(s.names for s in among if enough(s))
