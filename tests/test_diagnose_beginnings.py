"""How a recording begins, what an actuator makes of a held command, and one contact's one law."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rthyb_rt import config, core
from rthyb_rt.diagnose import actuation, actuator_choice, effects, engine, reading
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.problem import Member, compatible
from rthyb_rt.lab import experiment, virtual_time
from tests.diagnose_cases import FS, channels, write
from tests.test_diagnose_loop import SECTION_5, recorded

LAG = """
schema = "rthyb-rig/1"
[rig]
name = "lag"
elastic_stiffness_n_per_m = 666400
command_hold = "zoh"
[actuator]
kind = "first-order"
roll_off_hz = 9.6
[[specimen]]
element = "stiffness"
k_n_per_m = 666400
[sensors.displacement]
noise_std_m = 2e-6
[sensors.force]
noise_std_n = 5
"""
STRIBECK = """
[[specimen]]
element = "stribeck"
fc_n = 120
fs_n = 208
vs_m_per_s = 0.012
width_m_per_s = 1e-3
"""


def cut(first: int, folder: Path) -> Case:
    """A recording that agrees with its model, from a row on."""
    columns = {name: values[first:] for name, values in channels().items()}
    columns["t"] = columns["t"] - columns["t"][0]
    recording, model = write(folder, columns)
    return reading.read_case(recording, reading.read_model(model))


def zero_crossing(u: np.ndarray) -> int:
    """Row nearest to a zero of the command, at full speed."""
    late = np.flatnonzero(np.diff(np.sign(u[int(2 * FS) :]))) + int(2 * FS)
    return int(min(late, key=lambda i: abs(u[i])))


def test_command_that_passes_zero_in_mid_motion_is_no_rest(tmp_path: Path) -> None:
    u = channels()["x_cmd"]
    first = zero_crossing(u)
    moving = cut(first, tmp_path / "moving")
    # By chance or by the lab's trigger the first command is nothing.
    moving.channels["x_cmd"][0] = 0.0
    assert not actuation.from_rest(moving)
    assert actuation.from_rest(cut(0, tmp_path / "rest"))


def test_recording_that_begins_in_motion_at_a_zero_of_its_command_lacks_nothing(
    tmp_path: Path,
) -> None:
    case = cut(zero_crossing(channels()["x_cmd"]), tmp_path)
    case.channels["x_cmd"][0] = 0.0
    assert engine.diagnose(case).verdict == "none"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_first_reading_that_is_no_number_says_nothing_of_the_beginning(
    tmp_path: Path, bad: float
) -> None:
    columns = channels()
    columns["x_meas"][0] = bad
    recording, model = write(tmp_path, columns)
    assert actuation.from_rest(reading.read_case(recording, reading.read_model(model)))


def test_two_laws_of_friction_are_not_named_side_by_side() -> None:
    known = effects.catalogue()
    dry = [Member(e, Trial()) for e in known.values() if e.dry]
    assert {m.name for m in dry} == {"coulomb", "stribeck", "lugre"}
    for one in dry:
        for other in dry:
            assert one is other or not compatible([one, other])
        assert compatible([one, Member(known["stiffness"], Trial())])


def lagging(folder: Path, more: str = "") -> Path:
    """A test on a rig whose actuator lags by first order behind a held command."""
    wanted = {"ground_motion.pga_g": "0.05", "test.duration_s": "15"}
    rig = config.parse_rig(LAG + more, "lag")
    return recorded(
        folder, virtual_time.run(experiment.prepare(config.load_test(SECTION_5, wanted), rig))
    )


@pytest.mark.long
def test_velocity_of_a_lag_steps_with_a_held_command_after_the_row_and_not_before(
    tmp_path: Path,
) -> None:
    """A nanosecond of time offset, which noise decides, would take each step before its row."""
    rig = config.parse_rig(LAG, "lag")
    case = reading.read_case(lagging(tmp_path / "run"), reading.model_of_rig(rig))
    disp = actuator_choice.displacement(case)
    assert disp is not None
    assert not disp.found
    exact = core.VirtualRig(experiment.rig_config(rig, case.fs_hz)).motion(case.channels["x_cmd"])[
        1
    ]
    assert np.std(disp.best.motion.v - exact) < 1e-3 * np.std(exact)


@pytest.mark.long
def test_friction_behind_such_a_lag_is_named_alone_and_not_with_a_late_cell(tmp_path: Path) -> None:
    rig = config.parse_rig(LAG, "lag")
    run = lagging(tmp_path / "run", STRIBECK)
    found = engine.diagnose(reading.read_case(run, reading.model_of_rig(rig)))
    assert (found.verdict, found.effects) == ("explained", ["stribeck"])
    params = next(c.params for c in found.candidates if c.name == "stribeck")
    assert params["Fc_N"] == pytest.approx(120.0, rel=0.02)
    assert params["Fs_N"] == pytest.approx(208.0, rel=0.02)
