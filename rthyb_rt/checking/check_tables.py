"""The tables of a check: quantity, value, explanation."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from rthyb_rt import core
from rthyb_rt.analysis.loop_roots import MOST_GAIN, LoopVerdict
from rthyb_rt.checking.check_figures import Figures, most_delay
from rthyb_rt.config import STANDARD_HZ
from rthyb_rt.config.numerical import Matrices
from rthyb_rt.config.own_tables import FmuFile, LibraryFile
from rthyb_rt.lab.braking import RunOn
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.numbers import number, percent, quantity

_CHECKS: Final = {
    "link": "the link",
    "polarity": "polarity",
    "limits": "the limits",
    "watchdog": "the watchdog",
    "trip": "the stop after a trip",
}


def _structure_rows(f: Figures) -> list[tuple[str, str, str]]:
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
            "computed; fraction of critical",
        ),
    ]


def _integrator(setup: Setup) -> str:
    numerical = setup.test.numerical
    matrices = numerical.matrices
    if numerical.python is not None:
        return f"its own, {numerical.python.class_}"
    if isinstance(numerical.own, (LibraryFile, FmuFile)):
        return f"its own, {Path(numerical.own.file).name}"
    if not isinstance(matrices, Matrices):
        return numerical.integrator
    return matrices.integrator


def _slow_rows(setup: Setup) -> list[tuple[str, str, str]]:
    slow = setup.test.test.time_scale
    if slow == 1.0:
        return []
    what = (
        "seconds in the laboratory per second of the structure; all values below are in "
        "laboratory time"
    )
    return [("Time scale", number(slow), what)]


def rows_of_test(setup: Setup, f: Figures) -> list[tuple[str, str, str]]:
    """Return the rows for the test itself: motion, structure, controller, delays, peaks."""
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
        *_slow_rows(setup),
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
                ("alpha0", samples(f.alpha0), "initial delay of the phase lead"),
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
                    "Critical delay, adapted",
                    _followed(setup, f, samples),
                    "elastic specimen, alpha = delay of the rig",
                )
            )
    if f.identified_delay_samples is not None:
        kind = "behaves as a lag" if f.rig_is_lag else "behaves as a delay"
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


def loop_rows(loop: LoopVerdict | None, *, swept: bool = False) -> list[tuple[str, str, str]]:
    """Return the rows for the whole loop: root, gain margin, delay margin.

    Args:
        loop: its stability; None: not known.
        swept: whether the rig file has an identified response.
    """
    if loop is None:
        why = "no model fits the" if swept else "the rig file has no"
        return [("Largest root", "not computed", f"{why} identified response")]
    what = f"whole loop, elastic specimen; rig known up to {loop.swept_hz:g} Hz"
    root = f"{loop.radius:.5f} at {number(loop.frequency_hz)} Hz"
    if loop.unstable:
        return [("Largest root", f"{root}: UNSTABLE", what)]
    more = f"{MOST_GAIN:g} or more" if loop.gain_margin >= MOST_GAIN else number(loop.gain_margin)
    known = f", up to {loop.swept_hz:g} Hz" if loop.unproven else ""
    late = "any"
    if math.isfinite(loop.delay_margin_samples):
        late = quantity(loop.delay_margin_samples / STANDARD_HZ, "ms", 1e3)
    return [
        ("Largest root", root, what),
        ("Gain margin", more, f"factor by which the rig's gain may increase{known}"),
        ("Delay margin", late, f"additional delay the rig may have{known}"),
    ]


def limit_rows(limits: list[dict[str, Any]], *, linked: bool) -> list[tuple[str, str, str]]:
    """Return the limits from the files; for a rig with a link also the derived ones."""
    words = {
        "test": "limit of the test",
        "rig": "limit of the rig",
        "default": "limit by default",
        "derived": "limit derived from the test",
    }
    rows = []
    for limit in limits:
        if limit["from"] in ("default", "derived") and not linked:
            continue
        action = limit["action"] if limit["enable"] else "off"
        if action == "none" and limit["key"] == "command_velocity_m_per_s":
            action = "limits the command"
        value = f"{limit['value']:g} {limit['unit']}"
        rows.append((limit["key"], f"{value}, {action}" if action else value, words[limit["from"]]))
    return rows


def run_on_rows(found: RunOn) -> list[tuple[str, str, str]]:
    """Return the rows for the overshoot when the test is braked."""
    return [
        (
            "Peak displacement if stopped",
            quantity(found.displacement_m, "mm", 1e3),
            f"HOLD, STOP or ramp-out at the worst instant, {found.displacement_at_s:.2f} s",
        ),
        (
            "Peak force if stopped",
            quantity(found.force_n, "kN", 1e-3),
            f"the same at {found.force_at_s:.2f} s, braking with {found.brake_m_per_s2:.3g} m/s²",
        ),
    ]


def link_rows(link: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """Return the rows for the rig's link; none without one."""
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
        if link.get("axes_on_bus"):
            what += f", {link['axes_on_bus']} axes on this bus"
        rows.append(("Bus load", percent(link["bus_load"], 3), f"{what}; up to 80 % is accepted"))
    elif link["kind"] != "socket":
        lacking = "bitrate" if link["bitrate"] is None else "cantools, which reads the DBC file,"
        rows.append(("Bus load", "not known", f"{lacking} is missing"))
    clocks = {
        "host": (
            "host",
            "follows this PC's clock; the drive may skip or repeat a sample occasionally",
        ),
        "link": (
            f"link, feedback {link['lead_us']:g} us before the tick",
            "follows the drive's clock",
        ),
        "stepped": ("stepped", "not real time"),
    }
    rows.append(("Clock", *clocks[link["clock"]]))
    if link["sample_rate_hz"] != STANDARD_HZ:
        rows.append(("Sample rate", f"{link['sample_rate_hz']} Hz", "of the drive"))
    return rows


def commissioning_rows(found: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """Return the rows for the checks of the rig and their dates."""
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
            rows.append((f"Check of {_CHECKS[name]}", "not done", ""))
    return rows


def calibration_rows(c: dict[str, float]) -> list[tuple[str, str, str]]:
    """Return the rows for the conversion from the wire to the structure, if it is not trivial."""
    if c == asdict(core.WireCalibration()):
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
    return "" if fs_hz == STANDARD_HZ else f"at {fs_hz:g} Hz"


def _followed(setup: Setup, f: Figures, samples: Any) -> str:
    delay = f.critical_delay_followed_samples
    most = most_delay(setup)
    return f"above alpha_max = {most}" if delay == most else str(samples(delay))


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
