"""Single lines, as of mains or pumps, in the spectrum of what a model leaves of a force."""

from __future__ import annotations

import numpy as np

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY

MOST = 3
"""Number of lines returned, the strongest first."""
LEAST_HZ = 2.0
"""Frequency below which a line is regarded as motion."""
AROUND = 6
"""Number of lines on either side that belong to a line found: those of its taper."""
BESIDE = 64
"""Number of lines on either side that are the surroundings of one."""
FINER = 10
"""Number of steps to either side in which a frequency is refined, twice."""
WINDOW_HZ = 2.0
"""Half-width of the part of the spectrum that shows a line: a filter of this width forgets the ends
of a recording after half a second."""


def lines_hz(rest: Floats, motion: Floats, dt: float) -> list[float]:
    """Return the frequencies of lines that stand out of their surroundings, at most three, Hz.

    Args:
        rest: what the model leaves of a force, (n,), N.
        motion: the force of the model, whose own lines do not count, (n,), N.
        dt: sampling period, s.
    """
    spectrum, moved = _tapered(rest), _tapered(motion)
    f = np.fft.rfftfreq(rest.size, dt)
    local = np.array(
        [np.median(part) for part in np.array_split(spectrum, max(spectrum.size // 128, 1))]
    )
    floor = np.interp(
        np.arange(spectrum.size), (np.arange(local.size) + 0.5) * spectrum.size / local.size, local
    )
    apart = (f > LEAST_HZ) & (moved < POLICY.hum_apart * moved.max())
    strength = np.where(apart, spectrum / np.maximum(floor, 1e-300), 0.0)
    found = []
    for _ in range(MOST):
        i = int(np.argmax(strength))
        if strength[i] < POLICY.hum_line or not 0 < i < f.size - 1:
            break
        low, mid, high = np.log(np.maximum(spectrum[i - 1 : i + 2], 1e-300))
        step = 0.5 * (low - high) / min(low - 2.0 * mid + high, -1e-12)
        found.append(float(f[i] + step * f[1]))
        strength[max(i - AROUND, 0) : i + AROUND + 1] = 0.0
    return found


def _tapered(signal: Floats) -> Floats:
    """Return the amplitudes of a signal's lines, tapered, without its mean."""
    return np.asarray(np.abs(np.fft.rfft((signal - signal.mean()) * np.hanning(signal.size))))


def line_at(force: Floats, f_hz: float, dt: float) -> float:
    """Return a force's line at a frequency, (n,), N, as a fraction of its largest one; 0: none.

    A line stands out of its surroundings, as in `lines_hz`.
    """
    spectrum = _tapered(force)
    place = round(f_hz * dt * force.size)
    near = float(spectrum[max(place - 1, 0) : place + 2].max(initial=0.0))
    around = spectrum[max(place - BESIDE, 0) : place + BESIDE + 1]
    if not around.size or near <= POLICY.hum_line * float(np.median(around)):
        return 0.0
    return near / float(spectrum.max())


def hum_hz(rest: Floats, motion: Floats, dt: float) -> float | None:
    """Return the frequency of the strongest line if it is one steady sine, Hz; None: it is not.

    A resonance, or a pump that wanders, still stands out when the best sine is taken off: that is
    no hum, and where the motion is noise, nothing can be said of it. Arguments as for `lines_hz`.
    """
    found = lines_hz(rest, motion, dt)
    if not found:
        return None
    t, rest = dt * np.arange(rest.size), rest - rest.mean()
    step = 1.0 / (dt * rest.size)

    def off(f_hz: float) -> Floats:
        waves = np.column_stack([np.sin(2.0 * np.pi * f_hz * t), np.cos(2.0 * np.pi * f_hz * t)])
        return np.asarray(rest - waves @ np.linalg.lstsq(waves, rest, rcond=None)[0])

    best = found[0]
    for width in (step, step / FINER):
        tried = best + width * np.linspace(-1.0, 1.0, 2 * FINER + 1)
        best = float(min(tried, key=lambda f_hz: float(np.sum(off(f_hz) ** 2))))
    again = lines_hz(off(best), motion, dt)
    near = AROUND * step
    return None if any(abs(line - best) < near for line in again) else best


def window(f_hz: Floats, line_hz: float) -> Floats:
    """Return the weight of each frequency for evaluating a line, 1 there, (m,).

    A law of the force cannot be evaluated where the motion is noise; a line of the load cell can.
    """
    off = np.clip(np.abs(f_hz - line_hz) / WINDOW_HZ, 0.0, 1.0)
    return np.asarray(np.cos(0.5 * np.pi * off) ** 2)
