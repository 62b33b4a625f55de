"""Where the tick begins and its command ends: coarse wires, old frames, a clock of the drive."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Any

import loop_bench
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from link_tools import users_table
from loop_bench import FLAGS, STATE, Bench, watched
from realtime_bench import Bench as WholeTest
from realtime_bench import setup, until
from rthyb_rt._core import ffi, lib
from test_core_safety import mounted, table
from test_live_replay import FLOATS, MOUNTED, assert_the_same

from rthyb_rt import core
from rthyb_rt.analysis import summary
from rthyb_rt.core import loop, wire
from rthyb_rt.core.wire import Setpoint
from rthyb_rt.lab import realtime
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening

STEP_MM = 0.1
HUGE = 1e300
OUT_OF_RANGE = lib.RTHYB_S_OUT_OF_RANGE


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> wire.Codec:
    """A user's DBC with 0.1 mm a bit."""
    return table(tmp_path_factory.mktemp("dbc"), STEP_MM)


@pytest.fixture(scope="module")
def floats(tmp_path_factory: pytest.TempPathFactory) -> wire.Codec:
    """A user's DBC whose command is a 32-bit float."""
    return users_table(tmp_path_factory.mktemp("dbc"), FLOATS)


# ---- a wire that is coarser than the distance to a limit ----------------------------------------


def sent_m(bench: Bench) -> np.ndarray:
    """Every position that came to the drive, of the structure, from its zero at the tare."""
    log = bench.drive.log
    zero_m = bench.station._c.axis[0].tare_cmd
    wired = log["x_m"][(log["frames"] > 0) & (log["state"] >= STATE["RAMP_IN"])]
    c = bench.calibration
    return np.asarray((wired - c.cmd_offset_m) / c.cmd_gain - zero_m)


