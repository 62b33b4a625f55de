"""The figures that follow from a test file and a rig file together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rthyb_rt.config import lawtables, rigsettings, timescale
from rthyb_rt.config import limits as limits_file
from rthyb_rt.config.numerical import Matrices
from rthyb_rt.config.own_tables import PythonClass
from rthyb_rt.config.placing import placing
from rthyb_rt.config.rate import STANDARD_HZ, Rate
from rthyb_rt.config.rigfile import (
    BoucWen,
    ChabocheElement,
    CoulombElement,
    CoulombUnevenElement,
    FirstOrder,
    InertiaElement,
    IwanElement,
    MenegottoPintoElement,
    PDeltaElement,
    PeakOrientedElement,
    PendulumElement,
    PowerDampingElement,
    PureDelay,
    RcColumnElement,
    RigFile,
    RockingElement,
    ServoHydraulic,
    SpecimenElement,
    StiffnessElement,
    StribeckElement,
    TakedaElement,
)
from rthyb_rt.config.testfile import Numerical, TestFile
from rthyb_rt.errors import InputError, Problem

Rows = Sequence[Sequence[float]]

if TYPE_CHECKING:
    from rthyb_rt.config.axesfile import AxesRig
    from rthyb_rt.config.numerical_structure import Mode, Structure
    from rthyb_rt.config.own_structure import OwnStructure
    from rthyb_rt.config.sparse_structure import SparseStructure
    from rthyb_rt.core.laws import Parameter

DEFAULT_WINDOW_PERIODS = 0.1
"""The paper's conclusion: a tenth of the period."""
MAX_WINDOW_S = 1.0
OIL_SUBSTEPS = 75
"""Substeps needed per period of the table on its oil column: with fewer, the response to friction
and valve depends on their number."""


@dataclass(frozen=True)
class Derived:
    """Resolved figures of a test on a rig; every value is present.

    Attributes:
        fs_hz: sample rate.
        k_e_n_per_m: elastic stiffness of the specimen, k_e.
        stiffness_n_per_m: k_e plus the computed stiffness.
        mass_kg, period_s: with m = k (T / 2 pi)^2 for the whole stiffness; with a time scale,
            these and the damping are in laboratory time.
        damping_n_s_per_m, damping_ratio: with c = 2 zeta sqrt(k m).
        window_samples: T0 of Eqn 3.3, samples at that rate.
        law_settings: every setting of the control law, by its key; samples are of 1/1024 s.
        plc_enabled, estimator_enabled, rfc_enabled: whether each is active; none is for type
            "none".
        tangent: the tangent-stiffness formula.
        rfc_cutoff_hz: cut-off of the low-pass filter on x_c - x_m, 0 for none.
        force_lateness_s: delay of the force behind x_m in the equation of motion.
        rest_noise_displacement_m, rest_noise_force_n: noise at rest, for the excitation gate.
        limits: the limits of test and rig together, with the origin of each.
        notes: information for the user that requires no action.
        structure: the numerical part if the test gives it by matrices; mass, period and damping
            are then those of the first mode of the complete structure, as seen by the interface.
            For a user-defined part they are those stated in the test.
    """

    fs_hz: float
    k_e_n_per_m: float
    stiffness_n_per_m: float
    mass_kg: float
    period_s: float
    damping_n_s_per_m: float
    damping_ratio: float
    window_samples: int
    law_settings: Mapping[str, float]
    plc_enabled: bool
    estimator_enabled: bool
    rfc_enabled: bool
    tangent: str
    rfc_cutoff_hz: float
    force_lateness_s: float
    rest_noise_displacement_m: float
    rest_noise_force_n: float
    limits: limits_file.Resolved
    notes: tuple[str, ...] = ()
    structure: Structure | SparseStructure | OwnStructure | None = None

    @property
    def rate(self) -> Rate:
        """The rate of the test."""
        return Rate(self.fs_hz)

    @property
    def k_e(self) -> float:
        """The paper's name for the specimen's elastic stiffness, N/m."""
        return self.k_e_n_per_m


