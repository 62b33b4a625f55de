"""The benchmark as a campaign: the figures of `rthyb benchmark rths`, kept run by run."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import Rthyb

from rthyb_rt.benchmark import benchmark_runs, benchmark_table, campaigns, cases
from rthyb_rt.benchmark.benchmark_runs import BenchmarkRun
from rthyb_rt.campaign import book, campaign_page, pools, whole_campaign
from rthyb_rt.campaign.plan import Plan, PlannedRun
from rthyb_rt.errors import InputError

EXAMPLE = Path(__file__).parents[1] / "examples" / "campaigns" / "benchmark-rths.toml"
SLICE = """
schema = "rthyb-campaign/1"
[campaign]
name = "a-slice"
keep = "tripped"
[benchmark]
name = "rths"
plants = 1
[over]
law = ["inverse", "none"]
rate_hz = [1024]
motion = ["kobe"]
structure = [2]
"""


def sliced(folder: Path, text: str = SLICE) -> Plan:
    path = folder / "campaign.toml"
    path.write_text(text)
    return campaigns.read(path)


def test_the_whole_benchmark_is_one_campaign_with_every_law_that_there_is() -> None:
    found = campaigns.read(EXAMPLE).cases
    assert len(found) == 4 * 21 * 3 * len(cases.entrants()) * 2
    assert {case.chosen["law"] for case in found} == {one.name for one in cases.entrants()}
    assert len({case.command() for case in found}) == len(found)


@pytest.mark.long
def test_the_campaign_and_the_command_give_the_same_figures(rthyb: Rthyb, tmp_path: Path) -> None:
    rows = whole_campaign.conduct(sliced(tmp_path), tmp_path / "out", jobs=1).rows
    words = "--law inverse --law none --rate 1024 --motion kobe --case 2 --plants 1 --jobs 1 --json"
    of_command = json.loads(rthyb("benchmark", "rths", *words.split()).out)["runs"]
    assert len(rows) == len(of_command) == 4
    for row, run in zip(rows, of_command, strict=True):
        assert (row["law"], row["plant"]) == (run["entrant"], run["plant"])
        assert (row["ending"] == "completed") == (run["end"] == "completed")
        assert {key: row[key] for key in run["figures"]} == run["figures"]
    assert [row["ending"] for row in rows] == ["completed", "completed", "stopped", "stopped"]
    assert "limit 8.9 kN" in rows[2]["cause"]
    assert (tmp_path / "out" / rows[2]["folder"] / "recording.h5").is_file()


@pytest.mark.long
def test_a_run_that_no_law_could_bring_to_its_end_is_not_called_unstable(tmp_path: Path) -> None:
    """Case 3 with Kobe: the stiffest plants need more than 8900 N by the reference itself."""
    run = BenchmarkRun("inverse", 1024, 3, "kobe", 7001)
    outcome = benchmark_runs.measure(run)
    assert not outcome.completed
    assert outcome.beyond
    (line,) = benchmark_table.lines([outcome, benchmark_runs.measure(replace(run, plant=7002))])
    assert (line.runs, line.unstable, line.beyond) == (2, 0, 1)
    assert benchmark_table.cells(line)[-1] == "0 of 1"
    unstable = benchmark_runs.measure(replace(run, entrant="none", case=4))
    assert not unstable.completed
    assert not unstable.beyond
    text = SLICE.replace("[2]", "[3]").replace(', "none"', "")
    row = whole_campaign.conduct(sliced(tmp_path, text), tmp_path / "out", jobs=1).rows[1]
    assert row["beyond"]
    assert row["cause"].endswith(
        "the reference simulation of this plant exceeds that limit as well"
    )


@pytest.mark.long
def test_a_run_is_repeated_by_the_command_that_the_page_gives(rthyb: Rthyb, tmp_path: Path) -> None:
    plan = sliced(tmp_path)
    row = whole_campaign.conduct(plan, tmp_path / "out", jobs=1).rows[1]
    html = (tmp_path / "out" / campaign_page.PAGE).read_text(encoding="utf-8")
    command = plan.cases[1].command()
    assert command in html
    (run,) = json.loads(rthyb(*command.split()[1:], "--json").out)["runs"]
    assert run["plant"] == row["plant"] == 7001
    assert run["figures"]["J4"] == row["J4"]


@pytest.mark.long
def test_a_benchmark_that_was_interrupted_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = sliced(tmp_path)
    whole = whole_campaign.conduct(plan, tmp_path / "whole", jobs=1).rows
    with book.Book(tmp_path / "out", plan) as kept:
        for row in whole[:3]:
            kept.add(row)
    asked: list[int] = []
    locally = pools.locally

    def watched(left: list[PlannedRun], *arguments: object) -> None:
        asked.extend(case.number for case in left)
        locally(left, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(pools, "locally", watched)
    found = whole_campaign.conduct(plan, tmp_path / "out", jobs=1).rows
    assert asked == [3]
    assert [row | {"folder": ""} for row in found] == [row | {"folder": ""} for row in whole]


def test_the_page_lists_the_worst_run_of_every_group_however_many_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = sliced(tmp_path, SLICE.replace("plants = 1", "plants = 20"))
    rows = [
        case.identity() | {"ending": "completed", "cause": "", "true": 0.1, "J4": 1.0 + n}
        for n, case in enumerate(plan.cases)
    ]
    monkeypatch.setattr(campaign_page, "MOST_ROWS", 5)
    html = campaign_page.render(plan, rows)
    links = set(re.findall(r'href="#(run-\d+)"', html))
    assert len(links) >= 2
    assert links <= set(re.findall(r'id="(run-\d+)"', html))
    assert f"contains the other {len(rows) - 5}." in html


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            SLICE.replace('"none"', '"nun"'),
            r"campaign.toml:10: over.law: found 'nun'; must be pi-lead",
        ),
        (
            SLICE.replace("[1024]", "[2048]"),
            r":11: over.rate_hz: found 2048; must be one of 4096, 1024",
        ),
        (SLICE.replace("[2]", "[5]"), r":13: over.structure: found 5; must be one of 1, 2, 3, 4"),
        (SLICE.replace('"kobe"', '"kobo"'), r":12: over.motion: found kobo; must"),
        (SLICE.replace("structure", "case"), r":13: over.case: is not a key of a benchmark"),
        (
            SLICE.replace("plants = 1", "plants = 1\nwidth = 0"),
            r":9: benchmark.width: found 0; .* must be above 0",
        ),
        (SLICE.replace("plants = 1", "plants = 21"), r":8: benchmark.plants"),
        (SLICE.replace('"rths"', '"marths"'), r":7: benchmark.name"),
        (
            SLICE.replace("keep =", 'test = "x.toml"\nkeep ='),
            r"campaign.test: a benchmark has its own",
        ),
        ("noise_seeds = 3\n" + SLICE, r"campaign.toml:1: noise_seeds: a benchmark has its own"),
        (
            SLICE + '[draws]\ncount = 1\n[draws.spread]\n"rig.actuator.kp_per_s" = 0.1\n',
            r"draws: a benchmark has its own",
        ),
    ],
)
def test_what_the_benchmark_does_not_have_is_told_before_anything_runs(
    tmp_path: Path, text: str, told: str
) -> None:
    with pytest.raises(InputError) as caught:
        sliced(tmp_path, text)
    assert re.search(told, str(caught.value)), str(caught.value)
