"""Control of a rig: its link, the tick thread, and the run whose station is active.

A process that runs a single test (`rthyb_rt.lab.realtime.Session`) and a service that runs many
(`rthyb_rt.service.rig_engine.Engine`) start, wait, command, publish and end in the same way, with
the class in this module.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import repeat
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config.defaults import SKIPS
from rthyb_rt.config.rate import STANDARD_HZ, Rate
from rthyb_rt.config.rigfile import RigFile, default_lead_us
from rthyb_rt.core import FLAGS, ticker
from rthyb_rt.core.loop import Clock, Link, Loop, LoopAxis
from rthyb_rt.core.wire import Wire
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import (
    axis_wires,
    beside,
    experiment,
    extra_frames,
    punctuality,
    zeroing,
)
from rthyb_rt.lab.end_reasons import REMEDIES, RefusedError, TimingError
from rthyb_rt.lab.realtime.live_run import Counted, LiveRun, follows, stays_stopped
from rthyb_rt.lab.runs import AT_REST

if TYPE_CHECKING:
    from rthyb_rt.rig.links.opened import Opened

NEEDED: Final = ("fifo", "memory_locked")
"""Privileges without which ticks are delayed by other processes of the machine."""

FEEDBACK_S: Final = 10.0
"""Time to wait for valid pairs from a drive that follows."""

SET_REFUSED: Final = (
    "these parameters would remove a limit on the command's velocity or acceleration during a "
    "motion, and a command that is held back by that limit would jump; keep both limits (any value "
    "above 0), or stop and change them in IDLE; the previous parameters remain in force"
)
"""Why a station refuses a set of parameters, and what to do."""

_ATTEMPTS: Final = 10
_ATTEMPTS_AT_REST: Final = {"zero": 60, "reset": 60}
"""Attempts for commands at rest: a specimen that has just stopped must first come to rest."""
_BETWEEN_TICKS: Final = 2

_LOOK_S: Final = 0.001
_ANSWER_S: Final = 2.0
_FIRST_TICK_S: Final = 5.0
_TRIP_TICKS: Final = 4
"""Ticks within which the three frames of a trip have been sent."""
_RESET_TICKS: Final = 4
"""Ticks within which the three commands of a reset have been sent."""
_RELEASE_S: Final = 0.25
"""Time within which a drive that was reset reports that it follows again."""
_PAIR_S: Final = 0.25
_SILENT_WAITS: Final = 20

_RATE_S: Final = 0.1
_RATE_PAIRS: Final = 16
_RATE_OFF: Final = 0.2
"""Deviation above which a drive has another rate, measured over a tenth of a second on a PC that
may be late and a link that may lose pairs. Smaller deviations appear as slips of the two clocks."""

_T = TypeVar("_T")


class Conductor:
    """Conducts the runs on one link, from the first tick to the last.

    Commands, waiting and closing must come from one thread.

    Args:
        opened: the link, which remains the caller's.
        clock: "host"; "link": the ticks follow the drive's samples; or "stepped", which is not real
            time: waiting executes the ticks.
        before_tick: stepped clock: called before every tick, for example the drive's own tick;
            None: a tick follows each new pair.
        first: the first run; deleted if the link cannot be used.

    Attributes:
        opened, clock: as given.
        run: the run whose station is active.
        loop, wire, link: the loop, and wire and link of the first axis; see their modules for the
            readable attributes.
        ways: wire, link and calibration of every axis.
        commands_before: number of the command before the first; 0 if the drive starts from 0.
        rate: rate of the ticks; a run at another rate is not accepted.

    Raises:
        RthybError: the descriptor cannot be used.
        CoreError: a setting is rejected.
    """

    def __init__(
        self, opened: Opened, clock: Clock, before_tick: Callable[[], None] | None, first: LiveRun
    ) -> None:
        self.opened, self.clock, self.run = opened, clock, first
        self._before_tick = before_tick
        self._started = self._closed = False
        self._silent_waits = _SILENT_WAITS
        self._farewell = True
        self.commands_before = 0
        self.rate = first.setup.rate
        self._at_zero: Counted | None = None
        rigs = first.setup.rigs
        rig = rigs[0]
        with ExitStack() as undo:
            undo.callback(first.remove)
            owned = undo.enter_context(ExitStack())
            ways, channel = [], 0
            for own, at in zip(rigs, opened.all, strict=True):
                wire = Wire(extra_frames.codec_of(own, at.codec))
                # A row begins with the extra channels, those of the first axis first.
                wire.struct.extra_channel = channel
                channel += len(own.sensors.extra)
                link = Link(at.kind, at.fd)
                owned.callback(link.close)
                ways.append(LoopAxis(wire, link, axis_wires.calibration(own)))
            self.ways = tuple(ways)
            heard = [
                owned.enter_context(_heard(rig, at))
                for rig, at in _listened_to(first.setup, opened)
            ]
            self.wire, self.link = ways[0].wire, ways[0].link
            self.loop = Loop(
                first.station,
                self.wire,
                self.link,
                first.ring,
                clock,
                ways[0].calibration,
                lead_us=_lead_us(rig, self.rate),
                paced=before_tick is not None,
                further=self.ways[1:],
                sensors=_sensors_at(first.setup),
                heard=heard,
                heard_channel=beside.heard_channel(first.setup),
            )
            self._owned = owned.pop_all()
            undo.pop_all()
        first.counted = self._count()

    # ---- life cycle -----------------------------------------------------------------------------

    def start(self) -> None:
        """Start the ticks, in state IDLE.

        The command is the first reading; or, if a drive still follows the last loop on this link
        and is still at the same position, the last command of that loop.

        Raises:
            RthybError: the system refused a thread.
        """
        self._started = True
        left = [one.left for one in self.opened.all if one.left is not None]
        for one in self.opened.all:
            one.left = None
        if len(left) == len(self.ways):
            self.loop.continue_from(left)
        self.commands_before = int(self.wire.struct.seq)
        if self.clock == "stepped":
            self.loop.drop_old()
            return
        awake = self._owned.enter_context(ticker.AwakeProcessors())
        self.loop.start(
            cpu=punctuality.choose_cpu(punctuality.machine_facts()), latency_fd=awake.fd
        )
        self._owned.callback(ticker.unlock_memory)

    def check_privileges(self, warn: Callable[[str], None], *, required: bool, hint: str) -> None:
        """Report which privileges the tick thread did not obtain.

        Args:
            warn: called with a sentence for the user.
            required: refuse to continue without `NEEDED`.
            hint: how to obtain them.

        Raises:
            TimingError: a required privilege is missing.
        """
        if self.clock == "stepped":
            return
        if not self.opened.real_time:
            name = self.opened.name
            warn(f"{name}: a Python thread exchanges its frames, which is not real time")
        end = time.monotonic() + _FIRST_TICK_S
        # They are known once the thread, which first locks memory, has reached its first tick.
        while not self.loop.counts.elapsed and time.monotonic() < end:
            self._pass(_LOOK_S)
        missing = [name for name in NEEDED if name not in self.privileges]
        if not missing:
            return
        lacking = {"fifo": "real-time priority", "memory_locked": "locked memory"}
        words = f"the tick thread did not obtain {' and '.join(lacking[n] for n in missing)}"
        if required:
            raise TimingError(f"{words}, which require_realtime requires; {hint}")
        warn(f"{words}: ticks may be late or skipped; {hint}")

    def close(self) -> None:
        """End the tick thread and release everything; a second call has no effect.

        A motion is tripped first, so that the drive stops at once and not by its watchdog. A drive
        at rest is informed that the commands end on purpose.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._started and self.moving:
                self._trip()
        finally:
            self.loop.stop()
            if self._started:
                if self._farewell:
                    self.loop.leave()
                for one, last in zip(
                    self.opened.all, self.loop.last_commands() or repeat(None), strict=False
                ):
                    one.left = last
            with self._owned:
                self._close_run()

    def fall_silent(self) -> None:
        """End the tick thread as in a crash of this PC: without informing the drive."""
        self._farewell = False
        self.loop.stop()

    def _close_run(self) -> None:
        """Read the last rows and close the run; the tick thread has ended."""
        raise NotImplementedError

    def _trip(self) -> None:
        """Stop the drive without using anything that may have failed."""
        self.loop.command("trip")
        if self.clock == "stepped":
            for _ in range(_TRIP_TICKS):
                with suppress(Exception):
                    self._await_tick()
                self.loop.step()
            return
        end = time.monotonic() + _ANSWER_S
        while self.state != "TRIPPED" and time.monotonic() < end:
            time.sleep(_LOOK_S)
        time.sleep(_TRIP_TICKS * self.rate.period_s)

    # ---- state ----------------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """Name of the station's state after the last tick."""
        return self.loop.state

    @property
    def causing(self) -> tuple[str, float, float]:
        """The station's latched first cause, the value reached and the limit."""
        return self.run.causing

    @property
    def config(self) -> core.StationConfig:
        """Settings of the active station."""
        return self.run.config

    @property
    def zeroing_failed(self) -> bool:
        """Whether the last tare was refused because the reading moved."""
        return self.run.station.zeroing_failed

    @property
    def progress(self) -> tuple[int, int]:
        """Samples of the test proper so far, and of the whole test."""
        return self.run.progress

    @property
    def moving(self) -> bool:
        """Whether the drive is commanded to move, or held within a test."""
        return self.state not in AT_REST

    @property
    def privileges(self) -> list[str]:
        """Privileges that the tick thread obtained, once it runs."""
        return self.loop.privileges

    def follows(self) -> bool:
        """Whether valid pairs arrive from a drive that follows."""
        return follows(self.run.recent_flags)

    def stays_stopped(self) -> bool:
        """Whether the drive receives commands but keeps reporting that it has stopped."""
        return stays_stopped(self.run.recent_flags)

    # ---- time -----------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        """The time used for waiting; with the stepped clock, that of its ticks."""
        if self.clock == "stepped":
            return self.loop.counts.elapsed / self.rate.hz
        return time.monotonic()

    def _pass(self, seconds: float) -> None:
        """Wait; with the stepped clock, execute the ticks of that time."""
        if self.clock != "stepped":
            time.sleep(seconds)
            return
        for _ in range(self.rate.ticks(seconds)):
            self._await_tick()
            self.loop.step()

    def _await_tick(self) -> None:
        """Wait for the drive's pair, but not in every tick for a drive that has gone silent."""
        if self._before_tick is not None:
            self._before_tick()
            return
        gone = self._silent_waits >= _SILENT_WAITS
        came = self.loop.await_pair(self.rate.period_s if gone else _PAIR_S)
        self._silent_waits = 0 if came else self._silent_waits + 1

    def _wait_for(self, asked: Callable[[], _T | None]) -> _T:
        """Return the tick thread's answer.

        Raises:
            RthybError: it does not answer.
        """
        end = time.monotonic() + _ANSWER_S
        while (answer := asked()) is None:
            if time.monotonic() > end and self.clock != "stepped":
                raise RthybError(
                    "the tick thread does not respond, so the drive may receive no commands and "
                    "its own watchdog must stop it: make sure that the drive has stopped, or "
                    "press the emergency stop; then check what else uses this PC's processors, "
                    "and run `rthyb jitter`"
                )
            self._pass(_LOOK_S)
        return answer

    # ---- commands and parameters ----------------------------------------------------------------

    def command(self, name: core.Command) -> int:
        """Give an operator's command until it is accepted; return the tick in which it was.

        Raises:
            RefusedError: the current state does not allow it, or it was refused repeatedly.
            InputError, TimingError: "arm", at a rate that the drive or this PC does not keep.
            RthybError: the tick thread does not answer.
        """
        if name == "arm":
            self._refuse_rate()
        for _ in range(_ATTEMPTS_AT_REST.get(name, _ATTEMPTS)):
            state = self.state
            obeyed, tick = self._answered(name)
            tick -= self.loop.load_tick
            self.run.commands.append({"tick": tick, "command": name, "refused": not obeyed})
            if obeyed:
                if name == "zero":
                    self._at_zero = self._count()
                if name in ("arm", "start"):
                    self.run.renew()
                released = name != "reset" or self._is_released()
                if not released and state == "IDLE":
                    raise self._refusal(name, state, self._not_released())
                return tick
            if not core.command_allowed(state, name):
                raise self._refusal(name, state, "")
            # A test cannot start in a tick without a new pair, but perhaps in the next one.
            self._pass(_BETWEEN_TICKS * self.rate.period_s)
        raise self._refusal(name, state, self._why_refused(name, state))

    def _refuse_rate(self) -> None:
        """Refuse to arm at a rate other than the drive's, or above 1024 Hz if the PC misses it.

        This is judged by the time since the tare began, during which nothing has moved.

        Raises:
            InputError: a drive samples at another rate.
            TimingError: so many ticks were skipped that it would end a test.
        """
        before, now = self._at_zero, self._count()
        if before is None or now.ticks.elapsed - before.ticks.elapsed < self.rate.ticks(_RATE_S):
            return
        if why := self.other_rate(before):
            raise InputError(why, self.opened.name)
        watch = self.config.watches.get("skips")
        if self.rate.hz <= STANDARD_HZ or (watch is not None and watch.reaction == "none"):
            return
        ticks = now.ticks.elapsed - before.ticks.elapsed
        skipped = now.ticks.skipped - before.ticks.skipped
        most = watch.value if watch and watch.value > 0.0 else SKIPS
        if skipped <= most * ticks:
            return
        late_us = now.wake.since(before.wake).percentile_ns(99) / 1e3
        raise TimingError(
            f"this PC does not wake up in time for {self.rate.hz:g} Hz: of {ticks} ticks at rest "
            f"{skipped} were skipped ({100 * skipped / ticks:.1f} %), and {100 * most:.1f} % "
            f"would end a test (limits.skipped_ticks_share); 99 % woke at most {late_us:.0f} us "
            f"late, and a tick lasts {1e6 * self.rate.period_s:.0f} us; run rthyb jitter to see "
            "what to change on this PC, or use a lower sample rate"
        )

    def _is_released(self) -> bool:
        """Wait for the drive to follow after a reset; False if it does not."""
        begun_s = self.now_s
        while True:
            stopped = self.loop.counters()["stopped"]
            self._pass(_RESET_TICKS * self.rate.period_s)
            if self.loop.counters()["stopped"] == stopped:
                return True
            if self.now_s - begun_s > _RELEASE_S:
                return False

    def _not_released(self) -> str:
        if all(one.codec.has_reset for one in self.opened.all):
            return "the drive was sent a reset but remains stopped; its panel shows why"
        return "its frames have no reset command (link.reset_state): release it at its own panel"

    def _answered(self, name: core.Command) -> tuple[bool, int]:
        generation = self._wait_for(lambda: self.loop.command(name))
        return self._wait_for(lambda: self.loop.answer(generation))

    def _refusal(self, name: str, state: str, why: str) -> RefusedError:
        """Return the error for a refused command; ``why`` is "" if the state is the reason."""
        return RefusedError(f"{name}: refused in state {state}" + (f": {why}" if why else ""))

    def _why_refused(self, name: str, state: str) -> str:
        if self.run.station.refusal[0] == "apart":
            return self._why_not_one_clock()
        if figures := self.run.refusal_in_figures:
            if name == "reset" and self.run.station.refusal_sensor is not None:
                return f"{figures}; check the sensor, its cable and its amplifier"
            if name in ("resume", "reset"):
                return f"{figures}; unload the specimen first, or check the load cell"
            return (
                f"{figures}; bring the specimen back within the limit, or unload it, and zero again"
            )
        if name == "resume":
            return "the specimen is not at rest yet; try again"
        if name == "reset" and state == "IDLE" and not self.stays_stopped():
            return "the drive has not stopped, so there is nothing to reset"
        if name == "reset":
            return "the specimen is not at rest, or its readings are missing"
        return "the drive does not answer in every tick, or has stopped"

    def _why_not_one_clock(self) -> str:
        axis = self.run.station.refusal_axis
        if axis is None:
            return "the sample counts of the drives have not been compared yet; try again"
        return (
            "since contact with the drives began, the sample count of axis "
            f"{self.run.setup.axis_names[axis]} has moved by more than one sample against "
            f"another drive's. {REMEDIES['apart']} After a trip and a reset the counts are "
            "compared anew"
        )

    def set_parameters(self, parameters: core.Parameters) -> int:
        """Publish a set of parameters, wait until a tick uses it, and store it for the recording.

        Returns:
            its generation, which records then show.

        Raises:
            CoreError: a value is rejected; the previous set remains in force.
            RefusedError: the station refuses it; the previous set remains in force.
            RthybError: the tick thread does not answer.
        """
        state, run = self.state, self.run
        generation = self.loop.set_parameters(parameters)
        tick = self.loop.counts.elapsed - self.loop.load_tick
        values = dataclasses.asdict(parameters)
        # At once: rows with this generation may already be arriving.
        run.parameters.append({"generation": generation, "tick": tick, "values": values})
        taken = self._wait_for(lambda: self.loop.set_taken(generation))
        if not taken:
            run.parameters.pop()
        run.renew()
        if not taken:
            raise self._refusal("parameters", state, SET_REFUSED)
        return generation

    # ---- reasons --------------------------------------------------------------------------------

    def why_not_zeroed(self) -> str:
        """Return in words why the tare did not end."""
        if not self.zeroing_failed:
            return f"the feedback stopped during zeroing; {self.no_feedback()}"
        return zeroing.refused(self.run) or zeroing.restless(self.run, *self._restless())

    def _restless(self) -> tuple[str, float, float]:
        """Return the axis that moved most during the tare, in words, its motion, and the limit.

        The motion is relative to the limit of each axis; the words are "" for a single axis.
        """
        run, names = self.run, self.run.setup.axis_names
        if not names:
            return "", run.spread_m(), run.config.rest_spread_m
        found = [
            (f" of axis {name}", run.spread_m(k), axis.rest_spread_m or run.config.rest_spread_m)
            for k, (name, axis) in enumerate(zip(names, run.config.controller.axes, strict=True))
        ]
        return max(found, key=lambda one: one[1] / one[2])

    @property
    def tare(self) -> dict[str, Any]:
        """Offsets that zeroing subtracts from the readings, as `zeroing.tares`."""
        return zeroing.tares(self.run)

    def tare_in_words(self) -> str:
        """Return the tare in words."""
        return zeroing.in_words(self.run)

    def no_feedback(self) -> str:
        """Return in words why no valid pairs arrive from a drive that follows.

        Every further sensor concerned is named, and with several axes every axis.
        """
        if self.opened.failure is not None:
            return f"the thread that exchanges its frames has ended: {self.opened.failure}"
        names, flags = self.run.setup.axis_names, self.run.recent_flags
        sensors = zeroing.silent_sensors(self.run)
        if not names:
            way = self.ways[0]
            arrives = way.link.down == "up" and way.wire.counters()["pairs"]
            return sensors if sensors and arrives else self._no_feedback_of(way, flags)
        silent = [
            f"axis {name}: {self._no_feedback_of(way, flags)}"
            for name, way in zip(names, self.ways, strict=True)
            if way.link.down != "up" or not way.wire.counters()["pairs"]
        ]
        if sensors:
            silent.append(sensors)
        if silent:
            return "; ".join(silent)
        whose = _stopped_axes(flags, names)
        return (f"{whose}: " if whose else "") + _no_more(flags)

    def other_rate(self, since: Counted | None = None) -> str:
        """Return in words that a drive samples at another rate than the ticks; "" if none does.

        This is judged by the drive's sample count. ``since``: the counters when pairs began to
        arrive without interruption; None: those of the first tick. After too few ticks the result
        is "".
        """
        elapsed = self.loop.counts.elapsed - (since.ticks.elapsed if since else 0)
        if elapsed < self.rate.ticks(_RATE_S):
            return ""
        names = self.run.setup.axis_names or ("",)
        for k, (name, way) in enumerate(zip(names, self.ways, strict=True)):
            counters = way.wire.counters()
            if since is not None:
                earlier = since.axes[k]["wire"] if since.axes else since.wire
                counters = _more(counters, earlier)
            hz = (counters["pairs"] + counters["missed"]) / elapsed * self.rate.hz
            if counters["pairs"] < _RATE_PAIRS or abs(hz / self.rate.hz - 1.0) <= _RATE_OFF:
                continue
            whose = f"axis {name}: " if name else ""
            return (
                f"{whose}the drive sends about {hz:.0f} samples per second, but the test runs at "
                f"{self.rate.hz:g} Hz; set test.sample_rate_hz and the rig file's "
                "link.sample_rate_hz to the drive's rate, or set the drive to theirs"
            )
        return ""

    def _no_feedback_of(self, way: LoopAxis, flags: NDArray[np.uint32]) -> str:
        counters, pieces = way.wire.counters(), way.link.counters()["pieces_in"]
        if way.link.down != "up":
            return f"the link is down ({way.link.down}); check cable, power and interface"
        if counters["pairs"]:
            return _no_more(flags)
        if counters["frames"] or pieces:
            bad = {k: n for k, n in counters.items() if n and k not in ("sent", "frames", "stale")}
            details = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in bad.items())
            return (
                f"{counters['frames']} frames arrived in {FEEDBACK_S:g} s, but no pair of "
                f"displacement and force ({details or 'none was complete'}); check the DBC, or the "
                "drive's frames"
            )
        return (
            f"nothing arrived in {FEEDBACK_S:g} s; is the drive switched on, and does it send "
            f"displacement and force {self.rate.hz:g} times per second?"
        )

    # ---- statistics -----------------------------------------------------------------------------

    def wire_counters(self) -> dict[str, int]:
        """Return the counters of the wire by name; with several axes, their sum."""
        return _sum([way.wire.counters() for way in self.ways])

    def link_counters(self) -> dict[str, int]:
        """Return the counters of the link by name; with several axes, their sum."""
        return _sum([way.link.counters() for way in self.ways])

    def axis_counters(self) -> dict[str, dict[str, dict[str, int]]]:
        """Return both for each of several axes by its name; {} for one axis."""
        names = self.run.setup.axis_names
        return dict(zip(names, self._each(), strict=True)) if names else {}

    def _each(self) -> tuple[dict[str, dict[str, int]], ...]:
        return tuple(
            {"wire": way.wire.counters(), "link": way.link.counters()} for way in self.ways
        )

    def _count(self) -> Counted:
        return Counted(
            ticks=self.loop.counts,
            loop=self.loop.counters(),
            wire=self.wire_counters(),
            link=self.link_counters(),
            wake=self.loop.wake.copy(),
            sent=self.loop.sent.copy(),
            delays=self.loop.link_delays(),
            axes=self._each() if len(self.ways) > 1 else (),
        )

    def _axis_facts(self, run: LiveRun, before: Counted, now: Counted) -> dict[str, Any]:
        """Return the statistics of the link of each of several axes, by name; {} for one axis."""
        if not now.axes:
            return {}
        delays = self.loop.axis_delays
        return {
            "axes": {
                name: {
                    "link_delay_samples": -1 if delay is None else delay,
                    "wire": _more(new["wire"], old["wire"]),
                    "wire_counters": _more(new["link"], old["link"]),
                }
                for name, delay, new, old in zip(
                    run.setup.axis_names, delays, now.axes, before.axes, strict=True
                )
            }
        }

    def ending(self, run: LiveRun) -> dict[str, Any]:
        """Return the entries about the end for ``meta`` of a run's recording."""
        end = run.ending(self.state)
        return {**end, "real_time": {**end["station"], **self._facts(run)}}

    def _facts(self, run: LiveRun) -> dict[str, Any]:
        """Return the real-time statistics of a run; every value is present."""
        before, now = run.counted, self._count()
        assert before is not None
        return {
            "clock": self.clock,
            "link": self.opened.name,
            "link_facts": dict(self.opened.facts),
            "link_failure": self.opened.failure or "",
            "in_real_time": self.opened.real_time and self.clock != "stepped",
            "privileges": self.privileges,
            "began_ns": self.loop.began_ns,
            "ticks": {
                "elapsed": now.ticks.elapsed - before.ticks.elapsed,
                "executed": now.ticks.executed - before.ticks.executed,
                "skipped": now.ticks.skipped - before.ticks.skipped,
                "longest_skip": run.longest_skip,
            },
            "loop": _more(now.loop, before.loop),
            "wire": _more(now.wire, before.wire),
            "wire_counters": _more(now.link, before.link),
            "locked": self.loop.locked,
            "arrival_error_us": self.loop.arrival_error_us,
            "trim_ppm": self.loop.trim_ppm,
            "link_delay_samples": link_delay(now.delays - before.delays, self.loop.link_delay),
            "wake": histogram(now.wake.since(before.wake)),
            "sent": histogram(now.sent.since(before.sent)),
            "missed_rows": run.missed,
            "ring": {"locked": run.ring.locked, "in_memory": run.ring.in_memory},
            **self._axis_facts(run, before, now),
        }


