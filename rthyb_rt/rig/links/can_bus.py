"""SocketCAN: python-can opens and filters, this module checks, the core exchanges the frames."""

from __future__ import annotations

import contextlib
import errno
import socket
import traceback
from collections.abc import Iterator
from typing import Any, Final

import can
from can.interfaces.socketcan.utils import pack_filters

from rthyb_rt.config import busload
from rthyb_rt.config.rigfile import LinkTable
from rthyb_rt.core.sizes import STANDARD_RATE_HZ
from rthyb_rt.core.wire import ID_EXTENDED, Codec
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import locks, netlink
from rthyb_rt.rig.links.netlink import NetworkInterface
from rthyb_rt.rig.links.opened import Opened, Owned, Side, bit_rate

CAN_RAW_ERR_FILTER: Final = 2
"""Socket option of <linux/can/raw.h> that the module `socket` does not define."""
ERROR_CLASSES: Final = 0x1FFF_FFFF
CAN_RTR_FLAG: Final = 0x4000_0000
CANFD_MTU: Final = 72
USUAL_BITRATE: Final = 1_000_000

RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""Requested size. A full buffer loses the newest frames, so it must outlast a stall of the PC."""
SEND_BUFFER_BYTES: Final = 0
"""Rounded up by the kernel to its minimum, about 6 frames. Frames that queue up while the bus is
off would be sent as a burst of old commands when it returns."""
STALE_FRAMES_MOST: Final = 100_000


def open_can(wanted: LinkTable, side: Side, codec: Codec, *, shared: bool = False) -> Opened:
    """Open a SocketCAN interface for one side of a link.

    Only frames of the other side and error frames are received, and none that were sent here. The
    interface itself is left unchanged: setting it up is the operator's task.

    Args:
        wanted: ``channel`` is the interface; the bit rates, if any, are compared with the kernel's.
        side: which side of the link; the other side's frames are received.
        codec: defines the identifiers.
        shared: another axis of the same rig has opened and locked the interface for this side.

    Raises:
        InputError: lists every fault of the interface, with the command that corrects it.
    """
    need_sockets(wanted.channel)
    fd = wanted.fd or codec.is_fd
    interface = find(wanted.channel, netlink.interfaces())
    check(interface, wanted.bitrate, fd, wanted.data_bitrate)
    check_load(interface, codec, wanted.sample_rate_hz)
    with Owned() as owned:
        if not shared:
            locks.hold(owned, interface.name, interface.name, side)
        bus = _bus(interface.name, filters(codec, side), fd)
        owned.callback(bus.shutdown)
        try:
            _configure(bus.socket, interface.name, filters(codec, side), fd)
        except OSError as error:
            raise InputError(
                f"cannot be set up: {error.strerror or error}; is it still there and up? "
                f"see `ip link show {interface.name}`",
                interface.name,
            ) from error
        return Opened(
            kind="can",
            fd=bus.socket.fileno(),
            codec=codec,
            real_time=True,
            name=_name(interface),
            facts=_facts(interface, codec, bus.socket, wanted.sample_rate_hz),
            owned=owned.pop_all(),
        )


def need_sockets(channel: str) -> None:
    """Raise InputError if the kernel has no SocketCAN or denies its use."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        raise InputError(_no_sockets(error), channel) from None


def _no_sockets(error: OSError) -> str:
    if error.errno == errno.EAFNOSUPPORT:
        return (
            "this kernel has no SocketCAN (AF_CAN); load its modules with "
            "`sudo modprobe -a can can-raw`; in a systemd service, RestrictAddressFamilies= may "
            "also forbid CAN; for a container, its host must have the modules"
        )
    if error.errno == errno.EPROTONOSUPPORT:
        return "this kernel has CAN but no raw CAN sockets; load them with `sudo modprobe can-raw`"
    if error.errno in (errno.EPERM, errno.EACCES):
        return (
            "this process is not permitted to open CAN sockets; SocketCAN itself needs no "
            "privilege, so a sandbox forbids it (seccomp, container, systemd unit): allow "
            "AF_CAN there"
        )
    return f"no CAN socket can be opened: {error.strerror}"


