"""Effects of the actuator that begin in mid-recording.

The effect of a small change of each parameter on the displacement is a column; truncated before an
onset, it shows from when on the change would explain most (the same idea as in `onset`). Promising
candidates are simulated: the actuator's parameters change at a row; its position and velocity
continue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rthyb_rt.core.diagnosis_models import ActuatorModel, SimulationError
from rthyb_rt.diagnose.actuation import CATALOGUE, Actuation, ActuatorEffect, ActuatorFit
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.onset import SINGLES
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.refinement import inflated, inflation

BLOCKS = 48
"""Number of intervals between trial onsets: a quarter of a second each in twelve seconds."""
MOST = 3
"""Number of effects that are simulated in addition to one set."""
STEP = 1e-3
"""Relative step of a parameter for the numerical slope."""
NEAR = 25
"""Number of trial onsets between the neighbours of the best one."""
STEPS = (0.0, 25.0, 5.0)
"""Step, in rows, of the search for the onset before each fit; 0: no search."""


@dataclass(frozen=True)
class _Promise:
    effect: ActuatorEffect
    settings: dict[str, Any]
    values: Floats
    row: float
    chi2: float


def propose(task: Actuation, null: ActuatorFit, fits: Sequence[ActuatorFit]) -> list[ActuatorFit]:
    """Fit effects with an onset, one alone.

    Returns:
        The fits; none if the residual of the best set is white.
    """
    return _beside(task, null) if _missing(fits) else []


def propose_beside(task: Actuation, fits: Sequence[ActuatorFit]) -> list[ActuatorFit]:
    """Fit effects with an onset added to the best sets; a set that has an onset keeps it.

    Returns:
        The fits; none if the residual of the best set is white.
    """
    if not _missing(fits):
        return []
    late = sorted((f for f in fits if f.before and len(f.effects) == 1), key=lambda f: f.chi2)
    whole = sorted((f for f in fits if not f.before and f.effects), key=lambda f: f.chi2)
    singles = [f for f in whole if len(f.effects) == 1]
    return [fit for base in [*late[:1], *singles[:SINGLES]] for fit in _beside(task, base)]


def _missing(fits: Sequence[ActuatorFit]) -> bool:
    return inflation(min(fits, key=lambda f: f.chi2).residual) > POLICY.white_residual


def _beside(task: Actuation, base: ActuatorFit) -> list[ActuatorFit]:
    """Fit the most promising onset added to a set; if the set has one, with the same onset."""
    promises: dict[str, _Promise] = {}
    for effect in CATALOGUE:
        for promise in _promising(task, base, effect) if effect.name not in base.names else ():
            old = promises.get(effect.name)
            if old is None or promise.chi2 < old.chi2:
                promises[effect.name] = promise
    found = []
    own = float(base.residual @ base.residual)
    for promise in sorted(promises.values(), key=lambda p: p.chi2)[:MOST]:
        if own - promise.chi2 > task.price_of(promise.effect):
            fit = _fitted(task, base, promise)
            if fit is not None and _absent_before(task, fit):
                found.append(fit)
    return found


def _promising(task: Actuation, base: ActuatorFit, effect: ActuatorEffect) -> list[_Promise]:
    """Return for each variant of an effect the onset at which it would explain most."""
    late = replace(effect, late=True)
    out = []
    for settings, values in effect.starts(task.base, task.v_max):
        try:
            columns = _columns(task, base, effect, settings, values)
        except SimulationError:
            continue
        chi2, row, change = _cut(task, base, columns)
        start = values if effect.limit else values + change * _steps(values)
        logged = np.maximum(start, 0.3 * values) if effect.log else start
        out.append(_Promise(late, settings, logged, row, chi2))
    return out


def _steps(values: Floats) -> Floats:
    return STEP * np.where(values != 0.0, np.abs(values), 1.0)


def _columns(
    task: Actuation,
    base: ActuatorFit,
    effect: ActuatorEffect,
    settings: dict[str, Any],
    values: Floats,
) -> Floats:
    """Return the effect of a step of each parameter on the displacement, (rows, parameters).

    For a limit, which has no slope until it is reached, that of the limit itself.
    """
    changed = []
    model = replace(base.model, **settings)
    for name, value, step in zip(effect.fields, values, _steps(values), strict=True):
        own = value if effect.limit else getattr(base.model, name) + step
        moved: dict[str, Any] = {name: float(own)}
        changed.append(task.simulate(replace(model, **moved)).x)
    plain = task.simulate(base.model).x
    return np.column_stack([(c - plain)[task.rows] / task.sigma for c in changed])


def _cut(task: Actuation, base: ActuatorFit, columns: Floats) -> tuple[float, float, Floats]:
    """Return (chi-squared, row, coefficients) of the onset at which columns explain most.

    Zero and time offset are free, and so are the parameters of the given set.
    """
    nuisance = np.column_stack([np.ones(task.rows.size), *_moved_by(task, base)])
    held = nuisance.T @ nuisance
    held[1, 1] += POLICY.offset_prior_s**-2
    # A parameter without any effect here has a zero column.
    held += np.diag(1e-9 * held.diagonal() + np.where(held.diagonal() > 0.0, 0.0, 1.0))
    y = base.residual
    from_nuisance = np.linalg.solve(held, nuisance.T @ y)

    def brought(cut: int) -> tuple[float, int, Floats]:
        late = columns[cut:]
        cross = nuisance[cut:].T @ late
        own = late.T @ late - cross.T @ np.linalg.solve(held, cross)
        size = np.sqrt(np.maximum(own.diagonal(), 1e-300))
        wanted = late.T @ y[cut:] - cross.T @ from_nuisance
        scaled = own / np.outer(size, size) + 1e-6 * np.eye(size.size)
        beta = np.linalg.solve(scaled, wanted / size) / size
        return float(y @ y - wanted @ beta), cut, beta

    if base.before is not None:
        begun = min(int(np.searchsorted(task.rows, base.before[0])), task.rows.size - 1)
        cuts = np.array([begun])
        found = min(map(brought, cuts), key=lambda b: b[0])
    else:
        cuts = np.linspace(0, task.rows.size, BLOCKS + 1).astype(int)
        found = min(map(brought, cuts[1:-1]), key=lambda b: b[0])
        near = np.linspace(-cuts[1], cuts[1], NEAR).astype(int) + found[1]
        inside = near[(near > 0) & (near < task.rows.size - 1)]
        found = min([found, *map(brought, inside)], key=lambda b: b[0])
    return found[0], float(task.rows[found[1]]), found[2]


def _moved_by(task: Actuation, base: ActuatorFit) -> list[Floats]:
    """Return slopes of the displacement to time offset and to the set's own parameters."""
    plain = task.simulate(base.model, base.before).x

    def slope(later: ActuatorModel, first: ActuatorModel, step: float) -> Floats:
        before = (base.before[0], first) if base.before else None
        return np.asarray((task.simulate(later, before).x - plain)[task.rows] / task.sigma / step)

    first = base.before[1] if base.before else base.model
    moved = {"shift_s": base.model.shift_s + 1e-5}
    out = [slope(replace(base.model, **moved), replace(first, **moved), 1e-5)]  # type: ignore[arg-type]
    for effect in base.effects:
        for name in effect.fields:
            value = float(getattr(base.model, name))
            step = float(_steps(np.array([value]))[0])
            change: dict[str, Any] = {name: value + step}
            kept = first if effect.late else replace(first, **change)
            out.append(slope(replace(base.model, **change), kept, step))
    return out


