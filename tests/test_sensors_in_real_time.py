"""Sensors without an actuator over links, tick by tick: frames with every fault of every sensor,
the ends of what a frame carries, default limits, zeroing, and commissioning."""

from __future__ import annotations

import dataclasses
import os
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axes_bench import NAMES
from test_axes_files import OWN
from test_axes_redundant import TEST
from test_extra_channels import DBC
from test_sensors_without_actuator import LINKED, read

from rthyb_rt import config as files
from rthyb_rt import core
from rthyb_rt.core import dbc, loop, wire
from rthyb_rt.core.library import STATUS
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import axes_experiment, experiment, extra_frames, realtime, sensor_wires
from rthyb_rt.lab.realtime import station_replay
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig import identify_axes, virtual_rig
from rthyb_rt.rig.commissioning.guided_motion import Reach
from rthyb_rt.rig.identification import SweepPlan
from rthyb_rt.rig.identify_axes_live import identify_axes_live
from rthyb_rt.rig.links import opening

SWEEP = SweepPlan((4.0, 10.0), 1e-3)
MOST = 2**31 - 1
NO_NUMBER = -(2**31)
SENSORS = {"wire": ("right", 1e-9), "column": ("left", 1e-3)}
"""The axis with whose frames each is read, and the step of its channel."""
EACH = pytest.mark.parametrize("name", SENSORS)
SHORT = (
    TEST.replace('duration_s = "6 s"\n', "")
    .replace('name = "redundant"', 'name = "redundant"\nduration_s = 3')
    .replace('pga_g = "0.1 g"', "pga_g = 0.05\nstart_s = 1")
)
FREE = SHORT.replace(', force_n = "150 kN"', "")
"""Without a limit on the force at the interface."""
DEFAULTS = LINKED.replace('stuck_s = 0.2\njump_n = "20 kN"\n', "").replace(
    "ramp_in_s = 1.5", "ramp_in_s = 0.25\ntare_s = 0.125"
)
"""Without limits of their own on the sensors."""


def setup(text: str = DEFAULTS, test: str = SHORT) -> experiment.Setup:
    return axes_experiment.prepare(files.parse_test(test, "test.toml"), read(text), real_time=True)


# ---- frames that something changes on their way -------------------------------------------------

Change = Callable[[int, int], int | None]
"""From the tick of the test and the number on the wire the number that arrives; None: no frame."""


@dataclass
class Between:
    """What is between controller and drives: passes frames on, those of one sensor changed."""

    drives: Any
    ends: list[tuple[socket.socket, socket.socket]]
    axis: int = 0
    change: Change = lambda _, raw: raw
    begun: int | None = None
    ticks: int = 0
    whole: Callable[[int, bytes], bytes | None] = lambda _, frame: frame
    seen: list[int] = field(default_factory=list)
    commands: dict[int, int] = field(default_factory=dict)

    def tick(self) -> None:
        for k, (of_controller, of_drive) in enumerate(self.ends):
            for frame in waiting(of_controller):
                self.commands[k] = self.commands.get(k, 0) + 1
                of_drive.send(frame)
        self.drives.tick()
        self.ticks += 1
        if self.begun is None and any(
            drive.received_state == "RUNNING" for drive in self.drives.drives
        ):
            self.begun = self.ticks
        for k, (of_controller, of_drive) in enumerate(self.ends):
            for frame in waiting(of_drive):
                passed = self.passed(frame) if k == self.axis else frame
                if passed is not None:
                    # Like a bus, it does not wait for a controller that does not listen.
                    with suppress(BlockingIOError):
                        of_controller.send(passed, socket.MSG_DONTWAIT)

    def passed(self, frame: bytes) -> bytes | None:
        """A frame of the axis with the sensor: the number of the force frame is at byte 8."""
        now = -1 if self.begun is None else self.ticks - self.begun
        given = self.whole(now, frame)
        number = int.from_bytes(frame[:4], "little") & 0x7FF
        if given is None or number != wire.LC_FB:
            return given
        head, data = given[:8], bytearray(given[8:])
        raw = int.from_bytes(data[8:12], "little", signed=True)
        other = self.change(now, raw)
        if other is None:
            return None
        self.seen.append(other)
        data[8:12] = other.to_bytes(4, "little", signed=True)
        length = given[4]
        data[7] = wire.crc8(bytes([number & 0xFF]) + bytes(data[:7]) + bytes(data[8:length]))
        return head + bytes(data)


