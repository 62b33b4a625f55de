"""``rthyb check``: is a test sound, and how far is it from trouble."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption, RigOption, SetOption, load
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.analysis.loop_roots import Verdict
    from rthyb_rt.analysis.margins import Lead, SampledLead
    from rthyb_rt.config import Link, RigFile, TestFile
    from rthyb_rt.lab.braking import RunOn
    from rthyb_rt.lab.experiment import Setup

SCHEMA = "rthyb-check/1"

_CHECKS = {
    "link": "the link",
    "polarity": "polarity",
    "limits": "the limits",
    "watchdog": "the watchdog",
    "trip": "the stop on a trip",
}

_GAIN = "delay_estimator.gain_per_mm2_per_sample"

MUCH_DAMPING = 0.5
"""As a part of critical. No structure has it; who wrote 2 meant per cent."""

RUN_ON_TOLERANCE = 1.005
"""A smooth brake so near a peak that it is past it before it has begun is no run-on."""

NOISE_SPAN = 7
"""Standard deviations that 1024 samples of noise span."""


def check(
    test: Annotated[
        Path, typer.Argument(metavar="TEST.toml", help="Test file.", show_default=False)
    ],
    rig: RigOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check a test without running it.

    Every fault of test file and rig file is named at once. For a test without fault: period and
    mass, the compensator's gains, the delay that the structure survives, roots and margins of the
    whole loop where the rig's response is known, the margin of the delay estimator, the limits of
    test and rig together, the rig's link with the load of its bus and the dates of its
    commissioning, with notes and warnings where one of them is close.

    \b
    Examples:
      rthyb check my-test.toml
      rthyb check my-test.toml --rig my-rig.toml --set numerical.period_s=0.8
    """
    test_file, rig_file = load(test, rig, settings)
    found = examine(test_file, rig_file, rig or test_file.rig)
    _print(found, terminal.people(as_json))
    if as_json:
        terminal.print_json(found.document())


@dataclass(frozen=True)
class Examined:
    """What a test came to that was checked.

    Attributes:
        setup: the test, ready to go.
        figures: that follow from test and rig.
        loop: roots and margins of the loop; None where the rig's response is not known.
        runs_on: how far a HOLD, a STOP or a ramp-out goes on at most.
        limits: those that act, and where they come from.
        link, commissioning: of the rig; None for one without a link.
        factors: of the rig's calibration.
        notes, warnings: what a user should know, and what should be changed.
    """

    setup: Setup
    figures: Figures
    loop: Verdict | None
    runs_on: RunOn
    limits: list[dict[str, Any]]
    link: dict[str, Any] | None
    commissioning: dict[str, Any] | None
    factors: dict[str, float]
    notes: list[str]
    warnings: list[str]

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""
        return {
            "schema": SCHEMA,
            "ok": True,
            "test_name": self.setup.test.test.name,
            "rig_name": self.setup.rig.rig.name,
            "figures": asdict(self.figures),
            "run_on": asdict(self.runs_on),
            "loop": None if self.loop is None else asdict(self.loop),
            "limits": self.limits,
            "link": self.link,
            "commissioning": self.commissioning,
            "calibration": self.factors,
            "notes": self.notes,
            "warnings": self.warnings,
        }

    def tables(self) -> list[list[tuple[str, str, str]]]:
        """Return its tables, those that have a row: what, how much, what it is."""
        setup = self.setup
        tables = (
            [*_rows(setup, self.figures), *_loop_rows(self.loop)],
            _link_rows(self.link),
            _commissioning_rows(self.commissioning),
            _calibration_rows(self.factors),
            _limit_rows(setup, self.limits),
            _run_on_rows(self.runs_on),
        )
        return [list(rows) for rows in tables if rows]


