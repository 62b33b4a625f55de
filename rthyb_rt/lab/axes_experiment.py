"""A test on a rig with several axes, from its files to the core's settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config, core, ground_motion
from rthyb_rt.config import AxesRig, Derived, Limit, RigFile, TestFile, defaults, matrix_response
from rthyb_rt.config import limits as limits_file
from rthyb_rt.config.axes_reference import reference_of
from rthyb_rt.config.deriving_axes import (
    AxesDerived,
    derive_axes,
    in_order,
    of_axis,
    resolve_axes,
)
from rthyb_rt.config.lonesensors import (
    READ,
    LoneDisplacement,
    LoneForce,
    LoneSensor,
    tare_most,
)
from rthyb_rt.config.placing import placing
from rthyb_rt.config.rate import Rate
from rthyb_rt.config.testfile import MATRIX, MatrixLaw
from rthyb_rt.core.coupled_rig import CoupledRig
from rthyb_rt.core.group import (
    AXIS_WATCHES,
    DISAGREE,
    Allowance,
    AxisConfig,
    InterfaceConfig,
    SensorWatches,
    axis_channels,
    sensor_channels,
)
from rthyb_rt.core.matrix_lead import MatrixLeadConfig
from rthyb_rt.core.matrix_rfc import MatrixRfcConfig
from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.lab import (
    axes_rig,
    axis_wires,
    disagreement,
    experiment,
    frozen,
    sensor_wires,
)
from rthyb_rt.lab.experiment import Group, Setup
from rthyb_rt.record import signal_units

Floats = NDArray[np.float64]

NEVER: Final = 1e6
"""Multiple of the noise at rest that is never reached, so that a lead does not adapt."""


def prepare_any(test: TestFile, rig: RigFile | AxesRig) -> Setup:
    """Return a test in virtual time, ready to run, on a rig of one axis or of several.

    Raises:
        InputError: everything that is wrong in the files, in the record, or between them.
    """
    return prepare(test, rig) if isinstance(rig, AxesRig) else experiment.prepare(test, rig)


@placing
def prepare(
    test: TestFile,
    rig: AxesRig,
    *,
    real_time: bool = False,
    record: GroundMotion | None = None,
) -> Setup:
    """Read the ground motion and determine all settings of the core.

    Args:
        test, rig: the two files.
        real_time: as for `experiment.prepare`.
        record: the ground motion, neither cut nor scaled, if already read; None: read it.

    Raises:
        InputError: everything that is wrong in the files, in the record, or between them.
    """
    _refuse_what_is_of_one(test)
    if real_time:
        rig.refuse_silent_sensors("a test in real time")
        sensor_wires.check(rig)
        axis_wires.check(rig)
        experiment.refuse_other_rate(test, rig)
        experiment.refuse_python(test, [own.law for own in rig.specimen.element])

    def read() -> GroundMotion:
        return experiment.load_motion(test) if record is None else record

    derived, whole = experiment.both(lambda: derive_axes(test, rig), read)
    if real_time:
        experiment.refuse_slow(derived.structure)
    baseline = ground_motion.baseline_check(whole)
    motion = experiment.cut_and_scale(whole, test.ground_motion)
    lasts_s = test.test.duration_s
    if lasts_s is None:
        lasts_s = motion.duration_s + test.test.free_vibration_s
    ag = ground_motion.resample(
        motion, derived.fs_hz, method=test.ground_motion.interpolation, duration_s=lasts_s
    )
    end_tick = round(min(motion.duration_s, lasts_s) * derived.fs_hz)
    ordered = in_order(test, rig)
    expected = reference_of(test, rig, derived.structure, ag)
    derived = following(rig, derived, expected.axis_m, expected.axis_n)
    if real_time:
        _check_limits(rig, derived)
    group = Group(rig, derived, axes_rig.rig_config(rig, derived.fs_hz), expected)
    resolved = resolve_axes(ordered, rig, derived)
    controller = controller_config(ordered, rig, derived, end_tick)
    first = replace(derived.axis[0], structure=derived.structure)
    of_part, of_axes = experiment.part_channels(first), _axis_channels(controller, rig)
    experiment.refuse_own_names(test, of_part, _recorded(rig) | {one.name for one in of_axes})
    own_channels = of_part + of_axes + _lone_channels(rig)
    baseline_note = () if baseline.ok else (f"ground motion: {baseline.message}",)
    setup = Setup(
        test=resolved,
        rig=rig.of_axis(rig.names[0]),
        derived=first,
        motion=motion,
        ag_mps2=ag,
        controller=controller,
        virtual_rig=experiment.rig_config(rig.of_axis(rig.names[0]), derived.fs_hz),
        notes=(
            *derived.notes,
            *baseline_note,
            *_range_notes(group),
            *(_derived_notes(group) if real_time else ()),
        ),
        reference=signal_units.reference_rows(expected.x, expected.v, expected.force),
        channels=_extra_channels(rig, own_channels) + own_channels,
        group=group,
    )
    try:
        core.Controller(setup.controller)
        CoupledRig(group.virtual_rig)
    except core.CoreError as error:
        raise InputError(
            f"{error}; check the largest and smallest values of both files",
            f'test "{test.test.name}" on rig "{rig.rig.name}"',
        ) from error
    return setup


def _axis_channels(controller: core.ControllerConfig, rig: AxesRig) -> tuple[core.Channel, ...]:
    return axis_channels(controller, rig.kinematics.turns())


def _lone_channels(rig: AxesRig) -> tuple[core.Channel, ...]:
    """Return the channels of the sensors without an actuator."""
    sensors = rig.lone_sensors
    return sensor_channels([(one.name, "N" if one.kind == "force" else "m") for one in sensors])


def _refuse_names(rig: AxesRig, own: Sequence[core.Channel]) -> None:
    """Refuse a sensor without an actuator whose channels' names are used already.

    Args:
        rig: the rig file.
        own: channels that the recording has without extra sensors.

    Raises:
        InputError: naming the first such sensor.
    """
    names = [one.name for one in own]
    taken = _recorded(rig) | {name for name in names if names.count(name) > 1}
    extra = {each.name: axis.name for axis in rig.axis for each in axis.sensors.extra}
    for i, one in enumerate(rig.sensor or ()):
        for name in (one.name, f"{one.name}{READ}"):
            why = experiment.why_taken(name, taken)
            if why is None and name in extra:
                why = f'axis {extra[name]} has an extra sensor "{name}", recorded by that name'
            if why:
                raise InputError(
                    f'found "{one.name}", but {why}; choose another name', f"sensor.{i}.name"
                )


def _recorded(rig: AxesRig) -> set[str]:
    """Return the names that the records of all axes and the reference use."""
    numbered = (*experiment.TRUE, *experiment.HEARD)
    further = {f"{name}_{i}" for name in numbered for i in range(1, len(rig.axis))}
    further.update(signal_units.reference_names(len(rig.directions)))
    return further | experiment.RECORDED


def _extra_channels(rig: AxesRig, own: Sequence[core.Channel]) -> tuple[core.Channel, ...]:
    """Return the extra channels of every axis, which stand before all others of a row.

    Args:
        rig: the rig file.
        own: channels that the recording has without them.

    Raises:
        InputError: a name is used already, or a row has no room for so many.
    """
    taken = _recorded(rig) | {one.name for one in own}
    _refuse_names(rig, own)
    found = tuple(
        channel
        for i, axis in enumerate(rig.axis)
        for channel in experiment.channels_of_sensors(axis.sensors, taken, f"axis.{i}.sensors")
    )
    if rig.sensor and len(own) > core.CHANNELS_MAX:
        raise InputError(
            f"found {len(rig.sensor)} sensors without an actuator, each with two channels; with "
            f"the other values of axes, directions and structure these are {len(own)} channels, "
            f"but a row of the recording has room for {core.CHANNELS_MAX}: record less in "
            "numerical.record, or remove some of the sensors",
            "sensor",
        )
    if found and len(found) + len(own) > core.CHANNELS_MAX:
        raise InputError(
            f"found {len(found)} extra channels; beside the {len(own)} values of axes, directions "
            f"and structure, a row of the recording has room for {core.CHANNELS_MAX - len(own)}: "
            "remove some of them, or record less in numerical.record",
            "axis.sensors.extra",
        )
    return found


def _check_limits(rig: AxesRig, derived: AxesDerived) -> None:
    """Refuse a limit of an axis that no reading in its frames can reach."""
    for name, own in zip(rig.names, derived.axis, strict=True):
        axis_wires.check_limit(rig.of_axis(name), own.limits.limits)


def _refuse_what_is_of_one(test: TestFile) -> None:
    if test.history is not None:
        raise InputError(
            "found a history, which prescribes a single displacement; a rig with several axes "
            "supports only hybrid tests",
            "history",
        )
    if test.test.time_scale != 1.0:
        raise InputError(
            f"found {test.test.time_scale:g}; on a rig with several axes it must be 1",
            "test.time_scale",
        )


def following(rig: AxesRig, derived: AxesDerived, axis_m: Floats, pushed: Floats) -> AxesDerived:
    """Fill in the limits that follow from the reference motion of each axis.

    HOLD and ramp-out brake all axes together, at the highest deceleration that any of them needs.
    """
    rate, found = derived.rate, list[Derived]()
    for i, own in enumerate(derived.axis):
        view = rig.of_axis(rig.names[i])
        limits = limits_file.with_reference(
            own.limits,
            float(np.abs(np.diff(axis_m[:, i])).max(initial=0.0)) / rate.period_s,
            float(np.abs(np.diff(axis_m[:, i], 2)).max(initial=0.0)) / rate.period_s**2,
        )
        x_m, f_n = axis_m[:, [i]], pushed[:, [i]]
        v_m_per_s = np.gradient(x_m, rate.period_s, axis=0)
        expected = signal_units.reference_rows(x_m, v_m_per_s, f_n)
        found.append(replace(own, limits=experiment.with_sensors(view, limits, rate, expected)))
    hardest = max(
        (own.limits for own in found), key=lambda one: one.brake_acceleration_m_per_s2 or 0.0
    )
    brake = hardest.brake_acceleration_m_per_s2
    found[0] = replace(found[0], limits=replace(found[0].limits, brake_acceleration_m_per_s2=brake))
    return replace(derived, axis=tuple(found))


def _range_notes(group: Group) -> list[str]:
    """Return a note for each sensor whose range even the reference exceeds."""
    notes = []
    for i, axis in enumerate(group.rig.axis):
        for what, values, reach, unit, factor in (
            ("displacement.range_m", group.reference.axis_m[:, i],
             axis.sensors.displacement.range_m, "mm", 1e3),
            ("force.range_n", group.reference.axis_n[:, i], axis.sensors.force.range_n, "kN", 1e-3),
        ):  # fmt: skip
            peak = float(np.abs(values).max())
            if reach is not None and peak >= reach:
                notes.append(
                    f"axis {axis.name}: sensors.{what} = {reach * factor:g} {unit} is less than "
                    f"the peak of {peak * factor:.3g} {unit} in the reference simulation"
                )
    return notes


def _derived_notes(group: Group) -> list[str]:
    """Return a note for each velocity limit that is derived because no file states one.

    And one for each sensor without an actuator of which a limit is neither stated nor derived.
    """
    unwatched = []
    channels = sensor_wires.carried(group.rig)
    for one, channel in zip(group.rig.lone_sensors, channels, strict=True):
        of_force, found = isinstance(one, LoneForce), default_limits(one, channel, group)
        jump = one.jump_n if isinstance(one, LoneForce) else one.jump_m
        keys = {
            "stuck": ("stuck_s", one.stuck_s),
            "jump": ("jump_n" if of_force else "jump_m", jump),
        }
        missing = [key for name, (key, own) in keys.items() if own is None and name not in found]
        if missing:
            noise = "noise_std_n and lsb_n" if of_force else "noise_std_m and lsb_m"
            unwatched.append(
                f"sensor {one.name}: {' and '.join(missing)} cannot be derived from its noise "
                f"({noise}), so a reading that repeats itself or jumps may not end the test: state "
                "them"
            )
    return unwatched + [
        f"axis {name}: {note}"
        for name, own in zip(group.rig.names, group.derived.axis, strict=True)
        for note in experiment.derived_notes(own.limits)
    ]


_AT_REST: Final = """schema = "rthyb-test/1"
test = {{ name = "at-rest", description = "drives kept where they stand", sample_rate_hz = {hz:g} }}
controller = {{ type = "none" }}

