"""Whose fault it was that a scenario in real time did not end as it should: the machine's, or not.

A machine that stalls has the program end a test as it then must. A scenario that meets that says
`Stalled`. In the guest machine this is a suspicion only: it has to be proved by a reference thread,
which does nothing but sleep and note when it was itself late (``vm/reference.c``). A stall that is
proved has the scenario begin again; one that was met in every attempt has it *not run*, which is
counted and told. A stall that nobody else has seen is a failure of the program.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

TICK_S = 1.0 / 1024.0
CAUSES = ("stalled", "skips", "heartbeat", "drive_stopped", "link_lost", "lost_pairs")
"""By which a machine that stalls may end a test in real time."""
SHARE_MOST = 0.05
"""Of the scenarios may not run, and one in any case, which of a few would be more than that; with
more of them the machine has proved nothing."""
SLACK_S = 0.1
"""By which what is held against the reference may have been noted too early."""
NAME = "accounts"
JOB = Path("/run/job")


class Stalled(Exception):
    """It looks as if this machine had stalled, and the program did what it then should.

    Args:
        cause: one of `CAUSES`, or any other word for what was seen.
        from_s, to_s: when (CLOCK_MONOTONIC), as nearly as known.
    """

    def __init__(self, cause: str, from_s: float = 0.0, to_s: float = math.inf) -> None:
        super().__init__(cause)
        self.cause, self.from_s, self.to_s = cause, from_s, to_s


class NotRun(pytest.skip.Exception):
    """The machine let no attempt come to anything."""


# ---- the proof ----------------------------------------------------------------------------------


class Late(NamedTuple):
    """Once when a reference thread was late: "fifo" or "other", and when (CLOCK_MONOTONIC)."""

    thread: str
    due_s: float
    woken_s: float

    @property
    def ticks(self) -> float:
        return (self.woken_s - self.due_s) / TICK_S


class Needed(NamedTuple):
    """What proves a stall: a thread that was late by so many ticks within so many."""

    thread: str
    ticks: float
    within: float


UNEXPLAINED_MOST = 2
"""Ends that no stall explains are the program's when they come twice: the reference is one thread,
and may not see what holds up another process of the scenario, its drive or the kernel between."""

TWENTY_TICKS = Needed("fifo", 10, 100)
NEEDED = {
    "skips": Needed("fifo", 10, 1024),
    "heartbeat": Needed("other", 512, 1536),
    "lost_pairs": Needed("fifo", 20, 1024),
    "serial link": Needed("other", 10, 100),
}
"""Half of what the program's own watch counts (1024 ticks of silence; 20), and a fifth where it
adds up single ticks (50 or 102 in 1024): the reference wakes every second tick and talks to nobody,
so it sleeps through most stalls that are as short as that."""


def proof(lates: Iterable[Late], cause: str, from_s: float, to_s: float) -> str:
    """Return in words what the reference saw of a stall at that time; "": it saw none."""
    thread, ticks, within = NEEDED.get(cause, TWENTY_TICKS)
    own = [late for late in lates if late.thread == thread]
    inside = (late.woken_s for late in own if from_s < late.woken_s <= to_s + SLACK_S)
    for end_s in (from_s, *inside):
        close = [late for late in own if end_s - within * TICK_S < late.woken_s <= end_s]
        late = sum(each.ticks for each in close)
        if late >= ticks:
            at_s = close[-1].woken_s
            return f"the reference thread was {late:.0f} ticks late at {at_s:.3f} s"
    return ""


def read(file: Path) -> list[Late]:
    """Return what reference threads have noted."""
    lines = file.read_text(encoding="ascii").splitlines() if file.exists() else []
    words = (line.split() for line in lines)
    return [Late(name, int(due) * 1e-9, int(woken) * 1e-9) for name, due, woken in words]


def noted(boot: str = os.environ.get("RTHYB_BOOT", "")) -> Path:
    """Return the file of the guest's reference threads, in this boot or another."""
    return JOB / f"late.{boot}"


def seen(stalled: Stalled) -> str:
    """Return what proves a stall on this machine; without a reference it is taken as said."""
    if "RTHYB_GUEST" not in os.environ:
        return stalled.cause
    return proof(read(noted()), stalled.cause, stalled.from_s, stalled.to_s)


# ---- attempts -----------------------------------------------------------------------------------


