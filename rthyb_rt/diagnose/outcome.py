"""Results derived from a diagnosis: held-out error, prediction, the answer as JSON."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import closed, found_model, result
from rthyb_rt.diagnose.augment import rig_toml
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.closed import ClosedLoop
from rthyb_rt.diagnose.next_experiment import OF_UNKNOWN
from rthyb_rt.diagnose.predict import Augmented, Prediction, nrmse, output_error, predict
from rthyb_rt.diagnose.recovered import Recovered, recover
from rthyb_rt.diagnose.result import DiagnosisResult
from rthyb_rt.errors import InputError, RthybError


@dataclass
class Outcome:
    """Answer and prediction of a diagnosis.

    Attributes:
        closed: repeated simulation of the whole test; None if it is not a recording of this
            program.
        recovered: delay estimate and tangent stiffness of a closed loop run by another program.
    """

    answer: dict[str, Any]
    model: Augmented
    prediction: Prediction | None = None
    heldout: dict[str, float] = field(default_factory=dict)
    closed: ClosedLoop | None = None
    recovered: Recovered | None = None


def finish(d: DiagnosisResult, heldout: Case | None, wanted: Case | None) -> Outcome:
    """Validate a diagnosis on a second recording, and predict another.

    Args:
        d: the diagnosis.
        heldout: a complete second recording.
        wanted: a second recording whose outputs are to be predicted.
    """
    model = found_model.augmented(d)
    if d.case.model.family == "drive" and (heldout is not None or wanted is not None):
        model = found_model.in_newtons(d, model, wanted or heldout)
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
            d.next_experiment = dict(OF_UNKNOWN)
            d.notes.append("the effects found are not confirmed by the second recording")
    prediction = predict(model, wanted, d.case) if wanted is not None else None
    out = Outcome({**result.to_json(d), "notes": list(d.notes)}, model, prediction, errors)
    _close(d, out)
    return out


def _close(d: DiagnosisResult, out: Outcome) -> None:
    """Simulate the whole loop again, or recover from its signals what they determine."""
    if d.case.axis:
        why = "one of several axes cannot be simulated without the others"
        out.answer["closed_loop"] = {"possible": False, "why": why}
    elif d.case.own is not None:
        try:
            out.closed = close_loop(d, out.model)
            out.answer["closed_loop"] = out.closed.to_json()
        except RthybError as error:
            out.answer["closed_loop"] = {"possible": False, "why": str(error)}
    elif d.case.model.family == "loop":
        why = "a CSV recording contains neither the controller's settings nor the test"
        out.answer["closed_loop"] = {"possible": False, "why": why}
        out.recovered = recover(d.case)
        out.answer["recovered"] = out.recovered.to_json()


def close_loop(d: DiagnosisResult, model: Augmented) -> ClosedLoop:
    """Simulate a recorded test of this program with the model as given and with another.

    Raises:
        RthybError: the test cannot be repeated, or a model cannot be a rig.
    """
    rec = d.case.own
    if rec is None:
        raise InputError("the recording was not made by this program, so its test is not known")
    base = closed.same_actuator(d.case.model, rec)
    plain = found_model.baseline(d)
    texts = []
    for m in (plain, model):
        text, lost = rig_toml(
            replace(m, model=replace(m.model, rig=base.rig), base=replace(m.base, rig=base.rig))
        )
        texts.append(text)
    law, beside = _law_beside(model, lost)
    result = closed.resimulate(rec, texts[0], texts[1], law)
    lost = [name for name in lost if name not in beside]
    if lost:
        result.notes.append(
            f"simulated without {', '.join(lost)}, which a rig file cannot represent"
        )
    return result


def _held_out(d: DiagnosisResult, model: Augmented, heldout: Case) -> dict[str, float]:
    plain = predict(found_model.baseline(d), heldout, d.case)
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


def _law_beside(model: Augmented, lost: list[str]) -> tuple[closed.Law | None, set[str]]:
    """Return the force of momentary effects that a rig file cannot represent, and their names."""
    found = [
        (member, beta)
        for member, beta in zip(model.members, model.betas, strict=True)
        if member.name in lost and member.effect.momentary
    ]
    if not found:
        return None, set()
    own = replace(model, members=tuple(m for m, _ in found), betas=tuple(b for _, b in found))
    t = np.zeros(1)

    def law(x_m: float, v_m_per_s: float) -> float:
        motion = ComputedMotion(np.array([x_m]), np.array([v_m_per_s]), t)
        return float(own.effect_force(motion, t, {})[0])

    return law, {m.name for m, _ in found}
