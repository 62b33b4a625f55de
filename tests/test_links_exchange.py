"""Interfaces of python-can other than SocketCAN: through Python threads, not in real time."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import loop_bench
import pytest
from can.interfaces.virtual import VirtualBus
from link_tools import LinkUnderTest, nothing_left_open, until, wanted
from loop_bench import Bench, assert_adds_up

from rthyb_rt.core import loop, wire
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import exchange, locks
from rthyb_rt.rig.links.opening import Opened, Side, open_link

BUS_OFF = 0x40
FD_DBC = Path(__file__).parent / "data" / "links" / "fd_extended.dbc"


@pytest.fixture(autouse=True)
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who else runs these tests has a bus of the same name."""
    (tmp_path / "locks").mkdir()
    monkeypatch.setattr(locks, "SHARED_FOLDER", tmp_path / "locks")


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    """A bus of this test alone."""
    return str(request.node.name)


@pytest.fixture
def peer(channel: str) -> Iterator[VirtualBus]:
    """Somebody else on the bus, who knows nothing of us."""
    with VirtualBus(channel) as bus:
        yield bus


def open_virtual(channel: str, side: Side = "controller", **more: Any) -> Opened:
    return open_link(wanted("python-can", channel, interface="virtual", **more), side)


def received(fd: int) -> bytes:
    """The next frame that came over to the core's end."""
    with socket.socket(fileno=os.dup(fd)) as end:
        end.settimeout(20.0)
        return end.recv(100)


# ---- a test over it ------------------------------------------------------------------------------


class PatientBench(Bench):
    """Every frame arrives before the next tick, however late Python is."""

    opened: dict[str, Opened]

    def arrived(self, at: loop.Link, from_: loop.Link) -> None:
        receiver = self.opened["controller" if at is self.link else "drive"]
        until(
            lambda: receiver.facts["exchange"]["to_core"] >= from_.counters()["pieces_out"],
        )


def test_test_over_a_python_bus_is_bit_for_bit_that_over_a_socket(
    channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = open_virtual(channel), open_virtual(channel, "drive")

    def medium(bench: Bench) -> loop_bench.Ends:
        assert isinstance(bench, PatientBench)
        bench.opened = {"controller": ours, "drive": theirs}
        bench.ends = [os.dup(ours.fd), os.dup(theirs.fd)]
        return ours.kind, ours.codec, bench.ends[0], bench.ends[1]

    monkeypatch.setitem(loop_bench.MEDIA, "python-can", medium)
    with ours, theirs, PatientBench("python-can") as bench, Bench() as bare:
        assert_adds_up(bench.running(200))
        bare.running(200)
        assert bench.rows().tobytes() == bare.rows().tobytes()
        counters = ours.facts["exchange"]
        assert counters["to_bus"] == bench.link.counters()["pieces_out"]
        assert counters["to_core_lost"] == counters["to_bus_lost"] == 0
        assert ours.failure is None


def test_it_says_that_it_is_not_real_time(channel: str) -> None:
    with open_virtual(channel, bitrate=1_000_000) as opened:
        assert opened.real_time is False
        assert opened.kind == "can"
        assert opened.name == f"python-can virtual {channel}, not real time"
        assert opened.facts["interface"] == "virtual"
        assert opened.facts["notes"] == ["frames pass through Python: not real time"]


# ---- frames --------------------------------------------------------------------------------------


def test_only_the_other_sides_frames_reach_the_core(channel: str, peer: VirtualBus) -> None:
    with open_virtual(channel) as opened:
        for identifier, extended, remote in (
            (0x101, False, False),  # a command: ours
            (0x7FF, False, False),
            (0x181, True, False),  # the same number with 29 bits
            (0x181, False, True),  # asks for a frame, is none
        ):
            peer.send(
                can.Message(
                    arbitration_id=identifier, is_extended_id=extended, is_remote_frame=remote
                )
            )
        peer.send(can.Message(arbitration_id=0x182, is_extended_id=False, data=b"12345678"))
        raw = received(opened.fd)
        assert raw == bytes.fromhex("82010000 08000000") + b"12345678"
        until(lambda: opened.facts["exchange"]["to_core"] == 1)


def test_drive_hears_commands_alone(channel: str, peer: VirtualBus) -> None:
    with open_virtual(channel, "drive") as opened:
        peer.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=bytes(8)))
        peer.send(can.Message(arbitration_id=0x101, is_extended_id=False, data=b"\1\2\3"))
        assert received(opened.fd) == bytes.fromhex("01010000 03000000 010203 0000000000")


