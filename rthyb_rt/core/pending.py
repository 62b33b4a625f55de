"""Exceptions of user code that C calls: stored, and raised once C has returned."""

from __future__ import annotations

import sysconfig
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from rthyb_rt.errors import InputError, RthybError

_PACKAGE: Final = f"{Path(__file__).resolve().parents[1]}/"
_PYTHON: Final = f"{sysconfig.get_path('stdlib')}/"
"""Folder of Python's own modules."""


class OwnFault(InputError):
    """User code returned what it must not; the message names its method, its place and when."""


class OwnCodeError(InputError):
    """An error raised by user code; the message names the error and its location.

    Attributes:
        original: the original exception with its traceback.
    """

    exit_code = RthybError.exit_code

    def __init__(self, original: BaseException, doing: str) -> None:
        self.original = original
        if isinstance(original, OwnFault):
            problem = original.problems[0]
            super().__init__(problem)
            return
        own = _of_the_user(traceback.extract_tb(original.__traceback__))
        at = f"{own[-1].filename}:{own[-1].lineno}, in {own[-1].name}" if own else doing
        if isinstance(original, SyntaxError) and original.filename:
            at = f"{original.filename}:{original.lineno}"
        text = f"{type(original).__name__}: {original}".removesuffix(": ")
        super().__init__(f"{text} ({doing})", where=at)


def _of_the_user(frames: Iterable[traceback.FrameSummary]) -> list[traceback.FrameSummary]:
    """Return the frames in the user's files; those in installed packages if there are none."""
    outside = [
        one
        for one in frames
        if not one.filename.startswith((_PACKAGE, "<frozen"))
        and (_installed(one.filename) or not one.filename.startswith(_PYTHON))
    ]
    return [one for one in outside if not _installed(one.filename)] or outside


def _installed(file: str) -> bool:
    return "/site-packages/" in file or "/dist-packages/" in file


class _Pending(threading.local):
    error: OwnCodeError | None = None
    moment: Callable[[], str] | None = None


_PENDING: Final = _Pending()


def raise_pending() -> None:
    """Raise the exception that user code raised while C called it, if any.

    Raises:
        OwnCodeError: user code raised an exception.
        KeyboardInterrupt: the call was interrupted.
    """
    error = _PENDING.error
    if error is None:
        return
    _PENDING.error = None
    if not isinstance(error.original, Exception):
        raise error.original
    raise error from error.original


@contextmanager
def during(moment: Callable[[], str]) -> Iterator[None]:
    """Name the moment of errors that user code raises in the block.

    Args:
        moment: called when one is raised; returns words such as "at tick 12 of the test".
    """
    before, _PENDING.moment = _PENDING.moment, moment
    try:
        yield
    finally:
        _PENDING.moment = before


def moment_in_words() -> str:
    """Return when user code is being called, after a space; "" if that is not known."""
    return "" if _PENDING.moment is None else f" {_PENDING.moment()}"


def guarded(does: Callable[..., Any], doing: str, failed: Any) -> Callable[..., Any]:
    """Wrap a function for C: it raises nothing, and does nothing after a first exception.

    Args:
        does: the user's function.
        doing: description of the call for the message.
        failed: return value after an exception.
    """

    def called(*args: Any) -> Any:
        if _PENDING.error is not None:
            return failed
        try:
            return does(*args)
        except BaseException as error:  # raised again as soon as C has returned
            if not isinstance(error, OwnCodeError):
                said = f"{doing}{moment_in_words()}"
                if isinstance(error, Exception) and not isinstance(error, OwnFault):
                    error.add_note(f"in {said}")
                error = OwnCodeError(error, said)
            _PENDING.error = error
            return failed

    return called
