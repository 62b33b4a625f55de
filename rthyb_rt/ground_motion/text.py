"""Text of a strong-motion file: loading, line numbers for messages, blocks of numbers."""

from __future__ import annotations

import hashlib
import math
import re
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from rthyb_rt.errors import InputError, Problem
from rthyb_rt.ground_motion.acceleration import FloatArray

MAX_BYTES = 64 * 2**20
MAX_POINTS = 2_000_000
#: Largest number of errors listed for one file; the others are counted.
MAX_PROBLEMS = 5

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?", re.ASCII)
_NOT_FINITE = re.compile(r"[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
_LINE_END = re.compile(r"\r\n|\n|\r")
_BINARY_STARTS = {
    b"PK\x03\x04": "a ZIP archive: unpack it and give the file inside",
    b"\x1f\x8b": "a gzip file: unpack it first",
    b"MATLAB 5.0": "a MATLAB file: export time and acceleration as text",
    b"\x89HDF": "an HDF5 file: export time and acceleration as text",
}
# Tab, line feed, form feed, carriage return and DOS end-of-file occur in text.
_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0e-\x19\x1b-\x1f\x7f]")


@dataclass(frozen=True)
class TextLines:
    """The lines of a text file.

    Attributes:
        path: the file as given by the user.
        lines: text without line ends; line number = index + 1.
        encoding: encoding of the bytes.
        sha256: checksum of the file's bytes.
    """

    path: str
    lines: list[str]
    encoding: str
    sha256: str

    def at(self, index: int) -> str:
        """Return ``file:line`` of the line with this index."""
        return f"{self.path}:{index + 1}"

    def header(self, index: int) -> str:
        """Return the beginning of a line, which is sufficient for any header."""
        return self.lines[index][:300]

    def error(self, message: str, index: int | None = None) -> InputError:
        """Return an error about the file, or about one of its lines."""
        return InputError(message, self.path if index is None else self.at(index))


def load_text(path: str | PathLike[str]) -> TextLines:
    """Read a text file of at most 64 MiB, whatever its encoding and line ends.

    Raises:
        InputError: the file is missing, unreadable, empty, too large or not text.
    """
    name = clean(str(path), 300)
    try:
        info = Path(path).stat()
        if not stat.S_ISREG(info.st_mode):
            raise InputError("is not a file; give a ground-motion file", name)
        with Path(path).open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError("no such file; check the name and the folder", name) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not a usable file name"
        raise InputError(f"cannot be read ({reason})", name) from None
    if len(data) > MAX_BYTES:
        raise InputError(
            f"is larger than {MAX_BYTES // 2**20} MiB; cut out the part and the channel that are "
            "needed",
            name,
        )
    text, encoding = _decode(data, name)
    if not text.strip():
        raise InputError("is empty; a record of time and acceleration is needed", name)
    return TextLines(name, _LINE_END.split(text), encoding, hashlib.sha256(data).hexdigest())


def _decode(data: bytes, name: str) -> tuple[str, str]:
    """Return the text and its encoding; raise an error if it is not text."""
    for start, what in _BINARY_STARTS.items():
        if data.startswith(start):
            raise InputError(f"is {what}", name)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            text, encoding = data.decode("utf-16"), "utf-16"
        except UnicodeDecodeError:
            raise InputError("begins like UTF-16 text but is damaged", name) from None
        if "\x00" in text:
            raise InputError("is not a text file", name)
    else:
        control = _CONTROL.search(data)
        if control:
            raise InputError(
                f"is not a text file (byte 0x{control.group()[0]:02x} at position"
                f" {control.start()}); export time and acceleration as text",
                name,
            )
        try:
            text, encoding = data.decode("utf-8-sig"), "utf-8"
        except UnicodeDecodeError:
            text, encoding = data.decode("latin-1"), "latin-1"
    return text.rstrip("\x1a"), encoding


def clean(text: str, length: int = 200) -> str:
    """Return a piece of a file on one line of printable text, for messages and details."""
    shown = "".join(c if c.isprintable() else " " for c in text[: 4 * length])
    return " ".join(shown.split())[:length]


