"""Of what colour a channel's noise is, read where the motion has no part in it.

A data sheet states how large noise is, not of what colour. Of what the best set of effects leaves,
all that lies outside the band of the motion is noise; within the band it may be a law as well, and
the noise there is what stands to either side of it (Whittle's likelihood of a spectrum, Ark. Mat.
2 (1953) 423, with one level for each of some bands). All of it together is no larger than the sheet
allows: a misfit beyond that is a finding, whatever its spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY

OCTAVE = 0.5
"""Width of one level of the spectrum, octaves, where that holds `LINES` lines."""
LINES = 12
"""Least number of lines of one level: it is known to 1 / sqrt(12), 30 per cent, then."""
SCORINGS = 12
TRIED = 12
"""Sets that are tried with the colour of what they leave."""
FADE_S = 0.25
"""Time within which rows that are not judged are faded out."""
EULER = 0.5772156649015329
"""The mean of the logarithm of a line's power lies so far below the logarithm of the mean."""


@dataclass(frozen=True)
class Colour:
    """A spectrum of noise, in units of the white noise that stood for it.

    Attributes:
        f_hz: middles of its levels above the motion, (m,).
        power: power at each of them over that of the white noise, (m,).
        red: the same below: a floor, what adds to it at 1 Hz, and the power of 1 / f it goes with.
        from_hz: where the levels begin to count.
        least_hz: below this it is taken to change no more: half of the lowest line that was seen.
    """

    f_hz: Floats
    power: Floats
    red: tuple[float, float, float]
    from_hz: float
    least_hz: float

    @property
    def count(self) -> int:
        """How many numbers it has."""
        return self.f_hz.size + len(self.red)

    def at(self, f_hz: Floats) -> Floats:
        """Return the power at any frequencies, over that of the white noise, (n,)."""
        low = np.maximum(f_hz, self.least_hz)
        above = _between(low, self.f_hz, self.power)
        return np.where(low < self.from_hz, _red(low, self.red), above)

    def scatter(self, rows: int, fs_hz: float) -> float:
        """Return the relative standard deviation of such noise's rms over a number of rows.

        Of a Gaussian process each line of the spectrum scatters by its own power.
        """
        power = self.at(np.asarray(np.fft.rfftfreq(rows, 1.0 / fs_hz), dtype=np.float64)[1:])
        return float(0.5 * np.sqrt(np.sum(power**2)) / np.sum(power))


