"""What must not move and what must stop when something in the laboratory is not as it should be."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import loop_bench
import numpy as np
import pytest
from link_tools import users_table
from loop_bench import DELAY, FLAGS, K_N_PER_M, ORIGIN_M, STATE, Bench, H, watched
from rthyb_rt._core import ffi, lib
from test_live_replay import assert_the_same

from rthyb_rt import core
from rthyb_rt.core import loop, wire

BIAS_M = 0.002

TABLE = """VERSION ""
NS_ :
BS_:
BU_: PC
BO_ 512 SetValues: 4 PC
 SG_ x_cmd : 0|16@1- ({unit_mm},0) [0|0] "mm" PC
 SG_ seq : 16|4@1+ (1,0) [0|15] "" PC
 SG_ state : 20|4@1+ (1,0) [0|15] "" PC

BO_ 768 ActualValues: 12 PC
 SG_ x_meas : 0|32@1- (0.000001,0) [0|0] "mm" PC
 SG_ f_meas : 32|32@1- (0.001,0) [0|0] "N" PC
 SG_ count : 64|5@1+ (1,0) [0|31] "" PC
 SG_ status : 69|3@1+ (1,0) [0|7] "" PC
 SG_ echo : 72|4@1+ (1,0) [0|15] "" PC
"""


def table(folder: Path, unit_mm: float) -> wire.Codec:
    """Frames with numbers of few bits and a command in steps of ``unit_mm``."""
    return users_table(folder, TABLE.format(unit_mm=unit_mm))


def mounted(**sensors: core.SensorConfig) -> core.VirtualRig:
    specimen = (core.element("stiffness", k_n_per_m=K_N_PER_M),)
    servo = core.ServoConfig("pure-delay", delay_samples=DELAY)
    return core.VirtualRig(core.RigConfig(servo, specimen, **sensors))


@pytest.fixture
def biased(monkeypatch: pytest.MonkeyPatch) -> None:
    """The displacement reads 2 mm more than the drive was told."""
    off = core.SensorConfig(bias=BIAS_M)
    monkeypatch.setattr(loop_bench, "rig", lambda *_: mounted(displacement=off))


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as made:
        yield made


def targets(bench: Bench) -> np.ndarray:
    return np.asarray(bench.drive.log["target_m"])


def largest_step_m(bench: Bench, since: int) -> float:
    return float(np.abs(np.diff(targets(bench)[since - 1 :])).max())


# ---- START --------------------------------------------------------------------------------------


@pytest.mark.usefixtures("biased")
def test_start_goes_to_the_tare_once_without_a_leap_and_tests_do_not_wander_off() -> None:
    with Bench(seconds=0.2) as bench:
        bench.steps(20)
        stands = targets(bench)[-1] + BIAS_M  # where the first tare has its zero
        for allowed_m in (np.pi * BIAS_M / 256, 1e-8, 1e-8, 1e-8):
            bench.step("zero")
            bench.until("ZEROED")
            bench.step("arm")
            bench.steps(5)
            began = bench.drive.ticks
            bench.step("start")
            bench.until("RUNNING")
            assert largest_step_m(bench, began) < allowed_m
            bench.until("IDLE")
            bench.steps(20)
            assert targets(bench)[-1] == pytest.approx(stands, abs=1e-6)
        assert_the_same(bench)


# ---- RESET and release --------------------------------------------------------------------------


def test_reset_is_refused_while_the_drive_still_brakes(bench: Bench) -> None:
    bench.running(700)
    while abs(np.diff(targets(bench)[-2:])[0]) < 0.03 * H:
        bench.step()
    bench.step("trip")
    bench.steps(5)
    bench.step("reset")
    assert bench.refused
    assert bench.loop.state == "TRIPPED"
    bench.steps(200)
    began = bench.drive.ticks
    bench.step("reset")
    assert not bench.refused
    bench.steps(50)
    assert bench.drive.phase == "following"
    assert largest_step_m(bench, began) < 1e-7
    assert_the_same(bench)


def test_reset_without_a_fresh_reading_is_refused(bench: Bench) -> None:
    bench.running(500)
    bench.fault("drop", 10**6)
    bench.until("TRIPPED")
    bench.steps(600)
    bench.step("reset")
    assert bench.refused
    assert bench.loop.state == "TRIPPED"


def test_one_reading_after_a_silence_is_no_rest_that_a_reset_could_trust(bench: Bench) -> None:
    bench.running(500)
    bench.fault("drop", 800)
    bench.until("TRIPPED")
    while not bench.last_flags() & FLAGS["fresh"]:
        bench.step()
    bench.step("reset")
    assert bench.refused
    bench.steps(20)
    bench.step("reset")
    assert not bench.refused
    assert_the_same(bench)


@pytest.mark.usefixtures("biased")
def test_specimen_moved_while_the_drive_was_off_does_not_leap_when_it_is_released() -> None:
    with Bench() as bench:
        bench.running(700)
        bench.step("stop")
        bench.until("IDLE")
        bench.step("zero")  # from here on it is known how far command and reading lie apart
        bench.until("ZEROED")
        bench.step("stop")
        for _ in range(200):
            bench.drive.tick()  # hears nothing, stops by itself
        bench.drive._c.target_m += 0.03  # at the panel of the drive
        bench.drive._c.target1_m = bench.drive._c.target_m
        bench.drive.schedule([loop.Fault("drop-command", 0, bench.drive.ticks + 30)])
        began = bench.drive.ticks + 1
        bench.steps(30)
        assert bench.drive.phase == "stopped"
        bench.step("reset")
        assert not bench.refused
        bench.steps(30)
        assert bench.drive.phase == "following"
        assert largest_step_m(bench, began) < 1e-6
        assert_the_same(bench)


# ---- sensors ------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [0, 1, 3])
def test_jump_is_not_taken_after_lost_pairs_either(lost: int) -> None:
    with Bench(seconds=4.0, **watched("sensor_jump", 0.002, "ramp-out")) as bench:
        bench.running(300)
        bench.fault("drop", lost)
        bench.steps(lost)
        bench.fault("jump", 10**6, 0.05)
        bench.steps(15)
        rows = bench.rows()
        assert bench.loop.cause == "sensor_jump"
        assert np.abs(np.diff(rows["x_meas_m"][-30:])).max() < 0.001
        bench.until("TRIPPED")  # a sensor that stays there is none to come home by
        assert bench.loop.cause == "sensor_jump"
        assert_the_same(bench)


def test_new_level_that_is_only_indicated_is_taken_with_its_third_reading() -> None:
    with Bench(seconds=4.0, **watched("sensor_jump", 0.002, "indicate")) as bench:
        bench.running(300)
        bench.fault("jump", 10**6, 0.01)
        for fresh in (False, False, True, True):
            bench.step()
            assert bool(bench.last_flags() & FLAGS["fresh"]) == fresh
        assert bench.station.indicated == ["sensor_jump"]
        assert bench.loop.state == "RUNNING"
        assert_the_same(bench)


def test_displacement_that_leaps_to_and_fro_is_never_taken() -> None:
    with Bench(seconds=4.0, **watched("sensor_jump", 0.002, "indicate")) as bench:
        bench.running(300)
        for n in range(10):
            bench.fault("jump", 1, 0.03 * (-1) ** n)
            bench.step()
            assert bench.last_flags() & FLAGS["predicted"]


@pytest.mark.parametrize("bias_n", [0.0, 400.0, -400.0])
def test_saturated_cell_is_no_force_whatever_its_tare(
    bias_n: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = core.SensorConfig(bias=bias_n, range=1000.0)
    monkeypatch.setattr(loop_bench, "rig", lambda *_: mounted(force=cell))
    plain = loop_bench.config()
    ranged = dataclasses.replace(plain.controller, f_range_n=1000.0)
    monkeypatch.setattr(
        loop_bench, "config", lambda **_: dataclasses.replace(plain, controller=ranged)
    )
    with Bench(seconds=4.0) as bench:
        bench.running(0)
        bench.until("TRIPPED")
        rows = bench.rows()
        saturated = np.abs(rows["f_read_n"]) >= 1000.0
        assert saturated.sum() >= 20
        assert not np.any(rows["flags"][saturated] & FLAGS["fresh"])
        assert np.all(rows["code"][saturated] & core.STATUS["out_of_range"])
        assert bench.loop.cause == "link_lost"
        assert_the_same(bench)


# ---- the drive's own word -----------------------------------------------------------------------


def reading(count: int, status: int) -> wire.Reading:
    return wire.Reading(1e-3, 5.0, 0, count & 255, status)


@pytest.mark.parametrize("half", [False, True])
def test_stopped_counts_with_an_invalid_reading_and_without_the_other_half(half: bool) -> None:
    codec = wire.can()
    ours = wire.Wire(codec)
    for count in (1, 2):
        for frame in codec.encode_feedback(reading(count, 0)):
            ours.receive(frame)
    assert not status_of(ours) & 1
    frames = codec.encode_feedback(reading(3, 1 if half else 3))
    for frame in frames[:1] if half else frames:
        ours.receive(frame)
    assert status_of(ours) & 1
    assert status_of(ours) & 1, "its last word holds until there is another"
    for frame in codec.encode_feedback(reading(4, 0)):
        ours.receive(frame)
    assert not status_of(ours) & 1


def status_of(ours: wire.Wire) -> int:
    feedback = ffi.new("rthyb_feedback *")
    lib.rthyb_wire_take(ours.struct, feedback)
    return int(feedback.status)


@pytest.mark.parametrize("gap", [5, 8, 12, 15, 17])
def test_gap_is_a_gap_with_a_count_of_five_bits(gap: int, tmp_path: Path) -> None:
    with Bench(seconds=4.0, codec=table(tmp_path, 0.0001)) as bench:
        bench.running(300)
        before = bench.wire.counters()
        bench.fault("drop", gap)
        bench.steps(60)
        after = bench.wire.counters()
        assert after["stale"] - before["stale"] == gap
        assert after["reordered"] == before["reordered"]
        assert after["missed"] - before["missed"] == gap
        assert bench.loop.state == "RUNNING"


def test_command_that_the_wire_cannot_hold_trips(tmp_path: Path) -> None:
    codec = table(tmp_path, 0.0005)  # +-16.4 mm, of which 12.3 are the offset
    with Bench(seconds=4.0, codec=codec) as bench:
        bench.running(0)
        bench.until("TRIPPED")
        assert bench.loop.cause == "position"
        assert bench.loop.counters()["beyond"] == 1
        last = bench.rows()[-1]
        assert last["code"] == core.STATUS["position_limit"] | core.STATUS["trip"]
        assert np.count_nonzero(bench.rows()["flags"] & 1 << 11) == 1
        bench.steps(30)
        assert_the_same(bench)


# ---- limits -------------------------------------------------------------------------------------


def test_hold_that_comes_while_ramping_in_ramps_out() -> None:
    with Bench(seconds=4.0, ramp_in_ticks=1000, **watched("force", 1e3, "hold")) as bench:
        bench.steps(8)
        bench.step("zero")
        bench.until("ZEROED")
        bench.step("arm")
        bench.step("start")
        bench.steps(5)
        bench.fault("force", 500, 1e6)
        bench.step()
        assert (bench.loop.state, bench.loop.cause) == ("RAMP_OUT", "force")
        assert_the_same(bench)


@pytest.mark.parametrize("reaction", ["hold", "ramp-out"])
def test_force_on_the_way_out_trips_and_tracking_is_indicated(reaction: Any) -> None:
    watches = {"force": core.Watch(2e5, reaction), "tracking": core.Watch(0.02, reaction)}
    with Bench(seconds=4.0, watches=watches) as bench:
        bench.running(800)
        bench.step("stop")
        bench.steps(2)
        bench.fault("jump", 5, 0.05)
        bench.step()
        assert bench.loop.state == "RAMP_OUT"
        assert bench.station.indicated == ["tracking"]
        bench.steps(10)
        bench.fault("force", 1, 1e6)
        bench.step()
        assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "force")
        assert bench.records[-1]["code"][-1] & core.STATUS["trip"]
        assert_the_same(bench)


def test_force_that_ramped_a_test_out_may_fall_on_the_way_but_neither_stay_nor_grow() -> None:
    """It has a quarter of a second, and half as much again as its limit, before it trips."""
    for force_n, ticks in ((0.0, 0), (2e3, 256), (5e3, 1)):
        brisk = {} if ticks else {"path_velocity_m_per_s": 0.2, "path_acceleration_m_per_s2": 2.0}
        with Bench(seconds=4.0, **watched("force", 6e3, "ramp-out"), **brisk) as bench:
            bench.running(0)
            bench.until("RAMP_OUT", 9000)
            assert bench.loop.cause == "force"
            sign = np.sign(bench.rows()["f_meas_n"][-1])
            bench.fault("force", 60000, sign * force_n)
            bench.steps(max(ticks - 1, 0))
            assert bench.loop.state == "RAMP_OUT"
            bench.step()
            assert bench.loop.state == ("TRIPPED" if ticks else "RAMP_OUT")
            if not ticks:
                bench.until("IDLE")
            assert_the_same(bench)


def test_idle_is_not_reached_before_the_command_is_there() -> None:
    with Bench(seconds=6.0) as bench:
        bench.running(1500)
        slow = {"velocity_limit_m_per_s": 0.002, "path_velocity_m_per_s": 0.02}
        before = dataclasses.replace(core.Parameters.of(bench.config), **slow)
        bench.loop.set_parameters(before)
        bench.step("stop")
        bench.until("IDLE")
        there = targets(bench)[-1]
        bench.steps(300)
        assert np.abs(targets(bench)[-300:] - there).max() < 2e-6


def test_limit_of_the_command_cannot_be_switched_off_in_motion() -> None:
    with Bench(seconds=6.0) as bench:
        bench.running(800)
        set_ = core.Parameters.of(bench.config)
        published = []
        for velocity in (0.001, 0.0, 0.002):
            one = dataclasses.replace(set_, velocity_limit_m_per_s=velocity)
            published.append((bench.loop.set_parameters(one), one))
            bench.steps(100)
        assert bench.loop.counters()["parameters_refused"] == 1
        assert bench.loop.counters()["parameters"] == 2
        assert set(bench.rows()["generation"]) == {0, 1, 3}
        steps = np.abs(np.diff(bench.rows()["x_cmd_m"][-300:]))
        assert steps.max() <= 0.002 * H + 2e-9
        assert_the_same(bench, parameters=published)
        bench.step("stop")
        bench.until("IDLE", 60000)
        bench.loop.set_parameters(dataclasses.replace(set_, velocity_limit_m_per_s=0.0))
        bench.step()
        assert bench.loop.counters()["parameters"] == 3


@pytest.mark.parametrize(("before", "skipped", "lost"), [(11, 10, 21), (12, 9, 12)])
def test_no_row_says_tripped_while_the_test_runs_on(before: int, skipped: int, lost: int) -> None:
    with Bench(seconds=4.0) as bench:
        bench.running(500)
        bench.fault("drop", lost)
        bench.steps(before)
        bench.step(skipped=skipped)
        bench.steps(10)
        assert bench.loop.state == "RUNNING"
        assert not np.any(bench.rows()["state"] == STATE["TRIPPED"])
        assert not np.any(bench.rows()["code"] & core.STATUS["trip"])


# ---- the two clocks -----------------------------------------------------------------------------


@pytest.mark.parametrize("early", [0.4, 0.5, 0.6])
def test_sample_that_comes_as_the_tick_is_due_is_no_slip_however_long(early: float) -> None:
    with Bench() as bench:
        bench.steps(50)
        random = np.random.default_rng(1)
        done = bench.drive.ticks
        for n, is_early in enumerate(random.random(20000) < early):
            bench.drive.tick() if is_early and bench.drive.ticks == done + n else None
            bench.loop.beat()
            bench.loop.step()
            while bench.drive.ticks < done + n + 1:
                bench.drive.tick()
        assert bench.loop.counters()["slips"] == 0


# ---- another station at the same drive ----------------------------------------------------------


@pytest.mark.usefixtures("biased")
def test_station_that_takes_over_goes_on_with_the_last_command() -> None:
    with Bench(seconds=0.2) as bench:
        bench.running(0)
        bench.until("IDLE")
        bench.steps(30)
        began, first = bench.drive.ticks, len(bench.records)
        follower = core.Station(bench.config, bench.ag)
        bench.loop.load(follower, None)
        bench.station = follower
        bench.steps(40)
        assert bench.drive.phase == "following"
        assert largest_step_m(bench, began) == 0.0
        bench.records = bench.records[first:]
        assert_the_same(bench)


FORCE_RANGE_N = 5e4


@pytest.fixture
def ranged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The displacement reads 2 mm more than the drive was told, the load cell ends at 50 kN."""
    off = core.SensorConfig(bias=BIAS_M)
    monkeypatch.setattr(loop_bench, "rig", lambda *_: mounted(displacement=off))
    plain = loop_bench.config

    def made(**changes: Any) -> core.StationConfig:
        one = plain(**changes)
        controller = dataclasses.replace(one.controller, f_range_n=FORCE_RANGE_N)
        return dataclasses.replace(one, controller=controller)

    monkeypatch.setattr(loop_bench, "config", made)


