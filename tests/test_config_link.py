"""The wire of a rig as a laboratory writes it down: link, load of the bus, calibration."""

from __future__ import annotations

import itertools
from importlib import util
from pathlib import Path
from typing import Any

import pytest
from command_line import Rthyb
from hypothesis import given
from hypothesis import strategies as st
from rthyb_rt._core import lib

from rthyb_rt import config, core
from rthyb_rt.config import busload
from rthyb_rt.config.busload import FrameSize
from rthyb_rt.core import dbc
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axis_wires

ROOT = Path(__file__).resolve().parents[1]
OWN_DBC = ROOT / "hw" / "rthyb.dbc"

RIG = """schema = "rthyb-rig/1"
[rig]
name = "spring"
elastic_stiffness_n_per_m = 666400
[actuator]
kind = "pure-delay"
delay_samples = 10
[[specimen]]
element = "stiffness"
k_n_per_m = 666400
"""
CAN = '[link]\nkind = "can"\nchannel = "can0"\n'
SERIAL = '[link]\nkind = "serial"\nchannel = "/dev/ttyUSB0"\n'
PYTHON_CAN = '[link]\nkind = "python-can"\nchannel = "PCAN_USBBUS1"\n'


def link_of(text: str) -> config.LinkTable:
    link = config.parse_rig(RIG + text).link
    assert link is not None
    return link


def refused(text: str, **overrides: str) -> dict[str, str]:
    settings = {key.replace("__", "."): value for key, value in overrides.items()}
    with pytest.raises(InputError) as caught:
        config.parse_rig(RIG + text, "rig.toml", settings)
    return {problem.where: problem.message for problem in caught.value.problems}


# ---- links that are right ------------------------------------------------------------------------


def test_rig_without_a_link_has_none() -> None:
    assert config.parse_rig(RIG).link is None


def test_can_link_of_three_lines_has_the_usual_settings() -> None:
    link = link_of(CAN)
    assert (link.bitrate, link.fd, link.dbc, link.names) == (None, False, None, {})
    assert (link.clock, link.lead_us, link.require_realtime) == ("host", 200.0, False)


def test_serial_line_without_a_baud_rate_has_921600() -> None:
    assert link_of(SERIAL).bitrate == 921600
    assert link_of(SERIAL + "bitrate = 460_800\n").bitrate == 460800
    assert "bitrate = 921600" in config.dump(config.parse_rig(RIG + SERIAL))


def test_every_kind_of_link_is_written_out_and_read_back() -> None:
    for text in (
        CAN + 'bitrate = 1_000_000\nclock = "link"\nlead_us = "0.3 ms"\nstop_decel_m_per_s2 = 2\n',
        CAN + 'fd = true\nbitrate = 500_000\ndata_bitrate = 2_000_000\ndbc = "drive.dbc"\n'
        'names = { x_cmd = "SetPos", x_meas = "DRIVE.ActPos" }\n',
        SERIAL + "require_realtime = true\n",
        '[link]\nkind = "socket"\nchannel = "/run/rig.sock"\nclock = "stepped"\n',
        PYTHON_CAN + 'interface = "pcan"\nbitrate = 1_000_000\n',
    ):
        rig = config.parse_rig(RIG + text)
        assert config.parse_rig(config.dump(rig)) == rig
    assert link_of(CAN + 'lead_us = "0.3 ms"\n').lead_us == 300


# ---- links that are wrong ------------------------------------------------------------------------


def test_key_of_another_kind_of_link_is_refused_with_the_kinds_that_have_it() -> None:
    found = refused(SERIAL + 'fd = true\ndbc = "drive.dbc"\ninterface = "pcan"\n')
    assert found == {
        "rig.toml:14: link.fd": 'kind = "serial" does not have this key, which belongs to kind = '
        '"can" and kind = "python-can"; remove it',
        "rig.toml:15: link.dbc": 'kind = "serial" does not have this key, which belongs to kind = '
        '"can" and kind = "python-can"; remove it',
        "rig.toml:16: link.interface": 'kind = "serial" does not have this key, which belongs to '
        'kind = "python-can"; remove it',
    }
    socket = '[link]\nkind = "socket"\nchannel = "/run/rig"\nbitrate = 921600\n'
    assert '"serial"; remove it' in refused(socket)["rig.toml:14: link.bitrate"]


