"""Fluid dampers on a spring: the fluid's own, or that of a brace."""

from __future__ import annotations

from collections.abc import Sequence

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial
from rthyb_rt.diagnose.effects.friction import EXPONENTS

STRETCH = (1e-3, 3.0)
"""Stretch of the spring under the force at the largest velocity, relative to the amplitude: with
less it is the damper alone, with more the spring alone."""

MOST_ROWS = 20_000
"""Rows of a recording in which it is tried: an evaluation costs six of another damper, and with
more rows the answer would take twice as long."""


class BracedDamper(Effect):
    """A force proportional to a power of velocity, through a spring: the nonlinear Maxwell model.

    Its shape is the exponent, and the stretch of the spring, m, under the force at the largest
    velocity.
    """

    name = "power_damping+maxwell"
    plain = "a damper with a power of velocity on a spring"
    phrase = (
        "damping with velocity to the power of {exponent:3} ({F1_N} at 1 m/s) on a spring of "
        "{km_N_m}"
    )
    params = (
        Param("F1_N", "N", 0.0, 1e10), Param("exponent", "", 0.05, 10.0),
        Param("km_N_m", "N/m", 0.0, 1e12), Param("tau_s", "s", 1e-4, 1e4),
    )  # fmt: skip
    equation = "f' = km (v - (1 m/s) |f / F1|^(1 / exponent) sgn(f))"
    fingerprint = "a power law over velocity whose force lags behind it"
    shown_by = ("multi_amplitude", "a power of velocity requires several amplitudes")
    signs = "+"
    sprung = True
    begins = False  # it was built in before the test

    @property
    def names(self) -> tuple[str, ...]:
        """Both names."""
        return ("maxwell", "power_damping")

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return exponents between those of the laws with their own names, and soft springs.

        None in a recording of more than `MOST_ROWS`.
        """
        if ctx.x.size > MOST_ROWS:
            return []
        return [
            Trial((a, float(stretch)))
            for a in (0.35, 0.65, 1.5)
            for stretch in (0.05 * ctx.x_range, 0.3 * ctx.x_range)
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the exponent in the range without another name, and the spring within the motion."""
        return [
            min(EXPONENTS, key=lambda ends: abs(trial.theta[0] - 0.5 * sum(ends))),
            (STRETCH[0] * ctx.x_range, STRETCH[1] * ctx.x_range),
        ]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Reject the smallest possible exponent: anything less is friction with bristles."""
        return trial.theta[0] > 1.01 * EXPONENTS[0][0]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, the force."""
        return ("+", (None,)), 3

    @staticmethod
    def _element(ctx: Context, trial: Trial, force_n: float) -> core.ElementConfig:
        exponent, stretch = trial.theta
        return core.element(
            "nonlinear_maxwell", km_n_per_m=force_n / stretch, force_n=force_n,
            at_m_per_s=ctx.v_range, exponent=exponent,
        )  # fmt: skip

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per N at the largest velocity."""
        element = core.CoreElement(self._element(ctx, trial, 1.0))
        return [element.run(ctx.x, dt_s=ctx.dt)]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the damper, the spring, and the time of both at the largest velocity."""
        exponent, stretch = trial.theta
        return {
            "F1_N": float(beta[0]) / ctx.v_range**exponent, "exponent": exponent,
            "km_N_m": float(beta[0]) / stretch, "tau_s": stretch / ctx.v_range,
        }  # fmt: skip

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the damper with its exponent."""
        return f"fluid viscous damper, |v|^{trial.theta[0]:.3g} sgn(v), on a spring"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        return [self._element(ctx, trial, float(beta[0]))]


EFFECTS: tuple[Effect, ...] = (BracedDamper(),)
