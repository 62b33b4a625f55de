"""Effects with a memory of displacement: yielding, pinching, degradation, relaxation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.case import ModelBoucWen
from rthyb_rt.diagnose.effects import chains
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial
from rthyb_rt.diagnose.effects.friction import Lugre, Viscous
from rthyb_rt.diagnose.effects.springs import Stiffness

LARGE = ("multi_amplitude", "a memory of amplitude appears when small cycles follow large ones")
BAR = {"r0": 20.0, "cr1": 0.925, "cr2": 0.15}
"""Curvature of the branches of steel: Menegotto & Pinto 1973, constants by Filippou et al. 1983."""


def plastic(ctx: Context, variant: str, xy: float) -> Floats:
    """Return a yielding displacement with initial slope 1 and a limit near ``xy``, m."""
    if variant.startswith("bw"):
        n = float(variant[2:])
        # In units of xy: for a small xy, b and c in metres exceed the core's range.
        loop = core.element(
            "hysteresis", k_n_per_m=1.0, post_yield_ratio=0.0, a=1.0, b=0.5, c=0.5, eta=n
        )
        return core.CoreElement(loop).run(ctx.x / xy) * xy
    if variant.startswith("mp"):
        return core.CoreElement(_bar(1.0, 1.0, variant)).run(ctx.x / xy) * xy
    return chains.plastic(_yields(variant, xy), ctx.x)


def _bar(k: float, xy: float, variant: str) -> core.ElementConfig:
    """Return a bar of steel; after "mp" may stand R0 and cR1 of its branches."""
    curved = BAR
    if variant != "mp":
        r0, cr1 = variant.removeprefix("mp").split()
        curved = {"r0": float(r0), "cr1": float(cr1), "cr2": BAR["cr2"]}
    return core.element("menegotto_pinto", k_n_per_m=k, post_yield_ratio=0.0, xy_m=xy, **curved)


def _yields(variant: str, xy: float) -> Floats:
    """Return where the springs of a chain yield, m."""
    if variant.startswith("bell"):
        return chains.triangle(xy, float(variant.removeprefix("bell")))
    return chains.even(xy, float(variant.removeprefix("iwan")))


def hardened(ctx: Context, xy: float, shape: Sequence[float]) -> Floats:
    """Return a yielding displacement with initial slope 1 whose yield range moves and grows, m.

    ``shape`` is relative to the elastic stiffness and the yield displacement: kinematic modulus,
    recovery, growth and its rate.
    """
    kinematic, recovery, growth, rate = (*shape, 0.0, 0.0)[:4]
    bar = core.element(
        "chaboche", k_n_per_m=1.0, fy_n=1.0, kinematic_n_per_m=kinematic,
        recovery_per_m=recovery, isotropic_n=growth, isotropic_rate_per_m=rate,
    )  # fmt: skip
    return core.CoreElement(bar).run(ctx.x / xy) * xy


def contact(ctx: Context, xy: float) -> Floats:
    """Return the force per N of the sliding contact of an isolator, (n,)."""
    slider = core.element(
        "friction_pendulum", weight_n=1.0, radius_m=1e15, mu_slow=1.0, mu_fast=1.0,
        mu_rate_s_per_m=0.0, xy_m=1.0,
    )  # fmt: skip
    return core.CoreElement(slider).run(ctx.x / xy)


BACKSTRESS = ((0.02, 0.01), (0.07, 0.1), (0.3, 0.3))
"""Initial kinematic moduli and recoveries, relative to the yield point."""
GROWTH = (0.2, 0.02)
"""Initial growth of the yield force, and its rate."""
SPREADS = ("iwan", "bell")
"""Iwan's chains: yields evenly distributed, or as a triangle, most of them in the middle."""
ROUND = "mp r"
"""Menegotto-Pinto with a curvature of its own, which is fitted: R0 and cR1."""
CURVED = ((3.0, 0.05), (15.0, 0.9))
"""Branches that are all curved alike, nearly, and those of reinforcing steel."""
SLIDERS, TWO_CHAINS = "sliders", "chains"
APART = (2.0, 3.5)
"""How many times as far the second of two sliders, or chains, slides, initially."""
CHAINED = {SLIDERS: "iwan0", TWO_CHAINS: "iwan0.5"}
"""Forms of two chains of springs in parallel, and the form of each: the second one is Masing's
backbone with a long tail, such as that of Ramberg & Osgood (NACA TN 902, 1943)."""
TWO = {"two": "bw1", **CHAINED}
"""Forms of two loops in parallel, and the form of each of them."""
HARDENING = ("kinematic", "both")
"""Forms of yielding that harden by plastic flow."""
FORMS = {
    "mp": "Menegotto-Pinto",
    "kinematic": "kinematic hardening (Armstrong-Frederick)",
    "both": "kinematic and isotropic hardening (Chaboche)",
    "slider": "friction pendulum, friction that grows with velocity",
}
FLAT = 1e4
"""Radius of a practically flat bowl, m: the remaining spring of the weight is subtracted."""


