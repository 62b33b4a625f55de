"""Units of acceleration: their spellings in strong-motion files and their size in m/s2."""

from __future__ import annotations

import re
from types import MappingProxyType

STANDARD_GRAVITY_MPS2 = 9.80665

#: Canonical unit -> its size in m/s2.
ACCELERATION_UNITS = MappingProxyType(
    {
        "g": STANDARD_GRAVITY_MPS2,
        "g/10": STANDARD_GRAVITY_MPS2 / 10.0,
        "%g": STANDARD_GRAVITY_MPS2 / 100.0,
        "mg": STANDARD_GRAVITY_MPS2 / 1000.0,
        "m/s2": 1.0,
        "cm/s2": 0.01,
        "mm/s2": 0.001,
        "in/s2": 0.0254,
        "ft/s2": 0.3048,
    }
)

_SAME_UNIT = {
    "g's": "g",
    "gs": "g",
    "gn": "g",
    "gal": "cm/s2",
    "gals": "cm/s2",
}

_SPELLING = (
    r"(?:mm|cm|m|in|ft)/s(?:ec)?/s(?:ec)?"
    r"|(?:mm|cm|m|in|ft) ?[/.*·]? ?s(?:ec)?(?:\^|\*\*)?-?[2²]"
    r"|(?:mm|cm|m)ps2|gals?|mg|g/10|% ?g|g(?:'s|n)?"
)
_END = r"(?![A-Za-z0-9])"
_AFTER_NAME = re.compile(
    r"(?<![A-Za-z0-9])(?:acc[a-z]{0,20}|ag|a(?=[_ ]?[(\[_]))[_ ]{0,4}[(\[{,:]? ?"
    rf"(?:in )?(?:units? )?(?:of )?({_SPELLING}){_END}",
    re.IGNORECASE,
)
_AFTER_WORD_UNIT = re.compile(
    rf"(?<![A-Za-z0-9])units?[ _]?(?:of|are|is|in|:|=)? ?({_SPELLING}){_END}", re.IGNORECASE
)


def canonical_unit(text: str) -> str | None:
    """Return the canonical name of an acceleration unit, or None when it is not one.

    >>> canonical_unit("cm/sec/sec"), canonical_unit("(m/s^2)"), canonical_unit("gal")
    ('cm/s2', 'm/s2', 'cm/s2')
    """
    unit = text.strip().strip("()[]{}").lower().replace(" ", "").rstrip(".,")
    for old, new in (("²", "2"), ("^", ""), ("**", ""), ("sec", "s"), ("/s/s", "/s2")):
        unit = unit.replace(old, new)
    unit = re.sub(r"^(mm|cm|m|in|ft)(?:ps2|[.*·]?s-2)$", r"\1/s2", unit)
    unit = _SAME_UNIT.get(unit, unit)
    return unit if unit in ACCELERATION_UNITS else None


def find_unit(text: str) -> str | None:
    """Return the acceleration unit that a header line names, or None.

    Understands column names (``acc_g``, ``Acceleration (cm/s^2)``, ``ag_mps2``) and the phrase
    ``units of g``.
    """
    line = " ".join(text[:400].split())
    for pattern in (_AFTER_NAME, _AFTER_WORD_UNIT):
        match = pattern.search(line)
        if match:
            return canonical_unit(match.group(1))
    return None


def likely_units(peak_in_file: float) -> list[str]:
    """Return the units in which a peak value would be an ordinary PGA (0.01 g to 3 g)."""
    common = ("g", "m/s2", "cm/s2", "mm/s2", "mg")
    return [
        unit
        for unit in common
        if 0.01 <= peak_in_file * ACCELERATION_UNITS[unit] / STANDARD_GRAVITY_MPS2 <= 3.0
    ]
