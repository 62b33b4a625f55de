"""Faults of a recording that only a diagnosis reveals: stray readings, and loud sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import fitted, remainder, strays, understated
from rthyb_rt.diagnose.case import CHANNELS, Case, Floats
from rthyb_rt.diagnose.gaps import Mask
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.result import DiagnosisResult


@dataclass(frozen=True)
class SensorResidual:
    """What the best set of a diagnosis leaves of a channel.

    Attributes:
        name: the channel.
        made: what model and set make of it, (n,).
        rest: what they leave, (n,).
        rows: which rows are evaluated, (n,).
        motion: the motion that belongs to it.
        plain: whether the residual would be white if nothing else were missing.
    """

    name: str
    made: Floats
    rest: Floats
    rows: Mask
    motion: ComputedMotion
    plain: bool


def left_by(done: DiagnosisResult) -> list[SensorResidual]:
    """Return what a diagnosis leaves of the displacement and the load cell, if it has them."""
    left, search = [], done.force
    if done.disp is not None:
        task, motion = done.disp.task, done.disp.best.motion
        rows = np.zeros(task.x.size, dtype=np.bool_)
        rows[task.rows] = True
        made, rest, white = motion.x, task.x - motion.x, task.own is None
        left += [SensorResidual("x_meas", made, rest, rows, motion, white)]
    if search is None or "f_meas" not in done.case.channels or done.case.model.family == "forced":
        return left
    found, motion = search.problem.estimate, search.problem.estimate.motion
    if found.read is None:
        made = fitted.force_of(search.problem, search.best)
        rest = remainder.left_by(search, search.best)
        white = found.exact and not found.coloured
        left += [SensorResidual("f_meas", made, rest, found.rows, motion, white)]
    return left


def mended(case: Case, left: list[SensorResidual], unknown: bool) -> Case | None:
    """Return a recording without stray readings, or with the noise its sensors have; None: as is.

    If all is explained, only the displacement's noise matters: a motion that seems to differ from
    the actuator's was estimated, which shows less.

    Args:
        case: the recording that was diagnosed.
        left: residuals of its displacement and its load cell, as far as there are any.
        unknown: whether something in it could not be explained.
    """
    channels, notes, model = dict(case.channels), list(case.notes), case.model
    sheets = {"x_meas": model.x_std, "f_meas": model.f_std}
    for one in left if unknown else ():
        moved = one.motion
        rows = strays.isolated(one.rest, one.rows, sheets[one.name] or 0.0, moved.x, moved.v)
        rows = rows[np.isfinite(channels[one.name][rows])]
        if rows.size:
            channels[one.name], note = strays.without(one.name, channels[one.name], rows)
            # Along a motion that is spoiled by those of the displacement, others are not seen.
            return replace(case, channels=channels, notes=[*notes, note])
    for one in left if unknown else [o for o in left if o.name == "x_meas"]:
        sheet, found = sheets[one.name], _noise(one, left)
        if sheet and found > POLICY.noise_held * sheet:
            sheets[one.name], unit = found, CHANNELS[one.name]
            notes.append(
                f"the noise of {one.name} is {found:.3g} {unit}, but its data sheet states "
                f"{sheet:.3g} {unit}"
            )
    if len(notes) == len(case.notes):
        return None
    model = replace(model, x_std=sheets["x_meas"], f_std=sheets["f_meas"])
    return replace(case, model=model, notes=notes)


def _noise(one: SensorResidual, left: list[SensorResidual]) -> float:
    """Return the standard deviation of a sensor's white noise; 0 if the residual is more."""
    # Along a motion that is estimated from one sensor, the other one's residual contains its noise.
    others = [o for o in left if o is not one and o.plain]
    if not one.plain or not all(
        understated.unrelated(one.rest, o.rest, one.rows & o.rows) for o in others
    ):
        return 0.0
    motion = (one.motion.x, one.motion.v, one.motion.a)
    return understated.level(one.rest, one.made, one.rows, motion)
