"""Bristles and yields that are distributed, as a force and as elements of a rig file."""

from __future__ import annotations

import diagnose_cases as cases
import numpy as np
import pytest

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects, reading
from rthyb_rt.diagnose.effects import chains
from rthyb_rt.diagnose.effects.base import Context, Trial

FC_N = 150.0


@pytest.fixture
def ctx(tmp_path):
    _, toml = cases.write(tmp_path, cases.channels())
    x, v, a = cases.moved(cases.command())
    t = np.arange(x.size) / cases.FS
    return Context(reading.read_model(toml), ComputedMotion(x, v, a), t, cases.K * x, {})


def sliders(yields: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The mean of elastic, perfectly plastic springs, (n,), one by one."""
    total = np.zeros(x.size)
    for limit in yields:
        z = 0.0
        for i in range(1, x.size):
            z = min(max(z + x[i] - x[i - 1], -limit), limit)
            total[i] += z
    return total / yields.size


def force_of(elements, ctx: Context) -> np.ndarray:
    return sum(core.CoreElement(e).run(ctx.x, ctx.v, ctx.a, ctx.dt) for e in elements)


@pytest.mark.parametrize(
    ("drawn", "chain"),
    [
        (lambda n: -np.log(1.0 - n), chains.exponential),
        (lambda n: 1.0 + 0.8 * _triangular(n), lambda m: chains.triangle(m, 0.8)),
        (lambda n: 1.0 + 0.5 * (2.0 * n - 1.0), lambda m: chains.even(m, 0.5)),
    ],
    ids=["exponential", "triangle", "even"],
)
def test_a_chain_is_a_rig_files_elements_and_nearly_a_continuous_distribution(drawn, chain, ctx):
    mean_m, k = 1e-3, 4e5
    x = ctx.x[:2500]
    many = k * sliders(mean_m * drawn((np.arange(300) + 0.5) / 300), x)
    yields = chain(mean_m)
    assert yields.mean() == pytest.approx(mean_m, rel=1e-3)
    elements = chains.elements(yields, k)
    assert sum(e.params[0] for e in elements) == pytest.approx(k)
    made = sum(core.CoreElement(e).run(x) for e in elements)
    for force in (k * chains.plastic(yields, x), made):
        assert np.std(force - many) < 0.012 * np.std(many)


def _triangular(n: np.ndarray) -> np.ndarray:
    return np.where(n < 0.5, np.sqrt(2.0 * n) - 1.0, 1.0 - np.sqrt(2.0 * (1.0 - n)))


@pytest.mark.parametrize("form", ["dahl", "spread0", "spread0.5", "spread1.0", "slips"])
@pytest.mark.parametrize("travel_m", [2e-4, 2e-3])
def test_friction_with_bristles_is_simulated_in_the_form_in_which_it_was_found(form, travel_m, ctx):
    effect, trial, beta = effects.catalogue()["lugre"], Trial((travel_m,), form), [FC_N, 0.0]
    found = np.column_stack(effect.columns(ctx, trial)) @ beta
    made = force_of(effect.elements(ctx, trial, np.array(beta)), ctx)
    assert np.std(made - found) < 0.01 * np.std(found)


def test_bristles_whose_friction_falls_are_simulated_as_such(ctx):
    """All of LuGre's law, here solved row by row with the exact step of its bristle."""
    effect, trial = effects.catalogue()["lugre"], Trial((1e-3, 1.7, 0.05), "falls")
    found = np.column_stack(effect.columns(ctx, trial)) @ [FC_N, 0.0]
    made = force_of(effect.elements(ctx, trial, np.array([FC_N, 0.0])), ctx)
    assert np.std(made - found) < 0.01 * np.std(found)
    v, z, force = ctx.v, 0.0, np.zeros(ctx.t.size)
    level = FC_N * (1.0 + 0.7 * np.exp(-((v / 0.05) ** 2)))
    for i in range(1, v.size):
        end = np.sign(v[i]) * level[i]
        z = end + (z - end) * np.exp(-abs(v[i]) * ctx.dt * FC_N / 1e-3 / level[i])
        force[i] = z
    assert np.std(found - force) < 0.02 * np.std(force)


def test_two_chains_are_simulated_as_such_and_follow_ramberg_and_osgood(ctx):
    """Its backbone never ends to bend, other than that of one chain."""
    effect, k = effects.catalogue()["hysteresis"], ctx.model.k
    trial = Trial((1e-3, 3e-3), "chains")
    found = np.column_stack(effect.columns(ctx, trial)) @ [0.5, 0.3]
    made = force_of(effect.elements(ctx, trial, np.array([0.5, 0.3])), ctx)
    assert np.std(made - found) < 0.01 * np.std(found)
    # x = f / k + a (f / fy)^5: Masing's chain has the yields that make this backbone.
    xs = np.linspace(0.0, 1.05 * ctx.x_range, 400)
    fs = np.linspace(0.0, 2.0 * k * 2e-3, 4000)
    backbone = np.interp(xs, fs / k + 1e-3 * (fs / (k * 2e-3)) ** 5, fs)
    slopes = np.append(np.diff(backbone) / np.diff(xs), 0.0)
    truth = sum(
        (slopes[j] - slopes[j + 1]) * sliders(np.array([xs[j + 1]]), ctx.x)
        for j in range(xs.size - 1)
        if slopes[j] - slopes[j + 1] > 1e-3 * k
    )
    one, both = (
        min(_left(effect, Trial(shape, name), ctx, truth) for shape in shapes)
        for name, shapes in (
            ("iwan", [(a, s) for a in np.linspace(1e-3, 4e-3, 13) for s in (0.5, 0.8, 1.0)]),
            ("chains", [(a, b) for a in np.linspace(1e-3, 4e-3, 13) for b in (2 * a, 3.5 * a)]),
        )
    )
    assert both < 0.3 * one


def _left(effect, trial: Trial, ctx: Context, truth: np.ndarray) -> float:
    design = np.column_stack([*effect.columns(ctx, trial), ctx.x])
    rest = truth - design @ np.linalg.lstsq(design, truth, rcond=None)[0]
    return float(np.std(rest) / np.std(truth))


def test_damped_bristles_that_no_chain_has_are_damped_in_a_rig_file(ctx):
    effect, trial = effects.catalogue()["lugre"], Trial((2e-3,), "slips")
    kinds = [
        {e.kind for e in effect.elements(ctx, trial, np.array([FC_N, damping]))}
        for damping in (1e-3 * FC_N, 2.0 * FC_N)
    ]
    assert kinds == [{"iwan"}, {"lugre"}]


def test_yields_in_a_triangle_are_simulated_as_such(ctx):
    effect, trial = effects.catalogue()["hysteresis"], Trial((1e-3, 0.9), "bell")
    found = 0.5 * effect.columns(ctx, trial)[0]
    made = force_of(effect.elements(ctx, trial, np.array([0.5])), ctx)
    assert np.std(made - found) < 0.01 * np.std(found)
