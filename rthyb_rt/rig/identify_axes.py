"""Identify several coupled axes: each axis is swept in turn while all are read."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config import STANDARD, AxesRig, Rate, dump, parse_any_rig, response
from rthyb_rt.config.axes_response import held_otherwise
from rthyb_rt.config.axesfile import JointIdentified
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_rig
from rthyb_rt.rig.identification import (
    LOW_FREQUENCY_HZ,
    IdentificationResult,
    Progress,
    SineRows,
    SweepPlan,
    check,
    command_of,
    phasor,
    rest_rows,
    result_of,
    rounded,
    section_of,
)

Floats = NDArray[np.float64]

FREQUENCIES_HZ: Final = (
    *(0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0),
    *(12.0, 15.0, 20.0, 25.0, 30.0, 40.0),
)
"""Sweep for an inverse, which is used up to 10 Hz and must know the response beyond that."""


def sweep_of(amplitude_m: float = 2e-3) -> SweepPlan:
    """Return the sweep to which an inverse of several axes is fitted."""
    return SweepPlan(FREQUENCIES_HZ, amplitude_m)


@dataclass(frozen=True, eq=False)
class AxesResult:
    """Result of an identification of several axes.

    Attributes:
        response: the matrix of frequency responses, and the noise of each reading at rest.
        axes: each axis alone, as for a rig of one axis, while the others hold still.
        stiffness: of the specimen along the interface, from the slow sines, symmetric, (n, n).
        asymmetry: greatest difference of elements that should be equal, over the greatest element.
    """

    response: MatrixResponse
    axes: tuple[IdentificationResult, ...]
    stiffness: Floats
    asymmetry: float

    def as_json(self, filled: AxesRig) -> dict[str, Any]:
        """Return it as plain values, SI units.

        Args:
            filled: the rig as `identified_rig` returns it, for the names and the matrix.
        """
        assert filled.identified is not None
        named = zip(filled.names, self.axes, strict=True)
        return {
            "axes": {name: own.as_json() for name, own in named},
            "response": filled.identified.model_dump(exclude={"date"}),
            "stiffness": self.stiffness.tolist(),
            "asymmetry": self.asymmetry,
        }


@dataclass(frozen=True, eq=False)
class SweepRun:
    """Signals of the sweep of one axis, while the others are commanded to hold still.

    Attributes:
        command_m, x_m, f_n: of all axes, (n, axes) each: the reading of a row was latched when its
            command was applied.
        read: which rows contain a reading of every axis, (n,).
    """

    command_m: Floats
    x_m: Floats
    f_n: Floats
    read: NDArray[np.bool_]


NOT_SWEPT: Final = (
    "identification",
    "an axis that sweeps while the others hold still would work against them: identify each "
    "actuator before it is attached, and enter the values in [axis.identified]",
)

SLOW_HZ: Final = LOW_FREQUENCY_HZ


def identify_rig(
    rig: AxesRig, sweep: SweepPlan | None = None, progress: Progress | None = None
) -> AxesResult:
    """Sweep every axis of the virtual rig in turn while the others hold still.

    Args:
        rig: the rig file.
        sweep: of each axis; the usual one by default.
        progress: called with (ticks done, ticks of all sweeps) after each.

    Raises:
        InputError: invalid sweep, a limit or range was reached, or an axis did not follow.
    """
    rig.refuse_redundant(*NOT_SWEPT)
    sweep = sweep or sweep_of()
    check(sweep)
    command, parts = command_of(sweep)
    n, names = len(rig.axis), rig.names
    virtual = axes_rig.virtual_rig(rig)
    runs = list[SweepRun]()
    for column, name in enumerate(names):
        commands = np.zeros((command.size, n))
        commands[:, column] = command
        x, f = virtual.run(commands)
        _check_within(rig, name, commands, x, f)
        runs.append(SweepRun(commands, x, f, np.ones(command.size, np.bool_)))
        if progress is not None:
            progress((column + 1) * command.size, n * command.size)
    return result_of_runs(rig, runs, parts)


def result_of_runs(rig: AxesRig, runs: Sequence[SweepRun], parts: list[SineRows]) -> AxesResult:
    """Return the result of the sweeps of all axes.

    Args:
        rig: for its kinematics, and for messages.
        runs: one for each swept axis, in the rig's order.
        parts: rows of their sines.

    Raises:
        InputError: an axis did not follow.
    """
    found = tuple(
        result_of(
            rig.of_axis(name), run.command_m[:, k], run.x_m[:, k], run.f_n[:, k], parts, run.read
        )
        for k, (name, run) in enumerate(zip(rig.names, runs, strict=True))
    )
    axes, resting = len(runs), rest_rows(parts[0].rate)
    matrices = np.zeros((len(parts), axes, axes), np.complex128)
    noise = np.zeros(axes)
    for run in runs:
        noise += run.x_m[resting][run.read[resting]].var(axis=0, ddof=1) / axes
    for k, part in enumerate(parts):
        # If the others are commanded to hold still, the commands are a diagonal matrix.
        commanded, read = (_phasors(part, runs, name) for name in ("command_m", "x_m"))
        matrices[k] = read @ np.linalg.inv(commanded)
    frequencies = np.array([part.frequency_hz for part in parts])
    stiffness, asymmetry = _stiffness(rig, parts, runs)
    matrix = MatrixResponse(frequencies, matrices, np.sqrt(noise))
    return AxesResult(matrix, found, stiffness, asymmetry)


def _phasors(part: SineRows, runs: Sequence[SweepRun], name: str) -> NDArray[np.complex128]:
    """Return the complex amplitudes of a signal: rows are axes, columns the runs."""
    axes = range(len(runs))
    return np.array(
        [[phasor(part, getattr(run, name)[:, i], run.read)[0] for run in runs] for i in axes]
    )


def _check_within(rig: AxesRig, moving: str, u: Floats, x: Floats, f: Floats) -> None:
    """Refuse a sweep in which an axis reached the end of a sensor's range, or a limit."""
    for i, axis in enumerate(rig.axis):
        own, sensors = rig.of_axis(axis.name).limits, axis.sensors
        position, force = own.command_position_m, own.force_n
        h = core.PERIOD_S
        velocity = own.command_velocity_m_per_s
        met = [
            ("displacement", x[:, i], sensors.displacement.range_m, "m", "sensor's range"),
            ("force", f[:, i], sensors.force.range_n, "N", "load cell's range"),
            ("command", u[:, i], position.value if position else None, "m", "position limit"),
            ("force", f[:, i], force.value if force and force.acts else None, "N", "force limit"),
            (
                "command's velocity", np.diff(u[:, i]) / h,
                velocity.value if velocity and velocity.enable else None, "m/s", "velocity limit",
            ),
            (
                "command's acceleration", np.diff(u[:, i], 2) / h**2,
                own.command_acceleration_m_per_s2, "m/s^2", "acceleration limit",
            ),
        ]  # fmt: skip
        for what, values, limit, unit, name in met:
            peak = float(np.abs(values).max())
            if limit is not None and peak >= limit:
                raise InputError(
                    f"the {what} of axis {axis.name} reaches {peak:.3g} {unit} while axis {moving} "
                    f"is swept; its {name} is {limit:g} {unit}: identify with a smaller amplitude "
                    "(--amplitude), or up to a lower frequency",
                    "identify",
                )


