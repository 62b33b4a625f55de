"""``rthyb run`` of a test on a rig of several axes, in virtual time."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.folders import publish, refuse_taken, report_beside, staged
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.analysis.several import AxesSummary
    from rthyb_rt.config import AxesRig, TestFile

SCHEMA: Final = "rthyb-run/1"
LIMIT_TRIP: Final = 6


def run(
    test: TestFile, rig: AxesRig, out: Path | None, refused: str, *, report: bool, as_json: bool
) -> None:
    """Run the test, keep it, print what it came to.

    Args:
        test, rig: the two files.
        out: folder for the files of the run; None: one of its own.
        refused: an option that was given and is not for several axes; "": none.
        report, as_json: whether to write a report, and to print JSON.

    Raises:
        InputError: what is wrong with the files, or that option.
    """
    from rthyb_rt.analysis import several as measured
    from rthyb_rt.lab import keeping, several, virtual_time

    if refused:
        raise InputError(
            f'rig "{rig.rig.name}" has several axes ({", ".join(rig.names)}), which are tested in '
            f"virtual time without faults; leave {refused} out",
            refused,
        )
    started = datetime.datetime.now(datetime.UTC)
    setup = several.prepare(test, rig)
    for note in setup.notes:
        terminal.tell(f"note: {note}")
    refuse_taken(out)
    target = out or Path("runs") / f"{test.test.name}-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:
        with terminal.progress("Testing", setup.ticks, setup.derived.fs_hz) as progress:
            rec = virtual_time.run(setup, progress)
        with interrupts.held():
            keeping.keep(stage, setup, rec)
            folder = publish(stage, target, numbered=out is None)
    result = measured.summarize(rec)
    file = terminal.people(as_json)
    motion = f"{setup.motion.name}, PGA {setup.motion.pga_g:.3g} g"
    print(f"{result.test_name} on {result.rig_name}: {motion}\n", file=file)
    terminal.print_table(measured.table(result), file)
    print(f"\n{measured.verdict(result)}", file=file)
    print(f"Note: not computed: {measured.NOT_COMPUTED}", file=file)
    print(f"\nRecording  {folder / 'recording.h5'}", file=file)
    page = report_beside(rec, folder) if report else None
    if page is not None:
        print(f"Report     {page}", file=file)
    if as_json:
        terminal.print_json(_document(result, folder, page))
    if result.end_reason != "completed":
        raise typer.Exit(LIMIT_TRIP)


def _document(result: AxesSummary, folder: Path, report: Path | None) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "test_name": result.test_name,
        "end_reason": result.end_reason,
        "measures": result.as_json(),
        "paths": {
            "folder": str(folder),
            "recording": str(folder / "recording.h5"),
            "report": None if report is None else str(report),
        },
    }
