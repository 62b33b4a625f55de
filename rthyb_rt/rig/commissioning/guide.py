"""The commissioning of a rig, step by step: questions, motions, verdicts, and what is recorded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core import FLAGS
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.rig.commissioning import limit_checks, polarity, sensor_checks, stops
from rthyb_rt.rig.commissioning.certificate import STEPS, Certificate, CheckedStep, now, rig_hash
from rthyb_rt.rig.commissioning.guided_motion import (
    ATTEMPTS,
    Connection,
    GuidedMotion,
    MotionResult,
    Rows,
    bring_back,
    check_distance,
    check_limits,
    fresh,
    undisturbed,
)

REST_S: Final = 2.0
"""How long the rig is observed at rest."""
FRESH_SHARE: Final = 0.98
"""Least share of the ticks that must have new feedback for the link check to pass."""
RATE_TOLERANCE: Final = 0.01

_PANEL: Final = "release the drive at its own panel, because its frames have no reset command"


@dataclass(frozen=True)
class CommissioningSettings:
    """Settings of a commissioning.

    Attributes:
        steps: of `rthyb_rt.rig.commissioning.certificate.STEPS`, carried out in that order.
        distance_m: amplitude of the small motions, in the coordinates of the structure.
        allowed: asks the operator before each motion; if it returns False, the motion is skipped.
        tell: prints a line for the operator.
        witness: asks the operator about what no frame reports; None if no operator is present.
    """

    steps: Sequence[str] = STEPS
    distance_m: float = 1e-3
    allowed: Callable[[str], bool] = lambda _: True
    tell: Callable[[str], None] = lambda _: None
    witness: Callable[[str], bool | None] = lambda _: None


def commission(
    connection: Connection,
    plan: CommissioningSettings,
    known: Certificate | None = None,
    keep: Callable[[Certificate], None] = lambda _: None,
    axis: str = "",
) -> Certificate:
    """Carry out the steps of a plan, and end early if the link or the polarity check fails.

    Args:
        connection: the rig.
        plan: the settings.
        known: a certificate that is valid for this rig file; its other steps are kept.
        keep: called with the certificate after every step.
        axis: name of the axis, for a rig of several; otherwise "".

    Returns:
        The certificate with the steps that were carried out. A step that was not allowed is absent
        or unchanged.

    Raises:
        InputError: the rig file has no limit on position or force.
        RefusedError: the distance is more than the rig's limits allow.
        RthybError: a motion failed for a reason other than the one being checked.
    """
    check_limits(connection.rig)
    _check_room(connection, plan)
    rig = connection.rig
    # The operator confirms each motion and knows why the drive stopped: most often by a check.
    connection = replace(connection, resets=True)
    certificate = known or Certificate(
        rig_name=rig.rig.name,
        rig_hash=rig_hash(rig, axis),
        virtual=rig.link is None or rig.link.virtual,
        link=connection.opened.name,
        sample_rate_hz=rig.rate.whole_hz,
    )
    for name in (name for name in STEPS if name in plan.steps):
        step = _MADE[name](connection, plan)
        if step is None:
            plan.tell(f"{name}: skipped")
            continue
        certificate = certificate.with_step(step)
        keep(certificate)
        _print_step(plan, step)
        if not step.passed and name in ("link", "polarity"):
            plan.tell("the following steps depend on this one: correct the fault, then start again")
            break
    return certificate


def _check_room(connection: Connection, plan: CommissioningSettings) -> None:
    """Refuse motions that would go beyond the rig's position limit.

    With sensors without an actuator, one of them leads from one side of the position at the start
    to the other, and a limit counts from where a motion begins.

    Raises:
        RefusedError: states how far is allowed.
    """
    check_distance(connection.rig, plan.distance_m)
    limit, whole_m = connection.rig.limits.command_position_m, 2.0 * abs(plan.distance_m)
    to_both_sides = "polarity" in plan.steps and _has_sensors(connection)
    if not to_both_sides or limit is None or not limit.acts or whole_m <= limit.value:
        return
    shown = f"{abs(plan.distance_m) * 1e3:g} mm"
    raise RefusedError(
        f"a distance of {shown} is too large: to compare the sensors without an actuator, the "
        f"actuator moves from {shown} on one side to {shown} on the other, which is "
        f"{whole_m * 1e3:g} mm in one motion, and limits.command_position_m allows "
        f"{limit.value * 1e3:g} mm; choose a distance of at most {limit.value * 0.5e3:g} mm"
    )


def _print_step(plan: CommissioningSettings, step: CheckedStep) -> None:
    words = {True: "passed", False: "FAILED", None: "could not be checked"}[step.passed]
    plan.tell(f"{step.name}: {words}")
    for fault in step.faults:
        plan.tell(f"  {fault}")


# ---- link ---------------------------------------------------------------------------------------


def _link(connection: Connection, plan: CommissioningSettings) -> CheckedStep | None:
    if not plan.allowed(
        "Before you agree, reduce the hydraulic pressure, or the drive's current limit, and limit "
        "the free travel: if displacement and command disagree on the wire, the drive jumps as "
        "soon as commands are sent. Send commands that hold the drive where it is?"
    ):
        return None
    # Lost pairs are counted and judged below, not tolerated silently.
    counted = {"lost_pairs": core.Watch(1.0 - FRESH_SHARE, "indicate")}
    rest = GuidedMotion("rest", np.zeros(connection.rig.rate.ticks(REST_S)), counted)
    try:
        moved = undisturbed(connection, rest)
    except InputError as error:
        return CheckedStep("link", False, now(), faults=(str(error),))
    figures: dict[str, Any] = rest_figures(moved)
    faults = []
    if moved.cause != "completed":
        faults.append(f"the rig did not stay at rest: {moved.end_reason}")
    if figures["fresh_share"] < FRESH_SHARE:
        faults.append(
            f"{100 * figures['fresh_share']:.1f} % of the ticks had a new pair of displacement "
            f"and force; at least {100 * FRESH_SHARE:g} % must have one; check the wiring and the "
            "drive's sample rate"
        )
    setup = experiment.prescribed(connection.rig, rest.name, rest.path_m)
    spread_m = setup.derived.limits.rest_spread_m
    if abs(figures["jump_m"]) > spread_m:
        after = figures["displacement_m"]
        faults.append(
            f"the displacement went from {1e3 * (after - figures['jump_m']):.4g} mm to "
            f"{1e3 * after:.4g} mm when commands began, although it was commanded to hold: "
            "displacement and command disagree; check both in [calibration], starting with offset_m"
        )
    sensors, missing = sensor_checks.at_rest(connection.rig, moved)
    if sensors:
        figures["sensors"] = sensors
    faults += missing
    rate = figures["rate_hz"]
    wanted_hz = connection.rig.rate.hz
    if rate is not None and abs(rate / wanted_hz - 1.0) > RATE_TOLERANCE:
        faults.append(
            f"the drive sends {rate:.1f} samples per second, but {wanted_hz:g} are needed"
        )
    return CheckedStep("link", not faults, now(), figures, tuple(faults))


def rest_figures(moved: MotionResult) -> dict[str, Any]:
    """Return what a motion that stays at rest reveals about the link and the sensors."""
    rows = moved.running
    executed = rows[(rows["flags"] & FLAGS["blind"]) == 0]
    received = executed[fresh(executed)]
    delay = moved.facts["link_delay_samples"]
    return {
        "link": moved.facts["link"],
        # Of the axis itself, whether or not every sensor beside it had a reading.
        "fresh_share": np.count_nonzero(executed["missing"] == 0) / max(executed.size, 1),
        "rate_hz": _rate(received),
        "link_delay_samples": None if delay < 0 else delay,
        "slips": int(np.count_nonzero(rows["flags"] & FLAGS["slip"])),
        "displacement_m": moved.start_m,
        "jump_m": moved.start_m - float(moved.rows[fresh(moved.rows)]["x_meas_m"][0]),
        "force_n": moved.start_n,
        "noise_m": float(received["x_meas_m"].std()) if received.size else None,
        "noise_n": float(received["f_meas_n"].std()) if received.size else None,
        "skipped_ticks": int(rows.size - executed.size),
    }


def _rate(received: Rows) -> float | None:
    """Return the drive's samples per second of this PC's clock, by the drive's own counter."""
    if received.size < 2:
        return None
    counts: NDArray[np.int64] = received["count"].astype(np.int64)
    steps = (counts[1:] - counts[:-1]) % 256
    lasted_s = (int(received["due_ns"][-1]) - int(received["due_ns"][0])) * 1e-9
    return float(steps.sum() / lasted_s)


