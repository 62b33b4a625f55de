"""Rows of a recording by axis and by channel: from the core through ring and file, and back."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import Rthyb
from recording_data import recording as made_up
from scipy.io import loadmat

from rthyb_rt import config, core
from rthyb_rt.analysis import summary
from rthyb_rt.core import CHANNELS_MAX, Channel
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.lab import virtual_time as virtual
from rthyb_rt.lab.realtime import station_replay
from rthyb_rt.live.sources import PastSource
from rthyb_rt.record import mat_csv, recording, ring
from rthyb_rt.record.recording import AXIS_FIELDS, RecordedTest
from rthyb_rt.report import render
from rthyb_rt.service.growing import GrowingFile

STORED = Path(__file__).parent / "data" / "recordings"
EXAMPLE = Path(__file__).parents[1] / "examples" / "section5-T0.5.toml"
ACCELEROMETER = Channel("a_frame_mps2", "m/s^2", 0.5)
OIL = Channel("oil_k", "K")
OWN = set(core.RECORD_DTYPE.names or ())


def with_channels(count: int = 256) -> RecordedTest:
    """A recording whose rows have two channels, each with numbers of its own."""
    rec = made_up(count / 1024)
    n = np.arange(count, dtype=np.float64)
    values = np.stack([2.0 * n, 290.0 + n], axis=-1)
    channels = (ACCELEROMETER, OIL)
    rows = core.rows_of(core.as_records(rec.samples), channels, values)
    return dataclasses.replace(rec, samples=rows, channels=channels)


def same(found: np.ndarray, wanted: np.ndarray) -> bool:
    names = wanted.dtype.names or ()
    return found.dtype.names == names and all(
        found[name].tobytes() == wanted[name].tobytes() for name in names
    )


def set_up(changes: dict[str, str]) -> experiment.Setup:
    test = config.load_test(EXAMPLE, {"test.duration_s": "2", "ground_motion.start_s": "2"})
    rig = config.load_rig(config.find_rig(test.rig), changes)
    return experiment.prepare(test, rig)


# ---- a block per axis ---------------------------------------------------------------------------


def test_an_axis_is_read_by_its_number() -> None:
    rec = made_up(0.25)
    axis = rec.axis(0)
    assert axis.dtype.names == AXIS_FIELDS
    np.testing.assert_array_equal(axis["x_meas_m"], rec.samples["x_meas_m"])
    with pytest.raises(InputError, match="no axis 1; the test ran on a single axis"):
        rec.axis(1)


def test_core_and_axes_make_up_the_record() -> None:
    """Declared once, in the header: offsets of the axis are those of its own struct."""
    fields = core.RECORD_DTYPE.fields or {}
    axis = core.dtype_of("rthyb_axis_record")
    first = min(fields[name][1] for name in AXIS_FIELDS)
    assert set(axis.names or ()) == set(AXIS_FIELDS)
    for name, (kind, at) in ((n, f[:2]) for n, f in (axis.fields or {}).items()):
        assert fields[name][:2] == (kind, first + at)
    assert max(fields[name][1] for name in OWN - set(AXIS_FIELDS)) < first


def test_a_file_says_which_fields_are_of_an_axis_and_what_its_channels_are(tmp_path: Path) -> None:
    recording.write(tmp_path / "recording.h5", with_channels())
    with h5py.File(tmp_path / "recording.h5") as file:
        told = {name: recording.plain(v) for name, v in file["samples"].attrs.items()}
    assert told["axes"] == [list(AXIS_FIELDS)]
    assert told["channels"] == [
        {"name": "a_frame_mps2", "unit": "m/s^2", "scale": 0.5},
        {"name": "oil_k", "unit": "K", "scale": 1.0},
    ]
    assert told["units"]["oil_k"] == "K"


def test_the_samples_without_a_pair_are_counted_in_the_record() -> None:
    """As many in a row as the flags say; recordings of before have the same number."""
    station = core.Station(experiment.station_config(set_up({})), np.zeros(8))
    lost = [False, True, True, False, False, True, True, True]
    rows = np.concatenate([station.tick(lost=one).records for one in lost])
    assert rows["missing"].tolist() == [0, 1, 2, 0, 0, 1, 2, 3]
    rec = recording.read(STORED / "version-2-faults.h5")
    again, *_ = station_replay._rerun(rec)
    np.testing.assert_array_equal(rec.samples["missing"], again["missing"])
    assert rec.samples["missing"].max() >= 1


def test_the_cause_of_a_trip_is_in_its_row() -> None:
    setup = set_up({})
    station = core.Station(experiment.station_config(setup), setup.ag_mps2)
    station.tick(command="zero")
    while station.state != "ZEROED":
        rows = station.tick().records
    assert set(rows["cause"]) == {0}
    while station.state != "TRIPPED":
        rows = station.tick(lost=True).records
    assert core.CAUSES[rows["cause"][-1]] == "link_lost"


# ---- channels, there and back -------------------------------------------------------------------


def test_channels_come_back_from_the_file_with_unit_and_scale(tmp_path: Path) -> None:
    rec = with_channels()
    recording.write(tmp_path / "recording.h5", rec)
    back = recording.read(tmp_path / "recording.h5")
    assert back.channels == (ACCELEROMETER, OIL)
    assert same(back.samples, rec.samples)
    np.testing.assert_array_equal(back.channel("a_frame_mps2"), np.arange(256.0))
    np.testing.assert_array_equal(back.channel("oil_k"), 290 + np.arange(256.0))
    with pytest.raises(InputError, match="no channel 'oil_c'; channels are: a_frame_mps2, oil_k"):
        back.channel("oil_c")
    with pytest.raises(InputError, match="channels are: none"):
        made_up(0.25).channel("oil_k")


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["version-1-virtual", "version-1-stepped", "version-2-virtual", "version-2-stepped"]
)
def test_a_channel_more_leaves_recordings_of_every_version_readable(
    name: str, tmp_path: Path
) -> None:
    """A file of before, and the same with a channel beside its fields: nothing else changes."""
    plain = recording.read(STORED / f"{name}.h5")
    assert plain.channels == ()
    assert set(plain.samples.dtype.names or ()) == OWN
    path = tmp_path / "recording.h5"
    path.write_bytes((STORED / f"{name}.h5").read_bytes())
    with h5py.File(path, "a") as file:
        rows, attributes = file["samples"][()], dict(file["samples"].attrs)
        wider = np.zeros(rows.size, [*rows.dtype.descr, ("oil_k", "<f8")])
        for field in rows.dtype.names:
            wider[field] = rows[field]
        wider["oil_k"] = 293.0
        del file["samples"]
        table = file.create_dataset("samples", data=wider)
        table.attrs.update(attributes)
        table.attrs["channels"] = '[{"name": "oil_k", "unit": "K", "scale": 1.0}]'
    rec = recording.read(path)
    assert rec.channels == (OIL,)
    assert set(rec.channel("oil_k")) == {293.0}
    for field in OWN:
        assert rec.samples[field].tobytes() == plain.samples[field].tobytes()
    assert summary.summarize(rec).as_json() == summary.summarize(plain).as_json()
    assert render(rec) == render(plain)


@pytest.mark.parametrize(
    "told", ["", "no json", "[1, 2]", '{"name": "oil_k"}', '[{"name": "gone"}]', '[{"unit": "K"}]']
)
def test_a_table_of_channels_that_makes_no_sense_costs_the_channels_alone(
    told: str, tmp_path: Path
) -> None:
    rec = with_channels()
    recording.write(tmp_path / "recording.h5", rec)
    with h5py.File(tmp_path / "recording.h5", "a") as file:
        file["samples"].attrs["channels"] = told
    back = recording.read(tmp_path / "recording.h5")
    assert back.channels == ()
    assert same(back.samples, rec.samples)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ([Channel("x_num_m", "m")], "a field of this name"),
        ([OIL, OIL], "a field of this name"),
        ([Channel("Oil", "K")], "starts with a letter"),
        ([Channel("", "K")], "starts with a letter"),
        ([Channel("a" * 33, "K")], "starts with a letter"),
        ([Channel("oil.1", "K")], "starts with a letter"),
        ([Channel("oil", "K", 0.0)], "not a valid factor"),
        ([Channel("oil", "K", float("nan"))], "not a valid factor"),
        ([Channel("oil", "K", float("inf"))], "not a valid factor"),
        ([Channel(f"c{n}", "1") for n in range(65)], "room for 64"),
    ],
)
def test_channels_that_no_row_can_have_are_refused(channels: list[Channel], message: str) -> None:
    with pytest.raises(core.CoreError, match=message):
        core.row_dtype(channels)


def test_a_row_has_room_for_64_channels() -> None:
    assert CHANNELS_MAX == core.CHANNELS_MAX == 64
    dtype = core.row_dtype([Channel(f"c{n}", "1") for n in range(64)])
    assert dtype.itemsize == core.RECORD_DTYPE.itemsize + 64 * 8


def test_channels_are_exported_in_their_unit(tmp_path: Path) -> None:
    rec = with_channels()
    mat_csv.to_csv(rec, tmp_path / "full.csv", full=True)
    table = np.genfromtxt(tmp_path / "full.csv", delimiter=",", names=True)
    mat_csv.to_mat(rec, tmp_path / "recording.mat")
    mat = loadmat(tmp_path / "recording.mat", squeeze_me=True, simplify_cells=True)
    for found in (table, mat):
        np.testing.assert_array_equal(found["a_frame_mps2"], np.arange(256.0))
        np.testing.assert_array_equal(found["f_meas_n"], rec.samples["f_meas_n"])
    assert mat["units"]["a_frame_mps2"] == "m/s^2"


# ---- through the ring ---------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 2, 32])
def test_rows_with_channels_go_through_the_ring_and_are_recovered(
    count: int, tmp_path: Path
) -> None:
    rec = made_up(300 / 1024)
    channels = tuple(Channel(f"c{n}", "1", 2.0) for n in range(count))
    values = np.random.default_rng(1).standard_normal((300, count))
    rows = core.rows_of(core.as_records(rec.samples), channels, values)
    session = dataclasses.replace(rec, samples=rows[:0], channels=channels)
    made = ring.Ring.create(tmp_path, session, capacity=512)
    made.push(rows)
    with ring.RingReader(made.path) as reader:
        assert reader.about["channels"] == [dataclasses.asdict(one) for one in channels]
        assert reader.dtype == core.row_dtype(channels)
        newest = reader.newest()
        assert newest is not None
        assert newest.tobytes() == rows[-1].tobytes()
    found = ring.recover(made.path).recording
    made.remove()
    assert found.channels == channels
    assert same(found.samples, rows)


def test_a_record_whose_channels_nobody_knows_has_none(tmp_path: Path) -> None:
    rec = with_channels()
    made = ring.Ring.create(tmp_path, dataclasses.replace(rec, samples=rec.samples[:0]), 256)
    made.push(core.as_records(rec.samples))
    with ring.RingReader(made.path) as reader:
        rows = reader.read().samples
    made.remove()
    assert np.isnan(rows["oil_k"]).all()
    assert rows["x_meas_m"].tobytes() == rec.samples["x_meas_m"].tobytes()


def test_a_frozen_ring_shows_the_channels_of_its_newest_row(tmp_path: Path) -> None:
    rec = with_channels()
    made = ring.Ring.create(tmp_path, dataclasses.replace(rec, samples=rec.samples[:0]), 256)
    tripped = np.tile(rec.samples, 30)
    tripped["state"] = core.STATES.index("TRIPPED")
    tripped["oil_k"] = np.arange(tripped.size)
    made.push(tripped)
    with ring.RingReader(made.path) as reader:
        assert reader.frozen
        newest = reader.newest()
        assert newest is not None
        assert newest["oil_k"] == tripped.size - 1
    made.remove()


def test_a_recording_that_grows_has_channels_and_is_taken_up_with_them(tmp_path: Path) -> None:
    rec = with_channels(256)
    bare = dataclasses.replace(rec, samples=rec.samples[:0], meta=rec.meta)
    file = GrowingFile(tmp_path, bare)
    file.add(rec.samples[:128])
    file.close()
    again = GrowingFile(tmp_path, bare)
    assert again.resumed
    again.add(rec.samples[128:])
    again.close()
    found = recording.read(tmp_path / "recording.part.h5")
    assert found.channels == rec.channels
    assert same(found.samples, rec.samples)


# ---- from the core ------------------------------------------------------------------------------


@pytest.mark.long
def test_the_truth_of_a_virtual_rig_is_recorded_beside_what_its_sensors_say(
    tmp_path: Path, rthyb: Rthyb
) -> None:
    noisy = {
        "rig.sensors.displacement.noise_std_m": "1e-5",
        "rig.sensors.force.noise_std_n": "20",
        "rig.sensors.displacement.bias_m": "1e-4",
    }
    setup = set_up(noisy)
    plain, rec = virtual.run(setup), virtual.run(setup, truth=True)
    for name in OWN:
        assert rec.samples[name].tobytes() == plain.samples[name].tobytes()
    assert [one.name for one in rec.channels] == ["x_true_m", "f_true_n"]
    run = rec.running()
    off = rec.samples["x_read_m"] - rec.channel("x_true_m")
    assert np.std(off[run]) == pytest.approx(1e-5, rel=0.1)
    assert np.mean(off[run]) == pytest.approx(1e-4, rel=0.02)
    noise = rec.samples["f_read_n"] - rec.channel("f_true_n")
    assert np.std(noise[run]) == pytest.approx(20, rel=0.1)
    recording.write(tmp_path / "recording.h5", rec)
    back = recording.read(tmp_path / "recording.h5")
    assert realtime.replay(back).identical
    assert PastSource(back).status()["test"] == "section5-t0.5"
    (tmp_path / "rig.toml").write_text(rec.rig_toml, encoding="utf-8")
    for command in (
        ("replay", tmp_path / "recording.h5"),
        ("report", tmp_path / "recording.h5"),
        ("export", tmp_path / "recording.h5", "--csv", "--out", tmp_path / "rows.csv"),
        ("diagnose", tmp_path / "recording.h5", "--model", tmp_path / "rig.toml"),
    ):
        answer = rthyb(*command)
        assert answer.code == 0, answer.err


def test_a_loop_records_what_its_station_has_in_its_channels(tmp_path: Path) -> None:
    """Skipped ticks have none: nobody was there."""
    setup = dataclasses.replace(set_up({}), channels=(OIL,))
    assert experiment.blank(setup, "virtual").samples.dtype == core.row_dtype((OIL,))
    test = core.Virtual(
        core.Station(experiment.station_config(setup), setup.ag_mps2),
        core.VirtualRig(setup.virtual_rig),
    )
    test.station._c.channel[0] = 293.0
    rows, values = np.zeros(8, core.RECORD_DTYPE), np.zeros((8, 1))
    assert test.run(rows, "none", values) == 8
    assert set(values[:, 0]) == {293.0}
    for wrong in (np.zeros((7, 1)), np.zeros((8, 65))):
        with pytest.raises(core.CoreError, match="one row for each record"):
            test.run(rows, "none", wrong)


# ---- what the control law reports ----------------------------------------------------------------


def run_with(law: str, **options: bool) -> recording.RecordedTest:
    test, rig = config.load_both(None, None, [f"controller.type={law}", "test.duration_s=4"])
    return virtual.run(experiment.prepare(test, rig), **options)


def test_what_a_law_learns_beside_alpha_and_beta_stands_in_the_recording() -> None:
    rec = run_with("ats")
    assert [(one.name, one.unit) for one in rec.channels] == [("a0", ""), ("a1", "s"), ("a2", "s²")]
    running = rec.running()
    a0, a1, a2 = (rec.channel(name)[running] for name in ("a0", "a1", "a2"))
    # Chae et al. (2013), Eqn 8: x_p = a0 x + a1 x' + a2 x''; alpha and beta are a1, a2 in samples.
    rows = rec.samples[running]
    np.testing.assert_allclose(rows["alpha"], a1 * rec.fs_hz, rtol=1e-9)
    np.testing.assert_allclose(rows["beta"], a2 * rec.fs_hz**2, rtol=1e-9)
    assert np.ptp(a0) > 0.0


def test_truth_and_law_stand_side_by_side() -> None:
    rec = run_with("ats", truth=True)
    assert [one.name for one in rec.channels] == ["x_true_m", "f_true_n", "a0", "a1", "a2"]
    bare = run_with("ats")
    for name in ("a0", "a1", "a2"):
        np.testing.assert_array_equal(rec.channel(name), bare.channel(name))
    running = rec.running()
    assert np.abs(rec.channel("x_true_m") - rec.samples["x_meas_m"])[running].max() < 2e-5


def test_law_that_has_alpha_and_beta_alone_makes_no_row_longer() -> None:
    assert run_with("alpha-beta").channels == ()


def test_station_refuses_more_values_of_a_law_than_a_row_has_room_for() -> None:
    test, rig = config.load_both(None, None, ["controller.type=ats"])
    settings = experiment.station_config(experiment.prepare(test, rig))
    for first, count in ((62, 3), (65, 0), (0, 65), (2**32 - 1, 2)):
        wrong = dataclasses.replace(settings, law_channel=first, law_channel_count=count)
        with pytest.raises(core.CoreError):
            core.Station(wrong, np.zeros(8))
