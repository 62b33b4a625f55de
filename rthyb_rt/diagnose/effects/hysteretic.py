"""Effects with a memory of displacement: yielding, pinching, degradation, relaxation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial
from rthyb_rt.diagnose.simulate import iwan

LARGE = ("multi_amplitude", "a memory of amplitude shows when small cycles follow large ones")
SPRINGS = 12


def plastic(ctx: Context, variant: str, xy: float) -> Floats:
    """Return a yielding displacement with slope 1 at first and a limit near ``xy``, m."""
    if variant.startswith("bw"):
        n = float(variant[2:])
        # In units of xy: b and c in metres leave the core's range for small ones.
        loop = core.element(
            "hysteresis", k_n_per_m=1.0, post_yield_ratio=0.0, a=1.0, b=0.5, c=0.5, eta=n
        )
        return core.Element(loop).run(ctx.x / xy) * xy
    spread = float(variant[4:])
    if spread == 0.0:
        return iwan(np.array([xy]), np.array([1.0]), ctx.x)
    at = 1.0 + spread * (2.0 * (np.arange(SPRINGS) + 0.5) / SPRINGS - 1.0)
    return iwan(xy * at, np.full(SPRINGS, 1.0 / SPRINGS), ctx.x)


class Hysteresis(Effect):
    """Yielding: Bouc-Wen loops, and Iwan's springs that yield one by one."""

    name = "hysteresis"
    params = (Param("xy_m", "m", 1e-9, 10.0), Param("alpha", "", -1.0, 1.0))
    equation = "f = k (alpha x + (1 - alpha) z) instead of k x"
    fingerprint = "loops over displacement that do not depend on rate"
    shown_by = LARGE
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return yield displacements as parts of the amplitude, in sharp and round loops."""
        least = 0.004 if ctx.k_free else 0.05
        at = ctx.x_range * np.geomspace(least, 1.0, 12 if not ctx.k_free else 18)
        shapes = ["bw1", "bw2", "bw5", "iwan0"]
        if ctx.k_free:
            # With nothing known of the spring, the yielding part may have a dashpot beside it.
            shapes += ["bw1+", "bw2+", "iwan0+"]
        trials = [Trial((float(xy),), shape) for shape in shapes for xy in at]
        # Springs that yield one by one, over a spread that is fitted.
        trials += [Trial((float(xy), s), "iwan") for s in (1.0, 0.5, 0.2) for xy in at]
        if ctx.k_free:
            trials += [
                Trial((float(xy), 6.0 * float(xy)), "two") for xy in at[::2] if 6 * xy < ctx.x_range
            ]
        return trials

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep yielding within the motion."""
        least = 1e-3 if ctx.k_free else 0.03
        if trial.variant == "iwan":
            return [(least * ctx.x_range, 1.5 * ctx.x_range), (0.02, 1.0)]
        return [(least * ctx.x_range, 1.5 * ctx.x_range)] * len(trial.theta)

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, 1 - alpha; with a dashpot or a second loop beside it, two."""
        if trial.variant == "two":
            return ("++", (None, None)), 4
        if trial.variant.endswith("+"):
            return ("+*", (None, None)), 2
        return ("+", (None,)), 2

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the yielding part less the elastic one that it stands for."""
        xy = trial.theta[0]
        if trial.variant == "two":
            return [ctx.k_scale * plastic(ctx, "bw1", y) for y in trial.theta]
        shape = f"iwan{trial.theta[1]}" if trial.variant == "iwan" else trial.variant
        z = plastic(ctx, shape.rstrip("+"), xy)
        if trial.variant.endswith("+"):
            return [ctx.k_scale * z, ctx.k_scale * np.gradient(z) / ctx.dt * (xy / ctx.v_range)]
        return [ctx.k_scale * (z if ctx.k_free else z - ctx.x)]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False where the spring after yielding would push outwards."""
        if ctx.k_free:
            return (
                len(beta) == 1
                or trial.variant == "two"
                or bool(-0.05 * beta[0] <= beta[1] < 3.0 * beta[0])
            )
        return bool(0.0 < beta[0] < 1.3)

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return yield displacement and the share of stiffness that remains."""
        share = float(beta[0])
        alpha = 1.0 - share if not ctx.k_free else ctx.model.k / (ctx.model.k + share * ctx.k_scale)
        return {"xy_m": trial.theta[0], "alpha": alpha}

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return loops of the core's Bouc-Wen element, an Iwan chain as several sharp ones."""
        k = float(beta[0]) * ctx.k_scale
        xy = trial.theta[0]
        out = [] if ctx.k_free else [core.element("stiffness", k_n_per_m=-k)]
        if trial.variant == "two":
            return [
                *out,
                *(
                    _loop(float(b) * ctx.k_scale, y, 1.0)
                    for b, y in zip(beta, trial.theta, strict=True)
                ),
            ]
        shape = trial.variant.rstrip("+")
        if shape.startswith("bw"):
            return [*out, _loop(k, xy, float(shape[2:]))]
        spread = trial.theta[1] if shape == "iwan" else float(shape[4:])
        count = 1 if spread == 0.0 else 6
        at = 1.0 + spread * (2.0 * (np.arange(count) + 0.5) / count - 1.0)
        return [*out, *(_loop(k / count, float(xy * r), 12.0) for r in at)]


