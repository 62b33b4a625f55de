"""The rig file: actuator, specimen, sensors, and the results of an identification."""

from __future__ import annotations

import datetime
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import Field, PrivateAttr, StrictBool

from rthyb_rt import units
from rthyb_rt.config import busload
from rthyb_rt.config.fields import (
    SLUG,
    SOME_TEXT,
    Condition,
    Count,
    Names,
    OneOf,
    Range,
    Sign,
    Table,
    Text,
    WholeFile,
    nearest,
    written,
)
from rthyb_rt.config.limits import Limits
from rthyb_rt.config.own_tables import PythonClass
from rthyb_rt.config.rate import LEAST_HZ, MOST_HZ, STANDARD, STANDARD_HZ, Rate
from rthyb_rt.core.sizes import ELEMENTS_MAX

if TYPE_CHECKING:
    from rthyb_rt.config.lonesensors import OneOfSeveral

RIG_SCHEMA = "rthyb-rig/1"
MAX_SUBSTEPS = 1024
EXTRAS_MAX = 8
"""Largest number of extra channels of one rig: RTHYB_EXTRAS_MAX of the core."""
MAX_ELEMENTS = ELEMENTS_MAX
"""Largest number of elements of one specimen in the core."""

DelaySamples = Annotated[int, Count(0, 1000, "the delay in samples")]
Stiffness = Annotated[float, Range("N/m", 0, 1e12, "the stiffness")]
FrictionForce = Annotated[float, Range("N", 0, 1e8, "the friction force")]
FRICTION_WIDTH_MAX: Final = 1.0
"""Largest width_m_per_s of a friction law, m/s."""
FrictionWidth = Annotated[
    float,
    Range("m/s", 1e-7, FRICTION_WIDTH_MAX, "the velocity over which friction changes sign"),
]


ASSUMED: Final = Names("the keys that nobody stated", 128)


class RigInfo(Table):
    """Conventions of the rig.

    ``command_hold``: the drive holds a command ("zoh") or interpolates to it ("foh").
    ``elastic_stiffness_n_per_m`` is the paper's k_e, the upper bound of the tangent stiffness.
    ``assumed`` lists keys of the actuator whose values nobody stated: those of another rig.
    """

    name: Annotated[str, SLUG]
    description: Annotated[str, Text("a description")] = ""
    elastic_stiffness_n_per_m: Annotated[
        float,
        Range(
            "N/m",
            1e-3,
            1e12,
            "the specimen's elastic stiffness k_e",
            "the restoring-force compensator needs it as a bound: run `rthyb identify RIG`, or "
            "enter the value from an elastic test",
        ),
    ]
    load_cell: Literal["actuator-end", "specimen"] = "actuator-end"
    command_hold: Literal["zoh", "foh"] = "zoh"
    command_shift_s: Annotated[
        float, Range("s", -1, 1, "the delay of the measured row behind the command row")
    ] = 0.0
    seed: Annotated[int, Count(0, 2**32 - 1, "the seed of the sensor noise")] = 0
    assumed: Annotated[list[str], ASSUMED] | None = None


class PureDelay(Table):
    """x_m[n] = x_p[n - D]: the actuator of the paper's Section 4.2."""

    kind: Literal["pure-delay"]
    delay_samples: DelaySamples


class FirstOrder(Table):
    """x_m[n] = p x_m[n-1] + (1 - p) x_p[n-1], p = exp(-2 pi f / fs): Section 4.1."""

    kind: Literal["first-order"]
    roll_off_hz: Annotated[float, Range("Hz", 0.01, 500, "the roll-off frequency")]
    extra_delay_samples: DelaySamples = 0


_ActuatorTolerance = Annotated[
    float,
    Range("", 1e-9, 1e3, "the relative standard deviation"),
]


class SecondOrder(Table):
    """gain exp(-s delay) w^2 / (s^2 + 2 zeta w s + w^2).

    The tolerances (one standard deviation) state how well the numbers are known; they are used by
    a diagnosis but not by a test.
    """

    kind: Literal["second-order"]
    natural_frequency_hz: Annotated[float, Range("Hz", 0.1, 500, "the natural frequency")]
    damping_ratio: Annotated[float, Range("", 0.01, 10, "the damping ratio")]
    gain: Annotated[float, Range("", 0.01, 100, "the static gain")] = 1.0
    delay_s: Annotated[float, Range("s", 0, 1, "the delay")] = 0.0
    delay_tol_s: Annotated[float, Range("s", 1e-12, 1, "the delay's standard deviation")] | None = (
        None
    )
    natural_frequency_tol: _ActuatorTolerance | None = None
    damping_ratio_tol: _ActuatorTolerance | None = None
    gain_tol: _ActuatorTolerance | None = None


TOLERANCES = ("delay_tol_s", "natural_frequency_tol", "damping_ratio_tol", "gain_tol")
"""Keys of an actuator that state how well it is known, and do not describe the machine."""


def _oil_column_resolved(oil: float, mass: float, substeps: int) -> str | None:
    """Stability of the table on its oil column with explicit steps: h^2 k < 4 m, as in the core."""
    if (1 / (STANDARD_HZ * substeps)) ** 2 * oil < 4 * mass:
        return None
    needed = math.floor(math.sqrt(oil / (4 * mass)) / STANDARD_HZ) + 1
    remedy = f"use at least substeps = {needed}"
    if needed > MAX_SUBSTEPS:
        softest = 4 * mass * (STANDARD_HZ * MAX_SUBSTEPS) ** 2
        remedy = f"even with substeps = {MAX_SUBSTEPS} it must be below {softest:.3g} N/m"
    return (
        f"found {oil:g} N/m; with moving_mass_kg = {mass:g} kg and substeps = {substeps} the "
        f"integration of the oil column would be unstable; {remedy}; check the unit of the "
        "stiffness"
    )


