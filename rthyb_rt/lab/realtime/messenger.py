"""Messages for the user during a test, from a thread that may be blocked.

A terminal that is stopped (Ctrl-S, a lost connection) blocks every thread that writes to it. That
must not be the thread that passes on a stop.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from rthyb_rt.lab.experiment import Progress

_PERIOD_S = 0.05
_LAST_WORDS_S = 1.0


class Messenger:
    """Accepts messages without waiting, and delivers them when possible.

    Args:
        progress: called with (ticks done, ticks of the test).
        warn: called with a sentence.
        at_once: deliver in the caller's thread, in order, for the stepped clock.
    """

    def __init__(self, progress: Progress, warn: Callable[[str], None], *, at_once: bool) -> None:
        self._progress, self._warn, self._at_once = progress, warn, at_once
        self._sentences: deque[str] = deque()
        self._reached: tuple[int, int] | None = None
        self._failure: BaseException | None = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._deliver, name="messenger", daemon=True)
        if not at_once:
            self._thread.start()

    def warn(self, sentence: str) -> None:
        """Queue a sentence."""
        if self._at_once:
            self._warn(sentence)
        else:
            self._sentences.append(sentence)

    def progress(self, done: int, total: int) -> None:
        """Queue the progress; only the newest value is delivered.

        Raises the exceptions of the delivery.
        """
        if self._at_once:
            self._progress(done, total)
            return
        self._reached = (done, total)
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Deliver the rest, unless the receiver is blocked."""
        self._done.set()
        if not self._at_once:
            self._thread.join(_LAST_WORDS_S)

    def _deliver(self) -> None:
        delivered: tuple[int, int] | None = None
        try:
            while not (last := self._done.wait(_PERIOD_S)) or self._sentences:
                while self._sentences:
                    self._warn(self._sentences.popleft())
                reached = self._reached
                if reached is not None and reached != delivered:
                    self._progress(*reached)
                    delivered = reached
                if last and not self._sentences:
                    return
        except BaseException as error:
            self._failure = error
