"""Sensors without an actuator while a single axis of several moves.

Before the axes are commissioned, they move one at a time: jogs, and the checks of a commissioning.
The station then has one axis, and these sensors beside it, so that their ranges and limits act as
in a test. The other drives receive nothing; their feedback is heard, because it contains readings.
"""

from __future__ import annotations

import math
from dataclasses import replace

from rthyb_rt import core
from rthyb_rt.config import RigFile, defaults, limits
from rthyb_rt.config.lonesensors import LoneDisplacement, OneOfSeveral, SensorOfAxes
from rthyb_rt.core.group import sensor_channels
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.lab import axes_experiment, frozen, sensor_wires
from rthyb_rt.lab.experiment import HEARD, Setup


def with_sensors(setup: Setup) -> Setup:
    """Return the setup of a motion of one axis with the sensors that it has in common with others.

    Without such sensors, it is returned unchanged.
    """
    common = setup.rig.one_of
    if common is None or not common.sensors:
        return setup
    return replace(
        setup,
        beside=common,
        controller=replace(setup.controller, kinematics=_kinematics(common)),
        channels=(*setup.channels, *_channels(common), *_heard_channels(common)),
    )


def with_watches(setup: Setup, station: core.StationConfig) -> core.StationConfig:
    """Return the settings of a station with the limits of the sensors beside the axis.

    Any tare is accepted, as of the axis itself.
    """
    common = setup.beside
    if common is None:
        return station
    own = _channels(common)
    return replace(
        station,
        sensors=tuple(
            axes_experiment.sensor_watches(
                one.sensor,
                setup.rate,
                _default_limits(one, setup),
                _rest_spread_m(one, setup),
                0.0,
                frozen.of_sensor(
                    one.sensor, step_of(setup.rig, one), station.tare_ticks, setup.rate
                ),
            )
            for one in common.sensors
        ),
        lone_channel=setup.channels.index(own[0]),
        lone_channel_count=len(own),
    )


def heard_channel(setup: Setup) -> int:
    """Return the first channel of a row with displacement and force of drives that are heard."""
    found = () if setup.beside is None else _heard_channels(setup.beside)
    return setup.channels.index(found[0]) if found else 0


def heard_names(common: OneOfSeveral, axis: str) -> tuple[str, str]:
    """Return the channels with displacement and force of another axis, whose drive is heard."""
    number = 1 + list(common.others).index(axis)
    x_m, f_n = (f"{name}_{number}" for name in HEARD)
    return x_m, f_n


def places(common: OneOfSeveral) -> list[tuple[int, int]]:
    """Return where each sensor is read: 0 for the axis that moves, or 1 + number of another one.

    The second number is that of the extra channel.
    """
    order = [common.name, *common.others]
    return [(order.index(one.axis), one.number) for one in common.sensors]


def _kinematics(common: OneOfSeveral) -> Kinematics:
    """Return the axis as its own interface, from which the sensors follow but which needs none."""
    reads = [[one.per_m] for one in common.sensors if not one.is_cell]
    carries = [[one.per_n] for one in common.sensors if one.is_cell]
    return Kinematics(
        [[1.0]],
        displacements=[[1.0] + [0.0] * len(reads)] if reads else None,
        forces=[[1.0] + [0.0] * len(carries)] if carries else None,
        reads=reads or None,
        carries=carries or None,
    )


def _channels(common: OneOfSeveral) -> tuple[core.Channel, ...]:
    return sensor_channels(
        [(one.sensor.name, "N" if one.is_cell else "m") for one in common.sensors]
    )


def _heard_channels(common: OneOfSeveral) -> tuple[core.Channel, ...]:
    return tuple(
        core.Channel(name, unit)
        for axis in common.others
        for name, unit in zip(heard_names(common, axis), ("m", "N"), strict=True)
    )


def step_of(rig: RigFile, one: SensorOfAxes) -> float:
    """Return the difference of neighbouring readings in the frames that contain a sensor, m or N.

    Args:
        rig: of the axis that moves.
        one: a sensor that it has in common with others.
    """
    others = {} if rig.one_of is None else rig.one_of.others
    return float(sensor_wires.codec_of(others.get(one.axis, rig)).extra_step(one.number))


def _default_limits(one: SensorOfAxes, setup: Setup) -> dict[str, limits.Limit]:
    """Return the limits that follow from the noise of a sensor and the motion, as for a test.

    The fastest that a motion of one axis may be takes the place of the reference simulation.
    """
    step, rate = step_of(setup.rig, one), setup.rate
    fastest = abs(one.per_m) * setup.derived.limits.path_velocity_m_per_s
    sensor = one.sensor
    if isinstance(sensor, LoneDisplacement):
        return defaults.of_displacement_sensor(
            sensor.noise_std_m,
            max(sensor.lsb_m, step),
            [one.per_m],
            [setup.derived.limits],
            fastest,
            rate,
        )
    return defaults.of_load_cell(
        sensor.noise_std_n,
        max(sensor.lsb_n, step),
        min(one.most or math.inf, one.range),
        fastest / rate.hz,
        rate,
    )


def _rest_spread_m(one: SensorOfAxes, setup: Setup) -> float:
    sensor = one.sensor
    if not isinstance(sensor, LoneDisplacement):
        return 0.0
    return axes_experiment.rest_spread_m(sensor, [setup.derived.limits.rest_spread_m])
