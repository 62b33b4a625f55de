"""Whether load cells without an actuator correct the forces of the axes by a usual share."""

from __future__ import annotations

from rthyb_rt.config import AxesRig

_ROUNDED = 1e-6
"""Entries of the file may be rounded to seven digits."""


def warnings(rig: AxesRig) -> list[str]:
    """Return a warning for each load cell whose correction is not within 0 to 1, with pins.

    The correction along a direction is the entry of ``cell_forces`` times the cell's ``along``: the
    share of a difference between cell and axes that enters the force.

    Args:
        rig: the rig file.
    """
    rows = getattr(rig.kinematics, "cell_forces", None)
    cells = [one for one in rig.lone_sensors if one.kind == "force"]
    found = list[str]()
    for i, cell in enumerate(cells):
        for name, row in zip(rig.directions, rows or (), strict=False):
            along = float(rig.along(cell)[rig.directions.index(name)])
            share = row[i] * along
            if not -_ROUNDED <= share <= 1.0 + _ROUNDED:
                found.append(
                    f"kinematics.cell_forces: found {row[i]:g} for load cell {cell.name} along "
                    f"{name}, which times its along = {along:g} is a correction of {share:g}; "
                    "usual is 0, only the load cells of the axes, to 1, only this cell: check "
                    "sign and unit"
                )
    return found
