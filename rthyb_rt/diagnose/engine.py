"""The stages of a diagnosis, from a case to a verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from rthyb_rt.diagnose import actuation, effects, estimate, force, localise
from rthyb_rt.diagnose.actuation import Actuation, ActuatorFit
from rthyb_rt.diagnose.case import Case, Floats, Model
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.predict import Augmented, nrmse, output_error, predict
from rthyb_rt.diagnose.select import Fit, Problem, inflation, price, refine
from rthyb_rt.diagnose.simulate import Motion

Verdict = Literal["none", "explained", "ambiguous", "unknown"]
Progress = Callable[[str], None]

LEFT = {1: 0.05, 2: 0.015, 3: 0.008}
"""Part of the misfit that a set of one, two, three effects may leave, beside noise, where the lab
states how well it knows its model: laws differ in form, but several laws fit almost anything."""
LEFT_FREE = 0.35
"""The same for a first model without stated tolerances: real specimens are not clean laws."""
SIMULATED = 5e-4
"""Least relative half-width of an interval: what two good simulators differ by."""
ESTIMATED = 2e-3
"""The same where the motion is estimated from noisy sensors."""
BLUR = 0.008
"""Part of the force that the estimate of a free body's motion may leave unexplained."""
BLUR_CELL = 0.002
"""The same where a load cell tells the force."""
SIMULATION = 0.012
"""NRMSE of a simulated displacement below which nothing is missing that could be named."""
NOISE_LEFT = 0.1
"""Misfit beyond noise, in units of the noise, that is never held against a set."""


@dataclass
class Found:
    """One effect that was found, or a rival.

    Attributes:
        score: weight of evidence against the other sets, 0 to 1.
        params, ci95: by name with units.
        evidence: fall of the information criterion when it is added, negative is better.
        signal: what it adds along the recording, N or m, (n,).
        shape: variant of its law and shape parameters, for the report.
    """

    name: str
    channel: Literal["force", "disp"]
    score: float
    params: dict[str, float]
    ci95: dict[str, list[float]]
    evidence: float
    signal: Floats | None = None
    shape: str = ""


@dataclass
class Displacement:
    """Outcome on the displacement channel."""

    task: Actuation
    null: ActuatorFit
    best: ActuatorFit
    equal: list[ActuatorFit]
    rivals: list[ActuatorFit]
    scale: float
    left: float
    known: bool

    @property
    def found(self) -> bool:
        """Whether an effect is named."""
        return bool(self.best.effects)


@dataclass
class Diagnosis:
    """All that was found out about a recording."""

    case: Case
    verdict: Verdict
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


def displacement(case: Case) -> Displacement | None:
    """Diagnose x_cmd -> x_meas; None where one of the three is missing."""
    base = case.model.actuator
    if base is None or "x_cmd" not in case.channels or "x_meas" not in case.channels:
        return None
    task = Actuation(case, base)
    if task.rows.size < 100:
        return None
    null, fits, scale = actuation.search(task)
    n = task.rows.size
    before = null.chi2 / n - 1.0
    size = float(np.std(task.x[task.rows])) / task.sigma
    plain = task.simulate(base)

    def worth(fit: ActuatorFit) -> bool:
        gain = null.misfit(scale) - fit.misfit(scale)
        # Against the model as given: a time offset may have taken part of it over already.
        moved = float(np.std((fit.motion.x - plain.x)[task.rows])) / task.sigma
        return gain > task.price(fit) and moved > force.SMALLEST * size

    def needed(fit: ActuatorFit) -> bool:
        explained = null.misfit(scale) - fit.misfit(scale)
        for effect in fit.effects:
            rest = tuple(sorted(e.name for e in fit.effects if e is not effect))
            without = next((f for f in fits if f.names == rest), None) if rest else null
            if without is None:
                continue
            own = without.misfit(scale) - fit.misfit(scale)
            if own < task.price(fit) / len(fit.effects):
                return False
            if rest and own < 1.5e-3 * explained:
                return False
        return True

    good = [f for f in fits if worth(f) and needed(f)]
    best = good[0] if good else null
    equal = [
        f
        for f in good
        if f is not best
        and f.misfit(scale)
        - best.misfit(scale)
        + 1.1 * force.AMBIGUOUS * max(0, f.count - best.count)
        < force.AMBIGUOUS
    ]
    after = best.chi2 / n - 1.0
    left = after / before if before > 0 else 0.0
    known = after < NOISE_LEFT or left < _allowed(case, len(best.effects) or 1)
    if not best.effects and before < NOISE_LEFT + 0.3:
        known = True
    rivals = [f for f in fits if f is not best][:5]
    return Displacement(task, null, best, equal, rivals, scale, left, known)


