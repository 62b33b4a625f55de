"""The diagnosis as a page, together with the answer and the augmented model."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import __version__
from rthyb_rt.diagnose import fitted, why
from rthyb_rt.diagnose.augment import rig_toml
from rthyb_rt.diagnose.estimate import as_read
from rthyb_rt.diagnose.gaps import filled
from rthyb_rt.diagnose.ranking import rows_of
from rthyb_rt.diagnose.residual_laws import draw_laws, force_unit
from rthyb_rt.diagnose.result import DiagnosisResult
from rthyb_rt.diagnose.words import (
    LOOP_WORDS,
    called,
    check_rows,
    driving_notes,
    loop_notes,
    next_text,
    sentence,
    unheld,
)
from rthyb_rt.record.recording import replacing
from rthyb_rt.report.decimate import trace
from rthyb_rt.report.html import environment, extra_needed, sheets

if TYPE_CHECKING:
    from jinja2 import Environment

    from rthyb_rt.diagnose.case import Floats
    from rthyb_rt.diagnose.closed import ClosedLoop
    from rthyb_rt.diagnose.outcome import Outcome
    from rthyb_rt.diagnose.recovered import Recovered
    from rthyb_rt.report.drawing import Plate

AXES_SCHEMA = "rthyb-diagnose-axes/1"
"""Schema of the JSON of a recording with several axes: a ``rthyb-diagnose/1`` answer for each."""
STATES = {"none": "good", "explained": "found", "ambiguous": "open", "unknown": "dark"}
"""Colour of a verdict; none is the colour of an alarm."""
SHADES = 21
"""Number of colours of a map, odd so that the middle one represents zero."""
LOOP_CELLS, LOOP_POINTS = 250, 6000
"""Width of a loop in pixels, and its largest number of points."""


@dataclass(frozen=True)
class PagePart:
    """The diagnosis of a recording, or of one of its axes, as shown on the page.

    Attributes:
        d: the diagnosis.
        outcome: predictions and validation.
        checks: results of the self-check; None if there was none.
        reasons: the ledger of decisions, see `why.to_json`; None: created for the page.
    """

    d: DiagnosisResult
    outcome: Outcome
    checks: list[dict[str, Any]] | None
    reasons: dict[str, Any] | None = None


def write_report(
    folder: Path,
    d: DiagnosisResult,
    outcome: Outcome,
    checks: list[dict[str, Any]] | None,
    model_path: Path,
    reasons: dict[str, Any] | None = None,
) -> list[Path]:
    """Write report.html, diagnosis.json and augmented.toml; return their paths.

    Args:
        folder: output folder.
        d, outcome, checks, reasons: see `PagePart`.
        model_path: file of the model, to be named on the page.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
        RthybError: a file cannot be written.
    """
    part = PagePart(d, outcome, checks, reasons or why.to_json(d))
    html = _page([part], model_path, named=False)
    files = {"report.html": html, "diagnosis.json": _json(_answer(part))}
    return _written(folder, files | {"augmented.toml": rig_toml(outcome.model)[0]})


def write_axes_report(folder: Path, parts: Sequence[PagePart], model_path: Path) -> list[Path]:
    """Write one page and one JSON file of all axes, and an augmented model of each.

    Args:
        folder: output folder.
        parts: one for each axis.
        model_path: file of the model, to be named on the page.

    Returns:
        ``report.html``, ``diagnosis.json`` and ``augmented-AXIS.toml``.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
        RthybError: a file cannot be written.
    """
    parts = [replace(one, reasons=one.reasons or why.to_json(one.d)) for one in parts]
    answers = {one.d.case.axis: _answer(one) for one in parts}
    models = {f"augmented-{one.d.case.axis}.toml": rig_toml(one.outcome.model)[0] for one in parts}
    html = _page(parts, model_path, named=True)
    files = {"report.html": html, "diagnosis.json": _json({"schema": AXES_SCHEMA, "axes": answers})}
    return _written(folder, files | models)


def _answer(part: PagePart) -> dict[str, Any]:
    return part.outcome.answer | {"why": part.reasons}


def _json(answer: dict[str, Any]) -> str:
    return json.dumps(_plain(answer), indent=2, ensure_ascii=False) + "\n"


def _written(folder: Path, files: dict[str, str]) -> list[Path]:
    paths = []
    for file, content in files.items():
        path = folder / file
        with replacing(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
        paths.append(path)
    return paths


def _page(parts: Sequence[PagePart], model_path: Path, *, named: bool) -> str:
    """Return the page; ``named``: whether each part is headed by the name of its axis."""
    with extra_needed("the page"):
        engine = environment()
    sections, number = [], 1
    for one in parts:
        axis = one.d.case.axis if named else ""
        with extra_needed("the page"):
            plates = [*draw_all(one.d), *draw_loop(one.outcome)]
        plates = [replace(p, key=f"{axis}-{p.key}") for p in plates] if named else plates
        sections.append(
            {
                "axis": axis,
                "state": STATES[one.d.verdict],
                "verdict": one.d.verdict,
                "html": _section(engine, one, sheets(plates, number)),
            }
        )
        number += len(plates)
    first = parts[0].d
    return engine.get_template("diagnosis.html.j2").render(
        name=_name(first)
        if named or not first.case.axis
        else f"{_name(first)}, axis {first.case.axis}",
        parts=sections,
        versions=f"rthyb_rt {__version__} · model {model_path.name}",
    )


def _section(engine: Environment, part: PagePart, figures_of: list[list[tuple[int, Plate]]]) -> str:
    d, outcome, reasons = part.d, part.outcome, part.reasons or {}
    return engine.get_template("diagnosis_part.html.j2").render(
        after=_after(d),
        sentence=sentence(d, outcome.answer),
        notes=d.notes,
        next=next_text(d),
        errors=_errors(d),
        ranked=_ranked(d),
        checks=check_rows(part.checks),
        checked=part.checks is not None,
        figures_of=figures_of,
        closed=_closed(d, outcome.answer),
        limits=unheld(d, outcome) + driving_notes(d),
        facts=reasons["facts"],
        ledger=[
            (t, [(why.words_of(r), r, why.figures(r)) for r in rows])
            for t, rows in why.groups(reasons)
        ],
    )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _errors(d: DiagnosisResult) -> list[tuple[str, str, str]]:
    rows = []
    for key, title in (
        ("force", "force, this recording"), ("disp", "displacement, this recording"),
    ):  # fmt: skip
        if f"nrmse_before_{key}" in d.fit:
            rows.append(
                (
                    title,
                    _percent(d.fit[f"nrmse_before_{key}"]),
                    _percent(d.fit[f"nrmse_after_{key}"]),
                )
            )
    for key, title in (("force", "force, held out"), ("disp", "displacement, held out")):
        if f"heldout_nrmse_before_{key}" in d.fit:
            before = d.fit[f"heldout_nrmse_before_{key}"]
            after = d.fit.get(f"heldout_nrmse_after_{key}", float("nan"))
            rows.append((title, _percent(before), _percent(after)))
    return rows


def _closed(d: DiagnosisResult, answer: dict[str, Any]) -> dict[str, Any]:
    """Return the text about the closed loop; empty if there is none."""
    loop = answer.get("closed_loop")
    if loop is None:
        return {}
    rows, notes = [], loop_notes(d, answer)
    if loop["possible"]:
        for name, word in LOOP_WORDS.items():
            before, after = loop["nrmse_before"][name], loop["nrmse_after"][name]
            if _compared(before, after):
                rows.append((word, _percent(before), _percent(after)))
    for name, symbol in (("alpha", "alpha"), ("k_t_n_per_m", "k_t")):
        found = answer.get("recovered", {}).get(name, {"possible": True})
        if not found["possible"]:
            notes.append(f"{symbol} could not be recovered: {found['why']}.")
    return {"rows": rows, "notes": notes}


_ROUNDING: Final = 1e-12
"""Errors below this are rounding of double numbers (1e-16 of a value) in sums over a recording."""


def _compared(before: float, after: float) -> bool:
    """Return whether there is an error: a prescribed history has no delay estimate to compare."""
    return math.isfinite(before) or math.isfinite(after)


def _percent(value: float) -> str:
    """Return an error in percent; what is left of a sum of zeros is 0."""
    if not math.isfinite(value):
        return "–"
    return f"{100 * value:.3g}" if abs(value) > _ROUNDING else "0"


def _name(d: DiagnosisResult) -> str:
    """Return the recording's name: its file, or its folder if the file has the standard name."""
    if d.case.name != "recording":
        return d.case.name
    return d.case.folder or d.case.name


