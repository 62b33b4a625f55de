"""A model that states no tolerance begins with the stiffness that the recording shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.numbers import quantity


def with_own_stiffness(case: Case) -> Case:
    """Return a recording whose naive model has the stiffness of a line through it, with a note.

    Laws begin, and are told, in proportion to the model's spring; that of a first guess, such as
    the slope of the first cycle of a specimen that yields, may be several times the secant's. As it
    is if the line is nearly the model's, or falls.
    """
    model = case.model
    x, f = case.get("x_meas"), case.get("f_meas")
    if model.family != "drive" or model.k_tol is not None or not model.k or x is None or f is None:
        return case
    rows = case.rows & np.isfinite(x) & np.isfinite(f)
    if np.count_nonzero(rows) < POLICY.least_rows_static:
        return case
    rate = np.gradient(np.where(np.isfinite(x), x, 0.0))
    design = np.column_stack([x, rate, np.ones(x.size)])[rows]
    size = np.sqrt(np.mean(design**2, axis=0))
    size[size == 0.0] = 1.0
    k = float((np.linalg.lstsq(design / size, f[rows], rcond=None)[0] / size)[0])
    if not k > 0.0 or abs(k - model.k) <= POLICY.refitted_from * k:
        return case
    note = (
        f"the model states no tolerance for its stiffness of {quantity(model.k, 'N/m')}; the "
        f"results are relative to {quantity(k, 'N/m')}, the slope of a line through the recording"
    )
    return replace(case, model=replace(model, k=k, k_stated=model.k), notes=[*case.notes, note])
