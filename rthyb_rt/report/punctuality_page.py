"""The timing of a PC as one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import __version__
from rthyb_rt.core.ticker import PRIVILEGES, Latency
from rthyb_rt.lab.punctuality import JitterResult, PunctualityVerdict, criterion, privileges_of_all
from rthyb_rt.record.recording import replacing
from rthyb_rt.report.html import environment, extra_needed, sheets

if TYPE_CHECKING:
    from rthyb_rt.report.drawing import Plate

BAR = 4
"""Number of buckets of 3 % in one step of the figures: eight steps per factor of two."""


def write_page(
    results: Sequence[JitterResult],
    facts: Mapping[str, Any],
    verdict: PunctualityVerdict,
    path: Path,
) -> None:
    """Write verdict, histograms and the properties of the machine as one HTML file.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
        RthybError: the file cannot be written.
    """
    with extra_needed("the page"):
        plates = draw_all(results)
        engine = environment()
    html = engine.get_template("jitter.html.j2").render(
        results=results,
        verdict=verdict,
        criterion=criterion(results[0].rate),
        rate_hz=results[0].rate.whole_hz,
        facts=[*fact_rows(facts), obtained(results)],
        rows=[figure_row(result) for result in results],
        figures_of=sheets(plates),
        versions=f"rthyb_rt {__version__}",
    )
    with replacing(path) as temporary:
        temporary.write_text(html, encoding="utf-8")


def figure_row(result: JitterResult) -> tuple[str, ...]:
    """Return title, wake-up p50, p99, longest, reference p99, ratio, sent p99 and skipped ticks.

    Times in µs.
    """
    wake, reference, sent = result.measured.wake, result.reference.wake, result.measured.sent
    times = (
        wake.percentile_ns(50.0), wake.percentile_ns(99.0), wake.max_ns,
        reference.percentile_ns(99.0),
    )  # fmt: skip
    return (
        result.case.title,
        *(_us(time) for time in times),
        f"{result.ratio:.2f}",
        _us(sent.percentile_ns(99.0)) if sent.count else "–",
        str(result.measured.counts.skipped),
    )


def _us(ns: float) -> str:
    return f"{ns / 1e3:.0f}" if ns >= 1e5 else f"{ns / 1e3:.1f}"


def obtained(results: Sequence[JitterResult]) -> tuple[str, str]:
    """Return a row with the privileges of every run in words."""
    return "privileges obtained", _said(
        [name.replace("_", " ") for name in PRIVILEGES if name in privileges_of_all(results)]
    )


def fact_rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the properties of the machine in words."""
    return [(key.replace("_", " "), _said(value)) for key, value in facts.items()]


def _said(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(str, value)) or "none"
    return "not given" if value is None else str(value)


# ---- figures ------------------------------------------------------------------------------------


def draw_all(results: Sequence[JitterResult]) -> list[Plate]:
    """Return one histogram for each run."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw

    with rc_context(draw.STYLE):
        return [_histogram(result, f"run-{i}") for i, result in enumerate(results, start=1)]


def _histogram(result: JitterResult, key: str) -> Plate:
    from matplotlib.ticker import FuncFormatter, NullLocator

    from rthyb_rt.report import drawing as draw

    paper = draw.Paper(key, draw.HALF_WIDTH_IN, (1.9,), bottom_in=draw.LEGEND_IN)
    (axes,) = paper.axes
    kinds = (
        (result.reference.wake, "reference", draw.GREY, 2.0),
        (result.measured.wake, "wake-up", draw.BLUE, 0.9),
        (result.measured.sent, "to sent", draw.ORANGE, 0.9),
    )
    for latency, label, colour, width in kinds:
        if latency.count:
            edges_us, per_cent = shares(latency)
            axes.stairs(per_cent, edges_us, color=colour, linewidth=width, label=label)
    period_us = 1e6 * result.rate.period_s
    axes.axvline(period_us, color=draw.RED, linewidth=0.7, dashes=(5, 2))
    axes.set_xscale("log")
    axes.set_yscale("log")
    longest_us = max(latency.max_ns for latency, *_ in kinds) / 1e3
    axes.set_xlim(0.1, max(2.0 * period_us, 1.5 * longest_us))
    axes.set_ylim(40.0 / max(result.measured.wake.count, 100), 150.0)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_locator(NullLocator())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    draw.head(axes, "ticks, % of all", below=True)
    draw.x_label(axes, "time, µs")
    title = result.case.title
    ratio = f"p99 of the wake-up is {result.ratio:.2f} of the reference thread's."
    return paper.plate(title[0].upper() + title[1:], f"{ratio} Dashed: one tick.")


def shares(latency: Latency) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the edges of the steps, µs, (m + 1,), and the percentage of times in each, (m,).

    The last step includes all times beyond the range of the histogram.
    """
    counts = latency.buckets().astype(float)
    edges_us = Latency.edges_ns().astype(float) / 1e3
    starts = np.arange(0, counts.size, BAR)
    joined = np.add.reduceat(counts, starts)
    edges = np.append(edges_us[starts], 2.0 * edges_us[-1])
    return edges, 100.0 * joined / max(latency.count, 1)
