"""The recording of a hybrid test: one HDF5 file with everything needed to evaluate and repeat it.

Layout of the file (schema ``rthyb-recording/3``)::

    /samples              one row a sample, the core's record and its channels as a compound; attrs
                          fs_hz, units, axes, channels
    /ground_motion/ag_mps2   the ground motion as used by the controller; attrs name, source, ...
                          for a prescribed history (attr excitation) the displacement, m
    /reference            reference simulation, x_ref_m, v_ref_mps, f_ref_n (optional); of a second
                          direction of the interface x_ref_m_1, ...
    /config/test_toml, /config/rig_toml     the resolved files as text
    /replay/...           further data for a bit-identical replay
    attributes of /       versions, test name, end reason, ...
"""

from __future__ import annotations

import contextlib
import json
import os
import tomllib
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import documents
from rthyb_rt.core.rows import FLAGS, RUNNING, STATES, Channel, axes_in
from rthyb_rt.errors import InputError, RthybError

FILE_NAME = "recording.h5"
OMITTED = "rig_omitted"
"""Metadata: the notes on values that the rig file omitted. The recorded file has every value."""

BLOCK_ROWS = 128
"""Rows per block of a growing recording: an eighth of a second."""

Rows = NDArray[np.void]


@dataclass(frozen=True)
class Field:
    """A field of the samples in a version of the record.

    Attributes:
        type: NumPy's name of the type.
        unit: its unit.
        earlier: its value for rows of the previous version, (n,) from (n,); None: the field of the
            same name in that version.
    """

    type: str
    unit: str
    earlier: Callable[[Rows], NDArray[Any]] | None = None


@dataclass(frozen=True)
class Version:
    """The changes of a version of the record.

    Attributes:
        program: the first version of the program that writes it.
        fields: fields that it added or changed; for version 1 all fields.
        gone: fields of the previous version that it no longer has.
    """

    program: str
    fields: dict[str, Field]
    gone: tuple[str, ...] = ()


def _from_counts(name: str, unit: float) -> Callable[[Rows], NDArray[Any]]:
    """Return the value of an integer field of version 1, whose lowest count means no reading."""

    def values(rows: Rows) -> NDArray[Any]:
        return np.where(rows[name] == np.iinfo(np.int32).min, np.nan, rows[name] * unit)

    return values


def _in_a_row(rows: Rows) -> NDArray[Any]:
    """Return the number of rows without a pair up to and including each row."""
    lost = (rows["flags"] & FLAGS["predicted"]) != 0
    n = np.arange(1, len(rows) + 1)
    return (n - np.maximum.accumulate(np.where(lost, 0, n))).astype(np.uint32)


VERSIONS: dict[int, Version] = {
    1: Version(
        "0.1.0",
        {
            "tick": Field("<u8", "1"),
            "due_ns": Field("<i8", "ns"),
            "wake_late_ns": Field("<i4", "ns"),
            "sent_late_ns": Field("<i4", "ns"),
            "flags": Field("<u4", "bits"),
            "generation": Field("<u4", "1"),
            "x_raw": Field("<i4", "counts"),
            "f_raw": Field("<i4", "counts"),
            "state": Field("|u1", "1"),
            "echo": Field("|u1", "1"),
            "count": Field("|u1", "1"),
            "code": Field("|u1", "bits"),
            "ag_mps2": Field("<f8", "m/s^2"),
            "x_num_m": Field("<f8", "m"),
            "x_plc_m": Field("<f8", "m"),
            "x_cmd_m": Field("<f8", "m"),
            "x_meas_m": Field("<f8", "m"),
            "f_meas_n": Field("<f8", "N"),
            "alpha": Field("<f8", "samples"),
            "beta": Field("<f8", "samples^2"),
            "k_t_n_per_m": Field("<f8", "N/m"),
            "energy_error_j": Field("<f8", "J"),
            "tracking_indicator_m2": Field("<f8", "m^2"),
        },
    ),
    2: Version(
        "0.2.0",
        {
            "code": Field("<u2", "bits"),
            "state": Field("<u2", "1"),
            "echo": Field("<u2", "1"),
            "count": Field("<u2", "1"),
            "x_read_m": Field("<f8", "m", _from_counts("x_raw", 1e-9)),
            "f_read_n": Field("<f8", "N", _from_counts("f_raw", 1e-3)),
        },
        gone=("x_raw", "f_raw"),
    ),
    3: Version(
        "0.3.0",
        {
            "cause": Field("<u4", "1", lambda rows: np.zeros(len(rows), np.uint32)),
            "missing": Field("<u4", "samples", _in_a_row),
        },
    ),
}
"""Every version of the record: the last is written, all are read. To add a field, add a row here,
with its value for older recordings, and a member of the core's rthyb_record."""

