"""Write the tables of docs/paper.md from the studies, as ``rthyb reproduce all`` computes them.

``python docs/tools/study_tables.py`` renews what stands between the page's markers
``<!-- generated: SECTION -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

from pathlib import Path

from key_tables import renewed

from rthyb_rt import studies
from rthyb_rt.studies.results import Study, StudyRow, StudyTable, band_text, tables, value_text

PAGE = Path(__file__).resolve().parents[1] / "paper.md"


def parts() -> dict[str, str]:
    """Return the tables of every section by its number."""
    return {study.key: _section(study) for study in studies.run("all")}


def _section(study: Study) -> str:
    banded, missed = len(study.banded), len(study.missed)
    count = f"{banded - missed} of the {banded} values that have an accepted band lie within it."
    shown = [_table(table) for table in tables(study)]
    return "\n\n".join([count, *shown])


def _table(table: StudyTable) -> str:
    if table.cases:
        rows = [f"| | {' | '.join(_text(case) for case in table.cases)} | unit | the paper |"]
        rows.append("|---|" + "---|" * (len(table.cases) + 2))
    else:
        rows = ["| | here | accepted | unit | the paper |", "|---|---|---|---|---|"]
    for line in table.lines:
        cells = [_cell(row) for row in line.cells]
        if not table.cases:
            cells = [value_text(row) if row else "" for row in line.cells]
            cells.append(band_text(line.cells[0]) if line.cells[0] else "")
        columns = [_text(line.quantity), *cells, line.unit, _text(line.paper)]
        rows.append(f"| {' | '.join(columns)} |")
    return f"**{_text(table.title)}**\n\n" + "\n".join(rows)


def _cell(row: StudyRow | None) -> str:
    if row is None:
        return ""
    band = band_text(row)
    said = [band] if band else []
    if row.as_stated is False:
        said.append("outside the paper's range")
    return f"{value_text(row)} ({', '.join(said)})" if said else value_text(row)


def _text(text: str) -> str:
    """Return a text that a table of Markdown takes as it is."""
    return text.replace("|", "\\|").replace("_", "\\_").replace("*", "\\*")


if __name__ == "__main__":
    PAGE.write_text(renewed(PAGE.read_text(encoding="utf-8"), parts()), encoding="utf-8")
