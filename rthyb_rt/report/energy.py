"""The figure of the energy balance."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context

from rthyb_rt.analysis import balance as of
from rthyb_rt.analysis.summary import Summary
from rthyb_rt.numbers import percent, quantity
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import drawing as draw
from rthyb_rt.report.decimate import robust_limit

TITLE = "Energy balance"


def balance(rec: RecordedTest, summary: Summary) -> draw.Plate:
    """Draw how the input energy is stored and dissipated, as stacked layers."""
    found = of.of_recording(rec, summary.setup)
    if found is None:
        why = (
            "Mass, damping and stiffness of the whole structure are not in the recording, or do "
            "not belong to what it shows."
        )
        return draw.Plate("balance", TITLE, "", why, False)
    return drawn(found)


def drawn(found: of.EnergyBalance) -> draw.Plate:
    """Draw a balance as stacked layers."""
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        paper = draw.Paper("balance", draw.FULL_WIDTH_IN, (1.6,), bottom_in=draw.LEGEND_IN)
        (axes,) = paper.axes
        layers = (
            ("damping", found.damping_j, draw.GREEN),
            ("specimen", found.specimen_j, draw.ORANGE),
            ("elements", found.elements_j, draw.GREY),
            ("strain", found.strain_j, draw.PURPLE),
            ("kinetic", found.kinetic_j, draw.BLUE),
        )
        limit = max(robust_limit(found.input_j, found.input_j + found.fed_j), 1e-9)
        # All layers are thinned at the same rows, so that they remain stacked.
        columns = int(60.0 * draw.FULL_WIDTH_IN)
        rows = np.unique(
            np.linspace(0, found.t_s.size - 1, min(found.t_s.size, columns)).astype(int)
        )
        foot = np.zeros(rows.size)
        t = found.t_s[rows]
        for label, energy, colour in layers:
            if not energy.any():
                continue
            top = foot + draw.clip(np.nan_to_num(energy[rows]), 5.0 * limit)
            axes.fill_between(t, foot, top, facecolor=colour, alpha=0.55, linewidth=0, label=label)
            foot = top
        draw.curve(axes, found.t_s, found.input_j, draw.BLACK, 0.9, "input")
        draw.curve(axes, found.t_s, found.input_j + found.fed_j, draw.RED, 0.7,
                   "input and tracking error", (4.0, 1.5))  # fmt: skip
        low = min(0.0, float(np.min(foot, initial=0.0)))
        draw.set_range(axes, max(1.06 * low, -1.06 * limit), 1.12 * limit)
        draw.head(axes, "J", below=True)
        axes.set_xlim(*draw.span(found.t_s[0], found.t_s[-1]))
        draw.x_label(axes, "time, s")
        fed = quantity(float(found.fed_j[-1]), "J")
        within = ", by its nonlinear elements" if found.elements_j.any() else ""
        note = (
            f"Energy dissipated by damping of the numerical part{within} and by the specimen, and "
            "stored as strain and kinetic energy; together the layers equal the input. The "
            f"tracking error added {fed} in total; at most {percent(found.gap)} is unexplained."
        )
        return paper.plate(TITLE, note)
