"""The tare in words: what it subtracts, and why it did not end."""

from __future__ import annotations

from typing import Any

from rthyb_rt import numbers
from rthyb_rt.config.lonesensors import LoneForce
from rthyb_rt.lab import trips
from rthyb_rt.lab.end_reasons import REMEDIES, WORDS
from rthyb_rt.lab.runs import Run


def tares(run: Run) -> dict[str, Any]:
    """Return the offsets that zeroing subtracts from the readings.

    ``displacement_m`` and ``force_n``; with several axes those of the first, under ``axes`` those
    of each by its name, and under ``sensors``, if there are any, those of the sensors without an
    actuator, each with one of the two.
    """
    names, station = run.setup.axis_names, run.station
    x_m, f_n = station.tare
    found: dict[str, Any] = {"displacement_m": x_m, "force_n": f_n}
    if names:
        found["axes"] = {
            name: {"displacement_m": own_m, "force_n": own_n}
            for name, (own_m, own_n) in zip(names, station.tares, strict=True)
        }
    if sensors := _of_sensors(run):
        found["sensors"] = {
            name: {"force_n" if of_force else "displacement_m": value}
            for name, of_force, value in sensors
        }
    return found


def in_words(run: Run) -> str:
    """Return the tare in words."""
    return numbers.tare_of_status(tares(run))


def _of_sensors(run: Run) -> list[tuple[str, bool, float]]:
    """Return name, whether it is a load cell, and tare of each sensor without an actuator."""
    return [
        (one.name, isinstance(one, LoneForce), value)
        for one, value in zip(run.setup.sensors, run.station.sensor_tares, strict=True)
    ]


def refused(run: Run) -> str:
    """Return in words why the tare was refused; "" if an axis moved, or if it was not refused."""
    if not run.station.zeroing_failed:
        return ""
    if run.station.refusal[0] == "no_pose":
        return f"{WORDS['no_pose']}. {REMEDIES['no_pose']}"
    if run.station.tare_too_large:
        return _too_large(run)
    if run.station.refusal[0] in ("sensor_stuck", "force_stuck"):
        return _frozen(run)
    sensor = run.station.refusal_sensor
    if sensor is None:
        return ""
    name, (cause, value, limit) = trips.sensor_of(run.config, sensor), run.station.refusal
    if cause == "none":
        return restless(run, f" of {name}", value, limit)
    if cause in ("position", "force"):
        key = "range_m" if cause == "position" else "range_n"
        return (
            f"{run.refusal_in_figures}; the limit is the end of its range ({key} in the rig file), "
            "and zeroing needs a reading within it: bring the specimen to rest without load, or "
            "check the sensor"
        )
    return f"{run.refusal_in_figures}. {REMEDIES['sensor_lost']}"


def _frozen(run: Run) -> str:
    (cause, count, _), axis = run.station.refusal, run.station.refusal_axis
    sensor = run.station.refusal_sensor
    whose = trips.whose(axis, None, run.setup.axis_names, ())
    what, of = "its reading", "it"
    if sensor is not None:
        whose = trips.sensor_of(run.config, sensor)
    elif cause == "sensor_stuck":
        what, of = "the displacement", "its sensor"
    else:
        what, of = "the force", "its load cell"
    return (
        f"{whose}: {what} was exactly the same in {count:.0f} readings in a row, which the noise "
        f"that the rig file states for {of} rules out: the reading is frozen; check the sensor, "
        "its amplifier and its cable, or correct the noise in the rig file"
    )


def restless(run: Run, whose: str, spread_m: float, allowed_m: float) -> str:
    """Return in words that a displacement moved during the tare.

    Args:
        run: the station and its log.
        whose: axis or sensor after a space, in words; "" for a single axis.
        spread_m, allowed_m: by how much its readings varied, and by how much they may.
    """
    return (
        f"the rig is not at rest: the displacement{whose} moved by {spread_m * 1e3:.3g} mm "
        f"during the tare of {run.config.tare_ticks / run.setup.rate.hz:g} s, but at most "
        f"{allowed_m * 1e3:.3g} mm is allowed (limits.rest_spread_m); wait until it is at "
        "rest, or check its sensor"
    )


def _too_large(run: Run) -> str:
    (cause, value, limit), sensor = run.station.refusal, run.station.refusal_sensor
    share = 100 * run.setup.derived.limits.tare_share_most
    name, unit, factor = ("force", "kN", 1e-3)
    if cause == "rig_position":
        name, unit, factor = ("displacement", "mm", 1e3)
    of, part = "", "of the rig's limit (limits.tare_share_most)"
    remedy = f"the sensor and calibration.{name} in the rig file"
    if sensor is not None:
        of = f" of {trips.sensor_of(run.config, sensor)}"
        part = (
            f"of what it reads, by its along, if every axis is at the rig's limit of its {name} "
            "(limits.tare_share_most)"
        )
        remedy = "the sensor"
    return (
        f"the tare of the {name}{of} would be {value * factor:.3g} {unit}, but at most "
        f"{limit * factor:.3g} {unit} is allowed, {share:g} % {part}; bring the specimen to rest "
        f"without load, or check {remedy}"
    )


def silent_sensors(run: Run) -> str:
    """Return the sensors without an actuator that give no usable reading, in words; "": none."""
    station = run.station
    return "; ".join(
        f"{trips.sensor_of(run.config, k)}: no usable reading for {numbers.count(ticks, 'tick')}"
        + (", because its channel has no number" if no_number else _at_end(run, k, end))
        for k, (ticks, end, no_number) in enumerate(
            zip(
                station.sensors_missing,
                station.sensors_at_end,
                station.sensors_without_number,
                strict=True,
            )
        )
        if ticks
    )


def _at_end(run: Run, sensor: int, reading: float | None) -> str:
    """Return in words that a sensor reads a value at the end of its range; "" if it does not."""
    if reading is None:
        return ""
    of_force = isinstance(run.setup.sensors[sensor], LoneForce)
    unit, factor, key = ("kN", 1e-3, "range_n") if of_force else ("mm", 1e3, "range_m")
    range_ = run.config.sensors[sensor].range
    return (
        f", because it reads {numbers.quantity(reading, unit, factor, 4)}, at or beyond the end of "
        f"its range of {numbers.quantity(range_, unit, factor)} ({key} in the rig file)"
    )
