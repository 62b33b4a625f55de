"""The rate belongs to the test: what means a time is as long at 256 Hz as at 4096, and at 1024 Hz
nothing has changed."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from scipy.integrate import solve_ivp

from rthyb_rt import config, core, ground_motion
from rthyb_rt.analysis import margins, summary
from rthyb_rt.config import Rate
from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.diagnose import reading
from rthyb_rt.errors import InputError
from rthyb_rt.lab import braking, experiment, realtime, virtual_time
from rthyb_rt.record import mat_csv, recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import render

ROOT = Path(__file__).parents[1]
STORED = Path(__file__).parent / "data" / "recordings"
RATES = (256.0, 512.0, 1000.0, 1024.0, 2048.0, 4096.0)
STATE = {name: number for number, name in enumerate(STATES)}
K_N_PER_M, PERIOD_S, RATIO = 666400.0, 0.5, 0.02
TEST = """schema = "rthyb-test/1"
rig = "spring"
[test]
name = "plate"
duration_s = {duration_s}
sample_rate_hz = {rate_hz}
[ground_motion]
pga_g = 0.04
start_s = 1
[numerical]
period_s = {period_s}
damping_ratio = 0.02
{more}
"""
RIG = """schema = "rthyb-rig/1"
[rig]
name = "spring"
elastic_stiffness_n_per_m = 666400
[identified]
delay_s = 0.0078125
alpha = 8
[[specimen]]
element = "stiffness"
k_n_per_m = 666400
[actuator]
"""
DELAY = 'kind = "pure-delay"\ndelay_samples = {}\n'
LAG = 'kind = "second-order"\nnatural_frequency_hz = 40\ndamping_ratio = 0.7\ndelay_s = 0.004\n'
QUICK = "[limits]\nramp_in_s = 0.1\ntare_s = 0.1\n"


def prepared(
    rate_hz: float,
    more: str = "",
    actuator: str = LAG,
    duration_s: float = 3.0,
    period_s: float = PERIOD_S,
    rig: str = RIG,
) -> experiment.Setup:
    more = more if "[limits]" in more else more + QUICK
    text = TEST.format(rate_hz=rate_hz, duration_s=duration_s, period_s=period_s, more=more)
    return experiment.prepare(config.parse_test(text), config.parse_rig(rig + actuator))


def running(rec: RecordedTest) -> np.ndarray:
    return rec.samples[rec.samples["state"] == STATE["RUNNING"]]


# ---- at 1024 Hz ---------------------------------------------------------------------------------


def test_a_test_in_virtual_time_gives_what_it_gave_before_rates() -> None:
    """Every column, to the bit, where compiler and machine are those that recorded.

    The ground motion is the recorded one, because NumPy's sums differ in their last bit between
    processors with and without AVX-512; what is prepared here equals it but for that.
    """
    rec = recording.read(STORED / "version-2-virtual.h5")
    setup = experiment.prepare(config.parse_test(rec.test_toml), config.parse_rig(rec.rig_toml))
    ag = running(rec)["ag_mps2"]
    np.testing.assert_allclose(setup.ag_mps2, ag, rtol=1e-13, atol=1e-15)
    again = virtual_time.run(replace(setup, ag_mps2=ag))
    assert setup.derived.fs_hz == again.fs_hz == 1024.0
    assert again.samples.size == rec.samples.size
    facts = core.build_facts()
    same = all(rec.meta[key] == facts[key] for key in ("compiler", "architecture"))
    for name in recording.fields_of(rec.version):
        if same:
            assert again.samples[name].tobytes() == rec.samples[name].tobytes(), name
        else:
            np.testing.assert_allclose(again.samples[name], rec.samples[name], rtol=1e-6)


@pytest.mark.parametrize("kind", ["virtual", "stepped", "faults"])
def test_what_was_recorded_before_rates_replays_to_the_bit(kind: str) -> None:
    """Over no wire, over one, and over one that loses a pair in twenty."""
    rec = recording.read(STORED / f"version-2-{kind}.h5")
    facts = core.build_facts()
    if any(rec.meta[key] != facts[key] for key in ("compiler", "architecture")):
        pytest.skip("recorded with another compiler or on another machine")
    assert realtime.replay(rec).identical


def test_what_the_core_counts_at_1024_hz_is_what_it_always_counted() -> None:
    station = core.Station(experiment.station_config(prepared(1024)), np.zeros(8))
    ticks = station._c.ticks
    counted = {name: int(getattr(ticks, name)) for name in (
        "lost", "rest", "skips", "recent", "arrival", "overload", "least_way", "turn", "least_turn"
    )}  # fmt: skip
    assert counted == {
        "lost": 20, "rest": 20, "skips": 10, "recent": 1024, "arrival": 10240, "overload": 256,
        "least_way": 8, "turn": 16, "least_turn": 2,
    }  # fmt: skip
    controller = station._c.controller
    assert (controller.freeze_after, controller.extrapolate_until) == (3, 20)


# ---- what means a time --------------------------------------------------------------------------


class Standing:
    """A station at a drive that stands, tick by tick."""

    def __init__(self, setup: experiment.Setup, **changes: object) -> None:
        self.config = experiment.station_config(setup)
        self.station = core.Station(self.config, setup.ag_mps2)
        self.rate = setup.rate

    def until(self, state: str, most_s: float = 60.0, **inputs: object) -> float:
        """Tick until a state; return how long that took."""
        for n in range(1, self.rate.ticks(most_s) + 1):
            if self.station.tick(**inputs).state == state:  # type: ignore[arg-type]
                return n / self.rate.hz
        raise AssertionError(f"{state} not reached in {most_s} s: {self.station.state}")

    def zero(self) -> float:
        self.station.tick(command="zero")
        return self.until("ZEROED")


@pytest.mark.parametrize("rate_hz", RATES)
def test_the_stations_times_are_as_long_at_every_rate(rate_hz: float) -> None:
    setup = prepared(rate_hz, "[limits]\ntare_s = 0.25\narmed_timeout_s = 1.5\nramp_in_s = 0.5\n")
    tick_s = 1 / rate_hz
    at = Standing(setup)
    assert at.zero() == pytest.approx(0.25, abs=2 * tick_s)
    at.station.tick(command="arm")
    assert at.until("ZEROED") == pytest.approx(1.5, abs=2 * tick_s)
    at.station.tick(command="arm")
    at.station.tick(command="start")
    assert at.until("RUNNING") == pytest.approx(0.5, abs=2 * tick_s)
    at = Standing(setup)
    at.zero()
    assert at.until("TRIPPED", lost=True) == pytest.approx(20 / 1024, abs=0.51 * tick_s)
    assert at.station.cause == "link_lost"


@pytest.mark.parametrize("rate_hz", RATES)
def test_alpha_is_held_after_three_milliseconds_without_a_pair(rate_hz: float) -> None:
    at = Standing(prepared(rate_hz))
    at.zero()
    at.station.tick(command="arm")
    at.station.tick(command="start")
    at.until("RUNNING")
    at.station.tick()
    frozen = [
        bool(at.station.tick(lost=True).records[-1]["flags"] & FLAGS["frozen"])
        for _ in range(at.rate.ticks(0.01))
    ]
    assert frozen == sorted(frozen)
    assert frozen.index(True) + 1 == max(1, round(3 / 1024 * rate_hz))


@pytest.mark.parametrize("rate_hz", RATES)
def test_skipped_ticks_trip_and_are_made_up_for_by_their_time(rate_hz: float) -> None:
    most = round(20 / 1024 * rate_hz)
    at = Standing(prepared(rate_hz))
    at.zero()
    made_up = at.station.tick(skipped=most - 1).records
    assert (made_up.size, at.station.state) == (most, "ZEROED")
    stalled = at.station.tick(skipped=10 * most)
    assert (stalled.state, at.station.cause) == ("TRIPPED", "stalled")
    assert stalled.records.size == most + 1


@pytest.mark.parametrize("rate_hz", RATES)
def test_the_share_of_lost_pairs_is_of_the_last_second(rate_hz: float) -> None:
    """One in 20 is lost for ever: that is 5 %, at any rate, and no more."""
    table = f'{QUICK}lost_pairs_share = {{ value = 0.06, action = "trip" }}\n'
    at = Standing(prepared(rate_hz, table, duration_s=5.0))
    at.zero()
    at.station.tick(command="arm")
    at.station.tick(command="start")
    at.until("RUNNING")
    for n in range(at.rate.ticks(2.0)):
        at.station.tick(lost=n % 20 == 0)
    assert at.station.state == "RUNNING"
    lost = 0
    while at.station.state == "RUNNING" and lost < rate_hz:
        # Two of twenty: the share rises from 5 to 10 % within the second.
        at.station.tick(lost=lost % 20 < 2)
        lost += 1
    assert (at.station.state, at.station.cause) == ("TRIPPED", "lost_pairs")
    assert lost / rate_hz == pytest.approx(0.2, abs=40 / rate_hz + 0.02)


@pytest.mark.parametrize("rate_hz", RATES)
@pytest.mark.parametrize(
    "stuck",
    [
        "sensor_stuck_s = 0.0625\nforce_stuck_s = 0.125\n",
        "sensor_stuck_samples = 64\nforce_stuck_samples = 128\n",
    ],
)
def test_limits_mean_the_same_times_at_every_rate(rate_hz: float, stuck: str) -> None:
    table = f"{QUICK}command_increment_m = 1e-4\n{stuck}sensor_jump_m = 1e-3\nforce_jump_n = 500\n"
    watches = experiment.station_config(prepared(rate_hz, table)).watches
    pace = rate_hz / 1024
    assert watches["increment"].value * rate_hz == pytest.approx(1e-4 * 1024)
    assert watches["sensor_stuck"].value / rate_hz == pytest.approx(64 / 1024, abs=0.51 / rate_hz)
    assert watches["force_stuck"].value / rate_hz == pytest.approx(128 / 1024, abs=0.51 / rate_hz)
    # Of a longer sample the motion is larger, of a shorter one the noise is not smaller.
    assert watches["sensor_jump"].value == pytest.approx(1e-3 / min(pace, 1))
    assert watches["force_jump"].value == pytest.approx(500 / min(pace, 1))


@pytest.mark.parametrize("rate_hz", RATES)
def test_a_resolved_test_is_the_same_test(rate_hz: float) -> None:
    more = '[controller]\ntype = "alpha-beta"\nalpha0 = 7.3\nbeta0 = 11\n'
    setup = prepared(rate_hz, more, LAG)
    text = config.dump(setup.test)
    again = experiment.prepare(config.parse_test(text), setup.rig)
    assert again.derived.window_samples == setup.derived.window_samples
    assert again.derived.window_samples / rate_hz == pytest.approx(0.05, abs=0.5 / rate_hz)
    assert again.derived.law_settings == setup.derived.law_settings
    begins = core.Law(again.controller.law, period_s=1 / rate_hz).report()
    assert begins["alpha"] / rate_hz == pytest.approx(7.3 / 1024)
    assert begins["beta"] / rate_hz**2 == pytest.approx(11 / 1024**2)
    assert again.test.test.sample_rate_hz == rate_hz


# ---- the same structure at every rate -----------------------------------------------------------


def test_the_ground_motion_is_the_same_function_of_time() -> None:
    coarse, fine = prepared(256).ag_mps2, prepared(4096).ag_mps2
    assert fine.size == 16 * coarse.size
    np.testing.assert_allclose(fine[::16], coarse, atol=1e-9 * np.abs(coarse).max())
    record = ground_motion.GroundMotion(
        "sweep", "test", 1 / 1000, np.sin(2 * np.pi * 200 * np.arange(4000) / 1000)
    )
    # What 256 Hz cannot hold is gone, and does not come back as another frequency.
    folded = ground_motion.resample(record, 256.0)
    assert np.abs(folded[300:-300]).max() < 1e-4


@pytest.mark.parametrize("rate_hz", RATES)
@pytest.mark.parametrize("integrator", ["central-difference", "cr"])
def test_a_structure_swings_freely_as_theory_says(rate_hz: float, integrator: str) -> None:
    """An ideal rig: w_d = w sqrt(1 - zeta^2), exp(-zeta w t), but for the step's (w h)^2 / 24."""
    more = f'integrator = "{integrator}"\n[controller]\ntype = "none"\n'
    setup = prepared(rate_hz, more + QUICK, DELAY.format(0), duration_s=12.0)
    ag = setup.ag_mps2.copy()
    ag[setup.rate.ticks(2.0) :] = 0.0
    setup = experiment.replace(setup, ag_mps2=ag)
    x = running(virtual_time.run(setup))["x_meas_m"][setup.rate.ticks(2.0) + 2 :]
    t = np.arange(x.size) / rate_hz
    omega = 2 * np.pi / PERIOD_S
    free = omega * math.sqrt(1 - RATIO**2)
    # x = exp(-zeta w t) (a cos + b sin), fitted for the two numbers that theory is to give.
    up = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    crossed = t[up] + x[up] / (x[up] - x[up + 1]) / rate_hz
    cycles = crossed.size - 1
    frequency = 2 * np.pi * cycles / (crossed[-1] - crossed[0])
    step_error = (omega / rate_hz) ** 2 / 24
    # Central difference is the faster one, CR (of the trapezoidal rule) the slower one.
    signed = step_error if integrator == "central-difference" else -2 * step_error
    assert frequency / free - 1 == pytest.approx(signed, abs=0.05 * step_error + 2e-6)
    energy = [float(np.sum(x[a:b] ** 2)) for a, b in itertools.pairwise(up)]
    decay = -0.5 * np.polyfit(np.arange(len(energy)), np.log(energy), 1)[0]
    wanted = 2 * np.pi * RATIO / math.sqrt(1 - RATIO**2)
    assert decay == pytest.approx(wanted, rel=5 * step_error + 2e-3)


