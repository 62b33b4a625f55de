"""The comparison: sequentially thresholded least squares (SINDy) on the residual of the base model.

PySINDy's STLSQ where it is installed, else the same iteration here. The library of candidate terms
is what a user would write down for a structure: powers of displacement and speed, sign of speed,
acceleration, constant, time.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from prove import laws, rigs, scoring

try:
    from pysindy import STLSQ
except ImportError:
    STLSQ = None

SOLVER = "PySINDy STLSQ" if STLSQ else "STLSQ"


def solve(terms: np.ndarray, y: np.ndarray, threshold: float) -> np.ndarray:
    """Coefficients (k,) of terms (n, k) for y (n,), those under the threshold removed in turn."""
    if STLSQ:
        fit = STLSQ(threshold=threshold, alpha=1e-6, max_iter=20)
        try:
            fit.fit(terms, y[:, None])
        except ValueError:
            return np.zeros(terms.shape[1])
        return np.asarray(fit.coef_)[0]
    kept = np.ones(terms.shape[1], bool)
    xi = np.zeros(terms.shape[1])
    for _ in range(20):
        xi[:] = 0
        if not kept.any():
            break
        t = terms[:, kept]
        xi[kept] = np.linalg.solve(t.T @ t + 1e-6 * np.eye(t.shape[1]), t.T @ y)
        now = np.abs(xi) >= threshold
        if np.array_equal(now, kept):
            break
        kept = now
    return xi


def _smooth(x: np.ndarray, fs: float) -> np.ndarray:
    return sosfiltfilt(butter(4, min(25.0, 0.2 * fs), fs=fs, output="sos"), x)


def _filled(y: np.ndarray) -> np.ndarray:
    bad = ~np.isfinite(y)
    if bad.any():
        y = y.copy()
        y[bad] = np.interp(np.flatnonzero(bad), np.flatnonzero(~bad), y[~bad])
    return y


def force_terms(
    t: np.ndarray, x: np.ndarray, v: np.ndarray, a: np.ndarray
) -> dict[str, np.ndarray]:
    narrow = 0.02 * float(np.std(v)) + 1e-12
    return {
        "stiffness": x, "viscous": v, "inertia": a, "coulomb": np.tanh(v / narrow),
        "quad_damping": v * np.abs(v), "quadratic": x * x, "cubic": x**3,
        "bias": np.ones_like(x), "drift": t,
    }  # fmt: skip


def _motion(columns: dict[str, np.ndarray], fs: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x = _smooth(_filled(columns["x_meas"]), fs)
    v = np.gradient(x, 1 / fs)
    return x, v, np.gradient(v, 1 / fs)


def _base_force(model: dict[str, Any], fs: float, x: Any, v: Any, a: Any) -> np.ndarray:
    s = model["specimen"]
    bw = s.get("bouc_wen")
    specimen = laws.Specimen(
        s["k"], s["c"], s["moving_mass"], {"alpha": bw["alpha"], "xy": bw["xy"]} if bw else None
    )
    return laws.along(specimen, 0.0, 1 / fs, x, v, a)


def diagnose(folder: Path) -> tuple[scoring.Answer, scoring.Prediction]:
    """The baseline's answer for a case, in the words of the format."""
    model = tomllib.loads((folder / "baseline.toml").read_text())
    fs = model["fs_hz"]
    c = scoring.read_csv(folder / "recording.csv")
    x, v, a = _motion(c, fs)
    noise = model["noise"]
    if "f_meas" in c:
        f = _filled(c["f_meas"])
    elif "f_in" in c:
        f = _filled(c["f_in"])
    else:
        f = -model["numerical"]["m"] * (a + _filled(c["ag"]))
    found: list[tuple[float, str, float]] = []
    y = f - _base_force(model, fs, x, v, a)
    terms = force_terms(c["t"], x, v, a)
    fitted = _fit(terms, y, max(0.02 * float(np.std(f)), 0.1 * noise["f_std"]))
    found += [(abs(q) * rms, n, q) for n, (q, rms) in fitted.items()]
    moved: dict[str, tuple[float, float]] = {}
    if "x_cmd" in c and "actuator" in model:
        moved = _actuator(model, c, x, v, a, fs)
    found += [(abs(q) * rms / np.std(x) * np.std(f), n, q) for n, (q, rms) in moved.items()]
    found.sort(reverse=True)
    answer: scoring.Answer = {
        "verdict": "explained" if found else "none",
        "effects": [n for _, n, _ in found],
        "candidates": [{"name": n, "params": _named(n, q)} for _, n, q in found],
        "ambiguous_with": [],
        "localisation": {"channel": "force", "time_windows": [[0.0, float(c["t"][-1])]]},
    }
    if not (folder / "heldout_input.csv").exists():
        return answer, None
    return answer, _predict(folder, model, fs, fitted)