def _after(d: DiagnosisResult) -> str:
    """Return a description of the second of two models."""
    if d.verdict in ("explained", "ambiguous"):
        return "with the effects found"
    return "parameters adjusted within tolerance"


def _ranked(d: DiagnosisResult) -> list[tuple[str, str, str, str, str, list[str]]]:
    return [
        (
            row.effects,
            row.mark,
            f"{row.weight:.3f}",
            f"{row.evidence:,.0f}".replace("-", "−").replace(",", "\u202f"),
            f"{100 * min(row.held_out, 1.0):.3g} %" if math.isfinite(row.held_out) else "–",
            row.params,
        )
        for row in rows_of(d)
    ]


# ---- figures ----------------------------------------------------------------------------------


def draw_all(d: DiagnosisResult) -> list[Plate]:
    """Return the figures for which the recording has data."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw

    plates: list[Plate] = []
    with rc_context(draw.STYLE):
        signals = _signals(d)
        if signals is not None:
            plates.append(_overlay(d, signals))
            plates += draw_laws(d)
            plates.append(_map(d, signals))
            plates.append(_loops(d, signals))
            plates.append(_energy(d))
            plates.append(_spectrum(d, signals))
    return [p for p in plates if p.svg]


def draw_loop(outcome: Outcome) -> list[Plate]:
    """Return the figures of the closed loop: simulated again, or recovered from its signals."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw

    with rc_context(draw.STYLE):
        if outcome.closed is not None:
            return [_simulated_again(outcome.closed)]
        if outcome.recovered is not None:
            return [p for p in [_recovered(outcome.recovered, outcome)] if p is not None]
    return []


