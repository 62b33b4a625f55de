"""Settings of the core's parts: dataclasses here, structs there. SI units throughout."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.laws import LAWS
from rthyb_rt.core.library import CoreError, check, options
from rthyb_rt.core.sizes import DENSE_MAX, ELEMENTS_MAX, PERIOD_S

if TYPE_CHECKING:
    from rthyb_rt.core.group import AxisConfig, InterfaceConfig
    from rthyb_rt.core.kinematics import Kinematics
    from rthyb_rt.core.laws import LawDescription
    from rthyb_rt.core.matrix_lead import MatrixLeadConfig
    from rthyb_rt.core.matrix_rfc import MatrixRfcConfig
    from rthyb_rt.core.own import OwnClass
    from rthyb_rt.core.own_parts import OwnPartConfig
    from rthyb_rt.core.sparse import SparseConfig

EstimatorLaw = Literal["fixed", "gradient", "robust", "rls"]
Tangent = Literal["mean-of-ratios", "least-squares"]
Divisor = Literal["printed", "terms"]
Integrator = Literal["central-difference", "forward-euler", "cr", "kr-alpha", "prescribed"]
DenseIntegrator = Literal["cr", "rk4"]
ServoKind = Literal["pure-delay", "first-order", "second-order", "servo-hydraulic", "servo-valve"]
Hold = Literal["zoh", "foh"]
LoadCell = Literal["actuator-end", "specimen"]

_OPTIONS: Final[dict[str, dict[str, int]]] = {
    "law": options("rthyb_estimator_law", "RTHYB_LAW_"),
    "tangent": options("rthyb_tangent", "RTHYB_TANGENT_"),
    "divisor": options("rthyb_divisor", "RTHYB_DIVISOR_"),
    "integrator": options("rthyb_integrator", "RTHYB_"),
    "kind": options("rthyb_servo_kind", "RTHYB_"),
    "hold": options("rthyb_hold", "RTHYB_"),
    "load_cell": {"actuator-end": lib.RTHYB_ACTUATOR_END, "specimen": lib.RTHYB_SPECIMEN_END},
}


ExtraKind = Literal["none", "displacement", "velocity", "acceleration", "force"]
_EXTRA_KIND: Final = options("rthyb_extra_kind", "RTHYB_EXTRA_")
EXTRAS_MAX: Final[int] = lib.RTHYB_EXTRAS_MAX


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of the delay estimator (Eqn 2.6-2.11 and more robust variants).

    ``gain`` is per reference_m squared per sample for the law ``gradient``, per sample for
    ``robust``; ``memory_samples`` is used by ``rls`` only.
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
    """A control law by name, with the settings that differ from its defaults.

    ``settings`` has the keys of `rthyb_rt.core.laws`. With ``adapts`` False, the law does not learn
    and keeps its initial values. ``rest_noise_m``: standard deviation of x_m at rest. ``own``: a
    class in Python instead; ``name`` is then "python".
    """

    name: str = "none"
    settings: Mapping[str, float] = field(default_factory=dict)
    adapts: bool = True
    rest_noise_m: float = 0.0
    own: OwnClass | None = None

    @property
    def law(self) -> LawDescription:
        """Description of the law.

        Raises:
            CoreError: there is no such law.
        """
        if self.own is not None:
            from rthyb_rt.core.own import law_of

            return law_of(self.own)
        law = LAWS.get(self.name)
        if law is None:
            raise CoreError(
                f"control law {self.name!r} is unknown; the control laws are {', '.join(LAWS)}"
            )
        return law

    def values(self) -> list[float]:
        """Return all settings in the core's order.

        Raises:
            CoreError: there is no such law or setting, or one without a default is missing.
        """
        try:
            return self.law.ordered(self.settings)
        except ValueError as error:
            raise CoreError(str(error)) from None

    def mapping(self) -> dict[str, Any]:
        """Return the ``rthyb_law_config`` of the C core as a mapping; raises ``CoreError``."""
        plain = {"parameters": self.values(), "kind": self.law.kind, "adapts": self.adapts,
                 "rest_noise_m": self.rest_noise_m}  # fmt: skip
        if self.own is not None:
            from rthyb_rt.core.own import control_law

            plain["own"] = control_law(self.own)
        return plain


@dataclass(frozen=True)
class RfcConfig:
    """Settings of the restoring-force compensator (Eqn 3.1-3.3); ``window`` is T0 in samples.

    ``cutoff_hz`` is the cut-off of the low-pass filter on x_c - x_m, 0 for none; ``lateness_s``
    the delay of the force behind x_m.
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
    symmetric; ``load_kg`` (n,). e is 1 at the interface, degree of freedom ``at``, counted from 0.
    The known properties of the specimen affect only the coefficients of CR. ``force_delay``:
    samples by which the force is used late, 0 or 1.
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
            CoreError: the matrices are not square, differ in size, or are too large.
        """
        n = len(self.load_kg)
        names = ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m")
        for name in names:
            shape = np.shape(getattr(self, name))
            if not 1 <= n <= DENSE_MAX or shape != (n, n):
                raise CoreError(
                    f"{name}: found shape {shape} with {n} loads; both must have the same size, "
                    f"from 1 to {DENSE_MAX}"
                )
        plain = mapping(self) | {"size": n}
        flat = {name: [v for row in plain[name] for v in row] for name in names}
        return ffi.new("rthyb_dense_config *", plain | flat)


@dataclass(frozen=True)
class ServoConfig:
    """Settings of a virtual actuator; ``kind`` determines which of them are used."""

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
    loop_kp: float = 0.0
    loop_ki_per_s: float = 0.0


@dataclass(frozen=True)
class SensorConfig:
    """Errors of one sensor, in its own unit; for ``lsb`` and ``range``, 0 means off."""

    noise_std: float = 0.0
    lsb: float = 0.0
    bias: float = 0.0
    range: float = 0.0


@dataclass(frozen=True)
class ElementConfig:
    """One element of the catalogue: its kind and its parameters in the core's order.

    ``own``: a class in Python instead; ``kind`` is then "python".
    """

    kind: str
    params: tuple[float, ...]
    own: OwnClass | None = None


@dataclass(frozen=True)
class ExtraSensorConfig:
    """A further sensor of the virtual rig, in addition to those of displacement and force.

    It reads ``gain`` times the measured quantity, with the errors of ``sensor``, in the channel's
    unit.
    """

    kind: ExtraKind = "none"
    gain: float = 1.0
    sensor: SensorConfig = SensorConfig()


@dataclass(frozen=True)
class RigConfig:
    """A virtual rig: actuator, specimen, sensors."""

    servo: ServoConfig
    elements: tuple[ElementConfig, ...] = ()
    displacement: SensorConfig = SensorConfig()
    force: SensorConfig = SensorConfig()
    load_cell: LoadCell = "actuator-end"
    seed: int = 0
    extras: tuple[ExtraSensorConfig, ...] = ()


@dataclass(frozen=True)
class ControllerConfig:
    """Settings of the controller, as needed for one sample.

    ``numerical`` replaces ``motion``, unless the motion is prescribed. Without ``axes`` there is
    one axis, to which law, ranges and limits belong; with ``axes`` these are the defaults of every
    axis, and ``rfc`` is that of every one of the ``interfaces``, whose number equals that of the
    axes. ``kinematics`` relates the two; None: axis i is interface i. ``matrix_lead`` replaces the
    laws, ``matrix_rfc`` replaces ``rfc``.
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
    numerical: DenseConfig | SparseConfig | OwnPartConfig | None = None
    axes: tuple[AxisConfig, ...] = ()
    interfaces: tuple[InterfaceConfig, ...] = ()
    kinematics: Kinematics | None = None
    matrix_lead: MatrixLeadConfig | None = None
    matrix_rfc: MatrixRfcConfig | None = None

    @property
    def axis_count(self) -> int:
        """Number of axes."""
        return len(self.axes) or 1

    @property
    def interface_count(self) -> int:
        """Number of directions in which numerical part and axes are connected."""
        return len(self.interfaces) or 1


