"""The sequence of a test, in real or virtual time: zero, arm, start, and back to rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Protocol

from rthyb_rt import core
from rthyb_rt.errors import RthybError
from rthyb_rt.lab import trips
from rthyb_rt.lab.end_reasons import RefusedError, in_words

REST_TICKS: Final = 103
"""Rows of 1/1024 s at rest that are recorded after a test: a tenth of a second."""

TARE_MARGIN_S: Final = 2.0
"""Additional time, beyond its own duration, within which the tare must end."""

STEP_TICKS: Final = 8192
"""Maximum interval between two checks; with an operator, checks are far more frequent."""


@dataclass
class Operator:
    """Requests of the operator; another thread, or a signal handler, may set them.

    Attributes:
        stops: number of requested stops: the first ramps out, the second trips.
    """

    stops: int = 0

    def stop(self) -> None:
        """Request a stop."""
        self.stops += 1


class Conducted(Protocol):
    """Interface of a test that a sequence conducts: a station, over a link or in virtual time."""

    @property
    def config(self) -> core.StationConfig:
        """Settings of the station."""

    @property
    def state(self) -> str:
        """Name of the station's state after the last tick."""

    @property
    def causing(self) -> tuple[str, float, float]:
        """The station's latched first cause, the value reached and the limit."""

    @property
    def zeroing_failed(self) -> bool:
        """Whether the last tare was refused because the reading moved."""

    @property
    def progress(self) -> tuple[int, int]:
        """Samples of the test proper so far, and of the whole test."""

    @property
    def now_s(self) -> float:
        """Its clock."""

    def command(self, name: core.Command) -> int:
        """Give an operator's command until it is accepted; return the tick in which it was.

        Raises:
            RefusedError: the current state does not allow it, or it was refused repeatedly.
        """

    def advance(self, ticks: int) -> None:
        """Let a number of ticks pass; fewer if there is something to check."""

    def settle(self) -> None:
        """Wait for the rows that are recorded after a test: `REST_TICKS`, or more after a trip."""

    def not_zeroed(self) -> RthybError:
        """Return why the tare did not end."""


class Sequence:
    """Conducts a test from state to state, and passes on the operator's requests.

    Args:
        test: the test.
        operator: requests of the operator.
        hold_s: time after which a held test is stopped; inf if an operator is present.
        way_out_s: time for which a ramp-out is followed.
        progress: called with (ticks done, ticks of the test) now and then.
        warn: called with a sentence for the user while the test runs.
    """

    def __init__(
        self,
        test: Conducted,
        operator: Operator | None = None,
        *,
        hold_s: float = math.inf,
        way_out_s: float = math.inf,
        progress: Callable[[int, int], None] | None = None,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._way_out_s = way_out_s
        self._test, self._operator = test, operator or Operator()
        self._hold_s, self._progress, self.warn = hold_s, progress, warn
        self._given = 0
        self._held_s: float | None = None

    @property
    def stopped(self) -> bool:
        """Whether a stop of the operator has been passed on."""
        return self._given > 0

    def until(self, done: Callable[[], bool], most_s: float = math.inf) -> bool:
        """Return True once ``done`` is true, False if time runs out or the operator stops."""
        test, end_s = self._test, self._test.now_s + most_s
        while not done():
            if test.now_s >= end_s:
                return False
            left_s = min(end_s, self._hold_ends_s) - test.now_s
            test.advance(max(math.ceil(min(left_s * test.config.fs_hz, STEP_TICKS)), 1))
            if self._progress is not None:
                self._progress(*test.progress)
            self._attend_hold()
            if self._obey() and test.state in ("IDLE", "TRIPPED"):
                return done()
        return True

    @property
    def _hold_ends_s(self) -> float:
        return math.inf if self._held_s is None else self._held_s + self._hold_s

    def _attend_hold(self) -> None:
        if self._test.state != "HOLD":
            self._held_s = None
            return
        if self._held_s is None:
            self._held_s = self._test.now_s
            if self._hold_s == math.inf:
                cause, value, limit = self._test.causing
                words = trips.figures(cause, value, limit) or in_words(cause)
                self.warn(
                    f"held: {words}; the specimen stays in place until Ctrl-C returns it to zero"
                )
        if self._test.now_s >= self._hold_ends_s and not self._operator.stops:
            self._operator.stop()

    def _obey(self) -> bool:
        """Pass on the operator's requests; return whether there has been any."""
        asked = min(self._operator.stops, 2)
        while self._given < asked:
            self._given += 1
            with suppress(RefusedError):
                self._test.command("stop" if self._given == 1 else "trip")
        return self.stopped

    def conduct(self, zeroed: Callable[[], None] = lambda: None) -> None:
        """Zero, arm, start, and return to rest, whatever happens in between.

        Args:
            zeroed: called between the tare and ARM, before anything moves; an exception ends the
                test there.

        Raises:
            RthybError: the tare did not end, or a command was refused.
        """
        commands: tuple[core.Command, ...] = ("zero", "arm", "start")
        for name in commands:
            if self.stopped or self._test.state == "TRIPPED":
                break
            self._lead(name)
            if self._test.state == "ZEROED":
                zeroed()
        self.until(lambda: self._test.state in ("IDLE", "TRIPPED", "RAMP_OUT"))
        self.until(lambda: self._test.state in ("IDLE", "TRIPPED"), self._way_out_s)
        self._test.settle()

    def _lead(self, name: core.Command) -> None:
        """Give a command; after "zero" wait for the end of the tare."""
        test = self._test
        try:
            test.command(name)
        except RefusedError:
            if test.state == "TRIPPED" or self.stopped:
                return
            raise
        if name != "zero":
            return
        tare_s = test.config.tare_ticks / test.config.fs_hz
        self.until(lambda: test.state != "IDLE" or test.zeroing_failed, tare_s + TARE_MARGIN_S)
        if test.state == "IDLE" and not self.stopped:
            raise test.not_zeroed()
