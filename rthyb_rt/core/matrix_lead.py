"""Compensation of several actuators that feel one another: matrices of gain, delay and curvature
before an inverse of the axes as they were identified (``csrc/matrix_lead.c``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.kinematics import AXES_MAX
from rthyb_rt.core.library import CoreError, FloatArray, check, doubles, reading, writing
from rthyb_rt.core.sizes import PERIOD_S

Complexes = npt.NDArray[np.complex128]

TERMS: Final = ("gain", "delay", "curvature")
POLES_MAX: Final = int(lib.RTHYB_MATRIX_POLES)
"""Of the inverse."""


@dataclass(frozen=True)
class MatrixInverse:
    """C(z) = C_0 + sum of C_k (1 - 1/z) / (1 - rho_k / z), rho_k = exp(-2 pi f_k h).

    Attributes:
        pole_hz: f_k.
        coefficients: C_0, then C_k, (1 + poles, axes, axes); rows are commands.
    """

    pole_hz: tuple[float, ...]
    coefficients: FloatArray

    def response(self, f_hz: npt.ArrayLike, period_s: float = PERIOD_S) -> Complexes:
        """Return C at frequencies, (n, axes, axes)."""
        shapes = self.shapes(f_hz, self.pole_hz, period_s)
        return np.asarray(np.einsum("fk,kij->fij", shapes, self.coefficients))

    @staticmethod
    def shapes(
        f_hz: npt.ArrayLike, pole_hz: Sequence[float], period_s: float = PERIOD_S
    ) -> Complexes:
        """Return what the coefficients are multiplied by at frequencies, (n, 1 + poles)."""
        back = np.exp(-2j * np.pi * np.atleast_1d(np.asarray(f_hz, np.float64)) * period_s)
        rho = np.exp(-2.0 * np.pi * np.asarray(pole_hz, np.float64) * period_s)
        moving = (1.0 - back[:, None]) / (1.0 - back[:, None] * rho)
        return np.concatenate([np.ones((back.size, 1)), moving], axis=1)


@dataclass(frozen=True)
class MatrixLeadConfig:
    """Settings of a `MatrixLead`.

    Attributes:
        rest_noise_m: standard deviation of each axis at rest, one an axis: their number.
        inverse: of the axes; None: there is none, C = 1.
        coupled: the matrices have numbers beside the diagonal.
        roll_off_hz: of the lead behind gain, delay and curvature.
        cutoff_hz: of the filter pair that learning sees the signals through.
        gate_factor: learn only while an axis moves with so many times the power of its noise.
        memory_s: a sample's weight falls to 1/e in this time.
        gain_sigma, delay_sigma_s, curvature_sigma_s2: standard deviation of where a term begins.
        gain_most, delay_most_s: bounds of every number of the matrices, either way.
        first: gain less 1, delay (s) and curvature (s^2) at the beginning, (3, axes, axes); None: 0
        period_s: of a sample.
    """

    rest_noise_m: tuple[float, ...]
    inverse: MatrixInverse | None = None
    coupled: bool = True
    roll_off_hz: float = 20.0
    cutoff_hz: float = 10.0
    gate_factor: float = 10.0
    memory_s: float = 10.0
    gain_sigma: float = 0.05
    delay_sigma_s: float = 0.00390625
    curvature_sigma_s2: float = 1.52587890625e-5
    gain_most: float = 0.3
    delay_most_s: float = 0.1
    first: FloatArray | None = field(default=None, compare=False)
    period_s: float = PERIOD_S

    @property
    def size(self) -> int:
        """How many axes."""
        return len(self.rest_noise_m)

    def struct(self) -> Any:
        """Return the C struct; raises ``CoreError`` for shapes that do not go together."""
        n = self.size
        if not 1 <= n <= AXES_MAX:
            raise CoreError(
                f"found {n} axes; 1 to {AXES_MAX} are allowed, each with its noise at rest"
            )
        inverse = self.inverse or MatrixInverse((), np.eye(n)[None])
        poles = len(inverse.pole_hz)
        given = np.asarray(inverse.coefficients, np.float64)
        if given.shape != (poles + 1, n, n) or poles > POLES_MAX:
            raise CoreError(
                f"found coefficients of shape {given.shape}; an inverse with {poles} poles (at "
                f"most {POLES_MAX}) and {n} axes needs the shape {(poles + 1, n, n)}"
            )
        first = np.zeros((3, n, n)) if self.first is None else np.asarray(self.first, np.float64)
        if first.shape != (3, n, n):
            raise CoreError(
                f"found starting values of shape {first.shape}; they must have the shape "
                f"{(3, n, n)}"
            )
        own = ("period_s", "roll_off_hz", "cutoff_hz", "gate_factor", "memory_s", "gain_most",
               "delay_most_s")  # fmt: skip
        return ffi.new(
            "rthyb_matrix_lead_config *",
            {name: getattr(self, name) for name in own}
            | {
                "size": n,
                "coupled": int(self.coupled),
                "poles": poles,
                "sigma": [self.gain_sigma, self.delay_sigma_s, self.curvature_sigma_s2],
                "rest_noise_m": list(self.rest_noise_m),
                "first": first.tolist(),
                "pole_hz": list(inverse.pole_hz),
                "inverse": given.tolist(),
            },
        )


class MatrixLead:
    """A compensation of several axes at work.

    Args:
        config: its settings.
        x0_m: where each axis is at rest; None: at 0.

    Raises:
        CoreError: a setting out of range, or an inverse of which the axes as they were fitted
            would be unstable.
    """

    def __init__(self, config: MatrixLeadConfig, x0_m: npt.ArrayLike | None = None) -> None:
        self.config = config
        self._c = ffi.new("rthyb_matrix_lead *")
        at = self._row(np.zeros(config.size) if x0_m is None else x0_m)
        check(lib.rthyb_matrix_lead_init(self._c, config.struct(), reading(at)))

    def rest(self, x_m: npt.ArrayLike) -> None:
        """Stand still at a place, (axes,); what has been learnt stays."""
        lib.rthyb_matrix_lead_rest(self._c, reading(self._row(x_m)))

    def observe(self, x_p_m: npt.ArrayLike, x_m_m: npt.ArrayLike, frozen: bool = False) -> int:
        """Take the newest commands and readings in, (axes,) each; return the status bits."""
        p, m = self._row(x_p_m), self._row(x_m_m)
        return int(lib.rthyb_matrix_lead_observe(self._c, reading(p), reading(m), frozen))

    def lead(self, x_c_m: npt.ArrayLike, allowed_m: float = float("inf")) -> tuple[FloatArray, int]:
        """Return x_p, (axes,), for the same instant as ``x_c_m``, (axes,), and the status bits.

        ``allowed_m``: as far as what was learnt since the last call may move a command.
        """
        out = np.empty(self.config.size)
        code = lib.rthyb_matrix_lead_lead(
            self._c, reading(self._row(x_c_m)), allowed_m, writing(out)
        )
        return out, int(code)

    def run(self, x_c_m: npt.ArrayLike) -> FloatArray:
        """Return x_p along commands, (n, axes) both, without learning."""
        given = doubles(x_c_m)
        if given.ndim != 2 or given.shape[1] != self.config.size:
            raise CoreError(
                f"found an array of shape {given.shape}; there must be one column for each of "
                f"the {self.config.size} axes"
            )
        out = np.empty_like(given)
        lib.rthyb_matrix_lead_run(
            self._c, reading(given.reshape(-1)), writing(out.reshape(-1)), len(given)
        )
        return out

    @property
    def matrices(self) -> FloatArray:
        """Gain, delay (s) and curvature (s^2) as the command has them, (3, axes, axes)."""
        return self._terms(self._c.used) + np.eye(self.config.size) * [[[1.0]], [[0.0]], [[0.0]]]

    @property
    def learnt(self) -> FloatArray:
        """The same as they were learnt last, (3, axes, axes)."""
        return self._terms(self._c.learnt) + np.eye(self.config.size) * [[[1.0]], [[0.0]], [[0.0]]]

    @property
    def learning(self) -> bool:
        """Whether the last pair was learnt from."""
        return bool(self._c.open)

    def _terms(self, struct: Any) -> FloatArray:
        n, h = self.config.size, self.config.period_s
        found = np.array(
            [[[struct[t][i][j] for j in range(n)] for i in range(n)] for t in range(3)]
        )
        return np.asarray(found * np.array([1.0, h, h * h])[:, None, None])

    def _row(self, values: npt.ArrayLike) -> FloatArray:
        given = doubles(values)
        if given.shape != (self.config.size,):
            raise CoreError(
                f"found an array of shape {given.shape}; there must be one number for each of "
                f"the {self.config.size} axes"
            )
        return given
