"""``rthyb export``: a recording for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import AxisOption, RecordingArgument

if TYPE_CHECKING:
    from rthyb_rt.record.recording import RecordedTest


def export(
    recording: RecordingArgument,
    mat: Annotated[
        bool, typer.Option("--mat", help="Write a MAT file (version 5) with every field.")
    ] = False,
    csv: Annotated[
        bool,
        typer.Option(
            "--csv",
            help="Write a CSV file with t, ag, x_num, x_cmd, x_meas and f_meas, in SI units.",
        ),
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="With --csv, write every row and every field.")
    ] = False,
    axis: AxisOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File to write, instead of one beside the recording.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Export a recording as a MAT or CSV file.

    \b
    Examples:
      rthyb export runs/section5-t0.5-20260301T101500Z --mat
      rthyb export recording.h5 --csv --full --out test-7.csv
      rthyb export recording.h5 --csv --axis upper

    With --axis, the CSV file contains the signals of one of several axes; the part of its force
    that is due to the other axes is subtracted, by the specimen's stiffness matrix. The rig file of
    that axis, which is the model for a diagnosis, is written beside it.
    """
    if mat == csv:
        raise typer.BadParameter("choose one of the two", param_hint="--mat / --csv")
    if full and mat:
        raise typer.BadParameter(
            "applies only to --csv; a MAT file always has every field", param_hint="--full"
        )
    if axis is not None and (full or mat):
        raise typer.BadParameter("applies only to --csv without --full", param_hint="--axis")
    from rthyb_rt.record import axis_export
    from rthyb_rt.record.mat_csv import to_csv, to_mat
    from rthyb_rt.record.recording import open_run

    rec = open_run(recording)
    beside = recording / "recording" if recording.is_dir() else recording
    kind = ".mat" if mat else "-full.csv" if full else f"-{axis}.csv" if axis else ".csv"
    path = out or beside.with_name(beside.stem + kind)
    if axis is not None:
        model = axis_export.to_csv(rec, path, axis)
        interrupts.wrote(model)
        print(path, model, sep="\n")
        _note_extras(rec)
        return
    if mat:
        to_mat(rec, path)
    else:
        to_csv(rec, path, full=full)
    interrupts.wrote(path)
    print(path)
    if not full and not mat:
        _note_extras(rec)


def _note_extras(rec: RecordedTest) -> None:
    from rthyb_rt.record.mat_csv import without_extras

    note = without_extras(rec)
    if note:
        terminal.tell(f"note: the file {note}; --full writes all signals")
