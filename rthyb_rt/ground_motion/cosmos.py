"""COSMOS V1 and V2 (strong motion data format 1.20, COSMOS, 2001).

Each channel repeats: text header whose first line is ``Corrected acceleration (Format v01.20 with
13 text lines)``, integer header, real header, comment lines, then
``7000 acceleration pts, approx 70 secs, units=cm/sec2(04),Format=(8F10.5)`` and the data. Every
block states its own length and Fortran format. The interval of the series is real header 62, in
milliseconds; real header 34, in seconds, is that of the recorder, which can differ.
"""

from __future__ import annotations

import math
import re

from rthyb_rt.ground_motion.acceleration_units import canonical_unit
from rthyb_rt.ground_motion.channels import FileChannel, Samples, choose_channel
from rthyb_rt.ground_motion.text import TextLines, clean, read_block

_FORMAT = r"\( ?(\d{0,3}) ?[A-Za-z]{1,2}(\d{1,3})"
_FIRST = re.compile(
    r"^ {0,20}(raw|uncorrected|corrected) (?:acceleration|velocity|displacement)"
    r"[^(]{0,60}\(format v",
    re.IGNORECASE,
)
_REAL_HEADER = re.compile(
    rf"^ *(\d{{1,4}}) +real[- ]header values.{{0,60}}format *= *{_FORMAT}",
    re.IGNORECASE | re.ASCII,
)
_DATA = re.compile(
    r"^ *(\d{1,9}) +([a-z]{3,20}) +(?:pts|points)\b,?(.{0,80}?)units *= *([^,]{1,30}),"
    rf" *format *= *{_FORMAT}",
    re.IGNORECASE | re.ASCII,
)
_CHANNEL = re.compile(r"^ *Sta +Cha[n:]? *:? *(\d{0,4}|\?) *: *(.{0,30}?) *(?:\(|Location|$)", re.I)
# Codes of table 2 of the format for acceleration; 50 and above are counts and volts.
_UNIT_CODES = {2: "g", 4: "cm/s2", 7: "in/s2", 10: "cm/s2", 11: "mg"}


def cosmos_volume(text: TextLines) -> str | None:
    """Return the format's name if the first line is that of a COSMOS file."""
    match = _FIRST.match(text.header(0))
    if not match:
        return None
    return "cosmos-v2" if match.group(1).lower() == "corrected" else "cosmos-v1"


def read_cosmos(text: TextLines, channel: int | str | None) -> Samples:
    """Read one channel of acceleration of a COSMOS V1 or V2 file.

    Raises:
        InputError: the file contains raw counts or no acceleration, a header cannot be read or
            contradicts itself, the channel is unknown, or the data are damaged.
    """
    first = _FIRST.match(text.header(0))
    if first and first.group(1).lower() == "raw":
        raise text.error("holds raw counts (V0); use the V1 or V2 file of the same record", 0)
    channels = _acceleration_channels(text)
    if not channels:
        raise text.error(
            "holds no acceleration (no line such as '7000 acceleration pts, approx 70 secs,"
            " units=cm/sec2(04),Format=(8F10.5)'); use the acceleration file"
        )
    chosen = choose_channel(text, channels, channel)
    match = _DATA.match(text.header(chosen.index))
    assert match is not None
    points, columns, width = int(match.group(1)), int(match.group(5) or 1), int(match.group(6))
    if min(points, columns, width) < 1:
        raise text.error(f"{clean(match.group(), 80)!r} announces no data", chosen.index)
    unit = _unit(text, chosen.index, match.group(4))
    dt_s = _interval(text, chosen.index)
    _check_length(text, chosen.index, points * dt_s, match.group(3))
    values = read_block(text, chosen.index + 1, points, columns=columns, width=width)
    details = {"channel": str(chosen)}
    for name, pattern in (("station", r"^Statn No:(.*)"), ("event", r"^(?:Record|Rcrd) of (.*)")):
        for index in range(min(14, len(text.lines))):
            found = re.match(pattern, text.header(index), re.IGNORECASE)
            if found:
                details[name] = clean(found.group(1), 100)
    return Samples(dt_s, values, unit, "header", details)


def _acceleration_channels(text: TextLines) -> list[FileChannel]:
    """Return the channels of acceleration, without velocity and displacement series."""
    channels: list[FileChannel] = []
    number, label = "", ""
    for index, line in enumerate(text.lines):
        start = line[:12].lower()
        if "sta" in start and "cha" in start:
            named = _CHANNEL.match(text.header(index))
            if named:
                number, label = named.group(1), clean(named.group(2), 40)
        elif " pts" in line or " points" in line or " PTS" in line:
            data = _DATA.match(text.header(index))
            if data and data.group(2).lower().startswith("acc"):
                place = len(channels) + 1
                channels.append(
                    FileChannel(int(number) if number.isdecimal() else place, label, index)
                )
    return channels


def _unit(text: TextLines, index: int, said: str) -> str:
    """Return the unit of the data line, ``cm/sec2(04)``; name and code must agree."""
    match = re.match(r"([^(]*?) *(?:\( *(\d{1,4}) *\))? *$", said.strip(), re.ASCII)
    assert match is not None
    by_name = canonical_unit(match.group(1))
    by_code = _UNIT_CODES.get(int(match.group(2))) if match.group(2) else by_name
    if by_name is None or by_code is None or by_name != by_code:
        raise text.error(
            f"units={clean(said, 40)!r} is not a known unit of acceleration, or its name and code"
            " disagree; cm/sec2(04), g(02), gal(10), mg(11) and in/sec2(07) are read",
            index,
        )
    return by_name


def _interval(text: TextLines, data_index: int) -> float:
    """Return the interval of the series, s, from the real header before the data line."""
    for index in range(data_index - 1, max(-1, data_index - 4000), -1):
        if "eal" not in text.lines[index][:40] and "EAL" not in text.lines[index][:40]:
            continue
        match = _REAL_HEADER.match(text.header(index))
        if match:
            break
    else:
        raise text.error("no real-valued header before the data; the file is damaged", data_index)
    count, columns, width = int(match.group(1)), int(match.group(2) or 1), int(match.group(3))
    if count < 62 or columns < 1 or width < 1:
        raise text.error("the real header is shorter than 62 values", index)
    header = read_block(
        text, index + 1, count, columns=columns, width=width, said="the real header says"
    )
    in_milliseconds, of_recorder = float(header[61]), float(header[33])
    if in_milliseconds > 0.0:
        return in_milliseconds / 1000.0
    if of_recorder > 0.0:
        return of_recorder
    raise text.error(
        f"the sampling interval is unknown: real header 62 is {in_milliseconds:g} (ms) and 34 is"
        f" {of_recorder:g} (s)",
        index,
    )


def _check_length(text: TextLines, index: int, length_s: float, said: str) -> None:
    """Compare points times interval with the duration that the data line states."""
    match = re.search(r"approx *\.? *(\d{1,7}\.?\d{0,6}) *sec", said, re.IGNORECASE | re.ASCII)
    if match:
        stated = float(match.group(1))
        if math.fabs(stated - length_s) > max(2.0, 0.05 * stated):
            raise text.error(
                f"points times interval give {length_s:g} s, but the line says about {stated:g} s;"
                " the header is wrong (real header 62 is the interval in milliseconds)",
                index,
            )
