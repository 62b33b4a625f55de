"""Python interface of the core's clock: latency histograms, the ticker, real-time threads.

Names follow ``csrc/rthyb.h``, which states the contract. Times are whole nanoseconds. Calls that
wait release the GIL; they may be stopped, granted ticks or read from another thread.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from rthyb_rt import core
from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import options
from rthyb_rt.core.rows import RingMemory
from rthyb_rt.errors import RthybError

Clock = Literal["host", "stepped"]
Payload = Literal["none", "sample", "exchange"]

PERIOD_NS: Final = 1e9 / core.FS_HZ
"""Period of a ticker for which no rate is given."""
PRIORITY: Final = 80
"""Priority of the tick thread: above interrupt threads (50), below the kernel's own (99)."""
TRIM_MAX_NS: Final[int] = lib.rthyb_ticker_trim_max_ns(core.STANDARD_RATE_HZ)
"""Largest correction per call, 200 ppm of a period, at the default rate."""
RATES_HZ: Final[tuple[int, int]] = (lib.RTHYB_RATE_LEAST_HZ, lib.RTHYB_RATE_MOST_HZ)
"""Allowed rates of a ticker, ticks per second."""
LATENCY_DEVICE: Final = "/dev/cpu_dma_latency"

_CLOCKS: Final = options("rthyb_clock", "RTHYB_CLOCK_")
_PAYLOADS: Final = options("rthyb_payload", "RTHYB_PAYLOAD_")
PRIVILEGES: Final[dict[str, int]] = {
    "fifo": lib.RTHYB_P_FIFO,
    "cpu": lib.RTHYB_P_CPU,
    "memory_locked": lib.RTHYB_P_MEMORY,
    "processors_awake": lib.RTHYB_P_AWAKE,
    "signals_blocked": lib.RTHYB_P_SIGNALS,
}


class Latency:
    """Histogram of times: exact below 32 ns, then in steps of 3 %; one bucket from 69 s on.

    It can be read while another thread records.
    """

    def __init__(self, c: Any = None, owner: Any = None) -> None:
        self._c = ffi.new("rthyb_latency *") if c is None else c
        self._owner = owner  # keeps the memory behind a given pointer alive

    def record(self, ns: int) -> None:
        """Record one time; negative times count as zero."""
        lib.rthyb_latency_record(self._c, ns)

    def merge(self, other: Latency) -> None:
        """Add the times that ``other`` has recorded."""
        lib.rthyb_latency_merge(self._c, other._c)

    def copy(self) -> Latency:
        """Return an independent copy."""
        result = Latency()
        result.merge(self)
        return result

    def since(self, earlier: Latency) -> Latency:
        """Return the times recorded after ``earlier``, a copy of this histogram, was made.

        The longest time is exact if it is a new maximum, otherwise the upper end of its bucket.
        """
        result = self.copy()
        c, before = result._c, earlier._c
        for i in np.flatnonzero(earlier.buckets()).tolist():
            c.bucket[i] -= before.bucket[i]
        c.count -= before.count
        c.sum_ns -= before.sum_ns
        if c.max_ns == before.max_ns:
            used = np.flatnonzero(result.buckets())
            last = min(int(used[-1]) + 1, lib.RTHYB_LATENCY_BUCKETS) if used.size else 0
            c.max_ns = min(int(lib.rthyb_latency_edge_ns(last)), before.max_ns)
        return result

    def percentile_ns(self, percent: float) -> int:
        """Return the time that this percentage of times did not exceed, at most 3 % too high."""
        return int(lib.rthyb_latency_percentile(self._c, percent / 100.0))

    @property
    def count(self) -> int:
        """Number of recorded times."""
        return int(self._c.count)

    @property
    def max_ns(self) -> int:
        """The longest time, exact."""
        return int(self._c.max_ns)

    @property
    def mean_ns(self) -> float:
        """The mean time, exact; 0 if none was recorded."""
        return self._c.sum_ns / self._c.count if self._c.count else 0.0

    def buckets(self) -> npt.NDArray[np.uint64]:
        """Return the number of times in each bucket, (1025,); the last one has no upper end."""
        raw = ffi.buffer(ffi.addressof(self._c, "bucket"), ffi.sizeof(self._c.bucket))
        return np.frombuffer(raw, np.uint64).copy()

    @staticmethod
    def edges_ns() -> npt.NDArray[np.uint64]:
        """Return the lower ends of the buckets, (1025,)."""
        count = lib.RTHYB_LATENCY_BUCKETS + 1
        return np.array([lib.rthyb_latency_edge_ns(i) for i in range(count)], np.uint64)


