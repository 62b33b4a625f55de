"""Python interface of the tick: a link, the loop with one sample per tick, the virtual drive.

Names follow ``csrc/rthyb.h``, which states the contract. Calls that run or wait release the GIL.
While the thread of a loop runs, everything from which the loop was made belongs to that thread:
only what is documented as readable at any time may then be read.
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
from rthyb_rt.core.kinematics import AXES_MAX
from rthyb_rt.core.library import options, words
from rthyb_rt.core.rows import RingMemory, copy_records
from rthyb_rt.core.ticker import PRIORITY, RATES_HZ, Latency, TickCounts, Ticker, privilege_names
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
"""Ticks of 1/1024 s without a call of `Loop.beat` after which the test ramps out."""
SLIP_VOTES: Final[int] = lib.RTHYB_SLIP_VOTES
WATCHDOG_TICKS: Final[int] = lib.RTHYB_DRIVE_WATCHDOG
"""Ticks of 1/1024 s without a fresh command, after which the virtual drive stops."""
PHASES: Final = tuple(words("rthyb_drive_phase", "RTHYB_DRIVE_"))
LINK_FAULTS: Final = tuple(options("rthyb_link_fault", "RTHYB_LINK_"))
"""Why a link is down, by its number in the core."""

_FAREWELLS: Final = 3
"""Number of farewell frames, so that a single lost one does not matter."""

_KINDS: Final = options("rthyb_link_kind", "RTHYB_LINK_")
_CLOCKS: Final = options("rthyb_clock", "RTHYB_CLOCK_")
_FAULTS: Final = options("rthyb_drive_fault", "RTHYB_FAULT_")

LOG_DTYPE: Final = core.dtype_of("rthyb_drive_entry")
"""What a drive received and did in one of its ticks: the fields of ``rthyb_drive_entry``."""


class Link:
    """Frames over a descriptor that the caller opened and configured; no call waits.

    Args:
        kind: "can": a SocketCAN socket, or a SOCK_SEQPACKET socket that carries its frames;
            "stream": a tty in raw mode or a stream socket, with O_NONBLOCK.
        fd: the descriptor, which the link duplicates.

    Raises:
        RthybError: the descriptor is closed, or a stream on which a reader would wait.
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
        """Close the link's own descriptor; a second call has no effect."""
        lib.rthyb_link_close(self.struct)

    def receive(self) -> Frame | None:
        """Return a CAN frame, or some bytes of a stream; None: nothing more has arrived.

        Must not be called while a loop uses the link.
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
        return LINK_FAULTS[int(self.struct.down)]

    def counters(self) -> dict[str, int]:
        """Return every counter of ``rthyb_link_counters`` by name; readable at any time."""
        return _by_name(self.struct.counters)


class Phase:
    """The control loop of the link clock alone: arrival times in, corrections of the due times out.

    Args:
        lead_us: time by which a pair should arrive before its tick, from 10 us to half a period.
        rate_hz: ticks per second, 256 to 4096.

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
        """Return the argument for `rthyb_rt.core.ticker.Ticker.trim` after a tick, ns.

        ``after_due_ns``: arrival of the tick's pair after its due time; None: no pair arrived.
        """
        came = after_due_ns is not None
        return int(lib.rthyb_phase_step(self._c, came, after_due_ns or 0.0))

    def typical(self, arrived_ns: Sequence[int]) -> int:
        """Return the arrival time, ns, whose phase in the period is closest to all others."""
        stamps = ffi.new("int64_t[]", list(arrived_ns))
        return int(arrived_ns[lib.rthyb_phase_typical(self._c, stamps, len(arrived_ns))])

    @property
    def locked(self) -> bool:
        """Whether the error has been small for a quarter of a second."""
        return bool(self._c.locked)

    @property
    def error_ns(self) -> float:
        """Arrival relative to the intended instant, smoothed; positive: late."""
        return float(self._c.error_ns)

    @property
    def trim_ppm(self) -> float:
        """Extension of the period, mean over 4 s."""
        return float(self._c.trim_ns) / float(self._c.period_ns) * 1e6


