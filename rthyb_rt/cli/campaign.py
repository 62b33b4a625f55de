"""``rthyb campaign``: one test over lists, grids, seeds and drawn plants."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import JsonOption

if TYPE_CHECKING:
    from rthyb_rt.campaign.groups import RunGroup
    from rthyb_rt.campaign.plan import Measure, Plan
    from rthyb_rt.campaign.whole_campaign import Campaign, Progress

SCHEMA = "rthyb-campaign-result/1"
ENDED_EARLY = 6


OutOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder of the campaign, instead of runs/NAME. An interrupted campaign resumes there.",
        show_default=False,
    ),
]
JobsOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=1024,
        metavar="N",
        help="Processes of this machine; without it as many as it has processors.",
        show_default=False,
    ),
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of a Dask scheduler whose workers carry out the runs, such as "
        "tcp://lab:8786.",
        show_default=False,
    ),
]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="List the runs without carrying them out.")
]


def campaign(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="CAMPAIGN.toml", help="File that says what varies.", show_default=False
        ),
    ],
    out: OutOption = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run one test many times with varied settings.

    The runs are in virtual time. Settings vary over lists, grids, seeds, ground motions and
    randomly drawn plants. Every run is saved as soon as it ends: after Ctrl-C or a power failure,
    the same command resumes where it stopped. The table and the page give medians, worst cases,
    and which runs ended early and why.

    \b
    Examples:
      rthyb campaign examples/campaigns/laws-and-intensities.toml
      rthyb campaign examples/campaigns/laws-and-intensities.toml --dry-run
      rthyb campaign laws.toml --jobs 8 --out laws
      rthyb campaign laws.toml --cluster tcp://lab:8786

    The exit code is 6 if a limit or a trip ended a run, or if a run could not be carried out.
    """
    from rthyb_rt.benchmark.campaigns import read

    refuse_both(jobs, cluster)
    plan = read(file)
    if dry_run:
        print_plan(plan, terminal.people(as_json), as_json)
        return
    carry_out(plan, out or Path("runs") / plan.name, jobs, cluster, as_json)


def refuse_both(jobs: int | None, cluster: str | None) -> None:
    """Refuse a number of local processes together with a cluster."""
    if jobs is not None and cluster is not None:
        raise typer.BadParameter("applies to the processes of this machine; omit it with --cluster",
                                 param_hint="--jobs")  # fmt: skip


def carry_out(
    plan: Plan, folder: Path, jobs: int | None, cluster: str | None, as_json: bool
) -> None:
    """Carry out the runs and print the results; arguments as on the command line."""
    from rthyb_rt.campaign import pools, whole_campaign

    interrupts.wrote(folder)
    with _progress(plan) as progress:
        found = whole_campaign.conduct(
            plan, folder, jobs=jobs or pools.processors(), cluster=cluster, progress=progress
        )
    _print_result(found, terminal.people(as_json))
    if as_json:
        terminal.print_json(_document(found))
    if any(row["ending"] != "completed" for row in found.rows):
        raise typer.Exit(ENDED_EARLY)


@contextmanager
def _progress(plan: Plan) -> Iterator[Progress]:
    with terminal.sections("Campaign") as update:
        yield lambda done, whole: update(done, whole, plan.name)


def print_plan(plan: Plan, file: IO[str], as_json: bool) -> None:
    """Print the runs, each as the command that repeats it."""
    print(f"{plan.name}: {len(plan.cases)} runs", file=file)
    for case in plan.cases:
        print(f"{case.number:6}  {case.command()}", file=file)
    if as_json:
        runs = [{"case": case.number, "command": case.command()} for case in plan.cases]
        terminal.print_json({"schema": SCHEMA, "name": plan.name, "runs": runs})


def _print_result(found: Campaign, file: IO[str]) -> None:
    from rthyb_rt.campaign.groups import group

    groups = group(found.rows, list(found.plan.cases[0].chosen), found.plan.measures)
    done = sum(one.completed for one in groups)
    print(f"{found.plan.name}: {done} of {len(found.plan.cases)} runs completed\n", file=file)
    terminal.show(_grid(groups, found.plan.measures), file)
    causes = [row for row in found.rows if row["ending"] != "completed"]
    for row in causes[:5]:
        print(f"Run {row['case']} {row['ending']}: {row['cause']}", file=file)
    if len(causes) > 5:
        print(f"and {len(causes) - 5} more; the page has all of them", file=file)
    print(file=file)
    for name, path in found.paths.items():
        print(f"{name.capitalize():11}{path}", file=file)
    for note in found.notes:
        terminal.tell(f"note: {note}")


def _grid(groups: list[RunGroup], measures: Sequence[Measure]) -> Any:
    from rich.table import Table

    from rthyb_rt.campaign.campaign_page import value
    from rthyb_rt.campaign.groups import figure

    grid = Table(box=None, pad_edge=False, header_style="bold")
    for key in groups[0].chosen:
        grid.add_column(key, overflow="fold")
    for name in ("Runs", "Early", *(f"{m.label}, {m.unit}" for m in measures)):
        grid.add_column(name, justify="right")
    for one in groups:
        grid.add_row(
            *(value(chosen) for chosen in one.chosen.values()),
            str(one.runs),
            str(one.runs - one.completed),
            *(figure(one.spreads.get(measure.name), measure) for measure in measures),
        )
    return grid


def _document(found: Campaign) -> dict[str, Any]:
    from dataclasses import asdict

    from rthyb_rt.campaign.groups import group

    return {
        "schema": SCHEMA,
        "name": found.plan.name,
        "runs": len(found.plan.cases),
        "groups": [
            asdict(one)
            for one in group(found.rows, list(found.plan.cases[0].chosen), found.plan.measures)
        ],
        "rows": found.rows,
        "paths": {name: str(path) for name, path in found.paths.items()},
        "notes": list(found.notes),
    }
