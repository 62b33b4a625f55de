"""How long a delay a numerical part given by matrices survives: `margins` for many degrees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis.margins import Lead, SampledLead, first_crossing, largest_survived
from rthyb_rt.core import DenseConfig
from rthyb_rt.core.numerical_parts import DensePart

Floats = NDArray[np.float64]


def is_stable(
    part: DenseConfig, delay_samples: int, lead: Lead | SampledLead | None = None
) -> bool:
    """Return whether every root of the part with a delayed elastic specimen lies in the circle.

    The specimen is a spring ``k_e_n_per_m`` that feels the compensated command so many samples
    late, its mass and damping are left out; see `margins.is_stable`.

    Args:
        part: the numerical part.
        delay_samples: pure delay between compensated command and motion.
        lead: the compensator, or None without.
    """
    a, b = DensePart(part).step_matrices()
    rows = len(a)
    top, bottom = (lead or Lead()).polynomials()
    feed, back = top / bottom[0], bottom / bottom[0]
    late = part.force_delay + delay_samples
    # s, then x[n-1], x[n-2] ... and y[n-1], y[n-2] ... that the law remembers, y[n-1] ... y[n-late]
    kept = feed.size - 1
    led, ahead = rows + kept, rows + 2 * kept
    size = ahead + late
    m = np.zeros((size, size))
    row = np.zeros(size)
    row[part.at] = feed[0]
    row[rows:led], row[led:ahead] = feed[1:], -back[1:]
    m[:rows, :rows] = a
    if late:
        m[:rows, size - 1] += part.k_e_n_per_m * b
        m[ahead, :] = row
        m[np.arange(ahead + 1, size), np.arange(ahead, size - 1)] = 1.0
    else:
        m[:rows, :] += part.k_e_n_per_m * np.outer(b, row)
    if kept:
        m[rows, part.at] = 1.0
        m[led, :] = row
        for first in (rows, led):
            m[np.arange(first + 1, first + kept), np.arange(first, first + kept - 1)] = 1.0
    return bool(np.all(np.abs(np.linalg.eigvals(m)) < 1.0))


def critical_delay(part: DenseConfig, lead: Lead | SampledLead | None = None) -> float:
    """Return the longest pure delay that is survived, samples, as `margins.critical_delay`.

    Args:
        part: the numerical part; its ``force_delay`` comes on top.
        lead: the compensator at a fixed alpha, or None without; no force compensation.
    """
    lead = lead or Lead()
    start = round(lead.alpha)
    if not is_stable(part, start, lead):
        return 0.0
    a, b = DensePart(part).step_matrices()
    top, bottom = lead.polynomials()
    one, at = np.eye(len(a)), part.at

    def loop(z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        by_force = np.broadcast_to(b[:, None], (z.size, b.size, 1))
        moved = np.linalg.solve(z[:, None, None] * one - a, by_force)
        lead_gain = np.polyval(top, z) / np.polyval(bottom, z)
        # 1 = -loop z^-D; the part's b has the force's sign.
        return np.asarray(-part.k_e_n_per_m * moved[:, at, 0] * lead_gain * z**-part.force_delay)

    return first_crossing(loop, np.abs(np.angle(np.linalg.eigvals(a))), start)


def largest_followed_delay(part: DenseConfig, lead: Lead, most: int, step: int = 1) -> int | None:
    """Return the largest pure delay survived while alpha is the delay; see `margins`."""

    def survives(delay: int) -> bool:
        beta = delay**2 / 2.0 if lead.beta else 0.0
        return is_stable(part, delay, Lead(float(delay), beta, lead.w1, lead.w2))

    return largest_survived(survives, most, step)
