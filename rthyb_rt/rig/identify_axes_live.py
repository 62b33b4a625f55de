"""Identify several axes over their links, in real time and under all limits of the rig file.

Each axis is swept in turn while the others are commanded to hold still; all are read. The station
is that of a test: its numerical part is a mass so large that no force moves it, excited along one
axis by the ground motion. Limits, limiter and stops are therefore those of a test as well.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config import AxesRig, Limit
from rthyb_rt.core.sparse import SparseConfig, Symmetric
from rthyb_rt.errors import InputError, Problem, RthybError
from rthyb_rt.lab import axes_experiment, realtime
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.rig.commissioning.guided_motion import AxesConnection, LimitError, StoppedError
from rthyb_rt.rig.identification import (
    Progress,
    SineRows,
    SweepPlan,
    check,
    check_not_limited,
    check_read,
    command_of,
)
from rthyb_rt.rig.identify_axes import (
    NOT_SWEPT,
    AxesResult,
    SweepRun,
    result_of_runs,
    sweep_of,
)

if TYPE_CHECKING:
    from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]

_HEAVY_KG: Final = 1e15
"""Mass per direction: 100 kN move it by 1e-7 m in a minute, less than a sensor resolves."""


def identify_axes_live(
    connection: AxesConnection, sweep: SweepPlan | None = None, progress: Progress | None = None
) -> AxesResult:
    """Sweep every axis in turn and determine what a test needs; delays include those of the links.

    Args:
        connection: the rig; its file need not be identified.
        sweep: of each axis; the usual one by default.
        progress: called now and then with (ticks done, ticks of all sweeps).

    Raises:
        InputError: redundant actuators, invalid sweep, missing limits, no feedback, or an axis
            that does not follow.
        LimitError: a limit or a drive ended a sweep; the message names axis and cause.
        TimingError: this PC was late.
        StoppedError: the operator ended it.
        RthybError: as in `rthyb_rt.lab.realtime.run`.
    """
    sweep, rig = sweep or sweep_of(), connection.rig
    rig.refuse_redundant(*NOT_SWEPT)
    check(sweep)
    _check_limits(rig, sweep.amplitude_m)
    command, parts = command_of(sweep, rig.rate)
    runs, total = list[SweepRun](), len(rig.names) * command.size
    for k, name in enumerate(rig.names):

        def report(done: int, _: int, before: int = k * command.size) -> None:
            if progress is not None:
                progress(before + done, total)

        rec = _swept(connection, k, command, report)
        runs.append(_run_of(rec, rig, name, parts))
    return result_of_runs(rig, runs, parts)


def _check_limits(rig: AxesRig, amplitude_m: float) -> None:
    """Refuse to sweep axes without limits on position and force, or beyond those limits.

    Raises:
        InputError: lists every axis and key.
    """
    problems = []
    for name in rig.names:
        limits = rig.of_axis(name).limits
        for key, example in (("command_position_m", '"20 mm"'), ("force_n", '"5 kN"')):
            limit: Limit | None = getattr(limits, key)
            if limit is None or not limit.ends:
                problems.append(
                    Problem(
                        f"axis.{name}.limits.{key}",
                        f"{'missing' if limit is None else 'does not end the motion'}; no "
                        "axis is moved without a limit on position and on force that holds, ramps "
                        f"out or trips, such as {key} = {example}",
                    )
                )
        position = limits.command_position_m
        if position is not None and position.acts and amplitude_m > position.value:
            problems.append(
                Problem(
                    f"axis.{name}.limits.command_position_m",
                    f"{amplitude_m * 1e3:g} mm is more than the limit of "
                    f"{position.value * 1e3:g} mm; identify with a smaller amplitude "
                    "(--amplitude)",
                )
            )
    if problems:
        raise InputError(problems)


def setup_of(rig: AxesRig, axis: int, command_m: Floats) -> Setup:
    """Return a sweep of one axis, from 0, as the setup of a test.

    Args:
        rig: the rig, whose limits apply.
        axis: number of the swept axis.
        command_m: displacement of that axis at every tick, (n,).

    Raises:
        InputError: the values of the rig file are inconsistent.
    """
    rest = axes_experiment.at_rest(rig)
    assert rest.group is not None
    n, h = len(rig.names), rest.rate.period_s
    # The motion of that axis alone: exact for a matrix, to second order for pins.
    along: Floats = np.linalg.inv(rig.core_kinematics().jacobian())[:, axis].astype(np.float64)
    moved, wanted = np.zeros((command_m.size, n)), np.append(command_m, 0.0)
    moved[:, axis] = command_m
    pushed = moved @ np.array(rig.along_axes())
    derived = axes_experiment.following(rig, rest.group.derived, moved, pushed)
    part = SparseConfig(
        Symmetric.of(_HEAVY_KG * np.eye(n)),
        Symmetric.zero(n),
        load_kg=_HEAVY_KG * along,
        interfaces=tuple(((j, 1.0),) for j in range(n)),
        k_e_n_per_m=tuple(float(v) for v in np.diag(rig.k_e)),
        period_s=h,
    )
    acceleration = np.diff(wanted, 2, prepend=0.0, append=0.0) / h**2
    return replace(
        rest,
        ag_mps2=-acceleration[:-1],
        derived=replace(derived.axis[0], structure=rest.derived.structure),
        controller=replace(rest.controller, numerical=part),
        group=replace(rest.group, derived=derived),
    )


def _swept(
    connection: AxesConnection, axis: int, command: Floats, progress: Progress
) -> RecordedTest:
    """Carry out a sweep; the drives are at rest afterwards.

    Raises:
        LimitError, TimingError, StoppedError, RthybError: as `identify_axes_live`.
    """
    rig = connection.rig
    setup, operator = setup_of(rig, axis, command), realtime.Operator()
    links = [own.link for own in rig.axis]
    with connection.on_interrupt(operator.stop):
        rec = realtime.run(
            setup,
            connection.opened,
            clock=connection.clock,
            before_tick=connection.before_tick,
            progress=progress,
            operator=operator,
            # There is no report to continue with here.
            hold_s=0.0,
            require_realtime=any(link is not None and link.require_realtime for link in links),
            warn=connection.warn_once,
            resets=connection.resets,
        )
    cause = str(rec.meta["station"]["cause"])
    if cause != "completed":
        raise _broken_off(rec, rig.names[axis], cause)
    return rec


def _broken_off(rec: RecordedTest, name: str, cause: str) -> RthybError:
    message = f"the sweep of axis {name}: {rec.meta['end_reason']}"
    if cause in ("operator", "signal", "none"):
        return StoppedError(message)
    if cause in realtime.TIMING_CAUSES:
        return realtime.TimingError(message)
    return LimitError(
        f"{message}; identify with a smaller amplitude (--amplitude), or up to a lower frequency "
        "(--max-frequency)"
    )


def _run_of(rec: RecordedTest, rig: AxesRig, name: str, parts: list[SineRows]) -> SweepRun:
    """Return the signals of a sweep.

    Raises:
        InputError: a limit altered the command, or too few rows have a reading of every axis.
    """
    running = rec.running()
    fields = {
        key: np.column_stack([rec.axis(one)[key][running] for one in rig.names])
        for key in ("x_cmd_m", "x_meas_m", "f_meas_n", "missing")
    }
    fresh = rec.samples["flags"][running] & core.FLAGS["fresh"] != 0
    read = fresh & (fields["missing"] == 0).all(axis=1)
    try:
        check_not_limited(rec.samples[running], parts)
        check_read(read, parts)
    except InputError as error:
        raise InputError(f"the sweep of axis {name}: {error}") from error
    return SweepRun(fields["x_cmd_m"], fields["x_meas_m"], fields["f_meas_n"], read)
