"""The rig file for several actuators on one specimen: ``[[axis]]``, ``[kinematics]``.

An axis consists of the same tables that a rig with one axis has at the top level of its file.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import Field, GetJsonSchemaHandler
from pydantic_core import CoreSchema, ErrorDetails

from rthyb_rt.config import plantpoles
from rthyb_rt.config.fields import (
    SLUG,
    SOME_TEXT,
    Alternatives,
    Condition,
    Count,
    OneOf,
    Point,
    Range,
    Reader,
    Table,
    Text,
    WholeFile,
    explained,
    nearest,
    written,
)
from rthyb_rt.config.limits import DEFAULT_TARE_SHARE_MOST, DisplacementLimit, ForceLimit, Limits
from rthyb_rt.config.lonesensors import (
    AT,
    COMPONENT,
    LoneDisplacement,
    LoneSensor,
    OneOfSeveral,
    SensorOfAxes,
    extras_fault,
    in_order,
    places,
    rows_along,
    tare_most,
)
from rthyb_rt.config.lonesensors import fault as lone_fault
from rthyb_rt.config.rate import STANDARD, Rate
from rthyb_rt.config.rigfile import (
    ASSUMED,
    MAX_ELEMENTS,
    Actuator,
    Calibration,
    DisplacementSensor,
    ForceSensor,
    Identified,
    LinkTable,
    PureDelay,
    RigFile,
    RigInfo,
    Sensors,
    SpecimenElement,
    StiffnessElement,
    assumable,
    assumed_faults,
    assumed_of,
    extras_arrive,
    not_rising,
    with_assumed,
)
from rthyb_rt.core.sizes import COUPLED_MAX, SENSORS_MAX
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.core.kinematics import Kinematics as CoreKinematics
    from rthyb_rt.core.kinematics import Pin
    from rthyb_rt.core.library import FloatArray as Floats

AXES_MAX: Final = COUPLED_MAX
MEASURED_MAX: Final = COUPLED_MAX + SENSORS_MAX
"""Largest number of displacements, or of forces, that are measured."""
STATES_MAX: Final = 32
"""Largest number of states of a plant."""
COMMON_LIMITS: Final[tuple[str, ...]] = (
    "tracking_indicator_slope_m2_per_s",
    "energy_error_j",
    "lost_pairs_share",
    "lost_pairs_warning_share",
    "skipped_ticks_share",
    "skipped_ticks_warning_share",
    "path_velocity_m_per_s",
    "path_acceleration_m_per_s2",
    "brake_acceleration_m_per_s2",
    "ramp_in_s",
    "armed_timeout_s",
    "tare_s",
)
"""Limits common to all axes: they move together, and if one ends the test it ends for all."""

Rows = list[list[float]]


def _name(what: str) -> Text:
    return Text(
        what,
        r"[a-z][a-z0-9_-]{0,23}",
        "up to 24 characters of a-z 0-9 _ - in quotes, starting with a letter",
    )


AXIS_NAME: Final = _name("the name of an axis")
DIRECTION: Final = _name("the name of a direction")


@dataclass(frozen=True)
class MatrixOf(Reader):
    """Rows of numbers, all of the same length.

    Attributes:
        what: description of the matrix.
        most: maximum number of rows and columns.
        square, symmetric: whether it must be so.
        size: allowed magnitude of each number.
        example: a matrix that is accepted, as written in a file.
    """

    what: str
    most: int = AXES_MAX
    square: bool = True
    symmetric: bool = False
    size: float = 1e12
    example: str = "[[1, 0], [0, 1]]"

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        form = "symmetric" if self.symmetric else "square" if self.square else "of equal rows"
        return (
            f"{self.what} must be a list of 1 to {self.most} rows of numbers up to {self.size:g}, "
            f"{form}: {self.example}"
        )

    def read(self, value: object) -> Rows:
        """Return the rows; raise an explained error if they are invalid."""
        rows = value if isinstance(value, list) else []
        if not 1 <= len(rows) <= self.most or not all(isinstance(row, list) for row in rows):
            raise explained(f"found {written(value)}; {self.allowed()}")
        widths = {len(row) for row in rows}
        if len(widths) > 1 or not 1 <= max(widths) <= self.most:
            raise explained(
                f"found rows of {', '.join(str(len(row)) for row in rows)} numbers; "
                f"{self.allowed()}"
            )
        if self.square and widths != {len(rows)}:
            raise explained(f"found {len(rows)} rows of {max(widths)} numbers; {self.allowed()}")
        found = [[self._number(v, i, j) for j, v in enumerate(row)] for i, row in enumerate(rows)]
        if self.symmetric:
            self._check_symmetric(found)
        return found

    def _number(self, value: object, i: int, j: int) -> float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        # NaN fails the comparison.
        if number and abs(value) <= self.size:  # type: ignore[arg-type]
            return float(value)  # type: ignore[arg-type]
        raise explained(f"found {written(value)} in row {i + 1}, column {j + 1}; {self.allowed()}")

    def _check_symmetric(self, rows: Rows) -> None:
        largest = max(abs(v) for row in rows for v in row)
        for i, row in enumerate(rows):
            for j in range(i):
                if abs(row[j] - rows[j][i]) > 1e-9 * largest:
                    raise explained(
                        f"found {row[j]:g} in row {i + 1}, column {j + 1} and {rows[j][i]:g} in "
                        f"row {j + 1}, column {i + 1}; {self.allowed()}"
                    )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the rows."""
        row = {"type": "array", "items": {"type": "number"}, "maxItems": self.most}
        return {"type": "array", "items": row, "maxItems": self.most, "description": self.what}


