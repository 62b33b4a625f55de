"""Recordings of labs whose noise, formulas and wiring differ from ours."""

from __future__ import annotations

from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from scipy import signal

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import effects, engine, reading
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.effects.sensor import standing_out
from rthyb_rt.diagnose.estimate import _around_corners
from rthyb_rt.diagnose.outcome import finish
from rthyb_rt.diagnose.predict import nrmse
from rthyb_rt.errors import InputError


def diagnosed(folder: Path, columns: dict[str, np.ndarray], model: str | None = None):
    recording, toml = cases.write(folder, columns, model)
    return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


def coloured(n: int, corner_hz: float, seed: int) -> np.ndarray:
    """Return noise of unit standard deviation behind a first-order low-pass, (n,)."""
    pole = np.exp(-2 * np.pi * corner_hz / cases.FS)
    noise = signal.lfilter([1.0], [1.0, -pole], np.random.default_rng(seed).standard_normal(n))
    return noise / np.std(noise)


def test_noise_of_an_amplifier_with_a_low_pass_is_no_finding_within_the_data_sheet(tmp_path):
    columns = cases.channels()
    x, v, a = cases.moved(columns["x_cmd"])
    noise = 1.1 * cases.F_STD * coloured(x.size, 80.0, 4)
    columns["f_meas"] = cases.K * 1.004 * x + cases.C * 0.95 * v + cases.M * a + noise
    d = diagnosed(tmp_path, columns)
    assert (d.verdict, d.effects) == ("none", [])


def test_a_knock_is_no_noise_though_the_data_sheet_would_cover_its_mean(tmp_path):
    def knock(t, x, v, a):
        u = (t - 3.1) / 0.06
        return 5.0 * cases.F_STD * np.exp(-(u**2)) * np.sin(2 * np.pi * 9.0 * (t - 3.0))

    columns = cases.channels(knock)
    # One event in eight seconds: the rms of all that is left stays within a fifth of the noise.
    rest = knock(columns["t"], 0, 0, 0)
    assert np.hypot(cases.F_STD, np.sqrt(np.mean(rest**2))) < 1.2 * cases.F_STD
    assert diagnosed(tmp_path, columns).verdict != "explained"


@pytest.mark.long
def test_friction_rounded_by_a_root_is_dry_friction_beside_damping(tmp_path):
    d = diagnosed(
        tmp_path,
        cases.channels(
            lambda t, x, v, a: 600.0 * v / np.hypot(v, 3e-3) - 5.0e4 * v * np.abs(v), seed=5
        ),
    )
    assert (d.verdict, sorted(d.effects)) == ("explained", ["coulomb", "quad_damping"])
    size = next(c for c in d.candidates if c.name == "coulomb").params["Fc_N"]
    assert size == pytest.approx(600.0, rel=0.03)


def test_a_force_is_timed_where_it_stands_out_of_noise_and_not_by_the_noise_it_carries():
    t = np.arange(8192) / cases.FS
    force = 1000.0 * np.sin(2 * np.pi * 1.7 * t) + 3.0 * np.sin(2 * np.pi * 6.0 * t + 1.0)
    fed_back = 0.05 * np.random.default_rng(2).standard_normal(t.size)
    clean = standing_out(force + fed_back, 25.0, 1.0 / cases.FS)
    inner = slice(512, -512)
    assert np.max(np.abs(clean - force)[inner]) < 0.1
    rest = (clean - force)[inner] - np.mean((clean - force)[inner])
    assert np.corrcoef(np.diff(rest), np.diff(fed_back[inner]))[0, 1] < 0.1
    # Nothing stands out: the force is left as it is.
    assert standing_out(fed_back, 25.0, 1.0 / cases.FS) is fed_back


MASS = 6000.0


def on_moving_ground(seed: int, seconds: float = 10.0) -> dict[str, np.ndarray]:
    """Return a recording of a body on moving ground; its load cell feels the other direction."""
    rng = np.random.default_rng(seed)
    n = int(seconds * cases.FS)
    t = np.arange(n) / cases.FS
    noise = signal.sosfiltfilt(
        signal.butter(2, [0.5, 4.0], "bandpass", fs=cases.FS, output="sos"), rng.standard_normal(n)
    )
    ag = noise / np.std(noise) * 0.15 * np.sin(np.pi * t / t[-1])
    system = signal.StateSpace(
        [[0, 1], [-cases.K / MASS, -cases.C / MASS]], [[0], [-1]], np.eye(2), np.zeros((2, 1))
    )
    _, y, _ = signal.lsim(system, ag, t)
    f = cases.K * y[:, 0] + cases.C * y[:, 1]
    fy = 900.0 * np.sin(2 * np.pi * 1.2 * t + seed)
    return {
        "t": t, "ag": ag,
        "x_meas": y[:, 0] + cases.X_STD * rng.standard_normal(n),
        "f_meas": f + 0.2 * fy + cases.F_STD * rng.standard_normal(n),
        "fy_meas": fy,
    }  # fmt: skip