@dataclass(frozen=True)
class LastCommand:
    """The last command that a loop sent to a drive.

    Attributes:
        x_cmd_m: displacement in that command; calibrated, without tare.
        x_m: last reading of the displacement at that time, likewise.
        seq: sequence number of that command; a drive that still follows ignores older numbers.
        calibration: calibration by which both were converted.
    """

    x_cmd_m: float
    x_m: float
    seq: int
    calibration: core.WireCalibration


@dataclass(frozen=True, eq=False)
class LoopAxis:
    """Connection to the drive of one axis: frames, link and calibration."""

    wire: Wire
    link: Link
    calibration: core.WireCalibration = core.IDENTITY


class Loop:
    """Link -> wire -> station -> wire -> link -> record -> ring, once per tick.

    Args:
        station: states, limits, controller.
        wire: the controller's end of the frames.
        link: sends and receives the frames.
        ring: receives every record; without a ring, `records` has those of the last tick.
        clock: "host": `start` a thread; "link": the same, and its ticks follow the drive's samples;
            "stepped": call `step` for each tick, or `grant` ticks to a thread.
        calibration: conversion between the wire and the station.
        lead_us: link clock: time by which a pair arrives before its tick, 10 us to half a period.
        paced: stepped clock: False if the drive does not wait for the ticks, so that its count
            does not show the difference of two clocks, and slips are not counted.
        further: for several axes, all but the first, to which ``wire``, ``link`` and
            ``calibration`` belong. With the link clock, ticks follow the first axis' drive.
        sensors: for each of the station's sensors without an actuator, the axis whose feedback has
            its reading, and the number of the extra channel there; numbers beyond those of the
            axes are of ``heard``.
        heard: further drives to which nothing is sent, for the sensors in their feedback.
        heard_channel: first channel of a row for displacement and force of each of them; nan
            without a pair.

    The length of a tick is the station's ``period_s``.

    Raises:
        core.CoreError: a calibration or the lead is out of range, the station has other axes, or
            its period is not that of a whole number of ticks per second, 256 to 4096.
    """

    def __init__(
        self,
        station: core.Station,
        wire: Wire,
        link: Link,
        ring: RingMemory | None = None,
        clock: Clock = "stepped",
        calibration: core.WireCalibration = core.IDENTITY,
        lead_us: float = 200.0,
        *,
        paced: bool = True,
        further: Sequence[LoopAxis] = (),
        sensors: Sequence[tuple[int, int]] = (),
        heard: Sequence[LoopAxis] = (),
        heard_channel: int = 0,
    ) -> None:
        self._ways = (LoopAxis(wire, link, calibration), *further)
        self._heard = tuple(heard)
        self._axes = station.config.controller.axis_count
        if len(self._ways) != self._axes:
            raise core.CoreError(
                f"found {len(self._ways)} links; there must be one for each of the {self._axes} "
                "axes"
            )
        if len(self._ways) + len(self._heard) > AXES_MAX:
            raise core.CoreError(
                f"found {len(self._ways)} axes and {len(self._heard)} drives that are heard; there "
                f"may be up to {AXES_MAX} together"
            )
        tie = station.config.controller.kinematics
        asked = 0 if tie is None else tie.sensors
        if len(sensors) != asked:
            raise core.CoreError(
                f"found the places of {len(sensors)} sensors without an actuator in the feedback; "
                f"the station has {asked} of them"
            )
        self._kept = (station, wire, link, ring)
        # An array of doubles, for its alignment.
        self._memory = ffi.new("double[]", lib.rthyb_loop_size() // ffi.sizeof("double") + 1)
        self._c = ffi.cast("rthyb_loop *", self._memory)
        self._ag = ffi.from_buffer("double[]", station._ag)
        config = {
            "station": station._c,
            "axis": [
                (way.wire.struct, way.link.struct, way.calibration.struct()[0])
                for way in (*self._ways, *self._heard)
            ],
            "heard_count": len(self._heard),
            "heard_channel": heard_channel,
            "sensor_axis": [axis for axis, _ in sensors],
            "sensor_extra": [number for _, number in sensors],
            "ring": ffi.NULL if ring is None else ring.pointer,
            "ag_mps2": self._ag,
            "ag_count": station._ag.size,
            "clock": _CLOCKS[clock],
            "unpaced": not paced,
            "lead_ns": lead_us * 1e3,
        }
        error = lib.rthyb_loop_init(self._c, ffi.new("rthyb_loop_config *", config))
        if error == lib.RTHYB_E_KINEMATICS:
            raise core.CoreError(
                f"found sensors without an actuator at {list(sensors)}; each must be an axis, or "
                "a drive that is heard, and the number of an extra channel in its feedback, both "
                "from 0, and the channel must carry the whole range of the sensor, which must not "
                "be 0"
            )
        if error:
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
        """Ticks per second."""
        return int(lib.rthyb_ticker_rate_hz(self._kept[0].config.controller.period_s))

    def drop_old(self) -> None:
        """Stepped clock: discard what is waiting in the link, once, before the first tick.

        The other clocks do this themselves.
        """
        lib.rthyb_loop_drop_old(self._c)

    def continue_from(self, last: LastCommand | Sequence[LastCommand]) -> None:
        """Start from the last commands of an earlier loop with these links; call before the start.

        They are used if no drive has stopped in the meantime and the first readings equal the
        earlier ones within the station's ``rest_spread_m``. Otherwise the commands start at the
        first readings.

        Raises:
            core.CoreError: the number of commands is not that of the axes.
        """
        given = [last] if isinstance(last, LastCommand) else list(last)
        if len(given) != self._axes:
            raise core.CoreError(
                f"found {len(given)} last commands; there must be one for each of the "
                f"{self._axes} axes"
            )
        struct = ffi.new("rthyb_last_command[]", self._axes)
        for slot, one, way in zip(struct, given, self._ways, strict=True):
            # Another calibration means another position; the drive's count goes on nevertheless.
            same = one.calibration == way.calibration
            slot.x_cmd_m, slot.seq = one.x_cmd_m, one.seq
            slot.x_m = one.x_m if same else math.nan
        lib.rthyb_loop_continue_from(self._c, struct)

    def last_command(self) -> LastCommand | None:
        """Return the last command of the first axis' drive, once the loop has ended.

        None: nothing was ever sent, or the loop did not end at rest.
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
        """Run one tick of the stepped clock, after ``skipped`` ticks that are not executed."""
        if skipped:
            lib.rthyb_ticker_miss(self._ticker, skipped)
        lib.rthyb_loop_step(self._c)

    def await_pair(self, seconds: float) -> bool:
        """Stepped clock: wait until every axis has a pair for `step`; False: one has no pair."""
        end = time.monotonic() + seconds
        came = [self._await_pair(way, end) for way in (*self._ways, *self._heard)]
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
        """Start the tick thread with the best punctuality that the system permits.

        The arguments are those of `rthyb_rt.core.ticker.become_real_time`.

        Raises:
            RthybError: the system refused a thread.
        """
        error = lib.rthyb_loop_start(self._c, priority, cpu, latency_fd)
        if error:
            raise RthybError(f"the tick thread could not be started: {os.strerror(error)}")
        self._running = True

    def stop(self) -> None:
        """End the thread permanently; the drive's own watchdog then stops any motion."""
        lib.rthyb_ticker_stop(self._ticker)
        if self._running:
            lib.rthyb_loop_join(self._c)
        self._running = False

    def leave(self) -> None:
        """Announce to a drive at rest, once the loop has ended, that the commands end on purpose.

        Its watchdog stops it all the same, but it then needs no reset by an operator.
        """
        for _ in range(_FAREWELLS):
            if not lib.rthyb_loop_leave(self._c):
                return
            if self._clock != "stepped":
                time.sleep(core.PERIOD_S)

    def grant(self, ticks: int) -> None:
        """Let a thread with the stepped clock run a number of further ticks."""
        lib.rthyb_ticker_grant(self._ticker, ticks)

    def command(self, command: core.Command) -> int | None:
        """Submit an operator's command for the next tick; return its generation.

        None: the last command has not been answered yet, and only "trip" may replace it.
        """
        return lib.rthyb_loop_command(self._c, core.COMMANDS.index(command)) or None

    def answer(self, generation: int) -> tuple[bool, int] | None:
        """Return whether a command was accepted and in which tick; None: not answered yet."""
        tick = ffi.new("uint64_t *")
        answer = lib.rthyb_loop_answered(self._c, generation, tick)
        return (answer == 1, tick[0]) if answer else None

    def load(self, station: core.Station, ring: RingMemory | None) -> int:
        """Switch to another station and ring in the next tick; return the generation of the load.

        Ticks, wire and link continue, so the drive notices nothing. The previous station and ring
        are kept alive until `loaded` reports that they are no longer in use.

        Raises:
            core.CoreError: the previous load has not been answered yet: the tick thread has
                stalled.
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
        """Return whether a load was accepted; False: the previous station is not in IDLE.

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
        """Tick of the loop in which the current station had its tick 0; after a load."""
        return int(self._look().load_tick)

    def set_parameters(self, parameters: core.Parameters) -> int:
        """Publish a set of parameters; return its generation, which records then show.

        The next tick applies it as a whole. Only one thread may call this at a time.

        Raises:
            core.CoreError: a value is out of range, no watched quantity has a given name, or the
                set has another number of axes; the previous set remains in force.
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
        """Return whether a set of parameters, or a later one, took effect; None: not seen yet.

        False: it would have switched off a limit of the command outside IDLE; the previous set
        remains in force.
        """
        answer = lib.rthyb_loop_set_taken(self._c, generation)
        return answer == 1 if answer else None

    def beat(self) -> None:
        """Report that the program is alive; after a second without this call the test ramps out."""
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
        """Tick in which that cause occurred; readable at any time."""
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
        """Link clock: delay of pairs after the intended instant, smoothed; readable at any time."""
        return int(self._look().arrival_error_ns) / 1e3

    @property
    def trim_ppm(self) -> float:
        """Link clock: extension of the period, mean over 4 s; readable at any time."""
        return int(self._look().trim_ppb) / 1e3

    @property
    def records(self) -> core.RecordArray:
        """Copy of the records of the last tick; must not be read while a thread runs."""
        count = ffi.new("uint32_t *")
        records = lib.rthyb_loop_records(self._c, count)
        return copy_records(records, count[0], self._axes)

    @property
    def link_delay(self) -> int | None:
        """Samples from command to feedback on the first wire, by the last echo."""
        return self.axis_delays[0]

    @property
    def axis_delays(self) -> tuple[int | None, ...]:
        """The same of every axis; readable at any time."""
        delays = self._look().delay[0 : self._axes]
        return tuple(None if delay < 0 else int(delay) for delay in delays)

    def link_delays(self) -> npt.NDArray[np.int64]:
        """Return the number of pairs in RUNNING that the wire delayed by n samples, (256,).

        The last entry includes all longer delays. Readable at any time.
        """
        delays = lib.rthyb_loop_delays(self._c)
        return np.array(list(delays[0 : lib.RTHYB_LINK_DELAYS]), dtype=np.int64)

    @property
    def counts(self) -> TickCounts:
        """Ticks so far; readable at any time."""
        out = ffi.new("rthyb_ticker_counts *")
        lib.rthyb_ticker_read(self._ticker, out)
        return TickCounts(out.elapsed, out.executed, out.skipped, out.longest_skip)

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
        """Return the resource usage of the thread, once it has ended: ``rthyb_usage`` by name."""
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
    """A fault of the drive, from its tick ``first`` on for ``ticks`` ticks.

    ``value``: a probability for drop and drop-command, ticks for delay, m for jump, N for force.
    ``axis``: number of the drive among those of `Drives`; ignored by a single drive.
    """

    kind: FaultKind
    first: int
    ticks: int
    value: float = 1.0
    axis: int = 0


class Drive:
    """Virtual drive: servo controller and load cell at the other end of the wire, with a watchdog.

    Args:
        rig: virtual rig of one axis, or of several axes that are moved by `Drives`.
        codec: the frames.
        link: the other end of the controller's link.
        origin_m: position of the rig's zero, after calibration.
        stop_decel_m_per_s2: deceleration of the drive's own stop.
        log_ticks: number of ticks for which `log` has room.
        seed: seed of the faults.
        drift_ppm: parts per million by which the clock of `run` is fast, 199 at most.
        calibration: the controller's; the drive applies its inverse.

    Raises:
        core.CoreError: the deceleration is not positive, the drift too large, or the calibration
            out of range.
    """

    def __init__(
        self,
        rig: core.VirtualRig | CoupledRig,
        codec: Codec,
        link: Link,
        *,
        origin_m: float = 0.0,
        stop_decel_m_per_s2: float = 1.0,
        log_ticks: int = 0,
        seed: int = 0,
        drift_ppm: float = 0.0,
        calibration: core.WireCalibration = core.IDENTITY,
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
        """Replace the schedule of faults; call between two ticks.

        Raises:
            core.CoreError: a fault is out of range; the previous schedule remains.
        """
        table = ffi.new(
            "rthyb_fault[]", [(_FAULTS[f.kind], f.first, f.ticks, f.value) for f in faults]
        )
        if lib.rthyb_drive_schedule(self._c, table, len(faults)):
            raise core.CoreError("a fault of the virtual drive is out of range")
        self._faults = table

    def tick(self) -> None:
        """Run one sample: receive commands, latch the sensors, apply the command, reply.

        Raises:
            core.CoreError: its rig has several axes, so `Drives` must run it.
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
        """This drive alone, as `Drives.drives` has one for each axis."""
        return (self,)

    @property
    def ticks(self) -> int:
        """Samples so far."""
        return int(self._c.tick)

    @property
    def rate_hz(self) -> int:
        """Sample rate of its rig, and so of the drive; 0 if it is not a whole number."""
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
        """Whether it has stopped on its own and needs a reset to follow; readable at any time."""
        return bool(self._c.latched)

    @property
    def log(self) -> npt.NDArray[np.void]:
        """What it received and did, `LOG_DTYPE`, (ticks,): row n is its tick n."""
        return self._log[: self.ticks].copy()


class Drives:
    """The drives of all axes of one virtual rig, in its order, on the clock of the first.

    Args:
        drives: one for each axis, each created with that rig.

    Raises:
        core.CoreError: the rig has other axes, or the drives belong to different rigs.
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
        """Run one sample of all drives: receive all commands, latch, apply, reply."""
        lib.rthyb_drives_tick(self._c)

    def run(self, ticker: Ticker) -> None:
        """Tick until the ticker is stopped from another thread.

        Raises:
            core.CoreError: the ticker has another rate than the rig.
        """
        _require_rate(self.drives[0], ticker)
        lib.rthyb_drives_run(self._c, ticker._c)

    def schedule(self, faults: Sequence[Fault]) -> None:
        """Replace the schedule of faults, each for the drive of its axis.

        Raises:
            core.CoreError: a fault is out of range, or for an axis that does not exist.
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
        """What they received and did, `LOG_DTYPE`, (ticks, axes)."""
        return np.stack([drive.log for drive in self.drives], axis=1)


def _require_rate(drive: Drive, ticker: Ticker) -> None:
    if drive.rate_hz != ticker.rate_hz:
        raise core.CoreError(
            f"the virtual rig was made for {drive.rate_hz} Hz, but its clock ticks at "
            f"{ticker.rate_hz} Hz; the two must be equal"
        )


def _most_lead_us(rate_hz: int) -> float:
    """Return the longest time that a pair may arrive before its tick, half a period, us."""
    return round(0.5e6 / max(rate_hz, 1), 1)


def _by_name(struct: Any) -> dict[str, int]:
    return {name: int(getattr(struct, name)) for name, _ in ffi.typeof(struct).fields}
