"""`rthyb rig` and `rthyb run --realtime` over SocketCAN: two processes in a kernel that has it.

They need a virtual interface that ``RTHYB_VCAN`` names; `make test-vm` has one in a guest machine.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import select
import shutil
import signal
import struct
import subprocess
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from can_dump import Dump, candump, decoded
from command_line import Answer, Rthyb
from loop_bench import BUS_OFF, CAN_FRAME, can_socket, set_interface
from realtime_bench import (
    PROGRAM,
    ROWS,
    STATE,
    Process,
    process,
    require_calm,
    stop_begins,
)
from realtime_lab import (
    NOT_SENT,
    Lab,
    TooEarly,
    assert_whole,
    cause_of,
    memory_folder,
    repeated,
)
from stalls import Stalled

from rthyb_rt import config, core
from rthyb_rt.core import FLAGS, loop, mapped_ring
from rthyb_rt.lab import realtime
from rthyb_rt.lab.realtime import conducting
from rthyb_rt.record.recording import RecordedTest

pytestmark = pytest.mark.skipif(
    "RTHYB_VCAN" not in os.environ,
    reason="no CAN interface: make test-vm runs these tests in a guest machine",
)

DBC = Path(__file__).parents[1] / "hw" / "rthyb.dbc"
FD_DBC = Path(__file__).parent / "data" / "links" / "fd_extended.dbc"
BITRATE = 1_000_000
TIOCSETD, SIOCGIFNAME, N_SLCAN = 0x5423, 0x8910, 17  # asm-generic/ioctls.h, linux/sockios.h, tty.h
WITHOUT_PRIVILEGES = ("setpriv", "--bounding-set=-sys_nice,-ipc_lock")
LOST_TICKS = 20
LEAVING = 9
FAREWELL = 3
"""Commands at the end of a test at rest, by which the drive knows that the silence is meant."""
FAULT_S = 1.75
"""When the drive goes wrong, by its own clock: the test is well in its motion then."""
LATER_S = 1.75
"""How much later in the next attempt, where the controller was slow to begin."""


class CanLab(Lab):
    """A laboratory whose rig is the shipped one on CAN, at a virtual interface."""

    def __init__(self, folder: Path, runtime: Path) -> None:
        super().__init__(folder, runtime)
        self.shipped = config.find_rig("shaking-table-can").read_text(encoding="utf-8")
        self.rig_on(os.environ["RTHYB_VCAN"])

    def rig_on(
        self, channel: str, *, name: str = "rig.toml", clock: str = "host", **link: str
    ) -> Path:
        """Write the shipped file with another channel; "" leaves out a key of its link."""
        head, _, tail = self.shipped.partition("[link]\n")
        mine, gap, limits = tail.partition("\n[limits]")
        keys = {"channel": f'"{channel}"', "clock": f'"{clock}"', "virtual": "true"} | link
        kept = [line for line in mine.splitlines() if line.partition(" ")[0] not in keys]
        lines = [*kept, *(f"{key} = {value}" for key, value in keys.items() if value)]
        path = self.folder / name
        path.write_text("\n".join([head + "[link]", *lines, ""]) + gap + limits, encoding="utf-8")
        return path


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[CanLab]:
    with memory_folder() as runtime:
        # Rings and locks of every process and of this one are in the same place.
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
        yield CanLab(tmp_path, runtime)


@pytest.fixture
def interface() -> Iterator[str]:
    """A vcan of the test's own, which may go down and away."""
    with vcan("rig0") as name:
        yield name


@contextmanager
def vcan(name: str, *, fd: bool = False) -> Iterator[str]:
    """Give a virtual interface of the test's own; ``fd``: it takes the frames of CAN FD too."""
    ip("link", "add", name, *(("mtu", "72") if fd else ()), "type", "vcan")
    set_interface(name, "up")
    try:
        yield name
    finally:
        subprocess.run(["ip", "link", "delete", name], check=False, capture_output=True)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@contextmanager
def ip_at_hand() -> Iterator[Callable[[str], None]]:
    """An `ip` that has been started and takes its orders line by line.

    To start a program in mid-test takes a guest machine's only processor for several ticks, and the
    test would end by those.
    """
    with subprocess.Popen(["ip", "-batch", "-"], stdin=subprocess.PIPE) as waiting:
        assert waiting.stdin is not None

        def order(line: str) -> None:
            os.write(waiting.stdin.fileno(), f"{line}\n".encode())

        yield order
    assert waiting.returncode == 0


# ---- a test and what became of it ---------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """What controller, drive and bus have left of a test."""

    status: int
    out: str
    err: str
    rec: RecordedTest
    log: np.ndarray
    drive: dict[str, Any]
    frames: list[tuple[int, bytes, bool]]
    folder: Path

    @property
    def rows(self) -> np.ndarray:
        return self.rec.samples

    @property
    def cause(self) -> str:
        return cause_of(self.rec)

    def commands(self) -> dict[str, np.ndarray]:
        return decoded(self.frames, DBC, "ACT_CMD")


