"""Orderly end of a command after Ctrl-C, SIGTERM, SIGHUP or SIGQUIT, stating what was written."""

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
    """Raise KeyboardInterrupt for each of the signals, so that unfinished output is cleaned up.

    A signal that was ignored before, as under nohup, remains ignored.
    """
    _received.clear()
    _written.clear()
    complain = sys.unraisablehook

    def quiet(found: sys.UnraisableHookArgs) -> None:
        # Swallowed in a callback of some library; `received` remembers it.
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
    """Defer the signals until the end of the block, where the first one is raised.

    For work that must not be interrupted, and for libraries whose callbacks swallow an interrupt.
    """
    waiting: list[int] = []
    with _handled(lambda signum, _: waiting.append(signum)):
        yield
    if waiting:
        signal.raise_signal(waiting[0])


@contextlib.contextmanager
def on_interrupt(tell: Callable[[], None]) -> Iterator[None]:
    """Call ``tell`` for each of the signals during the block, which continues.

    For motions: they are stopped in their own way, which takes some time.
    """
    with _handled(lambda *_: tell()):
        yield


def received() -> int | None:
    """Return the first signal received, or None."""
    return _received[0] if _received else None


def wrote(path: Path) -> None:
    """Note a complete file or folder, in case the command ends early."""
    if path not in _written:
        _written.append(path)


def written() -> str:
    """Return as text which complete files the command has left."""
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
    # Python handles signals in its main thread only.
    if threading.current_thread() is threading.main_thread():
        for signum in _SIGNALS:
            if signal.getsignal(signum) not in (signal.SIG_IGN, None):
                before[signum] = signal.signal(signum, handler)
    try:
        yield
    finally:
        for signum, old in before.items():
            signal.signal(signum, old)
