"""``rthyb replay``: recomputes a recording and compares it bit for bit."""

from __future__ import annotations

import dataclasses

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption, RecordingArgument

SCHEMA = "rthyb-replay/1"
DEPARTS = 8


def replay(recording: RecordingArgument, as_json: JsonOption = False) -> None:
    """Recompute a recording and compare it bit for bit.

    Measured displacement, force and ground motion are taken from the recording. Commands,
    estimates and states are recomputed from the first tick in IDLE, including every fault and
    every command of the operator. The exit code is 0 if the result is identical bit for bit, 8 if
    it differs, and 3 if the recording needs another version of the program.

    \b
    Example:
      rthyb replay runs/section5-t0.5-20260301T101500Z
    """
    from rthyb_rt.lab import realtime
    from rthyb_rt.record.recording import UNITS, open_run

    rec = open_run(recording)
    found = realtime.replay(rec)
    file = terminal.people(as_json)
    if found.identical:
        print(f"bit-identical: {found.rows} samples, every field", file=file)
    else:
        print(
            f"differs from sample {found.first_row} of {found.rows} on, field {found.field}; "
            "largest differences:",
            file=file,
        )
        terminal.print_table(
            [(f"  {name}", f"{gap:.3g} {UNITS[name]}") for name, gap in found.largest.items()], file
        )
    if not found.same_build:
        sources = str(rec.meta.get("core_sources", "?"))[:12]
        known = (rec.meta.get(key, "?") for key in ("core_version", "compiler", "architecture"))
        made = ", ".join([*map(str, known), f"sources {sources}"])
        print(
            f"Note: recorded with another build of the core ({made}); "
            "bit-identical results are guaranteed only for the same build.",
            file=file,
        )
    if as_json:
        terminal.print_json({"schema": SCHEMA, **dataclasses.asdict(found)})
    if not found.identical:
        raise typer.Exit(DEPARTS)
