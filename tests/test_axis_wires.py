"""Ranges of an axis' own sensors that the frames of its link cannot carry: a saturated reading
would look like a valid one."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import util
from pathlib import Path

import pytest
from test_config_link import CAN, OWN_DBC, PYTHON_CAN, RIG, SERIAL
from test_several_axes import RIG as TWO_AXES
from test_several_axes import SHORT as TWO_AXES_TEST

from rthyb_rt import config
from rthyb_rt.config import AxesRig
from rthyb_rt.core import wire
from rthyb_rt.core.dbc import load
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, axis_wires, experiment
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening
from rthyb_rt.service import any_rig

MOST = 2**31 - 1
"""Largest number of 32 bits: 2.147 m in nm, 2.147 MN in mN."""
TEST = """schema = "rthyb-test/1"
[test]
name = "t"
[ground_motion]
pga_g = 0.04
duration_s = 2
[numerical]
period_s = 0.5
damping_ratio = 0.02
[controller]
type = "none"
"""
CELL = '[sensors.force]\nrange_n = "5 MN"\n'
STROKE = '[sensors.displacement]\nrange_m = "3 m"\n'


@pytest.mark.parametrize("codec", [wire.can(), wire.serial()])
@pytest.mark.parametrize(
    ("gain", "offset", "force_n", "displacement_m"),
    [
        (1.0, 0.0, MOST * 1e-3, MOST * 1e-9),
        (-2.0, 0.0, MOST * 2e-3, MOST * 2e-9),
        (1.0, 0.5, MOST * 1e-3 - 0.5, MOST * 1e-9 - 0.5),
        (10.0, -1.0, MOST * 1e-2 - 1.0, MOST * 1e-8 - 1.0),
    ],
)
def test_the_programs_own_frames_carry_a_nanometre_and_a_millinewton_in_32_bits(
    codec: wire.Codec, gain: float, offset: float, force_n: float, displacement_m: float
) -> None:
    assert codec.reading_reach(force=True, gain=gain, offset=offset) == pytest.approx(force_n)
    found = codec.reading_reach(force=False, gain=gain, offset=offset)
    assert found == pytest.approx(displacement_m)


def test_a_drive_that_saturates_sends_the_reading_at_the_end_of_the_frame() -> None:
    codec = wire.can()
    for sign in (1.0, -1.0):
        frames = codec.encode_feedback(wire.Reading(sign * 100.0, sign * 1e9))
        found = [codec.decode_feedback(frame)[1] for frame in frames]
        reach_m = codec.reading_reach(force=False, gain=1.0, offset=0.0)
        reach_n = codec.reading_reach(force=True, gain=1.0, offset=0.0)
        assert (found[0].x_m, found[1].f_n) == (sign * reach_m, sign * reach_n)


SIGNALS = {
    # bits, scale and range: what it carries, N
    "0|32@1- (0.001,0) [0|0]": 2147483.647,
    "0|16@1- (0.01,0) [0|0]": 327.67,
    "0|16@1- (0.01,0) [-300|100]": 100.0,
    "0|16@1+ (0.01,-327.68) [0|0]": 327.67,
    # The position of a piston from its lower end, and a load cell for compression only.
    "0|16@1+ (0.01,0) [0|0]": 655.35,
    "0|16@1+ (-0.01,0) [0|0]": 655.35,
}


@pytest.mark.parametrize("signal", SIGNALS)
def test_a_signal_of_a_dbc_file_carries_its_bits_and_its_range(signal: str, tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    path = tmp_path / "drive.dbc"
    text = re.sub(r"(SG_ f_meas : ).*( \"N\")", rf"\g<1>{signal}\2", OWN_DBC.read_text())
    path.write_text(text, encoding="utf-8")
    found = load(path).reading_reach(force=True, gain=1.0, offset=0.0)
    assert found == pytest.approx(SIGNALS[signal], rel=1e-9)


def prepared(text: str) -> object:
    rig = config.parse_rig(RIG + text, "rig.toml")
    return experiment.prepare(config.parse_test(TEST, "test.toml"), rig, real_time=True)


def refused(text: str, by: Callable[[str], object] = prepared) -> dict[str, str]:
    with pytest.raises(InputError) as caught:
        by(text)
    return {problem.where: problem.message for problem in caught.value.problems}


@pytest.mark.parametrize("link", [CAN, SERIAL, PYTHON_CAN + 'interface = "pcan"\n', ""])
def test_a_load_cell_of_5_mn_and_a_stroke_of_3_m_are_refused_with_what_the_frames_carry(
    link: str,
) -> None:
    found = refused(link + STROKE + CELL)
    (stroke,) = (v for k, v in found.items() if k.endswith("sensors.displacement.range_m"))
    assert stroke.startswith("found 3000 mm, but x_meas in the frames of the link carries every")
    assert "only up to 2147.48 mm; a larger one would arrive as a reading at that end" in stroke
    (cell,) = (v for k, v in found.items() if k.endswith("sensors.force.range_n"))
    assert cell.startswith("found 5000 kN, but f_meas in the frames")
    assert "only up to 2147.48 kN;" in cell
    assert "divided by 10, and multiply calibration.force.scale by 10" in cell
    assert 'or set range_n = "2147.48 kN"' in cell
    assert all(where.startswith("rig.toml:") for where in found)


@pytest.mark.parametrize(
    "cured",
    [
        CELL + "[calibration.force]\nscale = 10\n",
        '[sensors.force]\nrange_n = "2147.48 kN"\n',
        '[sensors.displacement]\nrange_m = "2147.48 mm"\n',
    ],
)
def test_what_the_message_advises_is_enough(cured: str) -> None:
    prepared(CAN + cured)


def test_nearly_all_of_a_range_is_not_all_of_it() -> None:
    """A calibration with an offset moves one end of the frame towards zero."""
    offset = '[calibration.force]\noffset_n = "100 kN"\n'
    (message,) = refused(CAN + '[sensors.force]\nrange_n = "2100 kN"\n' + offset).values()
    assert "only up to 2047.48 kN" in message
    prepared(CAN + '[sensors.force]\nrange_n = "2047 kN"\n' + offset)


def test_a_limit_of_the_force_beyond_the_end_of_the_frame_would_never_act() -> None:
    limit = '[limits]\nforce_n = "3 MN"\n'
    ((where, message),) = refused(CAN + limit).items()
    assert where.startswith("rig.toml:")
    assert where.endswith("limits.force_n")
    assert "found 3000 kN, but f_meas in the frames" in message
    assert "so this limit would never act: let the drive send the reading divided by 10" in message
    prepared(CAN + limit + "[calibration.force]\nscale = 10\n")
    # The range, which the frame carries, ends a test before.
    prepared(CAN + limit + '[sensors.force]\nrange_n = "2 MN"\n')
    prepared(CAN + '[limits]\nforce_n = { value = "3 MN", action = "none" }\n')


def test_the_limit_of_an_axis_of_several_counts_as_well() -> None:
    high = TWO_AXES.replace("60 kN", "3 MN").replace("90 kN", "3 MN")
    rig, test = config.parse_any_rig(high, "rig.toml"), config.parse_test(TWO_AXES_TEST)
    assert isinstance(rig, AxesRig)
    axes_experiment.prepare(test, rig)
    with pytest.raises(InputError, match=r"limits\.force_n: found 3000 kN, but f_meas in the"):
        axes_experiment.prepare(test, rig, real_time=True)


def test_the_limit_of_a_test_counts_as_well() -> None:
    test = config.parse_test(TEST + '[limits]\nforce_n = "3 MN"\n', "test.toml")
    with pytest.raises(InputError, match=r"test\.toml:\d+: limits\.force_n: found 3000 kN"):
        experiment.prepare(test, config.parse_rig(RIG + CAN, "rig.toml"), real_time=True)


def test_in_virtual_time_no_frame_carries_anything() -> None:
    rig = config.parse_rig(RIG + CAN + STROKE + CELL)
    experiment.prepare(config.parse_test(TEST), rig)


def test_a_dbc_file_that_carries_too_little_is_told_to_carry_more(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    (tmp_path / "drive.dbc").write_text(OWN_DBC.read_text(), encoding="utf-8")
    path = tmp_path / "rig.toml"
    path.write_text(RIG + CAN + 'dbc = "drive.dbc"\n' + CELL, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        axis_wires.check(config.load_rig(path))
    (problem,) = caught.value.problems
    assert "give f_meas in the DBC file more bits, a larger factor or a wider" in problem.message


def test_without_cantools_the_check_says_only_that_the_frames_were_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "drive.dbc").write_text(OWN_DBC.read_text(), encoding="utf-8")
    path = tmp_path / "rig.toml"
    path.write_text(RIG + CAN + 'dbc = "drive.dbc"\n' + CELL, encoding="utf-8")
    rig = config.load_rig(path)
    monkeypatch.setattr(util, "find_spec", lambda name: None)
    axis_wires.check(rig)


def test_a_service_and_a_virtual_rig_on_a_link_refuse_it_too() -> None:
    assert refused(CAN + CELL, lambda text: any_rig.at_rest(config.parse_rig(RIG + text)))
    ours, theirs = opening.socket_pair()
    with ours, theirs:
        rig = config.parse_rig(RIG + CELL)
        with pytest.raises(InputError, match="carries every reading only up to 2147"):
            virtual_rig.in_step(rig, theirs).__enter__()


def test_each_axis_of_several_is_refused_under_its_own_number() -> None:
    own = "[axis.sensors.force]\nrange_n = 5e6\n[kinematics]"
    rig = config.parse_any_rig(TWO_AXES.replace("[kinematics]", own), "rig.toml")
    assert isinstance(rig, AxesRig)
    test = config.parse_test(TWO_AXES_TEST, "test.toml")
    axes_experiment.prepare(test, rig)
    for attempt in (
        lambda: axes_experiment.prepare(test, rig, real_time=True),
        lambda: axes_experiment.at_rest(rig),
    ):
        with pytest.raises(InputError) as caught:
            attempt()
        (problem,) = caught.value.problems
        assert problem.where.endswith("axis.1.sensors.force.range_n")
        assert "found 5000 kN" in problem.message
