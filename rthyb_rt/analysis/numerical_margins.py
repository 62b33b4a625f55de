"""How long a delay a numerical part given by matrices survives: `margins` for many degrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt.analysis.margins import Lead, SampledLead
from rthyb_rt.config.numerical_structure import Structure
from rthyb_rt.core.numerical_parts import DensePart

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True)
class ManyDegrees:
    """A `margins.DelayedStructure` by the matrices of one step; the part's lateness comes on top.

    The specimen's mass and damping are left out of its roots.
    """

    structure: Structure

    def is_stable(self, delay_samples: int, lead: Lead | SampledLead | None = None) -> bool:
        """As `margins.DelayedStructure` has it."""
        part = self.structure.part
        a, b = DensePart(part).step_matrices()
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

    def loop(self, lead: Lead | SampledLead) -> tuple[Callable[[Complexes], Complexes], Floats]:
        """As `margins.DelayedStructure` has it."""
        part = self.structure.part
        a, b = DensePart(part).step_matrices()
        top, bottom = lead.polynomials()
        one, at = np.eye(len(a)), part.at

        def of(z: Complexes) -> Complexes:
            by_force = np.broadcast_to(b[:, None], (z.size, b.size, 1))
            moved = np.linalg.solve(z[:, None, None] * one - a, by_force)
            lead_gain = np.polyval(top, z) / np.polyval(bottom, z)
            # The part's b has the force's sign.
            return np.asarray(
                -part.k_e_n_per_m * moved[:, at, 0] * lead_gain * z**-part.force_delay
            )

        return of, np.abs(np.angle(np.linalg.eigvals(a)))

    def elastic_displacement_m(self, ag_mps2: ArrayLike) -> Floats:
        """As `margins.DelayedStructure` has it."""
        return self.structure.elastic_displacement_m(ag_mps2)
