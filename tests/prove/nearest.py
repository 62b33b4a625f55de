"""Parameters in the format's own terms, where the true law is another one.

An Iwan chain has no xy, a Maxwell-slip chain no sigma0, a stop that loses energy no one stiffness.
The answer states the parameters of the format's model that come nearest, in least squares, to the
true missing force along the true motion: what a perfect fit would return.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit
from scipy.optimize import minimize_scalar

from prove import bench, laws
from prove.effects import Missing


@njit(cache=True)
def _dahl(x: np.ndarray, length: float) -> np.ndarray:
    """Bristle of unit strength and breakaway `length`, each step in closed form."""
    f = np.zeros(x.size)
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        goal = 1.0 if dx >= 0 else -1.0
        f[i] = goal + (f[i - 1] - goal) * math.exp(-abs(dx) / length)
    return f


@njit(cache=True)
def _bouc_wen(x: np.ndarray, xy: float) -> np.ndarray:
    z = np.zeros(x.size)
    for i in range(1, x.size):
        z[i] = laws.bouc_wen_step(z[i - 1], x[i] - x[i - 1], xy)
    return z


def _best(
    y: np.ndarray, column: Callable[[float], np.ndarray], low: float, high: float
) -> tuple[float, float]:
    """Amplitude and nonlinear parameter (searched in its logarithm) nearest to y."""

    def miss(log: float) -> float:
        c = column(math.exp(log))
        return float(y @ y - (c @ y) ** 2 / max(float(c @ c), 1e-300))

    grid = np.linspace(math.log(low), math.log(high), 25)
    at = int(np.argmin([miss(g) for g in grid]))
    bounds = (grid[max(at - 1, 0)], grid[min(at + 1, grid.size - 1)])
    p = math.exp(minimize_scalar(miss, bounds=bounds, method="bounded").x)
    c = column(p)
    return float(c @ y / (c @ c)), p


def _against_model(lab: bench.Lab, m: Missing) -> dict[str, float]:
    """The error of the stated model, its tolerance and the channel offset included."""
    p, truth, believed = m.params, lab.truth, lab.believed
    match m.name:
        case "stiffness":
            return {"dk_ratio": truth.k * (1 + p["dk_ratio"]) / believed.k - 1}
        case "viscous":
            return {"c_Ns_m": truth.c + p["c_Ns_m"] - believed.c}
        case "inertia":
            return {"m_kg": truth.mass + p["m_kg"] - believed.mass}
        case "time_skew":
            late = p["skew_s"] - (0.0 if lab.family == "loop" else lab.f_offset_s)
            return {"skew_s": late}
        case _:
            return {"dtau_s": p["dtau_s"] + lab.delay_offset_s}


def parameters(
    lab: bench.Lab, run: bench.Run, m: Missing, y: np.ndarray
) -> tuple[dict[str, float], list[str]]:
    """Parameters of the answer, and the names of those that are held to 10 %.

    Not held: shape parameters for which laboratories have no common definition, and those of which
    the recording says too little.
    """
    p = dict(m.params)
    x, peak = run.x, float(np.max(np.abs(run.x)))
    if m.onset_s > 0 or not np.any(y):
        return p, []
    if m.name in ("stiffness", "viscous", "inertia", "time_skew", "delay"):
        return _against_model(lab, m), list(p)
    if m.name == "hysteresis":
        k = lab.truth.k
        gain, xy = _best(y, lambda s: k * (_bouc_wen(x, s) - x), 0.05 * peak, 3 * peak)
        return {"xy_m": xy, "alpha": 1 - gain}, []
    if m.name == "lugre":
        level, length = _best(y, lambda s: _dahl(x, s), 1e-3 * peak, 2 * peak)
        return {"Fc_N": level, "sigma0_N_m": level / length}, ["Fc_N"]
    if m.name == "stopper":
        side = m.shape["side"]

        def contact(at: float) -> np.ndarray:
            up = np.maximum(x - at, 0.0) if side >= 0 else np.zeros_like(x)
            return up + (np.minimum(x + at, 0.0) if side <= 0 else 0.0)

        stiff, at = _best(y, contact, 0.7 * p["xs_m"], min(1.3 * p["xs_m"], 0.99 * peak))
        return {"ks_N_m": stiff, "xs_m": at}, ["ks_N_m", "xs_m"]
    held = {
        "pinching": [], "second_mode": ["f2_Hz"], "degradation": ["loss"], "maxwell": ["km_N_m"],
        "stribeck": ["Fc_N", "Fs_N"], "hum": ["f_Hz", "amp_N"],
    }  # fmt: skip
    return p, list(held.get(m.name, p))
