"""What the diagnosis says of recordings whose truth is known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from scipy import signal

from rthyb_rt import cli, config, core
from rthyb_rt.diagnose import effects, engine, localise, reading
from rthyb_rt.diagnose.effects.base import Context, Effect, Param, Trial
from rthyb_rt.diagnose.outcome import finish
from rthyb_rt.diagnose.power import self_check
from rthyb_rt.diagnose.predict import nrmse
from rthyb_rt.diagnose.select import clustered
from rthyb_rt.errors import InputError

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


def test_a_longer_delay_that_a_stiffer_oil_column_hides_is_named_beside_it(tmp_path):
    # The lag of a slow motion, delay + zeta / (pi f), is that of the model.
    lag_s = cases.DELAY + 0.004 + cases.ZETA / (math.pi * cases.F_HZ)
    f_hz = cases.ZETA / (math.pi * (lag_s - cases.DELAY))
    model = cases.baseline().replace(f"f_hz = {cases.F_HZ}", f"f_hz = {f_hz}")
    d = diagnosed(tmp_path, cases.channels(delay=cases.DELAY + 0.004), model)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["delay", "oil_column"])
    assert found(d, "delay", "dtau_s") == pytest.approx(0.004, rel=0.1)
    assert found(d, "oil_column", "f_Hz") == pytest.approx(cases.F_HZ, rel=0.1)


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


MASS, SPRING, DASHPOT = 6700.0, 4.5e5, 3600.0


def of_a_free_body(
    x: np.ndarray,
    push: np.ndarray,
    a: np.ndarray,
    folder: Path,
    x_std: float = 4e-6,
    f_std: float = 0.4,
):
    rng = np.random.default_rng(7)
    n = x.size
    columns = {
        "t": np.arange(n) / cases.FS,
        "f_in": push,
        "x_meas": x + x_std * rng.standard_normal(n),
        "a_meas": a + 5e-3 * rng.standard_normal(n),
    }
    model = cases.baseline(
        family='"forced"', k=SPRING, c=DASHPOT, moving_mass=MASS, c_tol=0.1
    ).replace(f"f_std = {cases.F_STD}", f"f_std = {f_std}")
    head, _, tail = model.partition("[actuator]")
    return diagnosed(folder, columns, head + "[noise]" + tail.partition("[noise]")[2])


@pytest.mark.parametrize("missing", ["inertia", "stiffness"])
def test_a_body_under_a_sine_of_force_does_not_tell_mass_from_stiffness(missing, tmp_path):
    """The closed form of the steady state: only k - m w^2 is in it."""
    w = 2 * np.pi * 0.9
    k, m = (SPRING, 1.25 * MASS) if missing == "inertia" else (0.9 * SPRING, MASS)
    swing = (
        1200.0 / (k - m * w**2 + 1j * DASHPOT * w) * np.exp(1j * w * np.arange(12288) / cases.FS)
    )
    push = 1200.0 * np.cos(w * np.arange(12288) / cases.FS)
    d = of_a_free_body(swing.real, push, -(w**2) * swing.real, tmp_path)
    assert d.verdict == "ambiguous"
    assert sorted(d.ambiguous_with) == [["inertia"], ["stiffness"]]


@pytest.mark.parametrize("missing", ["inertia", "stiffness"])
def test_a_body_under_a_sweep_of_force_tells_mass_from_stiffness(missing, tmp_path):
    n = 16384
    t = np.arange(n) / cases.FS
    k, m = (SPRING, 1.25 * MASS) if missing == "inertia" else (0.87 * SPRING, MASS)
    ramp = np.clip(t / 0.5, 0, 1) * np.clip((t[-1] - t) / 0.5, 0, 1)
    push = 900.0 * ramp * np.sin(2 * np.pi * (0.3 * t + 0.1 * t**2))
    system = signal.StateSpace(
        [[0, 1], [-k / m, -DASHPOT / m]], [[0], [1 / m]], np.eye(2), np.zeros((2, 1))
    )
    _, y, _ = signal.lsim(system, push, t)
    d = of_a_free_body(y[:, 0], push, (push - k * y[:, 0] - DASHPOT * y[:, 1]) / m, tmp_path)
    assert (d.verdict, d.effects) == ("explained", [missing])


def test_what_the_balance_of_forces_would_lose_shows_in_the_motion(tmp_path):
    """A relaxation that is nearly a dashpot, beside a dashpot known to a tenth."""
    n = 10240
    t = np.arange(n) / cases.FS
    km, tau = 6.0e4, 0.03
    push = 900.0 * np.clip(t / 0.5, 0, 1) * np.sin(2 * np.pi * (0.3 * t + 0.2 * t**2))
    system = signal.StateSpace(
        [[0, 1, 0], [-SPRING / MASS, -DASHPOT / MASS, -1 / MASS], [0, km, -1 / tau]],
        [[0], [1 / MASS], [0]], np.eye(3), np.zeros((3, 1)),
    )  # fmt: skip
    _, y, _ = signal.lsim(system, push, t)
    a = (push - SPRING * y[:, 0] - DASHPOT * y[:, 1] - y[:, 2]) / MASS
    d = of_a_free_body(y[:, 0], push, a, tmp_path)
    assert (d.verdict, d.effects) == ("explained", ["maxwell"])
    # Beside a dashpot of a tenth more or less, stiffness and time alone are not known to a tenth.
    assert holds(d, "maxwell", "km_N_m", km)
    assert holds(d, "maxwell", "tau_s", tau)


FINE = 16
"""Steps of a simulated body in a row."""


def moved_body(push, law, mass: float, n: int, friction=lambda v: 0.0):
    """Return x and a of a body by symplectic Euler steps, from rest: (n,) each.

    ``push`` has the force of each step, ``law(x, v)`` is that of the specimen, ``friction(v)`` the
    level of dry friction, of which no more acts than stops the body.
    """
    h = 1.0 / (FINE * cases.FS)
    x = v = 0.0
    out = np.empty((n, 2))
    for i in range(n * FINE):
        free = push[i] - law(x, v)
        # A body that friction could stop within the step is stopped: it sticks.
        grip = friction(v)
        need = free + mass * v / h
        a = (free - np.clip(need, -grip, grip)) / mass
        if i % FINE == 0:
            out[i // FINE] = x, a
        v += h * a
        x += h * v
    return out[:, 0], out[:, 1]


def swept(n: int, f0: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a swept sine at the rows and at the steps between, of amplitude one."""
    fine = np.arange(n * FINE) / (FINE * cases.FS)
    rise = np.clip(fine / 0.5, 0, 1)
    wave = rise * np.sin(2 * np.pi * (f0 * fine + rate * fine**2))
    return wave[::FINE], wave


