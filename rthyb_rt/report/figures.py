"""The figures of the report."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from rthyb_rt.analysis import measures
from rthyb_rt.analysis.summary import (
    Summary,
    recorded_structure,
    reference_pair,
    stiffness_shares,
)
from rthyb_rt.config.numerical_structure import Structure
from rthyb_rt.config.sparse_structure import SparseStructure
from rthyb_rt.core import FLAGS, RUNNING, STATES
from rthyb_rt.core.laws import law_value
from rthyb_rt.core.rows import Channel
from rthyb_rt.numbers import delay, number, quantity
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import cyclic, extra_figures, frequency
from rthyb_rt.report import drawing as draw
from rthyb_rt.report import energy as of_energy
from rthyb_rt.report import structure as of_structure
from rthyb_rt.report.decimate import robust_limit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]


def draw_all(rec: RecordedTest, summary: Summary) -> list[draw.Plate]:
    """Return the figures of a recording in the order of the report."""
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        figures = _Figures(rec, summary)
        history = bool(summary.setup.history)
        plates = [
            figures.displacement(),
            figures.peak(),
            figures.hysteresis(),
            figures.tracking_error(),
            figures.synchronisation(),
            figures.transfer(),
            None if history else figures.force(),
            None if history else figures.response(),
            figures.accumulated_error(),
            None if history else figures.energy(),
            None if history else figures.balance(),
            figures.spectra(),
            None if history else figures.response_spectrum(),
            None if history and not summary.setup.plc_enabled else figures.delay(),
            None if history else figures.stiffness(),
        ]
        plates += cyclic.plates(rec, summary.loops)
        plates += extra_figures.plates(rec)
        if figures.structure is not None:
            plates += of_structure.plates(rec, figures.structure)
    return [plate for plate in plates if plate is not None]


def draw_one(rec: RecordedTest, summary: Summary, key: str) -> draw.Plate | None:
    """Return one figure of the report by its key; None if the recording has no data for it."""
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        plate: draw.Plate | None = getattr(_Figures(rec, summary), _METHODS.get(key, key))()
    return plate


def draw_recorded(rec: RecordedTest, channels: Sequence[Channel]) -> draw.Plate:
    """Return recorded channels over time in one figure."""
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        return of_structure.chosen(rec, channels)


_METHODS = {"tracking": "tracking_error", "accumulated": "accumulated_error"}
"""Keys of figures that differ from the names of their methods."""


def peak_window(summary: Summary, t: Floats) -> tuple[float, float]:
    """Return one and a half periods around the peak of the command, inside the recording, s."""
    period = summary.setup.period_s
    if period is None:
        f_eq = summary.fei_frequency_hz
        period = 1.0 / f_eq if np.isfinite(f_eq) and f_eq > 0.0 else 0.5
    centre = summary.peak_command_time_s
    first, last = (t[0], t[-1]) if t.size else (0.0, 0.0)
    start = max(centre - 0.75 * period, first)
    return start, min(start + 1.5 * period, last)


class _Figures:
    """The signals of one recording in the units of the figures."""

    def __init__(self, rec: RecordedTest, summary: Summary) -> None:
        self.rec, self.s = rec, summary
        samples = rec.samples
        self.t = rec.time_s()
        self.running = rec.running()
        self.x_num = samples["x_num_m"] * 1e3
        self.x_cmd = samples["x_cmd_m"] * 1e3
        self.x_meas = samples["x_meas_m"] * 1e3
        self.force_kn = samples["f_meas_n"] * 1e-3
        self.pair = reference_pair(rec)
        # For all rows, NaN where the reference simulation has no value.
        self.x_ref = np.full(self.t.shape, np.nan)
        if self.pair is not None:
            self.x_ref[self.pair[0]] = self.pair[1] * 1e3
        # Values below a micrometre are not significant and must not determine the range of an axis.
        self.x_anchor = max(draw.largest(self.x_ref), 1e-3) if self.pair is not None else None
        self.x_limit = max(
            robust_limit(self.x_num, self.x_meas, self.x_ref, anchor=self.x_anchor), 1e-3
        )
        self.window = peak_window(summary, self.t)

    @cached_property
    def structure(self) -> Structure | SparseStructure | None:
        """The numerical part if it has many degrees of freedom; reading it prepares all of it."""
        return recorded_structure(self.rec)

    # --- figures ------------------------------------------------------------------------------

    def displacement(self) -> draw.Plate:
        heights = (1.6,) if self.s.setup.history else (0.5, 1.6)
        paper = draw.Paper("displacement", draw.FULL_WIDTH_IN, heights)
        axes = paper.axes[-1]
        if not self.s.setup.history:
            self._ground(paper.axes[0])
        axes.axvspan(*self.window, color="#fbf0d9", linewidth=0)
        compensated = self.s.setup.plc_enabled
        if compensated:
            draw.curve(axes, self.t, self.x_cmd, draw.ORANGE, 0.6, "compensated command")
        # The command is a thin line on a broad line of the measurement: both are visible
        # everywhere.
        draw.curve(axes, self.t, self.x_meas, draw.BLUE, 1.2, "measured")
        draw.curve(axes, self.t, self.x_num, draw.BLACK, 0.5, "command")
        lead = min(draw.largest(self.x_cmd), 1.5 * self.x_limit) if compensated else 0.0
        draw.symmetric(axes, max(self.x_limit, lead))
        draw.head(axes, "displacement, mm", order=(2, 0, 1) if compensated else (1, 0))
        self._states(axes)
        self._time_axis(axes)
        note = "Shaded: the window of the next figure."
        return paper.plate("Command and measured displacement", note + self._clipped())

    def peak(self) -> draw.Plate:
        paper = draw.Paper("peak", draw.HALF_WIDTH_IN, (1.9,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        inside = (self.t >= self.window[0]) & (self.t <= self.window[1])
        t = self.t[inside]
        shown = [self.x_num[inside], self.x_meas[inside]]
        limit = 1.3 * robust_limit(*shown)
        compensated = self.s.setup.plc_enabled
        if compensated:
            draw.curve(axes, t, self.x_cmd[inside], draw.ORANGE, 0.9, "compensated")
        draw.curve(axes, t, shown[1], draw.BLUE, 2.0, "measured")
        draw.curve(axes, t, shown[0], draw.BLACK, 0.7, "command")
        if compensated:
            shown.append(self.x_cmd[inside])
        draw.fit_range(axes, *shown, limit=limit)
        order = (2, 0, 1) if compensated else (1, 0)
        draw.head(axes, "displacement, mm", order=order, below=True)
        draw.x_label(axes, "time, s")
        axes.set_xlim(*draw.span(*self.window))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        peak = quantity(self.s.peak_command_m, "mm", 1e3)
        where = f"{self.s.peak_command_time_s:.3f} s" if np.isfinite(self.window[0]) else "–"
        return paper.plate("At the peak", f"Largest command {peak} at {where}.")

    def hysteresis(self) -> draw.Plate:
        paper = draw.Paper("hysteresis", draw.HALF_WIDTH_IN, (1.9,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        x = np.where(self.running, self.x_meas, np.nan)
        f = np.where(self.running, self.force_kn, np.nan)
        k_e = self.s.setup.k_e_n_per_m
        f_anchor = self.x_anchor * k_e * 1e-6 if self.x_anchor and k_e else None
        x_limit, f_limit = self.x_limit, robust_limit(f, anchor=f_anchor)
        axes.axhline(0.0, color=draw.GREY, linewidth=0.4)
        axes.axvline(0.0, color=draw.GREY, linewidth=0.4)
        note = "Measured force over measured displacement"
        if k_e is not None:
            # The elastic line ends at the frame.
            slope = k_e * 1e-6
            reach = min(x_limit, f_limit / slope) * 1.05
            axes.plot(
                [-reach, reach], [-slope * reach, slope * reach], color=draw.RED, linewidth=0.7,
                dashes=(5, 2), label="elastic stiffness",
            )  # fmt: skip
            note += f"; dashed, the elastic stiffness {quantity(k_e, 'kN/m', 1e-3)}"
        draw.loop(axes, x, f, draw.BLUE, 0.6, "measured", x_limit=x_limit, y_limit=f_limit)
        axes.set_xlim(-1.08 * x_limit, 1.08 * x_limit)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        draw.symmetric(axes, f_limit, ticks=5)
        draw.head(axes, "force, kN", order=(1, 0) if k_e is not None else None, below=True)
        draw.x_label(axes, "measured displacement, mm")
        return paper.plate("Hysteresis loop", note + ".")

    def tracking_error(self) -> draw.Plate:
        paper = draw.Paper("tracking", draw.FULL_WIDTH_IN, (1.0,))
        (axes,) = paper.axes
        error = self.x_meas - self.x_num
        axes.axhline(0.0, color=draw.GREY, linewidth=0.4)
        draw.curve(axes, self.t, error, draw.RED, 0.7)
        limit = robust_limit(error, anchor=self.x_anchor)
        draw.symmetric(axes, limit)
        draw.head(axes, "measured − command, mm")
        marked = self._flag_marks(axes)
        self._states(axes)
        self._time_axis(axes)
        difference = quantity(self.s.tracking_peak_difference_m, "mm", 1e3)
        note = f"Largest difference {difference}." + _cut(error, limit) + marked
        return paper.plate("Tracking error", note)

    def synchronisation(self) -> draw.Plate:
        paper = draw.Paper("synchronisation", draw.HALF_WIDTH_IN, (2.44,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        x = np.where(self.running, self.x_num, np.nan)
        y = np.where(self.running, self.x_meas, np.nan)
        limit = self.x_limit
        axes.plot([-limit, limit], [-limit, limit], color=draw.RED, linewidth=0.7, dashes=(5, 2))
        draw.loop(axes, x, y, draw.BLUE, 0.5, x_limit=limit, y_limit=limit)
        axes.set_xlim(-1.08 * limit, 1.08 * limit)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        draw.symmetric(axes, limit)
        draw.head(axes, "measured displacement, mm")
        draw.x_label(axes, "command, mm")
        note = (
            "Measured displacement over command: on the dashed line the specimen is where it "
            "should be; a loop indicates a delay, a different slope an amplitude error."
        )
        return paper.plate("Synchronisation subspace", note)

    def force(self) -> draw.Plate:
        paper = draw.Paper("force", draw.FULL_WIDTH_IN, (1.3,))
        (axes,) = paper.axes
        k_e = self.s.setup.k_e_n_per_m
        anchor = self.x_anchor * k_e * 1e-6 if self.x_anchor and k_e else None
        shown, order, beside = [self.force_kn], None, ""
        draw.curve(axes, self.t, self.force_kn, draw.BLUE, 1.2, "measured")
        if self.rec.reference is not None and self.pair is not None:
            f_ref = np.full(self.t.shape, np.nan)
            rows = self.pair[0]
            f_ref[rows] = self.rec.reference["f_ref_n"][: rows.size] * 1e-3
            draw.curve(axes, self.t, f_ref, draw.BLACK, 0.5, "reference simulation")
            shown, order, beside = [*shown, f_ref], (1, 0), " and that of the reference"
        draw.symmetric(axes, max(robust_limit(*shown, anchor=anchor), 1e-6))
        draw.head(axes, "force, kN", order=order)
        self._states(axes)
        self._time_axis(axes)
        peak = quantity(self.s.peak_force_n, "kN", 1e-3)
        return paper.plate("Force of the specimen", f"Measured{beside}; largest {peak}.")

    def transfer(self) -> draw.Plate:
        return frequency.transfer(self.rec, self.s)

    def spectra(self) -> draw.Plate:
        return frequency.spectra(self.rec)

    def response_spectrum(self) -> draw.Plate:
        return frequency.response_spectrum(self.rec, self.structure)

    def balance(self) -> draw.Plate:
        return of_energy.balance(self.rec, self.s)

    def response(self) -> draw.Plate:
        title = "Response against the reference simulation"
        if self.pair is None:
            return draw.Plate(
                "response", title, "", "The recording has no reference simulation.", False
            )
        paper = draw.Paper("response", draw.FULL_WIDTH_IN, (1.45, 0.75))
        axes, below = paper.axes
        x_meas = np.where(np.isnan(self.x_ref), np.nan, self.x_meas)
        draw.curve(axes, self.t, x_meas, draw.BLUE, 1.2, "measured")
        draw.curve(axes, self.t, self.x_ref, draw.BLACK, 0.5, "reference simulation")
        draw.symmetric(axes, self.x_limit)
        draw.head(axes, "displacement, mm", order=(1, 0))
        difference = x_meas - self.x_ref
        limit = robust_limit(difference, anchor=self.x_anchor)
        below.axhline(0.0, color=draw.GREY, linewidth=0.4)
        draw.curve(below, self.t, difference, draw.RED, 0.7)
        draw.symmetric(below, limit, ticks=3)
        draw.head(below, "measured − reference, mm")
        self._time_axis(below)
        peak = quantity(self.s.response_peak_difference_m, "mm", 1e3)
        note = f"Largest difference {peak}." + _cut(difference, limit)
        return paper.plate(title, note)

    def accumulated_error(self) -> draw.Plate | None:
        if self.pair is None:
            return None
        paper = draw.Paper("accumulated", draw.HALF_WIDTH_IN, (1.2,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        rows, x_ref = self.pair
        total = measures.accumulated_error(x_ref, self.rec.samples["x_meas_m"][rows])
        draw.curve(axes, self.t[rows], total, draw.BLACK, 1.0)
        limit = robust_limit(total)
        draw.set_range(axes, 0.0, 1.08 * limit)
        draw.head(axes, "accumulated error, m")
        self._time_axis(axes)
        end = quantity(self.s.accumulated_error_m, "m")
        note = f"Σ |measured − reference| over all samples, Eqn 4.3; {end} at the end."
        return paper.plate("Accumulated error", note)

    def energy(self) -> draw.Plate:
        half = self.pair is not None
        width = draw.HALF_WIDTH_IN if half else draw.FULL_WIDTH_IN
        paper = draw.Paper("energy", width, (1.2,), right_in=0.5, bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        run = self.rec.samples[self.running]
        t = self.t[self.running]
        error = measures.energy_error(run["f_meas_n"], run["x_num_m"], run["x_meas_m"])
        indicator = measures.tracking_indicator(run["x_num_m"], run["x_meas_m"]) * 1e6
        other = axes.twinx()
        axes.axhline(0.0, color=draw.GREY, linewidth=0.4)
        draw.curve(axes, t, error, draw.RED, 0.9, "energy error")
        draw.curve(other, t, indicator, draw.BLUE, 0.9, dashes=(4, 1.5))
        # Drawn on the other axis, listed in the common legend.
        axes.plot(
            [], [], color=draw.BLUE, linewidth=0.9, dashes=(4, 1.5), label="tracking indicator"
        )
        draw.symmetric(axes, robust_limit(error))
        draw.symmetric(other, robust_limit(indicator))
        other.tick_params(axis="y", labelcolor=draw.BLUE)
        axes.tick_params(axis="y", labelcolor=draw.RED)
        other.grid(visible=False)
        draw.head(axes, "J", right="mm²", below=True)
        self._time_axis(axes)
        note = "Rising energy error, falling indicator: the specimen lags and energy is added."
        return paper.plate("Energy error and tracking indicator", note)

    def delay(self) -> draw.Plate:
        title, given = "Delay estimate", self.s.setup
        if not given.plc_enabled:
            return draw.Plate("delay", title, "", "The test ran without delay compensation.", False)
        alpha = self.rec.samples["alpha"]
        if not given.estimator_enabled:
            fixed = delay(self.s.alpha_end, self.rec.fs_hz)
            return draw.Plate("delay", title, "", f"The delay was fixed at {fixed}.", False)
        beta = self.rec.samples["beta"]
        curved = bool(np.ptp(beta[np.isfinite(beta)]) > 0.0) if np.isfinite(beta).any() else False
        paper = draw.Paper(
            "delay", draw.FULL_WIDTH_IN, (1.05, 0.5) if curved else (1.05,), right_in=0.5
        )
        axes = paper.axes[0]
        draw.curve(axes, self.t, alpha, draw.BLUE, 1.0)
        low, high = _alpha_range(alpha, given.alpha_identified)
        bounds = [b for b in (given.alpha_min, given.alpha_max) if b is not None]
        # A bound is drawn if it is near; a distant one would flatten the curve.
        near = [b for b in bounds if low - 0.6 * (high - low) <= b <= high + 0.6 * (high - low)]
        low, high = min([low, *near]), max([high, *near])
        margin = 0.08 * (high - low)
        draw.set_range(axes, low - margin, high + margin)
        for bound in near:
            name = "lower bound" if bound == given.alpha_min else "upper bound"
            draw.level(axes, bound, f"{name} {bound:g}", draw.RED)
        if given.alpha_identified is not None:
            name = f"identified {given.alpha_identified:g}"
            curve_above = self.s.alpha_end > given.alpha_identified
            draw.level(axes, given.alpha_identified, name, draw.GREEN, above=not curve_above)
        milliseconds = 1e3 / self.rec.fs_hz

        def in_ms(samples: Any) -> Any:
            return samples * milliseconds

        def in_samples(ms: Any) -> Any:
            return ms / milliseconds

        right = axes.secondary_yaxis("right", functions=(in_ms, in_samples))
        right.spines["right"].set_visible(False)
        right.yaxis.set_major_locator(MaxNLocator(5))
        right.tick_params(axis="y", size=0.0)
        draw.head(axes, self._reported("alpha"), right="ms")
        if curved:
            second = paper.axes[1]
            draw.curve(second, self.t, beta, draw.PURPLE, 0.9)
            draw.fit_range(second, beta, limit=robust_limit(beta), ticks=3)
            draw.head(second, self._reported("beta"))
        self._time_axis(paper.axes[-1])
        note = f"At the end {delay(self.s.alpha_end, self.rec.fs_hz)}."
        far = [f"{b:g}" for b in bounds if b not in near]
        if far:
            note += f" Outside the figure: bound{'s' if len(far) > 1 else ''} {' and '.join(far)}."
        return paper.plate(title, note)

    def _reported(self, name: str) -> str:
        """Return label and unit of a value that the control law reports."""
        value = law_value(self.s.setup.controller, name)
        return name if value is None else f"{value.label}, {value.unit}"

    def stiffness(self) -> draw.Plate:
        title, given = "Tangent stiffness", self.s.setup
        if not given.rfc_enabled:
            return draw.Plate(
                "stiffness", title, "", "The test ran without force compensation.", False
            )
        k = self.rec.samples["k_t_n_per_m"] * 1e-3
        k_e = given.k_e_n_per_m
        paper = draw.Paper("stiffness", draw.FULL_WIDTH_IN, (0.6, 1.0), one_abscissa=False)
        band, axes = paper.axes
        # It alternates between its bounds within milliseconds, so only shares are shown for the
        # whole test.
        edges, shares = stiffness_shares(k, None if k_e is None else k_e * 1e-3, self.rec.fs_hz)
        start = self.t[0] if self.t.size else 0.0
        foot = np.zeros(edges.size)
        for share, colour, label in zip(
            shares, (draw.RED, draw.BLUE, draw.GREY), ("at 0", "between", "at k_e"), strict=True
        ):
            top = foot + 100.0 * np.append(share, share[-1:])
            if share.any():
                band.fill_between(
                    start + edges, foot, top, step="post", facecolor=colour, alpha=0.75,
                    linewidth=0, label=label,
                )  # fmt: skip
            foot = top
        draw.set_range(band, 0.0, 100.0, 2)
        draw.head(band, "samples of each second, %")
        self._time_axis(band)
        inside = (self.t >= self.window[0]) & (self.t <= self.window[1])
        draw.curve(axes, self.t[inside], k[inside], draw.BLUE, 0.9)
        top_k = max(robust_limit(k), (k_e or 0.0) * 1e-3)
        draw.set_range(axes, -0.06 * top_k, 1.15 * top_k)
        draw.level(axes, 0.0, "lower bound 0", draw.RED, above=True)
        note = "Corrects the force for the tracking error"
        if k_e is not None:
            draw.level(axes, k_e * 1e-3, f"elastic stiffness {number(k_e * 1e-3)} kN/m", draw.RED)
            note += "; its bounds are 0 and the elastic stiffness"
        draw.head(axes, "tangent stiffness at the peak, kN/m")
        draw.x_label(axes, "time, s")
        axes.set_xlim(*draw.span(*self.window))
        note += ". Top: its value in each second; bottom: in the window around the peak."
        return paper.plate(title, note)

    # --- parts --------------------------------------------------------------------------------

    def _ground(self, axes: Axes) -> None:
        # On a slow time scale, the laboratory's ground acceleration is smaller by its square.
        g = self.rec.samples["ag_mps2"] / 9.80665 * self.s.setup.time_scale**2
        draw.curve(axes, self.t, g, draw.GREY, 0.6)
        draw.symmetric(axes, robust_limit(g), margin=1.1, ticks=2)
        draw.head(axes, "ground acceleration, g")

    def _time_axis(self, axes: Axes) -> None:
        """Set range and label of the time axis."""
        last = self.t[-1] + 1.0 / self.rec.fs_hz if self.t.size else 0.0
        axes.set_xlim(*(draw.span(self.t[0], last) if self.t.size else (0.0, 1.0)))
        draw.x_label(axes, "time, s")

    def _states(self, axes: Axes) -> None:
        """Shade and label the intervals outside the test proper."""
        state = self.rec.samples["state"]
        if not np.any(state == RUNNING):
            return
        edges = np.flatnonzero(np.diff(state)) + 1
        for start, stop in zip([0, *edges], [*edges, state.size], strict=True):
            if state[start] == RUNNING:
                continue
            first, last = self.t[start], self.t[min(stop, state.size - 1)]
            axes.axvspan(first, last, color=draw.PALE, linewidth=0)
            if last - first > 0.03 * (self.t[-1] - self.t[0]):
                name = STATES[state[start]].lower().replace("_", " ")
                axes.text(
                    0.5 * (first + last), 0.03, name, transform=axes.get_xaxis_transform(),
                    ha="center", va="bottom", fontsize=7.0, color=draw.GREY,
                )  # fmt: skip

    def _flag_marks(self, axes: Axes) -> str:
        """Mark the flagged samples at the bottom of the axes and explain the marks."""
        flags = self.rec.samples["flags"]
        marks = []
        for level, (name, colour, word) in enumerate(
            (
                ("limited", draw.RED, "orange-red"),
                ("predicted", draw.BLUE, "blue"),
                ("not_sent", draw.BLACK, "black"),
            )
        ):
            hit = (flags & FLAGS[name]) != 0
            if not hit.any():
                continue
            columns = int(draw.FULL_WIDTH_IN * draw.COLUMNS_PER_IN)
            rows = np.unique(np.flatnonzero(hit) * columns // flags.size) * flags.size // columns
            t = np.repeat(self.t[rows], 3)
            y = np.tile([0.05 * level, 0.05 * level + 0.045, np.nan], rows.size)
            axes.plot(t, y, color=colour, linewidth=0.7, transform=axes.get_xaxis_transform())
            marks.append(f"{word}: {name.replace('_', ' ')}")
        return f" Marks at the bottom: {'; '.join(marks)}." if marks else ""

    def _clipped(self) -> str:
        shown = np.concatenate([self.x_num, self.x_meas])
        cut = _cut(shown, self.x_limit)
        return f"{cut[:-1]}: the largest value is {number(draw.largest(shown))} mm." if cut else ""


def _alpha_range(alpha: Floats, identified: float | None) -> tuple[float, float]:
    values = alpha[np.isfinite(alpha)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    if identified is not None:
        low, high = min(low, identified), max(high, identified)
    # At least four samples, so that noise in the third decimal does not fill the picture.
    spare = max(0.0, 4.0 - (high - low)) / 2.0
    return low - spare, high + spare


def _cut(y: Floats, limit: float) -> str:
    return " The axis is truncated." if draw.largest(y) > 1.5 * limit else ""
