"""The model's residual over its arguments, with the law that was found and its 95 % band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.estimate import as_read
from rthyb_rt.diagnose.intervals import intervals
from rthyb_rt.diagnose.problem import columns_of, leaning
from rthyb_rt.diagnose.result import DiagnosisResult
from rthyb_rt.diagnose.words import called, together

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rthyb_rt.diagnose import force as forces
    from rthyb_rt.diagnose.case import Floats
    from rthyb_rt.diagnose.problem import Fit
    from rthyb_rt.diagnose.result import Displacement
    from rthyb_rt.report.drawing import Plate

STEP = 1e-4
"""Relative step of a parameter for the numerical derivative of a law."""
BINS, ROWS = 200, 40
"""Largest number of bins of the abscissa in which a law is one value, and rows per bin."""
LINE = 0.97
"""Fraction of a law's variance between such bins above which it is drawn as a line."""
FLAT = 1e-9
"""Relative variation up to which a signal is constant."""
BELONGS = 0.8
"""The same fraction above which a law is a function of the abscissa."""
THIN = 0.006
"""Half-width of a band, relative to the picture's height, below which its line hides it."""
JAGGED = 10.0
"""Path of the abscissa along a cycle, in picture widths, above which it is noisy."""
PARTS, POINTS = 60, 600
"""Number of averaged parts of such a cycle, and largest number of points of a cycle."""
SIDE = 0.2
"""Fraction of the largest displacement beyond which it is on one side."""
GRID = (88, 52)
"""Number of cells in which rows are counted."""
GREYS = ["#e2e2dd", "#c4c4be", "#9d9d97", "#6f6f6a"]
"""Colours from few rows in a cell to many."""
RIVALS = 2
"""Number of laws drawn beside the one that is named."""


@dataclass(frozen=True, eq=False)
class Contribution:
    """One effect of a set along the recording.

    Attributes:
        names: names in the answer.
        signal: its contribution, (n,).
        slopes: derivatives with respect to each parameter of the whole set, (n, parameters).
    """

    names: tuple[str, ...]
    signal: Floats
    slopes: Floats


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """A fitted set of effects.

    Attributes:
        parts: its effects.
        covariance: of the parameters to which the slopes refer; None if unknown.
    """

    parts: tuple[Contribution, ...]
    covariance: Floats | None

    @property
    def label(self) -> str:
        """Its effects in words."""
        return together(n for p in self.parts for n in p.names)

    def times(self, factor: float) -> FittedLaw:
        """Return the law in another unit of its contribution."""
        parts = tuple(
            Contribution(p.names, factor * p.signal, factor * p.slopes) for p in self.parts
        )
        return FittedLaw(parts, self.covariance)

    def of(self, kept: Sequence[Contribution]) -> tuple[Floats, Floats | None]:
        """Return the contribution of some of its parts, and half the width of their 95 % band."""
        signal = np.asarray(np.sum([p.signal for p in kept], axis=0))
        if self.covariance is None:
            return signal, None
        slopes = np.sum([p.slopes for p in kept], axis=0)
        variance = np.einsum("ij,jk,ik->i", slopes, self.covariance, slopes)
        return signal, 1.96 * np.sqrt(np.maximum(variance, 0.0))


@dataclass(frozen=True, eq=False)
class Rest:
    """The residual of a model in one channel, and the laws found for it.

    Attributes:
        left: residual of the model with parameters adjusted within tolerance, (n,).
        rows: rows that were evaluated, (n,).
        laws: the one that is named, then its equals.
        over: by key, a possible argument and its label, (n,).
        unit: unit of ``left``.
        channel: "force" or "disp".
    """

    left: Floats
    rows: NDArray[np.bool_]
    laws: tuple[FittedLaw, ...]
    over: dict[str, tuple[Floats, str]]
    unit: str
    channel: str


# ---- laws with their bands ----------------------------------------------------------------------