def test_a_mass_beside_a_play_of_a_body_under_a_force_is_named_too(tmp_path):
    """What an estimate may blur of the mass is half a per cent, and no fifteen."""
    n, gap = 10240, 1.5e-4
    rows, fine = swept(n, 0.3, 0.12)
    x, a = moved_body(
        900.0 * fine,
        lambda x, v: SPRING * (x - min(max(x, -gap), gap)) + DASHPOT * v,
        1.15 * MASS,
        n,
    )
    d = of_a_free_body(x, 900.0 * rows, a, tmp_path, x_std=1.5e-6, f_std=0.15)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["gap", "inertia"])
    assert found(d, "inertia", "m_kg") == pytest.approx(0.15 * MASS, rel=0.05)
    assert found(d, "gap", "gap_m") == pytest.approx(gap, rel=0.05)


def test_a_stop_beside_sticking_friction_on_moving_ground_shows_in_the_motion(tmp_path):
    """A friction with a peak, before a noisy cell: no estimate follows a body that sticks."""
    n, fc, fs, vs, ks, xs = 12288, 245.0, 590.0, 4e-3, 2.5e5, 9e-3
    rows, fine = swept(n, 0.5, 0.1)
    x, a = moved_body(
        -MASS * 0.15 * fine,
        lambda x, v: SPRING * x + DASHPOT * v + ks * (x - min(max(x, -xs), xs)),
        MASS,
        n,
        lambda v: fc + (fs - fc) * math.exp(-((v / vs) ** 2)),
    )
    rng = np.random.default_rng(5)
    ag = 0.15 * rows
    columns = {
        "t": np.arange(n) / cases.FS,
        "ag": ag,
        "x_meas": x + 7e-6 * rng.standard_normal(n),
        "f_meas": -MASS * (a + ag) + 100.0 * rng.standard_normal(n),
    }
    model = cases.baseline(family='"ground"', k=SPRING, c=DASHPOT, moving_mass=0.0)
    model = model.replace(f"f_std = {cases.F_STD}", "f_std = 100.0")
    model = model.replace(f"x_std = {cases.X_STD}", "x_std = 7e-6")
    head, _, tail = model.partition("[actuator]")
    noise = f"[numerical]\nm = {MASS}\n[noise]" + tail.partition("[noise]")[2]
    d = diagnosed(tmp_path, columns, head + noise)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["stopper", "stribeck"])
    assert found(d, "stopper", "xs_m") == pytest.approx(xs, rel=0.05)
    assert found(d, "stribeck", "Fc_N") == pytest.approx(fc, rel=0.1)


