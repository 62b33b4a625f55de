"""The command line as a test engineer meets it: output, exit codes, files left behind."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import Answer, Rthyb

from rthyb_rt import cli, config, core
from rthyb_rt.cli import folders
from rthyb_rt.errors import RthybError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record import recording

SHORT = ("--no-report", "--set", "test.duration_s=3")

TEST = """schema = "rthyb-test/1"
rig = "delay-10-elastic"
[test]
name = "plate"
duration_s = 3
[ground_motion]
pga_g = 0.04
[numerical]
period_s = 0.5
damping_ratio = 0.02
"""


def shell(*arguments: str, folder: Path, **environment: str) -> Answer:
    """Run a command through the entry point, as a shell does."""
    program = Path(sys.executable).with_name("rthyb")
    done = subprocess.run(
        [str(program), *arguments],
        cwd=folder,
        env={**os.environ, "FORCE_COLOR": "", **environment},
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    return Answer(done.returncode, done.stdout, done.stderr)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of 3 s."""
    folder = tmp_path_factory.mktemp("recorded") / "plate"
    with contextlib.redirect_stdout(io.StringIO()):
        assert cli.main(["run", *SHORT, "--out", str(folder)]) == 0
    return folder


# ---- help ---------------------------------------------------------------------------------------


def test_help_names_every_command_and_the_exit_codes(rthyb: Rthyb) -> None:
    answer = rthyb("--help")
    assert answer.code == 0
    for word in ("run", "check", "replay", "export", "report", "schema", "Exit codes", "limit"):
        assert word in answer.out


def test_without_arguments_the_help_is_shown(rthyb: Rthyb) -> None:
    answer = rthyb()
    assert answer.code in (0, 2)
    assert "Getting started" in answer.out + answer.err


@pytest.mark.parametrize("command", ["run", "check", "replay", "export", "report", "schema"])
def test_help_of_each_command_has_an_example(rthyb: Rthyb, command: str) -> None:
    answer = rthyb(command, "--help")
    assert answer.code == 0
    assert f"  rthyb {command} " in answer.out


def test_help_loads_none_of_the_heavy_packages() -> None:
    program = (
        "import sys; from rthyb_rt.cli import main; main(['--help']);"
        "print('loaded:', *sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.rpartition("loaded:")[2].split())
    assert "typer" in loaded
    assert not loaded & {"numpy", "pydantic", "h5py", "matplotlib", "scipy", "rich", "jinja2"}


def test_version_names_program_core_and_compiler() -> None:
    answer = shell("--version", folder=Path())
    assert answer.code == 0
    assert re.fullmatch(r"rthyb \S+ \(core \S+, compiler .+, \w+\)\n", answer.out)


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("rnu",), "run"),
        (("run", "--jsno"), "--json"),
        (("chek", "plate.toml"), "check"),
        (("replay", "--jason", "x"), "--json"),
    ],
)
def test_mistyped_command_or_option_is_answered_with_the_right_one(
    rthyb: Rthyb, arguments: tuple[str, ...], meant: str
) -> None:
    answer = rthyb(*arguments)
    assert answer.code == 2
    assert answer.out == ""
    assert meant in answer.err.split("Error:")[1]


# ---- run ----------------------------------------------------------------------------------------


