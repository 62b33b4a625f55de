"""Drawing of figures: paper, curves, axes, and inline SVG by matplotlib without pyplot.

Curves are thinned to what their pixels can show; text remains text, in the fonts of the page.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import offset_copy
from numpy.typing import NDArray

from rthyb_rt.numbers import number
from rthyb_rt.report.colours import BLACK as BLACK
from rthyb_rt.report.colours import BLUE as BLUE
from rthyb_rt.report.colours import GREEN as GREEN
from rthyb_rt.report.colours import GREY as GREY
from rthyb_rt.report.colours import ORANGE as ORANGE
from rthyb_rt.report.colours import PALE as PALE
from rthyb_rt.report.colours import PURPLE as PURPLE
from rthyb_rt.report.colours import RED as RED
from rthyb_rt.report.decimate import envelope, robust_limit, trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

FULL_WIDTH_IN, HALF_WIDTH_IN = 7.1, 3.45
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN = 0.46, 0.12, 0.24, 0.34
LEGEND_IN = 0.52
COLUMNS_PER_IN = 150.0
LOOP_CELLS = 700
"""Number of pixels across a loop in either direction."""

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "rthyb_rt",
    "font.family": "sans-serif",
    "font.size": 8.0,
    "axes.linewidth": 0.5,
    "axes.edgecolor": GREY,
    "axes.labelcolor": BLACK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.0,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-99, 99),
    "grid.color": "#e7e7e3",
    "grid.linewidth": 0.5,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": BLACK,
    "ytick.labelcolor": BLACK,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 0.0,
    "lines.linewidth": 0.8,
    "lines.solid_joinstyle": "round",
    "path.simplify": True,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
    "legend.handletextpad": 0.5,
    "legend.borderaxespad": 0.0,
    "legend.borderpad": 0.0,
}


@dataclass(frozen=True)
class Plate:
    """A finished figure for a page.

    Attributes:
        key: name in links and ids.
        title: title of the figure.
        svg: the drawing; empty if there is nothing to draw, which ``note`` then explains.
        note: explanation for the reader.
        half: whether two such figures are placed side by side.
        figure: the matplotlib figure, or None if there is nothing to draw.
    """

    key: str
    title: str
    svg: str
    note: str
    half: bool
    figure: Figure | None = field(default=None, repr=False, compare=False)


class Paper:
    """A sheet with axes arranged from top to bottom, in inches."""

    def __init__(
        self, key: str, width_in: float, heights_in: tuple[float, ...], *,
        right_in: float = RIGHT_IN, bottom_in: float = BOTTOM_IN, one_abscissa: bool = True,
    ) -> None:  # fmt: skip
        self.key, self.half = key, width_in == HALF_WIDTH_IN
        gap_in = 0.30 if one_abscissa else 0.30 + BOTTOM_IN
        height_in = TOP_IN + sum(heights_in) + gap_in * (len(heights_in) - 1) + bottom_in
        self.figure = Figure(figsize=(width_in, height_in))
        self.figure.patch.set_visible(False)
        self.axes: list[Axes] = []
        top = height_in - TOP_IN
        for height in heights_in:
            box = (LEFT_IN, top - height, width_in - LEFT_IN - right_in, height)
            fraction = np.array(box) / np.array([width_in, height_in, width_in, height_in])
            axes = self.figure.add_axes(
                (fraction[0], fraction[1], fraction[2], fraction[3]),
                sharex=self.axes[0] if self.axes and one_abscissa else None,
            )
            axes.patch.set_visible(False)
            axes.grid(axis="y")
            self.axes.append(axes)
            top -= height + gap_in
        for axes in self.axes[:-1] if one_abscissa else ():
            axes.tick_params(axis="x", labelbottom=False)

    def plate(self, title: str, note: str) -> Plate:
        """Return the finished figure."""
        svg = to_svg(self.figure, self.key, title)
        return Plate(self.key, title, svg, note, self.half, self.figure)


def curve(
    axes: Axes, x: Floats, y: Floats, colour: str, width: float, label: str = "",
    dashes: tuple[float, float] | None = None,
) -> None:  # fmt: skip
    """Draw a curve over time, thinned to the resolution of the paper."""
    width_in = axes.get_position().width * axes.figure.get_figwidth()  # type: ignore[union-attr]
    x, y = envelope(x, np.where(np.isfinite(y), y, np.nan), int(width_in * COLUMNS_PER_IN))
    # A curve far beyond the frame would overflow the coordinates of the drawing.
    finite = np.abs(y[np.isfinite(y)])
    if finite.size and finite.max() > 0.0:
        y = clip(y, robust_limit(y) * 5.0)
    kind: dict[str, Any] = {"dashes": dashes} if dashes else {}
    if label:
        kind["label"] = label
    axes.plot(x, y, color=colour, linewidth=width, **kind)


def loop(
    axes: Axes, x: Floats, y: Floats, colour: str, width: float, label: str = "", *,
    x_limit: float, y_limit: float, cells: int = LOOP_CELLS,
    dashes: tuple[float, float] | None = None,
) -> None:  # fmt: skip
    """Draw a closed curve, in a frame of ``limit`` on either side of zero."""
    x, y = trace(clip(x, x_limit), clip(y, y_limit), 2 * x_limit, 2 * y_limit, cells)
    kind: dict[str, Any] = {"dashes": dashes} if dashes else {}
    axes.plot(x, y, color=colour, linewidth=width, label=label, **kind)


def tiles(axes: Axes, xs: Floats, ys: Floats, kind: NDArray[np.int_], colours: list[str]) -> None:
    """Fill cells of a grid, all of one colour at once: a hundredth of the size of a mesh.

    Args:
        axes: the axes.
        xs, ys: edges of the cells, (nx + 1,), (ny + 1,).
        kind: colour number of each cell, (nx, ny); negative for none.
        colours: colours by number.
    """
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for n, colour in enumerate(colours):
        corners: list[tuple[float, float]] = []
        for j in range(ys.size - 1):
            there = np.concatenate(([False], kind[:, j] == n, [False]))
            edges = np.flatnonzero(there[1:] != there[:-1])
            for a, b in edges.reshape(-1, 2):
                low, high = float(ys[j]), float(ys[j + 1])
                left, right = float(xs[a]), float(xs[b])
                corners += [(left, low), (right, low), (right, high), (left, high), (left, low)]
        if corners:
            one = [Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY]
            path = Path(np.array(corners), np.array(one * (len(corners) // 5)))
            axes.add_patch(PathPatch(path, facecolor=colour, linewidth=0.0))


def clip(y: Floats, limit: float) -> Floats:
    """Limit a signal to values that a picture with ``limit`` on either side can represent."""
    return np.clip(y, -1.5 * limit, 1.5 * limit)


def largest(x: Floats) -> float:
    """Return the largest magnitude of the finite values; 0 if there are none."""
    finite = np.abs(x[np.isfinite(x)])
    return float(finite.max()) if finite.size else 0.0


def symmetric(axes: Axes, limit: float, margin: float = 1.06, ticks: int = 5) -> None:
    """Set the range of the ordinate to ``limit`` on either side of zero, plus a margin."""
    set_range(axes, -margin * limit, margin * limit, ticks)


def set_range(axes: Axes, low: float, high: float, ticks: int = 5) -> None:
    """Set the range of the ordinate, with plain numbers and powers of ten only if necessary."""
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(ticks, min_n_ticks=3))
    if not 1e-3 <= max(abs(low), abs(high)) < 1e5:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 2)))


def fit_range(axes: Axes, *signals: Floats, limit: float, ticks: int = 6) -> None:
    """Fit the ordinate to the signals, but not beyond ``limit`` on either side."""
    values = np.concatenate(signals)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    low, high = max(low, -limit), min(high, limit)
    if not high > low:
        low, high = low - 1.0, low + 1.0
    margin = 0.06 * (high - low)
    set_range(axes, low - margin, high + margin, ticks)


def span(first: float, last: float) -> tuple[float, float]:
    """Return a time range that is never empty."""
    if not (np.isfinite(first) and np.isfinite(last)):
        return 0.0, 1.0
    return (float(first), float(last)) if last > first else (float(first), float(first) + 1e-3)


def level(axes: Axes, y: float, text: str, colour: str, *, above: bool = True) -> None:
    """Draw a dashed level with its name."""
    axes.axhline(y, color=colour, linewidth=0.7, dashes=(5, 2))
    axes.annotate(
        text, (1.0, y), xycoords=axes.get_yaxis_transform(), xytext=(-2, 2 if above else -2),
        textcoords="offset points", ha="right", va="bottom" if above else "top",
        fontsize=7.0, color=colour,
        bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "alpha": 0.8, "linewidth": 0},
    )  # fmt: skip


def head(
    axes: Axes, label: str, *, order: tuple[int, ...] | None = None, below: bool = False,
    right: str = "",
) -> None:  # fmt: skip
    """Write the label of the ordinate above the axis, and the legend to its right."""
    axes.annotate(
        label, (0.0, 1.0), xycoords=("figure points", "axes fraction"), xytext=(0, 5),
        textcoords="offset points", ha="left", va="bottom", color=BLACK,
    )  # fmt: skip
    if right:
        axes.annotate(
            right, (1.0, 1.0), xycoords="axes fraction", xytext=(6, 5),
            textcoords="offset points", ha="left", va="bottom", color=BLACK,
        )  # fmt: skip
    handles, labels = axes.get_legend_handles_labels()
    if order:
        handles, labels = [handles[i] for i in order], [labels[i] for i in order]
    if handles:
        # Beside the label if there is space, else in line with the label of the abscissa.
        corner, y, shift = (0.0, 0.0, -27.0) if below else (1.0, 1.0, 6.0)
        axes.legend(
            handles, labels, ncols=len(handles), loc="upper left" if below else "lower right",
            bbox_to_anchor=(corner, y),
            bbox_transform=offset_copy(
                axes.transAxes, axes.get_figure(root=True), 0, shift, "points"
            ),
        )  # fmt: skip


LINE_IN = 0.16
"""Height of one line of a legend."""


def room_below(entries: int, columns: int) -> float:
    """Return the height below axes, inches, that a legend with this many entries needs."""
    return 0.46 + LINE_IN * -(-entries // columns)


def legend_below(axes: Axes, columns: int) -> None:
    """Draw the legend below the label of the abscissa, clear of the curves."""
    axes.legend(
        ncols=columns, loc="upper left", bbox_to_anchor=(0.0, 0.0),
        bbox_transform=offset_copy(axes.transAxes, axes.get_figure(root=True), 0, -27, "points"),
    )  # fmt: skip


def x_label(axes: Axes, text: str) -> None:
    """Write the label of the abscissa below it at the right."""
    axes.annotate(
        text, (1.0, 0.0), xycoords="axes fraction", xytext=(0, -15), textcoords="offset points",
        ha="right", va="top", color=BLACK,
    )  # fmt: skip


# --- SVG --------------------------------------------------------------------------------------

_DECIMALS = re.compile(r"(\d+\.\d\d)\d+")
_PATH = re.compile(r' d="[^"]*"')
_ID = re.compile(r'( id="|url\(#|href="#)')
_FONT = re.compile(r"font-family: [^;\"]*;? ?")
_UPRIGHT = re.compile(r' transform="rotate\(-0 [^"]*"')


def to_svg(figure: Figure, key: str, title: str) -> str:
    """Return the figure as an element for a page: own ids, the page's fonts, no header."""
    FigureCanvasSVG(figure)
    out = io.StringIO()
    empty = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(out, format="svg", metadata=empty)
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _PATH.sub(_shorten, text)
    text = _UPRIGHT.sub("", _FONT.sub("", text))
    text = _ID.sub(rf"\g<1>{key}-", text)
    width, height = figure.get_size_inches() * 72.0
    head = (
        f'<svg viewBox="0 0 {width:.1f} {height:.1f}" role="img" aria-label="{title}" '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
    )
    return head + text[text.index(">") + 1 :]


def _shorten(match: re.Match[str]) -> str:
    """Round coordinates to a hundredth of a point."""
    return _DECIMALS.sub(r"\1", match.group().replace("\n", ""))
