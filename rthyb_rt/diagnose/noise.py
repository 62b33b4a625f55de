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


def colour_of(
    residual: Floats,
    rows: NDArray[np.bool_],
    velocity: Floats,
    fs_hz: float,
    sheet: float | None,
) -> Colour | None:
    """Return the colour of what is left of a channel; None where it is white or cannot be told.

    Args:
        residual: what is left, over the standard deviation of its noise were that white, (n,).
        rows: which of them count, (n,).
        velocity: of the motion, of any unit, (n,).
        fs_hz: rows per second.
        sheet: what the data sheet states, in the residual's unit; None: nothing bounds the noise,
            and a misfit that is no noise could not be told from it.
    """
    seen = _spectrum(residual, rows, fs_hz) if sheet else None
    if seen is None or sheet is None:
        return None
    f_hz, power = seen
    moved = np.cumsum(np.abs(np.fft.rfft(_faded(rows, fs_hz) * velocity)) ** 2)
    if not moved[-1] > 0.0:
        return None
    beside_it = 0.5 * POLICY.noise_beside_motion
    ends = np.interp([beside_it, 1.0 - beside_it], moved / moved[-1], f_hz)
    low_hz, high_hz = map(float, ends)
    beside = np.flatnonzero(((f_hz < low_hz) | (f_hz > high_hz)) & (np.arange(f_hz.size) > 1))
    beside = beside[beside < f_hz.size - 1]
    # With little room above the motion nothing tells its noise from what it makes.
    if beside.size < 8 * LINES or high_hz > POLICY.noise_room * fs_hz:
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


def red_of(
    residual: Floats, rows: NDArray[np.bool_], fs_hz: float, sheet: float | None
) -> Colour | None:
    """Return a floor and what rises from it towards slow motion, read within the motion's band too.

    Slow noise swells over all of the band, where the force of a law has the lines of the motion: if
    a set leaves such noise, it is for the likelihoods of all sets to say.

    Args:
        residual, rows, fs_hz, sheet: as of `colour_of`.
    """
    seen = _spectrum(residual, rows, fs_hz) if sheet else None
    if seen is None or sheet is None:
        return None
    f_hz, power = seen[0][1:-1], seen[1][1:-1]
    if f_hz.size < 8 * LINES:
        return None
    red = _fitted_red(f_hz, power)
    found = Colour(f_hz[-1:], _red(f_hz[-1:], red), red, np.inf, 0.5 * float(f_hz[0]))
    return _held(found, seen[0], sheet) if red[1] > 0.0 and _better(found, f_hz, power) else None


def _spectrum(
    residual: Floats, rows: NDArray[np.bool_], fs_hz: float
) -> tuple[Floats, Floats] | None:
    """Return the lines of the rows that count, Hz, and their power; None of too few rows."""
    if rows.mean() < 0.5 or rows.size < 256:
        return None
    taper = _faded(rows, fs_hz)
    scale = float(np.sum(taper**2))
    if scale < 128:
        return None
    f_hz = np.asarray(np.fft.rfftfreq(rows.size, 1.0 / fs_hz), dtype=np.float64)
    mean = float(np.sum(taper * residual) / np.sum(taper))
    power = np.abs(np.fft.rfft(taper * (residual - mean))) ** 2 / scale
    return (f_hz, power) if np.isfinite(power).all() else None


def _held(found: Colour, f_hz: Floats, sheet: float) -> Colour:
    """Return a colour as large as the data sheet allows, over the lines that were seen.

    Slower noise stands in the mean of the recording, which is a nuisance.
    """
    seen, red = f_hz >= 2.0 * found.least_hz, found.red
    total = float(np.sum(found.at(f_hz[seen]))) / f_hz.size
    factor = POLICY.sheet_factor
    held = float(np.clip(total, (sheet / factor) ** 2, (sheet * factor) ** 2)) / total
    return replace(found, power=held * found.power, red=(held * red[0], held * red[1], red[2]))


def _faded(rows: NDArray[np.bool_], fs_hz: float) -> Floats:
    """Return a weight for each row that falls to nothing towards those that do not count."""
    reach = max(int(FADE_S * fs_hz), 2)
    inner = np.convolve(~rows, np.ones(2 * reach + 1), mode="same") < 0.5
    inner[:reach] = inner[-reach:] = False
    window = np.hanning(2 * reach + 1)
    return np.convolve(inner, window / window.sum(), mode="same")


def _levels(f_hz: Floats, power: Floats) -> tuple[Floats, Floats]:
    """Return the levels of a spectrum, of `OCTAVE` each where there are lines enough."""
    cuts = [0]
    for i in range(1, f_hz.size):
        if f_hz[i] > f_hz[cuts[-1]] * 2.0**OCTAVE and i - cuts[-1] >= LINES:
            cuts.append(i)
    if f_hz.size - cuts[-1] < LINES and len(cuts) > 1:
        cuts.pop()
    parts = [slice(a, b) for a, b in zip(cuts, [*cuts[1:], f_hz.size], strict=True)]
    middles = np.array([float(np.exp(np.mean(np.log(f_hz[p])))) for p in parts])
    # By the logarithm: a line, such as hum, does not count as noise.
    logs = np.array([float(np.mean(np.log(power[p] + 1e-300))) + EULER for p in parts])
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
    best, found = np.inf, (float(np.mean(power)), 0.0, 0.0)
    for slope in np.linspace(0.0, POLICY.noise_steepest, 9):
        design = np.column_stack((np.ones(f_hz.size), f_hz**-slope))
        level = np.full(f_hz.size, float(np.mean(power)))
        beta = np.zeros(2)
        for turn in range(SCORINGS):
            part = design[:, :1] if slope == 0.0 else design
            # What stands far out of such a spectrum is a line, and no noise.
            noise = power if turn < SCORINGS // 2 else np.minimum(power, POLICY.noise_line * level)
            beta = _not_negative(part / level[:, None], noise / level)
            level = np.maximum(design @ beta, 1e-6 * float(np.mean(power)))
        likelihood = float(np.sum(np.log(level) + np.minimum(power / level, POLICY.noise_line)))
        if likelihood < best - 1e-9:
            best, found = likelihood, (float(beta[0]), float(beta[1]), float(slope))
    return found


def _not_negative(design: Floats, y: Floats) -> Floats:
    """Return the least squares of one or two coefficients that are not negative, (2,)."""
    norms = np.sum(design**2, axis=0)
    alone = np.maximum(design.T @ y / norms, 0.0)
    if design.shape[1] == 1:
        return np.array([alone[0], 0.0])
    both = np.linalg.lstsq(design, y, rcond=None)[0]
    if (both >= 0.0).all():
        return np.asarray(both)
    better = int(np.argmax(alone**2 * norms))
    return np.where(np.arange(2) == better, alone, 0.0)


def _better(found: Colour, f_hz: Floats, power: Floats) -> bool:
    """Return whether the levels tell the lines better than one for all of them (BIC)."""
    level, white = found.at(f_hz), float(np.mean(power))
    gain = np.sum(np.log(white) + power / white) - np.sum(np.log(level) + power / level)
    return bool(2.0 * gain > found.count * np.log(f_hz.size))
