"""A reinforced concrete column: a damaged member whose cracks slip before they close."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Floats, Trial
from rthyb_rt.diagnose.effects.damage_law import CYCLES, DamageLaw

SLACK, WORN = "slack", "worn"
"""Without, and with, loss of strength."""
BELL = (0.15, 0.25)
"""Force at which cracks slip most, and the width of the bell, relative to the strength."""


class RcColumn(DamageLaw):
    """A loop in series with a slip-lock spring, worn by amplitude and energy.

    Variant "slack" has only the loss of unloading stiffness and slip, "worn" all losses.
    """

    variants = SLACK, WORN

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return columns with early or late yielding and slight or strong degradation."""
        shapes = [
            (float(xy), pivot, slip)
            for xy in ctx.x_range * np.array([0.12, 0.25, 0.45])
            for pivot in (1.5, 6.0)
            for slip in (0.08, 0.25)
        ]
        worn = (1.2, 0.1, 0.1, *BELL)
        return [
            *(Trial(shape, SLACK) for shape in shapes),
            *(Trial((*shape, *worn), WORN) for shape in shapes),
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep yielding within the motion and all fractions below one."""
        ends = [
            (0.02 * ctx.x_range, 0.9 * ctx.x_range), (0.05, 200.0), (1e-3, 0.5), (1.0, 10.0),
            (1e-3, 0.9), (1e-3, 0.9), (0.02, 0.9), (0.05, 1.0),
        ]  # fmt: skip
        return ends[: len(trial.theta)]

    @staticmethod
    def _whole(trial: Trial) -> tuple[float, ...]:
        return (*trial.theta, 1.0, 0.0, 0.0, *BELL) if len(trial.theta) == 3 else trial.theta

    def _element(self, ctx: Context, trial: Trial, k: float, xy: float) -> core.ElementConfig:
        """Return the column with the yield displacement scaled to the motion."""
        per = xy / trial.theta[0]
        _, pivot, slip, eta, amplitude, energy, level, width = self._whole(trial)
        reach = ctx.x_range * per
        return core.element(
            "rc_column", k_n_per_m=k, post_yield_ratio=0.0, xy_m=xy, eta=eta, pivot=pivot,
            ultimate_m=2.0 * reach, strength_lost_at_ultimate=amplitude,
            energy_j=4.0 * CYCLES * k * xy * reach, strength_lost_with_energy=energy,
            stiffness_lost_with_energy=0.0, slip=slip, slip_level=level, slip_width=width,
        )  # fmt: skip

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per unit of stiffness."""
        xy = trial.theta[0]
        column = core.CoreElement(self._element(ctx, trial, 1.0, 1.0))
        return [ctx.k_scale * xy * column.run(ctx.x / xy)]

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig]:
        """Return the column."""
        return [self._element(ctx, trial, float(beta[0]) * ctx.k_scale, trial.theta[0])]

    def form(self, trial: Trial) -> str:
        """Return the law by the names of its authors."""
        return "reinforced concrete column (Sivaselvan-Reinhorn, Park-Ang)"

    def _left(self, ctx: Context, trial: Trial) -> tuple[float, float]:
        """Return ductility beyond yielding, and the unloading stiffness left, at the largest x."""
        xy, pivot, *_ = trial.theta
        beyond = ctx.x_range / xy - 1.0
        return beyond, (1.0 + pivot) / (1.0 + beyond + pivot)

    def lost(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the loss of strength and stiffness together."""
        beyond, left = self._left(ctx, trial)
        amplitude = self._whole(trial)[4]
        strength = 1.0 - amplitude * beyond / (2.0 * ctx.x_range / trial.theta[0] - 1.0)
        return float(1.0 - strength * left)

    def slack(self, ctx: Context, trial: Trial) -> float:
        """Return the slack at the centre of the bell."""
        beyond, left = self._left(ctx, trial)
        slip, width = trial.theta[2], self.width(trial)
        bell = np.sqrt(2.0 / np.pi) * slip * 2.0 * beyond / width
        return float(1.0 - 1.0 / (1.0 + left * bell))

    def width(self, trial: Trial) -> float:
        """Return that of the bell."""
        return self._whole(trial)[7]
