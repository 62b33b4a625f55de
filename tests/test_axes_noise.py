"""Noise of the sensors in the commands of several axes: predicted, and as a run has it."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from rthyb_rt import config, core
from rthyb_rt.analysis import axes_noise, axes_roots, loop_stability
from rthyb_rt.lab import axes_experiment, virtual_time
from rthyb_rt.lab.experiment import Setup

FRAME = Path(__file__).parents[1] / "examples" / "two-actuator-frame.toml"
RATE_HZ = 1024.0


RIG = Path(config.shipped_rig("two-axis-frame")).read_text("utf-8")
COLUMN = """
[[sensor]]
kind = "force"
name = "column"
along = { x = 0.4 }
noise_std_n = NOISE
"""
WIRE = """
[[sensor]]
kind = "displacement"
name = "wire"
pin_m = [0.2667, 0.3]
direction = [1, 0]
noise_std_m = 2e-5
"""


def rig_with(sensors: str, cell_forces: str) -> str:
    """Return the shipped rig of two actuators with sensors that belong to neither."""
    keyed = RIG.replace("[kinematics]\n", f"[kinematics]\n{cell_forces}\n")
    return keyed.replace("[kinematics]", sensors + "\n[kinematics]")


def frame(
    folder: Path, rho_inf: float, more: str = "", pga: str = "0.12 g", rig: str = RIG
) -> Setup:
    """Return the shipped test of two actuators, whose rotations have no mass."""
    text = FRAME.read_text("utf-8").replace('"two-actuator-frame/', f'"{FRAME.with_suffix("")}/')
    text = text.replace("rho_inf = 0.5", f"rho_inf = {rho_inf}")
    text = re.sub(r"pga_g = .*", f'pga_g = "{pga}"', text)
    text = re.sub(r"duration_s = .*", 'duration_s = "8 s"', text)
    path = folder / "frame.toml"
    path.write_text(text + more, "utf-8")
    return axes_experiment.prepare(
        config.load_test(path), config.parse_any_rig(rig, "two-axis-frame.toml")
    )


def linear(setup: Setup) -> Setup:
    """Return a test without limits of the command, and with the tangent stiffness held at k_e."""
    controller = setup.controller
    free = {"velocity_limit_m_per_s": 1e3, "acceleration_limit_m_per_s2": 1e6}
    axes = tuple(dataclasses.replace(axis, **free) for axis in controller.axes)
    assert controller.matrix_rfc is not None
    # What so much noise could have caused has no influence on the stiffness.
    held = dataclasses.replace(controller.matrix_rfc, rest_noise=(1.0, 1.0))
    return dataclasses.replace(
        setup, controller=dataclasses.replace(controller, axes=axes, matrix_rfc=held)
    )


def as_predicted(setup: Setup) -> None:
    """Compare predicted noise of velocity and acceleration with that of a test."""
    known = axes_roots.axes_and_laws(setup)
    assert known is not None
    assert setup.group is not None
    jacobian = setup.group.rig.core_kinematics().jacobian()
    loop = axes_roots.loop_of(setup.controller, known[0], known[1][0], jacobian)
    predicted = axes_noise.of_loop(setup, loop)
    rec = virtual_time.run(setup)
    rows = rec.samples[rec.samples["state"] == core.RUNNING]
    commands = [rows[name] for name in ("x_plc_m", "x_plc_m_1")]
    found = [np.diff(x, 2).std() * RATE_HZ**2 for x in commands]
    assert found == pytest.approx(predicted["acceleration"], rel=0.05)
    found = [np.diff(x).std() * RATE_HZ for x in commands]
    assert found == pytest.approx(predicted["velocity"], rel=0.05)


# With a law that does not learn at rest, and hardly any ground motion.
STILL = "rfc = {{ cutoff_hz = {} }}\nmatrix = {{ gate_factor = 1e6 }}\n"


@pytest.mark.parametrize("rho_inf", [0.0, 0.8, 0.95])
@pytest.mark.parametrize("cutoff_hz", [0.0, 60.0])
def test_a_specimen_at_rest_is_shaken_by_noise_as_predicted(
    rho_inf: float, cutoff_hz: float, tmp_path: Path
) -> None:
    as_predicted(linear(frame(tmp_path, rho_inf, STILL.format(cutoff_hz), "0.00001 g")))


@pytest.mark.parametrize(
    ("sensors", "cell_forces"),
    [
        (COLUMN.replace("NOISE", "100"), "cell_forces = [[1.25], [0.1]]"),
        (WIRE, ""),
        (COLUMN.replace("NOISE", "50") + WIRE, "cell_forces = [[2.5], [0]]"),
    ],
    ids=["cell", "wire", "cell and wire"],
)
def test_noise_of_a_load_cell_below_a_column_and_of_a_wire_shakes_the_specimen_as_predicted(
    sensors: str, cell_forces: str, tmp_path: Path
) -> None:
    rig = rig_with(sensors, cell_forces)
    as_predicted(linear(frame(tmp_path, 0.8, STILL.format(60.0), "0.00001 g", rig)))


def test_a_load_cell_below_a_column_whose_noise_is_multiplied_is_said_before_the_test(
    tmp_path: Path,
) -> None:
    """Its correction was given in N per kN."""
    for per_newton, said in ((1.25, False), (2000, True)):
        rig = rig_with(COLUMN.replace("NOISE", "20"), f"cell_forces = [[{per_newton}], [0]]")
        texts = loop_stability.demand(frame(tmp_path, 0.5, rig=rig))
        assert any("noise of the sensors alone" in text for text in texts) == said


def test_noise_that_exceeds_the_acceleration_limit_is_said_before_the_test(tmp_path: Path) -> None:
    setup = frame(tmp_path, 0.95)
    (text,) = (text for text in loop_stability.demand(setup) if "noise" in text)
    assert "noise of the sensors alone makes the command of axis lower accelerate by" in text
    assert "controller.rfc.cutoff_hz" in text
    found = axes_noise.judge(setup)
    assert found is not None
    assert (found.axis, found.quantity) == ("lower", "acceleration")
    sigmas = found.limit / found.deviation
    assert found.limited == pytest.approx(2.0 * scipy.stats.norm.sf(sigmas), rel=1e-9)


def test_a_filter_or_more_damping_of_the_step_keeps_noise_below_the_limit(tmp_path: Path) -> None:
    filtered = "rfc = { cutoff_hz = 60 }\n"
    for setup in (frame(tmp_path, 0.5), frame(tmp_path, 0.95, filtered)):
        assert not [text for text in loop_stability.demand(setup) if "noise" in text]
