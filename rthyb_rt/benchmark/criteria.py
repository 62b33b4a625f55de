"""The benchmark's nine criteria, in the order of its code and of its published Table 3.

The text of the paper numbers them differently: there J4 to J6 are the rms errors of the three
storeys and J7 to J9 the peaks. In code and table only some are ordered by storey; that order is
used here.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NAMES: Final = ("J1", "J2", "J3", "J4", "J5", "J6", "J7", "J8", "J9")
MEANINGS: Final = {
    "J1": "delay of x_meas behind the command by cross-correlation, ms, at most 50 samples",
    "J2": "tracking error, std(x_meas - x_num) / std(x_num), %",
    "J3": "peak tracking error, max|x_meas - x_num| / max|x_num|, %",
    "J4": "response of storey 1, std(x_meas - x_ref) / std(x_ref), %",
    "J5": "peak of storey 1, max|x_meas - x_ref| / max|x_ref|, %",
    "J6": "response of storey 2, std, %",
    "J7": "response of storey 3, std, %",
    "J8": "peak of storey 2, %",
    "J9": "peak of storey 3, %",
    "true": "J2 without sensor noise, %",
    "high": "rms of the command above 100 Hz, um",
}
"""Meaning of each figure of a run."""

LAGS: Final = 50
"""Number of lags, in samples: J1 is the best lag below this, as in the benchmark's code."""
HIGH_HZ: Final = 100.0


def figures(
    target_m: Floats,
    measured_m: Floats,
    true_m: Floats,
    command_m: Floats,
    storeys_m: Floats,
    reference_m: Floats,
    rate_hz: float,
) -> dict[str, float]:
    """Return J1 to J9, ``true`` and ``high`` of a run.

    Args:
        target_m: displacement of the interface from the numerical part, (n,).
        measured_m: measured displacement, with noise, (n,).
        true_m: the same without noise, (n,).
        command_m: command sent to the plant, (n,).
        storeys_m: storeys 2 and 3 of the numerical part, (n, 2).
        reference_m: the three storeys of the reference simulation, (n, 3).
        rate_hz: samples per second.
    """
    first, second, third = reference_m.T
    error, response = measured_m - target_m, measured_m - first
    return {
        "J1": 1e3 * delay_samples(target_m, measured_m) / rate_hz,
        "J2": _rms(error, target_m),
        "J3": _peak(error, target_m),
        "J4": _rms(response, first),
        "J5": _peak(response, first),
        "J6": _rms(storeys_m[:, 0] - second, second),
        "J7": _rms(storeys_m[:, 1] - third, third),
        "J8": _peak(storeys_m[:, 0] - second, second),
        "J9": _peak(storeys_m[:, 1] - third, third),
        "true": _rms(true_m - target_m, target_m),
        "high": 1e6 * above(command_m, HIGH_HZ, rate_hz),
    }


def delay_samples(target: Floats, measured: Floats) -> int:
    """Return the lag below `LAGS` with the largest correlation of both, each (n,).

    numpy's corrcoef of measured[k:] and target[:n-k], with sums that are updated incrementally.
    """
    t, m = target - target.mean(), measured - measured.mean()
    n = t.size
    lags = np.arange(min(LAGS, n - 1))
    sum_t, sum_m = np.cumsum(t), np.cumsum(m)
    square_t, square_m = np.cumsum(t * t), np.cumsum(m * m)
    head = n - 1 - lags
    before = np.where(lags > 0, lags - 1, 0)
    first = np.where(lags > 0, 1.0, 0.0)
    s_t, q_t = sum_t[head], square_t[head]
    s_m = sum_m[-1] - first * sum_m[before]
    q_m = square_m[-1] - first * square_m[before]
    product = np.array([m[k:] @ t[: n - k] for k in lags])
    count = n - lags
    spread = (q_t - s_t * s_t / count) * (q_m - s_m * s_m / count)
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = (product - s_t * s_m / count) / np.sqrt(spread)
    return int(np.nanargmax(correlation)) if np.isfinite(correlation).any() else 0


def above(signal: Floats, frequency_hz: float, rate_hz: float) -> float:
    """Return the rms of the part of a signal, (n,), above a frequency."""
    spectrum = np.fft.rfft(signal - signal.mean())
    spectrum[np.fft.rfftfreq(signal.size, 1.0 / rate_hz) <= frequency_hz] = 0.0
    return float(np.sqrt(2.0) * np.linalg.norm(spectrum) / signal.size)


def _rms(error: Floats, of: Floats) -> float:
    return float(100.0 * np.std(error) / np.std(of))


def _peak(error: Floats, of: Floats) -> float:
    return float(100.0 * np.abs(error).max() / np.abs(of).max())
