"""The colour of the noise of motion sensors, determined where they do not detect motion.

A data sheet states the size of a sensor's noise, and its white floor shows at the top of the band;
slow noise may be a hundred times that. A motion, and the force that belongs to it, is in all
channels at once, noise only in one: where a channel is not coherent with any other, its signal is
noise (multiple coherence; Bendat and Piersol, Random Data, ch. 7 and 9). At lower frequencies,
where there is motion, the noise is extrapolated, but not above what is coherent with no other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import noise
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY

Spectra = NDArray[np.complex128]


def sensor_colour(
    channel: Floats,
    others: Sequence[Floats],
    fs_hz: float,
    sigma: float,
    sheet: float | None,
    known: NDArray[np.bool_] | None = None,
) -> noise.Colour | None:
    """Return the colour of a channel's noise; None if it is white or cannot be determined.

    Args:
        channel: without gaps, (n,).
        others: channels that show the same motion, or its force, in any unit, each (n,).
        fs_hz: rows per second.
        sigma: standard deviation of the noise if white, in the channel's unit.
        sheet: the same according to the data sheet; None: nothing bounds the noise.
        known: rows of the channel that were read rather than filled, (n,); None: all.
    """
    size = _segment(channel.size, fs_hz)
    if not others or size < 16 * noise.LINES or not sheet:
        return None
    own, beside = _spectra(channel / sigma, size), [_spectra(other, size) for other in others]
    if known is not None:
        # A filled gap in a motion exceeds the noise by far.
        whole = known[_starts(known.size, size)[:, None] + np.arange(size)].all(axis=1)
        if whole.sum() < POLICY.noise_rows * whole.size:
            return None
        own, beside = own[whole], [other[whole] for other in beside]
    power, shared = _apart(own, np.array(beside))
    f_hz = np.asarray(np.fft.rfftfreq(size, 1.0 / fs_hz), dtype=np.float64)
    # Next to the last lines that are motion rather than noise, from where little of it remains.
    reach = POLICY.noise_neighbours
    kernel = np.full(2 * reach + 1, 1.0 / (2 * reach + 1))
    wide = np.convolve(np.pad(shared, reach, mode="edge"), kernel, mode="valid")
    moving = np.flatnonzero(wide[:-1] > POLICY.noise_moves)
    last = int(moving[-1]) + 1 if moving.size else 1
    first = last + int(np.argmax(wide[last:] < POLICY.noise_shared))
    if f_hz[first] > POLICY.noise_room * fs_hz:
        return None
    found = noise.colour_above(first, f_hz, power, len(own))
    if found is None:
        return None
    # What comes and goes is motion of which the others show too little, or an event.
    parts = np.mean(np.abs(own[:, first:-1]) ** 2 / found.at(f_hz[first:-1]), axis=1)
    if np.max(parts) > POLICY.noise_burst**2 * np.mean(parts):
        return None
    return noise.within(found, f_hz, sheet / sigma)


def gain2(motion: Floats, force: Floats, fs_hz: float, omega: Floats) -> Floats:
    """Return the squared gain from a motion to its force at given frequencies, rad/s, (m,)."""
    size = max(_segment(motion.size, fs_hz), 16)
    of_motion, of_force = (np.mean(np.abs(_spectra(y, size)) ** 2, axis=0) for y in (motion, force))
    at = 2.0 * np.pi * np.asarray(np.fft.rfftfreq(size, 1.0 / fs_hz), dtype=np.float64)
    # What has been detrended has no first lines.
    gain = of_force[2:] / np.maximum(of_motion[2:], 1e-300)
    return np.asarray(np.interp(omega, at[2:], gain))


def _segment(rows: int, fs_hz: float) -> int:
    """Return the number of rows of a segment."""
    return int(min(rows / POLICY.noise_spectra, POLICY.noise_part_s * fs_hz))


def _starts(rows: int, size: int) -> NDArray[np.int_]:
    """Return the first row of each segment."""
    return np.arange(0, rows - size + 1, size // 2)


def _spectra(signal: Floats, size: int) -> Spectra:
    """Return the spectra of the segments of a signal, each detrended, (parts, lines)."""
    starts = _starts(signal.size, size)
    at = np.linspace(-1.0, 1.0, size)
    parts = signal[starts[:, None] + np.arange(size)]
    parts = parts - parts.mean(axis=1)[:, None] - np.outer(parts @ at / float(at @ at), at)
    # For a motion 1e8 times the noise, the leakage of Hann's own window would be visible.
    window = np.hanning(size) ** 2
    return np.asarray(np.fft.rfft(parts * window, axis=1) / np.sqrt(np.sum(window**2)))


def _apart(own: Spectra, others: Spectra) -> tuple[Floats, Floats]:
    """Return a channel's incoherent power and its coherent fraction, each (lines,).

    Args:
        own: spectra of the channel, (parts, lines).
        others: spectra of the others, (channels, parts, lines).
    """
    whole = np.mean(np.abs(own) ** 2, axis=0)
    size = np.sqrt(np.mean(np.abs(others) ** 2, axis=1, keepdims=True))
    scaled = others / np.maximum(size, 1e-300)
    between = np.einsum("ipl,jpl->lij", np.conj(scaled), scaled) / own.shape[0]
    between[:, np.arange(len(others)), np.arange(len(others))] += 1e-9
    along = np.einsum("ipl,pl->li", np.conj(scaled), own) / own.shape[0]
    taken = np.linalg.solve(between, along[:, :, None])[:, :, 0]
    rest = whole - np.real(np.sum(np.conj(along) * taken, axis=1))
    # With so few spectra, each of the others explains one by chance.
    free = POLICY.noise_independent * own.shape[0]
    rest = np.maximum(rest, 0.0) * free / max(free - len(others), 1.0)
    return rest, np.maximum(1.0 - rest / np.maximum(whole, 1e-300), 0.0)