def examine(test_file: TestFile, rig_file: RigFile, rig: str | None = None) -> Examined:
    """Check a test on a rig.

    Args:
        test_file, rig_file: the two.
        rig: path or name of the rig, by which it is known whether it was commissioned.

    Raises:
        InputError: with what is wrong between them.
    """
    from rthyb_rt.analysis import loop_roots
    from rthyb_rt.core import FS_HZ
    from rthyb_rt.lab import braking, experiment

    real_time = rig_file.link is not None and test_file.test.sample_rate_hz == FS_HZ
    setup = experiment.prepare(test_file, rig_file, real_time=real_time)
    figures, runs_on = _figures(setup), braking.run_on(setup)
    loop = loop_roots.judge(setup)
    commissioning = None if rig is None else _commissioning(setup, rig)
    notes, warnings = _remarks(setup, figures)
    warnings += _run_on_warnings(setup, figures, runs_on)
    remark = loop_roots.remark(loop)
    if remark is not None:
        warnings.append(remark)
    if loop is not None and loop.unstable and _is_real(setup):
        warnings.append("a test in real time will be refused: the loop is unstable")
    if commissioning is not None and commissioning["why_not"]:
        warnings.append(f"a test in real time will be refused: {commissioning['why_not']}")
    return Examined(
        setup=setup,
        figures=figures,
        loop=loop,
        runs_on=runs_on,
        limits=_limits(setup),
        link=_link(setup),
        commissioning=commissioning,
        factors=_calibration(setup),
        notes=notes,
        warnings=warnings,
    )


def _print(found: Examined, file: IO[str]) -> None:
    setup = found.setup
    print(f"{setup.test.test.name} on {setup.rig.rig.name}: no fault found\n", file=file)
    for number, rows in enumerate(found.tables()):
        if number:
            print("", file=file)
        terminal.print_table(rows, file)
    remarks = [f"Warning: {text}" for text in found.warnings]
    remarks += [f"Note: {text}" for text in found.notes]
    if remarks:
        print("", *remarks, sep="\n", file=file)


@dataclass(frozen=True)
class Figures:
    """What follows from a test on a rig; None where a figure does not apply.

    Attributes:
        critical_delay_samples: longest pure delay that the structure with an elastic specimen
            survives without compensation; 0 if none.
        alpha0, beta0: what the phase lead begins with; None for a law that has none.
        critical_delay_with_lead_samples: the same with the phase lead as it begins.
        critical_delay_followed_samples: the same with a phase lead whose alpha is the delay.
        identified_delay_samples: the rig's, as `rthyb identify` found it.
        peak_phi: peak of the estimator's input, from the reference simulation or from one with an
            elastic specimen, whichever is larger.
        estimator_loop_gain: g of the controller ``paper``.
        modes: of a structure that is given by matrices, the elastic specimen in it; mass, period
            and damping are then those of the first, as the interface sees it.
    """

    samples: int
    duration_s: float
    pga_g: float
    mass_kg: float
    period_s: float
    damping_n_s_per_m: float
    damping_ratio: float
    k_e_n_per_m: float
    window_samples: int
    alpha0: float | None
    beta0: float | None
    lead_first_sample_gain: float | None
    lead_nyquist_gain: float | None
    critical_delay_samples: float
    critical_delay_with_lead_samples: float | None
    critical_delay_followed_samples: int | None
    identified_delay_samples: float | None
    rig_is_lag: bool
    reference_peak_m: float
    reference_peak_m_per_s: float
    reference_peak_n: float
    peak_phi: float | None
    estimator_loop_gain: float | None
    modes: tuple[dict[str, float], ...] = ()