class Running:
    """A rig and a controller that are at work; `ended` waits for the controller.

    Attributes:
        rig, controller: their processes.
        begun_s: when (CLOCK_MONOTONIC).
    """

    def __init__(
        self,
        lab: CanLab,
        out: str,
        *arguments: object,
        bus: str = os.environ.get("RTHYB_VCAN", ""),
        far: str = "",
        rig: str = "rig.toml",
        faults: Sequence[str] = (),
        dump: bool = True,
    ) -> None:
        self.lab, self.out, self.begun_s = lab, out, time.monotonic()
        self.log = lab.folder / f"{out}.npy"
        self._owned = ExitStack()
        folder = lab.folder / f"{out}-bus"
        folder.mkdir()
        self._dump: Dump | None = None
        if dump:
            self._dump = self._owned.enter_context(candump(bus, folder))
        at = ("--can", far or bus, "--log", self.log, "--json", "--seed", 3, "--seconds", 60)
        asked = [word for fault in faults for word in ("--fault", fault)]
        self.rig = Process(lab.folder, "rig", rig, *at, *asked)
        self._owned.callback(self.rig.kill)
        self.controller = lab.controller(out, *arguments, rig=rig)
        self._owned.callback(self.controller.kill)

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_: object) -> None:
        self._owned.close()

    def is_running(self, state: str = "RUNNING", ticks: int = 300) -> bool:
        """Wait for it; False: the test is over already."""
        self.lab.await_state(self.controller, state, ticks)
        return self.controller.process.poll() is None

    def ended(self) -> Ended:
        status, out, err = self.controller.end()
        if not (self.lab.folder / self.out).is_dir() and "the drive" in err:
            raise Stalled(f"drive_stopped: {err}", self.begun_s, time.monotonic())
        frames = self._dump.frames() if self._dump else []
        drive = self.rig_ended()
        rec, folder = self.lab.recorded(self.out, err), self.lab.folder / self.out
        assert_whole(rec)
        assert realtime.replay(rec).identical
        return Ended(status, out, err, rec, np.load(self.log), drive, frames, folder)

    def bus(self) -> list[tuple[int, bytes, bool]]:
        """What was on the bus so far."""
        assert self._dump is not None
        return self._dump.frames()

    def rig_ended(self) -> dict[str, Any]:
        self.rig.signal(signal.SIGTERM)
        status, out, err = self.rig.end()
        assert status == 0, err
        return dict(json.loads(out))


def tell(fault: str, found: Ended) -> None:
    """Print what was seen, as a row of the fault table."""
    begins = stop_begins(found.log)
    told = np.flatnonzero(trip_heard(found.log))
    stop = f"silent {found.log['silent'][begins]}"
    if told.size:
        stop += f", {begins - told[0]} ticks after TRIPPED"
    state = core.STATES[found.rows["state"][-1]]
    print(f"seen | {fault} | {state} | {found.cause} | exit {found.status} | {stop} |")


def trip_heard(log: np.ndarray) -> np.ndarray:
    return (log["state"] == STATE["TRIPPED"]) & (log["frames"] > 0)


def counter(found: Ended, part: str, name: str) -> int:
    return int(found.rec.meta["real_time"][part][name])


def assert_commands_in_order(found: Ended, lost: int = 0) -> dict[str, np.ndarray]:
    """Each executed tick sent one command at most, and candump saw each of them once.

    ``lost`` ones a full queue has swallowed after they were numbered: the drive sees the gap.
    """
    said = found.commands()
    goes = said["state"] == LEAVING
    assert not goes[: goes.size - np.count_nonzero(goes)].any(), "spoke after its farewell"
    command = {signal: values[~goes] for signal, values in said.items()}
    count = np.count_nonzero(found.rows["flags"] & NOT_SENT == 0)
    if not lost:
        np.testing.assert_array_equal(command["seq"], (np.arange(count) + 1) & 0xFFFF)
    assert command["seq"].size == count
    assert np.sum(np.diff(command["seq"].astype(int)) % 0x10000 - 1) == lost
    assert found.log["refused"].max() == 0
    assert np.isfinite(found.log["target_m"]).all()
    return command


def assert_stop_is_in_time(log: np.ndarray) -> None:
    """By the 20th silent tick of its own, and in the tick that hears of a trip."""
    begins = stop_begins(log)
    assert log["silent"][begins] <= loop.WATCHDOG_TICKS
    told = np.flatnonzero(trip_heard(log))
    assert not told.size or begins <= told[0]
    assert (log["phase"][begins:] != loop.PHASES.index("following")).all()
    assert log["phase"][-1] == loop.PHASES.index("stopped")


