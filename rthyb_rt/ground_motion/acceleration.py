"""A ground motion: equally spaced accelerations with their provenance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion.acceleration_units import STANDARD_GRAVITY_MPS2

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GroundMotion:
    """One component of ground acceleration.

    Attributes:
        name: short name for tables and file names.
        source: origin of the data, in words.
        dt_s: sampling interval, s.
        acceleration_mps2: ground acceleration, m/s2, shape (n,); a read-only copy is kept.
            Sample k belongs to the instant k dt_s; the ground is at rest outside the record.
        details: provenance as text (format, units, points, station, scale, warnings, ...).

    Raises:
        ValueError: not one-dimensional, empty, not finite, or ``dt_s`` not positive.
    """

    name: str
    source: str
    dt_s: float
    acceleration_mps2: FloatArray
    details: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Take a read-only copy of the samples and check them."""
        samples = np.array(self.acceleration_mps2, dtype=np.float64)
        if samples.ndim != 1 or samples.size == 0 or not bool(np.isfinite(samples).all()):
            raise ValueError(
                "acceleration_mps2 must be a non-empty one-dimensional array of finite numbers"
            )
        if not (math.isfinite(self.dt_s) and self.dt_s > 0.0):
            raise ValueError(f"dt_s must be finite and positive, not {self.dt_s}")
        samples.flags.writeable = False
        object.__setattr__(self, "acceleration_mps2", samples)
        object.__setattr__(self, "details", MappingProxyType(dict(self.details)))

    @property
    def pga_mps2(self) -> float:
        """Peak ground acceleration, m/s2."""
        return float(np.abs(self.acceleration_mps2).max())

    @property
    def pga_g(self) -> float:
        """Peak ground acceleration in units of standard gravity (9.80665 m/s2)."""
        return self.pga_mps2 / STANDARD_GRAVITY_MPS2

    @property
    def duration_s(self) -> float:
        """Number of samples times the interval, s: 1560 samples at 50 Hz are 31.2 s."""
        return self.acceleration_mps2.size * self.dt_s

    @property
    def time_s(self) -> FloatArray:
        """Instants of the samples, s, shape (n,), the first at 0."""
        return np.arange(self.acceleration_mps2.size, dtype=np.float64) * float(self.dt_s)

    def scaled(self, *, pga_g: float | None = None, factor: float | None = None) -> GroundMotion:
        """Return the motion scaled to a peak of ``pga_g`` or multiplied by ``factor``.

        Args:
            pga_g: peak ground acceleration to scale to, g, not negative.
            factor: multiplier, any finite number (a negative one reverses the direction).

        Raises:
            InputError: a scale that is not finite, a negative PGA, or a record without motion
                that should be scaled to a PGA.
            ValueError: both or neither are given.
        """
        if (pga_g is None) == (factor is None):
            raise ValueError("give either pga_g or factor")
        if pga_g is not None:
            if not (math.isfinite(pga_g) and pga_g >= 0.0):
                raise InputError(
                    f"PGA {pga_g} g: must be a finite number >= 0", "ground_motion.pga_g"
                )
            if self.pga_g == 0.0:
                raise InputError(
                    f"{self.name} has no motion (every value is 0) and cannot be scaled to "
                    f"{pga_g} g; choose another record or another part of it",
                    "ground_motion.pga_g",
                )
            factor = pga_g / self.pga_g
        assert factor is not None
        if not math.isfinite(factor):
            raise InputError(f"factor {factor}: must be a finite number", "ground_motion.factor")
        total = float(self.details.get("scale", "1")) * factor
        return self._changed(self.acceleration_mps2 * factor, scale=f"{total!r}")

    def window(self, start_s: float = 0.0, duration_s: float | None = None) -> GroundMotion:
        """Return the samples from ``start_s`` on, for ``duration_s`` or to the end.

        The samples k with start_s <= k dt_s < start_s + duration_s are kept; the first of them
        becomes the instant 0. 50 s at 200 Hz are 10,000 samples.

        Raises:
            InputError: the window is empty or begins outside the record.
        """
        size = self.acceleration_mps2.size
        length = self.duration_s - start_s if duration_s is None else duration_s
        if not (0.0 <= start_s < self.duration_s):
            raise InputError(
                f"found {start_s:g} s, but {self.name} lasts only {self.duration_s:g} s; give an "
                "earlier start",
                "ground_motion.start_s",
            )
        if not length > 0.0:
            raise InputError(
                f"duration {length} s of {self.name}: must be more than 0 s",
                "ground_motion.duration_s",
            )
        # An instant within a millionth of an interval of a sample counts as that sample.
        first = math.ceil(start_s / self.dt_s - 1e-6)
        ends = min((start_s + length) / self.dt_s, float(size))
        last = math.ceil(ends - 1e-6)
        if last <= first:
            raise InputError(
                f"no sample of {self.name} lies in {length} s starting at {start_s} s (interval "
                f"{self.dt_s:g} s); choose a longer part",
                "ground_motion.duration_s",
            )
        if (first, last) == (0, size):
            return self
        note = f"{first * self.dt_s:g} s to {last * self.dt_s:g} s"
        return self._changed(self.acceleration_mps2[first:last], window=note)

    def padded(self, free_vibration_s: float) -> GroundMotion:
        """Return the motion followed by ``free_vibration_s`` of rest.

        Raises:
            InputError: the time is negative or not finite.
        """
        if not (math.isfinite(free_vibration_s) and free_vibration_s >= 0.0):
            raise InputError(
                f"{free_vibration_s} s of free vibration: must be a finite number >= 0",
                "test.free_vibration_s",
            )
        zeros = np.zeros(math.ceil(free_vibration_s / self.dt_s - 1e-6))
        if zeros.size == 0:
            return self
        return self._changed(
            np.concatenate([self.acceleration_mps2, zeros]),
            free_vibration_s=f"{free_vibration_s:g}",
        )

    def _changed(self, samples: ArrayLike, **notes: str) -> GroundMotion:
        """Return a copy with other samples and further details."""
        return replace(
            self,
            acceleration_mps2=np.asarray(samples, dtype=np.float64),
            details={**self.details, **notes},
        )
