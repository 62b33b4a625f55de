"""The report of a hybrid test: one HTML file that needs nothing else and prints well on A4."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rthyb_rt.errors import InputError
from rthyb_rt.recording import Recording, replacing
from rthyb_rt.summary import Summary, notices, percent, quantity, summarize, table, verdict

if TYPE_CHECKING:
    from rthyb_rt.report.figures import Plate

_HERE = Path(__file__).parent

_MOTION_NAMES = {"name": "Record", "source": "Source", "pga_g": "Peak, g", "scale": "Scale factor"}
_META_NAMES = {
    "rthyb_version": "rthyb_rt",
    "core_version": "core",
    "git_hash": "revision",
    "compiler": "compiler",
    "architecture": "architecture",
    "clock": "clock",
    "created_utc": "recorded, UTC",
}


def write_report(rec: Recording, path: str | Path) -> None:
    """Write the report of a recording as one self-contained HTML file.

    Args:
        rec: the recording.
        path: file to write.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
        RthybError: the file cannot be written.
    """
    html = render(rec)
    with replacing(Path(path)) as temporary:
        temporary.write_text(html, encoding="utf-8")


def render(rec: Recording) -> str:
    """Return the report of a recording as HTML.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
    """
    try:
        import jinja2
        from markupsafe import Markup

        from rthyb_rt.report.figures import draw_all
    except ImportError as error:
        raise InputError(
            f"a report needs {error.name}; install it with pip install 'rthyb-rt[report]'"
        ) from error
    summary = summarize(rec)
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["tied"] = _tied
    template = environment.from_string((_HERE / "report.html.j2").read_text(encoding="utf-8"))
    return template.render(
        style=Markup((_HERE / "report.css").read_text(encoding="utf-8")),
        markup=Markup,
        s=summary,
        title=summary.test_name or "Hybrid test",
        verdict=verdict(summary),
        notices=notices(summary),
        pairs=_pairs(summary),
        rows=_rest(summary),
        sheets=_sheets(draw_all(rec, summary)),
        motion=_named(rec.ground_motion, _MOTION_NAMES),
        versions=_named(rec.meta, _META_NAMES),
        settings=[("Test file", rec.test_toml), ("Rig file", rec.rig_toml)],
    )


def _tied(text: str) -> str:
    """Keep a number and its unit on one line."""
    text = text.replace("> ", ">\u00a0")
    return re.sub(r"(?<=\d) (?=(?:%|mm²?|ms|m|s|kN|kN/m|J|Hz|samples)(?:\W|$))", "\u00a0", text)


def _pairs(s: Summary) -> list[tuple[str, str, str]]:
    """Return tracking and response side by side."""
    return [
        ("NRMSE", percent(s.tracking_nrmse), percent(s.response_nrmse)),
        (
            "Largest difference",
            quantity(s.tracking_peak_difference_m, "mm", 1e3),
            quantity(s.response_peak_difference_m, "mm", 1e3),
        ),
        ("as part of the peak", percent(s.tracking_peak_error), percent(s.response_peak_error)),
    ]


def _rest(s: Summary) -> list[tuple[str, str, str]]:
    """Return the rows of the result table that the pairs do not show."""
    return [row for row in table(s) if not row.label.startswith(("Tracking,", "Response"))]


def _sheets(plates: list[Plate]) -> list[list[tuple[int, Plate]]]:
    """Number the figures and put those of half width two to a row."""
    sheets: list[list[tuple[int, Plate]]] = []
    for number, plate in enumerate(plates, start=1):
        last = sheets[-1] if sheets else []
        if plate.half and len(last) == 1 and last[0][1].half:
            last.append((number, plate))
        else:
            sheets.append([(number, plate)])
    return sheets


def _named(values: dict[str, Any], names: dict[str, str]) -> list[tuple[str, str]]:
    """Return values with their names for people, the known ones first, empty ones left out."""
    known = [(name, values[key]) for key, name in names.items() if key in values]
    more = [
        (key, value)
        for key, value in values.items()
        if key not in names and key not in ("test_name", "end_reason", "interrupted")
    ]
    return [
        (name, f"{value:.6g}" if isinstance(value, float) else str(value))
        for name, value in known + more
        if value not in (None, "")
    ]
