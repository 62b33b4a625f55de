"""The paper's studies, figure by figure, with accepted bands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from rthyb_rt.studies.results import Study

Which = Literal["2.1", "4.1", "4.2", "5", "all"]
SECTIONS: Final[tuple[Which, ...]] = ("2.1", "4.1", "4.2", "5")

Progress = Callable[[int, int, str], None]
"""Called with sections done, total sections, and the next one."""


def run(
    which: Which = "all", record: str | Path | None = None, progress: Progress | None = None
) -> list[Study]:
    """Reproduce one section of Chen & Tsai (2012), or all.

    Args:
        which: section as numbered in the paper.
        record: file of the ground motion TCU068 EW for Section 4.2; None: it is taken from the
            package pyslammer, or omitted if that is not installed.
        progress: called before each section and at the end.

    Returns:
        The studies in the order of the paper.

    Raises:
        InputError: ``record`` cannot be read.
    """
    from rthyb_rt.studies import estimator, inelastic, stability, table_tests

    makers: dict[str, Callable[[], Study]] = {
        "2.1": stability.study,
        "4.1": estimator.study,
        "4.2": lambda: inelastic.study(record),
        "5": table_tests.study,
    }
    wanted = SECTIONS if which == "all" else (which,)
    studies: list[Study] = []
    for section in wanted:
        if progress is not None:
            progress(len(studies), len(wanted), f"Section {section}")
        studies.append(makers[section]())
    if progress is not None:
        progress(len(wanted), len(wanted), "done")
    return studies
