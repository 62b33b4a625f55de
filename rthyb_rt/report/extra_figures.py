"""The figures of a rig's extra channels, and of its sensors without an actuator."""

from __future__ import annotations

import numpy as np

from rthyb_rt.numbers import number
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import drawing as draw
from rthyb_rt.report.decimate import robust_limit


def plates(rec: RecordedTest) -> list[draw.Plate]:
    """Return a figure of each such channel over time."""
    found = []
    t, running = rec.time_s(), rec.running()
    kinds = [("Extra channel", "as measured: no offset was subtracted.", one)
             for one in rec.extras()]  # fmt: skip
    kinds += [("Sensor", "after the tare; without a reading as predicted.", one)
              for one in rec.lone_sensors()]  # fmt: skip
    for kind, how, channel in kinds:
        values = rec.channel(channel.name)
        paper = draw.Paper(f"extra-{channel.name}", draw.FULL_WIDTH_IN, (1.0,))
        (axes,) = paper.axes
        draw.curve(axes, t, values, draw.GREEN, 0.8)
        draw.symmetric(axes, max(robust_limit(values), 1e-12))
        draw.head(axes, f"{channel.name}, {channel.unit}" if channel.unit else channel.name)
        if t.size:
            axes.set_xlim(*draw.span(t[0], t[-1] + 1.0 / rec.fs_hz))
        draw.x_label(axes, "time, s")
        own = values[running & np.isfinite(values)]
        note = "No reading during the test."
        if own.size:
            note = (
                f"From {number(float(own.min()))} to {number(float(own.max()))} {channel.unit} in "
                f"the test, {how}"
            )
        found.append(paper.plate(f"{kind} {channel.name}", note))
    return found
