"""Courses at common instants, and their differences from the first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import measures
from rthyb_rt.comparing.courses import MOST, Course, named_apart
from rthyb_rt.errors import InputError
from rthyb_rt.numbers import count

Floats = NDArray[np.float64]

_ON_A_SAMPLE: Final = 1e-6
"""Part of a sampling period within which an instant coincides with a sample."""


@dataclass(frozen=True)
class Overlay:
    """Courses compared with the first of them.

    Attributes:
        courses: two to ten courses.
        fs_hz: rate at which they are compared, that of the slowest, Hz.
        x_m, f_n: displacement and force of each at these instants, over its whole length; nan for
            a course without force.
        shared: number of samples that all of them have.
        lags_s: lag of each behind the first, by the largest correlation of their displacements, s;
            nan if there is no correlation.
        aligned: whether the lags were removed.
        notes: what was done to make them comparable.
    """

    courses: tuple[Course, ...]
    fs_hz: float
    x_m: tuple[Floats, ...]
    f_n: tuple[Floats, ...]
    shared: int
    lags_s: tuple[float, ...]
    aligned: bool
    notes: tuple[str, ...]

    @classmethod
    def of(cls, courses: Sequence[Course], *, align: bool = False) -> Overlay:
        """Compare courses with the first.

        Args:
            courses: two to ten; those with the same name are numbered.
            align: shift each so that it matches the first, for tables with an arbitrary time zero.

        Raises:
            InputError: there are fewer than two or more than ten, or they have no time in common.
        """
        if not 2 <= len(courses) <= MOST:
            raise InputError(
                f"found {count(len(courses), 'recording')}; give 2 to {MOST}", "compare"
            )
        named = named_apart(courses)
        fs_hz = min(course.fs_hz for course in named)
        shifts = [0.0] * len(named)
        found = _at_rate(named, fs_hz, shifts)
        lags = tuple(lag(found[0][0], x, fs_hz) for x, _ in found)
        if align:
            shifts = [one if math.isfinite(one) else 0.0 for one in lags]
            found = _at_rate(named, fs_hz, shifts)
        shared = min(x.size for x, _ in found)
        if shared < 2:
            raise InputError(
                "one of the recordings is empty, so they have no time in common", "compare"
            )
        notes = [*_notes(named, fs_hz, shared), *_shifted(named, shifts)]
        xs, fs = zip(*found, strict=True)
        return cls(tuple(named), fs_hz, xs, fs, shared, lags, align, tuple(notes))

    @property
    def labels(self) -> list[str]:
        """Label of each course."""
        return [course.label for course in self.courses]

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """A row for each course: label, ending, measures, and its difference from the first.

        ``x_difference_nrmse`` is rms(x - x_first) / rms(x_first) over the common instants,
        ``x_difference_m`` the largest magnitude; ``f_difference_nrmse`` and ``f_difference_n`` are
        the same for the force; ``lag_s`` is its lag behind the first, ``lag_samples`` the same in
        sampling periods of the comparison.
        """
        rows = []
        for course, x, f, late in zip(self.courses, self.x_m, self.f_n, self.lags_s, strict=True):
            row: dict[str, Any] = {"label": course.label, "ending": course.ending}
            row |= course.measures
            for letter, unit, first, own in (
                ("x", "m", self.x_m[0], x),
                ("f", "n", self.f_n[0], f),
            ):
                a, b = first[: self.shared], own[: self.shared]
                row[f"{letter}_difference_nrmse"] = _known(measures.response_nrmse(a, b))
                row[f"{letter}_difference_{unit}"] = _known(measures.peak_difference(a, b))
            row["lag_s"] = _known(late)
            row["lag_samples"] = _known(late * self.fs_hz)
            rows.append(row)
        return rows


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _at_rate(
    courses: Sequence[Course], fs_hz: float, shifts: Sequence[float]
) -> list[tuple[Floats, Floats]]:
    """Return displacement and force of each at the instants n / fs_hz, each shifted forward."""
    found = []
    for course, shift in zip(courses, shifts, strict=True):
        last = course.duration_s - 1.0 / course.fs_hz - shift
        # A sample that rounding has moved just beyond the end still exists.
        size = max(0, math.floor(last * fs_hz + _ON_A_SAMPLE) + 1)
        at_s = shift + np.arange(size) / fs_hz
        x = at(course.x_m, course.fs_hz, at_s)
        force = course.f_n
        f = np.full(size, np.nan) if force is None else at(force, course.fs_hz, at_s)
        found.append((x, f))
    return found


def at(y: Floats, fs_hz: float, at_s: Floats) -> Floats:
    """Return a signal at instants other than those of its samples.

    At a sample, that sample; between two, the cubic through the four nearest (Lagrange), whose
    error is proportional to the fourth derivative: below 0.03 % of a sine with 20 samples per
    period. The result is nan where a required sample is missing.

    Args:
        y: samples n / fs_hz, (n,).
        fs_hz: their rate, Hz.
        at_s: instants, (m,), s.
    """
    place = at_s * fs_hz
    near = np.rint(place)
    if np.all(np.abs(place - near) < _ON_A_SAMPLE):
        whole = near.astype(np.int64)
        inside = (whole >= 0) & (whole < y.size)
        return np.where(inside, y[np.clip(whole, 0, max(y.size - 1, 0))], np.nan)
    if y.size < 4:
        return np.interp(place, np.arange(y.size), y, left=np.nan, right=np.nan)
    start = np.clip(np.floor(place).astype(np.int64) - 1, 0, y.size - 4)
    u = place - start
    weights = (
        -(u - 1.0) * (u - 2.0) * (u - 3.0) / 6.0,
        u * (u - 2.0) * (u - 3.0) / 2.0,
        -u * (u - 1.0) * (u - 3.0) / 2.0,
        u * (u - 1.0) * (u - 2.0) / 6.0,
    )
    out = sum(w * y[start + i] for i, w in enumerate(weights))
    beyond = (place < -_ON_A_SAMPLE) | (place > y.size - 1 + _ON_A_SAMPLE)
    return np.where(beyond, np.nan, out)


def lag(first: Floats, other: Floats, fs_hz: float) -> float:
    """Return the lag of a signal behind another, by their largest correlation, s.

    Between samples, it is interpolated by the parabola through the largest value and its
    neighbours. The result is nan if one of the signals is constant zero.
    """
    size = min(first.size, other.size)
    a, b = (np.where(np.isfinite(y[:size]), y[:size], 0.0) for y in (first, other))
    a, b = (y / max(float(np.abs(y).max(initial=0.0)), 1e-300) for y in (a, b))
    if not (a.any() and b.any()):
        return math.nan
    long = 1 << (2 * size - 1).bit_length()
    found = np.fft.irfft(np.conj(np.fft.rfft(a, long)) * np.fft.rfft(b, long), long)
    best = int(np.argmax(found))
    low, mid, high = found[best - 1], found[best], found[(best + 1) % long]
    bend = low - 2.0 * mid + high
    between = 0.5 * (low - high) / bend if bend < 0.0 else 0.0
    whole = best if best < long // 2 else best - long
    return float((whole + between) / fs_hz)


def _notes(courses: Sequence[Course], fs_hz: float, shared: int) -> list[str]:
    notes = list(dict.fromkeys(note for course in courses for note in course.notes))
    other = [course for course in courses if course.fs_hz != fs_hz]
    if other:
        text = _who_has([(c.label, c.fs_hz) for c in other], "has", "have", "Hz")
        notes.append(f"{text}; compared at {fs_hz:g} Hz, the rate of the slowest")
    longer = [c for c in courses if c.duration_s > (shared + 1) / fs_hz]
    if longer:
        text = _who_has([(c.label, c.duration_s) for c in longer], "lasts", "last", "s")
        notes.append(f"{text}; compared over the {shared / fs_hz:.4g} s that they have in common")
    notes += [f"{c.label} contains no force" for c in courses if c.f_n is None]
    return notes


def _who_has(values: Sequence[tuple[str, float]], one: str, many: str, unit: str) -> str:
    """Return values in a sentence: each with its label, or only their range if there are many."""
    if len(values) <= 2:
        return ", ".join(f"{label} {one} {value:.6g} {unit}" for label, value in values)
    low, high = min(v for _, v in values), max(v for _, v in values)
    span = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
    return f"{len(values)} of them {many} {span} {unit}"


def _shifted(courses: Sequence[Course], shifts: Sequence[float]) -> list[str]:
    return [
        f"{course.label} was shifted by {-1e3 * shift:+.2f} ms to match the first"
        for course, shift in zip(courses, shifts, strict=True)
        if shift
    ]
