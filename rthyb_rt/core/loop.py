"""The thin face of the tick: a link, the loop that exchanges one sample a tick, the virtual drive.

Names follow ``csrc/rthyb.h``, where the contract stands. Calls that run or wait do so without the
GIL. What a loop is made of belongs to its thread while that runs: only what is said to be readable
may then be asked.
"""

from __future__ import annotations

import math
import os
import select
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from rthyb_rt import core
from rthyb_rt._core import ffi, lib
from rthyb_rt.core.coupled_rig import CoupledRig
from rthyb_rt.core.group import plant_of
from rthyb_rt.core.library import options, words
from rthyb_rt.core.rows import RingMemory, copy_records
from rthyb_rt.core.ticker import PRIORITY, RATES_HZ, Counts, Latency, Ticker, privilege_names
from rthyb_rt.core.wire import NOTICES, Codec, Frame, Wire
from rthyb_rt.errors import RthybError

Kind = Literal["can", "stream"]
Clock = Literal["host", "link", "stepped"]
FaultKind = Literal[
    "drop",
    "drop-command",
    "drop-force",
    "delay",
    "reorder",
    "duplicate",
    "corrupt",
    "stuck",
    "jump",
    "force",
    "not-finite",
    "silence",
]

HEARTBEAT_TICKS: Final[int] = lib.RTHYB_HEARTBEAT_TICKS
"""Ticks of 1/1024 s without a sign of life, after which the test ramps out."""
SLIP_VOTES: Final[int] = lib.RTHYB_SLIP_VOTES
WATCHDOG_TICKS: Final[int] = lib.RTHYB_DRIVE_WATCHDOG
"""Ticks of 1/1024 s without a fresh command, after which the virtual drive stops."""
PHASES: Final = tuple(words("rthyb_drive_phase", "RTHYB_DRIVE_"))
LINK_FAULTS: Final = ("up", "network-down", "device-gone", "bus-off", "hung-up")

_FAREWELLS: Final = 3
"""One that is lost does not matter."""

_KINDS: Final = options("rthyb_link_kind", "RTHYB_LINK_")
_CLOCKS: Final = options("rthyb_clock", "RTHYB_CLOCK_")
_FAULTS: Final = options("rthyb_drive_fault", "RTHYB_FAULT_")

LOG_DTYPE: Final = core.dtype_of("rthyb_drive_entry")
"""What a drive saw and did in one of its ticks: the fields of ``rthyb_drive_entry``."""


class Link:
    """Frames over a descriptor that the caller opened and set up, without ever waiting.

    Args:
        kind: "can": a SocketCAN socket, or a SOCK_SEQPACKET socket that carries its frames;
            "stream": a tty in raw mode or a stream socket, with O_NONBLOCK.
        fd: the descriptor; the link has its own from then on.

    Raises:
        RthybError: the descriptor is closed, or a stream that would make a reader wait.
    """

    def __init__(self, kind: Kind, fd: int) -> None:
        self.struct = ffi.new("rthyb_link *", {"fd": -1})
        error = lib.rthyb_link_open(self.struct, _KINDS[kind], fd)
        if error:
            raise RthybError(
                f"descriptor {fd} cannot be used as a {kind} link: {os.strerror(error)}; it must "
                "be open, and for a stream it must have O_NONBLOCK set"
            )

    def close(self) -> None:
        """Close the link's own descriptor; twice does no harm."""
        lib.rthyb_link_close(self.struct)

    def receive(self) -> Frame | None:
        """Take a CAN frame, or some bytes of a stream; None: nothing more has come.

        Not while a loop has the link.
        """
        frame = ffi.new("rthyb_frame *")
        if not lib.rthyb_link_receive(self.struct, frame):
            return None
        return Frame(frame.id, bytes(ffi.buffer(frame.data, frame.length)), bool(frame.fd))

    @property
    def fd(self) -> int:
        """The link's own descriptor."""
        return int(self.struct.fd)

    @property
    def down(self) -> str:
        """One of `LINK_FAULTS`; readable at any time."""
        return LINK_FAULTS[self.struct.down]

    def counters(self) -> dict[str, int]:
        """Return every counter of ``rthyb_link_counters`` by name; readable at any time."""
        return _by_name(self.struct.counters)


