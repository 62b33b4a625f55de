"""The telemetry ring: nothing torn, nothing in the way of the tick, and there after kill -9."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import random
import re
import signal
import socket
import stat
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recording_data import recording as made_up_recording
from ring_rows import CYCLE, rows

from rthyb_rt import cli, config, core, report
from rthyb_rt.analysis import summary
from rthyb_rt.core import STATES, RecordArray
from rthyb_rt.core.mapped_ring import AFTER_TRIP, CAPACITY
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import experiment, realtime, virtual_time
from rthyb_rt.record import recording, ring
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring, RingReader

pytestmark = pytest.mark.alone

TESTS = Path(__file__).resolve().parent
CORE = TESTS.parent / "csrc"

SLOT_BYTES = 160
NEWEST_AT = 128
ABOUT_AT = 4096

RUNNING, HOLD, TRIPPED, IDLE = (
    STATES.index(name) for name in ("RUNNING", "HOLD", "TRIPPED", "IDLE")
)


def are_whole(samples: RecordArray) -> bool:
    wanted = rows(0, 1).repeat(len(samples))
    for name in core.RECORD_DTYPE.names or ():
        if name not in ("flags", "state"):
            wanted[name] = samples["tick"].astype(core.RECORD_DTYPE[name])
    wanted["state"] = samples["state"]
    return bool((samples == wanted).all())


@pytest.fixture(scope="module")
def session() -> RecordedTest:
    return made_up_recording(2.0)


@pytest.fixture
def small(tmp_path: Path, session: RecordedTest) -> Iterator[Ring]:
    """A ring of 64 records."""
    made = Ring.create(tmp_path, session, capacity=64)
    yield made
    made.remove()


def slot_at(path: Path, row: int) -> int:
    """Where in the file a ring row lies."""
    slots_at, capacity = (int(n) for n in np.fromfile(path, "<u8", 7)[[4, 6]])
    return slots_at + row % (capacity & 0xFFFFFFFF) * SLOT_BYTES


def patch(path: Path, at: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


# ---- making it ----------------------------------------------------------------------------------


def test_ring_has_all_its_memory_before_the_start(tmp_path: Path, session: RecordedTest) -> None:
    made = Ring.create(tmp_path / "rings", session)
    facts = made.path.stat()
    assert facts.st_blocks * 512 >= facts.st_size > CAPACITY * SLOT_BYTES
    assert stat.S_IMODE(facts.st_mode) == 0o640
    assert stat.S_IMODE(ring.session_path(made.path).stat().st_mode) == 0o640
    made.remove()
    assert list(made.path.parent.iterdir()) == []


def test_every_start_has_a_ring_of_its_own(tmp_path: Path, session: RecordedTest) -> None:
    made = [Ring.create(tmp_path, session, capacity=8) for _ in range(3)]
    assert len({one.path for one in made}) == 3
    assert sorted(ring.find(tmp_path)) == sorted(one.path for one in made)
    for one in made:
        one.remove()


def test_in_memory_is_said_of_tmpfs_alone(tmp_path: Path, session: RecordedTest) -> None:
    for folder in (tmp_path, Path("/dev/shm")):
        command = ["stat", "-f", "-c", "%T", str(folder)]
        kind = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        made = Ring.create(folder, session, capacity=8)
        assert made.in_memory is (kind == "tmpfs")
        made.remove()


@pytest.mark.skipif(
    "libasan" in os.environ.get("LD_PRELOAD", ""), reason="the sanitizer answers mlock itself"
)
def test_memory_that_may_not_be_locked_is_said_so() -> None:
    command = ["prlimit", "--memlock=4096", "setpriv", "--bounding-set=-ipc_lock"]
    program = [sys.executable, "-c", LOCKING, str(TESTS)]
    done = subprocess.run([*command, *program], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("privileges cannot be given up here")
    assert done.stdout.split() == ["False"]


LOCKING = """
import sys, tempfile, pathlib
sys.path.insert(0, sys.argv[1])
from recording_data import recording
from rthyb_rt.record.ring import Ring
made = Ring.create(pathlib.Path(tempfile.mkdtemp()), recording(1.0), capacity=64)
print(made.locked)
made.remove()
"""


def test_full_tmpfs_is_one_clear_message_and_nothing_is_left(
    tmp_path: Path, session: RecordedTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(RthybError, match=r"no room .* 10\.5 MB needed, [\d.]+ MB free; delete"):
        Ring.create(tmp_path, session)
    assert list(tmp_path.iterdir()) == []


def test_session_that_cannot_be_written_leaves_no_ring(
    tmp_path: Path, session: RecordedTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise RthybError("cannot be written")

    monkeypatch.setattr(recording, "write", fails)
    with pytest.raises(RthybError, match="cannot be written"):
        Ring.create(tmp_path, session, capacity=8)
    assert list(tmp_path.iterdir()) == []


def test_folder_that_is_a_file_is_one_clear_message(tmp_path: Path, session: RecordedTest) -> None:
    (tmp_path / "rings").write_text("in the way")
    with pytest.raises(RthybError, match=r"no telemetry ring can be created here .*permissions"):
        Ring.create(tmp_path / "rings", session, capacity=8)


@pytest.mark.parametrize("capacity", [0, -8, 24])
def test_capacity_that_is_no_power_of_two_is_refused(
    tmp_path: Path, session: RecordedTest, capacity: int
) -> None:
    with pytest.raises(ValueError, match="power of two"):
        Ring.create(tmp_path, session, capacity=capacity)


def test_rings_of_a_user_go_to_the_runtime_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The service's is for the user whose it is: root, who may write there too, has another."""
    monkeypatch.setattr(ring, "_SERVICE", tmp_path)
    assert ring.default_folder() == tmp_path
    owner = os.geteuid()
    monkeypatch.setattr(ring.os, "geteuid", lambda: owner + 1)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1000")
    assert ring.default_folder() == Path("/run/user/1000/rthyb")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert ring.default_folder() == Path(f"/dev/shm/rthyb-{os.geteuid()}")


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder like /dev/shm, with the one of this user's rings still to be made."""
    folder = tmp_path / "shm"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setattr(ring, "_SHARED", folder)
    monkeypatch.setattr(ring, "_SERVICE", tmp_path / "service")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    return ring.default_folder()


