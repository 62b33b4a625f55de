"""A line in the load cell's signal: its frequency is as exact as the noise allows."""

from __future__ import annotations

from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from diagnose_answers import diagnosed, found, holds
from diagnose_cases import F_STD
from scipy import signal
from test_diagnose_steady import fitted

from rthyb_rt.diagnose import mains, noise


@pytest.mark.parametrize("f_hz", [16.731, 49.93, 60.0355, 101.7])
def test_the_frequency_of_a_hum_is_as_exact_as_its_noise_allows(f_hz: float) -> None:
    """Its bound: Rife and Boorstyn, IEEE Trans. Inf. Theory 20 (1974) 591, for unknown phase."""
    size_n = 300.0
    problem, fit = fitted(lambda t, x, v: size_n * np.sin(2.0 * np.pi * f_hz * t + 0.7), "hum")
    n, length_s = problem.y.size, float(problem.ctx.t[-1])
    bound_hz = np.sqrt(6.0 / n) * F_STD / (np.pi * size_n * length_s)
    assert abs(fit.members[0].trial.theta[0] - f_hz) < 4.0 * bound_hz


def heavy(hum_n: float, f_hz: float) -> tuple[dict[str, np.ndarray], str]:
    """A heavy specimen in slow motion without an accelerometer, and the model of its lab."""
    mass_kg, x_std_m = 200.0, 8e-6
    rng = np.random.default_rng(4)
    n, fine = 2048, 64
    t = np.arange(n * fine) / (cases.FS * fine)
    x = 6e-3 * np.sin(np.pi * t / t[-1]) ** 2 * np.sin(2.0 * np.pi * (0.5 * t + 0.2 * t**2))
    v = np.gradient(x, t)
    a = np.gradient(v, t)
    t, x, v, a = (z[::fine] for z in (t, x, v, a))
    f_meas = cases.K * x + cases.C * v + mass_kg * a + hum_n * np.sin(2.0 * np.pi * f_hz * t)
    columns = {
        "t": t,
        "x_meas": x + x_std_m * rng.standard_normal(x.size),
        "f_meas": f_meas + cases.F_STD * rng.standard_normal(x.size),
    }
    model = cases.baseline(moving_mass=mass_kg).replace(str(cases.X_STD), str(x_std_m))
    first, rest = model.split("[actuator]")
    return columns, first + "[noise]" + rest.split("[noise]")[1]


@pytest.mark.parametrize(("hum_n", "verdict"), [(200.0, "explained"), (0.0, "none")])
def test_a_hum_shows_where_the_motion_of_a_heavy_specimen_is_only_noise(
    hum_n: float, verdict: str, tmp_path: Path
) -> None:
    """At 60 Hz the mass turns the noise of the displacement into 230 N, the hum is 140 N rms."""
    d = diagnosed(tmp_path, *heavy(hum_n, 60.0355))
    assert d.verdict == verdict
    if hum_n:
        assert d.effects == ["hum"]
        assert holds(d, "hum", "amp_N", hum_n)
        assert found(d, "hum", "f_Hz") == pytest.approx(60.0355, abs=0.01)


def test_only_one_steady_sine_is_a_hum_and_no_resonance_or_pump_that_wanders() -> None:
    rng = np.random.default_rng(8)
    n = 4096
    t = np.arange(n) / cases.FS
    motion, white = 5e3 * np.sin(2.0 * np.pi * 2.0 * t), 5.0 * rng.standard_normal(n)
    b, a = signal.iirpeak(60.0, 60.0, fs=cases.FS)
    rings = signal.lfilter(b, a, rng.standard_normal(2 * n))[n:]
    wanders = 60.0 + 0.3 * np.sin(2.0 * np.pi * t / 7.0)
    told = {
        "sine": 60.0355,
        "resonance": None,
        "pump": None,
        "noise": None,
    }
    rests = {
        "sine": 60.0 * np.sin(2.0 * np.pi * 60.0355 * t),
        "resonance": 60.0 * rings / np.std(rings),
        "pump": 60.0 * np.sin(2.0 * np.pi * np.cumsum(wanders) / cases.FS),
        "noise": np.zeros(n),
    }
    for name, rest in rests.items():
        found = mains.hum_hz(rest + white, motion, 1.0 / cases.FS)
        assert found == (told[name] and pytest.approx(told[name], abs=0.005)), name
    assert len(mains.lines_hz(rests["pump"] + white, motion, 1.0 / cases.FS)) > 0


