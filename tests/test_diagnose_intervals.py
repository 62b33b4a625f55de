"""Intervals of parameters: what noise, form, a fitted actuator and another reading leave open."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import diagnose_cases as cases
import numpy as np
import pytest
from diagnose_answers import diagnosed
from scipy import signal

from rthyb_rt.core.diagnosis_models import ActuatorModel, ComputedMotion, actuator
from rthyb_rt.diagnose import actuator_choice, effects, engine, intervals, reading, result
from rthyb_rt.diagnose.actuation import Actuation
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.form import neighbours, of_form
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.refinement import inflated, inflation

LATE_S = 8.0e-5  # a normal offset in time, of the load cell


def held(d: result.DiagnosisResult, name: str, key: str) -> tuple[float, float]:
    """Return the ends of an interval."""
    low, high = next(c for c in d.candidates if c.name == name).ci95[key]
    return low, high


def fast(monkeypatch, tmp_path, true: tuple[float, float], stated: tuple[float, float], **more):
    """Write a recording behind an actuator of true (f, zeta), beside a model with stated ones."""
    monkeypatch.setattr(cases, "F_HZ", true[0])
    monkeypatch.setattr(cases, "ZETA", true[1])
    cases._moved.cache_clear()  # it does not know of other actuators
    u = cases.command(more.get("kind", "sweep"))
    x = cases.moved(u)[0]
    late = cases.moved(u, cases.DELAY + more.get("late", 0.0))
    cases._moved.cache_clear()
    rng = np.random.default_rng(5)
    force = 1.004 * cases.K * late[0] + 0.95 * cases.C * late[1]
    force += (cases.M + more.get("kg", 0.0)) * late[2]
    columns = {
        "t": np.arange(u.size) / cases.FS,
        "x_cmd": u,
        "x_meas": x + cases.X_STD * rng.standard_normal(u.size),
        "f_meas": force + cases.F_STD * rng.standard_normal(u.size),
    }
    monkeypatch.setattr(cases, "F_HZ", stated[0])
    monkeypatch.setattr(cases, "ZETA", stated[1])
    recording, toml = cases.write(tmp_path, columns)
    return reading.read_case(recording, reading.read_model(toml))


@pytest.mark.parametrize("bent", [0.0, 0.08])
def test_a_law_in_another_form_is_as_unsure_as_it_is(bent):
    """The truth lies inside as often as is said, though no one knows which form the law has."""
    rng = np.random.default_rng(11)
    x = np.sin(np.linspace(0.0, 60.0, 1500))
    law, sigma = np.sign(x) * np.abs(x) ** 1.5, 0.05
    design = np.column_stack([law, x]) / sigma
    inverse = np.linalg.inv(design.T @ design)
    near = np.column_stack(neighbours(law, [(x, 1.0)])) / sigma
    inside, inside_noise, draws = 0, 0, 300
    for _ in range(draws):
        y = design.sum(axis=1) + near @ (bent * rng.standard_normal(4)) + rng.standard_normal(1500)
        beta = inverse @ (design.T @ y)
        form = of_form(design, y - design @ beta, inverse, near)
        off = abs(beta[0] - 1.0)
        inside_noise += bool(off < 1.96 * np.sqrt(inverse[0, 0]))
        inside += bool(off < 1.96 * np.sqrt(inverse[0, 0] + form[0, 0]))
    # Of 300 draws 95 % are 285 +- 7.5 (two standard deviations).
    assert inside / draws > 0.925
    assert inside_noise / draws > 0.92 if not bent else inside_noise / draws < 0.4


def test_a_law_in_its_own_form_is_hardly_less_sure_for_it():
    rng = np.random.default_rng(12)
    x = np.sin(np.linspace(0.0, 60.0, 1500))
    design = np.column_stack([x**3, x]) / 0.05
    inverse = np.linalg.inv(design.T @ design)
    near = np.column_stack(neighbours(x**3, [(x, 1.0)])) / 0.05
    wider = []
    for _ in range(100):
        y = rng.standard_normal(1500)
        residual = y - design @ (inverse @ (design.T @ y))
        wider.append(of_form(design, residual, inverse, near)[0, 0] / inverse[0, 0])
    assert np.median(wider) < 0.5


@pytest.mark.long
def test_an_overdamped_actuator_with_a_lower_corner_is_named_alone(tmp_path, monkeypatch):
    """The fit went to the end of what an offset in time may be, and a delay was named beside it."""
    case = fast(monkeypatch, tmp_path, (20.0, 2.06), (45.0, 2.05))
    d = engine.diagnose(case)
    assert (d.verdict, d.effects) == ("explained", ["oil_column"])
    for key, true in (("f_Hz", 20.0), ("zeta", 2.06)):
        low, high = held(d, "oil_column", key)
        assert low < true < high
        assert high - low < 0.2 * true


@pytest.mark.long
def test_a_mass_behind_a_fast_actuator_is_weighed_at_the_time_of_the_load_cell(
    tmp_path, monkeypatch
):
    case = fast(monkeypatch, tmp_path, (70.0, 2.1), (70.0, 2.1), kg=400.0, late=LATE_S)
    d = engine.diagnose(case)
    assert (d.verdict, d.effects) == ("explained", ["inertia"])
    low, high = held(d, "inertia", "m_kg")
    assert low < 400.0 < high
    assert high - low < 0.1 * 400.0


def test_a_mass_on_a_spring_answers_to_the_motion_and_not_to_its_corners(tmp_path):
    """Behind a drive of 110 Hz the rows (256 a second) see any part of an acceleration."""
    _, toml = cases.write(tmp_path, cases.channels())
    drive = ActuatorModel(delay_s=0.0040, f_hz=110.0, zeta=0.7)
    motion = actuator(drive, cases.command(), cases.FS)
    t = np.arange(motion.x.size) / cases.FS
    ctx = Context(reading.read_model(toml), motion, t, cases.K * motion.x, {})
    mode = effects.catalogue()["second_mode"]
    found = mode.columns(ctx, Trial((2.5, 0.03)))[0]
    w = 2.0 * np.pi * 2.5
    # On the moving base y'' = w^2 (x - y) + 2 zeta w (x' - y'); it pulls with y''.
    system = signal.StateSpace(
        [[0.0, 1.0], [-(w**2), -0.06 * w]], np.array([[0.0, 0.0], [w**2, 0.06 * w]]),
        np.array([[-(w**2), -0.06 * w]]), np.array([[w**2, 0.06 * w]]),
    )  # fmt: skip
    start = [motion.x[0], motion.v[0]]
    _, pulled, _ = signal.lsim(system, np.column_stack([motion.x, motion.v]), t, X0=start)
    np.testing.assert_allclose(found, pulled.ravel(), atol=0.02 * np.max(np.abs(pulled)))
    aliased = effects.catalogue()["inertia"].columns(ctx, Trial())[0]
    assert np.std(aliased) < 0.97 * np.std(np.gradient(motion.v) * cases.FS)


def test_friction_that_falls_with_an_exponential_has_its_own_level(tmp_path):
    def falling(t, x, v, a):
        return (300.0 + 260.0 * np.exp(-np.abs(v) / 0.012)) * np.tanh(v / 3e-4)

    d = diagnosed(tmp_path, cases.channels(falling))
    assert (d.verdict, d.effects) == ("explained", ["stribeck"])
    found = next(c for c in d.candidates if c.name == "stribeck")
    assert "^1" in found.form
    for key, true in (("Fc_N", 300.0), ("Fs_N", 560.0), ("vs_m_s", 0.012)):
        low, high = found.ci95[key]
        assert low < true < high


def test_slack_beside_a_softer_spring_is_told_in_either_reading(tmp_path):
    """In all of the spring there is, or in the part that the model has: the same force."""
    gap, part = 4.0e-4, -0.12

    def slack(t, x, v, a):
        return cases.K * (part * x - np.clip(x, -gap, gap))

    d = diagnosed(tmp_path, cases.channels(slack))
    assert (d.verdict, sorted(d.effects)) == ("explained", ["gap", "stiffness"])
    low, high = held(d, "gap", "gap_m")
    assert low < gap < high
    assert low < gap / (1.0 + part) < high


def test_motions_about_a_fitted_actuator_lie_one_standard_deviation_away(tmp_path):
    """Their distances from it, squared, in units of the noise, come to the numbers that it has."""
    recording, toml = cases.write(tmp_path, cases.channels(delay=cases.DELAY + 2e-3))
    case = reading.read_case(recording, reading.read_model(toml))
    disp = actuator_choice.displacement(case)
    assert disp is not None
    assert disp.best.names == ("delay",)
    task: Actuation = disp.task
    own = disp.best.motion
    around = task.around(disp.best, 1.0, ComputedMotion(own.x, own.v, own.a))
    apart = [np.sum(((m.x - own.x)[task.rows] / task.sigma) ** 2) for m in around]
    # A delay and an offset in time are one number to the rows; the offset's prior parts them.
    assert 0.5 < np.sum(apart) < 3.0
    assert len(around) == 2


@pytest.mark.long
def test_a_lag_without_an_inertia_of_its_own_ends_no_diagnosis(tmp_path, monkeypatch):
    """Of second order it has its corner and its damping beyond all bounds: that is a rival."""
    case = fast(monkeypatch, tmp_path, (90.0, 30.0), (28.0, 0.9))
    d = engine.diagnose(case)
    assert d.disp is not None
    lags = [f.model for f in (*d.disp.rivals, d.disp.best) if "oil_column" in f.names]
    assert lags
    assert all(m.zeta <= 1e3 and m.f_hz <= 1e5 for m in lags)


@pytest.mark.long
def test_equals_are_told_at_the_time_of_the_load_cell_as_well(tmp_path, monkeypatch):
    case = fast(monkeypatch, tmp_path, (70.0, 2.1), (70.0, 2.1), kg=400.0, late=LATE_S, kind="sine")
    d = engine.diagnose(case)
    assert d.verdict == "ambiguous"
    assert sorted(d.ambiguous_with) == [["inertia"], ["stiffness"]]
    assert d.force is not None
    assert d.context is not None
    assert d.force.problem.ctx is d.context
    equal = {f.names: f for f in d.force.equal}
    again = [f for f in d.force.rivals if f.names in equal]
    assert again
    assert all(f is equal[f.names] for f in again)


def test_a_stated_tolerance_does_not_grow_with_the_noise_of_the_rows():
    """Of one parameter of evidence a and prior p: (by a + p) / (a + p)^2; of two, by chance."""
    a, p, by = 4.0, 25.0, 9.0
    one = inflated(np.array([[1.0 / (a + p)]]), np.array([[p]]), by)
    assert one[0, 0] == pytest.approx((by * a + p) / (a + p) ** 2)
    assert inflated(np.eye(2), None, by) == pytest.approx(by * np.eye(2))
    random = np.random.default_rng(4)
    design = random.standard_normal((40, 3)) @ np.array([[1, 1, 0], [0, 0.1, 0], [0, 0, 2.0]])
    prior = np.diag([0.0, 1.0 / 0.3**2, 0.0])
    inverse = np.linalg.inv(design.T @ design + prior)
    # The prior is one more row, of unit noise in its own unit.
    rows = np.vstack([design, [0.0, 1.0 / 0.3, 0.0]])
    errors = np.vstack(
        [3.0 * random.standard_normal((40, 40_000)), random.standard_normal((1, 40_000))]
    )
    assert np.cov(inverse @ rows.T @ errors) == pytest.approx(
        inflated(inverse, prior, by), rel=0.05, abs=2e-3
    )


def test_a_fit_to_a_simulated_motion_has_no_tolerance_that_its_laws_have_along_a_known_one(
    tmp_path,
):
    """A gap's size is pinned in the balance of forces, but free where the motion is simulated."""

    def slack(t, x, v, a):
        return -cases.K * np.clip(x, -1e-3, 1e-3)

    d = diagnosed(tmp_path, cases.channels(slack))
    best = d.force.best
    assert best.names == ("gap",)
    wide = 4.0 * best.covariance
    for scatter in (None, wide):
        fit = replace(best, covariance=wide, scatter=scatter, residual=3.0 * best.residual)
        sure = intervals.Sure(replace(d.force, best=fit), d.context)
        grown = sure.noise[1, 1] / wide[1, 1]
        assert (grown == pytest.approx(inflation(fit.residual))) == (scatter is not None)


