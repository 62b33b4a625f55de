"""Numerical parts, control laws and elements in Python: the same equations as those in C, and the
same numbers; what they do wrong is told with their own file and line."""

from __future__ import annotations

import re
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import own_parts
import pytest

import rthyb_rt as rt
from rthyb_rt import core
from rthyb_rt.config import timescale
from rthyb_rt.core import own, own_methods
from rthyb_rt.lab import experiment

SHORT = rt.Test("section5-T0.5", ground_motion={"duration_s": 3}, test={"free_vibration_s": 0.5})
HERE = Path(own_parts.__file__).name


@pytest.fixture(scope="module")
def plain() -> rt.Recording:
    return rt.run(SHORT)


def same_numbers(one: rt.Recording, other: rt.Recording, *names: str) -> None:
    for name in names or ("x_num_m", "x_meas_m", "f_meas_n", "x_cmd_m", "k_t_n_per_m"):
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_a_numerical_part_gives_what_the_one_in_c_gives(plain: rt.Recording) -> None:
    figures = rt.check(SHORT).figures
    part = own_parts.Oscillator(figures["mass_kg"], figures["damping_n_s_per_m"])
    rec = rt.run(SHORT.with_(numerical=part))
    same_numbers(plain, rec)
    velocity = np.diff(rec["x_num_m"]) * 1024.0
    np.testing.assert_allclose(rec["velocity"][:-1][rec.running[1:]], velocity[rec.running[1:]])
    assert rt.replay(rec).identical


def test_a_control_law_gives_what_the_one_in_c_gives() -> None:
    written = SHORT.with_(controller={"type": "chen-ricles", "chen_ricles": {"delay_s": 0.014}})
    in_c = rt.run(written)
    rec = rt.run(SHORT.with_(controller=own_parts.Inverse(0.014)))
    same_numbers(in_c, rec)
    same_numbers(in_c, rec, "alpha", "beta")
    led = rec["x_plc_m"] - rec["x_num_m"]  # of the next instant, where the row is of this one
    np.testing.assert_allclose(rec["effort"][:-1], led[1:], atol=1e-12)
    assert rt.replay(rec).identical


@pytest.mark.parametrize("rig", ["shaking-table-portal-frame", "delay-10-elastic"])
def test_elements_give_what_those_of_the_catalogue_give(rig: str) -> None:
    base = SHORT.with_(rig=rig)
    k = base.rig["rig.elastic_stiffness_n_per_m"]
    given = [
        {"element": "stiffness", "k_n_per_m": k},
        {"element": "maxwell", "km_n_per_m": 0.2 * k, "tau_s": 0.05},
    ]
    own_ones = [own_parts.Spring(k), own_parts.Maxwell(0.2 * k, 0.05)]
    in_c = rt.run(base.with_(rig={"specimen": given}))
    rec = rt.run(base.with_(rig={"specimen": own_ones}))
    same_numbers(in_c, rec)
    same_numbers(in_c, rec, "x_ref_m", "f_ref_n")


def test_a_copy_of_an_element_goes_on_by_itself() -> None:
    config = core.ElementConfig("python", (), own.spelled(own_parts.Maxwell(1e5, 0.1)))
    one, other, kept = core.CoreElement(config), core.CoreElement(config), core.CoreElement(config)
    x = 1e-3 * np.sin(np.arange(300) / 20.0)
    whole = kept.run(x)
    np.testing.assert_array_equal(one.run(x[:150]), whole[:150])
    other.run(-x[:150])
    np.testing.assert_array_equal(one.run(x[150:]), whole[150:])


# ---- files and other processes ------------------------------------------------------------------


def test_a_test_with_classes_of_ones_own_is_written_as_toml_and_reads_back_equal() -> None:
    test = SHORT.with_(
        controller=own_parts.Inverse(0.01), numerical=own_parts.Oscillator(4220.0),
        rig={"specimen": [own_parts.Spring(6e5)]},
    )  # fmt: skip
    text = test.to_toml()
    assert 'class = "own_parts:Oscillator"' in text
    assert rt.Test.from_toml(text, test.rig) == test
    assert rt.Rig.from_toml(test.rig.to_toml()) == test.rig


