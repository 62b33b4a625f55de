"""A rig of several axes is swept axis by axis: the matrix of responses against the plant's own, the
stiffness against the specimen's, and what a sweep must not do."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb

from rthyb_rt import config
from rthyb_rt.config import AxesRig, matrix_response
from rthyb_rt.config.axes_response import response_of_rig
from rthyb_rt.errors import InputError
from rthyb_rt.rig import identify_axes
from rthyb_rt.rig.identification import SweepPlan

H = 1.0 / 1024.0
K = [[8e5, 2e4], [2e4, 6e4]]
A = np.block(
    [
        [np.zeros((2, 2)), np.eye(2)],
        [-np.array([[9e3, -2e3], [-2e3, 7e3]]), -np.array([[90.0, -8.0], [-8.0, 80.0]])],
    ]
)
B = np.vstack([np.zeros((2, 2)), np.array([[8e3, 9e2], [3e2, 6.6e3]])])
C = np.hstack([np.eye(2), np.zeros((2, 2))])
SWEEP = SweepPlan((1.0, 2.0, 4.0, 8.0, 16.0), 1e-3)


def text(sensors: str = "", limits: str = "", actuators: bool = False) -> str:
    axis = "".join(
        f'[[axis]]\nname = "{name}"\n{sensors}\n{limits}\n'
        + ('actuator = { kind = "pure-delay", delay_samples = 7 }\n' if actuators else "")
        for name in ("left", "right")
    )
    plant = f"[plant]\na = {A.tolist()}\nb = {B.tolist()}\nc = {C.tolist()}\n"
    return (
        'schema = "rthyb-rig/1"\n[rig]\nname = "plant"\nload_cell = "specimen"\n' + axis
        + '[kinematics]\nkind = "matrix"\ninterface = ["x", "turn"]\nrotations = ["turn"]\n'
        f"matrix = [[1, 0.2], [1, -0.3]]\n[specimen]\nstiffness = {K}\n"
        + ("" if actuators else plant)
    )  # fmt: skip


def rig(**settings: str | bool) -> AxesRig:
    found = config.parse_any_rig(text(**settings), "rig.toml")  # type: ignore[arg-type]
    assert isinstance(found, AxesRig)
    return found


def exact(f_hz: float) -> np.ndarray:
    """Reading over command of the plant with its command held, sampled."""
    z = np.zeros((6, 6))
    z[:4, :4], z[:4, 4:] = A * H, B * H
    scipy_linalg = pytest.importorskip("scipy.linalg")
    step = scipy_linalg.expm(z)
    turn = np.exp(2j * np.pi * f_hz * H)
    return np.asarray(C @ np.linalg.solve(turn * np.eye(4) - step[:4, :4], step[:4, 4:]))


def test_the_matrix_of_responses_is_that_of_the_plant() -> None:
    found = identify_axes.identify_rig(rig(), SWEEP).response
    for f_hz, matrix in zip(found.frequency_hz, found.response, strict=True):
        assert np.abs(matrix - exact(f_hz)).max() < 2e-4
    # Rows are readings: the coupling of the axes is not symmetric.
    assert np.abs(exact(1.0) - exact(1.0).T).max() > 0.01


def test_stiffness_along_the_interface_is_the_specimens() -> None:
    result = identify_axes.identify_rig(rig(), SWEEP)
    assert np.abs(result.stiffness - K).max() < 2e-4 * 8e5
    assert result.asymmetry < 1e-3


def test_each_axis_gets_the_delay_of_its_own() -> None:
    delayed = identify_axes.identify_rig(rig(actuators=True), SWEEP)
    for own in delayed.axes:
        # Reading n was latched before command n, but a pure delay moves with it.
        assert own.delay_s == pytest.approx(7 * H, rel=1e-3)
        assert own.gain == pytest.approx(1.0, rel=1e-6)


def test_the_rig_file_that_is_written_reads_back_and_gives_an_inverse() -> None:
    result = identify_axes.identify_rig(rig(), replace(SWEEP, frequencies_hz=(
        0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 40.0)))  # fmt: skip
    filled = identify_axes.identified_rig(rig(), result)
    assert filled.identified is not None
    again = response_of_rig(rig(), filled.identified, config.STANDARD)
    assert np.abs(again.response - result.response.response).max() < 1e-4
    assert np.abs(np.array(filled.k_e) - K).max() < 1e-3 * 8e5
    assert filled.specimen.stiffness == K
    fit = matrix_response.fit(again, H)
    undone = np.abs(exact(4.0) @ fit.inverse.response(4.0, H)[0] - np.eye(2)).max()
    assert undone < 0.1
    assert all(axis.identified is not None for axis in filled.axis)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"sensors": "sensors = { force = { range_n = 50 } }"},
         "the force of axis left reaches 50 N while axis left is swept; its load cell's range"),
        ({"limits": "limits = { command_position_m = 0.0005 }"}, "its position limit is 0.0005 m"),
        ({"limits": "limits = { force_n = 40 }"}, "its force limit is 40 N"),
        ({"limits": "limits = { command_velocity_m_per_s = 0.001 }"}, "its velocity limit is"),
        ({"limits": "limits = { command_acceleration_m_per_s2 = 0.01 }"}, "its acceleration limit"),
    ],
)  # fmt: skip
def test_a_sweep_that_meets_a_limit_is_refused_with_its_axis(
    settings: dict[str, str], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        identify_axes.identify_rig(rig(**settings), SWEEP)


def test_an_axis_that_does_not_follow_is_named_by_its_rig() -> None:
    dead = text().replace(f"{B.tolist()}", f"{(B * [1.0, 0.0]).tolist()}")
    found = config.parse_any_rig(dead, "rig.toml")
    assert isinstance(found, AxesRig)
    with pytest.raises(InputError, match="did not follow the command"):
        identify_axes.identify_rig(found, SWEEP)


def test_rthyb_identify_writes_the_matrix_of_responses(rthyb: Rthyb, tmp_path: Path) -> None:
    path = tmp_path / "found.toml"
    done = rthyb(
        "identify", "two-axis-frame", "--amplitude", "0.2 mm", "--out", str(path), "--json"
    )
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert set(told["axes"]) == {"upper", "lower"}
    written = config.load_any_rig(path)
    assert isinstance(written, AxesRig)
    assert written.identified is not None
    assert written.identified.frequency_hz == told["response"]["frequency_hz"]
    assert np.array(told["stiffness"]) == pytest.approx(
        np.array(written.specimen.stiffness), rel=0.01
    )
