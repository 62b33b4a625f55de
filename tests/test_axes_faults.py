"""The fault table of a test of two axes, every row of it on either axis, tick by tick.

Rows that belong to no axis (the PC, its disk and clock, the operator) strike while that axis has
lost a pair: what one drive suffers at that moment changes nothing of them.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axes_bench import FLAGS, NAMES, H, columns, config, shaking
from loop_bench import BUS_OFF, CAN_FRAME
from test_axes_loop import Lab
from test_axes_realtime import LIMITED, linked

from rthyb_rt import config as files
from rthyb_rt import core
from rthyb_rt.core import loop
from rthyb_rt.errors import RthybError
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring, RingReader
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening

FAR_ENDS = pytest.mark.parametrize("axis", [0, 1], ids=NAMES)
WATCHES = {
    "sensor_jump": core.Watch(5e-3, "ramp-out"),
    "sensor_stuck": core.Watch(40.0, "ramp-out"),
    "force": core.Watch(3e4, "trip"),
}


class Table(Lab):
    """A lab that runs, and what must hold of both drives whatever happened."""

    def last(self, axis: int, name: str) -> Any:
        return self.rows[-1][f"{name}.{axis}" if axis else name][-1]

    def flags(self) -> int:
        return int(self.rows[-1]["flags"][-1])

    def steps(self, n: int, **given: Any) -> list[str]:
        return [self.step(**given) for _ in range(n)]

    def skip(self, n: int) -> None:
        """Ticks that the PC sleeps through, and the drives do not."""
        for _ in range(n):
            self.drives.tick()
        self.step(skipped=n)

    def lose_a_pair(self, axis: int) -> None:
        self.fault(axis, "drop", 1)

    def assert_tripped(self, cause: str, axis: int | None) -> None:
        """Latched with its axis; three commands with one position to each drive, then silence."""
        assert self.loop.state == "TRIPPED"
        self.steps(40)
        for command in ("start", "stop", "arm", "zero"):
            self.step(command)
            assert self.flags() & FLAGS["refused"]
        assert self.loop.state == "TRIPPED"
        assert (self.loop.cause, self.station.cause_axis) == (cause, axis)
        self.steps(30)
        for drive in self.drives.drives:
            log = drive.log
            assert drive.phase == "stopped"
            following = np.flatnonzero(log["phase"] == loop.PHASES.index("following"))
            assert log["silent"][following].max() < loop.WATCHDOG_TICKS
            heard = log[log["frames"] > 0]
            told = heard["state"] == core.STATES.index("TRIPPED")
            if told.any():
                assert np.ptp(heard["x_m"][told]) == 0.0
        self.assert_treated_well()

    def assert_ramps_out(self, cause: str, axis: int | None) -> None:
        """Both come back together, and are at rest together."""
        assert self.loop.state == "RAMP_OUT"
        self.until("IDLE")
        assert (self.loop.cause, self.station.cause_axis) == (cause, axis)
        self.assert_treated_well()

    def assert_treated_well(self) -> None:
        """No drive was ever told a number that is none, nor to leap, nor more than one command."""
        for drive in self.drives.drives:
            log = drive.log
            assert np.isfinite(log["target_m"]).all()
            assert log["refused"].max() == 0
            following = log["phase"] == loop.PHASES.index("following")
            steps = abs(np.diff(log["target_m"]))[following[1:] & following[:-1]]
            assert steps.max() <= 0.5 * H + 2e-9
        self.assert_replays()


Row = Callable[[Table, int, Path], None]
ROWS: dict[str, Row] = {}


def row(what: str) -> Callable[[Row], Row]:
    def keep(check: Row) -> Row:
        ROWS[what] = check
        return check

    return keep


@row("one feedback frame lost, late, twice, out of order, corrupt")
def _(lab: Table, axis: int, _folder: Path) -> None:
    for kind in ("drop", "delay", "duplicate", "reorder", "corrupt"):
        lab.fault(axis, kind, 1)
        lab.step()
        predicted = kind != "duplicate"
        assert bool(lab.flags() & FLAGS["predicted"]) == predicted, kind
        assert not lab.flags() & FLAGS["frozen"]
        assert lab.last(axis, "missing") == predicted
        assert lab.last(1 - axis, "missing") == 0
        # Predicted for both: neither goes on by its own reading alone.
        assert lab.steps(20) == ["RUNNING"] * 20, kind
        assert lab.flags() & FLAGS["fresh"]
    assert lab.loop.counters()["slips"] == 0
    lab.assert_treated_well()


@row("3 to 19 in a row")
def _(lab: Table, axis: int, _folder: Path) -> None:
    lab.fault(axis, "drop", 19)
    for n in range(19):
        assert lab.step() == "RUNNING"
        assert bool(lab.flags() & FLAGS["frozen"]) == (n >= 2)
    lab.step()
    assert lab.flags() & FLAGS["fresh"]
    lab.assert_treated_well()


@row("20 in a row")
def _(lab: Table, axis: int, _folder: Path) -> None:
    lab.fault(axis, "drop", 20)
    assert lab.steps(20) == ["RUNNING"] * 19 + ["TRIPPED"]
    lab.assert_tripped("link_lost", axis)


@row("a reading that is no number")
def _(lab: Table, axis: int, _folder: Path) -> None:
    lab.fault(axis, "not-finite", 1)
    lab.step()
    assert np.isnan(lab.last(axis, "x_read_m"))
    assert np.isfinite(columns(lab.rows[-1], "x_meas_m")).all()
    lab.assert_tripped("not_finite", axis)


@row("sensor stuck or jumping, force beyond its limit")
def _(lab: Table, axis: int, _folder: Path) -> None:
    lab.fault(axis, "force", 2, 5e4)
    lab.step()
    lab.assert_tripped("force", axis)


def ramped_out(lab: Table, axis: int, kind: loop.FaultKind, value: float, cause: str) -> None:
    lab.fault(axis, kind, 400, value)
    while lab.loop.state == "RUNNING":
        lab.step()
    assert lab.loop.state == "RAMP_OUT"
    lab.until("IDLE")
    assert (lab.loop.cause, lab.station.cause_axis) == (cause, axis)
    lab.assert_treated_well()


@row("sensor stuck")
def _(lab: Table, axis: int, _folder: Path) -> None:
    ramped_out(lab, axis, "stuck", 1.0, "sensor_stuck")


@row("sensor jumping")
def _(lab: Table, axis: int, _folder: Path) -> None:
    ramped_out(lab, axis, "jump", 2e-2, "sensor_jump")


@row("cable pulled")
def _(lab: Table, axis: int, _folder: Path) -> None:
    """The other end closes, and nothing comes back."""
    far = lab.drives.drives[axis]._kept[2]
    far.close()
    lab.steps(3)
    assert lab.loop.state == "TRIPPED"
    lab.steps(60)
    assert (lab.loop.state, lab.loop.cause) == ("TRIPPED", "link_down")
    assert lab.station.cause_axis == axis
    assert {drive.phase for drive in lab.drives.drives} == {"stopped"}
    lab.assert_treated_well()


@row("bus-off, and the bus is back")
def _(lab: Table, axis: int, _folder: Path) -> None:
    far = lab.drives.drives[axis]._kept[2]
    os.write(far.fd, CAN_FRAME.pack(BUS_OFF, 8, bytes(8)))
    lab.steps(2)
    assert lab.ways[axis].link.down == "up"
    lab.assert_tripped("link_down", axis)


@row("send queue full")
def _(lab: Table, axis: int, _folder: Path) -> None:
    """The command of that axis is lost, and counted; it never blocks, and nothing is caught up."""
    link = lab.ways[axis].link
    before, fd = link.counters()["no_room"], link.struct.fd
    for _n in range(8):
        link.struct.fd = full_socket(lab)
        lab.step()
        link.struct.fd = fd
        assert lab.flags() & FLAGS["not_sent"]
        assert lab.flags() >> core.UNSENT_BIT & 15 == 1 << axis
    assert link.counters()["no_room"] == before + 8
    assert lab.loop.state == "RUNNING"
    assert lab.steps(30) == ["RUNNING"] * 30
    lab.assert_treated_well()


def full_socket(lab: Table) -> int:
    """A descriptor that takes nothing more and gives nothing."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for one in ends:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
        one.setblocking(False)
        lab.owned.callback(one.close)
    try:
        while True:
            ends[0].send(bytes(16))
    except BlockingIOError:
        return ends[0].fileno()


