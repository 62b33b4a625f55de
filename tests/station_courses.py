"""Common procedures of all benches for a station."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from rthyb_rt import core


class Courses:
    """A station on the stepped clock with its records, and ways to a state; ``step`` differs."""

    station: core.Station
    records: list[np.ndarray]

    def step(self, command: core.Command = "none", **faults: Any) -> core.StationTick:
        """One tick."""
        raise NotImplementedError

    def until(self, state: str, most: int = 20000) -> int:
        for n in range(most):
            if self.station.state == state:
                return n
            self.step()
        raise AssertionError(f"never reached {state}, stayed in {self.station.state}")

    def running(self, ticks: int = 300) -> Self:
        self.step()
        self.step("zero")
        self.until("ZEROED")
        self.step("arm")
        self.step("start")
        self.until("RUNNING")
        for _ in range(ticks):
            self.step()
        assert self.station.state == "RUNNING"
        return self

    def rows(self) -> np.ndarray:
        return np.concatenate(self.records)
