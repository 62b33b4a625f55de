"""What is watched on the shipped rig, and when: each scenario as a laboratory would meet it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rthyb_rt import config, core
from rthyb_rt.config import defaults
from rthyb_rt.lab import experiment
from rthyb_rt.lab.experiment import Setup

ROOT = Path(__file__).resolve().parents[1]
FLAGS, STATUS = core.FLAGS, core.STATUS
QUICK = {"limits.ramp_in_s": "0.25", "limits.tare_s": "0.0625"}
LIMIT_N, RIG_LIMIT_N, RANGE_N = 15e3, 16e3, 25e3
QUARTER_S = 256


@cache
def shipped(changes: tuple[tuple[str, str], ...] = ()) -> Setup:
    """The shipped rig on CAN with the test of Section 5."""
    rig = config.load_rig(ROOT / "hw" / "rigs" / "shaking-table-can.toml")
    test = config.load_test(ROOT / "examples" / "section5-T0.5.toml", QUICK | dict(changes))
    return experiment.prepare(test, rig, real_time=True)


@dataclass
class Lab:
    """The station of the shipped rig, its virtual table, and a hand on both of its sensors.

    ``x_off_m`` and ``f_off_n`` are added to what the sensors read, ``at_x``, ``at_f`` replace it.
    """

    changes: dict[str, str] = field(default_factory=dict)
    station_changes: dict[str, Any] = field(default_factory=dict)
    x_off_m: float = 0.0
    f_off_n: float = 0.0
    at_x: Callable[[float], float] = lambda x: x
    at_f: Callable[[float], float] = lambda f: f
    lost: bool = False
    records: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.setup = shipped(tuple(sorted(self.changes.items())))
        self.config = dataclasses.replace(
            experiment.station_config(self.setup, real=True), **self.station_changes
        )
        self.station = core.Station(self.config, self.setup.ag_mps2)
        self.rig = core.VirtualRig(self.setup.virtual_rig)
        self.at_drive = 0.0

    def step(self, command: core.Command = "none", skipped: int = 0) -> core.StationTick:
        for _ in range(skipped):
            self.rig.step(self.at_drive)
        x, f, _ = self.rig.step(self.at_drive)
        tick = self.station.tick(
            self.at_x(x + self.x_off_m),
            self.at_f(f + self.f_off_n),
            lost=self.lost,
            command=command,
            skipped=skipped,
        )
        self.records.append(tick.records.copy())
        if tick.sent:
            self.at_drive = tick.x_cmd_m
        return tick

    def steps(self, n: int) -> Lab:
        for _ in range(n):
            self.step()
        return self

    def until(self, *states: str, most: int = 40000) -> int:
        """Return the ticks that it took."""
        for n in range(most):
            if self.station.state in states:
                return n
            self.step()
        raise AssertionError(f"never in {states}, stayed in {self.station.state}")

    def zeroed(self) -> Lab:
        self.steps(8)
        self.step("zero")
        self.until("ZEROED")
        return self

    def running(self, ticks: int = 0) -> Lab:
        self.zeroed()
        assert not self.step("arm").refused
        assert not self.step("start").refused
        self.until("RUNNING")
        return self.steps(ticks)

    @property
    def row(self) -> np.void:
        return self.records[-1][-1]

    def rows(self) -> np.ndarray:
        return np.concatenate(self.records)


def ended(lab: Lab) -> tuple[str, str]:
    return lab.station.state, lab.station.cause


# ---- a force at the end of the cell's range ------------------------------------------------------


@pytest.mark.parametrize("reading_n", [RANGE_N - 1.0, RANGE_N, RANGE_N + 1.0])
def test_a_load_cell_at_the_end_of_its_range_trips_in_the_same_tick(reading_n: float) -> None:
    lab = Lab().running(2000)
    lab.at_f = lambda _: reading_n
    tick = lab.step()
    assert ended(lab) == ("TRIPPED", "force")
    assert tick.state == "TRIPPED"
    code = int(lab.row["code"])
    assert code & STATUS["force_limit"]
    assert code & STATUS["trip"]
    assert bool(code & STATUS["out_of_range"]) == (reading_n >= RANGE_N)


@pytest.mark.parametrize("reading_m", [0.0751, -0.075])
def test_a_displacement_at_the_end_of_its_range_is_a_position_event_at_once(
    reading_m: float,
) -> None:
    lab = Lab(station_changes={"watches": {"position": core.Watch(0.04, "trip")}}).running(2000)
    lab.at_x = lambda _: reading_m
    lab.step()
    assert ended(lab) == ("TRIPPED", "position")
    assert (lab.station.cause_value, lab.station.cause_limit) == (reading_m, 0.075)


# ---- a force that stays beyond its limit ---------------------------------------------------------


def loaded(reaction: core.Reaction, limit_n: float = 3e3) -> Lab:
    watches = {"force": core.Watch(limit_n, reaction)}
    return Lab(station_changes={"watches": watches}).running(0)


def test_a_force_that_stays_beyond_its_limit_in_hold_trips_and_resume_is_refused() -> None:
    lab = loaded("hold")
    lab.until("HOLD")
    assert lab.station.cause == "force"
    lab.at_f = lambda _: 4e3
    lab.steps(100)
    tick = lab.step("resume")
    assert tick.refused
    assert lab.station.refusal == ("force", pytest.approx(4e3, abs=20.0), 3e3)
    waited = 101 + lab.until("TRIPPED")
    assert waited == QUARTER_S
    assert lab.station.cause == "force"


def test_half_as_much_again_as_the_limit_is_not_borne_for_a_tick_while_held() -> None:
    lab = loaded("hold")
    lab.until("HOLD")
    lab.at_f = lambda _: 4.6e3
    lab.step()
    assert lab.station.state == "TRIPPED"


def test_a_force_that_falls_while_held_lets_the_test_resume() -> None:
    lab = loaded("hold")
    lab.until("HOLD")
    lab.at_f = lambda _: 2e3
    lab.steps(400)
    assert not lab.step("resume").refused
    assert lab.station.state == "HOLD"


@pytest.mark.parametrize(("force_n", "within"), [(4e3, QUARTER_S), (24.9 * 3e3, 1)])
def test_a_force_that_grows_on_the_way_out_is_ended_within_its_bound(
    force_n: float, within: int
) -> None:
    lab = loaded("ramp-out")
    lab.until("RAMP_OUT")
    lab.at_f = lambda _: force_n
    assert lab.until("TRIPPED") == within
    assert lab.station.cause == "force"


def test_a_force_that_only_dips_below_its_limit_begins_no_new_count() -> None:
    lab = loaded("hold")
    lab.until("HOLD")
    beyond = 0
    for n in range(2 * QUARTER_S):
        force_n = 2.9e3 if n % 3 == 2 else 3.3e3
        beyond += force_n > 3e3
        lab.at_f = lambda _, force_n=force_n: force_n
        lab.step()
        if lab.station.state == "TRIPPED":
            break
    assert lab.station.state == "TRIPPED"
    assert beyond == QUARTER_S


@pytest.mark.long
@pytest.mark.parametrize("reaction", ["hold", "ramp-out", "trip"])
@pytest.mark.parametrize("seed", range(6))
def test_no_force_stays_beyond_its_limit_for_longer_than_stated(
    reaction: core.Reaction, seed: int
) -> None:
    """Random operators, forces, losses and skips; whatever happens, the rows keep the bound."""
    random = np.random.default_rng(seed)
    lab = loaded(reaction)
    beyond = 0
    for _ in range(6000):
        if random.random() < 0.01:
            level = random.choice([0.0, 2.9e3, 3.1e3, 4.4e3, 4.6e3, 3e4]) * random.choice([-1, 1])
            lab.at_f = lambda _, level=level: level
        lab.lost = random.random() < 0.02
        command = random.choice(["none"] * 60 + ["stop", "hold", "resume", "zero", "arm", "start"])
        skipped = int(random.random() < 0.005) * int(random.integers(1, 10))
        tick = lab.step(command, skipped)
        row = tick.records[-1]
        if lab.station.state == "TRIPPED":
            beyond = 0
            lab.at_f = lambda _: 0.0
            lab.lost = False
            lab.steps(60)
            lab.step("reset")
            lab.step("zero")
            lab.steps(200)
            continue
        is_beyond = abs(float(row["f_meas_n"])) > 3e3 and lab.station._c.tared
        beyond = beyond + 1 + skipped if is_beyond else 0
        assert beyond <= QUARTER_S + 1
        if is_beyond and reaction == "trip":
            raise AssertionError("a force beyond a limit that trips")
        assert not (beyond > 1 + skipped and abs(float(row["f_meas_n"])) > 4.5e3)


# ---- at rest -------------------------------------------------------------------------------------


def creep(lab: Lab, to_m: float, ticks: int = 1000) -> None:
    """The drive lets go: displacement and force run away while the command stands."""
    for n in range(ticks):
        away = to_m * (n + 1) / ticks
        lab.x_off_m, lab.f_off_n = away, 2e6 * away
        lab.step()


def test_a_specimen_that_creeps_in_zeroed_trips_at_its_force_limit() -> None:
    lab = Lab().zeroed()
    creep(lab, 0.012)
    assert ended(lab) == ("TRIPPED", "force")
    first = lab.rows()[np.argmax(lab.rows()["code"] & STATUS["trip"] > 0)]
    assert abs(first["f_meas_n"]) < LIMIT_N + 200.0


@pytest.mark.parametrize("command", ["arm", "start"])
def test_arm_and_start_are_refused_beyond_a_limit_with_the_figures(command: core.Command) -> None:
    watches = {"force": core.Watch(LIMIT_N, "ramp-out")}
    lab = Lab(station_changes={"watches": watches}).zeroed()
    if command == "start":
        lab.step("arm")
    lab.f_off_n = 20e3
    lab.steps(3)
    assert lab.step(command).refused
    cause, met, limit = lab.station.refusal
    assert (cause, limit) == ("force", LIMIT_N)
    assert met == pytest.approx(20e3, abs=50.0)


def test_start_is_refused_where_the_reading_has_wandered_from_the_command() -> None:
    bound_m = 5 * Lab().config.rest_spread_m
    for away_m, refused in ((0.4e-3, False), (0.8e-3, True), (12e-3, True)):
        lab = Lab().zeroed()
        lab.step("arm")
        for n in range(100):
            lab.x_off_m = away_m * (n + 1) / 100
            lab.step()
        assert lab.step("start").refused is refused
        if refused:
            met = pytest.approx(away_m, abs=0.05e-3)
            assert lab.station.refusal == ("tracking", met, pytest.approx(bound_m))


# ---- sensors that stand still, or jump -----------------------------------------------------------


def frozen(lab: Lab) -> int:
    """Freeze the load cell where it reads; return the ticks until it is noticed."""
    held = float(lab.row["f_meas_n"]) + lab.station.tare[1]
    lab.at_f = lambda _: held
    peak = 0.0
    for n in range(2000):
        lab.step()
        peak = max(peak, abs(float(lab.rig._c.f_true_n)))
        if lab.station.state != "RUNNING":
            assert peak < 4.9e3
            return n + 1
    raise AssertionError("never noticed")


@pytest.mark.parametrize("after", [1500, 2100, 2345, 3000, 5000])
def test_a_frozen_load_cell_ends_the_test_before_the_force_exceeds_the_tests_peak(
    after: int,
) -> None:
    lab = Lab().running(after)
    ticks = frozen(lab)
    assert ended(lab) == ("RAMP_OUT", "force_stuck")
    assert ticks <= 160
    assert lab.row["code"] & STATUS["sensor_stuck"]


def test_a_cell_without_noise_that_stands_on_its_step_is_none_that_is_stuck() -> None:
    assert derived(noise_n=0.0, step_n=1.0).get("force_stuck_s") is None
    assert derived(noise_n=0.2, step_n=1.0).get("force_stuck_s") is None
    assert derived(noise_n=0.5, step_n=1.0)["force_stuck_s"].value * 1024 == 73
    assert derived(noise_n=5.0, step_n=1.0)["force_stuck_s"].value * 1024 == 20


def derived(noise_n: float, step_n: float) -> Any:
    rig = config.load_rig(
        ROOT / "hw" / "rigs" / "shaking-table-can.toml",
        {
            "sensors.force.noise_std_n": str(noise_n),
            "sensors.force.lsb_n": str(step_n),
            "identified.rest_noise_force_n": str(noise_n),
        },
    )
    test = config.load_test(ROOT / "examples" / "section5-T0.5.toml", QUICK)
    return experiment.prepare(test, rig, real_time=True).derived.limits.derived


def test_odds_of_a_repeated_reading_are_those_of_a_sensor_that_is_drawn() -> None:
    random = np.random.default_rng(1)
    for sigma, step in ((0.5, 1.0), (1.0, 1.0), (5.0, 1.0)):
        drawn = np.round(random.normal(0.0, sigma, 400_000) / step)
        odds = defaults.repeat_odds(sigma, step)
        assert np.mean(drawn == 0) == pytest.approx(odds, rel=0.02)
        assert np.mean(drawn[1:] == drawn[:-1]) <= odds


@pytest.mark.parametrize("tare", [10, 64, 128, 1024])
def test_equal_readings_refuse_a_tare_only_where_noise_rules_them_out(tare: int) -> None:
    """The odds of so many in a row, at worst, with the noise at which they still count."""
    for share in (0.01, 0.3, 0.49, 0.5, 1.0, 3.0, 120.0):
        count = defaults.frozen_ticks(share * 1e-6, 1e-6, tare)
        odds = defaults.repeat_odds(share * 1e-6, 1e-6)
        assert count in (0, min(tare, 128))
        by_chance = odds ** (min(tare, 128) - 1)
        assert (count > 0) == (by_chance <= 1e-12 and odds <= 0.7)
        # In any of the places of the tare at which such a row may begin.
        assert not count or (tare - count + 1) * odds ** (count - 1) < 1e-12
    assert defaults.frozen_ticks(0.0, 1e-6, tare) == 0
    assert defaults.frozen_ticks(1e-6, 0.0, tare) == min(tare, 128)


def test_noise_of_half_a_step_repeats_for_much_less_than_a_frozen_reading_does() -> None:
    random = np.random.default_rng(11)
    drawn = np.round(random.normal(0.0, 0.5, 4_000_000))
    changes = np.flatnonzero(np.diff(drawn))
    longest = int(np.diff(changes).max())
    assert 20 < longest < defaults.frozen_ticks(0.5, 1.0, 1024) // 2


def test_a_force_that_jumps_is_not_used_and_ramps_out() -> None:
    lab = Lab().running(3000)
    before = float(lab.row["f_meas_n"])
    lab.f_off_n = 3e3
    lab.step()
    assert ended(lab) == ("RAMP_OUT", "force_jump")
    assert abs(float(lab.row["f_meas_n"]) - before) < 300.0
    assert lab.row["flags"] & FLAGS["predicted"]
    assert lab.row["code"] & STATUS["sensor_jump"]


@pytest.mark.long
def test_the_whole_shipped_test_meets_none_of_the_derived_limits() -> None:
    lab = Lab().running(0)
    lab.until("IDLE", "TRIPPED", most=60000)
    assert ended(lab) == ("IDLE", "completed")
    assert lab.station.indicated == []
    rows = lab.rows()
    running = rows[rows["state"] == core.STATES.index("RUNNING")]
    steepest = float(np.abs(np.diff(running["f_meas_n"])).max())
    assert 5 * steepest < lab.config.watches["force_jump"].value


# ---- pairs and ticks that are lost ---------------------------------------------------------------


def test_one_pair_in_a_hundred_is_said_and_one_in_ten_ramps_out() -> None:
    lab = Lab().running(200)
    for n in range(1500):
        lab.lost = n % 60 == 0
        lab.step()
    assert ended(lab) == ("RUNNING", "none")
    assert lab.station.indicated == ["lost_warning"]
    assert lab.row["code"] & STATUS["lost_rate"]
    for n in range(1024):
        lab.lost = n % 8 == 0
        lab.step()
        if lab.station.state != "RUNNING":
            break
    assert ended(lab) == ("RAMP_OUT", "lost_pairs")
    assert lab.station.cause_value == pytest.approx(103 / 1024)
    assert lab.station.cause_limit == 0.1


def test_nineteen_pairs_of_twenty_lost_do_not_last_for_a_second() -> None:
    lab = Lab().running(200)
    for n in range(400):
        lab.lost = n % 20 != 0
        lab.step()
        if lab.station.state != "RUNNING":
            break
    assert ended(lab) == ("RAMP_OUT", "lost_pairs")
    assert n < 120


def test_a_load_cell_at_the_end_of_its_range_now_and_then_is_the_cause_of_lost_pairs() -> None:
    """The test has no limit on the force, which would end it at once."""
    watches = {
        cause: watch
        for cause, watch in Lab().config.watches.items()
        if cause not in ("force", "rig_force")
    }
    lab = Lab(station_changes={"watches": watches}).running(200)
    for n in range(500):
        lab.f_off_n = 1e5 if n % 4 == 0 else 0.0
        lab.step()
        if lab.station.state != "RUNNING":
            break
    assert ended(lab) == ("RAMP_OUT", "force_range")
    assert lab.station.cause_limit == RANGE_N
    assert lab.station.cause_value == pytest.approx(1e5, rel=0.2)


def test_what_was_lost_before_the_test_is_not_held_against_it() -> None:
    lab = Lab().zeroed()
    lab.step("arm")
    for n in range(400):
        lab.lost = n % 3 == 0
        lab.step()
    lab.lost = False
    lab.steps(2)
    assert not lab.step("start").refused
    lab.until("RUNNING")
    lab.steps(100)
    assert lab.station.indicated == []


def test_skipped_ticks_are_said_at_one_in_a_hundred_and_ramp_out_at_fifty_a_second() -> None:
    lab = Lab().running(200)
    for _ in range(12):
        lab.step(skipped=1)
        lab.steps(9)
    assert ended(lab) == ("RUNNING", "none")
    assert lab.station.indicated == ["skip_warning"]
    for _ in range(39):
        lab.step(skipped=1)
        lab.steps(9)
    assert ended(lab) == ("RAMP_OUT", "skips")
    assert (lab.station.cause_value, lab.station.cause_limit) == (51 / 1024, 50 / 1024)


def test_a_pc_that_was_late_before_start_does_not_end_the_test_at_its_start() -> None:
    """Ticks skipped at rest are counted, but the share that ends a test begins at START."""
    lab = Lab().zeroed()
    lab.step("arm")
    for _ in range(80):
        lab.step(skipped=1)
    assert not lab.steps(1).step("start").refused
    assert lab.station.skipped == 80
    for _ in range(40):
        lab.step(skipped=1)
    assert lab.station.state in ("RAMP_IN", "RUNNING")
    for _ in range(11):
        lab.step(skipped=1)
    assert ended(lab) == ("RAMP_OUT", "skips")
    assert (lab.station.cause_value, lab.station.cause_limit) == (51 / 1024, 50 / 1024)


def test_a_pc_that_was_late_between_two_tests_is_not_held_against_the_second() -> None:
    """A second test in the same service begins as the first did, with nothing indicated."""
    lab = Lab().running(100)
    lab.step("stop")
    lab.until("IDLE")
    lab.zeroed()
    lab.step("arm")
    for _ in range(60):
        lab.step(skipped=1)
    assert not lab.steps(1).step("start").refused
    lab.until("RUNNING")
    lab.steps(100)
    assert (lab.station.cause, lab.station.indicated) == ("none", [])


def test_shares_have_keys() -> None:
    changes = {"limits.lost_pairs_share": "0.02", "limits.skipped_ticks_share": "0.01"}
    lab = Lab(changes).running(200)
    for n in range(600):
        lab.lost = n % 20 == 0
        lab.step()
        if lab.station.state != "RUNNING":
            break
    assert ended(lab) == ("RAMP_OUT", "lost_pairs")
    assert lab.station.cause_limit == 0.02
    assert lab.config.watches["skips"] == core.Watch(0.01, "ramp-out")


# ---- before the tare and after it ----------------------------------------------------------------


def test_the_rigs_limit_holds_before_the_tare_and_the_tests_after_it() -> None:
    """Tared at 3 kN, 16 kN before the tare are 13 kN after it: the rig's limit is met first."""
    watched = experiment.station_config(shipped(), real=True).watches
    watches = {k: v for k, v in watched.items() if k in ("force", "rig_force")}
    lab = Lab(station_changes={"watches": watches}, f_off_n=3e3).running(500)
    lab.at_f = lambda _: 15.9e3
    lab.steps(5)
    assert ended(lab) == ("RUNNING", "none")
    lab.at_f = lambda _: 16.1e3
    lab.step()
    assert ended(lab) == ("TRIPPED", "rig_force")
    assert lab.station.cause_value == pytest.approx(16.1e3, abs=1.0)
    lab = Lab(station_changes={"watches": watches}, f_off_n=3e3).running(500)
    lab.at_f = lambda _: -12.1e3
    lab.step()
    assert ended(lab) == ("TRIPPED", "force")


