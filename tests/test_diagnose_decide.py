"""Which set is named: every rule by evidence made by hand, and what holds for any evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import hypothesis
import hypothesis.strategies as st
import pytest

from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.court import Choice
from rthyb_rt.diagnose.decide import ALIKE, NAMING, RANKING, choose, gathered
from rthyb_rt.diagnose.hypotheses import (
    DriftRates,
    Evidence,
    Hypothesis,
    Laws,
    Need,
    SetMember,
    Setting,
)
from rthyb_rt.diagnose.policy import POLICY

LAWS = Laws.of(effects.catalogue())
ROWS = 1000.0
STATED = {"stiffness", "viscous", "bias"}


def part(name: str, price: float = 20.0, count: int = 1, **more: Any) -> SetMember:
    law = effects.catalogue()[name]
    declared = {"sensor": law.sensor, "carries": law.carries, "dissipates": law.dissipates}
    return SetMember(name, law.names, price, count, stated=name in STATED, **{**declared, **more})


def of(*parts: SetMember | str, chi2: float, **more: Any) -> Hypothesis:
    return Hypothesis(tuple(part(p) if isinstance(p, str) else p for p in parts), chi2, **more)


def evidence(*sets: Hypothesis, null: float = 20_000.0, **setting: Any) -> Evidence:
    return Evidence(Setting(LAWS, ROWS, **setting), of(chi2=null), sets)


ANSWERS = {
    "held_out": 0.9, "size": 0.5, "left": 0.5, "driven": (60.0, 60.0, 60.0),
    "driven_together": 180.0, "slow_noise": 1.0, "near_noise": 1.0, "beyond_forms": 1e9,
    "own_size": 0.1, "yielding": None, "line_of_others": 0.0,
}  # fmt: skip


def decided(
    seen: Evidence, less: tuple[str, ...] = (), policy: Any = POLICY, **answers: Any
) -> Choice:
    """What is named where each need has the same answer for all sets, or one for each by name."""
    given = {**ANSWERS, **answers}
    known: dict[Need, Any] = {}
    while isinstance(done := choose(replace(seen, known=known), policy, less), Need):
        answer = given[done.what.replace(" ", "_")]
        known[done] = answer[done.of.names] if isinstance(answer, dict) else answer
    return done


def fired(choice: Choice) -> set[str]:
    return {r.rule for r in choice.ledger}


# ---- each rule ---------------------------------------------------------------------------------


def not_needed() -> Evidence:
    """A second effect earns its price, and not that of one picked beside another."""
    return evidence(
        of("coulomb", chi2=1022.0), of("cubic", chi2=15_000.0), of("coulomb", "cubic", chi2=1000.0)
    )


def a_form() -> Evidence:
    """A second effect takes up a three-hundredth of the whole, far above the noise."""
    return evidence(
        of("coulomb", chi2=1160.0), of("cubic", chi2=15_000.0), of("coulomb", "cubic", chi2=1100.0)
    )


def a_normal_offset() -> Evidence:
    """A load cell 0.08 ms late, which shows where friction jumps; 0.1 ms is normal."""
    late = part("time_skew", offset_s=8e-5)
    return evidence(
        of("coulomb", chi2=1700.0), of(late, chi2=15_000.0), of("coulomb", late, chi2=1000.0)
    )


def a_drift() -> Evidence:
    """Of a naive model: a drift that is not there within the halves."""
    return evidence(of("drift", chi2=1000.0), of("coulomb", chi2=1300.0), naive=True)


def slow() -> Evidence:
    """A drift earns seven times its price among slow noise of 18 times the power of all rows."""
    return evidence(of("drift", chi2=1000.0), null=1139.0)


def a_hum() -> Evidence:
    """A line earns twice its price where the noise swells to four times its power."""
    return evidence(
        of("inertia", chi2=1080.0), of("hum", chi2=9000.0), of("hum", "inertia", chi2=1000.0)
    )


def the_cells_own_noise() -> Evidence:
    """Of a closed loop: a law earns its price, and not by the motion that the test makes."""
    return evidence(
        of("coulomb", chi2=1060.0), of("viscous", chi2=1000.0), null=1100.0, returns=True
    )


def a_zero() -> Evidence:
    """A body that moves freely rests beside its zero by as much as its sensor's noise."""
    return evidence(of("bias", chi2=1000.0), null=2000.0, judged="motion")


def more_laws() -> Evidence:
    """Of a naive model: two laws of which another one does nearly as well alone."""
    return evidence(
        of("hysteresis", chi2=1150.0), of("gap", chi2=8000.0), of("cubic", chi2=9000.0),
        of("cubic", "gap", chi2=1100.0), naive=True,
    )  # fmt: skip


def bristles() -> Evidence:
    """Bristles beside a spring that lacks as much as they hold: a spring that yields."""
    return evidence(
        of("hysteresis", chi2=1040.0), of("lugre", chi2=9000.0), of("stiffness", chi2=9000.0),
        of("lugre", "stiffness", chi2=1000.0, held_n_per_m=1e5, lost_n_per_m=1e5),
    )  # fmt: skip


def a_peak() -> Evidence:
    """Friction with a peak that brings less than the form of a step may."""
    return evidence(of("coulomb", chi2=1020.0), of(part("stribeck", 25.0, 3), chi2=1000.0))


def quick() -> Evidence:
    """Relaxation that is over long before the motion turns."""
    return evidence(
        of("viscous", chi2=1020.0), of(part("maxwell", 25.0, 2, settles_rad=0.01), chi2=1000.0)
    )


def a_form_of_one() -> Evidence:
    """Two pairs with one law in common, of which one has a parameter more and wins by its form."""
    fewer, more = part("cubic"), part("gap", 20.0, 2)
    return evidence(
        of("coulomb", chi2=9000.0), of(fewer, chi2=9000.0), of(more, chi2=9000.0),
        of("coulomb", fewer, chi2=1120.0), of("coulomb", more, chi2=1100.0),
    )  # fmt: skip