def _figures(setup: Setup) -> Figures:
    import numpy as np

    from rthyb_rt.analysis import margins

    derived, wanted = setup.derived, setup.test.controller
    lead = margins.lead_of(setup.controller.law, derived.rate.period_s)
    leads, settings, rate = derived.plc_enabled, derived.law_settings, derived.rate
    reference = setup.reference
    survives = _Survival.of(setup, lead if leads else None)
    identified = rate.samples(setup.rig.identified.alpha) if setup.rig.identified else None
    phi = loop_gain = None
    if isinstance(lead, margins.Lead):
        unit_m = settings["delay_estimator.reference_displacement_m"] / rate.pace
        phi = max(
            margins.peak_excitation(x, lead, unit_m)
            for x in (reference["x_ref_m"], survives.elastic_m)
        )
        if wanted.type == "paper" and derived.estimator_enabled:
            delay = lead.alpha if identified is None else identified
            loop_gain = margins.estimator_loop_gain(settings[_GAIN] / rate.pace, delay, phi)
    return Figures(
        samples=setup.ticks,
        duration_s=setup.ticks / derived.fs_hz,
        pga_g=setup.motion.pga_g,
        mass_kg=derived.mass_kg,
        period_s=derived.period_s,
        damping_n_s_per_m=derived.damping_n_s_per_m,
        damping_ratio=derived.damping_ratio,
        k_e_n_per_m=derived.k_e_n_per_m,
        window_samples=derived.window_samples,
        alpha0=lead.alpha if isinstance(lead, margins.Lead) else None,
        beta0=lead.beta if isinstance(lead, margins.Lead) else None,
        lead_first_sample_gain=lead.first_sample_gain if leads else None,
        lead_nyquist_gain=lead.nyquist_gain if leads else None,
        critical_delay_samples=survives.alone,
        critical_delay_with_lead_samples=survives.with_lead,
        critical_delay_followed_samples=survives.followed,
        identified_delay_samples=identified,
        rig_is_lag=margins.is_lag(setup.rig),
        reference_peak_m=float(np.abs(reference["x_ref_m"]).max()),
        reference_peak_m_per_s=float(np.abs(reference["v_ref_mps"]).max()),
        reference_peak_n=float(np.abs(reference["f_ref_n"]).max()),
        peak_phi=phi,
        estimator_loop_gain=loop_gain,
        modes=tuple(
            {
                "frequency_hz": mode.frequency_hz,
                "damping_ratio": mode.damping_ratio,
                "effective_mass": mode.effective_mass,
            }
            for mode in (derived.structure.modes() if derived.structure is not None else ())
        ),
    )


@dataclass(frozen=True)
class _Survival:
    """Delays that a test's structure survives, and how it moves with an elastic specimen."""

    alone: float
    with_lead: float | None
    followed: int | None
    elastic_m: Any

    @classmethod
    def of(cls, setup: Setup, lead: Lead | SampledLead | None) -> _Survival:
        """Return them; ``lead`` is None where nothing leads the command."""
        from rthyb_rt.analysis import margins, numerical_margins

        matrices, step = setup.derived.structure, max(1, round(setup.derived.rate.pace))
        structure: margins.DelayedStructure = (
            margins.OneDegree(setup.controller.motion)
            if matrices is None
            else numerical_margins.ManyDegrees(matrices)
        )
        with_lead = None if lead is None else margins.critical_delay(structure, lead)
        followed = None
        if isinstance(lead, margins.Lead):
            followed = margins.largest_followed_delay(structure, lead, _most(setup), step)
        elastic_m = structure.elastic_displacement_m(setup.ag_mps2)
        return cls(margins.critical_delay(structure), with_lead, followed, elastic_m)


# ---- remarks ------------------------------------------------------------------------------------


def _remarks(setup: Setup, f: Figures) -> tuple[list[str], list[str]]:
    """Return notes and warnings."""

    from rthyb_rt.config import STANDARD

    notes, warnings = list(setup.notes), list[str]()
    if "warning" in setup.motion.details:
        notes.append(f"ground motion: {setup.motion.details['warning']}")
    for found in (_divergence(setup, f), _oscillation(setup, f)):
        if found is not None:
            is_warning, text = found
            (warnings if is_warning else notes).append(text)
    if f.damping_ratio > MUCH_DAMPING:
        warnings.append(
            f"the damping is {f.damping_ratio:.3g} of critical; a structure has 0.01 to 0.1: 2 % "
            'is numerical.damping_ratio = 0.02, or "2 %"'
        )
    warnings += _limits_in_reach(setup, f)
    limits = setup.test.limits
    if not any(limit and limit.ends for limit in (limits.command_position_m, limits.force_n)):
        warnings.append(
            "nothing ends a test that grows: neither limits.command_position_m nor limits.force_n "
            "is set with an action that ends it"
        )
    if setup.rig.link is not None:
        if setup.rate != STANDARD:
            notes.append(
                f"test.sample_rate_hz = {setup.rate.hz:g} Hz is for virtual time: a test in real "
                f"time goes at {STANDARD.hz:g} Hz, and will be refused"
            )
        more_notes, more_warnings = _real_time_remarks(setup, f)
        notes, warnings = notes + more_notes, warnings + more_warnings
    return notes, warnings


