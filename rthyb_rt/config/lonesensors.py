"""Sensors without an actuator: ``[[sensor]]`` in the rig file for several axes.

A displacement sensor or load cell at the specimen that belongs to none of the axes. Its readings
enter the pose, or the force along the interface, beside those of the axes.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import StrictBool

from rthyb_rt.config.fields import Condition, Point, Range, Text, nearest, written
from rthyb_rt.config.limits import (
    DisplacementLimit,
    ForceLimit,
    IncrementLimit,
    StepLimit,
    TimeLimit,
)
from rthyb_rt.config.rigfile import DisplacementSensor, ExtraSensor, ForceSensor, RigFile
from rthyb_rt.core.sizes import SENSORS_MAX

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rthyb_rt.core.kinematics import Pin

    Floats = NDArray[np.float64]

CHANNEL: Final = Text(
    "the name of the sensor",
    r"[a-z][a-z0-9_]{0,26}",
    "up to 27 characters of a-z 0-9 _ in quotes, starting with a letter",
)
_EXTRA: Final = Text(
    "the name of an extra channel",
    r"[a-z][a-z0-9_]{0,31}",
    "up to 32 characters of a-z 0-9 _ in quotes, starting with a letter",
)
LEAST_LENGTH_M: Final = 1e-6
"""Least distance of a pin from its base (kinematics.c)."""
_LEAST_SLOPE: Final = 1e-9
"""Least reading for a unit of a direction, m/m or m/rad: less is rounding of the coordinates."""
_STATE_ALONG: Final = "add along = { name = value }, its reading for a unit along each direction"
READ: Final = "_read"
"""Ends the name of the channel with the readings as received."""


AT: Final = Range("m", -1000, 1000, "a coordinate")
"""A coordinate of a pin or a base."""
COMPONENT: Final = Range("", -1e6, 1e6, "a component")


def _not_all_zero(along: dict[str, float] | None) -> str | None:
    if along is None or any(along.values()):
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

    With a matrix in ``[kinematics]``, ``along`` states what it reads for a unit of each direction
    of the interface; directions that it omits do not affect it. With pins, it measures the distance
    from ``base_m``, at rest, to ``pin_m`` on the coupler, or along ``direction``, from base to pin,
    if the base is far away; with ``pulls`` shortening is positive. ``extra`` names the extra
    channel of an axis in whose frames its reading arrives, which a test in real time needs; the
    range is then required.
    """

    checks: ClassVar[tuple[Condition, ...]] = _ALONG

    kind: Literal["displacement"]
    name: Annotated[str, CHANNEL]
    along: _Along | None = None
    pin_m: Annotated[list[float], Point("a pin", AT)] | None = None
    base_m: Annotated[list[float], Point("a base", AT)] | None = None
    direction: Annotated[list[float], Point("a direction", COMPONENT)] | None = None
    pulls: StrictBool | None = None
    extra: Annotated[str, _EXTRA] | None = None
    stuck_s: TimeLimit | None = None
    jump_m: IncrementLimit | None = None
    disagreement_m: DisplacementLimit | None = None

    @property
    def pin(self) -> Pin:
        """The sensor between its base and its pin, for the kinematics of the core."""
        from rthyb_rt.core.kinematics import Pin

        base = self.base_m if self.direction is None else self.direction
        assert self.pin_m is not None
        assert base is not None
        (px, py), (bx, by) = self.pin_m, base
        return Pin((px, py), (bx, by), self.direction is not None, bool(self.pulls))


class LoneForce(ForceSensor):
    """A load cell at the specimen that belongs to no axis.

    ``along`` states which share of the specimen's force in each direction it carries; ``extra`` is
    as for a displacement sensor.
    """

    checks: ClassVar[tuple[Condition, ...]] = _ALONG

    kind: Literal["force"]
    name: Annotated[str, CHANNEL]
    along: _Along
    extra: Annotated[str, _EXTRA] | None = None
    stuck_s: TimeLimit | None = None
    jump_n: StepLimit | None = None
    disagreement_n: ForceLimit | None = None


LoneSensor = LoneDisplacement | LoneForce


