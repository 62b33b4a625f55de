"""Fewer points for the same picture: a curve is thinned to what its pixels can show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def envelope(x: Floats, y: Floats, columns: int) -> tuple[Floats, Floats]:
    """Return the smallest and largest point of each pixel column, in their order.

    In contrast to taking every k-th point, no peak is lost.

    Args:
        x: abscissa, increasing and evenly spaced, shape (n,).
        y: ordinate, shape (n,); nan makes a gap if it fills a column.
        columns: number of pixel columns.

    Returns:
        Both coordinates, at most ``2 * columns`` points; unchanged if there are no more than that.
    """
    if y.size <= 2 * columns:
        return x, y
    width = -(-y.size // columns)
    missing = -y.size % width
    # Repeating the last value changes neither the smallest nor the largest of its column.
    grid = np.concatenate([y, np.full(missing, y[-1])]).reshape(-1, width)
    gap = np.isnan(grid)
    low = np.argmin(np.where(gap, np.inf, grid), axis=1)
    high = np.argmax(np.where(gap, -np.inf, grid), axis=1)
    within = np.sort(np.column_stack([low, high]), axis=1)
    rows = np.minimum(within + np.arange(0, grid.size, width)[:, None], y.size - 1).ravel()
    return x[rows], y[rows]


def trace(
    x: Floats, y: Floats, x_range: float, y_range: float, cells: int
) -> tuple[Floats, Floats]:
    """Return a curve in the plane without points in the same pixel as the previous one.

    Args:
        x: abscissa, any order, shape (n,).
        y: ordinate, shape (n,); nan makes a gap.
        x_range: width of the picture in the unit of x, > 0.
        y_range: height of the picture in the unit of y, > 0.
        cells: number of pixels across the picture in either direction.

    Returns:
        Both coordinates; omitted points are within one pixel of those returned.
    """
    pixel_x = np.floor(x * (cells / x_range))
    pixel_y = np.floor(y * (cells / y_range))
    moved = np.ones(x.size, dtype=np.bool_)
    # nan differs from nan, so gaps stay.
    moved[1:] = (np.diff(pixel_x) != 0.0) | (np.diff(pixel_y) != 0.0)
    return x[moved], y[moved]


def robust_limit(*signals: Floats, anchor: float | None = None) -> float:
    """Return the half range of an axis that is insensitive to a diverged tail or a spike.

    The largest value, unless it is more than 20 times the usual size of the signals (the 97 %
    quantile of their moving part) or more than 5 times the anchor; then twice the smaller of the
    two, so that the relevant part remains readable.

    Args:
        signals: signals on the axis; values that are not finite are ignored.
        anchor: size that is known to be right, e.g. the peak of the reference simulation.

    Returns:
        The half range, > 0.
    """
    sizes = np.abs(np.concatenate([signal[np.isfinite(signal)] for signal in signals]))
    largest = float(sizes.max()) if sizes.size else 0.0
    if largest == 0.0:
        return 1.0
    # Only of the moving part: with long rest, a short motion would look like a spike.
    moving = sizes[sizes > 1e-3 * np.quantile(sizes, 0.99)]
    usual = float(np.quantile(moving, 0.97)) if moving.size else largest
    far = 20.0 * usual
    if anchor is not None:
        far, usual = min(far, 5.0 * anchor), min(usual, anchor)
    return largest if largest <= far else 2.0 * usual