class Hysteresis(Effect):
    """Yielding: Bouc-Wen loops, Iwan's springs that yield in turn, Menegotto-Pinto steel."""

    name = "hysteresis"
    plain = "yielding"
    phrase = "yielding from {xy_m} on ({alpha:%} of the stiffness remains)"
    params = (Param("xy_m", "m", 1e-9, 10.0), Param("alpha", "", -1.0, 1.0))
    equation = "f = k (alpha x + (1 - alpha) z) instead of k x"
    fingerprint = "loops over displacement that do not depend on rate"
    static = True
    slides = True
    many_springs = True
    of_spring = "alpha"
    also = Lugre.name
    yields = True
    shown_by = LARGE
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return yield displacements as fractions of the amplitude, for sharp and round loops."""
        least = 0.004 if ctx.k_free else 0.05
        at = ctx.x_range * np.geomspace(least, 1.0, 12 if not ctx.k_free else 18)
        shapes = ["bw1", "bw2", "bw5", "iwan0"]
        if ctx.k_free:
            # If nothing is known of the spring, the yielding part may have a parallel dashpot.
            shapes += ["bw1+", "bw2+", "iwan0+"]
        trials = [Trial((float(xy),), shape) for shape in shapes for xy in at]
        # Springs that yield in turn, with a fitted spread.
        trials += [Trial((float(xy), s), "iwan") for s in (1.0, 0.5, 0.2) for xy in at]
        trials += [Trial((float(xy), 0.7), "bell") for xy in at]
        trials += [Trial((float(xy),), "mp") for xy in at[::2]]
        trials += [Trial((float(xy), *c), ROUND) for c in CURVED for xy in at[::2]]
        trials += [Trial((float(xy), *b), "kinematic") for b in BACKSTRESS for xy in at[1::3]]
        trials += [
            Trial((float(xy), float(rate)), "slider")
            for xy in ctx.x_range * np.array([2e-3, 1e-2, 5e-2])
            for rate in np.array([4.0, 8.0, 20.0]) / ctx.v_range
        ]
        trials += [
            Trial((float(xy), float(xy * apart)), SLIDERS)
            for xy in at
            for apart in APART
            if xy * apart < ctx.x_range
        ]
        if not ctx.k_free:
            # Without tolerances, two loops predict better than one backstress fitted this closely.
            trials += [
                Trial((float(xy), *b, *GROWTH), "both") for b in BACKSTRESS for xy in at[1::2]
            ]
            trials += [
                Trial((float(xy), float(xy * apart)), TWO_CHAINS)
                for xy in at[::2]
                for apart in APART
                if xy < ctx.x_range
            ]
        else:
            trials += [
                Trial((float(xy), 6.0 * float(xy)), "two") for xy in at[::2] if 6 * xy < ctx.x_range
            ]
        return trials

    def kin(self, trial: Trial) -> Sequence[Trial]:
        """Return the other loops of one yield displacement with the same one."""
        if trial.variant in (*TWO, "slider"):
            return ()
        spreads = [Trial((trial.theta[0], s), v) for v in SPREADS for s in (0.5, 1.0)]
        loops = [Trial(trial.theta[:1], v) for v in ("bw1", "bw2", "bw5", "iwan0", "mp")]
        spreads.append(Trial((trial.theta[0], *CURVED[0]), ROUND))
        return [t for t in (*loops, *spreads) if t.variant != trial.variant.rstrip("+")]

    def elastic_until_m(self, trial: Trial) -> float:
        """Return the yield displacement, m."""
        return trial.theta[0]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep yielding within the motion."""
        least = 1e-3 if ctx.k_free else 0.03
        if trial.variant in SPREADS:
            return [(least * ctx.x_range, 1.5 * ctx.x_range), (0.02, 1.0)]
        if trial.variant == ROUND:
            return [(least * ctx.x_range, 1.5 * ctx.x_range), (1.0, 25.0), (0.01, 0.98)]
        if trial.variant == "slider":
            # If slower, friction that grows with velocity equals a dashpot beside plain friction.
            return [
                (1e-4 * ctx.x_range, 0.3 * ctx.x_range),
                (3.0 / ctx.v_range, 60.0 / ctx.v_range),
            ]
        if trial.variant in HARDENING:
            ends = [(1e-3, 3.0), (1e-4, 3.0), (0.01, 3.0), (1e-4, 1.0)]
            return [(least * ctx.x_range, 1.5 * ctx.x_range), *ends[: len(trial.theta) - 1]]
        return [(least * ctx.x_range, 1.5 * ctx.x_range)] * len(trial.theta)

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, 1 - alpha; two with a parallel dashpot or a second loop."""
        if trial.variant in (*TWO, "slider"):
            return ("++", (None, None)), 4
        if trial.variant in (*HARDENING, ROUND):
            return ("+", (None,)), 1 + len(trial.theta)
        if trial.variant.endswith("+"):
            return ("+*", (None, None)), 2
        return ("+", (None,)), 2

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the yielding part less the elastic part that it replaces."""
        xy = trial.theta[0]
        if trial.variant in TWO:
            less = 0.0 if ctx.k_free else ctx.x
            return [ctx.k_scale * (plastic(ctx, TWO[trial.variant], y) - less) for y in trial.theta]
        if trial.variant == "slider":
            z = contact(ctx, xy)
            return [z, -z * np.exp(-trial.theta[1] * np.abs(ctx.v))]
        shape = _shape(trial)
        if shape in HARDENING:
            z = hardened(ctx, xy, trial.theta[1:])
        else:
            z = plastic(ctx, shape.rstrip("+"), xy)
        if trial.variant.endswith("+"):
            return [ctx.k_scale * z, ctx.k_scale * np.gradient(z) / ctx.dt * (xy / ctx.v_range)]
        return [ctx.k_scale * (z if ctx.k_free else z - ctx.x)]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if the spring would push outwards after yielding."""
        if trial.variant == "slider":
            return bool(0.1 * beta[0] < beta[1] <= beta[0])
        if ctx.k_free:
            return (
                len(beta) == 1
                or trial.variant in TWO
                or bool(-0.05 * beta[0] <= beta[1] < 3.0 * beta[0])
            )
        return bool(0.0 < np.sum(beta) < 1.3)

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return yield displacement and the remaining fraction of the stiffness."""
        share = float(np.sum(beta)) if trial.variant in CHAINED else float(beta[0])
        if trial.variant == "slider":
            elastic = share / trial.theta[0]
            return {"xy_m": trial.theta[0], "alpha": ctx.model.k / (ctx.model.k + elastic)}
        alpha = 1.0 - share if not ctx.k_free else ctx.model.k / (ctx.model.k + share * ctx.k_scale)
        return {"xy_m": trial.theta[0], "alpha": alpha}

    def like(self, trial: Trial) -> Trial:
        """Return the loop whose approach to slip has the form of the given bristles."""
        if not trial.variant.startswith("spread"):
            return Trial(trial.theta[:1], "bw1")
        spread = float(trial.variant.removeprefix("spread"))
        return Trial((trial.theta[0], spread), "iwan") if spread else Trial(trial.theta, "iwan0")

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the loop by the names of its authors."""
        shape = trial.variant.rstrip("+")
        beside = ", with a dashpot on it" if trial.variant.endswith("+") else ""
        if shape == "two":
            return "two Bouc-Wen loops, eta 1"
        if shape == SLIDERS:
            return "two sliders in parallel (Masing, three lines)"
        if shape == TWO_CHAINS:
            return "two Iwan chains in parallel, spread 0.5"
        if shape in FORMS:
            return FORMS[shape]
        if shape.startswith("bw"):
            return f"Bouc-Wen, eta {shape[2:]}{beside}"
        if shape == ROUND:
            return f"Menegotto-Pinto, R0 {trial.theta[1]:.2g}, cR1 {trial.theta[2]:.2g}"
        if shape == "bell":
            return f"Iwan, yields in a triangle of +-{trial.theta[1]:.2g}"
        spread = trial.theta[1] if shape == "iwan" else float(shape[4:])
        what = f"Iwan, spread {spread:.2g}" if spread else "elastic, perfectly plastic"
        return what + beside

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element of the loop."""
        k = float(beta[0]) * ctx.k_scale
        xy = trial.theta[0]
        if trial.variant == "slider":
            weight, drop = (float(b) for b in beta)
            return [
                core.element(
                    "friction_pendulum", weight_n=weight, radius_m=FLAT, mu_fast=1.0,
                    mu_slow=1.0 - drop / weight, mu_rate_s_per_m=trial.theta[1], xy_m=xy,
                ),
                core.element("stiffness", k_n_per_m=-weight / FLAT),
            ]  # fmt: skip
        if trial.variant in CHAINED:
            k = float(np.sum(beta)) * ctx.k_scale
        out = [] if ctx.k_free else [core.element("stiffness", k_n_per_m=-k)]
        if trial.variant in CHAINED:
            for b, y in zip(beta, trial.theta, strict=True):
                out += chains.elements(_yields(CHAINED[trial.variant], y), float(b) * ctx.k_scale)
            return out
        if trial.variant == "two":
            return [
                *out,
                *(
                    bouc_wen(float(b) * ctx.k_scale, y, 1.0)
                    for b, y in zip(beta, trial.theta, strict=True)
                ),
            ]
        if trial.variant in HARDENING:
            kinematic, recovery, growth, rate = (*trial.theta[1:], 0.0, 0.0)[:4]
            return [
                *out,
                core.element(
                    "chaboche", k_n_per_m=k, fy_n=k * xy, kinematic_n_per_m=kinematic * k,
                    recovery_per_m=recovery / xy, isotropic_n=growth * k * xy,
                    isotropic_rate_per_m=rate / xy,
                ),
            ]  # fmt: skip
        shape = _shape(trial).rstrip("+")
        if shape.startswith("bw"):
            return [*out, bouc_wen(k, xy, float(shape[2:]))]
        if shape.startswith("mp"):
            return [*out, _bar(k, xy, shape)]
        return [*out, *chains.elements(_yields(shape, xy), k)]


