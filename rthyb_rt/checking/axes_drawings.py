"""The figures of a check of several axes: stability, Nyquist plot, tracking of each direction."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from matplotlib import rc_context
from numpy.typing import NDArray

from rthyb_rt.checking import axes_curves, drawings
from rthyb_rt.checking.axes_curves import KnownLoop, OverFrequency, StabilityCurves
from rthyb_rt.config.own_structure import OwnStructure
from rthyb_rt.lab.experiment import Group, Setup
from rthyb_rt.numbers import number, percent, quantity
from rthyb_rt.report import drawing as draw

Floats = NDArray[np.float64]

_TITLE: Final = "Stability over delay and period"
_UNKNOWN: Final = "The response of the axes is not known, or no model follows it."
_OWN: Final = "Drawn of a numerical part with matrices; those of your own part are not known."
_LOOSE: Final = "The structure has a motion without stiffness, so its modes are not known."


def plates(setup: Setup, group: Group) -> list[draw.Plate]:
    """Return all figures, in the order of the page."""
    loop = axes_curves.known(setup)
    names = group.rig.directions
    if loop is None:
        return [
            draw.Plate("stability", _TITLE, "", _UNKNOWN, False),
            draw.Plate("nyquist", drawings.NYQUIST, "", _UNKNOWN, True),
            *(draw.Plate(f"tracking-{j}", _of(name), "", _UNKNOWN, True)
              for j, name in enumerate(names)),
        ]  # fmt: skip
    followed = axes_curves.tracking(loop)
    stiffness = np.diag(np.array(group.rig.k_e))
    with rc_context(draw.STYLE):
        shown = [_tracking(followed, stiffness, j, name) for j, name in enumerate(names)]
        return [*_of_loop(loop, group), *shown]


def _of(name: str) -> str:
    return f"Predicted tracking of {name}"


def _of_loop(loop: KnownLoop, group: Group) -> list[draw.Plate]:
    """Return the figures for which the numerical part must be known."""
    own = isinstance(group.derived.structure, OwnStructure)
    limits = None if own else axes_curves.stability(loop)
    opened = None if own else axes_curves.nyquist(loop)
    why = _OWN if own else _LOOSE
    return [
        draw.Plate("stability", _TITLE, "", why, False)
        if limits is None
        else _stability(limits),
        draw.Plate("nyquist", drawings.NYQUIST, "", why, True)
        if opened is None
        else drawings.nyquist_plate(
            opened.curves,
            "Determinant of the loop opened at all axes, det(1 + L) − 1, from 0 Hz to half the "
            "sample rate; cross: −1, which the curve of a stable loop does not encircle. The axes "
            f"are known up to {opened.swept_hz:g} Hz.",
        ),
    ]  # fmt: skip


def _stability(found: StabilityCurves) -> draw.Plate:
    """Draw the largest root over an additional delay, and the largest delay over the period."""
    paper = draw.Paper(
        "stability", draw.FULL_WIDTH_IN, (1.5, 1.5), bottom_in=draw.LEGEND_IN, one_abscissa=False
    )
    roots, delays = paper.axes
    delay_ms = 1e3 * found.delay_s
    most = float(delay_ms[-1])
    for (name, growth), colour in zip(found.growth_per_s.items(), drawings.COLOURS, strict=False):
        roots.plot(delay_ms, growth, color=colour, linewidth=1.0, marker="o", markersize=2.0)
        late = 1e3 * np.nan_to_num(found.limit_s[name], nan=0.0, posinf=1e-3 * most)
        delays.plot(
            found.factors, late, color=colour, linewidth=1.0, marker="o", markersize=2.0, label=name
        )
    roots.axhline(0.0, color=draw.RED, linewidth=0.7, dashes=(5, 2))
    roots.set_xlim(float(delay_ms[0]), float(delay_ms[-1]))
    draw.fit_range(roots, *found.growth_per_s.values(), np.zeros(1), limit=1e3, ticks=4)
    draw.head(roots, "growth of the largest root, 1/s")
    draw.x_label(roots, "additional delay of all axes, ms")
    delays.axvline(1.0, color=draw.RED, linewidth=0.7, dashes=(5, 2))
    drawings.logarithmic(delays, found.factors)
    draw.set_range(delays, 0.0, 1.08 * most, ticks=4)
    draw.head(delays, "largest additional delay, ms", below=True)
    draw.x_label(delays, "periods of the structure over those of this test")
    here = int(np.argmin(np.abs(found.factors - 1.0)))
    said = ", ".join(f"{name}: {_limit(late[here])}" for name, late in found.limit_s.items())
    note = (
        "Above: growth rate of the slowest decaying or fastest growing motion, if all axes were "
        "later; it grows above the dashed line. Below: largest additional delay of a stable loop "
        "if all periods of the structure were longer or shorter, at the same stiffness and damping "
        f"ratios; delays up to {quantity(most, 'ms')} were tried. For this test, {said}."
    )
    return paper.plate(_TITLE, note)


def _limit(late_s: float) -> str:
    if math.isnan(late_s):
        return "unstable without additional delay"
    return "all of these" if math.isinf(late_s) else quantity(late_s, "ms", 1e3)


def _tracking(found: OverFrequency, stiffness: Floats, j: int, name: str) -> draw.Plate:
    """Draw gain and delay of a direction, and what the commands of the others add to it."""
    own = {key: curve[:, j, j] for key, curve in found.curves.items()}
    others = {key: axes_curves.coupling(curve, stiffness, j) for key, curve in found.curves.items()}
    paper = draw.Paper(
        f"tracking-{j}", draw.HALF_WIDTH_IN, (0.9, 0.9, 0.9), bottom_in=draw.room_below(3, 2)
    )
    gain, delay, cross = paper.axes
    drawings.draw_tracking(gain, delay, found.frequency_hz, own, named=False)
    colours = (draw.GREY, *drawings.COLOURS)
    for (key, share), colour in zip(others.items(), colours, strict=False):
        cross.plot(found.frequency_hz, share, color=colour, linewidth=0.9, label=key)
    draw.fit_range(cross, *others.values(), np.zeros(1), limit=3.0, ticks=4)
    drawings.logarithmic(cross, found.frequency_hz)
    draw.head(cross, "from the other directions")
    draw.legend_below(cross, 2)
    draw.x_label(cross, "frequency, Hz")
    worst = max(others, key=lambda key: float(others[key].max()) * (key != "not compensated"))
    at = int(np.argmax(others[worst]))
    note = (
        "Ratio of measured displacement to command, from the identified responses; dashed: perfect "
        "tracking. Below: motion due to commands of the other directions that store the same "
        f"elastic energy; {worst} at most {percent(float(others[worst][at]))}, at "
        f"{number(float(found.frequency_hz[at]))} Hz."
    )
    return paper.plate(_of(name), note)
