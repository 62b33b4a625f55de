"""A whole test conducted over the wire: on the stepped clock, and with threads of their own."""

from __future__ import annotations

import dataclasses
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from realtime_bench import (
    ATTEMPTS,
    QUIET,
    ROWS,
    STALLED,
    STATE,
    Bench,
    moment_s,
    setup,
    stop_begins,
    until,
)

from rthyb_rt import core
from rthyb_rt.analysis import summary
from rthyb_rt.core import dbc, loop, mapped_ring, wire
from rthyb_rt.core.laws import LAWS
from rthyb_rt.core.wire import NOTICES
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import axis_wires, end_reasons, experiment, realtime, virtual_time
from rthyb_rt.lab.realtime import collector
from rthyb_rt.lab.realtime.collector import Collector
from rthyb_rt.record import mat_csv, recording, ring
from rthyb_rt.report import render
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening

pytestmark = pytest.mark.alone


@pytest.fixture(autouse=True)
def _rings_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rings lie in memory on this machine, in a folder of the test's own."""
    monkeypatch.setattr(ring, "default_folder", lambda: tmp_path / "rings")


def rings(tmp_path: Path) -> list[Path]:
    return ring.find(tmp_path / "rings") if (tmp_path / "rings").exists() else []


def running(rec: recording.RecordedTest) -> np.ndarray:
    return rec.samples[rec.samples["state"] == STATE["RUNNING"]]


# ---- an ordinary day ----------------------------------------------------------------------------


def test_test_goes_from_idle_to_idle_and_its_ring_is_gone(tmp_path: Path) -> None:
    saved: list[recording.RecordedTest] = []
    rec = Bench().run(save=saved.append)
    rows = rec.samples
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    order = rows["state"][np.flatnonzero(np.diff(rows["state"], prepend=255))]
    names = ("IDLE", "ZEROED", "ARMED", "RAMP_IN", "RUNNING", "RAMP_OUT", "IDLE")
    assert list(order) == [STATE[name] for name in names]
    assert running(rec).size == ROWS
    assert rec.meta["end_reason"] == "completed"
    assert rec.meta["clock"] == "stepped"
    assert [c["command"] for c in rec.replay.commands] == ["zero", "arm", "start"]
    assert saved == [rec]
    assert rings(tmp_path) == []


def test_commands_stand_in_the_rows_of_their_ticks() -> None:
    rec = Bench().run()
    for given in rec.replay.commands:
        flags = int(rec.samples["flags"][given["tick"]])
        assert core.command_of(flags) == given["command"]
        assert not flags & core.FLAGS["refused"]


def test_running_rows_are_those_of_virtual_time_to_the_wires_last_digit() -> None:
    """Without a lead nothing amplifies what the wire rounds away: 1 nm and 1 mN, twice."""
    changes = {"controller.type": "none", "ground_motion.pga_g": "0.02"}
    # Else the link has a limit of its own, which in virtual time only indicates.
    changes["limits.command_velocity_m_per_s"] = "1"
    live = running(Bench(changes, QUIET).run())
    virtual = running(virtual_time.run(setup(changes, QUIET)))
    assert live.size == virtual.size
    for name in ("x_num_m", "x_plc_m", "x_cmd_m", "x_meas_m"):
        np.testing.assert_allclose(live[name], virtual[name], rtol=0, atol=5e-9)
    np.testing.assert_allclose(live["f_meas_n"], virtual["f_meas_n"], rtol=0, atol=5e-3)
    np.testing.assert_array_equal(live["ag_mps2"], virtual["ag_mps2"])
    assert np.abs(virtual["x_num_m"]).max() > 1e-3


