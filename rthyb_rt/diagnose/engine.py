"""The stages of a diagnosis, from a case to a verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import (
    actuation,
    decay,
    effects,
    estimate,
    fitted,
    force,
    freebody,
    gaps,
    lateness,
    localise,
    modulation,
    noise,
    noise_level,
    redundant,
    remainder,
    rigged,
    sensor_faults,
    spring_history,
    steady,
    whitening,
)
from rthyb_rt.diagnose.actuation import Actuation, ActuatorEffect, ActuatorFit
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.court import Ruling
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.effects.sensor import QUANTISATION
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.intervals import Sure, intervals, of_the_spring_there_is
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.predict import Augmented, followed
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.diagnose.refinement import refine
from rthyb_rt.diagnose.sensor_faults import SensorResidual
from rthyb_rt.diagnose.verdict import (
    Moved,
    Rounded,
    Said,
    Seen,
    Verdict,
    judge,
    lost_in_form,
    of_form,
    simulates,
)
from rthyb_rt.errors import InputError

Progress = Callable[[str], None]
Anew = Callable[[ResidualProblem, list[tuple[Member, ...]]], force.Search]
"""Searches a problem again, with these sets among those that are refined."""

FEWER = 2
"""Number of sets with fewer laws whose motion is examined."""
NEWTON_STEPS = 12
"""Largest number of steps by which a set is refined by a coarse load cell's readings."""
ROUNDS = 3
"""Number of searches by these readings, each near the set found by the last one."""
MENDED = 3
"""Number of times that a recording is diagnosed again without faults of its sensors."""
PASSES = 2
"""Number of simulations of such a motion, the second one with the effects found along it."""


@dataclass
class Found:
    """One effect that was found, or a rival.

    Attributes:
        score: weight of evidence against the other sets, 0 to 1.
        params, ci95: by name with units.
        evidence: change of the information criterion when it is added; negative is better.
        signal: its contribution along the recording, N or m, (n,).
        shape: variant of its law and shape parameters, for the report.
        form: the form of the law in a few words, among those that share the name.
        from_s: its onset, if in mid-recording, s.
        modulated_by: the channel that modulates it, and by how much; see `Modulated.slope`.
    """

    name: str
    channel: Literal["force", "disp"]
    score: float
    params: dict[str, float]
    ci95: dict[str, list[float]]
    evidence: float
    signal: Floats | None = None
    shape: str = ""
    form: str = ""
    from_s: float | None = None
    modulated_by: dict[str, Any] = field(default_factory=dict)


@dataclass
class Displacement:
    """Result for the displacement channel.

    Attributes:
        left: fraction of the misfit beyond noise that the best fit leaves.
        known: whether that may be noise, or due to the form of a law.
        quiet: whether it is within the sensor's data sheet.
    """

    task: Actuation
    null: ActuatorFit
    best: ActuatorFit
    equal: list[ActuatorFit]
    rivals: list[ActuatorFit]
    scale: float
    left: float
    known: bool
    quiet: bool = False

    @property
    def found(self) -> bool:
        """Whether an effect is named."""
        return bool(self.best.effects)


@dataclass
class DiagnosisResult:
    """The complete result for a recording."""

    case: Case
    verdict: Said
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
    ledger: tuple[Ruling, ...] = ()


