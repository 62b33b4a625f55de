"""The command line: ``rthyb COMMAND ...``.

What a command needs to compute is imported inside it, so that help comes at once.
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Sequence

from rthyb_rt.errors import RthybError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        arguments: what follows the program's name; None takes the process's own.
    """
    _settle_streams()
    try:
        status = _status(arguments)
        sys.stdout.flush()
    except OSError as error:
        # What is still buffered can go nowhere; Python must not try again at its end.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        # A reader that has seen enough is no error to speak of.
        if not isinstance(error, BrokenPipeError):
            _trace()
            print(f"rthyb: {error}", file=sys.stderr)
        return 1
    return status


def _settle_streams() -> None:
    """Make printing safe: a closed stream or a character it does not know must not end a test."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _status(arguments: Sequence[str] | None) -> int:
    try:
        # In here, so that an interrupt during the import ends as quietly as any other.
        from rthyb_rt.cli.commands import app

        app(args=arguments, prog_name="rthyb")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    except KeyboardInterrupt:
        return 130
    except OSError:
        raise
    except RthybError as error:
        _trace()
        for line in str(error).splitlines():
            print(f"rthyb: {line}", file=sys.stderr)
        return error.exit_code
    except Exception as error:
        _trace()
        print(
            f"rthyb: internal error: {type(error).__name__}: {error}\n"
            "rthyb: this is a fault of the program, please report it together with what the same "
            "command prints after RTHYB_TRACEBACK=1",
            file=sys.stderr,
        )
        return 1
    return 0


def _trace() -> None:
    if os.environ.get("RTHYB_TRACEBACK"):
        traceback.print_exc()
