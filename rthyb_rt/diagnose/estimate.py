"""The motion behind a recording, and its accuracy.

If a command and an actuator model reproduce the measured displacement, the simulated motion, which
is free of noise, is used. Otherwise displacement, accelerometer and load cell are combined in the
frequency domain, each weighted by its noise (a Wiener smoother); the remaining error, multiplied by
the specimen's impedance, gives the noise of the force residual, which need not be white.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import coarse, mains, noise
from rthyb_rt.diagnose.case import Case, Floats, Model
from rthyb_rt.diagnose.moving import gain2, sensor_colour
from rthyb_rt.diagnose.policy import POLICY

Complex = NDArray[np.complex128]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]
Denoiser = Callable[[Floats], Floats]
"""Removes white noise from a signal of shape (n,) outside the signal's band; `Whitener` whitens
coloured noise."""
SHIFT_S = 0.025
GAP_S = 0.4
"""Time after which a gap in the command no longer affects a simulated motion."""
EDGE_S = 0.5
"""Time at either end that is not evaluated, because the smoother has only half its data there."""
MOVING_EDGE_S = 1.5
"""The same if a recording begins or ends in full motion."""
TURN_ROWS = 20
"""Rows at either end of a quasi-static recording in which a reversal would not be detected."""


def white_noise(signal: Floats) -> float:
    """Return the standard deviation of a signal's white noise from its fourth differences."""
    fourth = np.diff(signal, 4)
    fourth = fourth[np.isfinite(fourth)]
    if fourth.size < 16:
        # If a channel is sampled less often than the others, its own rows are used.
        good = signal[np.isfinite(signal)]
        if good.size < 16:
            return float("nan")
        fourth = np.diff(good, 4)
    return float(1.4826 * np.median(np.abs(fourth - np.median(fourth))) / np.sqrt(70.0))


def noise_of(signal: Floats | None, sheet: float | None) -> float:
    """Return the noise of a channel: as measured, limited by the data sheet."""
    found = white_noise(signal) if signal is not None else float("nan")
    if sheet is None or not sheet > 0.0:
        scale = float(np.nanstd(signal)) if signal is not None else 1.0
        return found if found > 0.0 else 1e-6 * (scale or 1.0)
    if not np.isfinite(found):
        return sheet
    return float(np.clip(found, sheet / POLICY.noise_held, sheet * POLICY.noise_held))


def step_of(f_meas: Floats | None, f_std: float | None) -> float:
    """Return the step of a coarse load cell, N: few distinct readings, all on one grid; else 0."""
    if f_meas is None or f_std is None:
        return 0.0
    good = np.isfinite(f_meas)
    values = np.unique(f_meas[good])
    if values.size < 3 or values.size > POLICY.coarse_readings * good.sum():
        return 0.0
    steps = np.diff(values)
    lsb = float(np.median(steps[steps < 1.5 * steps.min()]))
    at = values / lsb
    mean = np.mean(np.exp(2j * np.pi * at))
    away = np.abs(np.exp(2j * np.pi * at) - mean / (abs(mean) or 1.0))
    return (
        lsb if lsb >= f_std and np.mean(away < POLICY.coarse_near) >= POLICY.coarse_on_grid else 0.0
    )


def force_noise(f_meas: Floats | None, f_std: float | None) -> float:
    """Return the standard deviation of a load cell's noise including its quantisation, N."""
    step = step_of(f_meas, f_std)
    if step > 0.0 and f_std is not None:
        return float(np.hypot(f_std, step / np.sqrt(12.0)))
    return noise_of(f_meas, f_std)


def force_sheet(f_meas: Floats | None, f_std: float | None) -> float | None:
    """Return the noise in a data sheet including the load cell's quantisation, N."""
    if not f_std:
        return None
    return float(np.hypot(f_std, step_of(f_meas, f_std) / np.sqrt(12.0)))


def filled(signal: Floats) -> Floats:
    """Return a signal with its gaps filled by a straight line, or by a cubic if short."""
    good = np.isfinite(signal)
    if good.all():
        return signal
    rows = np.arange(signal.size)
    out = np.interp(rows, rows[good], signal[good])
    short = _within_short_gaps(signal)
    if short.any() and good.sum() >= 4:
        out[short] = _cubic(rows[good], signal[good], rows[short])
    return out


def filled_if_short(signal: Floats) -> Floats:
    """Return a signal with its short gaps filled by a cubic, and the others unchanged."""
    return np.where(_within_short_gaps(signal), filled(signal), signal)


def _gaps(signal: Floats) -> Iterable[tuple[int, int]]:
    """Yield the first row of each gap and the first row after it."""
    lost = ~np.isfinite(signal)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], lost.astype(np.int8), [0]))))
    return zip(map(int, edges[::2]), map(int, edges[1::2]), strict=True)


def long_gaps(signal: Floats) -> list[tuple[int, int]]:
    """Return first row and first row after it of each gap that is not filled by a cubic."""
    return [(a, b) for a, b in _gaps(signal) if b - a > POLICY.short_gap]


def _within_short_gaps(signal: Floats) -> Mask:
    out = np.zeros(signal.size, dtype=np.bool_)
    for a, b in _gaps(signal):
        if b - a <= POLICY.short_gap and a > 0 and b < signal.size:
            out[a:b] = True
    return out


def _cubic(at: Rows, y: Floats, wanted: Rows) -> Floats:
    """Return values between rows by the cubic through the two neighbours on either side."""
    right = np.clip(np.searchsorted(at, wanted), 2, at.size - 2)
    index = right[:, None] + np.array([-2, -1, 0, 1])
    x, f = at[index].astype(np.float64), y[index]
    out = np.zeros(wanted.size)
    for i in range(4):
        term = f[:, i].copy()
        for j in range(4):
            if i != j:
                term *= (wanted - x[:, j]) / (x[:, i] - x[:, j])
        out += term
    return out


