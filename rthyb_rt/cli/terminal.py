"""What people read: tables, progress, notes; and JSON for machines."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

OnProgress = Callable[[int, int], None]


def print_json(document: dict[str, Any]) -> None:
    """Print a document on stdout; numbers that JSON does not have become null."""
    print(json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def people(as_json: bool) -> IO[str]:
    """Return where text for people goes: stdout belongs to the JSON document, if there is one."""
    return sys.stderr if as_json else sys.stdout


def tell(text: str) -> None:
    """Print a remark on stderr."""
    print(f"rthyb: {text}", file=sys.stderr)


def print_table(rows: Iterable[Sequence[str]], file: IO[str]) -> None:
    """Print rows of label, value and, dimmed where there is room for it, an explanation."""
    from rich.table import Table
    from rich.text import Text

    console = _console(file)
    rows = list(rows)
    needed = sum(max((len(row[i]) for row in rows), default=0) + 2 for i in range(len(rows[0])))
    columns = 2 if needed > console.width else 3
    table = Table.grid(padding=(0, 2, 0, 0))
    for style in ("", "bold", "dim")[:columns]:
        table.add_column(style=style, overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row[:columns]))
    show(table, file)


def show(text: RenderableType, file: IO[str]) -> None:
    """Print what rich lays out, without the blanks at the ends of lines."""
    console = _console(file)
    with console.capture() as capture:
        console.print(text)
    for line in capture.get().splitlines():
        print(line.rstrip(), file=file)


def width(file: IO[str]) -> int:
    """Return how many characters a line may have."""
    return _console(file).width


def _console(file: IO[str]) -> Console:
    """Return a console that writes plain text where nobody sees it, or where NO_COLOR asks."""
    from rich.console import Console

    plain = bool(os.environ.get("NO_COLOR"))
    console = Console(file=file, highlight=False, color_system=None if plain else "auto")
    # A file has no width: a row stays a line.
    return console if console.is_terminal else Console(file=file, highlight=False, width=200)


@contextmanager
def progress(description: str, ticks: int, fs_hz: float) -> Iterator[OnProgress]:
    """Show how far a test is, its rate and the time left, on a terminal's stderr.

    Args:
        description: what is going on.
        ticks: samples of the whole test.
        fs_hz: samples in a second.

    Yields:
        a function of (samples done, samples of the test).
    """
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        """Seconds of the test in a second."""

        def render(self, task: Task) -> Text:
            elapsed = task.finished_time if task.finished else task.elapsed
            rate = task.completed / elapsed if elapsed else 0.0
            return Text(f"{rate:.0f} x real time")

    console = _console(sys.stderr)
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} s"),
        Rate(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(description, total=ticks / fs_hz)

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done / fs_hz, total=total / fs_hz)

        yield update


@contextmanager
def sections(description: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show how far work in named parts is, on a terminal's stderr.

    Args:
        description: what is going on.

    Yields:
        a function of (parts done, parts in all, the part that begins).
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = _console(sys.stderr)
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f}"),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(description, total=1)

        def update(done: int, total: int, part: str) -> None:
            bar.update(task, completed=done, total=total, description=f"{description}: {part}")

        yield update
