"""Evidence on sets of effects, gathered for the rules of `decide`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np

from rthyb_rt.diagnose import coarse, mains
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.court import Choice
from rthyb_rt.diagnose.decide import gathered as decided
from rthyb_rt.diagnose.effects import catalogue
from rthyb_rt.diagnose.feedback import Driven, inferred, returns
from rthyb_rt.diagnose.fitted import (
    bent,
    contribution,
    force_of,
    left,
    offset_s,
    offset_sd,
    size,
    strained,
)
from rthyb_rt.diagnose.form import neighbours
from rthyb_rt.diagnose.hypotheses import (
    DriftRates,
    Evidence,
    Hypothesis,
    Laws,
    Need,
    SetMember,
    Setting,
)
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, price
from rthyb_rt.diagnose.refinement import inflation, solve
from rthyb_rt.diagnose.steady import past_forms

FOLD_S = 0.25
SLOW_LINES = 8
"""Number of lines from which the power of slow noise is read: to a half of itself."""
NEAR_LINES = (5, 12)
"""Lines on either side of one from which the noise at its frequency is read: the nearest ones have
what it leaves itself if it begins, ends or beats within the recording."""
BLOCK_LEAST = 4.0
"""Least number of rows of a block."""
FOLDS = 4
STILL, RESTS = 0.01, 0.25
"""Velocity, as a part of the largest, of a specimen at rest, and part of a half of the recording in
which it must be at rest for a drift to show there without any cycle."""
ASIDE = 0.2
"""Least displacement from the middle of its range, as a part of half the range, on a side."""


class Fitter(Protocol):
    """Refines sets, by the force balance or by simulated motion.

    Attributes:
        stated: names of effects that change a stated value within its tolerance.
        exact: whether the motion is free of estimation noise.
        rows: number of independent rows evaluated.
        judged: what is evaluated, see `hypotheses.Setting`.
        witnessed: whether another channel verifies the load cell, see `redundant`.
    """

    problem: ResidualProblem
    by_names: dict[tuple[str, ...], Fit]
    stated: set[str]
    exact: bool
    rows: float
    judged: Literal["force", "motion", "rig"]
    witnessed: bool

    def fit(self, members: Iterable[Member]) -> Fit | None:
        """Refine a set; None if it is not a physical law."""


class Gathered:
    """The sets that a search has refined, as evidence."""

    def __init__(self, fitter: Fitter, null: Fit, held_out: Callable[[Fit], float]) -> None:
        """Take the fitter, the null, and the fraction of a gain that other rows confirm."""
        self.fitter, self.held_out = fitter, held_out
        self.problem = fitter.problem
        self.laws = Laws.of(catalogue())
        self._made: dict[int, Hypothesis] = {}
        self._fits: dict[Hypothesis, Fit] = {}
        self.first = dict(fitter.by_names)
        self.null = self.of(null)

    @cached_property
    def driven(self) -> Driven | None:
        """What laws earn by the motion that the test imposes; None if the specimen is still."""
        return Driven.of(self.problem)

    def choose(self) -> Choice:
        """Return the decision."""
        sets = tuple(self.of(f) for f in self.first.values())
        evidence = Evidence(self._setting(), self.null, sets)
        return decided(evidence, POLICY, self._answer, self._beside)

    def better_than(self, best: Hypothesis) -> bool:
        """Return whether a set was refined meanwhile, as part of another one, and is better."""
        return any(h.chi2 + h.price < best.chi2 + best.price for h in self._beside())

    def fit(self, known: Hypothesis) -> Fit:
        """Return the fit behind a hypothesis."""
        return self._fits[known]

    def of(self, fit: Fit) -> Hypothesis:
        """Return what is always known of a fit."""
        made = self._made.get(id(fit))
        if made is None:
            made = self._made[id(fit)] = self._read(fit)
            self._fits.setdefault(made, fit)
        return made

    def _read(self, fit: Fit) -> Hypothesis:
        problem, laws = self.problem, self.laws
        ctx, held, lost = problem.ctx, 0.0, 0.0
        for m, b in zip(fit.members, fit.betas, strict=True):
            own = m.effect.holds_n_per_m(ctx, m.trial, b)
            if own > 0.0:
                held = own
            elif m.name == laws.stiffness:
                lost = -float(b[0]) * ctx.model.k
        return Hypothesis(
            tuple(self._part(m, offset_s(problem, fit)) for m in fit.members),
            fit.chi2,
            frozenset(bent(problem, fit)),
            offset_sd(problem, fit),
            held,
            lost,
            frozenset(strained(problem, fit)),
        )

    def _part(self, member: Member, normal_s: float) -> SetMember:
        effect, ctx = member.effect, self.problem.ctx
        shift_s = effect.offset_s(member.trial)
        own = effect.settings(ctx, member.trial)[1]
        omega_per_s = float(np.std(ctx.a)) / (float(np.std(ctx.v)) or 1.0)
        return SetMember(
            member.name,
            effect.names,
            price(self.problem, effect, own),
            own,
            effect.late,
            member.name in self.fitter.stated and effect.restates(member.trial),
            effect.sensor,
            effect.carries,
            effect.dissipates,
            shift_s + normal_s if shift_s else 0.0,
            effect.settling_s(member.trial) * omega_per_s,
            effect.complete,
        )

    def _setting(self) -> Setting:
        problem, model = self.problem, self.problem.case.model
        naive = model.k_tol is None
        # With a naive model the misfit is due to form, to which the motion's noise adds little.
        blurred = inferred(problem.case) and not self.fitter.exact and not naive
        return Setting(
            self.laws,
            self.fitter.rows,
            self.fitter.judged,
            naive,
            self.fitter.exact,
            problem.decays and naive,
            problem.frees("k"),
            (model.k_tol or 0.0) * abs(model.k),
            # A simulated motion is compared with the measured one: no regressor contains its noise.
            self.fitter.judged == "force" and (returns(problem.case) or blurred),
            self.fitter.witnessed,
            problem.estimate.read is not None,
        )

    def _beside(self) -> list[Hypothesis]:
        """Return the sets refined, or refined better, since the evidence was gathered."""
        return [self.of(f) for n, f in self.fitter.by_names.items() if self.first.get(n) is not f]

    def _answer(self, need: Need) -> Any:
        fit, problem = self.fit(need.of), self.problem
        if need.what == "part":
            return self._refined([fit.members[i] for i in need.which])
        if need.what == "yielding":
            twin = self._yielding(fit)
            return None if twin is None else self._refined(twin)
        if need.what == "beyond forms":
            return self._beyond_forms(fit, need.which[0])
        if need.what == "driven":
            return () if self.driven is None else self.driven.gains(fit)
        if need.what == "driven together":
            return np.inf if self.driven is None else self.driven.together(fit, need.which)
        if need.what == "driven more":
            return self._driven_more(fit, need.which[0])
        if need.what == "drift":
            return drift(problem, fit, self.laws)
        if need.what == "zero":
            model = problem.case.model
            if not model.k or not model.x_std or "x_meas" not in problem.case.channels:
                return np.inf
            force_n = float(np.max(np.abs(contribution(problem, fit, need.which[0]))))
            return force_n / abs(model.k) / model.x_std
        if need.what == "rounding":
            return rounding(problem, fit)
        if need.what == "left":
            return left(problem, fit)
        if need.what == "slow noise":
            return slow_power(problem, fit)
        if need.what == "near noise":
            return near_power(problem, fit, need.which[0])
        if need.what == "line of others":
            return line_of_others(problem, fit, need.which[0])
        if need.what == "own size":
            return size(problem, fit, need.which)
        return size(problem, fit) if need.what == "size" else self.held_out(fit)

    def _refined(self, members: list[Member]) -> Hypothesis | None:
        found = self.fitter.fit(members)
        return None if found is None else self.of(found)

    def _beyond_forms(self, fit: Fit, which: int) -> float:
        """Return what an effect earns beside other forms of the laws of its set."""
        effect = fit.members[which].effect
        if effect.sensor and not effect.carries:
            return beyond_forms(self.problem, fit, which)
        less = self.fitter.fit([m for i, m in enumerate(fit.members) if i != which])
        return np.inf if less is None else past_forms(self.problem, less, fit)

    def _driven_more(self, fit: Fit, which: int) -> float:
        """Return what a law earns beyond its simpler one by the motion that the test imposes."""
        name = fit.members[which].effect.plainer
        plainer = next((e for e in self.problem.effects if e.name == name), None)
        if plainer is None or self.driven is None:
            return np.inf
        simple = Member(plainer, plainer.trials(self.problem.ctx)[0])
        twin = (*fit.members[:which], simple, *fit.members[which + 1 :])
        return self.driven.more(fit.members, twin)

    def _yielding(self, fit: Fit) -> list[Member] | None:
        """Return a set with yielding in place of its bristles, and of a stated spring's change."""
        bristles = next(n for n in self.laws.also if n in fit.names)
        name = self.laws.also[bristles]
        yielding = next((e for e in self.problem.effects if e.name == name), None)
        if yielding is None:
            return None
        return [
            Member(yielding, yielding.like(m.trial)) if m.name == bristles else m
            for m in fit.members
            if self.problem.ctx.k_free or m.name != self.laws.stiffness
        ]