def assert_tripped(found: Ended, cause: str, trip_frames: int | None = 3) -> None:
    """Latched, with its cause; so many frames with the last position, and nothing after.

    None: there was no interface for candump to look at.
    """
    rows, facts = found.rows, found.rec.meta["real_time"]
    assert (facts["state"], facts["cause"]) == ("TRIPPED", cause)
    assert found.status == (7 if cause in realtime.TIMING_CAUSES else 6), found.err
    assert found.rec.meta["end_reason"] == realtime.end_reason("TRIPPED", cause)
    tripped = rows["state"] == STATE["TRIPPED"]
    assert tripped[np.flatnonzero(tripped)[0] :].all()
    assert np.count_nonzero(tripped) == mapped_ring.AFTER_TRIP
    assert np.isfinite(rows["x_meas_m"]).all()
    assert_stop_is_in_time(found.log)
    if trip_frames is None:
        return
    command = assert_commands_in_order(found)
    is_trip = command["state"] == STATE["TRIPPED"]
    assert np.count_nonzero(is_trip) == trip_frames
    assert is_trip[is_trip.size - trip_frames :].all()
    assert np.ptp(command["x_cmd"][is_trip.size - trip_frames - 1 :]) == 0


def begun_in_running(found: Ended, state: str) -> bool:
    """Whether the test was in its motion when it came to this state."""
    first = np.flatnonzero(found.rows["state"] == STATE[state])[:1]
    return bool((found.rows["state"][first - 1] == STATE["RUNNING"]).any())


# ---- an ordinary day ----------------------------------------------------------------------------


def assert_recording_is_what_was_on_the_bus(found: Ended) -> None:
    """Commands one by one, and each pair that was taken, against what candump saw."""
    rows, flags = found.rows, found.rows["flags"]
    assert not any(is_fd for _, _, is_fd in found.frames)
    command = assert_commands_in_order(found)
    sent = flags & NOT_SENT == 0
    # The row of a tick has the command that the drive had by then: the last one before.
    last = np.cumsum(sent) - sent - 1
    moving = np.flatnonzero(sent & np.isin(rows["state"], [STATE["RUNNING"], STATE["RAMP_OUT"]]))
    told_m = 1e-9 * command["x_cmd"] - found.rec.replay.tares["displacement_m"]
    np.testing.assert_allclose(told_m[last[moving]], rows["x_cmd_m"][moving], atol=1e-15)
    assert np.ptp(told_m[last[moving]]) > 5e-3

    actuator, load_cell = (decoded(found.frames, DBC, name) for name in ("ACT_FB", "LC_FB"))
    for reading in (actuator, load_cell):
        np.testing.assert_array_equal(
            reading["count"], np.arange(reading["count"].size) & 255, "candump missed a frame"
        )
    # What had come before the first tick may have been more than there was room for.
    armed = np.flatnonzero(rows["state"] == STATE["ARMED"])[0]
    fresh = rows[armed:][flags[armed:] & FLAGS["fresh"] != 0]
    steps = np.diff(fresh["count"].astype(int), prepend=int(fresh["count"][0])) % 256
    since = np.cumsum(steps)
    size = actuator["count"].size
    begins = [
        begin
        for begin in range(int(fresh["count"][0]), size - int(since[-1]), 256)
        if np.array_equal(actuator["x_meas"][begin + since], np.rint(1e9 * fresh["x_read_m"]))
    ]
    assert len(begins) == 1
    taken = begins[0] + since
    np.testing.assert_array_equal(load_cell["f_meas"][taken], np.rint(1e3 * fresh["f_read_n"]))
    np.testing.assert_array_equal(actuator["echo"][taken], fresh["echo"])


@pytest.mark.parametrize("clock", ["host", "link"])
def test_twenty_seconds_of_a_test_go_through_and_the_bus_has_what_is_recorded(
    lab: CanLab, rthyb: Rthyb, clock: str
) -> None:
    lab.rig_on(os.environ["RTHYB_VCAN"], clock=clock)

    def attempt(out: str) -> None:
        with Running(lab, out, "--set", "test.duration_s=20", "--json") as test:
            found = test.ended()
        require_calm(found.rec)
        assert found.status == 0, found.err
        assert found.rec.meta["end_reason"] == "completed"
        assert np.count_nonzero(found.rows["state"] == STATE["RUNNING"]) == 20 * core.FS_HZ
        assert_recording_is_what_was_on_the_bus(found)
        answer = rthyb("replay", found.folder)
        assert answer.code == 0
        assert answer.out.startswith("bit-identical")
        measures = json.loads(found.out)["measures"]
        assert measures["duration_s"] == 20.0
        assert measures["response_nrmse"] < 0.05
        live = measures["live"]
        assert live["in_real_time"]
        assert set(realtime.NEEDED) <= set(live["privileges"])
        assert live["missed_rows"] == 0
        facts = found.rec.meta["real_time"]
        assert facts["clock"] == clock
        assert facts["link_facts"]["driver"] == "vcan"

    repeated(attempt)


