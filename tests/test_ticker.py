"""The clock of the tick thread: exact due times, skips that keep the phase, real-time threads."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rthyb_rt import core
from rthyb_rt.core import ticker
from rthyb_rt.core.ticker import Latency, Tick, Ticker

pytestmark = pytest.mark.alone

PERIOD = Fraction(10**9, 1024)
YEAR_TICKS = 366 * 86400 * 1024
TIMEOUT_S = 60.0


def due_exactly(t0_ns: int, k: int) -> int:
    return t0_ns + int(k * PERIOD)  # rounded down


def in_thread(work: Callable[[], Any]) -> Any:
    """Run something in a thread of its own and return what it returns."""
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    thread.join(TIMEOUT_S)
    assert found, "the thread did not end"
    return found[0]


# ---- due times ----------------------------------------------------------------------------------


@given(t0=st.integers(0, 10**18), k=st.integers(0, 100 * YEAR_TICKS))
def test_due_times_are_exact_for_a_hundred_years(t0: int, k: int) -> None:
    assert Ticker(t0_ns=t0).due_ns(k) == due_exactly(t0, k)


@given(rate_hz=st.integers(256, 4096), t0=st.integers(0, 10**18), seconds=st.integers(0, 3 * 10**9),
       more=st.integers(0, 4095))  # fmt: skip
def test_due_times_are_exact_at_every_rate(rate_hz: int, t0: int, seconds: int, more: int) -> None:
    k = rate_hz * seconds + more
    assert Ticker(t0_ns=t0, rate_hz=rate_hz).due_ns(k) == t0 + k * 10**9 // rate_hz


@given(rate_hz=st.integers(256, 4096), after_ns=st.integers(0, 10**13))
def test_the_newest_tick_that_is_due_is_taken_at_every_rate(rate_hz: int, after_ns: int) -> None:
    clock = Ticker(t0_ns=7, rate_hz=rate_hz)
    tick = clock.woken(7 + after_ns)
    assert tick.due_ns <= 7 + after_ns < clock.due_ns(tick.k + 1)
    assert clock.rate_hz == rate_hz


@pytest.mark.parametrize("rate_hz", [-1024, 0, 255, 4097, 10**9])
def test_a_rate_out_of_range_is_refused(rate_hz: int) -> None:
    with pytest.raises(core.CoreError, match=rf"{rate_hz} Hz.*256 to 4096 Hz"):
        Ticker(rate_hz=rate_hz)


@pytest.mark.parametrize(("rate_hz", "most_ns"), [(256, 781), (512, 391), (2048, 98), (4096, 49)])
def test_a_drives_clock_is_followed_by_200_ppm_at_every_rate(rate_hz: int, most_ns: int) -> None:
    clock = Ticker(rate_hz=rate_hz)
    assert most_ns == pytest.approx(200e-6 * 1e9 / rate_hz, abs=0.5)
    for sign in (1, -1):
        before = clock.due_ns(rate_hz)
        clock.trim(sign * 10**9)
        assert clock.due_ns(rate_hz) - before == sign * most_ns


def test_a_second_of_ticks_is_a_second_for_ever() -> None:
    clock = Ticker(t0_ns=5)
    for seconds in (1, 60, 86400, 10 * 365 * 86400):
        assert clock.due_ns(1024 * seconds) == 5 + seconds * 10**9


def test_a_first_tick_before_the_clock_began_is_refused() -> None:
    with pytest.raises(core.CoreError, match="-1 ns"):
        Ticker(t0_ns=-1)


# ---- skipping -----------------------------------------------------------------------------------


@given(
    t0=st.integers(0, 10**15),
    delays_ns=st.lists(
        st.one_of(st.integers(0, 200_000), st.integers(0, 3_000_000), st.integers(0, 10**11)),
        max_size=60,
    ),
)
def test_executed_and_skipped_are_elapsed_whatever_the_stalls(
    t0: int, delays_ns: list[int]
) -> None:
    clock = Ticker(t0_ns=t0)
    before = -1
    for delay in delays_ns:
        now = due_exactly(t0, before + 1) + delay
        tick = clock.woken(now)
        # The newest tick that is due: on the grid, not in the future, and the next one not yet.
        assert due_exactly(t0, tick.k) == tick.due_ns <= now < due_exactly(t0, tick.k + 1)
        assert tick.skipped == tick.k - before - 1
        assert tick.woken_ns == now
        before = tick.k
        counts = clock.counts
        assert counts.executed + counts.skipped == counts.elapsed == before + 1
    assert clock.counts.executed == clock.wake.count == len(delays_ns)
    assert clock.wake.max_ns == max(delays_ns, default=0)


def test_after_a_stall_of_30_ms_one_tick_runs_and_then_the_next_is_waited_for() -> None:
    clock = Ticker()
    clock.woken(0)
    tick = clock.woken(clock.due_ns(1) + 30_000_000)
    assert (tick.k, tick.skipped) == (31, 30)  # 30 ms are 30.72 periods
    assert clock.due_ns(clock.counts.elapsed) > tick.woken_ns
    assert clock.counts.longest_skip == 30


def test_late_by_less_than_a_period_nothing_is_skipped() -> None:
    clock = Ticker()
    clock.woken(0)
    assert clock.woken(clock.due_ns(2) - 1).skipped == 0
    clock = Ticker()
    clock.woken(0)
    assert clock.woken(clock.due_ns(2)) == Tick(2, 1, clock.due_ns(2), clock.due_ns(2))


def test_wake_latency_is_that_of_the_tick_waited_for_even_if_it_was_skipped() -> None:
    clock = Ticker()
    clock.woken(20_000_000)
    assert clock.wake.max_ns == 20_000_000


def test_a_drives_clock_is_followed_by_200_ppm_and_no_more() -> None:
    clock = Ticker(t0_ns=1000)
    for k in range(1024):
        clock.trim(10**9 if k % 2 else 150)
        tick = clock.step()
        counts = clock.counts
        assert counts.elapsed == k + 1
        assert tick.due_ns == due_exactly(1000, k) + (k // 2 + 1) * 150 + (k + 1) // 2 * 195
    for _ in range(1024):
        clock.trim(-(10**9))
    assert clock.due_ns(0) == 1000 + 512 * (150 + 195) - 1024 * 195
    assert ticker.TRIM_MAX_NS / ticker.PERIOD_NS < 200e-6


# ---- waiting ------------------------------------------------------------------------------------


def waited(count: int) -> tuple[Ticker, list[Tick]]:
    clock = Ticker(t0_ns=ticker.now_ns() + 2_000_000)
    ticks = [tick for _ in range(count) if (tick := clock.wait()) is not None]
    return clock, ticks


def assert_never_a_burst(clock: Ticker, ticks: list[Tick]) -> None:
    for tick in ticks:
        assert 0 <= tick.woken_ns - tick.due_ns <= ticker.PERIOD_NS
    for first, second in itertools.pairwise(ticks):
        assert second.k == first.k + 1 + second.skipped
        assert second.woken_ns >= second.due_ns > first.woken_ns - ticker.PERIOD_NS
    counts = clock.counts
    assert counts.executed + counts.skipped == counts.elapsed == ticks[-1].k + 1
    assert counts.executed == len(ticks)


def test_no_tick_comes_before_it_is_due_nor_two_at_once() -> None:
    clock, ticks = waited(200)
    assert len(ticks) == 200
    assert_never_a_burst(clock, ticks)


def test_signals_do_not_make_a_tick_early() -> None:
    calls: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda *_: calls.append(1))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.0004, 0.0004)
        clock, ticks = waited(150)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert calls
    assert_never_a_burst(clock, ticks)


def test_a_ticker_that_was_stopped_gives_no_tick() -> None:
    clock = Ticker(t0_ns=ticker.now_ns())
    assert clock.wait() is not None
    clock.stop()
    assert clock.wait() is None
    assert clock.counts.executed == 1


STOPPED_PROCESS = """
import json, sys
from rthyb_rt.core import ticker
clock = ticker.Ticker(t0_ns=ticker.now_ns() + 1_000_000)
print("ready", flush=True)
ticks = [clock.wait() for _ in range(1500)]
print(json.dumps([list(t) for t in ticks] + [list(clock.counts)]))
"""


def test_a_stopped_process_skips_goes_on_in_phase_and_sends_no_burst() -> None:
    command = [sys.executable, "-c", STOPPED_PROCESS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.05)
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.12)
        process.send_signal(signal.SIGCONT)
        *rows, counts = json.loads(process.communicate(timeout=TIMEOUT_S)[0])
    ticks = [Tick(*row) for row in rows]
    elapsed, executed, skipped, longest = counts
    assert executed == 1500
    assert executed + skipped == elapsed
    assert longest >= 100  # of 0.12 s
    slots = [tick.k for tick in ticks]
    assert len(set(slots)) == len(slots)
    assert all(0 <= tick.woken_ns - tick.due_ns <= ticker.PERIOD_NS for tick in ticks)


# ---- stepped ------------------------------------------------------------------------------------


def test_stepped_ticks_come_on_the_callers_word_and_no_wall_clock() -> None:
    clock = Ticker("stepped")
    ticks = [clock.step() for _ in range(5000)]
    assert [tick.k for tick in ticks] == list(range(5000))
    assert all(tick.woken_ns == tick.due_ns == due_exactly(0, tick.k) for tick in ticks)
    assert clock.wake.count == 0


def test_a_stepped_thread_runs_as_many_ticks_as_it_is_granted() -> None:
    clock = Ticker("stepped")
    ticks: list[Tick] = []
    got = threading.Semaphore(0)

    def loop() -> None:
        while (tick := clock.wait()) is not None:
            ticks.append(tick)
            got.release()

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        for granted in (1, 3, 1000):
            clock.grant(granted)
            assert all(got.acquire(timeout=TIMEOUT_S) for _ in range(granted))
        assert not got.acquire(timeout=0.05)  # nothing more without a word
        clock.miss(19)
        clock.grant(2)
        assert all(got.acquire(timeout=TIMEOUT_S) for _ in range(2))
    finally:
        clock.stop()
        thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    assert [tick.k for tick in ticks] == [*range(1004), 1023, 1024]
    assert [tick.skipped for tick in ticks[-2:]] == [19, 0]
    assert clock.counts == (1025, 1006, 19, 19)


def test_stopping_wakes_a_stepped_thread_that_waits_for_a_word() -> None:
    clock = Ticker("stepped")
    timer = threading.Timer(0.05, clock.stop)
    timer.start()
    assert in_thread(clock.wait) is None
    timer.join()


# ---- the histogram ------------------------------------------------------------------------------

times = st.lists(
    st.one_of(st.integers(0, 100), st.integers(0, 10**6), st.integers(0, 2**36 - 1)), min_size=1
)


def histogram(values: list[int]) -> Latency:
    latency = Latency()
    for value in values:
        latency.record(value)
    return latency


@given(values=times, percent=st.floats(0.0, 100.0))
def test_a_percentile_is_never_too_low_and_at_most_3_per_cent_too_high(
    values: list[int], percent: float
) -> None:
    ordered = sorted(values)
    rank = max(1, int(np.ceil(percent / 100.0 * len(values))))
    exact = ordered[min(rank, len(values)) - 1]
    assert exact <= histogram(values).percentile_ns(percent) <= exact * (1.0 + 1.0 / 32.0)


@given(values=times)
def test_count_longest_and_mean_are_exact(values: list[int]) -> None:
    latency = histogram(values)
    assert latency.count == len(values) == latency.buckets().sum()
    assert latency.max_ns == latency.percentile_ns(100.0) == max(values)
    assert latency.mean_ns == pytest.approx(sum(values) / len(values))


@given(first=times, second=times)
def test_merged_histograms_are_that_of_all_times(first: list[int], second: list[int]) -> None:
    merged, both = histogram(first), histogram(first + second)
    merged.merge(histogram(second))
    assert np.array_equal(merged.buckets(), both.buckets())
    assert (merged.count, merged.max_ns, merged.mean_ns) == (
        both.count,
        both.max_ns,
        both.mean_ns,
    )


@given(value=st.integers(0, 2**36 - 1))
def test_every_time_lies_between_the_edges_of_its_bucket(value: int) -> None:
    edges = Latency.edges_ns()
    (i,) = np.flatnonzero(histogram([value]).buckets())
    assert edges[i] <= value < edges[i + 1]
    assert edges[i + 1] - edges[i] <= max(1, value / 32)


def test_an_hour_of_stall_and_a_time_before_its_due_time_are_counted_too() -> None:
    latency = histogram([3600 * 10**9, -5])
    buckets = latency.buckets()
    assert (buckets[-1], buckets[0]) == (1, 1)
    assert latency.percentile_ns(100.0) == 3600 * 10**9
    assert latency.percentile_ns(50.0) == 0
    assert Latency().percentile_ns(99.0) == 0


def test_a_reader_sees_whole_numbers_while_another_thread_records() -> None:
    live = Ticker(t0_ns=ticker.now_ns())

    def loop() -> None:
        while live.wait() is not None:
            pass

    thread = threading.Thread(target=loop)
    thread.start()
    last = 0
    try:
        for _ in range(200):
            counts, copy = live.counts, live.wake.copy()
            assert counts.elapsed >= last
            assert abs(int(copy.buckets().sum()) - copy.count) <= 1
            last = counts.elapsed
            time.sleep(0.001)
    finally:
        live.stop()
        thread.join(TIMEOUT_S)
    counts = live.counts
    assert counts.executed + counts.skipped == counts.elapsed
    assert live.wake.count == counts.executed > 0


# ---- real-time threads --------------------------------------------------------------------------

PRIVILEGED = """
import json, os, resource, signal, sys, threading
from rthyb_rt.core import ticker
if sys.argv[1] == "nobody":
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
    if os.geteuid() == 0:
        os.setgroups([])
        os.setuid(65534)