def _real_time_remarks(setup: Setup, f: Figures) -> tuple[list[str], list[str]]:
    """Return notes and warnings on what only a test in real time watches."""
    limits, noise = setup.test.limits, setup.derived.rest_noise_displacement_m
    notes, warnings = list[str](), list[str]()
    if setup.rig.link is not None and not _dbc_is_read(setup.rig.link):
        warnings.append(
            "link.dbc was not read, and its frames not checked: a test in real time will be "
            "refused; reading a DBC file needs cantools: pip install 'rthyb-rt[wire]'"
        )
    jump, spread = limits.sensor_jump_m, limits.rest_spread_m
    derived = setup.derived.limits.derived
    watched = [
        getattr(limits, key) or derived.get(key)
        for key in ("sensor_stuck_samples", "sensor_jump_m")
    ]
    if not any(limit is not None and limit.ends for limit in watched):
        notes.append(
            "nothing ends a test whose displacement sensor sticks or jumps: set "
            "limits.sensor_stuck_samples and limits.sensor_jump_m"
        )
    # Two samples that are each off by four standard deviations.
    step = f.reference_peak_m_per_s / setup.derived.fs_hz + 8 * noise
    if jump is not None and jump.acts and setup.rate.leap(jump.value) < step:
        warnings.append(
            f"limits.sensor_jump_m = {setup.rate.leap(jump.value):g} m is below the {step:.2g} m "
            "that displacement and noise change by from sample to sample: good readings will be "
            "refused"
        )
    if spread is not None and spread < NOISE_SPAN * noise:
        warnings.append(
            f"limits.rest_spread_m = {spread:g} m is below the span of the noise at rest, "
            f"{NOISE_SPAN * noise:.2g} m: zeroing will be refused"
        )
    return notes, warnings


def _divergence(setup: Setup, f: Figures) -> tuple[bool, str] | None:
    """Compare the rig's delay with what the structure survives."""
    leads = f.critical_delay_with_lead_samples is not None
    critical = f.critical_delay_with_lead_samples if leads else f.critical_delay_samples
    delay = f.identified_delay_samples
    # The estimator moves a lead that starts too short; force compensation removes the error.
    helped = setup.derived.rfc_enabled or (leads and setup.derived.estimator_enabled)
    if delay is None or critical is None or delay < critical:
        return None
    how, at = _lead_in_words(f) if leads else ("without phase lead", "at any delay")
    found = (
        f"{how} the structure on an elastic specimen survives a delay of {critical:.2g} samples, "
        f"and the rig has {delay:g}"
        if critical
        else f"{how} the structure on an elastic specimen is unstable"
        f" {at}, and the rig has {delay:g} samples"
    )
    if helped:
        return False, f"{found}: the test rests on delay estimate and force compensation"
    return True, f"{found}: the motion will grow; compensate the delay, or set a limit that trips"


def _lead_in_words(f: Figures) -> tuple[str, str]:
    """Return how the command is led, and the delay that this is made for."""
    if f.alpha0 is not None:
        return "with the phase lead at alpha0", "even at a delay of alpha0"
    return "with the control law at its first settings", "even at the delay that these are made for"


def _oscillation(setup: Setup, f: Figures) -> tuple[bool, str] | None:
    """Judge the loop of the paper's delay estimator."""
    from rthyb_rt.analysis.margins import LITTLE_MARGIN, OSCILLATES

    g = f.estimator_loop_gain
    if g is None or g <= LITTLE_MARGIN:
        return None
    gain = setup.derived.law_settings[_GAIN]
    remedy = (
        f"lower controller.delay_estimator.gain_per_mm2_per_sample from {gain:g} to "
        f"{LITTLE_MARGIN / g * gain:.2g} or less"
    )
    if g > OSCILLATES and not f.rig_is_lag:
        return True, (
            f"the delay estimate will oscillate on a pure delay: its loop gain is {g:.2f}, allowed "
            f"is {OSCILLATES:.2f}; {remedy}"
        )
    lag = ", though a lag such as this rig's forgives more than a delay" if f.rig_is_lag else ""
    return False, (
        f"little margin for the delay estimate: its loop gain is {g:.2f}, advised is up to "
        f"{LITTLE_MARGIN:g}{lag}; {remedy}"
    )


