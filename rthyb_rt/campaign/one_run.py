"""One run of a campaign, in any process."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Final

from rthyb_rt.campaign.plan import FAILED, STOPPED, PlannedRun, Row, program
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import storing
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import write_report

FOLDERS: Final = "runs"
REPORT: Final = "report.html"


class OtherProgramError(InputError):
    """A process has another program than the process that conducts the campaign."""


def carry_out(case: PlannedRun, keep: str = "nothing", folder: str = "", wanted: str = "") -> Row:
    """Run one test in virtual time; a run that fails gives a row that says why.

    Args:
        case: the run.
        keep: "nothing", "tripped" or "all": the runs whose recordings and settings are kept.
        folder: folder of the campaign, for these.
        wanted: `plan.program` of the conducting process; "" accepts any.

    Raises:
        OtherProgramError: this process has another core, and with it other control laws.
    """
    if wanted and program() != wanted:
        raise OtherProgramError(
            f"a process of the campaign has rthyb_rt {program()}, but the campaign was started "
            f"with {wanted}: install the same sources everywhere, and do not change them while a "
            "campaign is running"
        )
    row = case.identity()
    try:
        setup = case.prepared()
        rec = case.recorded(setup)
        row |= case.measured(setup, rec)
    except RthybError as error:
        return row | {"ending": FAILED, "cause": str(error)}
    except (ArithmeticError, ValueError, MemoryError) as error:
        # An internal error in one of thousands of runs must not end the others.
        return row | {"ending": FAILED, "cause": f"{type(error).__name__}: {error}"}
    if keep == "all" or (keep == "tripped" and row["ending"] == STOPPED):
        row |= _kept(case, setup, rec, Path(folder))
    return row


def _kept(case: PlannedRun, setup: Setup, rec: RecordedTest, folder: Path) -> Row:
    """Store recording, settings and report of a run; return the links to them."""
    place = folder / FOLDERS / f"{case.number:06d}"
    shutil.rmtree(place, ignore_errors=True)  # what a process began that was killed
    place.mkdir(parents=True, exist_ok=True)
    storing.store(place, setup, rec)
    found: Row = {"folder": str(place.relative_to(folder))}
    with contextlib.suppress(InputError):  # without the packages that a report needs
        write_report(rec, place / REPORT)
        found["report"] = REPORT
    return found
