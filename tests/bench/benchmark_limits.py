"""Check the goals for the law `inverse`: ``python tests/bench/benchmark_limits.py``.

All 21 plants at both rates: El Centro in cases 1 and 4 compared with figures set before the law was
written; every case and motion for unstable runs; plants with three times the spread; a yielding
specimen; sensors with twice the noise. Three minutes of computing time. Exit code 1 if a goal is
missed.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rthyb_rt.benchmark import benchmark_runs, benchmark_table, cases
from rthyb_rt.benchmark.benchmark_runs import RunOutcome
from rthyb_rt.benchmark.benchmark_table import EntrantLine
from rthyb_rt.campaign import pools

LAW = "inverse"
GOALS = {
    (4096, 1): {"J2": 2.57, "J4": 2.60},
    (4096, 4): {"J2": 2.02, "J4": 2.05},
    (1024, 1): {"J2": 1.30, "J4": 1.32},
    (1024, 4): {"J2": 1.02, "J4": 1.05},
}
"""Largest mean over the plants, %, for El Centro, by rate and case."""
EVERYWHERE = {"J6": 0.20, "J8": 0.15, "true": 0.15, "high": 2.0}
"""The same at both rates and in both cases; ``high`` in um."""
WORST = {"J2": 0.1, "J4": 0.1}
"""Largest excess of the worst plant over the mean, percentage points."""
YIELDING = {4096: {"J4": 3.6}, 1024: {"J4": 2.65}}
"""The same for a yielding specimen, case 1, by rate."""
NOISE = 2.0
NOISY = {1024: {"high": 3.0}}
"""The same with twice the benchmark's noise, which at 1024 Hz are the 16 um of its own rate."""
WIDE_WORST = 1.05
"""Largest ratio of the tracking error on the worst plant to the mean, with three times the spread.
J2 is relative to the plant's own motion, which in case 4 is 8.6 % below the mean for one of them:
J2 of a perfect law, the sensor's noise alone, is 9 % above its mean there. The error is therefore
compared as a length."""


@dataclass(frozen=True)
class Goal:
    """One figure and its upper limit."""

    what: str
    found: float
    most: float

    @property
    def met(self) -> bool:
        """Whether it is met; NaN is not."""
        return self.found <= self.most


def goals(
    usual: Sequence[RunOutcome],
    wide: Sequence[RunOutcome],
    yielding: Sequence[RunOutcome],
    noisy: Sequence[RunOutcome],
) -> list[Goal]:
    """Return every goal with the measured figure.

    Args:
        usual: plants with the benchmark's spread; all cases and motions.
        wide: plants with three times the spread.
        yielding: plants with a yielding specimen.
        noisy: sensors with `NOISE` times the noise.
    """
    found: list[Goal] = []
    lines = benchmark_table.lines(usual)
    for line in lines:
        if line.motion == "elcentro" and (line.rate_hz, line.case) in GOALS:
            found += _of_line(line)
    found += _of_wide(wide)
    for kind, runs, most in (("yielding", yielding, YIELDING), ("noisy", noisy, NOISY)):
        found += _of_means(benchmark_table.lines(runs), kind, most)
    everything = [*usual, *wide, *yielding, *noisy]
    unstable = sum(line.unstable for line in benchmark_table.lines(everything))
    count = len(everything)
    found.append(Goal(f"unstable of {count} runs", unstable, 0))
    return found


def _of_line(line: EntrantLine) -> Iterator[Goal]:
    where = f"{line.rate_hz} Hz, case {line.case}: "
    for key, most in (GOALS[line.rate_hz, line.case] | EVERYWHERE).items():
        yield Goal(f"{where}{key}", line.mean[key], most)
    for key, most in WORST.items():
        yield Goal(f"{where}{key}, worst less mean", line.worst[key] - line.mean[key], most)


def _of_means(
    lines: Sequence[EntrantLine], kind: str, most: dict[int, dict[str, float]]
) -> Iterator[Goal]:
    for line in lines:
        for key, value in most.get(line.rate_hz, {}).items():
            where = f"{line.rate_hz} Hz, case {line.case}, {kind}: {key}"
            yield Goal(where, line.mean.get(key, math.nan), value)


def _of_wide(outcomes: Sequence[RunOutcome]) -> Iterator[Goal]:
    lengths: dict[tuple[int, int], list[float]] = {}
    for one in outcomes:
        if one.completed:
            motion_m = np.std(benchmark_runs.reference(benchmark_runs.prepared(one.run))[0])
            kind = one.run.rate_hz, one.run.case
            lengths.setdefault(kind, []).append(one.figures["J2"] * motion_m)
    for (rate_hz, case), found in lengths.items():
        what = f"{rate_hz} Hz, case {case}, wide: worst tracking over mean"
        yield Goal(what, max(found) / float(np.mean(found)), WIDE_WORST)


def main() -> int:
    """Measure, print, and return the exit code."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--jobs", type=int, default=pools.processors())
    jobs = arguments.parse_args().jobs
    rates, seeds = list(cases.RATES), benchmark_runs.seeds_of(20)
    usual = benchmark_runs.planned([LAW], rates, list(cases.CASES), list(cases.MOTIONS), seeds)
    wide = benchmark_runs.planned([LAW], rates, [1, 4], ["elcentro"], seeds, width=3.0)
    yielding = benchmark_runs.planned([LAW], rates, [1], ["elcentro"], seeds, yielding=True)
    noisy = benchmark_runs.planned([LAW], list(NOISY), [1, 4], ["elcentro"], seeds, noise=NOISE)
    found = goals(*(benchmark_runs.measured(some, jobs) for some in (usual, wide, yielding, noisy)))
    for goal in found:
        verdict = "" if goal.met else "   MISSED"
        print(f"{goal.what:52} {goal.found:8.3f}  at most {goal.most:g}{verdict}")
    missed = sum(not goal.met for goal in found)
    print(f"{LAW}: {len(found) - missed} of {len(found)} goals met")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
