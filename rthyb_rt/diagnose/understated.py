"""White noise of a sensor that is louder than its data sheet states.

A sheet may be wrong, or the sensor in a bad place. What a law outside the catalogue leaves lies
where the motion is, comes when the motion is fast or far, and is not white: a residual that is
white, normal, equally loud at all times and wherever the motion is, is noise, however loud.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.gaps import Mask
from rthyb_rt.diagnose.noise_level import white_noise
from rthyb_rt.diagnose.policy import POLICY

BANDS = 8
"""Number of parts of the spectrum that must be alike."""
STRETCHES = 16
"""Number of stretches of time that must be alike."""
NORMAL = 3.0
"""Fourth moment of a normal distribution of unit variance."""
ROWS = 1024
"""Least number of rows: fewer do not show whether noise is white."""


def level(rest: Floats, made: Floats, rows: Mask, motion: Sequence[Floats]) -> float:
    """Return the standard deviation of a residual that is white noise; 0 if it is anything else.

    Args:
        rest: what a model leaves of a channel, (n,).
        made: what the model makes of it, (n,).
        rows: which rows are evaluated, (n,).
        motion: signals, each (n,), on which the noise must not depend.
    """
    if np.count_nonzero(rows) < ROWS or not np.isfinite(rest[rows]).all():
        return 0.0
    off = rest[rows] - np.mean(rest[rows])
    size = float(np.std(off))
    # Of a signal that changes from row to row, nothing is seen beside the motion.
    if not (0.0 < size < np.inf and white_noise(made) ** 2 < POLICY.excess_as_noise * size**2):
        return 0.0
    off = off / size
    parts = [part[rows] for part in motion]
    alike = _normal(off) and _flat(off) and _even(off**2) and _anywhere(off**2, parts)
    return size if alike else 0.0


def unrelated(one: Floats, other: Floats, rows: Mask) -> bool:
    """Return whether two residuals, (n,), have no more in common than a set may leave.

    A motion that the model lacks shows in the displacement and, by stiffness, damping and mass, in
    the force: noise of one sensor shows in no other.
    """
    slope = np.gradient(one)
    design = np.column_stack([one, slope, np.gradient(slope)])[rows]
    design, off = design - design.mean(axis=0), other[rows] - np.mean(other[rows])
    if not (np.isfinite(design).all() and np.isfinite(off).all()):
        return False
    found = np.linalg.lstsq(design, off, rcond=None)[0]
    shared = float(np.mean((design @ found) ** 2)) / max(float(np.mean(off**2)), 1e-300)
    return shared < POLICY.excess_as_noise


def _normal(off: Floats) -> bool:
    """Return whether rows of unit power, (n,), have the fourth moment of a normal distribution."""
    chance = POLICY.power_scatter * float(np.sqrt(24.0 / off.size)) / NORMAL
    fourth = float(np.mean(off**4)) / NORMAL
    return abs(fourth - 1.0) < POLICY.excess_as_noise + chance


def _flat(off: Floats) -> bool:
    """Return whether a spectrum is flat and without lines, but for what a set may leave.

    Beside noise that is as loud as stated, it may leave as much where the motion is.
    """
    power = np.abs(np.fft.rfft(off)[1:-1]) ** 2
    lines = power.size // BANDS
    bands = np.array([np.mean(part) for part in np.array_split(power, BANDS)])
    usual = float(np.median(bands))
    chance = POLICY.power_scatter * np.sqrt(2.0 / lines)
    most, left = (1.0 + n * POLICY.excess_as_noise + chance for n in (1, BANDS))
    slow, rest = bands[0] / usual, bands[1:] / usual
    # The largest of many lines that are distributed exponentially.
    line = float(np.max(power[lines:])) / usual
    by_chance = np.log(power.size) + 2.0 * POLICY.power_scatter
    return bool(
        np.max(rest) < most and np.min(bands) * most > usual and slow < left and line < by_chance
    )


def _even(power: Floats) -> bool:
    """Return whether no stretch of the rows is louder or quieter than the others."""
    parts = np.array([np.mean(part) for part in np.array_split(power, STRETCHES)])
    most = 1.0 + POLICY.excess_as_noise
    most += POLICY.power_scatter * float(np.sqrt(2.0 * STRETCHES / power.size))
    return bool(np.max(parts) < most and np.min(parts) * most > 1.0)


def _anywhere(power: Floats, motion: Sequence[Floats]) -> bool:
    """Return whether the power is the same near and far, to either side, slow and fast."""
    most = 1.0 + POLICY.excess_as_noise + 4.0 * POLICY.power_scatter / float(np.sqrt(power.size))
    ways = [way for part in motion for way in (part, np.abs(part))]
    ways += [a * b for i, a in enumerate(motion) for b in motion[i + 1 :]]
    for way in ways:
        upper = way > np.median(way)
        if upper.any() and not upper.all():
            low, high = sorted((float(np.mean(power[upper])), float(np.mean(power[~upper]))))
            if not high < most * low:
                return False
    return True