def law_of(search: forces.Search, fit: Fit, wider: Sequence[float]) -> FittedLaw:
    """Return a set of effects on the force along the recording, with its covariance.

    Args:
        search: the search that found it.
        fit: the set.
        wider: for each effect, the ratio of its intervals to those from noise alone.
    """
    ctx, members = search.problem.ctx, list(fit.members)
    columns = columns_of(ctx, members)
    signals = [_sum(b, c) for b, c in zip(fit.betas, columns, strict=True)]
    shapes = [(i, j) for i, m in enumerate(members) for j in range(len(m.trial.theta))]
    betas = [(i, j) for i, b in enumerate(fit.betas) for j in range(len(b))]
    covariance = fit.covariance
    if covariance is not None and covariance.shape[0] < len(shapes) + len(betas) + len(
        fit.nuisance
    ):
        shapes = []  # fitted without: for a set whose shapes are at a bound
    places = [*shapes, *betas]
    slopes = np.zeros((len(members), ctx.t.size, len(places)))
    for k, (i, j) in enumerate(shapes):
        theta = list(members[i].trial.theta)
        theta[j] *= np.exp(STEP)
        moved = [*members]
        moved[i] = replace(members[i], trial=Trial(tuple(theta), members[i].trial.variant))
        # All of them: a delayed load cell shows all others, so they depend on its own shape.
        for m, (b, c) in enumerate(zip(fit.betas, columns_of(ctx, moved), strict=True)):
            slopes[m, :, k] = (_sum(b, c) - signals[m]) / STEP
    for k, (i, j) in enumerate(betas, start=len(shapes)):
        slopes[i, :, k] = columns[i][j]
    known = None
    if covariance is not None:
        size = np.array([wider[i] for i, _ in places])
        known = covariance[: len(places), : len(places)] * np.outer(size, size)
    parts = [
        Contribution(m.effect.names, signal, slopes[i])
        for i, (m, signal) in enumerate(zip(members, signals, strict=True))
    ]
    return FittedLaw(tuple(parts), known)


def _sum(beta: Floats, columns: Sequence[Floats]) -> Floats:
    return np.asarray(np.sum([b * c for b, c in zip(beta, columns, strict=True)], axis=0))


def _wider(d: DiagnosisResult, search: forces.Search) -> list[float]:
    """Return the ratio of the answer's intervals to those from noise alone, for each effect."""
    assert d.context is not None
    by_name = {c.name: c for c in d.candidates if c.channel == "force"}
    out = []
    for i, m in enumerate(search.best.members):
        _, plain = intervals(search.best, i, d.context)
        answer = {k: v for n in m.effect.names if n in by_name for k, v in by_name[n].ci95.items()}
        ratios = [
            (answer[k][1] - answer[k][0]) / (high - low)
            for k, (low, high) in plain.items()
            if k in answer and high > low
        ]
        # The median: a lower limit that applies to the most certain ones says nothing about the
        # others.
        out.append(max(1.0, float(np.median(ratios))) if ratios else 1.0)
    return out


def actuator_law(disp: Displacement) -> FittedLaw:
    """Return the effects of the actuator along the recording: one law, as lags are not additive."""
    task, fit = disp.task, disp.best
    plain = task.simulate(task.base).x
    fields = [(f, v) for e, values in zip(fit.effects, fit.values, strict=True)
              for f, v in zip(e.fields, values, strict=True)]  # fmt: skip
    made = task.simulate(fit.model).x
    slopes = np.zeros((plain.size, len(fields)))
    for k, (name, value) in enumerate(fields):
        step = STEP * (abs(value) or 1e-3)
        change: dict[str, Any] = {name: value + step}
        slopes[:, k] = (task.simulate(replace(fit.model, **change)).x - made) / step
    known = fit.known(disp.scale)[: len(fields), : len(fields)]
    part = Contribution(fit.names, (made - plain) * 1e3, slopes * 1e3)
    return FittedLaw((part,), known)


# ---- residuals ----------------------------------------------------------------------------------