@pytest.mark.parametrize("rate_hz", RATES)
def test_the_tests_own_recursion_is_that_of_central_differences(rate_hz: float) -> None:
    """m (x+ - 2x + x-)/h^2 + c (x+ - x-)/2h + f = -m ag, in every row of the hybrid test."""
    more = f'[controller]\ntype = "none"\n{QUICK}'
    setup = prepared(rate_hz, more, DELAY.format(0))
    rows, h, d = running(virtual_time.run(setup)), 1 / rate_hz, setup.derived
    before, now, after = rows["x_num_m"][:-2], rows["x_num_m"][1:-1], rows["x_num_m"][2:]
    force = rows["f_meas_n"][1:-1]
    rest = (
        d.mass_kg * (after - 2 * now + before) / h**2
        + d.damping_n_s_per_m * (after - before) / (2 * h)
        + force
        + d.mass_kg * setup.ag_mps2[1 : now.size + 1]
    )
    assert np.abs(rest).max() < 1e-6 * np.abs(force).max()


@pytest.mark.parametrize("rate_hz", [256.0, 512.0, 1024.0, 2048.0, 4096.0])
def test_an_actuator_is_as_late_at_every_rate(rate_hz: float) -> None:
    """A pure delay is what the file says; a lag has 2 zeta / w, its delay, half a held sample."""
    t, f = np.arange(round(8 * rate_hz)) / rate_hz, 1.0
    lag = 2 * 0.7 / (2 * np.pi * 40) + 0.004 + 0.5 / rate_hz
    for actuator, delay_s in ((DELAY.format(8), 8 / 1024), (LAG, lag)):
        rig = core.VirtualRig(prepared(rate_hz, actuator=actuator).virtual_rig)
        x, _ = rig.run(np.sin(2 * np.pi * f * t))
        turn = np.angle(np.sum((x * np.exp(-2j * np.pi * f * t))[t >= 2])) + np.pi / 2
        assert -turn / (2 * np.pi * f) == pytest.approx(delay_s, rel=2e-3)