def test_a_gain_error_does_not_hide_a_delay_as_an_offset_in_time(tmp_path):
    columns = cases.channels(delay=cases.DELAY + 0.011)
    columns["x_meas"] = 0.85 * columns["x_meas"]
    del columns["f_meas"]
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["act_gain", "delay"])
    assert found(d, "delay", "dtau_s") == pytest.approx(0.011, rel=0.01)


def test_strokes_of_one_speed_leave_the_law_of_velocity_open(tmp_path):
    """Quasi-static, every stroke of one rate, with a turn just before the end."""
    rng = np.random.default_rng(4)
    corners = np.r_[0, 40, 40 + np.cumsum([330, *[660] * 8]), 5658 + 6]
    x = np.interp(
        np.arange(corners[-1]), corners, [0, 0, *[0.011 * (-1) ** i for i in range(9)], -0.01]
    )
    v = np.gradient(x) * 16.0
    force = 4.0e5 * x + 340.0 * np.sign(v)
    columns = {
        "t": np.arange(x.size) / 16.0,
        "x_meas": x + 4e-6 * rng.standard_normal(x.size),
        "f_meas": force + 30.0 * rng.standard_normal(x.size),
    }
    text = cases.baseline(k=4.0e5, c=0.0, moving_mass=0.0, fs_hz=16.0)
    head, _, _ = text.partition("[actuator]")
    d = diagnosed(tmp_path, columns, head + "[noise]\nx_std = 4e-6\nf_std = 30.0\n")
    assert d.verdict == "ambiguous"
    assert sorted(d.ambiguous_with) == [["coulomb"], ["quad_damping"], ["viscous"]]


def test_a_slow_sweep_tells_the_law_of_velocity_that_strokes_leave_open(tmp_path):
    """No part of it is straight for as long as its noise takes to average out."""
    rng = np.random.default_rng(11)
    t = np.arange(6400) / 16.0
    phase = 2 * np.pi * (0.01 * t + 0.2 * t**2 / (2 * t[-1]))
    x, v = 0.011 * np.sin(phase), 0.011 * np.cos(phase) * np.gradient(phase) * 16.0
    columns = {
        "t": t,
        "x_meas": x + 4e-5 * rng.standard_normal(x.size),
        "f_meas": 4.0e5 * x + 4.0e4 * v + 30.0 * rng.standard_normal(x.size),
    }
    text = cases.baseline(k=4.0e5, c=0.0, moving_mass=0.0, fs_hz=16.0)
    head, _, _ = text.partition("[actuator]")
    d = diagnosed(tmp_path, columns, head + "[noise]\nx_std = 4e-5\nf_std = 30.0\n")
    assert (d.verdict, d.effects) == ("explained", ["viscous"])
    assert found(d, "viscous", "c_Ns_m") == pytest.approx(4.0e4, rel=0.02)


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


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("stiffness", lambda t, x, v, a: 0.06 * cases.K * x),
        ("viscous", lambda t, x, v, a: 2.0 * cases.C * v),
    ],
)
def test_coarse_readings_do_not_hide_what_else_is_missing(name, law, tmp_path):
    columns = cases.channels(law)
    columns["f_meas"] = 200.0 * np.round(columns["f_meas"] / 200.0)
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, sorted(d.effects)) == ("explained", sorted(["quantisation", name]))


