"""The servo-valve of the field's benchmark: against scipy's matrix exponential, its published
frequency response and poles, with a yielding specimen, its rig file and its perturbed plants."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from kernels import Floats

from rthyb_rt import config, core
from rthyb_rt.benchmark import plants as benchmark
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time

A1B0, A2, A3, B1, B2, GAIN = 2.1283e13, 4.2297e6, 3.3, 425.0, 9.9976e4, 1.0261
MASS, STIFFNESS = 29.13, 1.19e6
DAMPING = 2.0 * 0.0097 * np.sqrt(STIFFNESS * MASS)


def plant() -> tuple[Floats, Floats]:
    """States q, q', F, x, v of the benchmark, in lengths that make them comparable."""
    a = np.array(
        [
            [0, 1, 0, 0, 0],
            [-B2, -B1, 0, -A1B0, 0],
            [1, 0, -A3, 0, -A2],
            [0, 0, 0, 0, 1],
            [0, 0, 1 / MASS, -STIFFNESS / MASS, -DAMPING / MASS],
        ]
    )
    unit = np.array([A1B0 / B2, A1B0 / np.sqrt(B2), 1e6, 1.0, 300.0])
    return a * unit / unit[:, None], np.array([0.0, A1B0 * GAIN, 0.0, 0.0, 0.0]) / unit


def quiet(**changes: Any) -> core.RigConfig:
    """The shipped rig at 4096 Hz, its sensors and its input perfect."""
    rig = experiment.rig_config(config.load_rig(config.shipped_rig("rths-benchmark")), 4096.0)
    servo = replace(rig.servo, command_range_m=0.0, command_lsb_m=0.0)
    return replace(
        rig, servo=replace(servo, **changes), displacement=core.SensorConfig(),
        force=core.SensorConfig(),
    )  # fmt: skip


@pytest.mark.parametrize("fs_hz", [256.0, 1024.0, 4096.0])
def test_a_held_command_is_answered_exactly(fs_hz: float) -> None:
    a, b = plant()
    augmented = np.zeros((6, 6))
    augmented[:5, :5], augmented[:5, 5] = a, b
    step = scipy.linalg.expm(augmented / fs_hz)
    command = 1e-3 * np.random.default_rng(2).normal(size=8000)
    s, x, f = np.zeros(5), np.zeros(8000), np.zeros(8000)
    for n in range(8000):
        x[n], f[n] = s[3], 1e6 * s[2]
        s = step[:5, :5] @ s + step[:5, 5] * command[n]
    found_x, found_f = core.VirtualRig(quiet(period_s=1.0 / fs_hz)).run(command)
    # c of the rig file has seven digits.
    np.testing.assert_allclose(found_x, x, rtol=0, atol=1e-6 * np.abs(x).max())
    np.testing.assert_allclose(found_f, f, rtol=0, atol=1e-6 * np.abs(f).max())


def test_poles_are_the_published_ones() -> None:
    hz = np.linalg.eigvals(plant()[0]) / (2.0 * np.pi)
    expected = [-7.67, -29.3 + 36.6j, -29.3 - 36.6j, -1.27 + 67.1j, -1.27 - 67.1j]
    for pole in expected:
        assert np.abs(hz - pole).min() < 0.06


@pytest.mark.parametrize(
    ("hz", "gain", "delay_ms"),
    [(1, 0.999, 25.0), (3.6, 0.916, 23.7), (5, 0.851, 22.7), (10, 0.633, 19.0), (16, 0.471, 15.7),
     (38, 0.274, 11.1)],
)  # fmt: skip
def test_frequency_response_is_the_benchmarks(hz: float, gain: float, delay_ms: float) -> None:
    t = np.arange(8 * 4096) / 4096.0
    x, _ = core.VirtualRig(quiet()).run(1e-3 * np.sin(2 * np.pi * hz * t))
    last = slice(-5 * 4096, None)  # whole periods of every one of them
    wave = np.column_stack([np.sin(2 * np.pi * hz * t[last]), np.cos(2 * np.pi * hz * t[last])])
    sine, cosine = np.linalg.lstsq(wave, x[last], rcond=None)[0]
    late_ms = -np.arctan2(cosine, sine) % (2 * np.pi) / (2 * np.pi * hz) * 1e3
    assert np.hypot(sine, cosine) == pytest.approx(gain * 1e-3, abs=6e-7)
    assert late_ms - 0.5e3 / 4096.0 == pytest.approx(delay_ms, abs=0.06)  # a held command's half


