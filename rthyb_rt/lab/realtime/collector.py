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
"""Time without a record after which the tick thread, or this whole process, has stalled."""
SURE_S: Final = 0.1
"""Further running time for the collector to find records: then it is the tick thread."""
LOOK_MOST_S: Final = 0.05
"""Greatest interval between two checks that counts as running time."""
ABSENCE_S: Final = 1.0
"""Absence of the operator's thread after which no heartbeat is sent and the test ramps out."""


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
        """Note that the thread that forwards a stop is present; from now on it must remain so."""
        self._attended_s = time.monotonic()

    def turn(self) -> None:
        self.drain()
        if self._attended_s is None or time.monotonic() - self._attended_s < ABSENCE_S:
            self._beat()

    def drain(self) -> None:
        for _ in self._run.news():
            self._last_s = time.monotonic()

    def check(self) -> None:
        """Raise any failure.

        Raises:
            RthybError: the recorder failed.
            TimingError: the tick thread has stalled.
        """
        if self._failure is not None:
            raise RthybError(
                f"the recorder failed: {self._failure!r}; the drive is being stopped; check this "
                "PC's memory and what else is running"
            ) from self._failure
        now_s = time.monotonic()
        passed_s, self._looked_s = now_s - self._looked_s, now_s
        silent_s = now_s - self._last_s
        # After a trip the ring stops, as intended.
        if not self._thread.is_alive() or silent_s <= SILENCE_S or self._run.reader.frozen:
            self._silent_s = 0.0
            return
        # If the whole process was stopped, this thread may resume before the others.
        self._silent_s += min(passed_s, LOOK_MOST_S)
        if self._silent_s > LOOK_MOST_S + SURE_S:
            raise TimingError(
                f"no record for {silent_s:.0f} s: the tick thread has stopped; the drive's own "
                "watchdog stops the drive; check what else uses this PC's processors, and run "
                "`rthyb jitter`"
            )

    def stop(self) -> None:
        """End the thread and collect the rows that the producer, which has ended, has left."""
        self._done.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._failure is None:
            self.drain()