VERSION = max(VERSIONS)
OLDEST_REPLAYED = 2
"""From this version on, rows contain everything that a bit-identical replay needs."""
AXIS_FIELDS: tuple[str, ...] = (
    *("x_read_m", "f_read_n", "x_cmd_m", "x_meas_m", "f_meas_n"),
    *("missing", "echo", "count"),
)
"""Fields that exist for each axis; the others belong to the whole test."""
_SCHEMAS = "rthyb-recording/"
SCHEMA = f"{_SCHEMAS}{VERSION}"


def fields_of(version: int) -> dict[str, Field]:
    """Return the fields of the samples in a version."""
    found: dict[str, Field] = {}
    for number in range(1, version + 1):
        step = VERSIONS[number]
        found = {name: field for name, field in found.items() if name not in step.gone}
        found |= step.fields
    return found


def _converted(rows: Rows, version: int) -> Rows:
    """Convert rows of an older version to the current one."""
    for number in range(version + 1, VERSION + 1):
        step, now = VERSIONS[number], fields_of(number)
        # Additional fields of a laboratory are kept in addition to those of this version.
        own = [name for name in rows.dtype.names or () if name not in fields_of(number - 1)]
        made = np.zeros(
            len(rows),
            dtype=[(name, field.type) for name, field in now.items()]
            + [(name, rows.dtype[name]) for name in own],
        )
        for name in (*now, *own):
            earlier = step.fields[name].earlier if name in step.fields else None
            made[name] = earlier(rows) if earlier else rows[name]
        rows = made
    return rows


UNITS: dict[str, str] = {name: field.unit for name, field in fields_of(VERSION).items()}
"""Unit of each field of `RecordedTest.samples`; a recording must have all of them."""


REFERENCE_UNITS: dict[str, str] = {"x_ref_m": "m", "v_ref_mps": "m/s", "f_ref_n": "N"}
"""Unit of each field of `RecordedTest.reference` along a displacement; a recording with a reference
has all of them."""
BESIDE_SAMPLES: frozenset[str] = frozenset(REFERENCE_UNITS) | {
    *("t_s", "fs_hz", "test_toml", "rig_toml", "units", "flag_bits", "state_names"),
    *("ground_motion", "history_m", "meta"),
}
"""Names that exported files and tables of signals use beside those of the samples."""

_CONVERTED = "converted_from"
"""Attribute of a file that was written from an older version: that version."""


@dataclass
class ReplayData:
    """Data for a bit-identical replay, in addition to the samples and the configuration.

    Attributes:
        parameters: every parameter set, ``{"generation", "tick", "values"}``.
        commands: every operator command, ``{"tick", "command"}``.
        skips: first tick and length of every skip, shape (n, 2).
        tares: offset subtracted from each channel at zeroing, in the channel's unit.
        codec: the core's description of how the link encodes numbers in frames; for several axes
            one after another; empty: no wire.
    """

    parameters: list[dict[str, Any]] = field(default_factory=list)
    commands: list[dict[str, Any]] = field(default_factory=list)
    skips: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    tares: dict[str, float] = field(default_factory=dict)
    codec: bytes = b""

    @property
    def skipped_ticks(self) -> int:
        """Ticks without a row."""
        return int(np.sum(self.skips[:, 1])) if self.skips.size else 0