def test_a_yielding_specimen_is_the_same_in_finer_substeps() -> None:
    yielding = core.element(
        "hysteresis", k_n_per_m=1.19e6, post_yield_ratio=0.1, a=1.0, b=500.0, c=500.0, eta=1.0
    )
    rest = [
        core.element("viscous", c_n_s_per_m=DAMPING), core.element("inertia", m_kg=MASS), yielding,
    ]  # fmt: skip
    t = np.arange(2 * 4096) / 4096.0
    command = 4e-3 * np.sin(2 * np.pi * 3.0 * t)
    runs = {
        n: core.VirtualRig(replace(quiet(substeps=n), elements=tuple(rest))).run(command)
        for n in (8, 32, 128)
    }
    force = np.abs(runs[128][1]).max()
    assert force < 0.7 * 1.19e6 * np.abs(runs[128][0]).max()  # it yields
    errors = [np.abs(runs[n][1] - runs[128][1]).max() / force for n in (8, 32)]
    assert errors[0] < 0.02
    assert errors[1] < 0.3 * errors[0]


def test_the_drives_input_has_steps_and_an_end() -> None:
    command = np.full(4 * 4096, 0.05)
    x, _ = core.VirtualRig(quiet(command_range_m=0.01)).run(command)
    unlimited, _ = core.VirtualRig(quiet()).run(command)
    assert x[-1] == pytest.approx(0.2 * unlimited[-1], rel=1e-9)
    coarse, _ = core.VirtualRig(quiet(command_lsb_m=0.04)).run(command)
    assert coarse[-1] == pytest.approx(0.8 * unlimited[-1], rel=1e-9)


@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_the_drives_own_loop_is_the_benchmarks_pi_by_tustins_rule(fs_hz: float) -> None:
    """Against scipy's bilinear transform of 2 + 95/s, looped through the exact plant."""
    numerator, denominator = scipy.signal.bilinear([2.0, 95.0], [1.0, 0.0], fs_hz)
    a, b = plant()
    augmented = np.zeros((6, 6))
    augmented[:5, :5], augmented[:5, 5] = a, b
    step = scipy.linalg.expm(augmented / fs_hz)
    t = np.arange(6000) / fs_hz
    command = 2e-3 * (np.sin(20.0 * t) + 0.3 * np.sin(70.0 * t))
    s, x, u1, e1 = np.zeros(5), np.zeros(t.size), 0.0, 0.0
    for n, wanted in enumerate(command):
        x[n] = s[3]
        error = wanted - s[3]
        u = numerator[0] * error + numerator[1] * e1 - denominator[1] * u1
        u1, e1 = u, error
        s = step[:5, :5] @ s + step[:5, 5] * u
    loop = quiet(period_s=1.0 / fs_hz, loop_kp=2.0, loop_ki_per_s=95.0)
    found, _ = core.VirtualRig(loop).run(command)
    np.testing.assert_allclose(found, x, rtol=0, atol=1e-5 * np.abs(x).max())


