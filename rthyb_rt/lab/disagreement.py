"""Limits on how far a sensor may differ from what all others of its kind imply.

Those that the rig file states, or else, in real time, as much as commissioning accepts of a sensor:
a share of its motion, a mounting out of line, and a lag at the speed of the reference simulation;
and the noise. They hold for the sensors without an actuator, and for those of the axes as far as
further sensors or redundant actuators imply their readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config import AxesRig, defaults
from rthyb_rt.config.linkframes import codec_of_link
from rthyb_rt.config.lonesensors import LoneSensor
from rthyb_rt.config.rigfile import ServoHydraulic
from rthyb_rt.core.group import Allowance
from rthyb_rt.lab import axis_wires, sensor_wires
from rthyb_rt.lab.experiment import Group

Floats = NDArray[np.float64]

_DELAY_S: Final = 0.02
"""Assumed delay of an actuator that was not identified."""
_AXES_LATER: Final = 1.1
"""Factor on the limits of the axes. If only one reading is redundant, all differences are in the
same proportion, and which sensor is wrong cannot be told: the one without an actuator is named."""


@dataclass(frozen=True)
class Differing:
    """The limit on the disagreement of a reading; ``watch`` None: there is none."""

    watch: core.Watch | None = None
    allowance: Allowance = field(default_factory=Allowance)


@dataclass(frozen=True)
class DisagreementLimits:
    """The limits by kind.

    Attributes:
        axis_m, axis_n: of displacement sensor and load cell of each axis, (axes,).
        sensor: of each sensor without an actuator, in the order of the core.
    """

    axis_m: tuple[Differing, ...]
    axis_n: tuple[Differing, ...]
    sensor: tuple[Differing, ...]


def limits(group: Group, *, real: bool) -> DisagreementLimits:
    """Return the limits of a test.

    Args:
        group: rig, figures of the axes, and reference simulation.
        real: whether limits that the file does not state are derived.

    Raises:
        InputError: a DBC file cannot be read, or has no such channel.
    """
    of_x, of_f = (_of_kind(group, force=force, real=real) for force in (False, True))
    n = len(group.rig.names)
    return DisagreementLimits(of_x[:n], of_f[:n], of_x[n:] + of_f[n:])


def _of_kind(group: Group, *, force: bool, real: bool) -> tuple[Differing, ...]:
    rig = group.rig
    weights = rig.core_kinematics().differences()[force]
    kind, key = ("force", "disagreement_n") if force else ("displacement", "disagreement_m")
    further = [one for one in rig.lone_sensors if (one.kind == "force") == force]
    tables: list[Any] = [*(getattr(axis.sensors, kind) for axis in rig.axis), *further]
    derived = [0.0] * len(tables)
    allowances = [Allowance()] * len(tables)
    # A sweep, or drives that are only held, have no reference.
    if real and weights.any() and group.reference.x.any():
        allowances = _allowances(group, further, force=force)
        derived = _constant(group, weights, further, force=force)
    found = []
    for table, value, allowance in zip(tables, derived, allowances, strict=True):
        stated = getattr(table, key)
        own = Allowance(allowance.share, allowance.least, stated is None)
        watch = core.Watch(value, "trip") if value > 0.0 else None
        if stated is not None:
            watch = core.Watch(float(stated.value), stated.action) if stated.acts else None
        found.append(Differing(watch, own))
    return tuple(found)


def _readings(group: Group, one: LoneSensor, *, force: bool) -> Floats:
    """Return what a sensor without an actuator reads in the reference simulation, (n,)."""
    seen = group.reference.force if force else group.reference.x
    return np.asarray(seen @ group.rig.along(one))


def _allowances(group: Group, further: Sequence[LoneSensor], *, force: bool) -> list[Allowance]:
    """Return what commissioning allows scales and mountings, for the axes and further sensors.

    The axes count as exact, because all others are compared with them. Redundant actuators differ
    by their tracking errors, which are a share of their motion.
    """
    rig, reference = group.rig, group.reference
    tie, own = rig.core_kinematics(), np.abs(reference.axis_n if force else reference.axis_m)
    of_axis = defaults.DISPLACEMENT_SHARE if rig.is_redundant and not force else 0.0
    found = [Allowance(of_axis)] * len(rig.names)
    share = defaults.FORCE_FACTOR - 1.0 if force else defaults.DISPLACEMENT_SHARE
    for one in further:
        by_axis = np.abs(rig.along(one)) @ np.abs(tie.jacobian().T if force else tie.back())
        terms = max(float((own @ by_axis).max()), float(by_axis.max() * own.max()))
        least = defaults.BEYOND_REFERENCE * defaults.ASKEW * terms
        found.append(Allowance(share, least))
    return found


def _constant(
    group: Group, weights: Floats, further: Sequence[LoneSensor], *, force: bool
) -> list[float]:
    """Return the part of the limits for lag, noise and resolution, m or N."""
    rig, rate, reference = group.rig, group.derived.rate, group.reference
    n, delay_s = len(rig.names), _delay_s(rig)
    noise, lsb = ("noise_std_n", "lsb_n") if force else ("noise_std_m", "lsb_m")
    measured = "rest_noise_force_n" if force else "rest_noise_displacement_m"

    def lag(reading: Floats) -> float:
        peak_per_s = float(np.abs(np.diff(reading)).max(initial=0.0)) * rate.hz
        return defaults.allowed_lag(peak_per_s, delay_s, rate)

    if force:
        of_axes = [_at_the_end(group, i) for i in range(n)]
    else:
        of_axes = [lag(reference.axis_m[:, i]) if rig.is_redundant else 0.0 for i in range(n)]
    in_frames = _steps(rig, force=force)
    resolution = [0.0] * n + [float(getattr(one, lsb)) for one in further]
    found = defaults.disagreements(
        weights,
        of_axes + [lag(_readings(group, one, force=force)) for one in further],
        [float(getattr(axis, measured)) for axis in group.derived.axis]
        + [float(getattr(one, noise)) for one in further],
        [max(both) for both in zip(in_frames, resolution, strict=True)],
        rate,
    )
    return [_AXES_LATER * value if k < n else value for k, value in enumerate(found)]


def _steps(rig: AxesRig, *, force: bool) -> list[float]:
    """Return the difference of neighbouring readings in the frames of axes and sensors."""
    found = []
    for name in rig.names:
        own = rig.of_axis(name)
        by, codec = axis_wires.calibration(own), codec_of_link(own.link)
        lsb = own.sensors.force.lsb_n if force else own.sensors.displacement.lsb_m
        gain = by.f_gain if force else by.x_gain
        found.append(max(lsb, codec.reading_step(force=force, gain=gain)))
    carried = zip(rig.lone_sensors, sensor_wires.carried(rig), strict=True)
    return found + [
        0.0 if channel is None else channel.step
        for one, channel in carried
        if (one.kind == "force") == force
    ]


def _at_the_end(group: Group, axis: int) -> float:
    """Return what a load cell at the end of an actuator measures besides the specimen, N.

    That is friction and inertia of the piston.
    """
    rig, rate = group.rig, group.derived.rate
    actuator = rig.axis[axis].actuator
    if rig.rig.load_cell != "actuator-end" or not isinstance(actuator, ServoHydraulic):
        return 0.0
    x = group.reference.axis_m[:, axis]
    v = float(np.abs(np.diff(x)).max(initial=0.0)) * rate.hz
    a = float(np.abs(np.diff(x, 2)).max(initial=0.0)) * rate.hz**2
    moving = actuator.viscous_n_s_per_m * v + actuator.moving_mass_kg * a
    return float(actuator.friction_n + defaults.BEYOND_REFERENCE * moving)


def _delay_s(rig: AxesRig) -> float:
    """Return the largest delay of an axis, s."""
    found = [axis.identified for axis in rig.axis]
    return max(_DELAY_S if one is None else one.delay_s for one in found)
