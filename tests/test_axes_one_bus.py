"""Two axes on one CAN bus, each with identifiers of its own, tick by tick: those of a DBC file, or
the program's own frames on a bus of CAN FD, with every row of the fault table on either axis."""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axes_bench import NAMES
from axes_bench import config as config_of_two
from loop_bench import BUS_OFF, CAN_FRAME
from one_bus import CODECS, FD_BYTE, MOST_BYTES, SWITCHED, Bus, DrivesAtBus
from realtime_bench import until
from test_axes_faults import FAR_ENDS, ROWS, Table, strike
from test_axes_files import OWN
from test_axes_realtime import AXES, LIMITED, assert_replays, setup

from rthyb_rt import config
from rthyb_rt.checking import examined_rig
from rthyb_rt.config import AxesRig, busload, linkframes
from rthyb_rt.core import loop, wire
from rthyb_rt.errors import InputError
from rthyb_rt.lab import extra_frames, realtime
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import locks, opening

FIRST = {"left": 0x100, "right": 0x200}
FD = "fd = true\ndata_bitrate = 4000000\n"
FRAMES = ("dbc", "ids")


def own_frames(name: str) -> str:
    first = FIRST[name]
    ids = f"command = {first}, displacement = {first + 1}, force = {first + 2}"
    return f"{FD}ids = {{ {ids} }}\n"


def frames_by_dbc(name: str, folder: Path) -> str:
    pytest.importorskip("cantools")
    given = OWN.format(command=FIRST[name], reading=FIRST[name] + 1)
    (folder / f"{name}.dbc").write_text(given, encoding="utf-8")
    return f'dbc = "{name}.dbc"\n'


@pytest.fixture(params=FRAMES)
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """The rig file, both of whose axes are at one bus of python-can, of this test alone."""
    (tmp_path / "locks").mkdir()
    monkeypatch.setattr(locks, "SHARED_FOLDER", tmp_path / "locks")
    text = LIMITED
    for name in AXES:
        frames = own_frames(name) if request.param == "ids" else frames_by_dbc(name, tmp_path)
        link = (
            f'[axis.link]\nkind = "python-can"\ninterface = "virtual"\n{frames}'
            f'channel = "{tmp_path.name}"\nbitrate = 1000000\nvirtual = true\n'
        )
        mark = "[kinematics]" if name == AXES[-1] else '[[axis]]\nname = "right"'
        text = text.replace(mark, f"{link}\n{mark}", 1)
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


def until_came(exchange: dict[str, int], sent: int) -> None:
    until(lambda: exchange["to_core"] >= sent, "a pair")


@pytest.mark.long
def test_a_test_of_two_axes_on_one_bus_completes_and_no_axis_hears_the_other(file: Path) -> None:
    given = config.load_any_rig(file)
    assert isinstance(given, AxesRig)
    with ExitStack() as owned:
        theirs = owned.enter_context(opening.open_axes(given, "drive"))
        ours = owned.enter_context(opening.open_axes(given, "controller"))
        links = [loop.Link(one.kind, one.fd) for one in theirs.all]
        for link in links:
            owned.callback(link.close)
        drives = virtual_rig.drives_of(
            given, [one.codec for one in theirs.all], links, virtual_rig.RigPlan()
        )

        def tick() -> None:
            # Frames pass through threads of Python, which are given the time that they need.
            time.sleep(0.0002)
            drives.tick()
            for name, link in zip(AXES, links, strict=True):
                until_came(ours.facts[f"{name}.exchange"], link.counters()["pieces_out"])

        rec = realtime.run(setup(given), ours, clock="stepped", before_tick=tick)
    assert rec.meta["end_reason"] == "completed"
    running = rec.running()
    facts = rec.meta["real_time"]["axes"]
    for k, name in enumerate(AXES):
        own, other = (rec.axis(one)[running] for one in (name, AXES[1 - k]))
        assert facts[name]["wire"]["pairs"] > 3000
        # It goes where it is told, a few samples late, and not where the other one is told.
        left_over = [
            float(np.std(own["x_meas_m"][20:] - one["x_cmd_m"][8:-12])) for one in (own, other)
        ]
        assert left_over[0] < 0.5 * left_over[1]
    assert_replays(rec)