@pytest.mark.parametrize("law", ["robust", "alpha-beta", "paper"])
def test_a_delay_is_learnt_as_fast_at_every_rate(law: str) -> None:
    """From half of it to the delay of 8/1024 s, with a motion that the paper's normalisation weighs
    little and one that it weighs much: the same curve over time, whatever the samples."""
    more = f'[controller]\ntype = "{law}"\nalpha0 = 4\n{QUICK}'
    for amplitude_m in (2e-4, 5e-3):
        learnt = {}
        for rate_hz in (512.0, 1024.0, 4096.0):
            settings = prepared(rate_hz, more).controller.law
            t = np.arange(round(8 * rate_hz)) / rate_hz
            sent, came = (amplitude_m * np.sin(3 * np.pi * (t - d)) for d in (0.0, 8 / 1024))
            found = core.Law(settings, period_s=1 / rate_hz).follow(sent, sent, came)[1]
            alpha = found["alpha"]
            learnt[rate_hz] = alpha[:: round(rate_hz / 256)] / rate_hz * 1024
        end = learnt[1024.0][-1]
        assert abs(end - 8) < 0.05 or (law == "paper" and 4.04 < end < 4.08)
        for rate_hz in (512.0, 4096.0):
            gap = np.abs(learnt[rate_hz] - learnt[1024.0])
            assert gap[128:].max() < 0.05
            assert gap[512:].max() < 0.015