class Lines:
    """The spectra of what is left of one channel by one set of effects or another.

    Attributes:
        f_hz: the lines, (m,).
    """

    def __init__(self, rows: NDArray[np.bool_], fs_hz: float) -> None:
        """Take in which rows count, (n,), and how many there are a second."""
        self.fs_hz, self.enough = fs_hz, bool(rows.mean() >= POLICY.noise_rows and rows.size >= 256)
        self.f_hz = np.asarray(np.fft.rfftfreq(rows.size, 1.0 / fs_hz), dtype=np.float64)
        self.taper = _faded(rows, fs_hz) if self.enough else np.zeros(rows.size)
        self.scale = float(np.sum(self.taper**2))
        self._kept: tuple[Floats, tuple[float, float] | None] | None = None

    def power(self, residual: Floats) -> Floats | None:
        """Return the power of each line of a residual of shape (n,), (m,); None of too few rows."""
        if not self.enough or self.scale < 128:
            return None
        mean = float(np.sum(self.taper * residual) / np.sum(self.taper))
        power = np.abs(np.fft.rfft(self.taper * (residual - mean))) ** 2 / self.scale
        return power if np.isfinite(power).all() else None

    def band(self, velocity: Floats) -> tuple[float, float] | None:
        """Return the ends of a motion's band, Hz, from its velocity, (n,); None: it stands still.

        Sets along one motion are asked about one after another: its band is kept.
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
    """Return the colour of what is left of a channel; None where it is white or cannot be told.

    Args:
        lines: the rows that count.
        power: of what is left, over the standard deviation of its noise were that white, as
            `Lines.power` has it.
        velocity: of the motion, of any unit, (n,).
        sheet: what the data sheet states, in the residual's unit; None: nothing bounds the noise,
            and a misfit that is no noise could not be told from it.
    """
    ends = lines.band(velocity) if power is not None and sheet else None
    if power is None or sheet is None or ends is None:
        return None
    f_hz, (low_hz, high_hz) = lines.f_hz, ends
    beside = np.flatnonzero(((f_hz < low_hz) | (f_hz > high_hz)) & (np.arange(f_hz.size) > 1))
    beside = beside[beside < f_hz.size - 1]
    # With little room above the motion nothing tells its noise from what it makes.
    if beside.size < 8 * LINES or high_hz > POLICY.noise_room * lines.fs_hz:
        return None
    # Seen from above only, noise is known as far as it goes on evenly: an octave to either side.
    below = f_hz[beside[0]] < low_hz
    near = beside[f_hz[beside] < (POLICY.noise_near if below else 2.0) * high_hz]
    above = beside[f_hz[beside] > high_hz]
    red = _fitted_red(f_hz[near], power[near])
    found = Colour(*_levels(f_hz[above], power[above]), red, high_hz, 0.5 * float(f_hz[near[0]]))
    if not _better(found, f_hz[beside], power[beside]):
        return None
    return _held(found, f_hz, sheet)


def colour_above(
    f_hz: Floats, power: Floats, spectra: int, from_hz: float, lines: Floats, sheet: float
) -> Colour | None:
    """Return the colour of noise that is seen from a frequency on; None where it is white.

    Args:
        f_hz, power: lines from there on and the power of each over that of white noise, (m,).
        spectra: how many that power is the mean of.
        from_hz: that frequency.
        lines: all lines that there are, Hz.
        sheet: what the data sheet states, over the standard deviation of the white noise.
    """
    near = f_hz < POLICY.noise_near * from_hz
    if near.sum() < 3:
        near[:3] = True
    red = _fitted_red(f_hz[near], power[near])
    levels = _levels(f_hz, power, 0.5 / spectra)
    found = Colour(*levels, red, from_hz, 0.5 * float(f_hz[0]))
    # How small it is has been measured, and slower noise than was seen is the sheet's as well.
    return _held(found, lines, sheet, least=0.0) if _better(found, f_hz, power) else None


def red_of(lines: Lines, power: Floats | None, sheet: float | None) -> Colour | None:
    """Return a floor and what rises from it towards slow motion, read within the motion's band too.

    Slow noise swells over all of the band, where the force of a law has the lines of the motion: if
    a set leaves such noise, it is for the likelihoods of all sets to say.

    Args:
        lines, power, sheet: as of `colour_of`.
    """
    if power is None or not sheet:
        return None
    f_hz, inner = lines.f_hz[1:-1], power[1:-1]
    if f_hz.size < 8 * LINES:
        return None
    red = _fitted_red(f_hz, inner)
    found = Colour(f_hz[-1:], _red(f_hz[-1:], red), red, np.inf, 0.5 * float(f_hz[0]))
    return _held(found, lines.f_hz, sheet) if red[1] > 0.0 and _better(found, f_hz, inner) else None


def _held(found: Colour, f_hz: Floats, sheet: float, least: float | None = None) -> Colour:
    """Return a colour as large as the data sheet allows, over all lines that a recording has.

    Those of the motion's band count as well, into which it is continued. Slower noise stands in the
    mean of the recording, which is a nuisance. ``least`` takes the place of what the sheet allows
    at least.
    """
    has, red = f_hz >= min(2.0 * found.least_hz, float(f_hz[2])), found.red
    total = float(np.sum(found.at(f_hz[has]))) / f_hz.size
    factor = POLICY.sheet_factor
    low = sheet / factor if least is None else least
    held = float(np.clip(total, low**2, (sheet * factor) ** 2)) / total
    return replace(found, power=held * found.power, red=(held * red[0], held * red[1], red[2]))


def _faded(rows: NDArray[np.bool_], fs_hz: float) -> Floats:
    """Return a weight for each row that falls to nothing towards those that do not count."""
    reach = max(int(FADE_S * fs_hz), 2)
    inner = np.convolve(~rows, np.ones(2 * reach + 1), mode="same") < 0.5
    inner[:reach] = inner[-reach:] = False
    window = np.hanning(2 * reach + 1)
    return np.convolve(inner, window / window.sum(), mode="same")


def _levels(f_hz: Floats, power: Floats, below: float = EULER) -> tuple[Floats, Floats]:
    """Return the levels of a spectrum, of `OCTAVE` each where there are lines enough.

    ``below`` says by how much the mean of a line's logarithm lies below that of its mean.
    """
    cuts = [0]
    for i in range(1, f_hz.size):
        if f_hz[i] > f_hz[cuts[-1]] * 2.0**OCTAVE and i - cuts[-1] >= LINES:
            cuts.append(i)
    if f_hz.size - cuts[-1] < LINES and len(cuts) > 1:
        cuts.pop()
    parts = [slice(a, b) for a, b in zip(cuts, [*cuts[1:], f_hz.size], strict=True)]
    middles = np.array([float(np.exp(np.mean(np.log(f_hz[p])))) for p in parts])
    # By the logarithm: a line, such as hum, does not count as noise.
    logs = np.array([float(np.mean(np.log(power[p] + 1e-300))) + below for p in parts])
    return middles, np.exp(logs)


def _between(f_hz: Floats, at_hz: Floats, power: Floats) -> Floats:
    return np.exp(np.interp(np.log(f_hz), np.log(at_hz), np.log(power)))


def _red(f_hz: Floats, red: tuple[float, float, float]) -> Floats:
    floor, more, slope = red
    return np.asarray(floor + more * f_hz**-slope)


def _fitted_red(f_hz: Floats, power: Floats) -> tuple[float, float, float]:
    """Return floor, rise at 1 Hz and its slope of greatest Whittle likelihood.

    For each slope the two others by Fisher scoring, neither below nothing.
    """
    mean = float(np.mean(power))
    best, found = np.inf, (mean, 0.0, 0.0)
    for slope in np.linspace(0.0, POLICY.noise_steepest, 9):
        rise = f_hz**-slope
        level = np.full(f_hz.size, mean)
        floor = more = 0.0
        for turn in range(SCORINGS):
            # What stands far out of such a spectrum is a line, and no noise.
            noise = power if turn < SCORINGS // 2 else np.minimum(power, POLICY.noise_line * level)
            floor, more = _not_negative(1.0 / level, rise if slope > 0.0 else None, noise / level)
            level = np.maximum(floor + more * rise, 1e-6 * mean)
        likelihood = float(np.sum(np.log(level) + np.minimum(power / level, POLICY.noise_line)))
        if likelihood < best - 1e-9:
            best, found = likelihood, (floor, more, float(slope))
    return found


def _not_negative(weight: Floats, rise: Floats | None, y: Floats) -> tuple[float, float]:
    """Return the coefficients of ``weight``, and of it times ``rise``, that are not negative.

    Of least squares of ``y``, each (n,).
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
    """Return whether the levels tell the lines better than one for all of them (BIC)."""
    level, white = found.at(f_hz), float(np.mean(power))
    gain = np.sum(np.log(white) + power / white) - np.sum(np.log(level) + power / level)
    return bool(2.0 * gain > found.count * np.log(f_hz.size))


def mere(rest: Floats, white: Floats, sheet: float, fs_hz: float) -> bool:
    """Return whether what is left of a channel is within its data sheet, and in no bursts.

    As it is, (n,), and as it would be were its noise white, (n,): slow noise swells by itself, and
    the rms of one recording scatters about what a sheet states.
    """
    return _rms(rest) < POLICY.sheet_factor * sheet and steady(white, fs_hz)


def steady(white: Floats, fs_hz: float) -> bool:
    """Return whether noise that is made white, (n,), comes in no bursts of a second."""
    count = max(int(white.size / max(fs_hz, 1.0)), 1)
    loudest = max(_rms(part) for part in np.array_split(white, count))
    return loudest < POLICY.noise_burst * _rms(white)


def _rms(signal: Floats) -> float:
    return float(np.sqrt(np.mean(signal**2)))