def test_friction_with_a_peak_on_a_shearing_contact_is_named_beside_a_mass(tmp_path):
    def law(t, x, v, a):
        shear = np.zeros_like(x)
        for i in range(1, x.size):
            shear[i] = np.clip(shear[i - 1] + (x[i] - x[i - 1]) / 4e-6, -1.0, 1.0)
        return shear * (250.0 + 200.0 * np.exp(-((v / 0.01) ** 2))) + 12.0 * a

    d = diagnosed(tmp_path, cases.channels(law))
    assert (d.verdict, sorted(d.effects)) == ("explained", ["inertia", "stribeck"])


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


def test_the_self_check_finds_again_what_was_found_and_says_how_little_would_be(tmp_path):
    friction = cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 4e-4))
    d = diagnosed(tmp_path, friction)
    rows = self_check(d)
    again = rows[0]
    assert (again["effect"], again["found"]) == ("coulomb", True)
    least = {r["effect"]: r for r in rows if "smallest_detectable_share" in r}
    assert set(least) >= {"coulomb", "viscous", "inertia", "cubic"}
    # Noise of 15 N beside forces of 2.4 kN: friction far smaller than that found is seen.
    assert 0.0 < rows[1]["smallest_detectable_share"] < 0.5 * again["share"]


def test_a_folder_that_cannot_be_one_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    recording, toml = cases.write(tmp_path, cases.channels())
    monkeypatch.setattr(engine, "diagnose", lambda *_: pytest.fail("the work was begun"))
    assert run("diagnose", recording, "--model", toml, "--report", toml) == 1
    assert "is a file and no folder" in capsys.readouterr().err


def test_a_second_test_without_a_reading_cannot_be_held_against_the_model(
    tmp_path, capsys, monkeypatch
):
    recording, toml = cases.write(tmp_path, cases.channels())
    commands = tmp_path / "commands.csv"
    commands.write_text("t,x_cmd\n" + "".join(f"{i / 1024!r},0.0\n" for i in range(2048)))
    monkeypatch.setattr(engine, "diagnose", lambda *_: pytest.fail("the work was begun"))
    assert run("diagnose", recording, "--model", toml, "--heldout", commands) == 3
    said = capsys.readouterr().err
    assert f"{commands}: holds no x_meas" in said
    assert "--predict" in said


def test_the_exit_code_says_nothing_is_missing(tmp_path, capsys):
    recording, toml = cases.write(tmp_path, cases.channels())
    assert run("diagnose", recording, "--model", toml) == 0
    assert "Nothing is missing" in capsys.readouterr().out