def _loop(k: float, xy: float, eta: float) -> core.ElementConfig:
    eta = min(eta, (15.0 + np.log10(0.5)) / max(-np.log10(xy), 0.1))
    half = 0.5 / xy**eta
    return core.element(
        "hysteresis", k_n_per_m=k, post_yield_ratio=0.0, a=1.0, b=half, c=half, eta=float(eta)
    )


def _loop_part(ctx: Context) -> Floats:
    """Return the part of the model's spring that yields, or all of an elastic one, N."""
    bw = ctx.model.bouc_wen
    if bw is None:
        return ctx.spring if ctx.model.k else ctx.k_scale * ctx.x
    return ctx.spring - bw.alpha * ctx.model.k * ctx.x


class Pinching(Effect):
    """A spring or loop that is slack around zero."""

    name = "pinching"
    params = (Param("depth", "", 0.0, 1.0), Param("width_ratio", "", 0.0, 10.0))
    equation = "the loop's force times 1 - depth exp(-(x / width)^2)"
    fingerprint = "force is missing around zero displacement, in both directions"
    shown_by = LARGE
    signs = "+"

    def _unit(self, ctx: Context) -> float:
        return ctx.model.bouc_wen.xy if ctx.model.bouc_wen else ctx.x_range

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return widths from a thirtieth to all of the amplitude."""
        if not ctx.model.k:
            return []
        at = ctx.x_range * np.geomspace(0.03, 1.0, 10)
        variants = ("x", "z", "slope") if ctx.model.bouc_wen else ("x",)
        if not ctx.model.bouc_wen:
            # Slack that widens with the largest displacement so far.
            peaks = [
                Trial((float(w),), v) for v in ("peak2", "peak4") for w in np.geomspace(0.1, 1.5, 8)
            ]
            peaks += [Trial((float(w),), "worn") for w in np.linspace(0.1, 0.9, 7)]
            return [*(Trial((float(w),), "x") for w in at), *peaks]
        return [Trial((float(w),), v) for v in variants for w in at]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the width within the motion."""
        if trial.variant.startswith("peak"):
            return [(0.05, 2.0)]
        if trial.variant == "worn":
            return [(0.02, 0.98)]
        return [(0.01 * ctx.x_range, 2.0 * ctx.x_range)]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, the depth."""
        return ("+", (None,)), 2

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return what the pinched force loses per depth."""
        width = trial.theta[0]
        loop = _loop_part(ctx)
        bw = ctx.model.bouc_wen
        if trial.variant == "z" and bw:
            z = loop / ((1.0 - bw.alpha) * ctx.model.k)
            return [-loop * np.exp(-((z / width) ** 2))]
        if trial.variant == "slope" and bw:
            depth, per = 0.3, bw.xy**bw.n
            pinched = ctx.unit(
                "pinching", k_n_per_m=ctx.model.k, post_yield_ratio=bw.alpha, a=1.0,
                b=bw.gamma / per, c=bw.beta / per, eta=bw.n, depth=depth,
                width_ratio=width / bw.xy,
            )  # fmt: skip
            return [(pinched - ctx.spring) / depth]
        if trial.variant == "worn":
            # Soft within a part of the largest excursion, and closed again where that is reached.
            peak = np.maximum.accumulate(np.abs(ctx.x)) + 1e-9 * ctx.x_range
            lost = np.minimum(np.abs(ctx.x), (peak - np.abs(ctx.x)) * width / (1.0 - width))
            return [-ctx.model.k * np.sign(ctx.x) * lost]
        if trial.variant.startswith("peak"):
            peak = np.maximum.accumulate(np.abs(ctx.x)) + 1e-9 * ctx.x_range
            return [-loop * np.exp(-((ctx.x / (width * peak)) ** int(trial.variant[4:])))]
        return [-loop * np.exp(-((ctx.x / width) ** 2))]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False where more than all is lost."""
        return bool(0.0 < beta[0] <= 1.2)

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return depth and width, as a part of the yield displacement or of the amplitude."""
        unit = 1.0 if trial.variant.startswith(("peak", "worn")) else self._unit(ctx)
        return {"depth": float(beta[0]), "width_ratio": trial.theta[0] / unit}

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the pinched loop instead of the model's own."""
        bw = ctx.model.bouc_wen
        if bw is None:
            return None
        per = bw.xy**bw.n
        pinched = core.element(
            "pinching", k_n_per_m=ctx.model.k, post_yield_ratio=bw.alpha, a=1.0,
            b=bw.gamma / per, c=bw.beta / per, eta=bw.n, depth=min(float(beta[0]), 1.0),
            width_ratio=trial.theta[0] / bw.xy,
        )  # fmt: skip
        return [pinched]


