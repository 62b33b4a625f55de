"""Channels beside displacement and force on a rig of several axes: each axis has its own."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from test_axes_files import OWN
from test_axes_realtime import AXES, LIMITED, SHORT, assert_replays
from test_axes_realtime import rig as pair_of
from test_axes_realtime import setup as real_setup

import rthyb_rt as rt
from rthyb_rt import config, core, numbers
from rthyb_rt.config import AxesRig
from rthyb_rt.core import CoreError, dbc, loop, wire
from rthyb_rt.core.coupled_rig import CoupledRig, StateSpace
from rthyb_rt.diagnose import mapping, reading
from rthyb_rt.diagnose.axes import OfAxis
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, axes_rig, experiment, extra_frames, realtime, virtual_time
from rthyb_rt.live.sources import LiveSource, PastSource
from rthyb_rt.record import mat_csv, recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.report import render
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening

LEFT = """
[[axis.sensors.extra]]
name = "left_lvdt"
unit = "mm"
measures = "displacement"
gain = 1000
lsb = 0.001
[[axis.sensors.extra]]
name = "left_acceleration"
unit = "m/s^2"
measures = "acceleration"
"""
RIGHT = """
[[axis.sensors.extra]]
name = "right_strain"
unit = "um/m"
measures = "force"
gain = 0.01
noise_std = 0.5
scale = 2
offset = 3
"""


# TOML does not let a table that is written in one line be continued below it.
QUIET = LIMITED.replace("sensors = { displacement = { noise_std_m = 2e-6 } }\n", "", 1)


def with_extras(left: str = LEFT, right: str = RIGHT) -> str:
    text = QUIET.replace('[[axis]]\nname = "right"', f'{left}[[axis]]\nname = "right"', 1)
    return text.replace("[kinematics]", f"{right}[kinematics]", 1)


def rig(**changed: str) -> AxesRig:
    return pair_of(with_extras(**changed))


def virtually(given: AxesRig, **what: bool) -> RecordedTest:
    return virtual_time.run(
        axes_experiment.prepare(config.parse_test(SHORT, "test.toml"), given), **what
    )


@pytest.fixture(scope="module")
def rec() -> RecordedTest:
    return virtually(rig())


# ---- virtual sensors -----------------------------------------------------------------------------


def test_each_axis_has_the_channels_of_its_own_sensors(rec: RecordedTest) -> None:
    names = {axis: [(c.name, c.unit) for c in own] for axis, own in rec.extras_by_axis().items()}
    assert names == {
        "left": [("left_lvdt", "mm"), ("left_acceleration", "m/s^2")],
        "right": [("right_strain", "um/m")],
    }
    assert [one.name for one in rec.extras()] == ["left_lvdt", "left_acceleration", "right_strain"]


def test_they_measure_the_motion_and_the_force_of_their_axis() -> None:
    rec = virtually(rig(), truth=True)
    # The rig is read before the tick: both are of the same instant. Steps of 1 um.
    apart = rec.channel("left_lvdt") - 1e3 * rec.channel("x_true_m")
    assert np.abs(apart).max() <= 0.000501
    strain = rec.channel("right_strain") - 0.01 * rec.channel("f_true_n_1")
    assert np.std(strain) == pytest.approx(0.5, rel=0.05)
    assert np.std(rec.channel("f_true_n_1")) > 1000.0
    # x'' = w^2 (u - x) - 2 zeta w x', with the command u that was held up to this instant.
    x, omega = rec.channel("x_true_m"), 2 * np.pi * 20
    u = np.roll(rec.axis("left")["x_cmd_m"], 1)
    expected = omega**2 * (u - x) - 2 * 0.7 * omega * np.gradient(x, 1 / 1024)
    own, inside = rec.channel("left_acceleration"), np.flatnonzero(rec.running())[50:-50]
    assert np.std((own - expected)[inside]) < 0.02 * np.std(own[inside])


def test_the_other_sensors_have_the_same_noise_with_and_without_extra_ones() -> None:
    noise = 'sensors = { force = { noise_std_n = 5 } }\nlimits = { command_position_m = "20 mm" }'
    text = with_extras().replace('limits = { command_position_m = "20 mm" }', noise)
    rec = virtually(pair_of(text.replace(RIGHT, "")))
    plain = virtually(pair_of(text.replace(RIGHT, "").replace(LEFT, ""))).samples
    assert len(rec.extras()) == 2
    assert np.std(plain["f_meas_n.1"][:64]) > 1.0
    for name in plain.dtype.names or ():
        assert np.array_equal(plain[name], rec.samples[name], equal_nan=True), name


def test_bad_sensors_are_refused_by_the_core() -> None:
    base = axes_rig.rig_config(rig())
    bad = core.ExtraSensorConfig("force", float("nan"))
    with pytest.raises(CoreError):
        CoupledRig(dataclasses.replace(base, extras=((), (bad,))))
    with pytest.raises(CoreError, match="at most 8"):
        CoupledRig(dataclasses.replace(base, extras=((core.ExtraSensorConfig(),) * 9, ())))
    with pytest.raises(CoreError, match="extra sensors of 1 axes"):
        CoupledRig(dataclasses.replace(base, extras=((),)))


def test_a_state_space_plant_has_them_too() -> None:
    """x' = -60 (x - u) on each axis, from a step: velocity and acceleration in closed form."""
    base = axes_rig.rig_config(rig())
    own = tuple(core.ExtraSensorConfig(kind) for kind in ("velocity", "acceleration"))
    pole = np.diag([-60.0, -60.0])
    plant = StateSpace(pole, -pole, np.eye(2), (1.0, 1.0))
    given = dataclasses.replace(base, servos=(), plant=plant, extras=((), own))
    moved = CoupledRig(given)
    for _ in range(11):
        moved.step([0.0, 0.01])
    left = np.exp(-60.0 * 10 / 1024)
    assert moved.extras[0] == ()
    assert moved.extras[1] == pytest.approx((0.6 * left, -36.0 * left), rel=1e-9)


