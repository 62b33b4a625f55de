"""Data of a test or a rig for its check: limits, link, dates of commissioning, calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rthyb_rt import config
from rthyb_rt.config import Limit, Limits, LinkTable, RigFile, busload
from rthyb_rt.config.limits import unit_of
from rthyb_rt.config.linkframes import frames_are_known, frames_of_link
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axis_wires
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.rig.commissioning import certificate


def limits_of(setup: Setup) -> list[dict[str, Any]]:
    """Return every limit of test and rig combined: key, value, unit, action, origin."""
    found = [
        _stated(key, getattr(setup.test.limits, key), source)
        for key, source in setup.derived.limits.sources.items()
    ]
    return found + _derived(setup)


def limits_of_rig(limits: Limits) -> list[dict[str, Any]]:
    """Return the limits that a rig file states, in the same form."""
    return [
        _stated(key, limit, "rig")
        for key in type(limits).model_fields
        if (limit := getattr(limits, key)) is not None
    ]


def _stated(key: str, limit: Any, source: str) -> dict[str, Any]:
    watched = isinstance(limit, Limit)
    return {
        "key": key,
        "value": limit.value if watched else limit,
        "unit": unit_of(key),
        "action": (limit.action if limit.enable else "none") if watched else None,
        "enable": limit.enable if watched else True,
        "from": source,
    }


def _derived(setup: Setup) -> list[dict[str, Any]]:
    """Return the limits that no file gives and that a test with a link has nevertheless."""
    return [
        {
            "key": key,
            "value": limit.value,
            "unit": unit_of(key),
            "action": limit.action,
            "enable": True,
            "from": "derived",
        }
        for key, limit in setup.derived.limits.derived.items()
    ]


def link_of(rig: RigFile, on_bus: Sequence[RigFile] = ()) -> dict[str, Any] | None:
    """Return the rig's link, with the load of bus or line.

    Args:
        rig: the rig, or one axis of several.
        on_bus: for one axis of several, all axes on its bus, whose frames load it together.
    """
    link = rig.link
    if link is None:
        return None
    found = {**link.model_dump(), "bus_load": _bus_load(on_bus or (rig,), link)}
    if len(on_bus) > 1:
        found["axes_on_bus"] = len(on_bus)
    return found


def _bus_load(rigs: Sequence[RigFile], link: LinkTable) -> float | None:
    """Return the load of the bus or line, None if bit rate or frames are not known."""
    if link.bitrate is None:
        return None
    if link.kind == "serial":
        extras = len(rigs[0].sensors.extra)
        return busload.serial_load(link.bitrate, extras, rate_hz=link.sample_rate_hz)
    frames = list[busload.FrameSize]()
    for rig in rigs:
        if rig.link is None or not frames_are_known(rig.link):
            return None
        frames += frames_of_link(rig.link, rig.sensors.extra)
    return busload.bus_load(frames, link.bitrate, link.data_bitrate, rate_hz=link.sample_rate_hz)


def commissioning_of(rig: RigFile, name: str | None, axis: str = "") -> dict[str, Any] | None:
    """Return the checks made on the rig as its file is now; None without a link.

    Args:
        rig: the rig, or one axis of several.
        name: path or name of the rig.
        axis: name of the axis.
    """
    if rig.link is None:
        return None
    path = config.find_rig(name)
    try:
        return certificate.standing(rig, path, axis).as_json()
    except InputError as error:
        return {
            "demanded": not rig.link.virtual,
            "commissioned": False,
            "certificate": str(certificate.place(path, axis)),
            "why_not": str(error),
            "steps": dict.fromkeys(certificate.STEPS),
        }


def calibration_of(rig: RigFile) -> dict[str, float]:
    """Return the conversion factors between wire and structure by name."""
    return asdict(axis_wires.calibration(rig))


def unread_frames(link: LinkTable | None) -> list[str]:
    """Return a warning if the link's DBC file could not be read."""
    if link is None or frames_are_known(link):
        return []
    return [
        "link.dbc was not read and its frames were not checked, so a test in real time will "
        "be refused; reading a DBC file needs cantools: pip install 'rthyb-rt[wire]'"
    ]
