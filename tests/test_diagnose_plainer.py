"""What need not be there is not named: bristles of a dry contact, an effect that may be zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rthyb_rt import core
from rthyb_rt.diagnose import effects, force, onset, proposals, remainder
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.dictionary import Dictionary
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.evidence import Gathered, held_out_gain
from rthyb_rt.diagnose.fitter import SetFitter
from rthyb_rt.diagnose.force import Search
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.diagnose.refinement import refine, solve
from tests.test_diagnose_nested import yielding
from tests.test_diagnose_steady import fitted

WAY_M = 2e-5


def test_dry_contact_beside_a_damper_is_compared_with_bristles_that_were_found_first() -> None:
    """A contact that shears by a five-hundredth of its motion; the search has tried bristles."""
    problem, fit = fitted(
        lambda t, x, v: 60.0 * yielding(x, WAY_M) / WAY_M + 900.0 * v, "lugre", "viscous"
    )
    fitter = SetFitter(problem)
    fitter.keep(fit)
    proposals._with_dry_friction(fitter)
    twin = fitter.by_names["coulomb", "viscous"]
    assert twin.members[-1].trial.variant == "contact"
    assert twin.members[-1].trial.theta[0] == pytest.approx(WAY_M, rel=0.2)
    assert fitter.score(twin) < fitter.score(fit)


def test_bristles_that_bend_far_are_not_compared_with_a_contact_that_shears_as_far() -> None:
    """A contact of any way would be the same law, and the plainer one of the two."""
    problem, fit = fitted(
        lambda t, x, v: 400.0 * yielding(x, 1.5e-3) / 1.5e-3 + 900.0 * v, "lugre", "viscous"
    )
    fitter = SetFitter(problem)
    fitter.keep(fit)
    proposals._with_dry_friction(fitter)
    assert list(fitter.by_names) == [("lugre", "viscous")]


@pytest.mark.parametrize(
    ("richer", "plain"),
    [
        (Trial((3e-5,), "spread0"), Trial((3e-5,), "contact")),
        (Trial((0.02, 1.0, 3e-5), "contact"), Trial((3e-5,), "contact")),
        (Trial((0.02, 1.0, 4e-4)), Trial((4e-4,))),
        (Trial((0.02, 1.0), "sharp"), Trial((), "sharp")),
    ],
    ids=["bristles", "a peak of a contact", "a peak of a step", "a peak of a body that sticks"],
)
def test_dry_friction_begins_with_the_shape_of_the_richer_law(richer: Trial, plain: Trial) -> None:
    assert effects.catalogue()["coulomb"].like(richer) == plain


@pytest.mark.parametrize(
    ("plain", "grid", "begun"),
    [
        (Trial((3e-5,), "contact"), Trial((0.02, 1.0, 7e-6), "contact"), 3e-5),
        (Trial((4e-4,)), Trial((0.02, 1.0, 1e-3)), 4e-4),
        (Trial((4e-4,)), Trial((0.02, 1.0, 7e-6), "contact"), 7e-6),
        (Trial((), "sharp"), Trial((0.02, 1.0, 1e-3)), 1e-3),
    ],
    ids=["a contact", "a step", "a step, not a contact", "a body that sticks"],
)
def test_friction_with_a_peak_begins_with_the_step_of_dry_friction(
    plain: Trial, grid: Trial, begun: float
) -> None:
    found = effects.catalogue()["stribeck"].beyond(plain, grid)
    assert found == Trial((*grid.theta[:2], begun), grid.variant)


def with_a_peak(t: Floats, x: Floats, v: Floats) -> Floats:
    """Friction that falls from 180 to 60 N, of a contact, beside a dashpot."""
    slides = 60.0 + 120.0 * np.exp(-((v / 0.01) ** 2))
    return np.asarray(slides * yielding(x, WAY_M) / WAY_M + 900.0 * v)


def test_peak_beside_another_law_is_found_from_dry_friction_beside_it() -> None:
    problem, fit = fitted(with_a_peak, "coulomb", "viscous")
    fitter = SetFitter(problem)
    fitter.keep(fit)
    proposals._reform(Dictionary(problem), fitter, dry=True)
    found = fitter.by_names["stribeck", "viscous"]
    assert found.chi2 < 1.1 * problem.y.size < 0.5 * fit.chi2


@pytest.mark.parametrize("more", [[], ["stribeck", "viscous"]], ids=["as before", "the right one"])
def test_evidence_is_scaled_by_what_the_set_found_with_it_leaves(
    monkeypatch: pytest.MonkeyPatch, more: list[str]
) -> None:
    """Dry friction leaves correlated rows; found on the way, the right law leaves none."""
    problem, fit = fitted(with_a_peak, "coulomb", "viscous")
    null, first = solve(problem, [], []), SetFitter(problem)
    assert null is not None
    first.keep(fit)
    right = fitted(with_a_peak, *more)[1].members if more else ()

    def search(_: object, fitter: SetFitter, seeds: list[tuple[Member, ...]]) -> None:
        for members in [*seeds, right]:
            if members:
                fitter.fit(members)

    monkeypatch.setattr(force, "sweep", search)
    dictionary = Dictionary(problem)
    fitter, alone, scale = force._scaled_down(dictionary, first, null)
    best = min(fitter.by_names.values(), key=fitter.score)
    assert best.names == (("stribeck", "viscous") if more else ("coulomb", "viscous"))
    assert scale == 1.0 if more else scale > 2.0
    assert problem.loudness == pytest.approx(np.sqrt(scale))
    assert solve(problem, [], []).chi2 == pytest.approx(alone.chi2)
    assert dictionary.reduced()[2] == pytest.approx(alone.chi2)


def searched(problem: ResidualProblem, *fits: Fit) -> Search:
    """A search that names the first set, and has refined the others."""
    null = refine(problem, ())
    assert null is not None
    return Search(problem, null, list(fits), fits[0], [], 0.0, 0.0, 0.0, 1.0, 1.0)


def masses(least_n: float) -> tuple[ResidualProblem, Fit, Fit]:
    """Friction, and beside it a mass of this force that is not there."""
    problem, alone = fitted(lambda t, x, v: 60.0 * np.sign(v), "coulomb")
    mass = effects.catalogue()["inertia"]
    both = refine(problem, (*alone.members, Member(mass, Trial())))
    assert both is not None
    kg = least_n / float(np.std(problem.ctx.a))
    order = [m.name for m in both.members].index("inertia")
    betas = tuple(np.array([kg]) if i == order else b for i, b in enumerate(both.betas))
    return problem, replace(both, betas=betas), alone


def test_effect_whose_interval_includes_zero_is_not_named_beside_another() -> None:
    problem, both, alone = masses(0.01)
    found = remainder.without_unsure(searched(problem, both, alone), problem.ctx)
    ruling = found.ledger[-1]
    assert (ruling.rule, ruling.part, ruling.against) == ("unsure", "inertia", ("coulomb",))
    assert ruling.found < ruling.wanted
    assert found.forms[0] is both  # what friction was beside the mass widens its interval
    assert found.held_gain == pytest.approx(held_out_gain(problem, alone))


def test_effect_of_a_size_is_named_and_so_are_sets_that_fit_alike() -> None:
    problem, both, alone = masses(40.0)
    assert remainder.without_unsure(searched(problem, both, alone), problem.ctx).best is both
    problem, both, alone = masses(0.01)
    equal = replace(searched(problem, both, alone), equal=[alone])
    assert remainder.without_unsure(equal, problem.ctx) is equal
    # Of a set whose part was never refined nothing else can be named.
    only = searched(problem, both)
    assert remainder.without_unsure(only, problem.ctx) is only


def test_effect_that_what_is_left_makes_uncertain_is_named() -> None:
    """More than noise is left: of a model that states no tolerance, or beside the rest."""
    problem, both, alone = masses(0.01)
    loud = replace(alone, residual=1.5 * alone.residual, chi2=2.25 * alone.chi2)
    left = searched(problem, both, loud)
    assert remainder.without_unsure(left, problem.ctx) is left
    problem.case = replace(problem.case, model=replace(problem.case.model, k_tol=None))
    naive = searched(problem, both, alone)
    assert remainder.without_unsure(naive, problem.ctx) is naive


def test_contact_of_a_body_is_a_spring_that_slips() -> None:
    """Along any motion it has the force of the law, unlike a step that sticks."""
    problem, fit = fitted(lambda t, x, v: 60.0 * yielding(x, WAY_M) / WAY_M, "coulomb")
    ctx, (member,) = problem.ctx, fit.members
    assert member.trial.variant == "contact"
    (element,) = member.effect.on_a_body(ctx, member.trial, fit.betas[0])
    force = core.CoreElement(element).run(ctx.x, ctx.v, ctx.a, ctx.dt)
    law = fit.betas[0][0] * member.effect.columns(ctx, member.trial)[0]
    np.testing.assert_allclose(force, law, atol=1e-6 * 60.0)
    rest = np.zeros_like(ctx.x)
    assert not np.any(core.CoreElement(element).run(rest, rest, rest, ctx.dt))


def test_law_of_a_simulated_body_has_no_onset() -> None:
    _, fit = fitted(lambda t, x, v: 60.0 * np.sign(v), "coulomb")
    (member,) = fit.members
    begun = Member(
        onset.Late(member.effect), Trial((*member.trial.theta, 0.6), member.trial.variant)
    )
    found = force._lasting(replace(fit, members=(begun,)))
    assert found.members == fit.members
    assert found.covariance is None
    assert force._lasting(fit) is fit


@pytest.mark.parametrize("normal_s", [-4e-5, 0.0, 4e-5])
def test_late_load_cell_is_as_late_as_it_is_together_with_the_normal_time_offset(
    normal_s: float,
) -> None:
    """Both delay its rows: 0.12 ms less a normal offset of 0.04 ms is a normal offset."""
    problem, fit = fitted(lambda t, x, v: 0.0 * x, "time_skew")
    null = solve(problem, [], [])
    assert null is not None
    offsets = [normal_s if n.name == "skew" else 0.0 for n in problem.nuisances]
    late = Member(fit.members[0].effect, Trial((1.2e-4,)))
    known = Gathered(SetFitter(problem), null, lambda _: 1.0)
    part = known.of(replace(fit, members=(late,), nuisance=np.array(offsets))).parts[0]
    assert part.offset_s == pytest.approx(1.2e-4 + normal_s)
