"""The tick thread is as punctual as a bare one at the same time, whatever else is running."""

from __future__ import annotations

import pytest
from proof.conftest import Note

from rthyb_rt import core
from rthyb_rt.lab import punctuality

SECONDS = 11.0
RATIO, MORE_NS = 1.25, 20_000


@pytest.fixture(scope="module")
def load() -> punctuality.Load:
    """The work of one tick in the built-in test."""
    return punctuality.Load.built_in()


@pytest.mark.parametrize("case", punctuality.CASES, ids=lambda case: case.title)
def test_wake_up_is_as_punctual_as_that_of_a_bare_thread(
    case: punctuality.KindOfRun, load: punctuality.Load, note: Note
) -> None:
    cpu = punctuality.choose_cpu(punctuality.machine_facts())
    result = punctuality.measure(case, round(SECONDS * core.FS_HZ), load, cpu)
    measured, reference = result.measured, result.reference
    p99_ns, bare_ns = (timing.wake.percentile_ns(99.0) for timing in (measured, reference))
    most_ns = RATIO * bare_ns + MORE_NS
    allowed = f"{most_ns / 1e3:.0f}; bare thread {bare_ns / 1e3:.1f}; run {result.attempts} x"
    note("wake-up p99", case.title, p99_ns / 1e3, "us", allowed)
    assert measured.counts.executed + measured.counts.skipped == measured.counts.elapsed
    if result.reference.wake.max_ns > punctuality.REPEAT_ABOVE_NS:
        pytest.skip(f"the bare thread was over 10 ms late in {result.attempts} runs")
    assert "fifo" in measured.privileges, "real-time priority is needed, and was not granted"
    assert p99_ns <= most_ns
