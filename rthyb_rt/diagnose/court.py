"""The court: the evidence, what it still needs, and the ledger of what each rule did."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rthyb_rt.diagnose.hypotheses import Evidence, Hypothesis, Need, What
from rthyb_rt.diagnose.policy import Policy, of_size


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


class UnknownNeed(Exception):
    """Raised by a rule that needs evidence which has not been gathered."""

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
        self.by_names: dict[tuple[str, ...], Hypothesis] = {}
        for h in (*evidence.sets, *evidence.beside):
            if h.names not in self.by_names or h.score < self.by_names[h.names].score:
                self.by_names[h.names] = h
        self.ledger: list[Ruling] = []

    def ask(self, what: What, of: Hypothesis, which: tuple[int, ...] = ()) -> Any:
        """Return evidence that is gathered on demand."""
        need = Need(what, of, which)
        if need not in self.evidence.known:
            raise UnknownNeed(need)
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
