"""`rthyb check --rig RIG`: a rig file alone, before there is a test."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import Rthyb
from test_axes_files import with_plant
from test_config_link import CAN, RIG
from test_sensors_in_real_time import DEFAULTS as WITH_SENSORS

from rthyb_rt import config
from rthyb_rt.config import RigFile

NEW = RIG.replace("elastic_stiffness_n_per_m = 666400\n", "") + CAN + "bitrate = 1_000_000\n"


@pytest.fixture
def new(tmp_path: Path) -> Path:
    """A rig as a laboratory first writes it down: nothing measured, no limits."""
    path = tmp_path / "new.toml"
    path.write_text(NEW, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", config.shipped("rig"))
def test_a_shipped_rig_says_what_its_file_says(rthyb: Rthyb, name: str) -> None:
    answer = rthyb("check", "--rig", name, "--json")
    assert answer.code == 0, answer.err
    found, rig = json.loads(answer.out), config.load_any_rig(config.find_rig(name))
    assert (found["schema"], found["ok"]) == ("rthyb-check-rig/1", True)
    assert found["rig_name"] == name
    views = {"": rig} if isinstance(rig, RigFile) else {n: rig.of_axis(n) for n in rig.names}
    for axis, view in views.items():
        said = found["axes"][axis] if axis else found
        assert said["actuator"] == view.actuator.kind
        assert view.identified is not None
        assert said["identified"]["alpha"] == view.identified.alpha
        k_e = view.rig.elastic_stiffness_n_per_m
        assert said["elastic_stiffness_n_per_m"] == pytest.approx(k_e, rel=1e-9)
        position = view.limits.command_position_m
        assert [
            limit["value"] for limit in said["limits"] if limit["key"] == "command_position_m"
        ] == ([] if position is None else [position.value])
        assert (said["link"] is None) == (view.link is None)
        short = max(view.identified.frequency_hz) < 80
        where = f"axis {axis}: the response is known up to" if axis else "the response is known up"
        assert any(note.startswith(where) for note in found["notes"]) == short


def test_a_rig_whose_axes_share_a_linear_plant_is_not_called_a_delay(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(
        with_plant("a = [[0, 0], [0, -40]]\nb = [[1, 0], [0, 1]]\nc = [[1, 0], [0, 1]]")
    )
    answer = rthyb("check", "--rig", str(path))
    assert answer.code == 0, answer.err
    assert answer.out.count("[plant]: one linear model of 2 states for all axes") == 2
    assert "pure-delay" not in answer.out
    assert "poles that neither decay nor grow (0 Hz)" in answer.out
    path.write_text(
        with_plant("a = [[1, 0], [0, -40]]\nb = [[1, 0], [0, 1]]\nc = [[1, 0], [0, 1]]")
    )
    refused = rthyb("check", "--rig", str(path))
    assert refused.code == 3
    assert "found a pole at 1 per second" in refused.err


def test_a_rig_that_nobody_has_measured_is_told_what_comes_next(rthyb: Rthyb, new: Path) -> None:
    answer = rthyb("check", "--rig", new)
    assert answer.code == 0, answer.err
    assert answer.out.startswith("spring: no errors found")
    lines = {line.split("  ")[0]: line for line in answer.out.splitlines()}
    assert "not identified" in lines["Elastic stiffness"]
    assert lines["Identified"].split() == ["Identified", "no"]
    assert "can0, CAN, 1000000 bit/s" in lines["Link"]
    assert "41.5 %" in lines["Bus load"]
    assert "Warning: a test in real time will be refused: this rig has not been comm" in answer.out
    both = "does not state limits.command_position_m and limits.force_n: `rthyb jog` and `rthyb"
    assert both in answer.out
    assert "Note: nothing is identified: run `rthyb identify RIG`" in answer.out


def test_a_stated_limit_is_no_longer_missing(rthyb: Rthyb, new: Path) -> None:
    answer = rthyb("check", "--rig", new, "--set", 'rig.limits.force_n="20 kN"')
    assert "force_n            20000 N, trip" in answer.out
    assert "does not state limits.command_position_m: " in answer.out


def test_an_old_identification_without_a_sweep_asks_for_one(rthyb: Rthyb, new: Path) -> None:
    old = "[identified]\nalpha = 10.0\ndelay_s = 0.0098\n"
    new.write_text(NEW + old, encoding="utf-8")
    answer = rthyb("check", "--rig", new)
    assert "10 samples (9.77 ms)" in answer.out
    assert "Note: no frequency response is identified" in answer.out
    assert 'rthyb identify RIG --max-frequency "80 Hz"' in answer.out


def test_sensors_without_an_actuator_are_listed_with_range_and_channel(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(WITH_SENSORS, encoding="utf-8")
    answer = rthyb("check", "--rig", path)
    assert answer.code == 0, answer.err
    lines = {line.split("  ")[0]: line.split("  ", 1)[1].strip() for line in
             answer.out.splitlines() if line.startswith("Sensor ")}  # fmt: skip
    assert lines["Sensor column"].startswith("force, range 70.0 kN ")
    assert lines["Sensor column"].endswith("channel cell of axis left")
    assert lines["Sensor wire"].startswith("displacement, range 80.0 mm ")
    assert json.loads(rthyb("check", "--rig", path, "--json").out)["sensors"] == ["wire", "column"]


WRONG = {
    "a key": ("rig.limits.force=3", "limits.force: unknown key"),
    "a value": ("rig.actuator.delay_samples=-1", "delay_samples: found -1"),
    "a key of a test": ("controller.w1=3", "controller.w1: belongs to a test"),
    "a range that no frame carries": ('rig.sensors.force.range_n="5 MN"', "only up to 2147.48 kN"),
}


@pytest.mark.parametrize("what", WRONG)
def test_errors_of_the_file_are_told_as_with_a_test(rthyb: Rthyb, new: Path, what: str) -> None:
    setting, said = WRONG[what]
    answer = rthyb("check", "--rig", new, "--set", setting)
    assert answer.code == 3
    assert said in answer.err
    assert not answer.out


def test_values_that_only_the_core_refuses_are_told(rthyb: Rthyb) -> None:
    stiff = ("--set", "rig.actuator.substeps=1", "--set", "rig.actuator.moving_mass_kg=1")
    answer = rthyb("check", "--rig", "hydraulic-25kn", *stiff)
    assert answer.code == 3
    assert "substeps" in answer.err


def test_neither_a_test_nor_a_rig_is_a_question(rthyb: Rthyb) -> None:
    answer = rthyb("check")
    assert answer.code == 2
    assert "give a test, or only a rig with --rig RIG.toml" in answer.err


def test_figures_need_a_test(rthyb: Rthyb, tmp_path: Path) -> None:
    answer = rthyb("check", "--rig", "hydraulic-25kn", "--plot", tmp_path / "page.html")
    assert answer.code == 2
    assert "give TEST.toml too" in answer.err
    assert not list(tmp_path.iterdir())


def test_settings_of_a_test_are_refused_where_only_a_rig_is_checked(rthyb: Rthyb) -> None:
    rig = ("check", "--rig", "rths-benchmark")
    settings = ("--set", "controller.type=ats", "--set", "numerical.period_s=1")
    answer = rthyb(*rig, *settings)
    assert answer.code == 3
    assert answer.err.splitlines() == [
        f"rthyb: --set {key}: belongs to a test, and without a test only the rig is checked; give "
        "TEST.toml as well, or leave this setting out"
        for key in ("controller.type", "numerical.period_s")
    ]
    # A key that no file has is still told as such.
    assert "unknown key" in rthyb(*rig, "--set", "specimens=1").err
    assert rthyb(*rig, "--set", "rig.actuator.gain=1.02").code == 0
