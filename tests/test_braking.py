"""How a command brakes, goes on after a gap, and comes within limits that are drawn in."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import loop_bench
import numpy as np
import pytest
from command_line import Rthyb
from rthyb_rt._core import ffi, lib

from rthyb_rt import config, core
from rthyb_rt.lab import braking, experiment

H = core.PERIOD_S
TEST = Path(__file__).resolve().parents[1] / "examples" / "section5-T0.5.toml"
SHIPPED = "shaking-table-can"
NOISE_M, NOISE_N = 2e-6, 5.0
"""The rig's sensors, standard deviations."""


@functools.cache
def prepared(*, without_velocity_limit: bool = False, **settings: Any) -> experiment.Setup:
    """Section 5, T = 0.5 s, on the shipped rig with its drive on CAN."""
    given = {key.replace("__", "."): str(value) for key, value in settings.items()}
    test = config.load_test(TEST, given)
    rig = config.load_rig(config.find_rig(SHIPPED))
    if without_velocity_limit:
        limits = rig.limits.model_copy(update={"command_velocity_m_per_s": None})
        rig = rig.model_copy(update={"limits": limits})
    return experiment.prepare(test, rig, real_time=True)


class Table:
    """The station of a test at a link, and the rig that it moves, on the stepped clock."""

    def __init__(self, setup: experiment.Setup, **changes: Any) -> None:
        self.setup = setup
        self.config = dataclasses.replace(experiment.station_config(setup, real=True), **changes)
        self.station = core.Station(self.config, setup.ag_mps2)
        self.rig = core.VirtualRig(setup.virtual_rig)
        self.at_drive = 0.0
        self.sent: list[float] = []
        self.records: list[np.ndarray] = []

    def step(self, command: core.Command = "none", **given: Any) -> core.StationTick:
        """One executed tick; the rig lives through the skipped ones as well."""
        for _ in range(given.get("skipped", 0) + 1):
            x, f, _ = self.rig.step(self.at_drive)
        tick = self.station.tick(x, f, command=command, **given)
        self.records.append(tick.records)
        if tick.sent:
            self.at_drive = tick.x_cmd_m
            self.sent.append(tick.x_cmd_m)
        return tick

    def steps(self, n: int) -> None:
        for _ in range(n):
            self.step()

    def until(self, state: str, most: int = 20000) -> None:
        for _ in range(most):
            if self.station.state == state:
                return
            self.step()
        raise AssertionError(f"never reached {state}, stayed in {self.station.state}")

    def running(self, ticks: int) -> Table:
        self.steps(30)
        for command, state in (("zero", "ZEROED"), ("arm", "ARMED"), ("start", "RUNNING")):
            self.step(command)  # type: ignore[arg-type]
            self.until(state)
        self.steps(ticks)
        return self

    def fast(self, m_per_s: float, after: int = 2000) -> Table:
        """Run until the command is so fast, to whichever side."""
        self.running(after)
        for _ in range(4096):
            if abs(self.speeds()[-1]) > m_per_s:
                return self
            self.step()
        raise AssertionError(f"never so fast, {np.abs(self.speeds()).max()} m/s at most")

    def speeds(self) -> np.ndarray:
        """Of the commands that left, m/s."""
        return np.diff(self.sent) / H

    def rows(self) -> np.ndarray:
        return np.concatenate(self.records)

    def adopt(self, **changes: Any) -> None:
        """Publish another set of parameters."""
        wanted = dataclasses.replace(core.Parameters.of(self.config), **changes)
        assert lib.rthyb_station_adopt(self.station._c, wanted.struct(1))

    def remember(self) -> tuple[bytes, bytes, float]:
        return bytes(ffi.buffer(self.station._c)), bytes(ffi.buffer(self.rig._c)), self.at_drive

    def back_to(self, then: tuple[bytes, bytes, float]) -> None:
        ffi.buffer(self.station._c)[:], ffi.buffer(self.rig._c)[:], self.at_drive = then
        self.records, self.sent = [], [self.at_drive]


