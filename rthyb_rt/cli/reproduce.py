"""``rthyb reproduce``: the paper's studies with their accepted bands."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.folders import publish, refuse_taken, staged
from rthyb_rt.cli.inputs import JsonOption
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table as Grid
    from rich.text import Text

    from rthyb_rt.studies.results import Line, Study, StudyRow, StudyTable

BAND_MISSED = 8
ROOM_FOR_PAPER = 116
"""Width of a line from which the statements of the paper are printed as well."""


class Section(StrEnum):
    """Sections that can be reproduced."""

    PLC = "2.1"
    ESTIMATOR = "4.1"
    INELASTIC = "4.2"
    TABLE = "5"
    ALL = "all"


def reproduce(
    section: Annotated[
        Section,
        typer.Argument(metavar="SECTION", help="Section to reproduce."),
    ] = Section.ALL,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Ground motion TCU068 EW for Section 4.2. Default: the one in the package "
            "pyslammer; if that is missing, El Centro without accepted bands.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the page and the results, instead of runs/reproduce-UTC.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Reproduce the studies of Chen & Tsai (2012).

    2.1 stability of the compensator, 4.1 delay estimator, 4.2 inelastic structure, 5 shaking
    table. Every result is compared with its accepted band and with the value in the paper.

    \b
    Examples:
      rthyb reproduce
      rthyb reproduce 4.2 --record TCU068-E.AT2

    The exit code is 8 if a result lies outside its band.
    """
    from rthyb_rt import studies
    from rthyb_rt.studies import studies_page

    if record is not None and section not in (Section.INELASTIC, Section.ALL):
        raise typer.BadParameter("applies only to Section 4.2", param_hint="--record")
    refuse_taken(out)
    started = datetime.datetime.now(datetime.UTC)
    with terminal.sections("Reproducing") as progress:
        found = studies.run(section.value, record, progress)
    file = terminal.people(as_json)
    for study in found:
        _print_study(study, file)
    missed = _print_verdict(found, file)
    target = out or Path("runs") / f"reproduce-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:
        try:
            studies_page.write_page(found, stage)
        except InputError as error:
            terminal.tell(f"no page was written: {error}")
        has_page = (stage / studies_page.PAGE).exists()
        folder = publish(stage, target, numbered=out is None)
    paths = {"results": str(folder / studies_page.RESULTS)}
    if has_page:
        paths["page"] = str(folder / studies_page.PAGE)
    print(
        "", *(f"{name.capitalize():9}{path}" for name, path in paths.items()), sep="\n", file=file
    )
    if as_json:
        terminal.print_json({**studies_page.document(found), "paths": paths})
    if missed:
        raise typer.Exit(BAND_MISSED)


def _print_study(study: Study, file: IO[str]) -> None:
    from rich.text import Text

    from rthyb_rt.studies.results import tables

    met = len(study.banded) - len(study.missed)
    head = f"Section {study.key}: {study.title}"
    terminal.show(Text(f"{head} ({met} of {len(study.banded)} bands met)", style="bold"), file)
    if study.notice:
        print(f"Note: {study.notice}", file=file)
    for table in tables(study):
        terminal.show(Text(f"\n{table.title}", style="bold"), file)
        terminal.show(_grid(table, terminal.width(file)), file)
    print("", file=file)


def _grid(table: StudyTable, width: int) -> Grid:
    grid = terminal.ruled_table()
    grid.add_column("", overflow="fold")
    if table.has_units:
        grid.add_column("unit", style="dim")
    for case in table.cases or ("value",):
        grid.add_column(case, justify="right", overflow="fold")
    if not table.cases:
        grid.add_column("accepted")
    with_paper = table.has_statements and width >= ROOM_FOR_PAPER
    if with_paper:
        grid.add_column("the paper", style="dim")
    for line in table.lines:
        grid.add_row(*_cells(table, line, with_paper))
    return grid


def _cells(table: StudyTable, line: Line, with_paper: bool) -> list[Text]:
    from rich.text import Text

    from rthyb_rt.studies.results import value_text

    cells = [Text(line.quantity)]
    if table.has_units:
        cells.append(Text(line.unit))
    for row in line.cells:
        if row is None:
            cells.append(Text("–", style="dim"))
            continue
        band = _band(row)
        value = Text(value_text(row), style="bold")
        if table.cases:
            cells.append(Text("\n").join([value, band]) if band else value)
        else:
            cells += [value, band]
    if with_paper:
        cells.append(Text(line.paper))
    return cells


def _band(row: StudyRow) -> Text:
    """Return the mark and the accepted band; nothing for a row without one."""
    from rich.text import Text

    from rthyb_rt.studies.results import band_text

    if row.inside is None:
        return Text("")
    mark = ("✓", "green") if row.inside else ("✗ missed", "bold red")
    return Text.assemble(mark, " ", (band_text(row).replace(" – ", "–"), "dim"))


def _print_verdict(found: Sequence[Study], file: IO[str]) -> int:
    """Print how many bands are met and which are not; return how many are not."""
    from rthyb_rt.studies.results import band_text, value_text

    missed = [(study, row) for study in found for row in study.missed]
    banded = sum(len(study.banded) for study in found)
    print(f"{banded - len(missed)} of {banded} accepted bands are met", file=file)
    for study, row in missed:
        what = ", ".join(part for part in (row.group, row.case, row.quantity) if part)
        print(
            f"✗ missed: Section {study.key}, {what}: {value_text(row)} {row.unit}, accepted: "
            f"{band_text(row)}",
            file=file,
        )
    return len(missed)