@placing
def derive(test: TestFile, rig: RigFile, *, deprecations: bool = True) -> Derived:
    """Combine a test with a rig.

    Args:
        test, rig: the two files.
        deprecations: note the deprecated keys of both files; False: the caller does.

    Raises:
        InputError: with everything that is incompatible.
    """
    problems: list[Problem] = []
    notes: list[str] = []
    rate = Rate(test.test.sample_rate_hz)
    k_e = rig.rig.elastic_stiffness_n_per_m
    stiffness = k_e + test.numerical.stiffness_n_per_m
    structure: Structure | SparseStructure | OwnStructure | None = None
    _check_own(test, rig)
    if test.numerical.structure is not None:
        structure, (mass, period, damping, ratio) = _of_many(test, k_e, rate, problems, notes)
    elif isinstance(test.numerical.matrices, Matrices):
        structure, (mass, period, damping, ratio) = _by_matrices(
            test.numerical.matrices, k_e, rate, problems, test.test.time_scale
        )
    else:
        mass, period = _mass_and_period(test.numerical, stiffness, problems)
        damping, ratio = _damping(test.numerical, stiffness, mass)
        # In the laboratory's time, see rthyb_rt.config.timescale.
        slow = test.test.time_scale
        mass, period, damping = slow**2 * mass, slow * period, slow * damping
        if test.numerical.own is None:
            _check_integration(test.numerical, period, ratio, rate, problems, notes)
        else:
            structure = _of_own(test, k_e, (rate.period_s, period), problems, notes)
    check_rate(test, rig, rate, problems)
    _check_one_axis(test, rig, problems)
    settings = law_settings(test, rig, rate, problems)
    noise_m, noise_n = rest_noise(test, rig, notes)
    limits = limits_file.resolve(test.limits, rig.limits, rig.rig.name, noise_m, problems)
    if deprecations:
        notes += [f"test: {note}" for note in test.limits.deprecated()]
        notes += [f'rig "{rig.rig.name}": {note}' for note in rig.limits.deprecated()]
    _note_slowness(test, rig, notes)
    _note_stiffness(rig, notes)
    _note_sensor_ranges(limits.limits, rig, notes)
    _note_friction(test, rig, mass, rate, notes)
    _note_substeps(rig, notes)
    notes += omitted(rig)
    rigsettings.note_defaults(test, rig, notes)
    controller = test.controller
    window = window_samples_of(test, period, rate, problems)
    by_rig_hz, by_rig_s = rigsettings.rfc_of_rig(test, rig)
    cutoff_hz = rfc_cutoff(test, by_rig_hz, rate, problems)
    if problems:
        raise InputError(problems)
    active = controller.compensates
    default_tangent = "mean-of-ratios" if controller.as_printed else "least-squares"
    return Derived(
        fs_hz=rate.hz,
        k_e_n_per_m=k_e,
        stiffness_n_per_m=stiffness,
        mass_kg=mass,
        period_s=period,
        damping_n_s_per_m=damping,
        damping_ratio=ratio,
        window_samples=window,
        law_settings=settings,
        plc_enabled=active and controller.plc_enabled,
        estimator_enabled=active and controller.law.learns and controller.delay_estimator.enabled,
        rfc_enabled=active and controller.rfc.enabled and test.history is None,
        tangent=controller.rfc.tangent or default_tangent,
        rfc_cutoff_hz=cutoff_hz,
        force_lateness_s=_given(controller.rfc.force_lateness_s, by_rig_s),
        rest_noise_displacement_m=noise_m,
        rest_noise_force_n=noise_n,
        limits=limits,
        notes=tuple(notes),
        structure=structure,
    )


def _check_one_axis(test: TestFile, rig: RigFile, problems: list[Problem]) -> None:
    """Find settings that are possible only on a rig with several axes."""
    alone = f'rig "{rig.rig.name}" has one axis; this is for rigs with several axes, [[axis]]'
    if test.controller.type == "matrix":
        problems.append(Problem("controller.type", f'found "matrix"; {alone}'))
    if test.controller.axis:
        problems.append(Problem("controller.axis", f"found laws of axes by name; {alone}"))
    if len(test.interface) > 1 and test.numerical.structure is None:
        problems.append(Problem("interface", f"found {len(test.interface)} directions; {alone}"))


