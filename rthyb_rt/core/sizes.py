"""The rate of the core, and what it has room for; known without arrays."""

from __future__ import annotations

from typing import Final

from rthyb_rt._core import lib

FS_HZ: Final = 1024.0
"""The rate of a test that states none; that of one that does is its own: `Setup.rate`."""
PERIOD_S: Final = 1.0 / FS_HZ
STANDARD_RATE_HZ: Final = 1024
"""The same as ticks a second, which are whole ones."""
WINDOW_MAX: Final[int] = lib.RTHYB_WINDOW_MAX
DELAY_MAX: Final[int] = lib.RTHYB_DELAY_MAX
ELEMENTS_MAX: Final[int] = lib.RTHYB_ELEMENTS_MAX
DENSE_MAX: Final[int] = lib.RTHYB_DENSE_MAX
IWAN_SLIDERS: Final[int] = lib.RTHYB_IWAN_SLIDERS
COUPLED_MAX: Final[int] = lib.RTHYB_COUPLED_MAX
"""Axes at one specimen."""
