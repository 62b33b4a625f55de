"""Resampling of a record to the controller's rate without inventing content."""

from __future__ import annotations

import functools
import math
from typing import Literal

import numpy as np

from rthyb_rt.ground_motion.acceleration import FloatArray, GroundMotion

# 100 dB of stop-band attenuation; with 64 zero crossings on each side the transition from pass to
# stop band is 5 % of the Nyquist frequency on either side of the cut-off (Kaiser's formulas).
_KAISER_BETA = 0.1102 * (100.0 - 8.7)
_ZERO_CROSSINGS = 64
_TRANSITION = 0.05
# The kernel between two samples is a polynomial of this degree to within rounding.
_DEGREE = 15
_COINCIDE = 1e-9
_MAX_SAMPLES = 2**26
_KEPT_SAMPLES = 2**20  # 8 MiB


def resample(
    motion: GroundMotion,
    fs_hz: float = 1024.0,
    method: Literal["band-limited", "linear"] = "band-limited",
    duration_s: float | None = None,
) -> FloatArray:
    """Return the ground acceleration at the instants n / fs_hz, m/s2, shape (round(T fs),).

    ``band-limited`` is the Kaiser-windowed sinc interpolation of the record, zero outside:
    x(t) = sum_k a_k h(t/dt - k), h(u) = c sinc(c u) I0(beta sqrt(1 - (u/U)^2)) / I0(beta),
    with beta for 100 dB (Kaiser 1974; Oppenheim & Schafer, Discrete-Time Signal Processing, 7.6)
    and U = 64/c rounded up. For upsampling, c = 1: frequencies up to .95 of the record's Nyquist
    frequency are preserved to 1e-5, none appear above 1.05 of it, and the record's own samples
    are preserved where instants coincide. For downsampling, c = .95 fs dt, which prevents aliasing.
    An abrupt beginning or end of the record causes ringing for some samples.

    ``linear`` is `numpy.interp` on the record followed by zeros: it adds content above the
    record's Nyquist frequency and is provided for comparison with published results.

    Args:
        motion: the record.
        fs_hz: sample rate, Hz.
        method: interpolation.
        duration_s: length, s; None: that of the record. Rest follows the record.

    Raises:
        ValueError: an unknown method, a rate or a duration that is not finite and positive, or
            more than 2**26 samples.
    """
    length_s = motion.duration_s if duration_s is None else duration_s
    if not (math.isfinite(fs_hz) and fs_hz > 0.0 and math.isfinite(length_s) and length_s > 0.0):
        raise ValueError(f"fs_hz and duration_s must be finite and positive: {fs_hz}, {length_s}")
    if length_s * fs_hz > _MAX_SAMPLES:
        raise ValueError(f"{length_s} s at {fs_hz} Hz are more than {_MAX_SAMPLES} samples")
    if method not in ("band-limited", "linear"):
        raise ValueError(f"method must be 'band-limited' or 'linear', not {method!r}")
    count = max(1, round(length_s * fs_hz))
    # Thousands of runs of a campaign have the same ground motion.
    compute = _resampled if count <= _KEPT_SAMPLES else _resampled.__wrapped__
    return compute(motion.acceleration_mps2.tobytes(), motion.dt_s, fs_hz, method, count).copy()


@functools.lru_cache(maxsize=2)
def _resampled(record: bytes, dt_s: float, fs_hz: float, method: str, count: int) -> FloatArray:
    acceleration_mps2 = np.frombuffer(record)
    # Instants in units of the record's interval; a product of round numbers remains exact.
    position = np.arange(count) / (fs_hz * dt_s)
    if method == "linear":
        followed_by_rest = np.append(acceleration_mps2, 0.0)
        places = np.arange(followed_by_rest.size)
        linear: FloatArray = np.interp(position, places, followed_by_rest, right=0.0)
        return linear
    rate_ratio = fs_hz * dt_s
    down = rate_ratio < 1.0 - _COINCIDE
    cutoff = (1.0 - _TRANSITION) * rate_ratio if down else 1.0
    return _interpolate(acceleration_mps2, position, cutoff)


def _interpolate(samples: FloatArray, position: FloatArray, cutoff: float) -> FloatArray:
    """Evaluate the band-limited record at positions given in samples, by a Farrow structure.

    With u = m + mu, 0 <= mu < 1, every tap h(mu - j) is a polynomial in mu, so the sum over taps
    becomes a few convolutions at the record's rate and one polynomial per output sample: any
    ratio of rates costs the same.
    """
    nearest = np.rint(position)
    position = np.where(np.abs(position - nearest) < _COINCIDE, nearest, position)
    whole = np.floor(position)
    fraction = position - whole
    half = math.ceil(_ZERO_CROSSINGS / cutoff)
    taps = _tap_polynomials(half, cutoff)
    # Branch p is the convolution with the taps' coefficients of mu**p. Convolution delays by
    # `half` samples, so the output between samples m and m + 1 is at m + half.
    length = samples.size + 2 * half - 1
    size = 1 << length.bit_length()
    spectrum = np.fft.rfft(samples, size)
    index = whole.astype(np.int64) + half
    inside = index < length
    index, fraction = index[inside], fraction[inside]
    inner = np.zeros(index.size)
    for row in taps[::-1]:
        branch = np.fft.irfft(spectrum * np.fft.rfft(row, size), size)
        inner = inner * fraction + branch[index]
    if cutoff == 1.0:
        own = (fraction == 0.0) & (index - half < samples.size)
        inner[own] = samples[index[own] - half]
    out = np.zeros(position.size)
    out[inside] = inner
    return out


@functools.lru_cache(maxsize=4)
def _tap_polynomials(half: int, cutoff: float) -> FloatArray:
    """Return the coefficients of mu**p (rows) of the taps h(mu + i - half) (columns i).

    Column i belongs to the sample i - half places before the output, so that a plain
    convolution of the record with a row sums over the samples.
    """
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    offset = np.arange(2 * half) - half
    u = nodes[:, None] + offset[None, :]
    window = np.i0(_KAISER_BETA * np.sqrt(1.0 - (u / half) ** 2)) / np.i0(_KAISER_BETA)
    kernel = cutoff * np.sinc(cutoff * u) * window
    fitted = np.polynomial.chebyshev.chebfit(2.0 * nodes - 1.0, kernel, _DEGREE)
    taps = _powers_of_fraction(np.asarray(fitted, dtype=np.float64))
    taps.flags.writeable = False
    return taps


def _powers_of_fraction(chebyshev: FloatArray) -> FloatArray:
    """Convert Chebyshev coefficients on [0, 1] (rows) to coefficients of powers of mu."""
    degree = chebyshev.shape[0] - 1
    basis = np.zeros((degree + 1, degree + 1))
    basis[0, 0] = 1.0
    if degree >= 1:
        basis[1, :2] = (-1.0, 2.0)
    for n in range(2, degree + 1):
        # T_n(2 mu - 1) = 2 (2 mu - 1) T_(n-1) - T_(n-2)
        basis[n, 1:] = 4.0 * basis[n - 1, :-1]
        basis[n] -= 2.0 * basis[n - 1] + basis[n - 2]
    powers: FloatArray = basis.T @ chebyshev
    return powers
