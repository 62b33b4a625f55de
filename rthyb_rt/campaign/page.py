"""A campaign as one page: medians and worst cases, what tripped and why, every run."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rthyb_rt import __version__, core
from rthyb_rt.campaign.groups import MEASURES, Group, figure, group
from rthyb_rt.campaign.plan import Case, Plan
from rthyb_rt.campaign.running import COMPLETED, FAILED, STOPPED, Row
from rthyb_rt.numbers import number
from rthyb_rt.record.recording import replacing
from rthyb_rt.report.html import environment, extra_needed, sheets

if TYPE_CHECKING:
    from rthyb_rt.report.drawing import Plate

PAGE: Final = "index.html"
MOST_ROWS: Final = 2000
"""Runs that the page lists; a browser is slow with more, and the table has all of them."""
_HERE = Path(__file__).parent


def write(plan: Plan, rows: Sequence[Row], folder: Path) -> None:
    """Write ``index.html``, one file that needs nothing else but the kept runs it links to.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
        RthybError: the file cannot be written.
    """
    html = render(plan, rows)
    with replacing(folder / PAGE) as temporary:
        temporary.write_text(html, encoding="utf-8")


def render(plan: Plan, rows: Sequence[Row]) -> str:
    """Return the page as HTML; arguments and errors as for `write`."""
    keys = list(plan.cases[0].chosen)
    groups = group(rows, keys)
    with extra_needed("the page of a campaign"):
        plates = _plates(rows, keys, groups)
        engine = environment(_HERE)
    engine.filters["figure"] = figure
    engine.filters["number"] = number
    engine.globals["value"] = value
    cases = {case.number: case for case in plan.cases}
    bad = [row for row in rows if row["ending"] != COMPLETED]
    shown = [*bad[:MOST_ROWS], *(r for r in rows if r["ending"] == COMPLETED)][:MOST_ROWS]
    return engine.get_template("campaign.html.j2").render(
        plan=plan,
        keys=keys,
        groups=groups,
        measures=MEASURES,
        counts={e: sum(r["ending"] == e for r in rows) for e in (COMPLETED, STOPPED, FAILED)},
        left=len(plan.cases) - len(rows),
        bad=[(row, cases[row["case"]]) for row in bad[:MOST_ROWS]],
        more_bad=max(0, len(bad) - MOST_ROWS),
        rows=[(row, cases[row["case"]]) for row in sorted(shown, key=lambda r: r["case"])],
        more=max(0, len(rows) - MOST_ROWS),
        sheets=sheets(plates),
        facts=_facts(plan),
        names=name_of,
    )


def _facts(plan: Plan) -> list[str]:
    built = core.build_facts()
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return [
        f"{len(plan.cases)} runs",
        f"rthyb_rt {__version__}",
        f"compiler {built['compiler']}, {built['architecture']}",
        now.replace("T", " ").replace("+00:00", " UTC"),
    ]


def value(given: Any) -> str:
    """Return a chosen value as people read it."""
    if isinstance(given, bool):
        return "yes" if given else "no"
    return f"{given:g}" if isinstance(given, float) else str(given)


def name_of(row: Row, case: Case) -> str:
    """Return what tells a run from the others of its campaign."""
    parts = [value(v) for v in case.chosen.values()]
    if case.drawn > 0:
        parts.append(f"plant {case.drawn}")
    elif case.drawn == 0:
        parts.append("nominal plant")
    if case.repeat:
        parts.append(f"noise {case.repeat + 1}")
    return ", ".join(parts) or f"run {row['case']}"


def _plates(rows: Sequence[Row], keys: Sequence[str], groups: Sequence[Group]) -> list[Plate]:
    """Return the figure of response over tracking error, a point a run; none without points."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw

    points = [
        (
            tuple(row.get(key) for key in keys),
            100.0 * float(row["tracking_nrmse"]),
            100.0 * float(row["response_nrmse"]),
        )
        for row in rows
        if row["ending"] == COMPLETED and row.get("tracking_nrmse") and row.get("response_nrmse")
    ]
    if len(points) < 2:
        return []
    colours = (draw.BLUE, draw.ORANGE, draw.GREEN, draw.RED, draw.PURPLE, draw.BLACK, draw.GREY)
    with rc_context(draw.STYLE):
        paper = draw.Paper("errors", draw.FULL_WIDTH_IN, (2.6,), bottom_in=draw.room_below(
            min(len(groups), len(colours)), 3))  # fmt: skip
        (axes,) = paper.axes
        for number, one in enumerate(groups):
            own = np.array([p[1:] for p in points if p[0] == tuple(one.chosen.values())])
            if own.size:
                axes.plot(
                    own[:, 0], own[:, 1], ".", ms=4, alpha=0.7,
                    color=colours[number % len(colours)],
                    label=(", ".join(map(value, one.chosen.values())) or "all runs")
                    if number < len(colours) else None,
                )  # fmt: skip
        abscissae, ordinates = [p[1] for p in points], [p[2] for p in points]
        # Over less than a decade a logarithmic scale has no round numbers to show.
        axes.set_xscale("log" if max(abscissae) > 10.0 * min(abscissae) else "linear")
        axes.set_yscale("log" if max(ordinates) > 10.0 * min(ordinates) else "linear")
        axes.margins(0.04, 0.08)
        draw.head(axes, "Response error, %")
        draw.x_label(axes, "Tracking error, %")
        draw.legend_below(axes, 3)
        note = "Each point is a completed run; a colour is one choice of the campaign's lists."
        return [paper.plate("Response error over tracking error", note)]