def rounding(problem: ResidualProblem, fit: Fit) -> float:
    """Return how improbable the readings of a coarse load cell are with a set, -2 ln."""
    case, found = problem.case, problem.estimate
    if found.read is None:
        return 0.0
    reading = case.channels["f_meas"]
    force_n = force_of(problem, fit)
    return coarse.deviance(force_n, reading, found.read, found.step_n, found.sigma_n)


def slow_power(problem: ResidualProblem, fit: Fit) -> float:
    """Return the mean power of the slowest lines of a residual, in units of its noise.

    The lines are half cosines over the recording, as of a cosine transform: a straight line is
    nearly the first one. Rows that are not evaluated are left out.
    """
    rows = problem.rows
    phase = np.pi * (rows - rows[0]) / max(int(rows[-1] - rows[0]), 1)
    return _power(np.cos(np.outer(np.arange(1, SLOW_LINES + 1), phase)), fit.residual)


def near_power(problem: ResidualProblem, fit: Fit, which: int) -> float:
    """Return the same for the lines next to that of an effect, whole periods of the test apart."""
    t, member = problem.ctx.t[problem.rows], fit.members[which]
    first, last = NEAR_LINES
    apart = np.arange(first, last + 1) / max(float(t[-1] - t[0]), problem.ctx.dt)
    apart = np.r_[-apart, apart]
    angle = 2.0 * np.pi * np.outer(member.trial.theta[0] + apart, t - t[0])
    return _power(np.vstack([np.cos(angle), np.sin(angle)]), fit.residual)


