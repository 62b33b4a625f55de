"""Damaged members, for which yielding, degradation and pinching are one law."""

from __future__ import annotations

from collections.abc import Sequence

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial
from rthyb_rt.diagnose.effects.damage_law import DamageLaw
from rthyb_rt.diagnose.effects.hysteretic import LARGE
from rthyb_rt.diagnose.effects.peak_oriented import PeakOriented
from rthyb_rt.diagnose.effects.rc_column import RcColumn
from rthyb_rt.diagnose.effects.takeda import Takeda
from rthyb_rt.diagnose.policy import POLICY

LOOP = (Param("xy_m", "m", 1e-9, 10.0), Param("alpha", "", -1.0, 1.0))
SLACK = (Param("depth", "", 0.0, 1.0), Param("width_ratio", "", 0.0, 10.0))
LOSS = (Param("loss", "", 0.0, 1.0), Param("travel_m", "m", 1e-9, 1e6))


class Aimed(Effect):
    """A member that yields and reloads towards the largest displacement so far."""

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
    laws: tuple[DamageLaw, ...] = (Takeda(pinches=False), PeakOriented(pinches=False))

    @property
    def names(self) -> tuple[str, ...]:
        """Both names."""
        return ("degradation", "hysteresis")

    def _law(self, trial: Trial) -> DamageLaw:
        return next(law for law in self.laws if trial.variant in law.variants)

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return the shapes of all laws, or of those that replace a stated spring."""
        laws = [law for law in self.laws if ctx.k_free or law.replaces]
        return [trial for law in laws for trial in law.trials(ctx)]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Return those of the law."""
        return self._law(trial).limits(ctx, trial)

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return the stiffness of each part, and the shape."""
        count = self._law(trial).count
        return ("+" * count, (None,) * count), count + len(trial.theta)

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force of each part per unit of stiffness."""
        return self._law(trial).columns(ctx, trial)

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if it does not degrade: then it is a plain loop."""
        law = self._law(trial)
        return law.sensible(ctx, beta) and law.lost(ctx, trial, beta) > POLICY.seen_wear

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the loop, and the final loss of stiffness."""
        law = self._law(trial)
        return {
            "xy_m": trial.theta[0],
            "alpha": law.alpha(ctx, trial, beta),
            "loss": law.lost(ctx, trial, beta),
            "travel_m": float(ctx.travel[-1]) or 1.0,
        }

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law by the names of its authors."""
        return self._law(trial).form(trial)

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return those of the law."""
        return self._law(trial).elements(ctx, trial, beta)


class WornColumn(Aimed):
    """A reinforced concrete column, a wall or a joint that pinches as well.

    Unloading softens with the largest displacement, strength decreases with displacement and work,
    and cracks slip before they close. Or what has been reached is slack until it is reached again.
    """

    name = "hysteresis+pinching+degradation"
    plain = "yielding with pinching and degradation"
    params = (*LOOP, *SLACK, *LOSS)
    equation = (
        "a loop in series with a slip-lock spring, worn by amplitude and energy; or a loop beside "
        "a spring that is slack up to the largest displacement so far; or a loop that reloads "
        "towards it in two lines"
    )
    fingerprint = "loops that become flatter and slacker around zero from cycle to cycle"
    laws = (RcColumn(pinches=True), Takeda(pinches=True), PeakOriented(pinches=True))

    @property
    def names(self) -> tuple[str, ...]:
        """All three names."""
        return ("degradation", "hysteresis", "pinching")

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if it does not pinch either: then it is a plain loop."""
        slack = self._law(trial).slack(ctx, trial)
        return slack > POLICY.seen_wear and super().sensible(ctx, trial, beta)

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the loop, its slack, and the final losses of stiffness and strength."""
        law = self._law(trial)
        slack = {"depth": law.slack(ctx, trial), "width_ratio": law.width(trial)}
        return super().report(ctx, trial, beta) | slack


EFFECTS: tuple[Effect, ...] = (Aimed(), WornColumn())
