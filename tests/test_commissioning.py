"""Jogging, polarity, limits and the drive's own stop, tick by tick with a virtual drive."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
from commissioning_bench import DELAY_SAMPLES, STIFFNESS_N_PER_M, Drive, at, rig
from numpy.testing import assert_allclose

from rthyb_rt import config, core
from rthyb_rt.core import FLAGS, STATES, loop
from rthyb_rt.core.wire import Codec
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.record import ring
from rthyb_rt.rig.commissioning import guide, guided_motion, jogging, limit_checks, polarity, stops
from rthyb_rt.rig.commissioning.certificate import STEPS, Certificate
from rthyb_rt.rig.identification import (
    SineRows,
    SweepPlan,
    check_not_limited,
    identify,
    identify_live,
)

pytestmark = pytest.mark.alone

REVERSED_SENSOR = {"calibration.displacement.polarity": "-1", "calibration.command.polarity": "1"}
REVERSED_COMMAND = {"calibration.command.polarity": "-1"}
REVERSED_FORCE = {"calibration.force.polarity": "-1"}


@pytest.fixture(autouse=True)
def _rings_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ring, "default_folder", lambda: tmp_path / "rings")


def no_ring_is_left(tmp_path: Path) -> bool:
    folder = tmp_path / "rings"
    return not folder.exists() or ring.find(folder) == []


# ---- paths --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance_m", "speed", "acceleration"),
    [(1e-3, 1e-3, 0.2), (-5e-3, 2e-2, 0.01), (1e-2, 1.0, 0.2), (1e-6, 1e-3, 0.2)],
)
def test_way_keeps_to_speed_and_acceleration(
    distance_m: float, speed: float, acceleration: float
) -> None:
    path = np.concatenate([[0.0, 0.0], guided_motion.eased(distance_m, speed, acceleration)])
    velocity = np.diff(path) * core.FS_HZ
    assert path[-1] == pytest.approx(distance_m, rel=1e-12)
    assert np.abs(velocity).max() <= speed * (1 + 1e-9)
    assert np.abs(np.diff(velocity)).max() * core.FS_HZ <= acceleration * (1 + 1e-6)
    assert (np.sign(velocity) * np.sign(distance_m) >= 0.0).all()


def test_way_is_as_short_as_its_speed_allows() -> None:
    # The quintic's peak is 15/8 of its mean velocity.
    assert guided_motion.eased(4e-3, 1e-3, 10.0).size == math.ceil(1.875 * 4.0 * core.FS_HZ)


# ---- jog ----------------------------------------------------------------------------------------


def test_jog_there_and_back(tmp_path: Path) -> None:
    with at(rig()) as there:
        out = jogging.jog(there.connection, 2e-3, 4e-3)
        assert there.position_m == pytest.approx(2e-3, abs=10e-6)
        back = jogging.jog(there.connection, -2e-3, 4e-3)
        assert there.position_m == pytest.approx(0.0, abs=20e-6)
        log = there.drive.log
    for jogged, distance_m in ((out, 2e-3), (back, -2e-3)):
        assert (jogged.cause, jogged.state, jogged.faults) == ("completed", "IDLE", ())
        assert jogged.moved_m == pytest.approx(distance_m, abs=10e-6)
        assert jogged.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=0.01)
    assert out.end_n == pytest.approx(STIFFNESS_N_PER_M * out.end_m, abs=5.0)
    assert back.start_m == pytest.approx(out.end_m, abs=2e-6)
    moving_rows = log["state"] == STATES.index("RUNNING")
    speed = np.abs(np.diff(log["target_m"])) * core.FS_HZ
    assert speed[moving_rows[1:]].max() <= 4e-3 * 1.01
    assert no_ring_is_left(tmp_path)


def test_quiet_sensors_at_zero_are_no_reason_to_see_nothing() -> None:
    quiet = {"sensors.displacement": "{}", "sensors.force": "{}"}
    with at(rig(quiet)) as there:
        jogged = jogging.jog(there.connection, 1e-3, 4e-3)
    assert jogged.start_m == 0.0
    assert jogged.moved_m == pytest.approx(1e-3, abs=2e-9)
    assert jogged.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=1e-5)


def test_operator_who_stops_a_jog_leaves_the_actuator_where_it_comes_to_rest() -> None:
    with at(rig()) as there:
        seen = [0]

        def look() -> None:
            running = there.drive.received_state == "RUNNING"
            seen[0] += running
            if seen[0] == 1024:
                there.operator()

        there.tell = look
        jogged = jogging.jog(there.connection, 4e-3, 2e-3)
    assert jogged.end_reason == "stopped by the operator"
    assert jogged.state == "IDLE"
    assert 0.1e-3 < jogged.moved_m < 3e-3
    assert jogged.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=0.05)
    assert jogged.faults == ()


@pytest.mark.parametrize(
    ("action", "state", "words"),
    [
        ("trip", "TRIPPED", "tripped: force limit"),
        ("ramp-out", "IDLE", "ramped out: force limit"),
        ("hold", "IDLE", "ramped out: force limit"),
    ],
)
def test_force_limit_ends_a_jog_where_it_is(action: str, state: str, words: str) -> None:
    limit = {"limits.force_n": f'{{ value = "500 N", action = "{action}" }}'}
    with at(rig(limit)) as there:
        jogged = jogging.jog(there.connection, 4e-3, 4e-3)
    assert (jogged.state, jogged.cause, jogged.end_reason) == (state, "force", words)
    assert 0.9e-3 < jogged.moved_m < 1.3e-3


def test_force_limit_of_a_jog_counts_from_zero_load() -> None:
    with at(rig({"limits.force_n": '"700 N"'})) as there:
        first = jogging.jog(there.connection, 1e-3, 4e-3)
        second = jogging.jog(there.connection, 1e-3, 4e-3)
    assert first.cause == "completed"
    assert second.cause == "force"
    assert second.end_n == pytest.approx(700.0, abs=40.0)


def test_position_limit_of_a_jog_counts_from_the_zero_of_the_rig() -> None:
    """A row of jogs leads no farther than one may; from beyond the limit there is a way back."""
    limit = {"limits.command_position_m": '{ value = "5 mm", action = "ramp-out" }'}
    with at(rig(limit)) as there:
        first = jogging.jog(there.connection, 3e-3, 4e-3)
        second = jogging.jog(there.connection, 3e-3, 4e-3)
        beyond_m = there.position_m
        farther = jogging.jog(there.connection, 1e-3, 4e-3)
        back = jogging.jog(there.connection, -3e-3, 4e-3)
    assert first.cause == "completed"
    assert second.cause == "rig_position"
    assert beyond_m == pytest.approx(5e-3, abs=0.1e-3)
    assert farther.cause == "rig_position"
    assert abs(farther.moved_m) < 0.1e-3
    assert back.cause == "completed"


def test_jog_that_would_leave_the_sensor_or_the_load_cell_is_refused_and_nothing_moves() -> None:
    far = rig({"sensors.displacement.range_m": '"12 mm"'})
    with at(far) as there:
        jogging.jog(there.connection, 8e-3, 20e-3)
        with pytest.raises(realtime.RefusedError, match=r"sensor reaches only to 12 mm"):
            jogging.jog(there.connection, 6e-3, 4e-3)
        assert jogging.jog(there.connection, -1e-3, 4e-3).cause == "completed"
    loaded = rig({"sensors.force.bias_n": "9000"})
    with at(loaded) as there:
        with pytest.raises(realtime.RefusedError, match=r"load cell reads 90\d\d(\.\d)? N at rest"):
            jogging.jog(there.connection, 1e-3, 4e-3)
        assert np.ptp(there.drive.log["target_m"]) < 20e-6


def test_jog_that_trips_before_it_begins_says_that_nothing_moved() -> None:
    """Standing at 3 mm, and the drive falls silent while it is armed or zeroed."""
    with at(rig({"limits.tare_s": "0.125"})) as there:
        jogging.jog(there.connection, 3e-3, 20e-3)
        begun = there.drive.ticks
        there.drive.schedule([loop.Fault("silence", begun + 150, 2**40)])
        with pytest.raises(InputError, match="feedback stopped during zeroing"):
            jogging.jog(there.connection, 1e-3)
    with at(rig()) as there:
        jogging.jog(there.connection, 3e-3, 20e-3)

        def look() -> None:
            if there.drive.received_state == "IDLE" and there.drive.ticks % 100 == 99:
                there.operator()

        there.tell = look
        jogged = jogging.jog(there.connection, 1e-3)
        assert there.position_m == pytest.approx(3e-3, abs=20e-6)
    assert jogged.end_reason == "stopped by the operator before it began"
    assert jogged.moved_m == 0.0
    assert jogged.start_m == pytest.approx(3e-3, abs=10e-6)
    assert jogged.start_n == pytest.approx(3e-3 * STIFFNESS_N_PER_M, abs=10.0)
    assert jogged.faults == ()


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"limits": "{ force_n = 8000 }"}, "limits.command_position_m: missing"),
        ({"limits": '{ command_position_m = "5 mm" }'}, "limits.force_n: missing"),
        (
            {"limits.force_n": '{ value = 8000, action = "indicate" }'},
            "limits.force_n: does not end the motion",
        ),
        (
            {"limits.force_n": "{ value = 8000, enable = false }"},
            "limits.force_n: does not end the motion",
        ),
    ],
)
def test_rig_without_bounds_on_position_and_force_is_not_moved(
    changes: dict[str, str], key: str
) -> None:
    with at(rig(changes)) as there:
        with pytest.raises(InputError, match=key):
            jogging.jog(there.connection, 1e-3)
        assert there.drive.ticks == 0


@pytest.mark.parametrize(
    ("distance_m", "speed", "message"),
    [
        (11e-3, 1e-3, "limits.command_position_m = 10 mm allows"),
        (1e-3, 0.03, r"at most 20 mm/s is allowed"),
        (1e-3, math.nan, "too fast for a jog"),
    ],
)
def test_jog_too_far_or_too_fast_is_refused(distance_m: float, speed: float, message: str) -> None:
    with at(rig()) as there:
        with pytest.raises(realtime.RefusedError, match=message) as caught:
            jogging.jog(there.connection, distance_m, speed)
        assert caught.value.exit_code == 5
        assert there.drive.ticks == 0


def test_rig_with_similitude_jogs_by_the_structures_millimetres() -> None:
    half_scale = rig({"calibration.similitude": "{ length = 2, force = 4 }"})
    with at(half_scale) as there:
        jogged = jogging.jog(there.connection, 2e-3, 4e-3)
        log = there.drive.log
    assert jogged.moved_m == pytest.approx(2e-3, abs=10e-6)
    # x_m is what stands on the wire: the specimen's.
    assert log["x_m"][-1] == pytest.approx(1e-3, abs=10e-6)
    assert jogged.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=0.01)


# ---- polarity -----------------------------------------------------------------------------------


def commissioned(given: config.RigFile, wired: config.RigFile, *steps: str) -> Certificate:
    with at(given, wired) as there:
        return guide.commission(there.connection, guide.CommissioningSettings(steps or STEPS))


@pytest.mark.parametrize(
    ("wired", "message", "cure"),
    [
        (REVERSED_SENSOR, r"moved against the command: -[01.\d]* mm when 1 mm", REVERSED_SENSOR),
        (REVERSED_COMMAND, "If it was wrong, invert the drive: command = { polarity = -1 }",
         REVERSED_COMMAND),
        (REVERSED_FORCE, "force falls as the displacement rises: k_e = -[45].*"
         "force = { polarity = -1 }", REVERSED_FORCE),
    ],
)  # fmt: skip
def test_wrong_sign_is_found_and_cured_by_the_key_that_the_message_names(
    wired: dict[str, str], message: str, cure: dict[str, str]
) -> None:
    real = rig(wired)
    found = commissioned(rig(), real)
    assert list(found.steps) == ["link", "polarity"]
    step = found.steps["polarity"]
    assert step.passed is False
    assert found.date_of("polarity") == ""
    (fault,) = step.faults
    assert re.search(message, fault)
    cured = commissioned(rig(cure), real, "polarity")
    assert cured.steps["polarity"].faults == ()
    assert cured.date_of("polarity") != ""


def test_remedy_keeps_scale_and_offset_of_the_channel() -> None:
    given = rig({"calibration.displacement": '{ polarity = -1, scale = 2, offset_m = "5 mm" }'})
    remedy = polarity.displacement_remedy(given)
    assert "displacement = { polarity = 1, scale = 2.0, offset_m = 0.005 }" in remedy
    assert "and command = { polarity = -1, scale = 2.0, offset_m = 0.005 }" in remedy
    assert "invert the drive: command = { polarity = 1, scale = 2.0, offset_m = 0.005 }" in remedy


def test_wrong_scale_is_found() -> None:
    wired = rig({"calibration.displacement.scale": "1.5", "calibration.command": "{ scale = 1 }"})
    (fault,) = commissioned(rig(), wired, "polarity").steps["polarity"].faults
    assert "0.66" in fault
    assert "0.8 to 1.2 is allowed" in fault


def test_load_cell_that_is_not_connected_is_found() -> None:
    found = commissioned(rig(), rig({"specimen.0.k_n_per_m": "0"}), "polarity")
    (fault,) = found.steps["polarity"].faults
    assert "the force did not respond" in fault


def test_actuator_that_is_off_is_found() -> None:
    wired = rig({"calibration.command": "{ scale = 1e-4 }"})
    displacement, force = commissioned(rig(), wired, "polarity").steps["polarity"].faults
    assert "did not follow" in displacement
    assert "did not respond" in force


def test_polarity_check_leaves_the_specimen_where_it_was() -> None:
    with at(rig(), rig(REVERSED_SENSOR)) as there:
        guide.commission(there.connection, guide.CommissioningSettings(("polarity",)))
        assert there.position_m == pytest.approx(0.0, abs=30e-6)
        assert np.abs(there.drive.log["target_m"]).max() == pytest.approx(1e-3, abs=30e-6)


# ---- from one motion to the next ----------------------------------------------------------------

CREEPING = {"sensors.displacement": '{ bias_m = "0.3 mm" }', "sensors.force": "{}"}
"""Displacement and command disagree by an error that no file knows of."""


def test_motion_after_motion_goes_on_from_the_command_that_the_drive_has() -> None:
    with at(rig(), rig(CREEPING)) as there:
        went = [jogging.jog(there.connection, 1e-3, 4e-3)]
        first = there.drive.ticks
        went += [jogging.jog(there.connection, way_m, 4e-3) for way_m in (1e-3, -1e-3, -1e-3)]
        target = there.drive.log["target_m"]
    assert [jogged.cause for jogged in went] == ["completed"] * 4
    # At its peak a jog goes 4 mm/s; what was not to be known goes at the very first contact.
    assert np.abs(np.diff(target[first - 1 :])).max() <= 4e-3 / core.FS_HZ * 1.01
    assert target[-1] == pytest.approx(target[first - 1] - 1e-3, abs=2e-9)
    assert target[first - 1] == pytest.approx(1e-3 + 2 * 0.3e-3, abs=5e-6)


def test_recording_of_a_motion_that_went_on_is_replayed_bit_for_bit() -> None:
    still = guided_motion.GuidedMotion("still", np.zeros(100), whole_force=False)
    with at(rig(), rig(CREEPING)) as there:
        guided_motion.carry_out(there.connection, still)
        rec = guided_motion.carry_out(there.connection, still).recording
        codec = there.connection.opened.codec
    taken = np.flatnonzero(rec.samples["flags"] & FLAGS["taken_over"])
    assert taken.size == 1
    assert rec.samples["x_cmd_m"][taken[0]] == pytest.approx(0.6e-3, abs=5e-6)
    assert rec.meta["real_time"]["commands_before"] > 0
    settings = guided_motion.station_of(
        experiment.prescribed(rig(), still.name, still.path_m), still
    )
    reach = settings.watches["position"]
    counted = dataclasses.replace(
        core.Parameters.of(settings), watches={**settings.watches, "rig_position": reach}
    )
    again = core.Station(settings, still.path_m).replay(
        rec.samples, codec, core.IDENTITY, [(1, counted)]
    )
    assert again.tobytes() == rec.samples.tobytes()


@pytest.mark.parametrize("meanwhile", ["stopped", "moved", "other calibration"])
def test_command_begins_at_the_reading_where_the_drive_may_stand_elsewhere(meanwhile: str) -> None:
    still = guided_motion.GuidedMotion("still", np.zeros(100))
    with at(rig(), rig(CREEPING)) as there:
        guided_motion.carry_out(there.connection, still)
        opened = there.connection.opened
        assert opened.left is not None
        if meanwhile == "stopped":
            for _ in range(loop.WATCHDOG_TICKS + 1):
                there.drive.tick()
            assert there.drive.phase == "stopped"
        elif meanwhile == "moved":
            there.drive.tick()  # the last commands are still on their way
            there.drive._c.wanted_m += 1e-3
            for _ in range(DELAY_SAMPLES + 2):
                there.drive.tick()
            assert there.drive.phase == "following"
        else:
            other = core.WireCalibration(x_offset_m=1e-3)
            opened.left = dataclasses.replace(opened.left, calibration=other)
        rec = guided_motion.carry_out(there.connection, still).recording
    assert not (rec.samples["flags"] & FLAGS["taken_over"]).any()
    assert rec.meta["real_time"]["commands_before"] > 0
    first = rec.samples[guided_motion.fresh(rec.samples)][0]
    sent = rec.samples[(rec.samples["flags"] & FLAGS["not_sent"]) == 0][1]
    assert sent["x_cmd_m"] == pytest.approx(first["x_meas_m"], abs=2e-9)


def test_motion_at_the_first_contact_is_made_good_at_a_gentle_speed() -> None:
    """The drive goes where it reads: 0.3 mm. What it reads then is zero, and that is approached."""
    with at(rig(), rig(CREEPING)) as there:
        guided_motion.carry_out(
            there.connection, guided_motion.GuidedMotion("still", np.zeros(100))
        )
        log = there.drive.log
    ramp = log["target_m"][log["state"] == STATES.index("RAMP_IN")]
    assert np.ptp(ramp) == pytest.approx(0.3e-3, abs=5e-6)
    assert np.abs(np.diff(ramp)).max() * core.FS_HZ <= guided_motion.GENTLE_M_PER_S * 1.01


# ---- link ---------------------------------------------------------------------------------------


def test_link_step_has_rate_noise_and_zero() -> None:
    given = rig({"sensors.force.bias_n": "40"})
    with at(given) as there:
        jogging.jog(there.connection, 3e-4)
        plan = guide.CommissioningSettings(("link",))
        step = guide.commission(there.connection, plan).steps["link"]
    assert step.passed is True
    figures = step.figures
    assert figures["fresh_share"] == 1.0
    assert figures["rate_hz"] == pytest.approx(1024.0, rel=1e-6)
    assert figures["link_delay_samples"] == 0
    assert figures["displacement_m"] == pytest.approx(3e-4, abs=10e-6)
    assert figures["jump_m"] == pytest.approx(0.0, abs=20e-6)
    assert figures["force_n"] == pytest.approx(40.0 + 3e-4 * STIFFNESS_N_PER_M, abs=10.0)
    assert figures["noise_m"] == pytest.approx(2e-6, rel=0.1)
    assert figures["noise_n"] == pytest.approx(5.0, rel=0.1)


def test_rig_that_jumps_as_commands_begin_is_found() -> None:
    wired = rig({"calibration.displacement": '{ offset_m = "2 mm" }', "calibration.command": "{}"})
    found = commissioned(rig(), wired)
    assert list(found.steps) == ["link"]
    (fault,) = found.steps["link"].faults
    assert "when commands began" in fault
    assert "starting with offset_m" in fault


def test_link_that_loses_frames_fails() -> None:
    faults = (loop.Fault("drop", 0, 2**40, 0.1),)
    with at(rig(), faults=faults) as there:
        found = guide.commission(there.connection, guide.CommissioningSettings())
    assert list(found.steps) == ["link"]
    assert "% of the ticks had a new pair" in found.steps["link"].faults[0]


def test_drive_that_is_silent_fails_the_link_step_and_nothing_follows() -> None:
    with at(rig(), faults=(loop.Fault("silence", 0, 2**40),)) as there:
        found = guide.commission(there.connection, guide.CommissioningSettings())
    assert list(found.steps) == ["link"]
    assert "nothing arrived in 10 s" in found.steps["link"].faults[0]


# ---- limits -------------------------------------------------------------------------------------

EVERY_LIMIT = {
    "limits.command_position_m": '{ value = "10 mm", action = "hold" }',
    "limits.command_velocity_m_per_s": '{ value = 0.1, action = "ramp-out" }',
    "limits.command_acceleration_m_per_s2": "10",
    "limits.command_increment_m": '{ value = "1 mm", action = "trip" }',
    "limits.force_n": '{ value = "8 kN", action = "trip" }',
    "limits.tracking_error_m": '{ value = "2 mm", action = "ramp-out" }',
    "limits.tracking_indicator_slope_m2_per_s": '{ value = 1e-3, action = "indicate" }',
    "limits.energy_error_j": '{ value = 5, action = "hold" }',
    "limits.sensor_jump_m": '{ value = "2 mm", action = "ramp-out" }',
    "limits.sensor_stuck_s": '{ value = 0.05, action = "ramp-out" }',
}


def test_every_limit_is_provoked_and_does_what_the_rig_file_says() -> None:
    given = rig(EVERY_LIMIT)
    asked: list[str] = []

    def allowed(question: str) -> bool:
        asked.append(question)
        return True

    with at(given) as there:
        checks = limit_checks.check_all(there.connection, 1e-3, allowed)
        assert there.position_m == pytest.approx(0.0, abs=50e-6)
        assert np.abs(there.drive.log["target_m"]).max() < 1.05e-3
    found = {check.key: check for check in checks}
    assert set(found) == {key.removeprefix("limits.") for key in EVERY_LIMIT}
    stuck = found.pop("sensor_stuck_s")
    assert (stuck.value, stuck.fault) == (None, "")
    assert "sensor that freezes" in stuck.reason
    for check in found.values():
        assert check.fault == "", check
        assert check.reason == ""
        assert 0.0 < (check.value or 0.0) < limit_of(given, check.key)
    assert found["command_position_m"].seen == "ramped out: position limit, IDLE"
    assert found["command_increment_m"].seen == "tripped: increment limit, TRIPPED"
    assert found["tracking_indicator_slope_m2_per_s"].seen == "completed, IDLE"
    assert found["command_acceleration_m_per_s2"].seen == "command limited"
    # One for the plain motion, and one for each limit but the stuck sensor.
    assert len(asked) == 10


def limit_of(given: config.RigFile, key: str) -> float:
    value = getattr(given.limits, key)
    return float(getattr(value, "value", value))


def test_plain_velocity_limit_is_seen_to_bound_the_command() -> None:
    given = rig({"limits.command_velocity_m_per_s": "0.1"})
    with at(given) as there:
        checks = limit_checks.check_all(there.connection, 1e-3, lambda _: True)
    (check,) = (check for check in checks if check.key == "command_velocity_m_per_s")
    assert (check.action, check.seen, check.fault) == ("limit", "command limited", "")
    assert check.value == pytest.approx(0.5e-3, rel=0.01)


@pytest.mark.parametrize(
    ("reaction", "fault"),
    [
        ("none", "limits.force_n was not reached; the motion ended for another reason: completed"),
        ("ramp-out", "limits.force_n did not lead to TRIPPED"),
    ],
)
def test_limit_that_does_something_else_than_the_rig_file_says_fails(
    reaction: core.Reaction, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A station whose force limit has the wrong reaction."""
    station_of = guided_motion.station_of

    def weak(setup: object, motion: guided_motion.GuidedMotion) -> core.StationConfig:
        made = station_of(setup, motion)  # type: ignore[arg-type]
        force = made.watches["force"]
        watches = {**made.watches, "force": core.Watch(force.value, reaction)}
        return dataclasses.replace(made, watches=watches)

    monkeypatch.setattr(guided_motion, "station_of", weak)
    step = commissioned(rig(), rig(), "limits").steps["limits"]
    assert step.passed is False
    assert any(text.startswith(fault) for text in step.faults)
    assert len(step.faults) == 1