@dataclass(frozen=True)
class Different(Reader):
    """A list of different names.

    Attributes:
        one: field of each name.
        least: minimum number of names.
    """

    one: Reader
    least: int = 0

    def read(self, value: object) -> list[str]:
        """Return the names; raise an explained error if they are invalid."""
        if not isinstance(value, list) or not self.least <= len(value) <= AXES_MAX:
            raise explained(
                f"found {written(value)}; must be a list of {self.least} to {AXES_MAX} names"
            )
        found = [str(self.one.read(v)) for v in value]
        for name in found:
            if found.count(name) > 1:
                raise explained(f"found {written(name)} twice; each name may appear only once")
        return found

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the list."""
        return {"type": "array", "items": {"type": "string"}, "maxItems": AXES_MAX}


# ---- one axis ------------------------------------------------------------------------------------


def _only_its_own(limits: Limits) -> str | None:
    common = [key for key in COMMON_LIMITS if getattr(limits, key) is not None]
    if not common:
        return None
    return (
        f"found {common[0]}, which applies to all axes together: move it to the [limits] table "
        "of the file"
    )


class AxisDisplacement(DisplacementSensor):
    """The displacement sensor of one of several axes."""

    disagreement_m: DisplacementLimit | None = None


class AxisForce(ForceSensor):
    """The load cell of one of several axes."""

    disagreement_n: ForceLimit | None = None


class AxisSensors(Sensors):
    """The sensors of one of several axes."""

    displacement: AxisDisplacement = Field(default_factory=AxisDisplacement)
    force: AxisForce = Field(default_factory=AxisForce)


class Axis(Table):
    """One actuator with its sensors, limits and link; ``elastic_stiffness_n_per_m`` is not its own.

    Without ``actuator`` the file must have a ``[plant]``.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("limits", ("limits",), _only_its_own),
        Condition("sensors", ("sensors", "link"), extras_arrive),
    )

    name: Annotated[str, AXIS_NAME]
    actuator: Annotated[Actuator, Field(discriminator="kind")] | None = None
    sensors: AxisSensors = Field(default_factory=AxisSensors)
    identified: Identified | None = None
    link: LinkTable | None = None
    calibration: Calibration = Field(default_factory=Calibration)
    limits: Limits = Field(default_factory=Limits)


# ---- kinematics ----------------------------------------------------------------------------------


class MatrixKinematics(Table):
    """Displacements of the axes = ``matrix`` times those of the interface: rows are axes.

    ``interface`` names the columns; those of ``rotations`` are angles in rad, the others in m.
    There may be more axes than directions: the actuators are then redundant.

    ``forces`` times the forces of the load cells are those along the interface; by default it is
    the transposed matrix, which holds for load cells in line with the axes. ``displacements`` times
    the measured displacements of the axes are those of the interface; by default it is the inverse
    of the matrix, or its least-squares inverse. Rows of both are directions, columns are axes,
    followed by the load cells, or the displacement sensors, without an actuator (``[[sensor]]``).
    """

    kind: Literal["matrix"]
    interface: Annotated[list[str], Different(DIRECTION, 1)]
    matrix: Annotated[Rows, MatrixOf("the matrix", square=False, size=1e6)]
    rotations: Annotated[list[str], Different(DIRECTION)] = Field(default_factory=list)
    forces: Annotated[Rows, MatrixOf("forces", MEASURED_MAX, square=False, size=1e6)] | None = None
    displacements: (
        Annotated[Rows, MatrixOf("displacements", MEASURED_MAX, square=False, size=1e6)] | None
    ) = None

    def turns(self) -> list[bool]:
        """Return which directions are angles."""
        return [name in self.rotations for name in self.interface]


COORDINATES: Final = ("x", "y", "theta")


class PinKinematics(Table):
    """Axes from bases to pins of a rigid coupler, in its plane: exact for motions of any size.

    Points are given at rest, relative to the point whose motion is the interface. If an axis is in
    ``directions``, its base is so far away that the axis never rotates; its direction from base to
    pin is given instead of the base. For axes in ``pulls``, shortening is positive.

    ``cell_forces`` states how load cells without an actuator (``[[sensor]]``) correct the forces
    that follow from those of the axes: rows are directions, columns such load cells. It is
    multiplied by the difference between what each reads and what it should by ``along``.
    """

    kind: Literal["pins"]
    interface: Annotated[list[str], Different(OneOf(COORDINATES), 1)]
    pins_m: dict[Annotated[str, AXIS_NAME], Annotated[list[float], Point("a pin", AT)]]
    bases_m: dict[Annotated[str, AXIS_NAME], Annotated[list[float], Point("a base", AT)]] = Field(
        default_factory=dict
    )
    directions: dict[
        Annotated[str, AXIS_NAME],
        Annotated[list[float], Point("a direction", COMPONENT)],
    ] = Field(default_factory=dict)
    pulls: Annotated[list[str], Different(AXIS_NAME)] = Field(default_factory=list)
    cell_forces: (
        Annotated[Rows, MatrixOf("cell_forces", SENSORS_MAX, square=False, size=1e6)] | None
    ) = None

    def turns(self) -> list[bool]:
        """Return which directions are angles."""
        return [name == "theta" for name in self.interface]


Kinematics = MatrixKinematics | PinKinematics


def core_kinematics(
    given: Kinematics, axes: Sequence[str], sensors: Sequence[LoneSensor] = ()
) -> CoreKinematics:
    """Return the kinematics of axes, in their order, and of the sensors without an actuator.

    Raises:
        CoreError: a direction of the interface is not restrained by the axes.
    """
    from rthyb_rt.core.kinematics import Kinematics as CoreKinematics

    if isinstance(given, MatrixKinematics):
        return CoreKinematics(
            given.matrix,
            forces=given.forces,
            displacements=given.displacements,
            reads=rows_along(sensors, "displacement", given.interface),
            carries=rows_along(sensors, "force", given.interface),
        )
    return CoreKinematics(
        pins=[_pin_of_axis(given, name) for name in axes],
        coordinates=given.interface,  # type: ignore[arg-type]
        forces=given.cell_forces,
        carries=rows_along(sensors, "force", given.interface),
        sensor_pins=[one.pin for one in in_order(sensors) if isinstance(one, LoneDisplacement)],
    )


def _pin_of_axis(given: PinKinematics, name: str) -> Pin:
    from rthyb_rt.core.kinematics import Pin

    far = name in given.directions
    bx, by = given.directions[name] if far else given.bases_m[name]
    px, py = given.pins_m[name]
    return Pin((px, py), (bx, by), far, name in given.pulls)


