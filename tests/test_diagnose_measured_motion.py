"""Specimens on a displacement transducer and a load cell alone: the motion is what they show."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from rthyb_rt.diagnose import engine, found_model, reading, remainder, spectral
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.outcome import DiagnosisResult

Floats = NDArray[np.float64]
Law = Callable[[Floats, Floats, float], Floats]
"""Force of a specimen from t, x in fine steps, and their length."""

K, PEAK_M, FINELY = 8e5, 0.01, 16


def motion(fs_hz: float, kind: str, seconds: float = 20.0) -> tuple[Floats, Floats]:
    """Time and displacement in fine steps, from rest to rest."""
    t = np.arange(round(seconds * fs_hz) * FINELY) / (fs_hz * FINELY)
    rest = np.clip(np.minimum(t, t[-1] - t) / 0.8, 0.0, 1.0)
    if kind == "sweep":
        x = np.sin(2 * np.pi * (0.3 * t + 0.5 * 3.2 / seconds * t**2)) * (0.2 + 0.8 * t / seconds)
    else:
        rng = np.random.default_rng(8)
        lines, phases = rng.uniform(0.2, 3.0, 20), rng.uniform(0.0, 2 * np.pi, 20)
        x = np.sum(np.sin(2 * np.pi * lines[:, None] * t + phases[:, None]), axis=0)
    x = x * rest**2 * (3.0 - 2.0 * rest)
    return t, PEAK_M * x / np.max(np.abs(x))


def diagnosed(
    folder: Path,
    law: Law,
    fs_hz: float,
    kind: str = "random",
    noise: tuple[float, float] = (1e-6, 4.0),
) -> DiagnosisResult:
    t, x = motion(fs_hz, kind)
    f = law(t, x, float(t[1]))[::FINELY]
    rng = np.random.default_rng(5)
    columns = {
        "t": t[::FINELY],
        "x_meas": x[::FINELY] + noise[0] * rng.standard_normal(f.size),
        "f_meas": f + noise[1] * rng.standard_normal(f.size),
    }
    model = (
        f'schema = "rthyb-baseline/1"\nfamily = "drive"\nfs_hz = {fs_hz}\n[specimen]\nk = {K}\n'
        f"c = 0\nmoving_mass = 0\nk_tol = 0.02\n[noise]\nx_std = {noise[0]}\nf_std = {noise[1]}\n"
    )
    recording, toml = cases.write(folder, columns, model)
    return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


def slider(x: Floats, stick_n_per_m: float, slip_n: float) -> Floats:
    """Elastic, perfectly plastic."""
    out, f = np.zeros(x.size), 0.0
    for i, step in enumerate(np.diff(x, prepend=x[0])):
        f = out[i] = min(max(f + stick_n_per_m * step, -slip_n), slip_n)
    return out


def test_a_fluid_damper_that_is_steep_at_each_reversal_is_named(tmp_path: Path) -> None:
    """There the noise of the displacement is louder in the force than the load cell's."""

    def law(t: Floats, x: Floats, h: float) -> Floats:
        v = np.gradient(x, h)
        return K * x + 1500.0 * np.sign(v) * np.abs(v / 0.1) ** 0.3

    d = diagnosed(tmp_path, law, 256.0, noise=(4e-6, 8.0))
    assert (d.verdict, d.effects) == ("explained", ["power_damping"])
    assert d.candidates[0].params["exponent"] == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("kind", ["sweep", pytest.param("random", marks=pytest.mark.long)])
def test_a_dashpot_is_no_relaxation_in_an_early_load_cell(tmp_path: Path, kind: str) -> None:
    """Both filter the noise of the velocity, and so might be likelier."""
    d = diagnosed(tmp_path, lambda t, x, h: K * x + 7e3 * np.gradient(x, h), 64.0, kind)
    assert (d.verdict, d.effects) == ("explained", ["viscous"])
    assert d.candidates[0].params["c_Ns_m"] == pytest.approx(7e3, rel=0.02)


def test_a_relaxation_within_two_rows_is_none_the_less_one(tmp_path: Path) -> None:
    km, tau = 1e6, 9e-3

    def law(t: Floats, x: Floats, h: float) -> Floats:
        system = signal.TransferFunction([km * tau, 0.0], [tau, 1.0])
        return np.asarray(K * x + signal.lsim(system, x, t)[1])

    d = diagnosed(tmp_path, law, 200.0, "sweep")
    assert (d.verdict, d.effects) == ("explained", ["maxwell"])
    assert d.candidates[0].params["tau_s"] == pytest.approx(tau, rel=0.05)


