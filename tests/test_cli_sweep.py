"""A sweep from the command line: its options, what it keeps, how it goes on."""

from __future__ import annotations

import csv
import json
import statistics
from pathlib import Path

import pytest

import rthyb_rt as rt
from rthyb_rt import cli

SHORT = ["--set", "ground_motion.duration_s=2", "--jobs", "1"]
LAWS = ["--over", "controller.type=paper,robust"]


def swept(folder: Path, *words: str) -> int:
    return cli.main(["sweep", *words, *SHORT, "--out", str(folder)])


@pytest.mark.long
def test_every_value_meets_every_other_and_numbers_stay_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "swept"
    assert swept(out, *LAWS, "--over", "controller.w1=3,4.5", "--repeat-seeds", "2", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["runs"] == 8
    told = [(r["controller.type"], r["controller.w1"], r["repeat"]) for r in found["rows"]]
    assert told == [(law, w, n) for law in ("paper", "robust") for w in (3, 4.5) for n in (0, 1)]
    wanted = rt.run(
        rt.Test("section5-T0.5").with_(
            {"ground_motion.duration_s": 2, "controller.w1": 4.5, "controller.type": "robust",
             "rig.seed": 2}
        )
    )  # fmt: skip
    assert found["rows"][-1]["response_nrmse"] == wanted.measures["response_nrmse"]


@pytest.mark.long
def test_statistics_over_the_seeds_are_those_of_the_table(tmp_path: Path) -> None:
    out = tmp_path / "swept"
    assert swept(out, *LAWS, "--repeat-seeds", "3") == 0
    with (out / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    with (out / "statistics.csv").open() as file:
        groups = list(csv.DictReader(file))
    assert [one["controller.type"] for one in groups] == ["paper", "robust"]
    for one in groups:
        values = [
            float(row["response_nrmse"]) for row in rows
            if row["controller.type"] == one["controller.type"]
        ]  # fmt: skip
        assert float(one["response_nrmse_mean"]) == pytest.approx(sum(values) / 3)
        assert float(one["response_nrmse_std"]) == pytest.approx(statistics.stdev(values))
        assert float(one["response_nrmse_worst"]) == max(values)
        assert one["runs"] == one["completed"] == "3"


@pytest.mark.long
def test_runs_that_end_early_are_named_and_the_exit_code_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "swept"
    early = ["--over", "controller.w1=3,1", "--over", "limits.force_n=15 kN,0.5 kN"]
    assert swept(out, *early) == 6
    printed = capsys.readouterr().out
    assert "1 of 4 runs completed" in printed
    assert "Run 1 stopped: force" in printed
    assert "Run 2 failed: --set controller.w1: w1 = 1" in printed


@pytest.mark.long
def test_interrupted_sweep_goes_on_and_no_run_is_lost_or_doubled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "swept"
    words = [*LAWS, "--repeat-seeds", "2"]
    assert swept(out, *words) == 0
    rows = (out / "rows.jsonl").read_text().splitlines(keepends=True)
    # As a power failure leaves it: two rows and a half.
    (out / "rows.jsonl").write_text("".join(rows[:2]) + rows[2][:40])
    assert swept(out, *words) == 0
    again = (out / "rows.jsonl").read_text().splitlines(keepends=True)
    assert sorted(again) == sorted(rows)
    assert swept(out, *LAWS, "--repeat-seeds", "3") == 3
    assert "holds a sweep of another test or rig or with other values" in capsys.readouterr().err


def test_dry_run_lists_the_runs_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert swept(tmp_path / "swept", *LAWS, "--dry-run") == 0
    printed = capsys.readouterr().out
    assert ": 2 runs" in printed
    assert "--set controller.type=robust" in printed
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_rigs_are_swept_by_name_and_by_file(tmp_path: Path) -> None:
    own = rt.Rig("delay-10-elastic").with_({"rig.name": "own"}).save(tmp_path / "own.toml")
    out = tmp_path / "swept"
    words = ["--over", f"rig=delay-10-elastic,{own}", "--set", 'limits.force_n="60 kN"']
    assert swept(out, *words, "--keep", "all") == 0
    names = [rt.open(out / "runs" / f"{n:06d}").rig["rig.name"] for n in (0, 1)]
    assert names == ["delay-10-elastic", "own"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--over", "controller.typ=a,b"], '--over controller.typ: unknown key (did you mean "ty'),
        (["--over", "controller.w1"], '--over: found "controller.w1"; must be KEY=V1,V2,...'),
        (["--over", "controller.w1=3,,4"], "--over: found"),
        (["--over", "controller.w1=3", "--over", "controller.w1=4"], "w1: occurs twice"),
        (["--over", "controller.w1=3,3"], "--over controller.w1: found a list of 2; a value"),
        ([*LAWS, "--repeat-seeds", "0"], "--repeat-seeds: found 0"),
        ([*LAWS, "--keep", "al"], '--keep: found "al" (did you mean "all"?)'),
        ([*LAWS, "--name", "My Sweep"], '--name: found "My Sweep"'),
    ],
)
def test_wrong_use_is_told_in_the_words_of_the_options_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    assert swept(tmp_path / "swept", *words) == 3
    assert told in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
