"""Restoring-force compensation of several axes by a tangent stiffness matrix (``matrix_rfc.c``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.kinematics import AXES_MAX
from rthyb_rt.core.library import CoreError, FloatArray, check, doubles, reading, writing
from rthyb_rt.core.sizes import PERIOD_S


@dataclass(frozen=True, eq=False)
class MatrixRfcConfig:
    """Settings of a `MatrixRfc`; interface coordinates are in m or rad, forces in N or N m.

    Attributes:
        k_e: elastic stiffness, symmetric and positive definite, (size, size).
        rest_noise: standard deviation of each coordinate at rest, (size,): while a coordinate has
            moved by at most four times that within the memory, its stiffness is the elastic one.
        memory_s: time in which a sample's weight falls to 1/e.
        cutoff_hz: cut-off of the low-pass filter on x_c - x_m; 0 for none.
        lateness_s: delay of the forces behind x_m.
        enabled: whether forces are changed at all.
        period_s: sampling period.
    """

    k_e: FloatArray
    rest_noise: tuple[float, ...]
    memory_s: float = 0.05
    cutoff_hz: float = 0.0
    lateness_s: float = 0.0
    enabled: bool = True
    period_s: float = PERIOD_S

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.rest_noise)

    def struct(self) -> Any:
        """Return the C struct; raises ``CoreError`` for inconsistent shapes."""
        given = np.asarray(self.k_e, np.float64)
        if not 1 <= self.size <= AXES_MAX or given.shape != (self.size, self.size):
            raise CoreError(
                f"found {self.size} coordinates and a k_e of shape {given.shape}; 1 to "
                f"{AXES_MAX} coordinates are allowed, each with its noise, and k_e must be square"
            )
        settings = {
            "size": self.size,
            "enabled": int(self.enabled),
            "period_s": self.period_s,
            "memory_s": self.memory_s,
            "cutoff_hz": self.cutoff_hz,
            "lateness_s": self.lateness_s,
            "k_e": given.tolist(),
            "rest_noise": list(self.rest_noise),
        }
        return ffi.new("rthyb_matrix_rfc_config *", settings)


class MatrixRfc:
    """A running restoring-force compensator of several coordinates.

    Args:
        config: its settings.
        x0: initial coordinates at rest, (size,); None: 0.
        f0: forces at rest, likewise.

    Raises:
        CoreError: a setting is out of range, or ``k_e`` is not a valid stiffness matrix.
    """

    def __init__(
        self,
        config: MatrixRfcConfig,
        x0: npt.ArrayLike | None = None,
        f0: npt.ArrayLike | None = None,
    ) -> None:
        self.size = config.size
        struct = config.struct()
        self._c = ffi.new("rthyb_matrix_rfc *")
        x, f = (self._row(np.zeros(self.size) if one is None else one) for one in (x0, f0))
        check(lib.rthyb_matrix_rfc_init(self._c, struct, reading(x), reading(f)))

    @property
    def k(self) -> FloatArray:
        """Current tangent stiffness, (size, size): symmetric, between 0 and k_e."""
        rows = range(self.size)
        return np.array([[self._c.k[i][j] for j in rows] for i in rows])

    def step(
        self,
        x_c: npt.ArrayLike,
        x_m: npt.ArrayLike,
        f: npt.ArrayLike,
        v_c: npt.ArrayLike | None = None,
        frozen: bool = False,
    ) -> tuple[FloatArray, int]:
        """Return the forces for the equation of motion, (size,), and the status bits."""
        c, m, own = self._row(x_c), self._row(x_m), self._row(f)
        v = self._row(np.zeros(self.size) if v_c is None else v_c)
        out = np.empty(self.size)
        code = lib.rthyb_matrix_rfc_step(
            self._c, reading(c), reading(v), reading(m), reading(own), frozen, writing(out)
        )
        return out, int(code)

    def run(
        self,
        x_c: npt.ArrayLike,
        x_m: npt.ArrayLike,
        f: npt.ArrayLike,
        v_c: npt.ArrayLike | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return forces, (n, size), and tangent stiffness, (n, size, size), for each row."""
        c, m, own = doubles(x_c), doubles(x_m), doubles(f)
        v = np.zeros_like(c) if v_c is None else doubles(v_c)
        if c.ndim != 2 or c.shape[1] != self.size or not c.shape == m.shape == own.shape == v.shape:
            raise CoreError(
                "found arrays that differ in length or do not have one column for each of the "
                f"{self.size} coordinates"
            )
        force, k = np.empty_like(c), np.empty((len(c), self.size, self.size))
        given = [reading(one.reshape(-1)) for one in (c, v, m, own)]
        lib.rthyb_matrix_rfc_run(
            self._c, *given, writing(force.reshape(-1)), writing(k.reshape(-1)), len(c)
        )
        return force, k

    def _row(self, values: npt.ArrayLike) -> FloatArray:
        given = doubles(values)
        if given.shape != (self.size,):
            raise CoreError(
                f"found an array of shape {given.shape}; there must be one number for each of "
                f"the {self.size} coordinates"
            )
        return given
