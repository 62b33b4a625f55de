"""The residual of one recording, the sets of effects that may explain it, and their price.

Possible errors of the model within its stated tolerances are nuisance columns with a prior.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import modulation, spring_history
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.effects import having, of_number
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Trial
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.gaps import Rows
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.spectral import low_passed, rests

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
        scatter: the same from the residual itself, see `refinement.clustered`; for a simulated
            motion only.
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
            and not self._is_its_own_form(fit)
            and not any(m.effect.borders(m.trial) in fit.names for m in fit.members)
        )

    def _is_its_own_form(self, fit: Fit) -> bool:
        """Return whether a law in another form is mostly the difference to a stated number's.

        Together with that number, which then moves the other way, it is anything of that shape.
        """
        shaped = {m.effect.number for m in fit.members if m.effect.number and m.trial.theta}
        moved = zip(fit.nuisance, self.nuisances, strict=True)
        return any(n.number in shaped and n.sigma and abs(b) > n.sigma for b, n in moved)

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
    """Return the price of an effect; one that only changes a stated value involves no selection.

    Any more parameters of such an effect are those of its form.
    """
    known = {n.name for n in problem.nuisances if n.sigma is not None}
    if effect.name not in known or effect.late:
        return penalty(problem.ln_n, count)
    return POLICY.stated_number_price + problem.ln_n * (count - len(effect.params))
