"""``rthyb run``: the main job."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.folders import publish, refuse_taken, staged
from rthyb_rt.cli.inputs import JsonOption, RigOption, SetOption, load
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.experiment import Setup
    from rthyb_rt.recording import Recording
    from rthyb_rt.summary import Summary

SCHEMA = "rthyb-run/1"
LIMIT_TRIP = 6


def run(
    test: Annotated[
        Path | None,
        typer.Argument(
            metavar="TEST.toml",
            help="Test file; without one the built-in test runs (Section 5, T = 0.5 s, El Centro).",
            show_default=False,
        ),
    ] = None,
    rig: RigOption = None,
    settings: SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the files of this run, instead of runs/TEST-UTC.",
            show_default=False,
        ),
    ] = None,
    no_report: Annotated[
        bool, typer.Option("--no-report", help="Leave the HTML report out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a hybrid test and write its recording and report.

    The test runs on the virtual rig that the rig file describes, as fast as the PC computes.
    Recording, report and the settings as they were used go to a folder of their own; its
    test.toml runs again as it stands.

    \b
    Examples:
      rthyb run
      rthyb run my-test.toml --rig my-rig.toml
      rthyb run my-test.toml --set ground_motion.pga_g=0.1 --set controller.type=robust
      rthyb run my-test.toml --set rig.actuator.delay_samples=12 --json

    Exit code 6 says that a limit ended the test; recording and report are there all the same.
    """
    from rthyb_rt import experiment, recording, summary

    started = datetime.datetime.now(datetime.UTC)
    test_file, rig_file = load(test, rig, settings)
    setup = experiment.prepare(test_file, rig_file)
    for note in setup.notes:
        terminal.tell(f"note: {note}")
    refuse_taken(out)
    target = out or Path("runs") / f"{test_file.test.name}-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:
        with terminal.progress("Testing", setup.ticks, setup.derived.fs_hz) as progress:
            rec = experiment.run(setup, progress)
        # A test that has been carried out is kept; and HDF5's callbacks would swallow a Ctrl-C.
        with interrupts.held():
            recording.write(stage / recording.FILE_NAME, rec)
            _write_settings(stage, setup, rec)
            folder = publish(stage, target, numbered=out is None)
    result = summary.summarize(rec)
    file = terminal.people(as_json)
    _print_result(setup, result, folder / recording.FILE_NAME, as_json)
    file.flush()
    report = None if no_report else _write_report(rec, folder)
    if report is not None:
        print(f"Report     {report}", file=file)
    if as_json:
        terminal.print_json(_document(result, folder, report))
    if result.end_reason != "completed":
        raise typer.Exit(LIMIT_TRIP)


def _write_settings(folder: Path, setup: Setup, rec: Recording) -> None:
    """Write test and rig as they were used; the test names the rig beside it."""
    from rthyb_rt import config

    test = config.dump(setup.test.model_copy(update={"rig": "rig.toml"}))
    (folder / "test.toml").write_text(test, encoding="utf-8")
    (folder / "rig.toml").write_text(rec.rig_toml, encoding="utf-8")


def _write_report(rec: Recording, folder: Path) -> Path | None:
    """Write the report; without the packages that it needs, say so and go on."""
    from rthyb_rt.report import write_report

    path = folder / "report.html"
    try:
        write_report(rec, path)
    except InputError as error:
        terminal.tell(f"no report written: {error}, then: rthyb report {folder}")
        return None
    return path


# ---- the result ---------------------------------------------------------------------------------


def _print_result(setup: Setup, result: Summary, recording: Path, as_json: bool) -> None:
    from rthyb_rt import summary

    file = terminal.people(as_json)
    print(f"{setup.test.test.name} on {setup.rig.rig.name}: {_motion(setup)}\n", file=file)
    terminal.print_table(summary.table(result), file)
    print(f"\n{summary.verdict(result)}", file=file)
    for notice in summary.notices(result):
        label = "Attention: " if notice.level == "alarm" else "Note: "
        print(f"{label}{notice.text}", file=file)
    print(f"\nRecording  {recording}", file=file)


def _motion(setup: Setup) -> str:
    return f"{setup.motion.name}, PGA {setup.motion.pga_g:.3g} g"


def _document(result: Summary, folder: Path, report: Path | None) -> dict[str, Any]:
    measures = result.as_json()
    identity = {key: measures.pop(key) for key in ("test_name", "end_reason", "setup")}
    return {
        "schema": SCHEMA,
        **identity,
        "measures": measures,
        "paths": {
            "folder": str(folder),
            "recording": str(folder / "recording.h5"),
            "report": str(report) if report else None,
            "test": str(folder / "test.toml"),
            "rig": str(folder / "rig.toml"),
        },
    }
