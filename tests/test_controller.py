"""One sample of the controller: its order, limits, status, lost samples, replay."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from kernels import (
    FS_HZ,
    HYDRAULIC,
    K_PLATE,
    Floats,
    H,
    controller,
    run_virtual,
    smooth_motion,
    time_s,
)

from rthyb_rt import core

PLATE = core.element("stiffness", k_n_per_m=K_PLATE)
MASS, DAMPING = 4220.0, 2121.0  # Section 5, T = 0.5 s
STATUS = core.STATUS
FLAG = core.FLAGS


def structure(integrator: Any = "central-difference") -> core.MotionConfig:
    return core.MotionConfig(
        integrator, mass_kg=MASS, damping_n_s_per_m=DAMPING, k_e_n_per_m=K_PLATE
    )


def shaking(duration_s: float, peak: float = 0.4) -> Floats:
    return smooth_motion(duration_s, 21, peak_m=peak)


def delay_rig(samples: int = 10, **settings: Any) -> core.VirtualRig:
    servo = core.ServoConfig("pure-delay", delay_samples=samples)
    return core.VirtualRig(core.RigConfig(servo, (PLATE,), **settings))


PAPER = core.EstimatorConfig(law="gradient", gain=0.03, alpha0=8.0)


def bits(*parts: Any) -> bytes:
    """Every bit of the records, column by column; what lies between the columns means nothing."""
    return b"".join(part[name].tobytes() for name in core.RECORD_DTYPE.names for part in parts)


# --- order of one sample -------------------------------------------------------------------------


def hybrid_test_in_python(ag: Floats, delay: int) -> dict[str, Floats]:
    """The order of one sample in controller.c, in plain Python: delay, elastic specimen, gradient
    law, Eqn 3.3, central difference, Eqn 2.5."""
    n_total, k, window = ag.size, 0.8 * K_PLATE, 20
    names = ("x_num_m", "x_plc_m", "x_meas_m", "f_meas_n", "alpha", "k_t_n_per_m")
    rec = {name: np.zeros(n_total + 1) for name in names}
    x_c, x_p, x_m, f = (rec[name] for name in names[:4])

    def at(signal: Floats, n: int) -> float:
        return float(signal[n]) if n >= 0 else 0.0

    alpha, ratios, ratio = PAPER.alpha0, [], K_PLATE
    for n in range(n_total):
        x_m[n] = at(x_p, n - delay)
        f[n] = k * x_m[n]
        mu = 3 * (x_p[n] - x_m[n]) + 2 * (at(x_p, n - 1) - at(x_m, n - 1))
        mu = 1e3 * (mu + at(x_p, n - 2) - at(x_m, n - 2))
        phi = 6e3 * (x_m[n] - at(x_m, n - 1))
        alpha += PAPER.gain * (mu - alpha * phi) * phi / (1.0 + phi**2)
        rec["alpha"][n] = alpha
        dx = x_m[n] - at(x_m, n - 1)
        ratio = (f[n] - at(f, n - 1)) / dx if dx != 0.0 else ratio
        ratios.append(ratio)
        k_t = min(max(sum(ratios[-window - 1 :]) / window, 0.0), K_PLATE)
        k_t = K_PLATE if n <= 2 * window else k_t
        rec["k_t_n_per_m"][n] = k_t
        force = f[n] + k_t * (x_c[n] - x_m[n])
        load = -MASS * ag[n] - force + MASS * (2 * x_c[n] - at(x_c, n - 1)) / H**2
        load += DAMPING * at(x_c, n - 1) / (2 * H)
        x_c[n + 1] = load / (MASS / H**2 + DAMPING / (2 * H))
        lead = 6.0 * alpha * (x_c[n + 1] - x_c[n])
        weighted = 3 * x_c[n + 1] + 2 * x_c[n] + at(x_c, n - 1)
        x_p[n + 1] = (weighted + lead - 2 * x_p[n] - at(x_p, n - 1)) / 3.0
    return {name: values[:n_total] for name, values in rec.items()}


def test_whole_loop_is_the_sample_order_written_again_in_python() -> None:
    ag = shaking(4.0)
    c = controller(structure(), estimator=PAPER, rfc={"window": 20})
    servo = core.ServoConfig("pure-delay", delay_samples=7)
    softer = core.element("stiffness", k_n_per_m=0.8 * K_PLATE)
    records = run_virtual(c, core.VirtualRig(core.RigConfig(servo, (softer,))), ag)
    for name, expected in hybrid_test_in_python(ag, 7).items():
        scale = np.max(np.abs(expected))
        assert scale > 0.0
        np.testing.assert_allclose(records[name], expected, rtol=0, atol=1e-6 * scale, err_msg=name)


def test_row_n_holds_the_commands_for_instant_n() -> None:
    command = smooth_motion(2.0, 1)
    c = controller(core.MotionConfig("prescribed"), estimator=core.EstimatorConfig(alpha0=12.0))
    records = run_virtual(c, delay_rig(10), command)
    np.testing.assert_array_equal(records["x_num_m"], command)
    np.testing.assert_array_equal(records["x_cmd_m"], records["x_plc_m"])
    np.testing.assert_array_equal(records["x_meas_m"][10:], records["x_cmd_m"][:-10])
    np.testing.assert_array_equal(records["tick"], np.arange(command.size))
    np.testing.assert_allclose(
        records["due_ns"], np.arange(command.size) * 1953125 / 2, rtol=0, atol=0.5
    )
    assert set(records["flags"]) == {FLAG["fresh"]}
    assert set(records["state"]) == {core.STATES.index("RUNNING")}
    assert set(records["code"]) == {0}


def test_sample_returns_the_command_of_the_next_row() -> None:
    ag = shaking(0.5)
    c = controller(structure(), estimator=PAPER)
    rig, x_cmd = delay_rig(3), 0.0
    for n, acceleration in enumerate(ag):
        x, f, _ = rig.step(x_cmd)
        sample = c.step(x, f, acceleration)
        assert sample.record["tick"] == n
        assert sample.record["x_cmd_m"] == x_cmd
        assert sample.record["ag_mps2"] == acceleration
        x_cmd = sample.x_cmd_next_m
    assert c.tick == ag.size


def test_step_by_step_is_the_same_as_the_virtual_test() -> None:
    ag = shaking(1.0)
    whole = run_virtual(controller(structure(), estimator=PAPER), delay_rig(), ag)
    c, rig, x_cmd = controller(structure(), estimator=PAPER), delay_rig(), 0.0
    for n, acceleration in enumerate(ag):
        x, f, _ = rig.step(x_cmd)
        sample = c.step(x, f, acceleration)
        x_cmd = sample.x_cmd_next_m
        assert all(sample.record[name] == whole[name][n] for name in whole.dtype.names)


def test_test_in_parts_is_the_same_as_in_one() -> None:
    ag = shaking(3.0)
    whole = run_virtual(controller(structure(), estimator=PAPER), delay_rig(), ag)
    c, rig = controller(structure(), estimator=PAPER), delay_rig()
    parts = [run_virtual(c, rig, ag, ticks) for ticks in (1, 1000, ag.size - 1001)]
    assert bits(*parts) == bits(whole)


def test_test_longer_than_its_ground_motion_goes_on_in_free_vibration() -> None:
    ag = shaking(1.0)
    padded = np.concatenate([ag, np.zeros(2048)])
    whole = run_virtual(controller(structure(), estimator=PAPER), delay_rig(), padded)
    short = run_virtual(controller(structure(), estimator=PAPER), delay_rig(), ag, padded.size)
    assert bits(short) == bits(whole)


def test_prescribed_motion_that_ends_is_held() -> None:
    command = np.linspace(0.0, 0.003, 50)
    records = run_virtual(controller(core.MotionConfig("prescribed")), delay_rig(), command, 90)
    np.testing.assert_array_equal(records["x_num_m"][:50], command)
    assert np.all(records["x_num_m"][50:] == 0.003)


def test_compensator_switched_off_sends_the_command_itself() -> None:
    c = controller(structure(), estimator=PAPER, lead_enabled=False)
    records = run_virtual(c, delay_rig(1), shaking(2.0))
    np.testing.assert_array_equal(records["x_cmd_m"], records["x_num_m"])
    np.testing.assert_array_equal(records["x_plc_m"], records["x_num_m"])


@pytest.mark.parametrize("reading", [(0.0012345678, 1234.5678), (-3.0, 1e7), (1e300, math.inf)])
def test_reading_is_on_record_to_its_last_bit_accepted_or_not(reading: Any) -> None:
    record = controller(core.MotionConfig("prescribed")).step(*reading, 0.0).record
    assert (record["x_read_m"], record["f_read_n"]) == reading


def test_reading_that_did_not_come_is_zero_on_record_and_one_that_is_no_number_is_nan() -> None:
    c = controller(core.MotionConfig("prescribed"))
    lost = c.step(0.001, 5.0, 0.0, lost=True).record
    assert (lost["x_read_m"], lost["f_read_n"]) == (0.0, 0.0)
    assert math.isnan(c.step(math.nan, 5.0, 0.0).record["x_read_m"])


# --- monitors ------------------------------------------------------------------------------------


def test_energy_error_and_tracking_indicator_are_their_sums_in_numpy() -> None:
    c = controller(structure(), estimator=core.EstimatorConfig(alpha0=4.0))
    records = run_virtual(c, delay_rig(10), shaking(4.0))
    x_c = np.concatenate([[0.0], records["x_num_m"]])
    x_m = np.concatenate([[0.0], records["x_meas_m"]])
    f = np.concatenate([[0.0], records["f_meas_n"]])
    energy = np.cumsum(0.5 * (f[1:] + f[:-1]) * np.diff(x_m - x_c))
    enclosed = 0.5 * (x_m[1:] + x_m[:-1]) * np.diff(x_c) - 0.5 * (x_c[1:] + x_c[:-1]) * np.diff(x_m)
    indicator = 0.5 * np.cumsum(enclosed)
    np.testing.assert_allclose(records["energy_error_j"], energy, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(records["tracking_indicator_m2"], indicator, rtol=1e-9, atol=1e-18)
    assert energy[-1] > 0.0  # a lag feeds energy into the structure
    assert indicator[-1] < 0.0


def test_tracking_indicator_of_a_lagging_sine_falls_by_the_ellipses_it_encloses() -> None:
    delay, amplitude = 10, 0.002
    command = amplitude * np.sin(2 * np.pi * 2.0 * time_s(5.0))
    c = controller(core.MotionConfig("prescribed"))
    records = run_virtual(c, delay_rig(delay), command)
    area = np.pi * amplitude**2 * np.sin(2 * np.pi * 2.0 * delay / FS_HZ)
    per_second = np.diff(records["tracking_indicator_m2"][1024::1024])
    np.testing.assert_allclose(per_second, -2.0 * area, rtol=1e-3)


# --- limits --------------------------------------------------------------------------------------


def steep_command() -> Floats:
    command = smooth_motion(4.0, 2, peak_m=0.01)
    command[1500:] += 0.003
    return command


@pytest.mark.parametrize(
    ("velocity", "acceleration"), [(0.15, 0.0), (0.0, 4.0), (0.2, 6.0), (0.05, 1.0)]
)
def test_command_stays_within_velocity_and_acceleration(
    velocity: float, acceleration: float
) -> None:
    c = controller(
        core.MotionConfig("prescribed"),
        estimator=core.EstimatorConfig(alpha0=10.0),
        velocity_limit_m_per_s=velocity,
        acceleration_limit_m_per_s2=acceleration,
    )
    records = run_virtual(c, delay_rig(), steep_command())
    x = np.concatenate([[0.0, 0.0], records["x_cmd_m"]])
    if velocity:
        assert np.max(np.abs(np.diff(x))) <= velocity * H * (1 + 1e-9)
    if acceleration:
        assert np.max(np.abs(np.diff(x, 2))) <= acceleration * H**2 * (1 + 1e-6)
    changed = records["x_cmd_m"] != records["x_plc_m"]
    assert np.any(changed)
    # Row n tells of the command that tick n computed, which is that of row n + 1.
    np.testing.assert_array_equal((records["code"] & STATUS["limited"] > 0)[:-1], changed[1:])
    np.testing.assert_array_equal((records["flags"] & FLAG["limited"] > 0)[:-1], changed[1:])


def test_limiter_that_has_nothing_to_do_leaves_every_bit_alone() -> None:
    command = smooth_motion(2.0, 3)
    settings = {"velocity_limit_m_per_s": 100.0, "acceleration_limit_m_per_s2": 1e6}
    free = run_virtual(controller(core.MotionConfig("prescribed")), delay_rig(), command)
    limited = controller(core.MotionConfig("prescribed"), **settings)
    assert bits(run_virtual(limited, delay_rig(), command)) == bits(free)


@pytest.mark.parametrize("acceleration", [1.0, 5.0, 100.0])
@pytest.mark.parametrize("velocity", [0.0, 0.05, 0.3])
def test_limited_command_comes_to_rest_on_a_step_without_swinging_past(
    acceleration: float, velocity: float
) -> None:
    limited = controller(
        core.MotionConfig("prescribed"),
        lead_enabled=False,
        velocity_limit_m_per_s=velocity,
        acceleration_limit_m_per_s2=acceleration,
    )
    command = np.where(time_s(3.0) < 0.1, 0.0, 0.02)
    x_cmd = run_virtual(limited, delay_rig(), command)["x_cmd_m"]
    assert np.max(x_cmd) <= 0.02
    assert np.all(x_cmd[-1000:] == 0.02)
    assert np.max(np.abs(np.diff(x_cmd, 2))) <= acceleration * H**2 * (1.0 + 1e-9)


def test_changing_alpha_moves_the_command_by_less_than_one_increment() -> None:
    velocity = 0.1
    c = controller(
        core.MotionConfig("prescribed"),
        estimator=core.EstimatorConfig(law="gradient", gain=30.0, alpha_max=60.0),
        velocity_limit_m_per_s=velocity,
    )
    records = run_virtual(c, delay_rig(25), smooth_motion(4.0, 6))
    steps = np.abs(np.diff(records["alpha"])[:-1])
    slope = np.abs(np.diff(records["x_num_m"]))[1:-1]
    moved = 2.0 * steps[: slope.size] * slope  # S / W1 = 2
    assert np.max(moved) > 0.9 * velocity * H
    assert np.max(moved) <= velocity * H * (1 + 1e-9)


def test_changing_alpha_and_beta_together_keep_to_the_same_increment() -> None:
    velocity = 0.2
    law = core.EstimatorConfig(law="rls", estimate_beta=True, memory_samples=300.0)
    c = controller(core.MotionConfig("prescribed"), estimator=law, velocity_limit_m_per_s=velocity)
    command = smooth_motion(4.0, 6) + 1e-4 * np.sin(2 * np.pi * 20.0 * time_s(4.0))
    records = run_virtual(c, delay_rig(25), command)
    slope, curvature = np.diff(command)[1:], np.diff(command, 2)
    d_alpha, d_beta = np.diff(records["alpha"])[:-1], np.diff(records["beta"])[:-1]
    moved = 2.0 * (np.abs(d_alpha * slope) + np.abs(d_beta * curvature))  # S / W1 = 2
    assert np.max(moved) > 0.9 * velocity * H
    assert np.max(moved) <= velocity * H * (1 + 1e-9)


def test_delay_is_learnt_from_the_command_that_the_drive_was_sent() -> None:
    law = core.EstimatorConfig(law="gradient", gain=0.3, alpha0=5.0)
    c = controller(core.MotionConfig("prescribed"), estimator=law, acceleration_limit_m_per_s2=2.0)
    records = run_virtual(c, delay_rig(12), smooth_motion(4.0, 9))
    assert np.any(records["flags"] & FLAG["limited"])
    x_p, x_m = (np.concatenate([[0.0, 0.0], 1e3 * records[n]]) for n in ("x_cmd_m", "x_meas_m"))
    e = x_p - x_m
    mu = 3 * e[2:] + 2 * e[1:-1] + e[:-2]
    alpha, expected = 5.0, []
    for mu_n, phi in zip(mu, 6.0 * np.diff(x_m[1:]), strict=True):
        alpha += 0.3 * (mu_n - alpha * phi) * phi / (1.0 + phi**2)
        expected.append(alpha)
    np.testing.assert_allclose(records["alpha"], expected, rtol=1e-8)


def test_core_says_what_it_was_built_from() -> None:
    facts = core.build_facts()
    assert facts["core_version"] == core.version()
    assert all(facts.values())


def test_several_bits_are_told_by_name() -> None:
    assert core.status_names(STATUS["limited"] | STATUS["trip"]) == ["limited", "trip"]
    assert core.status_names(0) == []


# --- lost samples --------------------------------------------------------------------------------


def feed(c: core.Controller, count: int, start: int = 0, lost: bool = False) -> list[Any]:
    """Rows of a controller that sees a straight line: 1 um and 0.5 N a sample."""
    return [
        c.step(1e-6 * (start + i), 0.5 * (start + i), 1e-6 * (start + i), lost)
        for i in range(count)
    ]


def test_lost_samples_follow_the_command_and_freeze_from_the_third() -> None:
    law = core.EstimatorConfig(law="gradient", gain=1e4, alpha0=3.0, alpha_min=-1e4, alpha_max=1e4)
    c = controller(core.MotionConfig("prescribed"), estimator=law, rfc={"window": 2})
    before = feed(c, 50)[-1].record
    rows = [s.record for s in feed(c, 30, start=50, lost=True)]
    ahead = np.minimum(np.arange(1, 31), 20)
    np.testing.assert_allclose([r["x_meas_m"] for r in rows], 1e-6 * (49 + ahead), rtol=1e-9)
    force = 0.5 * 49 + before["k_t_n_per_m"] * 1e-6 * ahead
    np.testing.assert_allclose([r["f_meas_n"] for r in rows], force, rtol=1e-9)
    flags = [int(r["flags"]) for r in rows]
    assert flags == [FLAG["predicted"]] * 2 + [FLAG["predicted"] | FLAG["frozen"]] * 28
    assert rows[0]["alpha"] != before["alpha"]
    assert len({r["alpha"] for r in rows[1:]}) == 1
    assert len({r["k_t_n_per_m"] for r in rows[1:]}) == 1
    assert {int(r["code"]) for r in rows[:19]} == {0}
    assert {int(r["code"]) for r in rows[19:]} == {0}
    after = feed(c, 1, start=80)[0].record
    assert after["flags"] == FLAG["fresh"]
    assert after["x_meas_m"] == 1e-6 * 80
    assert after["alpha"] != rows[-1]["alpha"]


def test_noise_is_not_run_out_over_a_gap() -> None:
    noise_m, noise_n = 1e-5, 20.0
    sensors = {
        "displacement": core.SensorConfig(noise_std=noise_m),
        "force": core.SensorConfig(noise_std=noise_n),
    }
    c = controller(structure(), estimator=core.EstimatorConfig(alpha0=10.0))
    rig, x_cmd, worst = delay_rig(**sensors), 0.0, 0.0
    for n, acceleration in enumerate(shaking(20.0)):
        x, f, _ = rig.step(x_cmd)
        sample = c.step(x, f, acceleration, lost=n % 1024 >= 1005)
        x_cmd = sample.x_cmd_next_m
        worst = max(worst, abs(float(sample.record["x_meas_m"]) - rig.true_displacement_m))
    assert worst < 6 * noise_m + 2e-5  # 19 samples of constant velocity: 19 sqrt(2) times the noise


def test_single_lost_samples_here_and_there_do_not_freeze() -> None:
    c = controller(structure(), estimator=PAPER)
    rig, x_cmd = delay_rig(), 0.0
    frozen = 0
    for n, acceleration in enumerate(shaking(2.0)):
        x, f, _ = rig.step(x_cmd)
        sample = c.step(x, f, acceleration, lost=n % 5 == 0)
        x_cmd = sample.x_cmd_next_m
        frozen += int(sample.record["flags"]) & FLAG["frozen"]
        assert bool(sample.record["flags"] & FLAG["predicted"]) == (n % 5 == 0)
    assert frozen == 0


@pytest.mark.parametrize(
    ("x", "f", "code"),
    [
        (np.nan, 1.0, STATUS["not_finite"]),
        (0.0, np.inf, STATUS["not_finite"]),
        (1e300, 1.0, STATUS["out_of_range"]),
        (0.0051, 1.0, STATUS["out_of_range"]),
        (0.0, -2100.0, STATUS["out_of_range"]),
    ],
)
def test_bad_pair_counts_as_a_lost_one_and_is_told(x: float, f: float, code: int) -> None:
    settings = {"estimator": PAPER, "x_range_m": 0.005, "f_range_n": 2000.0}
    c = controller(structure(), **settings)
    lossy = controller(structure(), **settings)
    for kernel in (c, lossy):
        feed(kernel, 40)
    told, lost = c.step(x, f, 0.1), lossy.step(0.0, 0.0, 0.1, lost=True)
    assert told.status == code
    assert lost.status == 0
    # A value that is not finite trips, a lost pair does not; what was refused is still on record.
    same = {"code": 0, "state": 0, "x_read_m": 0.0, "f_read_n": 0.0}
    assert told.record | same == lost.record | same
    assert c.step(0.0, 0.0, 0.0).record | same == lossy.step(0.0, 0.0, 0.0).record | same


# --- replay --------------------------------------------------------------------------------------


def noisy_rig(**settings: Any) -> core.VirtualRig:
    return core.VirtualRig(
        core.RigConfig(
            core.ServoConfig(**HYDRAULIC),
            (PLATE,),
            displacement=core.SensorConfig(noise_std=2e-6),
            force=core.SensorConfig(noise_std=20.0),
            seed=5,
            **settings,
        )
    )


LAWS = {
    "paper": core.EstimatorConfig(law="gradient", gain=0.03, alpha0=17.0),
    "robust": core.EstimatorConfig(law="robust", gain=0.002, alpha0=17.0, rest_noise_m=2e-6),
    "alpha-beta": core.EstimatorConfig(
        law="rls", estimate_beta=True, alpha0=17.0, beta0=144.5, rest_noise_m=2e-6
    ),
    "none": core.EstimatorConfig(),
}


def test_rows_of_another_layout_are_refused() -> None:
    c = controller(structure())
    with pytest.raises(core.CoreError, match="record_dtype"):
        c.run_virtual(delay_rig(), np.zeros(10), np.zeros(10))
    spread = np.zeros(20, core.RECORD_DTYPE)[::2]
    with pytest.raises(core.CoreError, match="contiguous"):
        c.run_virtual(delay_rig(), np.zeros(10), spread)


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"period_s": 0.0}, "period"),
        ({"period_s": np.nan}, "period"),
        ({"velocity_limit_m_per_s": -0.1}, "limit"),
        ({"velocity_limit_m_per_s": np.nan}, "limit"),
        ({"acceleration_limit_m_per_s2": -0.1}, "limit"),
        ({"acceleration_limit_m_per_s2": np.nan}, "limit"),
        ({"x_range_m": -1.0}, "limit"),
        ({"f_range_n": np.nan}, "limit"),
        ({"law": core.LawConfig("paper", {"alpha0": 8.0, "w1": 0.5})}, "control law"),
        ({"law": core.LawConfig("paper", {"alpha0": np.nan})}, "control law"),
        ({"law": core.LawConfig("none", rest_noise_m=-1.0)}, "control law"),
        ({"rfc": {"window": 0}}, "T0"),
        ({"rfc": {"k_e_n_per_m": 0.0}}, "k_e"),
        ({"motion": core.MotionConfig("cr", mass_kg=-1.0)}, "mass"),
    ],
    ids=str,
)
def test_controller_setting_out_of_range_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(core.CoreError, match=message):
        controller(**({"motion": structure()} | settings))


def test_equation_of_motion_with_another_sampling_period_is_refused() -> None:
    with pytest.raises(core.CoreError, match="period"):
        controller(core.MotionConfig("cr", mass_kg=1.0, period_s=2 * H))
