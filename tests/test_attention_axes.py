"""A test of several axes that went wrong is told so: in table, report and live view."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from test_attention import told_live
from test_axes_tests import RIG
from test_several_axes import SHORT, conducted

from rthyb_rt import config
from rthyb_rt.analysis import several_axes
from rthyb_rt.analysis.attention import RESPONSE_OFF, AxesJudge
from rthyb_rt.lab import axes_experiment, virtual_time
from rthyb_rt.live.sources import PastSource
from rthyb_rt.record.recording import RecordedTest

EXAMPLE = Path(__file__).parents[1] / "examples" / "two-actuator-frame.toml"
DEPARTED = "departed from the reference simulation"


DAMPED = SHORT.replace("ratio = 0.02", "ratio = 0.2")
"""So much that the delay alone does not make it unstable."""


@cache
def bare() -> RecordedTest:
    return conducted(DAMPED.replace('"paper"', '"none"'))


@cache
def good() -> RecordedTest:
    return conducted(DAMPED)


def alarms(rec: RecordedTest) -> list[str]:
    told = several_axes.notices(several_axes.summarize(rec))
    return [notice.text for notice in told if notice.level == "alarm"]


def test_axes_without_compensation_are_told_by_name_with_the_key_to_change() -> None:
    told = alarms(bare())
    assert [text.split(DEPARTED)[0] for text in told] == ["Axis left ", "Axis right "]
    assert all('set controller.type = "matrix"' in text for text in told)
    assert alarms(good()) == []


def test_what_is_told_is_the_worst_two_seconds_of_the_axis() -> None:
    rec = bare()
    s = several_axes.summarize(rec)
    for i, (name, one) in enumerate(s.attention):
        assert name == rec.axis_names[i]
        rows = slice(round(one.from_s * rec.fs_hz), round(one.to_s * rec.fs_hz))
        wanted = s.signals.reference.axis_m[rows, i]
        off = s.signals.measured_m[rows, i] - wanted
        ratio = np.sqrt(np.sum(off**2) / np.sum(wanted**2))
        assert one.value == pytest.approx(ratio, rel=1e-9)
        assert one.to_s - one.from_s == 2.0
        assert one.value > RESPONSE_OFF


def test_the_noise_of_an_axis_at_rest_is_not_judged() -> None:
    fs_hz, n = 1024.0, 8192
    time_s = np.arange(n) / fs_hz
    wanted = np.column_stack([1e-2 * np.sin(2 * np.pi * time_s), 1e-6 * np.sin(time_s)])
    rows = np.zeros(n, dtype=[("x_meas_m", float), ("x_meas_m.1", float)])
    rows["x_meas_m"] = wanted[:, 0]
    rows["x_meas_m.1"] = np.random.default_rng(1).normal(0.0, 1e-5, n)
    judge = AxesJudge(("moves", "rests"), fs_hz, 1e-2)
    judge.add(rows, wanted)
    assert judge.findings() == []
    rows["x_meas_m"] *= 0.7
    judge = AxesJudge(("moves", "rests"), fs_hz, 1e-2)
    judge.add(rows, wanted)
    assert [(name, round(one.value, 6)) for name, one in judge.findings()] == [("moves", 0.3)]


def test_commands_that_a_limit_reduced_are_told() -> None:
    rig = RIG.replace(
        'limits = { command_position_m = "20 mm" }',
        'limits = { command_position_m = "20 mm", command_acceleration_m_per_s2 = 2 }',
    )
    rec = conducted(SHORT, rig)
    limited = several_axes.summarize(rec).flags["limited"]
    assert limited > 0
    text = f"{limited} samples of {18 * 1024}"
    assert any(one.startswith(text) and "reduced by a limit" in one for one in alarms(rec))


@pytest.mark.long
def test_the_live_view_says_of_a_running_test_which_axis_does_not_follow(tmp_path: Path) -> None:
    whole = told_live(bare(), 18.0, tmp_path)
    assert [text.split(DEPARTED)[0] for text in whole] == ["Axis left ", "Axis right "]
    assert told_live(bare(), 1.0, tmp_path) == []
    for seconds in (3.0, 10.0, 18.0):
        assert told_live(good(), seconds, tmp_path) == [], seconds
    assert PastSource(bare()).status()["attention"] == alarms(bare())


@pytest.mark.long
def test_the_report_of_several_axes_begins_with_what_must_not_be_missed() -> None:
    pytest.importorskip("matplotlib")
    from rthyb_rt.report.axes_report import render

    page = render(bare())
    assert page.index("Axis left departed") < page.index('class="sentence"')
    assert "completed, see Attention" in page
    assert '<span class="state good">completed</span>' in render(good())


def test_the_document_of_a_run_has_the_axes_that_did_not_follow() -> None:
    told = several_axes.summarize(bare()).as_json()["attention"]
    assert [one["axis"] for one in told] == ["left", "right"]
    assert set(told[0]) == {"axis", "kind", "value", "allowed", "from_s", "to_s"}


@pytest.mark.long
def test_the_shipped_frame_of_two_actuators_follows_its_reference() -> None:
    """Its limits once reduced 98 % of the commands, and the lower axis was 26 % off."""
    test = config.load_test(EXAMPLE, {})
    rig = config.load_any_rig(config.find_rig(test.rig))
    assert isinstance(rig, config.AxesRig)
    s = several_axes.summarize(virtual_time.run(axes_experiment.prepare(test, rig)))
    assert s.attention == ()
    assert s.flags["limited"] < 0.02 * s.rows
    assert [one.tracking_nrmse < 0.03 for one in s.axes] == [True, True]
