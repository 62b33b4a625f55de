"""A loop beside a spring that aims at the largest displacement so far: a damaged member."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Floats, Trial
from rthyb_rt.diagnose.effects.damage_law import DamageLaw
from rthyb_rt.diagnose.effects.hysteretic import bouc_wen

AIMED, UNEVEN = "aimed", "aimed, uneven"
"""The stiffnesses in the two directions are equal, or their ratio is the last shape parameter."""
START = 0.02
"""Displacement that counts as the first one, relative to the range: loss counts from there on."""


class PeakOriented(DamageLaw):
    """A Bouc-Wen loop beside a spring that returns to the force at the largest displacement so far.

    Its shape is the yield displacement, the power of first loading, that of reloading if it
    pinches, and, if the directions are unlike, the ratio of their stiffnesses.
    """

    variants = AIMED, UNEVEN
    count = 2

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return loops that yield early or late beside springs that harden."""
        at = ctx.x_range * np.array([0.05, 0.15, 0.45])
        powers = (1.5, 3.0) if self.pinches else ()
        shapes = [(float(xy), hardening) for xy in at for hardening in (0.4, 0.8)]
        whole = [(*s, p) for s in shapes for p in powers] if powers else shapes
        return [
            *(Trial(shape, AIMED) for shape in whole),
            *(Trial((*shape, 1.0), UNEVEN) for shape in whole),
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep yielding within the motion; at a power of 1, nothing is lost."""
        ends = [(0.02 * ctx.x_range, 0.9 * ctx.x_range), (0.02, 1.0)]
        if self.pinches:
            ends.append((1.0, 8.0))
        return [*ends, (0.2, 5.0)] if trial.variant == UNEVEN else ends

    def _power(self, trial: Trial) -> float:
        """Return that of reloading."""
        return trial.theta[2] if self.pinches else 1.0

    @staticmethod
    def _uneven(trial: Trial) -> float:
        return trial.theta[-1] if trial.variant == UNEVEN else 1.0

    def _spring(self, ctx: Context, trial: Trial, k: float) -> core.ElementConfig:
        """Return the spring whose secant stiffness upwards is k at the end of the range."""
        return core.element(
            "peak_oriented", k_up_n_per_m=k, k_down_n_per_m=k * self._uneven(trial),
            reach_m=ctx.x_range, exponent=self._power(trial), backbone=trial.theta[1],
            start_m=START * ctx.x_range,
        )  # fmt: skip

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the forces of the loop, and of the spring, per unit of relative stiffness."""
        xy = trial.theta[0]
        loop = core.CoreElement(bouc_wen(1.0, 1.0, 1.0)).run(ctx.x / xy) * xy
        spring = core.CoreElement(self._spring(ctx, trial, 1.0)).run(ctx.x)
        return [ctx.k_scale * loop, ctx.k_scale * spring]

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig]:
        """Return the loop and the spring."""
        loop, spring = (float(b) * ctx.k_scale for b in beta)
        return [bouc_wen(loop, trial.theta[0], 1.0), self._spring(ctx, trial, spring)]

    def form(self, trial: Trial) -> str:
        """Return the rule by the name of its author."""
        rule = "Clough, with pinching" if self.pinches else "Clough"
        uneven = ", unlike in the two directions" if trial.variant == UNEVEN else ""
        return f"loop and a spring aimed at the largest displacement ({rule}){uneven}"

    def lost(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the loss of stiffness, spring and loop together, at the largest displacement."""
        loop, spring = float(beta[0]), 0.5 * (1.0 + self._uneven(trial)) * float(beta[1])
        first = loop + spring * START ** (trial.theta[1] - 1.0)
        return 1.0 - (loop + spring) / first if first > 0.0 else 0.0

    def slack(self, ctx: Context, trial: Trial) -> float:
        """Return the slack half way to the largest displacement."""
        return float(1.0 - 2.0 ** (1.0 - self._power(trial)))

    def width(self, trial: Trial) -> float:
        """Return where the spring has half its force."""
        return float(0.5 ** (1.0 / self._power(trial)))