def test_the_papers_section_4_2_converges_with_the_rate() -> None:
    """Its structure, rig and controller. Forward Euler is of first order, so that against 4096 Hz
    the differences are as 1/512 - 1/4096, 1/1024 - 1/4096 and 1/2048 - 1/4096: 7 to 3 to 1."""
    path = ROOT / "examples" / "section4.2.toml"
    found = {}
    for rate_hz in (512, 1024, 2048, 4096):
        test = config.load_test(
            path,
            {
                "test.sample_rate_hz": str(rate_hz),
                "test.duration_s": "30",
            },
        )
        rec = virtual_time.run(experiment.prepare(test, config.load_rig(config.find_rig(test.rig))))
        found[rate_hz] = running(rec)["x_meas_m"][:: rate_hz // 512]
    finest = found[4096]
    off = [float(np.sqrt(np.mean((found[hz] - finest) ** 2))) for hz in (512, 1024, 2048)]
    assert off[0] < 0.1 * float(np.sqrt(np.mean(finest**2)))
    assert off[0] / off[2] == pytest.approx(7, rel=0.15)
    assert off[1] / off[2] == pytest.approx(3, rel=0.15)


@pytest.mark.long
def test_the_reference_of_a_yielding_structure_converges_to_the_equations() -> None:
    """Bouc-Wen of Section 4.2 (Eqn 4.1-4.2) by an adaptive Runge-Kutta method of order 8."""
    path = ROOT / "examples" / "section4.2.toml"

    def setup_at(rate_hz: int) -> experiment.Setup:
        changes = {
            "test.sample_rate_hz": str(rate_hz),
            "test.duration_s": "6",
            "numerical.integrator": "central-difference",
        }
        test = config.load_test(path, changes)
        return experiment.prepare(test, config.load_rig(config.find_rig(test.rig)))

    finest = setup_at(4096)
    (loop,) = finest.rig.specimen
    k, ratio, a, b, c, eta = (
        float(getattr(loop, name))
        for name in ("k_n_per_m", "post_yield_ratio", "a", "b", "c", "eta")
    )
    mass, damping = finest.derived.mass_kg, finest.derived.damping_n_s_per_m
    t = np.arange(finest.ticks) / 4096

    def motion(now: float, y: np.ndarray) -> list[float]:
        x, v, z = y
        ag = np.interp(now, t, finest.ag_mps2)
        slope = a - (b * math.copysign(1, v * z) + c) * abs(z) ** eta
        force = ratio * k * x + (1 - ratio) * k * z
        return [v, (-damping * v - force) / mass - ag, v * slope]

    exact = solve_ivp(
        motion, (0, t[-1]), [0, 0, 0], "DOP853", t[::8], rtol=1e-9, atol=1e-12, max_step=1 / 1024
    ).y[0]
    off = []
    for rate_hz in (512, 1024, 2048, 4096):
        x = setup_at(rate_hz).reference["x_ref_m"][:: rate_hz // 512]
        off.append(float(np.abs(x - exact).max() / np.abs(exact).max()))
    # Of second order but where the loop has its corners, which fall where they fall in a step.
    assert off == sorted(off, reverse=True)
    assert off[0] < 1e-4
    assert off[-1] < off[0] / 20


# ---- everything after the test ------------------------------------------------------------------


@pytest.fixture(scope="module")
def fast() -> RecordedTest:
    """Section 5 at 4096 Hz, with a sensor's noise."""
    test = config.load_test(
        ROOT / "examples" / "section5-T0.5.toml",
        {
            "test.sample_rate_hz": "4096 Hz",
            "test.duration_s": "3",
            "ground_motion.start_s": "1",
            "controller.type": "alpha-beta",
        },
    )
    return virtual_time.run(experiment.prepare(test, config.load_rig(config.find_rig(test.rig))))


@pytest.mark.long
def test_a_recording_at_4096_hz_replays_and_is_reported(fast: RecordedTest, tmp_path: Path) -> None:
    recording.write(tmp_path / "recording.h5", fast)
    rec = recording.read(tmp_path / "recording.h5")
    assert rec.fs_hz == 4096.0
    assert realtime.replay(rec).identical
    found = summary.summarize(rec)
    assert found.duration_s == 3.0
    given = summary.setup(rec)
    assert given.alpha_identified == pytest.approx(17 * 4)
    assert given.alpha_max == pytest.approx(60 * 4)
    assert given.window_samples == 205
    assert found.fei_delay_s == pytest.approx(0.0, abs=5e-4)
    assert "4096 Hz" in render(rec)
    mat_csv.to_csv(rec, tmp_path / "rows.csv")
    table = np.genfromtxt(tmp_path / "rows.csv", delimiter=",", names=True)
    steps = np.diff(table[table.dtype.names[0]])
    np.testing.assert_allclose(steps, 1 / 4096, rtol=1e-6)


@pytest.mark.long
def test_a_recording_at_4096_hz_is_diagnosed_with_its_rig_file(
    fast: RecordedTest, tmp_path: Path, rthyb: Rthyb
) -> None:
    recording.write(tmp_path / "recording.h5", fast)
    (tmp_path / "rig.toml").write_text(fast.rig_toml, encoding="utf-8")
    case = reading.read_case(tmp_path / "recording.h5", reading.read_model(tmp_path / "rig.toml"))
    assert case.fs_hz == case.model.fs_hz == 4096.0
    answer = rthyb("diagnose", tmp_path / "recording.h5", "--model", tmp_path / "rig.toml")
    assert answer.code == 0, answer.err
    assert "Nothing is missing" in answer.out


@pytest.mark.long
@pytest.mark.parametrize("rate_hz", [256.0, 4096.0])
def test_the_check_of_a_test_says_the_same_times(rate_hz: float, rthyb: Rthyb) -> None:
    path = ROOT / "examples" / "section5-T0.5.toml"
    answers = [
        rthyb("check", path, "--set", f"test.sample_rate_hz={hz:g}", "--json").json
        for hz in (1024.0, rate_hz)
    ]
    before, now = (answer["figures"] for answer in answers)
    assert now["samples"] / rate_hz == before["samples"] / 1024
    for key in ("alpha0", "identified_delay_samples", "critical_delay_samples"):
        assert now[key] / rate_hz == pytest.approx(before[key] / 1024, rel=0.02), key
    for key in ("peak_phi", "estimator_loop_gain"):
        assert now[key] == pytest.approx(before[key], rel=0.03), key
    ran_on = [answer["run_on"] for answer in answers]
    assert ran_on[1]["displacement_m"] == pytest.approx(ran_on[0]["displacement_m"], rel=0.02)


def test_a_held_test_brakes_as_check_says_at_4096_hz() -> None:
    """The station's brake and the one that `rthyb check` reckons with, tick by tick."""
    rate = Rate(4096.0)
    course = braking.BrakingCourse.of(1e-3 * np.sin(2 * np.pi * 2 * np.arange(4096) / 4096), rate)
    brake = braking.Brake.of(course.x[300], course.v[300], course.a[300], 0.2, rate)
    assert float(brake.turn_s) == pytest.approx(16 / 1024)
    x, v, a = brake.at(float(brake.lasts_s))
    assert abs(float(v)) < 1e-12
    assert abs(float(a)) < 1e-12
    assert abs(float(x) - course.x[300]) > 1e-5


def test_the_delay_that_is_survived_is_found_in_steps_too() -> None:
    motion = core.MotionConfig(
        "central-difference", mass_kg=4220, damping_n_s_per_m=2121, k_e_n_per_m=666400
    )
    structure = margins.OneDegree(motion)
    one = margins.largest_followed_delay(structure, margins.Lead(17.0), 60)
    for step in (2, 4, 7):
        assert margins.largest_followed_delay(structure, margins.Lead(17.0), 60, step) == one


# ---- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize("rate", ["255", "4097", "1e300", "nan", "inf", "0", "-1024", '"4 m"'])
def test_a_rate_out_of_range_is_named(rate: str) -> None:
    text = TEST.format(rate_hz=rate, duration_s=1, period_s=0.5, more="")
    with pytest.raises(InputError, match="256 to 4096 Hz") as caught:
        config.parse_test(text)
    assert "test.sample_rate_hz" in str(caught.value)


def test_part_of_a_sample_of_a_pure_delay_is_refused_with_the_rates_that_fit() -> None:
    with pytest.raises(InputError) as caught:
        prepared(256.0, actuator=DELAY.format(10))
    text = str(caught.value)
    assert "2.5 samples" in text
    assert "(512, 1024, 2048, 4096)" in text
    assert prepared(512.0, actuator=DELAY.format(10)).virtual_rig.servo.delay_samples == 5
    lag = 'kind = "first-order"\nroll_off_hz = 5\nextra_delay_samples = 3\n'
    with pytest.raises(InputError, match="extra_delay_samples = 3"):
        prepared(2000.0, actuator=lag)


def test_a_filter_above_half_of_the_rate_is_refused() -> None:
    more = '[controller]\ntype = "robust"\ndelay_estimator = { cutoff_hz = 130 }\n'
    with pytest.raises(InputError, match=r"must be below half of test\.sample_rate_hz = 256 Hz"):
        prepared(256.0, more)
    assert prepared(512.0, more).controller.law.settings["delay_estimator.cutoff_hz"] == 130


def test_a_period_too_short_for_central_differences_at_256_hz_is_refused() -> None:
    with pytest.raises(InputError, match=r"needs more than 261\.8 Hz"):
        prepared(256.0, period_s=0.012)
    assert prepared(1024.0, period_s=0.012).ticks > 0
    more = 'integrator = "cr"\n[controller]\nrfc = { window_s = 0.01 }\n'
    assert prepared(256.0, more, period_s=0.012).ticks > 0


def test_a_station_and_a_rig_of_two_rates_are_not_joined() -> None:
    setup = prepared(4096.0)
    station = core.Station(experiment.station_config(setup), setup.ag_mps2)
    with pytest.raises(core.CoreError, match="must be equal"):
        core.Virtual(station, core.VirtualRig(experiment.rig_config(setup.rig)))


@pytest.mark.parametrize("rate_hz", [256.0, 4096.0])
def test_the_longest_delay_and_window_fit_at_every_rate(rate_hz: float) -> None:
    setup = prepared(rate_hz, "[controller]\nrfc = { window_samples = 1024 }\n", DELAY.format(1000))
    assert setup.controller.rfc.window == rate_hz
    rig = core.VirtualRig(setup.virtual_rig)
    step = np.ones(round(1.5 * rate_hz))
    x, _ = rig.run(step)
    assert np.flatnonzero(x)[0] / rate_hz == 1000 / 1024
    slow = 'kind = "second-order"\nnatural_frequency_hz = 40\ndamping_ratio = 1\ndelay_s = 1\n'
    x, _ = core.VirtualRig(prepared(rate_hz, actuator=slow).virtual_rig).run(step)
    assert x[round(rate_hz) :].max() > 0.9
    assert np.abs(x[: round(rate_hz)]).max() == 0.0
