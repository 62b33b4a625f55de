"""The least response above the end of the sweep with which a loop could be unstable.

There neither the actuators nor the specimen are known, whatever their phase and coupling. With u
the commands of the axes and W u the pose that they mean, let the rig return R W u. The elastic
force of that pose is K W u; in the coordinates in which K = L L^T is the identity,

    R = L D L^T,   det(1 - E D) = 0 at the limit of stability,   E = L^T W C T (1 - N B)^-1 N L

with N the numerical part, B the feedback without the rig, C the laws and T the kinematics, as in
`rthyb_rt.analysis.axes_roots`. D = 1 is the elastic specimen on perfect actuators, and the norm of
D is the largest ratio of the returned force to the elastic one, each by the elastic energy that it
stores. By the small-gain theorem the loop is stable with every D of a norm below 1 / ||E||, and
with one of that norm it is not. For one axis this is the force as a multiple of k_e |x_cmd|.

Specimens that are separate return no force for each other's motion: D is block-diagonal, and the
least D that makes the determinant zero is at least 1 / mu, with the upper bound of the structured
singular value mu = min ||S E S^-1|| over S that is positive and constant on each block (Doyle, IEE
Proc. D 129 (1982) 242), which is exact for up to three blocks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rthyb_rt.analysis.axes_roots import AxesLoop
    from rthyb_rt.config import AxesRig
    from rthyb_rt.config.matrix_response import MatrixResponse

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Blocks = list[list[int]]

NO_CROSSTALK: Final = 0.02
"""Response of a direction to the command of another, as a share of the elastic one, that a sweep
cannot tell from none: its own uncertainty is 1 to 2 % on the shipped rigs."""

_ROUNDS: Final = 12
_HALVINGS: Final = 40
_WIDEST: Final = 12.0
"""Range of the logarithm of a scale: laws and blocks differ by far less than e^12."""


def loop_gain(loop: AxesLoop, k_e: Floats, weights: Floats, z: Complexes, blocks: Blocks) -> Floats:
    """Return the reciprocal of the least response with which a loop could be unstable, (k,).

    Args:
        loop: the loop; its axes are not used.
        k_e: elastic stiffness along the interface, (m, m), symmetric and positive definite.
        weights: pose of the displacements of the axes, (m, axes).
        z: where, on the unit circle, (k,).
        blocks: directions of each separate specimen.
    """
    root = np.linalg.cholesky(k_e)
    moved = loop.part.response(z)
    inner = np.eye(len(k_e)) - moved @ loop.beside.response(z)
    commanded = weights @ loop.law.response(z)
    return structured_gain(root.T @ commanded @ np.linalg.solve(inner, moved) @ root, blocks)


def structured_gain(e: Complexes, blocks: Blocks) -> Floats:
    """Return an upper bound of the structured singular value for full complex blocks, (k,).

    ||S E S^-1|| is convex in the logarithms of the scales (Sezginer & Overton, SIAM J. Matrix Anal.
    Appl. 11 (1990) 574), which are found one by one: the minimum for two blocks, within .5 % of it
    for three. Every S gives an upper bound, so a search that ends early is on the safe side.

    Args:
        e: the matrices, (k, m, m).
        blocks: rows of each block; one block: the largest singular value.
    """
    logs = np.zeros((len(e), e.shape[1]))
    best = _scaled_norm(e, logs)
    for _ in range(_ROUNDS if len(blocks) > 1 else 0):
        before = best
        for rows in blocks[1:]:
            own = np.zeros(e.shape[1])
            own[rows] = 1.0
            step = _least(e, logs, own)
            logs = logs + step[:, None] * own
        best = np.minimum(best, _scaled_norm(e, logs))
        if (best > before * (1.0 - 1e-6)).all():
            break
    return np.asarray(best)


def _scaled_norm(e: Complexes, logs: Floats) -> Floats:
    scale = np.exp(logs)
    return np.asarray(np.linalg.norm(e * scale[:, :, None] / scale[:, None, :], 2, axis=(1, 2)))


def _least(e: Complexes, logs: Floats, own: Floats) -> Floats:
    """Return the change of one block's logarithm with the least norm, (k,), by golden section."""
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    low, high = np.full(len(e), -_WIDEST), np.full(len(e), _WIDEST)
    for _ in range(_HALVINGS):
        left, right = high - golden * (high - low), low + golden * (high - low)
        less = _scaled_norm(e, logs + left[:, None] * own) < _scaled_norm(
            e, logs + right[:, None] * own
        )
        low, high = np.where(less, low, left), np.where(less, right, high)
    return np.asarray(0.5 * (low + high))


def separate_specimens(rig: AxesRig, found: MatrixResponse | None) -> Blocks:
    """Return the directions of each separate specimen; a single block if none is separate.

    Directions belong together if stiffness, damping or mass couple them, if an axis moves both, or
    if in the sweep one responded to the command of the other.

    Args:
        rig: the rig.
        found: its response; None if each axis was identified alone.
    """
    tie, size = rig.core_kinematics(), len(rig.k_e)
    joined = np.zeros((size, size), np.bool_)
    for share in (np.abs(tie.jacobian().T), np.abs(tie.weights())):
        joined |= share @ share.T > 0.0
    for rows in (rig.k_e, rig.specimen.damping, rig.specimen.mass):
        joined |= np.zeros_like(joined) if rows is None else np.array(rows) != 0.0
    if found is not None:
        root = np.linalg.cholesky(np.array(rig.k_e))
        moved = root.T @ tie.weights() @ found.response @ tie.jacobian() @ np.linalg.inv(root.T)
        crosstalk = np.abs(moved).max(axis=0) > NO_CROSSTALK
        joined |= crosstalk | crosstalk.T
    reached = np.linalg.matrix_power(joined.astype(np.int64), max(size - 1, 1)) > 0
    # Rows of a relation that is closed under composition are equal within a block.
    return [np.flatnonzero(row).tolist() for row in np.unique(reached, axis=0)]