[numerical.storeys]
count = {count}
mass_kg = [{masses}]
stiffness_n_per_m = 1
specimen = [{storeys}]

[numerical.damping]
ratio = 0
modes = [1]
"""
_DIRECTION: Final = """[[interface]]
name = "{name}"
storey = {storey}
"""


def at_rest(rig: AxesRig) -> Setup:
    """Return a setup in whose state IDLE the drives of a rig remain where they are.

    Its structure, one mass per direction with a period of about one second on the specimen's
    stiffness, is never used.

    Raises:
        InputError: the values of the rig file are inconsistent.
    """
    rig.refuse_silent_sensors("real time")
    sensor_wires.check(rig)
    axis_wires.check(rig)
    storeys = range(1, len(rig.directions) + 1)
    masses = np.diag(rig.k_e) / (2.0 * np.pi) ** 2
    text = _AT_REST.format(
        hz=rig.rate.hz,
        count=len(storeys),
        storeys=", ".join(map(str, storeys)),
        masses=", ".join(f"{mass:.6g}" for mass in masses),
    )
    for storey, name in zip(storeys, rig.directions, strict=True):
        text += _DIRECTION.format(name=name, storey=storey)
    still = GroundMotion("none", "at-rest", core.PERIOD_S, np.zeros(2))
    setup = prepare(config.parse_test(text, "at-rest"), rig, record=still)
    return replace(setup, ag_mps2=np.zeros(1))


# ---- from the terms of the files to those of the core --------------------------------------------


def controller_config(
    test: TestFile, rig: AxesRig, derived: AxesDerived, end_tick: int
) -> core.ControllerConfig:
    """Return the core's settings; ``end_tick`` as for `experiment.controller_config`."""
    first = derived.first
    views = [
        experiment.controller_config(
            of_axis(test, name, first).model_copy(update={"limits": own.limits.limits}),
            rig.of_axis(name), own, end_tick,
        )
        for name, own in zip(rig.names, derived.axis, strict=True)
    ]  # fmt: skip
    by_matrix = test.controller.type == MATRIX
    axes = tuple(
        AxisConfig(
            name,
            view.law if own.plc_enabled and not by_matrix else core.LawConfig(),
            view.x_range_m,
            view.f_range_n,
            view.velocity_limit_m_per_s,
            view.acceleration_limit_m_per_s2,
        )
        for name, own, view in zip(rig.names, derived.axis, views, strict=True)
    )
    k_e = np.array(derived.k_e)
    return replace(
        views[0],
        law=core.LawConfig(),
        lead_enabled=by_matrix or any(own.plc_enabled for own in derived.axis),
        rfc=replace(views[0].rfc, k_e_n_per_m=float(k_e[0, 0])),
        motion=core.MotionConfig("kr-alpha", mass_kg=1.0, period_s=derived.rate.period_s),
        numerical=derived.structure.part,
        axes=axes,
        interfaces=tuple(_interfaces(test, rig, views[0].rfc, k_e)),
        kinematics=rig.core_kinematics(),
        matrix_lead=_matrix_lead(test, rig, derived) if by_matrix else None,
        matrix_rfc=_matrix_rfc(test, rig, derived, k_e),
    )


