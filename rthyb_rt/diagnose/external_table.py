"""An external table as channels in SI: columns selected, units converted, time in seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import channel_sizes
from rthyb_rt.diagnose.case import CHANNELS, Floats, Model
from rthyb_rt.diagnose.column_units import SI, USUAL, in_si, read_unit
from rthyb_rt.diagnose.mapping import EXAMPLE, UNASSIGNED, Source, Wish, missing, proposals, sources
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.table import TIME_NAMES, ColumnTable, TableColumn, plain, read_table
from rthyb_rt.errors import InputError, Problem

DAY_S = 86400.0
STAMP_S = 1e8
"""Time from which on it must be a calendar time: no laboratory clock runs for three years."""
HUGE = 1e30
"""A value beyond any reading in any unit; squares of larger ones overflow."""
_TIME_UNITS = ("s", "ms", "us", "ns")


@dataclass(frozen=True)
class Lab:
    """A recording from an external table.

    Attributes:
        t: time of each row, (n,), s.
        channels: each (n,), SI.
        notes: how the file was interpreted, in words.
        lines: line of each row in the file, (n,).
        labels: header of the column of each channel, without its unit.
        stated: unit of each channel whose unit the file or the user states.
        table, sources: the columns, and which of them are channels.
        further: numeric columns that are not channels, as written, by their header.
    """

    t: Floats
    channels: dict[str, Floats]
    notes: list[str]
    lines: NDArray[np.int64]
    labels: dict[str, str]
    stated: dict[str, str]
    table: ColumnTable
    sources: dict[str, Source]
    further: dict[str, Floats] = field(default_factory=dict)


def read_lab(path: Path, model: Model, wishes: Sequence[Wish], needed: bool) -> Lab:
    """Read a table as exported by laboratory software.

    Args:
        path: the file.
        model: provides the sampling rate, and the sizes from which an unstated unit is inferred.
        wishes: the user's assignments of columns.
        needed: whether each assigned column must exist.

    Raises:
        InputError: with line and column, what is allowed there and what to do.
    """
    where = str(path)
    table = read_table(path)
    found, notes = sources(table, list(wishes), where, needed)
    for channel, source in found.items():
        _refuse_words(table.columns[source.column], channel, where)
    labels = {k: table.columns[s.column].label for k, s in found.items()}
    notes = table.notes + notes
    t = _time(table, found.get("t"), labels, model, where, notes)
    channels = _channels(table, found, labels, model, where, notes)
    for channel, source in found.items():
        if source.unit is not None and not source.presumed and source.unit.factor != 1:
            notes.append(f"{channel}: {labels[channel]!r} converted from {source.unit.text}")
    stated = {k: s.unit.text for k, s in found.items() if s.unit is not None and not s.presumed}
    further = _further(table, found, labels)
    return Lab(t, channels, notes, table.lines, labels, stated, table, found, further)


def stated(
    path: Path,
    wishes: Sequence[Wish],
    channels: Sequence[str],
    needed: Sequence[str],
    missed: dict[str, Problem],
) -> tuple[Floats, dict[str, Floats], list[str]]:
    """Read a table whose units are all stated, as there is no model to infer them from.

    Args:
        path: the file.
        wishes: the user's assignments of columns.
        channels: channels to read, including ``t``.
        needed: those that the table must contain.
        missed: receives the channels whose assigned column the table does not have, each with the
            error; a channel with a column of its name is then read from that.

    Returns:
        Time of each row, (n,), s; the channels by name, each (n,), SI; notes on how the file was
        interpreted.

    Raises:
        InputError: with what is missing, and how to state it.
    """
    where = str(path)
    table = read_table(path)
    found, notes = sources(table, list(wishes), where, needed=False)
    missed |= {wish.channel: error for wish in wishes if (error := missing(table, wish, where))}
    found = {name: source for name, source in found.items() if name in channels}
    labels = {name: table.columns[source.column].label for name, source in found.items()}
    notes = table.notes + [note for note in notes if not note.startswith(UNASSIGNED)]
    problems = []
    for name in channels:
        if name not in found and name in needed:
            proposal = " ".join(proposals(table, found, (name,))) or EXAMPLE
            problems.append(f"has no column for {name}; assign one, for example: {proposal}")
    columns = {name: table.columns[source.column] for name, source in found.items()}
    unsaid = [n for n, source in found.items() if source.unit is None and not columns[n].day]
    if unsaid:
        problems.append(_unknown_units(table, found, labels, unsaid))
    if problems:
        raise InputError("; ".join(problems), where)
    out: dict[str, Floats] = {}
    for name, source in found.items():
        _refuse_words(columns[name], name, where)
        values = np.where(np.abs(columns[name].values) < HUGE, columns[name].values, np.nan)
        factor = source.unit.factor if source.unit is not None else Fraction(1)
        out[name] = in_si(values * source.sign, factor)
        if source.unit is not None and factor != 1:
            notes.append(f"{name}: {labels[name]!r} converted from {source.unit.text}")
    return out.pop("t"), out, notes


def _further(
    table: ColumnTable, found: dict[str, Source], labels: dict[str, str]
) -> dict[str, Floats]:
    """Return the numeric columns that are neither a channel nor time."""
    used = {source.column for source in found.values()}
    out = {}
    for j, column in enumerate(table.columns):
        time = plain(column.name) in TIME_NAMES or column.label == labels.get("t") or column.day
        if j in used or time or not column.header or column.fault is not None:
            continue
        values = np.where(np.abs(column.values) < HUGE, column.values, np.nan)
        if np.isfinite(values).any() and not _counts(values):
            out[column.header] = values
    return out


def _counts(values: Floats) -> bool:
    """Return whether a column counts its rows."""
    steps = np.diff(values)
    return bool(steps.size) and bool(np.all(steps == steps[0])) and steps[0] != 0.0


def time_unit(ratio: float) -> str | None:
    """Return the unit of a time whose rows are ``ratio`` sampling periods apart; None for none."""
    for unit in _TIME_UNITS:
        found = read_unit(unit)
        assert found is not None
        if abs(ratio * float(found.factor) - 1.0) < POLICY.rate_off:
            return unit
    return None


def _refuse_words(column: TableColumn, channel: str, where: str) -> None:
    if column.fault is None:
        return
    line, text = column.fault
    hint = ""
    if any(c.isdigit() for c in text):
        hint = "; write numbers as 1234.5 or 1.2345e3, without thousands separators"
        if channel == "t":
            hint += ", and times of day as 2026-01-31 12:00:00.125"
    raise InputError(
        f"column {column.header}: {text[:40]!r} is not a number{hint}; if there is no reading, "
        "leave the field empty or write nan",
        f"{where}:{line}",
    )


# ---- time ---------------------------------------------------------------------------------------


def _time(
    table: ColumnTable, source: Source | None, labels: dict[str, str], model: Model, where: str,
    notes: list[str],
) -> Floats:  # fmt: skip
    """Return the time of each row, (n,), s."""
    n = table.lines.size
    source = source or _counting(table, labels, model, notes)
    if source is None:
        notes.append(
            f"no time column: rows are assumed to be 1/{model.fs_hz:g} s apart, the fs_hz of the "
            "model"
        )
        return np.arange(n) / model.fs_hz
    column = table.columns[source.column]
    if source.sign < 0:
        raise InputError("time cannot be inverted; omit the minus sign", "--map t")
    if column.day:
        notes.append(f"times of day are converted to seconds since {_midnight(column.day)}")
        return column.values
    unit = source.unit
    if unit is None:
        steps = np.diff(column.values[np.isfinite(column.values)])
        text = time_unit(float(np.median(steps)) * model.fs_hz) if steps.size else None
        if text is None:
            raise InputError(
                f"column {column.header!r}: its unit is not stated, and its rows are 1/"
                f"{model.fs_hz:g} s apart (fs_hz of the model) in none of "
                f"{', '.join(_TIME_UNITS)}; state the unit, as in "
                f'--map t="{labels["t"]} [ms]", or correct fs_hz',
                where,
            )
        notes.append(
            f"time: the unit of {column.header!r} is not stated; assumed to be {text}, which "
            "agrees with fs_hz"
        )
        unit = read_unit(text)
    t = in_si(column.values, unit.factor if unit is not None else Fraction(1))
    first = t[np.isfinite(t)][:1]
    if first.size and first[0] >= STAMP_S:
        day = float(DAY_S * np.floor(first[0] / DAY_S))
        notes.append(f"time is a calendar time; it is counted from {day:.0f} s, a midnight")
        return t - day
    return t


def _midnight(day: str) -> str:
    return "midnight" if day == "midnight" else f"midnight of {day}"


def _counting(
    table: ColumnTable, labels: dict[str, str], model: Model, notes: list[str]
) -> Source | None:
    """Return a column that increases at the model's sampling rate, although its name is unknown.

    If it were ignored, gaps in time would not be detected.
    """
    known = {*CHANNELS}
    for j, column in enumerate(table.columns):
        if column.header in known or column.fault is not None:
            continue
        steps = np.diff(column.values)
        if steps.size < 2 or not np.isfinite(steps).all() or not np.all(steps > 0.0):
            continue
        unit = time_unit(float(np.median(steps)) * model.fs_hz)
        if unit is not None and _even(steps):
            labels["t"] = column.label
            notes.append(
                f"column {column.header!r} increases at the rate fs_hz, so it is read as t, in "
                f"{unit}"
            )
            return Source(j, read_unit(unit))
    return None


def _even(steps: Floats) -> bool:
    off = np.abs(steps / np.median(steps) - 1.0)
    return bool(np.mean(off < POLICY.time_even) > POLICY.time_rows)


# ---- channels -----------------------------------------------------------------------------------


def _channels(
    table: ColumnTable, found: dict[str, Source], labels: dict[str, str], model: Model, where: str,
    notes: list[str],
) -> dict[str, Floats]:  # fmt: skip
    """Return the channels in SI; a column without a unit is compared with those that have one."""
    known: dict[str, Floats] = {}
    open_: dict[str, Floats] = {}
    for channel, source in found.items():
        if channel == "t":
            continue
        values = table.columns[source.column].values
        # An infinite or implausible reading is treated as missing.
        values = np.where(np.abs(values) < HUGE, values, np.nan) * source.sign
        if source.unit is None:
            open_[channel] = values
        else:
            known[channel] = in_si(values, source.unit.factor)
    while open_:
        guessed = None
        for channel, values in open_.items():
            guessed = channel_sizes.guess(channel, values, known, model)
            if guessed is not None:
                break
        if guessed is None:
            raise InputError(_unknown_units(table, found, labels, list(open_)), where)
        text, relation = guessed
        unit = read_unit(text)
        assert unit is not None
        known[channel] = in_si(open_.pop(channel), unit.factor)
        notes.append(
            f"{channel}: the unit of {labels[channel]!r} is not stated; assumed to be {text}, "
            f"which makes it {abs(relation.ratio) * float(unit.factor):.3g} times as large as "
            f"{_basis(relation)} predicts: check it"
        )
    return {channel: known[channel] for channel in found if channel in known}


def _basis(relation: channel_sizes.Relation) -> str:
    others = [name for name in relation.of if name != relation.channel]
    return f"the model with {' and '.join(others)}" if others else "the model"


def _unknown_units(
    table: ColumnTable, found: dict[str, Source], labels: dict[str, str], names: list[str]
) -> str:
    parts = []
    for channel in names:
        column = table.columns[found[channel].column]
        none = f"an unknown unit ({column.unit})" if column.sure else "no unit"
        usual = ", ".join(USUAL[SI[channel]])
        parts.append(
            f"column {column.header!r} ({channel}) states {none}, and it cannot be inferred with "
            f'certainty; state it ({usual}): --map {channel}="{labels[channel]} '
            f'[{USUAL[SI[channel]][0]}]"'
        )
    return "; ".join(parts)
