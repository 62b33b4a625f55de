"""The figures of a structure of many degrees of freedom: modes, storeys, recorded quantities."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from rthyb_rt import documents
from rthyb_rt.config.dof_units import UNKNOWN, UNKNOWN_FORCE
from rthyb_rt.config.numerical_structure import Structure
from rthyb_rt.config.own_structure import OwnStructure
from rthyb_rt.config.sparse_structure import ROTATIONS, SparseStructure
from rthyb_rt.core.own_library import Recorded
from rthyb_rt.core.rows import Channel
from rthyb_rt.core.sparse import Response
from rthyb_rt.numbers import number, percent
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import drawing as draw
from rthyb_rt.report.decimate import robust_limit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
AnyQuantity = TypeVar("AnyQuantity", bound=Response | Recorded | Channel)

SHOWN_MODES = 5
SHOWN_CURVES = 3
_UNNAMED = "other directions"
_STILL = 1e-6
"""Part of a mode shape that is rounding."""
_COLOURS = (draw.BLUE, draw.ORANGE, draw.GREEN, draw.PURPLE, draw.RED)
_UNITS = {
    "m": ("mm", 1e3),
    "N": ("kN", 1e-3),
    "rad": ("mrad", 1e3),
    "N m": ("kN m", 1e-3),
}
_WORDS = {
    "m": "displacements",
    "N": "forces",
    "rad": "rotations",
    "N m": "moments",
    UNKNOWN: "motions",
    UNKNOWN_FORCE: "loads",
}


def plates(
    rec: RecordedTest, structure: Structure | SparseStructure | OwnStructure
) -> list[draw.Plate]:
    """Return the figures of a recording's structure, in the order of the report."""
    if isinstance(structure, OwnStructure):
        return curves(rec, structure.part.responses)
    found = [modes(structure)]
    if isinstance(structure, SparseStructure):
        responses = structure.part.responses
        found += storeys(rec, responses)
        found += curves(rec, responses, every=_chosen_by_name(rec))
    return found


def modes(structure: Structure | SparseStructure) -> draw.Plate:
    """Return the shapes of the lowest modes side by side."""
    shown = structure.modes()[:SHOWN_MODES]
    grounded = isinstance(structure, SparseStructure) and bool(structure.heights_m)
    drawn = [_moving(structure, np.array(mode.shape)) for mode in shown]
    most = max(at.size for at, _ in drawn)
    heights, what = np.arange(1.0, most + 1.0), "degree of freedom, in order"
    if isinstance(structure, SparseStructure) and structure.heights_m:
        heights, what = np.array(structure.heights_m), "height, m"
    paper = draw.Paper("modes", draw.FULL_WIDTH_IN, (2.0,))
    (axes,) = paper.axes
    for i, (mode, (at, _)) in enumerate(zip(shown, drawn, strict=True)):
        shape = np.array(mode.shape)[at]
        shape /= max(1.0, np.abs(shape).max())  # its scale may be that of another direction
        x, y = (np.append(0.0, v) if grounded else v for v in (shape, heights[: at.size]))
        axes.axvline(2.5 * i, color=draw.GREY, linewidth=0.4)
        axes.plot(2.5 * i + x, y, color=_COLOURS[i], linewidth=1.0, marker="o", markersize=2.0)
    axes.set_xlim(-1.25, 2.5 * len(shown) - 1.25)
    axes.set_ylim(0.0 if grounded else 0.5, float(heights.max()) * 1.04 + 0.04)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    names = [
        f"{number(m.frequency_hz, 3)} Hz, {percent(m.damping_ratio, 2)}" + (way and f"\nin {way}")
        for m, (_, way) in zip(shown, drawn, strict=True)
    ]
    axes.set_xticks([2.5 * i for i in range(len(shown))], names)
    draw.head(axes, what)
    shares = ", ".join(_share(mode.effective_mass) for mode in shown)
    note = (
        "Frequency and damping ratio of the structure with an elastic specimen; effective modal "
        f"mass: {shares}."
    )
    if any(way for _, way in drawn):
        note += (
            " Each mode is drawn in the direction of its largest motion, which is named if it is "
            "not that of the ground motion."
        )
    return paper.plate("Mode shapes", note)