def test_what_the_core_sends_is_on_the_bus(channel: str, peer: VirtualBus) -> None:
    with open_virtual(channel) as opened, socket.socket(fileno=os.dup(opened.fd)) as core_end:
        core_end.send(bytes.fromhex("01010000 08000000") + b"abcdefgh")
        message = peer.recv(20.0)
        assert message is not None
        assert (message.arbitration_id, message.is_extended_id) == (0x101, False)
        assert (bytes(message.data), message.is_fd) == (b"abcdefgh", False)


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\0\1\2"),
        can.Message(arbitration_id=0x1ABCDEF0, is_extended_id=True, data=b""),
        can.Message(arbitration_id=0x7, is_extended_id=False, is_fd=True, data=bytes(range(64))),
        can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, is_fd=True, data=b"1" * 12),
    ],
)
def test_message_becomes_the_kernels_frame_and_the_same_message_again(message: can.Message) -> None:
    from can.interfaces.socketcan.socketcan import build_can_frame

    message.is_rx = False
    raw = exchange.pack(message)
    peers = build_can_frame(message)
    assert raw[:6] == peers[:6]  # byte 7 holds a DLC where python-can writes one
    assert raw[8:] == peers[8:]
    assert len(raw) == len(peers)
    assert exchange.unpack(raw).equals(message, timestamp_delta=None)


def test_can_fd_and_29_bit_identifiers_of_a_dbc_pass(channel: str, peer: VirtualBus) -> None:
    more = {"dbc": FD_DBC.name, "fd": True, "names": {"x_cmd": "SetPos"}}
    link = wanted("python-can", channel, interface="virtual", **more)
    with open_link(link, "controller", folder=FD_DBC.parent) as opened:
        (frame,) = opened.codec.encode_feedback(wire.Reading(0.0125, -4500.0, 1, 2))
        assert (len(frame.data), frame.fd) == (24, True)
        assert frame.id & wire.ID_EXTENDED
        identifier = frame.id & 0x1FFF_FFFF
        peer.send(can.Message(arbitration_id=identifier, is_fd=True, data=frame.data))
        raw = received(opened.fd)
        assert len(raw) == 72
        tick = LinkUnderTest(opened)
        peer.send(can.Message(arbitration_id=identifier, is_fd=True, data=frame.data))
        until(lambda: opened.facts["exchange"]["to_core"] == 2)
        tick.loop.step()
        assert tick.loop.records["x_meas_m"][-1] == pytest.approx(0.0125, abs=1e-6)
        command = peer.recv(20.0)
        assert command is not None
        assert command.is_fd
        assert command.arbitration_id == opened.codec.command_id & 0x1FFF_FFFF
        tick.link.close()


# ---- errors of the bus ---------------------------------------------------------------------------


def error_frame(number: int) -> can.Message:
    return can.Message(
        arbitration_id=number, is_error_frame=True, is_extended_id=False, data=bytes(8)
    )


def test_bus_off_reaches_the_core(channel: str, peer: VirtualBus) -> None:
    with open_virtual(channel) as opened:
        tick = LinkUnderTest(opened)
        peer.send(error_frame(BUS_OFF))
        tick.comes_down("bus-off")


def test_lesser_error_is_counted_and_no_more(channel: str, peer: VirtualBus) -> None:
    with open_virtual(channel) as opened:
        tick = LinkUnderTest(opened)
        peer.send(error_frame(0x4))  # the controller has trouble
        until(lambda: tick.down() == "up" and tick.link.counters()["error_frames"] == 1)
        tick.link.close()


