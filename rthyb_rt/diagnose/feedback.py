"""Evidence in a closed loop: by the motion that the test makes, and not its load cell's noise.

What the load cell of a hybrid test reads, noise and all, moves the specimen a delay later. Above
the band of the ground motion that noise is all that moves it, so force and motion agree there
whatever the specimen is: a law can have the noise back out of the motion that it made, by an
inverse of the loop. Regressors must not know the noise (Söderström and Stoica, Instrumental
Variable Methods for System Identification, 1983). Two are without it: the force of a law along the
motion within its band, harmonics and all, and its force along the whole motion, judged in that
band alone. The first lacks the top of a wide band, the second a single sine's harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rthyb_rt.core.diagnosis_models import Motion
from rthyb_rt.diagnose import noise
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.estimate import low_passed
from rthyb_rt.diagnose.select import Fit, Member, Problem, columns_of, solve


def returns(case: Case) -> bool:
    """Return whether what the load cell reads moves the specimen."""
    return case.model.family == "loop" and "f_meas" in case.channels


class Driven:
    """What laws earn by the motion that a test makes."""

    def __init__(self, problem: Problem, cut_hz: float) -> None:
        """Take in a problem and where the band of its motion ends."""
        ctx, fs_hz = problem.ctx, problem.case.fs_hz
        x, v, a = (low_passed(signal, fs_hz, cut_hz) for signal in (ctx.x, ctx.v, ctx.a))
        self.problem, self.below = problem, problem.below(cut_hz)
        self.slow = replace(ctx, motion=Motion(x, v, a), ranges=ctx.all_ranges)

    @classmethod
    def of(cls, problem: Problem) -> Driven | None:
        """Return that of a problem; None where the specimen stands still."""
        ends = noise.Lines(problem.estimate.rows, problem.case.fs_hz).band(problem.ctx.v)
        return None if ends is None or ends[1] <= 0.0 else cls(problem, ends[1])

    def gains(self, fit: Fit) -> tuple[float, ...]:
        """Return what each effect of a set earns beside the others, the better of both ways.

        As a fall of chi-squared; less than nothing where the set makes no physical law there.
        """
        whole, members = self.problem, fit.members
        along = [
            np.column_stack([whole.seen(c) for c in own]) for own in columns_of(self.slow, members)
        ]
        harmonics = _gains(whole, members, along)
        in_band = _gains(self.below, members, self.below.blocks(members))
        return tuple(np.maximum(harmonics, in_band).tolist())


def _gains(problem: Problem, members: Sequence[Member], blocks: list[Floats]) -> Floats:
    every = solve(problem, members, blocks)
    out = np.full(len(members), -np.inf)
    if every is None:
        return out
    for i in range(len(members)):
        rest = [*members[:i], *members[i + 1 :]]
        less = solve(problem, rest, [*blocks[:i], *blocks[i + 1 :]])
        out[i] = np.inf if less is None else less.chi2 - every.chi2
    return out
