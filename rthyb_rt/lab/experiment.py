"""One hybrid test: from its files to the core's settings, and its empty recording."""

from __future__ import annotations

import datetime
import functools
import math
import subprocess
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import __version__, config, core, ground_motion
from rthyb_rt.config import AxesRig, Derived, Limit, Limits, Rate, RigFile, TestFile, timescale
from rthyb_rt.config import limits as limits_file
from rthyb_rt.config import testfile as test_file
from rthyb_rt.config.axes_reference import AxesReference
from rthyb_rt.config.deriving_axes import AxesDerived
from rthyb_rt.config.limits import VelocityLimit
from rthyb_rt.config.lonesensors import LoneSensor, OneOfSeveral
from rthyb_rt.config.own_tables import PythonClass, core_element
from rthyb_rt.config.placing import placing
from rthyb_rt.config.rigfile import TOLERANCES, LinkTable, Sensors
from rthyb_rt.core.coupled_rig import CoupledRigConfig
from rthyb_rt.errors import InputError, Problem
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.lab import axis_wires, histories
from rthyb_rt.record import recording, signal_units

if TYPE_CHECKING:
    from rthyb_rt.config.numerical_structure import Structure
    from rthyb_rt.config.own_structure import OwnStructure
    from rthyb_rt.config.sparse_structure import SparseStructure

REFERENCE_DTYPE = np.dtype([("x_ref_m", "<f8"), ("v_ref_mps", "<f8"), ("f_ref_n", "<f8")])

Progress = Callable[[int, int], None]

_A = TypeVar("_A")
_B = TypeVar("_B")


@dataclass(frozen=True)
class Group:
    """What a test on a rig with several axes has in addition to its first axis.

    Attributes:
        rig, derived: the rig file, and values derived from it and the test.
        virtual_rig: settings of the core.
        reference: motion of the interface and the axes in the reference simulation.
    """

    rig: AxesRig
    derived: AxesDerived
    virtual_rig: CoupledRigConfig
    reference: AxesReference