def waiting(end: socket.socket) -> Iterator[bytes]:
    while True:
        try:
            yield end.recv(256, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return


@contextmanager
def between(text: str) -> Iterator[tuple[Any, Between]]:
    """Both ends of the links, and what is between them."""
    with ExitStack() as owned:
        first, second = (
            tuple(map(owned.enter_context, opening.socket_pairs(NAMES))) for _ in range(2)
        )
        drives = owned.enter_context(virtual_rig.in_step(read(text), second[1]))
        ends = [
            tuple(owned.enter_context(socket.socket(fileno=os.dup(one.fd))) for one in (a, b))
            for a, b in zip(first[1].all, second[0].all, strict=True)
        ]
        yield first[0], Between(drives, ends)  # type: ignore[arg-type]


def through(
    name: str,
    change: Change = lambda _, raw: raw,
    text: str = DEFAULTS,
    test: str = SHORT,
    **more: Any,
) -> tuple[RecordedTest, Between]:
    with between(text) as (opened, way):
        way.axis, way.change = NAMES.index(SENSORS[name][0]), change
        for key, value in more.items():
            setattr(way, key, value)
        rec = realtime.run(
            setup(text, test), opened, clock="stepped", before_tick=way.tick, hold_s=0.5
        )
    return rec, way


def assert_replays(rec: RecordedTest) -> None:
    again = station_replay.replay(rec)
    assert again.identical, (again.first_row, again.field)
    assert again.rows == rec.samples.size


def sensor_of(rec: RecordedTest) -> tuple[str, str | None]:
    """The cause of the last row, and the sensor that it names."""
    last = core.placed_cause(int(rec.samples["cause"][-1]))
    names = ("wire", "column")
    return core.CAUSES[last.cause], None if last.sensor is None else names[last.sensor]


def test_frames_that_are_passed_on_give_the_test_that_they_give_without_anything_between() -> None:
    rec, way = through("column")
    direct = virtual_rig.run_faulty(setup(), ())
    assert rec.meta["end_reason"] == direct.meta["end_reason"] == "completed"
    for column in ("x_meas_m", "column", "wire", "wire_read"):
        np.testing.assert_array_equal(rec.samples[column], direct.samples[column])
    assert len(way.seen) > 3000
    assert_replays(rec)


@EACH
@pytest.mark.parametrize("end", [MOST, -MOST])
def test_a_number_at_the_end_of_the_frame_is_off_scale_and_never_a_reading(
    name: str, end: int
) -> None:
    """A converter that saturates: for a while the test goes on as without a reading, then trips."""
    whole, _ = through(name, lambda now, raw: end if 500 <= now < 510 else raw, test=FREE)
    assert whole.meta["end_reason"] == "completed"
    rows = whole.samples[whole.running()]
    off = np.abs(rows[f"{name}_read"]) > {"wire": 2.0, "column": 2e6}[name]
    assert off.sum() == 10
    np.testing.assert_array_equal((rows["code"] & STATUS["out_of_range"]) != 0, off)
    assert ((rows["flags"][off] & core.FLAGS["predicted"]) != 0).all()
    # What is used instead continues the motion.
    step = np.abs(np.diff(rows[name]))
    assert step.max() < 3 * np.abs(np.diff(rows[name][~off])).max()
    assert_replays(whole)

    rec, _ = through(name, lambda now, raw: end if now >= 500 else raw)
    assert rec.meta["station"]["state"] == "TRIPPED"
    assert sensor_of(rec)[1] == name
    assert f"of sensor {name}" in rec.meta["end_reason"]
    before = rec.samples[rec.samples["state"] != core.STATES.index("TRIPPED")]
    assert np.count_nonzero(before["code"] & STATUS["out_of_range"]) <= core.LOST_TICKS
    if name == "column":  # there is a limit on the force at the interface, which it may be beyond
        assert sensor_of(rec) == ("force", name)
        off = before["code"] & STATUS["out_of_range"]
        assert off[-1]
        assert not off[:-1].any()
    assert_replays(rec)


@EACH
def test_a_reading_at_the_end_of_its_own_range_is_off_scale_too(name: str) -> None:
    """80 mm and 70 kN, of the 2.1 m and 2.1 MN that the frame carries."""
    least = 80_000_000 if name == "wire" else 70_000_000
    rec, _ = through(name, lambda now, raw: least if now >= 500 else raw)
    assert (rec.meta["station"]["state"], sensor_of(rec)[1]) == ("TRIPPED", name)
    assert_replays(rec)


@EACH
def test_no_number_in_a_frame_trips_at_once_like_that_of_an_axis(name: str) -> None:
    rec, _ = through(name, lambda now, raw: NO_NUMBER if now >= 500 else raw)
    assert sensor_of(rec) == ("not_finite", name)
    before = rec.samples[rec.samples["state"] != core.STATES.index("TRIPPED")]
    np.testing.assert_array_equal(
        np.isnan(before[f"{name}_read"]), np.arange(before.size) == before.size - 1
    )
    assert_replays(rec)


@EACH
@pytest.mark.parametrize("older", [NO_NUMBER, None])
def test_no_number_in_the_older_of_two_frames_of_a_tick_is_seen(
    name: str, older: int | None
) -> None:
    """A frame comes a tick late, just before the next one, which is good."""
    with between(DEFAULTS) as (opened, way):
        way.axis = NAMES.index(SENSORS[name][0])
        way.change = lambda now, raw: older if older is not None and now == 500 else raw
        passed, kept = way.passed, list[bytes]()

        def late(frame: bytes) -> bytes | None:
            given = passed(frame)
            if way.begun is not None and way.ticks - way.begun == 500:
                assert given is not None
                kept.append(given)
                return None
            while kept:
                way.ends[way.axis][0].send(kept.pop(0))
            return given

        way.passed = late  # type: ignore[method-assign]
        rec = realtime.run(setup(), opened, clock="stepped", before_tick=way.tick, hold_s=0.5)
    facts = rec.meta["real_time"]["axes"][SENSORS[name][0]]["wire"]
    assert facts["superseded"] == 1
    if older is None:
        assert rec.meta["end_reason"] == "completed"
    else:
        assert sensor_of(rec) == ("not_finite", name)
        assert rec.meta["end_reason"] == f"tripped: no numeric reading of sensor {name}"
    assert_replays(rec)


@EACH
def test_a_frozen_channel_is_found_by_the_default_limit(name: str) -> None:
    held: list[int] = []

    def frozen(now: int, raw: int) -> int:
        if now < 1200:
            return raw
        held.append(raw)
        return held[0]

    rec, _ = through(name, frozen)
    assert sensor_of(rec) == ({"wire": "sensor_stuck", "column": "force_stuck"}[name], name)
    assert rec.meta["end_reason"].startswith("ramped out: ")
    assert rec.meta["end_reason"].endswith(f" of sensor {name}")
    assert_replays(rec)


@EACH
def test_a_jump_is_found_by_the_default_limit(name: str) -> None:
    by = {"wire": 5_000_000, "column": 9_000_000}[name]  # 5 mm, 9 kN
    rec, _ = through(name, lambda now, raw: raw + by if now >= 1200 else raw)
    assert sensor_of(rec) == ({"wire": "sensor_jump", "column": "force_jump"}[name], name)
    assert rec.meta["station"]["state"] != "RUNNING"
    assert_replays(rec)


@EACH
def test_lost_foreign_and_short_frames_are_no_readings(name: str) -> None:
    """Only the good ones count, and every tick without one is predicted."""
    rng = np.random.default_rng(3)
    kinds: list[int] = []

    def spoil(now: int, frame: bytes) -> bytes | None:
        if not 300 <= now < 1500 or int.from_bytes(frame[:4], "little") & 0x7FF != wire.LC_FB:
            return frame
        kind = int(rng.integers(0, 60))
        kinds.append(kind)
        if kind == 0:
            return None
        if kind == 1:  # another identifier
            return bytes([frame[0] ^ 0x40]) + frame[1:]
        if kind == 2:  # cut to the frame of a drive without the channel
            return frame[:4] + bytes([8]) + frame[5:]
        return frame

    rec, _ = through(name, whole=spoil)
    axis = SENSORS[name][0]
    facts = rec.meta["real_time"]["axes"][axis]["wire"]
    rows = rec.samples[rec.running()]
    own = rec.axis(axis)[rec.running()]
    lost = np.isnan(own["x_read_m"])
    spoiled = sum(kind < 3 for kind in kinds)
    assert lost.sum() == spoiled > 30
    np.testing.assert_array_equal(np.isnan(rows[f"{name}_read"]), lost)
    assert np.isfinite(rows[name]).all()
    assert facts["bad_length"] == sum(kind == 2 for kind in kinds) > 10
    assert rec.meta["end_reason"] == "completed"
    assert_replays(rec)


@EACH
def test_a_damaged_frame_is_rejected_with_its_reading(name: str) -> None:
    with between(DEFAULTS) as (opened, way):
        axis = NAMES.index(SENSORS[name][0])
        way.axis = axis
        sent = way.passed

        def damaged(frame: bytes) -> bytes | None:
            good = sent(frame)
            number = int.from_bytes(frame[:4], "little") & 0x7FF
            if good is None or number != wire.LC_FB or way.begun is None:
                return good
            if not 500 <= way.ticks - way.begun < 505:
                return good
            return good[:16] + bytes([good[16] ^ 0x10]) + good[17:]

        way.passed = damaged  # type: ignore[method-assign]
        rec = realtime.run(setup(), opened, clock="stepped", before_tick=way.tick, hold_s=0.5)
    rows = rec.samples[rec.running()]
    assert np.isnan(rows[f"{name}_read"]).sum() == 5
    assert rec.meta["real_time"]["axes"][NAMES[axis]]["wire"]["bad_crc"] == 5
    assert rec.meta["end_reason"] == "completed"
    assert_replays(rec)


@EACH
def test_a_drive_that_forgets_its_channel_ends_the_test(name: str) -> None:
    """Restarted with other firmware, whose frames have no room for it."""

    def cut(now: int, frame: bytes) -> bytes | None:
        is_force = int.from_bytes(frame[:4], "little") & 0x7FF == wire.LC_FB
        return frame[:4] + bytes([8]) + frame[5:] if is_force and now >= 500 else frame

    rec, _ = through(name, whole=cut)
    assert rec.meta["end_reason"] == f"tripped: link lost of axis {SENSORS[name][0]}"
    assert_replays(rec)


@EACH
def test_noise_and_slow_motion_of_a_whole_test_set_off_no_default_limit(name: str) -> None:
    rec, _ = through(name)
    assert rec.meta["end_reason"] == "completed"
    assert not (rec.samples["code"] & (STATUS["sensor_stuck"] | STATUS["sensor_jump"])).any()


# ---- zeroing -------------------------------------------------------------------------------------


def zeroed(name: str, change: Change) -> str:
    with pytest.raises(RthybError) as caught:
        through(name, change)
    return str(caught.value)


def test_a_displacement_sensor_that_moves_is_not_zeroed() -> None:
    drift = iter(range(10**6))
    said = zeroed("wire", lambda _, raw: raw + 2_000 * next(drift))  # 2 um a tick
    assert "displacement of sensor wire moved by" in said


def test_a_loaded_cell_is_not_zeroed() -> None:
    said = zeroed("column", lambda _, raw: raw + 20_000_000)
    assert "tare of the force of sensor column would be 20 kN" in said
    assert "14.4 kN is allowed" in said


@EACH
def test_a_frozen_sensor_is_not_zeroed(name: str) -> None:
    """Its noise is stated, so that equal readings are no chance; a tare of 0.125 s has 128."""
    first: list[int] = []

    def frozen(_: int, raw: int) -> int:
        first.append(raw)
        return first[0]

    said = zeroed(name, frozen)
    assert f"sensor {name}: its reading was exactly the same in 128 readings in a row" in said
    assert "check the sensor" in said


@pytest.mark.parametrize("noise", ["", "noise_std_n = 10\nlsb_n = 50\n"])
def test_equal_readings_are_zeroed_if_the_noise_is_not_stated_or_too_small_to_show(
    noise: str,
) -> None:
    first: list[int] = []

    def still(now: int, raw: int) -> int:
        first.append(raw)
        return first[0] if now < 0 else raw

    text = DEFAULTS.replace("noise_std_n = 10\nrange_n", f"{noise}range_n")
    assert text != DEFAULTS
    rec, _ = through("column", still, text=text)
    assert rec.meta["end_reason"] == "completed"
    assert_replays(rec)


@pytest.mark.parametrize("number", [wire.ACT_FB, wire.LC_FB])
def test_a_frozen_reading_of_an_axis_is_not_zeroed(number: int) -> None:
    held: dict[str, bytes] = {}

    def whole(_: int, frame: bytes) -> bytes:
        if int.from_bytes(frame[:4], "little") & 0x7FF != number:
            return frame
        head, data = frame[:8], bytearray(frame[8:])
        data[0:4] = held.setdefault("x", bytes(data[0:4]))
        data[7] = wire.crc8(bytes([number & 0xFF]) + bytes(data[:7]) + bytes(data[8 : frame[4]]))
        return head + bytes(data)

    with pytest.raises(RthybError) as error:
        through("wire", whole=whole)
    what = "displacement" if number == wire.ACT_FB else "force"
    assert f"axis right: the {what} was exactly the same in 128 readings" in str(error.value)


def saturating(count: Iterator[int], after: int) -> Change:
    return lambda _, raw: MOST if next(count) >= after else raw


@EACH
def test_a_sensor_at_the_end_of_its_frame_is_not_zeroed(name: str) -> None:
    end = {"wire": "2147 mm", "column": "2147 kN"}[name]
    for after in (0, 60):  # from the beginning, and while it is zeroed
        count = iter(range(10**6))
        said = zeroed(name, saturating(count, after))
        assert f"sensor {name}" in said
        assert end in said, said
        assert "range" in said


@EACH
def test_a_channel_without_a_number_from_the_beginning_is_named(name: str) -> None:
    """Its amplifier is off: nothing is sent to the drives, and there is no tare."""
    said = zeroed(name, lambda _, raw: NO_NUMBER)
    assert f"sensor {name}: no usable reading for" in said
    assert said.endswith("because its channel has no number")


# ---- serial lines --------------------------------------------------------------------------------


def at_lines(text: str) -> str:
    """The rig with a line for each axis, whose names are filled in later."""
    for k, name in enumerate(NAMES):
        link = f'link = {{ kind = "serial", channel = "LINE{k}", virtual = true }}\n'
        text = text.replace(f'name = "{name}"\n', f'name = "{name}"\n{link}', 1)
    return text


@pytest.mark.parametrize("held", [False, True])
def test_over_serial_lines_the_end_of_the_packet_is_off_scale_too(held: bool) -> None:
    """The cell saturates: its amplifier is overloaded, 3 MN at the virtual specimen's cell."""
    text = at_lines(DEFAULTS)
    over = text.replace("noise_std_n = 10\nrange_n", "bias_n = 9e7\nnoise_std_n = 10\nrange_n")
    over = over.replace('range_n = "70 kN"', "range_n = 1e9")
    over = over.replace("wire_step = 1e-3", "wire_step = 1")
    with ExitStack() as owned:
        lines = [virtual_rig.pty_line()[0] for _ in NAMES]
        for k, line in enumerate(lines):
            owned.callback(line.close)
            text, over = (one.replace(f"LINE{k}", line.name) for one in (text, over))
        links = [loop.Link(line.kind, line.fd) for line in lines]
        for link in links:
            owned.callback(link.close)
        given = read(text)
        # The drive's own frames carry what they can, which is less than its cell measures.
        drives = (
            virtual_rig.drives_of(
                read(over), [line.codec for line in lines], links, virtual_rig.RigPlan()
            )
            if held
            else virtual_rig.drives_of(
                given, [line.codec for line in lines], links, virtual_rig.RigPlan()
            )
        )
        opened = owned.enter_context(opening.open_axes(given, "controller"))
        one = axes_experiment.prepare(files.parse_test(SHORT, "test.toml"), given, real_time=True)
        assert [at.kind for at in opened.all] == ["stream", "stream"]
        if held:
            with pytest.raises(RthybError, match="sensor column"):
                realtime.run(one, opened, clock="stepped", before_tick=drives.tick, hold_s=0.5)
            return
        rec = realtime.run(one, opened, clock="stepped", before_tick=drives.tick, hold_s=0.5)
    assert rec.meta["end_reason"] == "completed"
    assert np.ptp(rec.samples["column"][rec.running()]) > 100
    assert_replays(rec)


# ---- frames of a DBC file -----------------------------------------------------------------------


def with_dbc(folder: Path, *, cell: str = "64|16@1- (4,0) [-80000|80000]", fd: bool = True) -> str:
    """The rig whose axes have frames of their own, with the sensors as signals in them."""
    text = DEFAULTS
    for k, (axis, first) in enumerate(zip(NAMES, (0x100, 0x200), strict=True)):
        signal, name = (("Cell", "cell"), ("Wire", "wire_end"))[k]
        place = {"Cell": cell, "Wire": "64|32@1- (1e-8,0) [0|0]"}[signal]
        table = OWN.format(command=first, reading=first + 1)
        table = table.replace("Reading: 8 drive", "Reading: 16 drive")
        (folder / f"{axis}.dbc").write_text(table + f' SG_ {signal} : {place} "" pc\n')
        link = (
            f'link = {{ kind = "can", channel = "can{k}", fd = true, virtual = true, '
            f'dbc = "{folder / f"{axis}.dbc"}" }}\n'
        )
        text = text.replace(f'name = "{axis}"\n', f'name = "{axis}"\n{link}', 1)
        text = text.replace(f'name = "{name}"\n', f'name = "{name}"\nsignal = "{signal}"\n', 1)
    return text


def over_dbc(text: str, raw: Callable[[int], int | None]) -> RecordedTest:
    """The test over sockets with the frames of the files; the cell's 16 bits can be replaced."""
    given = read(text)
    with ExitStack() as owned:
        first, second = (
            tuple(map(owned.enter_context, opening.socket_pairs(NAMES))) for _ in range(2)
        )
        for side in (*first, *second):
            for name, one in zip(NAMES, side.all, strict=True):
                link = given.of_axis(name).link
                assert link is not None
                assert link.dbc is not None
                one.codec = dbc.load(link.dbc)
        drives = owned.enter_context(virtual_rig.in_step(given, second[1]))
        ends = [
            tuple(owned.enter_context(socket.socket(fileno=os.dup(one.fd))) for one in (a, b))
            for a, b in zip(first[1].all, second[0].all, strict=True)
        ]

        def changed(now: int, frame: bytes) -> bytes:
            other = raw(now)
            if other is None or int.from_bytes(frame[:4], "little") & 0x7FF != 0x101:
                return frame
            return frame[:16] + other.to_bytes(2, "little", signed=True) + frame[18:]

        way = Between(drives, ends, NAMES.index("left"), whole=changed)  # type: ignore[arg-type]
        one = axes_experiment.prepare(files.parse_test(FREE, "test.toml"), given, real_time=True)
        return realtime.run(one, first[0], clock="stepped", before_tick=way.tick, hold_s=0.5)


@pytest.mark.parametrize("end", [20_000, -20_000, 20_001, 32_767, -32_768])
def test_ends_of_a_signal_are_off_scale_whether_its_file_ends_there_or_its_bits(
    end: int, tmp_path: Path
) -> None:
    """80 kN is the end in the file; beyond it, the extra channel is recorded as NaN as ever."""
    pytest.importorskip("cantools")
    rec = over_dbc(with_dbc(tmp_path), lambda now: end if 500 <= now < 510 else None)
    assert rec.meta["end_reason"] == "completed"
    rows = rec.samples[rec.running()]
    off = rows["column_read"] == 4.0 * end
    assert off.sum() == 10
    np.testing.assert_array_equal((rows["code"] & STATUS["out_of_range"]) != 0, off)
    np.testing.assert_array_equal(np.isnan(rows["cell"]), off & (abs(4.0 * end) > 80e3))
    assert np.abs(rows["column"]).max() < 70e3
    assert_replays(rec)
    rec = over_dbc(with_dbc(tmp_path), lambda now: end if now >= 500 else None)
    assert rec.meta["end_reason"] == "tripped: no usable reading of sensor column"
    assert_replays(rec)


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("64|16@1- (1,0) [0|0]", "carries every reading only up to 32.767 kN of either sign"),
        ("64|16@1- (4,0) [-60000|80000]", "carries every reading only up to 60 kN"),
        ("64|16@1+ (4,0) [0|0]", "carries every reading only up to 0 kN"),
        ("64|16@1- (4,0) [-60000|60000]", "or a wider [min|max]"),
    ],
)
def test_a_signal_that_does_not_carry_the_range_is_refused(
    cell: str, said: str, tmp_path: Path
) -> None:
    pytest.importorskip("cantools")
    with pytest.raises(InputError) as caught:
        setup(with_dbc(tmp_path, cell=cell))
    assert "sensor.0.range_n: found 70 kN, but" in str(caught.value)
    assert said in str(caught.value)


