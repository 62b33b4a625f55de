"""What systemd wants to know of a service, and how it takes log lines."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import sys
from collections.abc import Iterator

_PATIENCE_S = 0.1

_LEVELS = {
    logging.CRITICAL: 2,
    logging.ERROR: 3,
    logging.WARNING: 4,
    logging.INFO: 6,
    logging.DEBUG: 7,
}


def notify(*words: str) -> bool:
    """Tell systemd words such as ``READY=1``; False: nobody listens."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if not path:
        return False
    # A leading @ stands for the abstract name space.
    address = "\0" + path[1:] if path.startswith("@") else path
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
        out.settimeout(_PATIENCE_S)
        out.sendto("\n".join(words).encode(), address)
        return True
    return False


def watchdog_s() -> float | None:
    """Return the time in which systemd wants a sign of life; None: it wants none."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        return int(os.environ["WATCHDOG_USEC"]) / 1e6
    except (KeyError, ValueError):
        return None


class _Journal(logging.Formatter):
    """Lines with the level as the journal reads it."""

    def format(self, record: logging.LogRecord) -> str:
        level = _LEVELS.get(record.levelno, 6)
        return "\n".join(f"<{level}>{line}" for line in super().format(record).splitlines())


@contextlib.contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Log to stderr in the block, for the journal where that listens, else for people."""
    handler = logging.StreamHandler(sys.stderr)
    in_journal = bool(os.environ.get("JOURNAL_STREAM"))
    people = logging.Formatter("%(asctime)s %(levelname)s %(message)s")
    handler.setFormatter(_Journal("%(message)s") if in_journal else people)
    root = logging.getLogger("rthyb")
    before = root.handlers[:], root.level, root.propagate
    root.handlers[:], root.propagate = [handler], False
    root.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.handlers[:], root.propagate = before[0], before[2]
        root.setLevel(before[1])
