"""Serial lines as they are opened: raw, for one user, checked; on ptys, which are ttys too."""

from __future__ import annotations

import array
import errno
import fcntl
import os
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import loop_bench
import pytest
import serial
from link_tools import as_nobody, nothing_left_open, until, wanted
from loop_bench import Bench, assert_adds_up

from rthyb_rt.core import loop
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import serial_line
from rthyb_rt.rig.links.opening import Opened, open_link


class Pty:
    """A pty in the state in which a terminal program leaves one: cooked, with echo."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        self.path = os.ttyname(self.slave)
        os.set_blocking(self.master, False)

    def close(self) -> None:
        for fd in (self.master, self.slave):
            os.close(fd)

    def waiting(self, fd: int) -> int:
        count = array.array("i", [0])
        fcntl.ioctl(fd, termios.FIONREAD, count)
        return count[0]


@pytest.fixture
def pty() -> Iterator[Pty]:
    made = Pty()
    yield made
    made.close()


def open_pty(pty: Pty, **more: Any) -> Opened:
    return open_link(wanted("serial", pty.path, **more), "controller")


def refusal(path: object, baud: int = 921_600) -> str:
    with nothing_left_open(), pytest.raises(InputError) as refused:
        serial_line.open_line(str(path), baud)
    (problem,) = refused.value.problems
    assert problem.where == str(path)
    return problem.message


# ---- what a line is like -------------------------------------------------------------------------


def test_every_byte_passes_unchanged_both_ways(pty: Pty) -> None:
    every = bytes(range(256))  # ^C, ^S, ^Q, CR, NL and 0xFF among them
    with open_pty(pty) as opened:
        os.write(opened.fd, every)
        until(lambda: pty.waiting(pty.master) == 256)
        assert os.read(pty.master, 300) == every
        os.write(pty.master, every)
        until(lambda: pty.waiting(opened.fd) == 256)
        assert os.read(opened.fd, 300) == every
        assert pty.waiting(pty.master) == 0, "the line echoes"


def test_line_is_8n1_without_flow_control_and_never_waits(pty: Pty) -> None:
    with open_pty(pty) as opened:
        iflag, oflag, cflag, lflag, *_ = termios.tcgetattr(opened.fd)
        assert cflag & termios.CSIZE == termios.CS8
        off = termios.PARENB | termios.CSTOPB | termios.CRTSCTS | termios.HUPCL
        assert not cflag & off
        assert cflag & termios.CREAD
        assert cflag & termios.CLOCAL
        assert not iflag & (termios.IXON | termios.IXOFF | termios.ICRNL | termios.ISTRIP)
        assert not oflag & termios.OPOST
        assert not lflag & (termios.ICANON | termios.ECHO | termios.ISIG)
        assert not os.get_blocking(opened.fd)
        loop.Link(opened.kind, opened.fd).close()


def test_what_came_before_the_line_was_ours_is_thrown_away(pty: Pty) -> None:
    tty.setraw(pty.slave)
    os.write(pty.master, b"half a packet of the last test")
    until(lambda: pty.waiting(pty.slave) == 30)
    with open_pty(pty) as opened, pytest.raises(BlockingIOError):
        os.read(opened.fd, 100)


def test_facts_say_that_it_is_a_pty_and_what_it_carries(pty: Pty) -> None:
    with open_pty(pty) as opened:
        assert opened.kind == "stream"
        assert opened.codec.is_serial
        assert opened.real_time
        assert opened.name == f"{pty.path}, pty 921600 Bd"
        assert opened.facts["pty"] is True
        assert opened.facts["low_latency"] is False  # a pty does not know the word
        assert opened.facts["baud"] == 921600
        # 28 bytes of 10 bits, 1024 times a second
        assert opened.facts["line_load"] == pytest.approx(286720 / 921600)
        assert opened.failure is None


def test_a_rate_that_no_table_has_is_set_exactly(pty: Pty) -> None:
    with open_pty(pty, bitrate=1_234_567) as opened:
        assert serial_line._speed(opened.fd) == 1_234_567


def test_a_whole_test_starts_over_an_opened_line(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    """The controller's end by `open_link`, the drive at the other; on the stepped clock."""
    opened = open_pty(pty)

    def medium(bench: Bench) -> loop_bench.Ends:
        bench.ends = [os.dup(opened.fd), os.dup(pty.master)]
        return opened.kind, opened.codec, bench.ends[0], bench.ends[1]

    monkeypatch.setitem(loop_bench.MEDIA, "pty", medium)
    with opened, Bench("pty") as bench:
        bench.running()
        assert_adds_up(bench)
        assert bench.link.down == "up"


def fake_sysfs(folder: Path, pty: Pty, timer_ms: int) -> Path:
    device = folder / "class" / "tty" / Path(pty.path).name / "device"
    device.mkdir(parents=True)
    (device / "latency_timer").write_text(f"{timer_ms}\n")
    (folder / "drivers" / "ftdi_sio").mkdir(parents=True)
    (device / "driver").symlink_to(folder / "drivers" / "ftdi_sio")
    return device / "latency_timer"


@pytest.mark.parametrize(("timer_ms", "noted"), [(16, True), (1, False)])
def test_adapter_that_holds_bytes_back_is_noted_with_the_remedy(
    pty: Pty, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timer_ms: int, noted: bool
) -> None:
    timer = fake_sysfs(tmp_path, pty, timer_ms)
    monkeypatch.setattr(serial_line, "SYSFS", tmp_path)
    with open_pty(pty) as opened:
        assert opened.facts["driver"] == "ftdi_sio"
        assert opened.facts["latency_timer_ms"] == timer_ms
        notes = opened.facts.get("notes", [])
        assert bool(notes) == noted
        if noted:
            assert "16 ms" in notes[0]
            assert f"echo 1 | sudo tee {timer}" in notes[0]


