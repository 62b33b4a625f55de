"""The thin face of the C core: ndarrays and dataclasses in, ndarrays out.

Only this module and the faces of the parts that wait or talk (`ticker`, `ring`, `links.wire`,
`loop`) touch cffi. Every class owns the memory of one C struct; its methods
are named after the functions of ``csrc/rthyb.h``, where the contract stands. SI units throughout;
``alpha`` is in samples, ``beta`` in samples squared. Calls over arrays run without the GIL.
"""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt

from rthyb_rt import recording
from rthyb_rt._core import ffi, lib
from rthyb_rt.errors import RthybError
from rthyb_rt.laws import LAWS

if TYPE_CHECKING:
    from rthyb_rt.links.wire import Codec

FS_HZ: Final = 1024.0
"""The rate of real time. That of a test in virtual time is its own: `experiment.Setup.rate`."""
PERIOD_S: Final = 1.0 / FS_HZ
WINDOW_MAX: Final[int] = lib.RTHYB_WINDOW_MAX
DELAY_MAX: Final[int] = lib.RTHYB_DELAY_MAX
ELEMENTS_MAX: Final[int] = lib.RTHYB_ELEMENTS_MAX
DENSE_MAX: Final[int] = lib.RTHYB_DENSE_MAX
IWAN_SLIDERS: Final[int] = lib.RTHYB_IWAN_SLIDERS

FloatArray = npt.NDArray[np.float64]
RecordArray = npt.NDArray[np.void]

STATUS: Final[dict[str, int]] = {
    "not_finite": lib.RTHYB_S_NOT_FINITE,
    "out_of_range": lib.RTHYB_S_OUT_OF_RANGE,
    "limited": lib.RTHYB_S_LIMITED,
    "position_limit": lib.RTHYB_S_POSITION_LIMIT,
    "force_limit": lib.RTHYB_S_FORCE_LIMIT,
    "tracking_limit": lib.RTHYB_S_TRACKING_LIMIT,
    "link_lost": lib.RTHYB_S_LINK_LOST,
    "trip": lib.RTHYB_S_TRIP,
    "velocity_limit": lib.RTHYB_S_VELOCITY_LIMIT,
    "increment_limit": lib.RTHYB_S_INCREMENT_LIMIT,
    "indicator_limit": lib.RTHYB_S_INDICATOR_LIMIT,
    "energy_limit": lib.RTHYB_S_ENERGY_LIMIT,
    "sensor_stuck": lib.RTHYB_S_SENSOR_STUCK,
    "sensor_jump": lib.RTHYB_S_SENSOR_JUMP,
    "lost_rate": lib.RTHYB_S_LOST_RATE,
    "skip_rate": lib.RTHYB_S_SKIP_RATE,
}
FLAGS: Final = recording.FLAGS
FLAG_NAMES: Final = tuple(FLAGS)
STATE_NAMES: Final = recording.STATES

_REFUSED: Final[dict[int, str]] = {
    lib.RTHYB_E_PERIOD: "the sampling period must lie in (0, 1] s and be the same for all parts, "
    "and every cut-off below half of its rate",
    lib.RTHYB_E_WEIGHTS: "W1, W2 lie outside the stable region |W1| > 1, |W2| < |W1 + 1|",
    lib.RTHYB_E_ESTIMATOR: "a setting of the delay estimator is out of range",
    lib.RTHYB_E_WINDOW: f"the window T0 must lie in 1 ... {WINDOW_MAX} samples",
    lib.RTHYB_E_STIFFNESS: "the RFC needs an elastic stiffness k_e > 0 and a noise >= 0",
    lib.RTHYB_E_MOTION: "mass must be positive, damping >= 0, everything finite",
    lib.RTHYB_E_SERVO: "a setting of the actuator model is out of range, or its oil column is too "
    "stiff for its mass and substeps",
    lib.RTHYB_E_ELEMENT: "an element's kind, parameter count or a parameter is out of range",
    lib.RTHYB_E_SENSOR: "a sensor's noise, lsb, bias or range is out of range",
    lib.RTHYB_E_LAW: "there is no such control law, or it cannot work with its settings",
    lib.RTHYB_E_LIMIT: "a limit must be finite and >= 0, a starting value finite and sensible",
}


class CoreError(RthybError, ValueError):
    """The core refused a setting; the message says which kind."""


def status_names(code: int) -> list[str]:
    """Return the names of the status bits set in ``code``."""
    return [name for name, bit in STATUS.items() if code & bit]


def version() -> str:
    """Return the version of the compiled core."""
    return _text(lib.rthyb_version())


def build_facts() -> dict[str, str]:
    """Return what bit-identical replay depends on: the core's sources, compiler, architecture."""
    return {
        "core_version": version(),
        "core_sources": _text(lib.rthyb_source_hash()),
        "compiler": _text(lib.rthyb_compiler()),
        "architecture": platform.machine(),
    }


# ---- the record ---------------------------------------------------------------------------------

_NUMPY_NAME: Final[dict[str, str]] = {
    "uint16_t": "<u2",
    "uint32_t": "<u4",
    "int32_t": "<i4",
    "uint64_t": "<u8",
    "int64_t": "<i8",
    "double": "<f8",
}


def _flat(ctype: Any, offset: int = 0, suffix: str = "") -> list[tuple[str, str, int]]:
    """Return name, type and place of every number in a struct; those of axis 1 are "x_cmd_m.1"."""
    found = []
    for name, f in ctype.fields:
        at = offset + f.offset
        if f.type.kind == "array":
            size = ffi.sizeof(f.type.item)
            for k in range(f.type.length):
                found += _flat(f.type.item, at + k * size, f".{k}" if k else "")
        else:
            found.append((name + suffix, _NUMPY_NAME[f.type.cname], at))
    return found


def _dtype_of(struct: str) -> np.dtype[np.void]:
    numbers = _flat(ffi.typeof(struct))
    return np.dtype(
        {
            "names": [name for name, _, _ in numbers],
            "formats": [kind for _, kind, _ in numbers],
            "offsets": [at for _, _, at in numbers],
            "itemsize": ffi.sizeof(struct),
        }
    )


RECORD_DTYPE: Final = _dtype_of("rthyb_record")
CHANNELS_MAX: Final[int] = lib.RTHYB_CHANNELS_MAX


def row_dtype(channels: Sequence[recording.Channel]) -> np.dtype[np.void]:
    """Return the type of a row of a recording, and of a ring: a record and its channels.

    Raises:
        CoreError: the channels are too many, or not to be told apart.
    """
    try:
        recording.check_channels(channels)
    except ValueError as error:
        raise CoreError(str(error)) from error
    if not channels:
        return RECORD_DTYPE
    fields: Mapping[str, Any] = RECORD_DTYPE.fields or {}
    size, count = RECORD_DTYPE.itemsize, len(channels)
    return np.dtype(
        {
            "names": [*fields, *(channel.name for channel in channels)],
            "formats": [*(f[0] for f in fields.values()), *["<f8"] * count],
            "offsets": [*(f[1] for f in fields.values()), *(size + 8 * k for k in range(count))],
            "itemsize": size + 8 * count,
        }
    )