@dataclass
class RecordedTest:
    """A recorded hybrid test.

    Row n holds the commands for instant t_n and what was measured at t_n.

    Attributes:
        samples: structured array with at least the fields of `UNITS`.
        fs_hz: sampling rate, Hz.
        ag_mps2: ground motion at the sampling rate as used by the controller, m/s^2.
        ground_motion: provenance: name, source, pga_g, scale.
        reference: structured array with the fields of `REFERENCE_UNITS`, and those with a number
            for further directions, or None; its row k belongs to the k-th RUNNING row of
            ``samples`` and it may be longer.
        test_toml: resolved test file.
        rig_toml: resolved rig file.
        replay: further data for a replay.
        meta: rthyb_version, core_version, core_sources, compiler, architecture, git_hash,
            test_name, clock, created_utc, end_reason ("completed" or the reason), interrupted.
        version: version of the record in the file; the samples are converted to the current one.
        channels: named values of the rows in addition to the fields of `UNITS`.
        axis_names, interface_names: names of several axes, and of the directions in which they are
            connected to the numerical part; empty for one axis.
    """

    samples: NDArray[np.void]
    fs_hz: float
    ag_mps2: NDArray[np.float64]
    ground_motion: dict[str, Any]
    reference: NDArray[np.void] | None
    test_toml: str
    rig_toml: str
    replay: ReplayData = field(default_factory=ReplayData)
    meta: dict[str, Any] = field(default_factory=dict)
    version: int = VERSION
    channels: tuple[Channel, ...] = ()
    axis_names: tuple[str, ...] = ()
    interface_names: tuple[str, ...] = ()

    @property
    def axis_count(self) -> int:
        """Number of axes."""
        return axes_in(self.samples.dtype)

    def axis(self, which: int | str = 0) -> NDArray[np.void]:
        """Return a view of the fields of an axis, given by number from 0 or by name, shape (n,).

        Raises:
            InputError: there is no such axis; the message lists those that exist.
        """
        number = self.axis_names.index(which) if which in self.axis_names else which
        if not isinstance(number, int) or not 0 <= number < self.axis_count:
            from rthyb_rt.config.fields import nearest, written

            near = nearest(str(which), list(self.axis_names))
            there = (
                f"axes are: {', '.join(self.axis_names)}"
                if self.axis_names
                else "the test ran on a single axis, which has no name"
            )
            raise InputError(f"no axis {written(which)}{near}; {there}", "recording")
        if number == 0:
            return self.samples[list(AXIS_FIELDS)]
        fields: Mapping[str, Any] = self.samples.dtype.fields or {}
        own = [fields[f"{name}.{number}"] for name in AXIS_FIELDS]
        return self.samples.view(
            np.dtype(
                {
                    "names": list(AXIS_FIELDS),
                    "formats": [field[0] for field in own],
                    "offsets": [field[1] for field in own],
                    "itemsize": self.samples.dtype.itemsize,
                }
            )
        )

    def channel(self, name: str) -> NDArray[np.float64]:
        """Return a named value of every row in its unit, shape (n,).

        Raises:
            InputError: there is no channel of that name; the message lists those that exist.
        """
        for channel in self.channels:
            if channel.name == name:
                values = np.asarray(self.samples[name], dtype=np.float64)
                return values if channel.scale == 1.0 else channel.scale * values
        known = ", ".join(channel.name for channel in self.channels) or "none"
        raise InputError(f"no channel {name!r}; channels are: {known}", "recording")

    def extras(self) -> tuple[Channel, ...]:
        """Return the extra channels of the rig file, besides displacement and force.

        Those of several axes follow one another, in the order of the axes.
        """
        return tuple(one for own in self.extras_by_axis().values() for one in own)

    def extras_by_axis(self) -> dict[str, tuple[Channel, ...]]:
        """Return the extra channels of each axis by its name; that of a single axis is empty."""
        try:
            rig = documents.toml(self.rig_toml)
            names = {
                str(axis.get("name", "")): [
                    one["name"] for one in axis.get("sensors", {}).get("extra", ())
                ]
                for axis in rig.get("axis", [rig])
            }
        except (tomllib.TOMLDecodeError, AttributeError, KeyError, TypeError):
            return {}
        known = {channel.name: channel for channel in self.channels}
        return {
            axis: tuple(known[name] for name in own if name in known) for axis, own in names.items()
        }

    def lone_sensors(self) -> tuple[Channel, ...]:
        """Return the channels of the sensors without an actuator, after the tare."""
        try:
            names = [one["name"] for one in documents.toml(self.rig_toml).get("sensor", ())]
        except (tomllib.TOMLDecodeError, AttributeError, KeyError, TypeError):
            return ()
        known = {channel.name: channel for channel in self.channels}
        return tuple(known[name] for name in names if name in known)

    def running(self) -> NDArray[np.bool_]:
        """Return which rows belong to the test proper, shape (n,): RUNNING, or all if none is."""
        mask: NDArray[np.bool_] = self.samples["state"] == RUNNING
        return mask if mask.any() else np.ones(len(self.samples), dtype=np.bool_)

    def time_s(self) -> NDArray[np.float64]:
        """Return the time of each row, shape (n,), s; zero at the first row of the test proper."""
        tick = self.samples["tick"].astype(np.int64)
        start = tick[np.argmax(self.running())] if tick.size else 0
        return np.asarray((tick - start) / self.fs_hz, dtype=np.float64)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Provide a temporary name beside ``path``; rename it to ``path`` if the block succeeds.

    A reader of ``path`` sees either the old file or the complete new one; after a failure the
    temporary file is deleted.

    Raises:
        RthybError: the folder or the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise RthybError(
            f"cannot be written ({error.strerror or error}); "
            "check the folder's permissions and the space on the disk",
            where=str(path),
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write(path: str | Path, rec: RecordedTest) -> None:
    """Write a recording atomically: a temporary file in the same folder, which is then renamed.

    Args:
        path: file to write; folders are created, and an existing file is replaced.
        rec: the recording.

    Raises:
        RthybError: the file cannot be written; nothing is left behind.
    """
    import h5py

    # Built in memory: on a full disk the HDF5 library crashes, while a plain write says so.
    # HDF5 refuses a name that is open already, even in memory and in another thread.
    with h5py.File(uuid.uuid4().hex, "w", driver="core", backing_store=False) as file:
        fill(file, rec)
        file.flush()
        image = file.id.get_file_image()
    with replacing(Path(path)) as temporary, _made_anew(temporary) as out:
        out.write(image)
        out.flush()
        os.fsync(out.fileno())


def _made_anew(path: Path) -> BinaryIO:
    """Create and open a new file: symbolic links are never followed."""
    # A file left behind by a killed process with this number.
    path.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "wb")