@dataclass(frozen=True)
class SensorOfAxes:
    """A sensor without an actuator, as seen from one axis that moves while the others hold still.

    Attributes:
        sensor: the sensor.
        axis: name of the axis in whose frames it is read.
        channel: its extra channel there, and ``number`` that of the channel, from 0.
        by_axis: its reading for a unit that the sensors of each axis read, m or N, (axes,): a sum
            over the directions.
        terms: the sum of the magnitudes of the terms of each, (axes,).
        per_m: change of its reading for 1 m of the axis that moves: m/m, or N/m by the elastic
            stiffness of the specimen.
        per_n: of a load cell, its change for 1 N at the load cell of the axis that moves; for a
            displacement sensor 0.
        most: its reading if that of every axis is at its limit of the rig file, m or N; 0: no
            limit.
        tare_most: greatest tare that zeroing accepts by these limits, likewise.
    """

    sensor: LoneSensor
    axis: str
    channel: ExtraSensor
    number: int
    by_axis: tuple[float, ...]
    terms: tuple[float, ...]
    per_m: float
    per_n: float
    most: float
    tare_most: float

    @property
    def is_cell(self) -> bool:
        """Whether it is a load cell."""
        return isinstance(self.sensor, LoneForce)

    @property
    def range(self) -> float:
        """The end of its range, m or N; every sensor in a frame has one."""
        one = self.sensor
        found = one.range_n if isinstance(one, LoneForce) else one.range_m
        assert found is not None
        return found


@dataclass(frozen=True)
class OneOfSeveral:
    """What one axis has in common with the others: sensors without an actuator.

    Attributes:
        name: of the axis.
        names: of all axes, in their order.
        others: the other axes by name, in their order, each as a rig of one axis.
        sensors: those that name an extra channel, in the order of the core, from whichever frames.
        meaning: what else in the rig file determines what their readings mean, as plain values: the
            names of the axes and the kinematics, each in its order.
    """

    name: str
    names: tuple[str, ...]
    others: dict[str, RigFile]
    sensors: tuple[SensorOfAxes, ...]
    meaning: dict[str, Any]


def tare_most(by_axis: Floats, most: Sequence[float]) -> float:
    """Return the greatest allowed tare of a sensor, m or N; 0: any.

    It is what the sensor reads if the tare of every axis is at its own limit, with the signs that
    add up; where an axis to which it responds has no limit, it has none.

    Args:
        by_axis: its reading for a unit of each axis, (axes,).
        most: the limit of each axis, m or N, (axes,); 0: none.
    """
    import numpy as np

    size, limit = np.abs(by_axis), np.array(most)
    felt = size > 1e-9 * size.max()
    return float(size @ limit) if (limit[felt] > 0.0).all() else 0.0


def rows_along(
    sensors: Sequence[LoneSensor], kind: str, directions: Sequence[str]
) -> list[list[float]] | None:
    """Return what the sensors of a kind read for a unit of each direction; None: there are none.

    Args:
        sensors: all of them.
        kind: "displacement" or "force".
        directions: names, in the order of the columns.
    """
    rows = [
        [(one.along or {}).get(j, 0.0) for j in directions] for one in sensors if one.kind == kind
    ]
    return rows or None


def in_order(sensors: Sequence[LoneSensor]) -> list[LoneSensor]:
    """Return the sensors in the order of the core: displacements, then forces."""
    return sorted(sensors, key=lambda one: one.kind != "displacement")


Extras = Sequence[Sequence[tuple[str, str]]]
"""Name and unit of the extra channels of each axis."""


def places(sensors: Sequence[LoneSensor], extras: Extras) -> list[tuple[int, int] | None]:
    """Return the axis and the number of the extra channel with the reading of each sensor.

    None for a sensor without ``extra``.
    """
    found = {
        name: (axis, number)
        for axis, own in enumerate(extras)
        for number, (name, _) in enumerate(own)
    }
    return [None if one.extra is None else found[one.extra] for one in sensors]


