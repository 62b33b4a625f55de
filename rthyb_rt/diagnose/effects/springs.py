"""Effects that depend on displacement alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import play
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial
from rthyb_rt.diagnose.estimate import nominal_time

AMPLITUDES = (
    "multi_amplitude",
    "a stiffness that changes with amplitude requires several amplitudes",
)


class Stiffness(Effect):
    """Stiffness error, P-delta, force gain, flexible fixture: equivalent while linear.

    Variant "gain" is a gain error of load cell or amplifier, which also scales damping and inertia.
    For a yielding specimen, the error applies to its whole loop; variant "beside" is a spring
    parallel to the loop that does not yield with it, such as P-delta.
    """

    name = "stiffness"
    plain = "an error of the stiffness"
    phrase = "a stiffness {dk_ratio:%} {dk_ratio:below|above} the model's"
    params = (Param("dk_ratio", "", -1.0, 10.0),)
    equation = "f = dk_ratio k x"
    fingerprint = "linear in displacement, the same at every frequency"
    number = "k"
    static = True
    elastic = True
    shown_by = ("sweep", "the force of a spring does not depend on frequency, that of a mass does")

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return one trial if there is a spring, and another if it yields."""
        beside = [Trial((), "beside")] if ctx.model.bouc_wen else []
        return [Trial(), *beside] if ctx.model.k else []

    def forms_begun(self, ctx: Context, trial: Trial) -> Sequence[Trial]:
        """Return a gain as well: specimens seldom change suddenly in mid-test, amplifiers do."""
        model = ctx.model
        gain = model.family in ("drive", "loop") and bool(model.c or model.moving_mass)
        return [trial, Trial((), "gain")] if gain else [trial]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the model's restoring force, its entire force, or that of a parallel spring."""
        if trial.variant == "gain":
            return [ctx.total]
        if trial.variant == "beside":
            return [ctx.model.k * ctx.x]
        return [ctx.spring if ctx.model.k else ctx.x]

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return which of them it is."""
        forms = {
            "gain": "f = f0 (1 + dk_ratio), a gain",
            "beside": "f = dk_ratio k x, beside the loop",
        }
        return forms.get(trial.variant, "f = dk_ratio k x")

    def restates(self, trial: Trial) -> bool:
        """Return whether it changes the stated stiffness; a spring beside a loop is one more."""
        return not self.late and trial.variant != "beside"

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if nothing would remain of the spring."""
        return bool(beta[0] > -1.0) or not ctx.model.k

    def of_loop(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the stiffness error: the initial stiffness of a loop is that of its spring."""
        return float(beta[0]) if ctx.model.bouc_wen and not trial.variant else 0.0

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return a spring, negative if the model is too stiff; for a gain, all its forces."""
        share, model = float(beta[0]), ctx.model
        if trial.variant == "beside":
            return [core.element("stiffness", k_n_per_m=share * model.k)]
        if trial.variant and (model.extra or (share < 0.0 and model.moving_mass)):
            return None
        out = [core.element("stiffness", k_n_per_m=share * (model.k or 1.0))]
        if model.bouc_wen:
            if share <= 0.0:
                return None
            out = [model.bouc_wen.element(model.k, share)]
        if trial.variant and model.c:
            out.append(core.element("viscous", c_n_s_per_m=share * model.c))
        if trial.variant and model.moving_mass:
            out.append(core.element("inertia", m_kg=share * model.moving_mass))
        return out


LINES = "two lines"
"""An elastic spring that is softer beyond a displacement."""


class Cubic(Effect):
    """Hardening or softening spring.

    Variant "sine" is a pendulum, with x^3 as the first term of its series: its force is that of a
    spring at small amplitude, and k3 = -k / (6 L^2). Variant "power" has an exponent other than
    three, variant "two lines" softens at a corner, as where a foot lifts off.
    """

    name = "cubic"
    plain = "a cubic spring"
    phrase = "a spring that {k3_N_m3:softens|hardens} with displacement ({k3_N_m3})"
    params = (Param("k3_N_m3", "N/m^3", -1e15, 1e15),)
    equation = (
        "f = k3 x^3, or k [L sin(x / L) - x], or k x |x / x0|^(n - 1), or -k (|x| - x0) sgn(x) "
        "where |x| > x0"
    )
    fingerprint = "residual over displacement is an odd cubic without a loop"
    static = True
    curve = True
    elastic = True
    shown_by = AMPLITUDES

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return the cubic, and pendulums whose swing is large enough to distinguish them."""
        lengths = ctx.x_range * np.array([0.4, 0.55, 0.75, 1.0, 1.4])
        return [
            Trial(),
            *(Trial((float(length),), "sine") for length in lengths),
            *(Trial((n,), "power") for n in (1.5, 1.8, 2.2, 2.5, 3.8, 5.0)),
            *(Trial((float(part * ctx.x_range),), LINES) for part in (0.2, 0.35, 0.5, 0.65, 0.8)),
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the swing between half a right angle and overturning, a corner in the motion."""
        if trial.variant == LINES:
            return [(0.05 * ctx.x_range, 0.95 * ctx.x_range)]
        if trial.variant == "power":
            return [(1.3, 2.8) if trial.theta[0] < 3.0 else (3.2, 7.0)]
        return [(0.32 * ctx.x_range, 1.6 * ctx.x_range)] if trial.variant else []

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient; a pendulum only softens, and so does a foot that lifts off."""
        softens = trial.variant in ("sine", LINES)
        return (("+" if softens else "*"), (None,)), 1 + len(trial.theta)

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return x^3, or the difference between a pendulum and its spring."""
        if trial.variant == "power":
            return [ctx.k_scale * ctx.x * np.abs(ctx.x / ctx.x_range) ** (trial.theta[0] - 1.0)]
        if trial.variant == LINES:
            held = np.clip(ctx.x, -trial.theta[0], trial.theta[0])
            return [ctx.k_scale * (held - ctx.x)]
        if trial.variant:
            length = trial.theta[0]
            return [ctx.k_scale * (length * np.sin(ctx.x / length) - ctx.x)]
        return [ctx.x**3]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the coefficient of x^3: a pendulum's from its series, a power's the nearest."""
        if trial.variant == "power":
            nearest = 7.0 / (trial.theta[0] + 4.0) / ctx.x_range**2
            return {"k3_N_m3": float(beta[0]) * ctx.k_scale * nearest}
        if trial.variant == LINES:
            x = np.linspace(0.0, ctx.x_range)
            lost = float(np.sum(np.maximum(x - trial.theta[0], 0.0) * x**3) / np.sum(x**6))
            return {"k3_N_m3": -float(beta[0]) * ctx.k_scale * lost}
        if trial.variant:
            return {"k3_N_m3": -float(beta[0]) * ctx.k_scale / (6.0 * trial.theta[0] ** 2)}
        return {"k3_N_m3": float(beta[0])}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law."""
        if trial.variant == "power":
            return f"power law, |x|^{trial.theta[0]:.3g} sgn(x)"
        if trial.variant == LINES:
            return f"rocking, softer beyond {trial.theta[0]:.4g} m"
        return "pendulum, sin(x / L)" if trial.variant else "k3 x^3"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element; a pendulum replaces a spring."""
        if not trial.variant:
            return [core.element("cubic", k3_n_per_m3=float(beta[0]))]
        if trial.variant == "power":
            return [
                core.element(
                    "power_spring", force_n=float(beta[0]) * ctx.k_scale * ctx.x_range,
                    at_m=ctx.x_range, exponent=trial.theta[0],
                    width_m=float(np.clip(1e-4 * ctx.x_range, 1e-9, 1.0)),
                )
            ]  # fmt: skip
        k, length = float(beta[0]) * ctx.k_scale, trial.theta[0]
        if trial.variant == LINES:
            return [
                core.element("rocking", k_n_per_m=k, uplift_m=length, post_uplift_ratio=0.0),
                core.element("stiffness", k_n_per_m=-k),
            ]
        return [
            core.element("pendulum", weight_n=k * length, length_m=length),
            core.element("stiffness", k_n_per_m=-k),
        ]


RISES = ("exponential", "exponential down")
"""Exponential springs, which stiffen for positive and for negative displacement."""


class Quadratic(Effect):
    """A spring that differs between push and pull.

    Variants "exponential": the stiffness grows with exp(x / L) in one direction, as for rubber and
    soil; k2 x^2 is the first term of the series.
    """

    name = "quadratic"
    plain = "a quadratic spring"
    phrase = "a spring with different stiffnesses in the two directions (quadratic, {k2_N_m2})"
    params = (Param("k2_N_m2", "N/m^2", -1e15, 1e15),)
    equation = "f = k2 x^2, or 2 k2 L^2 [exp(x / L) - 1 - x / L]"
    fingerprint = "residual over displacement is an even parabola, or one steeper on one side"
    static = True
    curve = True
    elastic = True
    shown_by = AMPLITUDES

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return the parabola, and springs that stiffen in either direction."""
        lengths = ctx.x_range * np.array([2.0, 5.0, 12.0])
        return [Trial(), *(Trial((float(size),), to) for to in RISES for size in lengths)]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the length between what a cubic can also describe and what is a parabola."""
        return [(1.5 * ctx.x_range, 30.0 * ctx.x_range)] if trial.variant else []

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient; an exponential spring stiffens, in its own direction."""
        return (("+" if trial.variant else "*"), (None,)), 1 + len(trial.theta)

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return x^2, or the difference between an exponential spring and its initial stiffness."""
        return [_exponential(ctx.x, trial) if trial.variant else ctx.x**2]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the coefficient of x^2; for an exponential spring, that of its series."""
        return {"k2_N_m2": -float(beta[0]) if trial.variant == RISES[1] else float(beta[0])}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law."""
        if not trial.variant:
            return "k2 x^2"
        way = "" if trial.variant == RISES[0] else "-"
        return f"exponential, exp({way}x / {trial.theta[0]:.3g} m)"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element; for an exponential spring, the polynomial that equals it here."""
        if not trial.variant:
            return [core.element("quadratic", k2_n_per_m2=float(beta[0]))]
        unit = np.linspace(-1.0, 1.0, 201)
        force = float(beta[0]) * _exponential(ctx.x_range * unit, trial)
        k1, k2, k3 = np.linalg.lstsq(np.vander(unit, 4)[:, 2::-1], force, rcond=None)[0]
        return [
            core.element("stiffness", k_n_per_m=float(k1) / ctx.x_range),
            core.element("quadratic", k2_n_per_m2=float(k2) / ctx.x_range**2),
            core.element("cubic", k3_n_per_m3=float(k3) / ctx.x_range**3),
        ]


def _exponential(x: Floats, trial: Trial) -> Floats:
    """Return an exponential spring's force less its initial stiffness for abs(k2) = 1, (n,)."""
    way = 1.0 if trial.variant == RISES[0] else -1.0
    over = way * x / trial.theta[0]
    return np.asarray(way * 2.0 * trial.theta[0] ** 2 * (np.expm1(over) - over))


PARTS = 8
"""Number of springs that represent a distributed contact in a rig file."""
CORNERS = ("spread", "rough")
"""How the clearance of a contact is distributed: evenly, or by a logistic distribution, whose tails
are exponential like those of rough surfaces (Greenwood & Williamson, Proc. R. Soc. A 295, 1966)."""
LIKE = (0.5, 1.0, 2.0)
"""Widths of the other corner that are compared, relative to that of equal standard deviation."""


def met(depth: Floats, width: float, corner: str = CORNERS[0]) -> Floats:
    """Return the depth of a contact whose clearance is distributed, (n,), m.

    Surfaces that are not parallel touch at one end first: the result is the mean over the
    clearances. If they are distributed evenly by +-width, it is a parabola between no contact and
    full contact; by a logistic distribution of scale `width`, its integral.
    """
    if corner == CORNERS[1]:
        return np.asarray(width * np.logaddexp(0.0, depth / width))
    within = (depth + width) ** 2 / (4.0 * width)
    return np.where(depth < -width, 0.0, np.where(depth < width, within, depth))


def spread(middle: float, width: float, corner: str = CORNERS[0]) -> Floats:
    """Return clearances that represent such a contact, (`PARTS`,), m."""
    share = (np.arange(PARTS) + 0.5) / PARTS
    if corner == CORNERS[1]:
        return middle + width * np.log(share / (1.0 - share))
    return middle + width * (2.0 * share - 1.0)


def _both_sides(x: Floats, trial: Trial) -> Floats:
    """Return the depth of such a contact on both sides, signed, (n,), m."""
    at, width = trial.theta
    return met(x - at, width, trial.variant) - met(-x - at, width, trial.variant)


def _places(trial: Trial) -> list[float] | None:
    """Return the clearances that represent it in a rig file, m; None if it is met at zero."""
    at, width = trial.theta
    places = [float(place) for place in spread(at, width, trial.variant)]
    met_at_zero = width > at if trial.variant == CORNERS[0] else min(places) < 0.0
    return None if met_at_zero else places


def _corners(trial: Trial) -> list[Trial]:
    """Return the contact with its clearance distributed in the other ways, of similar widths."""
    at = trial.theta[0]
    if trial.variant not in CORNERS:  # sharp: any corner that is not much wider than this
        return [Trial((at, 0.1 * part * at), c) for c in CORNERS for part in LIKE]
    # Standard deviations: width / sqrt(3) of the even one, pi width / sqrt(3) of the logistic one.
    per = np.pi if trial.variant == CORNERS[1] else 1.0 / np.pi
    (other,) = set(CORNERS) - {trial.variant}
    return [Trial((at, float(per * part * trial.theta[1])), other) for part in LIKE]


class Gap(Effect):
    """Backlash or dead band in the specimen's connection.

    In the variants of `CORNERS`, the dead band does not end at the same displacement everywhere.
    """

    name = "gap"
    plain = "a gap"
    phrase = "a gap of {gap_m}"
    params = (Param("gap_m", "m", 1e-9, 1.0),)
    equation = "spring force at x beyond +-gap (dead band), or behind a play of +-gap"
    fingerprint = "force is missing around zero (dead band) or after each reversal (play)"
    static = True
    curve = True
    of_spring = "gap_m"
    interrupts = True
    shown_by = ("multi_amplitude", "a gap takes up the same displacement at every amplitude")
    signs = "+"
    pinned = (0.03,)

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return gaps from thousandths of the amplitude to most of it."""
        if not ctx.model.k:
            return []
        gaps = ctx.x_range * np.geomspace(2e-3, 0.8, 14)
        uneven = [
            Trial((float(up), float(up * ratio)), "uneven")
            for up in gaps[2:-2:3]
            for ratio in (0.2, 0.5, 2.0, 5.0)
        ]
        even = [Trial((float(g),), v) for v in ("deadband", "play") for g in gaps]
        return [
            *even,
            *uneven,
            *(
                Trial((float(g), width * float(g)), corner)
                for corner, width in zip(CORNERS, (0.3, 0.1), strict=True)
                for g in gaps[3:-1:3]
            ),
        ]

    def kin(self, trial: Trial) -> Sequence[Trial]:
        """Return the dead band with other corners."""
        return _corners(trial) if trial.variant in ("deadband", *CORNERS) else ()

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Leave the coefficient free if the stiffness is."""
        return ("+", (ctx.model.k_tol,)), len(trial.theta)

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force that the spring loses."""
        half = trial.theta[0]
        if trial.variant in CORNERS:
            moved = _both_sides(ctx.x, trial)
        elif trial.variant != "play":
            moved = ctx.x - np.clip(ctx.x, -trial.theta[-1], half)
        else:
            moved = play(half, ctx.x)
        return [ctx.model.spring(moved) - ctx.spring if ctx.model.k else moved - ctx.x]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the gap; half its width if the two sides differ."""
        ends = trial.theta[:1] if trial.variant in CORNERS else trial.theta
        return {"gap_m": float(np.mean(ends))}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the kind of gap."""
        if trial.variant == "uneven":
            up, down = trial.theta
            return f"dead band from {-down:.4g} to {up:.4g} m, the spring beyond"
        if trial.variant == CORNERS[0]:
            return f"dead band that ends over +-{trial.theta[1]:.4g} m, the spring beyond"
        if trial.variant == CORNERS[1]:
            return f"dead band with rough ends, {trial.theta[1]:.4g} m, the spring beyond"
        if trial.variant == "deadband":
            return "dead band, the spring beyond +-gap"
        return "play, the spring behind +-gap"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return a spring behind the gap to replace the model's own; play has no element."""
        k = float(beta[0]) * ctx.model.k
        if ctx.model.bouc_wen or k <= 0 or trial.variant == "play":
            return None
        out = [core.element("stiffness", k_n_per_m=-k)]
        if trial.variant == "deadband":
            return [*out, core.element("gap", k_n_per_m=k, gap_m=trial.theta[0])]
        if trial.variant in CORNERS:
            gaps = _places(trial)
            if gaps is None:
                return None
            return [*out, *(core.element("gap", k_n_per_m=k / PARTS, gap_m=g) for g in gaps)]
        up, down = trial.theta
        return [
            *out,
            core.element(
                "gap_uneven", k_up_n_per_m=k, gap_up_m=up, k_down_n_per_m=k, gap_down_m=down
            ),
        ]


class Stopper(Effect):
    """A stop beyond a displacement; in the variants of `CORNERS` not at the same one everywhere.

    Variants "impact": the contact loses energy in proportion to its depth (Hunt & Crossley, J.
    Appl. Mech. 42, 1975). With an elastic stop, damping and time would have to represent that.
    """

    name = "stopper"
    plain = "a stop"
    phrase = "a stop at {xs_m} with {ks_N_m}"
    params = (Param("ks_N_m", "N/m", 0.0, 1e12), Param("xs_m", "m", 0.0, 10.0))
    equation = (
        "f = ks (|x| - xs) sgn(x) where |x| > xs; if it loses energy, times 1 + loss v, v inwards"
    )
    fingerprint = "residual only beyond a certain displacement, growing from there"
    static = True
    curve = True
    shown_by = ("multi_amplitude", "a stop is reached only at large amplitude")
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return stops from a third of the amplitude to nearly all of it."""
        at = ctx.x_range * np.array(
            [0.3, 0.4, 0.5, 0.58, 0.65, 0.7, 0.75, 0.8, 0.84, 0.88, 0.91, 0.94, 0.96, 0.98]
        )
        sides = ("both", "up", "down")
        elastic = [
            *(Trial((float(xs),), side) for side in sides for xs in at),
            *(
                Trial((float(xs), width * float(xs)), corner)
                for corner, width in zip(CORNERS, (0.2, 0.07), strict=True)
                for xs in at[1:-2:3]
            ),
        ]
        if nominal_time(ctx.model):  # a loss for each m/s would refer to velocities of that time
            return elastic
        lossy = [
            Trial((float(xs), 0.2 / ctx.v_range), f"impact {side}") for side in sides for xs in at
        ]
        return [*elastic, *lossy]

    def kin(self, trial: Trial) -> Sequence[Trial]:
        """Return the elastic stop on both sides with other corners."""
        return _corners(trial) if trial.variant in ("both", *CORNERS) else ()

    def sharp(self, trial: Trial) -> Trial:
        """Return an elastic stop with a sharp corner."""
        return Trial(trial.theta[:1], "both" if trial.variant in CORNERS else self._side(trial))

    @staticmethod
    def _impact(trial: Trial) -> bool:
        return trial.variant.startswith("impact")

    @staticmethod
    def _side(trial: Trial) -> str:
        return trial.variant.removeprefix("impact ")

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Count the width over which contact is made, or its loss."""
        return ("+", (None,)), 1 + len(trial.theta)

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the stop within the motion."""
        second = []
        if trial.variant in CORNERS:
            second = [(1e-3 * ctx.x_range, ctx.x_range)]
        elif self._impact(trial):
            second = [(0.01 / ctx.v_range, 3.0 / ctx.v_range)]
        return [(0.1 * ctx.x_range, 0.999 * ctx.x_range), *second]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the penetration of the stop."""
        xs = trial.theta[0]
        if trial.variant in CORNERS:
            return [_both_sides(ctx.x, trial)]
        up, down = np.maximum(ctx.x - xs, 0.0), np.minimum(ctx.x + xs, 0.0)
        if self._impact(trial):
            up = up * np.maximum(1.0 + trial.theta[1] * ctx.v, 0.0)
            down = down * np.maximum(1.0 - trial.theta[1] * ctx.v, 0.0)
        return [{"up": up, "down": down}.get(self._side(trial), up + down)]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return stiffness and position."""
        return {"ks_N_m": float(beta[0]), "xs_m": trial.theta[0]}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return its sides."""
        if trial.variant == CORNERS[0]:
            return f"both sides, met over +-{trial.theta[1]:.4g} m"
        if trial.variant == CORNERS[1]:
            return f"both sides, met on rough surfaces, {trial.theta[1]:.4g} m"
        sides = {"up": "upwards only", "down": "downwards only"}.get(
            self._side(trial), "both sides"
        )
        if self._impact(trial):
            return f"{sides}, force times 1 + {trial.theta[1]:.3g} s/m times the velocity inwards"
        return sides

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        ks, xs = float(beta[0]), trial.theta[0]
        loss = trial.theta[1] if self._impact(trial) else 0.0
        if self._side(trial) == "both":
            return [core.element("stopper", ks_n_per_m=ks, xs_m=xs, loss_s_per_m=loss)]
        if trial.variant in CORNERS:
            places = _places(trial)
            if places is None:
                return None
            return [core.element("stopper", ks_n_per_m=ks / PARTS, xs_m=at) for at in places]
        up, down = (ks, 0.0) if self._side(trial) == "up" else (0.0, ks)
        return [
            core.element(
                "gap_uneven",
                k_up_n_per_m=up,
                gap_up_m=xs,
                k_down_n_per_m=down,
                gap_down_m=xs,
                loss_s_per_m=loss,
            )
        ]


EFFECTS: tuple[Effect, ...] = (Stiffness(), Cubic(), Quadratic(), Gap(), Stopper())