def _kinematics_fault(
    axes: list[Axis], given: Kinematics, sensors: list[LoneSensor] | None
) -> str | None:
    sensors = sensors or []
    if lone_fault(sensors, given.interface, given.kind):
        return None
    names, n = [axis.name for axis in axes], len(axes)
    shown = ", ".join(names)
    m = len(given.interface)
    by_matrix = isinstance(given, MatrixKinematics)
    if m > n or (m < n and not by_matrix):
        rule = (
            "there must be at least as many axes as directions"
            if by_matrix
            else "with pins, the number of directions must equal the number of axes; redundant "
            'actuators, more than there are directions, need kind = "matrix"'
        )
        return f"found {m} directions ({', '.join(given.interface)}) and {n} axes ({shown}); {rule}"
    if isinstance(given, MatrixKinematics):
        fault = _matrix_fault(given, names, sensors)
        if fault:
            return fault
        strange = [one for one in given.rotations if one not in given.interface]
        if strange:
            return f"found the rotation {written(strange[0])}; it must be one of interface"
    else:
        fault = _pins_fault(names, given) or _cell_forces_fault(given, sensors)
        if fault:
            return fault
    from rthyb_rt.core.library import CoreError

    try:
        core_kinematics(given, names, sensors)
    except CoreError:
        return _left_free(given, names, sensors)
    return _opposing_fault(given, names, sensors)


def _matrix_fault(
    given: MatrixKinematics, names: list[str], sensors: Sequence[LoneSensor]
) -> str | None:
    axes, along = ", ".join(names), ", ".join(given.interface)
    n, m = len(names), len(given.interface)
    if len(given.matrix) != n:
        return f"found {len(given.matrix)} rows; must be {n}, one for each axis ({axes})"
    if len(given.matrix[0]) != m:
        return (
            f"found rows of {len(given.matrix[0])} numbers; each must have {m}, one for each "
            f"direction ({along})"
        )
    for key, kind in (("forces", "force"), ("displacements", "displacement")):
        rows = getattr(given, key)
        lone = [one.name for one in sensors if one.kind == kind]
        also = f" and each sensor of kind {kind} ({', '.join(lone)})" if lone else ""
        if rows is not None and (len(rows), len(rows[0])) != (m, n + len(lone)):
            return (
                f"{key}: found {len(rows)} rows of {len(rows[0])} numbers; must be {m} rows, one "
                f"for each direction ({along}), of {n + len(lone)} numbers, one for each axis "
                f"({axes}){also}"
            )
        if rows is None and lone and key == "forces":
            return (
                f"forces is missing; with the load cell {lone[0]}, which belongs to no axis, state "
                f"how the force along each direction ({along}) follows from the load cells of the "
                f"axes ({axes}){also}"
            )
    return None


_ROUNDED: Final = 1e-6
"""Of a product of matrices, relative: entries may be rounded to seven digits (kinematics.c)."""


def _opposing_fault(
    given: Kinematics, names: list[str], sensors: Sequence[LoneSensor]
) -> str | None:
    """Refuse ``forces`` that take the actuators' opposing forces for a force of the specimen.

    The load cells of redundant axes also measure forces g by which the actuators push against each
    other. They have no resultant, B^T g = 0 with B the matrix, and the specimen does not feel them.
    """
    if not isinstance(given, MatrixKinematics) or given.forces is None:
        return None
    if not any(one.kind == "force" for one in sensors) or len(names) == len(given.interface):
        return None
    import numpy as np

    matrix = np.array(given.matrix)
    of_axes = np.array(given.forces)[:, : len(names)]
    # Each row of B^T belongs to one direction, whose unit must not matter.
    against = np.linalg.svd((matrix / np.linalg.norm(matrix, axis=0)).T)[2][matrix.shape[1] :]
    found = of_axes @ against.T
    felt = np.abs(found) > _ROUNDED * np.maximum(1.0, np.abs(of_axes) @ np.abs(against.T))
    if not felt.any():
        return None
    row, column = np.argwhere(felt)[0]
    pushes = against[column] / np.abs(against[column]).max()
    pushes[np.abs(pushes) < _ROUNDED] = 0.0
    shown = ", ".join(f"{name} {push:.6g} N" for name, push in zip(names, pushes, strict=True))
    force = found[row, column] / np.abs(against[column]).max()
    return (
        f"forces: found the row {_shown([given.forces[row]])} for {given.interface[row]}, which "
        f"gives {force:.6g} for forces by which the actuators only push against each other "
        f"({shown}); the load cells of the axes measure them, the specimen does not feel them: "
        "the columns of the axes must be combinations of those of the matrix"
    )


def _pins_fault(names: list[str], given: PinKinematics) -> str | None:
    for key in ("pins_m", "bases_m", "directions", "pulls"):
        for name in getattr(given, key):
            if name not in names:
                close = nearest(name, names)
                return f"{key}: found {written(name)}{close}; the axes are {', '.join(names)}"
    for name in names:
        if name not in given.pins_m:
            return f"pins_m: axis {name} is missing; every axis has a pin"
        if (name in given.bases_m) == (name in given.directions):
            both = "both bases_m and" if name in given.bases_m else "neither bases_m nor"
            return (
                f"axis {name} is listed in {both} directions; list it in exactly one of the two: "
                "in bases_m with the position of its base or, if the base is far away, in "
                "directions with the direction from the base to the pin"
            )
        pin = given.pins_m[name]
        if name in given.bases_m and _apart(pin, given.bases_m[name]) <= 1e-6:
            return f"axis {name} has its pin at its own base, [{pin[0]:g}, {pin[1]:g}] m"
        if name in given.directions and _apart(given.directions[name], [0.0, 0.0]) <= 1e-6:
            x, y = given.directions[name]
            return (
                f"directions: found [{x:g}, {y:g}] for axis {name}; it needs the direction from "
                "base to pin, longer than 1e-06, such as [1, 0]"
            )
    return None


def _cell_forces_fault(given: PinKinematics, sensors: Sequence[LoneSensor]) -> str | None:
    cells, along = [one.name for one in sensors if one.kind == "force"], ", ".join(given.interface)
    rows = given.cell_forces
    if rows is None and not cells:
        return None
    shape = (len(given.interface), len(cells))
    if rows is not None and (len(rows), len(rows[0])) == shape:
        return None
    found = "is missing" if rows is None else f"found {len(rows)} rows of {len(rows[0])} numbers"
    if not cells:
        return f"cell_forces: {found}, but the file has no [[sensor]] of kind force; remove it"
    return (
        f"cell_forces: {found}; must be {shape[0]} rows, one for each direction ({along}), of "
        f"{shape[1]} numbers, one for each load cell without an actuator ({', '.join(cells)}): "
        "the force by which 1 N more than expected at that cell corrects the force along each "
        "direction, such as 0.5 / 0.4 for half of the correction by a cell with along = 0.4"
    )


