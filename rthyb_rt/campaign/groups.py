"""Statistics of the runs of a campaign: medians and worst cases for each chosen combination."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rthyb_rt.campaign.plan import COMPLETED, FAILED, MEASURES, STOPPED, Measure, Row
from rthyb_rt.config.campaignfile import Scalar
from rthyb_rt.numbers import number


@dataclass(frozen=True)
class Magnitudes:
    """The magnitudes of a measure over the completed runs of a group.

    Attributes:
        median, worst, mean: of these magnitudes.
        std: sample standard deviation; None for a single run.
        worst_case: number of the run with the largest magnitude.
    """

    median: float
    worst: float
    worst_case: int
    mean: float
    std: float | None


@dataclass(frozen=True)
class RunGroup:
    """Runs that differ only in their plant and noise.

    Attributes:
        chosen: their values from the campaign's lists.
        runs, completed, stopped, failed: numbers of runs; only completed runs enter the figures.
        spreads: spread of each measure, by name; omitted if no completed run has it.
    """

    chosen: dict[str, Scalar]
    runs: int
    completed: int
    stopped: int
    failed: int
    spreads: dict[str, Magnitudes]


def group(
    rows: Sequence[Row], keys: Sequence[str], measures: Sequence[Measure] = MEASURES
) -> list[RunGroup]:
    """Return the groups in the order of their first runs.

    Args:
        rows: rows of the runs, by number.
        keys: keys that the campaign varies by lists.
        measures: measures that are reported for each group.
    """
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row.get(key) for key in keys), []).append(row)
    return [
        RunGroup(
            chosen=dict(zip(keys, chosen, strict=True)),
            runs=len(members),
            completed=_count(members, COMPLETED),
            stopped=_count(members, STOPPED),
            failed=_count(members, FAILED),
            spreads=_spreads(members, measures),
        )
        for chosen, members in found.items()
    ]


def _count(rows: Sequence[Row], ending: str) -> int:
    return sum(row["ending"] == ending for row in rows)


def _spreads(rows: Sequence[Row], measures: Sequence[Measure]) -> dict[str, Magnitudes]:
    spreads = {}
    for measure in measures:
        known = [
            (abs(row[measure.name]), row["case"])
            for row in rows
            if row["ending"] == COMPLETED and row.get(measure.name) is not None
        ]
        if known:
            worst, case = max(known)
            values = [value for value, _ in known]
            spreads[measure.name] = Magnitudes(
                statistics.median(values), worst, case, statistics.fmean(values),
                statistics.stdev(values) if len(values) > 1 else None,
            )  # fmt: skip
    return spreads


def figure(spread: Magnitudes | None, measure: Measure) -> str:
    """Return median and worst case as text, ``1.2 (3.4)``."""
    if spread is None:
        return "–"
    median, worst = spread.median * measure.factor, spread.worst * measure.factor
    if median == worst:
        return number(median)
    return f"{number(median)} ({number(worst)})"