def rows_of(
    records: RecordArray, channels: Sequence[recording.Channel], values: FloatArray
) -> RecordArray:
    """Return rows, (n,), of records, (n,), and the values of their channels, (n, count)."""
    rows = np.zeros(records.shape, dtype=row_dtype(channels))
    for name in RECORD_DTYPE.names or ():
        rows[name] = records[name]
    for k, channel in enumerate(channels):
        rows[channel.name] = values[:, k]
    return rows


def as_records(rows: RecordArray) -> RecordArray:
    """Return rows of a recording, whose fields may be more and in another order, as the core's."""
    if rows.dtype == RECORD_DTYPE:
        return np.ascontiguousarray(rows)
    records = np.zeros(rows.shape, dtype=RECORD_DTYPE)
    for name in RECORD_DTYPE.names or ():
        records[name] = rows[name]
    return records


# ---- configuration of the kernels ---------------------------------------------------------------

EstimatorLaw = Literal["fixed", "gradient", "robust", "rls"]
Tangent = Literal["mean-of-ratios", "least-squares"]
Divisor = Literal["printed", "terms"]
Integrator = Literal["central-difference", "forward-euler", "cr", "kr-alpha", "prescribed"]
DenseIntegrator = Literal["cr", "rk4"]
ServoKind = Literal["pure-delay", "first-order", "second-order", "servo-hydraulic", "servo-valve"]
Hold = Literal["zoh", "foh"]
LoadCell = Literal["actuator-end", "specimen"]

_ENUMS: Final[dict[str, dict[str, int]]] = {
    "law": {
        "fixed": lib.RTHYB_LAW_FIXED,
        "gradient": lib.RTHYB_LAW_GRADIENT,
        "robust": lib.RTHYB_LAW_ROBUST,
        "rls": lib.RTHYB_LAW_RLS,
    },
    "tangent": {
        "mean-of-ratios": lib.RTHYB_TANGENT_MEAN_OF_RATIOS,
        "least-squares": lib.RTHYB_TANGENT_LEAST_SQUARES,
    },
    "divisor": {"printed": lib.RTHYB_DIVISOR_PRINTED, "terms": lib.RTHYB_DIVISOR_TERMS},
    "integrator": {
        "central-difference": lib.RTHYB_CENTRAL_DIFFERENCE,
        "forward-euler": lib.RTHYB_FORWARD_EULER,
        "cr": lib.RTHYB_CR,
        "kr-alpha": lib.RTHYB_KR_ALPHA,
        "prescribed": lib.RTHYB_PRESCRIBED,
        "rk4": lib.RTHYB_RK4,
    },
    "kind": {
        "pure-delay": lib.RTHYB_PURE_DELAY,
        "first-order": lib.RTHYB_FIRST_ORDER,
        "second-order": lib.RTHYB_SECOND_ORDER,
        "servo-hydraulic": lib.RTHYB_SERVO_HYDRAULIC,
        "servo-valve": lib.RTHYB_SERVO_VALVE,
    },
    "hold": {"zoh": lib.RTHYB_ZOH, "foh": lib.RTHYB_FOH},
    "load_cell": {"actuator-end": lib.RTHYB_ACTUATOR_END, "specimen": lib.RTHYB_SPECIMEN_END},
}


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of the delay estimator (Eqn 2.6-2.11 and its sturdier relatives).

    ``gain`` is per reference_m squared per sample for the law ``gradient``, per sample for
    ``robust``; ``memory_samples`` belongs to ``rls``.
    """

    law: EstimatorLaw = "fixed"
    estimate_beta: bool = False
    alpha0: float = 0.0
    beta0: float = 0.0
    period_s: float = PERIOD_S
    reference_m: float = 1e-3
    gain: float = 0.0
    memory_samples: float = 2048.0
    cutoff_hz: float = 25.0
    alpha_min: float = 0.0
    alpha_max: float = 60.0
    rest_noise_m: float = 0.0
    gate_factor: float = 10.0


@dataclass(frozen=True)
class LawConfig:
    """A control law by its name, with the settings that are not its table's defaults.

    ``settings`` is by the keys of `rthyb_rt.laws`; ``adapts`` False: what it would learn stays as
    it begins. ``rest_noise_m``: standard deviation of x_m at rest.
    """

    name: str = "none"
    settings: Mapping[str, float] = field(default_factory=dict)
    adapts: bool = True
    rest_noise_m: float = 0.0

    def values(self) -> list[float]:
        """Return all settings in the core's order.

        Raises:
            CoreError: there is no such law or setting, or one without a default is missing.
        """
        law = LAWS.get(self.name)
        if law is None:
            raise CoreError(f"control law {self.name!r}: unknown; there are {', '.join(LAWS)}")
        try:
            return law.ordered(self.settings)
        except ValueError as error:
            raise CoreError(str(error)) from None

    def mapping(self) -> dict[str, Any]:
        """Return the ``rthyb_law_config`` of the C core as a mapping; raises ``CoreError``."""
        return {
            "parameters": self.values(),
            "kind": LAWS[self.name].kind,
            "adapts": self.adapts,
            "rest_noise_m": self.rest_noise_m,
        }


@dataclass(frozen=True)
class RfcConfig:
    """Settings of the restoring-force compensator (Eqn 3.1-3.3); ``window`` is T0 in samples.

    ``cutoff_hz`` is of the low-pass on x_c - x_m, 0 for none; ``lateness_s`` how much later than
    x_m the force is that the equation of motion uses.
    """

    k_e_n_per_m: float
    enabled: bool = True
    tangent: Tangent = "mean-of-ratios"
    divisor: Divisor = "printed"
    window: int = 51
    end_tick: int = 2**63
    rest_noise_m: float = 0.0
    period_s: float = PERIOD_S
    cutoff_hz: float = 0.0
    lateness_s: float = 0.0


@dataclass(frozen=True)
class MotionConfig:
    """Settings of the equation of motion and its integrator."""

    integrator: Integrator
    mass_kg: float = 0.0
    damping_n_s_per_m: float = 0.0
    stiffness_n_per_m: float = 0.0
    k_e_n_per_m: float = 0.0
    added_mass_kg: float = 0.0
    rho_inf: float = 1.0
    period_s: float = PERIOD_S


Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class DenseConfig:
    """Settings of a numerical part of n degrees of freedom, ``M a + C v + K x + e f = -load ag``.

    ``mass_kg``, ``damping_n_s_per_m`` and ``stiffness_n_per_m`` (n, n) are the part's own,
    symmetric; ``load_kg`` (n,). e is 1 at the interface, number ``at`` from 0. What is known of the
    specimen goes into the coefficients of CR alone. ``force_delay``: samples by which the force is
    used late, 0 or 1.
    """

    integrator: DenseIntegrator
    mass_kg: Matrix
    damping_n_s_per_m: Matrix
    stiffness_n_per_m: Matrix
    load_kg: tuple[float, ...]
    at: int = 0
    specimen_mass_kg: float = 0.0
    specimen_damping_n_s_per_m: float = 0.0
    k_e_n_per_m: float = 0.0
    force_delay: int = 0
    period_s: float = PERIOD_S

    def struct(self) -> Any:
        """Return the ``rthyb_dense_config`` of the C core.

        Raises:
            CoreError: the matrices are not square, not of one size, or too large.
        """
        n = len(self.load_kg)
        names = ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")
        for name in names:
            shape = np.shape(getattr(self, name))
            if not 1 <= n <= DENSE_MAX or shape != (n, n):
                raise CoreError(
                    f"{name} is {shape} with {n} loads; both must have one size from 1 to "
                    f"{DENSE_MAX}"
                )
        plain = _mapping(self) | {"size": n}
        flat = {name: [v for row in plain[name] for v in row] for name in names}
        return ffi.new("rthyb_dense_config *", plain | flat)


@dataclass(frozen=True)
class ServoConfig:
    """Settings of a virtual actuator; which of them count depends on ``kind``."""

    kind: ServoKind
    hold: Hold = "zoh"
    period_s: float = PERIOD_S
    delay_samples: float = 0.0
    roll_off_hz: float = 0.0
    natural_frequency_hz: float = 0.0
    damping_ratio: float = 0.0
    gain: float = 1.0
    kp_per_s: float = 0.0
    ki_per_s2: float = 0.0
    valve_time_constant_s: float = 0.0
    stall_force_n: float = 0.0
    flow_limit_m_per_s: float = 0.0
    oil_stiffness_n_per_m: float = 0.0
    oil_damping_n_s_per_m: float = 0.0
    moving_mass_kg: float = 0.0
    friction_n: float = 0.0
    friction_width_m_per_s: float = 0.0
    viscous_n_s_per_m: float = 0.0
    substeps: int = 16
    valve_n_per_m_s3: float = 0.0
    valve_b1_per_s: float = 0.0
    valve_b2_per_s2: float = 0.0
    velocity_feedback_n_s_per_m2: float = 0.0
    leakage_per_s: float = 0.0
    command_range_m: float = 0.0
    command_lsb_m: float = 0.0


@dataclass(frozen=True)
class SensorConfig:
    """Errors of one sensor, in its own unit; 0 switches ``lsb`` and ``range`` off."""

    noise_std: float = 0.0
    lsb: float = 0.0
    bias: float = 0.0
    range: float = 0.0


@dataclass(frozen=True)
class ElementConfig:
    """One element of the catalogue: its kind and its parameters in the core's order."""

    kind: str
    params: tuple[float, ...]