# ---- how far it runs on --------------------------------------------------------------------------


@functools.cache
def strong_motion() -> tuple[Table, list[tuple[bytes, bytes, float]], np.ndarray]:
    """The test until past its peak, what it was every 20 ms from 1.6 s on, and its rows."""
    table = Table(prepared()).running(0)
    table.records = []
    instants = []
    for n in range(3 * 1024):
        table.step()
        if n > 1.6 * 1024 and n % 20 == 0:
            instants.append(table.remember())
    return table, instants, table.rows()


@pytest.mark.parametrize("why", ["hold", "stop", "heartbeat"])
def test_brake_at_any_instant_goes_no_further_than_the_test_itself(why: str) -> None:
    table, instants, own = strong_motion()
    reference = table.setup.reference
    worst = np.zeros(3)
    for instant in instants:
        table.back_to(instant)
        if why == "heartbeat":
            table.step(heartbeat_late=True)
        else:
            table.step(why)  # type: ignore[arg-type]
        table.steps(250)
        rows = table.rows()
        assert table.station.state in ("HOLD" if why == "hold" else ("RAMP_OUT", "IDLE"))
        worst = np.maximum(
            worst, [np.abs(rows[name]).max() for name in ("x_num_m", "x_meas_m", "f_meas_n")]
        )
    print(f"{why}: {worst[1] * 1e3:.2f} mm, {worst[2] / 1e3:.2f} kN")
    assert worst[0] <= np.abs(own["x_num_m"]).max() * 1.0005
    assert worst[1] <= np.abs(own["x_meas_m"]).max() + 8 * NOISE_M
    assert worst[2] <= np.abs(reference["f_ref_n"]).max() + 4 * NOISE_N


def test_hold_at_half_as_much_again_is_no_force_trip() -> None:
    table = Table(prepared(ground_motion__pga_g="0.06 g")).running(round(2.25 * 1024))
    table.step("hold")
    table.steps(600)
    assert (table.station.state, table.station.cause) == ("HOLD", "none")
    assert np.abs(table.rows()["f_meas_n"]).max() < 8000


def test_brake_is_smooth_enough_for_the_phase_lead() -> None:
    """The compensated command goes nowhere that the test's own does not go."""
    table, instants, own = strong_motion()
    worst = 0.0
    for instant in instants:
        table.back_to(instant)
        table.step("hold")
        table.steps(250)
        worst = max(worst, np.abs(table.rows()["x_plc_m"]).max())
    assert worst <= np.abs(own["x_plc_m"]).max()


def test_station_brakes_as_check_computes_it() -> None:
    table, instants, _ = strong_motion()
    most = table.config.brake_acceleration_m_per_s2
    for instant in instants[::7]:
        table.back_to(instant)
        motion = table.station._c.controller.motion
        course = braking.BrakingCourse.of([motion.x2, motion.x1, motion.x])
        brake = braking.Brake.of(motion.x, course.v[2], course.a[2], most)
        table.step("hold")
        table.steps(round(float(brake.lasts_s) / H) - 1)
        lasts = H * np.arange(1, len(table.records) + 1)
        x, _, a = brake.at(lasts)
        # Row n has the displacement of before the brake's tick n.
        np.testing.assert_allclose(table.rows()["x_num_m"][1:], x[:-1], rtol=0, atol=1e-12)
        assert table.station._c.controller.interface[0].x_num == pytest.approx(x[-1], abs=1e-12)
        assert np.abs(a).max() <= most * (1 + 1e-9)