def rests(d: DiagnosisResult) -> list[Rest]:
    """Return the model's residuals in the evaluated channels, the one that differs first."""
    out = []
    if d.disp is not None and (d.channel == "disp" or d.force is None or _named_disp(d)):
        out.append(_of_displacement(d, d.disp))
    if d.force is not None and d.context is not None and not (d.channel == "disp" and out
                                                             and not _named_force(d)):  # fmt: skip
        out.append(_of_force(d, d.force))
    return out


def _named_disp(d: DiagnosisResult) -> bool:
    found = d.verdict in ("explained", "ambiguous")
    return found and d.disp is not None and bool(set(d.disp.best.names) & set(d.effects))


def _named_force(d: DiagnosisResult) -> bool:
    found = d.verdict in ("explained", "ambiguous")
    return found and d.force is not None and bool(set(d.force.best.names) & set(d.effects))


def _of_force(d: DiagnosisResult, search: forces.Search) -> Rest:
    problem, ctx = search.problem, search.problem.ctx
    found = as_read(d.case, problem.estimate)
    named = _named_force(d)
    fit = search.best if named else search.null
    if d.verdict == "unknown" and d.residual is not None and d.channel == "force":
        left = d.residual
    else:
        left = found.force - ctx.total - leaning(problem, fit)
    laws = []
    if named:
        laws.append(law_of(search, search.best, _wider(d, search)))
        laws += [law_of(search, f, [1.0] * len(f.members)) for f in search.equal[:RIVALS]]
    over = {
        "v": (ctx.v * 1e3, "velocity, mm/s"),
        "x": (ctx.x * 1e3, "displacement, mm"),
        "a": (ctx.a, "acceleration, m/s²"),
        "rate": (np.gradient(ctx.total) / ctx.dt * 1e-3, "rate of the model's force, kN/s"),
        "t": (ctx.t, "time, s"),
    }
    if "fy_meas" in ctx.other:
        over["fy"] = (ctx.other["fy_meas"], "force in the orthogonal direction, N")
    factor, unit = force_unit(left[found.rows])
    scaled = tuple(law.times(factor) for law in laws)
    return Rest(factor * left, found.rows, scaled, over, unit, "force")


def force_unit(*forces_n: Floats) -> tuple[float, str]:
    """Return the factor and the unit in which forces fit beside an axis: N, or kN from 10 kN."""
    finite = np.concatenate([np.abs(f[np.isfinite(f)]) for f in forces_n])
    return (1e-3, "kN") if finite.max(initial=0.0) >= 1e4 else (1.0, "N")


def _of_displacement(d: DiagnosisResult, disp: Displacement) -> Rest:
    task = disp.task
    plain = task.simulate(task.base)
    named = _named_disp(d)
    fit = disp.best if named else disp.null
    rows = np.zeros(task.x.size, dtype=np.bool_)
    rows[task.rows] = True
    left = (task.x - plain.x - fit.zero_m) * 1e3
    # Along the model's own motion, a delay and a gain are straight lines; along the command both
    # are loops, because of the lag in the model.
    over = {
        "v": (plain.v * 1e3, "velocity of the model, mm/s"),
        "x": (plain.x * 1e3, "displacement of the model, mm"),
    }
    laws = (actuator_law(disp),) if named else ()
    return Rest(left, rows, laws, over, "mm", "disp")


# ---- figures ------------------------------------------------------------------------------------


def draw_laws(d: DiagnosisResult) -> list[Plate]:
    """Return the residual over velocity, displacement, and any other argument of a law."""
    plates = []
    for rest in rests(d):
        parts = rest.laws[0].parts if rest.laws else ()
        keys = ["v", "x", *dict.fromkeys(k for k in map(_own, parts) if k)]
        plates += [_plate(rest, key) for key in keys if key in rest.over]
    return plates


def _own(part: Contribution) -> str:
    """Return an effect's argument if it is neither displacement nor velocity."""
    law = effects.catalogue().get(part.names[0]) if len(part.names) == 1 else None
    return law.over if law is not None else ""