ELEMENT_PARAMS: Final[dict[str, tuple[str, ...]]] = {
    "stiffness": ("k_n_per_m",),
    "viscous": ("c_n_s_per_m",),
    "coulomb": ("fc_n", "width_m_per_s"),
    "stribeck": ("fc_n", "fs_n", "vs_m_per_s", "width_m_per_s", "exponent"),
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
    "stopper": ("ks_n_per_m", "xs_m", "loss_s_per_m"),
    "hysteresis": ("k_n_per_m", "post_yield_ratio", "a", "b", "c", "eta"),
    "pinching": ("k_n_per_m", "post_yield_ratio", "a", "b", "c", "eta", "depth", "width_ratio"),
    "degradation": (
        "k_n_per_m",
        "post_yield_ratio",
        "a",
        "b",
        "c",
        "eta",
        "loss",
        "travel_m",
        "work_j",
        "amplitude_m",
    ),
    "maxwell": ("km_n_per_m", "tau_s"),
    "second_mode": ("m2_kg", "f2_hz", "zeta2"),
    "p_delta": ("gravity_load_n", "height_m"),
    "gap_friction": ("k_n_per_m", "gap_m", "fc_up_n", "fc_down_n", "seat_m"),
    "coulomb_uneven": ("fc_up_n", "fc_down_n", "width_m_per_s"),
    "gap_uneven": (
        "k_up_n_per_m",
        "gap_up_m",
        "k_down_n_per_m",
        "gap_down_m",
        "loss_s_per_m",
    ),
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
    "peak_oriented": (
        "k_up_n_per_m",
        "k_down_n_per_m",
        "reach_m",
        "exponent",
        "backbone",
        "start_m",
    ),
    "takeda": (
        "k_n_per_m",
        "post_yield_ratio",
        "xy_m",
        "sharpness",
        "unloading_exponent",
        "pinching",
        "pinching_level",
        "energy_j",
        "strength_down_over_up",
        "corner_on_line",
    ),
    "rocking": ("k_n_per_m", "uplift_m", "post_uplift_ratio"),
    "nonlinear_maxwell": ("km_n_per_m", "force_n", "at_m_per_s", "exponent"),
}
_ELEMENT_KIND: Final = {name: getattr(lib, f"RTHYB_{name.upper()}") for name in ELEMENT_PARAMS}


