"""Ways of several axes that act at angles: their limits hold for each axis where it really goes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from axes_bench import NAMES, Bench, H, config, rig

from rthyb_rt.core import AxisConfig
from rthyb_rt.core.kinematics import Kinematics, Pin

VELOCITY, ACCELERATION, BRAKE = 0.05, 0.6, 0.8
ROUNDING = 1.0 + 1e-6
FAR = {
    "turned": (0.0, 0.080),
    "turned and out": (0.006, 0.080),
    "turned and in": (-0.006, -0.080),
    "far out": (0.060, 0.080),
}
"""m and rad. The arms of pins that are turned by 80 mrad differ by 17 % from those at rest."""
SIZES = pytest.mark.parametrize("size", [1.0, 1.1, 1.15, 1.2])
"""Of the limits: ways are found in steps of a quarter, and only now and then close to a limit."""
WHERE = pytest.mark.parametrize("where", FAR)


def coupler() -> Kinematics:
    """Short actuators: their direction turns by as much as a laboratory has it turn."""
    pins = (Pin((0.267, 0.127), (0.9, 0.127)), Pin((0.267, -0.127), (0.9, -0.127)))
    return Kinematics(pins=pins, coordinates=("x", "theta"))


class Way(Bench):
    """A test whose commands leave as they are asked for."""

    def __init__(self, size: float = 1.0, **changes: Any) -> None:
        control: dict[str, Any] = {
            "kinematics": coupler(),
            "lead_enabled": False,
            "axes": tuple(AxisConfig(name, rest_spread_m=1.0) for name in NAMES),
        }
        given: dict[str, Any] = {
            "path_velocity_m_per_s": VELOCITY * size,
            "path_acceleration_m_per_s2": ACCELERATION * size,
            "brake_acceleration_m_per_s2": BRAKE * size,
        }
        super().__init__(config(control, **given | changes), plant=rig(coupler()))
        self.size = size

    @property
    def core(self) -> Any:
        return self.station._c

    def held(self) -> Way:
        self.running(100)
        self.step("hold")
        while self.core.leg != 1:
            self.step()
        return self

    def go(self, where: str, share: float = 1.0) -> None:
        """RESUME to a place far from where the test was left; ends after this share of the way."""
        for j, far in enumerate(FAR[where]):
            self.core.resume[j][0] = far
            self.core.resume[j][1] = self.core.resume[j][2] = 0.0
        assert not self.step("resume").refused
        for _ in range(int(share * self.core.path[0].ticks) - 2):
            self.step()

    def assert_rates(self, since: int, acceleration: float, velocity: float = np.inf) -> None:
        """From command to command, of every axis."""
        step = np.diff(self.commands(since), axis=0)
        assert abs(step).max() / H <= velocity * self.size * ROUNDING
        assert abs(np.diff(step, axis=0)).max() / H**2 <= acceleration * self.size * ROUNDING + 1e-9


@WHERE
@SIZES
def test_resume_keeps_to_the_path_limits_of_every_axis(size: float, where: str) -> None:
    way = Way(size).held()
    since = len(way.sent)
    way.go(where)
    way.assert_rates(since, ACCELERATION, VELOCITY)


@WHERE
@SIZES
def test_the_way_back_keeps_to_the_path_limits_of_every_axis(size: float, where: str) -> None:
    way = Way(size).held()
    way.go(where)
    way.step("stop")
    while way.core.leg == 0:
        way.step()
    since = len(way.sent)
    ticks = way.until("IDLE")
    way.assert_rates(since, ACCELERATION, VELOCITY)
    assert abs(way.commands()[-1]).max() < 2e-6
    # No longer than it takes the slower axis, in the steps in which a way is found.
    longest = abs(way.commands(since)[0]).max()
    assert ticks * H < 1.6 * (1.875 * longest / (VELOCITY * size)) + 0.2


@WHERE
@SIZES
def test_a_hold_half_way_brakes_every_axis_within_its_limit(size: float, where: str) -> None:
    way = Way(size).held()
    way.go(where, share=0.5)
    since = len(way.sent)
    way.step("hold")
    while way.core.leg != 1:
        way.step()
    way.assert_rates(since, BRAKE)


@WHERE
@SIZES
def test_the_ramp_in_keeps_to_the_path_limits_of_every_axis(size: float, where: str) -> None:
    """However short the file asks it to be."""
    way = Way(size, ramp_in_ticks=1)
    way.step()
    way.step("zero")
    way.until("ZEROED")
    way.step("arm")
    axes, _ = coupler().axes(np.array([FAR[where]]))
    for k in (0, 1):
        way.core.controller.axis[k].x_cmd = axes[0][k]
    since = len(way.sent)
    assert not way.step("start").refused
    while way.station.state == "RAMP_IN":
        way.step()
    way.assert_rates(since, ACCELERATION, VELOCITY)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_place_that_is_no_number_leads_nowhere(value: float) -> None:
    way = Way().held()
    way.core.resume[1][0] = value
    way.step("resume")
    for _ in range(2000):
        way.step()
    assert np.isfinite(way.commands()).all()
    assert abs(way.commands()).max() < 10.0
