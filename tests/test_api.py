"""The public interface in Python: tests and rigs as objects, runs, checks, recordings."""

from __future__ import annotations

import base64
import copy
import html
import inspect
import json
import math
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import own_parts
import pytest
from bench import interface
from command_line import Rthyb

import rthyb_rt as rt
from rthyb_rt import config
from rthyb_rt.analysis import summary
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record import recording

RTHYB = [sys.executable, "-c", "import rthyb_rt.cli as cli; cli.main()"]
SHORT = {"ground_motion": {"duration_s": "4 s"}, "test": {"free_vibration_s": "1 s"}}


@pytest.fixture(scope="module")
def short() -> rt.Test:
    return rt.Test("section5-T0.5", **SHORT)


@pytest.fixture(scope="module")
def rec(short: rt.Test) -> rt.Recording:
    return rt.run(short)


# ---- importing ----------------------------------------------------------------------------------


def test_importing_the_package_loads_nothing_of_what_it_may_need() -> None:
    code = (
        "import sys, json; import rthyb_rt as rt; dir(rt); "
        "print(json.dumps([m for m in sys.modules if m.split('.')[0] in "
        "('numpy', 'pydantic', 'h5py', 'matplotlib', 'pandas', 'xarray', 'scipy', 'typer', "
        "'rthyb_rt')]))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert json.loads(done.stdout) == ["rthyb_rt"]


@pytest.mark.speed
def test_importing_the_package_costs_less_than_150_ms_of_processor() -> None:
    cost_s = interface.import_cpu_s()
    print(f"import rthyb_rt: {1e3 * cost_s:.1f} ms of processor time")
    assert cost_s <= 0.15


@pytest.mark.long
def test_a_test_is_run_without_the_packages_that_draw_and_tabulate() -> None:
    code = (
        "import sys, rthyb_rt as rt; rec = rt.run(rt.Test('section5-T0.5', "
        "ground_motion={'duration_s': 1}, test={'free_vibration_s': 0})); repr(rec); "
        "sys.exit(any(m in sys.modules for m in ('matplotlib', 'pandas', 'xarray', 'jinja2')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_public_name_is_there_and_says_what_it_is() -> None:
    assert sorted(rt.__all__) == dir(rt)
    for name in rt.__all__:
        thing = getattr(rt, name)
        if name != "__version__":
            assert inspect.getdoc(thing), name
    with pytest.raises(AttributeError, match="no attribute 'simulate'"):
        rt.simulate  # type: ignore[attr-defined] # noqa: B018


# ---- tests and rigs -----------------------------------------------------------------------------


def test_test_from_file_from_name_and_from_its_own_text_are_one(tmp_path: Path) -> None:
    named = rt.Test("section5-T0.5")
    path = named.save(tmp_path / "mine.toml")
    assert named == rt.Test(path) == rt.Test.from_toml(path.read_text())
    assert hash(named) == hash(rt.Test(path))
    assert named.to_toml() == config.dump(config.load_test(config.builtin_test_path()))
    assert rt.Test(named.save(tmp_path / "again.toml")).rig == named.rig


def test_test_from_keywords_takes_units_as_the_file_does() -> None:
    mine = rt.Test(
        test={"name": "mine"},
        ground_motion={"pga_g": "0.3924 m/s2"},
        numerical={"period_s": "500 ms", "damping_ratio": "2 %"},
        limits={"force_n": "15 kN"},
        rig="shaking-table-portal-frame",
    )
    assert mine["numerical.period_s"] == 0.5
    assert mine["numerical.damping_ratio"] == 0.02
    assert mine["limits.force_n.value"] == 15e3
    assert mine["ground_motion.pga_g"] == pytest.approx(0.3924 / 9.80665)
    assert mine.rig.name == "shaking-table-portal-frame"


def test_values_of_numpy_and_paths_are_taken_as_numbers_and_texts(tmp_path: Path) -> None:
    record = tmp_path / "quake.csv"
    changed = rt.Test("section5-T0.5").with_(
        controller={"w1": np.float32(2.5), "alpha0": np.int64(12)}, ground_motion={"record": record}
    )
    assert changed["controller.w1"] == 2.5
    assert changed["controller.alpha0"] == 12
    assert changed["ground_motion.record"] == str(record)


def test_changed_copy_leaves_the_first_as_it_was() -> None:
    first = rt.Test("section5-T0.5")
    changed = first.with_(numerical={"period_s": "0.8 s"}).with_({"controller.type": "robust"})
    assert changed["numerical.period_s"] == 0.8
    # A period stands for the mass of the file, as it does after --set.
    assert changed["numerical.mass_kg"] is None
    assert changed["controller.type"] == "robust"
    assert first["numerical.mass_kg"] == 4220
    assert first["controller.type"] == "paper"
    assert first != changed


def test_none_leaves_a_key_out() -> None:
    free = rt.Test("section5-T0.5").with_({"limits.force_n": None})
    assert free["limits.force_n"] is None
    assert "force_n" not in free.to_toml().split("[limits")[1].split("[reference")[0]


def test_rig_is_changed_through_its_test_or_by_itself() -> None:
    rig = rt.Rig("delay-10-elastic")
    later = rig.with_(actuator={"delay_samples": 12})
    first = rt.Test("section5-T0.5", rig=rig)
    assert later["actuator.delay_samples"] == 12
    assert first.with_({"rig.actuator.delay_samples": 12}).rig == later
    assert first.with_(rig={"actuator": {"delay_samples": 12}}).rig == later
    assert first.with_(rig=later).rig == later
    assert first.with_(rig="first-order-5hz").rig == rt.Rig("first-order-5hz")
    assert first.rig == rig
    assert rt.Rig.from_toml(later.to_toml()) == later


def test_actuator_becomes_another_kind_as_a_whole() -> None:
    rig = rt.Rig("shaking-table-portal-frame").with_(
        {"actuator": {"kind": "pure-delay", "delay_samples": 3}}
    )
    assert rig["actuator"] == {"kind": "pure-delay", "delay_samples": 3}


def test_rig_from_keywords_runs_like_one_from_a_file() -> None:
    shipped = rt.Rig("delay-10-elastic")
    tables = {key: shipped[key] for key in ("rig", "actuator", "specimen", "sensors")}
    mine = rt.Rig(**tables)
    assert mine["specimen"] == shipped["specimen"]
    assert rt.check(rt.Test("section5-T0.5"), mine).figures["samples"] > 0


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda t: t.with_(controller={"typ": "x"}),
         ['with_: controller.typ: unknown key (did you mean "type"?)', "allowed here: type"]),
        (lambda t: t.with_({"numerical.mass_kg": "3 kN"}),
         ['with_: numerical.mass_kg: found "3 kN" (that is a force)', "the mass must be from"]),
        (lambda t: t.with_({"rig.actuator.kind": "pure-delay"}),
         ['with_: rig.actuator.kind: "pure-delay" has different keys',
          'with_({"rig.actuator": {"kind": "pure-delay", "delay_samples": ...}})']),
        (lambda t: t.with_({"numerical.mass_kg": -1, "rig.actuator.kp_per_s": "a"}),
         ["with_: numerical.mass_kg: found -1", 'with_: rig.actuator.kp_per_s: found "a"']),
        (lambda t: t.with_({"limits.forze_n": None}),
         ['with_: limits.forze_n: found None', 'did you mean "force_n"?']),
        (lambda t: t.with_(["controller.w1"]), ["with_: found", "a dict of dotted keys"]),
        (lambda t: t[3], ["test[3]: no such key", "a test file has: schema, rig, test"]),
        (lambda t: t["numerical.mass"],
         ['test["numerical.mass"]: no such key (did you mean "mass_kg"?)', "numerical has:"]),
        (lambda _: rt.Test(numerical={"period_s": "1 kg"}),
         ["Test: test: missing", 'Test: numerical.period_s: found "1 kg" (that is a mass)']),
        (lambda _: rt.Test(),
         ["Test: no argument was given", "section5-T0.5", "keyword arguments"]),
        (lambda _: rt.Test("section5"), ['test: found "section5"', "section5-T0.5"]),
        (lambda _: rt.Rig("nowhere.toml"), ["nowhere.toml: no such file"]),
        (lambda _: rt.Rig(3), ["Rig: found 3", "path of a rig file"]),
        (lambda _: rt.open("nowhere"), ["nowhere: does not exist; give the recording.h5"]),
        (lambda t: rt.run(rt.Test.from_toml(t.to_toml()).with_({"rig": None})),
         ['the test "section5-t0.5" names no rig', "test.with_(rig=", "delay-10-elastic"]),
    ],
)  # fmt: skip
def test_wrong_use_is_told_with_place_value_what_is_allowed_and_remedy(
    wrong: Callable[[rt.Test], object], told: list[str]
) -> None:
    with pytest.raises(rt.InputError) as raised:
        wrong(rt.Test("section5-T0.5"))
    for part in told:
        assert part in str(raised.value)
    assert "--set" not in str(raised.value)