def test_link_that_is_no_table_is_refused() -> None:
    with pytest.raises(InputError) as caught:
        config.parse_rig('link = "can0"\n' + RIG, "rig.toml")
    (problem,) = caught.value.problems
    assert problem.where == "rig.toml:1: link"
    assert problem.message == 'found "can0"; must be a table of keys and values'


def test_all_faults_of_a_link_and_a_calibration_come_at_once() -> None:
    found = refused(
        '[link]\nkind = "kan"\nchannel = ""\nlead_us = 5\nstop_decel_m_per_s2 = 0\nbaud = 921600\n'
        '[calibration]\nforce = { polarity = "reversed", scale = 0 }\nsimilitude.lenght = 2\n'
    )
    assert list(found) == [
        "rig.toml:12: link.kind",
        "rig.toml:13: link.channel",
        "rig.toml:14: link.lead_us",
        "rig.toml:15: link.stop_decel_m_per_s2",
        "rig.toml:16: link.baud",
        "rig.toml:18: calibration.force.scale",
        "rig.toml:18: calibration.force.polarity",
        "rig.toml:19: calibration.similitude.lenght",
    ]
    assert 'did you mean "can"' in found["rig.toml:12: link.kind"]
    assert "from 20 to 480 us" in found["rig.toml:14: link.lead_us"]
    assert "must be 1 or -1" in found["rig.toml:18: calibration.force.polarity"]
    assert "from 0.0001 to 10000" in found["rig.toml:18: calibration.force.scale"]
    assert 'did you mean "length"' in found["rig.toml:19: calibration.similitude.lenght"]


@pytest.mark.parametrize("polarity", ["0", "2", "true", "0.5", '"-1"'])
def test_polarity_that_is_neither_1_nor_minus_1_is_refused(polarity: str) -> None:
    found = refused(f"[calibration]\nforce.polarity = {polarity}\n")
    assert "must be 1 or -1" in found["rig.toml:12: calibration.force.polarity"]


def test_channel_of_another_kind_of_link_is_recognised() -> None:
    found = refused(CAN.replace("can0", "/dev/ttyUSB0"))
    assert 'a serial line is kind = "serial"' in found["rig.toml:13: link.channel"]
    found = refused(SERIAL.replace("/dev/", ""))
    assert 'such as "/dev/ttyUSB0"' in found["rig.toml:13: link.channel"]
    long = '[link]\nkind = "socket"\nchannel = "/tmp/' + "x" * 110 + '"\n'
    assert "at most 107" in refused(long)["rig.toml:13: link.channel"]


def test_python_can_without_its_interface_is_refused() -> None:
    assert 'such as "pcan"' in refused(PYTHON_CAN)["rig.toml:11: link.interface"]


def test_names_without_a_dbc_file_or_of_no_signal_are_refused() -> None:
    found = refused(CAN + 'names = { x_cmd = "SetPos" }\n')
    assert "dbc is missing; add dbc" in found["rig.toml:14: link.names"]
    found = refused(CAN + 'dbc = "d.dbc"\n[link.names]\nx_comd = "SetPos"\nseq = 3\n')
    assert 'did you mean "x_cmd"' in found["rig.toml:16: link.names.x_comd"]
    assert "text in quotes" in found["rig.toml:17: link.names.seq"]


def test_names_can_be_given_for_what_a_dbc_file_is_searched_for() -> None:
    assert set(config.rigfile.SIGNALS) == set(dbc.ROLES)


def test_wrong_setting_of_the_link_is_blamed_and_not_the_file() -> None:
    found = refused(CAN + "bitrate = 1_000_000\n", rig__link__bitrate="500000")
    assert list(found) == ["--set rig.link.bitrate"]
    found = refused(CAN, rig__link__kind="python-can")
    assert list(found) == ["--set rig.link.kind"]
    assert "needs the name of a python-can interface" in str(found)
    assert "channel" in str(refused("", rig__link__kind="can"))


# ---- load of the bus -----------------------------------------------------------------------------

bits = st.lists(st.integers(0, 1), min_size=1, max_size=120)


def stuff_bits(stream: list[int]) -> int:
    """Count the stuff bits of CAN: after five equal bits one of the other kind, which counts."""
    inserted, run, last = 0, 0, -1
    for bit in stream:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            inserted, last, run = inserted + 1, 1 - bit, 1
    return inserted


