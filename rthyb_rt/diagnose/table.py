"""Reading a table of numbers from text, as exported by measurement software.

Separators are commas, semicolons, tabs, bars or blanks, decimal signs points or commas. Lines that
begin with ``#``, ``%``, ``//``, ``!`` or ``***`` are comments; anything before the row of names is
ignored, and a row of units below it is recognised.
"""

from __future__ import annotations

import csv
import datetime
import re
import stat
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.case import CHANNELS, Floats
from rthyb_rt.diagnose.column_units import means_none, read_unit, split_name
from rthyb_rt.errors import InputError, Problem

COMMENTS = ("#", "%", "//", "!", "***")
TIME_NAMES = (
    "t", "time", "zeit", "temps", "tiempo", "tempo", "timestamp", "time_stamp", "datetime",
    "date_time", "x_value", "elapsed", "elapsed_time", "zeitkanal", "messzeit",
)  # fmt: skip
"""Names of a time column, in lower case."""
SAMPLE = 40
"""Number of lines, in the middle and at the end each, that are examined to find the format."""
MAX_FIELDS = 4096

_LINE_END = re.compile(r"\r\n|\n|\r")
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x19\x1b-\x1f]")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?", re.ASCII)
_NO_VALUE = frozenset(
    ("", "nan", "-nan", "+nan", "inf", "-inf", "+inf", "infinity", "-infinity", "n/a", "#n/a", "na",
     "null", "none", "-", "--", "---", "1.#qnan", "-1.#ind", "1.#inf", "overload", "overflow",
     "novalue")
)  # fmt: skip
_CLOCK = re.compile(
    r"(?:(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})[T ]\s*|(\d{1,2})\.(\d{1,2})\.(\d{4})[T ]\s*"
    r"|(\d{1,2}/\d{1,2}/\d{4}) )?(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?)Z?",
    re.ASCII,
)


class Dialect(NamedTuple):
    """Format of a table: separator ("" for blanks) and decimal sign."""

    separator: str
    decimal: str


DIALECTS = (
    Dialect(",", "."), Dialect(";", "."), Dialect(";", ","), Dialect("\t", "."),
    Dialect("\t", ","), Dialect("|", "."), Dialect("|", ","), Dialect("", "."), Dialect("", ","),
    Dialect(",", ","),
)  # fmt: skip
_SWAPPED = str.maketrans(",.", ".,")
_WORDS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", "": "blanks"}


@dataclass(frozen=True)
class TableColumn:
    """A column of a table.

    Attributes:
        header: text of its header.
        name, unit: the two parts of it; ``unit`` is "" if none is stated.
        sure: whether brackets or a row of units state the unit.
        values: (n,), as written; NaN where there is no number.
        fault: the first field that is not a number, with its line, or None.
        day: for clock times, the day from which they are counted, or "midnight".
    """

    header: str
    name: str
    unit: str
    sure: bool
    values: Floats
    fault: tuple[int, str] | None = None
    day: str = ""

    @property
    def label(self) -> str:
        """Its name for use in an option; that of a channel has no unit in it."""
        own = self.header.strip()
        return (own if own in CHANNELS else self.name or self.header).replace('"', "'")


@dataclass(frozen=True)
class ColumnTable:
    """The columns of a file, the line of each row, (n,), and notes."""

    columns: list[TableColumn]
    lines: NDArray[np.int64]
    notes: list[str]

    def line(self, row: int) -> int:
        """Return the line number of a row, as in an editor."""
        return int(self.lines[row])


def read_table(path: Path) -> ColumnTable:
    """Read a table of numbers from a text file.

    Raises:
        InputError: it is not text, has no rows or no column names, or rows of unequal length.
    """
    where = str(path)
    text = _text(path)
    quick = _quickly(text)
    if quick is not None:
        return quick
    lines = _LINE_END.split(text)
    rows = [(i, line) for i, line in enumerate(lines, 1) if _is_content(line)]
    if len(rows) < 2:
        raise InputError(
            "has no rows below its header; a recording needs a row of names, and below it a row "
            "of numbers for each instant",
            where,
        )
    dialect, width, numeric = _written(rows)
    names, stated, body, notes = _head(lines, rows, dialect, width, numeric, where)
    whole = _at_once([line for _, line in body], len(names), dialect)
    if whole is None:
        parted = _parted(body, len(names), dialect, where)
        line_of = [i for i, _ in parted]
        columns = [
            _column(name, unit, [fields[j] for _, fields in parted], line_of, dialect)
            for j, (name, unit) in enumerate(zip(names, stated, strict=True))
        ]
    else:
        line_of = [i for i, _ in body]
        columns = [
            TableColumn(name, *_name_and_unit(name, unit), np.ascontiguousarray(whole[:, j]))
            for j, (name, unit) in enumerate(zip(names, stated, strict=True))
        ]
    if dialect != DIALECTS[0]:
        point = "a comma" if dialect.decimal == "," else "a point"
        notes.append(
            f"columns are separated by {_WORDS[dialect.separator]}, with {point} as decimal "
            "separator"
        )
    return ColumnTable(columns, np.array(line_of, dtype=np.int64), notes)


