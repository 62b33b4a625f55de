"""Effects of the load cell and its amplifier, which the specimen does not feel."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import mains, noise_level, spectral
from rthyb_rt.diagnose.effects.base import Context, Effect, Floats, Param, Trial
from rthyb_rt.diagnose.effects.friction import Viscous
from rthyb_rt.diagnose.policy import POLICY

SKEW_TOLERANCE_S = 1e-4


def shifted(signal: Floats, rows: float) -> Floats:
    """Return a signal delayed by a possibly fractional number of rows, by a cubic through four."""
    whole = int(np.floor(rows))
    u = rows - whole
    at = np.arange(signal.size) - whole

    def take(k: int) -> Floats:
        return signal[np.clip(at + k, 0, signal.size - 1)]

    return (
        take(-2) * (u * (u * u - 1.0) / 6.0)
        + take(-1) * (u * (1.0 + u) * (2.0 - u) / 2.0)
        + take(0) * ((1.0 - u) * (1.0 + u) * (2.0 - u) / 2.0)
        + take(1) * (-u * (1.0 - u) * (2.0 - u) / 6.0)
    )


def standing_out(force: Floats, noise: float, dt: float) -> Floats:
    """Return a force up to twice the frequency up to which it is above white noise, (n,), N.

    In a closed loop the load cell's noise moves the specimen a moment later. That motion is far
    below the noise, but a force shifted ahead of the displacement would correlate with it.

    Args:
        force: (n,), N.
        noise: standard deviation of the load cell, N.
        dt: sampling period, s.
    """
    cut = _loudest_hz(force, noise, dt)
    return force if cut is None else _up_to(cut, force, dt)


def _loudest_hz(force: Floats, noise: float, dt: float) -> float | None:
    """Return twice the frequency up to which a force is above white noise; None: nowhere."""
    spectrum, f, size = _faded(force, dt)
    hertz = np.floor(f).astype(np.int64)
    power = np.bincount(hertz, np.abs(spectrum) ** 2) / np.bincount(hertz)
    above = np.flatnonzero(power > POLICY.faint_force**2 * noise**2 * size)
    return 2.0 * (float(above[-1]) + 1.0) if above.size else None


def _up_to(cut_hz: float, force: Floats, dt: float) -> Floats:
    size = spectral.fast_length(force.size + 2 * _fade(force, dt))
    spectrum, f, _ = _faded(force, dt, size)
    pad = _fade(force, dt)
    low = np.fft.irfft(spectrum / (1.0 + (f / cut_hz) ** 8), size)
    return np.asarray(low[pad : pad + force.size])


def _fade(force: Floats, dt: float) -> int:
    return min(int(1.0 / dt), force.size - 1)


def _faded(force: Floats, dt: float, size: int = 0) -> tuple[NDArray[np.complex128], Floats, int]:
    """Return a spectrum with both ends faded, its frequencies, and the number of rows.

    ``size``: number of rows, zero-padded; 0: as many as there are with the fading.
    """
    pad = _fade(force, dt)
    fade = np.sin(0.5 * np.pi * np.arange(pad) / max(pad, 1)) ** 2
    window = np.concatenate((fade, np.ones(force.size), fade[::-1]))
    size = size or window.size
    faded = window * np.pad(force, pad, mode="reflect", reflect_type="odd")
    return np.asarray(np.fft.rfft(faded, size)), np.asarray(np.fft.rfftfreq(size, dt)), size


def _part(some: Floats, whole: Floats) -> float:
    return float(np.std(some)) / (float(np.std(whole)) or 1.0)


class Bias(Effect):
    """A load cell with a force reading at rest."""

    name = "bias"
    plain = "an offset of the load cell"
    phrase = "an offset of the load cell of {bias_N:+}"
    params = (Param("bias_N", "N", -1e8, 1e8),)
    equation = "f_meas = f + bias"
    fingerprint = "residual is a constant"
    static = True
    zero = True
    on_body = ("forced", "ground")
    over = "t"
    shown_by = ("multi_amplitude", "a constant remains as the amplitude goes to zero")
    sensor = True

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return 1."""
        return [np.ones_like(ctx.t)]


