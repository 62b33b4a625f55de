"""The displacements of a prescribed history, sample by sample.

Every history begins and ends at rest at zero, and its velocity is continuous: cyclic histories
connect turning points by half-cosine ramps, the others have cosine tapers. A half-cosine ramp of
length L and duration T has the peak velocity pi L / (2 T) and the peak acceleration
pi^2 L / (2 T^2); differences between samples are means of these and therefore never larger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config.prescribed_history import (
    CyclicHistory,
    History,
    RandomHistory,
    SineHistory,
    SweepHistory,
)
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]

REST_S: Final = 1.0
"""Rest after a history, in the laboratory's time: the longest delay of a rig."""
MOST_SAMPLES: Final = 3600 * 4096
"""An hour at the highest rate, as for the longest hybrid test; four hours at 1024 Hz."""


@dataclass(frozen=True)
class Cycle:
    """One whole cycle of a history.

    Attributes:
        step: number of its amplitude, from 0.
        amplitude_m: its amplitude.
        start, stop: its rows of the path; both are where the displacement rises through zero.
    """

    step: int
    amplitude_m: float
    start: int
    stop: int


@dataclass(frozen=True)
class HistoryPlan:
    """A history at every sample of its test.

    Attributes:
        path_m: displacement, (n,); the first and the last are zero.
        cycles: whole cycles, each of one amplitude, in order; none for a sweep or noise.
        rate_hz: samples per second of the laboratory's time.
    """

    path_m: Floats
    cycles: tuple[Cycle, ...]
    rate_hz: float

    @property
    def peak_m(self) -> float:
        """Greatest displacement, m."""
        return float(np.abs(self.path_m).max(initial=0.0))

    @property
    def peak_m_per_s(self) -> float:
        """Greatest velocity, from differences between samples, m/s."""
        return float(np.abs(np.diff(self.path_m)).max(initial=0.0)) * self.rate_hz

    @property
    def peak_m_per_s2(self) -> float:
        """Greatest acceleration, from second differences, with rest before and after, m/s^2."""
        padded = np.pad(self.path_m, 2)
        return float(np.abs(np.diff(padded, 2)).max(initial=0.0)) * self.rate_hz**2


def plan(
    given: History, rate_hz: float, acceleration_m_per_s2: float, time_scale: float = 1.0
) -> HistoryPlan:
    """Return the displacements of a history.

    Args:
        given: the history in the test file.
        rate_hz: samples per second.
        acceleration_m_per_s2: in the laboratory, for ramps that are given by their velocity without
            an acceleration.
        time_scale: seconds in the laboratory per second of the history.

    Raises:
        InputError: it has more than `MOST_SAMPLES` samples, or frequencies too high for the rate.
    """
    own_hz = rate_hz * time_scale
    _check_frequency(given, own_hz)
    # In the history's own time, in which accelerations are larger by the square of the time scale.
    lasts_s = _duration_s(given, own_hz, acceleration_m_per_s2 * time_scale**2)
    count = lasts_s * own_hz + REST_S * rate_hz
    if count > MOST_SAMPLES:
        raise InputError(
            f"the history lasts {lasts_s * time_scale:.6g} s, {count:.0f} samples at {rate_hz:g} "
            f"Hz; at most {MOST_SAMPLES} are allowed; shorten it, make it faster, or lower "
            "test.sample_rate_hz",
            "history",
        )
    if isinstance(given, CyclicHistory):
        path, cycles = _of_turns(given, own_hz, acceleration_m_per_s2 * time_scale**2)
    elif isinstance(given, SineHistory):
        path, cycles = _sine(given, own_hz)
    else:
        path = _sweep(given, own_hz) if isinstance(given, SweepHistory) else _noise(given, own_hz)
        cycles = ()
    whole = np.concatenate([path, np.zeros(math.ceil(REST_S * rate_hz) + 1)])
    return HistoryPlan(whole, cycles, rate_hz)


def _check_frequency(given: History, own_hz: float) -> None:
    """Refuse a frequency with fewer than eight samples per period."""
    keys = ("frequency_hz", "from_hz", "to_hz")
    found = [(key, value) for key in keys if (value := getattr(given, key, None)) is not None]
    for key, value in found:
        if value > own_hz / 8.0:
            raise InputError(
                f"found {value:g} Hz; at most {own_hz / 8.0:g} Hz is allowed, eight samples per "
                "period; lower it, or raise test.sample_rate_hz or test.time_scale",
                f"history.{key}",
            )


def _duration_s(given: History, own_hz: float, most_m_per_s2: float) -> float:
    if isinstance(given, CyclicHistory):
        return float(_ways(given, own_hz, most_m_per_s2)[1].sum())
    if isinstance(given, SineHistory):
        return (given.cycles + 2 * given.taper_cycles) / given.frequency_hz
    return given.duration_s


def taper(t: Floats, lasts_s: float, taper_s: float) -> Floats:
    """Return the factor that fades in from 0 to 1 and out again.

    Half a cosine over ``taper_s`` at either end of ``lasts_s``, so that the velocity is continuous.
    """
    share = np.clip(np.minimum(t, lasts_s - t) / taper_s, 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * share))


def _instants(lasts_s: float, own_hz: float) -> Floats:
    return np.arange(math.ceil(lasts_s * own_hz)) / own_hz


# ---- with turning points ------------------------------------------------------------------------


def _turns(given: CyclicHistory) -> Floats:
    """Return zero, the turning points, and zero, m."""
    found = [0.0]
    for step in given.steps:
        found += [step.amplitude_m, -step.amplitude_m] * step.cycles
    return np.array([*found, 0.0])


