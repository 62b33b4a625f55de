"""The result of a diagnosis, and how the interchange format has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from rthyb_rt.diagnose import estimate, force
from rthyb_rt.diagnose.actuation import Actuation, ActuatorFit
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.court import Ruling
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.verdict import Said

Progress = Callable[[str], None]
"""Receives the name of each stage of a diagnosis."""


@dataclass
class Found:
    """One effect that was found, or a rival.

    Attributes:
        score: weight of evidence against the other sets, 0 to 1.
        params, ci95: by name with units.
        evidence: change of the information criterion when it is added; negative is better.
        signal: its contribution along the recording, N or m, (n,).
        shape: variant of its law and shape parameters, for the report.
        form: the form of the law in a few words, among those that share the name.
        from_s: its onset, if in mid-recording, s.
        modulated_by: the channel that modulates it, and by how much; see `Modulated.slope`.
    """

    name: str
    channel: Literal["force", "disp"]
    score: float
    params: dict[str, float]
    ci95: dict[str, list[float]]
    evidence: float
    signal: Floats | None = None
    shape: str = ""
    form: str = ""
    from_s: float | None = None
    modulated_by: dict[str, Any] = field(default_factory=dict)


@dataclass
class Displacement:
    """Result for the displacement channel.

    Attributes:
        left: fraction of the misfit beyond noise that the best fit leaves.
        known: whether that may be noise, or due to the form of a law.
        quiet: whether it is within the sensor's data sheet.
    """

    task: Actuation
    null: ActuatorFit
    best: ActuatorFit
    equal: list[ActuatorFit]
    rivals: list[ActuatorFit]
    scale: float
    left: float
    known: bool
    quiet: bool = False

    @property
    def found(self) -> bool:
        """Whether an effect is named."""
        return bool(self.best.effects)


@dataclass
class DiagnosisResult:
    """The complete result for a recording."""

    case: Case
    verdict: Said
    channel: Literal["force", "disp"]
    effects: list[str]
    candidates: list[Found]
    ambiguous_with: list[list[str]]
    windows: list[list[float]]
    x_m: list[float]
    v_m_s: list[float]
    fit: dict[str, float]
    next_experiment: dict[str, str] | None
    disp: Displacement | None
    force: force.Search | None
    estimate: Estimate | None
    context: Context | None
    notes: list[str] = field(default_factory=list)
    residual: Floats | None = None
    ledger: tuple[Ruling, ...] = ()


def _work(d: DiagnosisResult, c: Found) -> dict[str, float]:
    """Return the work that a force of the answer removed from the motion, J.

    The parameters of a loop are not unique, but its energy is.
    """
    if c.signal is None or c.channel != "force" or d.estimate is None:
        return {}
    x = d.estimate.motion.x
    rows = estimate.as_read(d.case, d.estimate).rows
    dx = np.where(rows, np.diff(x, prepend=x[0]), 0.0)
    return {"energy_J": float(c.signal @ dx)}


def to_json(d: DiagnosisResult) -> dict[str, Any]:
    """Return the answer in the interchange format."""
    known = [c for c in d.candidates if d.verdict != "unknown"]
    return {
        "schema": "rthyb-diagnose/1",
        "verdict": d.verdict,
        "effects": d.effects,
        "candidates": [
            {"name": c.name, "score": c.score, "params": c.params, "ci95": c.ci95,
             "delta_bic": c.evidence, "channel": c.channel}
            | ({"form": c.form} if c.form else {})
            | ({"modulated_by": c.modulated_by} if c.modulated_by else {}) | _work(d, c)
            | ({"from_s": c.from_s} if c.from_s is not None else {})
            for c in known
        ],
        "ambiguous_with": d.ambiguous_with,
        "localisation": {
            "channel": d.channel, "time_windows": d.windows, "x_m": d.x_m, "v_m_s": d.v_m_s,
        },
        "fit": d.fit,
        "next_experiment": d.next_experiment,
        "notes": d.notes,
    }  # fmt: skip
