"""Channels beside displacement and force: from wire or virtual sensor into every recording."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from rthyb_rt._core import ffi, lib

import rthyb_rt as rt
from rthyb_rt import cli, config, core
from rthyb_rt.core import CoreError, dbc, wire
from rthyb_rt.diagnose import mapping, reading
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, extra_frames, realtime, virtual_time
from rthyb_rt.live.sources import LiveSource, PastSource
from rthyb_rt.record import mat_csv, recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import render
from rthyb_rt.rig import identification, virtual_rig
from rthyb_rt.rig.links import opening

SHORT = {"ground_motion.duration_s": "3", "test.free_vibration_s": "0.5"}
TABLE = config.shipped_rig("shaking-table-portal-frame").read_text()
EXTRA = """
[[sensors.extra]]
name = "table_acceleration"
unit = "m/s^2"
measures = "acceleration"
noise_std = 0.01

[[sensors.extra]]
name = "lvdt_2"
unit = "mm"
measures = "displacement"
gain = 1000
lsb = 0.001
scale = 2
offset = 0.5
"""
DBC = """VERSION ""
BU_: C D
BO_ 257 CMD: 8 C
 SG_ x_cmd : 0|32@1- (1E-009,0) [0|0] "m" D
 SG_ seq : 32|16@1+ (1,0) [0|0] "" D
 SG_ state : 48|8@1+ (1,0) [0|0] "" D
BO_ 385 FB: 16 D
 SG_ x_meas : 0|32@1- (1E-009,0) [0|0] "m" C
 SG_ echo : 32|8@1+ (1,0) [0|0] "" C
 SG_ count : 40|8@1+ (1,0) [0|0] "" C
 SG_ status : 48|8@1+ (1,0) [0|0] "" C
 SG_ Accel : 64|16@1- (0.01,0) [-300|300] "m/s^2" C
 SG_ Both : 96|16@1- (0.01,0) [0|0] "" C
BO_ 386 LC: 16 D
 SG_ f_meas : 0|32@1- (0.001,0) [0|0] "N" C
 SG_ count : 40|8@1+ (1,0) [0|0] "" C
 SG_ Strain : 64|32@1- (1,0) [0|0] "" C
 SG_ Both : 96|16@1- (0.01,0) [0|0] "" C
