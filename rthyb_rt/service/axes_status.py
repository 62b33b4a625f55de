"""Status of several axes in the status of the service, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rthyb_rt.config import AxesRig
from rthyb_rt.core import STOPPED_BIT

if TYPE_CHECKING:
    from rthyb_rt.service.rig_engine import Engine

_FIELDS: Final = ("x_cmd_m", "x_meas_m", "f_meas_n")
"""Fields of a row, followed by a point and the number of the axis."""
_CHANNELS: Final = ("alpha", "beta")
"""Channels of a row, followed by an underscore and the number of the axis."""


def of_axes(engine: Engine) -> dict[str, dict[str, Any]]:
    """Return newest values (units in their names), link and drive by axis; {} for one axis."""
    rig = engine.rig
    if not isinstance(rig, AxesRig):
        return {}
    delays = engine.loop.axis_delays
    wanted = _wanted(rig, engine.newest)
    found = {}
    for k, (name, way, delay) in enumerate(zip(rig.names, engine.ways, delays, strict=True)):
        row = engine.newest
        stopped = None if row is None else bool(int(row["flags"]) >> (STOPPED_BIT + k) & 1)
        values = {field: _value(row, f"{field}.{k}" if k else field) for field in _FIELDS}
        values |= {field: _value(row, f"{field}_{k}" if k else field) for field in _CHANNELS}
        found[name] = {
            "x_num_m": wanted[k],
            **values,
            "link_down": way.link.down,
            "drive_stopped": stopped,
            "link_delay_samples": delay,
            "wire": way.wire.counters(),
            "wire_counters": way.link.counters(),
        }
    return found


def _wanted(rig: AxesRig, row: np.void | None) -> list[float | None]:
    """Return the command of the numerical part for each axis, m."""
    pose = [_value(row, f"x_num_m_{j}" if j else "x_num_m") for j in range(len(rig.directions))]
    given = [value for value in pose if value is not None and np.isfinite(value)]
    if len(given) < len(pose):
        return [None] * len(rig.axis)
    found: list[float | None] = rig.core_kinematics().axes(given)[0].tolist()
    return found


def of_directions(engine: Engine) -> dict[str, dict[str, Any]]:
    """Return command and tangent stiffness by direction of the interface; {} for one axis.

    ``x_num``, of the numerical part, is in ``unit``, m or rad; ``k_t`` in N or N m per unit.
    """
    rig = engine.rig
    if not isinstance(rig, AxesRig):
        return {}
    return {
        name: {
            "x_num": _value(engine.newest, f"x_num_m_{j}" if j else "x_num_m"),
            "k_t": _value(engine.newest, f"k_t_n_per_m_{j}" if j else "k_t_n_per_m"),
            "unit": "rad" if turns else "m",
        }
        for j, (name, turns) in enumerate(zip(rig.directions, rig.kinematics.turns(), strict=True))
    }


def _value(row: np.void | None, field: str) -> float | None:
    if row is None or field not in (row.dtype.names or ()):
        return None
    return float(row[field])
