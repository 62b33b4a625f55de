"""Each limit of the rig file is lowered, then provoked by a small motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from rthyb_rt import core
from rthyb_rt.config import Limit, RigFile
from rthyb_rt.config import limits as limits_file
from rthyb_rt.core import FLAGS
from rthyb_rt.lab.experiment import WATCHES
from rthyb_rt.rig.commissioning.guided_motion import (
    GENTLE_M_PER_S,
    Connection,
    Floats,
    GuidedMotion,
    MotionResult,
    Rows,
    bring_back,
    check_distance,
    eased,
    fresh,
    path_figures,
    undisturbed,
    with_rests,
)

ACCELERATION: Final = "command_acceleration_m_per_s2"
STUCK: Final = "sensor_stuck_s"

_NOT_PROVOKED: Final = {
    STUCK: "needs a sensor that freezes while the actuator moves; unplug it during a jog, with "
    "nobody near the rig",
    "force_stuck_s": "needs a load cell that freezes while the actuator moves",
    "force_jump_n": "needs a load cell that jumps",
    "lost_pairs_share": "needs a link that loses pairs",
    "lost_pairs_warning_share": "needs a link that loses pairs",
    "skipped_ticks_share": "needs a PC that is late",
    "skipped_ticks_warning_share": "needs a PC that is late",
}
_SHARE: Final = 0.5
"""Lowered limits are set to this share of the peak of the small motion."""
_SHARE_OF_ACCELERATION: Final = 0.9
"""The same for acceleration: a command with much less than its path needs overshoots far."""
_BARELY: Final = 1.02
_BRISK: Final = 0.1
_QUANTUM: Final = "quantum"
"""Key beside those of the limits: step of a command on the wire, in m of the structure."""
_LEAST_STEPS: Final = 40.0
"""Steps of the wire per sample^2 that an acceleration must exceed to be limited evenly."""
_APART: Final = 64
"""Ticks over which an acceleration is taken: with steps of 1 nm, fewer do not resolve it."""
_SLOPE_S: Final = 0.25
"""Time over which the station takes the slope of the tracking indicator."""


@dataclass(frozen=True)
class LimitCheck:
    """Result of the check of one limit.

    Attributes:
        key: of the rig file's ``[limits]``.
        action: what the rig file demands; "limit" for a limit that bounds the command.
        value: the value to which it was lowered, in the unit of the key; None if not checked.
        seen: the reaction, as named by the station.
        fault: what is wrong, or "".
        reason: why it was not checked, or "".
    """

    key: str
    action: str
    value: float | None = None
    seen: str = ""
    fault: str = ""
    reason: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the fields that are set, by name."""
        return {name: value for name, value in self.__dict__.items() if value not in (None, "")}


def configured(rig: RigFile) -> list[tuple[str, str]]:
    """Return key and action of every active limit of a rig file, in its order."""
    found: list[tuple[str, str]] = []
    for key in limits_file.Limits.model_fields:
        value = getattr(rig.limits, key)
        if isinstance(value, Limit) and value.acts:
            found.append((key, value.action))
        bounds = isinstance(value, limits_file.VelocityLimit) and value.enable and not value.acts
        if bounds or (key == ACCELERATION and value is not None):
            found.append((key, "limit"))
    return found


def small_motion(rig: RigFile, distance_m: float) -> GuidedMotion:
    """Return the motion that provokes limits.

    Raises:
        RefusedError: it exceeds the rig's own position limit.
    """
    check_distance(rig, distance_m)
    velocity, acceleration = path_figures(rig)
    way = eased(distance_m, min(velocity, GENTLE_M_PER_S), acceleration, rig.rate)
    return GuidedMotion("small-motion", with_rests(way, rate=rig.rate))


def brisk_motion(rig: RigFile, distance_m: float) -> GuidedMotion:
    """Return a motion of the same distance whose acceleration exceeds the rounding of the wire."""
    velocity, acceleration = path_figures(rig)
    way = eased(distance_m, velocity, min(acceleration, _BRISK), rig.rate)
    return GuidedMotion("brisk-motion", with_rests(way, rate=rig.rate))


