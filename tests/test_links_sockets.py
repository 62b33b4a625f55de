"""CAN frames over AF_UNIX sockets, and the locks that keep a link for one user."""

from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import loop_bench
import numpy as np
import pytest
from link_tools import as_nobody, nothing_left_open, until, wanted
from loop_bench import Bench, assert_adds_up

from rthyb_rt import core
from rthyb_rt.core import loop
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import locks, sockets
from rthyb_rt.rig.links.opened import Owned
from rthyb_rt.rig.links.opening import Opened, connect_socket, listen_socket, open_link, socket_pair


@pytest.fixture(autouse=True)
def own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "locks"
    folder.mkdir()
    monkeypatch.setattr(locks, "SHARED_FOLDER", folder)
    return folder


class Listening:
    """A drive that waits for its controller in a thread."""

    def __init__(self, path: Path) -> None:
        self.opened: Opened | None = None
        self._thread = threading.Thread(target=self._listen, args=(path,))
        self._thread.start()
        until(path.exists)

    def _listen(self, path: Path) -> None:
        self.opened = open_link(wanted("socket", path), "drive")

    def join(self) -> Opened:
        self._thread.join(20.0)
        assert self.opened is not None
        return self.opened


def refusal(path: Path | str, what: str = "connect") -> str:
    call = {"connect": connect_socket, "listen": listen_socket}[what]
    with nothing_left_open(), pytest.raises(InputError) as refused:
        call(path)
    (problem,) = refused.value.problems
    assert problem.where == str(path)
    return problem.message


def same_records(first: Bench, second: Bench) -> bool:
    """All that the core computed from tick to tick, bit for bit."""
    one, other = (np.asarray(bench.rows()).tobytes() for bench in (first, second))
    return one == other


def on(monkeypatch: pytest.MonkeyPatch, ours: Opened, theirs: Opened) -> str:
    """A medium for the bench made of an opened link's two ends."""

    def medium(bench: Bench) -> loop_bench.Ends:
        bench.ends = [os.dup(ours.fd), os.dup(theirs.fd)]
        return ours.kind, ours.codec, bench.ends[0], bench.ends[1]

    monkeypatch.setitem(loop_bench.MEDIA, "opened", medium)
    return "opened"


# ---- a link --------------------------------------------------------------------------------------


def test_pair_carries_a_test_as_a_bare_socket_pair_does(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket_pair()
    with ours, theirs, Bench(on(monkeypatch, ours, theirs)) as bench, Bench() as bare:
        assert_adds_up(bench.running())
        assert same_records(bench, bare.running())


def test_pair_says_what_it_is_and_leaves_nothing() -> None:
    with nothing_left_open():
        ours, theirs = socket_pair()
        assert (ours.kind, ours.real_time, ours.codec.command_id) == ("can", True, 0x101)
        assert ours.fd != theirs.fd
        for opened in (ours, theirs, ours, theirs):
            opened.close()


def test_controller_meets_the_drive_that_listens_at_a_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rig.socket"
    with nothing_left_open():
        drive = Listening(path)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        with open_link(wanted("socket", path), "controller") as ours, drive.join() as theirs:
            assert ours.facts == {"path": str(path)}
            with Bench(on(monkeypatch, ours, theirs)) as bench:
                assert_adds_up(bench.running(50))


def test_drive_takes_one_controller_and_no_other_finds_the_path(tmp_path: Path) -> None:
    path = tmp_path / "rig.socket"
    drive = Listening(path)
    with open_link(wanted("socket", path), "controller"), drive.join():
        assert not path.exists()
        message = refusal(path)
        assert f"process {os.getpid()} has it open as controller" in message
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
            assert other.connect_ex(str(path)) != 0


def test_one_end_gone_is_a_hang_up_at_the_other(tmp_path: Path) -> None:
    drive = Listening(tmp_path / "rig.socket")
    with connect_socket(tmp_path / "rig.socket") as ours:
        link = loop.Link(ours.kind, ours.fd)
        drive.join().close()
        station = core.Station(loop_bench.config(), loop_bench.shaking(0.1))
        tick = loop.Loop(station, loop_bench.wire.Wire(ours.codec), link)
        tick.step()
        assert link.down == "hung-up"
        link.close()


# ---- bad use -------------------------------------------------------------------------------------


def test_no_drive_has_been_started(tmp_path: Path) -> None:
    path = tmp_path / "rig.socket"
    start = f"`rthyb rig RIG.toml --socket {path}`"
    assert refusal(path) == f"the socket does not exist; start the drive first: {start}"


def test_drive_that_died_leaves_a_path_to_nobody_and_the_next_one_takes_it(tmp_path: Path) -> None:
    path = tmp_path / "rig.socket"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(path))
        dead.listen(1)
    assert refusal(path).startswith("no program is listening there; start the drive first")
    drive = Listening(path)
    ours = until(lambda: _connected(path))  # the old path may be there for a moment, or none
    ours.close()
    drive.join().close()