def _interfaces(
    test: TestFile, rig: AxesRig, rfc: core.RfcConfig, k_e: Floats
) -> list[InterfaceConfig]:
    found = []
    for j, (one, turns) in enumerate(zip(test.interface, rig.kinematics.turns(), strict=True)):
        limits = zip(("position", "force"), one.limits.of_kind(turns), strict=True)
        watches = {
            cause: core.Watch(float(limit.value), limit.action)
            for cause, limit in limits
            if limit is not None and limit.acts
        }
        own = replace(rfc, k_e_n_per_m=float(k_e[j, j]))
        found.append(InterfaceConfig(one.name, own, watches))
    return found


def _matrix_rfc(test: TestFile, rig: AxesRig, derived: AxesDerived, k_e: Floats) -> MatrixRfcConfig:
    """Return the force compensation; directions coupled by one specimen share a matrix."""
    own = derived.axis[0]
    enabled = test.controller.rfc.enabled and test.controller.type != "none"
    noise_m = np.array([axis.rest_noise_displacement_m for axis in derived.axis])
    weights, further = rig.core_kinematics().shares()
    lone_m = np.array([one.noise_std_m for one in rig.sensor or () if one.kind == "displacement"])
    return MatrixRfcConfig(
        k_e,
        tuple(float(v) for v in np.sqrt(weights**2 @ noise_m**2 + further**2 @ lone_m**2)),
        memory_s=max(own.window_samples, 2) * derived.rate.period_s,
        cutoff_hz=own.rfc_cutoff_hz,
        lateness_s=own.force_lateness_s,
        enabled=enabled,
        period_s=derived.rate.period_s,
    )