def check_all(
    connection: Connection, distance_m: float, allowed: Callable[[str], bool]
) -> list[LimitCheck]:
    """Provoke every limit that can be provoked, each with its own motion and return.

    Args:
        connection: the rig.
        distance_m: amplitude of the small motion.
        allowed: asks the operator before each motion; on False the limit is not checked.

    Raises:
        RthybError: a motion failed for a reason other than the limit being checked.
    """
    wanted = configured(connection.rig)
    plain = small_motion(connection.rig, distance_m)
    # When a limit trips, the drive makes its own stop, and the next motion begins with a reset.
    connection = replace(connection, resets=True)
    if not wanted or not allowed(
        f"Move by {distance_m * 1e3:g} mm and back, well within all limits?"
    ):
        return [LimitCheck(key, action, reason="not allowed") for key, action in wanted]
    usual = undisturbed(connection, plain)
    bring_back(connection, usual)
    if usual.cause != "completed":
        words = f"the small motion ended even without it: {usual.end_reason}"
        return [LimitCheck(key, action, fault=words) for key, action in wanted]
    brisk = brisk_motion(connection.rig, distance_m)
    h = connection.rig.rate.period_s
    reached = peaks(usual.running, h) | {ACCELERATION: _largest(np.diff(brisk.path_m, 2)) / h**2}
    return [
        _check(connection, brisk if key == ACCELERATION else plain, key, action, reached, allowed)
        for key, action in wanted
    ]


def peaks(rows: Rows, h: float = core.PERIOD_S) -> dict[str, float]:
    """Return the peak of a motion for each limit, by key; rows of the motion itself, (n,).

    The command must not have been limited. ``h`` is the period of the rows, s.
    """
    taken = rows[fresh(rows)]
    command = rows["x_cmd_m"]
    return {
        "command_position_m": _largest(rows["x_plc_m"]),
        "command_velocity_m_per_s": _largest(np.diff(rows["x_plc_m"])) / h,
        "command_increment_m": _largest(np.diff(command)),
        "force_n": _largest(taken["f_meas_n"]),
        "tracking_error_m": _largest(taken["x_meas_m"] - taken["x_num_m"]),
        "tracking_indicator_slope_m2_per_s": _largest(_slopes(rows["tracking_indicator_m2"], h)),
        "energy_error_j": _largest(rows["energy_error_j"]),
        "sensor_jump_m": _largest(np.diff(taken["x_meas_m"])),
        _QUANTUM: 2.0 * _largest(command - rows["x_plc_m"]),
    }


def _largest(values: Floats) -> float:
    return float(np.abs(values).max(initial=0.0))


def _slopes(indicator: Floats, h: float) -> Floats:
    """Return the slope of the tracking indicator, smoothed as the station does it."""
    share = min(h / _SLOPE_S, 1.0)
    slope, slopes = 0.0, np.zeros(indicator.size)
    for n, rise in enumerate(np.diff(indicator) / h):
        slope += (rise - slope) * share
        slopes[n + 1] = slope
    return slopes


