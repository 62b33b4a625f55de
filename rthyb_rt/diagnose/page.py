"""The diagnosis as a page, with the answer and the augmented model beside it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rthyb_rt import __version__
from rthyb_rt.diagnose import force as forces
from rthyb_rt.diagnose.augment import rig_toml
from rthyb_rt.diagnose.engine import Diagnosis
from rthyb_rt.diagnose.words import PLAIN, sentence
from rthyb_rt.recording import replacing
from rthyb_rt.report.html import environment, extra_needed, sheets

if TYPE_CHECKING:
    from rthyb_rt.diagnose.case import Floats
    from rthyb_rt.diagnose.outcome import Outcome
    from rthyb_rt.report.drawing import Plate


def write_report(
    folder: Path,
    d: Diagnosis,
    outcome: Outcome,
    checks: Sequence[dict[str, Any]] | None,
    model_path: Path,
) -> list[Path]:
    """Write report.html, diagnosis.json and augmented.toml; return their paths.

    Raises:
        InputError: matplotlib or jinja2 is not installed.
        RthybError: a file cannot be written.
    """
    with extra_needed("the page"):
        plates = draw_all(d)
        engine = environment()
    html = engine.get_template("diagnosis.html.j2").render(
        name=d.case.name,
        verdict=d.verdict,
        sentence=sentence(d, outcome.answer),
        notes=d.notes,
        next=d.next_experiment,
        errors=_errors(d),
        ranked=_ranked(d),
        checks=_checks(checks),
        figures_of=sheets(plates),
        versions=f"rthyb_rt {__version__} · model {model_path.name}",
    )
    text, _ = rig_toml(outcome.model)
    answer = json.dumps(_plain(outcome.answer), indent=2, ensure_ascii=False)
    paths = []
    for file, content in (
        ("report.html", html), ("diagnosis.json", answer + "\n"), ("augmented.toml", text),
    ):  # fmt: skip
        path = folder / file
        with replacing(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
        paths.append(path)
    return paths


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _errors(d: Diagnosis) -> list[tuple[str, str, str]]:
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


def _percent(value: float) -> str:
    return f"{100 * value:.3g}" if math.isfinite(value) else "–"


def _ranked(d: Diagnosis) -> list[tuple[str, str, str, str]]:
    if d.verdict == "unknown":
        return []
    rows = []
    for c in d.candidates:
        values = "; ".join(
            f"{k} {v:.4g} [{c.ci95[k][0]:.4g}, {c.ci95[k][1]:.4g}]"
            if k in c.ci95
            else f"{k} {v:.4g}"
            for k, v in c.params.items()
        )
        mark = " (named)" if c.name in d.effects else ""
        rows.append(
            (PLAIN.get(c.name, c.name) + mark, f"{c.score:.3f}", f"{c.evidence:.4g}", values)
        )
    return rows


def _checks(checks: Sequence[dict[str, Any]] | None) -> list[tuple[str, str]]:
    rows = []
    for row in checks or ():
        name = PLAIN.get(row["effect"], row["effect"])
        if "smallest_detectable_share" in row:
            share = row["smallest_detectable_share"]
            text = (
                f"found down to {100 * share:.2g} % of the force"
                if share
                else "not even at 16 % of the force"
            )
        else:
            found = "found again" if row["found"] else "not found again"
            text = f"at {100 * row['share']:.3g} % of the force: {found}"
        rows.append((name, text))
    return rows


# ---- figures ----------------------------------------------------------------------------------


def draw_all(d: Diagnosis) -> list[Plate]:
    """Return the figures that the recording has data for."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw

    plates: list[Plate] = []
    with rc_context(draw.STYLE):
        signals = _signals(d)
        if signals is not None:
            measured, before, after, unit, what = signals
            plates.append(_overlay(d, measured, before, after, unit, what))
            plates.append(_map(d, measured - before, unit))
            plates.append(_loops(d, measured, before, after, unit, what))
            plates.append(_energy(d))
            plates.append(_spectrum(d, measured - before, measured - after, unit))
    return [p for p in plates if p.svg]


def _signals(d: Diagnosis) -> tuple[Floats, Floats, Floats, str, str] | None:
    """Return what was measured, and the model's before and after, of the channel that matters."""
    if d.channel == "disp" and d.disp is not None:
        task = d.disp.task
        plain = task.simulate(task.base).x
        best = d.disp.best if d.disp.known else d.disp.null
        return task.x * 1e3, plain * 1e3, best.motion.x * 1e3, "mm", "displacement"
    search, found = d.force, d.estimate
    if search is None or found is None:
        return None
    problem = search.problem
    fit = search.best if search.best.members and d.verdict != "unknown" else search.null
    after = problem.ctx.total.copy()
    for b, nuisance in zip(fit.nuisance, problem.nuisances, strict=True):
        after += b * nuisance.column
    for i in range(len(fit.members)):
        after += forces.contribution(problem, fit, i)
    return found.force, problem.ctx.total, after, "N", "force"


