"""The frames of a rig's link, and the extra channels in them."""

from __future__ import annotations

from pathlib import Path

from rthyb_rt.config import RigFile
from rthyb_rt.core import dbc
from rthyb_rt.core.wire import Codec, Extra
from rthyb_rt.errors import InputError


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