def resolve(test: TestFile, derived: Derived) -> TestFile:
    """Return the test with every setting from the rig or from a default written out.

    It then runs identically with the defaults of another version.
    """
    controller = test.controller
    standard = derived.rate.pace == 1.0
    rfc = controller.rfc.model_copy(
        update={
            "enabled": controller.rfc.enabled and test.history is None,
            "window_periods": None,
            "window_s": None if standard else derived.window_samples / derived.fs_hz,
            "window_samples": derived.window_samples if standard else None,
            "tangent": derived.tangent,
            "cutoff_hz": derived.rfc_cutoff_hz,
            "force_lateness_s": derived.force_lateness_s,
        }
    )
    resolved = controller.with_settings(derived.law_settings).model_copy(update={"rfc": rfc})
    return test.model_copy(update={"controller": resolved, "limits": derived.limits.limits})


def _given(value: float | None, default: float) -> float:
    return default if value is None else value


def _check_own(test: TestFile, rig: RigFile) -> None:
    """Reject user-defined classes that cannot be loaded, before they are used."""
    if test.controller.python is None and not any(isinstance(e, PythonClass) for e in rig.specimen):
        return
    from rthyb_rt.config.own_deriving import check_classes

    check_classes(test, rig)


def _of_own(
    test: TestFile,
    k_e: float,
    periods_s: tuple[float, float],
    problems: list[Problem],
    notes: list[str],
) -> OwnStructure | None:
    # NumPy, which it needs, is slow to load.
    from rthyb_rt.config.own_deriving import structure_of

    return structure_of(test, k_e, periods_s, problems, notes)


def structure_of_test(
    test: TestFile, k_e: float | Rows, period_s: float, turns: Sequence[bool] = ()
) -> SparseStructure:
    """Return the structure of a test with storeys, or with matrices from a file.

    Args:
        test: the test; its file of matrices has been read.
        k_e: elastic stiffness of the rig's specimen, N/m; with several axes its rows, in the order
            of the interfaces.
        period_s: sampling period.
        turns: which interfaces are rotations; empty: none.

    Raises:
        InputError: with everything that is incompatible.
    """
    from rthyb_rt.config import sparse_structure

    numerical = test.numerical
    assert numerical.structure is not None
    keys = sparse_structure.Keys(
        numerical.damping, numerical.nonlinear, numerical.record, test.interface,
        numerical.integrator, numerical.rho_inf, turns,
    )  # fmt: skip
    found = sparse_structure.build(numerical.structure, keys, k_e, period_s)
    return found.slowed(test.test.time_scale)


def _of_many(
    test: TestFile, k_e: float, rate: Rate, problems: list[Problem], notes: list[str]
) -> tuple[SparseStructure | None, tuple[float, float, float, float]]:
    """Return the part, and mass, period, damping and damping ratio of the dominant mode."""
    from rthyb_rt.core import CoreError

    try:
        structure = structure_of_test(test, k_e, rate.period_s)
    except InputError as error:
        problems += error.problems
        return None, (1.0, 1.0, 0.0, 0.0)
    except CoreError as error:
        problems.append(Problem("numerical", str(error)))
        return None, (1.0, 1.0, 0.0, 0.0)
    storeys, first = test.numerical.storeys, structure.first()
    if storeys is not None:
        storey = storeys.specimen[0]
        said = storeys.each("stiffness_n_per_m")[storey - 1]
        if abs(k_e / said - 1) > 0.01:
            notes.append(
                f"storey {storey} is the specimen: its stiffness is the rig's k_e = {k_e:g} N/m, "
                f"not the {said:g} N/m of numerical.storeys"
            )
    if first.frequency_hz > 0.25 * rate.hz:
        problems.append(
            Problem(
                "test.sample_rate_hz",
                f"the mode with the largest effective mass is at {first.frequency_hz:.4g} Hz, "
                f"which is too high for a sample rate of {rate.hz:g} Hz; check the units of the "
                "masses and stiffnesses",
            )
        )
    if (note := structure.friction_note()) is not None:
        notes.append(note)
    return structure, oscillator(first)


def oscillator(mode: Mode) -> tuple[float, float, float, float]:
    """Return mass, period, damping and damping ratio of a mode, as seen by the interface."""
    omega = 2 * math.pi * mode.frequency_hz
    mass = 1.0 / max(mode.at_interface**2, 1e-12)
    return mass, 1.0 / mode.frequency_hz, 2 * mode.damping_ratio * omega * mass, mode.damping_ratio