def _matrix_lead(test: TestFile, rig: AxesRig, derived: AxesDerived) -> MatrixLeadConfig:
    """Return the lead of all axes, from the results of identification.

    Raises:
        InputError: no inverse can be fitted.
    """
    from rthyb_rt.config.axes_response import response_of_rig

    assert rig.identified is not None
    h = derived.rate.period_s
    found = response_of_rig(rig, rig.identified, derived.rate)
    given = test.controller.matrix or MatrixLaw()
    inverse = None
    if given.inverse:
        try:
            inverse = matrix_response.fit(found, h).inverse
        except InputError as error:
            raise InputError(
                f"{error.problems[0].message}; or set inverse = false, which compensates by terms "
                "fitted to the response",
                test.source.place(("controller", "matrix", "inverse")),
            ) from error
    first = None
    if not given.inverse:
        first = matrix_response.fitted_terms(found, h, given.roll_off_hz, coupled=given.coupled)
    learns = test.controller.delay_estimator.enabled and test.controller.plc_enabled
    return MatrixLeadConfig(
        tuple(axis.rest_noise_displacement_m for axis in derived.axis),
        inverse,
        coupled=given.coupled,
        roll_off_hz=given.roll_off_hz,
        cutoff_hz=given.cutoff_hz,
        gate_factor=given.gate_factor if learns else NEVER,
        memory_s=given.memory_s,
        first=first,
        period_s=h,
    )


