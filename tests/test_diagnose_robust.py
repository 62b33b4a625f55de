"""What real recordings bring with them: lost rows, models that were never checked, one law by two
names; and shipped rigs whose motion has to be the virtual rig's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from validate import own_rigs

from rthyb_rt import config, core
from rthyb_rt.core.diagnosis_models import actuator, body
from rthyb_rt.diagnose import (
    effects,
    engine,
    estimate,
    gaps,
    motion_evaluated,
    noise_level,
    reading,
)
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.fitter import SetFitter
from rthyb_rt.diagnose.freebody import Body
from rthyb_rt.diagnose.motion_fitter import MotionFitter
from rthyb_rt.diagnose.predict import Augmented, predict, start_of
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.lab import experiment

FS_HZ = 256.0


def naive(extra, *, seconds: float = 12.0, **numbers: float) -> Case:
    """Return a drive test beside a model that states no tolerance; ``extra(x, v)``, N."""
    rng = np.random.default_rng(3)
    t = np.arange(int(seconds * FS_HZ)) / FS_HZ
    phase = 2.0 * np.pi * (0.3 * t + 0.15 * t**2)
    x = 2e-3 * np.clip(t, 0.0, 1.0) * np.sin(phase)
    v = np.gradient(x) * FS_HZ
    f = extra(x, v) + 2.0 * rng.standard_normal(t.size)
    model = Model("drive", FS_HZ, **({"k": 2e4, "c": 500.0} | numbers), x_std=1e-6, f_std=2.0)
    channels = {"x_meas": x + 1e-6 * rng.standard_normal(t.size), "f_meas": f}
    return Case("naive", model, t, channels, np.ones(t.size, dtype=np.bool_))


def lost(signal: np.ndarray, share: float = 0.1) -> np.ndarray:
    gone = np.random.default_rng(5).random(signal.size) < share
    gone[:2] = gone[-2:] = False
    return np.where(gone, np.nan, signal)


def problem_of(case: Case) -> ResidualProblem:
    found = estimate.from_sensors(case)
    assert found is not None
    return ResidualProblem(
        case, motion_evaluated.context_of(case, found), found, effects.catalogue().values()
    )


# ---- lost rows -----------------------------------------------------------------------------------


def test_one_row_in_ten_that_is_lost_costs_its_neighbours_only():
    case = naive(lambda x, v: 2e4 * x + 800.0 * v)
    holes = {name: lost(y) for name, y in case.channels.items()}
    whole = estimate.from_sensors(case)
    found = estimate.from_sensors(replace(case, channels=holes))
    assert whole is not None
    assert found is not None
    # Three rows of each hole, and the force's own: nine tenths to the third power, and a tenth.
    assert found.rows.sum() > 0.55 * whole.rows.sum()
    off = (found.motion.x - whole.motion.x)[found.rows]
    assert np.std(off) < 2e-6  # twice the sensor's noise
    assert noise_level.white_noise(holes["x_meas"]) == pytest.approx(1e-6, rel=0.2)


def test_a_long_gap_is_crossed_straight_and_reaches_far():
    x = np.sin(np.arange(400) / 30.0)
    x[100:103], x[200:230] = np.nan, np.nan
    good = np.sin(np.arange(400) / 30.0)
    crossed = gaps.filled(x)
    assert np.max(np.abs(crossed - good)[100:103]) < 1e-4
    assert np.max(np.abs(np.diff(crossed[200:230], 2))) < 1e-12
    away = gaps.away_from_gaps(x, 100.0, 0.1, 0.1, bridged=True)
    assert np.flatnonzero(~away[:150]).tolist() == list(range(97, 106))
    assert np.flatnonzero(~away[150:]).tolist() == list(range(40, 90))


def test_a_prediction_goes_along_a_displacement_with_lost_rows():
    case = naive(lambda x, v: 2e4 * x)
    made = Augmented(case.model, case.model, (), (), None, None)
    holes = replace(case, channels={"x_meas": lost(case.channels["x_meas"])})
    assert np.isfinite(predict(made, holes).f).all()
    # Not where the rest is left out: it is to be foretold there.
    start = np.where(np.arange(case.t.size) < 300, case.channels["x_meas"], np.nan)
    assert np.isnan(predict(made, replace(case, channels={"x_meas": start})).f).all()


def test_a_body_that_is_let_go_starts_alike_where_an_early_row_is_lost():
    n, model = 600, Model("forced", 200.0, 2000.0, 2.0, 8.0, x_std=1e-6)
    x = body(8.0, model.elements(), np.zeros(n), 200.0, (0.05, 0.4), substeps=40).x
    case = Case("swing", model, np.arange(n) / 200.0, {}, np.ones(n, dtype=np.bool_))
    made = Augmented(model, model, (), (), None, None)
    x[5] = np.nan
    assert start_of(made, np.zeros(n), 0.0, case, {}, x) == pytest.approx((0.05, 0.4), rel=0.01)


# ---- models that nobody has checked --------------------------------------------------------------


@pytest.mark.long
def test_a_slider_beside_a_spring_that_nobody_knows_has_one_name():
    """Bristles and a free spring are a spring that yields: one force, and no ambiguity."""
    loop = core.element("hysteresis", k_n_per_m=4e6, post_yield_ratio=0.0, a=1.0, b=1.25e4,
                        c=1.25e4, eta=1.0)  # fmt: skip
    d = engine.diagnose(naive(lambda x, v: 1e3 * x + 1500.0 * v + core.CoreElement(loop).run(x)))
    assert (d.verdict, d.effects, d.ambiguous_with) == ("explained", ["hysteresis"], [])


def fit_of(
    problem: ResidualProblem, name: str, beta: float, *theta: float, variant: str = ""
) -> Fit:
    member = Member(effects.catalogue()[name], Trial(theta, variant))
    return Fit((member,), (np.array([beta]),), 0.0, 1, np.zeros(len(problem.nuisances)))


def test_what_gives_a_model_energy_or_takes_off_a_mass_it_has_not_is_no_answer():
    unchecked = problem_of(naive(lambda x, v: 2e4 * x))
    assert unchecked.sensible(fit_of(unchecked, "quad_damping", 50.0))
    assert not unchecked.sensible(fit_of(unchecked, "quad_damping", -50.0))
    assert not unchecked.sensible(fit_of(unchecked, "inertia", -3.0))
    assert not unchecked.sensible(fit_of(unchecked, "power_damping", 50.0, 0.2))
    stated = problem_of(naive(lambda x, v: 2e4 * x, k_tol=0.01, c_tol=0.15, moving_mass=10.0))
    assert stated.sensible(fit_of(stated, "quad_damping", -50.0))
    assert stated.sensible(fit_of(stated, "inertia", -3.0))
    assert not stated.sensible(fit_of(stated, "inertia", -13.0))
    # A fifth of the spring behind a gap is a softer spring and a stop.
    assert stated.sensible(fit_of(stated, "gap", 1.1, 5e-4, variant="deadband"))
    assert not stated.sensible(fit_of(stated, "gap", 0.2, 5e-4, variant="deadband"))


def spring(problem: ResidualProblem, k_n_per_m: float) -> np.ndarray:
    """Return the nuisances with which the model's spring has this stiffness."""
    model = problem.case.model
    return np.array(
        [k_n_per_m / model.k - 1.0 if n.number == "k" else 0.0 for n in problem.nuisances]
    )