def _ways(given: CyclicHistory, own_hz: float, most_m_per_s2: float) -> tuple[Floats, Floats]:
    """Return the turning points, and the duration of the ramp from each to the next, s."""
    turns = _turns(given)
    if given.frequency_hz is not None:
        return turns, np.full(turns.size - 1, 0.5 / given.frequency_hz)
    assert given.velocity_m_per_s is not None
    most = given.acceleration_m_per_s2 or most_m_per_s2
    way = np.abs(np.diff(turns))
    lasts = np.maximum(
        np.pi * way / (2.0 * given.velocity_m_per_s), np.pi * np.sqrt(way / (2.0 * most))
    )
    # Rounded up to whole samples, so that each turning point is a sample.
    return turns, np.ceil(lasts * own_hz - 1e-9) / own_hz


def _of_turns(
    given: CyclicHistory, own_hz: float, most_m_per_s2: float
) -> tuple[Floats, tuple[Cycle, ...]]:
    turns, lasts = _ways(given, own_hz, most_m_per_s2)
    begins = np.concatenate([[0.0], np.cumsum(lasts)])
    t = _instants(begins[-1], own_hz)
    # Rounded up, so that a turning point that is a sample does not belong to the previous ramp.
    at = np.clip(np.searchsorted(begins, t + 1e-9 / own_hz, side="right") - 1, 0, lasts.size - 1)
    share = np.clip((t - begins[at]) / lasts[at], 0.0, 1.0)
    path = turns[at] + np.diff(turns)[at] * (0.5 - 0.5 * np.cos(np.pi * share))
    return path, tuple(_cycles_of_turns(given, turns, lasts, begins, own_hz))


def _cycles_of_turns(
    given: CyclicHistory, turns: Floats, lasts: Floats, begins: Floats, own_hz: float
) -> list[Cycle]:
    rising = [0.0]
    for i in range(2, turns.size - 1, 2):
        low, high = -turns[i], turns[i + 1]
        # Zero of -low + (low + high) (1 - cos) / 2.
        rising.append(begins[i] + lasts[i] / np.pi * math.acos(1.0 - 2.0 * low / (low + high)))
    rows = [round(moment * own_hz) for moment in (*rising[: (turns.size - 2) // 2], begins[-1])]
    found = list[Cycle]()
    for number, step in enumerate(given.steps):
        for _ in range(step.cycles):
            n = len(found)
            found.append(Cycle(number, step.amplitude_m, rows[n], rows[n + 1]))
    return found


# ---- with tapers --------------------------------------------------------------------------------


def _sine(given: SineHistory, own_hz: float) -> tuple[Floats, tuple[Cycle, ...]]:
    f, ends = given.frequency_hz, given.taper_cycles
    lasts = (given.cycles + 2 * ends) / f
    t = _instants(lasts, own_hz)
    path = given.amplitude_m * taper(t, lasts, ends / f) * np.sin(2.0 * np.pi * f * t)
    rows = [round((ends + n) / f * own_hz) for n in range(given.cycles + 1)]
    return path, tuple(
        Cycle(0, given.amplitude_m, rows[n], rows[n + 1]) for n in range(given.cycles)
    )


def _sweep(given: SweepHistory, own_hz: float) -> Floats:
    t = _instants(given.duration_s, own_hz)
    share, first, last = t / given.duration_s, given.from_hz, given.to_hz
    if given.spacing == "linear" or first == last:
        f = first + (last - first) * share
        turns = t * (first + 0.5 * (last - first) * share)
    else:
        rate = math.log(last / first)
        f = first * np.exp(rate * share)
        turns = given.duration_s * first / rate * np.expm1(rate * share)
    size = np.full(t.size, given.amplitude_m)
    if given.velocity_m_per_s is not None:
        # A smooth minimum of both, below either of them everywhere.
        over = given.amplitude_m * 2.0 * np.pi * f / given.velocity_m_per_s
        size = given.amplitude_m / (1.0 + over**4) ** 0.25
    return np.asarray(
        size * taper(t, given.duration_s, given.taper_s) * np.sin(2.0 * np.pi * turns)
    )


def _noise(given: RandomHistory, own_hz: float) -> Floats:
    """Return spectral lines of equal size and random phase between two frequencies, tapered.

    Lines are 1 / T apart, so that only the tapers contribute outside the band.
    """
    t = _instants(given.duration_s, own_hz)
    first = math.ceil(given.from_hz * t.size / own_hz)
    last = math.floor(given.to_hz * t.size / own_hz)
    if last < first:
        raise InputError(
            f"found {given.from_hz:g} to {given.to_hz:g} Hz, between which {given.duration_s:g} s "
            "of noise has no spectral line; lengthen history.duration_s or widen the band",
            "history.to_hz",
        )
    spectrum = np.zeros(t.size // 2 + 1, np.complex128)
    # NumPy guarantees the raw bit stream across versions, but not that of its distributions.
    bits = np.random.PCG64(given.seed).random_raw(last - first + 1)
    spectrum[first : last + 1] = np.exp(2j * np.pi * (np.asarray(bits) >> 11) * 2.0**-53)
    path = np.fft.irfft(spectrum, t.size) * taper(t, given.duration_s, given.taper_s)
    size = np.abs(path).max() if given.peak_m is not None else np.sqrt(np.mean(path**2))
    wanted = given.peak_m if given.peak_m is not None else given.rms_m
    return np.asarray(path * (float(wanted or 0.0) / size))