def station_config(setup: Setup, group: Group, *, real: bool = False) -> core.StationConfig:
    """Return the settings of the station, as `experiment.station_config`, for every axis."""
    names, rig = group.rig.names, group.rig
    views = [
        experiment.axis_station_config(
            replace(
                setup,
                test=setup.test.model_copy(update={"limits": own.limits.limits}),
                rig=rig.of_axis(name),
                derived=own,
                channels=(),
                group=None,
            ),
            real=real,
        )
        for name, own in zip(names, group.derived.axis, strict=True)
    ]
    apart = disagreement.limits(group, real=real)
    axes = tuple(
        _axis_config(setup, group, k, view, apart, real=real) for k, view in enumerate(views)
    )
    common = {cause: w for cause, w in views[0].watches.items() if cause not in AXIS_WATCHES}
    part, own = experiment.part_channels(setup.derived), _axis_channels(setup.controller, rig)
    lone = _lone_channels(rig)
    return replace(
        views[0],
        controller=replace(setup.controller, axes=axes),
        watches=common,
        path_velocity_m_per_s=min(view.path_velocity_m_per_s for view in views),
        path_acceleration_m_per_s2=min(view.path_acceleration_m_per_s2 for view in views),
        law_channel=0,
        law_channel_count=0,
        part_channel=setup.channels.index(part[0]) if part else 0,
        part_channel_count=len(part),
        axis_channel=setup.channels.index(own[0]) if own else 0,
        axis_channel_count=len(own),
        sensors=_sensor_configs(setup, group, views, apart, real=real),
        lone_channel=setup.channels.index(lone[0]) if lone else 0,
        lone_channel_count=len(lone),
    )


