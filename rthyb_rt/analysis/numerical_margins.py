"""How long a delay a numerical part of many degrees of freedom survives, as `margins` has it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis.linear_parts import LinearPart
from rthyb_rt.analysis.margins import Lead, SampledLead, first_crossing, largest_survived
from rthyb_rt.core import DenseConfig
from rthyb_rt.core.sparse import SparseConfig

Floats = NDArray[np.float64]
Config = DenseConfig | SparseConfig | LinearPart


def _linear(part: Config) -> LinearPart:
    return part if isinstance(part, LinearPart) else LinearPart.of(part)


def is_stable(part: Config, delay_samples: int, lead: Lead | SampledLead | None = None) -> bool:
    """Return whether every root of the part with a delayed elastic specimen lies in the circle.

    The specimen is a spring ``k_e_n_per_m`` that feels the compensated command so many samples
    late, its mass and damping are left out; see `margins.is_stable`.

    Args:
        part: the numerical part.
        delay_samples: pure delay between compensated command and motion.
        lead: the compensator, or None without.
    """
    part = _linear(part)
    a, b = part.a, part.b
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
    row[:rows] = feed[0] * part.c
    row[rows:led], row[led:ahead] = feed[1:], -back[1:]
    m[:rows, :rows] = a
    if late:
        m[:rows, size - 1] += part.k_e_n_per_m * b
        m[ahead, :] = row
        m[np.arange(ahead + 1, size), np.arange(ahead, size - 1)] = 1.0
    else:
        m[:rows, :] += part.k_e_n_per_m * np.outer(b, row)
    if kept:
        m[rows, :rows] = part.c
        m[led, :] = row
        for first in (rows, led):
            m[np.arange(first + 1, first + kept), np.arange(first, first + kept - 1)] = 1.0
    return bool(np.all(np.abs(np.linalg.eigvals(m)) < 1.0))


def critical_delay(part: Config, lead: Lead | SampledLead | None = None) -> float:
    """Return the longest pure delay that is survived, samples, as `margins.critical_delay`.

    Args:
        part: the numerical part; its ``force_delay`` comes on top.
        lead: the compensator at a fixed alpha, or None without; no force compensation.
    """
    lead, part = lead or Lead(), _linear(part)
    start = round(lead.alpha)
    if not is_stable(part, start, lead):
        return 0.0
    k_e, late = part.k_e_n_per_m, part.force_delay
    top, bottom = lead.polynomials()

    def loop(z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        # 1 = -loop z^-D; the part's b has the force's sign.
        return np.asarray(-k_e * part.response(z) * np.polyval(top, z) / np.polyval(bottom, z)
                          * z**-late)  # fmt: skip

    return first_crossing(loop, np.abs(np.angle(np.linalg.eigvals(part.a))), start)


def largest_followed_delay(part: Config, lead: Lead, most: int, step: int = 1) -> int | None:
    """Return the largest pure delay survived while alpha is the delay; see `margins`."""
    linear = _linear(part)

    def survives(delay: int) -> bool:
        beta = delay**2 / 2.0 if lead.beta else 0.0
        return is_stable(linear, delay, Lead(float(delay), beta, lead.w1, lead.w2))

    return largest_survived(survives, most, step)
