"""Displacements of several actuators from those of the interface, and back.

Up to `AXES_MAX` axes act on one specimen, whose motion is described by as many interface
coordinates. A constant matrix relates them, or, exactly, pins on a rigid coupler and its bases.
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

AXES_MAX: Final = int(lib.RTHYB_COUPLED_MAX)
"""Largest number of axes at one specimen."""

Coordinate = Literal["x", "y", "theta"]
COORDINATES: Final = words("rthyb_coordinate", "RTHYB_COORDINATE_")
"""Coordinates of a plane motion: x and y in m, theta in rad from x towards y."""


@dataclass(frozen=True)
class Pin:
    """One axis between its base and its pin on the coupler.

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
        matrix: axes = matrix times pose, square, one row per axis.
        pins: alternative to ``matrix``, one per axis.
        coordinates: with pins, the coordinates of the interface; all others stay 0.

    Raises:
        CoreError: the axes leave a coordinate undetermined, a pin is at its own base, a coordinate
            is repeated, or there are not as many coordinates as axes, or more than `AXES_MAX`.
    """

    def __init__(
        self,
        matrix: npt.ArrayLike | None = None,
        *,
        pins: Sequence[Pin] = (),
        coordinates: Sequence[Coordinate] = (),
    ) -> None:
        if (matrix is None) == (not pins):
            raise CoreError("kinematics need either a matrix or pins, not both")
        settings = _of_pins(pins, coordinates) if matrix is None else _of_matrix(matrix)
        self._given_as = {
            "matrix": None if matrix is None else np.asarray(matrix, np.float64).tolist(),
            "pins": [asdict(pin) for pin in pins],
            "coordinates": list(coordinates),
        }
        self.size: int = settings["size"]
        self._c = ffi.new("rthyb_kinematics *")
        check(lib.rthyb_kinematics_init(self._c, ffi.new("rthyb_kinematics_config *", settings)))

    def plain(self) -> dict[str, Any]:
        """Return the settings as plain values for a recording; `of` restores them."""
        return dict(self._given_as)

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Kinematics:
        """Return the kinematics that `plain` described; raises ``CoreError``."""
        pins = [
            Pin(tuple(pin["pin_m"]), tuple(pin["base_m"]), bool(pin["far"]), bool(pin["pulls"]))
            for pin in plain["pins"]
        ]
        return cls(plain["matrix"], pins=pins, coordinates=plain["coordinates"])

    @property
    def struct(self) -> Any:
        """The C struct, for other interfaces of the core."""
        return self._c

    def axes(self, pose: npt.ArrayLike) -> tuple[FloatArray, int]:
        """Return axis displacements, m, with the shape of ``pose``, (size,) or (n, size).

        The second value is the status bits: a value that is not a number or implausible is replaced
        by the last good one.
        """
        return self._run(lib.rthyb_kinematics_axes_run, pose)

    def pose(self, axis_m: npt.ArrayLike) -> tuple[FloatArray, int]:
        """Return interface coordinates with the shape of ``axis_m``, (size,) or (n, size); status.

        Two Newton steps per row, each starting at the pose of the previous row.
        """
        return self._run(lib.rthyb_kinematics_pose_run, axis_m)

    def forces(self, axis_n: npt.ArrayLike) -> tuple[FloatArray, int]:
        """Return forces, N, and moments, N m, along the coordinates, (size,); status bits.

        Uses the transposed Jacobian at the last pose and the forces of the axes, (size,).
        """
        force, out = self._given(axis_n), np.empty(self.size)
        if force.shape != (self.size,):
            raise CoreError(
                f"found forces of shape {force.shape}; there must be one for each of the "
                f"{self.size} axes"
            )
        code = lib.rthyb_kinematics_forces(self._c, reading(force), writing(out))
        return out, int(code)

    def jacobian(self) -> FloatArray:
        """Return d axis / d pose at the last pose, (size, size)."""
        out = np.empty(self.size**2)
        lib.rthyb_kinematics_jacobian(self._c, writing(out))
        return out.reshape(self.size, self.size)

    def _given(self, values: npt.ArrayLike) -> FloatArray:
        given = doubles(values)
        if given.ndim > 2 or given.shape[-1] != self.size:
            raise CoreError(
                f"found an array of shape {given.shape}; each row must have {self.size} numbers"
            )
        return given

    def _run(self, run: Any, values: npt.ArrayLike) -> tuple[FloatArray, int]:
        given = self._given(values)
        out = np.empty_like(given)
        code = run(
            self._c,
            reading(given.reshape(-1)),
            writing(out.reshape(-1)),
            given.size // self.size,
        )
        return out, int(code)


def _of_matrix(matrix: npt.ArrayLike) -> dict[str, Any]:
    given = np.asarray(matrix, dtype=np.float64)
    if given.ndim != 2 or given.shape[0] != given.shape[1] or not 1 <= len(given) <= AXES_MAX:
        raise CoreError(
            f"found a matrix of shape {given.shape}; it must be square, with one row for each of "
            f"1 to {AXES_MAX} axes"
        )
    return {
        "kind": lib.RTHYB_KINEMATICS_MATRIX,
        "size": len(given),
        "matrix": given.reshape(-1).tolist(),
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
        "pin_m": [pin.pin_m for pin in pins],
        "base_m": [pin.base_m for pin in pins],
        "far": [int(pin.far) for pin in pins],
        "pulls": [int(pin.pulls) for pin in pins],
    }
