"""Recordings with one noise in force and motion: it is no evidence of an effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from test_diagnose_colour import coloured, resonant
from test_diagnose_noise import written
from test_diagnose_steady import along

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects, estimate, force, motion_evaluated, onset
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.evidence import Gathered
from rthyb_rt.diagnose.feedback import Driven
from rthyb_rt.diagnose.fitter import SetFitter
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, price
from rthyb_rt.diagnose.refinement import solve

FS_HZ, K, C, M = 512.0, 4e5, 1000.0, 300.0
F_HZ, ZETA, LATE = 30.0, 0.8, 2
MASS, LOSS = 12_000.0, 40_000.0
X_STD, F_STD = 1e-6, 20.0

LOOP = f"""
schema = "rthyb-baseline/1"
family = "loop"
fs_hz = {FS_HZ}
[specimen]
k = {K}
c = {C}
moving_mass = {M}
k_tol = 0.01
c_tol = 0.15
[actuator]
delay_s = {LATE / FS_HZ}
f_hz = {F_HZ}
zeta = {ZETA}
gain = 1.0
[numerical]
m = {MASS}
c = {LOSS}
[noise]
x_std = {X_STD}
f_std = {F_STD}
"""


def hybrid_test(seed: int, friction_n: float = 0.0) -> dict[str, np.ndarray]:
    """A structure of which a specimen is the spring; the actuator by its closed form.

    The ground is three sines up to 3 Hz. The command is a straight line between samples.
    """
    random, n, w0 = np.random.default_rng(seed), int(16 * FS_HZ), 2.0 * np.pi * F_HZ
    t = np.arange(n) / FS_HZ
    sines = ((0.7, 0.3, 0.0), (1.9, 0.2, 1.0), (3.1, 0.3, 2.0))
    ag = np.clip(t, 0.0, 1.0) * sum(a * np.sin(2 * np.pi * f * t + p) for f, a, p in sines)
    hears = F_STD * coloured(random, resonant(), n, FS_HZ)
    # State x, v, target and its slope.
    pull = [-w0 * w0, -2.0 * ZETA * w0, w0 * w0, 0.0]
    step = expm(np.array([[0.0, 1.0, 0.0, 0.0], pull, [0, 0, 0, 1.0], [0] * 4]) / FS_HZ)[:2]
    sent, x, force = np.zeros(n + 1), np.zeros(n), np.zeros(n)
    at, rate = np.zeros(2), 0.0
    for i in range(n):
        target, then = (sent[max(i - LATE + k, 0)] for k in (0, 1))
        a = w0 * w0 * (target - at[0]) - 2.0 * ZETA * w0 * at[1]
        dry = friction_n * np.tanh(at[1] / 1e-4)
        x[i], force[i] = at[0], K * at[0] + C * at[1] + M * a + dry + hears[i]
        rate -= (ag[i] + (LOSS * rate + force[i]) / MASS) / FS_HZ
        sent[i + 1] = sent[i] + rate / FS_HZ
        at = step @ [*at, target, (then - target) * FS_HZ]
    moved = x + X_STD * random.standard_normal(n)
    return {
        "t": t,
        "ag": ag,
        "x_num": sent[:n],
        "x_cmd": sent[:n],
        "x_meas": moved,
        "f_meas": force,
    }


def problem_of(noise_kg: float, dashpot_n_s_per_m: float) -> ResidualProblem:
    """A specimen that noise moves at 60 Hz as well, which its cell shows of what it made it of.

    Args:
        noise_kg: noise of the cell over the acceleration that it made, none by any law.
        dashpot_n_s_per_m: damping that is in no model.
    """
    random, n, w = np.random.default_rng(3), int(16 * FS_HZ), 2.0 * np.pi
    t = np.arange(n) / FS_HZ
    x, v, a = np.zeros(n), np.zeros(n), np.zeros(n)
    for f_hz, size in ((0.7, 4e-3), (1.9, 2e-3), (3.1, 1e-3)):
        x += size * np.sin(w * f_hz * t)
        v += size * w * f_hz * np.cos(w * f_hz * t)
        a -= size * (w * f_hz) ** 2 * np.sin(w * f_hz * t)
    slow = a.copy()
    for f_hz in np.linspace(55.0, 65.0, 101):
        size, at = 5e-7 * random.standard_normal(), w * f_hz * t + w * random.random()
        x += size * np.sin(at)
        v += size * w * f_hz * np.cos(at)
        a -= size * (w * f_hz) ** 2 * np.sin(at)
    model = Model(
        "loop", FS_HZ, k=K, c=C, moving_mass=M, k_tol=0.01, c_tol=0.001, x_std=X_STD, f_std=F_STD
    )
    cell = noise_kg * (a - slow) + F_STD * random.standard_normal(n)
    force = K * x + (C + dashpot_n_s_per_m) * v + M * a + cell
    channels = {"x_meas": x, "x_cmd": x, "f_meas": force}
    case = Case("loop", model, t, channels, np.ones(n, dtype=np.bool_))
    found = estimate.from_sensors(case)
    assert found is not None
    found = replace(
        found,
        motion=ComputedMotion(x, v, a),
        exact=True,
        force=force,
        whiten=lambda y: y / F_STD,
        pieces=None,
    )
    return ResidualProblem(
        case, motion_evaluated.context_of(case, found), found, effects.catalogue().values()
    )


def earned(problem: ResidualProblem, name: str, *theta: float) -> tuple[float, float, float]:
    """What an effect earns in all that is recorded, by the motion of the test, and its price."""
    effect = effects.catalogue()[name]
    member = Member(effect, Trial(theta))
    with_it = solve(problem, [member], problem.blocks([member]))
    without, driven = solve(problem, [], []), Driven.of(problem)
    assert with_it is not None
    assert without is not None
    assert driven is not None
    wanted = price(problem, effect, effect.settings(problem.ctx, member.trial)[1])
    return without.chi2 - with_it.chi2, driven.gains(with_it)[0], wanted


def test_noise_that_comes_back_as_motion_is_no_mass():
    """Over the acceleration it is one, at 60 Hz alone; the ground moves the specimen up to 3 Hz."""
    everywhere, driven, wanted = earned(problem_of(10.0, 0.0), "inertia")
    assert everywhere > 3.0 * wanted
    assert driven < 0.5 * wanted


def test_dashpot_earns_by_the_motion_of_the_test_what_it_earns_in_all():
    everywhere, driven, wanted = earned(problem_of(0.0, 300.0), "viscous")
    assert driven > 10.0 * wanted
    assert driven == pytest.approx(everywhere, rel=0.1)


@pytest.mark.parametrize("f_hz", [0.8, 1.33, 3.0])
@pytest.mark.parametrize("phase_rad", [0.0, 0.8, 1.6])
def test_late_cell_under_a_sine_that_begins_at_speed_earns_by_it_what_it_earns_in_all(
    f_hz, phase_rad
):
    """A dashpot of the model, far out of its tolerance, stands in for it but for its cost."""
    late_s, f_std, t = 0.01, 0.3 * F_STD, np.arange(int(12 * FS_HZ)) / FS_HZ

    def sine(at_s):
        turning = 5e-3 * np.exp(1j * (2.0 * np.pi * f_hz * at_s + phase_rad))
        return ((turning * (2j * np.pi * f_hz) ** n).imag for n in range(3))

    (x, v, a), (felt, rate, bent) = sine(t), sine(t - late_s)
    noise = f_std * np.random.default_rng(1).standard_normal(t.size)
    force = K * felt + C * rate + M * bent + noise
    model = Model("drive", FS_HZ, k=K, c=C, moving_mass=M, k_tol=0.01, c_tol=0.15, f_std=f_std)
    problem = along(model, t, ComputedMotion(x, v, a), force, unused=20)
    everywhere, driven, wanted = earned(problem, "time_skew", late_s)
    assert everywhere > 5.0 * wanted
    assert driven == pytest.approx(everywhere, rel=0.02)


@pytest.mark.parametrize(("zero", "named"), [(1.0, ()), (-1.0, ()), (20.0, ("bias",))])
def test_zero_error_of_the_displacement_is_no_offset_of_the_load_cell(zero, named):
    """Through the spring it is the same force; one of twenty times the sensor's noise is none."""
    problem, x_std = problem_of(0.0, 0.0), 10.0 * X_STD
    offset = zero * K * x_std
    found = replace(problem.estimate, force=problem.estimate.force + offset)
    assert (offset / F_STD) ** 2 * problem.y.size > 100.0  # plain to see in the force
    case = problem.case.with_model(replace(problem.case.model, x_std=x_std))
    judged = ResidualProblem(case, problem.ctx, found, effects.catalogue().values())
    assert force.search(judged).best.names == named


