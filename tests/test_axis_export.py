"""Axes of a recording of several, each exported and diagnosed by itself."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from test_axes_realtime import AXES, EITHER, LIMITED, SHORT
from test_axes_realtime import rig as pair_of

import rthyb_rt as rt
from rthyb_rt import config
from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.diagnose import reading
from rthyb_rt.diagnose.axes import OfAxis
from rthyb_rt.diagnose.case import tare_rows
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, virtual_time
from rthyb_rt.record import axis_export, mat_csv, recording
from rthyb_rt.record.recording import RecordedTest

STIFFNESS = np.array([[8e6, -1e6], [-1e6, 6e6]])
BACK = np.linalg.inv([[1.0, 0.0], [1.0, 1.0]])
RUBBING = LIMITED.replace(
    "stiffness = [[8e6, -1e6], [-1e6, 6e6]]\n",
    "stiffness = [[8e6, -1e6], [-1e6, 6e6]]\n"
    '[[specimen.element]]\nalong = "ground-floor"\n'
    'law = { element = "coulomb", fc_n = 800, width_m_per_s = 1e-3 }\n',
)
LONG = SHORT.replace("duration_s = 3", "duration_s = 12").replace("pga_g = 0.05", "pga_g = 0.2")


def run(text: str = LIMITED, test: str = SHORT) -> RecordedTest:
    return virtual_time.run(
        axes_experiment.prepare(config.parse_test(test, "test.toml"), pair_of(text))
    )


@pytest.fixture(scope="module")
def rec() -> RecordedTest:
    return run()


@EITHER
def test_force_of_an_axis_is_that_of_its_own_motion(rec: RecordedTest, axis: str) -> None:
    """The specimen is elastic: what is left of the load cell is k x of that axis, and noise."""
    k = AXES.index(axis)
    found = axis_export.axis_signals(rec, axis)
    own = BACK.T @ STIFFNESS @ BACK
    left = found["f_meas"] - own[k, k] * found["x_meas"]
    # The displacement sensor's noise of 2 um, through the stiffness of both.
    assert left.std() < 2.0 * 2e-6 * np.abs(own[k]).sum() + 40.0
    coupled = rec.axis(axis)["f_meas_n"][rec.running()] - own[k, k] * found["x_meas"]
    assert coupled.std() > 5.0 * left.std()


@EITHER
def test_other_signals_of_an_axis_are_as_recorded(rec: RecordedTest, axis: str) -> None:
    found, rows = axis_export.axis_signals(rec, axis), rec.running()
    assert list(found) == ["t", *mat_csv.INTERCHANGE]
    np.testing.assert_array_equal(found["x_meas"], rec.axis(axis)["x_meas_m"][rows])
    np.testing.assert_array_equal(found["x_cmd"], rec.axis(axis)["x_cmd_m"][rows])
    asked = np.column_stack([rec.samples["x_num_m"], rec.samples["x_num_m_1"]])[rows]
    wanted = asked @ np.linalg.inv(BACK)[AXES.index(axis)]
    np.testing.assert_allclose(found["x_num"], wanted, rtol=1e-12, atol=1e-15)


def test_a_file_without_an_axis_is_refused_with_their_names(
    rec: RecordedTest, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"the axes left, right.*--axis left.*--full"):
        mat_csv.to_csv(rec, tmp_path / "no.csv")
    assert not (tmp_path / "no.csv").exists()
    mat_csv.to_csv(rec, tmp_path / "full.csv", full=True)
    with (tmp_path / "full.csv").open() as file:
        assert "x_meas_m.1" in next(csv.reader(file))
    with pytest.raises(InputError, match='no axis "middle"; axes are: left, right'):
        axis_export.axis_signals(rec, "middle")


def test_rthyb_export_writes_an_axis_and_its_rig(
    rthyb: Rthyb, rec: RecordedTest, tmp_path: Path
) -> None:
    recording.write(tmp_path / "recording.h5", rec)
    done = rthyb("export", tmp_path / "recording.h5", "--csv", "--axis", "right")
    assert done.code == 0, done.err
    table, model = map(Path, done.out.split())
    assert (table.name, model.name) == ("recording-right.csv", "recording-right.rig.toml")
    given = config.load_rig(model)
    assert isinstance(given, RigFile)
    rig = pair_of()
    assert isinstance(rig, AxesRig)
    assert given.rig.elastic_stiffness_n_per_m == pytest.approx(rig.along_axes()[1][1])
    for words in (("--mat",), ("--csv", "--full")):
        assert rthyb("export", tmp_path / "recording.h5", *words, "--axis", "right").code == 2


def test_what_the_others_bring_is_that_of_the_matrices_and_elements() -> None:
    """Two sines through K, C and M of the specimen and a dashpot between them, in closed form."""
    damping, mass = [[4e4, -1e4], [-1e4, 2e4]], [[300.0, 50.0], [50.0, 200.0]]
    text = LIMITED.replace(
        "stiffness = [[8e6, -1e6], [-1e6, 6e6]]\n",
        f"stiffness = [[8e6, -1e6], [-1e6, 6e6]]\ndamping = {damping}\nmass = {mass}\n"
        '[[specimen.element]]\nalong = "first-floor"\n'
        'law = { element = "viscous", c_n_s_per_m = 3e4 }\n',
    )
    t = np.arange(2048) / 1024.0
    w = 2.0 * np.pi * np.array([3.0, 5.0])
    x = np.sin(np.outer(t, w)) * [2e-3, 1e-3]
    v, a = w * np.cos(np.outer(t, w)) * [2e-3, 1e-3], -(w**2) * x
    inner = slice(8, -8)
    for k, axis in enumerate(AXES):
        along = [BACK.T @ np.array(rows) @ BACK for rows in (STIFFNESS, damping, mass)]
        parts = zip(along, (x, v, a), strict=True)
        wanted = np.sum([motion[:, 1 - k] * rows[k, 1 - k] for rows, motion in parts], axis=0)
        wanted = wanted + BACK[1, k] * 3e4 * (v @ BACK[1])
        found = axis_export.from_others(pair_of(text), k, x, 1.0 / 1024.0)
        assert np.abs(found - wanted)[inner].max() < 0.005 * np.abs(wanted).max()
        own = axis_export.alone(pair_of(text), axis).specimen
        sizes = [next(iter(one.model_dump(exclude={"element"}).values())) for one in own]
        assert sizes == pytest.approx([rows[k, k] for rows in along])


# ---- diagnosis -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a test in which dry friction of 800 N acts along the ground floor, where the
    left axis is, and nowhere else; and the rig file that knows nothing of it."""
    folder = tmp_path_factory.mktemp("rubbing")
    recording.write(folder / "recording.h5", run(RUBBING, LONG))
    (folder / "rig.toml").write_text(LIMITED, encoding="utf-8")
    return folder


