"""Many tests, one after another, on one rig, with the connection to the drive kept in between.

The tick thread runs from the daemon's start to its end. Between two tests a station at rest holds
the drive at its position; `zero` replaces it by the station of the loaded test, between two ticks,
with its own ring. The drive's watchdog therefore does not respond, and a test's ring and
recording begin with its own first tick and can be replayed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import secrets
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config, core
from rthyb_rt.analysis import summary
from rthyb_rt.config import AxesRig, RigFile, TestFile
from rthyb_rt.core import STATES
from rthyb_rt.core.loop import Clock
from rthyb_rt.core.mapped_ring import AFTER_TRIP
from rthyb_rt.errors import RthybError
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.lab import experiment
from rthyb_rt.lab.end_reasons import shown
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.lab.realtime import Conductor, LiveRun, RefusedError
from rthyb_rt.lab.sequence import REST_TICKS, TARE_MARGIN_S
from rthyb_rt.service import any_rig, reloading

if TYPE_CHECKING:
    from rthyb_rt.core.wire import Codec
    from rthyb_rt.rig.links.opened import Opened

TURN_S: Final = 0.02
"""Interval at which the results of the tick thread are read."""

RELOAD_IN: Final = ("IDLE", "ZEROED", "HOLD")
"""States in which limits may change: at rest and not armed, or held."""

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
"""The commands of an operator."""


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
        state: state in which it was given.
        allowed: states in which it is allowed; the current state may be among them.
    """

    def __init__(self, command: str, why: str, state: str) -> None:
        self.state, self.allowed = state, allowed_states(command)
        text = f"{command}: {why}; the state is {state}"
        if state not in self.allowed:
            *others, last = self.allowed
            states = f"{', '.join(others)} or {last}" if others else last
            text += f"; {command} is allowed in {states}"
            if state == "TRIPPED":
                text += "; remove the cause, then reset"
        super().__init__(text)


@dataclass(frozen=True)
class Event:
    """An event of which the operator and the journal are informed.

    Attributes:
        level: level of `logging`.
        text: one line of text.
    """

    level: str
    text: str


@dataclass(frozen=True)
class Loaded:
    """A test that is ready to be zeroed.

    Attributes:
        setup: the test.
        digest: digest of its resolved files and its ground motion, 64 hexadecimal digits.
        test, record: the files from which it was made, as given.
    """

    setup: Setup
    digest: str
    test: TestFile
    record: GroundMotion

    @classmethod
    def of(cls, test: TestFile, rig: RigFile | AxesRig, record: GroundMotion) -> Loaded:
        """Prepare a test for a rig; this takes time, and may run in any thread.

        Raises:
            InputError: all errors in the test, or between test and rig.
        """
        setup = any_rig.prepare(test, rig, record)
        text = "\0".join((config.dump(setup.test), config.dump(setup.rig_file)))
        made = hashlib.sha256(text.encode())
        made.update(np.ascontiguousarray(setup.ag_mps2, dtype="<f8").tobytes())
        return cls(setup, made.hexdigest(), test, record)


@dataclass(kw_only=True)
class ServiceRun(LiveRun):
    """A run of the service.

    Attributes:
        digest: digest of the loaded test; "" between two tests.
        given_up_s: time at which its tare is abandoned, by the conductor's clock.
    """

    digest: str = ""
    given_up_s: float = math.inf

    @property
    def run_id(self) -> str:
        """Name of its recording."""
        return str(self.bare.meta["service"]["run_id"])


