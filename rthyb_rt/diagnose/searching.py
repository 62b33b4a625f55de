"""Searches for force laws in coloured noise, along better motions and in the whole rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rthyb_rt.diagnose import (
    actuation,
    effects,
    estimate,
    fitted,
    force,
    freebody,
    gaps,
    noise,
    noise_level,
    remainder,
    rigged,
    whitening,
)
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.gaps import Mask
from rthyb_rt.diagnose.motion_evaluated import context_of
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.diagnose.refinement import refine
from rthyb_rt.diagnose.result import Progress
from rthyb_rt.diagnose.verdict import simulates

Anew = Callable[[ResidualProblem, list[tuple[Member, ...]]], force.Search]
"""Searches a problem again, with these sets among those that are refined."""

FEWER = 2
"""Number of sets with fewer laws whose motion is examined."""
NEWTON_STEPS = 12
"""Largest number of steps by which a set is refined by a coarse load cell's readings."""
ROUNDS = 3
"""Number of searches by these readings, each near the set found by the last one."""
PASSES = 2
"""Number of simulations of such a motion, the second one with the effects found along it."""


def in_its_noise(
    case: Case, found: Estimate, search: force.Search, anew: Anew, progress: Progress
) -> tuple[Estimate, force.Search]:
    """Search again with coloured noise, if a set together with such noise is likelier.

    The residual of a set fitted with white noise lacks the slow noise that the set has absorbed:
    each set is tried with the colour of its own residual, including the empty set.
    """
    blur = found.blur
    # Along an estimated motion, the residual of a naive model is due to form, not readable noise;
    # nor does an absent force have noise.
    bounded = blur is not None and case.model.k_tol is not None and not search.problem.decays
    if found.read is not None:
        return _by_intervals(case, found, search, anew, progress)
    if not found.exact and not bounded:
        return found, search
    sheet, sigma = remainder.stated(case), found.sigma_n if blur is None else blur.sigma_n

    problem = search.problem
    sets = {id(f): f for f in (search.null, *search.fits[: noise.TRIED], *search.pool)}
    tried = [
        (
            found.begun(remainder.left_by(search, fit), case.fs_hz),
            found.motion.v,
            fitted.cost(problem, fit),
        )
        for fit in sets.values()
    ]
    blurs = None if blur is None else [blur] * len(tried)
    if blur is not None and sheet:
        changes = (fitted.change(problem, fit, blur.error) for fit in sets.values())
        blurs = blur.behind(changes, case.fs_hz)
    own = whitening.likeliest(tried, found.rows, case.fs_hz, sigma, sheet, blurs)
    if own is None:
        return found, search
    progress("noise")
    now = replace(found, scatter=own.scatter, share=own.share)
    now = now.whitened(own.whiten, own.pieces, case.fs_hz)
    problem = ResidualProblem(case, problem.ctx, now, effects.catalogue().values())
    return now, anew(problem, [f.members for f in search.pool])


def _by_intervals(
    case: Case, found: Estimate, search: force.Search, anew: Anew, progress: Progress
) -> tuple[Estimate, force.Search]:
    """Search again by the likelihood of the readings of a coarse load cell near the best set.

    Again near the next best one, if that is another.
    """
    for _ in range(ROUNDS):
        before = search.best.names
        found = _near_the_best(case, found, search)
        progress("steps")
        problem = ResidualProblem(case, search.problem.ctx, found, effects.catalogue().values())
        search = anew(problem, [f.members for f in search.pool])
        if search.best.names == before:
            break
    return found, search


def _near_the_best(case: Case, found: Estimate, search: force.Search) -> Estimate:
    """Return the readings of a coarse load cell as forces near the best set refined by them."""
    problem, fit = search.problem, search.best
    near = fitted.force_of(problem, fit)
    for _ in range(NEWTON_STEPS):
        closer = estimate.by_intervals(case, found, near)
        problem = ResidualProblem(case, problem.ctx, closer, effects.catalogue().values())
        refined = refine(problem, fit.members)
        if refined is None:
            break
        found, fit, before, near = closer, refined, near, fitted.force_of(problem, refined)
        moved = float(np.sqrt(np.mean((near - before)[found.rows] ** 2)))
        if moved < POLICY.coarse_settled * found.sigma_n:
            break
    return found


def away_from_rest(
    case: Case, found: Estimate, search: force.Search, anew: Anew, progress: Progress
) -> tuple[Estimate, force.Search] | None:
    """Search again without the rows at rest, if friction leaves something, or something begins.

    There it may have any force up to its level; a simulated motion ends in the sign of a rounding
    error. The answer counts if it explains all other rows, and those at rest as well with such a
    force; not if something would begin there, which nothing shows, or begins now as before.
    """
    ctx, best = search.problem.ctx, search.best
    at_rest = found.rows & (np.abs(ctx.v) < POLICY.at_rest * ctx.v_range)
    if not (found.exact and _dry(best) and bool(at_rest.any())):
        return None
    late = [m for m in best.members if m.effect.late]
    moves = replace(found, rows=found.rows & ~at_rest)
    if (remainder.understood(search) and not late) or moves.rows.sum() < POLICY.least_rows_force:
        return None
    progress("rest")
    problem = ResidualProblem(case, ctx, moves, effects.catalogue().values())
    again = anew(problem, [f.members for f in search.pool])
    moves, again = in_its_noise(case, moves, again, anew, progress)
    begins = [m for m in again.best.members if m.effect.late]
    begins = begins if late else [m for m in begins if _at(ctx, m, at_rest)]
    if begins or not remainder.understood(again) or not _holds(again, found, at_rest):
        return None
    return moves, again


