"""A comparison as one self-contained page, and its table as CSV."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, Final, NamedTuple

from rthyb_rt.comparing.overlay import Overlay
from rthyb_rt.numbers import number, percent, quantity
from rthyb_rt.record.recording import replacing
from rthyb_rt.report.html import environment, extra_needed, sheets, write_page

PAGE: Final = "compare.html"
TABLE: Final = "compare.csv"
_HERE = Path(__file__).parent


class Figure(NamedTuple):
    """A column of the table: its key in the rows, its head, unit and factor."""

    key: str
    head: str
    unit: str
    factor: float


FIGURES: Final = (
    Figure("x_difference_nrmse", "Difference, NRMSE", "%", 100.0),
    Figure("x_difference_m", "Largest difference", "mm", 1e3),
    Figure("f_difference_nrmse", "Force difference, NRMSE", "%", 100.0),
    Figure("lag_s", "Lag", "ms", 1e3),
    Figure("lag_samples", "Lag", "samples", 1.0),
    Figure("peak_measured_m", "Peak displacement", "mm", 1e3),
    Figure("peak_force_n", "Peak force", "kN", 1e-3),
    Figure("tracking_nrmse", "Tracking, NRMSE", "%", 100.0),
    Figure("response_nrmse", "Response, NRMSE", "%", 100.0),
    Figure("energy_error_relative", "Energy error", "%", 100.0),
)
"""Figures of each course; differences and lag are relative to the first."""
_OF_THE_FIRST: Final = (
    "x_difference_nrmse",
    "x_difference_m",
    "f_difference_nrmse",
    "lag_s",
    "lag_samples",
)


_BESIDE: Final = 4
"""Maximum of courses in columns beside one another; more are listed in rows."""


def table(overlay: Overlay) -> tuple[list[str], list[list[str]]]:
    """Return the table as text: heads, and rows with their label first.

    A column for each of a few courses, a row for each of many.
    """
    by_course = []
    for place, row in enumerate(overlay.rows):
        own = [
            "–" if place == 0 and f.key in _OF_THE_FIRST else number(_scaled(row[f.key], f.factor))
            for f in FIGURES
        ]
        by_course.append([*own, row["ending"]])
    heads = [*(f"{f.head}, {f.unit}" for f in FIGURES), "Ending"]
    if len(overlay.courses) > _BESIDE:
        named = zip(overlay.labels, by_course, strict=True)
        return ["", *heads], [[label, *cells] for label, cells in named]
    by_figure = zip(heads, *by_course, strict=True)
    return ["", *overlay.labels], [list(cells) for cells in by_figure if any(cells[1:])]


def sentence(overlay: Overlay) -> str:
    """Return the result in one sentence."""
    first, others = overlay.rows[0]["label"], overlay.rows[1:]
    worst = max(others, key=lambda row: row["x_difference_nrmse"] or 0.0)
    nrmse, largest = worst["x_difference_nrmse"], worst["x_difference_m"]
    if largest is None:
        return f"{worst['label']} has no displacement to compare with {first}."
    what = f"{percent(nrmse)} (NRMSE), {quantity(largest, 'mm', 1e3)} at most"
    if len(others) == 1:
        return f"{worst['label']} differs from {first} by {what}."
    return f"Of the {len(others)} others {worst['label']} differs most from {first}: {what}."


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def render(overlay: Overlay) -> str:
    """Return the page as HTML.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
    """
    with extra_needed("the page of a comparison"):
        from rthyb_rt.comparing.comparison_figures import plates

        template = environment(_HERE).get_template("compare.html.j2")
    heads, rows = table(overlay)
    return template.render(
        labels=overlay.labels,
        courses=overlay.courses,
        sentence=sentence(overlay),
        seconds=f"{overlay.shared / overlay.fs_hz:.2f} s at {overlay.fs_hz:g} Hz",
        heads=heads,
        rows=rows,
        notes=overlay.notes,
        sheets=sheets(plates(overlay)),
    )


def write(overlay: Overlay, path: Path) -> None:
    """Write the page as one file.

    Raises:
        InputError: the file name does not end in .html or .htm, or matplotlib or jinja2 is not
            installed.
        RthybError: the file cannot be written.
    """
    write_page(path, lambda: render(overlay))


def write_csv(overlay: Overlay, path: Path) -> None:
    """Write the rows in SI units, the unit in each column's name.

    Raises:
        RthybError: the file cannot be written.
    """
    rows: list[dict[str, Any]] = overlay.rows
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), restval="")
        writer.writeheader()
        writer.writerows(rows)
