"""Response spectra: peak response of oscillators with one degree of freedom to a motion.

An oscillator of period T and damping ratio zeta is on a base with the acceleration a(t); its
pseudo-acceleration is (2 pi / T)^2 times the largest magnitude of its displacement relative to the
base (Chopra, A.K.: "Dynamics of structures", 4th ed. (2012), chapter 6).

The response is computed in the frequency domain, where a motion that is given as a displacement
need not be differentiated: (i w)^2 is merely a further factor.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

PERIODS_S: Final = np.geomspace(0.05, 3.0, 50)
DAMPING: Final = 0.05
"""Damping ratio, as in the spectra of design codes."""
_QUIET: Final = 1e-3
"""Share of a free vibration that remains after the zeros appended to the motion."""
_SAMPLES: Final = 16
"""Samples per period of the stiffest oscillator: its peak is at most 2 % too low."""


def pseudo_acceleration(
    fs_hz: float, *, acceleration_mps2: ArrayLike | None = None,
    displacement_m: ArrayLike | None = None, periods_s: Floats = PERIODS_S,
    damping: float = DAMPING,
) -> Floats:  # fmt: skip
    """Return the spectrum of a base motion, (k,), m/s^2.

    Args:
        fs_hz: sampling rate, Hz.
        acceleration_mps2: acceleration of the base, (n,), m/s^2.
        displacement_m: displacement of the base, (n,), m; if both are given, they are added:
            ground, and floor relative to ground.
        periods_s: of the oscillators, (k,), s.
        damping: damping ratio, above 0.
    """
    given = [np.asarray(one, np.float64) for one in (acceleration_mps2, displacement_m)
             if one is not None]  # fmt: skip
    rows = given[0].size
    tail_s = -math.log(_QUIET) * float(periods_s.max()) / (2.0 * math.pi * damping)
    long = 1 << (rows + round(tail_s * fs_hz)).bit_length()
    w = 2.0 * np.pi * np.fft.rfftfreq(long, 1.0 / fs_hz)
    base = np.zeros(w.size, np.complex128)
    if acceleration_mps2 is not None:
        base += np.fft.rfft(_finite(acceleration_mps2), long)
    if displacement_m is not None:
        base -= w**2 * np.fft.rfft(_finite(displacement_m), long)
    # Enough points for the stiffest oscillator: a low-pass far above it.
    wanted_hz = _SAMPLES / float(periods_s.min())
    less = max(1, 1 << max(0, math.floor(math.log2(fs_hz / wanted_hz))))
    short = long // less
    w, base = w[: short // 2 + 1], base[: short // 2 + 1] / less
    found = np.empty(periods_s.size)
    for i, period_s in enumerate(periods_s):
        own = 2.0 * math.pi / float(period_s)
        u = np.fft.irfft(-base / (own**2 - w**2 + 2j * damping * own * w), short)
        found[i] = own**2 * float(np.abs(u).max())
    return found


def _finite(values: ArrayLike) -> Floats:
    """Return a motion with non-finite values bridged by interpolation, so that no step arises."""
    given = np.asarray(values, np.float64)
    good = np.flatnonzero(np.isfinite(given))
    if good.size == given.size or not good.size:
        return given if good.size else np.zeros(given.size)
    return np.interp(np.arange(given.size), good, given[good])
