"""One test at one link: what the tick thread works with, and the way to it for everybody else."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core, experiment, jitter, ring, ticker
from rthyb_rt.errors import RthybError
from rthyb_rt.experiment import Setup
from rthyb_rt.links.wire import Wire
from rthyb_rt.loop import Clock, Link, Loop
from rthyb_rt.realtime.endings import RefusedError, end_reason
from rthyb_rt.realtime.keeper import AT_REST, Keeper
from rthyb_rt.recording import STATES, Recording, ReplayData

if TYPE_CHECKING:
    from rthyb_rt.links.opened import Opened

NEEDED: Final = ("fifo", "memory_locked")
"""Privileges without which a tick comes when the rest of the machine has time for it."""

LOOK_S: Final = 0.002
"""How often is looked for an answer."""

SET_REFUSED: Final = (
    "while something moves, the set would switch off a limit of the command's velocity or "
    "acceleration, and what lags behind it would leap; keep both limits (any value above 0), or "
    "stop, and change them in IDLE; the set before stays in force"
)
"""Why a station refuses a set of parameters, and what to do."""

_LEAD_US = 200.0
_ANSWER_S = 2.0
_TRIP_TICKS = 4
"""In which its three frames have left."""
_PAIR_S = 0.25
_UNHEARD = 20


class Session:
    """One test at one link; a context manager that leaves nothing running.

    Commands, waiting and closing belong to one thread.

    Args:
        setup: the test.
        opened: the link, which stays the caller's.
        clock: "host"; "link": the ticks follow the drive's samples; or "stepped", which is not real
            time: `wait` executes the ticks.
        folder: of the ring; None takes `rthyb_rt.ring.default_folder`.
        before_tick: stepped clock: called before every tick, the drive's own tick for one; None: a
            tick comes with the next pair.
        station: settings of the station; None takes those of the test.
        facts: what else the recording is to know, by name.

    Attributes:
        setup, opened, clock: as given.
        ring: where every record goes first.
        loop, station, wire, link: what makes the tick; see their modules for what may be read.
        commands: every operator command so far: ``{"tick", "command", "refused"}``.

    Raises:
        RthybError: the ring has no room, or the descriptor is of no use.
        CoreError: a setting is refused.
    """

    def __init__(
        self,
        setup: Setup,
        opened: Opened,
        *,
        clock: Clock = "host",
        folder: Path | None = None,
        before_tick: Callable[[], None] | None = None,
        station: core.StationConfig | None = None,
        facts: Mapping[str, Any] | None = None,
    ) -> None:
        self.setup, self.opened, self.clock = setup, opened, clock
        self.commands: list[dict[str, Any]] = []
        self._before_tick = before_tick
        self.config = station or experiment.station_config(setup)
        self._bare = experiment.blank(setup, clock)
        self._parameters = [_first_parameters(setup)]
        self._bare.replay.parameters = list(self._parameters)
        self._bare.meta |= facts or {}
        self.station = core.Station(self.config, setup.ag_mps2)
        self.wire = Wire(opened.codec)
        with ExitStack() as undo:
            owned = undo.enter_context(ExitStack())
            self.link = Link(opened.kind, opened.fd)
            owned.callback(self.link.close)
            self.ring = ring.Ring.create(folder or ring.default_folder(), self._bare)
            undo.callback(self.ring.remove)
            owned.callback(self.ring.close)
            self._keeper = Keeper(self.ring.path)
            owned.callback(self._keeper.close)
            self.loop = Loop(
                self.station,
                self.wire,
                self.link,
                self.ring,
                clock,
                experiment.calibration(setup.rig),
                lead_us=_LEAD_US if setup.rig.link is None else setup.rig.link.lead_us,
                paced=before_tick is not None,
            )
            self._owned = owned.pop_all()
            undo.pop_all()
        self._keeper.beat = self.loop.beat
        self._started = self._closed = self._watched = False
        self._unheard = _UNHEARD
        self._commands_before = 0

    def __enter__(self) -> Session:
        """Return the session itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it."""
        self.close()

    def attended(self) -> None:
        """Have the operator's thread watched: a test whose operator is not heard ramps out.

        From this call on `wait` must be called at least once a second.
        """
        self._watched = True
        self._keeper.attended()

    def start(self) -> None:
        """Begin to tick, in state IDLE.

        The command is the first reading; or, where a drive still follows the last session at this
        link and stands as it did then, the last command of that session.

        Raises:
            RthybError: the system refused a thread.
        """
        self._started = True
        left, self.opened.left = self.opened.left, None
        if left is not None:
            self.loop.go_on(left)
        self._commands_before = int(self.wire.struct.seq)
        if self.clock == "stepped":
            self.loop.drop_old()
            return
        awake = self._owned.enter_context(ticker.AwakeProcessors())
        self.loop.start(cpu=jitter.choose_cpu(jitter.machine_facts()), latency_fd=awake.fd)
        self._owned.callback(ticker.unlock_memory)
        self._keeper.start()

    def close(self) -> None:
        """End the thread and let go of everything but the ring's file; twice does no harm.

        What still moves is tripped first, so that the drive stops at once and not by its watchdog.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._started and self.loop.state not in AT_REST:
                self._trip()
        finally:
            self.loop.stop()
            if self._started:
                self.opened.left = self.loop.last_command()
            self._keeper.stop()
            self._owned.close()

    def _trip(self) -> None:
        """Have the drive stopped, without anything that may have failed before."""
        self.loop.command("trip")
        if self.clock == "stepped":
            for _ in range(_TRIP_TICKS):
                self.loop.step()
            return
        end = time.monotonic() + _ANSWER_S
        while self.loop.state != "TRIPPED" and time.monotonic() < end:
            time.sleep(LOOK_S)
        time.sleep(_TRIP_TICKS * core.PERIOD_S)

    def discard(self) -> None:
        """Delete the ring and its session file: the recording has all of it."""
        self.ring.remove()

    @property
    def state(self) -> str:
        """Name of the station's state after the last tick."""
        return self.loop.state

    @property
    def privileges(self) -> list[str]:
        """What the tick thread obtained, once it ticks."""
        return self.loop.privileges

    @property
    def running_ticks(self) -> int:
        """Samples of the test proper so far."""
        return self._keeper.running

    @property
    def has_moved(self) -> bool:
        """Whether a command other than the reading at rest has ever left."""
        return self._keeper.moved

    def wait(self, seconds: float) -> None:
        """Let time pass; stepped clock: execute that time's ticks.

        Raises:
            RthybError: the recorder failed.
            TimingError: the tick thread stands still.
        """
        if self._watched:
            self._keeper.attended()
        if self.clock != "stepped":
            time.sleep(seconds)
        else:
            for _ in range(max(round(seconds * core.FS_HZ), 1)):
                (self._before_tick or self._await_pair)()
                self.loop.step()
            self._keeper.turn()
        self._keeper.check()

    def _await_pair(self) -> None:
        """Wait for the drive, though not in every tick for one that has fallen silent."""
        gone = self._unheard >= _UNHEARD
        came = self.loop.await_pair(core.PERIOD_S if gone else _PAIR_S)
        self._unheard = 0 if came else self._unheard + 1

    def command(self, name: core.Command) -> int:
        """Give an operator's command and wait for its answer; return the tick of that.

        Raises:
            RefusedError: it is not for the present state.
            RthybError: the tick thread does not answer.
        """
        state = self.loop.state
        generation = self._leave(name)
        answer = None
        end = time.monotonic() + _ANSWER_S
        while (answer := self.loop.answer(generation)) is None:
            self._still(end)
            self.wait(_moment(self.clock))
        obeyed, tick = answer
        self.commands.append({"tick": tick, "command": name, "refused": not obeyed})
        if not obeyed:
            raise RefusedError(f"{name}: refused in state {state}")
        return tick

    def _leave(self, name: core.Command) -> int:
        end = time.monotonic() + _ANSWER_S
        while (generation := self.loop.command(name)) is None:
            self._still(end)
            self.wait(_moment(self.clock))
        return generation

    def set_parameters(self, parameters: core.Parameters) -> int:
        """Publish a set of parameters, wait until a tick has it, and keep it for the recording.

        Returns:
            its generation, which records then show.

        Raises:
            CoreError: a value is refused; the set before stays in force.
            RefusedError: the station refuses it; the set before stays in force.
            RthybError: the tick thread does not answer.
        """
        state = self.loop.state
        generation = self.loop.set_parameters(parameters)
        values = dataclasses.asdict(parameters)
        tick = self.loop.counts.elapsed
        # At once: its rows may be on their way already.
        self._parameters.append({"generation": generation, "tick": tick, "values": values})
        end = time.monotonic() + _ANSWER_S
        while (taken := self.loop.set_taken(generation)) is None:
            self._still(end)
            self.wait(_moment(self.clock))
        if not taken:
            self._parameters.pop()
            raise RefusedError(f"parameters refused in state {state}: {SET_REFUSED}")
        return generation

    def _still(self, end: float) -> None:
        if time.monotonic() > end and self.clock != "stepped":
            raise RthybError(
                "the tick thread does not answer; the drive's own watchdog stops it; look what "
                "else takes this PC's processors, and at `rthyb jitter`"
            )

    def follows(self) -> bool:
        """Whether good pairs come, of a drive that obeys."""
        return self._keeper.follows()

    @property
    def recent_flags(self) -> NDArray[np.uint32]:
        """Flags of the newest rows."""
        return self._keeper.recent_flags

    @property
    def displacement_m(self) -> float:
        """Displacement of the last tick, after tare."""
        return self._keeper.displacement_m

    def spread(self, ticks: int) -> float:
        """Return how far the reading of the displacement moved in the last ticks, m."""
        return self._keeper.spread(ticks)

    def renew(self) -> None:
        """Write what tare and commands have become beside the ring, for a recovery."""
        self.ring.renew_session(self._with_facts(self._bare))

    def recording(self) -> Recording:
        """Return the recording of all that was; after `close`."""
        samples = self._keeper.samples()
        rec = dataclasses.replace(self._bare, samples=samples)
        rec = self._with_facts(rec)
        rec.replay.skips = ring.skips(samples)
        rec.meta |= {
            "end_reason": end_reason(self.loop.state, self.loop.cause, moved=self.has_moved),
            "interrupted": bool((samples["state"] == STATES.index("HOLD")).any()),
            "real_time": self._facts(),
        }
        if self._keeper.missed:
            # Row k of the reference belongs to the k-th row of the test, which no longer holds.
            rec.reference = None
        return rec

    def _with_facts(self, rec: Recording) -> Recording:
        x_m, f_n = self.station.tare
        replay = ReplayData(
            parameters=list(self._parameters),
            commands=list(self.commands),
            tares={"displacement_m": x_m, "force_n": f_n},
        )
        return dataclasses.replace(rec, replay=replay, meta=dict(rec.meta))

    def _facts(self) -> dict[str, Any]:
        """Return what else there is to know of the run; every value is there."""
        return {
            "clock": self.clock,
            "state": self.loop.state,
            "cause": self.loop.cause,
            "link": self.opened.name,
            "link_facts": dict(self.opened.facts),
            "link_failure": self.opened.failure or "",
            "in_real_time": self.opened.real_time and self.clock != "stepped",
            "privileges": self.loop.privileges,
            "ticks": self.loop.counts._asdict(),
            "loop": self.loop.counters(),
            "wire": self.wire.counters(),
            "wire_counters": self.link.counters(),
            "usage": self.loop.usage(),
            "locked": self.loop.locked,
            "arrival_error_us": self.loop.arrival_error_us,
            "trim_ppm": self.loop.trim_ppm,
            "commands_before": self._commands_before,
            "link_delay_samples": link_delay(self.loop.link_delays(), self.loop.link_delay),
            "wake": histogram(self.loop.wake),
            "sent": histogram(self.loop.sent),
            "missed_rows": self._keeper.missed,
            "indicated": self.station.indicated,
            "ring": {"locked": self.ring.locked, "in_memory": self.ring.in_memory},
        }


def _first_parameters(setup: Setup) -> dict[str, Any]:
    """Return what the files of a recording do not say of its settings."""
    values = {"rfc_end_tick": setup.controller.rfc.end_tick}
    return {"generation": 0, "tick": 0, "values": values}


def _moment(clock: Clock) -> float:
    return core.PERIOD_S if clock == "stepped" else LOOK_S


def link_delay(running: NDArray[np.int64], last: int | None) -> int:
    """Return the median of the link's delay in the test proper, samples; -1: not known.

    Args:
        running: how many pairs of it came with a delay of n samples, (n,).
        last: delay of the last pair of all, for a session without a test.
    """
    if not running.any():
        return -1 if last is None else last
    return int(np.searchsorted(np.cumsum(running), 0.5 * running.sum()))


def histogram(latency: ticker.Latency) -> dict[str, Any]:
    """Return a histogram as plain numbers: where its buckets begin and how many lie in each."""
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