RULES: dict[str, tuple[Evidence, dict[str, Any], tuple[str, ...], tuple[str, ...]]] = {
    "needed": (not_needed(), {}, ("coulomb",), ("coulomb", "cubic")),
    "normal offset": (a_normal_offset(), {}, ("coulomb",), ("coulomb", "time_skew")),
    "off zero": (a_zero(), {"zero": 1.0}, (), ("bias",)),
    "slow noise": (slow(), {"slow_noise": 18.0}, (), ("drift",)),
    "near noise": (a_hum(), {"near_noise": 4.0}, ("inertia",), ("hum", "inertia")),
    "drift goes on": (
        a_drift(),
        {"drift": DriftRates(1.0, 0.1, 0.05, 9.0)},
        ("coulomb",),
        ("drift",),
    ),
    "driven": (the_cells_own_noise(), {"driven": (10.0,)}, (), ("viscous",)),
    "rounding": (
        evidence(of("cubic", chi2=1000.0), of("hum", chi2=700.0), null=20_000.0, coarse=True),
        {"rounding": {(): 900.0, ("cubic",): 100.0, ("hum",): 400.0}},
        ("cubic",),
        ("hum",),
    ),
    "more laws": (more_laws(), {}, ("hysteresis",), ("cubic", "gap")),
    "yielding": (bristles(), {}, ("hysteresis",), ("lugre", "stiffness")),
    "plainest": (a_peak(), {}, ("coulomb",), ("stribeck",)),
    "simplest first": (a_form_of_one(), {}, ("coulomb", "cubic"), ("coulomb", "gap")),
    "earns": (evidence(of("cubic", chi2=19_990.0), null=20_000.0), {}, (), ("cubic",)),
    "size": (evidence(of("cubic", chi2=1000.0)), {"size": 1e-4}, (), ("cubic",)),
    "closer": (evidence(of("inertia", chi2=1000.0)), {"left": 1.1}, (), ("inertia",)),
    "held out": (evidence(of("cubic", chi2=1000.0)), {"held_out": 0.1}, (), ("cubic",)),
}
"""Of each rule evidence, what is answered when it is asked for, and what is named with and without
the rule."""


@pytest.mark.parametrize("rule", RULES)
def test_each_rule_changes_what_is_named(rule: str) -> None:
    seen, answers, named, without = RULES[rule]
    gone = (rule, "needed") if rule == "earns" else (rule,)
    kept = ("needed",) if rule == "earns" else ()
    choice = decided(seen, kept, **answers)
    assert choice.best.names == named
    assert rule in fired(choice)
    assert decided(seen, gone, **answers).best.names == without


def test_every_rule_has_its_evidence() -> None:
    assert set(RULES) == {*RANKING, *NAMING}
    assert set(ALIKE) == {"alike", "twins"}


def test_relaxation_that_is_over_at_once_is_a_dashpot() -> None:
    assert decided(quick()).best.names == ("viscous",)
    assert decided(quick(), ("plainest",)).best.names == ("maxwell",)
    slow = evidence(
        of("viscous", chi2=1020.0), of(part("maxwell", 25.0, 2, settles_rad=1.0), chi2=1000.0)
    )
    assert decided(slow).best.names == ("maxwell",)


def test_a_pair_of_one_parameter_each_is_no_larger_than_a_law_of_two() -> None:
    """Power damping nearly imitates friction and a dashpot, with as many parameters."""

    def named(count: int) -> tuple[str, ...]:
        seen = evidence(
            of("coulomb", chi2=8000.0), of("viscous", chi2=9000.0),
            of(part("power_damping", 20.0, count), chi2=1060.0),
            of("coulomb", "viscous", chi2=1010.0), naive=True,
        )  # fmt: skip
        return decided(seen).best.names

    assert named(2) == ("coulomb", "viscous")
    assert named(1) == ("power_damping",)


def test_a_second_mass_on_a_spring_too_stiff_for_the_motion_is_a_moving_mass() -> None:
    def seen(settles_rad: float) -> Evidence:
        return evidence(
            of("inertia", "cubic", chi2=1025.0), of("inertia", chi2=9000.0),
            of("cubic", chi2=15_000.0), of("second_mode", chi2=9000.0),
            of(part("second_mode", 30.0, 3, settles_rad=settles_rad), "cubic", chi2=1000.0),
        )  # fmt: skip

    assert decided(seen(0.02)).best.names == ("cubic", "inertia")
    assert ("cubic", "second_mode") not in {h.names for h in decided(seen(0.02)).ranked}
    assert ("cubic", "second_mode") in {h.names for h in decided(seen(0.5)).equal}


def test_beside_slow_relaxation_too_a_stiff_second_mode_is_a_moving_mass() -> None:
    stiff = part("second_mode", 30.0, 3, settles_rad=0.02)
    slow = part("maxwell", 25.0, 2, settles_rad=1.5)
    seen = evidence(
        of("inertia", slow, chi2=1025.0), of("inertia", chi2=9000.0), of(slow, chi2=15_000.0),
        of(stiff, chi2=9000.0), of(slow, stiff, chi2=1000.0),
    )  # fmt: skip
    assert decided(seen).best.names == ("inertia", "maxwell")


@pytest.mark.parametrize("settles_rad", [0.02, 0.2])
def test_along_an_estimated_motion_a_stiff_second_mode_must_show_in_the_motion_of_the_test(
    settles_rad: float,
) -> None:
    """Elsewhere it is a filter of the noise that the estimate has in common with the load cell."""

    def named(exact: bool, driven_more: float) -> tuple[str, ...]:
        seen = evidence(
            of("inertia", "cubic", chi2=3000.0),
            of("inertia", chi2=9000.0),
            of("cubic", chi2=15_000.0),
            of("second_mode", chi2=9000.0),
            of("cubic", part("second_mode", 30.0, 3, settles_rad=settles_rad), chi2=1000.0),
            exact=exact,
        )
        return decided(seen, driven_more=driven_more).best.names

    assert named(exact=False, driven_more=5.0) == ("cubic", "inertia")
    assert named(exact=False, driven_more=1500.0) == ("cubic", "second_mode")
    assert named(exact=True, driven_more=5.0) == ("cubic", "second_mode")


