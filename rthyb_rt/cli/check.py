"""``rthyb check``: errors of a test, and its margins; or what a rig file alone says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import JsonOption, RigOption, SetOption, load_any, note_unused

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rthyb_rt.checking.checked_axes import ExaminedAxes
    from rthyb_rt.checking.examined import Examined
    from rthyb_rt.checking.examined_rig import ExaminedRig


def check(
    test: Annotated[
        Path | None,
        typer.Argument(
            metavar="TEST.toml",
            help="Test file, or name of a shipped test. Without it, --rig is checked alone.",
            show_default=False,
        ),
    ] = None,
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
    """Check a test without running it, or a rig without a test.

    Reports every error in the test file and the rig file. If there is none, shows the period and
    mass, the gains of the compensator, the critical delay, the roots and margins of the complete
    loop if the rig's response is known, the margin of the delay estimator, the combined limits of
    test and rig, and the rig's link with its bus load and commissioning dates. Notes and warnings
    point out whatever is close to a limit.

    With --rig and without a test, shows what the rig file alone says: what was identified and how
    far its response is known, link, commissioning, calibration and limits.

    \b
    Examples:
      rthyb check my-test.toml
      rthyb check my-test.toml --rig my-rig.toml --set numerical.period_s=0.8
      rthyb check my-test.toml --plot check.html
      rthyb check --rig my-rig.toml
    """
    # The matrices of a loop are small: on several cores their roots take longer, above all if these
    # are busy.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from rthyb_rt.checking.checked_axes import examine_axes
    from rthyb_rt.checking.examined import examine
    from rthyb_rt.config import AxesRig

    if test is None:
        _check_rig(rig, settings, plot, as_json)
        return
    if plot is not None:
        from rthyb_rt.report.html import page_file

        page_file(plot)
    test_file, rig_file = load_any(test, rig, settings)
    note_unused(test_file, settings)
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


def _check_rig(
    name: str | None, settings: list[str] | None, plot: Path | None, as_json: bool
) -> None:
    from rthyb_rt import config
    from rthyb_rt.checking.examined_rig import examine_rig

    if name is None:
        raise typer.BadParameter(
            "missing; give a test, or only a rig with --rig RIG.toml", param_hint="TEST.toml"
        )
    if plot is not None:
        raise typer.BadParameter(
            "draws the stability of a test; give TEST.toml too", param_hint="--plot"
        )
    _reject_settings_of_a_test(settings or ())
    path, changes = config.find_rig(name), dict[str, str]()
    for part in config.split_overrides(settings or ()):
        changes |= part
    given = changes if config.has_axes(path) else config.with_some_stiffness(path, changes)
    rig = config.load_any_rig(path, given)
    found = examine_rig(rig, path, stiffness_stated=given == changes)
    print(f"{found.name}: no errors found\n", file=terminal.people(as_json))
    _print_tables(found, terminal.people(as_json))
    if as_json:
        terminal.print_json(found.document())


def _reject_settings_of_a_test(settings: Sequence[str]) -> None:
    """Reject what only a test file has; a rig is checked without one.

    Raises:
        InputError: with each such setting.
    """
    from rthyb_rt import config
    from rthyb_rt.errors import InputError, Problem

    of_a_test, _ = config.split_overrides(settings)
    sections = set(config.TestFile.model_fields)
    sections -= set(config.RigFile.model_fields) | set(config.AxesRig.model_fields)
    problems = [
        Problem(
            f"--set {key}",
            "belongs to a test, and without a test only the rig is checked; give TEST.toml as "
            "well, or leave this setting out",
        )
        for key in of_a_test
        if key.partition(".")[0] in sections
    ]
    if problems:
        raise InputError(problems)


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
    _print_tables(found, file)


def _print_axes(found: ExaminedAxes, file: IO[str]) -> None:
    setup, group = found.setup, found.group
    print(f"{setup.test.test.name} on {group.rig.rig.name}: no errors found\n", file=file)
    _print_tables(found, file)


def _print_tables(found: Examined | ExaminedAxes | ExaminedRig, file: IO[str]) -> None:
    """Print the tables, and the remarks after them."""
    for number, rows in enumerate(found.tables()):
        if number:
            print("", file=file)
        terminal.print_table(rows, file)
    remarks = [f"Warning: {text}" for text in found.warnings]
    remarks += [f"Note: {text}" for text in found.notes]
    if remarks:
        print("", *remarks, sep="\n", file=file)