# ---- files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        (
            {"right": RIGHT.replace("right_strain", "left_lvdt")},
            'axes left and right both have an extra sensor called "left_lvdt"',
        ),
        (
            {"left": LEFT + '[axis.link]\nkind = "serial"\nchannel = "/dev/a"\nbitrate = 400000\n'},
            "feedback (24 bytes)",
        ),
        (
            {"left": LEFT + '[axis.link]\nkind = "can"\nchannel = "can0"\n'},
            "the frames of hw/rthyb.dbc are full",
        ),
    ],
)
def test_channels_that_an_axis_cannot_have_are_told_with_their_key(
    changed: dict[str, str], says: str
) -> None:
    with pytest.raises(InputError) as error:
        rig(**changed)
    assert says in str(error.value)


@pytest.mark.parametrize("name", ["x_meas_m", "x_num_m_1", "alpha_1", "f_true_n_1"])
def test_a_name_that_recordings_of_several_axes_have_already_is_refused(name: str) -> None:
    given = rig(right=RIGHT.replace("right_strain", name))
    with pytest.raises(InputError, match="a recording of this test already has a channel") as error:
        virtually(given)
    assert "axis.1.sensors.extra.0.name" in str(error.value)


def test_more_channels_than_a_row_holds_are_refused_with_their_number() -> None:
    many = [
        "".join(f'\n[[axis.sensors.extra]]\nname = "{axis}_{i}"\nunit = "V"\n' for i in range(8))
        for axis in AXES
    ]
    given = rig(left=many[0], right=many[1])
    assert len(virtually(given).extras()) == 16
    four = given.model_copy(update={"axis": [*given.axis, *given.axis]})
    own = (core.Channel("a", ""),) * 35
    with pytest.raises(InputError, match=r"found 32 extra channels.*room for 29"):
        axes_experiment._extra_channels(four, own)


def test_a_rig_with_extra_channels_of_its_axes_reads_back() -> None:
    assert config.parse_any_rig(config.dump(rig())) == rig()


# ---- what is made of them ------------------------------------------------------------------------


def test_recordings_exports_and_python_have_them_with_their_units(
    rec: RecordedTest, tmp_path: Path
) -> None:
    recording.write(tmp_path / "recording.h5", rec)
    again = recording.read(tmp_path / "recording.h5")
    assert again.extras_by_axis() == rec.extras_by_axis()
    mat_csv.to_csv(again, tmp_path / "r.csv", full=True)
    head = (tmp_path / "r.csv").read_text().splitlines()[0]
    assert "left_lvdt" in head
    assert "right_strain" in head
    opened = rt.open(tmp_path / "recording.h5")
    assert np.array_equal(opened["right_strain"], rec.channel("right_strain"))


