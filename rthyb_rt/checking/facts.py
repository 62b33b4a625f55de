"""Data of a test for its check: limits, link, dates of commissioning, calibration."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rthyb_rt import config
from rthyb_rt.config import Limit, LinkTable, busload
from rthyb_rt.config.limits import unit_of
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axis_wires, extra_frames
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.rig.commissioning import certificate


def limits_of(setup: Setup) -> list[dict[str, Any]]:
    """Return every limit of test and rig combined: key, value, unit, action, origin."""
    found = []
    for key, source in setup.derived.limits.sources.items():
        limit = getattr(setup.test.limits, key)
        watched = isinstance(limit, Limit)
        found.append(
            {
                "key": key,
                "value": limit.value if watched else limit,
                "unit": unit_of(key),
                "action": (limit.action if limit.enable else "none") if watched else None,
                "enable": limit.enable if watched else True,
                "from": source,
            }
        )
    return found + _derived(setup)


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


def link_of(setup: Setup) -> dict[str, Any] | None:
    """Return the rig's link, with the load of bus or line by its frames."""
    link = setup.rig.link
    if link is None:
        return None
    load = _bus_load(link, len(setup.rig.sensors.extra))
    return {**link.model_dump(), "bus_load": load}


def _bus_load(link: LinkTable, extras: int) -> float | None:
    """Return the load of the bus or line, None if bit rate or frames are not known."""
    if link.bitrate is None:
        return None
    if link.kind == "serial":
        return busload.serial_load(link.bitrate, extras, rate_hz=link.sample_rate_hz)
    if not extra_frames.dbc_is_read(link):
        return None
    return busload.bus_load(
        config.frames_of_link(link),
        link.bitrate,
        link.data_bitrate,
        rate_hz=link.sample_rate_hz,
    )


def commissioning_of(setup: Setup, name: str | None) -> dict[str, Any] | None:
    """Return the checks made on the rig as its file is now; None without a link."""
    if setup.rig.link is None:
        return None
    path = config.find_rig(name)
    try:
        return certificate.standing(setup.rig, path).as_json()
    except InputError as error:
        return {
            "demanded": not setup.rig.link.virtual,
            "commissioned": False,
            "certificate": str(certificate.place(path)),
            "why_not": str(error),
            "steps": dict.fromkeys(certificate.STEPS),
        }


def calibration_of(setup: Setup) -> dict[str, float]:
    """Return the conversion factors between wire and structure by name."""
    return asdict(axis_wires.calibration(setup.rig))