def test_two_sensors_of_one_signal_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    text = with_dbc(tmp_path)
    again = '[[axis.sensors.extra]]\nname = "copy"\nunit = "N"\nsignal = "Cell"\n'
    at = text.index("[[axis.sensors.extra]]")
    text = text[:at] + again + text[at:]
    second = text[text.index('[[sensor]]\nkind = "force"') : text.index('[[sensor]]\nkind = "disp')]
    second = second.replace('"column"', '"twin"').replace('extra = "cell"', 'extra = "copy"')
    text = text.replace("[kinematics]", second + "[kinematics]").replace("1.25]", "1.25, 0]")
    text = text.replace("[0, 1, 0]]", "[0, 1, 0, 0]]")
    with pytest.raises(InputError, match="is that of the sensor column too"):
        setup(text)


# ---- what frames carry ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "scale", "offset", "reach"),
    [
        (1e-6, 1.0, 0.0, 2147.483647),
        (1e-3, -2.0, 0.0, 2e-3 * MOST),
        (1.0, 1.0, 1e9, MOST - 1e9),
        (1.0, 1.0, -1e9, MOST - 1e9),
        (1e-6, 1.0, 5e3, 0.0),
    ],
)
@pytest.mark.parametrize("base", [wire.serial, wire.can])
def test_reach_is_that_of_both_signs(
    base: Callable[[], wire.Codec], step: float, scale: float, offset: float, reach: float
) -> None:
    codec = base().with_extras([wire.Extra(scale, offset, step)])
    assert codec.extra_reach(0) == pytest.approx(reach, rel=1e-12)
    assert codec.extra_step(0) == pytest.approx(step * abs(scale))
    assert codec.extra_reach(1) == codec.extra_reach(7) == 0.0
    # Whatever is beyond arrives with at least that magnitude, of either sign.
    for value in (1e12, -1e12):
        frames = codec.encode_feedback(wire.Reading(0.0, 0.0, extra=(value,)))
        data = [codec.decode_feedback(one)[1] for one in frames] if base is wire.can else []
        if data:
            assert abs(data[-1].extra[0]) >= reach


