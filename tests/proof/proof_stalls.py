"""A minute of real time with a controller that is stopped repeatedly, among busy processes.

The controller's process receives SIGSTOP four times per second at random, mostly for 1 to 8 ms,
occasionally for up to 60; a Python thread in it occupies the GIL and two processes occupy the
processors. The operator starts a new test whenever the last one has ended. Everything is counted.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from proof.conftest import Note
from proof.parties import BUILD, FLAGS, HALF_NS, STATE, Parties, Plan, Run, repeated

from rthyb_rt.core import ticker

SECONDS = 60.0
QUIET_SECONDS = 10.0
RATIO, MORE_NS = 1.25, 20_000
"""Largest p99 of the wake-up: a factor on that of the bare thread, plus a constant."""
A_SECOND = 4.0
LENGTHS_MS = ((0.85, 1.0, 8.0), (0.12, 8.0, 15.0), (0.03, 25.0, 60.0))
"""Share of the stalls, and range of their lengths."""
BLIND_MAX = 20
PUNCTUAL_NS = HALF_NS - 50_000
"""Lateness beyond which a party may coincide with the other one's next tick."""
MOVING = [STATE[name] for name in ("RAMP_IN", "RUNNING", "HOLD")]
PERIOD_NS = ticker.PERIOD_NS


@contextmanager
def burners(count: int = 2) -> Iterator[None]:
    """Keep the processors busy."""
    with ExitStack() as owned:
        for _ in range(count):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            owned.callback(process.wait)
            owned.callback(process.kill)
        yield


def stall(party: Parties, seconds: float, given: list[float]) -> None:
    """Stop and continue the controller's process for this long; add lengths to ``given``, s."""
    chance = random.Random(1024)
    ticker.become_real_time(ticker.PRIORITY + 10)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(chance.expovariate(A_SECOND))
        _, low, high = chance.choices(LENGTHS_MS, [share for share, *_ in LENGTHS_MS])[0]
        length_s = chance.uniform(low, high) / 1e3
        party.controller.send_signal(signal.SIGSTOP)
        time.sleep(length_s)
        party.controller.send_signal(signal.SIGCONT)
        given.append(length_s)


@pytest.fixture(scope="module")
def stalls() -> list[float]:
    """Lengths of the stalls, s."""
    return []


@pytest.fixture(scope="module")
def run(stalls: list[float]) -> Run:
    """The minute, run once for all proofs below. Stalls of the machine itself do no harm here."""
    plan = Plan("stalls", SECONDS, burner=True, timed=True, count_allocations=True)
    with burners():
        party = Parties(plan, BUILD).start()
        thread = threading.Thread(target=stall, args=(party, SECONDS - 1.0, stalls))
        thread.start()
        thread.join()
        ticker.unlock_memory()
        return party.finish()


# ---- every tick is accounted for -----------------------------------------------------------------


def executed_of(rows: np.ndarray) -> np.ndarray:
    """Rows of the ticks that were executed."""
    return rows[rows["flags"] & FLAGS["blind"] == 0]


def gaps_of(rows: np.ndarray) -> np.ndarray:
    """Ticks skipped just before each executed one, (n,)."""
    return np.diff(executed_of(rows)["tick"].astype(np.int64), prepend=-1) - 1


def test_executed_and_skipped_are_elapsed_and_each_has_its_record(
    run: Run, stalls: list[float], note: Note
) -> None:
    counts, gaps = run.facts["counts"], gaps_of(run.rows)
    assert counts["executed"] + counts["skipped"] == counts["elapsed"]
    assert counts["elapsed"] > SECONDS * 1024
    assert (counts["executed"], counts["skipped"]) == (gaps.size, gaps.sum())
    assert counts["longest_skip"] == gaps.max()
    unrecorded = int(np.maximum(gaps - BLIND_MAX, 0).sum())  # during a stall that trips the test
    assert run.facts["counters"]["records"] == run.rows.size == counts["elapsed"] - unrecorded
    assert run.facts["ring_lost"] == 0
    assert (np.diff(run.rows["tick"].astype(np.int64)) > 0).all()
    assert len(stalls) > 0.5 * A_SECOND * SECONDS
    assert counts["skipped"] > len(stalls)
    note("stalls", "made by SIGSTOP", len(stalls))
    for name, value in counts.items():
        note("stalls", f"ticks {name}", value, "", "executed + skipped == elapsed, exactly")
    note("stalls", "records", run.rows.size, "", f"elapsed less {unrecorded} beyond 20 in a row")