@dataclass(frozen=True)
class Setup:
    """A test with all values resolved, ready to run.

    Attributes:
        test, rig, derived: the files, the test with every default filled in, and derived values.
        motion: the scaled record before resampling.
        ag_mps2: ground acceleration at every tick of the test, shape (n,), in the laboratory's
            time: divided by the square of the time scale. For a prescribed history: the
            displacement, m.
        controller, virtual_rig: settings of the core.
        notes: for the user; none requires action.
        reference: the reference simulation requested by the test file, shape (n,).
        channels: named values that are recorded in addition to the standard record.
        plan: of a prescribed history; None: a hybrid test.
        group: for a rig with several axes; ``rig`` and ``derived`` then belong to the first one.
        beside: for a motion of one axis of several, the sensors without an actuator.
    """

    test: TestFile
    rig: RigFile
    derived: Derived
    motion: GroundMotion
    ag_mps2: NDArray[np.float64]
    controller: core.ControllerConfig
    virtual_rig: core.RigConfig
    notes: tuple[str, ...] = ()
    reference: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, REFERENCE_DTYPE))
    channels: tuple[core.Channel, ...] = ()
    plan: histories.HistoryPlan | None = None
    group: Group | None = None
    beside: OneOfSeveral | None = None

    @property
    def ticks(self) -> int:
        """Length of the test in samples."""
        return int(self.ag_mps2.size)

    @property
    def rate(self) -> Rate:
        """Sample rate of the test."""
        return self.derived.rate

    @property
    def rigs(self) -> tuple[RigFile, ...]:
        """The rig of each axis: a single one, or those of the group."""
        if self.group is None:
            return (self.rig,)
        return tuple(self.group.rig.of_axis(name) for name in self.group.rig.names)

    @property
    def rig_file(self) -> RigFile | AxesRig:
        """The rig file, of one axis or of several."""
        return self.rig if self.group is None else self.group.rig

    @property
    def sensors(self) -> list[LoneSensor]:
        """Sensors without an actuator, in the order of the core."""
        if self.group is not None:
            return self.group.rig.lone_sensors
        return [] if self.beside is None else [one.sensor for one in self.beside.sensors]

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the axes of a group; () for a single axis, which has no name."""
        return () if self.group is None else self.group.rig.names


@placing
def prepare(
    test: TestFile,
    rig: RigFile,
    *,
    real_time: bool = False,
    record: GroundMotion | None = None,
) -> Setup:
    """Read the ground motion and determine all settings of the core.

    Args:
        test, rig: the two files.
        real_time: whether the test will run over a link, where derived limits act as well; a note
            names them.
        record: the ground motion, neither cut nor scaled, if already read; None: read it.

    Raises:
        InputError: everything that is wrong in the files, in the record, or between them.
    """

    def read() -> GroundMotion:
        return load_motion(test) if record is None else record

    if real_time:
        refuse_other_rate(test, rig)
        refuse_python(test, rig.specimen)
        axis_wires.check(rig)
    if test.history is not None:
        return _prepare_history(test, rig, real_time)
    derived, whole = both(lambda: config.derive(test, rig), read)
    if real_time:
        refuse_slow(derived.structure)
    test = config.resolve(test, derived)
    baseline = ground_motion.baseline_check(whole)
    motion = cut_and_scale(whole, test.ground_motion)
    lasts_s = test.test.duration_s
    if lasts_s is None:
        lasts_s = motion.duration_s + test.test.free_vibration_s
    slow = test.test.time_scale
    refuse_long(lasts_s, derived.fs_hz, slow)
    # Sampled more densely in the structure's time, hence at the tick rate in the laboratory's.
    ag = ground_motion.resample(
        motion, derived.fs_hz * slow, method=test.ground_motion.interpolation, duration_s=lasts_s
    )
    if slow != 1.0:
        ag /= slow**2
    end_tick = round(min(motion.duration_s, lasts_s) * derived.fs_hz * slow)
    setup = Setup(
        test=test,
        rig=rig,
        derived=derived,
        motion=motion,
        ag_mps2=ag,
        controller=(controller := controller_config(test, rig, derived, end_tick)),
        virtual_rig=rig_config(rig, derived.fs_hz),
        channels=channels_beside(test, rig, derived, controller.law),
        notes=derived.notes + (() if baseline.ok else (f"ground motion: {baseline.message}",)),
    )
    try:
        core.Controller(setup.controller)
        core.VirtualRig(setup.virtual_rig)
        expected = reference(setup)
    except core.CoreError as error:
        # The checks of the files come first, so this is a combination that they do not cover.
        raise InputError(
            f"{error}; check the largest and smallest values of both files",
            f'test "{test.test.name}" on rig "{rig.rig.name}"',
        ) from error
    return _noted(follow_reference(replace(setup, reference=expected)), real_time)


def _noted(setup: Setup, real_time: bool) -> Setup:
    """Return a test with the notes that follow from its reference and limits.

    Raises:
        InputError: in real time, the frames of the link do not carry a limit.
    """
    further = []
    if real_time:
        axis_wires.check_limit(setup.rig, setup.test.limits)
        further = derived_notes(setup.derived.limits)
    notes = (*setup.notes, *_range_notes(setup.rig, setup.reference), *further)
    return replace(setup, notes=notes)


def refuse_long(lasts_s: float, rate_hz: float, slow: float) -> None:
    """Refuse a test too long for a recording: a slow test of many hours.

    Raises:
        InputError: states how it would fit.
    """
    if slow > 1.0 and lasts_s * slow * rate_hz > histories.MOST_SAMPLES:
        raise InputError(
            f"found {slow:g}; {lasts_s:.6g} s of the structure are {lasts_s * slow:.6g} s in the "
            f"laboratory, {lasts_s * slow * rate_hz:.0f} samples at {rate_hz:g} Hz; at most "
            f"{histories.MOST_SAMPLES} are allowed: a time scale of up to "
            f"{histories.MOST_SAMPLES / (lasts_s * rate_hz):.3g}, a shorter test, or a lower "
            "test.sample_rate_hz",
            "test.time_scale",
        )


def _prepare_history(test: TestFile, rig: RigFile, real_time: bool) -> Setup:
    """Return a test that follows a prescribed history, ready to run.

    Raises:
        InputError: everything that is wrong in the files, or each limit that the history exceeds.
    """
    assert test.history is not None
    derived = config.derive(test, rig)
    plan = histories.plan(
        test.history, derived.fs_hz, derived.limits.path_acceleration_m_per_s2,
        test.test.time_scale,
    )  # fmt: skip
    title = test.history.title
    test = config.resolve(test, derived)
    controller = replace(
        controller_config(test, rig, derived, plan.path_m.size),
        motion=core.MotionConfig("prescribed", period_s=derived.rate.period_s),
    )
    setup = Setup(
        test=test,
        rig=rig,
        derived=derived,
        motion=GroundMotion(title, "history", derived.rate.period_s, np.zeros(1)),
        ag_mps2=plan.path_m,
        controller=controller,
        virtual_rig=rig_config(rig, derived.fs_hz),
        channels=channels_beside(test, rig, derived, controller.law),
        notes=derived.notes,
        plan=plan,
        reference=_along(rig, plan),
    )
    try:
        core.Controller(setup.controller)
        core.VirtualRig(setup.virtual_rig)
    except core.CoreError as error:
        raise InputError(
            f"{error}; check the largest and smallest values of both files",
            f'test "{test.test.name}" on rig "{rig.rig.name}"',
        ) from error
    setup = follow_reference(setup)
    _refuse_beyond(setup)
    return _noted(setup, real_time)


def _along(rig: RigFile, plan: histories.HistoryPlan) -> NDArray[np.void]:
    """Return the response of the rig file's specimen and table to a history, as a reference."""
    h, x = 1.0 / plan.rate_hz, plan.path_m
    v, a = np.gradient(x, h), np.zeros_like(x)
    a[1:-1] = np.diff(x, 2) / h**2
    elements = (*specimen_elements(rig), *table_elements(rig))
    force = np.sum([core.CoreElement(one).run(x, v, a, h) for one in elements], axis=0)
    return _rows_of_reference(x, v, np.asarray(force))


def _refuse_beyond(setup: Setup) -> None:
    """Refuse a history that a limit would alter, since all of it is known in advance.

    Raises:
        InputError: every limit that is exceeded, with both values.
    """
    assert setup.plan is not None
    plan, limits, slow = setup.plan, setup.test.limits, setup.test.test.time_scale
    if setup.derived.plc_enabled:
        # The drive receives the output of the control law.
        law = core.Law(setup.controller.law, period_s=setup.rate.period_s)
        plan = replace(plan, path_m=law.run(plan.path_m))
    position, velocity = limits.command_position_m, limits.command_velocity_m_per_s
    increment = limits.command_increment_m
    bounds = (
        ("command_position_m", position.value if position and position.acts else None,
         plan.peak_m, "m"),
        ("command_velocity_m_per_s", velocity.value if velocity and velocity.enable else None,
         plan.peak_m_per_s, "m/s"),
        ("command_acceleration_m_per_s2", limits.command_acceleration_m_per_s2,
         plan.peak_m_per_s2, "m/s^2"),
        ("command_increment_m", increment.value if increment and increment.ends else None,
         plan.peak_m_per_s / core.FS_HZ, "m"),
    )  # fmt: skip
    problems = [
        Problem(
            "history",
            f"found a peak of {peak:.4g} {unit}; limits.{key} = {most:g} {unit}: reduce the "
            "amplitude or the speed of the history"
            + (f" (test.time_scale is {slow:g})" if key != "command_position_m" else ""),
        )
        for key, most, peak, unit in bounds
        if most is not None and peak > most
    ]
    if problems:
        raise InputError(problems)