def test_run_without_arguments_leaves_recording_report_and_settings(tmp_path: Path) -> None:
    answer = shell("run", folder=tmp_path)
    assert answer.code == 0
    assert answer.err == ""
    (folder,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(r"section5-t0\.5-\d{8}T\d{6}Z", folder.name)
    files = {file.name for file in folder.iterdir()}
    assert files == {"recording.h5", "report.html", "test.toml", "rig.toml"}
    assert "\x1b" not in answer.out
    assert re.search(r"^Tracking, NRMSE +\d", answer.out, re.MULTILINE)
    assert re.search(r"^Response, NRMSE +\d", answer.out, re.MULTILINE)
    for file in ("recording.h5", "report.html"):
        assert f"{folder.relative_to(tmp_path)}/{file}" in answer.out
    assert recording.open_run(folder).meta["end_reason"] == "completed"


def test_saved_settings_run_again_to_the_same_recording(rthyb: Rthyb, tmp_path: Path) -> None:
    changes = ("--set", "rig.actuator.friction_n=120", "--set", "controller.type=robust")
    assert rthyb("run", *SHORT, *changes, "--out", "first").code == 0
    assert rthyb("run", "first/test.toml", "--no-report", "--out", "second").code == 0
    first, second = (recording.open_run(tmp_path / name) for name in ("first", "second"))
    assert first.samples.tobytes() == second.samples.tobytes()
    assert config.load_rig(tmp_path / "second" / "rig.toml").actuator.model_dump()[
        "friction_n"
    ] == (120.0)


def test_settings_of_test_and_rig_reach_the_recording(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "plate.toml").write_text(TEST)
    answer = rthyb(
        *("run", "plate.toml", "--no-report", "--rig", "delay-10-bouc-wen", "--out", "x"),
        *("--set", "controller.type=alpha-beta", "--set", "rig.actuator.delay_samples=7"),
    )
    assert answer.code == 0
    assert "plate on delay-10-bouc-wen" in answer.out
    rec = recording.open_run(tmp_path / "x")
    assert config.parse_test(rec.test_toml).controller.type == "alpha-beta"
    assert config.parse_rig(rec.rig_toml).actuator.model_dump()["delay_samples"] == 7


@pytest.mark.long
def test_json_is_alone_on_stdout_and_people_read_stderr(rthyb: Rthyb, tmp_path: Path) -> None:
    answer = rthyb("run", "--set", "test.duration_s=3", "--json")
    document = json.loads(answer.out)
    assert answer.code == 0
    assert document["schema"] == "rthyb-run/1"
    assert document["end_reason"] == "completed"
    assert 0.0 < document["measures"]["tracking_nrmse"] < 0.2
    assert document["measures"]["test_samples"] == 3 * 1024
    assert document["measures"]["samples"] > 3 * 1024
    assert "Tracking, NRMSE" in answer.err
    for path in document["paths"].values():
        assert (tmp_path / path).exists()


def test_json_has_null_where_a_measure_does_not_exist(rthyb: Rthyb) -> None:
    answer = rthyb(
        *("run", *SHORT, "--json", "--rig", "delay-10-elastic"),
        *("--set", "ground_motion.factor=0"),
    )
    assert answer.code == 0
    assert json.loads(answer.out)["measures"]["tracking_nrmse"] is None
    assert json.loads(answer.out)["paths"]["report"] is None


@pytest.mark.long
def test_limit_ends_the_test_with_code_6_and_the_files_are_there(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    answer = rthyb("run", "--set", "limits.force_n=1000", "--out", "x")
    assert answer.code == 6
    assert re.search(r"Result +tripped: force limit, after \d", answer.out)
    assert {file.name for file in (tmp_path / "x").iterdir()} >= {"recording.h5", "report.html"}


def test_run_without_the_report_packages_says_how_to_get_a_report(
    rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    answer = rthyb("run", "--set", "test.duration_s=3", "--out", "x")
    assert answer.code == 0
    assert "Tracking, NRMSE" in answer.out
    assert len(answer.err.splitlines()) == 1
    assert "pip install 'rthyb-rt[report]'" in answer.err
    assert "rthyb report x" in answer.err
    assert not (tmp_path / "x" / "report.html").exists()


def test_notes_of_the_configuration_are_told_before_the_run(rthyb: Rthyb) -> None:
    answer = rthyb("run", *SHORT, "--set", "numerical.integrator=forward-euler")
    assert answer.code == 0
    assert "rthyb: note: forward Euler" in answer.err


# ---- the folder of a run ------------------------------------------------------------------------


def test_folder_that_has_files_is_refused_before_the_test(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "notes.txt").write_text("mine")
    answer = rthyb("run", *SHORT, "--out", "x")
    assert answer.code == 2
    assert "x already exists" in answer.err
    assert [file.name for file in (tmp_path / "x").iterdir()] == ["notes.txt"]


def test_working_folder_is_not_replaced_by_a_run(rthyb: Rthyb, tmp_path: Path) -> None:
    assert rthyb("run", *SHORT, "--out", ".").code == 2
    assert list(tmp_path.iterdir()) == []


def test_empty_folder_is_filled(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    assert rthyb("run", *SHORT, "--out", "x").code == 0
    assert (tmp_path / "x" / "recording.h5").exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["x"]


def test_two_runs_of_one_second_get_two_folders(tmp_path: Path) -> None:
    target = tmp_path / "runs" / "plate-20260301T101500Z"
    places = []
    for number in range(3):
        with folders.staged(target) as stage:
            (stage / "recording.h5").write_text(str(number))
            places.append(folders.publish(stage, target, numbered=True))
    assert [place.name for place in places] == [target.name, f"{target.name}-2", f"{target.name}-3"]
    assert [(place / "recording.h5").read_text() for place in places] == ["0", "1", "2"]
    assert len(list(target.parent.iterdir())) == 3


def test_folder_that_cannot_be_written_is_one_message(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file in the way")
    answer = rthyb("run", *SHORT)
    assert answer.code == 1
    assert len(answer.err.splitlines()) == 1
    assert answer.err.startswith("rthyb: runs: cannot be written (")
    assert "--out" in answer.err
    assert (tmp_path / "runs").read_text() == "a file in the way"


def _disk_full(*arguments: object) -> None:
    raise RthybError("recording.h5: cannot be written (No space left on device)")


def _power_cut(*arguments: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("owner", "name", "fault", "code"),
    [
        (recording, "write", _disk_full, 1),
        (virtual_time, "run", _power_cut, 130),
        (recording, "write", _power_cut, 130),
    ],
)
def test_run_that_fails_on_the_way_leaves_nothing(
    rthyb: Rthyb,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    owner: object,
    name: str,
    fault: Callable[..., None],
    code: int,
) -> None:
    monkeypatch.setattr(owner, name, fault)
    assert rthyb("run", *SHORT).code == code
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "runs").mkdir()
    assert rthyb("run", *SHORT).code == code
    assert list(tmp_path.iterdir()) == [tmp_path / "runs"]
    assert list((tmp_path / "runs").iterdir()) == []


# ---- bad input ----------------------------------------------------------------------------------


def _record(rows: list[str]) -> str:
    return "# time s, acceleration m/s2\n" + "\n".join(rows) + "\n"


_GOOD_ROWS = [f"{0.01 * n:.2f} {0.5 * (-1) ** n:.2f}" for n in range(400)]

BAD_RECORDS = {
    "three_columns.txt": [*_GOOD_ROWS[:100], f"{_GOOD_ROWS[100]} 7", *_GOOD_ROWS[101:]],
    "one_column.txt": [*_GOOD_ROWS[:100], "1.00", *_GOOD_ROWS[101:]],
    "not_a_number.txt": [*_GOOD_ROWS[:100], "1.00 nan", *_GOOD_ROWS[101:]],
    "uneven_time.txt": [*_GOOD_ROWS[:100], "1.004 0.5", *_GOOD_ROWS[101:]],
    "above_5_g.txt": [*_GOOD_ROWS[:100], "1.00 60", *_GOOD_ROWS[101:]],
}


@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("three_columns.txt", ("102", "column")),
        ("one_column.txt", ("102", "column")),
        ("not_a_number.txt", ("102", "nan")),
        ("uneven_time.txt", ("1.004",)),
        ("above_5_g.txt", ("g", "5")),
    ],
)
def test_faulty_record_is_refused_with_its_file_and_row(
    rthyb: Rthyb, tmp_path: Path, command: str, file: str, words: tuple[str, ...]
) -> None:
    (tmp_path / file).write_text(_record(BAD_RECORDS[file]))
    (tmp_path / "plate.toml").write_text(TEST)
    answer = rthyb(
        *(command, "plate.toml", "--set", f"ground_motion.record={file}"),
        *("--set", "ground_motion.factor=1"),
    )
    assert answer.code == 3
    (line,) = answer.err.splitlines()
    assert line.startswith("rthyb: ")
    assert file in line
    for word in words:
        assert word in line
    assert answer.out == ""
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize(
    ("change", "place", "words"),
    [
        (("pga_g = 0.04", "pga_g = 6"), ":7: ground_motion.pga_g", ("6", "5 g")),
        (("pga_g = 0.04", 'record = "lost.txt"'), "lost.txt", ("no such file", "built in")),
        (("10-elastic", "10-elastc"), ":2: rig", ('found "delay-10-elastc"', "did you mean")),
        (('rig = "delay-10-elastic"', ""), ":1: rig", ("names no rig", "--rig RIG.toml")),
        (("period_s = 0.5", "mass_kg = -30"), ":9: numerical.mass_kg", ("-30", "kg")),
        (("period_s = 0.5", "perod_s = 0.5"), ":9: numerical.perod_s", ("did you mean",)),
        (("[num", "[controller]\nw1 = 0.5\n[num"), ":9: controller.w1", ("0.5", "|w1| > 1")),
        (("[num", "[controller]\nw2 = 4.5\n[num"), ":8: controller.w1", ("4.5", "|w1 + 1|")),
        (
            ("[num", "[controller.rfc]\nwindow_samples = 0\n[num"),
            ":9: controller.rfc.window_samples",
            ("0", "1"),
        ),
        (
            ("[num", "[controller.rfc]\nwindow_periods = 0.0002\n[num"),
            "controller.rfc.window_periods",
            ("T0 = 0", "from 1 to"),
        ),
    ],
)
def test_faulty_test_file_is_refused_with_place_value_and_remedy(
    rthyb: Rthyb,
    tmp_path: Path,
    command: str,
    change: tuple[str, str],
    place: str,
    words: tuple[str, ...],
) -> None:
    assert change[0] in TEST
    (tmp_path / "plate.toml").write_text(TEST.replace(change[0], change[1], 1))
    answer = rthyb(command, "plate.toml")
    assert answer.code == 3
    faults = [line for line in answer.err.splitlines() if place in line]
    assert len(faults) == 1
    assert faults[0].startswith("rthyb: ")
    for word in words:
        assert word in faults[0]
    assert answer.out == ""
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("command", ["run", "check"])
def test_rig_without_elastic_stiffness_is_refused_with_the_way_to_find_it(
    rthyb: Rthyb, tmp_path: Path, command: str
) -> None:
    (tmp_path / "plate.toml").write_text(TEST)
    rig = config.shipped_rig("delay-10-elastic").read_text()
    (tmp_path / "rig.toml").write_text(re.sub(r"elastic_stiffness.*\n", "", rig))
    answer = rthyb(command, "plate.toml", "--rig", "rig.toml")
    assert answer.code == 3
    (line,) = answer.err.splitlines()
    assert "rig.toml:" in line
    assert "rig.elastic_stiffness_n_per_m" in line
    assert "rthyb identify" in line
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("command", ["run", "check", "replay", "report"])
def test_missing_file_is_named(rthyb: Rthyb, command: str) -> None:
    answer = rthyb(command, "nowhere.toml")
    assert answer.code == 3
    (line,) = answer.err.splitlines()
    assert line.startswith("rthyb: nowhere.toml: ")


def test_faults_of_both_files_come_at_once_one_line_each(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "plate.toml").write_text(TEST.replace("0.02", "-1").replace("0.04", "9"))
    answer = rthyb(
        *("check", "plate.toml", "--rig", "delay-10-elastic", "--set", "controller.w1=0"),
        *("--set", "rig.actuator.delay_samples=-4"),
    )
    assert answer.code == 3
    lines = answer.err.splitlines()
    assert len(lines) == 4
    for place in ("ground_motion.pga_g", "damping_ratio", "controller.w1", "delay_samples"):
        assert sum(place in line for line in lines) == 1


@pytest.mark.parametrize(("rig", "of_rig"), [("rig.toml", 1), ("delay-10-elastic", 0), ("no", 0)])
def test_faults_of_the_rig_that_a_faulty_test_names_come_at_once(
    rthyb: Rthyb, tmp_path: Path, rig: str, of_rig: int
) -> None:
    shipped = config.shipped_rig("delay-10-elastic").read_text(encoding="utf-8")
    (tmp_path / "rig.toml").write_text(shipped.replace("delay_samples = 10", "delay_samples = -4"))
    named = re.sub(r"(?m)^rig = .*$", f'rig = "{rig}"', TEST.replace("0.02", "-1"))
    assert f'rig = "{rig}"' in named
    (tmp_path / "plate.toml").write_text(named)
    answer = rthyb("check", "plate.toml")
    assert answer.code == 3
    lines = answer.err.splitlines()
    assert "damping_ratio: found -1" in lines[0]
    assert len(lines) == 1 + of_rig
    assert ["delay_samples: found -4" in line for line in lines[1:]] == [True] * of_rig


def test_setting_without_a_value_is_refused(rthyb: Rthyb) -> None:
    answer = rthyb("run", "--set", "controller.w1")
    assert answer.code == 3
    assert "KEY=VALUE" in answer.err


# ---- check --------------------------------------------------------------------------------------


def example(name: str) -> Path:
    return config.builtin_test_path().with_name(name)


def test_check_shows_what_follows_from_the_test(rthyb: Rthyb, tmp_path: Path) -> None:
    answer = rthyb("check", example("section5-T0.5.toml"))
    assert answer.code == 0
    for words in ("0.500 s", "4220 kg", "2121 N s/m (2.00 %)", "51 samples", "3.26 samples"):
        assert words in answer.out
    assert "Warning" not in answer.out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("beta0", "first_sample", "nyquist"), [(144.5, 324.0, 1837.0), (0.0, 35.0, 103.0)]
)
def test_check_prints_the_gains_of_the_lead(
    rthyb: Rthyb, beta0: float, first_sample: float, nyquist: float
) -> None:
    answer = rthyb(
        "check", example("section5-T0.5.toml"), "--set", f"controller.beta0={beta0}", "--json"
    )
    figures = json.loads(answer.out)["figures"]
    assert figures["lead_first_sample_gain"] == pytest.approx(first_sample)
    assert figures["lead_nyquist_gain"] == pytest.approx(nyquist)
    assert re.search(rf"Lead, first sample +{first_sample:g}\b", answer.err)
    assert re.search(rf"Lead, Nyquist +{nyquist:g}\b", answer.err)


def test_check_in_json_is_alone_on_stdout(rthyb: Rthyb) -> None:
    answer = rthyb("check", example("section4.2.toml"), "--json")
    document = json.loads(answer.out)
    assert document["schema"] == "rthyb-check/1"
    assert document["ok"] is True
    assert document["figures"]["critical_delay_samples"] == pytest.approx(2.26, abs=0.01)
    assert abs(document["figures"]["critical_delay_followed_samples"] - 34) <= 1
    assert any("forward Euler" in note for note in document["notes"])


def test_check_in_json_lists_the_faults(rthyb: Rthyb) -> None:
    answer = rthyb("check", example("section4.2.toml"), "--set", "controller.w1=0", "--json")
    assert answer.code == 3
    document = json.loads(answer.out)
    assert document["ok"] is False
    assert [problem["where"] for problem in document["problems"]] == ["--set controller.w1"]
    assert len(answer.err.splitlines()) == 1


def check_gain(rthyb: Rthyb, gain: float, *more: str) -> dict[str, list[str]]:
    answer = rthyb(
        *("check", example("section4.2.toml"), "--json", *more),
        *("--set", f"controller.delay_estimator.gain_per_mm2_per_sample={gain}"),
    )
    assert answer.code == 0
    document = json.loads(answer.out)
    return {
        kind: [text for text in document[kind] if "loop gain" in text]
        for kind in ("notes", "warnings")
    }


def test_estimator_gain_is_judged_on_a_pure_delay(rthyb: Rthyb) -> None:
    assert check_gain(rthyb, 0.005) == {"notes": [], "warnings": []}
    close = check_gain(rthyb, 0.1)
    assert close["warnings"] == []
    assert "little margin" in close["notes"][0]
    beyond = check_gain(rthyb, 0.3)
    assert beyond["notes"] == []
    assert "will oscillate on a pure delay" in beyond["warnings"][0]


def test_estimator_gain_on_a_lag_gets_the_note_only(rthyb: Rthyb) -> None:
    found = check_gain(rthyb, 0.3, "--rig", "first-order-5hz")
    assert found["warnings"] == []
    assert "little margin" in found["notes"][0]


def test_advised_estimator_gain_is_accepted(rthyb: Rthyb) -> None:
    (text,) = check_gain(rthyb, 0.3)["warnings"]
    advised = re.search(r"to (\S+) or less", text)
    assert advised
    assert check_gain(rthyb, 0.99 * float(advised[1])) == {"notes": [], "warnings": []}


def test_other_estimators_have_no_loop_gain_to_judge(rthyb: Rthyb) -> None:
    answer = rthyb("check", example("section4.2.toml"), "--set", "controller.type=robust", "--json")
    assert json.loads(answer.out)["figures"]["estimator_loop_gain"] is None


def test_uncompensated_test_beyond_its_critical_delay_is_warned_of(rthyb: Rthyb) -> None:
    answer = rthyb("check", example("section4.2.toml"), "--set", "controller.type=none")
    assert answer.code == 0
    assert (
        "remains stable only up to a delay of 2.3 samples (2.2 ms), but the rig has a delay of 10 "
        "samples (9.77 ms): the motion will grow" in answer.out
    )
    assert "Lead, Nyquist" not in answer.out


def test_test_without_any_limit_is_warned_of(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "test.toml").write_text(TEST)
    warning = "Warning: nothing ends a test whose motion grows"
    assert warning in rthyb("check", "test.toml").out
    assert warning not in rthyb("check", "test.toml", "--set", "limits.force_n=20 kN").out
    off = ("--set", "limits.force_n={ value = 20000, enable = false }")
    assert warning in rthyb("check", "test.toml", *off).out


def test_damping_that_forgot_its_per_cent_is_warned_of(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "test.toml").write_text(TEST)
    meant = "Warning: the damping is 2 of critical; a structure has 0.01 to 0.1: 2 %"
    assert meant in rthyb("check", "test.toml", "--set", "numerical.damping_ratio=2").out
    assert "of critical; a" not in rthyb("check", "test.toml").out


@pytest.mark.parametrize("command", ["check", "run"])
def test_sensor_that_ends_before_the_expected_peak_is_noted(
    rthyb: Rthyb, tmp_path: Path, command: str
) -> None:
    (tmp_path / "test.toml").write_text(TEST)
    short = ("--set", "rig.sensors.displacement.range_m=2 mm", "--set", "test.duration_s=3")
    extra = ("--no-report",) if command == "run" else ()
    answer = rthyb(command, "test.toml", *short, *extra)
    found = "sensors.displacement.range_m = 2 mm is less than the peak of"
    assert found in (answer.out + answer.err)


@pytest.mark.parametrize("command", ["check", "run", "identify"])
def test_oil_column_that_cannot_be_computed_is_refused_before_anything_runs(
    rthyb: Rthyb, tmp_path: Path, command: str
) -> None:
    table = "shaking-table-portal-frame"
    (tmp_path / "test.toml").write_text(TEST.replace("delay-10-elastic", table))
    stiff = ("--set", "rig.actuator.oil_stiffness_n_per_m=1e12")
    answer = rthyb(command, table if command == "identify" else "test.toml", *stiff)
    assert answer.code == 3
    assert "rig.actuator.oil_stiffness_n_per_m: found 1e+12 N/m" in answer.err
    assert "at least substeps = 73" in answer.err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("command", ["check", "run"])
def test_setting_that_only_the_core_refuses_is_a_fault_of_the_files(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def refuse(config: object) -> None:
        raise core.CoreError("a limit must be finite and >= 0")

    (tmp_path / "test.toml").write_text(TEST)
    monkeypatch.setattr(core, "Controller", refuse)
    answer = rthyb(command, "test.toml")
    assert answer.code == 3
    assert 'test "plate" on rig "delay-10-elastic": a limit must be finite' in answer.err


def test_run_that_diverges_without_limits_is_not_reported_as_fine(rthyb: Rthyb) -> None:
    settings = ("controller.type=none", "rig=delay-10-elastic", "limits={}")
    answer = rthyb("run", "--no-report", *(word for s in settings for word in ("--set", s)))
    assert answer.code == 0
    for alarm in ("The motion diverged", "Response NRMSE", "The tracking error transferred"):
        assert f"Attention: {alarm}" in answer.out


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("force_n=1000", "force_n = 1 kN is below"),
        ("command_position_m=0.002", "command_position_m = 2 mm is below"),
        ("command_velocity_m_per_s=0.01", "command_velocity_m_per_s = 10 mm/s is below"),
    ],
)
def test_limit_below_the_expected_response_is_warned_of(
    rthyb: Rthyb, limit: str, words: str
) -> None:
    answer = rthyb("check", example("section5-T0.5.toml"), "--set", f"limits.{limit}")
    assert answer.code == 0
    assert f"Warning: limits.{words}" in answer.out