class ServoHydraulic(Table):
    """PI-controlled servo valve, square-root load flow, oil column and table."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition(
            "oil_stiffness_n_per_m",
            ("oil_stiffness_n_per_m", "moving_mass_kg", "substeps"),
            _oil_column_resolved,
        ),
    )

    kind: Literal["servo-hydraulic"]
    kp_per_s: Annotated[float, Range("1/s", 1e-2, 1e4, "the proportional gain")] = 63.5
    ki_per_s2: Annotated[float, Range("1/s^2", 0, 1e6, "the integral gain")] = 6.0
    valve_time_constant_s: Annotated[float, Range("s", 1e-5, 0.1, "the valve's lag")] = 0.0018
    stall_force_n: Annotated[float, Range("N", 1, 1e9, "the stall force")] = 16000.0
    flow_limit_m_per_s: Annotated[float, Range("m/s", 1e-4, 100, "the no-load velocity")] = 1.0
    oil_stiffness_n_per_m: Annotated[
        float, Range("N/m", 1e3, 1e12, "the oil column's stiffness")
    ] = 2e7
    oil_damping_n_s_per_m: Annotated[float, Range("N s/m", 0, 1e10, "the oil column's damping")] = (
        1.2e4
    )
    moving_mass_kg: Annotated[float, Range("kg", 1e-3, 1e6, "the moving mass")] = 45.0
    friction_n: FrictionForce = 80.0
    friction_width_m_per_s: FrictionWidth = 0.0005
    viscous_n_s_per_m: Annotated[float, Range("N s/m", 0, 1e9, "the viscous force")] = 600.0
    substeps: Annotated[int, Count(1, MAX_SUBSTEPS, "the substeps per sample")] = 16

    @property
    def omitted(self) -> tuple[str, ...]:
        """Keys that the file omits or lists as assumed, whose values are those of another rig."""
        return tuple(key for key in type(self).model_fields if key not in self.model_fields_set)

    def assuming(self, keys: Collection[str]) -> ServoHydraulic:
        """Return the same actuator, which omits those of the keys that have their default value.

        Another value has been stated by somebody since the file was written.
        """
        fields = type(self).model_fields
        gone = {key for key in keys if getattr(self, key) == fields[key].default}
        found = self.model_copy()
        found.model_fields_set.difference_update(gone)
        return found


class ServoValve(Table):
    """Servo valve, natural velocity feedback and actuator by their transfer functions.

    Transfer functions and parameter names are those of Silva et al., MSSP 135 (2020) 106381. The
    specimen's stiffness, damping and mass are solved together with it exactly; it needs an
    `inertia`. With ``loop_kp`` or ``loop_ki_per_s`` the drive closes its own displacement loop.
    """

    kind: Literal["servo-valve"]
    gain: Annotated[float, Range("", -10, 10, "the gain of the command")] = 1.0
    valve_n_per_m_s3: Annotated[float, Range("", 1e3, 1e20, "the valve's gain a1 b0")]
    valve_b1_per_s: Annotated[float, Range("1/s", 1e-3, 1e6, "the valve's damping b1")]
    valve_b2_per_s2: Annotated[float, Range("1/s^2", 1, 1e12, "the valve's stiffness b2")]
    velocity_feedback_n_s_per_m2: Annotated[
        float, Range("", 0, 1e15, "the natural velocity feedback a2")
    ]
    leakage_per_s: Annotated[float, Range("1/s", 0, 1e6, "the actuator's pole a3")]
    command_range_m: Annotated[float, Range("m", 0, 100, "the range of the drive's input")] = 0.0
    command_lsb_m: Annotated[float, Range("m", 0, 1, "the step of the drive's input")] = 0.0
    loop_kp: Annotated[float, Range("", 0, 1e3, "the gain of the drive's own loop")] = 0.0
    loop_ki_per_s: Annotated[float, Range("1/s", 0, 1e6, "its integral gain")] = 0.0
    delay_samples: Annotated[int, Count(0, 1000, "the transport delay")] = 0
    substeps: Annotated[int, Count(1, MAX_SUBSTEPS, "the substeps per sample")] = 1


Actuator = PureDelay | FirstOrder | SecondOrder | ServoHydraulic | ServoValve
_ACTUATOR: Final = "actuator."


def assumable(actuator: object, prefix: str = "") -> list[str]:
    """Return the keys of an actuator, as a table of a file, whose values may be assumed."""
    given = actuator.get("kind") if isinstance(actuator, dict) else getattr(actuator, "kind", "")
    if given != "servo-hydraulic":
        return []
    keys = [key for key, info in ServoHydraulic.model_fields.items() if not info.is_required()]
    return [f"{prefix}{_ACTUATOR}{key}" for key in keys]


def assumed_of(actuator: Actuator | None, prefix: str = "") -> tuple[str, ...]:
    """Return the keys of an actuator whose values nobody stated, after the name of its axis."""
    omitted = actuator.omitted if isinstance(actuator, ServoHydraulic) else ()
    return tuple(f"{prefix}{_ACTUATOR}{key}" for key in omitted)


def with_assumed(actuator: Actuator, assumed: Collection[str] | None, prefix: str = "") -> Actuator:
    """Return an actuator that omits the values which ``rig.assumed`` lists; see `assumed_of`."""
    start = f"{prefix}{_ACTUATOR}"
    keys = [key.removeprefix(start) for key in assumed or () if key.startswith(start)]
    if not keys or not isinstance(actuator, ServoHydraulic):
        return actuator
    return actuator.assuming(keys)


def assumed_faults(
    rig: object, known: list[str], needs: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
    """Yield what is wrong with ``assumed`` in the table ``[rig]``.

    Args:
        rig: the table.
        known: what it may list.
        needs: tables on which that depends.
    """
    listed = rig.get("assumed") if isinstance(rig, dict) else getattr(rig, "assumed", None)
    for name in listed if isinstance(listed, list) else ():
        if not isinstance(name, str) or name in known:
            continue
        allowed = (
            f"allowed here: {', '.join(known)}" if known else
            "only values of a servo-hydraulic actuator are ever assumed, and this rig has none"
        )  # fmt: skip
        text = f"found {written(name)}{nearest(name, known)}; {allowed}: correct or remove it"
        yield ("rig", "assumed"), text, ("rig.assumed", *needs)


def _valve_moves_a_mass(actuator: Actuator, specimen: list[SpecimenElement]) -> str | None:
    if not isinstance(actuator, ServoValve):
        return None
    mass = sum(item.m_kg for item in specimen if isinstance(item, InertiaElement))
    if mass > 0.0:
        return None
    return (
        f"found a mass of {mass:g} kg; an actuator of kind servo-valve needs a specimen with "
        'mass: add [[specimen]] with element = "inertia", m_kg above 0'
    )


class StiffnessElement(Table):
    """f = k x; may be negative to correct a model."""

    element: Literal["stiffness"]
    k_n_per_m: Annotated[float, Range("N/m", -1e12, 1e12, "the stiffness")]


class ViscousElement(Table):
    """f = c v; may be negative to correct a model."""

    element: Literal["viscous"]
    c_n_s_per_m: Annotated[float, Range("N s/m", -1e10, 1e10, "the damping")]


class CoulombElement(Table):
    """Dry friction, smoothed around zero velocity."""

    element: Literal["coulomb"]
    fc_n: FrictionForce
    width_m_per_s: FrictionWidth = 0.0005


def _static_above_sliding(fc_n: float, fs_n: float) -> str | None:
    if fs_n >= fc_n:
        return None
    return f"found {fs_n:g}; static friction must not be below sliding friction fc_n = {fc_n:g} N"


_FRICTION_CHECKS = (Condition("fs_n", ("fc_n", "fs_n"), _static_above_sliding),)


class StribeckElement(Table):
    """Friction that decreases from fs to fc around the velocity vs, by exp(-|v/vs|^exponent)."""

    checks: ClassVar[tuple[Condition, ...]] = _FRICTION_CHECKS

    element: Literal["stribeck"]
    fc_n: FrictionForce
    fs_n: FrictionForce
    vs_m_per_s: Annotated[float, Range("m/s", 1e-6, 10, "the Stribeck velocity")]
    width_m_per_s: FrictionWidth = 0.0005
    exponent: Annotated[float, Range("", 0.05, 10, "the exponent of the peak")] = 2.0


class LugreElement(Table):
    """LuGre bristle friction."""

    checks: ClassVar[tuple[Condition, ...]] = _FRICTION_CHECKS

    element: Literal["lugre"]
    fc_n: Annotated[float, Range("N", 1e-3, 1e8, "the sliding friction")]
    fs_n: FrictionForce
    vs_m_per_s: Annotated[float, Range("m/s", 1e-6, 10, "the Stribeck velocity")]
    sigma0_n_per_m: Annotated[float, Range("N/m", 1, 1e12, "the bristle stiffness")]
    sigma1_n_s_per_m: Annotated[float, Range("N s/m", 0, 1e9, "the bristle damping")]
    sigma2_n_s_per_m: Annotated[float, Range("N s/m", 0, 1e9, "the viscous term")] = 0.0


class QuadDampingElement(Table):
    """f = c2 v |v|."""

    element: Literal["quad_damping"]
    c2_n_s2_per_m2: Annotated[float, Range("N s^2/m^2", -1e12, 1e12, "the quadratic damping")]


class InertiaElement(Table):
    """f = m a."""

    element: Literal["inertia"]
    m_kg: Annotated[float, Range("kg", 0, 1e7, "the mass")]


class GapElement(Table):
    """A spring behind a gap on both sides."""

    element: Literal["gap"]
    k_n_per_m: Stiffness
    gap_m: Annotated[float, Range("m", 0, 10, "the gap")]


class CubicElement(Table):
    """f = k3 x^3."""

    element: Literal["cubic"]
    k3_n_per_m3: Annotated[float, Range("N/m^3", -1e15, 1e15, "the cubic stiffness")]


class QuadraticElement(Table):
    """f = k2 x^2."""

    element: Literal["quadratic"]
    k2_n_per_m2: Annotated[float, Range("N/m^2", -1e15, 1e15, "the quadratic stiffness")]


ContactLoss = Annotated[
    float, Range("s/m", 0, 1e6, "the loss of the contact (its force times 1 + loss v, v inwards)")
]


class StopperElement(Table):
    """A stop at the displacement xs, which may lose energy (Hunt & Crossley)."""

    element: Literal["stopper"]
    ks_n_per_m: Stiffness
    xs_m: Annotated[float, Range("m", 0, 10, "the stop's position")]
    loss_s_per_m: ContactLoss = 0.0


def _loop_closed(xy_m: float | None, a: float, b: float, c: float, eta: float) -> str | None:
    if xy_m is None:
        if b + c > 0:
            return None
        return (
            f"b + c = {b + c:g} must be above 0, or the hysteretic force is unbounded (Eqn 4.2); "
            "give b and c, or the yield displacement xy_m"
        )
    if b or c or a != 1:
        return "xy_m replaces a = 1, b = c = 0.5 / xy_m^eta; give either xy_m or a, b, c, not both"
    if math.log10(0.5) - eta * math.log10(xy_m) > 15:
        return f"xy_m = {xy_m:g} with eta = {eta:g} is too sharp to compute; lower eta"
    return None


class BoucWen(Table):
    """Parameters of Eqn 4.1-4.2, displacement in m; ``xy_m`` can be given instead of a, b and c.

    A loop given by its yield displacement is stored with a = 1, b = c = 0.5 / xy_m^eta.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("b", ("xy_m", "a", "b", "c", "eta"), _loop_closed),
    )

    element: str
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness")]
    post_yield_ratio: Annotated[float, Range("", 0, 1, "post-yield over elastic stiffness")]
    eta: Annotated[float, Range("", 1, 20, "the sharpness eta of yielding")]
    a: Annotated[float, Range("", 1e-3, 1e3, "A of Eqn 4.2")] = 1.0
    b: Annotated[float, Range("", 0, 1e15, "B of Eqn 4.2")] = 0.0
    c: Annotated[float, Range("", -1e15, 1e15, "C of Eqn 4.2")] = 0.0
    xy_m: Annotated[float, Range("m", 1e-5, 10, "the yield displacement")] | None = None

    def settle(self) -> None:
        """Store a, b and c for a loop that was given by its yield displacement."""
        if self.xy_m is not None:
            half = 0.5 / self.xy_m**self.eta
            self.__dict__.update(b=half, c=half, xy_m=None)


