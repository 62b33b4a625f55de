"""Limits of a direction: the commands of all axes end at them, however fast they come."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from axes_bench import SIDES, Bench, H, config, rig
from kernels import Floats
from test_axes_paths import coupler
from test_axes_watches import directed

from rthyb_rt import core
from rthyb_rt.core.kinematics import Kinematics

LIMITS = {0: 1.5e-3, 1: 4e-4}
"""m and rad; the motion goes farther."""
ACCELERATION = 10.0
DIRECTION = pytest.mark.parametrize("interface", [0, 1], ids=["x", "theta"])
GEOMETRY = pytest.mark.parametrize("geometry", ["matrix", "pins"])


def bench(interface: int, geometry: str, reaction: core.Reaction, **changes: Any) -> Bench:
    kinematics = Kinematics(SIDES) if geometry == "matrix" else coupler()
    control = directed(interface, "position", LIMITS[interface], reaction)
    control |= {"kinematics": kinematics, "acceleration_limit_m_per_s2": ACCELERATION}
    return Bench(config(control, **changes), plant=rig(kinematics))


def poses(lab: Bench) -> Floats:
    given = lab.settings.controller.kinematics
    assert given is not None
    found, code = given.pose(lab.commands())
    assert code == 0
    return np.asarray(found)


@GEOMETRY
@DIRECTION
@pytest.mark.parametrize("reaction", ["hold", "ramp-out"])
def test_no_command_leads_beyond_the_limit_of_a_direction(
    reaction: core.Reaction, interface: int, geometry: str
) -> None:
    lab = bench(interface, geometry, reaction).running(0)
    left = "HOLD" if reaction == "hold" else "RAMP_OUT"
    lab.until(left)
    assert lab.station.cause == "position"
    assert lab.station.cause_interface == interface
    for _ in range(600):
        lab.step()
    along = abs(poses(lab)[:, interface])
    assert along.max() <= LIMITS[interface] + 2e-9
    assert along.max() > 0.9 * LIMITS[interface]
    # And gently: every axis brakes before it.
    change = np.diff(lab.commands(), n=2, axis=0) / H**2
    assert abs(change).max() <= ACCELERATION * (1 + 1e-6)


@GEOMETRY
@DIRECTION
def test_a_test_that_stays_ends_in_front_of_the_limit_of_a_direction(
    interface: int, geometry: str
) -> None:
    lab = bench(interface, geometry, "ramp-out", stay=True).running(0)
    lab.until("RAMP_OUT")
    lab.until("IDLE", 3 * 1024)
    assert lab.station.cause_interface == interface
    assert abs(poses(lab)[:, interface]).max() <= LIMITS[interface] + 2e-9
    assert lab.commands()[-1] == pytest.approx(lab.commands()[-2], abs=1e-9)


@DIRECTION
@pytest.mark.parametrize("reaction", ["none", "indicate"])
def test_a_limit_that_only_indicates_holds_nothing(reaction: core.Reaction, interface: int) -> None:
    lab = bench(interface, "matrix", reaction).running(0)
    lab.until("IDLE", 6000)
    assert lab.station.cause == "completed"
    assert abs(poses(lab)[:, interface]).max() > 1.2 * LIMITS[interface]


@GEOMETRY
@DIRECTION
def test_without_an_acceleration_limit_the_commands_stop_at_the_limit_of_a_direction(
    interface: int, geometry: str
) -> None:
    kinematics = Kinematics(SIDES) if geometry == "matrix" else coupler()
    control = directed(interface, "position", LIMITS[interface], "ramp-out")
    lab = Bench(config(control | {"kinematics": kinematics}), plant=rig(kinematics)).running(0)
    lab.until("RAMP_OUT")
    lab.until("IDLE", 6000)
    assert abs(poses(lab)[:, interface]).max() <= LIMITS[interface] + 2e-9
    again = core.Station(lab.settings, lab.station._ag).replay(lab.rows())
    assert again.tobytes() == lab.rows().tobytes()