def refuse_other_rate(test: TestFile, rig: RigFile | AxesRig) -> None:
    """Refuse real time at a rate that no clock provides, or that is not the drive's.

    Without a link, the virtual rig at the other end runs at the rate of the test.

    Raises:
        InputError: both rates.
    """
    hz, key = test.test.sample_rate_hz, "test.sample_rate_hz"
    if hz != round(hz):
        raise InputError(
            f"found {hz:g} Hz; a test in real time needs a whole number of samples per second: "
            f"use {round(hz)}, or run it without --realtime",
            key,
        )
    if rig.link is not None and hz != rig.rate.hz:
        raise InputError(
            f"found {hz:g} Hz; the drive of this rig is sampled at {rig.rate.hz:g} Hz "
            "(link.sample_rate_hz in the rig file), and a test in real time must run at the "
            f"rate of its drive: set {key} = {rig.rate.hz:g}, or link.sample_rate_hz = {hz:g} if "
            "that is the drive's rate, or run the test without --realtime",
            key,
        )


def refuse_python(test: TestFile, elements: Sequence[Any]) -> None:
    """Refuse classes in Python, each with an alternative.

    Args:
        test: the test file.
        elements: of the rig's specimen.

    Raises:
        InputError: lists all of them.
    """
    found = []
    if test.numerical.python is not None:
        found.append(
            ("numerical.python", "a numerical part in a shared library, numerical.library")
        )
    if test.controller.python is not None:
        found.append(("controller.python", "a control law in C, docs/extending.md"))
    for i, one in enumerate(elements):
        if isinstance(one, PythonClass):
            found.append((f"specimen.{i}", "elements from the catalogue"))
    if found:
        raise InputError(
            Problem(
                where,
                "is a class in Python, which occasionally takes longer than a sampling period "
                "(garbage collection, the interpreter lock), so a test in real time cannot "
                f"depend on it; it runs in virtual time; in real time use {instead}",
            )
            for where, instead in found
        )


def follow_reference(setup: Setup) -> Setup:
    """Fill in the limits that follow from the reference simulation, unless a file states them.

    Args:
        setup: the test with its reference, and the limits of its files.

    Raises:
        InputError: the reference simulation diverges, or jumps.
    """
    derived, h = setup.derived, setup.rate.period_s
    x_m = setup.reference["x_ref_m"]
    sent_m = core.Law(setup.controller.law, period_s=h).run(x_m) if derived.plc_enabled else x_m
    _refuse_divergence(setup, x_m, sent_m)
    limits = limits_file.with_reference(
        derived.limits,
        float(np.abs(np.diff(sent_m)).max(initial=0.0)) / h,
        float(np.abs(np.diff(x_m, 2)).max(initial=0.0)) / h**2,
    )
    derived = replace(derived, limits=with_sensors(setup.rig, limits, setup.rate, setup.reference))
    return replace(setup, derived=derived, test=config.resolve(setup.test, derived))


def _refuse_divergence(setup: Setup, x_m: NDArray[np.float64], sent_m: NDArray[np.float64]) -> None:
    """Refuse a reference, or its command after the control law, that no limit could follow.

    Raises:
        InputError: with the first tick, and the user's own classes that may be the cause.
    """
    most = limits_file.VELOCITY_MAX_M_PER_S / limits_file.VELOCITY_MARGIN
    given = setup.derived.limits.limits.command_velocity_m_per_s
    law = setup.controller.law.own
    for path, what in ((x_m, "structure"), (sent_m, "command after the control law")):
        with np.errstate(invalid="ignore", over="ignore"):
            v = np.abs(np.diff(path)) / setup.rate.period_s
        beyond = np.flatnonzero(~(v <= most)) if given is None else np.flatnonzero(~np.isfinite(v))
        if not beyond.size:
            continue
        tick = int(beyond[0])
        own = [e.class_ for e in setup.rig.specimen if isinstance(e, PythonClass)]
        part = setup.test.numerical.python
        own = [law.name] if path is sent_m and law else own + ([part.class_] if part else [])
        suspects = f"your own {' and '.join(own)}, " if own else ""
        raise InputError(
            f"in the reference simulation the {what} moves from {path[tick]:.4g} m at tick {tick} "
            f"to {path[tick + 1]:.4g} m at the next; at most {most:g} m/s are possible: check "
            f"{suspects}the units of mass, stiffness and ground motion, the sign of damping, and "
            "elements such as stops, which may be too stiff for the sampling period",
            f'test "{setup.test.test.name}" on rig "{setup.rig.rig.name}"',
        )


def with_sensors(
    rig: RigFile,
    limits: limits_file.Resolved,
    rate: Rate,
    expected: NDArray[np.void] | None = None,
) -> limits_file.Resolved:
    """Fill in the limits that follow from sensors, link and reference."""
    peak, step = 0.0, 0.0
    if expected is not None:
        peak = float(np.abs(expected["v_ref_mps"]).max(initial=0.0))
        step = float(np.abs(np.diff(expected["f_ref_n"])).max(initial=0.0))
    found = config.derived_limits(rig, limits, peak, step, rate)
    return replace(limits, derived={**limits.derived, **found})


