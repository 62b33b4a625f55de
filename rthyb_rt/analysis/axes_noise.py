"""How far the noise of the sensors moves the commands of a test on several axes, before it runs.

Readings vary at rest. Their noise enters the loop of `rthyb_rt.analysis.axes_roots` with the forces
along the interface, F n_f, and with the displacements, W n_x, through the force compensation:

    f* = loop + F n_f - K LP W n_x,   x_c = -N f*

A loop can be stable and yet pass so much of it on that the limits hold the commands back, and then
the axes no longer follow. Motions without mass do so near half the sample rate, where the roots of
their step are -rho_inf: the closer to 1, the more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import axes_roots, loop_roots
from rthyb_rt.analysis.axes_roots import AxesLoop

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig
    from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class AxisNoise:
    """What noise alone asks of an axis.

    Attributes:
        axis: its name.
        acceleration_m_per_s2: standard deviation of the commanded acceleration.
        limit_m_per_s2: limit of the commanded acceleration.
    """

    axis: str
    acceleration_m_per_s2: float
    limit_m_per_s2: float

    @property
    def limited(self) -> float:
        """Share of normally distributed commands that are beyond the limit."""
        return math.erfc(self.limit_m_per_s2 / (math.sqrt(2.0) * self.acceleration_m_per_s2))


_POINTS: Final = 1024
"""Number of frequencies, once evenly spaced and once closer together towards half the rate."""
_NEAREST: Final = 1e-6
"""Distance of the nearest one from half the rate, in rad per sample."""


def accelerations(setup: Setup, loop: AxesLoop) -> Floats:
    """Return the standard deviation of each axis' commanded acceleration by noise, (axes,), m/s^2.

    Noise is taken as independent from sample to sample and from sensor to sensor. The variance is
    the mean of |H|^2 over the unit circle.

    Args:
        setup: a test on several axes.
        loop: its loop, which must be stable.
    """
    assert setup.group is not None
    h, rfc = setup.controller.period_s, setup.controller.matrix_rfc
    even = np.linspace(0.0, math.pi, _POINTS + 1)[1:-1]
    angle = np.union1d(even, math.pi - np.geomspace(_NEAREST, math.pi / 2.0, _POINTS))
    z = np.exp(1j * angle)
    moved = loop.part.response(z)
    back = loop.law.then(loop.axes).plus(loop.beside).response(z)
    closed = np.linalg.solve(np.eye(moved.shape[1]) - moved @ back, moved)
    by_displacement, by_force = _entering(setup.group.rig)
    entering = np.broadcast_to(by_force.astype(complex), (z.size, *by_force.shape))
    if rfc is not None and rfc.enabled:
        low_pass = loop_roots.low_pass(rfc.cutoff_hz, h).response(z)[:, :, None]
        felt = -low_pass * (np.asarray(rfc.k_e) @ by_displacement)
        entering = np.concatenate([entering, felt], axis=2)
    second_difference = np.abs(1.0 - 1.0 / z) ** 2 / h**2
    commands = loop.law.response(z) @ closed @ entering
    density = second_difference**2 * (np.abs(commands) ** 2).sum(axis=2).T
    steps = np.diff(angle)
    variance = (0.5 * (density[:, 1:] + density[:, :-1]) * steps).sum(axis=1) / math.pi
    return np.asarray(np.sqrt(variance))


def _entering(rig: AxesRig) -> tuple[Floats, Floats]:
    """Return pose and interface forces for one standard deviation of each axis' sensors."""
    tie = rig.core_kinematics()
    found = [rig.of_axis(name).identified for name in rig.names]
    noise_m = [0.0 if one is None else one.rest_noise_displacement_m or 0.0 for one in found]
    noise_n = [0.0 if one is None else one.rest_noise_force_n or 0.0 for one in found]
    return tie.shares()[0] * noise_m, tie.resultants(np.diag(noise_n)).T


def judge(setup: Setup) -> AxisNoise | None:
    """Return the axis whose acceleration limit noise reaches first; None: not known, or no limit.

    The worse of the laws' initial settings and those to which the response leads them.
    """
    known = axes_roots.axes_and_laws(setup)
    if known is None or setup.group is None:
        return None
    axes, states = known
    jacobian = setup.group.rig.core_kinematics().jacobian()
    found = []
    for law in states:
        loop = axes_roots.loop_of(setup.controller, axes, law, jacobian)
        for axis, value in zip(setup.controller.axes, accelerations(setup, loop), strict=True):
            limit = axis.over(setup.controller, ["acceleration_limit_m_per_s2"]).popitem()[1]
            if limit > 0.0 and value > 0.0:
                found.append(AxisNoise(axis.name, float(value), limit))
    return max(found, key=lambda one: one.limited, default=None)


def remark(setup: Setup) -> str | None:
    """Return a remark for the user if noise alone exceeds a limit by its standard deviation."""
    found = judge(setup)
    if found is None or found.acceleration_m_per_s2 <= found.limit_m_per_s2:
        return None
    return (
        f"noise of the sensors alone makes the command of axis {found.axis} accelerate by "
        f"{found.acceleration_m_per_s2:.3g} m/s² (standard deviation), more than its limit of "
        f"{found.limit_m_per_s2:.3g} m/s² allows: about {100.0 * found.limited:.0f} % of the "
        "commands will be reduced, and the axes may not follow; set controller.rfc.cutoff_hz, or "
        'use integrator = "kr-alpha" with a lower rho_inf'
    )
