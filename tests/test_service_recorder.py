"""The recorder: killed, late, on a full disk; every row against what was recorded."""

from __future__ import annotations

import errno
import json
import os
import random
import stat
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import pytest
from realtime_bench import PROGRAM, STATE, until
from recording_data import recording as made_up

from rthyb_rt import core
from rthyb_rt.core import mapped_ring
from rthyb_rt.errors import RthybError
from rthyb_rt.lab import experiment
from rthyb_rt.record import recording, ring
from rthyb_rt.record.recording import BLOCK_ROWS, FILE_NAME
from rthyb_rt.record.ring import Ring
from rthyb_rt.service import disk, growing
from rthyb_rt.service import ring_recorder as recorders
from rthyb_rt.service.growing import PART_NAME
from rthyb_rt.service.ordered import OrderedFile
from rthyb_rt.service.ring_recorder import Recorder, read_index, read_status

pytestmark = pytest.mark.alone

KILLS = int(os.environ.get("RTHYB_KILLS", "4"))
"""How often the recorder is killed; the long proof asks for 500."""


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder in memory, for rings and runs."""
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


def truth(count: int, seed: int = 1) -> core.RecordArray:
    """Rows like those of a test: IDLE, then RUNNING, every field of every row another number."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, dtype=core.RECORD_DTYPE)
    for name in core.RECORD_DTYPE.names or ():
        if np.issubdtype(rows[name].dtype, np.floating):
            rows[name] = rng.standard_normal(count)
    rows["tick"] = np.arange(count)
    rows["state"] = STATE["RUNNING"]
    rows["state"][:64] = STATE["IDLE"]
    return rows


class Producer:
    """A test of the service, as the recorder sees it."""

    def __init__(
        self, place: Path, name: str = "test", capacity: int = mapped_ring.CAPACITY
    ) -> None:
        session = made_up()
        session.meta |= {
            "test_name": name,
            "created_utc": "2026-11-21T12:00:00+00:00",
            "service": {"run_id": f"{name}-{random.random()}", "purpose": "test", "digest": ""},
        }
        self.session = session
        self.ring = Ring.create(place / "rings", session, capacity)

    def push(self, rows: core.RecordArray) -> None:
        self.ring.push(rows)

    def end(self, reason: str = "completed") -> None:
        self.session.meta["end_reason"] = reason
        self.session.replay.tares = {"displacement_m": 0.5, "force_n": 7.0}
        self.ring.renew_session(self.session)
        self.ring.close()


@contextmanager
def recorder(place: Path) -> Iterator[Recorder]:
    made = Recorder(place / "rings", place / "runs")
    try:
        yield made
    finally:
        made.close()


def turns(made: Recorder, count: int = 3) -> None:
    for _ in range(count):
        made.turn()


def begun(place: Path, rows: np.ndarray) -> Producer:
    """Return a test that goes on, of whose rows a recorder that has ended wrote whole blocks."""
    made = Producer(place)
    with recorder(place) as working:
        made.push(rows)
        working.turn()
    return made


def the_run(place: Path) -> Path:
    (folder,) = [path for path in (place / "runs").iterdir() if path.is_dir()]
    return folder


def assert_same(found: np.ndarray, wanted: np.ndarray) -> None:
    """Value by value; what lies between the fields does not count."""
    assert found.size == wanted.size
    for name in wanted.dtype.names or ():
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)


# ---- an ordinary day ----------------------------------------------------------------------------


def test_test_becomes_a_folder_a_line_of_the_index_and_no_ring(place: Path) -> None:
    rows = truth(1000)
    made = Producer(place)
    with recorder(place) as working:
        for at in range(0, 1000, 90):
            made.push(rows[at : at + 90])
            working.turn()
        part = the_run(place) / PART_NAME
        assert part.is_file()
        assert not (the_run(place) / FILE_NAME).exists()
        made.end()
        turns(working)
    folder = the_run(place)
    assert sorted(path.name for path in folder.iterdir()) == [FILE_NAME, "rig.toml", "test.toml"]
    rec = recording.read(folder / FILE_NAME)
    assert_same(rec.samples, rows)
    assert rec.replay.tares == {"displacement_m": 0.5, "force_n": 7.0}
    assert rec.meta["missing_rows"] == []
    assert rec.meta["end_reason"] == "completed"
    assert rec.reference is not None
    assert rec.ag_mps2.size == made.session.ag_mps2.size
    (entry,) = read_index(place / "runs")
    assert entry["rows"] == 1000
    assert entry["ticks"] == [0, 999]
    assert entry["folder"] == folder.name == "test-20261121T120000Z"
    assert ring.find(place / "rings") == []


