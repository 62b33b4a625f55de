"""1024 ticks per second: in C, bare, as the whole loop, and in Python; with and without load.

The Python loop is written as a laboratory would: sleep until the tick is due, one sample of rig and
controller, repeat. It has the same priority, skips like the C loop, and is timed by the same
histogram.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from proof.parties import Plan, Run, repeated

from rthyb_rt import core
from rthyb_rt.core import ticker
from rthyb_rt.lab import punctuality

SECONDS = 5.0
TICKS = round(SECONDS * core.FS_HZ)


def in_core() -> list[punctuality.JitterResult]:
    """Return the runs of `rthyb jitter`."""
    load, cpu = punctuality.Load.built_in(), punctuality.choose_cpu(punctuality.machine_facts())
    return [punctuality.measure(case, TICKS, load, cpu) for case in punctuality.CASES]


def in_loop() -> tuple[Run, int]:
    """Return a run of the whole tick with its ring, and the drive in a separate process.

    Frames are sent over an AF_UNIX socket pair. The second value is the number of attempts, which
    are repeated when the bare thread was late.
    """
    return repeated([Plan("bench", SECONDS)])["bench"]


def in_python() -> dict[str, ticker.Ticker]:
    """Return the clock of each Python loop after its run."""
    load = punctuality.Load.built_in()
    return {
        "Python loop": _timed(load, busy=False),
        "Python loop, beside busy Python": _timed(load, busy=True),
    }


def _timed(load: punctuality.Load, *, busy: bool) -> ticker.Ticker:
    clocks: list[ticker.Ticker] = []
    thread = threading.Thread(target=lambda: clocks.append(_loop(load)))
    with punctuality.busy_python() if busy else contextlib.nullcontext():
        thread.start()
        thread.join()
    ticker.unlock_memory()
    return clocks[0]


def _loop(load: punctuality.Load) -> ticker.Ticker:
    controller, rig = core.Controller(load.controller), core.VirtualRig(load.rig)
    excitation = load.excitation.tolist()
    ticker.become_real_time()
    clock = ticker.Ticker(t0_ns=ticker.now_ns() + 10_000_000)
    elapsed = 0
    while elapsed < TICKS:
        ahead_ns = clock.due_ns(elapsed) - time.monotonic_ns()
        if ahead_ns > 0:
            time.sleep(ahead_ns / 1e9)
        tick = clock.woken(time.monotonic_ns())
        x_m, f_n, _ = rig.step(controller.x_cmd_m)
        controller.step(x_m, f_n, excitation[tick.k % len(excitation)])
        elapsed = tick.k + 1
    return clock