def _shape(trial: Trial) -> str:
    """Return the variant of a loop with the number that makes its form."""
    if trial.variant == ROUND:
        return f"mp{trial.theta[1]} {trial.theta[2]}"
    return f"{trial.variant}{trial.theta[1]}" if trial.variant in SPREADS else trial.variant


def bouc_wen(k: float, xy: float, eta: float) -> core.ElementConfig:
    """Return a loop without hardening, of initial stiffness k, N/m, that yields at xy, m."""
    eta = min(eta, (15.0 + np.log10(0.5)) / max(-np.log10(xy), 0.1))
    half = 0.5 / xy**eta
    return core.element(
        "hysteresis", k_n_per_m=k, post_yield_ratio=0.0, a=1.0, b=half, c=half, eta=float(eta)
    )


def _loop_part(ctx: Context, x: Floats | None = None) -> Floats:
    """Return the yielding part of the model's spring, or all of an elastic one, N.

    Along the context's motion, or along another one from rest, (n,), m.
    """
    spring, x = (ctx.spring, ctx.x) if x is None else (ctx.model.spring(x), x)
    bw = ctx.model.bouc_wen
    if bw is None:
        return spring if ctx.model.k else ctx.k_scale * x
    return spring - bw.alpha * ctx.model.k * x


SLACK = (0.3, 0.6, 0.85)
"""Trial fractions of a loop's slope that are lost around zero."""


