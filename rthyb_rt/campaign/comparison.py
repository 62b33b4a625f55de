"""One test with all control laws."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from rthyb_rt import config
from rthyb_rt.campaign.one_run import carry_out
from rthyb_rt.campaign.plan import COMPLETED, FAILED, PlannedRun, Row
from rthyb_rt.core.laws import LAWS
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment

LAW: Final = "law"
"""Key of a row that contains the control law."""
TYPE: Final = "controller.type"


def compare(
    test: Path | None,
    rig: str | None,
    settings: Sequence[str],
    names: Sequence[str],
    tell: Callable[[int, int, str], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> list[Row]:
    """Run one test with each control law in virtual time; everything else is as in the files.

    Args:
        test: test file; None: the built-in one.
        rig: rig file or name; None: that of the test.
        settings: ``key=value``, as after ``--set``.
        names: names of the laws, ``controller.type``; none: all laws.
        tell: called with (laws done, number of laws, next law) before each run.
        note: called with each note on values that the rig file omits.

    Returns:
        A row for each law, as `carry_out` returns it, with the law's name at `LAW`: first the
        completed tests in order of their response error, then those that a limit ended, then those
        that a law cannot run.

    Raises:
        InputError: with the errors of the files, an unknown law, or a setting that chooses a law.
    """
    for name in names:
        if name not in LAWS:
            raise InputError(f"found {name!r}; must be one of {', '.join(LAWS)}", "--law")
    if any(setting.partition("=")[0].strip() == TYPE for setting in settings):
        raise InputError(
            f"{TYPE} is varied by the comparison itself; choose the laws with --law", "--set"
        )
    files = config.load_both(test, rig, settings)
    experiment.prepare(*files)
    if note is not None:
        for text in config.omitted(files[1]):
            note(text)
    wanted = list(dict.fromkeys(names)) or list(LAWS)
    rows = []
    for number, name in enumerate(wanted):
        if tell is not None:
            tell(number, len(wanted), name)
        own = (*settings, f"{TYPE}={name}")
        case = PlannedRun(number, {LAW: name}, -1, 0, str(test or ""), rig or "", own)
        rows.append(carry_out(case))
    return sorted(rows, key=_rank)


def _rank(row: Row) -> tuple[int, float]:
    if row["ending"] == FAILED:
        return 2, 0.0
    found = row.get("response_nrmse")
    found = row.get("tracking_nrmse") if found is None else found
    return int(row["ending"] != COMPLETED), math.inf if found is None else float(found)
