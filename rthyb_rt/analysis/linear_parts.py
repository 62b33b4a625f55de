"""A numerical part as its actuator experiences it: a linear system, small enough to find roots."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core import DenseConfig
from rthyb_rt.core.numerical_parts import DensePart
from rthyb_rt.core.sparse import SparseConfig, Symmetric, Weights, lowest_modes

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

MOST_MODES: Final = 80
"""Modes of a part that its loop includes; the flexibility of all others acts at once."""
_DIRECT: Final = 16
"""Number of states up to which a response is solved directly at each frequency."""


@dataclass(frozen=True)
class LinearPart:
    """s[n+1] = a s[n] + b force[n]; the displacement of the interface is c s[n].

    Attributes:
        a, b, c: (n, n), (n,), (n,).
        k_e_n_per_m: elastic stiffness of the specimen.
        force_delay: samples by which the force is delayed within the part.
    """

    a: Floats
    b: Floats
    c: Floats
    k_e_n_per_m: float
    force_delay: int

    @classmethod
    def of(cls, config: DenseConfig | SparseConfig) -> LinearPart:
        """Return the linear system of a part; elements of a sparse part have initial stiffness.

        Raises:
            CoreError: the part must be condensed, but has a motion without stiffness.
        """
        if isinstance(config, DenseConfig):
            a, b = DensePart(config).step_matrices()
            c = np.zeros(len(a))
            c[config.at] = 1.0
            return cls(a, b, c, config.k_e_n_per_m, config.force_delay)
        return condensed(config) if config.size > MOST_MODES else of_sparse(config)

    def response(self, z: Complexes) -> Complexes:
        """Return c (z - a)^-1 b at points z, (count,): displacement over force."""
        if len(self.a) > _DIRECT:
            found = self._by_roots(z)
            check = z[:: max(1, z.size // 5)]
            if np.allclose(self._by_roots(check), self._directly(check), rtol=1e-6, atol=0.0):
                return found
        return np.concatenate(
            [self._directly(some) for some in np.array_split(z, z.size // 64 + 1)]
        )

    def _directly(self, z: Complexes) -> Complexes:
        n = self.b.size
        inner = z[:, None, None] * np.eye(n) - self.a
        states = np.linalg.solve(inner, np.broadcast_to(self.b[:, None], (z.size, n, 1)))
        return np.asarray(states[:, :, 0] @ self.c)

    def _by_roots(self, z: Complexes) -> Complexes:
        roots, weights = self._fractions
        return np.concatenate(
            [(weights / (some[:, None] - roots)).sum(axis=1) for some in np.array_split(z, 32)]
        )

    @functools.cached_property
    def _fractions(self) -> tuple[Complexes, Complexes]:
        roots, shapes = np.linalg.eig(self.a.astype(np.complex128))
        return roots, (self.c @ shapes) * np.linalg.solve(shapes, self.b.astype(np.complex128))


def of_sparse(config: SparseConfig) -> LinearPart:
    """Return one step of KR-alpha in x and v, preceded by weights of the last q and force."""
    n, h, w = config.size, config.period_s, Weights.of(config.integrator, config.rho_inf)
    b = config.interface_rows()[0]
    k_e = config.k_e_n_per_m[0]
    m, whole = config.mass_kg.matrix().toarray(), config.whole_stiffness().toarray()
    c = config.damping_times(np.eye(n))
    own = whole - k_e * np.outer(b, b)
    gain = (0.5 + w.gamma) * h * h
    now, before = 1.0 - w.alpha_f, w.alpha_f
    in_step = w.gamma * h * c + w.beta * h * h * whole
    # x and v before the last step, from x, v and q.
    by_q = w.alpha_m * m + before * (in_step + (h * h - gain) * own - h * c)
    by = np.hstack([own, c - before * h * own, by_q, (before * b)[:, None]])
    s = (1.0 - w.alpha_m) * m + now * in_step
    rows, of_force = np.linalg.solve(s, -by), np.linalg.solve(s, -now * b)
    a = np.zeros((3 * n + 1, 3 * n + 1))
    one = np.eye(n)
    a[:n, :n], a[:n, n : 2 * n], a[n : 2 * n, n : 2 * n] = one, h * one, one
    a[:n] += gain * rows
    a[n : 2 * n] += h * rows
    a[2 * n : 3 * n] = rows
    column = np.concatenate([gain * of_force, h * of_force, of_force, [1.0]])
    kept = 2 * n if before == 0.0 and w.alpha_m == 0.0 else 3 * n + 1
    at = np.concatenate([b, np.zeros(2 * n + 1)])
    return LinearPart(a[:kept, :kept], column[:kept], at[:kept], k_e, 0)


def condensed(config: SparseConfig) -> LinearPart:
    """Return `MOST_MODES` modes of the joined structure, the rest by its residual flexibility.

    With f the force and x the interface, the joined structure is driven by f - k_e x. The
    flexibility of the omitted modes (MacNeal 1971) acts one sample later, as any force does.
    """
    row, k_e = config.interface_rows()[0], config.k_e_n_per_m[0]
    w2, shapes = lowest_modes(config, MOST_MODES)
    at = row @ shapes
    n = len(w2)
    given_way = float(row @ config.stiffness_solver().solve(np.ascontiguousarray(row)))
    left = max(given_way - float(np.sum(at**2 / w2)), 0.0)
    joined = of_sparse(
        SparseConfig(
            Symmetric.of(np.eye(n)),
            Symmetric.of(np.diag(w2)),
            np.zeros(n),
            (tuple((i, float(by)) for i, by in enumerate(at)),),
            (0.0,),
            damping_n_s_per_m=Symmetric.of(shapes.T @ config.damping_times(shapes)),
            integrator=config.integrator,
            rho_inf=config.rho_inf,
            period_s=config.period_s,
        )
    )
    b, c = np.append(joined.b, -left), np.append(joined.c, 1.0)
    a = -k_e * np.outer(b, c)
    a[:-1, :-1] += joined.a
    return LinearPart(a, b, c, k_e, 0)