def _fitted(task: Actuation, base: ActuatorFit, promise: _Promise) -> ActuatorFit | None:
    """Fit a set with one more effect, searching for its onset in decreasing steps."""
    effects = (*base.effects, promise.effect)
    settings = {"kappa_of": base.model.kappa_of, "vmax_of": base.model.vmax_of} | promise.settings
    values = np.array([*(v for own in base.values for v in own), *promise.values])
    row, best = promise.row, None
    for step in STEPS:
        row = _row(task, effects, settings, values, row, step)
        fit = task.fit(effects, [(settings, values)], row)
        if fit is None or fit.before is None:
            break
        best = fit if best is None or fit.chi2 < best.chi2 else best
        row, values = fit.before[0], np.array([v for own in fit.values for v in own])
    return best


def _row(
    task: Actuation,
    effects: Sequence[ActuatorEffect],
    settings: dict[str, Any],
    values: Floats,
    row: float,
    step: float,
) -> float:
    """Return the row near a given one from which on the late effects fit the displacement best."""
    while step >= 1.0:
        found = []
        for at in row + step * np.arange(-5, 6):
            # Nothing could begin after the last evaluated row.
            if 0 < at < task.rows[-1]:
                try:
                    r = task.residual(*task.models(effects, settings, values, 0.0, float(at)))[0]
                except SimulationError:
                    continue
                found.append((float(r @ r), float(at)))
        if not found:
            break
        row, step = min(found)[1], step / 5.0
    return row


def _absent_before(task: Actuation, fit: ActuatorFit) -> bool:
    """Return whether the last effect of a set, which has an onset, is absent before it.

    As in `onset.absent_before`: the effect of a step of its parameters, as large as their change,
    is fitted before the onset with free size.
    """
    assert fit.before is not None
    row, first = fit.before
    effect = fit.effects[-1]
    changes: dict[str, Any] = {f: float(getattr(fit.model, f)) for f in effect.fields}
    try:
        there = task.simulate(fit.model, (row, replace(first, **changes))).x
    except SimulationError:
        return False
    # Before the onset only: its effect afterwards is part of the set.
    column = ((there - fit.motion.x + fit.zero_m)[task.rows] / task.sigma)[:, None]
    if not np.any(column):
        return False
    base = np.column_stack([np.ones(task.rows.size), *_moved_by(task, fit)])
    design = np.column_stack([column, base])
    prior = np.zeros((design.shape[1], design.shape[1]))
    prior[2, 2] = POLICY.offset_prior_s**-2
    gram = design.T @ design + prior
    size = np.sqrt(np.maximum(gram.diagonal(), 1e-300))
    inverse = np.linalg.pinv(gram / np.outer(size, size), hermitian=True) / np.outer(size, size)
    part = float((inverse @ (design.T @ fit.residual))[0])
    width = float(np.sqrt(inflated(inverse, prior, inflation(fit.residual))[0, 0]))
    return part + POLICY.absent_sure * width < POLICY.absent_before
