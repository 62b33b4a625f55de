"""The frames of a rig's link, and the extra channels in them."""

from __future__ import annotations

from importlib import util
from pathlib import Path

from rthyb_rt.config import LinkTable, RigFile
from rthyb_rt.core import dbc, wire
from rthyb_rt.core.wire import Codec, Extra
from rthyb_rt.errors import InputError


def dbc_is_read(link: LinkTable) -> bool:
    """Return whether a DBC file, if the link has one, could be read and checked."""
    return link.dbc is None or util.find_spec("cantools") is not None


def codec_of_link(link: LinkTable | None) -> Codec:
    """Return the codec of a link as the rig file describes it; without a link, that of the program.

    Raises:
        InputError: the DBC file cannot be read or used.
    """
    if link is not None and link.kind == "serial":
        return wire.serial()
    if link is None or link.dbc is None:
        return wire.can()
    names = {str(role): name for role, name in link.names.items()}
    return dbc.load(Path(link.dbc), names, link.reset_state)


def codec_of(rig: RigFile, codec: Codec) -> Codec:
    """Return the codec of a rig's link, extended by the rig's extra channels.

    Both ends of the link use it: the drive that measures, and the controller that records.

    Args:
        rig: the rig, for its extra channels.
        codec: of its link, as opened.

    Raises:
        InputError: a channel does not exist in the frames of the rig's DBC file.
    """
    extras = []
    for i, one in enumerate(rig.sensors.extra):
        signal, in_force = None, False
        if rig.link is not None and rig.link.dbc is not None:
            try:
                signal, in_force = dbc.extra(Path(rig.link.dbc), codec, one.signal or one.name)
            except InputError as error:
                raise InputError(str(error), f"sensors.extra.{i}.signal") from None
        extras.append(Extra(one.scale, one.offset, one.wire_step, signal, in_force))
    return codec.with_extras(extras)
