"""Fig. 2.1: for which weightings W1, W2 the phase-lead compensator is stable."""

from __future__ import annotations

import numpy as np

from rthyb_rt import core
from rthyb_rt.studies.results import Curve, Panel, Row, Study

GRID = 641
SPAN = 8.0


def largest_pole(w1: np.ndarray, w2: np.ndarray) -> np.ndarray:
    """Return the largest pole radius of Eqn 2.5: roots of W1 z^2 + W2 z + 1, any shape."""
    root = np.sqrt((w2 * w2 - 4.0 * w1).astype(complex))
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-w2 + root) / (2.0 * w1), (-w2 - root) / (2.0 * w1)
        return np.asarray(np.maximum(np.abs(first), np.abs(second)))


def study() -> Study:
    """Compare the core's decision with root finding on a grid, and frequency values of C(z)."""
    axis = np.linspace(-SPAN, SPAN, GRID)
    w1, w2 = np.meshgrid(axis, axis, indexing="ij")
    decided = np.array(
        [[core.plc_is_stable(float(a), float(b)) for b in axis] for a in axis], dtype=bool
    )
    radius = largest_pole(w1, w2)
    clear = np.abs(radius - 1.0) > 1e-9  # on the border itself rounding decides
    disagree = int(np.count_nonzero(clear & (decided != (radius < 1.0))))
    rows = [
        Row("Grid points where decision and root finding differ", disagree, "", 0, 0),
        Row("Pole radius at W1 = 3, W2 = 2", float(largest_pole(np.array(3.0), np.array(2.0))),
            "", 0.5773, 0.5775),
        Row("First-sample gain at α = 17", _step_gain(17.0, 0.0), "", 34.999, 35.001),
        Row("Gain at the Nyquist frequency, α = 17", _gain(17.0, 0.0, 512.0), "", 102.99, 103.01),
        Row("The same with β = α²/2: first sample", _step_gain(17.0, 144.5), "", 323.9, 324.1),
        Row("The same with β = α²/2: Nyquist", _gain(17.0, 144.5, 512.0), "", 1836.9, 1837.1),
    ]  # fmt: skip
    for frequency, expected in ((1.0, 1.0053), (2.0, 1.0211), (5.0, 1.1255), (10.0, 1.4383)):
        rows.append(
            Row(f"|C z^-17| at {frequency:g} Hz, α = 17", _gain(17.0, 0.0, frequency), "",
                expected - 1e-3, expected + 1e-3, "amplitude error small but negligible")
        )  # fmt: skip
    right = np.array([1.0, SPAN])
    left = np.array([-SPAN, -1.0])
    curves = (
        Curve("|W2| < |W1 + 1|, W1 > 1", np.concatenate([right, right[::-1], right[:1]]),
              np.concatenate([right + 1, -(right[::-1] + 1), [2.0]]), "blue"),
        Curve("|W2| < |W1 + 1|, W1 < −1", np.concatenate([left, left[::-1], left[:1]]),
              np.concatenate([-(left + 1), left[::-1] + 1, [SPAN - 1]]), "green"),
        Curve("W1 = 3, W2 = 2", np.array([2.9, 3.1, np.nan, 3.0, 3.0]),
              np.array([2.0, 2.0, np.nan, 1.9, 2.1]), "red", width=1.6),
    )  # fmt: skip
    panel = Panel(
        "fig-2-1", "Stable regions of W1 and W2 (Fig. 2.1)", "W1", "W2", curves,
        "The compensator is stable inside either wedge.", half=True,
        x_range=(-SPAN, SPAN), y_range=(-SPAN - 1, SPAN + 1),
    )  # fmt: skip
    return Study(
        "2.1",
        "Stability of the phase-lead compensator",
        "Poles of Eqn 2.5 inside the unit circle: exactly |W1| > 1 and |W2| < |W1 + 1|. The "
        f"decision of the core is compared with the roots on a grid of {GRID} × {GRID} points.",
        tuple(rows),
        (panel,),
    )


def _gain(alpha: float, beta: float, frequency_hz: float) -> float:
    """|C| at one frequency from the core's impulse response."""
    impulse = np.zeros(512)
    impulse[0] = 1.0
    response = core.Plc().run(impulse, alpha, beta)
    turn = np.exp(-2j * np.pi * frequency_hz / core.FS_HZ * np.arange(impulse.size))
    return float(abs(np.sum(response * turn)))


def _step_gain(alpha: float, beta: float) -> float:
    return float(core.Plc().run(np.array([1.0]), alpha, beta)[0])