@pytest.mark.parametrize(
    "beside",
    [(), ("drift", 500.0), ("drift", -500.0), ("hum", 100.0, -80.0), ("crosstalk", 0.05)],
    ids=lambda b: " ".join(map(str, b)) or "alone",
)
def test_a_spring_that_falls_beside_a_loop_is_weighed_against_what_holds_the_specimen(beside):
    """A load may take a part of its stiffness (P-delta); what the load cell adds holds nothing."""
    problem = problem_of(naive(lambda x, v: 2e4 * x))
    laws, k = effects.catalogue(), problem.case.model.k
    members, betas = [Member(laws["hysteresis"], Trial((5e-4,), "bw1"))], [np.array([2.0])]
    if beside:
        theta = (50.0,) if beside[0] == "hum" else ()
        members.append(Member(laws[beside[0]], Trial(theta)))
        betas.append(np.array(beside[1:]))

    def sensible(k_n_per_m: float) -> bool:
        held = spring(problem, k_n_per_m)
        return problem.sensible(Fit(tuple(members), tuple(betas), 0.0, 1, held))

    # The loop holds twice the model's spring: with a falling one, the rest of it is elastic.
    assert sensible(0.1 * k)
    assert sensible(-0.4 * k)
    assert not sensible(-0.6 * k)


