"""The force channel: effects of the specimen, or of its load cell, missing from the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from rthyb_rt.diagnose import noise, onset, redundant, steady
from rthyb_rt.diagnose.court import Ruling
from rthyb_rt.diagnose.dictionary import Dictionary
from rthyb_rt.diagnose.effects import of_number
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.evidence import Gathered
from rthyb_rt.diagnose.fitted import count, to_earn
from rthyb_rt.diagnose.fitter import LEADING, SetFitter, plainer_friction, without
from rthyb_rt.diagnose.freebody import Body
from rthyb_rt.diagnose.motion_fitter import PARTS, MotionFitter
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, names_of
from rthyb_rt.diagnose.proposals import larger, sweep
from rthyb_rt.diagnose.refinement import inflation, solve

POOL = 6
"""Number of sets, and of single effects, whose motion is simulated."""
SEEDS = 8
"""Number of sets with which a search with less evidence begins."""
ROUNDS = 3
"""Number of decisions, if sets that were only refined for comparison prove better than the best."""
RIVALS = 6
"""Number of sets kept for display beside the one that is named."""
NUMBERS = ("k", "c", "moving_mass")
"""Numbers of the model whose effects are always candidates: at one frequency, a missing effect may
look like them."""


@dataclass
class Search:
    """Result of a search.

    Attributes:
        null: nuisance parameters only.
        fits: refined sets, best first.
        best: the set that is named; without members if nothing is missing.
        equal: other sets that fit equally well.
        excess_before, excess_after: misfit beyond noise, per row, in units of the noise.
        gain: what `best` earns beyond its price.
        held_gain: reduction of the misfit on blocks held out, relative to that on all blocks.
        scale: factor by which evidence was scaled down for coloured noise.
        moved: whether the simulated motion was evaluated, see `freebody`.
        balance: result from the force balance, if it was not accepted.
        pool: the best sets before evidence was scaled, whether or not they were rejected later.
        quiet: whether the residual of a simulated motion is within the displacement's data sheet.
        ledger: what each rule of `decide` did.
    """

    problem: ResidualProblem
    null: Fit
    fits: list[Fit]
    best: Fit
    equal: list[Fit]
    excess_before: float
    excess_after: float
    gain: float
    held_gain: float
    scale: float
    rivals: list[Fit] = field(default_factory=list)
    forms: list[Fit] = field(default_factory=list)
    moved: bool = False
    balance: Search | None = None
    pool: list[Fit] = field(default_factory=list)
    quiet: bool = False
    ledger: tuple[Ruling, ...] = ()


def _stiff(problem: ResidualProblem) -> ResidualProblem:
    """Return a problem with tight tolerances, so that an effect begins with all the misfit."""
    out = copy(problem)
    out.nuisances = [
        n if n.sigma is None else replace(n, sigma=1e-3 * n.sigma) for n in problem.nuisances
    ]
    return out


def _linear(
    problem: ResidualProblem, body: Body, fitter: SetFitter, null: Fit
) -> tuple[Fit, MotionFitter] | None:
    """Evaluate nothing and each linear effect by its motion; None if that diverges.

    A set that contains one of them must be compared with it.
    """
    plain = body.refined(problem, null)
    if plain is None:
        return None
    mover = MotionFitter(problem, body, fitter)
    by_name = {e.name: e for e in problem.effects}
    stiff = _stiff(problem)
    for name in map(of_number, NUMBERS):
        if name in by_name and body.linear:
            member = Member(by_name[name], Trial())
            begun = solve(stiff, [member], [stiff.columns(member)])
            if begun is not None:
                mover.move(begun)
    return _nothing(problem, body, mover, plain), mover


def _nothing(problem: ResidualProblem, body: Body, mover: MotionFitter, plain: Fit) -> Fit:
    """Return nuisance parameters only, started from the best effect if it reproduces the motion.

    The balance may start them too far off: then an effect of zero size would explain the
    difference. If the motion is not reproduced from there either, an effect of some size is needed.
    """
    best = min(mover.by_names.values(), key=lambda f: f.chi2, default=plain)
    if len(best.members) != 1 or best.chi2 >= plain.chi2 or plain.chi2 < body.met * mover.rows:
        return plain
    again = body.refined(problem, without(problem, best, 0))
    return again if again is not None and again.chi2 < body.met * mover.rows else plain


def _met(plain: Fit, mover: MotionFitter) -> bool:
    """Return whether a linear effect reproduces the displacement to its noise, and is needed.

    What a displacement does not show at all is left to the force balance.
    """
    return any(
        inflation(f.residual) < POLICY.white_residual and mover.score(f) < plain.chi2
        for f in mover.by_names.values()
    )


def _lasting(fit: Fit) -> Fit:
    """Return a set whose effects act throughout: those of a simulated body have no onset.

    Along an estimated motion, an onset may have only absorbed what the estimate lacks.
    """
    members = tuple(onset.lasting(m) for m in fit.members)
    return fit if members == fit.members else replace(fit, members=members, covariance=None)


def _seen_only(members: Iterable[Member]) -> bool:
    """Return whether a set contains a load cell effect, which moves nothing."""
    return any(m.effect.sensor for m in members)


def _simplest(
    dictionary: Dictionary, body: Body, mover: MotionFitter, singles: Sequence[Fit]
) -> None:
    """Add laws of one parameter to the best set of them, one after the other.

    They need the fewest simulations. A law of many parameters that imitates several of them needs
    the most, and would leave none for them.
    """
    for fit in [f for f in singles if count(mover.problem, f) == 1][:LEADING]:
        mover.move(fit)
    for _ in range(1, body.largest):
        best = mover.leading
        if best is None or best.chi2 < body.met * mover.rows:
            break
        for members in larger(dictionary, best, POOL):
            added, names = members[-1], names_of(members)
            simple = added.effect.settings(mover.problem.ctx, added.trial)[1] == 1
            if simple and names not in mover.by_names:
                mover.fit(members)


def beside_dry_friction(
    dictionary: Dictionary, body: Body, mover: MotionFitter
) -> list[tuple[Member, ...]]:
    """Return sets of dry friction with one more law, if a richer friction leads.

    A friction that falls with velocity may stand for dry friction beside a law of damping. It has
    as many parameters, so that such a set may have three effects for any body.
    """
    best, plainer = mover.leading, plainer_friction()
    rich = [n for n in best.names if n in plainer] if best is not None else []
    if best is None or len(rich) != 1 or len(best.names) > 2:
        return []
    names = tuple(sorted(plainer[n] if n in rich else n for n in best.names))
    dry = mover.by_names.get(names)
    if dry is None:
        return []
    found = [m for m in larger(dictionary, dry, POOL) if m[-1].name not in rich]
    found = [m for m in found if not (body.held and _seen_only(m))]
    return [m for m in found if names_of(m) not in mover.by_names]


def _moved(
    dictionary: Dictionary,
    body: Body,
    fitter: SetFitter,
    named: Fit,
    plain: Fit,
    mover: MotionFitter,
) -> Search | None:
    """Evaluate the most promising sets by simulated motion; None if none reproduces it."""
    problem = dictionary.problem
    ranked = [_lasting(f) for f in fitter.ranked]
    ranked = [f for f in ranked if body.quick(f) and body.distinct(f)]
    # Effects seen only by the load cell do not move the body.
    ranked = [f for f in ranked if not body.held or not _seen_only(f.members)]
    singles = [f for f in ranked if len(f.members) == 1]
    # The set named by the balance and its first set, after their subsets: the number of simulations
    # is limited. Alone, a law is among the singles, unless it is slow to simulate.
    felt = [f for f in (_lasting(named), *ranked[:1]) if not body.held or not _seen_only(f.members)]
    several = range(2, body.largest + 1)
    leading = [
        f
        for f in {f.names: f for f in felt}.values()
        if len(f.members) in several or (len(f.members) == 1 and not body.quick(f))
    ]
    parts = [f for f in singles if any(set(f.names) < set(whole.names) for whole in leading)]
    first = body.first(ranked)
    for fit in first:
        mover.move(fit)
    if problem.decays:
        mover.springs()
    # If those explain the motion, only similar sets are examined.
    enough = any(
        f.chi2 < POLICY.moved_decisive * plain.chi2 for f in mover.by_names.values() if first
    )
    if body.whole_rig:
        _simplest(dictionary, body, mover, singles)
    pool = [f for f in ranked if body.plain(f.members)] if enough else ranked
    for fit in [*([] if enough else (*parts, *leading, *singles[:POOL])), *pool[:POOL]]:
        if fit.names not in mover.by_names and not mover.pointless(fit.names):
            mover.move(fit)
    n = float(body.rows.size)
    grown: set[tuple[str, ...]] = set()
    for _ in range(2):
        best = min((plain, *mover.by_names.values()), key=mover.score)
        if best.chi2 < body.met * n:
            break
        mover.relieve()
        ahead = mover.ranked[:LEADING]
        for fit in [f for f in ahead if len(f.names) < body.largest and f.names not in grown]:
            grown.add(fit.names)
            for members in larger(dictionary, fit, POOL):
                if (body.held and _seen_only(members)) or (enough and not body.plain(members)):
                    continue
                if names_of(members) not in mover.by_names:
                    mover.fit(members)
    mover.relieve()
    mover.plain_friction()
    for members in beside_dry_friction(dictionary, body, mover):
        if not enough or body.plain(members):
            mover.fit(members)
    if problem.decays:
        mover.exchange()
    mover.settle()
    # A subset that now leads may strain a stated value, or have a simpler friction.
    body.runs = max(body.runs, PARTS)
    mover.relieve()
    mover.plain_friction()
    mover.elsewhere()
    mover.complete(body.met * n)
    best = min((plain, *mover.by_names.values()), key=mover.score)
    scale, before = inflation(best.residual), plain.chi2
    mover.rescale(scale, plain)
    found = _decide(problem, mover, plain, (before, n), scale, lambda _: 1.0)
    found.quiet = body.quiet(found.best)
    left = found.excess_after / max(found.excess_before, 1e-12)
    met = found.quiet or found.excess_after < POLICY.moved_excess or left < POLICY.moved_decisive
    return found if met else None


def search(
    problem: ResidualProblem,
    progress: Callable[[str], None] = lambda _: None,
    body: Body | None = None,
    doubtful: Callable[[Search], bool] = lambda _: False,
    seeds: Sequence[tuple[Member, ...]] = (),
) -> Search:
    """Find the set of effects that explains the force residual.

    Args:
        problem: the residual and the effects.
        progress: receives the name of each effect and stage.
        body: a freely moving body, whose sets can be evaluated by their motion.
        doubtful: whether the result of the force balance must be evaluated in this way.
        seeds: sets to refine as well, from the given shapes.
    """
    null = solve(problem, [], [])
    if null is None:
        raise ValueError("the nuisance cannot be solved")
    plain_null, n = null.chi2, problem.y.size * problem.estimate.share
    dictionary = Dictionary(problem, progress)
    fitter, scale = SetFitter(problem), 1.0
    sweep(dictionary, fitter, seeds)
    progress("onset")
    if problem.case.model.k_tol is not None:
        # A naive model is refitted as a whole: what it lacks has no onset.
        _begun(dictionary, fitter)
    pool = fitter.ranked[: noise.TRIED]
    if fitter.by_names:
        fitter, null, scale = _scaled_down(dictionary, fitter, null)
    known = redundant.witness(problem.case, problem.ctx, problem.estimate)
    if known is not None:
        progress("redundant channels")
        null = fitter.hear(known, [g.member for g in dictionary.groups], null)
        plain_null += fitter.testimony(null)
    progress("gate")
    done = _decide(problem, fitter, null, (plain_null, n), scale, fitter.held(null))
    done.pool = pool
    if body is None:
        return done
    doubted = doubtful(done) or _refused(fitter, done)
    if doubted or done.best.members:
        progress("motion")
        begun = _linear(problem, body, fitter, null)
        # If one linear effect simulates the motion to the noise, the balance cannot improve on it.
        if begun is not None and (doubted or _met(*begun)):
            by_motion = _moved(dictionary, body, fitter, done.best, *begun)
            return replace(by_motion, balance=done) if by_motion is not None else done
    return done


def _begun(dictionary: Dictionary, fitter: SetFitter) -> None:
    """Try effects with an onset, others in combination, and then their onsets again."""
    for fit in onset.propose(dictionary, fitter, _changing(fitter))[:LEADING]:
        for members in larger(dictionary, fit, 4) if len(fit.members) < 3 else ():
            fitter.fit(members)
    onset.settle(fitter, LEADING)


def _changing(fitter: SetFitter) -> bool:
    """Return whether the best set of which each effect earns its price changes in the recording.

    A weak effect that begins in mid-recording, fitted as if it were there throughout, may leave
    nothing but noise.
    """
    problem = fitter.problem
    fits = fitter.by_names.values()
    best = min(fits, key=lambda f: f.chi2 + to_earn(problem, f), default=None)
    return best is not None and steady.differs(problem, best)


def _sure_of_its_beginning(fitter: SetFitter) -> Fit:
    """Return the best set; one with an onset only if noise cannot explain it.

    A law with a free onset absorbs slow noise from some time on: its gain must be scaled down for
    correlated rows before its residual shows how much.
    """
    fits = fitter.by_names.values()
    best = min(fits, key=fitter.score)
    throughout = [f for f in fits if not any(m.effect.late for m in f.members)]
    if best in throughout or not throughout:
        return best
    plain = min(throughout, key=fitter.score)
    gain = (plain.chi2 - best.chi2) / inflation(plain.residual)
    return best if gain > fitter.price(best) - fitter.price(plain) else plain


def _refused(fitter: SetFitter, done: Search) -> bool:
    """Return whether one more effect earns its price many times, but was rejected for its share.

    Such an effect does not absorb noise; whether it absorbs the error of the estimated motion is
    shown by its simulation.
    """
    best = done.best
    if not best.members or done.excess_after < POLICY.refused_excess:
        return False
    return any(
        len(f.names) == len(best.names) + 1
        and set(best.names) < set(f.names)
        and best.chi2 - f.chi2 > POLICY.refused_price * (fitter.price(f) - fitter.price(best))
        for f in fitter.by_names.values()
    )


def _scaled_down(
    dictionary: Dictionary, fitter: SetFitter, null: Fit
) -> tuple[SetFitter, Fit, float]:
    """Repeat the search with less evidence per row if the best set leaves correlated rows.

    A set that is found only then may leave much less than the one whose residual set the scale: the
    search is repeated from it once more.

    Returns:
        The sets found, the model alone, and the factor by which their evidence was divided.
    """
    problem, scale = dictionary.problem, 1.0
    best = _sure_of_its_beginning(fitter)
    seeds = [f.members for f in fitter.ranked[:SEEDS]]
    for turn in range(2):
        found = inflation(np.sqrt(scale) * best.residual)
        found = found if found > POLICY.coloured_evidence else 1.0
        if found == scale or (turn and found * POLICY.coloured_evidence > scale):
            break
        problem.rescale(found / scale)
        dictionary.grams *= scale / found
        null, fitter, scale = solve(problem, [], []) or null, SetFitter(problem), found
        sweep(dictionary, fitter, seeds)
        if not fitter.by_names:
            break
        best = fitter.ranked[0]
        seeds = [best.members, *seeds]
    return fitter, null, scale


def _decide(
    problem: ResidualProblem,
    fitter: SetFitter,
    null: Fit,
    plain: tuple[float, float],
    scale: float,
    held_out: Callable[[Fit], float],
) -> Search:
    n = plain[1]
    for _ in range(ROUNDS):
        evidence = Gathered(fitter, null, held_out)
        choice = evidence.choose()
        if not evidence.better_than(choice.best):
            break
    best, fits = evidence.fit(choice.best), [evidence.fit(h) for h in choice.ranked]
    moved = isinstance(fitter, MotionFitter)
    after = unscaled(best, scale, moved) if best.members else plain[0]
    return Search(
        problem,
        null,
        fits,
        best,
        [evidence.fit(h) for h in choice.equal],
        plain[0] / n - 1.0,
        after / n - 1.0,
        null.chi2 - fitter.score(best) if best.members else 0.0,
        choice.held,
        scale,
        [f for f in fits if f is not best][:RIVALS],
        _forms(fitter, best, null),
        moved,
        ledger=choice.ledger,
    )


def unscaled(fit: Fit, scale: float, moved: bool = False) -> float:
    """Return the chi-squared of a set whose rows were scaled down; tolerances were not.

    The residual of a simulated motion has its own rows; that of the balance is scaled like its
    problem.
    """
    rest = float(fit.residual @ fit.residual) * (1.0 if moved else scale)
    return rest + fit.chi2 - rest / scale


def _forms(fitter: SetFitter, best: Fit, null: Fit) -> list[Fit]:
    """Return fits of the same effects that are nearly as good.

    With other forms of their laws; for a simulated motion, from other local minima: if a body
    sticks, the noise of the next row decides which of many minima that is.
    """
    others: Iterable[Fit | None] = fitter.known.values()
    share = POLICY.other_form
    if isinstance(fitter, MotionFitter):
        others, share = fitter.tried, POLICY.form_alone
    reach = share * (null.chi2 - best.chi2)
    return [
        f
        for f in others
        if f is not None and f is not best and f.names == best.names and f.chi2 - best.chi2 < reach
    ]