def _overlay(
    d: Diagnosis, measured: Floats, before: Floats, after: Floats, unit: str, what: str
) -> Plate:
    from rthyb_rt.report import drawing as draw

    paper = draw.Paper("overlay", draw.FULL_WIDTH_IN, (1.8, 1.3))
    top, low = paper.axes
    t = d.case.t
    draw.curve(top, t, measured, draw.BLACK, 1.4, "recorded")
    draw.curve(top, t, before, draw.ORANGE, 0.8, "model")
    draw.curve(top, t, after, draw.BLUE, 0.8, "with what was found")
    draw.curve(low, t, measured - before, draw.ORANGE, 0.8, "before")
    draw.curve(low, t, measured - after, draw.BLUE, 0.8, "after")
    for a, b in d.windows:
        low.axvspan(a, b, color=draw.GREY, alpha=0.12, linewidth=0)
    top.set_xlim(*draw.span(t[0], t[-1]))
    draw.head(top, f"{what}, {unit}")
    draw.head(low, f"residual, {unit}")
    draw.x_label(low, "time, s")
    return paper.plate(f"Recorded {what}, before and after", "Shaded: where the mismatch acts.")


def _map(d: Diagnosis, residual: Floats, unit: str) -> Plate:
    from rthyb_rt.report import drawing as draw

    motion = d.estimate.motion if d.estimate else (d.disp.best.motion if d.disp else None)
    assert motion is not None
    paper = draw.Paper("map", draw.HALF_WIDTH_IN, (2.3,))
    (axes,) = paper.axes
    x, v = motion.x * 1e3, motion.v * 1e3
    cells = 40
    sums, xs, vs = np.histogram2d(x, v, bins=cells, weights=residual)
    counts, _, _ = np.histogram2d(x, v, bins=(xs, vs))
    mean = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    limit = draw.largest(mean) or 1.0
    picture = axes.pcolormesh(
        xs, vs, mean.T, cmap="RdBu_r", vmin=-limit, vmax=limit, rasterized=False
    )
    bar = axes.figure.colorbar(picture, ax=axes, fraction=0.05, pad=0.03)
    bar.ax.tick_params(labelsize=7)
    draw.head(axes, "velocity, mm/s")
    draw.x_label(axes, "displacement, mm")
    return paper.plate(
        "Residual over displacement and velocity",
        f"Mean of the model's residual in each cell, {unit}.",
    )


def _loops(
    d: Diagnosis, measured: Floats, before: Floats, after: Floats, unit: str, what: str
) -> Plate:
    from rthyb_rt.report import drawing as draw

    motion = d.estimate.motion if d.estimate else (d.disp.best.motion if d.disp else None)
    assert motion is not None
    paper = draw.Paper("loops", draw.HALF_WIDTH_IN, (2.3,))
    (axes,) = paper.axes
    x = motion.x * 1e3
    x_limit, y_limit = (
        draw.largest(x) or 1.0,
        max(draw.largest(measured), draw.largest(after)) or 1.0,
    )
    for y, colour, width, label in (
        (measured, draw.BLACK, 1.2, "recorded"), (before, draw.ORANGE, 0.7, "model"),
        (after, draw.BLUE, 0.7, "found"),
    ):  # fmt: skip
        draw.loop(axes, x, y, colour, width, label, x_limit=x_limit, y_limit=y_limit)
    draw.symmetric(axes, y_limit)
    draw.head(axes, f"{what}, {unit}")
    draw.x_label(axes, "displacement, mm")
    return paper.plate(f"{what.capitalize()} over displacement", "Loops of record and model.")


def _energy(d: Diagnosis) -> Plate:
    from rthyb_rt.report import drawing as draw

    paper = draw.Paper("energy", draw.HALF_WIDTH_IN, (2.3,))
    (axes,) = paper.axes
    motion = d.estimate.motion if d.estimate else None
    colours = (draw.BLUE, draw.ORANGE, draw.GREEN, draw.PURPLE)
    terms = [c for c in d.candidates if c.signal is not None and c.channel == "force"]
    if motion is None or not terms or d.verdict == "unknown":
        return draw.Plate("energy", "Energy by term", "", "no force term was found", True)
    dx = np.diff(motion.x, prepend=motion.x[0])
    for c, colour in zip(terms, colours, strict=False):
        assert c.signal is not None
        draw.curve(axes, d.case.t, np.cumsum(c.signal * dx), colour, 0.9, c.name)
    draw.head(axes, "energy, J")
    draw.x_label(axes, "time, s")
    return paper.plate("Work of each term up to each moment", "Rising: taken out of the motion.")


def _spectrum(d: Diagnosis, before: Floats, after: Floats, unit: str) -> Plate:
    from rthyb_rt.report import drawing as draw

    paper = draw.Paper("spectrum", draw.HALF_WIDTH_IN, (2.3,))
    (axes,) = paper.axes
    for y, colour, label in ((before, draw.ORANGE, "before"), (after, draw.BLUE, "after")):
        f, p = _welch(y, d.case.fs_hz)
        axes.loglog(f, p, color=colour, linewidth=0.8, label=label)
    draw.head(axes, f"residual, {unit}/√Hz")
    draw.x_label(axes, "frequency, Hz")
    return paper.plate("Spectrum of the residual", "White noise is a level line.")


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
