"""The figures of a comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from rthyb_rt.comparing.overlay import Overlay
from rthyb_rt.numbers import quantity
from rthyb_rt.report import drawing as draw
from rthyb_rt.report.decimate import robust_limit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

_COLOURS: Final = (draw.BLACK, draw.BLUE, draw.RED, draw.GREEN, draw.ORANGE)
_DASHES: Final = (4.0, 1.5)
"""Dashes of the sixth and later curves, whose colours repeat."""
_WINDOW_S: Final = 1.5
"""Length of the window about the largest displacement: three periods of a stiff structure."""


def plates(overlay: Overlay) -> list[draw.Plate]:
    """Return all figures, in the order of the page."""
    found = [displacement(overlay)]
    if any(np.isfinite(f).any() for f in overlay.f_n):
        found += [force(overlay), peak(overlay), loops(overlay)]
    else:
        found.append(peak(overlay))
    return found


def displacement(overlay: Overlay) -> draw.Plate:
    """Draw the displacements, and below them the differences from the first."""
    signals = [1e3 * x for x in overlay.x_m]
    return _beside(overlay, "compare", "displacement", "mm", signals, 1e-3)


def force(overlay: Overlay) -> draw.Plate:
    """Draw the same for the forces."""
    signals = [1e-3 * f for f in overlay.f_n]
    return _beside(overlay, "compare-force", "force", "kN", signals, 1e-6)


def _beside(
    overlay: Overlay, key: str, what: str, unit: str, signals: list[Floats], least: float
) -> draw.Plate:
    columns = min(len(signals), 3)
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        below_in = draw.room_below(len(signals), columns)
        paper = draw.Paper(key, draw.FULL_WIDTH_IN, (1.6, 0.9), bottom_in=below_in)
        axes, below = paper.axes
        gaps = []
        for number, y in enumerate(signals):
            t = np.arange(y.size) / overlay.fs_hz
            _curve(axes, number, t, y)
            gap = y[: overlay.shared] - signals[0][: overlay.shared]
            if number:
                gaps.append(gap)
            # The first has no difference from itself, but appears in the legend.
            shown = gap if number else np.full(gap.size, np.nan)
            _curve(below, number, t[: gap.size], shown, overlay.labels[number])
        below.axhline(0.0, color=draw.GREY, linewidth=0.4)
        draw.symmetric(axes, max(robust_limit(*signals), least))
        limit = max(robust_limit(*gaps), 1e-3 * least)
        draw.symmetric(below, limit, ticks=3)
        draw.head(axes, f"{what}, {unit}")
        below.annotate(
            f"difference from the first, {unit}", (0.0, 1.0),
            xycoords=("figure points", "axes fraction"),
            xytext=(0, 5), textcoords="offset points", ha="left", va="bottom", color=draw.BLACK,
        )  # fmt: skip
        last = max(y.size for y in signals) / overlay.fs_hz
        below.set_xlim(*draw.span(0.0, last))
        draw.x_label(below, "time from the first sample of the test, s")
        draw.legend_below(below, columns)
        largest = max(draw.largest(gap) for gap in gaps)
        cut = " The axis is truncated." if largest > 1.5 * limit else ""
        note = f"Largest difference from the first {quantity(largest, unit)}.{cut}"
        return paper.plate(f"{what.capitalize()} compared with the first", note)


def peak(overlay: Overlay) -> draw.Plate:
    """Draw the displacements around the largest of the first."""
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        paper = draw.Paper("compare-peak", draw.HALF_WIDTH_IN, (1.9,))
        (axes,) = paper.axes
        first = overlay.x_m[0][: overlay.shared]
        sizes = np.where(np.isfinite(first), np.abs(first), -1.0)
        at_s = float(np.argmax(sizes)) / overlay.fs_hz
        start = max(0.0, min(at_s - 0.5 * _WINDOW_S, overlay.shared / overlay.fs_hz - _WINDOW_S))
        shown = []
        for number, x in enumerate(overlay.x_m):
            t = np.arange(x.size) / overlay.fs_hz
            inside = (t >= start) & (t <= start + _WINDOW_S)
            shown.append(1e3 * x[inside])
            _curve(axes, number, t[inside], shown[-1])
        draw.fit_range(axes, *shown, limit=max(1.3 * robust_limit(*shown), 1e-3))
        axes.set_xlim(*draw.span(start, start + _WINDOW_S))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        draw.head(axes, "displacement, mm")
        draw.x_label(axes, "time, s")
        note = f"Largest displacement of the first at {at_s:.3f} s. Curves as above."
        return paper.plate("At the peak", note)


def loops(overlay: Overlay) -> draw.Plate:
    """Draw force over displacement of each."""
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        paper = draw.Paper("compare-loops", draw.HALF_WIDTH_IN, (1.9,))
        (axes,) = paper.axes
        xs, fs = [1e3 * x for x in overlay.x_m], [1e-3 * f for f in overlay.f_n]
        x_limit, f_limit = max(robust_limit(*xs), 1e-3), max(robust_limit(*fs), 1e-6)
        axes.axhline(0.0, color=draw.GREY, linewidth=0.4)
        axes.axvline(0.0, color=draw.GREY, linewidth=0.4)
        for number, (x, f) in enumerate(zip(xs, fs, strict=True)):
            colour, dashes = _style(number)
            draw.loop(
                axes, x, f, colour, 0.9 if number == 0 else 0.6, x_limit=x_limit, y_limit=f_limit,
                dashes=dashes,
            )  # fmt: skip
        axes.set_xlim(-1.08 * x_limit, 1.08 * x_limit)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        draw.symmetric(axes, f_limit)
        draw.head(axes, "force, kN")
        draw.x_label(axes, "displacement, mm")
        return paper.plate("Hysteresis loops", "Force over displacement. Curves as above.")


def _style(number: int) -> tuple[str, tuple[float, float] | None]:
    return _COLOURS[number % len(_COLOURS)], _DASHES if number >= len(_COLOURS) else None


def _curve(axes: Axes, number: int, t: Floats, y: Floats, label: str = "") -> None:
    """Draw a curve in its colour; the first is broader, so that it shows below the others."""
    colour, dashes = _style(number)
    draw.curve(axes, t, y, colour, 1.4 if number == 0 else 0.7, label, dashes)
