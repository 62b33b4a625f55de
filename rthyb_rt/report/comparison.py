"""The figure of recordings beside one another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib import rc_context
from numpy.typing import NDArray

from rthyb_rt.numbers import count, quantity
from rthyb_rt.report import drawing as draw
from rthyb_rt.report.decimate import robust_limit

_COLOURS: Final = (draw.BLACK, draw.BLUE, draw.RED, draw.GREEN, draw.ORANGE, draw.PURPLE)
MOST: Final = len(_COLOURS)
"""Curves that can be told apart."""


def draw_comparison(
    labels: Sequence[str], motions_mm: Sequence[NDArray[np.float64]], fs_hz: float
) -> draw.Plate:
    """Draw motions over one another, and below how each differs from the first.

    Args:
        labels: of the recordings.
        motions_mm: measured displacement of each, mm, from the first sample of the test proper.
        fs_hz: rate of all of them.
    """
    with rc_context(draw.STYLE), np.errstate(over="ignore", invalid="ignore"):
        paper = draw.Paper("compare", draw.FULL_WIDTH_IN, (1.6, 0.9))
        axes, below = paper.axes
        first = motions_mm[0]
        gaps = []
        for number, (label, motion) in enumerate(zip(labels, motions_mm, strict=True)):
            if number == MOST:
                break
            t = np.arange(motion.size) / fs_hz
            draw.curve(axes, t, motion, _COLOURS[number], 0.5 if number == 0 else 0.9, label)
            shared = min(first.size, motion.size)
            if number:
                gaps.append(motion[:shared] - first[:shared])
                draw.curve(below, t[:shared], gaps[-1], _COLOURS[number], 0.7)
        draw.symmetric(axes, max(robust_limit(*motions_mm[:MOST]), 1e-3))
        draw.symmetric(below, max(robust_limit(*gaps), 1e-6), ticks=3)
        draw.head(axes, "measured displacement, mm")
        draw.head(below, "less the first, mm")
        last = max(motion.size for motion in motions_mm[:MOST]) / fs_hz
        below.set_xlim(*draw.span(0.0, last))
        draw.x_label(below, "time, s")
        largest = max(draw.largest(gap) for gap in gaps)
        note = f"Largest difference from the first {quantity(largest, 'mm')}."
        if len(motions_mm) > MOST:
            note += f" The first {MOST} of {count(len(motions_mm), 'recording')} are drawn."
        return paper.plate("Measured displacement beside the first recording", note)
