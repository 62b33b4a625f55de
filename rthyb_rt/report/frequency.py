"""The figures over frequency: transfer functions, spectra, response spectra."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from rthyb_rt.analysis import response_spectrum as of_oscillators
from rthyb_rt.analysis.spectra import SURE, FrequencyResponse, frequency_response
from rthyb_rt.analysis.summary import Summary
from rthyb_rt.config.sparse_structure import SparseStructure
from rthyb_rt.numbers import number
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import drawing as draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rthyb_rt.config.numerical_structure import Structure

Floats = NDArray[np.float64]

_TOO_LITTLE = "The test is too short, or the motion too small, for a spectrum."
_G = 9.80665


def answer(rec: RecordedTest, given: str, got: str = "x_meas_m") -> FrequencyResponse | None:
    """Return the frequency response between two signals of the test proper."""
    run = rec.samples[rec.running()]
    return frequency_response(run[given], run[got], rec.fs_hz)


def transfer(rec: RecordedTest, summary: Summary) -> draw.Plate:
    """Draw gain, delay and coherence from command to measured, and of the actuator alone."""
    title = "From command to measured displacement"
    tracking = answer(rec, "x_num_m")
    if tracking is None or not tracking.known.any():
        return draw.Plate("transfer", title, "", _TOO_LITTLE, True)
    shown = [(tracking, draw.BLACK, "command to measured")]
    actuator = answer(rec, "x_cmd_m") if summary.setup.plc_enabled else None
    if actuator is not None:
        shown.append((actuator, draw.ORANGE, "actuator alone"))
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        paper = draw.Paper(
            "transfer", draw.HALF_WIDTH_IN, (0.72, 0.72, 0.4), bottom_in=draw.LEGEND_IN
        )
        gain, delay, coherence = paper.axes
        for one, colour, label in shown:
            known = np.where(one.known, 1.0, np.nan)
            width = 0.9
            gain.plot(one.frequency_hz, one.gain * known, color=colour, linewidth=width)
            delay.plot(one.frequency_hz, 1e3 * one.delay_s, color=colour, linewidth=width)
            coherence.plot(
                one.frequency_hz, one.coherence, color=colour, linewidth=width, label=label
            )
        gain.axhline(1.0, color=draw.RED, linewidth=0.7, dashes=(5, 2))
        delay.axhline(0.0, color=draw.RED, linewidth=0.7, dashes=(5, 2))
        gains = [one.gain[one.known] for one, _, _ in shown]
        delays = [1e3 * one.delay_s[one.known] for one, _, _ in shown]
        draw.fit_range(gain, *gains, np.ones(1), limit=5.0, ticks=4)
        draw.fit_range(delay, *delays, np.zeros(1), limit=500.0, ticks=4)
        draw.set_range(coherence, 0.0, 1.05, 2)
        draw.head(gain, "gain")
        draw.head(delay, "delay, ms")
        draw.head(coherence, "coherence", below=True)
        top = max(float(one.frequency_hz[one.known].max(initial=0.0)) for one, _, _ in shown)
        coherence.set_xlim(0.0, 1.15 * max(top, 2.0))
        coherence.xaxis.set_major_locator(MaxNLocator(5))
        draw.x_label(coherence, "frequency, Hz")
        step = tracking.frequency_hz[0]
        note = (
            f"Welch's average of {tracking.segments} segments, {number(step)} Hz apart; gain and "
            f"delay where the coherence is {SURE:g} or more. Dashed: perfect tracking."
        )
        return paper.plate(title, note)


def spectra(rec: RecordedTest) -> draw.Plate:
    """Draw the spectra of command and measured displacement."""
    title = "Spectra of command and measured displacement"
    found = answer(rec, "x_num_m")
    if found is None:
        return draw.Plate("spectra", title, "", _TOO_LITTLE, True)
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        paper = draw.Paper("spectra", draw.HALF_WIDTH_IN, (1.9,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        f = found.frequency_hz
        # Amplitude spectral densities, whose decades are those of the motion.
        amplitudes = [1e3 * np.sqrt(psd) for psd in (found.output_psd, found.input_psd)]
        for y, colour, width, label in zip(
            amplitudes, (draw.BLUE, draw.BLACK), (1.1, 0.5), ("measured", "command"), strict=True
        ):
            at, shown = _by_octave(f, y)
            axes.plot(at, shown, color=colour, linewidth=width, label=label)
        _both_logarithmic(axes)
        axes.set_xlim(float(f[0]), float(f[-1]))
        top = max(float(y[np.isfinite(y)].max(initial=1e-12)) for y in amplitudes)
        axes.set_ylim(1e-6 * top, 3.0 * top)
        draw.head(axes, "mm/√Hz", order=(1, 0), below=True)
        draw.x_label(axes, "frequency, Hz")
        note = "Square roots of the power spectral densities of the test proper."
        return paper.plate(title, note)


def response_spectrum(
    rec: RecordedTest, structure: Structure | SparseStructure | None
) -> draw.Plate:
    """Draw the response spectra of the ground, and of the floor, commanded and measured.

    Args:
        rec: the recording.
        structure: its numerical part; None: one degree of freedom.
    """
    title = "Response spectra"
    run = rec.samples[rec.running()]
    ag = run["ag_mps2"]
    moved = draw.largest(run["x_num_m"]) > 0.0
    if len(run) < 16 or not moved or draw.largest(run["x_meas_m"]) > 1e3:
        return draw.Plate("response_spectrum", title, "", _TOO_LITTLE, True)
    below, unknown = _below(run, structure)
    if unknown:
        return draw.Plate("response_spectrum", title, "", unknown, True)
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        paper = draw.Paper(
            "response_spectrum", draw.HALF_WIDTH_IN, (1.9,), bottom_in=draw.LEGEND_IN
        )
        (axes,) = paper.axes
        periods = of_oscillators.PERIODS_S
        shown = [
            (ag, below + run["x_meas_m"], draw.BLUE, 1.4, "measured"),
            (ag, below + run["x_num_m"], draw.BLACK, 0.6, "command"),
            (ag, None, draw.GREY, 0.8, "ground"),
        ]
        top = 0.0
        for base, floor, colour, width, label in shown:
            y = of_oscillators.pseudo_acceleration(
                rec.fs_hz, acceleration_mps2=base, displacement_m=floor
            ) / _G  # fmt: skip
            top = max(top, draw.largest(y))
            axes.plot(periods, y, color=colour, linewidth=width, label=label)
        axes.set_xscale("log")
        axes.set_xlim(float(periods[0]), float(periods[-1]))
        axes.set_xticks([0.05, 0.1, 0.2, 0.5, 1.0, 2.0])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        draw.set_range(axes, 0.0, 1.08 * max(top, 1e-6))
        draw.head(axes, "pseudo-acceleration, g", order=(1, 0, 2), below=True)
        draw.x_label(axes, "period, s")
        note = (
            f"Oscillators with {100 * of_oscillators.DAMPING:g} % damping: on the ground, on the "
            "floor that moves over it by the command, and on the floor as measured."
        )
        return paper.plate(title, note)


def _below(run: NDArray[Any], structure: Structure | SparseStructure | None) -> tuple[Any, str]:
    """Return what to add to the actuator's motion so that it is a floor's relative to the ground.

    This is 0 if the interface moves as much as the ground when the structure moves with it as a
    rigid body. The actuator of an upper storey moves a drift: the motion of the floor below is the
    recorded one of the floor above less the command.

    Args:
        run: rows of the test proper.
        structure: the numerical part; None: one degree of freedom.

    Returns:
        The displacement, m, 0 or (n,); and why it is not known, "" if it is.
    """
    if not isinstance(structure, SparseStructure):
        return 0.0, ""
    row, influence = structure.part.interface_rows()[0], structure.influence
    if abs(row @ influence - 1.0) < 1e-9:
        return 0.0, ""
    # Displacements that contain the whole of the actuator's and move with the ground as a whole.
    floors = [int(at) for at in np.flatnonzero((row == 1.0) & (influence == 1.0))]
    for one in structure.part.responses:
        if one.joints or one.interfaces or len(one.displacements) != 1:
            continue
        ((at, by),) = one.displacements
        if at in floors and by == 1.0 and one.name in (run.dtype.names or ()):
            return run[one.name] - run["x_num_m"], ""
    why = "The actuator does not move a floor relative to the ground"
    if not floors:
        return 0.0, why + ", so that no floor's motion is known."
    label = structure.labels[floors[0]]
    name = f"x_{label}" if structure.heights_m else label
    return 0.0, (
        f'{why} but the difference between two, and the motion of the upper one, "{name}", was not '
        f'recorded: add "{name}" to record in [numerical].'
    )


def _by_octave(f: Floats, y: Floats, per_octave: int = 24) -> tuple[Floats, Floats]:
    """Average lines that are closer than a logarithmic axis resolves, in the mean square."""
    bins = np.unique(np.round(per_octave * np.log2(f)), return_inverse=True)[1]
    count = np.bincount(bins)
    return np.bincount(bins, f) / count, np.sqrt(np.bincount(bins, y**2) / count)


def _both_logarithmic(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(LogLocator(10.0, numticks=8))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 1)))
    axes.yaxis.set_minor_locator(NullLocator())
