"""The recording file: what goes in comes out, and nothing half-written or damaged is taken."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
from recording_data import FS_HZ, RECORD_DTYPE, recording
from rthyb_rt._core import lib
from scipy.io import loadmat

from rthyb_rt import core
from rthyb_rt.analysis.summary import OUT_OF_RANGE
from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.record import mat_csv
from rthyb_rt.record import recording as files
from rthyb_rt.record.recording import (
    SCHEMA,
    UNITS,
    RecordedTest,
    ReplayData,
    open_run,
    read,
    replacing,
    write,
)


@pytest.fixture
def short() -> RecordedTest:
    return recording(2.0)


@pytest.fixture
def path(tmp_path: Path, short: RecordedTest) -> Path:
    file = tmp_path / "run" / "recording.h5"
    write(file, short)
    return file


# --- round trip -------------------------------------------------------------------------------


def test_recording_comes_back_bit_for_bit(path: Path, short: RecordedTest) -> None:
    short.replay.skips = np.array([[100, 3], [900, 12]], dtype=np.int64)
    short.samples["x_meas_m"][7] = np.nan
    write(path, short)
    back = read(path)
    assert back.samples.dtype.fields == short.samples.dtype.fields
    assert back.samples.tobytes() == short.samples.tobytes()
    assert back.reference is not None
    assert short.reference is not None
    assert back.reference.tobytes() == short.reference.tobytes()
    assert back.ag_mps2.tobytes() == short.ag_mps2.tobytes()
    assert (back.fs_hz, back.test_toml, back.rig_toml) == (
        short.fs_hz,
        short.test_toml,
        short.rig_toml,
    )
    assert back.ground_motion == short.ground_motion
    assert back.meta == short.meta
    assert back.replay.codec == short.replay.codec
    assert back.replay.parameters == short.replay.parameters
    assert back.replay.commands == short.replay.commands
    assert back.replay.tares == short.replay.tares
    np.testing.assert_array_equal(back.replay.skips, short.replay.skips)


def test_types_of_the_attributes_survive(path: Path, short: RecordedTest) -> None:
    short.meta |= {"latency_us": {"p50": 3.5, "counts": [1, 2]}, "cpu": None, "note": "10 °C"}
    write(path, short)
    meta = read(path).meta
    assert meta["interrupted"] is False
    assert meta["latency_us"] == {"p50": 3.5, "counts": [1, 2]}
    assert meta["note"] == "10 °C"
    assert "cpu" not in meta


def test_test_file_of_any_language_and_length_survives(path: Path, short: RecordedTest) -> None:
    short.test_toml = "# Prüfkörper 試験体\n" * 20_000
    write(path, short)
    assert read(path).test_toml == short.test_toml


def test_recording_without_samples_or_reference_survives(
    tmp_path: Path, short: RecordedTest
) -> None:
    short.samples, short.reference = short.samples[:0], None
    short.ag_mps2, short.replay = short.ag_mps2[:0], ReplayData()
    write(tmp_path / "recording.h5", short)
    back = read(tmp_path / "recording.h5")
    assert back.samples.size == 0
    assert back.reference is None
    assert back.replay.skips.shape == (0, 2)


def test_file_explains_itself_to_other_programs(path: Path) -> None:
    with h5py.File(path) as file:
        assert file.attrs["schema"] == SCHEMA
        assert '"f_meas_n": "N"' in file["samples"].attrs["units"]
        assert '"limited": 16' in file["samples"].attrs["flags"]
        assert '"RUNNING"' in file["samples"].attrs["states"]
        assert file["ground_motion/ag_mps2"].attrs["fs_hz"] == FS_HZ


def test_flags_states_and_status_have_the_numbers_of_the_core() -> None:
    for name, bit in FLAGS.items():
        assert getattr(lib, f"RTHYB_F_{name.upper()}") == bit
    for number, name in enumerate(STATES):
        assert getattr(lib, f"RTHYB_{name}") == number
    assert core.STATUS["out_of_range"] == OUT_OF_RANGE


def test_every_field_of_the_record_has_a_unit() -> None:
    assert set(UNITS) == set(RECORD_DTYPE.names or ())


# --- rows and time ----------------------------------------------------------------------------


def test_time_starts_with_the_test_proper_and_keeps_lost_ticks(short: RecordedTest) -> None:
    short.samples["state"][:100] = STATES.index("RAMP_IN")
    short.samples["tick"] += 5000
    short.samples["tick"][200:] += 3
    t = short.time_s()
    assert t[100] == 0.0
    assert t[0] == -100 / FS_HZ
    assert t[200] - t[199] == 4 / FS_HZ
    assert short.running().sum() == len(short.samples) - 100


def test_recording_that_never_ran_is_taken_whole(short: RecordedTest) -> None:
    short.samples["state"] = STATES.index("RAMP_IN")
    assert short.running().all()


# --- writing fails ----------------------------------------------------------------------------


def test_failed_write_leaves_the_old_file_and_nothing_else(path: Path, short: RecordedTest) -> None:
    before = path.read_bytes()
    short.replay.parameters = [{"values": object()}]
    with pytest.raises(TypeError):
        write(path, short)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["recording.h5"]


FULL_DISK = """
import resource, sys
from recording_data import recording
from rthyb_rt import errors, report
from rthyb_rt.record import mat_csv, recording as recordings
rec = recording(2.0)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
for write, name in (
    (lambda path: recordings.write(path, rec), "recording.h5"),
    (lambda path: mat_csv.to_csv(rec, path), "recording.csv"),
    (lambda path: report.write_report(rec, path), "report.html"),
):
    try:
        write(f"{sys.argv[1]}/{name}")
    except errors.RthybError as error:
        print(error)
