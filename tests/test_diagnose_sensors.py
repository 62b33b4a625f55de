"""The colour of the noise of a motion's sensors, read where no other channel sees it move."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_diagnose_colour import coloured, pink
from test_diagnose_noise import DRIVE, F_STD, FS_HZ, X_STD, C, K, M, motion

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import estimate, reading, whitening
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


def ripple(cell_n: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a displacement with a drive's ripple up to 40 Hz, a force, and the sensor's spectrum.

    The spectrum is relative to white noise of 0.6 um.
    """
    f = np.fft.rfftfreq(T.size, 1 / FS)
    x = swing() + 2e-4 * noise(np.where((f > 3) & (f < 40), np.maximum(f, 3.0) ** -2.5, 0.0), 4)
    falling = 1 / np.sqrt(1 + (f / 80) ** 2)
    force = 1e6 * x + cell_n * noise(lines(0.0), 3)
    return x + 1e-6 * noise(falling, 1), force, falling**2 / np.mean(falling**2) / 0.6**2


def test_motion_that_a_noisy_load_cell_does_not_show_leaves_the_noise_above_it_as_measured() -> (
    None
):
    x, force, spectrum = ripple(40.0)
    found = sensor_colour(x, [force], FS, 6e-7, 1e-6)
    assert found is not None
    at = np.array([60.0, 120.0, 250.0])
    exact = np.interp(at, np.fft.rfftfreq(T.size, 1 / FS), spectrum)
    assert_allclose(found.at(at), exact, rtol=0.6)


def test_no_noise_is_assumed_below_that_a_clear_load_cell_rules_out() -> None:
    """The ripple rises steeply towards low frequency; the load cell shows that it is motion."""
    x, force, spectrum = ripple(0.4)
    found = sensor_colour(x, [force], FS, 6e-7, 1e-6)
    assert found is not None
    at = np.array([5.0, 10.0, 20.0, 30.0, 60.0, 120.0])
    exact = np.interp(at, np.fft.rfftfreq(T.size, 1 / FS), spectrum)
    assert_allclose(found.at(at), exact, rtol=0.3)


def test_a_burst_that_only_one_sensor_shows_is_no_spectrum_of_its_noise() -> None:
    x, a, force = records(noise(lines(1.0), 1), noise(lines(0.0), 2))
    burst = 1e-5 * np.exp(-(((T - 7.0) / 0.4) ** 2)) * np.sin(2 * np.pi * 11.0 * T)
    assert sensor_colour(x, [a, force], FS, 1e-7, 1e-7) is not None
    assert sensor_colour(x + burst, [a, force], FS, 1e-7, 1e-7) is None


@pytest.mark.parametrize("understated", [1.0, 1.8])
def test_a_spectrum_is_within_the_data_sheet_and_as_measured_where_it_is_low(
    understated: float,
) -> None:
    x, a, force = records(noise(lines(1.0), 1), noise(lines(0.0), 2))
    found = sensor_colour(x, [a, force], FS, 1e-7, 1e-7 / understated)
    f = np.fft.rfftfreq(T.size, 1 / FS)
    assert found is not None
    assert np.mean(found.at(f)) <= 1.1 * (1.2 / understated) ** 2
    at = np.array([120.0, 250.0])
    assert_allclose(found.at(at), at**-1.0 / np.mean(np.maximum(f, 0.1) ** -1.0), rtol=0.3)


def test_an_error_of_the_motion_weighs_with_all_that_a_set_adds_to_the_model() -> None:
    """The power is that of the whole impedance, whichever part the model states; well above its
    antiresonance at 5 Hz, where lines are too wide to show it."""
    rng = np.random.default_rng(7)
    omega = 2 * np.pi * np.fft.rfftfreq(T.size, 1 / FS)
    white = np.fft.rfft(rng.standard_normal(T.size)) * np.exp(-((omega / 600.0) ** 2))
    error = [np.fft.irfft(white * (1j * omega) ** i, T.size) for i in range(3)]

    def power(k: float, c: float, kg: float) -> np.ndarray:
        return np.asarray(np.abs(k - kg * omega**2 + 1j * c * omega) ** 2 * 1e-12)

    def force(k: float, c: float, kg: float) -> np.ndarray:
        return np.asarray(k * error[0] + c * error[1] + kg * error[2])

    ones = np.ones(omega.size)
    stated = whitening.Blur(
        power(4e5, 1e3, 200.0), 0.0, ones, ones, 5.0, omega, ComputedMotion(*error),
        force(4e5, 1e3, 200.0),
    )  # fmt: skip
    (more,) = stated.behind([force(6e4, -300.0, 230.0)], FS)
    band = (omega > 2 * np.pi * 12.0) & (omega < 2 * np.pi * 150.0)
    whole = np.asarray(more.power + more.more)
    assert_allclose(whole[band], power(4.6e5, 700.0, 430.0)[band], rtol=0.2)
    # Nothing added, what no noise would show, and laws that diverge.
    diverged = (np.full(T.size, np.nan), np.full(T.size, np.inf), 1e300 * rng.random(T.size))
    for change in (np.zeros(T.size), force(4.0, 0.0, 1e-9), *diverged):
        assert stated.behind([change], FS)[0] is stated


def test_the_frequencies_at_which_sets_are_compared_do_not_depend_on_a_bodys_accuracy() -> None:
    """Near resonance the model is accurate to 50 N, the cell to 5 N: no set adds to either."""
    ones = np.ones(4)
    still = ComputedMotion(*np.zeros((3, 4)))
    blur = whitening.Blur(0.0 * ones + 2475.0, 2475.0, ones, 0.1 * ones, 5.0, ones, still, ones)
    assert_allclose(whitening._in_one_band([blur, blur])[0].band, ones)


def test_a_gap_in_a_displacement_is_no_event_of_its_noise() -> None:
    x, a, force = records(noise(lines(1.0), 1), noise(lines(0.0), 2))
    known = np.ones(T.size, dtype=bool)
    known[6000:6040] = False
    gap = np.interp(T, T[known], x[known])
    found = sensor_colour(gap, [a, force], FS, 1e-7, 1e-7, known)
    assert found is not None
    at = np.array([60.0, 120.0, 250.0])
    shape = np.maximum(np.fft.rfftfreq(T.size, 1 / FS), 0.1) ** -1.0
    assert_allclose(found.at(at), at**-1.0 / np.mean(shape), rtol=0.6)


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