# ---- polarity -----------------------------------------------------------------------------------


def _polarity(connection: Connection, plan: CommissioningSettings) -> CheckedStep | None:
    if not plan.allowed(_polarity_question(connection, plan.distance_m)):
        return None
    moved = undisturbed(connection, limit_checks.small_motion(connection.rig, plan.distance_m))
    verdict = polarity.judge(connection.rig, moved)
    # A motion that a sensor has ended early shows little about the axis itself.
    faults = [] if moved.ended_by_sensor else list(verdict.faults)
    if moved.cause != "completed":
        faults.append(f"the motion did not finish: {moved.end_in_figures}")
    figures: dict[str, Any] = {
        "commanded_m": moved.commanded_m,
        "moved_m": moved.moved_m,
        "slope": verdict.slope,
        "force_change_n": moved.change_n,
        "stiffness_n_per_m": verdict.stiffness_n_per_m,
    }
    sensors, wrong = sensor_checks.by_motion(
        connection.rig, moved, must_show=not moved.ended_by_sensor
    )
    if sensors:
        figures["sensors"] = sensors
    # If the axis itself moved the wrong way, its sensors cannot be judged by it.
    if verdict.good or moved.ended_by_sensor:
        faults += wrong
    # A sensor that is at fault must not prevent the return.
    at_fault = bool(wrong or moved.ended_by_sensor)
    if sensors and not faults:
        figures["sensors"], faults = _other_way(connection, plan.distance_m, sensors)
        at_fault = bool(faults)
    bring_back(connection, moved, with_sensors=not at_fault)
    return CheckedStep("polarity", not faults, now(), figures, tuple(faults))


