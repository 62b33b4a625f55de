"""How far a law's parameters may be off because of its form alone.

No law is exactly true. The real force may equal the law times a smooth function of displacement or
velocity that is within some per cent of one, and part of any such function looks like a change of
the law's parameters. Its size is estimated from the residual: its components along such functions
beyond those caused by noise (a variance component by restricted maximum likelihood; Searle, Casella
and McCulloch, Variance Components, 1992, ch. 6). If the residual is noise alone, the result is
zero.
"""

from __future__ import annotations

import numpy as np

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY

DEGREE = 4
"""Largest degree of Chebyshev polynomials, which approximate smooth functions to one per cent."""


def neighbours(force: Floats, over: list[tuple[Floats, float]]) -> list[Floats]:
    """Return a law's force or motion times each polynomial of its possible arguments, each (n,).

    Args:
        force: force of the law, (n,).
        over: displacement, velocity, travel, each (n,), with their ranges.
    """
    out = []
    for values, reach in over:
        u = np.clip(values / reach, -1.0, 1.0)
        basis = np.polynomial.chebyshev.chebvander(u, DEGREE)
        out += [force * basis[:, k] for k in range(1, DEGREE + 1)]
    return out


def of_form(design: Floats, residual: Floats, inverse: Floats, near: Floats) -> Floats:
    """Return the covariance of a fit's parameters that is due to one law's form, (p, p).

    Args:
        design: slopes of the evaluated rows, whitened, (rows, p).
        residual: whitened, (rows,).
        inverse: inverse of the normal matrix including the priors, (p, p).
        near: the law's `neighbours`, whitened, (rows, q).
    """
    taken = inverse @ (design.T @ near)
    seen = near - design @ taken
    gram, right = np.linalg.eigh(seen.T @ seen)
    score = right.T @ (seen.T @ residual)
    known = gram > 1e-10 * max(float(gram[-1]), 1e-300)
    gram, score = gram[known], score[known]
    # The noise is the part that none of the neighbours explains.
    rest = float(residual @ residual) - float(np.sum(score**2 / gram))
    noise = max(rest, 0.0) / max(residual.size - gram.size, 1)
    if not noise > 0.0:
        return np.zeros_like(inverse)
    # Where its argument is largest, the function is the sum of all its coefficients.
    most = POLICY.form_error**2 / near.shape[1]
    sizes = most * np.r_[0.0, np.geomspace(1e-8, 1.0, 65)]
    power = gram * (noise + sizes[:, None] * gram)
    likelihood = np.sum(np.log(power) + score**2 / power, axis=1)
    size2 = float(sizes[int(np.argmin(likelihood))])
    # Estimated from so few directions, the size follows Student's distribution, not a Gaussian.
    freedom = max(float(np.sum((size2 * gram / (noise + size2 * gram)) ** 2)), 1.0)
    return np.asarray(size2 * _wider(freedom) ** 2 * (taken @ taken.T))


def gain_of_form(design: Floats, residual: Floats, inverse: Floats, near: list[Floats]) -> float:
    """Return the reduction of chi-squared by smooth changes of some laws' forms.

    Each coefficient has a prior, whose standard deviation is `form_error`.

    Args:
        design: slopes of the evaluated rows, whitened, (rows, p).
        residual: whitened, (rows,).
        inverse: inverse of the normal matrix including the priors, (p, p).
        near: the `neighbours` of each law, whitened, each (rows, q).
    """
    columns = np.column_stack(near)
    seen = columns - design @ (inverse @ (design.T @ columns))
    score = seen.T @ residual
    held = seen.T @ seen + np.eye(score.size) / POLICY.form_error**2
    return float(score @ np.linalg.solve(held, score))


def _wider(freedom: float) -> float:
    """Return the ratio of the 95 % points of Student's and the normal distribution.

    By the first terms in 1 / freedom (Abramowitz and Stegun 26.7.5): for 4, 1.39 instead of 1.42.
    """
    z2 = 1.96**2
    return (
        1.0 + (z2 + 1.0) / (4.0 * freedom) + (5.0 * z2**2 + 16.0 * z2 + 3.0) / (96.0 * freedom**2)
    )
