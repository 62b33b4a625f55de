"""What follows from a diagnosis: held-out error, prediction, the answer as JSON."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rthyb_rt.diagnose import engine
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.engine import Diagnosis
from rthyb_rt.diagnose.predict import Augmented, Prediction, nrmse, output_error, predict


@dataclass
class Outcome:
    """Answer and prediction of a diagnosis."""

    answer: dict[str, Any]
    model: Augmented
    prediction: Prediction | None = None
    heldout: dict[str, float] = field(default_factory=dict)


def finish(d: Diagnosis, heldout: Case | None, wanted: Case | None) -> Outcome:
    """Judge a diagnosis by a second recording, and predict another.

    Args:
        d: the diagnosis.
        heldout: a complete second recording.
        wanted: a second recording whose outputs are to be predicted.
    """
    model = engine.augmented(d)
    if d.case.model.family == "drive" and (heldout is not None or wanted is not None):
        model = engine.in_newtons(d, model)
    if heldout is not None or wanted is not None:
        model = output_error(model, d.case)
    errors: dict[str, float] = {}
    if heldout is not None:
        errors = _held_out(d, model, heldout)
        d.fit |= errors
        after = errors.get("heldout_nrmse_after", 0.0)
        before = errors.get("heldout_nrmse_before", np.inf)
        if d.verdict in ("explained", "ambiguous") and after > before:
            d.verdict, d.effects, d.ambiguous_with = "unknown", [], []
            d.notes.append("what was found does not hold on the second recording")
    prediction = predict(model, wanted, d.case) if wanted is not None else None
    return Outcome(engine.to_json(d), model, prediction, errors)


def _held_out(d: Diagnosis, model: Augmented, heldout: Case) -> dict[str, float]:
    plain = predict(engine.baseline(d), heldout, d.case)
    after = predict(model, heldout, d.case)
    out: dict[str, float] = {}
    f_name = "f_in" if d.case.model.family == "forced" else "f_meas"
    for channel, name in (("force", f_name), ("disp", "x_meas")):
        truth = heldout.channels.get(name)
        if truth is None:
            continue
        pair = ("f", "f") if channel == "force" else ("x", "x")
        out[f"heldout_nrmse_before_{channel}"] = nrmse(getattr(plain, pair[0]), truth)
        out[f"heldout_nrmse_after_{channel}"] = nrmse(getattr(after, pair[1]), truth)
    main = "disp" if d.channel == "disp" or d.case.model.family in ("ground", "forced") else "force"
    if not np.isfinite(out.get(f"heldout_nrmse_before_{main}", np.nan)):
        main = "force" if main == "disp" else "disp"
    for when in ("before", "after"):
        value = out.get(f"heldout_nrmse_{when}_{main}", np.nan)
        if np.isfinite(value):
            out[f"heldout_nrmse_{when}"] = value
    return {k: v for k, v in out.items() if np.isfinite(v)}
