"""One run of a campaign, in whatever process it is carried out."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from rthyb_rt.campaign.plan import FAILED, STOPPED, Case, Row, program
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import keeping
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import Recording
from rthyb_rt.report import write_report

FOLDERS: Final = "runs"
REPORT: Final = "report.html"


class OtherProgramError(InputError):
    """A process computes with another program than the one that conducts the campaign."""


def carry_out(case: Case, keep: str = "nothing", folder: str = "", wanted: str = "") -> Row:
    """Run one test in virtual time; a run that fails is a row that says why.

    Args:
        case: the run.
        keep: "nothing", "tripped" or "all": of which runs recording and settings are kept.
        folder: of the campaign, for those.
        wanted: `plan.program` of whoever conducts the campaign; "" for any.

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
        # One run of thousands that a fault of this program ends must not end the others.
        return row | {"ending": FAILED, "cause": f"{type(error).__name__}: {error}"}
    if keep == "all" or (keep == "tripped" and row["ending"] == STOPPED):
        row |= _kept(case, setup, rec, Path(folder))
    return row


def _kept(case: Case, setup: Setup, rec: Recording, folder: Path) -> Row:
    """Keep recording, settings and report of a run; return what leads to them."""
    place = folder / FOLDERS / f"{case.number:06d}"
    place.mkdir(parents=True, exist_ok=True)
    keeping.keep(place, setup, rec)
    found: Row = {"folder": str(place.relative_to(folder))}
    with contextlib.suppress(InputError):  # without the packages that a report needs
        write_report(rec, place / REPORT)
        found["report"] = REPORT
    return found
