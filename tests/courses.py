"""A test run through all states of a station, with an ideal specimen: a spring."""

from __future__ import annotations

import numpy as np
from kernels import Floats

from rthyb_rt import core


def course(one: core.Station, k_n_per_m: float, hold_at: int | None, ticks: int = 9000) -> Floats:
    """Return the displacements of the test proper; None: without a HOLD."""
    found: list[float] = []
    command = "zero"
    x = 0.0
    for n in range(ticks):
        if one.state == "ZEROED" and command == "none":
            command = "arm"
        elif one.state == "ARMED":
            command = "start"
        elif one.state == "RUNNING" and hold_at is not None and len(found) == hold_at:
            command, hold_at = "hold", None
        elif one.state == "HOLD" and n % 1000 == 999:
            command = "resume"
        before = one.state
        row = one.tick(x, k_n_per_m * x, command=command)  # type: ignore[arg-type]
        x, command = row.x_cmd_m, "none"
        if before == "RUNNING" and row.state == "RUNNING":
            found.append(x)
        if one.state == "RAMP_OUT":
            break
    return np.array(found)


def departure(held: Floats, straight: Floats, after: int) -> float:
    """Return the deviation of a held test from one that was not held, relative to its peak.

    The ticks of HOLD and of the return exist in only one of them and are omitted.
    """
    count = min(held.size, straight.size)
    apart = [
        np.abs(held[after : count - 40] - straight[after + s : count - 40 + s]).max()
        for s in range(4)
    ]
    return float(min(apart) / np.abs(straight).max())