def _by_matrices(
    given: Matrices, k_e: float, rate: Rate, problems: list[Problem], time_scale: float
) -> tuple[Structure, tuple[float, float, float, float]]:
    """Return the part, and mass, period, damping and damping ratio of the first mode."""
    # NumPy is slow to load, and most tests have no matrices.
    from rthyb_rt.config.numerical_structure import RADIUS_SLACK, structure_of

    structure = structure_of(given, k_e, rate.period_s).slowed(time_scale)
    modes = structure.modes()
    first = modes[0]
    if first.frequency_hz == 0.0:
        shape = ", ".join(f"{v:.3g}" for v in first.shape)
        problems.append(
            Problem(
                "numerical.matrices.k_n_per_m",
                f"nothing restrains the structure against the motion [{shape}], even with the "
                f"specimen's k_e = {k_e:g} N/m added; check for a missing spring, a wrong sign, or "
                "a subtracted specimen (numerical.matrices.specimen) that is stiffer than k_e",
            )
        )
        return structure, (1.0, 1.0, 0.0, 0.0)
    _check_stability(structure, problems, 1.0 + RADIUS_SLACK)
    return structure, oscillator(first)


def _check_stability(structure: Structure, problems: list[Problem], most: float) -> None:
    """Reject a time step with which the complete structure is unstable."""
    modes, rate_hz = structure.modes(), 1.0 / structure.part.period_s
    fed = [mode for mode in modes if mode.damping_ratio < -1e-9]
    radius = structure.spectral_radius()
    if radius <= most and not fed:
        return
    if fed:
        problems.append(
            Problem(
                "numerical.matrices.c_n_s_per_m",
                f"the mode at {fed[0].frequency_hz:.4g} Hz has a damping ratio of "
                f"{fed[0].damping_ratio:.3g}; the damping ratio of every mode must be at least "
                "0: check for a wrong sign, or for damping of the specimen that was taken out "
                "but is not in the matrices",
            )
        )
        return
    highest = modes[-1].frequency_hz
    problems.append(
        Problem(
            "numerical.matrices.integrator",
            f"the step is unstable: with {structure.part.integrator} at {rate_hz:g} Hz the "
            f"largest root of the assembled structure is {radius:.6g} and must be at most 1; its "
            f'highest mode is at {highest:.4g} Hz; use integrator = "cr" or a higher '
            "test.sample_rate_hz",
        )
    )


def _mass_and_period(
    numerical: Numerical, stiffness: float, problems: list[Problem]
) -> tuple[float, float]:
    if numerical.mass_kg is not None:
        mass = numerical.mass_kg
        period = 2 * math.pi * math.sqrt(mass / stiffness)
        if not 0.01 <= period <= 100:
            problems.append(
                Problem(
                    "numerical.mass_kg",
                    f"{mass:g} kg on {stiffness:g} N/m has a period of {period:.3g} s; the period "
                    "must be from 0.01 to 100 s; check the units of mass and k_e",
                )
            )
        return mass, period
    period = _given(numerical.period_s, math.nan)
    return stiffness * (period / (2 * math.pi)) ** 2, period


def _damping(numerical: Numerical, stiffness: float, mass: float) -> tuple[float, float]:
    critical = 2 * math.sqrt(stiffness * mass)
    if numerical.damping_n_s_per_m is not None:
        return numerical.damping_n_s_per_m, numerical.damping_n_s_per_m / critical
    ratio = _given(numerical.damping_ratio, math.nan)
    return ratio * critical, ratio


def _check_integration(
    numerical: Numerical,
    period: float,
    ratio: float,
    rate: Rate,
    problems: list[Problem],
    notes: list[str],
) -> None:
    if numerical.integrator == "central-difference" and period * rate.hz <= math.pi:
        problems.append(
            Problem(
                "test.sample_rate_hz",
                f"found {rate.hz:g} Hz; a period of {period:.3g} s needs more than "
                f"{math.pi / period:.4g} Hz with the integrator central-difference, which is "
                "unstable below pi samples per period; raise test.sample_rate_hz, or use the "
                "integrator cr or kr-alpha",
            )
        )
    if numerical.damping_n_s_per_m is not None and ratio > 2:
        problems.append(
            Problem(
                "numerical.damping_n_s_per_m",
                f"{numerical.damping_n_s_per_m:g} N s/m is {ratio:.3g} of critical; must be at "
                "most 2; check the units of damping, mass and k_e",
            )
        )
    if numerical.integrator == "forward-euler":
        lost = math.pi / (period * rate.hz)
        notes.append(
            f"forward Euler reduces the damping ratio by {100 * lost:.2f} percentage points: "
            f"{100 * ratio:.2f} % acts as {100 * (ratio - lost):.2f} %"
            + (", so that the motion grows without excitation" if ratio < lost else "")
        )