def _simulated_again(loop: ClosedLoop) -> Plate:
    from rthyb_rt.report import drawing as draw

    shown = [
        (name, title, factor)
        for name, title, factor in (
            ("x_meas", "x_meas, mm", 1e3), ("x_num", "x_num, mm", 1e3),
            ("f_meas", "f_meas, kN", 1e-3), ("alpha", "alpha, samples", 1.0),
        )
        if _compared(loop.nrmse_before[name], loop.nrmse_after[name])
    ]  # fmt: skip
    paper = draw.Paper("closed", draw.FULL_WIDTH_IN, (1.3,) * len(shown))
    for axes, (name, title, factor) in zip(paper.axes, shown, strict=True):
        for values, colour, width, label in (
            (loop.recorded, draw.BLACK, 1.4, "recorded"),
            (loop.before, draw.ORANGE, 0.8, "simulated, model as given"),
            (loop.after, draw.BLUE, 0.8, "simulated, with the effects found"),
        ):
            draw.curve(axes, loop.t, factor * values[name], colour, width, label)
        axes.set_xlim(*draw.span(loop.t[0], loop.t[-1]))
        draw.head(axes, title)
    draw.x_label(paper.axes[-1], "time, s")
    return paper.plate(
        "The test simulated again with the loop closed",
        "Same controller and ground motion; the rig is the model, as given or corrected.",
    )