SIGNALS = {
    # bits, scale and range: reach, step
    "64|12@1+ (1,-2048) [0|0]": (2047.0, 1.0),
    "64|12@1+ (1,0) [0|0]": (0.0, 1.0),
    "64|32@1- (1,0) [0|0]": (2147483647.0, 1.0),
    "64|16@1- (0.01,0) [-300|300]": (300.0, 0.01),
    "64|16@1- (0.01,0) [0|0]": (327.67, 0.01),
    "64|16@1- (0.01,0) [-300|100]": (100.0, 0.01),
}


@pytest.mark.parametrize("signal", SIGNALS)
def test_reach_of_a_signal_of_a_dbc_file(signal: str, tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    path = tmp_path / "drive.dbc"
    line = re.search(r" SG_ Accel : .*\n", DBC)
    assert line is not None
    path.write_text(DBC.replace(line[0], f' SG_ Accel : {signal} "N" C\n'), encoding="utf-8")
    base = dbc.load(path)
    place, in_force = dbc.extra(path, base, "Accel")
    codec = base.with_extras([wire.Extra(signal=place, in_force=in_force)])
    reach, step = SIGNALS[signal]
    assert codec.extra_reach(0) == pytest.approx(reach, rel=1e-9)
    assert codec.extra_step(0) == pytest.approx(step)
    for value in (1e11, -1e11):
        frame = codec.encode_feedback(wire.Reading(0.0, 0.0, extra=(value,)))[0]
        assert abs(codec.decode_feedback(frame)[1].extra[0]) >= reach


def test_a_value_beyond_the_range_of_its_signal_is_off_scale_not_missing(tmp_path: Path) -> None:
    """Recorded as NaN like any such value of an extra channel, but the station is given it."""
    pytest.importorskip("cantools")
    path = tmp_path / "drive.dbc"
    path.write_text(DBC, encoding="utf-8")
    base = dbc.load(path)
    place, in_force = dbc.extra(path, base, "Accel")
    narrow = base.with_extras([wire.Extra(signal=place, in_force=in_force)])
    wide_place, _ = dbc.extra(path, base, "Accel")
    wide_place.low, wide_place.high = -32768.0, 32767.0
    wide = base.with_extras([wire.Extra(signal=wide_place, in_force=in_force)])
    (frame, other) = wide.encode_feedback(wire.Reading(0.0, 0.0, extra=(310.0,)))
    ours = wire.Wire(narrow)
    for one in (frame, other):
        ours.receive(one)
    ours.take()
    assert ours.struct.pair.extra[0] == pytest.approx(310.0)
    assert ours.struct.pair.beyond == 1
    assert np.isnan(narrow.decode_feedback(frame)[1].extra[0])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "wire_step = 1e-3",
            "wire_step = 1e-6",
            "sensor.0.range_n: found 70 kN, but in the frames of axis left the channel cell, which "
            "extra of column names, carries every reading only up to 2.14748 kN",
        ),
        ("wire_step = 1e-3", "wire_step = 1e-6", "it must be at least 3.261e-05"),
        ("wire_step = 1e-9", "wire_step = 1e-11", "carries every reading only up to 21.4748 mm"),
        ("wire_step = 1e-3", "wire_step = 1e-3\noffset = 2.1e6", "only up to 47.4836 kN"),
        ("wire_step = 1e-3", "wire_step = 1e-3\nscale = 0.01", "only up to 21.4748 kN"),
    ],
)
def test_a_range_that_the_frame_does_not_carry_is_refused(old: str, new: str, said: str) -> None:
    text = DEFAULTS.replace(old, new, 1)
    for attempt in (setup, lambda given: axes_experiment.at_rest(read(given))):
        with pytest.raises(InputError) as caught:
            attempt(text)
        problems = " ".join(str(one) for one in caught.value.problems)
        assert said in problems
    with between_drives(text) as attempt_drives, pytest.raises(InputError, match="carries every"):
        attempt_drives()