@pytest.mark.parametrize("file", ["dbc"], indirect=True)
def test_a_bus_without_room_for_both_is_refused_with_its_load(file: Path) -> None:
    text = file.read_text(encoding="utf-8").replace("bitrate = 1000000", "bitrate = 500000")
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"4 frames, .* load the bus to \d{3} %, and at most 80 %"):
        config.load_any_rig(file)


# ---- the program's own frames on a bus of CAN FD -------------------------------------------------


def changed(file: Path, *changes: tuple[str, str]) -> str:
    """Change the rig file; return what is then refused."""
    text = file.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        config.load_any_rig(file)
    return str(caught.value)


OWN_FRAMES = pytest.mark.parametrize("file", ["ids"], indirect=True)


@OWN_FRAMES
def test_classic_frames_of_two_axes_are_refused_with_their_load(file: Path) -> None:
    """6 frames of 135 bits, 1024 times a second, at 1 Mbit/s: 83 %."""
    said = changed(file, (FD, ""))
    assert "axis.right.link" in said
    assert "6 frames, 1024 times per second, load the bus to 83 %, and at most 80 %" in said
    assert "set fd = true" not in said.split("bit/s is enough")[0]
    assert "with fd = true and a data_bitrate" in said


@OWN_FRAMES
def test_can_fd_without_a_faster_data_phase_is_no_way_out(file: Path) -> None:
    said = changed(file, ("data_bitrate = 4000000\n", ""))
    assert "load the bus to 91 %" in said


@OWN_FRAMES
@pytest.mark.parametrize(("data_bitrate", "faster"), [(4000000, True), (8000000, False)])
def test_a_bus_of_can_fd_that_is_too_slow_is_not_told_to_become_one(
    file: Path, data_bitrate: int, faster: bool
) -> None:
    said = changed(
        file,
        ("data_bitrate = 4000000\n", f"data_bitrate = {data_bitrate}\n"),
        ("bitrate = 1000000\n", "bitrate = 1000000\nsample_rate_hz = 4096\n"),
    )
    assert "no bit rate up to 1000000 bit/s is enough" in said
    assert "give each axis a bus of its own" in said
    assert "with fd = true" not in said
    assert ("raise data_bitrate" in said) == faster


@OWN_FRAMES
@pytest.mark.parametrize("of_fd", AXES)
def test_an_axis_of_classic_can_on_a_bus_of_can_fd_is_refused_with_both_axes(
    file: Path, of_fd: str
) -> None:
    """With bit rates that agree and at a rate at which all frames would have room."""
    text = file.read_text("utf-8").replace("data_bitrate = 4000000\n", "")
    text = text.replace("bitrate = 1000000\n", "bitrate = 1000000\nsample_rate_hz = 512\n")
    at = text.index("fd = true\n", 0 if of_fd == "right" else text.index("fd = true\n") + 1)
    file.write_text(text[:at] + text[at + len("fd = true\n") :], "utf-8")
    said = changed(file)
    assert f"fd = true is given for {of_fd} and not for" in said
    assert "axes left and right share" in said


@OWN_FRAMES
def test_equal_identifiers_are_refused_with_both_axes_and_the_identifier(file: Path) -> None:
    said = changed(file, ("command = 512, displacement = 513", "command = 512, displacement = 258"))
    assert "axes left and right both use frames with the identifier 0x102" in said
    assert "link.ids" in said


@OWN_FRAMES
def test_four_axes_fit_where_the_data_phase_is_fast_enough(file: Path) -> None:
    """12 frames of 34 bits at 1 Mbit/s and 113 bits in the data phase."""
    two = config.load_any_rig(file)
    assert isinstance(two, AxesRig)
    frames = [frame for i in range(2) for frame in linkframes.frames_of_axis(two, i)] * 2
    for data_bitrate, fits in ((3_000_000, False), (4_000_000, True)):
        load = busload.bus_load(frames, 1_000_000, data_bitrate)
        assert load == pytest.approx(12 * 1024 * (34e-6 + 113 / data_bitrate))
        assert (load <= busload.MAX_SHARE) == fits