def _recovered(found: Recovered, outcome: Outcome) -> Plate | None:
    from rthyb_rt.report import drawing as draw

    shown = [
        (slope, title, factor)
        for slope, title, factor in (
            (found.alpha, "alpha, samples", 1.0), (found.k_t, "k_t, kN/mm", 1e-6),
        )
        if np.isfinite(slope.value).any()
    ]  # fmt: skip
    if not shown:
        return None
    paper = draw.Paper("recovered", draw.FULL_WIDTH_IN, (1.4,) * len(shown))
    t = np.arange(found.alpha.value.size) / outcome.model.model.fs_hz
    for axes, (slope, title, factor) in zip(paper.axes, shown, strict=True):
        draw.curve(axes, t, factor * slope.value, draw.BLUE, 0.9, "recovered")
        axes.set_xlim(*draw.span(t[0], t[-1]))
        draw.head(axes, title)
    draw.x_label(paper.axes[-1], "time, s")
    return paper.plate(
        "What the controller did, recovered from its signals",
        "alpha from x_num and x_cmd (Eqn 2.5), k_t from the equation of motion (Eqn 3.2); there "
        "are gaps where the motion does not determine them.",
    )


@dataclass(frozen=True)
class _Signals:
    """Measured and modelled signals, before and after correction, of the relevant channel.

    Attributes:
        measured, before, after: each (n,), in ``unit``.
        judged: rows on which the answer is based; residuals beside gaps and during the initial
            transient are neither evaluated nor shown.
        label: label of ``after``.
    """

    measured: Floats
    before: Floats
    after: Floats
    judged: NDArray[np.bool_]
    unit: str
    what: str
    label: str

    def left(self, model: Floats) -> Floats:
        """Return the residual of a model, nan where it is not evaluated."""
        return np.where(self.judged, self.measured - model, np.nan)


def _signals(d: DiagnosisResult) -> _Signals | None:
    label = _after(d)
    if d.channel == "disp" and d.disp is not None:
        task = d.disp.task
        plain = task.simulate(task.base).x
        best = d.disp.best if d.disp.known else d.disp.null
        judged = np.zeros(task.x.size, dtype=np.bool_)
        judged[task.rows] = True
        return _Signals(
            task.x * 1e3, plain * 1e3, best.motion.x * 1e3, judged, "mm", "displacement", label
        )
    search, found = d.force, d.estimate
    if search is None or found is None:
        return _only_motion(d, label)
    problem, found = search.problem, as_read(d.case, found)
    fit = search.best if search.best.members and d.verdict != "unknown" else search.null
    shown = (found.force, problem.ctx.total, fitted.force_of(problem, fit))
    factor, unit = force_unit(*shown)
    measured, before, after = (factor * force for force in shown)
    return _Signals(measured, before, after, found.rows, unit, "force", label)


def _only_motion(d: DiagnosisResult, label: str) -> _Signals | None:
    """Return the displacement of a recording without force."""
    if d.disp is None:
        return None
    return _signals(replace(d, channel="disp"))


def _overlay(d: DiagnosisResult, s: _Signals) -> Plate:
    from rthyb_rt.report import drawing as draw

    paper = draw.Paper("overlay", draw.FULL_WIDTH_IN, (1.8, 1.3))
    top, low = paper.axes
    t = d.case.t
    draw.curve(top, t, s.measured, draw.BLACK, 1.4, "recorded")
    draw.curve(top, t, s.before, draw.ORANGE, 0.8, "model as given")
    draw.curve(top, t, s.after, draw.BLUE, 0.8, s.label)
    draw.curve(low, t, s.left(s.before), draw.ORANGE, 0.8, "before")
    draw.curve(low, t, s.left(s.after), draw.BLUE, 0.8, "after")
    for a, b in d.windows:
        low.axvspan(a, b, color=draw.GREY, alpha=0.12, linewidth=0)
    top.set_xlim(*draw.span(t[0], t[-1]))
    draw.head(top, f"{s.what}, {s.unit}")
    draw.head(low, f"residual, {s.unit}")
    draw.x_label(low, "time, s")
    where = "Shaded: intervals in which the mismatch acts." if d.windows else ""
    return paper.plate(f"Recorded {s.what}, before and after", where)


def _motion_of(d: DiagnosisResult) -> tuple[Floats, Floats]:
    """Return displacement in mm and velocity in mm/s."""
    motion = d.estimate.motion if d.estimate else (d.disp.best.motion if d.disp else None)
    assert motion is not None
    return motion.x * 1e3, motion.v * 1e3