@pytest.mark.long
def test_what_a_load_cell_feels_of_another_direction_moves_no_body(tmp_path):
    model = cases.baseline(family='"ground"', moving_mass=0.0).replace(
        "[noise]", f"[numerical]\nm = {MASS}\nc = 0.0\n[noise]"
    )
    d = diagnosed(tmp_path, on_moving_ground(1), model)
    assert (d.verdict, d.effects) == ("explained", ["crosstalk"])
    other = on_moving_ground(2)
    inputs = {k: other[k] for k in ("t", "ag", "fy_meas")}
    recording, _ = cases.write(tmp_path / "other", inputs, model)
    outcome = finish(d, None, reading.read_case(recording, d.case.model, judged=False))
    assert outcome.prediction is not None
    assert nrmse(outcome.prediction.x, other["x_meas"]) < 0.01
    noise = cases.F_STD / np.std(other["f_meas"])
    assert nrmse(outcome.prediction.f, other["f_meas"]) < 2.0 * noise


@pytest.mark.parametrize("guess", [1.0, 6.0])
def test_a_first_guess_of_the_stiffness_does_not_decide_what_is_found(guess: float) -> None:
    """Of a specimen that yields, the slope of the first cycle is several times the secant's."""
    t = np.arange(2400) / 100.0
    x = 0.02 * (t / t[-1]) * np.sin(2.0 * np.pi * 0.5 * t)
    rng = np.random.default_rng(5)
    slip = core.element("hysteresis", k_n_per_m=4e6, post_yield_ratio=0.0, a=1.0,
                        b=0.5 / 4e-3, c=0.5 / 4e-3, eta=1.0)  # fmt: skip
    f = 2e5 * x + core.CoreElement(slip).run(x) + 100.0 * rng.standard_normal(t.size)
    line = float(x @ f / (x @ x))
    model = Model("drive", 100.0, guess * line, x_std=1e-6, f_std=100.0)
    channels = {"x_meas": x + 1e-6 * rng.standard_normal(t.size), "f_meas": f}
    d = engine.diagnose(Case("cycles", model, t, channels, np.ones(t.size, dtype=np.bool_)))

    assert (d.verdict, d.effects) == ("explained", ["hysteresis"])
    assert d.case.model.k == pytest.approx(line, rel=0.05)
    # What is left before is that of the line; by the guess it would be four times the force.
    assert d.fit["nrmse_before"] < 0.7
    assert any("no tolerance" in note for note in d.notes) == (guess > 1.0)


def test_a_third_order_servo_valve_is_another_lag_and_no_delay_beside_it(tmp_path: Path) -> None:
    """A pole at 900 Hz delays by .18 ms, of which an exact second-order lag would leave nothing."""
    fs, fine, w = 1024.0, 16, 2.0 * np.pi * 16.0
    t = np.arange(int(8.0 * fs)) / fs
    u = 0.02 * np.sin(2.0 * np.pi * (0.2 * t + 0.8 * t**2))
    slow = signal.TransferFunction([w**2], [1.0, 2.3 * w, w**2])
    pole = 2.0 * np.pi * 900.0
    whole = signal.TransferFunction(np.array([w**2 * pole]), np.polymul(slow.den, [1.0, pole]))
    at = np.arange((t.size - 1) * fine + 1) / (fs * fine)
    x = signal.lsim(whole, np.interp(at - 0.004, t, u, left=0.0), at)[1][::fine]
    columns = {"t": t, "x_cmd": u}
    columns["x_meas"] = x + 1.4e-6 * np.random.default_rng(3).standard_normal(t.size)
    model = "\n".join([
        'schema = "rthyb-baseline/1"', 'family = "drive"', f"fs_hz = {fs}",
        "[specimen]", "k = 6e5", "c = 900.0", "moving_mass = 20.0", "k_tol = 0.02",
        "[actuator]", "delay_s = 0.004", "f_hz = 24.0", "zeta = 0.8",
        "[noise]", "x_std = 1.4e-6", "f_std = 7.0",
    ])  # fmt: skip
    d = diagnosed(tmp_path, columns, model)
    assert (d.verdict, d.effects) == ("explained", ["oil_column"])


