"""The generator of concealed cases: independent of the program, true to its own physics, fair."""

from __future__ import annotations

import ast
import json
import math
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from prove import (
    answers,
    bench,
    cases,
    effects,
    excitations,
    laws,
    loops,
    nearest,
    plans,
    prepare,
    rigs,
    rivals,
    scoring,
)
from prove import generate as generator
from prove.laws import Effect, Specimen
from prove.prepare import Wanted
from scipy.integrate import solve_ivp
from scipy.signal import StateSpace, lsim

PROVE = Path(plans.__file__).parent
H = 1 / 16384
T = np.arange(0, 2, H)
X = 0.006 * np.sin(2 * np.pi * 1.3 * T) * (1 - np.exp(-2 * T))
V = np.gradient(X, H)
A = np.gradient(V, H)


def force(name: str, params: dict[str, float], **shape: float) -> np.ndarray:
    return laws.along(
        Specimen(0.0, 0.0, 0.0, None, (Effect(name, params, shape),)), 0.0, H, X, V, A
    )


# ---- independence ------------------------------------------------------------------------------


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            names.add((node.module or "").split(".")[0])
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
            called = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
            assert called not in ("__import__", "import_module", "exec", "eval"), path.name
    return names


def test_the_generator_imports_nothing_of_the_program() -> None:
    files = list(PROVE.rglob("*.py"))
    assert len(files) > 8
    foreign = {"numpy", "scipy", "numba", "pysindy", "prove"}
    known = foreign | set(sys.stdlib_module_names)
    for path in files:
        assert imported(path) <= known, path.name
        assert "rthyb_rt" not in imported(path)


# ---- laws against second formulations ----------------------------------------------------------


def test_bouc_wen_in_closed_form_is_its_differential_equation() -> None:
    x = 0.01 * np.sin(np.linspace(0, 20, 100_001))
    z_fine, z_closed = 0.0, 0.0
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        z_fine += dx * (1 - (z_fine / 0.004) ** 2 * (0.55 + 0.45 * np.sign(dx * z_fine)))
        if i % 500 == 0:
            z_closed = laws.bouc_wen_step(z_closed, x[i] - x[i - 500], 0.004)
    assert_allclose(z_closed, z_fine, atol=2e-6)


def test_maxwell_branch_is_its_differential_equation() -> None:
    k, tau = 2e5, 0.05
    solved = solve_ivp(
        lambda t, f: k * np.interp(t, T, V) - f / tau, (0, 1.0), [0.0], rtol=1e-9, max_step=1e-3
    )
    found = force("maxwell", {"km_N_m": k, "tau_s": tau})
    assert_allclose(found[np.searchsorted(T, 1.0)], solved.y[0, -1], rtol=1e-4)


def test_second_mode_is_its_differential_equation() -> None:
    m, f, zeta = 80.0, 3.0, 0.03
    w = 2 * math.pi * f

    def rate(t: float, y: np.ndarray) -> list[float]:
        return [y[1], -np.interp(t, T, A) - 2 * zeta * w * y[1] - w * w * y[0]]

    y = solve_ivp(rate, (0, 1.5), [0.0, 0.0], rtol=1e-9, max_step=1e-3).y[:, -1]
    found = force("second_mode", {"m2_kg": m, "f2_Hz": f}, zeta=zeta)
    at = np.searchsorted(T, 1.5)
    assert_allclose(found[at], -m * (w * w * y[0] + 2 * zeta * w * y[1]), rtol=1e-3)


def test_friction_chain_reverses_like_a_bristle() -> None:
    level, sigma0 = 120.0, 4e5
    down = np.linspace(0.004, 0.002, 4001)
    x = np.concatenate((np.linspace(0, 0.004, 4001), down))
    zero = np.zeros_like(x)
    specimen = Specimen(0, 0, 0, None, (Effect("lugre", {"Fc_N": level, "sigma0_N_m": sigma0}),))
    f = laws.along(specimen, 0.0, H, x, zero, zero)[4001:]
    bristle = -level + 2 * level * np.exp(-sigma0 * (0.004 - down) / level)
    assert np.max(np.abs(f - bristle)) < 0.03 * level