def _map(d: DiagnosisResult, s: _Signals) -> Plate:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex
    from matplotlib.ticker import MaxNLocator

    from rthyb_rt.report import drawing as draw

    paper = draw.Paper("map", draw.HALF_WIDTH_IN, (2.3,), right_in=0.62)
    (axes,) = paper.axes
    residual = s.left(s.before)
    there = np.isfinite(residual)
    x, v = (q[there] for q in _motion_of(d))
    cells = 40
    sums, xs, vs = np.histogram2d(x, v, bins=cells, weights=residual[there])
    counts, _, _ = np.histogram2d(x, v, bins=(xs, vs))
    mean = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    limit = draw.largest(mean) or 1.0
    edges = np.linspace(-limit, limit, SHADES + 1)
    colours = [to_hex(c) for c in colormaps["RdBu_r"](np.linspace(0.0, 1.0, SHADES))]
    kind = np.where(counts > 0, np.clip(np.digitize(mean, edges) - 1, 0, SHADES - 1), -1)
    draw.tiles(axes, xs, vs, kind, colours)
    axes.set_xlim(xs[0], xs[-1])
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylim(vs[0], vs[-1])
    box = axes.get_position()
    beside = paper.figure.add_axes((box.x1 + 0.02, box.y0, 0.025, box.height))
    draw.tiles(beside, np.array([0.0, 1.0]), edges, np.arange(SHADES)[None, :], colours)
    beside.set_xlim(0.0, 1.0)
    beside.set_ylim(-limit, limit)
    beside.xaxis.set_visible(False)
    beside.yaxis.tick_right()
    beside.tick_params(labelsize=7)
    beside.yaxis.set_major_locator(MaxNLocator(5))
    for side in beside.spines.values():
        side.set_visible(False)
    draw.head(axes, "velocity, mm/s", right=s.unit)
    draw.x_label(axes, "displacement, mm")
    return paper.plate(
        "Residual over displacement and velocity",
        f"Mean residual of the model as given in each cell, {s.unit}.",
    )


def _loops(d: DiagnosisResult, s: _Signals) -> Plate:
    if s.what == "displacement":
        u = filled(d.case.channels["x_cmd"]) * 1e3
        curves = [y - u for y in (s.measured, s.before, s.after)]
        return _looped(
            s, u, curves, ("command, mm", "x_meas − x_cmd, mm"),
            "Tracking error of the actuator", "A lag appears as a loop.",
        )  # fmt: skip
    return _looped(
        s, _motion_of(d)[0], [s.measured, s.before, s.after],
        ("displacement, mm", f"{s.what}, {s.unit}"),
        f"{s.what.capitalize()} over displacement", "Loops of the recording and the model.",
    )  # fmt: skip


def _looped(
    s: _Signals, x: Floats, curves: list[Floats], names: tuple[str, str], title: str, note: str
) -> Plate:
    """Return the loops of recording, model and corrected model, with labels for both axes."""
    from matplotlib.ticker import MaxNLocator

    from rthyb_rt.report import drawing as draw

    paper = draw.Paper("loops", draw.HALF_WIDTH_IN, (2.3,), bottom_in=draw.room_below(3, 3))
    (axes,) = paper.axes
    draw.head(axes, names[1])
    x_limit = draw.largest(x[s.judged]) or 1.0
    y_limit = max(draw.largest(y[s.judged]) for y in curves) or 1.0
    rows = _around_the_largest(np.flatnonzero(s.judged), x, curves[0], x_limit, y_limit)
    for y, colour, width, label in zip(
        curves, (draw.BLACK, draw.ORANGE, draw.BLUE), (1.2, 0.7, 0.7),
        ("recorded", "model", "mended"), strict=True,
    ):  # fmt: skip
        draw.loop(
            axes, x[rows], y[rows], colour, width, label,
            x_limit=x_limit, y_limit=y_limit, cells=LOOP_CELLS,
        )  # fmt: skip
    draw.symmetric(axes, y_limit)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    draw.legend_below(axes, 3)
    draw.x_label(axes, names[0])
    if rows.size < int(s.judged.sum()):
        note += " The part around the largest displacement is shown."
    return paper.plate(title, note)


