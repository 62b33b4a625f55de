"""The figures of the report: inline SVG by matplotlib, without pyplot and its global state."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from matplotlib.transforms import offset_copy
from numpy.typing import NDArray

from rthyb_rt import measures
from rthyb_rt.recording import FLAGS, RUNNING, STATES, Recording
from rthyb_rt.report.decimate import envelope, robust_limit, trace
from rthyb_rt.summary import Summary, number, quantity, reference_pair

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

# Okabe & Ito (2008): told apart with any kind of colour vision; dashes help in black and white.
BLACK, ORANGE, GREEN, BLUE, RED, PURPLE = (
    "#1a1a1a",
    "#e69f00",
    "#009e73",
    "#0072b2",
    "#d55e00",
    "#cc79a7",
)
GREY, PALE = "#7a7a7a", "#f1f1ee"

FULL_WIDTH_IN, HALF_WIDTH_IN = 7.1, 3.45
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN = 0.46, 0.12, 0.24, 0.34
LEGEND_IN = 0.52
COLUMNS_PER_IN = 150.0

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "rthyb_rt",
    "font.family": "sans-serif",
    "font.size": 8.0,
    "axes.linewidth": 0.5,
    "axes.edgecolor": GREY,
    "axes.labelcolor": BLACK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.0,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-99, 99),
    "grid.color": "#e7e7e3",
    "grid.linewidth": 0.5,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": BLACK,
    "ytick.labelcolor": BLACK,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 0.0,
    "lines.linewidth": 0.8,
    "lines.solid_joinstyle": "round",
    "path.simplify": True,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
    "legend.handletextpad": 0.5,
    "legend.borderaxespad": 0.0,
    "legend.borderpad": 0.0,
}


@dataclass(frozen=True)
class Plate:
    """A figure as the report shows it.

    Attributes:
        key: name in links and ids.
        title: what it shows.
        svg: the drawing; empty when there is nothing to draw, and ``note`` says why.
        note: what to know when reading it.
        half: two of these stand side by side.
    """

    key: str
    title: str
    svg: str
    note: str
    half: bool


def draw_all(rec: Recording, summary: Summary) -> list[Plate]:
    """Return the figures of a recording in the order of the report."""
    with rc_context(STYLE), np.errstate(over="ignore", invalid="ignore"):
        drawing = _Drawing(rec, summary)
        plates = [
            drawing.displacement(),
            drawing.peak(),
            drawing.hysteresis(),
            drawing.tracking_error(),
            drawing.response(),
            drawing.accumulated_error(),
            drawing.energy(),
            drawing.delay(),
            drawing.stiffness(),
        ]
    return [plate for plate in plates if plate is not None]


class _Drawing:
    """The signals of one recording in the units of the figures."""

    def __init__(self, rec: Recording, summary: Summary) -> None:
        self.rec, self.s = rec, summary
        samples = rec.samples
        self.t = rec.time_s()
        self.running = rec.running()
        self.x_num = samples["x_num_m"] * 1e3
        self.x_cmd = samples["x_cmd_m"] * 1e3
        self.x_meas = samples["x_meas_m"] * 1e3
        self.force = samples["f_meas_n"] * 1e-3
        self.pair = reference_pair(rec)
        # On all rows, with a gap where the reference simulation has nothing to say.
        self.x_ref = np.full(self.t.shape, np.nan)
        if self.pair is not None:
            self.x_ref[self.pair[0]] = self.pair[1] * 1e3
        # Below a micrometre nothing is measured that could set the range of an axis.
        self.x_anchor = max(_largest(self.x_ref), 1e-3) if self.pair is not None else None
        self.x_limit = max(
            robust_limit(self.x_num, self.x_meas, self.x_ref, anchor=self.x_anchor), 1e-3
        )
        self.window = self._peak_window()

    def _peak_window(self) -> tuple[float, float]:
        """One and a half periods around the peak of the command, inside the recording."""
        period = self.s.setup.period_s
        if period is None:
            f_eq = self.s.fei_frequency_hz
            period = 1.0 / f_eq if np.isfinite(f_eq) and f_eq > 0.0 else 0.5
        centre = self.s.peak_command_time_s
        first, last = (self.t[0], self.t[-1]) if self.t.size else (0.0, 0.0)
        start = max(centre - 0.75 * period, first)
        return start, min(start + 1.5 * period, last)

    # --- figures ------------------------------------------------------------------------------

    def displacement(self) -> Plate:
        paper = _Paper("displacement", FULL_WIDTH_IN, (0.5, 1.6))
        ground, axes = paper.axes
        g = self.rec.samples["ag_mps2"] / 9.80665
        _curve(ground, self.t, g, GREY, 0.6)
        _symmetric(ground, robust_limit(g), margin=1.1, ticks=2)
        _head(ground, "ground acceleration, g")
        axes.axvspan(*self.window, color="#fbf0d9", linewidth=0)
        _curve(axes, self.t, self.x_cmd, ORANGE, 0.6, "compensated command")
        # What was wanted is a fine line on a broader one of what came: both show everywhere.
        _curve(axes, self.t, self.x_meas, BLUE, 1.2, "measured")
        _curve(axes, self.t, self.x_num, BLACK, 0.5, "command")
        _symmetric(axes, max(self.x_limit, min(_largest(self.x_cmd), 1.5 * self.x_limit)))
        _head(axes, "displacement, mm", order=(2, 0, 1))
        self._states(axes)
        self._time_axis(axes)
        note = "Shaded: the window of the next figure."
        return paper.plate("Command and measured displacement", note + self._clipped())

    def peak(self) -> Plate:
        paper = _Paper("peak", HALF_WIDTH_IN, (1.9,), bottom_in=LEGEND_IN)
        (axes,) = paper.axes
        inside = (self.t >= self.window[0]) & (self.t <= self.window[1])
        t = self.t[inside]
        shown = self.x_num[inside], self.x_cmd[inside], self.x_meas[inside]
        _curve(axes, t, shown[1], ORANGE, 0.9, "compensated")
        _curve(axes, t, shown[2], BLUE, 2.0, "measured")
        _curve(axes, t, shown[0], BLACK, 0.7, "command")
        _from_values(axes, *shown, limit=1.3 * robust_limit(shown[0], shown[2]))
        _head(axes, "displacement, mm", order=(2, 0, 1), below=True)
        _x_label(axes, "time, s")
        axes.set_xlim(*_span(*self.window))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        peak = quantity(self.s.peak_command_m, "mm", 1e3)
        where = f"{self.s.peak_command_time_s:.3f} s" if np.isfinite(self.window[0]) else "–"
        return paper.plate("At the peak", f"Largest command {peak} at {where}.")

    def hysteresis(self) -> Plate:
        paper = _Paper("hysteresis", HALF_WIDTH_IN, (1.9,), bottom_in=LEGEND_IN)
        (axes,) = paper.axes
        x = np.where(self.running, self.x_meas, np.nan)
        f = np.where(self.running, self.force, np.nan)
        k_e = self.s.setup.k_e_n_per_m
        f_anchor = self.x_anchor * k_e * 1e-6 if self.x_anchor and k_e else None
        x_limit, f_limit = self.x_limit, robust_limit(f, anchor=f_anchor)
        x, f = trace(_clip(x, x_limit), _clip(f, f_limit), 2 * x_limit, 2 * f_limit, 700)
        axes.axhline(0.0, color=GREY, linewidth=0.4)
        axes.axvline(0.0, color=GREY, linewidth=0.4)
        note = "Measured force over measured displacement"
        if k_e is not None:
            # The elastic line ends where it leaves the frame.
            slope = k_e * 1e-6
            reach = min(x_limit, f_limit / slope) * 1.05
            axes.plot(
                [-reach, reach], [-slope * reach, slope * reach], color=RED, linewidth=0.7,
                dashes=(5, 2), label="elastic stiffness",
            )  # fmt: skip
            note += f"; dashed, the elastic stiffness {quantity(k_e, 'kN/m', 1e-3)}"
        axes.plot(x, f, color=BLUE, linewidth=0.6, label="measured")
        axes.set_xlim(-1.08 * x_limit, 1.08 * x_limit)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        _symmetric(axes, f_limit, ticks=5)
        _head(axes, "force, kN", order=(1, 0) if k_e is not None else None, below=True)
        _x_label(axes, "measured displacement, mm")
        return paper.plate("Hysteresis loop", note + ".")

    def tracking_error(self) -> Plate:
        paper = _Paper("tracking", FULL_WIDTH_IN, (1.0,))
        (axes,) = paper.axes
        error = self.x_meas - self.x_num
        axes.axhline(0.0, color=GREY, linewidth=0.4)
        _curve(axes, self.t, error, RED, 0.7)
        limit = robust_limit(error, anchor=self.x_anchor)
        _symmetric(axes, limit)
        _head(axes, "measured − command, mm")
        marked = self._flag_marks(axes)
        self._states(axes)
        self._time_axis(axes)
        difference = quantity(self.s.tracking_peak_difference_m, "mm", 1e3)
        note = f"Largest difference {difference}." + _cut(error, limit) + marked
        return paper.plate("Tracking error", note)

    def response(self) -> Plate:
        title = "Response against the reference simulation"
        if self.pair is None:
            return Plate("response", title, "", "The recording has no reference simulation.", False)
        paper = _Paper("response", FULL_WIDTH_IN, (1.45, 0.75))
        axes, below = paper.axes
        x_meas = np.where(np.isnan(self.x_ref), np.nan, self.x_meas)
        _curve(axes, self.t, x_meas, BLUE, 1.2, "measured")
        _curve(axes, self.t, self.x_ref, BLACK, 0.5, "reference simulation")
        _symmetric(axes, self.x_limit)
        _head(axes, "displacement, mm", order=(1, 0))
        difference = x_meas - self.x_ref
        limit = robust_limit(difference, anchor=self.x_anchor)
        below.axhline(0.0, color=GREY, linewidth=0.4)
        _curve(below, self.t, difference, RED, 0.7)
        _symmetric(below, limit, ticks=3)
        _head(below, "measured − reference, mm")
        self._time_axis(below)
        peak = quantity(self.s.response_peak_difference_m, "mm", 1e3)
        note = f"Largest difference {peak}." + _cut(difference, limit)
        return paper.plate(title, note)

    def accumulated_error(self) -> Plate | None:
        if self.pair is None:
            return None
        paper = _Paper("accumulated", HALF_WIDTH_IN, (1.2,), bottom_in=LEGEND_IN)
        (axes,) = paper.axes
        rows, x_ref = self.pair
        total = measures.accumulated_error(x_ref, self.rec.samples["x_meas_m"][rows])
        _curve(axes, self.t[rows], total, BLACK, 1.0)
        limit = robust_limit(total)
        _range(axes, 0.0, 1.08 * limit)
        _head(axes, "accumulated error, m")
        self._time_axis(axes)
        end = quantity(self.s.accumulated_error_m, "m")
        note = f"Σ |measured − reference| over all samples, Eqn 4.3; {end} at the end."
        return paper.plate("Accumulated error", note)

    def energy(self) -> Plate:
        half = self.pair is not None
        width = HALF_WIDTH_IN if half else FULL_WIDTH_IN
        paper = _Paper("energy", width, (1.2,), right_in=0.5, bottom_in=LEGEND_IN)
        (axes,) = paper.axes
        run = self.rec.samples[self.running]
        t = self.t[self.running]
        error = measures.energy_error(run["f_meas_n"], run["x_num_m"], run["x_meas_m"])
        indicator = measures.tracking_indicator(run["x_num_m"], run["x_meas_m"]) * 1e6
        other = axes.twinx()
        axes.axhline(0.0, color=GREY, linewidth=0.4)
        _curve(axes, t, error, RED, 0.9, "energy error")
        _curve(other, t, indicator, BLUE, 0.9, dashes=(4, 1.5))
        # Drawn on the other axis, named in the one legend.
        axes.plot([], [], color=BLUE, linewidth=0.9, dashes=(4, 1.5), label="tracking indicator")
        _symmetric(axes, robust_limit(error))
        _symmetric(other, robust_limit(indicator))
        other.tick_params(axis="y", labelcolor=BLUE)
        axes.tick_params(axis="y", labelcolor=RED)
        other.grid(visible=False)
        _head(axes, "J", right="mm²", below=True)
        self._time_axis(axes)
        note = "Energy error rising, indicator falling: the specimen lags and is fed energy."
        return paper.plate("Energy error and tracking indicator", note)

    def delay(self) -> Plate:
        title, given = "Delay estimate", self.s.setup
        if not given.plc_enabled:
            return Plate("delay", title, "", "The test ran without delay compensation.", False)
        alpha = self.rec.samples["alpha"]
        if not given.estimator_enabled:
            fixed = _alpha_words(self.s.alpha_end, self.rec.fs_hz)
            return Plate("delay", title, "", f"The delay was fixed at {fixed}.", False)
        beta = self.rec.samples["beta"]
        curved = bool(np.ptp(beta[np.isfinite(beta)]) > 0.0) if np.isfinite(beta).any() else False
        paper = _Paper("delay", FULL_WIDTH_IN, (1.05, 0.5) if curved else (1.05,), right_in=0.5)
        axes = paper.axes[0]
        _curve(axes, self.t, alpha, BLUE, 1.0)
        low, high = _alpha_range(alpha, given.alpha_identified)
        bounds = [b for b in (given.alpha_min, given.alpha_max) if b is not None]
        # A bound is drawn when it is near; one far away would flatten the curve.
        near = [b for b in bounds if low - 0.6 * (high - low) <= b <= high + 0.6 * (high - low)]
        low, high = min([low, *near]), max([high, *near])
        margin = 0.08 * (high - low)
        _range(axes, low - margin, high + margin)
        for bound in near:
            name = "lower bound" if bound == given.alpha_min else "upper bound"
            _level(axes, bound, f"{name} {bound:g}", RED)
        if given.alpha_identified is not None:
            name = f"identified {given.alpha_identified:g}"
            curve_above = self.s.alpha_end > given.alpha_identified
            _level(axes, given.alpha_identified, name, GREEN, above=not curve_above)
        milliseconds = 1e3 / self.rec.fs_hz

        def in_ms(samples: Any) -> Any:
            return samples * milliseconds

        def in_samples(ms: Any) -> Any:
            return ms / milliseconds

        right = axes.secondary_yaxis("right", functions=(in_ms, in_samples))
        right.spines["right"].set_visible(False)
        right.yaxis.set_major_locator(MaxNLocator(5))
        right.tick_params(axis="y", size=0.0)
        _head(axes, "delay estimate, samples", right="ms")
        if curved:
            second = paper.axes[1]
            _curve(second, self.t, beta, PURPLE, 0.9)
            _from_values(second, beta, limit=robust_limit(beta), ticks=3)
            _head(second, "curvature term, samples²")
        self._time_axis(paper.axes[-1])
        note = f"At the end {_alpha_words(self.s.alpha_end, self.rec.fs_hz)}."
        far = [f"{b:g}" for b in bounds if b not in near]
        if far:
            note += f" Outside the picture: bound{'s' if len(far) > 1 else ''} {' and '.join(far)}."
        return paper.plate(title, note)

    def stiffness(self) -> Plate:
        title, given = "Tangent stiffness", self.s.setup
        if not given.rfc_enabled:
            return Plate("stiffness", title, "", "The test ran without force compensation.", False)
        k = self.rec.samples["k_t_n_per_m"] * 1e-3
        paper = _Paper("stiffness", FULL_WIDTH_IN, (1.0,))
        (axes,) = paper.axes
        _curve(axes, self.t, k, BLUE, 0.7)
        k_e = given.k_e_n_per_m
        top = max(robust_limit(k), (k_e or 0.0) * 1e-3)
        _range(axes, -0.06 * top, 1.1 * top)
        _level(axes, 0.0, "lower bound 0", RED, above=True)
        note = "Corrects the force for the tracking error"
        if k_e is not None:
            _level(axes, k_e * 1e-3, f"elastic stiffness {number(k_e * 1e-3)} kN/m", RED)
            note += "; bounds 0 and the elastic stiffness"
        _head(axes, "tangent stiffness, kN/m")
        self._time_axis(axes)
        return paper.plate(title, note + ".")

    # --- parts --------------------------------------------------------------------------------

    def _time_axis(self, axes: Axes) -> None:
        """Give the axis of time its range and label."""
        last = self.t[-1] + 1.0 / self.rec.fs_hz if self.t.size else 0.0
        axes.set_xlim(*(_span(self.t[0], last) if self.t.size else (0.0, 1.0)))
        _x_label(axes, "time, s")

    def _states(self, axes: Axes) -> None:
        """Shade and name the stretches outside the test proper."""
        state = self.rec.samples["state"]
        if not np.any(state == RUNNING):
            return
        edges = np.flatnonzero(np.diff(state)) + 1
        for start, stop in zip([0, *edges], [*edges, state.size], strict=True):
            if state[start] == RUNNING:
                continue
            first, last = self.t[start], self.t[min(stop, state.size - 1)]
            axes.axvspan(first, last, color=PALE, linewidth=0)
            if last - first > 0.03 * (self.t[-1] - self.t[0]):
                name = STATES[state[start]].lower().replace("_", " ")
                axes.text(
                    0.5 * (first + last), 0.03, name, transform=axes.get_xaxis_transform(),
                    ha="center", va="bottom", fontsize=7.0, color=GREY,
                )  # fmt: skip

    def _flag_marks(self, axes: Axes) -> str:
        """Mark the flagged samples along the foot of the axes and say what the marks mean."""
        flags = self.rec.samples["flags"]
        said = []
        for level, (name, colour, word) in enumerate(
            (
                ("limited", RED, "orange-red"),
                ("predicted", BLUE, "blue"),
                ("not_sent", BLACK, "black"),
            )
        ):
            hit = (flags & FLAGS[name]) != 0
            if not hit.any():
                continue
            columns = int(FULL_WIDTH_IN * COLUMNS_PER_IN)
            rows = np.unique(np.flatnonzero(hit) * columns // flags.size) * flags.size // columns
            t = np.repeat(self.t[rows], 3)
            y = np.tile([0.05 * level, 0.05 * level + 0.045, np.nan], rows.size)
            axes.plot(t, y, color=colour, linewidth=0.7, transform=axes.get_xaxis_transform())
            said.append(f"{word}: {name.replace('_', ' ')}")
        return f" Marks at the foot, {'; '.join(said)}." if said else ""

    def _clipped(self) -> str:
        shown = np.concatenate([self.x_num, self.x_meas])
        cut = _cut(shown, self.x_limit)
        return f"{cut[:-1]}: the largest value is {number(_largest(shown))} mm." if cut else ""


class _Paper:
    """A sheet with axes below one another, placed in inches."""

    def __init__(
        self, key: str, width_in: float, heights_in: tuple[float, ...], *,
        right_in: float = RIGHT_IN, bottom_in: float = BOTTOM_IN,
    ) -> None:  # fmt: skip
        self.key, self.half = key, width_in == HALF_WIDTH_IN
        gap_in = 0.30
        height_in = TOP_IN + sum(heights_in) + gap_in * (len(heights_in) - 1) + bottom_in
        self.figure = Figure(figsize=(width_in, height_in))
        self.figure.patch.set_visible(False)
        self.axes: list[Axes] = []
        top = height_in - TOP_IN
        for height in heights_in:
            box = (LEFT_IN, top - height, width_in - LEFT_IN - right_in, height)
            fraction = np.array(box) / np.array([width_in, height_in, width_in, height_in])
            axes = self.figure.add_axes(
                (fraction[0], fraction[1], fraction[2], fraction[3]),
                sharex=self.axes[0] if self.axes else None,
            )
            axes.patch.set_visible(False)
            axes.grid(axis="y")
            self.axes.append(axes)
            top -= height + gap_in
        for axes in self.axes[:-1]:
            axes.tick_params(axis="x", labelbottom=False)

    def plate(self, title: str, note: str) -> Plate:
        """Return the finished figure."""
        return Plate(self.key, title, _svg(self.figure, self.key, title), note, self.half)


def _curve(
    axes: Axes, x: Floats, y: Floats, colour: str, width: float, label: str = "",
    dashes: tuple[float, float] | None = None,
) -> None:  # fmt: skip
    """Draw a curve over time, thinned to what the paper shows."""
    width_in = axes.get_position().width * axes.figure.get_figwidth()  # type: ignore[union-attr]
    x, y = envelope(x, np.where(np.isfinite(y), y, np.nan), int(width_in * COLUMNS_PER_IN))
    # A curve far beyond the frame would overflow the coordinates of the drawing.
    finite = np.abs(y[np.isfinite(y)])
    if finite.size and finite.max() > 0.0:
        y = _clip(y, robust_limit(y) * 5.0)
    kind: dict[str, Any] = {"dashes": dashes} if dashes else {}
    if label:
        kind["label"] = label
    axes.plot(x, y, color=colour, linewidth=width, **kind)


def _clip(y: Floats, limit: float) -> Floats:
    return np.clip(y, -1.5 * limit, 1.5 * limit)


def _largest(x: Floats) -> float:
    finite = np.abs(x[np.isfinite(x)])
    return float(finite.max()) if finite.size else 0.0


def _symmetric(axes: Axes, limit: float, margin: float = 1.06, ticks: int = 5) -> None:
    _range(axes, -margin * limit, margin * limit, ticks)


def _range(axes: Axes, low: float, high: float, ticks: int = 5) -> None:
    """Set the range of the ordinate with plain numbers, powers of ten only where there must be."""
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(ticks, min_n_ticks=3))
    if not 1e-3 <= max(abs(low), abs(high)) < 1e5:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 2)))


def _from_values(axes: Axes, *signals: Floats, limit: float, ticks: int = 6) -> None:
    """Fit the ordinate to the signals, but not beyond ``limit`` either side."""
    values = np.concatenate(signals)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    low, high = max(low, -limit), min(high, limit)
    if not high > low:
        low, high = low - 1.0, low + 1.0
    margin = 0.06 * (high - low)
    _range(axes, low - margin, high + margin, ticks)


def _span(first: float, last: float) -> tuple[float, float]:
    """Return a range of time that is never empty."""
    if not (np.isfinite(first) and np.isfinite(last)):
        return 0.0, 1.0
    return (float(first), float(last)) if last > first else (float(first), float(first) + 1e-3)


def _alpha_range(alpha: Floats, identified: float | None) -> tuple[float, float]:
    values = alpha[np.isfinite(alpha)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    if identified is not None:
        low, high = min(low, identified), max(high, identified)
    # At least four samples, lest noise in the third decimal fills the picture.
    spare = max(0.0, 4.0 - (high - low)) / 2.0
    return low - spare, high + spare


def _alpha_words(alpha: float, fs_hz: float) -> str:
    return f"{quantity(alpha, 'samples')} ({quantity(alpha, 'ms', 1e3 / fs_hz)})"


def _cut(y: Floats, limit: float) -> str:
    return " The axis is cut." if _largest(y) > 1.5 * limit else ""


def _level(axes: Axes, y: float, text: str, colour: str, *, above: bool = True) -> None:
    """Draw a dashed level and write its name on it."""
    axes.axhline(y, color=colour, linewidth=0.7, dashes=(5, 2))
    axes.annotate(
        text, (1.0, y), xycoords=axes.get_yaxis_transform(), xytext=(-2, 2 if above else -2),
        textcoords="offset points", ha="right", va="bottom" if above else "top",
        fontsize=7.0, color=colour,
        bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "alpha": 0.8, "linewidth": 0},
    )  # fmt: skip


def _head(
    axes: Axes, label: str, *, order: tuple[int, ...] | None = None, below: bool = False,
    right: str = "",
) -> None:  # fmt: skip
    """Write what the ordinate is, upright above the axis, and the legend at its right."""
    axes.annotate(
        label, (0.0, 1.0), xycoords=("figure points", "axes fraction"), xytext=(0, 5),
        textcoords="offset points", ha="left", va="bottom", color=BLACK,
    )  # fmt: skip
    if right:
        axes.annotate(
            right, (1.0, 1.0), xycoords="axes fraction", xytext=(6, 5),
            textcoords="offset points", ha="left", va="bottom", color=BLACK,
        )  # fmt: skip
    handles, labels = axes.get_legend_handles_labels()
    if order:
        handles, labels = [handles[i] for i in order], [labels[i] for i in order]
    if handles:
        # Beside the label where there is room, else in the line of the abscissa's label.
        corner, y, shift = (0.0, 0.0, -27.0) if below else (1.0, 1.0, 6.0)
        axes.legend(
            handles, labels, ncols=len(handles), loc="upper left" if below else "lower right",
            bbox_to_anchor=(corner, y),
            bbox_transform=offset_copy(
                axes.transAxes, axes.get_figure(root=True), 0, shift, "points"
            ),
        )  # fmt: skip


def _x_label(axes: Axes, text: str) -> None:
    axes.annotate(
        text, (1.0, 0.0), xycoords="axes fraction", xytext=(0, -15), textcoords="offset points",
        ha="right", va="top", color=BLACK,
    )  # fmt: skip


# --- SVG --------------------------------------------------------------------------------------

_DECIMALS = re.compile(r"(\d+\.\d\d)\d+")
_PATH = re.compile(r' d="[^"]*"')
_ID = re.compile(r'( id="|url\(#|href="#)')
_FONT = re.compile(r"font-family: [^;\"]*;? ?")
_UPRIGHT = re.compile(r' transform="rotate\(-0 [^"]*"')


def _svg(figure: Figure, key: str, title: str) -> str:
    """Return the figure as an element to put into a page: own ids, the page's fonts, no header."""
    FigureCanvasSVG(figure)
    out = io.StringIO()
    empty = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(out, format="svg", metadata=empty)
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _PATH.sub(_shorten, text)
    text = _UPRIGHT.sub("", _FONT.sub("", text))
    text = _ID.sub(rf"\g<1>{key}-", text)
    width, height = figure.get_size_inches() * 72.0
    head = (
        f'<svg viewBox="0 0 {width:.1f} {height:.1f}" role="img" aria-label="{title}" '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink">'
    )
    return head + text[text.index(">") + 1 :]


def _shorten(match: re.Match[str]) -> str:
    """Cut coordinates to a hundredth of a point."""
    return _DECIMALS.sub(r"\1", match.group().replace("\n", ""))