class HysteresisElement(BoucWen):
    """Yielding: Bouc-Wen as in Eqn 4.1-4.2."""

    element: Literal["hysteresis"]


class PinchingElement(BoucWen):
    """Bouc-Wen with a loop pinched around zero."""

    element: Literal["pinching"]
    depth: Annotated[float, Range("", 0, 1, "the pinching depth")]
    width_ratio: Annotated[float, Range("", 1e-3, 10, "pinched width over yield displacement")]


def _lost_with_something(
    travel_m: float | None, work_j: float | None, amplitude_m: float | None
) -> str | None:
    if travel_m is not None or work_j is not None or amplitude_m is not None:
        return None
    return (
        "found none of travel_m, work_j and amplitude_m; give at least one: with travel_m, the "
        "strength is lost over cumulative travel, with work_j over cumulative work of the loop, "
        "with amplitude_m over the largest displacement"
    )


class DegradationElement(BoucWen):
    """Bouc-Wen whose stiffness decreases with travel, work or the largest displacement.

    At least one of ``travel_m``, ``work_j`` and ``amplitude_m`` is needed.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        *BoucWen.checks,
        Condition("travel_m", ("travel_m", "work_j", "amplitude_m"), _lost_with_something),
    )

    element: Literal["degradation"]
    loss: Annotated[float, Range("", 0, 1, "the share finally lost")]
    travel_m: Annotated[float, Range("m", 1e-6, 1e6, "the travel over which it is lost")] | None = (
        None
    )
    work_j: Annotated[float, Range("J", 1e-6, 1e15, "the work over which it is lost")] | None = None
    amplitude_m: (
        Annotated[float, Range("m", 1e-6, 1e3, "the largest displacement over which it is lost")]
        | None
    ) = None


class MaxwellElement(Table):
    """Spring and dashpot in series."""

    element: Literal["maxwell"]
    km_n_per_m: Stiffness
    tau_s: Annotated[float, Range("s", 1e-4, 1e4, "the relaxation time")]


class SecondModeElement(Table):
    """A mass attached to the specimen by a spring."""

    element: Literal["second_mode"]
    m2_kg: Annotated[float, Range("kg", 1e-6, 1e8, "the mass")]
    f2_hz: Annotated[float, Range("Hz", 0.01, 400, "the frequency")]
    zeta2: Annotated[float, Range("", 0, 2, "the damping ratio")] = 0.02


class PDeltaElement(Table):
    """The negative stiffness of a gravity load, load over height."""

    element: Literal["p_delta"]
    gravity_load_n: Annotated[float, Range("N", 0, 1e10, "the gravity load")]
    height_m: Annotated[float, Range("m", 0.01, 1e3, "the height")]


class GapFrictionElement(Table):
    """A slider behind a spring and a gap on both sides; its friction may differ by direction."""

    element: Literal["gap_friction"]
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness")]
    gap_m: Annotated[float, Range("m", 0, 10, "the gap")]
    fc_up_n: Annotated[float, Range("N", 0, 1e8, "the friction in the positive direction")]
    fc_down_n: Annotated[float, Range("N", 0, 1e8, "the friction in the negative direction")]
    seat_m: Annotated[float, Range("m", 0, 10, "the distance over which the faces close")] = 0.0


class CoulombUnevenElement(Table):
    """Dry friction that is larger in one direction."""

    element: Literal["coulomb_uneven"]
    fc_up_n: Annotated[float, Range("N", 0, 1e8, "the friction in the positive direction")]
    fc_down_n: Annotated[float, Range("N", 0, 1e8, "the friction in the negative direction")]
    width_m_per_s: FrictionWidth = 0.0005


class GapUnevenElement(Table):
    """A spring in each direction behind its own gap; a stiffness of 0 leaves one side free."""

    element: Literal["gap_uneven"]
    k_up_n_per_m: Annotated[float, Range("N/m", 0, 1e12, "the stiffness in the positive direction")]
    gap_up_m: Annotated[float, Range("m", 0, 10, "the gap in the positive direction")]
    k_down_n_per_m: Annotated[
        float, Range("N/m", 0, 1e12, "the stiffness in the negative direction")
    ]
    gap_down_m: Annotated[float, Range("m", 0, 10, "the gap in the negative direction")]
    loss_s_per_m: ContactLoss = 0.0


class PowerDampingElement(Table):
    """Fluid viscous damper, f = C |v|^a sgn(v); C in N (s/m)^a is ``force_n`` for at = 1 m/s."""

    element: Literal["power_damping"]
    force_n: Annotated[float, Range("N", -1e10, 1e10, "the force at the velocity at_m_per_s")]
    at_m_per_s: Annotated[float, Range("m/s", 1e-6, 100, "the velocity of that force")] = 1.0
    exponent: Annotated[float, Range("", 0.05, 10, "the exponent of the velocity")]
    width_m_per_s: Annotated[
        float,
        Range("m/s", 1e-7, FRICTION_WIDTH_MAX, "the velocity below which the force is linear"),
    ] = 0.0005


class NonlinearMaxwellElement(Table):
    """A fluid viscous damper, f = C |v|^a sgn(v), on a spring in series: its fluid, its brace."""

    element: Literal["nonlinear_maxwell"]
    km_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness of the spring")]
    force_n: Annotated[float, Range("N", 1e-6, 1e10, "the force at the velocity at_m_per_s")]
    at_m_per_s: Annotated[float, Range("m/s", 1e-6, 100, "the velocity of that force")] = 1.0
    exponent: Annotated[float, Range("", 0.05, 10, "the exponent of the velocity")]


class PowerSpringElement(Table):
    """A spring that softens (exponent below 1) or hardens, f = force |x / at|^n sgn(x)."""

    element: Literal["power_spring"]
    force_n: Annotated[float, Range("N", -1e10, 1e10, "the force at the displacement at_m")]
    at_m: Annotated[float, Range("m", 1e-6, 10, "the displacement of that force")]
    exponent: Annotated[float, Range("", 0.05, 10, "the exponent of the displacement")]
    width_m: Annotated[
        float, Range("m", 1e-9, 1, "the displacement below which the force is linear")
    ] = 1e-5


class RockingElement(Table):
    """An elastic spring in two lines: a wall, a pier or a column that rocks once it lifts off."""

    element: Literal["rocking"]
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness before uplift")]
    uplift_m: Annotated[float, Range("m", 1e-9, 10, "the displacement of uplift")]
    post_uplift_ratio: Annotated[
        float, Range("", -0.9, 0.99, "the stiffness after uplift over that before")
    ] = 0.0


class PendulumElement(Table):
    """f = weight sin(x / length), x along the arc; a negative weight is an inverted pendulum."""

    element: Literal["pendulum"]
    weight_n: Annotated[float, Range("N", -1e10, 1e10, "the weight")]
    length_m: Annotated[float, Range("m", 1e-3, 1e3, "the length")]


class FrictionPendulumElement(Table):
    """A slider in a bowl: weight over radius, and friction that grows with velocity."""

    element: Literal["friction_pendulum"]
    weight_n: Annotated[float, Range("N", 1e-3, 1e10, "the weight on the slider")]
    radius_m: Annotated[float, Range("m", 0.01, 1e4, "the bowl's radius")]
    mu_slow: Annotated[float, Range("", 0, 2, "the friction coefficient at low velocity")]
    mu_fast: Annotated[float, Range("", 0, 2, "the friction coefficient at high velocity")]
    mu_rate_s_per_m: Annotated[
        float, Range("s/m", 0, 1e5, "the rate of the transition between the two")
    ] = 20.0
    xy_m: Annotated[float, Range("m", 1e-7, 1, "the displacement before sliding")] = 2.5e-4


class IwanElement(Table):
    """Twelve parallel springs that yield in turn: Masing's loops."""

    element: Literal["iwan"]
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness")]
    post_yield_ratio: Annotated[float, Range("", 0, 1, "post-yield over elastic stiffness")]
    xy_m: Annotated[float, Range("m", 1e-7, 10, "the mean yield displacement")]
    spread: Annotated[float, Range("", 0, 1, "the spread of yielding about its mean")] = 1.0


