"""The virtual rig with several axes, as described by a rig file."""

from __future__ import annotations

import numpy as np

from rthyb_rt import core
from rthyb_rt.config import AxesRig, Rate
from rthyb_rt.config.axesfile import Plant
from rthyb_rt.config.lonesensors import LoneForce, LoneSensor
from rthyb_rt.config.own_tables import core_element
from rthyb_rt.core.coupled_rig import CoupledRig, CoupledRigConfig, StateSpace
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment


def rig_config(rig: AxesRig, fs_hz: float = core.FS_HZ) -> CoupledRigConfig:
    """Return the virtual rig with several axes at a sample rate.

    Raises:
        CoreError: the kinematics leave a direction undetermined, which files are checked for.
    """
    rate, n, m = Rate(fs_hz), len(rig.axis), len(rig.directions)
    given = rig.specimen
    stiffness, damping, mass = (
        np.zeros((m, m)) if rows is None else np.array(rows, dtype=np.float64)
        for rows in (given.stiffness, given.damping, given.mass)
    )
    sensors = [experiment.sensor_configs(axis.sensors) for axis in rig.axis]
    servos: tuple[core.ServoConfig, ...] = ()
    if rig.plant is None:
        servos = tuple(experiment.servo_config(rig.of_axis(name), rate) for name in rig.names)
    return CoupledRigConfig(
        rig.core_kinematics(),
        stiffness,
        damping,
        mass,
        servos,
        None if rig.plant is None else _state_space(rig.plant, n),
        tuple((rig.directions.index(one.along), core_element(one.law)) for one in given.element),
        tuple(x for x, _ in sensors),
        tuple(f for _, f in sensors),
        rig.rig.load_cell,
        rig.rig.seed,
        rate.period_s,
        given.attachment_stiffness_n_per_m or 0.0,
        tuple(experiment.extra_sensor_configs(axis.sensors) for axis in rig.axis),
        tuple(_errors_of(one) for one in rig.lone_sensors),
        tuple(rig.sensor_places),
    )


def _errors_of(one: LoneSensor) -> core.SensorConfig:
    if isinstance(one, LoneForce):
        return core.SensorConfig(one.noise_std_n, one.lsb_n, one.bias_n, one.range_n or 0.0)
    return core.SensorConfig(one.noise_std_m, one.lsb_m, one.bias_m, one.range_m or 0.0)


def _state_space(plant: Plant, axes: int) -> StateSpace:
    if plant.a is None or plant.b is None or plant.c is None:
        raise InputError(
            "the file was not read; load the rig file from its own folder", "plant.file"
        )
    return StateSpace(
        np.array(plant.a), np.array(plant.b), np.array(plant.c), (plant.stroke_m,) * axes
    )


def virtual_rig(rig: AxesRig, fs_hz: float = core.FS_HZ) -> CoupledRig:
    """Return the virtual rig at rest.

    Raises:
        InputError: values that pass the checks of the files but not those of the core, such as a
            specimen too stiff for the substeps.
    """
    try:
        return CoupledRig(rig_config(rig, fs_hz))
    except core.CoreError as error:
        raise InputError(
            f"{error}; check the largest and smallest values of the file, and its substeps",
            f'rig "{rig.rig.name}"',
        ) from error