@dataclass(frozen=True)
class _Weighed:
    """Comparison of sets of actuator effects.

    Attributes:
        size: size of the displacement, in units of its noise.
        plain: simulation of the model as given.
    """

    task: Actuation
    null: ActuatorFit
    fits: list[ActuatorFit]
    scale: float
    size: float
    plain: ComputedMotion

    def gain(self, fit: ActuatorFit, less: ActuatorFit) -> float:
        """Return the reduction of chi-squared from one set to another."""
        return less.misfit(self.scale) - fit.misfit(self.scale)

    def worth(self, fit: ActuatorFit) -> bool:
        """Return whether a set earns its price, and has a noticeable effect."""
        # Relative to the model as given: a time offset may already have absorbed part of it.
        moved = float(np.std((fit.motion.x - self.plain.x)[self.task.rows])) / self.task.sigma
        earned = self.gain(fit, self.null) > self.task.price(fit)
        return earned and moved > POLICY.least_force * self.size

    def completes(self, fit: ActuatorFit, effect: ActuatorEffect, without: ActuatorFit) -> bool:
        """Return whether an effect reduces the misfit to noise if the model is known well.

        It is not a matter of form if it earns its price beyond what smooth changes of the form of
        the other effects would earn, and is larger than the errors of any formula.
        """
        n = self.task.rows.size
        stated = self.task.case.model.k_tol is not None
        if not stated or fit.chi2 - n >= POLICY.actuator_at_noise * n:
            return False
        own = self.gain(fit, without)
        least = POLICY.actuator_at_noise_price * self.task.price_of(effect)
        inexact = any(not e.exact for e in without.effects)
        if inexact and own < POLICY.actuator_form**2 * self.gain(without, self.null):
            return False
        return own > least and own - self.task.by_form(without) / self.scale > least

    def needed(self, fit: ActuatorFit) -> bool:
        """Return whether no effect of a set can be omitted."""
        least = POLICY.needed_share_actuator * self.gain(fit, self.null)
        for effect in fit.effects:
            rest = tuple(sorted(e.name for e in fit.effects if e is not effect))
            without = next((f for f in self.fits if f.names == rest), None) if rest else self.null
            if without is None:
                continue
            own = self.gain(fit, without)
            if own < self.task.price(fit) / len(fit.effects):
                return False
            if rest and own < least and not self.completes(fit, effect, without):
                return False
        return True

    def alike(self, fit: ActuatorFit, best: ActuatorFit) -> bool:
        """Return whether a set cannot be distinguished from the best one."""
        more = max(0, fit.count - best.count)
        dearer = POLICY.dearer_rival_actuator * POLICY.same_evidence * more
        apart = fit.misfit(self.scale) - best.misfit(self.scale)
        return apart + dearer < POLICY.same_evidence


def displacement(case: Case) -> Displacement | None:
    """Diagnose x_cmd -> x_meas; None if one of the three is missing."""
    base = case.model.actuator
    if base is None or "x_cmd" not in case.channels or "x_meas" not in case.channels:
        return None
    task = Actuation(case, base)
    if task.rows.size < POLICY.least_rows:
        return None
    null, fits, scale = actuation.search(task)
    n = task.rows.size
    before = null.chi2 / n - 1.0
    size = float(np.std(task.x[task.rows])) / task.sigma
    sets = _Weighed(task, null, fits, scale, size, task.simulate(base))
    good = [f for f in fits if sets.worth(f) and sets.needed(f)]
    best = good[0] if good else _as_stated(task, null)
    equal = [f for f in good if f is not best and sets.alike(f, best)]
    after = best.chi2 / n - 1.0
    left = after / before if before > 0 else 0.0
    nothing = POLICY.excess_as_noise + POLICY.excess_of_nothing_actuator
    known = after < POLICY.excess_as_noise or (not best.effects and before < nothing)
    # If noise may be given any colour, it must be within the data sheet, and without bursts.
    known = known and task.own is None
    known = known or left < of_form(case.model.k_tol is None, len(best.effects) or 1, POLICY)
    # As for the force: noise has any colour, and only its white part is measured.
    quiet = bool(case.model.x_std) and noise.mere(
        task.left(best)[task.rows],
        best.residual,
        (case.model.x_std or 0.0) * (1.0 + (task.own.scatter if task.own is not None else 0.0)),
        case.fs_hz,
    )
    # An effect as small as what is left would not be reported either.
    known = known or quiet or np.sqrt(max(after, 0.0)) < POLICY.least_force * size
    rivals = [f for f in fits if f is not best][:5]
    return Displacement(task, null, best, equal, rivals, scale, left, known, quiet)


def _as_stated(task: Actuation, null: ActuatorFit) -> ActuatorFit:
    """Return nuisance parameters only, without a time offset if that brings nothing.

    A lag behind a held command has a velocity that changes in steps: an offset of a nanosecond in
    the wrong direction, determined by noise, would move each row's step to before the row.
    """
    residual, motion, zero = task.residual(task.base)
    if float(residual @ residual) - null.chi2 > POLICY.same_evidence:
        return null
    return replace(null, model=task.base, residual=residual, motion=motion, zero_m=zero)


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


def diagnose(case: Case, progress: Progress = lambda _: None) -> DiagnosisResult:
    """Find the physics that the model lacks.

    If something remains unknown, it may be the fault of a sensor: without that, the recording is
    diagnosed again. So it is if the displacement is noisier than stated.

    Args:
        case: recording and model.
        progress: receives the name of each stage.
    """
    first = done = _diagnosed(case, progress)
    # Faults of the load cell may show only once the motion is known.
    for _ in range(MENDED):
        unknown = done.verdict == "unknown"
        if not unknown and (done.disp is None or done.disp.quiet):
            break  # all is explained, within the data sheet
        mended = sensor_faults.mended(done.case, _left(done), unknown)
        if mended is None:
            break
        try:
            done = _diagnosed(mended, progress)
        except InputError:  # the rest is not enough
            break
    return done if done.verdict != "unknown" else first


