"""The service for tests: an engine in lockstep with its drive, a daemon in a thread."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from realtime_bench import SHORT, until

from rthyb_rt import config
from rthyb_rt.config import AxesRig, RigFile, TestFile
from rthyb_rt.core import loop
from rthyb_rt.lab import experiment
from rthyb_rt.record import ring
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening
from rthyb_rt.rig.links.opened import Opened
from rthyb_rt.service.control import Client, ControlServer, Dispatcher
from rthyb_rt.service.daemon import Daemon, Options
from rthyb_rt.service.peers import Peer, Rights
from rthyb_rt.service.rig_engine import Engine, Event, Loaded

LOOKERS, OPERATORS = 60001, 60002
"""Groups that do not exist on any test machine."""
OWNER = 60000
RIGHTS = Rights(LOOKERS, OPERATORS, OWNER)

ROOT = Peer(1, 0, frozenset({0}))
OPERATOR = Peer(2, 1001, frozenset({100, OPERATORS}))
LOOKER = Peer(3, 1002, frozenset({100, LOOKERS}))
STRANGER = Peer(4, 1003, frozenset({100}))


def short_test(changes: dict[str, str] | None = None) -> TestFile:
    return config.load_test(config.builtin_test_path(), SHORT | (changes or {}))


def rig_file(changes: dict[str, str] | None = None) -> RigFile:
    return config.load_rig(config.find_rig(short_test().rig), changes or {})


class Bench:
    """An engine on the stepped clock with its drive, or the drives of its axes."""

    def __init__(
        self,
        engine: Engine,
        drive: Any,
        events: list[Event],
        test_of: Callable[[dict[str, str] | None], TestFile] = short_test,
    ) -> None:
        self.engine, self.drive, self.events = engine, drive, events
        self.test_of = test_of

    @property
    def said(self) -> list[str]:
        return [event.text for event in self.events]

    def loaded(self, changes: dict[str, str] | None = None) -> Loaded:
        test = self.test_of(changes)
        found = self.engine.prepare(test, experiment.load_motion(test))
        self.engine.load(found)
        return found

    def until(self, state: str, most_s: float = 20.0) -> None:
        for _ in range(round(most_s / 0.02)):
            if self.engine.state == state:
                return
            self.engine.wait(0.02)
        raise AssertionError(f"never {state}, but {self.engine.state}: {self.said}")

    def reach(self, state: str, changes: dict[str, str] | None = None) -> None:
        """Bring a new engine to a state."""
        engine = self.engine
        if state == "IDLE":
            return
        if engine.loaded is None:
            self.loaded(changes)
        engine.zero()
        self.until("ZEROED")
        if state == "ZEROED":
            return
        assert engine.loaded is not None
        token = engine.arm(engine.loaded.digest, "the test")
        if state == "ARMED":
            return
        engine.start_test(token)
        if state == "RAMP_IN":
            return
        self.until("RUNNING")
        engine.wait(0.3)
        if state == "HOLD":
            engine.command("hold")
            engine.wait(0.7)
        elif state == "RAMP_OUT":
            engine.command("stop")
        elif state == "TRIPPED":
            engine.command("trip")
        assert engine.state == state

    def finish(self) -> None:
        """Let the test end normally."""
        self.until("IDLE", 60.0)
        self.engine.wait(0.3)
        assert self.engine.recorded is None


@contextmanager
def bench(
    folder: Path,
    changes: dict[str, str] | None = None,
    faults: Sequence[loop.Fault] = (),
    *,
    rig: RigFile | AxesRig | None = None,
    test_of: Callable[[dict[str, str] | None], TestFile] = short_test,
) -> Iterator[Bench]:
    """Yield an engine in IDLE, whose drive follows, with `rig_file` or the given ``rig``."""
    rig = rig or rig_file(changes)
    plan = virtual_rig.RigPlan(faults=tuple(faults), log_ticks=60000)
    events: list[Event] = []
    ours, theirs = pair(rig)
    with ours, theirs, virtual_rig.in_step(rig, theirs, plan) as drive:
        engine = Engine(
            rig,
            ours,
            clock="stepped",
            folder=folder,
            before_tick=drive.tick,
            tell=events.append,
        )
        try:
            engine.start()
            engine.wait(0.2)
            yield Bench(engine, drive, events, test_of)
        finally:
            engine.close()


def pair(rig: RigFile | AxesRig) -> tuple[Opened, Opened]:
    """Return both ends of a link, or of a link for each axis."""
    axes = rig.names if isinstance(rig, AxesRig) else ()
    return opening.socket_pairs(axes) if axes else opening.socket_pair()


def left(folder: Path) -> list[RecordedTest]:
    """Return the recordings left in the rings by the tests, the oldest first."""
    paths = sorted(ring.find(folder), key=lambda path: int(path.suffix[1:]))
    return [ring.recover(path).recording for path in paths]


# ---- the daemon ---------------------------------------------------------------------------------


class InThread:
    """An event loop in a separate thread."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()

    def call(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(60.0)

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


@contextmanager
def served(folder: Path, **more: Any) -> Iterator[Daemon]:
    """Yield a daemon on the stepped clock that listens at ``folder/control.sock``."""
    rig = more.pop("rig", None) or rig_file()
    given = {"recorder": "none", "require_realtime": False, "rights": Rights.of_system()} | more
    read_rig: Callable[[], RigFile | AxesRig] | None = given.pop("read_rig", None)
    demand: Callable[[RigFile | AxesRig], dict[str, Any]] = given.pop("demand", lambda _: {})
    options = Options(
        socket=folder / "control.sock", rings=folder / "rings", runs=folder / "runs", **given
    )
    ours, theirs = pair(rig)
    with ours, theirs, virtual_rig.in_step(rig, theirs) as drive:
        daemon = Daemon(
            rig,
            ours,
            "stepped",
            options,
            demand=demand,
            read_rig=read_rig,
            before_tick=drive.tick,
        )
        thread = InThread()
        working = asyncio.run_coroutine_threadsafe(daemon.work(), thread.loop)
        try:
            # The socket file exists slightly before the daemon listens.
            while daemon._server is None and not working.done():
                os.sched_yield()
            yield daemon
            thread.loop.call_soon_threadsafe(daemon.stop)
            assert working.result(60.0) == 0
        finally:
            # Resources left by a failed test must not be found by the garbage collector later.
            if not working.done():
                thread.loop.call_soon_threadsafe(daemon.stop)
                wait([working], 20.0)
            thread.close()
            daemon.engine.close()
            daemon._end_recorder()


def status(folder: Path) -> dict[str, Any]:
    """Return the status of the daemon in `served`."""
    with Client(folder / "control.sock") as client:
        found: dict[str, Any] = client.call("GetStatus")["status"]
        return found


def await_state(folder: Path, state: str) -> None:
    until(lambda: status(folder)["state"] == state, state)


@contextmanager
def listening(path: Path, dispatcher: Dispatcher, **limits: Any) -> Iterator[ControlServer]:
    """Yield a control server with only a dispatcher."""
    from rthyb_rt.service.control import ClientLimits

    thread = InThread()

    async def made() -> ControlServer:
        server = ControlServer(path, dispatcher, ClientLimits(**limits))
        await server.start()
        return server

    try:
        server = thread.call(made())
        try:
            yield server
        finally:
            thread.call(server.stop())
    finally:
        thread.close()
