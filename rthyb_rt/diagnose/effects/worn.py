"""Damaged members, for which yielding, degradation and pinching are one law."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects import takeda
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial
from rthyb_rt.diagnose.effects.hysteretic import LARGE, bouc_wen
from rthyb_rt.diagnose.policy import POLICY

AIMED, UNEVEN = "aimed", "aimed, uneven"
"""The stiffnesses in the two directions are equal, or their ratio is the last shape parameter."""
START = 0.02
"""Displacement that counts as the first one, relative to the range: loss counts from there on."""
LOOP = (Param("xy_m", "m", 1e-9, 10.0), Param("alpha", "", -1.0, 1.0))
SLACK = (Param("depth", "", 0.0, 1.0), Param("width_ratio", "", 0.0, 10.0))
LOSS = (Param("loss", "", 0.0, 1.0), Param("travel_m", "m", 1e-9, 1e6))


class Aimed(Effect):
    """A loop beside a spring that returns to the force at the largest displacement so far.

    Its shape is the yield displacement, the power of first loading, and, if the directions are
    unlike, the ratio of their stiffnesses.
    """

    name = "hysteresis+degradation"
    plain = "yielding with degradation"
    params: tuple[Param, ...] = (*LOOP, *LOSS)
    equation = (
        "a loop beside a spring whose force returns, on each side, to that at the largest "
        "displacement so far; or a loop that reloads straight towards that point"
    )
    fingerprint = "reloading aims at the farthest point so far, from wherever it begins"
    static = True
    shown_by = LARGE
    signs = "+"
    complete = True
    wears = yields = True
    pinches = False

    @property
    def names(self) -> tuple[str, ...]:
        """Both names."""
        return ("degradation", "hysteresis")

    def _shapes(self, ctx: Context) -> list[tuple[float, ...]]:
        at = ctx.x_range * np.array([0.05, 0.15, 0.45])
        return [(float(xy), hardening) for xy in at for hardening in (0.4, 0.8)]

    def _powers(self, trial: Trial) -> tuple[float, float, float]:
        """Return the powers of reloading and of first loading, and the ratio downwards."""
        return 1.0, trial.theta[1], trial.theta[-1] if trial.variant == UNEVEN else 1.0

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return loops that yield early or late; beside springs that harden, unless k is known."""
        loops = takeda.trials(ctx, self.pinches)
        if not ctx.k_free:
            return loops
        shapes = self._shapes(ctx)
        return [
            *loops,
            *(Trial(shape, AIMED) for shape in shapes),
            *(Trial((*shape, 1.0), UNEVEN) for shape in shapes),
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep yielding within the motion; at a power of 1, nothing is lost."""
        if takeda.takes(trial):
            return takeda.limits(ctx, trial, self.pinches)
        ends = [(0.02 * ctx.x_range, 0.9 * ctx.x_range), (0.02, 1.0)]
        return [*ends, (0.2, 5.0)] if trial.variant == UNEVEN else ends

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return the stiffness of the loop, and that of the spring, and the shape."""
        if takeda.takes(trial):
            return ("+", (None,)), 1 + len(trial.theta)
        return ("++", (None, None)), 2 + len(trial.theta)

    def _spring(self, ctx: Context, trial: Trial, k: float) -> core.ElementConfig:
        """Return the spring whose secant stiffness upwards is k at the end of the range."""
        pinched, hardening, uneven = self._powers(trial)
        return core.element(
            "peak_oriented", k_up_n_per_m=k, k_down_n_per_m=k * uneven, reach_m=ctx.x_range,
            exponent=pinched, backbone=hardening, start_m=START * ctx.x_range,
        )  # fmt: skip

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the forces of the loop, and of the spring, per unit of relative stiffness."""
        if takeda.takes(trial):
            return [takeda.column(ctx, trial, self.pinches)]
        xy = trial.theta[0]
        loop = core.CoreElement(bouc_wen(1.0, 1.0, 1.0)).run(ctx.x / xy) * xy
        spring = core.CoreElement(self._spring(ctx, trial, 1.0)).run(ctx.x)
        return [ctx.k_scale * loop, ctx.k_scale * spring]

    def _lost(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the loss of stiffness, spring and loop together, at the largest displacement."""
        if takeda.takes(trial):
            return takeda.lost(ctx, trial, self.pinches)
        _, hardening, uneven = self._powers(trial)
        loop, spring = float(beta[0]), 0.5 * (1.0 + uneven) * float(beta[1])
        first = loop + spring * START ** (hardening - 1.0)
        return 1.0 - (loop + spring) / first if first > 0.0 else 0.0

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if it does not degrade: then it is a plain loop."""
        if takeda.takes(trial) and not takeda.sensible(ctx, beta):
            return False
        return self._lost(ctx, trial, beta) > POLICY.seen_wear

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the loop, and the final loss of stiffness."""
        return {
            "xy_m": trial.theta[0],
            "alpha": takeda.left(ctx, trial, self.pinches, beta)
            if takeda.takes(trial)
            else ctx.model.k / (ctx.model.k + float(beta[0]) * ctx.k_scale),
            "loss": self._lost(ctx, trial, beta),
            "travel_m": float(ctx.travel[-1]) or 1.0,
        }

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the rule by the name of its author."""
        if takeda.takes(trial):
            return takeda.form(trial, self.pinches)
        rule = "Clough, with pinching" if "pinching" in self.names else "Clough"
        uneven = ", unlike in the two directions" if trial.variant == UNEVEN else ""
        return f"loop and a spring aimed at the largest displacement ({rule}){uneven}"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the loop and the spring."""
        if takeda.takes(trial):
            return takeda.elements(ctx, trial, self.pinches, beta)
        loop, spring = (float(b) * ctx.k_scale for b in beta)
        return [bouc_wen(loop, trial.theta[0], 1.0), self._spring(ctx, trial, spring)]


def _is_column(trial: Trial) -> bool:
    return trial.variant in COLUMNS


COLUMNS = SLACK_COLUMN, WORN_COLUMN = "slack", "worn"
"""Reinforced concrete columns without, and with, loss of strength."""
BELL = (0.15, 0.25)
"""Force at which cracks slip most, and the width of the bell, relative to the strength."""
CYCLES = 12.5
"""Number of full cycles whose work is the unit for energy-related loss."""


class WornColumn(Aimed):
    """A reinforced concrete column, a wall or a joint that pinches as well.

    Unloading softens with the largest displacement, strength decreases with displacement and work,
    and cracks slip before they close. Or what has been reached is slack until it is reached again:
    the shape then has the power of reloading behind that of first loading.
    """

    name = "hysteresis+pinching+degradation"
    plain = "yielding with pinching and degradation"
    params = (*LOOP, *SLACK, *LOSS)
    pinches = True
    equation = (
        "a loop in series with a slip-lock spring, worn by amplitude and energy; or a loop beside "
        "a spring that is slack up to the largest displacement so far; or a loop that reloads "
        "towards it in two lines"
    )
    fingerprint = "loops that become flatter and slacker around zero from cycle to cycle"

    @property
    def names(self) -> tuple[str, ...]:
        """All three names."""
        return ("degradation", "hysteresis", "pinching")

    def _shapes(self, ctx: Context) -> list[tuple[float, ...]]:
        return [(*shape, pinched) for shape in super()._shapes(ctx) for pinched in (1.5, 3.0)]

    def _powers(self, trial: Trial) -> tuple[float, float, float]:
        return trial.theta[2], trial.theta[1], trial.theta[-1] if trial.variant == UNEVEN else 1.0

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return columns with early or late yielding and slight or strong degradation.

        If k is known, only the loops of `takeda`. Variant "slack" has only the loss of unloading
        stiffness and slip, "worn" all losses.
        """
        if not ctx.k_free:
            return list(super().trials(ctx))
        shapes = [
            (float(xy), pivot, slip)
            for xy in ctx.x_range * np.array([0.12, 0.25, 0.45])
            for pivot in (1.5, 6.0)
            for slip in (0.08, 0.25)
        ]
        worn = (1.2, 0.1, 0.1, *BELL)
        return [
            *(Trial(shape, SLACK_COLUMN) for shape in shapes),
            *(Trial((*shape, *worn), WORN_COLUMN) for shape in shapes),
            *super().trials(ctx),
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep yielding within the motion and all fractions below one."""
        if takeda.takes(trial):
            return super().limits(ctx, trial)
        if not _is_column(trial):
            loop, hardening, *uneven = super().limits(ctx, trial)
            return [loop, hardening, (1.0, 8.0), *uneven]
        ends = [
            (0.02 * ctx.x_range, 0.9 * ctx.x_range), (0.05, 200.0), (1e-3, 0.5), (1.0, 10.0),
            (1e-3, 0.9), (1e-3, 0.9), (0.02, 0.9), (0.05, 1.0),
        ]  # fmt: skip
        return ends[: len(trial.theta)]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return the stiffness of the column, or of loop and spring, and the shape."""
        if not _is_column(trial):
            return super().settings(ctx, trial)
        return ("+", (None,)), 1 + len(trial.theta)

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
        """Return the force of the column, or of loop and spring, per unit of stiffness."""
        if not _is_column(trial):
            return super().columns(ctx, trial)
        xy = trial.theta[0]
        column = core.CoreElement(self._element(ctx, trial, 1.0, 1.0))
        return [ctx.k_scale * xy * column.run(ctx.x / xy)]

    def _left(self, ctx: Context, trial: Trial) -> tuple[float, float]:
        """Return ductility beyond yielding, and the unloading stiffness left, at the largest x."""
        xy, pivot, *_ = trial.theta
        beyond = ctx.x_range / xy - 1.0
        return beyond, (1.0 + pivot) / (1.0 + beyond + pivot)

    def _lost(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the loss of stiffness, or of strength and stiffness, of the whole law."""
        if not _is_column(trial):
            return super()._lost(ctx, trial, beta)
        beyond, left = self._left(ctx, trial)
        amplitude = self._whole(trial)[4]
        strength = 1.0 - amplitude * beyond / (2.0 * ctx.x_range / trial.theta[0] - 1.0)
        return float(1.0 - strength * left)

    def _slack(self, ctx: Context, trial: Trial) -> float:
        """Return the slack half way to the largest displacement, or at the centre of the bell."""
        if takeda.takes(trial):
            return takeda.slack(ctx, trial)
        if not _is_column(trial):
            return float(1.0 - 2.0 ** (1.0 - self._powers(trial)[0]))
        beyond, left = self._left(ctx, trial)
        slip, width = trial.theta[2], self._whole(trial)[7]
        bell = np.sqrt(2.0 / np.pi) * slip * 2.0 * beyond / width
        return float(1.0 - 1.0 / (1.0 + left * bell))

    def _width(self, trial: Trial) -> float:
        """Return that of the bell, where the spring has half its force, or the corner's force."""
        if takeda.takes(trial):
            return trial.theta[5]
        return self._whole(trial)[7] if _is_column(trial) else 0.5 ** (1.0 / self._powers(trial)[0])

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if it neither pinches nor degrades: then it is a plain loop."""
        if takeda.takes(trial) and not takeda.sensible(ctx, beta):
            return False
        worn = min(self._slack(ctx, trial), self._lost(ctx, trial, beta))
        return worn > POLICY.seen_wear

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the loop, its slack, and the final losses of stiffness and strength."""
        width = self._width(trial)
        whole = super().report(ctx, trial, beta)
        return whole | {"depth": self._slack(ctx, trial), "width_ratio": width}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law by the names of its authors."""
        if not _is_column(trial):
            return super().form(ctx, trial)
        return "reinforced concrete column (Sivaselvan-Reinhorn, Park-Ang)"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the column, or the loop and the spring."""
        if not _is_column(trial):
            return super().elements(ctx, trial, beta)
        return [self._element(ctx, trial, float(beta[0]) * ctx.k_scale, trial.theta[0])]


EFFECTS: tuple[Effect, ...] = (Aimed(), WornColumn())
