"""What the diagnosis says of recordings whose truth is known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest

from rthyb_rt import cli, config
from rthyb_rt.diagnose import effects, engine, localise, reading
from rthyb_rt.diagnose.effects.base import Context, Effect, Param, Trial
from rthyb_rt.diagnose.outcome import finish
from rthyb_rt.diagnose.predict import nrmse

SHARED = Path(__file__).resolve().parents[2] / "shared" / "diagnosis"


def diagnosed(folder: Path, columns: dict[str, np.ndarray], model: str | None = None):
    recording, toml = cases.write(folder, columns, model)
    return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


def found(d, name: str, key: str) -> float:
    return next(c for c in d.candidates if c.name == name).params[key]


def holds(d, name: str, key: str, truth: float) -> bool:
    low, high = next(c for c in d.candidates if c.name == name).ci95[key]
    return low <= truth <= high


def test_nothing_is_missing_inside_tolerances_and_noise(tmp_path):
    d = diagnosed(tmp_path, cases.channels())
    assert d.verdict == "none"
    assert d.effects == []


def test_an_undocumented_offset_of_a_tenth_of_a_millisecond_is_no_finding(tmp_path):
    columns = cases.channels(seed=3)
    t = columns["t"]
    for name in ("x_meas", "f_meas"):
        late = 1e-4 if name == "f_meas" else -1e-4
        columns[name] = np.interp(t - late, t, columns[name])
    assert diagnosed(tmp_path, columns).verdict == "none"


def test_dry_friction_is_named_with_its_size(tmp_path):
    d = diagnosed(tmp_path, cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 4e-4)))
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert found(d, "coulomb", "Fc_N") == pytest.approx(130.0, rel=0.02)
    assert holds(d, "coulomb", "Fc_N", 130.0)


def test_two_effects_that_cancel_are_both_named(tmp_path):
    d = diagnosed(
        tmp_path, cases.channels(lambda t, x, v, a: 200.0 * np.tanh(v / 4e-4) - 3600.0 * v)
    )
    assert (d.verdict, sorted(d.effects)) == ("explained", ["coulomb", "viscous"])


def test_a_stop_is_located_where_it_is_met(tmp_path):
    def stop(t, x, v, a):
        return 2e6 * np.maximum(np.abs(x) - 6.2e-3, 0.0) * np.sign(x)

    columns = cases.channels(stop)
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, d.effects) == ("explained", ["stopper"])
    assert found(d, "stopper", "xs_m") == pytest.approx(6.2e-3, rel=0.02)
    x, v, a = cases.moved(columns["x_cmd"])
    truth = localise.active(stop(columns["t"], x, v, a), cases.FS)
    said = np.zeros_like(truth)
    for first, last in d.windows:
        said |= (columns["t"] >= first - 1e-3) & (columns["t"] <= last + 1e-3)
    assert (truth & said).sum() / (truth | said).sum() > 0.85


def test_an_effect_that_begins_in_mid_record_is_named(tmp_path):
    d = diagnosed(
        tmp_path, cases.channels(lambda t, x, v, a: (t > 4.3) * 150.0 * np.tanh(v / 4e-4))
    )
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert d.windows[0][0] == pytest.approx(4.3, abs=0.2)


def test_a_longer_delay_is_the_actuators_and_not_the_specimens(tmp_path):
    d = diagnosed(tmp_path, cases.channels(delay=cases.DELAY + 0.004))
    assert (d.verdict, d.effects, d.channel) == ("explained", ["delay"], "disp")
    assert found(d, "delay", "dtau_s") == pytest.approx(0.004, abs=1.2e-4)


def test_a_sine_cannot_tell_mass_from_stiffness_and_a_sweep_can(tmp_path):
    def softer(t, x, v, a):
        return -0.09 * cases.K * x

    d = diagnosed(tmp_path / "sine", cases.channels(softer, kind="sine"))
    assert d.verdict == "ambiguous"
    assert sorted(d.ambiguous_with) == [["inertia"], ["stiffness"]]
    assert d.next_experiment is not None
    assert d.next_experiment["kind"] in ("sweep", "random", "multi_frequency")
    d = diagnosed(tmp_path / "sweep", cases.channels(softer))
    assert (d.verdict, d.effects) == ("explained", ["stiffness"])


def test_no_mass_is_less_than_nothing(tmp_path):
    """A stiffer specimen under a sine could be a negative mass, of more than there is."""
    d = diagnosed(tmp_path, cases.channels(lambda t, x, v, a: 0.09 * cases.K * x, kind="sine"))
    assert (d.verdict, d.effects) == ("explained", ["stiffness"])


def test_what_no_effect_explains_is_unknown_and_located(tmp_path):
    def bump(t, x, v, a):
        return 900.0 * np.exp(-(((x - 3e-3) / 3e-4) ** 2))

    d = diagnosed(tmp_path, cases.channels(bump))
    assert (d.verdict, d.effects) == ("unknown", [])
    assert d.x_m[0] < 3e-3 < d.x_m[1]
    assert d.x_m[1] - d.x_m[0] < 4e-3


def test_coarse_readings_are_a_load_cells_and_no_friction(tmp_path):
    columns = cases.channels()
    columns["f_meas"] = 260.0 * np.round(columns["f_meas"] / 260.0)
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, d.effects) == ("explained", ["quantisation"])
    assert found(d, "quantisation", "lsb_N") == pytest.approx(260.0, rel=1e-3)


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


# ---- the command line ---------------------------------------------------------------------------


def run(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments])


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


def test_the_exit_code_says_nothing_is_missing(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels())
    assert run("diagnose", recording, "--model", toml) == 0
    assert "Nothing is missing" in capsys.readouterr().out


BAD = {
    "no time column": (lambda c: c.pop("t"), "no time column"),
    "time runs back": (lambda c: c["t"].__setitem__(400, 0.1), "does not increase"),
    "dead load cell and displacement": (
        lambda c: (c["f_meas"].fill(np.nan), c["x_meas"].fill(np.nan)),
        "holds no number",
    ),
    "constant channels": (lambda c: (c["f_meas"].fill(3.0), c["x_meas"].fill(1.0)), "constant"),
    "millimetres": (lambda c: c.__setitem__("x_meas", 1e3 * c["x_meas"]), "wrong unit"),
    "kilograms force": (lambda c: c.__setitem__("f_meas", c["f_meas"] / 9.81), "wrong unit"),
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

RIG = """
schema = "rthyb-rig/1"
[rig]
name = "lab"
elastic_stiffness_n_per_m = 5e5
[actuator]
kind = "second-order"
natural_frequency_hz = 30
damping_ratio = 0.8
delay_s = 0.004
[[specimen]]
element = "stiffness"
k_n_per_m = 5e5
[[specimen]]
element = "viscous"
c_n_s_per_m = 1500
[sensors.displacement]
noise_std_m = 2e-6
[sensors.force]
noise_std_n = 12
"""


def test_a_hybrid_test_in_closed_loop_is_diagnosed_and_its_model_mended(tmp_path, monkeypatch):
    """PLC and RFC hide the friction from the response; cut at its signals, the loop shows it."""
    monkeypatch.chdir(tmp_path)
    naive, true = tmp_path / "naive.toml", tmp_path / "true.toml"
    naive.write_text(RIG, encoding="utf-8")
    true.write_text(RIG + '[[specimen]]\nelement = "coulomb"\nfc_n = 300\n', encoding="utf-8")
    assert run("run", "--rig", true) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert run("diagnose", folder, "--model", naive, "--report", tmp_path / "out") == 8
    mended = config.load_rig(tmp_path / "out" / "augmented.toml")
    friction = [e for e in mended.specimen if e.element == "coulomb"]
    assert friction[0].fc_n == pytest.approx(300.0, rel=0.01)
    assert run("diagnose", folder, "--model", tmp_path / "out" / "augmented.toml") == 0


def test_a_contact_that_shears_before_it_slips_is_dry_friction(tmp_path):
    def slider(t, x, v, a):
        slip, force = 0.0, np.empty_like(x)
        for i, now in enumerate(x):
            slip = min(max(slip, now - 2e-6), now + 2e-6)
            force[i] = 130.0 * (now - slip) / 2e-6
        return force

    d = diagnosed(tmp_path, cases.channels(slider))
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert found(d, "coulomb", "Fc_N") == pytest.approx(130.0, rel=0.02)


def test_units_do_not_hide_a_spring_of_the_third_power(tmp_path):
    # Of a motion of two millimetres the cube is a column of 1e-10 beside others of 1e2.
    columns = cases.channels(lambda t, x, v, a: 5e10 * x**3, amplitude=2e-3)
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, d.effects) == ("explained", ["cubic"])
    assert found(d, "cubic", "k3_N_m3") == pytest.approx(5e10, rel=0.03)
