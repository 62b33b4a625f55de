"""What a numerical part of many degrees of freedom is to its actuator: step, roots, delays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from frames import shear_building, space_frame

from rthyb_rt import core
from rthyb_rt.analysis import linear_parts, margins, numerical_margins
from rthyb_rt.analysis.linear_parts import LinearPart
from rthyb_rt.core.numerical_parts import SparsePart
from rthyb_rt.core.sparse import SparseConfig, Symmetric, lowest_modes

K_E = 3e7


class AsFound(numerical_margins.ManyDegrees):
    """A structure of which nothing is known but its linear system."""

    def __init__(self, linear: LinearPart) -> None:
        self.__dict__["linear"] = linear


def critical_delay(linear: LinearPart) -> float:
    return margins.critical_delay(AsFound(linear))


def building(storeys: int, **settings: Any) -> SparseConfig:
    m, k = shear_building(2e4 * np.ones(storeys), 3e7 * np.ones(storeys))
    k[0, 0] -= K_E  # the first storey is the specimen
    given: dict[str, Any] = {"by_mass_per_s": 0.3, "by_stiffness_s": 2e-4} | settings
    return SparseConfig(
        Symmetric.of(m), Symmetric.of(k), np.diag(m), (((0, 1.0),),), (K_E,), **given
    )


@pytest.mark.parametrize("settings", [{}, {"rho_inf": 0.5}, {"integrator": "central-difference"}])
def test_the_linear_system_steps_as_the_part_does(settings: dict[str, Any]) -> None:
    config = building(6, **settings)
    linear, part = LinearPart.of(config), SparsePart(config)
    rng = np.random.default_rng(2)
    part.step(0.0, 0.0)
    s = np.zeros(len(linear.a))
    for _ in range(400):
        force = float(rng.normal(0.0, 1e4))
        x, _ = part.step(0.0, force)
        s = linear.a @ s + linear.b * force
        assert linear.c @ s == pytest.approx(x, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("rho_inf", [1.0, 0.6])
def test_one_degree_of_freedom_survives_what_the_equation_of_motion_does(rho_inf: float) -> None:
    m, c, k = 4e4, 2e4, 1e6
    motion = core.MotionConfig("kr-alpha", m, c, k, K_E, rho_inf=rho_inf)
    one = Symmetric.of(np.array([[m]]))
    part = SparseConfig(
        one, Symmetric.of(np.array([[k]])), np.array([m]), (((0, 1.0),),), (K_E,),
        damping_n_s_per_m=Symmetric.of(np.array([[c]])), rho_inf=rho_inf,
    )  # fmt: skip
    expected = margins.critical_delay(margins.OneDegree(motion))
    assert expected > 0.1
    assert critical_delay(LinearPart.of(part)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.long
def test_many_storeys_condensed_survive_what_all_of_them_do() -> None:
    config = building(90)
    whole = linear_parts.of_sparse(config)
    few = LinearPart.of(config)
    assert len(few.a) == 2 * linear_parts.MOST_MODES + 1
    expected = critical_delay(whole)
    assert expected > 0.01
    assert critical_delay(few) == pytest.approx(expected, rel=0.02)


def test_the_modes_of_a_large_frame_are_those_of_its_condensed_matrices() -> None:
    mass, stiffness, _, corner = space_frame((3, 3), 8)
    load = np.zeros(mass.shape[0])
    config = SparseConfig(
        Symmetric.of(mass), Symmetric.of(stiffness), load, (((corner[0], 1.0),),), (0.0,)
    )
    w2, shapes = lowest_modes(config, 12)
    k = stiffness.toarray()
    own = np.flatnonzero(mass.diagonal())
    rest = np.setdiff1d(np.arange(len(k)), own)
    inner = np.linalg.solve(k[np.ix_(rest, rest)], k[np.ix_(rest, own)])
    small = k[np.ix_(own, own)] - k[np.ix_(own, rest)] @ inner
    expected = scipy.linalg.eigh(small, mass.toarray()[np.ix_(own, own)], eigvals_only=True)
    assert w2 == pytest.approx(expected[:12], rel=1e-8)
    assert shapes.T @ mass @ shapes == pytest.approx(np.eye(12), abs=1e-8)
    assert stiffness @ shapes == pytest.approx(mass @ shapes * w2, abs=1e-6 * w2[-1])


def test_a_structure_that_nothing_holds_has_no_modes() -> None:
    free = Symmetric.of(np.array([[1.0, -1.0], [-1.0, 1.0]]))
    config = SparseConfig(Symmetric.of(np.eye(2)), free, np.ones(2), (((0, 1.0),),), (0.0,))
    with pytest.raises(core.CoreError, match="the stiffness of the whole structure is"):
        lowest_modes(config, 1)