"""


@pytest.mark.long
def test_full_disk_is_one_clear_message_and_nothing_is_left(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)],
        capture_output=True, text=True, check=True, timeout=120,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])},
    )  # fmt: skip
    messages = done.stdout.splitlines()
    assert [message.split(": cannot be written (")[0] for message in messages] == [
        str(tmp_path / name) for name in ("recording.h5", "recording.csv", "report.html")
    ]
    assert list(tmp_path.iterdir()) == []


def test_folder_that_is_a_file_is_one_clear_message(tmp_path: Path, short: RecordedTest) -> None:
    (tmp_path / "run").write_text("in the way")
    with pytest.raises(RthybError, match="cannot be written"):
        write(tmp_path / "run" / "recording.h5", short)


def test_reader_sees_the_old_file_until_the_new_one_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with replacing(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"


# --- reading refuses --------------------------------------------------------------------------


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read(path)
    assert caught.value.exit_code == 3
    assert len(caught.value.problems) == 1
    assert caught.value.problems[0].where == str(path)
    return str(caught.value)


def test_missing_recording_is_refused(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "recording.h5")


def test_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "recording.h5").touch()
    assert "the file is empty" in refusal(tmp_path / "recording.h5")


def test_foreign_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "recording.h5").write_text("time,x\n0,0\n")
    assert "not an HDF5 file" in refusal(tmp_path / "recording.h5")


def test_foreign_hdf5_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(3)
    assert "not a recording: the attribute 'schema' is missing" in refusal(tmp_path / "other.h5")


def test_recording_of_a_later_version_is_refused_by_its_schema(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["schema"] = "rthyb-recording/4"
        file.attrs["rthyb_version"] = "0.4.0"
    assert refusal(path).endswith(
        "schema 'rthyb-recording/4', but this version reads rthyb-recording/1 to 3; "
        "pip install 'rthyb-rt>=0.4.0'"
    )


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.999])
def test_truncated_recording_is_refused(path: Path, part: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    message = refusal(path)
    assert "the file is truncated" in message or "the file is damaged" in message


def test_flipped_bits_in_the_samples_are_found(path: Path) -> None:
    with h5py.File(path) as file:
        chunk = file["samples"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + chunk.size // 2] ^= 0x10
    path.write_bytes(data)
    assert "the file is damaged" in refusal(path)


@pytest.mark.parametrize("name", ["samples", "ground_motion", "config/test_toml", "replay/tares"])
def test_recording_that_lacks_a_part_is_refused(path: Path, name: str) -> None:
    with h5py.File(path, "a") as file:
        del file[name]
    assert "the file is damaged" in refusal(path)


def test_recording_that_lacks_fields_is_refused_with_their_names(
    tmp_path: Path, short: RecordedTest
) -> None:
    names = [name for name in RECORD_DTYPE.names or () if name not in ("alpha", "beta")]
    short.samples = short.samples[names]
    write(tmp_path / "recording.h5", short)
    assert "'samples' lacks the fields alpha, beta" in refusal(tmp_path / "recording.h5")


def test_run_is_opened_by_folder_or_file(path: Path) -> None:
    assert len(open_run(path).samples) == len(open_run(path.parent).samples) == 2048


def test_folder_of_runs_is_refused_with_the_newest_run(path: Path) -> None:
    with pytest.raises(InputError, match=r"did you mean .*run"):
        open_run(path.parent.parent)


def test_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no recording\.h5 in this folder"):
        open_run(tmp_path)


# --- export -----------------------------------------------------------------------------------


def test_csv_has_the_interchange_columns_and_reads_back_exactly(
    tmp_path: Path, short: RecordedTest
) -> None:
    short.samples["state"][:10] = STATES.index("RAMP_IN")
    short.samples["x_meas_m"][20] = np.nan
    mat_csv.to_csv(short, tmp_path / "recording.csv")
    with (tmp_path / "recording.csv").open() as file:
        assert next(csv.reader(file)) == ["t", "ag", "x_num", "x_cmd", "x_meas", "f_meas"]
    table = np.genfromtxt(tmp_path / "recording.csv", delimiter=",", names=True)
    run = short.samples[10:]
    np.testing.assert_array_equal(table["t"], np.arange(run.size) / FS_HZ)
    for column, field in mat_csv.INTERCHANGE.items():
        np.testing.assert_array_equal(table[column], run[field])


def test_full_csv_has_every_field_of_every_row(tmp_path: Path, short: RecordedTest) -> None:
    mat_csv.to_csv(short, tmp_path / "full.csv", full=True)
    table = np.genfromtxt(tmp_path / "full.csv", delimiter=",", names=True)
    assert table.dtype.names == ("t_s", *(RECORD_DTYPE.names or ()))
    for field in RECORD_DTYPE.names or ():
        np.testing.assert_array_equal(table[field], short.samples[field])


def test_mat_file_opens_with_every_field(tmp_path: Path, short: RecordedTest) -> None:
    short.ground_motion["pga_g"] = None
    mat_csv.to_mat(short, tmp_path / "recording.mat")
    mat = loadmat(tmp_path / "recording.mat", squeeze_me=True)
    np.testing.assert_array_equal(mat["t_s"], short.time_s())
    for field in RECORD_DTYPE.names or ():
        np.testing.assert_array_equal(mat[field], short.samples[field])
    assert short.reference is not None
    np.testing.assert_array_equal(mat["x_ref_m"], short.reference["x_ref_m"])
    assert mat["fs_hz"] == FS_HZ
    assert mat["units"]["f_meas_n"] == "N"
    assert mat["state_names"][4] == "RUNNING"
    assert mat["ground_motion"]["name"] == "El Centro 1940 NS"
    assert mat["meta"]["test_name"] == "portal-frame-0.5s"


def test_mat_without_scipy_names_the_remedy(
    tmp_path: Path, short: RecordedTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "scipy.io", None)
    with pytest.raises(InputError, match=r"pip install 'rthyb-rt\[fit\]'"):
        mat_csv.to_mat(short, tmp_path / "recording.mat")
    assert list(tmp_path.iterdir()) == []


def test_two_threads_write_their_recordings_at_the_same_time(
    short: RecordedTest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both files are open at once: neither may hinder the other."""
    filled, both = files.fill, threading.Barrier(2, timeout=20.0)

    def together(file: h5py.File, rec: RecordedTest) -> None:
        both.wait()
        filled(file, rec)
        both.wait()

    monkeypatch.setattr(files, "fill", together)
    rec = short
    paths = [tmp_path / name / "recording.h5" for name in "ab"]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda path: write(path, rec), paths))
    monkeypatch.undo()
    first, second = (read(path) for path in paths)
    assert first.samples.tobytes() == second.samples.tobytes() == rec.samples.tobytes()
