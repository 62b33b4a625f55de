"""The goals of the benchmark: one that is missed is told, and ends with another exit code."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from bench import benchmark_limits as limits

from rthyb_rt.benchmark import benchmark_runs, criteria
from rthyb_rt.benchmark.benchmark_runs import BenchmarkRun, RunOutcome

GOOD = dict.fromkeys(criteria.MEANINGS, 0.1)


def outcomes(rate_hz: int, case: int, *figures: dict[str, float]) -> list[RunOutcome]:
    return [
        RunOutcome(BenchmarkRun(limits.LAW, rate_hz, case, "elcentro", plant), "completed", one)
        for plant, one in enumerate(figures)
    ]


def missed(
    usual: list[RunOutcome],
    wide: list[RunOutcome] | None = None,
    yielding: list[RunOutcome] | None = None,
    noisy: list[RunOutcome] | None = None,
) -> list[str]:
    found = limits.goals(usual, wide or [], yielding or [], noisy or [])
    return [goal.what for goal in found if not goal.met]


@pytest.mark.parametrize(("rate_hz", "case"), list(limits.GOALS))
def test_each_goal_is_missed_by_a_mean_just_above_it_and_met_just_below(
    rate_hz: int, case: int
) -> None:
    for key, most in (limits.GOALS[rate_hz, case] | limits.EVERYWHERE).items():
        below, above = (GOOD | {key: share * most} for share in (0.999, 1.001))
        assert missed(outcomes(rate_hz, case, below, below)) == []
        assert missed(outcomes(rate_hz, case, above, above)) == [
            f"{rate_hz} Hz, case {case}: {key}"
        ]


def test_one_plant_that_is_worse_than_the_others_is_told() -> None:
    usual = outcomes(4096, 1, GOOD, GOOD | {"J4": 0.32})
    assert missed(usual) == ["4096 Hz, case 1: J4, worst less mean"]


@pytest.mark.parametrize("rate_hz", list(limits.YIELDING))
def test_a_specimen_that_yields_has_a_goal_of_its_own(rate_hz: int) -> None:
    most = limits.YIELDING[rate_hz]["J4"]
    assert missed([], yielding=outcomes(rate_hz, 1, GOOD | {"J4": 0.999 * most})) == []
    assert missed([], yielding=outcomes(rate_hz, 1, GOOD | {"J4": 1.001 * most})) == [
        f"{rate_hz} Hz, case 1, yielding: J4"
    ]


def test_a_command_made_rough_by_noisy_sensors_is_told() -> None:
    most = limits.NOISY[1024]["high"]
    assert missed([], noisy=outcomes(1024, 4, GOOD | {"high": 0.999 * most})) == []
    assert missed([], noisy=outcomes(1024, 4, GOOD | {"high": 1.001 * most})) == [
        "1024 Hz, case 4, noisy: high"
    ]


def test_an_unstable_run_is_told_and_one_beyond_the_rig_is_none() -> None:
    run = BenchmarkRun(limits.LAW, 1024, 3, "kobe", 7001)
    assert missed([RunOutcome(run, "force limit", {})]) == ["unstable of 1 runs"]
    assert missed([RunOutcome(run, "force limit", {}, beyond=True)]) == []


def test_wide_plants_are_judged_by_the_length_of_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plant that moves half as far has twice the J2 by the sensor's noise alone."""
    by_plant = {0: [0.0, 2.0], 1: [0.0, 1.0]}
    monkeypatch.setattr(benchmark_runs, "prepared", lambda run: run.plant)
    monkeypatch.setattr(benchmark_runs, "reference", lambda plant: (by_plant[plant],))
    wide = outcomes(1024, 4, GOOD, GOOD | {"J2": 0.2})
    assert missed([], wide) == []
    wide = outcomes(1024, 4, GOOD, GOOD | {"J2": 0.3})
    assert missed([], wide) == ["1024 Hz, case 4, wide: worst tracking over mean"]


def test_the_exit_code_says_whether_every_goal_is_met(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark_limits.py", "--jobs", "1"])
    for j2, code in ((2.5, 0), (2.6, 1)):
        found = outcomes(4096, 1, GOOD | {"J2": j2})
        monkeypatch.setattr(benchmark_runs, "measured", lambda wanted, jobs, found=found: found)
        assert limits.main() == code


def test_the_page_shows_the_goals_that_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "docs" / "tools"))
    page = importlib.import_module("benchmark_page")
    assert page.OURS == limits.LAW
    assert {key: goals | limits.EVERYWHERE for key, goals in limits.GOALS.items()} == page.GOALS