"""


def rig_of(more: str = EXTRA) -> Any:
    return config.parse_rig(TABLE + more)


def test_file() -> Any:
    return config.load_test(config.builtin_test_path(), SHORT)


test_file.__test__ = False  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def virtual() -> RecordedTest:
    return virtual_time.run(experiment.prepare(test_file(), rig_of()))


# ---- virtual sensors ----------------------------------------------------------------------------


def test_virtual_sensors_read_what_they_measure_in_their_unit(virtual: RecordedTest) -> None:
    assert [(c.name, c.unit) for c in virtual.channels] == [
        ("table_acceleration", "m/s^2"), ("lvdt_2", "mm"),
    ]  # fmt: skip
    rig = core.VirtualRig(experiment.rig_config(rig_of()))
    commands = virtual.samples["x_cmd_m"]
    plain = core.VirtualRig(experiment.rig_config(rig_of("")))
    x, _, a = plain.motion(commands).__iter__()
    got = []
    for command in commands.tolist():
        rig.step(command)
        got.append(rig.extras)
    found = np.array(got)
    assert np.abs(found[:, 1] - 1000 * x).max() <= 0.0005 + 1e-9
    assert np.std(found[:, 0] - a) == pytest.approx(0.01, rel=0.05)


def test_the_other_sensors_have_the_same_noise_with_and_without_extra_ones(
    virtual: RecordedTest,
) -> None:
    plain = virtual_time.run(experiment.prepare(test_file(), rig_of("")))
    for name in plain.samples.dtype.names or ():
        assert np.array_equal(plain.samples[name], virtual.samples[name], equal_nan=True), name


def test_truth_and_extra_channels_stand_side_by_side(virtual: RecordedTest) -> None:
    rec = virtual_time.run(experiment.prepare(test_file(), rig_of()), truth=True)
    assert [c.name for c in rec.channels] == [
        "x_true_m",
        "f_true_n",
        "table_acceleration",
        "lvdt_2",
    ]
    # The rig is read before the tick: both are of the same instant.
    assert np.abs(rec.channel("lvdt_2") - 1e3 * rec.channel("x_true_m")).max() <= 0.000501
    assert np.array_equal(rec.channel("lvdt_2"), virtual.channel("lvdt_2"))


def test_bad_sensors_are_refused_by_the_core() -> None:
    base = experiment.rig_config(rig_of(""))
    for bad in (math.nan, math.inf, 1e300):
        for sensor in (
            core.ExtraSensorConfig("force", bad),
            core.ExtraSensorConfig("force", 1.0, core.SensorConfig(bad)),
        ):
            with pytest.raises(CoreError):
                core.VirtualRig(dataclasses.replace(base, extras=(sensor,)))
    with pytest.raises(CoreError, match="at most 8"):
        core.VirtualRig(dataclasses.replace(base, extras=(core.ExtraSensorConfig(),) * 9))


# ---- on the wire --------------------------------------------------------------------------------

READING = wire.Reading(0.012, -345.0, 7, 9, 0, (1.234567, -0.25))
TWO = (wire.Extra(), wire.Extra(scale=2.0, offset=0.5, step=0.125))


def test_a_serial_packet_is_longer_by_four_bytes_a_channel() -> None:
    codec = wire.serial().with_extras(TWO)
    (frame,) = codec.encode_feedback(READING)
    (plain,) = wire.serial().encode_feedback(READING)
    assert len(frame.data) == len(plain.data) + 8
    ((verdict, packet),) = wire.Deframer(extras=2).feed(frame.data)
    assert wire.verdict_names(verdict) == ["packet"]
    assert packet.data[:12] == next(iter(wire.Deframer().feed(plain.data)))[1].data
    # 1.234567 in steps of 1e-6; -0.25 is wire -0.375, three steps of 0.125.
    assert packet.data[12:20] == (1234567).to_bytes(4, "little") + (-3).to_bytes(
        4, "little", signed=True
    )
    verdict, reading = codec.decode_feedback(packet)
    assert verdict == 0
    assert reading == READING
    # Whoever knows of no extra channels refuses it, and the other way round.
    assert wire.verdict_names(wire.serial().decode_feedback(packet)[0]) == ["length"]


def test_own_frames_have_room_on_a_link_without_a_bus() -> None:
    codec = wire.can().with_extras(TWO)
    x, f = codec.encode_feedback(READING)
    old = wire.can().encode_feedback(READING)
    assert x == old[0]
    assert f.data[:7] == old[1].data[:7]
    assert (len(f.data), f.fd) == (16, True)
    assert codec.decode_feedback(f)[1].extra == READING.extra
    assert codec.encode_setpoint(wire.Setpoint(0.01, 5, 4)) == wire.can().encode_setpoint(
        wire.Setpoint(0.01, 5, 4)
    )


def test_what_is_no_number_is_nan_and_refuses_nothing() -> None:
    for codec in (wire.serial().with_extras(TWO), wire.can().with_extras(TWO)):
        received = wire.Wire(codec)
        for value in (math.nan, math.inf, 1e300):
            reading = wire.Reading(
                0.012, -345.0, 7, int(received.struct.samples) + 10, 0, (value, 3)
            )
            for frame in codec.encode_feedback(reading):
                received.feed(frame.data) if codec.is_serial else received.receive(frame)
            assert received.take().lost == 0
            channels = ffi.new("double[32]")
            lib.rthyb_wire_record_extras(received.struct, channels)
            # 1e300 is held to the end of its 32 bits.
            assert math.isnan(channels[0]) or channels[0] == pytest.approx(2147.483647)
            assert channels[1] == 3.0


def test_without_a_new_pair_an_extra_channel_has_no_number() -> None:
    codec = wire.serial().with_extras(TWO)
    received, channels = wire.Wire(codec), ffi.new("double[32]")
    received.struct.extra_channel = 5
    lib.rthyb_wire_record_extras(received.struct, channels)
    assert math.isnan(channels[5])
    received.feed(codec.encode_feedback(READING)[0].data)
    received.take()
    lib.rthyb_wire_record_extras(received.struct, channels)
    assert list(channels[5:7]) == pytest.approx(list(READING.extra))
    received.take()
    lib.rthyb_wire_record_extras(received.struct, channels)
    assert math.isnan(channels[5])
    assert math.isnan(channels[6])
    # An index that is none writes nothing.
    received.struct.extra_channel = 4_000_000_000
    lib.rthyb_wire_record_extras(received.struct, channels)


def test_a_recording_of_before_has_a_table_without_them() -> None:
    old = wire.serial().table[: ffi.offsetof("rthyb_codec", "extra_count")]
    assert wire.Codec.of(old).is_serial
    with pytest.raises(CoreError):
        wire.Codec.of(old[:-1])


def test_tables_that_do_not_fit_are_refused() -> None:
    codec = wire.serial().with_extras(TWO)
    for field, value in (("start", 8), ("start", 8 * 17), ("length", 0), ("length", 64)):
        table = ffi.new("rthyb_codec *")
        ffi.memmove(table, codec.struct, ffi.sizeof(table[0]))
        setattr(table.extra[0].signal, field, value)
        assert lib.rthyb_codec_check(table), (field, value)
    table = ffi.new("rthyb_codec *")
    ffi.memmove(table, codec.struct, ffi.sizeof(table[0]))
    table.extra_count = 9
    assert lib.rthyb_codec_check(table)
    table.extra_count, table.format = 1, lib.RTHYB_WIRE_CAN
    assert lib.rthyb_codec_check(table)


# ---- a DBC file ---------------------------------------------------------------------------------


@pytest.fixture
def dbc_rig(tmp_path: Path) -> Any:
    pytest.importorskip("cantools")
    (tmp_path / "drive.dbc").write_text(DBC)

    def made(signal: str) -> Any:
        return config.parse_rig(
            f'{TABLE}[[sensors.extra]]\nname = "a"\nunit = "g"\nscale = 0.5\noffset = 1\n'
            f'signal = "{signal}"\nmeasures = "acceleration"\n'
            f'[link]\nkind = "can"\nchannel = "can0"\nfd = true\ndbc = "{tmp_path / "drive.dbc"}"\n'
        )

    return made


@pytest.mark.parametrize(("signal", "which", "step"), [("Accel", 0, 0.005), ("LC.Strain", 1, 0.5)])
def test_a_signal_of_a_dbc_file_is_read_with_its_factor_and_the_rigs(
    dbc_rig: Any, signal: str, which: int, step: float
) -> None:
    rig = dbc_rig(signal)
    codec = extra_frames.codec_of(rig, dbc.load(rig.link.dbc))
    frames = codec.encode_feedback(wire.Reading(0.01, 5.0, 1, 2, 0, (3.0,)))
    found = codec.decode_feedback(frames[which])[1].extra
    assert found[0] == pytest.approx(3.0, abs=step)
    assert math.isnan(codec.decode_feedback(frames[1 - which])[1].extra[0])
    # value = scale * (factor * raw) + offset
    raw = round((3.0 - 1.0) / step)
    assert int.from_bytes(frames[which].data[8:10], "little", signed=True) == raw


@pytest.mark.parametrize(
    ("signal", "says"),
    [("Nothing", "no signal of this name"), ("Both", "is in both feedback frames"),
     ("CMD.x_cmd", "no signal of this name")],
)  # fmt: skip
def test_a_signal_that_is_not_there_is_told_with_its_place(
    dbc_rig: Any, signal: str, says: str
) -> None:
    rig = dbc_rig(signal)
    with pytest.raises(InputError) as error:
        extra_frames.codec_of(rig, dbc.load(rig.link.dbc))
    assert says in str(error.value)
    assert "sensors.extra.0.signal" in str(error.value)


# ---- files --------------------------------------------------------------------------------------

ACCELEROMETER = '[[sensors.extra]]\nname = "a"\nunit = "g"\nmeasures = "acceleration"\n'


def test_an_accelerometer_in_g_reads_in_g() -> None:
    rig = rig_of("\n" + ACCELEROMETER)
    assert rig.sensors.extra[0].gain == pytest.approx(1 / 9.80665, rel=1e-12)
    again = config.parse_rig(config.dump(rig), "rig")
    assert again == rig
    # A sensor that reads two per cent too much is one, not another unit; so is one turned round.
    for gain in (1.02 / 9.80665, -1 / 9.80665):
        assert rig_of(f"\n{ACCELEROMETER}gain = {gain}\n").sensors.extra[0].gain == gain
    both = EXTRA.replace("measures", "gain = 1\nmeasures", 1) + ACCELEROMETER
    short = {key: float(value) for key, value in SHORT.items()}
    rec = rt.run(rt.Test("section5-T0.5", rig=rt.Rig.from_toml(TABLE + both)).with_(short))
    moved = np.std(rec["table_acceleration"])
    assert np.std(rec["a"]) == pytest.approx(moved / 9.80665, rel=0.01)
    assert rec.units["a"] == "g"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[[sensors.extra]]\nname = "A"\nunit = "g"', "up to 32 characters of a-z 0-9 _"),
        ('[[sensors.extra]]\nname = "a"', "sensors.extra.0.unit: missing"),
        ('[[sensors.extra]]\nname = "a"\nunit = "g"\nmeasures = "speed"', "must be one of"),
        (
            ACCELEROMETER + "gain = 1\n",
            "found 1, with which the virtual sensor reads m/s^2, but",
        ),
        (
            ACCELEROMETER + "gain = 0\n",
            "gain: found 0, with which the virtual sensor always reads 0",
        ),
        (ACCELEROMETER.replace('"g"', '"mm"'), "gain: missing; the virtual sensor measures acc"),
        (ACCELEROMETER.replace('"g"', '"V"'), "give its reading in V for 1 m/s^2"),
        ('[[sensors.extra]]\nname = "a"\nunit = "g"\n' * 2, 'found the name "a" twice'),
        (
            EXTRA + '[link]\nkind = "serial"\nchannel = "/dev/ttyUSB0"\nbitrate = 400000\n',
            "feedback (24 bytes)",
        ),
        (
            '[[sensors.extra]]\nname = "a"\nunit = "g"\nsignal = "Tilt"\n'
            '[link]\nkind = "serial"\nchannel = "/dev/ttyUSB0"\nbitrate = 2000000\n',
            'extra channel a: found signal = "Tilt", which names a signal in a DBC file',
        ),
        (EXTRA + '[link]\nkind = "can"\nchannel = "can0"\n', "the frames of hw/rthyb.dbc are full"),
    ],
)
def test_what_a_channel_cannot_be_is_told_with_its_key(text: str, says: str) -> None:
    with pytest.raises(InputError) as error:
        rig_of("\n" + text)
    assert says in str(error.value)


@pytest.mark.parametrize("name", ["x_meas_m", "x_true_m"])
def test_a_name_that_recordings_have_already_is_refused(name: str) -> None:
    rig = rig_of(f'\n[[sensors.extra]]\nname = "{name}"\nunit = "m"\n')
    with pytest.raises(InputError, match=f'found "{name}", but a recording of this test already'):
        experiment.prepare(test_file(), rig)


def test_the_name_of_a_value_of_the_control_law_is_refused() -> None:
    test = config.load_test(config.builtin_test_path(), {**SHORT, "controller.type": "ats"})
    law = experiment.prepare(test, rig_of("")).channels[0].name
    rig = rig_of(f'\n[[sensors.extra]]\nname = "{law}"\nunit = "1"\n')
    with pytest.raises(InputError, match=f'found "{law}", but a recording of this test already'):
        experiment.prepare(test, rig)


def test_no_extra_channel_replaces_time_or_reference(virtual: RecordedTest, tmp_path: Path) -> None:
    mat_csv.to_mat(virtual, tmp_path / "one.mat")
    own = {name for name, _, _ in scipy.io.whosmat(tmp_path / "one.mat")}
    beside = own - set(virtual.samples.dtype.names or ()) - {"ag_mps2"}
    beside |= set(rt.Recording(virtual).units) - set(virtual.samples.dtype.names or ())
    assert beside >= {"x_ref_m", "v_ref_mps", "f_ref_n", "t_s", "fs_hz", "meta"}
    for name in beside:
        text = f'{TABLE}\n[[sensors.extra]]\nname = "{name}"\nunit = "m"\n'
        says = rf'mine.toml:{text.count(chr(10)) - 1}: .*found "{name}", but exported files have'
        with pytest.raises(InputError, match=says):
            experiment.prepare(test_file(), config.parse_rig(text, "mine.toml"))


def test_a_rig_with_extra_channels_reads_back() -> None:
    rig = rig_of()
    assert config.parse_rig(config.dump(rig)) == rig


# ---- the whole way ------------------------------------------------------------------------------


def test_a_test_in_real_time_records_what_comes_over_the_link() -> None:
    rig = rig_of()
    setup = experiment.prepare(test_file(), rig, real_time=True)
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(rig, theirs) as drive:
        rec = realtime.run(setup, ours, clock="stepped", before_tick=drive.tick)
    assert rec.meta["end_reason"] == "completed"
    x = rec.samples["x_read_m"] * 1e3
    both = np.isfinite(rec.channel("lvdt_2"))
    assert both.mean() > 0.99
    # Noise of 2 um and steps of 0.5 um of the one, steps of 1 um of the other.
    assert np.abs(rec.channel("lvdt_2") - x)[both].max() < 0.015
    assert realtime.replay(rec).identical


def test_lost_pairs_leave_no_number_in_extra_channels() -> None:
    rig = rig_of()
    setup = experiment.prepare(test_file(), rig, real_time=True)
    (mishap,) = virtual_rig.parse_mishaps(["drop:p=0.05,from=0,to=3"])
    rec = virtual_rig.run_faulty(setup, (mishap,))
    lost = (rec.samples["flags"] & core.FLAGS["fresh"]) == 0
    assert 20 < lost.sum() < 400
    assert np.isnan(rec.channel("lvdt_2")[lost]).all()
    assert np.isfinite(rec.channel("lvdt_2")[~lost]).all()


def test_recordings_and_exports_have_them_with_their_units(
    virtual: RecordedTest, tmp_path: Path
) -> None:
    recording.write(tmp_path / "r.h5", virtual)
    again = recording.read(tmp_path / "r.h5")
    assert again.channels == virtual.channels
    mat_csv.to_csv(again, tmp_path / "r.csv", full=True)
    head = (tmp_path / "r.csv").read_text().splitlines()[0]
    assert "lvdt_2" in head


def test_an_export_without_them_says_so(
    virtual: RecordedTest, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rec = rt.Recording(virtual)
    with pytest.warns(UserWarning, match=r"extra channels table_acceleration, lvdt_2.*whole=True"):
        rec.export(tmp_path / "r.csv")
    rec.export(tmp_path / "whole.csv", whole=True)  # a warning would be an error
    rec.save(tmp_path / "r.h5")
    assert cli.main(["export", str(tmp_path / "r.h5"), "--csv"]) == 0
    assert "no columns for the extra channels table_acceleration, lvdt_2" in capsys.readouterr().err
    assert cli.main(["export", str(tmp_path / "r.h5"), "--csv", "--full"]) == 0
    assert "no columns" not in capsys.readouterr().err


def test_an_identification_records_them_too() -> None:
    setup = experiment.prescribed(rig_of(), "identify", np.zeros(64))
    assert [c.name for c in setup.channels] == ["table_acceleration", "lvdt_2"]
    found = identification.identify(rig_of(), identification.SweepPlan((1.0, 2.0, 4.0)))
    assert found.alpha == pytest.approx(17, rel=0.05)


@pytest.mark.long
def test_the_report_shows_them_with_their_units(virtual: RecordedTest) -> None:
    page = render(virtual)
    assert "Extra channel table_acceleration" in page
    assert "lvdt_2, mm" in page


def test_a_diagnosis_may_read_a_second_displacement_sensor(
    virtual: RecordedTest, tmp_path: Path
) -> None:
    recording.write(tmp_path / "recording.h5", virtual)
    (tmp_path / "rig.toml").write_text(virtual.rig_toml)
    model = reading.read_model(tmp_path / "rig.toml")
    wishes = mapping.read_wishes(["x_meas=lvdt_2"])
    case = reading.read_case(tmp_path / "recording.h5", model, wishes=wishes)
    own = reading.read_case(tmp_path / "recording.h5", model)
    # Steps of 1 um of the one, noise of 2 um of the other, and both begin at zero.
    apart = case.channels["x_meas"] - own.channels["x_meas"]
    assert np.abs(apart).max() < 15e-6
    assert abs(np.mean(apart)) < 1e-6
    assert any("lvdt_2" in note for note in case.notes)


@pytest.mark.parametrize(
    ("wish", "says"),
    [("x_meas=lvdt_3", "its extra channels: table_acceleration, lvdt_2"),
     ("x_cmd=lvdt_2", "only x_meas, f_meas, ag can be replaced"),
     ("x_meas=table_acceleration", "needs a unit of the same kind as m")],
)  # fmt: skip
def test_what_a_diagnosis_cannot_read_is_told(
    virtual: RecordedTest, tmp_path: Path, wish: str, says: str
) -> None:
    recording.write(tmp_path / "recording.h5", virtual)
    (tmp_path / "rig.toml").write_text(virtual.rig_toml)
    model = reading.read_model(tmp_path / "rig.toml")
    with pytest.raises(InputError) as error:
        reading.read_case(tmp_path / "recording.h5", model, wishes=mapping.read_wishes([wish]))
    assert says in str(error.value)


def test_the_live_view_tells_the_newest_reading_of_each(virtual: RecordedTest) -> None:
    told = PastSource(virtual).status()
    found = {one["label"]: one["value"] for one in told["counters"]}
    assert found["lvdt_2"].endswith(" mm")
    assert float(found["lvdt_2"].split()[0].replace("\u2212", "-")) == pytest.approx(
        virtual.channel("lvdt_2")[-1], rel=1e-3, abs=1e-3
    )


def test_the_live_view_of_a_running_test_tells_them_too(tmp_path: Path) -> None:
    seen: list[dict[str, str]] = []
    setup = experiment.prepare(test_file(), rig_of(), real_time=True)
    ours, theirs = opening.socket_pair()

    def look(session: Any) -> None:
        source = LiveSource(session.run.ring.path, None)
        source.poll()
        source.look()
        seen.append({one["label"]: one["value"] for one in source.status()["counters"]})
        source.close()

    with ours, theirs, virtual_rig.in_step(rig_of(), theirs) as drive:
        realtime.run(setup, ours, clock="stepped", before_tick=drive.tick, zeroed=look)
    assert seen[0]["table_acceleration"].endswith(" m/s^2")
