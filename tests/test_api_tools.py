"""Identification, diagnosis, replay, comparison and sweeps from Python."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import config
from rthyb_rt.api.diagnosing import diagnose
from rthyb_rt.rig import identification

SHORT = {"ground_motion": {"duration_s": "2 s"}, "test": {"free_vibration_s": 0}}
LAWS = {"controller.type": ["paper", "robust"]}


@pytest.fixture(scope="module")
def short() -> rt.Test:
    return rt.Test("section5-T0.5", **SHORT)


@pytest.fixture(scope="module")
def rec(short: rt.Test) -> rt.Recording:
    return rt.run(short)


# ---- identification, replay, diagnosis ----------------------------------------------------------


@pytest.mark.long
def test_identification_is_that_of_the_command_line_and_fills_the_rig() -> None:
    found = rt.identify("delay-10-elastic", amplitude="1 mm", max_frequency=5.0)
    rig = config.load_rig(config.shipped_rig("delay-10-elastic"))
    wanted = identification.identify(rig, identification.SweepPlan.up_to(5.0, 1e-3))
    assert found.measures["alpha"] == wanted.alpha
    assert [tone["frequency_hz"] for tone in found.tones] == [
        tone.frequency_hz for tone in wanted.tones
    ]
    assert found.rig["identified.alpha"] == pytest.approx(wanted.alpha, rel=1e-3)
    assert repr(found).startswith("<Identification delay-10-elastic: delay 9.7")
    assert (
        rt.check("section5-T0.5", found.rig).figures["identified_delay_samples"]
        == (found.rig["identified.alpha"])
    )


def test_recording_replays_bit_for_bit_and_a_changed_one_does_not(rec: rt.Recording) -> None:
    assert rt.replay(rec).identical
    samples = rec.raw.samples.copy()
    row = int(np.flatnonzero(rec.running)[100])
    samples["x_cmd_m"][row] += 1e-9
    found = rt.replay(rt.Recording(type(rec.raw)(**{**vars(rec.raw), "samples": samples})))
    assert not found.identical
    assert (found.first_row, found.field) == (row, "x_cmd_m")


@pytest.mark.long
def test_diagnosis_names_the_friction_that_a_rig_has_and_its_model_has_not(tmp_path: Path) -> None:
    model = rt.Rig("delay-10-elastic")
    real = model.with_({"specimen": [*model["specimen"], {"element": "coulomb", "fc_n": "400 N"}]})
    rec = rt.run(rt.Test("section5-T0.5", rig=real).with_(limits={"force_n": "60 kN"}))
    told: list[str] = []
    found = rt.diagnose(rec, model, progress=told.append)
    assert found.verdict == "explained"
    assert found.effects == ["coulomb"]
    assert told[-1] == "verdict"
    assert "coulomb" in repr(found)
    assert found.text in found._repr_html_().replace("&gt;", ">").replace("&lt;", "<")
    json.dumps(found.answer)
    paths = found.report(tmp_path / "report")
    assert sorted(path.name for path in paths) == [
        "augmented.toml", "diagnosis.json", "report.html",
    ]  # fmt: skip
    # The same from a file of any lab, by its columns.
    csv = rec.export(tmp_path / "lab.csv")
    again = rt.diagnose(csv, model.save(tmp_path / "model.toml"))
    assert again.effects == found.effects


@pytest.mark.long
@pytest.mark.parametrize("hidden", [True, False])
def test_a_recording_of_another_control_law_is_diagnosed_as_one_of_ours(hidden: bool) -> None:
    model = rt.Rig("delay-10-elastic")
    friction = {"element": "coulomb", "fc_n": "400 N"}
    real = model.with_({"specimen": [*model["specimen"], friction]}) if hidden else model
    test = rt.Test("section5-T0.5", rig=real).with_({"controller.type": "ats"})
    rec = rt.run(test.with_(limits={"force_n": "60 kN"}))
    assert np.ptp(rec["alpha"][rec.running]) > 0.01  # it adapts
    found = rt.diagnose(rec, model)
    assert found.verdict == ("explained" if hidden else "none")
    assert found.effects == (["coulomb"] if hidden else [])


@pytest.mark.long
def test_the_room_of_the_diagnosis_is_the_public_function_however_it_was_imported() -> None:
    code = (
        "import rthyb_rt as rt; first = rt.diagnose; import rthyb_rt.diagnose.policy; "
        "from rthyb_rt.diagnose import engine; assert rt.diagnose is first and callable(first)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(rt.InputError, match=r'^diagnose: model: found "nowhere"'):
        rt.diagnose("no.csv", "nowhere")
    assert callable(diagnose)


# ---- comparison ---------------------------------------------------------------------------------


def test_two_recordings_differ_by_what_numpy_says(short: rt.Test, rec: rt.Recording) -> None:
    other = rt.run(short.with_(controller={"rfc": {"enabled": False}}))
    found = rt.compare(rec, other)
    a, b = rec["x_meas_m"][rec.running], other["x_meas_m"][other.running]
    row = found.rows[1]
    assert row["x_difference_m"] == np.abs(b - a).max() > 0.0
    assert row["x_difference_nrmse"] == pytest.approx(np.linalg.norm(b - a) / np.linalg.norm(a))
    assert found.rows[0]["x_difference_nrmse"] == found.rows[0]["f_difference_n"] == 0.0
    assert row["tracking_nrmse"] == other.measures["tracking_nrmse"]
    assert found.labels == ["section5-t0.5", "section5-t0.5 (2)"]
    assert list(found.to_pandas().index) == found.labels
    assert "<svg" in found._repr_html_()
    assert "\n" not in repr(found)


def test_longer_recording_is_compared_as_far_as_both_go(short: rt.Test, rec: rt.Recording) -> None:
    longer = rt.run(short.with_(test={"free_vibration_s": 1}))
    assert len(longer["t_s"]) > len(rec["t_s"])
    assert rt.compare(rec, longer).rows[1]["x_difference_m"] == 0.0


def test_recordings_of_two_rates_are_compared_at_the_lower_one(
    short: rt.Test, rec: rt.Recording
) -> None:
    found = rt.compare(rec, rt.run(short.with_({"test.sample_rate_hz": 2048})))
    assert found.rows[1]["x_difference_nrmse"] < 0.05
    assert any("2048 Hz; compared at 1024 Hz" in note for note in found.notes)
    with pytest.raises(rt.InputError, match=r"compare: found 0 recordings; give 2 to 10"):
        rt.compare()


# ---- sweeps -------------------------------------------------------------------------------------


@pytest.mark.long
def test_sweep_has_a_row_for_every_combination_and_seed(short: rt.Test, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    found = rt.sweep(
        short, LAWS | {"rig.actuator.kp_per_s": np.array([60.0, 80.0])}, repeat_seeds=2,
        out=tmp_path / "laws", jobs=1, progress=lambda done, whole: told.append((done, whole)),
    )  # fmt: skip
    assert len(found) == 8
    assert told[-1] == (8, 8)
    assert found.failed == found.stopped == []
    assert {(r["controller.type"], r["rig.actuator.kp_per_s"]) for r in found.rows} == {
        (law, gain) for law in LAWS["controller.type"] for gain in (60.0, 80.0)
    }
    row = found.rows[3]
    again = rt.run(
        short.with_({key: row[key] for key in ("controller.type", "rig.actuator.kp_per_s")}
                    | {"rig.seed": row["repeat"] + 1})
    )  # fmt: skip
    assert row["response_nrmse"] == again.measures["response_nrmse"]
    table = found.to_pandas()
    assert list(table.index) == list(range(8))
    assert (tmp_path / "laws" / "index.html").is_file()


@pytest.mark.long
def test_statistics_are_over_the_seeds_of_each_combination(short: rt.Test, tmp_path: Path) -> None:
    found = rt.sweep(short, LAWS, repeat_seeds=3, out=tmp_path / "laws", jobs=1)
    for one in found.statistics("tracking_nrmse"):
        values = [
            row["tracking_nrmse"] for row in found.rows
            if row["controller.type"] == one["controller.type"]
        ]  # fmt: skip
        assert one["runs"] == one["completed"] == len(values) == 3
        assert len(set(values)) == 3
        assert one["tracking_nrmse_median"] == np.median(values)
        assert one["tracking_nrmse_worst"] == max(values)
    assert "3" in found._repr_html_()
    with pytest.raises(rt.InputError, match=r'did you mean "tracking_nrmse"'):
        found.statistics("tracking")


@pytest.mark.long
def test_run_that_fails_or_trips_is_named_and_ends_no_other(short: rt.Test, tmp_path: Path) -> None:
    found = rt.sweep(
        short, {"controller.w1": [3, 1], "limits.force_n": ["15 kN", "1 kN"]},
        out=tmp_path / "some", jobs=1,
    )  # fmt: skip
    assert [row["case"] for row in found.failed] == [2, 3]
    assert "w1" in found.failed[0]["cause"]
    assert [row["case"] for row in found.stopped] == [1]
    assert "limit 1 kN" in found.stopped[0]["cause"]
    assert repr(found) == ("<Sweep section5-t0.5-sweep: 4 runs, 1 completed, 1 stopped, 2 failed>")
    # What tripped is kept, and says the same.
    assert not found.recording(1).completed
    with pytest.raises(rt.InputError, match=r'run 0 was not kept; those kept are: 1; .*keep="all"'):
        found.recording(0)


@pytest.mark.long
def test_rigs_are_swept_by_name_and_as_objects(short: rt.Test, tmp_path: Path) -> None:
    rigs = [rt.Rig("delay-10-elastic").with_(actuator={"delay_samples": n}) for n in (5, 6)]
    free = short.with_({"limits.force_n": None})
    found = rt.sweep(
        free, {"rig": [*rigs, "first-order-5hz"]}, out=tmp_path / "rigs", jobs=1, keep="all"
    )
    assert not found.failed
    assert found.recording(0).rig["actuator.delay_samples"] == 5
    assert found.recording(1).rig["actuator.delay_samples"] == 6
    assert found.recording(2).rig["rig.name"] == "first-order-5hz"


@pytest.mark.long
def test_lists_go_together_and_plants_are_drawn(short: rt.Test, tmp_path: Path) -> None:
    found = rt.sweep(
        short, together=[{"controller.w1": [3, 4], "controller.w2": [2, 2.5]}],
        draws={"count": 2, "seed": 1, "spread": {"rig.actuator.kp_per_s": 0.05}},
        out=tmp_path / "drawn", jobs=1,
    )  # fmt: skip
    assert [(r["controller.w1"], r["controller.w2"], r["drawn"]) for r in found.rows] == [
        (w1, w2, n) for w1, w2 in ((3, 2), (4, 2.5)) for n in range(3)
    ]
    assert len({row["tracking_nrmse"] for row in found.rows}) == 6


@pytest.mark.long
def test_sweep_goes_on_where_it_was_and_is_not_mixed_with_another(
    short: rt.Test, tmp_path: Path
) -> None:
    class Enough(Exception):
        pass

    def stop(done: int, whole: int) -> None:
        if done == 1:
            raise Enough

    out = tmp_path / "laws"
    with pytest.raises(Enough):
        rt.sweep(short, LAWS, repeat_seeds=2, out=out, jobs=1, progress=stop)
    out = out.rename(tmp_path / "moved")
    told: list[int] = []
    found = rt.sweep(
        short, LAWS, repeat_seeds=2, out=out, jobs=1, progress=lambda done, _: told.append(done)
    )
    assert told[0] == 1
    assert [row["case"] for row in found.rows] == [0, 1, 2, 3]
    with pytest.raises(rt.InputError, match=r"another test or rig or with other values.* with out"):
        rt.sweep(short, {"controller.w1": [3, 4]}, out=out, jobs=1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    with pytest.raises(rt.InputError, match=r"not empty and does not hold a sweep"):
        rt.sweep(short, LAWS, out=tmp_path / "mine", jobs=1)


LAWS_BY_A_SCRIPT = """
import json, sys, rthyb_rt as rt
print('top')
short = rt.Test('section5-T0.5', ground_motion={'duration_s': 1})
found = rt.sweep(short, {'controller.type': ['paper', 'robust']}, repeat_seeds=2, keep='all',
                 out=sys.argv[1], jobs=2)
