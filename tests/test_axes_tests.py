"""Test files on rigs of several axes: directions by name, laws of axes, limits, and what does not
fit together."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from rthyb_rt import config
from rthyb_rt.config import AxesRig
from rthyb_rt.config.deriving import derive
from rthyb_rt.config.deriving_axes import AxesDerived, derive_axes, in_order, resolve_axes
from rthyb_rt.errors import InputError

RIG = """schema = "rthyb-rig/1"
[rig]
name = "two-storeys"
[[axis]]
name = "left"
actuator = { kind = "second-order", natural_frequency_hz = 20, damping_ratio = 0.7 }
limits = { command_position_m = "30 mm", force_n = "60 kN" }
sensors = { displacement = { noise_std_m = 2e-6 } }
identified = { alpha = 12.0, delay_s = 0.0117 }
[[axis]]
name = "right"
actuator = { kind = "pure-delay", delay_samples = 9 }
limits = { command_position_m = "20 mm" }
identified = { alpha = 9.0, delay_s = 0.0088 }
[kinematics]
kind = "matrix"
interface = ["ground-floor", "first-floor"]
matrix = [[1, 0], [1, 1]]
[specimen]
stiffness = [[8e6, -1e6], [-1e6, 6e6]]
[limits]
ramp_in_s = 1.5
force_n = "90 kN"
"""
TEST = """schema = "rthyb-test/1"
rig = "none"
[test]
name = "two"
[numerical.storeys]
count = 3
mass_kg = "10 t"
stiffness_n_per_m = "8 MN/m"
specimen = [1, 2]
[numerical.damping]
ratio = 0.02
modes = [1, 2]
[[interface]]
name = "first-floor"
storey = 2
[[interface]]
name = "ground-floor"
storey = 1
[controller]
type = "paper"
"""


def rig(text: str = RIG) -> AxesRig:
    found = config.parse_any_rig(text, "rig.toml")
    assert isinstance(found, AxesRig)
    return found


def derived(test: str = TEST, given: str = RIG) -> AxesDerived:
    return derive_axes(config.parse_test(test, "test.toml"), rig(given))


def test_what_the_rig_notes_is_noted_for_every_test_on_it() -> None:
    plain = re.sub(r"actuator = .*\n", "", RIG)
    integrator = "[plant]\na = [[0, 0], [0, -300]]\nb = [[1, 0], [0, 300]]\nc = [[1, 0], [0, 1]]\n"
    assert any("poles that neither" in note for note in derived(given=plain + integrator).notes)
    assert not any("poles that neither" in note for note in derived().notes)


@pytest.mark.parametrize("count", [32, 33])
def test_more_friction_dampers_than_can_be_solved_for_are_noted_with_several_axes(
    count: int,
) -> None:
    law = 'law = { element = "coulomb", fc_n = "20 kN", width_m_per_s = 1e-5 }'
    storeys = f"storeys = {list(range(3, count + 3))}\nbeside = true"
    tall = TEST.replace("count = 3", "count = 40").replace(
        "[[interface]]", f"[[numerical.nonlinear]]\n{storeys}\n{law}\n[[interface]]", 1
    )
    notes = [note for note in derived(tall).notes if "dry friction" in note]
    assert len(notes) == (count > 32)


def faults(test: str = TEST, given: str = RIG) -> list[str]:
    with pytest.raises(InputError) as caught:
        derived(test, given)
    return [str(problem) for problem in caught.value.problems]


def test_interfaces_are_taken_by_name_in_the_order_of_the_rigs_directions() -> None:
    structure = derived().structure
    assert structure.interfaces == ("ground-floor", "first-floor")
    rows = structure.part.interface_rows()
    assert np.array_equal(rows, [[1, 0, 0], [-1, 1, 0]])


def test_the_structure_knows_the_whole_stiffness_of_the_specimen() -> None:
    """Modes of the joined structure against numpy."""
    k_e = np.array([[8e6, -1e6], [-1e6, 6e6]])
    b = np.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0]])
    third = np.array([0.0, -1.0, 1.0])
    whole = b.T @ k_e @ b + 8e6 * np.outer(third, third)
    wanted = np.sqrt(np.linalg.eigvalsh(whole / 1e4)) / (2 * np.pi)
    found = [mode.frequency_hz for mode in derived().structure.modes()]
    assert np.allclose(found, wanted, rtol=1e-9)


def test_each_axis_has_its_own_law_delay_and_limits() -> None:
    left, right = derived().axis
    assert left.law_settings["alpha0"] == 12.0
    assert right.law_settings["alpha0"] == 9.0
    assert left.limits.limits.force_n is not None
    assert left.limits.limits.force_n.value == 60e3
    assert right.limits.limits.force_n is not None
    assert right.limits.limits.force_n.value == 90e3
    assert left.limits.ramp_in_s == right.limits.ramp_in_s == 1.5
    # What an axis feels with the other one standing still.
    back = np.linalg.inv([[1, 0], [1, 1]])
    k = back.T @ np.array([[8e6, -1e6], [-1e6, 6e6]]) @ back
    assert [left.k_e_n_per_m, right.k_e_n_per_m] == pytest.approx(np.diag(k).tolist())


def test_a_law_is_chosen_for_an_axis_by_its_name() -> None:
    text = TEST + '[[controller.axis]]\nname = "right"\ntype = "robust"\n'
    left, right = derived(text).axis
    assert set(left.law_settings) != set(right.law_settings)
    test = config.parse_test(text, "test.toml")
    written = resolve_axes(test, rig(), derive_axes(test, rig()))
    assert [(law.name, law.type) for law in written.controller.axis] == [
        ("left", "paper"),
        ("right", "robust"),
    ]
    again = config.parse_test(config.dump(written), "again")
    assert again == written
    for one, other in zip(derive_axes(again, rig()).axis, (left, right), strict=True):
        assert one.law_settings == other.law_settings
        assert one.window_samples == other.window_samples
        assert one.limits.limits == other.limits.limits


def test_a_test_may_not_weaken_a_limit_of_one_axis() -> None:
    (found,) = faults(TEST + '[limits]\nforce_n = "80 kN"\n')
    assert re.search(r"axis left: test.toml:\d+: limits.force_n: found 80000 N; .*60000 N", found)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            'name = "first-floor"',
            'name = "first-flor"',
            r'interface.0.name: found "first-flor" \(did '
            r'you mean "first-floor"\?\); rig "two-storeys" has the directions',
        ),
        (
            '[[interface]]\nname = "first-floor"\nstorey = 2\n',
            "",
            'interface: found 1 of 2; the direction "first-floor"',
        ),
        (
            "storey = 2",
            "storey = 3",
            "interface.1: found storey 3; the actuator moves the specimen",
        ),
        (
            "storey = 2",
            "storey = 2\nlimits = { position_rad = 0.1 }",
            "interface.0.limits.position_rad: the direction first-floor does not turn",
        ),
        (
            'type = "paper"',
            'type = "matrix"',
            r'controller.type: found "matrix", which needs an inverse'
            r".*no \[identified\]: run `rthyb identify RIG`",
        ),
        (
            'type = "paper"',
            'type = "paper"\n[[controller.axis]]\nname = "rihgt"',
            r"controller.axis.0."
            r'name: found "rihgt" \(did you mean "right"',
        ),
    ],
)
def test_what_does_not_fit_the_rig_is_told(old: str, new: str, said: str) -> None:
    assert old in TEST
    found = faults(TEST.replace(old, new, 1))
    assert any(re.search(said, one) for one in found), found


def test_a_time_in_samples_is_told_once_where_it_stands() -> None:
    left = 'command_position_m = "30 mm", '
    given = RIG.replace(left, f"{left}sensor_stuck_samples = 64, ")
    found = derived(f"{TEST}\n[limits]\nforce_stuck_samples = 128\n", given)
    assert [note for note in found.notes if "samples" in note] == [
        "test: limits.force_stuck_samples is deprecated: write force_stuck_s = 0.125, in s",
        'rig "two-storeys", axis left: limits.sensor_stuck_samples is deprecated: write '
        "sensor_stuck_s = 0.0625, in s",
    ]


def test_a_numerical_part_of_one_degree_is_not_for_two_axes() -> None:
    text = TEST[: TEST.index("[numerical")] + "[numerical]\nperiod_s = 1\ndamping_ratio = 0\n"
    assert "needs storeys, matrices from a file, or a part of your own" in faults(text)[0]


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ('type = "none"\n[controller.matrix]\nmemory_s = 3', ('this table belongs to type = '
        '"matrix"')),
        (
            'type = "matrix"\n[[controller.axis]]\nname = "a"',
            "compensates all axes; remove one of the two",
        ),
        ('type = "none"\n[[controller.axis]]\nname = "a"\n[[controller.axis]]\nname = "a"',
         'found axis "a" twice'),
        ('type = "none"\n[[controller.axis]]\nname = "a"\ntype = "atz"', 'found "atz"'),
    ],
)  # fmt: skip
def test_laws_that_do_not_go_together_are_refused_by_the_test_file(extra: str, said: str) -> None:
    text = TEST.replace('type = "paper"', extra)
    with pytest.raises(InputError, match=said):
        config.parse_test(text, "test.toml")


def test_two_interfaces_of_one_name_are_refused() -> None:
    with pytest.raises(InputError, match='interfaces 1 and 2 are both called "ground-floor"'):
        config.parse_test(TEST.replace('"first-floor"', '"ground-floor"'), "test.toml")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "the rig has one actuator, which moves one"),
        ({"type": "matrix"}, 'controller.type: found "matrix"; rig .* has one axis'),
    ],
)
def test_a_test_of_two_axes_on_a_rig_of_one_is_refused(change: dict[str, Any], said: str) -> None:
    text = TEST.replace('"paper"', f'"{change["type"]}"') if change else TEST
    with pytest.raises(InputError, match=said):
        derive(
            config.parse_test(text, "test.toml"),
            config.load_rig(config.shipped_rig("delay-10-elastic")),
        )


def test_directions_that_follow_from_one_another_are_refused() -> None:
    pytest.importorskip("scipy")
    from rthyb_rt.config.sparse_structure import _interfaces_of
    from rthyb_rt.config.structures import Interface

    one = Interface(name="a", dof=[["1", 1.0], ["2", -1.0]])
    other = Interface(name="b", dof=[["2", 2.0], ["1", -2.0]])
    with pytest.raises(InputError, match="not independent"):
        _interfaces_of([one, other], ["1", "2"], {"1": 0, "2": 1})


def test_order_is_that_of_the_rig_whatever_the_file() -> None:
    test = config.parse_test(TEST, "test.toml")
    assert [one.name for one in in_order(test, rig()).interface] == ["ground-floor", "first-floor"]
