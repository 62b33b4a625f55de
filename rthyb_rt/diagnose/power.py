"""The power of an answer on this recording: would a known effect be found in it?

What was found is removed from the recording, and the remaining residual of the model is shifted
along it by a third of its length: the same kind of noise in another place. In this recording an
effect of the size found, smaller ones of its kind, and a few standard effects are hidden and
diagnosed again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import effects, engine
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context, Effect, Trial
from rthyb_rt.diagnose.estimate import as_read
from rthyb_rt.diagnose.fitted import contribution, force_of
from rthyb_rt.diagnose.problem import leaning
from rthyb_rt.diagnose.result import DiagnosisResult

PROBES = ("coulomb", "viscous", "inertia", "cubic")
SIZES = (0.16, 0.08, 0.04, 0.02, 0.01, 0.005)
"""Standard deviations of a hidden force, relative to that of the recorded one."""
PARTS = (0.5, 0.25, 0.12, 0.06, 0.03)
"""The same for an effect that was found, relative to its own size."""


def self_check(
    d: DiagnosisResult, progress: Callable[[str], None] = lambda _: None
) -> list[dict[str, Any]]:
    """Return, for each effect found and each probe, whether it is found, and its smallest size.

    Requires a measured force, or an effect of the actuator; otherwise the list is empty.
    """
    out: list[dict[str, Any]] = []
    named = d.verdict in ("explained", "ambiguous")
    if named and d.disp is not None and d.disp.found:
        out += _actuators(d, progress)
    search, ctx = d.force, d.context
    if search is None or ctx is None or "f_meas" not in d.case.channels:
        return out
    clean = _without_findings(d)
    size = float(np.std(ctx.force)) or 1.0
    for i, m in enumerate(search.best.members if named else ()):
        signal = contribution(search.problem, search.best, i)
        out += _found(_Hidden(clean, m.effect.names, signal, size, "f_meas"), m.name, progress)
    for name in PROBES:
        effect = effects.catalogue().get(name)
        unit = _unit(effect, ctx) if effect is not None else None
        if unit is None:
            continue
        scale = size / (float(np.std(unit)) or 1.0)
        hidden = _Hidden(clean, (name,), scale * unit, size, "f_meas")
        smallest = _smallest(hidden, SIZES, progress, f"hiding {name}")
        out.append(
            {"effect": name, "smallest_detectable_share": smallest, "largest_tried_share": SIZES[0]}
        )
    return out


class _Hidden:
    """A signal that can be hidden in a clean recording and searched for."""

    def __init__(
        self, clean: Case, names: tuple[str, ...], signal: Floats, size: float, channel: str
    ) -> None:
        self.clean, self.names, self.signal = clean, names, signal
        self.size, self.channel = size, channel

    def share(self, factor: float = 1.0) -> float:
        """Return the hidden signal's standard deviation relative to the recorded channel's."""
        return factor * float(np.std(self.signal)) / self.size

    def diagnosed(self, factor: float) -> DiagnosisResult:
        """Return the diagnosis of the recording with ``factor`` times the signal in it."""
        channels = dict(self.clean.channels)
        channels[self.channel] = channels[self.channel] + factor * self.signal
        return engine.diagnose(replace(self.clean, channels=channels))

    def names_it(self, d: DiagnosisResult) -> bool:
        """Return whether it was named, alone or among sets that fit equally well."""
        named = {n for group in (d.effects, *d.ambiguous_with) for n in group}
        return bool(named & set(self.names))


def _smallest(
    hidden: _Hidden, factors: tuple[float, ...], progress: Callable[[str], None], word: str
) -> float | None:
    """Return the smallest of decreasing factors that is found; None if none is.

    An effect found at one size is assumed to be found at all larger sizes: half of them are tried.
    """
    low, high = -1, len(factors)
    while high - low > 1:
        middle = (low + high) // 2
        progress(word)
        if hidden.names_it(hidden.diagnosed(factors[middle])):
            low = middle
        else:
            high = middle
    return hidden.share(factors[low]) if low >= 0 else None


def _found(hidden: _Hidden, name: str, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return whether an effect is found again at its size, and at which smallest fraction of it."""
    progress(f"hiding {name}")
    again = hidden.diagnosed(1.0)
    found = hidden.names_it(again)
    channel = "disp" if hidden.channel == "x_meas" else "force"
    rows: list[dict[str, Any]] = [
        {
            "effect": name,
            "channel": channel,
            "share": hidden.share(),
            "found": found,
            "verdict": again.verdict,
            "named": list(again.effects),
        }
    ]
    if found:
        least = _smallest(hidden, PARTS, progress, f"hiding {name}")
        rows.append(
            {
                "effect": name,
                "channel": channel,
                "smallest_detectable_share": least if least is not None else hidden.share(),
            }
        )
    return rows


def _moved_on(rest: Floats, judged: NDArray[np.bool_]) -> Floats:
    """Return a model's residual shifted by a third of the evaluated rows; others unchanged."""
    out = rest.copy()
    rows = np.flatnonzero(judged)
    out[rows] = np.roll(rest[rows], rows.size // 3)
    return out


def _without_findings(d: DiagnosisResult) -> Case:
    """Return the recording without what was found in its force, and with its noise shifted."""
    search, ctx = d.force, d.context
    assert search is not None
    assert ctx is not None
    f = d.case.channels["f_meas"]
    fit = search.best if d.verdict in ("explained", "ambiguous") else search.null
    model = ctx.total + leaning(search.problem, fit)
    judged = as_read(d.case, search.problem.estimate).rows & np.isfinite(f)
    clean = model + _moved_on(f - force_of(search.problem, fit), judged)
    return replace(d.case, channels={**d.case.channels, "f_meas": clean}, notes=[])


def _actuators(d: DiagnosisResult, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the same for what was found in the actuator."""
    disp = d.disp
    assert disp is not None
    x = d.case.channels["x_meas"]
    plain = disp.task.simulate(replace(disp.task.base, shift_s=disp.best.model.shift_s)).x
    judged = np.zeros(x.size, dtype=np.bool_)
    judged[disp.task.rows] = True
    clean: Floats = plain + _moved_on(x - disp.best.motion.x, judged & np.isfinite(x))
    case = replace(d.case, channels={**d.case.channels, "x_meas": clean}, notes=[])
    out = []
    for c in d.candidates:
        if c.channel == "disp" and c.name in disp.best.names and c.signal is not None:
            size = float(np.nanstd(x)) or 1.0
            out += _found(_Hidden(case, (c.name,), c.signal, size, "x_meas"), c.name, progress)
    return out


def _unit(effect: Effect, ctx: Context) -> Floats | None:
    trials = effect.trials(ctx)
    if not trials:
        return None
    trial: Trial = trials[len(trials) // 2]
    return effect.columns(ctx, trial)[0]