def follower_of(bench: Bench) -> int:
    """Let another station take over in IDLE; the drive's first tick under it."""
    bench.running(0)
    bench.until("IDLE")
    bench.steps(30)
    began = bench.drive.ticks
    follower = core.Station(bench.config, bench.ag)
    bench.loop.load(follower, None)
    bench.station, bench.records = follower, []
    return began


@pytest.mark.usefixtures("ranged")
@pytest.mark.parametrize("meanwhile", ["stands", "was moved"])
def test_command_is_not_taken_over_from_before_a_reading_that_is_sound(meanwhile: str) -> None:
    """The load cell says nothing at first, and the drive is moved without a word of it."""
    with Bench(seconds=0.2) as bench:
        began = follower_of(bench)
        bench.fault("force", 12, 1e6)
        bench.steps(3)
        if meanwhile == "was moved":
            for name in ("wanted_m", "target_m", "target1_m"):
                setattr(bench.drive._c, name, getattr(bench.drive._c, name) + 0.02)
        stood = bench.drive.ticks
        bench.steps(49)
        rows = bench.rows()
        taken = np.flatnonzero(rows["flags"] & FLAGS["taken_over"])
        moved = np.abs(np.diff(targets(bench)[stood:])).max()
        assert (rows["flags"][:12] & FLAGS["not_sent"]).all()
        if meanwhile == "stands":
            assert taken.size == 1
            assert largest_step_m(bench, began) == 0.0
        else:
            assert taken.size == 0
            # To where it reads, which is its bias away, and not 20 mm back.
            assert moved == pytest.approx(BIAS_M, abs=2e-9)
        assert_the_same(bench)