def _polarity_question(connection: Connection, distance_m: float) -> str:
    shown = f"{distance_m * 1e3:g} mm"
    if not _has_sensors(connection):
        return f"Move by {shown} and back, at 1 mm/s, to see both signs?"
    return (
        f"Move by {shown} at 1 mm/s, then faster to {-distance_m * 1e3:g} mm, and back, to see "
        "both signs, and which sensors without an actuator read too late?"
    )


def _has_sensors(connection: Connection) -> bool:
    common = connection.rig.one_of
    return common is not None and bool(common.sensors)


def _other_way(
    connection: Connection, distance_m: float, there: dict[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Move as far to the other side, faster, and judge the sensors without an actuator again.

    A reading that is the same on both sides has changed as it should on one of them; and one that
    is late has changed as it should once everything is at rest.

    Returns:
        The figures of both motions, and what is wrong. The axis is then where it began.
    """
    motion = limit_checks.brisk_motion(connection.rig, -2.0 * distance_m)
    moved = undisturbed(connection, motion)
    faults = []
    if moved.cause != "completed":
        faults.append(f"the motion to the other side did not finish: {moved.end_in_figures}")
    back, wrong = sensor_checks.by_motion(
        connection.rig, moved, must_show=not moved.ended_by_sensor, timely=True
    )
    bring_back(connection, moved, with_sensors=not (wrong or moved.ended_by_sensor))
    return sensor_checks.both_ways(there, back), faults + wrong


# ---- limits -------------------------------------------------------------------------------------


def _limits(connection: Connection, plan: CommissioningSettings) -> CheckedStep | None:
    if connection.rig.limits.command_velocity_m_per_s is None:
        plan.tell(
            "limits.command_velocity_m_per_s is missing in the rig file: each test will be "
            "limited to a velocity derived from its own reference simulation; it is better to "
            "state a limit for this rig"
        )
    checks = limit_checks.check_all(connection, plan.distance_m, plan.allowed)
    if all(check.reason == "not allowed" for check in checks):
        return None
    faults = [f"limits.{check.key} {check.fault}" for check in checks if check.fault]
    faults += [
        f"limits.{check.key} was not tried" for check in checks if check.reason == "not allowed"
    ]
    figures = {
        "checked": [check.as_json() for check in checks if not check.reason],
        "not_checked": {check.key: check.reason for check in checks if check.reason},
    }
    return CheckedStep("limits", not faults, now(), figures, tuple(faults))


# ---- the drive's own stop -----------------------------------------------------------------------


def _watchdog(connection: Connection, plan: CommissioningSettings) -> CheckedStep | None:
    codec = connection.opened.codec
    after = "is reset" if codec.has_reset else "is released at its own panel"
    allowed = stops.watchdog_ticks(connection)
    if not plan.allowed(
        f"Stop sending, at rest? The drive should stop by itself after {allowed} of its "
        f"samples and stay stopped, even when commands resume, until it {after}."
    ):
        return None
    stop = stops.watchdog(connection)
    if not codec.has_status:
        return _witnessed(
            plan,
            "watchdog",
            "The commands stopped and resumed. Did the drive stop by itself, and does its "
            "panel show that it stays stopped until it is released there?",
        )
    faults = []
    if not stop.stopped:
        faults.append(
            "the drive did not report a stop although it received no more commands: its watchdog "
            "does not work, and nothing would stop the drive if this PC failed; do not use this "
            "drive"
        )
    else:
        faults += _late(stop, allowed, "its last command")
        faults += _follows_again(stop)
    if stop.stays and not codec.has_reset:
        plan.tell(f"  {_PANEL}")
    figures = {"drive_ticks": stop.ticks, "stays_stopped": stop.stays, "reset": stop.released}
    return CheckedStep("watchdog", not faults, now(), figures, tuple(faults))


def _follows_again(stop: stops.Stop) -> list[str]:
    """Return what is wrong with a drive that resumes unasked, or does not resume when reset."""
    if stop.seen_again is False:
        return ["the drive no longer reported that it had stopped when commands resumed"]
    if stop.stays is False:
        return [
            "the drive followed again as soon as it received commands, although nobody had "
            "reset it: after a crash of this PC it would follow any command; configure it to "
            "wait for a reset, or for a release at its own panel"
        ]
    if stop.released is False:
        return [
            "the drive did not leave its stop after a reset command: check how it handles frames "
            "with the state RESET (docs/wire.md)"
        ]
    return []


def _trip(connection: Connection, plan: CommissioningSettings) -> CheckedStep | None:
    if not plan.allowed("Trip, at rest? The drive should stop at once."):
        return None
    stop = stops.trip(connection)
    codec = connection.opened.codec
    if not codec.has_status:
        return _witnessed(plan, "trip", "The drive was sent TRIPPED. Did it stop at once?")
    faults = []
    if not stop.stopped:
        faults.append("the drive did not report a stop when it was sent TRIPPED")
    else:
        faults += _late(stop, stops.TRIP_TICKS, "the command with the state TRIPPED")
    if codec.has_reset:
        stops.release(connection)
    elif stop.stopped:
        plan.tell(f"  {_PANEL}")
    return CheckedStep("trip", not faults, now(), {"drive_ticks": stop.ticks}, tuple(faults))


def _late(stop: stops.Stop, allowed: int, since: str) -> list[str]:
    if stop.ticks is None and not stop.gap:
        return []
    if stop.gap or stop.ticks is None:
        return [f"frames were lost around the stop, {ATTEMPTS} times: check the wiring"]
    if stop.ticks <= allowed:
        return []
    return [
        f"the drive stopped {stop.ticks} of its samples after {since}; at most {allowed} are "
        "allowed"
    ]


def _witnessed(plan: CommissioningSettings, name: str, question: str) -> CheckedStep:
    """Return what the operator has seen of a drive whose frames contain no status."""
    seen = plan.witness(question)
    plan.tell(f"  {_PANEL}")
    faults = {
        True: (),
        False: ("according to the operator it did not; do not use it",),
        None: (
            "the drive's frames have no status, so that its stop cannot be detected here, and "
            "nobody was asked: make this check in a terminal, without --yes",
        ),
    }[seen]
    return CheckedStep(name, seen, now(), {} if seen is None else {"seen_by": "operator"}, faults)


_MADE: Final[dict[str, Callable[[Connection, CommissioningSettings], CheckedStep | None]]] = {
    "link": _link,
    "polarity": _polarity,
    "limits": _limits,
    "watchdog": _watchdog,
    "trip": _trip,
}
