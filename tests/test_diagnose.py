"""What the diagnosis says of recordings whose truth is known."""

from __future__ import annotations

import math
from types import SimpleNamespace

import diagnose_cases as cases
import numpy as np
import pytest
from diagnose_answers import diagnosed, found, holds
from scipy import signal

from rthyb_rt import core
from rthyb_rt.diagnose import actuation, actuator_choice, localise, reading, words
from rthyb_rt.diagnose.outcome import finish
from rthyb_rt.diagnose.predict import nrmse
from rthyb_rt.diagnose.refinement import clustered


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


@pytest.mark.long
def test_two_effects_that_cancel_are_both_named(tmp_path):
    d = diagnosed(
        tmp_path, cases.channels(lambda t, x, v, a: 200.0 * np.tanh(v / 4e-4) - 3600.0 * v)
    )
    assert (d.verdict, sorted(d.effects)) == ("explained", ["coulomb", "viscous"])


@pytest.mark.long
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


@pytest.mark.long
def test_an_effect_that_begins_in_mid_record_is_named(tmp_path):
    d = diagnosed(
        tmp_path, cases.channels(lambda t, x, v, a: (t > 4.3) * 150.0 * np.tanh(v / 4e-4))
    )
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert d.windows[0][0] == pytest.approx(4.3, abs=0.2)


@pytest.mark.parametrize(("size", "verdict"), [(1.3e-3, "explained"), (5e-3, "unknown")])
def test_a_displacement_off_by_less_than_a_thousandth_hides_no_friction(size, verdict, tmp_path):
    """No actuator makes this bump; as an effect it would be too small to be reported, too."""
    columns = cases.channels(lambda t, x, v, a: 130.0 * np.tanh(v / 1e-4))
    bump = 6.0 * np.exp(-(((columns["t"] - 1.0) / 0.05) ** 2))
    columns["x_meas"] = columns["x_meas"] + size * np.std(columns["x_meas"]) * bump
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, d.effects) == (verdict, ["coulomb"] if verdict == "explained" else [])


@pytest.mark.long
def test_a_longer_delay_is_the_actuators_and_not_the_specimens(tmp_path):
    d = diagnosed(tmp_path, cases.channels(delay=cases.DELAY + 0.004))
    assert (d.verdict, d.effects, d.channel) == ("explained", ["delay"], "disp")
    assert found(d, "delay", "dtau_s") == pytest.approx(0.004, abs=1.2e-4)


@pytest.mark.long
def test_a_longer_delay_that_a_stiffer_oil_column_hides_is_named_beside_it(tmp_path):
    # The lag of a slow motion, delay + zeta / (pi f), is that of the model.
    lag_s = cases.DELAY + 0.004 + cases.ZETA / (math.pi * cases.F_HZ)
    f_hz = cases.ZETA / (math.pi * (lag_s - cases.DELAY))
    model = cases.baseline().replace(f"f_hz = {cases.F_HZ}", f"f_hz = {f_hz}")
    d = diagnosed(tmp_path, cases.channels(delay=cases.DELAY + 0.004), model)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["delay", "oil_column"])
    assert found(d, "delay", "dtau_s") == pytest.approx(0.004, rel=0.1)
    assert found(d, "oil_column", "f_Hz") == pytest.approx(cases.F_HZ, rel=0.1)


@pytest.mark.parametrize(
    ("beside", "named"), [("oil_column", True), ("delay_rate", False), ("rate_limit", False)]
)
def test_a_delay_beside_a_lag_counts_by_its_evidence_and_beside_inexact_laws_by_its_size(
    beside, named
):
    """Of half a per cent of the amplitude, at 20 times its price, and down to the noise."""
    known = {e.name: e for e in actuation.CATALOGUE}
    task = SimpleNamespace(
        rows=np.arange(10_000), case=SimpleNamespace(model=SimpleNamespace(k_tol=0.01)),
        price_of=lambda effect: 20.0, by_form=lambda fit: 10.0,
    )  # fmt: skip

    def of(chi2: float, *names: str) -> SimpleNamespace:
        effects_of = tuple(known[n] for n in names)
        return SimpleNamespace(chi2=chi2, effects=effects_of, misfit=lambda scale: chi2 / scale)

    weighed = actuator_choice.WeighedSets(task, of(1.6e7), [], 1.0, 1.0, None)
    both, alone = of(10_000.0, "delay", beside), of(10_400.0, beside)
    assert weighed.completes(both, known["delay"], alone) == named


@pytest.mark.parametrize(
    ("apart", "alike"), [(0.0, True), (1.9, True), (2.1, False), (-0.5, True), (-12.0, True)]
)
def test_a_lag_that_fits_as_well_as_a_delay_is_no_worse_for_its_second_number(
    apart: float, alike: bool
) -> None:
    """Beside another effect, its number must contribute something."""
    known = {e.name: e for e in actuation.CATALOGUE}

    def of(chi2: float, count: int, *names: str) -> SimpleNamespace:
        effects_of = tuple(known[n] for n in names)
        return SimpleNamespace(count=count, effects=effects_of, misfit=lambda scale: chi2 / scale)

    weighed = actuator_choice.WeighedSets(None, None, [], 1.0, 1.0, None)
    delay, lag = of(1000.0, 1, "delay"), of(1000.0 + apart, 2, "oil_column")
    assert weighed.alike(lag, delay) == alike
    pair, other = (
        of(1000.0, 2, "act_gain", "delay"),
        of(1000.0 + apart, 3, "act_gain", "oil_column"),
    )
    assert weighed.alike(other, pair) == (apart < -0.9)


