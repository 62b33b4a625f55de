"""A campaign from its file to its table and page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rthyb_rt.campaign import campaign_page, campaign_tables, pools
from rthyb_rt.campaign.book import Book
from rthyb_rt.campaign.groups import group
from rthyb_rt.campaign.plan import Plan, Row
from rthyb_rt.errors import InputError

Progress = Callable[[int, int], None]
"""Called with the number of runs that are done, and the number of all runs."""


@dataclass(frozen=True)
class Campaign:
    """Result of a campaign.

    Attributes:
        plan: its runs.
        rows: rows of the runs that are done, by number.
        paths: paths of its files, by kind.
        notes: values that a rig file omits, and files that were not written and how to obtain
            them.
    """

    plan: Plan
    rows: list[Row]
    paths: dict[str, Path]
    notes: tuple[str, ...]


def conduct(
    plan: Plan,
    folder: Path,
    *,
    jobs: int = 1,
    cluster: Any = None,
    progress: Progress = lambda done, whole: None,
) -> Campaign:
    """Carry out the runs that are missing in a folder, and write table and page.

    Args:
        plan: the campaign.
        folder: its folder; runs of an interrupted campaign that are done there are kept.
        jobs: number of processes on this machine.
        cluster: address of a Dask scheduler, or a client of it, whose workers are used instead.
        progress: called after each run.

    Raises:
        InputError: the folder contains something else, or the cluster does not answer.
        RthybError: a file cannot be written.
    """
    with Book(folder, plan) as book:
        whole = len(plan.cases)
        progress(len(book.rows), whole)

        def done(row: Row) -> None:
            book.add(row)
            progress(len(book.rows), whole)

        cases = book.left
        place = str(folder.resolve())
        if cases and cluster is not None:
            pools.on_cluster(cases, cluster, plan.keep, place, done)
        elif cases:
            pools.locally(cases, jobs, plan.keep, place, done)
        return _written(plan, book.in_order(), folder)


def _written(plan: Plan, rows: list[Row], folder: Path) -> Campaign:
    paths, notes = {"table": folder / campaign_tables.CSV}, list(plan.notes)
    campaign_tables.write_csv(rows, folder / campaign_tables.CSV)
    groups = group(rows, list(plan.cases[0].chosen), plan.measures)
    campaign_tables.write_csv(
        campaign_tables.statistics(groups, plan.measures), folder / campaign_tables.STATISTICS, ()
    )
    paths["statistics"] = folder / campaign_tables.STATISTICS
    if campaign_tables.write_parquet(rows, folder / campaign_tables.PARQUET):
        paths["parquet"] = folder / campaign_tables.PARQUET
    else:
        notes.append(
            "no Parquet table was written; install pyarrow with pip install 'rthyb-rt[campaign]'"
        )
    try:
        campaign_page.write(plan, rows, folder)
        paths["page"] = folder / campaign_page.PAGE
    except InputError as error:
        notes.append(f"no page was written: {error}")
    return Campaign(plan, rows, paths, tuple(notes))
