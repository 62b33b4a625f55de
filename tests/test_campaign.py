"""Campaigns: one test over lists, seeds and drawn plants, on processes that may die."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rthyb_rt import config
from rthyb_rt.benchmark import campaigns
from rthyb_rt.campaign import (
    book,
    campaign_page,
    campaign_tables,
    groups,
    one_run,
    plan,
    pools,
    whole_campaign,
)
from rthyb_rt.campaign.plan import PlannedRun, Row
from rthyb_rt.errors import InputError, RthybError

SHORT = '"test.duration_s" = [3]'
TWO_LAWS = f"""
schema = "rthyb-campaign/1"
[campaign]
name = "two-laws"
[over]
"controller.type" = ["paper", "alpha-beta"]
{SHORT}
"""


def campaign(folder: Path, text: str = TWO_LAWS) -> plan.Plan:
    path = folder / "campaign.toml"
    path.write_text(text)
    return campaigns.read(path)


def fault(folder: Path, text: str) -> str:
    with pytest.raises(InputError) as caught:
        campaign(folder, text)
    return str(caught.value)


# ---- the plan -----------------------------------------------------------------------------------


def test_every_value_meets_every_value_of_the_other_lists(tmp_path: Path) -> None:
    text = TWO_LAWS + '"ground_motion.pga_g" = [0.02, "0.04 g", 0.06]\n'
    cases = campaign(tmp_path, text).cases
    met = {(c.chosen["controller.type"], c.chosen["ground_motion.pga_g"]) for c in cases}
    assert len(cases) == len(met) == 6
    assert [case.number for case in cases] == list(range(6))
    assert cases[1].settings[-1] == "ground_motion.pga_g=0.04 g"


def test_values_that_go_together_move_line_by_line(tmp_path: Path) -> None:
    text = TWO_LAWS + '[[together]]\n"numerical.mass_kg" = [4220, 8440]\n"controller.w1" = [3, 4]\n'
    text = text.replace('"paper", ', "")
    pairs = [
        (c.chosen["numerical.mass_kg"], c.chosen["controller.w1"])
        for c in campaign(tmp_path, text).cases
    ]
    assert pairs == [(4220, 3), (8440, 4)]


DRAWN = (
    TWO_LAWS
    + """