def _apart(a: Sequence[float], b: Sequence[float]) -> float:
    return float(((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2) ** 0.5)


def _singular(given: MatrixKinematics, sensors: Sequence[LoneSensor]) -> str:
    from rthyb_rt.core.kinematics import Kinematics as CoreKinematics
    from rthyb_rt.core.library import CoreError

    along = ", ".join(given.interface)
    try:
        CoreKinematics(given.matrix)
    except CoreError:
        what = (
            "one of which is a combination of the others"
            if len(given.matrix) == len(given.interface)
            else "one of whose columns is a combination of the others"
        )
        return (
            f"found the rows {_shown(given.matrix)}, {what}, so some motion of the interface moves "
            "no axis; the matrix must not be singular"
        )
    reads = rows_along(sensors, "displacement", given.interface)
    if given.displacements is not None:
        try:
            CoreKinematics(given.matrix, displacements=given.displacements, reads=reads)
        except CoreError:
            found = _times(given.displacements, [*given.matrix, *(reads or ())])
            below = " with the sensors' along below it" if reads else ""
            return (
                f"displacements: found rows that times matrix{below} give {_shown(found)}; must be "
                f"the identity, so that every motion along {along} is measured as it is, and no "
                "other"
            )
    elif reads is not None:
        try:
            CoreKinematics(given.matrix, reads=reads)
        except CoreError:
            return (
                f"matrix: found the rows {_shown(given.matrix)}, and below them those of the "
                f"displacement sensors (along) {_shown(reads)}; one of their columns is, almost, "
                "zero or a combination of the others, so their readings together do not determine "
                f"the position along {along} precisely enough: correct them, or choose with "
                "displacements which sensors determine it"
            )
    carries = rows_along(sensors, "force", given.interface)
    if carries is not None and given.forces is not None:
        of_axes = CoreKinematics(given.matrix).back().T.tolist()
        found = _times(given.forces, [*of_axes, *carries])
        return (
            "forces: found rows that, from the forces that the load cells of axes and sensors "
            f"measure for a unit force of the specimen in each direction ({along}), give "
            f"{_shown(found)}; must be the identity. The load cells of the axes are in line with "
            f"them and measure {_shown(of_axes)}, the sensors (along) {_shown(carries)}"
        )
    if given.forces is None:
        return (
            f"matrix: found the rows {_shown(given.matrix)}, which are, almost, combinations of "
            f"one another, so the forces along {along} are not determined; some rows must differ "
            "more"
        )
    return (
        f"forces: found the rows {_shown(given.forces)}, one of which is zero or a combination of "
        f"the others; the load cells must determine the force along each direction ({along}) by "
        "itself"
    )


def _times(rows: Rows, columns: Rows) -> Rows:
    import numpy as np

    found: Rows = (np.array(rows) @ np.array(columns)).tolist()
    return found


def _shown(rows: Rows) -> str:
    return "; ".join(f"[{', '.join(f'{v:.6g}' for v in row)}]" for row in rows)


def _left_free(given: Kinematics, names: list[str], sensors: Sequence[LoneSensor] = ()) -> str:
    """Return why the axes do not restrain the interface."""
    if isinstance(given, MatrixKinematics):
        return _singular(given, sensors)
    for i, one in enumerate(names):
        for other in names[:i]:
            if _apart(given.pins_m[one], given.pins_m[other]) <= 1e-6:
                at = given.pins_m[one]
                return (
                    f"the pins of {other} and {one} coincide at [{at[0]:g}, {at[1]:g}] m, so the "
                    f"axes do not prevent motion along {', '.join(given.interface)}; give each "
                    "axis its own pin"
                )
    return (
        f"the axes {', '.join(names)} do not prevent every motion along "
        f"{', '.join(given.interface)}: no two axes may lie on one line, and with theta the axes "
        "may not all meet in one point; check pins_m and bases_m"
    )


# ---- specimen ------------------------------------------------------------------------------------


def _least_eigenvalue(rows: Rows) -> tuple[float, float]:
    import numpy as np

    values = np.linalg.eigvalsh(np.array(rows))
    return float(values[0]), float(np.abs(values).max())


def _holds(stiffness: Rows) -> str | None:
    least, most = _least_eigenvalue(stiffness)
    if least > 1e-9 * most:
        return None
    return (
        f"found a matrix with an eigenvalue of {least:.3g}; the elastic stiffness must be "
        "positive definite: check for a wrong sign, or for a direction without stiffness"
    )


def _not_negative(what: str) -> Any:
    def test(rows: Rows | None) -> str | None:
        if rows is None:
            return None
        least, most = _least_eigenvalue(rows)
        if least >= -1e-9 * most:
            return None
        return (
            f"found a matrix with an eigenvalue of {least:.3g}; {what} must not be negative in any "
            "direction"
        )

    return test


def _same_size(stiffness: Rows, rows: Rows | None) -> str | None:
    if rows is None or len(rows) == len(stiffness):
        return None
    return f"found {len(rows)} rows; must be {len(stiffness)}, as many as stiffness has"


class Along(Table):
    """An element of the catalogue along one direction of the interface."""

    along: Annotated[str, DIRECTION]
    law: Annotated[SpecimenElement, Field(discriminator="element")]

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition(
            "law",
            ("law",),
            lambda law: (
                f"found {written(law.element)}; enter a mass in the mass of the specimen"
                if law.element in ("inertia", "second_mode")
                else None
            ),
        ),
    )


