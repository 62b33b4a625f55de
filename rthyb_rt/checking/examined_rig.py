"""The check of a rig without a test: what its file alone says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from rthyb_rt import config, core
from rthyb_rt.checking import cell_corrections, check_tables, facts
from rthyb_rt.config import STANDARD_HZ, AxesRig, Identified, RigFile, response
from rthyb_rt.config.linkframes import on_one_bus
from rthyb_rt.config.lonesensors import LoneForce
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_rig, axis_wires, experiment, sensor_wires
from rthyb_rt.numbers import delay, number, quantity

Rows = list[tuple[str, str, str]]

SCHEMA: Final = "rthyb-check-rig/1"


@dataclass(frozen=True)
class ExaminedAxis:
    """A rig of one axis, or one axis of several.

    Attributes:
        name: of the axis; "" for a rig of one axis.
        rig: the axis as a rig of its own.
        actuator: its kind, or what the plant of all axes is.
        k_e_n_per_m: stiffness that it moves against; None if the rig file does not state it.
        limits: those that the rig file states.
        link, commissioning: None without a link.
        factors: calibration factors.
    """

    name: str
    rig: RigFile
    actuator: str
    k_e_n_per_m: float | None
    limits: list[dict[str, Any]]
    link: dict[str, Any] | None
    commissioning: dict[str, Any] | None
    factors: dict[str, float]

    def rows(self) -> Rows:
        """Return all rows: quantity, value, explanation."""
        where = "with the other axes at rest" if self.name else "k_e of the specimen"
        k_e = quantity(self.k_e_n_per_m, "kN/m", 1e-3, 4)
        return [
            (f"Axis {self.name}" if self.name else "Actuator", self.actuator, ""),
            ("Elastic stiffness", k_e, where if self.k_e_n_per_m else "not identified"),
            *_identified_rows(self.rig.identified),
            *check_tables.link_rows(self.link),
            *check_tables.commissioning_rows(self.commissioning),
            *check_tables.calibration_rows(self.factors),
            *check_tables.limit_rows(self.limits, linked=self.link is not None),
        ]

    def document(self) -> dict[str, Any]:
        """Return the same as plain values."""
        found = self.rig.identified
        return {
            "actuator": self.actuator,
            "elastic_stiffness_n_per_m": self.k_e_n_per_m,
            "identified": None if found is None else found.model_dump(),
            "limits": self.limits,
            "link": self.link,
            "commissioning": self.commissioning,
            "calibration": self.factors,
        }

    def notes(self) -> list[str]:
        """Return what a test on this axis must provide, or can do without."""
        found = self.rig.identified
        if found is None:
            return ["nothing is identified: run `rthyb identify RIG`, or state alpha0 in each test"]
        swept = max(found.frequency_hz, default=0.0)
        if not swept:
            return [
                "no frequency response is identified, so the roots and margins of a test's loop "
                f"cannot be computed: {response.REMEDY}"
            ]
        if swept < response.TOP_HZ:
            known = f"the response is known up to {swept:g} Hz, and what is above cannot be checked"
            return [f"{known}: {response.REMEDY}"]
        return []

    def warnings(self) -> list[str]:
        """Return what real time will be refused for."""
        found = facts.unread_frames(self.rig.link)
        if self.commissioning is not None and self.commissioning["why_not"]:
            why_not = self.commissioning["why_not"]
            found.append(f"a test in real time will be refused: {why_not}")
        stated = {limit["key"] for limit in self.limits}
        lacking = [key for key in ("command_position_m", "force_n") if key not in stated]
        if self.link is not None and lacking:
            found.append(
                f"the rig file does not state limits.{' and limits.'.join(lacking)}: `rthyb jog` "
                "and `rthyb commission` will refuse to move the actuator"
            )
        return found


@dataclass(frozen=True)
class ExaminedRig:
    """Result of `rthyb check` for a rig without a test.

    Attributes:
        name: of the rig.
        axes: what is known of each axis.
        sensors: of those without an actuator: name, range, channel.
        notes, warnings: information, and problems that should be corrected.
    """

    name: str
    axes: tuple[ExaminedAxis, ...]
    sensors: Rows
    notes: list[str]
    warnings: list[str]

    def tables(self) -> list[Rows]:
        """Return a table for each axis, and one of the sensors: quantity, value, explanation."""
        axes = [axis.rows() for axis in self.axes]
        return [*axes, self.sensors] if self.sensors else axes

    def document(self) -> dict[str, Any]:
        """Return the result as a JSON document."""
        by_name = {axis.name: axis.document() for axis in self.axes}
        return {
            "schema": SCHEMA,
            "ok": True,
            "rig_name": self.name,
            **({"axes": by_name} if all(by_name) else by_name[""]),
            "sensors": [name.removeprefix("Sensor ") for name, _, _ in self.sensors],
            "notes": self.notes,
            "warnings": self.warnings,
        }


def examine_rig(
    rig: RigFile | AxesRig, path: Path | None, *, stiffness_stated: bool
) -> ExaminedRig:
    """Check a rig without a test.

    Args:
        rig: the rig.
        path: its file, from which its commissioning is found; None: it has none.
        stiffness_stated: whether the file states the elastic stiffness.

    Raises:
        InputError: with all inconsistencies of its values.
    """
    _try_out(rig)
    if isinstance(rig, RigFile):
        k_e = rig.rig.elastic_stiffness_n_per_m if stiffness_stated else None
        axes = [_axis("", rig, rig.actuator.kind, k_e, path)]
    else:
        k_along = np.diag(rig.along_axes())
        views = [rig.of_axis(name) for name in rig.names]
        axes = [
            _axis(
                name,
                view,
                rig.actuator_of(name),
                float(k),
                path,
                [views[j] for j in on_one_bus(rig, i)],
            )
            for i, (name, view, k) in enumerate(zip(rig.names, views, k_along, strict=True))
        ]
    return ExaminedRig(
        rig.rig.name,
        tuple(axes),
        _sensor_rows(rig) if isinstance(rig, AxesRig) else [],
        config.omitted(rig)
        + (rig.notes if isinstance(rig, AxesRig) else [])
        + [_of(axis, text) for axis in axes for text in axis.notes()],
        [_of(axis, text) for axis in axes for text in axis.warnings()]
        + (cell_corrections.warnings(rig) if isinstance(rig, AxesRig) else []),
    )


def _axis(
    name: str,
    rig: RigFile,
    actuator: str,
    k_e_n_per_m: float | None,
    path: Path | None,
    on_bus: Sequence[RigFile] = (),
) -> ExaminedAxis:
    return ExaminedAxis(
        name,
        rig,
        actuator,
        k_e_n_per_m,
        facts.limits_of_rig(rig.limits),
        facts.link_of(rig, on_bus),
        None if path is None else facts.commissioning_of(rig, str(path), name),
        facts.calibration_of(rig),
    )


def _sensor_rows(rig: AxesRig) -> Rows:
    """Return a row for each sensor without an actuator: kind and range, and what reads it."""
    rows = []
    for one, place in zip(rig.lone_sensors, rig.sensor_places, strict=True):
        if isinstance(one, LoneForce):
            kind, end, unit, factor = "force", one.range_n, "kN", 1e-3
        else:
            kind, end, unit, factor = "displacement", one.range_m, "mm", 1e3
        value = kind if end is None else f"{kind}, range {quantity(end, unit, factor)}"
        read = "in virtual time only"
        if place is not None:
            channel = rig.axis[place[0]].sensors.extra[place[1]].name
            read = f"channel {channel} of axis {rig.names[place[0]]}"
        rows.append((f"Sensor {one.name}", value, read))
    return rows


def _try_out(rig: RigFile | AxesRig) -> None:
    """Build the virtual rig, and find what the frames of the link carry."""
    if isinstance(rig, AxesRig):
        axes_rig.virtual_rig(rig, rig.rate.hz)
        if rig.link is not None:
            sensor_wires.check(rig)
    else:
        try:
            core.VirtualRig(experiment.prescribed(rig, "check", np.zeros(1)).virtual_rig)
        except core.CoreError as error:
            raise InputError(
                f"{error}; check the largest and smallest values of the file",
                f'rig "{rig.rig.name}"',
            ) from error
    if rig.link is not None:
        axis_wires.check(rig)
        for view in [rig] if isinstance(rig, RigFile) else map(rig.of_axis, rig.names):
            axis_wires.check_limit(view, view.limits)


def _of(axis: ExaminedAxis, text: str) -> str:
    return f"axis {axis.name}: {text}" if axis.name else text


def _identified_rows(found: Identified | None) -> Rows:
    """Return the rows for the results of `rthyb identify`."""
    if found is None:
        return [("Identified", "no", "")]
    when = f"identified {found.date}" if found.date else "identified"
    rows = [
        ("Delay of the rig", delay(found.alpha, STANDARD_HZ), when),
        ("Gain", number(found.gain, 4), "mean of the slow sines"),
    ]
    if found.rest_noise_displacement_m is not None and found.rest_noise_force_n is not None:
        noise_m = quantity(found.rest_noise_displacement_m, "µm", 1e6)
        noise_n = quantity(found.rest_noise_force_n, "N")
        rows.append(("Noise at rest", f"{noise_m}, {noise_n}", "standard deviation"))
    if found.frequency_hz:
        swept = f"{min(found.frequency_hz):g} to {max(found.frequency_hz):g} Hz"
        leads = "no roll-off of leads"
        if found.roll_off_hz is not None:
            leads = f"leads roll off at {found.roll_off_hz:g} Hz, below the first resonance"
        rows.append(("Response known", swept, leads))
    return rows