def test_limit_that_may_not_be_tried_leaves_the_step_unfinished() -> None:
    with at(rig()) as there:
        plan = guide.CommissioningSettings(
            ("limits",), allowed=lambda question: "force_n" not in question
        )
        found = guide.commission(there.connection, plan)
    step = found.steps["limits"]
    assert step.passed is False
    assert step.faults == ("limits.force_n was not tried",)


@pytest.mark.parametrize("stated", [False, True])
def test_rig_without_a_velocity_limit_is_told_to_state_one(stated: bool) -> None:
    said: list[str] = []
    given = {"limits.command_velocity_m_per_s": "0.2"} if stated else {}
    with at(rig(given)) as there:
        plan = guide.CommissioningSettings(("limits",), allowed=lambda _: False, tell=said.append)
        guide.commission(there.connection, plan)
    missing = [text for text in said if "command_velocity_m_per_s is missing" in text]
    assert len(missing) == (0 if stated else 1)


# ---- the drive's own stop -----------------------------------------------------------------------


def without_watchdog(there: Drive) -> None:
    there.drive._c.silent = 0


def slow_watchdog(there: Drive) -> None:
    """It counts every other tick."""
    if there.drive.ticks % 2 and there.drive._c.silent:
        there.drive._c.silent -= 1


def test_drive_stops_by_itself_at_its_twentieth_sample() -> None:
    with at(rig()) as there:
        there.connection = attended(there)
        assert stops.watchdog(there.connection) == stops.Stop(True, 20, False, True, True, True)
        assert stops.trip(there.connection) == stops.Stop(True, 0, False, None)
        # What follows finds a drive that obeys again.
        assert jogging.jog(there.connection, 0.5e-3, 4e-3).cause == "completed"


