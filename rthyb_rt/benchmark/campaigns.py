"""The benchmark as a campaign: its runs are saved one by one, with a table and a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from rthyb_rt import config
from rthyb_rt.benchmark import benchmark_runs, cases
from rthyb_rt.benchmark.benchmark_runs import NOMINAL, BenchmarkRun
from rthyb_rt.campaign import plan
from rthyb_rt.campaign.plan import COMPLETED, Measure, Plan, PlannedRun, Row
from rthyb_rt.config.campaignfile import BENCHMARK_KEYS, CampaignFile, Scalar
from rthyb_rt.errors import InputError, Problem
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import RecordedTest

MEASURES: Final = (
    Measure("true", "Tracking without noise", "%", 1.0),
    Measure("J4", "Storey 1, J4", "%", 1.0),
    Measure("J2", "Tracking, J2", "%", 1.0),
    Measure("J6", "Storey 2, J6", "%", 1.0),
    Measure("J8", "Its peak, J8", "%", 1.0),
    Measure("high", "Command above 100 Hz", "µm", 1.0),
)
"""Figures of `criteria.MEANINGS` that are shown for each group of runs."""


@dataclass(frozen=True)
class BenchmarkCase(PlannedRun):
    """A run of the benchmark, which has its own test and rig, and its own figures.

    Attributes:
        run: the run.
    """

    run: BenchmarkRun

    def command(self) -> str:
        """Return the command line that repeats this run."""
        run = self.run
        words = ["rthyb benchmark rths", f"--law {run.entrant}", f"--rate {run.rate_hz}"]
        words += [f"--case {run.case}", f"--motion {run.motion}", f"--plant {run.plant}"]
        words += [f"--width {run.width:g}"] if run.width != 1.0 else []
        words += ["--yielding"] if run.yielding else []
        words += [f"--noise {run.noise:g}"] if run.noise != 1.0 else []
        return " ".join(words)

    def identity(self) -> Row:
        """Return the columns of its row that identify the run, with the seed of its plant."""
        row = super().identity()
        return row | {"plant": self.run.plant}

    def prepared(self) -> Setup:
        """Return the test, ready to run."""
        return benchmark_runs.prepared(self.run)

    def recorded(self, setup: Setup) -> RecordedTest:
        """Run it in virtual time, with the additional data that the figures require."""
        return benchmark_runs.recorded(setup)

    def measured(self, setup: Setup, rec: RecordedTest) -> Row:
        """Return ``ending``, ``cause`` and the figures of `criteria.MEANINGS`.

        ``beyond`` is returned for a run that reached its force limit: whether no law could avoid
        this.
        """
        row = plan.ended(rec)
        if row["ending"] != COMPLETED:
            beyond = benchmark_runs.is_beyond(setup)
            own = "; the reference simulation of this plant exceeds that limit as well"
            return row | {"cause": row["cause"] + (own if beyond else ""), "beyond": beyond}
        figures = benchmark_runs.figures_of(setup, rec)
        return row | {key: v if math.isfinite(v) else None for key, v in figures.items()}


def read(path: str | Path) -> Plan:
    """Return the runs of a campaign file, of a test or of the benchmark.

    Raises:
        InputError: with all errors in the file, or in the test or the rig of its first run, or with
            values that the benchmark does not have.
    """
    path = Path(path)
    file = config.parse_campaign(config.read_text(path, "campaign"), str(path))
    return plan.of(file, path) if file.benchmark is None else of(file, path)


def of(file: CampaignFile, path: Path) -> Plan:
    """Return the runs of a benchmark campaign; keys that it does not give include everything.

    Args:
        file: the campaign.
        path: path of its file.

    Raises:
        InputError: there is no such law, rate, motion or case.
    """
    wanted = file.benchmark
    if wanted is None:
        raise ValueError("the campaign has no [benchmark]")
    known: dict[str, Sequence[Any]] = {
        "rate_hz": list(cases.RATES),
        "motion": list(cases.MOTIONS),
        "law": [one.name for one in cases.entrants()],
        "structure": list(cases.CASES),
    }
    rates, motions, laws, numbers = (file.over.get(key, known[key]) for key in BENCHMARK_KEYS)
    try:
        planned = benchmark_runs.planned(
            [str(law) for law in laws],
            cast(Sequence[int], rates),
            cast(Sequence[int], numbers),
            [str(motion) for motion in motions],
            benchmark_runs.seeds_of(wanted.plants),
            width=wanted.width,
            yielding=wanted.yielding,
            noise=wanted.noise,
        )
    except InputError as error:
        raise InputError(_placed(problem, file) for problem in error.problems) from error
    found = tuple(_case(number, run) for number, run in enumerate(planned))
    return Plan(file.campaign.name, file.campaign.keep, found, plan.fingerprint(found), MEASURES)


def _placed(problem: Problem, file: CampaignFile) -> Problem:
    """Return an error in an option of `rthyb benchmark` as one in the corresponding key."""
    key = {"--rate": "rate_hz", "--case": "structure"}.get(problem.where, problem.where.strip("-"))
    return Problem(file.source.place(("over", key)), problem.message)


def _case(number: int, run: BenchmarkRun) -> BenchmarkCase:
    chosen: dict[str, Scalar] = {
        "rate_hz": run.rate_hz,
        "motion": run.motion,
        "law": run.entrant,
        "structure": run.case,
    }
    drawn = 0 if run.plant == NOMINAL else cases.SEEDS.index(run.plant) + 1
    return BenchmarkCase(number, chosen, drawn, 0, "", "", (), run)
