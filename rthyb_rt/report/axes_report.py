"""The report of a test on a rig with several axes, with the axes and directions by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import several_axes
from rthyb_rt.analysis.several_axes import NOT_COMPUTED, AxesSummary, OfDirection
from rthyb_rt.numbers import percent
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report.html import environment, extra_needed, sheets

if TYPE_CHECKING:
    from rthyb_rt.report.drawing import Plate

Floats = NDArray[np.float64]

NO_REFERENCE: Final = "There is no reference simulation for the rows of this recording."


def render(rec: RecordedTest) -> str:
    """Return the report of a recording with several axes as HTML.

    Raises:
        InputError: matplotlib or jinja2 is not installed, or the test never ran.
    """
    summary = several_axes.summarize(rec)
    found = several_axes.notices(summary)
    with extra_needed("a report"):
        plates = draw_all(rec, summary)
        engine = environment()
    return engine.get_template("several.html.j2").render(
        s=summary,
        title=summary.test_name or "Hybrid test",
        verdict=several_axes.verdict(summary),
        alarms=[notice for notice in found if notice.level == "alarm"],
        notes=[notice for notice in found if notice.level == "note"],
        rows=several_axes.table(summary),
        not_computed=NOT_COMPUTED,
        figures_of=sheets(plates),
        settings=[("Test file", rec.test_toml), ("Rig file", rec.rig_toml)],
        versions=", ".join(
            str(rec.meta[key]) for key in ("rthyb_version", "created_utc") if key in rec.meta
        ),
    )


def draw_all(rec: RecordedTest, s: AxesSummary) -> list[Plate]:
    """Return the figures of every direction and every axis, and the total energy."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw
    from rthyb_rt.report import extra_figures
    from rthyb_rt.report import structure as of_structure

    plates = []
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        for j, one in enumerate(s.directions):
            plates += [_displacement(s, j, one), _error(s, j, one)]
        for i, axis in enumerate(s.axes):
            plates += [_command(s, i), _tracking(s, i), _loop(s, i)]
            plates[-2] = _titled(plates[-2], axis.tracking_nrmse)
        plates += [
            balance(rec, s),
            *extra_figures.plates(rec),
            *of_structure.plates(rec, s.structure),
        ]
    return plates


def draw_balance(rec: RecordedTest, s: AxesSummary | None) -> Plate:
    """Draw the figure `balance` alone, as in the report."""
    from matplotlib import rc_context

    from rthyb_rt.report import drawing as draw

    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        return balance(rec, s)


def balance(rec: RecordedTest, s: AxesSummary | None) -> Plate:
    """Draw the energy balance of all directions together.

    Args:
        rec: the recording.
        s: its summary; None if the test never ran.
    """
    from rthyb_rt.analysis import structure_balance
    from rthyb_rt.report import drawing as draw
    from rthyb_rt.report import energy

    found = None if s is None else structure_balance.of_axes(rec, s.structure)
    if found is None:
        why = (
            "The test proper is too short, or does not begin where the structure is at rest, or "
            "the numerical part is your own, whose energies are not known."
        )
        return draw.Plate("balance", energy.TITLE, "", why, False)
    return energy.drawn(found)


def _titled(plate: Plate, nrmse: float) -> Plate:
    from dataclasses import replace

    return replace(plate, note=f"{plate.note} NRMSE {percent(nrmse)}.")


def _displacement(s: AxesSummary, j: int, one: OfDirection) -> Plate:
    from rthyb_rt.report import drawing as draw

    paper = draw.Paper(f"direction-{j}", draw.FULL_WIDTH_IN, (1.6,))
    (axes,) = paper.axes
    t, unit = s.signals.time_s, "mrad" if one.turns else "mm"
    measured, limit = s.signals.x_meas[:, j] * 1e3, 1e-3
    note = f"Measurement along the interface. {NO_REFERENCE}"
    if s.signals.reference is not None:
        expected = s.signals.reference.x[:, j] * 1e3
        limit = max(draw.largest(expected), limit)
        draw.curve(axes, t, expected, draw.GREY, 1.6, "reference")
        largest = several_axes.size_of(one.response_peak, one.turns)
        note = (
            "Measurement along the interface, and reference simulation; largest difference "
            f"{largest}."
        )
    draw.curve(axes, t, measured, draw.BLUE, 0.8, "measured")
    draw.symmetric(axes, max(draw.largest(measured), limit))
    axes.set_xlim(*draw.span(0.0, float(t[-1])))
    draw.head(axes, f"{one.name}, {unit}")
    draw.x_label(axes, "time, s")
    return paper.plate(f"Direction {one.name}", note)


