"""``rthyb jitter``: measures how punctual this PC is."""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.folders import publish, refuse_taken, staged
from rthyb_rt.cli.inputs import JsonOption
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.config import Rate
    from rthyb_rt.lab.punctuality import JitterResult, PunctualityVerdict

UNFIT = 7
PAGE, RESULTS = "jitter.html", "jitter.json"
LONGEST_S = 86400.0


def jitter(
    seconds: Annotated[
        float, typer.Option(metavar="N", help="Length of each of the five runs in seconds.")
    ] = 15.0,
    rate: Annotated[
        int,
        typer.Option(
            metavar="HZ", min=256, max=4096, help="Sample rate of your drive, 256 to 4096 Hz."
        ),
    ] = 1024,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the page and the results, instead of runs/jitter-UTC.",
            show_default=False,
        ),
    ] = None,
    require: Annotated[
        bool, typer.Option("--require", help="Exit with code 7 if this PC is not good enough.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure how well this PC keeps time in real time.

    A thread computes one sample of the built-in test per tick, with and without data exchange over
    a link, a telemetry reader, or busy Python code at the same time. A bare reference thread runs
    alongside. Run this as the user, and under the load, of your tests. The longer it
    runs, the rarer the disturbances that it can find. It says what to change if this PC is not good
    enough.

    \b
    Examples:
      rthyb jitter
      rthyb jitter --seconds 900 --require
      rthyb jitter --rate 2048
    """
    from rthyb_rt.config import Rate
    from rthyb_rt.lab import punctuality

    if not 1.0 / rate <= seconds <= LONGEST_S:
        raise typer.BadParameter(
            f"found {seconds:g}; must be from one tick to {LONGEST_S:g} s (a day)",
            param_hint="--seconds",
        )
    refuse_taken(out)
    started = datetime.datetime.now(datetime.UTC)
    facts = punctuality.machine_facts()
    results = _measure_all(seconds, Rate(float(rate)), punctuality.choose_cpu(facts))
    verdict = punctuality.judge(results, facts)
    document = {
        "created_utc": started.isoformat(timespec="seconds"),
        **punctuality.document(results, facts, verdict),
    }
    target = out or Path("runs") / f"jitter-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:
        has_page = _write(stage, document, results, facts, verdict)
        folder = publish(stage, target, numbered=out is None)
    paths = {"results": str(folder / RESULTS)}
    if has_page:
        paths["page"] = str(folder / PAGE)
    file = terminal.people(as_json)
    _print_result(results, facts, verdict, file)
    print(
        "", *(f"{name.capitalize():9}{path}" for name, path in paths.items()), sep="\n", file=file
    )
    if as_json:
        terminal.print_json({**document, "paths": paths})
    if require and not verdict.fit:
        raise typer.Exit(UNFIT)


def _measure_all(seconds: float, rate: Rate, cpu: int) -> list[JitterResult]:
    from rthyb_rt.lab import punctuality

    load, ticks = punctuality.Load.built_in(rate), round(seconds * rate.hz)
    results: list[JitterResult] = []
    total = ticks * len(punctuality.CASES)
    with terminal.progress("Timing", total, rate.hz) as progress:
        for case in punctuality.CASES:

            def follow(done: int, _: int, before: int = ticks * len(results)) -> None:
                progress(before + min(done, ticks), total)

            results.append(punctuality.measure(case, ticks, load, cpu, follow))
    return results


def _write(
    folder: Path,
    document: dict[str, Any],
    results: Sequence[JitterResult],
    facts: dict[str, Any],
    verdict: PunctualityVerdict,
) -> bool:
    """Write the results, then the page; False if the packages that it needs are missing."""
    from rthyb_rt.report.punctuality_page import write_page

    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / RESULTS).write_text(text + "\n", encoding="utf-8")
    try:
        write_page(results, facts, verdict, folder / PAGE)
    except InputError as error:
        terminal.tell(f"no page was written: {error}")
        return False
    return True


# ---- human-readable output ----------------------------------------------------------------------


def _print_result(
    results: Sequence[JitterResult],
    facts: dict[str, Any],
    verdict: PunctualityVerdict,
    file: IO[str],
) -> None:

    from rthyb_rt.lab.punctuality import criterion
    from rthyb_rt.report.punctuality_page import fact_rows, figure_row, obtained

    shown = ("kernel", "preemption", "cpu", "virtual machine", "governor", "isolated cpus")
    rows = [row for row in fact_rows(facts) if row[0] in shown]
    terminal.print_table([(*row, "") for row in (*rows, obtained(results))], file)
    grid = terminal.ruled_table()
    grid.add_column("times in µs", overflow="fold")
    for head in ("p50", "p99", "longest", "reference p99", "ratio", "to sent p99", "skipped"):
        grid.add_column(head, justify="right")
    for result in results:
        grid.add_row(*figure_row(result))
    print("", file=file)
    terminal.show(grid, file)
    for result in results:
        if result.attempts > 1:
            late = "in each of them" if result.disturbed else "before"
            print(
                f"Note: {result.case.title}: run {result.attempts} times, because the reference "
                f"thread was over 10 ms late {late}",
                file=file,
            )
    print(f"\n{verdict.sentence}", file=file)
    for what, how in verdict.remedies:
        print(f"  {what}: {how}", file=file)
    print(f"A PC is fit if: {criterion(results[0].rate)}.", file=file)
