"""``rthyb compare-laws``: one test with all control laws."""

from __future__ import annotations

from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption, RigOption, SetOption

if TYPE_CHECKING:
    from collections.abc import Sequence

SCHEMA = "rthyb-compare-laws/1"


def compare_laws(
    test: Annotated[
        Path | None,
        typer.Argument(
            metavar="TEST.toml",
            help="Test file, or name of a shipped test. Default: the built-in test.",
            show_default=False,
        ),
    ] = None,
    rig: RigOption = None,
    settings: SetOption = None,
    law: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Control law to include. Can be repeated. Default: all.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run one test with every control law and compare.

    The runs are in virtual time. Everything else stays as in the files, including the
    restoring-force compensator. Each law uses its settings from the test file; what is missing
    there is taken from the rig's identification or from its defaults. The table begins with the
    best response.

    \b
    Examples:
      rthyb compare-laws
      rthyb compare-laws my-test.toml --law ats --law inverse
      rthyb compare-laws my-test.toml --set controller.rfc.enabled=false
    """
    from rthyb_rt.campaign import comparison

    notes: list[str] = []
    with terminal.sections("Comparing") as progress:
        rows = comparison.compare(test, rig, settings or (), law or (), progress, notes.append)
    for note in notes:
        terminal.tell(f"note: {note}")
    _print(rows, terminal.people(as_json))
    if as_json:
        laws = [{key: value for key, value in row.items() if key != "case"} for row in rows]
        terminal.print_json({"schema": SCHEMA, "laws": laws})


def _print(rows: Sequence[dict[str, Any]], file: IO[str]) -> None:
    """Print the table, and below it why tests did not complete: sentences, too long for it."""
    from rthyb_rt.campaign.plan import COMPLETED

    grid = terminal.ruled_table()
    grid.add_column("law", no_wrap=True)
    for head in ("response", "largest difference", "tracking", "delay at the end"):
        grid.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        grid.add_row(row["law"], *_cells(row))
    terminal.show(grid, file)
    ended = [row for row in rows if row["ending"] != COMPLETED]
    if ended:
        print("\nNot completed:", file=file)
    for row in ended:
        print(f"  {row['law']}: {' '.join(str(row['cause']).split())}", file=file)


def _cells(row: dict[str, Any]) -> list[str]:
    """Return response, greatest difference, tracking and delay for a law."""
    from rthyb_rt.campaign.plan import COMPLETED
    from rthyb_rt.numbers import delay, number, percent

    if row["ending"] != COMPLETED:
        # Figures up to an early end cannot be compared with those of a complete test.
        return ["–"] * 4
    difference, alpha = row["response_peak_difference_m"], row["alpha_end"]
    return [
        percent(row["response_nrmse"]),
        "–" if difference is None else f"{number(1e3 * difference)} mm",
        percent(row["tracking_nrmse"]),
        "–" if alpha is None else delay(alpha, row["fs_hz"]),
    ]