def find(channel: str, interfaces: dict[str, NetworkInterface]) -> NetworkInterface:
    """Return an interface by name; InputError if it does not exist or is not CAN."""
    found = interfaces.get(channel)
    if found is not None and found.is_can:
        return found
    names = ", ".join(sorted(name for name, each in interfaces.items() if each.is_can))
    there = f"CAN interfaces here: {names}" if names else "there is no CAN interface here"
    if found is not None:
        raise InputError(f"is a network interface, but not CAN; {there}", channel)
    hint = "" if names else "; is the adapter plugged in and its driver loaded? see `ip link`"
    raise InputError(f"no such interface; {there}{hint}", channel)


def check(
    interface: NetworkInterface, bitrate: int | None, fd: bool, data_bitrate: int | None = None
) -> None:
    """Raise InputError with every fault of an interface and its remedy.

    Args:
        interface: as reported by the kernel.
        bitrate: as in the rig file, bit/s; ``None``: any.
        fd: whether CAN FD frames are used.
        data_bitrate: of CAN FD's data phase, likewise.
    """
    wrong = list(_wrong(interface, bitrate, fd, data_bitrate))
    if wrong:
        remedy = _remedy(interface, bitrate, fd, data_bitrate)
        raise InputError(f"{'; '.join(wrong)}; set it up with `{remedy}`", interface.name)


def _wrong(
    interface: NetworkInterface, bitrate: int | None, fd: bool, data_bitrate: int | None
) -> Iterator[str]:
    if not interface.up:
        yield "the interface is down"
    if bitrate and interface.bitrate and interface.bitrate != bitrate:
        yield f"its bit rate is {interface.bitrate} bit/s, but the rig file says {bitrate}"
    if data_bitrate and interface.data_bitrate and interface.data_bitrate != data_bitrate:
        yield (
            f"the bit rate of its data phase is {interface.data_bitrate} bit/s, but the rig file "
            f"says {data_bitrate}"
        )
    if interface.restart_ms:
        yield (
            f"restart-ms is {interface.restart_ms}, but must be 0: after a bus-off the interface "
            "must stay off the bus until the fault has been found"
        )
    if interface.state == "BUS_OFF":
        yield "the controller is off the bus (bus-off): check cable, termination and bit rates"
    if interface.listen_only:
        yield "listen-only mode is on, so no command would be sent"
    if fd and interface.mtu < CANFD_MTU:
        yield f"CAN FD is off (its frames have {interface.mtu} bytes, {CANFD_MTU} are needed)"


def _remedy(
    interface: NetworkInterface, bitrate: int | None, fd: bool, data_bitrate: int | None
) -> str:
    name = interface.name
    lines = [f"sudo ip link set {name} down"] if interface.up else []
    if interface.driver != "can":
        lines.append(f"sudo ip link set {name}{f' mtu {CANFD_MTU}' if fd else ''} up")
        return "; ".join(lines)
    rate = bitrate or interface.bitrate or USUAL_BITRATE
    options = f"type can bitrate {rate}"
    if interface.restart_ms != 0:  # slcan always has 0 and rejects the option
        options += " restart-ms 0"
    if fd:
        options += f" dbitrate {data_bitrate or interface.data_bitrate or rate} fd on"
    if interface.listen_only:
        options += " listen-only off"
    return "; ".join([*lines, f"sudo ip link set {name} up {options}"])


def check_load(interface: NetworkInterface, codec: Codec, rate_hz: int = STANDARD_RATE_HZ) -> None:
    """Raise InputError if the frames of a sample leave too little of the bus free."""
    if interface.bitrate is None:
        return
    fault = busload.bus_fault(
        busload.frames_of(codec), interface.bitrate, interface.data_bitrate, rate_hz=rate_hz
    )
    if fault:
        raise InputError(fault, interface.name)


