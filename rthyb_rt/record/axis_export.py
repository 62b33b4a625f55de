"""One axis of a recording of several, for a diagnosis: its signals, and its rig by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config
from rthyb_rt.errors import InputError
from rthyb_rt.record.export import write_columns
from rthyb_rt.record.recording import Recording, replacing


def axis_signals(rec: Recording, name: str) -> dict[str, NDArray[np.float64]]:
    """Return the signals of an axis in the rows of the test proper, SI units, (n,) each.

    Returns:
        ``t``, ``ag``, ``x_cmd`` and ``x_meas`` as recorded; ``x_num``, where the numerical part
        wants the axis, by the kinematics; ``f_meas``, its load cell less what the other axes bring
        by the specimen's elastic stiffness matrix, K x as along the axes at rest.

    Raises:
        InputError: there is no such axis, or the recording is of one.
    """
    rig = _rig_of(rec)
    own, k = rec.axis(name), rec.axis_names.index(name)
    rows = rec.running()
    measured = np.column_stack([rec.axis(one)["x_meas_m"][rows] for one in rec.axis_names])
    asked = np.column_stack(
        [rec.samples[f"x_num_m_{j}" if j else "x_num_m"][rows] for j in range(len(rec.axis_names))]
    )
    stiffness = np.array(rig.along_axes())[k]
    stiffness[k] = 0.0
    return {
        "t": rec.time_s()[rows],
        "ag": np.asarray(rec.samples["ag_mps2"][rows]),
        "x_num": rig.core_kinematics().axes(asked)[0][:, k],
        "x_cmd": np.asarray(own["x_cmd_m"][rows]),
        "x_meas": measured[:, k],
        "f_meas": own["f_meas_n"][rows] - measured @ stiffness,
    }


def to_csv(rec: Recording, path: Path, name: str) -> Path:
    """Write `axis_signals` as CSV, and beside it the rig of that axis; return the latter's path.

    Raises:
        InputError: as `axis_signals`.
        RthybError: a file cannot be written.
    """
    signals = axis_signals(rec, name)
    write_columns(signals, path)
    model = path.with_suffix(".rig.toml")
    with replacing(model) as temporary:
        temporary.write_text(config.dump(_rig_of(rec).of_axis(name)), encoding="utf-8")
    return model


def _rig_of(rec: Recording) -> config.AxesRig:
    rig = config.parse_any_rig(rec.rig_toml, "recording: rig")
    if not isinstance(rig, config.AxesRig):
        raise InputError("the recording is of one axis: leave the option out", "--axis")
    return rig
