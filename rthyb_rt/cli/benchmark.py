"""``rthyb benchmark``: the field's benchmark problems, with this program's controllers."""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rthyb_rt.benchmark.benchmark_table import EntrantLine
    from rthyb_rt.benchmark.marths_table import MarthsLine

benchmark = typer.Typer(
    name="benchmark",
    help="Run a published benchmark problem.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@benchmark.callback()
def _benchmarks() -> None:
    """Run a published benchmark problem with this program's controller and virtual rig."""


def _several(what: str, metavar: str) -> typer.models.OptionInfo:
    option: typer.models.OptionInfo = typer.Option(
        metavar=metavar, help=f"{what} Can be repeated.", show_default=False
    )
    return option


MotionOption = Annotated[
    list[str] | None, _several("elcentro, kobe or morgan. Default: elcentro.", "NAME")
]
PlantsOption = Annotated[
    int,
    typer.Option(
        metavar="N", help="Number of perturbed plants in addition to the nominal one, 0 to 20."
    ),
]
WidthOption = Annotated[
    float,
    typer.Option(
        metavar="W", help="Spread of the perturbed plants, as a multiple of the stated deviations."
    ),
]
JobsOption = Annotated[
    int | None,
    typer.Option(
        metavar="N", help="Number of processes. Default: one per processor.", show_default=False
    ),
]


def _check_width(width: float, most: float) -> None:
    if not 0.0 < width <= most:
        raise typer.BadParameter(
            f"found {width:g}; must be above 0, up to {most:g}: a width of 0 would draw the "
            "nominal plant again and again",
            param_hint="--width",
        )


@benchmark.command()
def rths(
    rate: Annotated[
        list[int] | None, _several("Sample rate, 4096 or 1024. Default: both.", "HZ")
    ] = None,
    case: Annotated[list[int] | None, _several("Structure, 1 to 4. Default: all.", "N")] = None,
    law: Annotated[
        list[str] | None,
        _several("Control law, or pi-lead (the benchmark's own). Default: all.", "NAME"),
    ] = None,
    motion: MotionOption = None,
    plants: PlantsOption = 20,
    plant: Annotated[
        list[int] | None,
        _several(
            "Plant by its seed, 7001 to 7020, or 0 for the nominal one, instead of --plants.",
            "SEED",
        ),
    ] = None,
    width: WidthOption = 1.0,
    yielding: Annotated[
        bool, typer.Option("--yielding", help="Use a specimen that yields (Bouc-Wen, 1 mm).")
    ] = False,
    noise: Annotated[
        float,
        typer.Option(
            metavar="X", help="Size of the sensors' noise, as a multiple of the benchmark's."
        ),
    ] = 1.0,
    jobs: JobsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare every control law on the benchmark of Silva et al.

    Silva et al. (2020). Criteria J1 to J9 as in the benchmark's code, over the whole record; then
    the tracking error without sensor noise, and the part of the command above 100 Hz. After the
    slash, the worst plant. Ground motions are scaled by 0.4. docs/benchmark.md explains the
    columns.

    \b
    Examples:
      rthyb benchmark rths --rate 4096 --case 1 --plants 0
      rthyb benchmark rths --law ats --law alpha-beta --jobs 2
      rthyb benchmark rths --yielding --motion kobe --json > kobe.json
    """
    from rthyb_rt.benchmark import benchmark_runs, benchmark_table, cases
    from rthyb_rt.campaign import pools

    _check_width(width, 10.0)
    if not 0.0 <= noise <= 10.0:
        raise typer.BadParameter(f"found {noise:g}; must be from 0 to 10", param_hint="--noise")
    wanted = benchmark_runs.planned(
        law or [one.name for one in cases.entrants()],
        rate or list(cases.RATES),
        case or list(cases.CASES),
        motion or ["elcentro"],
        plant or benchmark_runs.seeds_of(plants),
        width=width,
        yielding=yielding,
        noise=noise,
    )
    with terminal.sections("Benchmark") as progress:
        found = benchmark_runs.measured(
            wanted, pools.processors() if jobs is None else jobs, progress
        )
    print_lines(benchmark_table.lines(found), terminal.people(as_json))
    if as_json:
        terminal.print_json(benchmark_table.document(found))


@benchmark.command()
def marths(
    law: Annotated[
        list[str] | None,
        _several(
            "Compensator: none, lead, lead-decoupled, rodeac, matrix or matrix-inverse. "
            "Default: all.",
            "NAME",
        ),
    ] = None,
    motion: MotionOption = None,
    plants: PlantsOption = 20,
    integrator: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="newmark, as in the benchmark, or kr-alpha, as in this program.",
        ),
    ] = "newmark",
    width: WidthOption = 1.0,
    jobs: JobsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run the multi-axial benchmark: two coupled actuators.

    maRTHS. Criteria J1 to J10 as in the benchmark's code, one number per actuator or degree of
    freedom; then what they do not show: tracking without noise, and the response compared with
    the numerical part and the force model solved as one system. The worst plant is in brackets.
    Ground motions are scaled by 0.4. docs/benchmark-marths.md explains the columns.

    \b
    Examples:
      rthyb benchmark marths --plants 0
      rthyb benchmark marths --law rodeac --law matrix-inverse --motion kobe
      rthyb benchmark marths --integrator kr-alpha --json > marths.json
    """
    from rthyb_rt.benchmark import marths as own
    from rthyb_rt.benchmark import marths_laws, marths_table
    from rthyb_rt.campaign import pools

    _check_width(width, 3.0)
    wanted = own.planned(
        law or list(marths_laws.NAMES), motion or ["elcentro"], plants, integrator, width
    )
    with terminal.sections("Benchmark") as progress:
        found = own.measured(wanted, pools.processors() if jobs is None else jobs, progress)
    print_marths(marths_table.lines(found), terminal.people(as_json))
    if as_json:
        terminal.print_json(marths_table.document(found))


def print_marths(lines: Sequence[MarthsLine], file: IO[str]) -> None:
    """Print results of the multi-axial benchmark, two tables for each motion."""
    from rich.text import Text

    from rthyb_rt.benchmark import marths_table

    for number, motion in enumerate(dict.fromkeys(line.motion for line in lines)):
        terminal.show(Text(f"\n{motion}" if number else motion, style="bold"), file)
        for names in (marths_table.PUBLISHED, marths_table.BESIDE):
            grid = terminal.ruled_table()
            grid.add_column("law", no_wrap=True)
            for head in marths_table.heads(names):
                grid.add_column(head, justify="right", no_wrap=True)
            for line in lines:
                if line.motion == motion:
                    grid.add_row(line.law, *marths_table.cells(line, names))
            terminal.show(grid, file)


def print_lines(lines: Sequence[EntrantLine], file: IO[str]) -> None:
    """Print results, a table for each rate and motion, and the runs that are not counted."""
    from rich.text import Text

    from rthyb_rt.benchmark import benchmark_table

    kinds = list(dict.fromkeys((line.rate_hz, line.motion) for line in lines))
    for number, (rate_hz, motion) in enumerate(kinds):
        title = f"{rate_hz} Hz, {motion}"
        terminal.show(Text(f"\n{title}" if number else title, style="bold"), file)
        _print_kind([one for one in lines if (one.rate_hz, one.motion) == kinds[number]], file)
    for remark in benchmark_table.remarks(lines):
        terminal.show(Text(remark), file)


def _print_kind(lines: Sequence[EntrantLine], file: IO[str]) -> None:

    from rthyb_rt.benchmark import benchmark_table

    grid = terminal.ruled_table()
    grid.add_column("law", no_wrap=True)
    grid.add_column("case", justify="right", no_wrap=True)
    for head in benchmark_table.heads():
        grid.add_column(head, justify="right", no_wrap=True)
    for line in lines:
        grid.add_row(line.entrant, str(line.case), *benchmark_table.cells(line))
    terminal.show(grid, file)