@pytest.mark.long
def test_the_report_shows_them_with_their_units(rec: RecordedTest) -> None:
    page = render(rec)
    for title in ("Extra channel left_lvdt", "Extra channel right_strain"):
        assert title in page
    assert "right_strain, um/m" in page


def test_the_live_view_of_a_past_test_tells_the_last_reading_of_each(rec: RecordedTest) -> None:
    found = {one["label"]: one["value"] for one in PastSource(rec).status()["counters"]}
    for name in ("left_lvdt", "left_acceleration", "right_strain"):
        reading, unit = numbers.number(rec.channel(name)[-1], 4), found[name].split()[-1]
        assert found[name] == f"{reading} {unit}"
        assert unit == next(one.unit for one in rec.extras() if one.name == name)


def test_a_diagnosis_reads_a_second_sensor_of_its_axis_and_of_no_other(
    rec: RecordedTest, tmp_path: Path
) -> None:
    recording.write(tmp_path / "recording.h5", rec)
    left, right = (OfAxis(name, rig()) for name in AXES)

    def case(of: OfAxis, *wishes: str) -> reading.Case:
        path = tmp_path / "recording.h5"
        return reading.read_case(path, of.model, wishes=mapping.read_wishes(wishes), of=of)

    own, second = case(left), case(left, "x_meas=left_lvdt")
    apart = second.channels["x_meas"] - own.channels["x_meas"]
    # The rig's own sensor is exact here; the second has steps of 1 um, and its own zero.
    assert 0.0 < np.abs(apart).max() < 1.1e-6
    assert any("left_lvdt" in note for note in second.notes)
    with pytest.raises(InputError, match=r"of axis left, but .*right_strain"):
        case(right, "x_meas=left_lvdt")
    with pytest.raises(InputError, match="its extra channels: left_lvdt, left_acceleration"):
        case(left, "x_meas=lvdt_3")


def test_a_second_load_cell_is_freed_of_the_force_of_the_other_axis(tmp_path: Path) -> None:
    """The same force, read by both: the diagnosis gets the same signal from either."""
    cell = RIGHT.replace("right_strain", "right_cell").replace("um/m", "kN")
    cell = cell.replace("gain = 0.01\nnoise_std = 0.5", "gain = 0.001")
    given = rig(right=cell)
    recording.write(tmp_path / "recording.h5", virtually(given))
    of, path = OfAxis("right", given), tmp_path / "recording.h5"
    own = reading.read_case(path, of.model, of=of).channels["f_meas"]
    wishes = mapping.read_wishes(["f_meas=right_cell"])
    second = reading.read_case(path, of.model, wishes=wishes, of=of).channels["f_meas"]
    # The first is zeroed by the mean over the tare, the second by that over the rows at rest.
    assert np.std(own) > 100.0
    assert np.abs(second - own).max() < 1e-6 * np.abs(own).max()


# ---- over links ----------------------------------------------------------------------------------


def test_a_test_over_two_serial_lines_records_what_each_drive_sends(tmp_path: Path) -> None:
    seen: list[dict[str, str]] = []
    with ExitStack() as owned:
        lines = [virtual_rig.pty_line()[0] for _ in AXES]
        for line in lines:
            owned.callback(line.close)
        links = [
            f'[axis.link]\nkind = "serial"\nchannel = "{line.name}"\nvirtual = true\n'
            for line in lines
        ]
        given = rig(left=LEFT + links[0], right=RIGHT + links[1])
        ends = [loop.Link(line.kind, line.fd) for line in lines]
        for end in ends:
            owned.callback(end.close)
        codecs = [line.codec for line in lines]
        drives = virtual_rig.drives_of(given, codecs, ends, virtual_rig.RigPlan())
        opened = owned.enter_context(opening.open_axes(given, "controller"))

        def look(session: object) -> None:
            source = LiveSource(session.run.ring.path, None)  # type: ignore[attr-defined]
            source.poll()
            source.look()
            seen.append({one["label"]: one["value"] for one in source.status()["counters"]})
            source.close()

        rec = realtime.run(
            real_setup(given),
            opened,
            clock="stepped",
            before_tick=drives.tick,
            folder=tmp_path,
            zeroed=look,
        )
    assert rec.meta["end_reason"] == "completed"
    fresh = np.isfinite(rec.channel("left_lvdt")) & np.isfinite(rec.channel("right_strain"))
    assert fresh.mean() > 0.99
    own = rec.axis("left")["x_read_m"] * 1e3
    assert np.abs(rec.channel("left_lvdt") - own)[fresh].max() < 0.0011
    force = rec.axis("right")["f_read_n"]
    assert np.std((rec.channel("right_strain") - 0.01 * force)[fresh]) == pytest.approx(
        0.5, rel=0.1
    )
    assert_replays(rec)
    assert seen[0]["right_strain"].endswith(" um/m")


