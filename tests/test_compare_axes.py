"""Tests on several axes compared: one axis of each, by its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from test_axes_realtime import AXES, EITHER, LIMITED, SHORT

import rthyb_rt as rt
from rthyb_rt.errors import InputError


@pytest.fixture(scope="module")
def both() -> tuple[rt.Recording, rt.Recording]:
    """A test at two amplitudes."""
    test = rt.Test.from_toml(SHORT, rt.Rig.from_toml(LIMITED)).with_({"test.duration_s": 2})
    return rt.run(test), rt.run(test.with_({"ground_motion.pga_g": 0.04}))


@EITHER
def test_an_axis_has_its_own_figures_and_differences(
    both: tuple[rt.Recording, rt.Recording], axis: str
) -> None:
    found = rt.compare(*both, axis=axis)
    assert found.labels == [f"two, axis {axis}", f"two, axis {axis} (2)"]
    for row, rec in zip(found.rows, both, strict=True):
        own = rec.measures["axes"][axis]
        for name in ("tracking_nrmse", "peak_command_m", "peak_measured_m", "peak_force_n"):
            assert row[name] == own[name]
        assert row["energy_error_relative"] is None
    first, second = (rec.axis(axis)["x_meas_m"][rec.running] for rec in both)
    wanted = np.sqrt(np.mean((second - first) ** 2) / np.mean(first**2))
    assert found.rows[1]["x_difference_nrmse"] == pytest.approx(wanted, rel=1e-6)


def test_one_recording_is_compared_with_the_reference_of_the_axis(
    both: tuple[rt.Recording, rt.Recording],
) -> None:
    """Of a matrix of rows (1, 0) and (1, 1), the left axis is the ground floor itself."""
    found = rt.compare(both[0], axis="left")
    response = both[0].measures["directions"]["ground-floor"]["response_nrmse"]
    assert found.rows[1]["response_nrmse"] == pytest.approx(response, rel=1e-9)
    assert found.rows[1]["x_difference_nrmse"] == pytest.approx(response, rel=1e-6)


def test_rthyb_compare_asks_for_an_axis_and_knows_their_names(
    rthyb: Rthyb, both: tuple[rt.Recording, rt.Recording], tmp_path: Path
) -> None:
    rec = both[0].save(tmp_path / "run" / "recording.h5")
    (tmp_path / "rig.toml").write_text(LIMITED, encoding="utf-8")
    test = tmp_path / "test.toml"
    test.write_text(SHORT.replace('rig = "none"', 'rig = "rig.toml"'), encoding="utf-8")
    for what in (rec, test):
        asked = rthyb("compare", rec, what)
        assert asked.code == 3
        assert f"has several axes ({', '.join(AXES)}); choose the one to compare" in asked.err
    wrong = rthyb("compare", rec, "--axis", "middle")
    assert wrong.code == 3
    assert "found --axis middle; the axes are left, right" in wrong.err
    done = rthyb("compare", rec, test, "--axis", "right", "--out", tmp_path / "out", "--json")
    assert done.code == 0, done.err
    labels = [row["label"] for row in done.json["rows"]]  # type: ignore[attr-defined]
    assert labels == ["run, axis right", "two, axis right, reference simulation"]
    assert (tmp_path / "out" / "compare.csv").exists()


def test_an_axis_of_nothing_that_has_several_is_refused() -> None:
    short = rt.Test("section5-T0.5", ground_motion={"duration_s": 1})
    with pytest.raises(
        InputError, match="found upper, but none of the recordings has several axes"
    ):
        rt.compare(rt.run(short), axis="upper")


def test_a_misspelt_axis_is_told_in_the_words_of_python_and_of_the_command_line(
    rthyb: Rthyb, both: tuple[rt.Recording, rt.Recording], tmp_path: Path
) -> None:
    rec = both[0].save(tmp_path / "run" / "recording.h5")
    with pytest.raises(InputError, match=r'found axis="rihgt" \(did you mean "right"\?\)'):
        rt.compare(rec, axis="rihgt")
    told = rthyb("compare", rec, "--axis", "rihgt").err
    assert 'found --axis rihgt (did you mean "right"?); the axes are left, right' in told