# ---- what the drive and the bus do wrong --------------------------------------------------------

LONG = ("--set", "test.duration_s=6")


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("silence@{}", "link_lost"),
        ("not-finite@{}:0.005", "not_finite"),
        ("force@{}=20000", "force"),
    ],
)
def test_drive_that_goes_wrong_in_the_motion_trips_the_test(
    lab: CanLab, fault: str, cause: str
) -> None:
    at_s = FAULT_S

    def attempt(out: str) -> None:
        nonlocal at_s
        with Running(lab, out, *LONG, faults=[fault.format(at_s)]) as test:
            found = test.ended()
        require_calm(found.rec, cause)
        if not begun_in_running(found, "TRIPPED"):
            at_s += LATER_S
            raise TooEarly
        if cause == "link_lost" and not lost_by(found, round(at_s * core.FS_HZ)):
            require_calm(found.rec)
        assert_tripped(found, cause)
        tell(fault.format(at_s), found)

    repeated(attempt)


def lost_by(found: Ended, first: int) -> bool:
    """Whether the drive's last word was of the tick before its silence, and the trip 20 later."""
    rows = found.rows
    fresh = np.flatnonzero(rows["flags"] & FLAGS["fresh"])[-1]
    if rows["count"][fresh] != (first - 1) & 255:
        return False
    # The row that trips bears the cause; its state is the one that the tick began in.
    trip = np.flatnonzero(rows["code"] & core.STATUS["link_lost"])[0]
    after = int(rows["tick"][trip] - rows["tick"][fresh])
    longest = int(found.rec.meta["real_time"]["ticks"]["longest_skip"])
    assert LOST_TICKS <= after <= LOST_TICKS + longest
    away = rows["flags"][fresh + 1 : trip]
    assert (away & (FLAGS["predicted"] | FLAGS["blind"])).all()
    return True


@pytest.mark.parametrize(
    ("fault", "cause"),
    [("stuck@{}", "sensor_stuck"), ("jump@{}=0.01", "sensor_jump")],
)
def test_sensor_that_goes_wrong_in_the_motion_ramps_out(
    lab: CanLab, fault: str, cause: str
) -> None:
    at_s = FAULT_S

    def attempt(out: str) -> None:
        nonlocal at_s
        with Running(lab, out, *LONG, faults=[fault.format(at_s)]) as test:
            try:
                found = test.ended()
            except AssertionError as error:
                if "start: refused" not in str(error):
                    raise
                # The sensor was wrong before the test began, and nothing was recorded.
                at_s += LATER_S
                raise TooEarly from error
        require_calm(found.rec)
        leapt_before_zero = abs(found.rec.replay.tares["displacement_m"]) > 5e-3
        if leapt_before_zero or not begun_in_running(found, "RAMP_OUT"):
            at_s += LATER_S
            raise TooEarly
        tell(fault.format(at_s), found)
        assert (found.status, found.cause) == (6, cause), found.err
        assert found.rec.meta["end_reason"] == f"ramped out: {cause.replace('_', ' ')}"
        assert found.rows["state"][-1] == STATE["IDLE"]
        command = assert_commands_in_order(found)
        assert STATE["TRIPPED"] not in command["state"]
        assert_stop_is_in_time(found.log)

    repeated(attempt)


def test_bus_on_which_a_few_frames_go_wrong_carries_the_test_to_its_end(lab: CanLab) -> None:
    faults = [
        # Fewer than a tenth of any second, or the limit on lost pairs ramps the test out.
        "drop@1.5:0.2=0.1",
        "corrupt@1.8:0.01",
        "duplicate@2:0.2",
        "reorder@2.4:0.05",
        "delay@2.8:0.1=3",
        "drop-force@3:0.004",
        "drop-command@3.2:0.01",
    ]

    def attempt(out: str) -> None:
        with Running(lab, out, "--set", "test.duration_s=4", faults=faults) as test:
            found = test.ended()
        require_calm(found.rec)
        assert found.status == 0, found.err
        assert found.cause == "completed"
        assert_commands_in_order(found)
        ticks = {name: round(s * core.FS_HZ) for name, s in [("corrupt", 0.01), ("duplicate", 0.2)]}
        assert counter(found, "wire", "bad_crc") == 2 * ticks["corrupt"]
        assert counter(found, "wire", "duplicate") == 2 * ticks["duplicate"]
        for name in ("missed", "reordered", "lone", "stale"):
            assert counter(found, "wire", name) > 0, name
        flags = found.rows["flags"]
        for name in ("predicted", "frozen", "lost"):
            assert (flags & FLAGS[name]).any(), name
        tell("few frames", found)

    repeated(attempt)


# ---- the cable ----------------------------------------------------------------------------------


