"""Runs of the multi-axial benchmark as a table: means over the plants, the worst in brackets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from rthyb_rt.benchmark import cases, marths, marths_laws
from rthyb_rt.benchmark.benchmark_table import facts, short
from rthyb_rt.benchmark.marths import MarthsOutcome

WITH_WORST: Final = ("J2", "joined-upper", "command")
"""Figures for which a table shows the worst plant after the mean."""
HEADS: Final = {
    "J1": "J1 ms",
    "true": "true %",
    "joined": "joined %",
    "joined-upper": "joined upper %",
    "command": "command mm",
    "force": "force kN",
}
PUBLISHED: Final = ("J1", "J2", "J3", "J5", "J6", "J7", "J8", "J9", "J10")
BESIDE: Final = ("J2", "true", "joined", "joined-upper", "command", "force")
"""Two tables: the benchmark's criteria, and what they do not show."""


@dataclass(frozen=True)
class MarthsLine:
    """All plants of one law with one motion.

    Attributes:
        law, motion, integrator: identification.
        runs: number of runs.
        unstable: number of runs that were not completed.
        mean, worst: of the completed runs, by figure and number; empty if there are none.
    """

    law: str
    motion: str
    integrator: str
    runs: int
    unstable: int
    mean: Mapping[str, float]
    worst: Mapping[str, float]


def lines(outcomes: Iterable[MarthsOutcome]) -> list[MarthsLine]:
    """Return a row for each kind of run, in the order in which they occur."""
    kinds: dict[tuple[str, str, str], list[MarthsOutcome]] = {}
    for one in outcomes:
        run = one.run
        kinds.setdefault((run.law, run.motion, run.integrator), []).append(one)
    return [_line(kind, found) for kind, found in kinds.items()]


def _line(kind: tuple[str, str, str], found: Sequence[MarthsOutcome]) -> MarthsLine:
    done = [one.figures for one in found if one.completed]
    keys = list(done[0]) if done else []
    columns = {key: np.array([one[key] for one in done]) for key in keys}
    return MarthsLine(
        *kind,
        len(found),
        len(found) - len(done),
        {key: float(values.mean()) for key, values in columns.items()},
        {key: float(values.max()) for key, values in columns.items()},
    )


def heads(names: Sequence[str]) -> list[str]:
    """Return the headings of the columns of figures."""
    return [HEADS.get(name, f"{name} %") for name in names] + ["unstable"]


def cells(line: MarthsLine, names: Sequence[str]) -> list[str]:
    """Return the cells below `heads`: a number per axis or coordinate, the worst in brackets."""
    found = []
    for name in names:
        if not line.mean:
            found.append("–")
            continue
        text = _several(line.mean, name)
        if name in WITH_WORST and line.runs - line.unstable > 1:
            text += f" ({_several(line.worst, name)})"
        found.append(text)
    return [*found, f"{line.unstable} of {line.runs}"]


def _several(figures: Mapping[str, float], name: str) -> str:
    values = [figures[f"{name}.{i + 1}"] for i in range(marths.COUNTS[name])]
    return "/".join(short(value) for value in values)


def document(outcomes: Sequence[MarthsOutcome]) -> dict[str, Any]:
    """Return everything in machine-readable form: facts, meanings, rows, and all runs."""
    return {
        "benchmark": "marths",
        "facts": facts(),
        "meanings": marths.MEANINGS,
        "laws": marths_laws.NAMES,
        "nominal_plant": marths.NOMINAL,
        "scale": cases.SCALE,
        "lines": [asdict(line) for line in lines(outcomes)],
        "runs": [{**asdict(one.run), "figures": one.figures} for one in outcomes],
    }