class Drift(Effect):
    """A load cell with drift."""

    name = "drift"
    plain = "a drift of the load cell"
    phrase = "a drift of the load cell of {rate_N_s:+}"
    params = (Param("rate_N_s", "N/s", -1e8, 1e8),)
    equation = "f_meas = f + rate t"
    fingerprint = "residual is linear in time"
    static = True
    wanders = True
    on_body = ("forced",)
    over = "t"
    shown_by = ("multi_amplitude", "a drift continues when nothing moves")
    sensor = True

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return time since the start."""
        return [ctx.t - ctx.t[0]]

    def begun(self, ctx: Context, columns: list[Floats], t0: float) -> list[Floats]:
        """Return time since the onset, from zero."""
        return [np.maximum(ctx.t - t0, 0.0)]


class Hum(Effect):
    """Hum of the mains or of a pump in the load cell's signal."""

    name = "hum"
    plain = "hum in the load cell"
    phrase = "hum of {amp_N} at {f_Hz} in the load cell"
    params = (Param("f_Hz", "Hz", 0.1, 1e4), Param("amp_N", "N", 0.0, 1e8))
    equation = "f_meas = f + amp sin(2 pi f t + phase)"
    fingerprint = "a single line in the spectrum of the residual that is not in the motion"
    foretold = False
    shown_by = ("sweep", "the line keeps its frequency while that of the motion changes")
    sensor = line = True
    signs = "**"

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return the strongest lines that the model does not explain, away from the motion."""
        lines = mains.lines_hz(ctx.force - ctx.total, ctx.total, ctx.dt)
        return [Trial((f_hz,)) for f_hz in lines]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Keep the line within one bin of its initial frequency."""
        f = trial.theta[0]
        width = 1.0 / (ctx.t[-1] - ctx.t[0])
        return [(max(f - width, 1e-3), f + width)]

    def steps(self, ctx: Context, trial: Trial) -> list[float]:
        """Return a change by which the phase is 0.02 rad off at the end: it must remain linear."""
        return [0.02 / (2.0 * np.pi * trial.theta[0] * float(ctx.t[-1] - ctx.t[0]))]

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Count frequency, amplitude and phase."""
        return ("**", (None, None)), 3

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return sine and cosine."""
        phase = 2.0 * np.pi * trial.theta[0] * ctx.t
        return [np.sin(phase), np.cos(phase)]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return frequency and amplitude."""
        return {"f_Hz": trial.theta[0], "amp_N": float(np.hypot(beta[0], beta[1]))}


FORCES = 128
"""Number of forces whose slow part is cached."""


class _Audible:
    """The part of a closed loop's forces that is above the noise that moves the specimen.

    A search shifts the same few forces again and again.
    """

    def __init__(self, ctx: Context) -> None:
        assert ctx.model.f_std is not None
        self.ctx = ctx
        self.cut = _loudest_hz(ctx.total, ctx.model.f_std, ctx.dt)
        self.noisy = 0.0
        if self.cut is not None:
            audible = _up_to(self.cut, ctx.total, ctx.dt)
            self.noisy = _part(ctx.total - audible, ctx.total)
        self.known: OrderedDict[bytes, Floats | None] = OrderedDict()

    def slow(self, force: Floats) -> Floats:
        """Return the part of a force, (n,), N, that is shifted."""
        if self.cut is None:
            return force
        key = force.tobytes()
        if key not in self.known:
            slow = _up_to(self.cut, force, self.ctx.dt)
            # A change more abrupt than this noise belongs to the law itself.
            abrupt = _part(force - slow, force) > POLICY.abrupt_force * self.noisy
            self.known[key] = None if abrupt else slow
            if len(self.known) > FORCES:
                self.known.popitem(last=False)
        found = self.known[key]
        return force if found is None else found


class TimeSkew(Effect):
    """A time offset between the load cell's rows and those of the displacement.

    It applies to the forces of all effects on the specimen as well as to the model's.
    """

    name = "time_skew"
    plain = "a time skew of the load cell"
    phrase = "a load cell that is {skew_s} {skew_s:early|late}"
    params = (Param("skew_s", "s", -0.1, 0.1),)
    equation = "f_meas(t) = f(t - skew)"
    fingerprint = "residual is linear in the rate of the force"
    slow_as = Viscous.name
    over = "rate"
    shown_by = ("sweep", "a time skew changes the phase over frequency differently from a dashpot")
    sensor = True
    carries = True
    signs = "+"
    pinned = (0.02,)
    _kept: _Audible | None = None
    _late: tuple[Context, float, Context] | None = None

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return skews in both directions."""
        steps = np.array([0.15, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0, 6.0, 9.0, 13.0, 20.0]) * 1e-3
        skews = [float(sign * s) for s in steps for sign in (1.0, -1.0)]
        return [Trial((s,)) for s in skews if s > -self._most_early(ctx)]

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """In a closed loop, limit the lead of the cell to the time in which its noise returns."""
        (low, high), early = super().limits(ctx, trial)[0], self._most_early(ctx)
        return [(low, high if trial.theta[0] > 0.0 else max(min(high, early), low))]

    @staticmethod
    def _most_early(ctx: Context) -> float:
        """Return the largest lead of the cell over the displacement, s.

        The reading with its noise moves the specimen of a closed loop one row and the actuator's
        delay
        later: with a lead of this size, the reading matches the motion regardless of a real lead.
        """
        lag = ctx.model.actuator
        return lag.delay_s + ctx.dt if ctx.model.family == "loop" and lag else np.inf

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return a coefficient that is fixed at 1."""
        return ("+", (0.02,)), 1

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the shifted force less the force."""
        return [self.reading(ctx, trial, lambda along: [along.total])[0] - ctx.total]

    def reading(
        self, ctx: Context, trial: Trial, forces: Callable[[Context], list[Floats]]
    ) -> list[Floats]:
        """Return delayed forces: along the delayed motion where it is known between the rows.

        In a closed loop, not for a cell that is early: the noise of a reading returns in the motion
        only later, so that all of the force may be shifted back, and only a part of it ahead.
        """
        between = ctx.motion.between
        if between is None or (ctx.model.family == "loop" and trial.theta[0] < 0.0):
            return super().reading(ctx, trial, forces)
        whole, share = divmod(trial.theta[0] / ctx.dt, 1.0)
        kept = self._late
        if kept is None or kept[0] is not ctx or kept[1] != share:
            self._late = kept = (ctx, share, ctx.late(between(share), share * ctx.dt))
        return [shifted(force, whole) for force in forces(kept[2])]

    def carried(self, ctx: Context, trial: Trial, force: Floats) -> Floats:
        """Return a force delayed by a cubic; in a closed loop the part above the fed-back noise."""
        slow = force
        if ctx.model.family == "loop" and ctx.model.f_std:
            kept = self._kept
            if kept is None or kept.ctx is not ctx:
                self._kept = kept = _Audible(ctx)
            slow = kept.slow(force)
        return force + shifted(slow, trial.theta[0] / ctx.dt) - slow

    def offset_s(self, trial: Trial) -> float:
        """Return the skew, s."""
        return trial.theta[0]

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the skew."""
        return {"skew_s": trial.theta[0] * float(beta[0])}


BAND = 0.8
"""Fraction of a signal's power that lies below the upper end of its band."""
BEYOND = (8.0, 16.0)
"""Multiples of that frequency between which a force with a band contains only sensor noise."""


