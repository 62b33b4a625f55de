"""A bus that goes wrong in a real kernel, in the middle of a test."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
from loop_bench import (
    BUS_OFF,
    CAN_FRAME,
    FLAGS,
    STATE,
    Bench,
    assert_adds_up,
    assert_tripped,
    can_socket,
    set_interface,
)

AWAY = 30
"""Ticks that a cable is out: longer than the drive's own watchdog waits."""


def assert_every_tick_has_its_row(bench: Bench) -> None:
    rows = bench.rows()
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    assert_adds_up(bench)


def lose(bench: Bench, fault: str) -> None:
    """The tick after the loss trips; then everything stays away for a while."""
    bench.tick()
    assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "link_down")
    assert bench.link.down == fault
    for _ in range(AWAY - 1):
        bench.step()
    rows = bench.rows()[-AWAY:]
    assert set(rows["state"]) == {STATE["TRIPPED"]}
    for flag in ("predicted", "lost", "down"):
        assert (rows["flags"] & FLAGS[flag]).all()
    assert np.isfinite(rows["x_meas_m"]).all()
    assert bench.loop.counters()["not_sent"] == 3
    assert bench.drive.phase == "stopped"


def stays_tripped(bench: Bench) -> None:
    for command in ("start", "stop", "arm", "zero"):
        bench.step(command)  # type: ignore[arg-type]
        assert bench.refused
    assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "link_down")
    assert_every_tick_has_its_row(bench)


def test_bus_off_that_another_socket_reports_trips_and_stays_tripped(interface: str) -> None:
    with Bench("vcan", interfaces=(interface, interface)) as bench:
        bench.running()
        bench.drive_ticks()
        with can_socket(interface, ()) as driver:
            driver.send(CAN_FRAME.pack(BUS_OFF, 8, bytes(8)))
        bench.tick()
        assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "link_down")
        assert bench.link.down == "bus-off"
        bench.step()
        assert bench.link.down == "up"
        assert_tripped(bench, "link_down")
        assert_every_tick_has_its_row(bench)


def test_cable_pulled_trips_and_link_returns_stays_tripped(interface: str) -> None:
    with Bench("vcan", interfaces=(interface, interface)) as bench:
        bench.running()
        set_interface(interface, "down")
        lose(bench, "network-down")
        set_interface(interface, "up")
        bench.steps(20)
        assert bench.link.down == "up"
        assert bench.last_flags() & FLAGS["fresh"]
        stays_tripped(bench)


def test_after_the_cable_is_back_a_reset_lets_the_next_test_run(interface: str) -> None:
    with Bench("vcan", interfaces=(interface, interface)) as bench:
        bench.running()
        set_interface(interface, "down")
        lose(bench, "network-down")
        set_interface(interface, "up")
        bench.steps(20)
        bench.step("reset")
        assert not bench.refused
        bench.steps(20)
        assert (bench.loop.state, bench.drive.phase) == ("IDLE", "following")
        bench.running(0)
        bench.until("IDLE")
        assert bench.loop.cause == "completed"
        assert_every_tick_has_its_row(bench)


def test_blink_of_the_link_between_two_ticks_trips_all_the_same(interface: str) -> None:
    with Bench("vcan", interfaces=(interface, interface)) as bench:
        bench.running()
        set_interface(interface, "down")
        set_interface(interface, "up")
        bench.tick()
        assert (bench.loop.state, bench.loop.cause) == ("TRIPPED", "link_down")
        bench.steps(AWAY)
        stays_tripped(bench)


@pytest.mark.parametrize("comes_back", [False, True])
def test_adapter_unplugged_trips_and_another_of_its_name_is_not_taken_for_it(
    interface: str, comes_back: bool
) -> None:
    with Bench("vcan", interfaces=(interface, interface)) as bench:
        bench.running()
        subprocess.run(["ip", "link", "delete", interface], check=True)
        lose(bench, "device-gone")
        if comes_back:
            subprocess.run(["ip", "link", "add", interface, "type", "vcan"], check=True)
            set_interface(interface, "up")
        bench.steps(20)
        assert bench.link.down == "device-gone"
        stays_tripped(bench)
