"""Effects that depend on velocity: dashpots, and the nested family of dry friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects import chains
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial

SLOW = ("multi_amplitude", "friction stays constant while other forces grow with amplitude")


EXPONENTS = ((0.2, 0.9), (1.1, 1.85), (2.15, 3.5))
"""Exponents of velocity with their own names: 1 is a dashpot, 2 is quadratic damping."""
NEARLY = "nearly"
"""A damper whose exponent is near one."""


class Viscous(Effect):
    """A dashpot that the model lacks, or has in excess.

    In variant `NEARLY`, it is a fluid damper whose exponent is near one.
    """

    name = "viscous"
    plain = "viscous damping"
    phrase = "{c_Ns_m} {c_Ns_m:less|more} viscous damping"
    params = (Param("c_Ns_m", "N s/m", -1e10, 1e10),)
    equation = "f = c v"
    fingerprint = "residual is linear in velocity"
    number = "c"
    static = True
    dissipates = True
    shown_by = (
        "sweep",
        "a dashpot's force grows with velocity, the effect of a time skew with the force's rate",
    )

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return a dashpot, and one whose force grows a little faster than velocity."""
        return [Trial(), Trial((1.05,), NEARLY)]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the exponent in the range that has this name."""
        return [(EXPONENTS[0][1], EXPONENTS[1][0])] if trial.variant else []

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, and the exponent."""
        return ("*", (None,)), 1 + len(trial.theta)

    def restates(self, trial: Trial) -> bool:
        """Return whether it changes the stated damping only, and not its form."""
        return not self.late and not trial.variant

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the velocity, or its power with the work of a dashpot of 1 N s/m."""
        if not trial.variant:
            return [ctx.v]
        force = to_the_power(ctx, trial.theta[0])
        return [force * (float(ctx.v @ ctx.v) / (float(ctx.v @ force) or 1.0))]

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the exponent if it is not one."""
        if not trial.variant:
            return self.equation
        return f"fluid viscous damper, |v|^{trial.theta[0]:.3g} sgn(v)"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element; a damper in excess is subtracted as a dashpot of the same work."""
        c = float(beta[0])
        if not trial.variant or c <= 0.0:
            return [core.element("viscous", c_n_s_per_m=c)]
        force = to_the_power(ctx, trial.theta[0])
        peak_n = c * float(ctx.v @ ctx.v) / (float(ctx.v @ force) or 1.0)
        return [damper(ctx, peak_n, trial.theta[0])]


class QuadDamping(Effect):
    """Damping of orifices and drag."""

    name = "quad_damping"
    plain = "damping with the square of velocity"
    phrase = "{c2_Ns2_m2} {c2_Ns2_m2:less|more} damping with the square of velocity"
    params = (Param("c2_Ns2_m2", "N s^2/m^2", -1e12, 1e12),)
    equation = "f = c2 v |v|"
    fingerprint = "residual grows with the square of velocity"
    static = True
    dissipates = True
    shown_by = (
        "multi_amplitude",
        "a force proportional to the square of velocity requires several amplitudes",
    )

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return v |v|."""
        return [ctx.v * np.abs(ctx.v)]

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        return [core.element("quad_damping", c2_n_s2_per_m2=float(beta[0]))]