def test_record_that_ends_in_motion_is_noted_and_a_part_of_a_good_one_is_not(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    drifting = tmp_path / "drifting.txt"
    drifting.write_text("# time_s acc_g\n" + "".join(f"{0.01 * i:.2f} 0.1\n" for i in range(500)))
    test = example("section5-T0.5.toml")
    answer = rthyb("check", test, "--set", f"ground_motion.record={drifting}")
    assert "Note: ground motion: final velocity" in answer.out
    part = rthyb("check", test, "--set", "ground_motion.duration_s=3")
    assert "final velocity" not in part.out


# ---- replay, export, report, schema -------------------------------------------------------------


def test_replay_of_a_run_is_bit_identical(rthyb: Rthyb, recorded: Path) -> None:
    answer = rthyb("replay", recorded)
    assert answer.code == 0
    rows = recording.open_run(recorded).samples.size
    assert rows > 3 * 1024
    assert answer.out == f"bit-identical: {rows} samples, every field\n"


def _altered(
    recorded: Path, folder: Path, change: Callable[[recording.RecordedTest], None]
) -> Path:
    rec = recording.open_run(recorded)
    change(rec)
    recording.write(folder / "recording.h5", rec)
    return folder / "recording.h5"


def test_replay_finds_the_sample_that_was_changed(
    rthyb: Rthyb, recorded: Path, tmp_path: Path
) -> None:
    def nudge(rec: recording.RecordedTest) -> None:
        rec.samples["x_cmd_m"][1500] = np.nextafter(rec.samples["x_cmd_m"][1500], 1.0)

    path = _altered(recorded, tmp_path, nudge)
    answer = rthyb("replay", path)
    assert answer.code == 8
    rows = recording.open_run(recorded).samples.size
    assert answer.out.startswith(f"differs from sample 1500 of {rows} on, field x_cmd_m;")
    document = json.loads(rthyb("replay", path, "--json").out)
    assert document["identical"] is False
    assert document["first_row"] == 1500
    assert set(document["largest"]) == {"x_cmd_m"}


def test_replay_names_the_build_that_recorded(rthyb: Rthyb, recorded: Path, tmp_path: Path) -> None:
    path = _altered(recorded, tmp_path, lambda rec: rec.meta.update(compiler="cc 1.0"))
    answer = rthyb("replay", path)
    assert answer.code == 0
    assert "another build" in answer.out
    assert "cc 1.0" in answer.out


def test_export_writes_beside_the_recording(rthyb: Rthyb, recorded: Path) -> None:
    answer = rthyb("export", recorded, "--csv")
    assert answer.code == 0
    assert answer.out == f"{recorded / 'recording.csv'}\n"
    lines = (recorded / "recording.csv").read_text().splitlines()
    assert lines[0] == "t,ag,x_num,x_cmd,x_meas,f_meas"
    assert len(lines) == 3 * 1024 + 1


def test_export_of_every_field_to_a_named_file(
    rthyb: Rthyb, recorded: Path, tmp_path: Path
) -> None:
    answer = rthyb("export", recorded / "recording.h5", "--csv", "--full", "--out", "all.csv")
    assert answer.code == 0
    assert "k_t_n_per_m" in (tmp_path / "all.csv").read_text().splitlines()[0]


def test_export_to_matlab(rthyb: Rthyb, recorded: Path, tmp_path: Path) -> None:
    assert rthyb("export", recorded, "--mat", "--out", "x.mat").code == 0
    assert (tmp_path / "x.mat").read_bytes().startswith(b"MATLAB 5.0")


@pytest.mark.parametrize("choice", [(), ("--mat", "--csv"), ("--mat", "--full")])
def test_export_asks_for_one_format(rthyb: Rthyb, recorded: Path, choice: tuple[str, ...]) -> None:
    answer = rthyb("export", recorded, *choice)
    assert answer.code == 2
    assert "--" in answer.err.split("Error:")[1]


def test_recording_that_one_may_only_read_asks_where_its_report_goes(
    rthyb: Rthyb, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as those of the service, for its group."""

    def may(path: str | Path, mode: int) -> bool:
        return mode != os.W_OK or Path(path) != recorded

    monkeypatch.setattr(os, "access", may)
    answer = rthyb("report", recorded)
    assert answer.code == 1
    assert "is not writable; choose another path, such as --out" in answer.err


@pytest.mark.long
def test_report_is_written_for_an_older_recording(
    rthyb: Rthyb, recorded: Path, tmp_path: Path
) -> None:
    answer = rthyb("report", recorded, "--out", "again.html")
    assert answer.code == 0
    assert answer.out == "again.html\n"
    assert "<svg" in (tmp_path / "again.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", [("replay",), ("report",), ("export", "--csv")])
def test_file_that_is_no_recording_is_refused(
    rthyb: Rthyb, tmp_path: Path, command: tuple[str, ...]
) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["numbers"] = np.arange(4)
    answer = rthyb(*command, "other.h5")
    assert answer.code == 3
    (line,) = answer.err.splitlines()
    assert "not a recording" in line
    assert [file.name for file in tmp_path.iterdir()] == ["other.h5"]


@pytest.mark.parametrize(("kind", "table"), [("test", "numerical"), ("rig", "specimen")])
def test_schema_describes_the_tables_of_the_file(rthyb: Rthyb, kind: str, table: str) -> None:
    answer = rthyb("schema", kind)
    assert answer.code == 0
    assert table in json.loads(answer.out)["properties"]


# ---- whatever happens ---------------------------------------------------------------------------


def test_fault_of_the_program_is_told_in_words(
    rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(experiment, "prepare", broken)
    answer = rthyb("run")
    assert answer.code == 1
    assert "internal error: ZeroDivisionError: division by zero" in answer.err
    assert "RTHYB_TRACEBACK=1" in answer.err
    monkeypatch.setenv("RTHYB_TRACEBACK", "1")
    assert "Traceback (most recent call last)" in rthyb("run").err


def test_fault_of_the_program_is_told_to_machines(
    rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(experiment, "prepare", broken)
    answer = rthyb("run", "--json")
    assert answer.code == 1
    document = json.loads(answer.out)
    assert document["schema"] == "rthyb-problems/1"
    assert document["ok"] is False
    (problem,) = document["problems"]
    assert "ZeroDivisionError: division by zero" in problem["message"]


@pytest.mark.parametrize(
    ("command", "where"),
    [
        (("run", "--clock", "host"), "--clock"),
        (("run", "--clock", "sundial"), "--clock"),
        (("jog", "delay-10-elastic", "2 kN"), "DISTANCE"),
        (("check",), "TEST.toml"),
        (("run", "--no-such-option"), ""),
    ],
)
def test_word_that_the_command_line_does_not_take_is_named_to_machines(
    rthyb: Rthyb, command: tuple[str, ...], where: str
) -> None:
    answer = rthyb(*command, "--json")
    assert answer.code == 2
    (problem,) = json.loads(answer.out)["problems"]
    assert problem["where"] == where


@pytest.mark.long
def test_reader_that_leaves_early_is_no_error(tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("rthyb")
    with subprocess.Popen(
        [str(program), "schema", "test"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        assert process.stderr.read() == b""


@pytest.mark.long
@pytest.mark.parametrize(
    ("redirection", "code", "words"), [(">&-", 0, ""), (">/dev/full", 1, "No space left")]
)
def test_output_that_goes_nowhere_does_not_lose_the_run(
    tmp_path: Path, redirection: str, code: int, words: str
) -> None:
    program = Path(sys.executable).with_name("rthyb")
    command = f"{program} run {' '.join(SHORT)} --out x {redirection}"
    done = subprocess.run(
        command, shell=True, cwd=tmp_path, stderr=subprocess.PIPE, text=True, check=False
    )
    assert done.returncode == code
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == code
    assert recording.open_run(tmp_path / "x").meta["end_reason"] == "completed"


@pytest.mark.long
def test_terminal_without_greek_letters_shows_the_result_all_the_same(tmp_path: Path) -> None:
    answer = shell("run", *SHORT, folder=tmp_path, PYTHONIOENCODING="ascii")
    assert answer.code == 0
    assert "Tracking, NRMSE" in answer.out


def on_a_terminal(folder: Path, **environment: str) -> str:
    """Return all that a run writes to a terminal of 100 columns."""
    outer, inner = pty.openpty()
    program = Path(sys.executable).with_name("rthyb")
    settings = {"TERM": "xterm-256color", "COLUMNS": "100", **environment}
    clean = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")}
    with subprocess.Popen(
        [str(program), "run", *SHORT], cwd=folder, env=clean | settings, stdout=inner, stderr=inner
    ):
        os.close(inner)
        text = b""
        # A terminal whose other side has closed reads as an error, not as an end.
        with contextlib.suppress(OSError):
            while block := os.read(outer, 65536):
                text += block
    os.close(outer)
    return text.decode()


@pytest.mark.long
def test_terminal_shows_progress_with_rate_and_time_left(tmp_path: Path) -> None:
    text = on_a_terminal(tmp_path)
    assert re.search(r"Testing .* 3 of 3 s .*x real time.*\d:\d\d:\d\d", text)
    assert "\x1b[1m" in text


@pytest.mark.long
def test_no_color_is_honoured_on_a_terminal(tmp_path: Path) -> None:
    text = on_a_terminal(tmp_path, NO_COLOR="1")
    assert "Tracking, NRMSE" in text
    assert not re.search(r"\x1b\[[0-9;]*m", text)