def test_fault_of_a_file_has_its_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(rt.Test("section5-T0.5").to_toml().replace("w1 = 3", "w9 = 3"))
    with pytest.raises(rt.InputError, match=r"bad\.toml:\d+: controller\.w9: unknown key"):
        rt.Test(path)


def test_objects_say_in_one_line_what_they_are(rec: rt.Recording) -> None:
    test = rt.Test("section5-T0.5")
    for thing in (test, test.rig, rec, rt.check(test), rec.plot):
        assert "\n" not in repr(thing)
        assert repr(thing).startswith(f"<{type(thing).__name__}")
    assert "4220 kg" in repr(test)
    assert "completed, 5 s at 1024 Hz, tracking" in repr(rec)


# ---- runs and checks ----------------------------------------------------------------------------


def test_run_is_that_of_the_command_line_bit_for_bit(short: rt.Test, rec: rt.Recording) -> None:
    settings = ["ground_motion.duration_s=4", "test.free_vibration_s=1"]
    again = virtual_time.run(experiment.prepare(*config.load_both(None, None, settings)))
    assert again.samples.tobytes() == rec.raw.samples.tobytes()
    assert rt.run(short, short.rig).raw.samples.tobytes() == again.samples.tobytes()


def test_run_that_a_limit_ends_is_no_error() -> None:
    rec = rt.run(rt.Test("section5-T0.5", controller={"type": "none"}))
    assert not rec.completed
    assert "limit 15 kN" in rec.ending
    assert rec.notices


@pytest.mark.long
def test_run_keeps_what_the_command_keeps(short: rt.Test, tmp_path: Path) -> None:
    rec = rt.run(short, out=tmp_path / "kept")
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == [
        "recording.h5", "report.html", "rig.toml", "test.toml",
    ]  # fmt: skip
    assert sorted(tmp_path.iterdir()) == [tmp_path / "kept"]
    again = rt.open(tmp_path / "kept")
    assert again.raw.samples.tobytes() == rec.raw.samples.tobytes()
    assert again.test == rt.Test(tmp_path / "kept" / "test.toml").with_(
        rig=rt.Rig(tmp_path / "kept" / "rig.toml")
    )
    assert rt.run(tmp_path / "kept" / "test.toml").raw.samples.tobytes() == (
        rec.raw.samples.tobytes()
    )
    with pytest.raises(rt.InputError, match="already exists"):
        rt.run(short, out=tmp_path / "kept")