@contextmanager
def between_drives(text: str) -> Iterator[Callable[[], object]]:
    with ExitStack() as owned:
        _, theirs = map(owned.enter_context, opening.socket_pairs(NAMES))
        yield lambda: owned.enter_context(virtual_rig.in_step(read(text), theirs))


def test_the_step_that_is_asked_for_is_enough() -> None:
    text = DEFAULTS.replace("wire_step = 1e-3", "wire_step = 1e-6", 1)
    with pytest.raises(InputError) as caught:
        setup(text)
    asked = re.search(r"at least ([\d.e-]+)", str(caught.value))
    assert asked is not None
    rig = read(DEFAULTS.replace("wire_step = 1e-3", f"wire_step = {asked[1]}", 1))
    sensor_wires.check(rig)
    found = sensor_wires.carried(rig)[1]
    assert found is not None
    assert 70e3 <= found.reach < 70.1e3


def test_a_loop_refuses_a_channel_that_does_not_carry_the_range_at_the_start_and_at_a_load() -> (
    None
):
    """Whatever the files say: of another rig, the range may be larger than the frames carry."""
    given = setup()
    settings = experiment.station_config(given, real=True)
    wider = dataclasses.replace(
        settings,
        sensors=tuple(dataclasses.replace(one, range=1e8) for one in settings.sensors),
    )
    none = dataclasses.replace(
        settings, sensors=tuple(dataclasses.replace(one, range=0.0) for one in settings.sensors)
    )
    good, *bad = (core.Station(one, given.ag_mps2) for one in (settings, wider, none))
    again = core.Station(settings, given.ag_mps2)
    with ExitStack() as owned:
        ours, _ = map(owned.enter_context, opening.socket_pairs(NAMES))
        rig = read(DEFAULTS)
        ways = []
        for name, at in zip(NAMES, ours.all, strict=True):
            link = loop.Link(at.kind, at.fd)
            owned.callback(link.close)
            ways.append(
                loop.LoopAxis(wire.Wire(extra_frames.codec_of(rig.of_axis(name), at.codec)), link)
            )
        places = [(1, 0), (0, 0)]

        def started(station: core.Station) -> loop.Loop:
            first = ways[0]
            return loop.Loop(
                station, first.wire, first.link, clock="stepped", further=ways[1:], sensors=places
            )

        for one in bad:
            with pytest.raises(core.CoreError, match="extra channel"):
                started(one)
        running = started(good)
        for one, accepted in ((bad[0], False), (bad[1], False), (again, True)):
            generation = running.load(one, None)
            running.step()
            assert running.loaded(generation) is accepted


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('range_n = "70 kN"\n', "", "column: range_n is missing"),
        ('range_m = "80 mm"\n', "", "wire: range_m is missing"),
        (
            "wire_step = 1e-3",
            "wire_step = 1e-3\nscale = 0",
            'column: found extra = "cell" with scale = 0',
        ),
    ],
)
def test_a_sensor_that_could_not_be_relied_on_is_refused(old: str, new: str, said: str) -> None:
    assert old in DEFAULTS
    with pytest.raises(InputError) as caught:
        read(DEFAULTS.replace(old, new, 1))
    problems = [str(one) for one in caught.value.problems]
    assert any(said in one for one in problems), problems


