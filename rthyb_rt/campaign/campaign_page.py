"""A campaign as one page: medians and worst cases, what tripped and why, every run."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rthyb_rt import __version__, core
from rthyb_rt.campaign.groups import RunGroup, figure, group
from rthyb_rt.campaign.plan import COMPLETED, FAILED, STOPPED, Plan, PlannedRun, Row
from rthyb_rt.numbers import number
from rthyb_rt.record.recording import replacing
from rthyb_rt.report.html import environment, extra_needed, sheets

if TYPE_CHECKING:
    from rthyb_rt.report.drawing import Plate

PAGE: Final = "index.html"
MOST_ROWS: Final = 2000
"""Maximum of runs that the page lists: a browser is slow with more; the table has all of them."""
_HERE = Path(__file__).parent


def write(plan: Plan, rows: Sequence[Row], folder: Path) -> None:
    """Write ``index.html``, a self-contained file except for its links to the kept runs.

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
    groups = group(rows, keys, plan.measures)
    with extra_needed("the page of a campaign"):
        plates = _plates(rows, plan, groups)
        engine = environment(_HERE)
    engine.filters["figure"] = figure
    engine.filters["number"] = number
    engine.globals["value"] = value
    cases = {case.number: case for case in plan.cases}
    bad = [row for row in rows if row["ending"] != COMPLETED]
    shown = _shown(rows, groups)
    return engine.get_template("campaign.html.j2").render(
        plan=plan,
        keys=keys,
        groups=groups,
        measures=plan.measures,
        counts={e: sum(r["ending"] == e for r in rows) for e in (COMPLETED, STOPPED, FAILED)},
        left=len(plan.cases) - len(rows),
        bad=[(row, cases[row["case"]]) for row in bad[:MOST_ROWS]],
        more_bad=max(0, len(bad) - MOST_ROWS),
        rows=[(row, cases[row["case"]]) for row in shown],
        more=len(rows) - len(shown),
        sheets=sheets(plates),
        facts=_facts(plan),
        names=name_of,
    )


def _shown(rows: Sequence[Row], groups: Sequence[RunGroup]) -> list[Row]:
    """Return the runs that the page lists: the worst cases, to which it links, then the first."""
    worst = {spread.worst_case for one in groups for spread in one.spreads.values()}
    order = sorted(rows, key=lambda r: (r["case"] not in worst, r["ending"] == COMPLETED))
    return sorted(order[: max(MOST_ROWS, len(worst))], key=lambda r: int(r["case"]))


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
    """Return a chosen value as text."""
    if isinstance(given, bool):
        return "yes" if given else "no"
    return f"{given:g}" if isinstance(given, float) else str(given)


def name_of(row: Row, case: PlannedRun) -> str:
    """Return the values that distinguish a run from the others of its campaign."""
    parts = [value(v) for v in case.chosen.values()]
    if case.drawn > 0:
        parts.append(f"plant {case.drawn}")
    elif case.drawn == 0:
        parts.append("nominal plant")
    if case.repeat:
        parts.append(f"noise {case.repeat + 1}")
    return ", ".join(parts) or f"run {row['case']}"


def _plates(rows: Sequence[Row], plan: Plan, groups: Sequence[RunGroup]) -> list[Plate]:
    """Return the figure of the second measure over the first, one point per run, or none."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw

    first, second = plan.measures[:2]
    points: dict[tuple[Any, ...], list[tuple[float, float]]] = {}
    for row in rows:
        if row["ending"] == COMPLETED and row.get(first.name) and row.get(second.name):
            chosen = tuple(row.get(key) for key in plan.cases[0].chosen)
            place = (first.factor * row[first.name], second.factor * row[second.name])
            points.setdefault(chosen, []).append(place)
    if sum(map(len, points.values())) < 2:
        return []
    colours = (draw.BLUE, draw.ORANGE, draw.GREEN, draw.RED, draw.PURPLE, draw.BLACK)
    with rc_context(draw.STYLE):
        paper = draw.Paper("errors", draw.FULL_WIDTH_IN, (2.6,), bottom_in=draw.room_below(
            min(len(points), len(colours) + 1), 3))  # fmt: skip
        (axes,) = paper.axes
        seen = [one for one in groups if tuple(one.chosen.values()) in points]
        for number, one in enumerate(seen):
            own = np.array(points[tuple(one.chosen.values())])
            label = ", ".join(map(value, one.chosen.values())) or "all runs"
            named = number < len(colours)
            axes.plot(
                own[:, 0], own[:, 1], ".", ms=4, alpha=0.7,
                color=colours[number] if named else draw.GREY,
                label=label if named else "others" if number == len(colours) else None,
            )  # fmt: skip
        _scale(axes, [place for own in points.values() for place in own])
        draw.head(axes, f"{second.label}, {second.unit}")
        draw.x_label(axes, f"{first.label}, {first.unit}")
        draw.legend_below(axes, 3)
        note = (
            "Each point is one completed run; each colour is one combination of the values in "
            "the campaign's lists."
        )
        return [paper.plate(f"{second.label} over {first.label.lower()}", note)]


def _scale(axes: Any, points: Sequence[tuple[float, float]]) -> None:
    """Scale both axes; below one decade, a logarithmic axis has no round numbers to show."""
    for which, values in zip("xy", zip(*points, strict=True), strict=True):
        kind = "log" if max(values) > 10.0 * min(values) else "linear"
        axes.set(**{f"{which}scale": kind})
    axes.margins(0.04, 0.08)
