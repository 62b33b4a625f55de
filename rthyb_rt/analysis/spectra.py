"""Relation of two signals over frequency: transfer function, coherence, spectra, delay.

By Welch's method, with the averages of `scipy.signal.welch`, `csd` and `coherence` (Hann window, 50
% overlap, mean removed from each segment); implemented here so that a report does not need SciPy.

Welch, P.: "The use of fast Fourier transform for the estimation of power spectra", IEEE
Transactions on Audio and Electroacoustics 15 (1967) 70-73; Bendat, J.S., Piersol, A.G.: "Random
Data", 4th ed. (2010), chapters 9 and 11.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

SURE: Final = 0.95
"""Coherence from which gain and delay are drawn: with ten segments, the gain is then known to
5 % (one standard error, Bendat & Piersol, Eqn 9.90)."""
FAINT: Final = 1e-6
"""Share of the greatest input power below which there is no input to respond to."""
_LEAST_SEGMENTS: Final = 8
_LONGEST_S: Final = 4.0


@dataclass(frozen=True, repr=False)
class FrequencyResponse:
    """Response of one signal to another, by frequency.

    Attributes:
        frequency_hz: (k,), from the first line of the resolution; without the mean.
        response: H1 = S_xy / S_xx, complex, output over input, (k,).
        coherence: |S_xy|^2 / (S_xx S_yy), 0 to 1, (k,); meaningless for a single segment.
        input_psd, output_psd: one-sided power spectral densities, unit of the signal squared per
            hertz, (k,).
        known: where the output follows from the input: coherence `SURE` or more, significant input.
        segments: number of averaged segments.
    """

    frequency_hz: Floats
    response: Complexes
    coherence: Floats
    input_psd: Floats
    output_psd: Floats
    known: NDArray[np.bool_]
    segments: int

    def __repr__(self) -> str:
        """Return range, resolution and how much of it is known, in one line."""
        f = self.frequency_hz
        span = f"{f[0]:.4g} to {f[-1]:.4g} Hz" if f.size else "no frequency"
        return (
            f"<FrequencyResponse at {f.size} frequencies, {span}, known at "
            f"{int(np.count_nonzero(self.known))}, {self.segments} segments>"
        )

    @property
    def gain(self) -> Floats:
        """Amplitude of the output over that of the input, (k,)."""
        return np.abs(self.response)

    @property
    def phase_rad(self) -> Floats:
        """Phase of the output against the input, unwrapped, where `known`, otherwise nan, (k,)."""
        phase = np.full(self.response.size, np.nan)
        known = np.flatnonzero(self.known)
        phase[known] = np.unwrap(np.angle(self.response[known]))
        return phase

    @property
    def delay_s(self) -> Floats:
        """Delay of the output, -phase / (2 pi f), where `known`, otherwise nan, (k,), s."""
        return -self.phase_rad / (2.0 * math.pi * self.frequency_hz)


def segment_rows(rows: int, fs_hz: float) -> int:
    """Return the length of a segment, samples: a compromise between resolution and averaging.

    The greatest power of two that gives eight segments, up to 4 s: lines 0.25 Hz apart.
    """
    most = min(2.0 * rows / (_LEAST_SEGMENTS + 1), _LONGEST_S * fs_hz)
    return 1 << max(3, math.floor(math.log2(max(most, 8.0))))


def frequency_response(
    given: ArrayLike, answer: ArrayLike, fs_hz: float, segment: int | None = None
) -> FrequencyResponse | None:
    """Return the response of one signal to another; None for too few samples, or no motion.

    Args:
        given: the input, (n,); of a command and a measurement, the command.
        answer: the output, (n,). Rows in which either is not finite are interpolated in both.
        fs_hz: sampling rate, Hz.
        segment: length of a segment, samples; None: `segment_rows`.
    """
    x, y = (np.asarray(values, dtype=np.float64) for values in (given, answer))
    if x.shape != y.shape or x.ndim != 1:
        raise ValueError(f"signals must be of equal length; found shapes {x.shape}, {y.shape}")
    size = segment or segment_rows(x.size, fs_hz)
    good = np.isfinite(x) & np.isfinite(y)
    if x.size < size or np.count_nonzero(good) < max(size, x.size // 2):
        return None
    if not good.all():
        rows, at = np.arange(x.size), np.flatnonzero(good)
        x, y = np.interp(rows, at, x[at]), np.interp(rows, at, y[at])
    scale = float(np.abs(x).max()), float(np.abs(y).max())
    if not all(0.0 < one < math.inf for one in scale):
        return None
    # Scaled to one: the squares of a diverged test would overflow.
    xs, ys = _transforms(x / scale[0], size), _transforms(y / scale[1], size)
    density = np.float64(2.0 / (fs_hz * float(np.sum(_hann(size) ** 2))))
    s_xx, s_yy = (np.mean(np.abs(one) ** 2, axis=0)[1:] for one in (xs, ys))
    s_xy = np.mean(np.conj(xs) * ys, axis=0)[1:]
    power = s_xx * s_yy
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        h = np.where(s_xx > 0.0, s_xy / s_xx, np.nan) * (scale[1] / scale[0])
        coherence = np.where(power > 0.0, np.abs(s_xy) ** 2 / power, 0.0)
        input_psd, output_psd = (
            _one_sided(one) * density * np.square(np.float64(by))
            for one, by in zip((s_xx, s_yy), scale, strict=True)
        )
    return FrequencyResponse(
        frequency_hz=np.asarray(np.fft.rfftfreq(size, 1.0 / fs_hz)[1:], np.float64),
        response=h.astype(np.complex128),
        coherence=coherence,
        input_psd=input_psd,
        output_psd=output_psd,
        known=np.asarray((coherence >= SURE) & (s_xx > FAINT * s_xx.max())),
        segments=len(xs),
    )


def _one_sided(power: Floats) -> Floats:
    """Halve the line at half the rate, which has no mirror image that must be added."""
    out = power.astype(np.float64)
    out[-1] *= 0.5
    return out


def _hann(size: int) -> Floats:
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / size)


def _transforms(x: Floats, size: int) -> Complexes:
    """Return the transforms of the windowed segments, (segments, size / 2 + 1)."""
    pieces = np.lib.stride_tricks.sliding_window_view(x, size)[:: size // 2]
    return np.asarray(np.fft.rfft((pieces - pieces.mean(axis=1, keepdims=True)) * _hann(size)))
