"""History of a yielding model spring: a recording that begins in motion does not show it."""

from __future__ import annotations

import numpy as np

from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.effects.base import Floats
from rthyb_rt.diagnose.policy import POLICY

PAST = 400
"""Number of steps, each way, of the assumed past that leads the spring to the first row."""
HEAD_S = 0.1
"""Length of the beginning in which a motion must be at rest, s: see `POLICY.start_at_rest`."""


def at_rest(case: Case, x: Floats) -> bool:
    """Return whether a motion begins at rest at zero, where a spring has no history."""
    head = max(int(HEAD_S * case.fs_hz), 2)
    least = POLICY.start_at_rest * float(np.max(np.abs(x)))
    return float(np.max(np.abs(x[:head] - x[0]))) < least and abs(float(x[0])) < least


def extremes(case: Case, x: Floats) -> tuple[Floats, Floats]:
    """Return the spring's force if it came from the largest displacement in either direction, N.

    Of shape (n,) each. Any other history within that displacement gives a force between the two.
    """
    top = float(np.max(np.abs(x)))
    forces = []
    for end in (-top, top):
        past = np.concatenate((np.linspace(0.0, end, PAST), np.linspace(end, x[0], PAST)))
        forces.append(case.model.spring(np.concatenate((past, x)))[past.size :])
    return forces[0], forces[1]


def forgotten(case: Case, x: Floats, sigma_n: float) -> int:
    """Return the first row from which on the history no longer matters; 0 if that is too late.

    From the row at which both extreme histories agree within the noise, it is irrelevant. A motion
    that never yields again keeps its history: all of it is then evaluated, beside `column`.
    """
    if not matters(case, x):
        return 0
    low, high = extremes(case, x)
    apart = np.flatnonzero(np.abs(high - low) > POLICY.forgotten_force * sigma_n)
    first = int(apart[-1]) + 1 if apart.size else 0
    return first if first < POLICY.forgotten_by * x.size else 0


def matters(case: Case, x: Floats) -> bool:
    """Return whether a model's spring has a history at the first row of a motion, (n,), m."""
    return case.model.bouc_wen is not None and not at_rest(case, x)


def column(case: Case, x: Floats) -> Floats:
    """Return half the difference between both extreme histories, (n,), N.

    The model's spring begins without a history, between the two: one standard deviation of this
    column covers the one that it had, unless the motion before was larger. A simulated body begins
    without a history.
    """
    low, high = extremes(case, x)
    return 0.5 * (high - low)