def test_low_latency_is_asked_of_a_driver_that_has_it(
    pty: Pty, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda _, on: asked.append(on))
    with open_pty(pty) as opened:
        assert opened.facts["low_latency"] is True
    assert asked == [True]


# ---- one user ------------------------------------------------------------------------------------


def test_second_user_is_told_who_has_the_line(pty: Pty) -> None:
    with open_pty(pty):
        assert refusal(pty.path) == (
            f"process {os.getpid()} has it open; a serial line can have only one user: stop that "
            "program first"
        )


def test_pyserial_of_another_program_keeps_us_out_and_is_named(pty: Pty) -> None:
    program = "import serial,sys; s = serial.Serial(sys.argv[1], exclusive=True); print(); input()"
    with subprocess.Popen(
        [sys.executable, "-c", program, pty.path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert f"process {other.pid} has it open" in refusal(pty.path)
        other.communicate(b"\n")
    open_pty(pty).close()


def test_program_that_knows_no_locks_is_kept_out_by_the_kernel(pty: Pty) -> None:
    os.chmod(pty.path, 0o666)
    with open_pty(pty):
        with as_nobody(), pytest.raises(OSError, match="busy") as refused:
            os.open(pty.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        assert refused.value.errno == errno.EBUSY
        with as_nobody():
            assert "opened it exclusively" in refusal(pty.path)
    with as_nobody():
        open_pty(pty).close()  # and is let in again


def test_line_stays_locked_while_the_core_has_it(pty: Pty) -> None:
    opened = open_pty(pty)
    link = loop.Link(opened.kind, opened.fd)
    opened.close()
    assert "has it open" in refusal(pty.path)
    link.close()
    open_pty(pty).close()


def test_closing_twice_does_no_harm_and_leaves_nothing(pty: Pty) -> None:
    with nothing_left_open():
        for _ in range(3):
            opened = open_pty(pty)
            opened.close()
            opened.close()
            assert opened.fd == -1


# ---- bad use -------------------------------------------------------------------------------------


def test_line_that_is_not_there(tmp_path: Path) -> None:
    assert refusal(tmp_path / "ttyUSB7").startswith("no such device; ")


def test_line_that_is_not_there_but_another_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ttyS0", "ttyACM1", "ttyUSB0"):
        (tmp_path / "class" / "tty" / name).mkdir(parents=True)
    monkeypatch.setattr(serial_line, "SYSFS", tmp_path)
    message = refusal(tmp_path / "ttyUSB7")
    assert message == "no such device; serial adapters here: /dev/ttyACM1, /dev/ttyUSB0"


@pytest.mark.parametrize("path", ["/dev/null", "/dev/zero", "/", __file__])
def test_what_is_not_a_serial_line_is_not_even_opened(
    path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial, "Serial", lambda *_, **__: pytest.fail("it was opened"))
    message = refusal(path)
    assert message.startswith("is not a serial line; ")
    assert "adapter" in message


def test_no_permission_names_the_group(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    os.chmod(pty.path, 0)
    monkeypatch.setattr(serial_line, "_group", lambda path: f"group of {path}")
    with as_nobody():
        message = refusal(pty.path)
    assert message.startswith(f"no permission; it belongs to the group group of {pty.path}: ")
    assert "sudo usermod -aG" in message


def test_group_of_a_device_is_read_from_it(tmp_path: Path) -> None:
    assert serial_line._group("/dev/null") == "root"
    assert serial_line._group(str(tmp_path / "gone")) == "dialout"


def test_rate_that_the_driver_changes_is_refused_with_the_one_it_chose(
    pty: Pty, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_line, "_speed", lambda _: 460_800)
    message = refusal(pty.path)
    assert message.startswith("921600 Bd is not supported: the driver chose 460800 Bd")


def test_rate_that_a_divider_nearly_meets_is_taken(
    pty: Pty, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_line, "_speed", lambda _: 923_076)  # 12 MHz / 13
    open_pty(pty).close()


def test_rate_that_the_driver_refuses(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise ValueError("Failed to set custom baud rate (1234567): Invalid argument")

    monkeypatch.setattr(serial.Serial, "_set_special_baudrate", refuse)
    assert "cannot be set up for 1234567 Bd" in refusal(pty.path, 1_234_567)


def test_line_too_slow_for_the_samples_is_refused(pty: Pty) -> None:
    assert "115200 Bd" in refusal(pty.path, 115_200)


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EIO, "there is no hardware behind it"),
        (errno.ENXIO, "there is no hardware behind it"),
        (errno.EMFILE, "cannot be opened: Too many open files"),
    ],
)
def test_what_the_kernel_says_on_opening_is_said_in_words(
    pty: Pty, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise serial.SerialException(number, "could not open port")

    monkeypatch.setattr(serial, "Serial", fail)
    assert words in refusal(pty.path)


def test_port_without_hardware_behind_its_name(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with /dev/ttyS9 of a PC: it opens, and the first word to it fails."""

    def fail(*_: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(termios, "tcgetattr", fail)
    assert "there is no hardware behind it (Input/output error)" in refusal(pty.path)
