"""A short test on a quiet virtual rig, and processes of both, for tests in real time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
import stalls

from rthyb_rt import config
from rthyb_rt.core import STATES, loop
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening

STATE = {name: number for number, name in enumerate(STATES)}
PROGRAM = [sys.executable, "-c", "import sys; from rthyb_rt.cli import main; sys.exit(main())"]
PATIENCE_S = 60.0
"""Long enough for a machine that stalls; a process that takes longer hangs."""
STALLED = stalls.CAUSES
ATTEMPTS = 3

SHORT = {
    "test.duration_s": "1.5",
    "ground_motion.start_s": "1.5",
    "limits.ramp_in_s": "0.25",
    "limits.tare_s": "0.125",
}
ROWS = 1536
"""Duration of its RUNNING state."""
QUIET = {
    "rig.sensors.displacement.noise_std_m": "0",
    "rig.sensors.displacement.lsb_m": "0",
    "rig.sensors.force.noise_std_n": "0",
    "rig.sensors.force.lsb_n": "0",
}


def setup(changes: dict[str, str] | None = None, rig: dict[str, str] | None = None) -> Any:
    """Return the built-in test, shortened, with further settings."""
    test = config.load_test(config.builtin_test_path(), SHORT | (changes or {}))
    return experiment.prepare(
        test, config.load_rig(config.find_rig(test.rig), rig or {}), real_time=True
    )


@dataclass
class Bench:
    """Controller and drive in lockstep on the stepped clock, so that all runs are deterministic.

    Attributes:
        tell: called before every tick of the controller, with the drive, for timed events.
    """

    changes: dict[str, str] = field(default_factory=dict)
    rig: dict[str, str] = field(default_factory=dict)
    faults: tuple[loop.Fault, ...] = ()
    operator: realtime.Operator = field(default_factory=realtime.Operator)
    tell: Callable[[loop.Drive], None] = lambda _: None
    log: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def run(self, **arguments: Any) -> RecordedTest:
        """Run the whole test."""
        made = setup(self.changes, self.rig)
        plan = virtual_rig.RigPlan(faults=self.faults, log_ticks=40000)
        ours, theirs = opening.socket_pair()
        with ours, theirs, virtual_rig.in_step(made.rig, theirs, plan) as drive:

            def before_tick() -> None:
                self.tell(drive)
                drive.tick()

            try:
                return realtime.run(
                    made,
                    ours,
                    clock="stepped",
                    before_tick=before_tick,
                    operator=self.operator,
                    **arguments,
                )
            finally:
                self.log = drive.log

    def when(self, state: str, act: Callable[[], None], ticks: int = 200) -> Bench:
        """Schedule an action for some time after the drive first receives a state."""
        seen = [0]

        def tell(drive: loop.Drive) -> None:
            entry = drive.log[-1:]
            seen[0] += bool(entry.size and (seen[0] or entry["state"][0] == STATE[state]))
            if seen[0] == ticks:
                act()

        self.tell = tell
        return self


def require_calm(rec: RecordedTest, *expected: str, serial: bool = False) -> None:
    """Raise `Stalled` if a stall ended the test instead of the expected event.

    ``serial``: the data of the link are moved by ordinary kernel threads.
    """
    facts = rec.meta.get("real_time", {})
    cause = facts.get("cause", "none")
    if cause in set(STALLED) - set(expected):
        rows = rec.samples
        ended = rows["state"] == STATE["TRIPPED"]
        if not ended.any():
            ended = rows["state"] == STATE["RAMP_OUT"]
        row = int(np.argmax(ended)) if ended.any() else -1
        at_s = moment_s(rec, row)
        by_link = serial and cause in ("link_lost", "drive_stopped")
        raise stalls.Stalled("serial link" if by_link else str(cause), at_s, at_s)


def moment_s(rec: RecordedTest, row: int) -> float:
    """Return the due time of a row's tick (CLOCK_MONOTONIC)."""
    return 1e-9 * (int(rec.meta["real_time"]["began_ns"]) + int(rec.samples["due_ns"][row]))


def stop_begins(log: np.ndarray) -> int:
    """Return the drive's last tick in which it ceased to follow."""
    following = np.flatnonzero(log["phase"] == loop.PHASES.index("following"))
    return int(following[-1]) + 1


# ---- processes ----------------------------------------------------------------------------------


class Process:
    """A command of the program in a separate process."""

    def __init__(self, folder: Path, *arguments: object, env: dict[str, str] | None = None) -> None:
        self.process = subprocess.Popen(
            [*PROGRAM, *map(str, arguments)],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(env or {})},
            start_new_session=True,
        )

    def line(self) -> str:
        """Return the next line of its stdout."""
        out: IO[str] | None = self.process.stdout
        assert out is not None
        return out.readline()

    def remark(self) -> str:
        """Return the next line of its stderr."""
        err: IO[str] | None = self.process.stderr
        assert err is not None
        return err.readline()

    def signal(self, signum: int) -> None:
        self.process.send_signal(signum)

    def end(self) -> tuple[int, str, str]:
        """Wait for its end; return exit status, stdout, stderr."""
        try:
            out, err = self.process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            out, err = self.process.communicate()
            pytest.fail(f"the process hung: {out}\n{err}")
        return self.process.returncode, out, err

    def kill(self) -> None:
        """Kill it if it is still running."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


@contextmanager
def process(folder: Path, *arguments: object, **more: Any) -> Iterator[Process]:
    made = Process(folder, *arguments, **more)
    try:
        yield made
    finally:
        made.kill()


def until(condition: Callable[[], Any], what: str) -> Any:
    """Wait for a value, however slow the machine, and return it."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end, f"never came: {what}"
        time.sleep(0.005)
    return found
