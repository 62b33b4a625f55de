"""Tests on several axes from Python: run, read, and what is of one axis alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_axes_realtime import AXES, LIMITED, SHORT

import rthyb_rt as rt
from rthyb_rt.analysis import several
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
    assert rec.verdict == several.verdict(several.summarize(rec.raw))
    assert any(label.startswith("Axis right") for label, _, _ in rec.table)
    assert "axes left, right" in repr(rec)
    for name in AXES:
        peak = float(np.abs(rec.axis(name)["x_meas_m"][rec.running]).max())
        assert rec.measures["axes"][name]["peak_measured_m"] == pytest.approx(peak)


def test_what_was_kept_is_opened_as_it_was(rig: rt.Rig, rec: rt.Recording, tmp_path: Path) -> None:
    again = rt.open(rec.save(tmp_path / "recording.h5"))
    assert again.measures == rec.measures
    assert again.rig == rec.rig
    assert again.rig["axis.1.name"] == "right"
    rec.report(tmp_path / "report.html")
    assert (tmp_path / "report.html").stat().st_size > 10_000


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


def test_what_is_of_one_axis_says_so(rig: rt.Rig, rec: rt.Recording, tmp_path: Path) -> None:
    for call in (
        lambda: rt.check(rt.Test.from_toml(SHORT), rig),
        lambda: rt.identify(rig),
        lambda: rec.summary,
        rec.plot.tracking,
        lambda: rec.export(tmp_path / "one.csv"),
    ):
        with pytest.raises(InputError, match=r"axes \(?left, right"):
            call()