def attended(there: Drive) -> guided_motion.Connection:
    """As `rthyb commission` has it: whoever is asked before each motion has the drive reset."""
    return dataclasses.replace(there.connection, resets=True)


def released_by_any_command(there: Drive) -> None:
    there.drive._c.latched = 0


def test_drive_that_follows_again_by_itself_after_its_stop_fails() -> None:
    """So did every drive that kept to the frames of before."""
    with at(rig()) as there:
        there.tell = lambda: released_by_any_command(there)
        found = guide.commission(attended(there), guide.CommissioningSettings(("watchdog",))).steps[
            "watchdog"
        ]
    assert found.passed is False
    assert (
        "followed again as soon as it received commands, although nobody had reset it"
        in found.faults[0]
    )


def test_jog_at_a_drive_that_stopped_by_itself_is_refused_until_it_is_reset() -> None:
    with at(rig()) as there:
        assert jogging.jog(there.connection, 0.5e-3, 4e-3).cause == "completed"
        for _ in range(100):
            there.drive.tick()
        # It was told that the silence is meant: it stands, and follows again.
        assert there.drive.phase == "stopped"
        with stops.at_rest(there.connection) as session:
            session.command("trip")
            session.wait(0.1)
        with pytest.raises(RefusedError, match="`rthyb reset RIG`") as told:
            jogging.jog(there.connection, 0.5e-3, 4e-3)
        assert told.value.exit_code == 5
        assert there.drive.phase == "stopped"
        assert stops.release(there.connection) is True
        assert stops.release(there.connection) is False
        assert jogging.jog(there.connection, 0.5e-3, 4e-3).cause == "completed"


