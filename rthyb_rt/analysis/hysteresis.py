"""Results from the loops of a prescribed history: backbone, secant stiffness, energy, damping.

A cycle with the peaks (x+, f+) and (x-, f-) has the secant stiffness k = (f+ - f-) / (x+ - x-), the
energy E = closed integral of f dx, and the equivalent viscous damping ratio
E / (2 pi k X^2), X = (x+ - x-) / 2: that of a linear oscillator which dissipates the same energy
in resonance (Jacobsen, Trans. ASME 52, 1930; Chopra, Dynamics of Structures, section 3.9).
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rthyb_rt import documents
from rthyb_rt.analysis import measures
from rthyb_rt.config.testfile import TestFile
from rthyb_rt.core import RUNNING
from rthyb_rt.errors import InputError
from rthyb_rt.lab import histories
from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]

AROUND: Final = 0.01
"""Share of a cycle on either side of a peak that is averaged: enough to suppress sensor noise, and
only 0.07 % below the peak of a sine."""


@dataclass(frozen=True)
class MeasuredCycle:
    """One measured cycle.

    Attributes:
        rows: of the test proper, first and one past the last.
        upper, lower: displacement and force at the two peaks, m and N.
        secant_n_per_m: stiffness between them.
        energy_j: dissipated by the specimen.
        damping_ratio: equivalent, of critical.
    """

    rows: tuple[int, int]
    upper: tuple[float, float]
    lower: tuple[float, float]
    secant_n_per_m: float
    energy_j: float
    damping_ratio: float


@dataclass(frozen=True)
class Amplitude:
    """Results of the cycles of one amplitude.

    Attributes:
        amplitude_m: prescribed amplitude.
        loops: the cycles that were carried out, in order; at least one.
    """

    amplitude_m: float
    loops: tuple[MeasuredCycle, ...]

    @property
    def first(self) -> MeasuredCycle:
        """The first cycle, whose peaks are points of the backbone."""
        return self.loops[0]

    @property
    def last(self) -> MeasuredCycle:
        """The last cycle, which no longer depends on the previous amplitude."""
        return self.loops[-1]


def amplitudes(rec: RecordedTest) -> tuple[Amplitude, ...]:
    """Return the loops of a recording by amplitude, in their order.

    Args:
        rec: of any test.

    Returns:
        () for a test without cycles: a hybrid test, a sweep, noise, or one of another version.
    """
    plan = plan_of(rec)
    if plan is None or not plan.cycles:
        return ()
    run = rec.samples[rec.samples["state"] == RUNNING]
    x, f = (np.ascontiguousarray(run[name]) for name in ("x_meas_m", "f_meas_n"))
    late = _late_rows(np.ascontiguousarray(run["x_num_m"]), x, rec.fs_hz)
    found: dict[int, list[MeasuredCycle]] = {}
    for cycle in plan.cycles:
        # A row contains the command of the previous sample.
        start, stop = cycle.start + 1 + late, cycle.stop + 1 + late
        if stop < x.size and np.isfinite(x[start : stop + 1] + f[start : stop + 1]).all():
            found.setdefault(cycle.step, []).append(_loop(x, f, start, stop))
    sizes = {cycle.step: cycle.amplitude_m for cycle in plan.cycles}
    return tuple(Amplitude(sizes[step], tuple(loops)) for step, loops in found.items())


def plan_of(rec: RecordedTest) -> histories.HistoryPlan | None:
    """Return the history that a recording followed; None if it has none that can be read."""
    try:
        raw = documents.toml(rec.test_toml)
        if "history" not in raw:
            return None
        test = TestFile.model_validate(raw)
        assert test.history is not None
        # The resolved file contains all values of its limits.
        most = test.limits.path_acceleration_m_per_s2 or 1.0
        return histories.plan(test.history, rec.fs_hz, most, test.test.time_scale)
    except (tomllib.TOMLDecodeError, ValidationError, InputError):
        return None


def _late_rows(x_num: Floats, x_meas: Floats, fs_hz: float) -> int:
    """Return the delay of the specimen behind the command, rounded to whole rows."""
    delay_s = measures.fei(x_num, x_meas, fs_hz).delay_s
    return max(round(delay_s * fs_hz), 0) if np.isfinite(delay_s) else 0


def _loop(x: Floats, f: Floats, start: int, stop: int) -> MeasuredCycle:
    own, force = x[start : stop + 1], f[start : stop + 1]
    upper, lower = _peak(own, force, int(np.argmax(own))), _peak(own, force, int(np.argmin(own)))
    way = upper[0] - lower[0]
    secant = (upper[1] - lower[1]) / way if way > 0.0 else 0.0
    energy = float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(own)))
    elastic = 2.0 * np.pi * secant * (0.5 * way) ** 2
    return MeasuredCycle(
        (start, stop + 1), upper, lower, secant, energy, energy / elastic if elastic > 0.0 else 0.0
    )


def _peak(x: Floats, f: Floats, at: int) -> tuple[float, float]:
    around = max(int(AROUND * x.size), 1)
    part = slice(max(at - around, 0), at + around + 1)
    return float(x[part].mean()), float(f[part].mean())
