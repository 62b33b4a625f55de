"""The colour of a channel's noise, determined where the motion does not contribute.

A data sheet states the size of the noise, not its spectrum. In the residual of the best set of
effects, everything outside the band of the motion is noise; within the band it may also be a
missing law, and the noise is interpolated from both sides (Whittle's likelihood of a spectrum, Ark.
Mat. 2 (1953) 423, with one level per band). The total is limited by the data sheet: any further
misfit is a finding, whatever its spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY

OCTAVE = 0.5
"""Width of one level of the spectrum, octaves, if it contains `LINES` lines."""
LINES = 12
"""Least number of lines per level: its standard error is then 1 / sqrt(12), 30 per cent."""
SCORINGS = 12
BISECTIONS = 30
TRIED = 12
"""Number of sets that are tried with the colour of their residual."""
FADE_S = 0.25
"""Time over which the data are faded out next to rows that are not evaluated."""
SELDOM = 0.01
"""Probability that steady noise has a second louder than is accepted."""
EULER = 0.5772156649015329
"""Logarithm of the mean of a line's power less the mean of its logarithm."""


@dataclass(frozen=True)
class Colour:
    """A noise spectrum, relative to the white noise that it replaces.

    Attributes:
        f_hz: centres of its levels, above the motion or where no other channel shares it, (m,).
        power: power of each, relative to that of the white noise, (m,).
        red: the spectrum below: a floor, an addition at 1 Hz, and its exponent of 1 / f.
        from_hz: frequency from which the levels apply.
        least_hz: frequency below which it is constant: at most half of the lowest line observed.
    """

    f_hz: Floats
    power: Floats
    red: tuple[float, float, float]
    from_hz: float
    least_hz: float

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.f_hz.size + len(self.red)

    def at(self, f_hz: Floats) -> Floats:
        """Return the power at given frequencies, relative to that of the white noise, (n,)."""
        low = np.maximum(f_hz, self.least_hz)
        above = _between(low, self.f_hz, self.power)
        return np.where(low < self.from_hz, _red(low, self.red), above)

    def scatter(self, rows: int, fs_hz: float) -> float:
        """Return the relative standard deviation of this noise's rms over a number of rows.

        For a Gaussian process, each line of the spectrum scatters in proportion to its power.
        """
        power = self.at(np.asarray(np.fft.rfftfreq(rows, 1.0 / fs_hz), dtype=np.float64)[1:])
        return float(0.5 * np.sqrt(np.sum(power**2)) / np.sum(power))


class Lines:
    """The spectra of one channel's residuals for different sets of effects.

    Attributes:
        f_hz: the lines, (m,).
    """

    def __init__(self, rows: NDArray[np.bool_], fs_hz: float) -> None:
        """Set which rows count, (n,), and the number of rows per second."""
        self.fs_hz, self.enough = fs_hz, bool(rows.mean() >= POLICY.noise_rows and rows.size >= 256)
        self.f_hz = np.asarray(np.fft.rfftfreq(rows.size, 1.0 / fs_hz), dtype=np.float64)
        self.taper = _faded(rows, fs_hz) if self.enough else np.zeros(rows.size)
        self.scale = float(np.sum(self.taper**2))
        self._kept: tuple[Floats, tuple[float, float] | None] | None = None

    def power(self, residual: Floats) -> Floats | None:
        """Return the power of each line of a residual of shape (n,), (m,); None: too few rows."""
        if not self.enough or self.scale < 128:
            return None
        mean = float(np.sum(self.taper * residual) / np.sum(self.taper))
        power = np.abs(np.fft.rfft(self.taper * (residual - mean))) ** 2 / self.scale
        return power if np.isfinite(power).all() else None

    def band(self, velocity: Floats) -> tuple[float, float] | None:
        """Return the bounds of a motion's band, Hz, from its velocity, (n,); None: at rest.

        Sets along one motion are evaluated in succession: its band is cached.
        """
        if self._kept is None or self._kept[0] is not velocity:
            moved = np.cumsum(np.abs(np.fft.rfft(self.taper * velocity)) ** 2)
            ends = None
            if moved[-1] > 0.0:
                beside = 0.5 * POLICY.noise_beside_motion
                low, high = np.interp([beside, 1.0 - beside], moved / moved[-1], self.f_hz)
                ends = float(low), float(high)
            self._kept = velocity, ends
        return self._kept[1]


