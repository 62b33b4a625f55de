"""Assignment of a table's columns to channels, with their units and signs."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rthyb_rt.diagnose.case import CHANNELS
from rthyb_rt.diagnose.column_units import SI, USUAL, Stated, is_electric, read_unit, split_name
from rthyb_rt.diagnose.table import TIME_NAMES, ColumnTable, TableColumn, plain
from rthyb_rt.errors import InputError, Problem

EXAMPLE = '--map x_meas="LVDT 1 [mm]"'
UNASSIGNED = "columns not assigned to a channel"
"""Beginning of the note on such columns, which is only relevant to a diagnosis."""


@dataclass(frozen=True)
class Wish:
    """A column that the user assigned to a channel.

    Attributes:
        channel: a channel, or ``t``.
        text: the column's name, optionally with a leading sign and a unit in brackets.
        unit, sign: if given separately; otherwise "" and 0.
        where: the option or line with the assignment.
    """

    channel: str
    text: str
    where: str
    unit: str = ""
    sign: int = 0


@dataclass(frozen=True)
class Source:
    """A column that is a channel.

    Attributes:
        column: its index in the table, from 0.
        unit: None if not stated anywhere.
        sign: 1 or -1.
        presumed: the unit is that of the interchange format, because of the column's name alone.
    """

    column: int
    unit: Stated | None
    sign: int = 1
    presumed: bool = False


# ---- assignments by the user --------------------------------------------------------------------


def read_wishes(options: Iterable[str]) -> list[Wish]:
    """Read the values of ``--map``: ``CHANNEL=COLUMN``, or the path of a mapping file.

    Raises:
        InputError: with all errors.
    """
    wishes: dict[str, Wish] = {}
    problems: list[Problem] = []
    for option in options:
        channel, equals, text = option.partition("=")
        if not equals or Path(option).is_file():
            found = _of_file(option)
            wishes |= {wish.channel: wish for wish in found}
            continue
        channel, text = channel.strip(), text.strip()
        if channel not in SI:
            near = difflib.get_close_matches(channel, SI, 1, 0.5)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            problems.append(
                Problem(
                    f"--map {option}",
                    f"found channel {channel!r}{hint}; must be one of {', '.join(SI)}, as in "
                    f"{EXAMPLE}",
                )
            )
        elif not text.lstrip("+-").strip():
            problems.append(
                Problem(f"--map {option}", f"names no column; write it as in {EXAMPLE}")
            )
        else:
            wishes[channel] = Wish(channel, text, f"--map {channel}")
    if problems:
        raise InputError(problems)
    return list(wishes.values())


def _of_file(name: str) -> list[Wish]:
    from rthyb_rt import config
    from rthyb_rt.config.lines import KeyLines

    if not name.endswith(".toml") and not Path(name).is_file():
        raise InputError(
            f"found {name!r}; must be CHANNEL=COLUMN, as in {EXAMPLE}, or the path of a mapping "
            'file (schema = "rthyb-map/1")',
            "--map",
        )
    text = config.read_text(name, "mapping")
    file = config.parse_map(text, name)
    lines = KeyLines(text)
    return [
        Wish(
            channel, column.column,
            f"{name}:{lines.find(('channels', channel))}: channels.{channel}",
            column.unit or "", column.sign or 0,
        )
        for channel in SI
        if (column := getattr(file.channels, channel)) is not None
    ]  # fmt: skip


# ---- columns of the table -----------------------------------------------------------------------


def sources(
    table: ColumnTable, wishes: list[Wish], where: str, needed: bool
) -> tuple[dict[str, Source], list[str]]:
    """Return the column of each channel of a table, and notes.

    Args:
        table: the columns.
        wishes: the user's assignments, which take precedence over the names.
        where: the file, for messages.
        needed: whether an assigned column must exist; a second file may omit outputs.

    Raises:
        InputError: an assigned column does not exist, two columns are one channel, or a unit is
            not suitable for its channel.
    """
    found: dict[str, Source] = {}
    notes: list[str] = []
    problems: list[Problem] = []
    for wish in wishes:
        try:
            source = _wished(table, wish, where)
        except InputError as error:
            problems += error.problems
            continue
        if source is not None:
            found[wish.channel] = source
        elif needed:
            problems.append(_missing(table, wish, where))
    taken = {source.column for source in found.values()}
    for channel in SI:
        if channel in found:
            continue
        try:
            j = _by_name(table, channel, taken, where)
            if j is not None:
                found[channel] = _named(table.columns[j], j, channel, where)
                if plain(table.columns[j].name) != channel and table.columns[j].header != channel:
                    notes.append(f"column {table.columns[j].header!r} is read as {channel}")
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    return found, notes + _unused(table, found)


def _unused(table: ColumnTable, found: dict[str, Source]) -> list[str]:
    used = {source.column for source in found.values()}
    strange = [c.header for j, c in enumerate(table.columns) if j not in used and c.header]
    if not strange:
        return []
    return [
        f"{UNASSIGNED}: {', '.join(strange)}; those with numbers are tried as quantities that "
        f"modulate an effect (channels: {', '.join(CHANNELS)})"
    ]


def _matches(table: ColumnTable, name: str, exactly: bool) -> list[int]:
    """Return the columns with a name: exact, or else ignoring case and spacing."""
    columns = table.columns
    if re.fullmatch(r"#\d{1,4}", name) and 1 <= int(name[1:]) <= len(columns):
        return [int(name[1:]) - 1]
    tests = (
        lambda c: c.header == name,
        lambda c: c.name == name,
        lambda c: plain(c.header) == plain(name) != "",
        lambda c: plain(c.name) == plain(name) != "",
    )
    for same in tests[:2] if exactly else tests:
        found = [j for j, column in enumerate(columns) if same(column)]
        if found:
            return found
    return []


def _wished(table: ColumnTable, wish: Wish, where: str) -> Source | None:
    """Return the column that the user assigned; None if the table does not have it."""
    text = wish.text.strip()
    for sign, rest in ((1, text), (-1 if text[0] == "-" else 1, text[1:].strip())):
        if sign == 1 and rest != text and text[0] != "+":
            continue
        name, unit, bracketed = split_name(rest)
        for wanted, stated in ((rest, ""), (name, unit)):
            if wanted != rest and not bracketed and wish.unit == "" and read_unit(unit) is None:
                continue
            # A leading minus may be part of the name, but only for an exact match.
            match = _matches(table, wanted, exactly=rest == text and text[0] in "+-")
            if len(match) > 1:
                listed = ", ".join(f"#{j + 1}" for j in match)
                raise InputError(
                    f"{where} has {len(match)} columns named {wanted!r}: {listed}; choose one by "
                    f'its number, as in --map {wish.channel}="#{match[0] + 1} '
                    f'[{SI[wish.channel]}]"',
                    wish.where,
                )
            if match:
                return _stated(table.columns[match[0]], match[0], wish, stated, wish.sign or sign)
    return None


def _stated(column: TableColumn, j: int, wish: Wish, unit: str, sign: int) -> Source:
    """Return an assigned column with the unit of the assignment, or else of the file."""
    unit = wish.unit or unit
    if not unit:
        source = _named(column, j, wish.channel, wish.where)
        return Source(j, source.unit, sign, source.presumed)
    return Source(j, _fitting(unit, wish.channel, column, wish.where), sign)


def _fitting(text: str, channel: str, column: TableColumn, where: str) -> Stated:
    """Return a unit that suits a channel.

    Raises:
        InputError: it is unknown, or measures something else.
    """
    unit = read_unit(text)
    if unit is not None and unit.si == SI[channel]:
        return unit
    known = ", ".join(USUAL[SI[channel]])
    if is_electric(text):
        said = "is the unit of a sensor's electrical signal; give the calibrated quantity"
    elif unit is None:
        said = "is not known"
    else:
        said = f"is not a unit for {channel}, which is in {SI[channel]}"
    raise InputError(
        f"column {column.header!r}: the unit {text!r} {said}; allowed are {known} and similar "
        f'units, as in --map {channel}="{column.label} [{USUAL[SI[channel]][-1]}]"',
        where,
    )


def _named(column: TableColumn, j: int, channel: str, where: str) -> Source:
    """Return a column with the unit that its header states, if any."""
    own = Stated(SI[channel], read_unit(SI[channel]).factor, SI[channel])  # type: ignore[union-attr]
    if column.header == channel and not column.sure:
        return Source(j, own, presumed=True)
    if column.sure and (read_unit(column.unit) is not None or is_electric(column.unit)):
        return Source(j, _fitting(column.unit, channel, column, where))
    unit = read_unit(column.unit)
    if unit is not None and unit.si == SI[channel]:
        return Source(j, unit)
    # A word in brackets, or a last word, that is not a suitable unit is part of the name.
    return Source(j, None)


def _by_name(table: ColumnTable, channel: str, taken: set[int], where: str) -> int | None:
    """Return the column with a channel's name, or None."""
    free = [(j, c) for j, c in enumerate(table.columns) if j not in taken]
    names = (channel,) if channel != "t" else TIME_NAMES
    found = [j for j, c in free if c.header == channel]
    found = found or [j for j, c in free if plain(c.header) == channel]
    found = found or [j for j, c in free if plain(c.name) == channel]
    found = found or [j for j, c in free if plain(c.name) in names or plain(c.header) in names]
    if len(found) > 1:
        listed = ", ".join(f"#{j + 1} {table.columns[j].header!r}" for j in found)
        same = len({table.columns[j].header for j in found}) == 1
        two = "two columns of the same name" if same else f"more than one column for {channel}"
        raise InputError(
            f'has {two}: {listed}; choose one, for example --map {channel}="#{found[0] + 1} '
            f'[{SI[channel]}]"',
            where,
        )
    return found[0] if found else None


