"""What a person is told during a test, from a thread that may be held up.

A terminal that stands still (Ctrl-S, a connection that died) blocks whoever writes to it. That must
not be the thread that passes on a stop.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from rthyb_rt.lab.experiment import Progress

_PERIOD_S = 0.05
_LAST_WORDS_S = 1.0


class Teller:
    """Takes what is to be told without ever waiting, and tells it when it can.

    Args:
        progress: called with (ticks done, ticks of the test).
        warn: takes a sentence.
        at_once: tell in the caller's thread, in order: for the stepped clock.
    """

    def __init__(self, progress: Progress, warn: Callable[[str], None], *, at_once: bool) -> None:
        self._progress, self._warn, self._at_once = progress, warn, at_once
        self._sentences: deque[str] = deque()
        self._reached: tuple[int, int] | None = None
        self._failure: BaseException | None = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._tell, name="teller", daemon=True)
        if not at_once:
            self._thread.start()

    def warn(self, sentence: str) -> None:
        """Have a sentence told."""
        if self._at_once:
            self._warn(sentence)
        else:
            self._sentences.append(sentence)

    def progress(self, done: int, total: int) -> None:
        """Have the progress told; of several, only the newest.

        Raises what telling raised.
        """
        if self._at_once:
            self._progress(done, total)
            return
        self._reached = (done, total)
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Tell the rest, unless the other side takes none."""
        self._done.set()
        if not self._at_once:
            self._thread.join(_LAST_WORDS_S)

    def _tell(self) -> None:
        told: tuple[int, int] | None = None
        try:
            while not (last := self._done.wait(_PERIOD_S)) or self._sentences:
                while self._sentences:
                    self._warn(self._sentences.popleft())
                reached = self._reached
                if reached is not None and reached != told:
                    self._progress(*reached)
                    told = reached
                if last and not self._sentences:
                    return
        except BaseException as error:
            self._failure = error