cpu = sorted(os.sched_getaffinity(0))[-1]
found = {}

def locked():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if "VmLck" in line)

def work():
    with ticker.AwakeProcessors() as awake:
        found["names"] = ticker.become_real_time(7, cpu, awake.fd)
        found["device"] = awake.fd >= 0
    found["policy"] = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    found["priority"] = os.sched_getparam(0).sched_priority
    found["cpus"] = sorted(os.sched_getaffinity(0))
    found["blocked"] = len(signal.pthread_sigmask(signal.SIG_BLOCK, []))
    found["locked_kb"] = locked()

thread = threading.Thread(target=work)
thread.start()
thread.join()
found["cpu"] = cpu
found["others"] = [os.sched_getscheduler(0), len(signal.pthread_sigmask(signal.SIG_BLOCK, []))]
ticker.unlock_memory()
found["locked_after_kb"] = locked()
print(json.dumps(found))
"""


def prepared(user: str) -> dict[str, Any]:
    """Prepare a thread in a process of its own: memory is locked for all of it."""
    done = subprocess.run(
        [sys.executable, "-c", PRIVILEGED, user],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("user", ["as we are", "nobody"])
def test_privileges_reported_are_those_that_the_thread_has_and_no_other_thread(user: str) -> None:
    found = prepared(user)
    had = set(found["names"])
    assert (found["policy"] == os.SCHED_FIFO and found["priority"] == 7) == ("fifo" in had)
    assert (found["cpus"] == [found["cpu"]]) == ("cpu" in had)
    if "LD_PRELOAD" not in os.environ:  # a sanitizer keeps memory from being locked
        assert (found["locked_kb"] > 0) == ("memory_locked" in had)
    assert found["locked_after_kb"] == 0
    assert found["device"] or "processors_awake" not in had
    assert "signals_blocked" in had
    assert found["blocked"] > 20
    assert found["others"] == [os.SCHED_OTHER, 0]


def test_without_rights_nothing_is_pretended() -> None:
    had = set(prepared("nobody")["names"])
    assert {"fifo", "memory_locked"}.isdisjoint(had) or "LD_PRELOAD" in os.environ


def test_nothing_asked_for_nothing_obtained() -> None:
    try:
        had = in_thread(lambda: ticker.become_real_time(0, -1, -1, 4096))
    finally:
        ticker.unlock_memory()
    assert {"fifo", "cpu", "processors_awake"}.isdisjoint(had)


def test_a_processor_that_is_not_there_is_not_obtained() -> None:
    try:
        assert "cpu" not in in_thread(lambda: ticker.become_real_time(0, 1000, -1))
        assert "cpu" not in in_thread(lambda: ticker.become_real_time(0, 10**6, -1))
    finally:
        ticker.unlock_memory()