def _range_notes(rig: RigFile, expected: NDArray[np.void]) -> list[str]:
    """Return a note for each sensor whose range even the reference simulation exceeds."""
    displacement, force = rig.sensors.displacement, rig.sensors.force
    channels = (
        ("displacement.range_m", displacement.range_m, displacement.bias_m, "x_ref_m", "mm", 1e3),
        ("force.range_n", force.range_n, force.bias_n, "f_ref_n", "kN", 1e-3),
    )
    notes = []
    for key, reach, bias, column, unit, factor in channels:
        peak = float(np.abs(expected[column] + bias).max())
        if reach is not None and peak >= reach:
            notes.append(
                f"sensors.{key} = {reach * factor:g} {unit} is less than the peak of "
                f"{peak * factor:.3g} {unit} in the reference simulation: samples beyond the "
                "range are lost; use a sensor with a larger range, or scale the ground motion down"
            )
    return notes


def derived_notes(limits: limits_file.Resolved) -> list[str]:
    """Return a note on the velocity limit that is derived because no file states one."""
    velocity = limits.derived.get("command_velocity_m_per_s")
    if velocity is None:
        return []
    return [
        "neither test nor rig has limits.command_velocity_m_per_s: over a link the command is "
        f"limited to {velocity.value:.3g} m/s, {limits_file.VELOCITY_MARGIN:g} times the peak "
        "velocity of the compensated reference and at least twice the velocity of ramps; set it "
        "in the rig file"
    ]


def refuse_slow(structure: Structure | SparseStructure | OwnStructure | None) -> None:
    """Refuse a structure whose step leaves less than half of the sampling period to the rest.

    Raises:
        InputError: states the time that a step takes on this computer.
    """
    if structure is None or isinstance(structure.part, core.DenseConfig):
        return
    from rthyb_rt.config.own_structure import OwnStructure, refuse_in_real_time
    from rthyb_rt.core.numerical_parts import SparsePart

    if isinstance(structure, OwnStructure):
        refuse_in_real_time(structure.part)
        return
    part = structure.part
    taken_s, most_s = SparsePart(part).step_time_s(), 0.5 * part.period_s
    if taken_s > most_s:
        raise InputError(
            f"a step of the structure takes {taken_s * 1e6:.0f} us on this computer (median of "
            f"200, {part.size} degrees of freedom, {len(part.joints)} elements); in real time at "
            f"most {most_s * 1e6:.0f} us is allowed, half of the sampling period: eliminate "
            "degrees of freedom without mass by static condensation, use a coarser model, or "
            "run the test in virtual time",
            "numerical",
        )


def both(first: Callable[[], _A], second: Callable[[], _B]) -> tuple[_A, _B]:
    """Return the results of both functions, or raise the errors of both together."""
    try:
        a = first()
    except InputError as error:
        try:
            second()
        except InputError as other:
            raise InputError([*error.problems, *other.problems]) from None
        raise
    return a, second()


def load_motion(test: TestFile) -> GroundMotion:
    """Read the ground motion of a test, unscaled; for a history, return a motion at rest."""
    if test.history is not None:
        return GroundMotion(test.history.title, "history", 1.0 / core.FS_HZ, np.zeros(1))
    wanted = test.ground_motion
    return ground_motion.load(
        wanted.record, format=wanted.format, units=wanted.units, channel=wanted.channel
    )


def cut_and_scale(motion: GroundMotion, wanted: test_file.GroundMotionTable) -> GroundMotion:
    if wanted.start_s or wanted.duration_s is not None:
        motion = motion.window(wanted.start_s, wanted.duration_s)
    if wanted.pga_g is not None:
        return motion.scaled(pga_g=wanted.pga_g)
    return motion if wanted.factor is None else motion.scaled(factor=wanted.factor)


_PRESCRIBED: Final = """schema = "rthyb-test/1"
test = {{ name = "{name}", description = "{what}", sample_rate_hz = {hz:g} }}
numerical = {{ period_s = 1, damping_ratio = 0 }}
controller = {{ type = "none" }}
"""


def prescribed(
    rig: RigFile, name: str, path_m: NDArray[np.float64], rate: Rate | None = None
) -> Setup:
    """Return the setup of a test that follows a given displacement.

    Args:
        rig: the rig, whose limits apply.
        name: for messages.
        path_m: displacement at every tick, (n,).
        rate: of the ticks; None: that of the rig in real time.

    Raises:
        InputError: the values of the rig file are inconsistent.
    """
    test = config.parse_test(
        _PRESCRIBED.format(name=name, what=test_file.PRESCRIBED, hz=(rate or rig.rate).hz), name
    )
    derived = config.derive(test, rig)
    derived = replace(derived, limits=with_sensors(rig, derived.limits, derived.rate))
    test = config.resolve(test, derived)
    controller = controller_config(test, rig, derived, path_m.size)
    return Setup(
        test=test,
        rig=rig,
        derived=derived,
        motion=GroundMotion("none", name, derived.rate.period_s, np.zeros(1)),
        ag_mps2=path_m,
        controller=replace(
            controller,
            motion=core.MotionConfig("prescribed", period_s=derived.rate.period_s),
        ),
        virtual_rig=rig_config(rig, derived.fs_hz),
        channels=channels_of_sensors(rig.sensors, RECORDED, "sensors"),
    )


# ---- from the terms of the files to those of the core -------------------------------------------


