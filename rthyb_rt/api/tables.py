"""Tables for notebooks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from rthyb_rt.numbers import number


def html_table(rows: Iterable[Sequence[Any]], head: Sequence[str] = ()) -> str:
    """Return rows as an HTML table; numbers with three digits, a dash for missing values."""
    lines = ["<table>"]
    if head:
        lines.append("<tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr>")
    lines += ["<tr>" + "".join(f"<td>{_cell(one)}</td>" for one in row) + "</tr>" for row in rows]
    return "".join([*lines, "</table>"])


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return escape(number(value) if isinstance(value, float) else str(value))