def _listened_to(setup: experiment.Setup, opened: Opened) -> list[tuple[RigFile, Opened]]:
    """Return the other axes whose readings a motion of one axis needs, with their links."""
    if setup.beside is None:
        return []
    return list(zip(setup.beside.others.values(), opened.heard, strict=True))


@contextmanager
def _heard(rig: RigFile, at: Opened) -> Iterator[LoopAxis]:
    """Yield the connection to a drive that is only heard."""
    link = Link(at.kind, at.fd)
    try:
        yield LoopAxis(
            Wire(extra_frames.codec_of(rig, at.codec)), link, axis_wires.calibration(rig)
        )
    finally:
        link.close()


def _sensors_at(setup: experiment.Setup) -> list[tuple[int, int]]:
    """Return axis and number of the extra channel with the reading of each sensor of no axis."""
    if setup.beside is not None:
        return beside.places(setup.beside)
    if setup.group is None:
        return []
    return [place for place in setup.group.rig.sensor_places if place is not None]


def _lead_us(rig: RigFile, rate: Rate) -> float:
    """Return the time by which a pair should arrive before its tick."""
    wanted = None if rig.link is None else rig.link.lead_us
    return default_lead_us(rate.whole_hz) if wanted is None else wanted


def _stopped_axes(recent: NDArray[np.uint32], names: Sequence[str]) -> str:
    """Return the axes whose drives have stopped by themselves, in words; "" if none."""
    seen = int(np.bitwise_or.reduce(recent)) if recent.size else 0
    found = [name for k, name in enumerate(names) if seen >> (core.STOPPED_BIT + k) & 1]
    return f"axis {' and '.join(found)}" if found else ""