def test_what_richer_friction_explains_is_measured_without_it_in_whatever_order_a_set_has() -> None:
    """Beside a large spring, which explains nearly all."""

    def named(*parts: SetMember | str) -> tuple[str, ...]:
        rich = of(*parts, chi2=1000.0)
        seen = evidence(
            of("stiffness", chi2=1_800.0), of("coulomb", "stiffness", chi2=1120.0), rich,
            of("coulomb", chi2=5e4), of(part("stribeck", 25.0, 3), chi2=5e4), null=6e4, exact=False,
        )  # fmt: skip
        return decided(seen).best.names

    peak = part("stribeck", 25.0, 3)
    assert named("stiffness", peak) == named(peak, "stiffness") == ("stiffness", "stribeck")


def test_sets_that_differ_by_less_than_evidence_tells_are_both_named() -> None:
    seen = evidence(of("cubic", chi2=1000.0), of("gap", chi2=1005.0), of("stopper", chi2=1020.0))
    assert [h.names for h in decided(seen).equal] == [("gap",)]
    assert decided(seen, ("alike",)).equal == ()
    dearer = evidence(of("cubic", chi2=1000.0), of(part("gap", 20.0, 2), chi2=1005.0))
    assert decided(dearer).equal == ()


def test_a_power_of_velocity_near_two_is_no_other_explanation_than_the_square() -> None:
    """It contains it, and fits a little better; but it is one beside any other law."""
    power = part("power_damping", 30.0, 2)
    beside = (of("cubic", chi2=9000.0), of(power, chi2=9500.0))
    square = of("cubic", "quad_damping", chi2=1008.0)
    seen = evidence(
        square, of("cubic", power, chi2=1001.0), of("quad_damping", chi2=9600.0), *beside
    )
    assert decided(seen).best == square
    assert decided(seen).equal == ()
    other = of("cubic", "coulomb", chi2=1008.0)
    seen = evidence(other, of("cubic", power, chi2=1001.0), of("coulomb", chi2=9600.0), *beside)
    assert [h.names for h in decided(seen).equal] == [("cubic", "power_damping")]


def test_a_cheaper_name_for_the_same_thing_is_no_evidence() -> None:
    """Moving the stated damping costs less than an effect; the other one was not worth its price.

    With a chi-squared that no recording tells apart both are named.
    """
    cheap, dear = of(part("viscous", 13.0), chi2=19_980.0), of("quad_damping", chi2=19_981.0)
    seen = evidence(cheap, dear)
    assert [h.names for h in decided(seen).equal] == [("quad_damping",)]
    assert decided(seen, ("twins",)).equal == ()
    late = replace(cheap, parts=(replace(cheap.parts[0], late=True, stated=False),))
    assert decided(evidence(late, dear)).equal == ()


# ---- what excuses an effect that explains little ------------------------------------------------


def test_a_form_of_the_other_law_is_refused_and_says_by_how_much() -> None:
    choice = decided(a_form())
    assert choice.best.names == ("coulomb",)
    ruling = next(r for r in choice.ledger if r.rule == "share")
    assert (ruling.names, ruling.part) == (("coulomb", "cubic"), "cubic")
    assert ruling.found == 60.0
    assert ruling.wanted == pytest.approx(POLICY.needed_share[1] * (20_000.0 - 1100.0))


@pytest.mark.parametrize("second", ["cubic", "viscous"])
def test_what_another_form_of_the_first_law_explains_is_no_second_effect(second: str) -> None:
    """Two hundredths of the whole are far above the noise, and still the form of friction."""
    seen = evidence(
        of("coulomb", chi2=1400.0), of(second, chi2=15_000.0), of("coulomb", second, chi2=1000.0)
    )
    assert decided(seen).best.names == ("coulomb", second)
    choice = decided(seen, beyond_forms=5.0)
    assert choice.best.names == ("coulomb",)
    ruling = next(r for r in choice.ledger if r.rule == "form")
    assert (ruling.part, ruling.found, ruling.wanted) == (second, 5.0, 25.0)
    large = replace(seen, sets=(of("coulomb", chi2=3000.0), *seen.sets[1:]))
    assert decided(large, beyond_forms=5.0).best.names == ("coulomb", second)
    moved = replace(seen, setting=replace(seen.setting, judged="motion"))
    assert decided(moved, beyond_forms=5.0).best.names == decided(moved).best.names


def test_an_effect_that_ends_at_the_noise_is_no_form() -> None:
    at_noise = evidence(*(replace(h, chi2=h.chi2 - 100.0) for h in a_form().sets))
    assert decided(at_noise).best.names == ("coulomb", "cubic")
    blurred = replace(at_noise, setting=replace(at_noise.setting, exact=False))
    assert decided(blurred).best.names == ("coulomb",)


def test_a_stated_number_is_seen_against_its_tolerance() -> None:
    seen = evidence(
        of("coulomb", chi2=1160.0), of("viscous", chi2=15_000.0),
        of("coulomb", "viscous", chi2=1100.0),
    )  # fmt: skip
    assert decided(seen).best.names == ("coulomb", "viscous")
    moved = replace(seen, setting=replace(seen.setting, judged="motion"))
    assert decided(moved).best.names == ("coulomb",)
    bent = of("coulomb", chi2=1160.0, bent=frozenset({"viscous"}))
    assert decided(replace(moved, sets=(bent, *moved.sets[1:]))).best.names == (
        "coulomb",
        "viscous",
    )