[draws]
count = 400
seed = 7
[draws.spread]
"rig.actuator.kp_per_s" = 0.05
"rig.specimen.0.k_n_per_m" = { low = 0.9, high = 1.1 }
"""
)


def test_drawn_plants_scatter_as_stated_about_the_rig_file(tmp_path: Path) -> None:
    cases = campaign(tmp_path, DRAWN).cases
    assert len(cases) == 2 * 401
    of_first = [case for case in cases if case.chosen["controller.type"] == "paper"]
    assert of_first[0].drawn == 0
    assert not [s for s in of_first[0].settings if s.startswith("rig.")]
    found = {
        key: np.array(
            [float(s.split("=")[1]) for c in of_first[1:] for s in c.settings if s.startswith(key)]
        )
        for key in ("rig.actuator.kp_per_s", "rig.specimen.0.k_n_per_m")
    }
    gains, stiffness = found.values()
    # Standard errors of mean and deviation of 400 draws; three of them.
    assert abs(gains.mean() / 63.5 - 1.0) < 3 * 0.05 / 20
    assert abs(gains.std() / 63.5 / 0.05 - 1.0) < 3 / np.sqrt(800)
    assert (stiffness / 666.4e3 >= 0.9).all()
    assert (stiffness / 666.4e3 <= 1.1).all()
    assert np.ptp(stiffness / 666.4e3) > 0.18


def test_more_draws_leave_the_first_plants_as_they_were(tmp_path: Path) -> None:
    few = campaign(tmp_path, DRAWN.replace("count = 400", "count = 3"))
    many = campaign(tmp_path, DRAWN)
    assert [c.settings for c in few.cases[:4]] == [c.settings for c in many.cases[:4]]
    other = campaign(tmp_path, DRAWN.replace("seed = 7", "seed = 8"))
    assert other.cases[1].settings != many.cases[1].settings


def test_all_laws_meet_the_same_plants(tmp_path: Path) -> None:
    cases = campaign(tmp_path, DRAWN.replace("count = 400", "count = 5")).cases
    drawn = [[s for s in c.settings if s.startswith("rig.")] for c in cases]
    assert drawn[:6] == drawn[6:]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (TWO_LAWS.replace("[campaign]", "[campain]"), r"campaign.toml:3: campain: unknown key"),
        (TWO_LAWS.replace('"controller.type"', '"controller.typ"'), r":6: controller.typ: unknown"),
        (TWO_LAWS.replace('"alpha-beta"', '"paper"'), r":6: over.*twice"),
        (TWO_LAWS.replace("[3]", "[]"), r":7: over.*empty list"),
        (TWO_LAWS.replace("[3]", "[[3]]"), r":7: over.*a string, a number, true or false"),
        (TWO_LAWS.replace("two-laws", "Two laws"), r":4: campaign.name"),
        (TWO_LAWS + '[[together]]\n"controller.type" = ["ats"]\n', r"controller.type is varied"),
        (
            TWO_LAWS + '[[together]]\n"controller.w1" = [3]\n"controller.w2" = [1, 2]\n',
            r"different length",
        ),
        (
            TWO_LAWS + '[draws]\ncount = 1\n[draws.spread]\n"rig.rig.name" = 0.1\n',
            r"no number there",
        ),
        (
            TWO_LAWS + '[draws]\ncount = 1\n[draws.spread]\n"rig.actuator.kp_per_s" = {low = 1.1, '
            "high = 0.9}\n",
            r"high must be above low",
        ),
        (
            TWO_LAWS + '[draws]\ncount = 1\n[draws.spread]\n"rig.actuator.kp_per_s" = -0.1\n',
            r"draws.spread",
        ),
        ("noise_seeds = 0\n" + TWO_LAWS, r"campaign.toml:1: noise_seeds"),
        (
            "noise_seeds = 100000\n" + TWO_LAWS + '"controller.w1" = [3, 4, 5, 6, 7, 8]\n',
            r"1200000 runs; a campaign may have at most 1000000",
        ),
    ],
)
def test_slip_in_the_file_is_told_with_its_line_before_anything_runs(
    tmp_path: Path, text: str, told: str
) -> None:
    assert re.search(told, fault(tmp_path, text))


# ---- the runs -----------------------------------------------------------------------------------


@pytest.mark.long
def test_row_of_a_run_has_the_figures_of_rthyb_run(tmp_path: Path) -> None:
    case = campaign(tmp_path).cases[1]
    row = one_run.carry_out(case)
    words = [*case.command().split()[1:], "--no-report", "--json", "--out", "x"]
    code = "import sys; from rthyb_rt import cli; sys.exit(cli.main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, check=True
    )
    measures = json.loads(done.stdout)["measures"]
    for name in ("tracking_nrmse", "response_nrmse", "peak_measured_m", "energy_error_j"):
        assert row[name] == measures[name]


@pytest.mark.long
def test_run_that_trips_is_kept_with_its_cause_and_runs_again_as_it_stands(tmp_path: Path) -> None:
    text = TWO_LAWS.replace('"alpha-beta"', '"none"').replace("[3]", "[8]")
    case = campaign(tmp_path, text).cases[1]
    row = one_run.carry_out(case, "tripped", str(tmp_path))
    assert row["ending"] == plan.STOPPED
    assert "limit 15 kN" in row["cause"]
    kept = tmp_path / row["folder"]
    assert {p.name for p in kept.iterdir()} >= {"recording.h5", "test.toml", "rig.toml"}
    again = one_run.carry_out(PlannedRun(0, {}, -1, 0, str(kept / "test.toml"), "", ()))
    assert again["peak_measured_m"] == row["peak_measured_m"]


def test_run_that_cannot_be_carried_out_is_a_row_that_says_why(tmp_path: Path) -> None:
    case = campaign(tmp_path, TWO_LAWS + '"numerical.mass_kg" = [4220, -1]\n').cases[1]
    row = one_run.carry_out(case)
    assert row["ending"] == plan.FAILED
    assert "numerical.mass_kg" in row["cause"]
    assert json.dumps(row, allow_nan=False)


def test_noise_seeds_repeat_a_run_with_other_noise_alone(tmp_path: Path) -> None:
    cases = campaign(tmp_path, "noise_seeds = 2\n" + TWO_LAWS).cases
    one, two = (one_run.carry_out(case) for case in cases[:2])
    assert one["tracking_nrmse"] != two["tracking_nrmse"]
    assert abs(one["tracking_nrmse"] / two["tracking_nrmse"] - 1.0) < 0.1


@pytest.mark.long
def test_processes_give_the_rows_that_one_process_gives(tmp_path: Path) -> None:
    found = whole_campaign.conduct(campaign(tmp_path), tmp_path / "out", jobs=2)
    assert found.rows == [one_run.carry_out(case) for case in found.plan.cases]


# ---- what is kept -------------------------------------------------------------------------------


def made_up(number: int, **more: object) -> Row:
    return {"case": number, "controller.type": "paper", "ending": "completed", "cause": "", **more}


def test_interrupted_campaign_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = campaign(tmp_path, "noise_seeds = 3\n" + TWO_LAWS)
    with book.Book(tmp_path / "out", whole) as kept:
        for case in whole.cases[:4]:
            kept.add(one_run.carry_out(case))
    # The power fails while a line is written.
    with (tmp_path / "out" / book.ROWS).open("a") as file:
        file.write('{"case": 4, "ending"')
    asked: list[int] = []

    def locally(
        cases: list[PlannedRun], jobs: int, keep: str, folder: str, done: pools.Done
    ) -> None:
        asked.extend(case.number for case in cases)
        for case in cases:
            done(one_run.carry_out(case))

    monkeypatch.setattr(pools, "locally", locally)
    found = whole_campaign.conduct(whole, tmp_path / "out")
    assert asked == [4, 5]
    assert [row["case"] for row in found.rows] == list(range(6))
    assert whole_campaign.conduct(whole, tmp_path / "out").rows == found.rows
    assert asked == [4, 5]


def test_folder_of_another_campaign_is_not_mixed_with_this_one(tmp_path: Path) -> None:
    first = campaign(tmp_path)
    book.Book(tmp_path / "out", first).close()
    other = campaign(tmp_path, TWO_LAWS.replace("[3]", "[4]"))
    with pytest.raises(InputError, match="other runs, other files"):
        book.Book(tmp_path / "out", other)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty"):
        book.Book(tmp_path / "full", first)


def test_campaign_that_is_under_way_is_not_begun_a_second_time(tmp_path: Path) -> None:
    whole = campaign(tmp_path)
    with book.Book(tmp_path / "out", whole), pytest.raises(RthybError, match="another process"):
        book.Book(tmp_path / "out", whole)


def test_changed_rig_file_is_another_campaign(tmp_path: Path) -> None:
    rig = Path(__file__).parents[1] / "hw" / "rigs" / "shaking-table-portal-frame.toml"
    own = tmp_path / "rig.toml"
    own.write_text(rig.read_text())
    text = TWO_LAWS.replace('"two-laws"', '"two-laws"\nrig = "rig.toml"')
    first = campaign(tmp_path, text)
    assert first.cases[0].rig == str(own)
    own.write_text(rig.read_text().replace("kp_per_s = 63.5", "kp_per_s = 60"))
    assert campaign(tmp_path, text).fingerprint != first.fingerprint


MOTION = "t [s],a [m/s2]\n" + "".join(f"{0.01 * n:.2f},{n % 7 - 3}\n" for n in range(200))
LAW = """
import rthyb_rt as rt
class Held(rt.ControlLaw):
    def lead(self, x_c_m, allowed_m):
        return x_c_m