class Phase:
    """The loop of the link clock alone: when pairs arrived in, trims of the due times out.

    Args:
        lead_us: a pair is to arrive so long before its tick, from 10 to half a period.
        rate_hz: ticks a second, 256 to 4096.

    Raises:
        core.CoreError: the lead or the rate is out of range.
    """

    def __init__(self, lead_us: float = 200.0, rate_hz: int = core.STANDARD_RATE_HZ) -> None:
        self._c = ffi.new("rthyb_phase *")
        if lib.rthyb_phase_init(self._c, rate_hz, lead_us * 1e3):
            raise core.CoreError(
                f"found a lead of {lead_us} us at {rate_hz} Hz; at this rate 10 to "
                f"{_most_lead_us(rate_hz)} us are allowed, and the rate must be from "
                f"{RATES_HZ[0]} to {RATES_HZ[1]} Hz"
            )

    def step(self, after_due_ns: float | None) -> int:
        """Return what `rthyb_rt.core.ticker.Ticker.trim` is to be given after a tick, ns.

        ``after_due_ns``: arrival of the tick's pair after its due time; None: there is none.
        """
        came = after_due_ns is not None
        return int(lib.rthyb_phase_step(self._c, came, after_due_ns or 0.0))

    def typical(self, arrived_ns: Sequence[int]) -> int:
        """Return the one of these arrivals, ns, whose place in the period is closest to all."""
        stamps = ffi.new("int64_t[]", list(arrived_ns))
        return int(arrived_ns[lib.rthyb_phase_typical(self._c, stamps, len(arrived_ns))])

    @property
    def locked(self) -> bool:
        """Whether the error has been small for a quarter of a second."""
        return bool(self._c.locked)

    @property
    def error_ns(self) -> float:
        """Arrival after the wanted instant, smoothed."""
        return float(self._c.error_ns)

    @property
    def trim_ppm(self) -> float:
        """By how much the period is made longer, mean of 4 s."""
        return float(self._c.trim_ns) / float(self._c.period_ns) * 1e6


@dataclass(frozen=True)
class LastCommand:
    """What a loop left a drive with.

    Attributes:
        x_cmd_m: displacement that the drive was told last; calibrated, without tare.
        x_m: last reading of the displacement then, likewise.
        seq: number of that command; one that is older is no news to a drive that still follows.
        calibration: by which both are told.
    """

    x_cmd_m: float
    x_m: float
    seq: int
    calibration: core.Calibration


@dataclass(frozen=True, eq=False)
class LoopAxis:
    """The way to the drive of one axis and back: frames, link, and what is between it and us."""

    wire: Wire
    link: Link
    calibration: core.Calibration = core.IDENTITY


