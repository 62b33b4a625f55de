"""Reading a ground motion: format detection, units, plausibility, built-in records."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from importlib import resources
from os import PathLike
from pathlib import Path
from types import MappingProxyType

import numpy as np

from rthyb_rt.errors import InputError, Problem
from rthyb_rt.ground_motion.acceleration import FloatArray, GroundMotion
from rthyb_rt.ground_motion.acceleration_units import (
    ACCELERATION_UNITS,
    STANDARD_GRAVITY_MPS2,
    canonical_unit,
    likely_units,
)
from rthyb_rt.ground_motion.at2 import is_at2, read_at2, resembles_at2
from rthyb_rt.ground_motion.channels import Samples
from rthyb_rt.ground_motion.columns import read_columns
from rthyb_rt.ground_motion.cosmos import cosmos_volume, read_cosmos
from rthyb_rt.ground_motion.csmip import csmip_volume, read_csmip
from rthyb_rt.ground_motion.knet import is_knet, read_knet
from rthyb_rt.ground_motion.text import MAX_POINTS, TextLines, clean, load_text

FORMATS = ("auto", "at2", "cosmos-v1", "cosmos-v2", "csmip-v1", "csmip-v2", "knet", "columns")

MAX_PGA_G = 5.0
SMALL_PGA_G = 0.001
INTERVAL_RANGE_S = (1e-4, 1.0)
MAX_DURATION_S = 3600.0

#: Name of a built-in record -> (file in rthyb_rt/data, source in words).
BUILTIN = MappingProxyType(
    {
        "elcentro-1940-ns": (
            "elcentro_1940_ns_chopra_50hz_g.txt",
            "Imperial Valley earthquake of 18 May 1940, El Centro, component NS; public-domain US"
            " record, processed as tabulated in Chopra, Dynamics of Structures (50 Hz, 1560"
            " points, PGA 0.3188 g)",
        ),
        **{
            f"rths-{name.replace('_', '-')}": (
                f"rths_{name}.txt",
                f"{source}, with its rests, as the benchmarks of real-time hybrid simulation have"
                " it (MSSP 135 (2020) 106381); from github.com/FermandoisLab/maRTHS-bmk-RoDeAC,"
                " MIT licence",
            )
            for name, source in (
                ("elcentro", "Imperial Valley earthquake of 18 May 1940, El Centro, NS (0.320 g)"),
                ("kobe", "Kobe earthquake of 17 January 1995 (0.645 g)"),
                ("morgan_hill", "Morgan Hill earthquake of 24 April 1984 (0.244 g)"),
            )
        },
    }
)


def load(
    name_or_path: str | PathLike[str],
    *,
    format: str = "auto",
    units: str | None = None,
    channel: int | str | None = None,
) -> GroundMotion:
    """Return a built-in record by its name, or read a file.

    Raises:
        InputError: see `read`; for a missing file the built-in names are listed, and what
            contradicts a built-in record is refused.
    """
    if str(name_or_path) in BUILTIN:
        motion = builtin(str(name_or_path))
        _refuse_contradiction(motion, format, units, channel)
        return motion
    if not _exists(name_or_path):
        raise InputError(
            "no such file, and no built-in record of that name (built in:"
            f" {', '.join(BUILTIN)}); check the name and the folder",
            clean(str(name_or_path), 300),
        )
    return read(name_or_path, format=format, units=units, channel=channel)


@functools.cache
def builtin(name: str) -> GroundMotion:
    """Return a record that comes with the package; names are the keys of `BUILTIN`.

    Raises:
        InputError: no such name.
    """
    if name not in BUILTIN:
        raise InputError(
            f"no built-in record {clean(name, 60)!r}; built in: {', '.join(BUILTIN)}",
            "ground_motion.record",
        )
    file_name, source = BUILTIN[name]
    with resources.as_file(resources.files("rthyb_rt") / "data" / file_name) as path:
        motion = read(path, format="columns")
    details = {**motion.details, "file": f"rthyb_rt/data/{file_name}"}
    return GroundMotion(name, source, motion.dt_s, motion.acceleration_mps2, details)


def _refuse_contradiction(
    motion: GroundMotion, format: str, units: str | None, channel: int | str | None
) -> None:
    """Refuse what is said of a built-in record and is not so, instead of ignoring it.

    Raises:
        InputError: with each key that must be omitted.
    """
    unit, stored = motion.details["unit"].partition(" (")[0], motion.details["format"]
    record = f"the built-in record {motion.name}"
    problems = []
    if units is not None and canonical_unit(units) != unit:
        problems.append(
            Problem(
                "ground_motion.units",
                f'found "{clean(units, 40)}"; {record} is stored in {unit}; omit the key',
            )
        )
    if format not in ("auto", stored):
        problems.append(
            Problem(
                "ground_motion.format",
                f'found "{clean(format, 40)}"; {record} has the format {stored}; omit the key',
            )
        )
    if channel is not None:
        problems.append(
            Problem(
                "ground_motion.channel",
                f'found "{clean(str(channel), 40)}"; {record} has one component only; omit the key',
            )
        )
    if problems:
        raise InputError(problems)


def read(
    path: str | PathLike[str],
    *,
    format: str = "auto",
    units: str | None = None,
    channel: int | str | None = None,
) -> GroundMotion:
    """Read one component of ground acceleration from a text file.

    Args:
        path: the file, at most 64 MiB.
        format: one of `FORMATS`; ``auto`` detects it from the content, never from the file's name.
        units: unit of the file's numbers, for a file that does not state it (g, m/s2, cm/s2, gal,
            mg, in/s2, ...).
        channel: number or part of the name of a component, for a file that contains several.

    Returns:
        The motion in m/s2. ``details`` contains the format, unit, points, interval, peak, encoding
        and checksum, data from the header, and ``warning`` if something looks unusual.

    Raises:
        InputError: one or more errors, each with file and row: missing, binary or empty file,
            unknown format, wrong columns, a value that is not finite, uneven or decreasing time,
            truncated data, no unit, or a PGA above 5 g.
    """
    wanted_unit = None
    if units is not None:
        wanted_unit = canonical_unit(units)
        if wanted_unit is None:
            raise InputError(
                f"{clean(units, 40)!r} is not a unit of acceleration; use one of"
                f" {', '.join(ACCELERATION_UNITS)} or gal",
                "ground_motion.units",
            )
    if format not in FORMATS:
        raise InputError(
            f"{clean(format, 40)!r} is not a format; use one of {', '.join(FORMATS)}",
            "ground_motion.format",
        )
    text = load_text(path)
    found = _detect(text)
    chosen = found if format == "auto" else format
    if chosen != found and "-v" in chosen:
        raise text.error(
            f"is not a {chosen} file (its content looks like {found}); use format = 'auto'"
        )
    samples = _READERS[chosen](text, wanted_unit, channel)
    if wanted_unit is not None and wanted_unit != samples.unit:
        raise text.error(
            f"the file says {samples.unit} ({samples.unit_from}), but `units` says {wanted_unit}; "
            "omit `units` or correct the file's header"
        )
    acceleration, warnings = _checked(text, samples)
    details = {
        "file": Path(text.path).name,
        "format": chosen,
        "unit": f"{samples.unit} ({samples.unit_from})",
        "points": str(samples.values.size),
        "dt_s": f"{samples.dt_s:.9g}",
        "pga_g": f"{np.abs(acceleration).max() / STANDARD_GRAVITY_MPS2:.6g}",
        "encoding": text.encoding,
        "sha256": text.sha256,
        **samples.details,
    }
    if warnings:
        details["warning"] = "; ".join(warnings)
    name = clean(Path(text.path).stem, 60) or "record"
    about = samples.details.get("event") or samples.details.get("station")
    source = f"{chosen} file {Path(text.path).name}" + (f": {about}" if about else "")
    return GroundMotion(name, source, samples.dt_s, acceleration, details)


def _only_channel(text: TextLines, channel: int | str | None) -> None:
    """Reject a choice of channel in a format that contains only one."""
    if channel is not None and str(channel) != "1":
        raise text.error(f"has only one component; omit channel {clean(str(channel), 40)!r}")


def _at2(text: TextLines, units: str | None, channel: int | str | None) -> Samples:
    _only_channel(text, channel)
    return read_at2(text, units)


def _columns(text: TextLines, units: str | None, channel: int | str | None) -> Samples:
    try:
        return read_columns(text, units, channel)
    except InputError:
        # Its rows of five or eight values are not columns; a line of its header is missing.
        if resembles_at2(text):
            return read_at2(text, units)
        raise


def _knet(text: TextLines, _units: str | None, channel: int | str | None) -> Samples:
    _only_channel(text, channel)
    return read_knet(text)


def _cosmos(text: TextLines, _units: str | None, channel: int | str | None) -> Samples:
    return read_cosmos(text, channel)


def _csmip(text: TextLines, _units: str | None, channel: int | str | None) -> Samples:
    return read_csmip(text, channel)


_READERS: dict[str, Callable[[TextLines, str | None, int | str | None], Samples]] = {
    "at2": _at2,
    "knet": _knet,
    "cosmos-v1": _cosmos,
    "cosmos-v2": _cosmos,
    "csmip-v1": _csmip,
    "csmip-v2": _csmip,
    "columns": _columns,
}


def _detect(text: TextLines) -> str:
    """Return the format that the content resembles; columns if none of the others."""
    if is_knet(text):
        return "knet"
    if is_at2(text):
        return "at2"
    return cosmos_volume(text) or csmip_volume(text) or "columns"


def _checked(text: TextLines, samples: Samples) -> tuple[FloatArray, list[str]]:
    """Convert to m/s2 and check that the record is a plausible ground motion."""
    low, high = INTERVAL_RANGE_S
    if not low <= samples.dt_s <= high:
        raise text.error(
            f"the sampling interval is {samples.dt_s:.6g} s; {low:g} s to {high:g} s are accepted:"
            " check the unit of time"
        )
    if samples.values.size < 2:
        raise text.error("has fewer than two points; a record needs at least two")
    if samples.values.size > MAX_POINTS or samples.values.size * samples.dt_s > MAX_DURATION_S:
        raise text.error(
            f"lasts {samples.values.size * samples.dt_s:.6g} s ({samples.values.size} points); at"
            f" most {MAX_DURATION_S:g} s and {MAX_POINTS} points are accepted: keep only the"
            " strong-motion part"
        )
    peak = float(np.abs(samples.values).max())
    size = ACCELERATION_UNITS[samples.unit]
    pga_g = peak * size / STANDARD_GRAVITY_MPS2
    if not math.isfinite(pga_g) or pga_g > MAX_PGA_G:
        likely = [u for u in likely_units(peak) if u != samples.unit]
        guess = (
            f"the numbers are probably in {' or '.join(likely)}" if likely else "no known unit fits"
        )
        raise text.error(
            f"PGA {pga_g:.4g} g (peak {peak:.6g} read as {samples.unit}) is above {MAX_PGA_G:g} g,"
            f" which no ground motion reaches; {guess}: correct the unit"
        )
    warnings = []
    if pga_g < SMALL_PGA_G:
        likely = [u for u in likely_units(peak) if u != samples.unit]
        warnings.append(
            f"PGA {pga_g:.3g} g is very small"
            + (f"; the numbers may be in {' or '.join(likely)}" if likely else "")
        )
    return samples.values * size, warnings


def _exists(path: str | PathLike[str]) -> bool:
    """Return whether a path exists, also for names that no file can have."""
    try:
        return Path(path).exists()
    except (OSError, ValueError):
        return False