def test_lost_pairs_of_one_axis_leave_no_number_in_its_channels_alone() -> None:
    mishaps = virtual_rig.parse_mishaps(["left.drop:p=0.05,from=0,to=3"], AXES)
    rec = virtual_rig.run_faulty(real_setup(rig()), mishaps)
    gone = np.isnan(rec.channel("left_lvdt"))
    assert 20 < gone.sum() < 400
    assert np.array_equal(gone, np.isnan(rec.channel("left_acceleration")))
    assert np.isfinite(rec.channel("right_strain")[5:]).all()


def test_each_axis_finds_its_signals_in_its_own_dbc_file(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    more = ' SG_ Tilt : 64|16@1- (0.01,0) [0|0] "" pc\n'
    for axis, first in zip(AXES, (0x100, 0x200), strict=True):
        table = OWN.format(command=first, reading=first + 1)
        table = table.replace("Reading: 8 drive", "Reading: 16 drive")
        (tmp_path / f"{axis}.dbc").write_text(table + (more if axis == "right" else ""))
    both = {
        axis: f'[[axis.sensors.extra]]\nname = "{axis}_tilt"\nunit = "mrad"\nsignal = "Tilt"\n'
        f'[axis.link]\nkind = "can"\nchannel = "can{k}"\nfd = true\n'
        f'dbc = "{tmp_path / f"{axis}.dbc"}"\n'
        for k, axis in enumerate(AXES)
    }
    given = rig(**both)
    right = given.of_axis("right")
    codec = extra_frames.codec_of(right, dbc.load(right.link.dbc))  # type: ignore[union-attr, arg-type]
    frames = codec.encode_feedback(wire.Reading(0.01, 5.0, 1, 2, 0, (3.0,)))
    assert codec.decode_feedback(frames[0])[1].extra == pytest.approx((3.0,), abs=0.005)
    left = given.of_axis("left")
    with pytest.raises(InputError, match="no signal of this name"):
        extra_frames.codec_of(left, dbc.load(left.link.dbc))  # type: ignore[union-attr, arg-type]
    assert [c.name for c in axes_experiment.at_rest(given).channels[:2]] == [
        "left_tilt",
        "right_tilt",
    ]


@pytest.mark.long
def test_the_frame_records_a_second_sensor_from_the_command_line(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    text = config.shipped_rig("two-axis-frame").read_text(encoding="utf-8")
    end = text.index("[axis.limits]", text.index('name = "lower"'))
    (tmp_path / "rig.toml").write_text(text[:end] + RIGHT.lstrip() + "\n" + text[end:])
    words = ("--set", "test.duration_s=1", "--no-report", "--out", "run")
    done = rthyb("run", "two-actuator-frame", "--rig", "rig.toml", *words)
    assert done.code == 0, done.err
    found = rt.open("run")
    assert found["right_strain"].shape == found["x_meas_m"].shape
    assert experiment.TRUE[0] not in found


def test_no_extra_sensor_of_an_axis_replaces_time_or_reference() -> None:
    for name in ("t_s", "x_ref_m", "v_ref_mps", "f_ref_n", "x_ref_m_1", "f_ref_n_1"):
        given = rig(right=RIGHT.replace('"right_strain"', f'"{name}"'))
        with pytest.raises(InputError, match=f'found "{name}", but exported files have') as error:
            virtually(given)
        assert "axis.1.sensors.extra.0.name" in str(error.value)