OFFSET = {"offset_sd": 1.01 * POLICY.strained_offset}
STIFFNESS = {"strained": frozenset({"stiffness"})}


@pytest.mark.parametrize("strain", [OFFSET, STIFFNESS], ids=["a time offset", "a stiffness"])
def test_without_it_a_stated_value_would_have_to_stand_in(strain: dict[str, Any]) -> None:
    def named(less: dict[str, Any], both: dict[str, Any], naive: bool = False) -> tuple[str, ...]:
        alone, other, pair = a_form().sets
        seen = replace(a_form(), sets=(replace(alone, **less), other, replace(pair, **both)))
        return decided(replace(seen, setting=replace(seen.setting, naive=naive))).best.names

    assert named(strain, {}) == ("coulomb", "cubic")
    assert named({"offset_sd": 0.99 * POLICY.strained_offset}, {}) == ("coulomb",)
    assert named(strain, strain) == ("coulomb",)
    assert named(strain, {}, naive=True) == ("coulomb",)


def test_what_only_relieves_a_stated_value_must_explain_more_than_the_form_of_a_law() -> None:
    """So little, beside so much, is what the formula of the law leaves."""
    alone, other, pair = a_form().sets
    seen = replace(a_form(), sets=(replace(alone, **STIFFNESS), other, pair))
    assert decided(seen).best.names == ("coulomb", "cubic")
    own = (alone.chi2 - pair.chi2) / POLICY.form_alone
    loud = replace(seen, null=of(chi2=pair.chi2 + 1.1 * own))
    assert decided(loud).best.names == ("coulomb",)


JOINT, PINCHED = "hysteresis+degradation", "hysteresis+pinching+degradation"


@pytest.mark.parametrize("whole", [True, False])
def test_beside_the_whole_law_of_a_member_a_stated_value_must_explain_its_share(
    whole: bool,
) -> None:
    """No formula of a damaged column is exact, so that damping can make up for it."""
    column = part(JOINT, complete=whole)
    seen = evidence(
        of(column, chi2=1100.0), of(column, "viscous", chi2=1040.0), of("viscous", chi2=15_000.0)
    )
    beside = () if whole else ("viscous",)
    assert decided(seen).best.names == ("degradation", "hysteresis", *beside)


def test_a_column_that_pinches_or_not_is_no_second_explanation() -> None:
    plain, pinched = part(JOINT, complete=True), part(PINCHED, complete=True)
    seen = evidence(of(plain, chi2=1003.0), of(pinched, chi2=1000.0))
    assert not decided(seen).equal
    gap = of("gap", chi2=1003.0)
    assert decided(evidence(of(pinched, chi2=1000.0), gap)).equal == (gap,)
    separate = evidence(of(part(JOINT), chi2=1003.0), of(part(PINCHED), chi2=1000.0))
    assert decided(separate).equal


@pytest.mark.parametrize(("chi2", "named"), [(1101.0, "stiffness"), (1130.0, "cubic")])
def test_a_changed_stiffness_is_named_unless_a_law_in_its_place_fits_clearly_better(
    chi2: float, named: str
) -> None:
    alone, other, pair = a_form().sets
    changed = of("coulomb", "stiffness", chi2=chi2), of("stiffness", chi2=15_000.0)
    seen = replace(a_form(), sets=(replace(alone, **STIFFNESS), other, pair, *changed))
    assert decided(seen).best.names == ("coulomb", named)


def test_a_small_effect_beside_loud_crosstalk_earns_its_price_beside_other_forms() -> None:
    """What crosstalk leaves by a form of its own is no dashpot."""
    seen = evidence(
        of("crosstalk", chi2=5000.0), of("crosstalk", "viscous", chi2=4940.0),
        of("viscous", chi2=9e5), null=1e6,
    )  # fmt: skip
    choice = decided(seen, beyond_forms=0.0)
    assert choice.best.names == ("crosstalk",)
    assert [r.part for r in choice.ledger if r.rule == "form"] == ["viscous"]


def test_two_effects_that_cancel_earn_the_price_of_both_beside_a_third_one() -> None:
    """At one frequency a spring and a mass cancel, so that each of them seems to be needed."""
    several = (
        of("inertia", "stiffness", chi2=1044.0), of("lugre", "stiffness", chi2=9000.0),
        of("inertia", "lugre", chi2=9000.0), of("inertia", chi2=1065.0), of("lugre", chi2=9000.0),
    )  # fmt: skip
    spring = of("stiffness", chi2=1045.0)
    all_three = of("inertia", "lugre", "stiffness", chi2=1000.0)
    choice = decided(evidence(spring, *several, all_three, null=1500.0))
    assert choice.best.names == ("stiffness",)
    (ruling,) = {r for r in choice.ledger if r.rule == "together"}
    assert ruling.found < ruling.wanted
    # Better by the price of both, counted as beside others, all three are named.
    better = replace(all_three, chi2=950.0)
    assert decided(evidence(spring, *several, better, null=1500.0)).best is better


def test_an_effect_beside_another_is_as_large_as_one_alone() -> None:
    """At a low noise, 13 g earn 300 beside a second mass of 16 kg, an error of its formula."""
    seen = evidence(
        of("second_mode", chi2=1300.0), of("inertia", chi2=18_000.0),
        of("inertia", "second_mode", chi2=1000.0),
    )  # fmt: skip
    assert decided(seen).best.names == ("inertia", "second_mode")
    choice = decided(seen, own_size=1e-4)
    assert choice.best.names == ("second_mode",)
    (ruling,) = {r for r in choice.ledger if r.rule == "small"}
    assert (ruling.found, ruling.wanted) == (1e-4, POLICY.least_force)