class JointSpecimen(Table):
    """The specimen by matrices along the interface, in SI units of its directions.

    They relate the force in one direction to displacement, velocity and acceleration in another:
    N/m, or N m/rad if both are rotations. ``stiffness`` is the elastic stiffness, which bounds the
    tangent stiffness. ``attachment_stiffness_n_per_m`` is given if, and only if, there are more
    axes than directions: that of each actuator's attachment to the specimen, by which redundant
    actuators that disagree push against each other.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("stiffness", ("stiffness",), _holds),
        Condition("damping", ("stiffness", "damping"), _same_size),
        Condition("damping", ("damping",), _not_negative("damping")),
        Condition("mass", ("stiffness", "mass"), _same_size),
        Condition("mass", ("mass",), _not_negative("a mass")),
    )

    stiffness: Annotated[Rows, MatrixOf("the stiffness", symmetric=True)]
    damping: Annotated[Rows, MatrixOf("the damping", symmetric=True)] | None = None
    mass: Annotated[Rows, MatrixOf("the mass", symmetric=True)] | None = None
    attachment_stiffness_n_per_m: (
        Annotated[float, Range("N/m", 1, 1e12, "the stiffness of the attachments")] | None
    ) = None
    element: list[Along] = Field(default_factory=list, max_length=MAX_ELEMENTS)


class Plant(Table):
    """Actuators and specimen as one linear plant, s' = a s + b u, x = c s.

    u are the commands and x the displacements of the axes, in their order, m; time in s. ``file``
    (.npz or .mat with a, b, c) can be given instead of the three; its content is then written out.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (Alternatives(("file", "a"), required=True),)
    checks: ClassVar[tuple[Condition, ...]] = (
        Condition(
            "a",
            ("file", "a", "b", "c"),
            lambda file, a, b, c: (
                None
                if file is not None or (b is not None and c is not None)
                else "found a without b or c; give all three, or give file"
            ),
        ),
        Condition("a", ("a",), lambda a: None if a is None else plantpoles.fault(a)),
    )

    file: Annotated[str, SOME_TEXT] | None = None
    a: (
        Annotated[Rows, MatrixOf("a", STATES_MAX, size=1e15, example="[[-20, 0], [0, -30]]")] | None
    ) = None
    b: Annotated[Rows, MatrixOf("b", STATES_MAX, square=False, size=1e15)] | None = None
    c: Annotated[Rows, MatrixOf("c", STATES_MAX, square=False, size=1e15)] | None = None
    stroke_m: Annotated[float, Range("m", 1e-6, 100, "the stroke in each direction")] = 100.0


# ---- identification results ----------------------------------------------------------------------


def _responses_fit(
    frequency_hz: list[float], real: list[Rows], imaginary: list[Rows]
) -> str | None:
    if len(real) == len(imaginary) == len(frequency_hz):
        sizes = {len(rows) for rows in (*real, *imaginary)}
        return None if len(sizes) == 1 else "the matrices differ in size"
    return (
        f"found {len(frequency_hz)} frequencies, {len(real)} real and {len(imaginary)} imaginary "
        "matrices; there must be one of each for every frequency"
    )


class JointIdentified(Table):
    """What `rthyb identify` measured of all axes: the matrix of their frequency responses.

    Each entry is reading over command; the row is the axis that was read, the column the axis that
    was moved.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("frequency_hz", ("frequency_hz",), not_rising),
        Condition("frequency_hz", ("frequency_hz", "real", "imaginary"), _responses_fit),
    )

    frequency_hz: list[Annotated[float, Range("Hz", 1e-3, 512, "a frequency")]] = Field(
        min_length=1
    )
    real: list[Annotated[Rows, MatrixOf("a response", size=1e3)]]
    imaginary: list[Annotated[Rows, MatrixOf("a response", size=1e3)]]
    rest_noise_displacement_m: list[Annotated[float, Range("m", 0, 0.1, "the noise at rest")]]
    date: Annotated[str, Text("the date")] = ""

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Accept a date written as a TOML date."""
        if isinstance(data, dict) and isinstance(data.get("date"), datetime.date):
            return {**data, "date": data["date"].isoformat()}
        return data


# ---- the file ------------------------------------------------------------------------------------


class AxesInfo(Table):
    """General properties of a rig with several axes, as for one axis.

    ``elastic_stiffness`` is the measured stiffness along the interface; if it is missing, that of
    the specimen is used. ``assumed`` names the axis, "axis.left.actuator.kp_per_s".
    """

    name: Annotated[str, SLUG]
    description: Annotated[str, Text("a description")] = ""
    elastic_stiffness: Annotated[Rows, MatrixOf("the elastic stiffness", symmetric=True)] | None = (
        None
    )
    load_cell: Literal["actuator-end", "specimen"] = "actuator-end"
    command_hold: Literal["zoh", "foh"] = "zoh"
    command_shift_s: Annotated[
        float, Range("s", -1, 1, "the delay of the measured row behind the command row")
    ] = 0.0
    seed: Annotated[int, Count(0, 2**32 - 1, "the seed of the sensor noise")] = 0
    assumed: Annotated[list[str], ASSUMED] | None = None


def _names_differ(axes: list[Axis]) -> str | None:
    names = [axis.name for axis in axes]
    for i, name in enumerate(names):
        if name in names[:i]:
            return f"axes {names.index(name) + 1} and {i + 1} are both called {written(name)}"
    return None


def _channels_differ(axes: list[Axis]) -> str | None:
    seen = dict[str, str]()
    for axis in axes:
        for one in axis.sensors.extra:
            if one.name in seen:
                return (
                    f"axes {seen[one.name]} and {axis.name} both have an extra sensor called "
                    f"{written(one.name)}; a recording keeps each by its name: rename one of them, "
                    f"for example {written(f'{axis.name}_{one.name}'[:32].lower())}"
                )
            seen[one.name] = axis.name
    return None


def _driven(axes: list[Axis], plant: Plant | None) -> str | None:
    for axis in axes:
        if axis.actuator is None and plant is None:
            return (
                f"axis {axis.name} has no actuator; give [axis.actuator] below it, or add a "
                "[plant] for all axes"
            )
        if axis.actuator is not None and plant is not None:
            return (
                f"axis {axis.name} has an actuator, but the file also has a [plant], which "
                "replaces the actuators of all axes; remove one of the two"
            )
        if axis.actuator is not None and axis.actuator.kind == "servo-valve":
            return (
                f'axis {axis.name}: found kind = "servo-valve", which is solved together with a '
                'specimen of its own; on a rig with several axes use "servo-hydraulic", or a '
                "[plant]"
            )
    return None


