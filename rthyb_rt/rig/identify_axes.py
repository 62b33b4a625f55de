"""Identify several axes that feel one another: every axis is swept in turn, all are read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.rig.identify import REST_S, Sweep, command_of, phasor

Floats = NDArray[np.float64]

FREQUENCIES_HZ: Final = (
    *(0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0),
    *(12.0, 15.0, 20.0, 25.0, 30.0, 40.0),
)
"""Of a sweep for an inverse: it is used to 10 Hz, and must know what comes after."""


def sweep_of(amplitude_m: float = 2e-3) -> Sweep:
    """Return the sweep that an inverse of several axes is fitted to."""
    return Sweep(FREQUENCIES_HZ, amplitude_m)


def identify_axes(
    move: Callable[[Floats], Floats], axes: int, sweep: Sweep | None = None
) -> MatrixResponse:
    """Sweep every axis in turn while the others hold still, and work out the response matrix.

    Args:
        move: carries commands out, m, (n, axes), from rest, and returns the readings, (n, axes):
            reading n was latched when command n was applied.
        axes: how many.
        sweep: of each axis; the usual one by default.
    """
    sweep = sweep or sweep_of()
    command, parts = command_of(sweep)
    read = np.ones(command.size, np.bool_)
    rest = slice(round(0.2 * core.FS_HZ), round(REST_S * core.FS_HZ))
    found = np.zeros((len(parts), axes, axes), np.complex128)
    noise = np.zeros(axes)
    for column in range(axes):
        commands = np.zeros((command.size, axes))
        commands[:, column] = command
        readings = move(commands)
        noise += readings[rest].var(axis=0, ddof=1) / axes
        for k, part in enumerate(parts):
            told, _ = phasor(part, command, read)
            for row in range(axes):
                found[k, row, column] = phasor(part, readings[:, row], read)[0] / told
    return MatrixResponse(np.array(sweep.frequencies_hz), found, np.sqrt(noise))