# ---- default limits ------------------------------------------------------------------------------


def watches(text: str, *, real: bool = True) -> dict[str, Any]:
    one = setup(text)
    assert one.group is not None
    found = axes_experiment.station_config(one, one.group, real=real)
    return {each.name: each for each in found.sensors}


def test_default_limits_follow_from_noise_and_motion_on_real_links_only() -> None:
    found = watches(DEFAULTS)
    assert {one.stuck.value for one in found.values()} == {20.0}
    assert {one.stuck.reaction for one in found.values()} == {"ramp-out"}
    one = setup(DEFAULTS)
    assert one.group is not None
    velocity = [
        own.limits.derived["command_velocity_m_per_s"].value for own in one.group.derived.axis
    ]
    # second = x2 - x1: wire = x1 / 2 + x2 / 2, each at most twice as fast as its command may be.
    fastest = 2 * (0.5 * velocity[0] + 0.5 * velocity[1])
    assert found["wire"].jump.value == pytest.approx(fastest / 1024 + 20 * 2e-6)
    # A tenth of the smaller of the range and 0.4 (90 kN + 90 kN).
    assert found["column"].jump.value == pytest.approx(7e3)
    for each in watches(DEFAULTS, real=False).values():
        assert (each.stuck, each.jump) == (None, None)