@pytest.mark.long
def test_a_sweep_over_settings_of_a_law_runs_in_processes_of_their_own(tmp_path: Path) -> None:
    test = SHORT.with_(controller=own_parts.Inverse(0.01))
    found = rt.sweep(
        test, {"controller.python.settings.delay_s": [0.0, 0.014]}, out=tmp_path / "s", jobs=2
    )
    assert [row["ending"] for row in found.rows] == ["completed", "completed"]
    errors = [row["tracking_nrmse"] for row in found.rows]
    alone = rt.run(test.with_({"controller.python.settings.delay_s": 0.014}))
    assert errors[1] == alone.measures["tracking_nrmse"]
    assert errors[0] > 1.5 * errors[1]


@pytest.mark.long
def test_a_run_of_a_sweep_whose_law_fails_is_a_row_that_names_file_and_line(tmp_path: Path) -> None:
    test = SHORT.with_(controller=own_parts.Inverse(0.01))
    key = "controller.python.settings.fails_at"
    found = rt.sweep(test, {key: [0, 5000]}, out=tmp_path / "s", jobs=1)
    assert [row["ending"] for row in found.rows] == ["completed", "failed"]
    assert f"{HERE}:" in str(found.rows[1]["cause"])
    assert "the law has had enough" in str(found.rows[1]["cause"])


@pytest.mark.parametrize(
    ("given", "stored"),
    [
        (np.array([0.01, 0.002]), [0.01, 0.002]),
        (np.array([0.01]), [0.01]),
        (np.array([True, False]), [True, False]),
        (np.array([2, 3]), [2, 3]),
        ([np.int64(2), np.float64(0.5)], [2, 0.5]),
        (np.array(0.01), 0.01),
        (np.float32(0.5), 0.5),
        (np.array([]), []),
    ],
)
def test_numpy_array_as_a_setting_is_stored_as_a_list(given: Any, stored: Any) -> None:
    test = SHORT.with_(controller=own_parts.Weighted(given))
    found = test["controller.python.settings.weights"]
    assert found == stored
    # What is read from a test refuses every change; a part of it is a plain list.
    assert type(found[:] if isinstance(found, list) else found) is type(stored)
    again = rt.Test.from_toml(test.to_toml(), test.rig)
    assert again == test
    assert again["controller.python.settings.weights"] == stored


def test_law_with_an_array_runs_as_with_the_list() -> None:
    weights = [0.5, 0.25]
    by_list = rt.run(SHORT.with_(controller=own_parts.Weighted(weights)))
    by_array = rt.run(SHORT.with_(controller=own_parts.Weighted(np.array(weights))))
    same_numbers(by_list, by_array)
    assert rt.replay(by_array).identical


@pytest.mark.parametrize("given", [np.eye(2), np.array([1j]), np.array([None]), [[1.0]], {"a": 1}])
def test_what_is_no_list_of_plain_values_is_refused_with_words(given: Any) -> None:
    with pytest.raises(rt.InputError, match=r"or a list or a one-dimensional array of these"):
        SHORT.with_(controller=own_parts.Weighted(given))


# ---- what goes wrong ----------------------------------------------------------------------------


FAULTY = [
    ({"numerical": own_parts.Failing(4220.0)}, ZeroDivisionError, own_parts.Failing.answer),
    ({"numerical": own_parts.Late()}, ValueError, own_parts.Late.begin),
    ({"numerical": own_parts.Silly(4220.0, "nan")}, rt.InputError, own_parts.Silly.answer),
    ({"controller": own_parts.Inverse(0.01, 3)}, RuntimeError, own_parts.Inverse.lead),
    ({"controller": own_parts.Singular()}, np.linalg.LinAlgError, own_parts.Singular.lead),
    ({"rig": {"specimen": [own_parts.Jumpy("nan")]}}, rt.InputError, own_parts.Jumpy.force),
    ({"rig": {"specimen": [own_parts.Torn()]}}, KeyError, own_parts.Torn.force),
]


def within(method: Any, found: str) -> bool:
    """Return whether a message begins with a line of this method."""
    match = re.match(rf"[\w/.-]*{re.escape(HERE)}:(\d+)", found)
    lines = {line for *_, line in method.__code__.co_lines()}
    return match is not None and int(match[1]) in lines