def test_ring_that_is_met_while_it_is_made_is_recorded_all_the_same(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with recorder(place) as working:
        write_session = ring._write_session

        def watched(path: Path, session: recording.RecordedTest) -> None:
            working.turn()
            write_session(path, session)
            working.turn()

        monkeypatch.setattr(ring, "_write_session", watched)
        made = Producer(place)
        working.turn()
        assert working.status().run_id == made.session.meta["service"]["run_id"]
        made.end()


def test_recorder_that_is_ended_just_after_a_test_still_finishes_it(place: Path) -> None:
    """A PC that shuts down ends the daemon, then the recorder; the ring does not outlive it."""
    made = Producer(place)
    rows = truth(1000)
    told: list[bool] = []

    def done(working: Recorder) -> bool:
        if not told and working.busy:
            made.push(rows)
            made.end()
            told.append(True)
        return bool(told)

    recorders.run(place / "rings", place / "runs", done)
    assert_same(recording.read(the_run(place) / FILE_NAME).samples, rows)


def test_file_of_a_running_test_opens_as_any_other_and_lags_by_less_than_a_block(
    place: Path,
) -> None:
    rows = truth(1000)
    made = Producer(place)
    with recorder(place) as working:
        made.push(rows)
        working.turn()
        copy = place / "copy.h5"
        copy.write_bytes((the_run(place) / PART_NAME).read_bytes())
    with h5py.File(copy, "r") as file:
        found = file["samples"][()]
    assert_same(found, rows[: 1000 // BLOCK_ROWS * BLOCK_ROWS])
    made.ring.close()


def test_test_in_which_nothing_moved_leaves_nothing(place: Path) -> None:
    rows = truth(400)
    rows["state"] = STATE["ZEROED"]
    made = Producer(place)
    with recorder(place) as working:
        made.push(rows)
        turns(working)
        made.end()
        turns(working)
    assert list((place / "runs").iterdir()) == []
    assert ring.find(place / "rings") == []


def test_rings_of_others_are_left_alone(place: Path) -> None:
    session = made_up()
    other = Ring.create(place / "rings", session, 1024)
    rest = made_up()
    rest.meta["service"] = {"run_id": "r", "purpose": "rest"}
    resting = Ring.create(place / "rings", rest, 1024)
    with recorder(place) as working:
        turns(working)
        assert not working.busy
        assert working.status().fault == ""
    assert list((place / "runs").iterdir()) == []
    for made in (other, resting):
        assert made.path.exists()
        made.close()


def test_two_tests_of_one_second_get_a_folder_each(place: Path) -> None:
    with recorder(place) as working:
        for seed in (1, 2):
            made = Producer(place)
            made.push(truth(300, seed))
            turns(working)
            made.end()
            turns(working)
    names = sorted(entry["folder"] for entry in read_index(place / "runs"))
    assert names == ["test-20261121T120000Z", "test-20261121T120000Z-2"]
    for name, seed in zip(names, (1, 2), strict=True):
        assert_same(recording.open_run(place / "runs" / name).samples, truth(300, seed))


def test_second_recorder_is_refused(place: Path) -> None:
    with (
        recorder(place),
        pytest.raises(RthybError, match="another recorder is already running here"),
    ):
        Recorder(place / "rings", place / "runs")


def test_status_says_how_it_stands_and_grows_old(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Producer(place)
    with recorder(place) as working:
        made.push(truth(300))
        working.turn()
        status = read_status(place / "rings")
        assert status is not None
        assert status.alive
        assert status.run_id == made.session.meta["service"]["run_id"]
        assert status.rows == 256
        assert status.behind_rows == 44
        assert status.free_bytes > 0
        now = time.monotonic()
        monkeypatch.setattr(time, "monotonic", lambda: now + 2 * recorders.FRESH_S)
        assert not status.alive
    assert read_status(place / "rings") is None
    made.ring.close()


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"schema": "rthyb-recorder/1"}', "\xff"])
def test_status_that_makes_no_sense_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / recorders.STATUS_NAME).write_text(text, encoding="latin-1")
    assert read_status(tmp_path) is None


# ---- late ---------------------------------------------------------------------------------------


def test_rows_that_the_ring_no_longer_has_are_a_stated_range(place: Path) -> None:
    rows = truth(9000)
    made = Producer(place, capacity=2048)
    with recorder(place) as working:
        made.push(rows[:700])
        working.turn()
    made.push(rows[700:6000])
    with recorder(place) as working:
        working.turn()
        made.push(rows[6000:6500])
        working.turn()
    made.push(rows[6500:])
    with recorder(place) as working:
        turns(working, 1)
        made.end()
        turns(working)
    rec = recording.read(the_run(place) / FILE_NAME)
    missing = rec.meta["missing_rows"]
    assert len(missing) == 2
    there = np.ones(9000, dtype=bool)
    for first, last in missing:
        there[first : last + 1] = False
    assert_same(rec.samples, rows[there])
    assert missing[0][0] == 700 // BLOCK_ROWS * BLOCK_ROWS
    assert 9000 - np.count_nonzero(there) < 6000 - 640 + 2500
    assert rec.reference is None
    (entry,) = read_index(place / "runs")
    assert entry["missing_rows"] == missing


def test_producer_that_was_killed_leaves_all_up_to_its_last_row(place: Path) -> None:
    rows = truth(500)
    made = Producer(place)
    made.push(rows)
    # The lock goes with the process, and nothing says that the test ended in good order.
    made.ring._owned.close()
    with recorder(place) as working:
        turns(working)
    rec = recording.read(the_run(place) / FILE_NAME)
    assert_same(rec.samples, rows)
    assert rec.meta["end_reason"] == "its process ended early"


# ---- killed -------------------------------------------------------------------------------------


def start(place: Path) -> subprocess.Popen[bytes]:
    order = ["recorder", "--rings", str(place / "rings"), "--runs", str(place / "runs")]
    return subprocess.Popen([*PROGRAM, *order], stderr=subprocess.PIPE)


def test_recorder_that_is_killed_again_and_again_loses_nothing(place: Path) -> None:
    """A few kills of a test at four times its speed, or many at its own.

    It pauses where a machine starts recorders so slowly that it would be over before the last one.
    """
    rng = random.Random(7)
    few = KILLS <= 10
    a_kill, step = (12000, 41) if few else (4000, 10)
    rows = truth(KILLS * a_kill)
    made = Producer(place)
    done = threading.Event()
    pushed = [0]

    def produce() -> None:
        while not done.is_set():
            if pushed[0] < (readable + 1) * a_kill - step:
                push()
            time.sleep(0.01)

    def push() -> None:
        made.push(rows[pushed[0] : pushed[0] + step])
        pushed[0] += step

    readable = 0
    producer = threading.Thread(target=produce)
    producer.start()
    try:
        for _ in range(KILLS):
            process = start(place)
            status = place / "rings" / recorders.STATUS_NAME
            status.unlink(missing_ok=True)
            until(status.exists, "the recorder's first word")
            until(lambda: any((place / "runs").glob(f"*/{PART_NAME}")), "a file of the test")
            time.sleep(rng.uniform(0.0, 0.4))
            process.kill()
            process.communicate()
            with h5py.File(the_run(place) / PART_NAME, "r") as file:
                found = file["samples"][()]
            assert_same(found, rows[: found.size])
            readable += 1
        assert 0 < pushed[0] < rows.size
    finally:
        done.set()
        producer.join()
    made.end()
    with recorder(place) as working:
        turns(working)
    rec = recording.read(the_run(place) / FILE_NAME)
    assert_same(rec.samples, rows[: pushed[0]])
    assert rec.meta["missing_rows"] == []
    print(f"{readable} of {KILLS} killed recorders left a readable file, {rec.samples.size} rows")


def test_recorder_killed_before_it_could_tidy_does_not_record_twice(place: Path) -> None:
    rows = truth(600)
    made = Producer(place, capacity=256)
    with recorder(place) as working:
        for at in range(0, 600, 50):
            made.push(rows[at : at + 50])
            working.turn()
        made.end()
        (tape,) = working._tapes.values()
        tape.finish()
        del working._tapes[made.ring.path]
    assert read_index(place / "runs") == []
    with recorder(place) as working:
        turns(working)
    assert_same(recording.open_run(the_run(place)).samples, rows)
    (entry,) = read_index(place / "runs")
    assert entry["rows"] == 600
    assert ring.find(place / "rings") == []


def test_reboot_takes_the_ring_and_leaves_what_was_written(place: Path) -> None:
    rows = truth(1000)
    made = begun(place, rows)
    made.ring.remove()
    with recorder(place):
        pass
    rec = recording.open_run(the_run(place))
    assert_same(rec.samples, rows[: 1000 // BLOCK_ROWS * BLOCK_ROWS])
    assert rec.meta["end_reason"] == "its process ended early; the ring is gone"
    (entry,) = read_index(place / "runs")
    assert entry["end_reason"] == rec.meta["end_reason"]


def torn(place: Path) -> Path:
    """Damage the last block of the only file; return its folder."""
    folder = the_run(place)
    with h5py.File(folder / PART_NAME, "r") as file:
        samples = file["samples"]
        chunk = samples.id.get_chunk_info(len(samples) // BLOCK_ROWS - 1)
    with (folder / PART_NAME).open("r+b") as raw:
        raw.seek(chunk.byte_offset + chunk.size // 2)
        raw.write(b"\xff" * 16)
    return folder


def test_block_that_is_damaged_at_the_end_is_read_again_from_the_ring(place: Path) -> None:
    rows = truth(1024)
    made = begun(place, rows)
    torn(place)
    with recorder(place) as working:
        made.end()
        turns(working)
    rec = recording.open_run(the_run(place))
    assert_same(rec.samples, rows)
    assert rec.meta["missing_rows"] == []


def test_block_that_is_damaged_at_the_end_costs_itself_alone_where_the_ring_is_gone(
    place: Path,
) -> None:
    """A PC that lost its power has both: a torn file and no ring."""
    rows = truth(1024)
    made = begun(place, rows)
    folder = torn(place)
    made.ring.remove()
    with recorder(place) as working:
        assert working.status().fault == ""
    assert_same(recording.open_run(folder).samples, rows[: 1024 - BLOCK_ROWS])
    (entry,) = read_index(place / "runs")
    assert entry["rows"] == 1024 - BLOCK_ROWS
    assert not (folder / PART_NAME).exists()


def test_file_without_ring_that_is_beyond_help_is_put_aside_and_named(
    place: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = begun(place, truth(1024))
    made.ring.remove()
    folder = the_run(place)
    (folder / PART_NAME).write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(4000))
    with recorder(place) as working:
        turns(working)
        status = working.status()
        assert "recording.damaged.h5" in status.fault
        # The next test has nothing to do with it.
        assert not status.hinders
        assert [path.name for path in folder.iterdir()] == ["recording.damaged.h5"]
        assert [record.levelname for record in caplog.records].count("ERROR") == 1
        (folder / "recording.damaged.h5").unlink()
        turns(working)
        assert working.status().fault == ""
    assert read_index(place / "runs") == []


def test_file_without_ring_that_the_system_refuses_for_a_while_is_finished_later(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = truth(1024)
    made = begun(place, rows)
    made.ring.remove()
    monkeypatch.setattr(recorders, "_RETRY_S", 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(growing.GrowingFile, "_open", too_many_files)
        working = Recorder(place / "rings", place / "runs")
        turns(working)
        assert "Too many open files" in working.status().fault
        assert working.status().hinders
    turns(working)
    assert working.status().fault == ""
    working.close()
    assert_same(recording.open_run(the_run(place)).samples, rows)


def test_full_disk_is_no_reason_to_put_a_file_aside(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = truth(1024)
    made = begun(place, rows)
    made.ring.remove()
    monkeypatch.setattr(recorders, "_RETRY_S", 0.0)

    def full(_: growing.GrowingFile) -> None:
        raise growing.NoRoomError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(growing.GrowingFile, "_flush", full)
        working = Recorder(place / "rings", place / "runs")
        turns(working, 8)
        assert "the disk is full" in working.status().fault
    turns(working)
    working.close()
    assert not list((place / "runs").glob("*/*damaged*"))
    assert_same(recording.open_run(the_run(place)).samples, rows)


def test_recording_that_was_finished_before_a_reboot_stays_as_it_is(place: Path) -> None:
    made = Producer(place)
    rows = truth(600)
    with recorder(place) as working:
        made.push(rows)
        working.turn()
        part = the_run(place) / PART_NAME
        kept = part.read_bytes()
        made.end()
        turns(working)
    # The process before had no time to delete it.
    part.write_bytes(kept)
    (place / "runs" / recorders.INDEX_NAME).unlink()
    with recorder(place):
        pass
    rec = recording.open_run(the_run(place))
    assert_same(rec.samples, rows)
    assert rec.meta["end_reason"] == "completed"
    assert not part.exists()
    (entry,) = read_index(place / "runs")
    assert (entry["rows"], entry["ticks"]) == (600, [0, 599])


def test_ring_of_another_version_is_a_fault_that_says_what_to_restart(
    place: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = Producer(place)
    made.push(truth(300))
    with recorder(place) as working:
        with monkeypatch.context() as patch:
            # As an older recorder sees the ring of a newer daemon.
            patch.setattr(ring, "_fields", lambda _: [])
            turns(working)
            fault = working.status().fault
            assert "has different fields" in fault
            assert "restart rthyb-recorder whenever rthyb is restarted" in fault
            assert [record.levelname for record in caplog.records].count("ERROR") == 1
        made.ring.remove()
        turns(working)
        assert working.status().fault == ""


def test_ring_whose_file_is_of_another_course_is_a_fault(place: Path) -> None:
    made = Producer(place)
    rows = truth(1024)
    with recorder(place) as working:
        made.push(rows)
        working.turn()
    other = rows[1023:].copy()
    other["tick"] = 5000
    with h5py.File(the_run(place) / PART_NAME, "r+") as file:
        file["samples"][1023:] = other
    with recorder(place) as working:
        turns(working)
        assert (
            "the file ends with tick 5000, but the ring has tick 1023 in that place"
            in working.status().fault
        )
    made.ring.remove()


def test_end_of_a_long_test_takes_little_memory(place: Path) -> None:
    made = Producer(place)
    with recorder(place) as working:
        made.push(truth(60_000))
        working.turn()
        (tape,) = working._tapes.values()
        tracemalloc.start()
        tape._completed(made.session, True)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 60_000 * core.RECORD_DTYPE.itemsize / 2
    made.ring.remove()


def test_file_that_is_beyond_help_is_put_aside_and_written_anew(place: Path) -> None:
    rows = truth(1024)
    made = begun(place, rows)
    folder = the_run(place)
    (folder / PART_NAME).write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(4000))
    with recorder(place) as working:
        made.end()
        turns(working)
    runs = [path for path in (place / "runs").iterdir() if (path / FILE_NAME).exists()]
    assert_same(recording.open_run(runs[0]).samples, rows)


_READ = """
import sys, h5py
with h5py.File(sys.argv[1], "r") as file:
    print(file["samples"].shape[0], flush=True)
    sys.stdin.read()
"""


def test_somebody_who_looks_at_the_file_of_a_killed_test_costs_nothing(place: Path) -> None:
    """What the ring has lost meanwhile is in that file alone."""
    rows = truth(9000)
    made = Producer(place, capacity=2048)
    with recorder(place) as working:
        for at in range(0, 6000, 500):
            made.push(rows[at : at + 500])
            working.turn()
    command = [sys.executable, "-c", _READ, str(the_run(place) / PART_NAME)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as reader:
        assert reader.stdout is not None
        assert int(reader.stdout.readline()) > 5500
        with recorder(place) as working:
            made.push(rows[6000:7000])
            working.turn()
            assert working.status().fault == ""
            made.push(rows[7000:])
            turns(working)
            # And as it grows: any program may open it.
            subprocess.run(command, stdin=subprocess.DEVNULL, check=True, capture_output=True)
            made.end()
            turns(working)
        reader.communicate()
    assert_same(recording.open_run(the_run(place)).samples, rows)
    assert not list((place / "runs").glob("*/*damaged*"))


def test_file_that_the_system_refuses_for_a_while_is_not_put_aside(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = truth(1024)
    made = begun(place, rows)
    monkeypatch.setattr(recorders, "_RETRY_S", 0.0)
    with recorder(place) as working:
        with monkeypatch.context() as patch:
            patch.setattr(growing.GrowingFile, "_open", too_many_files)
            turns(working)
            assert "Too many open files" in working.status().fault
        turns(working)
        assert working.status().fault == ""
        made.end()
        turns(working)
    assert_same(recording.open_run(the_run(place)).samples, rows)
    assert not list((place / "runs").glob("*/*damaged*"))


def too_many_files(_: growing.GrowingFile) -> None:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def test_index_outlives_half_a_line(tmp_path: Path) -> None:
    recorders._append_to_index(tmp_path, {"run_id": "a", "rows": 1})
    with (tmp_path / recorders.INDEX_NAME).open("a") as file:
        file.write('{"run_id": "b", "ro')
    recorders._append_to_index(tmp_path, {"run_id": "c", "rows": 3})
    recorders._append_to_index(tmp_path, {"run_id": "a", "rows": 2})
    assert read_index(tmp_path) == [{"run_id": "a", "rows": 2}, {"run_id": "c", "rows": 3}]
    assert read_index(tmp_path / "nowhere") == []


# ---- a full disk --------------------------------------------------------------------------------


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    """A disk of 16 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)]
    if os.geteuid() or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("a small disk takes a mount, which is not permitted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def fill(folder: Path, left: int) -> Path:
    """Fill a disk but for so many bytes."""
    ballast = folder / "ballast"
    ballast.unlink(missing_ok=True)
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(disk.free_bytes(folder) - left, 1))
    return ballast


def test_full_disk_waits_says_so_and_loses_nothing_while_the_ring_has_it(
    place: Path, small: Path
) -> None:
    rows = truth(20000)
    made = Producer(place)
    working = Recorder(place / "rings", small)
    try:
        made.push(rows[:1000])
        working.turn()
        assert working.status().fault == ""
        ballast = fill(small, 1 << 20)
        made.push(rows[1000:20000])
        turns(working)
        status = working.status()
        assert "the disk is full" in status.fault
        assert status.behind_rows >= 19000
        with h5py.File(place / "copy.h5", "w"):
            pass
        made.end()
        turns(working)
        assert ring.find(place / "rings") == [made.ring.path]
        ballast.unlink()
        turns(working)
        assert working.status().fault == ""
    finally:
        working.close()
    (entry,) = read_index(small)
    rec = recording.open_run(small / entry["folder"])
    assert_same(rec.samples, rows)
    assert rec.meta["missing_rows"] == []


def test_disk_that_fills_between_two_blocks_never_reaches_hdf5(place: Path, small: Path) -> None:
    """Whatever is left, the file holds whole blocks and opens."""
    rows = truth(9000)
    for left in (0, 4096, 100_000, 1 << 20, 9 << 20, (9 << 20) + 300_000):
        made = Producer(place, name=f"left-{left}")
        working = Recorder(place / "rings", small)
        try:
            made.push(rows[:1000])
            working.turn()
            ballast = fill(small, left)
            made.push(rows[1000:9000])
            turns(working)
            (part,) = small.glob(f"left-{left}-*/{PART_NAME}")
            size = part.read_bytes()
            (place / "copy.h5").write_bytes(size)
            with h5py.File(place / "copy.h5", "r") as file:
                found = file["samples"][()]
            assert found.size >= 896
            assert_same(found, rows[: found.size])
            ballast.unlink()
            made.end()
            turns(working)
        finally:
            working.close()
        assert read_index(small), (working._faults, disk.free_bytes(small))
        entry = read_index(small)[-1]
        assert_same(recording.open_run(small / entry["folder"]).samples, rows)
        for path in (small / entry["folder"]).iterdir():
            path.unlink()


def test_full_disk_at_the_end_of_a_test_finishes_without_a_copy(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = truth(500)
    made = Producer(place)
    with recorder(place) as working:
        made.push(rows)
        working.turn()
        room = disk.KEPT_FREE_BYTES + 1000
        monkeypatch.setattr(disk, "free_bytes", lambda _: room)
        made.end()
        turns(working)
    assert_same(recording.open_run(the_run(place)).samples, rows)
    assert not (the_run(place) / PART_NAME).exists()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_motion_that_a_disk_did_not_take_at_once_is_recorded_all_the_same(
    place: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """All of it in one batch, and nothing after it but rest."""
    rows = truth(1000)
    rows["state"][-120:] = STATE["IDLE"]
    commit = OrderedFile.commit

    def refused(_: OrderedFile) -> None:
        monkeypatch.setattr(OrderedFile, "commit", commit)
        raise OSError(number, os.strerror(number))

    made = Producer(place)
    with recorder(place) as working:
        working.turn()
        made.push(rows)
        monkeypatch.setattr(OrderedFile, "commit", refused)
        working.turn()
        assert os.strerror(number).lower() in working.status().fault.lower() or number != errno.EIO
        made.end()
        turns(working)
    assert_same(recording.open_run(the_run(place)).samples, rows)


def test_what_a_disk_does_not_take_at_the_end_stays_in_the_ring(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording is not finished without the rows that are still kept back."""
    rows = truth(1000)
    commit = OrderedFile.commit

    def refused(_: OrderedFile) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    made = Producer(place)
    with recorder(place) as working:
        working.turn()
        made.push(rows)
        made.end()
        monkeypatch.setattr(OrderedFile, "commit", refused)
        turns(working)
        assert "Input/output error" in working.status().fault
        assert ring.find(place / "rings") == [made.ring.path]
        monkeypatch.setattr(OrderedFile, "commit", commit)
        turns(working)
    assert_same(recording.open_run(the_run(place)).samples, rows)


# ---- a slow disk, and one with a fault ----------------------------------------------------------


def test_disk_that_is_slower_than_the_rows_come_does_not_hold_the_recorder(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each write brings the next block: a turn ends all the same, and its disk is synced."""
    rows = truth(128 * 40)
    commit = OrderedFile.commit
    pushed = [256]

    def late(self: OrderedFile) -> None:
        if pushed[0] < rows.size:
            made.push(rows[pushed[0] : pushed[0] + 128])
            pushed[0] += 128
        commit(self)

    made = Producer(place)
    with recorder(place) as working:
        working.turn()
        made.push(rows[:256])
        monkeypatch.setattr(OrderedFile, "commit", late)
        working.turn()
        assert pushed[0] < rows.size / 4
        while pushed[0] < rows.size:
            working.turn()
        made.end()
        turns(working)
    assert_same(recording.open_run(the_run(place)).samples, rows)


class Stuck:
    """A disk whose fsync does not come back until it is let go; ``met``: somebody waits for it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.met, self._free, self._fsync = threading.Event(), threading.Event(), os.fsync
        monkeypatch.setattr(os, "fsync", self._sync)

    def _sync(self, fd: int) -> None:
        self.met.set()
        assert self._free.wait(60.0)
        self._fsync(fd)

    def let_go(self) -> None:
        self._free.set()


def test_recorder_that_waits_for_its_disk_from_the_first_moment_on_is_alive(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Producer(place)
    made.push(truth(300))
    disk_is = Stuck(monkeypatch)
    with recorder(place) as working:
        beginning = threading.Thread(target=working.turn)
        beginning.start()
        assert disk_is.met.wait(60.0)

        def told() -> bool:
            found = read_status(place / "rings")
            return found is not None and found.alive and "beginning has taken" in found.fault

        until(told, "a word on the disk")
        disk_is.let_go()
        beginning.join()
        made.end()
        turns(working)
    assert the_run(place).joinpath(FILE_NAME).is_file()


def test_recorder_says_that_its_disk_is_slow_while_it_waits_for_it(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is alive all the time, and what was pushed meanwhile is written afterwards."""
    rows = truth(3000)

    def said() -> recorders.Status:
        found = read_status(place / "rings")
        assert found is not None
        return found

    made = Producer(place)
    with recorder(place) as working:
        made.push(rows[:1000])
        working.turn()
        assert said().fault == ""
        disk_is = Stuck(monkeypatch)
        working._synced_s = 0.0
        writing = threading.Thread(target=working.turn)
        writing.start()
        assert disk_is.met.wait(60.0)
        made.push(rows[1000:])
        slow_s = "writing has taken over {} s: is the disk slow or stuck?"
        until(lambda: said().fault == slow_s.format(1), "a word on the disk")
        first = said()
        until(lambda: said().fault == slow_s.format(3), "another one")
        assert said().at_s > first.at_s
        assert said().alive
        # The ring waits for 64 s: what is merely slow stands against no test, what is stuck does.
        assert not said().hinders
        monkeypatch.setattr(recorders, "_STUCK_S", 2.0)
        until(lambda: said().hinders, "a disk that passes for stuck")
        disk_is.let_go()
        writing.join()
        # A while it is said all the same: each second may be as slow.
        working._said_s = 0.0
        working.turn()
        assert (said().fault, said().hinders) == (slow_s.format(3), False)
        monkeypatch.setattr(working._patience, "_slow_until_s", 0.0)
        working._said_s = 0.0
        working.turn()
        assert said().fault == ""
        made.end()
        turns(working)
    assert_same(recording.open_run(the_run(place)).samples, rows)


@pytest.mark.parametrize("at_the_end", [False, True])
def test_fault_of_the_disk_is_told_and_stands_against_the_next_test(
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    at_the_end: bool,
) -> None:
    """The system says it once: afterwards what was lost passes for written."""

    def faulty(_: int) -> None:
        monkeypatch.setattr(os, "fsync", fsync)
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    fsync = os.fsync
    made = Producer(place)
    with recorder(place) as working:
        made.push(truth(1000))
        working.turn()
        if at_the_end:
            working._synced_s = time.monotonic() + 100.0
            made.end()
        monkeypatch.setattr(os, "fsync", faulty)
        for _ in range(2):
            if not at_the_end:
                working._synced_s = 0.0
            working.turn()
        monkeypatch.setattr(recorders, "_RETRY_S", 0.0)
        turns(working)
        status = working.status()
        assert "the disk has reported an error (Input/output error)" in status.fault
        assert "restart the recorder" in status.fault
        assert status.hinders
        if not at_the_end:
            made.end()
        turns(working)
    assert caplog.text.count("restart the recorder") == 1 + at_the_end
    assert recording.open_run(the_run(place)).samples.size == 1000


def test_nobody_else_can_take_the_place_of_the_recorder(place: Path) -> None:
    """Its lock is not even to be opened by those who may look."""
    (place / "rings").mkdir()
    lock = place / "rings" / "recorder.lock"
    lock.touch(0o640)
    with recorder(place):
        assert stat.S_IMODE(lock.stat().st_mode) == 0o600


def channels_of(kind: str) -> tuple[core.Channel, ...]:
    """What rows have beside their record: nothing, what a law reports, as much as there may be."""
    if kind == "none":
        return ()
    if kind == "most":
        return tuple(core.Channel(f"c{n}", "1") for n in range(core.CHANNELS_MAX))
    return experiment.law_channels(core.LawConfig(kind))


@pytest.mark.parametrize("kind", ["none", "amb", "most"])
def test_room_that_is_asked_for_is_what_the_rows_take_and_not_much_more(
    place: Path, kind: str
) -> None:
    """Rows of noise, which does not compress: nothing takes more room."""
    channels, count = channels_of(kind), 100 * BLOCK_ROWS
    assert bool(channels) == (kind != "none")
    rng = np.random.default_rng(2)
    records = np.frombuffer(rng.bytes(count * core.RECORD_DTYPE.itemsize), core.RECORD_DTYPE).copy()
    records["tick"] = np.arange(count)
    rows = core.rows_of(records, channels, rng.standard_normal((count, len(channels))))
    session = replace(made_up(), samples=rows[:0], channels=channels)
    session.meta["service"] = {"run_id": kind}
    file = growing.GrowingFile(place / "run", session)
    before = (place / "run" / PART_NAME).stat().st_size
    file.add(rows)
    file.close()  # gives back what is reserved
    taken = (place / "run" / PART_NAME).stat().st_size - before
    asked = disk.needed_bytes(count, channels) - disk.needed_bytes(0, channels)
    assert 0.9 * asked < taken <= asked


def test_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RthybError, match="cannot be written"):
        growing.GrowingFile(tmp_path / "file" / "run", made_up())


def test_status_file_is_json(place: Path) -> None:
    with recorder(place) as working:
        working.turn()
        document: dict[str, Any] = json.loads((place / "rings/recorder.json").read_text())
    assert document["schema"] == recorders.SCHEMA