def fill(file: Any, rec: RecordedTest, *, growing: bool = False) -> None:
    """Write a recording to an open, empty HDF5 file.

    ``growing``: without its samples, whose data set can grow in blocks of `BLOCK_ROWS`; a complete
    block is never written again.
    """
    from rthyb_rt.record import signal_units

    file.attrs["schema"] = SCHEMA
    set_attributes(file, rec.meta)
    if rec.version != VERSION:
        file.attrs[_CONVERTED] = rec.version
    samples = _growing(file, rec.samples.dtype) if growing else _table(file, "samples", rec.samples)
    samples.attrs["fs_hz"] = rec.fs_hz
    samples.attrs["units"] = json.dumps(signal_units.of_samples(rec))
    further = [[f"{name}.{k}" for name in AXIS_FIELDS] for k in range(1, rec.axis_count)]
    samples.attrs["axes"] = json.dumps([list(AXIS_FIELDS), *further])
    if rec.axis_names:
        samples.attrs["axis_names"] = json.dumps(rec.axis_names)
        samples.attrs["interface_names"] = json.dumps(rec.interface_names)
    samples.attrs["channels"] = json.dumps([asdict(channel) for channel in rec.channels])
    for name, values in _names().items():
        samples.attrs[name] = json.dumps(values)
    motion = _table(file, "ground_motion/ag_mps2", np.asarray(rec.ag_mps2, dtype=np.float64))
    motion.attrs["fs_hz"] = rec.fs_hz
    set_attributes(motion, rec.ground_motion)
    if rec.reference is not None:
        reference = _table(file, "reference", rec.reference)
        reference.attrs["units"] = json.dumps(signal_units.of_reference(rec))
    _text(file, "config/test_toml", rec.test_toml)
    _text(file, "config/rig_toml", rec.rig_toml)
    file.create_group("replay")
    fill_replay(file, rec.replay)


def _names() -> dict[str, Any]:
    """Return a description of the samples, so that a file explains itself."""
    from rthyb_rt import core

    return {
        "flags": FLAGS,
        "states": STATES,
        "status": core.STATUS,
        "commands": core.COMMANDS,
        "causes": core.CAUSES,
    }


