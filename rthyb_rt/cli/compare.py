"""``rthyb compare``: recordings, simulations and tables of other laboratories side by side."""

from __future__ import annotations

import datetime
import re
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.folders import publish, refuse_taken, staged
from rthyb_rt.cli.inputs import AxisOption, JsonOption

if TYPE_CHECKING:
    from rthyb_rt.comparing.overlay import Overlay

SCHEMA = "rthyb-compare/1"


def compare(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="A",
            help="Recording; folder of a sweep; test file, for its simulation; CSV file.",
            show_default=False,
        ),
    ],
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="CHANNEL=COLUMN",
            help='Column of a CSV file for a channel, as in x_meas="LVDT 1 [mm]"; or a mapping '
            "file. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    align: Annotated[
        bool,
        typer.Option("--align", help="Shift each in time so that it matches the first."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for page and table, instead of runs/compare-A-UTC.",
            show_default=False,
        ),
    ] = None,
    axis: AxisOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare recordings, simulations and CSV files.

    Shows, on one page, curves, differences from the first, and a table, for two to ten of: tests of
    this program, kept runs of a campaign or sweep, the reference simulation of a test file, and CSV
    files of other laboratories whose columns state their units. A single recording is compared
    with its own reference simulation. If rates differ, the lowest is used; if lengths differ, the
    part common to all; notes say so.

    \b
    Examples:
      rthyb compare runs/monday runs/tuesday
      rthyb compare runs/monday my-test.toml
      rthyb compare runs/monday lab.csv --map x_meas="LVDT 1 [mm]" --align
      rthyb compare runs/my-test-sweep
      rthyb compare runs/two-actuator-frame-20260301T101500Z --axis upper
    """
    from rthyb_rt.comparing import courses
    from rthyb_rt.comparing.overlay import Overlay

    refuse_taken(out)
    started = datetime.datetime.now(datetime.UTC)
    found = Overlay.of(courses.read(recordings, columns or (), axis), align=align)
    first = re.sub(r"[^\w.-]+", "-", found.labels[0]).strip("-.") or "recording"
    target = out or Path("runs") / f"compare-{first}-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:
        note = _write(found, stage)
        folder = publish(stage, target, numbered=out is None)
    file = terminal.people(as_json)
    _print(found, file)
    paths = {name: folder / kept for name, kept in _names().items() if (folder / kept).exists()}
    print(
        "", *(f"{name.capitalize():9}{path}" for name, path in paths.items()), sep="\n", file=file
    )
    if note:
        terminal.tell(f"note: {note}")
    if as_json:
        terminal.print_json(
            {
                "schema": SCHEMA,
                "rate_hz": found.fs_hz,
                "samples": found.shared,
                "aligned": found.aligned,
                "rows": found.rows,
                "notes": list(found.notes),
                "paths": {name: str(path) for name, path in paths.items()},
            }
        )


def _names() -> dict[str, str]:
    from rthyb_rt.comparing import comparison_page

    return {"page": comparison_page.PAGE, "table": comparison_page.TABLE}


def _write(found: Overlay, folder: Path) -> str:
    """Write page and table; return which package is missing and how to install it."""
    from rthyb_rt.comparing import comparison_page
    from rthyb_rt.errors import InputError

    comparison_page.write_csv(found, folder / comparison_page.TABLE)
    try:
        comparison_page.write(found, folder / comparison_page.PAGE)
    except InputError as error:
        return f"no page was written: {error}"
    return ""


def _print(found: Overlay, file: IO[str]) -> None:
    from rthyb_rt.comparing import comparison_page

    print(comparison_page.sentence(found), "", sep="\n", file=file)
    heads, rows = comparison_page.table(found)
    grid = terminal.ruled_table()
    for place, head in enumerate(heads):
        grid.add_column(head, justify="right" if place else "left", overflow="fold")
    for cells in rows:
        grid.add_row(*cells)
    terminal.show(grid, file)
    if found.notes:
        print("", *(f"Note: {note}" for note in found.notes), sep="\n", file=file)
