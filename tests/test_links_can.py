"""SocketCAN before anything is opened: what the kernel says, what is refused, what to do then."""

from __future__ import annotations

import dataclasses
import errno
import socket
import struct
from pathlib import Path
from typing import Any

import pytest
from link_tools import nothing_left_open, wanted

from rthyb_rt.core import wire
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import can_bus, netlink
from rthyb_rt.rig.links.netlink import NetworkInterface
from rthyb_rt.rig.links.opening import open_link

RECORDED = Path(__file__).parent / "data" / "links" / "rtnetlink" / "links.bin"
"""Answer of a 6.1 kernel: lo, vcan0, vcan1, a pair of vxcan, and can0: slcan at 500 kbit/s."""

CAN0 = NetworkInterface(
    name="can0",
    is_can=True,
    driver="can",
    up=True,
    operational="UP",
    mtu=16,
    bitrate=1_000_000,
    restart_ms=0,
    state="ERROR_ACTIVE",
)
VCAN0 = NetworkInterface("vcan0", True, "vcan", True, "UNKNOWN", 72)
ETH0 = NetworkInterface("eth0", False, "", True, "UP", 1500)


# ---- what the kernel says ------------------------------------------------------------------------


def decoded(messages: bytes) -> dict[str, NetworkInterface]:
    from pyroute2.netlink.rtnl.ifinfmsg import ifinfmsg

    links = []
    at = 0
    while at < len(messages):
        (size,) = struct.unpack_from("=I", messages, at)
        link = ifinfmsg(messages[at : at + size])
        link.decode()
        links.append(link)
        at += (size + 3) & ~3
    return netlink.by_name(links)


def attribute(number: int, value: bytes) -> bytes:
    """As <linux/netlink.h> has it: length, type, value, padded to 4 bytes."""
    return struct.pack("=HH", 4 + len(value), number) + value + bytes(-len(value) % 4)


def hardware(flags: int = 0x10041, **more: bytes) -> bytes:
    """RTM_NEWLINK of a CAN FD adapter, put together by <linux/if_link.h> and <linux/can/netlink.h>.

    Numbers: IFLA_IFNAME 3, IFLA_MTU 4, IFLA_OPERSTATE 16 (6: up), IFLA_LINKINFO 18 with kind 1
    and data 2; in it bit timing 1 (bit rate first), state 4, modes 5, restart-ms 6, data bit
    timing 9.
    """
    controller = {
        "timing": attribute(1, struct.pack("=8I", 500_000, 875, 50, 10, 24, 5, 1, 2)),
        "state": attribute(4, struct.pack("=I", 0)),
        "modes": attribute(5, struct.pack("=II", 0, 0x20)),
        "restart": attribute(6, struct.pack("=I", 0)),
        "data": attribute(9, struct.pack("=8I", 2_000_000, 750, 25, 7, 7, 5, 1, 1)),
    } | more
    info = attribute(1, b"can\0") + attribute(2, b"".join(controller.values()))
    attributes = (
        attribute(3, b"can7\0")
        + attribute(4, struct.pack("=I", 72))
        + attribute(16, b"\6")
        + attribute(18, info)
    )
    body = struct.pack("=BxHiII", 0, 280, 5, flags, 0) + attributes
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 0) + body


def test_a_kernels_answer_as_recorded() -> None:
    found = decoded(RECORDED.read_bytes())
    assert list(found) == ["lo", "vcan0", "vcan1", "vxcan1", "vxcan0", "can0"]
    assert not found["lo"].is_can
    assert found["vcan0"] == VCAN0
    assert found["vxcan1"] == NetworkInterface("vxcan1", True, "vxcan", True, "UP", 72)
    assert found["can0"] == NetworkInterface(
        "can0", True, "can", False, "DOWN", 16, 500_000, None, 0, "STOPPED", False
    )


def test_an_adapters_answer_by_the_kernels_headers() -> None:
    assert decoded(hardware()) == {
        "can7": NetworkInterface(
            "can7", True, "can", True, "UP", 72, 500_000, 2_000_000, 0, "ERROR_ACTIVE", False
        )
    }