@dataclass(frozen=True)
class RigConfig:
    """A virtual rig: actuator, specimen, sensors."""

    servo: ServoConfig
    elements: tuple[ElementConfig, ...] = ()
    displacement: SensorConfig = SensorConfig()
    force: SensorConfig = SensorConfig()
    load_cell: LoadCell = "actuator-end"
    seed: int = 0


@dataclass(frozen=True)
class ControllerConfig:
    """All that one sample of the controller needs to know.

    ``numerical`` takes the place of ``motion``, unless that is prescribed.
    """

    law: LawConfig
    rfc: RfcConfig
    motion: MotionConfig
    lead_enabled: bool = True
    period_s: float = PERIOD_S
    x_range_m: float = 0.0
    f_range_n: float = 0.0
    velocity_limit_m_per_s: float = 0.0
    acceleration_limit_m_per_s2: float = 0.0
    clamp_m: float = 0.0
    numerical: DenseConfig | None = None


ELEMENT_PARAMS: Final[dict[str, tuple[str, ...]]] = {
    "stiffness": ("k_n_per_m",),
    "viscous": ("c_n_s_per_m",),
    "coulomb": ("fc_n", "width_m_per_s"),
    "stribeck": ("fc_n", "fs_n", "vs_m_per_s", "width_m_per_s"),
    "lugre": (
        "fc_n",
        "fs_n",
        "vs_m_per_s",
        "sigma0_n_per_m",
        "sigma1_n_s_per_m",
        "sigma2_n_s_per_m",
    ),
    "quad_damping": ("c2_n_s2_per_m2",),
    "inertia": ("m_kg",),
    "gap": ("k_n_per_m", "gap_m"),
    "cubic": ("k3_n_per_m3",),
    "quadratic": ("k2_n_per_m2",),
    "stopper": ("ks_n_per_m", "xs_m"),
    "hysteresis": ("k_n_per_m", "post_yield_ratio", "a", "b", "c", "eta"),
    "pinching": ("k_n_per_m", "post_yield_ratio", "a", "b", "c", "eta", "depth", "width_ratio"),
    "degradation": ("k_n_per_m", "post_yield_ratio", "a", "b", "c", "eta", "loss", "travel_m"),
    "maxwell": ("km_n_per_m", "tau_s"),
    "second_mode": ("m2_kg", "f2_hz", "zeta2"),
    "p_delta": ("gravity_load_n", "height_m"),
    "gap_friction": ("k_n_per_m", "gap_m", "fc_up_n", "fc_down_n", "seat_m"),
    "coulomb_uneven": ("fc_up_n", "fc_down_n", "width_m_per_s"),
    "gap_uneven": ("k_up_n_per_m", "gap_up_m", "k_down_n_per_m", "gap_down_m"),
    "power_damping": ("force_n", "at_m_per_s", "exponent", "width_m_per_s"),
    "power_spring": ("force_n", "at_m", "exponent", "width_m"),
    "pendulum": ("weight_n", "length_m"),
    "friction_pendulum": (
        "weight_n",
        "radius_m",
        "mu_slow",
        "mu_fast",
        "mu_rate_s_per_m",
        "xy_m",
    ),
    "iwan": ("k_n_per_m", "post_yield_ratio", "xy_m", "spread"),
    "menegotto_pinto": ("k_n_per_m", "post_yield_ratio", "xy_m", "r0", "cr1", "cr2"),
    "chaboche": (
        "k_n_per_m",
        "fy_n",
        "kinematic_n_per_m",
        "recovery_per_m",
        "isotropic_n",
        "isotropic_rate_per_m",
    ),
    "rc_column": (
        "k_n_per_m",
        "post_yield_ratio",
        "xy_m",
        "eta",
        "pivot",
        "ultimate_m",
        "strength_lost_at_ultimate",
        "energy_j",
        "strength_lost_with_energy",
        "stiffness_lost_with_energy",
        "slip",
        "slip_level",
        "slip_width",
    ),
}
_ELEMENT_KIND: Final = {name: getattr(lib, f"RTHYB_{name.upper()}") for name in ELEMENT_PARAMS}


def element(kind: str, /, **params: float) -> ElementConfig:
    """Return an element of the catalogue from its parameters by name.

    Raises ``CoreError`` for an unknown kind, a missing or a surplus parameter.
    """
    names = ELEMENT_PARAMS.get(kind)
    if names is None:
        raise CoreError(f"element {kind!r}: unknown; the catalogue has {', '.join(ELEMENT_PARAMS)}")
    if set(params) != set(names):
        raise CoreError(f"element {kind!r}: takes {', '.join(names)}, got {', '.join(params)}")
    return ElementConfig(kind, tuple(float(params[name]) for name in names))