@dataclass(frozen=True)
class Blur:
    """The contribution of the estimated motion to the noise of a force.

    Attributes:
        power: its power at each frequency of the transform, N^2 per row, (m,).
        accuracy: part of it that is the limited accuracy of a model near resonance, N^2 per row.
        band: weight of each frequency in the evaluation, 0 to 1, (m,).
        seen: fraction of the motion above its noise, 0 to 1; 1 at a hum of the load cell, (m,).
        sigma_n: standard deviation of the force channel's own noise where it is white, N.
        omega: those frequencies, rad/s, (m,).
        error: a possible error of the estimated motion, drawn from it, each (n,).
        direct: what that error does to the model's force, (n,), N.
        more: what a set of effects adds to the power, N^2 per row, (m,).
    """

    power: Floats
    accuracy: float
    band: Floats
    seen: Floats
    sigma_n: float
    omega: Floats
    error: ComputedMotion
    direct: Floats
    more: Floats | float = 0.0

    @property
    def rms(self) -> float:
        """Standard deviation of the contribution to a force, N, without the model's accuracy."""
        return float(np.sqrt(np.mean(np.maximum(self.power - self.accuracy + self.more, 0.0))))

    def behind(self, changes: Iterable[Floats], fs_hz: float) -> list[Blur]:
        """Return the contribution for each of some sets of effects that are added to the model.

        A missing mass that is as large as the stated one doubles what an error of the acceleration
        does to the force.

        Args:
            changes: by how much the force of each set changes with the error, (n,), N.
            fs_hz: rows per second.
        """
        if not self.direct.any():
            return [self for _ in changes]
        before = gain2(self.error.x, self.direct, fs_hz, self.omega)
        return [self._behind(change, before, fs_hz) for change in changes]

    def _behind(self, change: Floats, before: Floats, fs_hz: float) -> Blur:
        if not np.isfinite(change).all():
            return self
        # Of a law that diverges it is not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            now = gain2(self.error.x, self.direct + change, fs_hz, self.omega)
            through = self.power - self.accuracy
            more = through * (now / np.maximum(before, 1e-300) - 1.0)
        # Less than the scatter of the noise itself cannot be seen.
        whole = self.sigma_n**2 + self.power
        visible = np.abs(more) * self.band**2 > np.sqrt(2.0 / change.size) * whole
        return replace(self, more=more) if np.isfinite(more).all() and visible.any() else self


@dataclass(frozen=True)
class Estimate:
    """A motion and the specimen's force along it.

    Attributes:
        motion: x, v, a, each (n,).
        force: the force that a specimen model must reproduce, (n,), N.
        rows: rows to evaluate, (n,).
        whiten: whitens the noise of a force residual to unit variance; linear.
        sigma_n: standard deviation of the force residual's noise where it is white, N; of a coarse
            load cell without its rounding, but with the contribution of an estimated motion.
        share: fraction of the band that is evaluated: the variance of a row of whitened noise.
        exact: whether the motion is simulated and therefore free of noise.
        pieces: whitens pieces of a long residual only, from their first rows (m,) and their
            length, to (m, length); None if whitening uses no other rows.
        scatter: relative standard deviation of the noise's rms over such a recording, if it was
            determined together with a set of effects; 0: the noise is as assumed beforehand.
        blur: contribution of the estimated motion; None if unknown, or the motion is exact.
        begins: first row at which the motion and its history are known, see `begun`.
        read: rows with a reading of a coarse load cell that is evaluated only where it changes its
            reading, see `coarse`; None: of any other one.
        step_n: the step of its readings, N.
    """

    motion: ComputedMotion
    force: Floats
    rows: NDArray[np.bool_]
    whiten: Callable[[Floats], Floats]
    sigma_n: float
    exact: bool
    share: float = 1.0
    pieces: Callable[[Floats, Rows, int], Floats] | None = None
    scatter: float = 0.0
    blur: Blur | None = None
    begins: int = 0
    read: NDArray[np.bool_] | None = None
    step_n: float = 0.0

    @property
    def coloured(self) -> bool:
        """Whether the noise was determined together with a set of effects."""
        return self.scatter > 0.0

    def begun(self, signal: Floats, fs_hz: float) -> Floats:
        """Return a force, (n,), N, faded out before the first row that is known.

        A motion that is simulated from a command in mid-course begins with a jump from rest. A
        filter for coloured noise has a memory of seconds: without this, the jump would also be in
        the rows that are evaluated, differently for each law.
        """
        if self.begins == 0:
            return signal
        reach = min(int(noise.FADE_S * fs_hz), self.begins)
        weight = np.ones(signal.size)
        weight[: self.begins] = 0.0
        weight[self.begins - reach : self.begins] = _smooth(np.arange(reach) / reach)
        return weight * signal

    def beginning(self, first: int, fs_hz: float) -> Estimate:
        """Return the estimate evaluated, and known, from a row on only."""
        after, read = np.arange(self.rows.size) >= first, self.read
        later = replace(self, begins=max(first, self.begins), rows=self.rows & after)
        later = replace(later, read=None if read is None else read & after)
        return later.whitened(self.whiten, self.pieces, fs_hz) if first else later

    def whitened(
        self,
        whiten: Callable[[Floats], Floats],
        pieces: Callable[[Floats, Rows, int], Floats] | None,
        fs_hz: float,
    ) -> Estimate:
        """Return the estimate with another filter for its noise, which sees known rows only."""

        def of_pieces(signal: Floats, first: Rows, length: int) -> Floats:
            assert pieces is not None
            return pieces(self.begun(signal, fs_hz), first, length)

        return replace(
            self,
            whiten=lambda signal: whiten(self.begun(signal, fs_hz)),
            pieces=None if pieces is None else of_pieces,
        )