def worst(size: int) -> list[int]:
    """Five equal bits, then four of each kind in turn, each with a stuff bit before it."""
    return ([0] * 5 + list(itertools.chain.from_iterable([[1] * 4, [0] * 4] * size)))[:size]


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("data_bytes", range(9))
def test_longest_frame_is_the_one_that_bit_stuffing_makes(data_bytes: int, extended: bool) -> None:
    """SOF to CRC is stuffed; delimiters, ACK, end of frame and the gap of 3 bits are not."""
    # SOF, identifier, RTR (SRR, IDE, 18 bits), IDE or r1, r0, DLC, data, CRC
    size = 1 + 11 + 1 + (1 + 18 + 1 if extended else 0) + 1 + 1 + 4 + 8 * data_bytes + 15
    longest = size + stuff_bits(worst(size)) + 1 + 2 + 7 + 3
    assert busload.can_bits(FrameSize(data_bytes, extended)) == longest


@given(bits)
def test_no_bits_need_more_stuffing_than_the_worst_ones(stream: list[int]) -> None:
    assert stuff_bits(stream) <= stuff_bits(worst(len(stream))) == (len(stream) - 1) // 4


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("size", [1, 8, 12, 16, 20, 64])
def test_longest_can_fd_frame_is_the_sum_of_its_fields(size: int, extended: bool) -> None:
    head = 1 + 11 + (1 + 1 + 18 if extended else 0) + 1 + (0 if extended else 1) + 3
    stuffed = stuff_bits(worst(head + 1 + 4 + 8 * size))
    crc = 17 if size <= 16 else 21
    fixed = len(range(0, 4 + crc, 4))
    whole = head + 1 + 4 + 8 * size + stuffed + 4 + crc + fixed + 1 + 1 + 1 + 7 + 3
    arbitration, data = busload.can_fd_bits(FrameSize(size, extended, fd=True))
    assert arbitration + data == whole
    assert arbitration == head + stuff_bits(worst(head)) + 13


def test_own_frames_take_41_percent_of_1_mbit() -> None:
    assert busload.bus_load(busload.OWN_FRAMES, 1_000_000) == pytest.approx(3 * 135 * 1024e-6)


def test_slow_bus_is_refused_with_the_bit_rate_that_suffices() -> None:
    message = refused(CAN + "bitrate = 500_000\n")["rig.toml:14: link.bitrate"]
    assert "and at most 80 % is allowed" in message
    assert "load the bus to 83 %" in message
    assert message.endswith("; 800000 bit/s is enough")
    assert link_of(CAN + "bitrate = 800_000\n").bitrate == 800000
    # 3 x 135 bits x 1024 / 0.8
    assert link_of(CAN + "bitrate = 518_400\n").bitrate == 518400
    assert refused(CAN + "bitrate = 518_399\n")
    assert refused(PYTHON_CAN + 'interface = "pcan"\nbitrate = 250_000\n')


def test_bit_rate_that_no_classic_can_has_is_refused() -> None:
    found = refused(CAN + "bitrate = 5_000_000\n")
    assert "from 10000 to 1000000 bit/s" in found["rig.toml:14: link.bitrate"]


def test_115200_baud_is_refused_with_the_arithmetic() -> None:
    message = refused(SERIAL + "bitrate = 115_200\n")["rig.toml:14: link.bitrate"]
    assert message == (
        "found 115200 Bd: command (12 bytes) and feedback (16 bytes) at 1024 Hz need 286720 Bd, "
        "249 % of the line's capacity; at most 80 % is allowed, so use at least 460800 Bd"
    )
    assert (busload.COMMAND_BYTES, busload.FEEDBACK_BYTES) == (
        lib.RTHYB_SERIAL_COMMAND,
        lib.RTHYB_SERIAL_FEEDBACK,
    )


def test_data_phase_belongs_to_can_fd_and_is_no_slower() -> None:
    found = refused(CAN + "bitrate = 1_000_000\ndata_bitrate = 2_000_000\n")
    assert "set fd = true" in found["rig.toml:15: link.data_bitrate"]
    found = refused(CAN + "fd = true\nbitrate = 1_000_000\ndata_bitrate = 500_000\n")
    assert "must not be below it" in found["rig.toml:16: link.data_bitrate"]