def _left(done: DiagnosisResult) -> list[SensorResidual]:
    """Return what a diagnosis leaves of the displacement and the load cell, if it has them."""
    left, search = [], done.force
    if done.disp is not None:
        task, motion = done.disp.task, done.disp.best.motion
        rows = np.zeros(task.x.size, dtype=np.bool_)
        rows[task.rows] = True
        made, rest, white = motion.x, task.x - motion.x, task.own is None
        left += [SensorResidual("x_meas", made, rest, rows, motion, white)]
    if search is None or "f_meas" not in done.case.channels or done.case.model.family == "forced":
        return left
    found, motion = search.problem.estimate, search.problem.estimate.motion
    if found.read is None:
        made = fitted.force_of(search.problem, search.best)
        rest = remainder.left_by(search, search.best)
        white = found.exact and not found.coloured
        left += [SensorResidual("f_meas", made, rest, found.rows, motion, white)]
    return left


def _diagnosed(case: Case, progress: Progress) -> DiagnosisResult:
    progress("actuator")
    disp = displacement(case)
    found = motion_of(case, disp)
    search = ctx = None
    if found is not None and found.rows.sum() >= POLICY.least_rows_force:
        progress("force laws")
        ctx = context_of(case, found)
        problem = ResidualProblem(case, ctx, found, effects.catalogue().values())
        if rigged.given(case):
            found, ctx, search = _in_the_rig(problem, progress)
            progress("verdict")
            return _verdict(case, disp, found, ctx, search)
        held = freebody.shown(case) and not found.exact
        body = freebody.Body(case, ctx) if held or freebody.judged(case) else None
        if decay.judged(case):
            body = decay.Swing(case, ctx)

        def doubtful(done: force.Search) -> bool:
            # Several laws can fit almost any estimated motion, but they must also simulate it.
            assert body is not None
            if not held and (len(done.best.names) > 1 or _doubtful(case, done)):
                return True
            if not remainder.understood(done):
                return True
            # Coloured noise may hide an effect from the balance that the motion shows clearly.
            if freebody.judged(case) and not done.best.members:
                return not body.reproduced(done.problem, done.null)
            coloured = not held or done.scale > POLICY.coloured_cell
            if not (coloured and done.best.members):
                return False
            if not body.motion(problem, done.best):
                return True
            # The estimated motion of a body that sticks is worse where it sticks: a law then seems
            # to differ between parts, and only its simulation shows whether it does.
            return freebody.judged(case) and steady.differs(done.problem, done.best)

        search = force.search(problem, progress, body, doubtful)

        def anew(judged: ResidualProblem, known: list[tuple[Member, ...]]) -> force.Search:
            return force.search(judged, progress, body, doubtful, known)

        # What the displacement and the load cell both show is not limited by the balance's noise.
        settled = search.moved and (not held or _felt(case, search, ctx))
        if not settled:
            found, search = _in_its_noise(case, found, search, anew, progress)
            if disp is not None and found.motion is disp.best.motion and not search.moved:
                found, ctx, search = lateness.settled(disp.task, disp.best, found, ctx, search)
            settled = search.moved and (not held or _felt(case, search, ctx))
        if held and not settled:
            by_balance = search.balance or search
            tried = [search, by_balance] if search.moved else [search]
            again = (_along_its_motion(case, done, ctx, progress) for done in tried)
            found, ctx, search = next((a for a in again if a), (found, ctx, by_balance))
    elif "f_meas" in case.channels or case.model.family in ("ground", "forced"):
        raise InputError(
            "gaps, clipped readings and stray readings leave no part in which the force could "
            f"be evaluated (fewer than {POLICY.least_rows_force} rows); record again, or "
            "diagnose the parts between the gaps",
            case.name,
        )
    progress("verdict")
    return _verdict(case, disp, found, ctx, search)


