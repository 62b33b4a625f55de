"""Chains of sliders: parallel springs that yield in turn, as a force and as elements of the core.

A chain is described by the displacements at which its springs yield, (n,), m, in rising order. All
springs have the same stiffness (Iwan, J. Appl. Mech. 33, 1966).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import iwan

Floats = NDArray[Any]

SPRINGS, FINE = core.IWAN_SLIDERS, 32
"""Springs of the core's element, and of a distribution that it does not have."""
GROUPS = 6
"""Elements that stand for a distribution that the core does not have: with a group's mean and
standard deviation each, the force of an exponential one is .6 % off (4 elements: 1.3 %)."""


def even(yield_m: float, spread: float) -> Floats:
    """Return yields from ``1 - spread`` to ``1 + spread`` times ``yield_m``; a spread of 0: one."""
    if spread == 0.0:
        return np.array([yield_m])
    return np.asarray(yield_m * (1.0 + spread * _middles(SPRINGS)))


def triangle(yield_m: float, spread: float) -> Floats:
    """Return yields over the same range, most of them in the middle."""
    at = _middles(FINE)
    return np.asarray(yield_m * (1.0 + spread * np.sign(at) * (1.0 - np.sqrt(1.0 - np.abs(at)))))


def exponential(mean_m: float) -> Floats:
    """Return yields distributed exponentially.

    Each one is the mean of its share of them, so that all together slide at the right force.
    """
    stronger = np.arange(FINE, 0, -1) / FINE  # share of the springs from each one's on
    moment = np.r_[stronger * (1.0 - np.log(stronger)), 0.0]  # sum of their yields
    return np.asarray(-mean_m * FINE * np.diff(moment))


def _middles(count: int) -> Floats:
    return np.asarray(2.0 * (np.arange(count) + 0.5) / count - 1.0)


def plastic(yields_m: Floats, x_m: Floats) -> Floats:
    """Return the force of a chain of initial stiffness 1, (n,), m."""
    return iwan(yields_m, np.full(yields_m.size, 1.0 / yields_m.size), x_m)


def elements(yields_m: Floats, k_n_per_m: float) -> list[core.ElementConfig]:
    """Return elements of the core for a chain of that initial stiffness."""
    if yields_m.size in (1, SPRINGS) and np.allclose(
        np.diff(yields_m, 2), 0.0, atol=1e-9 * yields_m[-1]
    ):
        return [_element(yields_m, k_n_per_m)]  # as even as the springs of the element itself
    # More groups where springs yield early: there are more of them, and each reversal slides them.
    edges = np.linspace(np.sqrt(yields_m[0]), np.sqrt(yields_m[-1]), GROUPS + 1) ** 2
    group = np.searchsorted(edges[1:-1], yields_m, side="right")
    return [
        _element(own, k_n_per_m * own.size / yields_m.size)
        for own in (yields_m[group == one] for one in np.unique(group))
    ]


def _element(yields_m: Floats, k_n_per_m: float) -> core.ElementConfig:
    """Return the element whose even distribution has that mean and standard deviation."""
    n = core.IWAN_SLIDERS
    spread = yields_m.std() / yields_m.mean() * np.sqrt(3.0 * n**2 / (n**2 - 1.0))
    return core.element(
        "iwan", k_n_per_m=k_n_per_m, post_yield_ratio=0.0, xy_m=float(yields_m.mean()),
        spread=min(float(spread), 1.0),
    )  # fmt: skip