def _limits_in_reach(setup: Setup, f: Figures) -> list[str]:
    """Name the limits that already the reference simulation exceeds."""
    from rthyb_rt.config import STANDARD_HZ

    limits = setup.test.limits
    pairs = [
        ("command_position_m", limits.command_position_m, f.reference_peak_m, "m"),
        ("force_n", limits.force_n, f.reference_peak_n, "N"),
    ]
    found = [
        f"limits.{key} = {limit.value:g} {unit} is below the {peak:.3g} {unit} of the reference "
        "simulation: the test will meet it"
        for key, limit, peak, unit in pairs
        if limit is not None and limit.acts and peak > limit.value
    ]
    velocity, increment = limits.command_velocity_m_per_s, limits.command_increment_m
    peak_m_per_s = f.reference_peak_m_per_s
    if velocity is not None and velocity.enable and peak_m_per_s > velocity.value:
        found.append(
            f"limits.command_velocity_m_per_s = {velocity.value:g} m/s is below the "
            f"{peak_m_per_s:.3g} m/s of the reference simulation: the command will be held back"
        )
    peak_m = peak_m_per_s / STANDARD_HZ
    if increment is not None and increment.acts and peak_m > increment.value:
        found.append(
            f"limits.command_increment_m = {increment.value:g} m is below the {peak_m:.3g} m a "
            "sample of the reference simulation: the test will meet it"
        )
    return found


def _run_on_warnings(setup: Setup, f: Figures, found: RunOn) -> list[str]:
    """Name what a HOLD, a STOP or a ramp-out runs on to that the test itself does not reach."""
    from rthyb_rt.numbers import quantity

    limits = setup.test.limits
    warnings = []
    for key, limit, value, own, unit, factor in (
        ("command_position_m", limits.command_position_m, found.displacement_m,
         f.reference_peak_m, "mm", 1e3),
        ("force_n", limits.force_n, found.force_n, f.reference_peak_n, "kN", 1e-3),
    ):  # fmt: skip
        beyond = limit is not None and limit.acts and value > limit.value >= own
        if not beyond and value <= RUN_ON_TOLERANCE * own:
            continue
        than = f"limits.{key}" if beyond else "the test's own peak"
        allowed = limit.value if limit is not None and beyond else own
        warnings.append(
            f"a HOLD, a STOP or a ramp-out runs on to {quantity(value, unit, factor)}, beyond "
            f"{than} of {quantity(allowed, unit, factor)}: it brakes with "
            f"{found.brake_m_per_s2:.3g} m/s^2; raise limits.brake_acceleration_m_per_s2, or leave "
            "it out, and see that limits.command_acceleration_m_per_s2 allows it"
        )
    return warnings


# ---- for people ---------------------------------------------------------------------------------


def _structure_rows(f: Figures) -> list[tuple[str, str, str]]:
    from rthyb_rt.numbers import number, percent, quantity

    if f.modes:
        return [
            (
                f"Mode {i + 1} of {len(f.modes)}",
                f"{number(mode['frequency_hz'], 4)} Hz ({number(1 / mode['frequency_hz'])} s), "
                f"damping {percent(mode['damping_ratio'], 3)}, "
                f"{percent(mode['effective_mass'], 3)} of the mass",
                "" if i else "of the whole structure, specimen elastic",
            )
            for i, mode in enumerate(f.modes)
        ]
    return [
        (
            "Period",
            f"{number(f.period_s)} s ({number(1 / f.period_s)} Hz)",
            "of the whole structure",
        ),
        ("Mass", quantity(f.mass_kg, "kg", digits=4), "computed"),
        (
            "Damping",
            f"{quantity(f.damping_n_s_per_m, 'N s/m', digits=4)} ({percent(f.damping_ratio, 3)})",
            "computed; part of critical",
        ),
    ]


def _integrator(setup: Setup) -> str:
    from rthyb_rt.config.numerical import Matrices

    numerical = setup.test.numerical
    matrices = numerical.matrices
    if not isinstance(matrices, Matrices):
        return numerical.integrator
    return matrices.integrator