def test_an_effect_is_not_measured_against_what_the_load_cell_adds() -> None:
    """Crosstalk explains nearly all, and follows another channel instead of the motion."""
    loud = of("crosstalk", chi2=3000.0)
    two, three = (
        of("crosstalk", "time_skew", chi2=1260.0),
        of("crosstalk", "inertia", "time_skew", chi2=1060.0),
    )
    others = (
        of("crosstalk", "inertia", chi2=2800.0), of("inertia", "time_skew", chi2=18_500.0),
        of("inertia", chi2=19_500.0), of("time_skew", chi2=18_800.0),
    )  # fmt: skip
    choice = decided(evidence(loud, two, three, *others, exact=False))
    assert choice.best.names == three.names
    # In place of crosstalk, a law of the specimen: its form may leave as much.
    spring = [
        replace(h, parts=tuple(part("cubic") if p.name == "crosstalk" else p for p in h.parts))
        for h in (loud, two, three, others[0])
    ]
    choice = decided(evidence(*spring, *others[1:], exact=False))
    assert choice.best.names == ("cubic", "time_skew")
    (ruling,) = [r for r in choice.ledger if r.rule == "share" and r.part == "inertia"]
    assert ruling.found == 200.0 < ruling.wanted


def test_what_a_load_cell_does_by_itself_follows_no_law() -> None:
    """At the noise, it counts what an effect brings beside all smooth forms of the other law.

    Along an estimated motion, where to end at the noise alone is no excuse.
    """
    seen = evidence(
        of("coulomb", chi2=1100.0), of("hum", chi2=15_000.0), of("coulomb", "hum", chi2=1050.0),
        exact=False,
    )  # fmt: skip
    assert decided(seen, beyond_forms=30.0).best.names == ("coulomb", "hum")
    assert decided(seen, beyond_forms=20.0).best.names == ("coulomb",)


@pytest.mark.parametrize("stated", ["viscous", "stiffness"])
def test_what_a_changed_stated_value_imitates_does_not_lose_to_it_by_its_excuse(
    stated: str,
) -> None:
    alone, name = of("coulomb", chi2=1160.0), "maxwell"
    seen = evidence(
        alone, of(name, chi2=15_000.0), of(stated, chi2=15_000.0),
        of("coulomb", name, chi2=1100.0), of("coulomb", stated, chi2=1130.0),
    )  # fmt: skip
    assert set(decided(seen).best.names) == {"coulomb", name}
    without = evidence(*(h for h in seen.sets if stated not in h.names))
    assert decided(without).best is alone
    better = evidence(*seen.sets[:-1], of("coulomb", stated, chi2=1090.0))
    assert set(decided(better).best.names) == {"coulomb", stated}
    other = evidence(
        alone, of("gap", chi2=15_000.0), of(stated, chi2=15_000.0),
        of("coulomb", "gap", chi2=1100.0), of("coulomb", stated, chi2=1130.0),
    )  # fmt: skip
    assert set(decided(other).best.names) == {"coulomb", stated}


def test_an_effect_that_dry_friction_cannot_replace_is_no_form_of_richer_friction() -> None:
    """A spring of a seventieth of what is explained beside a peak, of a tenth beside friction."""
    peak = of("stribeck", chi2=1200.0)
    seen = evidence(
        peak, of("coulomb", chi2=5000.0), of("cubic", chi2=15_000.0),
        of("coulomb", "cubic", chi2=1180.0), of("stribeck", "cubic", chi2=1030.0),
        exact=False,
    )  # fmt: skip
    assert decided(seen, less=("plainest",)).best.names == ("cubic", "stribeck")
    without = evidence(*(h for h in seen.sets if h.names != ("coulomb", "cubic")), exact=False)
    assert ("cubic", "stribeck") not in {h.names for h in decided(without).ranked}


def test_what_is_added_to_a_peak_that_was_refined_elsewhere_is_measured_against_friction() -> None:
    """A peak contains dry friction: alone it cannot fit worse."""
    sets = [
        of("stribeck", "cubic", chi2=1000.0), of("stribeck", chi2=60_000.0),
        of("cubic", chi2=90_000.0),
    ]  # fmt: skip
    without = evidence(*sets, null=1e5, exact=False)
    assert decided(without).best.names == ("cubic", "stribeck")
    seen = evidence(*sets, of("coulomb", chi2=1100.0), null=1e5, exact=False)
    assert decided(seen).best.names == ("coulomb",)


def test_a_peak_of_friction_is_measured_against_friction_and_not_against_a_louder_hum() -> None:
    """A hum explains a thousand times what friction does; the form of a step has no share of it."""

    def named(friction_explains: float) -> tuple[str, ...]:
        seen = evidence(
            of("coulomb", chi2=20_000_000.0), of("stribeck", chi2=20_000_000.0),
            of("hum", chi2=1000.0 + friction_explains), of("coulomb", "hum", chi2=1150.0),
            of("hum", "stribeck", chi2=1000.0), null=20_000_000.0,
        )  # fmt: skip
        return decided(seen).best.names

    assert named(20_000.0) == ("hum", "stribeck")
    assert named(2_000_000.0) == ("coulomb", "hum")


def test_a_peak_does_not_lose_to_its_imitation_by_two_plainer_laws() -> None:
    plain = of("coulomb", chi2=1060.0)
    seen = evidence(plain, of("stribeck", chi2=1000.0), null=1_000_000.0)
    assert decided(seen).best.names == ("coulomb",)
    imitation = of("coulomb", "viscous", chi2=1005.0)
    both = replace(seen, sets=(*seen.sets, of("viscous", chi2=900_000.0), imitation))
    assert decided(both).best.names == ("stribeck",)
    better = replace(imitation, chi2=970.0)
    ahead = replace(seen, sets=(*seen.sets, of("viscous", chi2=900_000.0), better))
    assert decided(ahead).best.names == ("coulomb", "viscous")


