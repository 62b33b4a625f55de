"""What is said of a recording, by evidence made by hand: each rule, and the sets that fit alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from rthyb_rt.diagnose import engine, remainder
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.verdict import (
    TURNS,
    Coarse,
    Left,
    Moved,
    Reproduced,
    Rounded,
    Seen,
    Simulated,
    Verdict,
    judge,
    lost_in_form,
    needs_nothing,
    understood,
    within_rounding,
)

MET = Simulated(0.5, 0.5, 0.001, 0.001)
"""What the model alone makes of a motion that it is good for."""
FRICTION = Left(names=("coulomb",), laws=1, before=50.0, after=0.02, price=20.0)
"""A load cell's force that friction explains down to the noise."""
NOTHING = Left(before=0.02, after=0.02)
COARSE = Rounded("quantisation", gain=30.0, beyond=0.001, beyond_best=0.001)


def said(seen: Seen, less: tuple[str, ...] = (), **answers: Any) -> Verdict:
    """What is said with these answers; else neither data sheet nor motion explains it."""
    given: dict[Any, Any] = {
        "sheet": False,
        "simulated": None,
        "reproduced": None,
        "strength": 100.0,
        "changes": {},
        "varying": -50.0,
        "stroke": -50.0,
        "memory": -50.0,
        **answers,
    }
    while not isinstance(done := judge(seen, POLICY, less), Verdict):
        seen = replace(seen, known={**seen.known, done: given[done]})
    return done


# ---- what is left ------------------------------------------------------------------------------


def test_what_ends_at_the_noise_is_explained() -> None:
    assert said(Seen(FRICTION)).names == ("coulomb",)
    assert said(Seen(FRICTION)).said == "explained"
    assert said(Seen(NOTHING)).said == "none"


def test_a_set_may_leave_the_form_of_its_law_and_less_the_more_laws_it_has() -> None:
    left = replace(FRICTION, after=0.04 * FRICTION.before)
    assert said(Seen(left)).said == "explained"
    pair = replace(left, names=("coulomb", "cubic"), laws=2)
    assert said(Seen(pair)).said == "unknown"
    naive = replace(pair, naive=True)
    assert said(Seen(naive)).said == "explained"
    estimated = replace(
        left, after=0.12 * left.before, exact=False, part_before=0.9, part_after=0.1
    )
    assert said(Seen(estimated)).said == "explained"
    # A moment at which a law begins may be moved to meet much.
    assert said(Seen(replace(estimated, late=True))).said == "unknown"


def test_a_sheet_that_states_too_little_noise_is_no_finding() -> None:
    left = replace(FRICTION, before=0.5, after=0.4)
    assert said(Seen(left)).said == "explained"
    assert said(Seen(replace(left, scale=2.0))).said == "unknown"


def test_noise_of_any_colour_has_to_be_within_the_sheet() -> None:
    left = replace(FRICTION, before=0.5, after=0.4, coloured=True)
    assert said(Seen(left)).said == "unknown"
    assert said(Seen(left), sheet=True).said == "explained"


def test_noise_of_a_free_colour_hides_no_more_of_a_clear_finding_than_the_form_of_a_law() -> None:
    """A crosstalk of 30 times the noise of its data sheet, of which a thousandth stays."""
    left = replace(FRICTION, before=30.0, coloured=True, loud=True, of_force=1e-3)
    assert said(Seen(left)).said == "explained"
    assert said(Seen(replace(left, of_force=2e-3))).said == "unknown"
    assert said(Seen(replace(left, bent_after=4.1))).said == "unknown"
    assert said(Seen(replace(left, loud=False))).said == "unknown"


