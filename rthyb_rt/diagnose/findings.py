"""What is told of each effect that was found, of where it acts, and of what it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import (
    effects,
    estimate,
    fitted,
    force,
    localise,
    modulation,
    noise_level,
    redundant,
    remainder,
)
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.effects.sensor import QUANTISATION
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.intervals import Sure, intervals, of_the_spring_there_is
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.result import DiagnosisResult, Displacement, Found
from rthyb_rt.diagnose.verdict import Verdict


def quantisation(case: Case) -> Found | None:
    """Return a load cell with coarse resolution: few distinct readings, all on one grid.

    Not if rounding adds no more to its noise than its data sheet may be wrong by.
    """
    f = case.get("f_meas")
    if f is None or case.model.f_std is None:
        return None
    lsb = noise_level.step_of(f, case.model.f_std)
    if lsb < POLICY.coarse_told * case.model.f_std:
        return None
    return Found(
        QUANTISATION.name,
        "force",
        1.0,
        {"lsb_N": lsb},
        {"lsb_N": [0.999 * lsb, 1.001 * lsb]},
        -100.0,
    )


def located(
    case: Case,
    disp: Displacement | None,
    found: Estimate | None,
    ctx: Context | None,
    search: force.Search | None,
    said: Verdict,
    candidates: list[Found],
) -> DiagnosisResult:
    n, verdict, names = case.t.size, said.said, list(said.names)
    sets = [list(names) for names in said.sets]
    motion = found.motion if found else (disp.best.motion if disp else None)
    channel: Literal["force", "disp"] = "force"
    mask = np.zeros(n, dtype=np.bool_)
    parts: list[Floats] = []
    residual = None
    if verdict == "unknown":
        if disp is not None and not disp.known:
            channel = "disp"
            residual = disp.task.x - disp.null.motion.x
            clear = remainder.without_noise(residual, disp.task.sigma, case.fs_hz)
        elif search is not None and found is not None:
            residual = remainder.robust_residual(search)
            clear = remainder.clear_residual(search)
        if residual is not None:
            mask = localise.active(clear, case.fs_hz)
            parts = [clear]
    elif names:
        for c in candidates:
            if c.name in names and c.signal is not None:
                parts.append(c.signal)
                acts = localise.active(c.signal, case.fs_hz)
                # The running rms extends half a window ahead.
                mask |= acts & (case.t >= (case.t[0] if c.from_s is None else c.from_s))
        if candidates and candidates[0].channel == "disp":
            channel = "disp"
    x_m, v_m_s = [0.0, 0.0], [0.0, 0.0]
    if motion is not None and parts:
        xs = [localise.ranges(p, mask, motion.x) for p in parts]
        vs = [localise.ranges(p, mask, motion.v) for p in parts]
        x_m = [min(r[0] for r in xs), max(r[1] for r in xs)]
        v_m_s = [min(r[0] for r in vs), max(r[1] for r in vs)]
    spans = localise.windows(mask, case.t)
    if verdict in ("explained", "unknown") and not spans:
        spans = [[float(case.t[0]), float(case.t[-1])]]
    from rthyb_rt.diagnose.next_experiment import propose

    return DiagnosisResult(
        case, verdict, channel, names, candidates, sets, spans, x_m, v_m_s,
        _errors(disp, found, search, verdict), propose(case, ctx, disp, search, verdict, sets),
        disp, search, found, ctx,
        [*case.notes, *_begun(candidates, names), *filter(None, [redundant.disagreement(case)])],
        residual, said.ledger,
    )  # fmt: skip


def _begun(candidates: list[Found], names: list[str]) -> list[str]:
    """Return a note for each named effect with an onset."""
    return [
        f"{c.name} begins at {c.from_s:.4g} s, but in the augmented model, and in a prediction "
        "of another recording, it acts throughout"
        for c in candidates
        if c.name in names and c.from_s is not None
    ]


def _errors(
    disp: Displacement | None, found: Estimate | None, search: force.Search | None, verdict: str
) -> dict[str, float]:
    """Return NRMSE before and after: of the force if it was evaluated, else of the displacement."""
    out: dict[str, float] = {}
    if disp is not None:
        rows = disp.task.rows
        spread = float(np.std(disp.task.x[rows])) or 1.0
        out["nrmse_before_disp"] = float(np.std((disp.task.x - disp.null.motion.x)[rows])) / spread
        best = disp.best if disp.known else disp.null
        if disp.found or not disp.known:
            plain = disp.task.simulate(disp.task.base)
            out["nrmse_before_disp"] = float(np.std((disp.task.x - plain.x)[rows])) / spread
        out["nrmse_after_disp"] = float(np.std((disp.task.x - best.motion.x)[rows])) / spread
    if search is not None and found is not None:
        problem = search.problem
        found = estimate.as_read(problem.case, found)
        # The entire recording, however little of it the search used.
        rows = np.flatnonzero(found.rows)
        # If no force acts, the force of the spring is the reference.
        spread = float(np.std(found.force[rows])) or float(np.std(problem.ctx.spring[rows])) or 1.0
        before = (found.force - problem.ctx.total)[rows]
        fit = search.best if search.best.members and verdict != "unknown" else search.null
        model = fitted.force_of(problem, fit)
        out["nrmse_before_force"] = float(np.std(before)) / spread
        out["nrmse_after_force"] = float(np.std((found.force - model)[rows])) / spread
    main = (
        "disp"
        if disp is not None and disp.found and not (search and search.best.members)
        else "force"
    )
    if f"nrmse_before_{main}" not in out:
        main = "disp" if "nrmse_before_disp" in out else "force"
    if f"nrmse_before_{main}" in out:
        out["nrmse_before"] = out[f"nrmse_before_{main}"]
        out["nrmse_after"] = out[f"nrmse_after_{main}"]
    return out


def force_found(
    search: force.Search, ctx: Context, motions: Sequence[ComputedMotion]
) -> list[Found]:
    """Return the effects of the best set, then rivals, with intervals and evidence.

    Args:
        search: the search.
        ctx: the quantities on which the laws depend.
        motions: one standard deviation away from that motion each.
    """
    problem, sure = search.problem, Sure(search, ctx, motions)
    out: list[Found] = []
    equal = {f.names for f in search.equal}
    fits = [search.best, *search.equal, *[f for f in search.rivals if f.names not in equal]]
    scores = np.array([f.chi2 + fitted.cost(problem, f) for f in fits])
    weights = np.exp(-0.5 * np.clip(scores - scores.min(), 0, 700))
    weights /= weights.sum()
    seen: set[str] = set()
    for number, (fit, weight) in enumerate(zip(fits, weights, strict=True)):
        for i, m in enumerate(fit.members):
            params, ci = intervals(fit, i, ctx) if number else sure.of(i)
            of_the_spring_there_is(problem, fit, m.name, params, ci)
            for name in m.effect.names:
                if name in seen:
                    continue
                seen.add(name)
                wanted = effects.params_of(name, m.effect)
                form, slope = modulation.in_form(m.effect, ctx, m.trial, fit.betas[i])
                out.append(
                    Found(
                        name, "force", float(weight),
                        {k: v for k, v in params.items() if k in wanted},
                        {k: v for k, v in ci.items() if k in wanted},
                        -2.0 * 0.5 * (search.null.chi2 - fit.chi2),
                        fitted.contribution(problem, fit, i) if number == 0 else None,
                        f"{m.trial.variant} {m.trial.theta}".strip(),
                        form,
                        float(ctx.t[0]) + m.trial.theta[-1] if m.effect.late else None,
                        slope,
                    )
                )  # fmt: skip
        if number and len(out) > 8:
            break
    return out


def motions_around(disp: Displacement | None, found: Estimate | None) -> list[ComputedMotion]:
    """Return motions one standard deviation away from that of a fitted actuator."""
    if disp is None or found is None or not found.exact:
        return []
    return disp.task.around(disp.best, disp.scale, found.motion)


def displacement_found(disp: Displacement) -> list[Found]:
    out: list[Found] = []
    seen: set[str] = set()
    plain = disp.task.simulate(disp.task.base)
    fits = [disp.best, *disp.equal, *disp.rivals]
    scores = np.array([f.misfit(disp.scale) + disp.task.price(f) for f in fits])
    weights = np.exp(-0.5 * np.clip(scores - scores.min(), 0, 700))
    weights /= weights.sum()
    for number, (fit, weight) in enumerate(zip(fits, weights, strict=True)):
        j, known = 0, fit.known(disp.scale)
        if number == 0 and fit.effects:
            known = known + disp.task.of_form(fit)
        reach = fit.chi2 + POLICY.form_alone * (disp.null.chi2 - fit.chi2)
        others = [o for o in fit.others if o.chi2 < reach]
        for place, (effect, values) in enumerate(zip(fit.effects, fit.values, strict=True)):
            params = effect.report(disp.task.base, values)
            forms = [effect.report(disp.task.base, o.values[place]) for o in others]
            ci = {}
            for i, (k, v) in enumerate(params.items()):
                half = 1.96 * float(np.sqrt(max(known[j + i, j + i], 0.0)))
                half = max(half, POLICY.interval_simulated * abs(v))
                # As for the force: another form of the effect that is nearly as good.
                half = max([half, *(abs(o[k] - v) for o in forms if number == 0)])
                ci[k] = [v - half, v + half]
            j += len(values)
            if effect.name in seen:
                continue
            seen.add(effect.name)
            signal = None
            since = fit.before[0] if fit.before and effect.late else 0.0
            if number == 0:
                changes: dict[str, Any] = dict(zip(effect.fields, values, strict=True))
                alone = replace(
                    disp.task.base, kappa_of=fit.model.kappa_of, vmax_of=fit.model.vmax_of,
                    **changes,
                )  # fmt: skip
                signal = disp.task.simulate(alone, (since, disp.task.base)).x - plain.x
            begins = float(disp.task.case.t[0]) + since * disp.task.case.dt
            form = f"{effect.equation}, from {begins:.5g} s on" if effect.late else ""
            from_s = begins if effect.late else None
            out.append(
                Found(effect.name, "disp", float(weight), params, ci,
                      fit.misfit(disp.scale) - disp.null.misfit(disp.scale), signal, form=form,
                      from_s=from_s)
            )  # fmt: skip
    return out