def repeated(
    attempt: Callable[[int], None], most: int, proved: Callable[[Stalled], str] = seen
) -> None:
    """Call with 0, 1, 2 ... until no stall is met.

    Args:
        attempt: raises `Stalled` where it seems to have met one; begins from a known state.
        most: attempts.
        proved: returns what proves the stall; "": nothing does.

    Raises:
        NotRun: every attempt has met a stall that was proved.
        AssertionError: one has met what no stall explains.
    """
    evidence = ""
    unexplained = 0
    for number in range(most):
        try:
            attempt(number)
            if number:
                print(f"attempts: {number + 1}")
            return
        except Stalled as stalled:
            evidence = proved(stalled)
            if not evidence:
                unexplained += 1
                if unexplained == UNEXPLAINED_MOST or number == most - 1:
                    raise AssertionError(
                        f"{stalled.cause}: no stall of this machine explains it, the reference "
                        "thread was in time"
                    ) from stalled
            print(f"stalled: {stalled.cause}; {evidence or 'nothing explains it yet'}")
    raise NotRun(f"this machine stalled in each of {most} attempts: {evidence}")


# ---- the accounts -------------------------------------------------------------------------------


class Accounts:
    """What became of the scenarios, over all boots of a guest machine; a plugin of pytest.

    Args:
        file: where it outlives a boot; None: nothing does.
    """

    def __init__(self, file: Path | None = None) -> None:
        self.file = file
        self.run, self.not_run = 0, {}
        if file is not None and file.exists():
            found = json.loads(file.read_text(encoding="utf-8"))
            self.run, self.not_run = found["run"], dict(found["not_run"])

    def add(self, name: str, not_run: str = "") -> None:
        """Count a scenario; ``not_run``: why."""
        if not_run:
            self.not_run[name] = not_run
        else:
            self.run += 1
        if self.file is not None:
            facts = {"run": self.run, "not_run": self.not_run}
            self.file.write_text(json.dumps(facts), encoding="utf-8")

    @property
    def total(self) -> int:
        return self.run + len(self.not_run)

    @property
    def too_many(self) -> bool:
        """Whether the machine has let too few scenarios run."""
        return len(self.not_run) > max(SHARE_MOST * self.total, 1)

    def lines(self) -> Sequence[str]:
        """Return what is to be told."""
        if not self.not_run:
            return (f"not run: 0 of {self.total} scenarios",)
        share = 100.0 * len(self.not_run) / self.total
        verdict = "a failure, at most" if self.too_many else "no failure up to"
        head = f"not run: {len(self.not_run)} of {self.total} scenarios ({share:.1f} %)"
        reasons = (f"  {name}: {why}" for name, why in self.not_run.items())
        return (f"{head}, {verdict} {100 * SHARE_MOST:.0f} %", *reasons)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, call: pytest.CallInfo[None]):  # type: ignore[no-untyped-def]
        report = yield
        if call.excinfo is not None and isinstance(call.excinfo.value, NotRun):
            report.not_run = str(call.excinfo.value)
        return report

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: pytest.TestReport) -> tuple[str, str, str] | None:
        return ("not run", "N", "NOT RUN") if getattr(report, "not_run", "") else None

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or (report.when == "setup" and not report.passed):
            self.add(report.nodeid, getattr(report, "not_run", ""))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        terminalreporter.ensure_newline()
        for line in self.lines():
            terminalreporter.write_line(line)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self.too_many and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


def of(config: pytest.Config) -> Accounts:
    """Return the accounts of a session in the guest."""
    found = config.pluginmanager.get_plugin(NAME)
    assert isinstance(found, Accounts)
    return found


# ---- in the guest -------------------------------------------------------------------------------


def begin_in_guest(config: pytest.Config) -> None:
    """Have a reference thread from now on, and what became of the scenarios counted."""
    config.pluginmanager.register(Accounts(JOB / "scenarios.json"), NAME)
    command = [os.environ["RTHYB_REFERENCE"], str(noted())]
    if Path("/run/systemd/system").is_dir():
        # To the very end of a shutdown, which is looked at in the next boot.
        unit = ("--unit=reference", "--collect", "--quiet", "--property=DefaultDependencies=no")
        subprocess.run(["systemd-run", *unit, *command], check=True)
    else:
        process = subprocess.Popen(command)
        config.add_cleanup(process.wait)
        config.add_cleanup(process.terminate)
    end_s = time.monotonic() + 10.0
    while not noted().exists():
        assert time.monotonic() < end_s, "no reference thread: it wants real-time priority"
        time.sleep(0.01)
