"""Many tests on one rig, on the stepped clock: states, refusals, rings, and a drive that never
notices where one test ends and the next begins.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from realtime_bench import ROWS, STATE
from service_bench import Bench, bench, left, rig_file, short_test

from rthyb_rt import core
from rthyb_rt.core import STATES, loop, mapped_ring, ticker
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.record import ring
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening
from rthyb_rt.service.rig_engine import COMMANDS, Engine, Event, StateError, allowed_states

pytestmark = pytest.mark.alone

FOLLOWING = loop.PHASES.index("following")


@pytest.fixture
def rings(tmp_path: Path) -> Path:
    return tmp_path / "rings"


def give(made: Bench, command: str) -> None:
    """Give a command as an operator would who has everything else right."""
    engine = made.engine
    if command == "load":
        made.loaded()
    elif command == "zero":
        engine.zero()
    elif command == "arm":
        engine.arm(engine.loaded.digest if engine.loaded else "", "somebody")
    elif command == "start":
        engine.start_test("0")
    elif command == "reload":
        engine.reload(rig_file())
    else:
        engine.command(command)  # type: ignore[arg-type]


# ---- one after another --------------------------------------------------------------------------


def test_three_tests_run_and_the_drive_is_never_let_go(rings: Path) -> None:
    with bench(rings) as made:
        for period_s in ("0.5", "0.6", "0.7"):
            made.loaded({"numerical.period_s": period_s})
            made.reach("RUNNING")
            made.finish()
        log = made.drive.log
    first = int(np.flatnonzero(log["phase"] == FOLLOWING)[0])
    assert (log["phase"][first:] == FOLLOWING).all()
    assert log["silent"][first:].max() == 0
    recordings = left(rings)
    assert len(recordings) == 3
    peaks = []
    for rec in recordings:
        np.testing.assert_array_equal(rec.samples["tick"], np.arange(rec.samples.size))
        running = rec.samples[rec.samples["state"] == STATE["RUNNING"]]
        assert running.size == ROWS
        assert rec.samples["state"][-1] == STATE["IDLE"]
        assert realtime.replay(rec).identical
        facts = rec.meta["real_time"]
        assert facts["cause"] == "completed"
        assert facts["ticks"]["executed"] == rec.samples.size
        peaks.append(float(np.abs(running["x_num_m"]).max()))
    assert len(set(peaks)) == 3


def test_commands_stand_in_the_rows_that_the_recording_says(rings: Path) -> None:
    with bench(rings) as made:
        for _ in range(2):
            made.reach("HOLD")
            made.engine.command("resume")
            made.finish()
    for rec in left(rings):
        names = [given["command"] for given in rec.replay.commands]
        assert names == ["zero", "arm", "start", "hold", "resume"]
        for given in rec.replay.commands:
            row = rec.samples[given["tick"]]
            assert core.command_of(int(row["flags"])) == given["command"]
        assert rec.replay.tares["displacement_m"] != 0.0


def test_the_command_does_not_jump_where_stations_change(rings: Path) -> None:
    quiet = {f"rig.sensors.displacement.{key}": "0" for key in ("noise_std_m", "lsb_m")}
    with bench(rings, quiet) as made:
        made.reach("RUNNING")
        made.finish()
        made.reach("ZEROED")
        log = made.drive.log
    steps = np.abs(np.diff(log["target_m"][300:]))
    moving = np.isin(log["state"][301:], [STATE[s] for s in ("RAMP_IN", "RUNNING", "RAMP_OUT")])
    # A new station begins with the reading: what the servo lags by at rest, and the wire's digits.
    assert steps[~moving].max() < 2e-6


def test_service_begins_in_idle_with_nothing_loaded(rings: Path) -> None:
    with bench(rings) as made:
        assert made.engine.state == "IDLE"
        assert made.engine.recorded is None
        with pytest.raises(StateError, match="no test is loaded: load one first"):
            made.engine.zero()
        assert (made.drive.log["state"] == STATE["IDLE"]).all()
    assert ring.find(rings) == []


# ---- who may what when --------------------------------------------------------------------------


@pytest.mark.parametrize("state", STATES)
def test_every_command_is_refused_outside_its_states_with_the_reason(
    rings: Path, state: str
) -> None:
    with bench(rings) as made:
        made.reach(state)
        before = made.engine.loop.counters()["sent"]
        for command in COMMANDS:
            if state in allowed_states(command):
                continue
            with pytest.raises(StateError, match=f"the state is {state}; {command} is allowed in"):
                give(made, command)
            assert made.engine.state == state
        assert made.engine.loop.counters()["refused"] == 0
        assert made.engine.loop.counters()["sent"] == before


def test_stop_is_for_every_state_but_tripped() -> None:
    assert allowed_states("stop") == tuple(s for s in STATES if s != "TRIPPED")
    assert allowed_states("hold") == ("RUNNING", "HOLD")  # while RESUME moves
    assert allowed_states("load") == ("IDLE",)
    assert allowed_states("trip") == STATES


def test_only_the_token_of_this_arming_starts(rings: Path) -> None:
    with bench(rings) as made:
        engine = made.engine
        made.reach("ARMED")
        for wrong in ("", "0" * 32, "é"):
            with pytest.raises(
                StateError, match="armed by the test, and only that user may start it"
            ):
                engine.start_test(wrong)
        engine.command("stop")
        made.finish()
        made.reach("ZEROED")
        assert engine.loaded is not None
        first = engine.arm(engine.loaded.digest, "a")
        engine.command("stop")
        made.finish()
        made.reach("ZEROED")
        second = engine.arm(engine.loaded.digest, "b")
        with pytest.raises(StateError, match="armed by b"):
            engine.start_test(first)
        engine.start_test(second)
        assert engine.state == "RAMP_IN"


def test_armed_ends_by_itself_and_so_does_its_token(rings: Path) -> None:
    with bench(rings) as made:
        made.loaded({"limits.armed_timeout_s": "1"})
        made.reach("ARMED")
        assert made.engine.armed_by == "the test"
        made.engine.wait(1.2)
        assert made.engine.state == "ZEROED"
        assert made.engine.armed_by == ""


def test_who_means_another_test_does_not_arm(rings: Path) -> None:
    with bench(rings) as made:
        other = made.loaded({"numerical.period_s": "0.6"})
        made.loaded()
        made.reach("ZEROED")
        with pytest.raises(StateError, match=r"the test that was zeroed is .*, not"):
            made.engine.arm(other.digest, "somebody")
        assert made.engine.state == "ZEROED"


def test_digest_knows_test_rig_and_ground_motion(rings: Path) -> None:
    with bench(rings) as made:
        test = short_test()
        record = experiment.load_motion(test)
        same = made.engine.prepare(test, record)
        assert made.engine.prepare(test, record).digest == same.digest
        turned = made.engine.prepare(test, record.scaled(factor=-1.0))
        slower = made.engine.prepare(short_test({"numerical.period_s": "0.6"}), record)
        assert len({same.digest, turned.digest, slower.digest}) == 3


# ---- what does not come to its end --------------------------------------------------------------


def test_test_that_is_stopped_before_it_moves_leaves_nothing(rings: Path) -> None:
    with bench(rings) as made:
        made.reach("ARMED")
        made.engine.command("stop")
        made.finish()
        assert "section5-t0.5: nothing moved, so no recording is kept" in made.said
        assert len(ring.find(rings)) == 1
    assert ring.find(rings) == []


def test_zero_again_begins_a_new_recording(rings: Path) -> None:
    with bench(rings) as made:
        made.reach("ZEROED")
        first = made.engine.run_id
        made.engine.zero()
        made.until("ZEROED")
        assert made.engine.run_id != first
        assert len(ring.find(rings)) == 2


def test_rig_that_is_not_at_rest_is_not_zeroed_and_says_why(rings: Path) -> None:
    with bench(rings, {"rig.sensors.displacement.noise_std_m": "1e-3"}) as made:
        made.loaded({"limits.rest_spread_m": "0.1 mm"})
        made.engine.zero()
        made.engine.wait(1.0)
        assert made.engine.state == "IDLE"
        assert made.engine.recorded is None
        (why,) = (text for text in made.said if text.startswith("not zeroed: "))
        assert "the displacement moved by " in why
        assert "at most 0.1 mm is allowed" in why


def test_feedback_that_stops_during_the_tare_is_named(rings: Path) -> None:
    with bench(rings, faults=[loop.Fault("silence", 250, 2**40)]) as made:
        made.loaded({"limits.tare_s": "1"})
        made.engine.zero()
        made.engine.wait(4.0)
        assert made.engine.state == "IDLE"
        assert made.engine.recorded is None
        assert any(text.startswith("not zeroed: ") for text in made.said)


def test_drive_that_goes_silent_is_not_one_that_says_it_has_stopped(rings: Path) -> None:
    with bench(rings, faults=[loop.Fault("silence", 2048, 2**40)]) as made:
        made.loaded()
        made.engine.wait(3.0)
        with pytest.raises(StateError, match="the drive has gone silent"):
            made.engine.zero()
    with bench(rings, faults=[loop.Fault("drop-command", 2048, 2**40)]) as made:
        made.loaded()
        made.engine.wait(3.0)
        with pytest.raises(StateError, match="reports that it has stopped"):
            made.engine.zero()


@contextmanager
def engines_at_one_drive(rings: Path) -> Iterator[tuple[Callable[[], Bench], loop.Drive]]:
    """Give a way to begin a service anew, at a drive that has seen the others."""
    rig = rig_file()
    plan = virtual_rig.RigPlan(log_ticks=60000)
    ours, theirs = opening.socket_pair()
    made: list[Bench] = []
    with ours, theirs, virtual_rig.in_step(rig, theirs, plan) as drive:

        def begin() -> Bench:
            events: list[Event] = []
            engine = Engine(
                rig,
                ours,
                clock="stepped",
                folder=rings,
                before_tick=drive.tick,
                tell=events.append,
            )
            made.append(Bench(engine, drive, events))
            engine.start()
            engine.wait(0.2)
            return made[-1]

        try:
            yield begin, drive
        finally:
            for bench in made:
                bench.engine.close()


@pytest.mark.parametrize("state", ["IDLE", "RUNNING"])
def test_drive_of_a_service_that_was_killed_stays_stopped_until_an_operator_resets_it(
    rings: Path, state: str
) -> None:
    """It followed again six ticks after the next service had begun."""
    with engines_at_one_drive(rings) as (begin, drive):
        killed = begin()
        killed.reach(state)
        killed.engine.fall_silent()  # kill -9: no trip, no farewell
        for _ in range(200):
            drive.tick()
        assert drive.phase == "stopped"
        made = begin()
        began = drive.ticks
        made.loaded()
        made.engine.wait(3.0)
        assert (drive.log["phase"][began:] == loop.PHASES.index("stopped")).all()
        assert made.engine.stays_stopped()
        assert "reset" in made.engine.allowed
        with pytest.raises(
            StateError, match="will not follow commands until an operator resets it"
        ):
            made.engine.zero()
        made.engine.command("reset")
        assert drive.phase == "following"
        assert "reset" not in made.engine.allowed
        with pytest.raises(StateError, match="there is nothing to reset"):
            made.engine.command("reset")
        made.engine.wait(0.1)
        made.reach("RUNNING")
        made.engine.command("stop")
        made.finish()
        steps = np.abs(np.diff(drive.log["target_m"][began:]))
        assert steps.max() < 5e-4, "nothing leaps on the way"


def test_service_that_ends_in_good_order_needs_no_reset(rings: Path) -> None:
    with engines_at_one_drive(rings) as (begin, drive):
        begin().engine.close()
        for _ in range(200):
            drive.tick()
        assert drive.phase == "stopped"
        begin()
        assert drive.phase == "following"


def test_drive_that_does_not_hear_a_reset_is_named(rings: Path) -> None:
    with engines_at_one_drive(rings) as (begin, drive):
        begin().engine.fall_silent()
        for _ in range(200):
            drive.tick()
        made = begin()
        drive.schedule([loop.Fault("drop-command", 0, 2**40)])
        with pytest.raises(StateError, match="the drive was sent a reset but remains stopped"):
            made.engine.command("reset")
        drive.schedule([])
        made.engine.command("reset")
        assert drive.phase == "following"


def test_zeroing_that_is_stopped_ends_at_once_and_is_no_fault_of_the_drive(rings: Path) -> None:
    with bench(rings) as made:
        again = made.loaded({"limits.tare_s": "1"})
        made.engine.zero()
        made.engine.wait(0.2)
        assert "load" not in made.engine.allowed
        with pytest.raises(StateError, match="a test is being zeroed"):
            made.engine.load(again)
        made.engine.command("stop")
        assert made.engine.recorded is None
        assert made.engine.not_zeroed == "zeroing was stopped by an operator"
        assert "load" in made.engine.allowed
        assert not any(event.level == "error" for event in made.events)
        made.engine.load(again)
        made.engine.zero()
        made.until("ZEROED")


def test_zero_that_the_station_refuses_leaves_a_service_that_can_be_loaded(
    rings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the drive stops between the last look and the command."""
    with bench(rings) as made:
        loaded = made.loaded()
        answered = made.engine._answered

        def refused(name: str) -> tuple[bool, int]:
            obeyed, tick = answered("hold" if name == "zero" else name)
            return (False if name == "zero" else obeyed), tick

        monkeypatch.setattr(made.engine, "_answered", refused)
        with pytest.raises(StateError, match="does not answer in every tick"):
            made.engine.zero()
        monkeypatch.setattr(made.engine, "_answered", answered)
        assert made.engine.recorded is None
        made.engine.load(loaded)
        made.engine.zero()
        made.until("ZEROED")
        assert len(ring.find(rings)) == 2