def _in_its_noise(
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


def _in_the_rig(
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


def _along_its_motion(
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

            found, again = _in_its_noise(case, found, force.search(along, progress), anew, progress)
            if laws(again.best) != laws(fit):
                break
            if remainder.understood(again):
                return found, now, again
            begun, among = again.best, again
    return None


def _felt(case: Case, search: force.Search, ctx: Context) -> bool:
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


def _doubtful(case: Case, search: force.Search) -> bool:
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


def _coarse(case: Case, search: force.Search | None) -> tuple[Found | None, force.Search | None]:
    """Return the step of a coarse load cell and the search with the set within its rounding."""
    steps = quantisation(case)
    if steps is None or search is None:
        return steps, search
    lsb_n = steps.params["lsb_N"]
    before = Seen(remainder.left_of(search), rounding=remainder.rounded(search, steps.name, lsb_n))
    if lost_in_form(before, POLICY):
        return None, search
    if search.problem.estimate.read is not None:
        return steps, search
    return steps, remainder.within_rounding(search, lsb_n)


def _verdict(
    case: Case,
    disp: Displacement | None,
    found: Estimate | None,
    ctx: Context | None,
    search: force.Search | None,
) -> DiagnosisResult:
    steps, search = _coarse(case, search)
    if search is not None and ctx is not None:
        search = remainder.without_unsure(search, ctx)
    said = _judged(disp, ctx, search, steps)
    candidates: list[Found] = []
    if disp is not None and said.actuator:
        candidates += _disp_found(disp)
    if search is not None and ctx is not None and said.force:
        candidates += _force_found(search, ctx, _around(disp, found))
    if steps is not None:
        candidates.append(steps)
    done = _located(case, disp, found, ctx, search, said, candidates)
    named = [c for c in candidates if c.name in said.names]
    done.notes += modulation.in_words([c.name for c in named], [c.modulated_by for c in named])
    return done


def _judged(
    disp: Displacement | None,
    ctx: Context | None,
    search: force.Search | None,
    steps: Found | None,
) -> Verdict:
    """Return the verdict, gathering what the rules ask for."""
    moved = None
    if disp is not None:
        moved = Moved(disp.best.names, tuple(f.names for f in disp.equal), disp.known)
    if search is None:
        rounding = None if steps is None else Rounded(steps.name)
        said = judge(Seen(None, moved, rounding), POLICY)
    else:
        rounding = None
        if steps is not None:
            rounding = remainder.rounded(search, steps.name, steps.params["lsb_N"])
        seen = Seen(remainder.left_of(search), moved, rounding)
        while not isinstance(said := judge(seen, POLICY), Verdict):
            known = {**seen.known, said: remainder.asked(search, ctx, said)}
            seen = replace(seen, known=known)
    assert isinstance(said, Verdict)
    return said


def quantisation(case: Case) -> Found | None:
    """Return a load cell with coarse resolution: few distinct readings, all on one grid."""
    f = case.get("f_meas")
    if f is None or case.model.f_std is None:
        return None
    lsb = noise_level.step_of(f, case.model.f_std)
    if lsb == 0.0:
        return None
    return Found(
        QUANTISATION.name,
        "force",
        1.0,
        {"lsb_N": lsb},
        {"lsb_N": [0.999 * lsb, 1.001 * lsb]},
        -100.0,
    )


def _located(
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


def _force_found(
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


def _around(disp: Displacement | None, found: Estimate | None) -> list[ComputedMotion]:
    """Return motions one standard deviation away from that of a fitted actuator."""
    if disp is None or found is None or not found.exact:
        return []
    return disp.task.around(disp.best, disp.scale, found.motion)


def _disp_found(disp: Displacement) -> list[Found]:
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


def _work(d: DiagnosisResult, c: Found) -> dict[str, float]:
    """Return the work that a force of the answer removed from the motion, J.

    The parameters of a loop are not unique, but its energy is.
    """
    if c.signal is None or c.channel != "force" or d.estimate is None:
        return {}
    x = d.estimate.motion.x
    rows = estimate.as_read(d.case, d.estimate).rows
    dx = np.where(rows, np.diff(x, prepend=x[0]), 0.0)
    return {"energy_J": float(c.signal @ dx)}


def to_json(d: DiagnosisResult) -> dict[str, Any]:
    """Return the answer in the interchange format."""
    known = [c for c in d.candidates if d.verdict != "unknown"]
    return {
        "schema": "rthyb-diagnose/1",
        "verdict": d.verdict,
        "effects": d.effects,
        "candidates": [
            {"name": c.name, "score": c.score, "params": c.params, "ci95": c.ci95,
             "delta_bic": c.evidence, "channel": c.channel}
            | ({"form": c.form} if c.form else {})
            | ({"modulated_by": c.modulated_by} if c.modulated_by else {}) | _work(d, c)
            | ({"from_s": c.from_s} if c.from_s is not None else {})
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
