"""A check as one self-contained page: figures, remarks, tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rthyb_rt.report.html import environment, extra_needed, sheets, write_page

if TYPE_CHECKING:
    from rthyb_rt.checking.checked_axes import ExaminedAxes
    from rthyb_rt.checking.examined import Examined

_HERE = Path(__file__).parent


def write(found: Examined | ExaminedAxes, path: Path) -> None:
    """Write the page.

    Raises:
        InputError: the file name does not end in .html or .htm, or matplotlib or jinja2 is not
            installed.
        RthybError: the file cannot be written.
    """
    write_page(path, lambda: render(found))


def render(found: Examined | ExaminedAxes) -> str:
    """Return the page as HTML; errors as for `write`."""
    with extra_needed("a figure of a check"):
        from rthyb_rt.checking.plates import plates

        template = environment(_HERE).get_template("check.html.j2")
    return template.render(
        test=found.setup.test.test.name,
        rig=found.setup.rig_file.rig.name,
        warnings=found.warnings,
        notes=found.notes,
        tables=found.tables(),
        sheets=sheets(plates(found.setup)),
    )