print(json.dumps(found.rows))
"""
"""Without a guard by its name, as engineers write them."""


def members(session: int) -> list[int]:
    """Return the processes of a session that are alive; a zombie is not."""
    alive = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, _, of = place.read_text().rpartition(")")[2].split()[:4]
            if int(of) == session and state != "Z":
                alive.append(int(place.parent.name))
    return alive


def lines(folder: Path) -> list[dict[str, Any]]:
    path = folder / "rows.jsonl"
    text = path.read_text() if path.exists() else ""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def kill(script: Path, folder: str, whom: str, further: int, after_s: float) -> None:
    """Start the script and kill part of it once it has done some runs, unless it has ended."""
    before, patience = len(lines(script.parent / folder)), time.monotonic() + 300.0
    begun = subprocess.Popen(
        [sys.executable, script, folder], cwd=script.parent, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    while begun.poll() is None and len(lines(script.parent / folder)) < before + further:
        assert time.monotonic() < patience
        time.sleep(0.01)
    time.sleep(after_s)
    if whom == "a process that computes":
        for pid in members(begun.pid):
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
                break
        time.sleep(after_s)
    if begun.poll() is None:
        (os.killpg if whom == "all" else os.kill)(begun.pid, signal.SIGKILL)
    begun.wait()
    while members(begun.pid):  # those that compute end as well
        assert time.monotonic() < patience
        time.sleep(0.01)


def swept(folder: Path) -> list[dict[str, Any]]:
    """Let the script sweep into ``out`` of a folder, or go on there; return its rows."""
    (folder / "laws.py").write_text(LAWS_BY_A_SCRIPT)
    done = subprocess.run(
        [sys.executable, "laws.py", "out"], cwd=folder, check=True, capture_output=True, text=True
    )
    # Its processes have not run it from its top.
    top, told = done.stdout.splitlines()
    assert top == "top"
    rows: list[dict[str, Any]] = json.loads(told)
    assert [row["case"] for row in rows] == list(range(4))
    assert sorted(row["case"] for row in lines(folder / "out")) == list(range(4))
    return rows


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """The folder of a sweep by the script that nobody killed, and its rows."""
    folder = tmp_path_factory.mktemp("undisturbed")
    return folder / "out", swept(folder)


def never_lost_or_doubled(
    folder: Path,
    undisturbed: tuple[Path, list[dict[str, Any]]],
    kills: list[tuple[str, int, float]],
) -> None:
    script = folder / "laws.py"
    script.write_text(LAWS_BY_A_SCRIPT)
    for whom, further, after_s in kills:
        kill(script, "out", whom, further, after_s)
    rows = swept(folder)
    whole, expected = undisturbed
    assert rows == expected
    for row in rows:
        at = Path(row["folder"]) / "recording.h5"
        kept, wanted = rt.open(folder / "out" / at), rt.open(whole / at)
        assert kept["x_meas_m"].tobytes() == wanted["x_meas_m"].tobytes()
        assert not list((folder / "out" / row["folder"]).glob(".*"))


@pytest.mark.long
def test_script_that_is_killed_at_any_moment_goes_on_without_a_lost_or_doubled_run(
    tmp_path: Path, undisturbed: tuple[Path, list[dict[str, Any]]]
) -> None:
    kills = [("all", 0, 0.6), ("the script", 1, 0.0), ("a process that computes", 1, 0.2)]
    never_lost_or_doubled(tmp_path, undisturbed, kills)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_script_that_is_killed_again_and_again_loses_and_doubles_no_run(
    tmp_path: Path, undisturbed: tuple[Path, list[dict[str, Any]]], seed: int
) -> None:
    drawn = random.Random(seed)
    whom = ("all", "the script", "a process that computes")
    kills = [
        (drawn.choice(whom), drawn.choice((0, 0, 0, 1)), drawn.uniform(0.0, 2.0)) for _ in range(6)
    ]
    never_lost_or_doubled(tmp_path, undisturbed, kills)


@pytest.mark.long
def test_sweep_is_computed_by_a_dask_client(short: rt.Test, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    here = rt.sweep(short, LAWS, out=tmp_path / "here", jobs=1)
    with distributed.Client(
        processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None
    ) as client:
        there = rt.sweep(short, LAWS, out=tmp_path / "there", client=client)
        assert client.status == "running"
    assert there.rows == here.rows


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda t, out: rt.sweep(t, {"controller.typ": ["x"]}, out=out),
         'sweep: over.controller.typ: unknown key (did you mean "type"?)'),
        (lambda t, out: rt.sweep(t, {"controller.type": []}, out=out),
         "sweep: over.controller.type: found an empty list; give at least one value"),
        (lambda t, out: rt.sweep(t, {"controller.w1": [{}]}, out=out),
         "sweep: over.controller.w1: found a table; each value must be a string"),
        (lambda t, out: rt.sweep(t, ["controller.w1"], out=out), "sweep: over: found a list"),
        (lambda t, out: rt.sweep(t, {"test": [t.rig]}, out=out), "a test with the key test"),
        (lambda t, out: rt.sweep(t, LAWS, repeat_seeds=0, out=out),
         "sweep: repeat_seeds: found 0"),
        (lambda t, out: rt.sweep(t, LAWS, keep="al", out=out),
         'sweep: keep: found "al" (did you mean "all"?)'),
        (lambda t, out: rt.sweep(t, LAWS, name="My Sweep", out=out),
         'sweep: name: found "My Sweep"'),
        (lambda t, out: rt.identify(t.rig, amplitude="3 kg"),
         'identify: amplitude: found "3 kg" (that is a mass)'),
    ],
)  # fmt: skip
def test_wrong_use_is_told_and_nothing_is_written(
    short: rt.Test, tmp_path: Path, wrong: Callable[[rt.Test, Path], object], told: str
) -> None:
    with pytest.raises(rt.InputError) as raised:
        wrong(short, tmp_path / "out")
    assert told in str(raised.value)
    assert "--" not in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def test_a_rig_file_without_stiffness_can_be_identified_which_is_what_finds_it(
    tmp_path: Path,
) -> None:
    path = tmp_path / "new.toml"
    path.write_text(
        'schema = "rthyb-rig/1"\nrig = { name = "new" }\n'
        'actuator = { kind = "pure-delay", delay_samples = 12 }\n'
        '[[specimen]]\nelement = "stiffness"\nk_n_per_m = 6.7e5\n'
    )
    found = rt.identify(path, max_frequency=2)
    assert found.rig["rig.elastic_stiffness_n_per_m"] == pytest.approx(6.7e5, rel=1e-3)
    with pytest.raises(rt.InputError, match="elastic_stiffness_n_per_m: missing"):
        rt.Rig(path)


def test_a_sweep_with_a_velocity_of_its_own() -> None:
    found = rt.identify("delay-10-elastic", max_frequency="8 Hz", max_velocity="200 mm/s")
    assert found.tones[-1]["amplitude_m"] == pytest.approx(2e-3)
    slow = rt.identify("delay-10-elastic", max_frequency=8.0, max_velocity=0.02)
    assert slow.tones[-1]["amplitude_m"] == pytest.approx(0.02 / (2.0 * np.pi * 8.0))
    assert any("no sine is faster than 20 mm/s" in note for note in slow.notes)
    with pytest.raises(rt.InputError, match="the largest velocity of a sine"):
        rt.identify("delay-10-elastic", max_velocity="20 m/s")


def test_the_name_of_a_shipped_test_is_a_model(rec: rt.Recording) -> None:
    by_name, by_test = rt.diagnose(rec, "section5-T0.5"), rt.diagnose(rec, rt.Test("section5-T0.5"))
    assert by_name.verdict == by_test.verdict == "none"
    assert by_name.effects == by_test.effects