# ---- the file -----------------------------------------------------------------------------------


def _text(path: Path) -> str:
    where = str(path)
    try:
        mode = path.stat().st_mode
        # A pipe has an end; a device does not.
        if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode)):
            raise InputError(
                "is not a file; a recording is a CSV file, or the folder or recording.h5 of a run",
                where,
            )
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(
            "no such file; give a CSV file, or the folder or recording.h5 of a run", where
        ) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read ({reason})", where) from error
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            text = data.decode("utf-16")
        except UnicodeDecodeError as error:
            raise InputError("begins like UTF-16 text but is damaged", where) from error
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    control = _CONTROL.search(text)
    if control is not None:
        line = text.count("\n", 0, control.start()) + 1
        raise InputError(
            f"is not CSV text (byte {ord(control[0]):#04x}); give a recording as CSV, or the "
            "folder or recording.h5 of a run",
            f"{where}:{line}",
        )
    return text


def _is_content(line: str) -> bool:
    start = line.lstrip()
    return bool(start) and not start.startswith(COMMENTS)


def _quickly(text: str) -> ColumnTable | None:
    """Return a table of numbers below one plain row of names; None for any other table.

    This is ten times as fast, one second for ten minutes of four channels, with a tenth of the
    memory.
    """
    if "\r" in text:
        text = text.replace("\r\n", "\n")
    end = text.find("\n")
    names = [name.strip() for name in text[: max(end, 0)].split(",")]
    if end < 0 or '"' in text[:end] or len(names) < 2 or not _known(names):
        return None
    lines = text[end + 1 :].split("\n")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # for a file without rows, which is reported elsewhere
            body = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
    except ValueError:
        return None
    # A blank line between rows would shift the line numbers of those below it.
    if body.shape != (len(lines) - (not lines[-1].strip()), len(names)) or body.shape[0] < 2:
        return None
    columns = [
        TableColumn(name, *split_name(name), np.ascontiguousarray(body[:, j]))
        for j, name in enumerate(names)
    ]
    return ColumnTable(columns, np.arange(2, body.shape[0] + 2), [])


# ---- format -------------------------------------------------------------------------------------


def _fields(line: str, dialect: Dialect) -> list[str]:
    if dialect.separator == "":
        return line.split()[:MAX_FIELDS]
    if '"' not in line:
        return [field.strip() for field in line.split(dialect.separator)][:MAX_FIELDS]
    try:
        (found,) = csv.reader([line], delimiter=dialect.separator, skipinitialspace=True)
    except (csv.Error, ValueError):
        return [field.strip() for field in line.split(dialect.separator)][:MAX_FIELDS]
    return [field.strip() for field in found][:MAX_FIELDS]


def _pointed(field: str, dialect: Dialect) -> str:
    """Return a field with a decimal point; with decimal commas, a point is not valid."""
    return field.translate(_SWAPPED) if dialect.decimal == "," else field


def _is_number(field: str, dialect: Dialect) -> bool:
    return _NUMBER.fullmatch(_pointed(field, dialect)) is not None


def _is_cell(field: str, dialect: Dialect) -> bool:
    return (
        _is_number(field, dialect)
        or field.lower() in _NO_VALUE
        or _CLOCK.fullmatch(field) is not None
    )