def _rows(setup: Setup, f: Figures) -> list[tuple[str, str, str]]:
    from rthyb_rt.numbers import number, quantity

    fs_hz = setup.derived.fs_hz

    def samples(value: float | None) -> str:
        if value is None:
            return "none"
        if math.isinf(value):
            return "any"
        count = f"{value:g}" if value == round(value) else number(value)
        return f"{count} samples ({number(value / fs_hz * 1e3)} ms)"

    rows = [
        ("Ground motion", f"{setup.motion.name}, PGA {number(f.pga_g)} g", ""),
        ("Length of the test", f"{f.duration_s:.2f} s ({f.samples} samples)", _rate_words(fs_hz)),
        *_structure_rows(f),
        ("Elastic stiffness", quantity(f.k_e_n_per_m, "kN/m", 1e-3, 4), "k_e of the specimen"),
        ("Integrator", _integrator(setup), ""),
        ("Controller", _controller(setup), ""),
    ]
    if setup.derived.rfc_enabled:
        rows.append(("Window T0", samples(f.window_samples), "of the tangent stiffness, Eqn 3.3"))
    if f.lead_first_sample_gain is not None:
        if f.alpha0 is not None:
            rows += [
                ("alpha0", samples(f.alpha0), "delay that the phase lead begins with"),
                ("beta0", f"{number(f.beta0)} samples²", "its curvature term"),
            ]
        rows += [
            ("Lead, first sample", number(f.lead_first_sample_gain, 4), "gain on a step, C(∞)"),
            ("Lead, Nyquist", number(f.lead_nyquist_gain, 4), f"gain at {fs_hz / 2:g} Hz, |C(−1)|"),
        ]
    rows.append(
        ("Critical delay, none", samples(f.critical_delay_samples), "elastic specimen, no lead")
    )
    if f.critical_delay_with_lead_samples is not None:
        begins = "alpha0" if f.alpha0 is not None else "its first settings"
        rows.append(
            (
                "Critical delay, alpha0" if f.alpha0 is not None else "Critical delay, lead",
                samples(f.critical_delay_with_lead_samples),
                f"elastic specimen, lead at {begins}",
            )
        )
        if f.alpha0 is not None:
            rows.append(
                (
                    "Critical delay, followed",
                    _followed(setup, f, samples),
                    "elastic specimen, alpha = delay",
                )
            )
    if f.identified_delay_samples is not None:
        kind = "answers as a lag" if f.rig_is_lag else "answers as a delay"
        rows.append(("Delay of the rig", samples(f.identified_delay_samples), kind))
    rows += [
        ("Peak displacement", quantity(f.reference_peak_m, "mm", 1e3), "reference simulation"),
        ("Peak velocity", quantity(f.reference_peak_m_per_s, "mm/s", 1e3), "reference simulation"),
        ("Peak force", quantity(f.reference_peak_n, "kN", 1e-3), "reference simulation"),
    ]
    if f.estimator_loop_gain is not None:
        rows.append(
            (
                "Estimator loop gain g",
                number(f.estimator_loop_gain, 2),
                f"γ α φ² / (1 + φ²), peak φ = {number(f.peak_phi)}; advised up to 0.5",
            )
        )
    return rows


def _is_real(setup: Setup) -> bool:
    """Return whether something real is at the other end of the rig's link."""
    return setup.rig.link is not None and not setup.rig.link.virtual


def _loop_rows(loop: Verdict | None) -> list[tuple[str, str, str]]:
    """Return the lines of the whole loop: root, gain margin, delay margin."""
    from rthyb_rt.analysis.loop_roots import MOST_GAIN
    from rthyb_rt.config import STANDARD_HZ
    from rthyb_rt.numbers import number, quantity

    if loop is None:
        return [("Largest root", "not judged", "the rig file has no identified response")]
    what = f"whole loop, elastic specimen; rig known up to {loop.swept_hz:g} Hz"
    root = f"{loop.radius:.5f} at {number(loop.frequency_hz)} Hz"
    if loop.unstable:
        return [("Largest root", f"{root}: UNSTABLE", what)]
    more = f"{MOST_GAIN:g} or more" if loop.gain_margin >= MOST_GAIN else number(loop.gain_margin)
    late = "any"
    if math.isfinite(loop.delay_margin_samples):
        late = quantity(loop.delay_margin_samples / STANDARD_HZ, "ms", 1e3)
    return [
        ("Largest root", root, what),
        ("Gain margin", more, "what the rig's answer may be multiplied by"),
        ("Delay margin", late, "what the rig may be later"),
    ]


