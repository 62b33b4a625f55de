"""Names and units of the signals in a recording, also along several directions of the interface.

The signals of the first direction have no number, those of the second end with ``_1``. Names are
the same for displacements and rotations, but units are not: ``x_ref_m`` of a rotation is in rad.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import documents
from rthyb_rt.record.recording import AXIS_FIELDS, REFERENCE_UNITS, UNITS, RecordedTest

Floats = NDArray[np.float64]

_OF_ROTATIONS: Final = {"m": "rad", "m/s": "rad/s", "N": "N m", "N/m": "N m/rad"}
_OF_DIRECTION: Final = {name: UNITS[name] for name in ("x_num_m", "k_t_n_per_m")}
"""Fields of the samples that belong to a direction, with their units along a displacement."""


def units_of(axis_count: int = 1, *, first_turns: bool = False) -> dict[str, str]:
    """Return the units of the fields for a number of axes: "x_cmd_m.1" belongs to the second.

    Args:
        axis_count: number of axes.
        first_turns: whether the first direction, to which two of the fields belong, is a rotation.
    """
    further = {
        f"{name}.{axis}": UNITS[name] for axis in range(1, axis_count) for name in AXIS_FIELDS
    }
    return UNITS | _along(_OF_DIRECTION, (first_turns,)) | further


def of_samples(rec: RecordedTest) -> dict[str, str]:
    """Return the units of the fields and channels of a recording's samples."""
    found = units_of(rec.axis_count) | {one.name: one.unit for one in rec.channels}
    along = _along(_OF_DIRECTION, turns(rec))
    return found | {name: unit for name, unit in along.items() if name in found}


def of_reference(rec: RecordedTest) -> dict[str, str]:
    """Return the units of the reference simulation of a recording; empty without one."""
    names = () if rec.reference is None else rec.reference.dtype.names or ()
    along = _along(REFERENCE_UNITS, turns(rec) or (False,))
    return {name: unit for name, unit in along.items() if name in names}


def reference_names(directions: int) -> list[str]:
    """Return the fields of the reference simulation along so many directions."""
    return list(_along(REFERENCE_UNITS, (False,) * directions))


def is_of_reference(name: str) -> bool:
    """Whether a name is that of the reference simulation along some direction."""
    return name in REFERENCE_UNITS or name.rpartition("_")[0] in REFERENCE_UNITS


def reference_rows(x: Floats, v: Floats, force: Floats) -> NDArray[np.void]:
    """Return a reference simulation as it is recorded, (n,).

    Args:
        x, v, force: along the interface, (n, directions) each.
    """
    count = x.shape[1]
    rows = np.zeros(len(x), [(name, "<f8") for name in reference_names(count)])
    for j in range(count):
        for name, values in zip(REFERENCE_UNITS, (x, v, force), strict=True):
            rows[_numbered(name, j)] = values[:, j]
    return rows


def turns(rec: RecordedTest) -> tuple[bool, ...]:
    """Return which directions of a recording are rotations; empty for one axis."""
    try:
        tie = documents.toml(rec.rig_toml)["kinematics"]
        angles = ("theta",) if tie["kind"] == "pins" else tie.get("rotations", ())
        return tuple(name in angles for name in rec.interface_names)
    except (tomllib.TOMLDecodeError, KeyError, TypeError):
        return (False,) * len(rec.interface_names)


def _numbered(name: str, direction: int) -> str:
    return f"{name}_{direction}" if direction else name


def _along(units: Mapping[str, str], angles: Iterable[bool]) -> dict[str, str]:
    """Return names and units along every direction from those along one displacement."""
    return {
        _numbered(name, j): _OF_ROTATIONS[unit] if angle else unit
        for j, angle in enumerate(angles)
        for name, unit in units.items()
    }