ELEMENT_DEFAULTS: Final[dict[str, dict[str, float]]] = {
    "stribeck": {"exponent": 2.0},
    "stopper": {"loss_s_per_m": 0.0},
    "gap_uneven": {"loss_s_per_m": 0.0},
    "degradation": {"work_j": 0.0, "amplitude_m": 0.0},
}
"""Parameters of an element that may be omitted, by kind: the last ones, so that a recording made
before an element had them is completed with them."""

ELEMENT_ABSENT: Final[dict[str, tuple[str, ...]]] = {
    "degradation": ("travel_m", "work_j", "amplitude_m")
}
"""Parameters of an element whose key is absent from a rig file where they are 0, by kind."""


def element(kind: str, /, **params: float) -> ElementConfig:
    """Return an element of the catalogue from its parameters by name.

    Raises ``CoreError`` for an unknown kind, or a missing or unknown parameter.
    """
    names = ELEMENT_PARAMS.get(kind)
    if names is None:
        raise CoreError(
            f"element {kind!r} is unknown; the elements are {', '.join(ELEMENT_PARAMS)}"
        )
    whole = ELEMENT_DEFAULTS.get(kind, {}) | params
    if set(whole) != set(names):
        raise CoreError(
            f"element {kind!r}: found {', '.join(params)}; the parameters are {', '.join(names)}"
        )
    return ElementConfig(kind, tuple(float(whole[name]) for name in names))