def test_due_times_keep_their_phase(run: Run) -> None:
    tick = run.rows["tick"].astype(np.int64)
    np.testing.assert_array_equal(run.rows["due_ns"], tick * 1953125 // 2)
    assert (executed_of(run.rows)["wake_late_ns"] < PERIOD_NS).all()


# ---- the drive -----------------------------------------------------------------------------------


def test_no_command_of_a_skipped_tick_and_none_lost(run: Run, note: Note) -> None:
    rows, log = run.rows, run.log
    unsent = rows["flags"] & FLAGS["not_sent"] != 0
    assert unsent[rows["flags"] & FLAGS["blind"] != 0].all()
    sent = int((~unsent).sum())
    assert run.facts["counters"]["sent"] == sent == int(log["frames"].sum())
    assert log["refused"].max() == 0
    heard = log["frames"] > 0
    np.testing.assert_array_equal(log["seq"][heard], np.cumsum(log["frames"])[heard] % 65536)
    note("stalls", "commands sent, and seen by the drive", sent)


def test_drive_never_sees_a_burst(run: Run, note: Note) -> None:
    log, (due, _, done) = run.log, run.times.T
    commands = run.rows[run.rows["flags"] & FLAGS["not_sent"] == 0]
    first = np.flatnonzero(log["frames"])[0]
    frames = log["frames"].astype(np.int64)
    slots = np.rint(np.diff(due, prepend=due[0] - PERIOD_NS) / PERIOD_NS).astype(np.int64)
    # Which commands arrived in which tick of the drive, by their number.
    tick_of = np.searchsorted(np.cumsum(frames), np.arange(commands.size), side="right")
    assert (done[tick_of] >= run.t0_ns + commands["due_ns"]).all(), "a command came before its time"
    late_command = commands["sent_late_ns"] > PUNCTUAL_NS
    late_here = np.bincount(tick_of, late_command, frames.size).astype(np.int64)
    late_drive = (done - due > PUNCTUAL_NS).astype(np.int64)
    assert (frames <= slots + late_here + late_drive)[first:].all()
    punctual = (slots == 1) & (late_here == 0) & (late_drive == 0)
    punctual[1:] &= punctual[:-1]
    assert punctual[first:].mean() > 0.5
    assert frames[punctual].max() == 1
    note(
        "stalls", "most commands in a tick of the drive", int(frames.max()), "", "its own lateness"
    )
    note("stalls", "most where both were punctual", int(frames[punctual].max()), "", "1")


# ---- the station ---------------------------------------------------------------------------------


def skipped_before(tick: np.ndarray) -> np.ndarray:
    """Number of the 1024 ticks before each executed one that were skipped, (n,)."""
    skipped = np.ones(tick[-1] + 1, np.int64)
    skipped[tick] = 0
    before = np.concatenate([np.zeros(1025, np.int64), np.cumsum(skipped)])
    return before[tick + 1024] - before[tick]


def test_station_ends_a_test_for_skips_as_designed_and_for_nothing_else(
    run: Run, note: Note
) -> None:
    rows = executed_of(run.rows)
    gaps, state, tick = gaps_of(run.rows), rows["state"], rows["tick"].astype(np.int64)
    recent = skipped_before(tick)
    was_moving = np.isin(np.roll(state, 1), MOVING)
    was_moving[0] = False
    stalled, skips = gaps >= BLIND_MAX, (gaps > 10) | (recent > 50)
    ended = {"RAMP_OUT": STATE["RAMP_OUT"], "TRIPPED": STATE["TRIPPED"]}
    assert (state[was_moving & stalled] == ended["TRIPPED"]).all()
    assert np.isin(state[was_moving & skips], list(ended.values())).all()
    left = was_moving & np.isin(state, list(ended.values()))
    left[np.flatnonzero(left)[-1]] &= bool(skips[np.flatnonzero(left)[-1]])  # the operator's stop
    # A drive that received nothing for 20 of its ticks stops on its own, and reports it.
    silent = np.array([gaps[max(i - 25, 0) : i + 1].max() >= 17 for i in np.flatnonzero(left)])
    assert (skips[left] | silent).all()
    note("stalls", "tests tripped as stalled", int((was_moving & stalled).sum()))
    note("stalls", "tests ramped out for skips", int((was_moving & skips & ~stalled).sum()))
    assert (was_moving & stalled).any()
    assert (was_moving & skips & ~stalled).any()
    assert (state == STATE["RUNNING"]).sum() > 5 * 1024


# ---- what the system did to the thread -----------------------------------------------------------


def test_tick_thread_reads_no_page_from_disk_and_allocates_nothing(run: Run, note: Note) -> None:
    usage, facts = run.facts["usage"], run.facts
    assert facts["allocations_counted"], "the counter of allocations does not count"
    assert facts["allocations"] == 0
    assert usage["major_faults"] == 0
    note("stalls", "allocations of the tick thread, start to join", facts["allocations"], "", "0")
    note("stalls", "major faults", usage["major_faults"], "", "0")
    note("stalls", "minor faults", usage["minor_faults"])


def waits_on_the_clock(run: Run) -> tuple[int, int]:
    """Number of times the thread had to wait for the clock, least and most.

    Once before each tick and once before it is stopped, but not before a tick that was already due
    when the previous one was completed.
    """
    rows = executed_of(run.rows)
    done = rows["due_ns"] + np.maximum(rows["sent_late_ns"], rows["wake_late_ns"])
    next_due = (rows["tick"].astype(np.int64) + 1) * 1953125 // 2
    margin_ns = 30_000  # work after sending
    surely, perhaps = (int((done + extra >= next_due).sum()) for extra in (0, margin_ns))
    return rows.size - perhaps, rows.size + 1 - surely


def test_tick_thread_gives_the_processor_away_for_the_clock_alone(
    run: Run, stalls: list[float], note: Note
) -> None:
    waits = run.facts["usage"]["waits"]
    least, most = waits_on_the_clock(run)
    # A SIGSTOP ends one wait, is one itself, and the remaining wait is another.
    assert least <= waits <= most + 2 * len(stalls)
    note("stalls", "voluntary switches", waits, "", f"{least} to {most} + 2 a SIGSTOP")


# ---- without stalls ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def quiet() -> tuple[Run, int]:
    """Ten seconds without stops, and the number of attempts."""
    return repeated([Plan("quiet", QUIET_SECONDS, count_allocations=True)])["quiet"]


def test_without_stalls_each_tick_is_one_wait_on_the_clock_and_nothing_else(
    quiet: tuple[Run, int], note: Note
) -> None:
    found, attempts = quiet
    least, most = waits_on_the_clock(found)
    waits = found.facts["usage"]["waits"]
    assert least <= waits <= most
    assert found.facts["allocations"] == 0
    assert found.facts["usage"]["major_faults"] == 0
    note("quiet 10 s", "voluntary switches", waits, "", f"{least} to {most}; run {attempts} x")
    note("quiet 10 s", "executed ticks", found.facts["counts"]["executed"])
    note("quiet 10 s", "wake to sent p50", found.facts["sent_p50_ns"] / 1e3, "us")


def test_tick_thread_of_a_test_wakes_as_punctually_as_a_bare_thread_in_the_same_seconds(
    quiet: tuple[Run, int], note: Note
) -> None:
    found, attempts = quiet
    due_ns = found.rows["due_ns"] - found.began_ns
    beside = executed_of(found.rows[(due_ns >= 0) & (due_ns < QUIET_SECONDS * 1e9)])
    assert beside.size > 0.5 * QUIET_SECONDS * 1024, "the two were hardly there at the same time"
    p99_ns = float(np.percentile(beside["wake_late_ns"], 99.0))
    most_ns = RATIO * found.reference.p99_ns + MORE_NS
    allowed = f"{most_ns / 1e3:.0f}; bare thread {found.reference.p99_ns / 1e3:.1f}"
    note("quiet 10 s", "wake-up p99", p99_ns / 1e3, "us", f"{allowed}; run {attempts} x")
    if found.disturbed:
        pytest.skip(f"the bare thread was over 10 ms late in {attempts} runs")
    assert found.reference.fifo
    assert "fifo" in found.facts["privileges"], "real-time priority is needed, and was not granted"
    assert p99_ns <= most_ns