def test_a_tare_beyond_a_fifth_of_the_rigs_limit_is_refused_with_its_figures() -> None:
    lab = Lab(f_off_n=12e3)
    lab.steps(8)
    lab.step("zero")
    lab.steps(200)
    assert lab.station.state == "IDLE"
    assert lab.station.tare_too_large
    assert lab.station.refusal == ("rig_force", pytest.approx(12e3, abs=10.0), 3200.0)
    lab.f_off_n = 3e3
    lab.step("zero")
    lab.until("ZEROED")
    assert not lab.station.tare_too_large


def test_the_share_of_the_tare_has_a_key() -> None:
    lab = Lab({"limits.tare_share_most": "0.1"}, f_off_n=3e3)
    lab.steps(8)
    lab.step("zero")
    lab.steps(200)
    assert lab.station.tare_too_large


def test_a_command_keeps_to_the_rigs_stroke_wherever_it_was_zeroed() -> None:
    """Zeroed at 10 mm, a rig with 60 mm has 50 mm left to one side and 70 mm to the other."""
    watches = {"rig_position": core.Watch(0.06, "trip"), "position": core.Watch(0.055, "trip")}
    for sign, most in ((1.0, 0.05), (-1.0, 0.055)):
        path = sign * 0.058 * np.sin(np.pi * np.arange(4096) / 4096)
        lab = Lab(station_changes={"watches": watches})
        controller = dataclasses.replace(
            lab.config.controller, motion=core.MotionConfig("prescribed"), lead_enabled=False,
            velocity_limit_m_per_s=0.0,
        )  # fmt: skip
        made = dataclasses.replace(
            lab.config, controller=controller, tare_most_m=0.0, tare_most_n=0.0
        )
        lab.station = core.Station(made, path)
        for _ in range(3000):
            lab.rig.step(0.01)
        lab.at_drive = 0.01
        lab.zeroed()
        assert lab.station.command_tare_m == pytest.approx(0.01, abs=2e-3)
        tare = lab.station.command_tare_m
        assert not lab.step("arm").refused
        assert not lab.step("start").refused
        lab.until("TRIPPED")
        expected = "rig_position" if sign > 0 else "position"
        assert lab.station.cause == expected
        sent = sign * lab.rows()["x_cmd_m"].astype(float)
        assert sent.max() <= (0.06 - tare if sign > 0 else most) + 1e-12
