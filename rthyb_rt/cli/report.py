"""``rthyb report``: the report of a recording."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from rthyb_rt.cli import interrupts
from rthyb_rt.cli.inputs import RecordingArgument


def report(
    recording: RecordingArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File to write, instead of report.html beside the recording.",
            show_default=False,
        ),
    ] = None,
    files: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Instead: every figure as SVG and PDF, the table as LaTeX and CSV, into a folder.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write the HTML report of a recording.

    A single file with the verdict, figures, results and settings, for screen and print.

    \b
    Examples:
      rthyb report runs/section5-t0.5-20260301T101500Z
      rthyb report runs/section5-t0.5-20260301T101500Z --files paper/figures
    """
    from rthyb_rt.errors import RthybError
    from rthyb_rt.record.recording import open_run
    from rthyb_rt.report import write_report

    if files is not None and out is not None:
        raise typer.BadParameter(
            "applies only to the page; omit it with --files", param_hint="--out"
        )
    rec = open_run(recording)
    if files is not None:
        from rthyb_rt.report.publication import write_files

        interrupts.wrote(files)
        for path in write_files(rec, files):
            print(path)
        return
    folder = recording if recording.is_dir() else recording.parent
    path = out or folder / "report.html"
    if out is None and not os.access(folder, os.W_OK):
        # Recordings of a service are readable by its group, but writable only by the service.
        raise RthybError(
            f"{folder}: is not writable; choose another path, such as --out report.html"
        )
    write_report(rec, path)
    interrupts.wrote(path)
    print(path)
