"""The tick from wire to wire: loop, link and virtual drive, on the stepped clock.

Controller and drive speak real frames over an AF_UNIX socket pair (CAN frames) and over a pty
(serial packets). Every fault is asserted with the state, the first cause, the counters and the
frames that the drive saw.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_bench import (
    BUS_OFF,
    CAN_FRAME,
    CAN_MEDIA,
    DELAY,
    FLAGS,
    FORCE_BIAS_N,
    ORIGIN_M,
    STATE,
    Bench,
    H,
    assert_adds_up,
    assert_drive_was_treated_well,
    assert_tripped,
    config,
    rig,
    shaking,
    stop_begins,
    watched,
)
from recording_data import recording as made_up_recording
from rthyb_rt._core import lib
from test_live_replay import assert_the_same

from rthyb_rt import core
from rthyb_rt.core import loop, ticker, wire
from rthyb_rt.errors import RthybError
from rthyb_rt.record.ring import Ring, RingReader

BUS_STATE: Final = 0x2000_0200


@pytest.fixture(params=[*CAN_MEDIA, "pty"])
def medium(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=CAN_MEDIA)
def can_medium(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def bench(medium: str) -> Iterator[Bench]:
    with Bench(medium) as made:
        yield made


# ---- an ordinary day ----------------------------------------------------------------------------


def test_sunny_day_over_the_wire_goes_from_idle_back_to_idle(bench: Bench) -> None:
    bench.running(0)
    bench.until("RAMP_OUT")
    assert bench.loop.cause == "completed"
    bench.until("IDLE")
    bench.steps(50)
    rows = bench.rows()
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    assert set(rows["state"]) == {STATE[s] for s in core.STATES} - {
        STATE["HOLD"],
        STATE["TRIPPED"],
    }
    assert bench.station.tare == pytest.approx((ORIGIN_M, FORCE_BIAS_N), abs=1e-8)
    assert rows["x_num_m"][-1] == 0.0
    assert bench.drive.phase == "following"
    assert bench.loop.counters()["slips"] == 0
    assert bench.wire.counters()["pairs"] == rows.size
    assert_adds_up(bench)
    assert_drive_was_treated_well(bench)


def test_recorded_command_is_what_the_drive_decoded_to_the_last_bit(bench: Bench) -> None:
    bench.running(700)
    rows, log = bench.rows(), bench.drive.log
    begin = int(np.flatnonzero(rows["state"] == STATE["ARMED"])[0])
    decoded = log["x_m"][begin:] - bench.station.tare[0]
    np.testing.assert_array_equal(rows["x_cmd_m"][begin:], decoded)
    np.testing.assert_array_equal(log["target_m"][begin:], log["x_m"][begin:])
    assert np.ptp(decoded) > 1e-3


def test_record_has_due_time_echo_count_and_raw_reading_of_its_tick(bench: Bench) -> None:
    bench.running(100)
    rows, log = bench.rows(), bench.drive.log
    due = [n * 1953125 // 2 for n in range(rows.size)]
    np.testing.assert_array_equal(rows["due_ns"], due)
    np.testing.assert_array_equal(rows["count"], np.arange(rows.size) % 256)
    np.testing.assert_array_equal(rows["echo"], log["seq"] % 256)
    running = rows[rows["state"] == STATE["RUNNING"]]
    tare_m, tare_n = bench.station.tare
    np.testing.assert_array_equal(running["x_read_m"] - tare_m, running["x_meas_m"])
    np.testing.assert_array_equal(running["f_read_n"] - tare_n, running["f_meas_n"])


def test_running_part_is_what_the_virtual_test_computes(bench: Bench) -> None:
    bench.running(0)
    bench.until("RAMP_OUT")
    rows = bench.rows()
    rows = rows[rows["state"] == STATE["RUNNING"]]
    expected = np.zeros(rows.size, core.RECORD_DTYPE)
    core.Controller(config().controller).run_virtual(rig(0.0), shaking(2.0), expected)
    # The wire rounds displacement to 1 nm and force to 1 mN.
    np.testing.assert_allclose(rows["x_meas_m"], expected["x_meas_m"], atol=3e-7)
    np.testing.assert_array_equal(rows["ag_mps2"], expected["ag_mps2"])


@pytest.mark.parametrize("late", [0, 1, 3])
def test_alpha_minus_link_delay_is_the_rigs_own_delay(medium: str, late: int) -> None:
    law = core.LawConfig("alpha-beta", {"alpha0": 4.0, "beta0": 8.0})
    with Bench(medium, seconds=4.0, law=law) as bench:
        bench.drive.schedule([loop.Fault("delay", 0, 100000, late)])
        bench.running(0)
        bench.until("RAMP_OUT")
        running = bench.rows()[bench.rows()["state"] == STATE["RUNNING"]]
        assert bench.loop.link_delay == late
        assert running["alpha"][-1] - late == pytest.approx(DELAY, abs=0.1)


def test_every_record_reaches_the_ring(medium: str, tmp_path: Path) -> None:
    ring = Ring.create(tmp_path, made_up_recording(), capacity=4096)
    with Bench(medium, ring=ring) as bench, RingReader(ring.path) as reader:
        bench.running(50)
        bench.step(skipped=3)
        np.testing.assert_array_equal(reader.read().samples, bench.rows())
    ring.remove()


# ---- commands -----------------------------------------------------------------------------------


def test_command_is_answered_once_with_its_tick(can_medium: str) -> None:
    with Bench(can_medium) as bench:
        bench.steps(3)
        generation = bench.loop.command("start")
        assert generation == 1
        assert bench.loop.answer(1) is None
        assert bench.loop.command("zero") is None
        bench.step()
        assert bench.loop.answer(1) == (False, 3)
        assert bench.loop.counters()["refused"] == 1
        assert bench.loop.command("zero") == 2
        bench.step()
        assert bench.loop.answer(2) == (True, 4)


def test_trip_takes_the_place_of_a_command_that_waits(can_medium: str) -> None:
    with Bench(can_medium) as bench:
        bench.running()
        assert bench.loop.command("hold")
        assert bench.loop.command("trip")
        bench.step()
        assert_tripped(bench, "signal")


# ---- what the station was told, in the record ---------------------------------------------------

TOLD = ("slip", "lost", "down", "stopped", "silent", "refused")


def told(bench: Bench) -> set[str]:
    return {name for name in TOLD if bench.last_flags() & FLAGS[name]}


def test_flags_have_bits_of_their_own_as_in_the_core() -> None:
    for name, bit in core.FLAGS.items():
        assert bit == getattr(lib, f"RTHYB_F_{name.upper()}")
    assert sum(FLAGS.values()) < 1 << lib.RTHYB_F_COMMAND_BIT


@pytest.mark.parametrize("command", core.COMMANDS)
def test_record_has_the_operators_command_and_whether_it_was_refused(command: core.Command) -> None:
    with Bench() as bench:
        bench.running()
        bench.step(command)
        assert core.command_of(bench.last_flags()) == command
        assert told(bench) == (
            set() if command in ("none", "hold", "stop", "trip") else {"refused"}
        )
        bench.step()
        assert core.command_of(bench.last_flags()) == "none"


def test_number_of_no_command_is_refused() -> None:
    with pytest.raises(core.CoreError, match="no such command exists"):
        core.command_of(len(core.COMMANDS) << 24)


def test_pair_that_did_not_come_is_flagged_lost_and_one_that_was_refused_is_not(
    medium: str,
) -> None:
    with Bench(medium, **watched("sensor_jump", 0.003, "indicate")) as bench:
        bench.running()
        bench.fault("drop", 1)
        bench.step()
        assert told(bench) == {"lost"}
        bench.steps(5)
        assert told(bench) == set()
        bench.fault("jump", 1, 0.05)
        bench.step()
        assert bench.last_flags() & FLAGS["predicted"]
        assert told(bench) == set()
        read_m = float(bench.records[-1]["x_read_m"][-1])
        assert read_m - bench.station.tare[0] == pytest.approx(0.05, abs=0.01)


def test_blind_records_tell_nothing_of_their_tick(bench: Bench) -> None:
    bench.running()
    bench.drive_ticks(4)
    bench.drive.schedule([loop.Fault("drop", 0, 10**9)])
    bench.step("hold", skipped=3)
    flags = bench.records[-1]["flags"]
    assert np.all(flags[:3] < FLAGS["slip"])
    assert core.command_of(flags[3]) == "hold"


@pytest.mark.parametrize("skipped", [0, 2])
def test_count_that_slips_for_good_is_counted_and_flagged_once(bench: Bench, skipped: int) -> None:
    bench.running()
    bench.drive_ticks()  # the drive's clock is fast: two samples in one tick
    bench.step(skipped=skipped)
    # A tick after others that were slept through says nothing of the drive's clock.
    more = loop.SLIP_VOTES - (0 if skipped else 1)
    for _ in range(more - 1):
        bench.step()
        assert told(bench) == set()
    bench.step()
    assert told(bench) == {"slip"}
    for _ in range(2 * loop.SLIP_VOTES):
        bench.step()
        assert told(bench) == set()
    assert bench.loop.counters()["slips"] == 1


def test_sample_that_falls_now_before_and_now_behind_the_tick_is_no_slip(bench: Bench) -> None:
    bench.running()
    for _ in range(2 * loop.SLIP_VOTES):
        bench.step()
        bench.drive_ticks(2)
        bench.tick()
        bench.tick()
    bench.steps(10)
    assert bench.loop.counters()["slips"] == 0
    # One more that stays, in the midst of it: one slip, whoever comes first.
    bench.drive_ticks(1)
    for _ in range(2 * loop.SLIP_VOTES):
        bench.steps(3)
        bench.drive_ticks(2)
        bench.tick()
        bench.tick()
    bench.steps(10)
    assert bench.loop.counters()["slips"] == 1


def test_late_heartbeat_is_flagged_while_it_is_late() -> None:
    with Bench(seconds=4.0) as bench:
        bench.running()
        for _ in range(loop.HEARTBEAT_TICKS):
            bench.step(beat=False)
        assert told(bench) == set()
        bench.step(beat=False)
        assert told(bench) == {"silent"}
        bench.step()
        assert told(bench) == set()


def test_link_that_is_down_is_flagged(bench: Bench) -> None:
    bench.running()
    bench.unplug()
    bench.far.close()
    for _ in range(3):
        bench.tick()
    assert told(bench) == {"lost", "down"}


# ---- a drive that has stopped by itself ---------------------------------------------------------


def test_drive_that_stops_by_itself_trips_with_a_cause_of_its_own(bench: Bench) -> None:
    bench.running()
    bench.fault("drop-command", 20)
    for _ in range(30):
        bench.step()
        if bench.loop.state != "RUNNING":
            break
    assert told(bench) == {"stopped"}
    assert bench.loop.cause == "drive_stopped"
    assert bench.loop.cause_tick == bench.rows()["tick"][-1] == bench.station.cause_tick
    assert bench.loop.counters()["stopped"] == 2  # the first tick of the day, and this one
    assert bench.loop.counters()["down"] == 0
    bench.steps(60)
    assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "drive_stopped")
    assert bench.drive.phase == "stopped"
    log = bench.drive.log
    frames = log["x_m"][(log["state"] == STATE["TRIPPED"]) & (log["frames"] > 0)]
    assert frames.size == 3
    assert np.ptp(frames) == 0.0
    assert_adds_up(bench)


def test_zero_is_refused_until_the_drive_says_that_it_follows(bench: Bench) -> None:
    bench.running()
    bench.step("trip")
    bench.steps(60)
    bench.step("reset")
    assert told(bench) == {"stopped"}
    bench.drive.schedule([loop.Fault("drop-command", 0, bench.drive.ticks + 25)])
    for _ in range(24):
        bench.step("zero")
        assert bench.refused
        assert told(bench) == {"stopped", "refused"}
    # All three commands that told it were lost: it is reset once more, at rest.
    bench.step("reset")
    assert not bench.refused
    bench.fault("drop", 1)
    bench.step("zero")
    assert bench.refused, "it follows, but has not said so yet"
    assert told(bench) == {"stopped", "refused", "lost"}
    bench.step("zero")
    assert not bench.refused
    assert bench.loop.state == "IDLE"
    bench.until("ZEROED")


# ---- calibration --------------------------------------------------------------------------------

MOUNTED = core.WireCalibration(
    x_gain=-2.0, x_offset_m=0.004, f_gain=-0.5, f_offset_n=12.0, cmd_gain=-0.5, cmd_offset_m=0.002
)
"""The sensor the other way round and at half scale; the command to match it."""


def test_rig_behind_a_calibration_runs_the_same_test(medium: str) -> None:
    with Bench(medium, calibration=MOUNTED) as bench, Bench(medium) as plain:
        for each in (bench, plain):
            each.running(0)
            each.until("RAMP_OUT")
        ours, theirs = bench.rows(), plain.rows()
        np.testing.assert_allclose(ours["x_meas_m"], theirs["x_meas_m"], atol=2e-8)
        np.testing.assert_allclose(ours["f_meas_n"], theirs["f_meas_n"], atol=2e-2)
        np.testing.assert_allclose(
            bench.drive.log["target_m"], plain.drive.log["target_m"], atol=2e-8
        )
        begin = 10
        for name, atol in (("x_read_m", 2e-8), ("f_read_n", 2e-2)):
            np.testing.assert_allclose(ours[name][begin:], theirs[name][begin:], atol=atol)
        read_m = -2.0 * bench.drive.log["read_x_m"][begin:] + 0.004
        np.testing.assert_allclose(read_m, ours["x_read_m"][begin:], atol=2e-8)
        wire_m = bench.drive.log["x_m"][begin:]
        np.testing.assert_allclose(bench.drive.log["target_m"][begin:], (wire_m - 0.002) / -0.5)
        assert_adds_up(bench)
        assert_drive_was_treated_well(bench)


def test_command_behind_a_calibration_is_recorded_as_the_drive_has_it() -> None:
    with Bench(calibration=MOUNTED) as bench:
        bench.running(700)
        rows, log = bench.rows(), bench.drive.log
        begin = int(np.flatnonzero(rows["state"] == STATE["ARMED"])[0])
        had = log["target_m"][begin:] - bench.station.tare[0]
        np.testing.assert_array_equal(rows["x_cmd_m"][begin:], had)
        assert np.ptp(had) > 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {"x_gain": 0.0},
        {"f_gain": float("nan")},
        {"cmd_gain": float("inf")},
        {"x_gain": 1e10},
        {"x_offset_m": float("nan")},
        {"cmd_offset_m": 1e4},
        {"f_offset_n": float("-inf")},
    ],
)
def test_senseless_calibration_is_refused(changes: dict[str, float]) -> None:
    with pytest.raises(core.CoreError, match="gain"):
        Bench(calibration=core.WireCalibration(**changes))


# ---- faults, row by row -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "counter"),
    [
        ("drop", "missed"),
        ("delay", "superseded"),
        ("duplicate", "duplicate"),
        ("reorder", "reordered"),
        ("corrupt", "bad_crc"),
    ],
)
def test_one_bad_feedback_is_predicted_counted_and_flagged(
    bench: Bench, kind: loop.FaultKind, counter: str
) -> None:
    bench.running()
    before = bench.wire.counters()[counter]
    bench.fault(kind, 1)
    bench.step()
    predicted = kind != "duplicate"
    assert bool(bench.last_flags() & FLAGS["predicted"]) == predicted
    bench.step()
    assert bench.last_flags() & FLAGS["fresh"]
    bench.steps(20)
    assert bench.loop.state == "RUNNING"
    assert bench.loop.cause == "none"
    assert bench.wire.counters()[counter] > before
    assert bench.loop.counters()["slips"] == 0
    running = bench.rows()[bench.rows()["state"] == STATE["RUNNING"]]
    np.testing.assert_array_equal(running["ag_mps2"], shaking(2.0)[: running.size])
    assert_adds_up(bench)
    assert_drive_was_treated_well(bench)


def test_lone_displacement_frame_is_a_lost_sample(can_medium: str) -> None:
    with Bench(can_medium) as bench:
        bench.running()
        bench.fault("drop-force", 1)
        bench.step()
        assert bench.last_flags() & FLAGS["predicted"]
        bench.step()
        assert bench.last_flags() & FLAGS["fresh"]
        assert bench.wire.counters()["lone"] == 1
        assert bench.loop.state == "RUNNING"


@pytest.mark.parametrize("kind", ["drop", "corrupt"])
def test_three_to_nineteen_bad_feedbacks_freeze_alpha(bench: Bench, kind: loop.FaultKind) -> None:
    bench.running()
    bench.fault(kind, 19)
    for n in range(19):
        bench.step()
        assert bool(bench.last_flags() & FLAGS["frozen"]) == (n >= 2)
    bench.step()
    assert bench.last_flags() & FLAGS["fresh"]
    assert bench.loop.state == "RUNNING"
    assert_drive_was_treated_well(bench)


@pytest.mark.parametrize("kind", ["drop", "corrupt"])
def test_twenty_bad_feedbacks_trip_link_lost(bench: Bench, kind: loop.FaultKind) -> None:
    bench.running()
    bench.fault(kind, 20)
    bench.steps(19)
    assert bench.loop.state == "RUNNING"
    bench.step()
    assert_tripped(bench, "link_lost")


def test_drive_without_power_for_long_trips_link_lost(bench: Bench) -> None:
    bench.running()
    bench.fault("silence", 40)
    bench.steps(20)
    assert_tripped(bench, "link_lost", drive_listens=False)


def test_reading_that_is_no_number_trips_and_is_never_sent(bench: Bench) -> None:
    bench.running()
    bench.fault("not-finite", 1)
    bench.step()
    last = bench.records[-1][-1]
    assert np.isnan(last["x_read_m"])
    assert bench.wire.counters()["not_finite"] == 1
    assert np.isfinite(last["x_meas_m"])
    assert_tripped(bench, "not_finite")


def test_stuck_sensor_ramps_out(medium: str) -> None:
    with Bench(medium, **watched("sensor_stuck", 100, "ramp-out")) as bench:
        bench.running(700)
        bench.fault("stuck", 120)
        bench.steps(120)
        assert bench.loop.state == "RAMP_OUT"
        assert bench.loop.cause == "sensor_stuck"
        bench.until("IDLE")
        assert_drive_was_treated_well(bench)


def test_jumping_sensor_ramps_out_and_the_jump_is_not_taken(medium: str) -> None:
    with Bench(medium, **watched("sensor_jump", 0.003, "ramp-out")) as bench:
        bench.running()
        bench.fault("jump", 1, 0.05)
        bench.step()
        assert bench.loop.state == "RAMP_OUT"
        assert bench.loop.cause == "sensor_jump"
        assert abs(bench.records[-1]["x_meas_m"][-1]) < 0.02
        bench.until("IDLE")
        assert_drive_was_treated_well(bench)


def test_force_limit_trips(medium: str) -> None:
    with Bench(medium, **watched("force", 5e4, "trip")) as bench:
        bench.running()
        bench.fault("force", 1, 6e4)
        bench.step()
        assert_tripped(bench, "force")


def test_other_end_that_closes_trips_link_down(bench: Bench) -> None:
    bench.running()
    bench.unplug()
    bench.far.close()
    for _ in range(3):
        bench.tick()
    assert bench.loop.state == "TRIPPED"
    assert bench.loop.cause == "link_down"
    assert bench.link.down in ("hung-up", "device-gone", "network-down")
    for _ in range(50):
        bench.tick()
    assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "link_down")
    counters = bench.loop.counters()
    assert counters["not_sent"] == 3
    assert counters["down"] > 50
    assert_adds_up(bench)
    assert_drive_was_treated_well(bench)


def test_bus_off_trips_and_stays_tripped_when_the_bus_is_back(can_medium: str) -> None:
    with Bench(can_medium) as bench:
        bench.running()
        bench.drive_ticks()
        os.write(bench.ends[1], CAN_FRAME.pack(BUS_OFF, 8, bytes(8)))
        bench.tick()
        assert bench.link.down == "bus-off"
        assert bench.link.counters()["error_frames"] == 1
        assert bench.loop.state == "TRIPPED"
        bench.step()
        assert bench.link.down == "up"
        assert_tripped(bench, "link_down")


def test_bus_off_that_is_over_within_a_tick_trips_all_the_same(can_medium: str) -> None:
    with Bench(can_medium) as bench:
        bench.running()
        os.write(bench.ends[1], CAN_FRAME.pack(BUS_OFF, 8, bytes(8)))
        bench.step()
        assert bench.link.down == "up"
        assert_tripped(bench, "link_down")


@pytest.mark.parametrize("size", [1, 15, 17, 71, 73, 100])
def test_packet_that_is_no_can_frame_is_passed_over(size: int) -> None:
    with Bench() as bench:
        bench.running()
        os.write(bench.ends[1], bytes(size))
        bench.steps(5)
        assert bench.loop.state == "RUNNING"
        assert bench.wire.counters()["other_id"] == 0


def test_frame_whose_length_is_a_lie_is_not_read_beyond_its_end() -> None:
    with Bench() as bench:
        bench.running()
        os.write(bench.ends[1], CAN_FRAME.pack(wire.ACT_FB, 255, bytes(8)))
        bench.steps(5)
        assert bench.wire.counters()["bad_length"] == 1
        assert bench.loop.state == "RUNNING"


def test_error_report_that_is_not_bus_off_is_counted_and_nothing_else(can_medium: str) -> None:
    with Bench(can_medium) as bench:
        bench.running()
        before = bench.loop.counters()["down"]
        os.write(bench.ends[1], CAN_FRAME.pack(BUS_STATE, 8, bytes(8)))
        bench.steps(5)
        assert bench.link.counters()["error_frames"] == 1
        assert bench.loop.state == "RUNNING"
        assert bench.loop.counters()["down"] == before


def test_full_send_queue_is_a_lost_command_and_never_blocks() -> None:
    with Bench(send_buffer=1) as bench:
        bench.running(700)
        for _ in range(15):  # the drive does not read meanwhile
            bench.tick()
        assert bench.loop.state == "RUNNING"
        lost = bench.link.counters()["no_room"]
        assert 0 < lost < 15
        assert bench.loop.counters()["not_sent"] == lost
        flagged = bench.rows()[-lost:]
        assert (flagged["flags"] & FLAGS["not_sent"]).all()
        assert np.ptp(flagged["x_cmd_m"][1:]) == 0.0
        bench.steps(30)
        rows, log = bench.rows(), bench.drive.log
        assert rows["x_cmd_m"][-1] == log["x_m"][-1] - bench.station.tare[0]
        steps = np.abs(np.diff(log["target_m"][log["frames"] == 1]))
        assert steps.max() <= 0.5 * H + 2e-9
        assert bench.loop.state == "RUNNING"
        assert_adds_up(bench)


def test_drive_that_hears_nothing_stops_and_the_controller_trips(bench: Bench) -> None:
    bench.running()
    bench.fault("drop-command", 40)
    bench.steps(19)
    assert bench.drive.phase == "following"
    bench.step()
    assert bench.drive.phase in ("stopping", "stopped")
    assert bench.loop.state == "TRIPPED"
    bench.steps(40)
    assert bench.loop.cause == "drive_stopped"
    assert bench.drive.phase == "stopped"


def test_controller_that_is_killed_leaves_a_drive_that_stops_by_its_20th_tick(bench: Bench) -> None:
    bench.running(700)
    last = bench.drive.ticks
    bench.drive_ticks(100)
    assert stop_begins(bench) == last + loop.WATCHDOG_TICKS
    assert bench.drive.phase == "stopped"


def test_drive_brakes_at_its_own_deceleration_when_told_of_a_trip(bench: Bench) -> None:
    bench.running(700)
    bench.step("trip")
    assert_tripped(bench, "signal")
    log = bench.drive.log
    begin = stop_begins(bench)
    velocity = np.diff(log["target_m"])[begin - 2 : begin + 60] / H
    assert abs(velocity[0]) > 5e-3
    braking = velocity[: np.argmax(velocity == 0.0)]
    np.testing.assert_allclose(np.diff(np.abs(braking[:-1])), -1.0 * H, atol=1e-9)


def tell(bench: Bench, seq: int, state: str, x_m: float = 0.05) -> None:
    """A command that does not come from the loop."""
    number = (STATE | {name: raw for raw, name in wire.NOTICES.items()})[state]
    frame, _ = wire.can().encode_setpoint(wire.Setpoint(x_m, seq % 65536, number))
    os.write(bench.ends[0], CAN_FRAME.pack(frame.id, len(frame.data), frame.data))


def test_old_and_repeated_commands_neither_move_the_drive_nor_keep_it_going(
    can_medium: str,
) -> None:
    with Bench(can_medium) as bench:
        bench.running(700)
        bench.drive_ticks()
        last, begin = int(bench.drive.log["seq"][-1]), bench.drive.ticks
        for n in range(30):
            tell(bench, last - n, "RUNNING")
            bench.drive_ticks()
        assert stop_begins(bench) == begin - 1 + loop.WATCHDOG_TICKS
        assert np.abs(np.diff(bench.drive.log["target_m"][begin - 1 :])).max() < 1e-4


@pytest.mark.parametrize("first_seq", [1, 700])
def test_drive_that_stopped_by_itself_waits_for_a_reset_whoever_commands(
    can_medium: str, first_seq: int
) -> None:
    """It followed again on the first fresh command in state IDLE: six ticks after a new start."""
    with Bench(can_medium) as bench:
        bench.running(700)
        bench.drive_ticks(100)
        stands, last = bench.drive.log["target_m"][-1], int(bench.drive.log["seq"][-1])
        for n, state in enumerate(("RUNNING", "TRIPPED", "ZEROED", "RAMP_IN", "LEAVING")):
            tell(bench, last + 1 + n, state)
            bench.drive_ticks()
            assert bench.drive.phase == "stopped"
        # Another controller that has restarted, for a second.
        for n in range(1024):
            tell(bench, first_seq + n, "IDLE")
            bench.drive_ticks()
        assert bench.drive.phase == "stopped"
        assert bench.drive.latched
        assert bench.drive.log["target_m"][-1] == stands
        tell(bench, first_seq + 1023, "RESET")
        bench.drive_ticks()
        assert bench.drive.phase == "stopped", "no fresh command"
        tell(bench, first_seq + 1024, "RESET", x_m=float(stands))
        bench.drive_ticks()
        assert (bench.drive.phase, bench.drive.latched) == ("following", False)


def test_reset_that_comes_while_the_drive_still_brakes_does_not_have_it_follow(
    can_medium: str,
) -> None:
    with Bench(can_medium) as bench:
        bench.running(700)
        bench.drive._c.stop_decel_m_per_s2 = 1e-2
        tell(bench, int(bench.drive.log["seq"][-1]) + 2, "TRIPPED")
        bench.drive_ticks()
        assert bench.drive.phase == "stopping"
        tell(bench, int(bench.drive.log["seq"][-1]) + 1, "RESET")
        bench.drive_ticks()
        assert bench.drive.phase in ("stopping", "stopped")
        bench.drive_ticks(20_000)
        assert (bench.drive.phase, bench.drive.latched) == ("stopped", True)


def test_drive_that_was_told_the_silence_is_meant_follows_the_next_controller(
    can_medium: str,
) -> None:
    with Bench(can_medium) as bench:
        bench.steps(50)
        bench.loop.stop()
        bench.loop.leave()
        bench.drive_ticks(5)
        assert bench.drive.phase == "following", "it stands, and hears that this is meant"
        assert bench.drive.received_state == "LEAVING"
        bench.drive_ticks(loop.WATCHDOG_TICKS)
        assert (bench.drive.phase, bench.drive.latched) == ("stopped", False)
        tell(bench, 1, "IDLE", x_m=float(bench.drive.log["target_m"][-1]))
        bench.drive_ticks()
        assert bench.drive.phase == "following"


def test_nothing_that_moves_takes_leave(bench: Bench) -> None:
    bench.running(300)
    sent = int(bench.wire.struct.seq)
    bench.loop.leave()
    assert int(bench.wire.struct.seq) == sent


def test_reset_at_rest_is_for_a_drive_that_has_stopped(bench: Bench) -> None:
    bench.steps(100)
    bench.step("reset")
    assert bench.refused
    bench.drive_ticks(loop.WATCHDOG_TICKS + 40)
    bench.steps(40)
    assert told(bench) == {"stopped"}
    bench.step("zero")
    assert bench.refused
    bench.step("reset")
    assert not bench.refused
    bench.steps(3)
    assert told(bench) == set()
    bench.step("zero")
    assert not bench.refused
    bench.until("ZEROED")


# ---- what no status byte tells ------------------------------------------------------------------


def test_path_that_takes_no_command_ends_the_test_of_a_drive_without_status() -> None:
    """It went on for 6,266 ticks: readings came, and nobody said that the drive stood."""
    with Bench(seconds=8.0, send_buffer=1) as bench:
        bench.running(700)
        last = bench.drive.log[-1]
        for n in range(2000):
            # Its frames go out as ever, without a word of a stop; nobody reads the commands.
            reading = wire.Reading(
                last["read_x_m"], last["read_f_n"], last["seq"] % 256, (bench.drive.ticks + n) % 256
            )
            for frame in wire.can().encode_feedback(reading):
                os.write(bench.ends[1], CAN_FRAME.pack(frame.id, len(frame.data), frame.data))
            bench.tick()
            if bench.loop.state == "TRIPPED":
                break
        assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "link_down")
        assert bench.link.counters()["no_room"] <= loop.WATCHDOG_TICKS + 3
        assert_adds_up(bench)


@pytest.mark.parametrize(("ticks", "state"), [(30, "RUNNING"), (40, "TRIPPED")])
def test_feedback_that_grows_old_on_the_way_counts_as_lost(
    bench: Bench, ticks: int, state: str
) -> None:
    """Its readings are fresh; what the drive acts on is not."""
    bench.running(300)
    for delay in range(10, ticks + 1, 10):
        bench.fault("delay", 10**6, delay)
        bench.steps(60)
    assert bench.loop.state == state
    if state == "TRIPPED":
        assert bench.loop.cause == "link_lost"
        assert bench.loop.counters()["belated"] > 0


@pytest.mark.parametrize(("asleep_s", "state"), [(0.05, "RUNNING"), (2.0, "TRIPPED")])
def test_pc_that_was_suspended_does_not_go_on_where_it_was(
    medium: str, asleep_s: float, state: str
) -> None:
    """The clock of the ticks stood still meanwhile: not one of them was skipped."""
    with Bench(medium, paced=False) as bench:  # as at a drive that does not wait
        bench.running(300)
        bench.loop._ticker.asleep_ns -= round(asleep_s * 1e9)
        bench.step()
        assert bench.loop.state == state
        assert bench.loop.counters()["suspended"] == (state == "TRIPPED")
        if state == "TRIPPED":
            assert bench.loop.cause == "stalled"
            assert_the_same(bench)


# ---- overruns -----------------------------------------------------------------------------------


def test_one_overrun_is_skipped_and_counted(bench: Bench) -> None:
    bench.running()
    bench.step(skipped=1)
    last = bench.records[-1]
    assert last.size == 2
    assert last["flags"][0] & FLAGS["blind"]
    assert last["flags"][0] & FLAGS["not_sent"]
    bench.steps(20)
    rows = bench.rows()
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    np.testing.assert_array_equal(rows["due_ns"], rows["tick"].astype(np.int64) * 1953125 // 2)
    assert bench.loop.state == "RUNNING"
    assert bench.loop.counters()["slips"] == 0
    assert_adds_up(bench)
    assert_drive_was_treated_well(bench)


def test_burst_of_stalls_ramps_out(bench: Bench) -> None:
    bench.running()
    for _ in range(8):
        bench.step(skipped=8)
    assert bench.loop.cause == "skips"
    assert bench.loop.state == "RAMP_OUT"
    bench.until("IDLE")
    assert_adds_up(bench)
    assert_drive_was_treated_well(bench)


@pytest.mark.parametrize("skipped", [20, 60])
def test_stopped_process_trips_stalled_without_a_burst(bench: Bench, skipped: int) -> None:
    bench.running()
    bench.step(skipped=skipped)
    assert bench.loop.state == "TRIPPED"
    assert bench.loop.cause == "stalled"
    bench.steps(60)
    counts = bench.loop.counts
    assert counts.executed + counts.skipped == counts.elapsed
    assert counts.longest_skip == skipped
    assert_drive_was_treated_well(bench)
    assert bench.drive.phase == "stopped"
    assert bench.drive.log["silent"][stop_begins(bench)] == loop.WATCHDOG_TICKS


def test_silent_operators_side_ramps_out_after_a_second(medium: str) -> None:
    with Bench(medium, seconds=4.0) as bench:
        bench.running()
        for _ in range(loop.HEARTBEAT_TICKS):
            bench.step(beat=False)
        assert bench.loop.state == "RUNNING"
        bench.step(beat=False)
        assert bench.loop.state == "RAMP_OUT"
        assert bench.loop.cause == "heartbeat"
        assert bench.loop.counters()["late_heartbeats"] == 1
        bench.until("IDLE")


def test_after_reset_the_drive_follows_again_and_a_test_can_be_run(bench: Bench) -> None:
    bench.running()
    bench.step("trip")
    bench.steps(100)
    stands = bench.drive.log["target_m"][-1]
    bench.step("reset")
    bench.steps(20)
    assert bench.loop.state == "IDLE"
    assert bench.drive.phase == "following"
    assert bench.drive.log["target_m"][-1] == pytest.approx(stands, abs=1e-8)
    bench.running(0)
    bench.until("IDLE")
    assert bench.loop.cause == "completed"


@given(
    script=st.lists(
        st.tuples(
            st.sampled_from(["none", "zero", "arm", "start", "hold", "resume", "stop", "reset"]),
            st.integers(0, 24),
            st.sampled_from(["drop", "corrupt", "duplicate", "reorder", "jump", "delay"]),
            st.integers(1, 30),
        ),
        max_size=12,
    )
)
@settings(max_examples=40, deadline=None)
def test_any_script_adds_up_and_no_burst_ever_leaves(script: list[Any]) -> None:
    with Bench(seconds=0.5, tare_ticks=4, ramp_in_ticks=8) as bench:
        bench.steps(3)
        for command, skipped, kind, ticks in script:
            bench.fault(kind, ticks, 2.0)
            bench.step(command, skipped=skipped)
            bench.steps(40)
            log = bench.drive.log
            assert log["frames"].max() <= 1
            assert np.isfinite(log["target_m"]).all()
        counts = bench.loop.counts
        assert counts.executed + counts.skipped == counts.elapsed
        assert counts.elapsed == bench.drive.ticks


# ---- the link alone -----------------------------------------------------------------------------


def test_stream_that_would_make_a_reader_wait_is_refused() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs, pytest.raises(RthybError, match="O_NONBLOCK"):
        loop.Link("stream", ours.fileno())


def test_closed_descriptor_is_refused() -> None:
    with pytest.raises(RthybError, match="Bad file descriptor"):
        loop.Link("can", 9999)


def test_packet_torn_by_a_full_queue_costs_that_packet_alone() -> None:
    with Bench("pty") as bench:
        bench.steps(3)
        while bench.link.counters()["no_room"] == 0:  # nobody reads
            bench.tick()
        sent, total = bench.link.counters()["pieces_out"], bench.link.counters()["bytes_out"]
        assert total > lib.RTHYB_SERIAL_COMMAND * sent, "the queue took whole packets only"
        theirs, got = bench.ends[1], bytearray()
        got += read_all(theirs, total - bench.far.counters()["bytes_in"])
        for _ in range(5):
            bench.tick()
        got += read_all(theirs, bench.link.counters()["bytes_out"] - total)
        verdicts = [verdict for verdict, _ in wire.Deframer().feed(bytes(got))]
        assert verdicts[-5:] == [wire.VERDICTS["packet"]] * 5
        bad = [verdict for verdict in verdicts if verdict != wire.VERDICTS["packet"]]
        assert len(bad) == 1
        assert_adds_up(bench)


def read_all(fd: int, size: int) -> bytes:
    """So many bytes of a pty, whenever the kernel brings them."""
    got, end = bytearray(), time.monotonic() + 10.0
    while len(got) < size:
        assert time.monotonic() < end, f"{len(got)} of {size} bytes came"
        try:
            got += os.read(fd, size - len(got))
        except BlockingIOError:
            time.sleep(0.001)
    return bytes(got)


def test_senseless_fault_is_refused_and_the_old_schedule_stays() -> None:
    with Bench() as bench, pytest.raises(core.CoreError):
        bench.fault("delay", 1, 64.0)


def test_drive_that_cannot_brake_is_refused() -> None:
    with Bench() as bench, pytest.raises(core.CoreError):
        loop.Drive(rig(), wire.can(), bench.far, stop_decel_m_per_s2=0.0)


@pytest.mark.parametrize("ppm", [100.0, -100.0, 0.3])
def test_clock_of_the_drive_drifts_by_so_many_ppm(ppm: float) -> None:
    with Bench() as bench:
        drive = loop.Drive(rig(), wire.can(), bench.far, drift_ppm=ppm)
        clock = ticker.Ticker("stepped", 1_000_000_000)
        thread = threading.Thread(target=drive.run, args=(clock,))
        thread.start()
        clock.grant(1024)
        while drive.ticks < 1024:
            time.sleep(0.001)
        clock.stop()
        thread.join()
        assert clock.due_ns(1024) == pytest.approx(2_000_000_000 - ppm * 1e3, abs=1.0)


@pytest.mark.parametrize("ppm", [200.0, float("nan")])
def test_clock_that_drifts_beyond_what_can_be_followed_is_refused(ppm: float) -> None:
    with Bench() as bench, pytest.raises(core.CoreError, match="ppm"):
        loop.Drive(rig(), wire.can(), bench.far, drift_ppm=ppm)


# ---- the host clock -----------------------------------------------------------------------------


def test_two_threads_with_clocks_of_their_own_exchange_for_two_seconds() -> None:
    with Bench(clock="host") as bench:
        clock = ticker.Ticker("host", ticker.now_ns() + 10_000_000)
        drive = threading.Thread(target=bench.drive.run, args=(clock,))
        drive.start()
        bench.loop.start(priority=0)
        end = time.monotonic() + 2.0
        # On a machine that stalls, until it has lasted long enough all the same.
        while time.monotonic() < end or (
            bench.loop.counts.elapsed <= 1000 and time.monotonic() < end + 60.0
        ):
            bench.loop.beat()
            time.sleep(0.05)
        bench.loop.stop()
        time.sleep(0.05)
        clock.stop()
        drive.join()
        ticker.unlock_memory()
        counts, counters = bench.loop.counts, bench.loop.counters()
        assert counts.elapsed > 1000
        assert counts.executed + counts.skipped == counts.elapsed
        assert counters["sent"] == bench.link.counters()["pieces_out"]
        assert bench.loop.wake.count == counts.executed
        assert bench.loop.sent.count == counters["sent"]
        assert bench.loop.usage()["major_faults"] == 0
        log = bench.drive.log
        # A drive that was asleep itself finds what came meanwhile; the controller never sends two.
        assert int(log["frames"].sum()) == counters["sent"]
        assert counters["sent"] <= counts.executed
        assert log["refused"].max() == 0