SOONEST = 0.01
"""Path in which stiffness is lost, as part of all of it: what is lost sooner was never there."""


class Degradation(Effect):
    """Stiffness that is lost with the path covered."""

    name = "degradation"
    params = (Param("loss", "", 0.0, 1.0), Param("travel_m", "m", 1e-9, 1e6))
    equation = "the loop's force times 1 - loss (1 - exp(-travel / travel_m))"
    fingerprint = "residual in phase with displacement that grows during the test"
    shown_by = LARGE
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return travels from a fiftieth of the path to three times it."""
        if not ctx.model.k:
            return []
        path = float(ctx.travel[-1]) or 1.0
        variants = ("loop", "all") if ctx.model.bouc_wen else ("loop",)
        return [Trial((float(s),), v) for v in variants for s in path * np.geomspace(0.02, 3.0, 9)]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, the loss."""
        return ("+", (None,)), 2

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep it different from a spring that is softer from the start."""
        path = float(ctx.travel[-1]) or 1.0
        return [(SOONEST * path, 1e3 * path)]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return what is lost per loss."""
        part = _loop_part(ctx) if trial.variant == "loop" else ctx.spring
        return [part * np.expm1(-ctx.travel / trial.theta[0])]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False where more than all is lost."""
        return bool(0.0 < beta[0] <= 1.2)

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return loss and travel."""
        return {"loss": float(beta[0]), "travel_m": trial.theta[0]}

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return a loop of the model's own spring that loses it."""
        bw = ctx.model.bouc_wen
        alpha, xy, n = (bw.alpha, bw.xy, bw.n) if bw else (0.0, 1e3, 1.0)
        b, c = (bw.gamma, bw.beta) if bw else (0.5, 0.5)
        return [
            core.element(
                "degradation", k_n_per_m=ctx.model.k, post_yield_ratio=alpha, a=1.0,
                b=b / xy**n, c=c / xy**n, eta=n, loss=min(float(beta[0]), 1.0),
                travel_m=trial.theta[0],
            )
        ]  # fmt: skip


class Maxwell(Effect):
    """Relaxation: a spring and a dashpot in series."""

    name = "maxwell"
    params = (Param("km_N_m", "N/m", 0.0, 1e12), Param("tau_s", "s", 1e-4, 1e4))
    equation = "f' + f / tau = km v"
    fingerprint = "a dashpot at low frequency that turns into a spring at high"
    shown_by = ("sweep", "its force turns from velocity to displacement around 1 / (2 pi tau)")
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return relaxation times from a few rows to the length of the test."""
        return [Trial((float(tau),)) for tau in np.geomspace(4e-3, 4.0, 13)]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep it different from a spring and from a dashpot."""
        return [(2.0 * ctx.dt, 20.0)]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient."""
        return ("+", (None,)), 2

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per N/m."""
        return [ctx.unit("maxwell", km_n_per_m=1.0, tau_s=trial.theta[0])]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return stiffness and time."""
        return {"km_N_m": float(beta[0]), "tau_s": trial.theta[0]}

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        return [core.element("maxwell", km_n_per_m=float(beta[0]), tau_s=trial.theta[0])]


EFFECTS: tuple[Effect, ...] = (Hysteresis(), Pinching(), Degradation(), Maxwell())