def _error(s: AxesSummary, j: int, one: OfDirection) -> Plate:
    from rthyb_rt.report import drawing as draw

    key, title = f"difference-{j}", f"Difference of {one.name}"
    if s.signals.reference is None:
        return draw.Plate(key, title, "", NO_REFERENCE, False)
    paper = draw.Paper(key, draw.FULL_WIDTH_IN, (1.0,))
    (axes,) = paper.axes
    t = s.signals.time_s
    apart = (s.signals.x_meas[:, j] - s.signals.reference.x[:, j]) * 1e3
    draw.curve(axes, t, apart, draw.RED, 0.7, "measured − reference")
    draw.symmetric(axes, max(draw.largest(apart), 1e-6))
    axes.set_xlim(*draw.span(0.0, float(t[-1])))
    draw.head(axes, f"difference of {one.name}, {'mrad' if one.turns else 'mm'}")
    draw.x_label(axes, "time, s")
    return paper.plate(title, f"NRMSE {percent(one.response_nrmse)} of the reference.")


def _command(s: AxesSummary, i: int) -> Plate:
    from rthyb_rt.report import drawing as draw

    name = s.axes[i].name
    paper = draw.Paper(f"axis-{i}", draw.FULL_WIDTH_IN, (1.6,))
    (axes,) = paper.axes
    t = s.signals.time_s
    command, measured = s.signals.command_m[:, i] * 1e3, s.signals.measured_m[:, i] * 1e3
    draw.curve(axes, t, command, draw.ORANGE, 0.8, "compensated command")
    draw.curve(axes, t, measured, draw.BLUE, 0.8, "measured")
    draw.symmetric(axes, max(draw.largest(command), draw.largest(measured), 1e-3))
    axes.set_xlim(*draw.span(0.0, float(t[-1])))
    draw.head(axes, f"axis {name}, mm")
    draw.x_label(axes, "time, s")
    return paper.plate(f"Axis {name}", "Compensated command, and measured displacement.")


def _tracking(s: AxesSummary, i: int) -> Plate:
    from rthyb_rt.report import drawing as draw

    name = s.axes[i].name
    paper = draw.Paper(f"tracking-{i}", draw.HALF_WIDTH_IN, (1.9,))
    (axes,) = paper.axes
    wanted, measured = s.signals.wanted_m[:, i] * 1e3, s.signals.measured_m[:, i] * 1e3
    limit = max(draw.largest(wanted), draw.largest(measured), 1e-3)
    draw.loop(axes, wanted, measured, draw.BLUE, 0.6, x_limit=limit, y_limit=limit)
    draw.symmetric(axes, limit)
    axes.set_xlim(-1.06 * limit, 1.06 * limit)
    draw.head(axes, "measured, mm")
    draw.x_label(axes, "command, mm")
    return paper.plate(
        f"Tracking of axis {name}",
        "Measured displacement over the command of the numerical part for this axis.",
    )


def _loop(s: AxesSummary, i: int) -> Plate:
    from rthyb_rt.report import drawing as draw

    name = s.axes[i].name
    paper = draw.Paper(f"force-{i}", draw.HALF_WIDTH_IN, (1.9,))
    (axes,) = paper.axes
    x, f = s.signals.measured_m[:, i] * 1e3, s.signals.force_n[:, i] * 1e-3
    limit, most = max(draw.largest(x), 1e-3), max(draw.largest(f), 1e-6)
    draw.loop(axes, x, f, draw.BLUE, 0.6, x_limit=limit, y_limit=most)
    draw.symmetric(axes, most)
    axes.set_xlim(-1.06 * limit, 1.06 * limit)
    draw.head(axes, "force, kN")
    draw.x_label(axes, "displacement, mm")
    return paper.plate(
        f"Force on axis {name}",
        "This is not a single line if the other axes move as well, because they are coupled.",
    )