def _connected(path: Path) -> Opened | None:
    try:
        return connect_socket(path)
    except InputError:
        return None


@pytest.mark.parametrize("kind", [socket.SOCK_SEQPACKET, socket.SOCK_STREAM])
def test_path_at_which_another_program_listens_is_left_alone(
    tmp_path: Path, kind: socket.SocketKind
) -> None:
    path = tmp_path / "rig.socket"
    with socket.socket(socket.AF_UNIX, kind) as other:
        other.bind(str(path))
        other.listen(1)
        assert refusal(path, "listen").startswith("another program is listening there")
        assert path.is_socket()


def test_file_at_the_path_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("precious")
    assert "is not a socket; choose another path" in refusal(path, "listen")
    assert path.read_text() == "precious"


def test_link_to_a_file_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("precious")
    path = tmp_path / "rig.socket"
    path.symlink_to(tmp_path / "rig.toml")
    assert "not a socket" in refusal(path, "listen")
    assert path.is_symlink()


def test_socket_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "other.socket"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(path))
        other.listen(1)
        message = refusal(path)
        assert "not the socket of a virtual drive" in message
        assert "use the same path" in message


def test_folder_that_is_not_there(tmp_path: Path) -> None:
    message = refusal(tmp_path / "none" / "rig.socket", "listen")
    assert message == "no socket can be created there: No such file or directory"


def test_path_too_long_for_a_socket(tmp_path: Path) -> None:
    long = tmp_path / ("x" * 120)
    assert "AF_UNIX path too long" in refusal(long, "listen")
    assert "AF_UNIX path too long" in refusal(long)


def let_others_reach(path: Path) -> None:
    """Open a folder of pytest and those above it, which are its user's own."""
    top = Path(tempfile.gettempdir())
    if top not in path.parents:
        pytest.skip(f"{path} is not in {top}, and other folders are not opened")
    while path != top:
        path.chmod(0o755)
        path = path.parent


def test_socket_of_another_user(tmp_path: Path) -> None:
    let_others_reach(tmp_path)
    (tmp_path / "locks").chmod(0o777)
    path = tmp_path / "rig.socket"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        sockets._bind(other, str(path))
        if os.geteuid():
            path.chmod(0)
        with as_nobody():
            assert "no permission; only the user who started a virtual drive" in refusal(path)


def test_nobody_comes_in_time_and_the_path_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "rig.socket"
    with nothing_left_open(), pytest.raises(InputError, match="no controller connected within"):
        listen_socket(path, timeout_s=0.01)
    assert not path.exists()


# ---- locks ---------------------------------------------------------------------------------------

HOLDER = """
import sys
from pathlib import Path
from rthyb_rt.rig.links import locks
from rthyb_rt.rig.links.opened import Owned
locks.SHARED_FOLDER = Path(sys.argv[1])
with Owned() as owned:
    locks.hold(owned, "can0", "can0", "controller")
    print(flush=True)
    input()
"""