def _expected(ctx: Context) -> Floats:
    """Return the expected orthogonal force given its noisy reading, (n,), N.

    Noise in a regressor biases its coefficient towards zero and enters the residual. Replacing it
    by its expected value (Wiener's, in the band in which the reading is above its noise) avoids
    both: regression calibration, Carroll, Ruppert, Stefanski and Crainiceanu, Measurement Error in
    Nonlinear Models (2006), chapter 4.
    """
    reading = ctx.other["fy_meas"]
    return spectral.quiet(reading, 1.0 / ctx.dt, _noise(reading, ctx.dt))


def _noise(signal: Floats, dt: float) -> float:
    """Return the standard deviation of white noise at the level that a signal has near its band.

    If the noise is higher there than at the top of the spectrum, that level is used.
    """
    white = noise_level.white_noise(signal)
    power = np.abs(np.fft.rfft((signal - signal.mean()) * np.hanning(signal.size))) ** 2
    share = np.cumsum(power) / (float(power.sum()) or 1.0)
    f = np.fft.rfftfreq(signal.size, dt)
    end = f[np.searchsorted(share, BAND)]
    beside = power[(f > BEYOND[0] * end) & (f < BEYOND[1] * end)]
    if BEYOND[1] * end > f[-1] or not beside.size:
        return white
    # A Hann window reduces the power of white noise to three eighths.
    return max(white, float(np.sqrt(np.mean(beside) / (0.375 * signal.size))))


class Crosstalk(Effect):
    """A load cell that responds to force in the orthogonal direction."""

    name = "crosstalk"
    plain = "crosstalk from the other direction"
    phrase = "{ratio:%} of the orthogonal force in the load cell"
    params = (Param("ratio", "", -1.0, 1.0),)
    equation = "f_meas = f + ratio fy"
    fingerprint = "residual follows the orthogonal force"
    needs = "fy_meas"
    over = "fy"
    shown_by = ("random", "an orthogonal force that is independent of this one separates them")
    sensor = True
    _kept: tuple[Context, Floats] | None = None

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return one trial if the orthogonal force was recorded."""
        return [Trial()] if "fy_meas" in ctx.other else []

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the orthogonal force."""
        kept = self._kept
        if kept is None or kept[0] is not ctx:
            self._kept = kept = (ctx, _expected(ctx))
        return [kept[1]]


class Quantisation(Effect):
    """A coarse load cell. Determined from its readings directly, so it is not part of a search."""

    name = "quantisation"
    plain = "a load cell with coarse resolution"
    phrase = "a load cell that reads in steps of {lsb_N}"
    params = (Param("lsb_N", "N", 0.0, 1e8),)
    equation = "f_meas = lsb round(f / lsb)"
    fingerprint = "all readings lie on one grid; the residual is a sawtooth of half a step"
    shown_by = ("multi_amplitude", "small motion shows the individual steps")
    sensor = True


QUANTISATION = Quantisation()
EFFECTS: tuple[Effect, ...] = (Bias(), Drift(), Hum(), TimeSkew(), Crosstalk())