def test_what_a_set_leaves_where_coloured_noise_is_weak_is_small_if_it_is_so_in_the_force() -> None:
    """A stop met with a blow: 6 % of its misfit in units of the noise, .5 % of its force."""
    left = replace(FRICTION, before=12.4, after=0.76, coloured=True, loud=True, of_force=0.005)
    assert said(Seen(left)).said == "explained"
    assert said(Seen(replace(left, of_force=POLICY.left_stated[0]))).said == "unknown"
    assert said(Seen(replace(left, loud=False))).said == "unknown"
    assert said(Seen(replace(left, coloured=False))).said == "unknown"


def test_what_a_naive_model_leaves_is_measured_in_the_force_whatever_its_colour() -> None:
    """Noise of a free colour takes up the form of its laws, and shows less of it than there is."""
    left = replace(FRICTION, before=0.5, after=0.01, coloured=True, naive=True, of_force=0.2)
    assert said(Seen(left)).said == "explained"
    assert said(Seen(replace(left, of_force=POLICY.left_naive))).said == "unknown"
    assert said(Seen(replace(left, of_force=0.9, after=0.3, before=1.8))).said == "unknown"
    stated = replace(left, naive=False)
    assert said(Seen(stated)).said == "unknown"


@pytest.mark.long
def test_part_of_the_residual_that_a_set_leaves_is_taken_from_the_force_itself() -> None:
    """Friction of 40 N that a naive spring lacks: it leaves the noise, half of it half of it."""
    n, fs_hz, noise = 1024, 256.0, 1.0
    t = np.arange(n) / fs_hz
    x, v = 0.01 * np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)
    sensors = np.random.default_rng(2)
    channels = {
        "x_meas": x + 1e-6 * sensors.standard_normal(n),
        "f_meas": 1e4 * x + 40.0 * np.sign(v) + noise * sensors.standard_normal(n),
    }
    model = Model("drive", fs_hz, 9e3, 10.0, 0.0, x_std=1e-6, f_std=noise)
    search = engine.diagnose(Case("f", model, t, channels, np.ones(n, dtype=np.bool_))).force
    assert search is not None
    assert search.best.names == ("coulomb",)
    assert remainder.left_of(replace(search, best=search.null)).of_force == 1.0
    half = replace(search.best, betas=tuple(0.5 * b for b in search.best.betas))
    half = replace(half, nuisance=0.5 * (half.nuisance + search.null.nuisance))
    assert remainder.left_of(replace(search, best=half)).of_force == pytest.approx(0.25, abs=0.02)
    # In white noise it is what is left in units of the noise.
    left = remainder.left_of(search)
    assert left.of_force == pytest.approx(left.after / left.before, rel=0.05)


def test_noise_of_a_colour_that_comes_in_bursts_is_no_noise_however_little_stays() -> None:
    """Along an estimated motion nothing stays at all once the noise is what the set leaves."""
    left = replace(FRICTION, before=-0.1, after=-0.2, coloured=True, exact=False, part_before=0.9)
    assert said(Seen(left)).said == "unknown"
    assert said(Seen(replace(left, coloured=False))).said == "explained"
    assert said(Seen(left), sheet=True, strength=None).said == "explained"


def test_numbers_that_change_by_chance_are_those_of_one_law() -> None:
    assert said(Seen(FRICTION), changes={"fast motion": POLICY.changed_numbers}).said == "explained"
    # A naive model's laws are all of another form; a simulated motion is fitted as a whole.
    naive, moved = replace(FRICTION, naive=True), replace(FRICTION, moved=True)
    assert said(Seen(naive), changes={"fast motion": 9.0}).said == "explained"
    assert said(Seen(moved), changes={"fast motion": 9.0}).said == "explained"


def test_small_colour_that_no_law_earns_its_price_for_is_no_finding() -> None:
    left = Left(before=0.2, after=0.2)
    assert said(Seen(left)).said == "none"
    assert said(Seen(replace(left, coloured=True))).said == "unknown"
    assert said(Seen(replace(left, before=0.5, after=0.5))).said == "unknown"
    assert said(Seen(replace(left, before=0.5, after=0.5, naive=True))).said == "none"


