"""The daemon: a rig, its tests, the control socket and the signals, in one process.

It starts in IDLE, whatever happened before, and never resumes a motion. One thread serves the
operator; without its call of `turn`, fifty times per second, the tick thread ramps out. systemd's
watchdog is served only while ticks advance.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import signal
import subprocess
import sys
import time
import unicodedata
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rthyb_rt import __version__, config, core
from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.core import STATES
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.ground_motion.motion_files import MAX_DURATION_S
from rthyb_rt.ground_motion.text import MAX_POINTS
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.record import recording, ring
from rthyb_rt.record.recording import replacing
from rthyb_rt.service import axes_status, disk, metrics, reloading, ring_recorder, systemd
from rthyb_rt.service.control import (
    ClientLimits,
    ControlServer,
    Dispatcher,
    Method,
    ReplyError,
)
from rthyb_rt.service.peers import Peer, Rights, Role
from rthyb_rt.service.rig_engine import (
    TURN_S,
    Engine,
    Event,
    Loaded,
    StateError,
)

if TYPE_CHECKING:
    from rthyb_rt.core.loop import Clock
    from rthyb_rt.rig.links.opened import Opened

SCHEMA: Final = "rthyb-status/1"
TRIPPED: Final = 6
"""Exit status after a second signal, or a trip on the way out."""

_PRIVILEGES: Final = (
    "set LimitRTPRIO=80 and LimitMEMLOCK=infinity in its unit to obtain both, or "
    "link.require_realtime = false in the rig file to run without them"
)
_STATUS_S: Final = 1.0
_METRICS_S: Final = 5.0
_STEPPED_S: Final = 0.001
_RECORDER_S: Final = 0.5
_RESTART_S: Final = 1.0
_RECORDER_READY_S: Final = 10.0
_BEGIN_S: Final = 3.0
_DT_S: Final = (1e-5, 10.0)
_AG_MOST_MPS2: Final = 1e3
_DETAILS_MOST: Final = 100
_DETAILS_SIGNS: Final = 100_000
_NEWEST: Final = (
    "tick",
    "ag_mps2",
    "x_num_m",
    "x_cmd_m",
    "x_meas_m",
    "f_meas_n",
    "alpha",
    "beta",
    "k_t_n_per_m",
    "energy_error_j",
    "tracking_indicator_m2",
    "flags",
)

log = logging.getLogger("rthyb.daemon")


@dataclass(frozen=True)
class Options:
    """Options of a daemon.

    Attributes:
        socket: path of the control socket.
        rings: folder of the rings and of the recorder's status.
        runs: where recordings go, if the daemon has a recorder of its own.
        recorder: "own": a process that the daemon starts, and restarts if necessary; "service": one
            that another unit starts; "none": only the ring.
        require_realtime: refuse to run without real-time privileges.
        metrics: file in Prometheus' format that is rewritten every 5 s, or None.
        rights: rights of the users.
        limits: limits for clients.
    """

    socket: Path
    rings: Path
    runs: Path
    recorder: str
    require_realtime: bool
    metrics: Path | None = None
    rights: Rights | None = None
    limits: ClientLimits = field(default_factory=ClientLimits)


class Daemon:
    """The daemon of a rig; see the description of this module.

    Args:
        rig: the rig.
        opened: the link to its drive; it remains the caller's.
        clock, before_tick: as in `rthyb_rt.lab.realtime.Session`.
        options: options of the daemon.
        demand: returns the facts of a rig's commissioning, or refuses the rig.
        read_rig: reads the rig file again, for a reload.
    """

    def __init__(
        self,
        rig: RigFile | AxesRig,
        opened: Opened,
        clock: Clock,
        options: Options,
        *,
        demand: Callable[[RigFile | AxesRig], dict[str, Any]] = lambda _: {},
        read_rig: Callable[[], RigFile | AxesRig] | None = None,
        before_tick: Callable[[], None] | None = None,
    ) -> None:
        self.options = options
        _clear_rests(options.rings)
        self._demand, self._read_rig = demand, read_rig
        # As commissioned: repeated reloads may each lower the limits of the previous file.
        self._commissioned = rig
        self.engine = Engine(
            rig,
            opened,
            clock=clock,
            folder=options.rings,
            before_tick=before_tick,
            facts=demand(rig),
            tell=_to_log,
        )
        self.dispatcher = Dispatcher(self._methods(), options.rights or Rights.of_system())
        self._server: ControlServer | None = None
        self._stops = 0
        self._busy = asyncio.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._child_s = 0.0
        self._recorder: ring_recorder.Status | None = None
        self._reported_fault = ""
        self._said: dict[str, float] = {}
        self._ticks_seen = 0
        self._begun_s = time.monotonic()

    def run(self) -> int:
        """Serve until a signal arrives; return the exit status.

        Raises:
            TimingError: real-time privileges are missing that are required.
            RthybError: socket or recorder is unavailable, or the tick thread has failed.
        """
        try:
            return asyncio.run(self._main())
        finally:
            self.engine.close()
            self._end_recorder()

    async def _main(self) -> int:
        loop = asyncio.get_running_loop()
        for signum in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(signum, self.stop)
        loop.add_signal_handler(signal.SIGHUP, self._reload_by_signal)
        return await self.work()

    async def work(self) -> int:
        """Serve until `stop`; return the exit status. `run` does this with signals.

        Raises:
            TimingError: real-time privileges are missing that are required.
            RthybError: socket or recorder is unavailable, or the tick thread has failed.
        """
        self._start_recorder()
        # Load, zero and reload run one at a time; each further thread would lock another stack.
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1, "prepare"))
        self.engine.start()
        self.engine.check_privileges(
            log.warning, required=self.options.require_realtime, hint=_PRIVILEGES
        )
        server = ControlServer(self.options.socket, self.dispatcher, self.options.limits)
        await server.start()
        self._server = server
        log.info("ready, %s at %s", self.engine.rig.rig.name, self.engine.opened.name)
        systemd.notify("READY=1", self._status_line())
        try:
            while not self._over():
                self._turn()
                await asyncio.sleep(_STEPPED_S if self.engine.clock == "stepped" else TURN_S)
        finally:
            systemd.notify("STOPPING=1")
            await server.stop()
            if self.options.metrics is not None:
                # Without the file the service counts as down; an old file would report it as up.
                self.options.metrics.unlink(missing_ok=True)
        tripped = self._stops > 1 or (self.engine.state == "TRIPPED" and self._was_moving)
        return TRIPPED if tripped else 0

    # ---- turns ----------------------------------------------------------------------------------

    def _turn(self) -> None:
        if self.engine.clock == "stepped":
            self.engine.wait(TURN_S)
        else:
            self.engine.turn()
        if self._due("watchdog", (systemd.watchdog_s() or 4.0) / 4.0):
            self._feed_watchdog()
        if self._due("status", _STATUS_S):
            systemd.notify(self._status_line())
        if self._due("recorder", _RECORDER_S):
            self._look_after_recorder()
        if self.options.metrics is not None and self._due("metrics", _METRICS_S):
            self._write_metrics(self.options.metrics)

    def _due(self, what: str, every_s: float) -> bool:
        now = time.monotonic()
        if now - self._said.get(what, -math.inf) < every_s:
            return False
        self._said[what] = now
        return True

    def _feed_watchdog(self) -> None:
        """Notify systemd only while ticks advance; it restarts a service whose thread hangs."""
        ticks = self.engine.loop.counts.elapsed
        if ticks > self._ticks_seen:
            systemd.notify("WATCHDOG=1")
        self._ticks_seen = ticks

    def _status_line(self) -> str:
        done, ticks = self.engine.progress
        words = self.engine.state
        if self.engine.recorded is not None and self.engine.loaded is not None:
            name = self.engine.loaded.setup.test.test.name
            hz = self.engine.rate.hz
            words += f", {name} {done / hz:.0f} of {ticks / hz:.0f} s"
        elif self.engine.loaded is not None:
            words += f", {self.engine.loaded.setup.test.test.name} loaded"
        if self.engine.state == "IDLE" and self.engine.stays_stopped():
            words += "; the drive has stopped by itself: find out why, then run rthyb ctl reset"
        if self._reported_fault:
            words += f"; {self._reported_fault}"
        return f"STATUS={words}"

    def _write_metrics(self, path: Path) -> None:
        try:
            with replacing(path) as temporary:
                temporary.write_text(metrics.text(self.status()), encoding="utf-8")
        except RthybError as error:
            log.warning("%s", error)

    # ---- the end --------------------------------------------------------------------------------

    _was_moving = False

    def stop(self) -> None:
        """Ramp out and end; on the second call trip. Call from the serving thread."""
        self._stops += 1
        if not self.engine.moving:
            log.info("asked to stop the service, in state %s", self.engine.state)
            return
        self._was_moving = True
        log.warning(
            "asked to stop the service: %s", "ramping out" if self._stops == 1 else "tripping"
        )
        systemd.notify("STOPPING=1", "STATUS=ramping out")
        name: core.Command = "stop" if self._stops == 1 else "trip"
        with contextlib.suppress(StateError):
            self.engine.command(name)

    def _over(self) -> bool:
        if not self._stops:
            return False
        # Asked to end at rest, or the ramp-out was refused: there is no motion to complete.
        if self.engine.moving and self.engine.state != "RAMP_OUT":
            self._was_moving = True
            with contextlib.suppress(StateError):
                self.engine.command("stop")
        # A test that has ended is still passed to its recorder.
        return not self.engine.moving and (
            self.engine.recorded is None or self.engine.state in ("ZEROED", "ARMED")
        )

    # ---- the recorder ---------------------------------------------------------------------------

    def _start_recorder(self) -> None:
        if self.options.recorder != "own":
            return
        self._launch_recorder()
        end = time.monotonic() + _RECORDER_READY_S
        while not self._recorder_alive():
            if self._child is not None and self._child.poll() is not None:
                raise RthybError("the recorder did not start; its messages are above")
            if time.monotonic() > end:
                raise RthybError(f"the recorder did not respond within {_RECORDER_READY_S:g} s")
            time.sleep(TURN_S)

    def _launch_recorder(self) -> None:
        order = ["--rings", self.options.rings, "--runs", self.options.runs, "--parent"]
        program = "import sys; from rthyb_rt.cli import main; sys.exit(main())"
        self._child = subprocess.Popen(
            [sys.executable, "-c", program, "recorder", *map(str, order)],
            stdin=subprocess.PIPE,
            start_new_session=True,
        )
        self._child_s = time.monotonic()

    def _end_recorder(self) -> None:
        """Let the recorder finish its work; it ends when this end of its pipe is closed."""
        child, self._child = self._child, None
        if child is None:
            return
        assert child.stdin is not None
        child.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_RECORDER_READY_S)

    def _recorder_alive(self) -> bool:
        self._recorder = ring_recorder.read_status(self.options.rings)
        return self._recorder is not None and self._recorder.alive

    def _look_after_recorder(self) -> None:
        if self.options.recorder == "none":
            return
        child = self._child
        old_enough = time.monotonic() - self._child_s > _RESTART_S
        if child is not None and old_enough and child.poll() is not None:
            log.error("the recorder ended with status %s; it has been restarted", child.returncode)
            assert child.stdin is not None
            child.stdin.close()
            self._launch_recorder()
        fault = "" if self._recorder_alive() else "the recorder does not respond"
        fault = fault or (self._recorder.fault if self._recorder is not None else "")
        if fault != self._reported_fault:
            log.error("recorder: %s", fault) if fault else log.info("recorder: working again")
        self._reported_fault = fault

    async def _await_recorder(self) -> None:
        """Wait for the moment that the recorder needs to start with a test."""
        end = time.monotonic() + _BEGIN_S
        while self._recorder_alive() and time.monotonic() < end:
            if self._recorder is not None and self._recorder.run_id == self.engine.run_id:
                return
            await asyncio.sleep(TURN_S)

    def _check_recorder(self, setup: Setup) -> None:
        """Refuse to arm a test that would not be recorded.

        Raises:
            StateError: there is no recorder, it does not record this test, or has no room for it.
        """
        if self.options.recorder == "none":
            return
        state = self.engine.state
        if not self._recorder_alive() or self._recorder is None:
            why = "the recorder does not respond: check systemctl status rthyb-recorder"
            raise StateError("arm", why, state)
        found = self._recorder
        if found.fault and found.hinders:
            raise StateError("arm", f"recorder: {found.fault}", state)
        if found.run_id != self.engine.run_id:
            why = found.fault or "check its journal"
            raise StateError(
                "arm", f"the recorder has not started to record this test: {why}", state
            )
        axes = setup.controller.axis_count
        needed = disk.needed_bytes(setup.ticks, setup.channels, axes, setup.rate)
        if found.free_bytes < needed:
            raise StateError(
                "arm",
                f"{found.runs} has {found.free_bytes / 1e6:.0f} MB left, but the recording may "
                f"need {needed / 1e6:.0f} MB; free some space",
                state,
            )

    # ---- what clients call ----------------------------------------------------------------------

    def _methods(self) -> dict[str, Method]:
        look, operate = Role.LOOK, Role.OPERATE
        text = (str,)
        return {
            "GetStatus": Method(look, self._get_status),
            "GetRig": Method(look, self._get_rig),
            "GetMetrics": Method(look, self._get_metrics),
            "Load": Method(
                operate,
                self._load,
                {"test_toml": text, "record": (dict,)},
                large=True,
                may_begin=self.engine.check_load,
            ),
            "Zero": Method(operate, self._zero),
            "Arm": Method(operate, self._arm, {"digest": text}),
            "Start": Method(operate, self._start, {"token": text}),
            "Hold": Method(look, self._plain("hold")),
            "Resume": Method(operate, self._plain("resume")),
            "Stop": Method(look, self._stop_test, {"now": (bool, None)}),
            "Reset": Method(operate, self._plain("reset")),
            "Reload": Method(operate, self._reload),
        }

    async def _get_status(self, _: Peer, __: dict[str, Any]) -> dict[str, Any]:
        return {"status": self.status()}

    async def _get_metrics(self, _: Peer, __: dict[str, Any]) -> dict[str, Any]:
        return {"text": metrics.text(self.status())}

    async def _get_rig(self, _: Peer, __: dict[str, Any]) -> dict[str, Any]:
        rig = self.engine.rig
        return {"name": rig.rig.name, "rig_toml": config.dump(rig)}

    @contextlib.contextmanager
    def _alone(self, command: str) -> Iterator[None]:
        """Refuse a command in the middle of a longer one, or while the service shuts down."""
        self._refuse_at_the_end(command)
        if self._busy.locked():
            raise StateError(
                command, "another load, zero or reload is in progress", self.engine.state
            )
        yield

    def _refuse_at_the_end(self, command: str) -> None:
        """Refuse commands that lead to a motion once the service is shutting down.

        Raises:
            StateError: the service is shutting down.
        """
        if self._stops:
            raise StateError(command, "the service is shutting down", self.engine.state)

    async def _load(self, peer: Peer, given: dict[str, Any]) -> dict[str, Any]:
        with self._alone("load"):
            async with self._busy:
                self.engine.check_load()
                loaded = await asyncio.to_thread(self._prepare, given)
                self.engine.load(loaded)
        log.info("loaded by %s", peer.name)
        return {"digest": loaded.digest, "notes": list(loaded.setup.notes)}

    def _prepare(self, given: dict[str, Any]) -> Loaded:
        test = config.parse_test(given["test_toml"], "test")
        return self.engine.prepare(test, _record(given["record"]))

    async def _zero(self, peer: Peer, _: dict[str, Any]) -> dict[str, Any]:
        with self._alone("zero"):
            async with self._busy:
                loaded = self.engine.check_zero()
                making = asyncio.ensure_future(asyncio.to_thread(self.engine.make_run, loaded))
                try:
                    run = await asyncio.shield(making)
                except asyncio.CancelledError:
                    # The service is shutting down: the ring being created is no longer needed.
                    (await making).remove()
                    raise
                self.engine.zero(run)
        log.info("zero by %s", peer.name)
        return {}

    async def _arm(self, peer: Peer, given: dict[str, Any]) -> dict[str, Any]:
        with self._alone("arm"):
            self.engine.check("arm")
            run = self.engine.recorded
            assert run is not None
            await self._await_recorder()
            self._check_recorder(run.setup)
            token = self.engine.arm(given["digest"], peer.name)
        log.info("armed by %s", peer.name)
        return {"token": token, "timeout_s": run.config.armed_ticks / self.engine.rate.hz}

    async def _start(self, peer: Peer, given: dict[str, Any]) -> dict[str, Any]:
        with self._alone("start"):
            self.engine.start_test(given["token"])
        log.info("started by %s", peer.name)
        return {}

    def _plain(self, name: core.Command) -> Callable[[Peer, dict[str, Any]], Any]:
        async def handle(peer: Peer, _: dict[str, Any]) -> dict[str, Any]:
            if name == "resume":
                self._refuse_at_the_end(name)
            self.engine.command(name)
            log.info("%s by %s", name, peer.name)
            return {}

        return handle

    async def _stop_test(self, peer: Peer, given: dict[str, Any]) -> dict[str, Any]:
        name: core.Command = "trip" if given.get("now") else "stop"
        self.engine.command(name)
        log.warning("%s by %s", name, peer.name)
        return {}

    async def _reload(self, peer: Peer, _: dict[str, Any]) -> dict[str, Any]:
        with self._alone("reload"):
            generation = await self._reload_rig()
        log.info("reloaded by %s", peer.name)
        return {"generation": generation}

    async def _reload_rig(self) -> int:
        if self._read_rig is None:
            raise StateError(
                "reload",
                "the service was started without a rig file that it could read again",
                self.engine.state,
            )
        # Reading the file is work that must not compete with a test in motion.
        self.engine.check_reload()
        async with self._busy:
            rig = await asyncio.to_thread(self._read_rig)
            covered, facts = self._covered(rig)
            loaded = await asyncio.to_thread(self._renewed, rig)
            generation = self.engine.reload(rig, loaded)
            self.engine.know(facts)
            self._commissioned = covered
            if covered != rig:
                log.warning(
                    "the rig has not been commissioned with these limits: the next start of the "
                    "service will require it"
                )
            return generation

    def _renewed(self, rig: RigFile | AxesRig) -> Loaded | None:
        """Prepare the loaded test with other limits; None if more than limits has changed."""
        if reloading.changed(self.engine.rig, rig):
            return None
        return self.engine.with_rig(rig)

    def _covered(self, rig: RigFile | AxesRig) -> tuple[RigFile | AxesRig, dict[str, Any]]:
        """Return the commissioned file that covers one with other limits, and its facts.

        As for the limits of a test, limits that allow no more need no new commissioning.

        Raises:
            RefusedError: there is no such file.
        """
        try:
            return rig, self._demand(rig)
        except RefusedError:
            before = self._commissioned
            if reloading.axes_of(rig) != reloading.axes_of(before):
                raise
            if more := reloading.looser(rig, before):
                raise RefusedError(
                    f"reload: {', '.join(more)} would allow more than was commissioned; stop the "
                    "service, run `rthyb commission` on the changed file, and start the service "
                    "again"
                ) from None
            covered = reloading.with_limits_of(rig, before)
            return covered, self._demand(covered)

    def _reload_by_signal(self) -> None:
        systemd.notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")
        self._reloading = asyncio.ensure_future(self._reload_and_say())

    async def _reload_and_say(self) -> None:
        try:
            await self._reload_rig()
        except RthybError as error:
            log.error("not reloaded: %s", error)
        finally:
            systemd.notify("READY=1", self._status_line())

    # ---- the status -----------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """Return the complete status as values for JSON."""
        engine = self.engine
        done, ticks = engine.progress
        loaded = engine.loaded
        newest = engine.newest
        return {
            "schema": SCHEMA,
            "version": __version__,
            "rig": engine.rig.rig.name,
            "link": engine.opened.name,
            "clock": engine.clock,
            "sample_rate_hz": engine.rate.hz,
            "state": engine.state,
            "states": list(STATES),
            "cause": engine.loop.cause,
            "cause_of": engine.cause_of,
            "cause_in_figures": engine.cause_in_figures,
            "allowed": engine.allowed,
            "not_zeroed": engine.not_zeroed,
            "tare": engine.tare,
            "follows": engine.follows(),
            "drive_stopped": engine.stays_stopped(),
            "test": None
            if loaded is None
            else {
                "name": loaded.setup.test.test.name,
                "digest": loaded.digest,
                "duration_s": loaded.setup.ticks / engine.rate.hz,
                "ground_motion": loaded.setup.motion.name,
                "pga_g": loaded.setup.motion.pga_g,
            },
            "progress": {"ticks": done, "of": ticks},
            "armed_by": engine.armed_by,
            "run_id": engine.run_id,
            "ring": str(engine.ring_path),
            "last": engine.last,
            "newest": None if newest is None else {key: newest[key].item() for key in _NEWEST},
            "axes": axes_status.of_axes(engine),
            "directions": axes_status.of_directions(engine),
            "ticks": engine.loop.counts._asdict(),
            "wake": {
                "p50_ns": engine.loop.wake.percentile_ns(50),
                "p99_ns": engine.loop.wake.percentile_ns(99),
                "max_ns": engine.loop.wake.max_ns,
            },
            "privileges": engine.loop.privileges,
            "indicated": engine.indicated,
            "loop": engine.loop.counters(),
            "wire": engine.wire_counters(),
            "wire_counters": engine.link_counters(),
            "recorder": self._recorder_status(),
            "connections": 0 if self._server is None else self._server.connections,
            "uptime_s": time.monotonic() - self._begun_s,
        }

    def _recorder_status(self) -> dict[str, Any]:
        found = self._recorder
        alive = found is not None and found.alive
        status = {} if found is None else asdict(found)
        return {**status, "alive": alive, "wanted": self.options.recorder != "none"}


def _clear_rests(folder: Path) -> None:
    """Delete the rings of daemons that were killed while at rest, to free their memory."""
    for path in ring.find(folder):
        with contextlib.suppress(RthybError, OSError, KeyError, TypeError):
            with ring.RingReader(path) as reader:
                alive = reader.alive
            if not alive and _is_of_no_use(ring.session_path(path)):
                ring.delete(path)


def _is_of_no_use(session: Path) -> bool:
    """Whether an abandoned ring is one at rest by its session, or has no session."""
    if not session.exists():
        return True
    return bool(recording.read(session, rows=False).meta["service"]["purpose"] == "rest")


def _to_log(event: Event) -> None:
    log.log(logging.getLevelNamesMapping()[event.level.upper()], "%s", event.text)


def _record(given: dict[str, Any]) -> GroundMotion:
    """Return the ground motion of a request.

    Raises:
        InputError: with all errors in it.
        ReplyError: its structure is not that of the interface.
    """
    wanted = {"name": str, "source": str, "acceleration_mps2": list, "details": dict}
    for key, kind in wanted.items():
        if not isinstance(given.get(key), kind):
            raise ReplyError("org.varlink.service.InvalidParameter", parameter=f"record.{key}")
    dt_s, samples, details = given.get("dt_s"), given["acceleration_mps2"], given["details"]
    if type(dt_s) not in (int, float) or given.keys() - wanted.keys() != {"dt_s"}:
        raise ReplyError("org.varlink.service.InvalidParameter", parameter="record.dt_s")
    assert isinstance(dt_s, (int, float))
    if not _DT_S[0] <= dt_s <= _DT_S[1]:
        raise InputError(f"found {dt_s} s; must be from {_DT_S[0]} to {_DT_S[1]} s", "record.dt_s")
    if len(samples) > MAX_POINTS or len(samples) * dt_s > MAX_DURATION_S:
        raise InputError(
            f"found {len(samples)} points, {len(samples) * dt_s:.6g} s; at most {MAX_POINTS} "
            f"points and {MAX_DURATION_S:g} s are accepted",
            "record.acceleration_mps2",
        )
    if not samples or any(type(value) not in (int, float) for value in samples):
        raise InputError("must be a list of at least one number", "record.acceleration_mps2")
    if not all(abs(value) <= _AG_MOST_MPS2 for value in samples):
        raise InputError(
            f"found more than {_AG_MOST_MPS2:g} m/s2: check the unit", "record.acceleration_mps2"
        )
    if not all(isinstance(value, str) for value in details.values()):
        raise InputError("must be strings", "record.details")
    _check_texts(given)
    try:
        float(details.get("scale", "1"))
    except ValueError:
        raise InputError("must be a number", "record.details.scale") from None
    row = np.asarray(samples, dtype=np.float64)
    return GroundMotion(given["name"][:200], given["source"][:1000], float(dt_s), row, details)


def _check_texts(record: dict[str, Any]) -> None:
    """Refuse text that a terminal or an HDF5 file cannot represent.

    Raises:
        InputError: with the place.
    """
    details = record["details"]
    if (
        len(details) > _DETAILS_MOST
        or sum(map(len, (*details, *details.values()))) > _DETAILS_SIGNS
    ):
        raise InputError(
            f"at most {_DETAILS_MOST} entries are accepted, with {_DETAILS_SIGNS} characters in "
            "total",
            "record.details",
        )
    named = [(f"record.{key}", record[key], "") for key in ("name", "source")]
    named += [("record.details", text, "\n\t") for text in (*details, *details.values())]
    for where, text, also in named:
        for sign in text:
            # Control characters, surrogates, and marks that change the reading direction.
            if unicodedata.category(sign).startswith("C") and sign not in also:
                raise InputError(
                    f"contains the character U+{ord(sign):04X}, which is not allowed in text", where
                )


def record_of(motion: GroundMotion) -> dict[str, Any]:
    """Return a ground motion in the form of a request."""
    return {
        "name": motion.name,
        "source": motion.source,
        "dt_s": motion.dt_s,
        "acceleration_mps2": motion.acceleration_mps2.tolist(),
        "details": dict(motion.details),
    }
