"""Ctrl-C, SIGTERM, SIGHUP and SIGQUIT end a command in order, and say what was written."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_SIGNALS: tuple[int, ...] = (
    signal.SIGINT,
    signal.SIGTERM,
    signal.SIGHUP,
    signal.SIGQUIT,
)

_received: list[int] = []
_written: list[Path] = []


@contextlib.contextmanager
def orderly() -> Iterator[None]:
    """Raise KeyboardInterrupt for each of the signals, so that what is half done is cleaned up.

    A signal that was ignored before, as under nohup, stays ignored.
    """
    _received.clear()
    _written.clear()
    complain = sys.unraisablehook

    def quiet(found: sys.UnraisableHookArgs) -> None:
        # Swallowed in some library's callback; `received` still knows of it.
        if not issubclass(found.exc_type, KeyboardInterrupt):
            complain(found)

    sys.unraisablehook = quiet
    try:
        with _handled(_raise):
            yield
    finally:
        sys.unraisablehook = complain


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Let none of the signals into the block; the first that came is raised behind it.

    For what must not end halfway, and for libraries whose callbacks swallow an interrupt.
    """
    waiting: list[int] = []
    with _handled(lambda signum, _: waiting.append(signum)):
        yield
    if waiting:
        signal.raise_signal(waiting[0])


@contextlib.contextmanager
def on_interrupt(tell: Callable[[], None]) -> Iterator[None]:
    """Call ``tell`` for each of the signals in the block, which goes on.

    For what moves: it is stopped in its own way, and takes its time for it.
    """
    with _handled(lambda *_: tell()):
        yield


def received() -> int | None:
    """Return the first signal that came."""
    return _received[0] if _received else None


def wrote(path: Path) -> None:
    """Note a file or a folder that is whole, for the case that the command does not end well."""
    if path not in _written:
        _written.append(path)


def written() -> str:
    """Say which whole files the command has left."""
    files = [
        str(file)
        for path in _written
        for file in (sorted(path.iterdir()) if path.is_dir() else [path])
    ]
    return f"written: {', '.join(files)}" if files else "nothing was written"


def _raise(signum: int, _: object) -> None:
    _received.append(signum)
    raise KeyboardInterrupt


@contextlib.contextmanager
def _handled(handler: Callable[[int, Any], None]) -> Iterator[None]:
    before: dict[int, Any] = {}
    # Python handles signals in its main thread alone.
    if threading.current_thread() is threading.main_thread():
        for signum in _SIGNALS:
            if signal.getsignal(signum) not in (signal.SIG_IGN, None):
                before[signum] = signal.signal(signum, handler)
    try:
        yield
    finally:
        for signum, old in before.items():
            signal.signal(signum, old)
