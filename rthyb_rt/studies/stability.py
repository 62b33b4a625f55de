"""Fig. 2.1: for which weightings W1, W2 the phase-lead compensator is stable."""

from __future__ import annotations

import numpy as np

from rthyb_rt import core
from rthyb_rt.studies.results import Colour, Curve, Floats, Panel, Study, StudyRow, grouped

GRID = 641
SPAN = 8.0
ALPHA = 17.0

LEADS = {"β = 0, Eqn 2.5": 0.0, "β = α²/2": 0.5 * ALPHA**2}
"""Compensators at alpha = 17, as printed and with the curvature term."""


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
    clear = np.abs(radius - 1.0) > 1e-9  # exactly on the boundary, rounding decides
    disagree = int(np.count_nonzero(clear & (decided != (radius < 1.0))))
    rows = [
        StudyRow("Grid points where decision and root finding differ", disagree, "", 0, 0),
        StudyRow("Largest pole radius at W1 = 3, W2 = 2",
            float(largest_pole(np.array(3.0), np.array(2.0))), "", 0.5773, 0.5775,
            "“always within a unit circle”"),
    ]  # fmt: skip
    return Study(
        "2.1",
        "Stability of the phase-lead compensator",
        "Poles of Eqn 2.5 inside the unit circle: exactly |W1| > 1 and |W2| < |W1 + 1|. The "
        f"decision of the core is compared with the roots on a grid of {GRID} × {GRID} points.",
        tuple(grouped("Stable regions", rows) + _gain_rows()),
        (_regions(), _amplitude()),
        (
            "Eqn 2.5 is the exact inverse of a first-order lag. Behind a pure delay, for which the "
            "paper uses it, the amplitude grows with frequency; whether that is negligible depends "
            "on the structure. The curvature term β of the controller alpha-beta removes most of "
            "it, but amplifies noise more.",
        ),
    )


def _gain_rows() -> list[StudyRow]:
    """Return the gains with and without the curvature term."""
    expected = {"β = 0, Eqn 2.5": (35.0, 103.0), "β = α²/2": (324.0, 1837.0)}
    amplitudes = {1.0: 1.0053, 2.0: 1.0211, 5.0: 1.1255, 10.0: 1.4383}
    rows: list[StudyRow] = []
    for case, beta in LEADS.items():
        first, nyquist = expected[case]
        gains = [
            StudyRow("First-sample gain", float(core.Plc().run(np.array([1.0]), ALPHA, beta)[0]),
                "", first - 0.01, first + 0.01),
            StudyRow("Gain at the Nyquist frequency", _gain(beta, core.FS_HZ / 2), "",
                nyquist - 0.01, nyquist + 0.01),
        ]  # fmt: skip
        for frequency, amplitude in amplitudes.items():
            banded = beta == 0.0
            gains.append(
                StudyRow(f"Amplitude behind a delay of 17 samples, {frequency:g} Hz",
                    _gain(beta, frequency), "", amplitude - 1e-3 if banded else None,
                    amplitude + 1e-3 if banded else None, "“small but negligible” error")
            )  # fmt: skip
        rows += grouped("Gain of the compensator at α = 17, W1 = 3, W2 = 2", gains, case)
    return rows


def _gain(beta: float, frequency_hz: float) -> float:
    """|C| at one frequency from the core's impulse response; a delay does not change it."""
    impulse = np.zeros(512)
    impulse[0] = 1.0
    response = core.Plc().run(impulse, ALPHA, beta)
    turn = np.exp(-2j * np.pi * frequency_hz / core.FS_HZ * np.arange(impulse.size))
    return float(abs(np.sum(response * turn)))


def _regions() -> Panel:
    def wedge(w1: Floats, edge: Floats) -> tuple[Floats, Floats]:
        return np.concatenate([w1, w1[::-1], w1[:1]]), np.concatenate([edge, -edge[::-1], edge[:1]])

    right, left = np.array([1.0, SPAN]), np.array([-SPAN, -1.0])
    return Panel(
        "fig-2-1", "Stable regions of W1 and W2 (Fig. 2.1)", "W1", "W2",
        (
            Curve("W1 > 1", *wedge(right, right + 1.0), "blue", filled=True),
            Curve("W1 < −1", *wedge(left, -(left + 1.0)), "green", filled=True),
            Curve("W1 = 3, W2 = 2", np.array([2.7, 3.3, np.nan, 3.0, 3.0]),
                  np.array([2.0, 2.0, np.nan, 1.7, 2.3]), "red", width=1.4),
        ),
        "Stable where shaded: |W2| < |W1 + 1| and |W1| > 1.", half=True,
        x_range=(-SPAN, SPAN), y_range=(-SPAN - 1, SPAN + 1),
    )  # fmt: skip


def _amplitude() -> Panel:
    frequencies = np.arange(0.25, 20.01, 0.25)
    colours: tuple[Colour, ...] = ("blue", "orange")
    curves = [
        Curve(name, frequencies, np.array([_gain(beta, f) for f in frequencies]), colour)
        for (name, beta), colour in zip(LEADS.items(), colours, strict=True)
    ]
    return Panel(
        "plc-amplitude", "Amplitude of compensator and delay", "frequency, Hz", "|C z⁻¹⁷|",
        tuple(curves), "1 would be perfect; structures move below a few hertz.", half=True,
        y_range=(0.8, 2.2), levels=((1.0, ""),),
    )  # fmt: skip