@pytest.mark.parametrize(("added", "possible"), [(-0.5, True), (-1.5, False)])
def test_relaxation_beside_a_dashpot_that_drives_the_motion_is_no_physical_law(added, possible):
    problem, known = problem_of(0.0, 0.0), effects.catalogue()
    members = (Member(known["viscous"], Trial()), Member(known["maxwell"], Trial((0.05,))))
    betas = (np.array([added * C]), np.array([1e5]))
    unmoved = np.zeros(len(problem.nuisances))
    assert problem.sensible(Fit(members, betas, 0.0, 3, unmoved)) == possible
    # Alone it says that the model's dashpot is wrong, however far.
    assert problem.sensible(Fit(members[:1], betas[:1], 0.0, 1, unmoved))


@pytest.mark.parametrize(("added", "possible"), [(-0.5, True), (-1.5, False)])
@pytest.mark.parametrize("sprung", ["maxwell", "power_damping+maxwell"])
def test_a_dashpot_that_begins_drives_the_motion_beside_whatever_acts_through_a_spring(
    sprung, added, possible
):
    problem, known = problem_of(0.0, 0.0), effects.catalogue()
    shape = (0.05,) if sprung == "maxwell" else (0.5, 1e-4)
    members = (
        Member(onset.Late(known["viscous"]), Trial((3.0,))),
        Member(known[sprung], Trial(shape)),
    )
    betas = (np.array([added * C]), np.array([1e3]))
    fit = Fit(members, betas, 0.0, 3, np.zeros(len(problem.nuisances)))
    assert problem.sensible(fit) == possible


