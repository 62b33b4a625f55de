"""``rthyb run`` for a rig of several axes."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.folders import publish, refuse_taken, report_beside, staged

if TYPE_CHECKING:
    from rthyb_rt.analysis.several_axes import AxesSummary
    from rthyb_rt.lab.experiment import Progress, Setup
    from rthyb_rt.record.recording import RecordedTest

    Keep = Callable[[RecordedTest], Path]
    Conduct = Callable[[Setup, Progress, Keep], tuple[RecordedTest, Path]]

SCHEMA: Final = "rthyb-run/1"
LIMIT_TRIP: Final = 6
UNPUNCTUAL: Final = 7


def run(
    setup: Setup, out: Path | None, conduct: Conduct | None, *, report: bool, as_json: bool
) -> None:
    """Run the test, save it and print its results.

    Args:
        setup: the test.
        out: folder for the files of the run; None: a new one.
        conduct: runs it in real time, or with faults, and saves it; None: in virtual time.
        report, as_json: whether to write a report, and whether to print JSON.

    Raises:
        RthybError: as raised by ``conduct``.
    """
    from rthyb_rt.lab import storing, virtual_time

    started = datetime.datetime.now(datetime.UTC)
    refuse_taken(out)
    target = out or Path("runs") / f"{setup.test.test.name}-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:

        def keep(rec: RecordedTest) -> Path:
            with interrupts.held():
                storing.store(stage, setup, rec)
                return publish(stage, target, numbered=out is None)

        with terminal.progress("Testing", setup.ticks, setup.derived.fs_hz) as progress:
            if conduct is not None:
                rec, folder = conduct(setup, progress, keep)
            else:
                rec = virtual_time.run(setup, progress)
        if conduct is None:
            folder = keep(rec)
    _print_outcome(setup, rec, folder, report=report, as_json=as_json)
    status = _status(rec)
    if status:
        raise typer.Exit(status)


def _status(rec: RecordedTest) -> int:
    """Return the exit status: a stop by the operator is a regular end of a real-time test."""
    from rthyb_rt.lab.realtime import TIMING_CAUSES

    if rec.meta["end_reason"] == "completed":
        return 0
    station = rec.meta["station"]
    if "real_time" in rec.meta:
        if station["cause"] in TIMING_CAUSES:
            return UNPUNCTUAL
        if station["state"] != "TRIPPED" and station["cause"] in ("operator", "none"):
            return 0
    return LIMIT_TRIP


def _print_outcome(
    setup: Setup, rec: RecordedTest, folder: Path, *, report: bool, as_json: bool
) -> None:
    from rthyb_rt.analysis import several_axes as measured
    from rthyb_rt.analysis.notices import omission_notices

    file = terminal.people(as_json)
    motion = f"{setup.motion.name}, PGA {setup.motion.pga_g:.3g} g"
    print(f"{setup.test.test.name} on {setup.rig_file.rig.name}: {motion}\n", file=file)
    result = measured.summarize(rec) if rec.running().any() else None
    if result is None:
        print(f"The test did not complete: {rec.meta['end_reason']}.", file=file)
    else:
        # What the rig file omits was told before the test.
        told = omission_notices(result.omitted)
        notices = [notice for notice in measured.notices(result) if notice not in told]
        terminal.print_result(notices, measured.table(result), measured.verdict(result), file)
        print(f"Note: not computed: {measured.NOT_COMPUTED}", file=file)
    print(f"\nRecording  {folder / 'recording.h5'}", file=file)
    page = report_beside(rec, folder) if report and result is not None else None
    if page is not None:
        print(f"Report     {page}", file=file)
    if as_json:
        terminal.print_json(_document(rec, result, folder, page))


def _document(
    rec: RecordedTest, result: AxesSummary | None, folder: Path, report: Path | None
) -> dict[str, Any]:
    from rthyb_rt.analysis import several_axes as measured

    notices = [] if result is None else measured.notices(result)
    return {
        "schema": SCHEMA,
        "test_name": rec.meta["test_name"],
        "end_reason": rec.meta["end_reason"],
        "notices": [notice._asdict() for notice in notices],
        "measures": None if result is None else result.as_json(),
        "paths": {
            "folder": str(folder),
            "recording": str(folder / "recording.h5"),
            "report": None if report is None else str(report),
        },
    }