def recorded_element(kind: str, params: Sequence[float]) -> ElementConfig:
    """Return an element from its parameters in the order of `ELEMENT_PARAMS`.

    Those in `ELEMENT_DEFAULTS` may be missing: recordings made before an element had them are
    replayed with the law that it had.
    """
    later = tuple(ELEMENT_DEFAULTS.get(kind, {}).values())
    missing = len(ELEMENT_PARAMS.get(kind, ())) - len(params)
    return ElementConfig(kind, (*params, *(later if missing == len(later) else ())))


def _value(name: str, value: Any) -> Any:
    if isinstance(value, str):
        return _OPTIONS[name][value]
    if isinstance(value, LawConfig):
        return value.mapping()
    return mapping(value) if dataclasses.is_dataclass(value) else value


def mapping(config: Any) -> dict[str, Any]:
    given = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return {name: _value(name, value) for name, value in given.items() if value is not None}


def fill_part(slot: Any, config: DenseConfig | SparseConfig | OwnPartConfig | None) -> list[Any]:
    """Give a controller its numerical part; return the objects that must be kept alive."""
    if config is None:
        return []
    if isinstance(config, DenseConfig):
        settings, kept = config.struct(), list[Any]()
        slot.kind = lib.RTHYB_NUMERICAL_DENSE
    else:
        settings, *kept = config.struct()
        own = config.kind != "sparse"
        slot.kind = lib.RTHYB_NUMERICAL_LIBRARY if own else lib.RTHYB_NUMERICAL_SPARSE
    slot.cfg = settings
    part = slot if ffi.typeof(slot).kind == "pointer" else ffi.addressof(slot)
    state = ffi.new("double[]", lib.rthyb_numerical_size(part) // 8 + 1)
    slot.state = state
    return [settings, state, *kept]


def struct_of(ctype: str, config: Any) -> Any:
    return new_struct(ctype, mapping(config), config)


def new_struct(ctype: str, plain: Mapping[str, Any], config: Any) -> Any:
    """Return a struct with plain values; ``config`` is their source, for error messages."""
    try:
        return ffi.new(f"{ctype} *", plain)
    except OverflowError as error:
        raise CoreError(
            f"{type(config).__name__}: a whole number is out of range ({error})"
        ) from error


def rig_struct(config: RigConfig) -> Any:
    if len(config.elements) > ELEMENTS_MAX:
        raise CoreError(
            f"found {len(config.elements)} elements; a specimen has at most {ELEMENTS_MAX}"
        )
    apart = ("elements", "extras")
    plain: Mapping[str, Any] = {k: v for k, v in mapping(config).items() if k not in apart}
    struct = ffi.new("rthyb_rig_config *", dict(plain))
    struct.element_count = len(config.elements)
    for i, item in enumerate(config.elements):
        init_element(ffi.addressof(struct.elements, i), item)
    struct.extra_count = fill_extras(struct.extras, config.extras)
    return struct


def fill_extras(slots: Any, extras: Sequence[ExtraSensorConfig]) -> int:
    """Write the extra sensors of an axis into the array of the C struct; return their number.

    Raises:
        CoreError: there are more than `EXTRAS_MAX`.
    """
    if len(extras) > EXTRAS_MAX:
        raise CoreError(f"found {len(extras)} extra sensors; an axis has at most {EXTRAS_MAX}")
    for i, extra in enumerate(extras):
        slot = slots[i]
        slot.kind, slot.gain = _EXTRA_KIND[extra.kind], extra.gain
        for name, value in mapping(extra.sensor).items():
            setattr(slot.sensor, name, value)
    return len(extras)


def init_element(slot: Any, config: ElementConfig) -> None:
    kind = _ELEMENT_KIND.get(config.kind, -1) if config.own is None else lib.RTHYB_OWN
    target = slot if ffi.typeof(slot).kind == "pointer" else ffi.addressof(slot)
    check(lib.rthyb_element_init(target, kind, list(config.params), len(config.params)))
    if config.own is not None:
        from rthyb_rt.core.own import own_force

        target.own = own_force(config.own)