def test_a_simulated_motion_that_is_the_measured_one_has_the_force_for_it() -> None:
    left = replace(FRICTION, moved=True, after=0.5)
    assert said(Seen(left)).said == "explained"
    assert said(Seen(replace(left, after=0.03 * left.before))).said == "unknown"
    assert said(Seen(replace(left, after=0.03 * left.before, quiet=True))).said == "explained"


def test_better_noise_never_makes_it_unknown() -> None:
    for before in (0.05, 0.2, 1.0, 50.0):
        known = [
            understood(replace(FRICTION, before=before, after=part * before), POLICY, lambda: False)
            for part in (1.0, 0.3, 0.1, 0.03, 0.01, 0.0)
        ]
        assert known == sorted(known)


def test_a_doubtful_set_is_no_law_missing_from_a_model_that_leaves_only_noise() -> None:
    small = replace(FRICTION, before=0.05)
    for answers in ({"changes": {"fast motion": 6.0}}, {"varying": 60.0}):
        assert said(Seen(FRICTION), **answers).said == "unknown"
        assert said(Seen(small), **answers).said == "none"
        for change in ({"loud": True}, {"bent": 5.0}):
            assert said(Seen(replace(small, **change)), **answers).said == "unknown"


def test_a_law_for_a_free_body_has_to_move_it_as_it_was_moved() -> None:
    """The balance takes its force from the motion; only the simulation shows that it makes it."""
    poor, model_alone = Reproduced(400.0, 40.0), Reproduced(0.3, 0.6)
    diverges = Reproduced(400.0, np.inf)
    assert said(Seen(FRICTION), reproduced=poor).said == "unknown"
    assert said(Seen(FRICTION), reproduced=diverges).said == "unknown"
    assert said(Seen(FRICTION), reproduced=model_alone).said == "none"
    assert said(Seen(FRICTION), reproduced=replace(model_alone, bent=9.0)).said == "unknown"
    assert said(Seen(FRICTION), reproduced=replace(poor, quiet_before=True)).said == "none"
    for enough in (replace(poor, quiet=True), replace(poor, after=0.4), replace(poor, after=7.0)):
        assert said(Seen(FRICTION), reproduced=enough).said == "explained"
    # Two laws leave less than one because of their form.
    pair = replace(FRICTION, names=("coulomb", "cubic"), laws=2)
    assert said(Seen(pair), reproduced=replace(poor, after=7.0)).said == "unknown"
    # What was found by its motion has been compared with it.
    assert said(Seen(replace(FRICTION, moved=True)), reproduced=poor).said == "explained"


# ---- rules that turn it -------------------------------------------------------------------------

DELAY_RATE = Moved(names=("delay_rate",), exact=False)
BLURRED = replace(FRICTION, exact=False, part_before=1e-4)
SPRINGS = Left(
    names=("cubic", "quadratic", "stopper"), laws=3, curves=3, before=50.0, after=0.4, price=60.0
)
RULES: dict[str, tuple[Seen, dict[str, Any], str, str]] = {
    "blur": (Seen(BLURRED), {}, "none", "explained"),
    "motion": (Seen(FRICTION), {"simulated": MET}, "none", "explained"),
    "reproduced": (
        Seen(FRICTION), {"reproduced": Reproduced(before=400.0, after=40.0)},
        "unknown", "explained",
    ),
    "chance": (
        Seen(replace(FRICTION, before=0.05, coloured=True)),
        {"sheet": True, "strength": 10.0}, "none", "explained",
    ),
    "leftover": (
        Seen(replace(FRICTION, before=0.13, after=0.085), DELAY_RATE), {},
        "explained", "explained",
    ),
    "weak": (
        Seen(replace(FRICTION, names=("coulomb", "gap"), laws=2)), {"strength": 1.0},
        "unknown", "explained",
    ),
    "steady": (
        Seen(FRICTION), {"changes": {"fast motion": 6.0, "large displacements": 0.3}},
        "unknown", "explained",
    ),
    "curves": (Seen(SPRINGS), {}, "unknown", "explained"),
    "varying": (Seen(FRICTION), {"varying": 60.0}, "unknown", "explained"),
    "stroke": (Seen(FRICTION), {"stroke": 60.0}, "unknown", "explained"),
    "memory": (Seen(FRICTION), {"memory": 60.0}, "unknown", "explained"),
    "steps": (
        Seen(replace(NOTHING, before=1.0, after=1.0), rounding=COARSE), {},
        "explained", "unknown",
    ),
}  # fmt: skip
"""Of each rule evidence, answers to what is asked, and what is said with and without the rule."""


