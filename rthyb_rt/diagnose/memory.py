"""Whether a force with fractional memory explains more than relaxation and its limits.

Relaxation has one time. The rubber of a bearing and the polymer of a damper have a spectrum of
them: their force is a fractional derivative of the displacement, whose order lies between that of a
spring and that of a dashpot (Koeller, J. Appl. Mech. 51 (1984) 299; Makris and Constantinou,
J. Struct. Eng. 117 (1991) 2708). Over one or two decades of frequency, relaxation together with a
spring or a dashpot imitates it. Such a set is therefore compared with the derivative in their
place. It has no name; if it explains more, relative to its price, the set is not the answer.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import fftconvolve
from scipy.special import gamma

from rthyb_rt.diagnose import fitted
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.effects.base import Context, Effect, Trial
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.diagnose.refinement import solve
from rthyb_rt.diagnose.steady import standing

ORDERS = np.linspace(0.05, 0.95, 10)
"""Orders of the derivative that are tried first; 0 is a spring, 1 a dashpot."""
CLOSE = 1e-3
"""Accuracy of the order."""
MARGIN = 1.0
"""By how much chi-squared may be larger: one standard deviation of one parameter."""


class _Spectrum(Effect):
    """A force with fractional memory; its shape is the order of the derivative."""

    name = "memory"
    signs = "+"

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient; the order is the other parameter."""
        return ("+", (None,)), 2

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the derivative of the displacement."""
        return [derivative(ctx.x, ctx.dt, trial.theta[0])]


SPECTRUM = _Spectrum()


def gain(problem: ResidualProblem, fit: Fit) -> float:
    """Return the additional gain of such a force over relaxation and its limits, in chi-squared.

    Including the prices of both, and divided by the inflation due to correlated rows; minus
    infinity if a set has no relaxation, or no slopes, or if it fits better with more parameters:
    weak laws are not given up for their price alone.
    """
    kept = _others(fit)
    if len(kept) == len(fit.members) or (own := standing(problem, fit)) is None:
        return -np.inf
    rival = _least(problem, kept)
    if rival is None or rival.chi2 > fit.chi2 + MARGIN:
        return -np.inf
    return (own[0] - rival.chi2 - fitted.cost(problem, rival)) / own[1]


def _others(fit: Fit) -> tuple[Member, ...]:
    """Return a set without relaxation and the laws that are its limits in slow and fast motion."""
    relaxing = [m.effect for m in fit.members if m.effect.relaxes and not m.effect.late]
    limits = {name for e in relaxing for name in (e.name, e.slow_as, e.fast_as)}
    return tuple(m for m in fit.members if m.name not in limits or m.effect.late)


def derivative(x: Floats, dt_s: float, order: float) -> Floats:
    """Return the fractional derivative of a displacement that was constant before, (n,).

    Caputo's, for a straight line between rows (Oldham and Spanier, The Fractional Calculus, 1974,
    eq. 8.2.6).
    """
    steps = np.arange(x.size + 1.0) ** (1.0 - order)
    moved = np.diff(x, prepend=x[0])
    force = fftconvolve(moved, np.diff(steps))[: x.size]
    return np.asarray(force * dt_s**-order / gamma(2.0 - order))


def _least(problem: ResidualProblem, beside: tuple[Member, ...]) -> Fit | None:
    """Return the derivative of the best order beside some effects; None if none is physical."""

    def of(order: float) -> Fit | None:
        members = (*beside, Member(SPECTRUM, Trial((order,))))
        return solve(problem, members, problem.blocks(members))

    def misfit(order: float) -> float:
        found = of(order)
        return np.inf if found is None else found.chi2

    coarse = [misfit(float(order)) for order in ORDERS]
    at = int(np.clip(np.argmin(coarse), 1, len(ORDERS) - 2))
    near = minimize_scalar(misfit, bounds=ORDERS[[at - 1, at + 1]], options={"xatol": CLOSE})
    orders = [float(near.x), *map(float, ORDERS)]
    return of(orders[int(np.argmin([float(near.fun), *coarse]))])
