"""Forces of several coordinates are put right by a tangent stiffness matrix: elastic, yielding, at
rest, and with readings that are none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from kernels import Floats

from rthyb_rt.core import CoreError, RfcConfig
from rthyb_rt.core.kernels import Rfc
from rthyb_rt.core.library import STATUS
from rthyb_rt.core.matrix_rfc import MatrixRfc, MatrixRfcConfig

H = 1.0 / 1024.0
K_E = np.array([[6.0e6, 8.0e5], [8.0e5, 5.0e5]])
"""Of a frame: x against a rotation."""
NOISE = (1e-6, 3e-6)


def config(**settings: Any) -> MatrixRfcConfig:
    return replace(MatrixRfcConfig(K_E, NOISE), **settings)


def motion(seconds: float = 4.0, size: int = 2) -> Floats:
    t = np.arange(round(seconds / H)) * H
    rows = [np.sin(2 * np.pi * (1.3 + 0.8 * i) * t + i) - math.sin(i) for i in range(size)]
    return 3e-3 * np.array(rows).T


def weighted(x: Floats, f: Floats, own: MatrixRfcConfig) -> Floats:
    """Tangent stiffness at the end of a motion, by weighted least squares written again."""
    age = np.arange(len(x))[::-1]
    w = (1.0 - own.period_s / own.memory_s) ** age
    mean_x, mean_f = (w @ one / w.sum() for one in (x, f))
    dx, df = x - mean_x, f - mean_f
    ridge = np.diag(16.0 * w.sum() * np.array(own.rest_noise) ** 2)
    right = dx.T @ (w[:, None] * df) + ridge @ own.k_e
    slope = np.linalg.solve(dx.T @ (w[:, None] * dx) + ridge, right).T
    root = np.linalg.cholesky(own.k_e)
    inner = np.linalg.solve(root, np.linalg.solve(root, 0.5 * (slope + slope.T)).T)
    values, vectors = scipy.linalg.eigh(inner)
    return root @ vectors @ np.diag(np.clip(values, 0, 1)) @ vectors.T @ root.T


def test_an_elastic_specimen_has_its_elastic_stiffness_and_its_force_is_exact() -> None:
    wanted = motion()
    late = np.vstack([np.zeros((12, 2)), wanted])[: len(wanted)]
    force, k = MatrixRfc(config()).run(wanted, late, late @ K_E)
    assert np.abs(k - K_E).max() < 1e-6 * K_E.max()
    assert np.abs(force - wanted @ K_E).max() < 1e-6 * np.abs(wanted @ K_E).max()


@pytest.mark.parametrize("share", [0.8, 0.25, 0.0])
def test_a_specimen_that_has_softened_in_one_direction_is_known_by_it(share: float) -> None:
    direction = np.linalg.cholesky(K_E) @ np.array([0.6, 0.8])
    soft = K_E - (1 - share) * np.outer(direction, direction)
    x = motion()
    _, k = MatrixRfc(config()).run(x, x, x @ soft)
    assert np.abs(k[-1] - soft).max() < 2e-4 * K_E.max()


@pytest.mark.parametrize("seed", range(4))
def test_the_stiffness_is_the_weighted_least_squares_slope_between_nought_and_elastic(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(3, 3))
    k_e = 1e6 * (half @ half.T + 0.3 * np.eye(3))
    own = MatrixRfcConfig(k_e, (1e-6, 2e-6, 5e-7), memory_s=0.3)
    x = motion(2.0, 3) + 2e-4 * rng.normal(size=(2048, 3)).cumsum(axis=0) / 30
    slope = k_e + 8e5 * rng.normal(size=(3, 3))
    f = x @ slope.T + 500.0 + 10.0 * rng.normal(size=x.shape)
    _, k = MatrixRfc(own, x[0], f[0]).run(x, x, f)
    assert np.abs(k[-1] - weighted(x, f, own)).max() < 1e-7 * k_e.max()
    inside = scipy.linalg.eigh(k[-1], k_e, eigvals_only=True)
    assert inside.min() > -1e-9
    assert inside.max() < 1 + 1e-9


def test_one_coordinate_yields_as_the_compensator_of_one_axis_says() -> None:
    x = motion(size=1)
    yielded = np.clip(6e6 * x, -9e3, 9e3)
    one = Rfc(RfcConfig(k_e_n_per_m=6e6, window=20, tangent="least-squares", rest_noise_m=1e-7))
    alone, k_alone = one.run(x[:, 0], x[:, 0] - 1e-4, yielded[:, 0])
    many = MatrixRfc(MatrixRfcConfig(np.array([[6e6]]), (1e-7,), memory_s=0.005))
    force, k = many.run(x, x - 1e-4, yielded)
    settled = slice(100, None)
    # A window and an exponential memory: the same but where the stiffness has just changed.
    apart = np.abs(k[settled, 0, 0] - k_alone[settled]) > 0.02 * 6e6
    assert apart.mean() < 0.15
    assert np.median(np.abs(force[settled, 0] - alone[settled])) < 0.1


def test_at_rest_and_within_noise_the_stiffness_is_the_elastic_one() -> None:
    rng = np.random.default_rng(6)
    x = np.array(NOISE) * rng.normal(size=(4000, 2))
    _, k = MatrixRfc(config()).run(x, x, 50.0 * rng.normal(size=x.shape))
    assert np.abs(k[2000:] - K_E).max() < 0.25 * K_E.max()
    x = motion() * [1.0, 0.0]
    _, k = MatrixRfc(config()).run(x, x, 0.3 * x @ K_E)
    # What turns is not known to have softened: only x has moved.
    assert k[-1, 0, 0] == pytest.approx(0.3 * K_E[0, 0], rel=0.15)
    assert k[-1, 1, 1] > 0.8 * K_E[1, 1]


def test_lateness_and_low_pass_act_as_for_one_axis() -> None:
    x, v = motion(), np.gradient(motion(), H, axis=0)
    own = config(lateness_s=0.002, memory_s=1e3)
    force, k = MatrixRfc(own).run(x, x, x @ K_E, v)
    wanted = x @ K_E + 0.002 * np.einsum("nij,nj->ni", k, v)
    assert np.allclose(force, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())
    jump = np.tile([1e-4, 0.0], (3000, 1))
    force, _ = MatrixRfc(config(cutoff_hz=30.0)).run(jump, 0 * jump, 0 * jump)
    assert abs(force[0, 0]) < 0.1 * 1e-4 * K_E[0, 0]
    assert force[-1] == pytest.approx(1e-4 * K_E[0], rel=1e-9)
    off, _ = MatrixRfc(config(enabled=False)).run(jump, 0 * jump, 0 * jump)
    assert np.count_nonzero(off) == 0


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("which", range(4))
def test_a_senseless_value_is_replaced_by_the_last_good_one(absurd: float, which: int) -> None:
    rfc = MatrixRfc(config())
    x = motion(0.5)
    wanted = STATUS["out_of_range"] if math.isfinite(absurd) else STATUS["not_finite"]
    for n, row in enumerate(x):
        given = [row, row.copy(), row @ K_E, np.zeros(2)]
        if n % 20 == 10:
            before = rfc.k
            given[which] = np.array([absurd, given[which][1]])
            force, code = rfc.step(*given)
            assert code & wanted
            assert np.array_equal(rfc.k, before)
        else:
            force, code = rfc.step(*given)
            assert code == 0
        assert np.isfinite(force).all()
        assert np.isfinite(rfc.k).all()
        # The last good value is a sample old: never more off than what moved meanwhile.
        assert np.abs(force - row @ K_E).max() < 2500.0


def test_values_at_the_edge_of_sense_stay_finite_and_frozen_learns_nothing() -> None:
    rfc, rng = MatrixRfc(config()), np.random.default_rng(8)
    for _ in range(3000):
        x, f = 1e3 * rng.uniform(-1, 1, 2), 1e12 * rng.uniform(-1, 1, 2)
        force, _ = rfc.step(x, -x, f, 1e9 * x / 1e3)
        assert np.isfinite(force).all()
        assert np.isfinite(rfc.k).all()
    still = MatrixRfc(config())
    for row in motion(1.0):
        still.step(row, row, 0.1 * row @ K_E, frozen=True)
    assert np.array_equal(still.k, K_E)


WRONG: list[dict[str, Any]] = [
    {"k_e": np.array([[1e6, 2e6], [2e6, 1e6]])},
    {"k_e": np.array([[1e6, 2e5], [1e5, 1e6]])},
    {"k_e": np.zeros((2, 2))},
    {"k_e": np.full((2, 2), math.nan)},
    {"k_e": np.eye(3)},
    {"rest_noise": (-1e-6, 0.0)},
    {"rest_noise": (0.0,) * 5},
    {"memory_s": 0.0},
    {"memory_s": math.nan},
    {"cutoff_hz": 600.0},
    {"lateness_s": 2.0},
    {"period_s": 0.0},
]


@pytest.mark.parametrize("wrong", WRONG)
def test_settings_that_cannot_work_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(CoreError):
        MatrixRfc(config(**wrong))
