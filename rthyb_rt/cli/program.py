"""Execution of a command: its exit status, and the messages if it fails.

What a command needs for computing is imported inside the command, so that help appears at once.
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

_BOUNDS = {
    re.compile(r"Input should be greater than or equal to (.*)"): "at least ",
    re.compile(r"Input should be less than or equal to (.*)"): "at most ",
    re.compile(r"Input should be greater than (.*)"): "above ",
    re.compile(r"Input should be less than (.*)"): "below ",
    re.compile(r"Input should be a valid integer()"): "a whole number",
    re.compile(r"Input should be a valid number()"): "a number",
}
"""What a library says of an option's number, and how this program says it."""

_UNIT = re.compile(r"[( ](?:[munk]?m|cm|in|mm/s|m/s|k?N|Hz)[ )]")


def main(given: Sequence[str]) -> int:
    """Run the command line and return its exit status.

    Args:
        given: arguments after the program's name.
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
        # It is no error if the reader of the output has seen enough.
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
        # Imported here, so that an interrupt during the import is handled like any other.
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
        # Errors of the command-line parser print themselves.
        if hasattr(error, "show") and hasattr(error, "exit_code"):
            problem = Problem(_blamed(error), _parser_message(error))
            error.show()
            if as_json:
                _print_problems([problem])
            return int(error.exit_code)
        if interrupts.received() is not None:
            # Some libraries turn an interrupt during their import into another error.
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
    """Return the message of the command-line parser, and make the parser print the same."""
    message = str(getattr(error, "message", ""))
    if not message:
        # It composes its own message from parts, and would repeat them.
        return str(error.format_message()) if hasattr(error, "format_message") else ""
    # Its prefix for a word that is not one of the choices.
    message = message.removeprefix("Value error, ")
    for theirs, ours in _BOUNDS.items():
        if match := theirs.match(message):
            inputs: list[Any] = getattr(error.__cause__, "errors", list)()
            found = f"found {inputs[0]['input']}; " if inputs else ""
            message = f"{found}must be {ours}{match[1]}"
            break
    if message.startswith("Got unexpected extra argument") and _UNIT.search(message):
        message += '; write a value and its unit as one argument: "2 mm"'
    error.message = message
    return message


def _blamed(error: Any) -> str:
    """Return the option or argument to which the command-line parser objects, if it is one."""
    hint, parameter = getattr(error, "param_hint", None), getattr(error, "param", None)
    if isinstance(hint, str):
        return hint
    if parameter is None:
        return ""
    if parameter.param_type_name == "option":
        return max(map(str, parameter.opts), key=len)
    return str(parameter.metavar or parameter.name.upper()).strip("{}[]")


def _about_program(error: Exception) -> list[str]:
    """Return the messages for an error that the user did not cause."""
    build = _about_build(error)
    if build is not None:
        return [build]
    return [
        f"internal error: {type(error).__name__}: {error}",
        "this is a bug; please report it together with the output of the same command with "
        "RTHYB_TRACEBACK=1 set",
    ]


def _about_disk(error: OSError) -> Problem:
    """Return what the operating system refused, and where."""
    build = _about_build(error)
    if build is not None:
        return Problem("", build)
    where = "" if error.filename is None else str(error.filename)
    return Problem(where, error.strerror or str(error))


def _with_files(error: RthybError, arguments: Sequence[str]) -> list[Problem]:
    """Return the problems of an error; for an interrupt, including what was written."""
    if error.exit_code != INTERRUPTED:
        return error.problems
    where, files = f"rthyb {arguments[0]}", interrupts.written()
    return [Problem(where, f"{problem.message}; {files}") for problem in error.problems]


def _print_notes(error: BaseException) -> None:
    """Print the notes added to an error while it propagated, such as where data were saved."""
    for note in getattr(error, "__notes__", ()):
        print(f"rthyb: {note}", file=sys.stderr)


def _about_build(error: Exception) -> str | None:
    """Return why an editable installation cannot rebuild its core on import, or None."""
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
    """Print the document of a command that failed, unless it has already printed one."""
    if terminal.has_json():
        return
    found = [{"where": problem.where, "message": problem.message} for problem in problems]
    terminal.print_json({"schema": "rthyb-problems/1", "ok": False, "problems": found})


def _trace() -> None:
    if os.environ.get("RTHYB_TRACEBACK"):
        traceback.print_exc()
