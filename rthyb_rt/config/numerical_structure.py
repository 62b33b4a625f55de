"""A numerical part given by matrices, with the specimen joined to it: modes, damping, stability.

Everything here is small (at most eight degrees of freedom) and dense; the code that runs during a
test is ``csrc/numerical_dense.c``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt.config.numerical import Matrices
from rthyb_rt.core import DenseConfig, ElementConfig, Matrix, element
from rthyb_rt.core.numerical_parts import DensePart

Floats = NDArray[np.float64]

RADIUS_SLACK: Final = 1e-9
"""Tolerance of a spectral radius above 1: rounding of an eigenvalue on the unit circle."""
REFERENCE_SUBSTEPS: Final = 8
"""Substeps of RK4 with a nonlinear specimen, whose force is then held for 1/8 of a sample."""
LINEAR: Final = ("inertia", "viscous", "stiffness")
"""Elements that are equivalent to a number in the matrices."""


@dataclass(frozen=True)
class Mode:
    """One mode of the complete structure.

    Attributes:
        frequency_hz: natural frequency without damping.
        damping_ratio: phi' C phi / (2 omega), with phi' M phi = 1.
        shape: mode shape whose largest translation is 1, or if none of its degrees of freedom is
            known to be one, its largest entry, (n,).
        at_interface: entry of the interface in the mode shape with unit modal mass, 1/sqrt(kg).
        effective_mass: effective modal mass for the ground motion, as a share.
    """

    frequency_hz: float
    damping_ratio: float
    shape: tuple[float, ...]
    at_interface: float
    effective_mass: float

    def document(self) -> dict[str, float]:
        """Return frequency, damping ratio and effective mass as plain values."""
        return {
            "frequency_hz": self.frequency_hz,
            "damping_ratio": self.damping_ratio,
            "effective_mass": self.effective_mass,
        }


def linear_and_others(
    elements: Sequence[ElementConfig],
) -> tuple[tuple[float, float, float], list[ElementConfig]]:
    """Return a model's mass, kg, damping, N s/m, stiffness, N/m, and its other elements."""
    mass, damping, spring = (
        sum(e.params[0] for e in elements if e.kind == kind) for kind in LINEAR
    )
    return (mass, damping, spring), [e for e in elements if e.kind not in LINEAR]


