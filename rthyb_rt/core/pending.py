"""What code of the user's own raises while C calls it: kept, and raised when C has come back."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from rthyb_rt.errors import RthybError

_PACKAGE: Final = f"{Path(__file__).resolve().parents[1]}/"


class OwnCodeError(RthybError):
    """An error raised by code of the user's own; the message says which, and where it stands.

    Attributes:
        original: the error itself, with its traceback.
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
    """Raise what code of the user's own has raised while C called it, if it did.

    Raises:
        OwnCodeError: it did.
        KeyboardInterrupt: it was interrupted meanwhile.
    """
    error = _PENDING.error
    if error is None:
        return
    _PENDING.error = None
    if not isinstance(error.original, Exception):
        raise error.original
    raise error from error.original


def guarded(does: Callable[..., Any], doing: str, failed: Any) -> Callable[..., Any]:
    """Return what C may call: it raises nothing, and does nothing once something was raised.

    Args:
        does: the function of the user's own.
        doing: what it is, for the message.
        failed: what is returned then.
    """

    def called(*args: Any) -> Any:
        if _PENDING.error is not None:
            return failed
        try:
            return does(*args)
        except BaseException as error:  # is raised again as soon as C has come back
            _PENDING.error = (
                error if isinstance(error, OwnCodeError) else OwnCodeError(error, doing)
            )
            return failed

    return called
