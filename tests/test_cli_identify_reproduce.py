"""`rthyb identify` and `rthyb reproduce` as a lab meets them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Rthyb

import rthyb_rt as rt
from rthyb_rt import config, studies
from rthyb_rt.analysis.spectra import frequency_response
from rthyb_rt.record import recording
from rthyb_rt.studies import inelastic
from rthyb_rt.studies.results import Study

TABLE = "shaking-table-portal-frame"

NO_STIFFNESS = """schema = "rthyb-rig/1"
[rig]
name = "new-rig"
load_cell = "specimen"
[actuator]
kind = "pure-delay"
delay_samples = 12
[[specimen]]
element = "stiffness"
k_n_per_m = 5e5
"""


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, paper: list[Study]) -> None:
    """Let the command take the studies that this test run has already computed."""

    def run(which: str = "all", record: object = None, progress: Any = None) -> list[Study]:
        if progress is not None:
            progress(0, 1, "Section 2.1")
        return [study for study in paper if which in ("all", study.key)]

    monkeypatch.setattr(studies, "run", run)


# --- identify -----------------------------------------------------------------------------------


def test_identify_prints_what_it_found_and_how_to_go_on(rthyb: Rthyb, tmp_path: Path) -> None:
    answer = rthyb("identify", TABLE)
    assert answer.code == 0
    for word in ("frequency, Hz", "17.19", "α with β", "667.8 kN/m", "42.8 kg", "2.00 µm, 4.88 N"):
        assert word in answer.out
    bode, sweep, name = sorted(files(tmp_path))
    assert name.startswith(f"runs/identify-{TABLE}-")
    assert name.endswith("/rig.toml")
    assert (Path(bode).name, Path(sweep).name) == ("bode.svg", "recording.h5")
    assert f"rthyb run TEST.toml --rig {name}" in answer.out
    assert answer.err == ""


def test_sweep_itself_is_kept_and_says_the_same_by_another_way(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    answer = rthyb("identify", "delay-10-elastic", "--out", "found.toml", "--json")
    paths = json.loads(answer.out)["paths"]
    assert paths == {
        "rig": "found.toml", "sweep": "found-recording.h5", "bode": "found-bode.svg"
    }  # fmt: skip
    rec = recording.read(tmp_path / paths["sweep"])
    found = frequency_response(
        rec.samples["x_cmd_m"][rec.running()], rec.samples["x_meas_m"][rec.running()], 1024.0
    )
    assert found is not None
    # Where the sines were: ten samples and a gain of 1, as the least squares of the sweep say; a
    # segment in which a sine begins is not whole cycles, which costs a hundredth.
    for tone in (1.0, 2.0, 4.0, 10.0):
        line = int(np.argmin(np.abs(found.frequency_hz - tone)))
        assert found.gain[line] == pytest.approx(1.0, abs=0.015)
        assert found.delay_s[line] == pytest.approx(10 / 1024, rel=0.05)


def test_bode_plot_has_the_sines_and_the_model_of_the_check() -> None:
    found = rt.identify("first-order-5hz")
    plot = found.plot()
    decibels, phase, late = plot.figure.axes
    model, sines = decibels.get_lines()
    f = np.asarray(model.get_xdata())
    lag = 1 / (1 + 1j * f / 5)
    assert np.asarray(model.get_ydata()) == pytest.approx(20 * np.log10(np.abs(lag)), abs=0.1)
    assert np.asarray(sines.get_ydata()) == pytest.approx(
        [20 * np.log10(tone["gain"]) for tone in found.tones]
    )
    for line in phase.get_lines():
        assert np.asarray(line.get_ydata()).max() < 0
    assert late.get_ylim()[0] > 0
    assert found.recording["x_meas_m"].size > 10 * 1024


def test_bode_plot_of_a_pure_delay_is_not_filled_with_rounding() -> None:
    for axes in rt.identify("delay-10-elastic").plot().figure.axes:
        low, high = axes.get_ylim()
        assert high - low >= 1.0 - 1e-9


def test_identified_rig_runs_a_test(rthyb: Rthyb, tmp_path: Path) -> None:
    assert rthyb("identify", TABLE, "--max-frequency", "3 Hz", "--out", "found.toml").code == 0
    run = ("run", "--rig", "found.toml", "--no-report", "--set", "test.duration_s=3")
    assert rthyb(*run, "--out", "run").code == 0


def test_rig_file_without_stiffness_gets_one(rthyb: Rthyb, tmp_path: Path) -> None:
    given = tmp_path / "new-rig.toml"
    given.write_text(NO_STIFFNESS, encoding="utf-8")
    answer = rthyb("identify", given, "--amplitude", "1 mm", "--out", tmp_path / "done.toml")
    assert answer.code == 0
    found = config.load_rig(tmp_path / "done.toml")
    assert found.rig.elastic_stiffness_n_per_m == pytest.approx(5e5, rel=1e-4)
    assert found.identified is not None
    assert found.identified.delay_s == pytest.approx(12 / 1024, rel=5e-4)
    assert given.read_text(encoding="utf-8") == NO_STIFFNESS


@pytest.mark.long
def test_rig_file_is_replaced_only_when_out_names_it(rthyb: Rthyb, tmp_path: Path) -> None:
    given = tmp_path / "rig.toml"
    given.write_text(NO_STIFFNESS, encoding="utf-8")
    assert rthyb("identify", given, "--max-frequency", "2 Hz").code == 0
    assert given.read_text(encoding="utf-8") == NO_STIFFNESS
    assert rthyb("identify", given, "--max-frequency", "2 Hz", "--out", given).code == 0
    assert config.load_rig(given).identified is not None


def test_identify_with_a_changed_value(rthyb: Rthyb, tmp_path: Path) -> None:
    answer = rthyb(
        "identify", "delay-10-elastic", "--set", "actuator.delay_samples=20", "--json",
        "--set", "rig.rig.name=slow", "--max-frequency", "2 Hz",
    )  # fmt: skip
    found = json.loads(answer.out)
    assert found["schema"] == "rthyb-identify/1"
    assert found["rig_name"] == "slow"
    assert found["delay_s"] * 1024 == pytest.approx(20.0, abs=0.01)
    assert [tone["frequency_hz"] for tone in found["tones"]] == [0.5, 1.0, 1.5, 2.0]
    assert Path(found["paths"]["rig"]).is_file()
    assert "delay, samples" in answer.err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("nowhere.toml",), 3, "one that comes with the program"),
        ((TABLE, "--amplitude", "2 kg"), 2, 'found "2 kg"'),
        ((TABLE, "--amplitude", "0.002"), 2, 'found "0.002", assumed to be in mm'),
        ((TABLE, "--max-frequency", "fast"), 2, "--max-frequency"),
        ((TABLE, "--max-frequency", "300 Hz"), 2, '0.05 Hz to 100 Hz, as in --max-frequency "5'),
        ((TABLE, "--max-frequency", "300"), 2, "must be a frequency from 0.05 Hz to 100 Hz"),
        ((TABLE, "--amplitude", "-1 mm"), 2, 'from 0.01 mm to 1 m, as in --amplitude "1 mm"'),
        ((TABLE, "--amplitude", "0"), 2, "--amplitude"),
        ((TABLE, "--amplitude", "1 km"), 2, 'found "1 km"; must be a length'),
        ((TABLE, "--set", "actuator.kp=3"), 3, "kp_per_s"),
        ((TABLE, "--set", "specimen.0.k_n_per_m=-666400"), 3, "polarity of the load cell"),
        ((), 2, "RIG"),
    ],
)
def test_identify_refuses_with_one_line_and_writes_nothing(
    rthyb: Rthyb, tmp_path: Path, arguments: tuple[str, ...], code: int, message: str
) -> None:
    answer = rthyb("identify", *arguments)
    assert answer.code == code
    assert message in " ".join(answer.err.split())
    assert files(tmp_path) == []


def test_other_faults_of_a_rig_file_without_stiffness_are_named(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    given = tmp_path / "rig.toml"
    given.write_text(NO_STIFFNESS.replace("= 12", "= -1"), encoding="utf-8")
    answer = rthyb("identify", given)
    assert answer.code == 3
    assert "rig.toml:7: actuator.delay_samples" in answer.err
    assert "elastic_stiffness" not in answer.err


def test_file_that_cannot_be_written_is_said(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    answer = rthyb("identify", "delay-10-elastic", "--out", "file/rig.toml")
    assert answer.code == 1
    assert "cannot be written" in answer.err


# --- reproduce ------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.usefixtures("quick")
def test_reproduce_prints_tables_and_says_where_the_page_is(rthyb: Rthyb, tmp_path: Path) -> None:
    answer = rthyb("reproduce")
    assert answer.code == 0
    for word in ("Section 2.1", "Section 4.1", "Section 4.2", "Section 5", "alpha-beta", "✓ 11–13"):
        assert word in answer.out
    results, page = (line.split()[1] for line in answer.out.splitlines()[-2:])
    assert files(tmp_path) == sorted([results, page])
    assert results.startswith("runs/reproduce-")


def test_reproduce_one_section_for_programs(rthyb: Rthyb, tmp_path: Path) -> None:
    answer = rthyb("reproduce", "2.1", "--json", "--out", "here")
    assert answer.code == 0
    found = json.loads(answer.out)
    assert found["schema"] == "rthyb-reproduce/1"
    assert {row["section"] for row in found["rows"]} == {"2.1"}
    assert found["paths"] == {"results": "here/results.json", "page": "here/index.html"}
    assert "10 of 10 accepted bands are met" in answer.err
    assert files(tmp_path) == ["here/index.html", "here/results.json"]


def test_missed_band_is_exit_8_and_the_page_is_there(
    rthyb: Rthyb, tmp_path: Path, paper: list[Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    study = paper[0]
    spoilt = replace(study, rows=(replace(study.rows[0], value=7.0), *study.rows[1:]))
    monkeypatch.setattr(studies, "run", lambda *_: [spoilt])
    answer = rthyb("reproduce", "2.1", "--out", "here")
    assert answer.code == 8
    assert "9 of 10 accepted bands are met" in answer.out
    assert "✗ missed: Section 2.1, Stable regions" in answer.out
    assert files(tmp_path) == ["here/index.html", "here/results.json"]


@pytest.mark.long
def test_section_4_2_without_the_record_says_so(
    rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inelastic, "tcu068", lambda record=None: None)
    answer = rthyb("reproduce", "4.2", "--out", "here")
    assert answer.code == 0
    assert "Note: Run with the built-in El Centro record" in answer.out
    assert "8 of 8 accepted bands are met" in answer.out


@pytest.mark.long
def test_record_file_is_used(rthyb: Rthyb, tmp_path: Path) -> None:
    motion = inelastic.tcu068()
    if motion is None:
        pytest.skip("TCU068 is in the package pyslammer")
    rows = "".join(
        f"{t:.3f},{a:.9g}\n" for t, a in zip(motion.time_s, motion.acceleration_mps2, strict=True)
    )
    (tmp_path / "tcu068.csv").write_text("time (s),acceleration (m/s2)\n" + rows, encoding="utf-8")
    answer = rthyb("reproduce", "4.2", "--record", "tcu068.csv", "--out", "here", "--json")
    assert answer.code == 0
    assert json.loads(answer.out)["sections"][0]["bands"] == 21


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("4.3",), 2, "'2.1', '4.1', '4.2', '5', 'all'"),
        (("5", "--record", "tcu068.csv"), 2, "applies only to Section 4.2"),
        (("4.2", "--record", "nowhere.csv"), 3, "nowhere.csv: no such file"),
        (("2.1", "--out", "."), 2, "already exists"),
    ],
)
def test_reproduce_refuses_and_writes_nothing(
    rthyb: Rthyb, tmp_path: Path, arguments: tuple[str, ...], code: int, message: str
) -> None:
    answer = rthyb("reproduce", *arguments)
    assert answer.code == code
    assert message in " ".join(answer.err.split())
    assert files(tmp_path) == []


def test_without_the_report_packages_the_results_are_written_all_the_same(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.delitem(sys.modules, "rthyb_rt.studies.studies_figures", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    answer = rthyb("reproduce", "2.1", "--out", "here", "--json")
    assert answer.code == 0
    assert "no page was written" in answer.err
    assert "pip install 'rthyb-rt[report]'" in answer.err
    assert json.loads(answer.out)["paths"] == {"results": "here/results.json"}
    assert files(tmp_path) == ["here/results.json"]


@pytest.mark.parametrize("command", ["identify", "reproduce"])
def test_help_has_an_example(rthyb: Rthyb, command: str) -> None:
    answer = rthyb(command, "--help")
    assert answer.code == 0
    assert f"  rthyb {command}" in answer.out


def test_identify_takes_the_velocity_of_the_fast_sines(rthyb: Rthyb, tmp_path: Path) -> None:
    out = str(tmp_path / "rig.toml")
    answer = rthyb(
        "identify", "delay-10-elastic", "--max-frequency", "8 Hz", "--max-velocity", "30", "--out",
        out,
    )  # fmt: skip
    assert answer.code == 0, answer.err
    assert "so that no sine is faster than 30 mm/s" in answer.out
    refused = rthyb("identify", "delay-10-elastic", "--max-velocity", "11 m/s")
    assert refused.code == 2
    assert "a velocity from 0.1 mm/s to 10 m/s" in " ".join(refused.err.split())