def test_rows_beside_a_corner_that_they_do_not_resolve_are_left_out() -> None:
    t, noise = np.arange(1024) / 256.0, 1e-6
    rows = np.random.default_rng(2).standard_normal(t.size)
    wave = 0.01 * signal.sawtooth(2.0 * np.pi * t, 0.5) + noise * rows
    found = _around_corners(wave, noise)
    assert set(np.flatnonzero(found) % 128) == {0, 1, 2, 3, 125, 126, 127}
    for hz in (0.5, 5.0, 30.0, 60.0, 85.0, 120.0):
        sine = 0.01 * np.sin(2.0 * np.pi * hz * t + 0.3) + noise * rows
        assert not _around_corners(sine, noise).any()
    assert not _around_corners(noise * rows, noise).any()


def written(path: Path, dt: float, unit: float = 1.0) -> Path:
    t = np.arange(600) * dt
    x = 1e-3 * np.sin(2.0 * np.pi * t)
    rows = np.column_stack([unit * t, x, 5e5 * x])
    np.savetxt(path, rows, delimiter=",", header="t,x_meas,f_meas", comments="")
    return path


def test_a_second_recording_has_the_rate_of_its_own_time(tmp_path: Path) -> None:
    first, toml = cases.write(tmp_path, cases.channels())
    model = reading.read_model(toml)
    case = reading.read_case(first, model)
    other = reading.read_case(written(tmp_path / "other.csv", 0.01), model, False, beside=case)
    assert other.fs_hz == pytest.approx(100.0)
    assert any("0.01 s apart" in note for note in other.notes)
    # A time in milliseconds, and the first recording's own rate, stay with the model.
    wrong = written(tmp_path / "wrong.csv", 1.0 / cases.FS, 1000.0)
    with pytest.raises(InputError, match="the model says fs_hz"):
        reading.read_case(wrong, model, False, beside=case)
    with pytest.raises(InputError, match="but the model says fs_hz"):
        reading.read_case(written(tmp_path / "first.csv", 0.01), model)


@pytest.mark.parametrize(
    ("exponent", "name"), [(0.94, "viscous"), (1.06, "viscous"), (0.75, "power_damping")]
)
def test_a_damper_whose_exponent_is_nearly_one_is_a_dashpot(exponent, name, tmp_path) -> None:
    def damper(t, x, v, a):
        return 3000.0 * 0.1 ** (1.0 - exponent) * np.abs(v) ** exponent * np.sign(v)

    d = diagnosed(tmp_path, cases.channels(damper), cases.baseline())
    assert (d.verdict, d.effects) == ("explained", [name])


@pytest.mark.parametrize("exponent", [0.93, 1.0, 1.07])
def test_such_a_damper_is_simulated_in_the_form_in_which_it_was_found(exponent: float) -> None:
    x, v, a = cases.moved(cases.command())
    t = np.arange(x.size) / cases.FS
    model = Model("drive", cases.FS, cases.K, cases.C)
    ctx = Context(model, ComputedMotion(x, v, a), t, cases.K * x, {})
    law, trial = effects.catalogue()["viscous"], Trial((exponent,), "nearly")
    found = 800.0 * law.columns(ctx, trial)[0]
    elements = law.elements(ctx, trial, np.array([800.0]))
    made = sum(core.CoreElement(e).run(x, v, a, 1.0 / cases.FS) for e in elements)
    assert np.std(made - found) < 1e-3 * np.std(found)
    # Its parameter is that of the dashpot that does the same work.
    assert v @ found == pytest.approx(800.0 * v @ v)


@pytest.mark.parametrize(("steps", "names"), [(1.2, []), (4.0, ["quantisation"])])
def test_rounding_within_what_a_data_sheet_may_be_wrong_by_is_no_finding(
    steps, names, tmp_path
) -> None:
    columns = cases.channels()
    lsb_n = steps * cases.F_STD
    columns["f_meas"] = lsb_n * np.round(columns["f_meas"] / lsb_n)
    assert diagnosed(tmp_path, columns, cases.baseline()).effects == names
