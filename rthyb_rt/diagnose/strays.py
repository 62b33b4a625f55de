"""Stray readings: single rows in which a channel shows something that was not there.

A reading beyond everything else in its channel is impossible, and is excluded on sight. A smaller
one shows only in what the best set leaves: far from the rows beside it, which agree with one
another. A law can act in a single row as well, at the end of the motion or where it reverses, and
again and again at the same place: there, no reading is regarded as a fault.
"""

from __future__ import annotations

import numpy as np

from rthyb_rt.diagnose.case import CHANNELS, Floats
from rthyb_rt.diagnose.gaps import Mask, Rows
from rthyb_rt.diagnose.noise_level import white_noise
from rthyb_rt.diagnose.policy import POLICY

IMPULSE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
"""Fourth differences of a single row."""
TURN = 3
"""Number of rows on either side of a reversal in which a law may act in a single row."""


def impossible(values: Floats) -> Rows:
    """Return the rows with single readings far beyond all others; none if several are together.

    At most a few rows in a thousand are of this kind; more are a signal.

    Args:
        values: a channel, (n,), NaN where nothing was recorded.
    """
    good = np.isfinite(values)
    low, high = np.quantile(values[good], (0.002, 0.998))
    span = float(high - low)
    far = POLICY.stray_reading * span
    off = good & ((values < low - far) | (values > high + far))
    # A real peak has flanks: a faulty sample is isolated.
    alone = off & ~np.r_[False, off[:-1]] & ~np.r_[off[1:], False]
    return np.flatnonzero(off if span > 0.0 and np.array_equal(alone, off) else np.zeros_like(off))


def isolated(rest: Floats, rows: Mask, noise: float, x: Floats, v: Floats) -> Rows:
    """Return the rows in which a residual is isolated; none if a law may act in them.

    Two within four rows of each other, and the first and last four rows, are not recognised.

    Args:
        rest: what a set leaves of a channel, (n,).
        rows: which rows are evaluated, (n,).
        noise: stated standard deviation of the channel; the residual's own is used if larger.
        x: displacement, (n,), m.
        v: velocity, (n,), m/s.
    """
    off = np.where(rows & np.isfinite(rest), rest, np.nan)
    scale = float(np.sqrt(IMPULSE @ IMPULSE)) * float(np.nanmax([white_noise(off), noise]))
    width = IMPULSE.size // 2
    if not 0.0 < scale < np.inf or off.size < 2 * IMPULSE.size:
        return np.zeros(0, dtype=np.int64)
    fourth = np.convolve(off, IMPULSE, mode="valid") / scale  # row i is row i + width of `rest`
    found = []
    for i in np.flatnonzero(np.abs(fourth) > POLICY.stray_jump):
        near = fourth[max(i - width, 0) : i + width + 1]
        if near.size < IMPULSE.size or not np.isfinite(near).all():
            continue
        # Without it, the rows beside it must agree with one another.
        beside = near - (near @ IMPULSE) / (IMPULSE @ IMPULSE) * IMPULSE
        if int(np.argmax(np.abs(near))) == width and np.abs(beside).max() < POLICY.stray_healed:
            found.append(int(i) + width)
    at = np.array(found, dtype=np.int64)
    return at[:0] if at.size > POLICY.stray_most or _of_a_law(at, x, v) else at


def _of_a_law(at: Rows, x: Floats, v: Floats) -> bool:
    """Return whether a law may act in some rows: at ends of the motion, or at one place."""
    low, high = float(np.min(x)), float(np.max(x))
    near = POLICY.stray_place * (high - low)
    ends = (x[at] < low + near) | (x[at] > high - near)
    if 2 * np.count_nonzero(ends) > at.size:  # else, most of them are of no law, and so are these
        return True
    if at.size > 2 and float(np.ptp(x[at])) < near:
        return True
    moving = np.flatnonzero(v != 0.0)
    turns = moving[:-1][v[moving[:-1]] * v[moving[1:]] < 0.0]
    turned = sum(bool(np.any(np.abs(turns - row) <= TURN)) for row in at)
    # A law that acts where the motion reverses does so each time, or most times.
    return 2 * turned > turns.size


def without(name: str, values: Floats, rows: Rows) -> tuple[Floats, str]:
    """Return a channel without some of its readings, (n,), and a note that says so.

    Args:
        name: the channel.
        values: its readings, (n,).
        rows: the stray ones, at least one.
    """
    clean, first = values.copy(), int(rows[0])
    clean[rows] = np.nan
    return clean, (
        f"{name} has {rows.size} stray reading{'s' if rows.size > 1 else ''} "
        f"({values[first]:.3g} {CHANNELS[name]} in row {first + 1}); not evaluated there"
    )