@dataclass(frozen=True)
class Structure:
    """The numerical part and what is known of its specimen.

    Attributes:
        labels: labels of the degrees of freedom, (n,).
        part: settings of the part for the core.
    """

    labels: tuple[str, ...]
    part: DenseConfig

    def slowed(self, time_scale: float) -> Structure:
        """Return the structure for a slower time scale, see `rthyb_rt.config.timescale`.

        What is known of the specimen is in the laboratory and is not scaled: what its mass and
        damping then lack is computed, and `with_lack` removes it again.
        """
        if time_scale == 1.0:
            return self
        part, to_m = self.part, time_scale**2
        slow = replace(
            part,
            mass_kg=_rows(to_m * np.array(part.mass_kg)),
            damping_n_s_per_m=_rows(time_scale * np.array(part.damping_n_s_per_m)),
            load_kg=tuple(to_m * load for load in part.load_kg),
        )
        return replace(self, part=slow).with_lack(time_scale, 1.0)

    def with_lack(self, time_scale: float, share: float) -> Structure:
        """Return the structure with a share of the slow specimen's missing forces added."""
        part = self.part
        mass = share * (time_scale**2 - 1.0) * part.specimen_mass_kg
        damping = share * (time_scale - 1.0) * part.specimen_damping_n_s_per_m
        more = replace(
            part,
            mass_kg=_added(part.mass_kg, part.at, mass),
            damping_n_s_per_m=_added(part.damping_n_s_per_m, part.at, damping),
        )
        return replace(self, part=more)

    def joined(self) -> tuple[Floats, Floats, Floats]:
        """Return mass, damping and stiffness including the elastic specimen, (n, n) each."""
        part = self.part
        known = (part.specimen_mass_kg, part.specimen_damping_n_s_per_m, part.k_e_n_per_m)
        own = (part.mass_kg, part.damping_n_s_per_m, part.stiffness_n_per_m)
        m, c, k = (np.array(matrix) for matrix in own)
        for matrix, more in zip((m, c, k), known, strict=True):
            matrix[part.at, part.at] += more
        return m, c, k

    def modes(self) -> tuple[Mode, ...]:
        """Return the modes of the complete structure, the lowest first."""
        m, c, k = self.joined()
        w2, phi = _modes_of(m, k)
        load = np.array(self.part.load_kg)
        whole = float(load @ np.linalg.solve(m, load))
        found = []
        for square, shape in zip(w2, phi.T, strict=True):
            omega = float(np.sqrt(square)) if square > 0.0 else 0.0
            damping = float(shape @ c @ shape)
            largest = shape[np.argmax(np.abs(shape))]
            found.append(
                Mode(
                    omega / (2.0 * np.pi),
                    damping / (2.0 * omega) if omega else 0.0,
                    tuple(float(v) for v in shape / largest),
                    float(shape[self.part.at]),
                    float(shape @ load) ** 2 / whole if whole else 0.0,
                )
            )
        return tuple(found)

    def first(self) -> Mode:
        """Return the lowest mode."""
        return self.modes()[0]

    def spectral_radius(self) -> float:
        """Return the spectral radius of a step of the complete structure, the specimen elastic."""
        m, c, k = self.joined()
        return float(np.abs(step_roots(self.part.integrator, m, c, k, self.part.period_s)).max())

    def reference(
        self, elements: Sequence[ElementConfig], ag_mps2: ArrayLike
    ) -> tuple[Floats, Floats, Floats]:
        """Simulate the structure joined to a model of the specimen; return the interface's motion.

        Like `whole_reference`, without the displacements of the other degrees of freedom.
        """
        return self.whole_reference(elements, ag_mps2)[:3]

    def whole_reference(
        self, elements: Sequence[ElementConfig], ag_mps2: ArrayLike
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Simulate the structure joined to a model of the specimen.

        The linear elements of the model are added to the matrices, so their forces are not delayed.

        Args:
            elements: the model.
            ag_mps2: ground acceleration at every sample, (n,).

        Returns:
            At the interface: displacement, velocity, and the force without that of the model's
            masses and dampers, (n,) each; then the displacement of every degree of freedom, (n,
            dofs).
        """
        ag = np.atleast_1d(np.asarray(ag_mps2, dtype=np.float64))
        (mass, damping, spring), others = linear_and_others(elements)
        steps = REFERENCE_SUBSTEPS if others and self.part.integrator == "rk4" else 1
        part = replace(
            self.part,
            mass_kg=_added(self.part.mass_kg, self.part.at, mass),
            damping_n_s_per_m=_added(self.part.damping_n_s_per_m, self.part.at, damping),
            stiffness_n_per_m=_added(self.part.stiffness_n_per_m, self.part.at, spring),
            specimen_mass_kg=0.0,
            specimen_damping_n_s_per_m=0.0,
            k_e_n_per_m=max(self.part.k_e_n_per_m - spring, 0.0),
            force_delay=0,
            period_s=self.part.period_s / steps,
        )
        x, v, force, everywhere = DensePart(part).reference(others, np.repeat(ag, steps))
        return x[::steps], v[::steps], force[::steps] + spring * x[::steps], everywhere[::steps]

    def elastic_displacement_m(self, ag_mps2: ArrayLike) -> Floats:
        """Return the displacement of the interface with an elastic specimen, (n,)."""
        part = self.part
        model = [
            element("stiffness", k_n_per_m=part.k_e_n_per_m),
            element("viscous", c_n_s_per_m=part.specimen_damping_n_s_per_m),
            element("inertia", m_kg=part.specimen_mass_kg),
        ]
        return self.reference(model, ag_mps2)[0]


def structure_of(given: Matrices, k_e_n_per_m: float, period_s: float) -> Structure:
    """Return the numerical part that a test file's matrices describe.

    Args:
        given: the matrices.
        k_e_n_per_m: elastic stiffness of the rig's specimen.
        period_s: sampling period.
    """
    at, n = given.at, len(given.m_kg)
    m, k = np.array(given.m_kg), np.array(given.k_n_per_m)
    influence = np.array(given.influence if given.influence is not None else [1.0] * n)
    load = m @ influence
    out = given.specimen
    taken = k_e_n_per_m
    if out is not None and out.stiffness_n_per_m is not None:
        taken = out.stiffness_n_per_m
    if given.c_n_s_per_m is not None:
        c = np.array(given.c_n_s_per_m)
    else:
        whole = k.copy()
        whole[at, at] += 0.0 if out is not None else k_e_n_per_m
        c = modal_damping(m, whole, given.damping_ratios or [0.0])
    if out is not None:
        for matrix, own in zip((m, c, k), (out.mass_kg, out.damping_n_s_per_m, taken), strict=True):
            matrix[at, at] -= own
    part = DenseConfig(
        given.integrator,
        _rows(m),
        _rows(c),
        _rows(k),
        tuple(float(v) for v in load),
        at=at,
        specimen_mass_kg=out.mass_kg if out is not None else 0.0,
        specimen_damping_n_s_per_m=out.damping_n_s_per_m if out is not None else 0.0,
        k_e_n_per_m=k_e_n_per_m,
        force_delay=given.force_delay_samples,
        period_s=period_s,
    )
    return Structure(tuple(given.labels or (str(i + 1) for i in range(n))), part)


def modal_damping(m: Floats, k: Floats, ratios: Sequence[float]) -> Floats:
    """Return C = M Phi diag(2 zeta omega) Phi' M, (n, n); rigid-body modes are not damped.

    Args:
        m, k: masses and stiffnesses, (n, n).
        ratios: damping ratios of the modes, the lowest first, (n,), or one for all.
    """
    w2, phi = _modes_of(m, k)
    zeta = np.broadcast_to(np.asarray(ratios, dtype=np.float64), w2.shape)
    rate = 2.0 * zeta * np.sqrt(np.maximum(w2, 0.0))
    c: Floats = m @ (phi * rate) @ phi.T @ m
    return 0.5 * (c + c.T)


def _modes_of(m: Floats, k: Floats) -> tuple[Floats, Floats]:
    """Return omega^2, ascending, (n,), and the shapes with phi' M phi = 1 as columns, (n, n)."""
    root = np.linalg.inv(np.linalg.cholesky(m))
    w2, q = np.linalg.eigh(root @ k @ root.T)
    return w2, root.T @ q


def step_roots(
    integrator: str, m: Floats, c: Floats, k: Floats, h: float
) -> NDArray[np.complex128]:
    """Return the roots of one step of free motion, (2n,)."""
    n, one = len(m), np.eye(len(m))
    if integrator == "rk4":
        zero = np.zeros((n, n))
        a = np.block([[zero, one], [-np.linalg.solve(m, k), -np.linalg.solve(m, c)]])
        z = h * np.linalg.eigvals(a)
        return np.asarray(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0))))
    # Chen & Ricles (2008), with the accelerations substituted.
    alpha = np.linalg.solve(4.0 * m + 2.0 * h * c + h * h * k, 4.0 * one)
    to_v = np.hstack([-h * alpha @ k, one - h * alpha @ c])
    to_x = np.hstack([one, h * one]) + h * (to_v - np.hstack([np.zeros((n, n)), one]))
    return np.asarray(np.linalg.eigvals(np.vstack([to_x, to_v])))


def _rows(matrix: Floats) -> Matrix:
    return tuple(tuple(float(v) for v in row) for row in matrix)


def _added(matrix: Matrix, at: int, more: float) -> Matrix:
    changed = np.array(matrix)
    changed[at, at] += more
    return _rows(changed)
