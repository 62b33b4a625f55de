"""One CAN FD bus for the axes of a rig, in step with the test: every node hears every other one."""

from __future__ import annotations

import socket
import sys
from collections.abc import Collection, Sequence
from contextlib import ExitStack

from rthyb_rt.core import loop, wire

FIRST = (0x110, 0x120)
"""Identifier of the command of each axis; those of its readings follow."""
MOST_BYTES = 72
"""Of a frame between a program and the kernel's CAN sockets (CANFD_MTU)."""
FD_BYTE, SWITCHED = 5, 1
ERROR = 0x2000_0000


def identifiers(first: int) -> wire.Identifiers:
    return wire.Identifiers(first, first + 1, first + 2)


CODECS = tuple(wire.own(identifiers(first), fd=True, switched=True) for first in FIRST)


class Bus:
    """Nodes at one bus. A frame reaches all other nodes, in the order in which it was sent.

    Args:
        owned: closes it.
        accepted: identifiers that the filter of each node passes; None: all. Error frames pass
            every filter, as in SocketCAN.

    Attributes:
        nodes: the end of each node.
        frames: what was sent, of all nodes.
    """

    def __init__(self, owned: ExitStack, accepted: Sequence[Collection[int] | None]) -> None:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in accepted]
        self.nodes = [near for near, _ in pairs]
        self._ports = [far for _, far in pairs]
        self._accepted = list(accepted)
        self.frames: list[bytes] = []
        for near, far in pairs:
            owned.callback(near.close)
            owned.callback(far.close)

    def carry(self) -> None:
        """Pass on what the nodes have sent since."""
        for port in self._ports:
            for frame in _waiting(port):
                self.frames.append(frame)
                self.send(frame, but=port)

    def send(self, frame: bytes, but: socket.socket | None = None) -> None:
        number = int.from_bytes(frame[:4], sys.byteorder)
        for port, passed in zip(self._ports, self._accepted, strict=True):
            if port is not but and (passed is None or number & ERROR or number in passed):
                try:
                    port.send(frame, socket.MSG_DONTWAIT)
                except OSError:  # unplugged
                    continue


def _waiting(port: socket.socket) -> list[bytes]:
    found = []
    while True:
        try:
            frame = port.recv(MOST_BYTES, socket.MSG_DONTWAIT)
        except OSError:
            return found
        if not frame:
            return found
        found.append(frame)


class DrivesAtBus:
    """Drives whose commands and readings pass along the bus, with the interface of `Drives`."""

    def __init__(self, drives: Sequence[loop.Drive], bus: Bus) -> None:
        self._all, self._bus = loop.Drives(drives), bus

    @property
    def drives(self) -> Sequence[loop.Drive]:
        return self._all.drives

    def tick(self) -> None:
        self._bus.carry()
        self._all.tick()
        self._bus.carry()