@pytest.mark.parametrize(("change", "kind", "method"), FAULTY)
def test_check_tells_the_error_of_a_class_as_an_input_error_with_its_cause(
    change: dict[str, Any], kind: type[Exception], method: Any
) -> None:
    test = SHORT.with_(**change)
    with pytest.raises(kind) as raised:
        rt.run(test)
    with pytest.raises(rt.InputError) as caught:
        rt.check(test)
    assert within(method, str(caught.value)), str(caught.value)
    assert isinstance(caught.value.__cause__, kind)
    if kind is rt.InputError:
        assert str(caught.value) == str(raised.value)


@pytest.mark.parametrize(("change", "kind", "method"), FAULTY[-2:])
def test_identify_tells_the_error_of_an_element_as_an_input_error_with_its_cause(
    change: dict[str, Any], kind: type[Exception], method: Any
) -> None:
    with pytest.raises(rt.InputError) as caught:
        rt.identify(SHORT.with_(**change).rig)
    assert within(method, str(caught.value)), str(caught.value)
    assert isinstance(caught.value.__cause__, kind)


def test_an_error_in_a_part_comes_out_as_it_was_raised_with_its_own_line() -> None:
    with pytest.raises(ZeroDivisionError) as caught:
        rt.run(SHORT.with_(numerical=own_parts.Failing(4220.0)))
    last = traceback.extract_tb(caught.value.__traceback__)[-1]
    assert Path(last.filename).name == HERE
    assert last.line is not None
    assert "super().answer(ag_mps2, force_n) / (1" in last.line


def test_after_an_error_the_next_test_runs_as_if_nothing_had_been(plain: rt.Recording) -> None:
    with pytest.raises(ZeroDivisionError):
        rt.run(SHORT.with_(numerical=own_parts.Failing(4220.0)))
    same_numbers(plain, rt.run(SHORT))


def test_an_error_in_a_law_is_told_with_file_line_and_what_was_asked_of_it() -> None:
    with pytest.raises(rt.RthybError) as caught:
        core.Law(core.LawConfig("python", own=own.spelled(own_parts.Inverse(0.0, 3)))).run(
            [0.0] * 9
        )
    text = str(caught.value)
    assert f"{HERE}:" in text
    assert "RuntimeError: the law has had enough (lead of own_parts:Inverse at tick 2 of" in text


def told(change: dict[str, Any]) -> str:
    """Return the message of a test with changes, by table or dotted key."""
    tables = {key: value for key, value in change.items() if "." not in key}
    dotted = {key: value for key, value in change.items() if "." in key}
    with pytest.raises(rt.InputError) as caught:
        rt.run(SHORT.with_(dotted, **tables))
    return str(caught.value)


SENSELESS = ["nan", "inf", "-inf", "1e300"]


@pytest.mark.parametrize("what", [*SENSELESS, "1e9"])
def test_senseless_displacement_of_a_part_is_told_with_class_method_line_and_tick(
    what: str,
) -> None:
    found = told({"numerical": own_parts.Silly(4220.0, what, after=300)})
    assert re.match(rf"{PLACE}, in answer: Silly.answer returned {as_shown(what)} at tick", found)
    assert "at tick 300 of a simulation without the rig, for ag_mps2 = " in found
    assert "it must return the displacement of the next sample" in found


@pytest.mark.parametrize("what", SENSELESS)
def test_senseless_force_of_an_element_ends_the_test_where_it_was_returned(what: str) -> None:
    jumpy = {"rig": {"specimen": [own_parts.Jumpy(what, from_m=1e-3)]}}
    found = told(jumpy)
    assert re.match(rf"{PLACE}, in force: Jumpy.force returned {as_shown(what)} at tick", found)
    assert "of a simulation without the rig, for x_m = " in found
    element = core.CoreElement(core.ElementConfig("python", (), own.spelled(own_parts.Jumpy(what))))
    with pytest.raises(rt.RthybError, match=r"Jumpy.force returned .*, for x_m = 0.002"):
        element.force(2e-3, 0.0, 0.0, 0.0)


