"""K-NET and KiK-net ASCII: 17 header lines, then integer counts.

Acceleration in gal is count x scale factor, ``3920(gal)/6182761``; the counts include the offset
of the sensor (https://www.kyoshin.bosai.go.jp, "K-NET ASCII format").
"""

from __future__ import annotations

import re

from rthyb_rt.ground_motion.channels import Samples
from rthyb_rt.ground_motion.text import MAX_POINTS, TextLines, clean, parse_float, read_block

_HEADER_LINES = 40
_SCALE = re.compile(r"([\d.]{1,20}) *\( *gal *\) */ *([\d.]{1,20})", re.IGNORECASE | re.ASCII)
_NAMES = {
    "Origin Time": "event_time",
    "Mag.": "magnitude",
    "Station Code": "station",
    "Record Time": "record_time",
    "Sampling Freq": "sampling",
    "Duration Time": "duration",
    "Dir.": "component",
    "Scale Factor": "scale_factor",
}


def is_knet(text: TextLines) -> bool:
    """Return whether the text begins like a K-NET file."""
    first = next(line for line in text.lines if line.strip())
    return first.lstrip().startswith("Origin Time")


def read_knet(text: TextLines) -> Samples:
    """Read a K-NET or KiK-net file and remove the mean, which is the sensor's offset.

    Raises:
        InputError: a header line is missing or unreadable, or the data are damaged or truncated.
    """
    header: dict[str, str] = {}
    last = None
    for index in range(min(_HEADER_LINES, len(text.lines))):
        line = text.header(index).strip()
        if line.startswith("Memo"):
            last = index
            break
        for start, name in _NAMES.items():
            if line.startswith(start):
                # "Sampling Freq(Hz) 100Hz": the unit belongs to the label.
                rest = re.sub(r"^\([^)]{0,20}\)", "", line[len(start) :])
                header.setdefault(name, rest.strip())
    if last is None:
        raise text.error("is not a K-NET file: the header has no 'Memo.' line before the data")
    scale = _SCALE.search(header.get("scale_factor", ""))
    rate = _leading_number(header.get("sampling", ""))
    if scale is None or rate is None or rate <= 0.0:
        raise text.error(
            "the K-NET header lacks 'Sampling Freq(Hz)' (such as 100Hz) or 'Scale Factor' (such"
            f" as 3920(gal)/6182761); found {clean(header.get('sampling', ''), 40)!r} and"
            f" {clean(header.get('scale_factor', ''), 40)!r}",
            last,
        )
    over, under = (parse_float(part) for part in scale.groups())
    if not over or not under:
        raise text.error(f"scale factor {clean(scale.group(), 60)!r} is not usable", last)
    data = [line for line in text.lines[last + 1 :] if line.strip()]
    found = sum(len(line.split()) for line in data)
    values = read_block(text, last + 1, min(found, MAX_POINTS + 1), said="there are")
    duration = _leading_number(header.get("duration", ""))
    details = {k: clean(v, 80) for k, v in header.items() if k not in ("sampling", "duration")}
    if duration is not None:
        missing = round(duration * rate) - values.size
        # The duration in the header is in whole seconds.
        if missing > rate:
            raise text.error(
                f"the header says {duration:g} s at {rate:g} Hz, but the file has "
                f"{values.size / rate:g} s: it is truncated; get the complete file"
            )
    mean = float(values.mean()) if values.size else 0.0
    gal = (values - mean) * (over / under)
    details["mean_removed_gal"] = f"{mean * over / under:.6g}"
    return Samples(1.0 / rate, gal, "cm/s2", "K-NET format", details)


def _leading_number(text: str) -> float | None:
    """Return the number at the beginning of a header value."""
    match = re.match(r"\d{1,9}\.?\d{0,9}", text, re.ASCII)
    return float(match.group()) if match else None