class MenegottoPintoElement(Table):
    """Steel: branches with a smooth transition from the elastic to the hardening line."""

    element: Literal["menegotto_pinto"]
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness")]
    post_yield_ratio: Annotated[float, Range("", 0, 0.9, "post-yield over elastic stiffness")]
    xy_m: Annotated[float, Range("m", 1e-7, 10, "the yield displacement")]
    r0: Annotated[float, Range("", 1, 50, "the sharpness R0 of the first bend")] = 20.0
    cr1: Annotated[float, Range("", 0, 0.99, "the share cR1 of R0 finally lost")] = 0.925
    cr2: Annotated[float, Range("", 1e-3, 10, "the plastic displacement cR2 at half that loss")] = (
        0.15
    )


class ChabocheElement(Table):
    """Yielding with kinematic and isotropic hardening."""

    element: Literal["chaboche"]
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness")]
    fy_n: Annotated[float, Range("N", 1e-3, 1e10, "the first yield force")]
    kinematic_n_per_m: Annotated[float, Range("N/m", 0, 1e12, "the kinematic modulus H")] = 0.0
    recovery_per_m: Annotated[
        float, Range("1/m", 0, 1e8, "the recovery gamma; the shift ends at H / gamma")
    ] = 0.0
    isotropic_n: Annotated[float, Range("N", 0, 1e10, "the growth Q of the yield force")] = 0.0
    isotropic_rate_per_m: Annotated[float, Range("1/m", 0, 1e8, "the rate of that growth")] = 0.0


def _beyond(what: str) -> Callable[[float, float], str | None]:
    """Return the check that a displacement lies beyond another one, which ``what`` names."""

    def problem(least_m: float, found_m: float) -> str | None:
        if found_m > least_m:
            return None
        return f"found {found_m:g}; must lie beyond {what} = {least_m:g} m"

    return problem


Lost = Annotated[float, Range("", 0, 0.99, "the share lost")]