# ---- limits, link, calibration ------------------------------------------------------------------


def _limits(setup: Setup) -> list[dict[str, Any]]:
    """Return every limit of test and rig together: key, value, unit, action, where it is from."""
    from rthyb_rt.config import Limit
    from rthyb_rt.config.limits import unit_of

    found = []
    for key, source in setup.derived.limits.sources.items():
        limit = getattr(setup.test.limits, key)
        watched = isinstance(limit, Limit)
        found.append(
            {
                "key": key,
                "value": limit.value if watched else limit,
                "unit": unit_of(key),
                "action": (limit.action if limit.enable else "none") if watched else None,
                "enable": limit.enable if watched else True,
                "from": source,
            }
        )
    return found + _derived(setup)


def _derived(setup: Setup) -> list[dict[str, Any]]:
    """Return the limits that no file states and a test at a link has all the same."""
    from rthyb_rt.config.limits import unit_of

    return [
        {
            "key": key,
            "value": limit.value,
            "unit": unit_of(key),
            "action": limit.action,
            "enable": True,
            "from": "derived",
        }
        for key, limit in setup.derived.limits.derived.items()
    ]


def _limit_rows(setup: Setup, limits: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Return the limits that were given; for a rig with a link also what the others come to."""
    words = {
        "test": "limit of the test",
        "rig": "limit of the rig",
        "default": "limit by default",
        "derived": "limit that follows from the test",
    }
    rows = []
    for limit in limits:
        if limit["from"] in ("default", "derived") and setup.rig.link is None:
            continue
        action = limit["action"] if limit["enable"] else "off"
        if action == "none" and limit["key"] == "command_velocity_m_per_s":
            action = "limits the command"
        value = f"{limit['value']:g} {limit['unit']}"
        rows.append((limit["key"], f"{value}, {action}" if action else value, words[limit["from"]]))
    return rows


def _run_on_rows(found: RunOn) -> list[tuple[str, str, str]]:
    """Return the lines of how far the test runs on when it is braked."""
    from rthyb_rt.numbers import quantity

    return [
        (
            "Run-on, displacement",
            quantity(found.displacement_m, "mm", 1e3),
            f"HOLD, STOP or ramp-out at the worst instant, {found.displacement_at_s:.2f} s",
        ),
        (
            "Run-on, force",
            quantity(found.force_n, "kN", 1e-3),
            f"the same at {found.force_at_s:.2f} s, braking with {found.brake_m_per_s2:.3g} m/s²",
        ),
    ]


def _link(setup: Setup) -> dict[str, Any] | None:
    """Return the rig's link, with the share of bus or line that its frames take."""
    link = setup.rig.link
    if link is None:
        return None
    return {**link.model_dump(), "bus_load": _bus_load(link)}


def _bus_load(link: Link) -> float | None:
    """Return the share of the bus or line, None where bit rate or frames are not known."""
    from rthyb_rt import config
    from rthyb_rt.config import busload

    if link.bitrate is None:
        return None
    if link.kind == "serial":
        return busload.serial_load(link.bitrate)
    if not _dbc_is_read(link):
        return None
    return busload.bus_load(config.frames_of_link(link), link.bitrate, link.data_bitrate)


def _dbc_is_read(link: Link) -> bool:
    """Return whether a DBC file, if the link has one, could be read for its faults."""
    from importlib import util

    return link.dbc is None or util.find_spec("cantools") is not None


def _link_rows(link: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    from rthyb_rt.numbers import percent

    if link is None:
        return []
    unit = "baud" if link["kind"] == "serial" else "bit/s"
    kind = "CAN FD" if link["fd"] else {"can": "CAN"}.get(link["kind"], link["kind"])
    parts = [link["channel"], kind]
    parts += [f"interface {link['interface']}"] if link["interface"] else []
    parts += [f"{link['bitrate']} {unit}"] if link["bitrate"] else []
    rows = [("Link", ", ".join(parts), "for a test in real time")]
    if link["bus_load"] is not None:
        what = "command and feedback" if link["kind"] == "serial" else "with every stuff bit"
        rows.append(("Bus load", percent(link["bus_load"], 3), f"{what}; up to 80 % is accepted"))
    elif link["kind"] != "socket":
        rows.append(("Bus load", "not known", "bitrate, or cantools for the DBC file, is missing"))
    clocks = {
        "host": ("host", "this PC's clock leads; the drive's may slip a sample now and then"),
        "link": (
            f"link, feedback {link['lead_us']:g} us before the tick",
            "the drive's clock leads",
        ),
        "stepped": ("stepped", "not real time"),
    }
    rows.append(("Clock", *clocks[link["clock"]]))
    return rows


def _commissioning(setup: Setup, name: str | None) -> dict[str, Any] | None:
    """Return what has been checked on the rig, as its file stands; None without a link."""
    from rthyb_rt import config
    from rthyb_rt.rig.commissioning import certificate

    if setup.rig.link is None:
        return None
    path = config.find_rig(name)
    try:
        return certificate.standing(setup.rig, path).as_json()
    except InputError as error:
        return {
            "demanded": not setup.rig.link.virtual,
            "commissioned": False,
            "certificate": str(certificate.place(path)),
            "why_not": str(error),
            "steps": dict.fromkeys(certificate.STEPS),
        }


def _commissioning_rows(found: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    if found is None:
        return []
    words = {True: "passed", False: "FAILED", None: "could not be checked"}
    stands = "yes" if found["commissioned"] else "no"
    why = f"for this rig file: {found['certificate']}" if found["commissioned"] else "see below"
    if not found["demanded"]:
        why = "link.virtual: a virtual rig needs none"
    rows = [("Commissioned", stands, why)]
    for name, step in found["steps"].items():
        if step is not None:
            rows.append((f"Check of {_CHECKS[name]}", words[step["passed"]], step["date"]))
        elif any(found["steps"].values()):
            rows.append((f"Check of {_CHECKS[name]}", "not made", ""))
    return rows


def _calibration(setup: Setup) -> dict[str, float]:
    from rthyb_rt.lab import experiment

    return asdict(experiment.calibration(setup.rig))


def _calibration_rows(c: dict[str, float]) -> list[tuple[str, str, str]]:
    """Return the lines of what leads from the wire to the structure, if anything changes there."""
    from rthyb_rt import core

    if c == asdict(core.Calibration()):
        return []

    def line(gain: float, quantity: str, offset: float, unit: str) -> str:
        sign = "+" if offset >= 0 else "−"
        shift = f" {sign} {abs(offset):g} {unit}" if offset else ""
        return f"{gain:g} × {quantity}{shift}"

    return [
        ("Displacement", line(c["x_gain"], "wire", c["x_offset_m"], "m"), "of the structure"),
        ("Force", line(c["f_gain"], "wire", c["f_offset_n"], "N"), "of the structure"),
        ("Command on the wire", line(c["cmd_gain"], "x", c["cmd_offset_m"], "m"), ""),
    ]


def _rate_words(fs_hz: float) -> str:
    from rthyb_rt.config import STANDARD_HZ

    return "" if fs_hz == STANDARD_HZ else f"at {fs_hz:g} Hz, in virtual time"


def _followed(setup: Setup, f: Figures, samples: Any) -> str:
    delay = f.critical_delay_followed_samples
    most = _most(setup)
    return f"above alpha_max = {most}" if delay == most else str(samples(delay))


def _most(setup: Setup) -> int:
    """Return the largest delay that the law of this test may find, samples."""
    most = setup.derived.law_settings["delay_estimator.alpha_max"]
    return math.floor(setup.derived.rate.samples(most))


def _controller(setup: Setup) -> str:
    derived = setup.derived
    parts = {
        "phase lead": derived.plc_enabled,
        "delay estimator": derived.estimator_enabled,
        "force compensation": derived.rfc_enabled,
    }
    active = [name for name, on in parts.items() if on]
    name = setup.test.controller.type
    return f"{name}: {', '.join(active)}" if active else name
