"""The report of a hybrid test: one self-contained HTML file, suitable for printing on A4."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rthyb_rt.analysis.summary import (
    Summary,
    key_figures,
    notices,
    summarize,
    table,
    verdict,
)
from rthyb_rt.numbers import percent, quantity
from rthyb_rt.record import recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import axes_report
from rthyb_rt.report.html import environment, extra_needed, sheets, write_page

_MOTION_NAMES = {"name": "Record", "source": "Source", "pga_g": "Peak, g", "scale": "Scale factor"}
_META_NAMES = {
    "rthyb_version": "rthyb_rt",
    "core_version": "core",
    "git_hash": "revision",
    "core_sources": "sources of the core",
    "compiler": "compiler",
    "architecture": "architecture",
    "clock": "clock",
    "created_utc": "recorded, UTC",
}
_SHOWN_ELSEWHERE = (
    *("test_name", "end_reason", "interrupted", "real_time", "commissioning", recording.OMITTED),
)


def write_report(rec: RecordedTest, path: str | Path) -> None:
    """Write the report of a recording as one self-contained HTML file.

    Args:
        rec: the recording.
        path: file to write.

    Raises:
        InputError: the file name does not end in .html or .htm, or matplotlib or jinja2 is not
            installed.
        RthybError: the file cannot be written.
    """
    of_rig = render if len(rec.axis_names) < 2 else axes_report.render
    write_page(path, lambda: of_rig(rec))


def render(rec: RecordedTest) -> str:
    """Return the report of a recording as HTML.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
    """
    with extra_needed("a report"):
        from rthyb_rt.report import zoom
        from rthyb_rt.report.figures import draw_all, peak_window

        template = environment().get_template("report.html.j2")
    summary = summarize(rec)
    found = notices(summary)
    return template.render(
        s=summary,
        title=summary.test_name or "Hybrid test",
        figures_of_test=key_figures(summary),
        verdict=verdict(summary),
        alarms=[notice for notice in found if notice.level == "alarm"],
        notes=[notice for notice in found if notice.level == "note"],
        pairs=_pairs(summary),
        rows=_rest(summary),
        steps=_steps(summary),
        sheets=sheets(draw_all(rec, summary)),
        zoom=zoom.parts(rec, summary, peak_window(summary, rec.time_s())),
        motion=_named(rec.ground_motion, _MOTION_NAMES),
        versions=_named(rec.meta | _commissioned(rec.meta), _META_NAMES),
        settings=[("Test file", rec.test_toml), ("Rig file", rec.rig_toml)],
    )


def _pairs(s: Summary) -> list[tuple[str, str, str]]:
    """Return tracking and response side by side."""
    return [
        ("NRMSE", percent(s.tracking_nrmse), percent(s.response_nrmse)),
        (
            "Largest difference",
            quantity(s.tracking_peak_difference_m, "mm", 1e3),
            quantity(s.response_peak_difference_m, "mm", 1e3),
        ),
        ("relative to the peak", percent(s.tracking_peak_error), percent(s.response_peak_error)),
    ]


def _rest(s: Summary) -> list[tuple[str, str, str]]:
    """Return the rows of the result table that the pairs do not contain."""
    shown = ("Tracking,", "Response", "Loops at")
    return [row for row in table(s) if not row.label.startswith(shown)]


def _steps(s: Summary) -> list[tuple[str, ...]]:
    """Return the results for each amplitude of a prescribed history."""
    return [
        (
            quantity(one.amplitude_m, "mm", 1e3),
            str(len(one.loops)),
            quantity(one.first.upper[1], "kN", 1e-3),
            quantity(one.first.lower[1], "kN", 1e-3),
            quantity(one.last.secant_n_per_m, "kN/m", 1e-3),
            quantity(one.first.energy_j, "J"),
            quantity(one.last.energy_j, "J"),
            percent(one.last.damping_ratio),
        )
        for one in s.loops
    ]


def _named(values: dict[str, Any], names: dict[str, str]) -> list[tuple[str, str]]:
    """Return values with display names, known ones first, without empty ones."""
    known = [(name, values[key]) for key, name in names.items() if key in values]
    more = [
        (key, value)
        for key, value in values.items()
        if key not in names and key not in _SHOWN_ELSEWHERE
    ]
    return [(name, _shown(value)) for name, value in known + more if value not in (None, "")]


def _commissioned(meta: dict[str, Any]) -> dict[str, str]:
    """Return when each commissioning step of the rig was done, for a test in real time."""
    facts = meta.get("commissioning")
    if not isinstance(facts, dict):
        return {}
    if facts.get("virtual"):
        return {"Rig commissioned": "not required for a virtual rig"}
    steps = (("polarity", "Polarity"), ("limits", "Limits"), ("watchdog", "Drive's own stop"))
    return {f"{name} checked": str(facts.get(key) or "never") for key, name in steps}


def _shown(value: Any) -> str:
    """Return a value with a suitable number of digits, also if it was stored as text."""
    if isinstance(value, str) and re.fullmatch(r"-?\d+\.\d{7,}", value):
        value = float(value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items() if item != [])
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