@pytest.mark.parametrize(
    ("seen", "told"), [(True, ""), (False, "it did not"), (None, "without --yes")], ids=str
)
def test_stop_of_a_drive_without_status_is_what_the_operator_saw(
    seen: bool | None, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Codec, "has_status", False)
    monkeypatch.setattr(Codec, "has_reset", False)
    asked: list[str] = []

    def witness(question: str) -> bool | None:
        asked.append(question)
        there.drive._c.latched = 0  # released at its panel
        return seen

    plan = guide.CommissioningSettings(("watchdog", "trip"), witness=witness)
    with at(rig()) as there:
        # As its frames would be: nothing in them of a stop.
        there.tell = lambda: setattr(there.drive._c, "latched", 0)
        made = guide.commission(attended(there), plan)
    assert len(asked) == 2
    assert "its panel show that it stays stopped" in asked[0]
    for name in ("watchdog", "trip"):
        assert made.steps[name].passed is seen
        assert told in " ".join(made.steps[name].faults)


@pytest.mark.parametrize(
    ("fault", "step", "message"),
    [
        (without_watchdog, "watchdog", "its watchdog does not work"),
        (
            slow_watchdog,
            "watchdog",
            r"stopped 3[89] of its samples after its last command; at most 20 are",
        ),
    ],
)
def test_drive_whose_watchdog_is_broken_fails(fault: object, step: str, message: str) -> None:
    with at(rig()) as there:
        there.tell = lambda: fault(there)  # type: ignore[operator]
        found = guide.commission(there.connection, guide.CommissioningSettings((step,))).steps[step]
    assert found.passed is False
    assert re.search(message, found.faults[0])