def test_slow_brake_loses_little_by_being_smooth() -> None:
    """Against constant deceleration, x + v |v| / 2 a, from every tick of the reference."""
    course = braking.BrakingCourse.of(prepared().reference["x_ref_m"])
    brake = braking.Brake.of(course.x, course.v, course.a, 0.2)
    plain = course.x + course.v * np.abs(course.v) / 0.4
    reached = brake.at(brake.lasts_s)
    assert np.abs(reached[0]).max() == pytest.approx(np.abs(plain).max(), rel=0.02)
    assert np.abs(reached[1]).max() < 1e-12


def checked(rthyb: Rthyb, *settings: str) -> dict[str, Any]:
    options = [word for one in settings for word in ("--set", one)]
    done = rthyb("check", str(TEST), "--rig", SHIPPED, "--json", *options)
    return dict(json.loads(done.out))


def test_check_prints_the_run_on_and_warns(rthyb: Rthyb) -> None:
    own = checked(rthyb)
    assert own["run_on"]["displacement_m"] == pytest.approx(7.36e-3, rel=0.002)
    assert own["run_on"]["force_n"] == pytest.approx(4984, rel=0.002)
    assert own["run_on"]["brake_m_per_s2"] == pytest.approx(1.25 * 1.3666, rel=1e-3)
    assert not any("runs on" in text for text in own["warnings"])
    gentle = checked(rthyb, "limits.brake_acceleration_m_per_s2=0.2")
    assert gentle["run_on"]["displacement_m"] == pytest.approx(22.1e-3, rel=0.01)
    assert gentle["run_on"]["force_n"] == pytest.approx(14.8e3, rel=0.01)
    assert sum("the test's own peak" in text for text in gentle["warnings"]) == 2
    strong = checked(rthyb, "limits.brake_acceleration_m_per_s2=0.2", "ground_motion.pga_g=0.06 g")
    assert any("beyond limits.force_n of 15.0 kN" in text for text in strong["warnings"])


@pytest.mark.parametrize(
    ("settings", "brake"),
    [
        ({}, 1.25 * 1.3666),
        # What the way back may is no reason to brake more gently, but a reason to brake no more so.
        ({"limits__path_acceleration_m_per_s2": 0.1}, 1.25 * 1.3666),
        ({"limits__path_acceleration_m_per_s2": 3.0}, 3.0),
        ({"limits__command_acceleration_m_per_s2": 2.0}, 1.0),
        ({"limits__brake_acceleration_m_per_s2": 0.5}, 0.5),
    ],
)
def test_brake_follows_from_the_test_within_the_commands_limit(
    settings: dict[str, Any], brake: float
) -> None:
    setup = prepared(**settings)
    assert setup.test.limits.brake_acceleration_m_per_s2 == pytest.approx(brake, rel=1e-3)
    made = experiment.station_config(setup)
    assert made.brake_acceleration_m_per_s2 == pytest.approx(brake, rel=1e-3)
    assert made.path_acceleration_m_per_s2 == min(
        settings.get("limits__path_acceleration_m_per_s2", 0.2), brake
    )


# ---- gaps ----------------------------------------------------------------------------------------

A_MAX = 10.0


@pytest.mark.parametrize("skipped", [1, 3, 10])
def test_command_goes_on_from_its_last_step_after_skipped_ticks(skipped: int) -> None:
    table = Table(prepared(limits__command_acceleration_m_per_s2=A_MAX)).fast(0.06)
    before = len(table.sent) - 2
    own = np.abs(table.speeds()).max()
    table.step(skipped=skipped)
    table.steps(150)
    after = table.speeds()[before:]
    print(f"{skipped}: {after[0] * 1e3:.0f} to {after[1] * 1e3:.0f} mm/s, "
          f"most {np.abs(after).max() * 1e3:.0f} mm/s")  # fmt: skip
    assert np.abs(np.diff(after)).max() <= A_MAX * H * (1 + 1e-9)
    assert after[0] * after[1] > 0
    # It has so many ticks to make good, and does so without swinging about what is wanted.
    assert np.abs(after).max() <= own + (skipped + 4) * A_MAX * H


