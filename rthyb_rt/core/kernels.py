"""The parts of the controller and of the virtual rig, each separately, by sample or over arrays.

Every class owns the memory of one C struct; its methods are named after the functions of
``csrc/rthyb.h``, which states the contract. ``alpha`` is in samples, ``beta`` in samples squared.
Calls over arrays release the GIL.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import (
    CoreError,
    FloatArray,
    check,
    doubles,
    doubles_like,
    numbers_of,
    reading,
    require_one_length,
    writing,
)
from rthyb_rt.core.pending import during, raise_pending
from rthyb_rt.core.rows import CHANNELS_MAX
from rthyb_rt.core.settings import (
    ElementConfig,
    EstimatorConfig,
    LawConfig,
    MotionConfig,
    RfcConfig,
    RigConfig,
    init_element,
    rig_struct,
    struct_of,
)
from rthyb_rt.core.sizes import ELEMENTS_MAX, PERIOD_S

if TYPE_CHECKING:
    from rthyb_rt.core.station import Station


class Plc:
    """Phase-lead compensator (Eqn 2.5, with curvature term), at rest at ``x0_m``.

    Raises ``CoreError`` for weights outside the stable region of Fig. 2.1.
    """

    def __init__(self, w1: float = 3.0, w2: float = 2.0, x0_m: float = 0.0) -> None:
        self._c = ffi.new("rthyb_plc *")
        check(lib.rthyb_plc_init(self._c, w1, w2, x0_m))
        self._out = ffi.new("double *")

    def step(self, alpha: float, beta: float, x_c_m: float) -> tuple[float, int]:
        """Process one command; return the compensated command and the status bits."""
        code = lib.rthyb_plc_step(self._c, alpha, beta, x_c_m, self._out)
        return self._out[0], code

    def run(
        self, x_c_m: npt.ArrayLike, alpha: npt.ArrayLike, beta: npt.ArrayLike = 0.0
    ) -> FloatArray:
        """Return x_p for commands of shape (n,); alpha and beta are scalars or (n,)."""
        x = doubles(x_c_m)
        a, b = doubles_like(alpha, x), doubles_like(beta, x)
        out = np.empty_like(x)
        lib.rthyb_plc_run(self._c, reading(a), reading(b), reading(x), writing(out), x.size)
        return out

    def state(self) -> tuple[float, ...]:
        """Return the filter's memory: x[n-1], x[n-2], y[n-1], y[n-2]."""
        return (self._c.x1, self._c.x2, self._c.y1, self._c.y2)


def plc_is_stable(w1: float, w2: float) -> bool:
    """Return whether the poles of Eqn 2.5 lie inside the unit circle: |W1|>1, |W2|<|W1+1|."""
    return bool(lib.rthyb_plc_is_stable(w1, w2))


