"""Run the multi-axial benchmark and write docs/benchmark-marths.md and its picture.

``python docs/tools/marths_page.py`` renews what stands between the page's markers; runs are kept in
build/benchmark-marths.json (see `measuring`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import measuring
import numpy as np
import pictures
from benchmark_page import scatter
from matplotlib import rc_context
from matplotlib.figure import Figure
from measuring import facts_text, markdown

from rthyb_rt.benchmark import marths, marths_laws, marths_table
from rthyb_rt.benchmark.marths import MarthsOutcome, MarthsRun
from rthyb_rt.report import drawing

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "benchmark-marths.md"
PICTURE = ROOT / "docs" / "images" / "benchmark-marths.svg"
KEPT = ROOT / "build" / "benchmark-marths.json"
OURS = ("lead", "lead-decoupled", "matrix", "matrix-inverse")


def plan() -> dict[str, list[MarthsRun]]:
    """Return the runs behind the page, by part."""
    names = list(marths_laws.NAMES)
    return {
        "elcentro": marths.planned(names, ["elcentro"], 20),
        "motions": marths.planned(names, ["kobe", "morgan"], 20),
        "kr-alpha": marths.planned(names, ["elcentro"], 20, "kr-alpha"),
        "wide": marths.planned(names, ["elcentro"], 20, width=3.0),
    }


def measure(part: str, wanted: Sequence[MarthsRun], jobs: int) -> None:
    """Do the runs of a part, and keep them."""
    measuring.measure(
        KEPT, part, len(wanted), lambda: marths_table.document(marths.measured(wanted, jobs))
    )


def outcome(kept: dict[str, Any]) -> MarthsOutcome:
    """Return a run that was kept."""
    figures = kept.pop("figures")
    return MarthsOutcome(MarthsRun(**kept), figures)


def table_of(outcomes: Sequence[MarthsOutcome], motion: str, names: Sequence[str]) -> str:
    """Return a line a law, with one motion."""
    rows = [
        [f"`{line.law}`", *marths_table.cells(line, names)]
        for line in marths_table.lines(outcomes)
        if line.motion == motion
    ]
    return markdown(["law", *marths_table.heads(names)], rows, 1)


def parts(found: dict[str, list[MarthsOutcome]], facts: dict[str, Any]) -> dict[str, str]:
    """Return what stands between the markers, by name."""
    made = {"facts": facts_text(facts)}
    made["laws"] = markdown(
        ["law", "what it is"],
        [[f"`{name}`", words] for name, words in marths_laws.NAMES.items()],
        2,
    )
    made["elcentro"] = table_of(found["elcentro"], "elcentro", marths_table.PUBLISHED)
    made["elcentro-beside"] = table_of(found["elcentro"], "elcentro", marths_table.BESIDE)
    for motion in ("kobe", "morgan"):
        made[motion] = table_of(found["motions"], motion, marths_table.PUBLISHED)
        made[f"{motion}-beside"] = table_of(found["motions"], motion, marths_table.BESIDE)
    names = ("J3", "J5", *marths_table.BESIDE)
    made["kr-alpha"] = table_of(found["kr-alpha"], "elcentro", names)
    made["wide"] = table_of(found["wide"], "elcentro", names)
    return made


def picture(outcomes: Sequence[MarthsOutcome]) -> str:
    """Return tracking against response error, every law a point with its spread, each actuator."""
    with rc_context(drawing.STYLE):
        figure = Figure(figsize=(drawing.FULL_WIDTH_IN, 4.0))
        figure.patch.set_visible(False)
        for number in (0, 1):
            axes = figure.add_axes((0.075 + 0.49 * number, 0.12, 0.42, 0.79))
            axes.patch.set_visible(False)
            named = [
                (name, _points(outcomes, name, number + 1), name in OURS)
                for name in marths_laws.NAMES
            ]
            scatter(axes, named, (0.1, 150.0), (0.03, 15.0))
            axes.set_title(f"actuator {number + 1}", loc="left", fontsize=8.0)
            axes.set_xlabel("tracking error without noise, %")
            if number == 0:
                axes.set_ylabel("response error of the upper storeys, joined, %")
        title = "Tracking against response error on the multi-axial benchmark"
        return pictures.on_paper(drawing.to_svg(figure, "benchmark-marths", title))


def _points(outcomes: Sequence[MarthsOutcome], name: str, axis: int) -> Any:
    own = [one.figures for one in outcomes if one.run.law == name and one.completed]
    return np.array(
        [
            [found[f"true.{axis}"], max(found[f"joined-upper.{i}"] for i in range(1, 5))]
            for found in own
        ]
    )


def main() -> None:
    """Measure, and write the page and its picture."""
    given = measuring.arguments(plan())
    for part, wanted in plan().items():
        if given.only in (None, part):
            measure(part, wanted, given.jobs)
    found, facts = measuring.kept(KEPT, outcome, "elcentro")
    made = parts(found, facts)
    measuring.renew(PAGE, made)
    PICTURE.write_text(picture(found["elcentro"]), encoding="utf-8")


if __name__ == "__main__":
    main()
