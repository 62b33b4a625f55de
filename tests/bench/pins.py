"""How exactly the core finds the pose of a specimen from the displacements of its pinned axes.

The core solves for the pose by two Newton steps from the last one. Here the distances between pins
and bases are written a second time, with complex numbers in extended precision, and the solution is
held against them along a grid of poses.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rthyb_rt.core.kinematics import Kinematics, Pin

MOST_M, MOST_RAD = 0.060, 0.080
"""Range of the grid to either side."""
STEP_M, STEP_RAD = 0.5e-3, 1.0e-3
"""Largest motion from sample to sample: 0.5 m/s and 1 rad/s at 1024 Hz."""
PINS = (
    Pin((0.2667, 0.127), (1.6, 0.127), pulls=True),
    Pin((0.2667, -0.127), (1.6, -0.127), pulls=True),
    Pin((0.1, -0.2), (0.15, -1.4)),
)
"""The two actuators of the multi-axial benchmark, and one from below."""

Solve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Closing:
    """Largest errors along the grid.

    Attributes:
        poses: number of poses, each a sample.
        axis_m: difference between the distance of pin and base at the pose that was found and the
            displacement that was given.
        translation_m: error of x or y.
        rotation_rad: error of theta.
    """

    poses: int
    axis_m: float
    translation_m: float
    rotation_rad: float


def displacements(pose: np.ndarray, pins: tuple[Pin, ...] = PINS) -> np.ndarray:
    """Return the displacements of the axes, m, (n, axes), in extended precision.

    With r and b the pin and the base as complex numbers, |z + r e^(i theta) - b| - |r - b|.

    Args:
        pose: x in m, y in m, theta in rad, (n, 3).
        pins: pins with bases at a finite distance.
    """
    x, y, theta = np.asarray(pose, dtype=np.longdouble).T
    turned = np.cos(theta) + np.clongdouble(1j) * np.sin(theta)
    found = []
    for pin in pins:
        r, b = (np.clongdouble(complex(*point)) for point in (pin.pin_m, pin.base_m))
        longer = np.abs(x + 1j * y + r * turned - b) - np.abs(r - b)
        found.append(-longer if pin.pulls else longer)
    return np.stack(found, axis=1)


def grid(points: int = 5) -> np.ndarray:
    """Return a way through all poses of a grid, x, y, theta, (n, 3), at most a step at a time."""
    levels = np.linspace(-1.0, 1.0, points)
    corners = [(0.0, 0.0, 0.0)]
    for i, theta in enumerate(levels):
        for j, y in enumerate(levels[:: 1 - 2 * (i % 2)]):
            back = (i * points + j) % 2
            corners += [(x, y, theta) for x in levels[:: 1 - 2 * back]]
    scaled = np.array(corners) * (MOST_M, MOST_M, MOST_RAD)
    way = [scaled[:1]]
    for begin, end in itertools.pairwise(scaled):
        least = np.abs(end - begin) / (STEP_M, STEP_M, STEP_RAD)
        steps = int(np.ceil(least.max() - 1e-9))
        way.append(begin + (end - begin) * np.linspace(0.0, 1.0, steps + 1)[1:, None])
    return np.concatenate(way)


def in_core(axes: np.ndarray) -> np.ndarray:
    """Return the poses that the core finds, (n, 3), one sample after the other."""
    body: Any = Kinematics(pins=PINS, coordinates=["x", "y", "theta"])
    found, code = body.pose(axes)
    if code:
        raise RuntimeError(f"the core refused a pose of the grid ({code})")
    return np.asarray(found)


def measure(solve: Solve = in_core, points: int = 5) -> Closing:
    """Return the largest errors along the grid.

    Args:
        solve: gives poses, (n, 3), for displacements of the axes, (n, 3).
        points: points of the grid in each direction.
    """
    wanted = grid(points)
    given = displacements(wanted).astype(np.float64)
    found = solve(given)
    apart = np.abs(found - wanted).max(axis=0)
    return Closing(
        poses=len(wanted),
        axis_m=float(np.abs(displacements(found) - given).max()),
        translation_m=float(apart[:2].max()),
        rotation_rad=float(apart[2]),
    )
