"""Moving the actuator a little, at limited speed and within all limits of the rig file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rthyb_rt.lab import experiment, realtime
from rthyb_rt.rig.commissioning import polarity, sensor_checks
from rthyb_rt.rig.commissioning.guided_motion import (
    GENTLE_M_PER_S,
    Connection,
    GuidedMotion,
    carry_out,
    check_distance,
    check_limits,
    eased,
    path_figures,
    with_rests,
)


@dataclass(frozen=True)
class Jogged:
    """Result of a jog; displacements and forces are calibrated, not tared, and of the structure.

    Attributes:
        asked_m, speed_m_per_s: what was requested.
        start_m, end_m, start_n, end_n: readings at rest before and after the jog.
        stiffness_n_per_m: change of force over change of displacement; None if either is too small.
        state, cause, end_reason: how it ended, as in a recording.
        sensors: change of each sensor without an actuator and the one expected, by its name, m or
            N.
        faults: what is wrong with sensors or command, with the remedy.
        reversed: whether a sign is wrong, see
            `rthyb_rt.rig.commissioning.polarity.PolarityVerdict`.
    """

    asked_m: float
    speed_m_per_s: float
    start_m: float
    end_m: float
    start_n: float
    end_n: float
    stiffness_n_per_m: float | None
    state: str
    cause: str
    end_reason: str
    faults: tuple[str, ...]
    reversed: bool
    sensors: dict[str, Any] = field(default_factory=dict)

    @property
    def moved_m(self) -> float:
        """Distance travelled, signed."""
        return self.end_m - self.start_m

    def as_json(self) -> dict[str, Any]:
        """Return all values by name."""
        return {**self.__dict__, "moved_m": self.moved_m, "faults": list(self.faults)}


def jog(
    connection: Connection,
    distance_m: float,
    speed_m_per_s: float = GENTLE_M_PER_S,
    *,
    operator: realtime.Operator | None = None,
    progress: experiment.Progress | None = None,
) -> Jogged:
    """Move by a signed distance and stay there.

    The position limit counts from where the actuator is now, the force limit from zero load. On a
    stop the actuator decelerates and stays where it comes to rest. Ranges and limits of sensors
    without an actuator act as in a test.

    Args:
        connection: the rig.
        distance_m: signed, in the coordinates of the structure.
        speed_m_per_s: greatest speed on the way.
        operator, progress: as in `rthyb_rt.rig.commissioning.guided_motion.carry_out`.

    Raises:
        InputError: the rig file has no limit on position or force, or there is no feedback.
        RefusedError: too far, too fast, or the actuator is where the motion cannot begin.
        RthybError: something else failed; the motion has been stopped.
    """
    check_limits(connection.rig)
    check_distance(connection.rig, distance_m)
    velocity, acceleration = path_figures(connection.rig)
    if not 0.0 < speed_m_per_s <= velocity:
        raise realtime.RefusedError(
            f"{speed_m_per_s * 1e3:g} mm/s is too fast for a jog on this rig: at most "
            f"{velocity * 1e3:g} mm/s is allowed (by limits.path_velocity_m_per_s and half of "
            "what its other limits leave for the command)"
        )
    rate = connection.rig.rate
    path = with_rests(eased(distance_m, speed_m_per_s, acceleration, rate), rate=rate)
    moved = carry_out(connection, GuidedMotion("jog", path), operator=operator, progress=progress)
    verdict = polarity.judge(connection.rig, moved)
    # A motion that had barely begun reveals nothing about signs.
    conclusive = abs(moved.commanded_m) > moved.certain("x_meas_m")
    sensors, wrong = sensor_checks.by_motion(connection.rig, moved, must_show=False)
    # A motion that a sensor has ended early shows little about the axis itself.
    of_axis = () if moved.ended_by_sensor else verdict.faults
    faults = of_axis or tuple(wrong)
    return Jogged(
        asked_m=distance_m,
        speed_m_per_s=speed_m_per_s,
        start_m=moved.start_m,
        end_m=moved.start_m + moved.moved_m,
        start_n=moved.start_n,
        end_n=moved.start_n + moved.change_n,
        stiffness_n_per_m=verdict.stiffness_n_per_m,
        state=moved.state,
        cause=moved.cause,
        end_reason=moved.end_reason,
        faults=faults if conclusive else (),
        reversed=conclusive and verdict.reversed,
        sensors=sensors,
    )
