"""The Bode plot of an identified rig: results of the sine waves, and the fitted model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from rthyb_rt.config import RigFile, response
from rthyb_rt.config.rate import STANDARD, Rate
from rthyb_rt.numbers import quantity
from rthyb_rt.report import drawing as draw


class ToneLike(Protocol):
    """The result for one sine wave, like `rig.identification.Tone`."""

    @property
    def frequency_hz(self) -> float:
        """Frequency of the sine wave, Hz."""

    @property
    def gain(self) -> float:
        """Amplitude of the measured displacement over that of the command."""

    @property
    def delay_s(self) -> float:
        """Phase lag as time, s."""


def bode(rig: RigFile, tones: Sequence[ToneLike], rate: Rate = STANDARD) -> draw.Plate:
    """Draw gain, phase and delay from command to measured displacement over frequency.

    Args:
        rig: the rig with its identified values.
        tones: tones of the sweep, by increasing frequency.
        rate: rate of the sweep.
    """
    f = np.array([tone.frequency_hz for tone in tones])
    gain = np.array([tone.gain for tone in tones])
    delay = np.array([tone.delay_s for tone in tones])
    with rc_context(draw.STYLE), np.errstate(divide="ignore", invalid="ignore"):
        paper = draw.Paper("bode", draw.FULL_WIDTH_IN, (1.1, 1.1, 1.1), bottom_in=draw.LEGEND_IN)
        decibels, phase, late = paper.axes
        fitted = response.plant(rig) if f.size > 1 else None
        fine = np.geomspace(f[0], f[-1], 400)
        note = "Points: sine waves of the sweep, fitted by least squares."
        if fitted is not None:
            g = fitted.response(fine, rate.period_s, response.hold_of(rig))
            angle = np.unwrap(np.angle(g))
            # The model's phase is known up to whole turns; the slowest sine determines them.
            turns = (angle[0] + 2.0 * np.pi * f[0] * delay[0]) / (2.0 * np.pi)
            angle -= 2.0 * np.pi * np.round(turns)
            for axes, y in (
                (decibels, 20.0 * np.log10(np.abs(g))),
                (phase, np.degrees(angle)),
                (late, -1e3 * angle / (2.0 * np.pi * fine)),
            ):
                axes.plot(fine, y, color=draw.RED, linewidth=0.8)
            late.plot([], [], color=draw.RED, linewidth=0.8, label="model of the stability check")
            order = fitted.p.size - 1
            delayed = quantity(fitted.delay_s, "ms", 1e3)
            lag = f"a lag of order {order} behind " if order else ""
            note += f" Line: {lag}a delay of {delayed}, the model that rthyb check uses."
        points: dict[str, Any] = {
            "color": draw.BLUE,
            "marker": "o",
            "markersize": 3.0,
            "linewidth": 0.0,
        }
        decibels.plot(f, 20.0 * np.log10(gain), **points)
        phase.plot(f, -np.degrees(2.0 * np.pi * f * delay), **points)
        late.plot(f, 1e3 * delay, label="sines", **points)
        for axes, label in ((decibels, "gain, dB"), (phase, "phase, °"), (late, "delay, ms")):
            axes.margins(y=0.12)
            _widen(axes)
            draw.head(axes, label, below=axes is late)
        late.set_xscale("log")
        late.set_xlim(0.9 * float(f[0]), 1.1 * float(f[-1]))
        late.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        late.xaxis.set_minor_formatter(NullFormatter())
        late.set_xticks([tone for tone in f if tone in _TICKS_HZ] or list(f))
        draw.x_label(late, "frequency, Hz")
        return paper.plate(f"From command to displacement: {rig.rig.name}", note)


def _widen(axes: Axes) -> None:
    """Show at least `LEAST` of the ordinate, so that rounding does not fill a figure."""
    low, high = axes.get_ylim()
    if high - low < LEAST:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * LEAST, middle + 0.5 * LEAST)


LEAST: Final = 1.0
"""Smallest range of an ordinate, dB, ° and ms: a sample at 1024 Hz is 1 ms; chosen by judgement."""
_TICKS_HZ = (0.5, 1.0, 2.0, 4.0, 10.0, 20.0, 40.0, 80.0)