def _smooth(ramp: Floats) -> Floats:
    """Return a transition from 0 to 1 that is smooth up to its third derivative."""
    return np.asarray(ramp**4 * (35.0 - 84.0 * ramp + 70.0 * ramp**2 - 20.0 * ramp**3))


def _extended(signal: Floats, pad: int, odd: bool) -> Floats:
    head, tail = signal[pad:0:-1], signal[-2 : -pad - 2 : -1]
    if odd:
        head, tail = 2.0 * signal[0] - head, 2.0 * signal[-1] - tail
    out = np.concatenate((head, signal, tail))
    # The extension is periodic in the transform: both ends approach zero smoothly.
    smooth = _smooth(np.clip(np.arange(pad) / max(0.75 * pad, 1.0), 0.0, 1.0))
    out[:pad] *= smooth
    out[-pad:] *= smooth[::-1]
    return out


def _smooth_spectrum(power: Floats, width: int) -> Floats:
    kernel = np.hanning(2 * width + 3)[1:-1]
    kernel /= kernel.sum()
    return np.convolve(np.pad(power, width, mode="reflect"), kernel, mode="valid")


def _above_noise(spectrum: Complex, rows: int, noise_power: Floats | float) -> Floats:
    """Return the power of a signal above its noise, else 0."""
    power = _smooth_spectrum(np.abs(spectrum) ** 2 / rows, 12)
    return np.where(power > POLICY.motion_clear * noise_power, power - noise_power, 0.0)


def _envelope(power: Floats, omega: Floats, fall: int = 6) -> Floats:
    """Return the smallest power above a given one that never rises and falls at most like w^-fall.

    A sharper cut-off would ring: an end of the recording would have effects seconds away.
    """
    steep = omega**fall
    falling = np.maximum.accumulate(power * steep)
    falling /= np.maximum(steep, steep[1] if steep.size > 1 else 1.0)
    standing = np.maximum.accumulate(power[::-1])[::-1]
    return np.asarray(np.maximum(falling, standing))


def _smooth_number(value: int) -> bool:
    for factor in (2, 3, 5, 7):
        while value % factor == 0:
            value //= factor
    return value == 1


def fast_length(least: int) -> int:
    """Return the next length with small prime factors, whose transform is fast."""
    while not _smooth_number(least):
        least += 1
    return least


@dataclass(frozen=True)
class _Spectral:
    pad: int
    n: int
    omega: Floats

    @classmethod
    def of(cls, n: int, fs_hz: float) -> _Spectral:
        pad = int(min(n - 2, max(4.0 * fs_hz, 64)))
        # A length with small prime factors: other transforms take ten times as long.
        while pad > 64 and not _smooth_number(n + 2 * pad):
            pad -= 1
        f_hz = np.asarray(np.fft.rfftfreq(n + 2 * pad, 1.0 / fs_hz), dtype=np.float64)
        return cls(pad, n, 2.0 * np.pi * f_hz)

    def forward(self, signal: Floats, odd: bool = False) -> Complex:
        return np.fft.rfft(_extended(signal, self.pad, odd))

    def back(self, spectrum: Complex) -> Floats:
        return np.fft.irfft(spectrum, self.n + 2 * self.pad)[self.pad : self.pad + self.n]


@dataclass(frozen=True)
class _Knowledge:
    """Accuracy of a displacement at each frequency: variance as estimated and as measured, m^2 per
    row, and the fraction of the signal above the noise, 0 to 1."""

    variance: Floats
    measured: Floats
    seen: Floats


@dataclass(frozen=True)
class Sensor:
    """A channel of a motion, (n,); its noise: standard deviation if white, and colour.

    Also which of its rows are not part of a long gap, (n,); None: all.
    """

    signal: Floats
    sigma: float
    colour: noise.Colour | None = None
    known: NDArray[np.bool_] | None = None

    def power(self, omega: Floats) -> Floats:
        """Return the power of its noise at frequencies in rad/s, in its unit squared per row."""
        level = np.ones(omega.size) if self.colour is None else self.colour.at(omega / (2 * np.pi))
        return self.sigma**2 * level


def smoothed(
    case: Case, accelerations: list[Sensor], colour: noise.Colour | None = None
) -> tuple[ComputedMotion, _Knowledge, _Spectral]:
    """Combine displacement and accelerations, each with its noise, into one motion.

    Args:
        case: the recording.
        accelerations: of the specimen.
        colour: of the displacement's noise.

    Returns the motion, its accuracy at each frequency, and the frequencies.
    """
    x_meas = case.channels["x_meas"]
    place = Sensor(filled(x_meas), noise_of(x_meas, case.model.x_std), colour)
    s = _Spectral.of(place.signal.size, case.fs_hz)
    rows = place.signal.size + 2 * s.pad
    # A straight line between the ends has no frequency content in the transform.
    spectrum = s.forward(place.signal, odd=True)
    w2 = s.omega**2
    own = place.power(s.omega)
    information = 1.0 / own
    joined = spectrum / own
    prior = _above_noise(spectrum, rows, own)
    band = s.omega > 2 * np.pi * POLICY.accelerometer_from_hz
    safe = np.where(band, w2, 1.0)
    for sensor in accelerations:
        other, level = s.forward(filled(sensor.signal), odd=True), sensor.power(s.omega)
        prior = np.maximum(prior, np.where(band, _above_noise(other, rows, level) / safe**2, 0.0))
        joined = joined + np.where(band, -w2 * other / level, 0.0)
        information = information + np.where(band, w2**2 / level, 0.0)
    # Where any motion was detected at all, for weighting residuals.
    seen = np.maximum.accumulate(prior[::-1])[::-1]
    seen = seen / (seen + 4.0 / information)
    # Noise beyond the motion is amplified by each derivative: a law that filters it, such as
    # relaxation in an early load cell, would be likelier than a dashpot.
    prior = _envelope(prior, s.omega, 8)
    variance = 1.0 / (information + 1.0 / np.maximum(prior, 1e-12 * place.sigma**2))
    best = joined * variance
    x_hat = s.back(best)
    v_hat = s.back(1j * s.omega * best)
    a_hat = s.back(-w2 * best)
    return ComputedMotion(x_hat, v_hat, a_hat), _Knowledge(variance, 1.0 / information, seen), s