"""


def test_changed_ground_motion_or_control_law_is_another_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows computed with the file as it was before do not meet rows with the file as it is now."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    motion, law = tmp_path / "motion.csv", tmp_path / "held_command.py"
    text = (Path(__file__).parents[1] / "examples" / "section5-T0.5.toml").read_text()
    (tmp_path / "mine.toml").write_text(
        text.replace("elcentro-1940-ns", "motion.csv").replace("duration_s = 40", "duration_s = 1")
    )
    by_test = TWO_LAWS.replace('"two-laws"', '"two-laws"\ntest = "mine.toml"')
    by_list = TWO_LAWS + '"ground_motion.record" = ["motion.csv"]\n'
    by_class = TWO_LAWS + '"controller.python.class" = ["held_command:Held"]\n'
    by_class = by_class.replace('"paper", "alpha-beta"', '"python"')
    for file, before, texts in (
        (motion, MOTION, (by_test, by_list)),
        (law, LAW, (by_class,)),
    ):
        for text in texts:
            file.write_text(before)
            first = campaign(tmp_path, text).fingerprint
            assert campaign(tmp_path, text).fingerprint == first
            file.write_text(before + "\n")
            assert campaign(tmp_path, text).fingerprint != first


def test_campaign_that_was_moved_with_its_files_goes_on(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "elsewhere" / "there"
    (here / "rigs").mkdir(parents=True)
    there.parent.mkdir()
    repository = Path(__file__).parents[1]
    for name in ("first", "second"):
        rig = repository / "hw" / "rigs" / "shaking-table-portal-frame.toml"
        (here / "rigs" / f"{name}.toml").write_text(rig.read_text() + f"# {name}\n")
    test = (repository / "examples" / "section5-T0.5.toml").read_text()
    (here / "mine.toml").write_text(
        test.replace("elcentro-1940-ns", "motion.csv").replace("duration_s = 40", "duration_s = 1")
    )
    (here / "motion.csv").write_text(MOTION)
    text = TWO_LAWS.replace('"two-laws"', '"two-laws"\ntest = "mine.toml"')
    text += 'rig = ["rigs/first.toml", "rigs/second.toml"]\n'
    first = campaign(here, text)
    book.Book(here / "out", first).close()
    here.rename(there)
    moved = campaign(there, text)
    assert [one.rig for one in moved.cases] != [one.rig for one in first.cases]
    with book.Book(there / "out", moved) as kept:
        assert kept.left == list(moved.cases)
    # Two files that have changed places are other runs.
    rigs = there / "rigs"
    (rigs / "first.toml").rename(rigs / "third.toml")
    (rigs / "second.toml").rename(rigs / "first.toml")
    (rigs / "third.toml").rename(rigs / "second.toml")
    assert campaign(there, text).fingerprint != first.fingerprint


def test_campaign_that_was_killed_while_its_plan_was_written_goes_on(tmp_path: Path) -> None:
    whole = campaign(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    (out / f".{book.PLAN}.4711.part").write_text('{"schema": "rth')
    with book.Book(out, whole) as kept:
        assert kept.left == list(whole.cases)


def test_row_that_comes_twice_is_kept_once(tmp_path: Path) -> None:
    with book.Book(tmp_path / "out", campaign(tmp_path)) as kept:
        kept.add(made_up(1))
        kept.add(made_up(1, cause="again"))
    assert len((tmp_path / "out" / book.ROWS).read_text().splitlines()) == 1


# ---- processes that die -------------------------------------------------------------------------


def dies_at(case: PlannedRun, keep: str, folder: str, wanted: str) -> Row:
    """Carry out what `deadly` says: a run that kills its process once, or each time."""
    marks = Path(folder)
    if case.repeat == 1 and not (marks / f"{case.number}").exists():
        (marks / f"{case.number}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if case.repeat == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return case.identity() | {"ending": "completed", "cause": ""}


def deadly(repeats: list[int]) -> list[PlannedRun]:
    return [PlannedRun(n, {}, -1, repeat, "", "", ()) for n, repeat in enumerate(repeats)]


@pytest.mark.long
def test_process_that_dies_loses_no_run_and_doubles_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "carry_out", dies_at)
    rows: list[Row] = []
    pools.locally(deadly([0] * 9 + [1] + [0] * 20), 2, "nothing", str(tmp_path), rows.append)
    assert sorted(row["case"] for row in rows) == list(range(30))
    assert {row["ending"] for row in rows} == {"completed"}


def test_process_that_dies_while_the_next_run_is_handed_over_costs_no_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The pool learns of the death between two runs, and refuses the second one."""
    handed: list[int] = []

    class Dies(Executor):
        def submit(self, function: Any, case: PlannedRun, *_: Any) -> Future[Row]:  # type: ignore[override]
            handed.append(case.number)
            if len(handed) == 4:
                raise BrokenProcessPool
            future: Future[Row] = Future()
            future.set_result(case.identity() | {"ending": "completed", "cause": ""})
            return future

    monkeypatch.setattr(pools, "workers", lambda jobs: nullcontext(Dies()))
    rows: list[Row] = []
    pools.locally(deadly([0] * 6), 2, "nothing", "", rows.append)
    assert sorted(row["case"] for row in rows) == list(range(6))
    assert handed.count(3) == 2


