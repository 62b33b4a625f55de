"""Runs of one kind as one row: means, the worst plant, number of unstable runs."""

from __future__ import annotations

import datetime
import math
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from rthyb_rt import __version__, core
from rthyb_rt.benchmark import cases, criteria
from rthyb_rt.benchmark.benchmark_runs import NOMINAL, RunOutcome
from rthyb_rt.lab import punctuality

WITH_WORST: Final = ("J2", "J4", "J6", "J8", "true")
"""Figures for which a table shows the worst plant beside the mean."""


@dataclass(frozen=True)
class EntrantLine:
    """All plants of one entrant in one case, at one rate, with one motion.

    Attributes:
        entrant, rate_hz, case, motion: identification.
        runs: number of runs.
        unstable: number of runs that were not completed.
        beyond: number of runs that no law could complete; not counted as unstable.
        mean, worst, deviation: of the completed runs, by figure; empty if there are none.
    """

    entrant: str
    rate_hz: int
    motion: str
    case: int
    runs: int
    unstable: int
    beyond: int
    mean: Mapping[str, float]
    worst: Mapping[str, float]
    deviation: Mapping[str, float]


def lines(outcomes: Iterable[RunOutcome]) -> list[EntrantLine]:
    """Return a row for each kind of run, in the order in which they occur."""
    kinds: dict[tuple[int, str, str, int], list[RunOutcome]] = {}
    for one in outcomes:
        run = one.run
        kinds.setdefault((run.rate_hz, run.motion, run.entrant, run.case), []).append(one)
    return [_line(kind, found) for kind, found in kinds.items()]


def _line(kind: tuple[int, str, str, int], found: Sequence[RunOutcome]) -> EntrantLine:
    rate_hz, motion, name, case = kind
    done = [one.figures for one in found if one.completed]
    beyond = sum(one.beyond for one in found)
    columns = {
        key: np.array([one[key] for one in done]) for key in (criteria.MEANINGS if done else ())
    }
    return EntrantLine(
        name,
        rate_hz,
        motion,
        case,
        len(found),
        len(found) - len(done) - beyond,
        beyond,
        {key: float(values.mean()) for key, values in columns.items()},
        {key: float(values.max()) for key, values in columns.items()},
        {key: float(values.std()) for key, values in columns.items()},
    )


def heads() -> list[str]:
    """Return the headings of the columns after entrant and case."""
    units = {"J1": "J1 ms", "true": "true %", "high": "> 100 Hz µm"}
    return [units.get(key, f"{key} %") for key in criteria.MEANINGS] + ["unstable"]


def cells(line: EntrantLine) -> list[str]:
    """Return the cells below `heads`: a mean, followed by the worst plant if relevant."""
    found = []
    for key in criteria.MEANINGS:
        if not line.mean:
            found.append("–")
            continue
        text = short(line.mean[key])
        if key in WITH_WORST and line.runs - line.unstable - line.beyond > 1:
            text += f"/{short(line.worst[key])}"
        found.append(text)
    return [*found, f"{line.unstable} of {line.runs - line.beyond}"]


def remarks(found: Sequence[EntrantLine]) -> list[str]:
    """Return a sentence for each row of which runs are missing that no law could complete."""
    return [
        f"{line.entrant}, case {line.case}, {line.motion}, {line.rate_hz} Hz: {line.beyond} of "
        f"{line.runs} runs ended at the force limit, which the reference simulation of their plant "
        "exceeds as well, so they are not counted as unstable; the figures are those of the other "
        f"{line.runs - line.beyond}."
        for line in found
        if line.beyond
    ]


def short(value: float) -> str:
    """Return a figure with the digits relevant in a table."""
    if not math.isfinite(value):
        return "–"
    return (
        f"{value:.2f}"
        if abs(value) < 10
        else f"{value:.1f}"
        if abs(value) < 100
        else f"{value:.0f}"
    )


def facts() -> dict[str, Any]:
    """Return what the figures depend on, and their sources."""
    return {
        "rthyb": __version__,
        **core.build_facts(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "processor": punctuality.processor(),
        "processors": os.cpu_count(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }


def document(outcomes: Sequence[RunOutcome]) -> dict[str, Any]:
    """Return everything in machine-readable form: facts, meanings, rows, and all runs."""
    return {
        "benchmark": "rths",
        "facts": facts(),
        "meanings": criteria.MEANINGS,
        "nominal_plant": NOMINAL,
        "motions": {name: cases.MOTIONS[name] for name in cases.MOTIONS},
        "scale": cases.SCALE,
        "lines": [asdict(line) for line in lines(outcomes)],
        "runs": [
            {**asdict(one.run), "end": one.end, "beyond": one.beyond, "figures": one.figures}
            for one in outcomes
        ],
    }
