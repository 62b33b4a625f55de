"""The thread that collects every record of a test and sends the heartbeat."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from rthyb_rt.errors import RthybError
from rthyb_rt.lab.end_reasons import TimingError
from rthyb_rt.lab.realtime.live_run import LiveRun

RECORDER_PERIOD_S: Final = 0.02
SILENCE_S: Final = 5.0
"""Without a record: then the tick thread stands still, or all of this process did."""
SURE_S: Final = 0.1
"""Of running time on top, in which the recorder would find what came: then it is the thread."""
LOOK_MOST_S: Final = 0.05
"""Counted between two looks; a longer way from one to the next was no running time."""
ABSENCE_S: Final = 1.0
"""Of the operator's thread: then no heartbeat is sent, and the test ramps out."""


class Collector:
    """Collects the rows of a run repeatedly, and sends the heartbeat.

    If it can no longer collect rows, it sends no heartbeat, so that the test ramps out.

    Args:
        run: run whose rows are collected.
        beat: sends the heartbeat.
    """

    def __init__(self, run: LiveRun, beat: Callable[[], None]) -> None:
        self._run, self._beat = run, beat
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="recorder", daemon=True)
        self._failure: BaseException | None = None
        self._last_s = self._looked_s = time.monotonic()
        self._silent_s = 0.0
        self._attended_s: float | None = None

    def start(self) -> None:
        self._thread.start()

    def _keep(self) -> None:
        while not self._done.wait(RECORDER_PERIOD_S):
            try:
                self.turn()
            except BaseException as error:
                self._failure = error
                return

    def attended(self) -> None:
        """Note that the thread that passes on a stop is there; from then on it has to be."""
        self._attended_s = time.monotonic()

    def turn(self) -> None:
        self.drain()
        if self._attended_s is None or time.monotonic() - self._attended_s < ABSENCE_S:
            self._beat()

    def drain(self) -> None:
        for _ in self._run.news():
            self._last_s = time.monotonic()

    def check(self) -> None:
        """Raise what went wrong.

        Raises:
            RthybError: the recorder failed.
            TimingError: the tick thread stands still.
        """
        if self._failure is not None:
            raise RthybError(
                f"the recorder failed: {self._failure!r}; the drive is being stopped; check this "
                "PC's memory and what else is running"
            ) from self._failure
        now_s = time.monotonic()
        passed_s, self._looked_s = now_s - self._looked_s, now_s
        silent_s = now_s - self._last_s
        # After a trip the ring stands still, as it is meant to.
        if not self._thread.is_alive() or silent_s <= SILENCE_S or self._run.reader.frozen:
            self._silent_s = 0.0
            return
        # Where all of the process was stopped, this thread may go on before the others.
        self._silent_s += min(passed_s, LOOK_MOST_S)
        if self._silent_s > LOOK_MOST_S + SURE_S:
            raise TimingError(
                f"no record for {silent_s:.0f} s: the tick thread has stopped; the drive's own "
                "watchdog stops the drive; check what else uses this PC's processors, and run "
                "`rthyb jitter`"
            )

    def stop(self) -> None:
        """End the thread and keep what the producer, which has ended, has left."""
        self._done.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._failure is None:
            self.drain()
