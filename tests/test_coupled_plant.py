"""The virtual rig of several axes: plant against scipy, forces by differences, noise, strokes, and
commands that are none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.signal
from kernels import Floats

from rthyb_rt.core import CoreError
from rthyb_rt.core.coupled_plant import CoupledPlant, CoupledPlantConfig
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.core.library import STATUS

H = 1.0 / 1024.0
MATRIX = np.array([[1.0, 0.13], [1.0, -0.13]])


def discrete() -> tuple[Floats, Floats, Floats]:
    """Two coupled second-order axes with a held input."""
    k = np.array([[9e3, -2e3], [-2e3, 7e3]])
    c = np.array([[90.0, -8.0], [-8.0, 80.0]])
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-k, -c]])
    b = np.vstack([np.zeros((2, 2)), k @ np.array([[0.9, 0.1], [0.05, 0.95]])])
    out = np.hstack([np.eye(2), np.zeros((2, 2))])
    ad, bd, cd, *_ = scipy.signal.cont2discrete((a, b, out, np.zeros((2, 2))), H)
    return ad, bd, cd


def config(**settings: Any) -> CoupledPlantConfig:
    a, b, c = discrete()
    given: dict[str, Any] = {
        "a": a,
        "b": b,
        "c": c,
        "kinematics": Kinematics(MATRIX),
        "stroke_m": (0.03, 0.03),
        "noise_m": (0.0, 0.0),
        "stiffness": np.array([[1e6, 2e4], [2e4, 5e4], [0.0, 3e3]]),
        "damping": np.array([[1e3, 0.0], [0.0, 20.0], [7.0, 1.0]]),
        "mass": np.array([[8.5, 0.1], [0.1, 0.9], [0.0, 0.4]]),
    }
    return CoupledPlantConfig(**given | settings)


def commands(n: int = 4096) -> Floats:
    t = np.arange(n) * H
    return np.stack([5e-3 * np.sin(9 * t) * np.sin(t), 4e-3 * np.sin(13 * t + 0.4) * t / 4], axis=1)


def test_the_plant_is_the_state_space_model_it_was_given() -> None:
    u = commands()
    x, _ = CoupledPlant(config()).run(u)
    _, wanted, _ = scipy.signal.dlsim((*discrete(), np.zeros((2, 2)), H), u)
    assert np.abs(x - wanted).max() < 1e-15


def test_the_specimen_resists_by_three_forces_at_two_axes() -> None:
    x, force = CoupledPlant(config()).run(commands())
    pose = x @ np.linalg.inv(MATRIX).T
    v = np.diff(np.vstack([np.zeros(2), pose]), axis=0) / H
    a = np.diff(np.vstack([np.zeros(2), v]), axis=0) / H
    own = config()
    wanted = pose @ own.stiffness.T + v @ own.damping.T + a @ own.mass.T
    assert force.shape == (len(x), 3)
    assert np.abs(force - wanted).max() < 1e-9 * np.abs(wanted).max()


def test_noise_is_white_as_strong_as_said_and_the_same_again_from_its_seed() -> None:
    noisy = {"noise_m": (1e-5, 3e-5), "seed": 4}
    u = np.zeros((40_000, 2))
    x, _ = CoupledPlant(config(**noisy)).run(u)
    assert np.allclose(x.std(axis=0), [1e-5, 3e-5], rtol=0.02)
    assert abs(np.corrcoef(x[1:, 0], x[:-1, 0])[0, 1]) < 0.02
    assert abs(np.corrcoef(x.T)[0, 1]) < 0.02
    assert np.array_equal(CoupledPlant(config(**noisy)).run(u)[0], x)
    assert not np.array_equal(CoupledPlant(config(**noisy | {"seed": 5})).run(u)[0], x)


def test_readings_are_latched_before_the_command_that_comes_with_them() -> None:
    plant = CoupledPlant(config(noise_m=(1e-6, 1e-6)))
    u = commands(300)
    rows = []
    for row in u:
        x, _, code = plant.latch()
        assert code == 0
        assert np.abs(x - plant.true_m).max() < 6e-6
        assert np.allclose(plant.pose, np.linalg.solve(MATRIX, x), rtol=0, atol=1e-15)
        rows.append(plant.true_m)
        plant.apply(row)
    assert np.array_equal(np.array(rows), CoupledPlant(config()).run(u)[0])


def test_a_command_ends_at_the_stroke() -> None:
    plant, free = CoupledPlant(config(stroke_m=(0.004, 0.03))), CoupledPlant(config())
    for row in 2 * commands():
        code = plant.apply(row)
        assert bool(code & STATUS["limited"]) == (abs(row[0]) > 0.004)
        free.apply([min(max(row[0], -0.004), 0.004), row[1]])
        assert np.array_equal(plant.latch()[0], free.latch()[0])


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300])
def test_a_command_that_is_none_leaves_the_one_before(absurd: float) -> None:
    plant, other = CoupledPlant(config()), CoupledPlant(config())
    wanted = STATUS["out_of_range"] if math.isfinite(absurd) else STATUS["not_finite"]
    for k, row in enumerate(commands(600)):
        broken = [absurd, row[1]] if k % 50 == 25 else row
        kept = [commands(600)[k - 1][0], row[1]] if k % 50 == 25 else row
        assert bool(plant.apply(broken) & wanted) == (k % 50 == 25)
        other.apply(kept)
        x, f, _ = plant.latch()
        y, g, _ = other.latch()
        assert np.array_equal(x, y)
        assert np.array_equal(f, g)


def test_an_unstable_plant_says_so_and_stays_finite() -> None:
    a, b, c = discrete()
    plant = CoupledPlant(config(a=3.0 * a, b=b, c=c))
    codes = 0
    for _ in range(3000):
        codes |= plant.apply([1e-3, 1e-3])
        x, f, code = plant.latch()
        codes |= code
        assert np.isfinite(x).all()
        assert np.isfinite(f).all()
    assert codes & STATUS["out_of_range"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"a": np.full((4, 4), math.nan)},
        {"a": np.eye(33), "b": np.ones((33, 2)), "c": np.ones((2, 33))},
        {"b": np.ones((4, 3))},
        {"c": np.ones((1, 4))},
        {"stiffness": np.ones((3, 1))},
        {"mass": np.full((3, 2), math.inf)},
        {"noise_m": (-1e-6, 0.0)},
        {"noise_m": (0.0,)},
        {"stroke_m": (0.0, 0.03)},
        {"kinematics": Kinematics(np.eye(3))},
        {"period_s": 0.0},
    ],
)
def test_a_plant_that_does_not_fit_together_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(CoreError):
        CoupledPlant(config(**wrong))
