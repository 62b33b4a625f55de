"""A numerical part as its actuator experiences it: a linear system, small enough to find roots."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final
from weakref import WeakKeyDictionary

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
MANY_STATES: Final = 100
"""Number of states above which a loop brings a system into triangular form first."""
_SOLVED_TOGETHER: Final = 2**18
"""Entries of the matrices that are solved together, 4 MB: the service computes this, too."""


def solved_response(a: Floats, b: Floats, c: Floats, z: Complexes) -> Complexes:
    """Return c (z - a)^-1 b at points z, (count,), solved directly: (count, outputs, inputs).

    Args:
        a, b, c: (n, n), (n, inputs), (outputs, n); n is at least 1.
        z: the points.
    """
    found = np.empty((z.size, len(c), b.shape[1]), np.complex128)
    count = max(1, _SOLVED_TOGETHER // a.size)
    for first in range(0, z.size, count):
        rows = slice(first, first + count)
        inner = z[rows, None, None] * np.eye(len(a)) - a
        found[rows] = c @ np.linalg.solve(inner, np.broadcast_to(b, (len(inner), *b.shape)))
    return found


@dataclass(frozen=True)
class Triangular:
    """A linear system with many states in its Schur form, for its response at many points.

    a = Q t Q^H with t upper triangular, so that (z - a)^-1 b takes a back substitution at each
    point instead of an elimination. Unlike partial fractions this needs no separate eigenvalues.

    Attributes:
        t, b, c: t, Q^H b and c Q: (n, n), (n, inputs), (outputs, n).
    """

    t: Complexes
    b: Complexes
    c: Complexes

    @classmethod
    def of(cls, a: Floats, b: Floats, c: Floats) -> Triangular:
        """Return the form of a system; arguments as of `solved_response`."""
        from scipy.linalg import schur

        t, q = schur(a, "complex")
        return cls(t, q.conj().T @ b, c @ q)

    def response(self, z: Complexes) -> Complexes:
        """Return what `solved_response` does, (count, outputs, inputs)."""
        n, inputs = self.b.shape
        found = np.empty((z.size, len(self.c), inputs), np.complex128)
        count = max(1, _SOLVED_TOGETHER // (n * inputs))
        for first in range(0, z.size, count):
            some = z[first : first + count]
            x = np.zeros((n, inputs, some.size), np.complex128)
            flat = x.reshape(n, -1)
            for i in range(n - 1, -1, -1):
                known = self.b[i][:, None] + (self.t[i, i + 1 :] @ flat[i + 1 :]).reshape(
                    inputs, -1
                )
                x[i] = known / (some - self.t[i, i])
            moved = np.tensordot(self.c, x, axes=1)
            found[first : first + count] = np.moveaxis(moved, 2, 0)
        return found


@dataclass(frozen=True, eq=False)
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
        if config not in _CONDENSED:
            large = config.size > MOST_MODES
            _CONDENSED[config] = condensed(config) if large else of_sparse(config)
        return _CONDENSED[config]

    def response(self, z: Complexes) -> Complexes:
        """Return c (z - a)^-1 b at points z, (count,): displacement over force."""
        return self._whole.response(z)[:, 0, 0]

    @functools.cached_property
    def _whole(self) -> LinearStep:
        return LinearStep(self.a, self.b[:, None], self.c[None, :])


@dataclass(frozen=True)
class LinearStep:
    """s[n+1] = a s[n] + b force[n]; the displacements of m interfaces are c s[n].

    Attributes:
        a, b, c: (n, n), (n, m), (m, n).
    """

    a: Floats
    b: Floats
    c: Floats

    @classmethod
    def of(cls, config: SparseConfig) -> LinearStep:
        """Return the linear system of a part with all its interfaces, as `LinearPart.of` does.

        Raises:
            CoreError: the part must be condensed, but has a motion without stiffness.
        """
        rows = config.interface_rows()
        k_e = np.diag(config.k_e_n_per_m)
        if config.k_e_between:
            k_e = k_e + np.array(config.k_e_between)
        return (_condensed if config.size > MOST_MODES else _step_of)(config, rows, k_e)

    def response(self, z: Complexes) -> Complexes:
        """Return c (z - a)^-1 b at points z, (count,): displacements over forces, (count, m, m)."""
        if len(self.a) > _DIRECT:
            found = self._by_roots(z)
            check = z[:: max(1, z.size // 5)]
            direct = solved_response(self.a, self.b, self.c, check)
            rounding = 1e-6 * np.abs(direct).max(axis=(1, 2), keepdims=True)
            if (np.abs(self._by_roots(check) - direct) <= rounding).all():
                return found
        return solved_response(self.a, self.b, self.c, z)

    def _by_roots(self, z: Complexes) -> Complexes:
        roots, weights = self._fractions
        m, flat = weights.shape[1], weights.reshape(len(roots), -1)
        parts = [(1.0 / (some[:, None] - roots)) @ flat for some in np.array_split(z, 32)]
        return np.concatenate(parts).reshape(z.size, m, m)

    @functools.cached_property
    def _fractions(self) -> tuple[Complexes, Complexes]:
        roots, shapes = np.linalg.eig(self.a.astype(np.complex128))
        into = np.linalg.solve(shapes, self.b.astype(np.complex128))
        return roots, np.einsum("in,nj->nij", self.c @ shapes, into)


_CONDENSED: Final = WeakKeyDictionary[SparseConfig, LinearPart]()
"""A check examines the same part with several laws; condensing a large one takes a second."""


def of_sparse(config: SparseConfig) -> LinearPart:
    """Return one step of a part at its first interface, with all its degrees of freedom."""
    return _at_first(_step_of, config)


def condensed(config: SparseConfig) -> LinearPart:
    """Return a part at its first interface by `MOST_MODES` modes of the joined structure."""
    return _at_first(_condensed, config)


def _at_first(
    step_of: Callable[[SparseConfig, Floats, Floats], LinearStep], config: SparseConfig
) -> LinearPart:
    k_e = config.k_e_n_per_m[0]
    step = step_of(config, config.interface_rows()[:1], np.array([[k_e]]))
    return LinearPart(step.a, step.b[:, 0], step.c[0], k_e, 0)


def _step_of(config: SparseConfig, b: Floats, k_e: Floats) -> LinearStep:
    """Return one step of KR-alpha in x and v, preceded by weights of the last q and force.

    Args:
        config: the part.
        b: rows of the interfaces, (m, n).
        k_e: elastic stiffness of the specimen along them, (m, m).
    """
    n, m_count = config.size, len(b)
    h, w = config.period_s, Weights.of(config.integrator, config.rho_inf)
    m, whole = config.mass_kg.matrix().toarray(), config.whole_stiffness().toarray()
    c = config.damping_times(np.eye(n))
    own = whole - b.T @ k_e @ b
    gain = (0.5 + w.gamma) * h * h
    now, before = 1.0 - w.alpha_f, w.alpha_f
    in_step = w.gamma * h * c + w.beta * h * h * whole
    # x and v before the last step, from x, v and q.
    by_q = w.alpha_m * m + before * (in_step + (h * h - gain) * own - h * c)
    by = np.hstack([own, c - before * h * own, by_q, before * b.T])
    s = (1.0 - w.alpha_m) * m + now * in_step
    rows, of_force = np.linalg.solve(s, -by), np.linalg.solve(s, -now * b.T)
    a = np.zeros((3 * n + m_count,) * 2)
    one = np.eye(n)
    a[:n, :n], a[:n, n : 2 * n], a[n : 2 * n, n : 2 * n] = one, h * one, one
    a[:n] += gain * rows
    a[n : 2 * n] += h * rows
    a[2 * n : 3 * n] = rows
    columns = np.vstack([gain * of_force, h * of_force, of_force, np.eye(m_count)])
    kept = 2 * n if before == 0.0 and w.alpha_m == 0.0 else 3 * n + m_count
    at = np.hstack([b, np.zeros((m_count, 2 * n + m_count))])
    return LinearStep(a[:kept, :kept], columns[:kept], at[:, :kept])


def _condensed(config: SparseConfig, rows: Floats, k_e: Floats) -> LinearStep:
    """Return `MOST_MODES` modes of the joined structure, the rest by its residual flexibility.

    With f the force and x the interface, the joined structure is driven by f - k_e x. The
    flexibility of the omitted modes (MacNeal 1971) acts one sample later, as any force does.
    """
    w2, shapes = lowest_modes(config, MOST_MODES)
    at = rows @ shapes
    n, solver = len(w2), config.stiffness_solver()
    given_way = rows @ np.column_stack([solver.solve(np.ascontiguousarray(row)) for row in rows])
    # What rounding leaves of a flexibility that the modes hold in full may be negative.
    values, turned = np.linalg.eigh(given_way - (at / w2) @ at.T)
    left = (turned * np.maximum(values, 0.0)) @ turned.T
    joined = _step_of(
        SparseConfig(
            Symmetric.of(np.eye(n)),
            Symmetric.of(np.diag(w2)),
            np.zeros(n),
            tuple(tuple((i, float(by)) for i, by in enumerate(row)) for row in at),
            (0.0,) * len(at),
            damping_n_s_per_m=Symmetric.of(shapes.T @ config.damping_times(shapes)),
            integrator=config.integrator,
            rho_inf=config.rho_inf,
            period_s=config.period_s,
        ),
        at,
        np.zeros_like(k_e),
    )
    b, c = np.vstack([joined.b, -left]), np.hstack([joined.c, np.eye(len(at))])
    a = -b @ k_e @ c
    a[: len(joined.a), : len(joined.a)] += joined.a
    return LinearStep(a, b, c)