def test_an_element_that_fails_on_the_rig_alone_is_told_with_the_tick_of_the_test() -> None:
    """On the rig it moves in steps of a fraction of a sample, otherwise of a whole one."""
    found = told({"rig": {"specimen": [own_parts.Jumpy("nan", from_m=1e-3, longest_s=5e-4)]}})
    where = re.search(r"returned nan at tick (\d+) of the test \(([\d.]+) s\), for x_m", found)
    assert where is not None, found
    assert int(where[1]) / 1024 == pytest.approx(float(where[2]), abs=1e-3)


@pytest.mark.parametrize("what", [*SENSELESS, "1e9"])
def test_senseless_command_of_a_law_is_told_with_class_method_line_and_tick(what: str) -> None:
    found = told({"controller": own_parts.Astray(what, after=200)})
    assert re.match(rf"{PLACE}, in lead: Astray.lead returned {as_shown(what)} at tick", found)
    assert "at tick 200 of a simulation without the rig, for x_c_m = " in found


def test_law_and_element_whose_numbers_are_possible_but_absurd_are_named() -> None:
    found = told({"controller": own_parts.Astray("5", after=200)})
    assert "the command after the control law moves from" in found
    assert "to 5 m at the next; at most 50 m/s are possible: check your own own_parts:As" in found
    found = told({"rig": {"specimen": [own_parts.Jumpy("1e9")]}})
    assert "in the reference simulation the structure moves from 0 m at tick 0" in found
    assert "check your own own_parts:Jumpy" in found
    with pytest.raises(rt.RthybError, match=r"not at rest.*check own_parts:Astray: at rest its"):
        rt.run(SHORT.with_(controller=own_parts.Astray("0.01")))


REPORTED = [*SENSELESS, "-1e200"]


@pytest.mark.parametrize("what", REPORTED)
def test_senseless_response_of_a_part_ends_the_test_with_class_line_tick_and_value(
    what: str,
) -> None:
    found = told({"numerical": own_parts.Reporting(what, after=300)})
    line = line_of(own_parts.Reporting.report)
    assert found.startswith(f"{line}, in report: Reporting.report returned velocity = "), found
    assert f"velocity = {float(what)!r} at tick 300 of a simulation without the rig;" in found
    assert "one for each of its responses, finite and of at most 1e+150" in found


@pytest.mark.parametrize("what", REPORTED)
@pytest.mark.parametrize("name", ["alpha", "tau_s"])
def test_senseless_value_of_a_law_ends_the_test_with_class_line_tick_and_value(
    name: str, what: str
) -> None:
    found = told({"controller": own_parts.Valued(name, what, after=200)})
    line = line_of(own_parts.Valued.lead)
    assert found.startswith(f"{line}, in lead: Valued.values names {name}, but"), found
    assert (
        f"but the attribute {name} is {float(what)!r} after lead at tick 200 of a simulation"
        in found
    )
    assert f"set self.{name} to a number, finite and of at most 1e+150" in found


def test_value_of_a_law_that_is_senseless_from_the_beginning_is_told_with_begin() -> None:
    found = told({"controller": own_parts.Valued("tau_s", "nan", after=-1)})
    assert found.startswith(f"{line_of(own_parts.Valued.begin)}, in begin: Valued.values names tau")
    assert "is nan after begin; set self.tau_s to a number, finite and" in found


def test_values_up_to_the_largest_are_recorded_as_they_are() -> None:
    """Of any kind of number; the largest is one whose square is finite."""
    largest = own_methods.VALUE_MAX
    assert np.isfinite(largest * largest)
    for what in (repr(largest), repr(-largest)):
        rec = rt.run(SHORT.with_(controller=own_parts.Valued("tau_s", what, after=0)))
        assert rec["tau_s"][rec.running][-1] == float(what)
    with pytest.raises(rt.RthybError, match="of at most"):
        own_methods.value_of(own_parts.Valued("tau_s", "1", 0), "tau_s", "lead")


def line_of(method: Any) -> str:
    """Return file and line of a method as messages name them."""
    code = method.__code__
    return f"{Path(code.co_filename).relative_to(Path.cwd())}:{code.co_firstlineno}"


