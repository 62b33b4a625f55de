"""Tests that end at rest, or pause: there friction may have any force up to its level."""

from __future__ import annotations

from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from diagnose_answers import diagnosed, found

PEAK_N, LEVEL_N, FALL_M_S, ZERO_N = 900.0, 500.0, 0.015, 300.0


def held(v: np.ndarray) -> np.ndarray:
    """Return the sign of velocity; a body at rest keeps that of its last motion."""
    sign = np.sign(np.where(np.abs(v) > 1e-4 * np.abs(v).max(), v, 0.0))
    moved = np.maximum.accumulate(np.where(sign != 0.0, np.arange(v.size), 0))
    return np.asarray(sign[moved])


@pytest.mark.parametrize("seed", [1, 2])
def test_friction_that_holds_a_specimen_at_the_end_is_no_other_law(
    seed: int, tmp_path: Path
) -> None:
    """The simulated motion decays there for ever, and its velocity changes sign as it does."""
    random = np.random.default_rng(seed)
    u = cases.command("triangle", seconds=8.0)
    u = np.concatenate([np.zeros(64), u - u[0], np.full(256, u[-1] - u[0])])
    x, v, a = cases.moved(u)
    t = np.arange(u.size) / cases.FS
    friction = LEVEL_N + (PEAK_N - LEVEL_N) * np.exp(-((v / FALL_M_S) ** 2))
    f = cases.K * x + cases.C * v + cases.M * a + held(v) * friction + ZERO_N
    columns = {
        "t": t,
        "x_cmd": u,
        "x_meas": x + cases.X_STD * random.standard_normal(t.size),
        "f_meas": f + cases.F_STD * random.standard_normal(t.size),
    }
    d = diagnosed(tmp_path, columns, cases.baseline())
    assert (d.verdict, sorted(d.effects)) == ("explained", ["bias", "stribeck"])
    assert found(d, "stribeck", "Fs_N") == pytest.approx(PEAK_N, rel=0.05)
    assert found(d, "bias", "bias_N") == pytest.approx(ZERO_N, rel=0.05)


def paused(pulse_n: float, tmp_path: Path):
    """Diagnose dry friction of 600 N in a test with a pause, with a force on the cell in it."""
    random = np.random.default_rng(4)
    u = cases.command("triangle", seconds=6.0)
    u = np.concatenate([u - u[0], np.full(768, u[-1] - u[0]), u - u[0] + u[-1] - u[0]])
    x, v, a = cases.moved(u)
    t = np.arange(u.size) / cases.FS
    f = cases.K * x + cases.C * v + cases.M * a + 600.0 * held(v)
    f += pulse_n * ((t > 6.4) & (t < 8.6))
    columns = {
        "t": t,
        "x_cmd": u,
        "x_meas": x + cases.X_STD * random.standard_normal(t.size),
        "f_meas": f + cases.F_STD * random.standard_normal(t.size),
    }
    return diagnosed(tmp_path, columns, cases.baseline())


def test_friction_that_holds_a_specimen_in_a_pause_is_dry_friction(tmp_path: Path) -> None:
    d = paused(0.0, tmp_path)
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert found(d, "coulomb", "Fc_N") == pytest.approx(600.0, rel=0.02)


def test_a_force_in_a_pause_that_friction_cannot_hold_is_not_overlooked(tmp_path: Path) -> None:
    d = paused(1500.0, tmp_path)
    assert d.effects != ["coulomb"]