@pytest.mark.parametrize(
    ("value", "other", "least", "most"),
    [(0.11, 0.26, 0.11**2 / 0.26, 0.26), (-4.0, -8.0, -8.0, -2.0), (4.0, 1.0, 1.0, 7.0)],
    ids=["twice as large", "of negative sign", "smaller"],
)
def test_other_forms_widen_an_interval_in_both_directions_but_not_to_another_sign(
    value, other, least, most
):
    ends = sorted([other, intervals.opposite(other, value)])
    assert ends == pytest.approx([least, most])
    assert intervals.opposite(-0.1, 0.2) == pytest.approx(0.5)
    assert intervals.opposite(1.0, 0.0) == -1.0


@pytest.mark.parametrize(
    ("sizes", "least"),
    [([2.5, 0.9], 1.96 / 0.1), ([0.25], 1.96 / 0.75), ([-0.4], 1.96 / 1.4), ([2.5], None)],
    ids=["larger and slightly smaller", "much smaller", "of another sign", "larger"],
)
def test_an_effect_is_weak_if_another_form_finds_none_but_not_if_it_finds_more(
    tmp_path, sizes, least
):
    def friction(t, x, v, a):
        return 200.0 * np.tanh(v / 3e-4)

    d = diagnosed(tmp_path, cases.channels(friction))
    best = d.force.best
    assert best.names == ("coulomb",)
    alone = intervals.Sure(replace(d.force, forms=[]), d.context).strength(0)
    forms = [replace(best, betas=(by * best.betas[0],)) for by in sizes]
    strength = intervals.Sure(replace(d.force, forms=forms), d.context).strength(0)
    assert strength == pytest.approx(alone if least is None else least**2)
    assert (strength < 1.96**2) == (min(sizes) < 0.0)