@OWN_FRAMES
def test_extra_channels_lengthen_the_force_frame_and_count(file: Path) -> None:
    left, right = (
        ", ".join(f'{{ name = "{name}_{i}", unit = "N", wire_step = 0.1 }}' for i in range(8))
        for name in AXES
    )
    text = file.read_text(encoding="utf-8")
    text = text.replace("sensors = { ", f"sensors = {{ extra = [{left}], ")
    text = text.replace('name = "right"', f'name = "right"\nsensors = {{ extra = [{right}] }}')
    file.write_text(text, encoding="utf-8")
    given = config.load_any_rig(file)
    assert isinstance(given, AxesRig)
    assert [frame.data_bytes for frame in linkframes.frames_of_axis(given, 1)] == [8, 8, 48]
    for name in AXES:
        own = given.of_axis(name)
        codec = extra_frames.codec_of(own, linkframes.codec_of_link(own.link))
        reading = wire.Reading(1e-3, 5.0, 1, 2, 0, tuple(float(i) for i in range(8)))
        sent = codec.encode_feedback(reading)
        assert [(one.id - FIRST[name], len(one.data), one.fd) for one in sent] == [
            (1, 8, True), (2, 48, True)
        ]  # fmt: skip
        assert codec.decode_feedback(sent[1])[1].extra == pytest.approx(reading.extra)
        frames = linkframes.frames_of_link(own.link, own.sensors.extra)  # type: ignore[arg-type]
        assert frames == busload.frames_of(codec)
    # 8 channels at each axis take the room of both.
    assert "6 frames" in changed(file, ("data_bitrate = 4000000", "data_bitrate = 1300000"))


@OWN_FRAMES
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("force = 514", "force = 2048", "must be a whole number from 1 to 2047"),
        ("force = 514", "force = 513", "displacement 0x201 and force 0x201; each frame needs"),
        (", force = 514", "", "axis.right.link.ids.force"),
        ("ids = {", 'dbc = "x.dbc"\nids = {', "remove ids, or dbc"),
        ('"python-can"\ninterface = "virtual"\n' + FD, '"socket"\n', "does not have this key"),
    ],
)
def test_identifiers_that_cannot_be_used_are_refused(
    file: Path, old: str, new: str, said: str
) -> None:
    assert said in changed(file, (old, new))


@OWN_FRAMES
def test_the_check_of_the_rig_shows_the_load_of_all_axes(file: Path) -> None:
    given = config.load_any_rig(file)
    shown = examined_rig.examine_rig(given, file, stiffness_stated=True)
    for table in shown.tables():
        (row,) = [row for row in table if row[0] == "Bus load"]
        assert row[1] == "38.2 %"
        assert "2 axes on this bus" in row[2]


def test_the_example_of_the_guide_loads_both_axes_to_38_percent(tmp_path: Path) -> None:
    guide = Path(__file__).parents[1] / "docs" / "several-axes.md"
    parts = guide.read_text(encoding="utf-8").split("```toml\n")
    (text,) = [part.split("```")[0] for part in parts if "frame-on-one-bus" in part]
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    given = config.load_any_rig(path)
    assert isinstance(given, AxesRig)
    frames = [frame for i in range(2) for frame in linkframes.frames_of_axis(given, i)]
    assert busload.bus_load(frames, 1_000_000, 4_000_000) == pytest.approx(0.382, abs=5e-4)