def _axis_config(
    setup: Setup,
    group: Group,
    k: int,
    view: core.StationConfig,
    apart: disagreement.DisagreementLimits,
    *,
    real: bool,
) -> AxisConfig:
    """Return the settings of axis k, from those that it would have as a rig of one axis."""
    axis, own = setup.controller.axes[k], group.derived.axis[k]
    of_x, of_f = apart.axis_m[k], apart.axis_n[k]
    differing = {
        cause: one.watch
        for cause, one in zip(DISAGREE, (of_x, of_f), strict=True)
        if one.watch is not None
    }
    still: tuple[int | None, int | None] = (None, None)
    if real:
        still = frozen.of_axis(group.rig.of_axis(axis.name), view.tare_ticks, setup.rate)
    return replace(
        axis,
        velocity_limit_m_per_s=_velocity(own, axis, real),
        rest_spread_m=view.rest_spread_m,
        tare_most_m=view.tare_most_m,
        tare_most_n=view.tare_most_n,
        x_frozen_ticks=still[0],
        f_frozen_ticks=still[1],
        x_allowance=of_x.allowance if differing else None,
        f_allowance=of_f.allowance if differing else None,
        watches={
            cause: w for cause, w in {**view.watches, **differing}.items() if cause in AXIS_WATCHES
        },
    )


def _sensor_configs(
    setup: Setup,
    group: Group,
    views: Sequence[core.StationConfig],
    apart: disagreement.DisagreementLimits,
    *,
    real: bool,
) -> tuple[SensorWatches, ...]:
    """Return the settings of the sensors without an actuator."""
    rig, ticks = group.rig, views[0].tare_ticks
    channels = sensor_wires.carried(rig) if real else [None] * len(rig.lone_sensors)
    return tuple(
        sensor_watches(
            one,
            setup.rate,
            default_limits(one, channel, group) if real else {},
            _rest_spread_m(one, group),
            _tare_most(one, rig, views),
            0 if channel is None else frozen.of_sensor(one, channel.step, ticks, setup.rate),
            differs,
        )
        for one, channel, differs in zip(rig.lone_sensors, channels, apart.sensor, strict=True)
    )


def sensor_watches(
    one: LoneSensor,
    rate: Rate,
    derived_limits: Mapping[str, Limit],
    rest_spread: float,
    most: float,
    frozen_ticks: int = 0,
    differs: disagreement.Differing | None = None,
) -> SensorWatches:
    """Return the limits of a sensor without an actuator, stated or else derived.

    Args:
        one: the sensor.
        rate: rate of the test.
        derived_limits: those that follow from noise and motion, by name.
        rest_spread: by how much its readings may vary during the tare; 0: not limited.
        most: greatest tare; 0: any.
        frozen_ticks: equal readings in a row that end the tare; 0: any number may be equal.
        differs: limit on its difference from what the other sensors imply.
    """
    limits: dict[str, tuple[str, Limit | None]] = {"stuck": ("sensor_stuck_s", one.stuck_s)}
    if isinstance(one, LoneForce):
        reach, limits["jump"] = one.range_n, ("force_jump_n", one.jump_n)
    else:
        reach, limits["jump"] = one.range_m, ("sensor_jump_m", one.jump_m)
    watches = {
        name: core.Watch(experiment.at_rate(of, limit.value, rate), limit.action)
        for name, (of, limit) in limits.items()
        if limit is not None and limit.acts
    }
    for name, derived in derived_limits.items():
        of, stated = limits[name]
        # Derived changes per sample are already for the rate of the test; times never are.
        value = experiment.at_rate(of, derived.value, rate)
        if stated is None:
            watches[name] = core.Watch(
                value if name == "stuck" else float(derived.value), derived.action
            )
    return SensorWatches(
        one.name,
        reach or 0.0,
        watches.get("stuck"),
        watches.get("jump"),
        rest_spread,
        most,
        frozen_ticks,
        None if differs is None else differs.watch,
        Allowance() if differs is None else differs.allowance,
    )


