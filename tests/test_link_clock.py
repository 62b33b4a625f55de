"""The link clock: its loop on simulated clocks, and its waiting on a real link.

On simulated clocks nothing waits: the drive's samples arrive when its own period, a drift, jitter,
losses and outliers say, the ticker's due times are those of the core, and what the loop returns is
all that moves them. What runs on real time asserts counts only, never how long something took.
"""

from __future__ import annotations

import math
import os
import random
import statistics
import threading
import time
from dataclasses import dataclass, field

import numpy as np
import pytest
from loop_bench import Bench
from rthyb_rt._core import lib

from rthyb_rt import core
from rthyb_rt.core import loop, ticker

pytestmark = pytest.mark.alone

PERIOD_NS = 1e9 / core.FS_HZ
LEAD_NS = 200e3


@dataclass
class TwoClocks:
    """A drive that samples by a clock of its own, and ticks that take the newest pair.

    ``phase``: of a period, where the drive's first sample lies; ``losses`` and ``outliers``:
    probabilities, an outlier arrives up to 3 ms late; ``stalls``: how often a tick sleeps through,
    and for up to how long.
    """

    drift_ppm: float
    phase: float = 0.3
    jitter_us: float = 50.0
    losses: float = 0.0
    outliers: float = 0.0
    stalls: float = 0.0
    stall_ms: float = 0.0
    trimmed: bool = True
    seed: int = 1
    locked_at_s: float | None = None
    slips: list[float] = field(default_factory=list)
    net_slips: int = 0
    offset: int | None = None
    offsets: list[int | None] = field(default_factory=list)
    trims: list[int] = field(default_factory=list)
    errors_ns: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.clock, self.loop = ticker.Ticker("host", 0), loop.Phase(LEAD_NS / 1e3)
        self.period_ns = PERIOD_NS / (1.0 + self.drift_ppm * 1e-6)
        self.sample, self.newest, self.slack_ns = 0, -1, 4e6
        self.on_the_way: list[tuple[float, int]] = []

    def send(self, until_ns: float) -> None:
        """Let the drive take all samples that could have arrived."""
        while (instant := (self.phase + self.sample) * self.period_ns) <= until_ns + 1e6:
            if self.random.random() >= self.losses:
                late = self.random.uniform(-1.0, 1.0) * self.jitter_us * 1e3
                if self.random.random() < self.outliers:
                    late += self.random.uniform(0.0, 3e6)
                self.on_the_way.append((instant + late, self.sample))
            self.sample += 1

    def take(self, now_ns: float) -> tuple[float, int] | None:
        """The newest pair of what arrived; older than the last one is no pair."""
        self.send(now_ns)
        here = [pair for pair in self.on_the_way if pair[0] <= now_ns]
        self.on_the_way = [pair for pair in self.on_the_way if pair[0] > now_ns]
        pair = max(here, key=lambda p: p[1], default=None)
        if pair is None or pair[1] <= self.newest:
            return None
        self.newest = pair[1]
        return pair

    def run(self, seconds: float) -> TwoClocks:
        k, half = 0, (0, 0)
        while k < seconds * core.FS_HZ:
            due = self.clock.due_ns(k)
            late = 0.0
            if self.random.random() < self.stalls:
                late = self.random.uniform(0.0, self.stall_ms) * 1e6
            tick = self.clock.woken(int(due + late))
            pair = self.take(tick.woken_ns)
            punctual = tick.skipped == 0 and tick.woken_ns - tick.due_ns < PERIOD_NS / 2
            if pair is not None and punctual:
                self.watch_slip(pair[1] - tick.k, tick.k)
            trim = self.loop.step(pair[0] - tick.due_ns if pair and punctual else None)
            if self.trimmed:
                self.clock.trim(trim)
            self.trims.append(trim)
            self.errors_ns.append(self.loop.error_ns)
            if self.loop.locked and self.locked_at_s is None:
                self.locked_at_s = tick.k / core.FS_HZ
            self.offsets.append(self.offset)
            k = tick.k + 1
            if k <= seconds * core.FS_HZ / 2:
                half = (k, self.moved_ns(k))
        self.steady_ns = (self.moved_ns(k) - half[1]) / (k - half[0])
        return self

    def moved_ns(self, k: int) -> int:
        """How far the due time of tick k has been moved."""
        return self.clock.due_ns(k) - k * 1953125 // 2

    def watch_slip(self, offset: int, k: int) -> None:
        if self.offset is not None and offset != self.offset:
            self.slips.append(k / core.FS_HZ)
            self.net_slips += offset - self.offset
        self.offset = offset

    def slips_after_lock(self) -> int:
        assert self.locked_at_s is not None
        return sum(at > self.locked_at_s for at in self.slips)

    def steady_trim_ppm(self) -> float:
        """Mean of the second half."""
        return self.steady_ns / PERIOD_NS * 1e6


