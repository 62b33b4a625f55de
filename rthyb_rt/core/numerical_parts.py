"""Numerical parts of several degrees of freedom, outside a controller: for tests and references."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rthyb_rt import core
from rthyb_rt._core import ffi, lib
from rthyb_rt.core import CoreError, DenseConfig, ElementConfig, FloatArray


class DensePart:
    """A linear part of up to `core.DENSE_MAX` degrees of freedom; raises ``CoreError``.

    Args:
        config: its matrices and integrator.
        x0_m: where the interface is at rest.
    """

    def __init__(self, config: DenseConfig, x0_m: float = 0.0) -> None:
        self.config = config
        self._settings, self._state = config.struct(), ffi.new("rthyb_dense *")
        kind = lib.RTHYB_NUMERICAL_DENSE
        self._c = ffi.new(
            "rthyb_numerical *", {"kind": kind, "cfg": self._settings, "state": self._state}
        )
        if lib.rthyb_numerical_init(self._c, x0_m):
            raise CoreError(
                "the numerical part was refused: mass must be positive definite, every matrix "
                "symmetric and finite, the starting value sensible"
            )
        self._out = ffi.new("double *")

    def answer(self, ag_mps2: float, force_n: float) -> tuple[float, int]:
        """Return x[n+1] of the interface from ground acceleration and force at t_n; status bits."""
        code = lib.rthyb_numerical_answer(self._c, ag_mps2, force_n, self._out)
        return self._out[0], code

    def advance(self) -> int:
        """Do the rest of the step that was answered; return the status bits."""
        return int(lib.rthyb_numerical_advance(self._c))

    def step(self, ag_mps2: float, force_n: float) -> tuple[float, int]:
        """Do both."""
        x, code = self.answer(ag_mps2, force_n)
        return x, code | self.advance()

    def freeze(self, force_n: float) -> None:
        """Let a tick pass in which the interface follows a path, with this force."""
        lib.rthyb_numerical_freeze(self._c, force_n)

    def save(self) -> bytes:
        """Return the state."""
        kept = ffi.new("char[]", lib.rthyb_numerical_size(self._c.kind))
        lib.rthyb_numerical_save(self._c, kept)
        return bytes(ffi.buffer(kept))

    def restore(self, state: bytes) -> None:
        """Go on from a state that `save` gave."""
        if len(state) != lib.rthyb_numerical_size(self._c.kind):
            raise CoreError(f"a state of {len(state)} bytes is none of a dense part")
        lib.rthyb_numerical_restore(self._c, ffi.from_buffer(state))

    def step_matrices(self) -> tuple[FloatArray, FloatArray]:
        """Return A (2n, 2n) and b (2n,) of s[n+1] = A s[n] + b force[n], s = (x, v)."""
        rows = 2 * len(self.config.load_kg)
        step = np.array(list(self._state.step[0 : rows * rows])).reshape(rows, rows)
        return step + np.eye(rows), np.array(list(self._state.by_force[0:rows]))

    def displacements(self) -> FloatArray:
        """Return where every degree of freedom is, m, (n,)."""
        values = np.zeros(core.DENSE_MAX)
        count = lib.rthyb_numerical_report(
            self._c, ffi.from_buffer("double[]", values, require_writable=True), values.size
        )
        return values[:count]

    def reference(
        self, elements: Sequence[ElementConfig], ag_mps2: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return displacement, velocity and specimen force at the interface, each (n,).

        Then the displacement of every degree of freedom, (n, degrees of freedom).

        Raises ``CoreError`` for too many elements or a ground motion that is not finite.
        """
        ag = core.finite_motion(elements, ag_mps2)
        array = core.element_array(elements)
        x, v, f = np.empty_like(ag), np.empty_like(ag), np.empty_like(ag)
        everywhere = np.empty((ag.size, len(self.config.load_kg)))
        out = [
            ffi.from_buffer("double[]", one, require_writable=True)
            for one in (x, v, f, everywhere.reshape(-1))
        ]
        lib.rthyb_numerical_reference(
            self._c,
            array,
            len(elements),
            ffi.from_buffer("double[]", ag),
            ag.size,
            self.config.period_s,
            *out,
            everywhere.shape[1],
        )
        return x, v, f, everywhere