def test_stop_that_comes_late_after_a_trip_or_never_is_told() -> None:
    with at(rig()) as there:
        rows = recorded_trip(there)
    never = rows.copy()
    never["flags"] &= ~np.uint32(FLAGS["stopped"])
    assert stops.after_trip(never) == stops.Stop(False)
    late = delayed_stop(rows, 3)
    assert stops.after_trip(late).ticks == 3


def recorded_trip(there: Drive) -> np.ndarray:
    with stops.at_rest(there.connection) as session:
        session.command("trip")
        session.wait(0.25)
    return session.recording().samples


def delayed_stop(rows: np.ndarray, ticks: int) -> np.ndarray:
    """The same rows of a drive that says so many samples later that it has stopped."""
    late = rows.copy()
    stopped = (rows["flags"] & FLAGS["stopped"]) != 0
    tripped = rows["state"] == STATES.index("TRIPPED")
    first = int(np.flatnonzero(stopped & tripped)[0])
    late["flags"][first : first + ticks] &= ~np.uint32(FLAGS["stopped"])
    return late


def test_frames_lost_around_the_stop_are_no_late_stop() -> None:
    with at(rig()) as there:
        rows = recorded_trip(there)
    tripped = np.flatnonzero(rows["state"] == STATES.index("TRIPPED"))
    hole = rows.copy()
    hole["flags"][tripped[0] : tripped[0] + 3] &= ~np.uint32(FLAGS["fresh"])
    assert stops.after_trip(hole).gap


