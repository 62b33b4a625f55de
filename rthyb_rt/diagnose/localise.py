"""Location of a mismatch in a recording: windows of time, displacement and velocity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY

Mask = NDArray[np.bool_]
RUNNING_S = 0.15


def running_rms(signal: Floats, fs_hz: float, noise: float = 0.0) -> Floats:
    """Return the rms over 0.15 s around each row, less the noise, (n,)."""
    k = max(int(RUNNING_S * fs_hz) | 1, 1)
    total = np.cumsum(np.concatenate(([0.0], signal**2)))
    at = np.arange(signal.size)
    low, high = np.maximum(at - k // 2, 0), np.minimum(at + k // 2 + 1, signal.size)
    power = (total[high] - total[low]) / k
    return np.asarray(np.sqrt(np.maximum(power - noise**2, 0.0)))


def active(signal: Floats, fs_hz: float, noise: float = 0.0) -> Mask:
    """Return the rows at which a force or displacement acts, (n,).

    Its running rms exceeds a quarter of the largest one; gaps of up to 0.3 s are included.
    """
    level = running_rms(signal, fs_hz, noise)
    if not level.max() > 0.0:
        return np.zeros(signal.size, dtype=np.bool_)
    mask = level > POLICY.active_part * level.max()
    rows = np.flatnonzero(mask)
    breaks = np.diff(rows)
    for i in np.flatnonzero((breaks > 1) & (breaks <= POLICY.active_break_s * fs_hz)):
        mask[rows[i] : rows[i + 1]] = True
    return np.asarray(mask)


def windows(mask: Mask, t: Floats) -> list[list[float]]:
    """Return the spans of a mask as [first, last] times, s."""
    edges = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [
        [round(float(t[a]), 4), round(float(t[b]), 4)] for a, b in zip(starts, ends, strict=True)
    ]


def ranges(signal: Floats, mask: Mask, along: Floats) -> list[float]:
    """Return the range of ``along`` where a signal acts within a mask."""
    strong = mask & (np.abs(signal) > POLICY.active_rows * (np.max(np.abs(signal)) or 1.0))
    where = along[strong] if strong.any() else along
    return [float(where.min()), float(where.max())]