def put_there_by_another_user(folder: Path) -> None:
    folder.mkdir(mode=0o777)
    folder.chmod(0o777)
    if os.geteuid() != 0:
        pytest.skip("only root can make a folder that belongs to somebody else")
    os.chown(folder, 65534, 65534)


def test_ring_folder_that_another_user_has_put_there_is_refused(
    shared: Path, session: RecordedTest
) -> None:
    """Its owner could have had any file of the victim's overwritten."""
    put_there_by_another_user(shared)
    with pytest.raises(RthybError, match=r"everyone may write in .*belongs to user 65534"):
        Ring.create(shared, session, 64)
    assert list(shared.iterdir()) == []


def test_ring_folder_that_leads_elsewhere_is_refused(
    shared: Path, session: RecordedTest, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    shared.symlink_to(elsewhere)
    with pytest.raises(RthybError, match="is not a folder but a link"):
        Ring.create(shared, session, 64)
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o755, 0o710])
def test_ring_folder_with_rights_for_others_is_refused_with_the_remedy(
    shared: Path, session: RecordedTest, mode: int
) -> None:
    shared.mkdir()
    shared.chmod(mode)
    with pytest.raises(RthybError, match=f"mode {mode:o}; run chmod 700 {shared}"):
        Ring.create(shared, session, 64)
    shared.chmod(0o700)
    Ring.create(shared, session, 64).remove()


def test_ring_folder_that_is_missing_is_made_for_this_user_alone(
    shared: Path, session: RecordedTest
) -> None:
    made = Ring.create(shared, session, 64)
    assert stat.S_IMODE(shared.stat().st_mode) == 0o700
    made.remove()


def test_other_users_control_socket_is_not_taken_for_the_own_service(
    shared: Path, rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RTHYB_SOCKET", raising=False)
    put_there_by_another_user(shared)
    with socket.socket(socket.AF_UNIX) as imposter:
        imposter.bind(str(shared / "control.sock"))
        imposter.listen()
        imposter.setblocking(False)
        for command in (("ctl", "status"), ("live",)):
            answer = rthyb(*command)
            assert answer.code != 0
            assert "belongs to user 65534" in answer.err
        with pytest.raises(BlockingIOError):
            imposter.accept()
    answer = rthyb("recover")
    assert answer.code == 0
    assert "belongs to user 65534" in answer.err


def test_name_that_leads_to_a_file_of_the_users_does_not_have_it_overwritten(
    tmp_path: Path, session: RecordedTest
) -> None:
    """The session's temporary name can be guessed by who may write beside it."""
    mine = tmp_path / "mine"
    mine.write_text("precious")
    path = tmp_path / f"ring.{ring._boot_id()[:8]}.1"
    path.symlink_to(mine)
    second = tmp_path / f"ring.{ring._boot_id()[:8]}.2"
    part = tmp_path / f".{ring.session_path(second).name}.{os.getpid()}.part"
    part.symlink_to(mine)
    made = Ring.create(tmp_path, session, 64)
    assert made.path == second
    assert mine.read_text() == "precious"
    assert not ring.session_path(second).is_symlink()
    made.remove()


def test_closed_ring_takes_no_more(small: Ring) -> None:
    small.push(rows(0, 3))
    small.close()
    small.close()
    with pytest.raises(RthybError, match="the ring is closed"):
        small.push(rows(3, 1))
    with RingReader(small.path) as reader:
        assert reader.closed
        assert not reader.alive
        assert reader.read().samples["tick"].tolist() == [0, 1, 2]


# ---- readers ------------------------------------------------------------------------------------


def test_readers_follow_at_their_own_pace(small: Ring) -> None:
    with RingReader(small.path) as quick, RingReader(small.path) as slow:
        assert quick.newest() is None
        assert quick.read().samples.size == 0
        for start in (0, 20, 40):
            small.push(rows(start, 20))
            assert quick.read().samples["tick"].tolist() == list(range(start, start + 20))
        assert slow.read(25).samples["tick"].tolist() == list(range(25))
        assert slow.read().first == 25
        assert quick.next == slow.next == quick.pushed == 60
        assert quick.lost == slow.lost == 0


def test_late_reader_begins_with_the_oldest_record(small: Ring) -> None:
    small.push(rows(0, 150))
    with RingReader(small.path) as reader:
        found = reader.read()
        assert found.first == 150 - 64
        assert found.samples["tick"].tolist() == list(range(86, 150))
        assert reader.lost == 0


def test_lapped_reader_knows_what_it_lost(small: Ring) -> None:
    with RingReader(small.path) as reader:
        small.push(rows(0, 10))
        reader.read()
        small.push(rows(10, 100))
        found = reader.read()
        assert reader.lost == found.first - 10 > 0
        assert found.samples["tick"].tolist() == list(range(found.first, 110))
        assert found.first >= 110 - 64


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    steps=st.lists(st.tuples(st.booleans(), st.integers(1, 40)), max_size=30),
    capacity=st.sampled_from([1, 2, 16]),
)
def test_whatever_the_pace_records_come_whole_in_order_or_are_counted_as_lost(
    tmp_path: Path, session: RecordedTest, steps: list[tuple[bool, int]], capacity: int
) -> None:
    made = Ring.create(tmp_path, session, capacity=capacity)
    pushed = read = 0
    with RingReader(made.path) as reader:
        for is_push, count in steps:
            if is_push:
                made.push(rows(pushed, count))
                pushed += count
                continue
            before, lost = reader.next, reader.lost
            found = reader.read(count)
            read += found.samples.size
            ticks = found.samples["tick"].tolist()
            assert ticks == list(range(found.first, found.first + len(ticks)))
            assert are_whole(found.samples)
            assert found.first == before + reader.lost - lost
            if pushed - before <= capacity:
                assert (reader.lost, len(ticks)) == (lost, min(count, pushed - before))
        assert reader.next == read + reader.lost
        newest = reader.newest()
        assert (None if newest is None else newest["tick"]) == (pushed - 1 if pushed else None)
    made.remove()


