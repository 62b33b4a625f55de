"""The panels of a study as figures."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import MaxNLocator

from rthyb_rt.report import drawing as draw
from rthyb_rt.report.decimate import robust_limit
from rthyb_rt.studies.results import Colour, Panel, Study

FULL_HEIGHT_IN, HALF_HEIGHT_IN = 1.5, 1.8

_COLOURS: dict[Colour, str] = {
    "black": draw.BLACK,
    "orange": draw.ORANGE,
    "green": draw.GREEN,
    "blue": draw.BLUE,
    "red": draw.RED,
    "purple": draw.PURPLE,
    "grey": draw.GREY,
}


def draw_all(study: Study) -> list[draw.Plate]:
    """Return the figures of a study in its order."""
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        return [_plate(panel) for panel in study.panels]


def _plate(panel: Panel) -> draw.Plate:
    width, height = (
        (draw.HALF_WIDTH_IN, HALF_HEIGHT_IN) if panel.half else (draw.FULL_WIDTH_IN, FULL_HEIGHT_IN)
    )
    bottom = draw.LEGEND_IN if panel.half else draw.BOTTOM_IN
    paper = draw.Paper(panel.key, width, (height,), bottom_in=bottom)
    (axes,) = paper.axes
    x = np.concatenate([curve.x for curve in panel.curves])
    y = np.concatenate([curve.y for curve in panel.curves])
    for value, text in panel.levels:
        draw.level(axes, value, text, draw.GREY)
    for curve in panel.curves:
        colour = _COLOURS[curve.colour]
        if curve.filled and not curve.width:
            axes.fill(curve.x, curve.y, facecolor=colour, alpha=0.75, lw=0, label=curve.label)
            continue
        if curve.filled:
            axes.fill(curve.x, curve.y, facecolor=colour, alpha=0.15, linewidth=0)
        if np.all(np.diff(curve.x) > 0.0):
            dashes = (4, 1.5) if curve.dashed else None
            # Truncated before thinning: a short window needs the full resolution.
            first, last = panel.x_range or (-np.inf, np.inf)
            shown = (curve.x >= first) & (curve.x <= last)
            draw.curve(
                axes, curve.x[shown], curve.y[shown], colour, curve.width, curve.label, dashes
            )
        else:
            draw.loop(
                axes, curve.x, curve.y, colour, curve.width, curve.label,
                x_limit=robust_limit(x), y_limit=robust_limit(y),
            )  # fmt: skip
    axes.set_xlim(*(panel.x_range or (np.nanmin(x), np.nanmax(x))))
    axes.xaxis.set_major_locator(MaxNLocator(5 if panel.half else 12, steps=[1, 2, 2.5, 5, 10]))
    if panel.y_range is not None:
        draw.set_range(axes, *panel.y_range)
    else:
        draw.fit_range(axes, y, limit=robust_limit(y), ticks=5)
    draw.head(axes, panel.y_label, below=panel.half)
    draw.x_label(axes, panel.x_label)
    return paper.plate(panel.title, panel.note)
