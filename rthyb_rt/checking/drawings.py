"""The figures of a check: stability map, Nyquist plot, predicted tracking."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from rthyb_rt.checking import curves
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.numbers import quantity
from rthyb_rt.report import drawing as draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

NYQUIST = "Nyquist plot of the whole loop"

_UNKNOWN = "The rig's response is not known; rthyb identify finds it."
COLOURS = (draw.BLUE, draw.GREEN)
_REACH = 2.2
"""Range on either side of zero in the Nyquist plot; points beyond it are not critical."""


def stability(setup: Setup) -> draw.Plate:
    """Draw the delays up to which the structure is stable over its period, and the test itself."""
    title, found = "Stability over period and delay", curves.stability_map(setup)
    if found is None:
        why = "Drawn of a structure of one degree of freedom in a test that has a loop."
        return draw.Plate("stability", title, "", why, False)
    with rc_context(draw.STYLE):
        paper = draw.Paper("stability", draw.FULL_WIDTH_IN, (2.2,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        alone, led = (
            None if one is None else 1e3 * np.where(np.isfinite(one), one, 1e3)
            for one in (found.alone_s, found.with_lead_s)
        )
        assert alone is not None
        delay_ms = None if found.delay_s is None else 1e3 * found.delay_s
        seen = [alone] if led is None else [alone, led]
        top = 1.25 * max(float(np.median(one)) for one in seen)
        top = max(top, 1.6 * (delay_ms or 0.0), 1.0)
        axes.fill_between(
            found.periods_s, 0.0, alone, color=draw.GREY, alpha=0.25, linewidth=0,
            label="stable without compensation",
        )  # fmt: skip
        if led is not None:
            draws = np.where(led > 0.0, led, np.nan)
            axes.plot(found.periods_s, draws, color=draw.BLUE, linewidth=1.0,
                      label="limit with the control law as it begins")  # fmt: skip
        if delay_ms is not None:
            axes.axhline(delay_ms, color=draw.RED, linewidth=0.7, dashes=(5, 2))
            axes.plot([found.period_s], [delay_ms], "o", color=draw.RED, markersize=5.0,
                      label="this test")  # fmt: skip
        logarithmic(axes, found.periods_s)
        draw.set_range(axes, 0.0, top)
        draw.head(axes, "delay of the rig, ms", below=True)
        draw.x_label(axes, "period of the structure, s")
        at = int(np.argmin(np.abs(found.periods_s - found.period_s)))
        note = (
            "Elastic specimen, damping ratio and stiffness of the test, no force compensation. At "
            f"{quantity(found.period_s, 's')} the structure alone remains stable up to "
            f"{_milliseconds(found.alone_s[at])}"
        )
        if found.with_lead_s is not None:
            note += f", with the control law up to {_milliseconds(found.with_lead_s[at])}"
        return paper.plate(title, f"{note}.")


def _milliseconds(seconds: float) -> str:
    return "any delay" if math.isinf(seconds) else quantity(seconds, "ms", 1e3)


def nyquist(setup: Setup) -> draw.Plate:
    """Draw the Nyquist plot of the whole loop, opened at the rig, around -1."""
    found = curves.nyquist(setup)
    if found is None:
        return draw.Plate("nyquist", NYQUIST, "", _UNKNOWN, True)
    note = (
        "Loop opened at the rig, from 0 Hz to half the sample rate; cross: −1, which the "
        "curve of a stable loop does not encircle. The rig is known up to "
        f"{found.swept_hz:g} Hz."
    )
    return nyquist_plate(found.curves, note)


def nyquist_plate(curves_by_name: Mapping[str, Complexes], note: str) -> draw.Plate:
    """Draw curves of the complex plane around -1."""
    with rc_context(draw.STYLE):
        paper = draw.Paper("nyquist", draw.HALF_WIDTH_IN, (2.44,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        turn = np.linspace(0.0, 2.0 * math.pi, 200)
        axes.plot(np.cos(turn), np.sin(turn), color=draw.GREY, linewidth=0.4)
        for (name, loop), colour in zip(curves_by_name.items(), COLOURS, strict=False):
            inside = np.where(np.abs(loop) < 3.0 * _REACH, loop, np.nan)
            axes.plot(inside.real, inside.imag, color=colour, linewidth=0.9, label=name)
        axes.plot([-1.0], [0.0], "+", color=draw.RED, markersize=8.0)
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlim(-_REACH, _REACH)
        axes.set_ylim(-_REACH, _REACH)
        axes.grid(axis="x")
        draw.head(axes, "imaginary part", below=True)
        draw.x_label(axes, "real part")
        return paper.plate(NYQUIST, note)


def tracking(setup: Setup) -> draw.Plate:
    """Draw the predicted gain and delay from command to measured displacement."""
    title, found = "Predicted tracking", curves.tracking(setup)
    if found is None:
        return draw.Plate("tracking", title, "", _UNKNOWN, True)
    with rc_context(draw.STYLE):
        below_in = draw.room_below(3, 2)
        paper = draw.Paper("tracking", draw.HALF_WIDTH_IN, (1.0, 1.0), bottom_in=below_in)
        gain, delay = paper.axes
        draw_tracking(gain, delay, found.frequency_hz, found.curves)
        draw.legend_below(delay, 2)
        draw.x_label(delay, "frequency, Hz")
        note = (
            "Ratio of measured displacement to command, from the identified response; dashed: "
            "perfect tracking."
        )
        return paper.plate(title, note)


def draw_tracking(
    gain: Axes,
    delay: Axes,
    frequency_hz: Floats,
    responses: Mapping[str, Complexes],
    *,
    named: bool = True,
) -> None:
    """Draw gain and delay of responses to a command over a logarithmic abscissa.

    If ``named``, the curves of the delay have the names of the responses.
    """
    gains, delays = [], []
    for (name, g), colour in zip(responses.items(), (draw.GREY, *COLOURS), strict=False):
        gains.append(np.abs(g))
        late = -np.unwrap(np.angle(g)) / (2.0 * math.pi * frequency_hz)
        delays.append(1e3 * late)
        gain.plot(frequency_hz, gains[-1], color=colour, linewidth=0.9)
        label = name if named else None
        delay.plot(frequency_hz, delays[-1], color=colour, linewidth=0.9, label=label)
    gain.axhline(1.0, color=draw.RED, linewidth=0.7, dashes=(5, 2))
    delay.axhline(0.0, color=draw.RED, linewidth=0.7, dashes=(5, 2))
    draw.fit_range(gain, *gains, np.ones(1), limit=3.0, ticks=4)
    draw.fit_range(delay, *delays, np.zeros(1), limit=200.0, ticks=4)
    logarithmic(delay, frequency_hz)
    draw.head(gain, "gain")
    draw.head(delay, "delay, ms")


def logarithmic(axes: Axes, values: Floats) -> None:
    """Give an abscissa with these values a logarithmic scale with plain numbers."""
    axes.set_xscale("log")
    axes.set_xlim(float(values[0]), float(values[-1]))
    decades = [d * 10.0**e for e in range(-3, 4) for d in (1, 2, 5)]
    axes.set_xticks([one for one in decades if values[0] <= one <= values[-1]])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