def _moving(structure: Structure | SparseStructure, shape: Floats) -> tuple[NDArray[np.intp], str]:
    """Return the degrees of freedom to draw of a mode, and what they are if not as excited.

    These are the displacements that the ground motion excites, unless others move more. Rotations
    are drawn only of a mode without displacements. Degrees of freedom whose direction is not known
    are drawn if they have more than half of the mode's kinetic energy, and then those with mass.
    """
    every = np.arange(shape.size)
    if not isinstance(structure, SparseStructure) or structure.heights_m:
        return every, ""
    excited = np.intersect1d(np.flatnonzero(structure.influence), structure.translations)
    ways = {"": excited} | {way: at for way, at in structure.along.items() if way}
    # What no label names may be rotations, which do not compare with displacements: energies do.
    mass = structure.joined.mass_kg.matrix()
    heavy = np.array([i for i in structure.along.get("", ()) if mass[i, i] > 0.0], dtype=np.intp)
    energies = shape * (mass @ shape)
    if energies[heavy].sum() > 0.5 * energies.sum():
        return heavy, _UNNAMED
    moves = {way: float(np.abs(shape[at]).max(initial=0.0)) for way, at in ways.items()}
    displacing = {way: moves[way] for way, at in ways.items() if way not in ROTATIONS}
    if max(displacing.values()) > _STILL:
        moves = displacing
    # Symmetric structures move alike in two directions: rounding does not choose between them.
    way = "" if moves[""] > 0.99 * max(moves.values()) else max(moves, key=lambda one: moves[one])
    return ways[way], way


def _chosen_by_name(rec: RecordedTest) -> bool:
    """Return whether the test file names what to record, so that nobody asked for less."""
    numerical = documents.toml_if_valid(rec.test_toml).get("numerical")
    return isinstance(numerical, dict) and numerical.get("record") is not None


def _share(mass: float) -> str:
    """Return a share of the mass in words; very small ones as a bound."""
    return percent(mass, 2) if mass >= 1e-4 else "< 0.01 %"


def storeys(rec: RecordedTest, responses: Sequence[Response]) -> list[draw.Plate]:
    """Return the recorded peaks of storey drifts and shears over the storeys."""
    found = []
    running = rec.running()
    for what, title in (("drift", "Peak storey drifts"), ("shear", "Peak storey shears")):
        numbered = [
            (int(match[1]), one)
            for one in responses
            if (match := re.fullmatch(rf"{what}_(\d+)", one.name)) and _has(rec, one)
        ]
        if len(numbered) < 3:
            continue
        unit, factor = _UNITS[numbered[0][1].unit]
        paper = draw.Paper(f"{what}s", draw.HALF_WIDTH_IN, (1.8,))
        (axes,) = paper.axes
        storey = np.array([i for i, _ in numbered])
        values = [_finite(rec.samples[one.name][running]) * factor for _, one in numbered]
        high = np.array([v.max(initial=0.0) for v in values])
        low = np.array([v.min(initial=0.0) for v in values])
        axes.barh(storey, high - low, left=low, height=0.55, color=draw.BLUE)
        axes.axvline(0.0, color=draw.GREY, linewidth=0.4)
        axes.yaxis.set_major_locator(MaxNLocator(10, integer=True))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        largest = max(float(np.abs([low, high]).max()), 1e-9)
        axes.set_xlim(-1.08 * largest, 1.08 * largest)
        draw.head(axes, "storey")
        draw.x_label(axes, f"{what}, {unit}")
        at = storey[int(np.argmax(np.maximum(high, -low)))]
        note = f"Smallest to largest value; largest {number(largest)} {unit}, in storey {at}."
        found.append(paper.plate(title, note))
    return found