def _allowed(case: Case, size: int) -> float:
    if case.model.k_tol is None:
        return LEFT_FREE
    return LEFT.get(size, 0.008)


def settled(case: Case) -> int:
    """Return the first row that is no longer under the influence of an unknown start."""
    u = case.channels["x_cmd"]
    top = float(np.nanmax(np.abs(u))) or 1.0
    return 0 if abs(u[np.isfinite(u)][0]) < 1e-3 * top else int(actuation.MASK_S * case.fs_hz)


def motion_of(case: Case, disp: Displacement | None) -> Estimate | None:
    """Return the motion and the force, simulated where the actuator is understood."""
    if disp is not None and disp.known and disp.best.chi2 / disp.task.rows.size < 1.5:
        found = estimate.along(case, disp.best.motion, settled(case))
        if found is not None:
            return found
    if "x_meas" not in case.channels and "x_cmd" in case.channels and case.model.actuator:
        motion = simulated(case)
        return estimate.along(case, motion, settled(case))
    return estimate.from_sensors(case)


def simulated(case: Case) -> Motion:
    """Return the motion that the model's actuator makes of the command."""
    from rthyb_rt.diagnose.simulate import actuator

    assert case.model.actuator is not None
    return actuator(case.model.actuator, estimate.filled(case.channels["x_cmd"]), case.fs_hz)


def context_of(
    case: Case, found: Estimate, ranges: tuple[float, float, float] | None = None
) -> Context:
    """Return what force laws see of a recording."""
    other = {
        name: estimate.filled(values)
        for name, values in case.channels.items()
        if np.isfinite(values).any()
    }
    return Context(case.model, found.motion, case.t, found.force, other, ranges)


def diagnose(case: Case, progress: Progress = lambda _: None) -> Diagnosis:
    """Say what physics the model leaves out.

    Args:
        case: recording and model.
        progress: told the name of each stage.
    """
    progress("actuator")
    disp = displacement(case)
    found = motion_of(case, disp)
    search = ctx = None
    if found is not None and found.rows.sum() >= 50:
        progress("force laws")
        ctx = context_of(case, found)
        problem = Problem(case, ctx, found, effects.catalogue().values())
        search = force.search(problem, progress)
    progress("verdict")
    return _verdict(case, disp, found, ctx, search)


def _force_known(case: Case, search: force.Search) -> bool:
    """Return whether what was found leaves no more than the form of a law."""
    if not search.best.members:
        # Small colour that no law earns its price for is not a finding.
        return (
            search.excess_before < NOISE_LEFT + 0.15
            or case.model.k_tol is None
            or (_small(search, search.excess_before) and _within(search))
        )
    if search.excess_after < NOISE_LEFT or (search.scale < 1.5 and search.excess_after < 0.5):
        # At the noise, or above it without colour: the data sheet's figure is low.
        return True
    left = search.excess_after / max(search.excess_before, 1e-12)
    found = search.problem.estimate
    blur = 1.0 if found.exact else 2.5
    return _small(search, search.excess_after) or left < blur * _allowed(
        case, len(search.best.names)
    )


def _simulates(case: Case, search: force.Search | None) -> bool:
    """Return whether the model alone, its numbers moved within tolerance, simulates the record.

    Without a load cell this decides: a force that the displacement does not show is the smoother's.
    """
    m = case.model
    x_meas = case.channels.get("x_meas")
    free_body = m.family == "forced" or (m.family == "ground" and "f_meas" not in case.channels)
    if search is None or x_meas is None or not free_body or m.k_tol is None or m.k == 0:
        return False
    plain = Augmented(_with_nuisance(m, search, search.null), m, (), (), m.actuator, None)
    fitted = output_error(plain, case, force=True)
    reach = 3.6 * m.k_tol
    if abs(fitted.model.k / m.k - 1.0) > reach:
        return False
    if m.c and m.c_tol is not None and abs(fitted.model.c / m.c - 1.0) > 3.6 * m.c_tol:
        return False
    made = predict(fitted, case).x
    return nrmse(made, np.where(case.rows, x_meas, np.nan)) < SIMULATION


