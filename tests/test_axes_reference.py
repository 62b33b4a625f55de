"""The reference simulation in recordings of several axes: every direction, in its unit."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from test_several_axes import conducted, frame

import rthyb_rt as rt
from rthyb_rt.analysis import several_axes
from rthyb_rt.lab import realtime
from rthyb_rt.record import mat_csv, recording, ring, signal_units
from rthyb_rt.record.recording import REFERENCE_UNITS, RecordedTest

FIRST = ("x_ref_m", "v_ref_mps", "f_ref_n")
SECOND = ("x_ref_m_1", "v_ref_mps_1", "f_ref_n_1")


@cache
def storeys() -> RecordedTest:
    return conducted()


@cache
def sway_and_turn() -> RecordedTest:
    return frame(ground_motion__duration_s="1", test__free_vibration_s="0")


def kept(rec: RecordedTest, folder: Path) -> rt.Recording:
    recording.write(folder / "recording.h5", rec)
    return rt.open(folder / "recording.h5")


def older(rec: RecordedTest) -> RecordedTest:
    """The recording as it was written before, with the reference of the first direction only."""
    assert rec.reference is not None
    first = np.zeros(rec.reference.size, [(name, "<f8") for name in FIRST])
    for name in FIRST:
        first[name] = rec.reference[name]
    channels = tuple(
        replace(one, unit={"rad": "m", "N m/rad": "N/m"}.get(one.unit, one.unit))
        for one in rec.channels
    )
    return replace(rec, reference=first, channels=channels)


def test_every_direction_has_its_reference_in_the_recording(tmp_path: Path) -> None:
    rec = kept(storeys(), tmp_path)
    found = several_axes.summarize(rec.raw).signals.reference
    assert found is not None
    for names, j in ((FIRST, 0), (SECOND, 1)):
        for name, values in zip(names, (found.x, found.v, found.force), strict=True):
            seen = rec[name][rec.running]
            assert np.abs(seen - values[:, j]).max() < 1e-12 * np.abs(values[:, j]).max(), name
            assert np.isnan(rec[name][~rec.running]).all()
    assert np.ptp(rec["x_ref_m"] - rec["x_ref_m_1"]) != 0.0
    assert [name for name in rec if "_ref_" in name] == [*FIRST, *SECOND]


def test_a_rotation_is_told_in_rad_wherever_units_are_told(tmp_path: Path) -> None:
    rec = kept(sway_and_turn(), tmp_path)
    wanted = dict(zip(SECOND, ("rad", "rad/s", "N m"), strict=True))
    wanted |= {"x_num_m_1": "rad", "k_t_n_per_m_1": "N m/rad"}
    wanted |= {"dof_turn": "rad", "dof_x": "m", "dof_13": "m"}
    wanted |= {"x_num_m": "m", "k_t_n_per_m": "N/m", "x_cmd_m.1": "m", **REFERENCE_UNITS}
    assert {name: rec.units[name] for name in wanted} == wanted
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "recording.h5") as file:
        told = json.loads(file["samples"].attrs["units"])
        told |= json.loads(file["reference"].attrs["units"])
        channels = {one["name"]: one for one in json.loads(file["samples"].attrs["channels"])}
    assert {name: told[name] for name in wanted} == wanted
    assert channels["x_num_m_1"]["unit"] == "rad"
    io = pytest.importorskip("scipy.io")
    rec.export(tmp_path / "recording.mat")
    mat = io.loadmat(tmp_path / "recording.mat", squeeze_me=True)
    for name in wanted.keys() - {"x_cmd_m.1"}:
        assert mat["units"][name].item() == wanted[name], name
    assert rec.raw.reference is not None
    np.testing.assert_array_equal(mat["x_ref_m_1"], rec.raw.reference["x_ref_m_1"])


def test_the_first_direction_may_turn_as_well(tmp_path: Path) -> None:
    rec = storeys()
    turned = replace(rec, rig_toml='[kinematics]\nkind = "matrix"\nrotations = ["ground-floor"]\n')
    units = signal_units.of_samples(turned) | signal_units.of_reference(turned)
    names = ("x_num_m", "x_num_m_1", "x_ref_m", "x_ref_m_1", "f_ref_n", "f_ref_n_1")
    assert [units[name] for name in names] == ["rad", "m", "rad", "m", "N m", "N"]
    made = ring.Ring.create(tmp_path, turned, capacity=64)
    made.push(turned.samples[:64])
    made.close()
    with ring.RingReader(made.path) as reader:
        told = {field["name"]: field["unit"] for field in reader.about["fields"]}
    assert told | units == units
    assert {told[name] for name in ("x_cmd_m", "x_cmd_m.1", "x_num_m_1")} == {"m"}


def test_a_recording_with_the_reference_of_one_direction_is_reported_as_before(
    tmp_path: Path,
) -> None:
    rec = kept(older(sway_and_turn()), tmp_path)
    now = several_axes.summarize(sway_and_turn())
    assert rec.measures == now.as_json()
    assert [name for name in rec if "_ref_" in name] == list(FIRST)
    assert rec.units["x_num_m_1"] == "rad"
    assert realtime.replay(rec.raw).identical
    with pytest.raises(rt.InputError, match="x_ref_m_1"):
        rec["x_ref_m_1"]


def test_csv_has_the_fields_of_the_samples_and_mat_the_reference_as_well(tmp_path: Path) -> None:
    mat_csv.to_csv(storeys(), tmp_path / "full.csv", full=True)
    with (tmp_path / "full.csv").open(encoding="ascii") as file:
        head = file.readline().rstrip().split(",")
    assert head == ["t_s", *(storeys().samples.dtype.names or ())]
    whosmat = pytest.importorskip("scipy.io").whosmat
    mat_csv.to_mat(storeys(), tmp_path / "recording.mat")
    assert {*FIRST, *SECOND} <= {name for name, _, _ in whosmat(tmp_path / "recording.mat")}


def test_a_recovered_test_keeps_the_reference_of_every_direction(tmp_path: Path) -> None:
    rec = storeys()
    made = ring.Ring.create(tmp_path, rec, capacity=32768)
    made.push(rec.samples)
    made.close()
    found = ring.recover(made.path).recording
    assert found.reference is not None
    assert rec.reference is not None
    assert found.reference.tobytes() == rec.reference.tobytes()
    assert found.channels == rec.channels


def test_with_one_axis_names_and_units_are_those_of_before() -> None:
    raw = rt.run(rt.Test("section5-T0.5", ground_motion={"duration_s": 1})).raw
    assert raw.reference is not None
    assert raw.reference.dtype.names == FIRST
    assert list(signal_units.of_reference(raw).items()) == list(REFERENCE_UNITS.items())
    own = recording.UNITS | {channel.name: channel.unit for channel in raw.channels}
    assert list(signal_units.of_samples(raw).items()) == list(own.items())
