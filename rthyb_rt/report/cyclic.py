"""The figures of a prescribed history: loops by amplitude, backbone, stiffness and damping."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from rthyb_rt.analysis.hysteresis import Amplitude, MeasuredCycle
from rthyb_rt.core import RUNNING
from rthyb_rt.numbers import count, percent, quantity
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import drawing as draw

Floats = NDArray[np.float64]

SHOWN_LOOPS = 8
"""Largest number of loops in the figure, as more would overlap; the table has all."""


def plates(rec: RecordedTest, amplitudes: tuple[Amplitude, ...]) -> list[draw.Plate]:
    """Return the figures of a recording's loops, in the order of the report."""
    if not amplitudes:
        return []
    found = [loops(rec, amplitudes)]
    if len(amplitudes) > 1:
        found += [backbone(amplitudes), over_amplitude(amplitudes)]
    return found


def loops(rec: RecordedTest, amplitudes: tuple[Amplitude, ...]) -> draw.Plate:
    """Return the last loop of each amplitude, superimposed."""
    picked = np.unique(np.linspace(0, len(amplitudes) - 1, SHOWN_LOOPS).round().astype(int))
    columns = min(picked.size, SHOWN_LOOPS // 2)
    paper = draw.Paper(
        "loops", draw.FULL_WIDTH_IN, (2.6,), bottom_in=draw.room_below(picked.size, columns)
    )
    (axes,) = paper.axes
    run = rec.samples[rec.samples["state"] == RUNNING]
    x, f = run["x_meas_m"] * 1e3, run["f_meas_n"] * 1e-3
    shades = colormaps["viridis"](np.linspace(0.0, 0.85, picked.size))
    axes.axhline(0.0, color=draw.GREY, linewidth=0.4)
    axes.axvline(0.0, color=draw.GREY, linewidth=0.4)
    # The largest is drawn first, so that smaller ones remain visible.
    for shade, number in reversed(list(zip(shades, picked, strict=True))):
        one = amplitudes[number]
        rows = slice(*one.last.rows)
        draw.loop(
            axes, x[rows], f[rows], to_hex(shade), 0.8, quantity(one.amplitude_m, "mm", 1e3),
            x_limit=_largest(x), y_limit=_largest(f),
        )  # fmt: skip
    axes.set_xlim(-1.05 * _largest(x), 1.05 * _largest(x))
    axes.xaxis.set_major_locator(MaxNLocator(9))
    draw.symmetric(axes, _largest(f))
    draw.head(axes, "measured force, kN")
    draw.legend_below(axes, columns)
    draw.x_label(axes, "measured displacement, mm")
    left = len(amplitudes) - picked.size
    note = "The last cycle of each amplitude" + (
        f"; {count(left, 'amplitude')} not shown." if left else "."
    )
    return paper.plate("Loops by amplitude", note)


def backbone(amplitudes: tuple[Amplitude, ...]) -> draw.Plate:
    """Return the peaks of the first and the last cycle of each amplitude."""
    paper = draw.Paper("backbone", draw.HALF_WIDTH_IN, (1.9,), bottom_in=draw.LEGEND_IN)
    (axes,) = paper.axes
    lower = [one.first.lower for one in reversed(amplitudes)]
    points = np.array([*lower, (0.0, 0.0), *(one.first.upper for one in amplitudes)])
    last = np.array(
        [*(one.last.lower for one in reversed(amplitudes)), *(one.last.upper for one in amplitudes)]
    )
    axes.axhline(0.0, color=draw.GREY, linewidth=0.4)
    axes.axvline(0.0, color=draw.GREY, linewidth=0.4)
    x, f = points[:, 0] * 1e3, points[:, 1] * 1e-3
    axes.plot(x, f, color=draw.BLUE, linewidth=1.0, marker="o", markersize=2.5, label="first cycle")
    axes.plot(
        last[:, 0] * 1e3, last[:, 1] * 1e-3, color=draw.ORANGE, linewidth=0.0, marker="x",
        markersize=3.5, label="last cycle",
    )  # fmt: skip
    axes.set_xlim(-1.08 * _largest(x), 1.08 * _largest(x))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    draw.symmetric(axes, max(_largest(f), _largest(last[:, 1] * 1e-3)), margin=1.08)
    draw.head(axes, "force at the peaks, kN", below=True)
    draw.x_label(axes, "displacement, mm")
    return paper.plate("Backbone", "Peaks of the first and the last cycle of each amplitude.")


def over_amplitude(amplitudes: tuple[Amplitude, ...]) -> draw.Plate:
    """Return secant stiffness and equivalent damping over the amplitude."""
    paper = draw.Paper("secant", draw.HALF_WIDTH_IN, (1.9,), right_in=0.5, bottom_in=draw.LEGEND_IN)
    (axes,) = paper.axes
    other = axes.twinx()
    x = np.array([one.amplitude_m * 1e3 for one in amplitudes])
    last: list[MeasuredCycle] = [one.last for one in amplitudes]
    k = np.array([one.secant_n_per_m * 1e-3 for one in last])
    damping = np.array([one.damping_ratio * 100.0 for one in last])
    axes.plot(x, k, color=draw.BLUE, linewidth=1.0, marker="o", markersize=2.5, label="stiffness")
    other.plot(x, damping, color=draw.RED, linewidth=0.9, marker="s", markersize=2.2)
    axes.plot([], [], color=draw.RED, linewidth=0.9, marker="s", markersize=2.2, label="damping, %")
    axes.set_xlim(0.0, 1.05 * float(x.max()))
    draw.set_range(axes, 0.0, 1.15 * max(float(k.max()), 1e-9))
    draw.set_range(other, 0.0, 1.15 * max(float(damping.max()), 1e-9))
    draw.head(axes, "secant stiffness, kN/m", below=True)
    draw.x_label(axes, "amplitude, mm")
    total = sum(loop.energy_j for one in amplitudes for loop in one.loops)
    note = (
        f"From the last cycle of each amplitude. All cycles dissipated {quantity(total, 'J')}; "
        f"equivalent damping at the largest amplitude: {percent(last[-1].damping_ratio)}."
    )
    return paper.plate("Stiffness and damping", note)


def _largest(x: Floats) -> float:
    return max(draw.largest(np.asarray(x)), 1e-9)
