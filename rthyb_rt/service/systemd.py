"""Notifications to systemd, and log lines for the journal."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import socket
import sys
import threading
from collections.abc import Iterator
from typing import IO

_PATIENCE_S = 0.1
_LINES_MOST = 1000
_LAST_LINES_S = 1.0
_STACK_BYTES = 256 << 10

_LEVELS = {
    logging.CRITICAL: 2,
    logging.ERROR: 3,
    logging.WARNING: 4,
    logging.INFO: 6,
    logging.DEBUG: 7,
}


def notify(*words: str) -> bool:
    """Send words such as ``READY=1`` to systemd; False if no service manager is listening."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if not path:
        return False
    # A leading @ denotes the abstract name space.
    address = "\0" + path[1:] if path.startswith("@") else path
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
        out.settimeout(_PATIENCE_S)
        out.sendto("\n".join(words).encode(), address)
        return True
    return False


def watchdog_s() -> float | None:
    """Return the watchdog interval of systemd; None if there is no watchdog."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        return int(os.environ["WATCHDOG_USEC"]) / 1e6
    except (KeyError, ValueError):
        return None


class _Journal(logging.Formatter):
    """Formats lines with their level in the journal's notation."""

    def format(self, record: logging.LogRecord) -> str:
        level = _LEVELS.get(record.levelno, 6)
        return "\n".join(f"<{level}>{line}" for line in super().format(record).splitlines())


class Behind(logging.Handler):
    """Passes lines to a thread that writes them.

    A stopped terminal, or a journal that waits for its disk, may block a write for a while. That
    must not block the thread that sends the heartbeat and receives the operator's stop.

    Args:
        stream: destination of the lines.
    """

    def __init__(self, stream: IO[str]) -> None:
        super().__init__()
        self._stream = stream
        self._lines: queue.Queue[logging.LogRecord | None] = queue.Queue(_LINES_MOST)
        self._lost, self._over = 0, False
        # All of its stack is locked in memory if the process has that privilege.
        before = threading.stack_size(_STACK_BYTES)
        self._thread = threading.Thread(target=self._write, name="logging", daemon=True)
        self._thread.start()
        threading.stack_size(before)

    def emit(self, record: logging.LogRecord) -> None:
        """Pass a line on; if a thousand are already waiting, drop and count it."""
        # Formatted now, because its arguments may have changed when it is written.
        record.msg, record.args = record.getMessage(), None
        try:
            self._lines.put_nowait(record)
        except queue.Full:
            self._lost += 1

    def _write(self) -> None:
        while (record := self._lines.get()) is not None:
            self._print(record)
            # The dropped lines came after all those that were waiting.
            if self._lost and self._lines.empty():
                lost, self._lost = self._lost, 0
                text = f"{lost} log lines were lost because nothing read them"
                self._print(logging.LogRecord("", logging.ERROR, "", 0, text, None, None))
            if self._over and self._lines.empty():
                return

    def _print(self, record: logging.LogRecord) -> None:
        text = self.format(record) + "\n"
        with contextlib.suppress(OSError, ValueError):
            try:
                fd = self._stream.fileno()
            except OSError:
                self._stream.write(text)
                return
            # Bypasses the stream, whose lock a blocked write would hold until the process ends.
            data = memoryview(text.encode(errors="backslashreplace"))
            while data:
                data = data[os.write(fd, data) :]

    def close(self) -> None:
        """Write the waiting lines, unless that is blocked."""
        self._over = True
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(_LAST_LINES_S)
        super().close()


@contextlib.contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Log to stderr within the block, in the journal's format if it is connected."""
    handler = Behind(sys.stderr)
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
        handler.close()