def test_interface_that_goes_down_trips_and_stays_tripped_when_it_is_back(
    lab: CanLab, interface: str
) -> None:
    lab.rig_on(interface)

    def attempt(out: str) -> None:
        with ip_at_hand() as order, Running(lab, out, *LONG, bus=interface) as test:
            if test.is_running():
                order(f"link set {interface} down")
                time.sleep(0.3)
                order(f"link set {interface} up")
            found = test.ended()
        require_calm(found.rec)
        assert begun_in_running(found, "TRIPPED")
        assert_tripped(found, "link_down", trip_frames=0)
        tell("ip link set down, up", found)
        assert counter(found, "loop", "not_sent") >= 3
        begins = stop_begins(found.log)
        assert found.log["silent"][begins] == loop.WATCHDOG_TICKS
        # The drive's frames come again, and the station stays where it is.
        after = found.rows["flags"][found.rows["state"] == STATE["TRIPPED"]]
        assert (after & FLAGS["down"]).any()
        assert after[-1] & FLAGS["fresh"]

    repeated(attempt)


def test_interface_that_is_deleted_trips_and_the_drive_stops_by_itself(
    lab: CanLab,
) -> None:
    bus = "rig0"
    lab.rig_on(bus)

    def attempt(out: str) -> None:
        with (
            vcan(bus),
            ip_at_hand() as order,
            Running(lab, out, *LONG, bus=bus, dump=False) as test,
        ):
            if test.is_running():
                order(f"link delete {bus}")
            found = test.ended()
        require_calm(found.rec)
        assert begun_in_running(found, "TRIPPED")
        assert_tripped(found, "link_down", trip_frames=None)
        tell("ip link delete", found)
        assert not trip_heard(found.log).any()
        begins = stop_begins(found.log)
        assert found.log["silent"][begins] == loop.WATCHDOG_TICKS
        late = found.rows["flags"][-mapped_ring.AFTER_TRIP // 2 :]
        assert (late & (FLAGS["down"] | FLAGS["blind"])).all()

    repeated(attempt)


def test_bus_off_that_the_adapter_reports_trips(lab: CanLab, interface: str) -> None:
    lab.rig_on(interface)

    def attempt(out: str) -> None:
        with Running(lab, out, *LONG, bus=interface) as test:
            if test.is_running():
                with can_socket(interface, ()) as driver:
                    driver.send(CAN_FRAME.pack(BUS_OFF, 8, bytes(8)))
            found = test.ended()
        require_calm(found.rec)
        assert begun_in_running(found, "TRIPPED")
        assert_tripped(found, "link_down")
        tell("bus-off", found)
        assert counter(found, "wire_counters", "error_frames") == 1

    repeated(attempt)


# ---- operator and process -----------------------------------------------------------------------


def test_controller_that_is_killed_is_recovered_and_the_drive_stops_by_itself(
    lab: CanLab, rthyb: Rthyb
) -> None:
    def attempt(out: str) -> None:
        with Running(lab, out, *LONG) as test:
            if not test.is_running():
                require_calm(test.ended().rec)
                pytest.fail("over before it was killed")
            path = lab.ring_of(test.controller)
            killed_s = time.monotonic()
            test.controller.signal(signal.SIGKILL)
            test.controller.end()
            time.sleep(0.3)  # the drive's 20 ticks, and its way to rest
            bus = test.bus()
            drive = test.rig_ended()
        log = np.load(test.log)
        begins = stop_begins(log)
        if log["state"][begins] != STATE["RUNNING"]:
            raise Stalled("drive_stopped", test.begun_s, killed_s)
        assert path is not None
        assert log["silent"][begins] == loop.WATCHDOG_TICKS
        assert_stop_is_in_time(log)
        assert drive["watchdog_stops"] == 1
        folder = lab.folder / f"{out}-recovered"
        answer = rthyb("recover", path, "--out", folder, "--json")
        assert answer.code == 0
        assert "its process ended early" in str(answer.json["end_reason"])
        assert answer.json["missing_rows"] == []
        assert rthyb("replay", folder).out.startswith("bit-identical")
        rows = lab.recorded(folder.name).samples
        assert rows["state"][-1] == STATE["RUNNING"]
        np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
        heard = decoded(bus, DBC, "ACT_CMD")["seq"].size
        sent = np.count_nonzero(rows["flags"] & NOT_SENT == 0)
        assert heard - 1 <= sent <= heard
        print(f"seen | kill -9 | recovered {sent} of {heard} | silent {log['silent'][begins]} |")

    repeated(attempt)


def test_second_test_on_the_bus_is_refused_and_ctrl_c_ends_the_first(
    lab: CanLab, rthyb: Rthyb
) -> None:
    def attempt(out: str) -> None:
        with Running(lab, out, *LONG) as test:
            answers = []
            if test.is_running():
                answers = [rthyb(*second), rthyb("rig", "--can", os.environ["RTHYB_VCAN"])]
                test.controller.signal(signal.SIGINT)
            found = test.ended()
        require_calm(found.rec)
        assert [answer.code for answer in answers] == [3, 3]
        holders = {"controller": test.controller, "drive": test.rig}
        for answer, (side, holder) in zip(answers, holders.items(), strict=True):
            assert f"process {holder.process.pid} has it open as {side}" in answer.err
        assert not (lab.folder / "second").exists()
        assert found.status == 0, found.err
        assert found.rec.meta["end_reason"] == "stopped by the operator"
        assert begun_in_running(found, "RAMP_OUT")
        assert found.rows["state"][-1] == STATE["IDLE"]
        command = assert_commands_in_order(found)
        assert STATE["TRIPPED"] not in command["state"]
        assert_stop_is_in_time(found.log)
        tell("SIGINT", found)

    second = ("run", lab.folder / "test.toml", "--rig", lab.folder / "rig.toml", "--realtime")
    second += ("--out", lab.folder / "second")
    repeated(attempt)


def test_second_ctrl_c_trips(lab: CanLab) -> None:
    def attempt(out: str) -> None:
        with Running(lab, out, *LONG) as test:
            if test.is_running():
                test.controller.signal(signal.SIGINT)
                test.is_running("RAMP_OUT", 10)
                test.controller.signal(signal.SIGINT)
            found = test.ended()
        require_calm(found.rec)
        if STATE["TRIPPED"] not in found.rows["state"]:
            raise TooEarly
        assert_tripped(found, "signal")
        tell("SIGINT twice", found)

    repeated(attempt)


def test_controller_that_was_held_for_a_tenth_of_a_second_trips_without_a_burst(
    lab: CanLab,
) -> None:
    def attempt(out: str) -> None:
        with Running(lab, out, *LONG) as test:
            if test.is_running():
                test.controller.signal(signal.SIGSTOP)
                time.sleep(0.1)
                test.controller.signal(signal.SIGCONT)
            found = test.ended()
        require_calm(found.rec, "stalled")
        if not begun_in_running(found, "TRIPPED"):
            raise TooEarly
        assert_tripped(found, "stalled")
        tell("SIGSTOP 0.1 s", found)
        begins = stop_begins(found.log)
        assert found.log["silent"][begins] == loop.WATCHDOG_TICKS
        assert counter(found, "ticks", "longest_skip") >= 60

    repeated(attempt)


# ---- the PC -------------------------------------------------------------------------------------

HOUR_S = 3600.0
JUMPS = 8
AFTER_JUMP = 40
"""Ticks in which a jump of the clock would show."""


@contextmanager
def wall_clock() -> Iterator[Callable[[float], None]]:
    """A wall clock that may be set forth and back, and is right again afterwards."""
    off_s = 0.0

    def jump(by_s: float) -> None:
        nonlocal off_s
        time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + by_s)
        off_s += by_s

    try:
        yield jump
    finally:
        jump(-off_s)