def with_attribute(base: type, **attributes: Any) -> Any:
    """Return an object of a class at the top level of own_parts, with other attributes."""
    made = type("Changed", (base,), {"__module__": own_parts.__name__, **attributes})
    own_parts.Changed = made  # type: ignore[attr-defined]
    return made(*{own_parts.Oscillator: (4220.0,), own_parts.Inverse: (0.01,)}.get(base, ()))


ILL_FORMED = [
    (own_parts.Unset, "values", ["tau_s"], "has values = ['tau_s']: define values as a dict"),
    (own_parts.Unset, "values", None, "has values = None: define values as a dict of names and"),
    (own_parts.Unset, "values", {"Tau": "s"}, "has 'Tau' as a name in values; a name consists"),
    (own_parts.Unset, "values", {"tau": 1}, "has 1 as the unit of tau in values; a unit is a"),
    (own_parts.Unset, "values", {f"v{i}": "1" for i in range(99)}, "has 99 values; at most"),
    (own_parts.Unset, "lead", 3, "Changed.lead at module own_parts is 3, which is not a method"),
    (own_parts.Unset, "observe", "x", "is 'x', which is not a method: define it as observe(self"),
    (own_parts.Oscillator, "responses", {3: "m"}, "has 3 as a name in responses; a name consists"),
    (own_parts.Oscillator, "responses", "roof", "has responses = 'roof': define responses as a"),
    (own_parts.Oscillator, "responses", {f"v{i}": "1" for i in range(99)}, "has 99 responses; at"),
    (own_parts.Oscillator, "report", rt.NumericalPart.report, "no method report(self); define it"),
    (own_parts.Oscillator, "answer", None, "is None, which is not a method: define it as answer("),
]


@pytest.mark.parametrize(("base", "name", "value", "words"), ILL_FORMED)
@pytest.mark.parametrize("does", [rt.run, rt.check])
def test_attribute_of_the_wrong_form_is_told_with_class_and_what_to_do(
    does: Any, base: type, name: str, value: Any, words: str
) -> None:
    table = "controller" if issubclass(base, rt.ControlLaw) else "numerical"
    test = SHORT.with_(**{table: with_attribute(base, **{name: value})})
    with pytest.raises(rt.InputError) as caught:
        does(test)
    found = str(caught.value)
    assert found.startswith(f'with_: {table}.python.class: "own_parts:Changed": Changed'), found
    assert words in found
    assert len(caught.value.problems) == 1


def test_responses_without_report_are_told_with_their_names() -> None:
    found = told({"numerical": own_parts.Unreported(4220.0)})
    assert re.search(rf"Unreported at {PLACE} has no method report\(self\)", found)
    assert "because its responses are roof, drift" in found
    assert "own.py" not in found


def test_report_without_responses_is_told_because_nobody_would_call_it() -> None:
    found = told({"numerical": own_parts.Unasked()})
    assert re.search(rf"Unasked at {PLACE} has a method report but no responses", found)
    assert 'define responses as a dict of names and units, {"roof": "m"}, in the class' in found
    assert "own.py" not in found


def test_static_methods_and_other_callables_are_methods() -> None:
    still = with_attribute(own_parts.Unset, values={}, lead=staticmethod(lambda x, allowed: x))
    assert rt.run(SHORT.with_(controller=still)).completed


WRONG = [
    ("controller", own_parts.Short, "Short.lead", "takes (self, x_c_m), but it is called with 2"),
    ("controller", own_parts.Misspelt, "Misspelt", "lead(self, x_c_m, allowed_m); is laed miss"),
    ("controller", own_parts.Mute, "Mute.lead", "returned None (is a return missing?) at tick 0"),
    ("controller", own_parts.Unset, "Unset.values", "names gain, but the attribute gain is missi"),
    ("numerical", own_parts.OneResponse, "OneResponse.report", "returned 3.0 instead of 1 values"),
    ("element", own_parts.Text, "Text.force", "returned 'stiff' at tick 0"),
    (
        "element",
        own_parts.ShortForce,
        "ShortForce.force",
        "define it as force(self, x_m, v_m_per_s",
    ),
]