def check_rate(test: TestFile, rig: RigFile, rate: Rate, problems: list[Problem]) -> None:
    """Find what is impossible at a rate: a pure delay of a fraction of a sample, a high cut-off."""
    actuator = rig.actuator
    key, delay = "", 0
    if isinstance(actuator, PureDelay):
        key, delay = "delay_samples", actuator.delay_samples
    elif isinstance(actuator, FirstOrder):
        key, delay = "extra_delay_samples", actuator.extra_delay_samples
    if delay and rate.samples(delay) != round(rate.samples(delay)):
        step = STANDARD_HZ / math.gcd(delay, int(STANDARD_HZ))
        whole = [f"{hz:g}" for hz in (256, 512, 1024, 2048, 4096) if hz % step == 0]
        problems.append(
            Problem(
                "test.sample_rate_hz",
                f'found {rate.hz:g} Hz; the {actuator.kind} actuator of rig "{rig.rig.name}" has '
                f"{key} = {delay} samples of 1/1024 s, which is {rate.samples(delay):.4g} "
                f"samples at that rate; it must be a whole number; use a multiple of {step:g} Hz "
                f"({', '.join(whole)}), or an actuator of kind second-order with delay_s",
            )
        )


def law_settings(
    test: TestFile, rig: RigFile, rate: Rate, problems: list[Problem]
) -> dict[str, float]:
    """Return every setting of the control law: of the file, else of the rig, else the default."""
    controller, settings = test.controller, dict[str, float]()
    from_rig = rigsettings.law_settings_of_rig(test, rig, rate, problems)
    for parameter in controller.law.parameters:
        value = from_rig.get(parameter.key)
        if value is None:
            value = controller.setting(parameter.key)
        if value is None and controller.plc_enabled:
            problems.append(Problem(f"controller.{parameter.key}", _absent(parameter, rig)))
        # It compensates nothing.
        settings[parameter.key] = max(parameter.low, 0.0) if value is None else value
    if any(math.isnan(value) for value in settings.values()):
        return settings  # reported already
    found = controller.law.complaint(list(settings.values()), rate.period_s)
    if found is not None:
        key, text = found
        where = next(p.rig_key for p in controller.law.parameters if p.key == key)
        if key in from_rig:
            text = (
                f'rig "{rig.rig.name}" gives {where} = {settings[key]:g}: {text}; change the '
                "value that bounds it, or identify the rig again"
            )
        problems.append(Problem(f"controller.{key}", text))
    return settings


def _absent(parameter: Parameter, rig: RigFile) -> str:
    """Return the message for a setting that neither the files nor the law's table give."""
    key = f"controller.{parameter.key}"
    if parameter.rig_key is None:
        allowed = lawtables.range_of(parameter).allowed()
        return f"missing, and it has no default; give {key} in the test file: {allowed}"
    unit = f" in {parameter.unit}" if parameter.unit else ""
    return (
        f'missing, and rig "{rig.rig.name}" has no {parameter.rig_key} to use instead; '
        f"give {key}{unit}, or run `rthyb identify RIG`"
    )


def window_samples_of(test: TestFile, period: float, rate: Rate, problems: list[Problem]) -> int:
    rfc = test.controller.rfc
    if rfc.window_samples is not None:
        return max(1, round(rate.samples(rfc.window_samples)))
    if rfc.window_s is not None:
        key, window_s = "window_s", rfc.window_s
    else:
        key = "window_periods"
        window_s = _given(rfc.window_periods, DEFAULT_WINDOW_PERIODS) * period
    samples = math.floor(window_s * rate.hz + 0.5)
    most = math.floor(MAX_WINDOW_S * rate.hz + 0.5)
    if test.test.time_scale > 1.0:
        # A tenth of a long period may be minutes, and the noise averages out long before.
        samples = min(samples, most)
    if not 1 <= samples <= most:
        problems.append(
            Problem(
                f"controller.rfc.{key}",
                f"a window of {window_s:.4g} s is T0 = {samples} samples; must be from 1 to "
                f"{most}, which at a period of {period:.4g} s is {1 / rate.hz / period:.2g} to "
                f"{most / rate.hz / period:.2g} periods",
            )
        )
    return samples