@pytest.mark.parametrize("drift_ppm", [100.0, -100.0])
def test_two_clocks_100_ppm_apart_slip_12_or_13_samples_in_two_minutes(drift_ppm: float) -> None:
    host = TwoClocks(drift_ppm, trimmed=False).run(120.0)
    assert abs(host.net_slips) in (12, 13)
    assert len(TwoClocks(drift_ppm, trimmed=False, jitter_us=0.0).run(120.0).slips) in (12, 13)


@pytest.mark.parametrize("drift_ppm", [100.0, -100.0, 0.3])
def test_with_the_link_clock_they_do_not_slip_at_all(drift_ppm: float) -> None:
    clocks = TwoClocks(drift_ppm, phase=0.8).run(120.0)
    assert clocks.slips == []
    assert clocks.steady_trim_ppm() == pytest.approx(-drift_ppm, abs=2.0)
    assert clocks.loop.trim_ppm == pytest.approx(-drift_ppm, abs=2.0)
    assert max(map(abs, clocks.errors_ns[20 * 1024 :])) < 50e3


@pytest.mark.parametrize("drift_ppm", [100.0, -100.0, 0.0])
@pytest.mark.parametrize("phase", [n / 16 for n in range(16)])
def test_it_locks_within_four_seconds_from_any_phase(phase: float, drift_ppm: float) -> None:
    clocks = TwoClocks(drift_ppm, phase).run(8.0)
    assert clocks.locked_at_s is not None
    assert clocks.locked_at_s < 4.0
    assert clocks.slips_after_lock() == 0
    assert max(map(abs, clocks.trims)) <= ticker.TRIM_MAX_NS


@pytest.mark.parametrize("drift_ppm", [100.0, -100.0])
@pytest.mark.parametrize(
    "harm",
    [
        {"losses": 0.05},
        {"outliers": 0.01},
        {"stalls": 0.002, "stall_ms": 40.0},
        {"stalls": 0.05, "stall_ms": 0.9},
        {"losses": 0.02, "outliers": 0.01, "stalls": 0.001, "stall_ms": 15.0},
    ],
    ids=["losses", "outliers", "stalls", "late ticks", "all of it"],
)
def test_losses_outliers_and_stalls_do_not_disturb_it(
    harm: dict[str, float], drift_ppm: float
) -> None:
    clocks = TwoClocks(drift_ppm, 0.5, **harm).run(60.0)
    assert clocks.locked_at_s is not None
    locked = int(clocks.locked_at_s * core.FS_HZ)
    just_locked, at_the_end = clocks.offsets[locked : locked + 5000], clocks.offsets[-5000:]
    assert statistics.mode(just_locked) == statistics.mode(at_the_end), (
        "no sample was lost for good"
    )
    assert clocks.steady_trim_ppm() == pytest.approx(-drift_ppm, abs=2.0)
    assert max(map(abs, clocks.errors_ns[20 * 1024 :])) < 50e3
    assert clocks.loop.locked


def test_one_outlier_moves_the_next_ticks_by_nanoseconds() -> None:
    clocks = TwoClocks(50.0, 0.8, jitter_us=0.0).run(20.0)
    steady = clocks.trims[-1]
    trims = [clocks.loop.step(400e3 - LEAD_NS)] + [clocks.loop.step(-LEAD_NS) for _ in range(200)]
    assert max(abs(trim - steady) for trim in trims) <= 25
    assert abs(sum(trims) - steady * len(trims)) < 1000


def test_silence_keeps_the_drift_and_forgets_the_phase() -> None:
    clocks = TwoClocks(80.0, 0.8, jitter_us=0.0).run(20.0)
    trims = [clocks.loop.step(None) for _ in range(1024)]
    assert sum(trims) / 1024 == pytest.approx(-80e-6 * PERIOD_NS, abs=0.5)
    assert not clocks.loop.locked
    for _ in range(257):
        clocks.loop.step(-LEAD_NS + 20e3)
    assert clocks.loop.locked


def test_silence_of_19_ticks_is_no_loss_of_lock() -> None:
    clocks = TwoClocks(0.0, 0.8, jitter_us=0.0).run(5.0)
    for _ in range(19):
        clocks.loop.step(None)
    assert clocks.loop.locked
    clocks.loop.step(None)
    assert not clocks.loop.locked


def test_drive_whose_clock_is_beyond_reach_never_locks_and_nothing_runs_off() -> None:
    clocks = TwoClocks(600.0, 0.1).run(30.0)
    assert not clocks.loop.locked
    assert len(clocks.slips) > 5
    assert max(map(abs, clocks.errors_ns)) <= PERIOD_NS
    assert clocks.trims[-1] == -ticker.TRIM_MAX_NS


