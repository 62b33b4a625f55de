"""The motion of a specimen from noisy sensors, frequency by frequency.

Displacement, accelerometer and load cell are combined in the frequency domain, each weighted by its
noise (a Wiener smoother).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import noise
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.gaps import Rows, filled
from rthyb_rt.diagnose.noise_level import noise_of
from rthyb_rt.diagnose.policy import POLICY

Complex = NDArray[np.complex128]
Denoiser = Callable[[Floats], Floats]
"""Removes white noise from a signal of shape (n,) outside the signal's band; `Whitener` whitens
coloured noise."""
EDGE_S = 0.5
"""Time at either end that is not evaluated, because the smoother has only half its data there."""
MOVING_EDGE_S = 1.5
"""The same if a recording begins or ends in full motion."""


def smooth_ramp(ramp: Floats) -> Floats:
    """Return a transition from 0 to 1 that is smooth up to its third derivative."""
    return np.asarray(ramp**4 * (35.0 - 84.0 * ramp + 70.0 * ramp**2 - 20.0 * ramp**3))


def _extended(signal: Floats, pad: int, odd: bool) -> Floats:
    head, tail = signal[pad:0:-1], signal[-2 : -pad - 2 : -1]
    if odd:
        head, tail = 2.0 * signal[0] - head, 2.0 * signal[-1] - tail
    out = np.concatenate((head, signal, tail))
    # The extension is periodic in the transform: both ends approach zero smoothly.
    smooth = smooth_ramp(np.clip(np.arange(pad) / max(0.75 * pad, 1.0), 0.0, 1.0))
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
class Spectrum:
    """The transform of a signal that is continued beyond its ends by its mirror image.

    Attributes:
        pad: number of rows by which it is continued at either end.
        n: its number of rows.
        omega: frequencies of the transform, (m,), rad/s.
    """

    pad: int
    n: int
    omega: Floats

    @classmethod
    def of(cls, n: int, fs_hz: float) -> Spectrum:
        """Return the transform for a number of rows at a sampling frequency, Hz."""
        pad = int(min(n - 2, max(4.0 * fs_hz, 64)))
        # A length with small prime factors: other transforms take ten times as long.
        while pad > 64 and not _smooth_number(n + 2 * pad):
            pad -= 1
        f_hz = np.asarray(np.fft.rfftfreq(n + 2 * pad, 1.0 / fs_hz), dtype=np.float64)
        return cls(pad, n, 2.0 * np.pi * f_hz)

    def forward(self, signal: Floats, odd: bool = False) -> Complex:
        """Return the spectrum, (m,), of a signal, (n,); ``odd``: continued point-symmetrically."""
        return np.fft.rfft(_extended(signal, self.pad, odd))

    def back(self, spectrum: Complex) -> Floats:
        """Return the signal, (n,), of a spectrum, (m,)."""
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
) -> tuple[ComputedMotion, _Knowledge, Spectrum]:
    """Combine displacement and accelerations, each with its noise, into one motion.

    Args:
        case: the recording.
        accelerations: of the specimen.
        colour: of the displacement's noise.

    Returns the motion, its accuracy at each frequency, and the frequencies.
    """
    x_meas = case.channels["x_meas"]
    place = Sensor(filled(x_meas), noise_of(x_meas, case.model.x_std), colour)
    s = Spectrum.of(place.signal.size, case.fs_hz)
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


def drawn_error(s: Spectrum, variance: Floats, size: int) -> ComputedMotion:
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
    s = Spectrum.of(x.size, case.fs_hz)
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
    s = Spectrum.of(signal.size, fs_hz)
    spectrum = s.forward(signal, odd=True)
    power = _envelope(_above_noise(spectrum, signal.size + 2 * s.pad, sigma**2), s.omega)
    gain = power / (power + sigma**2)
    return lambda other: s.back(gain * s.forward(other, odd=True))


def quiet(signal: Floats, fs_hz: float, sigma: float) -> Floats:
    """Return a signal without the noise outside its band, (n,)."""
    return band_of(signal, fs_hz, sigma)(signal)


def low_passed(signal: Floats, fs_hz: float, cut_hz: float) -> Floats:
    """Return a signal below a frequency, (n,); an eighth-order roll-off without delay."""
    s = Spectrum.of(signal.size, fs_hz)
    gain = 1.0 / (1.0 + (s.omega / (2.0 * np.pi * cut_hz)) ** 8)
    return s.back(gain * s.forward(signal, odd=True))


def rests(x: Floats, fs_hz: float) -> tuple[bool, bool]:
    """Return whether a motion, (n,), is at rest in its first and in its last tenth of a second."""
    head = max(int(0.1 * fs_hz), 2)
    loud = 0.02 * float(np.max(np.abs(x - np.median(x))))
    first, last = (float(np.max(np.abs(d))) for d in (x[:head] - x[0], x[-head:] - x[-1]))
    return first < loud, last < loud


def without_edges(rows: NDArray[np.bool_], fs_hz: float, x: Floats) -> NDArray[np.bool_]:
    """Return rows, (n,), without those at either end, where the smoother lacks half its data."""
    out = rows.copy()
    for at, rest in zip((0, -1), rests(x, fs_hz), strict=True):
        cut = int(min((EDGE_S if rest else MOVING_EDGE_S) * fs_hz, rows.size / 12))
        if cut:
            out[slice(None, cut) if at == 0 else slice(-cut, None)] = False
    return out


def whitening_filter(s: Spectrum, power: Floats, band: Floats) -> Callable[[Floats], Floats]:
    """Return the filter that makes noise of a power, (m,), white within a band, (m,), 0 to 1."""
    gain = band / np.sqrt(power)

    def whiten(signal: Floats) -> Floats:
        return s.back(gain * s.forward(signal))

    return whiten


MARGIN = 512
"""Number of rows on either side of a piece that are whitened with it: the filter's memory."""


def filter_of_pieces(
    s: Spectrum, power: Floats, band: Floats, fs_hz: float
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