def colour_of(
    lines: Lines, power: Floats | None, velocity: Floats, sheet: float | None
) -> Colour | None:
    """Return the colour of a channel's residual; None if it is white or cannot be determined.

    Args:
        lines: the rows that count.
        power: power of the residual, relative to the standard deviation that its noise would have
            if white, from `Lines.power`.
        velocity: velocity of the motion, in any unit, (n,).
        sheet: data sheet value in the residual's unit; None: nothing bounds the noise, and a
            misfit could not be distinguished from it.
    """
    ends = lines.band(velocity) if power is not None and sheet else None
    if power is None or sheet is None or ends is None:
        return None
    f_hz, (low_hz, high_hz) = lines.f_hz, ends
    beside = np.flatnonzero(((f_hz < low_hz) | (f_hz > high_hz)) & (np.arange(f_hz.size) > 1))
    beside = beside[beside < f_hz.size - 1]
    # If little of the spectrum is left above the motion, the two cannot be separated.
    if beside.size < 8 * LINES or high_hz > POLICY.noise_room * lines.fs_hz:
        return None
    # If seen from above only, noise is extrapolated as far as it is regular: an octave each way.
    below = f_hz[beside[0]] < low_hz
    near = beside[f_hz[beside] < (POLICY.noise_near if below else 2.0) * high_hz]
    above = beside[f_hz[beside] > high_hz]
    red = _fitted_red(f_hz[near], power[near])
    found = Colour(*_levels(f_hz[above], power[above]), red, high_hz, 0.5 * float(f_hz[near[0]]))
    if not _better(found, f_hz[beside], power[beside]):
        return None
    return _held(found, f_hz, sheet)


def colour_above(first: int, lines: Floats, seen: Floats, spectra: int) -> Colour | None:
    """Return the colour of noise that is observed above a frequency; None if it is white.

    Args:
        first: the first line observed.
        lines, seen: all lines, Hz, and the power on them that no other channel shares, relative to
            white noise, (m,).
        spectra: number of spectra averaged in that power.
    """
    f_hz, power, from_hz = lines[first:-1], seen[first:-1], float(lines[first])
    near = f_hz < POLICY.noise_near * from_hz
    if near.sum() < 3:
        near[:3] = True
    red = _fitted_red(f_hz[near], power[near])
    levels = _levels(f_hz, power, 0.5 / spectra)
    found = Colour(*levels, red, from_hz, 0.5 * float(f_hz[0]))
    return _continued(found, lines, seen, spectra) if _better(found, f_hz, power) else None


def _continued(found: Colour, f_hz: Floats, seen: Floats, spectra: int) -> Colour:
    """Return a colour continued below the lowest line on which it was observed.

    It is extrapolated, but no noise is larger than what a channel does not share with the others.

    Args:
        found: as observed, and extrapolated.
        f_hz, seen: all lines, and the power on them that no other channel shares, (m,).
        spectra: number of spectra averaged in that power.
    """
    below = (f_hz >= f_hz[2]) & (f_hz < found.from_hz)
    if not below.any():
        return replace(found, red=(float(found.power[0]), 0.0, 0.0))
    middles, most = _levels(f_hz[below], seen[below], 0.5 / spectra)
    power = np.append(np.minimum(found.at(middles), most), found.power)
    return Colour(
        np.append(middles, found.f_hz), power, (float(power[0]), 0.0, 0.0), float(middles[0]),
        min(found.least_hz, float(middles[0])),
    )  # fmt: skip


