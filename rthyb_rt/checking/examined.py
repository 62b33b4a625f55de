"""The complete result of a check of a test and its rig."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

from rthyb_rt.analysis import loop_stability
from rthyb_rt.analysis.loop_roots import LoopVerdict
from rthyb_rt.checking import check_tables, facts, remarks
from rthyb_rt.checking.check_figures import Figures, figures_of
from rthyb_rt.checking.checked_history import HistoryFigures, figures_of_history, rows_of_history
from rthyb_rt.config import RigFile, TestFile
from rthyb_rt.lab import braking, experiment
from rthyb_rt.lab.braking import RunOn
from rthyb_rt.lab.experiment import Setup

SCHEMA: Final = "rthyb-check/1"


@dataclass(frozen=True)
class Examined:
    """Result of a check of a test.

    Attributes:
        setup: the test, ready to run.
        figures: figures derived from test and rig.
        loop: roots and margins of the loop; None if the rig's response is not known.
        runs_on: largest overshoot of a HOLD, a STOP or a ramp-out.
        limits: effective limits and their origin.
        link, commissioning: of the rig; None for a rig without a link.
        factors: calibration factors of the rig.
        notes, warnings: information, and problems that should be corrected.
    """

    setup: Setup
    figures: Figures | HistoryFigures
    loop: LoopVerdict | None
    runs_on: RunOn
    limits: list[dict[str, Any]]
    link: dict[str, Any] | None
    commissioning: dict[str, Any] | None
    factors: dict[str, float]
    notes: list[str]
    warnings: list[str]

    def document(self) -> dict[str, Any]:
        """Return the result as a JSON document."""
        return {
            "schema": SCHEMA,
            "ok": True,
            "test_name": self.setup.test.test.name,
            "rig_name": self.setup.rig.rig.name,
            "figures": asdict(self.figures),
            "run_on": asdict(self.runs_on),
            "loop": None if self.loop is None else asdict(self.loop),
            "limits": self.limits,
            "link": self.link,
            "commissioning": self.commissioning,
            "calibration": self.factors,
            "notes": self.notes,
            "warnings": self.warnings,
        }

    def tables(self) -> list[list[tuple[str, str, str]]]:
        """Return the tables that are not empty: quantity, value, explanation."""
        setup = self.setup
        all_tables = (
            self._first_rows(),
            check_tables.link_rows(self.link),
            check_tables.commissioning_rows(self.commissioning),
            check_tables.calibration_rows(self.factors),
            check_tables.limit_rows(self.limits, linked=setup.rig.link is not None),
            check_tables.run_on_rows(self.runs_on),
        )
        return [list(rows) for rows in all_tables if rows]

    def _first_rows(self) -> list[tuple[str, str, str]]:
        if isinstance(self.figures, HistoryFigures):
            return rows_of_history(self.setup, self.figures)
        rows = check_tables.rows_of_test(self.setup, self.figures)
        found = self.setup.rig.identified
        swept = found is not None and bool(found.frequency_hz)
        return [*rows, *check_tables.loop_rows(self.loop, swept=swept)]


def examine(test_file: TestFile, rig_file: RigFile, rig: str | None = None) -> Examined:
    """Check a test on a rig.

    Args:
        test_file, rig_file: the two files.
        rig: path or name of the rig, from which its commissioning is found.

    Raises:
        InputError: with all inconsistencies between them.
    """
    real_time = rig_file.link is not None and test_file.test.sample_rate_hz == rig_file.rate.hz
    setup = experiment.prepare(test_file, rig_file, real_time=real_time)
    figures = figures_of(setup) if setup.plan is None else figures_of_history(setup)
    runs_on = braking.run_on(setup)
    loop = loop_stability.judge(setup)
    commissioning = None if rig is None else facts.commissioning_of(setup.rig, rig)
    notes, warnings = remarks.remarks(setup, figures)
    warnings += remarks.run_on_warnings(setup, figures, runs_on)
    warnings += loop_stability.remarks(setup, loop)
    if loop is not None and loop.unstable and loop_stability.is_real(setup):
        warnings.append("a test in real time will be refused: the loop is unstable")
    if commissioning is not None and commissioning["why_not"]:
        warnings.append(f"a test in real time will be refused: {commissioning['why_not']}")
    return Examined(
        setup=setup,
        figures=figures,
        loop=loop,
        runs_on=runs_on,
        limits=facts.limits_of(setup),
        link=facts.link_of(setup.rig),
        commissioning=commissioning,
        factors=facts.calibration_of(setup.rig),
        notes=notes,
        warnings=warnings,
    )