def controller_config(
    test: TestFile, rig: RigFile, derived: Derived, end_tick: int
) -> core.ControllerConfig:
    """Return the core's settings; ``end_tick`` is t_ex, where stage 3 of the RFC begins."""
    wanted, limits = test.controller, test.limits
    sensors, velocity = rig.sensors, limits.command_velocity_m_per_s
    return core.ControllerConfig(
        lead_enabled=derived.plc_enabled,
        law=law_config(test, derived),
        rfc=core.RfcConfig(
            k_e_n_per_m=derived.k_e_n_per_m,
            enabled=derived.rfc_enabled,
            tangent=cast(core.Tangent, derived.tangent),
            divisor=wanted.rfc.divisor,
            window=derived.window_samples,
            end_tick=end_tick,
            rest_noise_m=derived.rest_noise_displacement_m,
            period_s=derived.rate.period_s,
            cutoff_hz=derived.rfc_cutoff_hz,
            lateness_s=derived.force_lateness_s,
        ),
        motion=motion_config(test, derived),
        numerical=derived.structure.part if derived.structure is not None else None,
        x_range_m=sensors.displacement.range_m or 0.0,
        f_range_n=sensors.force.range_n or 0.0,
        velocity_limit_m_per_s=velocity.value if velocity and velocity.enable else 0.0,
        acceleration_limit_m_per_s2=limits.command_acceleration_m_per_s2 or 0.0,
        period_s=derived.rate.period_s,
    )


def law_config(test: TestFile, derived: Derived) -> core.LawConfig:
    """Return the control law with all its settings."""
    return core.LawConfig(
        name=test.controller.type,
        settings=dict(derived.law_settings),
        adapts=derived.estimator_enabled,
        rest_noise_m=derived.rest_noise_displacement_m,
        own=test.controller.python.own if test.controller.python is not None else None,
    )


def motion_config(test: TestFile, derived: Derived) -> core.MotionConfig:
    """Return the settings of the equation of motion of the numerical part."""
    return core.MotionConfig(
        integrator=test.numerical.integrator,
        mass_kg=derived.mass_kg,
        damping_n_s_per_m=derived.damping_n_s_per_m,
        stiffness_n_per_m=test.numerical.stiffness_n_per_m,
        k_e_n_per_m=derived.k_e_n_per_m,
        rho_inf=test.numerical.rho_inf,
        period_s=derived.rate.period_s,
    )


WATCHES: Final[dict[str, str]] = {
    "command_position_m": "position",
    "command_velocity_m_per_s": "velocity",
    "command_increment_m": "increment",
    "force_n": "force",
    "tracking_error_m": "tracking",
    "tracking_indicator_slope_m2_per_s": "indicator",
    "energy_error_j": "energy",
    "sensor_stuck_s": "sensor_stuck",
    "sensor_jump_m": "sensor_jump",
    "force_stuck_s": "force_stuck",
    "force_jump_n": "force_jump",
    "lost_pairs_share": "lost_pairs",
    "lost_pairs_warning_share": "lost_warning",
    "skipped_ticks_share": "skips",
    "skipped_ticks_warning_share": "skip_warning",
}
"""Names in the station of the limits of the files."""
RIG_WATCHES: Final = {key: f"rig_{WATCHES[key]}" for key in limits_file.BEFORE_TARE}
"""The same for the limits of the rig file that act before the tare."""


def _stuck_ticks(rate: Rate, seconds: float) -> float:
    """Return the ticks after which an equal reading counts as stuck: at least one repetition."""
    return float(max(2, rate.ticks(seconds)))


_TIMED: Final[dict[str, Callable[[Rate, float], float]]] = {
    "command_increment_m": Rate.increment,
    "sensor_stuck_s": _stuck_ticks,
    "force_stuck_s": _stuck_ticks,
    "sensor_jump_m": Rate.leap,
    "force_jump_n": Rate.leap,
}
"""Limits that depend on the rate: times, and changes in 1/1024 s, with their conversion."""


def channels_beside(
    test: TestFile, rig: RigFile, derived: Derived, law: core.LawConfig
) -> tuple[core.Channel, ...]:
    """Return the channels of a test on one axis beside its record, in the order of a row.

    Those of the rig's extra sensors, of the numerical part, and of the control law.

    Raises:
        InputError: a channel has a name that recordings or exported files use already.
    """
    own = part_channels(derived) + law_channels(law)
    refuse_own_names(test, own, RECORDED)
    taken = RECORDED | {one.name for one in own}
    return channels_of_sensors(rig.sensors, taken, "sensors") + own


TRUE: Final = ("x_true_m", "f_true_n")
"""Channels of a virtual rig's readings without errors; those of further axes end with a number."""
HEARD: Final = ("heard_x_m", "heard_f_n")
"""Channels of the displacement and the force of axes that stand still while another one moves; they
end with a number."""
RECORDED: Final = frozenset(core.RECORD_DTYPE.names or ()) | set(TRUE)
"""Names that the record of one axis uses."""


def why_taken(name: str, taken: Collection[str]) -> str | None:
    """Return why no further channel of a recording can have a name, or None if one can.

    Args:
        name: of the channel.
        taken: names of the channels that the recording has without it.
    """
    of_reference = name in taken and signal_units.is_of_reference(name)
    if name in taken and not of_reference:
        return f'a recording of this test already has a channel "{name}"'
    if of_reference or name in recording.BESIDE_SAMPLES:
        return f'exported files have a variable "{name}" beside the channels'
    return None


