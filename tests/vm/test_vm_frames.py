"""What is on the bus, as tools see it that know nothing of rthyb: candump and cantools."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from can_dump import candump, decoded
from loop_bench import STATE, Bench, assert_adds_up, assert_drive_was_treated_well

from rthyb_rt.core import dbc, wire

ROOT = Path(__file__).parents[2]

FD_DRIVE = """\
VERSION ""
BU_: PC
BO_ 2566848768 SetValues: 12 PC
 SG_ Enable : 0|8@1+ (1,0) [0|3] "" PC
 SG_ Setpoint : 15|32@0- (0.001,0) [-50000|50000] "um" PC
 SG_ Alive : 64|16@1+ (1,0) [0|65535] "" PC
 SG_ Mode : 80|8@1+ (1,0) [0|255] "" PC
BO_ 768 ActualValues: 48 PC
 SG_ Position : 64|32@1- (0.001,0) [-60000|60000] "um" PC
 SG_ Load : 263|64@0- (1,0) [0|0] "N" PC
 SG_ Count : 344|16@1+ (1,0) [0|65535] "" PC
 SG_ Applied : 360|16@1+ (1,0) [0|65535] "" PC
BA_DEF_ SG_ "GenSigStartValue" INT 0 255;
BA_DEF_DEF_ "GenSigStartValue" 0;
BA_ "GenSigStartValue" SG_ 2566848768 Enable 3;
SIG_VALTYPE_ 768 Load : 2;
"""
FD_NAMES = {
    "x_cmd": "Setpoint",
    "seq": "Alive",
    "state": "Mode",
    "x_meas": "Position",
    "f_meas": "Load",
    "count": "Count",
    "echo": "Applied",
}


def test_candump_and_cantools_see_the_numbers_of_the_record(tmp_path: Path) -> None:
    name = os.environ["RTHYB_VCAN"]
    with candump(name, tmp_path) as dump, Bench("vcan", interfaces=(name, name)) as bench:
        bench.running(700)
        frames = dump.frames()
        rows, log, tare_m = bench.rows(), bench.drive.log, bench.station.tare[0]
        assert len(frames) == 3 * rows.size
        assert not any(is_fd for _, _, is_fd in frames)
        file = ROOT / "hw" / "rthyb.dbc"
        command, actuator, load_cell = (
            decoded(frames, file, name) for name in ("ACT_CMD", "ACT_FB", "LC_FB")
        )
        np.testing.assert_array_equal(command["seq"], np.arange(rows.size) + 1)
        np.testing.assert_array_equal(command["state"][:-1], log["state"][1:])
        np.testing.assert_array_equal(actuator["x_meas"], np.rint(1e9 * rows["x_read_m"]))
        np.testing.assert_array_equal(load_cell["f_meas"], np.rint(1e3 * rows["f_read_n"]))
        for reading in (actuator, load_cell):
            np.testing.assert_array_equal(reading["count"], rows["count"])
            np.testing.assert_array_equal(reading["echo"], rows["echo"])
        # The row of a tick has the command that the reading of this tick answers; before the tare
        # is known it is counted from elsewhere.
        begin = int(np.flatnonzero(rows["state"] == STATE["ARMED"])[0])
        told_m = 1e-9 * command["x_cmd"][:-1]
        np.testing.assert_allclose(told_m, log["x_m"][1:], rtol=1e-15)
        in_test_m = told_m[begin - 1 :] - tare_m
        np.testing.assert_allclose(in_test_m, rows["x_cmd_m"][begin:], atol=1e-15)
        assert np.ptp(in_test_m) > 1e-3


def test_drive_of_another_make_is_tested_over_can_fd(tmp_path: Path) -> None:
    file = tmp_path / "drive.dbc"
    file.write_text(FD_DRIVE, encoding="ascii")
    codec = dbc.load(file, FD_NAMES)
    assert codec.is_fd
    name = os.environ["RTHYB_VCAN_FD"]
    with (
        candump(name, tmp_path) as dump,
        Bench("vcan", codec=codec, interfaces=(name, name)) as bench,
    ):
        bench.running(0)
        bench.until("RAMP_OUT")
        assert bench.loop.cause == "completed"
        bench.until("IDLE")
        frames = dump.frames()
        rows, log = bench.rows(), bench.drive.log
        assert len(frames) == 2 * rows.size
        assert all(is_fd for _, _, is_fd in frames)
        assert {(can_id, len(data)) for can_id, data, _ in frames} == {
            (codec.command_id & ~wire.ID_EXTENDED, 12),
            (0x300, 48),
        }
        command, actual = (decoded(frames, file, n) for n in ("SetValues", "ActualValues"))
        assert set(command["Enable"]) == {3}
        np.testing.assert_array_equal(command["Mode"][:-1], log["state"][1:])
        np.testing.assert_allclose(1e-9 * command["Setpoint"][:-1], log["x_m"][1:], rtol=1e-15)
        np.testing.assert_array_equal(actual["Position"], np.rint(1e9 * rows["x_read_m"]))
        np.testing.assert_array_equal(actual["Load"], rows["f_read_n"])
        np.testing.assert_array_equal(actual["Count"], np.arange(rows.size))
        assert bench.loop.link_delay == 0
        assert bench.wire.counters()["pairs"] == rows.size
        assert_adds_up(bench)
        assert_drive_was_treated_well(bench)
