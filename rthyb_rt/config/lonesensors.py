"""Sensors without an actuator: ``[[sensor]]`` in the rig file for several axes.

A displacement sensor or load cell at the specimen that belongs to none of the axes. Its readings
enter the pose, or the force along the interface, beside those of the axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal

from rthyb_rt.config.fields import Condition, Range, Text, nearest, written
from rthyb_rt.config.limits import IncrementLimit, StepLimit, TimeLimit
from rthyb_rt.config.rigfile import DisplacementSensor, ForceSensor
from rthyb_rt.core.sizes import SENSORS_MAX

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CHANNEL: Final = Text(
    "the name of the sensor",
    r"[a-z][a-z0-9_]{0,26}",
    "up to 27 characters of a-z 0-9 _ in quotes, starting with a letter",
)
READ: Final = "_read"
"""Ends the name of the channel with the readings as received."""


def _not_all_zero(along: dict[str, float]) -> str | None:
    if any(along.values()):
        return None
    shown = ", ".join(f"{name} = {value:g}" for name, value in along.items()) or "no direction"
    return (
        f"found {shown}; state what the sensor reads for a unit along each direction to which it "
        "responds, such as along = { x = 1 }"
    )


_ALONG: Final = (Condition("along", ("along",), _not_all_zero),)
_Along = dict[
    Annotated[
        str,
        Text(
            "the name of a direction",
            r"[a-z][a-z0-9_-]{0,23}",
            "up to 24 characters of a-z 0-9 _ - in quotes, starting with a letter",
        ),
    ],
    Annotated[float, Range("", -1e6, 1e6, "its reading for a unit along a direction")],
]


class LoneDisplacement(DisplacementSensor):
    """A displacement sensor at the specimen that belongs to no axis.

    ``along`` states what it reads for a unit of each direction of the interface; directions that it
    omits do not affect it.
    """

    checks: ClassVar[tuple[Condition, ...]] = _ALONG

    kind: Literal["displacement"]
    name: Annotated[str, CHANNEL]
    along: _Along
    stuck_s: TimeLimit | None = None
    jump_m: IncrementLimit | None = None


class LoneForce(ForceSensor):
    """A load cell at the specimen that belongs to no axis.

    ``along`` states which share of the specimen's force in each direction it carries.
    """

    checks: ClassVar[tuple[Condition, ...]] = _ALONG

    kind: Literal["force"]
    name: Annotated[str, CHANNEL]
    along: _Along
    stuck_s: TimeLimit | None = None
    jump_n: StepLimit | None = None


LoneSensor = LoneDisplacement | LoneForce


def rows_along(
    sensors: Sequence[LoneSensor], kind: str, directions: Sequence[str]
) -> list[list[float]] | None:
    """Return what the sensors of a kind read for a unit of each direction; None: there are none.

    Args:
        sensors: all of them.
        kind: "displacement" or "force".
        directions: names, in the order of the columns.
    """
    rows = [[one.along.get(j, 0.0) for j in directions] for one in sensors if one.kind == kind]
    return rows or None


def in_order(sensors: Sequence[LoneSensor]) -> list[LoneSensor]:
    """Return the sensors in the order of the core: displacements, then forces."""
    return sorted(sensors, key=lambda one: one.kind != "displacement")


def values_of(sensors: Sequence[LoneSensor], samples: NDArray[np.void]) -> NDArray[np.float64]:
    """Return what a recording has of the sensors after the tare, m and N, (n, sensors).

    Args:
        sensors: in the order of the core.
        samples: rows of the recording, (n,).
    """
    import numpy as np

    found = [samples[one.name] for one in sensors]
    return np.column_stack(found) if found else np.empty((samples.size, 0))


def fault(sensors: Sequence[LoneSensor], directions: Sequence[str], kind: str) -> str | None:
    """Return what is wrong with the sensors of a rig with this kind of kinematics, or None."""
    names = [one.name for one in sensors]
    for i, one in enumerate(sensors):
        if one.name in names[:i]:
            first = names.index(one.name) + 1
            return f"sensors {first} and {i + 1} are both called {written(one.name)}"
        for name in one.along:
            if name not in directions:
                close = nearest(name, list(directions))
                return (
                    f"{one.name}: found along = {written(name)}{close}; the directions of the "
                    f"interface are {', '.join(directions)}"
                )
    for which in ("displacement", "force"):
        count = sum(one.kind == which for one in sensors)
        if count > SENSORS_MAX:
            return f'found {count} sensors of kind = "{which}"; there may be up to {SENSORS_MAX}'
    if sensors and kind != "matrix":
        return (
            f"found {len(sensors)} sensors without an actuator ({', '.join(names)}) with "
            f'kinematics of kind = "{kind}"; they need kind = "matrix", which states how their '
            "readings enter displacement and force of the interface"
        )
    return None
