"""Forms of laws that the diagnosis tells apart, and the elements that they become."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import diagnose_cases as cases
import numpy as np
import pytest
from scipy import signal

from rthyb_rt import config, core
from rthyb_rt.core.diagnosis_models import ActuatorModel, ComputedMotion, actuator
from rthyb_rt.diagnose import effects, engine, found_model, outcome, reading
from rthyb_rt.diagnose.augment import rig_toml
from rthyb_rt.diagnose.case import Model
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.modulation import Modulated, UnknownChannel
from rthyb_rt.diagnose.onset import Late
from rthyb_rt.diagnose.problem import Member, columns_of

K, H = cases.K, 1 / cases.FS


def diagnosed(folder, law, **kwargs):
    recording, toml = cases.write(folder, cases.channels(law, **kwargs))
    return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


def element(kind, x, v=0.0, a=0.0, **params):
    return core.CoreElement(core.element(kind, **params)).run(x, v, a, H)


@pytest.fixture(scope="module")
def ctx(tmp_path_factory):
    _, toml = cases.write(tmp_path_factory.mktemp("ctx"), cases.channels())
    x, v, a = cases.moved(cases.command())
    t = np.arange(x.size) * H
    return Context(reading.read_model(toml), ComputedMotion(x, v, a), t, K * x, {})


@pytest.fixture(scope="module")
def free(ctx, tmp_path_factory):
    """The same, without tolerances: what is not stated may be anything."""
    _, toml = cases.write(tmp_path_factory.mktemp("free"), cases.channels(), naive())
    other = {"fy_meas": 0.1 * ctx.force}
    return Context(reading.read_model(toml), ctx.motion, ctx.t, ctx.force, other)


def force_of(found, ctx):
    return sum(core.CoreElement(one).run(ctx.x, ctx.v, ctx.a, ctx.dt) for one in found)


BETAS = {
    "gap": 1.0, "hysteresis": 0.8, "cubic": 0.7, "stopper": 3e5, "power_damping": 200.0,
    "quadratic": 6e6,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "trial"),
    [
        ("hysteresis", Trial((2e-3,), "mp")),
        ("hysteresis", Trial((2e-3, 3.5, 0.3), "mp r")),
        ("hysteresis", Trial((2e-3,), "iwan0")),
        ("hysteresis", Trial((2e-3, 0.7), "iwan")),
        ("hysteresis", Trial((2e-3, 0.1, 0.2), "kinematic")),
        ("hysteresis", Trial((2e-3, 0.1, 0.2, 0.3, 0.05), "both")),
        ("cubic", Trial((5e-3,), "sine")),
        ("cubic", Trial()),
        ("cubic", Trial((2.3,), "power")),
        ("quadratic", Trial((9e-2,), "exponential")),
        ("quadratic", Trial((9e-2,), "exponential down")),
        ("gap", Trial((1e-3,), "deadband")),
        ("gap", Trial((1e-3, 3e-4), "uneven")),
        ("stopper", Trial((4e-3,), "up")),
        ("stopper", Trial((4e-3,), "down")),
        ("stopper", Trial((4e-3,), "both")),
        ("power_damping", Trial((0.4,))),
        ("power_damping", Trial((1.4,))),
    ],
)
def test_elements_of_a_law_give_the_force_that_was_fitted(name, trial, ctx):
    effect = effects.catalogue()[name]
    beta = np.array([BETAS[name]])
    fitted = effect.columns(ctx, trial)[0] * beta[0]
    found = force_of(effect.elements(ctx, trial, beta), ctx)
    np.testing.assert_allclose(found, fitted, atol=2e-4 * np.max(np.abs(fitted)))


def test_the_slider_of_an_isolator_becomes_a_friction_pendulum_on_a_flat_bowl(ctx):
    effect, trial = effects.catalogue()["hysteresis"], Trial((4e-4, 50.0), "slider")
    beta = np.array([600.0, 250.0])
    fitted = np.column_stack(effect.columns(ctx, trial)) @ beta
    found = force_of(effect.elements(ctx, trial, beta), ctx)
    np.testing.assert_allclose(found, fitted, atol=1e-6 * 600.0)


def test_every_form_says_what_it_is(ctx):
    forms = {}
    for name, effect in effects.catalogue().items():
        for trial in effect.trials(ctx):
            forms.setdefault(name, set()).add(effect.form(ctx, trial))
    assert all(text for texts in forms.values() for text in texts)
    text = " ".join(forms["hysteresis"])
    for word in ("Bouc-Wen", "Iwan", "Menegotto-Pinto", "isotropic", "friction pendulum"):
        assert word in text
    assert any("sin" in form for form in forms["cubic"])
    assert any("one" in form or "only" in form for form in forms["stopper"])


@pytest.mark.parametrize("name", sorted(effects.catalogue()))
def test_parameters_at_the_ends_of_a_shape_are_numbers(name, free):
    """Also those of a candidate that loses are printed, and may end anywhere within the limits."""
    effect, done = effects.catalogue()[name], set()
    for trial in effect.trials(free):
        if trial.variant in done:
            continue
        done.add(trial.variant)
        (signs, _), _ = effect.settings(free, trial)
        limits = effect.limits(free, trial)
        for end in (0, 1):
            at = replace(trial, theta=tuple(float(pair[end]) for pair in limits))
            for size in (1e-9, 1.0, 1e9):
                said = effect.report(free, at, np.full(len(signs), size))
                assert np.all(np.isfinite(list(said.values()))), (trial.variant, end, size, said)
                assert effect.form(free, at)


LAWS = {
    "hysteresis, Menegotto-Pinto": lambda x, v: (
        element("menegotto_pinto", x, k_n_per_m=K, post_yield_ratio=0.1, xy_m=3e-3, r0=20.0,
                cr1=0.925, cr2=0.15) - K * x
    ),
    "hysteresis, Iwan": lambda x, v: (
        element("iwan", x, k_n_per_m=K, post_yield_ratio=0.1, xy_m=3e-3, spread=0.8) - K * x
    ),
    "hysteresis, kinematic and isotropic": lambda x, v: (
        element("chaboche", x, k_n_per_m=K, fy_n=1200.0, kinematic_n_per_m=2e5,
                recovery_per_m=150.0, isotropic_n=300.0, isotropic_rate_per_m=20.0) - K * x
    ),
    "hysteresis, friction pendulum": lambda x, v: element(
        "friction_pendulum", x, v, weight_n=8e3, radius_m=1e3, mu_slow=0.03, mu_fast=0.07,
        mu_rate_s_per_m=60.0, xy_m=3e-4,
    ),
    "cubic, pendulum": lambda x, v: K * 5e-3 * np.sin(x / 5e-3) - K * x,
    "cubic, power": lambda x, v: 500.0 * np.sign(x) * np.abs(x / 7e-3) ** 2.3,
    "quadratic, exponential": lambda x, v: 0.8 * K * (0.02 * (1.0 - np.exp(-x / 0.02)) - x),
    "gap, dead band from to": lambda x, v: (
        K * (np.maximum(x - 1e-3, 0.0) + np.minimum(x + 3e-4, 0.0)) - K * x
    ),
    "power_damping, fluid": lambda x, v: 400.0 * np.sign(v) * np.abs(v / 0.1) ** 0.5,
    "stopper, upwards": lambda x, v: 1e6 * np.maximum(x - 5e-3, 0.0),
}  # fmt: skip


QUICK = ("hysteresis, Menegotto-Pinto", "cubic, power", "gap, dead band from to")


@pytest.mark.parametrize(
    "law", [pytest.param(one, marks=() if one in QUICK else pytest.mark.long) for one in LAWS]
)
def test_a_law_is_named_with_its_form_and_becomes_a_rig(law, tmp_path):
    name, form = law.split(", ", 1)
    d = diagnosed(tmp_path, lambda t, x, v, a: LAWS[law](x, v), seed=3)
    assert (d.verdict, d.effects) == ("explained", [name])
    model = found_model.augmented(d)
    (member,) = [m for m in model.members if m.name == name]
    said = member.effect.form(d.context, member.trial)
    assert all(word in said for word in form.split())
    text, lost = rig_toml(model)
    assert lost == []
    config.parse_rig(text)
    assert tomllib.loads(text)["specimen"]


def naive():
    return "\n".join(line for line in cases.baseline().splitlines() if "_tol" not in line)


def test_friction_and_a_dashpot_beside_a_naive_model_are_not_one_damper(tmp_path):
    """A power of velocity has as many parameters as the two, and leaves five times as much."""
    t = np.arange(3 * 1024) / 512
    x = 8e-3 * np.sin(3 * np.pi * t) * np.minimum(t, 1.0)
    v = np.gradient(x, t)
    rng = np.random.default_rng(3)
    f = 3e4 * x + 400.0 * np.tanh(v / 2e-4) + 7500.0 * v + 2.0 * rng.standard_normal(t.size)
    columns = {"t": t, "x_meas": x + 1e-6 * rng.standard_normal(t.size), "f_meas": f}
    recording, model = cases.write(
        tmp_path, columns,
        'schema = "rthyb-baseline/1"\nfamily = "drive"\nfs_hz = 512\n[specimen]\nk = 3e4\nc = 0\n'
        "moving_mass = 0\n[noise]\nx_std = 1e-6\nf_std = 2\n",
    )  # fmt: skip
    d = engine.diagnose(reading.read_case(recording, reading.read_model(model)))
    assert (d.verdict, d.effects) == ("explained", ["coulomb", "viscous"])
    params = {k: v for c in d.candidates[:2] for k, v in c.params.items()}
    assert params["Fc_N"] == pytest.approx(400.0, rel=0.02)
    assert params["c_Ns_m"] == pytest.approx(7500.0, rel=0.02)


@pytest.mark.long
def test_a_worn_column_beside_a_naive_model_yields_pinches_and_degrades(tmp_path):
    def law(t, x, v, a):
        return element(
            "rc_column", x, k_n_per_m=K, post_yield_ratio=0.05, xy_m=2e-3, eta=2.0, pivot=4.0,
            ultimate_m=2e-2, strength_lost_at_ultimate=0.2, energy_j=40.0,
            strength_lost_with_energy=0.2, stiffness_lost_with_energy=0.3, slip=0.2,
            slip_level=0.3, slip_width=0.2,
        ) - K * x  # fmt: skip

    recording, toml = cases.write(tmp_path, cases.channels(law, seed=3), naive())
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == ("explained", ["degradation", "hysteresis", "pinching"])
    params = {k: v for c in d.candidates[:3] for k, v in c.params.items()}
    assert params["xy_m"] == pytest.approx(2e-3, rel=0.15)
    assert set(params) == {"xy_m", "alpha", "depth", "width_ratio", "loss", "travel_m"}
    text, lost = rig_toml(found_model.augmented(d))
    assert lost == []
    assert any(one.element == "rc_column" for one in config.parse_rig(text).specimen)


def wall(x):
    """A slider of .8 kN, and a wall whose cracks open, on either side, up to where it has been."""
    slides = np.zeros(x.size)
    for i in range(1, x.size):
        slides[i] = np.clip(slides[i - 1] + 4e5 * (x[i] - x[i - 1]), -800.0, 800.0)
    largest, force = np.full(2, 1e-4), np.zeros(x.size)
    for i, here in enumerate(x):
        side = int(here < 0.0)
        largest[side] = max(largest[side], abs(here))
        whole = (3e5, 2.2e5)[side] * 0.02 * (largest[side] / 0.02) ** 0.5
        # Straight from zero to a third of that force at two thirds of the way, then to the peak.
        share = np.interp(abs(here) / largest[side], [0.0, 2 / 3, 1.0], [0.0, 1 / 3, 1.0])
        force[i] = np.sign(here) * whole * share
    return slides + force


def test_a_wall_aimed_at_its_largest_displacement_is_named_and_foretold(tmp_path):
    """Cycles of growing amplitude; the straight lines of the wall are not the powers of the law."""
    turns = np.repeat([2, 4, 6, 9, 12, 16, 20, 25], 2) * 1e-3
    turns = np.ravel(np.column_stack([turns, -turns]))
    x = np.interp(np.arange(40 * (turns.size + 1)) / 40, np.arange(turns.size + 1), np.r_[0, turns])
    f = wall(x) + 10.0 * np.random.default_rng(5).standard_normal(x.size)
    t, end = np.arange(x.size) / 10, 40 * 24
    stated = (
        'schema = "rthyb-baseline/1"\nfamily = "drive"\nfs_hz = 10\n[specimen]\nk = 2.5e5\nc = 0\n'
        "moving_mass = 0\n[noise]\nx_std = 1e-6\nf_std = 10\n"
    )

    def written(name, rows):
        columns = {"t": t[rows], "x_meas": x[rows], "f_meas": f[rows]}
        return cases.write(tmp_path / name, columns, stated)

    recording, toml = written("first", slice(end))
    model = reading.read_model(toml)
    first = reading.read_case(recording, model)
    then = reading.read_case(written("then", slice(end, None))[0], model, judged=False)
    d = engine.diagnose(first)
    assert (d.verdict, d.effects) == ("explained", ["degradation", "hysteresis", "pinching"])
    found = found_model.augmented(d)
    assert "aimed" in found.members[0].effect.form(d.context, found.members[0].trial)
    text, lost = rig_toml(found)
    assert lost == []
    assert {"hysteresis", "peak_oriented"} <= {e.element for e in config.parse_rig(text).specimen}
    assert outcome.finish(d, then, None).heldout["heldout_nrmse_after"] < 0.1


RIG = """schema = "rthyb-rig/1"
[rig]
name = "chain"
elastic_stiffness_n_per_m = 5e5
command_hold = "foh"
[actuator]
kind = "second-order"
natural_frequency_hz = 28
damping_ratio = 0.9
delay_s = 0.0052
[[specimen]]
element = "iwan"
k_n_per_m = 5e5
post_yield_ratio = 0.1
xy_m = 3e-3
spread = 0.8
[sensors.displacement]
noise_std_m = 3e-6
[sensors.force]
noise_std_n = 15
"""


@pytest.mark.long
def test_a_rig_file_may_have_nothing_but_a_loop_for_a_specimen(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "FS", core.FS_HZ)  # the rate of every rig file

    def law(t, x, v, a):
        f = element("iwan", x, k_n_per_m=5e5, post_yield_ratio=0.1, xy_m=3e-3, spread=0.8)
        plain = 1.004 * K * x + 0.95 * cases.C * v + cases.M * a
        return f + 100.0 * np.tanh(v / 4e-4) - plain

    recording, _ = cases.write(tmp_path, cases.channels(law, seed=6))
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG, encoding="utf-8")
    d = engine.diagnose(reading.read_case(recording, reading.read_model(rig)))
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])


AIMED = ("aimed", "aimed, uneven")
TAKEDA = ("takeda", "takeda, worn", "takeda, uneven")
JOINT = ("hysteresis+degradation", "hysteresis+pinching+degradation")


@pytest.mark.parametrize(
    ("name", "variant"),
    [(name, v) for name in JOINT for v in (*AIMED, *TAKEDA)]
    + [(JOINT[1], v) for v in ("slack", "worn")],
)
def test_the_column_of_the_core_is_the_one_that_was_fitted(name, variant, free):
    effect = effects.catalogue()[name]
    trial = next(one for one in effect.trials(free) if one.variant == variant)
    columns = np.column_stack(effect.columns(free, trial))
    beta = np.array([0.9, 0.6])[: columns.shape[1]]
    fitted = columns @ beta
    found = force_of(effect.elements(free, trial, beta), free)
    np.testing.assert_allclose(found, fitted, atol=1e-9 * np.max(np.abs(fitted)))


@pytest.mark.parametrize("name", JOINT)
def test_a_loop_in_place_of_a_stated_spring_begins_with_its_stiffness(name, ctx):
    effect = effects.catalogue()[name]
    assert {t.variant for t in effect.trials(ctx)} == {"takeda", "takeda, worn"}
    for trial in effect.trials(ctx):
        (column,) = effect.columns(ctx, trial)
        found = force_of(effect.elements(ctx, trial, np.ones(1)), ctx)
        np.testing.assert_allclose(found, column, atol=1e-9 * np.max(np.abs(column)))
        few = np.abs(ctx.x) < 1e-3 * ctx.x_range
        first = slice(None, int(np.argmin(few)))
        assert np.all(np.abs(column[first]) <= 2e-2 * ctx.k_scale * np.abs(ctx.x[first]))


def clough(x, k, xy, ratio, exponent):
    """Straight lines by the rule of Clough & Johnston, row by row, on a backbone of two lines."""
    peak, f, last, zero = {1: xy, -1: xy}, 0.0, 0.0, 0.0
    out = np.zeros(x.size)
    for i, here in enumerate(x):
        way = 1 if here >= last else -1
        unloads = {s: k * (xy / peak[s]) ** exponent for s in (1, -1)}
        if f * way < 0.0:
            reached = f + unloads[-way] * (here - last)
            if reached * way < 0.0:
                f, last, out[i] = reached, here, reached
                continue
            zero = last - f / unloads[-way]
            f, last = 0.0, zero
        top, far = k * (xy + ratio * (peak[way] - xy)), way * here
        if far >= peak[way]:
            peak[way], most = far, k * (xy + ratio * (far - xy))
        else:
            most = top * (far - way * zero) / (peak[way] - way * zero)
        f = way * min(way * f + unloads[way] * abs(here - last), most)
        last, out[i] = here, f
    return out


@pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_joint_that_reloads_towards_its_largest_displacement_yields_and_degrades(tmp_path, known):
    """Beside a stated stiffness, and beside the line through the recording."""
    rule = {"xy": 2e-3, "ratio": 0.1, "exponent": 0.4}
    measured = cases.channels(lambda t, x, v, a: clough(x, K, **rule) - K * x, seed=4)
    recording, toml = cases.write(tmp_path, measured, None if known else naive())
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == ("explained", ["degradation", "hysteresis"])
    assert d.fit["nrmse_after"] < 0.03
    text, lost = rig_toml(found_model.augmented(d))
    assert lost == []
    (loop,) = [e for e in config.parse_rig(text).specimen if e.element == "takeda"]
    assert loop.xy_m == pytest.approx(2e-3, rel=0.1)
    assert loop.unloading_exponent == pytest.approx(0.4, abs=0.1)


@pytest.mark.long
def test_the_exponent_of_a_fluid_damper_is_found(tmp_path):
    d = diagnosed(tmp_path, lambda t, x, v, a: 400.0 * np.sign(v) * np.abs(v / 0.1) ** 0.35)
    (found,) = [c for c in d.candidates if c.name == "power_damping"]
    assert found.params["exponent"] == pytest.approx(0.35, abs=0.02)
    assert found.params["F1_N"] == pytest.approx(400.0 * 10**0.35, rel=0.05)


@pytest.mark.parametrize(
    ("exponent", "law"),
    [(0.9, "viscous"), (1.1, "viscous"), (1.85, "quad_damping"), (2.15, "quad_damping"),
     (0.2, ""), (1.5, ""), (2.6, ""), (3.5, "")],
)  # fmt: skip
def test_a_power_of_velocity_at_the_end_of_its_range_is_the_law_beyond_it(exponent, law):
    assert effects.catalogue()["power_damping"].borders(Trial((exponent,))) == law


def test_a_cell_of_a_closed_loop_is_not_early_by_what_its_noise_takes_to_come_round(ctx):
    """A reading moves the specimen a row and the actuator's delay later, noise and all."""
    law = effects.catalogue()["time_skew"]
    loop = Context(replace(ctx.model, family="loop"), ctx.motion, ctx.t, ctx.force, {})
    most = loop.model.actuator.delay_s + loop.dt
    early = [-t.theta[0] for t in law.trials(loop) if t.theta[0] < 0.0]
    assert 0.0 < max(early) < most < max(-t.theta[0] for t in law.trials(ctx))
    assert max(t.theta[0] for t in law.trials(loop)) == max(t.theta[0] for t in law.trials(ctx))
    assert law.limits(loop, Trial((-1e-3,)))[0][1] == pytest.approx(min(most, 0.03))
    assert law.limits(ctx, Trial((-1e-3,)))[0][1] == pytest.approx(0.03)


