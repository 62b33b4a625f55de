"""A drive that shares nothing with the core, python-can and cantools, on three kinds of interface.

It speaks on the vcan that the controller is on, at the other end of a vxcan, and over a serial line
as an slcan adapter does: there the kernel talks to python-can's own slcan driver.
"""

from __future__ import annotations

import fcntl
import os
import struct
import time
import tty
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from loop_bench import STATE, Arrivals, can_socket, config, set_interface, shaking

from rthyb_rt import core
from rthyb_rt.core import loop, wire

ROOT = Path(__file__).parents[2]
BITRATE = 1_000_000
TIOCSETD, SIOCGIFNAME, N_SLCAN = 0x5423, 0x8910, 17  # asm-generic/ioctls.h, linux/sockios.h, tty.h
ORIGIN_NM, BIAS_MN, K_MN_PER_NM = 12_300_000, 45_000, 0.6664


def crc8(data: bytes) -> int:
    """SAE J1850, bit by bit."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x1D if crc & 0x80 else 0)) & 0xFF
    return crc ^ 0xFF


class PythonDrive:
    """Stands one sample later where it is told to; a spring pulls at it."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus, self.database = bus, cantools.database.load_file(ROOT / "hw" / "rthyb.dbc")
        self.commands: list[dict[str, Any]] = []
        self.readings: list[tuple[int, int]] = []

    def tick(self, sent: int) -> None:
        """Take in all that was sent, answer with what was latched before."""
        at_nm = self.commands[-1]["x_cmd"] if self.commands else ORIGIN_NM
        while len(self.commands) < sent:
            self.take()
        f_mn = BIAS_MN + round(K_MN_PER_NM * (at_nm - ORIGIN_NM))
        echo = self.commands[-1]["seq"] & 255 if self.commands else 0
        count = len(self.readings) & 255
        self.readings.append((at_nm, f_mn))
        for name, signal, value in (("ACT_FB", "x_meas", at_nm), ("LC_FB", "f_meas", f_mn)):
            self.send(name, {signal: value, "echo": echo, "count": count, "status": 0})

    def take(self) -> None:
        frame = self.bus.recv(10.0)
        assert frame is not None, "a command was sent and did not come"
        message = self.database.get_message_by_frame_id(frame.arbitration_id)
        assert message.name == "ACT_CMD"
        command = message.decode(frame.data, decode_choices=False, scaling=False)
        assert command["crc8"] == crc8(bytes([message.frame_id & 255]) + frame.data[:7])
        self.commands.append(command)

    def send(self, name: str, signals: dict[str, int]) -> None:
        message = self.database.get_message_by_name(name)
        data = message.encode(signals | {"crc8": 0}, scaling=False, strict=False)
        data = data[:7] + bytes([crc8(bytes([message.frame_id & 255]) + data[:7])])
        self.bus.send(can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False))


class Controller:
    """The loop on a raw socket of its own, in lockstep with a drive."""

    def __init__(self, interface: str, owned: ExitStack) -> None:
        codec = wire.can()
        sockets = [can_socket(interface, codec.feedback_ids) for _ in range(2)]
        for each in sockets:
            owned.enter_context(each)
        self.arrivals = Arrivals(sockets[1])
        self.link = loop.Link("can", sockets[0].fileno())
        owned.callback(self.link.close)
        law = core.LawConfig("paper", {"alpha0": 1.0}, adapts=False)
        made = config(law=law, tare_ticks=32, ramp_in_ticks=64)
        station = core.Station(made, shaking(0.5))
        self.station, self.wire = station, wire.Wire(codec)
        self.loop = loop.Loop(station, self.wire, self.link)
        self.records: list[np.ndarray] = []

    def step(self, drive: PythonDrive, command: core.Command = "none") -> None:
        drive.tick(self.link.counters()["pieces_out"])
        end = time.monotonic() + 10.0
        while self.arrivals.count() < 2 * len(drive.readings):
            assert time.monotonic() < end, "readings were sent and did not come"
        if command != "none":
            assert self.loop.command(command)
        self.tick()

    def tick(self) -> None:
        self.loop.beat()
        self.loop.step()
        self.records.append(self.loop.records)

    def until(self, state: str, drive: PythonDrive) -> None:
        for _ in range(5000):
            if self.loop.state == state:
                return
            self.step(drive)
        raise AssertionError(f"never reached {state}, stayed in {self.loop.state}")


def on_vcan(owned: ExitStack) -> tuple[str, can.BusABC]:
    name = os.environ["RTHYB_VCAN"]
    return name, owned.enter_context(can.Bus(name, interface="socketcan"))