@pytest.mark.parametrize(
    ("part", "changed"),
    [
        ({"restart": attribute(6, struct.pack("=I", 100))}, {"restart_ms": 100}),
        ({"restart": b""}, {"restart_ms": None}),
        ({"state": attribute(4, struct.pack("=I", 3))}, {"state": "BUS_OFF"}),
        ({"modes": attribute(5, struct.pack("=II", 0, 2))}, {"listen_only": True}),
        ({"modes": b""}, {}),
        ({"timing": b""}, {"bitrate": None}),
        ({"timing": attribute(1, bytes(32))}, {"bitrate": None}),
        ({"timing": attribute(1, b"\xff" * 4 + bytes(28))}, {"bitrate": None}),  # slcan by slcand
        ({"data": b""}, {"data_bitrate": None}),
        ({"new": attribute(99, b"from a kernel to come")}, {}),
        ({"flags": 0}, {"up": False}),
    ],
)
def test_what_an_adapter_says_and_what_it_leaves_out(
    part: dict[str, Any], changed: dict[str, Any]
) -> None:
    usual = decoded(hardware())["can7"]
    assert decoded(hardware(**part))["can7"] == dataclasses.replace(usual, **changed)


def test_this_kernel_answers_too() -> None:
    with nothing_left_open():
        found = netlink.interfaces()
    assert found["lo"].is_can is False
    assert set(found) == {name for _, name in socket.if_nameindex()}


def test_kernel_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr("pyroute2.IPRoute", refuse)
    with pytest.raises(InputError, match="does not list its network interfaces: Address family"):
        netlink.interfaces()


# ---- what is refused -----------------------------------------------------------------------------


def refusal(
    interface: NetworkInterface, bitrate: int | None = None, fd: bool = False, **more: int
) -> str:
    with pytest.raises(InputError) as refused:
        can_bus.check(interface, bitrate, fd, **more)
    (problem,) = refused.value.problems
    assert problem.where == interface.name
    return problem.message


@pytest.mark.parametrize("bitrate", [None, 1_000_000])
def test_interface_in_order_is_taken(bitrate: int | None) -> None:
    can_bus.check(CAN0, bitrate, False)


def test_virtual_bus_has_no_bit_rate_to_be_wrong() -> None:
    can_bus.check(VCAN0, 1_000_000, True)


def test_interface_that_is_down() -> None:
    down = dataclasses.replace(CAN0, up=False, bitrate=None)
    assert refusal(down, 500_000) == (
        "the interface is down; set it up with `sudo ip link set can0 up type can bitrate 500000`"
    )
    assert "up type can bitrate 1000000`" in refusal(down)
    down = dataclasses.replace(down, restart_ms=None)
    assert "up type can bitrate 1000000 restart-ms 0`" in refusal(down)
    down = dataclasses.replace(VCAN0, up=False)
    assert refusal(down) == "the interface is down; set it up with `sudo ip link set vcan0 up`"


def test_bit_rate_other_than_the_rig_files() -> None:
    assert refusal(CAN0, 500_000) == (
        "its bit rate is 1000000 bit/s, but the rig file says 500000; set it up with `sudo ip link "
        "set can0 down; sudo ip link set can0 up type can bitrate 500000`"
    )


def test_data_bit_rate_other_than_the_rig_files() -> None:
    fast = dataclasses.replace(CAN0, mtu=72, data_bitrate=2_000_000)
    message = refusal(fast, 1_000_000, True, data_bitrate=5_000_000)
    assert (
        "the bit rate of its data phase is 2000000 bit/s, but the rig file says 5000000" in message
    )
    assert "bitrate 1000000 dbitrate 5000000 fd on`" in message
    can_bus.check(fast, 1_000_000, True, 2_000_000)


def test_kernel_that_would_go_back_to_the_bus_by_itself() -> None:
    message = refusal(dataclasses.replace(CAN0, restart_ms=100))
    assert message.startswith("restart-ms is 100, but must be 0: ")
    assert "up type can bitrate 1000000 restart-ms 0`" in message


def test_controller_that_is_off_the_bus_already() -> None:
    assert "bus-off" in refusal(dataclasses.replace(CAN0, state="BUS_OFF"))