def test_yielding_chain_has_the_stated_strength_and_forgets_nothing() -> None:
    xy = 0.002
    params = {"xy_m": xy, "alpha": 0.3}
    specimen = Specimen(1e6, 0, 0, None, (Effect("hysteresis", params, {"spread": 0.6}),))
    x = np.concatenate((np.linspace(0, 0.02, 500), np.linspace(0.02, -0.02, 1000)))
    f = laws.along(specimen, 0.0, H, x, 0 * x, 0 * x)
    assert_allclose(f[499], 1e6 * (0.3 * 0.02 + 0.7 * xy), rtol=1e-9)
    assert_allclose(f[-1], -f[499], rtol=1e-9)


def test_a_stuck_mass_stays_and_a_sliding_one_feels_the_full_friction() -> None:
    specimen = Specimen(4e5, 0.0, 0.0, None, (Effect("coulomb", {"Fc_N": 300.0}),))
    load = np.where(T < 1, 200.0, 900.0 * np.sin(2 * np.pi * (T - 1)))
    x, v, _, f = rigs.free_motion(load, H, 3000.0, 0.0, specimen)
    assert np.max(np.abs(x[T < 1])) == 0
    friction = f - 4e5 * x
    moving = np.abs(v) > 1e-4
    assert moving.any()
    assert_allclose(friction[moving], 300 * np.sign(v[moving]), atol=1e-6)


def test_free_motion_of_a_linear_specimen_is_that_of_linear_theory() -> None:
    m, c, k = 3000.0, 2000.0, 5e5
    load = 500 * np.sin(2 * np.pi * 1.7 * T)
    system = StateSpace([[0, 1], [-k / m, -c / m]], [[0], [1 / m]], [[1, 0]], [[0]])
    expected = lsim(system, load, T)[1]
    assert_allclose(rigs.free_motion(load, H, m, 0.0, Specimen(k, c, 0.0))[0], expected, atol=1e-8)


def test_actuator_is_its_transfer_function() -> None:
    dt = 1 / 1024
    t = np.arange(1024) * dt
    command = 0.005 * np.sin(2 * np.pi * 2 * t) * np.minimum(t * 4, 1)
    a = rigs.Actuator(0.0051, 28.0, 0.9, 0.97)
    w = 2 * np.pi * 28
    fine = np.arange(16 * 1023 + 1) * dt / 16
    system = StateSpace([[0, 1], [-w * w, -1.8 * w]], [[0], [0.97 * w * w]], [[1, 0]], [[0]])
    expected = lsim(system, np.interp(fine - 0.0051, t, command), fine)[1]
    assert_allclose(rigs.track(command, dt, a)[0], expected, atol=1e-8)


def test_rate_limits_hold() -> None:
    t = np.arange(2048) / 1024
    command = 0.006 * np.sin(2 * np.pi * 1.5 * t)
    for place in (rigs.COMMAND, rigs.VALVE):
        a = rigs.Actuator(0.005, 28.0, 0.9, vmax_m_s=0.03, limit_at=place)
        assert np.max(np.abs(rigs.track(command, 1 / 1024, a)[1])) < 0.0302


def test_the_compensated_loop_follows_the_structure_without_a_rig() -> None:
    """With force compensation by the true stiffness the loop is the ideal structure."""
    dt, k, mass, damping = 1 / 1024, 5e5, 5000.0, 2000.0
    t = np.arange(8192) * dt
    ag = 0.2 * excitations.load("random", t, np.random.default_rng(3))
    actuator = rigs.Actuator(0.005, 28.0, 0.9)
    control = loops.Controller(actuator.lag_s / dt, k, samples=60, strong_until_s=0.0)
    done = loops.closed_test(
        ag, dt, mass, damping, actuator, Specimen(k, 500.0, 0.0), loops.Sensors(), control,
        0 * t, 0 * t, 0 * t,
    )  # fmt: skip
    fine = rigs.fine_signal(ag, t, dt)
    ideal = rigs.free_motion(-mass * fine, dt / 16, mass, damping, Specimen(k, 500.0, 0.0))[0][::16]
    assert done.finished
    assert np.std(done.x_num - ideal) < 0.05 * np.std(ideal)


