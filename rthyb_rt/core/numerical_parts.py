"""Numerical parts of several degrees of freedom without a controller: for tests and references."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rthyb_rt import core
from rthyb_rt._core import ffi, lib
from rthyb_rt.core import CoreError, DenseConfig, ElementConfig, FloatArray
from rthyb_rt.core.kernels import without_rig
from rthyb_rt.core.pending import during, raise_pending
from rthyb_rt.core.settings import fill_part
from rthyb_rt.core.sparse import SparseConfig

if TYPE_CHECKING:
    from rthyb_rt.core.own_parts import OwnPartConfig


class Part:
    """A numerical part with one or more interfaces; raises ``CoreError``.

    Args:
        config: its matrices and integrator.
        x0_m: displacement at which the interface is at rest; ignored by a sparse part, whose
            settings contain it.
    """

    refused = "the numerical part was rejected: every number must be finite and plausible"

    def __init__(
        self, config: DenseConfig | SparseConfig | OwnPartConfig, x0_m: float = 0.0
    ) -> None:
        self._c = ffi.new("rthyb_numerical *")
        self._kept = fill_part(self._c, config)
        refused = lib.rthyb_numerical_init(self._c, x0_m)
        raise_pending()
        if refused:
            raise CoreError(self.refused)
        self._period_s = config.period_s
        self._interfaces = int(lib.rthyb_numerical_interfaces(self._c))
        self._forces = ffi.new("double[]", self._interfaces)
        self._out = ffi.new("double[]", self._interfaces)

    def answer(self, ag_mps2: float, force_n: float) -> tuple[float, int]:
        """Return the interface's x[n+1] from ground acceleration and force at t_n; status bits."""
        x, code = self.answer_all(ag_mps2, [force_n])
        return float(x[0]), code

    def answer_all(self, ag_mps2: float, force_n: Sequence[float]) -> tuple[FloatArray, int]:
        """Return the same of all interfaces, (m,), from a force at each, (m,)."""
        for i, force in enumerate(force_n):
            self._forces[i] = force
        code = lib.rthyb_numerical_answer(self._c, ag_mps2, self._forces, self._out)
        raise_pending()
        return np.array(list(self._out)), int(code)

    def advance(self) -> int:
        """Do the rest of the step after `answer`; return the status bits."""
        code = int(lib.rthyb_numerical_advance(self._c))
        raise_pending()
        return code

    def step(self, ag_mps2: float, force_n: float) -> tuple[float, int]:
        """Call `answer` and `advance`."""
        x, code = self.answer(ag_mps2, force_n)
        return x, code | self.advance()

    def look(self) -> Any:
        """Return the state of the first interface at t_n as ``rthyb_interface``."""
        return self._look()[0]

    def _look(self) -> Any:
        all_of_them = ffi.new("rthyb_interface[]", self._interfaces)
        lib.rthyb_numerical_look(self._c, all_of_them)
        return all_of_them

    def motion(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return displacement, velocity and acceleration of all interfaces at t_n, (m,) each."""
        found = np.array([(one.x, one.v, one.a) for one in self._look()])
        return found[:, 0], found[:, 1], found[:, 2]

    def freeze(self, force_n: float) -> None:
        """Handle a tick in which the interface, under this force, follows a path."""
        self.freeze_all([force_n])

    def freeze_all(self, force_n: Sequence[float]) -> None:
        """Handle such a tick of all interfaces, with a force at each, (m,)."""
        for i, force in enumerate(force_n):
            self._forces[i] = force
        lib.rthyb_numerical_freeze(self._c, self._forces)
        raise_pending()

    @property
    def state_bytes(self) -> int:
        """Size of a state."""
        return int(lib.rthyb_numerical_size(self._c))

    def save(self) -> bytes:
        """Return the state."""
        kept = ffi.new("char[]", self.state_bytes)
        lib.rthyb_numerical_save(self._c, kept)
        return bytes(ffi.buffer(kept))

    def restore(self, state: bytes) -> None:
        """Continue from a state that `save` returned."""
        if len(state) != self.state_bytes:
            raise CoreError(
                f"found a state of {len(state)} bytes, which does not belong to this numerical "
                f"part: its state has {self.state_bytes}"
            )
        lib.rthyb_numerical_restore(self._c, ffi.from_buffer(state))

    def reported(self, most: int) -> FloatArray:
        """Return the values that the part reports, at most ``most`` of them."""
        values = np.zeros(most)
        out = ffi.from_buffer("double[]", values, require_writable=True)
        count = lib.rthyb_numerical_report(self._c, out, most)
        raise_pending()
        return values[:count]

    def joined(
        self, elements: Sequence[ElementConfig], ag_mps2: npt.ArrayLike, reports: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Run the part with elements attached directly to its interface.

        Args:
            elements: elements at the interface.
            ag_mps2: ground acceleration at every sample, (n,).
            reports: number of reported values per sample.

        Returns:
            Displacement, velocity and force at the interface, (n,) each; reported values,
            (n, reports).

        Raises:
            CoreError: there are too many elements or more than one interface, or the ground motion
                is not finite.
        """
        ag = core.finite_motion(elements, ag_mps2)
        if self._interfaces != 1:
            raise CoreError(
                f"found a numerical part with {self._interfaces} interfaces; a reference is "
                "simulated for one interface only"
            )
        array = core.element_array(elements)
        x, v, f = np.full_like(ag, np.nan), np.empty_like(ag), np.empty_like(ag)
        everywhere = np.empty((ag.size, reports))
        out = [
            ffi.from_buffer("double[]", one, require_writable=True)
            for one in (x, v, f, everywhere.reshape(-1))
        ]
        period_s, samples = self._period_s, ffi.from_buffer("double[]", ag)
        with during(lambda: without_rig(x)):
            lib.rthyb_numerical_reference(
                self._c, array, len(elements), samples, ag.size, period_s, *out, reports
            )
        raise_pending()
        return x, v, f, everywhere


class DensePart(Part):
    """A linear part of up to `core.DENSE_MAX` degrees of freedom."""

    refused = (
        "the numerical part was rejected: the mass matrix must be positive definite, every "
        "matrix symmetric and finite, and the starting value plausible"
    )

    def __init__(self, config: DenseConfig, x0_m: float = 0.0) -> None:
        super().__init__(config, x0_m)
        self.config = config

    def step_matrices(self) -> tuple[FloatArray, FloatArray]:
        """Return A (2n, 2n) and b (2n,) of s[n+1] = A s[n] + b force[n], s = (x, v)."""
        rows = 2 * len(self.config.load_kg)
        state = ffi.cast("rthyb_dense *", self._c.state)
        step = np.array(list(state.step[0 : rows * rows])).reshape(rows, rows)
        return step + np.eye(rows), np.array(list(state.by_force[0:rows]))

    def displacements(self) -> FloatArray:
        """Return the displacement of every degree of freedom, m, (n,)."""
        return self.reported(core.DENSE_MAX)

    def force_for(self, ag_mps2: float, x_next_m: FloatArray) -> FloatArray:
        """Return the force at t_n that moves the interface to its displacement at t_n+1, N, (1,).

        Only for a part that uses the force without delay.
        """
        state = ffi.cast("rthyb_dense *", self._c.state)
        at = self.config.at
        base = state.x + state.change + state.by_excitation[at] * ag_mps2
        return np.asarray((x_next_m - base) / state.by_force[at])

    def reference(
        self, elements: Sequence[ElementConfig], ag_mps2: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return displacement, velocity and specimen force at the interface, each (n,).

        The fourth value is the displacement of every degree of freedom, (n, dofs); see `joined`.
        """
        return self.joined(elements, ag_mps2, len(self.config.load_kg))


class SparsePart(Part):
    """A part of any size, with elements between its degrees of freedom."""

    def __init__(self, config: SparseConfig) -> None:
        super().__init__(config)
        self.config = config
        self._settings = self._kept[0]
        place = self._kept[2].place
        self._place = np.asarray(place)
        self._answers: dict[int, tuple[FloatArray, FloatArray]] = {}
        self._led: tuple[Any, Any, Any] | None = None

    def displacements(self) -> FloatArray:
        """Return the displacement of every degree of freedom, m, (n,)."""
        values = np.zeros(self.config.size)
        state = ffi.cast("rthyb_sparse *", self._c.state)
        out = ffi.from_buffer("double[]", values, require_writable=True)
        lib.rthyb_sparse_displacements(self._c.cfg, state, out, values.size)
        return np.asarray(values[self._place])

    def friction_effort(self) -> tuple[int, int, int, bool]:
        """Return what dry friction took in the last answer, between force and command.

        These are the number of linear solutions, that of elements which began to hold or to slide
        in them, the cost of evaluating force laws, and whether nothing was left until after the
        command; see ``rthyb_friction_effort``.
        """
        found = ffi.cast("rthyb_sparse *", self._c.state).friction_effort
        return found.passes, found.changes, found.law_cost, bool(found.settled)

    def force_for(self, ag_mps2: float, x_next_m: FloatArray) -> FloatArray:
        """Return the forces at t_n that lead to the interfaces' next displacements, N, (m,).

        Dry friction that is solved for with the step is that of these forces; the state stays as
        it is.
        """
        state = ffi.cast("rthyb_sparse *", self._c.state)
        m, stepped = self._interfaces, int(state.stepped)
        if stepped not in self._answers:
            gain = np.array(list(state.gain[stepped][0 : m * m])).reshape(m, m)
            pull = np.array(list(state.pull[stepped][0:m]))
            self._answers[stepped] = np.linalg.inv(gain), pull
        by_displacement, pull = self._answers[stepped]
        base = np.array(list(state.base[0:m]))
        force = np.asarray(by_displacement @ (x_next_m - base - ag_mps2 * pull))
        if stepped and self._settings.sliders > 0:
            held_back = x_next_m - self._moved_with_friction(ag_mps2, force, by_displacement)
            force = force + by_displacement @ held_back
        return force

    def _moved_with_friction(
        self, ag_mps2: float, force_n: FloatArray, by_displacement: FloatArray
    ) -> FloatArray:
        """Return x[n+1] under forces that lack those which overcome the friction, m, (m,).

        The friction is nevertheless that of the motion which these would lead to without it.
        """
        if self._led is None:
            self._led = self._led_interfaces(by_displacement)
        kept = self.save()
        forces = ffi.new("double[]", force_n.tolist())
        lib.rthyb_numerical_answer(self._led[0], ag_mps2, forces, self._out)
        lib.rthyb_numerical_advance(self._led[0])
        moved = np.asarray(self.config.interface_rows() @ self.displacements())
        self.restore(kept)
        return moved

    def _led_interfaces(self, by_displacement: FloatArray) -> tuple[Any, Any, Any]:
        """Return this part with sliders that act on each other as if the interfaces were led.

        Where friction f_r takes D f_r from the interfaces' x[n+1] (``slider_x``), forces A D f_r
        restore it, A = ``by_displacement``. They change the sliders' velocities by -c D' A D f_r,
        c = gamma h / ((1/2 + gamma) h^2), because S is symmetric; see numerical_sparse.c. So the
        interaction G of the sliders becomes G + c D' A D, where A is negative definite.
        """
        cfg = ffi.new("rthyb_sparse_config *", self._settings[0])
        count = cfg.sliders
        g = np.array(list(cfg.slider_g[0 : count * count])).reshape(count, count)
        d = np.array(list(cfg.slider_x[0 : self._interfaces * count])).reshape(-1, count)
        c = cfg.gamma / ((0.5 + cfg.gamma) * cfg.period_s)
        led = g + c * d.T @ by_displacement @ d
        # The interfaces alone move such a slider: what is left is rounding.
        led_only = np.diag(led) <= 1e-9 * np.diag(g)
        led[led_only, :] = led[:, led_only] = 0.0
        cfg.slider_g = between = ffi.new("double[]", led.ravel().tolist())
        part = ffi.new("rthyb_numerical *", self._c[0])
        part.cfg = cfg
        return part, cfg, between

    def step_time_s(self, steps: int = 200) -> float:
        """Return the median computing time of a step on this computer, s; the state advances."""
        taken = []
        for i in range(steps):
            begun = time.perf_counter_ns()
            self.answer_all(0.1 * (-1.0) ** i, [0.0] * self._interfaces)
            self.advance()
            taken.append(time.perf_counter_ns() - begun)
        return float(np.median(taken)) * 1e-9

    def responses(self) -> FloatArray:
        """Return the responses of this sample, (count,); call between `answer` and `advance`."""
        return self.reported(len(self.config.responses))