_GOES_ON = re.compile(r"([.,;:]| (in|of|the|and|by|at|to|for|from|with))$")


def header_text(lines: Iterable[str], length: int = 300) -> str:
    """Return the header of a file on one line; a long one ends with a sentence or with "…".

    Lines are joined as they read: sentences continue, separate entries follow after ";".
    """
    whole = ""
    for line in filter(None, (clean(line, 400).lstrip("# ") for line in lines)):
        joint = " " if _GOES_ON.search(whole) else "; "
        whole += (joint if whole else "") + line
    if len(whole) <= length:
        return whole
    cut = whole[: length - 1]
    sentence = cut.rfind(". ") + 1
    return cut[:sentence] if sentence > length // 3 else cut[: cut.rfind(" ")].rstrip(" ,;") + " …"


def parse_float(token: str) -> float | None:
    """Return a number in C, Python or Fortran notation (1.5D-3), or None."""
    if not _NUMBER.fullmatch(token):
        return None
    return float(token.replace("D", "E").replace("d", "e"))


def limited(problems: Iterable[Problem], path: str) -> InputError:
    """Return one error for many errors of a file: the first ones, and the number of others."""
    found = list(problems)
    shown = found[:MAX_PROBLEMS]
    if len(found) > MAX_PROBLEMS:
        shown.append(Problem(path, f"and at least {len(found) - MAX_PROBLEMS} more faults"))
    return InputError(shown)


def not_a_number(token: str) -> str:
    """Return the message for a value that is not a finite number."""
    shown = clean(token, 40)
    if _NOT_FINITE.fullmatch(shown) or parse_float(shown) is not None:
        return (
            f"the value is {shown}; every value of a record must be finite: repair or cut the "
            "record, gaps are not filled in"
        )
    if shown and set(shown) == {"*"}:
        return f"{shown} marks a number too large for its field; get a complete file"
    if re.fullmatch(r"[+-]?\d+,\d+", shown):
        return f"{shown!r} has a decimal comma; use decimal points"
    return f"{shown!r} is not a number"


def read_block(
    text: TextLines,
    first: int,
    count: int,
    *,
    columns: int | None = None,
    width: int | None = None,
    said: str = "the header says",
) -> FloatArray:
    """Read ``count`` numbers from line ``first`` on, up to the next line of text.

    With a Fortran format (``columns`` fields of ``width`` characters per line), fields may touch;
    without one they are separated by blanks, and a sign may touch the number before it.

    Args:
        text: the file.
        first: index of the first line of numbers.
        count: expected number of values.
        columns: fields per line.
        width: characters per field.
        said: origin of ``count``, for the message.

    Raises:
        InputError: a value is not a finite number, or there are more or fewer values than
            ``count``.
    """
    if count > MAX_POINTS:
        raise text.error(f"{said} {count} points; at most {MAX_POINTS} are accepted", first - 1)
    last = first
    while last < len(text.lines) and not _is_words(text.lines[last]):
        last += 1
    block = text.lines[first:last]
    tokens = " ".join(block).split() if sum(map(len, block)) < 100 * (count + 100) else []
    if len(tokens) == count and all(map(_NUMBER.fullmatch, tokens)):
        values = np.array([float(t.replace("D", "E").replace("d", "e")) for t in tokens])
        if bool(np.isfinite(values).all()):
            return values
    return _read_fields(text, first, last, count, columns, width, said)


def _is_words(line: str) -> bool:
    """Return whether a line of a data block is text: the end-of-data mark or the next header."""
    rest = _NOT_FINITE.sub("", line[:300])
    return re.search(r"[A-Za-z]{2,}|[|/&#=]|--", rest) is not None


