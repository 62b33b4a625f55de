"""The model that a diagnosis found, as it predicts and as a rig file holds it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rthyb_rt.diagnose import effects, estimate, remainder
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.predict import Augmented, followed
from rthyb_rt.diagnose.problem import ResidualProblem
from rthyb_rt.diagnose.refinement import refine
from rthyb_rt.diagnose.result import DiagnosisResult


def augmented(d: DiagnosisResult) -> Augmented:
    """Return the model with the effects found; for an unknown verdict, with refitted values."""
    model = d.case.model
    search = d.force
    members: tuple[Any, ...] = ()
    betas: tuple[Floats, ...] = ()
    skew = 0.0
    fitted = model
    if search is not None:
        fit = search.best if d.verdict in ("explained", "ambiguous") else search.null
        if d.verdict == "ambiguous" and d.case.own is not None:
            # Of sets that fit equally well, one that a rig can represent, so that the loop can be
            # closed.
            fits = [search.best, *search.equal]
            fit = next((f for f in fits if not any(m.effect.sensor for m in f.members)), fit)
        free = model.k_tol is None
        if fit.members or not free:
            fitted = remainder.with_nuisance(model, search.problem, fit)
        members, betas = fit.members, fit.betas
    disp = d.disp
    lag, zeros = model.actuator, (0.0, 0.0)
    if disp is not None and disp.known:
        lag = disp.best.model
        zeros = (disp.best.zero_m, disp.task.late_zero(disp.best))
    ranges = d.context.all_ranges if d.context is not None else None
    cell = "f_meas" in d.case.channels and model.family != "forced"
    return Augmented(fitted, model, members, betas, lag, ranges, skew, zeros, cell)


def in_newtons(d: DiagnosisResult, model: Augmented, wanted: Case | None = None) -> Augmented:
    """Return the model fitted again with the same weight for every newton of misfit.

    A naive model leaves a misfit far above the noise: plain least squares, not the weights of the
    noise, then predicts best, along the kind of motion along which ``wanted`` will be predicted.
    """
    search = d.force
    if search is None or d.case.model.k_tol is not None or search.problem.estimate.exact:
        return model
    if d.verdict not in ("explained", "ambiguous") or not search.best.members:
        return model
    read = estimate.as_read(d.case, search.problem.estimate)
    sigma = float(np.std(search.best.residual)) * read.sigma_n or 1.0
    level = max(sigma, read.sigma_n)
    plain = replace(read, whiten=lambda y: y / level, pieces=None)
    ctx = search.problem.ctx
    motion = followed(model, d.case, wanted) if wanted is not None else None
    if motion is not None:
        ctx = Context(ctx.model, motion, ctx.t, ctx.force, ctx.other, ctx.all_ranges)
    problem = ResidualProblem(d.case, ctx, plain, effects.catalogue().values())
    problem.rescale(max(1.0, float(np.mean(search.best.residual**2))))
    fit = refine(problem, search.best.members)
    if fit is None or not problem.sensible(fit):
        return model
    fitted = remainder.with_nuisance(d.case.model, problem, fit)
    if any(m.effect.complete for m in fit.members) and min(fitted.k, fitted.c) < 0.0:
        # A joint law excludes all others of the specimen, above all what drives it.
        below = {"k": fitted.k < 0.0, "c": fitted.c < 0.0}
        gone = [below.get(n.number, False) for n in problem.nuisances]
        for j in np.flatnonzero(gone):
            whole = 1.0 if problem.nuisances[j].number == "k" else d.case.model.c
            problem.y = problem.y + whole * problem.base[:, j]
        problem.base = problem.base[:, ~np.array(gone)]
        problem.nuisances = [n for n, g in zip(problem.nuisances, gone, strict=True) if not g]
        again = refine(problem, fit.members)
        if again is not None and problem.sensible(again):
            fit = again
            kept = remainder.with_nuisance(d.case.model, problem, fit)
            fitted = replace(
                kept,
                k=0.0 if below["k"] else kept.k,
                c=0.0 if below["c"] else kept.c,
            )
    return replace(model, model=fitted, members=fit.members, betas=fit.betas)


def baseline(d: DiagnosisResult) -> Augmented:
    """Return the model as given."""
    m = d.case.model
    return Augmented(m, m, (), (), m.actuator, None)
