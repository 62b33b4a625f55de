"""The baseline file of a diagnosis: a laboratory's model for a recording.

Its keys are short and in SI, as in their equations; a string may have another unit.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, StrictBool

from rthyb_rt.config.fields import Condition, Range, Table, Text

BASELINE_SCHEMA = "rthyb-baseline/1"

Stiffness = Annotated[float, Range("N/m", 0, 1e15, "the stiffness")]
Mass = Annotated[float, Range("kg", 0, 1e12, "the mass")]
Tolerance = Annotated[
    float,
    Range("", 1e-9, 1e3, "the relative standard deviation"),
]


class BaselineBoucWen(Table):
    """F = k (alpha x + (1 - alpha) z), z' = v (1 - |z/xy|^n (beta + gamma sgn(v z)))."""

    alpha: Annotated[float, Range("", -1e3, 1e3, "post-yield over elastic stiffness")]
    xy: Annotated[float, Range("m", 1e-12, 1e6, "the yield displacement")]
    n: Annotated[float, Range("", 0.1, 1e3, "the sharpness of yielding")] = 2.0
    beta: Annotated[float, Range("", -1e6, 1e6, "beta of the loop")] = 0.5
    gamma: Annotated[float, Range("", -1e6, 1e6, "gamma of the loop")] = 0.5


class BaselineSpecimen(Table):
    """F = k x + c x' + moving_mass x''."""

    k: Stiffness = 0.0
    c: Annotated[float, Range("N s/m", 0, 1e15, "the damping")] = 0.0
    moving_mass: Mass = 0.0
    k_tol: Tolerance | None = None
    c_tol: Tolerance | None = None
    bouc_wen: BaselineBoucWen | None = None


class Actuator(Table):
    """x = gain exp(-delay s) w^2 / (s^2 + 2 zeta w s + w^2) x_cmd."""

    delay_s: Annotated[float, Range("s", -10, 100, "the delay")] = 0.0
    f_hz: Annotated[float, Range("Hz", 1e-9, 1e9, "the natural frequency")]
    zeta: Annotated[float, Range("", 1e-9, 1e6, "the damping ratio")]
    gain: Annotated[float, Range("", -1e6, 1e6, "the static gain")] = 1.0
    delay_tol_s: (
        Annotated[float, Range("s", 1e-12, 100, "the delay's standard deviation")] | None
    ) = None
    f_tol: Tolerance | None = None
    zeta_tol: Tolerance | None = None
    gain_tol: Tolerance | None = None


class BaselineNumerical(Table):
    """The computed part: m (x'' + ag) + c x' + F = 0."""

    m: Mass = 0.0
    c: Annotated[float, Range("N s/m", -1e15, 1e15, "the damping of the numerical part")] = 0.0


def _plc_stable(w1: float | None, w2: float | None) -> str | None:
    if w1 is None or w2 is None or (abs(w1) > 1.0 and abs(w2) < abs(w1 + 1.0)):
        return None
    return (
        f"found {w1:g} with plc_w2 = {w2:g}; a stable compensator has |w1| > 1 and "
        f"|w2| < |w1 + 1| = {abs(w1 + 1):g}; the paper uses 3 and 2"
    )


class BaselineController(Table):
    """The compensation in a closed loop."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("plc_w1", ("plc_w1", "plc_w2"), _plc_stable),
    )

    plc_w1: Annotated[float, Range("", -1e6, 1e6, "the weighting W1")] | None = None
    plc_w2: Annotated[float, Range("", -1e6, 1e6, "the weighting W2")] | None = None
    rfc: StrictBool | None = None
    adaptive: StrictBool | None = None


class Noise(Table):
    """Standard deviations of the sensors."""

    x_std: Annotated[float, Range("m", 1e-30, 1e6, "the displacement's noise")] | None = None
    f_std: Annotated[float, Range("N", 1e-30, 1e15, "the force's noise")] | None = None
    a_std: Annotated[float, Range("m/s^2", 1e-30, 1e9, "the acceleration's noise")] | None = None


class BaselineFile(Table):
    """The model of a recording. Without ``actuator``, the specimen is driven by ``x_meas``."""

    schema_: Literal["rthyb-baseline/1"] = Field(alias="schema")
    family: Literal["drive", "ground", "forced", "loop"]
    fs_hz: Annotated[float, Range("Hz", 1e-9, 1e9, "the sampling rate of the recording")]
    name: Annotated[str, Text("a name")] = ""
    description: Annotated[str, Text("a description")] = ""
    command_hold: Literal["zoh", "foh"] = "foh"
    command_shift_s: Annotated[
        float, Range("s", -100, 100, "the delay of the measured row behind the command row")
    ] = 0.0
    specimen: BaselineSpecimen
    actuator: Actuator | None = None
    numerical: BaselineNumerical = Field(default_factory=BaselineNumerical)
    controller: BaselineController = Field(default_factory=BaselineController)
    noise: Noise = Field(default_factory=Noise)