@row("one overrun, a burst of stalls, a stopped process")
def _(lab: Table, axis: int, _folder: Path) -> None:
    lab.lose_a_pair(axis)
    lab.skip(3)
    assert lab.loop.state == "RUNNING"
    assert lab.rows[-1].size == 4
    lab.steps(40)
    lab.lose_a_pair(axis)
    lab.skip(25)
    assert lab.loop.state == "TRIPPED"
    lab.assert_tripped("stalled", None)


@row("a burst of stalls")
def _(lab: Table, axis: int, _folder: Path) -> None:
    for _n in range(8):
        lab.lose_a_pair(axis)
        lab.skip(9)
        lab.step()
    lab.assert_ramps_out("skips", None)


@row("the controller is killed")
def _(lab: Table, axis: int, _folder: Path) -> None:
    """No drive hears anything more: each stops by its 20th tick, and the ring has the last rows."""
    lab.lose_a_pair(axis)
    last = lab.drives.drives[0].ticks
    for _n in range(60):
        lab.drives.tick()
    for drive in lab.drives.drives:
        following = drive.log["phase"] == loop.PHASES.index("following")
        assert np.flatnonzero(following)[-1] < last + loop.WATCHDOG_TICKS
        assert drive.phase == "stopped"
    assert lab.ring is not None
    with ExitStack() as owned:
        reader = RingReader(lab.ring.path)
        owned.callback(reader.close)
        rows = reader.read(4096).samples
    made = np.concatenate(lab.rows)
    assert rows.tobytes() == made[-rows.size :].tobytes()


