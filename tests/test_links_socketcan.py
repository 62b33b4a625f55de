"""SocketCAN itself: needs a kernel with vcan (RTHYB_VCAN=vcan0) and, to change it, its root."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import socket
import struct
import subprocess
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import loop_bench
import pytest
from link_tools import LinkUnderTest, nothing_left_open, until, wanted
from loop_bench import Bench, assert_adds_up

from rthyb_rt import core
from rthyb_rt.core import wire
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import can_bus, locks, netlink
from rthyb_rt.rig.links.opening import Opened, Side, open_link

VCAN: Final = os.environ.get("RTHYB_VCAN", "vcan0")
FD_DBC: Final = Path(__file__).parent / "data" / "links" / "fd_extended.dbc"
FRAME: Final = struct.Struct("=IB3x8s")
BUS_OFF: Final = 0x2000_0040
SPARE: Final = "rthyb-spare"
N_SLCAN: Final = 17
TIOCSETD: Final = 0x5423

pytestmark = pytest.mark.skipif(
    VCAN not in {name for _, name in socket.if_nameindex()},
    reason=f"this kernel has no {VCAN} (RTHYB_VCAN names another; make test-vm has one)",
)


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@pytest.fixture(autouse=True)
def own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "SHARED_FOLDER", tmp_path)


@pytest.fixture
def spare() -> Iterator[str]:
    """A virtual bus of this test alone, which may go down or away."""
    ip("link", "add", SPARE, "type", "vcan")
    ip("link", "set", SPARE, "up")
    yield SPARE
    with contextlib.suppress(subprocess.CalledProcessError):
        ip("link", "del", SPARE)


@pytest.fixture
def stranger() -> Iterator[socket.socket]:
    """A plain socket of another program on the bus."""
    with raw_socket(VCAN) as sock:
        yield sock


def raw_socket(name: str) -> socket.socket:
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.bind((name,))
    sock.settimeout(20.0)
    return sock


def opened_can(channel: str = VCAN, side: Side = "controller", **more: Any) -> Opened:
    return open_link(wanted("can", channel, **more), side)


def waiting(opened: Opened) -> list[bytes]:
    """All that has come."""
    frames = []
    with socket.socket(fileno=os.dup(opened.fd)) as end:
        while select.select([end], [], [], 0.02)[0]:
            frames.append(end.recv(100))
    return frames


# ---- a test over it ------------------------------------------------------------------------------


def test_test_over_vcan_is_bit_for_bit_that_over_a_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    with opened_can() as ours, opened_can(side="drive") as theirs:

        def medium(bench: Bench) -> loop_bench.Ends:
            bench.ends = [os.dup(ours.fd), os.dup(theirs.fd)]
            return ours.kind, ours.codec, bench.ends[0], bench.ends[1]

        monkeypatch.setitem(loop_bench.MEDIA, "vcan", medium)
        with Bench("vcan") as bench, Bench() as bare:
            assert_adds_up(bench.running())
            bare.running()
            assert bench.rows().tobytes() == bare.rows().tobytes()


def test_facts_of_a_virtual_bus() -> None:
    with opened_can(bitrate=1_000_000) as opened:
        assert opened.name == f"{VCAN}, virtual CAN"
        assert opened.real_time
        assert opened.kind == "can"
        assert opened.facts["driver"] == "vcan"
        assert "bitrate" not in opened.facts
        assert "restart_ms" not in opened.facts
        # The kernel gives twice what is asked, up to net.core.rmem_max; at least its default.
        assert opened.facts["receive_buffer_bytes"] >= 212_992
        assert opened.facts["send_buffer_bytes"] < 10_000


# ---- frames --------------------------------------------------------------------------------------


def test_only_the_other_sides_frames_come_in(stranger: socket.socket) -> None:
    with opened_can() as opened, opened_can(side="drive") as drive:
        for number in (0x101, 0x180, 0x181, 0x182, 0x7FF, 0x8000_0181, 0x4000_0182):
            stranger.send(FRAME.pack(number, 8, bytes(8)))
        assert [FRAME.unpack(raw)[0] for raw in waiting(opened)] == [0x181, 0x182]
        assert [FRAME.unpack(raw)[0] for raw in waiting(drive)] == [0x101]


def test_own_frames_are_not_heard_but_others_hear_them(stranger: socket.socket) -> None:
    with opened_can() as opened, socket.socket(fileno=os.dup(opened.fd)) as end:
        end.send(FRAME.pack(0x181, 8, b"from us."))  # passes our own filters
        assert FRAME.unpack(stranger.recv(100)) == (0x181, 8, b"from us.")
        assert waiting(opened) == []


def test_what_came_while_it_was_opened_is_thrown_away(
    stranger: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between bind and filters everything comes in."""
    discard = can_bus._discard

    def late(sock: socket.socket) -> None:
        stranger.send(FRAME.pack(0x181, 8, bytes(8)))
        discard(sock)

    monkeypatch.setattr(can_bus, "_discard", late)
    with opened_can() as opened:
        assert waiting(opened) == []