def jumped_at(test: Running, jump: Callable[[float], None]) -> list[int]:
    """Set the clock an hour forth and back, again and again; return the ticks just before."""
    ticks: list[int] = []
    reader = test.lab._reader_of(test.controller)
    assert reader is not None
    with reader:
        for number in range(JUMPS):
            while (rows := reader.read(1024).samples).size:
                last = int(rows["tick"][-1])
            ticks.append(last)
            jump(HOUR_S if number % 2 == 0 else -HOUR_S)
            time.sleep(0.15)
    return ticks


def test_wall_clock_that_jumps_by_an_hour_costs_no_tick(lab: CanLab) -> None:
    def attempt(out: str) -> None:
        ticks: list[int] = []
        with wall_clock() as jump, Running(lab, out, *LONG) as test:
            if test.is_running():
                ticks = jumped_at(test, jump)
            found = test.ended()  # whole: executed + skipped == elapsed; and replayed bit for bit
        counts = found.rec.meta["real_time"]["ticks"]
        assert counts["executed"] + counts["skipped"] == counts["elapsed"]
        assert counts["elapsed"] < 60 * core.FS_HZ, "an hour has become ticks"
        rows = found.rows
        blind = rows["tick"][rows["flags"] & FLAGS["blind"] != 0].astype(np.int64)
        beside = [at for at in ticks if ((blind > at) & (blind <= at + AFTER_JUMP)).any()]
        require_calm(found.rec)
        # A jump that cost a tick would do so each time; one in a while is this machine's.
        assert len(beside) <= JUMPS // 2, "jumps have skipped ticks"
        assert found.status == 0, found.err
        assert found.rec.meta["end_reason"] == "completed"
        assert np.count_nonzero(rows["state"] == STATE["RUNNING"]) == 6 * core.FS_HZ
        at = np.searchsorted(rows["tick"], ticks)
        assert (rows["state"][at] == STATE["RUNNING"]).all()
        assert (rows["state"][at + AFTER_JUMP] == STATE["RUNNING"]).all()
        assert (np.diff(rows["due_ns"]) < 2 * core.PERIOD_S * 1e9).all()
        assert_commands_in_order(found)
        print(f"seen | wall clock {len(ticks)} x 1 h | {counts['skipped']} ticks skipped in all |")

    repeated(attempt)