BAD = {
    "time runs back": (lambda c: c["t"].__setitem__(400, 0.1), "does not increase"),
    "dead load cell and displacement": (
        lambda c: (c["f_meas"].fill(np.nan), c["x_meas"].fill(np.nan)),
        "holds no number",
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
        "nothing but noise",
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


def test_gaps_that_leave_nothing_to_judge_allow_no_answer(tmp_path):
    columns = cases.channels()
    lost = (np.arange(columns["t"].size) % 150) < 5
    for name in ("x_cmd", "x_meas", "f_meas"):
        columns[name][lost] = np.nan
    with pytest.raises(InputError, match="leave no stretch"):
        diagnosed(tmp_path, columns)


@pytest.mark.parametrize("reading", [1e6, 1e300, np.inf])
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
    assert "Of the specimen this says nothing" in said


def test_a_slip_of_the_pen_in_a_model_is_said(tmp_path):
    text = cases.baseline().replace("moving_mass", "mass")
    d = diagnosed(tmp_path, cases.channels(), text)
    assert any("specimen.mass (is moving_mass meant?)" in note for note in d.notes)


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
    assert "holds on rows left out" in page
    # The page's own policy bars pictures: a drawing that needs one shows a broken frame.
    assert "<image" not in page


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


def band_brake(t, x, v, a, up=14e3, down=19e3, gap=1.1e-3, k=9e6):
    """A brake behind a play: the drum is dragged along by what the band does not hold."""
    drum, force = -0.6 * gap, np.empty_like(x)
    for i, now in enumerate(x):
        drum = min(max(drum, now - gap - up / k), now + gap + down / k)
        bent = now - drum
        force[i] = k * (max(bent - gap, 0.0) + min(bent + gap, 0.0))
    return force


def of_a_brake(seed: int, amplitude: float, **grip: float) -> dict[str, np.ndarray]:
    columns = cases.channels(seed=seed, amplitude=amplitude)
    x, v, _ = cases.moved(columns["x_cmd"])
    noise = 150.0 * np.random.default_rng(seed + 50).standard_normal(x.size)
    del columns["x_cmd"]
    return columns | {"f_meas": band_brake(columns["t"], x, v, None, **grip) + noise}


def naive(columns: dict[str, np.ndarray], f_std: float) -> str:
    x, f = columns["x_meas"], columns["f_meas"]
    slopes = np.column_stack((x, signal.savgol_filter(x, 51, 3, deriv=1, delta=1.0 / cases.FS)))
    k, c = np.linalg.lstsq(slopes, f, rcond=None)[0]
    head = f'schema = "rthyb-baseline/1"\nfamily = "drive"\nfs_hz = {cases.FS}\n'
    return head + (
        f"[specimen]\nk = {k}\nc = {c}\nmoving_mass = 0\n"
        f"[noise]\nx_std = {cases.X_STD}\nf_std = {f_std}\n"
    )


def test_a_brake_that_grips_harder_one_way_behind_a_play_is_named_with_its_parts(tmp_path):
    columns = of_a_brake(2, 9e-3)
    toml = naive(columns, 150.0)
    d = diagnosed(tmp_path, columns, toml)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["bias", "coulomb", "gap"])
    assert found(d, "coulomb", "Fc_N") == pytest.approx(16.5e3, rel=0.02)
    assert found(d, "gap", "gap_m") == pytest.approx(1.1e-3, rel=0.03)
    # The load cell reads none of it while the play is open.
    assert found(d, "bias", "bias_N") == pytest.approx(-2.5e3, rel=0.03)

    other = of_a_brake(3, 5e-3)
    recording, _ = cases.write(tmp_path / "smaller", other, toml)
    second = reading.read_case(recording, d.case.model, judged=False)
    done = finish(d, None, second)
    # Where in its play it began is forgotten with the first slips to either side.
    assert nrmse(done.prediction.f, other["f_meas"], 3 * int(cases.FS)) < 0.03
    # The element of the core is the law that was fitted, from where in its play it began.
    (member,), (beta,) = done.model.members, done.model.betas
    (config_of,) = member.effect.elements(d.context, member.trial, beta)
    assert config_of.kind == "gap_friction"
    gap, start = member.trial.theta[0], member.trial.theta[3]
    np.testing.assert_allclose(
        core.Element(config_of).run(d.context.x + gap * (2.0 * start - 1.0)),
        beta[0] * member.effect.columns(d.context, member.trial)[0],
        atol=1e-6 * 16.5e3,
    )


def test_a_brake_that_grips_alike_behind_a_play_has_no_bias(tmp_path):
    columns = of_a_brake(2, 9e-3, up=16e3, down=16e3)
    d = diagnosed(tmp_path, columns, naive(columns, 150.0))
    assert sorted(d.effects) == ["coulomb", "gap"]


def test_a_sensor_with_a_zero_of_its_own_bends_no_lag_and_its_wander_goes_on(tmp_path):
    columns = cases.channels(delay=cases.DELAY + 0.004)
    wander = 4e-5 + 1.5e-5 * columns["t"]
    columns["x_meas"] = columns["x_meas"] + wander
    half = columns["t"].size * 3 // 4
    early = {k: v[:half] for k, v in columns.items()}
    d = diagnosed(tmp_path, early)
    assert "delay" in d.disp.best.names
    assert found(d, "delay", "dtau_s") == pytest.approx(0.004, abs=2e-4)

    late = {k: v[half:] for k, v in columns.items() if k in ("t", "x_cmd")}
    recording, _ = cases.write(tmp_path / "later", late)
    ahead = finish(d, None, reading.read_case(recording, d.case.model, judged=False))
    off = columns["x_meas"][half:] - ahead.prediction.x
    assert abs(np.mean(off)) < 0.4 * np.mean(wander[half:])


def test_units_do_not_hide_a_spring_of_the_third_power(tmp_path):
    # Of a motion of two millimetres the cube is a column of 1e-10 beside others of 1e2.
    columns = cases.channels(lambda t, x, v, a: 5e10 * x**3, amplitude=2e-3)
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, d.effects) == ("explained", ["cubic"])
    assert found(d, "cubic", "k3_N_m3") == pytest.approx(5e10, rel=0.03)