@pytest.mark.long
def test_relaxation_beside_less_damping_is_told_with_what_it_means_for_fast_motion(tmp_path):
    relaxing = core.element("maxwell", km_n_per_m=2e5, tau_s=0.1)

    def missing(t, x, v, a):
        return core.CoreElement(relaxing).run(x, v, a, t[1] - t[0]) - 2.0 * cases.C * v

    d = diagnosed(tmp_path, cases.channels(missing))
    assert (d.verdict, sorted(d.effects)) == ("explained", ["maxwell", "viscous"])
    assert found(d, "viscous", "c_Ns_m") == pytest.approx(-2.0 * cases.C, rel=0.15)
    (note,) = words.driving_notes(d)
    assert "would be driven" in note
    milder = diagnosed(
        tmp_path / "milder",
        cases.channels(lambda t, x, v, a: missing(t, x, v, a) + 1.4 * cases.C * v),
    )
    assert words.driving_notes(milder) == []


@pytest.mark.long
def test_triangle_of_a_stiff_drive_is_judged_between_its_corners(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "FS", 1000.0)
    monkeypatch.setattr(cases, "F_HZ", 90.0)
    mass, u = 1000.0, cases.command("triangle", 6.0)
    x = cases.moved(u)[0]
    # A load cell late by what is normal: at the corners that is fifty times its noise.
    late = cases.moved(u, cases.DELAY + 1e-4)
    rng = np.random.default_rng(4)
    f = cases.K * late[0] - 1.5 * cases.C * late[1] + mass * late[2]
    columns = {
        "t": np.arange(u.size) / cases.FS,
        "x_cmd": u,
        "x_meas": x + cases.X_STD * rng.standard_normal(u.size),
        "f_meas": f + cases.F_STD * rng.standard_normal(u.size),
    }
    d = diagnosed(tmp_path, columns, cases.baseline(moving_mass=mass, fs_hz=cases.FS))
    # One velocity either way: a dashpot and one with its square, and no third.
    assert d.verdict == "ambiguous"
    assert sorted(d.ambiguous_with) == [["quad_damping"], ["viscous"]]


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
def test_friction_with_a_peak_on_a_shearing_contact_is_named_beside_a_mass(tmp_path):
    def law(t, x, v, a):
        shear = np.zeros_like(x)
        for i in range(1, x.size):
            shear[i] = np.clip(shear[i - 1] + (x[i] - x[i - 1]) / 4e-6, -1.0, 1.0)
        return shear * (250.0 + 200.0 * np.exp(-((v / 0.01) ** 2))) + 12.0 * a

    d = diagnosed(tmp_path, cases.channels(law))
    assert (d.verdict, sorted(d.effects)) == ("explained", ["inertia", "stribeck"])


@pytest.mark.long
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


@pytest.mark.long
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
        core.CoreElement(config_of).run(d.context.x + gap * (2.0 * start - 1.0)),
        beta[0] * member.effect.columns(d.context, member.trial)[0],
        atol=1e-6 * 16.5e3,
    )


@pytest.mark.long
def test_a_brake_that_grips_alike_behind_a_play_has_no_bias(tmp_path):
    columns = of_a_brake(2, 9e-3, up=16e3, down=16e3)
    d = diagnosed(tmp_path, columns, naive(columns, 150.0))
    assert sorted(d.effects) == ["coulomb", "gap"]


@pytest.mark.long
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


@pytest.mark.long
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


def _in_mid_motion(folder, u, before: int, xy: float):
    """Diagnose a yielding specimen whose recording begins in motion.

    Returns:
        The answer, and by how much the force would be another one if the spring had no history.
    """
    alpha = 0.35
    rng = np.random.default_rng(8)
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
    straight = np.concatenate((np.linspace(0.0, x[before], 100), x[rows]))
    fresh = (1.0 - alpha) * cases.K * (_yielding(straight, xy)[100:] - _yielding(x, xy)[rows])
    return diagnosed(folder, columns, model), fresh


@pytest.mark.long
def test_a_yielding_specimen_recorded_in_mid_motion_lacks_nothing(tmp_path):
    u = cases.command("sine", 11.3)
    d, fresh = _in_mid_motion(tmp_path, u, 5 * int(cases.FS), xy=6e-3)
    assert d.verdict == "none"
    # Where it is judged, it no longer matters whether the spring had a history.
    assert np.max(np.abs(fresh)) > 20.0 * cases.F_STD
    judged = d.estimate.rows
    assert judged.sum() > 0.5 * judged.size
    assert np.max(np.abs(fresh[judged])) < cases.F_STD


@pytest.mark.long
def test_a_specimen_that_hardly_yields_and_keeps_its_history_lacks_nothing(tmp_path):
    u = cases.command("sine", 11.3)
    d, fresh = _in_mid_motion(tmp_path, u, 5 * int(cases.FS), xy=16e-3)
    judged = d.estimate.rows
    assert judged.sum() > 0.9 * judged.size
    assert np.sqrt(np.mean(fresh[judged] ** 2)) > cases.F_STD
    assert d.verdict == "none"
