"""Compensation of several coupled actuators: matrices of gain, delay and curvature, followed by
an inverse of the identified axes (``csrc/matrix_lead.c``)."""

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
"""Largest number of poles of the inverse."""


@dataclass(frozen=True)
class MatrixInverse:
    """C(z) = C_0 + sum of C_k (1 - 1/z) / (1 - rho_k / z), rho_k = exp(-2 pi f_k h).

    Attributes:
        pole_hz: the frequencies f_k.
        coefficients: C_0, then all C_k, (1 + poles, axes, axes); rows are commands.
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
        """Return the factors of the coefficients at frequencies, (n, 1 + poles)."""
        back = np.exp(-2j * np.pi * np.atleast_1d(np.asarray(f_hz, np.float64)) * period_s)
        rho = np.exp(-2.0 * np.pi * np.asarray(pole_hz, np.float64) * period_s)
        moving = (1.0 - back[:, None]) / (1.0 - back[:, None] * rho)
        return np.concatenate([np.ones((back.size, 1)), moving], axis=1)


@dataclass(frozen=True)
class MatrixLeadConfig:
    """Settings of a `MatrixLead`.

    Attributes:
        rest_noise_m: standard deviation of each axis at rest; its length is the number of axes.
        inverse: inverse of the axes; None: C = 1.
        coupled: whether the matrices have off-diagonal terms.
        roll_off_hz: roll-off of the lead behind gain, delay and curvature.
        cutoff_hz: cut-off of the filter pair through which learning sees the signals.
        gate_factor: learn only while an axis moves with this many times the power of its noise.
        memory_s: time in which a sample's weight falls to 1/e.
        gain_sigma, delay_sigma_s, curvature_sigma_s2: standard deviation of a term's initial value.
        gain_most, delay_most_s: largest magnitude of every entry of the matrices.
        first: initial gain less 1, delay (s) and curvature (s^2), (3, axes, axes); None: 0.
        period_s: sampling period.
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
        """Number of axes."""
        return len(self.rest_noise_m)

    def struct(self) -> Any:
        """Return the C struct; raises ``CoreError`` for inconsistent shapes."""
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
    """A running compensation of several axes.

    Args:
        config: its settings.
        x0_m: initial displacement of each axis at rest; None: 0.

    Raises:
        CoreError: a setting is out of range, or the inverse would make the axes, as identified,
            unstable.
    """

    def __init__(self, config: MatrixLeadConfig, x0_m: npt.ArrayLike | None = None) -> None:
        self.config = config
        self._c = ffi.new("rthyb_matrix_lead *")
        at = self._row(np.zeros(config.size) if x0_m is None else x0_m)
        check(lib.rthyb_matrix_lead_init(self._c, config.struct(), reading(at)))

    def rest(self, x_m: npt.ArrayLike) -> None:
        """Come to rest at displacements, (axes,); what has been learnt is kept."""
        lib.rthyb_matrix_lead_rest(self._c, reading(self._row(x_m)))

    def observe(self, x_p_m: npt.ArrayLike, x_m_m: npt.ArrayLike, frozen: bool = False) -> int:
        """Process the newest commands and readings, (axes,) each; return the status bits."""
        p, m = self._row(x_p_m), self._row(x_m_m)
        return int(lib.rthyb_matrix_lead_observe(self._c, reading(p), reading(m), frozen))

    def lead(self, x_c_m: npt.ArrayLike, allowed_m: float = float("inf")) -> tuple[FloatArray, int]:
        """Return x_p, (axes,), for the same instant as ``x_c_m``, (axes,), and the status bits.

        ``allowed_m``: largest change of a command that may result from learning since the last
        call.
        """
        out = np.empty(self.config.size)
        code = lib.rthyb_matrix_lead_lead(
            self._c, reading(self._row(x_c_m)), allowed_m, writing(out)
        )
        return out, int(code)

    def run(self, x_c_m: npt.ArrayLike) -> FloatArray:
        """Return x_p along commands, both (n, axes), without learning."""
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
        """Gain, delay (s) and curvature (s^2) that the command uses, (3, axes, axes)."""
        return self._terms(self._c.used) + np.eye(self.config.size) * [[[1.0]], [[0.0]], [[0.0]]]

    @property
    def learnt(self) -> FloatArray:
        """Gain, delay (s) and curvature (s^2) as last learnt, (3, axes, axes)."""
        return self._terms(self._c.learnt) + np.eye(self.config.size) * [[[1.0]], [[0.0]], [[0.0]]]

    @property
    def learning(self) -> bool:
        """Whether the law learnt from the last pair."""
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
