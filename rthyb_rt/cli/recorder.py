"""``rthyb recorder``: the service's recorder as a separate process."""

from __future__ import annotations

import select
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import interrupts

if TYPE_CHECKING:
    from rthyb_rt.service.ring_recorder import Recorder


def recorder(
    rings: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the rings, instead of /run/rthyb or the user's own.",
            show_default=False,
        ),
    ] = None,
    runs: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the recordings.")] = Path(
        "runs"
    ),
    parent: Annotated[
        bool, typer.Option("--parent", help="Exit when stdin is closed and every test is recorded.")
    ] = False,
) -> None:
    """Record the tests of `rthyb serve`.

    Reads the telemetry ring, writes one folder per test, and adds a line for it to index.jsonl. If
    it is killed and started again, it resumes where it stopped. `rthyb serve` normally starts its
    own recorder; under systemd the recorder is a separate unit, which outlives the service.

    \b
    Examples:
      rthyb recorder --runs /var/lib/rthyb
    """
    from rthyb_rt.record import ring
    from rthyb_rt.service import ring_recorder, systemd

    stops: list[bool] = []
    ready: list[bool] = []

    def done(working: Recorder) -> bool:
        if not ready:
            ready.append(systemd.notify("READY=1"))
        if stops:
            return True
        return parent and not working.busy and _orphaned()

    with systemd.logging_to_stderr(), interrupts.on_interrupt(lambda: stops.append(True)):
        ring_recorder.run(rings or ring.default_folder(), runs, done)


def _orphaned() -> bool:
    """Return whether the parent process has closed its end of stdin."""
    readable, _, _ = select.select([sys.stdin.fileno()], [], [], 0.0)
    return bool(readable)
