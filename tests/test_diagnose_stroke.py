"""A mass on a spring that softens is no second mode, and no second law beside one."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from diagnose_cases import FS, command, moved
from scipy.integrate import solve_ivp

from rthyb_rt.diagnose import effects, stroke
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, ResidualProblem
from rthyb_rt.diagnose.steady import left
from tests.test_diagnose_steady import fitted

MASS_KG, F_HZ, ZETA, SOFTER = 12.0, 2.2, 0.02, 20.0


@cache
def riding(per_m2: float) -> np.ndarray:
    """Force of a mass that rides on the specimen; its spring softens, a part per m^2 of stroke."""
    a, t = moved(command())[2], np.arange(moved(command())[2].size) / FS
    omega = 2.0 * np.pi * F_HZ

    def pull(y: np.ndarray, u: np.ndarray) -> np.ndarray:
        return -(omega**2) * y * (1.0 - per_m2 * y**2) - 2.0 * ZETA * omega * u

    def rate(now: float, y: np.ndarray) -> list[float]:
        return [y[1], pull(y[0], y[1]) - np.interp(now, t, a)]

    done = solve_ivp(rate, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-7, atol=1e-9, max_step=0.02)
    return np.asarray(MASS_KG * pull(*done.y))


def test_such_a_mass_moves_as_its_equation_says() -> None:
    problem, _ = fitted(lambda t, x, v: 2e3 * v, "viscous")
    law, shape = effects.catalogue()["second_mode"], Trial((F_HZ, ZETA))
    linear = law.columns(problem.ctx, shape)[0]
    mean2 = float(np.mean((linear / (2.0 * np.pi * F_HZ) ** 2) ** 2))
    for change in (0.0, -0.03):
        force = law.by_stroke(problem.ctx, shape, change, shape)
        assert force is not None
        truth = riding(-change / mean2) / MASS_KG
        assert float(np.std(force - truth)) < 0.02 * float(np.std(truth))
    # A spring that has softened to nothing lets its mass run away.
    assert law.by_stroke(problem.ctx, shape, -10.0, shape) is None
    assert effects.catalogue()["viscous"].by_stroke(problem.ctx, Trial(), 0.1, Trial()) is None


@pytest.mark.parametrize("beside", ["quad_damping", "cubic"])
def test_mass_on_a_spring_that_softens_explains_more_than_two_laws(beside: str) -> None:
    force = riding(SOFTER)
    problem, fit = fitted(lambda t, x, v: force, *sorted((beside, "second_mode")))
    assert stroke.gain(problem, fit) > 5.0 * POLICY.same_evidence


@pytest.mark.parametrize("beside", ["viscous", "quad_damping"])
def test_second_mode_beside_a_damper_is_what_it_is(beside: str) -> None:
    force = riding(0.0)
    damper = {"viscous": lambda v: 900.0 * v, "quad_damping": lambda v: 6e3 * v * np.abs(v)}
    names = sorted((beside, "second_mode"))
    problem, fit = fitted(lambda t, x, v: force + damper[beside](v), *names)
    assert stroke.gain(problem, fit) < POLICY.same_evidence


@pytest.mark.parametrize(("times", "seed"), [(1.3, 8), (3.0, 1), (15.0, 1)])
def test_mass_alone_is_compared_where_only_a_softer_spring_reaches_the_noise(
    times: float, seed: int
) -> None:
    """A spring that changes a little is the form of the law, however little noise there is.

    In one of them the noise is a standard deviation more than expected, all of which is left.
    """

    def gain(per_m2: float) -> float:
        force = times * riding(per_m2)
        return stroke.gain(*fitted(lambda t, x, v: force, "second_mode", seed=seed))

    assert gain(SOFTER) > 5.0 * POLICY.same_evidence
    assert gain(0.1 * SOFTER) == gain(0.0) == -np.inf


def test_softer_spring_shows_before_what_it_leaves_exceeds_the_scatter_of_the_noise() -> None:
    """Noise has an rms that scatters from recording to recording; that of one recording is one."""

    def searched(per_m2: float) -> tuple[ResidualProblem, Fit]:
        force = 0.5 * riding(per_m2)
        return fitted(lambda t, x, v: force, "second_mode")

    problem, fit = searched(SOFTER)
    rows = problem.y.size * problem.estimate.share
    assert fit.chi2 - rows < 3.0 * np.sqrt(2.0 * rows)
    assert stroke.gain(problem, fit) > POLICY.same_evidence
    assert stroke.gain(*searched(0.0)) == -np.inf


def test_sets_without_a_mass_on_a_spring_are_not_compared() -> None:
    plain = fitted(lambda t, x, v: 2e3 * v + 60.0 * np.sign(v), "coulomb", "viscous")
    assert stroke.gain(*plain) == -np.inf


@pytest.mark.parametrize("per_m2", [-100.0, -40.0, 40.0, 80.0, 200.0])
def test_much_softer_spring_is_found_from_the_frequency_of_a_linear_one(per_m2: float) -> None:
    """The frequency at small strokes is far from the one in the recording then."""
    force = riding(per_m2)
    problem, fit = fitted(lambda t, x, v: force, "second_mode")
    least = stroke._least(problem, fit.members[0])
    assert least is not None
    prior = np.diag([0.0, *(0.0 if n.sigma is None else n.sigma**-2.0 for n in problem.nuisances)])
    exact, _ = left(np.column_stack([problem.seen(force), problem.base]), prior, problem.y)
    assert fit.chi2 > exact + 100.0
    assert least < exact + 0.02 * (fit.chi2 - exact)
