"""Curves of a check of several axes: largest root and largest delay, the loop, the tracking."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import axes_roots, loop_roots
from rthyb_rt.analysis.axes_roots import Axes, AxesLoop, System, constant, on_each
from rthyb_rt.checking.curves import BEGINS_ADAPTED, angles_near
from rthyb_rt.config.sparse_structure import SparseStructure
from rthyb_rt.core.library import CoreError
from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

DELAYS: Final = (0, 2, 4, 8, 12, 16, 24, 32, 48)
"""Additional delays, in samples, for which the largest root is computed."""
PERIODS: Final = 9
"""Number of factors on the periods of the structure, from a quarter to four: two per octave."""


@dataclass(frozen=True)
class KnownLoop:
    """What the rig file makes known of the loop of a test.

    Attributes:
        setup: the test.
        axes: the axes with their specimen.
        laws: the control laws, by the name of their state.
    """

    setup: Setup
    axes: Axes
    laws: dict[str, System]

    @property
    def jacobian(self) -> Floats:
        """The kinematics at rest, (axes, directions)."""
        assert self.setup.group is not None
        return self.setup.group.rig.core_kinematics().jacobian()

    def loops(self, factor: float = 1.0) -> dict[str, AxesLoop]:
        """Return the loop for each law.

        Args:
            factor: on all periods of the structure, at the same stiffness and damping ratios.

        Raises:
            CoreError: the numerical part has a motion without stiffness.
        """
        config, group = self.setup.controller, self.setup.group
        assert group is not None
        structure = group.derived.structure
        assert isinstance(structure, SparseStructure)
        config = replace(config, numerical=structure.slowed(factor).part)
        return {
            name: axes_roots.loop_of(config, self.axes, law, self.jacobian)
            for name, law in self.laws.items()
        }


def known(setup: Setup) -> KnownLoop | None:
    """Return the loop of a test; None if the response of the axes is not known."""
    found = axes_roots.axes_and_laws(setup)
    if found is None or not found[1]:
        return None
    axes, laws = found
    return KnownLoop(setup, axes, dict(zip(BEGINS_ADAPTED, laws, strict=False)))


@dataclass(frozen=True)
class StabilityCurves:
    """Largest roots over a common additional delay, and the largest delay for other periods.

    Attributes:
        delay_s: additional delay of all axes, (k,), s.
        growth_per_s: growth rate of the largest root by the law's state, (k,) each, 1/s; a motion
            grows where it is positive.
        factors: on the periods of the structure, (p,).
        limit_s: largest additional delay of a stable loop by the law's state, whole samples, (p,)
            each, s; inf: all of ``delay_s``; nan: unstable without one.
    """

    delay_s: Floats
    growth_per_s: dict[str, Floats]
    factors: Floats
    limit_s: dict[str, Floats]


def stability(loop: KnownLoop) -> StabilityCurves | None:
    """Return the curves of a test; None if its structure has a motion without stiffness."""
    rate, factors = loop.setup.rate, np.geomspace(0.25, 4.0, PERIODS)
    try:
        limits = [
            {name: largest_delay(one) for name, one in loop.loops(float(factor)).items()}
            for factor in factors
        ]
        here = loop.loops()
    except CoreError:
        return None
    growth = {
        name: rate.hz * np.array([_growth(_later(one, late)) for late in DELAYS])
        for name, one in here.items()
    }
    limit_s = {name: np.array([found[name] for found in limits]) * rate.period_s for name in here}
    return StabilityCurves(np.array(DELAYS) * rate.period_s, growth, factors, limit_s)


def largest_delay(loop: AxesLoop) -> float:
    """Return the whole samples by which all axes may be later; inf: `DELAYS`; nan: none, not 0."""
    if not loop.stable():
        return math.nan
    low, high = 0, 0
    for high in DELAYS[1:]:
        if not _later(loop, high).stable():
            break
        low = high
    else:
        return math.inf
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _later(loop, middle).stable() else (low, middle)
    return float(low)


def _later(loop: AxesLoop, samples: int) -> AxesLoop:
    """Return the loop with all axes later by a number of samples."""
    if samples == 0:
        return loop
    count = loop.law.d.shape[0]
    return replace(loop, law=loop.law.then(on_each(loop_roots.later(samples), count)))


def _growth(loop: AxesLoop) -> float:
    """Return the logarithm of the largest root, per sample."""
    return math.log(max(float(np.abs(loop.roots()).max()), 1e-300))


@dataclass(frozen=True)
class OverFrequency:
    """Curves by the state of the control law, over common frequencies.

    Attributes:
        frequency_hz: (k,), Hz.
        curves: complex values, (k,) or (k, directions, directions) each.
        swept_hz: frequency up to which the response of the axes is known.
    """

    frequency_hz: Floats
    curves: dict[str, Complexes]
    swept_hz: float


def nyquist(loop: KnownLoop) -> OverFrequency | None:
    """Return det(1 + L) - 1, with L the loop opened at all axes, up to half the sample rate.

    It takes the place of L of one axis: the loop is unstable if the curve encircles -1
    (generalised Nyquist criterion; MacFarlane & Postlethwaite 1977, Int. J. Control 25:1). None if
    the structure has a motion without stiffness.
    """
    try:
        found = loop.loops()
    except CoreError:
        return None
    theta = angles_near(np.concatenate([one.roots(0.0) for one in found.values()]))
    z = np.exp(1j * theta)
    curves = {
        name: np.asarray(np.prod(1.0 + one.opened(z), axis=1) - 1.0) for name, one in found.items()
    }
    h = loop.setup.controller.period_s
    return OverFrequency(theta / (2.0 * math.pi * h), curves, loop.axes.swept_hz)


def tracking(loop: KnownLoop) -> OverFrequency:
    """Return the predicted response of every direction to the command of every direction."""
    h, size = loop.setup.controller.period_s, loop.jacobian.shape[1]
    f = np.geomspace(0.1, min(loop.axes.swept_hz, 0.5 / h), 300)
    z = np.exp(2j * np.pi * f * h)
    moved = loop.axes.system.response(z)[:, :size]
    laws = {"not compensated": constant(np.eye(len(loop.jacobian))), **loop.laws}
    curves = {
        name: np.asarray(moved @ law.response(z) @ loop.jacobian) for name, law in laws.items()
    }
    return OverFrequency(f, curves, loop.axes.swept_hz)


def coupling(response: Complexes, stiffness: Floats, direction: int) -> Floats:
    """Return the motion of a direction due to the commands of the others.

    Args:
        response: (k, directions, directions).
        stiffness: elastic stiffness of the specimen along the directions, (directions,).
        direction: the index.

    Returns:
        Share of the commands, (k,): root of the sum of squares, where commands in m and in rad
        count by the energy that they store in the specimen.
    """
    scale = np.sqrt(stiffness[direction] / stiffness)
    shares = np.abs(response[:, direction, :]) * scale
    return np.asarray(np.linalg.norm(np.delete(shares, direction, axis=1), axis=1))