@pytest.mark.parametrize("rule", RULES)
def test_each_rule_turns_what_is_said(rule: str) -> None:
    seen, answers, turned, without = RULES[rule]
    verdict = said(seen, **answers)
    assert (verdict.said, [r.rule for r in verdict.ledger]) == (turned, [rule])
    assert said(seen, (rule,), **answers).said == without


def test_beside_an_effect_of_the_actuator_a_force_explains_most_of_what_may_be_noise() -> None:
    """The motion is simulated with that effect, whose formula is not exact."""
    small = replace(FRICTION, before=0.13, after=0.085)
    assert said(Seen(small, DELAY_RATE)).names == ("delay_rate",)
    both = ("delay_rate", "coulomb")
    assert said(Seen(replace(small, after=0.05), DELAY_RATE)).names == both
    # More than noise, or than the load cell's sheet, or no such motion.
    assert said(Seen(replace(small, before=0.3, after=0.09), DELAY_RATE)).names == both
    assert said(Seen(replace(small, loud=True), DELAY_RATE)).names == both
    assert said(Seen(small, Moved())).names == ("coulomb",)
    assert said(Seen(small, Moved(("delay",)))).names == ("delay", "coulomb")
    assert said(Seen(small)).names == ("coulomb",)
    assert said(Seen(replace(small, bent=4.0), DELAY_RATE)).said == "unknown"


@pytest.mark.parametrize(
    "left",
    [{"quiet": True}, {"after": 0.05}, {"curves": 2}, {"naive": True}],
    ids=["the motion to its noise", "only noise left", "two", "naive model"],
)
def test_springs_that_leave_nothing_or_are_few_are_no_mere_curve(left: dict[str, Any]) -> None:
    assert said(Seen(replace(SPRINGS, **left))).names == SPRINGS.names


def test_a_finding_without_which_noise_would_be_larger_than_its_sheet_is_no_chance() -> None:
    seen, answers, *_ = RULES["chance"]
    assert seen.force is not None
    loud = replace(seen, force=replace(seen.force, loud=True))
    assert said(loud, **answers).names == FRICTION.names


def test_a_naive_model_that_leaves_a_good_part_of_the_force_lacks_something() -> None:
    """Its stiffness and damping were fitted: what they leave is more than their error."""
    poor = replace(NOTHING, before=40.0, after=40.0, naive=True)
    assert said(Seen(replace(poor, part_before=0.1)), sheet=False).said == "none"
    assert said(Seen(replace(poor, part_before=0.8)), sheet=False).said == "unknown"


def test_every_rule_has_its_evidence() -> None:
    assert set(RULES) == set(TURNS)


def test_numbers_of_the_model_are_named_within_the_blur_too() -> None:
    seen = Seen(replace(BLURRED, names=("stiffness",), stated=frozenset({"stiffness"})))
    assert said(seen).names == ("stiffness",)
    bent = Seen(replace(BLURRED, bent=5.0))
    assert said(bent).names == ("coulomb",)