# ---- fairness ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drive_lab() -> bench.Lab:
    w = Wanted("single", "drive", ("inertia",))
    lab = prepare.draw_lab(w, np.random.default_rng(5))
    lab.truth = Specimen(lab.truth.k, lab.truth.c, lab.truth.mass)
    lab.noise = bench.Noise(2e-6, 10.0, 0.01)
    return lab


@pytest.mark.parametrize(("kind", "told"), [("sine", False), ("sweep", True)])
def test_mass_and_spring_are_told_apart_only_by_more_than_one_frequency(
    drive_lab: bench.Lab, kind: str, told: bool
) -> None:
    rng = np.random.default_rng(1)
    missing = [effects.Missing("inertia", {"m_kg": 200.0}, {}, "m_kg")]
    lab = effects.install(drive_lab, missing)
    test = bench.plan_test(lab, kind, 12.0, rng)
    test.scale = 0.006
    run = bench.perform(lab, test, rng)
    y = prepare.contribution(lab, run, missing, 0)
    verdicts = rivals.judge_force(y, run, lab, ("inertia",), pairs=False)
    worse = verdicts.sets[("stiffness",)] - verdicts.truth
    assert (worse > rivals.CLEAR) is told
    assert told or worse < rivals.EQUAL


@pytest.mark.parametrize("family", ["drive", "ground", "forced"])
def test_the_spring_behind_a_play_drives_no_free_body(family: str) -> None:
    """It returns 4 k g (X - g) more than it takes, per cycle between X and -X with a play of g."""
    k, g, peak = 2e5, 4e-4, 5e-3
    x = peak * np.sin(2 * np.pi * T)
    v, spring = np.gradient(x, H), Specimen(k, 0.0, 0.0, None, (Effect("gap", {"gap_m": g}, {}),))
    shapes, scale = [], effects.Scale(5e-3, 0.03, 1000.0, 0.1, 0.05, 10.0, 5.0)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        lab = prepare.draw_lab(Wanted("single", family, ("gap",)), rng)
        shapes.append(effects.draw("gap", lab, scale, rng).shape["play"])
    assert (max(shapes) > 0.0) == (family == "drive")
    spring.effects[0].shape["play"] = max(shapes)
    f = laws.along(spring, 0.0, H, x, v, np.gradient(v, H))
    second = T >= 1.0
    work = float(f[second] @ v[second]) * H
    assert work == pytest.approx(-4 * k * g * (peak - g) * max(shapes), abs=0.01 * k * g * peak)


def test_windows_are_where_the_effect_acts() -> None:
    t = np.arange(16384) / 1024
    y = np.where((t > 3) & (t < 5), np.sin(40 * t), 0) + np.where((t > 5.2) & (t < 6), 0.5, 0)
    (one,) = answers.windows(t, y)
    assert_allclose(one, [3, 6], atol=0.06)


def test_nearest_parameters_of_the_format_s_own_loop_are_its_own() -> None:
    lab = prepare.draw_lab(Wanted("single", "drive", ("hysteresis",)), np.random.default_rng(2))
    run = bench.Run(T, X, V, A, A, X, X, 0 * X, np.array([X, V, A]))
    soft = Specimen(lab.truth.k, 0.0, 0.0, {"alpha": 0.4, "xy": 0.003})
    y = laws.along(soft, 0.0, H, X, V, A) - lab.truth.k * X
    m = effects.Missing("hysteresis", {"xy_m": 0.001, "alpha": 0.9}, {}, "alpha")
    found, _ = nearest.parameters(lab, run, m, y)
    assert_allclose([found["xy_m"], found["alpha"]], [0.003, 0.4], rtol=1e-3)