def test_adaptive_controller_ends_where_it_ends_in_virtual_time() -> None:
    live = running(Bench({}, QUIET).run())
    virtual = running(virtual_time.run(setup({}, QUIET)))
    np.testing.assert_allclose(live["x_meas_m"], virtual["x_meas_m"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(live["alpha"], virtual["alpha"], rtol=0, atol=1e-3)


LESS_EAGER = {
    f"controller.amb.log_gain{n}": gain for n, gain in enumerate(("6.4", "4.2", "0", "-1"))
}
"""The published gains of amb are for another rig; here they amplify what the wire rounds."""


@pytest.mark.parametrize("law", LAWS)
def test_every_control_law_does_over_a_link_what_it_does_in_virtual_time(law: str) -> None:
    changes = {"controller.type": law, "limits.command_velocity_m_per_s": "1"}
    changes |= LESS_EAGER if law == "amb" else {}
    rec = Bench(changes, QUIET).run()
    live, virtual = running(rec), running(virtual_time.run(setup(changes, QUIET)))
    assert rec.meta["end_reason"] == "completed"
    assert live.size == virtual.size == ROWS
    np.testing.assert_allclose(live["x_meas_m"], virtual["x_meas_m"], rtol=0, atol=5e-9)
    np.testing.assert_allclose(live["alpha"], virtual["alpha"], rtol=0, atol=1e-3)
    leads = np.abs(live["x_cmd_m"] - live["x_num_m"]).max()
    assert leads < 1e-8 if law == "none" else leads > 1e-3
    assert realtime.replay(rec).identical


def test_rig_mounted_the_other_way_round_gives_the_same_motion() -> None:
    mounted = {
        "rig.calibration.displacement.polarity": "-1",
        "rig.calibration.displacement.offset_m": "0.004",
        "rig.calibration.force.polarity": "-1",
        "rig.calibration.force.scale": "2",
    }
    plain, turned = running(Bench({}, QUIET).run()), running(Bench({}, QUIET | mounted).run())
    np.testing.assert_allclose(turned["x_meas_m"], plain["x_meas_m"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(turned["f_meas_n"], plain["f_meas_n"], rtol=0, atol=1.0)
    correlation = np.corrcoef(plain["x_read_m"], turned["x_read_m"])[0, 1]
    assert correlation > 0.999


def test_recording_of_a_test_in_real_time_serves_everything(tmp_path: Path) -> None:
    rec = Bench().run()
    recording.write(tmp_path / "recording.h5", rec)
    back = recording.read(tmp_path / "recording.h5")
    np.testing.assert_array_equal(back.samples, rec.samples)
    assert back.meta["real_time"] == rec.meta["real_time"]
    assert back.replay.tares == rec.replay.tares
    found = summary.summarize(back)
    assert found.duration_s == 1.5
    assert found.response_nrmse is not None
    assert found.response_nrmse < 0.05
    assert not any(found.flags[name] for name in ("predicted", "blind", "not_sent", "frozen"))
    assert found.as_json()["live"]["lost_pairs"] == 0
    labels = [row.label for row in summary.table(found)]
    # On a stepped clock there is no punctuality to tell of.
    assert labels[-2:] == ["Samples", "Link"]
    assert [notice.text for notice in summary.notices(found) if notice.level == "alarm"] == []
    assert "Punctuality" not in render(back)
    mat_csv.to_csv(back, tmp_path / "test.csv")
    assert len((tmp_path / "test.csv").read_text().splitlines()) == ROWS + 1
    mat_csv.to_mat(back, tmp_path / "test.mat")


@pytest.mark.parametrize(
    ("rig", "faults"),
    [
        ({}, ()),
        (
            {
                "rig.calibration.displacement.polarity": "-1",
                "rig.calibration.force.scale": "0.5",
                "rig.calibration.similitude.length": "2",
            },
            (),
        ),
        (
            {},
            (
                loop.Fault("drop", 600, 400, 0.2),
                loop.Fault("corrupt", 1100, 300, 1.0),
                loop.Fault("delay", 1500, 100, 3.0),
                loop.Fault("drop-command", 1700, 12, 1.0),
            ),
        ),
        ({}, (loop.Fault("not-finite", 1000, 5),)),
        ({}, (loop.Fault("silence", 1000, 2**40),)),
    ],
    ids=["sunny", "turned round", "bad link", "no number", "dead"],
)
def test_recording_is_computed_again_bit_for_bit(
    rig: dict[str, str], faults: tuple[loop.Fault, ...], tmp_path: Path
) -> None:
    recording.write(tmp_path / "recording.h5", Bench({}, rig, faults).run())
    rec = recording.read(tmp_path / "recording.h5")
    found = realtime.replay(rec)
    assert (found.first_row, found.field, found.largest) == (None, None, {})
    assert found.identical
    assert found.rows == rec.samples.size


@contextmanager
def in_step() -> Iterator[tuple[realtime.Session, Callable[[], recording.RecordedTest]]]:
    """Begin a session on the stepped clock; once it has ended, its recording can be had, once."""
    made = setup()
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(made.rig, theirs) as drive:
        session = realtime.Session(made, ours, clock="stepped", before_tick=drive.tick)

        def recorded() -> recording.RecordedTest:
            rec = session.recording()
            session.discard()
            return rec

        with session:
            session.start()
            session.wait(0.2)
            yield session, recorded


def test_parameters_that_were_set_meanwhile_are_part_of_the_replay() -> None:
    with in_step() as (session, recorded):
        session.command("zero")
        session.wait(0.2)
        slow = core.Parameters.of(session.run.config)
        slow = dataclasses.replace(slow, velocity_limit_m_per_s=0.01, adapt=False)
        assert session.set_parameters(slow) == 1
        session.command("arm")
        session.command("start")
        session.wait(1.0)
    rec = recorded()
    assert rec.samples["generation"][-1] == 1
    assert (running(rec)["flags"] & core.FLAGS["limited"]).any()
    assert realtime.replay(rec).identical
    rec.replay.parameters[1]["values"]["velocity_limit_m_per_s"] = 0.011
    assert not realtime.replay(rec).identical


def test_set_that_the_station_refuses_is_told_and_is_no_part_of_the_recording() -> None:
    with in_step() as (session, recorded):
        session.command("zero")
        session.wait(0.2)
        limited = core.Parameters.of(session.run.config)
        limited = dataclasses.replace(limited, velocity_limit_m_per_s=0.01)
        assert session.set_parameters(limited) == 1
        session.command("arm")
        session.command("start")
        session.wait(0.5)
        without = dataclasses.replace(limited, velocity_limit_m_per_s=0.0)
        with pytest.raises(realtime.RefusedError) as told:
            session.set_parameters(without)
        assert "refused in state RUNNING" in str(told.value)
        assert "stop and change them in IDLE" in str(told.value)
        assert session.loop.set_taken(2) is False
        assert session.set_parameters(limited) == 3
        session.wait(0.2)
    rec = recorded()
    assert set(rec.samples["generation"]) == {0, 1, 3}
    assert [one["generation"] for one in rec.replay.parameters] == [0, 1, 3]
    assert rec.meta["real_time"]["loop"]["parameters_refused"] == 1
    assert realtime.replay(rec).identical


def test_over_a_users_dbc_a_recording_is_replayed_without_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = opening.socket_pair
    codec = dbc.load(Path(__file__).parents[1] / "hw" / "rthyb.dbc")
    ends = [dataclasses.replace(end, codec=codec) for end in pair()]
    monkeypatch.setattr(opening, "socket_pair", lambda: ends)
    recording.write(tmp_path / "recording.h5", Bench({"ground_motion.duration_s": "0.3"}).run())
    monkeypatch.setitem(sys.modules, "cantools", None)
    rec = recording.read(tmp_path / "recording.h5")
    assert rec.replay.codec == codec.table
    assert realtime.replay(rec).identical


def test_a_recording_states_all_settings_and_a_replay_derives_none(tmp_path: Path) -> None:
    made = setup({"ground_motion.duration_s": "0.2"})
    station = experiment.station_config(made, real=True)
    unlike = dataclasses.replace(
        station,
        watches={"force": core.Watch(1.0, "indicate")},
        ramp_in_ticks=77,
        path_acceleration_m_per_s2=0.123,
    )
    bench = Bench({"ground_motion.duration_s": "0.2"})
    rec = bench.run(station=unlike)
    recording.write(tmp_path / "recording.h5", rec)
    back = recording.read(tmp_path / "recording.h5")
    written = back.replay.parameters[0]["values"]["station"]
    assert core.StationConfig.of(written) == unlike
    assert np.count_nonzero(back.samples["state"] == STATE["RAMP_IN"]) == 77
    assert realtime.replay(back).identical
    written["ramp_in_ticks"] = 78
    assert not realtime.replay(back).identical
    written["no_such_figure"] = 1
    with pytest.raises(RthybError, match="replay the recording with the version that recorded"):
        realtime.replay(back)


def test_recording_that_ends_amid_skipped_ticks_is_replayed_up_to_them() -> None:
    """As a black box does that is full there, or the ring of a process that was killed."""
    with in_step() as (session, recorded):
        session.loop.step(skipped=4)
        session.wait(0.1)
    rec = recorded()
    (blind,) = np.nonzero(rec.samples["flags"] & core.FLAGS["blind"])
    assert blind.size == 4
    assert realtime.replay(rec).identical
    cut = dataclasses.replace(rec, samples=rec.samples[: blind[2]])
    found = realtime.replay(cut)
    assert found.identical
    assert found.rows == blind[0]
    cut.samples["x_cmd_m"][blind[0] - 1] += 1e-9
    assert not realtime.replay(cut).identical


def test_row_that_was_changed_is_where_the_replay_departs() -> None:
    rec = Bench().run()
    rec.samples["x_read_m"][1000] += 1e-9
    found = realtime.replay(rec)
    assert not found.identical
    assert (found.first_row, found.field) == (1000, "x_meas_m")


def test_recording_without_its_first_rows_cannot_be_replayed() -> None:
    rec = Bench().run()
    rec.samples = rec.samples[5:]
    with pytest.raises(InputError, match="first rows of the test are missing"):
        realtime.replay(rec)


def test_session_beside_the_ring_knows_tare_and_commands(tmp_path: Path) -> None:
    found: list[recording.RecordedTest] = []

    def look() -> None:
        (path,) = rings(tmp_path)
        found.append(ring.recover(path).recording)

    rec = Bench().when("RUNNING", look).run()
    (half,) = found
    np.testing.assert_array_equal(half.samples, rec.samples[: half.samples.size])
    assert half.replay.tares == rec.replay.tares
    assert half.replay.commands == rec.replay.commands
    assert half.meta["end_reason"] == "still running (recovered from the telemetry ring)"
    assert summary.summarize(half).live is None


# ---- the operator -------------------------------------------------------------------------------


def test_operator_who_stops_brings_the_specimen_to_rest() -> None:
    bench = Bench()
    rec = bench.when("RUNNING", bench.operator.stop).run()
    assert rec.meta["end_reason"] == "stopped by the operator"
    assert rec.samples["state"][-1] == STATE["IDLE"]
    assert STATE["RAMP_OUT"] in rec.samples["state"]
    assert 200 <= running(rec).size < 300
    assert bench.log["target_m"][-1] == pytest.approx(rec.replay.tares["displacement_m"], abs=2e-9)


def test_operator_who_stops_twice_trips() -> None:
    bench = Bench()
    asked = [bench.operator.stop] * 2
    bench.when("RUNNING", lambda: [ask() for ask in asked] and None)
    rec = bench.run()
    assert rec.meta["end_reason"] == "tripped: the operator"
    assert rec.samples["state"][-1] == STATE["TRIPPED"]
    assert np.count_nonzero(rec.samples["state"] == STATE["TRIPPED"]) == mapped_ring.AFTER_TRIP
    log = bench.log
    told = (log["state"] == STATE["TRIPPED"]) & (log["frames"] > 0)
    assert np.count_nonzero(told) == 3
    assert log["phase"][-1] == loop.PHASES.index("stopped")


@pytest.mark.parametrize("state", ["IDLE", "ZEROED"])
def test_operator_who_stops_before_the_start_moves_nothing(state: str) -> None:
    bench = Bench({"limits.tare_s": "0.5"})
    rec = bench.when(state, bench.operator.stop, ticks=1 if state == "ZEROED" else 100).run()
    moved = np.isin(rec.samples["state"], [STATE["RAMP_IN"], STATE["RUNNING"]])
    if state == "IDLE":
        assert rec.meta["end_reason"] == "stopped by the operator before it began"
        assert not moved.any()
        assert summary.summarize(rec).flags["not_sent"] == 0
    assert rec.samples["state"][-1] == STATE["IDLE"]
    assert np.ptp(bench.log["target_m"][200:]) < 2e-5


# ---- what can be the matter ---------------------------------------------------------------------


def test_limit_trips_and_the_second_after_is_kept() -> None:
    limit = {"limits.command_position_m": '{ value = "0.5 mm", action = "trip" }'}
    bench = Bench(limit)
    rec = bench.run()
    assert rec.meta["end_reason"] == "tripped: position limit"
    assert rec.meta["real_time"]["cause"] == "position"
    assert np.count_nonzero(rec.samples["state"] == STATE["TRIPPED"]) == mapped_ring.AFTER_TRIP
    assert summary.notices(summary.summarize(rec))[0].text.startswith(
        "The test did not complete: tripped: position limit, command"
    )


def test_limit_that_ramps_out_is_named() -> None:
    limit = {"limits.force_n": '{ value = "200 N", action = "ramp-out" }'}
    rec = Bench(limit).run()
    assert rec.meta["end_reason"] == "ramped out: force limit"
    assert rec.samples["state"][-1] == STATE["IDLE"]


def test_limit_that_holds_says_what_to_do_and_waits_for_the_operator() -> None:
    limit = {"limits.force_n": '{ value = "200 N", action = "hold" }'}
    warnings: list[str] = []
    bench = Bench(limit)
    rec = bench.when("HOLD", bench.operator.stop, ticks=1000).run(warn=warnings.append)
    (warning,) = warnings
    assert re.fullmatch(
        r"held: force 0\.2\d+ kN \(limit 0\.2 kN\); the specimen stays in place until Ctrl-C "
        "returns it to zero",
        warning,
    )
    assert rec.meta["end_reason"] == "ramped out: force limit"
    assert rec.meta["interrupted"]
    assert np.count_nonzero(rec.samples["state"] == STATE["HOLD"]) > 900


def test_link_that_dies_while_it_is_armed_is_a_trip_and_no_error() -> None:
    bench = Bench(faults=(loop.Fault("silence", 260, 10000),))
    rec = bench.run()
    assert rec.meta["end_reason"] == "tripped: link lost"
    remedy = summary.notices(summary.summarize(rec))[1].text
    assert "check the cable, and the power and display of the drive" in remedy
    assert not (rec.samples["state"] == STATE["RUNNING"]).any()


def test_force_at_the_end_of_its_sensors_range_names_the_sensor_and_not_the_cable() -> None:
    no_limit = {"limits.force_n": '{ value = "1 MN", enable = false }'}
    rec = Bench(no_limit, faults=(loop.Fault("force", 1200, 10000, 40e3),)).run()
    assert rec.meta["end_reason"] == "tripped: link lost"
    remedy = summary.notices(summary.summarize(rec))[1].text
    read = re.search(
        r"no usable pair for 20 ticks \(the last one read (.*) mm and (.*) kN, before", remedy
    )
    assert read is not None, remedy
    assert abs(float(read[1])) < 20.0
    assert 25.0 <= float(read[2]) < 60.0
    assert "check the sensors of displacement and force" in remedy
    assert "cable" not in remedy


def ends_with(row: dict[str, int], count: int = 20) -> np.ndarray:
    """Rows of a test whose last ones before a trip are alike."""
    rows = np.zeros(60, core.RECORD_DTYPE)
    rows["state"] = STATE["RUNNING"]
    rows["flags"] = core.FLAGS["fresh"]
    rows["state"][50:] = STATE["TRIPPED"]
    for name, value in row.items():
        rows[name][50 - count : 50] = value
    return rows


FLAG = core.FLAGS
REFUSED, ABSENT = FLAG["predicted"], FLAG["predicted"] | FLAG["lost"]
BEYOND = core.STATUS["out_of_range"]


@pytest.mark.parametrize(
    ("rows", "look_at"),
    [
        (ends_with({"flags": ABSENT}), "check the cable, and the power and display"),
        (
            ends_with({"flags": REFUSED, "code": BEYOND}),
            "check the sensors of displacement and force",
        ),
        (ends_with({"flags": ABSENT, "code": BEYOND}), "marked a reading as invalid; check"),
        (ends_with({"flags": REFUSED}), "jumped farther than anything can move; check its sensor"),
        (ends_with({"flags": REFUSED}, count=5), "check the cable, and the power and display"),
        (ends_with({"flags": REFUSED})[:50], "jumped farther"),
        (ends_with({})[:0], "check the cable, and the power and display"),
    ],
)
def test_lost_link_says_whether_the_cable_or_a_sensor_is_to_be_looked_at(
    rows: np.ndarray, look_at: str
) -> None:
    found = end_reasons.remedy("link_lost", rows, core.FS_HZ)
    assert look_at in found
    assert "usable pair" in found
    assert end_reasons.remedy("stalled", rows, core.FS_HZ) == end_reasons.REMEDIES["stalled"]
    assert end_reasons.remedy("completed", rows, core.FS_HZ) == ""


NO_NUMBER = core.CAUSES.index("not_finite")
OF_AXIS_2 = NO_NUMBER | 2 << 8
OF_SENSOR_1 = NO_NUMBER | 1 << 12


@pytest.mark.parametrize(
    ("cause", "reading", "flags", "said"),
    [
        (NO_NUMBER, (np.nan, 7.0), "fresh", "received from the drive"),
        (NO_NUMBER, (0.0, np.inf), "fresh", "received from the drive"),
        (NO_NUMBER, (np.nan, np.nan), "lost", "received from the drive"),
        (OF_AXIS_2, (1e-3, 7.0), "fresh", "received from the drive"),
        (OF_SENSOR_1, (1e-3, 7.0), "fresh", "received from the drive"),
        (NO_NUMBER, (1e-3, 7.0), "fresh", "computed from readings that were numbers: check the"),
        # Nothing arrived, with one axis, and with several.
        (NO_NUMBER, (0.0, 0.0), "lost", "computed from readings that were numbers: check the"),
        (NO_NUMBER, (np.nan, 0.0), "lost", "computed from readings that were numbers: check the"),
        # Of a version that did not record the cause of a row.
        (0, (1e-3, 7.0), "fresh", "received from the drive or computed: check the sensors first"),
    ],
)
def test_value_that_is_not_a_number_is_told_as_received_or_as_computed(
    cause: int, reading: tuple[float, float], flags: str, said: str
) -> None:
    rows = np.zeros(60, core.RECORD_DTYPE)
    rows["state"], rows["state"][50:] = STATE["RUNNING"], STATE["TRIPPED"]
    rows["cause"][49:], rows["flags"][49] = cause, FLAG[flags]
    rows["x_read_m"][49], rows["f_read_n"][49] = reading
    # What comes after the trip says nothing of it.
    rows["x_read_m"][50:] = np.nan if np.isfinite(reading).all() else 0.0
    found = end_reasons.remedy("not_finite", rows, core.FS_HZ)
    assert said in found
    own = end_reasons.remedy("not_finite", rows, core.FS_HZ, "frame.so")
    assert ("frame.so" in own) == ("computed from" in said)


def test_every_end_that_lies_outside_the_test_says_what_to_do() -> None:
    names = core.CAUSES
    # Behind the limits of one axis stand the causes that only several axes have.
    outside = names[names.index("not_finite") : names.index("position")]
    outside += names[names.index("apart") :]
    in_their_own_words = {"not_arrived", "skip_warning", "lost_warning"}
    of_several_axes = core.CAUSES[core.CAUSES.index("apart") :]
    told = {*outside, *of_several_axes} - in_their_own_words
    assert set(end_reasons.REMEDIES) == told
    assert "check its velocity" in end_reasons.WORDS["not_arrived"]


@pytest.mark.parametrize(
    ("fault", "message", "code"),
    [
        (loop.Fault("silence", 0, 2**40), "nothing arrived in 10 s; is the drive switched on", 3),
        (loop.Fault("drop-force", 0, 2**40), "no pair of displacement and force .*lone", 3),
        (loop.Fault("corrupt", 0, 2**40), "no pair of displacement and force .*bad crc", 3),
        # An operator's reset is asked for: that is a refusal, not a fault of a file.
        (loop.Fault("drop-command", 0, 2**40), "reports that it has stopped.*rthyb reset", 5),
    ],
)
def test_drive_that_is_not_ready_is_named_and_nothing_moves(
    fault: loop.Fault, message: str, code: int, tmp_path: Path
) -> None:
    bench = Bench(faults=(fault,))
    with pytest.raises(RthybError, match=message) as caught:
        bench.run()
    assert caught.value.exit_code == code
    assert caught.value.problems[0].where == "socket pair"
    assert np.ptp(bench.log["target_m"]) == 0.0
    assert rings(tmp_path) == []


def test_rig_that_is_not_at_rest_is_not_zeroed(tmp_path: Path) -> None:
    noisy = {"rig.sensors.displacement.noise_std_m": "5e-5"}
    with pytest.raises(InputError, match=r"moved by .* mm during the tare of 0.125 s") as caught:
        Bench({"limits.rest_spread_m": "0.1 mm"}, noisy).run()
    assert "at most 0.1 mm is allowed" in str(caught.value)
    assert rings(tmp_path) == []


def test_recording_that_cannot_be_kept_is_left_in_the_ring(tmp_path: Path) -> None:
    def full(_: recording.RecordedTest) -> None:
        raise RthybError("no space left")

    with pytest.raises(RthybError, match="no space left") as caught:
        Bench().run(save=full)
    (path,) = rings(tmp_path)
    assert f"rthyb recover {path}" in caught.value.__notes__[0]
    rec = ring.recover(path).recording
    assert running(rec).size == ROWS
    assert rec.meta["end_reason"].startswith("closed")


def test_failure_during_the_motion_trips_and_leaves_the_ring(tmp_path: Path) -> None:
    bench = Bench()

    def fail() -> None:
        raise ValueError("a fault of the program")

    with pytest.raises(ValueError, match="fault of the program") as caught:
        bench.when("RUNNING", fail).run()
    (path,) = rings(tmp_path)
    assert str(path) in caught.value.__notes__[0]
    rec = ring.recover(path).recording
    assert rec.samples["state"][-5] == STATE["RUNNING"]
    assert (rec.samples["state"][-4:] == STATE["TRIPPED"]).all()
    not_sent = rec.samples["flags"][-4:] & core.FLAGS["not_sent"] != 0
    np.testing.assert_array_equal(not_sent, [False, False, False, True])


def test_settings_that_the_core_refuses_leave_no_ring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, senseless = setup(), core.WireCalibration(x_gain=0.0)
    monkeypatch.setattr(axis_wires, "calibration", lambda _: senseless)
    ours, theirs = opening.socket_pair()
    with ours, theirs, pytest.raises(core.CoreError):
        realtime.Session(made, ours, clock="stepped")
    assert rings(tmp_path) == []


def test_command_for_another_state_is_refused_with_its_reason() -> None:
    made = setup()
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(made.rig, theirs) as drive:
        session = realtime.Session(made, ours, clock="stepped", before_tick=drive.tick)
        with session:
            session.start()
            session.wait(0.2)
            with pytest.raises(realtime.RefusedError, match="start: refused in state IDLE"):
                session.command("start")
            assert session.run.commands[-1]["refused"]
        session.discard()


# ---- words --------------------------------------------------------------------------------------


@pytest.mark.parametrize("cause", core.CAUSES)
def test_every_cause_has_its_words(cause: str) -> None:
    for state in ("IDLE", "TRIPPED"):
        words = realtime.end_reason(state, cause)
        assert "_" not in words
        assert words.startswith("tripped") == (state == "TRIPPED")
    assert (realtime.end_reason("IDLE", cause) == "completed") == (cause == "completed")


def test_what_never_moved_was_not_ramped_out() -> None:
    words = realtime.end_reason("IDLE", "skips", moved=False)
    assert words == "ended before anything moved: too many skipped ticks"
    assert realtime.end_reason("IDLE", "skips") == "ramped out: too many skipped ticks"
    assert realtime.end_reason("TRIPPED", "stalled", moved=False) == "tripped: this PC stalled"


def test_command_that_never_arrives_is_told_with_its_time_and_where_to_look() -> None:
    words = realtime.end_reason("TRIPPED", "not_arrived")
    assert words.startswith("tripped: the command came no closer to the end of its path for 10 s")
    assert "velocity and acceleration limits" in words


@pytest.mark.parametrize(
    ("text", "kind", "first", "ticks", "value"),
    [
        ("drop@2", "drop", 2048, 2**62, 1.0),
        ("drop@2.5:0.1=0.5", "drop", 2560, 102, 0.5),
        ("not-finite@1:0", "not-finite", 1024, 1, 1.0),
        ("jump@0=-1e-3", "jump", 0, 2**62, -1e-3),
    ],
)
def test_fault_of_the_command_line_becomes_ticks(
    text: str, kind: loop.FaultKind, first: int, ticks: int, value: float
) -> None:
    assert virtual_rig.parse_faults([text]) == ((loop.Fault(kind, first, ticks, value),), None)


def test_power_cut_of_the_command_line_is_the_first_of_all() -> None:
    assert virtual_rig.parse_faults(["power-cut@7", "power-cut@3"]) == ((), 3.0)


@pytest.mark.parametrize(
    "text", ["drop:p", "drop@", "burn@1", "drop@-1", "drop@1:x", "drop@1=1e999"]
)
def test_fault_that_cannot_be_understood_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=text.partition("@")[0]):
        virtual_rig.parse_faults([text])


def test_fault_of_a_test_is_of_the_kinds_that_are_possible_there() -> None:
    with pytest.raises(InputError, match="allowed are drop,") as caught:
        virtual_rig.parse_mishaps(["burn@1"])
    assert "power-cut" not in str(caught.value)
    with pytest.raises(InputError, match="has no power supply of its own; use silence"):
        virtual_rig.parse_mishaps(["power-cut@1"])


def test_every_fault_of_the_drive_has_a_name_on_the_command_line() -> None:
    assert set(loop._FAULTS) | {"power-cut"} == set(virtual_rig.FAULT_KINDS)


# ---- with threads of their own ------------------------------------------------------------------


class Threads:
    """A virtual rig in a thread, as a process of its own would have it."""

    def __init__(self, made: experiment.Setup) -> None:
        self.ours, theirs = opening.socket_pair()
        line = virtual_rig.OpenedLine(theirs)
        self.stop = virtual_rig.StopRequest()
        self.results: list[virtual_rig.RigResult] = []
        plan = virtual_rig.RigPlan(log_ticks=60000)

        def serve() -> None:
            self.results.append(virtual_rig.serve(made.rig, line, plan, self.stop))
            line.close()

        self.thread = threading.Thread(target=serve)

    def __enter__(self) -> Threads:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self.thread.join()
        self.ours.close()

    @property
    def log(self) -> np.ndarray:
        return self.results[0].log


def test_host_clock_keeps_every_row_and_says_how_punctual_it_was() -> None:
    made = setup()
    for number in range(1, ATTEMPTS + 1):
        begin_s = time.monotonic()
        with Threads(made) as rig:
            rec = realtime.run(made, rig.ours)
        print(f"attempts: {number}")
        if rec.meta["real_time"]["cause"] not in STALLED:
            break
    assert rec.meta["end_reason"] == "completed"
    rows, facts = rec.samples, rec.meta["real_time"]
    assert begin_s < 1e-9 * facts["began_ns"] < moment_s(rec, -1) < time.monotonic()
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    assert facts["missed_rows"] == []
    ticks = facts["ticks"]
    assert ticks["executed"] + ticks["skipped"] == ticks["elapsed"] == rows.size
    assert facts["loop"]["records"] == rows.size
    assert facts["wake"]["count"] == sum(facts["wake"]["counts"]) == ticks["executed"]
    assert rec.replay.skips[:, 1].sum() == ticks["skipped"]
    assert running(rec).size == ROWS
    np.testing.assert_array_equal(running(rec)["ag_mps2"], made.ag_mps2)
    # Once more the last command, three times: the controller takes leave of its drive.
    assert rig.log["frames"].sum() == facts["loop"]["sent"] + 3


def test_recorder_that_fails_has_the_drive_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    made = setup({"test.duration_s": "20"})
    take = realtime.LiveRun.take

    def fail(self: realtime.LiveRun, samples: np.ndarray) -> None:
        if (samples["state"] == STATE["RUNNING"]).any():
            raise MemoryError
        take(self, samples)

    monkeypatch.setattr(realtime.LiveRun, "take", fail)
    with Threads(made) as rig, pytest.raises(RthybError, match="the recorder failed"):
        realtime.run(made, rig.ours)
    log = rig.log
    assert log["phase"][-1] == loop.PHASES.index("stopped")
    # On a machine that stalls two of the three come in one tick of the drive.
    told = np.count_nonzero((log["state"] == STATE["TRIPPED"]) & (log["frames"] > 0))
    assert 1 <= told <= 3
    assert log["silent"][stop_begins(log)] <= loop.WATCHDOG_TICKS


class Clock:
    """Stands in for the module ``time``, and goes when it is told to."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(collector, "time", made)
    return made


@pytest.fixture
def kept(clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    """A collector of an empty run; its thread only waits."""
    assert clock is not None
    monkeypatch.setattr(Collector, "_keep", lambda self: self._done.wait())
    made = realtime.LiveRun.make(setup(), "host", wire.can(), tmp_path / "rings")
    found = Collector(made, lambda: None)
    found.start()
    yield found
    found.stop()
    made.remove()


def test_process_that_was_stopped_for_six_seconds_has_its_recorder_look_first(
    kept: Collector, clock: Clock
) -> None:
    """After SIGCONT the operator's thread may wake first: that says nothing of the tick thread."""
    kept.check()
    clock.now_s += 6.0
    for _ in range(4):
        kept.check()
        clock.now_s += 0.02
    kept._run.ring.push(np.zeros(1, core.RECORD_DTYPE))
    kept.drain()
    for _ in range(100):
        kept.check()
        clock.now_s += 0.02
    # Stopped again and again, each time for a look: none of it was running time of this process.
    clock.now_s += 6.0
    kept.check()
    clock.now_s += 6.0
    kept.check()


def test_tick_thread_that_stands_still_is_told_of_as_a_fault_of_this_pc(
    kept: Collector, clock: Clock
) -> None:
    def look() -> None:
        while clock.now_s < 1010.0:
            kept.check()
            clock.now_s += 0.02

    with pytest.raises(realtime.TimingError, match=r"the tick thread has stopped.*rthyb jitter"):
        look()
    assert 1005.1 <= clock.now_s <= 1005.3
    assert realtime.TimingError.exit_code == 7


@pytest.mark.parametrize("required", [True, False])
def test_missing_privileges_are_a_warning_or_a_refusal(
    required: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = setup({"test.duration_s": "0.25"})
    monkeypatch.setattr(loop.Loop, "privileges", property(lambda _: ["signals_blocked"]))
    warnings: list[str] = []
    with Threads(made) as rig:
        if required:
            with pytest.raises(
                realtime.TimingError, match="real-time priority and locked"
            ) as found:
                realtime.run(made, rig.ours, require_realtime=True, warn=warnings.append)
            assert found.value.exit_code == 7
            assert rings(tmp_path) == []
        else:
            realtime.run(made, rig.ours, warn=warnings.append)
            assert len(warnings) == 1
    at_rest = [STATE["IDLE"], *(told for told, name in NOTICES.items() if name == "LEAVING")]
    assert np.isin(rig.log["state"], at_rest).all() == required


def test_stop_is_passed_on_while_the_terminal_takes_nothing() -> None:
    made = setup({"test.duration_s": "30"})
    operator, stuck = realtime.Operator(), threading.Event()

    def progress(done: int, total: int) -> None:
        if done:
            threading.Timer(0.2, operator.stop).start()
            stuck.wait(8.0)

    for attempt in range(1, ATTEMPTS + 1):
        with Threads(made) as rig:
            rec = realtime.run(made, rig.ours, operator=operator, progress=progress)
        stuck.set()
        if rec.meta["real_time"]["cause"] not in STALLED:
            break
        print(f"attempt {attempt}: {rec.meta['end_reason']}")
        operator.stops = 0
        stuck.clear()
    assert rec.meta["end_reason"] == "stopped by the operator"
    assert np.count_nonzero(rec.samples["state"] == STATE["RUNNING"]) < 4 * core.FS_HZ


def test_operator_who_is_not_heard_of_has_the_test_ramped_out() -> None:
    made = setup({"test.duration_s": "30"})
    for attempt in range(1, ATTEMPTS + 1):
        with Threads(made) as rig, realtime.Session(made, rig.ours) as session:
            session.start()
            session.attended()
            begun = time.monotonic()
            while not session.follows() and time.monotonic() < begun + 20.0:
                session.wait(0.02)
            for command in ("zero", "arm", "start"):
                session.command(command)  # type: ignore[arg-type]
                while session.state == "IDLE":
                    session.wait(0.02)
            while session.state == "RAMP_IN":
                session.wait(0.02)
            until(lambda: session.loop.cause != "none", "the end of a test that nobody attends")
            cause = session.loop.cause
        if cause not in STALLED or cause == "heartbeat":
            break
        print(f"attempt {attempt}: {cause}")
    assert cause == "heartbeat"
