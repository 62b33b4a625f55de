"""Frames and shear buildings for tests and benchmarks, with textbook matrices assembled here."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Floats = NDArray[np.float64]

E, G = 200e9, 77e9
STOREY_M, BAY_M = 3.2, 6.0


def shear_building(masses: Floats, stiffnesses: Floats) -> tuple[Floats, Floats]:
    """Return M and K of stacked storeys, from below, (n, n) each."""
    n = len(masses)
    k = np.zeros((n, n))
    for i, own in enumerate(stiffnesses):
        k[i, i] += own
        if i:
            k[i - 1, i - 1] += own
            k[i, i - 1] -= own
            k[i - 1, i] -= own
    return np.diag(masses).astype(float), k


def beam_stiffness(
    start: Floats, end: Floats, area: float, i_y: float, i_z: float, torsion: float
) -> Floats:
    """Return the stiffness of an Euler-Bernoulli member in space, (12, 12), global axes."""
    along = end - start
    length = float(np.linalg.norm(along))
    k = np.zeros((12, 12))
    axial, twist = E * area / length, G * torsion / length
    for at, value in ((0, axial), (3, twist)):
        k[at, at] = k[at + 6, at + 6] = value
        k[at, at + 6] = k[at + 6, at] = -value
    for v, r, inertia, sign in ((1, 5, i_z, 1.0), (2, 4, i_y, -1.0)):
        s, c = 12 * E * inertia / length**3, 6 * E * inertia / length**2 * sign
        far, near = 4 * E * inertia / length, 2 * E * inertia / length
        at = [v, r, v + 6, r + 6]
        k[np.ix_(at, at)] += [
            [s, c, -s, c],
            [c, far, -c, near],
            [-s, -c, s, -c],
            [c, near, -c, far],
        ]
    e1 = along / length
    helper = np.array([0.0, 0.0, 1.0]) if abs(e1[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    e2 = np.cross(helper, e1)
    e2 /= np.linalg.norm(e2)
    turn = np.kron(np.eye(4), np.array([e1, e2, np.cross(e1, e2)]))
    return np.asarray(turn.T @ k @ turn)


def space_frame(columns: tuple[int, int], storeys: int) -> tuple[Any, Any, list[str], list[int]]:
    """Return a frame with this number of columns each way; its rotations have no mass.

    Returns:
        Mass and stiffness, csc (n, n); labels ``node.x``; the index of each storey's corner x.
    """
    nx, ny = columns
    nodes = {(i, j, 0): -1 for i in range(nx) for j in range(ny)}
    for s in range(1, storeys + 1):
        for i in range(nx):
            for j in range(ny):
                nodes[i, j, s] = sum(1 for at in nodes.values() if at >= 0)
    n = 6 * nx * ny * storeys
    rows, columns_, values = [], [], []
    for (i, j, s), node in nodes.items():
        here = np.array([i * BAY_M, j * BAY_M, s * STOREY_M])
        for step, section in (
            ((0, 0, 1), (0.02, 4e-4, 4e-4, 2e-5)),
            ((1, 0, 0), (0.01, 3e-4, 1e-4, 1e-6)),
            ((0, 1, 0), (0.01, 3e-4, 1e-4, 1e-6)),
        ):
            other = nodes.get((i + step[0], j + step[1], s + step[2]))
            if other is None or (s == 0 and step[2] == 0):
                continue
            there = here + np.array(step) * np.array([BAY_M, BAY_M, STOREY_M])
            k = beam_stiffness(here, there, *section)
            places = [6 * at + d if at >= 0 else -1 for at in (node, other) for d in range(6)]
            for a, row in enumerate(places):
                for b, column in enumerate(places):
                    if row >= 0 and column >= 0 and k[a, b] != 0.0:
                        rows.append(row)
                        columns_.append(column)
                        values.append(k[a, b])
    stiffness = sp.coo_matrix((values, (rows, columns_)), shape=(n, n)).tocsc()
    mass = sp.diags(np.tile([1.2e4, 1.2e4, 1.2e4, 0.0, 0.0, 0.0], n // 6)).tocsc()
    labels = [f"{at + 1}.{d}" for at in range(n // 6) for d in ("x", "y", "z", "rx", "ry", "rz")]
    return mass, stiffness, labels, [6 * nx * ny * s for s in range(storeys)]