# ---- other media --------------------------------------------------------------------------------


def assert_completed(found: Ended) -> None:
    assert found.status == 0, found.err
    assert found.rec.meta["end_reason"] == "completed"
    assert np.count_nonzero(found.rows["state"] == STATE["RUNNING"]) == ROWS
    assert found.log["refused"].max() == 0
    sent = np.count_nonzero(found.rows["flags"] & NOT_SENT == 0)
    assert found.log["frames"].sum() - sent in (0, FAREWELL)


def test_test_over_a_cable_between_two_interfaces(lab: CanLab) -> None:
    ours, theirs = os.environ["RTHYB_VXCAN"].split(",")
    lab.rig_on(ours)

    def attempt(out: str) -> None:
        with Running(lab, out, bus=ours, far=theirs) as test:
            found = test.ended()
        require_calm(found.rec)
        assert_completed(found)
        assert_commands_in_order(found)
        assert found.rec.meta["real_time"]["link_facts"]["driver"] == "vxcan"

    repeated(attempt)


class Adapter:
    """A serial CAN adapter: an interface of the kernel's slcan, and the other end of its line."""

    def __init__(self, owned: ExitStack) -> None:
        self.line, end = os.openpty()
        for fd in (self.line, end):
            owned.callback(os.close, fd)
        tty.setraw(end)
        fcntl.ioctl(end, TIOCSETD, struct.pack("i", N_SLCAN))
        name = fcntl.ioctl(end, SIOCGIFNAME, bytes(16))
        self.name = name.split(b"\0")[0].decode()


@contextmanager
def serial_adapters(bitrate: int = BITRATE) -> Iterator[tuple[str, str]]:
    """Two adapters on one bus, which is a thread: what one of them says the other one hears."""
    with ExitStack() as owned:
        ours, theirs = (Adapter(owned) for _ in range(2))
        done = threading.Event()
        bus = threading.Thread(target=pass_on, args=(ours.line, theirs.line, done))
        bus.start()
        owned.callback(bus.join)
        owned.callback(done.set)
        for adapter in (ours, theirs):
            set_interface(adapter.name, "up", "type", "can", "bitrate", str(bitrate))
        yield ours.name, theirs.name


def pass_on(a: int, b: int, done: threading.Event) -> None:
    # Between two threads that do not wait, one that does would be the slowest of the three.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    other = {a: b, b: a}
    while not done.is_set():
        for fd in select.select([a, b], [], [], 0.05)[0]:
            os.write(other[fd], os.read(fd, 4096))


def test_test_over_serial_adapters(lab: CanLab) -> None:
    def attempt(out: str) -> None:
        with serial_adapters() as (ours, theirs):
            lab.rig_on(ours)
            # What these adapters lose is this machine's doing, not a fault of the link.
            calm = ("--set", "limits.lost_pairs_share=0.5")
            with Running(lab, out, *calm, bus=ours, far=theirs) as test:
                found = test.ended()
        require_calm(found.rec, serial=True)
        assert_completed(found)
        # Adapters and the bus between them are as slow as this machine.
        assert_commands_in_order(found, lost=counter(found, "loop", "not_sent"))
        facts = found.rec.meta["real_time"]["link_facts"]
        assert (facts["driver"], facts["bitrate"], facts["restart_ms"]) == ("can", BITRATE, 0)

    repeated(attempt)


def test_drive_of_another_make_over_can_fd(lab: CanLab) -> None:
    """Its frames are in a DBC file beside the rig file; both processes go by it."""
    bus = os.environ["RTHYB_VCAN_FD"]
    shutil.copy(FD_DBC, lab.folder / "drive.dbc")
    names = '{ x_cmd = "SetPos" }'
    lab.rig_on(bus, dbc='"drive.dbc"', fd="true", names=names, bitrate="")

    def attempt(out: str) -> None:
        with Running(lab, out, bus=bus) as test:
            found = test.ended()
        require_calm(found.rec)
        assert_completed(found)
        assert all(is_fd for _, _, is_fd in found.frames)
        command, actual = (decoded(found.frames, FD_DBC, name) for name in ("Command", "Actual"))
        sent = np.count_nonzero(found.rows["flags"] & NOT_SENT == 0)
        np.testing.assert_array_equal(command["seq"][:sent], np.arange(sent) + 1)
        assert command["seq"].size - sent in (0, FAREWELL)
        assert np.ptp(command["SetPos"]) > 1000  # um
        np.testing.assert_array_equal(actual["count"], np.arange(actual["count"].size))

    repeated(attempt)


