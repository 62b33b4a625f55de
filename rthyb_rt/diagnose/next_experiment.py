"""The next experiment: candidates are simulated, and the one that separates best is proposed."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion, actuator
from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.actuation import CATALOGUE, MASK_S
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.gaps import filled
from rthyb_rt.diagnose.problem import columns_of

if TYPE_CHECKING:
    from rthyb_rt.diagnose import force
    from rthyb_rt.diagnose.result import Displacement

KINDS = ("sweep", "random", "multi_frequency", "multi_amplitude")


def excitations(case: Case, amplitude: float, f0_hz: float) -> dict[str, ComputedMotion]:
    """Return displacement histories of one minute for each kind of experiment."""
    fs = case.fs_hz
    t = np.arange(int(min(16.0, 16384 / fs) * fs)) / fs
    top = min(4.0 * f0_hz, 0.1 * fs)
    low = 0.25 * f0_hz
    span = t[-1]
    phase = 2 * np.pi * (low * t + (top - low) * t**2 / (2 * span))
    rng = np.random.default_rng(1)
    tones = np.linspace(low, top, 40)
    random = np.sum(
        [
            np.sin(2 * np.pi * f * t + p)
            for f, p in zip(tones, rng.uniform(0, 2 * np.pi, 40), strict=True)
        ],
        axis=0,
    )
    several = np.sum([np.sin(2 * np.pi * f * t) for f in (low, f0_hz, 0.5 * top, top)], axis=0)
    # Four amplitudes, each reached smoothly over a cycle: a jump would contain every frequency.
    steps = 0.25 + 0.125 * sum(1.0 + np.tanh((t - span * q / 4) * 2.0 * f0_hz) for q in (1, 2, 3))
    shapes = {
        "sweep": np.sin(phase),
        "random": random / np.max(np.abs(random)),
        "multi_frequency": several / np.max(np.abs(several)),
        "multi_amplitude": np.asarray(steps) * np.sin(2 * np.pi * f0_hz * t),
    }
    out = {}
    for kind, shape in shapes.items():
        x = amplitude * shape
        v = np.gradient(x) * fs
        out[kind] = ComputedMotion(x, v, np.gradient(v) * fs)
    return out


def main_frequency(x: Floats, fs_hz: float) -> float:
    """Return the central frequency of a motion's power, Hz."""
    power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(x.size))) ** 2
    f = np.fft.rfftfreq(x.size, 1.0 / fs_hz)
    return float(np.clip(np.sum(f * power) / max(np.sum(power), 1e-300), 0.05, 0.1 * fs_hz))


OF_UNKNOWN = {
    "kind": "multi_amplitude",
    "why": "an unknown force then shows whether it depends on amplitude, rate or time",
}
"""What to do about a force that no known effect explains."""


def propose(
    case: Case,
    ctx: Context | None,
    disp: Displacement | None,
    search: force.Search | None,
    verdict: str,
    sets: list[list[str]],
) -> dict[str, str] | None:
    """Return the kind of experiment that best separates the rival explanations, and why."""
    if verdict == "none":
        return None
    if ctx is None or search is None or not (search.equal and verdict == "ambiguous"):
        if verdict == "ambiguous" and disp is not None and disp.equal:
            return _for_actuator(case, disp)
        if verdict == "unknown":
            return dict(OF_UNKNOWN)
        known = {name: e.shown_by for name, e in effects.catalogue().items()}
        known |= {e.name: e.shown_by for e in CATALOGUE}
        names = disp.best.names if disp is not None and disp.found else ()
        names += search.best.names if search and search.best.members else ()
        for name in names:
            if name in known:
                kind, why = known[name]
                return {"kind": kind, "why": f"to confirm {name}: {why}"}
        return {"kind": "sweep", "why": "to confirm over the whole frequency range"}
    separation = {
        kind: _separation(case, ctx, search, motion)
        for kind, motion in excitations(
            case, ctx.x_range, main_frequency(ctx.x, case.fs_hz)
        ).items()
    }
    return _best(separation, sets)


def _for_actuator(case: Case, disp: Displacement) -> dict[str, str]:
    """Return the kind of experiment in which the motions of rival actuators differ most."""
    u = filled(case.channels["x_cmd"])
    commands = excitations(case, float(np.max(np.abs(u))) or 1e-6, main_frequency(u, case.fs_hz))
    fits = [disp.best, *disp.equal]
    separation = {}
    for kind, command in commands.items():
        moved = [actuator(f.model, command.x, case.fs_hz).x for f in fits]
        # After the start: a command that begins with a step contains what no test does.
        rest = slice(int(MASK_S * case.fs_hz), None)
        gaps = [float(np.std((a - b)[rest])) for a, b in combinations(moved, 2)]
        separation[kind] = min(gaps) / disp.task.sigma
    sets = [list(f.names) for f in fits]
    return _best(separation, sets)


def _best(separation: dict[str, float], sets: list[list[str]]) -> dict[str, str]:
    best = max(separation, key=lambda kind: separation[kind])
    named = " and ".join("+".join(s) for s in sets[:3])
    others = ", ".join(f"{k.replace('_', ' ')} {v:.1f}" for k, v in separation.items() if k != best)
    return {
        "kind": best,
        "why": f"{named} then differ by {separation[best]:.1f} times the noise (each was "
        f"simulated; other experiments: {others})",
    }


def _separation(case: Case, ctx: Context, search: force.Search, motion: ComputedMotion) -> float:
    """Return the least misfit of one set to the force of another, in units of the noise.

    The coefficients of the set, stiffness and damping are fitted, as in a new diagnosis.
    """
    n = motion.x.size
    rng = np.random.default_rng(2)
    other = {"fy_meas": np.convolve(rng.standard_normal(n), np.ones(64) / 8, mode="same")}
    there = Context(
        case.model, motion, np.arange(n) / case.fs_hz, np.zeros(n), other, ctx.all_ranges
    )
    base = [there.spring, there.v]
    forces, designs = [], []
    for fit in [search.best, *search.equal]:
        columns, total = [], np.zeros(n)
        for own, beta in zip(columns_of(there, fit.members), fit.betas, strict=True):
            columns += own
            total += np.sum([b * c for b, c in zip(beta, own, strict=True)], axis=0)
        forces.append(total)
        free = [c for c in base if case.model.k_tol is None]
        designs.append(np.column_stack([*columns, *free]))
    sigma = search.problem.estimate.sigma_n or 1.0
    gaps = []
    for i, wanted in enumerate(forces):
        for j, design in enumerate(designs):
            if i != j:
                scale = np.sqrt(np.mean(design**2, axis=0))
                scale[scale == 0] = 1.0
                beta, *_ = np.linalg.lstsq(design / scale, wanted, rcond=None)
                gaps.append(float(np.std(wanted - design / scale @ beta)))
    return min(gaps) / sigma if gaps else 0.0
