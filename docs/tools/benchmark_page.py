"""Run the field's benchmark and write docs/benchmark.md and its picture.

``python docs/tools/benchmark_page.py`` renews what stands between the markers

    <!-- generated: NAME -->  ...  <!-- end -->

of the page. Runs are kept in build/benchmark-rths.json, part by part: ``--only PART`` does one of
them anew and takes the others from there, ``--only none`` draws from what is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import measuring
import numpy as np
import pictures
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from measuring import facts_text, markdown

from rthyb_rt.benchmark import benchmark_runs, benchmark_table, cases
from rthyb_rt.benchmark.benchmark_runs import BenchmarkRun, RunOutcome
from rthyb_rt.benchmark.benchmark_table import EntrantLine
from rthyb_rt.core.laws import LAWS
from rthyb_rt.report import drawing

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "benchmark.md"
PICTURE = ROOT / "docs" / "images" / "benchmark-rths.svg"
KEPT = ROOT / "build" / "benchmark-rths.json"
SHORT = ("J2", "J4", "J6", "J8", "true")
OURS = "inverse"
RIVALS = (OURS, "ats+rfc", "amb+rfc")
"""Our law, and the two published ones with the same force compensation."""
GOALS = {
    (4096, 1): {"J2": 2.57, "J4": 2.60, "J6": 0.20, "J8": 0.15, "true": 0.15, "high": 2.0},
    (4096, 4): {"J2": 2.02, "J4": 2.05, "J6": 0.20, "J8": 0.15, "true": 0.15, "high": 2.0},
    (1024, 1): {"J2": 1.30, "J4": 1.32, "J6": 0.20, "J8": 0.15, "true": 0.15, "high": 2.0},
    (1024, 4): {"J2": 1.02, "J4": 1.05, "J6": 0.20, "J8": 0.15, "true": 0.15, "high": 2.0},
}
"""Goals of `OURS`: largest means over the plants, by rate in Hz and case; a test compares them with
those of ``tests/bench/benchmark_limits.py``."""


def plan() -> dict[str, list[BenchmarkRun]]:
    """Return the runs behind the page, by part."""
    names = [one.name for one in cases.entrants()]
    rates = list(cases.RATES)
    return {
        "elcentro": benchmark_runs.planned(
            names, rates, [1, 4], ["elcentro"], benchmark_runs.seeds_of(20)
        ),
        "between": benchmark_runs.planned(
            names, rates, [2, 3], ["elcentro"], benchmark_runs.seeds_of(4)
        ),
        "motions": benchmark_runs.planned(
            names, rates, [1, 4], ["kobe", "morgan"], benchmark_runs.seeds_of(4)
        ),
        "limit": benchmark_runs.planned(RIVALS, rates, [3], ["kobe"], benchmark_runs.seeds_of(20)),
        "wide": benchmark_runs.planned(
            names, rates, [1, 4], ["elcentro"], benchmark_runs.seeds_of(20), width=3.0
        ),
        "yielding": benchmark_runs.planned(
            names, rates, [1, 4], ["elcentro"], benchmark_runs.seeds_of(2), yielding=True
        ),
        "noise": benchmark_runs.planned(
            RIVALS, [1024], [1, 4], ["elcentro"], benchmark_runs.seeds_of(20), noise=2.0
        ),
    }


def measure(part: str, wanted: Sequence[BenchmarkRun], jobs: int) -> None:
    """Do the runs of a part, and keep them."""
    measuring.measure(
        KEPT,
        part,
        len(wanted),
        lambda: benchmark_table.document(benchmark_runs.measured(wanted, jobs)),
    )


def outcome(kept: dict[str, Any]) -> RunOutcome:
    """Return a run that was kept."""
    figures, end, beyond = (kept.pop(key) for key in ("figures", "end", "beyond"))
    return RunOutcome(BenchmarkRun(**kept), end, figures, beyond)


# ---- tables -------------------------------------------------------------------------------------


def whole_table(lines: Sequence[EntrantLine], rate_hz: int) -> str:
    """Return cases 1 and 4 with all figures."""
    heads = ["law", "case", *benchmark_table.heads()]
    rows = [
        [f"`{line.entrant}`", str(line.case), *benchmark_table.cells(line)]
        for line in lines
        if line.rate_hz == rate_hz
    ]
    return markdown(heads, rows, 1)


def short_table(
    lines: Sequence[EntrantLine], kind: Callable[[EntrantLine], str], kinds: Sequence[str]
) -> str:
    """Return a line a law: the figures of `SHORT` as means, case 1 / case 4, in each kind."""
    rows = []
    for name in dict.fromkeys(line.entrant for line in lines):
        row = [f"`{name}`"]
        for wanted in kinds:
            own = [line for line in lines if line.entrant == name and kind(line) == wanted]
            row += [" / ".join(_mean(line, key) for line in own) for key in SHORT]
            lost = sum(one.unstable for one in own)
            whole = sum(one.runs - one.beyond for one in own)
            row.append(f"{lost} of {whole}")
        rows.append(row)
    heads = ["law"]
    for wanted in kinds:
        heads += [*(f"{wanted}: {SHORT[0]} %", *(f"{key} %" for key in SHORT[1:])), "unstable"]
    return markdown(heads, rows, 1)


def paired_table(outcomes: Sequence[RunOutcome], rate_hz: int) -> str:
    """Return our law beside its rivals and its goals, and on how many plants it is better.

    Every law meets the same plants, with the same noise, so that each plant is a pair.
    """
    keys = list(GOALS[rate_hz, 1])
    rows = []
    for case in (1, 4):
        by_law = {
            name: {
                one.run.plant: one.figures
                for one in outcomes
                if (one.run.entrant, one.run.rate_hz, one.run.case) == (name, rate_hz, case)
                and one.completed
            }
            for name in RIVALS
        }
        ours = by_law[OURS]
        for name, theirs in by_law.items():
            row = [str(case), f"`{name}`"]
            both = ours.keys() & theirs.keys()
            for key in keys:
                mean = benchmark_table.short(float(np.mean([f[key] for f in theirs.values()])))
                better = sum(ours[plant][key] < theirs[plant][key] for plant in both)
                row.append(mean if name == OURS else f"{mean} ({better} of {len(both)})")
            rows.append(row)
        goal = GOALS[rate_hz, case]
        rows.append([str(case), "goal", *(f"{goal[key]:.2f}" for key in keys)])
    units = {"high": "> 100 Hz µm"}
    return markdown(["case", "law", *(units.get(key, f"{key} %") for key in keys)], rows, 2)


def _case(line: EntrantLine) -> str:
    return f"case {line.case}"


def _motion(line: EntrantLine) -> str:
    return line.motion


def _mean(line: EntrantLine, key: str) -> str:
    return benchmark_table.short(line.mean[key]) if line.mean else "–"


def parts(found: dict[str, list[RunOutcome]], facts: dict[str, Any]) -> dict[str, str]:
    """Return what stands between the markers, by name."""
    made = {"facts": facts_text(facts)}
    lines = benchmark_table.lines(found["elcentro"])
    for rate in cases.RATES:
        made[f"elcentro-{rate}"] = whole_table(lines, rate)
        made[f"paired-{rate}"] = paired_table(found["elcentro"], rate)
    if "noise" in found:
        made["noise-1024"] = whole_table(benchmark_table.lines(found["noise"]), 1024)
    for part in [name for name in plan() if name in found and name not in ("elcentro", "noise")]:
        lines, kind = benchmark_table.lines(found[part]), _case if part == "between" else _motion
        for rate in cases.RATES:
            own = [line for line in lines if line.rate_hz == rate]
            made[f"{part}-{rate}"] = short_table(own, kind, list(dict.fromkeys(map(kind, own))))
    return made


# ---- the picture --------------------------------------------------------------------------------


def picture(outcomes: Sequence[RunOutcome]) -> str:
    """Return tracking against response error in case 1, every law a point with its spread."""
    with rc_context(drawing.STYLE):
        figure = Figure(figsize=(drawing.FULL_WIDTH_IN, 4.4))
        figure.patch.set_visible(False)
        for number, rate in enumerate(cases.RATES):
            axes = figure.add_axes((0.075 + 0.49 * number, 0.11, 0.42, 0.80))
            axes.patch.set_visible(False)
            _draw_rate(axes, [one for one in outcomes if _shown(one, rate)])
            axes.set_title(f"{rate} Hz", loc="left", fontsize=8.0)
            axes.set_xlabel("tracking error without noise, %")
            if number == 0:
                axes.set_ylabel("response error of storey 1 (J4), %")
        title = "Tracking against response error of every control law on the benchmark"
        return pictures.on_paper(drawing.to_svg(figure, "benchmark-rths", title))


def _shown(one: RunOutcome, rate: int) -> bool:
    return one.completed and one.run.rate_hz == rate and one.run.case == 1


def _draw_rate(axes: Any, outcomes: Sequence[RunOutcome]) -> None:
    names = list(dict.fromkeys(one.run.entrant for one in outcomes))
    named = []
    for name in names:
        own = [one.figures for one in outcomes if one.run.entrant == name]
        points = np.array([[found["true"], found["J4"]] for found in own])
        named.append((name, points, name in LAWS and LAWS[name].with_rfc))
    scatter(axes, named, (0.08, 250.0), (1.0, 300.0))


def scatter(
    axes: Any,
    named: Sequence[tuple[str, Any, bool]],
    across: tuple[float, float],
    up: tuple[float, float],
) -> None:
    """Draw laws as points with bars from the best to the worst plant, on two logarithmic axes.

    Args:
        axes: of a figure.
        named: name, points (plants, 2), and whether it is this program's own.
        across, up: limits.
    """
    for axis, limits in ((axes.xaxis, across), (axes.yaxis, up)):
        axis.axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}lim": limits})
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
    axes.grid(axis="both")
    places = []
    for name, points, ours in named:
        x, y = points.mean(axis=0)
        low, high = points.min(axis=0), points.max(axis=0)
        colour = drawing.BLUE if ours else drawing.GREY
        axes.plot([low[0], high[0]], [y, y], color=colour, linewidth=0.7)
        axes.plot([x, x], [low[1], high[1]], color=colour, linewidth=0.7)
        axes.plot([x], [y], "o", color=colour, markersize=3.2)
        places.append((name, x, y, colour))
    _name_points(axes, places)


def _name_points(axes: Any, places: Sequence[tuple[str, float, float, str]]) -> None:
    """Write the names beside the points, each clear of those above it."""
    last = np.inf
    for name, x, y, colour in sorted(places, key=lambda place: -place[2]):
        height = min(float(np.log10(y)), last - 0.055)
        last = height if last - float(np.log10(y)) < 0.4 else float(np.log10(y))
        place = (x * 1.12, 10**height)
        axes.annotate(name, (x, y), xytext=place, fontsize=6.5, color=colour, va="center")


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
