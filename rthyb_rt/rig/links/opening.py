"""Open a link as the rig file describes it, check it, and pass its descriptor to the core.

Nothing here causes motion: no frame is sent, and no interface is brought up.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol, TypeVar

from rthyb_rt.config import AxesRig
from rthyb_rt.config.linkframes import codec_of_link
from rthyb_rt.config.rigfile import DEFAULT_BAUD, LinkTable
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import serial_line, sockets
from rthyb_rt.rig.links.opened import Opened, Side, together
from rthyb_rt.rig.links.sockets import connect_socket, listen_socket, socket_pair

__all__ = [
    "Opened",
    "Side",
    "at_each",
    "connect_socket",
    "listen_socket",
    "open_axes",
    "open_link",
    "socket_pair",
    "socket_pairs",
    "together",
]

# Without a handler, Python prints python-can's own messages beside ours.
logging.getLogger("can").addHandler(logging.NullHandler())


class Closes(Protocol):
    """What is closed when it is no longer needed."""

    def close(self) -> None:
        """Release it; may be called more than once."""


_T = TypeVar("_T", bound=Closes)


def open_link(
    wanted: LinkTable, side: Side, *, folder: Path | None = None, shared: bool = False
) -> Opened:
    """Open a link for the controller or for a drive.

    Args:
        wanted: the rig file's ``[link]``.
        side: which end. Over a socket the controller connects; the drive listens and waits for one
            controller.
        folder: what ``dbc`` is relative to; the current folder by default.
        shared: another axis of the same rig has already opened this bus.

    Raises:
        InputError: what prevents it, and what to do.
    """
    if wanted.kind == "serial":
        return serial_line.open_line(
            wanted.channel, wanted.bitrate or DEFAULT_BAUD, wanted.sample_rate_hz
        )
    codec = codec_of_link(wanted, folder)
    if wanted.kind == "can":
        from rthyb_rt.rig.links import can_bus  # python-can is slow to import

        return can_bus.open_can(wanted, side, codec, shared=shared)
    if wanted.kind == "python-can":
        from rthyb_rt.rig.links import exchange

        return exchange.open_bus(wanted, side, codec, shared=shared)
    reach = sockets.connect_socket if side == "controller" else sockets.listen_socket
    return reach(wanted.channel, codec)


def open_axes(rig: AxesRig, side: Side, *, folder: Path | None = None) -> Opened:
    """Open the links of all axes of a rig, each as described by its ``[axis.link]``.

    Axes on one CAN bus have a socket each, filtered by their own identifiers.

    Raises:
        InputError: what prevents one of them, with its axis; none remains open then.
    """
    with ExitStack() as undo:
        links = at_each(
            rig,
            lambda link, shared: open_link(link, side, folder=folder, shared=shared),
            undo,
        )
        undo.pop_all()
    return together(links)


def at_each(
    rig: AxesRig, reach: Callable[[LinkTable, bool], _T], owned: ExitStack
) -> dict[str, _T]:
    """Open something for the link of each axis of a rig and return it by name.

    Args:
        rig: the rig.
        reach: opens one; its second argument is whether a previous axis has opened the same bus.
        owned: takes ownership of what is open.

    Raises:
        InputError: an axis has no link, or what ``reach`` raises, with the axis.
    """
    found: dict[str, _T] = {}
    buses: set[tuple[str, str]] = set()
    for axis in rig.axis:
        where = f"axis.{axis.name}.link"
        if axis.link is None:
            raise InputError("the axis has no link; give a link for every axis, or for none", where)
        bus = (axis.link.kind, axis.link.channel)
        try:
            found[axis.name] = reach(axis.link, bus in buses)
        except InputError as error:
            raise InputError(str(error), where) from error
        owned.callback(found[axis.name].close)
        buses.add(bus)
    return found


def socket_pairs(names: Sequence[str]) -> tuple[Opened, Opened]:
    """Return both ends of an unnamed link for each of several axes: controller and drives."""
    pairs = {name: socket_pair() for name in names}
    ours = together({name: pair[0] for name, pair in pairs.items()})
    return ours, together({name: pair[1] for name, pair in pairs.items()})
