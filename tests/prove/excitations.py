"""Test signals: displacement commands of an actuator, ground accelerations, forces."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt

Rng = np.random.Generator
NEXT_KINDS = ("sweep", "random", "multi_frequency", "multi_amplitude")


def taper(t: np.ndarray, rise: float, fall: float) -> np.ndarray:
    """Raised-cosine start and end."""
    up = np.clip(t / rise, 0, 1)
    down = np.clip((t[-1] - t) / fall, 0, 1)
    return (0.5 - 0.5 * np.cos(np.pi * up)) * (0.5 - 0.5 * np.cos(np.pi * down))


def quake_envelope(t: np.ndarray, rng: Rng) -> np.ndarray:
    """Rise, strong phase, decay, as an earthquake record has them."""
    t1, t2 = rng.uniform(1.5, 3.0), rng.uniform(7.0, 10.0)
    e = np.where(t < t1, (t / t1) ** 2, 1.0)
    return np.where(t > t2, np.exp(-rng.uniform(0.4, 0.8) * (t - t2)), e)


def band_noise(t: np.ndarray, rng: Rng, low: float, high: float) -> np.ndarray:
    fs = 1 / (t[1] - t[0])
    sos = butter(3, [low, high], "bandpass", fs=fs, output="sos")
    y = sosfiltfilt(sos, rng.standard_normal(t.size))
    return y / np.std(y)


def earthquake(t: np.ndarray, rng: Rng) -> np.ndarray:
    """Kanai-Tajimi noise under the envelope of a record."""
    dt = t[1] - t[0]
    wg, zg = 2 * np.pi * rng.uniform(1.5, 3.0), rng.uniform(0.4, 0.7)
    y = rng.standard_normal(t.size)
    q = np.exp(-zg * wg * dt)
    wd = wg * np.sqrt(1 - zg * zg) * dt
    y = lfilter([1.0, -0.9], [1, -2 * q * np.cos(wd), q * q], y)
    fs = 1 / dt
    y = sosfiltfilt(butter(2, [0.2, 12.0], "bandpass", fs=fs, output="sos"), y)
    return y / np.std(y) * quake_envelope(t, rng)


def command(kind: str, t: np.ndarray, rng: Rng) -> np.ndarray:
    """Displacement of peak 1 against t, s. Kinds: sweep, random, earthquake, cyclic, sine, small,
    multi_amplitude, multi_frequency."""
    total = t[-1]
    if kind == "sweep":
        f0, f1 = rng.uniform(0.15, 0.3), rng.uniform(3.5, 5.0)
        rate = np.log(f1 / f0)
        phase = 2 * np.pi * f0 * total / rate * (np.exp(rate * t / total) - 1)
        y = np.sin(phase) * (1 - rng.uniform(0.4, 0.6) * t / total) * taper(t, 0.3, 1.0)
    elif kind == "random":
        y = band_noise(t, rng, rng.uniform(0.2, 0.35), rng.uniform(2.5, 3.5))
        y *= quake_envelope(t, rng)
    elif kind == "earthquake":
        dt = t[1] - t[0]
        w, z = 2 * np.pi * rng.uniform(0.9, 2.0), 0.05
        q = np.exp(-z * w * dt)
        y = lfilter([dt * dt], [1, -2 * q * np.cos(w * dt), q * q], earthquake(t, rng))
        y *= taper(t, 0.5, 0.5)
    elif kind == "cyclic":
        f = rng.uniform(0.6, 1.2)
        cycles = np.floor(t * f)
        levels = np.interp(cycles, [0, total * f * 0.75], [rng.uniform(0.2, 0.35), 1.0])
        y = levels * np.sin(2 * np.pi * f * t) * taper(t, 0.3, 0.5)
        y = sosfiltfilt(butter(2, 8.0, fs=1 / (t[1] - t[0]), output="sos"), y)
    elif kind == "sine":
        y = np.sin(2 * np.pi * rng.uniform(0.8, 1.8) * t + rng.uniform(0, 6))
    elif kind == "small":
        f = rng.uniform(0.8, 1.4)
        y = np.sin(2 * np.pi * f * t) * (0.6 + 0.4 * np.cos(2 * np.pi * rng.uniform(0.1, 0.16) * t))
        y *= taper(t, 0.3, 0.6)
    elif kind == "multi_amplitude":
        f = rng.uniform(0.8, 1.6)
        level = np.select([t < total / 3, t < 2 * total / 3], [0.2, 0.5], 1.0)
        level = sosfiltfilt(butter(2, 0.8, fs=1 / (t[1] - t[0]), output="sos"), level)
        y = level * np.sin(2 * np.pi * f * t) * taper(t, 0.5, 0.5)
    elif kind == "multi_frequency":
        edges = np.linspace(0, total, 4)
        y = np.zeros_like(t)
        for f, (a, b) in zip((0.5, 1.4, 3.6), itertools.pairwise(edges), strict=True):
            inside = (t >= a) & (t <= b)
            y[inside] = np.sin(2 * np.pi * f * (t[inside] - a)) * taper(t[inside] - a, 0.4, 0.4)
    else:
        raise ValueError(f"no command is called {kind!r}")
    return y / np.max(np.abs(y))


def load(kind: str, t: np.ndarray, rng: Rng) -> np.ndarray:
    """Ground acceleration or force of peak 1. The free motion filters it by itself."""
    total = t[-1]
    if kind == "sweep":
        f0, f1 = rng.uniform(0.2, 0.4), rng.uniform(3.5, 5.0)
        rate = np.log(f1 / f0)
        y = np.sin(2 * np.pi * f0 * total / rate * (np.exp(rate * t / total) - 1))
        y *= taper(t, 0.5, 1.5)
    elif kind in ("random", "cyclic"):
        y = band_noise(t, rng, 0.3, rng.uniform(4.0, 8.0)) * quake_envelope(t, rng)
    elif kind == "earthquake":
        y = earthquake(t, rng)
    elif kind == "small":
        y = band_noise(t, rng, 0.3, 5.0) * taper(t, 1.0, 2.0)
    elif kind == "sine":
        y = np.sin(2 * np.pi * rng.uniform(0.8, 1.8) * t)
    elif kind in ("multi_amplitude", "multi_frequency"):
        y = command(kind, t, rng)
    else:
        raise ValueError(f"no load is called {kind!r}")
    return y / np.max(np.abs(y))


def triangle(t: np.ndarray, rng: Rng, cycles: int, growing: bool) -> np.ndarray:
    """Quasi-static saw of one speed, corners on rows: rising peaks, or equal ones; rest before it.

    It ends on the way: a specimen that stood still at the end would tell friction from damping.
    """
    peaks = [0.0]
    for i in range(cycles):
        level = (i + 1) / cycles if growing else 1.0
        peaks += [level, -level]
    way = float(np.sum(np.abs(np.diff(peaks)))) * cycles
    rest = 40
    rows = (t.size - rest) // round(way)  # of a stroke of peak / cycles
    peaks += [1.0, -1.0] * 4
    legs = [np.zeros(rest)]
    for a, b in itertools.pairwise(peaks):
        n = rows * round(abs(b - a) * cycles)
        legs.append(a + (b - a) * np.arange(n) / n)
    return np.concatenate(legs)[: t.size]