class Pinching(Effect):
    """A spring or loop that is slack around zero."""

    name = "pinching"
    plain = "pinching"
    phrase = "pinching by {depth:%} around zero displacement"
    params = (Param("depth", "", 0.0, 1.0), Param("width_ratio", "", 0.0, 10.0))
    equation = "the loop's force times 1 - depth exp(-(x / width)^2)"
    fingerprint = "force is missing around zero displacement in both directions"
    static = True
    many_springs = True
    replaces_spring = True
    of_spring = "depth"
    shown_by = LARGE
    signs = "+"

    def _unit(self, ctx: Context) -> float:
        return ctx.model.bouc_wen.xy if ctx.model.bouc_wen else ctx.x_range

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return widths from a thirtieth of the amplitude to all of it."""
        if not ctx.model.k:
            return []
        at = ctx.x_range * np.geomspace(0.03, 1.0, 10)
        if not ctx.model.bouc_wen:
            # Slackness that widens with the largest displacement so far.
            peaks = [
                Trial((float(w),), v) for v in ("peak2", "peak4") for w in np.geomspace(0.1, 1.5, 8)
            ]
            peaks += [Trial((float(w),), "worn") for w in np.linspace(0.1, 0.9, 7)]
            return [*(Trial((float(w),), "x") for w in at), *peaks]
        # If the slope is slack, the depth does not scale the loop.
        slopes = [Trial((float(w), depth), "slope") for depth in SLACK for w in at]
        return [*(Trial((float(w),), v) for v in ("x", "z") for w in at), *slopes]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the width within the motion, and some of the slope."""
        if trial.variant == "slope":
            return [(0.01 * ctx.x_range, 2.0 * ctx.x_range), (1e-3, 0.98)]
        if trial.variant.startswith("peak"):
            return [(0.05, 2.0)]
        if trial.variant == "worn":
            return [(0.02, 0.98)]
        return [(0.01 * ctx.x_range, 2.0 * ctx.x_range)]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient: the depth, or one that is fixed at 1."""
        return ("+", (0.02 if trial.variant == "slope" else None,)), 2

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the loss of the pinched force per unit depth."""
        width = trial.theta[0]
        loop = _loop_part(ctx)
        bw = ctx.model.bouc_wen
        if trial.variant == "z" and bw:
            z = loop / ((1.0 - bw.alpha) * ctx.model.k)
            return [-loop * np.exp(-((z / width) ** 2))]
        if trial.variant == "slope" and bw:
            depth, per = trial.theta[1], bw.xy**bw.n
            pinched = ctx.unit(
                "pinching", k_n_per_m=ctx.model.k, post_yield_ratio=bw.alpha, a=1.0,
                b=bw.gamma / per, c=bw.beta / per, eta=bw.n, depth=depth,
                width_ratio=width / bw.xy,
            )  # fmt: skip
            return [pinched - ctx.spring]
        if trial.variant == "worn":
            # Soft within a fraction of the largest excursion, and closed again where that is
            # reached.
            peak = np.maximum.accumulate(np.abs(ctx.x)) + 1e-9 * ctx.x_range
            lost = np.minimum(np.abs(ctx.x), (peak - np.abs(ctx.x)) * width / (1.0 - width))
            return [-ctx.model.k * np.sign(ctx.x) * lost]
        if trial.variant.startswith("peak"):
            peak = np.maximum.accumulate(np.abs(ctx.x)) + 1e-9 * ctx.x_range
            return [-loop * np.exp(-((ctx.x / (width * peak)) ** int(trial.variant[4:])))]
        return [-loop * np.exp(-((ctx.x / width) ** 2))]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if more than everything is lost."""
        return bool(0.0 < beta[0] <= 1.2)

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return depth and width, relative to the yield displacement or the amplitude."""
        unit = 1.0 if trial.variant.startswith(("peak", "worn")) else self._unit(ctx)
        depth = float(beta[0]) * (trial.theta[1] if trial.variant == "slope" else 1.0)
        return {"depth": depth, "width_ratio": trial.theta[0] / unit}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the quantity over which the force is slack."""
        return {
            "z": "slack over the loop's own force",
            "slope": "slope of the loop slack (Baber-Noori)",
            "worn": "slack within the largest displacement so far, closed where that is reached",
            "x": "slack over displacement",
        }.get(trial.variant, "slack over displacement, as a part of the largest so far")

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the pinched loop that replaces the model's own."""
        bw = ctx.model.bouc_wen
        if bw is None:
            return None
        per, depth = bw.xy**bw.n, self.report(ctx, trial, beta)["depth"]
        pinched = core.element(
            "pinching", k_n_per_m=ctx.model.k, post_yield_ratio=bw.alpha, a=1.0,
            b=bw.gamma / per, c=bw.beta / per, eta=bw.n, depth=min(depth, 1.0),
            width_ratio=trial.theta[0] / bw.xy,
        )  # fmt: skip
        return [pinched]


