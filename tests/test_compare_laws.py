"""One test through all control laws: what is run, what is printed, what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from command_line import Rthyb

from rthyb_rt import config
from rthyb_rt.analysis import summary
from rthyb_rt.campaign import comparison
from rthyb_rt.core.laws import LAWS
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time

SHORT = ("test.duration_s=6",)
TEST = """schema = "rthyb-test/1"
test = { name = "short", duration_s = 4 }
numerical = { period_s = 0.5, damping_ratio = 0.02 }
"""


def test_every_law_runs_the_same_test_and_the_best_response_stands_first() -> None:
    told: list[tuple[int, int, str]] = []
    rows = comparison.compare(None, None, SHORT, (), lambda *told_now: told.append(told_now))
    assert {row["law"] for row in rows} == set(LAWS)
    assert [name for _, _, name in told] == list(LAWS)
    ended = [row["ending"] for row in rows]
    assert ended == sorted(ended, key=lambda one: one != "completed")
    responses = [row["response_nrmse"] for row in rows if row["ending"] == "completed"]
    assert responses == sorted(responses)
    assert rows[-1]["law"] in ("none", "amb")
    assert all(row["ending"] != "failed" for row in rows)


def test_a_row_is_what_running_the_test_with_that_law_gives() -> None:
    (row,) = comparison.compare(None, None, SHORT, ["ats"])
    test, rig = config.load_both(None, None, [*SHORT, "controller.type=ats"])
    found = summary.summarize(virtual_time.run(experiment.prepare(test, rig)))
    assert row["response_nrmse"] == found.response_nrmse
    assert row["tracking_nrmse"] == found.tracking_nrmse
    assert row["alpha_end"] == found.alpha_end


def test_a_law_that_refuses_the_test_says_why_and_the_others_run(tmp_path: Path) -> None:
    """Without an identified delay a law that needs one has nothing to begin with."""
    rig = tmp_path / "rig.toml"
    rig.write_text(
        'schema = "rthyb-rig/1"\nrig = { name = "bare", elastic_stiffness_n_per_m = 1e6 }\n'
        'actuator = { kind = "pure-delay", delay_samples = 3 }\n'
        '[[specimen]]\nelement = "stiffness"\nk_n_per_m = 1e6\n'
    )
    test = tmp_path / "test.toml"
    controller = 'controller = { type = "none" }'
    test.write_text(f'rig = "{rig}"\n{TEST}{controller}\n')
    rows = comparison.compare(test, None, (), ["paper", "none", "ats"])
    by_name = {row["law"]: row for row in rows}
    assert rows[-1]["law"] == "paper"
    assert by_name["paper"]["ending"] == "failed"
    assert "alpha0" in by_name["paper"]["cause"]
    assert by_name["ats"]["ending"] == "completed"


@pytest.mark.parametrize(
    ("settings", "names", "words"),
    [
        ((), ["atz"], "must be one of"),
        (
            ("controller.type=ats",),
            [],
            "is varied by the comparison itself; choose the laws with --law",
        ),
        (("test.duration_s=-1",), [], "duration_s"),
    ],
)
def test_what_cannot_be_compared_is_named(
    settings: tuple[str, ...], names: list[str], words: str
) -> None:
    with pytest.raises(InputError) as caught:
        comparison.compare(None, None, settings, names)
    assert words in str(caught.value)


def test_the_command_prints_a_line_a_law_and_all_measures_as_json(rthyb: Rthyb) -> None:
    arguments = ("compare-laws", "--set", SHORT[0], "--law", "ats", "--law", "none")
    shown = rthyb(*arguments)
    assert shown.code == 0
    lines = shown.out.splitlines()
    assert lines[0].split()[:2] == ["law", "response"]
    assert {lines[2].split()[0], lines[3].split()[0]} == {"ats", "none"}
    machine = rthyb(*arguments, "--json")
    laws = machine.json["laws"]
    assert isinstance(laws, list)
    assert {one["law"] for one in laws} == {"ats", "none"}
    assert all(math.isfinite(one["tracking_nrmse"]) for one in laws)


def test_why_a_law_ended_early_is_a_line_below_the_table_which_stays_as_narrow(
    rthyb: Rthyb,
) -> None:
    """In a file or a pipe, where a line has no end: without compensation the frame diverges."""
    laws = ("--law", "ats", "--law", "none")
    shown = rthyb("compare-laws", "frame-three-storeys", "--set", "test.duration_s=3", *laws)
    table, below = shown.out.split("\nNot completed:\n")
    assert [line.split()[0] for line in table.splitlines()[2:]] == ["ats", "none"]
    widest = max(len(line) for line in table.splitlines() if "─" not in line)
    assert max(map(len, table.splitlines())) == widest
    (why,) = below.splitlines()
    assert why.startswith("  none: force ")
    assert "without compensation this structure remains stable up to" in why