class Estimator:
    """Adaptive delay estimator for a compensator with these weights; raises ``CoreError``."""

    def __init__(
        self, config: EstimatorConfig, x0_m: float = 0.0, *, w1: float = 3.0, w2: float = 2.0
    ) -> None:
        self._c = ffi.new("rthyb_estimator *")
        struct = struct_of("rthyb_estimator_config", config)
        check(lib.rthyb_estimator_init(self._c, struct, w1, w2, x0_m))

    @property
    def alpha(self) -> float:
        """Current estimate, samples."""
        return float(self._c.alpha)

    @property
    def beta(self) -> float:
        """Current estimate of the curvature term, samples squared."""
        return float(self._c.beta)

    @property
    def gate_open(self) -> bool:
        """Whether the excitation of the last sample was sufficient to learn from it."""
        return bool(self._c.open)

    def step(self, x_p_m: float, x_m_m: float, frozen: bool = False) -> int:
        """Process one pair; return the status bits."""
        return int(lib.rthyb_estimator_step(self._c, x_p_m, x_m_m, frozen))

    def run(self, x_p_m: npt.ArrayLike, x_m_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return alpha and beta, each (n,), along pairs of shape (n,)."""
        p, m = doubles(x_p_m), doubles(x_m_m)
        require_one_length(p, m)
        alpha, beta = np.empty_like(p), np.empty_like(p)
        lib.rthyb_estimator_run(
            self._c, reading(p), reading(m), writing(alpha), writing(beta), p.size
        )
        return alpha, beta

    def state(self) -> dict[str, float]:
        """Return every number of the estimator's memory by name."""
        return numbers_of(self._c, skip=("cfg", "w1", "w2", "filter"))


class Law:
    """A control law on its own, without the rest of the controller; raises ``CoreError``."""

    def __init__(self, config: LawConfig, x0_m: float = 0.0, *, period_s: float = PERIOD_S) -> None:
        self.config = config
        self._c = ffi.new("rthyb_law *")
        struct = ffi.new("rthyb_law_config *", config.mapping())
        check(lib.rthyb_law_init(self._c, struct, period_s, x0_m))
        self._out = ffi.new("double *")
        self._values = ffi.new("double[]", lib.RTHYB_LAW_VALUES_MAX)

    def rest(self, x_m: float) -> None:
        """Come to rest at a displacement; what has been learnt is kept."""
        lib.rthyb_law_rest(self._c, x_m)
        raise_pending()

    def observe(self, x_p_m: float, x_m_m: float, frozen: bool = False) -> int:
        """Process the newest pair; return the status bits."""
        code = int(lib.rthyb_law_observe(self._c, x_p_m, x_m_m, frozen))
        raise_pending()
        return code

    def lead(self, x_c_m: float, allowed_m: float = float("inf")) -> tuple[float, int]:
        """Return x_p for the same instant, and the status bits.

        ``allowed_m``: largest change of the command that may result from learning since the last
        call.
        """
        code = lib.rthyb_law_lead(self._c, x_c_m, allowed_m, self._out)
        raise_pending()
        return self._out[0], code

    def run(self, x_c_m: npt.ArrayLike) -> FloatArray:
        """Return x_p for commands of shape (n,), without learning."""
        x = doubles(x_c_m)
        out = np.full_like(x, np.nan)
        with during(lambda: without_rig(out, now=0)):
            lib.rthyb_law_run(self._c, reading(x), writing(out), x.size)
        raise_pending()
        return out

    def follow(
        self, x_c_m: npt.ArrayLike, x_p_m: npt.ArrayLike, x_m_m: npt.ArrayLike
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return x_p and all reported values, each (n,), along recorded signals of shape (n,).

        At each sample the law observes the pair of ``x_p_m`` and ``x_m_m``, then compensates
        ``x_c_m``.
        """
        c, p, m = doubles(x_c_m), doubles(x_p_m), doubles(x_m_m)
        require_one_length(c, p, m)
        led = np.empty_like(c)
        names = [value.name for value in self.config.law.values]
        values = np.empty((c.size, len(names)))
        for n in range(c.size):
            self.observe(p[n], m[n])
            led[n], _ = self.lead(c[n])
            values[n] = list(self.report().values())
        return led, {name: values[:, i] for i, name in enumerate(names)}

    def report(self) -> dict[str, float]:
        """Return the values that the law reports, by name."""
        lib.rthyb_law_report(self._c, self._values)
        names = self.config.law.values
        return {value.name: float(self._values[i]) for i, value in enumerate(names)}

    def save(self) -> bytes:
        """Return the complete state of the law."""
        size = self.config.law.state_bytes
        return bytes(ffi.buffer(self._c.state.bytes, size))

    def restore(self, state: bytes) -> None:
        """Continue from a state that was saved by a law with the same settings."""
        ffi.memmove(self._c.state.bytes, state, self.config.law.state_bytes)


class Rfc:
    """Restoring-force compensator with its tangent stiffness; raises ``CoreError``."""

    def __init__(self, config: RfcConfig, x0_m: float = 0.0, f0_n: float = 0.0) -> None:
        self._c = ffi.new("rthyb_rfc *")
        check(lib.rthyb_rfc_init(self._c, struct_of("rthyb_rfc_config", config), x0_m, f0_n))
        self._out = ffi.new("double *")

    @property
    def k_n_per_m(self) -> float:
        """Current tangent stiffness, between 0 and k_e."""
        return float(self._c.k_n_per_m)

    def step(
        self,
        x_c_m: float,
        x_m_m: float,
        f_n: float,
        frozen: bool = False,
        v_c_m_per_s: float = 0.0,
    ) -> tuple[float, int]:
        """Return the force for the equation of motion (Eqn 3.2) and the status bits."""
        code = lib.rthyb_rfc_step(self._c, x_c_m, v_c_m_per_s, x_m_m, f_n, frozen, self._out)
        return self._out[0], code

    def follow(self, x_c_m: float, x_m_m: float, f_n: float) -> None:
        """Process a sample of a motion along a path."""
        lib.rthyb_rfc_follow(self._c, x_c_m, x_m_m, f_n)

    def run(
        self,
        x_c_m: npt.ArrayLike,
        x_m_m: npt.ArrayLike,
        f_n: npt.ArrayLike,
        v_c_m_per_s: npt.ArrayLike | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return compensated force and tangent stiffness, each (n,)."""
        c, m, f = doubles(x_c_m), doubles(x_m_m), doubles(f_n)
        v = np.zeros_like(c) if v_c_m_per_s is None else doubles(v_c_m_per_s)
        require_one_length(c, v, m, f)
        force, k = np.empty_like(c), np.empty_like(c)
        lib.rthyb_rfc_run(
            self._c,
            reading(c),
            reading(v),
            reading(m),
            reading(f),
            writing(force),
            writing(k),
            c.size,
        )
        return force, k


class Motion:
    """Equation of motion of the numerical part; raises ``CoreError``."""

    def __init__(self, config: MotionConfig, x0_m: float = 0.0) -> None:
        self._c = ffi.new("rthyb_motion *")
        check(lib.rthyb_motion_init(self._c, struct_of("rthyb_motion_config", config), x0_m))
        self._out = ffi.new("double *")

    def step(self, ag_mps2: float, force_n: float) -> tuple[float, int]:
        """Return x[n+1] from ground acceleration and force at t_n, and the status bits."""
        code = lib.rthyb_motion_step(self._c, ag_mps2, force_n, self._out)
        return self._out[0], code

    def reference(
        self, elements: Sequence[ElementConfig], ag_mps2: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return displacement, velocity and specimen force, each (n,), without rig or delay.

        Raises ``CoreError`` for too many elements or a ground motion that is not finite.
        """
        ag = finite_motion(elements, ag_mps2)
        array = element_array(elements)
        x, v, f = np.full_like(ag, np.nan), np.empty_like(ag), np.empty_like(ag)
        out = (writing(x), writing(v), writing(f))
        with during(lambda: without_rig(x)):
            lib.rthyb_run_reference(self._c, array, len(elements), reading(ag), ag.size, *out)
        raise_pending()
        return x, v, f


def without_rig(written: FloatArray, now: int = 1) -> str:
    """Return the moment of a simulation without a rig, in words.

    Args:
        written: its output, NaN from some tick on.
        now: 1 if that of the present tick is written already, 0 if it is not.
    """
    tick = max(0, int(np.count_nonzero(~np.isnan(written))) - now)
    return f"at tick {tick} of a simulation without the rig"


def finite_motion(elements: Sequence[ElementConfig], ag_mps2: npt.ArrayLike) -> FloatArray:
    """Return the ground motion of a reference simulation, (n,).

    Raises ``CoreError`` for too many elements or a value that is not finite.
    """
    ag = doubles(ag_mps2)
    if len(elements) > ELEMENTS_MAX:
        raise CoreError(f"found {len(elements)} elements; at most {ELEMENTS_MAX} are allowed")
    if not np.isfinite(ag).all():
        raise CoreError("the ground acceleration contains a value that is not finite")
    return ag


def element_array(elements: Sequence[ElementConfig]) -> Any:
    """Return the ``rthyb_element`` structs of fresh elements; raises ``CoreError``."""
    array = ffi.new("rthyb_element[]", max(len(elements), 1))
    for slot, config in zip(array, elements, strict=False):
        init_element(slot, config)
    return array


class CoreElement:
    """One specimen element with its history; raises ``CoreError``."""

    def __init__(self, config: ElementConfig) -> None:
        self._c = ffi.new("rthyb_element *")
        init_element(self._c, config)

    def force(self, x_m: float, v_m_per_s: float, a_m_per_s2: float, dt_s: float) -> float:
        """Return the resisting force, N, at one instant, and update the history."""
        force = float(lib.rthyb_element_force(self._c, x_m, v_m_per_s, a_m_per_s2, dt_s))
        raise_pending()
        return force

    def run(
        self,
        x_m: npt.ArrayLike,
        v_m_per_s: npt.ArrayLike = 0.0,
        a_m_per_s2: npt.ArrayLike = 0.0,
        dt_s: float = PERIOD_S,
    ) -> FloatArray:
        """Return the resisting force along a motion of shape (n,)."""
        x = doubles(x_m)
        v, a = doubles_like(v_m_per_s, x), doubles_like(a_m_per_s2, x)
        out = np.empty_like(x)
        lib.rthyb_element_run(
            self._c, reading(x), reading(v), reading(a), dt_s, writing(out), x.size
        )
        raise_pending()
        return out

    def state(self) -> tuple[float, ...]:
        """Return the history variables."""
        return tuple(self._c.state)


class VirtualRig:
    """The virtual rig in this process; raises ``CoreError``."""

    def __init__(self, config: RigConfig) -> None:
        self.config = config
        self._c = ffi.new("rthyb_rig *")
        check(lib.rthyb_rig_init(self._c, rig_struct(config)))
        self._x, self._f = ffi.new("double *"), ffi.new("double *")

    def step(self, x_p_m: float) -> tuple[float, float, int]:
        """Latch displacement and force, then apply the command; return both and status bits."""
        code = lib.rthyb_rig_step(self._c, x_p_m, self._x, self._f)
        raise_pending()
        return self._x[0], self._f[0], code

    def run(self, x_p_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return x_meas_m and f_meas_n, each (n,), along commands of shape (n,)."""
        p = doubles(x_p_m)
        x, f = np.empty_like(p), np.empty_like(p)
        lib.rthyb_rig_run(self._c, reading(p), writing(x), writing(f), p.size)
        raise_pending()
        return x, f

    def motion(self, x_p_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x (m), v (m/s), a (m/s^2) as latched, each (n,), along commands of shape (n,)."""
        p = doubles(x_p_m)
        out = np.empty((p.size, 3))
        servo, step = self._c.servo, lib.rthyb_rig_step
        for n, command in enumerate(p.tolist()):
            out[n] = servo.x, servo.v, servo.a
            step(self._c, command, self._x, self._f)
        return out[:, 0].copy(), out[:, 1].copy(), out[:, 2].copy()

    @property
    def extras(self) -> tuple[float, ...]:
        """Readings of the extra sensors at the last latch, each in its unit."""
        return tuple(self._c.extra[i] for i in range(len(self.config.extras)))

    def record_extras(self, station: Station, channel: int) -> None:
        """Write the extra sensors' readings of every sample into a station's row.

        Args:
            station: the station, which is kept alive with this rig.
            channel: channel of the row for the first of these readings.

        Raises:
            CoreError: the row has no room for them.
        """
        if not 0 <= channel <= CHANNELS_MAX - len(self.config.extras):
            raise CoreError(
                f"found channel {channel} and {len(self.config.extras)} extra sensors; a row has "
                f"only {CHANNELS_MAX} channels"
            )
        self._station = station
        self._c.extra_to = ffi.addressof(station._c.channel, channel)

    def reseed(self) -> None:
        """Restart the noise of the sensors from the seed."""
        lib.rthyb_rig_reseed(self._c)

    @property
    def true_displacement_m(self) -> float:
        """Displacement at the last latch without the sensor's errors."""
        return float(self._c.x_true_m)
