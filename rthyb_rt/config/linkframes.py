"""The frames of a link as the rig file describes it, and the load of a bus that axes share."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rthyb_rt.config import busload
from rthyb_rt.config.fields import written
from rthyb_rt.config.rigfile import BUSES, ExtraSensor, LinkTable

if TYPE_CHECKING:
    from rthyb_rt.config.axesfile import AxesRig
    from rthyb_rt.core.wire import Codec

_OWN_BUS = "give each axis a bus of its own"
_FD = "with fd = true and a data_bitrate, frames of CAN FD carry the same numbers in less time; or "
_FASTER = "raise data_bitrate if all drives can follow, or "


def frames_are_known(link: LinkTable) -> bool:
    """Return whether a DBC file, if the link has one, can be read: this needs cantools."""
    return link.dbc is None or importlib.util.find_spec("cantools") is not None


def codec_of_link(link: LinkTable | None, folder: Path | None = None) -> Codec:
    """Return the codec of a link, without extra channels; without a link, that of the program.

    Args:
        link: the rig file's ``[link]``.
        folder: what ``dbc`` is relative to; the current folder by default.

    Raises:
        InputError: the DBC file cannot be read or used, or cantools is not installed.
    """
    from rthyb_rt.core import wire

    if link is not None and link.kind == "serial":
        return wire.serial()
    if link is not None and link.dbc is not None:
        from rthyb_rt.core import dbc

        names = {str(role): name for role, name in link.names.items()}
        return dbc.load((folder or Path()) / link.dbc, names, link.reset_state)
    if link is None or link.ids is None:
        return wire.can()
    given = link.ids
    return wire.own(
        wire.Identifiers(given.command, given.displacement, given.force),
        fd=link.fd,
        switched=link.data_bitrate is not None,
    )


def frames_of_link(
    link: LinkTable, extra: Sequence[ExtraSensor] = ()
) -> tuple[busload.FrameSize, ...]:
    """Return the frames of one sample on a CAN link: the program's own, or those of its DBC file.

    Args:
        link: the link.
        extra: extra channels in its feedback. Those of a DBC file do not change its frames.

    Raises:
        InputError: the DBC file cannot be used, or cantools is not installed.
    """
    if link.dbc is None:
        return busload.own_frames(
            fd=link.fd and link.ids is not None, extras=len(extra) if link.ids else 0
        )
    return busload.frames_of(codec_of_link(link))


def on_one_bus(rig: AxesRig, number: int) -> list[int]:
    """Return the numbers of the axes whose links are on the same line as that of one axis."""
    link = rig.axis[number].link
    if link is None:
        return [number]
    place = _place(link)
    return [
        i for i, axis in enumerate(rig.axis) if axis.link is not None and _place(axis.link) == place
    ]


def _place(link: LinkTable) -> tuple[str, str, str]:
    return link.kind, link.channel, link.interface or ""


def shared_links(rig: AxesRig) -> list[tuple[int, str]]:
    """Return errors in links of two axes that share a line: number of the axis, and the reason.

    Several axes can share a CAN bus if their frames have different identifiers and the bus has the
    capacity for all.
    """
    found = list[tuple[int, str]]()
    for number, axis in enumerate(rig.axis):
        axes = on_one_bus(rig, number)
        if axis.link is None or len(axes) == 1 or number != axes[0]:
            continue
        names = " and ".join(rig.names[i] for i in axes)
        channel = written(axis.link.channel)
        if axis.link.kind not in BUSES:
            complaint = f"axes {names} are both at {channel}; each axis needs its own"
        else:
            complaint = _one_bus(rig, axes, names, channel) or ""
        if complaint:
            found.append((axes[-1], complaint))
    return found


def _one_bus(rig: AxesRig, axes: list[int], names: str, channel: str) -> str | None:
    links = [link for i in axes if (link := rig.axis[i].link) is not None]
    if not all(frames_are_known(link) for link in links):
        return None
    first = links[0]
    of_fd = [rig.names[i] for i in axes if (link := rig.axis[i].link) is not None and link.fd]
    if 0 < len(of_fd) < len(axes):
        classic = [rig.names[i] for i in axes if rig.names[i] not in of_fd]
        return (
            f"axes {names} share {channel}, but fd = true is given for {' and '.join(of_fd)} and "
            f"not for {' and '.join(classic)}; a bus is either CAN FD or classic CAN, because a "
            "drive of classic CAN destroys frames of CAN FD: give fd = true, with the same bit "
            "rates, for all of them or for none, or a bus of its own"
        )
    if first.bitrate is None:
        return _same_identifiers(rig, axes, channel) or (
            f"axes {names} share {channel}, and without a bitrate its load cannot be "
            "checked; give the same bitrate in both links"
        )
    if any((one.bitrate, one.data_bitrate) != (first.bitrate, first.data_bitrate) for one in links):
        return _same_identifiers(rig, axes, channel) or (
            f"axes {names} share {channel} but have different bit rates; give the same for both"
        )
    return _same_identifiers(rig, axes, channel) or busload.bus_fault(
        [frame for i in axes for frame in frames_of_axis(rig, i)],
        first.bitrate,
        first.data_bitrate,
        rate_hz=first.sample_rate_hz,
        otherwise=busload.SHORTER if any(one.dbc for one in links) else _more_room(first),
    )


def _more_room(link: LinkTable) -> str:
    """Return what to do if the program's own frames of several axes load a bus too much."""
    if not link.fd:
        return _FD + _OWN_BUS
    # Without a data_bitrate, `busload.bus_fault` itself says to set it.
    faster = link.data_bitrate is not None and link.data_bitrate < busload.MOST_DATA_BITRATE
    return (_FASTER if faster else "") + _OWN_BUS


def frames_of_axis(rig: AxesRig, number: int) -> tuple[busload.FrameSize, ...]:
    """Return the frames of one sample of an axis with a link on a CAN bus; as `frames_of_link`."""
    axis = rig.axis[number]
    return () if axis.link is None else frames_of_link(axis.link, axis.sensors.extra)


def _same_identifiers(rig: AxesRig, axes: list[int], channel: str) -> str | None:
    seen: dict[int, str] = {}
    for i in axes:
        codec = codec_of_link(rig.axis[i].link)
        for one in sorted({codec.command_id, *codec.feedback_ids}):
            if one in seen:
                return (
                    f"axes {seen[one]} and {rig.names[i]} both use frames with the identifier "
                    f"0x{one & 0x1FFFFFFF:X} on {channel}; give each its own identifiers in "
                    "link.ids or in a DBC file of its own, or a bus of its own"
                )
            seen[one] = rig.names[i]
    return None