@pytest.mark.parametrize(("place", "kind", "name", "words"), WRONG)
def test_a_method_of_the_wrong_form_is_told_with_the_users_class_and_line(
    place: str, kind: Any, name: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    change = {"rig": {"specimen": [kind()]}} if place == "element" else {place: kind()}
    found = told(change)
    assert name in found
    assert words in found
    assert re.search(PLACE, found)
    assert "own.py" not in found
    assert capfd.readouterr().err == ""


PLACE = rf"[\w/.-]*{re.escape(HERE)}:\d+"


def as_shown(what: str) -> str:
    return re.escape(repr(float(what)))


def test_in_real_time_classes_in_python_are_refused_with_what_takes_their_place() -> None:
    test = SHORT.with_(
        controller=own_parts.Inverse(0.01), numerical=own_parts.Oscillator(4220.0),
        rig={"specimen": [own_parts.Spring(6e5)]},
    )  # fmt: skip
    from rthyb_rt.api import files

    with pytest.raises(rt.InputError) as caught:
        experiment.prepare(files.file_of_test(test), files.file_of_rig(test.rig), real_time=True)
    places = {problem.where.split(" ")[-1]: problem.message for problem in caught.value.problems}
    assert set(places) == {"numerical.python", "controller.python", "rig.specimen.0"}
    assert "numerical.library" in places["numerical.python"]
    assert "garbage collection" in places["controller.python"]


def test_a_class_that_is_not_there_is_refused_with_its_place() -> None:
    name = "with_: controller.python.class"
    found = told({"controller.type": "python", "controller.python": {"class": "own_parts:Nobody"}})
    assert found.startswith(f'{name}: "own_parts:Nobody": module own_parts has no Nobody')
    found = told({"controller.type": "python", "controller.python": {"class": "no_such:Law"}})
    assert "cannot be imported (No module named 'no_such')" in found
    found = told({"controller.type": "python", "controller.python": {"class": "own_parts:Spring"}})
    assert '"own_parts:Spring" is not a ControlLaw' in found
    found = told({"controller.type": "python", "controller.python": {"class": "my laws"}})
    assert 'the class must be the name of a module and of a class in it, "my_parts:Osc' in found
    found = told({"controller.type": "python"})
    assert 'type = "python" needs it' in found
    found = told(
        {"numerical.integrator": "cr", "numerical.python": {"class": "own_parts:Oscillator"}}
    )
    assert "does its own integration" in found


def test_settings_that_the_class_does_not_take_are_told_with_those_that_it_takes() -> None:
    wrong = {"class": "own_parts:Oscillator", "settings": {"mass": 3.0}}
    found = told({"numerical.python": wrong})
    where = line_of(own_parts.Oscillator.__init__)
    assert found == (
        'with_: numerical.python.settings.mass: "own_parts:Oscillator": Oscillator.__init__ at '
        f"{where} takes the settings mass_kg, damping_n_s_per_m = 0.0; found mass: mass_kg is "
        "missing, mass is unknown (is it mass_kg?)"
    )
    found = told({"numerical.python": {"class": "own_parts:Oscillator"}})
    assert "found none: mass_kg is missing" in found
    test = SHORT.with_(controller=own_parts.Inverse(0.01))
    with pytest.raises(rt.InputError, match=r"with_: controller.python.settings.b: .* b is unk"):
        rt.run(test.with_({"controller.python.settings.b": 2}))
    bare = {"element": "python", "class": "own_parts:Text", "settings": {"k": 2.0}}
    for does in (rt.run, rt.check, lambda test: rt.identify(test.rig)):
        with pytest.raises(rt.InputError, match=r"Text.__init__ at .* no settings; found k: k is"):
            does(SHORT.with_({"rig.specimen": [bare]}))


def test_wrong_settings_in_a_file_are_told_with_the_line_of_the_file(tmp_path: Path) -> None:
    good = SHORT.with_(controller=own_parts.Inverse(0.01)).to_toml()
    assert good.count("delay_s = 0.01\n") == 1
    path = tmp_path / "mine.toml"
    path.write_text(good.replace("delay_s = 0.01\n", "delay = 0.01\n"))
    number = path.read_text().split("\n").index("delay = 0.01") + 1
    with pytest.raises(rt.InputError) as caught:
        rt.run(path, SHORT.rig)
    assert str(caught.value).startswith(
        f'{path}:{number}: controller.python.settings.delay: "own_parts:Inverse": Inverse.__init__'
    )
    path.write_text(good.replace("delay_s = 0.01\n", ""))
    with pytest.raises(rt.InputError) as caught:
        rt.run(path, SHORT.rig)
    number = path.read_text().split("\n").index("[controller.python.settings]") + 1
    assert str(caught.value).startswith(f"{path}:{number}: controller.python.settings: ")
    assert str(caught.value).endswith("found none: delay_s is missing")


def test_settings_that_have_no_name_are_refused_with_words() -> None:
    found = told({"controller": own_parts.Unnamed(0.01, 0.02)})
    assert "takes *delays_s by position only, but a file states every setting by its name" in found


def test_an_object_created_with_wrong_arguments_is_told_with_its_class() -> None:
    with pytest.raises(TypeError, match=r"^Oscillator\(\) missing a required argument: 'mass_kg'"):
        own_parts.Oscillator()  # type: ignore[call-arg]


def test_what_no_file_can_hold_is_refused_where_it_is_given() -> None:
    class Inner(rt.ControlLaw):
        """Nothing else finds it."""

    with pytest.raises(rt.InputError, match="define the class at the top level of its module"):
        SHORT.with_(controller=Inner())
    with pytest.raises(rt.InputError, match=r"give an instance, Spring\(\.\.\.\)"):
        SHORT.with_(rig={"specimen": [own_parts.Spring]})
    with pytest.raises(rt.InputError, match="a setting must be a number"):
        SHORT.with_(controller=own_parts.Inverse(object()))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("tables", "form"),
    [
        ({"controller": {"type": "python", "python": own_parts.Inverse(0.01)}}, "controller=Inv"),
        ({"controller": {"python": {"class": own_parts.Inverse(0.01)}}}, "controller=Inverse(...)"),
        ({"numerical": {"python": own_parts.Oscillator(4220.0)}}, "numerical=Oscillator(...)"),
        (
            {"rig": {"specimen": [{"element": "python", "class": own_parts.Spring(6e5)}]}},
            "specimen=[Spring(...)]",
        ),
    ],
)
def test_object_in_place_of_one_of_its_keys_is_told_with_its_table(
    tables: dict[str, Any], form: str
) -> None:
    with pytest.raises(rt.InputError, match="it stands for its whole table") as caught:
        SHORT.with_(**tables)
    assert form in str(caught.value)


