"""Notes and warnings on a test without errors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from rthyb_rt.analysis.margins import LITTLE_MARGIN, OSCILLATES
from rthyb_rt.checking import facts
from rthyb_rt.checking.check_figures import GAIN, Figures
from rthyb_rt.checking.checked_history import HistoryFigures
from rthyb_rt.config import STANDARD_HZ, Limit
from rthyb_rt.lab.braking import RunOn
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.numbers import delay, quantity

MUCH_DAMPING: Final = 0.5
"""Implausible fraction of critical damping; a value of 2 was probably meant in per cent."""

RUN_ON_TOLERANCE: Final = 1.005
"""Factor on a peak up to which braking is no overshoot: so near, it takes effect after it."""

NOISE_SPAN: Final = 7
"""Range of 1024 samples of noise, in standard deviations."""

_LABORATORY_UNITS: Final = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3), "N": ("kN", 1e-3)}
"""Unit in which a laboratory reads a quantity, and its factor from SI."""


def remarks(setup: Setup, f: Figures | HistoryFigures) -> tuple[list[str], list[str]]:
    """Return notes and warnings."""

    notes, warnings = list(setup.notes), list[str]()
    if "warning" in setup.motion.details:
        notes.append(f"ground motion: {setup.motion.details['warning']}")
    if isinstance(f, Figures):
        _of_structure(setup, f, notes, warnings)
    warnings += _limits_in_reach(setup, f)
    limits = setup.test.limits
    if not any(limit and limit.ends for limit in (limits.command_position_m, limits.force_n)):
        warnings.append(
            "nothing ends a test whose motion grows: neither limits.command_position_m nor "
            "limits.force_n is set with an action that ends the test"
        )
    if setup.rig.link is not None:
        if setup.rate != setup.rig_file.rate:
            notes.append(
                f"test.sample_rate_hz = {setup.rate.hz:g} Hz can be used only in virtual time: "
                f"the drive is sampled at {setup.rig_file.rate.hz:g} Hz (link.sample_rate_hz), so "
                "in real time this test will be refused"
            )
        more_notes, more_warnings = _real_time_remarks(setup, f)
        notes, warnings = notes + more_notes, warnings + more_warnings
    return notes, warnings


def _of_structure(setup: Setup, f: Figures, notes: list[str], warnings: list[str]) -> None:
    """Add remarks on the combination of structure and rig."""
    for found in (_divergence(setup, f), _oscillation(setup, f)):
        if found is not None:
            is_warning, text = found
            (warnings if is_warning else notes).append(text)
    if f.damping_ratio > MUCH_DAMPING:
        warnings.append(
            f"the damping is {f.damping_ratio:.3g} of critical; a structure has 0.01 to 0.1: 2 % "
            'is numerical.damping_ratio = 0.02, or "2 %"'
        )


def _real_time_remarks(setup: Setup, f: Figures | HistoryFigures) -> tuple[list[str], list[str]]:
    """Return notes and warnings on conditions that are watched only in real time."""
    limits, noise = setup.test.limits, setup.derived.rest_noise_displacement_m
    notes, warnings = list[str](), facts.unread_frames(setup.rig.link)
    jump, spread = limits.sensor_jump_m, limits.rest_spread_m
    derived = setup.derived.limits.derived
    watched = [
        getattr(limits, key) or derived.get(key) for key in ("sensor_stuck_s", "sensor_jump_m")
    ]
    if not any(limit is not None and limit.ends for limit in watched):
        notes.append(
            "nothing ends a test whose displacement sensor freezes or jumps: set "
            "limits.sensor_stuck_s and limits.sensor_jump_m"
        )
    # Two samples, each off by four standard deviations.
    step = f.reference_peak_m_per_s / setup.derived.fs_hz + 8 * noise
    if jump is not None and jump.acts and setup.rate.leap(jump.value) < step:
        warnings.append(
            f"limits.sensor_jump_m = {_shown(setup.rate.leap(jump.value), 'm')} is below "
            f"{_shown(step, 'm')}, the most that displacement and noise together change from one "
            "sample to the next: valid readings will be rejected"
        )
    if spread is not None and spread < NOISE_SPAN * noise:
        warnings.append(
            f"limits.rest_spread_m = {_shown(spread, 'm')} is below the span of the noise at rest, "
            f"{_shown(NOISE_SPAN * noise, 'm')}: zeroing will be refused"
        )
    return notes, warnings


def _divergence(setup: Setup, f: Figures) -> tuple[bool, str] | None:
    """Compare the rig's delay with the critical delay of the structure."""
    leads = f.critical_delay_with_lead_samples is not None
    critical = f.critical_delay_with_lead_samples if leads else f.critical_delay_samples
    identified = f.identified_delay_samples
    # The estimator corrects a lead that starts too short; force compensation removes the error.
    helped = setup.derived.rfc_enabled or (leads and setup.derived.estimator_enabled)
    if identified is None or critical is None or identified < critical:
        return None
    rig_has = delay(identified, setup.rate.hz)
    how, at = _lead_in_words(f) if leads else ("without phase lead", "at any delay")
    found = (
        f"{how} the structure with an elastic specimen remains stable only up to a delay "
        f"of {delay(critical, setup.rate.hz, 2)}, but the rig has a delay of {rig_has}"
        if critical
        else f"{how} the structure with an elastic specimen is unstable {at}, and the rig has "
        f"a delay of {rig_has}"
    )
    if helped:
        return False, f"{found}: the test depends on the delay estimate and the force compensation"
    return True, f"{found}: the motion will grow; compensate the delay, or set a limit that trips"