def extras_fault(
    sensors: Sequence[LoneSensor], extras: Extras, still: Collection[str] = ()
) -> str | None:
    """Return what is wrong with the extra channels that sensors name, or None.

    Args:
        sensors: all of them.
        extras: the extra channels of each axis.
        still: names of those whose scale is 0.
    """
    units = {name: unit for own in extras for name, unit in own}
    taken = dict[str, str]()
    for one in sensors:
        if one.extra is None:
            continue
        if one.extra not in units:
            known = ", ".join(units) or "none"
            return (
                f"{one.name}: found extra = {written(one.extra)}{nearest(one.extra, list(units))}; "
                f"it must name an [[axis.sensors.extra]]; the file has: {known}"
            )
        if one.extra in still:
            return (
                f"{one.name}: found extra = {written(one.extra)} with scale = 0, which makes every "
                "reading the same; correct the scale of the channel"
            )
        unit = "N" if one.kind == "force" else "m"
        if units[one.extra] != unit:
            return (
                f"{one.name}: found extra = {written(one.extra)} with the unit "
                f"{written(units[one.extra])}; a sensor of kind {one.kind} needs a channel in "
                f"{unit}: convert it by the channel's scale"
            )
        key, range_ = ("range_n", one.range_n) if one.kind == "force" else ("range_m", one.range_m)
        if range_ is None:
            return (
                f"{one.name}: {key} is missing; a sensor that is read through an extra channel "
                "needs it, because a reading at the end of its range must not count as one"
            )
        if one.extra in taken:
            return (
                f"sensors {taken[one.extra]} and {one.name} both name the extra channel "
                f"{one.extra}; each needs its own"
            )
        taken[one.extra] = one.name
    return None


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
        for name in one.along or ():
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
    faults = (
        _place_fault(one, kind) or _blind(one, kind, directions)
        for one in sensors
        if isinstance(one, LoneDisplacement)
    )
    return next((found for found in faults if found is not None), None)


def _place_fault(one: LoneDisplacement, kind: str) -> str | None:
    """Return what is wrong with the keys that state what a displacement sensor measures."""
    keys = [key for key in ("pin_m", "base_m", "direction") if getattr(one, key) is not None]
    keys += ["pulls"] if one.pulls else []
    if kind == "matrix":
        if keys:
            return (
                f"{one.name}: found {keys[0]}, which goes with pins; with kinematics of kind = "
                '"matrix" state what the sensor reads with along'
            )
        return None if one.along is not None else f"{one.name}.along: missing; {_STATE_ALONG}"
    if one.along is not None:
        return (
            f"{one.name}: found along, which goes with a matrix; with kinematics of kind = "
            f'"{kind}" give pin_m, the pin on the coupler, and base_m, from which it measures'
        )
    if one.pin_m is None or (one.base_m is None) == (one.direction is None):
        return (
            f"{one.name}: found {', '.join(keys) or 'no pin'}; with kinematics of kind = "
            f'"{kind}" give pin_m, the pin on the coupler, and either base_m, the point from '
            "which it measures, or, if that is far away, direction, from there to the pin"
        )
    (px, py), pin = one.pin_m, one.pin
    length = math.hypot(*pin.base_m) if pin.far else math.dist(pin.pin_m, pin.base_m)
    if length > LEAST_LENGTH_M:
        return None
    if pin.far:
        return (
            f"{one.name}: found direction = [{pin.base_m[0]:g}, {pin.base_m[1]:g}]; it needs the "
            f"direction from base to pin, longer than {LEAST_LENGTH_M:g}, such as [1, 0]"
        )
    return f"{one.name}: has its pin at its own base, [{px:g}, {py:g}] m"


def _blind(one: LoneDisplacement, kind: str, directions: Sequence[str]) -> str | None:
    """Return an error if a sensor between pins responds to no direction of the interface at rest.

    Its slopes there are the direction cosines of base to pin and the lever arm about the origin, as
    the core has them (kinematics.c).
    """
    if kind == "matrix":
        return None
    (px, py), pin = one.pin_m or (0.0, 0.0), one.pin
    ex, ey = pin.base_m if pin.far else (px - pin.base_m[0], py - pin.base_m[1])
    length = math.hypot(ex, ey)
    slopes = {"x": ex / length, "y": ey / length, "theta": (px * ey - py * ex) / length}
    if any(abs(slopes[name]) > _LEAST_SLOPE for name in directions if name in slopes):
        return None
    key, (bx, by) = ("direction" if pin.far else "base_m"), pin.base_m
    return (
        f"{one.name}: found pin_m = [{px:g}, {py:g}] and {key} = [{bx:g}, {by:g}]; with these its "
        f"reading at rest responds to none of the directions {', '.join(directions)}: mount it "
        "along the motion, or correct the coordinates"
    )
