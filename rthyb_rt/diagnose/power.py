"""The power of an answer on this very recording: would a known effect be found in it?

An effect of the size found (or, where nothing was found, of several sizes) is hidden in what the
model with its effects leaves, and diagnosed again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rthyb_rt.diagnose import effects, engine
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context, Effect, Trial
from rthyb_rt.diagnose.engine import Diagnosis

PROBES = ("coulomb", "viscous", "inertia", "cubic")
SIZES = (0.16, 0.08, 0.04, 0.02, 0.01, 0.005)


def self_check(d: Diagnosis) -> list[dict[str, Any]]:
    """Return, for each probe, whether it is found at the size found and how small it may be.

    Needs a measured force; without one the list is empty.
    """
    search, ctx = d.force, d.context
    if search is None or ctx is None or "f_meas" not in d.case.channels:
        return []
    clean = _without_findings(d)
    force_rms = float(np.std(ctx.force)) or 1.0
    out: list[dict[str, Any]] = []
    for m in search.best.members if d.verdict in ("explained", "ambiguous") else ():
        i = search.best.members.index(m)
        from rthyb_rt.diagnose.force import contribution

        signal = contribution(search.problem, search.best, i)
        out.append(_probe(clean, m.name, signal, force_rms))
    for name in PROBES:
        effect = effects.catalogue().get(name)
        if effect is None:
            continue
        unit = _unit(effect, ctx)
        if unit is None:
            continue
        smallest = None
        for size in SIZES:
            row = _probe(clean, name, unit * (size * force_rms / (np.std(unit) or 1.0)), force_rms)
            if not row["found"]:
                break
            smallest = size
        out.append({"effect": name, "smallest_detectable_share": smallest})
    return out


def _without_findings(d: Diagnosis) -> Case:
    """Return the recording less what was found in its force."""
    from rthyb_rt.diagnose.force import contribution

    search = d.force
    assert search is not None
    f = d.case.channels["f_meas"].copy()
    if d.verdict in ("explained", "ambiguous"):
        for i in range(len(search.best.members)):
            f -= contribution(search.problem, search.best, i)
    return replace(d.case, channels={**d.case.channels, "f_meas": f}, notes=[])


def _unit(effect: Effect, ctx: Context) -> Floats | None:
    trials = effect.trials(ctx)
    if not trials:
        return None
    trial: Trial = trials[len(trials) // 2]
    return effect.columns(ctx, trial)[0]


def _probe(clean: Case, name: str, signal: Floats, force_rms: float) -> dict[str, Any]:
    hidden = replace(
        clean, channels={**clean.channels, "f_meas": clean.channels["f_meas"] + signal}
    )
    again = engine.diagnose(hidden)
    named = name in again.effects or any(name in s for s in again.ambiguous_with)
    return {
        "effect": name,
        "share": float(np.std(signal)) / force_rms,
        "found": bool(named),
        "verdict": again.verdict,
        "named": list(again.effects),
    }
