"""Runs of the benchmark, one by one or with several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np

from rthyb_rt.benchmark import cases, criteria
from rthyb_rt.campaign import pools
from rthyb_rt.errors import InputError, Problem
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import RecordedTest

NOMINAL: Final = 0
"""Used instead of a seed for the plant without perturbation."""


@dataclass(frozen=True)
class BenchmarkRun:
    """One run.

    Attributes:
        entrant: name of the entrant.
        rate_hz: one of `cases.RATES`.
        case: one of `cases.CASES`.
        motion: one of `cases.MOTIONS`.
        plant: the seed of a perturbed plant, or `NOMINAL`.
        width: size of the perturbation, in the benchmark's standard deviations.
        yielding: whether the specimen yields.
        noise: size of the sensors' noise, as a multiple of the benchmark's density.
    """

    entrant: str
    rate_hz: int
    case: int
    motion: str
    plant: int = NOMINAL
    width: float = 1.0
    yielding: bool = False
    noise: float = 1.0


@dataclass(frozen=True)
class RunOutcome:
    """Result of a run.

    Attributes:
        run: the run.
        end: how it ended, "completed" for a complete run; in the benchmark's own evaluation, a
            force of 8900 N ends a run.
        figures: J1 to J9 and the others of `criteria.MEANINGS`; empty if it was not completed.
        beyond: whether it was not completed, and could not be with any law: see `is_beyond`.
    """

    run: BenchmarkRun
    end: str
    figures: dict[str, float]
    beyond: bool = False

    @property
    def completed(self) -> bool:
        """Whether the run was completed."""
        return bool(self.figures)


def planned(
    entrants: Sequence[str],
    rates: Sequence[int],
    numbers: Sequence[int],
    motions: Sequence[str],
    seeds: Sequence[int],
    *,
    width: float = 1.0,
    yielding: bool = False,
    noise: float = 1.0,
) -> list[BenchmarkRun]:
    """Return all combinations as runs, each on every plant.

    Args:
        entrants, rates, numbers, motions: values to combine; ``numbers`` are `cases.CASES`.
        seeds: seeds of plants, or `NOMINAL`; `seeds_of` returns the benchmark's.
        width, yielding, noise: as in `BenchmarkRun`.

    Raises:
        InputError: there is no such entrant, rate, case, motion or plant, or one is given twice.
    """
    require_once(
        {"--law": entrants, "--rate": rates, "--case": numbers, "--motion": motions}
        | {"--plant": seeds}
    )
    for name in entrants:
        cases.entrant(name)
    _known(rates, cases.RATES, "--rate", "Hz")
    _known(numbers, cases.CASES, "--case", "")
    _known(motions, cases.MOTIONS, "--motion", "")
    for seed in seeds:
        if seed not in (NOMINAL, *cases.SEEDS):
            raise InputError(
                f"found {seed}; must be {NOMINAL}, the nominal plant, or the seed of a perturbed "
                f"one, {cases.SEEDS[0]} to {cases.SEEDS[-1]}",
                "--plant",
            )
    return [
        BenchmarkRun(name, rate, case, motion, seed, width, yielding, noise)
        for rate in rates
        for motion in motions
        for name in entrants
        for case in numbers
        for seed in seeds
    ]


def seeds_of(perturbed: int) -> tuple[int, ...]:
    """Return the nominal plant and the seeds of this number of perturbed ones.

    Raises:
        InputError: there are not as many.
    """
    if not 0 <= perturbed <= len(cases.SEEDS):
        raise InputError(
            f"found {perturbed}; must be 0 to {len(cases.SEEDS)} perturbed plants, in addition to "
            "the nominal one",
            "--plants",
        )
    return (NOMINAL, *cases.SEEDS[:perturbed])


def require_once(given: Mapping[str, Sequence[Any]]) -> None:
    """Reject values that occur twice: their runs would be counted twice in one row of the table.

    Args:
        given: the values, by the option that has them.

    Raises:
        InputError: names the first such value of each option.
    """
    problems = []
    for where, values in given.items():
        twice = next((one for n, one in enumerate(values) if one in values[:n]), None)
        if twice is not None:
            problems.append(Problem(where, f"found {twice} twice; give each value once"))
    if problems:
        raise InputError(problems)


def _known(found: Sequence[Any], known: Any, where: str, unit: str) -> None:
    for one in found:
        if one not in known:
            allowed = ", ".join(str(value) for value in known)
            raise InputError(f"found {one}; must be one of {allowed} {unit}".rstrip(), where)


def prepared(run: BenchmarkRun) -> Setup:
    """Return a run as a test of this program, ready to run."""
    who = cases.entrant(run.entrant)
    seed = None if run.plant == NOMINAL else run.plant
    rig = cases.rig_of(
        who, seed, run.rate_hz, width=run.width, yielding=run.yielding, noise=run.noise
    )
    test = cases.test_of(who, run.case, run.rate_hz)
    return experiment.prepare(test, rig, record=cases.motion(run.motion))


def recorded(setup: Setup) -> RecordedTest:
    """Carry out a run in virtual time, with the additional data that `figures_of` requires."""
    return virtual_time.run(setup, truth=True, freedoms=True)


def measure(run: BenchmarkRun) -> RunOutcome:
    """Carry out one run in virtual time, and evaluate it."""
    setup = prepared(run)
    rec = recorded(setup)
    end = str(rec.meta["end_reason"])
    if end != "completed":
        return RunOutcome(run, end, {}, is_beyond(setup))
    return RunOutcome(run, end, figures_of(setup, rec))


def is_beyond(setup: Setup) -> bool:
    """Return whether the reference simulation of a run itself exceeds the force limit.

    This is the case for Kobe in case 3, on the stiffest eight of the 21 plants: the limit would end
    the run even with a perfect control law.
    """
    limit = setup.rig.limits.force_n
    force_n = reference(setup)[2]
    return limit is not None and float(np.abs(force_n).max()) > limit.value


def reference(setup: Setup) -> tuple[criteria.Floats, ...]:
    """Return the reference simulation of a run: the structure joined to the plant's own specimen.

    Displacement, velocity and force of the interface, (n,) each, and the displacement of every
    storey, (n, 3).
    """
    structure = setup.derived.structure
    if structure is None:
        raise ValueError("the numerical part of a benchmark run must be given by matrices")
    elements = experiment.specimen_elements(setup.rig)
    return structure.whole_reference(elements, setup.ag_mps2)


def figures_of(setup: Setup, rec: RecordedTest) -> dict[str, float]:
    """Return the figures of a completed run over the whole record, including rest."""
    rows = rec.samples[rec.running()][: setup.ticks]
    storeys_m = reference(setup)[3][: rows.size]
    return criteria.figures(
        rows["x_num_m"],
        rows["x_meas_m"],
        rows["x_true_m"],
        rows["x_cmd_m"],
        np.column_stack([rows["x_part_2_m"], rows["x_part_3_m"]]),
        storeys_m,
        setup.derived.fs_hz,
    )


Item = TypeVar("Item")
Found = TypeVar("Found")
Tell = Callable[[int, int, str], None]

_CHUNK: Final = 4


def measured(
    runs: Sequence[BenchmarkRun], jobs: int = 1, tell: Tell | None = None
) -> list[RunOutcome]:
    """Carry out runs, in their order, with the given number of processes.

    Args:
        runs: the runs.
        jobs: number of processes that compute, each with one thread.
        tell: called with (runs done, total runs, the entrant) after each.

    Raises:
        InputError: the number of processes is below one.
    """
    outcomes = []
    for outcome in each(measure, runs, jobs):
        outcomes.append(outcome)
        if tell is not None:
            tell(len(outcomes), len(runs), outcome.run.entrant)
    return outcomes


def each(do: Callable[[Item], Found], items: Sequence[Item], jobs: int) -> Iterator[Found]:
    """Yield the result of a function for each item, in order, using the given number of processes.

    Even a single run has a process of its own: the linear algebra library of this one has already
    started its threads, which would make a run slower than on one processor.

    Args:
        do: a function that a new process can import.
        items: its arguments, one for each call.
        jobs: number of processes, each with one thread.

    Raises:
        InputError: the number of processes is below one.
    """
    if jobs < 1:
        raise InputError(f"found {jobs}; must be at least 1 process", "--jobs")
    if not items:
        return
    processes = min(jobs, len(items))
    with pools.workers(processes) as pool:
        # Few items are spread over all processes.
        share = max(1, min(_CHUNK, len(items) // processes))
        yield from pool.map(do, items, chunksize=share)
