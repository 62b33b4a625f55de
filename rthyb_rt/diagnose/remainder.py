"""The residual of model and effects in the force, and what `verdict` needs to know about it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import (
    estimate,
    fitted,
    instants,
    memory,
    noise,
    noise_level,
    steady,
    stroke,
    varying,
    verdict,
    whitening,
)
from rthyb_rt.diagnose.case import Case, Floats, Model
from rthyb_rt.diagnose.court import Ruling
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.evidence import held_out_gain
from rthyb_rt.diagnose.force import RIVALS, Search, unscaled
from rthyb_rt.diagnose.freebody import Body, judged
from rthyb_rt.diagnose.intervals import Sure
from rthyb_rt.diagnose.motion_fitter import AGAIN, SETTLED
from rthyb_rt.diagnose.policy import POLICY, SIDES
from rthyb_rt.diagnose.predict import Augmented, nrmse, output_error, predict
from rthyb_rt.diagnose.problem import Fit, ResidualProblem
from rthyb_rt.diagnose.verdict import Asked, Left, Reproduced, Rounded, Simulated

DRAWN = 4
"""Number of errors of an estimated motion from which their size at each row is taken: the standard
error of that of three rows is a fifth."""


def left_by(search: Search, fit: Fit) -> Floats:
    """Return the residual of the force with model, effects and fitted nuisance, (n,), N."""
    return search.problem.estimate.force - fitted.force_of(search.problem, fit)


def bend(problem: ResidualProblem, fit: Fit) -> float:
    """Return the largest change of a stated value by a fit, in standard deviations."""
    pairs = zip(fit.nuisance, problem.nuisances, strict=True)
    moved = (abs(float(b)) / n.sigma for b, n in pairs if n.sigma is not None and n.stated)
    return max(moved, default=0.0)


def part_of_force(search: Search, fit: Fit, excess: float) -> float:
    """Return a misfit beyond noise, rms, relative to the force.

    No force acts in a free decay, so the noise of such a force is no measure of the residual.
    """
    found, rows = search.problem.estimate, search.problem.estimate.rows
    if not np.any(found.force):
        whole = search.problem.ctx.spring
        rest = float(np.sqrt(np.mean(left_by(search, fit)[rows] ** 2)))
        return rest / (float(np.sqrt(np.mean(whole[rows] ** 2))) or 1e-300)
    force_rms = float(np.sqrt(np.mean(found.force[rows] ** 2))) or 1.0
    return float(np.sqrt(max(excess, 0.0))) * found.sigma_n / force_rms


def _part_explained(search: Search) -> float:
    """Return the reduction of the residual by the best set, rms, relative to the force.

    For coloured noise, a misfit in units of that noise does not show its size in newtons: a slow
    misfit is small relative to slow noise. 0 for white noise, for which it does.
    """
    found, rows = search.problem.estimate, search.problem.estimate.rows
    if not found.coloured or not np.any(found.force):
        return 0.0
    null, best, force = (
        float(np.mean(part[rows] ** 2))
        for part in (left_by(search, search.null), left_by(search, search.best), found.force)
    )
    return float(np.sqrt(max(null - best, 0.0) / max(force, 1e-300)))


def left_of(search: Search) -> Left:
    """Return the result of a search in the form that `verdict` requires."""
    problem, best, found = search.problem, search.best, search.problem.estimate
    exact, naive = found.exact, problem.case.model.k_tol is None
    # Not needed if model and motion are known.
    known = exact and not naive
    before = 0.0 if known else part_of_force(search, search.null, search.excess_before)
    after = 0.0 if exact else part_of_force(search, best, search.excess_after)
    return Left(
        names=best.names,
        equal=tuple(f.names for f in search.equal),
        laws=len(best.members),
        curves=sum(m.effect.curve for m in best.members),
        before=search.excess_before,
        after=search.excess_after,
        scale=search.scale,
        part_before=before if exact else max(before, _part_explained(search)),
        part_after=after,
        bent=bend(problem, search.null),
        bent_after=bend(problem, best),
        stated=frozenset(n.name for n in problem.nuisances if n.sigma is not None),
        price=fitted.cost(problem, best),
        naive=naive,
        exact=exact,
        coloured=found.coloured,
        moved=search.moved,
        quiet=search.quiet,
        late=any(m.effect.late for m in best.members),
        cell="f_meas" in problem.case.channels and bool(np.any(found.force)),
        loud=loud(search),
        of_force=_left_in_force(search),
    )


def _left_in_force(search: Search) -> float:
    """Return the fraction of the model's residual that the best set leaves in the force as it is.

    In power, beyond the noise. In units of a coloured noise, what is slow counts for little,
    however large it is.
    """
    passed, rows = _passed_on(search, search.best), search.problem.estimate.rows
    sheet = stated(search.problem.case) or 0.0
    # Where the set is steep, the error of an estimated motion may be louder in its force than the
    # load cell: what it leaves is seen elsewhere, if that is most of the recording.
    calm = rows & (passed <= sheet**2)
    if 2 * np.count_nonzero(calm) < np.count_nonzero(rows):
        calm = rows
    credit = sheet**2 + np.minimum(passed, sheet**2)
    null, best = (
        float(np.mean((left_by(search, fit) ** 2 - credit)[calm]))
        for fit in (search.null, search.best)
    )
    if null <= 0.0:
        return float(best > 0.0)
    return max(best, 0.0) / null


def _passed_on(search: Search, fit: Fit) -> Floats:
    """Return what the error of an estimated motion does to the force of a set, N^2, (n,).

    Like a slider while it sticks, or a fluid damper at each reversal, it may be steep for a while.
    """
    problem, blur = search.problem, search.problem.estimate.blur
    size = problem.ctx.t.size
    power = np.zeros(size)
    if blur is None or not problem.estimate.coloured:
        return power  # nor is it asked for
    for shift in size * np.arange(DRAWN) // DRAWN:
        # It is stationary: shifted, it is another draw of the same error.
        x, v, a, direct = (
            np.roll(part, shift) for part in (blur.error.x, blur.error.v, blur.error.a, blur.direct)
        )
        change = fitted.change(problem, fit, ComputedMotion(x, v, a))
        power = np.asarray(power + (direct + change) ** 2)
    # Which of two readings is the first one beyond a corner is chance.
    power = np.convolve(power, np.ones(3) / (3.0 * DRAWN), mode="same")
    return power if np.isfinite(power).all() else np.zeros(size)


def loud(search: Search) -> bool:
    """Return whether the model alone leaves more than the force's data sheet permits for noise.

    Along an estimated motion with the error of that motion; never for that of a free body, whose
    accuracy near resonance no data sheet covers.
    """
    found, sheet = search.problem.estimate, stated(search.problem.case)
    if not sheet or search.moved:
        return False
    if not found.exact:
        if found.blur is None or found.blur.accuracy > 0.0:
            return False
        sheet = float(np.hypot(sheet, found.blur.rms))
    rest = left_by(search, search.null)[found.rows]
    return not whitening.within_sheet(rest, sheet, found.scatter)


def understood(search: Search) -> bool:
    """Return whether the residual of the effects found may be due to the form of a law."""
    return verdict.understood(left_of(search), POLICY, lambda: by_the_sheet(search))


def blurred(search: Search) -> bool:
    """Return whether the model alone is within the accuracy of an estimated motion."""
    left = left_of(search)
    return verdict.small(left, left.part_before, POLICY) and verdict.within(left.bent, POLICY)


def stated(case: Case) -> float | None:
    """Return the noise that the data sheet of the force states, N."""
    forced = case.model.family == "forced"
    return noise_level.force_sheet(case.get("f_in" if forced else "f_meas"), case.model.f_std)


def by_the_sheet(search: Search) -> bool:
    """Return whether the residual is within the load cell's data sheet.

    A data sheet does not state the colour of the noise; only its white part is measured. A residual
    that no law explains, that is within the sheet and has no bursts, cannot be distinguished from
    noise, whether a set is named or not. Readings in which a law's force jumps are no burst, but
    they count as noise like all others.
    """
    case, found = search.problem.case, search.problem.estimate
    # Where a coarse load cell is evaluated, its rounding is no noise.
    sheet = stated(case) if found.read is None else found.sigma_n
    if not sheet or not verdict.within(bend(search.problem, search.best), POLICY):
        return False
    rest = left_by(search, search.best)
    white = even = found.whiten(rest)[found.rows]
    if not noise.steady(white, case.fs_hz):
        calm = instants.without_readings(search.problem, search.best, rest)
        even = found.whiten(calm)[found.rows]
    blur = 0.0 if found.blur is None else found.blur.rms
    if found.coloured and found.blur is not None:
        # No sheet covers the error of an estimated motion; its colour was limited by its own.
        count = found.share * white.size
        most = 1.0 + POLICY.excess_as_noise + POLICY.power_scatter * np.sqrt(2.0 / count)
        if float(white @ white) < most * count and noise.steady(even, case.fs_hz):
            return True
    most_n = float(np.hypot(sheet * (1.0 + found.scatter), blur))
    return "f_meas" in case.channels and noise.mere(rest[found.rows], even, most_n, case.fs_hz)


def simulated(search: Search) -> Simulated | None:
    """Return how the model alone, with fitted parameters, simulates a body without load cell.

    None if the recording is not of such a body, so that its motion is not decisive.
    """
    case, m = search.problem.case, search.problem.case.model
    x_meas = case.channels.get("x_meas")
    free_body = m.family == "forced" or (m.family == "ground" and "f_meas" not in case.channels)
    if x_meas is None or not free_body or m.k_tol is None or m.k == 0:
        return None
    plain = Augmented(with_nuisance(m, search.problem, search.null), m, (), (), m.actuator, None)
    fitted = output_error(plain, case, force=True)
    k_off, c_off = abs(fitted.model.k / m.k - 1.0) / max(m.k_tol, 1e-300), 0.0
    if m.c and m.c_tol is not None:
        c_off = abs(fitted.model.c / m.c - 1.0) / max(m.c_tol, 1e-300)
    made = predict(fitted, case).x
    spread = float(np.nanstd(x_meas)) or 1.0
    return Simulated(
        k_off,
        c_off,
        nrmse(made, np.where(case.rows, x_meas, np.nan)),
        noise_level.noise_of(x_meas, m.x_std) / spread,
    )


def reproduced(search: Search, ctx: Context) -> Reproduced | None:
    """Return how the best set, and the model alone, simulate a body without load cell.

    None if the recording is not of such a body, or if an effect of the set acts from some time on
    or with another channel: its force is known only along a motion.
    """
    case, fit = search.problem.case, search.best
    if not judged(case):
        return None
    body = Body(case, ctx)
    if not body.in_core(fit):
        return None

    alone, found = (_settled(body, search.problem, f) for f in (search.null, fit))

    def excess(of: Fit | None) -> float:
        return np.inf if of is None else of.chi2 / body.rows.size - 1.0

    def quiet(of: Fit | None) -> bool:
        return of is not None and body.quiet(of)

    bent = bend(search.problem, alone) if alone is not None else np.inf
    return Reproduced(excess(alone), excess(found), bent, quiet(alone), quiet(found))


def _settled(body: Body, problem: ResidualProblem, fit: Fit) -> Fit | None:
    """Return a set fitted to its simulated motion, again as long as that improves it clearly."""
    found = body.settled(problem, fit)
    for _ in range(AGAIN):
        if found is None or found.chi2 < POLICY.motion_met_alone * body.rows.size:
            break
        more = body.settled(problem, found)
        if more is None or more.chi2 > (1.0 - SETTLED) * found.chi2:
            break
        found = more
    return found


NAMELESS = {"varying": varying.gain, "stroke": stroke.gain, "memory": memory.gain}
"""Laws outside the catalogue with which a set is compared, by the rule of `verdict`."""


def asked(search: Search, ctx: Context | None, what: Asked) -> Any:
    """Return what `verdict` asks for."""
    if what == "sheet":
        return by_the_sheet(search)
    if what == "simulated":
        return simulated(search)
    if what == "reproduced":
        return None if ctx is None else reproduced(search, ctx)
    if what == "changes":
        return {c.part: c.deviations for c in steady.changes(search.problem, search.best)}
    if what in NAMELESS:
        return NAMELESS[what](search.problem, search.best)
    return None if ctx is None else min(_strengths(search, ctx))


def _strengths(search: Search, ctx: Context) -> list[float]:
    """Return the strength of each effect of the best set; infinite if it has no size."""
    sure = Sure(search, ctx)
    sizes = map(sure.strength, range(len(search.best.members)))
    return [np.inf if s is None else s for s in sizes]


def without_unsure(search: Search, ctx: Context) -> Search:
    """Return the search with the set without effects whose size may be zero.

    By 1.96 standard deviations, see `Sure.strength`. Evidence counts rows; these include more, such
    as the scatter between parts of the recording and the forms of the laws. Not if other sets fit
    as well, nor if the rest leaves more than noise: the interval is then wide for what no law
    explains, as for a naive model. Along a simulated motion, which shows the error of every form,
    the rest must be within that of its own laws, and within the tolerances.
    """
    problem = search.problem
    if problem.case.model.k_tol is None:
        return search
    while len(search.best.members) > 1 and not search.equal:
        best = search.best
        found, which = min((s, i) for i, s in enumerate(_strengths(search, ctx)))
        rest = replace(best, members=best.members[:which] + best.members[which + 1 :])
        fit = next((f for f in search.fits if f.names == rest.names), None)
        if found >= SIDES**2 or fit is None:
            break
        part = best.members[which].name
        ruling = Ruling("unsure", best.names, part, found, SIDES**2, fit.names)
        # What it was beside the other one is a form of it as well.
        less = replace(
            _with_best(search, fit, [best, *search.forms]),
            gain=search.null.chi2 - fit.chi2 - fitted.cost(problem, fit),
            held_gain=held_out_gain(problem, fit), ledger=(*search.ledger, ruling),
        )  # fmt: skip
        noise = less.excess_after < POLICY.excess_as_noise
        plain = search.moved and verdict.within(bend(problem, fit), POLICY)
        if not (noise or plain) or not understood(less):
            break
        search = less
    return search


# ---- a coarse load cell -------------------------------------------------------------------------


def beyond(search: Search, fit: Fit, lsb_n: float) -> float:
    """Return the fraction of rows with a residual beyond rounding and noise."""
    problem = search.problem
    rest = left_by(search, fit)
    reach = 0.5 * lsb_n + POLICY.rounded_noise * (problem.case.model.f_std or 0.0)
    read = problem.estimate.read
    return float(np.mean(np.abs(rest[problem.rows if read is None else read]) > reach))


def rounded(search: Search, name: str, lsb_n: float) -> Rounded:
    """Return how much of the residual the quantisation of a load cell explains."""
    found = search.problem.estimate
    missing = left_by(search, search.null)[found.rows if found.read is None else found.read]
    return Rounded(
        name,
        lsb_n**2 / 12.0 / max(float(np.mean(missing**2)), 1e-300),
        search.gain,
        beyond(search, search.null, lsb_n),
        beyond(search, search.best, lsb_n),
        exact=found.read is not None,
    )


def within_rounding(search: Search, lsb_n: float) -> Search:
    """Return the search with the set that stays within rounding, if the best one does not."""
    if search.moved or not search.best.members:
        return search
    problem = search.problem
    fits: dict[verdict.Names, Fit] = {}
    for f in (search.best, *search.fits):
        fits.setdefault(f.names, f)
    sets = tuple(
        verdict.Coarse(f.names, fitted.count(problem, f), f.chi2, beyond(search, f, lsb_n))
        for f in fits.values()
    )
    own = tuple(f.names for f in search.equal)
    name, equal = verdict.within_rounding(sets, own, POLICY)
    return replace(_with_best(search, fits[name], []), equal=[fits[e] for e in equal])


def _with_best(search: Search, fit: Fit, forms: list[Fit]) -> Search:
    """Return a search that names another one of its sets."""
    scale, moved = search.scale, search.moved
    noise = unscaled(search.best, scale, moved) / (1.0 + search.excess_after)
    after = unscaled(fit, scale, moved) / noise - 1.0
    rivals = [f for f in search.fits if f is not fit][:RIVALS]
    return replace(search, best=fit, excess_after=after, rivals=rivals, forms=forms)


# ---- location of the residual -------------------------------------------------------------------


def without_noise(residual: Floats, noise: float, fs_hz: float, share: float = 1.0) -> Floats:
    """Return a residual with its noise averaged over a short time.

    Args:
        residual: (n,).
        noise: standard deviation of its noise where it is white.
        fs_hz: rows per second.
        share: fraction of the band that contains noise: slower noise is not averaged out.
    """
    k = max(int(POLICY.located_mean_s * fs_hz) | 1, 1)
    smooth = np.convolve(np.pad(residual, k // 2, mode="edge"), np.ones(k) / k, mode="valid")
    level = noise * np.sqrt(min(share, 1.0 / k))
    return np.where(np.abs(smooth) > POLICY.located_noise * level, smooth, 0.0)


def clear_residual(search: Search) -> Floats:
    """Return the force residual where it is above its noise, (n,), N.

    The noise of the force along an estimated motion has any colour, and is far above that of the
    sensors where the motion is poorly known: if it dominates the residual, it is whitened first.
    """
    found = estimate.as_read(search.problem.case, search.problem.estimate)
    residual = robust_residual(search)
    white = np.where(found.rows, found.sigma_n * found.whiten(residual), 0.0)
    fs_hz = search.problem.case.fs_hz
    if not found.exact and np.std(residual) > POLICY.located_white * np.std(white):
        return without_noise(white, found.sigma_n, fs_hz, found.share)
    return without_noise(residual, found.sigma_n, fs_hz)


def robust_residual(search: Search) -> Floats:
    """Return the force residual with the nuisance fitted outside the effect, (n,), N.

    Least squares would adjust stiffness and damping to absorb part of a missing effect. A missing
    effect is not noise of many independent rows either, and must not outweigh the model's
    tolerances: a stated value moves no farther than its tolerance permits.
    """
    problem = search.problem
    sigmas = [n.sigma for n in problem.nuisances]
    prior = np.array([0.0 if s is None else s**-2.0 for s in sigmas])
    reach = np.array([np.inf if s is None else POLICY.located_bend * s for s in sigmas])
    for _ in range(20):
        beta = _robust(problem, prior)
        over = np.abs(beta) > reach
        if not over.any():
            break
        prior[over] *= 4.0
    found = estimate.as_read(problem.case, problem.estimate)
    out = found.force - problem.ctx.total
    for b, nuisance in zip(beta, problem.nuisances, strict=True):
        out = out - b * nuisance.column
    return np.where(found.rows, out, 0.0)


def _robust(problem: ResidualProblem, prior: Floats) -> Floats:
    """Return the nuisance parameters with a loss that ignores outliers, and prior weights."""
    y, base = problem.y, problem.base
    weight: Any = np.ones(y.size)
    beta: Any = np.zeros(base.shape[1])
    for _ in range(12):
        gram = base.T @ (base * weight[:, None]) + np.diag(prior)
        beta = np.linalg.solve(
            gram + np.diag(1e-12 * gram.diagonal() + 1e-30), base.T @ (weight * y)
        )
        rest = np.abs(y - base @ beta)
        size = max(1.5, 1.4826 * float(np.median(rest)))
        weight = 1.0 / (1.0 + (rest / (2.0 * size)) ** 2) ** 2
    return np.asarray(beta)


def with_nuisance(model: Model, problem: ResidualProblem, fit: Fit) -> Model:
    for b, nuisance in zip(fit.nuisance, problem.nuisances, strict=True):
        model = nuisance.moves(model, float(b))
    return replace(model, moving_mass=max(model.moving_mass, 0.0))
