"""What the diagnosis writes and refuses, what it makes of damaged data, and the full circle."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from diagnose_answers import diagnosed, found, run

from rthyb_rt import config, core
from rthyb_rt.diagnose import effects, engine, power, reading, words
from rthyb_rt.diagnose.effects.base import Context, Effect, Param, Trial
from rthyb_rt.diagnose.outcome import finish
from rthyb_rt.diagnose.predict import nrmse
from rthyb_rt.errors import InputError

SHARED = Path(__file__).resolve().parents[2] / "shared" / "diagnosis"


@pytest.mark.long
def test_the_augmented_model_predicts_another_recording(tmp_path):
    def friction(t, x, v, a):
        return 250.0 * np.tanh(v / 4e-4)

    d = diagnosed(tmp_path, cases.channels(friction))
    other = cases.channels(friction, amplitude=4e-3, seed=9)
    model = d.case.model
    recording, _ = cases.write(tmp_path / "other", other)
    outcome = finish(d, None, reading.read_case(recording, model, judged=False))
    assert outcome.prediction is not None
    after = nrmse(outcome.prediction.f, other["f_meas"])
    x, v, a = cases.moved(other["x_cmd"])
    before = nrmse(cases.K * x + cases.C * v + cases.M * a, other["f_meas"])
    noise = cases.F_STD / np.std(other["f_meas"])
    assert after < 1.1 * noise
    assert before > 3.0 * after


@pytest.mark.long
def test_a_users_own_effect_is_found_by_its_name(tmp_path):
    class Magnet(Effect):
        """A magnet at a place pulls the specimen to it."""

        name = "magnet"
        params = (Param("pull_N", "N", 0.0, 1e6), Param("at_m", "m", -1.0, 1.0))
        equation = "f = pull exp(-((x - at) / 0.3 mm)^2)"
        fingerprint = "a force at one displacement only"
        signs = "+"

        def trials(self, ctx: Context):
            """Try places along the motion."""
            return [Trial((float(x),)) for x in np.linspace(0.1, 0.9, 17) * ctx.x_range]

        def columns(self, ctx: Context, trial: Trial):
            """Return the pull per N."""
            return [np.exp(-(((ctx.x - trial.theta[0]) / 3e-4) ** 2))]

        def report(self, ctx: Context, trial: Trial, beta):
            """Return pull and place."""
            return {"pull_N": float(beta[0]), "at_m": trial.theta[0]}

    def bump(t, x, v, a):
        return 900.0 * np.exp(-(((x - 3e-3) / 3e-4) ** 2))

    effects.register(Magnet())
    try:
        d = diagnosed(tmp_path, cases.channels(bump))
    finally:
        effects.remove("magnet")
    assert (d.verdict, d.effects) == ("explained", ["magnet"])
    assert found(d, "magnet", "at_m") == pytest.approx(3e-3, rel=0.01)


@pytest.mark.long
def test_the_effect_of_the_users_guide_is_found_from_the_command_line(tmp_path, capsys):
    """The page of Python in docs/diagnosis.md, as it stands there."""
    guide = (Path(__file__).parents[1] / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    (tmp_path / "magnet.py").write_text(
        guide.split("```python\n")[1].split("```")[0], encoding="utf-8"
    )

    def bump(t, x, v, a):
        return 900.0 * np.exp(-(((x - 3e-3) / 3e-4) ** 2))

    recording, toml = cases.write(tmp_path, cases.channels(bump))
    call = ("diagnose", recording, "--model", toml, "--json", "--effect")
    try:
        assert run(*call, tmp_path / "magnet.py") == 8
    finally:
        effects.remove("magnet")
    answer = json.loads(capsys.readouterr().out)
    assert answer["effects"] == ["magnet"]
    assert answer["candidates"][0]["params"]["pull_N"] == pytest.approx(900.0, rel=0.01)
    assert "confirm magnet: the place" in answer["next_experiment"]["why"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1", "registers no effect"),
        ("import math\nfoo(\n", ":2: SyntaxError"),
        ("import math\n\nfoo()\n", ":3: NameError"),
        (
            "from rthyb_rt.diagnose import effects\nclass A(effects.Effect):\n    name = 'a'\n"
            "effects.register(A())\n",
            "lacks params, equation, columns",
        ),
    ],
)
def test_an_effect_that_is_none_is_refused_with_its_line(text, words, tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels())
    (tmp_path / "own.py").write_text(text, encoding="utf-8")
    assert run("diagnose", recording, "--model", toml, "--effect", tmp_path / "own.py") == 3
    assert words in capsys.readouterr().err
    assert "a" not in effects.catalogue()


# ---- the command line ---------------------------------------------------------------------------


@pytest.mark.long
def test_the_command_writes_answer_report_and_a_rig_that_loads(tmp_path, capsys):
    recording, toml = cases.write(
        tmp_path, cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 4e-4))
    )
    out = tmp_path / "report"
    assert run("diagnose", recording, "--model", toml, "--json", "--report", out) == 8
    answer = json.loads(capsys.readouterr().out)
    assert answer["schema"] == "rthyb-diagnose/1"
    assert answer["effects"] == ["coulomb"]
    assert answer["candidates"][0]["name"] == "coulomb"
    assert answer["localisation"]["time_windows"]
    assert "<svg" in (out / "report.html").read_text(encoding="utf-8")
    rig = config.load_rig(out / "augmented.toml")
    friction = [e for e in rig.specimen if e.element == "coulomb"]
    assert friction[0].fc_n == pytest.approx(130.0, rel=0.02)


@pytest.mark.long
def test_the_self_check_finds_again_what_was_found_and_says_how_little_would_be(
    tmp_path, monkeypatch
):
    # Each size is a diagnosis of its own: fewer of them, one probe that was found and one new.
    monkeypatch.setattr(power, "PROBES", ("coulomb", "inertia"))
    monkeypatch.setattr(power, "SIZES", (0.16, 0.01))
    monkeypatch.setattr(power, "PARTS", (0.5, 0.12))
    friction = cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 4e-4))
    d = diagnosed(tmp_path, friction)
    rows = power.self_check(d)
    again = rows[0]
    assert (again["effect"], again["found"]) == ("coulomb", True)
    least = {r["effect"]: r for r in rows if "smallest_detectable_share" in r}
    assert set(least) >= {"coulomb", "inertia"}
    # Noise of 15 N beside forces of 2.4 kN: friction far smaller than that found is seen.
    assert 0.0 < rows[1]["smallest_detectable_share"] < 0.5 * again["share"]


def test_a_folder_that_cannot_be_one_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    recording, toml = cases.write(tmp_path, cases.channels())
    monkeypatch.setattr(engine, "diagnose", lambda *_: pytest.fail("the work was begun"))
    assert run("diagnose", recording, "--model", toml, "--report", toml) == 1
    assert "is a file, not a folder" in capsys.readouterr().err


def test_a_second_test_without_a_reading_cannot_be_held_against_the_model(
    tmp_path, capsys, monkeypatch
):
    recording, toml = cases.write(tmp_path, cases.channels())
    commands = tmp_path / "commands.csv"
    commands.write_text("t,x_cmd\n" + "".join(f"{i / cases.FS!r},0.0\n" for i in range(512)))
    monkeypatch.setattr(engine, "diagnose", lambda *_: pytest.fail("the work was begun"))
    assert run("diagnose", recording, "--model", toml, "--heldout", commands) == 3
    said = capsys.readouterr().err
    assert f"{commands}: has no x_meas" in said
    assert "--predict" in said


def test_the_exit_code_says_nothing_is_missing(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels())
    assert run("diagnose", recording, "--model", toml) == 0
    assert "Nothing is missing" in capsys.readouterr().out


@pytest.mark.parametrize(("verdict", "rows"), [("none", 2), ("unknown", 2), ("explained", 1)])
def test_only_effects_are_said_to_turn_one_error_into_another(verdict, rows):
    errors = {"x_meas": 0.0, "x_num": 0.0, "f_meas": 0.0, "alpha": float("nan")}
    after = {**errors, "x_meas": 1.14e-3}
    loop = {"possible": True, "nrmse_before": errors, "nrmse_after": after}
    found = words.loop_rows({"verdict": verdict, "closed_loop": loop})
    assert len(found) == rows
    assert ("→" in found[0][1]) == (rows == 1)
    assert found[-1][1].endswith("0.114 %")
    assert not any("delay estimate" in row[2] for row in found)


BAD = {
    "time runs back": (lambda c: c["t"].__setitem__(400, 0.1), "does not increase"),
    "dead load cell and displacement": (
        lambda c: (c["f_meas"].fill(np.nan), c["x_meas"].fill(np.nan)),
        "contains no number",
    ),
    "constant channels": (lambda c: (c["f_meas"].fill(3.0), c["x_meas"].fill(1.0)), "constant"),
    "millimetres": (lambda c: c.__setitem__("x_meas", 1e3 * c["x_meas"]), "wrong unit"),
    "kilograms force": (lambda c: c.__setitem__("f_meas", c["f_meas"] / 9.81), "wrong unit"),
    "a displacement against its command": (
        lambda c: c.__setitem__("x_meas", -c["x_meas"]),
        "wrong sign",
    ),
    "a load cell the wrong way round": (
        lambda c: c.__setitem__("f_meas", -c["f_meas"]),
        "wrong sign",
    ),
    "an open cable": (
        lambda c: c.__setitem__(
            "f_meas", 15.0 * np.random.default_rng(0).standard_normal(c["t"].size)
        ),
        "only noise",
    ),
    "another rate": (lambda c: c.__setitem__("t", 2.0 * c["t"]), "fs_hz"),
    "clipped most of the time": (
        lambda c: c.__setitem__("f_meas", np.clip(c["f_meas"], -900.0, 900.0)),
        "clipped",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_no_answer_comes_from_unusable_data(what, tmp_path, capsys):
    spoil, words = BAD[what]
    columns = cases.channels()
    spoil(columns)
    recording, toml = cases.write(tmp_path, columns)
    assert run("diagnose", recording, "--model", toml) == 3
    assert words in capsys.readouterr().err


def test_a_gap_and_a_few_clipped_rows_are_said_and_not_judged(tmp_path):
    columns = cases.channels(lambda t, x, v, a: 200.0 * np.tanh(v / 4e-4))
    top = 0.93 * np.max(columns["f_meas"])
    columns["f_meas"] = np.minimum(columns["f_meas"], top)
    keep = (columns["t"] < 5.0) | (columns["t"] > 5.4)
    d = diagnosed(tmp_path, {k: v[keep] for k, v in columns.items()})
    assert any("gap" in note for note in d.notes)
    assert any("clipped" in note for note in d.notes)
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])


def test_single_rows_lost_here_and_there_hide_nothing(tmp_path):
    """Five rows in a hundred, as a slow network leaves them out: the friction is still there."""
    columns = cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 4e-4))
    keep = np.random.default_rng(1).random(columns["t"].size) > 0.05
    d = diagnosed(tmp_path, {k: v[keep] for k, v in columns.items()})
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert found(d, "coulomb", "Fc_N") == pytest.approx(130.0, rel=0.02)


@pytest.mark.long
def test_gaps_that_leave_nothing_to_judge_allow_no_answer(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "FS", core.FS_HZ)
    columns = cases.channels()
    lost = (np.arange(columns["t"].size) % 150) < 5
    for name in ("x_cmd", "x_meas", "f_meas"):
        columns[name][lost] = np.nan
    with pytest.raises(InputError, match="leave no part"):
        diagnosed(tmp_path, columns)


@pytest.mark.parametrize("reading", [1e6, np.inf])
def test_a_stray_reading_is_said_and_not_judged(reading, tmp_path):
    columns = cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 4e-4))
    columns["f_meas"][500] = reading
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert any("f_meas" in note for note in d.notes)


def test_without_a_force_the_specimen_is_not_said_to_lack_nothing(tmp_path, capsys):
    columns = cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 4e-4))
    columns["f_meas"].fill(np.nan)
    recording, toml = cases.write(tmp_path, columns)
    assert run("diagnose", recording, "--model", toml) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Nothing is missing in the actuator" in said
    assert "so this says nothing about the specimen" in said


@pytest.mark.long
def test_a_slip_of_the_pen_in_a_model_is_said(tmp_path):
    text = cases.baseline().replace("moving_mass", "mass")
    d = diagnosed(tmp_path, cases.channels(), text)
    assert any("specimen.mass (did you mean moving_mass?)" in note for note in d.notes)


@pytest.mark.long
def test_the_verdict_of_a_stop_is_a_sentence_of_the_laboratory(tmp_path, capsys):
    recording, toml = cases.write(
        tmp_path,
        cases.channels(
            lambda t, x, v, a: 3.1e6 * (np.maximum(x - 6e-3, 0.0) + np.minimum(x + 6e-3, 0.0))
        ),
    )
    out = tmp_path / "report"
    assert run("diagnose", recording, "--model", toml, "--report", out) == 8
    said = " ".join(capsys.readouterr().out.split())
    assert "and only where |x| > 6.0" in said
    assert "the load cell reads more than the model: a stop at 6.0" in said
    assert "MN/m explains" in said
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "is confirmed on rows that were held out" in page
    # The page's own policy bars pictures: a drawing that needs one shows a broken frame.
    assert "<image" not in page


@pytest.mark.long
def test_the_form_of_a_law_is_told_in_the_terminal_and_on_the_page(tmp_path, capsys):
    """The loss of a stop changes its force by a third, and is none of its parameters."""
    stop = core.element("stopper", ks_n_per_m=3.1e6, xs_m=5e-3, loss_s_per_m=4.0)
    recording, toml = cases.write(
        tmp_path,
        cases.channels(lambda t, x, v, a: core.CoreElement(stop).run(x, v, a, t[1] - t[0])),
    )
    out = tmp_path / "report"
    assert run("diagnose", recording, "--model", toml, "--report", out) == 8
    said = re.search(
        r"stopper law +both sides, force times 1 \+ (\S+) s/m times the velocity inwards",
        capsys.readouterr().out,
    )
    assert said is not None
    assert float(said[1]) == pytest.approx(4.0, rel=0.1)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert f"{said[1]} s/m times the velocity inwards" in " ".join(page.split())


@pytest.mark.long
def test_a_simulated_motion_is_not_said_to_leave_noise_in_the_force(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels(lambda t, x, v, a: 500.0 * np.sign(v)))
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    answer = finish(d, None, None).answer
    assert "the rest is noise" in words.sentence(d, answer)
    moved = replace(d, force=replace(d.force, moved=True))
    assert "the rest is noise" not in words.sentence(moved, answer)
    assert "the motion is as measured" in words.sentence(moved, answer)


def test_a_model_that_is_none_is_refused(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels(), 'schema = "rthyb-wrong/1"\n')
    assert run("diagnose", recording, "--model", toml) == 3
    toml.write_text(cases.baseline(family='"ground"'), encoding="utf-8")
    assert run("diagnose", recording, "--model", toml) == 3
    toml.write_text(cases.baseline(k='"stiff"'), encoding="utf-8")
    assert run("diagnose", recording, "--model", toml) == 3
    err = capsys.readouterr().err
    assert "specimen.k" in err


# ---- the open examples, where they are -----------------------------------------------------------


@pytest.mark.long
@pytest.mark.skipif(not SHARED.exists(), reason="the open examples are not on this machine")
@pytest.mark.parametrize("name", ["c901_009", "c901_020", "c901_043"])
def test_open_examples_are_answered_rightly(name):
    folder = SHARED / "blind-open" / name
    truth = json.loads((folder / "answer.json").read_text())
    model = reading.read_model(folder / "baseline.toml")
    d = engine.diagnose(reading.read_case(folder / "recording.csv", model))
    assert d.verdict == truth["verdict"]
    if truth["verdict"] == "explained":
        assert sorted(d.effects) == sorted(e["name"] for e in truth["effects"])
    if truth["verdict"] == "ambiguous":
        assert sorted(d.ambiguous_with) == sorted([n] for n in truth["ambiguous"])
    assert math.isfinite(d.fit["nrmse_before"])


# ---- the full circle ---------------------------------------------------------------------------

DAMPED_AND_MEASURED = """[[specimen]]
element = "viscous"
c_n_s_per_m = 1500
[sensors.displacement]
noise_std_m = 2e-6
[sensors.force]
noise_std_n = 12
"""


@pytest.mark.long
def test_a_hybrid_test_in_closed_loop_is_diagnosed_and_its_model_mended(tmp_path, monkeypatch):
    """PLC and RFC hide the friction from the response; split at its signals, the loop shows it."""
    monkeypatch.chdir(tmp_path)
    naive, true = tmp_path / "naive.toml", tmp_path / "true.toml"
    text = cases.rig(more=DAMPED_AND_MEASURED)
    naive.write_text(text, encoding="utf-8")
    true.write_text(text + '[[specimen]]\nelement = "coulomb"\nfc_n = 300\n', encoding="utf-8")
    assert run("run", "--rig", true) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert run("diagnose", folder, "--model", naive, "--report", tmp_path / "out") == 8
    mended = config.load_rig(tmp_path / "out" / "augmented.toml")
    friction = [e for e in mended.specimen if e.element == "coulomb"]
    assert friction[0].fc_n == pytest.approx(300.0, rel=0.01)
    assert run("diagnose", folder, "--model", tmp_path / "out" / "augmented.toml") == 0


def test_a_history_has_no_delay_estimate_that_a_repeated_simulation_could_meet():
    before = {"x_meas": 0.0151, "x_num": 0.0, "f_meas": 0.82, "alpha": math.nan}
    after = {"x_meas": 5.66e-5, "x_num": 0.0, "f_meas": 0.6, "alpha": math.nan}
    loop = {"possible": True, "nrmse_before": before, "nrmse_after": after}
    ((_, value, rest),) = words.loop_rows({"verdict": "explained", "closed_loop": loop})
    assert value == "1.51 → 0.00566 %"
    assert rest == "computed displacement 0 → 0 %; force 82 → 60 %"