def test_blur_of_an_estimated_motion_excuses_nothing_that_the_motion_itself_shows() -> None:
    """Near resonance a force within the blur moves a body by far more than its sensor's noise."""
    missed = replace(MET, nrmse=0.05)
    assert said(Seen(BLURRED), simulated=missed).names == ("coulomb",)
    assert said(Seen(BLURRED), simulated=MET).said == "none"
    # Whether the set may stay is decided by what it simulates itself.
    poor = Reproduced(before=400.0, after=40.0)
    assert said(Seen(BLURRED), simulated=missed, reproduced=poor).said == "unknown"


@pytest.mark.parametrize(
    "made",
    [
        replace(MET, k_off=4.0), replace(MET, c_off=4.0), replace(MET, nrmse=0.02),
        replace(MET, nrmse=0.006),
    ],
    ids=["stiffness bent", "damping bent", "motion missed", "beyond the sensor's noise"],
)  # fmt: skip
def test_a_model_that_does_not_simulate_the_motion_says_nothing(made: Simulated) -> None:
    assert said(Seen(FRICTION), simulated=made).said == "explained"


@pytest.mark.parametrize(
    "left",
    [{"names": ("coulomb",)}, {"equal": (("lugre",),)}, {"naive": True}, {"moved": True}],
    ids=["alone", "others fit as well", "naive model", "simulated motion"],
)
def test_a_size_that_may_be_zero_is_no_substitute_there(left: dict[str, Any]) -> None:
    seen, answers, *_ = RULES["weak"]
    assert seen.force is not None
    verdict = said(replace(seen, force=replace(seen.force, **left)), **answers)
    assert verdict.said in ("explained", "ambiguous")


def test_an_effect_as_strong_as_its_price_is_no_chance() -> None:
    seen = RULES["chance"][0]
    answers = {"sheet": True}
    assert said(seen, **answers, strength=25.0).names == ("coulomb",)
    assert said(seen, **answers, strength=None).names == ("coulomb",)


def test_what_stays_closer_than_rounding_is_a_law() -> None:
    close = replace(COARSE, beyond=0.015, beyond_best=0.001)
    assert said(Seen(FRICTION, rounding=close)).names == ("coulomb", "quantisation")
    assert said(Seen(FRICTION, rounding=COARSE)).names == ("quantisation",)
    strong = replace(COARSE, gain=500.0)
    assert said(Seen(FRICTION, rounding=strong)).names == (
        "coulomb", "quantisation",
    )  # fmt: skip
    bent = Seen(replace(FRICTION, bent=5.0), rounding=COARSE)
    assert said(bent).names == ("coulomb", "quantisation")


def test_rounding_explains_less_than_a_law_beside_a_naive_model() -> None:
    seen = Seen(replace(FRICTION, naive=True), rounding=replace(COARSE, share=1e-3))
    assert lost_in_form(seen, POLICY)
    assert not lost_in_form(replace(seen, rounding=COARSE), POLICY)
    assert not lost_in_form(replace(seen, force=FRICTION), POLICY)
    assert not lost_in_form(replace(seen, force=replace(NOTHING, naive=True)), POLICY)


# ---- rounding chooses among sets ----------------------------------------------------------------


def test_a_right_law_is_never_off_by_more_than_half_a_step() -> None:
    best = Coarse(("stribeck",), 3, 900.0, 0.1)
    inside = Coarse(("coulomb",), 1, 950.0, 0.001)
    assert within_rounding((best, inside), (), POLICY) == (("coulomb",), ())
    alike = replace(inside, names=("gap",), chi2=955.0)
    assert within_rounding((best, inside, alike), (), POLICY) == (("coulomb",), (("gap",),))
    both = replace(best, names=("coulomb", "cubic"), beyond=0.001)
    assert within_rounding((both, inside), (), POLICY)[0] == ("coulomb",)
    assert within_rounding((replace(best, beyond=0.001), alike), (("gap",),), POLICY) == (
        ("stribeck",), (("gap",),),
    )  # fmt: skip


# ---- actuator and force together ----------------------------------------------------------------