def _rounded(case: Case, search: force.Search, quantised: Found) -> bool:
    """Return whether the model with nothing in it stays within half a step of nearly all rows."""
    problem = search.problem
    rest = problem.estimate.force - problem.ctx.total
    for b, nuisance in zip(search.null.nuisance, problem.nuisances, strict=True):
        rest = rest - b * nuisance.column
    if search.best.members and search.gain > 400.0 and search.excess_after < 0.25:
        return False
    reach = 0.55 * quantised.params["lsb_N"] + 3.0 * (case.model.f_std or 0.0)
    return float(np.mean(np.abs(rest[problem.rows]) < reach)) > 0.98


def _small(search: force.Search, excess: float) -> bool:
    """Return whether a misfit is within what an estimated motion can tell of the force."""
    found = search.problem.estimate
    if found.exact:
        return False
    force_rms = float(np.sqrt(np.mean(found.force[found.rows] ** 2))) or 1.0
    least = BLUR_CELL if "f_meas" in search.problem.case.channels else BLUR
    return float(np.sqrt(max(excess, 0.0))) * found.sigma_n < least * force_rms


def _within(search: force.Search) -> bool:
    """Return whether the model alone meets the record without leaving its stated tolerances."""
    return all(
        n.sigma is None or abs(float(b)) < 3.6 * n.sigma
        for b, n in zip(search.null.nuisance, search.problem.nuisances, strict=True)
    )


def _verdict(
    case: Case,
    disp: Displacement | None,
    found: Estimate | None,
    ctx: Context | None,
    search: force.Search | None,
) -> Diagnosis:
    quantised = quantisation(case)
    disp_known = disp is None or disp.known
    force_known = search is None or _force_known(case, search)
    candidates: list[Found] = []
    names: list[str] = []
    sets: list[list[str]] = []
    named_force = search is not None and bool(search.best.members) and force_known
    if search is not None and _small(search, search.excess_before) and _within(search):
        stated = {n.name for n in search.problem.nuisances if n.sigma is not None}
        named_force = named_force and set(search.best.names) <= stated
    if named_force or not force_known:
        agreed = _simulates(case, search)
        if agreed:
            named_force, force_known = False, True
    if quantised is not None and search is not None and _rounded(case, search, quantised):
        # All that is left is what rounding leaves, and no force law.
        named_force, force_known = False, True
    named_disp = disp is not None and disp.found and disp_known
    if disp is not None and named_disp:
        candidates += _disp_found(disp)
        names += list(disp.best.names)
    if search is not None and ctx is not None and named_force:
        candidates += _force_found(search, ctx)
        names += list(search.best.names)
    if quantised is not None:
        candidates.append(quantised)
        names.append("quantisation")
    base_disp = list(disp.best.names) if disp is not None and named_disp else []
    base_force = list(search.best.names) if search is not None and named_force else []
    extra = ["quantisation"] if quantised is not None else []
    verdict: Verdict = "explained" if names else "none"
    if search is not None and named_force and search.equal:
        sets += [base_disp + list(f.names) + extra for f in [search.best, *search.equal]]
    if disp is not None and named_disp and disp.equal:
        sets += [list(f.names) + base_force + extra for f in [disp.best, *disp.equal]]
    unique: list[list[str]] = []
    for group in sets:
        if sorted(group) not in unique:
            unique.append(sorted(group))
    if unique:
        verdict = "ambiguous"
    if not disp_known or not force_known:
        verdict, names, unique = "unknown", [], []
    return _located(case, disp, found, ctx, search, verdict, names, candidates, unique)


def _located(
    case: Case,
    disp: Displacement | None,
    found: Estimate | None,
    ctx: Context | None,
    search: force.Search | None,
    verdict: Verdict,
    names: list[str],
    candidates: list[Found],
    sets: list[list[str]],
) -> Diagnosis:
    n = case.t.size
    motion = found.motion if found else (disp.best.motion if disp else None)
    channel: Literal["force", "disp"] = "force"
    mask = np.zeros(n, dtype=np.bool_)
    parts: list[Floats] = []
    residual = None
    if verdict == "unknown":
        if disp is not None and not disp.known:
            channel = "disp"
            residual = disp.task.x - disp.null.motion.x
            noise = disp.task.sigma
        elif search is not None and found is not None:
            residual, noise = robust_residual(search), found.sigma_n
        if residual is not None:
            clear = _without_noise(residual, noise, case.fs_hz)
            mask = localise.active(clear, case.fs_hz)
            parts = [clear]
    elif names:
        for c in candidates:
            if c.name in names and c.signal is not None:
                parts.append(c.signal)
                mask |= localise.active(c.signal, case.fs_hz)
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
    from rthyb_rt.diagnose.experiment import propose

    return Diagnosis(
        case, verdict, channel, names, candidates, sets, spans, x_m, v_m_s,
        _errors(disp, found, search, verdict), propose(case, ctx, disp, search, verdict, sets),
        disp, search, found, ctx, list(case.notes), residual,
    )  # fmt: skip


