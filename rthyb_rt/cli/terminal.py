"""Output for people: tables, progress, notes; and JSON for programs."""

from __future__ import annotations

import json
import os
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any

from rthyb_rt.cli import streams
from rthyb_rt.documents import finite

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table

    from rthyb_rt.analysis.notices import Notice

OnProgress = Callable[[int, int], None]

_BAR_ROOM = 64
"""Width of a line from which progress includes a bar and a rate."""

_VALUE_ROOM = 28
"""Width that a value needs beside its label, unless it is shorter."""


_state = {"json": False}


def begin() -> None:
    """Reset the record of what an earlier command of this process printed."""
    _state["json"] = False


def has_json() -> bool:
    """Return whether the command has printed JSON: a document, or lines of them."""
    return _state["json"]


def begin_json_lines() -> None:
    """Note that from now on every line on stdout is a separate document."""
    _state["json"] = True


def print_json(document: dict[str, Any]) -> None:
    """Print a document on stdout; non-finite numbers become null."""
    text = json.dumps(finite(document), indent=2, ensure_ascii=False, allow_nan=False)
    if streams.shown(sys.stdout, text) != text:
        text = json.dumps(finite(document), indent=2, allow_nan=False)
    _state["json"] = True
    print(text)


def people(as_json: bool) -> IO[str]:
    """Return the stream for human-readable text: stderr if stdout carries JSON."""
    return sys.stderr if as_json else sys.stdout


def tell(text: str) -> None:
    """Print a remark on stderr."""
    print(f"rthyb: {text}", file=sys.stderr)


def print_table(rows: Iterable[Sequence[str]], file: IO[str]) -> None:
    """Print rows of label, value and, if there is room, a dimmed explanation.

    If even label and value do not fit, the value is printed below its label.
    """
    from rich.table import Table
    from rich.text import Text

    console = _console(file)
    rows = [[streams.shown(file, cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in rows) + 2 for i in range(len(rows[0]))]
    columns = 2 if sum(widths) > console.width else 3
    table = Table.grid(padding=(0, 2, 0, 0))
    for style in ("", "bold", "dim")[:columns]:
        table.add_column(style=style, overflow="fold", no_wrap=not style)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row[:columns]))
    if widths[0] + min(widths[1], _VALUE_ROOM) > console.width:
        _print_stacked(table, console.width, file)
    else:
        show(table, file)


def print_result(
    notices: Sequence[Notice], rows: Iterable[Sequence[str]], verdict: str, file: IO[str]
) -> None:
    """Print the results of a test.

    Alarms come first, because they may invalidate the figures below them.
    """
    alarms = [f"Attention: {notice.text}" for notice in notices if notice.level == "alarm"]
    if alarms:
        print(*alarms, "", sep="\n", file=file)
    print_table(rows, file)
    print(f"\n{verdict}", file=file)
    for notice in notices:
        if notice.level == "note":
            print(f"Note: {notice.text}", file=file)


def ruled_table() -> Table:
    """Return an empty table with many columns: a rule below its heads, no frame."""
    from rich import box
    from rich.table import Table

    return Table(
        box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1), pad_edge=False, header_style="dim"
    )


def show(text: RenderableType, file: IO[str]) -> None:
    """Print what rich lays out, without trailing blanks.

    If a table is too wide for the terminal, its rows are printed one after another.
    """
    from rich.measure import Measurement
    from rich.table import Table

    console = _console(file)
    free = console.options.update(width=1000)
    if isinstance(text, Table) and Measurement.get(console, free, text).minimum > console.width:
        _print_stacked(text, console.width, file)
        return
    with console.capture() as capture:
        console.print(text)
    for line in capture.get().splitlines():
        print(line.rstrip(), file=file)


def _print_stacked(table: Table, room: int, file: IO[str]) -> None:
    """Print the first cell of each row, with the others and their heads below it."""
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        for number, (column, cell) in enumerate(zip(table.columns, cells, strict=True)):
            text = " ".join(str(cell).split())
            head = str(column.header)
            if not text:
                continue
            print(
                textwrap.fill(
                    f"{head}: {text}" if head else text,
                    room,
                    initial_indent="  " if number else "",
                    subsequent_indent="    " if number else "",
                    break_long_words=False,
                    break_on_hyphens=False,
                ),
                file=file,
            )


def width(file: IO[str]) -> int:
    """Return the width of a line in characters."""
    return _console(file).width


def _console(file: IO[str]) -> Console:
    """Return a console; plain text if the output is not a terminal, or for NO_COLOR."""
    from rich.console import Console

    plain = bool(os.environ.get("NO_COLOR"))
    console = Console(file=file, highlight=False, color_system=None if plain else "auto")
    # A file has no width: each row stays on one line.
    return console if console.is_terminal else Console(file=file, highlight=False, width=200)


@contextmanager
def progress(description: str, ticks: int, fs_hz: float) -> Iterator[OnProgress]:
    """Show the progress of a test, its rate and the remaining time, on a terminal's stderr.

    Args:
        description: what is being done.
        ticks: samples of the whole test.
        fs_hz: samples per second.

    Yields:
        A function of (samples done, samples of the test).
    """
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column
    from rich.text import Text

    class CasesPerSecond(ProgressColumn):
        """Seconds of the test per second."""

        def render(self, task: Task) -> Text:
            elapsed = task.finished_time if task.finished else task.elapsed
            rate = task.completed / elapsed if elapsed else 0.0
            return Text(f"{rate:.0f} x real time")

    console = _console(sys.stderr)
    whole = Column(no_wrap=True)
    columns = [
        TextColumn("{task.description}", markup=False),
        TextColumn("{task.completed:.0f} of {task.total:.0f} s"),
        TimeRemainingColumn(table_column=whole),
    ]
    if console.width >= _BAR_ROOM:
        columns.insert(1, BarColumn(min(40, console.width - _BAR_ROOM + 10)))
        columns.insert(3, CasesPerSecond(table_column=whole))
    with Progress(
        *columns,
        console=console,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(description, total=ticks / fs_hz)

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done / fs_hz, total=total / fs_hz)

        yield update


@contextmanager
def sections(description: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show the progress of work with named parts, on a terminal's stderr.

    Args:
        description: what is being done.

    Yields:
        A function of (parts done, number of parts, current part).
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    console = _console(sys.stderr)
    columns = [
        TextColumn("{task.description}", markup=False),
        TextColumn("{task.completed:.0f} of {task.total:.0f}"),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
    ]
    if console.width >= _BAR_ROOM:
        columns.insert(1, BarColumn(min(40, console.width - _BAR_ROOM + 10)))
    with Progress(
        *columns,
        console=console,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(description, total=1)

        def update(done: int, total: int, part: str) -> None:
            bar.update(task, completed=done, total=total, description=f"{description}: {part}")

        yield update