def test_numbers_of_commands_agree_with_the_echo_of_the_drive() -> None:
    with at(rig()) as there:
        moved = guided_motion.carry_out(
            there.connection, limit_checks.small_motion(there.connection.rig, 0.2e-3)
        )
    rows = moved.rows
    known = guided_motion.fresh(rows) & (rows["echo"] > 0)
    delay = (guided_motion.command_numbers(rows) - rows["echo"].astype(np.int64))[known] % 256
    assert set(delay) == {0}
    assert known.sum() > 1000


# ---- the whole of it ----------------------------------------------------------------------------


def test_sound_rig_passes_every_step_and_is_asked_before_each_motion() -> None:
    asked: list[str] = []
    kept: list[Certificate] = []
    with at(rig()) as there:
        plan = guide.CommissioningSettings(allowed=lambda q: asked.append(q) or True)  # type: ignore[func-returns-value]
        found = guide.commission(there.connection, plan, keep=kept.append)
    assert [(step.name, step.passed) for step in found.steps.values()] == [
        (name, True) for name in STEPS
    ]
    assert [list(c.steps) for c in kept] == [list(STEPS[: n + 1]) for n in range(len(STEPS))]
    watchdog = {"drive_ticks": 20, "stays_stopped": True, "reset": True}
    assert found.steps["watchdog"].figures == watchdog
    assert found.steps["trip"].figures == {"drive_ticks": 0}
    # Link, polarity, plain motion, position, force, watchdog, trip.
    assert len(asked) == 7
    assert not found.virtual