def test_rows_that_hang_together_tell_as_little_as_they_do():
    rng, keeps, rows, draws = np.random.default_rng(5), 0.9, 4800, 300
    noise = signal.lfilter([1.0], [1.0, -keeps], rng.standard_normal((draws, rows)), axis=1)
    slope = np.ones((rows, 1))
    inverse = np.array([[1.0 / rows]])
    shown = [float(clustered(slope, y - y.mean(), inverse)[0, 0]) for y in noise]
    # Variance of the mean of a first-order autoregression: 1 / (1 - keeps)^2 a row, in the limit.
    truth = 1.0 / (1.0 - keeps) ** 2 / rows
    assert np.mean(shown) == pytest.approx(truth, rel=0.1)


def test_what_a_spring_loses_is_a_part_of_the_spring_there_is(tmp_path):
    loss, travel, stiffer = 0.12, 0.15, 0.02

    def weaker(t, x, v, a):
        path = np.cumsum(np.abs(np.diff(x, prepend=x[0])))
        there = cases.K * (1.0 + stiffer)
        return (there - 1.004 * cases.K) * x - there * loss * (1.0 - np.exp(-path / travel)) * x

    d = diagnosed(tmp_path, cases.channels(weaker))
    assert "degradation" in d.effects
    assert found(d, "degradation", "loss") == pytest.approx(loss, rel=0.01)
    assert holds(d, "degradation", "loss", loss)


def _yielding(x: np.ndarray, xy: float) -> np.ndarray:
    """Bouc-Wen's z, n = 2, beta = gamma = 0.5, from z = 0, by small steps along the path."""
    z = np.zeros(x.size)
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        z[i] = z[i - 1]
        for _ in range(8):
            z[i] += dx / 8 * (1.0 - (z[i] / xy) ** 2 * (0.5 + 0.5 * np.sign(dx * z[i])))
    return z


def test_a_yielding_specimen_recorded_in_mid_motion_lacks_nothing(tmp_path):
    alpha, xy, before = 0.35, 6e-3, 5 * int(cases.FS)
    rng = np.random.default_rng(8)
    u = cases.command("sine", 11.3)
    x, v, a = cases.moved(u)
    f = cases.K * (alpha * x + (1.0 - alpha) * _yielding(x, xy)) + cases.C * v + cases.M * a
    rows = slice(before, None)
    t = np.arange(u.size)[rows] / cases.FS
    columns = {
        "t": t - t[0],
        "x_cmd": u[rows],
        "x_meas": x[rows] + cases.X_STD * rng.standard_normal(t.size),
        "f_meas": f[rows] + cases.F_STD * rng.standard_normal(t.size),
    }
    table = f"[specimen.bouc_wen]\nalpha = {alpha}\nxy = {xy}\nn = 2.0\nbeta = 0.5\ngamma = 0.5\n"
    model = cases.baseline().replace("[actuator]", f"{table}[actuator]")
    d = diagnosed(tmp_path, columns, model)
    assert d.verdict == "none"
    # Where it is judged, it no longer matters whether the spring was at rest when recording began.
    fresh = (1.0 - alpha) * cases.K * (_yielding(x[rows] - x[before], xy) - _yielding(x, xy)[rows])
    assert np.max(np.abs(fresh)) > 20.0 * cases.F_STD
    judged = d.estimate.rows
    assert judged.sum() > 0.5 * judged.size
    assert np.max(np.abs(fresh[judged])) < cases.F_STD