def _lead_in_words(f: Figures) -> tuple[str, str]:
    """Return a description of the lead, and of the delay for which it is designed."""
    if f.alpha0 is not None:
        return "with the phase lead at alpha0", "even at a delay of alpha0"
    return (
        "with the control law at its initial settings",
        "even at the delay for which they are designed",
    )


def _oscillation(setup: Setup, f: Figures) -> tuple[bool, str] | None:
    """Check the loop of the paper's delay estimator."""
    g = f.estimator_loop_gain
    if g is None or g <= LITTLE_MARGIN:
        return None
    gain = setup.derived.law_settings[GAIN]
    remedy = (
        f"lower controller.delay_estimator.gain_per_mm2_per_sample from {gain:g} to "
        f"{LITTLE_MARGIN / g * gain:.2g} or less"
    )
    if g > OSCILLATES and not f.rig_is_lag:
        return True, (
            f"the delay estimate will oscillate on a pure delay: its loop gain is {g:.2f}, "
            f"and must not exceed {OSCILLATES:.2f}; {remedy}"
        )
    lag = (
        ", although a lag such as this rig's is less critical than a delay" if f.rig_is_lag else ""
    )
    return False, (
        f"little margin for the delay estimate: its loop gain is {g:.2f}; at most "
        f"{LITTLE_MARGIN:g} is advised{lag}; {remedy}"
    )


def within_reach(given: Iterable[tuple[str, Limit | None, float, str]]) -> list[str]:
    """Report the limits that a peak of the reference simulation exceeds.

    Args:
        given: key, limit, peak, and the unit of both, for each.
    """
    return [
        f"{key} = {_shown(limit.value, unit)} is below the peak of {_shown(peak, unit)} in the "
        "reference simulation: the test will reach it"
        for key, limit, peak, unit in given
        if limit is not None and limit.acts and peak > limit.value
    ]


def _shown(value: float, unit: str) -> str:
    """Return a limit or a peak in the unit that laboratories use for it."""
    name, factor = _LABORATORY_UNITS.get(unit, (unit, 1.0))
    return f"{value * factor:.4g} {name}"


def _limits_in_reach(setup: Setup, f: Figures | HistoryFigures) -> list[str]:
    """Report the limits that even the reference simulation exceeds."""
    limits = setup.test.limits
    found = within_reach(
        [
            ("limits.command_position_m", limits.command_position_m, f.reference_peak_m, "m"),
            ("limits.force_n", limits.force_n, f.reference_peak_n, "N"),
        ]
    )
    velocity, increment = limits.command_velocity_m_per_s, limits.command_increment_m
    peak_m_per_s = f.reference_peak_m_per_s
    if velocity is not None and velocity.enable and peak_m_per_s > velocity.value:
        found.append(
            f"limits.command_velocity_m_per_s = {_shown(velocity.value, 'm/s')} is below the peak "
            f"of {_shown(peak_m_per_s, 'm/s')} in the reference simulation: the command will be "
            "limited"
        )
    peak_m = peak_m_per_s / STANDARD_HZ
    if increment is not None and increment.acts and peak_m > increment.value:
        found.append(
            f"limits.command_increment_m = {_shown(increment.value, 'm')} is below the peak of "
            f"{_shown(peak_m, 'm')} per sample in the reference simulation: the test will reach it"
        )
    return found


def run_on_warnings(setup: Setup, f: Figures | HistoryFigures, found: RunOn) -> list[str]:
    """Report overshoots of a HOLD, a STOP or a ramp-out beyond what the test itself reaches."""
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
            f"a HOLD, a STOP or a ramp-out overshoots to {quantity(value, unit, factor)}, beyond "
            f"{than} of {quantity(allowed, unit, factor)}: it brakes with "
            f"{found.brake_m_per_s2:.3g} m/s^2; raise or remove "
            "limits.brake_acceleration_m_per_s2, and make sure that "
            "limits.command_acceleration_m_per_s2 allows it"
        )
    return warnings
