"""A command of the command line from beginning to end: its status, and what is said when it fails.

What a command needs to compute is imported inside it, so that help comes at once.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import Any

from rthyb_rt.cli import interrupts, streams, terminal
from rthyb_rt.errors import Problem, RthybError

INTERRUPTED = 128 + signal.SIGINT

_UNIT = re.compile(r"[( ](?:[munk]?m|cm|in|mm/s|m/s|k?N|Hz)[ )]")


def main(given: Sequence[str]) -> int:
    """Run the command line and return its exit status.

    Args:
        given: what follows the program's name.
    """
    terminal.begin()
    with streams.settled() as outlet, interrupts.orderly():
        status = _status(list(given))
        signum = interrupts.received()
        if signum is not None or status == INTERRUPTED:
            signum = signum or signal.SIGINT
            how = "interrupted" if signum == signal.SIGINT else f"ended by {_name(signum)}"
            text = f"{how}; {interrupts.written()}"
            print(f"rthyb: {text}", file=sys.stderr)
            if "--json" in given:
                _print_problems([Problem(f"rthyb {given[0]}", text)])
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
    except KeyboardInterrupt as error:
        _print_notes(error)
        return INTERRUPTED
    except OSError as error:
        _trace()
        problem = _about_disk(error)
        print(f"rthyb: {problem}", file=sys.stderr)
        if as_json:
            _print_problems([problem])
        return 1
    except RthybError as error:
        _trace()
        for line in str(error).splitlines():
            print(f"rthyb: {line}", file=sys.stderr)
        _print_notes(error)
        if as_json:
            _print_problems(_with_files(error, arguments))
        return error.exit_code
    except Exception as error:
        # What the parser of the command line raises shows itself.
        if hasattr(error, "show") and hasattr(error, "exit_code"):
            problem = Problem(_blamed(error), _parser_message(error))
            error.show()
            if as_json:
                _print_problems([problem])
            return int(error.exit_code)
        if interrupts.received() is not None:
            # Some libraries make another error of an interrupt, when it comes during their import.
            return INTERRUPTED
        _trace()
        for line in (lines := _about_program(error)):
            print(f"rthyb: {line}", file=sys.stderr)
        _print_notes(error)
        if as_json:
            _print_problems([Problem("", "; ".join(lines))])
        return 1
    return status if isinstance(status, int) else 0


def _parser_message(error: Any) -> str:
    """Return what the parser of the command line found, and have it show the same."""
    message = str(getattr(error, "message", ""))
    if not message:
        # It makes its own from its parts, and would show it twice.
        return str(error.format_message()) if hasattr(error, "format_message") else ""
    # Its prefix for a word that is none of a choice.
    message = message.removeprefix("Value error, ")
    if message.startswith("Got unexpected extra argument") and _UNIT.search(message):
        message += '; write a value and its unit as one argument: "2 mm"'
    error.message = message
    return message


def _blamed(error: Any) -> str:
    """Return the option or argument that the parser of the command line blames, if it is one."""
    hint, parameter = getattr(error, "param_hint", None), getattr(error, "param", None)
    if isinstance(hint, str):
        return hint
    if parameter is None:
        return ""
    if parameter.param_type_name == "option":
        return max(map(str, parameter.opts), key=len)
    return str(parameter.metavar or parameter.name.upper()).strip("{}[]")


def _about_program(error: Exception) -> list[str]:
    """Return what to say of an error that is none of the user's."""
    build = _about_build(error)
    if build is not None:
        return [build]
    return [
        f"internal error: {type(error).__name__}: {error}",
        "this is a bug; please report it together with the output of the same command with "
        "RTHYB_TRACEBACK=1 set",
    ]


def _about_disk(error: OSError) -> Problem:
    """Return what the system refused, and where."""
    build = _about_build(error)
    if build is not None:
        return Problem("", build)
    where = "" if error.filename is None else str(error.filename)
    return Problem(where, error.strerror or str(error))


def _with_files(error: RthybError, arguments: Sequence[str]) -> list[Problem]:
    """Return the faults of an error; of one that is an interrupt, with what was written."""
    if error.exit_code != INTERRUPTED:
        return error.problems
    where, files = f"rthyb {arguments[0]}", interrupts.written()
    return [Problem(where, f"{problem.message}; {files}") for problem in error.problems]


def _print_notes(error: BaseException) -> None:
    """Print what was added to an error on its way up: where something is that should be kept."""
    for note in getattr(error, "__notes__", ()):
        print(f"rthyb: {note}", file=sys.stderr)


def _about_build(error: Exception) -> str | None:
    """Say what is the matter when an editable installation cannot rebuild its core on import."""
    import subprocess

    if isinstance(error, OSError) and str(error.filename).endswith("editable_rebuild.lock"):
        return (
            "the core must be rebuilt, but you have no write access to its sources: run as their "
            "owner, or install the wheel"
        )
    if isinstance(error, subprocess.CalledProcessError) and "cmake" in str(error.cmd):
        return "the C core failed to build, see above"
    return None


def _print_problems(problems: Sequence[Problem]) -> None:
    """Print the document of a command that failed, unless it has printed its own before."""
    if terminal.has_json():
        return
    found = [{"where": problem.where, "message": problem.message} for problem in problems]
    terminal.print_json({"schema": "rthyb-problems/1", "ok": False, "problems": found})


def _trace() -> None:
    if os.environ.get("RTHYB_TRACEBACK"):
        traceback.print_exc()
