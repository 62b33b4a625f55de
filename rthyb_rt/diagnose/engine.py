"""The stages of a diagnosis, from a case to a verdict."""

from __future__ import annotations

from dataclasses import replace

from rthyb_rt.diagnose import (
    decay,
    effects,
    force,
    freebody,
    lateness,
    modulation,
    remainder,
    rigged,
    sensor_faults,
    steady,
)
from rthyb_rt.diagnose.actuator_choice import displacement
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.findings import (
    displacement_found,
    force_found,
    located,
    motions_around,
    quantisation,
)
from rthyb_rt.diagnose.motion_evaluated import context_of, motion_of
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Member, ResidualProblem
from rthyb_rt.diagnose.refitted import with_own_stiffness
from rthyb_rt.diagnose.result import DiagnosisResult, Displacement, Found, Progress
from rthyb_rt.diagnose.searching import (
    along_its_motion,
    away_from_rest,
    balance_is_doubtful,
    felt_by_cell,
    in_its_noise,
    in_the_rig,
)
from rthyb_rt.diagnose.verdict import Moved, Rounded, Seen, Verdict, judge, lost_in_form
from rthyb_rt.errors import InputError

MENDED = 3
"""Number of times that a recording is diagnosed again without faults of its sensors."""


def diagnose(case: Case, progress: Progress = lambda _: None) -> DiagnosisResult:
    """Find the physics that the model lacks.

    If something remains unknown, it may be the fault of a sensor: without that, the recording is
    diagnosed again. So it is if the displacement is noisier than stated.

    Args:
        case: recording and model.
        progress: receives the name of each stage.
    """
    first = done = _diagnosed(with_own_stiffness(case), progress)
    # Faults of the load cell may show only once the motion is known.
    for _ in range(MENDED):
        unknown = done.verdict == "unknown"
        if not unknown and (done.disp is None or done.disp.quiet):
            break  # all is explained, within the data sheet
        mended = sensor_faults.mended(done.case, sensor_faults.left_by(done), unknown)
        if mended is None:
            break
        try:
            done = _diagnosed(mended, progress)
        except InputError:  # the rest is not enough
            break
    return done if done.verdict != "unknown" else first


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
            found, ctx, search = in_the_rig(problem, progress)
            progress("verdict")
            return _verdict(case, disp, found, ctx, search)
        held = freebody.shown(case) and not found.exact
        body = freebody.Body(case, ctx) if held or freebody.judged(case) else None
        if decay.judged(case):
            body = decay.Swing(case, ctx)

        def doubtful(done: force.Search) -> bool:
            # Several laws can fit almost any estimated motion, but they must also simulate it.
            assert body is not None
            if not held and (len(done.best.names) > 1 or balance_is_doubtful(case, done)):
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
        settled = search.moved and (not held or felt_by_cell(case, search, ctx))
        if not settled:
            plain = found
            found, search = in_its_noise(case, found, search, anew, progress)
            moves = away_from_rest(case, plain, search, anew, progress)
            found, search = moves or (found, search)
            if disp is not None and found.motion is disp.best.motion and not search.moved:
                found, ctx, search = lateness.settled(disp.task, disp.best, found, ctx, search)
            settled = search.moved and (not held or felt_by_cell(case, search, ctx))
        if held and not settled:
            by_balance = search.balance or search
            tried = [search, by_balance] if search.moved else [search]
            again = (along_its_motion(case, done, ctx, progress) for done in tried)
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
        candidates += displacement_found(disp)
    if search is not None and ctx is not None and said.force:
        candidates += force_found(search, ctx, motions_around(disp, found))
    if steps is not None:
        candidates.append(steps)
    done = located(case, disp, found, ctx, search, said, candidates)
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
        exact = all(e.exact for e in disp.best.effects)
        moved = Moved(disp.best.names, tuple(f.names for f in disp.equal), disp.known, exact)
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