# ---- bad use ------------------------------------------------------------------------------------


def sent_on(interface: str) -> int:
    """Frames that have ever left on it, by the kernel's own count."""
    return int(Path(f"/sys/class/net/{interface}/statistics/tx_packets").read_text())


@pytest.fixture
def refusal(lab: CanLab, rthyb: Rthyb) -> Callable[..., str]:
    """Run the test and return what it says: it is refused, in one message, and nothing is left."""

    def refused(*settings: str) -> str:
        out = lab.folder / "refused"
        rig = ("--rig", lab.folder / "rig.toml")
        answer: Answer = rthyb(
            *("run", lab.folder / "test.toml", *rig, "--realtime", "--out", out, *settings)
        )
        assert answer.code == 3
        assert answer.out == ""
        assert len(re.findall("^rthyb: ", answer.err, re.MULTILINE)) == 1
        assert not out.exists()
        assert not list(lab.runtime.glob("rthyb/ring.*"))
        return answer.err

    return refused


def test_interface_that_is_not_there(
    lab: CanLab, refusal: Callable[..., str], rthyb: Rthyb
) -> None:
    lab.rig_on("can9")
    message = refusal()
    assert "can9: no such interface; CAN interfaces here: " in message
    assert os.environ["RTHYB_VCAN"] in message
    answer = rthyb("rig", "--can", "can9")
    assert answer.code == 3
    assert "can9: no such interface" in answer.err


def test_interface_that_is_down(lab: CanLab, interface: str, refusal: Callable[..., str]) -> None:
    lab.rig_on(interface)
    set_interface(interface, "down")
    assert f"the interface is down; set it up with `sudo ip link set {interface} up`" in refusal()
    set_interface(interface, "up")
    assert sent_on(interface) == 0


@pytest.mark.parametrize(
    ("bitrate", "said", "message"),
    [
        (800_000, f"{BITRATE}", "its bit rate is 800000 bit/s, but the rig file says 1000000"),
        (500_000, "", "and at most 80 % is allowed"),
    ],
)
def test_adapter_of_another_bit_rate(
    lab: CanLab, refusal: Callable[..., str], bitrate: int, said: str, message: str
) -> None:
    with serial_adapters(bitrate) as (name, _):
        lab.rig_on(name, bitrate=said)
        assert message in refusal()
        assert sent_on(name) == 0


@pytest.mark.parametrize(
    ("link", "message"),
    [
        ({"bitrate": "500_000"}, "and at most 80 % is allowed"),
        (
            {"dbc": '"drive.dbc"', "fd": "true", "bitrate": ""},
            "drive.dbc: x_cmd: no signal of this name exists, but the commanded displacement "
            "is needed; ",
        ),
        (
            {"dbc": '"none.dbc"'},
            "no such file; a relative path is relative to the folder of the rig file",
        ),
    ],
)
def test_link_that_cannot_work_is_refused_before_it_is_opened(
    lab: CanLab, refusal: Callable[..., str], link: dict[str, str], message: str
) -> None:
    bus = os.environ["RTHYB_VCAN"]
    shutil.copy(FD_DBC, lab.folder / "drive.dbc")
    before = sent_on(bus)
    lab.rig_on(bus, **link)
    assert message in refusal()
    assert sent_on(bus) == before


def test_nothing_on_the_bus_is_said_and_nothing_is_sent(
    lab: CanLab, interface: str, refusal: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.rig_on(interface)
    monkeypatch.setattr(conducting, "FEEDBACK_S", 0.5)
    assert "is the drive switched on" in refusal()
    assert sent_on(interface) == 0


def test_pc_without_privileges_is_refused_where_real_time_is_required(lab: CanLab) -> None:
    """root without its capabilities is nobody: the drive is told to stay where it is, no more."""
    bus = os.environ["RTHYB_VCAN"]
    lab.rig_on(bus, require_realtime="true")
    log = lab.folder / "drive.npy"
    with process(lab.folder, "rig", "rig.toml", "--log", log) as drive:
        assert drive.line()
        run = ("run", "test.toml", "--rig", "rig.toml", "--realtime", "--out", "out")
        answer = subprocess.run(
            ["prlimit", "--rtprio=0", "--memlock=65536", *WITHOUT_PRIVILEGES, *PROGRAM, *run],
            cwd=lab.folder,
            capture_output=True,
            text=True,
            check=False,
        )
        drive.signal(signal.SIGTERM)
        assert drive.end()[0] == 0
    assert answer.returncode == 7
    assert "did not obtain real-time priority and locked memory" in answer.stderr
    assert "run rthyb jitter to see how to obtain them" in answer.stderr
    assert not (lab.folder / "out").exists()
    seen = np.load(log)
    assert np.isin(seen["state"][seen["frames"] > 0], (STATE["IDLE"], LEAVING)).all()
    assert np.ptp(seen["target_m"]) < 1e-4
