"""Units as written over a column: ``[mm]``, ``(kN)``, ``_kN``, ``, kN``, ``m/s²``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

from rthyb_rt import units
from rthyb_rt.diagnose.case import CHANNELS, Floats

SI: dict[str, str] = {"t": "s", **CHANNELS}
"""Unit of each column of a recording in the interchange format."""

USUAL: dict[str, tuple[str, ...]] = {
    "s": ("s", "ms", "us"),
    "m": ("m", "cm", "mm", "um", "in"),
    "N": ("N", "kN", "MN", "kgf", "lbf", "kip"),
    "m/s^2": ("m/s^2", "cm/s^2", "mm/s^2", "g"),
}
"""Usual units of a column that states none; any two differ by more than a factor of two."""

_SPELLINGS: dict[str, str] = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sek": "s", "sekunden": "s",
    "msec": "ms", "msecs": "ms", "millisecond": "ms", "milliseconds": "ms", "usec": "us",
    "microseconds": "us", "n": "N", "newton": "N", "newtons": "N", "kn": "kN", "lb": "lbf",
    "lbs": "lbf", "kips": "kip", "klbf": "kip", "inch": "in", "inches": "in", '"': "in",
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "millimeter": "mm",
    "millimeters": "mm", "millimetre": "mm", "millimetres": "mm", "micron": "um", "microns": "um",
    "micrometer": "um", "micrometre": "um", "gn": "g", "mps2": "m/s^2", "mpss": "m/s^2",
    "ms-2": "m/s^2", "ms^-2": "m/s^2", "m/sec2": "m/s^2", "m/sec^2": "m/s^2", "cm/sec2": "cm/s^2",
    "cm/sec^2": "cm/s^2",
}  # fmt: skip
_FURTHER: dict[str, tuple[str, str]] = {
    "kgf": ("9.80665", "N"), "kp": ("9.80665", "N"), "tf": ("9806.65", "N"),
    "mg": ("0.00980665", "m/s^2"), "milli-g": ("0.00980665", "m/s^2"),
    "%g": ("0.0980665", "m/s^2"), "mgal": ("1e-5", "m/s^2"), "mil": ("2.54e-5", "m"),
    "mils": ("2.54e-5", "m"), "thou": ("2.54e-5", "m"), "ns": ("1e-9", "s"), "h": ("3600", "s"),
}  # fmt: skip
"""Units that rig files do not use."""
_ELECTRIC = ("v", "mv", "uv", "volt", "volts", "mv/v", "ma")
_NONE = ("", "-", "--", "1", "none", "unitless", "[-]", "(-)")
_BRACKETS = re.compile(r"(.*?)[\s_,/]*[\[({<]([^\[\](){}<>]*)[\])}>]\s*")
_TAIL = re.compile(r"(.+?)(?:\s*[,/:]\s*|\s+in\s+|[\s_]+)([^\s,_]+)")


@dataclass(frozen=True)
class Stated:
    """A unit as it was written, its factor to SI, and the SI unit of its kind.

    If it measures something else, ``si`` is not the unit of any channel.
    """

    text: str
    factor: Fraction
    si: str


def read_unit(text: str) -> Stated | None:
    """Return a unit in any spelling, or None if it is not a unit."""
    plain = text.strip().strip("[](){}<>").strip().replace("**", "^").replace("\u00b7", "*")
    for spelled in (plain, _SPELLINGS.get(plain.lower(), ""), plain.lower()):
        if spelled in _NONE:
            continue
        if spelled.lower() in _FURTHER:
            number, si = _FURTHER[spelled.lower()]
            return Stated(plain, Fraction(number), si)
        try:
            found = units.unit(spelled)
        except (units.UnitError, ValueError, ZeroDivisionError, OverflowError, RecursionError):
            continue
        same = [si for si in USUAL if units.unit(si).dimension == found.dimension]
        return Stated(plain, found.factor, same[0] if same else plain)
    return None


def means_none(text: str) -> bool:
    """Return whether a text in place of a unit means that there is none."""
    return text.strip().lower() in _NONE


def is_electric(text: str) -> bool:
    """Return whether a unit is that of a sensor's electrical signal."""
    return text.strip().strip("[](){}").strip().lower() in _ELECTRIC


def split_name(header: str) -> tuple[str, str, bool]:
    """Split the name over a column into name and unit.

    Returns:
        Name, unit ("" for none), and whether brackets mark the unit; without them a last word
        that could be a unit may also be part of the name.
    """
    match = _BRACKETS.fullmatch(header)
    if match is not None and match[1].strip():
        return match[1].strip(), match[2].strip(), True
    match = _TAIL.fullmatch(header.strip())
    if match is not None and read_unit(match[2]) is not None:
        return match[1].strip(), match[2], False
    return header.strip(), "", False


def in_si(values: Floats, factor: Fraction) -> Floats:
    """Return values in SI with at most two roundings, so that 9 mm is the double next to 0.009."""
    if factor == 1:
        return values
    return values * float(factor.numerator) / float(factor.denominator)