@pytest.mark.parametrize("calibration", [core.IDENTITY, MOUNTED], ids=["plain", "turned round"])
@pytest.mark.parametrize("reaction", ["hold", "ramp-out", "trip"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_position_limit_holds_on_the_wire_however_coarse_that_is(
    side: float,
    reaction: Any,
    calibration: core.WireCalibration,
    coarse: wire.Codec,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shaking = loop_bench.shaking
    monkeypatch.setattr(loop_bench, "shaking", lambda seconds: side * shaking(seconds))
    step_m = STEP_MM * 1e-3 / abs(calibration.cmd_gain)
    limit_m = 30.7 * step_m if calibration is core.IDENTITY else 15.7 * step_m
    limited = watched("position", limit_m, reaction)
    with Bench(seconds=4.0, codec=coarse, calibration=calibration, **limited) as bench:
        bench.running(0)
        for _ in range(1500):
            bench.step()
        assert bench.loop.cause == "position"
        assert bench.loop.counters()["beyond"] == 0
        farthest = np.abs(sent_m(bench)).max()
        assert farthest <= limit_m + 1e-6 * step_m
        assert farthest > limit_m - 2.0 * step_m, "the limit was never near"
        assert_the_same(bench)


def test_reading_that_is_no_number_at_the_limit_sends_nothing_beyond_it(coarse: wire.Codec) -> None:
    limit_m = 3.07e-3
    with Bench(seconds=4.0, codec=coarse, **watched("position", limit_m, "hold")) as bench:
        bench.running(0)
        bench.until("HOLD")
        bench.steps(20)
        bench.fault("jump", 5, HUGE)
        bench.steps(5)
        bench.fault("not-finite", 5)
        bench.steps(40)
        assert np.abs(sent_m(bench)).max() <= limit_m + 1e-10
        assert np.isfinite(sent_m(bench)).all()


def test_jog_that_ends_at_the_limit_stays_within_it_at_rest(
    coarse: wire.Codec, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit_m, end_m = 3.07e-3, 3.06e-3
    u = np.linspace(0.0, 1.0, 1000)
    way = end_m * np.append(u**3 * (10.0 - 15.0 * u + 6.0 * u**2), np.ones(200))
    monkeypatch.setattr(loop_bench, "shaking", lambda _: way)
    plain = loop_bench.config

    def prescribed(**changes: Any) -> core.StationConfig:
        made = plain(**changes)
        motion = core.MotionConfig("prescribed")
        controller = dataclasses.replace(made.controller, motion=motion, lead_enabled=False)
        return dataclasses.replace(made, controller=controller)

    monkeypatch.setattr(loop_bench, "config", prescribed)
    with Bench(codec=coarse, stay=True, **watched("position", limit_m, "ramp-out")) as bench:
        bench.running(0)
        bench.until("IDLE")
        bench.steps(100)
        assert bench.loop.cause == "completed"
        assert bench.rows()["x_plc_m"][-1] == pytest.approx(end_m, abs=1e-9)
        at_rest = bench.drive.log["target_m"][-50:] - bench.station._c.axis[0].tare_cmd
        assert np.ptp(at_rest) == 0.0
        assert limit_m - 1e-4 < at_rest[0] <= limit_m + 1e-10


def test_limit_narrower_than_a_step_of_the_wire_trips_and_nothing_leaves(
    coarse: wire.Codec, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The sensor's offset puts zero half way between two steps.
    off = core.SensorConfig(bias=0.5e-4)
    monkeypatch.setattr(loop_bench, "rig", lambda *_: mounted(displacement=off))
    with Bench(seconds=4.0, codec=coarse, **watched("position", 4e-5, "hold")) as bench:
        bench.steps(8)
        stood_m = bench.drive.log["target_m"][-1]
        bench.step("zero")
        bench.until("ZEROED")
        bench.station._c.axis[0].seen_x = bench.station._c.axis[0].tare_x
        bench.step("arm")
        bench.step("start")
        bench.until("TRIPPED")
        bench.steps(30)
        assert bench.loop.cause == "position"
        assert np.ptp(bench.drive.log["target_m"][8:] - stood_m) == 0.0
        assert_the_same(bench)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_number_stays_none_between_any_bounds(coarse: wire.Codec, bad: float) -> None:
    for codec in (coarse, wire.can(), wire.serial()):
        within = lib.rthyb_command_within(codec.struct, bad, -0.01, 0.01)
        assert within == bad or math.isnan(within)
        with pytest.raises(core.CoreError, match="finite"):
            codec.encode_setpoint(Setpoint(within))
        assert math.isnan(lib.rthyb_command_within(codec.struct, HUGE, -0.01, 0.01))
        assert lib.rthyb_command_within(codec.struct, HUGE, -math.inf, math.inf) == HUGE


@given(
    st.floats(-0.05, 0.05),
    st.floats(0.0, 0.05),
    st.floats(0.0, 0.05),
)
@settings(max_examples=300, deadline=None)
def test_nearest_step_between_two_bounds_is_sent(
    coarse: wire.Codec, x_m: float, below_m: float, above_m: float
) -> None:
    low, high, step_m = x_m - below_m, x_m + above_m, STEP_MM * 1e-3
    steps = np.arange(-1100, 1101) * step_m
    possible = steps[(steps >= low - 1e-6 * step_m) & (steps <= high + 1e-6 * step_m)]
    within = lib.rthyb_command_within(coarse.struct, x_m, low, high)
    if possible.size == 0:
        assert math.isnan(within)
        return
    _, sent = coarse.encode_setpoint(Setpoint(within))
    assert low - 2e-6 * step_m <= sent <= high + 2e-6 * step_m
    assert abs(sent - x_m) <= np.abs(possible - x_m).min() + 2e-6 * step_m


@pytest.mark.parametrize("unit_mm", [0.3, 0.6, 0.7])
def test_last_step_that_a_frame_holds_is_not_beyond_it(unit_mm: float, tmp_path: Path) -> None:
    """A limit that is the frame's own: the step's value over the step is one in the last digit."""
    codec = table(tmp_path, unit_mm)
    step_m = codec.struct.command.field[0].scale
    setpoint, frame = ffi.new("rthyb_setpoint *"), ffi.new("rthyb_frame *")
    sent = ffi.new("double *")
    for steps, said in ((32767, 0), (-32768, 0), (32767.001, OUT_OF_RANGE), (HUGE, OUT_OF_RANGE)):
        setpoint.x_m = steps * step_m
        assert lib.rthyb_encode_setpoint(codec.struct, setpoint, frame, sent) == said
        assert sent[0] == (-32768 if steps < 0 else 32767) * step_m


@given(st.floats(1e-6, 0.05), st.booleans())
@settings(max_examples=200, deadline=None)
def test_next_float_is_sent_where_the_nearest_lies_beyond(
    floats: wire.Codec, x_m: float, turned: bool
) -> None:
    near = float(np.float32(x_m))
    if near <= x_m:
        return
    low = float(np.nextafter(np.float32(near), np.float32(0.0)))
    sign = -1.0 if turned else 1.0
    bounds = sorted((sign * low, sign * x_m))
    assert lib.rthyb_command_within(floats.struct, sign * x_m, *bounds) == sign * low


def test_ramp_in_over_a_long_way_is_no_faster_than_any_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At the first contact the command lies off zero by what sensor and actuator differ."""
    off = core.SensorConfig(bias=0.004)
    monkeypatch.setattr(loop_bench, "rig", lambda *_: mounted(displacement=off))
    for path, most in ((0.002, 1e3), (1e3, 0.02)):
        changes = {"path_velocity_m_per_s": path, "path_acceleration_m_per_s2": most}
        with Bench(seconds=1.0, **changes) as bench:
            bench.running(1)
            rows = bench.rows()
            way = rows["x_num_m"][rows["state"] == STATE["RAMP_IN"]]
            assert abs(way[0]) > 3.9e-3
            speed = np.diff(way) * core.FS_HZ
            assert np.abs(speed).max() <= path * (1 + 1e-6)
            assert np.abs(np.diff(speed)).max() * core.FS_HZ <= most * (1 + 1e-3)


# ---- what waits in the link before the first tick -----------------------------------------------


@pytest.mark.parametrize("medium", ["socketpair", "pty"])
def test_first_tick_takes_nothing_that_was_sent_before_it(medium: str) -> None:
    with Bench(medium, clock="host") as bench:
        bench.drive_ticks(40)
        bench.arrived(bench.link, bench.far)
        bench.loop.start()
        until(lambda: bench.loop.counts.executed >= 3, "three ticks")
        bench.loop.stop()
        counters = bench.wire.counters()
        assert counters["pairs"] == counters["superseded"] == counters["bad_framing"] == 0
        assert bench.loop.counters()["old"] >= (1 if medium == "pty" else 80)
        assert bench.loop.counters()["down"] == 0


def test_rest_of_a_packet_whose_beginning_was_dropped_is_no_damage() -> None:
    with Bench("pty") as bench:
        codec = wire.serial()
        (frame,) = codec.encode_feedback(wire.Reading(1e-3, 5.0, 0, 1, 0))
        (after,) = codec.encode_feedback(wire.Reading(1e-3, 5.0, 0, 2, 0))
        os.write(bench.ends[1], frame.data[:7])
        until(lambda: (bench.loop.drop_old(), bench.loop.counters()["old"])[1], "the half")
        os.write(bench.ends[1], frame.data[7:] + after.data)
        until(lambda: bench.loop.await_pair(0.1), "a pair")
        counters = bench.wire.counters()
        assert counters["bad_framing"] == counters["bad_crc"] == counters["bad_length"] == 0


def test_session_on_the_stepped_clock_begins_with_the_drives_newest_sample(tmp_path: Path) -> None:
    made = setup()
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(made.rig, theirs) as drive:
        for _ in range(60):
            drive.tick()
        session = realtime.Session(
            made, ours, clock="stepped", before_tick=drive.tick, folder=tmp_path
        )
        with session:
            session.start()
            session.wait(core.PERIOD_S)
            assert session.loop.counters()["old"] == 120
            assert session.wire.counters()["superseded"] == 0
            assert session.loop.records["count"][0] == drive.ticks - 1
        session.discard()


# ---- the link's delay ---------------------------------------------------------------------------


def test_delay_of_the_link_is_that_of_the_test_and_not_of_its_last_tick() -> None:
    def late_at_the_end(drive: loop.Drive) -> None:
        if drive.received_state == "RAMP_OUT":
            drive.schedule([loop.Fault("delay", 0, 2**40, 3)])

    rec = WholeTest(tell=late_at_the_end).run()
    rows = rec.samples
    sent = np.flatnonzero((rows["flags"] & FLAGS["not_sent"]) == 0)
    newest = np.arange(rows.size) - sent[0]
    delay = (newest - rows["echo"].astype(np.int64)) % 256
    assert delay[-1] == 3
    assert np.median(delay[rows["state"] == STATE["RUNNING"]]) == 0
    found = summary.live(rec)
    assert found is not None
    assert found.link_delay_samples == 0


def test_median_of_the_links_delay() -> None:
    few = np.zeros(256, dtype=np.int64)
    assert realtime.link_delay(few, None) == -1
    assert realtime.link_delay(few, 4) == 4
    few[[1, 2, 7]] = (5, 6, 4)
    assert realtime.link_delay(few, 7) == 2
    assert realtime.link_delay(few, 7) == np.median(np.repeat(np.arange(256), few))


def test_every_fresh_pair_of_the_test_is_in_the_histogram_of_delays() -> None:
    with Bench(seconds=1.0) as bench:
        bench.running(100)
        bench.fault("delay", 10**6, 2)
        bench.until("IDLE")
        rows = bench.rows()
        fresh = (rows["flags"] & FLAGS["fresh"]) != 0
        running = np.count_nonzero(fresh & (rows["state"] == STATE["RUNNING"]))
        delays = bench.loop.link_delays()
        assert delays.sum() == running
        assert delays[0] >= 100
        assert delays[2] > 100
        assert delays[[0, 2]].sum() == running


# ---- the stepped clock beside a rig that has a clock of its own ---------------------------------


@pytest.mark.parametrize("paced", [True, False])
def test_rig_that_does_not_wait_for_the_stepped_clock_has_no_slips(
    paced: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = setup()
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(made.rig, theirs) as drive:
        ticks = [0]

        def goes_on(*_: object) -> bool:
            """Two samples come in the time of every 300th tick."""
            ticks[0] += 1
            for _ in range(2 if ticks[0] % 300 == 0 else 1):
                drive.tick()
            return True

        monkeypatch.setattr(loop.Loop, "await_pair", goes_on)
        before_tick = goes_on if paced else None
        session = realtime.Session(
            made, ours, clock="stepped", before_tick=before_tick, folder=tmp_path
        )
        with session:
            session.start()
            session.wait(3000 * core.PERIOD_S)
            slips = session.loop.counters()["slips"]
        session.discard()
    assert slips >= 8 if paced else slips == 0
