"""The rig's end of a wire."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import socket
import time
import tty
from pathlib import Path
from typing import Final

from rthyb_rt.config import AxesRig
from rthyb_rt.config.rigfile import LinkTable
from rthyb_rt.core import loop, wire
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import opening
from rthyb_rt.rig.links.opened import Opened

_SETTLED_S: Final = 0.05
"""Time that a new connection is given to prove that it is up."""


class WireEnd:
    """The rig's end of a wire: a descriptor that stays the same while controllers change.

    Args:
        kind: as in `rthyb_rt.core.loop.Link`.
        fd: the descriptor; the line owns it.
        codec: the frames.
        name: for messages.
        mortal: whether the rig has nothing left to do once the other end is gone.

    Attributes:
        kind, fd, codec, name: as given.
    """

    def __init__(
        self, kind: loop.Kind, fd: int, codec: wire.Codec, name: str, *, mortal: bool = False
    ) -> None:
        self.kind, self.fd, self.codec, self.name = kind, fd, codec, name
        self._mortal = mortal

    def tend(self, link: loop.Link) -> bool:
        """Tend the connection; return False once there can be no other."""
        return not (self._mortal and link.down == "hung-up")

    def close(self) -> None:
        """Close the descriptor; may be called more than once."""
        fd, self.fd = self.fd, -1
        if fd >= 0:
            os.close(fd)


class OpenedLine(WireEnd):
    """A line over a link that is already open."""

    def __init__(self, opened: Opened) -> None:
        super().__init__(opened.kind, opened.fd, opened.codec, opened.name)
        self._opened = opened

    def tend(self, link: loop.Link) -> bool:
        """Tend the connection; return False once a thread in between has given up."""
        return self._opened.failure is None

    def close(self) -> None:
        """Release everything that was opened."""
        self.fd = -1
        self._opened.close()


class ListeningLine(WireEnd):
    """CAN frames over a socket in the file system, to which one controller after another connects.

    Args:
        path: of the socket.
        codec: the frames.

    Raises:
        InputError: another process is listening there, or the path cannot be used.
    """

    def __init__(self, path: Path, codec: wire.Codec) -> None:
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # No controller has connected yet: equivalent to one that has left.
        there.close()
        super().__init__("can", here.detach(), codec, str(path))
        self._path = path
        try:
            self._listener = _listen(path)
        except BaseException:
            super().close()
            raise
        self._connected_s = -math.inf

    def tend(self, link: loop.Link) -> bool:
        """Accept the next controller when one has left."""
        if link.down == "up" or time.monotonic() < self._connected_s + _SETTLED_S:
            return True
        with contextlib.suppress(BlockingIOError):
            peer, _ = self._listener.accept()
            with peer:
                # Replace the descriptor that the drive uses, in between two system calls.
                os.dup2(peer.fileno(), link.fd, inheritable=False)
            self._connected_s = time.monotonic()
        return True

    def close(self) -> None:
        """Stop listening and remove the socket from the file system."""
        if self.fd >= 0:
            self._listener.close()
            self._path.unlink(missing_ok=True)
        super().close()


def _listen(path: Path) -> socket.socket:
    with contextlib.ExitStack() as undo:
        listener = undo.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        try:
            _remove_abandoned(path)
            # Before the socket has its name, so that no other process can connect in between.
            os.fchmod(listener.fileno(), 0o600)
            listener.bind(str(path))
            listener.listen(1)
            listener.setblocking(False)
        except OSError as error:
            raise InputError(
                f"no socket can be created here ({error.strerror or error}); choose a path of at "
                "most 100 characters in a folder to which you have write access",
                str(path),
            ) from error
        undo.pop_all()
        return listener


def _remove_abandoned(path: Path) -> None:
    if not path.is_socket():
        if path.exists():
            raise InputError("already exists and is not a socket; choose another path", str(path))
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        refused = probe.connect_ex(str(path))
    if refused != errno.ECONNREFUSED:
        raise InputError(
            "another virtual rig is listening here; stop it, or choose another path", str(path)
        )
    path.unlink()


def pty_line() -> tuple[WireEnd, str]:
    """Return a line of serial packets on a new pty, and the path of the pty's other end."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    path = os.ttyname(slave)
    # Unread bytes must not wait for the first controller: without one the line is dead.
    os.close(slave)
    return WireEnd("stream", master, wire.serial(), path), path


def inherited_line(fd: int) -> WireEnd:
    """Return the line on a socket inherited from another process; it ends with that process."""
    return WireEnd("can", fd, wire.can(), "socket pair", mortal=True)


def lines_of(rig: AxesRig) -> list[WireEnd]:
    """Open the drive's end of the link of each axis of a rig.

    Raises:
        InputError: what prevents one of them, with its axis.
    """
    with contextlib.ExitStack() as undo:
        found = opening.at_each(rig, lambda link, shared: line_of(link, shared=shared), undo)
        undo.pop_all()
    return list(found.values())


def line_of(link: LinkTable, *, shared: bool = False) -> WireEnd:
    """Open the drive's end of a rig file's link; ``shared`` as of `opening.open_link`.

    Raises:
        InputError: what prevents it.
    """
    if link.kind == "socket":
        return ListeningLine(Path(link.channel), wire.can())
    return OpenedLine(opening.open_link(link, "drive", shared=shared))