def line_of_others(problem: ResidualProblem, fit: Fit, which: int) -> float:
    """Return the force without an effect of one frequency there, relative to its largest line."""
    others = (contribution(problem, fit, i) for i in range(len(fit.members)) if i != which)
    force = sum(others, problem.ctx.total)
    f_hz = fit.members[which].trial.theta[0]
    return mains.line_at(np.asarray(force), f_hz, problem.ctx.dt)


def _power(lines: Floats, residual: Floats) -> float:
    """Return the mean power of a residual, (n,), along some lines, (m, n), without its mean."""
    lines = lines - lines.mean(axis=1, keepdims=True)
    return float(np.mean((lines @ residual) ** 2 / np.sum(lines**2, axis=1)))


def beyond_forms(problem: ResidualProblem, fit: Fit, which: int) -> float:
    """Return what a load cell effect earns if the others may take any smooth form."""
    ctx, own = problem.ctx, problem.columns(fit.members[which])
    over = [(ctx.x, ctx.x_range), (ctx.v, ctx.v_range)]
    near = [problem.base]
    for i, member in enumerate(fit.members):
        if i != which:
            near.append(problem.columns(member))
            forms = [] if member.effect.sensor else neighbours(contribution(problem, fit, i), over)
            near += [problem.seen(column)[:, None] for column in forms]
    design = np.column_stack(near)
    design /= np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-300)
    both = np.column_stack([problem.y, own])
    y, *mine = (both - design @ np.linalg.lstsq(design, both, rcond=1e-9)[0]).T
    alone = np.column_stack(mine)
    left = y - alone @ np.linalg.lstsq(alone, y, rcond=None)[0]
    return float(y @ y - left @ left)


