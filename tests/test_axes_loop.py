"""Two drives of one rig over two links: the fault table on either of them, counts that
come apart, and what a ring and a replay have of it."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from axes_bench import FLAGS, NAMES, OFFSET_M, columns, config, rig, shaking, watched

from rthyb_rt import core
from rthyb_rt.core import AxisConfig, loop, wire
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring, RingReader

EITHER = pytest.mark.parametrize("axis", [0, 1], ids=NAMES)
WHEN = 900


class Lab:
    """A loop and two drives in lockstep, each pair of ends a cable of its own."""

    codecs: Sequence[wire.Codec] = (wire.can(), wire.can())

    def __init__(
        self,
        owned: ExitStack,
        settings: core.StationConfig | None = None,
        calibrations: Sequence[core.WireCalibration] = (core.IDENTITY, core.IDENTITY),
        ring: Ring | None = None,
        seconds: float = 2.0,
    ) -> None:
        self.owned, self.ring = owned, ring
        self.settings = settings or config()
        self.station = core.Station(self.settings, shaking(seconds))
        self.calibrations, self.seconds = tuple(calibrations), seconds
        plant, ways, drives = rig(), [], []
        for axis, (near, far) in enumerate(self.cables()):
            codec = self.codecs[axis]
            links = [loop.Link("can", one.fileno()) for one in (near, far)]
            for one in (near, far):
                one.close()
            for link in links:
                owned.callback(link.close)
            ways.append(loop.LoopAxis(wire.Wire(codec), links[0], calibrations[axis]))
            drives.append(
                loop.Drive(
                    plant,
                    codec,
                    links[1],
                    origin_m=OFFSET_M[axis],
                    seed=axis,
                    calibration=calibrations[axis],
                    log_ticks=20000,
                )
            )
        self.drives = self.together(drives)
        first = ways[0]
        self.loop = loop.Loop(
            self.station, first.wire, first.link, ring, calibration=first.calibration,
            further=ways[1:],
        )  # fmt: skip
        self.ways = ways
        self.rows: list[np.ndarray] = []

    def cables(self) -> list[tuple[socket.socket, socket.socket]]:
        """Both ends of the cable of each axis: of the controller and of its drive."""
        return [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in NAMES]

    def together(self, drives: Sequence[loop.Drive]) -> Any:
        return loop.Drives(drives)

    def step(self, command: core.Command | None = None, skipped: int = 0) -> str:
        self.drives.tick()
        self.loop.beat()
        if command:
            assert self.loop.command(command)
        self.loop.step(skipped)
        self.rows.append(self.loop.records)
        return self.loop.state

    def until(self, state: str, most: int = 9000) -> None:
        for _ in range(most):
            if self.loop.state == state:
                return
            self.step()
        raise AssertionError(f"never {state}: {self.loop.state}, {self.loop.cause}")

    def running(self, ticks: int = 200) -> Self:
        for _ in range(5):
            self.step()
        self.step("zero")
        self.until("ZEROED")
        self.step("arm")
        self.step("start")
        self.until("RUNNING")
        for _ in range(ticks):
            self.step()
        return self

    def fault(self, axis: int, kind: loop.FaultKind, ticks: int, value: float = 1.0) -> None:
        drive = self.drives.drives[axis]
        drive.schedule([loop.Fault(kind, drive.ticks, ticks, value)])

    def replayed(self) -> np.ndarray:
        return core.Station(self.settings, shaking(self.seconds)).replay(
            np.concatenate(self.rows), self.codecs, self.calibrations
        )

    def assert_replays(self) -> None:
        rows = np.concatenate(self.rows)
        again = self.replayed()
        for name in rows.dtype.names or ():
            np.testing.assert_array_equal(again[name], rows[name], err_msg=name)


@pytest.fixture
def owned() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_a_test_of_two_axes_over_two_links_ends_at_rest_and_replays(owned: ExitStack) -> None:
    turned = core.WireCalibration(x_gain=-2.0, x_offset_m=0.01, cmd_gain=-0.5, f_gain=0.25)
    lab = Lab(owned, calibrations=(core.IDENTITY, turned)).running()
    lab.until("IDLE")
    assert lab.loop.cause == "completed"
    rows = np.concatenate(lab.rows)
    running = rows["state"] == core.RUNNING
    moved = columns(rows[running], "x_meas_m")
    assert (abs(moved).max(axis=0) > 3e-3).all()
    # Both axes at one specimen, whatever their signs on the wire.
    theta = (moved[:, 0] - moved[:, 1]) / 0.5
    assert abs(theta).max() < 0.1
    assert lab.loop.axis_delays == (0, 0)
    lab.assert_replays()
    last = lab.loop.last_commands()
    assert last is not None
    assert [one.calibration for one in last] == [core.IDENTITY, turned]


Row = tuple[loop.FaultKind, int, float, str, str]
TABLE: dict[str, Row] = {
    "a pair now and then is lost": ("drop", 300, 0.05, "RUNNING", "none"),
    "no pair any more": ("drop", 100, 1.0, "TRIPPED", "link_lost"),
    "commands are lost": ("drop-command", 100, 1.0, "TRIPPED", "drive_stopped"),
    "a command now and then is lost": ("drop-command", 300, 0.05, "RUNNING", "none"),
    "the force is lost": ("drop-force", 100, 1.0, "TRIPPED", "link_lost"),
    "feedback is a sample late": ("delay", 100, 1.0, "RUNNING", "none"),
    "feedback is three samples late": ("delay", 100, 3.0, "TRIPPED", "apart"),
    "feedback out of order": ("reorder", 40, 1.0, "RUNNING", "none"),
    "everything twice": ("duplicate", 200, 1.0, "RUNNING", "none"),
    "damaged frames": ("corrupt", 100, 1.0, "TRIPPED", "link_lost"),
    "the displacement is stuck": ("stuck", 200, 1.0, "RAMP_OUT", "sensor_stuck"),
    "the displacement leaps": ("jump", 30, 2e-2, "TRIPPED", "sensor_jump"),
    "the force leaps": ("force", 30, 5e4, "TRIPPED", "force"),
    "the displacement is no number": ("not-finite", 5, 1.0, "TRIPPED", "not_finite"),
    "silence": ("silence", 100, 1.0, "TRIPPED", "link_lost"),
}


@EITHER
@pytest.mark.parametrize("what", TABLE)
def test_fault_on_either_axis(what: str, axis: int, owned: ExitStack) -> None:
    kind, ticks, value, state, cause = TABLE[what]
    watches = {
        "sensor_jump": core.Watch(5e-3, "trip"),
        "sensor_stuck": core.Watch(40.0, "ramp-out"),
        "force": core.Watch(3e4, "trip"),
    }
    lab = Lab(owned, replace(config(), watches=watches)).running(600)
    assert lab.loop.state == "RUNNING"
    lab.fault(axis, kind, ticks, value)
    sent = len(lab.drives.drives[0].log)
    for _ in range(90):
        lab.step()
    assert lab.loop.state == state
    assert lab.loop.cause == cause
    assert lab.station.cause_axis == (None if cause == "none" else axis)
    # What one axis suffers, the commands of neither leave this world.
    told = np.stack([drive.log["target_m"][sent:] for drive in lab.drives.drives], axis=1)
    assert abs(np.diff(told, axis=0)).max() < 1e-3
    if state == "TRIPPED":
        for _ in range(30):
            lab.step()
        assert {drive.phase for drive in lab.drives.drives} == {"stopped"}
    lab.assert_replays()


@EITHER
def test_a_link_that_is_torn_stops_both_drives(axis: int, owned: ExitStack) -> None:
    lab = Lab(owned).running()
    os.close(lab.drives.drives[axis]._kept[2].fd)
    lab.drives.drives[axis]._kept[2].struct.fd = -1
    for _ in range(40):
        lab.step()
    assert lab.loop.state == "TRIPPED"
    assert lab.loop.cause in ("link_down", "link_lost")
    assert lab.station.cause_axis == axis
    lab.assert_replays()


@EITHER
@pytest.mark.parametrize("skip", [2, 5])
def test_counts_of_two_drives_that_come_apart(axis: int, skip: int, owned: ExitStack) -> None:
    lab = Lab(owned).running()
    lab.drives.drives[axis]._c.tick += skip
    states = [lab.step() for _ in range(25)]
    assert states.index("TRIPPED") in (19, 20)
    assert (lab.loop.cause, lab.station.cause_axis) == ("apart", axis)
    lab.assert_replays()


@EITHER
def test_one_sample_apart_is_jitter(axis: int, owned: ExitStack) -> None:
    lab = Lab(owned).running()
    lab.drives.drives[axis]._c.tick += 1
    for _ in range(60):
        assert lab.step() == "RUNNING"


@EITHER
def test_a_command_that_finds_no_room_on_one_link(axis: int, owned: ExitStack) -> None:
    """It stays as it was for that axis, the row says which, and the replay has it."""
    lab = Lab(owned).running()
    link = lab.ways[axis].link.struct
    fd, spare = link.fd, os.open(os.devnull, os.O_RDONLY)
    lab.step()
    link.fd = spare  # nothing can be written to it
    state = lab.step()
    link.fd = fd
    link.down = 0
    os.close(spare)
    row = lab.rows[-1][-1:]
    assert row["flags"][0] & FLAGS["not_sent"]
    assert int(row["flags"][0]) >> core.UNSENT_BIT & 15 == 1 << axis
    assert state in ("RUNNING", "TRIPPED")
    lab.step()
    lab.assert_replays()


def test_a_wire_that_cannot_hold_the_command_of_one_axis_trips_all(owned: ExitStack) -> None:
    axes = (AxisConfig(NAMES[0]), AxisConfig(NAMES[1]))
    coarse = core.WireCalibration(cmd_gain=1e4, x_gain=1e-4)  # metres are beyond an i4 in nm
    lab = Lab(owned, config({"axes": axes}), calibrations=(core.IDENTITY, coarse))
    for _ in range(5):
        lab.step()
    lab.step("zero")
    for _ in range(200):
        lab.step()
    assert lab.loop.counters()["beyond"] > 0
    assert lab.station.cause_axis in (None, 1)


def test_a_ring_holds_rows_of_both_axes(owned: ExitStack, tmp_path: Path) -> None:
    settings = config(watched(1, "force", 1e5, "trip"))
    settings = replace(settings, axis_channel=0, axis_channel_count=5)
    channels = core.axis_channels(settings.controller)
    dtype = core.row_dtype(channels, 2)
    session = RecordedTest(
        samples=np.zeros(0, dtype),
        fs_hz=core.FS_HZ,
        ag_mps2=shaking(1.0),
        ground_motion={},
        reference=None,
        test_toml="",
        rig_toml="",
        channels=channels,
        axis_names=NAMES,
        interface_names=("x", "theta"),
    )
    ring = Ring.create(tmp_path, session, 4096)
    owned.callback(ring.close)
    lab = Lab(owned, settings, ring=ring, seconds=1.0).running(500)
    reader = RingReader(ring.path)
    owned.callback(reader.close)
    rows = reader.read(4096).samples
    made = np.concatenate(lab.rows)
    assert rows.dtype == dtype
    for name in made.dtype.names or ():
        np.testing.assert_array_equal(rows[name], made[name][-rows.size :], err_msg=name)
    rec = replace(session, samples=rows)
    np.testing.assert_array_equal(rec.axis("right")["x_meas_m"], rows["x_meas_m.1"])
    np.testing.assert_array_equal(rec.axis(0)["x_meas_m"], rows["x_meas_m"])


def test_a_ring_for_rows_of_another_number_of_axes_is_refused(
    owned: ExitStack, tmp_path: Path
) -> None:
    session = RecordedTest(
        samples=np.zeros(0, core.row_dtype((), 1)), fs_hz=core.FS_HZ, ag_mps2=shaking(1.0),
        ground_motion={}, reference=None, test_toml="", rig_toml="",
    )  # fmt: skip
    of_one = Ring.create(tmp_path, session, 64)
    owned.callback(of_one.close)
    lab = Lab(owned)
    lab.step()
    generation = lab.loop.load(core.Station(lab.settings, shaking(1.0)), of_one)
    lab.step()
    assert lab.loop.loaded(generation) is False
    lab.running(50)
    with pytest.raises(core.CoreError):
        Lab(owned, ring=of_one)


def test_a_recording_of_two_axes_is_written_and_read(tmp_path: Path, owned: ExitStack) -> None:
    from rthyb_rt.record import recording

    lab = Lab(owned).running(100)
    rows = np.concatenate(lab.rows)
    rec: Any = RecordedTest(
        samples=rows, fs_hz=core.FS_HZ, ag_mps2=shaking(1.0), ground_motion={}, reference=None,
        test_toml="", rig_toml="", axis_names=NAMES, interface_names=("x", "theta"),
    )  # fmt: skip
    recording.write(tmp_path / "two.h5", rec)
    again = recording.read(tmp_path / "two.h5")
    assert again.samples.tobytes() == rows.tobytes()
    assert (again.axis_names, again.interface_names) == (NAMES, ("x", "theta"))
    assert again.axis_count == 2
    with pytest.raises(Exception, match='no axis "up"; axes are: left, right'):
        again.axis("up")