def fill_replay(file: Any, replay: ReplayData) -> None:
    """Write the data for a replay to an open HDF5 file, replacing the existing data."""
    group = file["replay"]
    for name in tuple(group):
        del group[name]
    _table(group, "codec", np.frombuffer(replay.codec, dtype=np.uint8))
    group.create_dataset("skips", data=np.asarray(replay.skips).reshape(-1, 2))
    _text(group, "parameters", json.dumps(replay.parameters))
    _text(group, "commands", json.dumps(replay.commands))
    _text(group, "tares", json.dumps(replay.tares))


def set_attributes(owner: Any, values: dict[str, Any]) -> None:
    """Store values as attributes: scalars directly, structures as JSON; None is omitted."""
    for key, value in values.items():
        if value is not None:
            scalar = isinstance(value, (str, bool, int, float, np.generic))
            owner.attrs[key] = value if scalar else json.dumps(value)


def _table(file: Any, name: str, data: NDArray[Any]) -> Any:
    if len(data) == 0:
        return file.create_dataset(name, data=data)
    # The checksum makes a damaged block an error instead of a number.
    return file.create_dataset(
        name,
        data=data,
        chunks=(min(len(data), 4096),),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
        fletcher32=True,
    )


def _growing(file: Any, dtype: np.dtype[Any]) -> Any:
    return file.create_dataset(
        "samples",
        shape=(0,),
        maxshape=(None,),
        dtype=dtype,
        chunks=(BLOCK_ROWS,),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
        fletcher32=True,
    )


def _text(file: Any, name: str, text: str) -> None:
    import h5py

    file.create_dataset(name, data=text, dtype=h5py.string_dtype("utf-8"))


