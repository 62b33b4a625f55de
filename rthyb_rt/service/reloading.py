"""Rules for reloading a rig file: only limits may change, of one axis or of several."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.config import limits as limits_file
from rthyb_rt.rig.commissioning import certificate


def axes_of(rig: RigFile | AxesRig) -> list[str]:
    """Return the names of the axes; "" for a single axis."""
    return [name for _, name in certificate.each(rig)]


def changed(old: RigFile | AxesRig, new: RigFile | AxesRig) -> list[str]:
    """Return the names of the tables, apart from limits, in which two rig files differ."""
    before, after = _tables(old), _tables(new)
    names = dict.fromkeys((*before, *after))
    return [name for name in names if before.get(name) != after.get(name)]


def _tables(rig: RigFile | AxesRig) -> dict[str, Any]:
    found = rig.model_dump(exclude={"limits"})
    for axis in found.pop("axis", ()):
        name = axis.pop("name")
        found |= {f"axis.{name}.{key}": value for key, value in axis.items() if key != "limits"}
    return found


def looser(rig: RigFile | AxesRig, bound: RigFile | AxesRig) -> list[str]:
    """Return the keys of limits that are looser than in another file of the same axes."""
    found = []
    for (own, name), (other, _) in zip(certificate.each(rig), certificate.each(bound), strict=True):
        place = f"axis.{name}.limits" if name else "limits"
        found += [f"{place}.{key}" for key in limits_file.looser(own.limits, other.limits)]
    return found


def with_limits_of(rig: RigFile | AxesRig, other: RigFile | AxesRig) -> RigFile | AxesRig:
    """Return a rig file with the limits of another one of the same axes."""
    update: dict[str, Any] = {"limits": other.limits}
    if isinstance(rig, AxesRig) and isinstance(other, AxesRig):
        update["axis"] = [
            own.model_copy(update={"limits": theirs.limits})
            for own, theirs in zip(rig.axis, other.axis, strict=True)
        ]
    return rig.model_copy(update=update)


def limit_changes(old: RigFile | AxesRig, new: RigFile | AxesRig) -> str:
    """Return the change of each limit as text; the axes of both files are the same."""
    before = _limits(old)
    words = [
        f"{place}{name} {_limit(before[place][name])} -> {_limit(value)}"
        for place, limits in _limits(new).items()
        for name, value in limits.items()
        if value != before[place][name]
    ]
    return ", ".join(words) or "nothing has changed"


def _limits(rig: RigFile | AxesRig) -> dict[str, dict[str, Any]]:
    """Return the tables of limits of a file, by the prefix of their keys."""
    found = {"": rig.limits.model_dump()}
    if isinstance(rig, AxesRig):
        found |= {f"axis {axis.name}: ": axis.limits.model_dump() for axis in rig.axis}
    return found


def _limit(value: Any) -> str:
    """Return a limit as text, whether it is a table, a number, or None."""
    if value is None:
        return "unset"
    if not isinstance(value, Mapping):
        return f"{value:g}"
    return f"{value['value']:g} ({value['action'] if value['enable'] else 'off'})"