def test_readers_in_threads_get_whole_records_of_a_running_ring(
    tmp_path: Path, session: RecordedTest
) -> None:
    made = Ring.create(tmp_path, session, capacity=1024)
    total, chunk = 200_000, 10_000
    faults: list[str] = []
    seen: list[tuple[int, int]] = []

    def follow() -> None:
        with RingReader(made.path) as reader:
            read, last = 0, -1
            while reader.next < total:
                found = reader.read(256)
                read += found.samples.size
                if not found.samples.size:
                    time.sleep(1e-4)  # or the producer waits for the GIL, not for a reader
                if not are_whole(found.samples):
                    faults.append("torn")
                newest = reader.newest()
                if newest is not None:
                    if newest["tick"] < last:
                        faults.append("backwards")
                    last = int(newest["tick"])
            seen.append((read, reader.lost))

    threads = [threading.Thread(target=follow) for _ in range(2)]
    for thread in threads:
        thread.start()
    chunks = [rows(start, chunk) for start in range(0, total, chunk)]
    for records in chunks:
        made.push(records)
    for thread in threads:
        thread.join()
    made.remove()
    assert faults == []
    assert all(read + lost >= total - 1024 and read for read, lost in seen)


def test_reader_needs_no_right_to_write(small: Ring) -> None:
    small.push(rows(0, 5))
    small.path.chmod(0o440)
    with RingReader(small.path) as reader:
        assert reader.read().samples.size == 5


def test_reader_knows_whether_the_process_lives(small: Ring) -> None:
    with RingReader(small.path) as one, RingReader(small.path) as other:
        assert one.alive
        assert other.alive
        small.close()
        assert not one.alive
        assert not other.alive


def test_description_names_every_field_with_its_unit(small: Ring) -> None:
    with RingReader(small.path) as reader:
        fields = {field["name"]: field for field in reader.about["fields"]}
    assert {name: field["unit"] for name, field in fields.items()} == recording.UNITS
    for name, field in fields.items():
        dtype, offset = (core.RECORD_DTYPE.fields or {})[name][:2]
        assert (np.dtype(field["type"]), field["offset"]) == (dtype, offset)


def test_file_is_what_the_guide_says(small: Ring) -> None:
    small.push(rows(0, 70))
    data = small.path.read_bytes()
    assert data[:8] == b"rthybrng"
    layout, record_bytes = struct.unpack_from("<II", data, 8)
    about_at, about_bytes, slots_at, size = struct.unpack_from("<4Q", data, 16)
    assert (layout, record_bytes, size) == (3, core.RECORD_DTYPE.itemsize, len(data))
    assert struct.unpack_from("<II", data, 48) == (64, SLOT_BYTES)
    assert struct.unpack_from("<QQ", data, 64) == (70, 0)
    assert about_at == ABOUT_AT
    fields = json.loads(data[about_at : about_at + about_bytes])["fields"]
    dtype = np.dtype(
        {key: [field[name] for field in fields] for key, name in
         (("names", "name"), ("formats", "type"), ("offsets", "offset"))}
        | {"itemsize": record_bytes}
    )  # fmt: skip
    at = slots_at + 69 % 64 * SLOT_BYTES
    assert struct.unpack_from("<Q", data, at) == (2 * 69 + 2,)
    assert np.frombuffer(data, dtype, 1, at + 8)["tick"][0] == 69


# ---- the black box ------------------------------------------------------------------------------