class Tick(NamedTuple):
    """One tick to execute; the ``skipped`` ticks just before it were not executed."""

    k: int
    skipped: int
    due_ns: int
    woken_ns: int


class TickCounts(NamedTuple):
    """Numbers of ticks of a ticker: executed + skipped == elapsed."""

    elapsed: int
    executed: int
    skipped: int
    longest_skip: int


class Ticker:
    """Due times t0 + k 1e9/rate ns, and which ticks to skip after oversleeping.

    Args:
        clock: "host": CLOCK_MONOTONIC; "stepped": each tick is granted by the caller.
        t0_ns: due time of the first tick.
        rate_hz: ticks per second, 256 to 4096.

    Raises:
        core.CoreError: ``t0_ns`` is negative, or the rate is out of range.
    """

    def __init__(
        self, clock: Clock = "host", t0_ns: int = 0, rate_hz: int = core.STANDARD_RATE_HZ
    ) -> None:
        self._c = ffi.new("rthyb_ticker *")
        if lib.rthyb_ticker_init(self._c, _CLOCKS[clock], max(rate_hz, 0), t0_ns):
            raise core.CoreError(
                f"found ticks at {rate_hz} Hz, the first one due at {t0_ns} ns; allowed are "
                f"{RATES_HZ[0]} to {RATES_HZ[1]} Hz, and 0 ns or later"
            )
        self._tick = ffi.new("rthyb_tick *")

    @property
    def rate_hz(self) -> int:
        """Ticks per second."""
        return int(self._c.rate_hz)

    def due_ns(self, k: int) -> int:
        """Return the due time of tick ``k``, rounded down to a whole ns."""
        return int(lib.rthyb_ticker_due_ns(self._c, k))

    def wait(self) -> Tick | None:
        """Wait for the next tick; None once the ticker was stopped."""
        return self._taken() if lib.rthyb_ticker_wait(self._c, self._tick) else None

    def woken(self, now_ns: int) -> Tick:
        """Return the tick that a thread woken at ``now_ns`` must execute."""
        lib.rthyb_ticker_woken(self._c, now_ns, self._tick)
        return self._taken()

    def step(self) -> Tick:
        """Return the next tick, without waiting."""
        lib.rthyb_ticker_step(self._c, self._tick)
        return self._taken()

    def trim(self, ns: int) -> None:
        """Shift all later due times, by at most 200 ppm of a period: 195 ns at 1024 Hz."""
        lib.rthyb_ticker_trim(self._c, ns)

    def grant(self, ticks: int) -> None:
        """Stepped clock: grant this many further ticks."""
        lib.rthyb_ticker_grant(self._c, ticks)

    def miss(self, ticks: int) -> None:
        """Stepped clock: let the next tick be preceded by this many skipped ticks."""
        lib.rthyb_ticker_miss(self._c, ticks)

    def stop(self) -> None:
        """Make `wait` return None from now on."""
        lib.rthyb_ticker_stop(self._c)

    @property
    def counts(self) -> TickCounts:
        """Ticks so far."""
        return _counts(self._c)

    @property
    def wake(self) -> Latency:
        """Histogram of the wake-up latency: time of waking after the due time."""
        return Latency(ffi.addressof(self._c, "wake"), self._c)

    def _taken(self) -> Tick:
        tick = self._tick
        return Tick(tick.k, tick.skipped, tick.due_ns, tick.woken_ns)


def now_ns() -> int:
    """Return CLOCK_MONOTONIC."""
    return int(lib.rthyb_now_ns())


# ---- real-time threads --------------------------------------------------------------------------


def become_real_time(
    priority: int = PRIORITY, cpu: int = -1, latency_fd: int = -1, stack_bytes: int = 1 << 16
) -> list[str]:
    """Make the calling thread, and only it, as punctual as the system permits.

    Args:
        priority: priority under SCHED_FIFO, 1 to 99; 0 leaves the scheduling policy unchanged.
        cpu: processor to which the thread is pinned; -1 leaves the choice to the kernel.
        latency_fd: descriptor of an open `AwakeProcessors`; -1 for none.
        stack_bytes: size of the stack to touch in advance; it must be available.

    Returns:
        What was obtained, each verified afterwards: names of `PRIVILEGES`.
    """
    return privilege_names(
        lib.rthyb_thread_become_real_time(priority, cpu, latency_fd, stack_bytes)
    )


def privilege_names(bits: int) -> list[str]:
    """Return the names of the privileges set in ``bits``."""
    return [name for name, bit in PRIVILEGES.items() if bits & bit]


def unlock_memory() -> None:
    """Release the memory that real-time threads locked for the whole process."""
    lib.rthyb_memory_unlock()


