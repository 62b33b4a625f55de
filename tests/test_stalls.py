"""What a stalled machine may be blamed for, and what becomes of a run that met stalls."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import stalls
from stalls import TICK_S, Late, NotRun, Stalled, proof, repeated


def late(ticks: float, woken_s: float, thread: str = "fifo") -> Late:
    return Late(thread, woken_s - ticks * TICK_S, woken_s)


# ---- the proof, by the clock of the reference ---------------------------------------------------


@pytest.mark.parametrize("cause", ["stalled", "link_lost", "drive_stopped"])
def test_stall_is_proved_by_a_reference_that_was_late_at_the_same_moment(cause: str) -> None:
    assert "19 ticks late at 5.000 s" in proof([late(19, 5.0)], cause, 5.01, 5.01)
    assert proof([late(19, 5.0)], cause, 4.95, 4.95)


@pytest.mark.parametrize(
    "lates",
    [
        [],
        [late(9.5, 5.0)],  # not late enough
        [late(200, 4.0)],  # at another moment: before
        [late(200, 5.3)],  # and after
        [late(200, 5.0, "other")],  # of a thread that comes after the program's
        [late(4, 4.99), late(4, 5.0)],
    ],
)
def test_trip_for_a_stall_that_no_reference_has_seen_is_not_proved(lates: Sequence[Late]) -> None:
    assert proof(lates, "stalled", 5.0, 5.0) == ""


def test_skips_are_proved_by_what_a_second_has_cost_in_all() -> None:
    small = [late(1.2, 4.1 + 0.1 * n) for n in range(9)]
    assert proof(small, "skips", 5.0, 5.0)
    assert not proof(small[:8], "skips", 5.0, 5.0)
    assert not proof(small, "skips", 5.8, 5.8)
    assert not proof(small, "stalled", 5.0, 5.0)


def test_silence_of_a_program_is_proved_by_an_ordinary_thread() -> None:
    assert proof([late(600, 5.0, "other")], "heartbeat", 5.0, 5.0)
    assert not proof([late(600, 5.0)], "heartbeat", 5.0, 5.0)


def test_notes_of_a_reference_are_read(tmp_path: Path) -> None:
    file = tmp_path / "late.1"
    assert stalls.read(file) == []
    file.write_text("fifo 1000000000 1500000000\nother 2000000000 2001000000\n", encoding="ascii")
    first, second = stalls.read(file)
    assert (first.thread, first.due_s, first.woken_s) == ("fifo", 1.0, 1.5)
    assert first.ticks == 512.0
    assert second.thread == "other"


def test_without_a_reference_a_stall_is_taken_as_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RTHYB_GUEST", raising=False)
    assert stalls.seen(Stalled("stalled")) == "stalled"


# ---- attempts -----------------------------------------------------------------------------------


def by(lates: Sequence[Late]) -> Callable[[Stalled], str]:
    return lambda stalled: proof(lates, stalled.cause, stalled.from_s, stalled.to_s)


def stalls_in(numbers: Sequence[int], tried: list[int]) -> Callable[[int], None]:
    """An attempt at whose end, number + 1 s, the program said it had stalled."""

    def attempt(number: int) -> None:
        tried.append(number)
        if number in numbers:
            raise Stalled("stalled", number + 1.0, number + 1.0)

    return attempt


EVERY_SECOND = [late(30, float(second)) for second in range(1, 10)]


def test_scenario_that_met_a_proved_stall_begins_again() -> None:
    tried: list[int] = []
    repeated(stalls_in([0, 1], tried), 3, by(EVERY_SECOND))
    assert tried == [0, 1, 2]


def test_scenario_that_met_one_in_every_attempt_is_not_run() -> None:
    tried: list[int] = []
    with pytest.raises(NotRun, match=r"stalled in each of 3 attempts: .* 30 ticks late at 3.000 s"):
        repeated(stalls_in([0, 1, 2], tried), 3, by(EVERY_SECOND))
    assert tried == [0, 1, 2]


@pytest.mark.parametrize("unproved", [0, 1])
def test_trip_without_a_proved_stall_is_a_failure_when_it_comes_twice(unproved: int) -> None:
    tried: list[int] = []
    with pytest.raises(AssertionError, match="no stall of this machine explains it"):
        repeated(stalls_in([0, 1, 2], tried), 3, by(EVERY_SECOND[:unproved]))
    assert tried == list(range(unproved + 2))


def test_failure_of_the_program_stays_one_beside_a_stall() -> None:
    def attempt(number: int) -> None:
        assert number, "as a product fails"

    with pytest.raises(AssertionError, match="as a product fails"):
        repeated(attempt, 3, by(EVERY_SECOND))


# ---- the accounts -------------------------------------------------------------------------------

SCENARIOS = """
import pytest, stalls