def within(found: Colour, f_hz: Floats, sheet: float) -> Colour:
    """Return a colour, constant below its levels, without what exceeds the data sheet.

    The highest levels are no noise: motion that no other channel shows, or a fault of the sensor,
    has a band of its own.

    Args:
        found: the colour as observed.
        f_hz: all lines, (m,).
        sheet: data sheet value relative to the standard deviation of the white noise.
    """
    most = (sheet * POLICY.sheet_factor) ** 2

    def cut(cap: float) -> Colour:
        red = (min(found.red[0], cap), 0.0, 0.0)
        return replace(found, power=np.minimum(found.power, cap), red=red)

    low, high = most, float(np.max(found.power))
    if float(np.mean(found.at(f_hz))) <= most:
        return found
    for _ in range(BISECTIONS):
        cap = float(np.sqrt(low * high))
        low, high = (cap, high) if float(np.mean(cut(cap).at(f_hz))) <= most else (low, cap)
    return cut(low)


def red_of(lines: Lines, power: Floats | None, sheet: float | None) -> Colour | None:
    """Return a floor and a rise towards low frequency, also fitted within the motion's band.

    Slow noise extends over the band in which the force of a law has the lines of the motion:
    whether a set leaves such noise is decided by the likelihoods of all sets.

    Args:
        lines, power, sheet: as for `colour_of`.
    """
    if power is None or not sheet:
        return None
    f_hz, inner = lines.f_hz[1:-1], power[1:-1]
    if f_hz.size < 8 * LINES:
        return None
    red = _fitted_red(f_hz, inner)
    found = Colour(f_hz[-1:], _red(f_hz[-1:], red), red, np.inf, 0.5 * float(f_hz[0]))
    return _held(found, lines.f_hz, sheet) if red[1] > 0.0 and _better(found, f_hz, inner) else None


def _held(found: Colour, f_hz: Floats, sheet: float) -> Colour:
    """Return a colour scaled to the size that the data sheet permits, over all lines.

    This includes the lines of the motion's band, into which it is extrapolated. Slower noise
    appears in the mean of the recording, which is a nuisance parameter.
    """
    has, red = f_hz >= min(2.0 * found.least_hz, float(f_hz[2])), found.red
    total = float(np.sum(found.at(f_hz[has]))) / f_hz.size
    factor = POLICY.sheet_factor
    held = float(np.clip(total, (sheet / factor) ** 2, (sheet * factor) ** 2)) / total
    return replace(found, power=held * found.power, red=(held * red[0], held * red[1], red[2]))


def _faded(rows: NDArray[np.bool_], fs_hz: float) -> Floats:
    """Return a weight for each row that fades to zero towards rows that do not count."""
    reach = max(int(FADE_S * fs_hz), 2)
    inner = np.convolve(~rows, np.ones(2 * reach + 1), mode="same") < 0.5
    inner[:reach] = inner[-reach:] = False
    window = np.hanning(2 * reach + 1)
    return np.convolve(inner, window / window.sum(), mode="same")


def _levels(f_hz: Floats, power: Floats, below: float = EULER) -> tuple[Floats, Floats]:
    """Return the levels of a spectrum, `OCTAVE` wide each if there are enough lines.

    ``below``: logarithm of a line's mean less the mean of its logarithm.
    """
    cuts = [0]
    for i in range(1, f_hz.size):
        if f_hz[i] > f_hz[cuts[-1]] * 2.0**OCTAVE and i - cuts[-1] >= LINES:
            cuts.append(i)
    if f_hz.size - cuts[-1] < LINES and len(cuts) > 1:
        cuts.pop()
    parts = [slice(a, b) for a, b in zip(cuts, [*cuts[1:], f_hz.size], strict=True)]
    middles = np.array([float(np.exp(np.mean(np.log(f_hz[p])))) for p in parts])
    # By the logarithm: a single line, such as hum, does not count as noise.
    logs = np.array([float(np.mean(np.log(power[p] + 1e-300))) + below for p in parts])
    return middles, np.exp(logs)


def _between(f_hz: Floats, at_hz: Floats, power: Floats) -> Floats:
    return np.exp(np.interp(np.log(f_hz), np.log(at_hz), np.log(power)))


def _red(f_hz: Floats, red: tuple[float, float, float]) -> Floats:
    floor, more, slope = red
    return np.asarray(floor + more * f_hz**-slope)


