"""One axis of a recording with several axes, for a diagnosis: its signals and its rig."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config, core
from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.config.axesfile import Rows
from rthyb_rt.config.own_tables import core_element
from rthyb_rt.config.rigfile import InertiaElement, StiffnessElement, ViscousElement
from rthyb_rt.errors import InputError
from rthyb_rt.record.mat_csv import write_columns
from rthyb_rt.record.recording import RecordedTest, replacing

Floats = NDArray[np.float64]

_SLOPE: Final = np.arange(-4, 5) / 60.0
_CURVATURE: Final = np.array([28, 7, -8, -17, -20, -17, -8, 7, 28]) / 462.0
"""First and second derivative, by the spacing, of a parabola fitted to nine points (Savitzky and
Golay 1964): 3 and 2 per cent short at 20 Hz of 1024, and a tenth and a fortieth of the noise that
differences of neighbours have."""


NOT_ALONE: Final = (
    "the model of an axis by itself, as for a diagnosis or CSV,",
    "rthyb export RECORDING --mat (or --csv --full) writes the signals of all axes",
)
"""The load cell of a redundant axis also measures by how much the actuators oppose each other."""


def axis_signals(rec: RecordedTest, name: str, rig: AxesRig | None = None) -> dict[str, Floats]:
    """Return the signals of an axis in the rows of the test proper, SI units, (n,) each.

    Args:
        rec: a recording with several axes.
        name: name of the axis.
        rig: known properties of the specimen; None: the matrices of the rig file in the recording,
            without its elements.

    Returns:
        ``t``, ``ag``, ``x_cmd`` and ``x_meas`` as recorded; ``x_num``, the command of the numerical
        part for the axis, by the kinematics; ``f_meas``, its load cell less the force that is due
        to the measured motion of the other axes, see `from_others`.

    Raises:
        InputError: there is no such axis, or the recording has only one axis.
    """
    rig = rig or _without_elements(rig_of(rec))
    rig.refuse_redundant(*NOT_ALONE)
    own, k = rec.axis(name), rec.axis_names.index(name)
    rows = rec.running()
    asked = np.column_stack(
        [rec.samples[f"x_num_m_{j}" if j else "x_num_m"][rows] for j in range(len(rec.axis_names))]
    )
    return {
        "t": rec.time_s()[rows],
        "ag": np.asarray(rec.samples["ag_mps2"][rows]),
        "x_num": rig.core_kinematics().axes(asked)[0][:, k],
        "x_cmd": np.asarray(own["x_cmd_m"][rows]),
        "x_meas": np.asarray(own["x_meas_m"][rows]),
        "f_meas": own["f_meas_n"][rows] - force_of_others(rec, name, rig),
    }


def force_of_others(rec: RecordedTest, name: str, rig: AxesRig) -> Floats:
    """Return the force on an axis that is due to the measured motion of the others, N, (n,).

    Args:
        rec: a recording with several axes; n rows belong to the test proper.
        name: name of the axis.
        rig: known properties of the specimen.
    """
    rows = rec.running()
    measured = np.column_stack([rec.axis(one)["x_meas_m"][rows] for one in rec.axis_names])
    return from_others(rig, rec.axis_names.index(name), measured, 1.0 / rec.fs_hz)


def from_others(rig: AxesRig, k: int, x_m: Floats, dt_s: float) -> Floats:
    """Return the force on an axis that is not due to its own motion, N, (n,).

    It follows from the specimen's matrices in the coordinates of the axes at rest, J^-T K J^-1 and
    so on, without their diagonals, and from the whole force of its elements.

    Args:
        rig: the rig with all axes.
        k: number of the axis.
        x_m: displacements of all axes, (n, axes).
        dt_s: interval between rows.
    """
    v, a = _derivatives(x_m, dt_s)
    total = np.zeros(x_m.shape[0])
    given = (stiffness_of(rig), rig.specimen.damping, rig.specimen.mass)
    for rows, motion in zip(given, (x_m, v, a), strict=True):
        if rows is not None:
            felt = np.array(rig.along_axes(rows)[k])
            felt[k] = 0.0
            total += motion @ felt
    back = np.linalg.inv(rig.core_kinematics().jacobian())
    for one in rig.specimen.element:
        along = back[rig.directions.index(one.along)]
        element = core.CoreElement(core_element(one.law))
        total += along[k] * element.run(x_m @ along, v @ along, a @ along, dt_s)
    return total


def alone(rig: AxesRig, name: str) -> RigFile:
    """Return an axis as a rig with one axis, with the damping and mass of its own motion.

    It is the model for the signals of `axis_signals`.

    Raises:
        InputError: there is no axis of that name.
    """
    rig.refuse_redundant(*NOT_ALONE)
    found, k = rig.of_axis(name), rig.names.index(name)

    def felt(rows: Rows | None) -> float:
        return 0.0 if rows is None else rig.along_axes(rows)[k][k]

    specimen = rig.specimen
    k_n_per_m, c_n_s_per_m = felt(stiffness_of(rig)), felt(specimen.damping)
    elements: list[object] = [StiffnessElement(element="stiffness", k_n_per_m=k_n_per_m)]
    if c_n_s_per_m:
        elements.append(ViscousElement(element="viscous", c_n_s_per_m=c_n_s_per_m))
    if m_kg := felt(specimen.mass):
        elements.append(InertiaElement(element="inertia", m_kg=m_kg))
    return found.model_copy(update={"specimen": elements})


def to_csv(rec: RecordedTest, path: Path, name: str) -> Path:
    """Write `axis_signals` as CSV, and beside it the rig of that axis; return the rig's path.

    Raises:
        InputError: as for `axis_signals`.
        RthybError: a file cannot be written.
    """
    signals = axis_signals(rec, name)
    write_columns(signals, path)
    model = path.with_suffix(".rig.toml")
    with replacing(model) as temporary:
        known = alone(_without_elements(rig_of(rec)), name)
        temporary.write_text(config.dump(known), encoding="utf-8")
    return model


def rig_of(rec: RecordedTest) -> AxesRig:
    """Return the rig file of a recording with several axes.

    Raises:
        InputError: the recording has only one axis.
    """
    rig = config.parse_any_rig(rec.rig_toml, "recording: rig")
    if not isinstance(rig, AxesRig):
        raise InputError("the recording has only one axis: omit the option", "--axis")
    return rig


def _without_elements(rig: AxesRig) -> AxesRig:
    """Return a rig whose specimen consists only of its matrices."""
    return rig.model_copy(update={"specimen": rig.specimen.model_copy(update={"element": []})})


def stiffness_of(rig: AxesRig) -> Rows:
    """Return the specimen's matrix: the measured one includes the stiffness of the elements."""
    return rig.specimen.stiffness if rig.specimen.element else rig.k_e


def _derivatives(x: Floats, dt_s: float) -> tuple[Floats, Floats]:
    """Return velocity and acceleration of columns, (n, axes) each; at rest before and after."""
    padded = np.pad(x, ((4, 4), (0, 0)), "edge")

    def each(weights: Floats) -> Floats:
        columns = [np.convolve(one, weights[::-1], "valid") for one in padded.T]
        return np.column_stack(columns)

    return each(_SLOPE) / dt_s, each(_CURVATURE) / dt_s**2
