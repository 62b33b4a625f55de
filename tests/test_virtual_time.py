"""Tests in virtual time: the same station, limits and replay as at a rig, without a clock."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rthyb_rt import config, core
from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.errors import RthybError
from rthyb_rt.lab import end_reasons, experiment, realtime, virtual_time
from rthyb_rt.record import recording
from rthyb_rt.record.recording import RecordedTest

STATE = {name: number for number, name in enumerate(STATES)}
TEST = """schema = "rthyb-test/1"
rig = "spring"
[test]
name = "plate"
duration_s = 4
[ground_motion]
pga_g = 0.04
[numerical]
period_s = 0.5
damping_ratio = 0.02
"""
RIG = """schema = "rthyb-rig/1"
[rig]
name = "spring"
elastic_stiffness_n_per_m = 666400
[identified]
delay_s = 0.00586
alpha = 6
[actuator]
kind = "pure-delay"
delay_samples = 6
[[specimen]]
element = "stiffness"
k_n_per_m = 666400
"""
NOISE = """
[sensors]
displacement.noise_std_m = 2e-6
force.noise_std_n = 5
"""
QUICK = {"ramp_in_s": 0.05, "tare_s": 0.05}


def prepared(test: str = "", rig: str = "", **limits: object) -> experiment.Setup:
    table = "".join(f"{key} = {value}\n" for key, value in (QUICK | limits).items())
    text = f"{TEST}{test}\n[limits]\n{table}"
    return experiment.prepare(config.parse_test(text), config.parse_rig(RIG + rig))


def proper(rec: RecordedTest) -> np.ndarray:
    return rec.samples[rec.samples["state"] == STATE["RUNNING"]]


def states(rec: RecordedTest) -> list[str]:
    numbers = rec.samples["state"]
    return [STATES[n] for n in numbers[np.flatnonzero(np.diff(numbers, prepend=255))]]


# ---- an ordinary day ----------------------------------------------------------------------------


def test_test_goes_from_idle_over_every_state_and_back_to_idle() -> None:
    setup = prepared()
    rec = virtual_time.run(setup)
    assert states(rec) == ["IDLE", "ZEROED", "ARMED", "RAMP_IN", "RUNNING", "RAMP_OUT", "IDLE"]
    assert rec.meta["end_reason"] == "completed"
    assert rec.meta["clock"] == "virtual"
    assert rec.meta["station"]["cause"] == "completed"
    assert proper(rec).size == setup.ticks
    np.testing.assert_array_equal(rec.samples["tick"], np.arange(rec.samples.size))
    due = np.rint(rec.samples["tick"] * 1e9 / core.FS_HZ)
    np.testing.assert_array_equal(rec.samples["due_ns"], due)
    assert rec.time_s()[rec.running()][0] == 0.0
    for given in rec.replay.commands:
        flags = int(rec.samples["flags"][given["tick"]])
        assert core.command_of(flags) == given["command"]
    assert [c["command"] for c in rec.replay.commands] == ["zero", "arm", "start"]


def test_test_proper_is_that_of_the_controller_alone_at_the_same_rig() -> None:
    """The second formulation: no station, no states, the kernel and the rig in a loop."""
    setup = prepared()
    rows = proper(virtual_time.run(setup))
    alone = np.zeros(setup.ticks, core.RECORD_DTYPE)
    done, _ = core.Controller(setup.controller).run_virtual(
        core.VirtualRig(setup.virtual_rig), setup.ag_mps2, alone
    )
    assert done == rows.size
    for name in ("ag_mps2", "x_num_m", "x_plc_m", "x_cmd_m", "x_meas_m", "f_meas_n", "alpha"):
        np.testing.assert_array_equal(rows[name], alone[name], err_msg=name)
    assert np.abs(rows["x_num_m"]).max() > 1e-3


def test_offset_of_a_sensor_is_tared_away() -> None:
    offset = "\n[sensors]\ndisplacement.bias_m = 0.002\nforce.bias_n = 300\n"
    free, biased = virtual_time.run(prepared()), virtual_time.run(prepared(rig=offset))
    tares = {"displacement_m": 0.002, "force_n": 300.0, "command_m": 0.0}
    assert biased.replay.tares == pytest.approx(tares)
    for name in ("x_meas_m", "f_meas_n", "x_cmd_m"):
        np.testing.assert_allclose(proper(biased)[name], proper(free)[name], rtol=0, atol=1e-9)


@pytest.mark.parametrize("law", ["paper", "robust", "alpha-beta", "none"])
@pytest.mark.parametrize("integrator", ["central-difference", "forward-euler", "cr", "kr-alpha"])
def test_recording_replays_bit_for_bit(tmp_path: Path, law: str, integrator: str) -> None:
    text = f'[controller]\ntype = "{law}"\n'
    test = TEST.replace("[numerical]", f'[numerical]\nintegrator = "{integrator}"')
    setup = experiment.prepare(
        config.parse_test(f"{test}{text}[limits]\ncommand_velocity_m_per_s = 0.3\n"),
        config.parse_rig(RIG + NOISE),
    )
    recording.write(tmp_path / recording.FILE_NAME, virtual_time.run(setup))
    found = realtime.replay(recording.read(tmp_path / recording.FILE_NAME))
    assert found.identical, found
    assert found.rows > setup.ticks


def test_replay_finds_a_row_that_was_altered() -> None:
    rec = virtual_time.run(prepared(rig=NOISE))
    row = int(np.flatnonzero(rec.running())[500])
    rec.samples["x_cmd_m"][row] = np.nextafter(rec.samples["x_cmd_m"][row], 1.0)
    found = realtime.replay(rec)
    assert (found.identical, found.first_row, found.field) == (False, row, "x_cmd_m")


# ---- limits: every action -----------------------------------------------------------------------

FORCE_N = 800


def limited(action: str, **more: object) -> RecordedTest:
    return virtual_time.run(
        prepared(force_n=f'{{ value = {FORCE_N}, action = "{action}" }}', **more)
    )


def test_trip_stops_the_drive_by_itself_and_keeps_the_second_after_it() -> None:
    rec = limited("trip")
    assert states(rec)[-2:] == ["RUNNING", "TRIPPED"]
    assert rec.meta["end_reason"] == "tripped: force limit"
    tripped = rec.samples[rec.samples["state"] == STATE["TRIPPED"]]
    assert tripped.size == 1024
    sent = (tripped["flags"] & FLAGS["not_sent"]) == 0
    assert list(np.flatnonzero(sent)) == [0, 1]  # and the row that tripped sent the first
    last = proper(rec)[-1]
    assert last["code"] & core.STATUS["force_limit"]
    assert last["code"] & core.STATUS["trip"]
    assert abs(last["f_meas_n"]) > FORCE_N >= np.abs(proper(rec)["f_meas_n"][:-1]).max()
    # The drive brakes at 1 m/s^2 from where it was, six samples later, and stands.
    x = tripped["x_meas_m"]
    v = np.diff(x) * core.FS_HZ
    assert np.abs(np.diff(v[8:]) * core.FS_HZ).max() <= 1.0 + 1e-6
    assert np.ptp(x[-100:]) == 0.0
    assert realtime.replay(rec).identical


def test_ramp_out_brings_the_specimen_back_to_zero() -> None:
    rec = limited("ramp-out")
    assert states(rec)[-3:] == ["RUNNING", "RAMP_OUT", "IDLE"]
    assert rec.meta["end_reason"] == "ramped out: force limit"
    assert abs(rec.samples["x_meas_m"][-1]) < 2e-6
    assert realtime.replay(rec).identical


def test_hold_stands_for_a_second_and_then_ramps_out() -> None:
    rec = virtual_time.run(prepared(command_position_m='{ value = 0.001, action = "hold" }'))
    assert states(rec)[-4:] == ["RUNNING", "HOLD", "RAMP_OUT", "IDLE"]
    held = rec.samples["state"] == STATE["HOLD"]
    assert np.count_nonzero(held) == 1024
    assert rec.meta["interrupted"]
    assert rec.meta["end_reason"] == "ramped out: position limit"
    assert rec.meta["station"]["cause"] == "position"
    assert rec.meta["station"]["cause_limit"] == 0.001
    assert abs(rec.meta["station"]["cause_value"]) > 0.001
    assert realtime.replay(rec).identical


def test_force_that_stays_beyond_its_limit_while_held_ends_in_a_trip() -> None:
    rec = limited("hold")
    assert states(rec)[-3:] == ["RUNNING", "HOLD", "TRIPPED"]
    assert np.count_nonzero(rec.samples["state"] == STATE["HOLD"]) <= 257
    assert rec.meta["station"]["cause"] == "force"
    assert realtime.replay(rec).identical


@pytest.mark.parametrize("action", ["indicate", "none"])
def test_limit_that_ends_nothing_lets_the_test_complete(action: str) -> None:
    rec = limited(action)
    assert rec.meta["end_reason"] == "completed"
    assert ("force" in rec.meta["station"]["indicated"]) == (action == "indicate")
    flagged = (proper(rec)["code"] & core.STATUS["force_limit"]) != 0
    expected = np.abs(proper(rec)["f_meas_n"]) > FORCE_N
    np.testing.assert_array_equal(flagged, expected if action == "indicate" else False)


SMALL = {
    "command_position_m": ('"0.2 mm"', "position"),
    "command_velocity_m_per_s": ('"2 mm/s"', "velocity"),
    "command_increment_m": ('"2 um"', "increment"),
    "force_n": ("100", "force"),
    "tracking_error_m": ('"1 um"', "tracking"),
    "tracking_indicator_slope_m2_per_s": ("1e-10", "indicator"),
    "energy_error_j": ("1e-6", "energy"),
}


@pytest.mark.parametrize("key", SMALL)
@pytest.mark.parametrize("action", ["trip", "ramp-out", "hold", "indicate"])
def test_every_limit_of_the_motion_works_with_every_action(key: str, action: str) -> None:
    value, cause = SMALL[key]
    rec = virtual_time.run(prepared(**{key: f'{{ value = {value}, action = "{action}" }}'}))
    if action == "indicate":
        assert rec.meta["end_reason"] == "completed"
        assert cause in rec.meta["station"]["indicated"]
        return
    assert rec.meta["station"]["cause"] == cause
    # A force that stays beyond its limit is not held for long.
    trips = action == "trip" or (action == "hold" and cause == "force")
    begun = "tripped" if trips else "ramped out"
    assert rec.meta["end_reason"] == f"{begun}: {end_reasons.in_words(cause)}"
    assert ("HOLD" in states(rec)) == (action == "hold")
    assert realtime.replay(rec).identical


def test_command_never_passes_a_position_limit_that_ends_the_test() -> None:
    for action in ("trip", "ramp-out", "hold"):
        limit = f'{{ value = "1 mm", action = "{action}" }}'
        rec = virtual_time.run(prepared(command_position_m=limit))
        assert np.abs(rec.samples["x_cmd_m"]).max() <= 1e-3
        assert rec.meta["station"]["cause"] == "position"


def test_sensor_that_stands_at_its_stop_ends_the_test_by_a_lost_link() -> None:
    rig = "\n[sensors]\ndisplacement.range_m = 0.001\n"
    rec = virtual_time.run(prepared(rig=rig))
    assert rec.meta["end_reason"].startswith("tripped")
    assert states(rec)[-1] == "TRIPPED"


def test_not_finite_ground_motion_trips_and_nothing_of_it_reaches_the_rig() -> None:
    setup = prepared()
    setup.ag_mps2[700] = np.nan
    rec = virtual_time.run(setup)
    assert rec.meta["end_reason"] == "tripped: a value was not a number"
    assert np.isfinite(rec.samples["x_cmd_m"]).all()


def test_rig_that_never_rests_is_named() -> None:
    noisy = "\n[sensors]\ndisplacement.noise_std_m = 1e-4\n"
    with pytest.raises(RthybError, match=r"not at rest.*rest_spread_m"):
        virtual_time.run(prepared(rig=noisy, rest_spread_m='"1 um"'))


# ---- as a user sees it --------------------------------------------------------------------------


def written(folder: Path, **limits: object) -> None:
    setup = prepared(rig=NOISE, **limits)
    (folder / "rig.toml").write_text(config.dump(setup.rig), encoding="utf-8")
    text = f"{TEST}\n[limits]\n" + "".join(
        f"{key} = {value}\n" for key, value in (QUICK | limits).items()
    )
    (folder / "test.toml").write_text(text, encoding="utf-8")


@pytest.mark.parametrize("action", ["trip", "hold", "ramp-out"])
def test_command_line_leaves_with_six_after_a_limit(
    rthyb: Any, tmp_path: Path, action: str
) -> None:
    written(tmp_path, force_n=f'{{ value = {FORCE_N}, action = "{action}" }}')
    answer = rthyb("run", "test.toml", "--rig", "rig.toml", "--no-report", "--json", "--out", "o")
    assert answer.code == 6
    document = json.loads(answer.out)
    assert "force limit" in document["end_reason"]
    assert rthyb("replay", "o").code == 0
    assert tomllib.loads((tmp_path / "o/test.toml").read_text())["limits"]["force_n"]["action"] == (
        action
    )


# ---- faults on demand ---------------------------------------------------------------------------


def rehearsed(rthyb: Any, folder: Path, *faults: str, **limits: object) -> tuple[int, RecordedTest]:
    """Run a test of 4 s with faults; return its exit code and its recording."""
    written(folder, **limits)
    options = [part for fault in faults for part in ("--fault", fault)]
    answer = rthyb("run", "test.toml", "--rig", "rig.toml", "--no-report", "--out", "o", *options)
    return answer.code, recording.open_run(folder / "o")


def test_lost_pairs_are_seen_before_the_lab_sees_them(rthyb: Any, tmp_path: Path) -> None:
    code, rec = rehearsed(rthyb, tmp_path, "drop:p=0.05,from=1,to=3")
    assert code == 0
    assert rec.meta["clock"] == "stepped"
    lost = np.flatnonzero(proper(rec)["flags"] & FLAGS["lost"]) / core.FS_HZ
    assert 1.0 <= lost.min() < 1.2
    assert 2.8 < lost.max() <= 3.0 + 2 / core.FS_HZ
    assert lost.size == pytest.approx(0.05 * 2048, rel=0.3)
    assert realtime.replay(rec).identical


def test_silent_drive_is_rehearsed_to_the_trip(rthyb: Any, tmp_path: Path) -> None:
    code, rec = rehearsed(rthyb, tmp_path, "silence:from=2")
    assert code == 6
    assert rec.meta["end_reason"] == "tripped: link lost"
    assert proper(rec).size == pytest.approx(2 * 1024 + 20, abs=2)


def test_force_beyond_its_limit_is_rehearsed_with_every_action(rthyb: Any, tmp_path: Path) -> None:
    for action, last in (("trip", "TRIPPED"), ("ramp-out", "IDLE"), ("hold", "IDLE")):
        folder = tmp_path / action
        folder.mkdir()
        limit = f'{{ value = 9000, action = "{action}" }}'
        at = f"{folder.name}/o"
        written(folder, force_n=limit)
        answer = rthyb(
            *("run", f"{action}/test.toml", "--rig", f"{action}/rig.toml", "--no-report"),
            *("--fault", "force:n=10000,from=1,to=1.1", "--out", at),
        )
        assert answer.code == 6
        rec = recording.open_run(tmp_path / at)
        assert rec.meta["real_time"]["cause"] == "force"
        assert states(rec)[-1] == last
        assert ("HOLD" in states(rec)) == (action == "hold")


def test_two_faults_at_once_each_do_their_part(rthyb: Any, tmp_path: Path) -> None:
    _, rec = rehearsed(rthyb, tmp_path, "delay:ticks=3,from=1,to=2", "not-finite:from=3")
    assert rec.meta["end_reason"].startswith("tripped: a value was not a number")
    rows = proper(rec)
    assert np.flatnonzero(np.isnan(rows["x_read_m"]))[0] == pytest.approx(3 * 1024, abs=2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nonsense", "no such kind of fault"),
        ("drop:q=1", "drop accepts from, to, p, each at most once"),
        ("drop:p=2", "drop accepts 0 to 1"),
        ("stuck:p=1", "stuck accepts from, to, each at most once"),
        ("jump:from=1", "jump needs a value in m"),
        ("drop:from=5,to=4", "it ends at 4 s, before its start at 5 s"),
        ("drop:from=now", "could not convert"),
        ("power-cut:from=1", "use silence"),
    ],
)
def test_fault_that_cannot_be_is_refused_with_what_can(rthyb: Any, text: str, said: str) -> None:
    answer = rthyb("run", "--fault", text)
    assert answer.code == 2
    assert said in " ".join(answer.err.split())


def test_faults_of_a_wire_belong_to_the_rig_at_its_other_end(rthyb: Any) -> None:
    answer = rthyb("run", "--realtime", "--fault", "drop")
    assert answer.code == 2
    assert "rthyb rig" in answer.err