@pytest.mark.parametrize(("apart_s", "possible"), [(0.5, True), (3.0, False)])
def test_effects_that_begin_do_so_in_one_event(apart_s, possible):
    problem, known = problem_of(0.0, 0.0), effects.catalogue()
    members = (
        Member(onset.Late(known["viscous"]), Trial((3.0,))),
        Member(onset.Late(known["stiffness"]), Trial((3.0 + apart_s,))),
    )
    betas = (np.array([0.5 * C]), np.array([0.1]))
    fit = Fit(members, betas, 0.0, 4, np.zeros(len(problem.nuisances)))
    assert problem.sensible(fit) == possible


def test_together_effects_earn_no_less_than_one_of_them_beside_the_others():
    """Of a single effect it is what that one earns; of a dashpot with a needless spring as well."""
    problem = problem_of(0.0, 300.0)
    members = [Member(effects.catalogue()[n], Trial()) for n in ("viscous", "cubic")]
    both, driven = solve(problem, members, problem.blocks(members)), Driven.of(problem)
    assert both is not None
    assert driven is not None
    alone = driven.gains(both)
    assert driven.together(both, (0,)) == pytest.approx(alone[0])
    assert driven.together(both, (0, 1)) == pytest.approx(alone[0], rel=0.1)
    assert driven.together(both, (0, 1)) >= max(alone)


