"""Figures of a prescribed history on a rig: its peaks beside the limits, and its steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rthyb_rt.config.prescribed_history import CyclicHistory
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.numbers import number, quantity

Rows = list[tuple[str, str, str]]


@dataclass(frozen=True)
class HistoryFigures:
    """Figures of a history; None where a figure does not apply.

    Attributes:
        history: description of the history.
        time_scale: seconds in the laboratory per second of the history.
        reference_peak_m, reference_peak_m_per_s, reference_peak_m_per_s2: of the history, in
            laboratory time.
        reference_peak_n: force of the rig file's specimen for this history.
        steps: amplitude and number of cycles, in their order; none for a sweep or noise.
        identified_delay_samples: delay of the rig according to `rthyb identify`.
    """

    samples: int
    duration_s: float
    history: str
    time_scale: float
    k_e_n_per_m: float
    reference_peak_m: float
    reference_peak_m_per_s: float
    reference_peak_m_per_s2: float
    reference_peak_n: float
    identified_delay_samples: float | None
    steps: tuple[dict[str, float], ...] = ()


def figures_of_history(setup: Setup) -> HistoryFigures:
    """Return the figures of a history that is ready to run."""
    plan, history, found = setup.plan, setup.test.history, setup.rig.identified
    assert plan is not None
    assert history is not None
    steps = history.steps if isinstance(history, CyclicHistory) else ()
    return HistoryFigures(
        samples=setup.ticks,
        duration_s=setup.ticks / setup.derived.fs_hz,
        history=history.title,
        time_scale=setup.test.test.time_scale,
        k_e_n_per_m=setup.derived.k_e_n_per_m,
        reference_peak_m=plan.peak_m,
        reference_peak_m_per_s=plan.peak_m_per_s,
        reference_peak_m_per_s2=plan.peak_m_per_s2,
        reference_peak_n=float(np.abs(setup.reference["f_ref_n"]).max()),
        identified_delay_samples=None if found is None else setup.rate.samples(found.alpha),
        steps=tuple(
            {"amplitude_m": step.amplitude_m, "cycles": float(step.cycles)} for step in steps
        ),
    )


def rows_of_history(setup: Setup, f: HistoryFigures) -> Rows:
    """Return the rows for a history: description, length, and its peaks with their limits."""
    limits, fs_hz = setup.test.limits, setup.derived.fs_hz
    position, velocity = limits.command_position_m, limits.command_velocity_m_per_s
    force = limits.force_n
    most_n = _below(force.value if force and force.acts else None, "kN", 1e-3)
    rows: Rows = [
        ("History", f.history, ""),
        ("Length of the test", f"{f.duration_s:.2f} s ({f.samples} samples)", f"at {fs_hz:g} Hz"),
    ]
    if f.time_scale != 1.0:
        rows.append(
            (
                "Time scale",
                number(f.time_scale),
                "seconds in the laboratory per second of the history",
            )
        )
    rows += [
        (
            f"Step {i + 1}",
            f"{quantity(step['amplitude_m'], 'mm', 1e3)}, {step['cycles']:g} cycles",
            "",
        )
        for i, step in enumerate(f.steps)
    ]
    rows += [
        ("Elastic stiffness", quantity(f.k_e_n_per_m, "kN/m", 1e-3, 4), "k_e of the specimen"),
        ("Controller", setup.test.controller.type, ""),
        (
            "Peak displacement",
            quantity(f.reference_peak_m, "mm", 1e3),
            _below(position.value if position and position.acts else None, "mm", 1e3),
        ),
        (
            "Peak velocity",
            quantity(f.reference_peak_m_per_s, "mm/s", 1e3),
            _below(velocity.value if velocity and velocity.enable else None, "mm/s", 1e3),
        ),
        (
            "Peak acceleration",
            quantity(f.reference_peak_m_per_s2, "m/s²"),
            _below(limits.command_acceleration_m_per_s2, "m/s²", 1.0),
        ),
        (
            "Peak force",
            quantity(f.reference_peak_n, "kN", 1e-3),
            f"from the rig's specimen model; {most_n}",
        ),
    ]
    if f.identified_delay_samples is not None:
        delay_ms = f.identified_delay_samples / fs_hz * 1e3
        rows.append(
            (
                "Delay of the rig",
                f"{number(f.identified_delay_samples)} samples ({number(delay_ms)} ms)",
                "the specimen lags by this much, which does no harm here",
            )
        )
    return rows


def _below(limit: float | None, unit: str, factor: float) -> str:
    return "no limit" if limit is None else f"limit {quantity(limit, unit, factor)}"