def _fitted_red(f_hz: Floats, power: Floats) -> tuple[float, float, float]:
    """Return floor, rise at 1 Hz and exponent with the largest Whittle likelihood.

    For each exponent, the other two by Fisher scoring, both non-negative.
    """
    mean = float(np.mean(power))
    best, found = np.inf, (mean, 0.0, 0.0)
    for slope in np.linspace(0.0, POLICY.noise_steepest, 9):
        rise = f_hz**-slope
        level = np.full(f_hz.size, mean)
        floor = more = 0.0
        for turn in range(SCORINGS):
            # A component far above such a spectrum is a line, not noise.
            noise = power if turn < SCORINGS // 2 else np.minimum(power, POLICY.noise_line * level)
            floor, more = _not_negative(1.0 / level, rise if slope > 0.0 else None, noise / level)
            level = np.maximum(floor + more * rise, 1e-6 * mean)
        likelihood = float(np.sum(np.log(level) + np.minimum(power / level, POLICY.noise_line)))
        if likelihood < best - 1e-9:
            best, found = likelihood, (floor, more, float(slope))
    return found


def _not_negative(weight: Floats, rise: Floats | None, y: Floats) -> tuple[float, float]:
    """Return the non-negative coefficients of ``weight`` and of ``weight`` times ``rise``.

    By least squares for ``y``, each (n,).
    """
    one, right_one = float(weight @ weight), float(weight @ y)
    alone = max(right_one / one, 0.0)
    if rise is None:
        return alone, 0.0
    other = weight * rise
    two, right_two, both = float(other @ other), float(other @ y), float(weight @ other)
    beside = max(right_two / two, 0.0)
    apart = one * two - both * both
    if apart > 0.0:
        first = (two * right_one - both * right_two) / apart
        second = (one * right_two - both * right_one) / apart
        if first >= 0.0 and second >= 0.0:
            return first, second
    return (alone, 0.0) if alone**2 * one >= beside**2 * two else (0.0, beside)


def _better(found: Colour, f_hz: Floats, power: Floats) -> bool:
    """Return whether the levels describe the lines better than a single level (BIC)."""
    level, white = found.at(f_hz), float(np.mean(power))
    gain = np.sum(np.log(white) + power / white) - np.sum(np.log(level) + power / level)
    return bool(2.0 * gain > found.count * np.log(f_hz.size))


def mere(rest: Floats, white: Floats, sheet: float, fs_hz: float) -> bool:
    """Return whether a channel's residual is within its data sheet, and without bursts.

    Given as it is, (n,), and whitened, (n,): slow noise varies in strength, and the rms of one
    recording scatters about the data sheet value. Its mean is not counted: noise that is slower
    than the recording has one, and beyond that noise it is an offset, which is an effect.
    """
    return float(np.std(rest)) < POLICY.sheet_factor * sheet and steady(white, fs_hz)


def steady(white: Floats, fs_hz: float) -> bool:
    """Return whether whitened noise, (n,), has no bursts of a second.

    In a narrow band, a second has few independent values, and the loudest of many is loud by chance
    (chi-squared by Wilson and Hilferty, Proc. Natl. Acad. Sci. 17 (1931) 684).
    """
    count = max(int(white.size / max(fs_hz, 1.0)), 1)
    loudest = max(_rms(part) for part in np.array_split(white, count))
    power = np.abs(np.fft.rfft(white)[1:]) ** 2
    # Of lines distributed exponentially, the mean square is twice the square of the mean.
    values = 4.0 * float(np.sum(power)) ** 2 / max(float(np.sum(power**2)), 1e-300)
    w = 2.0 * count / (9.0 * max(values, 1.0))
    chance = (1.0 - w + NormalDist().inv_cdf(1.0 - SELDOM / count) * np.sqrt(w)) ** 3
    return loudest < max(POLICY.noise_burst, float(np.sqrt(max(chance, 0.0)))) * _rms(white)


def _rms(signal: Floats) -> float:
    return float(np.sqrt(np.mean(signal**2)))