def _without_noise(residual: Floats, noise: float, fs_hz: float) -> Floats:
    """Return a residual with its noise averaged down over a fiftieth of a second."""
    k = max(int(0.02 * fs_hz) | 1, 1)
    smooth = np.convolve(np.pad(residual, k // 2, mode="edge"), np.ones(k) / k, mode="valid")
    level = noise / np.sqrt(k)
    return np.where(np.abs(smooth) > 3.5 * level, smooth, 0.0)


def robust_residual(search: force.Search) -> Floats:
    """Return the force residual with the nuisance fitted to what is not in the way, (n,), N.

    Least squares would bend stiffness and damping to take over part of what is missing.
    """
    problem = search.problem
    y, base = problem.y, problem.base
    rows = problem.nuisances
    weight: Any = np.ones(y.size)
    beta: Any = np.zeros(base.shape[1])
    for _ in range(12):
        gram = base.T @ (base * weight[:, None])
        for j, nuisance in enumerate(rows):
            if nuisance.sigma is not None:
                gram[j, j] += 1.0 / nuisance.sigma**2
        beta = np.linalg.solve(
            gram + np.diag(1e-12 * gram.diagonal() + 1e-30), base.T @ (weight * y)
        )
        rest = np.abs(y - base @ beta)
        size = max(1.5, 1.4826 * float(np.median(rest)))
        weight = 1.0 / (1.0 + (rest / (2.0 * size)) ** 2) ** 2
    out = problem.estimate.force - problem.ctx.total
    for b, nuisance in zip(beta, rows, strict=True):
        out = out - b * nuisance.column
    out = out.copy()
    out[~problem.estimate.rows] = 0.0
    return out


def _errors(
    disp: Displacement | None, found: Estimate | None, search: force.Search | None, verdict: str
) -> dict[str, float]:
    """Return NRMSE before and after: of the force where it was judged, else of the displacement."""
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
        rows = problem.rows
        target = found.force[rows]
        spread = float(np.std(target)) or 1.0
        before = (found.force - problem.ctx.total)[rows]
        fit = search.best if search.best.members and verdict != "unknown" else search.null
        model = problem.ctx.total.copy()
        for b, nuisance in zip(fit.nuisance, problem.nuisances, strict=True):
            model += b * nuisance.column
        for i in range(len(fit.members)):
            model += force.contribution(problem, fit, i)
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


def _force_found(search: force.Search, ctx: Context) -> list[Found]:
    """Return the effects of the best set, then rivals, with intervals and evidence."""
    problem = search.problem
    out: list[Found] = []
    fits = [search.best, *search.equal, *[f for f in search.rivals if f not in search.equal]]
    scores = np.array(
        [
            f.chi2
            + sum(price(problem, m.effect, m.effect.settings(ctx, m.trial)[1]) for m in f.members)
            for f in fits
        ]
    )
    weights = np.exp(-0.5 * np.clip(scores - scores.min(), 0, 700))
    weights /= weights.sum()
    seen: set[str] = set()
    for number, (fit, weight) in enumerate(zip(fits, weights, strict=True)):
        for i, m in enumerate(fit.members):
            params, ci = intervals(fit, i, ctx)
            if number == 0:
                _widen(ci, params, search, m.name, ctx)
            _of_the_spring_there_is(fit, m.name, params, ci)
            for name in m.effect.names:
                if name in seen:
                    continue
                seen.add(name)
                wanted = effects.params_of(name, m.effect)
                out.append(
                    Found(
                        name, "force", float(weight),
                        {k: v for k, v in params.items() if k in wanted},
                        {k: v for k, v in ci.items() if k in wanted},
                        -2.0 * 0.5 * (search.null.chi2 - fit.chi2),
                        force.contribution(problem, fit, i) if number == 0 else None,
                        f"{m.trial.variant} {m.trial.theta}".strip(),
                    )
                )  # fmt: skip
        if number and len(out) > 8:
            break
    return out


def _of_the_spring_there_is(
    fit: Fit, name: str, params: dict[str, float], ci: dict[str, list[float]]
) -> None:
    """Count what a spring loses as a part of the stiffness found, where the model's was wrong."""
    stiffer = sum(
        float(b[0]) for m, b in zip(fit.members, fit.betas, strict=True) if m.name == "stiffness"
    )
    key = {"degradation": "loss", "pinching": "depth", "hysteresis": "alpha"}.get(name)
    if key not in params or not stiffer > -0.9:
        return

    def counted(value: float) -> float:
        if key == "alpha":
            return 1.0 - (1.0 - value) / (1.0 + stiffer)
        return value / (1.0 + stiffer)

    params[key] = counted(params[key])
    ci[key] = [counted(end) for end in ci[key]]


def _widen(
    ci: dict[str, list[float]],
    params: dict[str, float],
    search: force.Search,
    name: str,
    ctx: Context,
) -> None:
    """Let intervals reach to what other forms of the same law come to; none is known to be true."""
    for fit in search.forms:
        for i, m in enumerate(fit.members):
            if m.name == name:
                other = m.effect.report(ctx, m.trial, fit.betas[i])
                for k, v in other.items():
                    ci[k] = [min(ci[k][0], v), max(ci[k][1], v)]
    # Rows whose noise hangs together a little tell less than their number.
    wider = float(np.sqrt(inflation(search.best.residual)))
    for k, v in params.items():
        ci[k] = [v + wider * (end - v) for end in ci[k]]
        half = (SIMULATED if search.problem.estimate.exact else ESTIMATED) * abs(v)
        ci[k] = [min(ci[k][0], v - half), max(ci[k][1], v + half)]


def intervals(
    fit: Fit, member: int, ctx: Context
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Return the parameters of one effect and their 95 % intervals."""
    m = fit.members[member]
    params = m.effect.report(ctx, m.trial, fit.betas[member])
    if fit.covariance is None:
        return params, {}
    shapes = [len(f.trial.theta) for f in fit.members]
    widths = [len(b) for b in fit.betas]
    has_shapes = fit.covariance.shape[0] == sum(shapes) + sum(widths) + fit.nuisance.size
    first_shape = sum(shapes[:member])
    first_beta = (sum(shapes) if has_shapes else 0) + sum(widths[:member])
    index = [first_shape + j for j in range(shapes[member])] if has_shapes else []
    index += [first_beta + j for j in range(widths[member])]
    cov = fit.covariance[np.ix_(index, index)]
    gradient: dict[str, list[float]] = {k: [] for k in params}
    from rthyb_rt.diagnose.effects.base import Trial

    for j in range(shapes[member] if has_shapes else 0):
        theta = list(m.trial.theta)
        theta[j] *= np.exp(1e-4)
        moved = m.effect.report(ctx, Trial(tuple(theta), m.trial.variant), fit.betas[member])
        for k in params:
            gradient[k].append((moved[k] - params[k]) / 1e-4)
    for j in range(widths[member]):
        beta = fit.betas[member].copy()
        step = 1e-4 * (abs(beta[j]) or 1e-12)
        beta[j] += step
        moved = m.effect.report(ctx, m.trial, beta)
        for k in params:
            gradient[k].append((moved[k] - params[k]) / step)
    ci = {}
    for k, value in params.items():
        g = np.array(gradient[k])
        half = 1.96 * float(np.sqrt(max(g @ cov @ g, 0.0)))
        ci[k] = [value - half, value + half]
    return params, ci


def _disp_found(disp: Displacement) -> list[Found]:
    out: list[Found] = []
    seen: set[str] = set()
    plain = disp.task.simulate(disp.task.base)
    fits = [disp.best, *disp.equal, *disp.rivals]
    scores = np.array([f.misfit(disp.scale) + disp.task.price(f) for f in fits])
    weights = np.exp(-0.5 * np.clip(scores - scores.min(), 0, 700))
    weights /= weights.sum()
    for number, (fit, weight) in enumerate(zip(fits, weights, strict=True)):
        j = 0
        for effect, values in zip(fit.effects, fit.values, strict=True):
            params = effect.report(disp.task.base, values)
            ci = {}
            for i, (k, v) in enumerate(params.items()):
                cov = fit.covariance
                half = SIMULATED * abs(v)
                if cov is not None:
                    half = max(
                        half, 1.96 * float(np.sqrt(max(cov[j + i, j + i], 0.0) * disp.scale))
                    )
                ci[k] = [v - half, v + half]
            j += len(values)
            if effect.name in seen:
                continue
            seen.add(effect.name)
            signal = None
            if number == 0:
                from dataclasses import replace

                changes: dict[str, Any] = dict(zip(effect.fields, values, strict=True))
                alone = replace(
                    disp.task.base, kappa_of=fit.model.kappa_of, vmax_of=fit.model.vmax_of,
                    **changes,
                )  # fmt: skip
                signal = disp.task.simulate(alone).x - plain.x
            out.append(
                Found(effect.name, "disp", float(weight), params, ci,
                      fit.misfit(disp.scale) - disp.null.misfit(disp.scale), signal)
            )  # fmt: skip
    return out


def quantisation(case: Case) -> Found | None:
    """Return a coarse load cell: few distinct readings, all on one grid."""
    f = case.get("f_meas")
    if f is None or case.model.f_std is None:
        return None
    lsb = estimate.step_of(f, case.model.f_std)
    if lsb == 0.0:
        return None
    return Found(
        "quantisation", "force", 1.0, {"lsb_N": lsb}, {"lsb_N": [0.999 * lsb, 1.001 * lsb]}, -100.0
    )


def to_json(d: Diagnosis) -> dict[str, Any]:
    """Return the answer in the interchange format."""
    known = [c for c in d.candidates if d.verdict != "unknown"]
    return {
        "schema": "rthyb-diagnose/1",
        "verdict": d.verdict,
        "effects": d.effects,
        "candidates": [
            {"name": c.name, "score": c.score, "params": c.params, "ci95": c.ci95,
             "delta_bic": c.evidence, "channel": c.channel}
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


def augmented(d: Diagnosis) -> Augmented:
    """Return the model with what was found in it; for an unknown verdict, with refitted numbers."""
    model = d.case.model
    search = d.force
    members: tuple[Any, ...] = ()
    betas: tuple[Floats, ...] = ()
    skew = 0.0
    fitted = model
    if search is not None:
        fit = search.best if d.verdict in ("explained", "ambiguous") else search.null
        free = model.k_tol is None
        if fit.members or not free:
            fitted = _with_nuisance(model, search, fit)
        members, betas = fit.members, fit.betas
    disp = d.disp
    lag = model.actuator
    if disp is not None and disp.known:
        lag = disp.best.model
    ranges = d.context.all_ranges if d.context is not None else None
    return Augmented(fitted, model, members, betas, lag, ranges, skew)


def in_newtons(d: Diagnosis, model: Augmented) -> Augmented:
    """Return the model fitted again with every newton of misfit counting alike.

    A naive model leaves misfit far above the noise: what predicts best then is plain least squares,
    not the weights of noise.
    """
    search = d.force
    if search is None or d.case.model.k_tol is not None or search.problem.estimate.exact:
        return model
    if d.verdict not in ("explained", "ambiguous") or not search.best.members:
        return model
    sigma = float(np.std(search.best.residual)) * search.problem.estimate.sigma_n or 1.0
    level = max(sigma, search.problem.estimate.sigma_n)
    plain = replace(search.problem.estimate, whiten=lambda y: y / level)
    problem = Problem(d.case, search.problem.ctx, plain, effects.catalogue().values())
    problem.rescale(max(1.0, float(np.mean(search.best.residual**2))))
    fit = refine(problem, search.best.members)
    if fit is None or not problem.sensible(fit):
        return model
    return replace(
        model, model=_with_nuisance(d.case.model, search, fit), members=fit.members, betas=fit.betas
    )


def _with_nuisance(model: Model, search: force.Search, fit: Fit) -> Model:
    for b, nuisance in zip(fit.nuisance, search.problem.nuisances, strict=True):
        if nuisance.name == "stiffness":
            model = replace(model, k=model.k * (1.0 + float(b)))
        elif nuisance.name == "viscous":
            model = replace(model, c=model.c + float(b))
        elif nuisance.name == "inertia":
            model = replace(model, moving_mass=max(model.moving_mass + float(b), 0.0))
    return model


def baseline(d: Diagnosis) -> Augmented:
    """Return the model as it was given."""
    m = d.case.model
    return Augmented(m, m, (), (), m.actuator, None)
