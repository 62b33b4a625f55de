"""Numbers for display: significant digits, units, per cent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """Return ``value`` with this many significant digits, or a dash if there is no value."""
    if value is None or np.isnan(value):
        return "–"
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    # Below 1e-10 only round-off remains, in every unit that is displayed.
    if abs(value) < 1e-10:
        return "0"
    if not 1e-4 <= abs(value) < 1e5:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        text = f"{mantissa}·10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    else:
        decimals = digits - 1 - int(np.floor(np.log10(abs(float(f"{value:.{digits - 1}e}")))))
        text = f"{value:.{max(decimals, 0)}f}"
    return text.replace("-", "−", 1) if text.startswith("-") else text


def tare(tare_m: float, tare_n: float) -> str:
    """Return the tare of both readings, ``tare 1.204 mm, -0.310 kN``."""
    return f"tare {tare_m * 1e3:.3f} mm, {tare_n * 1e-3:.3f} kN"


def tare_of_status(found: Mapping[str, Any]) -> str:
    """Return the tare in a service's status; for several axes and sensors, with their names."""
    each = found.get("axes") or {}
    if not each:
        return tare(found["displacement_m"], found["force_n"])
    words = [f"{name} {tare(own['displacement_m'], own['force_n'])}" for name, own in each.items()]
    for name, own in (found.get("sensors") or {}).items():
        of_force = "force_n" in own
        text = (
            f"{own['force_n'] * 1e-3:.3f} kN"
            if of_force
            else f"{own['displacement_m'] * 1e3:.3f} mm"
        )
        words.append(f"{name} tare {text}")
    return "; ".join(words)


def percent(fraction: float | None, digits: int = 2) -> str:
    """Return a fraction as per cent, ``2.1 %``; values above ten are given as a bound."""
    if fraction is None or np.isnan(fraction):
        return "–"
    if fraction > 10.0:
        return "> 1000 %"
    return f"{number(100.0 * fraction, 3 if abs(fraction) >= 0.1 else digits)} %"


def quantity(value: float | None, unit: str, factor: float = 1.0, digits: int = 3) -> str:
    """Return a value in a unit, ``0.12 mm``; ``factor`` converts SI to that unit."""
    if value is None or np.isnan(value):
        return "–"
    return f"{number(value * factor, digits)} {unit}"


def delay(samples: float, fs_hz: float, digits: int = 3) -> str:
    """Return a delay in samples and ms, ``17 samples (16.6 ms)``.

    Args:
        samples: the delay in sampling periods; a dash for nan, ``∞ samples`` for infinity.
        fs_hz: sample rate, Hz.
        digits: significant digits of both numbers.
    """
    if not np.isfinite(samples):
        return "–" if np.isnan(samples) else f"{number(samples)} samples"
    text = f"{samples:.{digits}g}"
    noun = "sample" if text == "1" else "samples"
    return f"{text} {noun} ({1e3 * samples / fs_hz:.{digits}g} ms)"


def count(n: int, noun: str) -> str:
    """Return a number with its noun, ``1 sample``, ``2 samples``."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
