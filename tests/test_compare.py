"""Recordings beside one another: other lengths, rates, units and origins, and the page of it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import cli
from rthyb_rt.comparing import comparison_page, courses, overlay
from rthyb_rt.comparing.courses import Course

FS_HZ = 1024.0


@pytest.fixture(scope="module")
def short() -> rt.Test:
    return rt.Test("section5-T0.5", ground_motion={"duration_s": 3})


@pytest.fixture(scope="module")
def kept(short: rt.Test, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept") / "monday"
    rt.run(short, out=folder, report=False)
    return folder


def course(label: str, x: np.ndarray, fs_hz: float = FS_HZ) -> Course:
    return Course(label, "recording", fs_hz, np.asarray(x, np.float64), None)


def sine(seconds: float, fs_hz: float, late_s: float = 0.0) -> np.ndarray:
    t = np.arange(round(seconds * fs_hz)) / fs_hz - late_s
    return 0.01 * np.sin(2 * np.pi * 2.0 * t) * np.exp(-(((t - 2.0) / 0.8) ** 2))


def lab_table(path: Path, rec: rt.Recording, late_s: float = 0.0) -> Path:
    """Write a recording as another lab would: mm and kN, time of its own, half the rate."""
    rows = np.flatnonzero(rec.running)[::2]
    t = rec["t_s"][rows] + late_s
    lines = ["Time [ms];LVDT 1 [mm];Load cell [kN]"]
    for time, x, f in zip(t, rec["x_meas_m"][rows], rec["f_meas_n"][rows], strict=True):
        lines.append(f"{1e3 * float(time)!r};{1e3 * float(x)!r};{1e-3 * float(f)!r}")
    path.write_text("\n".join(lines) + "\n")
    return path


# ---- at other instants --------------------------------------------------------------------------


def test_value_between_samples_is_that_of_the_sine_they_were_taken_of() -> None:
    y = np.sin(2 * np.pi * np.arange(200) / 20.0)
    at_s = np.arange(0.0, 9.9, 0.0037) / 1.0
    found = overlay.at(y, 20.0, at_s)
    wanted = np.sin(2 * np.pi * at_s)
    assert np.abs(found - wanted)[30:-30].max() < 3e-4
    # A straight line and a cubic are met exactly.
    place = np.linspace(0.0, 199.0, 777)
    cubic = 1e-4 * (np.arange(200.0) - 80.0) ** 3
    assert overlay.at(cubic, 1.0, place) == pytest.approx(1e-4 * (place - 80.0) ** 3, abs=1e-9)


def test_sample_is_taken_as_it_is_and_beyond_the_ends_there_is_none() -> None:
    y = np.array([1.0, np.nan, 3.0, 4.0, 5.0])
    assert np.array_equal(overlay.at(y, 2.0, np.array([0.0, 1.0, 2.0])), [1.0, 3.0, 5.0])
    found = overlay.at(y, 2.0, np.array([-0.25, 1.75, 2.25]))
    assert np.isnan(found[[0, 2]]).all()
    assert overlay.at(y[2:4], 1.0, np.array([0.5])) == pytest.approx([3.5])


@pytest.mark.parametrize("late_s", [0.0, 0.0123, -0.0207])
def test_lag_is_found_to_a_hundredth_of_a_sample(late_s: float) -> None:
    found = overlay.lag(sine(5, FS_HZ), sine(5, FS_HZ, late_s), FS_HZ)
    assert found == pytest.approx(late_s, abs=0.01 / FS_HZ)


def test_lag_of_what_does_not_move_is_no_number() -> None:
    assert np.isnan(overlay.lag(np.zeros(9), np.ones(9), 1.0))
    assert overlay.lag(np.full(9, 1e300), np.full(9, 1e300), 1.0) == 0.0


# ---- lengths and rates --------------------------------------------------------------------------


def test_other_rate_and_length_are_taken_together_and_said() -> None:
    found = overlay.Overlay.of([course("a", sine(4, 1024)), course("b", sine(5, 1536), 1536.0)])
    assert found.fs_hz == 1024.0
    assert found.shared == 4096
    assert found.rows[1]["x_difference_nrmse"] < 1e-6
    assert found.rows[1]["lag_s"] == pytest.approx(0.0, abs=1e-6)
    assert found.notes == (
        "b has 1536 Hz; compared at 1024 Hz, the rate of the slowest",
        "b lasts 5 s; compared over the 4 s that they have in common",
        "a contains no force",
        "b contains no force",
    )


def test_moved_over_the_first_what_came_late_differs_no_more() -> None:
    pair = [course("a", sine(5, FS_HZ)), course("b", sine(5, FS_HZ, 0.05))]
    apart, over = overlay.Overlay.of(pair), overlay.Overlay.of(pair, align=True)
    assert apart.rows[1]["x_difference_nrmse"] > 0.5
    assert over.rows[1]["x_difference_nrmse"] < 1e-3
    assert over.rows[1]["lag_s"] == apart.rows[1]["lag_s"]
    assert apart.rows[1]["lag_samples"] == pytest.approx(0.05 * FS_HZ, abs=0.01)
    heads, rows = comparison_page.table(apart)
    assert heads[2] == "b"
    lags = [(name, second) for name, _, second in rows if name.startswith("Lag")]
    assert [name for name, _ in lags] == ["Lag, ms", "Lag, samples"]
    assert [float(value) for _, value in lags] == pytest.approx([50.0, 51.2], abs=0.1)
    assert over.notes[-1] == "b was shifted by -50.00 ms to match the first"


def test_differences_are_those_of_the_closed_form() -> None:
    t = np.arange(2048) / FS_HZ
    a, b = np.sin(2 * np.pi * 4 * t), 1.1 * np.sin(2 * np.pi * 4 * t)
    row = overlay.Overlay.of([course("a", a), course("b", b)]).rows[1]
    assert row["x_difference_nrmse"] == pytest.approx(0.1)
    assert row["x_difference_m"] == pytest.approx(0.1)


def test_courses_that_share_nothing_or_are_too_many_are_refused() -> None:
    one = course("a", sine(1, FS_HZ))
    with pytest.raises(rt.InputError, match="found 1 recording; give 2 to 10"):
        overlay.Overlay.of([one])
    with pytest.raises(rt.InputError, match="found 11 recordings"):
        overlay.Overlay.of([one] * 11)
    with pytest.raises(rt.InputError, match="no time in common"):
        overlay.Overlay.of([one, course("b", np.zeros(0))])


# ---- what is compared ---------------------------------------------------------------------------


def test_recording_alone_is_held_against_its_reference_as_its_own_report_says(kept: Path) -> None:
    found = rt.compare(kept)
    assert found.labels == ["monday, reference simulation", "monday"]
    wanted = rt.open(kept).measures
    assert found.rows[1]["x_difference_nrmse"] == pytest.approx(wanted["response_nrmse"])
    assert found.rows[1]["x_difference_m"] == pytest.approx(wanted["response_peak_difference_m"])


def test_recording_without_reference_alone_has_nothing_beside_it(kept: Path) -> None:
    rec = rt.open(kept)
    rec.raw.reference = None
    with pytest.raises(rt.InputError, match="has no reference simulation"):
        rt.compare(rec)


def test_test_file_stands_for_its_simulation(short: rt.Test, kept: Path, tmp_path: Path) -> None:
    path = short.save(tmp_path / "own.toml")
    found = rt.compare(kept, path)
    reference = rt.open(kept).raw.reference
    assert reference is not None
    assert found.labels[1] == "section5-t0.5, reference simulation"
    peak = found.rows[1]["peak_measured_m"]
    assert peak == pytest.approx(np.abs(reference["x_ref_m"]).max(), rel=1e-12)


def test_table_of_a_lab_is_compared_in_its_units_and_moved(kept: Path, tmp_path: Path) -> None:
    rec = rt.open(kept)
    path = lab_table(tmp_path / "lab.csv", rec, late_s=7.0)
    columns = {"x_meas": "LVDT 1", "f_meas": "Load cell", "t": "Time"}
    found = rt.compare(rec, path, columns=columns)
    # Its time begins at 7 s and is counted from there: nothing is left to move.
    assert found.rows[1]["x_difference_nrmse"] < 1e-9
    assert found.rows[1]["f_difference_nrmse"] < 1e-9
    assert any("'LVDT 1' converted from mm" in note for note in found.notes)
    assert any("time begins at 7 s" in note for note in found.notes)
    assert any("1024 Hz; compared at 512 Hz" in note for note in found.notes)


def test_table_without_units_is_refused_in_the_words_of_whoever_asks(
    kept: Path, tmp_path: Path
) -> None:
    path = tmp_path / "lab.csv"
    path.write_text("t,LVDT\n0,0\n0.1,1\n0.2,2\n")
    with pytest.raises(
        rt.InputError, match=r'has no column for x_meas; assign one, .*columns={"x_me'
    ):
        rt.compare(kept, path)
    with pytest.raises(rt.InputError, match=r'states no unit.*columns={"x_meas": "LVDT \[m'):
        rt.compare(kept, path, columns={"x_meas": "LVDT"})
    path.write_text("t,x_meas\n0,0\n0.2,1\n0.1,2\n")
    with pytest.raises(rt.InputError, match="time does not increase"):
        rt.compare(kept, path)


@pytest.mark.long
def test_kept_runs_of_a_sweep_stand_beside_one_another(short: rt.Test, tmp_path: Path) -> None:
    over = {"controller.rfc.enabled": [True, False]}
    rt.sweep(short, over, out=tmp_path / "swept", keep="all", jobs=1)
    found = rt.compare(tmp_path / "swept")
    assert found.labels == ["enabled True", "enabled False"]
    assert found.rows[1]["x_difference_nrmse"] > 0.0
    rt.sweep(short, over, out=tmp_path / "bare", keep="nothing", jobs=1)
    with pytest.raises(rt.InputError, match="kept no recording"):
        rt.compare(tmp_path / "bare")


def test_tests_and_sweeps_are_compared_as_their_files_and_folders_are(
    kept: Path, short: rt.Test, tmp_path: Path
) -> None:
    file = short.save(tmp_path / "short.toml")
    given, named = rt.compare(kept, short), rt.compare(kept, file)
    assert given.rows == named.rows
    assert given.labels[1].endswith("reference simulation")
    swept = rt.sweep(short, {"controller.w1": [3, 3.5]}, out=tmp_path / "w1", keep="all", jobs=1)
    assert rt.compare(swept).rows == rt.compare(swept.folder).rows


@pytest.fixture
def two_sensors(tmp_path: Path) -> Path:
    """A table with its own column x_meas, and a second sensor that read twice as much."""
    path, t = tmp_path / "lab.csv", np.arange(1024) / 512.0
    x = 3.0 * np.sin(2.0 * np.pi * t)
    np.savetxt(path, np.column_stack([t, x, 2.0 * x]), delimiter=",", comments="",
               header="t [s],x_meas [mm],LVDT 2 [mm]")  # fmt: skip
    return path


def test_assigned_column_comes_before_the_one_with_the_name_of_the_channel(
    kept: Path, two_sensors: Path
) -> None:
    found = rt.compare(kept, two_sensors, columns={"x_meas": "LVDT 2"})
    assert found.rows[1]["peak_measured_m"] == pytest.approx(6e-3, rel=1e-3)
    assert rt.compare(kept, two_sensors).rows[1]["peak_measured_m"] == pytest.approx(3e-3, rel=1e-3)
    # The assignments of a diagnosis name more than a comparison reads.
    both = {"x_meas": "LVDT 2", "x_cmd": "x_meas"}
    assert rt.compare(kept, two_sensors, columns=both).rows == found.rows


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        (
            {"x_meas": "LVDT 9 [mm]"},
            "lab.csv has no column 'LVDT 9' (did you mean 'LVDT 2'?); its columns are 't [s]', "
            "'x_meas [mm]', 'LVDT 2 [mm]'",
        ),
        (
            {"x_cmd": "LVDT 2 [mm]"},
            "found x_cmd=LVDT 2 [mm]; only t, x_meas, f_meas of a CSV file are compared; assign",
        ),
    ],
)
def test_column_that_is_assigned_in_vain_is_refused_although_the_file_has_its_own(
    kept: Path, two_sensors: Path, columns: dict[str, str], says: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    with pytest.raises(rt.InputError) as caught:
        rt.compare(kept, two_sensors, columns=columns)
    ((channel, column),) = columns.items()
    assert str(caught.value).startswith(f"compare: columns: {channel}: ")
    assert says in str(caught.value)
    option = f"{channel}={column}"
    assert cli.main(["compare", str(kept), str(two_sensors), "--map", option]) == 3
    assert f"--map {channel}: " in capsys.readouterr().err


def test_columns_need_a_table_and_a_second_table_without_them_is_noted(
    kept: Path, two_sensors: Path, tmp_path: Path
) -> None:
    with pytest.raises(rt.InputError, match="none of the recordings is a CSV file"):
        rt.compare(kept, columns={"x_meas": "LVDT 2 [mm]"})
    other = tmp_path / "other.csv"
    other.write_text(two_sensors.read_text().replace("LVDT 2", "LVDT 7"))
    found = rt.compare(two_sensors, other, columns={"x_meas": "LVDT 2 [mm]"})
    assert any(
        note.startswith("other.csv: x_meas is read from the column of") for note in found.notes
    )


# ---- command and page ---------------------------------------------------------------------------


def test_command_writes_page_and_table_and_says_the_same_as_json(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "beside"
    assert cli.main(["compare", str(kept), "--out", str(out), "--json"]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert found["schema"] == "rthyb-compare/1"
    assert found["rows"][1]["label"] == "monday"
    assert "monday differs from monday, reference simulation by" in printed.err
    html = (out / comparison_page.PAGE).read_text()
    assert html.count("<figure id=") == 4
    assert re.findall(r'(?:src|href)="(?!#)', html) == []
    assert (out / comparison_page.TABLE).read_text().startswith("label,ending,peak_command_m,")
    assert cli.main(["compare", str(kept), "--out", str(out)]) == 2


def test_ten_courses_stand_below_one_another_and_two_beside(tmp_path: Path) -> None:
    many = [course(f"run {i}", (1 + 0.01 * i) * sine(3, FS_HZ)) for i in range(courses.MOST)]
    heads, rows = comparison_page.table(overlay.Overlay.of(many))
    assert heads[0] == ""
    assert [row[0] for row in rows] == [f"run {i}" for i in range(10)]
    most = 1e3 * 0.09 * np.abs(sine(3, FS_HZ)).max()
    assert comparison_page.sentence(overlay.Overlay.of(many)) == (
        f"Of the 9 others run 9 differs most from run 0: 9.0 % (NRMSE), {most:.3f} mm at most."
    )
    heads, rows = comparison_page.table(overlay.Overlay.of(many[:2]))
    assert heads == ["", "run 0", "run 1"]
    comparison_page.write(overlay.Overlay.of(many), tmp_path / "page.html")
    html = (tmp_path / "page.html").read_text()
    assert all(f">run {i}</th>" in html for i in range(10))
