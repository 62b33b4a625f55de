"""The colour of the noise of a motion's sensors, read where no other channel sees it move."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_diagnose_colour import coloured, pink
from test_diagnose_noise import DRIVE, F_STD, FS_HZ, X_STD, C, K, M, motion

from rthyb_rt.diagnose import estimate, reading
from rthyb_rt.diagnose.moving import sensor_colour

FS = 1000.0
T = np.arange(12000) / FS
AT_HZ = np.array([8.0, 15.0, 30.0, 60.0, 120.0, 250.0])


def swing() -> np.ndarray:
    """Return random motion up to 5 Hz, a hundred thousand times the noise of its sensor."""
    rng = np.random.default_rng(5)
    f = np.fft.rfftfreq(T.size, 1 / FS)
    spectrum = (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)) * (f < 5) * (f > 0)
    x = np.fft.irfft(spectrum, T.size)
    return np.asarray(0.01 * x / np.max(np.abs(x)))


def noise(shape: np.ndarray, seed: int) -> np.ndarray:
    """Return noise of unit expected rms; of its spectrum this is the amplitude, (lines,)."""
    rng = np.random.default_rng(seed)
    y = np.fft.irfft(shape * np.fft.rfft(rng.standard_normal(T.size)), T.size)
    return np.asarray(y / np.sqrt(np.mean(shape**2)))


def lines(power: float) -> np.ndarray:
    f = np.maximum(np.fft.rfftfreq(T.size, 1 / FS), 0.1)
    return np.asarray(f ** (-0.5 * power))


def records(x_noise: np.ndarray, a_noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return displacement, acceleration and a force on the stroke that all show one motion."""
    x = swing()
    w = 2 * np.pi * np.fft.rfftfreq(T.size, 1 / FS)
    a = np.fft.irfft(-(w**2) * np.fft.rfft(x), T.size)
    force = 1e6 * x + 2e3 * np.gradient(x) * FS + 0.1 * noise(lines(0.0), 3)
    return x + 1e-7 * x_noise, a + 3e-4 * a_noise, force


@pytest.mark.parametrize("power", [0.7, 1.0, 1.6])
def test_slow_noise_of_a_displacement_sensor_is_told_from_what_it_measures(power: float) -> None:
    x, a, force = records(noise(lines(power), 1), noise(lines(0.0), 2))
    found = sensor_colour(x, [a, force], FS, 1e-7, 1e-7)
    f = np.fft.rfftfreq(T.size, 1 / FS)
    shape = np.maximum(f, 0.1) ** -power
    exact = np.maximum(AT_HZ, 0.1) ** -power / np.mean(shape)
    assert found is not None
    assert_allclose(found.at(AT_HZ), exact, rtol=0.6)
    # White noise would be out by this much.
    assert max(exact[0], 1 / exact[-1]) > 2.5


def test_white_noise_beside_a_large_motion_is_white() -> None:
    """What a window shows beside a motion so large is no slow noise."""
    x, a, force = records(noise(lines(0.0), 1), noise(lines(0.0), 2))
    assert sensor_colour(x, [a, force], FS, 1e-7, 1e-7) is None
    assert sensor_colour(a, [x, force], FS, 3e-4, 3e-4) is None


def test_a_hum_of_the_accelerometers_amplifier_does_not_pass_for_motion() -> None:
    f = np.fft.rfftfreq(T.size, 1 / FS)
    hump = 0.5 + 1 / np.sqrt((1 - (f / 70) ** 2) ** 2 + (0.5 * f / 70) ** 2)
    x, a, force = records(noise(lines(0.0), 1), noise(hump, 2))
    found = sensor_colour(a, [x, force], FS, 3e-4, 3e-4)
    assert found is not None
    at = np.array([20.0, 70.0, 200.0])
    exact = np.interp(at, f, hump**2) / np.mean(hump**2)
    assert_allclose(found.at(at), exact, rtol=0.6)


def test_nothing_is_said_of_one_channel_alone_or_without_a_data_sheet() -> None:
    x, a, _ = records(noise(lines(1.0), 1), noise(lines(0.0), 2))
    assert sensor_colour(x, [], FS, 1e-7, 1e-7) is None
    assert sensor_colour(x, [a], FS, 1e-7, None) is None
    assert sensor_colour(x[:200], [a[:200]], FS, 1e-7, 1e-7) is None


@pytest.mark.parametrize("shape", [pink(), np.ones_like(pink())], ids=["pink", "white"])
def test_the_force_along_an_estimated_motion_is_as_sure_as_is_said(
    shape: np.ndarray, tmp_path: Path
) -> None:
    """No actuator is stated: the motion is what the sensors say. The model is right."""
    random = np.random.default_rng(1)
    t, u, x, v, a = motion(FS_HZ)
    columns = {
        "t": t,
        "x_cmd": u,
        "x_meas": x + 3.0 * X_STD * coloured(random, shape, t.size, FS_HZ),
        "f_meas": K * x + C * v + M * a + F_STD * random.standard_normal(t.size),
    }
    table = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header=",".join(columns), comments="")
    specimen, sheets = DRIVE.split("[actuator]")[0], DRIVE.split("[noise]")[1]
    louder = sheets.replace(f"x_std = {X_STD}", f"x_std = {3.0 * X_STD}")
    (tmp_path / "b.toml").write_text(f"{specimen}[noise]{louder}", encoding="utf-8")
    case = reading.read_case(tmp_path / "r.csv", reading.read_model(tmp_path / "b.toml"))
    found = estimate.from_sensors(case)
    assert found is not None
    force = case.model.force(found.motion.x, found.motion.v, found.motion.a)
    left = found.whiten(found.force - force)[found.rows]
    # With the displacement's noise taken for white, 1.37 where it is pink.
    assert float(np.mean(left**2)) / found.share == pytest.approx(1.0, abs=0.15)