def test_arming_beyond_a_limit_is_refused_with_the_figures(rings: Path) -> None:
    """Somebody leans on the specimen after the tare."""
    limit = {"limits.force_n": '{ value = "5 kN", action = "hold" }'}
    with bench(rings) as made:
        loaded = made.loaded(limit)
        made.engine.zero()
        made.until("ZEROED")
        made.drive.schedule([loop.Fault("force", 0, 2**40, 6e3)])
        made.engine.wait(0.1)
        with pytest.raises(StateError, match=r"force 6\.\d* kN \(limit 5 kN\); bring") as told:
            made.engine.arm(loaded.digest, "somebody")
        assert told.value.state == "ZEROED"
        made.drive.schedule([])
        made.engine.wait(0.1)
        made.engine.arm(loaded.digest, "somebody")


def test_trip_is_recorded_at_once_and_stays_until_it_is_reset(rings: Path) -> None:
    limit = {"limits.command_position_m": '{ value = "0.5 mm", action = "trip" }'}
    with bench(rings) as made:
        made.loaded(limit)
        made.reach("RAMP_IN")
        made.until("TRIPPED")
        made.engine.wait(1.2)
        assert made.engine.state == "TRIPPED"
        assert made.engine.recorded is None
        assert made.engine.last is not None
        assert made.engine.last["end_reason"] == "tripped: position limit"
        figures = made.engine.cause_in_figures
        assert re.fullmatch(r"command 0\.5\d+ mm \(limit 0\.5 mm\)", figures)
        assert made.engine.last["ending"].startswith(f"{figures} at ")
        told = made.said
        assert any(text.endswith(f"cause: {figures}") for text in told)
        assert any(f"ended: tripped: position limit, {figures} at " in text for text in told)
        (path, *_) = [p for p in ring.find(rings) if p != made.engine.ring_path]
        with ring.RingReader(path) as reader:
            assert reader.closed
        with pytest.raises(StateError, match="zero is allowed in IDLE or ZEROED"):
            made.engine.zero()
        made.engine.command("reset")
        assert made.engine.state == "IDLE"
        made.engine.wait(0.3)
        made.loaded()
        made.reach("RUNNING")
        made.finish()
    tripped, good = left(rings)
    assert tripped.meta["real_time"]["cause"] == "position"
    assert np.count_nonzero(tripped.samples["state"] == STATE["TRIPPED"]) == mapped_ring.AFTER_TRIP
    assert realtime.replay(tripped).identical
    assert good.meta["real_time"]["cause"] == "completed"
    assert realtime.replay(good).identical


