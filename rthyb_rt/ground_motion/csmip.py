"""CSMIP Volume 1 and Volume 2 (Shakal & Huang, OSMS 85-03, 1985, and later files).

Data blocks are announced by a line:
Volume 2 ``15050 points of accel data equally spaced at  .020 sec, in cm/sec2. (8f10.6)``,
digital Volume 1 ``13200 Accelerogram points at 200 pts/sec in units of g . Format: (8f9.6)``.
A Volume 1 of a film recorder has none: after 13 text lines, 100 integers (16i5) and 50 reals
(8f10.3) it holds pairs of time and acceleration (10f7.3). A channel ends with
``/&  ---------- End of data for channel  1 ----------``; fields may touch.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from rthyb_rt.ground_motion.acceleration import FloatArray
from rthyb_rt.ground_motion.acceleration_units import canonical_unit, find_unit
from rthyb_rt.ground_motion.channels import FileChannel, Samples, choose_channel
from rthyb_rt.ground_motion.text import MAX_POINTS, TextLines, clean, read_block, time_step

_FORMAT = r"\( ?(\d{1,3}) ?[fFeEgG] ?(\d{1,3})"
_FLOAT = r"(\d{0,6}\.?\d{1,9})"
_EQUALLY_SPACED = re.compile(
    r"^ *(\d{1,9}) +points +of +acc[a-z.]{0,12} +data +equally[ -]spaced +at +"
    rf"{_FLOAT} *sec[a-z.]{{0,5}} *,? *(?:in +(?:units of +)?([^(]{{1,20}}?))?[. ]*(?:{_FORMAT}|$)",
    re.IGNORECASE | re.ASCII,
)
_PER_SECOND = re.compile(
    rf"^ *(\d{{1,9}}) +acc[a-z.]{{0,15}} +points +at +{_FLOAT} *"
    r"(?:pts|points|samples)/sec[a-z]{0,4}"
    rf" *,? *in +units +of +([^(:]{{1,20}}?)[. ]*(?:format)? *:? *(?:{_FORMAT}|$)",
    re.IGNORECASE | re.ASCII,
)
_FILM_POINTS = re.compile(r"NO\. OF POINTS *= *(\d{1,9})", re.IGNORECASE | re.ASCII)
_FILM_UNIT = re.compile(r"\bARE +SEC +AND +([^ .]{1,12})", re.IGNORECASE)
_CHANNEL = re.compile(
    r"(?:^|\s)Chan(?:nel)? {0,3}(\d{1,4}) *: *(.{0,24}?)(?: {2,}|\(| from|$)", re.I
)
_FILM_HEADER_LINES = 13 + 7 + 7
_FILM_FORMAT = (10, 7)


@dataclass(frozen=True)
class _Block:
    """One block of acceleration: its channel and how to read it."""

    channel: FileChannel
    points: int
    dt_s: float | None  # None: the block contains its own times
    unit: str | None
    columns: int
    width: int


def csmip_volume(text: TextLines) -> str | None:
    """Return the format's name if the text is a CSMIP file."""
    first = text.header(0).lower()
    if "corrected accelerogram" in first:
        return "csmip-v1" if "uncorrected accelerogram" in first.split(" from ")[0] else "csmip-v2"
    if "response and fourier amplitude spectra" in first:
        return "csmip-v2"
    if any(_is_announcement(line) and _EQUALLY_SPACED.match(line[:300]) for line in text.lines):
        return "csmip-v2"
    return None


