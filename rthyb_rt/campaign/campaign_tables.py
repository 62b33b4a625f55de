"""The table of a campaign for other programs: CSV, and Parquet if pyarrow is installed."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rthyb_rt.campaign.groups import RunGroup
from rthyb_rt.campaign.plan import FAILED, STOPPED, Measure, Row
from rthyb_rt.record.recording import replacing

CSV: Final = "table.csv"
STATISTICS: Final = "statistics.csv"
PARQUET: Final = "table.parquet"
_FIRST: Final = ("case",)


def columns(rows: Sequence[Row], first: Sequence[str] = _FIRST) -> list[str]:
    """Return the names of all columns, in the order of their first occurrence."""
    names: dict[str, None] = dict.fromkeys(first)
    for row in rows:
        names.update(dict.fromkeys(row))
    return list(names)


def statistics(groups: Sequence[RunGroup], measures: Sequence[Measure]) -> list[Row]:
    """Return a row for each group: chosen values, counts, and statistics of its measures."""
    rows = []
    for one in groups:
        row: Row = dict(one.chosen)
        row |= {name: getattr(one, name) for name in ("runs", "completed", STOPPED, FAILED)}
        for measure in measures:
            spread = one.spreads.get(measure.name)
            for name in ("mean", "std", "median", "worst"):
                row[f"{measure.name}_{name}"] = None if spread is None else getattr(spread, name)
        rows.append(row)
    return rows


def write_csv(rows: Sequence[Row], path: Path, first: Sequence[str] = _FIRST) -> None:
    """Write all rows, one line each; missing values are left empty.

    Args:
        rows: rows of the table.
        path: file to write.
        first: columns that precede the others.

    Raises:
        RthybError: the file cannot be written.
    """
    names = columns(rows, first)
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(rows)


def write_parquet(rows: Sequence[Row], path: Path) -> bool:
    """Write the same as Parquet; return False if pyarrow is not installed.

    A column that contains text is written as text throughout.

    Raises:
        RthybError: the file cannot be written.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        return False
    table = pyarrow.table({name: _column([row.get(name) for row in rows])
                           for name in columns(rows)})  # fmt: skip
    with replacing(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)
    return True


def _column(values: list[Any]) -> list[Any]:
    kinds = {type(value) for value in values if value is not None}
    if str in kinds and len(kinds) > 1:
        return [None if value is None else str(value) for value in values]
    if kinds == {int, float}:
        return [None if value is None else float(value) for value in values]
    if bool in kinds and len(kinds) > 1:
        return [None if value is None else str(value) for value in values]
    return values
