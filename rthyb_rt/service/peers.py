"""The user at the other end of the control socket, and the rights of that user."""

from __future__ import annotations

import errno
import grp
import os
import socket
import struct
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Final

LOOKERS: Final = "rthyb"
OPERATORS: Final = "rthyb-operator"

PASSWD: Final = Path("/etc/passwd")

_SO_PEERGROUPS: Final = 59
"""Supplementary groups of the peer when it connected; missing in Python's socket module."""
_CREDENTIALS: Final = struct.Struct("iII")
_GROUPS_BYTES: Final = 1024
"""The most that Python's getsockopt returns: 256 groups; beyond, only the primary group counts."""


class Role(IntEnum):
    """Rights, in increasing order."""

    NONE = 0
    LOOK = 1
    """May watch, hold and stop."""
    OPERATE = 2
    """May do everything."""


GROUP_OF: Final = {Role.LOOK: LOOKERS, Role.OPERATE: OPERATORS}


@dataclass(frozen=True)
class Peer:
    """A process at the other end, as identified by the kernel."""

    pid: int
    uid: int
    groups: frozenset[int]

    @property
    def user(self) -> str:
        """The user, for messages."""
        name = _user_name(self.uid)
        return f"{name} (uid {self.uid})" if name else f"uid {self.uid}"

    @property
    def name(self) -> str:
        """User and process, for messages."""
        return f"{self.user}, process {self.pid}"


def _user_name(uid: int) -> str:
    """Return the name of a local user, or ""; a query to a directory could take too long."""
    try:
        lines = PASSWD.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    for line in lines:
        name, *fields = line.split(":")
        if len(fields) > 1 and fields[1] == str(uid) and name.isprintable():
            return name
    return ""


@dataclass(frozen=True)
class Rights:
    """Groups that confer rights.

    Attributes:
        lookers, operators: group numbers; None if the group does not exist.
        owner: the user that runs the service, and could end it anyway.
    """

    lookers: int | None
    operators: int | None
    owner: int

    @classmethod
    def of_system(cls) -> Rights:
        """Return the rights by the groups of this system."""
        return cls(_gid(LOOKERS), _gid(OPERATORS), os.geteuid())

    def role(self, peer: Peer) -> Role:
        """Return the rights of a peer."""
        if peer.uid in (0, self.owner) or self.operators in peer.groups:
            return Role.OPERATE
        return Role.LOOK if self.lookers in peer.groups else Role.NONE


def _gid(name: str) -> int | None:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        return None


def peer_of(connection: socket.socket) -> Peer:
    """Return the peer of a connection.

    Raises:
        OSError: the kernel does not identify it.
    """
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, gid = _CREDENTIALS.unpack(raw)
    try:
        groups = connection.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _GROUPS_BYTES)
    except OSError as error:
        if error.errno != errno.ERANGE:
            raise
        groups = b""
    supplementary = struct.unpack(f"{len(groups) // 4}I", groups)
    return Peer(pid, uid, frozenset((gid, *supplementary)))