def test_an_element_of_ones_own_is_accepted_in_a_list_and_a_law_or_a_part_is_not() -> None:
    accepted = SHORT.with_(rig={"specimen": [own_parts.Spring(6e5)]})
    assert accepted.rig["specimen"][0]["settings"] == {"k_n_per_m": 6e5}
    for other, place in (
        (own_parts.Inverse(0.014), "a control law; give it as controller=Inverse"),
        (own_parts.Oscillator(4220.0), "a numerical part; give it as numerical=Oscillator"),
    ):
        with pytest.raises(rt.InputError, match=f"which is {place}"):
            SHORT.with_(rig={"specimen": [other]})


def test_an_element_of_ones_own_is_accepted_in_true_time_only() -> None:
    test = SHORT.with_(rig={"specimen": [own_parts.Spring(4737410.0)]})
    checked = rt.check(test.with_({"test.time_scale": 1}))
    assert checked.document["figures"]
    with pytest.raises(rt.InputError, match=r"Spring, a class in Python, .*remove one of the two"):
        rt.check(test.with_({"test.time_scale": 2}))
    element = core.ElementConfig("python", (), own.spelled(own_parts.Spring(6e5)))
    assert timescale.slowed(element, 1.0) is element
    assert timescale.rate_dependent(element)
    with pytest.raises(core.CoreError, match="Spring behaves in stretched time is not known"):
        timescale.slowed(element, 2.0)


def test_a_period_that_is_not_the_parts_own_is_noted() -> None:
    part = own_parts.Oscillator(4.0 * SHORT["numerical.mass_kg"])
    notes = rt.check(SHORT.with_(numerical=part)).notes
    assert any("its period is 1 s" in note for note in notes)