def test_the_loop_hears_the_sensor_with_its_noise_and_its_steps() -> None:
    noisy = replace(
        quiet(loop_kp=2.0, loop_ki_per_s=95.0), displacement=core.SensorConfig(noise_std=1e-5)
    )
    still, _ = core.VirtualRig(replace(noisy, displacement=core.SensorConfig())).run(
        np.zeros(40000)
    )
    assert not still.any()
    rig = core.VirtualRig(noisy)
    true = np.array([(rig.step(0.0), rig.true_displacement_m)[1] for _ in range(40000)])
    assert 1e-8 < np.std(true) < 1e-5
    stuck = replace(noisy, displacement=core.SensorConfig(lsb=1.0))
    deaf, _ = core.VirtualRig(stuck).run(np.full(400, 1e-4))
    assert not deaf.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_a_loop_with_a_senseless_command_stays_finite(bad: float) -> None:
    rig = core.VirtualRig(quiet(loop_kp=1e3, loop_ki_per_s=1e6))
    for n in range(20000):
        x, f, _ = rig.step(bad if n % 7 == 0 else 1e3)
        assert np.isfinite([x, f]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_a_senseless_command_is_not_taken(bad: float) -> None:
    rig, good = core.VirtualRig(quiet()), core.VirtualRig(quiet())
    for n in range(2000):
        wrong = n % 5 == 4
        x, f, code = rig.step(bad if wrong else 1e-3)
        assert (x, f) == good.step(1e-3)[:2]
        assert (code != 0) == wrong


def test_a_rig_that_runs_off_stops_at_its_guard() -> None:
    rig = core.VirtualRig(quiet(gain=-1e3, leakage_per_s=0.0, velocity_feedback_n_s_per_m2=0.0))
    for _ in range(20000):
        x, f, _ = rig.step(1e3)
        assert np.isfinite([x, f]).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"valve_n_per_m_s3": 0.0},
        {"valve_b1_per_s": np.nan},
        {"valve_b2_per_s2": -1.0},
        {"velocity_feedback_n_s_per_m2": np.inf},
        {"leakage_per_s": -1.0},
        {"substeps": 0},
        {"hold": "foh"},
        {"command_range_m": -1.0},
        {"delay_samples": 0.5},
        {"loop_kp": np.nan},
        {"loop_ki_per_s": np.inf},
        {"loop_kp": 1e4},
    ],
)
def test_a_plant_that_means_nothing_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(core.CoreError):
        core.VirtualRig(quiet(**changes))


def test_a_valve_without_a_mass_to_push_is_refused_by_the_file() -> None:
    text = config.shipped_rig("rths-benchmark").read_text()
    bare = text.replace('[[specimen]]\nelement = "inertia"\nm_kg = 29.13\n', "")
    with pytest.raises(InputError, match=r"found a mass of 0 kg.*element = .inertia."):
        config.parse_rig(bare, "rig.toml")


# --- perturbed plants ----------------------------------------------------------------------------


@pytest.mark.long
def test_plants_are_drawn_with_the_stated_deviations_and_by_their_seed() -> None:
    plants = [benchmark.drawn(seed) for seed in range(2000)]
    assert benchmark.drawn(7) == plants[7]
    nominal = benchmark.nominal()
    for key in ("valve_b1_per_s", "valve_b2_per_s2"):
        values = np.array([getattr(plant.actuator, key) for plant in plants])
        own = getattr(nominal.actuator, key)
        assert values.std() == pytest.approx(benchmark.DEVIATIONS[key], rel=0.1)
        assert values.mean() == pytest.approx(own, abs=0.1 * values.std())
    stiffness = np.array([plant.specimen[0].model_dump()["k_n_per_m"] for plant in plants])
    damping = np.array([plant.specimen[1].model_dump()["c_n_s_per_m"] for plant in plants])
    assert stiffness.std() == pytest.approx(5e4, rel=0.1)
    np.testing.assert_allclose(damping, 2 * 0.0097 * np.sqrt(MASS * stiffness), rtol=1e-6)
    wide = benchmark.drawn(7, 3.0).specimen[0].model_dump()["k_n_per_m"]
    assert wide - 1.19e6 == pytest.approx(3.0 * (stiffness[7] - 1.19e6))


@pytest.mark.parametrize("seed", [None, 3])
def test_a_frame_of_three_storeys_runs_on_the_plant(seed: int | None) -> None:
    rig = benchmark.nominal() if seed is None else benchmark.drawn(seed)
    text = (config.shipped_rig("rths-benchmark").parents[1] / ".." / "examples").resolve()
    example = (text / "frame-three-storeys.toml").read_text().replace('"25 kN"', '"8.9 kN"')
    specimen = "{ mass_kg = 29.13, damping_n_s_per_m = 114.22, stiffness_n_per_m = 1.19e6 }"
    example = example.replace("specimen = {} ", f"specimen = {specimen} ").replace(
        "[ground_motion]", "duration_s = 12\n[ground_motion]"
    )
    setup = experiment.prepare(config.parse_test(example), rig)
    samples = virtual_time.run(setup).samples
    assert np.abs(samples["f_meas_n"]).max() < 8900.0
    running = samples[samples["state"] == core.STATES.index("RUNNING")]
    error = running["x_meas_m"] - running["x_num_m"]
    assert error.std() < 0.1 * running["x_num_m"].std()
