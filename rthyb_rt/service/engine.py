"""Many tests, one after another, on one rig that is never let go in between.

The tick thread runs from the daemon's start to its end. Between two tests a station at rest keeps
the drive where it stands; `zero` puts the station of the loaded test in its place, at the edge of
a tick, with a ring of its own. So the drive's watchdog has nothing to notice, and a test's ring
and recording begin with its own first tick and can be replayed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import secrets
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config, core, experiment, jitter, ticker
from rthyb_rt.config import RigFile, TestFile
from rthyb_rt.errors import RthybError
from rthyb_rt.experiment import Setup
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.links.wire import Wire
from rthyb_rt.loop import Clock, Link, Loop
from rthyb_rt.realtime import (
    LOOK_BACK_TICKS,
    NEEDED,
    SET_REFUSED,
    RefusedError,
    TimingError,
    end_reason,
    follows,
    histogram,
    link_delay,
    no_feedback,
)
from rthyb_rt.recording import FLAGS, RUNNING, STATES, Recording, ReplayData
from rthyb_rt.ring import AFTER_TRIP, Reader, Ring, default_folder

if TYPE_CHECKING:
    from rthyb_rt.links.opened import Opened

TURN_S: Final = 0.02
"""Between two looks at what the tick thread has done."""

_AT_REST: Final = ("IDLE", "ZEROED", "ARMED")
RELOAD_IN: Final = ("IDLE", "ZEROED", "HOLD")
"""States in which limits may change: at rest and not armed, or held."""
_AFTER_TICKS: Final = 103
"""Rows at rest behind a test that are kept with it: a tenth of a second."""
_TARE_MARGIN_S: Final = 2.0
_ANSWER_S: Final = 2.0
_LOOK_S: Final = 0.001
_ATTEMPTS: Final = 10
_RESET_ATTEMPTS: Final = 60
"""A reset waits for a specimen that has just been stopped to stand still."""
_TRIP_TICKS: Final = 4
_FIRST_TICK_S: Final = 5.0
_CHUNK: Final = 4096
_LEAD_US: Final = 200.0

_REST_TEST: Final = """schema = "rthyb-test/1"
test = { name = "at-rest", description = "no test: the drive is kept where it stands" }
numerical = { period_s = 1, damping_ratio = 0 }
controller = { type = "none" }
"""

_T = TypeVar("_T")

COMMANDS: Final[tuple[str, ...]] = (
    "load",
    "zero",
    "arm",
    "start",
    "hold",
    "resume",
    "stop",
    "reset",
    "reload",
)
"""All that an operator may ask for."""


def allowed_states(command: str) -> tuple[str, ...]:
    """Return the states in which an operator may give one of `COMMANDS`, or "trip"."""
    if command == "load":
        return ("IDLE",)
    if command == "reload":
        return RELOAD_IN
    return tuple(s for s in STATES if core.command_allowed(s, command))  # type: ignore[arg-type]


class StateError(RefusedError):
    """A command that was refused.

    Attributes:
        state: the state it was given in.
        allowed: the states that it is for; the present one may be among them.
    """

    def __init__(self, command: str, why: str, state: str) -> None:
        self.state, self.allowed = state, allowed_states(command)
        text = f"{command}: {why}; the state is {state}"
        if state not in self.allowed:
            text += f", {command} is allowed in {' or '.join(self.allowed)}"
            if state == "TRIPPED":
                text += "; reset leaves TRIPPED, once its cause is gone"
        super().__init__(text)


@dataclass(frozen=True)
class Event:
    """Something that an operator, and the journal, should know of.

    Attributes:
        level: of `logging`.
        text: one line.
    """

    level: str
    text: str


@dataclass(frozen=True)
class Loaded:
    """A test that is ready to be zeroed.

    Attributes:
        setup: the test.
        digest: of its resolved files and its ground motion, hexadecimal, 64 digits.
    """

    setup: Setup
    digest: str

    @classmethod
    def of(cls, setup: Setup) -> Loaded:
        """Return it with its digest."""
        text = "\0".join((config.dump(setup.test), config.dump(setup.rig)))
        made = hashlib.sha256(text.encode())
        made.update(np.ascontiguousarray(setup.ag_mps2, dtype="<f8").tobytes())
        return cls(setup, made.hexdigest())


@dataclass
class _Counted:
    """What the counters of the whole service showed when a test began."""

    ticks: ticker.Counts
    loop: dict[str, int]
    wire: dict[str, int]
    link: dict[str, int]
    wake: ticker.Latency
    sent: ticker.Latency
    delays: NDArray[np.int64]


@dataclass
class _Run:
    """A station, its ring, and what a recording of it is to know.

    Attributes:
        purpose: "test", or "rest" between two tests.
    """

    purpose: str
    setup: Setup
    station_config: core.StationConfig
    station: core.Station
    ring: Ring
    bare: Recording
    reader: Reader
    digest: str = ""
    commands: list[dict[str, Any]] = field(default_factory=list)
    parameters: list[dict[str, Any]] = field(default_factory=list)
    counted: _Counted | None = None
    running: int = 0
    moved: bool = False
    held: bool = False
    zeroed: bool = False
    given_up_s: float = float("inf")
    tripped_rows: int = 0
    cause: str = ""
    idle_rows: int = 0
    missed: list[list[int]] = field(default_factory=list)
    next_row: int = 0
    next_tick: int = 0
    longest_skip: int = 0

    @property
    def run_id(self) -> str:
        return str(self.bare.meta["service"]["run_id"])

    @property
    def begun(self) -> bool:
        """Whether more has come of it than a tare: its end is one at rest."""
        return self.zeroed or self.moved or self.tripped_rows > 0

    def close(self) -> None:
        self.reader.close()
        self.ring.close()

    def remove(self) -> None:
        self.reader.close()
        self.ring.remove()


class Engine:
    """A rig, its link, the tick thread, and the test that is loaded.

    All calls but `prepare` and `make_run` belong to one thread, which calls `turn` every `TURN_S`:
    that is the sign of life without which what moves ramps out after a second.

    Args:
        rig: the rig.
        opened: the link to its drive; stays the caller's.
        clock: as in `rthyb_rt.realtime.Session`.
        folder: of the rings; None takes `rthyb_rt.ring.default_folder`.
        before_tick: stepped clock: called before every tick.
        facts: what the recordings are to know, by name.
        tell: takes every event.

    Attributes:
        rig, opened, clock, folder: as given; ``rig`` as it was reloaded.
        loaded: the test that `zero` takes, or None.
        last: what became of the last test: ``test_name``, ``run_id``, ``end_reason``; or None.

    Raises:
        RthybError: the ring has no room, or the descriptor is of no use.
    """

    def __init__(
        self,
        rig: RigFile,
        opened: Opened,
        *,
        clock: Clock = "host",
        folder: Path | None = None,
        before_tick: Callable[[], None] | None = None,
        facts: Mapping[str, Any] | None = None,
        tell: Callable[[Event], None] = lambda _: None,
    ) -> None:
        self.rig, self.opened, self.clock = rig, opened, clock
        self.folder = folder or default_folder()
        self.loaded: Loaded | None = None
        self.last: dict[str, Any] | None = None
        self.not_zeroed = ""
        self._before_tick, self._facts, self._tell = before_tick, dict(facts or {}), tell
        self._token: tuple[str, str] | None = None
        self._recent: NDArray[np.uint32] = np.zeros(0, np.uint32)
        self._newest: np.void | None = None
        self._state = "IDLE"
        self._in_turn = False
        self.wire = Wire(opened.codec)
        with ExitStack() as owned:
            self.link = Link(opened.kind, opened.fd)
            owned.callback(self.link.close)
            self._rest = self._make_rest()
            owned.callback(self._rest.remove)
            self._run = self._rest
            self.loop = Loop(
                self._rest.station,
                self.wire,
                self.link,
                self._rest.ring,
                clock,
                experiment.calibration(rig),
                lead_us=_LEAD_US if rig.link is None else rig.link.lead_us,
                paced=before_tick is not None,
            )
            self._owned = owned.pop_all()
        self._closed = False

    # ---- its life -------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to tick: with the last reading as command, in state IDLE.

        Raises:
            RthybError: the system refused a thread.
        """
        if self.clock == "stepped":
            self.loop.drop_old()
            return
        awake = self._owned.enter_context(ticker.AwakeProcessors())
        self.loop.start(cpu=jitter.choose_cpu(jitter.machine_facts()), latency_fd=awake.fd)
        self._owned.callback(ticker.unlock_memory)

    def check_privileges(self, required: bool) -> None:
        """Say which privileges the tick thread did not obtain.

        Raises:
            TimingError: it lacks one, and they are required.
        """
        if self.clock == "stepped":
            return
        end = time.monotonic() + _FIRST_TICK_S
        # They are known once the thread, which locks memory first, has come to its first tick.
        while not self.loop.counts.elapsed and time.monotonic() < end:
            time.sleep(_LOOK_S)
        missing = [name.replace("_", " ") for name in NEEDED if name not in self.loop.privileges]
        if not self.opened.real_time:
            name = self.opened.name
            self._say("warning", f"{name}: a Python thread exchanges its frames: not real time")
        if not missing:
            return
        words = f"the tick thread did not obtain: {', '.join(missing)}"
        hint = "LimitRTPRIO=80 and LimitMEMLOCK=infinity in its unit give both"
        if required:
            raise TimingError(
                f"{words}; {hint}, or say link.require_realtime = false in the rig file"
            )
        self._say("warning", f"{words}: ticks may be late or skipped; {hint}")

    def close(self) -> None:
        """End the tick thread and let go of everything; what still moves is tripped first."""
        if self._closed:
            return
        self._closed = True
        try:
            if self.moving:
                self._trip()
            self.turn()
        finally:
            self.loop.stop()
            if self._run is not self._rest:
                self._drain()
                self._end_run(self._run)
            self._owned.close()

    def _trip(self) -> None:
        """Have the drive stopped, without anything that may have failed before."""
        self.loop.command("trip")
        end = time.monotonic() + _ANSWER_S
        while self.loop.state != "TRIPPED" and time.monotonic() < end:
            self._pass(_LOOK_S)
        self._pass(_TRIP_TICKS * core.PERIOD_S)

    # ---- looking --------------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """Name of the station's state after the last tick."""
        return self.loop.state

    @property
    def moving(self) -> bool:
        """Whether the drive is commanded to move, or held within a test."""
        return self.state not in (*_AT_REST, "TRIPPED")

    @property
    def recorded(self) -> _Run | None:
        """The test whose station ticks, or None between two tests."""
        return None if self._run is self._rest else self._run

    @property
    def run_id(self) -> str:
        """Name of the present test's recording, or ""."""
        run = self.recorded
        return run.run_id if run is not None else ""

    @property
    def ring_path(self) -> Path:
        """The ring that the tick thread fills."""
        return self._run.ring.path

    @property
    def newest(self) -> np.void | None:
        """Record of the last tick that `turn` has seen."""
        return self._newest

    @property
    def progress(self) -> tuple[int, int]:
        """Samples of the test proper so far, and of the whole test."""
        run = self.recorded
        if run is not None:
            return run.running, run.setup.ticks
        return 0, self.loaded.setup.ticks if self.loaded is not None else 0

    @property
    def armed_by(self) -> str:
        """Who has armed, or ""."""
        return self._token[1] if self._token is not None else ""

    @property
    def indicated(self) -> list[str]:
        """Causes that were seen and only indicated."""
        return self._run.station.indicated

    @property
    def recent_flags(self) -> NDArray[np.uint32]:
        """Flags of the newest rows."""
        return self._recent

    def follows(self) -> bool:
        """Whether good pairs come, of a drive that obeys."""
        return follows(self._recent)

    # ---- time -----------------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Let time pass, turn by turn; stepped clock: execute that time's ticks."""
        end = time.monotonic() + seconds
        ticks = round(seconds * core.FS_HZ)
        per_turn = round(TURN_S * core.FS_HZ)
        while ticks > 0 if self.clock == "stepped" else time.monotonic() < end:
            self._pass(min(ticks, per_turn) / core.FS_HZ)
            ticks -= per_turn
            self.turn()

    def _pass(self, seconds: float) -> None:
        if self.clock != "stepped":
            time.sleep(seconds)
            return
        for _ in range(max(round(seconds * core.FS_HZ), 1)):
            if self._before_tick is not None:
                self._before_tick()
            else:
                self.loop.await_pair(core.PERIOD_S)
            self.loop.step()

    def turn(self) -> None:
        """Give the sign of life, see what became of the ticks, and end a test that is over."""
        self.loop.beat()
        self._drain()
        run = self._run
        if run is not self._rest and self._is_over(run):
            self._finish()

    def _is_over(self, run: _Run) -> bool:
        if run.tripped_rows >= AFTER_TRIP:
            return True
        if run.begun:
            return self.state == "IDLE" and run.idle_rows >= _AFTER_TICKS
        if run.station.zeroing_failed:
            self._give_up(self._not_at_rest(run))
            return True
        if self.state == "IDLE" and self._now_s() > run.given_up_s:
            self._give_up(no_feedback(self))
            return True
        return False

    def _give_up(self, why: str) -> None:
        self.not_zeroed = why
        self._say("error", f"not zeroed: {why}")

    def _now_s(self) -> float:
        if self.clock == "stepped":
            return self.loop.counts.elapsed / core.FS_HZ
        return time.monotonic()

    def _not_at_rest(self, run: _Run) -> str:
        allowed_mm = run.station_config.rest_spread_m * 1e3
        return (
            "the displacement moved by more than "
            f"{allowed_mm:.3g} mm (limits.rest_spread_m) during the tare; let the rig come to "
            "rest, or look at its sensor"
        )

    # ---- records --------------------------------------------------------------------------------

    def _drain(self) -> None:
        run = self._run
        while (rows := run.reader.read(_CHUNK)).samples.size:
            if rows.first != run.next_row:
                run.missed.append([run.next_row, rows.first - 1])
            run.next_row = run.reader.next
            self._take(run, rows.samples)
        # A frozen ring shows its newest record alone.
        newest = run.reader.newest()
        if newest is not None:
            self._newest = newest.copy()
        if run.tripped_rows and not run.cause:
            run.cause = self.loop.cause
        self._forget_token()

    def _take(self, run: _Run, samples: NDArray[np.void]) -> None:
        states = samples["state"]
        run.running += int(np.count_nonzero(states == RUNNING))
        run.zeroed |= bool((states == STATES.index("ZEROED")).any())
        run.held |= bool((states == STATES.index("HOLD")).any())
        run.tripped_rows += int(np.count_nonzero(states == STATES.index("TRIPPED")))
        at_rest = [*map(STATES.index, _AT_REST)]
        run.moved |= bool((~np.isin(states, [*at_rest, STATES.index("TRIPPED")])).any())
        other = np.flatnonzero(states != STATES.index("IDLE"))
        run.idle_rows = (
            states.size - 1 - int(other[-1]) if other.size else (run.idle_rows + states.size)
        )
        self._count_skips(run, samples)
        self._recent = np.concatenate([self._recent, samples["flags"]])[-LOOK_BACK_TICKS:]
        self._tell_transitions(samples)

    @staticmethod
    def _count_skips(run: _Run, samples: NDArray[np.void]) -> None:
        executed = samples["tick"][(samples["flags"] & FLAGS["blind"]) == 0].astype(np.int64)
        if executed.size:
            gaps = np.diff(np.concatenate([[run.next_tick - 1], executed])) - 1
            run.longest_skip = max(run.longest_skip, int(gaps.max()))
            run.next_tick = int(executed[-1]) + 1

    def _tell_transitions(self, samples: NDArray[np.void]) -> None:
        changes = np.flatnonzero(np.diff(samples["state"])) + 1
        for row in (0, *changes.tolist()):
            self._entered(STATES[samples["state"][row]], int(samples["tick"][row]))

    def _forget_token(self) -> None:
        if self._token is not None and self.state != "ARMED":
            self._token = None

    def _entered(self, state: str, tick: int) -> None:
        if state == self._state:
            return
        before, self._state = self._state, state
        levels = {"TRIPPED": "critical", "HOLD": "warning"}
        caused = state in ("TRIPPED", "HOLD", "RAMP_OUT") and self.loop.cause != "none"
        why = f", cause: {self.loop.cause.replace('_', ' ')}" if caused else ""
        name = f" ({self._run.setup.test.test.name})" if self._run is not self._rest else ""
        self._say(levels.get(state, "info"), f"{before} -> {state} at tick {tick}{name}{why}")

    def _say(self, level: str, text: str) -> None:
        self._tell(Event(level, text))

    # ---- the operator's commands ----------------------------------------------------------------

    def prepare(self, test: TestFile, record: GroundMotion) -> Loaded:
        """Work out a test for this rig; takes its time, and may run in any thread.

        Raises:
            InputError: with what is wrong in the test, or between test and rig.
        """
        return Loaded.of(experiment.prepare(test, self.rig, real_time=True, record=record))

    def check_load(self) -> None:
        """Refuse a load that the state does not allow, before anything is made of it.

        Raises:
            StateError: the state is not IDLE.
        """
        if self.state == "IDLE" and self._run is not self._rest:
            raise StateError("load", self._between_tests(), self.state)
        if self.state != "IDLE":
            raise StateError("load", "a test is loaded between two tests only", self.state)

    def _between_tests(self) -> str:
        if self._run.begun:
            return "the last test is just being put away; try again"
        return "a test is being zeroed; wait for the end of the tare, or stop it"

    @property
    def allowed(self) -> list[str]:
        """Which of `COMMANDS` the present state allows."""
        busy = ("load",) if self.recorded is not None else ()
        return [c for c in COMMANDS if self.state in allowed_states(c) and c not in busy]

    def load(self, loaded: Loaded) -> None:
        """Make a test the one that `zero` takes.

        Raises:
            StateError: the state is not IDLE.
        """
        self.check_load()
        self.loaded = loaded
        name = loaded.setup.test.test.name
        self._say("info", f"loaded {name}, {loaded.digest[:12]}")

    def check_zero(self) -> Loaded:
        """Return the test to be zeroed.

        Raises:
            StateError: there is none, the state is none for it, or the drive does not follow.
        """
        self.check("zero")
        if self.loaded is None:
            raise StateError("zero", "no test is loaded: load one first", self.state)
        if not self.follows():
            raise StateError("zero", no_feedback(self), self.state)
        return self.loaded

    def make_run(self, loaded: Loaded) -> _Run:
        """Return station and ring of a test; takes its time, and may run in any thread.

        Raises:
            RthybError: the ring has no room.
        """
        station = experiment.station_config(loaded.setup)
        return self._make_run("test", loaded.setup, station, loaded.digest)

    def zero(self, run: _Run | None = None) -> None:
        """Begin the loaded test with the tare of its sensors; its ring begins here.

        Args:
            run: what `make_run` made; None makes it here.

        Raises:
            StateError: as `check_zero`.
        """
        try:
            loaded = self.check_zero()
            if run is not None and run.digest != loaded.digest:
                raise StateError("zero", "another test was loaded meanwhile", self.state)
            if self.recorded is not None:
                self._command("stop")
                self._finish()
        except BaseException:
            if run is not None:
                run.remove()
            raise
        run = run or self.make_run(loaded)
        self.not_zeroed = ""
        self._put(run)
        try:
            self._command("zero")
        except BaseException:
            # Else the station of a test would stay that nobody zeroes any more.
            self._finish()
            raise
        tare_s = run.station_config.tare_ticks / core.FS_HZ
        run.given_up_s = self._now_s() + tare_s + _TARE_MARGIN_S

    def arm(self, digest: str, owner: str) -> str:
        """Arm the test that was zeroed; return the token that `start` asks for.

        Args:
            digest: of the test that the operator means.
            owner: who arms, for messages.

        Raises:
            StateError: wrong state, or another test than the operator means.
        """
        self.check("arm")
        self._check_digest("arm", digest)
        self._command("arm")
        token = secrets.token_hex(16)
        self._token = token, owner
        self.renew()
        return token

    def start_test(self, token: str) -> None:
        """Start the armed test.

        Raises:
            StateError: wrong state, or not the token of this arming.
        """
        self.check("start")
        if self._token is None or not secrets.compare_digest(
            self._token[0].encode(), token.encode()
        ):
            owner = self.armed_by or "nobody"
            raise StateError(
                "start",
                f"the token is not that of this arming; armed by {owner}, and only who arms starts",
                self.state,
            )
        self._command("start")
        self._token = None
        self.renew()

    def command(self, name: core.Command) -> None:
        """Give "hold", "resume", "stop", "reset" or "trip".

        Raises:
            StateError: it is not for the present state.
        """
        self.check(name)
        self._drain()
        self._command(name)
        run = self._run
        if name == "stop" and run is not self._rest and not run.begun:
            self.not_zeroed = "zeroing was stopped by an operator"
            self._say("info", self.not_zeroed)
            self._finish()
        if name == "reset" and self._run is self._rest:
            self._put_rest()

    def reload(self, rig: RigFile) -> int:
        """Take the limits of a rig file into force; return the generation of the set, or 0.

        Raises:
            StateError: the state is none for it, more than the limits has changed, or the tick
                thread refused the set; then all is as before.
            InputError: the loaded test does not go with the new limits.
        """
        self.check_reload()
        changed = [
            name
            for name, value in rig.model_dump().items()
            if value != self.rig.model_dump()[name] and name != "limits"
        ]
        if changed:
            raise StateError(
                "reload",
                f"{', '.join(changed)} of the rig file changed too; restart the service for that",
                self.state,
            )
        loaded = self.loaded and self._with_rig(self.loaded, rig)
        generation = 0
        if self.recorded is not None and loaded is not None:
            generation = self._set_limits(self._run, loaded.setup)
            self._run.digest = loaded.digest
        told = _changes(self.rig.limits.model_dump(), rig.limits.model_dump())
        self.rig, self.loaded = rig, loaded
        if self._run is self._rest and self.state == "IDLE":
            self._put_rest()
        self._say("info", f"limits reloaded, generation {generation}: {told}")
        return generation

    def check_reload(self) -> None:
        """Refuse a reload that is not for the present state.

        Raises:
            StateError: it is not.
        """
        if self.state not in RELOAD_IN:
            why = "limits change at rest or in HOLD, where nobody is surprised"
            raise StateError("reload", why, self.state)

    def know(self, facts: Mapping[str, Any]) -> None:
        """Have the recordings of the next tests know more, by name."""
        self._facts |= facts

    def _with_rig(self, loaded: Loaded, rig: RigFile) -> Loaded:
        test = loaded.setup.test
        # The resolved test has the old rig's limits written out: they are not its own.
        old = loaded.setup.derived.limits
        own = {
            key: value if old.sources.get(key) == "test" else None
            for key, value in dict(test.limits).items()
        }
        test = test.model_copy(update={"limits": test.limits.model_copy(update=own)})
        derived = config.derive(test, rig)
        setup = dataclasses.replace(
            loaded.setup, test=config.resolve(test, derived), rig=rig, derived=derived
        )
        end_tick = setup.controller.rfc.end_tick
        controller = experiment.controller_config(setup.test, rig, derived, end_tick)
        return Loaded.of(dataclasses.replace(setup, controller=controller))

    def _set_limits(self, run: _Run, setup: Setup) -> int:
        parameters = core.Parameters.of(experiment.station_config(setup))
        state = self.state
        generation = self.loop.set_parameters(parameters)
        tick = run.next_tick
        values = dataclasses.asdict(parameters)
        # At once: its rows may be on their way already.
        run.parameters.append({"generation": generation, "tick": tick, "values": values})
        taken = self._wait_for(lambda: self.loop.set_taken(generation))
        if not taken:
            run.parameters.pop()
        self.renew()
        if not taken:
            raise StateError("reload", SET_REFUSED, state)
        return generation

    def check(self, name: str) -> None:
        """Refuse one of `COMMANDS`, or "trip", that is not for the present state.

        Raises:
            StateError: it is not.
        """
        if self.state not in allowed_states(name):
            raise StateError(name, "not in this state", self.state)

    def _check_digest(self, name: str, digest: str) -> None:
        if digest != self._run.digest:
            raise StateError(
                name,
                f"the test that was zeroed is {self._run.digest[:12]}, not "
                f"{digest[:12] or 'named'}; look which test is loaded, and zero again",
                self.state,
            )

    def _command(self, name: core.Command) -> int:
        """Give a command and wait for its answer; return the tick of that."""
        state = self.state
        for _ in range(_RESET_ATTEMPTS if name == "reset" else _ATTEMPTS):
            obeyed, tick = self._answered(name)
            tick -= self.loop.load_tick
            self._run.commands.append({"tick": tick, "command": name, "refused": not obeyed})
            if obeyed:
                self._drain()
                return tick
            # A tick without a fresh pair is none to start in; the next one may be.
            self._pass(2 * core.PERIOD_S)
        raise StateError(name, self._why_refused(name), state)

    def _answered(self, name: core.Command) -> tuple[bool, int]:
        generation = self._wait_for(lambda: self.loop.command(name))
        return self._wait_for(lambda: self.loop.answer(generation))

    def _wait_for(self, asked: Callable[[], _T | None]) -> _T:
        end = time.monotonic() + _ANSWER_S
        while (answer := asked()) is None:
            if time.monotonic() > end and self.clock != "stepped":
                raise RthybError(
                    "the tick thread does not answer; the drive's own watchdog stops it"
                )
            self._pass(_LOOK_S)
        return answer

    def _why_refused(self, name: str) -> str:
        if name == "resume":
            return "the specimen has not come to a stand yet; try again"
        if name == "reset":
            return "the specimen does not stand still, or its readings are missing"
        limit = self._run.station_config.watches.get("position")
        x_m = float(self._newest["x_meas_m"]) if self._newest is not None else 0.0
        if name == "start" and limit is not None and abs(x_m) > limit.value:
            return (
                f"the specimen stands at {x_m * 1e3:.3g} mm, beyond the position limit of "
                f"{limit.value * 1e3:g} mm; bring it back to its middle"
            )
        return "the drive does not answer in every tick, or has stopped by itself"

    # ---- stations and rings ---------------------------------------------------------------------

    def _make_rest(self) -> _Run:
        test = config.parse_test(_REST_TEST, "at rest")
        derived = config.derive(test, self.rig)
        ag = np.zeros(1)
        setup = Setup(
            test=config.resolve(test, derived),
            rig=self.rig,
            derived=derived,
            motion=GroundMotion("none", "at rest", core.PERIOD_S, ag),
            ag_mps2=ag,
            controller=experiment.controller_config(test, self.rig, derived, 1),
            virtual_rig=experiment.rig_config(self.rig),
        )
        return self._make_run("rest", setup, _rest_station(setup))

    def _make_run(
        self, purpose: str, setup: Setup, station: core.StationConfig, digest: str = ""
    ) -> _Run:
        bare = experiment.blank(setup, self.clock)
        bare.meta |= self._facts
        bare.meta["service"] = {"run_id": uuid.uuid4().hex, "purpose": purpose, "digest": digest}
        first = {"rfc_end_tick": setup.controller.rfc.end_tick}
        parameters = [{"generation": 0, "tick": 0, "values": first}]
        bare.replay.parameters = list(parameters)
        made = Ring.create(self.folder, bare)
        try:
            reader = Reader(made.path)
            return _Run(
                purpose=purpose,
                setup=setup,
                station_config=station,
                station=core.Station(station, setup.ag_mps2),
                ring=made,
                bare=bare,
                reader=reader,
                digest=digest,
                parameters=parameters,
            )
        except BaseException:
            made.remove()
            raise

    def _put(self, run: _Run, station: core.Station | None = None) -> None:
        """Have the tick thread go on with a run; the state is IDLE, or the station stays."""
        generation = self.loop.load(station or run.station, run.ring)
        taken = self._wait_for(lambda: self.loop.loaded(generation))
        if not taken:
            raise RthybError(f"the station of before is in {self.state}, not in IDLE")
        self._drain()
        self._run = run
        run.counted = self._count()

    def _put_rest(self) -> None:
        """Keep the drive where it stands, with a fresh station."""
        rest = self._rest
        setup = dataclasses.replace(rest.setup, rig=self.rig)
        rest.station_config = _rest_station(setup)
        rest.station = core.Station(rest.station_config, rest.setup.ag_mps2)
        self._put(rest)

    def _count(self) -> _Counted:
        return _Counted(
            ticks=self.loop.counts,
            loop=self.loop.counters(),
            wire=self.wire.counters(),
            link=self.link.counters(),
            wake=self.loop.wake.copy(),
            sent=self.loop.sent.copy(),
            delays=self.loop.link_delays(),
        )

    def _finish(self) -> None:
        """Let the station at rest take over, and give the test's ring to the recorder."""
        run = self._run
        if self.state == "TRIPPED":
            # It stays tripped until it is reset; only the ring changes.
            self._rest.station, self._rest.station_config = run.station, run.station_config
            self._put(self._rest)
        else:
            self._put_rest()
        self._end_run(run)

    def _end_run(self, run: _Run) -> None:
        if not run.moved and not run.tripped_rows:
            self._say("info", f"{run.setup.test.test.name}: nothing moved, nothing is kept")
            run.remove()
            return
        facts = self.facts(run)
        state = "TRIPPED" if run.tripped_rows else "IDLE"
        reason = end_reason(state, facts["cause"], moved=run.moved)
        run.bare.meta |= {"end_reason": reason, "interrupted": run.held, "real_time": facts}
        self._renew(run)
        run.close()
        self.last = {
            "test_name": run.setup.test.test.name,
            "run_id": run.run_id,
            "end_reason": reason,
        }
        level = "info" if reason == "completed" else "warning"
        self._say(level, f"{run.setup.test.test.name} ended: {reason}")

    # ---- what the recording is to know ----------------------------------------------------------

    def renew(self) -> None:
        """Write what tare and commands have become beside the ring, for the recorder."""
        if self.recorded is not None:
            self._renew(self._run)

    def _renew(self, run: _Run) -> None:
        x_m, f_n = run.station.tare
        replay = ReplayData(
            parameters=list(run.parameters),
            commands=list(run.commands),
            tares={
                "displacement_m": x_m,
                "force_n": f_n,
                "command_m": run.station.command_tare_m,
            },
        )
        rec = dataclasses.replace(run.bare, replay=replay, meta=dict(run.bare.meta))
        run.ring.renew_session(rec)

    def facts(self, run: _Run) -> dict[str, Any]:
        """Return how a test went, as ``meta["real_time"]`` of its recording."""
        before, now = run.counted, self._count()
        assert before is not None
        counts = {
            "elapsed": now.ticks.elapsed - before.ticks.elapsed,
            "executed": now.ticks.executed - before.ticks.executed,
            "skipped": now.ticks.skipped - before.ticks.skipped,
            "longest_skip": run.longest_skip,
        }
        return {
            "clock": self.clock,
            "state": "TRIPPED" if run.tripped_rows else self.state,
            "cause": run.cause or run.station.cause,
            "link": self.opened.name,
            "link_facts": dict(self.opened.facts),
            "link_failure": self.opened.failure or "",
            "in_real_time": self.opened.real_time and self.clock != "stepped",
            "privileges": self.loop.privileges,
            "ticks": counts,
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
            "indicated": run.station.indicated,
            "ring": {"locked": run.ring.locked, "in_memory": run.ring.in_memory},
        }


def _rest_station(setup: Setup) -> core.StationConfig:
    base = experiment.station_config(setup)
    return dataclasses.replace(
        base,
        controller=dataclasses.replace(base.controller, motion=core.MotionConfig("prescribed")),
        stay=True,
    )


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return what became of each limit of a rig file, in words."""
    words = [
        f"{name} {_limit(old[name])} -> {_limit(value)}"
        for name, value in new.items()
        if value != old[name]
    ]
    return ", ".join(words) or "nothing has changed"


def _limit(value: Any) -> str:
    """Return a limit as a rig file may give it: a table, a number, or nothing."""
    if value is None:
        return "unset"
    if not isinstance(value, Mapping):
        return f"{value:g}"
    return f"{value['value']:g} ({value['action'] if value['enable'] else 'off'})"


def _more(now: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    return {name: value - before[name] for name, value in now.items()}