class RcColumnElement(Table):
    """A reinforced concrete column: pinching and degradation with amplitude and energy."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("ultimate_m", ("xy_m", "ultimate_m"), _beyond("the yield displacement xy_m")),
    )

    element: Literal["rc_column"]
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness")]
    post_yield_ratio: Annotated[float, Range("", 0, 1, "post-yield over elastic stiffness")]
    xy_m: Annotated[float, Range("m", 1e-6, 10, "the yield displacement")]
    eta: Annotated[float, Range("", 1, 20, "the sharpness of yielding")] = 2.0
    pivot: Annotated[float, Range("", 0, 1e6, "the pivot of unloading")] = 200.0
    ultimate_m: Annotated[float, Range("m", 1e-5, 100, "the displacement of that loss")] = 10.0
    strength_lost_at_ultimate: Lost = 0.0
    energy_j: Annotated[float, Range("J", 1e-6, 1e15, "the energy of the losses with it")] = 1e12
    strength_lost_with_energy: Lost = 0.0
    stiffness_lost_with_energy: Lost = 0.0
    slip: Annotated[float, Range("", 0, 0.5, "slip over the displacement beyond yield")] = 0.0
    slip_level: Annotated[float, Range("", -1, 1, "the force of slip over the strength")] = 0.3
    slip_width: Annotated[float, Range("", 0.01, 10, "the width of slip over the strength")] = 0.2


class PeakOrientedElement(Table):
    """A spring that is slack within the largest displacement so far on either side: pinching."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("reach_m", ("start_m", "reach_m"), _beyond("the first excursion start_m")),
    )

    element: Literal["peak_oriented"]
    k_up_n_per_m: Annotated[float, Range("N/m", 0, 1e12, "the secant stiffness upwards at reach_m")]
    k_down_n_per_m: Annotated[
        float, Range("N/m", 0, 1e12, "the secant stiffness downwards at reach_m")
    ]
    reach_m: Annotated[float, Range("m", 1e-6, 100, "the displacement of these two")]
    exponent: Annotated[float, Range("", 1, 10, "the power of reloading")] = 2.0
    backbone: Annotated[float, Range("", 0, 1, "the power of first loading")] = 0.6
    start_m: Annotated[float, Range("m", 1e-7, 10, "the excursion that counts as the first")] = 1e-4


class TakedaElement(Table):
    """A loop that reloads towards the largest displacement so far: damaged concrete, joints."""

    element: Literal["takeda"]
    k_n_per_m: Annotated[float, Range("N/m", 1e-3, 1e12, "the stiffness")]
    post_yield_ratio: Annotated[float, Range("", -0.9, 0.99, "post-yield over elastic stiffness")]
    xy_m: Annotated[float, Range("m", 1e-6, 10, "the yield displacement")]
    sharpness: Annotated[float, Range("", 1, 1000, "the sharpness of yielding")] = 20.0
    unloading_exponent: Annotated[float, Range("", 0, 1, "the exponent of unloading")] = 0.4
    pinching: Annotated[float, Range("", 0, 1, "the degree of pinching")] = 0.0
    pinching_level: Annotated[float, Range("", 0, 0.99, "the force of the corner")] = 0.3
    energy_j: Annotated[float, Range("J", 1e-12, 1e15, "the energy of the loss of strength")] = 1e15
    strength_down_over_up: Annotated[float, Range("", 0.01, 100, "strength down over up")] = 1.0
    corner_on_line: Annotated[float, Range("", 0, 1, "the corner's share of the line")] = 1.0


class PythonElement(PythonClass):
    """A class in Python, for tests in virtual time, and the arguments with which it is created."""

    element: Literal["python"]


SpecimenElement = (
    StiffnessElement
    | ViscousElement
    | CoulombElement
    | StribeckElement
    | LugreElement
    | QuadDampingElement
    | InertiaElement
    | GapElement
    | CubicElement
    | QuadraticElement
    | StopperElement
    | HysteresisElement
    | PinchingElement
    | DegradationElement
    | MaxwellElement
    | SecondModeElement
    | PDeltaElement
    | GapFrictionElement
    | CoulombUnevenElement
    | GapUnevenElement
    | PowerDampingElement
    | PowerSpringElement
    | RockingElement
    | PendulumElement
    | FrictionPendulumElement
    | IwanElement
    | MenegottoPintoElement
    | ChabocheElement
    | RcColumnElement
    | PeakOrientedElement
    | TakedaElement
    | NonlinearMaxwellElement
    | PythonElement
)


class DisplacementSensor(Table):
    """The displacement channel: noise, resolution, offset, range (absent: none)."""

    noise_std_m: Annotated[float, Range("m", 0, 0.1, "the noise")] = 0.0
    lsb_m: Annotated[float, Range("m", 0, 0.1, "the resolution")] = 0.0
    bias_m: Annotated[float, Range("m", -1, 1, "the offset")] = 0.0
    range_m: Annotated[float, Range("m", 1e-6, 100, "the range in each direction")] | None = None


class ForceSensor(Table):
    """The load cell: noise, resolution, offset, range (absent: none)."""

    noise_std_n: Annotated[float, Range("N", 0, 1e7, "the noise")] = 0.0
    lsb_n: Annotated[float, Range("N", 0, 1e7, "the resolution")] = 0.0
    bias_n: Annotated[float, Range("N", -1e8, 1e8, "the offset")] = 0.0
    range_n: Annotated[float, Range("N", 1e-3, 1e10, "the range in each direction")] | None = None


_MEASURED_IN = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2", "force": "N"}
"""SI unit of what an extra sensor of the virtual rig can measure."""
_OTHER_UNITS = {
    "displacement": ("m", "cm", "mm", "um", "in", "ft"),
    "velocity": ("m/s", "cm/s", "mm/s", "in/s"),
    "acceleration": ("m/s^2", "mm/s^2", "g"),
    "force": ("N", "kN", "MN", "lbf", "kip"),
}
"""Units that a gain may be in by mistake."""
_SAME_GAIN = 0.01
"""A gain within one per cent of the factor of another unit is in that unit: a calibration of a
sensor is stated to at least this accuracy, and the factors differ by more than three."""


def _factor(measures: str, unit: str) -> float | None:
    """Return the reading in a unit for 1 of the SI unit; None: it is of another kind."""
    try:
        return 1.0 / units.convert(f"1 {unit}", _MEASURED_IN[measures])
    except (units.UnitError, KeyError):
        return None


def _gain_in_its_unit(gain: float | None, unit: str, measures: str) -> str | None:
    if measures == "none":
        return None
    own, si = _factor(measures, unit), _MEASURED_IN[measures]
    if gain is None:
        if own is not None:
            return None
        return (
            f"missing; the virtual sensor measures {measures}, and the unit {unit} is not one of "
            f"{measures}: give its reading in {unit} for 1 {si}, or a unit such as "
            f"{', '.join(_OTHER_UNITS[measures])}"
        )
    if gain == 0.0:
        return "found 0, with which the virtual sensor always reads 0; omit gain, or give another"
    if own is None or abs(abs(gain) / own - 1.0) <= _SAME_GAIN:
        return None
    for other in _OTHER_UNITS[measures]:
        factor = _factor(measures, other)
        if factor is not None and abs(abs(gain) / factor - 1.0) <= _SAME_GAIN:
            return (
                f"found {gain:g}, with which the virtual sensor reads {other}, but its unit is "
                f"{unit}: omit gain, or give the reading in {unit} for 1 {si}, {own:.6g}, or "
                f'unit = "{other}"'
            )
    return None