@pytest.mark.usefixtures("biased")
def test_station_replaced_before_its_first_reading_passes_the_command_on() -> None:
    """Limits are reloaded, and a test is zeroed, while pairs are lost."""
    with Bench(seconds=0.2) as bench:
        began = follower_of(bench)
        bench.fault("drop", 4)
        bench.steps(2)
        second = core.Station(bench.config, bench.ag)
        bench.loop.load(second, None)
        bench.station, bench.records = second, []
        bench.steps(40)
        assert bench.drive.phase == "following"
        assert np.count_nonzero(bench.rows()["flags"] & FLAGS["taken_over"]) == 1
        assert largest_step_m(bench, began) == 0.0
        assert_the_same(bench)


def test_station_in_use_outlives_the_loads_that_nobody_asks_after() -> None:
    with Bench(seconds=0.2) as bench:
        bench.steps(30)
        for _ in range(3):
            station = core.Station(bench.config, bench.ag)
            in_use = weakref.ref(station)
            bench.loop.load(station, None)
            del station
            with pytest.raises(core.CoreError, match="not yet been taken over"):
                bench.loop.load(core.Station(bench.config, bench.ag), None)
            bench.steps(1)
            gc.collect()
            alive = in_use()
            assert alive is not None
            assert alive._c.tick == 1
            del alive


