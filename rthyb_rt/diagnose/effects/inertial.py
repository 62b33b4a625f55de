"""Effects of mass: moving parts missing from the model, and parts attached to the specimen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import SimulationError, body
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial


class Inertia(Effect):
    """Moving mass between load cell and specimen that the model lacks."""

    name = "inertia"
    plain = "a moving mass"
    phrase = "{m_kg} {m_kg:less|more} moving mass"
    params = (Param("m_kg", "kg", -1e7, 1e7),)
    equation = "f = m a"
    fingerprint = "residual is linear in acceleration, growing with frequency squared"
    number = "moving_mass"
    over = "a"
    shown_by = ("sweep", "the force of a mass grows with the square of frequency")

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the acceleration."""
        return [ctx.a]

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return False if less than half of the known mass would remain."""
        whole = ctx.model.moving_mass + ctx.model.mass
        return bool(beta[0] > -0.5 * whole) or whole == 0.0 or ctx.k_free

    def mass_kg(self, beta: Floats) -> float | None:
        """Return the mass."""
        return float(beta[0])

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element; a mass to be subtracted has none."""
        return [core.element("inertia", m_kg=float(beta[0]))] if beta[0] >= 0 else None


def _from_velocity(v: Floats, dt: float) -> Floats:
    """Return the acceleration for a velocity of shape (n,), (n,): five rows, error (w dt)^4 / 30.

    Three rows at the ends.
    """
    out = np.gradient(v) / dt
    if v.size > 4:
        out[2:-2] = (8.0 * (v[3:-1] - v[1:-3]) - (v[4:] - v[:-4])) / (12.0 * dt)
    return np.asarray(out)


class SecondMode(Effect):
    """A mass attached to the specimen by a spring."""

    name = "second_mode"
    plain = "a second mass on a spring"
    phrase = "{m2_kg} on a spring at {f2_Hz}"
    params = (Param("m2_kg", "kg", 0.0, 1e8), Param("f2_Hz", "Hz", 0.01, 400.0))
    equation = "y'' + 2 zeta w2 y' + w2^2 y = -a, f = -m2 (2 zeta w2 y' + w2^2 y)"
    fingerprint = "residual oscillates at a frequency of its own"
    shown_by = ("sweep", "a sweep through its natural frequency excites it")
    settles = True
    plainer = Inertia.name
    signs = "+"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return frequencies up to a fifth of the sampling rate, with light and heavier damping."""
        top = min(0.12 * ctx.model.fs_hz, 60.0)
        return [
            Trial((float(f), z)) for f in np.geomspace(0.6, top, 22) for z in (0.01, 0.03, 0.08)
        ]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep frequency and damping near the trial's: its response is a peak.

        A mode with fewer than four rows per period acts as a mass.
        """
        f, most = trial.theta[0], 0.25 * ctx.model.fs_hz
        return [(max(min(f, most) / 1.4, 0.05), min(f * 1.4, most)), (1e-3, 0.4)]

    def settling_s(self, trial: Trial) -> float:
        """Return the reciprocal of its angular frequency."""
        return 1.0 / (2.0 * np.pi * trial.theta[0])

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Count the damping as fitted, too."""
        return ("+", (None,)), 3

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per kg.

        It responds to the acceleration averaged over a row, not to the instantaneous one: a fast
        actuator has a peak of it after each corner of its command, which the rows sample at random.
        """
        f, zeta = trial.theta
        mass = core.CoreElement(core.element("second_mode", m2_kg=1.0, f2_hz=f, zeta2=zeta))
        return [mass.run(ctx.x, ctx.v, _from_velocity(ctx.v, ctx.dt), ctx.dt)]

    def by_stroke(self, ctx: Context, trial: Trial, change: float, like: Trial) -> Floats | None:
        """Return the force per kg of a mass on a spring that hardens or softens, (n,).

        y'' + 2 zeta w2 y' + w2^2 y (1 + change y^2 / mean(y^2)) = -a (Duffing).
        """
        f, zeta = trial.theta
        omega = 2.0 * np.pi * f
        still = self.columns(ctx, like)[0] / (2.0 * np.pi * like.theta[0]) ** 2
        a = _from_velocity(ctx.v, ctx.dt)
        parts = [
            core.element("stiffness", k_n_per_m=omega**2),
            core.element("viscous", c_n_s_per_m=2.0 * zeta * omega),
            core.element("cubic", k3_n_per_m3=change * omega**2 / float(np.mean(still**2))),
        ]
        try:
            return body(1.0, parts, -a, ctx.model.fs_hz).a + a
        except (SimulationError, core.CoreError):
            return None

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return mass and frequency."""
        return {"m2_kg": float(beta[0]), "f2_Hz": trial.theta[0]}

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the element."""
        f, zeta = trial.theta
        return [core.element("second_mode", m2_kg=float(beta[0]), f2_hz=f, zeta2=zeta)]


EFFECTS: tuple[Effect, ...] = (Inertia(), SecondMode())