def test_fractions_of_a_nanosecond_are_not_lost() -> None:
    phase = loop.Phase()
    error = 100.0  # 0.4 ns a tick
    total = sum(phase.step(error - LEAD_NS) for _ in range(100))
    step = 2 * math.pi * 0.3 / 1024
    expected = sum(2 * step * error + step**2 * error * n for n in range(100))
    assert total == pytest.approx(expected, abs=1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300, -1e300])
def test_senseless_stamp_counts_as_none(bad: float) -> None:
    sober, drunk = loop.Phase(), loop.Phase()
    for n in range(2000):
        assert sober.step(None if n % 7 == 0 else 30e3 - LEAD_NS) == drunk.step(
            bad if n % 7 == 0 else 30e3 - LEAD_NS
        )
    assert drunk.locked


@pytest.mark.parametrize("lead_us", [0.0, 9.9, 489.0, -1.0, math.nan, math.inf])
def test_lead_that_leaves_no_room_is_refused(lead_us: float) -> None:
    with pytest.raises(core.CoreError, match="10 to 488"):
        loop.Phase(lead_us)
    with Bench() as bench, pytest.raises(core.CoreError, match="10 to 488"):
        loop.Loop(bench.station, bench.wire, bench.link, clock="link", lead_us=lead_us)


# ---- on a real link -----------------------------------------------------------------------------


def wait_until(what: str, condition: object, seconds: float = 20.0) -> None:
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s for {what}"
        time.sleep(0.005)


@pytest.mark.parametrize("medium", ["socketpair", "pty"])
def test_ticks_of_the_link_clock_take_pairs_and_add_up(medium: str) -> None:
    with Bench(medium, clock="link") as bench:
        clock = ticker.Ticker("host", ticker.now_ns() + 10_000_000)
        drive = threading.Thread(target=bench.drive.run, args=(clock,))
        drive.start()
        bench.loop.start(priority=0)
        wait_until("1500 ticks", lambda: bench.loop.counts.elapsed > 1500)
        bench.loop.stop()
        clock.stop()
        drive.join()
        ticker.unlock_memory()
        counts, counters = bench.loop.counts, bench.loop.counters()
        assert counts.executed + counts.skipped == counts.elapsed
        assert counters["sent"] == bench.link.counters()["pieces_out"]
        assert 0 < counters["wake_ups"] <= 8 * counts.executed
        assert bench.wire.counters()["pairs"] > 0
        assert abs(bench.loop.arrival_error_us) <= PERIOD_NS / 1e3
        assert abs(bench.loop.trim_ppm) <= 200.0
        log = bench.drive.log
        assert log["refused"].max() == 0


def test_link_that_hung_up_neither_spins_nor_stops_the_ticks() -> None:
    with Bench(clock="link") as bench:
        bench.loop.start(priority=0)
        wait_until("ticks", lambda: bench.loop.counts.executed > 20)
        bench.unplug()
        bench.far.close()
        wait_until("the link's end", lambda: bench.link.down == "hung-up")
        before, executed = bench.loop.counters()["wake_ups"], bench.loop.counts.executed
        wait_until("200 more ticks", lambda: bench.loop.counts.executed > executed + 200)
        assert bench.loop.counters()["wake_ups"] - before <= 1
        bench.loop.stop()
        ticker.unlock_memory()


def test_link_that_babbles_wakes_the_thread_so_many_times_a_tick_and_no_more() -> None:
    with Bench(clock="link") as bench:
        bench.loop.start(priority=0)
        over = threading.Event()

        def babble() -> None:
            while not over.is_set():
                try:
                    os.write(bench.ends[1], bytes(16))
                except BlockingIOError:
                    time.sleep(1e-4)

        os.set_blocking(bench.ends[1], False)
        babbler = threading.Thread(target=babble)
        babbler.start()
        wait_until("400 ticks", lambda: bench.loop.counts.executed > 400)
        over.set()
        babbler.join()
        bench.loop.stop()
        ticker.unlock_memory()
        counters, counts = bench.loop.counters(), bench.loop.counts
        assert 0 < counters["wake_ups"] <= lib.RTHYB_WAKE_UPS_MAX * (counts.executed + 1)
        assert counts.executed + counts.skipped == counts.elapsed


def test_records_of_the_link_clock_have_the_due_times_that_were_kept() -> None:
    with Bench(clock="link") as bench:
        clock = ticker.Ticker("host", ticker.now_ns() + 10_000_000)
        drive = threading.Thread(target=bench.drive.run, args=(clock,))
        drive.start()
        bench.loop.start(priority=0)
        wait_until("600 ticks", lambda: bench.loop.counts.executed > 600)
        bench.loop.stop()
        clock.stop()
        drive.join()
        ticker.unlock_memory()
        last = bench.loop.records[-1]
        nominal = int(last["tick"]) * 1953125 // 2
        assert abs(int(last["due_ns"]) - nominal) <= ticker.TRIM_MAX_NS * bench.loop.counts.executed
        assert np.all(bench.loop.records["wake_late_ns"] >= 0)