def test_operator_who_says_no_moves_nothing() -> None:
    with at(rig()) as there:
        found = guide.commission(
            there.connection, guide.CommissioningSettings(allowed=lambda _: False)
        )
        assert there.drive.ticks == 0
    assert found.steps == {}


def test_operator_who_stops_a_motion_ends_the_commissioning() -> None:
    with at(rig()) as there:

        def look() -> None:
            if there.drive.received_state == "RUNNING":
                there.operator()

        there.tell = look
        with pytest.raises(guided_motion.StoppedError) as caught:
            guide.commission(there.connection, guide.CommissioningSettings(("polarity",)))
    assert caught.value.exit_code == 130


# ---- identification over the link ---------------------------------------------------------------

QUICK = SweepPlan((2.0, 4.0), 0.5e-3)


def test_identification_over_the_link_finds_what_the_virtual_rig_is() -> None:
    given = rig({"calibration.force.polarity": "-1"})
    with at(given) as there:
        live = identify_live(there.connection, QUICK)
    virtual = identify(given, QUICK)
    assert live.left_out == 0
    assert live.link_delay_samples == 0.0
    for tone in live.tones:
        assert_allclose(tone.delay_s * core.FS_HZ, DELAY_SAMPLES, atol=0.05)
        assert_allclose(tone.gain, 1.0, atol=2e-3)
    assert_allclose(live.alpha, virtual.alpha, atol=0.05)
    assert_allclose(live.k_e_n_per_m, STIFFNESS_N_PER_M, rtol=2e-3)
    assert_allclose(live.rest_noise_m, 2e-6, rtol=0.1)
    assert_allclose(live.rest_noise_n, 5.0, rtol=0.1)


def test_delay_of_the_link_is_told_from_that_of_the_actuator() -> None:
    with at(rig(), faults=(loop.Fault("delay", 0, 2**40, 3.0),)) as there:
        live = identify_live(there.connection, QUICK)
    assert live.link_delay_samples == pytest.approx(3.0, abs=1e-9)
    assert_allclose(live.delay_s * core.FS_HZ, DELAY_SAMPLES + 3, atol=0.05)


