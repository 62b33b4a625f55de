"""Write docs/effects.md and its pictures from the catalogue of effects itself.

``python docs/tools/effect_pages.py`` renews both. An effect that is added needs an example here for
its picture, and a place among `rthyb_rt.diagnose.catalogue.PAIRS`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from pictures import on_paper

from rthyb_rt.core.diagnosis_models import ActuatorModel, ComputedMotion, actuator
from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.case import Model
from rthyb_rt.diagnose.catalogue import EffectEntry, entries
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.words import KINDS
from rthyb_rt.report import drawing as draw
from rthyb_rt.report.decimate import trace

DOCS = Path(__file__).resolve().parents[1]
PAGE, IMAGES = DOCS / "effects.md", DOCS / "images"
FS = 1024.0
CELLS = 160
MODEL = Model("drive", FS, 5e5, c=1500.0, moving_mass=40.0, k_tol=0.01)
ACTUATOR = ActuatorModel(0.005, 25.0, 0.8)
STEP_N = 400.0
CYCLE = slice(int(2.0 * FS), int(3.25 * FS))
"""Rows of the largest slow cycle, and a little more."""
SHORT = {"hum": slice(int(2.4 * FS), int(2.65 * FS)), "quantisation": CYCLE}
"""Rows in which an effect shows that would fill its picture along the whole motion."""
WHOLE = (
    "inertia", "second_mode", "degradation", "drift", "delay_rate", "oil_column", "maxwell",
    "rate_limit",
)  # fmt: skip
"""Effects of which one cycle does not show enough."""

EXAMPLES: dict[str, tuple[Trial, tuple[float, ...]]] = {
    "stiffness": (Trial(), (-0.15,)),
    "cubic": (Trial(), (1.2e9,)),
    "quadratic": (Trial(), (8e6,)),
    "gap": (Trial((1.5e-3,), "deadband"), (1.0,)),
    "stopper": (Trial((7e-3,), "both"), (4e5,)),
    "viscous": (Trial(), (6e3,)),
    "quad_damping": (Trial(), (7e4,)),
    "power_damping": (Trial((0.3,)), (700.0,)),
    "power_damping+maxwell": (Trial((0.3, 3e-3)), (700.0,)),
    "coulomb": (Trial((1e-3,)), (600.0,)),
    "stribeck": (Trial((0.02, 5e-4)), (300.0, 500.0)),
    "lugre": (Trial((8e-4,), "dahl"), (600.0, 0.0)),
    "gap+coulomb": (Trial((2e-3, 8e-4, 0.5), "middle"), (1200.0,)),
    "gap+coulomb+bias": (Trial((2e-3, 8e-4, 4e-4, 0.5, 1e-4), "middle"), (1.5e6,)),
    "inertia": (Trial(), (300.0,)),
    "second_mode": (Trial((4.0, 0.03)), (40.0,)),
    "hysteresis": (Trial((5e-3,), "bw2"), (0.7,)),
    "pinching": (Trial((2.5e-3,), "x"), (0.7,)),
    "degradation": (Trial((0.06,), "loop"), (0.4,)),
    "hysteresis+degradation": (Trial((2e-3, 0.5), "aimed"), (0.5, 0.4)),
    "hysteresis+pinching+degradation": (Trial((3e-3, 1.5, 0.25), "slack"), (0.7,)),
    "maxwell": (Trial((0.05,)), (1.5e5,)),
    "bias": (Trial(), (500.0,)),
    "drift": (Trial(), (150.0,)),
    "hum": (Trial((50.0,)), (200.0, 0.0)),
    "time_skew": (Trial((8e-3,)), (1.0,)),
    "crosstalk": (Trial(), (0.15,)),
    "quantisation": (Trial(), ()),
}
"""Shape and coefficients of each effect in its picture."""
CHANGES: dict[str, dict[str, Any]] = {
    "delay": {"delay_s": 0.015},
    "delay_rate": {"kappa_s2_m": 0.12},
    "act_gain": {"gain": 0.9},
    "oil_column": {"f_hz": 7.0, "zeta": 0.5},
    "rate_limit": {"vmax_m_s": 0.05},
}
"""The same of the actuator's."""
OWN_ABSCISSA = {
    "inertia": "a", "time_skew": "rate", "crosstalk": "fy", "bias": "t", "drift": "t", "hum": "t",
    "quantisation": "f", "degradation": "t", "second_mode": "t",
}  # fmt: skip
"""What shows an effect better than displacement does, in the middle of its picture."""