def test_a_late_cell_of_a_closed_loop_is_late_with_all_of_the_force():
    """Its noise moves the specimen only afterwards: friction that jumps is as late as the rest."""
    u = cases.command()
    lag = ActuatorModel(cases.DELAY, cases.F_HZ, cases.ZETA)
    motion = actuator(lag, u, cases.FS)
    model = Model("loop", cases.FS, k=K, c=cases.C, moving_mass=cases.M, f_std=cases.F_STD)
    model = replace(model, actuator=lag)
    t = np.arange(u.size) * H
    loop = Context(model, motion, t, K * motion.x, {})
    law, late_s = effects.catalogue()["time_skew"], 2.5 * H

    def jumps(along):
        return [300.0 * np.sign(along.v)]

    (seen,) = law.reading(loop, Trial((late_s,)), jumps)
    _, v, _ = cases.moved(u, cases.DELAY + late_s)
    np.testing.assert_array_equal(seen[4:], 300.0 * np.sign(v[4:]))
    # An early one is not shifted with the noise that the loop has brought back.
    plain = law.carried(loop, Trial((-late_s,)), jumps(loop)[0])
    np.testing.assert_array_equal(law.reading(loop, Trial((-late_s,)), jumps)[0], plain)


def test_a_late_cell_behind_a_fast_lag_is_no_moving_mass(tmp_path, monkeypatch):
    """The acceleration bends within each row: a curve through the rows would show a mass."""
    rate_hz, fine, rows, late_s = 1024.0, 16, 8192, 0.00538
    settings = {"F_HZ": 73.0, "ZETA": 2.2, "M": 105.0, "K": 2.1e5, "C": 520.0, "DELAY": 0.003}
    for name, value in (settings | {"FS": fine * rate_hz, "F_STD": 1.3}).items():
        monkeypatch.setattr(cases, name, value)
    rng = np.random.default_rng(3)
    low = signal.butter(2, 8.0, fs=rate_hz, output="sos")
    u = 0.02 * signal.sosfilt(low, rng.standard_normal(rows))
    at = np.arange(fine * (rows - 1) + 1)
    x, v, a = cases.moved(np.interp(at / fine, np.arange(rows), u), cases.DELAY, fine=1)
    force = cases.K * x + cases.C * v + cases.M * a
    seen = np.interp(fine * (np.arange(rows) - late_s * rate_hz), at, force)
    monkeypatch.setattr(cases, "FS", rate_hz)
    table = {
        "t": np.arange(rows) / rate_hz,
        "x_cmd": u,
        "x_meas": x[::fine] + cases.X_STD * rng.standard_normal(rows),
        "f_meas": seen + cases.F_STD * rng.standard_normal(rows),
    }
    changed = {"k": cases.K, "c": cases.C, "moving_mass": cases.M, "fs_hz": rate_hz}
    recording, toml = cases.write(tmp_path, table, cases.baseline(**changed))
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == ("explained", ["time_skew"])
    assert d.candidates[0].params["skew_s"] == pytest.approx(late_s, rel=0.01)


