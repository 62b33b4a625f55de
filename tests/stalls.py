"""Decides whether an unexpected end of a real-time scenario was caused by the machine.

A stall of the machine makes the program end a test, as it must. A scenario that encounters this
raises `Stalled`. In the guest machine this is only a suspicion, to be confirmed by a reference
thread that only sleeps and records when it was late (``vm/reference.c``). After a confirmed stall
the scenario is repeated; if all attempts encounter one, it is *not run*, which is counted and
reported. A stall that the reference did not see is a failure of the program.
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
"""Causes by which a stall of the machine may end a test in real time."""
SHARE_MOST = 0.05
"""Share of the scenarios, but at least one, that need not run; with more, the machine has shown
nothing."""
SLACK_S = 0.1
"""Time by which an event to compare with the reference may be recorded too early."""
NAME = "accounts"
JOB = Path("/run/job")


class Stalled(Exception):
    """The machine appears to have stalled, and the program to have reacted correctly.

    Args:
        cause: one of `CAUSES`, or any other description.
        from_s, to_s: when (CLOCK_MONOTONIC), as far as known.
    """

    def __init__(self, cause: str, from_s: float = 0.0, to_s: float = math.inf) -> None:
        super().__init__(cause)
        self.cause, self.from_s, self.to_s = cause, from_s, to_s


class NotRun(pytest.skip.Exception):
    """The machine stalled in every attempt."""


# ---- confirmation -------------------------------------------------------------------------------


class Late(NamedTuple):
    """A delay of a reference thread: "fifo" or "other", and when (CLOCK_MONOTONIC)."""

    thread: str
    due_s: float
    woken_s: float

    @property
    def ticks(self) -> float:
        return (self.woken_s - self.due_s) / TICK_S


class Needed(NamedTuple):
    """What confirms a stall: a thread that was late by this many ticks within this many."""

    thread: str
    ticks: float
    within: float


UNEXPLAINED_MOST = 2
"""Unconfirmed ends count as the program's if they occur twice: the reference is a single thread,
and may not see what delays another process of the scenario, its drive or the kernel."""

TWENTY_TICKS = Needed("fifo", 10, 100)
NEEDED = {
    "skips": Needed("fifo", 10, 1024),
    "heartbeat": Needed("other", 512, 1536),
    "lost_pairs": Needed("fifo", 20, 1024),
    "serial link": Needed("other", 10, 100),
}
"""Half of the program's own limits (1024 ticks of silence; 20), and a fifth where it sums single
ticks (50 or 102 in 1024): the reference wakes every second tick and does no I/O, so it sleeps
through most stalls of this length."""


def proof(lates: Iterable[Late], cause: str, from_s: float, to_s: float) -> str:
    """Describe what the reference saw of a stall at that time; "" if nothing."""
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
    """Return the records of reference threads."""
    lines = file.read_text(encoding="ascii").splitlines() if file.exists() else []
    words = (line.split() for line in lines)
    return [Late(name, int(due) * 1e-9, int(woken) * 1e-9) for name, due, woken in words]


def noted(boot: str = os.environ.get("RTHYB_BOOT", "")) -> Path:
    """Return the file of the guest's reference threads, in this boot or another."""
    return JOB / f"late.{boot}"


def seen(stalled: Stalled) -> str:
    """Return what confirms a stall on this machine; without a reference it is assumed."""
    if "RTHYB_GUEST" not in os.environ:
        return stalled.cause
    return proof(read(noted()), stalled.cause, stalled.from_s, stalled.to_s)


# ---- attempts -----------------------------------------------------------------------------------


def repeated(
    attempt: Callable[[int], None], most: int, proved: Callable[[Stalled], str] = seen
) -> None:
    """Call with 0, 1, 2 ... until no stall occurs.

    Args:
        attempt: raises `Stalled` if it appears to have encountered one; begins in a known state.
        most: number of attempts.
        proved: returns what confirms the stall; "" if nothing.

    Raises:
        NotRun: every attempt encountered a confirmed stall.
        AssertionError: an attempt ended without a stall as explanation.
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
    """Results of the scenarios over all boots of a guest machine; a plugin of pytest.

    Args:
        file: file in which they persist over a boot; None: none.
    """

    def __init__(self, file: Path | None = None) -> None:
        self.file = file
        self.run, self.not_run = 0, {}
        if file is not None and file.exists():
            found = json.loads(file.read_text(encoding="utf-8"))
            self.run, self.not_run = found["run"], dict(found["not_run"])

    def add(self, name: str, not_run: str = "") -> None:
        """Count a scenario; ``not_run``: the reason, if any."""
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
        """Whether too many scenarios were not run."""
        return len(self.not_run) > max(SHARE_MOST * self.total, 1)

    def lines(self) -> Sequence[str]:
        """Return the lines to report."""
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
    """Return the results of a session in the guest."""
    found = config.pluginmanager.get_plugin(NAME)
    assert isinstance(found, Accounts)
    return found


# ---- in the guest -------------------------------------------------------------------------------


def begin_in_guest(config: pytest.Config) -> None:
    """Start a reference thread, and count the results of the scenarios from now on."""
    config.pluginmanager.register(Accounts(JOB / "scenarios.json"), NAME)
    command = [os.environ["RTHYB_REFERENCE"], str(noted())]
    if Path("/run/systemd/system").is_dir():
        # Until the very end of a shutdown, which is examined in the next boot.
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
