"""A coefficient that changes with time has no name, and no laws that have one stand in for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rthyb_rt.diagnose import varying
from rthyb_rt.diagnose.policy import POLICY
from tests.test_diagnose_steady import FS, Force, fitted


def pulses(t: np.ndarray, f_hz: float) -> np.ndarray:
    """On for the first half of each period."""
    return (np.mod(t * f_hz, 1.0) < 0.5).astype(float)


@pytest.mark.parametrize(
    ("force", "names"),
    [
        (lambda t, x, v: 600.0 * v * pulses(t, 0.9), ("viscous",)),
        (lambda t, x, v: 600.0 * v * pulses(t, 0.9), ("hysteresis", "viscous")),
        (lambda t, x, v: 1.5e4 * x * np.cos(2 * np.pi * 1.7 * t), ("coulomb",)),
    ],
    ids=["a damper that is switched", "the same as two laws", "a spring loaded in a rhythm"],
)  # fmt: skip
def test_coefficient_that_changes_with_time_explains_more_than_laws_in_its_place(
    force: Force, names: tuple[str, ...]
) -> None:
    assert varying.gain(*fitted(force, *names)) > 5.0 * POLICY.same_evidence


@pytest.mark.parametrize("kind", ["sweep", "sine", "triangle"])
@pytest.mark.parametrize(
    ("force", "names"),
    [
        (lambda t, x, v: 2e3 * v, ("viscous",)),
        (lambda t, x, v: 60.0 * np.sign(v), ("coulomb",)),
        # Neither is quite a dashpot, dry friction or a spring of the third power.
        (lambda t, x, v: 2e3 * np.sign(v) * np.abs(v) ** 0.95, ("viscous",)),
        (lambda t, x, v: 60.0 * np.tanh(v / 4e-3), ("coulomb",)),
        (lambda t, x, v: 300.0 * np.sinh(x / 4e-3), ("cubic", "stiffness")),
        # They change once, which is not in a rhythm.
        (lambda t, x, v: -3e4 * x * np.minimum(t / 6.0, 1.0), ("degradation",)),
        (lambda t, x, v: 20.0 + 10.0 * t, ("bias", "drift")),
    ],
    ids=["dashpot", "dry friction", "nearly a dashpot", "nearly dry friction", "nearly cubic",
         "a spring that wears", "a cell that drifts"],
)  # fmt: skip
def test_law_of_the_catalogue_is_not_taken_for_such_a_coefficient(
    force: Force, names: tuple[str, ...], kind: str
) -> None:
    """Under a sine any law is a periodic coefficient of the displacement or the velocity."""
    assert varying.gain(*fitted(force, *names, kind=kind)) < POLICY.same_evidence


def test_long_recording_is_not_searched_by_lines_too_far_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a sine of 1.5 Hz: half a line apart, up to three times twice its frequency."""
    problem, fit = fitted(lambda t, x, v: 600.0 * v * pulses(t, 0.9), "viscous", kind="sine")
    lines = varying._lines(problem)
    assert lines[0] == pytest.approx(0.5 * FS / problem.ctx.t.size, rel=0.05)
    assert lines[-1] == pytest.approx(9.0, rel=0.05)
    assert varying.gain(problem, fit) > -np.inf
    monkeypatch.setattr(varying, "VALUES", 2 * problem.ctx.t.size * (varying.FEWEST - 1))
    assert varying.gain(problem, fit) == -np.inf


def test_nothing_that_is_named_is_held_against_nothing() -> None:
    problem, fit = fitted(lambda t, x, v: 2e3 * v, "viscous")
    assert varying.gain(problem, replace(fit, members=(), betas=())) == -np.inf
