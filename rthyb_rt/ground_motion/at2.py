"""PEER AT2: four lines of header, then accelerations in rows.

The fourth line is ``NPTS=  4000, DT= .01000 SEC`` or, in the NGA files, ``4000  0.0100  NPTS,
DT``; the third names the quantity and the unit
(https://peer.berkeley.edu/smcat/data.html, "Time history").
"""

from __future__ import annotations

import re

from rthyb_rt.ground_motion.acceleration_units import canonical_unit, find_unit
from rthyb_rt.ground_motion.channels import Samples
from rthyb_rt.ground_motion.text import TextLines, clean, header_text, parse_float, read_block

_HEADER_LINES = 20
_FLOAT = r"((?:\d{1,9}\.?\d{0,12}|\.\d{1,12})(?:[eEdD][+-]?\d{1,3})?)"
_NAMED_POINTS = re.compile(r"NPTS *[=:]? *(\d{1,9})(?![\d.])", re.IGNORECASE | re.ASCII)
_NAMED_STEP = re.compile(rf"\bDT *[=:]? *{_FLOAT}", re.IGNORECASE | re.ASCII)
_VALUES_FIRST = re.compile(rf"^ *(\d{{1,9}}) *,? +{_FLOAT} *,? *NPTS", re.IGNORECASE | re.ASCII)


def is_at2(text: TextLines) -> bool:
    """Return whether the text has the NPTS line of a PEER file."""
    return _points_line(text) is not None


def resembles_at2(text: TextLines) -> bool:
    """Return whether the text is a PEER file that lacks only its NPTS line."""
    head = " ".join(text.header(i) for i in range(min(_HEADER_LINES, len(text.lines)))).upper()
    named = text.path.upper().endswith(".AT2")
    return not is_at2(text) and (named or "PEER" in head or "IN UNITS OF" in head)


def read_at2(text: TextLines, units: str | None) -> Samples:
    """Read a PEER AT2 file; ``units`` applies if the header names none; the default is g.

    Raises:
        InputError: there is no NPTS/DT line, the file has velocity or displacement instead of
            acceleration, or the data do not agree with the header.
    """
    index = _points_line(text)
    if index is None:
        raise text.error(
            "is not a PEER AT2 file as it comes from the database: no line with NPTS and DT among"
            f" the first {_HEADER_LINES} lines; put back 'NPTS= 4000, DT= .01000 SEC' with the"
            " record's own numbers, or download it again"
        )
    points, dt_s = _points_and_step(text, index)
    header = [text.header(i) for i in range(index)]
    joined = " ".join(header).upper()
    if re.search(r"\b(?:VELOCITY|DISPLACEMENT) (?:TIME|HISTORY|SERIES)", joined):
        raise text.error("holds velocity or displacement; use the file with acceleration (.AT2)")
    unit = None
    for line in reversed(header):
        match = re.search(r"\(([^()]{1,20})\)", line) if "HISTORY" in line.upper() else None
        unit = find_unit(line) or (canonical_unit(match.group(1)) if match else None)
        if unit is not None:
            break
    details = {"header": header_text(header)}
    if index >= 2:
        details["event"] = clean(header[index - 2])
    return Samples(
        dt_s=dt_s,
        values=read_block(text, index + 1, points, said="NPTS says"),
        unit=unit or units or "g",
        unit_from="header" if unit else "argument" if units else "PEER convention",
        details=details,
    )


def _points_line(text: TextLines) -> int | None:
    """Return the index of the line with NPTS and DT."""
    for index in range(min(_HEADER_LINES, len(text.lines))):
        line = text.header(index).upper()
        if "NPTS" in line and "DT" in line:
            return index
    return None


def _points_and_step(text: TextLines, index: int) -> tuple[int, float]:
    """Return NPTS and DT, s, from their line in either order of name and value."""
    line = text.header(index)
    points = _NAMED_POINTS.search(line)
    step = _NAMED_STEP.search(line)
    if points and step:
        values = points.group(1), step.group(1)
    else:
        match = _VALUES_FIRST.match(line)
        if not match:
            raise text.error(
                f"{clean(line, 80)!r}: NPTS and DT cannot be read; expected"
                " 'NPTS= 4000, DT= .01000 SEC' or '4000 0.0100 NPTS, DT'",
                index,
            )
        values = match.group(1), match.group(2)
    dt_s = parse_float(values[1])
    assert dt_s is not None
    return int(values[0]), dt_s
