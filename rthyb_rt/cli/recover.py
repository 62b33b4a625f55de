"""``rthyb recover``: a recording from the telemetry ring of a test."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.folders import publish, refuse_taken, staged
from rthyb_rt.cli.inputs import JsonOption
from rthyb_rt.errors import RthybError

if TYPE_CHECKING:
    from rthyb_rt.record.ring import RecoveredRecording, Sight

SCHEMA = "rthyb-recover/1"
LIST_SCHEMA = "rthyb-rings/1"


def recover(
    ring: Annotated[
        Path | None,
        typer.Argument(
            metavar="RING",
            help="Ring of a real-time test, ring.*, with its session file beside it. Default: "
            "list the rings.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the recording, instead of runs/TEST-UTC-recovered.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Recover the recording of a killed test.

    The telemetry ring in memory holds the last 64 s of a test, up to the last tick or the one
    before it, even if its process was killed. It does not survive a reboot. The ring and its
    session file are not changed, and a running test is not disturbed.

    Without an argument, lists the rings in /run/rthyb, in $XDG_RUNTIME_DIR/rthyb and in the
    user's folder in /dev/shm: test, age, ticks, and whether a controller is still writing.

    \b
    Examples:
      rthyb recover
      rthyb recover /run/rthyb/ring.1f0c92d4.1
      rthyb recover ring.1f0c92d4.1 --out runs/after-the-crash
    """
    from rthyb_rt.record import recording
    from rthyb_rt.record import ring as rings

    if ring is None:
        if out is not None:
            raise typer.BadParameter("needs a RING; rthyb recover lists them", param_hint="--out")
        _list(as_json)
        return
    refuse_taken(out)
    found = rings.recover(ring)
    target = out or Path("runs") / _name(found)
    with staged(target) as stage, interrupts.held():
        recording.write(stage / recording.FILE_NAME, found.recording)
        folder = publish(stage, target, numbered=out is None)
    file = terminal.people(as_json)
    terminal.print_table(_table(found), file)
    print(f"\nRecording  {folder / recording.FILE_NAME}", file=file)
    if as_json:
        terminal.print_json(_document(found, folder))


def _list(as_json: bool) -> None:
    from rthyb_rt.record import ring as rings

    places = rings.folders()
    found = [rings.look(path) for folder in places for path in _rings_in(folder)]
    file = terminal.people(as_json)
    if found:
        _show(found, file)
    else:
        print(f"No ring in {', '.join(map(str, places))}: nothing to recover.", file=file)
    if as_json:
        terminal.print_json(
            {
                "schema": LIST_SCHEMA,
                "folders": [str(folder) for folder in places],
                "rings": [sight.as_json() for sight in found],
            }
        )


def _rings_in(folder: Path) -> list[Path]:
    from rthyb_rt.record import ring as rings

    try:
        return rings.find(rings.trusted(folder))
    except RthybError as error:
        terminal.tell(str(error))
        return []
    except OSError as error:
        terminal.tell(f"{folder}: cannot be read ({error.strerror or error})")
        return []


def _show(found: list[Sight], file: IO[str]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="")
    for head in ("ring", "test", "age", "ticks", "controller"):
        table.add_column(head, justify="right" if head in ("age", "ticks") else "left")
    for sight in found:
        writes = f"writes ({sight.state})" if sight.alive else "gone"
        row = (str(sight.path), sight.test_name, _age(sight.age_s), str(sight.ticks), writes)
        table.add_row(*map(Text, row))
    terminal.show(table, file)
    for sight in found:
        if sight.fault:
            print(f"Note: {sight.path}: {sight.fault}", file=file)
    left = [sight for sight in found if not sight.alive and not sight.fault]
    if left:
        print(f"\nNext  rthyb recover {left[-1].path}", file=file)


def _age(age_s: float | None) -> str:
    if age_s is None:
        return ""
    for unit, length_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if age_s >= length_s:
            return f"{age_s / length_s:.1f} {unit}"
    return f"{max(age_s, 0.0):.0f} s"


def _name(found: RecoveredRecording) -> str:
    now = datetime.datetime.now(datetime.UTC)
    return f"{found.recording.meta.get('test_name', 'test')}-{now:%Y%m%dT%H%M%SZ}-recovered"


def _table(found: RecoveredRecording) -> list[tuple[str, str, str]]:
    samples = found.recording.samples
    first, last = int(samples["tick"][0]), int(samples["tick"][-1])
    seconds = len(samples) / found.recording.fs_hz
    return [
        ("End", str(found.recording.meta["end_reason"]), ""),
        ("Rows", f"{len(samples)} ({seconds:.3f} s)", f"ticks {first} to {last}"),
        ("Rows missing", _ranges(found.missing_rows), "overwritten or incomplete"),
        ("Ticks missing", _ranges(found.missing_ticks), "between two rows"),
    ]


def _ranges(ranges: list[list[int]]) -> str:
    return ", ".join(f"{first} to {last}" for first, last in ranges) or "none"


def _document(found: RecoveredRecording, folder: Path) -> dict[str, Any]:
    meta = found.recording.meta
    return {
        "schema": SCHEMA,
        "test_name": meta.get("test_name"),
        "end_reason": meta["end_reason"],
        "alive": found.alive,
        "recovered_rows": list(found.rows),
        "missing_rows": found.missing_rows,
        "missing_ticks": found.missing_ticks,
        "paths": {"folder": str(folder), "recording": str(folder / "recording.h5")},
    }