FD_DBC = """VERSION ""
NS_ :
 BA_DEF_
 BA_
 BA_DEF_DEF_
BS_:
BU_: PC DRIVE
BO_ 257 SET: 8 PC
 SG_ x_cmd : 0|32@1- (1e-9,0) [0|0] "m" DRIVE
 SG_ seq : 32|16@1+ (1,0) [0|0] "" DRIVE
BO_ 385 ACTUAL: 64 DRIVE
 SG_ x_meas : 0|32@1- (1e-9,0) [0|0] "m" PC
 SG_ f_meas : 32|32@1- (1e-3,0) [0|0] "N" PC
 SG_ count : 64|8@1+ (1,0) [0|0] "" PC
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 385 2;
"""


def lab(tmp_path: Path, link: str, text: str = FD_DBC) -> Path:
    """A folder with a rig file and the DBC file beside it."""
    (tmp_path / "drive.dbc").write_text(text)
    path = tmp_path / "rig.toml"
    path.write_text(RIG + CAN + link)
    return path


def faults_of(path: Path, **overrides: str) -> dict[str, str]:
    with pytest.raises(InputError) as caught:
        config.load_rig(path, {key.replace("__", "."): v for key, v in overrides.items()})
    return {p.where.removeprefix(f"{path}:"): p.message for p in caught.value.problems}


def test_dbc_beside_the_rig_file_is_found_from_anywhere_and_its_frames_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = lab(tmp_path, 'dbc = "drive.dbc"\nbitrate = 1_000_000\n', OWN_DBC.read_text())
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    link = config.load_rig(path).link
    assert link is not None
    assert link.dbc == str(tmp_path / "drive.dbc")
    assert config.frames_of_link(link) == busload.OWN_FRAMES
    assert "83 %" in faults_of(path, link__bitrate="500000")["--set link.bitrate"]


def test_missing_or_unfit_dbc_is_refused_before_anything_is_opened(tmp_path: Path) -> None:
    path = lab(tmp_path, 'dbc = "driv.dbc"\n')
    assert "no such file" in faults_of(path)["14: link.dbc"]
    path = lab(tmp_path, 'dbc = "drive.dbc"\n', OWN_DBC.read_text().replace("f_meas", "Load"))
    (message,) = faults_of(path).values()
    assert "the measured force is needed" in message
    path = lab(tmp_path, 'dbc = "drive.dbc"\nnames.f_meas = "Load"\n', "")
    assert faults_of(path)


def test_long_frames_of_a_dbc_need_can_fd_and_a_fast_data_phase(tmp_path: Path) -> None:
    path = lab(tmp_path, 'dbc = "drive.dbc"\nbitrate = 1_000_000\n')
    assert "set fd = true" in faults_of(path)["11: link.fd"]
    path = lab(tmp_path, 'dbc = "drive.dbc"\nfd = true\nbitrate = 1_000_000\n')
    # 135 bits of the command and 712 of the answer, 1024 times a second
    message = faults_of(path)["16: link.bitrate"]
    assert "load the bus to 87 %, and at most 80 %" in message
    assert "shorter frames, or set data_bitrate" in message
    assert config.load_rig(path, {"rig.link.data_bitrate": "2000000"}).link


# ---- calibration ---------------------------------------------------------------------------------


def factors(text: str = "") -> core.WireCalibration:
    return axis_wires.calibration(config.parse_rig(RIG + text))


def test_rig_without_a_calibration_changes_nothing_at_all() -> None:
    assert factors() == core.IDENTITY
    assert str(factors()) == str(core.IDENTITY)  # no -0.0


def test_half_scale_specimen_with_its_load_cell_backwards() -> None:
    """The worked example of the guide."""
    c = factors(
        '[calibration]\ndisplacement = { offset_m = "-150 mm" }\nforce = { polarity = -1 }\n'
        "similitude = { length = 2, force = 4 }\n"
    )
    # The wire says 0.160 m and -3000 N: the specimen stands at 10 mm, the structure at 20 mm.
    assert c.x_gain * 0.160 + c.x_offset_m == pytest.approx(0.020, abs=1e-15)
    assert c.f_gain * -3000 + c.f_offset_n == 12000
    assert c.cmd_gain * 0.020 + c.cmd_offset_m == pytest.approx(0.160, abs=1e-15)


def test_command_goes_out_by_a_channel_of_its_own_if_it_has_one() -> None:
    c = factors(
        "[calibration]\ndisplacement.polarity = -1\n"
        'command = { scale = 0.001, offset_m = "5 mm" }\nsimilitude.length = 3\n'
    )
    assert (c.x_gain, c.x_offset_m) == (-3, 0)
    # x = 30 mm of the structure, 10 mm of the specimen, (10 - 5) mm / 0.001 on the wire
    assert c.cmd_gain * 0.030 + c.cmd_offset_m == pytest.approx(5.0)