def test_the_frames_are_those_of_the_protocol_but_for_identifier_and_checksum() -> None:
    """Encoded by the table, each is what the code for `hw/rthyb.dbc` makes of the same numbers."""
    codec, usual = CODECS[1], wire.can()
    random = np.random.default_rng(5)
    for k in range(3000):
        x_m, f_n = random.normal(scale=10.0 ** random.integers(-8, 4, 2)).tolist()
        seq, state, echo, count, status = random.integers(0, 256, 5).tolist()
        if k % 50 == 0:
            x_m, f_n = random.choice([np.nan, np.inf, -np.inf, 1e300, -1e300], 2).tolist()
        if np.isfinite(x_m):
            command = wire.Setpoint(x_m, 256 * echo + seq, state % 10)
            (frame, sent_m), (own, own_m) = (c.encode_setpoint(command) for c in (codec, usual))
            assert (frame.data[:7], sent_m, frame.fd) == (own.data[:7], own_m, True)
            assert frame.data[7] == wire.crc8(bytes([frame.id & 0xFF]) + frame.data[:7])
            assert codec.decode_setpoint(frame)[1] == usual.decode_setpoint(own)[1]
        reading = wire.Reading(x_m, f_n, echo, count, status)
        for one, other in zip(
            codec.encode_feedback(reading), usual.encode_feedback(reading), strict=True
        ):
            assert one.data[:7] == other.data[:7]
            found, wanted = codec.decode_feedback(one), usual.decode_feedback(other)
            assert str(found) == str(wanted)
    assert (codec.command_id, *codec.feedback_ids) == (0x120, 0x121, 0x122)


class TableOnOneBus(Table):
    """The lab, with one bus for the sockets of both axes and for both drives."""

    codecs = CODECS
    filtered = True

    def cables(self) -> list[tuple[socket.socket, socket.socket]]:
        accepted = [
            set(side) if self.filtered else None
            for codec in CODECS
            for side in (codec.feedback_ids, (codec.command_id,))
        ]
        self.bus = Bus(self.owned, accepted)
        ends = iter(self.bus.nodes)
        return [(next(ends), next(ends)) for _ in NAMES]

    def together(self, drives: Sequence[loop.Drive]) -> Any:
        return DrivesAtBus(drives, self.bus)


BUS_ROWS = dict(ROWS)
# These two are no matter of the frames.
del BUS_ROWS["somebody else has the line of an axis"], BUS_ROWS["configuration out of range"]


def _cable_pulled(lab: TableOnOneBus, axis: int, _folder: Path) -> None:
    """One drive leaves the bus. Nobody hangs up: its readings are missing, then all stop."""
    lab.drives.drives[axis]._kept[2].close()
    assert lab.steps(20) == ["RUNNING"] * 19 + ["TRIPPED"]
    lab.steps(60)
    assert (lab.loop.state, lab.loop.cause) == ("TRIPPED", "link_lost")
    assert lab.station.cause_axis == axis
    assert {drive.phase for drive in lab.drives.drives} == {"stopped"}
    lab.assert_treated_well()


def _bus_off(lab: TableOnOneBus, _axis: int, _folder: Path) -> None:
    """The adapter is off the bus that all share: the first axis is named, and all stop."""
    lab.bus.send(CAN_FRAME.pack(BUS_OFF, 8, bytes(8)))
    lab.steps(2)
    assert [way.link.down for way in lab.ways] == ["up", "up"]
    lab.assert_tripped("link_down", 0)


BUS_ROWS["cable pulled"] = _cable_pulled  # type: ignore[assignment]
BUS_ROWS["bus-off, and the bus is back"] = _bus_off  # type: ignore[assignment]


@pytest.mark.long
@FAR_ENDS
@pytest.mark.parametrize("what", BUS_ROWS)
def test_row_of_the_fault_table_on_one_bus(what: str, axis: int, tmp_path: Path) -> None:
    with ExitStack() as owned:
        strike(TableOnOneBus, BUS_ROWS[what], axis, owned, tmp_path)


class WithoutFilters(TableOnOneBus):
    filtered = False


def test_all_frames_switch_to_the_fast_data_phase_and_belong_to_one_axis() -> None:
    with ExitStack() as owned:
        lab = WithoutFilters(owned, config_of_two()).running(50)
        assert lab.loop.state == "RUNNING"
        frames = lab.bus.frames
        assert {len(frame) for frame in frames} == {MOST_BYTES}
        assert {frame[FD_BYTE] & SWITCHED for frame in frames} == {SWITCHED}
        numbers = {int.from_bytes(frame[:4], "little") for frame in frames}
        assert numbers == {first + i for first in (0x110, 0x120) for i in range(3)}
        others = [way.wire.counters()["other_id"] for way in lab.ways]
        assert min(others) > 100  # heard, and left to whom they belong
        lab.assert_replays()
