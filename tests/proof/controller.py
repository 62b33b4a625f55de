"""The controller as a separate process: a whole real-time run, from loop.start to its join.

python controller.py '{"fd": 3, "clock": "host", "seconds": 60, "cpu": 1, "out": "c.npz", ...}'

Prints the time of tick 0 once that is known. Rows are read from the ring, as by a recorder.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from proof import structure

from rthyb_rt import core
from rthyb_rt.core import loop, ticker, wire
from rthyb_rt.lab import punctuality
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring, RingReader, default_folder

NEXT: dict[str, core.Command] = {
    "IDLE": "zero",
    "ZEROED": "arm",
    "ARMED": "start",
    "TRIPPED": "reset",
}
"""Commands of an operator who keeps the test running, whatever happens."""


class Allocations:
    """Count of one thread's allocations, if counting.c is preloaded; else None."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(None) if "LD_PRELOAD" in os.environ else None

    def _word(self, name: str) -> Any:
        return ctypes.c_uint64.in_dll(self._library, name)

    def watch(self, thread: int) -> None:
        """Count this thread's allocations from now on, starting at 0; by the kernel's id of it."""
        if self._library:
            self._word("counting_allocations").value = 0
            self._word("counting_thread").value = thread

    @property
    def count(self) -> int | None:
        """Number of allocations."""
        return self._word("counting_allocations").value if self._library else None

    def works(self) -> bool:
        """Whether an allocation of the calling thread is counted."""
        if not self._library:
            return False
        malloc, free = self._library.malloc, self._library.free
        malloc.restype, free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
        self.watch(threading.get_native_id())
        free(malloc(100))
        counted = self.count
        self.watch(0)
        return bool(counted and counted >= 2)


def threads() -> set[int]:
    """Return the kernel's ids of this process's threads."""
    return {int(name) for name in os.listdir("/proc/self/task")}


class Follower:
    """Sends heartbeats and reads every row from the ring, 50 times per second."""

    def __init__(self, running: loop.Loop, reader: RingReader) -> None:
        self._loop, self._reader = running, reader
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._follow)
        self.parts: list[np.ndarray] = []
        self._thread.start()

    def _follow(self) -> None:
        last = False
        while not last:
            last = self._done.wait(0.02)
            self._loop.beat()
            # A copy: the rows refer to a buffer for 8192 of them, all of which is locked in memory.
            self.parts.append(self._reader.read().samples.copy())

    def finish(self) -> np.ndarray:
        """Return all rows, (n,)."""
        self._done.set()
        self._thread.join()
        return np.concatenate(self.parts)


def command(running: loop.Loop, wanted: core.Command) -> None:
    """Give a command and wait until it is answered."""
    generation = running.command(wanted)
    while generation is not None and running.answer(generation) is None:
        time.sleep(0.002)


def operate(running: loop.Loop, seconds: float) -> None:
    """Keep a test running for this long, then end it properly."""
    end, again = time.monotonic() + seconds, 0.0
    last: core.Command = "none"
    while time.monotonic() < end:
        wanted = NEXT.get(running.state, "none")
        # A tare takes 64 ticks, so it must not be restarted continually.
        if wanted != "none" and (wanted != last or time.monotonic() > again):
            command(running, wanted)
            again = time.monotonic() + 0.5
        last = wanted
        time.sleep(0.02)
    command(running, "stop")
    end = time.monotonic() + 10.0
    while running.state not in ("IDLE", "TRIPPED") and time.monotonic() < end:
        time.sleep(0.02)


def main(spec: dict[str, Any]) -> None:
    """Run the test of ``structure`` for ``spec["seconds"]`` and write the results."""
    allocations = Allocations()
    counted = allocations.works()
    seconds = spec["seconds"]
    station = core.Station(structure.station(), structure.shaking(seconds + 5.0))
    link, end = loop.Link("can", spec["fd"]), wire.Wire(wire.can())
    session = RecordedTest(
        np.zeros(0, core.RECORD_DTYPE), core.FS_HZ, np.zeros(0), {}, None, test_toml="", rig_toml=""
    )
    default_folder().mkdir(mode=0o700, parents=True, exist_ok=True)
    with ExitStack() as owned:
        folder = owned.enter_context(
            tempfile.TemporaryDirectory(prefix="proof-", dir=default_folder())
        )
        ring = Ring.create(Path(folder), session)
        owned.callback(ring.remove)
        reader = owned.enter_context(RingReader(ring.path))
        awake = owned.enter_context(ticker.AwakeProcessors())
        running = loop.Loop(station, end, link, ring, spec["clock"])
        before = threads()
        running.start(cpu=spec["cpu"], latency_fd=awake.fd)
        (tick_thread,) = threads() - before
        allocations.watch(tick_thread)
        while running.counts.elapsed == 0:
            time.sleep(0.001)
        print(running.began_ns, flush=True)
        follower = Follower(running, reader)
        sys.stdin.readline()  # the drive is ready
        with punctuality.busy_python() if spec["burner"] else nullcontext():
            operate(running, seconds)
            running.stop()
        tick_allocations = allocations.count
        rows = follower.finish()
        facts = {
            "counts": running.counts._asdict(),
            "counters": running.counters(),
            "wire": end.counters(),
            "link": link.counters(),
            "usage": running.usage(),
            "privileges": running.privileges,
            "allocations": tick_allocations,
            "allocations_counted": counted,
            "ring_lost": reader.lost,
            "tare_m": station.tare[0],
            "link_delay": running.link_delay,
            "wake_p50_ns": running.wake.percentile_ns(50.0),
            "wake_p99_ns": running.wake.percentile_ns(99.0),
            "wake_max_ns": running.wake.max_ns,
            "sent_p50_ns": running.sent.percentile_ns(50.0),
            "sent_p99_ns": running.sent.percentile_ns(99.0),
        }
        np.savez(spec["out"], rows=rows, facts=json.dumps(facts))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