@pytest.mark.parametrize("late_s", [5.5e-3, -5e-3])
def test_a_displacement_sensor_off_its_zero_beside_a_late_cell_is_no_zero_of_the_cell(
    tmp_path, late_s
):
    """The reading between the rows is that of the same sensor."""
    zero_m, random, u = 3e-4, np.random.default_rng(3), cases.command()
    x, late = cases.moved(u)[0], cases.moved(u, cases.DELAY + late_s)
    force = cases.K * (late[0] + zero_m) + cases.C * late[1] + cases.M * late[2]
    table = {
        "t": np.arange(u.size) / cases.FS,
        "x_cmd": u,
        "x_meas": x + zero_m + cases.X_STD * random.standard_normal(u.size),
        "f_meas": force + cases.F_STD * random.standard_normal(u.size),
    }
    recording, toml = cases.write(tmp_path, table)
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == ("explained", ["time_skew"])
    assert d.candidates[0].params["skew_s"] == pytest.approx(late_s, rel=0.05)


def slowly_loaded() -> Context:
    """Return a recording of slow motion behind a lag, and of a voltage."""
    model = Model("drive", cases.FS, cases.K, c=cases.C, k_tol=0.02, c_tol=0.1)
    t = np.arange(2048) / cases.FS
    lag = ActuatorModel(cases.DELAY, cases.F_HZ, cases.ZETA)
    motion = actuator(lag, 1e-2 * np.sin(2.0 * np.pi * t), cases.FS)
    force = model.force(motion.x, motion.v, motion.a)
    return Context(model, motion, t, force, {"voltage": np.sin(0.7 * t)})