def test_driver_that_says_bus_off_by_its_state_only(
    channel: str, peer: VirtualBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(VirtualBus, "state", property(lambda _: can.BusState.ERROR))
    with open_virtual(channel) as opened:
        tick = LinkUnderTest(opened)
        peer.send(error_frame(0))
        tick.comes_down("bus-off")


def test_adapter_that_is_pulled_out_hangs_up_on_the_core(
    channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pulled = threading.Event()
    receive = VirtualBus._recv_internal

    def gone(bus: VirtualBus, timeout: float | None) -> Any:
        if pulled.is_set():
            raise OSError(19, "No such device")
        return receive(bus, timeout)

    monkeypatch.setattr(VirtualBus, "_recv_internal", gone)
    with open_virtual(channel) as opened:
        tick = LinkUnderTest(opened)
        assert tick.down() == "up"
        pulled.set()
        tick.comes_down("hung-up")
        assert until(lambda: opened.failure) == "[Errno 19] No such device"


def test_bus_without_room_loses_commands_and_is_given_up_after_20(
    channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = threading.Event()
    send = VirtualBus.send

    def refuse(bus: VirtualBus, message: can.Message, timeout: float | None = None) -> None:
        if full.is_set():
            raise can.CanOperationError("Transmit buffer full")
        send(bus, message, timeout)

    monkeypatch.setattr(VirtualBus, "send", refuse)
    with open_virtual(channel) as opened, socket.socket(fileno=os.dup(opened.fd)) as core_end:
        counters, frame = opened.facts["exchange"], bytes.fromhex("01010000 00000000") + bytes(8)

        def send_commands(count: int, counter: str, total: int) -> None:
            for _ in range(count):
                core_end.send(frame)
            until(lambda: counters[counter] == total)

        full.set()
        send_commands(19, "to_bus_lost", 19)
        full.clear()
        send_commands(1, "to_bus", 1)
        full.set()
        send_commands(19, "to_bus_lost", 38)
        assert opened.failure is None
        core_end.send(frame)
        assert until(lambda: opened.failure) == "Transmit buffer full"
        core_end.settimeout(20.0)
        assert core_end.recv(100) == b"", "the core sees the end"


def test_python_that_stalls_sends_no_burst_of_old_commands(
    channel: str, peer: VirtualBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    send, stalled, goes_on = VirtualBus.send, threading.Event(), threading.Event()

    def slow(bus: VirtualBus, message: can.Message, timeout: float | None = None) -> None:
        stalled.set()
        goes_on.wait(20.0)
        send(bus, message, timeout)

    monkeypatch.setattr(VirtualBus, "send", slow)
    with open_virtual(channel) as opened, socket.socket(fileno=os.dup(opened.fd)) as core_end:
        counters, sent = opened.facts["exchange"], 0
        for number in range(60):  # of 60 ms
            frame = bytes.fromhex("01010000 01000000") + bytes([number]) + bytes(7)
            with contextlib.suppress(BlockingIOError):
                core_end.send(frame, socket.MSG_DONTWAIT)
                sent += 1
            if not number:
                assert stalled.wait(20.0)
        goes_on.set()
        until(lambda: counters["to_bus"] == sent)
        heard = [peer.recv(0.0) for _ in range(sent)]
        assert [m.data[0] for m in heard if m is not None] == list(range(sent))
        assert peer.recv(0.0) is None
        assert 2 <= sent <= 10
        core_end.send(bytes.fromhex("01010000 01000000") + bytes([99]) + bytes(7))
        fresh = peer.recv(20.0)
        assert fresh is not None
        assert fresh.data[0] == 99


def test_readings_of_a_drive_may_wait_longer(channel: str) -> None:
    """The newest pair counts: an old one is no harm, and two frames are but one sample."""
    with open_virtual(channel, "drive") as opened, socket.socket(fileno=os.dup(opened.fd)) as end:
        assert end.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) >= exchange.QUEUE_BYTES["drive"]


def test_core_that_does_not_read_loses_frames_and_stops_nothing(
    channel: str, peer: VirtualBus
) -> None:
    with open_virtual(channel) as opened:
        counters = opened.facts["exchange"]
        for _ in range(2000):
            peer.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=bytes(8)))
        until(lambda: counters["to_core"] + counters["to_core_lost"] == 2000)
        assert 0 < counters["to_core_lost"] < 2000
        assert opened.failure is None
        tick = LinkUnderTest(opened)
        assert tick.down() == "up"
        tick.link.close()


# ---- opening and closing -------------------------------------------------------------------------


def test_closing_ends_the_threads_and_leaves_nothing(channel: str) -> None:
    with nothing_left_open():
        opened = open_virtual(channel)
        link = loop.Link(opened.kind, opened.fd)
        opened.close()
        opened.close()
        assert opened.fd == -1
        link.close()


def test_core_that_ends_first_is_no_failure(channel: str) -> None:
    with nothing_left_open():
        opened = open_virtual(channel)
        threads = [t for t in threading.enumerate() if t.name == "rthyb-exchange"]
        assert len(threads) == 2
        with socket.socket(fileno=os.dup(opened.fd)) as core_end:
            core_end.shutdown(socket.SHUT_RDWR)
        until(lambda: not any(thread.is_alive() for thread in threads))
        assert opened.failure is None
        opened.close()


def refusal(interface: str, channel: str = "test", **more: Any) -> str:
    link = wanted("python-can", channel, interface=interface, **more)
    with nothing_left_open(), pytest.raises(InputError) as refused:
        open_link(link, "controller")
    (problem,) = refused.value.problems
    assert problem.where == f"{interface} {channel}"
    return problem.message


@pytest.mark.parametrize("side", ["controller", "drive"])
def test_second_user_of_the_same_side_is_told_who_has_it(channel: str, side: Side) -> None:
    other: Side = "drive" if side == "controller" else "controller"
    with open_virtual(channel, side), open_virtual(channel, other):
        with nothing_left_open(), pytest.raises(InputError) as refused:
            open_virtual(channel, side)
        (problem,) = refused.value.problems
        assert problem.where == f"virtual {channel}"
        assert f"process {os.getpid()} has it open as {side}" in problem.message
        with open_virtual(f"{channel}-2", side):
            pass
    open_virtual(channel, side).close()


def test_device_has_one_user_by_whatever_name(tmp_path: Path) -> None:
    """/dev/ttyUSB0 is also a link in /dev/serial/by-id."""
    device, link = tmp_path / "ttyUSB0", tmp_path / "by-id"
    device.touch()
    link.symlink_to(device)
    with (
        open_virtual(str(device)),
        pytest.raises(InputError, match="has it open as controller"),
    ):
        open_virtual(str(link))


def test_interface_that_python_can_does_not_have() -> None:
    message = refusal("pcna")
    assert "python-can has " in message
    assert "pcan" in message
    assert "socketcan," not in message


def test_socketcan_is_not_opened_the_slow_way() -> None:
    assert 'kind = "can"' in refusal("socketcan", "can0")


def test_driver_that_is_not_installed_or_refuses(tmp_path: Path) -> None:
    assert "python-can cannot open it" in refusal("slcan", str(tmp_path / "ttyUSB0"))


def test_driver_that_fails_half_way_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        half_open = socket.socket()
        assert half_open.fileno() >= 0
        raise RuntimeError("the vendor's library\nsays no")

    monkeypatch.setattr(VirtualBus, "__init__", fail)
    with pytest.warns(ResourceWarning):  # what it left open
        message = refusal("virtual")
    assert message == "python-can cannot open it: the vendor's library says no"


def test_bit_rate_too_low_for_the_samples_of_a_dbc(channel: str) -> None:
    more = {"dbc": str(FD_DBC), "fd": True, "names": {"x_cmd": "SetPos"}}
    assert "load the bus" in refusal("virtual", channel, bitrate=125_000, **more)


def test_errors_of_python_can_are_not_printed_beside_ours(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    refusal("slcan", str(tmp_path / "ttyUSB0"))
    out, err = capfd.readouterr()
    assert out + err == ""