def test_folder_that_cannot_be_written_is_told_and_nothing_is_left(
    short: rt.Test, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(rt.RthybError, match="cannot be written"):
        rt.run(short, out=tmp_path / "file" / "run")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_progress_is_told(short: rt.Test) -> None:
    told: list[tuple[int, int]] = []
    rt.run(short, progress=lambda done, whole: told.append((done, whole)))
    assert told[-1][0] == told[-1][1] == 5 * 1024


@pytest.mark.long
def test_check_says_what_the_command_says() -> None:
    done = subprocess.run(
        [*RTHYB, "check", str(config.builtin_test_path()), "--json"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    found = rt.check("section5-T0.5")
    assert json.loads(json.dumps(found.document)) == json.loads(done.stdout)
    assert found.figures["period_s"] == pytest.approx(0.5, rel=1e-3)
    assert "<table>" in found._repr_html_()
    heavy = rt.check(rt.Test("section5-T0.5", numerical={"damping_ratio": 0.9}))
    assert any("of critical" in text for text in heavy.warnings)


# ---- recordings ---------------------------------------------------------------------------------


def test_signals_have_names_and_units(rec: rt.Recording) -> None:
    assert rec.units["x_meas_m"] == "m"
    assert rec.units["f_ref_n"] == "N"
    assert set(rec) == set(rec.units)
    assert "x_meas_m" in rec
    assert "x_meas" not in rec
    np.testing.assert_array_equal(rec["x_meas_m"], rec.raw.samples["x_meas_m"])
    assert rec["t_s"][rec.running][0] == 0.0
    for name in rec:
        assert rec[name].shape == rec["t_s"].shape, name
    inside = rec["x_ref_m"][rec.running]
    assert np.isfinite(inside).all()
    assert np.isnan(rec["x_ref_m"][~rec.running]).all()
    assert np.abs(rec["x_meas_m"][rec.running] - inside).max() == pytest.approx(
        rec.measures["response_peak_difference_m"]
    )
    with pytest.raises(rt.InputError, match=r'no signal "x_meas" \(did you mean "x_meas_m"\?\)'):
        rec["x_meas"]


def test_signals_are_the_recordings_own_and_cannot_be_overwritten(
    short: rt.Test, tmp_path: Path
) -> None:
    rt.run(short, out=tmp_path / "kept", report=False)
    rec = rt.open(tmp_path / "kept")
    for name in rec:
        with pytest.raises(ValueError, match="read-only"):
            rec[name][0] = 0
    before = rec.measures["peak_measured_m"]
    mine = rec["x_meas_m"] - 1e-3
    mine[:] = 0.0
    rec.to_xarray(whole=True)["x_meas_m"][:] = 0.0
    table = rec.to_pandas(whole=True)
    table.loc[:, "x_meas_m"] = 0.0
    assert np.any(rec["x_meas_m"] != 0.0)
    assert rec.measures["peak_measured_m"] == before


def test_test_and_rig_refuse_to_be_changed_in_place() -> None:
    test = rt.Test("section5-T0.5")
    with pytest.raises(AttributeError, match=r"test never changes; test.with_\(numerical={...}\)"):
        test.numerical = 3  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match=r'did you mean "numerical"\?'):
        test.numeric = 3  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match=r'test.with_\({"test.name": ...}\) returns a changed'):
        test.name = "mine"  # type: ignore[misc]
    with pytest.raises(TypeError, match=r'rig.with_\({"actuator.kp_per_s": ...}\) returns'):
        test.rig["actuator.kp_per_s"] = 60.0
    assert test == rt.Test("section5-T0.5")


def test_channel_of_a_law_is_a_signal_with_its_unit() -> None:
    rec = rt.run(rt.Test("section5-T0.5", controller={"type": "ats"}, **SHORT))
    names = [channel.name for channel in rec.raw.channels]
    assert names
    for channel in rec.raw.channels:
        assert rec.units[channel.name] == channel.unit
        np.testing.assert_array_equal(rec[channel.name], rec.raw.channel(channel.name))


def test_tables_of_pandas_and_xarray_have_the_signals_and_their_units(rec: rt.Recording) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    table, whole, grid = rec.to_pandas(), rec.to_pandas(whole=True), rec.to_xarray()
    assert len(table) == np.count_nonzero(rec.running)
    assert len(whole) == len(rec["t_s"])
    assert table.index.name == "t_s"
    assert table.attrs["units"]["f_meas_n"] == "N"
    np.testing.assert_array_equal(whole["x_meas_m"], rec["x_meas_m"])
    np.testing.assert_array_equal(grid["x_meas_m"], table["x_meas_m"])
    assert grid["x_meas_m"].attrs["units"] == "m"
    assert grid.coords["t_s"].attrs["units"] == "s"


def test_package_that_is_missing_is_named_with_its_remedy(
    rec: rt.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for name in ("rthyb_rt.report.figures", "rthyb_rt.report.drawing"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(rt.InputError, match=r"to_pandas: needs pandas; .*rthyb-rt\[data\]"):
        rec.to_pandas()
    with pytest.raises(rt.InputError, match=r"a figure needs matplotlib.*rthyb-rt\[report\]"):
        rec.plot.response()
    # Of all figures, the one that the report draws in the browser needs no matplotlib.
    with pytest.raises(rt.InputError, match=r"without it, plot.displacement\(\) alone is drawn"):
        rec.plot.hysteresis()
    assert "<iframe" in rec._repr_html_()


def test_without_matplotlib_the_displacement_is_the_chart_of_the_report(
    rec: rt.Recording, tmp_path: Path
) -> None:
    """In a process of its own, where nothing has imported matplotlib or jinja2 before."""
    rec.save(tmp_path / "recording.h5")
    script = (
        "import sys; sys.modules['matplotlib'] = sys.modules['jinja2'] = None; "
        "import rthyb_rt as rt; rec = rt.open('recording.h5'); plot = rec.plot.displacement(); "
        "plot.save('chart.html'); print(plot._repr_html_())\n"
        "try: plot.save('chart.svg')\n"
        "except rt.InputError as error: print(error, file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    shown = re.fullmatch(
        r'<iframe title="Displacement" srcdoc="([^"]*)" [^>]*></iframe>\n', done.stdout
    )
    assert shown is not None
    page = html.unescape(shown[1])
    assert page == (tmp_path / "chart.html").read_text(encoding="utf-8")
    assert "://" not in re.sub(r"https?://[^ ]*(uPlot|w3\.org)[^ ]*", "", page)
    told = json.loads(re.search(r'id="zoom-data">(.*?)</script>', page, re.S)[1])  # type: ignore[index]
    measured = next(s for s in told["panels"][1]["series"] if s["label"] == "measured")
    values = np.frombuffer(base64.b64decode(measured["data"]), "<i2") * told["panels"][1]["scale"]
    every = round(told["step"] * rec.fs_hz)
    np.testing.assert_allclose(
        values, 1e3 * rec["x_meas_m"][::every], atol=told["panels"][1]["scale"]
    )
    assert "chart.svg: found the file name extension" in done.stderr
    assert "rthyb-rt[report]" in done.stderr


def test_measures_are_those_of_the_command_line(rec: rt.Recording) -> None:
    found = summary.summarize(rec.raw)
    assert rec.measures["tracking_nrmse"] == found.tracking_nrmse
    assert rec.measures["fs_hz"] == 1024
    assert rec.verdict == summary.verdict(found)
    assert rec.table[0][0] == "Result"
    json.dumps(rec.measures)


@pytest.mark.long
def test_figures_are_those_of_the_report(rec: rt.Recording, tmp_path: Path) -> None:
    from rthyb_rt.report.figures import draw_all

    plates = draw_all(rec.raw, rec.summary)
    for plate in plates:
        plot = getattr(rec.plot, plate.key)()
        assert plot.title == plate.title
        assert bool(plot.svg) == bool(plate.svg)
    plot = rec.plot.hysteresis()
    assert plot.figure is not None
    for ending, head in (("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")):
        assert plot.save(tmp_path / f"loop.{ending}").read_bytes().startswith(head)
    with pytest.raises(
        rt.InputError, match=r'found the file name extension ".docx"; must be one of'
    ):
        plot.save(tmp_path / "loop.docx")


def test_figure_that_a_recording_has_not_says_so(rec: rt.Recording, tmp_path: Path) -> None:
    bare = rt.Recording(recording.RecordedTest(**{**vars(rec.raw), "reference": None}))
    plot = bare.plot.accumulated()
    assert plot.svg == ""
    assert "no reference simulation" in plot.note
    with pytest.raises(rt.InputError, match="no figure to save"):
        plot.save(tmp_path / "none.svg")
    assert "x_ref_m" not in bare


def test_notebook_shows_verdict_and_figure(rec: rt.Recording) -> None:
    html = rec._repr_html_()
    assert rec.verdict in html
    assert "<svg" in html
    assert "Tracking, NRMSE" in html


def test_figures_of_one_notebook_share_no_names(rec: rt.Recording) -> None:
    plot = rec.plot.response()
    pages = [plot._repr_html_(), plot._repr_html_()]
    first, second = ({*re.findall(r' id="([^"]+)"', page)} for page in pages)
    assert first
    assert not first & second
    for page, own in zip(pages, (first, second), strict=True):
        assert {*re.findall(r'(?:url\(|href=")#([^)"]+)', page)} <= own


@pytest.mark.long
def test_recording_is_saved_exported_and_reported(rec: rt.Recording, tmp_path: Path) -> None:
    assert rt.open(rec.save(tmp_path / "recording.h5"))["x_meas_m"].tobytes() == (
        rec["x_meas_m"].tobytes()
    )
    header = rec.export(tmp_path / "short.csv").read_text().splitlines()[0]
    assert header == "t,ag,x_num,x_cmd,x_meas,f_meas"
    assert "x_meas_m" in rec.export(tmp_path / "all.csv", whole=True).read_text().splitlines()[0]
    assert rec.export(tmp_path / "all.mat").stat().st_size > 0
    assert "<svg" in rec.report(tmp_path / "report.html").read_text()
    with pytest.raises(
        rt.InputError, match=r'found the file name extension ".xlsx"; must be one of .csv, .mat'
    ):
        rec.export(tmp_path / "all.xlsx")


@pytest.mark.long
@pytest.mark.speed
def test_running_from_python_costs_what_the_command_costs() -> None:
    ratio = interface.ratio_of(interface.run_and_command(pairs=5))
    print(f"rt.run over rthyb run: {ratio:.3f} of the processor time")
    assert ratio <= 1.05


WITHOUT_A_PATH = {
    "open": lambda none, rec, rig: rt.open(none),
    "replay": lambda none, rec, rig: rt.replay(none),
    "save": lambda none, rec, rig: rig.save(none),
    "save of a recording": lambda none, rec, rig: rec.save(none),
    "export": lambda none, rec, rig: rec.export(none),
    "report": lambda none, rec, rig: rec.report(none),
    "report_files": lambda none, rec, rig: rec.report_files(none),
    "plot.save": lambda none, rec, rig: rec.plot.response().save(none),
    "compare": lambda none, rec, rig: rt.compare(rec, none),
    "diagnose": lambda none, rec, rig: rt.diagnose(none, rig),
    "diagnose: model": lambda none, rec, rig: rt.diagnose(rec, none),
    "Test": lambda none, rec, rig: rt.run(5 if none is None else none),
    "run": lambda none, rec, rig: rt.run(HALF_A_SECOND, out=5 if none is None else none),
    "sweep": lambda none, rec, rig: rt.sweep(HALF_A_SECOND, out=5 if none is None else none),
}
MISTAKES = {
    "rig for test": (
        lambda rec: rt.run(rt.Rig("delay-10-elastic")),
        'found the rig "delay-10-elastic", but a test is needed here; the test comes before',
    ),
    "test for rig": (
        lambda rec: rt.run(HALF_A_SECOND, HALF_A_SECOND),
        "a rig is needed here; test.rig is its rig",
    ),
    "recording for test": (rt.check, "recording.test is the one it ran with"),
    "recording for rig": (rt.identify, "recording.rig is the one it ran with"),
    "name of a test for a rig": (
        lambda rec: rt.Rig("section5-T0.5"),
        "no file and no rig of that name (it is a test)",
    ),
    "name of a rig for a test": (
        lambda rec: rt.Test("delay-10-elastic"),
        "no file and no test of that name (it is a rig)",
    ),
    "row for signal": (lambda rec: rec[0], "found 0; a signal is chosen by its name"),
    "measure": (lambda rec: rec.measures["trackng_nrmse"], '(did you mean "tracking_nrmse"?)'),
    "unit": (lambda rec: rec.units["x_meas"], 'no signal "x_meas" (did you mean "x_meas_m"?)'),
    "progress of a run": (
        lambda rec: rt.run(HALF_A_SECOND, progress=3),
        "run: progress: found 3; give a function of two numbers",
    ),
    "progress of a diagnosis": (
        lambda rec: rt.diagnose(rec, "delay-10-elastic", progress=3),
        "diagnose: progress: found 3; give a function of one text",
    ),
    "cluster": (
        lambda rec: rt.sweep(HALF_A_SECOND, {"controller.w1": [3]}, client=7),
        "sweep: client: found 7; give a distributed.Client, or the address",
    ),
    "spread": (
        lambda rec: rt.sweep(HALF_A_SECOND, draws={"count": 2}),
        "draws.spread: missing; give the standard deviation of each key that is drawn, draws={",
    ),
    "one table together": (
        lambda rec: rt.sweep(HALF_A_SECOND, together={"controller.w1": [3]}),
        "sweep: together: found a table; give a list of dicts",
    ),
    "key that is a number": (
        lambda rec: HALF_A_SECOND.with_({3: 4}),
        'found 3 as the name of a key; a key is a string as in the file, such as "w1", or dotted',
    ),
    "element for a controller": (
        lambda rec: HALF_A_SECOND.with_(controller=own_parts.Spring(6e5)),
        "controller: found an object of Spring, which is a specimen element; give it in a list:",
    ),
    "law for a numerical part": (
        lambda rec: HALF_A_SECOND.with_(numerical=own_parts.Inverse(0.01)),
        "found an object of Inverse, which is a control law; give it as controller=Inverse(...)",
    ),
    "law for an element": (
        lambda rec: rt.Rig("delay-10-elastic", specimen=[own_parts.Inverse(0.01)]),
        "specimen: found an object of Inverse, which is a control law",
    ),
    "element without a list": (
        lambda rec: rt.Rig("delay-10-elastic").with_(specimen=own_parts.Spring(6e5)),
        "give it in a list: rig.with_(specimen=[Spring(...)])",
    ),
    "table of the rig": (
        lambda rec: HALF_A_SECOND.with_(actuator={"delay_samples": 12}),
        'actuator is a table of the rig, not of the test: give it below rig, with_({"rig.',
    ),
    "type for kind": (
        lambda rec: rt.Rig(
            rig={"name": "mine", "elastic_stiffness_n_per_m": 1e6},
            actuator={"type": "pure-delay", "delay_samples": 3},
            specimen=[{"kind": "stiffness", "k_n_per_m": 1e6}],
        ),
        'Rig: actuator.kind: missing; found type = "pure-delay": call that key kind\n'
        'Rig: specimen.0.element: missing; found kind = "stiffness": call that key element',
    ),
    "array for a signal": (
        lambda rec: rec.frequency_response(rec["x_num_m"]),
        "found an array of shape (",
    ),
    "segment in words": (
        lambda rec: rec.frequency_response(segment_s="4 s"),
        'segment_s: found "4 s"; give the length of a segment in s as a number',
    ),
    "nothing to check": (lambda rec: rt.check(None), "check: test: found nothing (None); give a"),
    "test for a recording": (
        lambda rec: rt.diagnose(HALF_A_SECOND, "delay-10-elastic"),
        'diagnose: recording: found the test "section5-t0.5"; give a recording, such as run(test)',
    ),
    "recording for a model": (
        lambda rec: rt.diagnose(rec, rec),
        "diagnose: model: found a recording; give a rig, a test, or the path of a rig, test or",
    ),
    "rig to compare": (
        lambda rec: rt.compare(rec, rt.Rig("delay-10-elastic")),
        'compare: found the rig "delay-10-elastic"; give a recording, a test, a sweep, or the path',
    ),
    "effect in bytes": (
        lambda rec: rt.diagnose(rec, "delay-10-elastic", effects=b"magnet.py"),
        "effects: found b'magnet.py'; an effect is an object of a class",
    ),
    "one effect that is not there": (
        lambda rec: rt.diagnose(rec, "delay-10-elastic", effects="magnet.py"),
        "magnet.py: cannot be read (No such file",
    ),
    "number for the text of a file": (
        lambda rec: rt.Test.from_toml(3),
        "Test.from_toml: found 3; give the text of a test file as a string",
    ),
    "name of a report": (
        lambda rec: rt.run(HALF_A_SECOND, report="report.html"),
        'run: report: found "report.html"; must be True or False; recording.report(path) writes',
    ),
    "word for a flag": (
        lambda rec: rt.compare(rec, align="yes"),
        'compare: align: found "yes"; must be True or False',
    ),
    "number for a flag": (lambda rec: rec.export("x.csv", whole=3), "export: whole: found 3; must"),
    "check of itself in words": (
        lambda rec: rt.diagnose(rec, "delay-10-elastic", self_check="no"),
        'diagnose: self_check: found "no"',
    ),
    "progress of one number": (
        lambda rec: rt.run(HALF_A_SECOND, progress=lambda done: None),
        "run: progress: found a function of (done); give a function of two numbers",
    ),
    "progress of two texts": (
        lambda rec: rt.diagnose(rec, "delay-10-elastic", progress=lambda a, b: None),
        "diagnose: progress: found a function of (a, b); give a function of one text",
    ),
    "plot of a check": (
        lambda rec: rt.check(HALF_A_SECOND).plots()["niquist"],
        'check: no plot "niquist" (did you mean "nyquist"?); plots are: stability, nyquist',
    ),
    "folder named like a page": (
        lambda rec: rec.report_files("report.html"),
        "report.html: is the name of one file, but several are written: give a folder",
    ),
    "number together": (
        lambda rec: rt.sweep(HALF_A_SECOND, together=3),
        "sweep: together: found 3; give a list of dicts",
    ),
    "list of numbers together": (
        lambda rec: rt.sweep(HALF_A_SECOND, together=[3]),
        "sweep: together: found 3; give a dict of lists by dotted key, together=[{",
    ),
    "table of values": (
        lambda rec: rt.sweep(HALF_A_SECOND, {"controller.w1": {"low": 3}}),
        "sweep: over.controller.w1: found a table; a key is dotted, as in the file, and has a li",
    ),
    "number for a key": (
        lambda rec: rt.sweep(HALF_A_SECOND, {3: [3]}),
        "sweep: over.3: found 3 as a key; a key is dotted",
    ),
    "class of a recording": (
        lambda rec: rt.Recording("runs/monday"),
        'found "runs/monday"; a recording is made by run(test), or read by open(path)',
    ),
    "class of a check": (
        lambda rec: rt.Check(HALF_A_SECOND),
        'Check: found the test "section5-t0.5"; give it to check(test)',
    ),
    "class of a comparison": (
        rt.Comparison,
        "found a recording; a comparison is made by compare(first, second)",
    ),
    "table for a list of tables": (
        lambda rec: rt.Rig("delay-10-elastic", specimen={"element": "stiffness"}),
        'specimen has the entries 0 to 0; found "element"; it is a list of tables: give the whole',
    ),
    "table for an empty list": (
        lambda rec: rt.Rig("delay-10-elastic", sensors={"extra": {"name": "a"}}),
        'sensors.extra has no entries; found "name"; it is a list of tables',
    ),
    "rig of several axes for a model": (
        lambda rec: rt.diagnose(rec, rt.Rig("two-axis-frame")),
        'diagnose: model "two-axis-frame": found [[axis]]: this rig has several axes',
    ),
    "list to compare": (
        lambda rec: rt.compare([rec, rec]),
        "found a list of 2; give each recording, or its path, by itself: compare(*recordings)",
    ),
    "columns in a list": (
        lambda rec: rt.compare(rec, rec, columns=["x"]),
        "columns: found a list of 1; give a dict of columns by channel",
    ),
    "number for an effect": (
        lambda rec: rt.diagnose(rec, "delay-10-elastic", effects=[3]),
        "found 3; an effect is an object of a class Gap(rthyb_rt.Effect), such as Gap()",
    ),
    "figure of a check": (
        lambda rec: rt.check(HALF_A_SECOND).figures["critical_delay_sample"],
        'check: no figure "critical_delay_sample" (did you mean "critical_delay_samples"?)',
    ),
    "recording as CSV": (
        lambda rec: rec.save("rec.csv"),
        'found the file name extension ".csv"; must be .h5 or .hdf5',
    ),
    "rig as JSON": (
        lambda rec: rt.Rig("delay-10-elastic").save("rig.json"),
        'rig.json: found the file name extension ".json"; must be .toml',
    ),
    "axis without a name": (
        lambda rec: rec.axis("upper"),
        'no axis "upper"; the test ran on a single axis, which has no name',
    ),
    "report as PDF": (
        lambda rec: rec.report("report.pdf"),
        'report.pdf: found the file name extension ".pdf"; a page is HTML',
    ),
    "comparison as PDF": (
        lambda rec: rt.compare(rec).report("beside.pdf"),
        "must end in .html or .htm; for a PDF, print the page from a browser",
    ),
    "check as PDF": (
        lambda rec: rt.check(HALF_A_SECOND).report("check.pdf"),
        'check.pdf: found the file name extension ".pdf"',
    ),
    "axis": (lambda rec: rec.export("x.csv", axis="upper"), "export: axis: the recording has only"),
    "file that is not there": (
        lambda rec: rt.diagnose("lab.csv", "delay-10-elastic"),
        "lab.csv: no such file; give a CSV file, or",
    ),
    "no processes": (
        lambda rec: rt.sweep(HALF_A_SECOND, {"controller.w1": [3]}, jobs=0),
        "sweep: jobs: found 0; the number of processes must be a whole number from 1",
    ),
    "processes in words": (
        lambda rec: rt.sweep(HALF_A_SECOND, {"controller.w1": [3]}, jobs="two"),
        'sweep: jobs: found "two"',
    ),
    "progress": (
        lambda rec: rt.sweep(HALF_A_SECOND, {"controller.w1": [3]}, progress=5),
        "sweep: progress: found 5; give a function of two numbers",
    ),
}
HALF_A_SECOND = rt.Test(
    "section5-T0.5", ground_motion={"duration_s": 0.5}, test={"free_vibration_s": 0.1}
)


@pytest.mark.long
def test_shortest_of_tests_has_a_report(tmp_path: Path) -> None:
    """In which no frequency is known well enough to be drawn."""
    rec = rt.run(HALF_A_SECOND, out=tmp_path / "run")
    assert "<svg" in (tmp_path / "run" / "report.html").read_text()
    assert not any("no report" in note for note in rec.notes)


@pytest.mark.parametrize("call", WITHOUT_A_PATH)
@pytest.mark.parametrize("none", [None, 3.5, ["a"]], ids=["None", "number", "list"])
def test_what_is_no_path_is_refused_with_what_was_found_and_what_to_give(
    call: str, none: Any
) -> None:
    with pytest.raises(rt.InputError) as caught:
        WITHOUT_A_PATH[call](none, rt.run(HALF_A_SECOND), rt.Rig("delay-10-elastic"))
    (problem,) = caught.value.problems
    assert problem.message.startswith("found ")
    assert "path" in problem.message
    assert problem.where.startswith(call.split()[0].split(":")[0])


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_of_a_newcomer_is_told_with_what_was_meant(
    mistake: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    call, told = MISTAKES[mistake]
    with pytest.raises(rt.InputError) as caught:
        call(rt.run(HALF_A_SECOND))
    assert told in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_test_that_is_not_given_is_the_built_in_one_and_the_result_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = tmp_path / "built-in.toml"
    HALF_A_SECOND.with_({"test.name": "built-in"}).save(short)
    monkeypatch.setattr("rthyb_rt.config.builtin_test_path", lambda: short)
    assert rt.run(None).notes[0].startswith("no test was given, so the built-in one was used")
    found = rt.sweep(None, {"controller.w1": [3]}, out=tmp_path / "swept", jobs=1)
    assert found.notes[0].startswith("no test was given")
    assert not any("no test was given" in note for note in rt.run(HALF_A_SECOND).notes)
    with pytest.raises(rt.InputError, match="no measure 3; measures are: "):
        found.statistics(3)  # type: ignore[arg-type]


def test_results_of_many_numbers_are_shown_in_one_line(rec: rt.Recording) -> None:
    assert re.fullmatch(
        r"<EnergyBalance of \d+ rows, at the end: input [\d.]+ J, fed .*; gap [\de.-]+>",
        repr(rec.energy_balance()),
    )
    assert re.fullmatch(
        r"<FrequencyResponse at \d+ frequencies, [\d.]+ to 512 Hz, known at \d+, \d+ segments>",
        repr(rec.frequency_response()),
    )
    assert "\n" not in repr(rt.replay(rec))


def test_a_recording_is_a_mapping_with_a_default(rec: rt.Recording) -> None:
    assert rec.get("no_such_signal") is None
    assert rec.get("no_such_signal", 3) == 3
    np.testing.assert_array_equal(rec.get("x_meas_m"), rec["x_meas_m"])
    with pytest.raises(AttributeError, match=r'no figure hysteresys \(did you mean "hysteresis"'):
        rec.plot.hysteresys()  # type: ignore[operator]


READ_BY_NAME = {
    'recording["x_meas_m"]': lambda rec: rec.x_meas_m,
    'recording.measures["tracking_nrmse"]': lambda rec: rec.tracking_nrmse,
    'in brackets, ["tracking_nrmse"]': lambda rec: rec.measures.tracking_nrmse,
    'a value is read by its key, test["controller"]': lambda rec: rec.test.controller,
    'a value is read by its key, rig["actuator"]': lambda rec: rec.rig.actuator,
    'a recording has no attribute complete (did you mean "completed"?)': lambda rec: rec.complete,
    'a test has no attribute too_toml (did you mean "to_toml"?)': lambda rec: rec.test.too_toml,
}


@pytest.mark.parametrize("told", READ_BY_NAME)
def test_name_written_like_an_attribute_is_told_with_how_it_is_read(
    told: str, rec: rt.Recording
) -> None:
    with pytest.raises(AttributeError, match=re.escape(told)):
        READ_BY_NAME[told](rec)


def test_objects_with_such_hints_are_copied_and_sent_to_other_processes(rec: rt.Recording) -> None:
    for made in (copy.deepcopy(rec), pickle.loads(pickle.dumps(rec))):
        np.testing.assert_array_equal(made["x_meas_m"], rec["x_meas_m"])
        assert made.measures == rec.measures
    for made in (copy.deepcopy(rec.test), pickle.loads(pickle.dumps(rec.test))):
        assert made == rec.test
    assert not hasattr(rec, "shape")
    assert "controller.w1" in rec.test
    assert "controller.w9" not in rec.test
    with pytest.raises(TypeError, match="not iterable"):
        list(rec.test)  # type: ignore[call-overload]


def test_a_test_takes_changes_of_its_rig_where_it_takes_those_of_its_own_tables() -> None:
    by_name = rt.Test("section5-T0.5", rig={"actuator": {"kp_per_s": 60}}, controller={"w1": 4})
    changes = {"rig.actuator.kp_per_s": 60, "controller.w1": 4}
    assert by_name == rt.Test("section5-T0.5").with_(changes)
    whole = {
        "rig": {"name": "mine", "elastic_stiffness_n_per_m": 1e6},
        "actuator": {"kind": "pure-delay", "delay_samples": 3},
        "specimen": [{"element": "stiffness", "k_n_per_m": 1e6}],
    }
    made = rt.Test(rig=whole, test={"name": "mine"}, numerical={"period_s": 1, "damping_ratio": 0})
    assert made.rig == rt.Rig(**whole)


def test_misspelt_public_name_is_told_with_the_name_that_was_meant() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import rthyb_rt as rt; rt.comparee"],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert "Did you mean: 'compare'?" in done.stderr


# ---- nothing that is read changes what was recorded ----------------------------------------------


def test_units_and_measures_are_copies_and_a_recording_takes_no_attributes() -> None:
    rec = rt.run(rt.Test("section5-T0.5", ground_motion={"duration_s": 1}))
    rec.units["mine"] = "m"
    rec.units.pop("x_meas_m")
    assert "x_meas_m" in rec.to_pandas().columns
    error = rec.measures["tracking_nrmse"]
    rec.measures["tracking_nrmse"] = 0.0
    assert rec.measures["tracking_nrmse"] == error > 0.0
    with pytest.raises(AttributeError, match=r"recording\.x_meas_m cannot be set"):
        rec.x_meas_m = 3


def test_a_number_that_is_none_is_refused_in_a_sweep() -> None:
    for value in (math.nan, math.inf):
        with pytest.raises(rt.InputError, match=r"over\.controller\.w1: found .* must be finite"):
            rt.sweep(rt.Test("section5-T0.5"), {"controller.w1": [3, value]})


def test_a_sweep_of_an_identification_has_no_energy_balance() -> None:
    found = rt.identify("delay-10-elastic").recording
    with pytest.raises(rt.InputError, match="a test that reached RUNNING, with a numerical part"):
        found.energy_balance()


def test_what_is_a_test_or_a_rig_already_is_told_so() -> None:
    test = rt.Test("section5-T0.5")
    with pytest.raises(rt.InputError, match="is a Test already; use it as it is"):
        rt.Test(test)
    with pytest.raises(rt.InputError, match="is a Rig already; use it as it is"):
        rt.Rig(test.rig)
    with pytest.raises(rt.InputError, match="found two rigs"):
        test.with_({"rig": "delay-10-elastic"}, rig="first-order-5hz")
    spring = [{"element": "stiffness", "k_n_per_m": 1e5}]
    changed = test.with_({"rig": {"specimen": spring}})
    assert changed.rig["specimen"] == test.with_(rig={"specimen": spring}).rig["specimen"]


def test_tests_that_come_with_the_program_are_compared_by_their_names() -> None:
    found = rt.compare("section5-T0.5", "section5-T1.0")
    assert found.labels == [
        "section5-t0.5, reference simulation",
        "section5-t1.0, reference simulation",
    ]


# ---- what a test or a rig has, it keeps ---------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda test, rig: test["numerical"].update(mass_kg=1.0), 'test["numerical"] cannot'),
        (lambda test, rig: test["numerical"].pop("mass_kg"), "test.with_"),
        (lambda test, rig: rig["specimen"].append({}), 'rig["specimen"] cannot be changed'),
        (lambda test, rig: rig["specimen"][0].clear(), 'rig["specimen.0"] cannot be changed'),
        (lambda test, rig: rig["identified"]["frequency_hz"].sort(), "rig.with_"),
    ],
)
def test_a_change_of_a_table_in_place_is_refused(
    change: Callable[[rt.Test, rt.Rig], object], said: str
) -> None:
    test, rig = rt.Test("section5-T0.5"), rt.Rig("delay-10-elastic")
    before = test.to_toml(), rig.to_toml()
    with pytest.raises(TypeError) as caught:
        change(test, rig)
    assert said in str(caught.value)
    assert (test.to_toml(), rig.to_toml()) == before


def test_a_setting_that_is_assigned_names_the_copy_to_make() -> None:
    test = rt.Test("section5-T0.5")
    with pytest.raises(TypeError) as caught:
        test["numerical"]["mass_kg"] = 1.0
    assert str(caught.value) == (
        'test["numerical"]["mass_kg"] cannot be changed, because a test never changes; '
        'test.with_({"numerical.mass_kg": ...}) returns a changed copy'
    )
    table = test["numerical"]
    with pytest.raises(TypeError, match="never changes"):
        table |= {"mass_kg": 1.0}


def test_what_is_read_from_a_rig_is_a_start_for_a_changed_copy() -> None:
    rig = rt.Rig("delay-10-elastic")
    longer = rig.with_(specimen=[*rig["specimen"], {"element": "coulomb", "fc_n": 10.0}])
    assert len(longer["specimen"]) == 2
    for copied in (copy.deepcopy(rig["specimen"]), pickle.loads(pickle.dumps(rig["specimen"]))):
        assert copied == rig["specimen"]
        copied[0]["k_n_per_m"] = 1.0
    own = dict(rig["actuator"])
    own["delay_samples"] = 12
    assert rig.with_(actuator=own)["actuator.delay_samples"] == 12
    assert json.loads(json.dumps(rig["actuator"])) == rig["actuator"]


# ---- a rig alone --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["shaking-table-can", "two-axis-frame"])
def test_a_rig_is_checked_alone_as_on_the_command_line(name: str, rthyb: Rthyb) -> None:
    told = json.loads(rthyb("check", "--rig", name, "--json").out)
    for found in (rt.check(rig=name), rt.check(rt.Rig(name)), rt.check(None, rt.Rig(name))):
        assert isinstance(found, rt.RigCheck)
        assert json.loads(json.dumps(found.document)) == told
        assert found.warnings == told["warnings"]
        assert found.notes == told["notes"]
        assert found.table[0][0] in ("Actuator", "Axis upper")
        assert f"RigCheck {name}: no errors" in repr(found)
        assert "<table" in found._repr_html_()


def test_a_rig_that_exists_only_in_python_is_checked_alone() -> None:
    made = rt.Rig("delay-10-elastic").with_(rig={"name": "mine"})
    found = rt.check(rig=made)
    assert found.document["rig_name"] == "mine"
    assert found.document["commissioning"] is None
    with pytest.raises(InputError, match="or only a rig, check"):
        rt.check(None)  # type: ignore[call-overload]


def test_a_rig_file_without_a_stiffness_is_checked_alone(tmp_path: Path) -> None:
    shipped = config.shipped_rig("delay-10-elastic").read_text("utf-8")
    path = tmp_path / "new.toml"
    path.write_text(shipped.replace("elastic_stiffness_n_per_m = 4737410\n", ""), "utf-8")
    assert rt.check(rig=path).document["elastic_stiffness_n_per_m"] is None