def test_ring_stands_still_a_second_after_a_trip_while_the_status_page_goes_on(
    tmp_path: Path, session: RecordedTest
) -> None:
    made = Ring.create(tmp_path, session, capacity=4096)
    with RingReader(made.path) as reader:
        made.push(rows(0, 100))
        made.push(rows(100, AFTER_TRIP - 1, TRIPPED))
        assert not reader.frozen
        made.push(rows(100 + AFTER_TRIP - 1, 1, TRIPPED))
        assert reader.frozen
        for tick in range(100 + AFTER_TRIP, 5000, 97):
            made.push(rows(tick, 1, TRIPPED))
            newest = reader.newest()
            assert newest is not None
            assert newest["tick"] == tick
        assert reader.pushed == 100 + AFTER_TRIP
        assert reader.read().samples["tick"].tolist() == list(range(100 + AFTER_TRIP))
    made.close()
    with RingReader(made.path) as reader:  # closing does not thaw it
        assert reader.frozen
        assert reader.closed
    made.remove()


def test_reset_lets_the_ring_go_on_and_the_next_trip_freezes_it_again(
    tmp_path: Path, session: RecordedTest
) -> None:
    made = Ring.create(tmp_path, session, capacity=4096)
    with RingReader(made.path) as reader:
        made.push(rows(0, 2000, TRIPPED))
        made.push(rows(2000, 10, IDLE))
        assert not reader.frozen
        made.push(rows(2010, 5, TRIPPED))
        made.push(rows(2015, 5, IDLE))  # reset before the second was over
        made.push(rows(2020, AFTER_TRIP + 7, TRIPPED))
        assert reader.frozen
        assert reader.pushed == AFTER_TRIP + 20 + AFTER_TRIP
    found = ring.recover(made.path)
    assert found.missing_rows == []
    assert found.missing_ticks == [[AFTER_TRIP, 1999]]
    assert str(found.recording.meta["end_reason"]).startswith("tripped")
    made.remove()


# ---- damage -------------------------------------------------------------------------------------


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        RingReader(path)
    assert caught.value.exit_code == 3
    assert caught.value.problems[0].where == str(path)
    return str(caught.value)


def test_ring_of_another_layout_is_refused_with_the_version_that_wrote_it(small: Ring) -> None:
    patch(small.path, 8, struct.pack("<I", 2))
    assert re.search(
        r"the ring of rthyb_rt \d.* has layout 2, but this version reads layout 3",
        refusal(small.path),
    )
    patch(small.path, ABOUT_AT, b"?")
    assert "the ring has layout 2, but this version reads layout 3" in refusal(small.path)


def test_ring_with_other_fields_is_refused(small: Ring) -> None:
    data = small.path.read_bytes()
    patch(small.path, data.index(b'"alpha"'), b'"gamma"')
    assert re.search(r"the ring of rthyb_rt \d.* has different fields", refusal(small.path))


def test_ring_with_longer_records_is_refused(small: Ring) -> None:
    patch(small.path, 12, struct.pack("<I", 160))
    assert "records have a different size" in refusal(small.path)


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (0, bytes(8), "not completely set up"),
        (0, b"RIFF", "not a telemetry ring"),
        (16, struct.pack("<Q", 2**63), "header is damaged"),
        (24, struct.pack("<Q", 2**63), "header is damaged"),
        (32, struct.pack("<Q", 2**64 - 152), "header is damaged"),
        (40, struct.pack("<Q", 2**40), "header is damaged"),
        (48, struct.pack("<I", 0), "header is damaged"),
        (48, struct.pack("<I", 63), "header is damaged"),
        (48, struct.pack("<I", 2**31), "header is damaged"),
        (52, struct.pack("<I", 0), "different size"),
        (ABOUT_AT, b"?", "the description in the ring is damaged"),
    ],
)
def test_damaged_header_is_refused(small: Ring, at: int, value: bytes, message: str) -> None:
    patch(small.path, at, value)
    assert message in refusal(small.path)


@pytest.mark.parametrize("size", [0, 7, 271, 4096, -1])
def test_truncated_ring_is_refused(small: Ring, tmp_path: Path, size: int) -> None:
    copy = tmp_path / "copy"
    copy.write_bytes(small.path.read_bytes()[:size])
    assert re.search(r"too short|truncated", refusal(copy))