@pytest.mark.parametrize("after", [0.4, pytest.param(0.0, marks=pytest.mark.long)])
def test_a_wall_that_rocks_softens_without_a_loop(tmp_path: Path, after: float) -> None:
    uplift = 3e-3

    def law(t: Floats, x: Floats, h: float) -> Floats:
        held = np.clip(x, -uplift, uplift)
        return K * (held + after * (x - held))

    d = diagnosed(tmp_path, law, 128.0)
    assert (d.verdict, d.effects) == ("explained", ["cubic"])
    model = found_model.augmented(d)
    (rocks,) = [e for e in model.elements()[0] if e.kind == "rocking"]
    assert rocks.params[1] == pytest.approx(uplift, rel=0.02)
    assert rocks.params[0] == pytest.approx((1.0 - after) * K, rel=0.03)


@pytest.mark.parametrize("kind", ["sweep", pytest.param("random", marks=pytest.mark.long)])
def test_two_sliders_beside_a_spring_are_yielding_and_nothing_else(
    tmp_path: Path, kind: str
) -> None:
    def law(t: Floats, x: Floats, h: float) -> Floats:
        first = slider(x, 0.5 * K, 0.5 * K * 2.5e-3)
        return 0.2 * K * x + first + slider(x, 0.3 * K, 0.3 * K * 5e-3)

    d = diagnosed(tmp_path, law, 64.0, kind)
    assert (d.verdict, d.effects) == ("explained", ["hysteresis"])
    assert d.fit["nrmse_after"] < 0.01


@pytest.mark.parametrize("rough", [0.0, 1.0 / 12.0])
def test_what_is_left_beside_a_steep_law_is_not_credited_to_its_noise(
    tmp_path: Path, rough: float
) -> None:
    """A rough plate, whose friction depends on the place: no law of the catalogue has that."""
    friction_n = 1500.0

    def law(t: Floats, x: Floats, h: float) -> Floats:
        steep = np.tanh(np.gradient(x, h) / 1e-4)
        return K * x + friction_n * (steep + rough * np.sin(2.0 * np.pi * 5.0 * x / PEAK_M))

    d = diagnosed(tmp_path, law, 256.0, noise=(2e-6, 8.0))
    assert d.effects == ["coulomb"]
    assert d.force is not None
    left = remainder.left_of(d.force)
    assert left.loud
    assert left.of_force == pytest.approx(0.5 * rough**2, rel=0.4, abs=5e-4)


@pytest.mark.parametrize(("f_hz", "fs_hz", "seconds"), [(0.02, 100.0, 200.0), (1.0, 256.0, 20.0)])
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_velocity_of_a_transducer_is_known_in_slow_and_in_fast_tests(
    f_hz: float, fs_hz: float, seconds: float, moves: bool, seed: int
) -> None:
    """From rest, or recorded from the middle of a motion on: of a sine, whose velocity is known."""
    t = np.arange(round(seconds * fs_hz)) / fs_hz
    rise = np.ones(t.size) if moves else np.sin(np.pi * t / seconds) ** 2
    turn = 2.0 * np.pi * f_hz
    x = PEAK_M * rise * np.sin(turn * t + 0.7)
    v = PEAK_M * turn * np.cos(turn * t + 0.7) * rise
    if not moves:
        slope = np.pi / seconds * np.sin(2.0 * np.pi * t / seconds)
        v += PEAK_M * slope * np.sin(turn * t + 0.7)
    rng, sigma = np.random.default_rng(seed), 1e-3 * PEAK_M
    model = Model(family="drive", fs_hz=fs_hz, k=K, c=0.0, mass=0.0, x_std=sigma)
    measured = {"x_meas": x + sigma * rng.standard_normal(t.size)}
    case = Case("sine", model, t, measured, np.ones(t.size, bool))
    found, _, _ = spectral.smoothed(case, [])
    middle = slice(t.size // 4, -t.size // 4)
    assert np.std((found.v - v)[middle]) < 0.02 * np.std(v[middle])
