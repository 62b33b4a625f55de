"""The studies as a page and as a machine-readable document."""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rthyb_rt import __version__, core
from rthyb_rt.record.recording import replacing
from rthyb_rt.report.html import environment, extra_needed, sheets
from rthyb_rt.studies.results import Study, StudyRow, band_text, tables, value_text

SCHEMA = "rthyb-reproduce/1"
PAGE, RESULTS = "index.html", "results.json"
_HERE = Path(__file__).parent


def write_page(studies: Sequence[Study], folder: str | Path) -> None:
    """Write ``results.json``, then ``index.html``, a self-contained file.

    Args:
        studies: as returned by `rthyb_rt.studies.run`.
        folder: output folder, created if necessary.

    Raises:
        InputError: matplotlib or jinja2 is not installed; ``results.json`` is written nevertheless.
        RthybError: a file cannot be written.
    """
    with replacing(Path(folder) / RESULTS) as temporary:
        text = json.dumps(document(studies), indent=1, ensure_ascii=False, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    html = render(studies)
    with replacing(Path(folder) / PAGE) as temporary:
        temporary.write_text(html, encoding="utf-8")


def document(studies: Sequence[Study]) -> dict[str, Any]:
    """Return the rows as a document; a value that is not finite is None."""
    return {
        "schema": SCHEMA,
        "created_utc": _now(),
        "rthyb_version": __version__,
        **core.build_facts(),
        "bands": sum(len(study.banded) for study in studies),
        "missed": sum(len(study.missed) for study in studies),
        "sections": [
            {
                "section": study.key,
                "title": study.title,
                "bands": len(study.banded),
                "missed": len(study.missed),
                "notice": study.notice,
                "left_open": list(study.ambiguities),
            }
            for study in studies
        ],
        "rows": [_row(study, row) for study in studies for row in study.rows],
    }


def _row(study: Study, row: StudyRow) -> dict[str, Any]:
    band = None if row.inside is None else {"low": row.low, "high": row.high}
    return {
        "section": study.key,
        "group": row.group,
        "case": row.case,
        "quantity": row.quantity,
        "value": row.value if math.isfinite(row.value) else None,
        "unit": row.unit,
        "band": band,
        "inside": row.inside,
        "paper": row.paper,
        "as_stated": row.as_stated,
    }


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def render(studies: Sequence[Study]) -> str:
    """Return the page as HTML.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
    """
    with extra_needed("the page"):
        from rthyb_rt.studies.studies_figures import draw_all

        engine = environment(_HERE)
    engine.filters["value"] = value_text
    engine.filters["band"] = band_text
    sections = []
    figures = 0
    for study in studies:
        plates = draw_all(study)
        sections.append((study, tables(study), sheets(plates, figures + 1)))
        figures += len(plates)
    facts = core.build_facts()
    return engine.get_template("page.html.j2").render(
        sections=sections,
        bands=sum(len(study.banded) for study in studies),
        missed=[(study, row) for study in studies for row in study.missed],
        facts=[
            f"rthyb_rt {__version__}",
            f"core {facts['core_version']}",
            f"compiler {facts['compiler']}, {facts['architecture']}",
            _now().replace("T", " ").replace("+00:00", " UTC"),
        ],
    )