def test_what_is_no_file_is_refused(tmp_path: Path, small: Ring) -> None:
    assert "no such file; rings do not survive a reboot" in refusal(tmp_path / "ring.0.1")
    assert f"did you mean {small.path}?" in refusal(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    assert "no such file" in refusal(tmp_path / "pipe")


@settings(
    max_examples=200,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    changes=st.lists(
        st.tuples(st.integers(0, 1), st.integers(0, 4095), st.binary(min_size=1, max_size=9)),
        min_size=1,
        max_size=6,
    )
)
def test_damage_never_makes_a_reader_crash_or_hang(
    tmp_path: Path, small: Ring, changes: list[tuple[int, int, bytes]]
) -> None:
    small.push(rows(0, 70))
    data = bytearray(small.path.read_bytes())
    slots_at = struct.unpack_from("<Q", data, 32)[0]
    for where, offset, value in changes:
        at = offset % 160 if where == 0 else slots_at + offset
        data[at : at + len(value)] = value
    copy = tmp_path / "copy"
    copy.write_bytes(data)
    try:
        reader = RingReader(copy)
    except InputError:
        return
    with reader:
        reader.newest()
        assert sum(reader.read().samples.size for _ in range(3)) <= 64


def test_half_written_slot_is_left_out_and_stated(tmp_path: Path, session: RecordedTest) -> None:
    made = Ring.create(tmp_path, session, capacity=64)
    made.push(rows(0, 50))
    patch(made.path, slot_at(made.path, 20), struct.pack("<Q", 2 * (20 + 64) + 1))
    found = ring.recover(made.path)
    assert found.missing_rows == found.missing_ticks == [[20, 20]]
    assert found.recording.samples["tick"].tolist() == [*range(20), *range(21, 50)]
    made.remove()


@pytest.mark.parametrize(
    ("stamp", "counted", "rows_held"),
    [
        (lambda n: 2 * n + 1, False, (100 - 63, 99)),  # killed among the words
        (lambda n: 2 * n + 2, False, (100 - 63, 100)),  # killed before the count
        (lambda n: 2 * n + 2, True, (101 - 64, 100)),
    ],
    ids=["among-the-words", "before-the-count", "after-all"],
)
def test_process_killed_between_two_instructions_costs_its_last_tick_at_most(
    tmp_path: Path,
    session: RecordedTest,
    stamp: object,
    counted: bool,
    rows_held: tuple[int, int],
) -> None:
    made = Ring.create(tmp_path, session, capacity=64)
    made.push(rows(0, 100))
    at = slot_at(made.path, 100)
    patch(made.path, at + 8, rows(100, 1).tobytes())
    patch(made.path, at, struct.pack("<Q", stamp(100)))  # type: ignore[operator]
    if counted:
        patch(made.path, 64, struct.pack("<Q", 101))
    found = ring.recover(made.path)
    assert found.rows == rows_held
    assert found.missing_rows == [[0, rows_held[0] - 1]]
    assert found.missing_ticks == []
    assert are_whole(found.recording.samples)
    made.remove()


def test_half_written_status_page_does_not_hang_a_reader(small: Ring) -> None:
    small.push(rows(0, AFTER_TRIP + 5, TRIPPED))
    patch(small.path, NEWEST_AT, struct.pack("<Q", 13))
    with RingReader(small.path) as reader:
        assert reader.frozen
        assert reader.newest() is None


# ---- kill -9 ------------------------------------------------------------------------------------

PRODUCER = """
import mmap, pathlib, sys
from recording_data import recording
from ring_rows import CYCLE, rows
from rthyb_rt.record.ring import Ring
folder, capacity, size = pathlib.Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
made = Ring.create(folder, recording(1.0), capacity=capacity)
with (folder / "counter").open("r+b") as file:
    # In one store: struct.pack_into writes zeros first, and may be killed there.
    returned = memoryview(mmap.mmap(file.fileno(), 8)).cast("q")
every = rows(0, CYCLE)
batches = [every[start : start + size] for start in range(0, CYCLE, size)]
pushed = 0
print(made.path, flush=True)
while True:
    for batch in batches:
        made.push(batch)
        pushed += size
        returned[0] = pushed
"""


def killed_producer(folder: Path, capacity: int, batch: int, wait_s: float) -> tuple[Path, int]:
    """Return the ring of a process killed while it pushes, and how many pushes had returned."""
    counter = folder / "counter"
    counter.write_bytes(bytes(8))
    command = [sys.executable, "-c", PRODUCER, str(folder), str(capacity), str(batch)]
    environment = os.environ | {"PYTHONPATH": str(TESTS)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        path = Path(process.stdout.readline().strip())
        with RingReader(path) as reader:
            assert reader.alive
        while counter.read_bytes() == bytes(8):
            time.sleep(1e-3)
        time.sleep(wait_s)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    return path, int(struct.unpack("<q", counter.read_bytes())[0])


def follows_its_rows(found: ring.RecoveredRecording) -> bool:
    """Whether every record is whole and where it was pushed."""
    samples = found.recording.samples
    wanted = np.arange(found.rows[0], found.rows[1] + 1) % CYCLE
    return are_whole(samples) and np.array_equal(samples["tick"], wanted)


@pytest.mark.parametrize("seed", range(5))
def test_killed_process_leaves_every_tick_that_it_had_pushed(tmp_path: Path, seed: int) -> None:
    wait_s = random.Random(seed).uniform(0.0, 0.1)
    path, returned = killed_producer(tmp_path, CAPACITY, 1, wait_s)
    found = ring.recover(path)
    assert not found.alive
    assert found.rows[1] - (returned - 1) in (0, 1)
    assert found.rows[1] - found.rows[0] + 1 >= min(returned, CAPACITY - 1)
    assert follows_its_rows(found)


@pytest.mark.parametrize("seed", range(8))
def test_process_killed_at_full_speed_leaves_no_torn_record(tmp_path: Path, seed: int) -> None:
    wait_s = random.Random(100 + seed).uniform(0.0, 0.02)
    path, returned = killed_producer(tmp_path, 4096, 20_000, wait_s)
    found = ring.recover(path)
    assert found.rows[1] >= returned - 1
    assert found.rows[1] - found.rows[0] + 1 in (4095, 4096)
    assert follows_its_rows(found)
    assert str(found.recording.meta["end_reason"]).startswith("its process ended early")


# ---- from ring to recording ---------------------------------------------------------------------

TEST = """schema = "rthyb-test/1"
rig = "delay-10-elastic"
[test]
name = "plate"
duration_s = 2
[ground_motion]
pga_g = 0.04
[numerical]
period_s = 0.5
damping_ratio = 0.02
"""


@pytest.fixture(scope="module")
def whole() -> RecordedTest:
    """A test of 2 s from its first tick in IDLE to its last."""
    test = config.parse_test(TEST)
    return virtual_time.run(experiment.prepare(test, config.load_rig(config.find_rig(test.rig))))


@pytest.fixture(scope="module")
def tested(whole: RecordedTest) -> RecordedTest:
    """The test proper alone, counted from its own first tick."""
    samples = whole.samples[whole.running()]
    samples["tick"] -= samples["tick"][0]
    return dataclasses.replace(whole, samples=samples)


def test_recovered_test_is_the_test_and_replays_bit_for_bit(
    tmp_path: Path, whole: RecordedTest
) -> None:
    tested = whole
    made = Ring.create(tmp_path, tested)
    made.push(tested.samples)
    made.close()
    found = ring.recover(made.path)
    recording.write(tmp_path / "recording.h5", found.recording)
    back = recording.read(tmp_path / "recording.h5")
    assert back.samples.tobytes() == tested.samples.tobytes()
    assert back.reference is not None
    assert tested.reference is not None
    assert back.reference.tobytes() == tested.reference.tobytes()
    assert (back.test_toml, back.rig_toml) == (tested.test_toml, tested.rig_toml)
    assert back.ground_motion == tested.ground_motion
    assert back.ag_mps2.tobytes() == tested.ag_mps2.tobytes()
    assert realtime.replay(back).identical
    assert back.meta["end_reason"] == "closed (recovered from the telemetry ring)"
    assert back.meta["missing_rows"] == back.meta["missing_ticks"] == []
    assert back.meta["recovered_rows"] == [0, whole.samples.size - 1]
    assert back.meta["core_version"] == tested.meta["core_version"]


def test_lapped_ring_gives_a_recording_from_the_first_row_that_is_left(
    tmp_path: Path, tested: RecordedTest
) -> None:
    made = Ring.create(tmp_path, tested, capacity=1024)
    made.push(tested.samples)
    found = ring.recover(made.path)
    rec = found.recording
    assert found.rows == (1024, 2047)
    assert found.missing_rows == rec.meta["missing_rows"] == [[0, 1023]]
    assert rec.samples.tobytes() == tested.samples[1024:].tobytes()
    assert rec.reference is not None
    assert tested.reference is not None
    assert rec.reference.tobytes() == tested.reference[1024:].tobytes()
    again = summary.summarize(rec).response_nrmse
    late = summary.summarize(replace(rec, reference=tested.reference)).response_nrmse
    assert again is not None
    assert late is not None
    assert again < 0.1 < late
    assert rec.meta["end_reason"] == "still running (recovered from the telemetry ring)"
    assert summary.result_table(rec)
    report.write_report(rec, tmp_path / "report.html")
    made.remove()


def test_long_wait_before_the_test_does_not_cost_its_reference(
    tmp_path: Path, tested: RecordedTest
) -> None:
    made = Ring.create(tmp_path, tested, capacity=4096)
    made.push(rows(0, 3000, IDLE))
    ran = tested.samples.copy()
    ran["tick"] += 3000
    made.push(ran)
    rec = ring.recover(made.path).recording
    assert rec.meta["missing_rows"] == [[0, 951]]
    assert rec.reference is not None
    assert rec.time_s()[rec.running()][0] == 0.0
    made.remove()


def test_gap_within_the_test_costs_its_reference(tmp_path: Path, tested: RecordedTest) -> None:
    made = Ring.create(tmp_path, tested)
    made.push(tested.samples)
    patch(made.path, slot_at(made.path, 700), bytes(8 * 19))
    found = ring.recover(made.path)
    assert found.rows == (0, 699)  # a slot never written: nothing after it can be trusted
    patch(made.path, slot_at(made.path, 700), struct.pack("<Q", 2**40 + 1))
    found = ring.recover(made.path)
    assert found.missing_rows == [[700, 700]]
    assert found.recording.reference is None
    assert found.recording.replay.codec == tested.replay.codec
    made.remove()


def test_blind_rows_come_back_as_skips_and_a_hold_as_interruption(
    tmp_path: Path, session: RecordedTest
) -> None:
    made = Ring.create(tmp_path, session, capacity=128)
    records = rows(0, 100)
    for first, count in ((0, 2), (40, 1), (95, 5)):
        records["flags"][first : first + count] = core.FLAGS["blind"]
    made.push(records)
    plain = ring.recover(made.path).recording
    assert plain.replay.skips.tolist() == [[0, 2], [40, 1], [95, 5]]
    assert plain.meta["interrupted"] is False
    made.push(rows(100, 3, HOLD))
    assert ring.recover(made.path).recording.meta["interrupted"] is True
    made.remove()


def test_renewed_session_is_the_one_that_is_recovered(small: Ring, session: RecordedTest) -> None:
    small.push(rows(0, 5))
    tared = replace(session.replay, tares={"displacement_m": 0.25, "force_n": -3.0})
    small.renew_session(replace(session, replay=tared))
    assert ring.recover(small.path).recording.replay.tares == tared.tares


def test_ring_without_a_record_is_refused(small: Ring) -> None:
    with pytest.raises(InputError, match="no record: its process ended before the first tick"):
        ring.recover(small.path)


def test_ring_without_its_session_is_refused(small: Ring) -> None:
    small.push(rows(0, 5))
    ring.session_path(small.path).unlink()
    with pytest.raises(InputError, match=r"session\.h5 is not beside the ring; copy both"):
        ring.recover(small.path)


# ---- rthyb recover ------------------------------------------------------------------------------


def test_recover_writes_a_recording_and_says_what_is_missing(
    tmp_path: Path,
    tested: RecordedTest,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    made = Ring.create(tmp_path / "rings", tested, capacity=1024)
    made.push(tested.samples)
    made.close()
    assert cli.main(["recover", str(made.path)]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^Rows +1024 \(1\.000 s\) +ticks 1024 to 2047$", out, re.MULTILINE)
    assert re.search(r"^Rows missing +0 to 1023 ", out, re.MULTILINE)
    assert re.search(r"^Ticks missing +none ", out, re.MULTILINE)
    path = Path(out.split("Recording  ")[1].strip())
    assert re.fullmatch(r"runs/plate-\d{8}T\d{6}Z-recovered/recording\.h5", str(path))
    assert recording.open_run(path.parent).samples["tick"][0] == 1024
    assert len(ring.find(tmp_path / "rings")) == 1  # nothing was deleted


def test_recover_as_json_says_the_same(
    tmp_path: Path, small: Ring, capsys: pytest.CaptureFixture[str]
) -> None:
    small.push(rows(7, 5))
    out = tmp_path / "out"
    assert cli.main(["recover", str(small.path), "--out", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["schema"] == "rthyb-recover/1"
    assert answer["alive"] is True
    assert answer["recovered_rows"] == [0, 4]
    assert answer["paths"] == {"folder": str(out), "recording": str(out / "recording.h5")}
    assert recording.open_run(out).samples["tick"].tolist() == [7, 8, 9, 10, 11]


@pytest.mark.parametrize("damage", ["folder", "foreign", "taken"])
def test_recover_that_cannot_be_done_writes_nothing(
    tmp_path: Path, small: Ring, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    small.push(rows(0, 5))
    out = tmp_path / "out"
    given, code = small.path, 3
    if damage == "folder":
        given = small.path.parent
    elif damage == "foreign":
        given = ring.session_path(small.path)
    else:
        out.write_text("in the way")
        code = 2
    assert cli.main(["recover", str(given), "--out", str(out)]) == code
    assert capsys.readouterr().err
    assert not out.is_dir()


# ---- in C alone ---------------------------------------------------------------------------------


PAUSE = """
#define _GNU_SOURCE
#include <time.h>
static void pause_here(void)
{
    const struct timespec t = {0, 60000};
    nanosleep(&t, NULL);
}
"""


def gcc(target: Path, source: Path, *flags: str) -> Path:
    arguments = ["-std=c11", "-DNDEBUG", f"-I{CORE}", *flags, str(TESTS / "ring_stress.c")]
    command = ["gcc", *arguments, str(source), "-lpthread", "-o", str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and "sanitize" in " ".join(flags) and "tsan" in done.stderr:
        pytest.skip("this compiler has no ThreadSanitizer")
    assert done.returncode == 0, done.stderr
    return target


def run(program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    # A preloaded sanitizer would quarrel with this one, and some kernels' random addresses do.
    environment = {key: value for key, value in os.environ.items() if key != "LD_PRELOAD"}
    fixed = ["setarch", "-R"]
    allowed = subprocess.run([*fixed, "true"], capture_output=True, check=False).returncode == 0
    return subprocess.run(
        [*(fixed if allowed else []), str(program), *arguments],
        env=environment | {"TSAN_OPTIONS": "halt_on_error=1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def counts(done: subprocess.CompletedProcess[str]) -> list[list[int]]:
    assert done.returncode == 0, done.stderr
    return [[int(word) for word in line.split()] for line in done.stdout.splitlines()]


def spoilt(folder: Path, good: str, bad: str) -> Path:
    """Return a copy of ring.c with a part of the algorithm taken out."""
    text = (CORE / "ring.c").read_text(encoding="utf-8")
    assert text.count(good) == 1
    path = folder / "ring.c"
    path.write_text(text.replace(good, bad), encoding="utf-8")
    return path


SECOND_LOOK = "return __atomic_load_n(&slot->stamp, __ATOMIC_RELAXED) == stamp;"
WORD_STORE = "__atomic_store_n(&slot->words[i], word, __ATOMIC_RELEASE);"


def test_readers_at_full_speed_see_no_torn_record_and_account_for_every_one(
    tmp_path: Path,
) -> None:
    program = gcc(tmp_path / "stress", CORE / "ring.c", "-O3")
    for pushed, read, lost, torn, disordered in counts(run(program)):
        assert (torn, disordered) == (0, 0)
        assert read + lost == pushed
        assert read > 0


def test_newest_record_never_gets_older_though_threads_pause_anywhere(tmp_path: Path) -> None:
    source = tmp_path / "ring.c"
    text = (CORE / "ring.c").read_text(encoding="utf-8")
    for pause, before in (
        ("if (ring->pushed % 53 == 0) pause_here();", "    ring->pushed++;\n"),
        ("pause_here();", "    set_phase(ring, RTHYB_RING_FROZEN);\n"),
        ("pause_here();", "    set_phase(ring, RTHYB_RING_OPEN);\n"),
        (
            "if (last % 7 == 0) pause_here();",
            "        const rthyb_ring_slot *slot = frozen",
        ),
    ):
        assert text.count(before) == 1
        text = text.replace(before, pause + before)
    source.write_text(PAUSE + text, encoding="utf-8")
    # A reader that slept is lapped.
    program = gcc(tmp_path / "stress", source, "-O2", "-DCAPACITY=4")
    for _, read, _, torn, disordered in counts(run(program)):
        assert read > 0
        assert (torn, disordered) == (0, 0)


def test_torn_records_would_have_been_seen(tmp_path: Path) -> None:
    program = gcc(tmp_path / "stress", spoilt(tmp_path, SECOND_LOOK, "return 1;"), "-O1")
    assert any(torn for _ in range(20) for _, _, _, torn, _ in counts(run(program)))


def test_ring_is_clean_under_the_race_detector(tmp_path: Path) -> None:
    program = gcc(tmp_path / "stress", CORE / "ring.c", "-O1", "-g", "-fsanitize=thread")
    for pushed, read, lost, torn, disordered in counts(run(program)):
        assert (torn, disordered) == (0, 0)
        assert read + lost == pushed


def test_a_race_would_have_been_detected(tmp_path: Path) -> None:
    source = spoilt(tmp_path, WORD_STORE, "slot->words[i] = word;")
    done = run(gcc(tmp_path / "stress", source, "-O1", "-g", "-fsanitize=thread"))
    assert done.returncode != 0
    assert "data race" in done.stderr


@pytest.mark.speed
def test_a_push_costs_little_more_than_copying_the_record(tmp_path: Path) -> None:
    program = gcc(tmp_path / "stress", CORE / "ring.c", "-O3")
    done = run(program, "speed")
    ns = {name: float(value) for name, value in map(str.split, done.stdout.splitlines())}
    assert ns["push"] <= max(10.0, 4.0 * ns["copy"])
    assert ns["read"] <= max(20.0, 8.0 * ns["copy"])


def test_the_ring_asks_the_kernel_nothing_after_its_start(tmp_path: Path) -> None:
    target = tmp_path / "ring.o"
    command = ["gcc", "-std=c11", "-O3", "-fno-pic", "-fno-stack-protector", "-ffunction-sections"]
    subprocess.run([*command, "-c", str(CORE / "ring.c"), "-o", str(target)], check=True)
    # What the compiler has not put into the push itself, by the names of the source.
    parts = ["rthyb_ring_push", "rthyb_ring_push_run", "store", "append", "show", "push_tripped"]
    sections = [word for name in parts for word in ("-j", f".text.{name}")]
    listing = subprocess.run(
        ["objdump", "-r", "-d", *sections, str(target)], capture_output=True, text=True, check=True
    ).stdout
    called = set(re.findall(r"R_\w+\s+([\w.]+)", listing))
    own = {f".text.{name}" for name in parts} | {"rthyb_ring_push", ".text.unlikely"}
    constants = {name for name in called if re.fullmatch(r"\.(LC\d+|rodata[\w.]*)", name)}
    assert called <= own | constants
    symbols = subprocess.run(["nm", str(target)], capture_output=True, text=True, check=True).stdout
    assert not re.search(r" [BbDdC] ", symbols)


# ---- what lies about ----------------------------------------------------------------------------


def test_rings_that_lie_about_are_listed_whatever_is_wrong_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rthyb: Rthyb, session: RecordedTest
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(ring, "_SERVICE", tmp_path / "service")
    monkeypatch.setattr(ring.os, "geteuid", lambda: 4_000_000_000)
    none = rthyb("recover")
    assert none.code == 0
    assert none.out.startswith(f"No ring in {tmp_path}/service, {tmp_path}/rthyb, /dev/shm/rthyb-")
    assert rthyb("recover", "--json").json["rings"] == []
    folder = ring.default_folder()
    assert folder == tmp_path / "rthyb"
    good = Ring.create(folder, session, 64)
    good.push(rows(0, 5))
    good.close()
    folder.joinpath("ring.0.9").write_bytes(b"torn")
    found = {Path(str(one["path"])).name: one for one in rings_listed(rthyb)}
    assert found["ring.0.9"]["fault"].startswith("too short for a telemetry ring; give a file")
    seen = found[good.path.name]
    assert (seen["rows"], seen["ticks"], seen["alive"], seen["fault"]) == (5, 5, False, "")
    ring.session_path(good.path).unlink()
    (orphan,) = [one for one in rings_listed(rthyb) if one["path"] == str(good.path)]
    assert "session file" in str(orphan["fault"])
    assert rthyb("recover", "--out", "x").code == 2


def test_ring_that_goes_while_rings_are_looked_for_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, session: RecordedTest
) -> None:
    """The recorder looks for rings all the time, while daemons delete theirs."""
    stays, goes = (Ring.create(tmp_path, session, 64) for _ in range(2))
    look = Path.stat

    def gone(path: Path, *, follow_symlinks: bool = True) -> os.stat_result:
        if path == goes.path:
            goes.remove()
        return look(path, follow_symlinks=follow_symlinks)

    monkeypatch.setattr(Path, "stat", gone)
    assert ring.find(tmp_path) == [stays.path]
    stays.remove()
    assert list(tmp_path.iterdir()) == []


def rings_listed(rthyb: Rthyb) -> list[dict[str, object]]:
    answer = rthyb("recover", "--json")
    assert answer.code == 0
    found: list[dict[str, object]] = answer.json["rings"]  # type: ignore[assignment]
    return found
