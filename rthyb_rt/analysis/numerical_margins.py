"""Critical delay of numerical parts with many degrees of freedom; see `margins`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt.analysis.linear_parts import LinearPart
from rthyb_rt.analysis.margins import Lead, SampledLead
from rthyb_rt.config.numerical_structure import Structure
from rthyb_rt.config.sparse_structure import SparseStructure

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class ManyDegrees:
    """A `margins.DelayedStructure` by the matrices of one step; the part's own delay is additional.

    Mass and damping of the specimen are not included.
    """

    structure: Structure | SparseStructure

    @functools.cached_property
    def linear(self) -> LinearPart:
        """The part as a linear system."""
        return LinearPart.of(self.structure.part)

    def is_stable(self, delay_samples: int, lead: Lead | SampledLead | None = None) -> bool:
        """See `margins.DelayedStructure`."""
        part = self.linear
        a, b = part.a, part.b
        rows = len(a)
        top, bottom = (lead or Lead()).polynomials()
        feed, back = top / bottom[0], bottom / bottom[0]
        late = part.force_delay + delay_samples
        # s, then x[n-1], x[n-2] ... and y[n-1], y[n-2] ... that the law remembers, then
        # y[n-1] ... y[n-late]
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

    def loop(self, lead: Lead | SampledLead) -> tuple[Callable[[Complexes], Complexes], Floats]:
        """See `margins.DelayedStructure`."""
        part, (top, bottom) = self.linear, lead.polynomials()

        def of(z: Complexes) -> Complexes:
            lead_gain = np.polyval(top, z) / np.polyval(bottom, z)
            # The part's b has the sign of the force.
            moved = -part.k_e_n_per_m * part.response(z)
            return np.asarray(moved * lead_gain * z**-part.force_delay)

        return of, np.abs(np.angle(np.linalg.eigvals(part.a)))

    def elastic_displacement_m(self, ag_mps2: ArrayLike) -> Floats:
        """See `margins.DelayedStructure`."""
        return self.structure.elastic_displacement_m(ag_mps2)
