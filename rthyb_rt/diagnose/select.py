"""Which set of effects explains a force residual: singles, pairs and triples together.

All trial shapes of all effects become columns of one dictionary. Their products are stored block by
block in time, so that any set of effects can be solved, and any block held out, without reading the
rows again. Possible errors of the model within its stated tolerances are nuisance columns with a
prior.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import modulation, spring_history
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.effects import having, of_number
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Trial
from rthyb_rt.diagnose.estimate import Estimate, Rows, fast_length, low_passed, rests
from rthyb_rt.diagnose.policy import POLICY

BLOCKS = 16
STRETCHES = 24
"""Number of stretches of a recording whose misfits scatter independently."""
ROWS_MAX = 24_000
"""Number of rows that a search uses; a longer recording is thinned."""
LONG = 4
"""Multiple of this from which a search whitens pieces of the recording instead of all of it."""
PIECE = 1024
"""Number of rows of such a piece."""
KEPT = 64
"""Number of cached blocks of columns, a few tenths of a megabyte each."""
SLOPES = 101
"""Number of displacements, over the range of motion, at which the slope of a spring is taken."""


@dataclass(frozen=True)
class Nuisance:
    """A column that is always present: a possible error that is not a finding.

    Attributes:
        name: name of the equivalent effect, or of its own if there is none.
        column: its force per unit, (n,), N.
        sigma: its standard deviation; None: free.
        plain: description in words.
        unit: unit of its adjustment; "%" of a relative one.
        number: the number of the model that it changes; empty: none.
        effect: the effect that it replaces by changing a stated value; empty: none.
        cell: whether it belongs to the load cell, so that no effect carries it.
        stated: whether much more than its standard deviation contradicts the model.
    """

    name: str
    column: Floats
    sigma: float | None
    plain: str
    unit: str
    number: str = ""
    effect: str = ""
    cell: bool = False
    stated: bool = True

    def moves(self, model: Model, by: float) -> Model:
        """Return a model with the number changed: the stiffness relatively, others absolutely."""
        if not self.number:
            return model
        old = getattr(model, self.number)
        now = old * (1.0 + by) if self.number == "k" else old + by
        return replace(model, **{self.number: now})


@dataclass(frozen=True)
class Member:
    """An effect in one shape."""

    effect: Effect
    trial: Trial

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name


def columns_of(ctx: Context, members: Sequence[Member]) -> list[list[Floats]]:
    """Return the columns of each effect of a set, each (n,), N, as the load cell shows them."""
    cells = [m for m in members if m.effect.carries]

    def of(member: Member) -> list[Floats]:
        def own(along: Context) -> list[Floats]:
            return list(member.effect.columns(along, member.trial))

        return own(ctx) if member.effect.sensor else _read_by(cells, ctx, own)

    return [of(m) for m in members]


def _read_by(
    cells: Sequence[Member], ctx: Context, forces: Callable[[Context], list[Floats]]
) -> list[Floats]:
    """Return forces along a motion as each of these cells in turn shows them, each (n,), N."""
    if not cells:
        return forces(ctx)
    *first, last = cells
    return last.effect.reading(ctx, last.trial, lambda along: _read_by(first, along, forces))


def bending(problem: ResidualProblem, members: Sequence[Member]) -> list[Floats]:
    """Return the nuisance columns, each (n,), N, as the load cell shows them.

    Nuisance forces on the specimen pass through the load cell like the specimen's force.
    """
    cells = [m for m in members if m.effect.carries]
    if not cells:
        return [n.column for n in problem.nuisances]

    def forces(along: Context) -> list[Floats]:
        here = along is problem.ctx
        all_of_them = problem.nuisances if here else problem.nuisances_along(along)
        return [n.column for n in all_of_them if not n.cell]

    shown = iter(_read_by(cells, problem.ctx, forces))
    return [n.column if n.cell else next(shown) for n in problem.nuisances]


def leaning(problem: ResidualProblem, fit: Fit) -> Floats:
    """Return what the nuisance parameters of a fit add to the model's force, (n,), N."""
    out = np.zeros(problem.ctx.t.size)
    for b, column in zip(fit.nuisance, bending(problem, fit.members), strict=True):
        out += b * column
    return out


def whole(problem: ResidualProblem, fit: Fit, ctx: Context) -> Floats:
    """Return the entire force of a fit along another motion: effects, model, nuisance, N.

    Of shape (n,), as the load cell shows it.
    """
    along = copy(problem)
    along.ctx, along.nuisances = ctx, problem.nuisances_along(ctx)
    columns = columns_of(ctx, fit.members)
    parts = [
        b * c
        for beta, own in zip(fit.betas, columns, strict=True)
        for b, c in zip(beta, own, strict=True)
    ]
    return np.asarray(ctx.total + leaning(along, fit) + np.sum(parts, axis=0))


def names_of(members: Iterable[Member]) -> tuple[str, ...]:
    """Return the sorted names of a set of effects, with those of a joint law listed separately."""
    return tuple(sorted(n for m in members for n in m.effect.names))


