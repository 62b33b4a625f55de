"""Recordings for other programs: MAT for MATLAB and Octave, CSV for all others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.errors import InputError
from rthyb_rt.record import signal_units
from rthyb_rt.record.recording import UNITS, RecordedTest, replacing

INTERCHANGE: dict[str, str] = {
    "ag": "ag_mps2",
    "x_num": "x_num_m",
    "x_cmd": "x_cmd_m",
    "x_meas": "x_meas_m",
    "f_meas": "f_meas_n",
}
"""Columns of the interchange format other than ``t``, and the fields from which they come."""


def to_csv(rec: RecordedTest, path: str | Path, *, full: bool = False) -> None:
    """Write a recording as CSV, SI units, one header row, numbers that read back exactly.

    Args:
        rec: the recording.
        path: file to write.
        full: False gives the interchange format that ``rthyb diagnose`` and other labs read:
            the rows of the test proper with columns t, ag, x_num, x_cmd, x_meas, f_meas. True
            gives every row, every field and every channel under its own name, after ``t_s``,
            but not the reference simulation.

    Raises:
        InputError: the rig has several axes and ``full`` is False: see `axis_export`.
        RthybError: the file cannot be written.
    """
    if rec.axis_names and not full:
        raise InputError(
            f"the recording has the axes {', '.join(rec.axis_names)}, but this format holds one: "
            f"choose it (--axis {rec.axis_names[0]}), or write all fields (--full)",
            "export",
        )
    if full:
        rows = np.ones(len(rec.samples), dtype=np.bool_)
        names = {name: name for name in rec.samples.dtype.names or ()}
        header = ["t_s", *names]
    else:
        rows = rec.running()
        names = INTERCHANGE
        header = ["t", *names]
    columns = [rec.time_s(), *(_values(rec, name) for name in names.values())]
    write_columns(dict(zip(header, (one[rows] for one in columns), strict=True)), path)


def without_extras(rec: RecordedTest) -> str:
    """Return a note on the extra channels that the interchange format does not have; "": none."""
    names = [one.name for one in rec.extras()]
    if not names:
        return ""
    return f"has no columns for the extra channels {', '.join(names)}, which diagnose does not read"


def write_columns(columns: Mapping[str, NDArray[Any]], path: str | Path) -> None:
    """Write columns, (n,) each, under their names as CSV; raises ``RthybError`` on failure."""
    values = [one.tolist() for one in columns.values()]
    with replacing(Path(path)) as temporary, temporary.open("w", encoding="ascii") as file:
        file.write(",".join(columns) + "\n")
        # repr gives the shortest text that is read back as the same double.
        file.writelines(",".join(map(repr, row)) + "\n" for row in zip(*values, strict=True))


def to_mat(rec: RecordedTest, path: str | Path) -> None:
    """Write a recording as a MAT file (version 5), one column vector for each field.

    The variables are ``t_s``, every field of the samples under its own name, ``x_ref_m`` and the
    other reference signals if there are any, ``fs_hz``, ``test_toml``, ``rig_toml`` and the
    structures ``units``, ``flag_bits``, ``ground_motion`` and ``meta``; ``state_names`` is a cell.

    Args:
        rec: the recording.
        path: file to write.

    Raises:
        InputError: scipy is not installed.
        RthybError: the file cannot be written.
    """
    try:
        from scipy.io import savemat
    except ImportError as error:
        raise InputError(
            "writing MAT files needs scipy; install it with pip install 'rthyb-rt[fit]'", str(path)
        ) from error
    units = UNITS | {"t_s": "s"} | {one.name: one.unit for one in rec.channels}
    if rec.axis_names:
        own = signal_units.of_samples(rec) | signal_units.of_reference(rec)
        # A field of a structure cannot be called x_cmd_m.1; its unit is that of x_cmd_m.
        units |= {name: unit for name, unit in own.items() if "." not in name}
    variables: dict[str, Any] = {"t_s": rec.time_s()}
    variables |= {name: _values(rec, name) for name in rec.samples.dtype.names or ()}
    if rec.reference is not None:
        variables |= {name: rec.reference[name] for name in rec.reference.dtype.names or ()}
    variables |= {
        "fs_hz": rec.fs_hz,
        "test_toml": rec.test_toml,
        "rig_toml": rec.rig_toml,
        "units": units,
        "flag_bits": FLAGS,
        "state_names": np.array(STATES, dtype=object),
        "ground_motion": {_excitation(rec): rec.ag_mps2} | _without_none(rec.ground_motion),
        "meta": _without_none(rec.meta),
    }
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        savemat(file, variables, do_compression=True, oned_as="column", long_field_names=True)


def _values(rec: RecordedTest, name: str) -> NDArray[Any]:
    """Return a field of the samples, a channel in its unit, (n,)."""
    is_channel = any(channel.name == name for channel in rec.channels)
    return rec.channel(name) if is_channel else np.asarray(rec.samples[name])


def _excitation(rec: RecordedTest) -> str:
    """Return the kind of excitation of a test: a prescribed history is a displacement."""
    return "history_m" if "excitation" in rec.ground_motion else "ag_mps2"


def _without_none(values: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}