class Engine(Conductor):
    """A rig, its link, the tick thread, and the test that is loaded.

    All calls except `prepare`, `with_rig` and `make_run` must come from one thread, which calls
    `turn` every `TURN_S`; without these calls a test that is running ramps out after a second.

    Args:
        rig: the rig.
        opened: the link to its drive; it remains the caller's.
        clock: as in `rthyb_rt.lab.realtime.Session`.
        folder: of the rings; None: `rthyb_rt.record.ring.default_folder`.
        before_tick: stepped clock: called before every tick.
        facts: facts to be stored in the recordings, by name.
        tell: called with every event.

    Attributes:
        rig, opened, clock, folder: as given; ``rig`` as last reloaded.
        loaded: the test that `zero` uses, or None.
        last: result of the last test: ``test_name``, ``run_id``, ``end_reason``, and ``ending``,
            the figures of the limit that ended it, "" if none did; or None.

    Raises:
        RthybError: there is no space for the ring, or the descriptor cannot be used.
    """

    run: ServiceRun

    def __init__(
        self,
        rig: RigFile | AxesRig,
        opened: Opened,
        *,
        clock: Clock = "host",
        folder: Path | None = None,
        before_tick: Callable[[], None] | None = None,
        facts: Mapping[str, Any] | None = None,
        tell: Callable[[Event], None] = lambda _: None,
    ) -> None:
        self.rig, self.folder = rig, folder
        self.loaded: Loaded | None = None
        self.last: dict[str, Any] | None = None
        self.not_zeroed = ""
        self._facts_given, self._on_event = dict(facts or {}), tell
        self._token: tuple[str, str] | None = None
        self._newest: np.void | None = None
        self._state = "IDLE"
        self._rest = self._make_rest(clock, [one.codec for one in opened.all])
        super().__init__(opened, clock, before_tick, self._rest)

    def _close_run(self) -> None:
        """Leave the ring of an unfinished test to the recorder, and delete the ring at rest."""
        self._drain()
        if self.run is not self._rest:
            self._end_run(self.run)
        self._rest.remove()

    # ---- state ----------------------------------------------------------------------------------

    @property
    def recorded(self) -> ServiceRun | None:
        """The test whose station is running, or None between two tests."""
        return None if self.run is self._rest else self.run

    @property
    def run_id(self) -> str:
        """Name of the current test's recording, or ""."""
        run = self.recorded
        return run.run_id if run is not None else ""

    @property
    def ring_path(self) -> Path:
        """The ring into which the tick thread writes."""
        return self.run.ring.path

    @property
    def newest(self) -> np.void | None:
        """Record of the last tick that `turn` has seen."""
        return self._newest

    @property
    def progress(self) -> tuple[int, int]:
        """Samples of the test proper so far, and of the whole test."""
        if self.recorded is not None:
            return super().progress
        return 0, self.loaded.setup.ticks if self.loaded is not None else 0

    @property
    def armed_by(self) -> str:
        """The user who armed the test, or ""."""
        return self._token[1] if self._token is not None else ""

    @property
    def indicated(self) -> list[str]:
        """Causes that occurred and were only indicated."""
        return self.run.station.indicated

    # ---- time -----------------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Wait, calling `turn`; with the stepped clock, execute the ticks of that time."""
        end = time.monotonic() + seconds
        ticks = self.rate.ticks(seconds)
        per_turn = self.rate.ticks(TURN_S)
        while ticks > 0 if self.clock == "stepped" else time.monotonic() < end:
            self._pass(min(ticks, per_turn) / self.rate.hz)
            ticks -= per_turn
            self.turn()

    def turn(self) -> None:
        """Report that the program is alive, read the new ticks, and close a test that has ended."""
        self.loop.beat()
        self._drain()
        run = self.run
        if run is not self._rest and self._is_over(run):
            self._finish()

    def _is_over(self, run: ServiceRun) -> bool:
        if run.tripped_rows >= AFTER_TRIP:
            return True
        if run.begun:
            return self.state == "IDLE" and run.idle_rows >= self.rate.ticks(
                REST_TICKS / core.FS_HZ
            )
        tare_over = self.state == "IDLE" and self.now_s > run.given_up_s
        if self.zeroing_failed or tare_over:
            self.not_zeroed = self.why_not_zeroed()
            self._report("error", f"not zeroed: {self.not_zeroed}")
            return True
        return False

    # ---- records --------------------------------------------------------------------------------

    def _drain(self) -> None:
        run = self.run
        for samples in run.news():
            self._report_transitions(samples)
        # A frozen ring provides only its newest record.
        newest = run.reader.newest()
        if newest is not None:
            self._newest = newest.copy()
        if run.tripped_rows and run.caused is None:
            run.note_cause()
        self._forget_token()

    def _report_transitions(self, samples: NDArray[np.void]) -> None:
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
        words = self.cause_in_words
        why = f", cause: {words}" if caused else ""
        if (before, state) == ("IDLE", "ZEROED"):
            why = f", {self.tare_in_words()}"
        name = f" ({self.run.setup.test.test.name})" if self.run is not self._rest else ""
        self._report(levels.get(state, "info"), f"{before} -> {state} at tick {tick}{name}{why}")

    @property
    def cause_in_figures(self) -> str:
        """The value that triggered the cause, and the limit; "" if there are none."""
        return self.run.cause_in_figures

    @property
    def cause_of(self) -> str:
        """The axis or direction to which the cause belongs, in words; "" if none."""
        return self.run.whose

    @property
    def cause_in_words(self) -> str:
        """The cause with its figures, or with its axis."""
        return shown(self.loop.cause, self.cause_of, self.cause_in_figures)

    def _report(self, level: str, text: str) -> None:
        self._on_event(Event(level, text))

    # ---- the operator's commands ----------------------------------------------------------------

    def prepare(self, test: TestFile, record: GroundMotion) -> Loaded:
        """Prepare a test for this rig; this takes time, and may run in any thread.

        Raises:
            InputError: all errors in the test, or between test and rig.
        """
        return Loaded.of(test, self.rig, record)

    def with_rig(self, rig: RigFile | AxesRig) -> Loaded | None:
        """Prepare the loaded test again for a rig; this takes time, and may run in any thread.

        Raises:
            InputError: test and rig are incompatible.
        """
        loaded = self.loaded
        return None if loaded is None else Loaded.of(loaded.test, rig, loaded.record)

    def check_load(self) -> None:
        """Refuse a load that the state does not allow, before the test is prepared.

        Raises:
            StateError: the state is not IDLE.
        """
        if self.state == "IDLE" and self.run is not self._rest:
            raise StateError("load", self._between_tests(), self.state)
        if self.state != "IDLE":
            raise StateError("load", "a test can be loaded only in IDLE", self.state)

    def _between_tests(self) -> str:
        if self.run.begun:
            return "the recording of the last test is still being completed; try again"
        return "a test is being zeroed; wait for the end of the tare, or stop it"

    @property
    def allowed(self) -> list[str]:
        """The `COMMANDS` that the current state allows."""
        idle = () if self.state != "IDLE" or self.stays_stopped() else ("reset",)
        vain = ("load", *idle) if self.recorded is not None else idle
        return [c for c in COMMANDS if self.state in allowed_states(c) and c not in vain]

    def load(self, loaded: Loaded) -> None:
        """Set the test that `zero` will use.

        Raises:
            StateError: the state is not IDLE.
        """
        self.check_load()
        self.loaded = loaded
        name = loaded.setup.test.test.name
        self._report("info", f"loaded {name}, {loaded.digest[:12]}")

    def check_zero(self) -> Loaded:
        """Return the test to be zeroed.

        Raises:
            StateError: there is none, the state does not allow it, or the drive does not follow.
        """
        self.check("zero")
        if self.loaded is None:
            raise StateError("zero", "no test is loaded: load one first", self.state)
        if not self.follows():
            raise StateError("zero", self.no_feedback(), self.state)
        return self.loaded

    def make_run(self, loaded: Loaded) -> ServiceRun:
        """Return station and ring of a test; this takes time, and may run in any thread.

        Raises:
            RthybError: there is no space for the ring.
        """
        facts = self._facts_of("test", loaded.digest)
        return ServiceRun.make(
            loaded.setup,
            self.clock,
            [way.wire.codec for way in self.ways],
            self.folder,
            facts=facts,
            digest=loaded.digest,
        )

    def zero(self, run: ServiceRun | None = None) -> None:
        """Begin the loaded test with the tare of its sensors; its ring begins here.

        Args:
            run: result of `make_run`; None: it is called here.

        Raises:
            StateError: as `check_zero`.
        """
        try:
            loaded = self.check_zero()
            if run is not None and run.digest != loaded.digest:
                raise StateError("zero", "another test has been loaded in the meantime", self.state)
            if self.recorded is not None:
                self._obey("stop")
                self._finish()
        except BaseException:
            if run is not None:
                run.remove()
            raise
        run = run or self.make_run(loaded)
        self.not_zeroed = ""
        self._put(run)
        try:
            self._obey("zero")
        except BaseException:
            # Otherwise the station of a test whose zeroing was abandoned would remain.
            self._finish()
            raise
        run.given_up_s = self.now_s + run.config.tare_ticks / self.rate.hz + TARE_MARGIN_S

    def arm(self, digest: str, owner: str) -> str:
        """Arm the test that was zeroed; return the token that `start` requires.

        Args:
            digest: digest of the test that the operator intends to run.
            owner: the user who arms, for messages.

        Raises:
            StateError: wrong state, or another test than the operator intends.
        """
        self.check("arm")
        self._check_digest("arm", digest)
        self._obey("arm")
        token = secrets.token_hex(16)
        self._token = token, owner
        return token

    def start_test(self, token: str) -> None:
        """Start the armed test.

        Raises:
            StateError: wrong state, or the token does not belong to this arming.
        """
        self.check("start")
        if self._token is None or not secrets.compare_digest(
            self._token[0].encode(), token.encode()
        ):
            owner = self.armed_by or "nobody"
            raise StateError(
                "start",
                "the token does not belong to the current arming; the test was armed by "
                f"{owner}, and only that user may start it",
                self.state,
            )
        self._obey("start")
        self._token = None

    def command(self, name: core.Command) -> int:
        """Give "hold", "resume", "stop", "reset" or "trip"; return the tick in which it acted.

        Raises:
            StateError: the current state does not allow it.
        """
        self.check(name)
        self._drain()
        tick = self._obey(name)
        run = self.run
        if name == "stop" and run is not self._rest and not run.begun:
            self.not_zeroed = "zeroing was stopped by an operator"
            self._report("info", self.not_zeroed)
            self._finish()
        if name == "reset" and self.run is self._rest:
            self._put_rest()
        return tick

    def _obey(self, name: core.Command) -> int:
        """Give any command, and wait for its result."""
        tick = super().command(name)
        self._drain()
        return tick

    def reload(self, rig: RigFile | AxesRig, loaded: Loaded | None = None) -> int:
        """Apply the limits of a rig file; return the generation of the set, or 0.

        Args:
            rig: the file, of which only the limits may have changed.
            loaded: result of `with_rig`; None: it is called here.

        Raises:
            StateError: the state does not allow it, more than the limits has changed, or the tick
                thread refused the set; nothing has then changed.
            InputError: the loaded test is incompatible with the new limits.
        """
        self.check_reload()
        changed = reloading.changed(self.rig, rig)
        if changed:
            raise StateError(
                "reload",
                f"{', '.join(changed)} of the rig file also changed; restart the service to "
                "apply that",
                self.state,
            )
        loaded = loaded or self.with_rig(rig)
        generation = 0
        if self.recorded is not None and loaded is not None:
            station = experiment.station_config(loaded.setup, real=True)
            generation = self.set_parameters(core.Parameters.of(station))
            self.run.digest = loaded.digest
        changes = reloading.limit_changes(self.rig, rig)
        self.rig, self.loaded = rig, loaded
        if self.run is self._rest and self.state == "IDLE":
            self._put_rest()
        self._report("info", f"limits reloaded, generation {generation}: {changes}")
        return generation

    def check_reload(self) -> None:
        """Refuse a reload that the current state does not allow.

        Raises:
            StateError: it is refused.
        """
        if self.state not in RELOAD_IN:
            why = "limits can be changed only at rest or in HOLD"
            raise StateError("reload", why, self.state)

    def know(self, facts: Mapping[str, Any]) -> None:
        """Add facts to the recordings of the next tests, by name."""
        self._facts_given |= facts

    def check(self, name: str) -> None:
        """Refuse one of `COMMANDS`, or "trip", that the current state does not allow.

        Raises:
            StateError: it is refused.
        """
        if self.state not in allowed_states(name):
            raise StateError(name, "not possible in this state", self.state)

    def _check_digest(self, name: str, digest: str) -> None:
        if digest != self.run.digest:
            raise StateError(
                name,
                f"the test that was zeroed is {self.run.digest[:12]}, not "
                f"{digest[:12] or 'named'}; check which test is loaded, and zero again",
                self.state,
            )

    def _refusal(self, name: str, state: str, why: str) -> StateError:
        command = "reload" if name == "parameters" else name
        return StateError(command, why or "not possible in this state", state)

    # ---- stations and rings ---------------------------------------------------------------------

    def _make_rest(self, clock: Clock, codecs: Sequence[Codec]) -> ServiceRun:
        setup = any_rig.at_rest(self.rig)
        return ServiceRun.make(
            setup,
            clock,
            codecs,
            self.folder,
            config=_rest_station(setup),
            facts=self._facts_of("rest", ""),
        )

    def _facts_of(self, purpose: str, digest: str) -> dict[str, Any]:
        """Return the facts for a recording: of a "test", or of the "rest" between two tests."""
        service = {"run_id": uuid.uuid4().hex, "purpose": purpose, "digest": digest}
        return {**self._facts_given, "service": service}

    def _put(self, run: ServiceRun) -> None:
        """Switch the tick thread to another run; outside IDLE the station stays."""
        generation = self.loop.load(run.station, run.ring)
        taken = self._wait_for(lambda: self.loop.loaded(generation))
        if not taken:
            raise RthybError(f"the previous test is in state {self.state}, not in IDLE")
        self._drain()
        run.recent_flags, self.run = self.run.recent_flags, run
        run.counted = self._count()

    def _put_rest(self) -> None:
        """Hold the drive at its position with a new station."""
        rest = self._rest
        if rest.setup.rig_file != self.rig:
            rest.setup = any_rig.at_rest(self.rig)
        rest.config = _rest_station(rest.setup)
        rest.station = core.Station(rest.config, rest.setup.ag_mps2)
        self._put(rest)

    def _finish(self) -> None:
        """Switch to the station at rest, and leave the test's ring to the recorder."""
        run = self.run
        if self.state == "TRIPPED":
            # It remains tripped until it is reset; only the ring changes.
            self._rest.station, self._rest.config = run.station, run.config
            self._put(self._rest)
        else:
            self._put_rest()
        self._end_run(run)

    def _end_run(self, run: ServiceRun) -> None:
        name = run.setup.test.test.name
        if not run.moved and not run.tripped_rows:
            self._report("info", f"{name}: nothing moved, so no recording is kept")
            run.remove()
            return
        run.bare.meta |= self.ending(run)
        run.renew()
        run.close()
        reason = str(run.bare.meta["end_reason"])
        ending = _ending_of(run)
        self.last = {
            "test_name": name,
            "run_id": run.run_id,
            "end_reason": reason,
            "ending": ending,
        }
        how = f", {ending}" if ending else ""
        self._report("info" if reason == "completed" else "warning", f"{name} ended: {reason}{how}")


def _rest_station(setup: Setup) -> core.StationConfig:
    return dataclasses.replace(experiment.station_config(setup, real=True), stay=True)


def _ending_of(run: ServiceRun) -> str:
    """Return the limit that ended a test, with its figures; "" if none did or they are unknown."""
    if run.setup.group is None:
        return summary.ending(run.bare, run.running)
    return run.ended_by