class AwakeProcessors:
    """Keeps all processors from sleeping while it is open, where the system permits."""

    def __init__(self) -> None:
        self.fd = -1

    def __enter__(self) -> AwakeProcessors:
        try:
            self.fd = os.open(LATENCY_DEVICE, os.O_RDWR | os.O_CLOEXEC)
            os.write(self.fd, bytes(4))
        except OSError:
            self._close()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close()

    def _close(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)
        self.fd = -1


# ---- timing of two threads ----------------------------------------------------------------------


@dataclass(frozen=True)
class Timing:
    """Timing of one thread.

    Attributes:
        wake: time from the due time to waking.
        sent: time from waking to the command being sent; empty without payload.
        privileges: names of `PRIVILEGES` that the thread had.
        lost: ticks without a fresh pair from the rig's thread.
        not_sent: commands for which the socket had no space.
        major_faults: page faults that needed the disk.
        minor_faults: page faults served from memory.
        blocked: voluntary context switches other than waiting for the tick.
        preempted: involuntary context switches.
    """

    counts: TickCounts
    wake: Latency
    sent: Latency
    privileges: tuple[str, ...]
    lost: int
    not_sent: int
    major_faults: int
    minor_faults: int
    blocked: int
    preempted: int


class JitterRun:
    """A thread with a payload, timed beside a bare one of the same priority.

    Args:
        ticks: length of the run.
        payload: "none"; "sample": one sample of controller and virtual rig; "exchange": the rig in
            a thread of its own behind an AF_UNIX socket pair.
        controller, rig, excitation: parts of the payload.
        ring: receives the record of every sample.
        priority, cpu, latency_fd: as in `become_real_time`.
        rate_hz: ticks per second; the caller must give the payload a matching period.
    """

    def __init__(
        self,
        ticks: int,
        payload: Payload = "none",
        controller: core.ControllerConfig | None = None,
        rig: core.RigConfig | None = None,
        excitation: npt.ArrayLike = (),
        ring: RingMemory | None = None,
        *,
        priority: int = PRIORITY,
        cpu: int = -1,
        latency_fd: int = -1,
        rate_hz: int = core.STANDARD_RATE_HZ,
    ) -> None:
        self._c = ffi.new("rthyb_jitter *")
        self._c.payload = _PAYLOADS[payload]
        self._c.priority, self._c.cpu, self._c.latency_fd = priority, cpu, latency_fd
        self._c.ticks, self._c.rate_hz = ticks, rate_hz
        self._excitation = np.ascontiguousarray(excitation, np.float64)
        self._kept: list[object] = [ring]
        self._c.ring = ffi.NULL if ring is None else ring.pointer
        if controller is not None and rig is not None:
            pair = core.Controller(controller), core.VirtualRig(rig)
            self._kept += pair
            self._c.controller, self._c.rig = pair[0]._c, pair[1]._c
            self._c.excitation = ffi.from_buffer("double[]", self._excitation)
            self._c.excitation_count = self._excitation.size

    def run(self) -> None:
        """Start the threads and wait for them to end, without the GIL.

        Raises:
            RthybError: the system refused a thread or a socket.
        """
        error = lib.rthyb_jitter_run(self._c)
        if error:
            raise RthybError(f"the threads to be timed could not be started: {os.strerror(error)}")

    def stop(self) -> None:
        """End the run early; may be called from any thread."""
        lib.rthyb_jitter_stop(self._c)

    @property
    def elapsed(self) -> int:
        """Ticks so far; readable during the run."""
        return _counts(ffi.addressof(self._c.measured, "ticker")).elapsed

    @property
    def measured(self) -> Timing:
        """The thread that carried the payload."""
        return self._timing(self._c.measured)

    @property
    def reference(self) -> Timing:
        """The bare thread."""
        return self._timing(self._c.reference)

    def _timing(self, c: Any) -> Timing:
        counts = _counts(ffi.addressof(c, "ticker"))
        return Timing(
            counts=counts,
            wake=Latency(ffi.addressof(c.ticker, "wake"), self._c).copy(),
            sent=Latency(ffi.addressof(c, "sent"), self._c).copy(),
            privileges=tuple(privilege_names(c.privileges)),
            lost=c.lost,
            not_sent=c.not_sent,
            major_faults=c.usage.major_faults,
            minor_faults=c.usage.minor_faults,
            blocked=max(c.usage.waits - counts.executed, 0),
            preempted=c.usage.preemptions,
        )


def _counts(ticker: Any) -> TickCounts:
    out = ffi.new("rthyb_ticker_counts *")
    lib.rthyb_ticker_read(ticker, out)
    return TickCounts(out.elapsed, out.executed, out.skipped, out.longest_skip)