SOONEST = 0.01
"""Least travel, or work, in which stiffness is lost, relative to the total; with less, it was never
there."""
POINTS = 65
"""Points at which the force is taken for the work up to a displaced beginning."""
STRAIGHT_M = 1e3
"""Yield displacement of a loop that a rig file needs for a spring that does not yield, m."""
WORN = ("loop", "loop, work", "loop, amplitude")
"""Forms of degradation: with travel; with work (Park & Ang, J. Struct. Eng. 111, 1985); with the
largest displacement so far, as damage by Sivaselvan & Reinhorn, J. Eng. Mech. 126, 2000."""


class Degradation(Effect):
    """Stiffness that is lost with what the specimen has gone through.

    Variants: with the travel, of the loop or of the whole spring; of the loop, with the absolute
    work of its force, or with the largest displacement so far.
    """

    name = "degradation"
    plain = "degradation"
    phrase = "a stiffness that loses {loss:%} over {travel_m} of travel"
    params = (Param("loss", "", 0.0, 1.0), Param("travel_m", "m", 1e-9, 1e6))
    equation = (
        "the loop's force times 1 - loss (1 - exp(-travel / travel_m)); or with its work, or the "
        "largest displacement, instead of travel"
    )
    fingerprint = "residual in phase with displacement that grows during the test"
    static = True
    many_springs = True
    wears = True
    replaces_spring = True
    of_spring = "loss"
    shown_by = LARGE
    begins = False
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return travels and works from a fiftieth of the total to three times, and amplitudes."""
        if not ctx.model.k:
            return []
        whole = ["all"] if ctx.model.bouc_wen else []
        return [
            Trial((float(size),), v)
            for v in (*WORN[:1], *whole, *WORN[1:])
            for size in self._total(ctx, v) * np.geomspace(0.02, 3.0, 9)
            if v != WORN[2] or size > 0.1 * ctx.x_range
        ]

    @staticmethod
    def _gone_through(ctx: Context, variant: str) -> Floats:
        """Return the travel, m, the work, J, or the largest displacement so far, m, (n,)."""
        if variant == WORN[1]:
            part = np.abs(_loop_part(ctx))
            step = np.abs(np.diff(ctx.x, prepend=ctx.x[0]))
            # As for the travel: the work of loading straight to the first displacement.
            way = np.linspace(0.0, float(ctx.x[0]), POINTS)
            first = abs(float(np.trapezoid(_loop_part(ctx, way), way)))
            return first + np.cumsum(0.5 * (part + np.r_[part[0], part[:-1]]) * step)
        return np.maximum.accumulate(np.abs(ctx.x)) if variant == WORN[2] else ctx.travel

    @staticmethod
    def _total(ctx: Context, variant: str) -> float:
        """Return how much of it there is in a recording with the ranges of this one."""
        if variant == WORN[2]:
            return ctx.x_range
        return float(Degradation._gone_through(ctx, variant)[-1]) or 1.0

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, the loss."""
        return ("+", (None,)), 2

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep it different from a spring that is softer from the start."""
        total = self._total(ctx, trial.variant)
        return [((0.1 if trial.variant == WORN[2] else SOONEST) * total, 1e3 * total)]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the lost force per unit loss."""
        part = ctx.spring if trial.variant == "all" else _loop_part(ctx)
        return [part * np.expm1(-self._gone_through(ctx, trial.variant) / trial.theta[0])]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if more than everything is lost."""
        return bool(0.0 < beta[0] <= 1.2)

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the loss, and the travel; for another form, that in which it is lost here."""
        loss = {"loss": float(beta[0])}
        if trial.variant not in WORN[1:]:
            return loss | {"travel_m": trial.theta[0]}
        worn = self._gone_through(ctx, trial.variant)
        at = min(int(np.searchsorted(worn, trial.theta[0])), worn.size - 1)
        beyond = max(trial.theta[0] / max(float(worn[at]), 1e-300), 1.0)
        return loss | {"travel_m": float(ctx.travel[at]) * beyond or ctx.x_range}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return which force is reduced, and by what."""
        at = trial.theta[0]
        forms = {
            WORN[1]: f"of the loop, with its work, loss (1 - exp(-work / {at:.3g} J))",
            WORN[2]: f"of the loop, with the largest displacement, loss (1 - exp(-x / {at:.3g} m))",
            "all": "of all, with travel",
        }
        return forms.get(trial.variant, "of the loop, with travel")

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return a loop of the model's own spring that degrades.

        If all of the force degrades, the spring beside the loop does so as an element of its own.
        """
        bw, k = ctx.model.bouc_wen, ctx.model.k
        alpha = bw.alpha if bw else 0.0
        at = {"travel_m": 0.0, "work_j": 0.0, "amplitude_m": 0.0}
        # The element's work is that of k z, of which the loop is the part 1 - alpha.
        if trial.variant == WORN[1] and alpha >= 1.0:
            return None
        per = 1.0 / (1.0 - alpha) if trial.variant == WORN[1] else 1.0
        at[{WORN[1]: "work_j", WORN[2]: "amplitude_m"}.get(trial.variant, "travel_m")] = (
            trial.theta[0] * per
        )

        def worn(k: float, ratio: float, loop: ModelBoucWen) -> core.ElementConfig:
            per = loop.xy**loop.n
            return core.element(
                "degradation", k_n_per_m=k, post_yield_ratio=ratio, a=1.0, b=loop.gamma / per,
                c=loop.beta / per, eta=loop.n, loss=min(float(beta[0]), 1.0), **at,
            )  # fmt: skip

        straight = ModelBoucWen(0.0, STRAIGHT_M, 1.0)
        if bw is None or trial.variant != "all":
            return [worn(k, alpha, bw or straight)]
        if not 0.0 <= alpha <= 1.0:
            return None
        parts = ((1.0 - alpha, bw), (alpha, straight))
        return [worn(share * k, 0.0, loop) for share, loop in parts if share > 0.0]


class Maxwell(Effect):
    """Relaxation: a spring and a dashpot in series."""

    name = "maxwell"
    plain = "relaxation"
    phrase = "relaxation of {km_N_m} within {tau_s}"
    params = (Param("km_N_m", "N/m", 0.0, 1e12), Param("tau_s", "s", 1e-4, 1e4))
    equation = "f' + f / tau = km v"
    fingerprint = "a dashpot at low frequency, a spring at high frequency"
    relaxes = settles = sprung = True
    plainer = Viscous.name
    slow_as, fast_as = Viscous.name, Stiffness.name
    shown_by = (
        "sweep",
        "its force changes from velocity-proportional to displacement-proportional around 1 / "
        "(2 pi tau)",
    )
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return relaxation times from a few rows to the length of the test."""
        return [Trial((float(tau),)) for tau in np.geomspace(max(4e-3, ctx.dt), 4.0, 13)]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep it different from a spring, and from a dashpot that is late by a part of a row."""
        return [(ctx.dt, 20.0)]

    def settling_s(self, trial: Trial) -> float:
        """Return the relaxation time."""
        return trial.theta[0]

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
