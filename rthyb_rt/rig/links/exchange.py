"""All other CAN interfaces of python-can, connected to the core by threads in Python.

The core has a SEQPACKET socket that carries CAN frames, as from `sockets.socket_pair`. Its buffers
are the bounded queues of both directions; frames that do not fit are dropped and counted. It is not
real time.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import traceback
from typing import Any, Final

import can

from rthyb_rt.config import busload
from rthyb_rt.config.rigfile import LinkTable
from rthyb_rt.core.wire import ID_EXTENDED, Codec
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import locks
from rthyb_rt.rig.links.opened import Opened, Owned, Side

CAN_MTU: Final = 16
CANFD_MTU: Final = 72
CAN_RTR_FLAG: Final = 0x4000_0000
CAN_ERR_FLAG: Final = 0x2000_0000
CAN_ERR_BUSOFF: Final = 0x40
CANFD_BRS: Final = 1
CANFD_FDF: Final = 4

QUEUE_BYTES: Final[dict[Side, int]] = {"controller": 0, "drive": 1 << 15}
"""Buffer towards the bus. Commands: the kernel's minimum, about 6 frames, since frames that queue
up while Python stalls are sent as a burst of old ones. Readings: about 40 pairs, the newest counts.
"""
WAIT_S: Final = 0.05
SEND_TIMEOUT_S: Final = 0.01
FAILED_SENDS_MOST: Final = 20
"""Failed sends in a row after which the bus counts as lost."""
JOIN_S: Final = 2.0

_HEADER: Final = struct.Struct("=IBB2x")


def open_bus(wanted: LinkTable, side: Side, codec: Codec, *, shared: bool = False) -> Opened:
    """Open an interface of python-can for one side of a link.

    Vendor parameters that are not keys of the rig file are configured in python-can
    (``~/.canrc``).

    Raises:
        InputError: no such interface, missing driver, refusal by the driver, or interface in use.
    """
    interface, where = wanted.interface or "", f"{wanted.interface} {wanted.channel}"
    if interface == "socketcan":
        raise InputError('use kind = "can" for SocketCAN, which runs in real time', where)
    fd = wanted.fd or codec.is_fd
    _check_load(wanted, where, codec)
    with Owned() as owned:
        # Another axis of the same rig may have opened, and locked, the interface for this side.
        if not shared:
            locks.hold(owned, where, f"{interface} {_place(wanted.channel)}", side)
        bus = _bus(wanted, interface, where, fd)
        owned.callback(bus.shutdown)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        owned.enter_context(ours)
        owned.enter_context(theirs)
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUE_BYTES[side])
        exchange = Exchange(bus, ours, _accepted(codec, side))
        owned.callback(exchange.stop)
        exchange.start()
        return Opened(
            kind="can",
            fd=theirs.fileno(),
            codec=codec,
            real_time=False,
            name=f"python-can {where}, not real time",
            facts={
                "interface": interface,
                "channel": wanted.channel,
                "exchange": exchange.counters,
                "notes": ["frames pass through Python: not real time"],
            },
            owned=owned.pop_all(),
            failed=lambda: exchange.failure,
        )


def _place(channel: str) -> str:
    """Return the canonical name of a channel: the device of a serial adapter has several names."""
    return os.path.realpath(channel) if channel.startswith("/") else channel


def _check_load(wanted: LinkTable, where: str, codec: Codec) -> None:
    if wanted.bitrate is None:
        return
    frames = busload.frames_of(codec)
    fault = busload.bus_fault(
        frames, wanted.bitrate, wanted.data_bitrate, rate_hz=wanted.sample_rate_hz
    )
    if fault:
        raise InputError(fault, where)


def _accepted(codec: Codec, side: Side) -> frozenset[int]:
    return frozenset(codec.feedback_ids if side == "controller" else (codec.command_id,))


def _bus(wanted: LinkTable, interface: str, where: str, fd: bool) -> can.BusABC:
    given: dict[str, Any] = {"receive_own_messages": False}
    if wanted.bitrate is not None:
        given["bitrate"] = wanted.bitrate
    if wanted.data_bitrate is not None:
        given["data_bitrate"] = wanted.data_bitrate
    if fd:
        given["fd"] = True
    try:
        return can.Bus(interface=interface, channel=wanted.channel, **given)
    except can.CanInterfaceNotImplementedError as error:
        known = ", ".join(sorted(can.VALID_INTERFACES - {"socketcan"}))
        raise InputError(f"{error}; python-can has {known}", where) from None
    except Exception as error:  # a vendor's driver may raise anything
        traceback.clear_frames(error.__traceback__)  # release what is half open
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"python-can cannot open it: {reason}", where) from None


class Exchange:
    """Two threads between a bus and a socket, until `stop`, a bus error, or a closed socket.

    Args:
        bus: of python-can, without filters, since those would also reject error frames.
        ours: one end of a SEQPACKET socket pair; the core has the other.
        accepted: identifiers that are forwarded to the core.

    Attributes:
        counters: frames to the core and to the bus, and frames lost in each direction.
        failure: why the threads gave up, or None.
    """

    def __init__(self, bus: can.BusABC, ours: socket.socket, accepted: frozenset[int]) -> None:
        self.counters = dict.fromkeys(("to_core", "to_core_lost", "to_bus", "to_bus_lost"), 0)
        self.failure: str | None = None
        self._bus, self._ours, self._accepted = bus, ours, accepted
        self._done = threading.Event()
        self._threads = [
            threading.Thread(target=self._guarded, args=(way,), name="rthyb-exchange", daemon=True)
            for way in (self._from_bus, self._to_bus)
        ]

    def start(self) -> None:
        """Start both threads."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End both threads; the core sees that the other side has closed the connection."""
        self._hang_up()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(JOIN_S)

    def _hang_up(self) -> None:
        self._done.set()
        with contextlib.suppress(OSError):  # the core has closed its end already
            self._ours.shutdown(socket.SHUT_RDWR)

    def _guarded(self, way: Any) -> None:
        try:
            way()
        except (BrokenPipeError, ConnectionResetError):
            pass  # the core has closed its end
        except Exception as error:  # a vendor's driver may raise anything
            if not self._done.is_set():
                self.failure = " ".join(str(error).split()) or type(error).__name__
        finally:
            self._hang_up()

    def _from_bus(self) -> None:
        while not self._done.is_set():
            message = self._bus.recv(WAIT_S)
            raw = None if message is None else self._frame(message)
            if raw is None:
                continue
            try:
                self._ours.send(raw, socket.MSG_DONTWAIT)
                self.counters["to_core"] += 1
            except BlockingIOError:
                self.counters["to_core_lost"] += 1

    def _frame(self, message: can.Message) -> bytes | None:
        """Pack a frame for the core, or return None if it is to be dropped."""
        if not message.is_error_frame:
            return pack(message) if _identifier(message) in self._accepted else None
        raw = pack(message)
        if self._bus.state is can.BusState.ERROR:  # some drivers' error frames carry no details
            (number,) = struct.unpack_from("=I", raw)
            raw = struct.pack("=I", number | CAN_ERR_BUSOFF) + raw[4:]
        return raw

    def _to_bus(self) -> None:
        failed = 0
        while not self._done.is_set():
            raw = self._ours.recv(CANFD_MTU)
            if not raw:
                return
            try:
                self._bus.send(unpack(raw), SEND_TIMEOUT_S)
                self.counters["to_bus"] += 1
                failed = 0
            except can.CanOperationError:  # includes a full transmit queue
                self.counters["to_bus_lost"] += 1
                failed += 1
                if failed >= FAILED_SENDS_MOST:
                    raise


