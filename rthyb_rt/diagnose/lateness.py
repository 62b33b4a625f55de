"""The result fitted again with the exact delay of the load cell.

The search represents a normal time offset as a straight line over the rate of the model's force,
and that rate as a difference of rows. The force of an effect is delayed like the model's; and the
force of a mass behind an actuator that is fast compared with the rows has a rate that the rows do
not resolve: the command turns a corner at each of them. Along a simulated motion of an actuator
both are known exactly.
"""

from __future__ import annotations

from dataclasses import replace

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects, fitted, force
from rthyb_rt.diagnose.actuation import Actuation, ActuatorFit
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.problem import Fit, ResidualProblem, whole
from rthyb_rt.diagnose.refinement import refine, solve

PASSES = 3
STEP_S = 1e-5
"""A tenth of a normal offset: within it the force is a straight line except at a corner."""
Settled = tuple[Estimate, Context, force.Search]


def settled(
    task: Actuation, fit: ActuatorFit, found: Estimate, ctx: Context, search: force.Search
) -> Settled:
    """Return motion, context and search along the motion delayed like the force.

    Args:
        task, fit: the actuator whose motion is used.
        found, ctx, search: the result so far.
    """

    def late_by(seconds: float) -> ComputedMotion:
        model = replace(fit.model, shift_s=fit.model.shift_s + seconds)
        return task.residual(model, fit.before)[1]

    done: Settled = (found, ctx, search)
    members = search.best.members
    # A load cell that was found to be delayed has its own time already.
    for _ in range(0 if not members or any(m.effect.carries for m in members) else PASSES):
        best, problem = done[2].best, done[2].problem
        place = next((i for i, n in enumerate(problem.nuisances) if n.name == "skew"), None)
        if place is None:
            break
        late = float(best.nuisance[place])
        sides = [
            whole(problem, _without(best, place), replace(ctx, motion=late_by(late + step)))
            for step in (-STEP_S, STEP_S)
        ]
        rate = (sides[1] - sides[0]) / (2.0 * STEP_S)
        along = replace(ctx, motion=late_by(late), ranges=ctx.all_ranges)
        # The entire offset remains a parameter of the fit: its prior is centred on zero.
        now = replace(found, motion=along.motion, force=found.force + late * rate)
        anew = ResidualProblem(problem.case, along, now, effects.catalogue().values())
        anew.late_as(rate)
        anew.rescale(problem.loudness**2)
        better = _refitted(done[2], anew)
        if better is None:
            break
        gain, done = best.chi2 - better.best.chi2, (now, along, better)
        if gain < 0.1 or not better.best.members:
            break
    return done


def _without(fit: Fit, place: int) -> Fit:
    """Return a fit with one nuisance parameter set to zero."""
    nuisance = fit.nuisance.copy()
    nuisance[place] = 0.0
    return replace(fit, nuisance=nuisance)


def _refitted(search: force.Search, problem: ResidualProblem) -> force.Search | None:
    """Return the result fitted to another problem; None if that is no better.

    An effect that no longer earns its price has only compensated for the time offset.
    """

    def again(fit: Fit) -> Fit | None:
        refined = refine(problem, fit.members)
        return refined if refined is not None and problem.sensible(refined) else None

    best, null = again(search.best), solve(problem, [], [])
    if best is None or null is None or best.chi2 > search.best.chi2:
        return None
    if null.chi2 - best.chi2 < fitted.to_earn(problem, best):
        rows = problem.y.size * problem.estimate.share
        left = search.scale * null.chi2 / rows - 1.0
        return replace(
            search, problem=problem, null=null, best=null, equal=[], forms=[], rivals=[],
            excess_before=left, excess_after=left, gain=0.0, held_gain=0.0,
        )  # fmt: skip
    pairs = [(f, again(f)) for f in search.equal]
    anew = {id(f): new for f, new in [(search.best, best), *pairs] if new is not None}
    return replace(
        search,
        problem=problem,
        null=null,
        best=best,
        equal=[anew[id(f)] for f in search.equal if id(f) in anew],
        forms=[f for f in map(again, search.forms) if f is not None],
        # The others were not named: they are shown as they were.
        fits=[anew.get(id(f), f) for f in search.fits],
        rivals=[anew.get(id(f), f) for f in search.rivals],
    )