def rfc_cutoff(test: TestFile, by_rig_hz: float, rate: Rate, problems: list[Problem]) -> float:
    """Return the cut-off of the low-pass on x_c - x_m, Hz; 0: none."""
    cutoff_hz = _given(test.controller.rfc.cutoff_hz, by_rig_hz)
    if not cutoff_hz < 0.5 * rate.hz:
        problems.append(
            Problem(
                "controller.rfc.cutoff_hz",
                f"found {cutoff_hz:g} Hz; must be below half of test.sample_rate_hz = {rate.hz:g} "
                "Hz, or 0 for no low-pass; lower it, or raise the rate (256 to 4096 Hz)",
            )
        )
    return cutoff_hz


def rest_noise(test: TestFile, rig: RigFile, notes: list[str]) -> tuple[float, float]:
    """Return the measured noise, or else that stated for the sensors."""
    identified, sensors = rig.identified, rig.sensors
    noise_m = identified.rest_noise_displacement_m if identified else None
    noise_n = identified.rest_noise_force_n if identified else None
    noise_m = _given(noise_m, sensors.displacement.noise_std_m)
    noise_n = _given(noise_n, sensors.force.noise_std_n)
    # A quiet sensor may stay on one step at rest; its rounding acts as noise once it moves.
    noise_m = max(noise_m, sensors.displacement.lsb_m / math.sqrt(12))
    noise_n = max(noise_n, sensors.force.lsb_n / math.sqrt(12))
    if noise_m == 0 and test.controller.law.uses_rest_noise:
        notes.append(
            f'rig "{rig.rig.name}" gives no displacement noise at rest: 0 is used, and the '
            "excitation gate stays open; `rthyb identify RIG` measures it"
        )
    return noise_m, noise_n


_YIELDING = (IwanElement, MenegottoPintoElement, ChabocheElement, RcColumnElement, TakedaElement)


def _note_stiffness(rig: RigFile, notes: list[str]) -> None:
    """Compare k_e with the total initial stiffness of the specimen's elements."""
    total = 0.0
    for element in rig.specimen:
        if isinstance(element, (StiffnessElement, RockingElement, *_YIELDING)):
            total += element.k_n_per_m
        elif isinstance(element, BoucWen):
            ratio = element.post_yield_ratio
            total += element.k_n_per_m * (ratio + (1 - ratio) * element.a)
        elif isinstance(element, PDeltaElement):
            total -= element.gravity_load_n / element.height_m
        elif isinstance(element, PeakOrientedElement):
            first = (element.start_m / element.reach_m) ** (element.backbone - 1.0)
            total += max(element.k_up_n_per_m, element.k_down_n_per_m) * first
        elif isinstance(element, PendulumElement):
            total += element.weight_n / element.length_m
    k_e = rig.rig.elastic_stiffness_n_per_m
    if total > 0 and abs(k_e / total - 1) > 0.2:
        notes.append(
            f"k_e = {k_e:g} N/m, but the initial stiffness of the specimen's elements is "
            f"{total:g} N/m: check rig.elastic_stiffness_n_per_m"
        )


def _note_slowness(test: TestFile, rig: RigFile, notes: list[str]) -> None:
    """Report what a slow test misses of a specimen whose force depends on velocity."""
    slow = test.test.time_scale
    if slow == 1.0 or test.history is not None:
        return
    names = {item.element for item in rig.specimen if _is_rate_dependent(item)}
    text = (
        f"test.time_scale = {slow:g}: the specimen moves that many times more slowly than the "
        "structure"
    )
    if not names:
        notes.append(f"{text}; its elements do not depend on rate, so nothing is lost")
        return
    notes.append(
        f"{text}, so the forces of its {', '.join(sorted(names))} are not those of the structure: "
        f"a viscous force is measured as 1/{slow:g} of the structure's, an inertia force as "
        f"1/{slow**2:g}; add the missing share to the numerical part, or test faster"
    )


def _is_rate_dependent(item: SpecimenElement) -> bool:
    return timescale.on_rate((key, getattr(item, key)) for key in type(item).model_fields)


