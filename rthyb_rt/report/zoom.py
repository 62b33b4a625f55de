"""The first figure as an interactive chart by uPlot, without a network connection.

The static figure remains in the page for printing and for browsers without scripts; on the screen
the chart replaces it.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis.summary import Summary
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import colours
from rthyb_rt.report.decimate import robust_limit

Floats = NDArray[np.float64]

KEY: Final = "displacement"
"""Key of the figure that the chart replaces."""
MOST_ROWS: Final = 16384
"""Largest number of rows of the chart: 40 s at 341 Hz, in a fifth of a megabyte."""
_GAP: Final = -32768
_HERE: Final = Path(__file__).parent
_UPLOT: Final = _HERE.parent / "live" / "static"
"""The live view's copy, together with its licence."""


def parts(
    rec: RecordedTest, summary: Summary, window_s: tuple[float, float]
) -> dict[str, str] | None:
    """Return style, script and data of the chart; None if the test is too short for one."""
    if len(rec.samples) < 16:
        return None
    script = "\n".join(
        path.read_text(encoding="utf-8")
        for path in (_UPLOT / "uPlot.iife.min.js", _HERE / "zoom.js")
    )
    return {
        "style": (_UPLOT / "uPlot.min.css").read_text(encoding="utf-8"),
        "script": script,
        # "</" would end the element.
        "data": json.dumps(chart(rec, summary, window_s), allow_nan=False).replace("</", r"<\/"),
    }


def page(title: str, made: Mapping[str, str]) -> str:
    """Return the chart as a page of its own, which needs neither matplotlib nor a network.

    Args:
        title: title of the page.
        made: style, script and data, from `parts`.
    """
    return _PAGE.format(title=html.escape(title), **made)


_PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}
body {{ font: 13px/1.4 "Liberation Sans", Arial, sans-serif; margin: 8px; color: #1a1a1a; }}
figure, p {{ margin: 0; }}
.u-legend {{ font: 12px/1.4 "Liberation Sans", Arial, sans-serif; text-align: left; width: auto; }}
.u-legend th {{ font-weight: 400; }}
</style>
</head>
<body>
<figure id="figure-displacement"></figure>
<script type="application/json" id="zoom-data">{data}</script>
<script>
{script}
</script>
</body>
</html>
"""


def chart(rec: RecordedTest, summary: Summary, window_s: tuple[float, float]) -> dict[str, Any]:
    """Return the signals of the chart: 16 bits per value, scaled, of every n-th row.

    Args:
        rec: the recording.
        summary: its figures.
        window_s: range of the next figure, s; shaded.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        every = math.ceil(len(rec.samples) / MOST_ROWS)
        samples = rec.samples[::every]
        # On a slow time scale, the laboratory's ground acceleration is smaller by its square.
        g = samples["ag_mps2"] / 9.80665 * summary.setup.time_scale**2
        ground = _panel("ground acceleration, g", [(g, colours.GREY, 1.0, "ground")])
        # The command is a thin line on a broad line of the measurement, as in the static figure.
        signals = [
            (samples["x_meas_m"] * 1e3, colours.BLUE, 2.5, "measured"),
            (samples["x_num_m"] * 1e3, colours.BLACK, 1.0, "command"),
        ]
        if summary.setup.plc_enabled:
            signals.insert(
                0, (samples["x_cmd_m"] * 1e3, colours.ORANGE, 1.5, "compensated command")
            )
        moved = _panel("displacement, mm", signals)
    panels = [{**moved, "height": 300}]
    if not summary.setup.history:  # which moves without a ground motion
        panels.insert(0, {**ground, "height": 90})
    return {
        "start": float(rec.time_s()[0]),
        "step": every / rec.fs_hz,
        "window": list(window_s) if all(map(math.isfinite, window_s)) else None,
        "panels": panels,
    }


def _panel(label: str, signals: list[tuple[Floats, str, float, str]]) -> dict[str, Any]:
    limit = 1.5 * max(robust_limit(*(values for values, *_ in signals)), 1e-12)
    series = []
    for values, colour, width, name in signals:
        known = np.isfinite(values)
        counts = np.rint(np.clip(np.where(known, values, 0.0) / limit, -1.0, 1.0) * 32767.0)
        packed = np.where(known, counts, _GAP).astype("<i2").tobytes()
        data = base64.b64encode(packed).decode("ascii")
        series.append({"label": name, "colour": colour, "width": width, "data": data})
    return {"label": label, "scale": limit / 32767.0, "series": series}
