"""Lightly damped resonances in the sweep of several axes, for the model of their response.

Real poles describe servos, but no resonance: a pole pair of its own does. The response is linear
in what each pole contributes, so for given positions of the pairs all other coefficients follow
by least squares, and only natural frequency and damping ratio of each pair are searched for: the
projection of what remains onto the space of a further pair's columns is the largest for the best
one (separable least squares, Golub & Pereyra, SIAM Journal on Numerical Analysis 10 (1973) 413).
All responses of all axes share the pairs, because a resonance is one of the whole rig.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

MOST_PAIRS: Final = 3
REDUNDANCY: Final = 1.5
"""Real equations per coefficient of each response, at least, as for the fit of one axis."""
LIGHTEST, HEAVIEST = 0.002, 0.3
"""Damping ratios that are tried: welded steel at small motion, and where real poles serve too."""
_SPACING: Final = 0.02
"""Relative spacing of the natural frequencies that are tried at first."""
_DAMPINGS: Final = 6
_ROUNDS: Final = 30
"""Refinements of every pair, each in 0.7 times the previous range."""


@dataclass(frozen=True)
class Pair:
    """A pole pair.

    Attributes:
        natural_hz: undamped natural frequency.
        damping_ratio: below 1.
    """

    natural_hz: float
    damping_ratio: float

    def of_z(self, period_s: float) -> tuple[float, float]:
        """Return a1 and a0 of z^2 + a1 z + a0, whose zeros are the sampled poles."""
        w = 2.0 * math.pi * self.natural_hz * period_s
        size = math.exp(-self.damping_ratio * w)
        return -2.0 * size * math.cos(w * math.sqrt(1.0 - self.damping_ratio**2)), size * size

    def response(self, z: Complexes, period_s: float) -> Complexes:
        """Return what it makes of an input at z, (k,), as (k, 2): 1 at rest, and its rate."""
        return np.asarray(_columns([self], z, period_s)[0])


def _columns(pairs: Sequence[Pair], z: Complexes, period_s: float) -> Complexes:
    """Return the responses of several pairs at z, (pairs, k, 2)."""
    a1, a0 = np.array([pair.of_z(period_s) for pair in pairs]).T[:, :, None]
    w = 2.0 * math.pi * period_s * np.array([[pair.natural_hz] for pair in pairs])
    at_rest = (1.0 + a1 + a0) / (z * z + a1 * z + a0)
    return np.stack([at_rest, (z - 1.0) / w * at_rest], axis=2)


@dataclass(frozen=True)
class Grid:
    """Points at which a response is fitted.

    Attributes:
        z: of the sines of the sweep, (k,).
        beyond: above its end, where the response shall be small, (m,).
        quiet: weight of the latter.
        period_s: sampling period.
    """

    z: Complexes
    beyond: Complexes
    quiet: float
    period_s: float

    def rows(self, at_z: Complexes, at_beyond: Complexes) -> Floats:
        """Return real and imaginary parts of both as rows, (..., 2 k + 2 m, columns)."""
        parts = (at_z.real, at_z.imag, self.quiet * at_beyond.real, self.quiet * at_beyond.imag)
        return np.concatenate(parts, axis=-2)

    def of_pairs(self, pairs: Sequence[Pair], late: int) -> Floats:
        """Return the columns of each pair behind a delay, (pairs, rows, 2)."""
        inside, outside = (
            _columns(pairs, z, self.period_s) * (z ** -(late + 1.0))[:, None]
            for z in (self.z, self.beyond)
        )
        return self.rows(inside, outside)


def most_pairs(tones: int, others: int) -> int:
    """Return how many pairs a sweep can determine, beside other coefficients of each response."""
    return max(0, min(MOST_PAIRS, math.floor((2 * tones / REDUNDANCY - others) / 2)))


def _gains(columns: Floats, basis: Floats, left: Floats) -> Floats:
    """Return by how much pairs reduce the sum of squares, (pairs,).

    Args:
        columns: of each pair, (pairs, rows, 2).
        basis: orthonormal columns that are in the fit already, (rows, n).
        left: what they leave, (rows, responses).
    """
    beside = columns - basis @ (basis.T @ columns)
    size = np.linalg.norm(beside, axis=1, keepdims=True)
    # A pair that the others can replace gains nothing; its columns would be rounding.
    good = (size > 1e-9 * np.linalg.norm(columns, axis=1, keepdims=True)).all(axis=(1, 2))
    beside = beside / np.where(size > 0.0, size, 1.0)
    between = np.einsum("pr,pr->p", beside[:, :, 0], beside[:, :, 1])
    onto = np.einsum("pri,ro->pio", beside, left)
    squares = (onto**2).sum(axis=(1, 2)) - 2.0 * between * (onto[:, 0] * onto[:, 1]).sum(axis=1)
    rest = 1.0 - between**2
    return np.where(good & (rest > 1e-9), squares / np.where(rest > 1e-9, rest, 1.0), 0.0)


def _best_of(
    pairs: Sequence[Pair], grid: Grid, late: int, basis: Floats, left: Floats
) -> tuple[float, Pair]:
    gains = _gains(grid.of_pairs(pairs, late), basis, left)
    at = int(np.argmax(gains))
    return float(gains[at]), pairs[at]


def _around(pair: Pair, span: float, low_hz: float, high_hz: float) -> list[Pair]:
    """Return pairs around one: by factors of the frequency, and by larger ones of the damping."""
    steps = (-span, -0.5 * span, 0.0, 0.5 * span, span)
    return [
        Pair(
            min(max(pair.natural_hz * math.exp(_SPACING * a), low_hz), high_hz),
            min(max(pair.damping_ratio * math.exp(b), LIGHTEST), HEAVIEST),
        )
        for a in steps
        for b in steps
    ]


def _fitted(columns: Floats, aim: Floats) -> tuple[Floats, Floats]:
    """Return an orthonormal basis of columns, and what their fit leaves."""
    basis = np.linalg.qr(columns)[0]
    return basis, aim - basis @ (basis.T @ aim)


def _refined(
    pairs: list[Pair], grid: Grid, late: int, fixed: Floats, aim: Floats, ends: tuple[float, float]
) -> list[Pair]:
    """Return the pairs moved, one after another, to where the fit leaves the least."""
    span = 1.0
    for _ in range(_ROUNDS):
        for k in range(len(pairs)):
            others = [grid.of_pairs([one], late)[0] for i, one in enumerate(pairs) if i != k]
            basis, left = _fitted(np.hstack([fixed, *others]), aim)
            pairs[k] = _best_of(_around(pairs[k], span, *ends), grid, late, basis, left)[1]
        span *= 0.7
    return pairs


def found_pairs(
    grid: Grid, f_hz: Floats, fixed: Sequence[Floats], aim: Floats, count: int
) -> tuple[int, list[Pair]]:
    """Return the delay, and the pairs, with which a fit leaves the least.

    Args:
        grid: where the response is known.
        f_hz: frequencies of its sines, (k,); each pair lies between the first and the last.
        fixed: columns that are in the fit anyway, for delays of 1, 2, ... samples, (rows, n) each.
        aim: the response, and below it zeros, (rows, responses).
        count: number of pairs, above 0.

    Returns:
        The index of the delay, and the pairs.
    """
    ends = float(f_hz[0]), float(f_hz[-1])
    steps = max(2, math.ceil(math.log(ends[1] / ends[0]) / _SPACING))
    tried = [
        Pair(float(f), float(d))
        for f in np.geomspace(*ends, steps)
        for d in np.geomspace(LIGHTEST, HEAVIEST, _DAMPINGS)
    ]
    best: tuple[float, int, list[Pair]] | None = None
    for late, columns in enumerate(fixed):
        pairs = list[Pair]()
        basis, left = _fitted(columns, aim)
        for _ in range(count):
            pairs.append(_best_of(tried, grid, late, basis, left)[1])
            own = [grid.of_pairs([one], late)[0] for one in pairs]
            basis, left = _fitted(np.hstack([columns, *own]), aim)
        remains = float((left**2).sum())
        if best is None or remains < best[0]:
            best = remains, late, pairs
    assert best is not None
    _, late, pairs = best
    return late, _refined(pairs, grid, late, fixed[late], aim, ends)