def channels_of_sensors(
    sensors: Sensors, taken: Collection[str], where: str
) -> tuple[core.Channel, ...]:
    """Return the channels of the extra sensors of an axis.

    Args:
        sensors: of the axis.
        taken: names of the channels that the recording has without them.
        where: key of the sensors' table in the rig file.

    Raises:
        InputError: a channel has a name that recordings or exported files use already.
    """
    for i, one in enumerate(sensors.extra):
        if why := why_taken(one.name, taken):
            raise InputError(
                f'found "{one.name}", but {why}; choose another name', f"{where}.extra.{i}.name"
            )
    return tuple(core.Channel(one.name, one.unit) for one in sensors.extra)


def refuse_own_names(
    test: TestFile, channels: Sequence[core.Channel], taken: Collection[str]
) -> None:
    """Refuse channels of the numerical part or the control law whose names are used already.

    Args:
        test: the test file, which names the class, library, FMU or structure that they are from.
        channels: of the part, then of the law.
        taken: names of the channels that the recording has without them.

    Raises:
        InputError: naming the first such channel, and where its name is chosen.
    """
    used = set(taken)
    for one in channels:
        if why := why_taken(one.name, used):
            where, whose = _origin(test, one.name)
            raise InputError(f'{whose} "{one.name}", but {why}; choose another name for it', where)
        used.add(one.name)


def _origin(test: TestFile, name: str) -> tuple[str, str]:
    """Return the key and, in words, the origin of a channel that is not the rig's."""
    from rthyb_rt.core.own import ControlLaw, NumericalPart
    from rthyb_rt.core.own_methods import place_of

    law, part = test.controller.python, test.numerical.python
    if law is not None and name in (kind := law.own.found(ControlLaw)).values:
        return "controller.python", f"{place_of(kind)}: {kind.__name__}.values names"
    if part is not None:
        made = part.own.found(NumericalPart)
        return "numerical.python", f"{place_of(made)}: {made.__name__}.responses names"
    given = [key for key in ("library", "fmu") if getattr(test.numerical, key) is not None]
    return ".".join(("numerical", *given)), "found a response called"


def law_channels(law: core.LawConfig) -> tuple[core.Channel, ...]:
    """Return the channels of everything that a control law reports besides alpha and beta."""
    return tuple(core.Channel(value.name, value.unit) for value in law.law.beside)


def part_channels(derived: Derived) -> tuple[core.Channel, ...]:
    """Return the channels of the responses of the structure that the test records, by name."""
    part = derived.structure.part if derived.structure is not None else None
    if part is None or isinstance(part, core.DenseConfig):
        return ()
    return tuple(core.Channel(one.name, one.unit) for one in part.responses)


def station_config(setup: Setup, *, real: bool = False) -> core.StationConfig:
    """Return the settings of the station: states, limits and paths around the controller.

    Args:
        setup: the test.
        real: whether there is a link to something that may break, so that derived limits, which no
            file states, act. Otherwise they only indicate.
    """
    if setup.group is not None:
        # Imported here, because that module depends on this one.
        from rthyb_rt.lab import axes_experiment

        return axes_experiment.station_config(setup, setup.group, real=real)
    return axis_station_config(setup, real=real)


def axis_station_config(setup: Setup, *, real: bool = False) -> core.StationConfig:
    """Return the settings of the station of one axis; arguments as for `station_config`."""
    limits, resolved, rate = setup.test.limits, setup.derived.limits, setup.rate
    given = {cause: _watched(limits, resolved, key, real) for key, cause in WATCHES.items()}
    # Derived changes per sample are already for the rate of the test; times never are.
    stated = {
        WATCHES[key]
        for key in _TIMED
        if getattr(limits, key) is not None or key in limits_file.IN_SAMPLES
    }
    keys = {cause: key for key, cause in WATCHES.items()}
    for key, cause in RIG_WATCHES.items():
        given[cause] = getattr(setup.rig.limits, key)
        if resolved.sources.get(key) != "test":
            given[WATCHES[key]] = None
    controller = setup.controller
    velocity = resolved.derived.get("command_velocity_m_per_s")
    if velocity is not None and real:
        controller = replace(controller, velocity_limit_m_per_s=float(velocity.value))
    count = _law_channel_count(setup)
    return core.StationConfig(
        controller=controller,
        watches={
            cause: core.Watch(
                at_rate(keys[cause], limit.value, rate) if cause in stated else float(limit.value),
                limit.action,
            )
            for cause, limit in given.items()
            # Disabled, not omitted: the station has its own default for skipped ticks.
            if limit is not None and (limit.acts or cause == "skips")
        },
        path_velocity_m_per_s=resolved.path_velocity_m_per_s,
        path_acceleration_m_per_s2=resolved.path_acceleration_m_per_s2,
        brake_acceleration_m_per_s2=resolved.brake_acceleration_m_per_s2 or 0.0,
        rest_spread_m=resolved.rest_spread_m,
        tare_most_m=_tare_most(setup, "command_position_m"),
        tare_most_n=_tare_most(setup, "force_n"),
        tare_ticks=rate.ticks(resolved.tare_s),
        ramp_in_ticks=rate.ticks(resolved.ramp_in_s),
        armed_ticks=rate.ticks(resolved.armed_timeout_s),
        law_channel=max(0, len(setup.channels) - count),
        law_channel_count=count,
        part_channel=_first_channel(setup, part_channels(setup.derived)),
        part_channel_count=len(part_channels(setup.derived)),
    )


def _first_channel(setup: Setup, own: tuple[core.Channel, ...]) -> int:
    """Return the number of the first of a contiguous group of a row's channels."""
    return setup.channels.index(own[0]) if own else 0


def _law_channel_count(setup: Setup) -> int:
    """Return how many of a row's channels, after all others, are reports of the law."""
    own = law_channels(setup.controller.law)
    return len(own) if own and setup.channels[-len(own) :] == own else 0