def test_a_spring_that_falls_beside_bristles_is_weighed_against_what_these_hold():
    """With a falling spring, bristles cancel it: together they imitate any loop."""
    problem = problem_of(naive(lambda x, v: 2e4 * x))
    effect, k = effects.catalogue()["lugre"], problem.case.model.k
    member = Member(effect, Trial((1e-4,), "dahl"))
    beta = np.array([2.0 * k * 1e-4, 0.0])  # they hold twice the model's spring

    def sensible(k_n_per_m: float) -> bool:
        return problem.sensible(Fit((member,), (beta,), 0.0, 1, spring(problem, k_n_per_m)))

    assert sensible(0.0)
    assert sensible(-0.4 * k)
    assert not sensible(-0.6 * k)


@pytest.mark.parametrize("sprung", ["maxwell", "power_damping+maxwell"])
def test_a_naive_models_dashpot_does_not_drive_fast_motion_beside_relaxation(sprung):
    problem = problem_of(naive(lambda x, v: 2e4 * x + 80.0 * v, c=80.0))
    law, c = effects.catalogue()[sprung], problem.case.model.c
    member = Member(law, next(iter(law.trials(problem.ctx))))
    unit = np.std(law.columns(problem.ctx, member.trial)[0])
    beta = np.array([c * np.std(problem.ctx.v) / unit])  # as large as the model's dashpot

    def sensible(c_n_s_per_m: float) -> bool:
        held = [c_n_s_per_m - c if n.number == "c" else 0.0 for n in problem.nuisances]
        return problem.sensible(Fit((member,), (beta,), 0.0, 1, np.array(held)))

    assert sensible(0.0)
    assert sensible(-0.005 * c)  # an error of the fit
    assert not sensible(-0.02 * c)


def test_a_motion_simulated_late_counts_like_the_others():
    """A part that is asked for after rows were taken for less evidence is no worse for that."""
    problem = problem_of(naive(lambda x, v: 2e4 * x))

    class Still(Body):
        whole_rig, rows = False, np.arange(100)

        def __init__(self) -> None:
            pass

        def refined(self, problem: ResidualProblem, fit: Fit) -> Fit:
            return replace(fit, chi2=400.0 + 9.0, residual=np.full(100, 2.0))

    mover = MotionFitter(problem, Still(), SetFitter(problem))
    early = mover.move(fit_of(problem, "coulomb", 1.0))
    assert early is not None
    mover.rescale(4.0, replace(early))
    late = mover.move(fit_of(problem, "quad_damping", 1.0))
    assert late is not None
    assert early.chi2 == late.chi2 == 100.0 + 9.0


# ---- shipped rigs --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", sorted(own_rigs.LAGS))
def test_motion_of_a_rig_files_actuator_is_the_virtual_rigs(kind):
    case = next(c for c in own_rigs.plans(1) if c.rig == kind)
    rig: config.RigFile = own_rigs.rig_files(case)[1]
    t = np.arange(3000) / core.FS_HZ
    u = 7e-3 * np.sin(4.0 * np.pi * t) * np.minimum(t, 1.0) + 1e-3 * np.sin(22.0 * np.pi * t)
    lag = reading.model_of_rig(rig).actuator
    assert lag is not None
    ours = actuator(lag, u, core.FS_HZ)
    # A pure delay moves when it latches: the row before shows what this one had.
    own = [
        np.roll(y, -int(lag.jumps)) for y in core.VirtualRig(experiment.rig_config(rig)).motion(u)
    ]
    for mine, its in zip((ours.x, ours.v, ours.a), own, strict=True):
        assert mine[50:-50] == pytest.approx(its[50:-50], abs=1e-5 * float(np.max(np.abs(its))))