def _read_fields(
    text: TextLines,
    first: int,
    last: int,
    count: int,
    columns: int | None,
    width: int | None,
    said: str,
) -> FloatArray:
    """Read a block field by field, with the line of every error."""
    values: list[float] = []
    problems: list[Problem] = []
    for index in range(first, last):
        line = text.lines[index]
        if len(line) > 100_000:
            raise text.error(
                "the line is longer than this format allows; the file is damaged", index
            )
        for field in _fields(line, columns, width, count - len(values)):
            value = parse_float(field)
            if value is None or not math.isfinite(value):
                problems.append(Problem(text.at(index), not_a_number(field)))
                value = 0.0
            values.append(value)
        if len(values) > count + MAX_POINTS or len(problems) > 1000:
            break
    if problems:
        raise limited(problems, text.path)
    if len(values) < count:
        ended = f" ({clean(text.lines[last], 40)!r} follows)" if last < len(text.lines) else ""
        raise text.error(
            f"{said} {count} points, but the file has {len(values)}{ended}: it is truncated or the "
            "header is wrong; get the complete file",
            min(last, len(text.lines) - 1),
        )
    if len(values) > count:
        raise text.error(
            f"{said} {count} points, but the file has {len(values)}; correct the header or get the"
            " original file"
        )
    return np.array(values)


def _fields(line: str, columns: int | None, width: int | None, remaining: int) -> list[str]:
    """Split one line of numbers into fields."""
    tokens = line.split()
    if columns is not None and width is not None:
        if len(tokens) == min(columns, remaining):
            return tokens
        body = line.rstrip()
        return [body[i : i + width].strip() for i in range(0, len(body), width)]
    fields: list[str] = []
    for token in tokens:
        parts = _NUMBER.findall(token)
        fields.extend(parts if len(parts) > 1 and "".join(parts) == token else [token])
    return fields


def time_step(
    times_s: FloatArray, text: TextLines, line_index: Iterable[int], remedy: str
) -> tuple[float, float]:
    """Return the interval and the first instant of a column of times.

    Times may be rounded to the decimals with which they are printed; the interval is then the
    round rate or the round interval that fits them all.

    Args:
        times_s: instants, s, shape (n,), n >= 2.
        text: the file.
        line_index: index of the line of every instant.
        remedy: what the user can do about uneven times.

    Raises:
        InputError: times decrease, repeat or are not equally spaced, with row and interval.
    """
    steps = np.diff(times_s)
    usual = float(np.median(steps))
    rows = list(line_index)
    if bool((steps <= 0.0).any()):
        k = int(np.argmax(steps <= 0.0)) + 1
        word = "repeats" if steps[k - 1] == 0.0 else "goes back"
        raise text.error(
            f"time {word}: {times_s[k]:.9g} s after {times_s[k - 1]:.9g} s; times must increase "
            "by a constant interval from row to row",
            rows[k],
        )
    count = times_s.size - 1
    mean = float(times_s[-1] - times_s[0]) / count
    quantum = _printed_quantum(times_s)
    single_precision = 1.2e-7 * float(np.abs(times_s).max())
    tolerance = min(1.01 * quantum + 1e-3 * mean + single_precision, 0.25 * mean)
    away = np.abs(times_s - (times_s[0] + mean * np.arange(count + 1)))
    if bool((away > tolerance).any()):
        # The step at fault is the one that differs; a slow drift shows only in the total.
        uneven = np.abs(steps - usual) > max(tolerance, 0.02 * usual)
        k = int(np.argmax(uneven) if uneven.any() else np.argmax(away[1:])) + 1
        raise text.error(
            f"time is not equally spaced: found an interval of {steps[k - 1]:.6g} s before"
            f" {times_s[k]:.9g} s, expected {usual:.6g} s; {remedy}",
            rows[k],
        )
    candidates = [round(mean, 6)]
    if mean < 1.0:
        candidates.insert(0, 1.0 / round(1.0 / mean))
    for candidate in candidates:
        if candidate > 0.0 and abs(candidate - mean) * count <= tolerance:
            return candidate, float(times_s[0])
    return mean, float(times_s[0])


def _printed_quantum(times_s: FloatArray) -> float:
    """Return the last decimal place of the printed times, s; 0 if finer than 1e-9."""
    for decimals in range(10):
        scaled = times_s * 10.0**decimals
        if bool(np.all(np.abs(scaled - np.rint(scaled)) <= 1e-12 * np.abs(scaled) + 1e-9)):
            return float(10.0**-decimals)
    return 0.0
