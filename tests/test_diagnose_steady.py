"""A law has one set of numbers: what has others early, or in fast motion, stands for another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from diagnose_cases import F_STD, FS, C, K, M, command, moved
from scipy import signal
from scipy.stats import chi2, norm

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects, motion_evaluated, steady
from rthyb_rt.diagnose.case import Case, Floats, Model, ModelBoucWen
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.estimate import Estimate
from rthyb_rt.diagnose.fitted import cost
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.diagnose.refinement import refine

Force = Callable[[Floats, Floats, Floats], Floats]
"""A force that is left out, N, of time, displacement and velocity."""


def along(
    model: Model, t: Floats, motion: ComputedMotion, f_meas: Floats, unused: int = 0
) -> ResidualProblem:
    """A force in white noise along a motion that is known, without some rows at either end."""
    rows, f_std = np.ones(t.size, dtype=np.bool_), model.f_std or 0.0
    rows[:unused] = rows[t.size - unused :] = False
    channels = {"x_meas": motion.x, "x_cmd": motion.x, "f_meas": f_meas}
    case = Case(model.family, model, t, channels, rows)
    found = Estimate(motion, f_meas, rows, lambda y: y / f_std, f_std, True)
    laws = effects.catalogue().values()
    return ResidualProblem(case, motion_evaluated.context_of(case, found), found, laws)


def fitted(
    force: Force, *names: str, seed: int = 1, kind: str = "sweep"
) -> tuple[ResidualProblem, Fit]:
    """The named set, in the shapes that a search would choose, along a motion that is known."""
    x, v, a = moved(command(kind))
    t = np.arange(x.size) / FS
    model = Model("drive", FS, k=K, c=C, moving_mass=M, k_tol=0.01, c_tol=0.15, f_std=F_STD)
    noise = F_STD * np.random.default_rng(seed).standard_normal(x.size)
    f_meas = K * x + C * v + M * a + force(t, x, v) + noise
    problem, laws = along(model, t, ComputedMotion(x, v, a), f_meas), effects.catalogue()
    shapes = product(*(laws[n].trials(problem.ctx) for n in names))
    sets = [[Member(laws[n], s) for n, s in zip(names, own, strict=True)] for own in shapes]
    fits = filter(None, (refine(problem, m) for m in sets))
    physical = filter(problem.sensible, fits)
    return problem, min(physical, key=lambda f: f.chi2 + cost(problem, f))


def changes_of(force: Force, *names: str, seed: int = 1) -> dict[str, float]:
    """How far beyond chance the numbers of a set are others, by part of the recording."""
    return {c.part: c.deviations for c in steady.changes(*fitted(force, *names, seed=seed))}


SECOND_HALF, DIRECTION = "the second half of the recording", "motion in one direction"


@pytest.mark.parametrize(
    ("force", "names", "part"),
    [
        (lambda t, x, v: 3e3 * np.maximum(v, 0.0), ("viscous", "bias"), DIRECTION),
        (lambda t, x, v: 2e3 * v * (t > 4.0), ("viscous",), SECOND_HALF),
    ],
    ids=["a damper that grips one way only", "a damper that wears in"],
)  # fmt: skip
def test_laws_that_stand_in_for_another_have_other_numbers_elsewhere(
    force: Force, names: tuple[str, ...], part: str
) -> None:
    found = changes_of(force, *names)
    assert max(found, key=found.__getitem__) == part
    assert found[part] > POLICY.changed_numbers


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("force", "names"),
    [
        (lambda t, x, v: 2e3 * v, ("viscous",)),
        (lambda t, x, v: 60.0 * np.sign(v) + 4e8 * x**3, ("coulomb", "cubic")),
        (lambda t, x, v: (40.0 + 50.0 * np.exp(-((v / 0.02) ** 2))) * np.sign(v), ("stribeck",)),
        (lambda t, x, v: 20.0 + 10.0 * t, ("drift", "bias")),
    ],
    ids=["a damper", "friction and a hardening spring", "a Stribeck peak", "a cell that drifts"],
)  # fmt: skip
def test_a_law_has_the_same_numbers_everywhere(
    force: Force, names: tuple[str, ...], seed: int
) -> None:
    assert max(changes_of(force, *names, seed=seed).values()) < POLICY.changed_numbers


@pytest.mark.parametrize("part", [1.0, 0.98, 0.95])
def test_the_form_of_a_law_is_no_change_of_its_numbers(part: float) -> None:
    """A damper of a power of velocity near one: a smooth function of velocity times a dashpot."""
    found = changes_of(lambda t, x, v: 2e3 * np.sign(v) * np.abs(v) ** part, "viscous")
    assert max(found.values()) < POLICY.changed_numbers


@pytest.mark.parametrize("sigma0_n_per_m", [100e3, 200e3, 400e3])
def test_bristles_with_a_peak_in_sliding_have_the_same_numbers_everywhere(
    sigma0_n_per_m: float,
) -> None:
    """Bristles that slide at 150 N, and at 90 N more in slow motion: LuGre without its damping."""

    def held(t: Floats, x: Floats, v: Floats) -> Floats:
        slides = 150.0 * (1.0 + 0.6 * np.exp(-((v / 0.02) ** 2)))
        end = slides * np.sign(v) / sigma0_n_per_m
        passed = np.exp(-np.abs(v) / FS * sigma0_n_per_m / slides)
        z, out = 0.0, []
        for towards, left in zip(end, passed, strict=True):
            z = float(towards + (z - towards) * left)
            out.append(sigma0_n_per_m * z)
        return np.array(out)

    assert max(changes_of(held, "lugre").values()) < POLICY.changed_numbers


@pytest.mark.parametrize("power", [0.8, 1.0, 1.3, 1.6])
def test_wear_by_another_law_of_travel_is_no_change_of_its_numbers(power: float) -> None:
    def lost(t: Floats, x: Floats, v: Floats) -> Floats:
        travel = np.cumsum(np.abs(np.diff(x, prepend=x[0])))
        return 0.12 * K * x * np.expm1(-((travel / (0.3 * travel[-1])) ** power))

    found = changes_of(lost, "degradation")
    assert max(found.values()) < POLICY.changed_numbers


def worn_by(variant: str, x: Floats, force: Floats) -> Floats:
    """Share of what a specimen goes through in all, at every row: by its work or its amplitude."""
    step = np.abs(np.diff(x, prepend=x[0]))
    most = np.maximum.accumulate(np.abs(x))
    gone = np.cumsum(np.abs(force) * step) if "work" in variant else most
    return gone / gone[-1]


@pytest.mark.parametrize("variant", ["loop, work", "loop, amplitude"])
def test_wear_by_work_or_by_amplitude_is_told_from_wear_by_travel(variant: str) -> None:
    """Its loss, and that the same element of a rig file has this force."""
    problem, fit = fitted(
        lambda t, x, v: 0.2 * K * x * np.expm1(-worn_by(variant, x, K * x) / 0.4),
        "degradation", kind="steps",
    )  # fmt: skip
    (member,), (beta,) = fit.members, fit.betas
    assert member.trial.variant == variant
    assert beta[0] == pytest.approx(0.2, rel=0.03)
    elements = member.effect.elements(problem.ctx, member.trial, beta)
    assert elements is not None
    x, v, a = problem.ctx.x, problem.ctx.v, problem.ctx.a
    force = core.CoreElement(elements[0]).run(x, v, a, 1.0 / FS)
    exact = K * x + beta[0] * member.effect.columns(problem.ctx, member.trial)[0]
    np.testing.assert_allclose(force, exact, atol=2e-3 * K * float(np.max(np.abs(x))))


def test_wear_by_amplitude_that_was_reached_at_the_start_is_told_with_some_travel() -> None:
    """A body let go from 6 mm: what it loses by 3 mm was lost before the first row."""
    t = np.arange(2000) / FS
    x = 6e-3 * np.cos(9.0 * t)
    motion = ComputedMotion(x, -54e-3 * np.sin(9.0 * t), -81.0 * x)
    model = Model("drive", FS, k=K, c=C, moving_mass=M, k_tol=0.01, f_std=F_STD)
    ctx = Context(model, motion, t, K * motion.x, {})
    law = effects.catalogue()["degradation"]
    told = law.report(ctx, Trial((3e-3,), "loop, amplitude"), np.array([0.2]))
    assert told["travel_m"] == ctx.travel[0] == 6e-3  # the shortest path there
    yields = replace(model, bouc_wen=ModelBoucWen(1.0, 2e-3, 2.0, 0.5, 0.5))
    ctx = Context(yields, motion, t, K * motion.x, {})
    assert law.elements(ctx, Trial((30.0,), "loop, work"), np.array([0.2])) is None
    assert law.elements(ctx, Trial((3e-3,), "all"), np.array([0.2])) is not None


def test_a_spring_that_breaks_at_once_does_not_wear() -> None:
    found = changes_of(lambda t, x, v: -0.1 * K * x * (t > 4.0), "degradation")
    assert max(found, key=found.__getitem__) == SECOND_HALF
    assert found[SECOND_HALF] > POLICY.changed_numbers


@pytest.mark.parametrize("share", [0.02, 0.05, 0.08])
def test_a_damper_that_warms_by_some_per_cent_is_still_that_damper(share: float) -> None:
    found = changes_of(lambda t, x, v: 2e3 * v * (1.0 - share * (t > 4.0)), "viscous")
    assert max(found.values()) < POLICY.changed_numbers
    worn = changes_of(lambda t, x, v: 2e3 * v * (1.0 - 0.4 * (t > 4.0)), "viscous")
    assert worn[SECOND_HALF] > POLICY.changed_numbers


@pytest.mark.parametrize(("width_m_per_s", "judged"), [(1e-4, 4), (0.02, 5)])
def test_width_of_a_jump_between_two_rows_is_no_number_of_a_law(
    width_m_per_s: float, judged: int
) -> None:
    """It decides the force while the actuator rests, which dry friction does not determine."""

    def rubs(t: Floats, x: Floats, v: Floats) -> Floats:
        return (90.0 + 80.0 * np.exp(-np.abs(v / 0.08))) * np.tanh(v / width_m_per_s)

    problem, _ = fitted(rubs, "viscous")
    law = Member(effects.catalogue()["stribeck"], Trial((0.08, 1.0, width_m_per_s)))
    fit = refine(problem, [law])
    assert fit is not None
    assert {c.count for c in steady.changes(problem, fit)} == {judged}


def coloured(problem: ResidualProblem, fit: Fit, pole: float) -> tuple[ResidualProblem, Fit]:
    """The set in noise of the first order, as the estimate of such a recording filters it."""
    found = replace(
        problem.estimate, whiten=lambda y: signal.lfilter([1.0, -pole], [1.0], y) / F_STD
    )
    other = ResidualProblem(problem.case, problem.ctx, found, problem.effects)
    again = refine(other, fit.members)
    assert again is not None
    return other, again


def test_friction_of_which_some_readings_are_a_row_late_is_the_same_everywhere() -> None:
    """In slow noise, a wrong row at a reversal weighs most; friction that grows still shows."""

    def rubs(more: float) -> Force:
        def force(t: Floats, x: Floats, v: Floats) -> Floats:
            late = np.where((v > 0.0) & (np.arange(v.size) % 2 == 0), np.roll(v, 1), v)
            return 90.0 * np.sign(late) * (1.0 + more * (t > 4.0))

        return force

    same = steady.changes(*coloured(*fitted(rubs(0.0), "coulomb"), 0.95))
    assert max(c.deviations for c in same) < POLICY.changed_numbers
    grown = {
        c.part: c.deviations for c in steady.changes(*coloured(*fitted(rubs(0.8), "coulomb"), 0.95))
    }
    assert grown[SECOND_HALF] > POLICY.changed_numbers


def test_friction_that_turns_late_after_one_reversal_is_the_same_in_both_directions() -> None:
    """By two rows, once the motion is upwards: only a part that fades out at reversals shows it."""

    def force(t: Floats, x: Floats, v: Floats) -> Floats:
        return 90.0 * np.sign(np.where(v > 0.0, np.roll(v, 2), v))

    assert changes_of(force, "coulomb")[DIRECTION] < POLICY.changed_numbers


def earned(force: Force, *names: str) -> tuple[float, float]:
    """What the last effect earns beside the law before it: as that is, and in any form of it."""
    problem, both = fitted(force, *names)
    alone = refine(problem, fitted(force, *names[:-1])[1].members)
    assert alone is not None
    return alone.chi2 - both.chi2, steady.past_forms(problem, alone, both)


def test_damping_beside_friction_with_another_law_of_its_peak_is_its_form() -> None:
    """A peak that falls with the power -2 of velocity (Hess and Soom, J. Tribol. 112, 1990)."""

    def peak(t: Floats, x: Floats, v: Floats) -> Floats:
        return (150.0 + 900.0 / (1.0 + (v / 0.02) ** 2)) * np.sign(v)

    as_it_is, in_any_form = earned(peak, "stribeck", "quad_damping")
    assert as_it_is > 100.0
    assert in_any_form < 0.4 * as_it_is


def chain(t: Floats, x: Floats, v: Floats) -> Floats:
    """Springs that slip in turn, their yields crowded at both ends of their range."""
    yields = 3e-3 * (1.0 + 0.95 * np.cos(np.pi * (np.arange(400) + 0.5) / 400))
    slip, force = np.zeros(yields.size), np.empty_like(x)
    for i, now in enumerate(x):
        slip = np.clip(slip, now - yields, now + yields)
        force[i] = 0.6 * K * float(np.mean(now - slip) - now)
    return force


def test_pinching_beside_a_loop_of_another_form_is_that_form() -> None:
    """No function of displacement and velocity has a memory; other loops have."""
    as_it_is, in_any_form = earned(chain, "hysteresis", "pinching")
    assert as_it_is > 50.0
    assert in_any_form < 0.3 * as_it_is


def test_a_spring_that_is_there_beside_friction_is_no_form_of_it() -> None:
    """Friction that changes with displacement does not change its sign with it."""
    as_it_is, in_any_form = earned(
        lambda t, x, v: 90.0 * np.sign(v) + 1e8 * x**3, "coulomb", "cubic"
    )
    assert as_it_is > 100.0
    assert in_any_form > 0.8 * as_it_is


def test_what_an_effect_earns_beside_any_form_is_that_of_least_squares_with_all_columns() -> None:
    """A second formulation: the priors as rows of their own, solved by singular values."""
    problem, both = fitted(lambda t, x, v: 90.0 * np.sign(v) + 300.0 * v, "coulomb", "viscous")
    alone = refine(problem, both.members[:1])
    assert alone is not None
    force = (
        alone.betas[0][0] * alone.members[0].effect.columns(problem.ctx, alone.members[0].trial)[0]
    )
    ctx, near = problem.ctx, []
    for values, reach in ((ctx.x, ctx.x_range), (ctx.v, ctx.v_range)):
        u = np.clip(values / reach, -1.0, 1.0)
        near += [force * np.cos(k * np.arccos(u)) for k in range(1, 5)]
    least = []
    for fit in (alone, both):
        own = [*fit.betas[0:1], *fit.betas[1:]]
        blocks = [c for m in fit.members for c in m.effect.columns(ctx, m.trial)] + [
            n.column for n in problem.nuisances
        ]
        design = np.column_stack([problem.seen(c) for c in (*blocks, *near)])
        sigma = [np.inf] * len(np.concatenate(own)) + [n.sigma for n in problem.nuisances]
        sigma += [POLICY.form_error] * len(near)
        rows = np.diag([0.0 if not s else 1.0 / s for s in sigma])
        # Friction's width is a shape, which both sets may change as well.
        slope = steady.design_of(problem, fit)[:, : sum(len(m.trial.theta) for m in fit.members)]
        design = np.vstack(
            [np.column_stack([design, slope]), np.pad(rows, ((0, 0), (0, slope.shape[1])))]
        )
        y = np.r_[problem.y, np.zeros(len(sigma))]
        left = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
        least.append(float(left @ left))
    assert steady.past_forms(problem, alone, both) == pytest.approx(least[0] - least[1], rel=1e-3)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("deviations", [0.0, 1.0, 2.0, 3.5])
def test_chance_is_that_of_chi_squared(count: int, deviations: float) -> None:
    fall = float(chi2.isf(norm.sf(deviations), count))
    assert steady.Change("", fall, count).deviations == pytest.approx(deviations, abs=0.15)


def test_change_that_explains_as_little_as_the_form_of_a_law_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Friction of 1000 N whose peak of 5 % is 2.5 times as wide from mid-test on."""

    def force(t: Floats, x: Floats, v: Floats) -> Floats:
        wide = 0.02 * np.where(t > 4.0, 2.5, 1.0)
        return 1000.0 * (1.0 + 0.05 * np.exp(-((v / wide) ** 2))) * np.sign(v)

    problem, fit = fitted(force, "stribeck")
    assert not steady.differs(problem, fit)
    monkeypatch.setattr(steady, "_least_of_one", lambda *_: 0.0)
    assert steady.differs(problem, fit)


@pytest.mark.parametrize(
    ("force", "names"),
    [
        (lambda t, x, v: 600.0 * np.sign(v) + 14.0 * (t > 4.0), ("bias", "coulomb")),
        (lambda t, x, v: 300.0 * np.sign(v) + 200.0 * v * (t > 4.0), ("coulomb", "viscous")),
        (lambda t, x, v: 3e3 * np.sign(v) + 4e8 * x**3 * (1.0 + (t > 4.0)), ("coulomb", "cubic")),
    ],
    ids=["an offset", "a dashpot", "a spring that hardens twice as much"],
)  # fmt: skip
def test_strong_friction_does_not_hide_that_a_weak_law_begins_in_mid_test(
    force: Force, names: tuple[str, ...]
) -> None:
    """What a change explains is compared with its own law, not with the friction beside it."""
    assert changes_of(force, *names)[SECOND_HALF] > POLICY.changed_numbers