def test_reset_soon_after_a_trip_keeps_its_cause(rings: Path) -> None:
    with bench(rings) as made:
        made.reach("TRIPPED")
        made.engine.command("reset")
        made.finish()
    (rec,) = left(rings)
    assert rec.meta["real_time"]["cause"] == "signal"
    assert rec.meta["real_time"]["state"] == "TRIPPED"


def test_end_of_the_service_trips_what_still_moves(rings: Path) -> None:
    with bench(rings) as made:
        made.reach("RUNNING")
        made.engine.close()
        log = made.drive.log
    assert log["state"][-1] == STATE["TRIPPED"]
    (rec,) = left(rings)
    assert rec.samples["state"][-1] == STATE["TRIPPED"]


def test_service_whose_turns_stop_ramps_out_by_itself(rings: Path) -> None:
    with bench(rings) as made:
        made.loaded({"test.duration_s": "20"})
        made.reach("RUNNING")
        made.engine._pass(0.9)
        assert made.engine.state == "RUNNING"
        made.engine._pass(0.2)
        assert made.engine.state == "RAMP_OUT"
        made.finish()
    (rec,) = left(rings)
    assert rec.meta["real_time"]["cause"] == "heartbeat"
    assert realtime.replay(rec).identical


def test_station_of_a_running_test_cannot_be_taken_from_the_tick(rings: Path) -> None:
    with bench(rings) as made:
        made.reach("RUNNING")
        engine = made.engine
        generation = engine.loop.load(engine._rest.station, engine._rest.ring)
        engine.wait(0.1)
        assert engine.loop.loaded(generation) is False
        made.finish()
    (rec,) = left(rings)
    assert realtime.replay(rec).identical


