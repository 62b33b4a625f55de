"""The station: states, limits, fault reactions, on the stepped clock against a small rig."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from station_courses import Courses

from rthyb_rt import core

K_N_PER_M, MASS_KG = 666400.0, 4220.0
H = core.PERIOD_S
OFFSET_M, OFFSET_N = 0.0123, 45.0
FLAGS = core.FLAGS


def shaking(seconds: float) -> np.ndarray:
    """A gentle burst of ground motion."""
    t = np.arange(round(seconds * core.FS_HZ)) * H
    return np.asarray(0.3 * np.sin(2 * np.pi * 1.7 * t) * np.sin(np.pi * t / seconds) ** 2)


def config(**changes: Any) -> core.StationConfig:
    controller = core.ControllerConfig(
        law=core.LawConfig("paper", {"alpha0": 6.0}),
        rfc=core.RfcConfig(k_e_n_per_m=K_N_PER_M, window=51),
        motion=core.MotionConfig(
            "central-difference", mass_kg=MASS_KG, damping_n_s_per_m=2121.0, k_e_n_per_m=K_N_PER_M
        ),
        velocity_limit_m_per_s=0.5,
    )
    base: dict[str, Any] = {
        "controller": controller,
        "tare_ticks": 64,
        "ramp_in_ticks": 256,
        "armed_ticks": 500,
    }
    return core.StationConfig(**(base | changes))


@dataclass
class Bench(Courses):
    """A station joined to a rig that is offset from zero, and a log of what the drive saw."""

    seconds: float = 2.0
    changes: dict[str, Any] = field(default_factory=dict)
    records: list[np.ndarray] = field(default_factory=list)
    sent: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.station = core.Station(config(**self.changes), shaking(self.seconds))
        specimen = core.element("stiffness", k_n_per_m=K_N_PER_M)
        self.rig = core.VirtualRig(
            core.RigConfig(core.ServoConfig("pure-delay", delay_samples=6), (specimen,))
        )
        self.at_drive = OFFSET_M

    def step(self, command: core.Command = "none", **faults: Any) -> core.StationTick:
        """One tick: the rig answers to the last command that reached it."""
        x, f, _ = self.rig.step(self.at_drive - OFFSET_M)
        pair = {"x_m": x + OFFSET_M, "f_n": f + OFFSET_N} | faults
        tick = self.station.tick(command=command, **pair)
        self.records.append(tick.records.copy())
        if tick.sent:
            self.sent.append((tick.x_cmd_m, tick.state))
            self.at_drive = tick.x_cmd_m
        return tick

    def last_flags(self) -> int:
        return int(self.records[-1]["flags"][-1])


def watched(name: str, value: float, reaction: core.Reaction) -> dict[str, Any]:
    return {"watches": {name: core.Watch(value, reaction)}}


# ---- a second time ------------------------------------------------------------------------------


READINGS: list[dict[str, Any]] = [
    {"x_m": 3.0, "f_n": 5e6},
    {"x_m": math.nan},
    {"f_n": -math.inf},
    {"x_m": 1e300},
    {"x_m": 1.0 / 3.0, "f_n": 1e-300},
    {"lost": True},
]
"""What may come in: more than a lab has, less than a count of its wire, no number, nothing."""


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("tare_ticks", [1, 64])
def test_a_test_without_a_wire_is_replayed_to_the_last_bit(
    reading: dict[str, Any], tare_ticks: int
) -> None:
    bench = Bench(0.5, {"tare_ticks": tare_ticks}).running(100)
    for pause in (3, 1, 30):
        bench.step(**reading)
        for _ in range(pause):
            bench.step(skipped=pause - 1)
    again = core.Station(config(tare_ticks=tare_ticks), shaking(0.5)).replay(bench.rows())
    assert again.tobytes() == bench.rows().tobytes()


# ---- an ordinary day ----------------------------------------------------------------------------


def test_sunny_day_goes_from_idle_through_the_test_back_to_idle_at_rest() -> None:
    bench = Bench().running(0)
    assert bench.station.tare == pytest.approx((OFFSET_M, OFFSET_N), abs=1e-12)
    bench.until("RAMP_OUT")
    assert bench.station.cause == "completed"
    assert bench.station.test_tick == round(2.0 * core.FS_HZ)
    bench.until("IDLE")
    for _ in range(50):
        bench.step()
    rows = bench.rows()
    assert rows["x_num_m"][-1] == 0.0
    assert rows["x_cmd_m"][-1] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    assert not bench.station.interrupted


def test_running_part_is_what_the_controller_alone_computes() -> None:
    bench = Bench().running(0)
    bench.until("RAMP_OUT")
    rows = bench.rows()
    rows = rows[rows["state"] == core.STATES.index("RUNNING")]
    alone = core.Controller(config().controller)
    rig = core.VirtualRig(
        core.RigConfig(
            core.ServoConfig("pure-delay", delay_samples=6),
            (core.element("stiffness", k_n_per_m=K_N_PER_M),),
        )
    )
    expected = np.zeros(rows.size, dtype=core.RECORD_DTYPE)
    alone.run_virtual(rig, shaking(2.0), expected)
    np.testing.assert_allclose(rows["x_meas_m"], expected["x_meas_m"], atol=1e-9)
    np.testing.assert_allclose(rows["alpha"], expected["alpha"], atol=1e-5)
    np.testing.assert_array_equal(rows["ag_mps2"], expected["ag_mps2"])


def test_ramp_in_is_half_a_wave_of_a_raised_cosine() -> None:
    bench = Bench()
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    # Somebody has moved the specimen by 2 mm at the drive's own panel since the tare; the command
    # followed it there, and the ramp brings it back.
    moved = OFFSET_M + 0.002
    bench.step("stop")
    for _ in range(3):
        bench.station.tick(moved, 0.0, drive_stopped=True)
    bench.station._c.state = core.STATES.index("ARMED")
    bench.station.tick(moved, 0.0, command="start")
    x = [bench.station.tick(moved, 0.0).records["x_num_m"][-1] for _ in range(255)]
    u = np.arange(1, 256) / 256
    np.testing.assert_allclose(x, 0.001 * (1 + np.cos(np.pi * u)), atol=1e-15)


def test_the_drive_never_moves_before_start() -> None:
    bench = Bench()
    for command in ("none", "zero", "none", "none"):
        bench.step(command)  # type: ignore[arg-type]
    bench.until("ZEROED")
    bench.step("arm")
    for _ in range(100):
        bench.step()
    positions = {round(x, 12) for x, _ in bench.sent}
    assert positions == {OFFSET_M}


def test_armed_too_long_goes_back_to_zeroed() -> None:
    bench = Bench()
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    assert bench.until("ZEROED") == 500


def test_tare_of_a_moving_specimen_is_refused() -> None:
    bench = Bench()
    bench.step("zero")
    for n in range(200):
        bench.step(x_m=1e-5 * n)
    assert bench.station.state == "IDLE"
    assert bench.station.zeroing_failed


def test_pairs_lost_while_zeroing_prolong_it_and_leave_the_tare_what_it_is() -> None:
    bench = Bench()
    bench.step()
    bench.step("zero")
    for n in range(80):
        bench.step(lost=n % 2 == 0)
    assert bench.station.state == "IDLE"
    for _ in range(23):
        bench.step()
    assert bench.station.state == "ZEROED"
    assert bench.station.tare == pytest.approx((OFFSET_M, OFFSET_N), abs=1e-12)


# ---- what is allowed when -----------------------------------------------------------------------

ALLOWED = {
    "zero": {"IDLE", "ZEROED"},
    "arm": {"ZEROED"},
    "start": {"ARMED"},
    "hold": {"RUNNING", "HOLD"},
    "resume": {"HOLD"},
    "stop": set(core.STATES) - {"TRIPPED"},
    "reset": {"TRIPPED", "IDLE"},
    "trip": set(core.STATES),
}


@pytest.mark.parametrize("command", ALLOWED)
@pytest.mark.parametrize("state", core.STATES)
def test_each_command_is_for_its_states_alone(state: str, command: core.Command) -> None:
    assert core.command_allowed(state, command) == (state in ALLOWED[command])


def test_start_without_zero_and_arm_is_refused_and_nothing_moves() -> None:
    bench = Bench()
    bench.step()
    assert bench.step("start").refused
    assert bench.step("arm").refused
    assert bench.station.state == "IDLE"


def test_start_while_the_link_is_silent_is_refused() -> None:
    bench = Bench()
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    assert bench.step("start", lost=True).refused is False or bench.station.state == "ARMED"
    bench = Bench()
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    bench.step(lost=True)
    assert bench.step("start", lost=True).refused


def test_a_test_that_stays_is_over_when_its_command_stands_and_not_when_it_swings_by() -> None:
    """With weights that hardly damp, the compensator swings on where the braking has ended."""
    swinging = core.LawConfig("paper", {"w1": 1.05, "w2": -1.9, "alpha0": 20.0}, adapts=False)
    controller = dataclasses.replace(config().controller, law=swinging, velocity_limit_m_per_s=0.0)
    changes = {"controller": controller, "stay": True, "path_acceleration_m_per_s2": 5.0}
    bench = Bench(changes=changes).running(440)
    bench.step("stop")
    bench.until("IDLE")
    sent_from = len(bench.sent) - 1
    for _ in range(100):
        bench.step()
    assert np.ptp([x for x, _ in bench.sent[sent_from:]]) < 10e-6


# ---- hold, resume, stop -------------------------------------------------------------------------


def largest_acceleration(rows: np.ndarray) -> float:
    return float(np.abs(np.diff(rows["x_num_m"], 2)).max() / H**2)


def test_hold_brakes_at_the_limit_stands_and_resumes_where_it_left() -> None:
    bench = Bench().running(700)
    before = bench.station.test_tick
    bench.step("hold")
    held_from = len(bench.records)
    for _ in range(2000):
        bench.step()
    assert bench.station.state == "HOLD"
    assert bench.station.test_tick == before
    standing = bench.rows()[-500:]
    assert np.ptp(standing["x_num_m"]) == 0.0
    assert np.ptp(standing["alpha"]) == 0.0
    braking = np.concatenate(bench.records[held_from : held_from + 1000])
    assert largest_acceleration(braking) <= 0.2 * 1.02
    bench.step("resume")
    bench.until("RUNNING")
    assert bench.station.test_tick == before
    assert bench.station.interrupted
    bench.until("RAMP_OUT")
    assert bench.station.cause == "completed"


def test_resume_is_refused_while_still_braking() -> None:
    bench = Bench().running(700)
    bench.step("hold")
    assert bench.step("resume").refused


def test_resumed_motion_has_no_kink() -> None:
    bench = Bench().running(700)
    before = bench.rows()["x_num_m"][-60:]
    bench.step("hold")
    for _ in range(2000):
        bench.step()
    bench.step("resume")
    bench.until("RUNNING")
    for _ in range(30):
        bench.step()
    after = bench.rows()["x_num_m"][-60:]

    def jerkiest(x: np.ndarray) -> float:
        """Largest change of the acceleration from one tick to the next, m/s^2."""
        return float(np.abs(np.diff(x, 3)).max() / H**2)

    assert jerkiest(after) <= 2.0 * jerkiest(before)


def test_operator_stop_ramps_out_to_rest_with_alpha_frozen() -> None:
    bench = Bench().running(700)
    alpha = bench.rows()["alpha"][-1]
    bench.step("stop")
    assert bench.station.state == "RAMP_OUT"
    bench.until("IDLE")
    bench.step()
    rows = bench.rows()
    out = rows[rows["state"] == core.STATES.index("RAMP_OUT")]
    assert bench.station.cause == "operator"
    assert np.all(np.abs(out["alpha"] - alpha) < 0.05)
    assert np.ptp(out["alpha"][1:]) == 0.0
    assert largest_acceleration(out[2:]) <= 0.2 * 1.02
    assert np.max(np.abs(np.diff(out["x_num_m"]))) <= 0.06 * H
    assert rows["x_num_m"][-1] == 0.0


def test_stop_of_a_test_that_stays_ends_where_its_deceleration_does() -> None:
    bench = Bench(changes={"stay": True}).running(700)
    before = bench.rows()
    velocity = float(np.diff(before["x_num_m"][-2:])[0]) / H
    bench.step("stop")
    stopped_at = bench.rows()["x_num_m"][-1]
    bench.until("IDLE")
    for _ in range(100):
        bench.step()
    rows = bench.rows()
    way = rows["x_num_m"][-1] - stopped_at
    assert abs(velocity) > 1e-3
    least = velocity**2 / (2 * 0.2)
    # Its deceleration comes and goes in 16 ticks.
    assert least < way * np.sign(velocity) < least + 1.2 * 16 * H * abs(velocity)
    assert np.ptp(rows["x_num_m"][-100:]) == 0.0
    assert bench.station.cause == "operator"
    out = rows[rows["state"] == core.STATES.index("RAMP_OUT")]
    assert largest_acceleration(out[2:]) <= 0.2 * 1.02
    bench.running(50)


def test_stop_during_hold_ramps_out() -> None:
    bench = Bench().running(500)
    bench.step("hold")
    for _ in range(2000):
        bench.step()
    bench.step("stop")
    bench.until("IDLE")
    assert bench.station.cause == "operator"


# ---- faults, row by row -------------------------------------------------------------------------


def assert_tripped(bench: Bench, cause: str) -> None:
    """Three frames with one position, the last one sent before, then silence; latched."""
    assert bench.station.state == "TRIPPED"
    assert bench.station.cause == cause
    frames = [x for x, state in bench.sent if state == "TRIPPED"]
    before = [x for x, state in bench.sent if state != "TRIPPED"][-1]
    for _ in range(40):
        bench.step()
    frames = [x for x, state in bench.sent if state == "TRIPPED"]
    assert frames == [before] * 3
    assert bench.station.state == "TRIPPED"
    assert bench.step("start").refused
    assert bench.step("stop").refused
    assert bench.station.cause == cause


@pytest.mark.parametrize("lost", [1, 2])
def test_one_or_two_lost_pairs_are_predicted_and_flagged(lost: int) -> None:
    bench = Bench().running()
    for _ in range(lost):
        bench.step(lost=True)
        assert bench.last_flags() & FLAGS["predicted"]
        assert not bench.last_flags() & FLAGS["frozen"]
    assert bench.station.state == "RUNNING"


def test_three_to_nineteen_lost_pairs_freeze_alpha_and_stiffness() -> None:
    bench = Bench().running()
    for n in range(19):
        bench.step(lost=True)
        assert bool(bench.last_flags() & FLAGS["frozen"]) == (n >= 2)
    assert bench.station.state == "RUNNING"
    bench.step()
    assert bench.station.state == "RUNNING"
    assert bench.last_flags() & FLAGS["fresh"]


def test_twenty_lost_pairs_in_a_row_trip() -> None:
    bench = Bench().running()
    for _ in range(20):
        bench.step(lost=True)
    assert_tripped(bench, "link_lost")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["x_m", "f_n"])
def test_value_that_is_not_finite_is_never_sent_and_trips(where: str, bad: float) -> None:
    bench = Bench().running()
    bench.step(**{where: bad})
    assert_tripped(bench, "not_finite")
    assert all(np.isfinite(x) for x, _ in bench.sent)


def test_absurd_but_finite_value_counts_as_a_lost_pair() -> None:
    bench = Bench().running()
    bench.step(x_m=1e300)
    assert bench.station.state == "RUNNING"
    assert bench.last_flags() & FLAGS["predicted"]


def test_stuck_sensor_ramps_out() -> None:
    bench = Bench(changes=watched("sensor_stuck", 100, "ramp-out")).running(700)
    for _ in range(150):
        bench.step(x_m=OFFSET_M + 0.001, f_n=OFFSET_N)
    assert bench.station.cause == "sensor_stuck"
    assert bench.station.state in ("RAMP_OUT", "IDLE")


def test_specimen_at_rest_is_not_a_stuck_sensor() -> None:
    bench = Bench(changes=watched("sensor_stuck", 100, "ramp-out")).running(0)
    bench.step("hold")
    for _ in range(500):
        bench.step()
    assert bench.station.state == "HOLD"


def test_jumping_sensor_ramps_out_and_the_jump_is_not_taken() -> None:
    bench = Bench(changes=watched("sensor_jump", 0.003, "ramp-out")).running()
    bench.step(x_m=0.05)
    assert bench.station.cause == "sensor_jump"
    assert abs(bench.rows()["x_meas_m"][-1]) < 0.02


@pytest.mark.parametrize(
    ("cause", "leap"), [("sensor_jump", {"x_m": 0.05}), ("force_jump", {"f_n": 5e3})]
)
def test_sensor_that_leaps_to_another_level_before_the_test_is_told_as_that(
    cause: str, leap: dict[str, float]
) -> None:
    bench = Bench(changes=watched(cause, 1e-4 if "x_m" in leap else 100.0, "ramp-out"))
    bench.step("zero")
    bench.until("ZEROED")
    for _ in range(19):
        bench.step(**leap)
    assert bench.station.state == "ZEROED"
    bench.step(**leap)
    assert_tripped(bench, cause)


def test_link_that_is_lost_after_a_leap_is_told_as_lost() -> None:
    bench = Bench(changes=watched("sensor_jump", 1e-4, "ramp-out"))
    bench.step("zero")
    bench.until("ZEROED")
    bench.step(x_m=0.05)
    for _ in range(19):
        bench.step(lost=True)
    assert_tripped(bench, "link_lost")


@pytest.mark.parametrize("why", ["stop", "end"])
def test_force_limit_trips_on_the_way_out_as_well(why: str) -> None:
    bench = Bench(changes=watched("force", 5e4, "trip")).running()
    if why == "stop":
        bench.step("stop")
    bench.until("RAMP_OUT")
    bench.step(f_n=6e4)
    assert_tripped(bench, "force")


def test_fault_that_ramped_a_test_out_stays_its_cause_if_another_trips_it() -> None:
    bench = Bench(changes=watched("force", 5e4, "trip")).running()
    bench.step(heartbeat_late=True)
    assert bench.station.state == "RAMP_OUT"
    bench.step(f_n=6e4)
    assert_tripped(bench, "heartbeat")


@pytest.mark.parametrize("reaction", ["none", "indicate", "hold", "ramp-out", "trip"])
@pytest.mark.parametrize("name", ["position", "force", "tracking"])
def test_record_says_which_limit_was_passed(name: str, reaction: core.Reaction) -> None:
    bench = Bench(changes=watched(name, 1e-9, reaction)).running(0)
    for _ in range(40):
        bench.step()
    codes = np.bitwise_or.reduce(bench.rows()["code"])
    bit = core.STATUS[f"{name}_limit"]
    assert bool(codes & bit) == (reaction != "none")
    # A force far beyond its limit, and the test off its course already: nothing is left but a trip.
    escalated = name == "force" and reaction in ("hold", "ramp-out")
    assert bool(codes & core.STATUS["trip"]) == (reaction == "trip" or escalated)


def test_force_limit_trips() -> None:
    bench = Bench(changes=watched("force", 5e4, "trip")).running()
    bench.step(f_n=6e4)
    assert_tripped(bench, "force")


@pytest.mark.parametrize(
    ("reaction", "state"),
    [("indicate", "RUNNING"), ("hold", "HOLD"), ("ramp-out", "RAMP_OUT"), ("trip", "TRIPPED")],
)
@pytest.mark.parametrize("name", ["position", "velocity", "increment", "tracking", "energy"])
def test_each_limit_does_what_it_is_set_to(name: str, reaction: core.Reaction, state: str) -> None:
    bench = Bench(changes=watched(name, 1e-9, reaction))
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("arm")
    bench.step("start")
    seen = set()
    for _ in range(900):
        seen.add(bench.step().state)
    if reaction == "indicate":
        assert bench.station.indicated == [name]
        assert bench.station.state == state
    else:
        assert state in seen
        assert bench.station.cause == name


def test_indicator_that_falls_for_long_is_seen() -> None:
    lagging = dataclasses.replace(config().controller, lead_enabled=False)
    changes = watched("indicator", 1e-7, "ramp-out") | {"controller": lagging}
    bench = Bench(changes=changes).running(0)
    bench.until("RAMP_OUT")
    assert bench.station.cause == "indicator"


def test_indicator_that_tripped_a_test_says_nothing_of_the_next_one() -> None:
    lagging = dataclasses.replace(config().controller, lead_enabled=False)
    changes = watched("indicator", 1e-7, "trip") | {"controller": lagging}
    bench = Bench(changes=changes).running(0)
    bench.until("TRIPPED")
    for _ in range(30):
        bench.step()
    bench.step("reset")
    bench.running(20)  # as at the first time: no trip in RAMP_IN by what the last test left
    bench.until("TRIPPED")
    assert bench.station.cause == "indicator"


def test_command_never_leaves_the_position_limit_whatever_the_reaction() -> None:
    for reaction in ("hold", "ramp-out", "trip"):
        bench = Bench(changes=watched("position", 2e-4, reaction)).running(0)
        for _ in range(2500):
            bench.step()
        assert max(abs(x - OFFSET_M) for x, _ in bench.sent) <= 2e-4 + 1e-12


def test_cable_pulled_trips_and_stays_tripped_when_the_link_returns() -> None:
    bench = Bench().running()
    bench.step(lost=True, link_down=True)
    assert_tripped(bench, "link_down")


@pytest.mark.parametrize("state", ["ZEROED", "ARMED", "RAMP_IN", "RUNNING", "HOLD", "RAMP_OUT"])
def test_drive_that_stops_trips_in_every_state_but_idle(state: str) -> None:
    bench = Bench()
    bench.step()
    bench.step(drive_stopped=True)
    assert bench.station.cause == "none"
    bench.step("zero")
    bench.until("ZEROED")
    for command, reached in (
        ("arm", "ARMED"),
        ("start", "RAMP_IN"),
        ("none", "RUNNING"),
        ("hold", "HOLD"),
        ("stop", "RAMP_OUT"),
    ):
        if bench.station.state == state:
            break
        bench.step(command)  # type: ignore[arg-type]
        bench.until(reached)
    assert bench.station.state == state
    tick = bench.station.ticks
    bench.step(drive_stopped=True)
    assert bench.station.cause_tick == tick
    assert_tripped(bench, "drive_stopped")


@pytest.mark.parametrize("why", ["link_down", "drive_stopped"])
@pytest.mark.parametrize(("command", "state"), [("zero", "IDLE"), ("reset", "IDLE")])
def test_nobody_zeroes_a_drive_that_does_not_follow(
    why: str, command: core.Command, state: str
) -> None:
    bench = Bench()
    bench.step()
    if command == "reset":
        bench.step("trip")
        for _ in range(30):
            bench.step()
    tick = bench.step(command, **{why: True})
    # A drive that has stopped is what a reset is for.
    assert tick.refused == (command == "zero" or why == "link_down")
    assert bench.station.state == ("TRIPPED" if command == "reset" and tick.refused else state)
    flags = int(tick.records["flags"][-1])
    assert bool(flags & FLAGS["refused"]) == tick.refused
    assert flags & FLAGS["down" if why == "link_down" else "stopped"]


@pytest.mark.parametrize("why", ["link_down", "drive_stopped"])
@pytest.mark.parametrize("command", ["arm", "start"])
def test_arm_and_start_without_a_drive_are_refused_and_trip(why: str, command: str) -> None:
    bench = Bench()
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    if command == "start":
        bench.step("arm")
    tick = bench.step(command, **{why: True})  # type: ignore[arg-type]
    assert tick.refused
    assert_tripped(bench, why)


def test_one_overrun_is_made_up_for_and_counted() -> None:
    bench = Bench().running()
    before, n = bench.station.test_tick, bench.station.ticks
    tick = bench.step(skipped=3)
    assert tick.records.size == 4
    flags = tick.records["flags"]
    assert np.all(flags[:3] & FLAGS["blind"])
    assert np.all(flags[:3] & FLAGS["not_sent"])
    assert not flags[3] & FLAGS["blind"]
    assert bench.station.test_tick == before + 4
    assert bench.station.ticks == n + 4
    assert bench.station.skipped == 3
    np.testing.assert_array_equal(tick.records["tick"], np.arange(n, n + 4))
    assert bench.station.state == "RUNNING"


def test_gap_is_caught_up_at_the_velocity_limit_and_not_in_one_step() -> None:
    slow = config().controller
    limited = core.ControllerConfig(
        law=slow.law, rfc=slow.rfc, motion=slow.motion, velocity_limit_m_per_s=0.05
    )
    bench = Bench(changes={"controller": limited}).running(700)
    for _ in range(3):
        bench.step(skipped=9)
    for _ in range(200):
        bench.step()
    steps = np.abs(np.diff([x for x, _ in bench.sent]))
    assert steps.max() <= 0.05 * H * (1 + 1e-9)


def test_more_than_ten_skips_in_a_row_ramp_out() -> None:
    bench = Bench().running()
    bench.step(skipped=10)
    assert bench.station.state == "RUNNING"
    bench.step(skipped=11)
    assert bench.station.state == "RAMP_OUT"
    assert bench.station.cause == "skips"


def test_fifty_one_skips_within_a_second_ramp_out_and_fifty_do_not() -> None:
    bench = Bench(seconds=4.0).running()
    for _ in range(5):
        bench.step(skipped=10)
        bench.step()
    assert bench.station.state == "RUNNING"
    bench.step(skipped=1)
    assert bench.station.cause == "skips"


def test_skips_of_long_ago_are_forgotten() -> None:
    bench = Bench(seconds=6.0).running()
    for _ in range(4):
        for _ in range(5):
            bench.step(skipped=10)
        for _ in range(1024):
            bench.step()
    assert bench.station.state == "RUNNING"
    assert bench.station.skipped == 200


@pytest.mark.parametrize("skipped", [20, 21, 500, 100000])
def test_stall_of_twenty_ticks_trips_without_a_burst(skipped: int) -> None:
    bench = Bench().running()
    before = bench.station.ticks
    tick = bench.step(skipped=skipped)
    assert tick.records.size <= core.BLIND_MAX + 1
    assert bench.station.ticks == before + skipped + 1
    assert bench.station.skipped == skipped
    assert_tripped(bench, "stalled")
    silent = [bool(rows["flags"][-1] & FLAGS["not_sent"]) for rows in bench.records]
    assert silent[-43:] == [False] * 3 + [True] * 40


def test_python_hung_ramps_out() -> None:
    bench = Bench().running()
    bench.step(heartbeat_late=True)
    assert bench.station.state == "RAMP_OUT"
    assert bench.station.cause == "heartbeat"
    bench.until("IDLE")


def test_signal_twice_trips() -> None:
    bench = Bench().running()
    bench.step("stop")
    bench.step("trip")
    assert bench.station.state == "TRIPPED"
    assert bench.station.cause == "signal"


def test_reset_stands_where_the_specimen_is_and_a_new_test_can_start() -> None:
    bench = Bench().running(700)
    bench.step(f_n=np.nan)
    for _ in range(30):
        bench.step()
    bench.step("reset")
    assert bench.station.state == "IDLE"
    assert bench.station.cause == "none"
    tick = bench.step()
    assert tick.x_cmd_m == pytest.approx(bench.at_drive)
    bench.running(200)


def test_first_cause_is_kept() -> None:
    watches = {"force": core.Watch(5e4, "ramp-out"), "tracking": core.Watch(1e-3, "trip")}
    bench = Bench(changes={"watches": watches}).running()
    bench.step(f_n=6e4)
    assert bench.station.cause == "force"
    bench.step("trip")
    assert bench.station.cause == "force"
    assert bench.station.state == "TRIPPED"


def slowed(bench: Bench, velocity_m_per_s: float) -> Bench:
    """Narrow the command's velocity limit behind the station's back: its path leaves it behind."""
    bench.station._c.controller.cfg.axis[0].velocity_limit_m_per_s = velocity_m_per_s
    return bench


@pytest.mark.parametrize("stay", [False, True])
def test_command_that_never_comes_to_the_end_of_its_path_is_given_up_after_ten_seconds(
    stay: bool,
) -> None:
    bench = Bench(changes={"stay": stay}).running(700)
    bench.step("stop")
    while not stay and bench.station._c.leg == 0:
        bench.step()
    # Whoever narrows a limit so far keeps the command from its end: 0.1 um in 10 s.
    slowed(bench, 1e-8).until("TRIPPED")
    assert bench.station.cause == "not_arrived"
    path = np.flatnonzero(np.diff(bench.rows()["x_num_m"]))[-1]
    waited = bench.rows().size - int(path) - 1
    assert waited == pytest.approx(10 * core.FS_HZ, abs=2)
    for _ in range(30):
        bench.step()
    # Nothing but the three frames of a trip, with the last position in them.
    tripped = [x for x, state in bench.sent if state == "TRIPPED"]
    assert len(tripped) == 3
    assert set(tripped) == {bench.sent[-4][0]}


def test_slow_way_that_comes_nearer_is_waited_for() -> None:
    bench = Bench(changes={"stay": True}).running(700)
    slowed(bench, 1e-4).step("stop")
    assert bench.until("IDLE", 200_000) > 12 * core.FS_HZ
    assert bench.station.cause == "operator"


@pytest.mark.parametrize("state", ["IDLE", "ZEROED", "ARMED"])
def test_skips_at_rest_are_counted_and_ramp_nothing_out(state: str) -> None:
    bench = Bench()
    bench.step()
    for command in ("zero", "arm")[: ("IDLE", "ZEROED", "ARMED").index(state)]:
        bench.step(command)
        bench.until("ZEROED" if command == "zero" else "ARMED")
    for _ in range(9):
        bench.step(skipped=12)
    assert (bench.station.state, bench.station.cause) == (state, "none")
    assert bench.station.skipped == 108


# ---- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"tare_ticks": 0},
        {"ramp_in_ticks": 0},
        {"path_velocity_m_per_s": 0.0},
        {"path_acceleration_m_per_s2": float("nan")},
        {"rest_spread_m": 0.0},
        {"watches": {"force": core.Watch(-1.0, "trip")}},
        {"watches": {"completed": core.Watch(1.0, "trip")}},
    ],
)
def test_senseless_setting_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(core.CoreError):
        core.Station(config(**changes), shaking(1.0))


# ---- any script at all --------------------------------------------------------------------------

LIMIT_M, SPEED_M_PER_S = 0.004, 0.5
ON_ITS_WAY = ("RAMP_IN", "RUNNING", "HOLD", "RAMP_OUT")


class AnyScript(RuleBasedStateMachine):
    """Commands, faults and stalls in any order."""

    def __init__(self) -> None:
        super().__init__()
        watches = {
            "position": core.Watch(LIMIT_M, "ramp-out"),
            "force": core.Watch(1e4, "trip"),
            "sensor_jump": core.Watch(0.01, "ramp-out"),
        }
        self.bench = Bench(changes={"watches": watches, "tare_ticks": 4, "ramp_in_ticks": 8})
        self.checked, self.last = 0, OFFSET_M
        self.bench.step()

    def note(self, action: Callable[[], core.StationTick], resets: bool = False) -> None:
        before = self.bench.station.state
        action()
        after = self.bench.station.state
        if before == "TRIPPED" and not resets:
            assert after == "TRIPPED"

    @rule(command=st.sampled_from(core.COMMANDS))
    def operator(self, command: core.Command) -> None:
        self.note(lambda: self.bench.step(command), resets=command == "reset")

    @rule(n=st.integers(1, 200))
    def wait(self, n: int) -> None:
        for _ in range(n):
            self.note(self.bench.step)

    @rule()
    def full_start(self) -> None:
        for command in ("zero", "none", "none", "none", "none", "none", "arm", "start"):
            self.note(lambda c=command: self.bench.step(c))  # type: ignore[misc]
        for _ in range(20):
            self.note(self.bench.step)

    @rule(n=st.integers(1, 25))
    def lose(self, n: int) -> None:
        for _ in range(n):
            self.note(lambda: self.bench.step(lost=True))

    @rule(n=st.integers(1, 40))
    def stall(self, n: int) -> None:
        self.note(lambda: self.bench.step(skipped=n))

    @rule(value=st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 0.03, -0.5]))
    def bad_displacement(self, value: float) -> None:
        self.note(lambda: self.bench.step(x_m=value))

    @rule(value=st.sampled_from([np.nan, np.inf, 1e300, 2e4]))
    def bad_force(self, value: float) -> None:
        self.note(lambda: self.bench.step(f_n=value))

    @precondition(lambda self: self.bench.station.state != "TRIPPED")
    @rule()
    def cable(self) -> None:
        self.note(lambda: self.bench.step(lost=True, link_down=True))

    @invariant()
    def ticks_add_up(self) -> None:
        station = self.bench.station
        assert station.ticks == len(self.bench.records) + station.skipped

    @invariant()
    def commands_are_finite_within_the_limit_and_no_leap(self) -> None:
        """Each one that was ever sent; what a trip repeats has been sent before."""
        tare = self.bench.station.tare[0]
        for x, state in self.bench.sent[self.checked :]:
            assert np.isfinite(x)
            if state in ON_ITS_WAY:
                assert abs(x - tare) <= LIMIT_M + 1e-12, state
            if state in ON_ITS_WAY:
                assert abs(x - self.last) <= SPEED_M_PER_S * H + 1e-12, state
            if state == "TRIPPED":
                assert x == self.last
            self.last = x
        self.checked = len(self.bench.sent)


TestAnyScript = AnyScript.TestCase
TestAnyScript.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


@given(skips=st.lists(st.integers(0, 30), min_size=1, max_size=60))
@settings(max_examples=50, deadline=None)
def test_executed_and_skipped_ticks_are_all_ticks(skips: list[int]) -> None:
    bench = Bench()
    for skipped in skips:
        bench.step(skipped=skipped)
    assert bench.station.ticks == len(skips) + sum(skips)
    assert bench.station.skipped == sum(skips)


# ---- the cause with its figures -----------------------------------------------------------------


def test_a_trip_keeps_the_value_met_and_the_limit_until_the_reset() -> None:
    bench = Bench(changes=watched("force", 500.0, "trip")).running(100)
    bench.until("TRIPPED")
    station = bench.station
    met = bench.rows()["f_meas_n"][-1]
    assert station.cause == "force"
    assert (station.cause_value, station.cause_limit) == (met, 500.0)
    for _ in range(60):
        bench.step()
    bench.step("reset")
    assert station.state == "IDLE"
    assert (station.cause, station.cause_value, station.cause_limit) == ("none", 0.0, 0.0)


def test_a_cause_without_a_number_has_none() -> None:
    bench = Bench().running(100)
    bench.step("trip")
    assert bench.station.cause == "signal"
    assert (bench.station.cause_value, bench.station.cause_limit) == (0.0, 0.0)


def test_the_fault_that_comes_after_a_stop_brings_its_own_figures() -> None:
    bench = Bench().running(700)
    bench.step("stop")
    assert bench.station.cause_limit == 0.0
    for _ in range(25):
        bench.step(lost=True)
    assert bench.station.cause == "link_lost"
    assert (bench.station.cause_value, bench.station.cause_limit) == (20.0, 20.0)