def missing(table: ColumnTable, wish: Wish, where: str) -> Problem | None:
    """Return the error for an assigned column that a table does not have; None: it has it."""
    return _missing(table, wish, where) if _wished(table, wish, where) is None else None


def _missing(table: ColumnTable, wish: Wish, where: str) -> Problem:
    headers = [c.header for c in table.columns if c.header]
    name = split_name(wish.text.lstrip("+-").strip())[0]
    near = difflib.get_close_matches(name, [*headers, *(c.name for c in table.columns)], 1, 0.5)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    listed = ", ".join(repr(h) for h in headers[:12]) + (", ..." if len(headers) > 12 else "")
    return Problem(wish.where, f"{where} has no column {name!r}{hint}; its columns are {listed}")


def proposals(table: ColumnTable, found: dict[str, Source], wanted: Iterable[str]) -> list[str]:
    """Return options that would assign unrecognised columns to channels, by their units."""
    used = {source.column for source in found.values()}
    out = []
    for channel in wanted:
        for j, column in enumerate(table.columns):
            unit = read_unit(column.unit) if column.unit else None
            if (
                j not in used
                and unit is not None
                and unit.si == SI[channel]
                and channel not in found
            ):
                out.append(f'--map {channel}="{column.header}"')
                used.add(j)
                break
    return out
