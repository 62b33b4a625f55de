"""One run of a campaign, in whatever process it is carried out."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any, Final

from rthyb_rt import config
from rthyb_rt.analysis import summary
from rthyb_rt.campaign.plan import Case
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record import recording
from rthyb_rt.report import write_report

Row = dict[str, Any]
"""What came of one run: ``case``, what it was chosen and drawn to be, ``ending``, measures."""

COMPLETED, STOPPED, FAILED = "completed", "stopped", "failed"
"""A run reached its end; a limit or a trip ended it; it could not be carried out."""
FOLDERS: Final = "runs"
REPORT: Final = "report.html"
_LEFT_OUT: Final = (
    "test_name",
    "end_reason",
    "interrupted",
    "clock",
    "final_state",
    "ended_by",
    "live",
)


def carry_out(case: Case, keep: str = "nothing", folder: str = "") -> Row:
    """Run one test in virtual time; a run that fails is a row that says why.

    Args:
        case: the run.
        keep: "nothing", "tripped" or "all": of which runs recording and settings are kept.
        folder: of the campaign, for those.

    Returns:
        Its row. Measures have the names and units of ``rthyb run --json``; what is not a number
        there is None.
    """
    row = identity(case)
    try:
        test, rig = config.load_both(Path(case.test) if case.test else None, case.rig or None,
                                     case.settings)  # fmt: skip
        setup = experiment.prepare(test, rig)
        rec = virtual_time.run(setup)
        found = summary.summarize(rec)
    except RthybError as error:
        return row | {"ending": FAILED, "cause": str(error)}
    except (ArithmeticError, ValueError, MemoryError) as error:
        # One run of thousands that a fault of this program ends must not end the others.
        return row | {"ending": FAILED, "cause": f"{type(error).__name__}: {error}"}
    row |= {"ending": COMPLETED if found.end_reason == "completed" else STOPPED}
    row |= {"cause": "" if row["ending"] == COMPLETED else found.ending}
    row |= _measures(found)
    if keep == "all" or (keep == "tripped" and row["ending"] == STOPPED):
        place = Path(folder) / FOLDERS / f"{case.number:06d}"
        place.mkdir(parents=True, exist_ok=True)
        recording.write(place / recording.FILE_NAME, rec)
        written = config.dump(setup.test.model_copy(update={"rig": "rig.toml"}))
        (place / "test.toml").write_text(written, encoding="utf-8")
        (place / "rig.toml").write_text(rec.rig_toml, encoding="utf-8")
        row["folder"] = str(place.relative_to(folder))
        with contextlib.suppress(InputError):  # without the packages that a report needs
            write_report(rec, place / REPORT)
            row["report"] = REPORT
    return row


def identity(case: Case) -> Row:
    """Return the part of a row that says which run it is."""
    row: Row = {"case": case.number, **case.chosen}
    if case.drawn >= 0:
        row["drawn"] = case.drawn
    row["repeat"] = case.repeat
    return row


def _measures(found: summary.Summary) -> Row:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in found.as_json().items()
        if name not in _LEFT_OUT and isinstance(value, (bool, int, float, type(None)))
    }