def test_offset_that_is_kilometres_on_the_wire_is_refused() -> None:
    found = refused('[calibration]\ndisplacement = { scale = 0.001, offset_m = "5 m" }\n')
    message = found["rig.toml:12: calibration.displacement.offset_m"]
    assert "this is 5000 in the units of the frame" in message
    assert "check the unit of scale" in message


# ---- the rig that comes with the program, and what check shows of a link -------------------------


def example(name: str = "section5-T0.5.toml") -> Path:
    return config.builtin_test_path().with_name(name)


def test_shipped_can_rig_is_the_shaking_table_with_a_link_and_limits() -> None:
    on_can = config.load_rig(config.shipped_rig("shaking-table-can"))
    plain = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    assert on_can.link is not None
    assert (on_can.link.kind, on_can.link.bitrate, on_can.link.clock) == ("can", 10**6, "link")
    assert (on_can.actuator, on_can.specimen, on_can.sensors) == (
        plain.actuator,
        plain.specimen,
        plain.sensors,
    )
    assert plain.link is None
    assert plain.limits == config.Limits()


def test_check_shows_link_load_clock_and_calibration(rthyb: Rthyb) -> None:
    answer = rthyb("check", example(), "--rig", "shaking-table-can")
    assert answer.code == 0
    lines = {line.split("  ")[0]: " ".join(line.split()) for line in answer.out.splitlines()}
    assert lines["Link"].startswith("Link can0, CAN, 1000000 bit/s")
    assert lines["Bus load"].startswith("Bus load 41.5 %")
    assert lines["Clock"].startswith("Clock link, feedback 200 us before the tick")
    assert "Displacement" not in lines
    assert "watched in real time alone" not in answer.out
    backwards = ("--set", "rig.calibration.force.polarity=-1")
    answer = rthyb("check", example(), "--rig", "shaking-table-can", *backwards)
    assert "Force                -1 × wire" in answer.out


def test_check_says_what_it_cannot_know_of_a_bus(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG + CAN)
    (row,) = (
        line
        for line in rthyb("check", example(), "--rig", "rig.toml").out.splitlines()
        if "Bus load  not known" in line
    )
    assert "bitrate is missing" in row
    (tmp_path / "rig.toml").write_text(RIG + SERIAL)
    answer = rthyb("check", example(), "--rig", "rig.toml")
    assert "/dev/ttyUSB0, serial, 921600 baud" in answer.out
    assert "Bus load  31.1 %" in answer.out
    assert "Note: nothing ends a test whose displacement sensor freezes or jumps" in answer.out


def test_check_warns_of_a_dbc_that_nobody_could_read(
    rthyb: Rthyb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = lab(tmp_path, 'dbc = "drive.dbc"\nbitrate = 1_000_000\n', "this is no DBC file")
    assert rthyb("check", example(), "--rig", path).code == 3
    monkeypatch.setattr(util, "find_spec", lambda name: None)
    answer = rthyb("check", example(), "--rig", path)
    assert "Bus load  not known" in answer.out
    assert "Warning: link.dbc was not read" in answer.out
    assert "a test in real time will be refused" in answer.out
    assert "pip install 'rthyb-rt[wire]'" in answer.out


def test_check_in_json_has_the_link(rthyb: Rthyb) -> None:
    document: dict[str, Any] = rthyb(
        "check", example(), "--rig", "shaking-table-can", "--json"
    ).json
    assert document["link"]["channel"] == "can0"
    assert document["link"]["bus_load"] == pytest.approx(0.41472)
    assert document["calibration"]["x_gain"] == 1
    assert rthyb("check", example(), "--json").json["link"] is None


def test_calibration_of_the_guide_is_what_check_prints(rthyb: Rthyb, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "own-specimen.md").read_text(encoding="utf-8")
    section = page.split("## Sensors and scale of a real rig")[1].split("\n## ")[0]
    (tmp_path / "rig.toml").write_text(section.split("```toml\n")[1].split("```")[0])
    answer = rthyb("check", example(), "--rig", "rig.toml", "--set", "limits={}")
    assert answer.code == 0
    printed = [" ".join(line.split()) for line in answer.out.splitlines()]
    for line in section.split("```text\n")[1].split("```")[0].splitlines():
        assert any(row.startswith(" ".join(line.split())) for row in printed), line