def limited(**changes: Any) -> core.StationConfig:
    """Settings of the small rig with an acceleration limit of the command."""
    made = loop_bench_config(**changes)
    controller = dataclasses.replace(made.controller, acceleration_limit_m_per_s2=A_MAX)
    return dataclasses.replace(made, controller=controller)


loop_bench_config = loop_bench.config


@pytest.fixture
def accelerated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_bench, "config", limited)


class Left:
    """The commands that have left a loop, as its limiter had them, with the gaps between them."""

    def __init__(self, bench: loop_bench.Bench) -> None:
        self.bench = bench
        self.sent = bench.loop.counters()["sent"]
        self.elapsed = bench.loop.counts.elapsed
        self.x: list[float] = []
        self.gap: list[bool] = []

    def note(self) -> bool:
        """After every tick; True if a command has left."""
        sent, elapsed = self.bench.loop.counters()["sent"], self.bench.loop.counts.elapsed
        if sent == self.sent:
            return False
        self.x.append(self.bench.station._c.controller.axis[0].limiter.x_lim)
        self.gap.append(elapsed - self.elapsed > 1)
        self.sent, self.elapsed = sent, elapsed
        return True


@pytest.mark.usefixtures("accelerated")
def test_command_goes_on_from_its_last_step_after_a_full_queue() -> None:
    with loop_bench.Bench(send_buffer=1, seconds=4.0) as bench:
        bench.running(900)
        left = Left(bench)
        while not left.x or abs(left.x[-1] - left.x[-2 if len(left.x) > 1 else -1]) < 0.02 * H:
            bench.step()
            left.note()
        for _ in range(14):  # the drive does not read meanwhile
            bench.tick()
            left.note()
        assert bench.loop.counters()["not_sent"] > 0
        for _ in range(200):
            bench.step()
            left.note()
        assert any(left.gap[1:])
        steps = np.diff(left.x)
        assert np.abs(np.diff(steps)).max() <= A_MAX * H * H * (1 + 1e-9)
        gap = np.flatnonzero(left.gap[1:])
        assert (steps[gap] * steps[gap - 1] >= 0).all()


def test_command_without_a_velocity_limit_of_its_files_has_one_at_a_link(rthyb: Rthyb) -> None:
    setup = prepared(without_velocity_limit=True)
    own = experiment.station_config(setup, real=True).controller.velocity_limit_m_per_s
    assert own == pytest.approx(2 * 0.093, rel=0.1)
    (note,) = (text for text in setup.notes if "command_velocity_m_per_s" in text)
    assert f"{own:.3g} m/s" in note
    # In virtual time nothing can break: it is only told.
    virtual = experiment.station_config(setup)
    assert virtual.controller.velocity_limit_m_per_s == 0.0
    assert virtual.watches["velocity"] == core.Watch(own, "indicate")
    table = Table(setup).fast(0.085)
    table.step(skipped=10)
    print(f"ten skipped ticks: one command of {abs(table.speeds()[-1]) * H * 1e3:.2f} mm")
    table.steps(100)
    assert np.abs(table.speeds()).max() <= own * (1 + 1e-9)


def test_rig_with_a_velocity_limit_keeps_it() -> None:
    setup = prepared()
    assert not any("command_velocity_m_per_s" in text for text in setup.notes)
    assert experiment.station_config(setup, real=True).controller.velocity_limit_m_per_s == 0.5


# ---- limits that are drawn in --------------------------------------------------------------------

NARROWER = {
    "velocity": {"velocity_limit_m_per_s": 0.01},
    "acceleration": {"acceleration_limit_m_per_s2": 2.0},
    "both": {"velocity_limit_m_per_s": 0.01, "acceleration_limit_m_per_s2": 2.0},
    "position": {"watches": {"position": core.Watch(1e-3, "ramp-out")}},
    "path": {"path_velocity_m_per_s": 0.005, "path_acceleration_m_per_s2": 0.05},
}


