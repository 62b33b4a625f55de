"""Exceptions of user code that C calls: stored, and raised once C has returned."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from rthyb_rt.errors import RthybError

_PACKAGE: Final = f"{Path(__file__).resolve().parents[1]}/"


class OwnCodeError(RthybError):
    """An error raised by user code; the message names the error and its location.

    Attributes:
        original: the original exception with its traceback.
    """

    def __init__(self, original: BaseException, doing: str) -> None:
        self.original = original
        last = traceback.extract_tb(original.__traceback__)
        own = [frame for frame in last if not _of_this_program(frame.filename)]
        at = f"{own[-1].filename}:{own[-1].lineno}, in {own[-1].name}" if own else doing
        if isinstance(original, SyntaxError) and original.filename:
            at = f"{original.filename}:{original.lineno}"
        text = f"{type(original).__name__}: {original}".removesuffix(": ")
        super().__init__(f"{text} ({doing})", where=at)


def _of_this_program(file: str) -> bool:
    return file.startswith((_PACKAGE, "<frozen"))


class _Pending(threading.local):
    error: OwnCodeError | None = None


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
            _PENDING.error = (
                error if isinstance(error, OwnCodeError) else OwnCodeError(error, doing)
            )
            return failed

    return called
