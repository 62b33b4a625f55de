"""The sample rate of a test, and what the files' figures are at it.

The rate belongs to the test (`test.sample_rate_hz`), in real time to the drive as well
(`link.sample_rate_hz`), and the two must agree. What the files count in samples they count in
those of 1/1024 s, whatever the rate: a file says the same of time at every rate, and a figure that
`rthyb identify` has found in real time goes for a test in virtual time at 4096 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

STANDARD_HZ: Final = 1024.0
"""The rate where nothing else is said (the paper's Section 4), and of a file's samples."""
LEAST_HZ: Final = 256.0
MOST_HZ: Final = 4096.0
"""What the core has room for: RTHYB_DELAY_MAX, RTHYB_WINDOW_MAX, RTHYB_RECENT_MAX are a second."""


@dataclass(frozen=True)
class Rate:
    """A sample rate.

    Attributes:
        hz: samples a second.
    """

    hz: float = STANDARD_HZ

    @property
    def period_s(self) -> float:
        """Time from sample to sample."""
        return 1.0 / self.hz

    @property
    def pace(self) -> float:
        """Samples of this rate in one of 1/1024 s."""
        return self.hz / STANDARD_HZ

    @property
    def whole_hz(self) -> int:
        """Samples a second of a rate in real time, which is a whole number."""
        return round(self.hz)

    def ticks(self, seconds: float) -> int:
        """Return a time in whole samples, at least one."""
        return max(1, round(seconds * self.hz))

    def samples(self, standard: float) -> float:
        """Return what a file gives in samples of 1/1024 s, in samples of this rate."""
        return standard * self.pace

    def increment(self, standard: float) -> float:
        """Return what a file allows to be gone in 1/1024 s, for one sample of this rate."""
        return standard / self.pace

    def leap(self, standard: float) -> float:
        """Return what a file allows a reading to leap by in 1/1024 s, for one sample of this rate.

        Of a longer sample the motion is larger; of a shorter one the noise is not smaller.
        """
        return standard / min(self.pace, 1.0)


STANDARD: Final = Rate()