def on_vxcan(owned: ExitStack) -> tuple[str, can.BusABC]:
    near, far = os.environ["RTHYB_VXCAN"].split(",")
    return near, owned.enter_context(can.Bus(far, interface="socketcan"))


def attach(fd: int) -> str:
    """Make a CAN interface of a terminal; return its name."""
    fcntl.ioctl(fd, TIOCSETD, struct.pack("i", N_SLCAN))
    name = fcntl.ioctl(fd, SIOCGIFNAME, bytes(16))
    return name.split(b"\0")[0].decode()


def over_serial_line(owned: ExitStack) -> tuple[str, can.BusABC]:
    """The kernel's end is the pty's master, python-can's the slave, which has a name to open."""
    master, slave = os.openpty()
    for fd in (master, slave):
        owned.callback(os.close, fd)
        tty.setraw(fd)
    name = attach(master)
    bus = can.Bus(os.ttyname(slave), interface="slcan", bitrate=BITRATE, sleep_after_open=0.0)
    owned.enter_context(bus)
    set_bitrate = ("type", "can", "bitrate", str(BITRATE))
    set_interface(name, *set_bitrate)
    # On its way up the kernel tells the adapter its bit rate, and waits until that is read.
    with ThreadPoolExecutor(1) as pool:
        up = pool.submit(set_interface, name, "up")
        while not up.done():
            bus.recv(0.05)
        up.result()
    return name, bus


MEDIA: dict[str, Callable[[ExitStack], tuple[str, can.BusABC]]] = {
    "vcan": on_vcan,
    "vxcan": on_vxcan,
    "slcan": over_serial_line,
}


@pytest.fixture(params=MEDIA)
def ends(request: pytest.FixtureRequest) -> Iterator[tuple[Controller, PythonDrive]]:
    with ExitStack() as owned:
        interface, bus = MEDIA[request.param](owned)
        yield Controller(interface, owned), PythonDrive(bus)


def start(controller: Controller, drive: PythonDrive) -> None:
    for _ in range(8):
        controller.step(drive)
    controller.step(drive, "zero")
    controller.until("ZEROED", drive)
    controller.step(drive, "arm")
    controller.step(drive, "start")
    controller.until("RUNNING", drive)


def test_sunny_day_with_a_drive_that_python_can_plays(
    ends: tuple[Controller, PythonDrive],
) -> None:
    controller, drive = ends
    start(controller, drive)
    controller.until("RAMP_OUT", drive)
    assert controller.loop.cause == "completed"
    controller.until("IDLE", drive)

    rows = np.concatenate(controller.records)
    tare_m, tare_n = controller.station.tare
    assert (tare_m, tare_n) == pytest.approx((1e-9 * ORIGIN_NM, 1e-3 * BIAS_MN), abs=1e-8)
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    readings = np.column_stack([1e9 * rows["x_read_m"], 1e3 * rows["f_read_n"]])
    np.testing.assert_array_equal(np.rint(readings), drive.readings)
    assert set(rows["state"]) >= {STATE["RAMP_IN"], STATE["RUNNING"], STATE["RAMP_OUT"]}
    counters = controller.wire.counters()
    assert counters.pop("pairs") == counters.pop("sent") == rows.size
    assert counters.pop("frames") == 2 * rows.size
    assert not any(counters.values()), counters
    assert controller.loop.link_delay == 0

    commands = drive.commands
    assert len(commands) == rows.size - 1
    assert [command["seq"] for command in commands] == list(range(1, rows.size))
    states = np.array([command["state"] for command in commands])
    assert ((states == rows["state"][:-1]) | (states == rows["state"][1:])).all()
    # The row of a tick has the command that the reading of this tick answers.
    begin = int(np.flatnonzero(rows["state"] == STATE["ARMED"])[0])
    told_m = np.array([1e-9 * command["x_cmd"] - tare_m for command in commands[begin - 1 :]])
    np.testing.assert_allclose(told_m, rows["x_cmd_m"][begin:], atol=1e-15)
    assert np.ptp(told_m) > 1e-4


def test_serial_adapter_pulled_out_trips_and_stays_tripped() -> None:
    with ExitStack() as plugged, ExitStack() as owned:
        interface, bus = over_serial_line(plugged)
        controller, drive = Controller(interface, owned), PythonDrive(bus)
        start(controller, drive)
        before = len(controller.records)
        plugged.close()
        for _ in range(30):
            controller.tick()
        assert (controller.loop.state, controller.loop.cause) == ("TRIPPED", "link_down")
        assert controller.link.down == "device-gone"
        rows = np.concatenate(controller.records)
        np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
        states = rows["state"][before:]
        assert (states[1:] == STATE["TRIPPED"]).all()
        assert (rows["flags"][before + 1 :] & core.FLAGS["predicted"]).all()
