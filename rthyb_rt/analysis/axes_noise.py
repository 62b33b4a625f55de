"""What the noise of the sensors alone asks of several axes, before a test runs.

As for one axis (`rthyb_rt.analysis.command_noise`), with matrices: the noise of every load cell and
displacement sensor, those without an actuator among them, reaches every axis through the interface.
Rotations without mass pass it on almost undamped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import axes_roots, command_noise, loop_roots
from rthyb_rt.analysis.axes_roots import AxesLoop
from rthyb_rt.analysis.command_noise import CommandNoise

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig
    from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]


def of_loop(setup: Setup, loop: AxesLoop) -> dict[str, Floats]:
    """Return the standard deviations of velocity and acceleration of each command, (axes,).

    Noise is taken as independent from sample to sample and from sensor to sensor.

    Args:
        setup: a test on several axes.
        loop: its loop, which must be stable.
    """
    assert setup.group is not None
    h, rfc = setup.controller.period_s, setup.controller.matrix_rfc
    angle = command_noise.angles(loop.roots())
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
    return command_noise.deviations(loop.law.response(z) @ closed @ entering, angle, h)


def _entering(rig: AxesRig) -> tuple[Floats, Floats]:
    """Return pose and interface forces for one standard deviation of each sensor, at rest.

    (directions, displacement sensors) and (directions, load cells): those of the axes, in their
    order, then those without an actuator.
    """
    tie = rig.core_kinematics()
    found = [rig.of_axis(name).identified for name in rig.names]
    noise_m = [0.0 if one is None else one.rest_noise_displacement_m or 0.0 for one in found]
    noise_n = [0.0 if one is None else one.rest_noise_force_n or 0.0 for one in found]
    for one in rig.lone_sensors:
        if one.kind == "force":
            noise_n.append(one.noise_std_n)
        else:
            noise_m.append(one.noise_std_m)
    # A cell without an actuator also changes what the cells of the axes count for.
    unit = np.eye(tie.size + tie.force_sensors)
    still = np.zeros((len(unit), tie.displacement_sensors))
    by_cell = tie.measured_forces(
        unit[:, : tie.size], np.concatenate([still, unit[:, tie.size :]], axis=1)
    )
    return np.concatenate(tie.shares(), axis=1) * noise_m, by_cell.T * noise_n


def judge(setup: Setup) -> CommandNoise | None:
    """Return the limit of an axis that noise reaches first; None: not known, or no limit.

    The worse of the laws' initial settings and those to which the response leads them.
    """
    known = axes_roots.axes_and_laws(setup)
    if known is None or setup.group is None:
        return None
    (axes, states), config = known, setup.controller
    jacobian = setup.group.rig.core_kinematics().jacobian()
    keys = {
        "velocity": "velocity_limit_m_per_s",
        "acceleration": "acceleration_limit_m_per_s2",
    }
    found = list[CommandNoise]()
    for law in states:
        noise = of_loop(setup, axes_roots.loop_of(config, axes, law, jacobian))
        for i, axis in enumerate(config.axes):
            own = axis.over(config, list(keys.values()))
            limits = {quantity: own[key] for quantity, key in keys.items()}
            of_axis = {quantity: float(values[i]) for quantity, values in noise.items()}
            found += command_noise.beyond(axis.name, of_axis, limits)
    return max(found, key=lambda one: one.limited, default=None)
