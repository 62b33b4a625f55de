"""What redundant channels reveal about the sensors.

On moving ground the body itself weighs the force: m (x'' + ag) + f = 0, whatever the specimen
does. Any deviation of the load cell from this is an error of the cell: a law of the specimen
cancels, but not delay, hum or crosstalk of the cell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rthyb_rt.diagnose import estimate, gaps, noise_level, spectral
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, columns_of, penalty
from rthyb_rt.diagnose.refinement import inflation
from rthyb_rt.diagnose.spectral import Complex


@dataclass(frozen=True)
class Witness:
    """The force by the load cell and by the accelerometer, in the band in which it varies.

    Attributes:
        ctx: the quantities on which effects depend.
        rest: their sum, which is noise if both are correct, (n,), N.
        rows: rows to evaluate, (n,).
        nuisance: mass, time offset, and offset and drift of the accelerometer; (n, 4).
        priors: inverse variance of the coefficient of each; 0: free.
        sigma_n: noise of the sum, N.
        denoise: filter to that band.
    """

    ctx: Context
    rest: Floats
    rows: gaps.Mask
    nuisance: Floats
    priors: Floats
    sigma_n: float
    denoise: spectral.Denoiser

    def left(self, fit: Fit) -> Floats:
        """Return the residual of the sum with a set, in units of the noise, followed by priors."""
        return self._solved(self.rest - cell_error(self.ctx, fit), self.nuisance, self.priors)

    def beside(self, columns: Sequence[Floats]) -> Floats:
        """Return the residual of the sum with load cell errors, each (n,), of free size."""
        more = np.column_stack([self.denoise(c) for c in columns])
        priors = np.concatenate([self.priors, np.zeros(len(columns))])
        return self._solved(self.rest, np.column_stack([self.nuisance, more]), priors)

    def _solved(self, off: Floats, columns: Floats, priors: Floats) -> Floats:
        y = self.denoise(off)[self.rows] / self.sigma_n
        design = columns[self.rows] / self.sigma_n
        size = np.sqrt(np.maximum(np.mean(design**2, axis=0), 1e-300))
        design = np.vstack([design / size, np.diag(np.sqrt(priors) / size)])
        y = np.concatenate([y, np.zeros(size.size)])
        beta = np.linalg.lstsq(design, y, rcond=None)[0]
        return np.asarray(y - design @ beta)


def cell_error(ctx: Context, fit: Fit) -> Floats:
    """Return the error of the load cell according to a set of effects, (n,), N."""
    felt = [(m, b) for m, b in zip(fit.members, fit.betas, strict=True) if not m.effect.sensor]
    out = np.zeros(ctx.t.size)
    for pairs, sign in ((list(zip(fit.members, fit.betas, strict=True)), 1.0), (felt, -1.0)):
        for (_, beta), columns in zip(pairs, columns_of(ctx, [m for m, _ in pairs]), strict=True):
            for b, c in zip(beta, columns, strict=True):
                out += sign * b * c
    return out


LINES = 8
"""Number of frequencies above the noise needed to determine gain and time offset."""


def disagreement(case: Case) -> str:
    """Describe how a_meas differs from x_meas'' (on moving ground + ag); empty if it agrees.

    Gain and time offset are compared where both are above their noise. If they differ, one of the
    channels is wrong, and the accelerometer cannot be used to check the load cell.
    """
    ground = case.model.family == "ground"
    if any(name not in case.channels for name in ("x_meas", "a_meas", *("ag",) * ground)):
        return ""
    x, felt = (gaps.filled(case.channels[name]) for name in ("x_meas", "a_meas"))
    ag = gaps.filled(case.channels["ag"]) if ground else np.zeros(x.size)
    window, made = _accelerations(x, ag, case.dt)
    w = 2.0 * np.pi * np.fft.rfftfreq(x.size, case.dt)
    noise = np.hypot(
        noise_level.noise_of(case.channels["a_meas"], case.model.a_std),
        w**2 * noise_level.noise_of(case.channels["x_meas"], case.model.x_std),
    )
    weight = 1.0 / (noise * np.sqrt(np.sum(window**2)))
    # Noise in the regressor would bias gain and time offset towards zero.
    slow = w < 2.0 * np.pi * POLICY.motion_from_hz
    weight[slow | (np.abs(made) * weight < POLICY.accelerometer_clear)] = 0.0
    if np.count_nonzero(weight) < LINES:
        return ""
    design = np.column_stack([made * weight, -1j * w * made * weight])
    off = (np.fft.rfft(window * (felt - felt.mean())) - made) * weight
    stacked = np.vstack([design.real, design.imag])
    inverse = np.linalg.pinv(stacked.T @ stacked, hermitian=True)
    gain, late = inverse @ (stacked.T @ np.concatenate([off.real, off.imag]))
    rest = off - design @ np.array([gain, late])
    # Real and imaginary part each have half of the power of a frequency.
    spread = max(1.0, float(np.mean(np.abs(rest[weight > 0.0]) ** 2)))
    unsure = POLICY.accelerometer_sure * np.sqrt(0.5 * spread * inverse.diagonal())
    late /= 1.0 + gain  # of the larger signal
    words = []
    if abs(gain) - unsure[0] > POLICY.accelerometer_gain:
        words.append(f"is {100.0 * gain:+.2g} % larger")
    if abs(late) - unsure[1] > POLICY.accelerometer_late_s:
        words.append(f"is {1e3 * late:+.2g} ms later")
    made_of = "x_meas'' + ag" if ground else "x_meas''"
    return f"a_meas {' and '.join(words)} than {made_of}: one of them is wrong" if words else ""


def _accelerations(x: Floats, ag: Floats, dt: float) -> tuple[Floats, Complex]:
    """Return a window, (n,), and the spectrum of x'' + ag under it, by its derivatives."""
    x, turn = x - x.mean(), 2.0 * np.pi / (x.size - 1)
    angle, rate = turn * np.arange(x.size), turn / dt
    window = 0.5 - 0.5 * np.cos(angle)
    slope, bend = 0.5 * rate * np.sin(angle), 0.5 * rate**2 * np.cos(angle)
    w = 2.0 * np.pi * np.fft.rfftfreq(x.size, dt)
    # window x'' = (window x)'' - 2 (window' x)' + window'' x.
    wx, sx, bx, ground = (
        np.fft.rfft(part) for part in (window * x, slope * x, bend * x, window * (ag - ag.mean()))
    )
    return window, np.asarray(ground - w**2 * wx - 2j * w * sx + bx)


def witness(case: Case, ctx: Context, found: estimate.Estimate) -> Witness | None:
    """Return the balance of the body; None if a channel is missing or unsuitable."""
    model, channels = case.model, case.channels
    if model.family != "ground" or model.mass <= 0.0 or model.k_tol is None:
        return None
    if "f_meas" not in channels or "a_meas" not in channels or disagreement(case):
        return None
    force, felt = gaps.filled(channels["f_meas"]), gaps.filled(channels["a_meas"])
    sigma = float(
        np.hypot(
            noise_level.force_noise(channels["f_meas"], model.f_std),
            model.mass * noise_level.noise_of(channels["a_meas"], model.a_std),
        )
    )
    band = spectral.band_of(force, case.fs_hz, sigma)
    # Either channel may have a normal time offset.
    skew = np.gradient(force) * case.fs_hz
    # An accelerometer drifts like a load cell: it cannot be used at low frequencies.
    slow = np.column_stack([np.ones(force.size), ctx.t - ctx.t[0]])
    nuisance = np.column_stack([band(model.mass * felt), band(skew), slow])
    priors = np.array([POLICY.mass_blur**-2, 0.5 * POLICY.offset_prior_s**-2, 0.0, 0.0])
    rest = force + model.mass * felt
    return Witness(ctx, rest, found.rows, nuisance, priors, sigma, band)


def testimony(known: Witness, fits: Sequence[Fit]) -> Callable[[Fit], float]:
    """Return what a set adds to chi-squared because of the body's force balance.

    Relative to the set with the smallest residual, and divided by the inflation due to correlated
    rows.
    """
    best = min((known.left(f) for f in fits), key=lambda r: float(r @ r))
    least, together = float(best @ best), inflation(best)

    def added(fit: Fit) -> float:
        left = known.left(fit)
        return max(float(left @ left) - least, 0.0) / together

    return added


def accused(known: Witness, members: Sequence[Member]) -> Member | None:
    """Return the load cell effect that explains most of the disagreement.

    Args:
        known: the balance of the body.
        members: effects in the shapes to try.

    Returns:
        The effect in its best shape; None if none explains enough.
    """
    free = Fit((), (), 0.0, 0)
    plain = known.left(free)
    found: list[tuple[float, int, Floats]] = []
    for i, member in enumerate(members):
        if not member.effect.sensor:
            continue
        columns = member.effect.columns(known.ctx, member.trial)
        left = known.beside(columns)
        costs = penalty(float(np.log(max(plain.size, 2))), len(columns) + len(member.trial.theta))
        found.append((float(left @ left) + costs * inflation(left), i, left))
    if not found:
        return None
    worth, i, _ = min(found, key=lambda f: f[0])
    return members[i] if worth < float(plain @ plain) else None