@pytest.mark.long
def test_run_that_kills_each_process_is_told_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "carry_out", dies_at)
    rows: list[Row] = []
    pools.locally(deadly([0, 0, 2, 0, 0, 0]), 2, "nothing", str(tmp_path), rows.append)
    by_number = {row["case"]: row for row in rows}
    assert len(rows) == len(by_number) == 6
    assert by_number[2]["ending"] == plan.FAILED
    assert "terminated twice" in by_number[2]["cause"]
    assert all(row["ending"] == "completed" for n, row in by_number.items() if n != 2)


def test_processes_compute_with_one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with pools.single_threaded():
        assert {os.environ[name] for name in pools.ONE_THREAD} == {"1"}
    assert os.environ["OMP_NUM_THREADS"] == "7"


@pytest.mark.long
def test_campaign_ends_where_a_process_has_another_program_than_the_one_that_conducts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody has rebuilt the core in the middle of it: no row is made by the new one."""
    monkeypatch.setattr(pools, "program", lambda: "0.1 0123")
    rows: list[Row] = []
    with pytest.raises(
        InputError, match=r"the campaign was started with 0\.1 0123: install the same sources"
    ):
        pools.locally(campaign(tmp_path).cases, 1, "nothing", str(tmp_path), rows.append)
    assert rows == []


@pytest.mark.long
def test_cluster_whose_worker_is_killed_loses_no_run_and_doubles_none(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    whole = campaign(tmp_path, "noise_seeds = 20\n" + TWO_LAWS.replace("[3]", "[8]"))
    rows: list[Row] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:

        def done(row: Row) -> None:
            rows.append(row)
            if len(rows) == 5:
                with distributed.Client(cluster.scheduler_address) as client:
                    pid = next(iter(client.run(os.getpid).values()))
                os.kill(pid, signal.SIGKILL)

        pools.on_cluster(whole.cases, cluster.scheduler_address, "nothing", str(tmp_path), done)
    assert sorted(row["case"] for row in rows) == list(range(40))
    alone = one_run.carry_out(whole.cases[7])
    assert next(row for row in rows if row["case"] == 7) == alone


def test_scheduler_that_is_not_there_is_told() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        pools.on_cluster([], "tcp://127.0.0.1:9", "nothing", "", list[Row]().append)


# ---- tables and page ----------------------------------------------------------------------------

ROWS = [
    made_up(0, tracking_nrmse=0.01, response_nrmse=0.03, drawn=0),
    made_up(1, tracking_nrmse=0.05, response_nrmse=0.02, drawn=1),
    made_up(2, tracking_nrmse=0.02, response_nrmse=None, drawn=2),
    {"case": 3, "controller.type": "none", "ending": "stopped", "cause": "force", "drawn": 0},
]


def test_groups_tell_median_worst_and_how_many_ended_early() -> None:
    first, second = groups.group(ROWS, ["controller.type"])
    tracking = first.spreads["tracking_nrmse"]
    assert (tracking.median, tracking.worst, tracking.worst_case) == (0.02, 0.05, 1)
    assert first.spreads["response_nrmse"].median == 0.025
    assert groups.figure(tracking, plan.MEASURES[0]) == "2.00 (5.00)"
    assert groups.figure(None, plan.MEASURES[0]) == "–"
    assert (second.runs, second.stopped, second.spreads) == (1, 1, {})


def test_tables_hold_every_run_and_column(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    campaign_tables.write_csv(ROWS, tmp_path / "t.csv")
    with (tmp_path / "t.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [row["case"] for row in read] == ["0", "1", "2", "3"]
    assert float(read[1]["tracking_nrmse"]) == 0.05
    assert read[3]["tracking_nrmse"] == ""
    assert campaign_tables.write_parquet(ROWS, tmp_path / "t.parquet")
    table = parquet.read_table(tmp_path / "t.parquet")
    assert table.column_names == campaign_tables.columns(ROWS)
    assert table["tracking_nrmse"].to_pylist() == [0.01, 0.05, 0.02, None]


def test_page_leads_to_the_worst_run_and_says_why_one_ended_early(tmp_path: Path) -> None:
    rows = [ROWS[0], ROWS[1] | {"controller.type": "alpha-beta"}]
    rows[1] |= {"ending": "stopped", "cause": "force 15 kN (limit)", "folder": "runs/000001"}
    html = campaign_page.render(campaign(tmp_path), rows)
    assert "1 of 2 runs completed, 1 was ended by a limit or a trip." in html
    assert 'href="#run-1"' in html
    assert 'href="runs/000001/"' in html
    assert "force 15 kN (limit)" in html
    assert "rthyb run --set controller.type=alpha-beta --set test.duration_s=3" in html


@pytest.mark.long
def test_command_carries_out_the_example_and_tells_where_it_is_kept(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").write_text(TWO_LAWS)
    code = "import sys; from rthyb_rt import cli; sys.exit(cli.main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "campaign", "campaign.toml", "--jobs", "1", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    result = json.loads(done.stdout)
    assert len(result["rows"]) == result["runs"] == 2
    assert "2 of 2 runs completed" in done.stderr
    assert (tmp_path / result["paths"]["page"]).is_file()


@pytest.mark.long
def test_campaign_of_thousands_costs_in_proportion(tmp_path: Path) -> None:
    """The book and the tables, which grow with the campaign, against the same of a tenth."""

    def seconds(count: int) -> float:
        rows = [made_up(n, tracking_nrmse=1.0 / (n + 1), response_nrmse=0.1) for n in range(count)]
        whole = plan.Plan("x", "nothing", tuple(
            PlannedRun(n, {"controller.type": "paper"}, -1, 0, "", "", ()) for n in range(count)
        ), "f")  # fmt: skip
        began = time.process_time()
        with book.Book(tmp_path / str(count), whole) as kept:
            for row in rows:
                kept.add(row)
        campaign_tables.write_csv(rows, tmp_path / f"{count}.csv")
        groups.group(rows, ["controller.type"])
        return time.process_time() - began

    seconds(100)
    small, large = seconds(1000), seconds(10_000)
    assert large < 20 * small


EXAMPLES = sorted((Path(__file__).parents[1] / "examples" / "campaigns").glob("*.toml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_shipped_campaign_can_be_carried_out(path: Path) -> None:
    cases = campaigns.read(path).cases
    row = one_run.carry_out(cases[-1])
    assert row["ending"] == plan.COMPLETED
    keys = json.loads(json.dumps(config.json_schema("campaign")))["properties"]
    assert set(tomllib.loads(path.read_text())) <= set(keys)