@dataclass
class Fit:
    """A set of effects fitted to the residual.

    Attributes:
        members: effects with their shapes.
        betas: linear coefficients of each.
        chi2: sum of squares of the whitened residual and of the priors.
        count: number of fitted parameters.
        residual: whitened, evaluated rows; empty before refinement.
        covariance: of (log shapes, coefficients), before scaling.
        scatter: the same from the residual itself, see `clustered`; for a simulated motion only.
        start: initial displacement, m, and velocity, m/s, of that motion.
        lost: what its input was fitted to be where it was not recorded, see `freebody.Body`.
    """

    members: tuple[Member, ...]
    betas: tuple[Floats, ...]
    chi2: float
    count: int
    nuisance: Floats = field(default_factory=lambda: np.zeros(0))
    residual: Floats = field(default_factory=lambda: np.zeros(0))
    covariance: Floats | None = None
    scatter: Floats | None = None
    start: tuple[float, float] | None = None
    lost: tuple[float, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Sorted names, with those of a joint law listed separately."""
        return names_of(self.members)


class ResidualProblem:
    """The residual of one recording, the nuisance columns, and the dictionary of effects."""

    def __init__(
        self,
        case: Case,
        ctx: Context,
        estimate: Estimate,
        effects: Iterable[Effect],
        blurred: bool | None = None,
    ) -> None:
        self.case, self.ctx, self.estimate = case, ctx, estimate
        self.blurred = not estimate.exact if blurred is None else blurred
        self.loudness = 1.0
        self.cut_hz: float | None = None
        self._blocks: OrderedDict[tuple[Any, ...], Floats] = OrderedDict()
        self._kept: tuple[tuple[Any, ...], list[Nuisance], Floats] | None = None
        rows = np.flatnonzero(estimate.rows)
        self.thin = max(1, -(-rows.size // ROWS_MAX))
        self.rows = rows[:: self.thin]
        self.pieces: Pieces | None = None
        if self.thin >= LONG and estimate.pieces is not None:
            self.pieces = _pieces(estimate, ctx)
            self.rows = self.pieces.rows
        self.remembers = spring_history.matters(case, ctx.x)
        self.y = self.seen(estimate.force - ctx.total)
        self.nuisances = list(self._nuisances(ctx))
        self.base = np.column_stack(
            [self.seen(n.column) for n in self.nuisances] or [np.zeros((self.y.size, 0))]
        )
        catalogue = list(effects)
        free = {n.name for n in self.nuisances if n.sigma is None}
        self.effects = [e for e in catalogue if self._admitted(e)]
        if case.further and case.model.family != "loop":
            possible = [e for e in catalogue if e.name in free or e in self.effects]
            self.effects += modulation.forms(possible, case.further, free)
        self.ln_n = float(np.log(max(self.y.size, 2)))

    def _admitted(self, effect: Effect) -> bool:
        model = self.case.model
        names = {n.name for n in self.nuisances if n.sigma is None}
        if effect.name in names:
            return False
        if effect.number == "moving_mass" and self.decays and model.k_tol is None:
            return False
        cell = "f_meas" in self.case.channels and model.family != "forced"
        if effect.sensor and model.family in ("forced", "ground") and not cell:
            return model.family in effect.on_body
        return not quasi(self.case) or effect.static

    @property
    def decays(self) -> bool:
        """Whether no force acts on a body: then its mass scales all forces, and is fixed."""
        return self.case.model.family == "forced" and not np.any(self.ctx.force)

    def nuisances_along(self, ctx: Context) -> list[Nuisance]:
        """Return the nuisance columns along another motion."""
        return list(self._nuisances(ctx))

    def _nuisances(self, ctx: Context) -> Iterable[Nuisance]:
        model = self.case.model
        if model.k:
            name = of_number("k")
            yield Nuisance(name, ctx.spring, model.k_tol, "stiffness", "%", number="k", effect=name)
        if model.c:
            sigma = None if model.c_tol is None else model.c_tol * abs(model.c)
            name = of_number("c")
            yield Nuisance(name, ctx.v, sigma, "damping", "N s/m", number="c", effect=name)
        if self.remembers:
            past = spring_history.column(self.case, ctx.x)
            yield Nuisance("history", past, 1.0, "spring history", "", stated=False)
        mass = of_number("moving_mass")
        massive = bool(model.moving_mass) or model.family == "forced"
        if model.k_tol is None and massive and not self.decays:
            yield Nuisance(mass, ctx.a, None, "moving mass", "kg", number="moving_mass")
        if quasi(self.case):
            return
        if "f_meas" in self.case.channels and self.case.tare_error_n:
            name = min(having(lambda e: e.zero))
            one, sigma = np.ones_like(ctx.t), self.case.tare_error_n
            yield Nuisance(name, one, sigma, "zero of the load cell", "N", cell=True)
        if model.k_tol is not None and self.blurred:
            # An estimated acceleration is slightly too small: not a finding about the mass.
            kg = model.whole_mass
            if kg > 0.0:
                yield Nuisance("blur", ctx.a, POLICY.mass_blur * kg, "mass", "kg", effect=mass)
        if model.family == "forced":
            late = np.gradient(ctx.force) / ctx.dt
        elif model.family == "ground" and "f_meas" not in self.case.channels:
            late = model.mass * np.gradient(ctx.other["ag"]) / ctx.dt
        else:
            late = -np.gradient(ctx.total) / ctx.dt
        yield Nuisance("skew", late, POLICY.offset_prior_s, "time offset", "s", cell=True)

    def frees(self, number: str) -> bool:
        """Return whether a number of the model is refitted without a tolerance."""
        return any(n.number == number and n.sigma is None for n in self.nuisances)

    def late_as(self, rate: Floats) -> None:
        """Replace the column of the time offset, given this rate of the force, (n,), N/s."""
        self.nuisances = [
            replace(n, column=rate) if n.name == "skew" else n for n in self.nuisances
        ]
        self.base = np.column_stack([self.seen(n.column) for n in self.nuisances])

    def rescale(self, factor: float) -> None:
        """Increase the noise by ``sqrt(factor)``: coloured noise makes rows less informative."""
        root = float(np.sqrt(factor))
        self.loudness *= root
        self.y = self.y / root
        self.base = self.base / root

    def seen(self, column: Floats) -> Floats:
        """Return a force as evaluated: whitened, evaluated rows only."""
        if self.cut_hz is not None:
            column = low_passed(column, self.case.fs_hz, self.cut_hz)
        pieces, whiten = self.pieces, self.estimate.pieces
        if pieces is None or whiten is None:
            return self.estimate.whiten(column)[self.rows] / self.loudness
        clean = whiten(column, pieces.first, PIECE)
        return np.asarray(clean[pieces.judged] / self.loudness)

    def below(self, cut_hz: float) -> ResidualProblem:
        """Return the same problem up to a frequency: its residual and all its columns."""
        return self._seen_anew(cut_hz, self.rows)

    def within(self, seconds: float) -> ResidualProblem:
        """Return the same problem without rows this near to an end at which the motion goes on.

        Of each end, a sixth of the recording at most; the problem itself if there are none.
        """
        size, fs_hz = self.ctx.t.size, self.case.fs_hz
        cut = min(int(seconds * fs_hz), size // 6)
        first, last = (0 if rest else cut for rest in rests(self.ctx.x, fs_hz))
        kept = self.rows[(self.rows >= first) & (self.rows < size - last)]
        if self.pieces is not None or kept.size == self.rows.size:
            return self
        return self._seen_anew(self.cut_hz, kept)

    def _seen_anew(self, cut_hz: float | None, rows: Rows) -> ResidualProblem:
        out = copy(self)
        out.cut_hz, out.rows, out._blocks, out._kept = cut_hz, rows, OrderedDict(), None
        out.y = out.seen(self.estimate.force - self.ctx.total)
        out.base = np.column_stack(
            [out.seen(n.column) for n in out.nuisances] or [np.zeros((out.y.size, 0))]
        )
        return out

    def sensible(self, fit: Fit, driving: bool = False) -> bool:
        """Return whether every effect of a fit, and its springs together, are physical.

        ``driving``: relaxation may stand beside a dashpot that would drive fast motion.
        """
        return (
            all(
                m.effect.sensible(self.ctx, m.trial, b)
                for m, b in zip(fit.members, fit.betas, strict=True)
            )
            and not self._gives_way(fit)
            and not self._holds_within_a_gap(fit)
            and not self._pushes(fit)
            and (driving or not self._undoes_a_push(fit))
            and not self._weighs_nothing(fit)
            and not self._begins_twice(fit)
            and not any(m.effect.borders(m.trial) in fit.names for m in fit.members)
        )

    def _begins_twice(self, fit: Fit) -> bool:
        """Return whether effects begin at different moments: two events, where one is rare.

        What breaks or comes loose may add several effects, but at once.
        """
        moments = [m.trial.theta[-1] for m in fit.members if m.effect.late]
        length = float(self.ctx.t[-1] - self.ctx.t[0])
        return bool(moments) and max(moments) - min(moments) > POLICY.same_moment * length

    def _weighs_nothing(self, fit: Fit) -> bool:
        """Return whether a set subtracts more mass than there is.

        Along a motion whose acceleration is proportional to its velocity, as behind a first-order
        lag, that would be a dashpot by another name.
        """
        model = self.case.model
        there = model.whole_mass
        added = [m.effect.mass_kg(b) for m, b in zip(fit.members, fit.betas, strict=True)]
        return there + sum(kg for kg in added if kg is not None) < 0.0

    def _holds_within_a_gap(self, fit: Fit) -> bool:
        """Return whether, within a gap, most of a stated spring acts: then it is a stop.

        With a stiffness that is stated too small by as much as the gap takes away, the force is
        that of the stated spring, and of a second one beyond a displacement.
        """
        if self.case.model.k_tol is None:
            return False
        pairs = list(zip(fit.members, fit.betas, strict=True))
        lost = [float(b[0]) for m, b in pairs if m.effect.interrupts]
        held = 1.0 + sum(float(b[0]) for m, b in pairs if m.effect.number == "k")
        return bool(lost) and held - sum(lost) > 1.0 - POLICY.gap_in_spring

    def _pushes(self, fit: Fit) -> bool:
        """Return whether a damping law adds energy to a naive model.

        The model's dashpot is refitted with it: a negative law first reduces that to zero, and
        drives the motion as soon as it is larger.
        """
        return self.case.model.k_tol is None and any(
            m.effect.dissipates and min(b) < 0.0
            for m, b in zip(fit.members, fit.betas, strict=True)
        )

    def _undoes_a_push(self, fit: Fit) -> bool:
        """Return whether relaxation stands beside a dashpot that, with the model's, is negative.

        Faster motion than its own leaves relaxation no damping: the two together would then drive
        the motion, which no passive specimen does. Within a band they can cancel and imitate
        anything. A dashpot that begins counts as well, and that of a naive model as far as it is
        more than an error of the fit.
        """
        sprung = [i for i, m in enumerate(fit.members) if m.effect.sprung]
        if not sprung:
            return False
        pairs = list(zip(fit.members, fit.betas, strict=True))
        added = [float(b[0]) for m, b in pairs if m.effect.number_at_last == "c"]
        held = zip(fit.nuisance, self.nuisances, strict=True)
        whole = self.case.model.c + sum(float(b) for b, n in held if n.number == "c") + sum(added)
        if whole >= 0.0:
            return False
        if added or not self.frees("c"):
            return bool(added)
        columns = columns_of(self.ctx, [fit.members[i] for i in sprung])
        force = sum(
            float(np.std(np.asarray(fit.betas[i]) @ np.array(own)))
            for i, own in zip(sprung, columns, strict=True)
        )
        return -whole * float(np.std(self.ctx.v)) > POLICY.dashpot_level * force

    def _gives_way(self, fit: Fit) -> bool:
        """Return whether, with a yielding law in a naive model, an elastic spring pushes outwards.

        What softens there is the loop. A polynomial that imitates this has a negative slope within
        the motion, and predicts nothing beyond it. Without a law of elasticity it is the model's
        spring, which a load on the specimen can turn negative (P-delta): up to a share of the
        specimen's elastic stiffness. The same is true of that spring beside bristles.
        """
        ctx = self.ctx
        if not ctx.k_free:
            return False
        elastic = [i for i, m in enumerate(fit.members) if m.effect.elastic]
        bristles_n_per_m = sum(
            m.effect.holds_n_per_m(ctx, m.trial, b)
            for m, b in zip(fit.members, fit.betas, strict=True)
        )
        if not any(m.effect.yields for m in fit.members) and (elastic or not bristles_n_per_m):
            return False
        x = np.linspace(-ctx.x_range, ctx.x_range, SLOPES)
        slope = np.diff(self._pulled(fit, x, elastic))
        least, most = float(slope.min()), float(np.abs(slope).max())
        if elastic and least < -POLICY.spring_level * most:
            return True
        # From rest, before anything yields; what the load cell adds holds nothing.
        first = np.array([0.0, 1e-3 * ctx.x_range / SLOPES])
        holding = [i for i, m in enumerate(fit.members) if m.effect.elastic or m.effect.yields]
        whole = np.diff(self._pulled(fit, first, holding))
        per_m = (SLOPES - 1) / (2.0 * ctx.x_range)
        held_n_per_m = float(whole[0]) / float(first[1]) + bristles_n_per_m
        return least * per_m < -POLICY.p_delta * held_n_per_m

    def _pulled(self, fit: Fit, x: Floats, which: Iterable[int]) -> Floats:
        """Return the force of the model's spring and of some effects along a slow motion, (n,)."""
        ctx = self.ctx
        still = ComputedMotion(x, np.zeros(x.size), np.zeros(x.size))
        t = np.linspace(0.0, 1.0, x.size)
        along = Context(ctx.model, still, t, still.v, {}, ctx.all_ranges)
        force = along.spring.copy()
        for b, nuisance in zip(fit.nuisance, self.nuisances, strict=True):
            if nuisance.number == "k":
                force += b * along.spring
        for i in which:
            member = fit.members[i]
            columns = member.effect.columns(along, member.trial)
            force += np.asarray(fit.betas[i]) @ np.array(columns)
        return np.asarray(force)

    def beside(self, members: Sequence[Member]) -> Floats:
        """Return the evaluated nuisance columns with a set, (rows, nuisances)."""
        cells = [m for m in members if m.effect.carries]
        if not cells:
            return self.base
        # Called several times for one set while the shape of its cell effect is unchanged.
        key, kept = (self.loudness, *((m.effect, m.trial) for m in cells)), self._kept
        if kept is None or kept[0] != key or kept[1] is not self.nuisances:
            seen = [self.seen(c) for c in bending(self, members)]
            self._kept = kept = (key, self.nuisances, np.column_stack(seen or [self.base]))
        return kept[2]

    def columns(self, member: Member) -> Floats:
        """Return the evaluated columns of an effect in one shape, (rows, coefficients)."""
        return self.blocks([member])[0]

    def blocks(self, members: Sequence[Member]) -> list[Floats]:
        """Return the evaluated columns of a set, each (rows, coefficients); read-only.

        The latest are cached: a search needs most of what it has refined again.
        """
        cells = [m for m in members if m.effect.carries]
        return [self._block(m, [] if m.effect.sensor else cells) for m in members]

    def _block(self, member: Member, cells: list[Member]) -> Floats:
        key = (self.loudness, *((m.effect, m.trial) for m in (member, *cells)))
        found = self._blocks.get(key)
        if found is None:
            columns = columns_of(self.ctx, [member, *cells])[0]
            found = np.column_stack([self.seen(c) for c in columns])
            # Each onset is an effect of its own.
            if not any(m.effect.late for m in (member, *cells)):
                self._blocks[key] = found
            if len(self._blocks) > KEPT:
                self._blocks.popitem(last=False)
        else:
            self._blocks.move_to_end(key)
        return found

    def changed(
        self, members: Sequence[Member], blocks: Sequence[Floats], which: int
    ) -> list[Floats]:
        """Return the blocks of a set in which one effect has a different shape."""
        if members[which].effect.carries:
            return self.blocks(members)
        alone = [members[which], *(m for m in members if m.effect.carries)]
        return [*blocks[:which], self.blocks(alone)[0], *blocks[which + 1 :]]


@dataclass(frozen=True)
class Pieces:
    """Stretches of a long recording that represent all of it.

    Attributes:
        first: first row of each, (m,).
        judged: which of their rows are evaluated, (m, PIECE).
        rows: those rows, in order.
    """

    first: Rows
    judged: NDArray[np.bool_]
    rows: Rows


def _pieces(estimate: Estimate, ctx: Context) -> Pieces:
    """Choose half of the pieces evenly, and half where the model's error is largest."""
    count = estimate.rows.size // PIECE
    most = ROWS_MAX // PIECE
    at = np.arange(count)
    rest = np.where(estimate.rows, estimate.force - ctx.total, 0.0)[: count * PIECE]
    off = np.sum(rest.reshape(count, PIECE) ** 2, axis=1)
    even = np.unique(np.linspace(0, count - 1, most // 2).astype(np.int64))
    loud = [i for i in at[np.argsort(-off)] if i not in set(even)][: most - even.size]
    first = np.sort(np.concatenate((even, np.array(loud, dtype=np.int64)))) * PIECE
    judged = estimate.rows[first[:, None] + np.arange(PIECE)]
    return Pieces(first, judged, (first[:, None] + np.arange(PIECE))[judged])


def quasi(case: Case) -> bool:
    """Return whether the recording's time is nominal."""
    from rthyb_rt.diagnose.estimate import quasi_static

    return quasi_static(case)


@dataclass(frozen=True)
class _Group:
    member: Member
    columns: tuple[int, ...]
    signs: str
    pinned: tuple[float | None, ...]
    count: int


@dataclass(frozen=True)
class Solved:
    """Sets of groups of one size, each solved.

    Attributes:
        chi2: of each, (m,).
        groups: of each, (m, size).
    """

    chi2: Floats
    groups: Rows

    def __len__(self) -> int:
        return self.chi2.size

    def __iter__(self) -> Iterator[tuple[float, tuple[int, ...]]]:
        return (
            (c, tuple(g)) for c, g in zip(self.chi2.tolist(), self.groups.tolist(), strict=True)
        )

    def where(self, kept: NDArray[np.bool_]) -> Solved:
        """Return a selection."""
        return Solved(self.chi2[kept], self.groups[kept])


class Dictionary:
    """All trial shapes of all effects, and their products block by block."""

    def __init__(
        self, problem: ResidualProblem, progress: Callable[[str], None] = lambda _: None
    ) -> None:
        self.problem = problem
        self.made = problem.loudness
        groups: list[_Group] = []
        columns: list[Floats] = []
        for effect in problem.effects:
            for trial in effect.trials(problem.ctx):
                member = Member(effect, trial)
                block = problem.columns(member)
                norms = np.sqrt(np.sum(block**2, axis=0))
                # No lower bound: depending on its unit, a coefficient's column may be arbitrarily
                # small.
                if not np.isfinite(norms).all() or not (norms > 0.0).any():
                    continue
                (signs, pinned), count = effect.settings(problem.ctx, trial)
                keep = [j for j in range(block.shape[1]) if norms[j] > 0]
                if keep != list(range(block.shape[1])):
                    continue
                first = len(columns)
                columns += [block[:, j] for j in keep]
                groups.append(
                    _Group(member, tuple(range(first, first + len(keep))), signs, pinned, count)
                )
            progress(effect.name)
        self.groups = groups
        self.costs = np.array([price(problem, g.member.effect, g.count) for g in groups])
        base = problem.base
        data = (
            np.column_stack([*columns, base, problem.y])
            if columns
            else np.column_stack([base, problem.y])
        )
        self.p, self.b = len(columns), base.shape[1]
        self.scale = np.sqrt(np.mean(data**2, axis=0))
        self.scale[self.scale == 0] = 1.0
        self.scale[-1] = 1.0
        data = data / self.scale
        self.cuts = np.linspace(0, data.shape[0], BLOCKS + 1).astype(int)
        self.data = data
        self.grams = np.stack([data[i:j].T @ data[i:j] for i, j in pairwise(self.cuts)])
        self.ridge = np.zeros(self.b)
        for j, nuisance in enumerate(problem.nuisances):
            if nuisance.sigma is not None:
                self.ridge[j] = 1.0 / (nuisance.sigma * self.scale[self.p + j]) ** 2
        self._pins()

    def _pins(self) -> None:
        self.pin_a, self.pin_b = np.zeros(self.p), np.zeros(self.p)
        self.pin_c = np.zeros(len(self.groups))
        for g, group in enumerate(self.groups):
            for j, sigma in zip(group.columns, group.pinned, strict=True):
                if sigma is not None:
                    s = self.scale[j]
                    self.pin_a[j] = 1.0 / (sigma * s) ** 2
                    self.pin_b[j] = 1.0 / (sigma**2 * s)
                    self.pin_c[g] += 1.0 / sigma**2

    def reduced(self, gram: Floats | None = None) -> tuple[Floats, Floats, float]:
        """Return the products after eliminating the nuisance: A, b and the sum of squares left."""
        g = self.grams.sum(axis=0) if gram is None else gram
        p, b = self.p, self.b
        bb = g[p : p + b, p : p + b] + np.diag(self.ridge + 1e-12 * g.diagonal()[p : p + b])
        cross = g[p : p + b]
        solved = np.linalg.solve(bb, cross) if b else cross
        rest = g - g[:, p : p + b] @ solved
        return rest[:p, :p], rest[:p, -1], float(rest[-1, -1])

    def beside(self, fit: Fit) -> tuple[Floats, Floats, float]:
        """Return the products after eliminating the nuisance and a set with free shapes."""
        return self.begun(fit, self.cuts[:-1])[0]

    def begun(self, fit: Fit, rows: Rows) -> list[tuple[Floats, Floats, float]]:
        """Return the same products for columns that begin at each of some rows, in order."""
        base, pins, y, extra = self._taken_out(fit)
        size = np.sqrt(np.maximum(np.sum(base**2, axis=0), 1e-200))
        base = base / size
        held = base.T @ base + np.diag(pins / size**2 + 1e-9)
        data, loudness = self.data[:, : self.p], self._loudness()
        beside = np.column_stack([base, y])
        from_base = np.linalg.solve(held, base.T @ y)
        left = float(y @ y - (base.T @ y) @ from_base) + extra
        # The products of the columns alone still contain the nuisance, which is not yet eliminated.
        gram, cross = np.zeros((self.p, self.p)), np.zeros((pins.size, self.p))
        right, end = np.zeros(self.p), y.size
        out = []
        for first in map(int, rows[::-1]):
            for part, whole in self._parts(first, end):
                own = data[part]
                if whole is None:
                    gram += (own.T @ own) / loudness**2
                else:
                    gram += self.grams[whole, : self.p, : self.p]
            # One product for nuisance, set and residual, because each reads all columns.
            products = beside[first:end].T @ data[first:end] / loudness
            cross += products[:-1]
            right += products[-1]
            end = first
            a = gram - cross.T @ np.linalg.solve(held, cross)
            out.append((a, right - cross.T @ from_base, left))
        return out[::-1]

    def _parts(self, first: int, end: int) -> Iterable[tuple[slice, int | None]]:
        """Divide a stretch of evaluated rows into blocks with known products, and the remainder."""
        inside = self.cuts[(self.cuts > first) & (self.cuts < end)]
        known = {(int(i), int(j)): b for b, (i, j) in enumerate(pairwise(self.cuts))}
        for i, j in pairwise([first, *map(int, inside), end]):
            yield slice(i, j), known.get((i, j))

    def _taken_out(self, fit: Fit) -> tuple[Floats, Floats, Floats, float]:
        """Return nuisance and set columns, their priors, the residual, and its own priors."""
        problem = self.problem
        blocks = [problem.beside(fit.members)]
        pins = [0.0 if n.sigma is None else n.sigma**-2 for n in problem.nuisances]
        y = problem.y
        extra = 0.0
        own = problem.blocks(fit.members)
        for i, (member, beta) in enumerate(zip(fit.members, fit.betas, strict=True)):
            block = own[i]
            (_, pinned), _ = member.effect.settings(problem.ctx, member.trial)
            # Relative to the fit: a coefficient fixed at one stays near it.
            y = y - block @ beta
            for b, sigma in zip(beta, pinned, strict=True):
                pins.append(0.0 if sigma is None else sigma**-2)
                extra += 0.0 if sigma is None else ((b - 1.0) / sigma) ** 2
            blocks.append(block)
        places = [(i, j) for i, m in enumerate(fit.members) for j in range(len(m.trial.theta))]
        for slope in _slopes(problem, fit.members, own, places, fit):
            blocks.append(slope[:, None])
            pins.append(0.0)
        return np.column_stack(blocks), np.array(pins), y, extra

    def _loudness(self) -> float:
        """Return the factor by which rows were scaled down since the dictionary was created."""
        return self.problem.loudness / self.made

    def singles(self) -> Solved:
        """Return chi2 of every group alone; unphysical ones are omitted."""
        return self.sets([(g,) for g in range(len(self.groups))])

    def sets(
        self,
        sets: Sequence[tuple[int, ...]] | Rows,
        reduced: tuple[Floats, Floats, float] | None = None,
    ) -> Solved:
        """Return chi2 of sets of groups of one size; unphysical ones are omitted."""
        if len(sets) == 0:
            return Solved(np.zeros(0), np.zeros((0, 1), dtype=np.int64))
        a, b, j0 = self.reduced() if reduced is None else reduced
        width = 2
        groups = np.array(sets)
        size = groups.shape[1] * width
        index = np.full((len(self.groups), width), -1)
        sign = np.zeros((len(self.groups), width), dtype=bool)
        for g, group in enumerate(self.groups):
            index[g, : len(group.columns)] = group.columns
            sign[g, : len(group.columns)] = [s == "+" for s in group.signs]
        out: list[tuple[Floats, Rows]] = []
        aa = a + np.diag(self.pin_a)
        bb = b + self.pin_b
        for part in np.array_split(np.arange(len(sets)), max(1, len(sets) // 40000)):
            cols = index[groups[part]].reshape(part.size, size)
            there = cols >= 0
            safe = np.where(there, cols, 0)
            mat = aa[safe[:, :, None], safe[:, None, :]]
            mat = np.where(there[:, :, None] & there[:, None, :], mat, 0.0)
            diag = np.arange(size)
            mat[:, diag, diag] = np.where(there, mat[:, diag, diag] * (1 + 1e-10) + 1e-12, 1.0)
            rhs = np.where(there, bb[safe], 0.0)
            try:
                beta = np.linalg.solve(mat, rhs[:, :, None])[:, :, 0]
            except np.linalg.LinAlgError:
                beta = np.stack(
                    [np.linalg.lstsq(m, r, rcond=None)[0] for m, r in zip(mat, rhs, strict=True)]
                )
            chi2 = j0 + self.pin_c[groups[part]].sum(axis=1) - np.sum(beta * rhs, axis=1)
            positive = sign[groups[part]].reshape(part.size, size)
            bad = np.any(positive & (beta < 0), axis=1) | ~np.isfinite(chi2)
            out.append((chi2[~bad], groups[part[~bad]]))
        return Solved(*map(np.concatenate, zip(*out, strict=True)))

    def penalties(self, groups: Rows) -> Floats:
        """Return the price of each of some sets, (m, size), (m,)."""
        return np.asarray(self.costs[groups].sum(axis=1))

    def penalty(self, groups: Sequence[int]) -> float:
        """Return the price of a set: for its parameters, and for its selection among many."""
        return sum(float(self.costs[g]) for g in groups)

    def best(self, found: Solved, most: int, variants: int = 1) -> list[tuple[int, ...]]:
        """Return the best sets of groups, up to ``most`` different sets of names, in order.

        For each set of names, up to ``variants`` shapes of different variants are returned.
        """
        scores = found.chi2 + self.penalties(found.groups)
        order = np.lexsort((*found.groups.T[::-1], scores))
        kept: dict[tuple[str, ...], dict[tuple[str, ...], tuple[int, ...]]] = {}
        for groups in (tuple(row) for row in found.groups[order].tolist()):
            parts = [self.groups[g].member for g in groups]
            names = names_of(parts)
            if len(set(names)) < len(names) or not compatible(parts):
                continue
            if names not in kept and len(kept) == most:
                continue
            shapes = kept.setdefault(names, {})
            form = tuple(m.trial.variant for m in sorted(parts, key=lambda m: m.name))
            if form not in shapes and len(shapes) < variants:
                shapes[form] = groups
        return [groups for shapes in kept.values() for groups in shapes.values()]

    def pairs(self) -> Solved:
        """Return chi2 of all pairs of different effects."""
        n = len(self.groups)
        names = np.array([hash(g.member.name) for g in self.groups])
        i, j = np.triu_indices(n, 1)
        differ = names[i] != names[j]
        return self.sets(np.column_stack([i[differ], j[differ]]))

    def extended(self, seeds: Sequence[tuple[int, ...]]) -> Solved:
        """Return chi2 of the seeds with one additional effect each."""
        sets = []
        for seed in seeds:
            names = {self.groups[g].member.name for g in seed}
            sets += [
                (*seed, g) for g, group in enumerate(self.groups) if group.member.name not in names
            ]
        return self.sets(sets)


def compatible(members: Sequence[Member]) -> bool:
    """Return whether effects may be combined.

    A contact has one law of friction: a second one would be another form of the first, and would
    absorb errors in the form of the first. The same applies to a joint law and one of its names.
    """
    if sum(m.effect.dry for m in members) > 1:
        return False
    names = [name for m in members for name in m.effect.names]
    if len(set(names)) < len(names):
        return False
    whole = [m for m in members if m.effect.complete]
    beside = [m for m in members if not m.effect.complete and not m.effect.sensor]
    return not whole or (len(whole) == 1 and not beside)


def penalty(ln_n: float, count: int) -> float:
    """Return the price of an effect with ``count`` parameters."""
    return count * ln_n + POLICY.effect_price


def price(problem: ResidualProblem, effect: Effect, count: int) -> float:
    """Return the price of an effect; one that only changes a stated value involves no selection."""
    known = {n.name for n in problem.nuisances if n.sigma is not None}
    moved = effect.name in known and not effect.late
    return POLICY.stated_number_price if moved else penalty(problem.ln_n, count)


def solve(
    problem: ResidualProblem, members: Sequence[Member], blocks: Sequence[Floats]
) -> Fit | None:
    """Solve for the linear coefficients of effects with given evaluated columns."""
    base = problem.beside(members)
    design = np.column_stack([*blocks, base]) if blocks else base
    y = problem.y
    if design.shape[1] == 0:
        return Fit((), (), float(y @ y), 0, residual=y)
    scale = np.sqrt(np.mean(design**2, axis=0))
    scale[scale == 0] = 1.0
    design = design / scale
    found = _solved(problem, members, design.T @ design, design.T @ y, scale)
    if found is None:
        return None
    real, inverse, chi2 = found
    ends = np.cumsum([0, *(b.shape[1] for b in blocks)])
    return Fit(
        tuple(members),
        tuple(real[i:k] for i, k in pairwise(ends)),
        chi2,
        sum(m.effect.settings(problem.ctx, m.trial)[1] for m in members),
        nuisance=real[ends[-1] :],
        residual=y - design @ (real * scale),
        covariance=inverse / np.outer(scale, scale),
    )


def _solved(
    problem: ResidualProblem, members: Sequence[Member], gram: Floats, right: Floats, scale: Floats
) -> tuple[Floats, Floats, float] | None:
    """Return coefficients, inverse and chi-squared of the normal equations of scaled columns.

    None if they have no solution, or a sign that no law permits.
    """
    extra, signs, j = 0.0, "", 0
    for member in members:
        (sign, pinned), _ = member.effect.settings(problem.ctx, member.trial)
        signs += sign[: len(pinned)]
        for sigma in pinned:
            if sigma is not None:
                gram[j, j] += 1.0 / (sigma * scale[j]) ** 2
                right[j] += 1.0 / (sigma**2 * scale[j])
                extra += 1.0 / sigma**2
            j += 1
    for nuisance in problem.nuisances:
        if nuisance.sigma is not None:
            gram[j, j] += 1.0 / (nuisance.sigma * scale[j]) ** 2
        j += 1
    gram[np.diag_indices_from(gram)] *= 1.0 + 1e-11
    try:
        inverse = np.linalg.inv(gram)
    except np.linalg.LinAlgError:
        return None
    beta = inverse @ right
    real = beta / scale
    if any(s == "+" and real[i] < 0 for i, s in enumerate(signs)):
        return None
    return real, np.asarray(inverse), float(problem.y @ problem.y + extra - beta @ right)


class Scan:
    """Chi-squared of a set in which only the last effect changes its shape.

    The products of the other columns are computed in advance.
    """

    def __init__(self, problem: ResidualProblem, members: Sequence[Member]) -> None:
        self.problem, self.rest = problem, list(members[:-1])
        self.blocks = problem.blocks(members)
        self.alone = not members[-1].effect.carries
        if self.alone:
            self.fixed = np.column_stack([*self.blocks[:-1], problem.beside(members)])
            self.before = sum(b.shape[1] for b in self.blocks[:-1])
            self.gram, self.right = self.fixed.T @ self.fixed, self.fixed.T @ problem.y

    def chi2(self, last: Member) -> float | None:
        """Return chi-squared with this shape of the last effect; None if it cannot be solved."""
        problem, members = self.problem, [*self.rest, last]
        blocks = problem.changed(members, self.blocks, len(self.rest))
        if not self.alone:
            fit = solve(problem, members, blocks)
            return None if fit is None else fit.chi2
        block, at = blocks[-1], self.before
        size = at + block.shape[1]
        order = np.r_[np.arange(at), np.arange(len(self.gram), len(self.gram) + size - at),
                      np.arange(at, len(self.gram))]  # fmt: skip
        cross = self.fixed.T @ block
        gram = np.block([[self.gram, cross], [cross.T, block.T @ block]])[np.ix_(order, order)]
        right = np.r_[self.right, block.T @ problem.y][order]
        scale = np.sqrt(gram.diagonal() / problem.y.size)
        scale[scale == 0] = 1.0
        found = _solved(problem, members, gram / np.outer(scale, scale), right / scale, scale)
        return None if found is None else found[2]


def refine(problem: ResidualProblem, members: Sequence[Member], steps: int = 8) -> Fit | None:
    """Fit the shape parameters as well, starting from the given shapes.

    Damped Gauss-Newton in their logarithms.
    """
    members = list(members)
    blocks = problem.blocks(members)
    fit = solve(problem, members, blocks)
    if fit is None or not any(m.trial.theta for m in members):
        return fit
    places = [(i, j) for i, m in enumerate(members) for j in range(len(m.trial.theta))]
    carried = any(m.effect.carries for m in members)
    damping = 1e-3
    for _ in range(steps):
        design = _design(problem, members, blocks, places, fit)
        gram = design.T @ design
        prior = priors_of(problem, members, len(places), gram.shape[0])
        # Units must not matter: columns are scaled to the same norm.
        unit = 1.0 / np.sqrt(np.maximum(gram.diagonal() + prior.diagonal(), 1e-300))
        held = np.r_[np.zeros(len(places)), *fit.betas, fit.nuisance]
        aim = np.zeros(held.size)
        aim[len(places) : held.size - fit.nuisance.size] = 1.0
        right = design.T @ fit.residual + prior.diagonal() * (aim - held)
        gram += prior
        improved = False
        for _ in range(4):
            damped = gram + damping * np.diag(
                np.r_[gram.diagonal()[: len(places)], np.zeros(gram.shape[0] - len(places))]
            )
            damped *= np.outer(unit, unit)
            damped[np.diag_indices_from(damped)] += 1e-12
            try:
                delta = (unit * np.linalg.solve(damped, unit * right))[: len(places)]
            except np.linalg.LinAlgError:
                break
            delta = np.clip(delta, -0.5, 0.5)
            trial_members = _stepped(problem, members, places, delta)
            trial_blocks = problem.blocks(trial_members) if carried else [
                problem.columns(m) if m.trial.theta else b
                for m, b in zip(trial_members, blocks, strict=True)
            ]  # fmt: skip
            attempt = solve(problem, trial_members, trial_blocks)
            if attempt is not None and attempt.chi2 < fit.chi2:
                gain = fit.chi2 - attempt.chi2
                members, blocks, fit = trial_members, trial_blocks, attempt
                damping = max(damping * 0.2, 1e-6)
                improved = True
                break
            damping *= 8.0
        if not improved:  # the slopes are still valid
            return _with_covariance(problem, members, design, len(places), fit)
        if gain < 1e-5 * fit.chi2 + 0.02:
            break
    design = _design(problem, members, blocks, places, fit)
    return _with_covariance(problem, members, design, len(places), fit)


def priors_of(problem: ResidualProblem, members: Sequence[Member], first: int, size: int) -> Floats:
    extra = np.zeros((size, size))
    j = first
    for m in members:
        (_, pinned), _ = m.effect.settings(problem.ctx, m.trial)
        for sigma in pinned:
            if sigma is not None:
                extra[j, j] = 1.0 / sigma**2
            j += 1
    for nuisance in problem.nuisances:
        if nuisance.sigma is not None:
            extra[j, j] = 1.0 / nuisance.sigma**2
        j += 1
    return extra


def _moved(problem: ResidualProblem, member: Member, j: int, step: float) -> Member | None:
    theta = list(member.trial.theta)
    low, high = member.effect.limits(problem.ctx, member.trial)[j]
    value = theta[j] * float(np.exp(step))
    if not low <= abs(value) <= high:
        return None
    theta[j] = value
    return Member(member.effect, Trial(tuple(theta), member.trial.variant))


def _stepped(
    problem: ResidualProblem,
    members: Sequence[Member],
    places: Sequence[tuple[int, int]],
    delta: Floats,
) -> list[Member]:
    out = list(members)
    for (i, j), d in zip(places, delta, strict=True):
        member = out[i]
        theta = list(member.trial.theta)
        low, high = member.effect.limits(problem.ctx, member.trial)[j]
        value = theta[j] * float(np.exp(d))
        theta[j] = float(np.copysign(np.clip(abs(value), low, high), value))
        out[i] = Member(member.effect, Trial(tuple(theta), member.trial.variant))
    return out


def design_of(problem: ResidualProblem, fit: Fit) -> Floats:
    """Return the slopes of the rows to (log shapes, coefficients, nuisance), (rows, p)."""
    blocks = problem.blocks(fit.members)
    places = [(i, j) for i, m in enumerate(fit.members) for j in range(len(m.trial.theta))]
    return _design(problem, fit.members, blocks, places, fit)


def unfiltered_slopes(problem: ResidualProblem, fit: Fit) -> Floats:
    """Return the slopes of the force itself to (log shapes, coefficients), (n, p), at every row."""
    bare = copy(problem)
    bare.estimate = replace(problem.estimate, whiten=lambda force: force, pieces=None)
    bare.rows, bare.pieces, bare.cut_hz, bare.loudness = (
        np.arange(len(problem.ctx.x)),
        None,
        None,
        1.0,
    )
    bare.y, bare._blocks, bare._kept = np.zeros(bare.rows.size), OrderedDict(), None
    places = [(i, j) for i, m in enumerate(fit.members) for j in range(len(m.trial.theta))]
    blocks = bare.blocks(fit.members)
    return np.column_stack([*_slopes(bare, fit.members, blocks, places, fit), *blocks])


def _design(
    problem: ResidualProblem,
    members: Sequence[Member],
    blocks: Sequence[Floats],
    places: Sequence[tuple[int, int]],
    fit: Fit,
) -> Floats:
    slopes = _slopes(problem, members, blocks, places, fit)
    return np.column_stack([*slopes, *blocks, problem.beside(members)])


def _slopes(
    problem: ResidualProblem,
    members: Sequence[Member],
    blocks: Sequence[Floats],
    places: Sequence[tuple[int, int]],
    fit: Fit,
) -> list[Floats]:
    """Return the slopes of the evaluated rows to the logarithm of each shape parameter."""
    jacobian = []
    for i, j in places:
        step = members[i].effect.steps(problem.ctx, members[i].trial)[j]
        moved = _moved(problem, members[i], j, step)
        if moved is None:
            step = -step
            moved = _moved(problem, members[i], j, step)
        slope = np.zeros(problem.y.size)
        if moved is not None and moved.effect.carries:
            # It changes every block: their sum is whitened in one pass.
            now_all = columns_of(problem.ctx, [*members[:i], moved, *members[i + 1 :]])
            pairs = zip(fit.betas, now_all, strict=True)
            force = sum(b * c for beta, own in pairs for b, c in zip(beta, own, strict=True))
            before = sum(old @ beta for old, beta in zip(blocks, fit.betas, strict=True))
            slope = (problem.seen(np.asarray(force)) - before) / step
        elif moved is not None:
            now = problem.changed([*members[:i], moved, *members[i + 1 :]], blocks, i)
            for new, old, beta in zip(now, blocks, fit.betas, strict=True):
                if new is not old:
                    slope += (new - old) @ beta / step
        jacobian.append(slope)
    return jacobian


def _with_covariance(
    problem: ResidualProblem, members: Sequence[Member], design: Floats, shapes: int, fit: Fit
) -> Fit:
    """Add the joint covariance of (log shapes, coefficients, nuisance)."""
    gram = design.T @ design + priors_of(problem, members, shapes, design.shape[1])
    scale = np.sqrt(np.maximum(gram.diagonal(), 1e-300))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    fit.covariance = inverse / np.outer(scale, scale)
    return fit


def clustered(design: Floats, residual: Floats, inverse: Floats) -> Floats:
    """Return the covariance of least squares from the residual itself, (p, p).

    Errors in the form of a law are correlated over a stretch of the recording and count there as
    one observation, not one per row: the sums of ``design * residual`` over stretches are taken as
    independent (Liang and Zeger, Biometrika 73 (1986) 13, with the factor g / (g - 1)).

    Args:
        design: slopes of the evaluated rows, (rows, p).
        residual: whitened, (rows,).
        inverse: inverse of the normal matrix including the priors, (p, p).
    """
    cuts = np.linspace(0, residual.size, STRETCHES + 1).astype(np.int64)
    scores = np.stack([design[i:j].T @ residual[i:j] for i, j in pairwise(cuts)])
    scores = (scores - scores.mean(axis=0)) @ inverse
    return np.asarray(scores.T @ scores * STRETCHES / (STRETCHES - 1))


def inflation(residual: Floats) -> float:
    """Return the inflation of evidence by a residual's colour and size (1 for unit white noise).

    The variance of a mean over many rows relative to that of unit white noise: variance times
    correlation length.
    """
    n = residual.size
    if n < 32:
        return max(1.0, float(np.mean(residual**2)))
    # Long enough that no lag considered wraps around in the transform.
    size = fast_length(n + n // 4)
    spectrum = np.abs(np.fft.rfft(residual - residual.mean(), size)) ** 2
    correlation = np.fft.irfft(spectrum, size)[: n // 4] / (n - np.arange(n // 4))
    variance = float(correlation[0])
    if variance <= 0:
        return 1.0
    rho = correlation / variance
    alone = rho < POLICY.hangs_together
    cut = int(np.argmax(alone)) if alone.any() else rho.size
    tau = 1.0 + 2.0 * float(np.sum(rho[1:cut]))
    return max(1.0, float(np.mean(residual**2)) * max(tau, 1.0))


def inflated(covariance: Floats, prior: Floats | None, by: float) -> Floats:
    """Return the covariance of parameters if rows are less informative than their number, (p, p).

    With the evidence of the rows, A, and of the priors, P, ``C = (A + P)^-1``: errors of the rows
    with ``by`` times the power give ``C (by A + P) C``. A stated tolerance does not grow with them.

    Args:
        covariance: C, (p, p).
        prior: P, (p, p); None: not known, so that everything grows.
        by: power of the errors relative to that assumed for A.
    """
    stated = np.zeros_like(covariance) if prior is None else covariance @ prior @ covariance
    return np.asarray(stated + by * (covariance - stated))
