"""Displacements of several actuators from those of the interface, and back.

Up to `AXES_MAX` axes act on one specimen, whose motion is described by interface coordinates. A
constant matrix relates them, or, exactly, pins on a rigid coupler and its bases. With a matrix
there may be fewer coordinates than axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import (
    CoreError,
    FloatArray,
    check,
    doubles,
    reading,
    words,
    writing,
)
from rthyb_rt.core.sizes import SENSORS_MAX

AXES_MAX: Final = int(lib.RTHYB_COUPLED_MAX)
"""Largest number of axes at one specimen."""

Coordinate = Literal["x", "y", "theta"]
COORDINATES: Final = words("rthyb_coordinate", "RTHYB_COORDINATE_")
"""Coordinates of a plane motion: x and y in m, theta in rad from x towards y."""


@dataclass(frozen=True)
class Pin:
    """One axis, or displacement sensor, between its base and its pin on the coupler.

    Attributes:
        pin_m: position of its pin at rest, x and y from the interface's reference point, m.
        base_m: position of its base, likewise; with ``far``, the direction from base to pin, of any
            length.
        far: the base is so far away that the axis never turns.
        pulls: the axis counts shortening as positive.
    """

    pin_m: tuple[float, float]
    base_m: tuple[float, float]
    far: bool = False
    pulls: bool = False


class Kinematics:
    """Interface coordinates and axes of one specimen; each pose is found from the previous one.

    Args:
        matrix: axes = matrix times pose, (axes, directions): one row per axis, no more columns than
            rows.
        pins: alternative to ``matrix``, one per axis.
        coordinates: with pins, the coordinates of the interface, as many as axes; all others stay
            0.
        forces: with a matrix: interface forces = forces times those of the load cells, (directions,
            axes); None: the transposed matrix, for load cells in line with the axes. With pins and
            load cells without an actuator, g: F = J^T f + forces (g - carries J^T f), with the
            forces f and the Jacobian J of the axes, (directions, cells).
        displacements: with a matrix: pose = displacements times those of the axes, (directions,
            axes), with displacements times matrix = identity; None: the least-squares inverse.
        reads: with a matrix: displacement sensors without an actuator; a row for each with its
            reading for a unit of every coordinate, (sensors, directions). ``displacements`` then
            has further columns for them, and times ``matrix`` above ``reads`` is the identity.
        carries: the same for load cells without an actuator: share of each interface force that
            such a cell measures, (cells, directions). ``forces`` must then be given, with further
            columns for them; those of the axes are in line with them, so ``forces`` times (the
            forces of the axes with a unit resultant, above ``carries``) is the identity.
        sensor_pins: with pins, displacement sensors without an actuator. Each counts like the
            sensor of an axis in the least-squares pose.

    Raises:
        CoreError: the axes leave a coordinate undetermined, a pin is at its own base, a coordinate
            is repeated, a shape or a number is wrong, or there are more than `AXES_MAX` axes.
    """

    def __init__(
        self,
        matrix: npt.ArrayLike | None = None,
        *,
        pins: Sequence[Pin] = (),
        coordinates: Sequence[Coordinate] = (),
        forces: npt.ArrayLike | None = None,
        displacements: npt.ArrayLike | None = None,
        reads: npt.ArrayLike | None = None,
        carries: npt.ArrayLike | None = None,
        sensor_pins: Sequence[Pin] = (),
    ) -> None:
        further = {"reads": reads, "carries": carries}
        if (matrix is None) == (not pins):
            raise CoreError("kinematics need either a matrix or pins, not both")
        if matrix is None:
            if displacements is not None or reads is not None:
                raise CoreError(
                    "found displacements or reads together with pins; they go with a matrix only"
                )
            settings = _of_pins(pins, coordinates)
            _add_cells(settings, forces, carries, len(coordinates))
            _add_sensor_pins(settings, sensor_pins)
        elif sensor_pins:
            raise CoreError("found sensor_pins together with a matrix; they go with pins only")
        else:
            settings = _of_matrix(matrix, forces, displacements, further)
        self._given_as = {
            "matrix": None if matrix is None else np.asarray(matrix, np.float64).tolist(),
            "pins": [asdict(pin) for pin in pins],
            "coordinates": list(coordinates),
        }
        for name, given in {"forces": forces, "displacements": displacements, **further}.items():
            if given is not None:
                self._given_as[name] = np.asarray(given, np.float64).tolist()
        if sensor_pins:
            self._given_as["sensor_pins"] = [asdict(pin) for pin in sensor_pins]
        self.size: int = settings["size"]
        self.directions: int = settings.get("directions", self.size)
        self.displacement_sensors: int = settings.get("displacement_sensors", 0)
        self.force_sensors: int = settings.get("force_sensors", 0)
        self._c = ffi.new("rthyb_kinematics *")
        check(lib.rthyb_kinematics_init(self._c, ffi.new("rthyb_kinematics_config *", settings)))

    def plain(self) -> dict[str, Any]:
        """Return the settings as plain values for a recording; `of` restores them."""
        return dict(self._given_as)

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Kinematics:
        """Return the kinematics that `plain` described; raises ``CoreError``."""
        pins, sensor_pins = (
            [
                Pin(tuple(pin["pin_m"]), tuple(pin["base_m"]), bool(pin["far"]), bool(pin["pulls"]))
                for pin in plain.get(name, ())
            ]
            for name in ("pins", "sensor_pins")
        )
        return cls(
            plain["matrix"],
            pins=pins,
            sensor_pins=sensor_pins,
            coordinates=plain["coordinates"],
            forces=plain.get("forces"),
            displacements=plain.get("displacements"),
            reads=plain.get("reads"),
            carries=plain.get("carries"),
        )

    @property
    def struct(self) -> Any:
        """The C struct, for other interfaces of the core."""
        return self._c

    def axes(self, pose: npt.ArrayLike) -> tuple[FloatArray, int]:
        """Return axis displacements, m, (size,) or (n, size), for poses, (directions,) or (n, ...).

        The second value is the status bits: a value that is not a number or implausible is replaced
        by the last good one.
        """
        return self._run(lib.rthyb_kinematics_axes_run, pose, self.directions, self.size)

    def pose(self, axis_m: npt.ArrayLike) -> tuple[FloatArray, int]:
        """Return poses, (directions,) or (n, directions), for axes, (size,) or (n, size); status.

        Displacement sensors without an actuator are not used: see `measured_pose`. With pins, two
        Newton steps per row, each starting at the pose of the previous row.
        """
        return self._run(lib.rthyb_kinematics_pose_run, axis_m, self.size, self.directions)

    def forces(self, axis_n: npt.ArrayLike) -> tuple[FloatArray, int]:
        """Return forces, N, and moments, N m, along the coordinates, (directions,); status bits.

        Uses the given matrix, or the transposed Jacobian at the last pose, and the forces of the
        axes, (size,). With load cells without an actuator it is always the Jacobian: see
        `measured_forces`.
        """
        force, out = self._given(axis_n, self.size), np.empty(self.directions)
        if force.shape != (self.size,):
            raise CoreError(
                f"found forces of shape {force.shape}; there must be one for each of the "
                f"{self.size} axes"
            )
        code = lib.rthyb_kinematics_forces(self._c, reading(force), writing(out))
        return out, int(code)

    @property
    def sensors(self) -> int:
        """Number of sensors without an actuator: displacements, then forces."""
        return self.displacement_sensors + self.force_sensors

    def measured_pose(self, axis_m: npt.ArrayLike, sensor: npt.ArrayLike) -> FloatArray:
        """Return the poses measured by the sensors of the axes and those without an actuator.

        Args:
            axis_m: displacements of the axes, m, (n, size).
            sensor: readings of the sensors without an actuator, (n, sensors).

        Returns:
            (n, directions); with pins, each found from the previous one.
        """
        return self._measured(lib.rthyb_kinematics_measured_pose, axis_m, sensor)

    def measured_forces(self, axis_n: npt.ArrayLike, sensor: npt.ArrayLike) -> FloatArray:
        """Return the interface forces measured by all load cells, N or N m, (n, directions).

        Args:
            axis_n: forces of the axes, N, (n, size).
            sensor: readings of the sensors without an actuator, (n, sensors).
        """
        return self._measured(lib.rthyb_kinematics_measured_forces, axis_n, sensor)

    def _measured(self, run: Any, axes: npt.ArrayLike, sensor: npt.ArrayLike) -> FloatArray:
        own, further = self._given(axes, self.size), doubles(sensor)
        if own.ndim != 2 or further.shape != (len(own), self.sensors):
            raise CoreError(
                f"found arrays of shape {own.shape} and {further.shape}; there must be a row for "
                f"each sample, with {self.size} axes and {self.sensors} sensors without an actuator"
            )
        out = np.empty((len(own), self.directions))
        for one, beside, to in zip(own, further, out, strict=True):
            run(self._c, reading(one), reading(beside), writing(to))
        return out

    def readings(self, pose: npt.ArrayLike, force: npt.ArrayLike) -> FloatArray:
        """Return the readings of the sensors without an actuator, (n, sensors).

        Args:
            pose: (n, directions).
            force: interface forces, (n, directions).
        """
        along, pushed = self._given(pose, self.directions), self._given(force, self.directions)
        out, of_c = np.empty((len(along), self.sensors)), ffi.addressof(self._c, "cfg")
        for one, by, to in zip(along, pushed, out, strict=True):
            lib.rthyb_kinematics_readings(of_c, reading(one), reading(by), writing(to))
        return out

    def reads(self) -> FloatArray:
        """Return d displacement sensors without an actuator / d pose at the last pose.

        (displacement_sensors, directions).
        """
        out = np.empty(self.displacement_sensors * self.directions)
        lib.rthyb_kinematics_reads(self._c, writing(out))
        return out.reshape(self.displacement_sensors, self.directions)

    @property
    def has_forces(self) -> bool:
        """Whether the interface forces follow from a matrix of their own."""
        return "forces" in self._given_as

    @property
    def has_pins(self) -> bool:
        """Whether the axes are described by pins, not by a matrix."""
        return bool(self._given_as["pins"])

    def weights(self) -> FloatArray:
        """Return d pose / d measured axes at the last pose, (directions, size).

        Displacement sensors without an actuator follow the axes.
        """
        if self.displacement_sensors:
            own, further = self.shares()
            return np.asarray(own + further @ self.reads() @ self.back())
        if self.size == self.directions and "displacements" not in self._given_as:
            return self.back()
        # Constant: the poses of unit displacements are its columns.
        return self.pose(np.eye(self.size))[0].T

    def shares(self) -> tuple[FloatArray, FloatArray]:
        """Return how the measured pose depends on each sensor.

        Returns:
            d pose / d sensors of the axes, (directions, size), and d pose / d displacement sensors
            without an actuator, (directions, displacement_sensors).
        """
        if not self.displacement_sensors:
            return self.weights(), np.empty((self.directions, 0))
        n, p = self.size, self.displacement_sensors
        if self.has_pins:
            both = np.linalg.pinv(np.concatenate([self.jacobian(), self.reads()]))
            return both[:, :n], both[:, n:]
        flat = self._c.measure[0 : self.directions * (n + p)]
        whole = np.array(list(flat)).reshape(self.directions, n + p)
        return whole[:, :n], whole[:, n:]

    def differences(self) -> tuple[FloatArray, FloatArray]:
        """Return how readings differ from what all other sensors of their kind imply.

        Row k has the weights of all readings in the difference of reading k from the least squares
        fit to all others, as the station compares them: of the displacements of the axes and the
        displacement sensors without an actuator, (size + displacement_sensors, ...), and of the
        forces of the axes and the load cells without an actuator, (size + force_sensors, ...). A
        row of zeros belongs to a reading that the others do not imply. With pins, the rows are
        those at rest; the station compares with those at the pose of each tick.
        """
        c = ffi.new("rthyb_disagreement *")
        lib.rthyb_disagreement_init(c, ffi.addressof(self._c, "cfg"), 1.0)

        def square(rows: Any, count: int) -> FloatArray:
            return np.array([list(row[0:count]) for row in rows[0:count]])

        return (
            square(c.by_x, self.size + self.displacement_sensors),
            square(c.by_f, self.size + self.force_sensors),
        )

    def resultants(self, axis_n: npt.ArrayLike) -> FloatArray:
        """Return forces along the coordinates, N or N m, (n, directions), at the last pose.

        Args:
            axis_n: forces of the axes, N, (n, size).
        """
        each = np.array([self.forces(unit)[0] for unit in np.eye(self.size)])
        return np.asarray(self._given(axis_n, self.size) @ each)

    def pushes(self, force: npt.ArrayLike) -> FloatArray:
        """Return forces of the axes with given interface forces, at the last pose.

        With redundant axes these are the smallest ones, by the sum of their squares.

        Args:
            force: N or N m, (directions,) or (n, directions).

        Returns:
            N, (size,) or (n, size).
        """
        given, each = self._given(force, self.directions), np.empty((self.directions, self.size))
        for unit, of_unit in zip(np.eye(self.directions), each, strict=True):
            lib.rthyb_kinematics_pushes(self._c, reading(unit), writing(of_unit))
        return np.asarray(given @ each)

    def jacobian(self) -> FloatArray:
        """Return d axis / d pose at the last pose, (size, directions)."""
        out = np.empty(self.size * self.directions)
        lib.rthyb_kinematics_jacobian(self._c, writing(out))
        return out.reshape(self.size, self.directions)

    def back(self) -> FloatArray:
        """Return the inverse of `jacobian`, or its least-squares inverse, (directions, size)."""
        jacobian = self.jacobian()
        square = self.size == self.directions
        found = np.linalg.inv(jacobian) if square else np.linalg.pinv(jacobian)
        return np.asarray(found, dtype=np.float64)

    def _given(self, values: npt.ArrayLike, width: int) -> FloatArray:
        given = doubles(values)
        if given.ndim > 2 or given.shape[-1] != width:
            raise CoreError(
                f"found an array of shape {given.shape}; each row must have {width} numbers"
            )
        return given

    def _run(self, run: Any, values: npt.ArrayLike, width: int, to: int) -> tuple[FloatArray, int]:
        given = self._given(values, width)
        out = np.empty((*given.shape[:-1], to))
        code = run(
            self._c, reading(given.reshape(-1)), writing(out.reshape(-1)), given.size // width
        )
        return out, int(code)


_FURTHER: Final = ("reads", "carries")


def _of_matrix(
    matrix: npt.ArrayLike,
    forces: npt.ArrayLike | None,
    displacements: npt.ArrayLike | None,
    further: Mapping[str, npt.ArrayLike | None],
) -> dict[str, Any]:
    given = np.asarray(matrix, dtype=np.float64)
    if given.ndim != 2 or not 1 <= given.shape[1] <= given.shape[0] <= AXES_MAX:
        raise CoreError(
            f"found a matrix of shape {given.shape}; it must have one row for each of 1 to "
            f"{AXES_MAX} axes and no more columns than rows"
        )
    settings: dict[str, Any] = {
        "kind": lib.RTHYB_KINEMATICS_MATRIX,
        "size": given.shape[0],
        "directions": given.shape[1],
        "given": 0,
        "matrix": given.reshape(-1).tolist(),
    }
    n, m = given.shape
    counts = [_add_sensors(settings, name, further[name], m) for name in _FURTHER]
    if counts[1] and forces is None:
        raise CoreError(
            f"found {counts[1]} load cells without an actuator, but no forces; give the matrix "
            "that converts the readings of all load cells to interface forces"
        )
    for name, rows, bit, count in (
        ("forces", forces, lib.RTHYB_GIVEN_FORCES, counts[1]),
        ("displacements", displacements, lib.RTHYB_GIVEN_DISPLACEMENTS, counts[0]),
    ):
        if rows is None:
            continue
        own = np.asarray(rows, dtype=np.float64)
        if own.shape != (m, n + count):
            also = f" and {count} sensors without an actuator" if count else ""
            raise CoreError(
                f"{name}: found shape {own.shape}; with a matrix of shape {given.shape}{also} it "
                f"must be {(m, n + count)}"
            )
        settings["given"] |= bit
        settings[name] = own.reshape(-1).tolist()
    return settings


def _add_sensors(
    settings: dict[str, Any], name: str, given: npt.ArrayLike | None, directions: int
) -> int:
    """Add the rows of sensors without an actuator to the settings; return their number."""
    if given is None:
        return 0
    rows = np.asarray(given, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != directions or not 1 <= len(rows) <= SENSORS_MAX:
        raise CoreError(
            f"{name}: found shape {rows.shape}; it must have a row of {directions} numbers, one "
            f"for each direction, for each of 1 to {SENSORS_MAX} sensors"
        )
    count = {"reads": "displacement_sensors", "carries": "force_sensors"}[name]
    settings[name], settings[count] = rows.reshape(-1).tolist(), len(rows)
    return len(rows)


def _add_cells(
    settings: dict[str, Any],
    forces: npt.ArrayLike | None,
    carries: npt.ArrayLike | None,
    directions: int,
) -> None:
    """Add load cells without an actuator to settings with pins."""
    count = _add_sensors(settings, "carries", carries, directions)
    shape = None if forces is None else np.shape(forces)
    if shape != ((directions, count) if count else None):
        raise CoreError(
            f"forces: found {'none' if shape is None else f'shape {shape}'} with pins and {count} "
            f"load cells without an actuator; it must have {directions} rows, one for each "
            "direction, and a column for each such load cell"
        )
    if count:
        settings["given"] = lib.RTHYB_GIVEN_FORCES
        settings["forces"] = np.asarray(forces, np.float64).reshape(-1).tolist()


def _add_sensor_pins(settings: dict[str, Any], pins: Sequence[Pin]) -> None:
    """Add displacement sensors without an actuator to settings with pins."""
    if len(pins) > SENSORS_MAX:
        raise CoreError(
            f"found {len(pins)} displacement sensors without an actuator; at most {SENSORS_MAX} "
            "are allowed"
        )
    settings["displacement_sensors"] = len(pins)
    settings |= {f"sensor_{name}": values for name, values in _rods(pins).items()}


def _rods(pins: Sequence[Pin]) -> dict[str, Any]:
    return {
        "pin_m": [pin.pin_m for pin in pins],
        "base_m": [pin.base_m for pin in pins],
        "far": [int(pin.far) for pin in pins],
        "pulls": [int(pin.pulls) for pin in pins],
    }


def _of_pins(pins: Sequence[Pin], coordinates: Sequence[Coordinate]) -> dict[str, Any]:
    unknown = [name for name in coordinates if name not in COORDINATES]
    if unknown or not 1 <= len(pins) <= len(COORDINATES) or len(coordinates) != len(pins):
        raise CoreError(
            f"found {len(pins)} axes with pins and the coordinates "
            f"{', '.join(coordinates) or 'none'}; there must be as many coordinates as axes, out "
            f"of {', '.join(COORDINATES)}"
        )
    return {
        "kind": lib.RTHYB_KINEMATICS_PINS,
        "size": len(pins),
        "coordinate": [COORDINATES[name] for name in coordinates],
        **_rods(pins),
    }