def test_a_diagnosis_refuses_a_model_with_a_class_in_python() -> None:
    rec = rt.run(SHORT)
    model = SHORT.rig.with_(specimen=[own_parts.Spring(6e5)])
    with pytest.raises(rt.InputError, match="own_parts:Spring is a class in Python"):
        rt.diagnose(rec, model)


# ---- an effect for the diagnosis ----------------------------------------------------------------


@pytest.mark.parametrize("ends", [(1.0, 1e-9), (1.0, 1.0), (0.0, float("nan")), ("0 m", 1.0)])
def test_parameter_without_a_range_is_refused(ends: tuple[Any, Any]) -> None:
    with pytest.raises(rt.InputError, match=r'Param "gap_m": found the range from .* below high'):
        rt.Param("gap_m", "m", *ends)


class Magnet(rt.Effect):
    """A magnet at a place pulls the specimen to it."""

    name = "magnet"
    params = (rt.Param("pull_N", "N", 0.0, 1e6), rt.Param("at_m", "m", -1.0, 1.0))
    equation = "f = pull exp(-((x - at) / 0.3 mm)^2)"
    fingerprint = "a force at one displacement only"
    signs = "+"

    def trials(self, ctx: rt.Context) -> list[rt.Trial]:
        return [rt.Trial((float(x),)) for x in np.linspace(0.1, 0.9, 17) * ctx.x_range]

    def columns(self, ctx: rt.Context, trial: rt.Trial) -> list[Any]:
        return [np.exp(-(((ctx.x - trial.theta[0]) / 3e-4) ** 2))]

    def report(self, ctx: rt.Context, trial: rt.Trial, beta: Any) -> dict[str, float]:
        return {"pull_N": float(beta[0]), "at_m": trial.theta[0]}


class Broken(Magnet):
    """Looks for something that is not there."""

    def columns(self, ctx: rt.Context, trial: rt.Trial) -> list[Any]:
        return [ctx.other["no such channel"]]


class Bump(rt.Element):
    """The force of that magnet."""

    def force(self, x_m: float, v: float, a: float, dt_s: float, state: Any) -> float:
        return float(900.0 * np.exp(-(((x_m - 3e-3) / 3e-4) ** 2)))


@pytest.fixture(scope="module")
def pulled() -> rt.Recording:
    test = rt.Test("section5-T0.5")
    return rt.run(test.with_(rig={"specimen": [*test.rig["specimen"], Bump()]}))


@pytest.mark.long
def test_an_effect_of_ones_own_is_found_and_leaves_the_catalogue_as_it_was(
    pulled: rt.Recording, tmp_path: Path
) -> None:
    from rthyb_rt.diagnose import effects

    before = effects.catalogue()
    found = rt.diagnose(pulled, SHORT.rig, effects=[Magnet()])
    assert (found.verdict, found.effects) == ("explained", ["magnet"])
    assert found.answer["candidates"][0]["params"]["pull_N"] == pytest.approx(900.0, rel=0.02)
    assert "magnet" in found.text
    assert found.report(tmp_path / "told")
    assert effects.catalogue() == before


@pytest.mark.long
def test_an_error_in_an_effect_names_its_line(pulled: rt.Recording) -> None:
    with pytest.raises(KeyError) as caught:
        rt.diagnose(pulled, SHORT.rig, effects=[Broken()])
    lines = [frame.line for frame in traceback.extract_tb(caught.value.__traceback__)]
    assert 'return [ctx.other["no such channel"]]' in lines


def test_an_effect_that_is_none_or_lacks_something_is_refused(pulled: rt.Recording) -> None:
    class Nameless(Magnet):
        """Has everything but a name."""

        name = ""

    with pytest.raises(rt.InputError, match="effect 'Nameless' lacks name"):
        rt.diagnose(pulled, SHORT.rig, effects=[Nameless()])
    with pytest.raises(rt.InputError, match=r"such as Magnet\(\)"):
        rt.diagnose(pulled, SHORT.rig, effects=[Magnet])  # type: ignore[list-item]