def test_other_interfaces_are_not_heard(spare: str) -> None:
    with opened_can() as opened, raw_socket(spare) as elsewhere:
        elsewhere.send(FRAME.pack(0x181, 8, bytes(8)))
        assert waiting(opened) == []


def test_can_fd_frames_by_a_dbc(spare: str) -> None:
    ip("link", "set", spare, "down")
    ip("link", "set", spare, "mtu", "72")
    ip("link", "set", spare, "up")
    link = wanted("can", spare, dbc=FD_DBC.name, fd=True, names={"x_cmd": "SetPos"})
    with (
        open_link(link, "controller", folder=FD_DBC.parent) as ours,
        open_link(link, "drive", folder=FD_DBC.parent) as theirs,
        LinkUnderTest(ours) as tick,
        socket.socket(fileno=os.dup(theirs.fd)) as drive,
    ):
        (frame,) = ours.codec.encode_feedback(wire.Reading(0.0125, -4500.0, 1, 2))
        drive.send(struct.pack("=IB3x64s", frame.id, len(frame.data), frame.data))
        # The kernel hands a frame on when it likes.
        end = time.monotonic() + 20.0
        assert tick.down() == "up"
        while not tick.loop.records["flags"][-1] & core.FLAGS["fresh"] and time.monotonic() < end:
            assert tick.down() == "up"
        assert tick.loop.records["x_meas_m"][-1] == pytest.approx(0.0125, abs=1e-6)
        drive.settimeout(20.0)
        command = drive.recv(100)
        assert len(command) == 72
        (number,) = struct.unpack_from("=I", command)
        assert number == ours.codec.command_id


# ---- errors --------------------------------------------------------------------------------------


def test_bus_off_reaches_the_core(stranger: socket.socket) -> None:
    with opened_can() as opened, LinkUnderTest(opened) as tick:
        assert tick.down() == "up"
        stranger.send(FRAME.pack(BUS_OFF, 8, bytes(8)))
        until(lambda: tick.down() == "bus-off")
        assert tick.link.counters()["error_frames"] == 1


@pytest.mark.parametrize("bit", range(10))
def test_error_frames_of_every_class_come_through(stranger: socket.socket, bit: int) -> None:
    with opened_can() as opened:
        stranger.send(FRAME.pack(0x2000_0000 | 1 << bit, 8, bytes(8)))
        assert [FRAME.unpack(raw)[0] for raw in waiting(opened)] == [0x2000_0000 | 1 << bit]


def test_interface_goes_down_and_comes_back(spare: str) -> None:
    with opened_can(spare) as opened, LinkUnderTest(opened) as tick:
        assert tick.down() == "up"
        ip("link", "set", spare, "down")
        until(lambda: tick.down() == "network-down")
        ip("link", "set", spare, "up")
        with raw_socket(spare) as stranger, socket.socket(fileno=os.dup(opened.fd)) as end:
            assert tick.down() == "network-down"  # until something passes
            stranger.send(FRAME.pack(0x181, 8, bytes(8)))
            until(lambda: tick.down() == "up")
            end.send(FRAME.pack(0x101, 8, bytes(8)))
            assert FRAME.unpack(stranger.recv(100))[0] == 0x101
            stranger.send(FRAME.pack(0x7FF, 8, bytes(8)))
            stranger.send(FRAME.pack(0x182, 8, bytes(8)))
        assert [FRAME.unpack(raw)[0] for raw in waiting(opened)] == [0x182], "filters are gone"


def test_interface_is_deleted(spare: str) -> None:
    with opened_can(spare) as opened, LinkUnderTest(opened) as tick:
        assert tick.down() == "up"
        ip("link", "del", spare)
        until(lambda: tick.down() == "device-gone")


# ---- opening -------------------------------------------------------------------------------------


def refusal(channel: str, **more: Any) -> str:
    with nothing_left_open(), pytest.raises(InputError) as refused:
        opened_can(channel, **more)
    assert str(refused.value).startswith(f"{channel}: ")
    return str(refused.value)


def test_second_controller_is_refused_and_the_drive_is_not() -> None:
    with opened_can(), opened_can(side="drive"):
        assert f"process {os.getpid()} has it open as controller" in refusal(VCAN)
    with nothing_left_open():
        opened = opened_can()
        opened.close()
        opened.close()


def test_no_such_interface_names_those_that_are_there() -> None:
    message = refusal("can9")
    assert message.startswith("can9: no such interface; CAN interfaces here: ")
    assert VCAN in message


def test_interface_that_is_not_can() -> None:
    assert "is a network interface, but not CAN" in refusal("lo")


