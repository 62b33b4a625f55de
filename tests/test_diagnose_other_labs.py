"""Recordings of labs whose noise, formulas and wiring differ from ours."""

from __future__ import annotations

from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from scipy import signal

from rthyb_rt.diagnose import engine, reading
from rthyb_rt.diagnose.effects.sensor import standing_out
from rthyb_rt.diagnose.outcome import finish
from rthyb_rt.diagnose.predict import nrmse


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
