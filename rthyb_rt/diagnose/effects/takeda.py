"""Loops that reload towards the farthest point so far: a form of yielding with degradation.

Shape parameters: the yield displacement, m; the sharpness of the corner there; the exponent with
which unloading softens; 1 + the post-yield ratio; for a law that pinches, by how much, at which
force, and the share of the direct line in its corner; in variant `WORN`, the loss with work; in
variant `UNEVEN`, the strength downwards as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Floats, Trial
from rthyb_rt.diagnose.effects.damage_law import CYCLES, DamageLaw

PLAIN, WORN, UNEVEN = "takeda", "takeda, worn", "takeda, uneven"
YIELDS = (0.1, 0.3, 0.6)
"""Initial yield displacements, relative to the range."""
BEND = (4.0, 0.3, 1.1)
"""Initial sharpness, exponent of unloading (Takeda, Sozen & Nielsen 1970 have .4), and 1 + the
post-yield ratio."""
PINCHED = ((0.3, 0.4, 0.7), (0.8, 0.3, 0.5))
"""Initial degree of pinching, its level, and the part of the direct line in its corner."""
ENDLESS_J = 1e15
"""Energy of the loss with work of a loop that has none, J."""
SHARPEST = 800.0
"""Largest sharpness; a derivative of the fit steps beyond it, and the element ends at 1000."""
LOSS = 0.2
"""Initial loss of strength over `CYCLES`."""


@dataclass(frozen=True)
class Shape:
    """The shape parameters by name."""

    xy_m: float
    sharpness: float
    unloading: float
    ratio: float
    pinching: float
    level: float
    on_line: float
    loss: float
    uneven: float


class Takeda(DamageLaw):
    """A loop of straight lines."""

    variants = PLAIN, WORN, UNEVEN
    replaces = True

    def _shape(self, trial: Trial) -> Shape:
        xy, sharpness, unloading, slope, *more = trial.theta
        corner, ends = (more[:3], more[3:]) if self.pinches else ([0.0, 0.5, 1.0], more)
        pinching, level, on_line = corner
        loss, uneven = (*ends, *(0.0, 1.0)[len(ends) :])
        return Shape(xy, sharpness, unloading, slope - 1.0, pinching, level, on_line, loss, uneven)

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return loops that yield early or late, whole or worn; if k is known, alike both ways."""
        ends: dict[str, tuple[float, ...]] = {PLAIN: (), WORN: (LOSS,)}
        if ctx.k_free:
            ends[UNEVEN] = (LOSS, 1.0)
        return [
            Trial((ctx.x_range * xy, *BEND, *pinched, *end), variant)
            for variant, end in ends.items()
            for xy in YIELDS
            for pinched in (PINCHED if self.pinches else ((),))
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep yielding within the motion, and strength above zero up to twice the range."""
        low = [(0.02 * ctx.x_range, 0.9 * ctx.x_range), (1.0, SHARPEST), (0.01, 0.99), (0.7, 1.9)]
        slack = [(0.02, 0.99), (0.05, 0.9), (0.01, 0.99)] if self.pinches else []
        return [*low, *slack, (1e-3, 10.0), (0.2, 5.0)][: len(trial.theta)]

    def _element(self, ctx: Context, trial: Trial, k: float, per: float) -> core.ElementConfig:
        """Return the loop of stiffness k, N/m, for a motion divided by ``per``, m."""
        shape = self._shape(trial)
        xy = shape.xy_m / per
        cycles = 4.0 * CYCLES * k * xy * ctx.x_range / per
        return core.element(
            "takeda", k_n_per_m=k, post_yield_ratio=shape.ratio, xy_m=xy,
            sharpness=shape.sharpness, unloading_exponent=shape.unloading,
            pinching=shape.pinching, pinching_level=shape.level,
            energy_j=min(cycles / max(shape.loss, 1e-9), ENDLESS_J),
            strength_down_over_up=shape.uneven, corner_on_line=shape.on_line,
        )  # fmt: skip

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force of the loop, less the spring that it replaces if k is known."""
        xy = trial.theta[0]
        loop = xy * core.CoreElement(self._element(ctx, trial, 1.0, xy)).run(ctx.x / xy)
        return [ctx.k_scale * (loop if ctx.k_free else loop - ctx.x)]

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig]:
        """Return the loop, and less of the spring that it replaces."""
        k = float(beta[0]) * ctx.k_scale
        less = [] if ctx.k_free else [core.element("stiffness", k_n_per_m=-k)]
        return [*less, self._element(ctx, trial, k, 1.0)]

    def form(self, trial: Trial) -> str:
        """Return the law by the names of its authors."""
        rule = "Takeda-Clough, pinching in two lines" if self.pinches else "Takeda-Clough"
        worn = {WORN: ", strength lost with work", UNEVEN: ", unlike in the two directions"}
        end = worn.get(trial.variant, "")
        return f"loop that reloads towards the largest displacement ({rule}){end}"

    def _secant(self, ctx: Context, trial: Trial) -> float:
        """Return the secant stiffness of first loading at the end of the range, relative to k."""
        loop = core.CoreElement(self._element(ctx, trial, 1.0, 1.0))
        return float(loop.run(np.array([ctx.x_range]))[0]) / ctx.x_range

    def lost(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the loss of stiffness at the largest displacement, at which reloading aims."""
        return 1.0 - self._secant(ctx, trial)

    def slack(self, ctx: Context, trial: Trial) -> float:
        """Return by how much the slope is smaller at first, between equal largest displacements."""
        shape, force = self._shape(trial), self._secant(ctx, trial)
        unloading = max(min(shape.xy_m / ctx.x_range, 1.0) ** shape.unloading, force)
        way = 2.0 - force / unloading
        straight = shape.level * way
        late = max(way - (1.0 - shape.level) * force / unloading, straight)
        corner = shape.on_line * straight
        corner += shape.pinching * (late - corner)
        return float(1.0 - straight / max(corner, straight))

    def width(self, trial: Trial) -> float:
        """Return the force of the corner, relative to the one aimed at."""
        return self._shape(trial).level

    def alpha(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the post-yield stiffness relative to the initial one, with springs beside it."""
        ratio, share = self._shape(trial).ratio, float(beta[0])
        if not ctx.k_free:
            return 1.0 - share * (1.0 - ratio)
        beside, loop = ctx.model.k, share * ctx.k_scale
        return (beside + ratio * loop) / (beside + loop)

    def sensible(self, ctx: Context, beta: Floats) -> bool:
        """Return False if the spring that it replaces would push outwards."""
        return ctx.k_free or bool(0.0 < beta[0] < 1.3)