def _specimen_fits(axes: list[Axis], kinematics: Kinematics, specimen: JointSpecimen) -> str | None:
    n, m = len(axes), len(kinematics.interface)
    if len(specimen.stiffness) != m:
        return (
            f"found a stiffness of {len(specimen.stiffness)} directions; kinematics has {m}: "
            f"{', '.join(kinematics.interface)}"
        )
    attached = specimen.attachment_stiffness_n_per_m
    if n > m and attached is None:
        return (
            f"attachment_stiffness_n_per_m is missing; with {n} axes for {m} directions the "
            "actuators push against each other where they disagree, by the stiffness of each "
            "actuator's attachment to the specimen: give it in N/m"
        )
    if n <= m and attached is not None:
        return (
            f"found attachment_stiffness_n_per_m = {attached:g} with {n} axes for {m} directions; "
            "it applies only if there are more axes than directions: remove it"
        )
    for i, one in enumerate(specimen.element):
        if one.along not in kinematics.interface:
            close = nearest(one.along, kinematics.interface)
            return (
                f"element {i + 1}: found along = {written(one.along)}{close}; the directions of "
                f"the interface are {', '.join(kinematics.interface)}"
            )
    return None


def _elastic_fits(rig: AxesInfo, specimen: JointSpecimen) -> str | None:
    if rig.elastic_stiffness is None:
        return None
    fault = _same_size(specimen.stiffness, rig.elastic_stiffness) or _holds(rig.elastic_stiffness)
    return None if fault is None else f"elastic_stiffness: {fault}"


def _plant_fits(axes: list[Axis], plant: Plant | None) -> str | None:
    if plant is None or plant.a is None or plant.b is None or plant.c is None:
        return None
    n, states = len(axes), len(plant.a)
    found = (len(plant.b), len(plant.b[0]), len(plant.c), len(plant.c[0]))
    if found == (states, n, n, states):
        return None
    return (
        f"found a with {states} states, b of {found[0]} x {found[1]} and c of {found[2]} x "
        f"{found[3]}; for {n} axes, b must be {states} x {n} and c {n} x {states}"
    )


def _one_clock(axes: list[Axis]) -> str | None:
    linked = [axis for axis in axes if axis.link is not None]
    if linked and len(linked) < len(axes):
        without = next(axis.name for axis in axes if axis.link is None)
        return (
            f"axis {without} has no [axis.link], but axis {linked[0].name} has one; give a link "
            "for every axis, or for none"
        )
    rates = {axis.link.sample_rate_hz: axis.name for axis in linked if axis.link is not None}
    if len(rates) > 1:
        listed = " and ".join(f"{hz} Hz (axis {name})" for hz, name in sorted(rates.items()))
        return f"found sample_rate_hz of {listed}; all axes are sampled at one rate"
    clocks = {axis.link.clock for axis in linked if axis.link is not None}
    if len(clocks) > 1:
        return f"found the clocks {', '.join(sorted(clocks))}; all axes must use the same clock"
    if "link" in clocks:
        return (
            'found clock = "link"; with several axes the host must be the clock, because no link '
            "can time the others"
        )
    return None


def _sensors_arrive(axes: list[Axis], sensors: list[LoneSensor] | None) -> str | None:
    still = {one.name for axis in axes for one in axis.sensors.extra if one.scale == 0.0}
    fault = extras_fault(sensors or (), _extras_of(axes), still)
    if fault:
        return fault
    linked = [axis.name for axis in axes if axis.link is not None]
    silent = [one.name for one in sensors or () if one.extra is None]
    if not linked or not silent:
        return None
    return (
        f"{silent[0]}: extra is missing; axis {linked[0]} has a link, so state which extra channel "
        "of an axis ([[axis.sensors.extra]]) has the readings of this sensor"
    )


_ROUND_OFF: Final = 1e-9
"""Of a sensor's reading for a unit of an axis, relative to the terms of which it is the sum."""


def _extras_of(axes: Sequence[Axis]) -> list[list[tuple[str, str]]]:
    return [[(one.name, one.unit) for one in axis.sensors.extra] for axis in axes]


def _compared(axes: list[Axis], given: Kinematics, sensors: list[LoneSensor] | None) -> str | None:
    """Return which sensor has a limit on a disagreement with others that nothing else implies."""
    if _kinematics_fault(axes, given, sensors) or _sensors_fit(given, sensors):
        return None  # told by itself
    ordered = in_order(sensors or ())
    tie = core_kinematics(given, tuple(axis.name for axis in axes), ordered)
    for force, rows in zip((False, True), tie.differences(), strict=True):
        kind, key = ("force", "disagreement_n") if force else ("displacement", "disagreement_m")
        own = [
            (f"axis {axis.name}: sensors.{kind}", getattr(getattr(axis.sensors, kind), key))
            for axis in axes
        ]
        further = [(one.name, getattr(one, key)) for one in ordered if one.kind == kind]
        for (name, limit), row in zip(own + further, rows, strict=True):
            if limit is not None and not row.any():
                what = "load cells" if force else "displacement sensors"
                return (
                    f"{name} has {key}, but its reading does not follow from those of the other "
                    f"{what}, so that it cannot disagree with them; remove {key}"
                )
    return None


def _sensors_fit(kinematics: Kinematics, sensors: list[LoneSensor] | None) -> str | None:
    return lone_fault(sensors or [], kinematics.interface, kinematics.kind)


def _on_virtual_drives(axes: list[Axis], kinematics: Kinematics) -> str | None:
    """Refuse real drives of redundant actuators: their signs cannot be checked safely."""
    real = [axis.name for axis in axes if axis.link is not None and not axis.link.virtual]
    if not real or len(axes) <= len(kinematics.interface):
        return None
    return (
        f"axis {real[0]} has a link to a real drive, and there are {len(axes)} axes for "
        f"{len(kinematics.interface)} directions; redundant actuators are supported with virtual "
        "drives only, because commissioning would push them against each other: if virtual drives "
        "are at the other ends, set virtual = true in every [axis.link]; otherwise remove "
        "[axis.link] of every axis, and run tests in virtual time"
    )


def _cells_fit(
    rig: AxesInfo, kinematics: Kinematics, sensors: list[LoneSensor] | None
) -> str | None:
    own = isinstance(kinematics, MatrixKinematics) and kinematics.forces is not None
    # With further load cells the matrix says how to weigh them against those of the axes.
    own = own and not any(one.kind == "force" for one in sensors or ())
    if not own or rig.load_cell == "specimen":
        return None
    return (
        f"forces: found a matrix, with rig.load_cell = {written(rig.load_cell)}; load cells at the "
        "actuators' ends are in line with the axes, whose matrix of forces is known: remove "
        'forces, or give rig.load_cell = "specimen"'
    )