def _dry(fit: Fit) -> list[int]:
    """Return which laws of a set are dry friction."""
    return [i for i, m in enumerate(fit.members) if m.effect.dry]


def _at(ctx: Context, late: Member, rows: Mask) -> bool:
    """Return whether an effect begins in, or next to, such a row."""
    near = np.abs(ctx.t - ctx.first_s - late.trial.theta[-1]) < 2.0 * ctx.dt
    return bool((near & rows).any())


def _holds(search: force.Search, found: Estimate, at_rest: Mask) -> bool:
    """Return whether dry friction up to its level explains what the rest of a set leaves at rest.

    A set without dry friction must explain it by itself.
    """
    problem, fit = search.problem, search.best
    frictions = [fitted.contribution(problem, fit, i) for i in _dry(fit)]
    held = found.force - fitted.force_of(problem, fit) + sum(frictions)
    level = sum(float(np.max(np.abs(f[search.problem.estimate.rows]))) for f in frictions)
    beyond = np.abs(held[at_rest]) > level + 3.0 * found.sigma_n
    return float(np.mean(beyond)) < POLICY.rounded_rows


def in_the_rig(
    problem: ResidualProblem, progress: Progress
) -> tuple[Estimate, Context, force.Search]:
    """Search by the force balance, and evaluate its candidates by simulating the rig."""
    case, ctx, found = problem.case, problem.ctx, problem.estimate
    body = rigged.RigBody(case, ctx)

    def doubtful(done: force.Search) -> bool:
        return bool(done.best.members) or not found.exact or not remainder.understood(done)

    search = force.search(problem, progress, body, doubtful)
    motion = body.motion(search.problem, search.best) if search.moved else None
    along = estimate.along(case, motion, actuation.settled(case)) if motion is not None else None
    if along is None:
        return found, ctx, search
    now = context_of(case, along, ctx.all_ranges)
    moved = ResidualProblem(case, now, along, effects.catalogue().values(), search.problem.blurred)
    return along, now, replace(search, problem=moved)


def along_its_motion(
    case: Case, search: force.Search, ctx: Context, progress: Progress
) -> tuple[Estimate, Context, force.Search] | None:
    """Search again along the best set's simulated motion, if the estimated one is too inaccurate.

    No estimate follows the motion of a body that sticks and slips. If what was found reproduces the
    measured displacement to its noise, the load cell is evaluated along that motion; the answer
    counts if the search finds the same laws and they leave nothing.
    """
    if not search.best.members or (not search.moved and remainder.understood(search)):
        return None
    progress("motion")

    def laws(fit: Fit) -> set[str]:
        return {m.name for m in fit.members if not m.effect.sensor}

    # The error of the estimate may have been named as one more law; not along the motion itself.
    fewer = (
        []
        if search.moved
        else [f for f in search.fits if f.members and laws(f) < laws(search.best)]
    )
    for fit in [search.best, *fewer[:FEWER]]:
        begun, among = fit, search
        for _ in range(PASSES):
            motion = freebody.Body(case, ctx).motion(among.problem, begun)
            found = estimate.along(case, motion, 0) if motion is not None else None
            if found is None or found.rows.sum() < POLICY.least_rows_force:
                break
            now = context_of(case, found)
            along = ResidualProblem(case, now, found, effects.catalogue().values())

            def anew(judged: ResidualProblem, known: list[tuple[Member, ...]]) -> force.Search:
                return force.search(judged, progress, seeds=known)

            found, again = in_its_noise(case, found, force.search(along, progress), anew, progress)
            if laws(again.best) != laws(fit):
                break
            if remainder.understood(again):
                return found, now, again
            begun, among = again.best, again
    return None


def felt_by_cell(case: Case, search: force.Search, ctx: Context) -> bool:
    """Return whether the motion simulated with a set has the force that the load cell measured.

    In most rows, that is: if friction engages one row too early or late, all of it is missing
    there.
    """
    motion = freebody.Body(case, ctx).motion(search.problem, search.best)
    if motion is None:
        return False
    f_meas, model = case.channels["f_meas"], case.model
    rows = search.problem.estimate.rows & np.isfinite(f_meas)
    sigma = noise_level.force_noise(f_meas, model.f_std)
    inertia = -model.mass * (motion.a + gaps.filled(case.channels["ag"]))

    def excess(rest: Floats) -> float:
        return (1.4826 * float(np.median(np.abs(rest[rows]))) / sigma) ** 2 - 1.0

    left = excess(f_meas - inertia)
    return left < POLICY.excess_as_noise or left < POLICY.felt_by_cell * excess(
        f_meas - search.problem.ctx.total
    )


def balance_is_doubtful(case: Case, search: force.Search) -> bool:
    """Return whether the force balance of a free body leaves the answer open.

    It does if nothing explains it, if the effect named is within the error of the estimated motion,
    if a linear effect is named, because displacement noise biases towards a softer specimen, or if
    a friction law more complex than dry friction is named.
    """
    if not search.best.members:
        return not remainder.understood(search)
    if not remainder.understood(search):
        return True
    names = set(search.best.names)
    blurred = remainder.blurred(search)
    # The estimate is smooth where the body sticks, which looks like a more complex friction.
    leans = names & effects.having(lambda e: e.number or (e.dry and e.plainer))
    return bool(leans) or blurred or simulates(remainder.simulated(search), POLICY)