def at_rate(key: str, value: float, rate: Rate) -> float:
    """Return a file's limit in samples of a rate."""
    timed = _TIMED.get(key)
    return float(value) if timed is None else timed(rate, float(value))


def _tare_most(setup: Setup, key: str) -> float:
    """Return the greatest allowed tare, by the rig's own limit; 0: any."""
    limit: Limit | None = getattr(setup.rig.limits, key)
    if limit is None or not limit.acts:
        return 0.0
    return setup.derived.limits.tare_share_most * limit.value


def _watched(limits: Limits, resolved: limits_file.Resolved, key: str, real: bool) -> Limit | None:
    """Return a limit as stated in a file, or else as derived."""
    given: Limit | None = getattr(limits, key)
    derived = resolved.derived.get(key)
    # A velocity limit always acts, whatever its action.
    acts = derived is not None and (derived.ends or isinstance(derived, VelocityLimit))
    if given is not None or derived is None or real or not acts:
        return derived if given is None else given
    return derived.model_copy(update={"action": "indicate"})


def first_parameters(setup: Setup, station: core.StationConfig) -> dict[str, Any]:
    """Return the settings at the beginning of a recording, generation 0 of its parameters.

    They are complete, because another version might derive them differently in a replay.
    """
    values = {"rfc_end_tick": setup.controller.rfc.end_tick, "station": station.plain()}
    return {"generation": 0, "tick": 0, "values": values}


def stop_decel_m_per_s2(rig: RigFile) -> float:
    """Return the deceleration of the drive's own stop, assumed to be the same without a link."""
    default: float = LinkTable.model_fields["stop_decel_m_per_s2"].default
    return default if rig.link is None else rig.link.stop_decel_m_per_s2


def rig_config(rig: RigFile, fs_hz: float = core.FS_HZ) -> core.RigConfig:
    """Return the virtual rig of a rig file at a sample rate."""
    displacement, force = sensor_configs(rig.sensors)
    return core.RigConfig(
        servo=servo_config(rig, Rate(fs_hz)),
        elements=specimen_elements(rig),
        displacement=displacement,
        force=force,
        load_cell=rig.rig.load_cell,
        seed=rig.rig.seed,
        extras=extra_sensor_configs(rig.sensors),
    )


def extra_sensor_configs(sensors: Sensors) -> tuple[core.ExtraSensorConfig, ...]:
    """Return the settings of a virtual rig's sensors besides displacement and force."""
    return tuple(
        core.ExtraSensorConfig(
            one.measures,
            1.0 if one.gain is None else one.gain,
            core.SensorConfig(one.noise_std, one.lsb, one.bias),
        )
        for one in sensors.extra
    )


def sensor_configs(sensors: Sensors) -> tuple[core.SensorConfig, core.SensorConfig]:
    """Return the settings of the displacement sensor and the load cell of a virtual rig."""
    x, f = sensors.displacement, sensors.force
    return (
        core.SensorConfig(x.noise_std_m, x.lsb_m, x.bias_m, x.range_m or 0.0),
        core.SensorConfig(f.noise_std_n, f.lsb_n, f.bias_n, f.range_n or 0.0),
    )


def servo_config(rig: RigFile, rate: Rate) -> core.ServoConfig:
    """Return the settings of the actuator; its transport delay becomes ``delay_samples``.

    Substeps are given for samples of 1/1024 s and have the same length at another rate.
    """
    given = rig.actuator.model_dump(exclude=set(TOLERANCES))
    samples = given.pop("delay_samples", 0) + given.pop("extra_delay_samples", 0)
    delay = rate.samples(samples) + given.pop("delay_s", 0.0) * rate.hz
    if "substeps" in given:
        given["substeps"] = math.ceil(given["substeps"] / rate.pace)
    return core.ServoConfig(
        hold=rig.rig.command_hold, period_s=rate.period_s, delay_samples=float(delay), **given
    )


def specimen_elements(rig: RigFile) -> tuple[core.ElementConfig, ...]:
    """Return the specimen's elements with their parameters in the core's order."""
    return tuple(core_element(item) for item in rig.specimen)


# ---- the reference simulation -------------------------------------------------------------------


def reference(setup: Setup, *, table_forces: bool | None = None) -> NDArray[np.void]:
    """Simulate the same structure joined to the specimen, without actuator and sensors.

    For a slow test this is the response of the structure in its own time, stretched to the
    laboratory's: velocity-dependent elements of the specimen contribute their full force.

    Args:
        setup: the test.
        table_forces: whether to include the forces of the table (moving mass, friction, viscous
            force) that a load cell at the actuator also measures; None: ``reference.table_forces``
            of the file.

    Returns:
        ``x_ref_m``, ``v_ref_mps``, ``f_ref_n`` at every tick, shape (n,).
    """
    elements = _reference_elements(setup, table_forces)
    structure = setup.derived.structure
    if structure is not None:
        from rthyb_rt.config.own_structure import OwnStructure

        # The elements of the model are slowed down as well, so that their force is complete.
        whole = (
            structure
            if isinstance(structure, OwnStructure)
            else structure.with_lack(setup.test.test.time_scale, -1.0)
        )
        return _rows_of_reference(*whole.reference(elements, setup.ag_mps2))
    rigid = [e for e in elements if e.kind not in _IMPLICIT]
    motion = motion_config(setup.test, setup.derived)
    # An inertial force would need the acceleration that it affects, a damper the velocity: both are
    # added where the integrator treats them implicitly.
    motion = replace(
        motion,
        added_mass_kg=sum(e.params[0] for e in elements if e.kind == "inertia"),
        damping_n_s_per_m=motion.damping_n_s_per_m
        + sum(e.params[0] for e in elements if e.kind == "viscous"),
    )
    return _rows_of_reference(*core.Motion(motion).reference(rigid, setup.ag_mps2))


