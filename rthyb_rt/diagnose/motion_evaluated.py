"""Along which motion the force is evaluated: simulated, of the rig, or estimated."""

from __future__ import annotations

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import actuation, estimate, gaps, rigged, spring_history
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.result import Displacement


def motion_of(case: Case, disp: Displacement | None) -> Estimate | None:
    """Return the motion and the force, simulated if the actuator is understood."""
    found = _motion(case, disp)
    if found is None:
        return None
    if not found.exact and found.blur is not None and "f_meas" in case.channels:
        expected = case.model.force(found.motion.x, found.motion.v, found.motion.a)
        found = estimate.where_it_changes(case, found, expected) or found
    x = found.motion.x
    return found.beginning(spring_history.forgotten(case, x, found.sigma_n), case.fs_hz)


def _motion(case: Case, disp: Displacement | None) -> Estimate | None:
    if (
        disp is not None
        and disp.known
        and (disp.quiet or disp.best.chi2 / disp.task.rows.size < POLICY.motion_understood)
    ):
        found = estimate.along(case, disp.best.motion, actuation.settled(case))
        if found is not None:
            return found
    by_rig = rigged.as_given(case)
    if by_rig is not None:
        found = estimate.along(case, by_rig, actuation.settled(case))
        if found is not None:
            return found
    if "x_meas" not in case.channels and "x_cmd" in case.channels and case.model.actuator:
        motion = simulated(case)
        return estimate.along(case, motion, actuation.settled(case))
    return estimate.from_sensors(case)


def simulated(case: Case) -> ComputedMotion:
    """Return the motion of the model's actuator along the command."""
    from rthyb_rt.core.diagnosis_models import actuator

    assert case.model.actuator is not None
    return actuator(case.model.actuator, gaps.filled(case.channels["x_cmd"]), case.fs_hz)


def context_of(
    case: Case, found: Estimate, ranges: tuple[float, float, float] | None = None
) -> Context:
    """Return the quantities of a recording on which force laws depend."""
    other = {
        name: gaps.filled(values)
        for name, values in case.recorded.items()
        if np.isfinite(values).any()
    }
    read = estimate.as_read(case, found)
    return Context(case.model, found.motion, case.t, read.force, other, ranges)