@pytest.mark.parametrize("rows", [0.98, 0.5, -0.02, -0.5, -1.98])
def test_what_begins_in_mid_recording_begins_later_in_a_late_cell(rows):
    """By a share of a row as well: otherwise its start jumps where the delay is a whole row."""
    ctx, start_s = slowly_loaded(), 3.1
    cell = Member(effects.catalogue()["time_skew"], Trial((rows / cases.FS,)))
    law = Member(Late(effects.catalogue()["coulomb"]), Trial((start_s,), "sharp"))
    seen = columns_of(ctx, [law, cell])[0][0]
    about = slice(int(2.9 * cases.FS), int(3.3 * cases.FS))
    # It slides in one direction all the while.
    switch = 0.5 * (1.0 + np.tanh((ctx.t - start_s - rows / cases.FS) / 0.005))
    assert np.abs(seen[about]) == pytest.approx(switch[about], abs=1e-6)


@pytest.mark.parametrize("rows", [0.98, 0.5, -0.5])
def test_a_channel_that_modulates_a_law_is_as_late_in_a_late_cell_as_the_law(rows):
    ctx = slowly_loaded()
    cell = Member(effects.catalogue()["time_skew"], Trial((rows / cases.FS,)))
    law = Modulated(effects.catalogue()["viscous"], UnknownChannel("voltage", 0.0, 1.0), True)
    seen = columns_of(ctx, [Member(law, Trial()), cell])[0][0]
    plain = columns_of(ctx, [Member(effects.catalogue()["viscous"], Trial()), cell])[0][0]
    wanted = plain * np.sin(0.7 * (ctx.t - rows / cases.FS))
    assert seen[8:-8] == pytest.approx(wanted[8:-8], abs=1e-6 * np.max(np.abs(plain)))


@pytest.mark.parametrize("variant", ["spread0", "spread0.5", "spread1.0"])
def test_bristles_beside_a_softer_spring_are_yielding_of_the_same_form(
    ctx: Context, variant: str
) -> None:
    """k (alpha x + (1 - alpha) z) is a spring of alpha k and a chain of (1 - alpha) k."""
    chain, yielding = effects.catalogue()["lugre"], effects.catalogue()["hysteresis"]
    xy, alpha = 0.3 * ctx.x_range, 0.35
    own = Trial((xy,), variant)
    force = chain.columns(ctx, own)[0] * (1.0 - alpha) * ctx.model.k * xy
    force += (alpha - 1.0) * ctx.model.k * ctx.x
    twin = yielding.columns(ctx, yielding.like(own))[0] * (1.0 - alpha)
    assert twin == pytest.approx(force, abs=1e-9 * float(np.abs(force).max()))
