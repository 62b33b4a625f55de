"""The two-actuator frame and the ten storeys on CAN, a bus for each axis: by `rthyb run --realtime`
and through the service, each a process beside `rthyb rig`; and a bus that is pulled out. The frame
also with both axes on one bus of CAN FD, each with frames of its own."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import stalls
import test_service_daemon
from command_line import Answer, Rthyb
from loop_bench import can_socket
from one_bus import FD_BYTE, MOST_BYTES, SWITCHED
from realtime_bench import ATTEMPTS, STATE, Process, process, require_calm, until
from realtime_lab import Lab, TooEarly, assert_whole, memory_folder, repeated
from stalls import Stalled
from test_realtime_vcan import assert_stop_is_in_time, ip_at_hand, vcan

from rthyb_rt import config
from rthyb_rt.analysis import several_axes, summary
from rthyb_rt.core import loop
from rthyb_rt.lab import realtime
from rthyb_rt.record.recording import RecordedTest

ROOT = Path(__file__).parents[2]
SHORT = (
    *("--set", "ground_motion.start_s=1.5"),
    *("--set", "limits.ramp_in_s=0.25", "--set", "limits.tare_s=0.125"),
)
TWO_S, LONG = ("--set", "test.duration_s=2"), ("--set", "test.duration_s=6")
# An axis that comes to rest at a peak while the other one moves on may be left with more than the
# rig's own 40 kN, and reset is then refused: at a third of the motion this cannot happen.
GENTLE = ("--set", "ground_motion.pga_g=0.04")
IN_TWO_S = 2048
LINK = 'kind = "can"\nchannel = "{bus}"\nclock = "host"\nvirtual = true\n'
FD = "fd = true\nbitrate = 1_000_000\ndata_bitrate = 4_000_000\n"
FIRST = 0x110
"""Identifier of the first axis' command on a bus for all; the next axis' is higher by 16."""


@dataclass(frozen=True)
class Example:
    """An example as it stands, and the axes of its rig; of one axis none has a name.

    ``shared``: all axes are on one bus of CAN FD, each with identifiers of its own.
    """

    test: str
    rig: str
    axes: tuple[str, ...] = ()
    shared: bool = False

    @property
    def file(self) -> Path:
        return ROOT / "examples" / f"{self.test}.toml"

    @property
    def buses(self) -> tuple[str, ...]:
        return tuple(f"bus{k}" for k in range(1 if self.shared else len(self.axes) or 1))

    @property
    def identifiers(self) -> tuple[tuple[int, int, int], ...]:
        """Of command, displacement and force of each axis on a bus for all."""
        firsts = [FIRST + 16 * k for k in range(len(self.axes))]
        return tuple((first, first + 0x100, first + 0x101) for first in firsts)

    def link(self, k: int) -> str:
        """Return the link of an axis."""
        if not self.shared:
            return LINK.format(bus=self.buses[k])
        words = zip(("command", "displacement", "force"), self.identifiers[k], strict=True)
        ids = ", ".join(f"{word} = {number}" for word, number in words)
        return f"{LINK.format(bus=self.buses[0])}{FD}ids = {{ {ids} }}\n"

    def rig_file(self) -> str:
        """Return the shipped rig file with the link of each of its axes."""
        text = config.find_rig(self.rig).read_text(encoding="utf-8")
        if not self.axes:
            return f"{text}\n[link]\n{self.link(0)}"
        for k, axis in enumerate(self.axes):
            head = f'[[axis]]\nname = "{axis}"\n'
            assert text.count(head) == 1
            text = text.replace(head, f"{head}\n[axis.link]\n{self.link(k)}")
        return text


FRAME = Example("two-actuator-frame", "two-axis-frame", ("upper", "lower"))
TOGETHER = replace(FRAME, shared=True)
STOREYS = Example("ten-storeys", "delay-10-bouc-wen")
BOTH = pytest.mark.parametrize("example", [FRAME, STOREYS], ids=lambda example: example.test)
STOPPED = loop.PHASES.index("stopped")
EITHER = pytest.mark.parametrize("axis", FRAME.axes)


@contextmanager
def buses_of(example: Example) -> Iterator[None]:
    with ExitStack() as owned:
        for bus in example.buses:
            owned.enter_context(vcan(bus, fd=example.shared))
        yield


@pytest.fixture(autouse=True)
def memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with memory_folder() as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
        yield runtime


# ---- what a test has left ------------------------------------------------------------------------


def log_of(file: Path, example: Example) -> list[np.ndarray]:
    """Return the log of each drive."""
    log = np.load(file)
    return list(log.T) if example.axes else [log]


def assert_sound(rec: RecordedTest, example: Example) -> None:
    """A row for every tick, bit for bit repeatable, and every axis has heard its drive."""
    ticks = rec.samples["tick"].astype(np.int64)
    gaps = np.flatnonzero(np.diff(ticks) != 1)
    assert ticks[0] == 0
    # What is missing behind a trip was slept through.
    assert (rec.samples["state"][gaps + 1] == STATE["TRIPPED"]).all()
    assert realtime.replay(rec).identical
    facts = rec.meta["real_time"]
    assert facts["link_facts"]
    if example.axes:
        assert rec.axis_names == example.axes
        assert list(facts["axes"]) == list(example.axes)
        assert all(own["wire"]["pairs"] > 0 for own in facts["axes"].values())


def assert_completed(rec: RecordedTest, example: Example) -> None:
    assert rec.meta["end_reason"] == "completed"
    assert_sound(rec, example)
    running = rec.samples["state"] == STATE["RUNNING"]
    assert np.count_nonzero(running) == IN_TWO_S
    # It went where it was to go: nothing but noise, latency and lost pairs is left.
    if example.axes:
        off = [own.tracking_nrmse for own in several_axes.summarize(rec).axes]
    else:
        off = [summary.summarize(rec).tracking_nrmse]
    assert max(off) < 0.25


def tripped_in_motion(rec: RecordedTest) -> bool:
    state = rec.samples["state"]
    first = np.flatnonzero(state == STATE["TRIPPED"])[:1]
    return bool((state[first - 1] == STATE["RUNNING"]).any())


def assert_tripped_by(rec: RecordedTest, logs: list[np.ndarray], axis: str) -> None:
    """The bus of one axis was pulled out: all drives have stopped in time, and it is named."""
    assert (rec.meta["station"]["state"], rec.meta["station"]["cause"]) == ("TRIPPED", "link_down")
    assert rec.meta["end_reason"] == f"tripped: link down of axis {axis}"
    assert_sound(rec, FRAME)
    for log in logs:
        assert log["refused"].max() == 0
        assert_stop_is_in_time(log)
    # One was told to stop, the other one heard nothing any more.
    heard = [bool((log["state"][log["frames"] > 0] == STATE["TRIPPED"]).any()) for log in logs]
    assert heard == [name != axis for name in FRAME.axes]


# ---- rthyb rig and rthyb run --realtime ----------------------------------------------------------


class OnBuses(Lab):
    """A laboratory that has an example and the rig for it."""

    def __init__(self, folder: Path, runtime: Path, example: Example) -> None:
        super().__init__(folder, runtime)
        self.example = example
        (folder / "rig.toml").write_text(example.rig_file(), encoding="utf-8")

    @contextmanager
    def at_work(self, out: str, *settings: str) -> Iterator[Process]:
        """Give the controller; `ended` wants the log that the drives have left afterwards."""
        rig = ("rig", "rig.toml", "--log", f"{out}.npy", "--seconds", 120)
        with process(self.folder, *rig) as drives:
            assert drives.line().strip().endswith("1024 Hz")
            run = ("run", self.example.file, "--rig", "rig.toml", "--realtime", "--no-report")
            with process(self.folder, *run, "--out", out, *SHORT, *settings) as controller:
                yield controller
            drives.process.terminate()
            assert drives.end()[0] == 0

    def ended(self, out: str, controller: Process, begun_s: float) -> tuple[int, RecordedTest]:
        status, _, err = controller.end()
        if not (self.folder / out).is_dir() and "drive" in err:
            raise Stalled(f"drive_stopped: {err}", begun_s, time.monotonic())
        rec = self.recorded(out, err)
        assert_whole(rec)
        return status, rec

    def pulled(self, out: str, bus: str) -> RecordedTest:
        """Return the recording of a long test in which a bus goes down; the test trips in motion.

        Raises:
            TooEarly: it had ended before.
        """
        begun_s = time.monotonic()
        with ip_at_hand() as ip, self.at_work(out, *LONG) as controller:
            if self.await_state(controller, "RUNNING", 300):
                ip(f"link set {bus} down")
            status, rec = self.ended(out, controller, begun_s)
            ip(f"link set {bus} up")
        require_calm(rec)
        if not tripped_in_motion(rec):
            raise TooEarly
        assert status == 6
        return rec


@BOTH
def test_example_runs_in_real_time_on_a_bus_for_each_axis(
    tmp_path: Path, memory: Path, example: Example
) -> None:
    def attempt(out: str) -> None:
        begun_s = time.monotonic()
        with lab.at_work(out, *TWO_S) as controller:
            status, rec = lab.ended(out, controller, begun_s)
        require_calm(rec)
        assert status == 0
        assert_completed(rec, example)
        for log in log_of(tmp_path / f"{out}.npy", example):
            assert log["refused"].max() == 0
            assert np.isfinite(log["target_m"]).all()

    lab = OnBuses(tmp_path, memory, example)
    with buses_of(example):
        repeated(attempt)


def frames_on(bus: str) -> list[bytes]:
    """Return frames that pass on a bus of CAN FD, those of about fifty ticks."""
    with can_socket(bus, [number for one in TOGETHER.identifiers for number in one], True) as heard:
        time.sleep(0.05)
        found = list[bytes]()
        while True:
            try:
                found.append(heard.recv(MOST_BYTES))
            except BlockingIOError:
                return found


def test_both_axes_run_on_one_bus_of_can_fd_each_with_frames_of_its_own(
    tmp_path: Path, memory: Path
) -> None:
    """Every frame is one of CAN FD at the faster rate; each axis follows its own commands."""

    def attempt(out: str) -> None:
        begun_s, frames = time.monotonic(), list[bytes]()
        with lab.at_work(out, *TWO_S) as controller:
            if lab.await_state(controller, "RUNNING", 300):
                frames = frames_on(TOGETHER.buses[0])
            status, rec = lab.ended(out, controller, begun_s)
        require_calm(rec)
        assert status == 0
        assert_completed(rec, TOGETHER)
        numbers = {struct.unpack("=I", frame[:4])[0] for frame in frames}
        assert numbers == {number for one in TOGETHER.identifiers for number in one}
        assert all(len(frame) == MOST_BYTES and frame[FD_BYTE] & SWITCHED for frame in frames)
        for log in log_of(tmp_path / f"{out}.npy", TOGETHER):
            assert log["refused"].max() == 0
            assert np.isfinite(log["target_m"]).all()

    lab = OnBuses(tmp_path, memory, TOGETHER)
    with buses_of(TOGETHER):
        repeated(attempt)


def test_a_pulled_bus_for_both_axes_trips_the_test_and_stops_both_drives(
    tmp_path: Path, memory: Path
) -> None:
    def attempt(out: str) -> None:
        rec = lab.pulled(out, TOGETHER.buses[0])
        assert rec.meta["end_reason"] == f"tripped: link down of axis {TOGETHER.axes[0]}"
        assert_sound(rec, TOGETHER)
        for log in log_of(tmp_path / f"{out}.npy", TOGETHER):
            assert log["refused"].max() == 0
            assert_stop_is_in_time(log)

    lab = OnBuses(tmp_path, memory, TOGETHER)
    with buses_of(TOGETHER):
        repeated(attempt)


@EITHER
def test_pulled_bus_of_either_axis_trips_both_and_names_it(
    tmp_path: Path, memory: Path, axis: str
) -> None:
    def attempt(out: str) -> None:
        rec = lab.pulled(out, bus)
        assert_tripped_by(rec, log_of(tmp_path / f"{out}.npy", FRAME), axis)

    bus = FRAME.buses[FRAME.axes.index(axis)]
    lab = OnBuses(tmp_path, memory, FRAME)
    with buses_of(FRAME):
        repeated(attempt)


# ---- the service ---------------------------------------------------------------------------------


class Served(test_service_daemon.Lab):
    """A service on the buses of an example, its rig, and `rthyb ctl` beside them."""

    def __init__(self, folder: Path, memory: Path, example: Example, rthyb: Rthyb) -> None:
        self.folder, self.rings, self.runs = folder, memory / "rings", folder / "runs"
        self.rings.mkdir()
        self.log, self.socket = folder / "drive.npy", self.rings / "control.sock"
        self.example, self.rthyb = example, rthyb
        (folder / "rig.toml").write_text(example.rig_file(), encoding="utf-8")
        self.processes: list[Process] = []
        self.drive = self._process("rig", "rig.toml", "--log", self.log)
        assert self.drive.line().strip().endswith("1024 Hz")

    def ctl(self, *words: object) -> Answer:
        """Give a command that is obeyed, unless the machine has stalled."""
        answer = self.rthyb("ctl", words[0], "--socket", self.socket, *words[1:])
        if answer.code:
            self.require_calm_at_rest(answer.err)
        assert answer.code == 0, answer.err
        return answer

    def running(self, *settings: str) -> str:
        """Bring the example into its motion; return its run."""
        self.serve()
        until(lambda: self.status()["follows"], "drives that follow")
        self.ctl("load", self.example.file, *SHORT, *settings)
        self.ctl("zero")
        until(self._recorder_is_there, "the recorder")
        self.ctl("arm")
        run_id = str(self.status()["run_id"])
        self.ctl("start")
        self.await_state("RUNNING")
        return run_id


def through_the_service(example: Example, rthyb: Rthyb, attempt: Callable[[Served], None]) -> None:
    def with_lab(_: int) -> None:
        with (
            TemporaryDirectory() as folder,
            memory_folder() as memory,
            buses_of(example),
            ExitStack() as owned,
        ):
            made = Served(Path(folder), memory, example, rthyb)
            owned.callback(made.close)
            attempt(made)

    stalls.repeated(with_lab, ATTEMPTS)


@BOTH
def test_example_runs_through_the_service(rthyb: Rthyb, example: Example) -> None:
    def attempt(made: Served) -> None:
        run_id = made.running(*TWO_S)
        status = made.status()
        until(made.over, "the end of the test")
        rec = made.recorded(run_id)
        require_calm(rec)
        assert rec.meta["missing_rows"] == []
        assert_completed(rec, example)
        if example.axes:
            assert list(status["axes"]) == list(example.axes)
        made.end_drive()
        assert all(log["refused"].max() == 0 for log in log_of(made.log, example))

    through_the_service(example, rthyb, attempt)


@EITHER
def test_pulled_bus_trips_the_service_which_names_the_axis_and_goes_on_after_reset(
    rthyb: Rthyb, axis: str
) -> None:
    bus = FRAME.buses[FRAME.axes.index(axis)]

    def attempt(made: Served) -> None:
        with ip_at_hand() as ip:
            run_id = made.running(*LONG, *GENTLE)
            time.sleep(0.5)
            ip(f"link set {bus} down")
            rec = made.recorded(run_id)
            said = made.ctl("status").out
            ip(f"link set {bus} up")
        require_calm(rec)
        if not tripped_in_motion(rec):
            raise Stalled("before its motion")
        assert f"axis {axis}: " in said
        until(lambda: made.status()["axes"][axis]["link_down"] == "up", "the bus")
        made.ctl("reset")
        until(lambda: made.status()["follows"], "drives that follow again")
        assert made.status()["state"] == "IDLE"
        made.end_drive()
        logs = log_of(made.log, FRAME)
        stopped = [int(np.flatnonzero(log["phase"] == STOPPED)[-1]) + 1 for log in logs]
        assert_tripped_by(rec, [log[:end] for log, end in zip(logs, stopped, strict=True)], axis)

    through_the_service(FRAME, rthyb, attempt)