def test_what_a_file_states_replaces_the_default() -> None:
    found = watches(LINKED)
    assert found["column"].stuck == core.Watch(205.0, "trip")
    assert found["column"].jump == core.Watch(20e3, "trip")
    off = DEFAULTS.replace(
        'name = "wire"\n', 'name = "wire"\nstuck_s = { value = 1, enable = false }\n'
    )
    assert watches(off)["wire"].stuck is None
    assert watches(off)["wire"].jump is not None


def test_a_coarse_channel_repeats_its_readings_for_longer() -> None:
    """Half the noise: the chance of a repetition at worst is erf(1 / 2 sqrt 2) = .383."""
    coarse = watches(DEFAULTS.replace("wire_step = 1e-3", "wire_step = 10"))
    assert coarse["column"].stuck.value == np.ceil(np.log(1e-12) / np.log(0.3829249225480262))


def test_a_sensor_whose_noise_is_not_stated_is_noted() -> None:
    one = setup(DEFAULTS.replace("noise_std_n = 10\nrange_n", "range_n"))
    (note,) = [note for note in one.notes if "sensor column" in note]
    assert "stuck_s and jump_n cannot be derived from its noise" in note
    assert not any("sensor" in note for note in setup().notes)


# ---- the other commands of real time -------------------------------------------------------------


@pytest.mark.long
def test_identification_over_links_is_as_in_virtual_time_and_watches_the_sensors() -> None:
    def live(text: str, *faults: loop.Fault) -> identify_axes.AxesResult:
        given = read(text)
        ours, theirs = opening.socket_pairs(NAMES)
        plan = virtual_rig.RigPlan(faults=faults)
        with ours, theirs, virtual_rig.in_step(given, theirs, plan) as drives:
            connection = Reach(given, ours, "stepped", drives.tick)
            return identify_axes_live(connection, SWEEP)

    found = live(DEFAULTS)
    wanted = identify_axes.identify_rig(read(DEFAULTS), SWEEP)
    assert np.abs(found.stiffness - wanted.stiffness).max() < 0.01 * wanted.stiffness.max()
    narrow = DEFAULTS.replace('range_m = "80 mm"', 'range_m = "0.3 mm"')
    with pytest.raises(RthybError, match="sensor wire"):
        live(narrow)