# ---- cases and scores --------------------------------------------------------------------------

KINDS = ["single", "null", "ambiguous", "dormant", "unknown", "cancel"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cases")
    written = [list(generator.generate(11, 1, out / kind, [kind], jobs=1)) for kind in KINDS]
    assert all(len(w) == 1 for w in written)
    return out


def folders(folder: Path) -> list[Path]:
    return sorted(p.parent for p in folder.glob("*/*/answer.json"))


@pytest.mark.long
def test_cases_hold_what_the_format_asks_for(folder: Path) -> None:
    for case in folders(folder):
        model = tomllib.loads((case / "baseline.toml").read_text())
        assert model["schema"] == "rthyb-baseline/1"
        recording = scoring.read_csv(case / "recording.csv")
        steps = np.diff(recording["t"])
        assert_allclose(steps, 1 / model["fs_hz"], rtol=1e-6)
        held = scoring.read_csv(case / "heldout_input.csv")
        truth = scoring.read_csv(case / "heldout_truth.csv")
        assert set(truth) == {"t", "x", "f", "x_base", "f_base"}
        assert held["t"].size == truth["t"].size
        assert "f_meas" not in held
        assert all(np.isfinite(c).all() for c in truth.values())
        answer = json.loads((case / "answer.json").read_text())
        assert answer["verdict"] in ("none", "explained", "ambiguous", "unknown")
        for effect in answer["effects"]:
            spans = np.ravel(effect["windows"])
            assert np.all(np.diff(spans) >= 0)
            assert effect["share"] >= 0


def test_same_seed_same_case(folder: Path, tmp_path: Path) -> None:
    list(generator.generate(11, 1, tmp_path, ["single"], jobs=1))
    for path in tmp_path.rglob("*.csv"):
        assert path.read_bytes() == (folder / "single" / path.relative_to(tmp_path)).read_bytes()


def test_the_truth_scores_full_marks_and_silence_none(folder: Path) -> None:
    def rows(tool: scoring.Tool) -> list[scoring.Row]:
        out = []
        for case in folders(folder):
            said, prediction = tool(case)
            out.append(scoring.score(case, said, prediction))
            scoring.resolve(out[-1], tool, case, said)
        return out

    for line in scoring.table(rows(scoring.oracle)):
        expected = 0 if line.what.startswith("false alarms") else 1
        assert line.count == 0 or line.value == pytest.approx(expected), line.what
    silent = rows(lambda _: ({"verdict": "none"}, None))
    for line in scoring.table(silent):
        assert line.count == 0 or line.value == 0, line.what
    alarmed = rows(lambda _: ({"verdict": "explained", "effects": ["coulomb"]}, None))
    assert all(r.alarm for r in alarmed if r.kind in ("null", "dormant"))


def test_overlap_of_windows() -> None:
    assert scoring.overlap([[0, 2]], [[1, 3]]) == pytest.approx(1 / 3)
    assert scoring.overlap([[0, 1], [0.5, 2]], [[0, 2]]) == 1
    assert scoring.overlap([], [[0, 1]]) == 0


def test_a_tool_that_fails_is_scored_as_wrong(folder: Path, tmp_path: Path) -> None:
    program = tmp_path / "broken"
    program.write_text("#!/bin/sh\necho no >&2\nexit 1\n")
    program.chmod(0o755)
    case = folders(folder)[0]
    said, prediction = scoring.command_line([str(program)])(case)
    assert said["verdict"] == "failed"
    assert not scoring.score(case, said, prediction).right


def test_every_name_of_the_format_is_drawn_somewhere() -> None:
    drawn = {n for w in plans.schedule(3, 320) for n in w.names}
    assert set(effects.CATALOGUE) <= drawn
    assert set(effects.UNKNOWN) <= drawn
    kinds = {w.kind for w in plans.schedule(3, 320)}
    assert kinds == set(cases.KINDS)