class Loop:
    """Link -> wire -> station -> wire -> link -> record -> ring, once a tick.

    Args:
        station: states, limits, controller.
        wire: the controller's end of the frames.
        link: where they come from and go to.
        ring: takes every record; without one, `records` has those of the last tick.
        clock: "host": `start` a thread; "link": the same, and its ticks follow the drive's samples;
            "stepped": `step` for each tick, or a thread that `ticker` grants ticks to.
        calibration: between the wire and the station.
        lead_us: link clock: a pair arrives so long before its tick, from 10 to half a period.
        paced: stepped clock: False where the drive does not wait for the ticks, so that its count
            says nothing of two clocks, and no slip is looked for.
        further: of several axes, all but the first, of which ``wire``, ``link`` and ``calibration``
            are. Ticks of the link clock follow the first axis' drive.

    Its ticks are as long as the station's ``period_s`` says.

    Raises:
        core.CoreError: a calibration or the lead is senseless, the station has other axes, or its
            period is not that of a whole number of ticks a second, 256 to 4096.
    """

    def __init__(
        self,
        station: core.Station,
        wire: Wire,
        link: Link,
        ring: RingMemory | None = None,
        clock: Clock = "stepped",
        calibration: core.Calibration = core.IDENTITY,
        lead_us: float = 200.0,
        *,
        paced: bool = True,
        further: Sequence[LoopAxis] = (),
    ) -> None:
        self._ways = (LoopAxis(wire, link, calibration), *further)
        self._axes = station.config.controller.axis_count
        if len(self._ways) != self._axes:
            raise core.CoreError(
                f"found {len(self._ways)} links; there must be one for each of the {self._axes} "
                "axes"
            )
        self._kept = (station, wire, link, ring)
        # Doubles, for the sake of their alignment.
        self._memory = ffi.new("double[]", lib.rthyb_loop_size() // ffi.sizeof("double") + 1)
        self._c = ffi.cast("rthyb_loop *", self._memory)
        self._ag = ffi.from_buffer("double[]", station._ag)
        config = {
            "station": station._c,
            "axis": [
                (way.wire.struct, way.link.struct, way.calibration.struct()[0])
                for way in self._ways
            ],
            "ring": ffi.NULL if ring is None else ring.pointer,
            "ag_mps2": self._ag,
            "ag_count": station._ag.size,
            "clock": _CLOCKS[clock],
            "unpaced": not paced,
            "lead_ns": lead_us * 1e3,
        }
        if lib.rthyb_loop_init(self._c, ffi.new("rthyb_loop_config *", config)):
            raise core.CoreError(self._refused(lead_us))
        self._clock = clock
        self._running = False
        self._ring = None if ring is None else ring.pointer
        self._next: tuple[core.Station, RingMemory | None, Any, Any] | None = None
        self._load_generation = 0

    def _refused(self, lead_us: float) -> str:
        least, most = RATES_HZ
        if not (rate_hz := self.rate_hz):
            hz = 1.0 / self._kept[0].config.controller.period_s
            return (
                f"found {hz:g} ticks per second; the rate must be a whole number from {least} to "
                f"{most}"
            )
        return (
            f"found a lead of {lead_us} us of a pair before its tick; at {rate_hz} Hz 10 to "
            f"{_most_lead_us(rate_hz)} us are allowed"
        )

    @property
    def rate_hz(self) -> int:
        """Ticks a second."""
        return int(lib.rthyb_ticker_rate_hz(self._kept[0].config.controller.period_s))

    def drop_old(self) -> None:
        """Stepped clock: drop what waits in the link, once, before the first tick.

        The other clocks do it by themselves.
        """
        lib.rthyb_loop_drop_old(self._c)

    def continue_from(self, last: LastCommand | Sequence[LastCommand]) -> None:
        """Begin with what an earlier loop at these links told the drives last; before the start.

        It holds if no drive has stopped meanwhile and their first readings are those of then,
        within the station's ``rest_spread_m``. Else the commands begin at the first readings.

        Raises:
            core.CoreError: it is not of as many axes.
        """
        given = [last] if isinstance(last, LastCommand) else list(last)
        if len(given) != self._axes:
            raise core.CoreError(
                f"found {len(given)} last commands; there must be one for each of the "
                f"{self._axes} axes"
            )
        struct = ffi.new("rthyb_last_command[]", self._axes)
        for slot, one, way in zip(struct, given, self._ways, strict=True):
            # Told by another calibration it is another place; the drive counts on all the same.
            same = one.calibration == way.calibration
            slot.x_cmd_m, slot.seq = one.x_cmd_m, one.seq
            slot.x_m = one.x_m if same else math.nan
        lib.rthyb_loop_continue_from(self._c, struct)

    def last_command(self) -> LastCommand | None:
        """Return what the first axis' drive was left with, once the loop has ended.

        None: nothing was ever sent, or it did not end at rest.
        """
        last = self.last_commands()
        return last[0] if last else None

    def last_commands(self) -> tuple[LastCommand, ...] | None:
        """Return the same of every axis."""
        struct = ffi.new("rthyb_last_command[]", self._axes)
        if not lib.rthyb_loop_last(self._c, struct):
            return None
        return tuple(
            LastCommand(one.x_cmd_m, one.x_m, one.seq, way.calibration)
            for one, way in zip(struct, self._ways, strict=True)
        )

    def step(self, skipped: int = 0) -> None:
        """Run one tick of the stepped clock, after ``skipped`` that nobody executes."""
        if skipped:
            lib.rthyb_ticker_miss(self._ticker, skipped)
        lib.rthyb_loop_step(self._c)

    def await_pair(self, seconds: float) -> bool:
        """Stepped clock: wait until every axis has a pair for `step`; False: one has none."""
        end = time.monotonic() + seconds
        came = [self._await_pair(way, end) for way in self._ways]
        return all(came)

    @staticmethod
    def _await_pair(way: LoopAxis, end: float) -> bool:
        wire, link = way.wire, way.link
        while True:
            lib.rthyb_link_drain(link.struct, wire.struct)
            left = end - time.monotonic()
            if wire.struct.fresh or link.down != "up" or left <= 0.0:
                return bool(wire.struct.fresh)
            select.select([link.fd], [], [], left)

    def start(self, priority: int = PRIORITY, cpu: int = -1, latency_fd: int = -1) -> None:
        """Start the tick thread, as punctual as the system lets it be.

        Arguments are those of `rthyb_rt.core.ticker.become_real_time`.

        Raises:
            RthybError: the system refused a thread.
        """
        error = lib.rthyb_loop_start(self._c, priority, cpu, latency_fd)
        if error:
            raise RthybError(f"the tick thread could not be started: {os.strerror(error)}")
        self._running = True

    def stop(self) -> None:
        """End the thread, for good; what moves is then stopped by the drive's own watchdog."""
        lib.rthyb_ticker_stop(self._ticker)
        if self._running:
            lib.rthyb_loop_join(self._c)
        self._running = False

    def leave(self) -> None:
        """Tell a drive at rest, once the loop has ended, that the silence that follows is meant.

        Its watchdog stops it all the same, but then it asks nobody to reset it.
        """
        for _ in range(_FAREWELLS):
            if not lib.rthyb_loop_leave(self._c):
                return
            if self._clock != "stepped":
                time.sleep(core.PERIOD_S)

    def grant(self, ticks: int) -> None:
        """Let a thread with the stepped clock run so many more ticks."""
        lib.rthyb_ticker_grant(self._ticker, ticks)

    def command(self, command: core.Command) -> int | None:
        """Leave an operator's command for the next tick; return its generation.

        None: the last one is not answered yet, and only "trip" takes its place.
        """
        return lib.rthyb_loop_command(self._c, core.COMMANDS.index(command)) or None

    def answer(self, generation: int) -> tuple[bool, int] | None:
        """Return whether a command was obeyed and in which tick; None: not answered yet."""
        tick = ffi.new("uint64_t *")
        answer = lib.rthyb_loop_answered(self._c, generation, tick)
        return (answer == 1, tick[0]) if answer else None

    def load(self, station: core.Station, ring: RingMemory | None) -> int:
        """Have the next tick go on with another station and ring; return the load's generation.

        Ticks, wire and link stay, so that the drive notices nothing. Station and ring of before
        are kept alive until `loaded` has said that they are no longer in use.

        Raises:
            core.CoreError: the load before has not been answered yet; the tick thread stands.
        """
        if self._next is not None and self.loaded(self._load_generation) is None:
            raise core.CoreError(
                "the test that was loaded before has not yet been taken over; wait for the next "
                "tick"
            )
        ag = ffi.from_buffer("double[]", station._ag)
        fresh = None if ring is None else ring.pointer
        self._next = (station, ring, ag, fresh)
        struct = ffi.new("rthyb_load *", (station._c, fresh or ffi.NULL, ag, station._ag.size))
        self._load_generation = int(lib.rthyb_loop_load(self._c, struct))
        return self._load_generation

    def loaded(self, generation: int) -> bool | None:
        """Return whether a load was taken; False: its station may not go, for it is not in IDLE.

        None: not answered yet.
        """
        newest = lib.rthyb_loop_loaded(self._c, self._load_generation)
        if newest == 1 and self._next is not None:
            station, ring, self._ag, self._ring = self._next
            self._kept = (station, *self._kept[1:3], ring)
        if newest:
            self._next = None
        answer = lib.rthyb_loop_loaded(self._c, generation)
        return answer == 1 if answer else None

    @property
    def load_tick(self) -> int:
        """Tick of the loop in which the present station had its tick 0; after a load."""
        return int(self._look().load_tick)

    def set_parameters(self, parameters: core.Parameters) -> int:
        """Publish a set of parameters; return its generation, which records then show.

        The next tick takes it whole. One thread at a time.

        Raises:
            core.CoreError: a value is out of range, there is nothing to watch under a name, or the
                set is of another number of axes; the set before stays in force.
        """
        if len(parameters.axes) not in (0, self._axes):
            raise core.CoreError(
                f"found parameters for {len(parameters.axes)} axes; the rig has {self._axes}: "
                "give them for every axis, or only those that apply to all axes alike"
            )
        struct = parameters.struct()
        if lib.rthyb_loop_set_parameters(self._c, struct):
            raise core.CoreError(
                f"{parameters}: limits must be from 0 to 1e12 (velocity and acceleration of the "
                "command from 0 to 1e6), the velocity of slow paths from 1e-9 to 1e3 m/s and "
                "their acceleration from 1e-9 to 1e6 m/s^2"
            )
        return int(struct.generation)

    def set_taken(self, generation: int) -> bool | None:
        """Return whether a set of parameters, or a later one, came in force; None: not seen yet.

        False: outside IDLE it would switch off a limit of the command; the set before stays.
        """
        answer = lib.rthyb_loop_set_taken(self._c, generation)
        return answer == 1 if answer else None

    def beat(self) -> None:
        """Give a sign of life; after a second without one the test ramps out."""
        lib.rthyb_loop_beat(self._c)

    @property
    def state(self) -> str:
        """Name of the station's state after the last tick; readable at any time."""
        return str(core.STATES[self._look().state])

    @property
    def cause(self) -> str:
        """The station's latched first cause; readable at any time."""
        return str(core.CAUSES[self._look().cause])

    @property
    def cause_tick(self) -> int:
        """Tick in which that cause came up; readable at any time."""
        return int(self._look().cause_tick)

    @property
    def began_ns(self) -> int:
        """CLOCK_MONOTONIC at the records' ``due_ns`` 0; stepped clock: 0; readable at any time."""
        return int(self._look().began_ns)

    @property
    def locked(self) -> bool:
        """Link clock: whether the ticks follow the drive's samples; readable at any time."""
        return bool(self._look().locked)

    @property
    def arrival_error_us(self) -> float:
        """Link clock: how long after the wanted instant pairs arrive, smoothed; at any time."""
        return int(self._look().arrival_error_ns) / 1e3

    @property
    def trim_ppm(self) -> float:
        """Link clock: by how much the period is made longer, mean of 4 s; readable at any time."""
        return int(self._look().trim_ppb) / 1e3

    @property
    def records(self) -> core.RecordArray:
        """Records of the last tick, a copy; not while a thread runs."""
        count = ffi.new("uint32_t *")
        records = lib.rthyb_loop_records(self._c, count)
        return copy_records(records, count[0], self._axes)

    @property
    def link_delay(self) -> int | None:
        """Samples from command to feedback that the first wire takes, by the last echo."""
        return self.axis_delays[0]

    @property
    def axis_delays(self) -> tuple[int | None, ...]:
        """The same of every axis; readable at any time."""
        delays = self._look().delay[0 : self._axes]
        return tuple(None if delay < 0 else int(delay) for delay in delays)

    def link_delays(self) -> npt.NDArray[np.int64]:
        """Return how many pairs of the RUNNING state the wire delayed by n samples, (256,).

        The last one: that and more. Readable at any time.
        """
        delays = lib.rthyb_loop_delays(self._c)
        return np.array(list(delays[0 : lib.RTHYB_LINK_DELAYS]), dtype=np.int64)

    @property
    def counts(self) -> Counts:
        """Ticks so far; readable at any time."""
        out = ffi.new("rthyb_ticker_counts *")
        lib.rthyb_ticker_read(self._ticker, out)
        return Counts(out.elapsed, out.executed, out.skipped, out.longest_skip)

    def counters(self) -> dict[str, int]:
        """Return every counter of ``rthyb_loop_counters`` by name; readable at any time."""
        return _by_name(lib.rthyb_loop_counted(self._c)[0])

    @property
    def wake(self) -> Latency:
        """Histogram of the wake-up latency; readable at any time."""
        return Latency(ffi.addressof(self._ticker, "wake"), self._memory)

    @property
    def sent(self) -> Latency:
        """Histogram of the time from wake-up to the command being sent; readable at any time."""
        return Latency(lib.rthyb_loop_sent(self._c), self._memory)

    @property
    def privileges(self) -> list[str]:
        """What the thread obtained; names of `rthyb_rt.core.ticker.PRIVILEGES`."""
        return privilege_names(lib.rthyb_loop_ended(self._c, ffi.new("rthyb_usage *")))

    def usage(self) -> dict[str, int]:
        """Return what the system did to the thread, once it has ended: ``rthyb_usage`` by name."""
        usage = ffi.new("rthyb_usage *")
        lib.rthyb_loop_ended(self._c, usage)
        return _by_name(usage[0])

    @property
    def _ticker(self) -> Any:
        return lib.rthyb_loop_ticker(self._c)

    def _look(self) -> Any:
        """Return a ``rthyb_loop_view``."""
        view = ffi.new("rthyb_loop_view *")
        lib.rthyb_loop_look(self._c, view)
        return view


@dataclass(frozen=True)
class Fault:
    """What goes wrong at the drive, from its tick ``first`` on for ``ticks`` ticks.

    ``value``: of drop and drop-command the probability, of delay ticks, of jump m, of force N.
    ``axis``: number of the drive among those of `Drives`; one alone does not look at it.
    """

    kind: FaultKind
    first: int
    ticks: int
    value: float = 1.0
    axis: int = 0


class Drive:
    """Actuator controller and load cell at the other end of the wire, with a watchdog of their own.

    Args:
        rig: what moves and measures, of one axis, or of several of which `Drives` move it.
        codec: the frames.
        link: their other end.
        origin_m: where the rig's zero lies, behind the calibration.
        stop_decel_m_per_s2: how it brakes on its own.
        log_ticks: how many ticks `log` has room for.
        seed: of the faults.
        drift_ppm: how much the clock of `run` is fast, 199 at most.
        calibration: the controller's; the drive applies its inverse.

    Raises:
        core.CoreError: the deceleration is not positive, the drift too large, or the calibration
            senseless.
    """

    def __init__(
        self,
        rig: core.Rig | CoupledRig,
        codec: Codec,
        link: Link,
        *,
        origin_m: float = 0.0,
        stop_decel_m_per_s2: float = 1.0,
        log_ticks: int = 0,
        seed: int = 0,
        drift_ppm: float = 0.0,
        calibration: core.Calibration = core.IDENTITY,
    ) -> None:
        self._c = ffi.new("rthyb_drive *")
        self._kept = (rig, codec, link)
        self._log: npt.NDArray[np.void] = np.zeros(log_ticks, LOG_DTYPE)
        self._c.plant, self._c.link, self._c.codec = plant_of(rig)[0], link.struct, codec.struct[0]
        self.rig = rig
        self._c.origin_m, self._c.stop_decel_m_per_s2 = origin_m, stop_decel_m_per_s2
        self._c.calibration = calibration.struct()[0]
        self._c.log = ffi.cast("rthyb_drive_entry *", ffi.from_buffer(self._log))
        self._c.log_size, self._c.seed, self._c.drift_ppm = log_ticks, seed, drift_ppm
        self._faults: Any = None
        if lib.rthyb_drive_init(self._c):
            raise core.CoreError(
                f"found a drive that brakes with {stop_decel_m_per_s2} m/s^2 and whose clock is "
                f"{drift_ppm} ppm fast; the deceleration must be above 0 and the clock's "
                "deviation at most 199 ppm"
            )

    def schedule(self, faults: Sequence[Fault]) -> None:
        """Put a schedule of faults in force, in place of the one before; between two ticks.

        Raises:
            core.CoreError: a fault is out of range; the schedule of before stays.
        """
        table = ffi.new(
            "rthyb_fault[]", [(_FAULTS[f.kind], f.first, f.ticks, f.value) for f in faults]
        )
        if lib.rthyb_drive_schedule(self._c, table, len(faults)):
            raise core.CoreError("a fault of the virtual drive is out of range")
        self._faults = table

    def tick(self) -> None:
        """Run one sample: take commands in, latch, apply, answer.

        Raises:
            core.CoreError: it is one of several of its rig.
        """
        self._require_alone()
        lib.rthyb_drive_tick(self._c)

    def run(self, ticker: Ticker) -> None:
        """Tick until the ticker is stopped from another thread.

        Raises:
            core.CoreError: as `tick` does, or the ticker has another rate than the rig.
        """
        self._require_alone()
        _require_rate(self, ticker)
        lib.rthyb_drive_run(self._c, ticker._c)

    def _require_alone(self) -> None:
        axes = int(lib.rthyb_plant_axes(ffi.addressof(self._c, "plant")))
        if axes != 1:
            raise core.CoreError(f"one drive cannot move a rig with {axes} axes; use Drives")

    @property
    def drives(self) -> tuple[Drive, ...]:
        """Itself: what `Drives` has of every axis."""
        return (self,)

    @property
    def ticks(self) -> int:
        """Samples so far."""
        return int(self._c.tick)

    @property
    def rate_hz(self) -> int:
        """Samples a second of its rig, and so of itself; 0: no whole number, for no ticker."""
        period_s = lib.rthyb_plant_period_s(ffi.addressof(self._c, "plant"))
        return int(lib.rthyb_ticker_rate_hz(period_s))

    @property
    def watchdog_ticks(self) -> int:
        """Samples without a fresh command after which it stops: 19.5 ms at any rate."""
        return int(self._c.watchdog)

    @property
    def phase(self) -> str:
        """One of `PHASES`; readable at any time."""
        return PHASES[int(self._c.phase)]

    @property
    def received_state(self) -> str:
        """The controller's state in the last fresh command; readable at any time."""
        state = int(self._c.state)
        return dict(enumerate(core.STATES)).get(state) or NOTICES.get(state) or str(state)

    @property
    def latched(self) -> bool:
        """Whether it has stopped by itself, and follows nobody until it is reset; at any time."""
        return bool(self._c.latched)

    @property
    def log(self) -> npt.NDArray[np.void]:
        """What it saw and did, `LOG_DTYPE`, (ticks,): row n is its tick n."""
        return self._log[: self.ticks].copy()


class Drives:
    """The drives of all axes of one virtual rig, in its order, by the clock of the first.

    Args:
        drives: one an axis, each made with that rig.

    Raises:
        core.CoreError: the rig has other axes, or they have not the same one.
    """

    def __init__(self, drives: Sequence[Drive]) -> None:
        self.drives = tuple(drives)
        self._c = ffi.new("rthyb_drives *", {"count": len(self.drives)})
        for k, drive in enumerate(self.drives[: lib.RTHYB_COUPLED_MAX]):
            self._c.drive[k] = drive._c
        if lib.rthyb_drives_check(self._c):
            raise core.CoreError(
                f"found {len(self.drives)} drives; this virtual rig needs one for each of its "
                "axes, created with it"
            )

    def tick(self) -> None:
        """Run one sample of all of them: take all commands in, latch, apply, answer."""
        lib.rthyb_drives_tick(self._c)

    def run(self, ticker: Ticker) -> None:
        """Tick until the ticker is stopped from another thread.

        Raises:
            core.CoreError: the ticker has another rate than the rig.
        """
        _require_rate(self.drives[0], ticker)
        lib.rthyb_drives_run(self._c, ticker._c)

    def schedule(self, faults: Sequence[Fault]) -> None:
        """Put a schedule of faults in force, each at the drive of its axis, in place of the last.

        Raises:
            core.CoreError: a fault is out of range, or of an axis that there is not.
        """
        strange = [fault.axis for fault in faults if not 0 <= fault.axis < len(self.drives)]
        if strange:
            raise core.CoreError(
                f"found a fault for axis number {strange[0]}; the axes are numbered from 0 to "
                f"{len(self.drives) - 1}"
            )
        for k, drive in enumerate(self.drives):
            drive.schedule([fault for fault in faults if fault.axis == k])

    @property
    def ticks(self) -> int:
        """Samples so far."""
        return self.drives[0].ticks

    @property
    def received_state(self) -> str:
        """The controller's state in the last fresh command of the first; readable at any time."""
        return self.drives[0].received_state

    @property
    def log(self) -> npt.NDArray[np.void]:
        """What they saw and did, `LOG_DTYPE`, (ticks, axes)."""
        return np.stack([drive.log for drive in self.drives], axis=1)


def _require_rate(drive: Drive, ticker: Ticker) -> None:
    if drive.rate_hz != ticker.rate_hz:
        raise core.CoreError(
            f"the virtual rig was made for {drive.rate_hz} Hz, but its clock ticks at "
            f"{ticker.rate_hz} Hz; the two must be equal"
        )


def _most_lead_us(rate_hz: int) -> float:
    """Return half a period, which a pair may arrive before its tick at most, us."""
    return round(0.5e6 / max(rate_hz, 1), 1)


def _by_name(struct: Any) -> dict[str, int]:
    return {name: int(getattr(struct, name)) for name, _ in ffi.typeof(struct).fields}
