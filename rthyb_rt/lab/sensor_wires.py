"""The channels through which sensors without an actuator are read: what the frames can carry.

A converter that saturates sends the end of its range, which looks like a reading. Such a reading is
recognised if the frame carries the whole range of the sensor, because it is then at or beyond the
end of that range.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.config.linkframes import codec_of_link
from rthyb_rt.config.lonesensors import LoneForce, LoneSensor
from rthyb_rt.config.rigfile import ExtraSensor, LinkTable
from rthyb_rt.core import wire
from rthyb_rt.errors import InputError, Problem
from rthyb_rt.lab import extra_frames
from rthyb_rt.lab.axis_wires import beyond_frame

WIRE_MOST: Final = 2**31 - 1
"""Largest number in the 32-bit field of an extra channel of the program's own frames."""


@dataclass(frozen=True)
class Carried:
    """What the frames of a link carry of a sensor.

    Attributes:
        reach: largest magnitude of which every reading is carried, of either sign, m or N.
        step: difference of neighbouring readings, m or N; 0: as fine as a floating-point number.
    """

    reach: float
    step: float


def carried(rig: AxesRig) -> list[Carried | None]:
    """Return what the frames carry of each of `AxesRig.lone_sensors`; None: it names no channel.

    Raises:
        InputError: a DBC file cannot be read, or has no such channel.
    """
    codecs = {name: codec_of(rig.of_axis(name)) for name in _axes(rig)}
    found: list[Carried | None] = []
    for place in rig.sensor_places:
        if place is None:
            found.append(None)
            continue
        axis, number = place
        codec = codecs[rig.names[axis]]
        found.append(Carried(codec.extra_reach(number), codec.extra_step(number)))
    return found


def check(rig: AxesRig) -> None:
    """Refuse a sensor whose range is larger than what its channel carries.

    Raises:
        InputError: lists every such sensor; or as `carried`.
    """
    problems = []
    for one, place, found in zip(rig.lone_sensors, rig.sensor_places, carried(rig), strict=True):
        if place is None or found is None:
            continue
        key, range_ = (
            ("range_n", one.range_n) if isinstance(one, LoneForce) else ("range_m", one.range_m)
        )
        if range_ is not None and found.reach < range_:
            number = (rig.sensor or []).index(one)
            problems.append(
                Problem(f"sensor.{number}.{key}", _too_small(rig, one, place, range_, found.reach))
            )
    problems += _shared(rig)
    if problems:
        raise InputError(problems)


def _shared(rig: AxesRig) -> list[Problem]:
    """Return a problem for each sensor whose channel is the same number as that of another one."""
    taken, problems = dict[tuple[int, int, int], str](), []
    codecs = {name: codec_of(rig.of_axis(name)) for name in _axes(rig)}
    for one, place in zip(rig.lone_sensors, rig.sensor_places, strict=True):
        if place is None:
            continue
        slot = codecs[rig.names[place[0]]].struct.extra[place[1]]
        at = (place[0], int(slot.in_force), int(slot.signal.start))
        if at in taken:
            number = (rig.sensor or []).index(one)
            problems.append(
                Problem(
                    f"sensor.{number}.extra",
                    f"found {one.extra}, whose signal in the frames of axis {rig.names[place[0]]} "
                    f"is that of the sensor {taken[at]} too; each sensor needs a signal of its own",
                )
            )
        taken.setdefault(at, one.name)
    return problems


def _axes(rig: AxesRig) -> list[str]:
    return [rig.names[k] for k in sorted({place[0] for place in rig.sensor_places if place})]


def codec_of(rig: RigFile) -> wire.Codec:
    """Return the frames of an axis, with its extra channels, by its rig file alone.

    Raises:
        InputError: a DBC file cannot be read, or has no such channel.
    """
    return extra_frames.codec_of(rig, codec_of_link(rig.link))


def _too_small(
    rig: AxesRig, one: LoneSensor, place: tuple[int, int], range_: float, reach: float
) -> str:
    axis = rig.axis[place[0]]
    channel = axis.sensors.extra[place[1]]
    unit, factor = ("kN", 1e-3) if isinstance(one, LoneForce) else ("mm", 1e3)
    return beyond_frame(
        f"{range_ * factor:.6g} {unit}",
        f"in the frames of axis {axis.name} the channel {channel.name}, which extra of {one.name} "
        "names,",
        f"{reach * factor:.6g} {unit} of either sign",
        f"{_remedy(axis.link, channel, range_)}, or state the range of a smaller sensor",
    )


def _remedy(link: LinkTable | None, channel: ExtraSensor, range_: float) -> str:
    if link is not None and link.dbc is not None:
        return (
            "correct scale and offset of the channel, or give its signal in the DBC file more bits "
            "or a wider [min|max]"
        )
    least = (range_ + abs(channel.offset)) / (WIRE_MOST * abs(channel.scale))
    # Rounded up, so that the step that is asked for is enough.
    return f"found wire_step = {channel.wire_step:g}; it must be at least {1.0005 * least:.3e}"
