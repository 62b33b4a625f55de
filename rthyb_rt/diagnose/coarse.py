"""A coarse load cell, which reads exactly where it changes its reading.

Rounding by steps far above the noise is no noise: between two changes the force may be anywhere
within a step, and least squares take the colour of that for a law. In the instant of a change the
force is half-way between the two readings, whatever the steps.

A set that is found by these instants is then refined by the likelihood of all readings, each as an
interval: by Newton's method around it, a reading near the end of its step is a force there, and one
in the middle of its step is none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.policy import POLICY

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]
SHARE = 0.661
"""Variance of a row of `intervals`: the mean of m / (m + u) over forces that are anywhere up to
`POLICY.coarse_near_end` within a step, each by the probability of its reading."""
REACH = 6.0
"""Standard deviations beyond which a probability is 1, or given by its asymptote."""


@dataclass(frozen=True)
class Exact:
    """Rows in which a coarse load cell is exact.

    Attributes:
        rows: these rows, (n,).
        force: the force in them, (n,), N.
        weight: reciprocal of its standard deviation, (n,), 1/N.
        pairs: whether it is the mean force of each of these rows and the next one.
    """

    rows: Mask
    force: Floats
    weight: Floats
    pairs: bool

    def seen(self, signal: Floats) -> Floats:
        """Return a force, (n,), N, in these rows with errors of unit variance."""
        if self.pairs:
            signal = 0.5 * (signal + np.append(signal[1:], signal[-1]))
        return np.where(self.weight > 0.0, signal, 0.0) * self.weight


def changes(reading: Floats, rows: Mask, step_n: float, noise_n: float, expected: Floats) -> Exact:
    """Return where a coarse load cell changes its reading, and the force there.

    Noise makes it change back and forth around the instant at which the force itself passes. The
    rows with either reading then count: as many show the later one before that instant as show the
    earlier one after it.

    Args:
        reading: the readings, (n,), N.
        rows: rows with a reading of its own.
        step_n: step of the readings, N.
        noise_n: standard deviation of the noise before rounding, N.
        expected: the force by the model, for its rates and its repetitions, (n,), N.
    """
    force, found = reading.copy(), np.zeros(reading.size, dtype=np.bool_)
    rate = np.abs(np.diff(expected, append=expected[-1]))
    # Slow noise moves an instant as much as it is.
    variance = noise_n**2 + rate**2 / 12.0
    alike: dict[tuple[float, float], list[int]] = {}
    level = np.round((reading - reading[rows][0]) / step_n).astype(np.int64)
    at = np.flatnonzero((np.diff(level) != 0) & rows[:-1] & rows[1:])
    taken = -1
    for group in _groups(at, level, noise_n, rate):
        row = int(np.sum(group[::2])) - int(np.sum(group[1::2]))
        # With an even number the force turned within the noise, and nobody knows how near.
        if len(group) % 2 == 0 or row <= taken:
            continue
        before, after = float(reading[group[0]]), float(reading[group[-1] + 1])
        force[row : row + 2], found[row], taken = 0.5 * (before + after), True, row + 1
        alike.setdefault((before, after), []).append(row)
        if abs(int(level[group[-1] + 1] - level[group[0]])) > 1:
            variance[row] += step_n**2 / 24.0  # each of the two rows within its own step
    for same in alike.values():
        variance[same] += _repeated(np.array(same), expected, rate)
    return Exact(found, force, 1.0 / np.sqrt(np.maximum(variance, 1e-300)), pairs=True)


def _repeated(same: Rows, expected: Floats, rate: Floats) -> float:
    """Return the variance by which changes between the same two readings err alike, for each, N^2.

    Where between two rows the force passed is not known. If a sine has a whole number of rows in a
    cycle, it is the same place each time, and all these changes are no more than one. Otherwise the
    place, and with it the expected force half-way, scatters as much as it may.
    """
    half_way = 0.5 * (expected[same] + expected[same + 1])
    unseen = float(np.mean(rate[same] ** 2)) / 12.0 - float(np.var(half_way))
    return (same.size - 1) * max(unseen, 0.0)


def _groups(at: Rows, level: Rows, noise_n: float, rate: Floats) -> Iterator[list[int]]:
    """Yield the changes, as rows, that belong to one passage of one force between two readings."""
    group: list[int] = []
    between = None
    for row in map(int, at):
        pair = (min(level[row], level[row + 1]), max(level[row], level[row + 1]))
        reach = POLICY.coarse_flicker * noise_n / max(float(rate[row]), 1e-300)
        if group and (pair != between or row - group[-1] > max(reach, 1.0)):
            yield group
            group = []
        between = pair
        group.append(row)
    if group:
        yield group


def intervals(reading: Floats, rows: Mask, step_n: float, noise_n: float, best: Floats) -> Exact:
    """Return the readings as forces with which least squares maximise their likelihood.

    A force that is u standard deviations within the nearest end of a step is repelled from there by
    m(u), the normal density over the normal integral, with the weight m (m + u). Of a force that
    passes the end faster than its noise, hardly a row would be near enough: its change within a row
    counts as noise.

    Args:
        reading: the readings, (n,), N.
        rows: rows with a reading.
        step_n: step of the readings, N.
        noise_n: standard deviation of the noise before rounding, N.
        best: the force by a model that is nearly right, (n,), N.
    """
    off = best - reading
    noise = np.hypot(noise_n, np.diff(best, append=best[-1]) / np.sqrt(12.0))
    within = (0.5 * step_n - np.abs(off)) / noise
    near = rows & np.isfinite(best) & (within < POLICY.coarse_near_end)
    u = within[near]
    push = np.array([_mills(value) for value in u.tolist()])
    weight = push * (push + u)
    force, root = reading.copy(), np.zeros(reading.size)
    force[near] = best[near] - np.sign(off[near]) * noise[near] * push / weight
    root[near] = np.sqrt(weight) / noise[near]
    return Exact(near, force, root, pairs=False)


def _mills(u: float) -> float:
    """Return the normal density over the normal integral up to u."""
    if u < -REACH:
        inverse = 1.0 / u
        return -u - inverse + 2.0 * inverse**3
    return math.exp(-0.5 * u * u) / (math.sqrt(2.0 * math.pi) * _integral(u))


def _integral(u: float) -> float:
    """Return the normal integral up to u."""
    return 0.5 * math.erfc(-u / math.sqrt(2.0))


def deviance(expected: Floats, reading: Floats, rows: Mask, step_n: float, noise_n: float) -> float:
    """Return -2 ln of the probability of readings, each of a force within half a step of it.

    A force that stays half-way between two readings fits where the reading changes, but not that it
    changes there only once.

    Args:
        expected: the force by a model, (n,), N.
        reading: the readings, (n,), N.
        rows: rows with a reading.
        step_n: step of the readings, N.
        noise_n: standard deviation of the noise before rounding, N.
    """
    inside = (0.5 * step_n - np.abs(expected[rows] - reading[rows])) / noise_n
    if not np.isfinite(inside).all():
        return math.inf  # of a law that diverges
    # The other end of a step is too far to matter, and so is the middle of one.
    near = inside[inside < REACH]
    beyond = near[near < -REACH]
    out = float(np.sum(beyond**2 + np.log(2.0 * np.pi * beyond**2)))
    return out - 2.0 * sum(math.log(_integral(u)) for u in near[near >= -REACH].tolist())


def is_rounded(step_n: float, noise_n: float) -> bool:
    """Return whether the noise is too small to carry the reading over several steps."""
    return step_n > POLICY.coarse_undithered * noise_n
