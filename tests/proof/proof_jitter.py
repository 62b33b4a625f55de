"""The tick thread is as punctual as a bare one at the same time, whatever else is running."""

from __future__ import annotations

import pytest
from proof.conftest import Note

from rthyb_rt import core
from rthyb_rt.lab import jitter

SECONDS = 11.0
RATIO, MORE_NS = 1.25, 20_000


@pytest.fixture(scope="module")
def load() -> jitter.Load:
    """The work of one tick in the built-in test."""
    return jitter.Load.built_in()


@pytest.mark.parametrize("case", jitter.CASES, ids=lambda case: case.title)
def test_wake_up_is_as_punctual_as_that_of_a_bare_thread(
    case: jitter.KindOfRun, load: jitter.Load, note: Note
) -> None:
    cpu = jitter.choose_cpu(jitter.machine_facts())
    result = jitter.measure(case, round(SECONDS * core.FS_HZ), load, cpu)
    measured, reference = result.measured, result.reference
    p99_ns, bare_ns = (timing.wake.percentile_ns(99.0) for timing in (measured, reference))
    most_ns = RATIO * bare_ns + MORE_NS
    allowed = f"{most_ns / 1e3:.0f}; bare thread {bare_ns / 1e3:.1f}; run {result.attempts} x"
    note("wake-up p99", case.title, p99_ns / 1e3, "us", allowed)
    assert measured.counts.executed + measured.counts.skipped == measured.counts.elapsed
    if result.reference.wake.max_ns > jitter.REPEAT_ABOVE_NS:
        pytest.skip(f"the bare thread was over 10 ms late in {result.attempts} runs")
    assert "fifo" in measured.privileges, "real-time priority is needed, and was not granted"
    assert p99_ns <= most_ns