def _check(
    connection: Connection,
    plain: GuidedMotion,
    key: str,
    action: str,
    reached: dict[str, float],
    allowed: Callable[[str], bool],
) -> LimitCheck:
    if key in _NOT_PROVOKED:
        return LimitCheck(key, action, reason=_NOT_PROVOKED[key])
    h = connection.rig.rate.period_s
    least = _LEAST_STEPS * reached[_QUANTUM] / h**2 if key == ACCELERATION else 0.0
    if not reached[key] > least:
        return LimitCheck(
            key, action, reason="the small motion does not come close enough to this limit"
        )
    given = getattr(connection.rig.limits, key)
    share = _SHARE_OF_ACCELERATION if key == ACCELERATION else _SHARE
    value = share * min(reached[key], given if key == ACCELERATION else given.value)
    outcome = "only limit the command" if action == "limit" else _OUTCOMES[action]
    unit = limits_file.unit_of(key)
    question = f"Provoke limits.{key}, lowered to {value:.3g} {unit}? It should {outcome}."
    if not allowed(question):
        return LimitCheck(key, action, reason="not allowed")
    if action == "limit":
        moved = undisturbed(connection, _bounded(plain, key, value))
        fault = _why_not_bounded(moved, key, value, reached[_QUANTUM], h)
        seen = "command limited" if not fault else moved.end_reason
    else:
        moved = undisturbed(connection, _watched(plain, key, action, value))
        seen = f"{moved.end_reason}, {moved.state}"
        fault = _why_not_seen(moved, WATCHES[key], action)
    bring_back(connection, moved)
    return LimitCheck(key, action, value=value, seen=seen, fault=fault)


_OUTCOMES: Final = {
    "indicate": "be reported while the motion continues",
    "hold": "hold",
    "ramp-out": "ramp out, back to where it began",
    "trip": "trip; afterwards release the drive if necessary",
}


def _watched(plain: GuidedMotion, key: str, action: str, value: float) -> GuidedMotion:
    watch = core.Watch(value, action)  # type: ignore[arg-type]
    return GuidedMotion(
        f"provoke-{WATCHES[key].replace('_', '-')}",
        plain.path_m,
        watches={WATCHES[key]: watch},
        stay=False,
        whole_force=key != "force_n",
    )


def _bounded(plain: GuidedMotion, key: str, value: float) -> GuidedMotion:
    name = {
        "command_velocity_m_per_s": "velocity_limit_m_per_s",
        ACCELERATION: "acceleration_limit_m_per_s2",
    }[key]
    return GuidedMotion(f"bound-{'speed' if 'velocity' in key else 'acceleration'}", plain.path_m,
                  **{name: value})  # type: ignore[arg-type]  # fmt: skip


def _why_not_seen(moved: MotionResult, cause: str, action: str) -> str:
    """Return what is wrong with the reaction to a limit, or ""."""
    if action == "indicate":
        if cause not in moved.facts["indicated"]:
            return "was not reported"
        return "" if moved.cause == "completed" else f"ended the motion: {moved.end_reason}"
    if moved.cause != cause:
        return f"was not reached; the motion ended for another reason: {moved.end_reason}"
    needed = {"hold": "HOLD", "ramp-out": "RAMP_OUT", "trip": "TRIPPED"}[action]
    if needed not in moved.states:
        return f"did not lead to {needed}: {moved.end_reason}"
    return ""


def _why_not_bounded(
    moved: MotionResult, key: str, value: float, quantum_m: float, h: float
) -> str:
    """Return what is wrong with the bounds of a command, or ""."""
    if moved.cause != "completed":
        return f"the motion ended: {moved.end_reason}"
    rows = moved.running
    if not (rows["flags"] & FLAGS["limited"]).any():
        return "the command was not limited"
    found, rounding = _command_reached(_without_gaps(rows)["x_cmd_m"], key, quantum_m, h)
    if found > value * _BARELY + rounding:
        return f"the command still reached {found:.4g} {limits_file.unit_of(key)}"
    return ""


def _command_reached(
    command_m: Floats, key: str, quantum_m: float, h: float
) -> tuple[float, float]:
    """Return velocity or acceleration of a command as sent, and the effect of its rounding."""
    if key != ACCELERATION:
        return _largest(np.diff(command_m)) / h, quantum_m / h
    change = np.diff(command_m)
    apart = change[_APART:] - change[:-_APART]
    return _largest(apart) / (_APART * h**2), 2.0 * quantum_m / (_APART * h**2)


def _without_gaps(rows: Rows) -> Rows:
    """Return the rows after the last skipped tick: across a gap the command is held."""
    blind = np.flatnonzero(rows["flags"] & FLAGS["blind"])
    return rows[int(blind[-1]) + 2 :] if blind.size else rows
