"""Channels unknown to the model that modulate a law: voltage, current, temperature.

The friction of a magneto-rheological damper increases with its current, the drag of oil decreases
with its temperature. A law with a linear coefficient is tried with a coefficient that is linear in
the channel, ``f = (b0 + b1 g) c(t)`` with ``g`` the channel less its mean, in units of its standard
deviation. Two questions precede its price, both answered by the recording itself:

* Is it the channel, or would any signal of its kind do? The same channel shifted along the
recording,
  and reversed, has the same size and spectrum; none of them may gain as much
  (a permutation test; Theiler et al., Physica D 58 (1992) 77).
* Does it contain more than the motion? The part of a channel that follows from the instantaneous
  displacement, velocity and acceleration represents a law of those, not the channel: the remainder
  must earn its price alone, with at least half of the coefficient.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Trial
from rthyb_rt.diagnose.effects.sensor import shifted
from rthyb_rt.diagnose.policy import POLICY

if TYPE_CHECKING:
    from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem

GOLDEN = 0.6180339887498949
"""Shift, relative to the recording (the golden section): no period occurs twice."""


@dataclass(frozen=True)
class UnknownChannel:
    """A channel unknown to the model.

    Attributes:
        name: header of its column.
        mean, spread: over the recording, in the column's own unit.
    """

    name: str
    mean: float
    spread: float

    def of(self, ctx: Context) -> Floats:
        """Return the channel centred and scaled, (n,); zero where it was not recorded.

        As late as the motion.
        """
        values = ctx.other.get(self.name)
        if values is None:
            return np.zeros(ctx.t.size)
        if ctx.late_s:
            values = shifted(values, ctx.late_s / ctx.dt)
        return (values - self.mean) / self.spread


class Modulated(Effect):
    """A law whose coefficient is linear in a channel."""

    begins = False

    def __init__(self, effect: Effect, channel: UnknownChannel, bare: bool) -> None:
        """Store the law, the channel, and whether the law's mean is already free."""
        self.effect, self.channel, self.bare = effect, channel, bare
        self.name = f"{effect.name}*{channel.name}"
        self.params = effect.params
        self.equation = f"{effect.equation}, its coefficient linear in {channel.name}"
        self.fingerprint = f"{effect.fingerprint}, and its size follows {channel.name}"
        self.shown_by = effect.shown_by
        self.dissipates, self.yields, self.sprung = effect.dissipates, effect.yields, effect.sprung

    @property
    def names(self) -> tuple[str, ...]:
        """The law's own name."""
        return self.effect.names

    def in_words(self) -> str:
        """Return a description of the addition to the law."""
        return f"how {self.effect.name} changes with {self.channel.name}"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return the law's trials that have one free coefficient."""
        return [t for t in self.effect.trials(ctx) if _single(self.effect, ctx, t)]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the law, and the law times the channel."""
        (column,) = self.effect.columns(ctx, trial)
        by = column * self.channel.of(ctx)
        return [by] if self.bare else [column, by]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return the law's settings, and those of the channel's coefficient."""
        (sign, _), count = self.effect.settings(ctx, trial)
        if self.bare:
            return ("*", (None,)), count
        return (f"{sign}*", (None, None)), count + 1

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Return the law's limits."""
        return self.effect.limits(ctx, trial)

    def settling_s(self, trial: Trial) -> float:
        """Return the law's own time."""
        return self.effect.settling_s(trial)

    def steps(self, ctx: Context, trial: Trial) -> list[float]:
        """Return the law's steps."""
        return self.effect.steps(ctx, trial)

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return the law's verdict at both ends of the channel's range."""
        if self.bare:
            return True
        g = self.channel.of(ctx)
        ends = [float(beta[0] + beta[1] * end) for end in (g.min(), g.max())]
        (sign, _), _ = self.effect.settings(ctx, trial)
        if sign == "+" and min(ends) < POLICY.modulation_turned * abs(float(beta[0])):
            return False
        return self.effect.sensible(ctx, trial, beta[:1])

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the law's parameters at the channel's mean; if alone, the change per unit."""
        mean = beta[:1] / self.channel.spread if self.bare else beta[:1]
        return self.effect.report(ctx, trial, np.asarray(mean))

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law's form."""
        return self.effect.form(ctx, trial)

    def slope(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, Any]:
        """Return how the channel changes the law, for the answer.

        Keys: ``channel``; ``mean`` of the channel, at which the law has its parameters; ``param``
            and
        ``per_unit``, the parameter proportional to the force and its change per unit of the
        channel; ``relative_per_unit``, that change relative to its value at the mean.
        """
        per = float(beta[-1]) / self.channel.spread
        unit = self.effect.report(ctx, trial, np.array([1.0]))
        twice = self.effect.report(ctx, trial, np.array([2.0]))
        param = next((k for k in unit if np.isclose(twice[k], 2.0 * unit[k])), "")
        out: dict[str, Any] = {"channel": self.channel.name, "mean": self.channel.mean}
        if param:
            out |= {"param": param, "per_unit": per * unit[param]}
        if not self.bare and beta[0] != 0.0:
            out["relative_per_unit"] = per / float(beta[0])
        return out

    def at_mean(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the elements of the law at the channel's mean."""
        return [] if self.bare else self.effect.elements(ctx, trial, beta[:1])


def in_form(effect: Effect, ctx: Context, trial: Trial, beta: Floats) -> tuple[str, dict[str, Any]]:
    """Return the form of a law in words, and its modulation for the answer ({} without one)."""
    form = effect.form(ctx, trial)
    if not isinstance(effect, Modulated):
        return form, {}
    slope = effect.slope(ctx, trial, beta)
    if "per_unit" in slope:
        kind = next((p.unit for p in effect.params if p.name == slope["param"]), "")
        size = f"{slope['per_unit']:+.3g} {kind}".strip()
    else:
        size = f"{100.0 * slope.get('relative_per_unit', np.nan):+.3g} %"
    return f"{form}; modulated by {effect.channel.name}: {size} per unit of it", slope


def in_words(names: Iterable[str], slopes: Iterable[dict[str, Any]]) -> list[str]:
    """Return a note for each law of an answer that a channel modulates."""
    out = []
    for name, slope in zip(names, slopes, strict=True):
        if "per_unit" in slope:
            said = f"{slope['param']} {slope['per_unit']:+.4g} for each of its units"
        elif slope:
            said = f"its force by {100.0 * slope.get('relative_per_unit', np.nan):+.3g} % for each"
        if slope:
            out.append(
                f"{name} changes with {slope['channel']}: {said}; its parameters are those at the "
                f"mean, {slope['mean']:.4g}"
            )
    return out


def _single(effect: Effect, ctx: Context, trial: Trial) -> bool:
    """Return whether a law has one coefficient in this shape, and it is free."""
    (signs, pinned), _ = effect.settings(ctx, trial)
    return len(signs) == 1 and pinned == (None,)


def channels(further: dict[str, Floats]) -> list[UnknownChannel]:
    """Return the additional channels that can be tried: the first few that vary."""
    out = []
    for name, values in further.items():
        good = values[np.isfinite(values)]
        if good.size > POLICY.numbers_least * values.size and np.std(good) > 0.0:
            out.append(UnknownChannel(name, float(np.mean(good)), float(np.std(good))))
    return out[: POLICY.modulation_channels]


def forms(effects: Iterable[Effect], further: dict[str, Floats], free: set[str]) -> list[Modulated]:
    """Return the laws of the specimen modulated by each channel unknown to the model.

    Args:
        effects: the catalogue.
        further: such channels of the recording, each (n,).
        free: names of laws that are refitted without a price: only the channel's part is needed.
    """
    laws = [e for e in effects if not e.sensor and len(e.names) == 1]
    return [Modulated(e, c, e.name in free) for c in channels(further) for e in laws]


def modulated(problem: ResidualProblem, fit: Fit) -> list[tuple[Member, ...]]:
    """Return a set with one of its laws, or one that is always present, modulated by a channel."""
    from rthyb_rt.diagnose.problem import Member

    out: list[tuple[Member, ...]] = []
    by_law: dict[str, list[Modulated]] = {}
    for effect in problem.effects:
        if isinstance(effect, Modulated):
            by_law.setdefault(effect.effect.name, []).append(effect)
    for i, m in enumerate(fit.members):
        if _single(m.effect, problem.ctx, m.trial):
            out += [
                (*fit.members[:i], Member(e, m.trial), *fit.members[i + 1 :])
                for e in by_law.get(m.name, [])
            ]
    there = {n for m in fit.members for n in m.effect.names}
    always = {n.name for n in problem.nuisances} - there
    out += [
        (*fit.members, Member(e, Trial()))
        for name, changed in by_law.items()
        for e in changed
        if name in always
    ]
    return out


def holds(problem: ResidualProblem, fit: Fit) -> bool:
    """Return whether each modulation of a set is due to its channel; see the module."""
    return all(
        _holds(problem, fit, i)
        for i, m in enumerate(fit.members)
        if isinstance(m.effect, Modulated)
    )


def _holds(problem: ResidualProblem, fit: Fit, which: int) -> bool:
    member = fit.members[which]
    effect = member.effect
    assert isinstance(effect, Modulated)
    ctx = problem.ctx
    g = effect.channel.of(ctx)
    (law,) = effect.effect.columns(ctx, member.trial)
    blocks = problem.blocks(fit.members)
    blocks[which] = blocks[which][:, :-1]
    beside = np.column_stack([*blocks, problem.base])
    basis, _ = np.linalg.qr(beside / np.maximum(np.sqrt(np.mean(beside**2, axis=0)), 1e-300))
    y = problem.y - basis @ (basis.T @ problem.y)

    def rest(channel: Floats) -> Floats:
        column = problem.seen(law * channel)
        return np.asarray(column - basis @ (basis.T @ column))

    def gain(column: Floats) -> float:
        return float(column @ y) ** 2 / max(float(column @ column), 1e-300)

    own = rest(g)
    base, _ = np.linalg.qr(problem.base) if problem.base.size else (np.zeros((y.size, 0)), None)
    whole = problem.y - base @ (base.T @ problem.y)
    if problem.case.model.k_tol is None and gain(own) < POLICY.modulation_share * float(
        whole @ whole
    ):
        return False
    from rthyb_rt.diagnose.problem import penalty

    if gain(own) < penalty(problem.ln_n, 1) or not _the_channel(g, gain(own), gain, rest):
        return False
    follows = _by_motion(ctx, g, problem.estimate.rows)
    left = g - follows
    if float(np.var(left)) < POLICY.modulation_alone:
        return False
    first = rest(follows)
    size = float(first @ first)
    left_column = rest(left)
    if size > 0.0:
        y = y - first * (float(first @ y) / size)
        left_column = left_column - first * (float(first @ left_column) / size)
    of_rest = float(left_column @ y) / max(float(left_column @ left_column), 1e-300)
    of_all = float(fit.betas[which][-1])
    return gain(left_column) > penalty(problem.ln_n, 1) and of_rest * np.sign(
        of_all
    ) > POLICY.modulation_own * abs(of_all)


def _the_channel(g: Floats, own: float, gain: Any, rest: Any) -> bool:
    """Return whether a channel gains more than its shifted copies."""
    for j in range(1, POLICY.modulation_shifts + 1):
        by = round((j * GOLDEN % 1.0) * g.size)
        if any(gain(rest(np.roll(way, by))) >= own for way in (g, g[::-1])):
            return False
    return True


def _by_motion(ctx: Context, g: Floats, rows: Any) -> Floats:
    """Return the part of a channel that follows from the instantaneous motion, (n,)."""
    x, v = ctx.x / ctx.x_range, ctx.v / ctx.v_range
    a = ctx.a / (float(np.max(np.abs(ctx.a))) or 1.0)
    parts = [np.ones_like(x), x, v, a, np.abs(x), np.abs(v), np.abs(a), x**2, v**2, x * v]
    design = np.column_stack(parts)
    beta, *_ = np.linalg.lstsq(design[rows], g[rows], rcond=None)
    return np.asarray(design @ beta)
