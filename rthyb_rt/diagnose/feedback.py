"""Evidence from the motion that a test imposes, where noise is in force and motion alike.

In a hybrid test, the reading of the load cell, including noise, moves the specimen a delay later.
Above the band of the ground motion only this noise moves the specimen, so force and motion are
consistent there whatever the specimen is: by inverting the loop, a law can recover the noise from
the resulting motion. A body without a load cell is another such case: its force comes from its
estimated acceleration, so that above the band the noise of the displacement is both the force and
the motion, and a law can subtract it. Regressors must not be correlated with the noise (Söderström
and Stoica, Instrumental Variable Methods for System Identification, 1983). Two satisfy this: the
force of a law along the motion within its band, including harmonics, and its force along the whole
motion, evaluated in that band only. The first lacks the top of a wide band, the second the
harmonics of a single sine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import noise
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, columns_of
from rthyb_rt.diagnose.refinement import solve
from rthyb_rt.diagnose.spectral import low_passed


def returns(case: Case) -> bool:
    """Return whether the load cell's reading moves the specimen."""
    return case.model.family == "loop" and "f_meas" in case.channels


def inferred(case: Case) -> bool:
    """Return whether a body's force is inferred from its motion, without a load cell."""
    return case.model.family in ("ground", "forced") and "f_meas" not in case.channels


SETTLED = 2.0
"""Periods of the cut-off frequency within which the filter is affected by the ends of a recording:
the slowest of its poles decays to one per cent in them."""


class Driven:
    """What laws earn by the motion that a test imposes."""

    def __init__(self, problem: ResidualProblem, cut_hz: float) -> None:
        """Store a problem and the upper end of its motion's band."""
        ctx, fs_hz = problem.ctx, problem.case.fs_hz
        x, v, a = (low_passed(signal, fs_hz, cut_hz) for signal in (ctx.x, ctx.v, ctx.a))
        inner = problem.within(SETTLED / cut_hz)
        self.problems = [problem] if inner is problem else [problem, inner]
        self.below = [one.below(cut_hz) for one in self.problems]
        self.slow = replace(ctx, motion=ComputedMotion(x, v, a), ranges=ctx.all_ranges)

    @classmethod
    def of(cls, problem: ResidualProblem) -> Driven | None:
        """Return the instance for a problem; None if the specimen does not move."""
        ends = noise.Lines(problem.estimate.rows, problem.case.fs_hz).band(problem.ctx.v)
        return None if ends is None or ends[1] <= 0.0 else cls(problem, ends[1])

    def gains(self, fit: Fit) -> tuple[float, ...]:
        """Return what each effect of a set earns beside the others, the best of all ways.

        As a reduction of chi-squared; negative if the set is not a physical law there.
        """
        ways = self._ways(fit.members)
        return tuple(_gain(ways, fit.members, (i,)) for i in range(len(fit.members)))

    def together(self, fit: Fit, which: Sequence[int]) -> float:
        """Return what several effects of a set earn together beside the rest of it, likewise."""
        return _gain(self._ways(fit.members), fit.members, which)

    def more(self, members: Sequence[Member], than: Sequence[Member]) -> float:
        """Return what a set earns beyond another one, in the shapes of both, likewise."""
        chi2 = {one: value for one, _, value in self._ways(than)}
        return float(
            max((chi2.get(one, np.inf) - v for one, _, v in self._ways(members)), default=-np.inf)
        )

    def _ways(self, members: Sequence[Member]) -> list[_Way]:
        """Return the problems in which a set is a physical law.

        Both, and again without the ends of the recording that disturb the filter: a law that acts
        there only earns nothing without them.
        """
        ways: list[tuple[ResidualProblem, list[Floats]]] = []
        slow = columns_of(self.slow, members)
        for one, below in zip(self.problems, self.below, strict=True):
            along = [np.column_stack([one.seen(c) for c in own]) for own in slow]
            ways += [(one, along), (below, below.blocks(members))]
        solved = [(one, blocks, solve(one, members, blocks)) for one, blocks in ways]
        return [(one, blocks, whole.chi2) for one, blocks, whole in solved if whole is not None]


_Way = tuple[ResidualProblem, list[Floats], float]
"""A problem, the columns of every effect of a set, each (rows, columns), and its chi-squared."""


def _gain(ways: Sequence[_Way], members: Sequence[Member], which: Sequence[int]) -> float:
    rest, found = [i for i in range(len(members)) if i not in which], [-np.inf]
    for problem, blocks, whole in ways:
        less = solve(problem, [members[i] for i in rest], [blocks[i] for i in rest])
        found.append(np.inf if less is None else less.chi2 - whole)
    return float(max(found))
