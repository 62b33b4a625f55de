"""Limits of test and rig, and what becomes of them in virtual time and at the station."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args, get_origin

import numpy as np
import pytest
from command_line import Rthyb
from pydantic import BaseModel

from rthyb_rt import config, core
from rthyb_rt.config import axesfile, baselinefile, numerical, rigfile, testfile
from rthyb_rt.config import limits as config_limits
from rthyb_rt.config.limits import WATCHED
from rthyb_rt.core.group import Reaction
from rthyb_rt.core.library import options
from rthyb_rt.core.station import Command
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, realtime, virtual_time
from rthyb_rt.rig.commissioning import certificate

TEST = """schema = "rthyb-test/1"
[test]
name = "plate"
duration_s = 4
[ground_motion]
pga_g = 0.04
start_s = 1.0
[numerical]
mass_kg = 4220
damping_n_s_per_m = 2121
[controller]
alpha0 = 6
"""
RIG = """schema = "rthyb-rig/1"
[rig]
name = "spring"
elastic_stiffness_n_per_m = 666400
load_cell = "specimen"
[actuator]
kind = "pure-delay"
delay_samples = 6
[[specimen]]
element = "stiffness"
k_n_per_m = 666400
"""


def limits(**given: str) -> str:
    return "[limits]\n" + "".join(f"{key} = {value}\n" for key, value in given.items())


def prepared(test: str = "", rig: str = "") -> experiment.Setup:
    return experiment.prepare(config.parse_test(TEST + test), config.parse_rig(RIG + rig))


def refused(test: str, rig: str) -> dict[str, str]:
    with pytest.raises(InputError) as caught:
        config.derive(config.parse_test(TEST + test), config.parse_rig(RIG + rig))
    # Each with its line: "test:14: limits.force_n".
    places = [problem.where.split(": ") for problem in caught.value.problems]
    assert all(place.startswith("test:") for place, _ in places)
    return {
        key: problem.message
        for (_, key), problem in zip(places, caught.value.problems, strict=True)
    }


# ---- what a file may say ------------------------------------------------------------------------


def test_plain_number_trips_but_of_the_velocity_only_limits() -> None:
    given = config.parse_test(
        TEST + limits(force_n='"15 kN"', command_velocity_m_per_s=0.4, sensor_stuck_samples=50)
    ).limits
    assert given.force_n is not None
    assert (given.force_n.value, given.force_n.action) == (15000, "trip")
    assert given.command_velocity_m_per_s is not None
    assert (given.command_velocity_m_per_s.action, given.command_velocity_m_per_s.acts) == (
        "none",
        False,
    )
    table = config.parse_test(TEST + limits(command_velocity_m_per_s="{ value = 0.4 }")).limits
    assert table.command_velocity_m_per_s is not None
    assert table.command_velocity_m_per_s.action == "trip"


def test_slips_of_the_pen_are_named_all_at_once_with_line_value_and_range() -> None:
    text = TEST + limits(
        comand_position_m=0.04,
        force_n='{ value = "15 kN", action = "tripp" }',
        energy_error_j='"3 mm"',
        tracking_indicator_slope_m2_per_s='{ value = "1 mm^2/s", enabled = true }',
        sensor_stuck_s=0,
        command_increment_m=0,
        ramp_in_s=0,
    )
    with pytest.raises(InputError) as caught:
        config.parse_test(text, "test.toml")
    assert {p.where.split(": ")[1]: p.message for p in caught.value.problems} == {
        "limits.comand_position_m": 'unknown key (did you mean "command_position_m"?); allowed '
        f"here: {', '.join(config.Limits.model_fields)}",
        "limits.force_n.action": 'found "tripp" (did you mean "trip"?); must be one of "none", '
        '"indicate", "hold", "ramp-out", "trip"',
        "limits.energy_error_j": 'found "3 mm" (that is a length); the limit must be an energy '
        "from 1e-9 to 1e12 J",
        "limits.tracking_indicator_slope_m2_per_s.enabled": 'unknown key (did you mean "enable"?); '
        "allowed here: value, enable, action",
        "limits.sensor_stuck_s": "found 0; the limit must be from 0.001 to 60 s",
        "limits.command_increment_m": "found 0; the limit must be from 1e-9 to 100 m",
        "limits.ramp_in_s": "found 0; the duration of the ramp-in must be from 0.01 to 600 s",
    }
    assert [p.where.split(":")[1] for p in caught.value.problems] == [str(n) for n in range(14, 21)]


@pytest.mark.long
def test_json_schema_takes_a_limit_as_a_number_a_text_and_a_table() -> None:
    jsonschema = pytest.importorskip("jsonschema", reason="comes with pyslammer")
    schema = config.json_schema("test")
    for value in ("15000", '"15 kN"', '{ value = 15000, action = "hold" }'):
        jsonschema.validate(tomllib.loads(TEST + limits(force_n=value)), schema)
    for value in ("true", "-3", '{ value = 15000, action = "stop" }', '{ action = "hold" }'):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(tomllib.loads(TEST + limits(force_n=value)), schema)
    rig = config.shipped_rig("shaking-table-can").read_text(encoding="utf-8")
    jsonschema.validate(tomllib.loads(rig), config.json_schema("rig"))


# ---- the rig's own limits -----------------------------------------------------------------------


def test_limit_that_the_test_leaves_out_is_the_rigs() -> None:
    setup = prepared(limits(force_n=9000), limits(force_n=25000, command_position_m=0.08))
    assert setup.test.limits.command_position_m is not None
    assert setup.test.limits.command_position_m.value == 0.08
    watches = experiment.station_config(setup).watches
    # The rig's act before the tare, the test's after it.
    assert "position" not in watches
    assert watches["rig_position"] == core.Watch(0.08, "trip")
    assert watches["force"] == core.Watch(9000, "trip")
    assert watches["rig_force"] == core.Watch(25000, "trip")
    sources = setup.derived.limits.sources
    assert (sources["force_n"], sources["command_position_m"]) == ("test", "rig")
    assert sources["tare_s"] == "default"
    assert "energy_error_j" not in sources


def test_limit_above_the_rigs_is_refused_naming_both() -> None:
    found = refused(
        limits(force_n=30000, command_acceleration_m_per_s2=20, sensor_stuck_samples=128),
        limits(force_n=25000, command_acceleration_m_per_s2=10, sensor_stuck_s=0.05),
    )
    assert found == {
        "limits.force_n": 'found 30000 N; rig "spring" has limits.force_n = 25000 N, action '
        '"trip", and a test may not allow more; remove the key from the test to use the rig\'s',
        "limits.sensor_stuck_samples": 'found 0.125 s; rig "spring" has '
        'limits.sensor_stuck_s = 0.05 s, action "trip", and a test may not allow more; '
        "remove the key from the test to use the rig's",
        "limits.command_acceleration_m_per_s2": 'found 20 m/s^2; rig "spring" has '
        "limits.command_acceleration_m_per_s2 = 10 m/s^2, at most; remove the key from the test "
        "to use the rig's",
    }


@pytest.mark.parametrize(
    "weaker",
    [
        "{ value = 9000, action = 'indicate' }",
        "{ value = 9000, action = 'hold' }",
        "{ value = 9000, enable = false }",
    ],
)
def test_limit_of_the_rig_cannot_be_switched_off_or_weakened(weaker: str) -> None:
    rig = limits(force_n='{ value = 25000, action = "ramp-out" }')
    (message,) = refused(limits(force_n=weaker), rig).values()
    assert 'action "ramp-out", and a test may not weaken it; use that action or a stronger' in (
        message
    )
    stronger = prepared(limits(force_n='{ value = 9000, action = "trip" }'), rig)
    assert experiment.station_config(stronger).watches["force"] == core.Watch(9000, "trip")


def test_rig_that_only_limits_the_velocity_is_not_weakened_by_a_test_that_does() -> None:
    rig = limits(command_velocity_m_per_s=0.5)
    assert prepared(limits(command_velocity_m_per_s=0.3), rig).test.limits
    assert refused(limits(command_velocity_m_per_s=0.6), rig)
    assert refused(limits(command_velocity_m_per_s="{ value = 0.3, enable = false }"), rig)


def test_ramp_in_and_tare_of_the_rig_are_the_least_and_its_other_figures_the_most() -> None:
    rig = limits(ramp_in_s=3, tare_s=2, armed_timeout_s=20, rest_spread_m=2e-4)
    assert prepared(limits(ramp_in_s=4, tare_s=2, armed_timeout_s=10, rest_spread_m=1e-4), rig)
    found = refused(limits(ramp_in_s=2, tare_s=1, armed_timeout_s=30, rest_spread_m=3e-4), rig)
    assert set(found) == {
        "limits.ramp_in_s",
        "limits.tare_s",
        "limits.armed_timeout_s",
        "limits.rest_spread_m",
    }
    assert "3 s, at least" in found["limits.ramp_in_s"]


def test_limit_given_as_a_list_is_told_what_a_limit_is() -> None:
    found = refused(limits(command_position_m='["80 mm"]'), "")
    (message,) = found.values()
    assert message == "found a list of 1; the limit must be from 1e-6 to 100 m"


def test_faults_of_limits_come_together_with_the_others() -> None:
    text = limits(force_n=30000) + "[controller.rfc]\nwindow_periods = 0.0005\n"
    assert set(refused(text, limits(force_n=25000))) == {
        "limits.force_n",
        "controller.rfc.window_periods",
    }


def test_path_faster_than_the_command_may_be_is_refused() -> None:
    found = refused(
        limits(
            path_velocity_m_per_s=0.05,
            path_acceleration_m_per_s2=3,
            command_velocity_m_per_s=0.04,
            command_increment_m='"20 um"',
            command_acceleration_m_per_s2=2,
        ),
        "",
    )
    assert "limits.command_increment_m = 2e-05 m allows" in found["limits.path_velocity_m_per_s"]
    assert "at most 2 m/s^2" in found["limits.path_acceleration_m_per_s2"]


# ---- virtual time -------------------------------------------------------------------------------


def test_limit_of_the_rig_ends_a_virtual_test_and_is_in_its_recording() -> None:
    setup = prepared("", limits(force_n=800))
    run = virtual_time.run(setup)
    assert run.meta["end_reason"] == "tripped: force limit of the rig"
    held = tomllib.loads(run.test_toml)["limits"]
    assert held["force_n"] == {"value": 800.0, "enable": True, "action": "trip"}
    assert (held["ramp_in_s"], held["path_velocity_m_per_s"]) == (2.0, 0.02)
    assert realtime.replay(run).identical
    # Read again with its rig it is the same test.
    again = experiment.prepare(config.parse_test(run.test_toml), config.parse_rig(run.rig_toml))
    assert again.controller == setup.controller
    assert experiment.station_config(again) == experiment.station_config(setup)


# ---- the station --------------------------------------------------------------------------------


def test_every_limit_has_its_watch_with_value_and_action() -> None:
    actions = ("indicate", "hold", "ramp-out", "trip", "trip", "hold", "hold", "ramp-out", "none",
               "trip", "hold", "trip", "none", "trip", "indicate")  # fmt: skip
    values = (0.04, 0.4, 0.001, 9000, 0.004, 0.002, 1.5, 50 / 1024, 0.005, 40 / 1024, 700, 0.2, 0.1,
              0.3, 0.02)  # fmt: skip
    given = {
        key: f'{{ value = {value}, action = "{action}" }}'
        for key, value, action in zip(WATCHED, values, actions, strict=True)
    }
    watches = experiment.station_config(prepared(limits(**given))).watches
    assert watches == {
        "position": core.Watch(0.04, "indicate"),
        "velocity": core.Watch(0.4, "hold"),
        "increment": core.Watch(0.001, "ramp-out"),
        "force": core.Watch(9000, "trip"),
        "tracking": core.Watch(0.004, "trip"),
        "indicator": core.Watch(0.002, "hold"),
        "energy": core.Watch(1.5, "hold"),
        "sensor_stuck": core.Watch(50, "ramp-out"),
        "force_stuck": core.Watch(40, "trip"),
        "force_jump": core.Watch(700, "hold"),
        "lost_pairs": core.Watch(0.2, "trip"),
        "skips": core.Watch(0.3, "trip"),
        "skip_warning": core.Watch(0.02, "indicate"),
    }


def test_figures_of_paths_and_zeroing_are_the_stations() -> None:
    setup = prepared(limits(command_velocity_m_per_s=0.5))
    made = experiment.station_config(setup)
    brake = setup.derived.limits.brake_acceleration_m_per_s2
    assert made == core.StationConfig(
        made.controller, watches=made.watches, brake_acceleration_m_per_s2=brake
    )
    # Without noise of the sensors, and without limits, what is left to watch is link and PC.
    assert {name: watch.value for name, watch in made.watches.items()} == {
        "lost_pairs": 0.1,
        "lost_warning": 0.01,
        "skips": 50 / 1024,
        "skip_warning": 0.01,
    }
    assert {watch.reaction for watch in made.watches.values()} == {"indicate"}
    made = experiment.station_config(
        prepared(limits(ramp_in_s=1.5, armed_timeout_s=10, tare_s=0.25, rest_spread_m=5e-4))
    )
    assert (made.ramp_in_ticks, made.armed_ticks, made.tare_ticks) == (1536, 10240, 256)
    assert made.rest_spread_m == 5e-4


def test_paths_take_half_of_what_the_command_may() -> None:
    made = experiment.station_config(
        prepared(limits(command_velocity_m_per_s=0.03, command_acceleration_m_per_s2=0.3))
    )
    assert made.path_velocity_m_per_s == 0.015
    assert made.path_acceleration_m_per_s2 == 0.15
    # 10 um a sample are 10.24 mm/s.
    small = experiment.station_config(prepared(limits(command_increment_m='"10 um"')))
    assert small.path_velocity_m_per_s == pytest.approx(0.00512)
    given = limits(path_velocity_m_per_s=0.03, command_velocity_m_per_s=0.03)
    assert experiment.station_config(prepared(given)).path_velocity_m_per_s == 0.03


def test_rest_spread_follows_the_noise_of_the_sensor() -> None:
    assert experiment.station_config(prepared()).rest_spread_m == 1e-4
    noisy = '[sensors]\ndisplacement.noise_std_m = "20 um"\n'
    assert experiment.station_config(prepared("", noisy)).rest_spread_m == pytest.approx(4e-4)


# ---- the station at work, on the stepped clock --------------------------------------------------

Reading = Callable[[int, float, float], tuple[float, float]]


class Bench:
    """A station as the files make it, joined to their virtual rig, and stepped through a test."""

    def __init__(self, setup: experiment.Setup, reading: Reading = lambda n, x, f: (x, f)) -> None:
        self.station = core.Station(experiment.station_config(setup), setup.ag_mps2)
        self.rig = core.VirtualRig(setup.virtual_rig)
        self.reading = reading
        self.at_drive = 0.0
        self.rows: list[np.ndarray] = []

    def step(self, command: core.Command = "none") -> None:
        x, f, _ = self.rig.step(self.at_drive)
        tick = self.station.tick(*self.reading(self.station.test_tick, x, f), command=command)
        self.rows.append(tick.records.copy())
        if tick.sent:
            self.at_drive = tick.x_cmd_m

    def until(self, *states: str, most: int = 12000) -> str:
        for _ in range(most):
            if self.station.state in states:
                return self.station.state
            self.step()
        raise AssertionError(f"stayed in {self.station.state}")

    def running(self) -> Bench:
        self.step()
        self.step("zero")
        self.until("ZEROED")
        self.step("arm")
        self.step("start")
        self.until("RUNNING")
        return self

    def all_rows(self) -> np.ndarray:
        return np.concatenate(self.rows)


QUICK = {"ramp_in_s": "0.1", "tare_s": "0.1"}


def test_test_at_the_station_is_the_test_of_virtual_time() -> None:
    setup = prepared(limits(force_n=9000, command_velocity_m_per_s=0.4, **QUICK))
    bench = Bench(setup).running()
    bench.until("RAMP_OUT")
    assert bench.station.cause == "completed"
    rows = bench.all_rows()
    rows = rows[rows["state"] == core.STATES.index("RUNNING")]
    run = virtual_time.run(setup)
    virtual = run.samples[run.running()]
    np.testing.assert_allclose(rows["x_meas_m"], virtual["x_meas_m"], atol=1e-12)
    np.testing.assert_allclose(rows["alpha"], virtual["alpha"], atol=1e-9)


SMALL = {
    "command_position_m": '"0.2 mm"',
    "command_velocity_m_per_s": '"2 mm/s"',
    "command_increment_m": '"2 um"',
    "force_n": "100",
    "tracking_error_m": '"10 um"',
    "tracking_indicator_slope_m2_per_s": "1e-9",
    "energy_error_j": "1e-4",
    "sensor_stuck_s": "0.05",
    "sensor_jump_m": '"1 mm"',
    "force_stuck_s": "0.05",
    "force_jump_n": "1000",
}
CAUSES = ("position", "velocity", "increment", "force", "tracking", "indicator", "energy",
          "sensor_stuck", "sensor_jump", "force_stuck", "force_jump")  # fmt: skip


def faulty(key: str) -> Reading:
    """Readings of a rig one of whose sensors sticks or jumps after a while."""
    if key == "force_stuck_s":
        return lambda n, x, f: (x, 1.0 if n > 500 else f)
    if key == "force_jump_n":
        return lambda n, x, f: (x, f + (2000.0 if n > 500 else 0.0))
    if key == "sensor_stuck_s":
        return lambda n, x, f: (1e-6 if n > 500 else x, f)
    if key == "sensor_jump_m":
        return lambda n, x, f: (x + (0.002 if n > 500 else 0.0), f)
    return lambda n, x, f: (x, f)


@pytest.mark.parametrize(("key", "cause"), zip(SMALL, CAUSES, strict=True))
@pytest.mark.parametrize(
    ("action", "state"), [("hold", "HOLD"), ("ramp-out", "RAMP_OUT"), ("trip", "TRIPPED")]
)
def test_limit_of_the_file_does_at_the_station_what_its_action_says(
    key: str, cause: str, action: str, state: str
) -> None:
    given = {key: f'{{ value = {SMALL[key]}, action = "{action}" }}'}
    bench = Bench(prepared(limits(**QUICK, **given)), faulty(key)).running()
    assert bench.until("HOLD", "RAMP_OUT", "TRIPPED") == state
    assert bench.station.cause == cause
    # Long before the end of the ground motion: nothing but the limit did it.
    assert bench.station.test_tick < 4000


@pytest.mark.parametrize("action", ["none", "indicate"])
def test_limit_that_does_not_act_lets_the_test_run_to_its_end(action: str) -> None:
    given = {"force_n": f'{{ value = 100, action = "{action}" }}'}
    bench = Bench(prepared(limits(**QUICK, **given))).running()
    assert bench.until("HOLD", "RAMP_OUT", "TRIPPED") == "RAMP_OUT"
    assert bench.station.cause == "completed"
    assert bench.station.indicated == (["force"] if action == "indicate" else [])


def test_plain_velocity_limits_the_command_at_the_station_and_does_not_react() -> None:
    bench = Bench(prepared(limits(command_velocity_m_per_s='"2 mm/s"', **QUICK))).running()
    assert bench.until("HOLD", "RAMP_OUT", "TRIPPED") == "RAMP_OUT"
    assert bench.station.cause == "completed"
    steps = np.abs(np.diff(bench.all_rows()["x_cmd_m"]))
    assert 0.99 * 0.002 / 1024 < steps.max() <= 0.002 / 1024 * (1 + 1e-9)


def test_command_never_leaves_the_position_limit_at_the_station() -> None:
    given = {"command_position_m": '{ value = "0.2 mm", action = "hold" }'}
    bench = Bench(prepared(limits(**QUICK, **given))).running()
    bench.until("HOLD")
    for _ in range(300):
        bench.step()
    rows = bench.all_rows()
    assert np.abs(rows["x_cmd_m"]).max() <= 0.0002
    assert np.abs(rows["x_plc_m"]).max() > 0.0002


def test_noisy_sensor_can_be_zeroed_with_the_spread_that_follows_from_its_noise() -> None:
    noisy = '[sensors]\ndisplacement.noise_std_m = "20 um"\n'
    bench = Bench(prepared("", noisy))
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench = Bench(prepared(limits(rest_spread_m='"0.1 mm"'), noisy))
    bench.step()
    bench.step("zero")
    for _ in range(1500):
        bench.step()
    assert bench.station.zeroing_failed


def test_ramp_out_of_the_file_keeps_to_the_path_velocity() -> None:
    given = {"path_velocity_m_per_s": "0.004"}
    bench = Bench(prepared(limits(**QUICK, **given))).running()
    while abs(bench.rows[-1]["x_num_m"][-1]) < 0.003:
        bench.step()
    bench.step("stop")
    bench.until("IDLE")
    bench.step()
    bench.step()
    rows = bench.all_rows()
    ramp = rows[rows["state"] == core.STATES.index("RAMP_OUT")]
    # Behind the braking, whose speed is that of the test.
    turn = int(np.argmax(np.abs(ramp["x_num_m"])))
    speed = np.abs(np.diff(ramp["x_num_m"][turn:])) * 1024
    assert 0.002 < speed.max() <= 0.004 * (1 + 1e-6)
    assert rows["x_num_m"][-1] == 0.0


# ---- what check shows ---------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(RIG + limits(force_n=25000, command_velocity_m_per_s=0.5))
    (tmp_path / "test.toml").write_text(
        TEST.replace("[test]", 'rig = "rig.toml"\n[test]')
        + limits(force_n='{ value = 9000, action = "trip" }', energy_error_j=2)
    )
    return tmp_path


def test_check_shows_each_limit_with_its_action_and_where_it_is_from(
    rthyb: Rthyb, files: Path
) -> None:
    answer = rthyb("check", "test.toml")
    assert answer.code == 0
    shown = [" ".join(line.split()) for line in answer.out.splitlines()]
    assert "force_n 9000 N, trip limit of the test" in shown
    assert "energy_error_j 2 J, trip limit of the test" in shown
    assert "command_velocity_m_per_s 0.5 m/s, limits the command limit of the rig" in shown
    assert not any(line.startswith("ramp_in_s") for line in shown)


def test_check_in_json_lists_the_limits(rthyb: Rthyb, files: Path) -> None:
    listed = {limit["key"]: limit for limit in json.loads(
        rthyb("check", "test.toml", "--json").out
    )["limits"]}  # fmt: skip
    assert listed["force_n"] == {
        "key": "force_n", "value": 9000.0, "unit": "N", "action": "trip", "enable": True,
        "from": "test",
    }  # fmt: skip
    assert listed["command_velocity_m_per_s"]["from"] == "rig"
    assert (listed["ramp_in_s"]["value"], listed["ramp_in_s"]["from"]) == (2.0, "default")


def test_check_warns_where_only_an_indication_stands_against_growth(
    rthyb: Rthyb, files: Path
) -> None:
    (files / "rig.toml").write_text(RIG)
    warning = "Warning: nothing ends a test whose motion grows"
    assert warning not in rthyb("check", "test.toml").out
    weak = ("--set", 'limits.force_n={ value = 9000, action = "indicate" }')
    assert warning in rthyb("check", "test.toml", *weak).out


def test_check_warns_of_sensor_limits_that_good_readings_exceed(rthyb: Rthyb, files: Path) -> None:
    link = '[link]\nkind = "socket"\nchannel = "/run/rig"\n'
    noise = '[sensors]\ndisplacement.noise_std_m = "20 um"\n'
    (files / "rig.toml").write_text(RIG + link + noise)
    tight = ("sensor_jump_m=0.1 mm", "rest_spread_m=0.1 mm", "command_increment_m=1 um")
    answer = rthyb("check", "test.toml", *(w for t in tight for w in ("--set", f"limits.{t}")))
    assert answer.code == 0
    for words in (
        "limits.rest_spread_m = 0.1 mm is below the span of the noise at rest, 0.14 mm",
        "limits.command_increment_m = 0.001 mm is below the peak of",
    ):
        assert f"Warning: {words}" in answer.out
    # Eight times the noise, and the way of one sample at the peak velocity.
    found = re.search(
        r"Warning: limits\.sensor_jump_m = 0\.1 mm is below ([0-9.e-]+) mm, the most that "
        "displacement and noise together change",
        answer.out,
    )
    assert found is not None
    assert 0.16 < float(found[1]) < 0.4


def test_a_time_in_samples_is_told_to_be_deprecated_and_means_the_same() -> None:
    old = prepared(limits(sensor_stuck_samples=50), limits(force_stuck_samples=64))
    new = prepared(limits(sensor_stuck_s=50 / 1024), limits(force_stuck_s=0.0625))
    told = [note for note in old.notes if "deprecated" in note]
    assert told == [
        f"{where}: limits.{key}_samples is deprecated: write {key}_s = {value}, in s"
        for where, key, value in (
            ("test", "sensor_stuck", "0.048828125"),
            ('rig "spring"', "force_stuck", "0.0625"),
        )
    ]
    assert not [note for note in new.notes if "deprecated" in note]
    assert old.test.limits == new.test.limits
    assert "samples" not in config.dump(old.test).partition("[limits]")[2]
    assert experiment.station_config(old) == experiment.station_config(new)
    assert certificate.rig_hash(old.rig) == certificate.rig_hash(new.rig)
    assert not config.Limits.model_construct(**dict(new.test.limits)).deprecated()
    found = refused(limits(sensor_stuck_samples=50, sensor_stuck_s=0.05), "")
    assert "only one of" in next(iter(found.values()))


def test_type_checker_and_header_know_the_same_commands_and_reactions() -> None:
    assert get_args(Command) == core.COMMANDS
    assert get_args(Reaction) == core.REACTIONS
    assert config_limits.ACTIONS == core.REACTIONS


def names_of(table: type[BaseModel], key: str) -> set[str]:
    """The names that a key of a file accepts."""
    found = table.model_fields[key].annotation
    inner = [one for one in get_args(found) if get_origin(one) is Literal]
    return set(get_args(inner[0] if inner else found))


def tables_with(key: str) -> list[type[BaseModel]]:
    """The tables of all files that have a key whose value is one of several names."""
    every = [rigfile, axesfile, testfile, baselinefile, numerical]
    tables = {one for module in every for one in vars(module).values() if isinstance(one, type)}
    given = (one for one in tables if issubclass(one, BaseModel) and key in one.model_fields)
    return sorted((one for one in given if names_of(one, key)), key=lambda one: one.__name__)


@pytest.mark.parametrize(
    ("key", "enum", "prefix"),
    [
        ("command_hold", "rthyb_hold", "RTHYB_"),
        ("tangent", "rthyb_tangent", "RTHYB_TANGENT_"),
        ("divisor", "rthyb_divisor", "RTHYB_DIVISOR_"),
        ("measures", "rthyb_extra_kind", "RTHYB_EXTRA_"),
        ("clock", "rthyb_clock", "RTHYB_CLOCK_"),
    ],
)
def test_files_accept_the_names_of_the_header(key: str, enum: str, prefix: str) -> None:
    tables = tables_with(key)
    assert tables
    for table in tables:
        assert names_of(table, key) == set(options(enum, prefix)), table


def test_files_name_no_integrator_that_the_header_lacks() -> None:
    known = set(options("rthyb_integrator", "RTHYB_"))
    named = {name for table in tables_with("integrator") for name in names_of(table, "integrator")}
    assert known - named == {"prescribed"}
    assert named <= known


def test_every_element_and_actuator_of_the_header_has_its_table() -> None:
    for key, enum, prefix in (
        ("element", "rthyb_element_kind", "RTHYB_"),
        ("kind", "rthyb_servo_kind", "RTHYB_"),
    ):
        tables = (one for one in vars(rigfile).values() if isinstance(one, type))
        given = [one for one in tables if issubclass(one, BaseModel) and key in one.model_fields]
        named = {name for table in given for name in names_of(table, key)}
        header = {name.replace("-", "_") for name in options(enum, prefix)}
        header -= {"element_kinds", "servo_kinds", "own"}  # counts, and the user's own element
        assert header <= {name.replace("-", "_") for name in named}, enum