class PowerDamping(Effect):
    """A fluid viscous damper: its force is proportional to a power of velocity."""

    name = "power_damping"
    plain = "damping with a power of velocity"
    phrase = "damping with velocity to the power of {exponent:3} ({F1_N} at 1 m/s)"
    params = (Param("F1_N", "N", 0.0, 1e10), Param("exponent", "", 0.05, 10.0))
    equation = "f = F1 |v / (1 m/s)|^exponent sgn(v)"
    fingerprint = "residual over velocity is a power law, neither linear nor quadratic"
    dissipates = True
    shown_by = ("multi_amplitude", "a power of velocity requires several amplitudes")
    contains = (Viscous.name, QuadDamping.name)
    signs = "+"
    momentary = True

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return exponents below, between and above those of the laws with their own names."""
        return [Trial((a,)) for a in (0.3, 0.45, 0.6, 0.75, 1.25, 1.5, 1.75, 2.5, 3.0)]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the exponent in the range without another name."""
        return [min(EXPONENTS, key=lambda ends: abs(trial.theta[0] - 0.5 * sum(ends)))]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Reject the smallest exponent: anything less is dry friction; and those of a dashpot."""
        return trial.theta[0] > 1.01 * EXPONENTS[0][0] and self.borders(trial) != Viscous.name

    def borders(self, trial: Trial) -> str:
        """Return the law whose exponent lies just beyond the bound that has been reached."""
        ends = [end for pair in EXPONENTS for end in pair][1:-1]
        end = min(ends, key=lambda at: abs(trial.theta[0] - at))
        if abs(trial.theta[0] / end - 1.0) > 1e-3:
            return ""
        return Viscous.name if round(end) == 1 else QuadDamping.name

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, the force."""
        return ("+", (None,)), 2

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per N at the largest velocity."""
        return [to_the_power(ctx, trial.theta[0])]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the force at 1 m/s, which is C in N (s/m)^exponent, and the exponent."""
        a = trial.theta[0]
        return {"F1_N": float(beta[0]) / ctx.v_range**a, "exponent": a}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the damper with its exponent."""
        return f"fluid viscous damper, |v|^{trial.theta[0]:.3g} sgn(v)"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        return [damper(ctx, float(beta[0]), trial.theta[0])]


LINEAR = 3e-3
"""Fraction of the largest velocity below which such a damper is linear."""


def to_the_power(ctx: Context, exponent: float) -> Floats:
    """Return a power of velocity with its sign, (n,), 1 at the largest velocity."""
    r = ctx.v / ctx.v_range
    return np.asarray(r * (r**2 + LINEAR**2) ** (0.5 * (exponent - 1.0)))


def damper(ctx: Context, force_n: float, exponent: float) -> core.ElementConfig:
    """Return the element with that force at the largest velocity."""
    return core.element(
        "power_damping", force_n=force_n, at_m_per_s=float(ctx.v_range), exponent=exponent,
        width_m_per_s=float(np.clip(LINEAR * ctx.v_range, 1e-7, 1.0)),
    )  # fmt: skip


CONTACT = (2e-5, 4e-3)
"""Range of the displacement before a dry contact slips, relative to the amplitude; beyond it,
friction is that of bristles."""

SHARP = 1e-4
"""Width of the step of a dry contact in a rig file, relative to the largest velocity."""
STICKS = 1e-7
"""The same for the simulation of a freely moving body, which solves for the force that holds it: in
a minute at rest it creeps by 1e-5 of its motion in a second."""


def slipping(ctx: Context, way_m: float) -> Floats:
    """Return the force per N of a dry contact that shears by ``way_m`` before it slips, (n,)."""
    return chains.plastic(chains.even(way_m, 0.0), ctx.x) / way_m


class Coulomb(Effect):
    """Dry friction with a free width around zero velocity: a fixed one would look like Stribeck.

    Variant "contact" shears slightly before it slips, as every contact does: a small reversal then
    shows the force of a spring instead of a step. Variant "root" rounds the step by the other
    common formula, which reaches its level more slowly than tanh: with tanh alone, the difference
    would be taken for damping. Variant "sharp" has no width: in a simulation, the body sticks.
    """

    name = "coulomb"
    plain = "dry friction"
    phrase = "dry friction of {Fc_N}"
    params = (Param("Fc_N", "N", 0.0, 1e8),)
    equation = "f = Fc tanh(v / width), or Fc v / sqrt(v^2 + width^2)"
    fingerprint = "residual jumps with the sign of velocity, its magnitude is constant"
    static = True
    dry = True
    dissipates = True
    shown_by = SLOW
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return widths from a sharp jump to a thirtieth of the velocity."""
        return [
            *(Trial((float(w),)) for w in ctx.v_range * np.geomspace(3e-4, 4e-2, 8)),
            *(Trial((float(w),), "root") for w in ctx.v_range * np.array([5e-3, 2e-2])),
            *(Trial((float(z),), "contact") for z in ctx.x_range * np.geomspace(5e-5, 3e-3, 4)),
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the width below that of a dashpot, and the contact below a bristle."""
        if self.shears(trial):
            return [(CONTACT[0] * ctx.x_range, CONTACT[1] * ctx.x_range)]
        return [(1e-5 * ctx.v_range, 0.12 * ctx.v_range) for _ in trial.theta]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the smoothed sign of velocity, or of the latest displacement."""
        if self.shears(trial):
            return [slipping(ctx, trial.theta[0])]
        if trial.variant == "root":
            return [ctx.v / np.hypot(ctx.v, trial.theta[0])]
        return [np.tanh(ctx.v / (trial.theta[0] if trial.theta else STICKS * ctx.v_range))]

    def like(self, trial: Trial) -> Trial:
        """Return a contact that shears as far as bristles do, or the step below a peak."""
        if trial.variant == "sharp":
            return Trial((), "sharp")
        sheared = self.shears(trial) or trial.variant in BRISTLES
        return Trial(trial.theta[-1:], "contact" if sheared else "")

    def shears(self, trial: Trial) -> bool:
        """Return whether it is a contact."""
        return trial.variant == "contact"

    def rounded(self, trial: Trial, least: float) -> Trial:
        """Return a step by tanh; a contact has the smallest width."""
        old = trial.theta[0] if trial.theta and not trial.variant else least
        return Trial((max(old, least),))

    def sharp(self, trial: Trial) -> Trial:
        """Return a step of zero width."""
        return Trial((), "sharp")

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return how the sign of velocity is smoothed, and over how much."""
        if not trial.theta:
            return "Fc sgn(v)"
        at = trial.theta[0]
        if self.shears(trial):
            return f"Fc of a contact that shears by {at:.3g} m before it slips"
        step = "Fc v / sqrt(v^2 + width^2)" if trial.variant == "root" else "Fc tanh(v / width)"
        return f"{step}, width {at:.3g} m/s"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        shaped = trial.theta and not self.shears(trial)
        width = trial.theta[0] if shaped else SHARP * ctx.v_range
        width = float(np.clip(width, 1e-7, 1.0))
        return [core.element("coulomb", fc_n=float(beta[0]), width_m_per_s=width)]

    def on_a_body(
        self, ctx: Context, trial: Trial, beta: Floats
    ) -> list[core.ElementConfig] | None:
        """Return the element: for a contact, a spring that slips."""
        if self.shears(trial):
            way = trial.theta[0]
            return chains.elements(chains.even(way, 0.0), float(beta[0]) / way)
        if trial.theta:
            return self.elements(ctx, trial, beta)
        width = float(STICKS * ctx.v_range)
        return [core.element("coulomb", fc_n=float(beta[0]), width_m_per_s=width)]


PEAKS = (0.4, 2.5)
"""Range of the exponent of a peak: the measured ones, 0.5 to 2 (Armstrong-Helouvry, Dupont &
Canudas de Wit, Automatica 30, 1994), with room on both sides so that these are not at a limit."""


class Stribeck(Effect):
    """Friction that decreases with velocity.

    The exponent of its peak is a shape: fitting the Gaussian (2) where the peak is an exponential
    (1) would bias the final level by many times its noise.
    """

    name = "stribeck"
    plain = "friction that falls with velocity"
    phrase = "friction that falls with velocity from {Fs_N} to {Fc_N} within {vs_m_s}"
    params = (
        Param("Fc_N", "N", 0.0, 1e8),
        Param("Fs_N", "N", 0.0, 1e8),
        Param("vs_m_s", "m/s", 1e-6, 10.0),
    )
    equation = (
        f"f = [Fc + (Fs - Fc) exp(-|v/vs|^n)] tanh(v / width), n from {PEAKS[0]} to {PEAKS[1]}"
    )
    fingerprint = "friction with a peak at low velocity"
    dry = True
    plainer = Coulomb.name
    dissipates = True
    shown_by = SLOW
    signs = "++"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return Stribeck velocities, each with sharp and softer jumps."""
        at = ctx.v_range * np.geomspace(0.02, 0.6, 7)
        narrow, way = 1e-3 * ctx.v_range, 1e-3 * ctx.x_range
        return [
            *(
                Trial((float(vs), 2.0, float(w)))
                for vs in at
                for w in ctx.v_range * np.array([1e-3, 4e-3, 1.2e-2])
                if w < 0.4 * vs
            ),
            *(Trial((float(vs), 1.0, narrow)) for vs in at),
            *(Trial((float(vs), n, way), "contact") for vs in at for n in (2.0, 1.0)),
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the Stribeck velocity within the motion and the width well below it."""
        r = ctx.v_range
        peak = [(0.01 * r, 1.2 * r), PEAKS]
        if trial.variant == "sharp":
            return peak
        if self.shears(trial):
            return [*peak, (CONTACT[0] * ctx.x_range, CONTACT[1] * ctx.x_range)]
        return [*peak, (1e-5 * r, 0.4 * trial.theta[0])]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return sliding and additional static friction per N."""
        vs, n, width = (*trial.theta, STICKS * ctx.v_range)[:3]
        sheared = self.shears(trial)
        sign = slipping(ctx, width) if sheared else np.tanh(ctx.v / width)
        return [sign, sign * np.exp(-(np.abs(ctx.v / vs) ** n))]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return both levels and the velocity of the transition between them."""
        fc = float(beta[0])
        return {"Fc_N": fc, "Fs_N": fc + float(beta[1]), "vs_m_s": trial.theta[0]}

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if it is a smooth hump rather than friction."""
        return bool(beta[1] > 0.05 * beta[0] and beta[0] > 0.02 * beta[1])

    def beyond(self, plain: Trial, trial: Trial) -> Trial:
        """Return the same peak on the step of dry friction of the same variant."""
        alike = plain.variant == trial.variant and plain.theta and len(trial.theta) == 3
        return Trial((*trial.theta[:2], plain.theta[0]), trial.variant) if alike else trial

    def shears(self, trial: Trial) -> bool:
        """Return whether the peak is that of a contact."""
        return trial.variant == "contact"

    def rounded(self, trial: Trial, least: float) -> Trial:
        """Return the same peak on a step by tanh."""
        old = least if self.shears(trial) else (*trial.theta, least)[2]
        return Trial((*trial.theta[:2], max(old, least)))

    def sharp(self, trial: Trial) -> Trial:
        """Return the same peak on a step of zero width."""
        return Trial(trial.theta[:2], "sharp")

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law of the peak, and how its sign is smoothed, over how much."""
        if trial.variant == "sharp":
            sign = "sgn(v)"
        elif self.shears(trial):
            sign = f"a contact that shears by {trial.theta[2]:.3g} m before it slips"
        else:
            sign = f"tanh(v / width), width {trial.theta[2]:.3g} m/s"
        return f"[Fc + (Fs - Fc) exp(-|v/vs|^{trial.theta[1]:.2g})] by {sign}"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        width = 1e-3 * ctx.v_range if trial.variant else trial.theta[2]
        return self._of_width(ctx, trial, beta, float(np.clip(width, 1e-7, 1.0)))

    def on_a_body(
        self, ctx: Context, trial: Trial, beta: Floats
    ) -> list[core.ElementConfig] | None:
        """Return the element."""
        if not trial.variant:
            return self.elements(ctx, trial, beta)
        return self._of_width(ctx, trial, beta, float(STICKS * ctx.v_range))

    def _of_width(
        self, ctx: Context, trial: Trial, beta: Floats, width: float
    ) -> list[core.ElementConfig]:
        p = self.report(ctx, trial, beta)
        return [
            core.element(
                "stribeck",
                fc_n=p["Fc_N"], fs_n=p["Fs_N"], vs_m_per_s=p["vs_m_s"], width_m_per_s=width,
                exponent=trial.theta[1],
            )
        ]  # fmt: skip


BRISTLES = ("dahl", "spread0", "spread0.5", "spread1.0", "slips")
FALLS = "falls"
"""Bristles whose friction falls with velocity: all of LuGre's law."""


class Lugre(Effect):
    """Friction with bristles that bend before they slide.

    In variant `FALLS`, it also falls with velocity; ratio of the friction at rest, and velocity
    within which it falls, are two more shapes.
    """

    name = "lugre"
    plain = "friction with elastic bristles"
    phrase = "friction of {Fc_N} with elastic bristles of {sigma0_N_m}"
    params = (Param("Fc_N", "N", 0.0, 1e8), Param("sigma0_N_m", "N/m", 1.0, 1e12))
    equation = "f = s0 z + s1 z', z' = v - s0 |v| z / g(v)"
    fingerprint = "friction that acts as a spring after each reversal"
    dry = True
    slides = True
    plainer = Coulomb.name
    shown_by = ("multi_amplitude", "at amplitudes below their travel, the bristles only bend")
    signs = "+*"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return bristle deflections relative to the amplitude, with and without static excess."""
        even = [
            Trial((float(z0),), v)
            for z0 in ctx.x_range * np.geomspace(2e-3, 0.6, 10)
            for v in BRISTLES
        ]
        falling = [
            Trial((float(z0), 1.6, float(vs)), FALLS)
            for z0 in ctx.x_range * np.geomspace(2e-3, 0.06, 3)
            for vs in ctx.v_range * np.array([0.02, 0.1, 0.4])
        ]
        return even + falling

    def kin(self, trial: Trial) -> Sequence[Trial]:
        """Return the other laws of bristles of the same travel."""
        return [Trial(trial.theta[:1], v) for v in BRISTLES if v != trial.variant]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep bristles visible: below a thousandth of the amplitude it is Coulomb friction."""
        falling = [(1.02, 4.0), (2e-3 * ctx.v_range, 2.0 * ctx.v_range)]
        return [(1e-3 * ctx.x_range, 1.0 * ctx.x_range), *falling][: len(trial.theta)]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return two coefficients, bristle stiffness and damping, and one more for each shape."""
        return ("+*", (None, None)), 1 + len(trial.theta)

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return bristle force per N of friction, and its rate over the velocity range."""
        z0 = trial.theta[0]
        if self._one(trial):
            _, fs, vs = self._bristle(trial)
            z = ctx.unit(
                "lugre", fc_n=1.0, fs_n=fs, vs_m_per_s=vs, sigma0_n_per_m=1.0 / z0,
                sigma1_n_s_per_m=0.0, sigma2_n_s_per_m=0.0,
            )  # fmt: skip
        else:
            yields = self._yields(trial)
            z = chains.plastic(yields, ctx.x) / float(yields.mean())
        return [z, np.gradient(z) / ctx.dt * (z0 / ctx.v_range)]

    @staticmethod
    def _one(trial: Trial) -> bool:
        """Return whether the law is that of one bristle, not of a chain of sliders."""
        return trial.variant in ("dahl", FALLS)

    @staticmethod
    def _bristle(trial: Trial) -> tuple[float, ...]:
        """Return its travel, friction at rest over that in motion, and the velocity between."""
        return trial.theta if trial.variant == FALLS else (trial.theta[0], 1.0, 1.0)

    def _yields(self, trial: Trial) -> Floats:
        """Return where the sliders of a chain slide, m."""
        z0 = trial.theta[0]
        if trial.variant == "slips":  # reverses like bristles of that travel
            return chains.exponential(0.5 * z0)
        return chains.even(z0, float(trial.variant.removeprefix("spread")))

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if the damping outweighs the bristles."""
        return bool(-0.7 * beta[0] <= beta[1] < 3.0 * beta[0])

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return sliding friction and bristle stiffness."""
        return {"Fc_N": float(beta[0]), "sigma0_N_m": float(beta[0]) / trial.theta[0]}

    def holds_n_per_m(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the stiffness of the bristles."""
        return self.report(ctx, trial, beta).get("sigma0_N_m", 0.0)

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law of the bristles."""
        if trial.variant == "dahl":
            return "bristles of Dahl and LuGre"
        if trial.variant == FALLS:
            _, fs, vs = trial.theta
            return f"bristles of LuGre, {fs:.3g} times as much at rest, falling within {vs:.3g} m/s"
        if trial.variant == "spread0":
            return "one bristle, elastic until it slides"
        if trial.variant == "slips":
            return "Iwan chain, yields spread exponentially"
        return f"Iwan chain, spread {trial.variant.removeprefix('spread')}"

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the bristles, or the chain; with damping, whichever is nearer to its force."""
        p = self.report(ctx, trial, beta)
        damping = max(float(beta[1]), 0.0) / ctx.v_range
        _, fs, vs = self._bristle(trial)
        bristles = [
            core.element(
                "lugre", fc_n=p["Fc_N"], fs_n=fs * p["Fc_N"], vs_m_per_s=vs,
                sigma0_n_per_m=p["sigma0_N_m"], sigma1_n_s_per_m=damping, sigma2_n_s_per_m=0.0,
            )
        ]  # fmt: skip
        if self._one(trial):
            return bristles
        yields = self._yields(trial)
        chain = chains.elements(yields, p["Fc_N"] / float(yields.mean()))
        if not damping:
            return chain
        force = np.column_stack(self.columns(ctx, trial)) @ beta

        def error(elements: list[core.ElementConfig]) -> float:
            made = sum(core.CoreElement(e).run(ctx.x, ctx.v, ctx.a, ctx.dt) for e in elements)
            return float(np.sum((made - force) ** 2))

        return min(chain, bristles, key=error)


STARTS = {"low": 0.05, "middle": 0.5, "high": 0.95}
"""Trial positions in the play at the start of a recording, relative to its width."""


def behind(
    ctx: Context, k: float, gap: float, up: float, down: float, start: float, seat: float = 0.0
) -> Floats:
    """Return the force of a slider of +``up`` and -``down`` behind a play and a spring, (n,), N.

    ``start`` is the position in the play at the first row: 0 at its lower face, 1 at its upper one.
    """
    element = core.CoreElement(
        core.element(
            "gap_friction", k_n_per_m=k, gap_m=gap, fc_up_n=up, fc_down_n=down, seat_m=seat
        )
    )
    return element.run(ctx.x + gap * (2.0 * start - 1.0), ctx.v, ctx.a, ctx.dt)


class FrictionBehindGap(Effect):
    """Dry friction that is driven through a backlash: no force acts until the gap is closed."""

    name = "gap+coulomb"
    plain = "dry friction behind a gap"
    params = (Param("gap_m", "m", 1e-9, 1.0), Param("Fc_N", "N", 0.0, 1e8))
    equation = "slider of +-Fc on a spring k behind a play of +-gap"
    fingerprint = "after each reversal the force falls to zero, stays there, and returns"
    static = True
    shown_by = ("multi_amplitude", "a gap takes up the same displacement at every amplitude")
    signs = "+"
    complete = True

    @property
    def names(self) -> tuple[str, ...]:
        """Both names."""
        return ("coulomb", "gap")

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return gaps and elastic displacements; a spring that the model knows is used."""
        if not ctx.k_free:
            return []
        r = ctx.x_range
        return [
            Trial((float(g), float(w), q), place)
            for g in r * np.geomspace(0.015, 0.5, 6)
            for w in r * np.geomspace(0.008, 0.35, 4)
            for place, q in STARTS.items()
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep both within the motion, and the start within the play."""
        way = ctx.x_range
        return [(1e-3 * way, way), (5e-4 * way, way), (0.005, 1.0)]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, the friction, and four parameters."""
        return ("+", (None,)), 4

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per N of friction."""
        gap, way, start = trial.theta
        return [behind(ctx, 1.0 / way, gap, 1.0, 1.0, start)]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return gap and friction."""
        return {"gap_m": trial.theta[0], "Fc_N": float(beta[0])}

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        gap, way, _ = trial.theta
        fc = float(beta[0])
        return [
            core.element(
                "gap_friction", k_n_per_m=fc / way, gap_m=gap, fc_up_n=fc, fc_down_n=fc, seat_m=0.0
            )
        ]


class UnevenFrictionBehindGap(Effect):
    """The same if the two directions slip at different forces.

    Bands, wedges and inclined pads hold more firmly in one direction. While sliding, half the
    difference of the levels looks like an offset of the load cell and is reported as such; within
    the play and while sticking it is absent, which distinguishes the two.

    The faces of the play close over part of the displacement, not at once.
    """

    name = "gap+coulomb+bias"
    plain = "dry friction behind a gap, stronger in one direction"
    params = (
        Param("gap_m", "m", 1e-9, 1.0),
        Param("Fc_N", "N", 0.0, 1e8),
        Param("bias_N", "N", -1e8, 1e8),
    )
    equation = "slider of bias +- Fc on a spring k behind a play of +-gap"
    fingerprint = "as for friction behind a gap, but with two different levels; zero in the gap"
    static = True
    shown_by = ("multi_amplitude", "a gap takes up the same displacement at every amplitude")
    signs = "+"
    complete = True

    @property
    def names(self) -> tuple[str, ...]:
        """All three names."""
        return ("bias", "coulomb", "gap")

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return gaps, elastic displacements and their ratio, coarser than for the even pair."""
        if not ctx.k_free:
            return []
        r = ctx.x_range
        return [
            Trial((float(g), float(w * q), float(w / q), start, 0.5 * float(min(g, w * q))), place)
            for g in r * np.geomspace(0.02, 0.5, 5)
            for w in r * np.geomspace(0.015, 0.25, 3)
            for q in (0.84, 1.19)
            for place, start in STARTS.items()
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep all displacements within the motion, and the start within the play."""
        way = (5e-4 * ctx.x_range, ctx.x_range)
        return [(1e-3 * ctx.x_range, ctx.x_range), way, way, (0.005, 1.0), way]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return one coefficient, the spring's stiffness, and the parameters of the loop."""
        return ("+", (None,)), 1 + len(trial.theta)

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per N/m of the spring."""
        gap, up, down, start, seat = trial.theta
        return [behind(ctx, 1.0, gap, up, down, start, seat)]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return gap, friction, and half the difference between its directions."""
        gap, up, down = trial.theta[:3]
        k = float(beta[0])
        return {"gap_m": gap, "Fc_N": 0.5 * k * (up + down), "bias_N": 0.5 * k * (up - down)}

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        gap, up, down = trial.theta[:3]
        k = float(beta[0])
        return [
            core.element(
                "gap_friction", k_n_per_m=k, gap_m=gap, fc_up_n=k * up, fc_down_n=k * down,
                seat_m=trial.theta[4],
            )
        ]  # fmt: skip


EFFECTS: tuple[Effect, ...] = (
    Viscous(), QuadDamping(), PowerDamping(), Coulomb(), Stribeck(), Lugre(), FrictionBehindGap(),
    UnevenFrictionBehindGap(),
)  # fmt: skip