def read_csmip(text: TextLines, channel: int | str | None) -> Samples:
    """Read one channel of acceleration of a CSMIP Volume 1 or 2 file.

    Raises:
        InputError: spectra instead of a record, no block of acceleration, an unknown unit or
            channel, film data that are not equally spaced, or damaged data.
    """
    if "response and fourier" in text.header(0).lower():
        raise text.error("is a Volume 3 (spectra); use the Volume 2 of the same record", 0)
    blocks = _announced_blocks(text) or _film_blocks(text)
    if not blocks:
        raise text.error(
            "holds no block of acceleration (no line such as '15050 points of accel data equally"
            " spaced at .020 sec, in cm/sec2. (8f10.6)')"
        )
    chosen = choose_channel(text, [block.channel for block in blocks], channel)
    block = next(b for b in blocks if b.channel is chosen)
    if block.unit is None:
        raise text.error("the unit of acceleration is not known", chosen.index)
    if min(block.points, block.columns, block.width) < 1 or block.points > MAX_POINTS:
        raise text.error(f"{block.points} points in this format cannot be read", chosen.index)
    details = {"channel": str(chosen), "header": clean(text.header(0), 100)}
    if block.dt_s is None:
        dt_s, values = _read_film(text, block)
    else:
        dt_s = block.dt_s
        values = read_block(
            text, chosen.index + 1, block.points, columns=block.columns, width=block.width
        )
    return Samples(dt_s, values, block.unit, "header", details)


def _is_announcement(line: str) -> bool:
    """Return whether a line may announce a block of data, by a fast test."""
    return " points " in line[:60] or " POINTS " in line[:60]


def _announced_blocks(text: TextLines) -> list[_Block]:
    """Return the announced blocks of acceleration, with the channel named before each."""
    blocks: list[_Block] = []
    number, label = 0, ""
    for index, line in enumerate(text.lines):
        if "Chan" in line or "CHAN" in line:
            named = _CHANNEL.search(text.header(index))
            if named:
                number, label = int(named.group(1)), clean(named.group(2), 24)
        if not _is_announcement(line):
            continue
        spaced = _EQUALLY_SPACED.match(text.header(index))
        match = spaced or _PER_SECOND.match(text.header(index))
        if match is None:
            continue
        rate = float(match.group(2))
        dt_s = rate if spaced else 1.0 / rate if rate > 0.0 else 0.0
        blocks.append(
            _Block(
                FileChannel(number or len(blocks) + 1, label, index),
                int(match.group(1)),
                dt_s,
                canonical_unit(match.group(3)) if match.group(3) else None,
                int(match.group(4) or 8),
                int(match.group(5) or 10),
            )
        )
        number, label = 0, ""
    return blocks


def _film_blocks(text: TextLines) -> list[_Block]:
    """Return the channels of a Volume 1 of pairs, each 27 header lines and its data."""
    blocks: list[_Block] = []
    start = 0
    while start + _FILM_HEADER_LINES < len(text.lines) and len(blocks) < 200:
        header = "\n".join(text.header(i) for i in range(start, start + 13))
        points, unit = _FILM_POINTS.search(header), _FILM_UNIT.search(header)
        if points is None:
            break
        named = next((m for line in header.split("\n") if (m := _CHANNEL.search(line))), None)
        index = start + _FILM_HEADER_LINES - 1
        columns, width = _FILM_FORMAT
        blocks.append(
            _Block(
                FileChannel(
                    int(named.group(1)) if named else len(blocks) + 1,
                    clean(named.group(2), 24) if named else "",
                    index,
                ),
                int(points.group(1)),
                None,
                canonical_unit(unit.group(1)) if unit else find_unit(header),
                columns,
                width,
            )
        )
        start = index + 1
        while start < len(text.lines) and "END OF DATA" not in text.lines[start].upper():
            start += 1
        start += 1
    return blocks


def _read_film(text: TextLines, block: _Block) -> tuple[float, FloatArray]:
    """Return interval and accelerations of a block of (time, acceleration) pairs."""
    first = block.channel.index + 1
    pairs = read_block(
        text,
        first,
        2 * block.points,
        columns=block.columns,
        width=block.width,
        said="the header's pairs make",
    )
    times, values = pairs[0::2], pairs[1::2]
    if times.size < 2:
        return 1.0, values
    lines = (first + 2 * k // block.columns for k in range(times.size))
    dt_s, _ = time_step(
        times, text, lines, "film is digitised unevenly: use the Volume 2 of the same record"
    )
    return dt_s, values
