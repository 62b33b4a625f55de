"""Loops that reload towards the farthest point so far: a form of yielding with degradation.

Shape parameters: the yield displacement, m; the sharpness of the corner there; the exponent with
which unloading softens; 1 + the post-yield ratio; for a law that pinches, by how much, and at which
force; in variant `WORN`, the loss with work; in variant `UNEVEN`, the strength downwards as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Floats, Trial

PLAIN, WORN, UNEVEN = "takeda", "takeda, worn", "takeda, uneven"
FORMS = (PLAIN, WORN, UNEVEN)
CYCLES = 12.5
"""Number of full cycles whose work is the unit of loss, as for the columns of `worn`."""
YIELDS = (0.1, 0.3, 0.6)
"""Initial yield displacements, relative to the range."""
BEND = (4.0, 0.3, 1.1)
"""Initial sharpness, exponent of unloading (Takeda, Sozen & Nielsen 1970 have .4), and 1 + the
post-yield ratio."""
PINCHED = ((0.3, 0.4), (0.8, 0.3))
"""Initial degree of pinching, and its level."""
ENDLESS_J = 1e15
"""Energy of the loss with work of a loop that has none, J."""
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
    loss: float
    uneven: float


def takes(trial: Trial) -> bool:
    """Return whether a shape is one of these."""
    return trial.variant in FORMS


def _shape(trial: Trial, pinches: bool) -> Shape:
    xy, sharpness, unloading, slope, *more = trial.theta
    pinching, level = (more.pop(0), more.pop(0)) if pinches else (0.0, 0.5)
    loss, uneven = (*more, *(0.0, 1.0)[len(more) :])
    return Shape(xy, sharpness, unloading, slope - 1.0, pinching, level, loss, uneven)


def trials(ctx: Context, pinches: bool) -> list[Trial]:
    """Return loops that yield early or late, whole or worn; if k is known, equal on both sides."""
    ends: dict[str, tuple[float, ...]] = {PLAIN: (), WORN: (LOSS,)}
    if ctx.k_free:
        ends[UNEVEN] = (LOSS, 1.0)
    return [
        Trial((ctx.x_range * xy, *BEND, *pinched, *end), variant)
        for variant, end in ends.items()
        for xy in YIELDS
        for pinched in (PINCHED if pinches else ((),))
    ]


def limits(ctx: Context, trial: Trial, pinches: bool) -> list[tuple[float, float]]:
    """Keep yielding within the motion, and strength falling to zero at twice the range or later."""
    low = [(0.02 * ctx.x_range, 0.9 * ctx.x_range), (1.0, 40.0), (0.01, 0.99), (0.7, 1.9)]
    slack = [(0.02, 0.99), (0.05, 0.9)] if pinches else []
    return [*low, *slack, (1e-3, 10.0), (0.2, 5.0)][: len(trial.theta)]


def element(ctx: Context, trial: Trial, pinches: bool, k: float, per: float) -> core.ElementConfig:
    """Return the loop of stiffness k, N/m, for a motion divided by ``per``, m."""
    shape = _shape(trial, pinches)
    xy = shape.xy_m / per
    cycles = 4.0 * CYCLES * k * xy * ctx.x_range / per
    return core.element(
        "takeda", k_n_per_m=k, post_yield_ratio=shape.ratio, xy_m=xy, sharpness=shape.sharpness,
        unloading_exponent=shape.unloading, pinching=shape.pinching, pinching_level=shape.level,
        energy_j=min(cycles / max(shape.loss, 1e-9), ENDLESS_J), strength_down_over_up=shape.uneven,
    )  # fmt: skip


def column(ctx: Context, trial: Trial, pinches: bool) -> Floats:
    """Return the force of the loop, less the spring that it replaces if k is known, (n,), N."""
    xy = trial.theta[0]
    loop = xy * core.CoreElement(element(ctx, trial, pinches, 1.0, xy)).run(ctx.x / xy)
    return ctx.k_scale * (loop if ctx.k_free else loop - ctx.x)


def elements(ctx: Context, trial: Trial, pinches: bool, beta: Floats) -> list[core.ElementConfig]:
    """Return the loop, and less of the spring that it replaces."""
    k = float(beta[0]) * ctx.k_scale
    less = [] if ctx.k_free else [core.element("stiffness", k_n_per_m=-k)]
    return [*less, element(ctx, trial, pinches, k, 1.0)]


def _secant(ctx: Context, trial: Trial, pinches: bool) -> float:
    """Return the secant stiffness of first loading at the end of the range, relative to k."""
    loop = core.CoreElement(element(ctx, trial, pinches, 1.0, 1.0))
    return float(loop.run(np.array([ctx.x_range]))[0]) / ctx.x_range


def lost(ctx: Context, trial: Trial, pinches: bool) -> float:
    """Return the loss of stiffness at the largest displacement, at which reloading aims."""
    return 1.0 - _secant(ctx, trial, pinches)


def slack(ctx: Context, trial: Trial) -> float:
    """Return by how much the slope is smaller at first, between equal largest displacements."""
    shape = _shape(trial, pinches=True)
    force = _secant(ctx, trial, pinches=True)
    unloading = max(min(shape.xy_m / ctx.x_range, 1.0) ** shape.unloading, force)
    way = 2.0 - force / unloading
    straight = shape.level * way
    late = max(way - (1.0 - shape.level) * force / unloading, straight)
    return float(1.0 - straight / (straight + shape.pinching * (late - straight)))


def left(ctx: Context, trial: Trial, pinches: bool, beta: Floats) -> float:
    """Return the post-yield stiffness relative to the initial one: alpha."""
    ratio, share = _shape(trial, pinches).ratio, float(beta[0])
    if not ctx.k_free:
        return 1.0 - share * (1.0 - ratio)
    beside, loop = ctx.model.k, share * ctx.k_scale
    return (beside + ratio * loop) / (beside + loop)


def sensible(ctx: Context, beta: Floats) -> bool:
    """Return False if the spring that it replaces would push outwards."""
    return ctx.k_free or bool(0.0 < beta[0] < 1.3)


def form(trial: Trial, pinches: bool) -> str:
    """Return the law by the names of its authors."""
    rule = "Takeda-Clough, pinching in two lines" if pinches else "Takeda-Clough"
    worn = {WORN: ", strength lost with work", UNEVEN: ", unlike in the two directions"}
    end = worn.get(trial.variant, "")
    return f"loop that reloads towards the largest displacement ({rule}){end}"