@pytest.mark.parametrize("narrower", NARROWER)
@pytest.mark.parametrize("where", ["braking", "resuming", "ramping out", "on the way back"])
def test_limits_drawn_in_on_a_path_are_braked_into(where: str, narrower: str) -> None:
    setup = prepared(limits__command_acceleration_m_per_s2=A_MAX)
    table = Table(setup, path_velocity_m_per_s=0.06, path_acceleration_m_per_s2=1.4).fast(0.08)
    left = table.station.test_tick
    if where == "ramping out":
        table.step("stop")
        table.steps(5)
    elif where == "on the way back":
        table.step("stop")
        while table.station._c.leg == 0 or abs(table.speeds()[-1]) < 0.02:
            table.step()
    else:
        table.step("hold")
        table.steps(5)
    if where == "resuming":
        while table.station._c.leg == 0:
            table.step()
        table.steps(100)
        table.step("resume")
        while abs(table.speeds()[-1]) < 0.02:
            table.step()
    before = len(table.sent) - 3
    table.adopt(**NARROWER[narrower])
    for _ in range(500):
        if table.station.state != "RUNNING":
            table.step()
    a_max = NARROWER[narrower].get("acceleration_limit_m_per_s2", A_MAX)
    harshest = np.abs(np.diff(table.speeds()[before + 1 :])).max() / H
    print(f"{where}, {narrower}: {harshest / a_max:.2f} a_max")
    assert harshest <= a_max * (1 + 1e-6)
    if narrower in ("velocity", "both"):
        assert abs(table.speeds()[before + 50 :]).max() <= 0.01 * (1 + 1e-9)
    if where == "resuming" and narrower != "position":
        table.until("RUNNING")
        assert table.station.test_tick == left
        assert table.station._c.controller.interface[0].x_num == pytest.approx(
            table.station._c.resume[0][0], abs=1e-12
        )


def test_narrower_limits_in_ramp_in_lead_to_zero_all_the_same() -> None:
    table = Table(prepared(), ramp_in_ticks=400)
    table.steps(30)
    table.step("zero")
    table.until("ZEROED")
    table.step("stop")
    # Somebody moves the specimen at the drive's panel; the command follows it there.
    for _ in range(3):
        table.station.tick(0.004, 0.0, drive_stopped=True)
    table.station._c.state = core.STATES.index("ARMED")
    x = []
    for n in range(4000):
        if n == 150:
            table.adopt(path_velocity_m_per_s=0.008)
        command: core.Command = "none" if n else "start"
        table.station.tick(0.004 + 1e-6 * (n % 2), 5.0 * (n % 2), command=command)
        x.append(table.station._c.controller.interface[0].x_num)
        if table.station.state == "RUNNING":
            break
    assert table.station.state == "RUNNING"
    assert np.abs(np.diff(x[400:-1])).max() <= 0.008 * H * (1 + 1e-9)
    assert np.abs(np.diff(x[:-1], 2)).max() <= 1.75 * H * H


# ---- HOLD on the way back to the test ------------------------------------------------------------


def test_hold_during_resume_brakes_again_and_resume_leads_where_the_test_was_left() -> None:
    table = Table(prepared()).fast(0.08)
    table.step("hold")
    c = table.station._c
    left = (c.resume[0][0], c.resume[0][1], c.resume[0][2], table.station.test_tick)
    table.steps(400)
    for _ in range(2):
        assert not table.step("resume").refused
        table.steps(150)
        assert table.station.state == "HOLD"
        assert abs(table.speeds()[-1]) > 1e-4
        before = len(table.sent) - 1
        assert not table.step("hold").refused
        table.steps(300)
        assert table.station.state == "HOLD"
        assert np.ptp(table.rows()["x_num_m"][-100:]) == 0.0
        assert np.abs(np.diff(table.rows()["x_num_m"][-350:], 2)).max() <= 1.72 * H * H
        assert before < len(table.sent)
        assert left == (c.resume[0][0], c.resume[0][1], c.resume[0][2], table.station.test_tick)
    table.step("resume")
    table.until("RUNNING")
    assert c.controller.interface[0].x_num == pytest.approx(left[0], abs=1e-12)
    assert table.station.test_tick == left[3]