# ---- limits -------------------------------------------------------------------------------------

TIGHT = {"rig.limits.tracking_error_m": '{ value = "0.05 mm", action = "ramp-out" }'}


def test_limits_are_reloaded_at_rest_and_go_into_the_next_test(rings: Path) -> None:
    with bench(rings) as made:
        before = made.loaded()
        assert made.engine.reload(rig_file(TIGHT)) == 0
        assert made.engine.loaded is not None
        assert made.engine.loaded.digest != before.digest
        made.reach("RAMP_IN")
        made.finish()
    (rec,) = left(rings)
    assert rec.meta["real_time"]["cause"] == "tracking"
    assert realtime.replay(rec).identical


def test_limits_are_reloaded_in_hold_with_a_generation(rings: Path) -> None:
    with bench(rings) as made:
        made.reach("HOLD")
        assert made.engine.reload(rig_file(TIGHT)) == 1
        made.engine.command("resume")
        made.finish()
    (rec,) = left(rings)
    assert rec.meta["real_time"]["cause"] == "tracking"
    assert rec.samples["generation"][-1] == 1
    assert realtime.replay(rec).identical


def test_reload_that_the_tick_refuses_says_why_and_changes_nothing(rings: Path) -> None:
    limited = {"rig.limits.command_acceleration_m_per_s2": "20"}
    with bench(rings, limited) as made:
        made.reach("HOLD")
        engine, loaded = made.engine, made.engine.loaded
        with pytest.raises(StateError) as told:
            engine.reload(rig_file())
        assert "would remove a limit on the command's velocity" in str(told.value)
        assert "stop and change them in IDLE" in str(told.value)
        assert "the state is HOLD" in str(told.value)
        assert engine.rig.limits.command_acceleration_m_per_s2 is not None
        assert engine.loaded is loaded
        assert not any("limits reloaded" in text for text in made.said)
        assert engine.reload(rig_file(limited | TIGHT)) == 2
        engine.command("resume")
        made.finish()
        assert engine.reload(rig_file()) == 0
    (rec,) = left(rings)
    assert set(rec.samples["generation"]) == {0, 2}
    assert rec.meta["real_time"]["loop"]["parameters_refused"] == 1
    assert realtime.replay(rec).identical


