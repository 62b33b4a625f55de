"""``rthyb recover``: what a test left in its telemetry ring, as a recording."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.folders import publish, refuse_taken, staged
from rthyb_rt.cli.inputs import JsonOption

if TYPE_CHECKING:
    from rthyb_rt.ring import Recovered

SCHEMA = "rthyb-recover/1"


def recover(
    ring: Annotated[
        Path,
        typer.Argument(
            metavar="RING",
            help="The ring of a real-time test, ring.*; its session file stands beside it.",
            show_default=False,
        ),
    ],
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
    """Make a recording of what a test left in its ring.

    The ring lies in memory and has the last 64 s of a test, up to the last tick or the one before,
    even if its process was killed. It is gone after a reboot. Ring and session stay as they are; a
    test that is running does not notice.

    \b
    Examples:
      rthyb recover /run/rthyb/ring.1f0c92d4.1
      rthyb recover ring.1f0c92d4.1 --out runs/after-the-crash
    """
    from rthyb_rt import recording
    from rthyb_rt import ring as rings

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


def _name(found: Recovered) -> str:
    now = datetime.datetime.now(datetime.UTC)
    return f"{found.recording.meta.get('test_name', 'test')}-{now:%Y%m%dT%H%M%SZ}-recovered"


def _table(found: Recovered) -> list[tuple[str, str, str]]:
    samples = found.recording.samples
    first, last = int(samples["tick"][0]), int(samples["tick"][-1])
    seconds = len(samples) / found.recording.fs_hz
    return [
        ("End", str(found.recording.meta["end_reason"]), ""),
        ("Rows", f"{len(samples)} ({seconds:.3f} s)", f"ticks {first} to {last}"),
        ("Rows missing", _ranges(found.missing_rows), "overwritten, or half written"),
        ("Ticks missing", _ranges(found.missing_ticks), "between two rows"),
    ]


def _ranges(ranges: list[list[int]]) -> str:
    return ", ".join(f"{first} to {last}" for first, last in ranges) or "none"


def _document(found: Recovered, folder: Path) -> dict[str, Any]:
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