def command() -> ComputedMotion:
    """Return the motion of the pictures: cycles of 1 Hz that grow to 10 mm, then 3 Hz of 5 mm."""
    t = np.arange(int(6.0 * FS)) / FS
    size = _smooth(np.interp(t, [0.0, 3.2, 4.2, 6.0], [2e-3, 10e-3, 5e-3, 5e-3]))
    rate = _smooth(np.interp(t, [0.0, 3.6, 4.4, 6.0], [1.0, 1.0, 3.0, 3.0]))
    phase = 2 * np.pi * np.cumsum(rate) / FS
    x = size * np.sin(phase)
    v = np.gradient(x) * FS
    return ComputedMotion(x, v, np.gradient(v) * FS)


def _smooth(y: np.ndarray) -> np.ndarray:
    """Round off the corners, which would be jerks of the motion."""
    width = int(0.4 * FS) | 1
    window = np.hanning(width)
    padded = np.pad(y, width // 2, mode="edge")
    return np.convolve(padded, window / window.sum(), mode="valid")


def context() -> Context:
    """Return what the laws of the pictures see."""
    motion = command()
    t = np.arange(motion.x.size) / FS
    across = 3000.0 * np.sin(2 * np.pi * 0.7 * t + 1.0)
    force = MODEL.force(motion.x, motion.v, motion.a)
    return Context(MODEL, motion, t, force, {"fy_meas": across})


# ---- pictures -----------------------------------------------------------------------------------

Panel = tuple[np.ndarray, list[np.ndarray], str, str]
"""Abscissa, curves (before and after, or what is added), and the names of both axes."""


def panels_of_force(entry: EffectEntry) -> list[Panel]:
    """Return force over displacement, then what the effect adds over what shows it."""
    ctx = context()
    trial, betas = EXAMPLES[entry.name]
    if entry.name == "quantisation":
        added = STEP_N * np.round(ctx.total / STEP_N) - ctx.total
    else:
        columns = effects.catalogue()[entry.name].columns(ctx, trial)
        added = np.sum([b * c for b, c in zip(betas, columns, strict=True)], axis=0)
    over = {
        "x": (ctx.x * 1e3, "displacement, mm"),
        "a": (ctx.a, "acceleration, m/s²"),
        "rate": (np.gradient(ctx.total) * FS * 1e-3, "rate of force, kN/s"),
        "fy": (ctx.other["fy_meas"] * 1e-3, "force across, kN"),
        "f": (ctx.total * 1e-3, "force, kN"),
        "t": (ctx.t, "time, s"),
    }
    middle, name = over[OWN_ABSCISSA.get(entry.name, "x")]
    part, first = SHORT.get(entry.name, slice(None)), _first(entry)
    forces = [ctx.total[first] * 1e-3, (ctx.total + added)[first] * 1e-3]
    return [
        (ctx.x[first] * 1e3, forces, "displacement, mm", "force, kN"),
        (middle[part], [added[part]], name, "what is added, N"),
        (ctx.v[part] * 1e3, [added[part]], "velocity, mm/s", "what is added, N"),
    ]


def _first(entry: EffectEntry) -> slice:
    """Return the rows of the first panel."""
    return slice(None) if entry.name in WHOLE else CYCLE


def panels_of_actuator(entry: EffectEntry) -> list[Panel]:
    """Return displacement over command, then what the effect adds along the model's motion."""
    u = command().x
    plain = actuator(ACTUATOR, u, FS)
    added = actuator(replace(ACTUATOR, **CHANGES[entry.name]), u, FS).x - plain.x
    first = _first(entry)
    moved = [plain.x[first] * 1e3, (plain.x + added)[first] * 1e3]
    return [
        (u[first] * 1e3, moved, "command, mm", "displacement, mm"),
        (plain.x * 1e3, [added * 1e3], "displacement, mm", "what is added, mm"),
        (plain.v * 1e3, [added * 1e3], "velocity, mm/s", "what is added, mm"),
    ]


def picture(entry: EffectEntry) -> str:
    """Return the picture of an effect as SVG."""
    panels = (panels_of_actuator if entry.place == "actuator" else panels_of_force)(entry)
    with rc_context(draw.STYLE):
        figure = Figure(figsize=(7.1, 1.95))
        figure.patch.set_visible(False)
        for i, (x, curves, abscissa, ordinate) in enumerate(panels):
            axes = figure.add_axes(((0.45 + 2.42 * i) / 7.1, 0.2, 1.75 / 7.1, 0.66))
            axes.patch.set_visible(False)
            axes.grid(axis="y")
            colours = (draw.GREY, draw.BLUE) if len(curves) == 2 else (draw.BLUE,)
            for y, colour in zip(curves, colours, strict=True):
                spans = [float(np.ptp(q)) or 1.0 for q in (x, np.concatenate(curves))]
                kept = trace(x, y, spans[0], spans[1], CELLS)
                axes.plot(*kept, color=colour, linewidth=0.8)
            axes.xaxis.set_major_locator(MaxNLocator(5))
            low = min(0.0, *(float(y.min()) for y in curves))
            high = max(0.0, *(float(y.max()) for y in curves))
            margin = 0.06 * (high - low)
            draw.set_range(axes, low - margin, high + margin)
            axes.annotate(
                ordinate, (0.0, 1.0), xycoords="axes fraction", xytext=(-22, 5),
                textcoords="offset points", ha="left", va="bottom", color=draw.BLACK,
            )  # fmt: skip
            draw.x_label(axes, abscissa)
        key = f"effect-{file_name(entry.name)}"
        return on_paper(draw.to_svg(figure, key, entry.plain))


def file_name(name: str) -> str:
    """Return an effect's name as a file has it."""
    return name.replace("+", "-").replace("_", "-")


# ---- page ---------------------------------------------------------------------------------------

HEAD = """# The catalogue of effects

The effects that [`rthyb diagnose`](diagnosis.md) can name, one section each: what an effect looks
like, which experiment reveals it, and what it can be confused with. The program considers all of
them, alone and in sets of up to three; `rthyb diagnose --why` shows how much each would improve the
fit. For an effect that is not listed here, see [an effect of your
own](diagnosis.md#an-effect-of-your-own).

In every figure the specimen is a spring of 500 N/mm with a little damping and mass. It is moved
through cycles of 1 Hz that grow to 10 mm, then of 3 Hz and 5 mm. Left: force over displacement
without the effect (grey) and with it (blue), for one cycle or for all. Middle and right: the
contribution of the effect, which is the residual of a model without it. For an effect of the
actuator, the figures show displacement instead of force.

<!-- This page is written by docs/tools/effect_pages.py from the catalogue of the program. -->
"""

PLACES = {
    "specimen": "Effects of the specimen",
    "load cell": "Effects of the load cell",
    "actuator": "Effects of the actuator",
}


def heading(entry: EffectEntry) -> str:
    """Return the heading of an effect's section."""
    return f"{entry.name}: {entry.plain}"


def anchor(entry: EffectEntry) -> str:
    """Return the anchor of that heading, as web sites make it."""
    kept = "".join(c for c in heading(entry).lower() if c.isalnum() or c in "_- ")
    return kept.replace(" ", "-")


def section(entry: EffectEntry, known: dict[str, EffectEntry]) -> str:
    """Return the section of one effect."""
    kind, why = entry.shown_by
    lines = [
        f"### {heading(entry)}",
        "",
        f"![{entry.fingerprint}](images/effect-{file_name(entry.name)}.svg)",
        "",
        f"* Equation: `{entry.equation}`",
        f"* Parameters: {', '.join(f'`{p}`' for p in entry.params)}",
        f"* Fingerprint: {entry.fingerprint}.",
        f"* Shown by {KINDS.get(kind, kind)}: {why}.",
        "* Confused with:",
    ]
    for other, parts in entry.alike:
        found = known[other]
        lines.append(f"    * [{found.plain}](#{anchor(found)}): {parts}.")
    return "\n".join(lines)


def page() -> str:
    """Return the whole page."""
    known = entries()
    parts = [HEAD]
    for place, title in PLACES.items():
        parts.append(f"## {title}\n")
        parts += [section(e, known) + "\n" for e in known.values() if e.place == place]
    return "\n".join(parts)


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    for found in entries().values():
        path = IMAGES / f"effect-{file_name(found.name)}.svg"
        path.write_text(picture(found), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