def test_interface_that_is_down(spare: str) -> None:
    ip("link", "set", spare, "down")
    assert f"the interface is down; set it up with `sudo ip link set {spare} up`" in refusal(spare)
    subprocess.run(["ip", "link", "set", spare, "up"], check=True)  # as it says
    opened_can(spare).close()


def test_can_fd_over_an_interface_without(spare: str) -> None:
    ip("link", "set", spare, "down")
    ip("link", "set", spare, "mtu", "16")
    ip("link", "set", spare, "up")
    assert f"ip link set {spare} mtu 72 up" in refusal(spare, fd=True)
    opened_can(spare).close()


def test_interface_that_goes_between_look_and_bind(
    spare: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = netlink.interfaces()
    ip("link", "del", spare)
    monkeypatch.setattr(netlink, "interfaces", lambda: known)
    with pytest.warns(ResourceWarning):  # python-can's own socket, which it left open
        assert "cannot be opened: No such device" in refusal(spare)


def test_filters_that_the_kernel_did_not_take_are_found_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """python-can would go on and filter in Python, where the core never reads."""
    from can.interfaces.socketcan import SocketcanBus

    monkeypatch.setattr(SocketcanBus, "_apply_filters", lambda *_: None)
    assert "the kernel does not support: identifier filters" in refusal(VCAN)


# ---- slcan: an adapter with a bit rate -----------------------------------------------------------


class Adapter:
    """A serial CAN adapter: the kernel's slcan on a pty, somebody at the other end who reads."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        before = {name for _, name in socket.if_nameindex()}
        fcntl.ioctl(self.slave, TIOCSETD, struct.pack("i", N_SLCAN))
        (self.name,) = {name for _, name in socket.if_nameindex()} - before
        self.said = b""
        self._end = threading.Event()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        while not self._end.is_set():
            if select.select([self.master], [], [], 0.02)[0]:
                with contextlib.suppress(OSError):
                    self.said += os.read(self.master, 4096)

    def set_up(self, *options: str) -> None:
        ip("link", "set", self.name, "down")
        ip("link", "set", self.name, "up", "type", "can", *options)

    def close(self) -> None:
        self._end.set()
        self._reader.join()
        os.close(self.slave)
        os.close(self.master)


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    try:
        made = Adapter()
    except (OSError, ValueError) as error:
        pytest.skip(f"no slcan here: {error}")
    yield made
    made.close()


def test_bit_rate_of_the_kernel_is_compared_with_the_rig_files(adapter: Adapter) -> None:
    adapter.set_up("bitrate", "800000")
    message = refusal(adapter.name, bitrate=1_000_000)
    assert "its bit rate is 800000 bit/s, but the rig file says 1000000" in message
    assert f"sudo ip link set {adapter.name} up type can bitrate 1000000`" in message
    with opened_can(adapter.name, bitrate=800_000) as opened:
        assert opened.name == f"{adapter.name}, CAN 800 kbit/s"
        assert opened.facts["bitrate"] == 800_000
        assert opened.facts["restart_ms"] == 0
        # 3 frames of 135 bits, 1024 times a second
        assert opened.facts["bus_load"] == pytest.approx(3 * 135 * 1024 / 800_000)


def test_remedy_for_another_bit_rate_works(adapter: Adapter) -> None:
    adapter.set_up("bitrate", "500000")
    message = refusal(adapter.name, bitrate=1_000_000)
    for line in message.split("`")[1].split("; "):
        ip(*line.removeprefix("sudo ip ").split())
    opened_can(adapter.name, bitrate=1_000_000).close()


def test_bit_rate_too_low_for_the_samples(adapter: Adapter) -> None:
    adapter.set_up("bitrate", "500000")
    assert "load the bus" in refusal(adapter.name)


def test_adapter_that_only_listens(adapter: Adapter) -> None:
    adapter.set_up("bitrate", "1000000", "listen-only", "on")
    assert "listen-only mode is on" in refusal(adapter.name)


def test_commands_go_out_over_the_adapter_and_its_frames_come_in(adapter: Adapter) -> None:
    adapter.set_up("bitrate", "1000000")
    with opened_can(adapter.name) as opened, socket.socket(fileno=os.dup(opened.fd)) as end:
        os.write(adapter.master, b"t18180011223344556677\rt18280000000000000000\r")
        until(lambda: select.select([opened.fd], [], [], 0)[0])
        assert waiting(opened)[0] == FRAME.pack(0x181, 8, bytes.fromhex("0011223344556677"))
        end.send(FRAME.pack(0x101, 8, b"12345678"))
        until(lambda: b"t10183132333435363738\r" in adapter.said)


def test_adapter_that_is_pulled_out(adapter: Adapter) -> None:
    adapter.set_up("bitrate", "1000000")
    with opened_can(adapter.name) as opened, LinkUnderTest(opened) as tick:
        assert tick.down() == "up"
        fcntl.ioctl(adapter.slave, TIOCSETD, struct.pack("i", 0))
        until(lambda: tick.down() == "device-gone")
