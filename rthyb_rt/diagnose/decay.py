"""Free decays of a naive model: the remaining energy shows the damping, and nothing else.

No force acts, so nearly all of the force is the spring's. The laws of damping are a thousandth of
it and yet determine how the motion decays: they are compared with one another, not with the misfit
of the spring.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from itertools import combinations

import numpy as np

from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.dictionary import Dictionary
from rthyb_rt.diagnose.freebody import Body, Loose
from rthyb_rt.diagnose.predict import Augmented
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, compatible
from rthyb_rt.diagnose.refinement import solve

MOST = 6
"""Number of pairs of damping laws refined with the spring, and of sets simulated first."""
HARDLY = 1e-3
"""Relative size of a negligible dashpot in the model; a parameter must not be zero."""


def judged(case: Case) -> bool:
    """Return whether a recording is a free decay of a naive model: its motion is conclusive."""
    model, push = case.model, case.channels.get("f_in")
    free = model.family == "forced" and model.k_tol is None and model.k != 0.0
    return free and push is not None and not np.nan_to_num(push).any()


class Swing(Body):
    """A freely decaying body: its initial state is fitted, and so is the reading at rest.

    The zero of a sensor and a constant force are equivalent there, and are no finding.
    """

    linear = False
    largest = 3

    def _loose(self) -> Loose:
        return (("x", 0.4, np.inf), ("v", 0.4, np.inf), ("zero", 0.4, np.inf))

    def first(self, ranked: Sequence[Fit]) -> list[Fit]:
        """Return the sets of springs and damping only, which explain most decays."""
        plain = [f for f in ranked if len(f.names) <= self.largest and self.plain(f.members)]
        return plain[:MOST]

    def plain(self, members: Sequence[Member]) -> bool:
        """Return whether a set has elastic springs and damping only."""
        return all(m.effect.elastic or m.effect.dissipates for m in members)

    def refined(self, problem: ResidualProblem, fit: Fit) -> Fit | None:
        """Fit a set to the motion as `Body` does, starting with a dashpot that does not push.

        In the balance, laws of damping compensate for one another, even with a negative dashpot. A
        motion started there would grow: the other laws are solved again without it.
        """
        numbers = [n.number for n in problem.nuisances]
        c = self.case.model.c
        at = numbers.index("c") if "c" in numbers else -1
        if at < 0 or fit.scatter is not None or c + float(fit.nuisance[at]) > 0.0:
            return super().refined(problem, fit)
        held = copy(problem)
        held.nuisances = [n for n in problem.nuisances if n.number != "c"]
        held.base = np.delete(problem.base, at, axis=1)
        held.y = problem.y + c * problem.base[:, at]
        begun = solve(held, fit.members, held.blocks(fit.members))
        if begun is None:
            return None
        begun.nuisance = np.insert(begun.nuisance, at, -(1.0 - HARDLY) * c)
        return super().refined(problem, begun)

    def differences(self, now: Augmented, loose: Floats, at: tuple[float, float]) -> Floats:
        """Return recording less simulation in units of the noise, one for each of the rows."""
        push, mass = self._push(1.0)
        motion = now.moved_by(push, mass, self.case.t, self.other, self._begun(at, loose))
        x = motion.x + loose[2] * self.spread
        return np.asarray((x - self.x)[self.rows] / self.sigma)


def conservative(fit: Fit) -> tuple[Member, ...]:
    """Return the members of a set that do not dissipate energy."""
    return tuple(m for m in fit.members if not m.effect.dissipates)


def explained(
    problem: ResidualProblem, known: Callable[[Sequence[Member]], Fit | None], fit: Fit,
    member: Member, null: Fit,
) -> float:  # fmt: skip
    """Return the misfit explained by a set, of the kind that one of its effects can explain.

    Args:
        problem: the recording.
        known: refines a set, or returns None if it is not a physical law.
        fit: the set.
        member: the effect of it.
        null: nuisance parameters only.

    Returns:
        Reduction of chi-squared; for damping in a free decay, that of all damping laws in the set,
        else that of the whole set.
    """
    whole = null.chi2 - fit.chi2
    if not (problem.decays and problem.case.model.k_tol is None and member.effect.dissipates):
        return whole
    spring = conservative(fit)
    without = known(spring) if spring else null
    return whole if without is None else without.chi2 - fit.chi2


def damped_twice(dictionary: Dictionary, begun: Fit) -> list[tuple[Member, ...]]:
    """Return a set's spring with each of the most promising pairs of damping laws.

    Over one range of amplitudes, constant friction together with drag that vanishes with the motion
    looks like a single dashpot: neither is worth much without the other.
    """
    spring = conservative(begun)
    groups = dictionary.groups
    laws = [g for g, group in enumerate(groups) if group.member.effect.dissipates]
    pairs = [
        pair for pair in combinations(laws, 2)
        if groups[pair[0]].member.name != groups[pair[1]].member.name
    ]  # fmt: skip
    found = dictionary.sets(pairs, dictionary.beside(begun))
    sets = [(*spring, *(groups[g].member for g in pair)) for pair in dictionary.best(found, MOST)]
    return [members for members in sets if compatible(members)]