@pytest.mark.long
def test_the_axis_that_feels_a_friction_is_told_it_and_the_other_one_nothing(
    rthyb: Rthyb, rubbing: Path, tmp_path: Path
) -> None:
    done = rthyb(
        "diagnose", rubbing, "--model", rubbing / "rig.toml", "--report", tmp_path, "--json"
    )
    assert done.code == 8, done.err
    assert done.json["schema"] == "rthyb-diagnose-axes/1"
    answers = dict(done.json["axes"])  # type: ignore[call-overload]
    assert list(answers) == list(AXES)
    assert answers["right"]["verdict"] == "none"
    # The tare was taken while the friction held something: an offset of less than a newton.
    assert set(answers["left"]["effects"]) <= {"coulomb", "bias"}
    left_words, right_words = done.err.split("Axis right\n")
    assert "Axis left\n" in left_words
    told = re.search(r"coulomb Fc +(\S+) N ", left_words)
    assert told is not None
    assert float(told[1]) == pytest.approx(800.0, rel=0.01)
    assert right_words.startswith("Nothing is missing")

    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for name in AXES:
        assert page.count(f'id="axis-{name}"') == 1
        assert f'id="figure-{name}-' in page
        own = config.load_rig(tmp_path / f"augmented-{name}.toml")
        k_n_per_m = pair_of().along_axes()[AXES.index(name)][AXES.index(name)]
        assert own.rig.elastic_stiffness_n_per_m == pytest.approx(k_n_per_m, rel=0.01)
    ids = re.findall(r'<figure id="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    numbers = [int(n) for n in re.findall(r"<b>Figure (\d+)\.", page)]
    assert numbers == list(range(1, len(ids) + 1))
    kept = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert {name: one["verdict"] for name, one in kept["axes"].items()} == {
        name: one["verdict"] for name, one in answers.items()
    }


@pytest.mark.long
def test_one_axis_alone_has_the_answer_of_one_axis(rthyb: Rthyb, rubbing: Path) -> None:
    model = rubbing / "rig.toml"
    done = rthyb("diagnose", rubbing, "--model", model, "--axis", "right", "--json")
    assert done.code == 0, done.err
    assert done.json["schema"] == "rthyb-diagnose/1"
    assert done.json["effects"] == []
    found = rt.diagnose(rubbing / "recording.h5", rt.Rig(model), axis="right")
    assert found.verdict == "none"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--axis", "middle"), 3, "found middle; the recording has the axes left, right"),
        (("--predict", "x.csv", "--out", "y.csv"), 2, "choose it with --axis left"),
        (("--model", "delay-10-elastic"), 3, "is a model of one axis, but the recording has"),
        (("--model", "two-axis-frame"), 3, "was recorded on the axes left, right, but the model"),
    ],
)
def test_what_does_not_go_with_several_axes_is_refused(
    rthyb: Rthyb, rubbing: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    model = () if "--model" in words else ("--model", rubbing / "rig.toml")
    done = rthyb("diagnose", rubbing, *model, *words)
    assert done.code == code
    # A refusal of an option is drawn in a box.
    assert said in " ".join(done.err.replace("│", " ").split())


def test_an_axis_is_asked_for_in_python_and_refused_of_one(rubbing: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match='axis="left"; it has left, right'):
        rt.diagnose(rubbing / "recording.h5", rubbing / "rig.toml")
    (tmp_path / "lab.csv").write_text("t,x_cmd,x_meas\n0,0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match="found left, but the recording has only one axis"):
        rt.diagnose(tmp_path / "lab.csv", "delay-10-elastic", axis="left")


def test_the_error_of_a_zero_counts_the_sensors_of_the_other_axes(
    rec: RecordedTest, tmp_path: Path
) -> None:
    """Only the left displacement sensor has noise, 2 um: the right axis' force has it by K."""
    recording.write(tmp_path / "recording.h5", rec)
    of = OfAxis("right", pair_of())
    case = reading.read_case(tmp_path / "recording.h5", of.model, of=of)
    ticks = tare_rows(rec).size
    assert ticks > 100
    coupling = (BACK.T @ STIFFNESS @ BACK)[1, 0]
    assert case.tare_error_n == pytest.approx(abs(coupling) * 2e-6 / np.sqrt(ticks), rel=0.2)
    assert case.axis == "right"


@pytest.mark.long
def test_friction_that_the_model_lacks_is_found_in_the_export_of_its_axis(
    rthyb: Rthyb, rubbing: Path, tmp_path: Path
) -> None:
    axis_export.to_csv(recording.open_run(rubbing), tmp_path / "case.csv", "left")
    model = tmp_path / "case.rig.toml"
    done = rthyb("diagnose", tmp_path / "case.csv", "--model", model, "--json")
    assert done.code == 8, done.err
    assert set(done.json["effects"]) <= {"coulomb", "bias"}
    told = re.search(r"coulomb Fc +(\S+) N ", done.err)
    assert told is not None
    assert float(told[1]) == pytest.approx(800.0, rel=0.01)