def default_limits(
    one: LoneSensor, channel: sensor_wires.Carried | None, group: Group
) -> dict[str, Limit]:
    """Return the limits on a sensor without an actuator that follow from its noise and the motion.

    Args:
        one: the sensor.
        channel: what the frames carry of it; None: not known.
        group: rig, limits of the axes, and reference.

    Returns:
        ``stuck``, a time, and ``jump``, a change per sample of the test, if they can be derived:
        both need the noise of the sensor, the jump of a load cell a reference.
    """
    rig, derived = group.rig, group.derived
    along = rig.along(one)
    step = 0.0 if channel is None else channel.step
    tie, rate = rig.core_kinematics(), derived.rate
    limits = [own.limits for own in derived.axis]
    if isinstance(one, LoneForce):
        change = float(np.abs(np.diff(group.reference.force @ along)).max(initial=0.0))
        force = [limit.limits.force_n for limit in limits]
        most = [limit.value if limit is not None and limit.acts else 0.0 for limit in force]
        reach = tare_most(along @ tie.jacobian().T, most)
        return defaults.of_load_cell(
            one.noise_std_n, max(one.lsb_n, step), min(reach, one.range_n or math.inf), change, rate
        )
    by_axis = np.array(along @ tie.back())
    peak = float(np.abs(group.reference.v @ along).max(initial=0.0))
    return defaults.of_displacement_sensor(
        one.noise_std_m, max(one.lsb_m, step), by_axis.tolist(), limits, peak, rate
    )


def _rest_spread_m(one: LoneSensor, group: Group) -> float:
    if isinstance(one, LoneForce):
        return 0.0
    return rest_spread_m(one, [own.limits.rest_spread_m for own in group.derived.axis])


def rest_spread_m(one: LoneDisplacement, of_axes: Sequence[float]) -> float:
    """Return by how much the readings of a displacement sensor may vary during the tare.

    It is what the axes may, but never so little that the stated noise of the sensor refuses it. A
    test with all its limits written out states that of the axes, and must give the same.
    """
    noise_m = max(one.noise_std_m, one.lsb_m / math.sqrt(12))
    return max(limits_file.REST_SPREAD_SIGMAS * noise_m, *of_axes)


def _tare_most(one: LoneSensor, rig: AxesRig, views: Sequence[core.StationConfig]) -> float:
    """Return the greatest allowed tare of a sensor, m or N; 0: any.

    The readings r = a u for the interface's displacement u follow from those of the axes,
    u = B^+ x; those of a load cell, r = a F, from the forces of the axes with the same work,
    F = B^T f.
    """
    along = rig.along(one)
    tie = rig.core_kinematics()
    of_force = isinstance(one, LoneForce)
    by_axis = along @ (tie.jacobian().T if of_force else tie.back())
    return tare_most(
        by_axis, [view.tare_most_n if of_force else view.tare_most_m for view in views]
    )


def _velocity(own: Derived, axis: AxisConfig, real: bool) -> float | None:
    derived: Limit | None = own.limits.derived.get("command_velocity_m_per_s")
    return float(derived.value) if derived is not None and real else axis.velocity_limit_m_per_s