def drift(problem: ResidualProblem, fit: Fit, laws: Laws) -> DriftRates:
    """Return the drift of a set as shown by the halves of the recording."""
    member = next(m for m in fit.members if m.name in laws.wanders)
    rest = [problem.columns(m) for m in fit.members if m is not member]
    level = [] if laws.zeros & set(fit.names) else [problem.seen(np.ones(problem.ctx.t.size))]
    design = np.column_stack([problem.columns(member), *rest, problem.base, *level])
    size = np.sqrt(np.mean(design**2, axis=0))
    size[size == 0.0] = 1.0
    design /= size
    rates, widths = [], []
    middle = problem.y.size // 2
    for part in (slice(None, middle), slice(middle, None)):
        d, y = design[part], problem.y[part]
        inverse = np.linalg.pinv(d.T @ d, hermitian=True)
        beta = inverse @ (d.T @ y)
        rates.append(float(beta[0]))
        widths.append(float(inverse[0, 0]) * inflation(y - d @ beta))
    weights = 1.0 / np.maximum(np.array(widths), 1e-300)
    within = float(np.sum(weights * np.array(rates)) / np.sum(weights))
    whole = float(fit.betas[fit.members.index(member)][0]) * float(size[0])
    x, v = problem.ctx.x[problem.rows], problem.ctx.v[problem.rows]
    still = np.abs(v) < STILL * problem.ctx.v_range
    fewest = min(
        np.inf if np.mean(still[half]) > RESTS else cycles(x[half])
        for half in (slice(None, middle), slice(middle, None))
    )
    return DriftRates(whole, within, float(np.sum(weights)) ** -0.5, fewest)


def cycles(x: Floats) -> float:
    """Return the number of cycles of a displacement, (n,): half of how often it changes sides.

    Small cycles about another displacement than the middle of its range are not counted.
    """
    low, high = float(np.min(x)), float(np.max(x))
    aside = (2.0 * x - high - low) / max(high - low, 1e-300)
    sides = np.sign(aside[np.abs(aside) > ASIDE])
    return 0.5 * (1 + np.count_nonzero(np.diff(sides)))


def _fold_rows(problem: ResidualProblem, fit: Fit, blocks: Sequence[Floats]) -> float:
    """Return the number of rows of a block, of which every event must have some in each fold.

    A stop that is reached once acts for a tenth of a second. How long a set acts, in rows, is the
    square of the sum of its power over the sum of the squares (its participation ratio).
    """
    usual = max(FOLD_S * problem.case.fs_hz, BLOCK_LEAST)
    power = sum((c @ beta for c, beta in zip(blocks, fit.betas, strict=True)), 0.0 * problem.y) ** 2
    acts = problem.thin * float(np.sum(power)) ** 2 / max(float(np.sum(power**2)), 1e-300)
    if acts < FOLDS * BLOCK_LEAST:
        return usual
    return float(np.clip(acts / (2 * FOLDS), BLOCK_LEAST, usual))


def held_out_gain(problem: ResidualProblem, fit: Fit) -> float:
    """Return how much of a set's gain is confirmed on blocks to which it was not fitted.

    Blocks of a quarter of a second, or less, alternate between the folds, so that each fold
    contains part of every event.
    """
    blocks = problem.blocks(fit.members)
    design = np.column_stack([*blocks, problem.base])
    width = sum(b.shape[1] for b in blocks)
    scale = np.sqrt(np.mean(design**2, axis=0))
    scale[scale == 0] = 1.0
    design = design / scale
    ridge = np.zeros(design.shape[1])
    pin = np.zeros(design.shape[1])
    j = 0
    for m in fit.members:
        (_, pinned), _ = m.effect.settings(problem.ctx, m.trial)
        for sigma in pinned:
            if sigma is not None:
                ridge[j] = 1.0 / (sigma * scale[j]) ** 2
                pin[j] = 1.0 / (sigma**2 * scale[j])
            j += 1
    for nuisance in problem.nuisances:
        if nuisance.sigma is not None:
            ridge[j] = 1.0 / (nuisance.sigma * scale[j]) ** 2
        j += 1
    block = (problem.rows / _fold_rows(problem, fit, blocks)).astype(int)
    before = after = 0.0
    y = problem.y
    for fold in range(FOLDS):
        out = block % FOLDS == fold
        for use in (True, False):
            part = slice(0 if use else width, None)
            d = design[:, part]
            gram = d[~out].T @ d[~out] + np.diag(ridge[part] + 1e-9 * y.size)
            right = d[~out].T @ y[~out] + pin[part]
            beta = np.linalg.solve(gram, right) if gram.size else np.zeros(0)
            rest = y[out] - d[out] @ beta
            # The prior is included: moving a stated value has the same cost.
            prior = float(np.sum(np.where(pin[part] > 0, 0.0, ridge[part] * beta**2))) / FOLDS
            if use:
                after += float(rest @ rest) + prior
            else:
                before += float(rest @ rest) + prior
    whole = solve(problem, [], [])
    gain = (whole.chi2 if whole else before) - fit.chi2
    return (before - after) / gain if gain > 0 else 0.0