@row("the operator stops it, and once more")
def _(lab: Table, axis: int, _folder: Path) -> None:
    lab.lose_a_pair(axis)
    lab.step("stop")
    assert lab.loop.state == "RAMP_OUT"
    lab.steps(20)
    lab.lose_a_pair(axis)
    lab.step("trip")
    lab.assert_tripped("signal", None)


@row("the program hangs")
def _(lab: Table, axis: int, _folder: Path) -> None:
    states = []
    for n in range(1100):
        if n == 1000:
            lab.lose_a_pair(axis)
        lab.drives.tick()
        lab.loop.step(0)
        lab.rows.append(lab.loop.records)
        states.append(lab.loop.state)
    assert states.index("RAMP_OUT") == pytest.approx(1024, abs=1)
    lab.assert_ramps_out("heartbeat", None)


def undisturbed(lab: Table, axis: int, disturb: Callable[[], None]) -> None:
    """The rows are those of a lab in which nothing was disturbed."""
    with ExitStack() as owned:
        quiet = type(lab)(owned, lab.settings, seconds=lab.seconds).running(300)
        for one in (quiet, lab):
            one.lose_a_pair(axis)
        for _n in range(300):
            disturb()
            lab.step()
            quiet.step()
        for name in lab.rows[-1].dtype.names or ():
            np.testing.assert_array_equal(
                np.concatenate(lab.rows)[name], np.concatenate(quiet.rows)[name], err_msg=name
            )


@row("the disk is full, or slow: nobody empties the ring")
def _(lab: Table, axis: int, _folder: Path) -> None:
    assert lab.ring is not None
    undisturbed(lab, axis, lambda: None)
    with ExitStack() as owned:
        reader = RingReader(lab.ring.path)
        owned.callback(reader.close)
        kept = reader.read(4096).samples
    assert 0 < kept.size < np.concatenate(lab.rows).size
    assert kept.tobytes() == np.concatenate(lab.rows)[-kept.size :].tobytes()


@row("the wall clock jumps")
def _(lab: Table, axis: int, _folder: Path) -> None:
    hours = iter(range(1000))
    with pytest.MonkeyPatch.context() as patch:

        def jump() -> None:
            at = 3600.0 * next(hours)
            patch.setattr(time, "time", lambda: at)
            patch.setattr(time, "time_ns", lambda: int(at * 1e9))

        undisturbed(lab, axis, jump)


@row("somebody else has the line of an axis")
def _(_lab: Table, axis: int, _folder: Path) -> None:
    with ExitStack() as owned:
        lines = [virtual_rig.pty_line()[0] for _ in range(3)]
        for line in lines:
            owned.callback(line.close)
        first = linked(lines[0].name, lines[1].name)
        names = [lines[2].name, lines[2].name]
        names[axis] = lines[axis].name
        owned.enter_context(opening.open_axes(first, "controller"))
        with pytest.raises(RthybError, match=f"{NAMES[axis]}.*{lines[axis].name}"):
            opening.open_axes(linked(*names), "controller").__enter__()


@row("configuration out of range")
def _(_lab: Table, axis: int, _folder: Path) -> None:
    """Before anything moves, all errors at once, with axis, value and line."""
    own = ('command_position_m = "30 mm", force_n = "60 kN"', 'command_position_m = "20 mm"')[axis]
    wrong = LIMITED.replace(own, 'command_position_m = inf, force_n = "-60 kN"')
    line = 1 + wrong[: wrong.index("inf")].count("\n")
    with pytest.raises(RthybError) as told:
        files.parse_any_rig(wrong, "rig.toml")
    for part in (f"rig.toml:{line}", "command_position_m", "inf", "force_n", "-60"):
        assert part in str(told.value), told.value


@pytest.fixture
def owned() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.long
@FAR_ENDS
@pytest.mark.parametrize("what", ROWS)
def test_row_of_the_fault_table(what: str, axis: int, owned: ExitStack, tmp_path: Path) -> None:
    strike(Table, ROWS[what], axis, owned, tmp_path)


def strike(table: type[Table], check: Row, axis: int, owned: ExitStack, folder: Path) -> None:
    """Run a lab with a test, and what a row of the fault table says of it."""
    settings = replace(config(), watches=WATCHES)
    session = RecordedTest(
        samples=np.zeros(0, core.row_dtype((), 2)),
        fs_hz=core.FS_HZ,
        ag_mps2=shaking(1.0),
        ground_motion={},
        reference=None,
        test_toml="",
        rig_toml="",
        axis_names=NAMES,
        interface_names=("x", "theta"),
    )
    ring = Ring.create(folder, session, 256)
    owned.callback(ring.close)
    lab = table(owned, settings, ring=ring, seconds=4.0).running(300)
    assert lab.loop.state == "RUNNING"
    check(lab, axis, folder)
