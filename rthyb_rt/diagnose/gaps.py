"""Rows that a recording lacks, and the rows near them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY

Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]


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
