"""``rthyb check``: errors of a test, and its margins."""

from __future__ import annotations

from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import JsonOption, RigOption, SetOption, load_any

if TYPE_CHECKING:
    from rthyb_rt.checking.checked_axes import ExaminedAxes
    from rthyb_rt.checking.examined import Examined


def check(
    test: Annotated[
        Path,
        typer.Argument(
            metavar="TEST.toml", help="Test file, or name of a shipped test.", show_default=False
        ),
    ],
    rig: RigOption = None,
    settings: SetOption = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Page with stability map, Nyquist plot and predicted tracking, as HTML.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a test without running it.

    Reports every error in the test file and the rig file. If there is none, shows the period and
    mass, the gains of the compensator, the critical delay, the roots and margins of the complete
    loop if the rig's response is known, the margin of the delay estimator, the combined limits of
    test and rig, and the rig's link with its bus load and commissioning dates. Notes and warnings
    point out whatever is close to a limit.

    \b
    Examples:
      rthyb check my-test.toml
      rthyb check my-test.toml --rig my-rig.toml --set numerical.period_s=0.8
      rthyb check my-test.toml --plot check.html
    """
    from rthyb_rt.checking.checked_axes import examine_axes
    from rthyb_rt.checking.examined import examine
    from rthyb_rt.config import AxesRig

    if plot is not None:
        from rthyb_rt.report.html import page_file

        page_file(plot)
    test_file, rig_file = load_any(test, rig, settings)
    if isinstance(rig_file, AxesRig):
        axes = examine_axes(test_file, rig_file)
        _print_axes(axes, terminal.people(as_json))
        _write_page(axes, plot, terminal.people(as_json))
        if as_json:
            terminal.print_json(axes.document())
        return
    found = examine(test_file, rig_file, rig or test_file.rig)
    _print(found, terminal.people(as_json))
    _write_page(found, plot, terminal.people(as_json))
    if as_json:
        terminal.print_json(found.document())


def _write_page(found: Examined | ExaminedAxes, plot: Path | None, file: IO[str]) -> None:
    if plot is None:
        return
    from rthyb_rt.checking import check_page

    check_page.write(found, plot)
    interrupts.wrote(plot)
    print(f"\nPage      {plot}", file=file)


def _print(found: Examined, file: IO[str]) -> None:
    setup = found.setup
    print(f"{setup.test.test.name} on {setup.rig.rig.name}: no errors found\n", file=file)
    for number, rows in enumerate(found.tables()):
        if number:
            print("", file=file)
        terminal.print_table(rows, file)
    _print_remarks(found, file)


def _print_axes(found: ExaminedAxes, file: IO[str]) -> None:
    setup, group = found.setup, found.group
    print(f"{setup.test.test.name} on {group.rig.rig.name}: no errors found\n", file=file)
    for number, rows in enumerate(found.tables()):
        if number:
            print("", file=file)
        terminal.print_table(rows, file)
    _print_remarks(found, file)


def _print_remarks(found: Examined | ExaminedAxes, file: IO[str]) -> None:
    remarks = [f"Warning: {text}" for text in found.warnings]
    remarks += [f"Note: {text}" for text in found.notes]
    if remarks:
        print("", *remarks, sep="\n", file=file)