# ---- kernels ------------------------------------------------------------------------------------


class Plc:
    """Phase-lead compensator (Eqn 2.5, with curvature term), at rest at ``x0_m``.

    Raises ``CoreError`` for weights outside the stable region of Fig. 2.1.
    """

    def __init__(self, w1: float = 3.0, w2: float = 2.0, x0_m: float = 0.0) -> None:
        self._c = ffi.new("rthyb_plc *")
        _check(lib.rthyb_plc_init(self._c, w1, w2, x0_m))
        self._out = ffi.new("double *")

    def step(self, alpha: float, beta: float, x_c_m: float) -> tuple[float, int]:
        """Take one command in; return the compensated command and the status bits."""
        code = lib.rthyb_plc_step(self._c, alpha, beta, x_c_m, self._out)
        return self._out[0], code

    def run(
        self, x_c_m: npt.ArrayLike, alpha: npt.ArrayLike, beta: npt.ArrayLike = 0.0
    ) -> FloatArray:
        """Return x_p for commands of shape (n,); alpha and beta are scalars or (n,)."""
        x = _doubles(x_c_m)
        a, b = _like(alpha, x), _like(beta, x)
        out = np.empty_like(x)
        lib.rthyb_plc_run(self._c, _in(a), _in(b), _in(x), _out(out), x.size)
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
        struct = _struct("rthyb_estimator_config", config)
        _check(lib.rthyb_estimator_init(self._c, struct, w1, w2, x0_m))

    @property
    def alpha(self) -> float:
        """Present estimate, samples."""
        return float(self._c.alpha)

    @property
    def beta(self) -> float:
        """Present estimate of the curvature term, samples squared."""
        return float(self._c.beta)

    @property
    def gate_open(self) -> bool:
        """Whether the last sample was exciting enough to learn from."""
        return bool(self._c.open)

    def step(self, x_p_m: float, x_m_m: float, frozen: bool = False) -> int:
        """Take one pair in; return the status bits."""
        return int(lib.rthyb_estimator_step(self._c, x_p_m, x_m_m, frozen))

    def run(self, x_p_m: npt.ArrayLike, x_m_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return alpha and beta, each (n,), along pairs of shape (n,)."""
        p, m = _doubles(x_p_m), _doubles(x_m_m)
        _same_length(p, m)
        alpha, beta = np.empty_like(p), np.empty_like(p)
        lib.rthyb_estimator_run(self._c, _in(p), _in(m), _out(alpha), _out(beta), p.size)
        return alpha, beta

    def state(self) -> dict[str, float]:
        """Return every number of the estimator's memory by name."""
        return _numbers(self._c, skip=("cfg", "w1", "w2", "filter"))


class Law:
    """A control law at work, without the controller around it; raises ``CoreError``."""

    def __init__(self, config: LawConfig, x0_m: float = 0.0, *, period_s: float = PERIOD_S) -> None:
        self.config = config
        self._c = ffi.new("rthyb_law *")
        struct = ffi.new("rthyb_law_config *", config.mapping())
        _check(lib.rthyb_law_init(self._c, struct, period_s, x0_m))
        self._out = ffi.new("double *")
        self._values = ffi.new("double[]", lib.RTHYB_LAW_VALUES_MAX)

    def rest(self, x_m: float) -> None:
        """Stand still at a place; what has been learnt stays."""
        lib.rthyb_law_rest(self._c, x_m)

    def observe(self, x_p_m: float, x_m_m: float, frozen: bool = False) -> int:
        """Take the newest pair in; return the status bits."""
        return int(lib.rthyb_law_observe(self._c, x_p_m, x_m_m, frozen))

    def lead(self, x_c_m: float, allowed_m: float = float("inf")) -> tuple[float, int]:
        """Return x_p for the same instant, and the status bits.

        ``allowed_m``: as far as what was learnt since the last call may move the command.
        """
        code = lib.rthyb_law_lead(self._c, x_c_m, allowed_m, self._out)
        return self._out[0], code

    def run(self, x_c_m: npt.ArrayLike) -> FloatArray:
        """Return x_p for commands of shape (n,), without learning."""
        x = _doubles(x_c_m)
        out = np.empty_like(x)
        lib.rthyb_law_run(self._c, _in(x), _out(out), x.size)
        return out

    def follow(
        self, x_c_m: npt.ArrayLike, x_p_m: npt.ArrayLike, x_m_m: npt.ArrayLike
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return x_p and all reported values, each (n,), along recorded signals of shape (n,).

        At each sample the law takes in the pair of ``x_p_m`` and ``x_m_m``, then leads ``x_c_m``.
        """
        c, p, m = _doubles(x_c_m), _doubles(x_p_m), _doubles(x_m_m)
        _same_length(c, p, m)
        led = np.empty_like(c)
        names = [value.name for value in LAWS[self.config.name].values]
        values = np.empty((c.size, len(names)))
        for n in range(c.size):
            self.observe(p[n], m[n])
            led[n], _ = self.lead(c[n])
            values[n] = list(self.report().values())
        return led, {name: values[:, i] for i, name in enumerate(names)}

    def report(self) -> dict[str, float]:
        """Return what the law reports, by name."""
        lib.rthyb_law_report(self._c, self._values)
        names = LAWS[self.config.name].values
        return {value.name: float(self._values[i]) for i, value in enumerate(names)}

    def save(self) -> bytes:
        """Return the law's state, all of it."""
        size = LAWS[self.config.name].state_bytes
        return bytes(ffi.buffer(self._c.state.bytes, size))

    def restore(self, state: bytes) -> None:
        """Go on from a state that a law of the same settings has saved."""
        ffi.memmove(self._c.state.bytes, state, LAWS[self.config.name].state_bytes)


class Rfc:
    """Restoring-force compensator with its tangent stiffness; raises ``CoreError``."""

    def __init__(self, config: RfcConfig, x0_m: float = 0.0, f0_n: float = 0.0) -> None:
        self._c = ffi.new("rthyb_rfc *")
        _check(lib.rthyb_rfc_init(self._c, _struct("rthyb_rfc_config", config), x0_m, f0_n))
        self._out = ffi.new("double *")

    @property
    def k_n_per_m(self) -> float:
        """Present tangent stiffness between 0 and k_e."""
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
        """Take in a sample of a motion along a path."""
        lib.rthyb_rfc_follow(self._c, x_c_m, x_m_m, f_n)

    def run(
        self,
        x_c_m: npt.ArrayLike,
        x_m_m: npt.ArrayLike,
        f_n: npt.ArrayLike,
        v_c_m_per_s: npt.ArrayLike | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return compensated force and tangent stiffness, each (n,)."""
        c, m, f = _doubles(x_c_m), _doubles(x_m_m), _doubles(f_n)
        v = np.zeros_like(c) if v_c_m_per_s is None else _doubles(v_c_m_per_s)
        _same_length(c, v, m, f)
        force, k = np.empty_like(c), np.empty_like(c)
        lib.rthyb_rfc_run(self._c, _in(c), _in(v), _in(m), _in(f), _out(force), _out(k), c.size)
        return force, k


class Motion:
    """Equation of motion of the numerical part; raises ``CoreError``."""

    def __init__(self, config: MotionConfig, x0_m: float = 0.0) -> None:
        self._c = ffi.new("rthyb_motion *")
        _check(lib.rthyb_motion_init(self._c, _struct("rthyb_motion_config", config), x0_m))
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
        x, v, f = np.empty_like(ag), np.empty_like(ag), np.empty_like(ag)
        lib.rthyb_run_reference(
            self._c, array, len(elements), _in(ag), ag.size, _out(x), _out(v), _out(f)
        )
        return x, v, f


def finite_motion(elements: Sequence[ElementConfig], ag_mps2: npt.ArrayLike) -> FloatArray:
    """Return the ground motion of a reference simulation, (n,).

    Raises ``CoreError`` for too many elements or a value that is not finite.
    """
    ag = _doubles(ag_mps2)
    if len(elements) > ELEMENTS_MAX:
        raise CoreError(f"at most {ELEMENTS_MAX} elements, got {len(elements)}")
    if not np.isfinite(ag).all():
        raise CoreError("the ground acceleration holds a value that is not finite")
    return ag


def element_array(elements: Sequence[ElementConfig]) -> Any:
    """Return the ``rthyb_element`` structs of fresh elements; raises ``CoreError``."""
    array = ffi.new("rthyb_element[]", max(len(elements), 1))
    for slot, config in zip(array, elements, strict=False):
        _init_element(slot, config)
    return array


class Element:
    """One specimen element with its history; raises ``CoreError``."""

    def __init__(self, config: ElementConfig) -> None:
        self._c = ffi.new("rthyb_element *")
        _init_element(self._c, config)

    def force(self, x_m: float, v_m_per_s: float, a_m_per_s2: float, dt_s: float) -> float:
        """Return the resisting force, N, at one instant, and move the history on."""
        return float(lib.rthyb_element_force(self._c, x_m, v_m_per_s, a_m_per_s2, dt_s))

    def run(
        self,
        x_m: npt.ArrayLike,
        v_m_per_s: npt.ArrayLike = 0.0,
        a_m_per_s2: npt.ArrayLike = 0.0,
        dt_s: float = PERIOD_S,
    ) -> FloatArray:
        """Return the resisting force along a motion of shape (n,)."""
        x = _doubles(x_m)
        v, a = _like(v_m_per_s, x), _like(a_m_per_s2, x)
        out = np.empty_like(x)
        lib.rthyb_element_run(self._c, _in(x), _in(v), _in(a), dt_s, _out(out), x.size)
        return out

    def state(self) -> tuple[float, ...]:
        """Return the history variables."""
        return tuple(self._c.state)


class Rig:
    """The virtual rig in this process; raises ``CoreError``."""

    def __init__(self, config: RigConfig) -> None:
        self.config = config
        self._c = ffi.new("rthyb_rig *")
        _check(lib.rthyb_rig_init(self._c, _rig_struct(config)))
        self._x, self._f = ffi.new("double *"), ffi.new("double *")

    def step(self, x_p_m: float) -> tuple[float, float, int]:
        """Latch displacement and force, then apply the command; return both and status bits."""
        code = lib.rthyb_rig_step(self._c, x_p_m, self._x, self._f)
        return self._x[0], self._f[0], code

    def run(self, x_p_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return x_meas_m and f_meas_n, each (n,), along commands of shape (n,)."""
        p = _doubles(x_p_m)
        x, f = np.empty_like(p), np.empty_like(p)
        lib.rthyb_rig_run(self._c, _in(p), _out(x), _out(f), p.size)
        return x, f

    def motion(self, x_p_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x (m), v (m/s), a (m/s^2) as latched, each (n,), along commands of shape (n,)."""
        p = _doubles(x_p_m)
        out = np.empty((p.size, 3))
        servo, step = self._c.servo, lib.rthyb_rig_step
        for n, command in enumerate(p.tolist()):
            out[n] = servo.x, servo.v, servo.a
            step(self._c, command, self._x, self._f)
        return out[:, 0].copy(), out[:, 1].copy(), out[:, 2].copy()

    def reseed(self) -> None:
        """Begin the noise of the sensors anew, from the seed."""
        lib.rthyb_rig_reseed(self._c)

    @property
    def true_displacement_m(self) -> float:
        """Displacement at the last latch without the sensor's errors."""
        return float(self._c.x_true_m)


@dataclass(frozen=True)
class Sample:
    """What one call of :meth:`Controller.step` gives back."""

    x_cmd_next_m: float
    status: int
    record: dict[str, float | int] = field(repr=False)


class Controller:
    """The controller without states and limits: one sample, or a run at a virtual rig.

    Raises ``CoreError``.
    """

    def __init__(self, config: ControllerConfig) -> None:
        self.config = config
        self._c = ffi.new("rthyb_controller *")
        struct = _struct("rthyb_controller_config", replace(config, numerical=None))
        self._part = _fill_part(struct.numerical, config.numerical)
        _check(lib.rthyb_controller_init(self._c, struct))
        self._input = ffi.new("rthyb_input *")
        self._record = ffi.new("rthyb_record *")

    def step(
        self, x_meas_m: float, f_meas_n: float, excitation: float, lost: bool = False
    ) -> Sample:
        """Run one tick; ``excitation`` is ag in m/s^2, or the next command when prescribed."""
        i = self._input
        i.x_meas_m, i.f_meas_n, i.excitation = x_meas_m, f_meas_n, excitation
        i.lost = lib.RTHYB_LOST if lost else 0
        code = lib.rthyb_controller_step(self._c, i, self._record)
        row = np.frombuffer(bytes(ffi.buffer(self._record)), RECORD_DTYPE)[0]
        return Sample(
            self._c.x_cmd, code, {name: row[name].item() for name in RECORD_DTYPE.names or ()}
        )

    @property
    def x_cmd_m(self) -> float:
        """Command for the next sample."""
        return float(self._c.x_cmd)

    @property
    def tick(self) -> int:
        """Index of the next sample."""
        return int(self._c.tick)

    def run_virtual(
        self, rig: Rig, excitation: FloatArray, records: RecordArray
    ) -> tuple[int, int]:
        """Fill ``records`` with the next ticks against ``rig``.

        ``excitation`` is the whole test's, (n_total,). Returns how many records were written
        (fewer when a value was not finite) and the status bits seen.
        """
        ag = _doubles(excitation)
        status = ffi.new("int32_t *")
        done = lib.rthyb_run_virtual(
            self._c, rig._c, _in(ag), ag.size, records.size, _records(records), status
        )
        return int(done), int(status[0])


# ---- states, limits, faults ----------------------------------------------------------------------

Reaction = Literal["none", "indicate", "hold", "ramp-out", "trip"]
Command = Literal["none", "zero", "arm", "start", "hold", "resume", "stop", "reset", "trip"]

REACTIONS: Final[tuple[Reaction, ...]] = ("none", "indicate", "hold", "ramp-out", "trip")
COMMANDS: Final[tuple[Command, ...]] = (
    "none",
    "zero",
    "arm",
    "start",
    "hold",
    "resume",
    "stop",
    "reset",
    "trip",
)
CAUSES: Final[tuple[str, ...]] = (
    "none",
    "completed",
    "operator",
    "signal",
    "not_finite",
    "link_lost",
    "link_down",
    "drive_stopped",
    "stalled",
    "heartbeat",
    "not_arrived",
    "skips",
    "skip_warning",
    "lost_pairs",
    "lost_warning",
    "sensor_stuck",
    "sensor_jump",
    "force_stuck",
    "force_jump",
    "position",
    "velocity",
    "increment",
    "force",
    "tracking",
    "indicator",
    "energy",
    "rig_position",
    "rig_force",
)
WATCHABLE: Final = CAUSES[CAUSES.index("skips") :]
BLIND_MAX: Final[int] = lib.RTHYB_BLIND_MAX
LOST_TICKS: Final[int] = lib.RTHYB_LOST_TICKS


@dataclass(frozen=True)
class Watch:
    """What is done when a watched quantity goes past ``value``; 0 switches the watch off."""

    value: float
    reaction: Reaction


@dataclass(frozen=True)
class StationConfig:
    """Settings of the station.

    ``watches`` has a :class:`Watch` by cause: position (m), velocity (m/s), increment (m a tick),
    force (N), tracking (m), indicator (m^2/s), energy (J), sensor_stuck and force_stuck (ticks),
    sensor_jump (m), force_jump (N), rig_position (m) and rig_force (N) before tare, lost_pairs,
    lost_warning, skips and skip_warning (share of the last second's ticks).
    ``tare_most_m``, ``tare_most_n``: ZERO refuses a larger tare; 0 takes any.
    ``brake_acceleration_m_per_s2``: of HOLD, and where RAMP_OUT begins; 0: as of paths. ``stay``:
    RAMP_OUT ends where it comes to rest, and not at 0.
    """

    controller: ControllerConfig
    watches: Mapping[str, Watch] = field(default_factory=dict)
    path_velocity_m_per_s: float = 0.02
    path_acceleration_m_per_s2: float = 0.2
    brake_acceleration_m_per_s2: float = 0.0
    rest_spread_m: float = 1e-4
    tare_most_m: float = 0.0
    tare_most_n: float = 0.0
    tare_ticks: int = 1024
    ramp_in_ticks: int = 2048
    armed_ticks: int = 30720
    stay: bool = False

    @property
    def fs_hz(self) -> float:
        """Sample rate."""
        return 1.0 / self.controller.period_s

    def plain(self) -> dict[str, Any]:
        """Return all of it as plain values, for a recording: `of` takes them back."""
        return dataclasses.asdict(self)

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> StationConfig:
        """Return the settings that `plain` has written down.

        Raises:
            CoreError: they are not those of this version.
        """
        try:
            given = dict(plain)
            inner: dict[str, Any] = dict(given.pop("controller"))
            if "estimator" in inner:
                inner |= _law_of_estimator(inner)
            parts = {"law": LawConfig, "rfc": RfcConfig, "motion": MotionConfig}
            inner |= {name: kind(**inner[name]) for name, kind in parts.items()}
            if inner.get("numerical") is not None:
                inner["numerical"] = _dense(inner["numerical"])
            watches = {name: Watch(**watch) for name, watch in given.pop("watches").items()}
            return cls(controller=ControllerConfig(**inner), watches=watches, **given)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CoreError(
                f"station settings: {error}; replay with the version that recorded"
            ) from error


def _law_of_estimator(controller: dict[str, Any]) -> dict[str, Any]:
    """Return what took the place of estimator and phase lead in a controller's plain settings.

    Recordings have them so that were made when there was no other law. They are taken out here.
    """
    old, enabled = controller.pop("estimator"), controller.pop("plc_enabled")
    name, own = {
        "fixed": ("paper", {}),
        "gradient": (
            "paper",
            {"gain_per_mm2_per_sample": old["gain"] / (old["reference_m"] / 1e-3) ** 2},
        ),
        "robust": ("robust", {"rate_per_sample": old["gain"]}),
        "rls": ("alpha-beta", {"memory_s": old["memory_samples"] * old["period_s"]}),
    }[old["law"]]
    own |= {"reference_displacement_m": old["reference_m"]}
    own |= {key: old[key] for key in ("alpha_min", "alpha_max")}
    if name != "paper":
        own |= {key: old[key] for key in ("cutoff_hz", "gate_factor")}
    settings = {key: old[key] for key in ("w1", "w2", "alpha0", "beta0")}
    settings |= {f"delay_estimator.{key}": value for key, value in own.items()}
    law = {
        "name": name,
        "settings": settings,
        "adapts": old["law"] != "fixed",
        "rest_noise_m": old["rest_noise_m"],
    }
    return {"law": law, "lead_enabled": enabled}


@dataclass(frozen=True)
class Calibration:
    """Between the numbers on the wire and the structure's own; as it stands it changes nothing.

    x = ``x_gain`` wire + ``x_offset_m``, f = ``f_gain`` wire + ``f_offset_n``, and the command goes
    out as ``cmd_gain`` x + ``cmd_offset_m``.
    """

    x_gain: float = 1.0
    x_offset_m: float = 0.0
    f_gain: float = 1.0
    f_offset_n: float = 0.0
    cmd_gain: float = 1.0
    cmd_offset_m: float = 0.0

    def struct(self) -> Any:
        """Return the ``rthyb_calibration`` of the C core.

        Raises:
            CoreError: a gain is 0, not finite or senseless, or an offset is.
        """
        struct = _struct("rthyb_calibration", self)
        if lib.rthyb_calibration_check(struct):
            raise CoreError(
                f"{self}: the size of a gain must lie in 1e-9 ... 1e9, of an offset of "
                "displacement in 0 ... 1e3 m, of force in 0 ... 1e12 N"
            )
        return struct


IDENTITY: Final = Calibration()


@dataclass(frozen=True)
class StationTick:
    """What one tick of the station came to."""

    x_cmd_m: float
    sent: bool
    state: str
    refused: bool
    records: RecordArray = field(repr=False)


def _dense(plain: Mapping[str, Any]) -> DenseConfig:
    """Return a part's settings from plain values, lists for tuples."""

    def frozen(value: Any) -> Any:
        return tuple(frozen(v) for v in value) if isinstance(value, (list, tuple)) else value

    return DenseConfig(**{name: frozen(value) for name, value in plain.items()})


@dataclass(frozen=True)
class Parameters:
    """What may be changed while a test runs; always a whole set.

    ``watches`` as in :class:`StationConfig`, and what it does not name is not watched; limits of
    the command with 0 for off; path limits are for paths that begin from then on, and narrower ones
    have the path that runs brake and begin anew; a brake of 0 is as hard as paths are. ``adapt``
    False: what the control law has learnt stays as it is.
    """

    watches: Mapping[str, Watch] = field(default_factory=dict)
    velocity_limit_m_per_s: float = 0.0
    acceleration_limit_m_per_s2: float = 0.0
    path_velocity_m_per_s: float = 0.02
    path_acceleration_m_per_s2: float = 0.2
    adapt: bool = True
    brake_acceleration_m_per_s2: float = 0.0

    @classmethod
    def of(cls, config: StationConfig) -> Parameters:
        """Return the set that a station begins with, generation 0."""
        return cls(
            watches=config.watches,
            velocity_limit_m_per_s=config.controller.velocity_limit_m_per_s,
            acceleration_limit_m_per_s2=config.controller.acceleration_limit_m_per_s2,
            path_velocity_m_per_s=config.path_velocity_m_per_s,
            path_acceleration_m_per_s2=config.path_acceleration_m_per_s2,
            brake_acceleration_m_per_s2=config.brake_acceleration_m_per_s2,
        )

    def struct(self, generation: int = 0) -> Any:
        """Return the ``rthyb_parameters`` of the C core.

        Raises:
            CoreError: there is nothing to watch under a name.
        """
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        own.pop("watches")
        struct = ffi.new("rthyb_parameters *", own | {"generation": generation})
        _fill_watches(struct.watch, self.watches)
        return struct


class Station:
    """States, limits and faults around the controller; raises ``CoreError``."""

    def __init__(self, config: StationConfig, ag_mps2: npt.ArrayLike) -> None:
        plain = {k: v for k, v in _mapping_of(config).items() if k != "watches"}
        struct = ffi.new("rthyb_station_config *", plain)
        self._part = _fill_part(struct.controller.numerical, config.controller.numerical)
        _fill_watches(struct.watch, config.watches)
        self._c = ffi.new("rthyb_station *")
        _check(lib.rthyb_station_init(self._c, struct))
        self._ag = _doubles(ag_mps2)
        self._in, self._out = ffi.new("rthyb_station_input *"), ffi.new("rthyb_station_output *")

    def tick(
        self,
        x_m: float = 0.0,
        f_n: float = 0.0,
        *,
        lost: bool = False,
        command: Command = "none",
        skipped: int = 0,
        link_down: bool = False,
        drive_stopped: bool = False,
        heartbeat_late: bool = False,
        taken_over_m: float | None = None,
    ) -> StationTick:
        """Run one executed tick with the newest pair (before tare), or without one.

        ``taken_over_m``: with the first sound reading, the command that the drive has already.
        """
        i = self._in
        i.taken_over, i.x_cmd_m = taken_over_m is not None, taken_over_m or 0.0
        i.x_m, i.f_n, i.lost = x_m, f_n, lib.RTHYB_LOST if lost else 0
        i.skipped, i.command = skipped, COMMANDS.index(command)
        i.link_down, i.drive_stopped, i.heartbeat_late = link_down, drive_stopped, heartbeat_late
        records = np.zeros(BLIND_MAX + 1, dtype=RECORD_DTYPE)
        lib.rthyb_station_tick(
            self._c, i, _in(self._ag), self._ag.size, _records(records), self._out
        )
        out = self._out
        return StationTick(
            x_cmd_m=out.x_cmd_m,
            sent=bool(out.send),
            state=STATE_NAMES[out.state],
            refused=bool(out.refused),
            records=records[: out.records],
        )

    def replay(
        self,
        rows: RecordArray,
        codec: Codec | None = None,
        calibration: Calibration = IDENTITY,
        parameters: Sequence[tuple[int, Parameters]] = (),
    ) -> RecordArray:
        """Return the rows that this station, a fresh one, computes from recorded inputs.

        With the station's settings and ground motion those of the recording, every byte is the same
        again; the first row that differs, or is missing, is where the recording and the core part.
        What clock and link added (times, echo, count, slips) is copied.

        Args:
            rows: every row from the station's first tick on, (n,).
            codec: of the link that sent the commands; None: no wire, they left as computed.
            calibration: of the loop.
            parameters: every set that was published, with its generation.

        Returns:
            The rows, (n,); fewer where those given do not make whole ticks.

        Raises:
            CoreError: the station has ticked already.
        """
        if self.ticks:
            raise CoreError(
                f"only a fresh station replays; this one has {self.ticks} ticks behind it"
            )
        recorded = as_records(rows)
        out = np.zeros(recorded.size, dtype=RECORD_DTYPE)
        sets = ffi.new("rthyb_parameters[]", len(parameters))
        for slot, (generation, one) in enumerate(parameters):
            sets[slot] = one.struct(generation)[0]
        source = ffi.new("rthyb_replay *")
        source.rows, source.count = _records(recorded), recorded.size
        ag = _in(self._ag)
        source.ag_mps2, source.ag_count = ag, self._ag.size
        source.codec = ffi.NULL if codec is None else codec.struct
        source.calibration = calibration.struct()[0]
        source.parameters, source.parameter_count = sets, len(parameters)
        return out[: lib.rthyb_station_replay(self._c, source, _records(out))]

    @property
    def state(self) -> str:
        """Name of the present state."""
        return STATE_NAMES[int(self._c.state)]

    @property
    def cause(self) -> str:
        """First cause that took the test off its course, latched."""
        return CAUSES[int(self._c.cause)]

    @property
    def cause_tick(self) -> int:
        """Tick in which that cause came up; without one it means nothing."""
        return int(self._c.cause_tick)

    @property
    def cause_value(self) -> float:
        """What was met when that cause came up, in its watch's unit; 0 where it has no number."""
        return float(self._c.cause_value)

    @property
    def cause_limit(self) -> float:
        """What was allowed then, in the same unit; 0 where the cause has no number."""
        return float(self._c.cause_limit)

    @property
    def refusal(self) -> tuple[str, float, float]:
        """Which watch refused the last command or tare, with what was met and what is allowed.

        "none" where none did.
        """
        c = self._c
        return CAUSES[int(c.refused_cause)], float(c.refused_value), float(c.refused_limit)

    @property
    def indicated(self) -> list[str]:
        """Causes that were seen and only indicated."""
        return [name for bit, name in enumerate(CAUSES) if self._c.indicated >> bit & 1]

    @property
    def interrupted(self) -> bool:
        """Whether the test was held."""
        return bool(self._c.interrupted)

    @property
    def zeroing_failed(self) -> bool:
        """Whether the last tare was refused: the reading moved, or `tare_too_large`."""
        return int(self._c.zeroing) in (2, 3)

    @property
    def tare_too_large(self) -> bool:
        """Whether it was refused for its size; `refusal` has the figures."""
        return bool(self._c.zeroing == 3)

    @property
    def ticks(self) -> int:
        """Ticks so far, executed and skipped."""
        return int(self._c.tick)

    @property
    def skipped(self) -> int:
        """Ticks skipped so far."""
        return int(self._c.skipped)

    @property
    def test_tick(self) -> int:
        """Index of the ground motion's next sample."""
        return int(self._c.test_tick)

    @property
    def tare(self) -> tuple[float, float]:
        """Offsets taken off displacement (m) and force (N)."""
        return self._c.tare_x, self._c.tare_f

    @property
    def command_tare_m(self) -> float:
        """What is added to a command on its way to the drive: where that stood at the tare, m."""
        return float(self._c.tare_cmd)


class Virtual:
    """A test in virtual time: a station and a virtual rig, without clock and wire.

    Args:
        station: states, limits, controller, ground motion.
        rig: what moves and measures; the drive has the station's zero for its own.
        stop_decel_m_per_s2: how the drive brakes by itself after a trip.
        truth: the first two channels are what the sensors saw, without their errors: m and N.

    Raises:
        CoreError: the deceleration is not positive, or station and rig are not of one rate.
    """

    def __init__(
        self,
        station: Station,
        rig: Rig,
        stop_decel_m_per_s2: float = 1.0,
        truth: bool = False,
    ) -> None:
        self.station, self.rig = station, rig
        self._c = ffi.new("rthyb_virtual *")
        self._ag = _in(station._ag)
        self._c.station, self._c.rig = station._c, rig._c
        self._c.ag_mps2, self._c.ag_count = self._ag, station._ag.size
        self._c.stop_decel_m_per_s2, self._c.truth = stop_decel_m_per_s2, truth
        error = lib.rthyb_virtual_init(self._c)
        if error == lib.RTHYB_E_PERIOD:
            raise CoreError(
                f"the station ticks every {station._c.cfg.controller.period_s:g} s, the virtual "
                f"rig every {rig._c.cfg.servo.period_s:g} s; they must be the same"
            )
        if error:
            raise CoreError(
                f"the drive brakes with {stop_decel_m_per_s2} m/s^2, more than 0 is needed"
            )

    def run(
        self, records: RecordArray, command: Command = "none", channels: FloatArray | None = None
    ) -> int:
        """Fill ``records``, one a tick, the first tick with an operator's command.

        Args:
            records: takes them, (n,).
            command: of the first tick.
            channels: takes as many of each row's channels as it has columns, (n, count).

        Returns:
            how many were written: fewer where the state has become another, or a tare has failed.

        Raises:
            CoreError: ``channels`` has other rows than ``records``, or too many columns.
        """
        number, values, count = COMMANDS.index(command), ffi.NULL, 0
        if channels is not None:
            count = channels.shape[1]
            if len(channels) != records.size or count > CHANNELS_MAX:
                raise CoreError(
                    f"channels {channels.shape} for {records.size} records; one row each, "
                    f"{CHANNELS_MAX} columns at most"
                )
            values = _out(channels)
        return int(
            lib.rthyb_virtual_run(self._c, number, records.size, _records(records), values, count)
        )


def command_of(flags: int) -> Command:
    """Return the operator's command in a record's flags; "none" if there was none.

    Raises:
        CoreError: no command has that number.
    """
    number = int(flags) >> recording.COMMAND_BIT
    if not 0 <= number < len(COMMANDS):
        raise CoreError(f"flags {int(flags):#x} hold no command: {number} is beyond the last one")
    return COMMANDS[number]


def command_allowed(state: str, command: Command) -> bool:
    """Return whether an operator may give a command in a state."""
    code = COMMANDS.index(command)
    return bool(lib.rthyb_command_allowed(STATE_NAMES.index(state), code))


# ---- crossing the boundary ----------------------------------------------------------------------


def _text(c_string: Any) -> str:
    raw: bytes = ffi.string(c_string)
    return raw.decode()


def _check(error: int) -> None:
    if error:
        raise CoreError(_REFUSED.get(error, f"the core refused its settings ({error})"))


def _doubles(values: npt.ArrayLike) -> FloatArray:
    return np.ascontiguousarray(np.atleast_1d(np.asarray(values, dtype=np.float64)))


def _like(values: npt.ArrayLike, model: FloatArray) -> FloatArray:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float64), model.shape))


def _same_length(first: FloatArray, *others: FloatArray) -> None:
    for other in others:
        if other.shape != first.shape:
            raise CoreError(f"arrays of one length needed, got {first.shape} and {other.shape}")


def _in(array: FloatArray) -> Any:
    return ffi.from_buffer("double[]", array)


def _out(array: FloatArray) -> Any:
    return ffi.from_buffer("double[]", array, require_writable=True)


def _records(array: RecordArray) -> Any:
    if array.dtype != RECORD_DTYPE or not array.flags.c_contiguous:
        raise CoreError("records must be a contiguous array of RECORD_DTYPE")
    return ffi.cast("rthyb_record *", ffi.from_buffer(array))


def _value(name: str, value: Any) -> Any:
    if isinstance(value, str):
        return _ENUMS[name][value]
    if isinstance(value, LawConfig):
        return value.mapping()
    return _mapping(value) if dataclasses.is_dataclass(value) else value


def _fill_watches(slots: Any, watches: Mapping[str, Watch]) -> None:
    unknown = set(watches) - set(WATCHABLE)
    if unknown:
        raise CoreError(f"nothing to watch under the name {', '.join(sorted(unknown))}")
    for name, watch in watches.items():
        slot = slots[CAUSES.index(name)]
        slot.value, slot.reaction = watch.value, REACTIONS.index(watch.reaction)


def _mapping_of(config: StationConfig) -> dict[str, Any]:
    own = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return own | {"controller": _mapping(replace(config.controller, numerical=None))}


def _mapping(config: Any) -> dict[str, Any]:
    given = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return {name: _value(name, value) for name, value in given.items() if value is not None}


def _fill_part(slot: Any, config: DenseConfig | None) -> list[Any]:
    """Have a controller compute with a numerical part of its own; return what must stay alive."""
    if config is None:
        return []
    settings = config.struct()
    state = ffi.new("rthyb_dense *")
    slot.kind, slot.cfg, slot.state = lib.RTHYB_NUMERICAL_DENSE, settings, state
    return [settings, state]


def _struct(ctype: str, config: Any) -> Any:
    try:
        return ffi.new(f"{ctype} *", _mapping(config))
    except OverflowError as error:
        raise CoreError(
            f"{type(config).__name__}: a whole number is out of range ({error})"
        ) from error


def _rig_struct(config: RigConfig) -> Any:
    if len(config.elements) > ELEMENTS_MAX:
        raise CoreError(
            f"a specimen has at most {ELEMENTS_MAX} elements, got {len(config.elements)}"
        )
    plain: Mapping[str, Any] = {k: v for k, v in _mapping(config).items() if k != "elements"}
    struct = ffi.new("rthyb_rig_config *", dict(plain))
    struct.element_count = len(config.elements)
    for i, item in enumerate(config.elements):
        _init_element(ffi.addressof(struct.elements, i), item)
    return struct


def _init_element(slot: Any, config: ElementConfig) -> None:
    kind = _ELEMENT_KIND.get(config.kind, -1)
    target = slot if ffi.typeof(slot).kind == "pointer" else ffi.addressof(slot)
    _check(lib.rthyb_element_init(target, kind, list(config.params), len(config.params)))


def _numbers(struct: Any, skip: tuple[str, ...] = ()) -> dict[str, float | int]:
    """Return the scalar fields of a struct, arrays spread over indexed names."""
    numbers: dict[str, float | int] = {}
    for name, description in ffi.typeof(struct[0]).fields:
        if name in skip:
            continue
        value = getattr(struct, name)
        if description.type.kind == "array":
            numbers.update({f"{name}[{i}]": v for i, v in enumerate(value)})
        else:
            numbers[name] = value
    return numbers
