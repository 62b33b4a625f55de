"""Open a link as the rig file has it, check it, and hand its descriptor to the core.

Nothing here moves anything: no frame is sent, and no interface is set up that was not.
"""

from __future__ import annotations

import logging
from pathlib import Path

from rthyb_rt.config.rigfile import DEFAULT_BAUD, Link
from rthyb_rt.core import dbc, wire
from rthyb_rt.rig.links import serial_line, sockets
from rthyb_rt.rig.links.opened import Opened, Side
from rthyb_rt.rig.links.sockets import connect_socket, listen_socket, socket_pair

__all__ = [
    "Opened",
    "Side",
    "connect_socket",
    "listen_socket",
    "open_link",
    "socket_pair",
]

# Without a handler, Python prints python-can's own words beside our messages.
logging.getLogger("can").addHandler(logging.NullHandler())


def open_link(wanted: Link, side: Side, *, folder: Path | None = None) -> Opened:
    """Open a link for the controller or for a drive.

    Args:
        wanted: the rig file's ``[link]``.
        side: which end. Over a socket the controller connects; the drive listens, and waits until
            one controller has come.
        folder: what ``dbc`` is relative to; the current folder if there is none.

    Raises:
        InputError: what stands against it, and what to do.
    """
    if wanted.kind == "serial":
        return serial_line.open_line(wanted.channel, wanted.bitrate or DEFAULT_BAUD)
    codec = _codec(wanted, folder)
    if wanted.kind == "can":
        from rthyb_rt.rig.links import can_bus  # python-can takes its time

        return can_bus.open_can(wanted, side, codec)
    if wanted.kind == "python-can":
        from rthyb_rt.rig.links import exchange

        return exchange.open_bus(wanted, side, codec)
    reach = sockets.connect_socket if side == "controller" else sockets.listen_socket
    return reach(wanted.channel, codec)


def _codec(wanted: Link, folder: Path | None) -> wire.Codec:
    if not wanted.dbc:
        return wire.can()
    names = {str(role): name for role, name in wanted.names.items()}
    return dbc.load((folder or Path()) / wanted.dbc, names, wanted.reset_state)