def test_the_form_of_a_law_changes_its_parameter_by_no_more_than_such_a_law_is_inexact():
    """A test at one speed shows a law at one place of its argument, whatever function it is."""
    rng = np.random.default_rng(13)
    t = np.linspace(0.0, 30.0, 3000)
    v = 0.1 * np.clip(20.0 * np.sin(2.0 * np.pi * 0.5 * t), -1.0, 1.0)
    law, sigma = 20.0 * np.tanh(v / 1e-3), 0.1
    design = np.column_stack([law, v]) / sigma
    inverse = np.linalg.inv(design.T @ design)
    x = np.cumsum(v) * (t[1] - t[0])
    near = np.column_stack(neighbours(law, [(x, np.max(np.abs(x))), (v, 0.1)])) / sigma
    y = design.sum(axis=1) + near @ np.full(8, 0.5) + rng.standard_normal(t.size)
    form = of_form(design, y - design @ (inverse @ (design.T @ y)), inverse, near)
    assert 0.2 * POLICY.form_error < np.sqrt(form[0, 0]) < 1.5 * POLICY.form_error


def test_an_interval_ends_where_the_meaning_of_its_parameter_does():
    known = effects.catalogue()["hysteresis"].params
    assert {p.name: p.low for p in known} == {"xy_m": 1e-9, "alpha": -1.0}
    ends = intervals.possible(
        known, {"xy_m": 3e-5, "alpha": 1e-4}, {"xy_m": [-1e-5, 7e-5], "alpha": [-0.1, 0.1]}
    )
    assert ends["xy_m"] == pytest.approx([3e-5**2 / 7e-5, 7e-5])
    assert ends["alpha"] == [-0.1, 0.1]
    # A known length keeps its interval, and a less known one has a longer one.
    low = [
        intervals.possible(known, {"xy_m": 1.0}, {"xy_m": [1.0 - h, 1.0 + h]})["xy_m"][0]
        for h in (0.05, 0.9, 1.0, 1.1, 5.0)
    ]
    assert low == sorted(low, reverse=True)
    assert low[0] == pytest.approx(0.95, abs=0.003)
    dry, loss = (effects.catalogue()[name].params for name in ("coulomb", "degradation"))
    assert intervals.possible(dry, {"Fc_N": 5.0}, {"Fc_N": [-2.0, 12.0]}) == {"Fc_N": [0.0, 12.0]}
    assert intervals.possible(dry, {"Fc_N": 0.0}, {"Fc_N": [-2.0, 2.0]}) == {"Fc_N": [0.0, 2.0]}
    assert intervals.possible(loss, {"loss": 0.6}, {"loss": [0.1, 8.0]}) == {"loss": [0.1, 1.0]}
    # Another form of a law may have a length that no specimen has.
    ends = intervals.within(known, {"xy_m": 3e-5}, {"xy_m": [1e-143, 5.0]})
    assert ends == {"xy_m": [1e-9, 5.0]}


def test_a_spring_does_not_lose_more_than_there_is():
    """Of a spring that is 30 % softer than the model's, 60 % of the model's are 86 %."""
    problem = SimpleNamespace(nuisances=[SimpleNamespace(number="k")])
    fit = SimpleNamespace(members=(), betas=(), nuisance=[-0.3])
    params, ci = {"loss": 0.6, "travel_m": 0.1}, {"loss": [0.3, 0.9], "travel_m": [0.05, 0.2]}
    intervals.of_the_spring_there_is(problem, fit, "degradation", params, ci)
    assert params["loss"] == pytest.approx(0.6 / 0.7)
    assert ci["loss"] == pytest.approx([0.3 / 0.7, 1.0])
