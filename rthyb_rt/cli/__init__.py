"""The command line: ``rthyb COMMAND ...``.

Imports nothing that Python has not already loaded, so that a Ctrl-C is handled at any time.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # as in typing, which is slow to import
if TYPE_CHECKING:
    from collections.abc import Sequence

_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        arguments: arguments after the program's name; None: those of the process.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        from rthyb_rt.cli import program
    except KeyboardInterrupt:
        return _interrupted_early(given)
    try:
        return program.main(given)
    except KeyboardInterrupt:
        # For the moments before and after those in which signals are handled.
        print("rthyb: interrupted", file=sys.stderr)
        return _INTERRUPTED


def _interrupted_early(given: list[str]) -> int:
    print("rthyb: interrupted; nothing was written", file=sys.stderr)
    if "--json" in given:
        import json

        found = {"where": f"rthyb {given[0]}", "message": "interrupted; nothing was written"}
        print(json.dumps({"schema": "rthyb-problems/1", "ok": False, "problems": [found]}))
    return _INTERRUPTED
