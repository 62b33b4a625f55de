"""Tests on several axes from Python: run, read, and what is of one axis alone."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from test_axes_realtime import AXES, LIMITED, SHORT

import rthyb_rt as rt
from rthyb_rt.analysis import several_axes
from rthyb_rt.errors import InputError


@pytest.fixture(scope="module")
def rig() -> rt.Rig:
    return rt.Rig.from_toml(LIMITED)


@pytest.fixture(scope="module")
def rec(rig: rt.Rig) -> rt.Recording:
    return rt.run(rt.Test.from_toml(SHORT), rig)


def test_a_test_on_two_axes_runs_and_tells_of_each(rec: rt.Recording) -> None:
    assert rec.completed
    assert rec.ending == "completed"
    assert rec.axis_names == AXES
    assert set(rec.measures["axes"]) == set(AXES)
    assert set(rec.measures["directions"]) == {"ground-floor", "first-floor"}
    assert rec.verdict == several_axes.verdict(several_axes.summarize(rec.raw))
    assert any(label.startswith("Axis right") for label, _, _ in rec.table)
    assert "axes left, right" in repr(rec)
    for name in AXES:
        peak = float(np.abs(rec.axis(name)["x_meas_m"][rec.running]).max())
        assert rec.measures["axes"][name]["peak_measured_m"] == pytest.approx(peak)


@pytest.mark.long
def test_what_was_kept_is_opened_as_it_was(rig: rt.Rig, rec: rt.Recording, tmp_path: Path) -> None:
    again = rt.open(rec.save(tmp_path / "recording.h5"))
    assert again.measures == rec.measures
    assert again.rig == rec.rig
    assert again.rig["axis.1.name"] == "right"
    rec.report(tmp_path / "report.html")
    assert (tmp_path / "report.html").stat().st_size > 10_000


def test_the_signals_of_one_axis_are_exported_with_its_rig_beside_them(
    rec: rt.Recording, tmp_path: Path
) -> None:
    path = rec.export(tmp_path / "right.csv", axis="right")
    assert path.read_text().splitlines()[0] == "t,ag,x_num,x_cmd,x_meas,f_meas"
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    assert rows[:, 4].tobytes() == rec.axis("right")["x_meas_m"][rec.running].tobytes()
    assert [one.name for one in tmp_path.glob("*.toml")] == ["right.rig.toml"]


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda rec, path: rec.export(path),
         'choose it (axis="left"), or write all fields (whole=True)'),
        (lambda rec, path: rec.export(path, axis="left", whole=True), "export: axis: found"),
        (lambda rec, path: rec.export(path, axis="up"), 'no axis "up"; axes are: left'),
        (lambda rec, path: rec.axis("lefft"), 'no axis "lefft" (did you mean "left"?); axes are'),
        (lambda rec, path: rec.measures["tracking_nrmse"],
         'no measure "tracking_nrmse"; measures are: axes, directions'),
        (lambda rec, path: rec.measures["tracking_nrmse"], 'are in measures["axes"]["left"]'),
    ],
)  # fmt: skip
def test_what_one_axis_has_is_told_where_it_is_of_several(
    rec: rt.Recording, tmp_path: Path, call: Callable[[rt.Recording, Path], object], told: str
) -> None:
    with pytest.raises(InputError) as caught:
        call(rec, tmp_path / "all.csv")
    assert told in str(caught.value)
    assert "--" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_rig_of_several_axes_is_changed_by_the_name_of_its_axis(rig: rt.Rig) -> None:
    assert repr(rig) == "<Rig two-storeys: axes left, right>"
    changed = rig.with_({"axis.right.actuator.delay_samples": 4})
    assert changed["axis.1.actuator.delay_samples"] == 4.0
    assert rig["axis.1.actuator.delay_samples"] == 9.0
    assert rt.Rig("two-axis-frame").name == "two-axis-frame"
    with pytest.raises(InputError, match="delay_samples"):
        rig.with_({"axis.right.actuator.delay_samples": -1})


def test_a_limit_that_ends_it_is_told_with_its_axis(rig: rt.Rig) -> None:
    tight = rig.with_({"axis.left.limits.force_n": "1 kN"})
    rec = rt.run(rt.Test.from_toml(SHORT), tight)
    assert not rec.completed
    assert rec.ending.endswith(" of axis left")
    assert rec.verdict.startswith("The test did not complete: ")


def test_a_check_of_several_axes_is_that_of_the_command_line(
    rig: rt.Rig, rthyb: Rthyb, tmp_path: Path
) -> None:
    found = rt.check(rt.Test.from_toml(SHORT), rig)
    (tmp_path / "test.toml").write_text(SHORT, encoding="utf-8")
    told = rthyb(
        "check", tmp_path / "test.toml", "--rig", rig.save(tmp_path / "rig.toml"), "--json"
    )
    assert told.code == 0, told.err
    assert json.loads(json.dumps(found.document)) == told.json
    assert list(found.figures["axes"]) == list(AXES)
    assert found.figures["directions"]["first-floor"]["reference_peak"] > 0.0
    assert any(label == "Axis right" for label, _, _ in found.table)
    assert found.warnings == []
    assert repr(found) == "<Check two on two-storeys: no errors, 0 warnings, 1 notes>"
    assert "Axis right" in found._repr_html_()


def test_a_check_names_the_limits_that_the_reference_exceeds(
    rig: rt.Rig, rthyb: Rthyb, tmp_path: Path
) -> None:
    test = rt.Test.from_toml(SHORT)
    peaks = rt.check(test, rig).figures
    below_n = 0.5 * peaks["axes"]["left"]["reference_peak_n"]
    below_m = 0.5 * peaks["directions"]["first-floor"]["reference_peak"]
    tight = rig.with_({"axis.left.limits.force_n": below_n})
    low = test.with_({"interface.0.limits.position_m": below_m})
    warned = rt.check(low, tight).warnings
    assert [text.partition(" = ")[0] for text in warned] == [
        "axis left: force_n",
        "direction first-floor: position_m",
    ]
    said = rthyb(
        "check", low.save(tmp_path / "test.toml"), "--rig", tight.save(tmp_path / "rig.toml")
    )
    assert all(f"Warning: {text}" in said.out for text in warned)


def test_an_identification_of_several_axes_is_that_of_the_command_line(
    rig: rt.Rig, rthyb: Rthyb, tmp_path: Path
) -> None:
    found = rt.identify(rig, amplitude="0.5 mm", max_frequency="4 Hz")
    assert isinstance(found, rt.AxesIdentification)
    path = rig.save(tmp_path / "rig.toml")
    told = rthyb(
        "identify", path, "--amplitude", "0.5 mm", "--max-frequency", "4 Hz", "--json",
        "--out", tmp_path / "identified.toml",
    )  # fmt: skip
    assert told.code == 0, told.err
    same = {key: told.json[key] for key in ("axes", "response", "stiffness", "asymmetry")}
    assert json.loads(json.dumps(found.measures)) == same
    assert found.rig == rt.Rig(tmp_path / "identified.toml")
    assert found.axis_names == AXES
    assert found.frequency_hz[-1] == 4.0
    assert found.response.shape == (found.frequency_hz.size, 2, 2)
    # The rows and columns are those of the rig file: a specimen's stiffness is its own.
    wanted = np.array(rig["specimen.stiffness"])
    assert np.abs(found.stiffness - wanted).max() < 0.02 * np.abs(wanted).max()
    assert repr(found).startswith("<AxesIdentification two-storeys: delays left ")


@pytest.mark.long
def test_a_sweep_over_an_axis_has_the_figures_of_the_runs(rig: rt.Rig, tmp_path: Path) -> None:
    key = "rig.axis.right.actuator.delay_samples"
    test = rt.Test.from_toml(SHORT, rig).with_({"test.duration_s": 1, "controller.type": "none"})
    found = rt.sweep(test, {key: [2, 9]}, out=tmp_path / "sweep", jobs=1, keep="all")
    assert [row["ending"] for row in found.rows] == ["completed"] * 2
    for row in found.rows:
        alone = rt.run(test.with_({key: row[key]})).measures
        for kind, name, figure in (
            ("axes", "right", "tracking_nrmse"),
            ("axes", "left", "peak_force_n"),
            ("directions", "first-floor", "response_nrmse"),
        ):
            assert row[f"{kind}.{name}.{figure}"] == alone[kind][name][figure]
    slow, fast = (row["axes.right.tracking_nrmse"] for row in found.rows[::-1])
    assert slow > 2.0 * fast
    (first, _) = found.statistics("axes.right.tracking_nrmse")
    assert first["axes.right.tracking_nrmse_worst"] == fast
    assert found.recording(0).axis_names == AXES
    page = found.paths["page"].read_text(encoding="utf-8")
    assert "first-floor: response error" in page
    # What every campaign shows of a group is told of each direction.
    assert "directions.ground-floor.tracking_nrmse_median" in found.statistics()[0]


@pytest.mark.long
def test_a_sweep_says_which_axis_ended_a_run_and_what_no_axis_has(
    rig: rt.Rig, tmp_path: Path
) -> None:
    test = rt.Test.from_toml(SHORT, rig).with_({"test.duration_s": 1})
    found = rt.sweep(
        test, {"rig.axis.left.limits.force_n": [200, 60e3]}, out=tmp_path / "limit", jobs=1
    )
    (stopped,) = found.stopped
    assert stopped["cause"].endswith("of axis left")
    with pytest.raises(InputError, match="middle"):
        rt.sweep(test, {"rig.axis.middle.actuator.delay_samples": [2]}, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.long
def test_plants_are_drawn_about_the_values_of_a_named_axis(rig: rt.Rig, tmp_path: Path) -> None:
    test = rt.Test.from_toml(SHORT, rig).with_({"test.duration_s": 0.5})
    key = "rig.axis.left.actuator.natural_frequency_hz"
    draws = {"count": 2, "seed": 1, "spread": {key: 0.1}}
    found = rt.sweep(test, draws=draws, out=tmp_path / "drawn", jobs=1, keep="all")
    drawn = [found.recording(n).rig["axis.0.actuator.natural_frequency_hz"] for n in range(3)]
    assert drawn[0] == 20.0
    assert len(set(drawn)) == 3
    assert all(abs(frequency - 20.0) < 10.0 for frequency in drawn)


def test_one_axis_in_a_list_is_told_where_its_tables_belong(rig: rt.Rig) -> None:
    with pytest.raises(InputError, match="at least 2 are needed; a rig with one axis has no list"):
        rt.Rig(rig={"name": "one"}, axis=[rig["axis"][0]])


def test_what_is_of_one_axis_says_so(rig: rt.Rig, rec: rt.Recording, tmp_path: Path) -> None:
    for call in (
        lambda: rec.summary,
        rec.plot.tracking,
        lambda: rec.export(tmp_path / "one.csv"),
    ):
        with pytest.raises(InputError, match=r"axes \(?left, right"):
            call()


def test_figure_of_several_axes_is_told_with_where_it_is(rec: rt.Recording) -> None:
    with pytest.raises(rt.InputError) as caught:
        rec.plot.displacement()
    assert str(caught.value).startswith("plot.displacement: the test ran on several axes (")
    assert "report(path) or report_files(folder); balance() alone" in str(caught.value)


def test_remedy_of_an_identification_is_in_words_of_python() -> None:
    with pytest.raises(
        rt.InputError, match="identify with a smaller amplitude, or up to"
    ) as caught:
        rt.identify("two-axis-frame", max_frequency=2)
    assert "--" not in str(caught.value)


def test_without_matplotlib_the_balance_of_several_axes_says_what_to_install(
    rec: rt.Recording,
) -> None:
    """In a process of its own, where nothing has imported matplotlib before."""
    code = (
        "import sys; sys.modules['matplotlib'] = None; import rthyb_rt as rt; "
        "rec = rt.open(sys.argv[1])\n"
        "try:\n    rec.plot.balance()\n"
        "except rt.InputError as error:\n    print(error)\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = rec.save(Path(folder) / "recording.h5")
        told = subprocess.run(
            [sys.executable, "-c", code, str(path)], check=True, capture_output=True, text=True
        )
    assert told.stdout.startswith("a figure needs matplotlib; install it with pip install")
