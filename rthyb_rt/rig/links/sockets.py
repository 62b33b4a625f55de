"""CAN frames over AF_UNIX sockets: controller and virtual drive on one machine, without a bus."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
from pathlib import Path

from rthyb_rt.core import wire
from rthyb_rt.core.wire import Codec
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import locks
from rthyb_rt.rig.links.opened import Opened, Owned

MODE = 0o600


def socket_pair(codec: Codec | None = None) -> tuple[Opened, Opened]:
    """Return both ends of an unnamed link: controller and drive of one test."""
    codec = codec or wire.can()
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    first, second = (_opened(end, "pair", codec, Owned()) for end in pair)
    for opened, end in zip((first, second), pair, strict=True):
        opened.owned.callback(end.close)
    return first, second


def connect_socket(path: str | Path, codec: Codec | None = None) -> Opened:
    """Connect to a virtual drive that listens at a path, as the controller.

    Raises:
        InputError: no program is listening, another controller is connected, or no permission.
    """
    where = str(path)
    with Owned() as owned:
        locks.hold(owned, where, os.path.realpath(where), "controller")
        sock = owned.enter_context(_socket())
        try:
            sock.connect(where)
        except OSError as error:
            raise InputError(_not_connected(error, where), where) from None
        return _opened(sock, where, codec, owned)


def listen_socket(
    path: str | Path, codec: Codec | None = None, *, timeout_s: float | None = None
) -> Opened:
    """Wait at a path for a controller and accept exactly one, as the drive.

    The path is accessible to this user only, and removed as soon as the controller has connected.

    Args:
        path: of the socket; a stale socket of a dead process is removed, anything else is not.
        codec: the frames.
        timeout_s: how long to wait; ``None``: until a controller connects or a signal arrives.

    Raises:
        InputError: the path is in use or cannot be created, or no controller connected in time.
    """
    where = str(path)
    with Owned() as owned:
        locks.hold(owned, where, os.path.realpath(where), "drive")
        with _socket() as listener:
            _bind(listener, where)
            try:
                listener.settimeout(timeout_s)
                sock = owned.enter_context(listener.accept()[0])
            except TimeoutError:
                raise InputError(f"no controller connected within {timeout_s} s", where) from None
            finally:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(where)
        return _opened(sock, where, codec, owned)


def _socket() -> socket.socket:
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def _opened(sock: socket.socket, where: str, codec: Codec | None, owned: Owned) -> Opened:
    return Opened(
        kind="can",
        fd=sock.fileno(),
        codec=codec or wire.can(),
        real_time=True,
        name=f"socket {where}",
        facts={"path": where},
        owned=owned.pop_all(),
    )


def _not_connected(error: OSError, where: str) -> str:
    start = f"start the drive first: `rthyb rig RIG.toml --socket {where}`"
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return f"the socket does not exist; {start}"
    if error.errno == errno.ECONNREFUSED:
        return f"no program is listening there; {start}"
    if error.errno == errno.EPROTOTYPE:
        return (
            "not the socket of a virtual drive (AF_UNIX SEQPACKET); use the same path as `rthyb "
            "rig --socket`"
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return "no permission; only the user who started a virtual drive may connect to its socket"
    return f"cannot be connected to: {error.strerror or error}"


def _bind(listener: socket.socket, where: str) -> None:
    _remove_stale(where)
    os.fchmod(listener.fileno(), MODE)  # before bind, which creates the path with this mode
    try:
        listener.bind(where)
    except OSError as error:
        raise InputError(
            f"no socket can be created there: {error.strerror or error}", where
        ) from None
    try:
        listener.listen(1)
    except BaseException:
        os.unlink(where)
        raise


def _remove_stale(where: str) -> None:
    """Remove the socket of a dead process; InputError for anything else."""
    try:
        if not stat.S_ISSOCK(os.lstat(where).st_mode):
            raise InputError("already exists and is not a socket; choose another path", where)
    except FileNotFoundError:
        return
    except OSError as error:
        raise InputError(f"no socket can be created there: {error.strerror}", where) from None
    with _socket() as probe:
        try:
            probe.connect(where)
        except ConnectionRefusedError:
            os.unlink(where)
            return
        except OSError:
            pass
    raise InputError(
        "another program is listening there; stop it first, or choose another path", where
    )