def _written(rows: list[tuple[int, str]]) -> tuple[Dialect, int, list[bool]]:
    """Return format, number of columns, and which of them hold numbers: the best interpretation."""
    middle = len(rows) // 2
    sample = [line for _, line in rows[middle : middle + SAMPLE]]
    sample += [line for _, line in rows[max(middle + SAMPLE, len(rows) - SAMPLE) :]]
    best: tuple[float, Dialect, int] | None = None
    for dialect in DIALECTS:
        parted = [_fields(line, dialect) for line in sample]
        width = Counter(map(len, parted)).most_common(1)[0][0]
        score = sum(_score(fields, dialect) for fields in parted if len(fields) == width)
        if best is None or score > best[0]:
            best = (score, dialect, width)
    assert best is not None
    _, dialect, width = best
    if dialect.separator != "," and dialect.decimal == ".":
        body = "\n".join(line for _, line in rows[len(rows) // 4 :])
        if re.search(r"\d,\d", body) and not re.search(r"\d\.\d", body):
            dialect = Dialect(dialect.separator, ",")
    parted = [_fields(line, dialect) for line in sample]
    counts = [
        sum(_is_cell(fields[j], dialect) for fields in parted if len(fields) == width)
        for j in range(width)
    ]
    return dialect, width, [2 * count > len(sample) for count in counts]


def _score(fields: list[str], dialect: Dialect) -> float:
    """Return how well a line fits: numbers count for a format, words against it."""
    score = 0.0
    for field in fields:
        if _is_cell(field, dialect):
            score += 1.0 if field else 0.1
        else:
            # A word that contains a separator is two fields that were not separated.
            score -= 3.0 if re.search(r"[;\t,|]|\d\s+\d", field) else 0.5
    return score


# ---- column names -------------------------------------------------------------------------------


def plain(name: str) -> str:
    """Return a name in lower case with single underscores instead of spaces."""
    return re.sub(r"[\s_\-.]+", "_", name.strip().lower()).strip("_")


def _known(names: list[str]) -> int:
    """Return the number of names that belong to channels or time."""
    return sum(
        name in CHANNELS or plain(split_name(name)[0]) in (*CHANNELS, *TIME_NAMES) for name in names
    )


def _head(
    lines: list[str], rows: list[tuple[int, str]], dialect: Dialect, width: int,
    numeric: list[bool], where: str,
) -> tuple[list[str], list[str], list[tuple[int, str]], list[str]]:  # fmt: skip
    """Return names, units, the rows below, and notes."""
    first = _first_row(rows, dialect, width, numeric)
    above = [(k, _names(line, dialect, width)) for k, (_, line) in enumerate(rows[:first])]
    named = [(k, names) for k, names in above if names is not None]
    if not named:
        names = _commented(
            lines[: rows[first][0] - 1] if first < len(rows) else lines, dialect, width
        )
        if names is None:
            raise _no_names(rows, dialect, width, where)
        return names, [""] * len(names), rows[first:], ["the column names were found in a comment"]
    at, names = max(named, key=lambda item: (_known(item[1]), item[0]))
    if not _known(names):
        # No name is recognised: use the lowest row that does not contain units.
        at, names = next(((k, n) for k, n in reversed(named) if not _is_units(n)), named[-1])
    # Below names of the interchange format every line is a row, or an error.
    first = at + 1 if _known(names) > 1 else first
    notes, stated = [], [""] * len(names)
    if any(line.strip() for line in lines[: rows[at][0] - 1]):
        notes.append(
            f"the column names were found in line {rows[at][0]}; the lines above it are ignored"
        )
    for k in range(at + 1, min(max(first, at + 2), len(rows))):
        found = _fields(rows[k][1], dialect)
        if _is_units(found) and len(found) <= len(names):
            stated = [*found, *[""] * (len(names) - len(found))]
            first = max(first, k + 1)
        elif k < first:
            notes.append(f"line {rows[k][0]}, between names and numbers, is ignored")
    return names, stated, rows[first:], notes


def _first_row(
    rows: list[tuple[int, str]], dialect: Dialect, width: int, numeric: list[bool]
) -> int:
    for k, (_, line) in enumerate(rows):
        fields = _fields(line, dialect)
        if (
            len(fields) == width
            and any(_is_number(field, dialect) for field in fields)
            and all(
                _is_cell(f, dialect)
                for f, of_numbers in zip(fields, numeric, strict=True)
                if of_numbers
            )
        ):
            return k
    return len(rows)


def _names(line: str, dialect: Dialect, width: int) -> list[str] | None:
    """Return the names in a line, one for each column, or None."""
    for found in (
        _fields(line, dialect),
        [part.strip() for part in re.split(r"\s{2,}|\t", line.strip())],
        re.findall(r"\S+(?: ?[\[(][^\])]*[\])])?", line),
        *(_fields(line, other) for other in DIALECTS[::2]),
    ):
        if len(found) == 2 * width and all(read_unit(unit) for unit in found[1::2]):
            found = [f"{a}, {b}" for a, b in zip(found[::2], found[1::2], strict=True)]
        while len(found) > width and found[-1].lower() in ("", "comment"):
            found.pop()
        short = width - len(found)
        if short == 1 and len(found) > 1 and dialect.separator:
            found = [*found, ""]  # rows end in a separator
        if len(found) == width and sum(_is_cell(f, dialect) for f in found) <= width // 2:
            return found
    fields = _fields(line, dialect)
    return fields if _known(fields) > 1 else None


def _is_units(fields: list[str]) -> bool:
    """Return whether a row holds units: half of its fields are known, the others are short."""
    said = [field for field in fields if not means_none(field)]
    known = sum(read_unit(field) is not None for field in said)
    short = all(len(f) <= 10 and " " not in f.strip("[]() ") for f in said)
    return 0 < known >= len(said) / 2 and short and _known(fields) < 2


def _commented(above: list[str], dialect: Dialect, width: int) -> list[str] | None:
    """Return names in the last comment above the rows, as written by numpy."""
    for line in reversed([line.strip() for line in above if line.strip()][-5:]):
        if line.startswith(COMMENTS):
            names = _names(line.lstrip("#%/!* \t"), dialect, width)
            if names is not None:
                return names
    return None


def _no_names(rows: list[tuple[int, str]], dialect: Dialect, width: int, where: str) -> InputError:
    line, text = rows[0]
    fields = _fields(text, dialect)
    shown = text.strip()[:60]
    hint = (
        "the first line must name the columns: t and " + ", ".join(CHANNELS)
        if all(_is_cell(f, dialect) for f in fields)
        else f"the rows have {width} fields, and no line above them has as many names"
    )
    if width == 2 * len(re.split(r"[,;\t]", text)) and dialect == DIALECTS[0]:
        hint += (
            "; the numbers seem to have decimal commas in a file whose columns are separated by "
            "commas: export it with semicolons or with decimal points"
        )
    return InputError(f"has no column names; found {shown!r}; {hint}", f"{where}:{line}")


# ---- rows ---------------------------------------------------------------------------------------


def _at_once(lines: list[str], width: int, dialect: Dialect) -> Floats | None:
    """Return rows of numbers only, (rows, width); None for other rows, which are split."""
    if not lines:
        return None
    if dialect.decimal == ",":
        if dialect.separator == "," or any("." in line for line in lines):
            return None
        lines = [line.replace(",", ".") for line in lines]
    try:
        body = np.loadtxt(lines, delimiter=dialect.separator or None, comments=None, ndmin=2)
    except ValueError:
        return None
    return body if body.shape == (len(lines), width) and body.size else None


def _parted(
    body: list[tuple[int, str]], width: int, dialect: Dialect, where: str
) -> list[tuple[int, list[str]]]:
    """Return the fields of each row with its line."""
    out: list[tuple[int, list[str]]] = []
    problems: list[Problem] = []
    for i, line in body:
        fields = _fields(line, dialect)
        while len(fields) > width and fields[-1] == "":
            fields.pop()
        if len(fields) != width:
            hint = ""
            if dialect == DIALECTS[0] and len(fields) == 2 * width:
                hint = (
                    "; decimal commas cannot be distinguished from the commas between columns: "
                    "export with semicolons or with decimal points"
                )
            problems.append(
                Problem(
                    f"{where}:{i}", f"has {len(fields)} fields, but the header has {width}{hint}"
                )
            )
            if len(problems) == 5:
                break
        out.append((i, fields))
    if problems:
        raise InputError(problems)
    if not out:
        raise InputError("has no rows below its header", where)
    return out


def _name_and_unit(header: str, unit: str) -> tuple[str, str, bool]:
    """Return name, unit, and whether the unit is certain; ``unit`` is from a row of units."""
    name, own, sure = split_name(header)
    if unit and not means_none(unit):
        # With a row of units, the whole header is the name, except for a repeated unit.
        return (name if sure else header), unit.strip("[](){} "), True
    return name, own, sure


def _column(
    header: str, unit: str, fields: list[str], lines: list[int], dialect: Dialect
) -> TableColumn:
    name, own, sure = _name_and_unit(header, unit)
    values = np.full(len(fields), np.nan)
    for i, field in enumerate(fields):
        text = _pointed(field, dialect)
        if _NUMBER.fullmatch(text):
            values[i] = float(text.replace("D", "e").replace("d", "e"))
        elif field.lower() not in _NO_VALUE:
            clock = _clock(fields)
            if clock is not None:
                return TableColumn(header, name, "s", True, *clock)
            return TableColumn(header, name, own, sure, values, (lines[i], field))
    return TableColumn(header, name, own, sure, values)


def _clock(fields: list[str]) -> tuple[Floats, None, str] | None:
    """Return seconds since midnight before the first of a column of clock times, else None."""
    values = np.full(len(fields), np.nan)
    first: tuple[int, str] | None = None
    for i, field in enumerate(fields):
        match = _CLOCK.fullmatch(field)
        if match is None:
            if field.lower() in _NO_VALUE:
                continue
            return None
        y, m, d, d2, m2, y2, slashed, hour, minute, second = match.groups()
        try:
            date = datetime.date(int(y or y2), int(m or m2), int(d or d2)) if y or y2 else None
        except ValueError:
            return None
        # In 3/4/2026 the month is ambiguous, so the date must not change.
        day = (date.toordinal() if date else 0, str(date or slashed or "midnight"))
        first = first or day
        if not date and day != first:
            return None
        at = 60.0 * (60.0 * int(hour) + int(minute)) + float(second.replace(",", "."))
        values[i] = 86400.0 * (day[0] - first[0]) + at
    return values, None, first[1] if first else "midnight"
