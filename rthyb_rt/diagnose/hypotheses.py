"""What a decision between sets of effects is made from, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

from rthyb_rt.diagnose.effects import Effect

What = Literal[
    "part", "yielding", "beyond forms", "drift", "driven", "driven together", "driven more", "size",
    "own size", "left", "held out", "zero", "slow noise", "near noise",
    "line of others", "rounding",
]  # fmt: skip


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
        contained: laws with those that they are at certain values of their shape.
        settling: laws that act like a simpler law in motion slow enough, with that law.
        limits: laws that slow, or fast, motion cannot distinguish from other ones, with those.
        also: laws equivalent to another law in parallel with a free spring, with that law.
        sliders: sliders in series, any number of which is a form of the same effect.
        wanders, zeros: zeros of the load cell that change with time, and constant ones.
        lines: effects with a single frequency of their own.
        stiffness: effects that change the model's stiffness.
    """

    plainer: Mapping[str, str]
    contained: Mapping[str, frozenset[str]]
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
            {n: frozenset(e.contains) for n, e in laws},
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
            lines next to that of the effect; "line of others", the force of model and other laws at
            its frequency, as a fraction of their largest line; "rounding", how improbable the
            readings of a coarse load cell are with it, each as an interval (-2 ln).
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


Sets = list[Hypothesis]
