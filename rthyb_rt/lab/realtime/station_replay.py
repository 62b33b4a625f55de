"""Replay of a recording with a new station."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config, core
from rthyb_rt.config import AxesRig, RigFile, TestFile
from rthyb_rt.config.lonesensors import READ
from rthyb_rt.core import FLAGS
from rthyb_rt.core.wire import Codec
from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.lab import axis_wires, experiment, trips
from rthyb_rt.lab.end_reasons import in_words
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import RecordedTest, require_replayable


def replay(rec: RecordedTest) -> experiment.Replay:
    """Run all inputs of a recorded test through a new station, and compare every field.

    Skipped ticks at the very end, after which no executed tick was recorded, are omitted: the ring
    may have been full there, or the process killed.

    Raises:
        InputError: it was recorded by another version, this version cannot read its configuration,
            or rows are missing.
    """
    rows, rec, _ = _rerun(rec)
    return experiment.compare(rec, _padded(rows, rec.samples.size))


def first_cause(rec: RecordedTest) -> tuple[str, float, float]:
    """Return what interrupted or ended a test, as determined by a new station.

    For rows of a test that is still running, or whose process did not record the cause.

    Returns:
        The cause, or "none"; the value reached and the limit, SI, both 0 if the cause has no
        number.

    Raises:
        InputError: it was recorded by another version, this version cannot read its configuration,
            or rows are missing.
    """
    station = _rerun(rec)[2]
    return station.cause, station.cause_value, station.cause_limit


def first_cause_in_words(rec: RecordedTest) -> str:
    """Return that cause in words, with its figures and its axis; "" if there is none.

    Raises:
        InputError: as for `first_cause`.
    """
    station = _rerun(rec)[2]
    if station.cause == "none":
        return ""
    direction, sensor = station.cause_interface, station.cause_sensor
    if sensor is None:
        whose = trips.whose(station.cause_axis, direction, rec.axis_names, rec.interface_names)
    else:
        whose = trips.sensor_of(station.config, sensor)
    turns = False
    if direction is not None and rec.interface_names:
        rig = config.parse_any_rig(rec.rig_toml, "recording: rig")
        turns = isinstance(rig, AxesRig) and rig.kinematics.turns()[direction]
    met = station.cause, station.cause_value, station.cause_limit
    text = trips.figures(*met, turns=turns, alone=sensor is not None) or in_words(station.cause)
    return f"{whose}: {text}" if whose else text


def _rerun(rec: RecordedTest) -> tuple[NDArray[np.void], RecordedTest, core.Station]:
    """Return the rows that a new station computes, the recording, and the final station."""
    require_replayable(rec)
    own = np.flatnonzero((rec.samples["flags"] & FLAGS["blind"]) == 0)
    rec = replace(rec, samples=rec.samples[: own[-1] + 1 if own.size else 0])
    ticks = rec.samples["tick"]
    if not ticks.size or ticks[0] != 0:
        raise InputError(
            "the first rows of the test are missing; only a test that was recorded from its "
            "first tick can be replayed",
            "recording",
        )
    test = config.parse_test(rec.test_toml, "recording: test")
    rig = config.parse_any_rig(rec.rig_toml, "recording: rig")
    views = [rig.of_axis(name) for name in rig.names] if isinstance(rig, AxesRig) else [rig]
    first, *later = rec.replay.parameters
    station = core.Station(_settings(rec, test, views[0], first["values"]), rec.ag_mps2)
    published = [(int(one["generation"]), core.Parameters.of_plain(one["values"])) for one in later]
    calibrations = [axis_wires.calibration(view) for view in views]
    codecs = _codecs(rec.replay.codec, len(views))
    further = [rec.samples[f"{one.name}{READ}"] for one in station.config.sensors]
    sensors = np.column_stack(further) if further else None
    rows = station.replay(rec.samples, codecs, calibrations, published, sensors)
    return rows, rec, station


def _codecs(tables: bytes, axes: int) -> list[Codec | None]:
    """Return the frames of each axis' link from their consecutive tables.

    Raises:
        InputError: their number is not that of the axes.
    """
    if not tables:
        return [None] * axes
    size, left = divmod(len(tables), axes)
    if left:
        raise InputError(f"its frames are not those of {axes} axes", "recording: codec")
    return [Codec.of(tables[k * size : (k + 1) * size]) for k in range(axes)]


def _settings(
    rec: RecordedTest, test: TestFile, rig: RigFile, values: Mapping[str, Any]
) -> core.StationConfig:
    """Return the initial settings of a recording: as stated in it, otherwise as derived."""
    if "station" in values:
        return core.StationConfig.of(values["station"])
    derived = config.derive(test, rig)
    # Recordings from before settings were recorded have only the limits of the files.
    derived = replace(derived, limits=replace(derived.limits, derived={}))
    setup = Setup(
        test=test,
        rig=rig,
        derived=derived,
        motion=GroundMotion("recorded", "recording", 1.0 / rec.fs_hz, rec.ag_mps2),
        ag_mps2=rec.ag_mps2,
        controller=experiment.controller_config(test, rig, derived, int(values["rfc_end_tick"])),
        virtual_rig=experiment.rig_config(rig, rec.fs_hz),
    )
    return experiment.station_config(setup)


def _padded(rows: NDArray[np.void], count: int) -> NDArray[np.void]:
    """Return rows padded to a length; the missing ones differ from any recorded row."""
    full = np.zeros(count, dtype=core.record_dtype(core.axes_in(rows.dtype)))
    full["tick"] = np.iinfo(np.uint64).max
    full[: rows.size] = rows
    return full