@pytest.mark.usefixtures("biased")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e300])
def test_hand_over_of_no_number_begins_at_the_reading_and_replays(bad: float) -> None:
    with Bench(seconds=0.2) as bench:
        bench.drive._c.phase = loop.PHASES.index("following")
        bench.drive_ticks(3)
        bench.loop.continue_from(loop.LastCommand(bad, ORIGIN_M + BIAS_M, 7, core.IDENTITY))
        bench.running(20)
        rows = bench.rows()
        assert not (rows["flags"] & FLAGS["taken_over"]).any()
        assert np.isfinite(targets(bench)).all()
        assert_the_same(bench)


# ---- the end of the way -------------------------------------------------------------------------


@pytest.mark.parametrize("limit_m", [0.003, 0.005, 0.0065])
def test_command_brakes_before_the_position_limit(
    limit_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = loop_bench.config
    most = 5.0

    def limited(**changes: Any) -> core.StationConfig:
        made = plain(**changes)
        controller = dataclasses.replace(made.controller, acceleration_limit_m_per_s2=most)
        return dataclasses.replace(made, controller=controller)

    monkeypatch.setattr(loop_bench, "config", limited)
    with Bench(seconds=4.0, **watched("position", limit_m, "ramp-out")) as bench:
        bench.running(0)
        bench.until("RAMP_OUT")
        bench.steps(60)
        x = targets(bench)
        assert bench.loop.cause == "position"
        assert np.abs(np.diff(x, 2)).max() / H**2 <= most * 1.01 + 4e-9 / H**2
        assert np.abs(bench.rows()["x_cmd_m"][100:]).max() <= limit_m + 1e-9


@pytest.mark.parametrize("acceleration", [0.0, 4.5])
def test_slow_command_is_not_frozen_by_a_coarse_wire(acceleration: float) -> None:
    """A DBC with 0.01 mm a bit, and a command that moves by less than half of that in a tick."""
    coarse, reached = 1e-5, []
    for step in (1e-9, coarse):
        motion = core.MotionConfig("prescribed")
        made = core.ControllerConfig(
            law=core.LawConfig(),
            rfc=core.RfcConfig(k_e_n_per_m=K_N_PER_M, enabled=False),
            motion=motion,
            lead_enabled=False,
            velocity_limit_m_per_s=4.8e-3,
            acceleration_limit_m_per_s2=acceleration,
        )
        controller = core.Controller(made)
        x = 0.0
        for _ in range(2048):
            controller.step(x, 0.0, 5e-3)
            x = round(controller.x_cmd_m / step) * step
            controller._c.axis[0].x_cmd = x
        reached.append(x)
    assert reached[0] == pytest.approx(5e-3, abs=1e-6)
    assert reached[1] == pytest.approx(5e-3, abs=coarse)