@pytest.fixture
def other(own_locks: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Another process that has can0 open as controller."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(own_locks)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process
        process.kill()


def test_second_controller_is_told_which_process_is_the_first(
    other: subprocess.Popen[bytes],
) -> None:
    with Owned() as owned, nothing_left_open(), pytest.raises(InputError) as refused:
        locks.hold(owned, "can0", "can0", "controller")
    assert str(refused.value) == (
        f"can0: process {other.pid} has it open as controller; a link can have only one "
        "controller at a time: stop that program first"
    )


def test_drive_and_other_interfaces_have_locks_of_their_own(
    other: subprocess.Popen[bytes],
) -> None:
    del other
    with nothing_left_open(), Owned() as owned:
        locks.hold(owned, "can0", "can0", "drive")
        locks.hold(owned, "can1", "can1", "controller")


def test_killed_controller_leaves_the_link_free(
    other: subprocess.Popen[bytes], own_locks: Path
) -> None:
    other.kill()
    other.wait()
    with Owned() as owned:
        locks.hold(owned, "can0", "can0", "controller")
        assert [path.name for path in own_locks.iterdir()] == ["rthyb-can0-controller.lock"]
    assert list(own_locks.iterdir()) == []


def test_many_at_once_and_never_two_have_it(own_locks: Path) -> None:
    """Files come and go under one name; a counter that two would spoil shows who had it."""
    inside, most, taken = [0], [0], [0]

    def use() -> None:
        for _ in range(60):
            try:
                with Owned() as owned:
                    locks.hold(owned, "can0", "can0", "controller")
                    inside[0] += 1
                    most[0] = max(most[0], inside[0])
                    taken[0] += 1
                    inside[0] -= 1
            except InputError:
                pass

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1
    assert taken[0] > 0
    assert list(own_locks.iterdir()) == []


def test_two_paths_that_look_alike_have_two_locks() -> None:
    with Owned() as owned:
        for path in ("/tmp/a-b", "/tmp/a_b", "/tmp/a/b", "x" * 100 + "1", "x" * 100 + "2"):
            locks.hold(owned, path, path, "drive")


def test_one_path_by_two_names_has_one_lock(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "alias").symlink_to(tmp_path / "real")
    drive = Listening(tmp_path / "real" / "rig.socket")
    assert "has it open as drive" in refusal(tmp_path / "alias" / "rig.socket", "listen")
    connect_socket(tmp_path / "alias" / "rig.socket").close()
    drive.join().close()


def test_locks_go_where_all_users_meet_or_else_to_the_users_own_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_locks: Path
) -> None:
    own = tmp_path / "own"
    own.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(own))
    assert locks.folder() == own_locks
    monkeypatch.setattr(locks, "SHARED_FOLDER", tmp_path / "none")
    assert locks.folder() == own
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert locks.folder().is_dir()


def test_trap_in_place_of_a_lock_file_is_not_followed(own_locks: Path, tmp_path: Path) -> None:
    (own_locks / "rthyb-can0-drive.lock").symlink_to(tmp_path / "elsewhere")
    with nothing_left_open(), Owned() as owned, pytest.raises(InputError, match="cannot be locked"):
        locks.hold(owned, "can0", "can0", "drive")
    assert not (tmp_path / "elsewhere").exists()


def test_lock_file_of_another_user_serves_too(own_locks: Path) -> None:
    """In a folder for everybody the kernel lets nobody create what another user has there."""
    own_locks.chmod(0o1777)
    path = own_locks / "rthyb-can0-drive.lock"
    path.touch(0o444)
    let_others_reach(own_locks.parent)
    with as_nobody(), Owned() as owned:
        locks.hold(owned, "can0", "can0", "drive")
        with pytest.raises(InputError, match="has it open as drive"):
            locks.hold(owned, "can0", "can0", "drive")
