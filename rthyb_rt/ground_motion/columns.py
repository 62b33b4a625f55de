"""Two-column text and CSV: time and acceleration.

Lines that begin with ``#``, ``%``, ``!``, ``//``, ``*`` or ``"`` are comments; lines before the
first row of numbers are headers. Columns are separated by commas, semicolons, tabs or blanks.
The unit is stated in a header (``acc_g``, ``acc (m/s2)``, ``units: cm/s2``) or is an argument.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from rthyb_rt.errors import Problem
from rthyb_rt.ground_motion.acceleration import FloatArray
from rthyb_rt.ground_motion.acceleration_units import canonical_unit, find_unit
from rthyb_rt.ground_motion.channels import Samples
from rthyb_rt.ground_motion.text import (
    MAX_POINTS,
    TextLines,
    clean,
    header_text,
    limited,
    not_a_number,
    parse_float,
    time_step,
)

_COMMENT = ("#", "%", "!", "//", "*", '"', "'")
_DECIMAL_COMMA = re.compile(r"(?<![\d.,])[+-]?\d+,\d+(?:[eE][+-]?\d+)?(?![\d.,])", re.ASCII)
_MILLISECONDS = re.compile(r"\b(?:time|t)[_ ]{0,3}[(\[]? ?(?:ms|millisec[a-z]*)\b", re.IGNORECASE)
_MAX_HEADER_LINES = 200


@dataclass(frozen=True)
class _Table:
    """Rows of numbers and the headers before them."""

    headers: list[str]
    rows: list[int]
    separator: str | None
    values: FloatArray


def read_columns(text: TextLines, units: str | None, channel: int | str | None) -> Samples:
    """Read time and acceleration from columns.

    Args:
        text: the file.
        units: canonical unit of acceleration; None: it must be stated in a header.
        channel: name or number (from 1) of the acceleration column in a file with more than two.

    Raises:
        InputError: there are no numbers, a wrong number of columns (with row), a value that is not
            a finite number (with row), a decimal comma, uneven or decreasing time (with row), or no
            unit.
    """
    table = _read_table(text)
    names = _column_names(table)
    time_column, column = _choose_columns(text, table, names, channel)
    if table.values.shape[0] < 2:
        raise text.error("has one row; a record needs at least two", table.rows[0])
    header_unit = None
    if names:
        header_unit = _unit_of_name(names[column])
    for line in reversed(table.headers):
        header_unit = header_unit or find_unit(line)
    unit = header_unit or units
    if unit is None:
        raise text.error(
            "does not state the unit of acceleration; write it in the header (time_s,acc_g) or "
            "give `units` (g, m/s2, cm/s2, gal, ...)"
        )
    in_milliseconds = any(_MILLISECONDS.search(line) for line in table.headers)
    times = table.values[:, time_column] * (1e-3 if in_milliseconds else 1.0)
    dt_s, start_s = time_step(
        times, text, table.rows, "resample the record to equal intervals, or restore the lost rows"
    )
    details = {"first_time_s": f"{start_s:.9g}"}
    if table.headers:
        details["header"] = header_text(table.headers[:6])
    return Samples(
        dt_s,
        table.values[:, column].copy(),
        unit,
        "header" if header_unit else "argument",
        details,
    )


def _read_table(text: TextLines) -> _Table:
    """Find headers, separator and rows, and read the rows."""
    headers: list[str] = []
    rows: list[int] = []
    for index, line in enumerate(text.lines):
        stripped = line[:1000].strip()
        if not stripped:
            continue
        if stripped.startswith(_COMMENT):
            if len(headers) < _MAX_HEADER_LINES:
                headers.append(stripped[:300].lstrip("#%!/*\"' "))
        elif rows or _is_row(stripped):
            rows.append(index)
        elif len(headers) < _MAX_HEADER_LINES:
            headers.append(stripped[:300])
        else:
            break
    if not rows:
        raise text.error(
            "the format is not recognised: it is neither PEER AT2, COSMOS, CSMIP or K-NET, nor "
            "columns of numbers; check that this is the right file, and that its numbers have a "
            "decimal point"
        )
    if len(rows) > MAX_POINTS:
        raise text.error(f"holds {len(rows)} rows; at most {MAX_POINTS} are accepted")
    separator = _separator(text, rows)
    return _Table(headers, rows, separator, _read_rows(text, rows, separator))


def _is_row(line: str) -> bool:
    """Return whether a line is data: its first field is, or represents, a number."""
    fields = [f for f in re.split(r"[,;\s]+", line) if f]
    return bool(fields) and (
        parse_float(fields[0]) is not None
        or (len(fields) > 1 and fields[0].lower() in ("nan", "inf", "-inf", "+inf"))
    )


def _separator(text: TextLines, rows: list[int]) -> str | None:
    """Return the separator of the first rows (None: blanks); reject a decimal comma."""
    sample = [text.lines[i][:1000] for i in rows[:50]]
    for index, line in zip(rows, sample, strict=False):
        by_other = re.split(r"[;\s]+", line.strip())
        if len(by_other) > 1 and any(_DECIMAL_COMMA.fullmatch(f) for f in by_other):
            raise text.error(
                f"{clean(line, 60)!r} has decimal commas; use decimal points (0.02 instead of"
                " 0,02)",
                index,
            )
    for separator in (";", ",", "\t"):
        if separator in sample[0].strip():
            return separator
    return None


def _read_rows(text: TextLines, rows: list[int], separator: str | None) -> FloatArray:
    """Read the rows as an array of shape (rows, columns)."""
    lines = [text.lines[i] for i in rows]
    if all(map(str.isascii, lines)) and max(map(len, lines)) < 10_000:
        try:
            values = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
            if bool(np.isfinite(values).all()):
                return values
        except ValueError:
            pass  # the rows are read again below, to locate the errors
    return _read_rows_one_by_one(text, rows, separator)


def _read_rows_one_by_one(text: TextLines, rows: list[int], separator: str | None) -> FloatArray:
    """Read rows with the place of every error."""
    problems: list[Problem] = []
    table: list[list[float]] = []
    width = 0
    for index in rows:
        line = text.lines[index]
        if len(line) > 10_000:
            raise text.error("the line is too long for a row of a table", index)
        fields = [f.strip() for f in line.strip().split(separator)]
        if len(fields) > 1 and fields[-1] == "":
            fields.pop()  # a separator at the end of the row
        width = width or len(fields)
        values = [parse_float(field) for field in fields]
        if len(fields) != width:
            problems.append(
                Problem(
                    text.at(index),
                    f"the row has {len(fields)} columns, the first row has {width}; every row"
                    " needs time and acceleration",
                )
            )
        for field, value in zip(fields, values, strict=True):
            if value is None or not math.isfinite(value):
                problems.append(Problem(text.at(index), not_a_number(field)))
                break
        table.append([v for v in values if v is not None])
        if len(problems) > 1000:
            break
    if problems:
        raise limited(problems, text.path)
    return np.array(table, dtype=np.float64).reshape(len(rows), width)


def _column_names(table: _Table) -> list[str]:
    """Return the names of the columns if the last header has one for each, else an empty list."""
    width = table.values.shape[1]
    for line in reversed(table.headers[-3:]):
        body = re.sub(r"^columns? *:", "", line, flags=re.IGNORECASE).strip()
        names = [name.strip() for name in body.split(table.separator)]
        if len(names) == width and sum(name.lower().startswith("t") for name in names) == 1:
            return names
    return []


def _unit_of_name(name: str) -> str | None:
    """Return the unit in a column's name: ``acc_ew (gal)``, ``acc_ns_g``, ``acc g``."""
    bracket = re.search(r"[(\[]([^()\[\]]{1,20})[)\]] *$", name)
    if bracket:
        return canonical_unit(bracket.group(1))
    ending = canonical_unit(name.rpartition("_")[2]) if "_" in name else None
    return ending or find_unit(name)