def test_lost_readings_are_left_out_of_the_fits() -> None:
    with at(rig(), faults=(loop.Fault("drop", 0, 2**40, 0.03),)) as there:
        live = identify_live(there.connection, QUICK)
    assert live.left_out > 50
    assert_allclose(live.delay_s * core.FS_HZ, DELAY_SAMPLES, atol=0.05)
    assert_allclose(live.alpha, DELAY_SAMPLES, atol=0.3)
    assert_allclose(live.k_e_n_per_m, STIFFNESS_N_PER_M, rtol=2e-3)


def test_limit_that_ends_the_sweep_is_named_with_its_frequency() -> None:
    sweep = SweepPlan((2.0, 4.0), 0.5e-3)
    limit = {"limits.tracking_error_m": '"0.11 mm"'}  # 12 samples at 4 Hz, 0.5 mm: 0.15 mm
    with at(rig(limit)) as there, pytest.raises(guided_motion.LimitError) as caught:
        identify_live(there.connection, sweep)
    assert "the sweep ended at 4 Hz: tripped: tracking limit" in str(caught.value)
    assert caught.value.exit_code == 6


def test_limit_of_the_rig_file_ends_a_sweep_in_virtual_time_as_well() -> None:
    limit = {"limits.tracking_error_m": '"0.11 mm"'}  # 12 samples at 4 Hz, 0.5 mm: 0.15 mm
    with pytest.raises(guided_motion.LimitError) as caught:
        identify(rig(limit), QUICK)
    assert "the sweep ended at 4 Hz: tripped: tracking limit" in str(caught.value)


@pytest.mark.parametrize(
    ("cause", "code"), [("skips", 7), ("stalled", 7), ("heartbeat", 7), ("link_lost", 6)]
)
def test_motion_that_this_pc_spoils_every_time_is_a_matter_of_timing(
    monkeypatch: pytest.MonkeyPatch, cause: str, code: int
) -> None:
    still = guided_motion.GuidedMotion("still", np.zeros(100))
    with at(rig()) as there:
        moved = guided_motion.carry_out(there.connection, still)
        moved.recording.meta["station"]["cause"] = cause
        monkeypatch.setattr(guided_motion, "carry_out", lambda *_, **__: moved)
        with pytest.raises(RthybError, match="3 times; run `rthyb jitter`") as caught:
            guided_motion.undisturbed(there.connection, still)
        assert caught.value.exit_code == code
        with pytest.raises(RthybError, match="the sweep ended before it moved") as caught:
            identify_live(there.connection, QUICK)
        assert caught.value.exit_code == code


@pytest.mark.parametrize(
    ("skipped", "message"),
    [(None, "altered the command at 2 Hz"), (100, "altered the command at 2 Hz"),
     (2000, "skipped ticks at 2 Hz, .*`rthyb jitter`")],
)  # fmt: skip
def test_command_limited_after_skipped_ticks_is_the_fault_of_the_pc(
    skipped: int | None, message: str
) -> None:
    rows = np.zeros(4096, core.RECORD_DTYPE)
    rows["flags"][2010:2020] = FLAGS["limited"]
    if skipped is not None:
        rows["flags"][skipped] = FLAGS["blind"]
    parts = [SineRows(1.0, 0, slice(0, 500)), SineRows(2.0, 600, slice(600, 4000))]
    with pytest.raises(InputError, match=message):
        check_not_limited(rows, parts)


def test_limited_command_is_no_sweep() -> None:
    limit = {"limits.command_velocity_m_per_s": "0.009"}
    with at(rig(limit)) as there, pytest.raises(InputError, match=r"altered the command at 4 Hz"):
        identify_live(there.connection, QUICK)


@pytest.mark.parametrize(
    ("wired", "message"),
    [
        (REVERSED_SENSOR, r"moves against the command; .*displacement = { polarity = -1 }"),
        (REVERSED_FORCE, r"force falls as the displacement rises .*force = { polarity = -1 }"),
    ],
)
def test_identification_names_a_wrong_sign_with_its_remedy(
    wired: dict[str, str], message: str
) -> None:
    with at(rig(), rig(wired)) as there, pytest.raises(InputError, match=message):
        identify_live(there.connection, QUICK)


def test_sweep_stopped_by_the_operator_finds_nothing() -> None:
    asked: list[int] = []
    with at(rig()) as there:

        def look() -> None:
            if (
                there.drive.received_state == "RUNNING"
                and abs(there.position_m) > 0.3e-3
                and not asked
            ):
                asked.append(1)
                there.operator()

        there.tell = look
        with pytest.raises(guided_motion.StoppedError, match="stopped at 2 Hz; there is no result"):
            identify_live(there.connection, QUICK)
        assert there.position_m == pytest.approx(0.0, abs=30e-6)
