"""The answer of a case: what is missing, where and when it acts, what the baseline gets wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prove import bench, effects, nearest, rivals
from prove.effects import Missing
from prove.prepare import Prepared, Redraw, Wanted, hold_out, rms

Rng = np.random.Generator


@dataclass
class Case:
    """A finished case: what is written, and the truth beside it."""

    wanted: Wanted
    lab: bench.Lab
    run: bench.Run
    held: bench.Run
    held_kind: str
    missing: list[Missing]
    answer: dict[str, Any]
    rng: Rng
    drop: tuple[str, ...] = ()
    nan_rows: tuple[tuple[int, int], ...] = ()
    follow_ups: dict[str, bench.Run] = field(default_factory=dict)  # next experiments, performed


def windows(t: np.ndarray, y: np.ndarray) -> list[list[float]]:
    """Times, s, where the running rms over 0.1 s exceeds a fifth of the peak; short gaps closed."""
    dt = t[1] - t[0]
    width = max(1, round(0.1 / dt)) if dt < 0.01 else 3
    # Prefix sums, ends shortened, as the running mean of squares.
    total = np.concatenate(([0.0], np.cumsum(y**2)))
    i = np.arange(y.size)
    a, b = np.maximum(i - width // 2, 0), np.minimum(i + width // 2 + 1, y.size)
    level = np.sqrt(np.maximum(total[b] - total[a], 0) / (b - a))
    active = level > 0.2 * np.max(np.abs(y))
    edges = np.flatnonzero(np.diff(np.concatenate(([0], active.astype(int), [0]))))
    spans = [[float(t[p]), float(t[q - 1])] for p, q in edges.reshape(-1, 2)]
    gap = 0.3 if dt < 0.01 else 0.01 * (t[-1] - t[0])
    merged: list[list[float]] = []
    for span in spans:
        if merged and span[0] - merged[-1][1] < gap:
            merged[-1][1] = span[1]
        else:
            merged.append(span)
    return [[round(p, 3), round(q, 3)] for p, q in merged]


def describe(
    lab: bench.Lab, run: bench.Run, m: Missing, y: np.ndarray, spread: dict[str, float]
) -> dict[str, Any]:
    """One entry of `effects`; `scored` are the parameters that the recording fixes."""
    level = rms(y)
    noise = lab.noise.x if m.channel == "disp" else lab.noise.f
    out: dict[str, Any] = {"name": m.name, "params": dict(m.params), "channel": m.channel}
    if m.name not in effects.UNKNOWN:
        out["params"], held = nearest.parameters(lab, run, m, y)
        out["scored"] = [q for q in held if spread.get(q, 0.0) < 0.03]
    whole = rms(run.x) if m.channel == "disp" else rms(run.f)
    out |= {"effect_rms": level, "share": level / whole, "snr": level / noise if noise > 0 else 0.0}
    out["windows"] = windows(run.t, y) if level > 0 else []
    if level > 0:
        strong = np.abs(y) > 0.5 * np.max(np.abs(y))
        out["where"] = {
            "x": [float(np.min(run.x[strong])), float(np.max(run.x[strong]))],
            "v": [float(np.min(run.v[strong])), float(np.max(run.v[strong]))],
        }
    if m.onset_s > 0:
        out["onset_s"] = m.onset_s
    return out


def nrmse(predicted: np.ndarray, true: np.ndarray) -> float:
    spread = float(np.std(true))
    return rms(predicted - true) / spread if spread > 0 else 0.0


def finish(
    w: Wanted, ready: Prepared, rng: Rng, verdict: str, ambiguous: list[Any] | None = None,
    next_experiment: list[str] | None = None,
) -> Case:  # fmt: skip
    """Held-out test, answer, and what of the recording goes missing."""
    held, held_kind = hold_out(w, ready, rng)
    lab, run = ready.lab, ready.run
    x_base, f_base = bench.believed_outputs(lab, held)
    base_error = {"force": nrmse(f_base, held.f), "disp": nrmse(x_base, held.x)}
    if w.family in ("drive", "loop") and max(base_error.values()) > 1.5:
        raise Redraw("held-out test has nothing in common with the model")
    spreads: list[dict[str, float]] = [{} for _ in ready.missing]
    if all(m.name in effects.CATALOGUE and m.onset_s < 0 for m in ready.missing):
        spreads = rivals.spread_of_parameters(run, lab, ready.missing)
    answer: dict[str, Any] = {
        "heldout_nrmse_base": base_error,
        "kind": w.kind,
        "tier": w.tier if w.kind == "single" else w.kind,
        "family": w.family,
        "noise": w.noise,
        "excitation": w.excitation,
        "heldout": held_kind,
        "inelastic": lab.truth.bouc_wen is not None,
        "effects": [
            describe(lab, run, m, y, s)
            for m, y, s in zip(ready.missing, ready.parts, spreads, strict=True)
        ],
        "ambiguous": ambiguous or [],
        "f_std": lab.noise.f,
        "x_std": lab.noise.x,
        "next_experiment": next_experiment or [],
        "verdict": verdict,
        "groups": list(w.groups),
    }
    if len(ready.parts) == 2 and all(rms(p) > 0 for p in ready.parts):
        whole = math.hypot(*(rms(p) for p in ready.parts))
        answer["cancel_ratio"] = rms(ready.parts[0] + ready.parts[1]) / whole
    drop, nan_rows = losses(w, run, ready.missing, rng)
    if nan_rows:
        answer["groups"].append("nan")
    return Case(w, lab, run, held, held_kind, ready.missing, answer, rng, drop, nan_rows)


def losses(
    w: Wanted, run: bench.Run, missing: list[Missing], rng: Rng
) -> tuple[tuple[str, ...], tuple[tuple[int, int], ...]]:
    """Channels that the recording lacks, and spans of rows without values."""
    drop: list[str] = []
    if "no_cell" in w.groups:
        drop.append("f_meas")
    elif rng.random() < 0.15:
        drop.append("a_meas")
    if rng.random() < 0.15 and not any(m.name == "crosstalk" for m in missing):
        drop.append("fy_meas")
    spans = []
    if rng.random() < 0.12:
        for _ in range(int(rng.integers(1, 4))):
            a = int(rng.integers(run.t.size // 20, run.t.size * 9 // 10))
            spans.append((a, a + int(rng.integers(1, 20))))
    return tuple(drop), tuple(spans)