def _rows_of_reference(
    x: NDArray[np.float64], v: NDArray[np.float64], force: NDArray[np.float64]
) -> NDArray[np.void]:
    return signal_units.reference_rows(*(one[:, np.newaxis] for one in (x, v, force)))


_IMPLICIT: Final = ("inertia", "viscous")
"""Elements that the reference adds to the mass and damping of the structure."""


def _reference_elements(setup: Setup, table_forces: bool | None) -> list[core.ElementConfig]:
    slow = setup.test.test.time_scale
    elements = [timescale.slowed(one, slow) for one in specimen_elements(setup.rig)]
    if setup.test.reference.table_forces if table_forces is None else table_forces:
        elements += table_elements(setup.rig)
    return elements


def reference_elements(setup: Setup) -> list[core.ElementConfig]:
    """Return the elements that produce the force of the reference simulation."""
    return [e for e in _reference_elements(setup, None) if e.kind not in _IMPLICIT]


def table_elements(rig: RigFile) -> list[core.ElementConfig]:
    """Return the elements of the table that a load cell at the actuator measures as well."""
    actuator = rig.actuator
    if actuator.kind != "servo-hydraulic" or rig.rig.load_cell != "actuator-end":
        return []
    return [
        core.element("inertia", m_kg=actuator.moving_mass_kg),
        core.element("viscous", c_n_s_per_m=actuator.viscous_n_s_per_m),
        core.element(
            "coulomb", fc_n=actuator.friction_n, width_m_per_s=actuator.friction_width_m_per_s
        ),
    ]


# ---- the recording ------------------------------------------------------------------------------


def blank(setup: Setup, clock: str) -> recording.RecordedTest:
    """Return the recording of a test before its first sample.

    Args:
        setup: the test.
        clock: "virtual", or a clock of `rthyb_rt.core.ticker`.
    """
    return recording.RecordedTest(
        samples=np.zeros(0, dtype=core.row_dtype(setup.channels, setup.controller.axis_count)),
        channels=setup.channels,
        fs_hz=setup.derived.fs_hz,
        ag_mps2=setup.ag_mps2,
        ground_motion=_provenance(setup),
        # A history is its own reference: no other motion of the specimen is expected.
        reference=setup.reference if setup.plan is None else None,
        test_toml=config.dump(setup.test),
        rig_toml=config.dump(setup.rig_file),
        axis_names=() if setup.group is None else setup.group.rig.names,
        interface_names=() if setup.group is None else setup.group.rig.directions,
        meta={
            **core.build_facts(),
            "rthyb_version": __version__,
            "git_hash": _git_hash(),
            "created_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "test_name": setup.test.test.name,
            "clock": clock,
            "end_reason": "unknown",
            "interrupted": False,
            **({recording.OMITTED: omitted} if (omitted := config.omitted(setup.rig_file)) else {}),
        },
    )


def _provenance(setup: Setup) -> dict[str, Any]:
    motion = setup.motion
    if setup.plan is not None:
        return {"name": motion.name, "source": "history of the test file", "excitation": "x, m"}
    return {
        **dict(motion.details),
        "name": motion.name,
        "source": motion.source,
        "pga_g": motion.pga_g,
        "interpolation": setup.test.ground_motion.interpolation,
    }


@functools.cache
def _git_hash() -> str:
    """Return the commit of the checkout that contains this package, or "" if it is installed."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return answer.stdout.strip()


# ---- replay -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Replay:
    """Result of running the inputs of a recording through this core again.

    Attributes:
        identical: whether every computed field agrees bit for bit.
        rows: number of compared rows.
        first_row, field: first difference, or None.
        largest: greatest difference by field, for fields that differ, in the field's unit.
        same_build: whether recording and replay used the same core: same sources, same compiler,
            same architecture.
    """

    identical: bool
    rows: int
    first_row: int | None
    field: str | None
    largest: dict[str, float]
    same_build: bool


def compare(rec: recording.RecordedTest, again: core.RecordArray) -> Replay:
    """Compare every recorded field with the rows that were computed again, shape (n,)."""
    samples = rec.samples
    first_row: int | None = None
    first_field: str | None = None
    largest: dict[str, float] = {}
    # Fields that its version did not record were derived from the others.
    further = [name for name in samples.dtype.names or () if "." in name]
    for name in (*recording.fields_of(rec.version), *further):
        recorded, computed = samples[name], again[name]
        # Bits, not values: -0.0 differs from 0.0, and a NaN equals itself.
        bits = _bits(name)
        differs = np.nonzero(recorded.view(bits) != computed.view(bits))[0]
        if not differs.size:
            continue
        with np.errstate(invalid="ignore", over="ignore"):
            gap = np.abs(recorded.astype(np.float64) - computed.astype(np.float64))[differs]
        largest[name] = float(np.max(np.where(np.isnan(gap), np.inf, gap)))
        if first_row is None or differs[0] < first_row:
            first_row, first_field = int(differs[0]), name
    facts = core.build_facts()
    return Replay(
        identical=first_row is None,
        rows=int(samples.size),
        first_row=first_row,
        field=first_field,
        largest=largest,
        same_build=all(rec.meta.get(key) == value for key, value in facts.items()),
    )


def _bits(name: str) -> str:
    return f"u{core.RECORD_DTYPE[name.partition('.')[0]].itemsize}"