def line_share(signal: Floats, x: Floats) -> float:
    """Return the fraction of a signal's variance that lies between narrow bins of the abscissa."""
    total = float(np.var(signal))
    if total <= FLAT**2 * float(np.mean(signal**2)):
        return 1.0  # a constant is a line over any abscissa
    if float(np.ptp(x)) == 0.0:
        return 0.0
    at, count = _bins(x)
    mean = np.bincount(at, signal, count.size) / count
    return 1.0 - float(np.mean((signal - mean[at]) ** 2)) / total


def _bins(x: Floats) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Return the bin of each value, and the number of values in each bin.

    No bin is wide, for laws that are steep at the ends, and none has many rows, for laws that jump
    at rest, where most rows are.
    """
    share = np.linspace(0.0, 1.0, int(np.clip(x.size // ROWS, 24, BINS)) // 2 + 1)[1:-1]
    even = float(x.min()) + share * float(np.ptp(x))
    edges = np.unique(np.concatenate((np.quantile(x, share), even)))
    at = np.searchsorted(edges, x, side="right")
    _, at, count = np.unique(at, return_inverse=True, return_counts=True)
    return at, count


def _elsewhere(rest: Rest, key: str) -> list[Contribution]:
    """Return the effects of the named set that depend on something else than this abscissa.

    They are subtracted if this makes another effect visible. They are not subtracted if several
    sets fit equally well, because their common part is not known.
    """
    parts = rest.laws[0].parts if len(rest.laws) == 1 else ()
    if key not in ("v", "x"):
        return [p for p in parts if _own(p) != key]

    def belongs(part: Contribution, over: str) -> bool:
        x = rest.over[over][0][rest.rows]
        return line_share(part.signal[rest.rows], x) > BELONGS

    if not any(belongs(p, key) for p in parts):
        return []
    beside = "x" if key == "v" else "v"
    return [
        p
        for p in parts
        if not belongs(p, key) and any(belongs(p, k) for k in (beside, _own(p)) if k in rest.over)
    ]


def _plate(rest: Rest, key: str) -> Plate:
    from matplotlib.ticker import MaxNLocator

    from rthyb_rt.report import drawing as draw

    over, name = rest.over[key]
    off = _elsewhere(rest, key)
    left = rest.left - np.sum([p.signal for p in off], axis=0) if off else rest.left
    several = len(rest.laws) > 1
    entries = 1 + len(rest.laws) + bool(rest.laws)
    columns = 1 if several else 3
    paper = draw.Paper(
        f"law-{rest.channel}-{key}", draw.HALF_WIDTH_IN, (2.3,),
        bottom_in=draw.room_below(entries, columns),
    )  # fmt: skip
    (axes,) = paper.axes
    draw.head(axes, f"residual, {rest.unit}")
    x, y = over[rest.rows], left[rest.rows]
    _density(axes, x, y)
    limits, cycle, thin = [y], False, False
    for law, colour in zip(rest.laws, (draw.BLUE, draw.RED, draw.GREEN), strict=False):
        first = law is rest.laws[0]
        signal, half = law.of([p for p in law.parts if p not in off])
        drawn = _drawn(rest, over, signal, half)
        label = law.label if several else "law found"
        axes.plot(
            drawn.x, drawn.f, color=colour, linewidth=1.1, label=label,
            linestyle="-" if first else "--",
        )  # fmt: skip
        if first and drawn.half is not None:
            _band(axes, drawn, colour)
            thin = float(drawn.half.max()) < THIN * float(np.ptp(signal[rest.rows]))
        cycle = cycle or drawn.cycle
        limits.append(signal[rest.rows])
    draw.set_range(axes, *_limits(limits))
    axes.set_xlim(*_limits([x], 1e-3))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    draw.legend_below(axes, columns)
    draw.x_label(axes, name)
    quantity = name.split(",")[0]
    return paper.plate(
        f"Residual of the model over {quantity}", _note(rest, quantity, off, cycle, thin)
    )


def _note(rest: Rest, quantity: str, off: Sequence[Contribution], cycle: bool, thin: bool) -> str:
    if not rest.laws:
        return "Recorded less the model; darker: more rows."
    words = ["Grey: recorded less the model, with parameters adjusted within tolerance."]
    if off:
        names = " and ".join(called(n) for p in off for n in p.names)
        do = "it does" if len(off) == 1 else "they do"
        words.append(f"Without {names}: {do} not follow {quantity}.")
    if cycle:
        words.append("The law is drawn along the largest cycle.")
    if thin:
        words.append("Its band is narrower than the line.")
    return " ".join(words)


def _limits(signals: Sequence[Floats], share: float = 2e-3) -> tuple[float, float]:
    """Return the range of some signals without a few outlying rows, with a margin."""
    low = min(float(np.quantile(s, share)) for s in signals)
    high = max(float(np.quantile(s, 1.0 - share)) for s in signals)
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin


def _density(axes: Axes, x: Floats, y: Floats) -> None:
    """Draw the density of rows: the more rows in a cell, the darker."""
    from rthyb_rt.report import drawing as draw

    limits = (_limits([x], 1e-3), _limits([y]))
    count, xs, ys = np.histogram2d(x, y, bins=GRID, range=limits)
    # A single row is visible; beyond that, by quantiles of the counts.
    levels = np.quantile(count[count > 0], [0.5, 0.8, 0.95]) if count.any() else [1.0]
    kind = np.where(count > 0, np.digitize(count, levels), -1)
    draw.tiles(axes, xs, ys, kind, GREYS)
    axes.fill([], [], facecolor=GREYS[2], linewidth=0.0, label="residual")


@dataclass(frozen=True)
class _Drawn:
    """A law for drawing: as a line if it is one, else along a cycle."""

    x: Floats
    f: Floats
    half: Floats | None
    cycle: bool


def _drawn(rest: Rest, over: Floats, signal: Floats, half: Floats | None) -> _Drawn:
    x, f = over[rest.rows], signal[rest.rows]
    if line_share(f, x) <= LINE:
        part = _cycle(rest)
        found = [over[part], signal[part]] + ([half[part]] if half is not None else [])
        if float(np.sum(np.abs(np.diff(found[0])))) > JAGGED * float(np.ptp(found[0])):
            # An estimated velocity has the noise of its sensors, and would fill the picture.
            found = [_smooth(y, max(part.size // PARTS, 1)) for y in found]
        x, f, *width = (y[:: max(1, part.size // POINTS)] for y in found)
        return _Drawn(x, f, width[0] if width else None, True)
    at, count = _bins(x)
    x, f = np.bincount(at, x) / count, np.bincount(at, f) / count
    mean = np.bincount(at, half[rest.rows]) / count if half is not None else None
    return _Drawn(x, f, mean, False)


def _smooth(y: Floats, rows: int) -> Floats:
    """Return a moving mean over this many rows."""
    padded = np.pad(y, (rows // 2, rows - 1 - rows // 2), mode="edge")
    return np.convolve(padded, np.full(rows, 1.0 / rows), mode="valid")


def _band(axes: Axes, drawn: _Drawn, colour: str) -> None:
    assert drawn.half is not None
    low, high = drawn.f - drawn.half, drawn.f + drawn.half
    axes.fill(
        np.concatenate((drawn.x, drawn.x[::-1])), np.concatenate((high, low[::-1])),
        facecolor=colour, alpha=0.3, linewidth=0.0, label="95 % band",
    )  # fmt: skip


def _cycle(rest: Rest) -> NDArray[np.int_]:
    """Return the rows of the cycle with the largest displacement."""
    x = np.where(rest.rows, rest.over["x"][0], 0.0)
    top = int(np.argmax(np.abs(x)))
    # The last side of rest with a clear displacement, so that noise around rest is no reversal.
    known = np.abs(x) > SIDE * abs(x[top])
    last = np.maximum.accumulate(np.where(known, np.arange(x.size), 0))
    turns = np.flatnonzero(np.diff(np.sign(x[last]) > 0))
    before, after = turns[turns < top], turns[turns >= top]
    begin = int(before[-2]) if before.size > 1 else 0
    end = int(after[1]) if after.size > 1 else x.size - 1
    part = np.arange(begin, end + 1)
    return part[rest.rows[part]]
