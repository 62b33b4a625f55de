"""Controller, drive and bare reference thread as processes, connected by a socket pair."""

from __future__ import annotations

import json
import math
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rthyb_rt import core
from rthyb_rt.core import ticker
from rthyb_rt.lab import punctuality

HERE: Final = Path(__file__).resolve().parent
ROOT: Final = HERE.parents[1]
BUILD: Final = ROOT / "build" / "proof"
HALF_NS: Final = round(ticker.PERIOD_NS / 2)
REPEAT_ABOVE_NS: Final = punctuality.REPEAT_ABOVE_NS
ATTEMPTS: Final = 3
PATIENCE_S: Final = 60.0
FLAGS: Final = {name: 1 << bit for bit, name in enumerate(core.FLAG_NAMES)}
STATE: Final = {name: number for number, name in enumerate(core.STATES)}


@cache
def compiled(name: str, *sources: str, shared: bool = False) -> Path:
    """Build one of the C programs in this folder with the necessary parts of the core."""
    BUILD.mkdir(parents=True, exist_ok=True)
    target = BUILD / name
    kind = ["-shared", "-fPIC"] if shared else []
    files = [HERE / f"{name.split('.')[0]}.c", *(ROOT / "csrc" / source for source in sources)]
    command = ["gcc", "-std=c11", "-O2", *kind, f"-I{ROOT / 'csrc'}", *files, "-lpthread"]
    done = subprocess.run(
        [*map(str, command), "-o", str(target)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return target


@dataclass(frozen=True)
class Reference:
    """Timing of the bare thread."""

    executed: int
    skipped: int
    longest_ns: int
    p50_ns: int
    p99_ns: int
    fifo: bool


@dataclass
class Run:
    """Results of a completed run.

    Attributes:
        rows: rows of the ring, from the first tick on.
        facts: counters of the controller, by name.
        log: log of the drive, one entry per tick of its own.
        times: due, woken and done for each of these ticks, ns, (n, 3); zeros if not recorded.
        t0_ns: due time of the controller's tick 0.
        began_ns: later time at which drive and bare thread began.
    """

    rows: np.ndarray
    facts: dict[str, Any]
    log: np.ndarray
    times: np.ndarray
    drive: dict[str, Any]
    reference: Reference
    t0_ns: int
    began_ns: int

    @property
    def skipped_by_drive(self) -> int:
        """Ticks that the drive slept through."""
        return int(self.drive["counts"]["skipped"])

    @property
    def disturbed(self) -> bool:
        """Whether the machine itself was more than 10 ms late."""
        return self.reference.longest_ns > REPEAT_ABOVE_NS


@dataclass(frozen=True)
class Plan:
    """Settings of a run."""

    name: str
    seconds: float
    clock: str = "host"
    ppm: float = 0.0
    burner: bool = False
    timed: bool = False
    count_allocations: bool = False
    swapped: bool = False
    """The controller on the first processor and the drive on the last."""


class Parties:
    """The processes of one run."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        self.plan, self._folder = plan, folder / plan.name
        self._folder.mkdir(parents=True, exist_ok=True)
        self._owned = ExitStack()
        allowed = sorted(os.sched_getaffinity(0))
        self._cpu, self._drive_cpu = allowed[-1], allowed[0]
        if plan.swapped:
            self._cpu, self._drive_cpu = self._drive_cpu, self._cpu

    def start(self) -> Parties:
        """Start controller, drive and reference, and the test."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ours, theirs:
            self.controller = self._controller(ours.fileno())
            self.t0_ns = int(self._line(self.controller))
            self._later_ns = math.ceil((ticker.now_ns() - self.t0_ns) / 1e9 + 2.0) * 10**9
            self._drive = self._drive_process(theirs.fileno(), self.t0_ns + self._later_ns)
            assert self._line(self._drive) == "ready"
        self._reference = self._reference_process()
        assert self.controller.stdin is not None
        self.controller.stdin.write("go\n")
        self.controller.stdin.flush()
        return self

    def _process(self, command: list[str], **more: Any) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **more
        )
        self._owned.callback(self._end, process)
        return process

    @staticmethod
    def _end(process: subprocess.Popen[str]) -> None:
        if process.poll() is None:
            process.kill()
            process.communicate()

    def _python(self, script: str, spec: dict[str, Any], fd: int, **more: Any) -> Any:
        spec |= {"fd": fd, "seconds": self.plan.seconds}
        command = [sys.executable, str(HERE / script), json.dumps(spec)]
        return self._process(command, pass_fds=[fd], **more)

    def _controller(self, fd: int) -> subprocess.Popen[str]:
        environment = dict(os.environ)
        if self.plan.count_allocations:
            environment["LD_PRELOAD"] = str(compiled("counting.so", shared=True))
        spec = {
            "clock": self.plan.clock,
            "burner": self.plan.burner,
            "cpu": self._cpu,
            "out": str(self._folder / "controller.npz"),
        }
        return self._python("controller.py", spec, fd, env=environment)

    def _drive_process(self, fd: int, t0_ns: int) -> subprocess.Popen[str]:
        spec = {
            "t0_ns": t0_ns + HALF_NS,
            "ppm": self.plan.ppm,
            "timed": self.plan.timed,
            "cpu": self._drive_cpu,
            "out": str(self._folder / "drive.npz"),
        }
        return self._python("drive.py", spec, fd)

    def _reference_process(self) -> subprocess.Popen[str]:
        program = compiled("reference", "ticker.c", "latency.c", "thread.c")
        ticks = round(self.plan.seconds * core.FS_HZ)
        begin = self.t0_ns + self._later_ns + HALF_NS
        return self._process([str(program), *map(str, (begin, ticks, ticker.PRIORITY, self._cpu))])

    @staticmethod
    def _line(process: subprocess.Popen[str]) -> str:
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        assert line, f"{process.args} ended before it had begun"
        return line

    def finish(self) -> Run:
        """Wait for the end of the test and return its results."""
        with self._owned:
            patience = self.plan.seconds + PATIENCE_S
            self.controller.communicate(timeout=patience)
            self._drive.communicate(timeout=PATIENCE_S)
            out = self._reference.communicate(timeout=PATIENCE_S)[0]
            for process in (self.controller, self._drive, self._reference):
                assert process.returncode == 0, f"{process.args} ended with {process.returncode}"
            with np.load(self._folder / "controller.npz") as found:
                rows, facts = found["rows"], json.loads(str(found["facts"]))
            with np.load(self._folder / "drive.npz") as found:
                log, times, drive = found["log"], found["times"], json.loads(str(found["facts"]))
        *numbers, fifo = map(int, out.split())
        reference = Reference(*numbers, fifo=bool(fifo))
        return Run(rows, facts, log, times, drive, reference, self.t0_ns, self._later_ns)


def repeated(
    plans: list[Plan], folder: Path = BUILD, beside: Callable[[list[Parties]], None] | None = None
) -> dict[str, tuple[Run, int]]:
    """Run all plans at the same time; repeat disturbed ones, up to three attempts.

    Returns:
        the last run of each plan and its number of attempts, by name.
    """
    found: dict[str, tuple[Run, int]] = {}
    for attempt in range(1, ATTEMPTS + 1):
        due = [plan for plan in plans if plan.name not in found or found[plan.name][0].disturbed]
        if not due:
            break
        parties = [Parties(plan, folder).start() for plan in due]
        if beside is not None:
            beside(parties)
        for plan, party in zip(due, parties, strict=True):
            found[plan.name] = party.finish(), attempt
    return found