def test_a_stated_value_that_both_frictions_move_is_no_excuse_for_the_richer_one() -> None:
    """Bristles, and dry friction, which the search has tried with the damping set free as well."""
    moved = frozenset(("viscous",))
    plain = of("coulomb", chi2=1060.0, bent=moved)
    bristles = of("lugre", chi2=1000.0, bent=moved)
    sets = (of("viscous", chi2=900_000.0), of("coulomb", "viscous", chi2=1005.0))
    seen = evidence(plain, bristles, *sets, null=1_000_000.0)
    assert decided(seen).best.names == ("coulomb", "viscous")
    free = replace(bristles, bent=frozenset[str]())
    assert decided(evidence(plain, free, *sets, null=1_000_000.0)).best.names == ("lugre",)


def test_damping_of_a_free_decay_is_measured_against_damping() -> None:
    """The spring is nearly all of the force; of a thousandth each part of the damping matters."""
    spring = of("cubic", chi2=1500.0)
    seen = evidence(
        spring, of("coulomb", chi2=19_000.0), of("cubic", "coulomb", chi2=1450.0), naive=True,
        exact=False,
    )  # fmt: skip
    assert decided(seen).best is spring
    swings = replace(seen, setting=replace(seen.setting, swings=True))
    assert decided(swings, part=spring).best.names == ("coulomb", "cubic")


# ---- what is asked for -------------------------------------------------------------------------


def test_what_is_not_known_is_asked_for_and_nothing_else() -> None:
    pair = of("coulomb", "cubic", chi2=1000.0)
    need = choose(evidence(pair), POLICY)
    assert need == Need("part", pair, (1,))
    asked: list[Need] = []

    def answer(need: Need) -> Any:
        asked.append(need)
        return {"part": of("gap", chi2=5000.0)}.get(need.what, 0.5)

    assert gathered(evidence(pair), POLICY, answer).best is pair
    each = ["part", "own size"]
    assert [n.what for n in asked] == [*each, *each, "size", "left", "held out"]


def test_a_model_of_free_stiffness_is_asked_for_yielding_in_the_place_of_bristles() -> None:
    seen = evidence(of("lugre", chi2=1000.0), k_free=True)
    yielding = of("hysteresis", chi2=1010.0)
    assert decided(seen, yielding=yielding).best is yielding
    assert decided(seen, yielding=None).best.names == ("lugre",)


def test_set_that_is_no_physical_law_without_one_effect_needs_that() -> None:
    pair = of("coulomb", "cubic", chi2=1000.0)
    assert decided(evidence(pair), part=None).best is pair


def test_a_late_cell_has_to_show_in_the_motion_of_the_test_in_any_recording() -> None:
    seen = evidence(
        of("time_skew", "viscous", chi2=1000.0), of("viscous", chi2=1100.0),
        of("time_skew", chi2=9000.0),
    )  # fmt: skip
    assert decided(seen, driven=(-2.0, 60.0)).best.names == ("viscous",)
    assert decided(seen, driven=(60.0, -2.0)).best.names == ("time_skew", "viscous")
    for change in ({"naive": True}, {"witnessed": True}):
        other = replace(seen, setting=replace(seen.setting, **change))
        assert decided(other, driven=(-2.0, 60.0)).best.names == ("time_skew", "viscous")


def test_two_effects_that_cancel_have_to_show_together_in_the_motion_of_the_test() -> None:
    """Each undoes the other, and what is left of both filters the noise of the load cell."""
    seen = evidence(
        of("maxwell", chi2=2000.0), of("time_skew", chi2=2000.0),
        of("maxwell", "time_skew", chi2=1000.0), null=1100.0, returns=True,
    )  # fmt: skip
    found = decided(seen, driven_together=10.0)
    assert found.best.names == ()
    assert "driven together" in fired(found)
    assert decided(seen, driven_together=90.0).best.names == ("maxwell", "time_skew")


def test_a_drift_that_moves_a_body_no_farther_than_its_zero_is_not_named() -> None:
    """Slow noise of the displacement moves its zero by as much during the recording."""
    seen = evidence(of("drift", chi2=1000.0), null=2000.0, judged="motion")
    found = decided(seen, zero=1.0)
    assert found.best.names == ()
    assert "off zero" in fired(found)
    assert decided(seen, zero=20.0).best.names == ("drift",)


def test_a_drift_is_compared_with_slow_noise_only_where_there_is_some() -> None:
    """By chance, the slowest lines of white noise have up to 2.5 times its power."""
    assert decided(slow(), slow_noise=2.4).best.names == ("drift",)
    assert decided(slow(), slow_noise=6.0).best.names == ("drift",)
    assert decided(slow(), slow_noise=7.0).best.names == ()
    fast = evidence(of("coulomb", chi2=1000.0), null=1139.0)
    assert decided(fast, slow_noise=18.0).best.names == ("coulomb",)
    naive = replace(slow(), setting=replace(slow().setting, naive=True))
    rates = DriftRates(1.0, 0.9, 0.1, 9.0)
    assert decided(naive, slow_noise=18.0, drift=rates).best.names == ("drift",)


def test_a_drift_that_no_half_shows_has_to_be_better_than_an_offset_by_an_effects_price() -> None:
    """Nobody knows when the cell was zeroed: an offset that drifts contains the offset alone."""
    seen = evidence(
        of("coulomb", chi2=1300.0), of("drift", chi2=9000.0), of("bias", chi2=9000.0),
        of("coulomb", "drift", chi2=1000.0), of("bias", "coulomb", chi2=1003.0), naive=True,
    )  # fmt: skip
    unsure = DriftRates(1.0, 0.9, 0.6, 9.0)
    found = decided(seen, drift=unsure)
    assert found.best.names == ("bias", "coulomb")
    assert found.equal == ()
    ruling = next(r for r in found.ledger if r.rule == "drift or offset")
    assert (ruling.found, ruling.against) == (3.0, ("bias", "coulomb"))
    assert ruling.wanted == POLICY.several_price * 20.0
    # What the halves show, or the evidence of the whole recording, decides as before.
    assert decided(seen, drift=DriftRates(1.0, 0.9, 0.1, 9.0)).best.names == ("coulomb", "drift")
    worse = replace(seen, sets=(*seen.sets[:-1], of("bias", "coulomb", chi2=1030.0)))
    assert decided(worse, drift=unsure).best.names == ("coulomb", "drift")
    stated = replace(seen, setting=replace(seen.setting, naive=False))
    assert decided(stated, zero=100.0).best.names == ("coulomb", "drift")


