"""Noise of a channel: its level, and the steps in which it is read."""

from __future__ import annotations

import numpy as np

from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.policy import POLICY


def white_noise(signal: Floats) -> float:
    """Return the standard deviation of a signal's white noise from its fourth differences."""
    fourth = np.diff(signal, 4)
    fourth = fourth[np.isfinite(fourth)]
    if fourth.size < 16:
        # If a channel is sampled less often than the others, its own rows are used.
        good = signal[np.isfinite(signal)]
        if good.size < 16:
            return float("nan")
        fourth = np.diff(good, 4)
    return float(1.4826 * np.median(np.abs(fourth - np.median(fourth))) / np.sqrt(70.0))


def noise_of(signal: Floats | None, sheet: float | None) -> float:
    """Return the noise of a channel: as measured, limited by the data sheet."""
    found = white_noise(signal) if signal is not None else float("nan")
    if sheet is None or not sheet > 0.0:
        scale = float(np.nanstd(signal)) if signal is not None else 1.0
        return found if found > 0.0 else 1e-6 * (scale or 1.0)
    if not np.isfinite(found):
        return sheet
    return float(np.clip(found, sheet / POLICY.noise_held, sheet * POLICY.noise_held))


def step_of(f_meas: Floats | None, f_std: float | None) -> float:
    """Return the step of a coarse load cell, N: few distinct readings, all on one grid; else 0."""
    if f_meas is None or f_std is None:
        return 0.0
    good = np.isfinite(f_meas)
    values = np.unique(f_meas[good])
    if values.size < 3 or values.size > POLICY.coarse_readings * good.sum():
        return 0.0
    steps = np.diff(values)
    lsb = float(np.median(steps[steps < 1.5 * steps.min()]))
    at = values / lsb
    mean = np.mean(np.exp(2j * np.pi * at))
    away = np.abs(np.exp(2j * np.pi * at) - mean / (abs(mean) or 1.0))
    return (
        lsb if lsb >= f_std and np.mean(away < POLICY.coarse_near) >= POLICY.coarse_on_grid else 0.0
    )


def force_noise(f_meas: Floats | None, f_std: float | None) -> float:
    """Return the standard deviation of a load cell's noise including its quantisation, N."""
    step = step_of(f_meas, f_std)
    if step > 0.0 and f_std is not None:
        return float(np.hypot(f_std, step / np.sqrt(12.0)))
    return noise_of(f_meas, f_std)


def force_sheet(f_meas: Floats | None, f_std: float | None) -> float | None:
    """Return the noise in a data sheet including the load cell's quantisation, N."""
    if not f_std:
        return None
    return float(np.hypot(f_std, step_of(f_meas, f_std) / np.sqrt(12.0)))