def pack(message: can.Message) -> bytes:
    """Return a message of python-can as ``struct can_frame`` or ``struct canfd_frame``."""
    data = bytes(message.data)
    flags = CANFD_FDF if message.is_fd else 0
    flags |= CANFD_BRS if message.bitrate_switch else 0
    room = (CANFD_MTU if message.is_fd else CAN_MTU) - _HEADER.size
    return _HEADER.pack(_identifier(message), len(data), flags) + data[:room].ljust(room, b"\0")


def unpack(raw: bytes) -> can.Message:
    """Return a ``struct can_frame`` or ``struct canfd_frame`` as a message of python-can."""
    identifier, length, flags = _HEADER.unpack_from(raw)
    extended = bool(identifier & ID_EXTENDED)
    return can.Message(
        arbitration_id=identifier & (0x1FFF_FFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_fd=len(raw) == CANFD_MTU,
        bitrate_switch=len(raw) == CANFD_MTU and bool(flags & CANFD_BRS),
        data=raw[_HEADER.size : _HEADER.size + length],
        is_rx=False,
    )


def _identifier(message: can.Message) -> int:
    """Return the identifier with its flags as in SocketCAN."""
    if message.is_error_frame:
        return CAN_ERR_FLAG | (message.arbitration_id & 0x1FFF_FFFF)
    flags = ID_EXTENDED if message.is_extended_id else 0
    return message.arbitration_id | flags | (CAN_RTR_FLAG if message.is_remote_frame else 0)
