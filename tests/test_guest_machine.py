"""What the guest machine of `make test-vm` needs of its host, without the machine itself."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import stalls
from realtime_bench import until
from vm import guest

pytestmark = pytest.mark.skipif(
    platform.machine() != "x86_64", reason="the guest is a kernel for amd64"
)
HERE = Path(__file__).parent


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(guest, "STORE", tmp_path / "vm")
    return guest.build("xstate", "-shared", "-fPIC", "-ldl")


def set_short_area(folder: Path, preload: Path | None) -> str:
    program = folder / "tracee"
    if not program.exists():
        options = ("-std=c11", "-Wall", "-Wextra", "-Werror")
        subprocess.run(["gcc", *options, HERE / "xstate_tracee.c", "-o", program], check=True)
    preloaded = {"LD_PRELOAD": str(preload)} if preload else {}
    ran = subprocess.run(
        [program], env={**os.environ, **preloaded}, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    if ran.stdout.startswith("no "):
        pytest.skip(f"this machine has {ran.stdout}")
    return ran.stdout


def test_registers_are_set_from_an_area_shorter_than_the_processors(
    library: Path, tmp_path: Path
) -> None:
    """As on a processor with AMX: refused by the host, until the library is before the guest."""
    assert set_short_area(tmp_path, None) == "refused\n"
    assert set_short_area(tmp_path, library) == "front given\nrest kept, with ymm0\n"


@pytest.mark.parametrize(("known", "needed"), [(0, True), (1 << 20, False)])
def test_library_is_used_where_the_processors_area_is_the_larger_one(
    library: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    known: int,
    needed: bool,
) -> None:
    monkeypatch.setattr(guest, "GUEST_XSTATE", known)
    assert guest.preloaded() == ([library] if needed else [])
    assert capsys.readouterr().out.count("\n") == needed
    assert guest.preloaded(always=True) == [library]


def test_what_is_built_is_built_once_and_again_when_its_source_is_newer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guest, "STORE", tmp_path / "vm")
    built = guest.build("reference", "-lpthread")
    built_ns = built.stat().st_mtime_ns
    assert guest.build("reference").stat().st_mtime_ns == built_ns
    os.utime(built, (0, 0))
    assert guest.build("reference", "-lpthread").stat().st_mtime_ns >= built_ns


_TIMED = """
import ctypes, select, time

class Timespec(ctypes.Structure):
    _fields_ = [("s", ctypes.c_long), ("ns", ctypes.c_long)]

class Setting(ctypes.Structure):
    _fields_ = [("every", Timespec), ("ahead", Timespec)]

class Event(ctypes.Structure):
    _fields_ = [("value", ctypes.c_void_p), ("signal", ctypes.c_int), ("notify", ctypes.c_int),
                ("rest", ctypes.c_byte * 64)]

libc, timer = ctypes.CDLL(None), ctypes.c_void_p()
assert libc.timer_create(1, ctypes.byref(Event(notify=1)), ctypes.byref(timer)) == 0

def waited(sleep_s, ahead_ns):
    setting = Setting(ahead=Timespec(0, ahead_ns))
    assert libc.timer_settime(timer, 0, ctypes.byref(setting), None) == 0
    begun = time.monotonic()
    for _ in range(3):
        select.select([], [], [], sleep_s / 3)
        ended = time.monotonic()
    return ended - begun

print(waited(0.6, 0), waited(0.6, 100_000_000), waited(0.6, 900_000_000), waited(6.0, 100_000_000))
"""


def test_clock_of_the_guest_stands_where_the_host_is_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a third of the pace, and not beyond what is due, unless no timer is ever set again."""
    monkeypatch.setattr(guest, "STORE", tmp_path / "vm")
    clock = guest.build("clock", "-shared", "-fPIC", "-ldl")
    ran = subprocess.run(
        [sys.executable, "-I", "-c", _TIMED],
        env={"LD_PRELOAD": str(clock)},
        capture_output=True,
        text=True,
        check=True,
    )
    without, late, early, for_ever = map(float, ran.stdout.split())
    assert without == pytest.approx(0.2, abs=0.07)
    assert late == pytest.approx(0.1005, abs=2e-4)
    assert early == pytest.approx(0.2, abs=0.07)
    assert for_ever > 1.5


@pytest.mark.skipif(os.geteuid() != 0, reason="a thread that comes before all others is root's")
def test_reference_thread_notes_when_it_was_stopped_and_for_how_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guest, "STORE", tmp_path / "vm")
    with subprocess.Popen([guest.build("reference", "-lpthread"), tmp_path / "late"]) as running:
        try:
            until((tmp_path / "late").exists, "the reference thread")
            time.sleep(0.2)
            begin_s = time.monotonic()
            running.send_signal(signal.SIGSTOP)
            time.sleep(0.3)
            end_s = time.monotonic()
            assert not stalls.proof(stalls.read(tmp_path / "late"), "stalled", end_s, end_s)
            running.send_signal(signal.SIGCONT)
            time.sleep(0.2)
        finally:
            running.kill()
    lates = stalls.read(tmp_path / "late")
    if running.returncode == 1:
        pytest.skip("no real-time priority here")
    for thread in ("fifo", "other"):
        late = max((each for each in lates if each.thread == thread), key=lambda each: each.ticks)
        assert begin_s - 0.05 <= late.due_s
        assert late.woken_s - late.due_s >= 0.25
    assert stalls.proof(lates, "stalled", end_s, end_s)