def test_adapter_that_only_listens() -> None:
    message = refusal(dataclasses.replace(CAN0, listen_only=True))
    assert "listen-only off`" in message


def test_can_fd_frames_over_an_interface_without() -> None:
    message = refusal(CAN0, None, True)
    assert "CAN FD is off (its frames have 16 bytes, 72 are needed)" in message
    assert "bitrate 1000000 dbitrate 1000000 fd on`" in message
    small = dataclasses.replace(VCAN0, mtu=16)
    assert "sudo ip link set vcan0 mtu 72 up`" in refusal(small, None, True)


def test_all_that_is_wrong_is_said_at_once_with_one_remedy() -> None:
    message = refusal(
        dataclasses.replace(CAN0, restart_ms=100, state="BUS_OFF", listen_only=True), 500_000, True
    )
    for part in (
        "1000000 bit/s",
        "restart-ms is 100",
        "bus-off",
        "listen-only mode is on",
        "CAN FD",
    ):
        assert part in message
    assert message.count("set it up with") == 1


def test_bit_rate_too_low_for_the_samples() -> None:
    slow = dataclasses.replace(CAN0, bitrate=500_000)
    with pytest.raises(InputError, match=r"can0: .*load the bus"):
        can_bus.check_load(slow, wire.can())  # 3 frames of 135 bits, 1024 times: 83 %
    can_bus.check_load(CAN0, wire.can())
    can_bus.check_load(VCAN0, wire.can())


def no_interface(channel: str, *there: NetworkInterface) -> str:
    with pytest.raises(InputError) as refused:
        can_bus.find(channel, {each.name: each for each in there})
    return str(refused.value)


def test_no_such_interface_says_which_there_are() -> None:
    assert no_interface("can1", CAN0, VCAN0, ETH0) == (
        "can1: no such interface; CAN interfaces here: can0, vcan0"
    )
    assert no_interface("can0", ETH0) == (
        "can0: no such interface; there is no CAN interface here; is the adapter plugged in and "
        "its driver loaded? see `ip link`"
    )
    assert can_bus.find("can0", {"can0": CAN0}) is CAN0


def test_interface_that_is_not_can() -> None:
    assert no_interface("eth0", ETH0, VCAN0) == (
        "eth0: is a network interface, but not CAN; CAN interfaces here: vcan0"
    )


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EAFNOSUPPORT, "sudo modprobe -a can can-raw"),
        (errno.EPROTONOSUPPORT, "sudo modprobe can-raw"),
        (errno.EPERM, "a sandbox forbids it"),
        (errno.EACCES, "a sandbox forbids it"),
        (errno.EMFILE, "no CAN socket can be opened: "),
    ],
)
def test_kernel_without_can_sockets_or_a_process_without_the_right(
    monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, "in the kernel's words")

    monkeypatch.setattr(socket, "socket", refuse)
    with pytest.raises(InputError) as refused:
        open_link(wanted("can", "can0"), "controller")
    assert str(refused.value).startswith("can0: ")
    assert words in str(refused.value)


def test_missing_dbc_is_named_in_the_rig_files_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=str(tmp_path / "drive.dbc")):
        open_link(wanted("can", "can0", dbc="drive.dbc"), "controller", folder=tmp_path)


# ---- filters -------------------------------------------------------------------------------------


def passes(filters: bytes, identifier: int) -> bool:
    """As the kernel compares: one pair of number and mask is enough."""
    pairs = struct.iter_unpack("=II", filters)
    return any(identifier & mask == number & mask for number, mask in pairs)


@pytest.mark.parametrize(("side", "heard"), [("controller", {0x181, 0x182}), ("drive", {0x101})])
def test_filters_let_exactly_the_other_sides_frames_through(side: Any, heard: set[int]) -> None:
    filters = can_bus.pack_filters(can_bus.filters(wire.can(), side))
    assert {number for number in range(0x800) if passes(filters, number)} == heard
    for number in heard:
        assert not passes(filters, number | 0x8000_0000)  # 29 bits
        assert not passes(filters, number | 0x4000_0000)  # remote