class ExtraSensor(Table):
    """A channel in addition to displacement and force, recorded by its name.

    On a rig of several axes, a ``[[sensor]]`` may be read through it; nothing else uses it.

    ``scale`` and ``offset`` convert the wire to the value; at the end of a serial packet the wire
    has steps of ``wire_step``. ``measures``, ``gain`` and the errors apply to the virtual rig.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("gain", ("gain", "unit", "measures"), _gain_in_its_unit),
    )

    name: Annotated[
        str,
        Text(
            "the name of the channel",
            r"[a-z][a-z0-9_]{0,31}",
            "up to 32 characters of a-z 0-9 _ in quotes, starting with a letter",
        ),
    ]
    unit: Annotated[str, Text("its unit", r"\S{0,16}", "up to 16 characters without spaces")]
    scale: Annotated[
        float, Range("", -1e12, 1e12, "the factor applied to the number on the wire")
    ] = 1.0
    offset: Annotated[float, Range("", -1e12, 1e12, "the value for a 0 on the wire")] = 0.0
    signal: Annotated[str, SOME_TEXT] | None = None
    wire_step: Annotated[
        float, Range("", 1e-15, 1e6, "the step of the channel's own 32-bit number")
    ] = 1e-6
    measures: Literal["none", "displacement", "velocity", "acceleration", "force"] = "none"
    gain: (
        Annotated[
            float, Range("", -1e12, 1e12, "its reading for 1 m, m/s, m/s^2 or N of that quantity")
        ]
        | None
    ) = None
    noise_std: Annotated[float, Range("", 0, 1e12, "the noise, in its unit")] = 0.0
    lsb: Annotated[float, Range("", 0, 1e12, "the resolution, in its unit")] = 0.0
    bias: Annotated[float, Range("", -1e12, 1e12, "the error at rest, in its unit")] = 0.0

    def settle(self) -> None:
        """Write out the gain of a virtual sensor in its unit."""
        if self.gain is None and self.measures != "none":
            self.__dict__["gain"] = _factor(self.measures, self.unit)


def _different_names(extra: list[ExtraSensor]) -> str | None:
    names = [one.name for one in extra]
    twice = [name for name in names if names.count(name) > 1]
    return f'found the name "{twice[0]}" twice; each channel needs its own name' if twice else None


class Sensors(Table):
    """The sensors that the controller reads."""

    checks: ClassVar[tuple[Condition, ...]] = (Condition("extra", ("extra",), _different_names),)

    displacement: DisplacementSensor = Field(default_factory=DisplacementSensor)
    force: ForceSensor = Field(default_factory=ForceSensor)
    extra: list[ExtraSensor] = Field(default_factory=list, max_length=EXTRAS_MAX)


def not_rising(frequency_hz: Sequence[float]) -> str | None:
    """Return an error message unless frequencies, Hz, increase from each to the next."""
    for n, (before, now) in enumerate(itertools.pairwise(frequency_hz)):
        if now <= before:
            return (
                f"found {now:g} Hz after {before:g} Hz, entry {n + 2} of {len(frequency_hz)}; "
                "frequencies must increase from each to the next: sort all lists of the response "
                "by frequency, and keep one value of each"
            )
    return None


def _one_row_a_frequency(
    frequency_hz: list[float], amplitude: list[float], delay_at_frequency_s: list[float]
) -> str | None:
    sizes = [len(frequency_hz), len(amplitude), len(delay_at_frequency_s)]
    if len(set(sizes)) == 1:
        return None
    return (
        f"frequency_hz, amplitude and delay_at_frequency_s have {sizes[0]}, {sizes[1]} and "
        f"{sizes[2]} entries; they must have the same number"
    )


def _one_force_a_frequency(
    frequency_hz: list[float], in_phase: list[float], in_quadrature: list[float]
) -> str | None:
    if len(in_phase) == len(in_quadrature) and len(in_phase) in (0, len(frequency_hz)):
        return None
    return (
        f"force_in_phase_n_per_m and force_in_quadrature_n_per_m have {len(in_phase)} and "
        f"{len(in_quadrature)} entries; they must have one for each of the {len(frequency_hz)} "
        "of frequency_hz, or both be left out"
    )


def _one_command_a_frequency(
    frequency_hz: list[float], command_amplitude_m: list[float]
) -> str | None:
    if len(command_amplitude_m) in (0, len(frequency_hz)):
        return None
    return (
        f"command_amplitude_m has {len(command_amplitude_m)} entries; it must have one for each of "
        f"the {len(frequency_hz)} of frequency_hz, or be left out"
    )


class Identified(Table):
    """Results of `rthyb identify`; ``alpha`` is the initial delay estimate of the next test.

    ``roll_off_hz`` is present if the sweep found a resonance of actuator and specimen: control laws
    then roll off their lead below it.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("frequency_hz", ("frequency_hz",), not_rising),
        Condition(
            "frequency_hz",
            ("frequency_hz", "amplitude", "delay_at_frequency_s"),
            _one_row_a_frequency,
        ),
        Condition(
            "force_in_phase_n_per_m",
            ("frequency_hz", "force_in_phase_n_per_m", "force_in_quadrature_n_per_m"),
            _one_force_a_frequency,
        ),
        Condition(
            "command_amplitude_m",
            ("frequency_hz", "command_amplitude_m"),
            _one_command_a_frequency,
        ),
    )

    alpha: Annotated[float, Range("samples", 0, 1000, "the identified delay")]
    delay_s: Annotated[float, Range("s", 0, 1, "the identified delay")]
    gain: Annotated[float, Range("", 0.01, 100, "the amplitude ratio")] = 1.0
    rest_noise_displacement_m: (
        Annotated[float, Range("m", 0, 0.1, "the displacement noise at rest")] | None
    ) = None
    rest_noise_force_n: Annotated[float, Range("N", 0, 1e7, "the force noise at rest")] | None = (
        None
    )
    date: Annotated[str, Text("the date")] = ""
    frequency_hz: list[Annotated[float, Range("Hz", 1e-3, 512, "a frequency")]] = Field(
        default_factory=list
    )
    amplitude: list[Annotated[float, Range("", 0, 100, "an amplitude ratio")]] = Field(
        default_factory=list
    )
    delay_at_frequency_s: list[Annotated[float, Range("s", -1, 1, "a delay")]] = Field(
        default_factory=list
    )
    force_in_phase_n_per_m: list[
        Annotated[float, Range("N/m", -1e12, 1e12, "a force in phase over displacement")]
    ] = Field(default_factory=list)
    force_in_quadrature_n_per_m: list[
        Annotated[float, Range("N/m", -1e12, 1e12, "a force in quadrature over displacement")]
    ] = Field(default_factory=list)
    command_amplitude_m: list[
        Annotated[float, Range("m", 1e-9, 1, "the amplitude of a commanded sine")]
    ] = Field(default_factory=list)
    roll_off_hz: (
        Annotated[float, Range("Hz", 1, 400, "the roll-off below the first resonance")] | None
    ) = None

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Accept a date written as a TOML date."""
        if isinstance(data, dict) and isinstance(data.get("date"), datetime.date):
            return {**data, "date": data["date"].isoformat()}
        return data


LinkKind = Literal["can", "serial", "socket", "python-can"]


SIGNALS = ("x_cmd", "x_meas", "f_meas", "seq", "state", "echo", "count", "status", "crc8")
"""Signals of a DBC file that the controller needs (`rthyb_rt.core.dbc.ROLES`)."""

BUSES: tuple[LinkKind, ...] = ("can", "python-can")
DEFAULT_BAUD = 921_600
_CAN_NAME_MAX = 15
_SOCKET_PATH_MAX = 107


def _words(what: str) -> Text:
    return Text(what, SOME_TEXT.pattern, SOME_TEXT.form)


SignalNames = dict[Annotated[str, OneOf(SIGNALS)], Annotated[str, _words("the name of a signal")]]


def _channel_fits(kind: LinkKind, channel: str) -> str | None:
    size = len(channel.encode())
    if kind == "can" and (size > _CAN_NAME_MAX or "/" in channel or " " in channel):
        other = '; a serial line is kind = "serial"' if channel.startswith("/dev/") else ""
        return (
            f'found "{channel}"; a CAN interface has a name such as "can0", up to {_CAN_NAME_MAX} '
            f"characters{other}"
        )
    if kind == "serial" and "/" not in channel:
        return f'found "{channel}"; a serial line is named by its path, such as "/dev/ttyUSB0"'
    if kind == "socket" and size > _SOCKET_PATH_MAX:
        return f"found a path of {size} bytes; a socket's path has at most {_SOCKET_PATH_MAX}"
    return None


def _interface_fits(kind: LinkKind, interface: str | None) -> str | None:
    if kind == "python-can":
        if interface is None:
            return (
                'missing; kind = "python-can" needs the name of a python-can interface, such as '
                '"pcan"'
            )
        return None
    return _only_for(interface is not None, kind, ("python-can",))


def _only_for(given: bool, kind: LinkKind, kinds: tuple[LinkKind, ...]) -> str | None:
    """Reject a key that this kind of link does not have."""
    if not given or kind in kinds:
        return None
    those = " and ".join(f'kind = "{name}"' for name in kinds)
    return f'kind = "{kind}" does not have this key, which belongs to {those}; remove it'


def _bitrate_enough(
    kind: LinkKind,
    bitrate: int | None,
    fd: bool,
    data_bitrate: int | None,
    dbc: str | None,
    sample_rate_hz: int,
    ids: IdentifiersTable | None,
) -> str | None:
    if kind == "socket":
        return _only_for(bitrate is not None, kind, ("can", "python-can", "serial"))
    if kind == "serial":
        return busload.serial_fault(bitrate or DEFAULT_BAUD, rate_hz=sample_rate_hz)
    if bitrate is None:
        return None
    least, most = busload.CAN_BITRATES[0], busload.CAN_BITRATES[-1]
    if not least <= bitrate <= most:
        return (
            f"found {bitrate}; the bit rate of CAN must be from {least} to {most} bit/s"
            f"{' (of the arbitration phase)' if fd else ''}"
        )
    # The frames of a DBC file are counted when it is read.
    if dbc is not None:
        return None
    frames = busload.own_frames(fd=fd and ids is not None)
    return busload.bus_fault(frames, bitrate, data_bitrate, rate_hz=sample_rate_hz)


LEAD_US: Final = 200.0
"""Time by which a feedback precedes its tick, if half a period is long enough."""
_LEAD_SHARE: Final = 0.4
"""Otherwise, the fraction of a period."""


def default_lead_us(sample_rate_hz: int) -> float:
    """Return the default time by which a feedback precedes its tick."""
    return min(LEAD_US, float(round(_LEAD_SHARE * 1e6 / sample_rate_hz)))


def _lead_fits(clock: str, lead_us: float | None, sample_rate_hz: int) -> str | None:
    most_us = 0.5e6 / sample_rate_hz
    if clock != "link" or lead_us is None or lead_us <= most_us:
        return None
    return (
        f"found {lead_us:g} us; at sample_rate_hz = {sample_rate_hz} a feedback can arrive at most "
        f"half a period, {most_us:.0f} us, before its tick; leave lead_us out, or make it smaller"
    )


def _data_phase_fits(
    kind: LinkKind, fd: bool, bitrate: int | None, data_bitrate: int | None
) -> str | None:
    if data_bitrate is None:
        return None
    if kind not in BUSES or not fd:
        return "is the bit rate of CAN FD's data phase; remove it, or set fd = true"
    if bitrate is None or data_bitrate < bitrate:
        return (
            f"found {data_bitrate}; bitrate must be given as well, and data_bitrate must not be "
            "below it"
        )
    return None


def _identifiers_apart(command: int, displacement: int, force: int) -> str | None:
    if len({command, displacement, force}) == 3:
        return None
    return (
        f"found command {command:#x}, displacement {displacement:#x} and force {force:#x}; each "
        "frame needs an identifier of its own"
    )


class IdentifiersTable(Table):
    """Identifiers of the program's own frames (``hw/rthyb.dbc``) of one drive, 11 bits each.

    Without this table: 0x101, 0x181 and 0x182.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("command", ("command", "displacement", "force"), _identifiers_apart),
    )

    command: Annotated[int, Count(1, 0x7FF, "the identifier of the command")]
    displacement: Annotated[int, Count(1, 0x7FF, "the identifier of the displacement")]
    force: Annotated[int, Count(1, 0x7FF, "the identifier of the force")]


