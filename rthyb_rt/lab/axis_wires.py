"""The readings of an axis' own sensors: their conversion, and what the frames can carry.

A drive that saturates sends the end of what a frame holds, which looks like a reading. It is
recognised only if the frame carries the whole range of the sensor.
"""

from __future__ import annotations

import math

from rthyb_rt import core
from rthyb_rt.config import AxesRig, Limits, LinkTable, RigFile
from rthyb_rt.config.linkframes import codec_of_link, frames_are_known
from rthyb_rt.config.placing import placing
from rthyb_rt.errors import InputError, Problem


def calibration(rig: RigFile) -> core.WireCalibration:
    """Return the six factors between the wire and the structure.

    The channels of the rig file convert from the wire to the specimen, its similitude from the
    specimen to the structure; a command is converted in the opposite direction.
    """
    given = rig.calibration
    x, f, command = given.displacement, given.force, given.command or given.displacement
    length, force = given.similitude.length, given.similitude.force
    return core.WireCalibration(
        x_gain=length * x.gain,
        x_offset_m=length * x.offset_m,
        f_gain=force * f.gain,
        f_offset_n=force * f.offset_n,
        cmd_gain=1.0 / (length * command.gain),
        cmd_offset_m=0.0 - command.offset_m / command.gain,
    )


@placing
def check(rig: RigFile | AxesRig) -> None:
    """Refuse a displacement sensor or load cell with a larger range than its frame carries.

    Raises:
        InputError: lists every such sensor; or a DBC file cannot be read.
    """
    if isinstance(rig, RigFile):
        problems = _problems(rig, "")
    else:
        problems = [
            problem
            for k, name in enumerate(rig.names)
            for problem in _problems(rig.of_axis(name), f"axis.{k}.")
        ]
    if problems:
        raise InputError(problems)


def _problems(rig: RigFile, prefix: str) -> list[Problem]:
    displacement, force = rig.sensors.displacement.range_m, rig.sensors.force.range_n
    if _unread(rig) or (displacement is None and force is None):
        return []
    codec, by = codec_of_link(rig.link), calibration(rig)
    reach_m = codec.reading_reach(force=False, gain=by.x_gain, offset=by.x_offset_m)
    reach_n = codec.reading_reach(force=True, gain=by.f_gain, offset=by.f_offset_n)
    return [
        Problem(
            f"{prefix}sensors.{key}", _too_small(rig.link, key, range_ * factor, reach * factor)
        )
        for key, range_, reach, factor in (
            ("displacement.range_m", displacement, reach_m, 1e3),
            ("force.range_n", force, reach_n, 1e-3),
        )
        if range_ is not None and reach < range_
    ]


def _too_small(link: LinkTable | None, key: str, range_: float, reach: float) -> str:
    """Return what is wrong with a range, and what to do; both values in mm or kN."""
    of, _, name = key.partition(".")
    signal, unit = ("f_meas", "kN") if of == "force" else ("x_meas", "mm")
    most = f"{_rounded_down(reach):.6g} {unit}"
    carrier = f"{signal} in the frames of the link"
    said = beyond_frame(f"{range_:.6g} {unit}", carrier, most, _more(link, of, range_, reach))
    if reach > 0.0:
        said += f'; or set {name} = "{_rounded_down(reach):.6g} {unit}", where a test then ends'
    return said


def beyond_frame(range_: str, carrier: str, most: str, remedy: str) -> str:
    """Return why a range that a frame does not carry is refused, and what to do.

    Args:
        range_: the range that is stated, with its unit.
        carrier: the signal or channel, and where it is.
        most: the largest reading that it carries, with its unit.
        remedy: what to do.
    """
    return (
        f"found {range_}, but {carrier} carries every reading only up to {most}; a larger one "
        f"would arrive as a reading at that end: {remedy}"
    )


def _more(link: LinkTable | None, of: str, wanted: float, reach: float) -> str:
    """Return how the frames can carry more; ``of``: displacement or force."""
    if link is not None and link.dbc is not None:
        signal = "f_meas" if of == "force" else "x_meas"
        return f"give {signal} in the DBC file more bits, a larger factor or a wider [min|max]"
    if not reach > 0.0:
        return f"correct calibration.{of}"
    # A power of ten, which a reader of the frames can undo at a glance.
    factor = 10.0 ** math.ceil(math.log10(wanted / reach))
    return (
        f"let the drive send the reading divided by {factor:g}, and multiply "
        f"calibration.{of}.scale by {factor:g}"
    )


def check_limit(rig: RigFile, limits: Limits) -> None:
    """Refuse a limit of the force that no reading can reach, because its frame ends before.

    With a range stated, a test ends there at the latest.

    Args:
        rig: the rig, or one axis of several.
        limits: those of a test on it.

    Raises:
        InputError: the limit, and what the frame carries.
    """
    limit = limits.force_n
    if limit is None or not limit.acts or rig.sensors.force.range_n is not None or _unread(rig):
        return
    by = calibration(rig)
    codec = codec_of_link(rig.link)
    reach = codec.reading_reach(force=True, gain=by.f_gain, offset=by.f_offset_n)
    if limit.value <= reach:
        return
    shown = f"{_rounded_down(reach * 1e-3):.6g} kN"
    raise InputError(
        f"found {limit.value * 1e-3:.6g} kN, but f_meas in the frames of the link carries every "
        f"reading only up to {shown}, so this limit would never act: "
        f"{_more(rig.link, 'force', limit.value, reach)}; or lower the limit",
        "limits.force_n",
    )


def _unread(rig: RigFile) -> bool:
    """Return whether the frames are unknown: a check says so, and real time is refused."""
    return rig.link is not None and not frames_are_known(rig.link)


def _rounded_down(value: float) -> float:
    """Return a value with six digits, not above it: a range of that size is carried."""
    if not value > 0.0:
        return 0.0
    last = 10.0 ** (math.floor(math.log10(value)) - 5)
    return math.floor(value / last) * last
