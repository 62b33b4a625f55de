"""The command line: ``rthyb COMMAND ...``.

What a command needs to compute is imported inside it, so that help comes at once.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Sequence

from rthyb_rt.cli import interrupts, streams
from rthyb_rt.errors import InputError, Problem, RthybError

INTERRUPTED = 128 + signal.SIGINT


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        arguments: what follows the program's name; None takes the process's own.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    with streams.settled() as outlet, interrupts.orderly():
        status = _status(given)
        signum = interrupts.received()
        if signum is not None or status == INTERRUPTED:
            signum = signum or signal.SIGINT
            how = "interrupted" if signum == signal.SIGINT else f"ended by {_name(signum)}"
            print(f"rthyb: {how}; {interrupts.written()}", file=sys.stderr)
            return 128 + signum
        sys.stdout.flush()
        # A reader that has seen enough is no error to speak of.
        if outlet is not None and outlet.fault and not isinstance(outlet.fault, BrokenPipeError):
            print(
                f"rthyb: stdout cannot be written ({outlet.fault.strerror}); "
                f"{interrupts.written()}",
                file=sys.stderr,
            )
            return status or 1
    return status


def _name(signum: int) -> str:
    return signal.Signals(signum).name


def _status(arguments: list[str]) -> int:
    as_json = "--json" in arguments
    try:
        # In here, so that an interrupt during the import ends as quietly as any other.
        from rthyb_rt.cli.commands import app

        status = app(args=arguments, prog_name="rthyb", standalone_mode=False)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        _trace()
        print(f"rthyb: {_about_build(error) or error}", file=sys.stderr)
        return 1
    except RthybError as error:
        _trace()
        for line in str(error).splitlines():
            print(f"rthyb: {line}", file=sys.stderr)
        _print_notes(error)
        if as_json:
            _print_problems(
                error.problems if isinstance(error, InputError) else [Problem("", str(error))]
            )
        return error.exit_code
    except Exception as error:
        # What the parser of the command line raises shows itself.
        if hasattr(error, "show") and hasattr(error, "exit_code"):
            # Its prefix for a word that is none of a choice.
            message = str(getattr(error, "message", "")).removeprefix("Value error, ")
            if not message and hasattr(error, "format_message"):
                message = str(error.format_message())
            vars(error)["message"] = message
            error.show()
            if as_json:
                _print_problems([Problem("", message)])
            return int(error.exit_code)
        _trace()
        build = _about_build(error)
        if build is not None:
            print(f"rthyb: {build}", file=sys.stderr)
            return 1
        print(
            f"rthyb: internal error: {type(error).__name__}: {error}\n"
            "rthyb: this is a fault of the program, please report it together with what the same "
            "command prints after RTHYB_TRACEBACK=1",
            file=sys.stderr,
        )
        _print_notes(error)
        return 1
    return status if isinstance(status, int) else 0


def _print_notes(error: Exception) -> None:
    """Print what was added to an error on its way up: where something is that should be kept."""
    for note in getattr(error, "__notes__", ()):
        print(f"rthyb: {note}", file=sys.stderr)


def _about_build(error: Exception) -> str | None:
    """Say what is the matter when an editable installation cannot rebuild its core on import."""
    import subprocess

    if isinstance(error, OSError) and str(error.filename).endswith("editable_rebuild.lock"):
        return (
            "the core is rebuilt from sources that you may not write: run as their owner, or "
            "install the wheel"
        )
    if isinstance(error, subprocess.CalledProcessError) and "cmake" in str(error.cmd):
        return "the C core does not build, see above"
    return None


def _print_problems(problems: Sequence[Problem]) -> None:
    from rthyb_rt.cli import terminal

    found = [{"where": problem.where, "message": problem.message} for problem in problems]
    terminal.print_json({"schema": "rthyb-problems/1", "ok": False, "problems": found})


def _trace() -> None:
    if os.environ.get("RTHYB_TRACEBACK"):
        traceback.print_exc()