def _note_sensor_ranges(limits: limits_file.Limits, rig: RigFile, notes: list[str]) -> None:
    """Report limits beyond the sensor's range, which can never be reached."""
    force_range, x_range = rig.sensors.force.range_n, rig.sensors.displacement.range_m
    force, position = limits.force_n, limits.command_position_m
    if force is not None and force_range is not None and force.value > force_range:
        notes.append(
            f"limits.force_n = {force.value:g} N lies beyond the load cell's range of "
            f"{force_range:g} N and can never be reached"
        )
    if position is not None and x_range is not None and position.value > x_range:
        notes.append(
            f"limits.command_position_m = {position.value:g} m lies beyond the displacement "
            f"sensor's range of {x_range:g} m"
        )


_Steep = tuple[str, float, float, float, float]
"""Key, force at the velocity, that velocity, exponent, width: force (width / velocity)^exponent."""


def _steep(element: SpecimenElement) -> _Steep | None:
    """Return the forces of an element that develop within a width of velocity."""
    match element:
        case CoulombElement(fc_n=force, width_m_per_s=width):
            return "fc_n", force, 1.0, 0.0, width
        case StribeckElement(fs_n=force, width_m_per_s=width):
            return "fs_n", force, 1.0, 0.0, width
        case CoulombUnevenElement(fc_up_n=up, fc_down_n=down, width_m_per_s=width):
            return ("fc_up_n" if up > down else "fc_down_n"), max(up, down), 1.0, 0.0, width
        case PowerDampingElement(exponent=n) if n < 1:
            return "force_n", abs(element.force_n), element.at_m_per_s, n, element.width_m_per_s
    return None


def _note_friction(test: TestFile, rig: RigFile, mass: float, rate: Rate, notes: list[str]) -> None:
    """Report friction that changes sign faster than an explicit step can follow: F_c h > m w."""
    found = [(f"specimen.{i}", *steep) for i, e in enumerate(rig.specimen) if (steep := _steep(e))]
    moving = mass + sum(e.m_kg for e in rig.specimen if isinstance(e, InertiaElement))
    table = rig.actuator
    seen = test.reference.table_forces and rig.rig.load_cell == "actuator-end"
    if isinstance(table, ServoHydraulic) and seen:
        width = table.friction_width_m_per_s
        found.append(("actuator", "friction_n", table.friction_n, 1.0, 0.0, width))
        moving += table.moving_mass_kg
    for place, key, force, at, n, width in found:
        needed = (force / (rate.hz * moving * at**n)) ** (1 / (1 - n))
        if width < needed:
            name = "friction_width_m_per_s" if place == "actuator" else "width_m_per_s"
            how = f" ({key} h / m)" if n == 0 else ""
            notes.append(
                f"rig {place}: {key} = {force:g} N over {name} = {width:g} m/s is too steep for "
                f"the time step of the reference simulation, which chatters on {moving:.4g} kg "
                f"and is not reliable; use a width of at least {needed:.2g} m/s{how}"
            )


def omitted(rig: RigFile | AxesRig) -> list[str]:
    """Return the notes on values of servo-hydraulic actuators that are only defaults, if any."""
    if not isinstance(rig, RigFile):
        return [f"axis {n}: {note}" for n in rig.names for note in omitted(rig.of_axis(n))]
    actuator = rig.actuator
    if not isinstance(actuator, ServoHydraulic) or not actuator.omitted:
        return []
    values = ", ".join(f"{key} = {getattr(actuator, key):g}" for key in actuator.omitted)
    return [
        f'rig "{rig.rig.name}" omits {", ".join(actuator.omitted)} of its actuator, so the values '
        f"of shaking-table-portal-frame are used: {values}; give the values of this rig"
    ]


def _note_substeps(rig: RigFile, notes: list[str]) -> None:
    """Request substeps that resolve the motion of the table between oil column and specimen."""
    actuator = rig.actuator
    if not isinstance(actuator, ServoHydraulic):
        return
    stiffness = actuator.oil_stiffness_n_per_m + rig.rig.elastic_stiffness_n_per_m
    omega = math.sqrt(stiffness / actuator.moving_mass_kg)
    needed = math.ceil(OIL_SUBSTEPS * omega / (2 * math.pi * STANDARD_HZ))
    if actuator.substeps < needed:
        notes.append(
            f"actuator.substeps = {actuator.substeps} is too coarse for a table that resonates "
            f"at {omega / (2 * math.pi):.0f} Hz on its oil column: the response depends on the "
            f"substeps; use {needed} or more"
        )