def _drawn(s: _Spectral, variance: Floats, size: int) -> ComputedMotion:
    """Return one of the errors that an estimated motion of this variance may have, each (size,)."""
    white = np.random.default_rng(size).standard_normal(size)
    x = np.sqrt(variance) * s.forward(white)
    return ComputedMotion(s.back(x), s.back(1j * s.omega * x), s.back(-(s.omega**2) * x))


def aligned(case: Case, parts: list[Floats], sigma: float) -> Floats:
    """Return the sum of signals that form the acceleration, each aligned with the time of x_meas.

    Channels may be a fraction of a row apart; the offset of each is the one for which their sum
    best equals the second derivative of the displacement.
    """
    x = filled(case.channels["x_meas"])
    s = _Spectral.of(x.size, case.fs_hz)
    w = s.omega
    sigma_x = noise_of(x, case.model.x_std)
    wanted = -(w**2) * s.forward(x, odd=True)
    spectra = [s.forward(part, odd=True) for part in parts]
    gap = np.sum(spectra, axis=0) - wanted
    seen = w > 2 * np.pi * POLICY.motion_from_hz
    weight = np.where(seen, 1.0 / np.sqrt(sigma**2 + w**4 * sigma_x**2), 0.0)
    columns = np.column_stack([-1j * w * c * weight for c in spectra])
    gap = gap * weight
    matrix = np.concatenate((columns.real, columns.imag))
    right = np.concatenate((gap.real, gap.imag))
    late, *_ = np.linalg.lstsq(matrix, right, rcond=None)
    late = np.clip(late, -5e-4, 5e-4)
    return np.asarray(
        np.sum(
            [
                part + tau * np.gradient(part) * case.fs_hz
                for part, tau in zip(parts, late, strict=True)
            ],
            axis=0,
        )
    )


def band_of(signal: Floats, fs_hz: float, sigma: float) -> Denoiser:
    """Return the (Wiener) filter that removes white noise from a signal of shape (n,)."""
    s = _Spectral.of(signal.size, fs_hz)
    spectrum = s.forward(signal, odd=True)
    power = _envelope(_above_noise(spectrum, signal.size + 2 * s.pad, sigma**2), s.omega)
    gain = power / (power + sigma**2)
    return lambda other: s.back(gain * s.forward(other, odd=True))


def quiet(signal: Floats, fs_hz: float, sigma: float) -> Floats:
    """Return a signal without the noise outside its band, (n,)."""
    return band_of(signal, fs_hz, sigma)(signal)


def low_passed(signal: Floats, fs_hz: float, cut_hz: float) -> Floats:
    """Return a signal below a frequency, (n,); an eighth-order roll-off without delay."""
    s = _Spectral.of(signal.size, fs_hz)
    gain = 1.0 / (1.0 + (s.omega / (2.0 * np.pi * cut_hz)) ** 8)
    return s.back(gain * s.forward(signal, odd=True))


def rests(x: Floats, fs_hz: float) -> tuple[bool, bool]:
    """Return whether a motion, (n,), is at rest in its first and in its last tenth of a second."""
    head = max(int(0.1 * fs_hz), 2)
    loud = 0.02 * float(np.max(np.abs(x - np.median(x))))
    first, last = (float(np.max(np.abs(d))) for d in (x[:head] - x[0], x[-head:] - x[-1]))
    return first < loud, last < loud


def _edges(rows: NDArray[np.bool_], fs_hz: float, x: Floats) -> NDArray[np.bool_]:
    out = rows.copy()
    for at, rest in zip((0, -1), rests(x, fs_hz), strict=True):
        cut = int(min((EDGE_S if rest else MOVING_EDGE_S) * fs_hz, rows.size / 12))
        if cut:
            out[slice(None, cut) if at == 0 else slice(-cut, None)] = False
    return out


def _impedance(case: Case, omega: Floats, mass: float) -> Floats:
    m = case.model
    return np.abs(m.k - mass * omega**2 + 1j * m.c * omega)


def _coloured(s: _Spectral, power: Floats, band: Floats) -> Callable[[Floats], Floats]:
    gain = band / np.sqrt(power)

    def whiten(signal: Floats) -> Floats:
        return s.back(gain * s.forward(signal))

    return whiten


MARGIN = 512
"""Number of rows on either side of a piece that are whitened with it: the filter's memory."""