def _choose_columns(
    text: TextLines, table: _Table, names: list[str], channel: int | str | None
) -> tuple[int, int]:
    """Return the columns of time and acceleration, from 0."""
    width = table.values.shape[1]
    first = table.rows[0]
    if width < 2:
        raise text.error(
            "the row has 1 column; two are needed: time and acceleration (for values alone, add"
            " the times or use a PEER AT2 header)",
            first,
        )
    time_column = next((i for i, n in enumerate(names) if n.lower().startswith("t")), 0)
    others = [i for i in range(width) if i != time_column]
    listed = ", ".join(f"{i + 1} {clean(names[i], 30)}" if names else str(i + 1) for i in others)
    if channel is None:
        if len(others) == 1:
            return time_column, others[0]
        raise text.error(
            f"the row has {width} columns, but two are expected, time and acceleration; or choose "
            f"the column of acceleration with `channel` ({clean(listed)})",
            first,
        )
    wanted = clean(str(channel), 40)
    fitting = [
        i
        for i in others
        if wanted == str(i + 1)
        or (names and not wanted.isdecimal() and wanted and wanted.lower() in names[i].lower())
    ]
    if len(fitting) != 1:
        raise text.error(
            f"{len(fitting)} columns fit channel {wanted!r}; the columns besides time are"
            f" {clean(listed)}",
            first,
        )
    return time_column, fitting[0]