def curves(
    rec: RecordedTest, responses: Sequence[Response | Recorded], *, every: bool = True
) -> list[draw.Plate]:
    """Return recorded quantities over time, the largest first, `SHOWN_CURVES` in a figure.

    Args:
        rec: the recording.
        responses: the quantities; those that it does not contain are left out.
        every: draw all; otherwise only the first figure of each unit.
    """
    found = []
    for unit, word in _WORDS.items():
        own = _by_peak(rec, [one for one in responses if one.unit == unit and _has(rec, one)])
        groups = _in_figures(own)
        for n, group in enumerate(groups if every else groups[:1], start=1):
            paper = draw.Paper(
                f"recorded-{word}" + (f"-{n}" if n > 1 else ""), draw.FULL_WIDTH_IN, (1.4,)
            )
            (axes,) = paper.axes
            _draw_curves(rec, axes, group, unit)
            draw.x_label(axes, "time, s")
            title = f"Recorded {word}"
            note = "Recorded quantities of the structure"
            if every and len(groups) > 1:
                title += f", {n} of {len(groups)}"
                note += ", the largest peaks first."
            else:
                note += _not_shown(len(own) - len(group))
            found.append(paper.plate(title, note))
    return found


def _in_figures(own: Sequence[AnyQuantity]) -> list[Sequence[AnyQuantity]]:
    """Return quantities in groups of as many as are drawn together."""
    return [own[i : i + SHOWN_CURVES] for i in range(0, len(own), SHOWN_CURVES)]


def _not_shown(others: int) -> str:
    """Return the end of the sentence on quantities that are not drawn."""
    if not others:
        return "."
    if others == 1:
        return "; 1 other, with a smaller peak, is not shown."
    return f"; {others} others, with smaller peaks, are not shown."


def chosen(rec: RecordedTest, channels: Sequence[Channel]) -> draw.Plate:
    """Return recorded channels over time in one figure, `SHOWN_CURVES` of one unit in each axes.

    Args:
        rec: the recording.
        channels: of its channels, at least one.
    """
    units = list(dict.fromkeys(one.unit for one in channels))
    panels: list[Sequence[Channel]] = []
    for unit in units:
        panels += _in_figures([one for one in channels if one.unit == unit])
    paper = draw.Paper("recorded", draw.FULL_WIDTH_IN, (1.4,) * len(panels))
    for axes, group in zip(paper.axes, panels, strict=True):
        _draw_curves(rec, axes, group, group[0].unit)
    draw.x_label(paper.axes[-1], "time, s")
    return paper.plate("Recorded quantities", "As recorded, over time.")


def _by_peak(
    rec: RecordedTest, responses: Sequence[Response | Recorded]
) -> list[Response | Recorded]:
    running = rec.running()
    peaks = [
        float(np.abs(_finite(rec.samples[one.name][running])).max(initial=0.0)) for one in responses
    ]
    return [responses[i] for i in np.argsort(peaks)[::-1]]


def _draw_curves(
    rec: RecordedTest, axes: Axes, group: Sequence[Response | Recorded | Channel], unit: str
) -> None:
    """Draw signals of one unit over time, each with its own name."""
    t = rec.time_s()
    shown_unit, factor = _UNITS.get(unit, (unit, 1.0))
    signals = [rec.samples[one.name] * factor for one in group]
    for signal, one, colour in zip(signals, group, _COLOURS, strict=False):
        draw.curve(axes, t, signal, colour, 0.8, one.name)
    draw.symmetric(axes, max(robust_limit(*signals), 1e-9))
    word = _WORDS.get(unit, "recorded")
    draw.head(axes, f"{word}, {shown_unit}" if shown_unit else word)
    if t.size:
        axes.set_xlim(*draw.span(t[0], t[-1] + 1.0 / rec.fs_hz))


def _finite(values: Floats) -> Floats:
    """Return the finite values: the channels of a skipped tick are unknown."""
    return np.asarray(values[np.isfinite(values)])


def _has(rec: RecordedTest, one: Response | Recorded) -> bool:
    return one.name in (rec.samples.dtype.names or ())