def _in_pieces(
    s: _Spectral, power: Floats, band: Floats, fs_hz: float
) -> Callable[[Floats, Rows, int], Floats]:
    """Return the same filter for pieces of a recording."""
    gain = band / np.sqrt(power)

    def whiten(signal: Floats, first: Rows, length: int) -> Floats:
        size = length + 2 * MARGIN
        rows = first[:, None] - MARGIN + np.arange(size)
        ramp = np.ones(size)
        ramp[: MARGIN // 2] = np.sin(np.linspace(0.0, np.pi / 2, MARGIN // 2)) ** 2
        ramp[-(MARGIN // 2) :] = ramp[: MARGIN // 2][::-1]
        omega = 2.0 * np.pi * np.fft.rfftfreq(size, 1.0 / fs_hz)
        part = np.fft.rfft(ramp * signal[np.clip(rows, 0, signal.size - 1)], axis=1)
        clean = np.fft.irfft(part * np.interp(omega, s.omega, gain), size, axis=1)
        return np.asarray(clean[:, MARGIN:-MARGIN])

    return whiten


@dataclass(frozen=True)
class Whitener:
    """Whitens the noise of a channel to unit variance.

    Attributes:
        whiten: an entire signal, (n,) to (n,); linear.
        pieces: parts of it, see `Estimate`.
        scatter: relative standard deviation of the noise's rms over such a recording.
        share: fraction of the band that is evaluated, see `Estimate`.
    """

    whiten: Callable[[Floats], Floats]
    pieces: Callable[[Floats, Rows, int], Floats]
    scatter: float
    share: float


def likelihood(
    residual: Floats,
    rows: NDArray[np.bool_],
    velocity: Floats,
    fs_hz: float,
    sigma: float,
    sheet: float | None,
    blur: Blur | None = None,
    lines: noise.Lines | None = None,
) -> tuple[float, Whitener | None]:
    """Return -2 ln of the likelihood of a set's residual, for noise with its colour.

    Up to a constant, including the price of the colour's parameters. The noise level is the best
    fit within the data sheet. The filter is None if the noise is white and the motion exact.

    Args:
        residual: residual of a channel, (n,), in its unit.
        rows: which of them count, (n,).
        velocity: of the motion, (n,), m/s.
        fs_hz: rows per second.
        sigma: standard deviation of the noise if white, in the channel's unit.
        sheet: the same according to the data sheet.
        blur: contribution of the estimated motion to that noise, whatever its colour.
        lines: of these rows, if already known.
    """
    stated = sheet / sigma if sheet else 1.0
    lines = lines or noise.Lines(rows, fs_hz)
    power = lines.power(residual / sigma) if sheet else None
    colours = (
        noise.colour_of(lines, power, velocity, sheet and stated),
        noise.red_of(lines, power, sheet and stated),
    )
    found = [_in_colour(c, residual, rows, fs_hz, sigma, blur) for c in colours if c is not None]
    # If its colour can be seen beside the motion, it is not white.
    if colours[0] is None:
        found.append(
            _in_white(residual[rows] / sigma, stated)
            if blur is None
            else _in_colour(None, residual, rows, fs_hz, sigma, blur)
        )
    return min(found, key=lambda f: f[0])


def _in_white(white: Floats, stated: float) -> tuple[float, None]:
    """Return -2 ln of the likelihood for white noise with the best level within the sheet."""
    size = float(np.sqrt(np.mean(white**2)))
    level = float(np.clip(size, stated / POLICY.sheet_factor, stated * POLICY.sheet_factor))
    return float(white @ white) / level**2 + 2.0 * white.size * float(np.log(level)), None


def _in_colour(
    colour: noise.Colour | None,
    residual: Floats,
    rows: NDArray[np.bool_],
    fs_hz: float,
    sigma: float,
    blur: Blur | None,
) -> tuple[float, Whitener | None]:
    """Return the same for noise of one colour and the blur, with its whitening filter."""
    count = int(rows.sum())
    s = _Spectral.of(residual.size, fs_hz)
    power = np.ones(s.omega.size) if colour is None else colour.at(s.omega / (2.0 * np.pi))
    band = np.ones(power.size) if blur is None else blur.band
    if blur is not None:
        power = power + (blur.power + blur.more) / sigma**2
    cost = count * float(np.mean(band**2 * np.log(power)))
    power = sigma**2 * power
    changed = blur is not None and bool(np.any(blur.more))
    scatter = np.sqrt(0.5 / count) if changed else 0.0
    if colour is not None:
        scatter = colour.scatter(count, fs_hz)
    made = Whitener(
        _coloured(s, power, band),
        _in_pieces(s, power, band, fs_hz),
        scatter,
        max(float(np.mean(band**2)), 1e-3),
    )
    own = made.whiten(residual)[rows]
    cost += float(own @ own)
    if colour is None:
        return cost, made
    return cost + colour.count * float(np.log(count)), made


def _in_one_band(blurs: list[Blur]) -> list[Blur]:
    """Return the contributions, weighted alike: where no motion was seen, by the largest of them.

    There a law has only the noise of the sensors to act on, and a set would be preferred for
    passing less of it.
    """
    first = blurs[0]
    most = np.max([b.power + b.more - b.accuracy for b in blurs], axis=0)
    floor = first.sigma_n**2 + first.accuracy
    band = np.maximum(np.minimum(first.band, floor / (floor + most)), first.seen)
    return [replace(b, band=band) for b in blurs]


def likeliest(
    tried: Sequence[tuple[Floats, Floats, float]],
    rows: NDArray[np.bool_],
    fs_hz: float,
    sigma: float,
    sheet: float | None,
    blurs: list[Blur] | None = None,
) -> Whitener | None:
    """Return the filter for the noise of the likeliest of some sets; None: it is as assumed.

    Of those sets whose residual is within the data sheet, if any: slow noise of arbitrary size
    would explain what a drift leaves, at frequencies where no spectral line shows it.

    Args:
        tried: for each set, its residual in a channel, (n,), in its unit; the velocity of its
            motion, (n,), m/s; and its price.
        rows, fs_hz, sigma, sheet: see `likelihood`.
        blurs: for each set, the contribution of the estimated motion; None: the motion is exact.
    """
    lines = noise.Lines(rows, fs_hz)
    behind: Sequence[Blur | None] = _in_one_band(blurs) if blurs else [None] * len(tried)
    candidates: list[tuple[bool, float, Whitener | None]] = []
    for (left, velocity, price), blur in zip(tried, behind, strict=True):
        cost, own = likelihood(left, rows, velocity, fs_hz, sigma, sheet, blur, lines)
        # No data sheet covers the contribution of the estimated motion.
        bounded = bool(sheet) and blur is None
        scatter = own.scatter if own is not None else 0.0
        beyond = bounded and not within_sheet(left[rows], sheet or 0.0, scatter)
        candidates.append((beyond, cost + price, own if scatter > 0.0 else None))
    return min(candidates, key=lambda t: t[:2])[2]


def within_sheet(rest: Floats, sheet: float, scatter: float) -> bool:
    """Return whether a channel's residual, (n,), with its mean, is as small as the sheet permits.

    The rms of one recording of slow noise has a relative ``scatter`` about the data sheet value.
    """
    return float(np.sqrt(np.mean(rest**2))) < POLICY.sheet_factor * sheet * (1.0 + scatter)


def away_from_gaps(
    signal: Floats, fs_hz: float, before_s: float, after_s: float, bridged: bool = False
) -> NDArray[np.bool_]:
    """Return the rows that are not affected by gaps in a signal, (n,).

    If ``bridged``, a short gap, which `filled` interpolates as accurately as its neighbours,
    affects only its own rows.
    """
    out = np.ones(signal.size, dtype=np.bool_)
    for a, b in _gaps(signal):
        before, after = int(before_s * fs_hz), int(after_s * fs_hz)
        if bridged and b - a <= POLICY.short_gap:
            before, after = min(before, b - a), min(after, b - a)
        out[max(0, a - before) : b + after] = False
    return out


def at_its_time(force: Floats, sigma: float, fs_hz: float) -> Mask:
    """Return the rows in which a force is known despite a small time offset, (n,).

    A normal time offset is represented as a straight line over the force's rate, which is a
    difference of rows. At a corner of a stiff drive's command, a mass causes a peak two or three
    rows wide, for which neither is accurate, by many times the noise.

    Args:
        force: the model's force along a motion without noise, (n,), N.
        sigma: standard deviation of the noise of a row, N.
        fs_hz: rows per second.
    """
    late = 2.0 * POLICY.offset_prior_s * fs_hz
    bent = np.zeros(force.size)
    bent[1:-1] = 0.5 * late**2 * np.abs(np.diff(force, 2))
    # The first neglected term of the central difference.
    third = late / 6.0 * np.abs(np.diff(force, 3))
    bent[1:-2] = np.maximum(bent[1:-2], third)
    bent[2:-1] = np.maximum(bent[2:-1], third)
    return np.asarray(bent < POLICY.abrupt_model * sigma)


def along(case: Case, motion: ComputedMotion, exact_from: int) -> Estimate | None:
    """Return the estimate for a simulated motion, evaluated from row ``exact_from`` on."""
    f_meas = case.get("f_meas")
    if f_meas is None:
        return None
    sigma = force_noise(f_meas, case.model.f_std)
    rows = case.rows & np.isfinite(f_meas)
    rows = rows.copy()
    rows[:exact_from] = False
    if "x_cmd" in case.channels:
        rows &= away_from_gaps(case.channels["x_cmd"], case.fs_hz, 0.01, GAP_S)
    # A force shifted in time has no rows beyond the ends.
    ends = int(min(SHIFT_S * case.fs_hz, rows.size / 50))
    if ends:
        rows[:ends] = rows[-ends:] = False
    expected = case.model.force(motion.x, motion.v, motion.a)
    sheet, step = case.model.f_std, step_of(f_meas, case.model.f_std)
    steps = sheet is not None and step > 0.0 and coarse.is_rounded(step, sheet)
    sure = rows & at_its_time(expected, sheet if steps and sheet else sigma, case.fs_hz)
    if sure.sum() > POLICY.abrupt_rows * rows.sum():
        rows = sure
    found = Estimate(
        motion, filled(f_meas), rows, lambda y: y / sigma, sigma, True, begins=exact_from
    )
    return where_it_changes(case, found, expected) or found


def where_it_changes(case: Case, found: Estimate, expected: Floats) -> Estimate | None:
    """Return the estimate evaluated where a coarse load cell changes its reading.

    Args:
        case: recording and model.
        found: the estimate as evaluated in every row.
        expected: the force by the model, (n,), N.

    Returns:
        None if the load cell is not coarse, or changes too rarely or too often.
    """
    f_meas, sheet_n = case.channels["f_meas"], case.model.f_std
    step_n = step_of(f_meas, sheet_n)
    blur_n = found.blur.rms if found.blur is not None else 0.0
    noise_n = float(np.hypot(sheet_n or 0.0, blur_n))
    if case.model.family in ("forced", "ground"):
        # As without steps: near resonance, a small force causes a large motion.
        rms_n = float(np.sqrt(np.mean(found.force[found.rows] ** 2)))
        noise_n = max(noise_n, POLICY.force_accuracy * rms_n)
    if step_n == 0.0 or not coarse.is_rounded(step_n, noise_n):
        return None
    exact = coarse.changes(filled(f_meas), np.isfinite(f_meas), step_n, noise_n, expected)
    changed = int(np.count_nonzero(found.rows & exact.rows))
    often = changed > POLICY.coarse_change * found.rows.sum()
    if often or changed < POLICY.least_rows_force:
        return None
    now = replace(found, sigma_n=noise_n, share=1.0, blur=None, read=found.rows, step_n=step_n)
    return _exact(case, now, exact)


def by_intervals(case: Case, found: Estimate, best: Floats) -> Estimate:
    """Return the estimate of a coarse load cell with its readings as intervals.

    As it is if too few of them are near an end of their step.

    Args:
        case: recording and model.
        found: the estimate as evaluated where the reading changes.
        best: the force by the model with the effects that were found in it, (n,), N.
    """
    f_meas = case.channels["f_meas"]
    exact = coarse.intervals(filled(f_meas), np.isfinite(f_meas), found.step_n, found.sigma_n, best)
    near = _exact(case, replace(found, share=coarse.SHARE), exact)
    return near if near.rows.sum() >= POLICY.least_rows_force else found


def as_read(case: Case, found: Estimate) -> Estimate:
    """Return the estimate of a coarse load cell with its readings in all rows, rounding as noise.

    To be shown; any other estimate as it is.
    """
    if found.read is None:
        return found
    f_meas = case.channels["f_meas"]
    sigma = force_noise(f_meas, case.model.f_std)
    plain = replace(found, force=filled(f_meas), rows=found.read, sigma_n=sigma, read=None)
    return plain.whitened(lambda y: y / sigma, None, case.fs_hz)


def _exact(case: Case, found: Estimate, exact: coarse.Exact) -> Estimate:
    assert found.read is not None
    now = replace(found, force=exact.force, rows=found.read & exact.rows)
    return now.whitened(exact.seen, None, case.fs_hz)


def _in_colour_each(
    case: Case, accelerations: list[Sensor]
) -> tuple[list[Sensor], noise.Colour | None]:
    """Return the accelerations, and the displacement's colour, each with that of its noise."""
    x_meas, model = case.channels["x_meas"], case.model
    forces = ("f_in",) if model.family == "forced" else ("f_meas", "x_cmd")
    beside = [filled(case.channels[n]) for n in forces if n in case.channels]
    x, sigma = filled(x_meas), noise_of(x_meas, model.x_std)
    felt = [a.signal for a in accelerations]
    colour = sensor_colour(
        x, [*felt, *beside], case.fs_hz, sigma, model.x_std, np.isfinite(filled_if_short(x_meas))
    )
    coloured = [
        replace(
            a,
            colour=sensor_colour(a.signal, [x, *beside], case.fs_hz, a.sigma, model.a_std, a.known),
        )
        for a in accelerations
    ]
    return coloured, colour


def from_sensors(case: Case) -> Estimate | None:
    """Return the estimate from displacement, accelerometer and load cell; None without a force."""
    model, channels = case.model, case.channels
    f_meas, a_meas, ag = channels.get("f_meas"), channels.get("a_meas"), channels.get("ag")
    if "x_meas" not in channels:
        return None
    if quasi_static(case):
        return _static(case)
    accelerations: list[Sensor] = []
    ground = model.family == "ground"
    if a_meas is not None:
        # On moving ground an accelerometer also measures the ground.
        parts = [a_meas, -ag] if ground and ag is not None else [a_meas]
        sigma = noise_of(a_meas, model.a_std)
        known_rows = np.all([np.isfinite(filled_if_short(part)) for part in parts], axis=0)
        whole = aligned(case, [filled(part) for part in parts], sigma)
        accelerations.append(Sensor(whole, sigma, known=known_rows))
    accelerations, colour = _in_colour_each(case, accelerations)
    motion, known, s = smoothed(case, accelerations, colour)
    mass = model.moving_mass
    rows = case.rows & away_from_gaps(channels["x_meas"], case.fs_hz, 0.1, 0.1, bridged=True)
    for name in ("a_meas", "ag"):
        if name in channels:
            rows = rows & away_from_gaps(channels[name], case.fs_hz, 0.1, 0.1, bridged=True)
    if model.family == "forced":
        force, sigma = filled(channels["f_in"]), noise_of(channels["f_in"], model.f_std)
        sigma = min(sigma, model.f_std) if model.f_std else sigma
        rows = rows & np.isfinite(channels["f_in"])
    elif f_meas is not None:
        force, sigma = filled(f_meas), force_noise(f_meas, model.f_std)
        rows = rows & np.isfinite(f_meas)
    elif ground and ag is not None:
        force = -model.mass * (motion.a + filled(ag))
        mass += model.mass
        sigma = 1e-4 * float(np.std(force))
        rows = rows & np.isfinite(ag)
    else:
        return None
    channel = sigma
    if model.family in ("forced", "ground"):
        # Near resonance a small force causes a large motion: accuracy is limited to some per
        # thousand.
        sigma = max(sigma, POLICY.force_accuracy * float(np.sqrt(np.mean(force[rows] ** 2))))
    measured = model.family == "forced" or f_meas is not None
    z2 = _impedance(case, s.omega, mass) ** 2
    power = sigma**2 + z2 * known.variance
    # If displacement is only noise, so are force laws evaluated on it: no band to evaluate.
    seen = known.seen
    if f_meas is not None:
        # The load cell itself may hum elsewhere.
        moved = model.force(motion.x, motion.v, motion.a)
        line_hz = mains.hum_hz(force - moved, moved, case.dt)
        if line_hz is not None:
            seen = np.maximum(seen, mains.window(s.omega / (2.0 * np.pi), line_hz))
    band = np.maximum(sigma**2 / (sigma**2 + z2 * known.measured), seen)
    rows = _edges(rows, case.fs_hz, filled(channels["x_meas"]))
    share = float(np.mean(band**2))
    error = _drawn(s, known.variance, force.size)
    return Estimate(
        motion, force, rows, _coloured(s, power, band), sigma, False, max(share, 1e-3),
        _in_pieces(s, power, band, case.fs_hz),
        blur=Blur(
            power - channel**2, sigma**2 - channel**2, band, seen, channel, s.omega, error,
            model.k * error.x + model.c * error.v + mass * error.a,
        ) if measured else None,
    )  # fmt: skip


def quasi_static(case: Case) -> bool:
    """Return whether time is nominal: the model has no rate, and rows are too far apart for one."""
    return nominal_time(case.model)


def nominal_time(model: Model) -> bool:
    """Return whether recordings for a model have a nominal time, see `quasi_static`."""
    rateless = model.family == "drive" and model.c == 0 and model.moving_mass == 0
    return rateless and model.fs_hz <= POLICY.static_hz


def _rate(x: Floats, fs_hz: float, span: int = 34) -> Floats:
    """Return the rate of a noisy ramp, (n,): the slope of the straightest stretch at each row."""
    span = min(span, x.size - 1)
    at = np.arange(span + 1.0) - span / 2.0
    parts = np.lib.stride_tricks.sliding_window_view(x, span + 1)
    slope = parts @ at / float(at @ at)
    rest = parts - parts.mean(axis=1)[:, None] - slope[:, None] * at
    bent = np.sum(rest**2, axis=1)
    first = np.arange(x.size)[:, None] - np.array([span, span // 2, 0])
    first = np.clip(first, 0, slope.size - 1)
    best = np.argmin(bent[first], axis=1)
    return np.asarray(slope[first[np.arange(x.size), best]] * fs_hz)


def _legs(x: Floats, v: Floats, fs_hz: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return a rate that is constant along each straight stroke, and where that holds.

    A noisy rate would favour the laws that are least sensitive to it.
    """
    sigma = white_noise(x)
    out, straight = v.copy(), np.zeros(x.size, dtype=np.bool_)
    turns = np.flatnonzero(np.diff(np.sign(v)) != 0)
    for first, last in pairwise([0, *(turns + 1), x.size]):
        # The reversal is somewhere near the change of sign; near an end it is not detected.
        part = x[first + (5 if first else TURN_ROWS) : last - (5 if last < x.size else TURN_ROWS)]
        if part.size < 24:
            continue
        at = np.arange(part.size) - 0.5 * (part.size - 1)
        slope = float(part @ at / (at @ at))
        rest = part - part.mean() - slope * at
        # Straight: deviations no larger than noise, neither overall nor over a third of it.
        thirds = [float(np.mean(p)) for p in np.array_split(rest, 3)]
        bent = POLICY.stroke_bent * sigma * np.sqrt(3.0 / part.size)
        if np.std(rest) < POLICY.stroke_straight * sigma and max(map(abs, thirds)) < bent:
            rests = abs(slope) < POLICY.stroke_rests * sigma / np.sqrt(at @ at)
            out[first:last] = 0.0 if rests else slope * fs_hz
            straight[first:last] = True
    return out, straight


def _plainly_moving(x: Floats, v: Floats, sigma: float) -> NDArray[np.bool_]:
    """Return the rows whose neighbours differ by more than noise, in the direction of v.

    There the direction is certain, however near a reversal: in a coarse recording of cycles, the
    rows around reversals show the capacity of the specimen.
    """
    across = np.zeros(x.size)
    across[1:-1] = x[2:] - x[:-2]
    apart = np.abs(across) > POLICY.static_apart * np.sqrt(2.0) * sigma
    return np.asarray(apart & (np.sign(across) == np.sign(v)))


def _static(case: Case) -> Estimate | None:
    f_meas = case.get("f_meas")
    if f_meas is None:
        return None
    x = filled(case.channels["x_meas"])
    v = np.gradient(x) * case.fs_hz
    sure = np.ones(x.size, dtype=np.bool_)
    unsure = (case.model.x_std or 0.0) * case.fs_hz
    if unsure > POLICY.static_rate_noise * float(np.median(np.abs(v))):
        v, straight = _legs(x, _rate(x, case.fs_hz), case.fs_hz)
        bent = bool(np.mean(straight) < POLICY.static_straight)
        if bent:
            # A slow sweep or random motion is curved within any span that averages its noise.
            v = smoothed(case, [])[0].v
        # The exact row of the reversal is unknown: such rows are not evaluated.
        turns = np.flatnonzero(np.diff(np.sign(v)) != 0)
        for reach in range(-5, 7):
            sure[np.clip(turns + reach, 0, x.size - 1)] = False
        sure[-TURN_ROWS:] = False
        if bent:
            sure |= _plainly_moving(x, v, noise_of(case.channels["x_meas"], case.model.x_std))
    sigma = case.model.f_std or noise_of(f_meas, None)
    sigma = float(np.hypot(sigma, abs(case.model.k) * (case.model.x_std or 0.0)))
    rows = case.rows & np.isfinite(f_meas) & np.isfinite(case.channels["x_meas"])
    if (rows & sure).sum() > POLICY.static_rows * rows.sum():
        rows = rows & sure
    return Estimate(
        ComputedMotion(x, v, np.zeros_like(x)),
        filled(f_meas),
        rows,
        lambda y: y / sigma,
        sigma,
        False,
    )
