"""Readings in which a force jumps may be wrong by half of the jump, and no others."""

from __future__ import annotations

import numpy as np
import pytest
from diagnose_cases import F_STD, FS, C, K, M

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects, instants
from rthyb_rt.diagnose.case import Model
from rthyb_rt.diagnose.effects.base import SWITCH_S, Trial
from rthyb_rt.diagnose.onset import Late
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.diagnose.refinement import refine
from tests.test_diagnose_steady import along, fitted

BEGIN_S = 2.2


def friction(_: np.ndarray, __: np.ndarray, v: np.ndarray) -> np.ndarray:
    return 60.0 * np.sign(v)


def begun(smooth: bool) -> tuple[ResidualProblem, Fit]:
    """A spring that begins in mid-test, fitted as one that begins smoothly."""

    def force(t: np.ndarray, x: np.ndarray, _: np.ndarray) -> np.ndarray:
        switch = 0.5 * (1.0 + np.tanh((t - BEGIN_S) / SWITCH_S)) if smooth else t >= BEGIN_S
        return 3e4 * x * switch

    problem, _ = fitted(force, "viscous")
    late = Late(effects.catalogue()["stiffness"])
    fit = refine(problem, [Member(late, Trial((BEGIN_S,)))])
    assert fit is not None
    return problem, fit


def test_wrong_readings_at_reversals_are_left_out_and_others_are_not() -> None:
    problem, fit = fitted(friction, "coulomb")
    v = problem.ctx.v
    before = np.flatnonzero(v[:-1] * v[1:] < 0.0)
    noise = np.random.default_rng(5).normal(0.0, problem.case.model.f_std or 0.0, v.size)
    rest = noise.copy()
    rest[before] += 50.0
    found = instants.without_readings(problem, fit, rest)
    assert np.abs(found[before]).max() < 0.3 * np.abs(rest[before]).max()
    # As much elsewhere is something that the friction does not explain.
    middle = (before[:-1] + before[1:]) // 2
    rest = noise.copy()
    rest[middle] += 50.0
    found = instants.without_readings(problem, fit, rest)
    assert found[middle] == pytest.approx(rest[middle])


def test_jump_limits_by_how_much_a_reading_may_be_wrong() -> None:
    problem, fit = fitted(friction, "coulomb")
    before = np.flatnonzero(problem.ctx.v[:-1] * problem.ctx.v[1:] < 0.0)
    noise = (problem.case.model.f_std or 0.0) * np.ones(problem.ctx.t.size)
    design, prior = instants.with_readings(
        problem, fit, np.zeros((problem.y.size, 0)), np.zeros((0, 0))
    )
    assert design.shape[1] == prior.shape[0] >= 2 * before.size
    # One standard deviation of each is half of the jump, 60 N, in units of the noise.
    assert design[before, :].max() == pytest.approx(60.0 / noise[0], rel=0.02)
    assert np.array_equal(prior, np.eye(prior.shape[0]))


def test_law_that_begins_at_once_leaves_only_readings_beside_its_beginning() -> None:
    problem, fit = begun(smooth=False)
    t, x = problem.ctx.t, problem.ctx.x
    smooth = 0.5 * (1.0 + np.tanh((t - BEGIN_S) / SWITCH_S))
    rest = 3e4 * x * ((t >= BEGIN_S) - smooth)
    found = instants.without_readings(problem, fit, rest)
    at = int(np.argmax(np.abs(rest)))
    assert abs(found[at]) < 0.3 * abs(rest[at])
    # A quarter of a second later the same readings are none of these.
    later = np.roll(rest, FS // 4)
    assert instants.without_readings(problem, fit, later) == pytest.approx(later)


def test_law_that_begins_smoothly_loses_nothing() -> None:
    problem, fit = begun(smooth=True)
    rest = np.zeros(problem.ctx.t.size)
    assert np.array_equal(instants.without_readings(problem, fit, rest), rest)


def test_smooth_force_has_no_such_readings() -> None:
    problem, fit = fitted(lambda t, x, v: 4e10 * x**3, "cubic")
    rest = np.random.default_rng(2).normal(0.0, 1e4, problem.ctx.t.size)
    assert np.array_equal(instants.without_readings(problem, fit, rest), rest)


def test_reversals_in_every_tenth_row_leave_a_residual_as_it_is() -> None:
    """So many readings left open would pass for less noise than there is."""
    t = np.arange(2048) / FS
    omega = 2.0 * np.pi * FS / 20.0
    motion = ComputedMotion(
        1e-3 * np.sin(omega * t + 0.1),
        1e-3 * omega * np.cos(omega * t + 0.1),
        -1e-3 * omega**2 * np.sin(omega * t + 0.1),
    )
    model = Model("drive", FS, k=K, c=C, moving_mass=M, k_tol=0.01, c_tol=0.15, f_std=F_STD)
    force = K * motion.x + C * motion.v + M * motion.a + friction(t, motion.x, motion.v)
    problem = along(model, t, motion, force)
    fit = refine(problem, [Member(effects.catalogue()["coulomb"], Trial((), "sharp"))])
    assert fit is not None
    rest = np.random.default_rng(2).normal(0.0, 100.0, t.size)
    assert np.array_equal(instants.without_readings(problem, fit, rest), rest)


def test_set_without_laws_has_no_such_readings() -> None:
    problem, fit = fitted(lambda t, x, v: 20.0 + 0.0 * t, "bias")
    rest = np.arange(problem.ctx.t.size, dtype=float)
    assert np.array_equal(instants.without_readings(problem, fit, rest), rest)


@pytest.mark.parametrize("rows_a_cycle", [2.7, 3.3, 5.0, 9.99, 12.0, 40.0])
def test_no_reading_of_a_sine_is_a_jump_at_any_number_of_rows_a_cycle(rows_a_cycle: float) -> None:
    t = np.arange(2048) / FS
    omega = 2.0 * np.pi * FS / rows_a_cycle
    wave = np.exp(1j * omega * t)
    motion = ComputedMotion(
        *(1e-3 * np.imag(part) for part in (wave, 1j * omega * wave, -(omega**2) * wave))
    )
    model = Model("drive", FS, k=K, c=C, moving_mass=M, k_tol=0.01, c_tol=0.15, f_std=F_STD)
    force = K * motion.x + C * motion.v + M * motion.a + 1e6 * motion.x
    problem = along(model, t, motion, force)
    fit = refine(problem, [Member(effects.catalogue()["stiffness"], Trial())])
    assert fit is not None
    assert not instants._wrong(problem, fit, instants.ISOLATED).any()
    assert instants._wrong(problem, fit).any()
