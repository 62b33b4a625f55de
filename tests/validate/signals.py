"""Excitations, coloured noise, and the windows of time in which an effect acts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Rng = np.random.Generator
COLOURS = ("white", "pink", "hump", "lowpass", "red_white")


def band(n: int, fs: float, low: float, high: float, rng: Rng) -> np.ndarray:
    """Gaussian motion between two frequencies, of peak 1; edges fall off over a third."""
    f = np.fft.rfftfreq(n, 1 / fs)
    size = 1 / (1 + np.exp(-(f - low) / (0.1 * low + 1e-9)))
    size /= 1 + np.exp(np.minimum((f - high) / (0.1 * high), 300.0))
    spectrum = size * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size))
    spectrum[0] = 0.0
    y = np.fft.irfft(spectrum, n)
    return y / np.max(np.abs(y))


def ramp_in(t: np.ndarray, seconds: float = 0.6) -> np.ndarray:
    """From 0 to 1 without a kink."""
    s = np.clip((t - t[0]) / seconds, 0, 1)
    return s * s * (3 - 2 * s)


def excitation(kind: str, t: np.ndarray, f0: float, rng: Rng) -> np.ndarray:
    """A test signal of peak 1 about f0, from rest at t[0]."""
    fs, length = 1 / (t[1] - t[0]), t[-1] - t[0]
    s = t - t[0]
    if kind == "quake":
        rise, stay = 0.12 * length, 0.45 * length
        shape = np.where(s < rise, (s / rise) ** 2, 1.0)
        shape = np.where(s > stay, np.exp(-4.0 * (s - stay) / length), shape)
        y = shape * band(t.size, fs, 0.3 * f0, 4.0 * f0, rng)
    elif kind == "random":
        y = ramp_in(t) * band(t.size, fs, 0.25 * f0, 2.5 * f0, rng)
    elif kind == "sweep":
        low, high = 0.3 * f0, 3.5 * f0
        rate = np.log(high / low) / length
        y = np.sin(2 * np.pi * low * (np.exp(rate * s) - 1) / rate) * ramp_in(t)
        y *= 1 - 0.5 * s / length
    elif kind == "cyclic":  # cycles of growing amplitude
        steps = 0.25 + 0.75 * np.floor(5 * s / length) / 4
        y = np.convolve(steps, np.hanning(31) / np.hanning(31).sum(), "same")
        y = y * np.sin(2 * np.pi * 0.6 * f0 * s) * ramp_in(t)
    elif kind == "multisine":
        lines = f0 * np.array([0.31, 0.53, 0.87, 1.37, 2.11])
        phase = rng.uniform(0, 2 * np.pi, lines.size)
        y = np.sum(np.sin(2 * np.pi * lines[:, None] * s + phase[:, None]), 0) * ramp_in(t)
    elif kind == "sine":
        y = np.sin(2 * np.pi * f0 * s) * ramp_in(t, 2.0)
    elif kind == "steps":  # one frequency at several amplitudes
        stage = np.floor(4 * s / length).clip(0, 3)
        smooth = np.hanning(round(fs / f0) | 1)
        y = np.convolve(0.25 + 0.25 * stage, smooth / smooth.sum(), "same")
        y = y * np.sin(2 * np.pi * f0 * s) * ramp_in(t)
    elif kind == "triangle":  # one rate of travel throughout
        y = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * f0 * s))
    else:
        raise ValueError(kind)
    return y / np.max(np.abs(y))


@dataclass(frozen=True)
class Noise:
    """Noise of a channel: true standard deviation, what the sheet says of it, and its colour."""

    std: float
    sheet: float = 1.0
    colour: str = "white"
    place_hz: float = 60.0

    def spectrum(self, f: np.ndarray, fs: float) -> np.ndarray:
        """Amplitude over frequency, of mean square 1 over the band of the recording."""
        g = np.maximum(f, 0.05)
        if self.colour == "pink":
            y = np.sqrt(1 / g)
        elif self.colour == "hump":
            r = f / self.place_hz
            y = 0.5 + 1 / np.sqrt((1 - r**2) ** 2 + (0.15 * r) ** 2)
        elif self.colour == "lowpass":
            y = 1 / np.sqrt(1 + (f / (1.5 * self.place_hz)) ** 4) + 0.02
        elif self.colour == "red_white":
            y = np.sqrt(1 + (2.0 / g) ** 2)
        else:
            y = np.ones_like(f)
        return y / np.sqrt(np.mean(y**2))

    def draw(self, n: int, fs: float, rng: Rng) -> np.ndarray:
        """n rows of it: drawn longer and cut, so that its ends do not join.

        The rms of these very rows is `std`, so that a slow wander does not take them beyond what
        the sheet is good for.
        """
        more = 2 * n
        shape = self.spectrum(np.fft.rfftfreq(more, 1 / fs), fs)
        y = np.fft.irfft(shape * np.fft.rfft(rng.standard_normal(more)), more)[:n]
        return self.std / rms(y) * y


def windows(t: np.ndarray, y: np.ndarray) -> list[list[float]]:
    """Where the rms over 0.15 s exceeds a quarter of its largest, s; breaks to 0.3 s are closed."""
    dt = t[1] - t[0]
    half = max(1, round(0.075 / dt))
    total = np.concatenate(([0.0], np.cumsum(y**2)))
    i = np.arange(y.size)
    first, last = np.maximum(i - half, 0), np.minimum(i + half + 1, y.size)
    level = np.sqrt(np.maximum(total[last] - total[first], 0.0) / (last - first))
    rows = np.flatnonzero(level > 0.25 * level.max()) if level.max() > 0 else np.array([], int)
    spans: list[list[float]] = []
    for row in t[rows]:
        if spans and row - spans[-1][1] <= 0.3:
            spans[-1][1] = float(row)
        else:
            spans.append([float(row), float(row)])
    return [[round(a, 4), round(b, 4)] for a, b in spans]


def rms(y: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(y))))