def read(path: str | Path, *, rows: bool = True) -> RecordedTest:
    """Read a recording.

    Args:
        path: the HDF5 file.
        rows: False leaves ``samples`` empty, because its last block may be damaged.

    Returns:
        The complete recording in memory.

    Raises:
        InputError: the file is missing, damaged or not a recording, or has another schema.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        found = "is not a regular file" if path.exists() else "does not exist"
        found = "is a folder" if path.is_dir() else found
        raise InputError(f"{found}; give the {FILE_NAME} of a run", str(path))
    if not os.access(path, os.R_OK):
        raise InputError("is not readable; check its permissions", str(path))
    try:
        with h5py.File(path, "r") as file:
            return _load(file, str(path), rows)
    except InputError:
        raise
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, UnicodeDecodeError) as error:
        raise InputError(_why_unreadable(path, error), str(path)) from error


def _why_unreadable(path: Path, error: Exception) -> str:
    with path.open("rb") as file:
        signature = file.read(8)
    if not signature:
        return "the file is empty; the run that wrote it did not finish"
    if signature != b"\x89HDF\r\n\x1a\n":
        return "not an HDF5 file and therefore not a recording; give the recording.h5 of a run"
    if "truncated" in str(error):
        return "the file is truncated; copy it again, and check the disk"
    detail = str(error).strip("'\"").splitlines()[0] if str(error) else type(error).__name__
    return f"the file is damaged ({detail}); copy it again or use another run"


def _load(file: Any, where: str, rows: bool) -> RecordedTest:
    """Read the open file as a recording; an exception of h5py indicates damage."""
    version = _version(file, where)
    samples_set = file["samples"]
    if samples_set.ndim != 1:
        raise InputError(f"'samples' has shape {samples_set.shape}; it must be (n,)", where)
    _require_fields(samples_set.dtype, fields_of(version), "samples", where)
    samples = samples_set[()] if rows else np.zeros(0, dtype=samples_set.dtype)
    reference = None
    if "reference" in file:
        _require_fields(file["reference"].dtype, REFERENCE_UNITS, "reference", where)
        reference = file["reference"][()]
    motion = file["ground_motion/ag_mps2"]
    replay = file["replay"]
    return RecordedTest(
        samples=_converted(samples, version),
        channels=_channels(samples_set),
        fs_hz=float(samples_set.attrs["fs_hz"]),
        ag_mps2=motion[()],
        ground_motion={k: plain(v) for k, v in motion.attrs.items() if k != "fs_hz"},
        reference=reference,
        test_toml=file["config/test_toml"].asstr()[()],
        rig_toml=file["config/rig_toml"].asstr()[()],
        replay=ReplayData(
            codec=replay["codec"][()].tobytes() if "codec" in replay else b"",
            parameters=json.loads(replay["parameters"].asstr()[()]),
            commands=json.loads(replay["commands"].asstr()[()]),
            skips=replay["skips"][()],
            tares=json.loads(replay["tares"].asstr()[()]),
        ),
        meta={k: plain(v) for k, v in file.attrs.items() if k not in ("schema", _CONVERTED)},
        version=int(file.attrs.get(_CONVERTED, version)),
        axis_names=_texts(samples_set, "axis_names"),
        interface_names=_texts(samples_set, "interface_names"),
    )


def _texts(samples: Any, name: str) -> tuple[str, ...]:
    texts = plain(samples.attrs.get(name))
    return tuple(map(str, texts)) if isinstance(texts, list) else ()


def _channels(samples: Any) -> tuple[Channel, ...]:
    """Return the channels that an open file describes."""
    described = plain(samples.attrs.get("channels"))
    names = samples.dtype.names or ()
    return tuple(
        Channel(one["name"], str(one.get("unit", "")), float(one.get("scale", 1.0)))
        for one in (described if isinstance(described, list) else ())
        if isinstance(one, dict) and one.get("name") in names
    )


def _version(file: Any, where: str) -> int:
    """Return the version of the record in an open file; it must be a known one."""
    schema = plain(file.attrs.get("schema"))
    if not isinstance(schema, str) or not schema.startswith(_SCHEMAS):
        raise InputError(
            "an HDF5 file, but not a recording: the attribute 'schema' "
            + (f"is {schema!r}" if schema is not None else "is missing")
            + f"; it must be {SCHEMA!r}",
            where,
        )
    number = schema.removeprefix(_SCHEMAS)
    version = int(number) if number.isascii() and number.isdecimal() else 0
    if version in VERSIONS:
        return version
    known = f"schema {schema!r}, but this version reads {_SCHEMAS}1 to {VERSION}"
    program = plain(file.attrs.get("rthyb_version"))
    if version < VERSION or not program:
        raise InputError(f"{known}; use the version of rthyb_rt that wrote the file", where)
    raise InputError(f"{known}; {_take_program(f'>={program}')}", where)


def _take_program(which: str) -> str:
    """Return how to obtain another version of this program, given as ``==0.1.0``."""
    return f"pip install 'rthyb-rt{which}'"


def require_replayable(rec: RecordedTest) -> None:
    """Refuse to replay a recording of a version whose rows do not contain all inputs.

    Raises:
        InputError: the recording has an older version; the message states which program replays it.
    """
    if rec.version >= OLDEST_REPLAYED:
        return
    program = rec.meta.get("rthyb_version") or VERSIONS[rec.version].program
    raise InputError(
        f"recorded as version {rec.version} by rthyb_rt {program}; a bit-identical replay needs "
        f"that version: {_take_program(f'=={program}')}",
        "recording",
    )


def _require_fields(dtype: np.dtype[Any], needed: Iterable[str], name: str, where: str) -> None:
    missing = sorted(set(needed) - set(dtype.names or ()))
    if missing:
        raise InputError(f"'{name}' lacks the fields {', '.join(missing)}", where)


def plain(value: Any) -> Any:
    """Return an attribute as a Python value; JSON structures in text are parsed."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8")
    if isinstance(value, str) and value[:1] in ("{", "["):
        with contextlib.suppress(json.JSONDecodeError):
            return json.loads(value)
    return value


def open_run(path: str | Path) -> RecordedTest:
    """Read the recording of a run.

    Args:
        path: the run's folder or the recording itself.

    Raises:
        InputError: there is no recording, or it cannot be read.
    """
    path = Path(path)
    if not path.is_dir():
        return read(path)
    if (path / FILE_NAME).exists():
        return read(path / FILE_NAME)
    runs = [run.parent for run in path.glob(f"*/{FILE_NAME}")]
    newest = max(runs, key=lambda run: (run / FILE_NAME).stat().st_mtime, default=None)
    hint = f"; did you mean {newest}?" if newest else "; give the folder of a run"
    raise InputError(f"no {FILE_NAME} in this folder{hint}", str(path))