def test_hold_while_it_stands_changes_nothing() -> None:
    table = Table(prepared()).fast(0.08)
    table.step("hold")
    table.steps(400)
    stands = table.station._c.controller.interface[0].x_num
    assert not table.step("hold").refused
    assert not table.step("resume").refused
    table.until("RUNNING")
    assert table.station._c.controller.interface[0].x_num != stands


# ---- any operator, any gap -----------------------------------------------------------------------


class Limits:
    """The limits that the command has, and had until it came within them."""

    def __init__(self) -> None:
        self.v, self.a, self.x = 0.5, A_MAX, 5e-3

    def parameters(self, random: np.random.Generator) -> core.Parameters:
        self.v = float(random.choice([0.02, 0.05, 0.1, 0.5]))
        self.a = float(random.choice([3.0, A_MAX, 20.0]))
        base = core.Parameters.of(limited(watches={"position": core.Watch(self.x, "indicate")}))
        return dataclasses.replace(
            base,
            velocity_limit_m_per_s=self.v,
            acceleration_limit_m_per_s2=self.a,
            brake_acceleration_m_per_s2=float(random.choice([0.0, 0.4, 2.0])),
            path_velocity_m_per_s=float(random.choice([0.01, 0.03])),
        )


def any_day(random: np.random.Generator) -> Iterator[tuple[str, int]]:
    """What happens next, and for how many ticks."""
    kinds = ["none", "hold", "resume", "stop", "skip", "deaf", "set", "lose"]
    shares = [0.3, 0.1, 0.2, 0.0, 0.04, 0.2, 0.1, 0.06]
    while True:
        yield str(random.choice(kinds, p=shares)), int(random.integers(1, 10))


@pytest.mark.usefixtures("accelerated")
@pytest.mark.parametrize("seed", range(6))
def test_commands_that_leave_keep_to_their_limits_across_any_gap(seed: int) -> None:
    random = np.random.default_rng(seed)
    limits, quiet = Limits(), {"position": core.Watch(5e-3, "hold")}
    with loop_bench.Bench(send_buffer=1, seconds=40.0, watches=quiet) as bench:
        bench.running(50)
        left = Left(bench)
        gaps = 0

        def tick(action: Any) -> None:
            nonlocal gaps
            action()
            if not left.note():
                return
            if len(left.x) < 3:
                return
            x2, x1, x = left.x[-3:]
            was, step = x1 - x2, x - x1
            slack = 2e-12
            assert abs(step - was) <= limits.a * H * H + slack
            # A limit that was drawn in is reached by braking.
            assert abs(step) <= max(limits.v * H, abs(was) - limits.a * H * H) + slack
            # The narrower reach of a new deceleration is the position limit's, which is hard.
            assert abs(x) <= limits.x + slack
            if left.gap[-1]:
                gaps += 1
                assert step * was >= -slack * slack

        for kind, n in any_day(random):
            if bench.loop.counts.elapsed > 9000 or bench.loop.state in ("TRIPPED", "IDLE"):
                break
            if kind == "skip":
                tick(lambda n=n: bench.step(skipped=1 + n % 2))
            elif kind == "deaf":
                for _ in range(n):
                    tick(bench.tick)
            elif kind == "set":
                bench.loop.set_parameters(limits.parameters(random))
            elif kind == "lose":
                bench.fault("drop", n)
            elif kind != "none":
                tick(lambda kind=kind: bench.step(kind))
            for _ in range(4 * n):
                tick(bench.step)
        print(f"seed {seed}: {len(left.x)} commands, {gaps} gaps, {bench.loop.state}")
        assert gaps > 5