def test_a_drift_of_a_naive_model_needs_motion_that_repeats_within_each_half() -> None:
    """The loop of one cycle is no closed one: its law may err by as much as a drift."""
    once, twice = DriftRates(1.0, 0.9, 0.1, 1.5), DriftRates(1.0, 0.9, 0.1, 2.0)
    assert decided(a_drift(), drift=twice).best.names == ("drift",)
    found = decided(a_drift(), drift=once)
    assert found.best.names == ("coulomb",)
    assert next(r for r in found.ledger if r.rule == "drift repeats").found == 1.5
    stated = replace(a_drift(), setting=replace(a_drift().setting, naive=False))
    assert decided(stated, drift=once, zero=100.0).best.names == ("drift",)


def test_a_weight_that_moves_a_body_far_off_its_zero_is_named() -> None:
    assert decided(a_zero(), zero=20.0).best.names == ("bias",)


def test_a_law_is_a_finding_for_what_it_explains_beside_a_zero_error() -> None:
    """A constant that is there, and larger than a law alone, explains nothing of the law."""
    sets = (
        of("bias", chi2=1000.0), of("viscous", chi2=1900.0), of("bias", "viscous", chi2=900.0),
    )  # fmt: skip
    small = replace(evidence(*sets, null=2000.0), sets=sets[:2], beside=sets[2:])
    assert decided(small, zero=1.0).best.names == ("viscous",)
    alike = replace(small, beside=(of("bias", "viscous", chi2=990.0),))
    assert "beside zero" in fired(decided(alike, zero=1.0))
    assert decided(alike, zero=1.0).best.names == ()


def test_stated_value_off_by_many_tolerances_is_named_although_a_tiny_law_fits_better() -> None:
    tiny, viscous = of("quadratic", chi2=1000.0), of("viscous", chi2=1200.0)
    seen = evidence(tiny, viscous, of("lugre", chi2=1100.0), null=1400.0)
    sizes = {("quadratic",): 8e-4, ("viscous",): 0.08, ("lugre",): 9e-4}
    assert decided(seen, size=sizes).best.names == ("viscous",)
    assert decided(seen, size=sizes).equal == ()
    plain = replace(seen, sets=(tiny, of("lugre", chi2=1100.0)))
    assert decided(plain, size=sizes | {("lugre",): 0.08}).best.names == ()
    small = decided(seen, size=sizes | {("viscous",): 9e-4})
    assert small.best.names == ()


def test_stated_value_in_the_place_of_a_tiny_law_has_its_twins_too() -> None:
    """The lower price of a stated value is no evidence against an offset in time."""
    tiny, viscous = of("quadratic", chi2=1000.0), of("viscous", chi2=1200.0)
    late = of(part("time_skew", 60.0), chi2=1200.2)
    sizes = {h.names: 0.08 for h in (viscous, late)} | {tiny.names: 8e-4}
    seen = replace(evidence(tiny, viscous, null=1400.0), beside=(late, of("lugre", chi2=1100.0)))
    told = decided(seen, size=sizes)
    assert (told.best.names, [h.names for h in told.equal]) == (("viscous",), [("time_skew",)])


def test_stated_value_that_only_stands_for_a_tiny_law_is_not_named_in_its_place() -> None:
    """Beside that law it explains nothing: large parts of it cancel one another."""
    tiny, viscous = of("quadratic", chi2=1000.0), of("viscous", chi2=1200.0)
    sizes = {("quadratic",): 8e-4, ("viscous",): 0.08, ("quadratic", "viscous"): 8e-4}
    seen = evidence(tiny, viscous, null=1400.0)
    both = of("quadratic", "viscous", chi2=995.0)
    told = decided(replace(seen, beside=(both,)), size=sizes)
    assert told.best.names == ()
    assert "beside tiny" in fired(told)
    both = of("quadratic", "viscous", chi2=900.0)
    assert decided(replace(seen, beside=(both,)), size=sizes).best.names == ("viscous",)


@pytest.mark.parametrize("judged", ["force", "motion"])
def test_zero_error_of_the_displacement_passes_for_no_other_law_either(judged: Any) -> None:
    """Through the spring it is a constant force; a law has to explain more than that.

    In the force of a load cell as in the simulated motion of a body without one.
    """
    both = evidence(of("bias", chi2=1000.0), of("cubic", chi2=990.0), null=2000.0, judged=judged)
    found = decided(both, zero=1.0)
    assert found.best.names == ()
    assert fired(found) == {"off zero", "beside zero"}
    assert decided(both, zero=20.0).best.names == ("cubic",)
    better = replace(both, sets=(both.sets[0], of("cubic", chi2=900.0)))
    assert decided(better, zero=1.0).best.names == ("cubic",)
    assert decided(replace(both, setting=replace(both.setting, naive=True)), zero=1.0).best.parts


# ---- any evidence ------------------------------------------------------------------------------

NAMES = ("coulomb", "stribeck", "viscous", "cubic", "gap", "hysteresis", "lugre", "stiffness",
         "drift", "hum", "maxwell")  # fmt: skip