def filters(codec: Codec, side: Side) -> list[can.typechecking.CanFilter]:
    """Return python-can's filters for the frames that the other side sends."""
    identifiers = codec.feedback_ids if side == "controller" else (codec.command_id,)
    return [_filter(identifier) for identifier in identifiers]


def _filter(identifier: int) -> can.typechecking.CanFilter:
    extended = bool(identifier & ID_EXTENDED)
    bits = 0x1FFF_FFFF if extended else 0x7FF
    return {  # with the flag in the mask, remote frames of this identifier are rejected
        "can_id": identifier & bits,
        "can_mask": bits | CAN_RTR_FLAG,
        "extended": extended,
    }


def _bus(name: str, wanted_filters: list[can.typechecking.CanFilter], fd: bool) -> Any:
    try:
        return can.Bus(
            interface="socketcan",
            channel=name,
            can_filters=wanted_filters,
            fd=fd,
            receive_own_messages=False,
            ignore_rx_error_frames=False,
            ignore_config=True,
        )
    except OSError as error:  # it existed a moment ago
        traceback.clear_frames(error.__traceback__)  # a frame still holds python-can's socket
        raise InputError(
            f"cannot be opened: {error.strerror}; is it still there? see `ip link show {name}`",
            name,
        ) from None


def _configure(
    sock: socket.socket, name: str, wanted_filters: list[can.typechecking.CanFilter], fd: bool
) -> None:
    """Set the options that python-can does not set, and verify all: it only logs a refusal."""
    raw, packed = socket.SOL_CAN_RAW, pack_filters(wanted_filters)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    sock.setsockopt(raw, CAN_RAW_ERR_FILTER, ERROR_CLASSES)
    held = {
        "identifier filters": sock.getsockopt(raw, socket.CAN_RAW_FILTER, 64) == packed,
        "error frames": sock.getsockopt(raw, CAN_RAW_ERR_FILTER) == ERROR_CLASSES,
        "suppression of own frames": sock.getsockopt(raw, socket.CAN_RAW_RECV_OWN_MSGS) == 0,
        "frames to other programs": sock.getsockopt(raw, socket.CAN_RAW_LOOPBACK) == 1,
        "CAN FD": sock.getsockopt(raw, socket.CAN_RAW_FD_FRAMES) == fd,
    }
    missing = [what for what, holds in held.items() if not holds]
    if missing:
        raise InputError(
            f"the kernel does not support: {', '.join(missing)}; use a kernel or container whose "
            "SocketCAN supports them",
            name,
        )
    _discard(sock)


def _discard(sock: socket.socket) -> None:
    """Discard what arrived before the filters were set."""
    with contextlib.suppress(BlockingIOError):
        for _ in range(STALE_FRAMES_MOST):
            sock.recv(CANFD_MTU, socket.MSG_DONTWAIT)


def _name(interface: NetworkInterface) -> str:
    if interface.driver in ("vcan", "vxcan"):
        return f"{interface.name}, virtual CAN"
    if interface.bitrate is None:
        return f"{interface.name}, CAN"
    return f"{interface.name}, CAN {bit_rate(interface.bitrate)}"


def _facts(
    interface: NetworkInterface, codec: Codec, sock: socket.socket, rate_hz: int
) -> dict[str, Any]:
    rate, frames = interface.bitrate, busload.frames_of(codec)
    load = busload.bus_load(frames, rate, interface.data_bitrate, rate_hz=rate_hz) if rate else None
    facts = {
        "interface": interface.name,
        "driver": interface.driver,
        "operational": interface.operational,
        "mtu_bytes": interface.mtu,
        "bitrate": rate,
        "data_bitrate": interface.data_bitrate,
        "restart_ms": interface.restart_ms,
        "controller_state": interface.state,
        "bus_load": load,
        "receive_buffer_bytes": sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF),
        "send_buffer_bytes": sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF),
    }
    known = {name: value for name, value in facts.items() if value is not None}
    if rate is None and interface.driver == "can":
        known["notes"] = ["the kernel does not know the bit rate, so it was not checked"]
    return known