def response_of(
    command: Floats, parts: list[SineRows], moved: Sequence[Floats], rest: slice
) -> MatrixResponse:
    """Return the matrix of responses from sweeps of one axis after another.

    Args:
        command: of the swept axis, (n,).
        parts: rows of its sines.
        moved: readings of each sweep, (n, axes) each.
        rest: rows before any motion.
    """
    axes, read = len(moved), np.ones(command.size, np.bool_)
    found = np.zeros((len(parts), axes, axes), np.complex128)
    noise = np.zeros(axes)
    for column, readings in enumerate(moved):
        noise += readings[rest].var(axis=0, ddof=1) / axes
        for k, part in enumerate(parts):
            commanded, _ = phasor(part, command, read)
            for row in range(axes):
                found[k, row, column] = phasor(part, readings[:, row], read)[0] / commanded
    return MatrixResponse(np.array([p.frequency_hz for p in parts]), found, np.sqrt(noise))


def _stiffness(
    rig: AxesRig, parts: list[SineRows], runs: Sequence[SweepRun]
) -> tuple[Floats, float]:
    """Return the stiffness along the interface, from forces and displacements of the slow sines."""
    axes = len(runs)
    slow = [part for part in parts if part.frequency_hz <= SLOW_HZ] or parts[:1]
    by_axis = np.zeros((axes, axes))
    for part in slow:
        x, f = (_phasors(part, runs, name) for name in ("x_m", "f_n"))
        by_axis += np.real(f @ np.linalg.inv(x)) / len(slow)
    jacobian = rig.core_kinematics().jacobian()
    along = jacobian.T @ by_axis @ jacobian
    apart = float(np.abs(along - along.T).max() / np.abs(along).max())
    return 0.5 * (along + along.T), apart


def identified_rig(rig: AxesRig, result: AxesResult) -> AxesRig:
    """Return the rig file with the results of each axis and of all axes together.

    Raises:
        InputError: a value that a rig file does not allow, such as a stiffness that is not positive
            definite.
    """
    axes = [
        axis.model_copy(
            update={"identified": section_of(own, response.hold_of(rig.of_axis(axis.name)))}
        )
        for axis, own in zip(rig.axis, result.axes, strict=True)
    ]

    def rows(matrix: Floats, digits: int = 5) -> list[list[float]]:
        return [[rounded(float(v), digits) for v in row] for row in matrix]

    # As in a rig file: for commands that are held for 1/1024 s.
    swept, rate = result.response, Rate(result.axes[0].sample_rate_hz)
    matrices = swept.response / held_otherwise(rig, swept.frequency_hz, rate)
    found = JointIdentified.model_construct(
        frequency_hz=result.response.frequency_hz.tolist(),
        real=[rows(one.real) for one in matrices],
        imaginary=[rows(one.imag) for one in matrices],
        rest_noise_displacement_m=[rounded(float(v), 3) for v in result.response.rest_noise_m],
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
    )
    info = rig.rig.model_copy(update={"elastic_stiffness": rows(result.stiffness)})
    filled = rig.model_copy(update={"rig": info, "axis": axes, "identified": found})
    again = parse_any_rig(dump(filled), "identified rig")
    assert isinstance(again, AxesRig)
    return again


def identify_axes(
    move: Callable[[Floats], Floats], axes: int, sweep: SweepPlan | None = None
) -> MatrixResponse:
    """Sweep every axis in turn while the others hold still, and return the response matrix.

    Args:
        move: carries out commands, m, (n, axes), from rest, and returns the readings, (n, axes):
            reading n was latched when command n was applied.
        axes: number of axes.
        sweep: of each axis; the usual one by default.
    """
    sweep = sweep or sweep_of()
    command, parts = command_of(sweep)
    rest = rest_rows(STANDARD)
    moved = []
    for column in range(axes):
        commands = np.zeros((command.size, axes))
        commands[:, column] = command
        moved.append(move(commands))
    return response_of(command, parts, moved, rest)
