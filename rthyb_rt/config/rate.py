"""The sample rate of a test, and conversion of the files' figures to it.

The rate belongs to the test (`test.sample_rate_hz`) and in real time also to the drive
(`link.sample_rate_hz`); the two must agree. Samples in the files are always of 1/1024 s: a file
describes the same times at every rate, and a value that `rthyb identify` found in real time
also applies to a test in virtual time at 4096 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

STANDARD_HZ: Final = 1024.0
"""The default rate (the paper's Section 4), and that of samples in files."""
LEAST_HZ: Final = 256.0
MOST_HZ: Final = 4096.0
"""Sizes of the core: RTHYB_DELAY_MAX, RTHYB_WINDOW_MAX and RTHYB_RECENT_MAX are one second."""


@dataclass(frozen=True)
class Rate:
    """A sample rate.

    Attributes:
        hz: samples per second.
    """

    hz: float = STANDARD_HZ

    @property
    def period_s(self) -> float:
        """Sampling period."""
        return 1.0 / self.hz

    @property
    def pace(self) -> float:
        """Samples of this rate per sample of 1/1024 s."""
        return self.hz / STANDARD_HZ

    @property
    def whole_hz(self) -> int:
        """Samples per second of a rate in real time, a whole number."""
        return round(self.hz)

    def ticks(self, seconds: float) -> int:
        """Return a time in whole samples, at least one."""
        return max(1, round(seconds * self.hz))

    def samples(self, standard: float) -> float:
        """Return a number of samples of 1/1024 s as a number of samples of this rate."""
        return standard * self.pace

    def increment(self, standard: float) -> float:
        """Return an allowed change in 1/1024 s as an allowed change in one sample of this rate."""
        return standard / self.pace

    def leap(self, standard: float) -> float:
        """Return an allowed jump of a reading in 1/1024 s for one sample of this rate.

        During a longer sample the motion is larger; in a shorter one the noise is not smaller.
        """
        return standard / min(self.pace, 1.0)


STANDARD: Final = Rate()