def _sum(counters: Sequence[Mapping[str, int]]) -> dict[str, int]:
    return {name: sum(one[name] for one in counters) for name in counters[0]}


def _no_more(recent: NDArray[np.uint32]) -> str:
    """Return in words why the pairs received so far are no longer valid."""
    if (recent & FLAGS["stopped"]).any():
        return (
            "the drive reports that it has stopped, and will not follow commands until an "
            "operator resets it; find out why it stopped, then run `rthyb reset RIG` (for a "
            "service: `rthyb ctl reset`)"
        )
    if (recent & FLAGS["fresh"]).any():
        return (
            "the feedback was interrupted or jumped a moment ago; try again, and if it happens "
            "again, check the sensors and their cables"
        )
    return (
        "the drive has gone silent: no more pairs of displacement and force arrive; is it "
        "switched on, and is its cable connected?"
    )


def _more(now: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    return {name: value - before[name] for name, value in now.items()}


def link_delay(running: NDArray[np.int64], last: int | None) -> int:
    """Return the median of the link's delay in the test proper, samples; -1: unknown.

    Args:
        running: number of its pairs with a delay of n samples, (n,).
        last: delay of the last pair, for a session without a test.
    """
    if not running.any():
        return -1 if last is None else last
    return int(np.searchsorted(np.cumsum(running), 0.5 * running.sum()))


def histogram(latency: ticker.Latency) -> dict[str, Any]:
    """Return a histogram as plain numbers: the lower bound and the count of each bucket."""
    buckets = latency.buckets()
    used = np.flatnonzero(buckets)
    return {
        "count": latency.count,
        "p50_ns": latency.percentile_ns(50),
        "p99_ns": latency.percentile_ns(99),
        "max_ns": latency.max_ns,
        "from_ns": latency.edges_ns()[used].tolist(),
        "counts": buckets[used].tolist(),
    }
