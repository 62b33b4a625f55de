"""Default rate and sizes of the core, available without NumPy."""

from __future__ import annotations

from typing import Final

from rthyb_rt._core import lib

FS_HZ: Final = 1024.0
"""Rate of a test that gives none; the rate of a particular test is `Setup.rate`."""
PERIOD_S: Final = 1.0 / FS_HZ
STANDARD_RATE_HZ: Final = 1024
"""The same as a whole number of ticks per second."""
WINDOW_MAX: Final[int] = lib.RTHYB_WINDOW_MAX
DELAY_MAX: Final[int] = lib.RTHYB_DELAY_MAX
ELEMENTS_MAX: Final[int] = lib.RTHYB_ELEMENTS_MAX
DENSE_MAX: Final[int] = lib.RTHYB_DENSE_MAX
IWAN_SLIDERS: Final[int] = lib.RTHYB_IWAN_SLIDERS
SENSORS_MAX: Final[int] = lib.RTHYB_SENSORS_MAX
"""Largest number of displacement sensors, and of load cells, without an actuator."""
COUPLED_MAX: Final[int] = lib.RTHYB_COUPLED_MAX
"""Largest number of axes at one specimen."""