def test_more_than_limits_is_no_reload(rings: Path) -> None:
    with bench(rings) as made:
        with pytest.raises(StateError, match="sensors of the rig file also changed; restart"):
            made.engine.reload(rig_file({"rig.sensors.force.noise_std_n": "7"}))
        assert made.engine.rig.sensors.force.noise_std_n != 7


def test_test_that_is_weaker_than_the_new_limits_stops_the_reload(rings: Path) -> None:
    with bench(rings) as made:
        made.loaded({"limits.tracking_error_m": '{ value = "9 mm", action = "trip" }'})
        with pytest.raises(InputError, match="tracking_error_m"):
            made.engine.reload(rig_file(TIGHT))
        assert made.engine.rig.limits.tracking_error_m is None


# ---- counting -----------------------------------------------------------------------------------


def test_histogram_of_one_test_is_what_came_since() -> None:
    whole = ticker.Latency()
    for ns in (10, 20, 5000):
        whole.record(ns)
    before = whole.copy()
    for ns in (15, 900, 30):
        whole.record(ns)
    later = whole.since(before)
    assert later.count == 3
    assert later.mean_ns == pytest.approx((15 + 900 + 30) / 3)
    assert 900 <= later.max_ns <= 900 * 1.04
    assert int(later.buckets().sum()) == 3
    whole.record(70000)
    assert whole.since(before).max_ns == 70000
    assert whole.since(whole.copy()).count == 0
