"""What an engineer who doubts is told: the law over its data, the ledger, what is not held."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import diagnose_cases as cases
import numpy as np
import pytest

pytest.importorskip("matplotlib")

import rthyb_rt as rt
from rthyb_rt import cli
from rthyb_rt.diagnose import (
    catalogue,
    court,
    decide,
    engine,
    page,
    reading,
    residual_laws,
    why,
    words,
)
from rthyb_rt.diagnose.outcome import finish
from rthyb_rt.report import drawing as draw

FRICTION_N = 130.0


def friction(t, x, v, a):
    return FRICTION_N * np.tanh(v / 4e-4)


def hardening(t, x, v, a):
    return friction(t, x, v, a) + 1.5e9 * x**3


def heavier(t, x, v, a):
    return 90.0 * a


def softer(t, x, v, a):
    return -0.09 * cases.K * x


def bump(t, x, v, a):
    return 900.0 * np.exp(-(((x - 3e-3) / 3e-4) ** 2))


def diagnosed(law: Callable | None = None, kind: str = "sweep", late_s: float = 0.0):
    return _diagnosed(law, kind, late_s)


@cache
def _diagnosed(law: Callable | None, kind: str, late_s: float):
    """Once for every way in which it is asked for."""
    columns = cases.channels(law, kind=kind, delay=cases.DELAY + late_s)
    with TemporaryDirectory() as folder:
        recording, toml = cases.write(Path(folder), columns)
        return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


def of_late_load_cell(rows: int = 6) -> dict[str, np.ndarray]:
    columns = cases.channels()
    f = columns["f_meas"]
    columns["f_meas"] = np.concatenate((np.full(rows, f[0]), f[:-rows]))
    return columns


def run(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments])


@pytest.mark.long
def test_what_no_effect_explains_is_unknown_and_located():
    d = diagnosed(bump)
    assert (d.verdict, d.effects) == ("unknown", [])
    assert d.x_m[0] < 3e-3 < d.x_m[1]
    assert d.x_m[1] - d.x_m[0] < 4e-3


@pytest.mark.long
def test_beside_an_unknown_force_the_actuator_that_is_known_is_told_and_the_best_known_set():
    d = diagnosed(bump, late_s=4e-3)
    assert (d.verdict, d.effects) == ("unknown", [])
    told = words.sentence(d, {})
    assert re.search(r"differently is known: 4\.0\d ms more delay of the actuator explains", told)
    best = re.search(r"set of known effects, (.*), would leave (\S+) % of the difference; ", told)
    assert best is not None, told
    # The same share as --why states among the reasons of the verdict.
    reasons = " ".join(" ".join(why.lines(why.to_json(d))).split())
    assert f"leaves {best[2]} % of the misfit" in reasons
    # Of two explanations of the actuator, neither is known; and it must explain something.
    doubted = replace(d, disp=replace(d.disp, equal=[d.disp.best]))
    worse = replace(d, fit=d.fit | {"nrmse_after_disp": 2.0})
    for other in (doubted, worse, replace(d, fit={})):
        assert "actuator" not in words.sentence(other, {})


@pytest.mark.long
def test_where_the_actuator_is_as_stated_nothing_is_said_of_it():
    told = words.sentence(diagnosed(bump), {})
    assert "actuator" not in told
    assert "The best set of known effects" in told


@pytest.mark.long
@pytest.mark.parametrize(
    ("before", "after", "wanted"),
    [
        (50.0, -1e-3, "would leave only noise; --why says why it is not named"),
        (50.0, 20.0, "would leave 40 % of the difference; --why says"),
        (50.0, 60.0, ""), (-1e-3, 60.0, ""), (float("nan"), float("nan"), ""),
    ],
)  # fmt: skip
def test_what_the_best_known_set_would_leave_is_a_share_or_is_not_told(before, after, wanted):
    d = diagnosed(bump)
    search = replace(d.force, excess_before=before, excess_after=after)
    told = words.sentence(replace(d, force=search), {})
    assert wanted in told
    assert ("The best set" in told) == bool(wanted)


# ---- the law over its data -----------------------------------------------------------------------


def test_dry_friction_is_drawn_over_velocity_with_a_band_that_holds_the_truth():
    (rest,) = residual_laws.rests(diagnosed(friction))
    law, half = rest.laws[0].of(rest.laws[0].parts)
    _, v, _ = cases.moved(cases.command())
    sliding = rest.rows & (np.abs(v) > 5e-3)
    truth = FRICTION_N * np.sign(v)
    assert np.all(np.abs(law - truth)[sliding] < 1.5 * half[sliding])
    assert half[sliding].max() < 0.03 * FRICTION_N
    assert (
        residual_laws.line_share(law[rest.rows], rest.over["v"][0][rest.rows]) > residual_laws.LINE
    )
    assert (
        residual_laws.line_share(law[rest.rows], rest.over["x"][0][rest.rows]) < residual_laws.LINE
    )


def test_what_is_left_over_velocity_lies_around_the_law():
    (rest,) = residual_laws.rests(diagnosed(friction))
    law, _ = rest.laws[0].of(rest.laws[0].parts)
    assert np.std((rest.left - law)[rest.rows]) == pytest.approx(cases.F_STD, rel=0.1)


@pytest.mark.long
def test_of_friction_beside_a_hardening_spring_each_is_drawn_alone():
    d = diagnosed(hardening)
    assert sorted(d.effects) == ["coulomb", "cubic"]
    (rest,) = residual_laws.rests(d)
    assert [p.names for p in residual_laws._elsewhere(rest, "v")] == [("cubic",)]
    assert [p.names for p in residual_laws._elsewhere(rest, "x")] == [("coulomb",)]
    over_v = next(p for p in residual_laws.draw_laws(d) if p.key == "law-force-v")
    assert "Without a cubic spring: it does not follow velocity." in over_v.note


@pytest.mark.long
def test_a_forgotten_mass_is_a_line_over_acceleration():
    d = diagnosed(heavier)
    assert d.effects == ["inertia"]
    assert [p.key for p in residual_laws.draw_laws(d)] == [
        "law-force-v",
        "law-force-x",
        "law-force-a",
    ]
    (rest,) = residual_laws.rests(d)
    slope = np.polyfit(rest.over["a"][0][rest.rows], rest.left[rest.rows], 1)[0]
    assert slope == pytest.approx(90.0, rel=0.02)


def test_a_late_actuator_is_a_line_over_the_velocity_of_its_model():
    d = diagnosed(None, late_s=0.004)
    assert d.effects == ["delay"]
    (rest,) = residual_laws.rests(d)
    assert (rest.channel, rest.unit) == ("disp", "mm")
    slope = np.polyfit(rest.over["v"][0][rest.rows], rest.left[rest.rows], 1)[0]
    assert slope == pytest.approx(-0.004, rel=0.05)
    law, half = rest.laws[0].of(rest.laws[0].parts)
    assert half is not None
    assert np.std((rest.left - law)[rest.rows]) == pytest.approx(cases.X_STD * 1e3, rel=0.1)


@pytest.mark.long
def test_laws_that_fit_alike_are_drawn_beside_one_another():
    d = diagnosed(softer, kind="sine")
    assert d.verdict == "ambiguous"
    (rest,) = residual_laws.rests(d)
    assert {law.label for law in rest.laws} == {"a moving mass", "an error of the stiffness"}
    plate = residual_laws.draw_laws(d)[0]
    assert "a moving mass" in plate.svg
    assert "stroke-dasharray" in plate.svg


@pytest.mark.parametrize("law", [None, pytest.param(bump, marks=pytest.mark.long)])
def test_without_an_answer_only_what_is_left_is_drawn(law):
    plates = residual_laws.draw_laws(diagnosed(law))
    assert [p.key for p in plates] == ["law-force-v", "law-force-x"]
    assert all("law found" not in p.svg and "darker: more rows" in p.note for p in plates)


# ---- the page ------------------------------------------------------------------------------------


def written(d, folder: Path) -> str:
    page.write_report(folder, d, finish(d, None, None), None, Path("baseline.toml"))
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.long
def test_an_explained_recording_raises_no_alarm_on_its_page(tmp_path):
    text = written(diagnosed(friction), tmp_path)
    assert '<span class="state found">explained</span>' in text
    assert "state bad" not in text.split("</style>")[1]
    for words_of_axis in ("residual, N", "velocity, mm/s", "displacement, mm", "95 % band"):
        assert words_of_axis in text
    assert len(text) < 600_000


@pytest.mark.parametrize(
    ("law", "kind", "state"),
    [
        (None, "sweep", "good"),
        (softer, "sine", "open"),
        pytest.param(bump, "sweep", "dark", marks=pytest.mark.long),
    ],
)
def test_no_verdict_has_the_colour_of_an_alarm(law, kind, state, tmp_path):
    text = written(diagnosed(law, kind), tmp_path)
    assert f'<span class="state {state}">' in text


def test_legends_stand_outside_of_the_curves():
    """Every word of a legend lies below the axes that it is of, or above them."""
    top, bottom = 72.0 * draw.TOP_IN, 72.0 * (draw.TOP_IN + 2.3)
    halves = [p for p in page.draw_all(diagnosed(hardening)) if p.half and p.key != "map"]
    assert {"law-force-v", "law-force-x", "loops", "energy", "spectrum"} == {p.key for p in halves}
    for plate in halves:
        legend = plate.svg.split(f'id="{plate.key}-legend_1"')[1]
        places = [float(y) for y in re.findall(r'<text [^>]*y="([\d.]+)"', legend)]
        assert len(places) >= 2, plate.key
        assert min(places) > bottom or max(places) < top, plate.key


def test_large_forces_are_drawn_in_kn_with_their_laws_and_bands():
    assert residual_laws.force_unit(np.array([9999.0, np.nan]), np.zeros(3)) == (1.0, "N")
    assert residual_laws.force_unit(np.zeros(3), np.array([-1e4, np.inf])) == (1e-3, "kN")
    assert residual_laws.force_unit(np.array([np.nan])) == (1.0, "N")
    part = residual_laws.Contribution(("coulomb",), np.array([3e4, -3e4]), np.array([[1.0], [2.0]]))
    law = residual_laws.FittedLaw((part,), np.array([[1e6]]))
    for given, scaled in zip(
        law.of([part]), law.times(1e-3).of(law.times(1e-3).parts), strict=True
    ):
        assert scaled == pytest.approx(1e-3 * given)


def test_closed_loop_of_a_history_has_no_row_for_a_delay_estimate():
    d = diagnosed(friction)
    errors = {"x_meas": 1.7e-139, "x_num": 0.0, "f_meas": 0.4, "alpha": float("nan")}
    loop = {"possible": True, "notes": [], "nrmse_before": errors, "nrmse_after": errors}
    rows = page._closed(d, {"closed_loop": loop})["rows"]
    assert [row[0] for row in rows] == ["measured displacement", "computed displacement", "force"]
    assert [row[1] for row in rows] == ["0", "0", "40"]


# ---- the ledger ----------------------------------------------------------------------------------


def test_every_rule_that_takes_a_set_out_has_words_for_it():
    in_order_only = {"simplest first"}
    assert set(decide.RANKING) - in_order_only <= set(why.DROPPED)


def test_the_ledger_says_why_dry_friction_was_named_and_the_others_were_not():
    d = diagnosed(friction)
    sets = [row for row in why.ledger(d) if row.channel == "force"]
    assert (sets[0].effects, sets[0].fate) == (("coulomb",), "named")
    assert sets[0].left < 0.05
    assert "more than its price" in sets[0].why
    assert [s for s in sets if s.fate in ("named", "as good")] == [sets[0]]
    told = {s.effects: s for s in sets}
    # What comes nearest is friction with more to it; all that is none leaves a multiple.
    others = [s for s in sets if s.fate == "lost" and not {"coulomb", "stribeck"} & set(s.effects)]
    assert others
    assert all(s.left > 2.0 * sets[0].left for s in others)
    assert all(s.why for s in sets)
    named = {n for s in sets for n in s.effects}
    assert {"stiffness", "gap", "hysteresis", "bias", "crosstalk"} <= named
    assert told[("crosstalk",)].why.startswith("not tried")


def test_the_verdict_names_the_rule_that_withdrew_a_set_which_leaves_only_noise():
    d = replace(diagnosed(friction), verdict="unknown")
    assert dict(why.facts(d))["verdict"].startswith("unknown: the best set leaves")
    weak = court.Ruling("weak", d.force.best.names, found=1.0, wanted=3.84)
    told = dict(why.facts(replace(d, ledger=[weak])))["verdict"]
    assert told == f"unknown: {why.TURNED['weak']}"


def test_the_ledger_says_that_a_set_in_whose_place_another_is_named_was_too_small():
    """It may fit better: that it is less simple is not why it is not named."""
    d = diagnosed(friction)
    rival = next(f for f in d.force.rivals if not set(f.names) & set(d.force.best.names))
    small = [*d.force.ledger, court.Ruling("size", rival.names, found=8e-4, wanted=1e-3)]
    told = why.ledger(replace(d, force=replace(d.force, ledger=small)), catalogue=False)
    row = next(row for row in told if row.effects == rival.names)
    assert row.fate == "lost"
    assert "of the whole; less than" in row.why
    assert row.why.endswith("is not reported")


def test_the_ledger_says_of_a_stated_value_what_it_explains_beside_a_tiny_law():
    d = diagnosed(friction)
    rival = d.force.rivals[0]
    beside = court.Ruling("beside tiny", rival.names, "", 5.0, 20.0, against=("quadratic",))
    search = replace(d.force, best=d.force.null, ledger=[beside])
    said = why._why_force(search, rival, "lost", 20.0)
    assert re.search(r"but added to .* by 5.00, and must improve it by 20.0", said)


def test_the_ledger_says_what_noise_was_believed_and_how_far_numbers_moved():
    # At this rate a friction that turns within a row or two would count as noise.
    told = dict(why.facts(diagnosed()))
    believed, stated = (
        float(part)
        for part in re.findall(r"([\d.]+) N (?:assumed|stated)", told["noise of the force"])
    )
    assert believed == pytest.approx(cases.F_STD, rel=0.1)
    assert stated == cases.F_STD
    # The specimen of the cases is 0.4 % stiffer than the model says.
    told = dict(why.facts(diagnosed(friction)))
    moved = re.match(r"adjusted by ([\d.]+) %; 1.00 % stated", told["tolerance, stiffness"])
    assert moved is not None
    assert float(moved[1]) == pytest.approx(0.4, abs=0.1)


def test_how_far_numbers_moved_is_told_of_the_set_shown_first_and_of_whose_it_is():
    """Without the friction, the damping moves by several times its tolerance to stand for it."""
    d = diagnosed(friction)
    for changed, whose in (
        (d, "; "),
        (replace(d, verdict="unknown", effects=[]), " beside the best set, which is not named; "),
    ):
        told = dict(why.facts(changed))
        for nuisance, moved in zip(d.force.problem.nuisances, d.force.best.nuisance, strict=True):
            value = why._moved(nuisance, float(moved))
            said = told[f"tolerance, {nuisance.plain}"]
            assert said.startswith(f"adjusted by {value}{whose}")
    told = dict(why.facts(replace(d, verdict="none", effects=[])))
    damping = told["tolerance, damping"]
    assert re.match(r"adjusted by [\d.]+ kN s/m without any effect; ", damping)
    assert damping.split(" without")[0] != dict(why.facts(d))["tolerance, damping"].split(";")[0]


def test_friction_is_told_with_the_width_of_its_jump_wherever_its_law_is(tmp_path, capsys):
    d = diagnosed(friction)
    found = next(c for c in d.candidates if c.name == "coulomb")
    said = re.fullmatch(r"Fc tanh\(v / width\), width ([\d.e-]+) m/s", words.law_text(found))
    assert said is not None
    assert float(said[1]) == pytest.approx(4e-4, rel=0.1)
    recording, toml = cases.write(tmp_path, cases.channels(friction))
    assert run("diagnose", recording, "--model", toml, "--report", tmp_path / "r") == 8
    assert said[0] in capsys.readouterr().out
    report = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    assert said[0] in report.replace("\xa0", " ")
    augmented = (tmp_path / "r" / "augmented.toml").read_text(encoding="utf-8")
    width = re.search(r"width_m_per_s = (\S+)", augmented)
    assert width is not None
    assert float(width[1]) == pytest.approx(float(said[1]), rel=0.01)


@pytest.mark.long
def test_the_ledger_of_readings_without_noise_says_so_and_has_no_figures_of_twenty_digits():
    """The rig has no noise, and the model states none: a delay of two samples is then a lot."""
    model = rt.Rig("delay-10-elastic")
    short = {"duration_s": 8, "start_s": 1}
    late = model.with_({"actuator.delay_samples": 12})
    done = rt.run(rt.Test("section5-T0.5", rig=late, ground_motion=short))
    with TemporaryDirectory() as folder:
        path = done.save(Path(folder) / "recording.h5")
        known = reading.read_model(model.save(Path(folder) / "rig.toml"))
        d = engine.diagnose(reading.read_case(path, known))
    told = dict(why.facts(d))
    for what in ("noise of the displacement", "noise of the force"):
        assert "free of noise, and the resolution of their sensor is not known" in told[what]
    for says in told.values():
        assert re.search(r"\d{7}", says.replace("\u202f", "")) is None, says
    assert "free of noise" not in dict(why.facts(diagnosed()))["noise of the force"]


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (0.0, "0.00"),
        (-12.34, "−12.3"),
        (439642.4, "439\u202f642"),
        (7293436859852527.0, "7.29·10¹⁵"),
        (-2.5e21, "−2.50·10²¹"),
    ],
)
def test_evidence_has_as_many_digits_as_say_something(value: float, says: str):
    assert why.count(value) == says


def test_the_ledger_of_a_right_model_names_nothing():
    rows = why.ledger(diagnosed())
    assert rows
    assert {row.fate for row in rows} <= {"lost", "refused"}


@pytest.mark.long
def test_the_ledger_of_an_unknown_force_says_what_the_best_set_leaves():
    d = diagnosed(bump)
    assert {row.fate for row in why.ledger(d)} <= {"lost", "dropped", "refused"}
    told = dict(why.facts(d))
    assert told["verdict"].startswith("unknown: ")
    assert "beside the best set, which is not named" in told["tolerance, stiffness"]


def test_laws_that_fit_alike_are_said_to_be_as_good():
    sets = {s.effects: s for s in why.ledger(diagnosed(softer, kind="sine"))}
    assert sets[("inertia",)].fate == sets[("stiffness",)].fate == "as good"


@pytest.mark.long
def test_the_ledger_comes_on_demand(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels(friction))
    assert run("diagnose", recording, "--model", toml, "--json", "--report", tmp_path / "r") == 8
    printed = capsys.readouterr()
    assert "why" not in json.loads(printed.out)
    assert "Why:" not in printed.err
    assert json.loads((tmp_path / "r" / "diagnosis.json").read_text())["why"]["sets"]
    text = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    assert "<summary>What the answer is based on</summary>" in text
    assert run("diagnose", recording, "--model", toml, "--json", "--why") == 8
    answer = json.loads(capsys.readouterr().out)
    assert answer["why"]["sets"][-1]["fate"] == "refused"
    assert run("diagnose", recording, "--model", toml, "--why") == 8
    told = capsys.readouterr().out
    assert "Why:\n" in told
    assert "named: dry friction\n" in told
    assert max(map(len, told.split("Why:")[1].splitlines())) <= 120


# ---- the terminal --------------------------------------------------------------------------------


@pytest.mark.long
def test_the_terminal_says_the_error_on_a_second_recording(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels(friction))
    second, _ = cases.write(
        tmp_path / "second", cases.channels(friction, kind="sine", seed=2, amplitude=5e-3)
    )
    assert run("diagnose", recording, "--model", toml, "--heldout", second) == 8
    told = " ".join(capsys.readouterr().out.split())
    found = re.search(
        r"second recording's force: ([\d.]+) % with the model as given, ([\d.]+) % with the "
        r"effects found \(NRMSE\)", told
    )  # fmt: skip
    assert found is not None, told
    before, after = float(found[1]), float(found[2])
    assert after < 0.3 * before
    assert "--heldout" not in told


@pytest.mark.long
def test_the_terminal_says_how_to_have_an_answer_judged(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels(friction))
    assert run("diagnose", recording, "--model", toml) == 8
    assert "--heldout FILE" in capsys.readouterr().out
    recording, toml = cases.write(tmp_path, cases.channels())
    assert run("diagnose", recording, "--model", toml) == 0
    assert "--heldout" not in capsys.readouterr().out


@pytest.mark.long
def test_a_late_load_cell_is_said_to_be_in_no_rig_file(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, of_late_load_cell())
    assert run("diagnose", recording, "--model", toml, "--report", tmp_path / "r") == 8
    told = " ".join(capsys.readouterr().out.split())
    note = "A rig file cannot represent a time skew of the load cell"
    assert note in told
    assert note in (tmp_path / "r" / "report.html").read_text(encoding="utf-8")


def test_a_loop_that_what_was_found_does_not_bring_back_is_said():
    d = diagnosed(friction)
    loop = {"possible": True, "notes": ["simulated without gap, which a rig file cannot represent"]}
    errors = {"x_meas": 0.891, "x_num": 0.9, "f_meas": 0.8, "alpha": 0.1}
    loop |= {"nrmse_before": errors, "nrmse_after": errors | {"x_meas": 0.888}}
    first, second = words.loop_notes(d, {"closed_loop": loop})
    assert (
        first == "With the loop closed: simulated without gap, which a rig file cannot represent."
    )
    assert "by 89.1 % without them and by 88.8 % with them" in second
    loop["nrmse_after"] = errors | {"x_meas": 0.02}
    assert words.loop_notes(d, {"closed_loop": loop}) == [first]
    assert words.loop_notes(d, {"closed_loop": {"possible": False, "why": "it was held"}}) == [
        "The test could not be simulated again: it was held."
    ]


# ---- the catalogue -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("windows", "told"),
    [
        ([[0.06, 5.0]], "between 0.1 and 5.0 s"),
        ([[0.06, 5.0], [6.04, 6.06]], "between 0.1 and 5.0 s and between 6.0 and 6.1 s"),
        ([[0.06, 5.0], [6.07, 6.10]], "between 0.1 and 5.0 s and at 6.1 s"),
        ([[1, 2], [3, 4], [5, 6], [7, 8]],
         "between 1.0 and 2.0 s, between 3.0 and 4.0 s, between 5.0 and 6.0 s and once more"),
    ],
)  # fmt: skip
def test_when_a_force_is_missing_is_said_without_spans_of_no_length(windows, told):
    found = replace(diagnosed(friction), windows=windows)
    assert words._when(found) == told


def test_the_terminal_lists_every_effect_and_what_parts_two_of_them(capsys):
    assert run("effects") == 0
    told = capsys.readouterr().out
    for name in catalogue.entries():
        assert re.search(rf"^{re.escape(name)} ", told, re.MULTILINE), name
    assert run("effects", "stribeck") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "dry friction: both jump with the sign of velocity" in told
    assert run("effects", "bias", "--json") == 0
    assert json.loads(capsys.readouterr().out)["place"] == "load cell"


def test_an_effect_that_is_not_there_is_refused_with_those_that_are(capsys):
    assert run("effects", "stribek") == 2
    assert "stribeck" in capsys.readouterr().err