def test_sets_of_actuator_and_force_that_fit_alike_are_all_told() -> None:
    left = replace(FRICTION, equal=(("gap",),))
    found = said(Seen(left, Moved(("delay",))))
    assert found.said == "ambiguous"
    assert found.names == ("delay", "coulomb")
    assert found.sets == (("coulomb", "delay"), ("delay", "gap"))
    lag = said(Seen(FRICTION, Moved(("delay",), (("oil_column",),))))
    assert lag.sets == (("coulomb", "delay"), ("coulomb", "oil_column"))


def test_what_is_not_known_of_the_actuator_leaves_all_unknown() -> None:
    found = said(Seen(FRICTION, Moved(("delay",), known=False)))
    assert (found.said, found.names, found.sets) == ("unknown", (), ())
    assert said(Seen(None, Moved(("delay",)))).names == ("delay",)
    assert said(Seen(None, None, COARSE)).names == ("quantisation",)
    assert said(Seen()).said == "none"


# ---- any evidence ------------------------------------------------------------------------------

LEFT = st.builds(
    Left,
    names=st.sampled_from([(), ("coulomb",), ("stiffness",), ("coulomb", "cubic")]),
    laws=st.integers(0, 3),
    curves=st.integers(0, 3),
    before=st.floats(-0.1, 1e3),
    after=st.floats(-0.1, 1e3),
    scale=st.floats(1.0, 10.0),
    part_before=st.floats(0.0, 0.1),
    part_after=st.floats(0.0, 0.1),
    bent=st.floats(0.0, 10.0),
    stated=st.just(frozenset({"stiffness"})),
    price=st.floats(0.0, 100.0),
    naive=st.booleans(),
    exact=st.booleans(),
    coloured=st.booleans(),
    moved=st.booleans(),
    quiet=st.booleans(),
    late=st.booleans(),
    cell=st.booleans(),
    loud=st.booleans(),
)
ANSWERS = st.fixed_dictionaries(
    {
        "sheet": st.booleans(),
        "simulated": st.none() | st.just(MET),
        "reproduced": st.none()
        | st.builds(
            Reproduced,
            st.floats(-0.1, 1e6),
            st.floats(-0.1, np.inf),
            st.floats(0.0, 10.0),
            st.booleans(),
            st.booleans(),
        ),
        "strength": st.none() | st.floats(0.0, 1e3),
        "changes": st.dictionaries(st.sampled_from("abc"), st.floats(-3.0, 10.0)),
        "varying": st.floats(-1e3, 1e3),
        "stroke": st.floats(-1e3, 1e3),
        "memory": st.floats(-1e3, 1e3),
    }
)


@hypothesis.given(LEFT, ANSWERS, st.none() | st.just(COARSE))
def test_names_and_verdict_agree(left: Left, answers: dict[str, Any], coarse: Any) -> None:
    found = said(Seen(left, rounding=coarse), **answers)
    assert said(Seen(left, rounding=coarse), **answers) == found
    assert (found.said in ("explained", "ambiguous")) == bool(found.names)
    assert set(found.names) <= {*left.names, "quantisation"}
    assert found.said != "ambiguous" or len(found.sets) > 1


@hypothesis.given(LEFT, ANSWERS)
def test_what_is_named_or_called_nothing_is_understood(left: Left, answers: dict[str, Any]) -> None:
    found = said(Seen(left), **answers)
    turned = {r.rule for r in found.ledger}
    known = answers["sheet"] or understood(left, POLICY, lambda: answers["sheet"])
    if turned & {"weak", "steady", "curves", "varying", "stroke", "memory"}:
        known = needs_nothing(left, POLICY)
    elif "reproduced" in turned:
        made = answers["reproduced"]
        known = made.quiet_before or made.before < POLICY.motion_met - 1.0
        known = known and made.bent < POLICY.within_tolerance
    known = known or bool(turned & {"motion", "steps"})
    assert (found.said == "unknown") == (not known)