@pytest.mark.parametrize("number", range({total}))
def test_scenario(number):
    def attempt(_):
        if number < {stalled}:
            raise stalls.Stalled("stalled", 1.0, 1.0)
        assert number < {total} - {failed}
    stalls.repeated(attempt, 2, lambda _: "late at 1 s")
"""
CONFTEST = """
import pathlib, stalls

def pytest_configure(config):
    accounts = stalls.Accounts(pathlib.Path(__file__).with_name("accounts.json"))
    config.pluginmanager.register(accounts, stalls.NAME)
"""


def boot(folder: Path, total: int, stalled: int = 0, failed: int = 0) -> tuple[int, str]:
    """Run made-up scenarios in a session of their own; return exit code and output."""
    folder.mkdir(exist_ok=True)
    (folder / "conftest.py").write_text(CONFTEST, encoding="utf-8")
    (folder / "pytest.ini").write_text("[pytest]\naddopts = -q\n", encoding="utf-8")
    name = f"test_{len(list(folder.glob('test_*')))}.py"
    text = SCENARIOS.format(total=total, stalled=stalled, failed=failed)
    (folder / name).write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", name]
    known = {"PYTHONPATH": str(Path(__file__).parent), "PYTHONDONTWRITEBYTECODE": "1"}
    known["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # most of a start is other people's plugins
    ran = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **known},
        capture_output=True,
        text=True,
        check=False,
    )
    return ran.returncode, ran.stdout


def test_five_in_a_hundred_not_run_are_told_and_six_fail(tmp_path: Path) -> None:
    code, said = boot(tmp_path / "five", 100, stalled=5)
    assert code == 0, said
    assert "not run: 5 of 100 scenarios (5.0 %), no failure up to 5 %" in said
    assert "test_scenario[4]: this machine stalled in each of 2 attempts: late at 1 s" in said
    assert "95 passed" in said
    assert "5 not run" in said
    code, said = boot(tmp_path / "six", 100, stalled=6)
    assert code == 1
    assert "not run: 6 of 100 scenarios (6.0 %), a failure, at most 5 %" in said


def test_failure_beside_scenarios_that_were_not_run_stays_one(tmp_path: Path) -> None:
    code, said = boot(tmp_path, 40, stalled=1, failed=1)
    assert code == 1
    assert "1 failed, 38 passed, 1 not run" in said


@pytest.mark.long
def test_scenarios_of_all_boots_are_counted_together(tmp_path: Path) -> None:
    assert "0 of 19 " in boot(tmp_path, 19)[1]
    code, said = boot(tmp_path, 3, stalled=1)
    assert code == 0, said
    assert "1 of 22 scenarios (4.5 %)" in said
    code, said = boot(tmp_path, 3, stalled=1)
    assert code == 1
    assert "2 of 25 scenarios (8.0 %), a failure" in said


def test_one_that_was_not_run_is_no_failure_though_there_are_few(tmp_path: Path) -> None:
    assert boot(tmp_path / "one", 19, stalled=1)[0] == 0
    assert boot(tmp_path / "two", 19, stalled=2)[0] == 1
