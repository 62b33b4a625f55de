"""One axis of a recording of several, exported and diagnosed by itself."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from test_axes_realtime import AXES, EITHER, LIMITED, SHORT
from test_axes_realtime import rig as pair_of

from rthyb_rt import config
from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.errors import InputError
from rthyb_rt.lab import several, virtual_time
from rthyb_rt.record import axis_export, export, recording
from rthyb_rt.record.recording import Recording

STIFFNESS = np.array([[8e6, -1e6], [-1e6, 6e6]])
BACK = np.linalg.inv([[1.0, 0.0], [1.0, 1.0]])
RUBBING = LIMITED.replace(
    "stiffness = [[8e6, -1e6], [-1e6, 6e6]]\n",
    "stiffness = [[8e6, -1e6], [-1e6, 6e6]]\n"
    '[[specimen.element]]\nalong = "ground-floor"\n'
    'law = { element = "coulomb", fc_n = 800, width_m_per_s = 1e-3 }\n',
)
LONG = SHORT.replace("duration_s = 3", "duration_s = 12").replace("pga_g = 0.05", "pga_g = 0.2")


def run(text: str = LIMITED, test: str = SHORT) -> Recording:
    return virtual_time.run(several.prepare(config.parse_test(test, "test.toml"), pair_of(text)))


@pytest.fixture(scope="module")
def rec() -> Recording:
    return run()


@EITHER
def test_force_of_an_axis_is_that_of_its_own_motion(rec: Recording, axis: str) -> None:
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
def test_other_signals_of_an_axis_are_as_recorded(rec: Recording, axis: str) -> None:
    found, rows = axis_export.axis_signals(rec, axis), rec.running()
    assert list(found) == ["t", *export.INTERCHANGE]
    np.testing.assert_array_equal(found["x_meas"], rec.axis(axis)["x_meas_m"][rows])
    np.testing.assert_array_equal(found["x_cmd"], rec.axis(axis)["x_cmd_m"][rows])
    asked = np.column_stack([rec.samples["x_num_m"], rec.samples["x_num_m_1"]])[rows]
    wanted = asked @ np.linalg.inv(BACK)[AXES.index(axis)]
    np.testing.assert_allclose(found["x_num"], wanted, rtol=1e-12, atol=1e-15)


def test_a_file_without_an_axis_is_refused_with_their_names(rec: Recording, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the axes left, right.*--axis left.*--full"):
        export.to_csv(rec, tmp_path / "no.csv")
    assert not (tmp_path / "no.csv").exists()
    export.to_csv(rec, tmp_path / "full.csv", full=True)
    with (tmp_path / "full.csv").open() as file:
        assert "x_meas_m.1" in next(csv.reader(file))
    with pytest.raises(InputError, match="no axis 'middle'; the recording has left, right"):
        axis_export.axis_signals(rec, "middle")


def test_rthyb_export_writes_an_axis_and_its_rig(
    rthyb: Rthyb, rec: Recording, tmp_path: Path
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


def test_a_recording_of_several_axes_is_no_case_of_a_diagnosis_as_it_stands(
    rthyb: Rthyb, rec: Recording, tmp_path: Path
) -> None:
    recording.write(tmp_path / "recording.h5", rec)
    done = rthyb("diagnose", tmp_path / "recording.h5", "--model", "delay-10-elastic")
    assert done.code == 3
    told = done.err.replace("\n", " ")
    assert "several axes (left, right)" in told
    assert "--csv --axis left" in told


@pytest.mark.parametrize(("axis", "named"), [("left", "coulomb"), ("right", "none")])
def test_friction_that_the_model_lacks_is_found_at_the_axis_that_feels_it(
    rthyb: Rthyb, tmp_path: Path, axis: str, named: str
) -> None:
    """Dry friction of 800 N along the ground floor, where the left axis is, and nobody else."""
    rec = run(RUBBING, LONG)
    axis_export.to_csv(rec, tmp_path / "case.csv", axis)
    done = rthyb("diagnose", tmp_path / "case.csv", "--model", tmp_path / "case.rig.toml", "--json")
    if named == "none":
        assert done.code == 0, done.err
        assert done.json["effects"] == []
        return
    assert done.code == 8, done.err
    # The tare was taken while the friction held something: an offset of less than a newton.
    assert set(done.json["effects"]) <= {named, "bias"}
    told = re.search(r"coulomb Fc +(\S+) N ", done.err)
    assert told is not None
    assert float(told[1]) == pytest.approx(800.0, rel=0.01)