def test_steady_noise_of_a_narrow_band_has_no_bursts_however_long_it_is() -> None:
    """A second of it has few independent values, and the loudest of many is loud by chance."""
    rng = np.random.default_rng(9)
    wide = rng.standard_normal(40_000)
    narrow = signal.sosfiltfilt(signal.butter(4, 0.05, output="sos"), wide)
    knock = np.ones(40_000)
    knock[5000:5256] = 4.0
    assert noise.steady(wide, cases.FS)
    assert noise.steady(narrow, cases.FS)
    assert not noise.steady(knock * wide, cases.FS)
    assert not noise.steady(knock * narrow, cases.FS)


def test_a_line_of_a_force_is_told_by_its_largest_one() -> None:
    """Beside a sine of 1 there is one of 0.05 at three times its frequency, none at seven."""
    t = np.arange(4000) / 200.0
    force = np.sin(2.0 * np.pi * 0.75 * t) + 0.05 * np.sin(2.0 * np.pi * 2.25 * t)
    assert mains.line_at(force, 2.25, 1.0 / 200.0) == pytest.approx(0.05, rel=0.02)
    assert mains.line_at(force, 5.25, 1.0 / 200.0) < 1e-3
    assert mains.line_at(np.zeros(100), 2.0, 0.01) == 0.0
    # A sweep has power there, and no line.
    swept = np.sin(2.0 * np.pi * (0.3 + 0.2 * t) * t)
    assert mains.line_at(swept, 2.25, 1.0 / 200.0) == 0.0


def loops(x: np.ndarray, exponent: float, part: float) -> np.ndarray:
    """Return Bouc-Wen's z / xy for x / xy, with another exponent and form than the tool's."""
    z, out = 0.0, np.empty(x.size)
    for i in range(x.size):
        dx = (x[i] - x[max(i - 1, 0)]) / 8.0
        for _ in range(8):
            z += dx * (1.0 - abs(z) ** exponent * (part + (1.0 - part) * np.sign(dx * z)))
        out[i] = z
    return out


@pytest.mark.long
def test_what_a_loop_of_another_form_lacks_of_a_harmonic_is_no_hum(tmp_path: Path) -> None:
    """Sine cycles of growing amplitude: the loop's third harmonic is as steady as a hum."""
    fs_hz, xy, random = 300.0, 1.2e-3, np.random.default_rng(5)
    t = np.arange(int(32.0 * fs_hz)) / fs_hz
    x = 0.7e-3 * (1.0 + np.floor(t / 8.0)) * np.sin(2.0 * np.pi * 0.75 * t)
    k = 1.4e7
    pink = np.fft.irfft(
        np.fft.rfft(random.standard_normal(t.size)) / np.sqrt(1.0 + np.arange(t.size // 2 + 1))
    )
    f = k * (0.3 * x + 0.7 * xy * loops(x / xy, 1.8, 0.6)) + 190.0 * pink / pink.std()
    columns = {"t": t, "x_meas": x + 7e-7 * random.standard_normal(t.size), "f_meas": f}
    model = cases.baseline(k=k, c=0, moving_mass=0, k_tol=0.02, c_tol=0.15, fs_hz=fs_hz)
    model = model.replace(f"f_std = {cases.F_STD}", "f_std = 220.0")
    model = model.replace(f"x_std = {cases.X_STD}", "x_std = 7.4e-7")
    head, _, tail = model.partition("[actuator]")
    d = diagnosed(tmp_path, columns, head + "[noise]" + tail.partition("[noise]")[2])
    assert d.verdict == "explained"
    assert d.effects == ["hysteresis"]