@st.composite
def any_evidence(draw: st.DrawFn) -> Evidence:
    """Some singles and every part of some larger sets: more effects never fit worse."""
    null = draw(st.floats(1000.0, 1e6))
    gains = {n: draw(st.floats(0.0, null - 900.0)) for n in NAMES}
    groups = draw(st.lists(st.lists(st.sampled_from(NAMES), min_size=1, max_size=3, unique=True),
                           min_size=1, max_size=6))  # fmt: skip
    wanted = {tuple(sorted(g)) for g in groups}
    wanted |= {(n,) for g in groups for n in g}
    wanted |= {tuple(sorted({*g} - {n})) for g in groups for n in g if len(g) > 1}
    counts = {n: draw(st.integers(1, 3)) for n in NAMES}
    sets = [
        Hypothesis(
            tuple(part(n, 12.0 + 7.0 * counts[n], counts[n]) for n in names),
            null - min(max(gains[n] for n in names) * draw(st.floats(1.0, 1.2)), null - 800.0),
            offset_sd=draw(st.floats(0.0, 10.0)),
        )
        for names in sorted(wanted)
    ]
    setting = Setting(LAWS, ROWS, naive=draw(st.booleans()), exact=draw(st.booleans()),
                      k_free=draw(st.booleans()), returns=draw(st.booleans()))  # fmt: skip
    return Evidence(setting, of(chi2=null), tuple(sets))


FREE = {"part": None, "yielding": None, "drift": DriftRates(1.0, 0.9, 0.01, 9.0),
        "beyond_forms": 50.0, "driven": (60.0, 60.0, 60.0), "driven_together": 180.0,
        "driven_more": 60.0, "zero": 100.0, "slow_noise": 1.0, "rounding": 0.0}  # fmt: skip


@hypothesis.given(any_evidence(), st.randoms())
def test_neither_order_nor_repetition_matters(seen: Evidence, random: Any) -> None:
    first = decided(seen, **FREE)
    shuffled = list(seen.sets)
    random.shuffle(shuffled)
    again = decided(replace(seen, sets=tuple(shuffled)), **FREE)
    assert (again.best, again.ranked, again.equal) == (first.best, first.ranked, first.equal)
    assert decided(seen, **FREE) == first


@hypothesis.given(any_evidence(), st.floats(0.0, 500.0))
def test_a_set_that_fits_better_is_never_nothing(seen: Evidence, better: float) -> None:
    """What is named and then fits better still: something is named."""
    first = decided(seen, **FREE)
    hypothesis.assume(first.best.parts)
    sets = tuple(
        replace(h, chi2=h.chi2 - better) if h.names == first.best.names else h for h in seen.sets
    )
    assert decided(replace(seen, sets=sets), **FREE).best.parts


@hypothesis.given(any_evidence())
def test_what_is_named_earns_its_price(seen: Evidence) -> None:
    choice = decided(seen, **FREE)
    if choice.best.parts:
        assert seen.null.chi2 - choice.best.chi2 > choice.best.price
        assert choice.best is choice.ranked[0]
    refused = {r.names for r in choice.ledger if r.rule in ("needed", "share")}
    ranked = {h.names for h in choice.ranked}
    assert not refused & ranked
    assert not {h.names for h in choice.equal} - {h.names for h in seen.sets}


@hypothesis.given(any_evidence(), st.sampled_from([0.0, float("nan"), -float("inf")]))
def test_what_holds_on_no_other_rows_is_not_named(seen: Evidence, held: float) -> None:
    assert not decided(seen, **FREE, held_out=held).best.parts


@pytest.mark.parametrize(
    ("richer", "named", "equal"),
    [
        (1000.0, ("cubic",), [("gap",)]),
        (980.0, ("gap",), []),
    ],
    ids=["by less than evidence tells", "by more"],
)
def test_of_single_laws_the_one_with_fewer_parameters_is_first_if_the_other_is_hardly_better(
    richer: float, named: tuple[str, ...], equal: list[tuple[str, ...]]
) -> None:
    """A dead band with rough ends in a spring of free stiffness is a smooth hardening spring."""
    seen = evidence(of("cubic", chi2=1010.0), of(part("gap", 29.0, 2), chi2=richer))
    choice = decided(seen)
    assert choice.best.names == named
    assert [h.names for h in choice.equal] == equal


def test_a_stiff_second_mode_beside_a_negative_mass_must_show_in_the_motion_of_the_test() -> None:
    """The two take mass off the noise of an estimated motion, and hardly any off the motion."""

    def named(exact: bool, earned: float) -> tuple[str, ...]:
        stiff = part("second_mode", 30.0, 3, settles_rad=0.23)
        seen = evidence(
            of("inertia", chi2=19_990.0), of(stiff, chi2=19_990.0), of("inertia", stiff, chi2=1e3),
            exact=exact,
        )  # fmt: skip
        return decided(seen, driven=(earned, earned), driven_together=earned).best.names

    assert named(exact=False, earned=5.0) == ()
    assert named(exact=False, earned=500.0) == ("inertia", "second_mode")
    assert named(exact=True, earned=5.0) == ("inertia", "second_mode")


def test_a_line_where_the_other_forces_have_one_must_be_more_than_the_form_of_a_law() -> None:
    """A hum is the load cell's own, unless a law makes a harmonic of the motion there."""

    def seen(loop_alone: float) -> Evidence:
        both = of("hum", "hysteresis", chi2=1000.0)
        loop = of("hysteresis", chi2=1000.0 + loop_alone)
        return evidence(loop, of("hum", chi2=50_000.0), both, null=60_000.0)

    assert decided(seen(170.0), line_of_others=0.001).best.names == ("hum", "hysteresis")
    harmonic = decided(seen(170.0), line_of_others=0.1)
    assert harmonic.best.names == ("hysteresis",)
    assert "harmonic" in {r.rule for r in harmonic.ledger}
    assert decided(seen(470.0), line_of_others=0.1).best.names == ("hum", "hysteresis")
