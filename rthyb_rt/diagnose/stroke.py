"""Whether a mass whose own spring changes with its stroke explains more than a set with one.

A second mode is a mass on a linear spring. Liquid sloshing in a tank and a pendulum soften with
their stroke, a mass on a membrane hardens: the frequency changes with the amplitude (Duffing;
Nayfeh and Mook, Nonlinear Oscillations, 1979, ch. 4). If such a mass is assumed to be linear, a
second law absorbs the difference: a hum at the same frequency, a play, a further damper. A set of
several laws that includes such a mass is therefore compared with this mass alone, with a cubic
spring fitted. The latter has no name; if it explains more, the set is not the answer. Where a mass
alone was found, a change of its spring always explains a little more; that is an error in the form
of the law, unless it is more than such an error may be and leaves nothing but noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rthyb_rt.diagnose import fitted
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, penalty
from rthyb_rt.diagnose.refinement import priors_of, solve
from rthyb_rt.diagnose.steady import left, standing

BEGUN = [
    (-slope * change, change)
    for change in (-0.1, -0.06, -0.03, -0.01, 0.01, 0.03, 0.06, 0.1)
    for slope in (0.75, 1.5, 2.25)
]
"""Initial logarithms of the frequency's factor, and initial changes of the spring.

A steady oscillation of the amplitude A has the frequency f (1 + 3/8 change A^2), with A^2 in units
of the mean square of the stroke (Duffing; Nayfeh and Mook): by 3/4 of the change at a steady
amplitude, and more where the stroke is large for a part of the recording only. A frequency and a
change of opposite effect fit almost equally well: they form a narrow valley.
"""
BEST = 3
"""Initial points, best first, from which the fit descends."""
STEPS = 12
STEP = np.array([1e-4, 1e-2, 1e-4])
REACH = np.array([0.03, 0.5, 0.03])
"""Steps of the slopes, and largest steps: logarithms of frequency and damping, change of spring."""
LARGEST = 1e100
"""Force per kg beyond which a mass has run away: its squares are still finite."""
TRIED = 4
"""Largest number of times that a step is shortened."""

Misfit = Callable[[Floats], tuple[float, Floats] | None]
"""Chi-squared and residual for logarithms of frequency and damping, and a change; or divergence."""


def gain(problem: ResidualProblem, fit: Fit) -> float:
    """Return the additional gain of such a mass over a set with a linear one, in chi-squared.

    Including prices, and divided by the inflation due to correlated rows; minus infinity if the set
    has no such mass or no slopes, or if it is a mass alone whose residual is noise or due to the
    form of its law.
    """
    own = standing(problem, fit)
    if own is None:
        return -np.inf
    rivals = [_least(problem, m) for m in fit.members if not m.effect.late]
    rival = min((r for r in rivals if r is not None), default=np.inf)
    if len(fit.members) == 1:
        if not (_ends_at_noise(problem, rival, fit.chi2) and _no_form(problem, rival, fit.chi2)):
            return -np.inf
        # Neighbours of its law in the motion of the specimen are no part of its own stroke.
        own = fit.chi2 + fitted.cost(problem, fit), own[1]
    # Mass, frequency, damping, and the change of the spring.
    return (own[0] - rival - penalty(problem.ln_n, 4)) / own[1]


def _ends_at_noise(problem: ResidualProblem, one: float, other: float) -> bool:
    """Return whether a chi-squared reaches the noise, relative to what another one leaves.

    With the noise as it is in evidence that was scaled down. The chi-squared of noise alone
    scatters by ``sqrt(2 n)``: one that is no farther away has reached the noise. The other one may
    be within its scatter, which is that of the same noise: their difference hardly scatters.
    """
    rows = problem.y.size * problem.estimate.share
    noise, chance = rows / problem.loudness**2, float(np.sqrt(2.0 / rows))
    return one - noise < max(POLICY.noise_reached * (other - noise), chance * noise)


def _no_form(problem: ResidualProblem, one: float, other: float) -> bool:
    """Return whether two chi-squared differ by more than the form of a law may explain."""
    null = solve(problem, [], [])
    return null is not None and other - one > POLICY.form_alone * (null.chi2 - other)


def _least(problem: ResidualProblem, member: Member) -> float | None:
    """Return the least chi-squared of a mass alone; None if it is not physical."""
    prior = priors_of(problem, (), 1, 1 + problem.base.shape[1])

    def misfit(at: Floats) -> tuple[float, Floats] | None:
        f, zeta = (
            float(t * np.exp(q)) for t, q in zip(member.trial.theta[:2], at[:2], strict=True)
        )
        trial = Trial((f, zeta), member.trial.variant)
        column = member.effect.by_stroke(problem.ctx, trial, float(at[2]), member.trial)
        if column is None or not float(np.max(np.abs(column))) < LARGEST:
            return None
        return left(np.column_stack([problem.seen(column), problem.base]), prior, problem.y)

    if len(member.trial.theta) < 2 or (first := misfit(np.zeros(3))) is None:
        return None
    begun = [(np.zeros(3), first)]
    for f, change in BEGUN:
        at = np.array([f, 0.0, change])
        if (found := misfit(at)) is not None:
            begun.append((at, found))
    begun.sort(key=lambda b: b[1][0])
    return min(_descended(misfit, *b) for b in begun[:BEST])


def _descended(misfit: Misfit, at: Floats, found: tuple[float, Floats]) -> float:
    """Return the chi-squared after a damped Gauss-Newton descent from a point."""
    best, rest = found
    for _ in range(STEPS):
        sides = [misfit(at + e) for e in np.diag(STEP)]
        if any(s is None for s in sides):
            break
        slopes = [(s[1] - rest) / e for s, e in zip(sides, STEP, strict=True) if s is not None]
        step = np.linalg.lstsq(np.column_stack(slopes), -rest, rcond=None)[0]
        # Shortened as a whole: along the valley, or not at all.
        step /= max(1.0, float(np.max(np.abs(step) / REACH)))
        tried = ((at + step * 0.4**k, misfit(at + step * 0.4**k)) for k in range(TRIED))
        better = next(((q, found) for q, found in tried if found and found[0] < best), None)
        if better is None:
            break
        at, (best, rest) = better
    return best