def _ids_fit(kind: LinkKind, ids: IdentifiersTable | None, dbc: str | None) -> str | None:
    if ids is not None and dbc is not None:
        return "the DBC file has the identifiers of its frames; remove ids, or dbc"
    return _only_for(ids is not None, kind, BUSES)


class LinkTable(Table):
    """The link for commands and readings of a test in real time.

    Default ``bitrate`` of CAN: the current setting of the interface; of a serial line: 921600 baud.
    ``ids`` gives the program's own frames other identifiers; with ``fd = true`` they are then CAN
    FD frames. ``dbc`` is relative to the rig file; ``reset_state`` is the raw value of its state
    signal that resets the drive after a stop of its own. ``lead_us`` is used with ``clock =
    "link"`` only; the default is 200 us, or 0.4 of the period if that is less. ``sample_rate_hz``
    is the rate at which the drive takes commands and sends readings, and so the rate of a test in
    real time.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("lead_us", ("clock", "lead_us", "sample_rate_hz"), _lead_fits),
        Condition("channel", ("kind", "channel"), _channel_fits),
        Condition("interface", ("kind", "interface"), _interface_fits),
        Condition(
            "bitrate",
            ("kind", "bitrate", "fd", "data_bitrate", "dbc", "sample_rate_hz", "ids"),
            _bitrate_enough,
        ),
        Condition("fd", ("kind", "fd"), lambda kind, fd: _only_for(fd, kind, BUSES)),
        Condition("data_bitrate", ("kind", "fd", "bitrate", "data_bitrate"), _data_phase_fits),
        Condition(
            "dbc", ("kind", "dbc"), lambda kind, dbc: _only_for(dbc is not None, kind, BUSES)
        ),
        Condition("ids", ("kind", "ids", "dbc"), _ids_fit),
        Condition(
            "names",
            ("dbc", "names"),
            lambda dbc, names: (
                "are names in a DBC file, but dbc is missing; add dbc, or remove them"
                if names and dbc is None
                else None
            ),
        ),
        Condition(
            "reset_state",
            ("dbc", "reset_state"),
            lambda dbc, reset_state: (
                "is a state in a DBC file, but dbc is missing; add dbc, or remove it"
                if reset_state is not None and dbc is None
                else None
            ),
        ),
    )

    kind: LinkKind
    channel: Annotated[str, _words("the channel of the link")]
    interface: Annotated[str, _words("the interface of python-can")] | None = None
    bitrate: Annotated[int, Count(1, 12_000_000, "the bit rate or baud rate")] | None = None
    fd: StrictBool = False
    data_bitrate: (
        Annotated[
            int,
            Count(10_000, busload.MOST_DATA_BITRATE, "the bit rate of CAN FD's data phase"),
        ]
        | None
    ) = None
    ids: IdentifiersTable | None = None
    dbc: Annotated[str, _words("the DBC file")] | None = None
    names: SignalNames = Field(default_factory=dict)
    reset_state: Annotated[int, Count(8, 2**32 - 1, "the state that resets the drive")] | None = (
        None
    )
    sample_rate_hz: Annotated[
        int, Count(int(LEAST_HZ), int(MOST_HZ), "the drive's sample rate in Hz")
    ] = int(STANDARD_HZ)
    clock: Literal["host", "link", "stepped"] = "host"
    lead_us: (
        Annotated[float, Range("us", 20, 480, "the time by which the feedback leads its tick")]
        | None
    ) = None
    require_realtime: StrictBool = False
    stop_decel_m_per_s2: Annotated[
        float, Range("m/s^2", 1e-3, 1e4, "the deceleration of the drive's own stop")
    ] = 1.0
    virtual: StrictBool = False

    @property
    def rate(self) -> Rate:
        """The drive's sample rate."""
        return Rate(float(self.sample_rate_hz))

    def settle(self) -> None:
        """Write out the baud rate of a serial line, and the lead."""
        if self.lead_us is None:
            self.__dict__.update(lead_us=default_lead_us(self.sample_rate_hz))
        if self.kind == "serial" and self.bitrate is None:
            self.__dict__.update(bitrate=DEFAULT_BAUD)


