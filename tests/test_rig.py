"""The virtual rig: what its sensors add, what its load cell sees, and that a seed repeats it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.stats
from kernels import HYDRAULIC, K_PLATE, Floats, H, rms, smooth_motion

from rthyb_rt import core

PLATE = core.element("stiffness", k_n_per_m=K_PLATE)
DIRECT = core.ServoConfig("pure-delay")


def rig(**settings: Any) -> core.VirtualRig:
    return core.VirtualRig(core.RigConfig(**({"servo": DIRECT, "elements": (PLATE,)} | settings)))


def noisy(seed: int = 0) -> core.VirtualRig:
    return rig(
        displacement=core.SensorConfig(noise_std=2e-6),
        force=core.SensorConfig(noise_std=20.0),
        seed=seed,
    )


def test_sensor_noise_is_white_and_normal_with_its_standard_deviation() -> None:
    x, f = noisy().run(np.zeros(100_000))
    for signal, std in ((x, 2e-6), (f, 20.0)):
        scaled = signal / std
        assert np.std(scaled) == pytest.approx(1.0, abs=0.01)
        assert np.mean(scaled) == pytest.approx(0.0, abs=0.015)
        assert scipy.stats.kstest(scaled, "norm").pvalue > 1e-3
        spectrum = np.abs(np.fft.rfft(scaled))[1:-1] ** 2 / scaled.size
        assert scipy.stats.kstest(spectrum, "expon").pvalue > 1e-3
    assert abs(np.corrcoef(x, f)[0, 1]) < 0.015


def test_same_seed_repeats_the_test_to_the_bit_and_another_does_not() -> None:
    command = smooth_motion(1.0, 1)
    first, again, other = (noisy(seed).run(command) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.all(first[0] != other[0])
    assert abs(np.corrcoef(first[0] - command, other[0] - command)[0, 1]) < 0.15


def test_neighbouring_seeds_start_differently() -> None:
    starts = [noisy(seed).step(0.0)[0] for seed in range(200)]
    assert len(set(starts)) == 200
    assert scipy.stats.kstest(np.array(starts) / 2e-6, "norm").pvalue > 1e-3


def test_quantisation_leaves_whole_steps_no_farther_than_half_a_step() -> None:
    command = smooth_motion(2.0, 2)
    lsb = 5e-7
    x, f = rig(displacement=core.SensorConfig(lsb=lsb), force=core.SensorConfig(lsb=0.25)).run(
        command
    )
    np.testing.assert_allclose(x / lsb, np.round(x / lsb), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(f / 0.25, np.round(f / 0.25))
    assert np.max(np.abs(x - command)) <= 0.5 * lsb * (1 + 1e-9)
    assert np.max(np.abs(f - K_PLATE * command)) <= 0.125 * (1 + 1e-9)


def test_sensor_saturates_at_both_ends_of_its_range() -> None:
    command = smooth_motion(2.0, 3, peak_m=0.01)
    x, f = rig(
        displacement=core.SensorConfig(range=0.004), force=core.SensorConfig(range=2000.0)
    ).run(command)
    np.testing.assert_array_equal(x, np.clip(command, -0.004, 0.004))
    np.testing.assert_allclose(f, np.clip(K_PLATE * command, -2000.0, 2000.0), rtol=1e-15)


def test_bias_is_added_before_the_range_ends() -> None:
    kernel = rig(displacement=core.SensorConfig(bias=5e-5, range=0.001))
    assert kernel.step(0.0005)[0] == pytest.approx(0.00055, rel=1e-12)
    assert kernel.step(0.00098)[0] == 0.001
    assert kernel.true_displacement_m == 0.00098


def test_noise_does_not_reach_the_specimen() -> None:
    command = smooth_motion(1.0, 4)
    _, f = rig(displacement=core.SensorConfig(noise_std=1e-4)).run(command)
    np.testing.assert_array_equal(f, K_PLATE * command)


def table_force(x: Floats) -> Floats:
    """What accelerates, rubs and damps the table between two samples."""
    v = np.gradient(x, H)
    friction = HYDRAULIC["friction_n"] * np.tanh(v / HYDRAULIC["friction_width_m_per_s"])
    mass, viscous = HYDRAULIC["moving_mass_kg"], HYDRAULIC["viscous_n_s_per_m"]
    return np.asarray(mass * np.gradient(v, H) + friction + viscous * v)


def test_load_cell_at_the_actuator_also_sees_the_table() -> None:
    command = smooth_motion(4.0, 5, peak_m=0.004)
    servo = core.ServoConfig(**HYDRAULIC, hold="foh")
    x, at_actuator = rig(servo=servo).run(command)
    _, at_specimen = rig(servo=servo, load_cell="specimen").run(command)
    np.testing.assert_allclose(at_specimen, K_PLATE * x, rtol=0, atol=1e-6)
    seen = (at_actuator - at_specimen)[10:-10]
    assert rms(seen) > 50.0
    assert rms(seen - table_force(x)[10:-10]) < 0.1 * rms(seen)


def test_reading_the_load_cell_does_not_age_the_specimen() -> None:
    command = smooth_motion(2.0, 9, peak_m=0.004)
    servo = core.ServoConfig(**HYDRAULIC)
    specimen = (PLATE, core.element("maxwell", km_n_per_m=2e6, tau_s=0.02))
    runs = [
        rig(servo=servo, elements=specimen, load_cell=end).run(command)[0]
        for end in ("actuator-end", "specimen")
    ]
    assert rms(runs[1] - runs[0]) < 1e-3 * rms(runs[0])


@pytest.mark.parametrize("load_cell", ["actuator-end", "specimen"])
@pytest.mark.parametrize("kind", ["pure-delay", "first-order", "second-order"])
def test_other_actuators_have_no_table_to_see(kind: str, load_cell: str) -> None:
    servo = core.ServoConfig(
        kind,  # type: ignore[arg-type]
        roll_off_hz=9.0,
        natural_frequency_hz=25.0,
        damping_ratio=0.8,
    )
    x, f = rig(servo=servo, load_cell=load_cell).run(smooth_motion(1.0, 6))
    np.testing.assert_allclose(f, K_PLATE * x, rtol=1e-14)


@pytest.mark.parametrize("kind", ["pure-delay", "first-order", "second-order"])
def test_specimen_feels_the_actuators_velocity_and_acceleration(kind: str) -> None:
    servo = core.ServoConfig(
        kind,  # type: ignore[arg-type]
        hold="foh",
        roll_off_hz=9.0,
        natural_frequency_hz=25.0,
        damping_ratio=0.8,
    )
    command = smooth_motion(2.0, 7)
    for element, derivative in (
        (core.element("viscous", c_n_s_per_m=1.0), 1),
        (core.element("inertia", m_kg=1.0), 2),
    ):
        x, f = rig(servo=servo, elements=(element,)).run(command)
        expected = x
        for _ in range(derivative):
            expected = np.gradient(expected, H)
        middle = slice(20, -20)
        assert rms(f[middle] - expected[middle]) < 0.06 * rms(expected[middle])


def test_step_by_step_is_the_same_as_the_whole_run() -> None:
    command = smooth_motion(0.2, 8)
    x, f = noisy(3).run(command)
    kernel = noisy(3)
    steps = [kernel.step(value) for value in command]
    assert {code for _, _, code in steps} == {0}
    np.testing.assert_array_equal([s[0] for s in steps], x)
    np.testing.assert_array_equal([s[1] for s in steps], f)


@pytest.mark.parametrize("name", ["noise_std", "lsb", "range"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("sensor", ["displacement", "force"])
def test_sensor_setting_out_of_range_is_refused(sensor: str, name: str, value: float) -> None:
    with pytest.raises(core.CoreError, match="sensor"):
        rig(**{sensor: core.SensorConfig(**{name: value})})


@pytest.mark.parametrize("bias", [np.nan, np.inf, 1e300])
def test_senseless_bias_is_refused(bias: float) -> None:
    with pytest.raises(core.CoreError, match="sensor"):
        rig(displacement=core.SensorConfig(bias=bias))


def test_specimen_takes_sixteen_elements_and_not_one_more() -> None:
    _, f = rig(elements=(PLATE,) * 16).run([0.001])
    assert f[0] == pytest.approx(16 * K_PLATE * 0.001)
    with pytest.raises(core.CoreError, match="16"):
        rig(elements=(PLATE,) * 17)


def test_rig_with_a_broken_element_is_refused() -> None:
    with pytest.raises(core.CoreError, match="element"):
        rig(elements=(core.ElementConfig("coulomb", (80.0, 0.0)),))