def _identified_fits(axes: list[Axis], identified: JointIdentified | None) -> str | None:
    if identified is None or len(identified.real[0]) == len(axes):
        return None
    return f"found matrices of {len(identified.real[0])} axes; the file has {len(axes)}"


class AxesRig(WholeFile):
    """A rig with several axes: virtual, or the model of a real one."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("axis", ("axis",), _names_differ),
        Condition("axis", ("axis",), _channels_differ),
        Condition("axis", ("axis", "plant"), _driven),
        Condition("axis", ("axis",), _one_clock),
        Condition("sensor", ("kinematics", "sensor"), _sensors_fit),
        Condition("kinematics", ("axis", "kinematics", "sensor"), _kinematics_fault),
        Condition("sensor", ("axis", "sensor"), _sensors_arrive),
        Condition("kinematics", ("axis", "kinematics", "sensor"), _compared),
        Condition("axis", ("axis", "kinematics"), _on_virtual_drives),
        Condition("kinematics", ("rig", "kinematics", "sensor"), _cells_fit),
        Condition("specimen", ("axis", "kinematics", "specimen"), _specimen_fits),
        Condition("rig", ("rig", "specimen"), _elastic_fits),
        Condition("plant", ("axis", "plant"), _plant_fits),
        Condition("identified", ("axis", "identified"), _identified_fits),
    )

    schema_: Literal["rthyb-rig/1"] = Field(alias="schema")
    rig: AxesInfo
    axis: list[Axis] = Field(min_length=2, max_length=AXES_MAX)
    kinematics: Annotated[Kinematics, Field(discriminator="kind")]
    specimen: JointSpecimen
    sensor: (
        Annotated[
            list[Annotated[LoneSensor, Field(discriminator="kind")]],
            Field(min_length=1, max_length=2 * SENSORS_MAX),
        ]
        | None
    ) = None
    plant: Plant | None = None
    identified: JointIdentified | None = None
    limits: Limits = Field(default_factory=Limits)

    @classmethod
    def _explain(
        cls, kind: str, loc: tuple[int | str, ...], value: object, fault: ErrorDetails
    ) -> tuple[tuple[int | str, ...], str]:
        where, text = super()._explain(kind, loc, value, fault)
        if kind == "too_short" and loc == ("axis",):
            text += (
                "; a rig with one axis has no list of axes: its tables actuator, sensors, limits "
                "and so on stand beside the table rig"
            )
        return where, text

    @classmethod
    def further_faults(
        cls, keys: dict[str, Any]
    ) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
        """Report names in ``rig.assumed`` that are no keys which the file may omit."""
        known, axes = [], keys.get("axis")
        for one in axes if isinstance(axes, list) else ():
            own = one if isinstance(one, dict) else getattr(one, "__dict__", {})
            known += assumable(own.get("actuator"), f"axis.{own.get('name')}.")
        yield from assumed_faults(keys.get("rig"), known, ("axis",))

    def settle(self) -> None:
        """Omit the values that are listed as assumed, and list all that are omitted."""
        listed = self.rig.assumed
        if listed:
            self.__dict__["axis"] = [
                axis
                if axis.actuator is None
                else axis.model_copy(
                    update={"actuator": with_assumed(axis.actuator, listed, f"axis.{axis.name}.")}
                )
                for axis in self.axis
            ]
        assumed = list(self.assumed) or None
        if assumed != listed:
            self.__dict__["rig"] = self.rig.model_copy(update={"assumed": assumed})

    @property
    def assumed(self) -> tuple[str, ...]:
        """Keys whose values nobody stated, as ``rig.assumed`` lists them in a file."""
        return tuple(
            key for axis in self.axis for key in assumed_of(axis.actuator, f"axis.{axis.name}.")
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes, in their order."""
        return tuple(axis.name for axis in self.axis)

    @property
    def directions(self) -> tuple[str, ...]:
        """Names of the interface's directions, in the order of the kinematics."""
        return tuple(self.kinematics.interface)

    @property
    def lone_sensors(self) -> list[LoneSensor]:
        """Sensors without an actuator, in the order of the core: displacements, then forces."""
        return in_order(self.sensor or ())

    @property
    def sensor_places(self) -> list[tuple[int, int] | None]:
        """Axis, and number of its extra channel, with the reading of each of `lone_sensors`."""
        return places(self.lone_sensors, _extras_of(self.axis))

    def refuse_silent_sensors(self, what: str) -> None:
        """Refuse what needs the readings of every sensor from a link.

        Args:
            what: what is asked for, as the subject of a sentence.

        Raises:
            InputError: a sensor without an actuator names no extra channel.
        """
        silent = [one.name for one in self.sensor or () if one.extra is None]
        if silent:
            raise InputError(
                f'rig "{self.rig.name}" has sensors without an actuator that name no extra '
                f"channel ({', '.join(silent)}); {what} needs their readings from the link: give "
                "each extra = the name of an [[axis.sensors.extra]], or run tests in virtual time",
                "sensor",
            )

    @property
    def is_redundant(self) -> bool:
        """Whether there are more axes than directions."""
        return len(self.axis) > len(self.directions)

    def refuse_redundant(self, what: str, instead: str) -> None:
        """Refuse what is not supported with more axes than directions.

        Args:
            what: what is asked for, as the subject of a sentence.
            instead: what the user can do.

        Raises:
            InputError: there are more axes than directions.
        """
        if self.is_redundant:
            raise InputError(
                f'rig "{self.rig.name}" has {len(self.axis)} axes ({", ".join(self.names)}) for '
                f"{len(self.directions)} directions ({', '.join(self.directions)}); {what} is not "
                f"supported with redundant actuators; {instead}",
                "kinematics",
            )

    @property
    def link(self) -> LinkTable | None:
        """The link of the first axis: all axes have a link or none, and all use one clock."""
        return self.axis[0].link

    @property
    def rate(self) -> Rate:
        """The rate in real time, which is that of all drives; without links, as for one axis."""
        return STANDARD if self.link is None else self.link.rate

    def without_links(self) -> AxesRig:
        """Return it as a rig without links."""
        axes = [axis.model_copy(update={"link": None}) for axis in self.axis]
        return self.model_copy(update={"axis": axes})

    def core_kinematics(self) -> CoreKinematics:
        """Return the kinematics of the core."""
        return core_kinematics(self.kinematics, self.names, self.lone_sensors)

    def along(self, one: LoneSensor) -> Floats:
        """Return what a sensor without an actuator reads for a unit of each direction, at rest.

        Args:
            one: the sensor.

        Returns:
            (directions,); m/m or m/rad, for a load cell the share of each force.
        """
        import numpy as np

        if one.along is None:
            lone = [each for each in self.lone_sensors if each.kind == one.kind]
            return np.asarray(self.core_kinematics().reads()[lone.index(one)])
        return np.array([one.along.get(name, 0.0) for name in self.directions])

    def actuator_of(self, name: str) -> str:
        """Return what moves an axis: the kind of its actuator, or what the plant of all axes is."""
        actuator = self._axis(name).actuator
        if actuator is not None:
            return actuator.kind
        states = "" if self.plant is None or self.plant.a is None else f" of {len(self.plant.a)}"
        return f"[plant]: one linear model{states} states for all axes"

    @property
    def notes(self) -> list[str]:
        """Notes on the values of the file."""
        found = (
            None if self.plant is None or self.plant.a is None else plantpoles.note(self.plant.a)
        )
        return [] if found is None else [found]

    def of_axis(self, name: str) -> RigFile:
        """Return one axis as a rig with one axis, with the other axes at rest.

        Its specimen has the elastic stiffness of the whole specimen as seen by this axis. Of
        redundant axes it is the axis' share, without the forces by which they oppose each other.

        Raises:
            InputError: there is no axis of that name.
        """
        found = self._alone(name)
        return found.as_one_of(self._one_of(name)) if self.sensor else found

    def _alone(self, name: str) -> RigFile:
        axis = self._axis(name)
        at = self.names.index(name)
        k = self.along_axes()[at][at]
        own = {key: getattr(axis.limits, key) for key in Limits.model_fields}
        limits = {
            key: getattr(self.limits, key) if value is None else value for key, value in own.items()
        }
        keys = set(AxesInfo.model_fields) - {"name", "elastic_stiffness", "assumed"}
        info = {key: getattr(self.rig, key) for key in keys}
        found = RigFile.model_construct(
            schema_=self.schema_,
            rig=RigInfo.model_construct(
                **info,
                name=f"{self.rig.name[:38]}.{name}",
                elastic_stiffness_n_per_m=k,
                assumed=list(assumed_of(axis.actuator)) or None,
            ),
            # A plant has no actuators of its own: nothing simulates this one.
            actuator=axis.actuator or PureDelay(kind="pure-delay", delay_samples=0),
            specimen=[StiffnessElement(element="stiffness", k_n_per_m=k)],
            sensors=axis.sensors,
            identified=axis.identified,
            link=axis.link,
            calibration=axis.calibration,
            limits=Limits.model_construct(**limits),
        )
        return found

    def _one_of(self, name: str) -> OneOfSeveral:
        """Return what an axis has in common with the others."""
        return OneOfSeveral(
            name,
            self.names,
            {other: self._alone(other) for other in self.names if other != name},
            tuple(self._seen_from(name)),
            {
                "axes": list(self.names),
                "kinematics": self.kinematics.model_dump(exclude_none=True),
            },
        )

    def _seen_from(self, name: str) -> Iterator[SensorOfAxes]:
        """Yield the sensors without an actuator that arrive in frames, as seen from an axis.

        They read r = a u for the interface's displacement u = B^+ x, x being the readings of the
        axes; load cells read r = a F, with F = B^T f for the same work as the forces f of the axes.
        """
        import numpy as np

        at, tie, k = self.names.index(name), self.core_kinematics(), np.array(self.k_e)
        back, by_force = tie.back(), tie.jacobian().T
        # Forces of the axes for 1 m of this one.
        pushed = (back.T @ k @ back)[:, at]
        for one, place in zip(self.lone_sensors, self.sensor_places, strict=True):
            if place is None:
                continue
            axis, number = place
            along = self.along(one)
            means = by_force if one.kind == "force" else back
            terms = np.abs(along) @ np.abs(means)
            by_axis = np.where(np.abs(along @ means) > _ROUND_OFF * terms, along @ means, 0.0)
            per_m, per_n = float(by_axis[at]), 0.0
            if one.kind == "force":
                shares = by_axis * pushed
                still = abs(shares.sum()) <= _ROUND_OFF * np.abs(shares).sum()
                per_m = 0.0 if still else float(shares.sum())
                per_n = per_m / float(pushed[at])
            yield SensorOfAxes(
                one, self.names[axis], self.axis[axis].sensors.extra[number], number,
                tuple(by_axis.tolist()), tuple(terms.tolist()), per_m, per_n,
                tare_most(by_axis, self._limits_of(one.kind)),
                tare_most(by_axis, self._limits_of(one.kind, of_tare=True)),
            )  # fmt: skip

    def _limits_of(self, kind: str, *, of_tare: bool = False) -> list[float]:
        """Return the limit of each axis on its position or force, or on its tare; 0: none."""
        found = []
        for axis in self.axis:
            key = "force_n" if kind == "force" else "command_position_m"
            limit = getattr(axis.limits, key) or getattr(self.limits, key)
            share = axis.limits.tare_share_most or self.limits.tare_share_most
            used = (share or DEFAULT_TARE_SHARE_MOST) if of_tare else 1.0
            found.append(used * limit.value if limit is not None and limit.acts else 0.0)
        return found

    def _axis(self, name: str) -> Axis:
        for axis in self.axis:
            if axis.name == name:
                return axis
        raise InputError(
            f"found {written(name)}{nearest(name, list(self.names))}; the axes of rig "
            f"{written(self.rig.name)} are {', '.join(self.names)}",
            "axis",
        )

    def along_axes(self, given: Rows | None = None) -> Rows:
        """Return a matrix of the interface in the coordinates of the axes at rest, (axes, axes).

        Args:
            given: stiffness, damping or mass along the directions, (directions, directions); None:
                the specimen's elastic stiffness, N/m.
        """
        import numpy as np

        back = self.core_kinematics().back()
        found: Rows = (back.T @ np.array(self.k_e if given is None else given) @ back).tolist()
        return found

    @property
    def k_e(self) -> Rows:
        """The specimen's elastic stiffness along the interface, (directions, directions)."""
        return self.rig.elastic_stiffness or self.specimen.stiffness
