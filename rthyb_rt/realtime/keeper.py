"""The thread that keeps every record of a test and gives the sign of life."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import ring
from rthyb_rt.errors import RthybError
from rthyb_rt.realtime.endings import TimingError
from rthyb_rt.recording import FLAGS, RUNNING, STATES

RECORDER_PERIOD_S: Final = 0.02
LOOK_BACK_TICKS: Final = 64
GOOD_PAIRS: Final = 48
"""Of the last `LOOK_BACK_TICKS`, with a drive that follows: then a test begins."""

SILENCE_S: Final = 5.0
"""Without a record: then the tick thread stands still, or all of this process did."""
SURE_S: Final = 0.1
"""Of running time on top, in which the recorder would find what came: then it is the thread."""
LOOK_MOST_S: Final = 0.05
"""Counted between two looks; a longer way from one to the next was no running time."""
ABSENCE_S: Final = 1.0
"""Of the operator's thread: then no sign of life is given, and the test ramps out."""
AT_REST: Final = ("IDLE", "ZEROED", "ARMED", "TRIPPED")
"""States in which nothing moves on this program's word."""

_CHUNK = 256
_NOT_FOLLOWING: Final = FLAGS["stopped"] | FLAGS["down"]


def follows(flags: NDArray[np.uint32]) -> bool:
    """Return whether good pairs come, of a drive that obeys, by the flags of the newest rows."""
    fresh = np.count_nonzero(flags & FLAGS["fresh"])
    return bool(fresh >= GOOD_PAIRS and not (flags & _NOT_FOLLOWING).any())


class Keeper:
    """Reads the ring again and again, keeps every record, and gives the sign of life.

    Who no longer records gives none, so that the test ramps out.
    """

    def __init__(self, path: Path) -> None:
        self._reader = ring.Reader(path)
        self._parts: list[NDArray[np.void]] = []
        self._next = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="recorder", daemon=True)
        self._failure: BaseException | None = None
        self._last_s = self._looked_s = time.monotonic()
        self._silent_s = 0.0
        self._at_rest = [STATES.index(s) for s in AT_REST]
        self.beat: Callable[[], None] = lambda: None
        self._attended_s: float | None = None
        self.missed: list[list[int]] = []
        self._recent: NDArray[np.uint32] = np.zeros(0, np.uint32)
        self.running = 0
        self.moved = False
        self.displacement_m = 0.0

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
            self.beat()

    def drain(self) -> None:
        while (rows := self._reader.read(_CHUNK)).samples.size:
            if rows.first != self._next:
                self.missed.append([self._next, rows.first - 1])
            self._next = self._reader.next
            self._take(rows.samples.copy())

    def _take(self, samples: NDArray[np.void]) -> None:
        self._parts.append(samples)
        self._last_s = time.monotonic()
        self.running += int(np.count_nonzero(samples["state"] == RUNNING))
        self.moved = self.moved or bool((~np.isin(samples["state"], self._at_rest)).any())
        self.displacement_m = float(samples["x_meas_m"][-1])
        self._recent = np.concatenate([self._recent, samples["flags"]])[-LOOK_BACK_TICKS:]

    @property
    def recent_flags(self) -> NDArray[np.uint32]:
        """Flags of the last `LOOK_BACK_TICKS` rows."""
        return self._recent

    def follows(self) -> bool:
        return follows(self._recent)

    def check(self) -> None:
        """Raise what went wrong.

        Raises:
            RthybError: the recorder failed.
            TimingError: the tick thread stands still.
        """
        if self._failure is not None:
            raise RthybError(
                f"the recorder failed: {self._failure!r}; the drive is being stopped; look at this "
                "PC's memory and at what else it runs"
            ) from self._failure
        now_s = time.monotonic()
        passed_s, self._looked_s = now_s - self._looked_s, now_s
        silent_s = now_s - self._last_s
        # After a trip the ring stands still, as it is meant to.
        if not self._thread.is_alive() or silent_s <= SILENCE_S or self._reader.frozen:
            self._silent_s = 0.0
            return
        # Where all of the process was stopped, this thread may go on before the others.
        self._silent_s += min(passed_s, LOOK_MOST_S)
        if self._silent_s > LOOK_MOST_S + SURE_S:
            raise TimingError(
                f"no record for {silent_s:.0f} s: the tick thread stands still; the drive's own "
                "watchdog stops it; look what else takes this PC's processors, and at `rthyb "
                "jitter`"
            )

    def stop(self) -> None:
        """End the thread and keep what the producer, which has ended, has left."""
        self._done.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._failure is None:
            self.drain()

    def spread(self, ticks: int) -> float:
        raw = [part["x_raw"][part["flags"] & FLAGS["fresh"] != 0] for part in self._parts[-ticks:]]
        x = np.concatenate(raw)[-ticks:].astype(np.float64)
        return float(np.ptp(x)) * 1e-9 if x.size else 0.0

    def samples(self) -> NDArray[np.void]:
        """Return all that was kept, shape (n,)."""
        return ring.joined(self._parts)

    def close(self) -> None:
        self._reader.close()