def _around_the_largest(
    rows: NDArray[np.int_], x: Floats, y: Floats, x_limit: float, y_limit: float
) -> NDArray[np.int_]:
    """Return rows around the largest abscissa, few enough to draw as a loop."""
    kept = trace(x[rows], y[rows], 2.0 * x_limit, 2.0 * y_limit, LOOP_CELLS)[0].size
    if kept <= LOOP_POINTS:
        return rows
    width = rows.size * LOOP_POINTS // kept
    top = int(np.argmax(np.abs(x[rows])))
    first = int(np.clip(top - width // 2, 0, rows.size - width))
    return rows[first : first + width]


def _energy(d: DiagnosisResult) -> Plate:
    """Return the work of each term: those of the model, and those that were found."""
    from rthyb_rt.report import drawing as draw

    motion, ctx, search = d.estimate.motion if d.estimate else None, d.context, d.force
    if motion is None or ctx is None or search is None:
        return draw.Plate("energy", "Energy by term", "", "no force was recorded", True)
    rows = as_read(d.case, search.problem.estimate).rows
    dx = np.where(rows, np.diff(motion.x, prepend=motion.x[0]), 0.0)
    terms = [(ctx.force, draw.BLACK, "recorded"), (ctx.total, draw.ORANGE, "model as given")]
    colours = (draw.BLUE, draw.GREEN, draw.PURPLE, draw.RED)
    found = [c for c in d.candidates if c.signal is not None and c.channel == "force"]
    if d.verdict in ("explained", "ambiguous"):
        terms += [
            (c.signal, colour, called(c.name))
            for c, colour in zip(found, colours, strict=False)
            if c.signal is not None
        ]
    paper = draw.Paper(
        "energy", draw.HALF_WIDTH_IN, (2.3,), bottom_in=draw.room_below(len(terms), 2)
    )
    (axes,) = paper.axes
    # Before there are labelled curves, so that no legend is added: it is placed below.
    draw.head(axes, "energy, J")
    for force, colour, label in terms:
        draw.curve(axes, d.case.t, np.cumsum(force * dx), colour, 0.9, label)
    axes.set_xlim(*draw.span(d.case.t[0], d.case.t[-1]))
    draw.legend_below(axes, 2)
    draw.x_label(axes, "time, s")
    return paper.plate(
        "Cumulative work of each term", "A rising curve takes energy out of the motion."
    )


def _spectrum(d: DiagnosisResult, s: _Signals) -> Plate:
    from rthyb_rt.report import drawing as draw

    paper = draw.Paper("spectrum", draw.HALF_WIDTH_IN, (2.3,), bottom_in=0.62)
    (axes,) = paper.axes
    for y, colour, label in (
        (s.left(s.before), draw.ORANGE, "before"), (s.left(s.after), draw.BLUE, "after"),
    ):  # fmt: skip
        f, p = _welch(np.nan_to_num(y), d.case.fs_hz)
        axes.loglog(f, p, color=colour, linewidth=0.8, label=label)
    draw.head(axes, f"residual, {s.unit}/√Hz", below=True)
    draw.x_label(axes, "frequency, Hz")
    return paper.plate("Spectrum of the residual", "White noise appears as a horizontal line.")


def _welch(y: Floats, fs_hz: float) -> tuple[Floats, Floats]:
    size = int(min(y.size, max(256, y.size // 8)))
    window = np.hanning(size)
    parts = [
        np.abs(np.fft.rfft((y[i : i + size] - np.mean(y[i : i + size])) * window)) ** 2
        for i in range(0, y.size - size + 1, max(size // 2, 1))
    ]
    power = np.mean(parts, axis=0) * 2.0 / (fs_hz * np.sum(window**2))
    f_hz = np.asarray(np.fft.rfftfreq(size, 1.0 / fs_hz), dtype=np.float64)
    return f_hz[1:], np.asarray(np.sqrt(power[1:]) + 1e-30)