def test_a_filter_of_noise_that_comes_back_earns_nothing_over_a_mass_by_the_motion_of_the_test():
    problem, known = problem_of(-40.0, 0.0), effects.catalogue()
    force = problem.estimate.force + 40.0 * problem.ctx.a
    problem = ResidualProblem(
        problem.case, problem.ctx, replace(problem.estimate, force=force), known.values()
    )
    stiff, mass = (
        Member(known["second_mode"], Trial((20.0, 0.3))),
        Member(known["inertia"], Trial()),
    )
    fits = [solve(problem, [m], problem.blocks([m])) for m in (mass, stiff)]
    driven = Driven.of(problem)
    assert driven is not None
    more = driven.more([stiff], [mass])
    assert fits[0].chi2 - fits[1].chi2 > 100.0
    assert more < 10.0
    assert driven.more([mass], [stiff]) > -more


def pushed(seed: int = 5) -> ResidualProblem:
    """A body under a known force up to 3 Hz, without a load cell, as its model has it.

    Its displacement sensor is noisy from 25 to 30 Hz: the mass makes forces of that noise.
    """
    random, n, w = np.random.default_rng(seed), int(16 * FS_HZ), 2.0 * np.pi
    t = np.arange(n) / FS_HZ
    push, moved = np.zeros(n), np.zeros((3, n), dtype=np.complex128)
    for f_hz, size in ((0.7, 900.0), (1.9, 700.0), (3.1, 500.0)):
        s = 1j * w * f_hz
        swing = size / (K + C * s + M * s**2) * np.exp(s * t)
        push += size * np.cos(w * f_hz * t)
        moved += np.array([swing, s * swing, s**2 * swing])
    x, v, a = moved.real
    for f_hz in np.linspace(25.0, 30.0, 101):
        s, phase = 1j * w * f_hz, w * random.random()
        shown = 1e-7 * random.standard_normal() * np.exp(s * t + 1j * phase)
        x, v, a = x + shown.real, v + (s * shown).real, a + (s**2 * shown).real
    model = Model("forced", FS_HZ, k=K, c=C, moving_mass=M, k_tol=0.01, c_tol=0.15, x_std=X_STD)
    channels = {"x_meas": x, "f_in": push + F_STD * random.standard_normal(n)}
    case = Case("forced", model, t, channels, np.ones(n, dtype=np.bool_))
    found = estimate.from_sensors(case)
    assert found is not None
    found = replace(
        found, motion=ComputedMotion(x, v, a), force=channels["f_in"], whiten=lambda y: y / F_STD,
        pieces=None,
    )  # fmt: skip
    return ResidualProblem(
        case, motion_evaluated.context_of(case, found), found, effects.catalogue().values()
    )


def test_noise_of_a_displacement_is_no_second_mass_of_a_body_without_a_load_cell():
    """A mass on a spring at 25 Hz takes the noise off; the force moves the body up to 3 Hz."""
    problem = pushed()
    everywhere, driven, wanted = earned(problem, "second_mode", 25.0, 0.05)
    assert everywhere > 2.0 * wanted
    assert driven < 0.5 * wanted
    assert asked_for_motion(problem)


def test_load_cell_has_noise_of_its_own_and_is_not_asked_for_the_motion_of_the_test():
    problem = pushed()
    problem.case.channels["f_meas"] = np.zeros(problem.case.t.size)
    assert not asked_for_motion(problem)


def asked_for_motion(problem: ResidualProblem) -> bool:
    """Whether each effect has to show in the motion that the test imposes."""
    null = solve(problem, [], [])
    assert null is not None
    return Gathered(SetFitter(problem), null, lambda _: 1.0)._setting().returns


@pytest.mark.long
def test_dry_friction_in_a_closed_loop_with_a_noisy_cell_is_named(tmp_path):
    d = written(tmp_path, hybrid_test(1, friction_n=60.0), LOOP)
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert d.candidates[0].params["Fc_N"] == pytest.approx(60.0, rel=0.1)


@pytest.mark.long
def test_closed_loop_with_a_noisy_cell_misses_nothing(tmp_path):
    d = written(tmp_path, hybrid_test(1), LOOP)
    assert (d.verdict, d.effects) == ("none", [])
