"""Results of a study: rows with accepted bands, and panels of curves to draw."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.numbers import number

Floats = NDArray[np.float64]
Colour = Literal["black", "orange", "green", "blue", "red", "purple", "grey"]


@dataclass(frozen=True)
class StudyRow:
    """One figure of a study.

    Attributes:
        quantity: description of the figure.
        value: as computed here.
        unit: of value and band; "" for a dimensionless number.
        low, high: accepted band, both None if there is none.
        paper: statement of Chen & Tsai (2012) about it; "" if there is none.
        stated: the same as a range, if it is one; a value outside it is marked, which is not an
            error of a method that is reproduced on another rig.
        group: rows of one group form one table, under this heading.
        case: which of several compared cases it belongs to: a column of the group's table; "" if
            nothing is compared.
    """

    quantity: str
    value: float
    unit: str = ""
    low: float | None = None
    high: float | None = None
    paper: str = ""
    group: str = ""
    case: str = ""
    stated: tuple[float, float] | None = None

    @property
    def as_stated(self) -> bool | None:
        """Whether the value is in the range that the paper states; None if it states none."""
        if self.stated is None:
            return None
        return bool(self.stated[0] <= self.value <= self.stated[1])

    @property
    def inside(self) -> bool | None:
        """Whether the value is in its band; None without a band. NaN never is."""
        if self.low is None and self.high is None:
            return None
        low = -np.inf if self.low is None else self.low
        high = np.inf if self.high is None else self.high
        return bool(low <= self.value <= high)


@dataclass(frozen=True)
class Curve:
    """A line of a panel; ``filled`` shades the enclosed area, without an outline if width is 0."""

    label: str
    x: Floats
    y: Floats
    colour: Colour = "blue"
    dashed: bool = False
    width: float = 0.9
    filled: bool = False


@dataclass(frozen=True)
class Panel:
    """One picture: curves over a common abscissa, a figure of the paper or part of it."""

    key: str
    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    note: str = ""
    half: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    levels: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True)
class Study:
    """A section of the paper, reproduced.

    Attributes:
        key: as on the command line ("4.1").
        title, text: what is studied and how.
        rows: figures with their bands.
        panels: pictures.
        ambiguities: details that the paper leaves open, and the assumptions made.
        notice: remark on all figures; usually "".
    """

    key: str
    title: str
    text: str
    rows: tuple[StudyRow, ...]
    panels: tuple[Panel, ...]
    ambiguities: tuple[str, ...] = field(default=())
    notice: str = ""

    @property
    def banded(self) -> list[StudyRow]:
        """Rows that have a band."""
        return [row for row in self.rows if row.inside is not None]

    @property
    def missed(self) -> list[StudyRow]:
        """Rows whose value is outside its band."""
        return [row for row in self.rows if row.inside is False]


# --- tables -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A row of a table: one quantity, one cell per case; None if a case lacks this figure."""

    quantity: str
    unit: str
    paper: str
    cells: tuple[StudyRow | None, ...]


@dataclass(frozen=True)
class StudyTable:
    """The rows of one group; ``cases`` are the headings of the cells, () if nothing is compared."""

    title: str
    cases: tuple[str, ...]
    lines: tuple[Line, ...]

    @property
    def has_units(self) -> bool:
        """Whether any row has a unit."""
        return any(line.unit for line in self.lines)

    @property
    def has_statements(self) -> bool:
        """Whether the paper states anything about any row."""
        return any(line.paper for line in self.lines)


def grouped(group: str, rows: Iterable[StudyRow], case: str = "") -> list[StudyRow]:
    """Return the rows as part of a group, and of a case if one is given."""
    return [replace(row, group=group, case=case or row.case) for row in rows]


def tables(study: Study) -> list[StudyTable]:
    """Return the rows of a study as one table per group, with cases side by side."""
    groups: dict[str, list[StudyRow]] = {}
    for row in study.rows:
        groups.setdefault(row.group, []).append(row)
    return [_table(group, rows) for group, rows in groups.items()]


def _table(title: str, rows: list[StudyRow]) -> StudyTable:
    cases = tuple(dict.fromkeys(row.case for row in rows))
    lines = []
    for quantity in dict.fromkeys(row.quantity for row in rows):
        cells = {row.case: row for row in rows if row.quantity == quantity}
        statements = dict.fromkeys(row.paper for row in cells.values() if row.paper)
        unit = next(iter(cells.values())).unit
        lines.append(
            Line(quantity, unit, "; ".join(statements), tuple(cells.get(case) for case in cases))
        )
    return StudyTable(title, cases if cases != ("",) else (), tuple(lines))


def value_text(row: StudyRow) -> str:
    """Return the value with four significant digits, a count without decimals."""
    if float(row.value).is_integer() and abs(row.value) < 1e5:
        return f"{row.value:.0f}".replace("-", "−")
    return number(row.value, 4)


def band_text(row: StudyRow) -> str:
    """Return the accepted band, ``11 – 13``, ``≤ 0.25``; "" without one."""
    if row.low is not None and row.high is not None:
        if row.low == row.high:
            return _bound(row.low)
        return f"{_bound(row.low)} – {_bound(row.high)}"
    if row.low is not None:
        return f"≥ {_bound(row.low)}"
    return f"≤ {_bound(row.high)}" if row.high is not None else ""


def _bound(value: float) -> str:
    return f"{value:.6g}".replace("-", "−")


def rms(x: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))
