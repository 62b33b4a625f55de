"""Table of the sets of effects that were compared: the one named, its equals, and rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from rthyb_rt.diagnose import evidence, fitted
from rthyb_rt.diagnose import force as forces
from rthyb_rt.diagnose.actuation import ActuatorFit
from rthyb_rt.diagnose.intervals import intervals
from rthyb_rt.diagnose.problem import Fit
from rthyb_rt.diagnose.result import DiagnosisResult, Displacement
from rthyb_rt.diagnose.words import called, interval_text, law_text, together, value_text

_AnyFit = TypeVar("_AnyFit", Fit, ActuatorFit)

MOST = 7
"""Largest number of rows of a table."""


@dataclass(frozen=True)
class Row:
    """One set of effects compared with the others.

    Attributes:
        mark: "named", "as good" or "rival".
        effects: its effects in words.
        params: parameters of each effect, with 95 % intervals if known.
        weight: weight of evidence against the other sets of the table, 0 to 1.
        evidence: change of the information criterion relative to the model alone; negative is
            better.
        held_out: fraction of the misfit's reduction that is confirmed on quarter seconds to which
            the set was not fitted; nan if not evaluated.
    """

    mark: str
    effects: str
    params: list[str]
    weight: float
    evidence: float
    held_out: float


def rows_of(d: DiagnosisResult) -> list[Row]:
    """Return the sets of the actuator, then those of the force, best first.

    None for an unknown verdict: no effect is then named, not even as a rival.
    """
    if d.verdict == "unknown":
        return []
    rows: list[Row] = []
    if d.disp is not None and d.disp.found:
        rows += _actuator(d, d.disp)
    if d.force is not None and d.force.best.members and d.context is not None:
        named = set(d.force.best.names) <= set(d.effects)
        if named or d.verdict == "ambiguous":
            rows += _force(d, d.force)
    return rows


def _weights(scores: Sequence[float]) -> list[float]:
    size = np.array(scores)
    weights = np.exp(-0.5 * np.clip(size - size.min(), 0, 700))
    return [float(w) for w in weights / weights.sum()]


def _mark(number: int, equal: int) -> str:
    if number == 0:
        return "named" if equal == 0 else "as good"
    return "as good" if number <= equal else "rival"


def _text(name: str, params: dict[str, float], ci: dict[str, list[float]], several: bool) -> str:
    values = [
        value_text(k, v) + (f" ({interval_text(k, ci[k])})" if k in ci else "")
        for k, v in params.items()
    ]
    return f"{called(name)}: {', '.join(values)}" if several else ", ".join(values)


def _actuator(d: DiagnosisResult, disp: Displacement) -> list[Row]:
    by_name = {c.name: c for c in d.candidates if c.channel == "disp"}
    fits = _distinct([disp.best, *disp.equal, *disp.rivals])
    scores = [f.misfit(disp.scale) + disp.task.price(f) for f in fits]
    null = disp.null.misfit(disp.scale)
    rows = []
    for i, (fit, score, weight) in enumerate(zip(fits, scores, _weights(scores), strict=True)):
        params = [
            _text(
                e.name,
                e.report(disp.task.base, v),
                by_name[e.name].ci95 if i == 0 and e.name in by_name else {},
                len(fit.effects) > 1,
            )
            for e, v in zip(fit.effects, fit.values, strict=True)
        ]
        rows.append(
            Row(_mark(i, len(disp.equal)), together(fit.names), params, weight, score - null,
                float("nan"))
        )  # fmt: skip
    return rows


def _force(d: DiagnosisResult, search: forces.Search) -> list[Row]:
    problem, ctx = search.problem, d.context
    assert ctx is not None
    by_name = {c.name: c for c in d.candidates if c.channel == "force"}
    equal = {f.names for f in search.equal}
    rivals = [f for f in search.rivals if f.names not in equal]
    fits = _distinct([search.best, *search.equal, *rivals])
    scores = [f.chi2 + fitted.cost(problem, f) for f in fits]
    rows = []
    for i, (fit, score, weight) in enumerate(zip(fits, scores, _weights(scores), strict=True)):
        params, several = [], len(fit.names) > 1
        for j in range(len(fit.members)):
            values, ci = intervals(fit, j, ctx)
            for name in fit.members[j].effect.names:
                own = by_name.get(name) if i == 0 else None
                # For the named set, the values of the answer, whose intervals are wider.
                shown = (own.params, own.ci95) if own else (values, ci)
                law = law_text(own) if own else ""
                params.append(_text(name, *shown, several) + (f"; {law}" if law else ""))
        held = float("nan") if search.moved else evidence.held_out_gain(problem, fit)
        rows.append(
            Row(_mark(i, len(search.equal)), together(fit.names), params, weight,
                score - search.null.chi2, held)
        )  # fmt: skip
    return rows


def _distinct(fits: list[_AnyFit]) -> list[_AnyFit]:
    seen: set[tuple[str, ...]] = set()
    out = []
    for fit in fits:
        if fit.names not in seen:
            seen.add(fit.names)
            out.append(fit)
    return out[:MOST]