OFFSET_ON_WIRE_MAX_M = 1e3
"""Largest command offset that the core accepts."""


def _offset_on_wire(scale: float, offset_m: float) -> str | None:
    if abs(offset_m) <= OFFSET_ON_WIRE_MAX_M * scale:
        return None
    return (
        f"found {offset_m:g} m; divided by scale = {scale:g} this is {abs(offset_m) / scale:g} in "
        f"the units of the frame, and at most {OFFSET_ON_WIRE_MAX_M:g} is allowed; check the unit "
        "of scale"
    )


class DisplacementChannel(Table):
    """x = polarity scale wire + offset, in m of the specimen."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("offset_m", ("scale", "offset_m"), _offset_on_wire),
    )

    scale: Annotated[float, Range("", 1e-4, 1e4, "the scale")] = 1.0
    polarity: Annotated[int, Sign("the polarity")] = 1
    offset_m: Annotated[float, Range("m", -10, 10, "the offset")] = 0.0

    @property
    def gain(self) -> float:
        """Scale with its sign."""
        return self.polarity * self.scale


class ForceChannel(Table):
    """f = polarity scale wire + offset, in N of the specimen."""

    scale: Annotated[float, Range("", 1e-4, 1e4, "the scale")] = 1.0
    polarity: Annotated[int, Sign("the polarity")] = 1
    offset_n: Annotated[float, Range("N", -1e7, 1e7, "the offset")] = 0.0

    @property
    def gain(self) -> float:
        """Scale with its sign."""
        return self.polarity * self.scale


class Similitude(Table):
    """Structure over specimen: x of the structure = length times x of the specimen."""

    length: Annotated[float, Range("", 0.01, 100, "the length factor")] = 1.0
    force: Annotated[float, Range("", 1e-5, 1e5, "the force factor")] = 1.0


class Calibration(Table):
    """Conversion between numbers on the wire and displacement and force of the structure.

    ``command`` absent: as ``displacement``. Everything else in a rig file is in the structure's
    units.
    """

    displacement: DisplacementChannel = Field(default_factory=DisplacementChannel)
    force: ForceChannel = Field(default_factory=ForceChannel)
    command: DisplacementChannel | None = None
    similitude: Similitude = Field(default_factory=Similitude)


def kinds() -> Iterator[type[Table]]:
    """Return the tables of every kind of actuator and specimen element."""
    for union in (Actuator, SpecimenElement):
        yield from union.__args__


def extras_arrive(sensors: Sensors, link: LinkTable | None) -> str | None:
    """Report an extra channel for which the link has no space, or no signal of that name."""
    if link is None or not sensors.extra:
        return None
    for one in sensors.extra:
        if one.signal is not None and link.dbc is None:
            return (
                f"extra channel {one.name}: found signal = {written(one.signal)}, which names a "
                "signal in a DBC file, but link.dbc is missing; add link.dbc, or remove signal: in "
                "the program's own frames the channels follow in the order of the rig file"
            )
    if link.kind == "socket":
        return None
    extras, rate_hz = len(sensors.extra), link.sample_rate_hz
    if link.kind == "serial":
        return busload.serial_fault(link.bitrate or DEFAULT_BAUD, extras, rate_hz=rate_hz)
    if link.dbc is not None:
        return None
    if link.ids is not None and link.fd:
        if link.bitrate is None:
            return None
        frames = busload.own_frames(fd=True, extras=extras)
        return busload.bus_fault(frames, link.bitrate, link.data_bitrate, rate_hz=rate_hz)
    return (
        f"found {extras} extra channels, but the frames of hw/rthyb.dbc are full: set link.dbc to "
        "a DBC file of the drive with these signals in its feedback frames; or, on a bus of CAN "
        "FD, set fd = true and give link.ids, because the program's own force frame can then be "
        "longer; or remove the channels"
    )


class RigFile(WholeFile):
    """A rig: virtual, or the model of a real one."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("specimen", ("actuator", "specimen"), _valve_moves_a_mass),
        Condition("sensors", ("sensors", "link"), extras_arrive),
    )
    foreign: ClassVar[dict[str, str]] = {
        "sensor": "sensors without an actuator need a rig of several axes ([[axis]] and "
        "[kinematics]); with one axis, record it as [[sensors.extra]] alone"
    }

    schema_: Literal["rthyb-rig/1"] = Field(alias="schema")
    rig: RigInfo
    actuator: Annotated[Actuator, Field(discriminator="kind")]
    specimen: list[Annotated[SpecimenElement, Field(discriminator="element")]] = Field(
        min_length=1, max_length=MAX_ELEMENTS
    )
    sensors: Sensors = Field(default_factory=Sensors)
    identified: Identified | None = None
    link: LinkTable | None = None
    calibration: Calibration = Field(default_factory=Calibration)
    limits: Limits = Field(default_factory=Limits)
    _one_of: Any = PrivateAttr(default=None)

    @classmethod
    def further_faults(
        cls, keys: dict[str, Any]
    ) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
        """Report names in ``rig.assumed`` that are no keys which the file may omit."""
        known = assumable(keys.get("actuator"))
        yield from assumed_faults(keys.get("rig"), known, ("actuator",))

    def settle(self) -> None:
        """Omit the values that are listed as assumed, and list all that are omitted."""
        self.__dict__["actuator"] = with_assumed(self.actuator, self.rig.assumed)
        assumed = list(self.assumed) or None
        if assumed != self.rig.assumed:
            self.__dict__["rig"] = self.rig.model_copy(update={"assumed": assumed})

    @property
    def assumed(self) -> tuple[str, ...]:
        """Keys whose values nobody stated, as ``rig.assumed`` lists them in a file."""
        return assumed_of(self.actuator)

    @property
    def one_of(self) -> OneOfSeveral | None:
        """What this axis of several has in common with the others; None: no sensors."""
        found: OneOfSeveral | None = self._one_of
        return found

    def as_one_of(self, common: OneOfSeveral) -> RigFile:
        """Return the same rig with what it has in common with other axes."""
        found = self.model_copy()
        found._one_of = common
        return found

    @property
    def rate(self) -> Rate:
        """The rate of real time: that of the drive, or without a link the default rate."""
        return STANDARD if self.link is None else self.link.rate