def _fit(
    terms: dict[str, np.ndarray], y: np.ndarray, threshold: float
) -> dict[str, tuple[float, float]]:
    """Coefficient and rms of each term that stays; the threshold is on its rms share of y."""
    sizes = {n: float(np.sqrt(np.mean(s**2))) for n, s in terms.items()}
    columns = np.array([terms[n] / sizes[n] for n in terms]).T
    xi = solve(columns[::4], y[::4], threshold)
    return {n: (q / sizes[n], sizes[n]) for n, q in zip(terms, xi, strict=True) if q != 0}


def _actuator(
    model: dict[str, Any], c: dict[str, np.ndarray], x: Any, v: Any, a: Any, fs: float
) -> dict[str, tuple[float, float]]:
    p = model["actuator"]
    believed = rigs.Actuator(p["delay_s"], p["f_hz"], p["zeta"], p["gain"])
    base = rigs.track(_filled(c["x_cmd"]), 1 / fs, believed)[0][:: rigs.FINE]
    terms = {"delay": v, "act_gain": x, "oil_column": a, "delay_rate": v * np.abs(v)}
    return _fit(terms, x - base, 0.02 * float(np.std(x)))


_PARAMETER = {
    "viscous": "c_Ns_m", "inertia": "m_kg", "coulomb": "Fc_N", "quad_damping": "c2_Ns2_m2",
    "quadratic": "k2_N_m2", "cubic": "k3_N_m3", "bias": "bias_N", "drift": "rate_N_s",
}  # fmt: skip


def _named(name: str, q: float) -> dict[str, float]:
    if name == "delay":
        return {"dtau_s": -q}
    if name == "act_gain":
        return {"gain": 1 + q}
    return {_PARAMETER[name]: q} if name in _PARAMETER else {}


def _predict(
    folder: Path, model: dict[str, Any], fs: float, fitted: dict[str, tuple[float, float]]
) -> scoring.Prediction:
    """Force along the held-out motion; a free motion is simulated with the terms as laws."""
    held = scoring.read_csv(folder / "heldout_input.csv")
    if "x_meas" in held:
        x, v, a = _motion(held, fs)
        f = _base_force(model, fs, x, v, a)
        terms = force_terms(held["t"], x, v, a)
        return {"t": held["t"], "f": f + sum(q * terms[n] for n, (q, _) in fitted.items())}
    s = model["specimen"]
    extra = tuple(
        laws.Effect(n, {_PARAMETER[n]: max(q, 0.0) if n == "coulomb" else q})
        for n, (q, _) in fitted.items()
        if n in _PARAMETER and n in laws.CODES
    )
    k = s["k"] + fitted.get("stiffness", (0.0, 0.0))[0]
    bw = s.get("bouc_wen")
    specimen = laws.Specimen(
        k, s["c"], s["moving_mass"], {"alpha": bw["alpha"], "xy": bw["xy"]} if bw else None, extra
    )
    mass = model.get("numerical", {}).get("m", 0.0) if "ag" in held else 0.0
    load = -mass * held["ag"] if "ag" in held else held["f_in"] - fitted.get("bias", (0.0, 0.0))[0]
    fine = rigs.fine_signal(load, held["t"], 1 / fs)
    x, _, _, f = rigs.free_motion(fine, 1 / fs / rigs.FINE, mass, 0.0, specimen)
    step = slice(None, None, rigs.FINE)
    return {"t": held["t"], "x": x[step], "f": f[step]}
