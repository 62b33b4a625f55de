"""Limits of several axes where one axis says nothing, of directions, and of a test that stays."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from axes_bench import NAMES, OFFSET_M, OFFSET_N, SIDES, Bench, config, controller, shaking, watched

from rthyb_rt import core
from rthyb_rt.core import AxisConfig, AxisReading, Parameters, Watch

EITHER = pytest.mark.parametrize("axis", [0, 1], ids=NAMES)
DIRECTION = pytest.mark.parametrize("interface", [0, 1], ids=["x", "theta"])


def directed(interface: int, name: str, value: float, reaction: core.Reaction) -> dict[str, Any]:
    """A limit that one direction alone has."""
    own = {name: Watch(value, reaction)}
    interfaces = tuple(
        replace(one, watches=own if k == interface else {})
        for k, one in enumerate(controller().interfaces)
    )
    return {"interfaces": interfaces}


# ---- at rest, while another axis has no pair --------------------------------------------------


def zeroed(settings: core.StationConfig) -> Bench:
    """Stopped again after ZERO: at rest, with a zero that readings can be far from."""
    bench = Bench(settings)
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    bench.step("stop")
    assert bench.station.state == "IDLE"
    return bench


AT_REST: dict[str, tuple[float, dict[str, float]]] = {
    "force": (500.0, {"f_n": 2e3}),
    "rig_force": (500.0, {"f_n": 2e3}),
    "tracking": (1e-3, {"x_m": 0.03}),
}


@EITHER
@pytest.mark.parametrize("silent", ["lost", "drive_stopped", "link_down"])
@pytest.mark.parametrize("name", AT_REST)
def test_an_axis_at_rest_is_watched_though_the_other_one_says_nothing(
    name: str, silent: str, axis: int
) -> None:
    most, reading = AT_REST[name]
    bench = zeroed(config(watched(axis, name, most, "trip")))
    other = {1 - axis: {silent: True}}
    for _ in range(40):
        assert bench.step(faults=other).state == "IDLE"
    bench.step(faults=other | {axis: reading})
    assert bench.station.state == "TRIPPED"
    assert (bench.station.cause, bench.station.cause_axis) == (name, axis)
    again = core.Station(bench.settings, shaking(2.0)).replay(bench.rows())
    assert again.tobytes() == bench.rows().tobytes()


@EITHER
@pytest.mark.parametrize("silent", ["drive_stopped", "link_down", "lost"])
def test_an_axis_that_does_not_follow_trips_nothing_by_its_own_force(
    silent: str, axis: int
) -> None:
    """Whoever works at a drive that stands by itself pulls at it as he likes."""
    bench = zeroed(config(watched(axis, "force", 500.0, "trip")))
    for _ in range(40):
        bench.step(faults={axis: {silent: True, "f_n": 2e3}})
    assert bench.station.state == "IDLE"


@EITHER
def test_tracking_of_an_axis_counts_by_its_own_reading_while_the_other_one_has_none(
    axis: int,
) -> None:
    bench = Bench(config(watched(axis, "tracking", 6e-3, "trip"))).running(300)
    away = bench.read()[axis].x_m + 0.02
    bench.step(faults={1 - axis: {"lost": True}, axis: {"x_m": away}})
    assert (bench.station.cause, bench.station.cause_axis) == ("tracking", axis)


# ---- forces along a direction -----------------------------------------------------------------


def push(bench: Bench, interface: int, most: float) -> dict[int, dict[str, float]]:
    """Readings of a force along one direction alone."""
    along = np.zeros(2)
    along[interface] = most
    axes = np.linalg.solve(SIDES.T, along)
    return {k: {"f_n": OFFSET_N[k] + axes[k]} for k in (0, 1)}


@DIRECTION
@pytest.mark.parametrize("reaction", ["hold", "ramp-out"])
def test_a_force_along_a_direction_that_stays_in_spite_of_all_trips(
    reaction: core.Reaction, interface: int
) -> None:
    """As of an axis: .25 s beyond the limit with nothing left to do but a trip."""
    bench = Bench(config(directed(interface, "force", 4e3, reaction))).running(300)
    pushed = push(bench, interface, 5e3)
    states = [bench.step(faults=pushed).state for _ in range(300)]
    left = "HOLD" if reaction == "hold" else "RAMP_OUT"
    assert states[0] == left
    assert states.index("TRIPPED") == pytest.approx(256, abs=2)
    assert bench.station.cause == "force"
    assert bench.station.cause_interface == interface


@DIRECTION
def test_a_force_along_a_direction_far_beyond_its_limit_trips_a_hold_at_once(
    interface: int,
) -> None:
    bench = Bench(config(directed(interface, "force", 4e3, "hold"))).running(300)
    assert bench.step(faults=push(bench, interface, 5e3)).state == "HOLD"
    assert bench.step(faults=push(bench, interface, 7e3)).state == "TRIPPED"


@DIRECTION
def test_nothing_begins_with_a_force_along_a_direction_beyond_its_limit(interface: int) -> None:
    bench = Bench(config(directed(interface, "force", 4e3, "ramp-out")))
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    pushed = push(bench, interface, 5e3)
    bench.step(faults=pushed)
    assert bench.step("arm", pushed).refused
    name, met, most = bench.station.refusal
    assert (name, most) == ("force", 4e3)
    assert met == pytest.approx(5e3, rel=0.01)
    assert bench.station.refusal_interface == interface
    assert bench.station.refusal_axis is None
    bench.step()
    assert not bench.step("arm").refused
    bench.step(faults=pushed)
    assert bench.step("start", pushed).refused
    assert bench.station.refusal_interface == interface


@DIRECTION
def test_a_hold_is_not_resumed_with_a_force_along_a_direction_beyond_its_limit(
    interface: int,
) -> None:
    bench = Bench(config(directed(interface, "force", 4e3, "hold"))).running(300)
    bench.step("hold")
    for _ in range(200):
        bench.step()
    assert bench.station._c.leg == 1
    pushed = push(bench, interface, 5e3)
    bench.step(faults=pushed)
    assert bench.step("resume", pushed).refused
    assert bench.station.refusal_interface == interface
    bench.step()
    assert not bench.step("resume").refused


@DIRECTION
def test_a_force_along_a_direction_trips_at_rest(interface: int) -> None:
    bench = zeroed(config(directed(interface, "force", 4e3, "trip")))
    bench.step(faults=push(bench, interface, 5e3))
    assert bench.station.state == "TRIPPED"
    assert bench.station.cause_interface == interface


@EITHER
def test_a_refused_arm_names_its_axis(axis: int) -> None:
    bench = Bench(config(watched(axis, "force", 500.0, "ramp-out")))
    bench.step()
    bench.step("zero")
    bench.until("ZEROED")
    pushed = {axis: {"f_n": OFFSET_N[axis] + 600.0}}
    bench.step(faults=pushed)
    assert bench.step("arm", pushed).refused
    assert bench.station.refusal_axis == axis
    assert bench.station.refusal_interface is None
    assert bench.step("hold").refused  # not for this state, and of no axis
    assert bench.station.refusal_axis is None


# ---- a test that ends where it is -------------------------------------------------------------


@EITHER
def test_a_test_that_stays_ends_in_front_of_the_limit_of_one_axis(axis: int) -> None:
    """The limiter holds the other axis on the straight way: where that leaves it, it stays."""
    own = {"position": Watch(2e-3, "ramp-out")}
    axes = tuple(AxisConfig(n, watches=own if k == axis else {}) for k, n in enumerate(NAMES))
    settings = config({"axes": axes, "acceleration_limit_m_per_s2": 1.0}, stay=True)
    bench = Bench(settings).running(0)
    bench.until("RAMP_OUT")
    bench.until("IDLE", 3 * 1024)
    assert (bench.station.cause, bench.station.cause_axis) == ("position", axis)
    ended = bench.commands()
    assert abs(ended[-1][axis]) <= 2e-3
    assert abs(ended[-1][1 - axis]) > 1e-4
    assert abs(np.diff(ended, n=2, axis=0)).max() <= 1.0 * core.PERIOD_S**2 * (1 + 1e-6)


# ---- a drive that goes on from another loop ---------------------------------------------------


def test_commands_are_taken_over_of_all_axes_or_of_none() -> None:
    station = core.Station(config(), shaking(1.0))
    given = [AxisReading(OFFSET_M[0], 0.0, taken_over_m=0.0125), AxisReading(OFFSET_M[1], 0.0)]
    with pytest.raises(core.CoreError, match="taken_over_m is missing for axis 2"):
        station.tick(axes=given)
    assert station.ticks == 0
    given[1] = replace(given[1], taken_over_m=-0.0042)
    assert station.tick(axes=given).commands_m == (0.0125, -0.0042)


# ---- sets of parameters -----------------------------------------------------------------------


def test_a_recorded_set_of_parameters_of_several_axes_is_read_again() -> None:
    settings = config(
        watched(1, "force", 3e3, "hold") | directed(0, "position", 2e-3, "ramp-out"),
        watches={"energy": Watch(5.0, "indicate")},
    )
    given = Parameters.of(settings)
    written = json.loads(json.dumps(dataclasses.asdict(given)))
    again = Parameters.of_plain(written)
    assert again == given
    assert bytes(core.library.ffi.buffer(again.struct(3))) == bytes(
        core.library.ffi.buffer(given.struct(3))
    )


def test_a_set_that_came_in_force_is_replayed() -> None:
    bench = Bench().running(200)
    given = Parameters.of(bench.settings)
    narrow = replace(given.axes[1], watches={"position": Watch(1e-3, "ramp-out")})
    changed = replace(given, axes=(given.axes[0], narrow))
    from rthyb_rt._core import lib

    assert lib.rthyb_station_adopt(bench.station._c, changed.struct(1)) == 1
    for _ in range(500):
        bench.step()
    assert (bench.station.cause, bench.station.cause_axis) == ("position", 1)
    plain = Parameters.of_plain(json.loads(json.dumps(dataclasses.asdict(changed))))
    again = core.Station(bench.settings, shaking(2.0)).replay(bench.rows(), parameters=[(1, plain)])
    assert again.tobytes() == bench.rows().tobytes()
