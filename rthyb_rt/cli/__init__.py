"""The command line: ``rthyb COMMAND ...``.

Nothing is imported here that Python has not loaded already: a Ctrl-C finds somebody to answer it
from the first moment on.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # as of typing, whose import costs time
if TYPE_CHECKING:
    from collections.abc import Sequence

_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        arguments: what follows the program's name; None takes the process's own.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        from rthyb_rt.cli import program
    except KeyboardInterrupt:
        return _interrupted_early(given)
    try:
        return program.main(given)
    except KeyboardInterrupt:
        # In the moments before and behind those in which signals are looked after.
        print("rthyb: interrupted", file=sys.stderr)
        return _INTERRUPTED


def _interrupted_early(given: list[str]) -> int:
    print("rthyb: interrupted; nothing was written", file=sys.stderr)
    if "--json" in given:
        import json

        found = {"where": f"rthyb {given[0]}", "message": "interrupted; nothing was written"}
        print(json.dumps({"schema": "rthyb-problems/1", "ok": False, "problems": [found]}))
    return _INTERRUPTED
