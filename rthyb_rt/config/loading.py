"""Reading TOML text and ``--set`` overrides into checked models; reports all errors at once."""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, get_args

from pydantic import ValidationError

from rthyb_rt import documents
from rthyb_rt.config import busload
from rthyb_rt.config.axesfile import AxesRig, Plant
from rthyb_rt.config.baselinefile import BASELINE_SCHEMA, BaselineFile
from rthyb_rt.config.campaignfile import CAMPAIGN_SCHEMA, CampaignFile
from rthyb_rt.config.changes import ON_COMMAND_LINE, Wording
from rthyb_rt.config.fields import Alternatives, Table, WholeFile, nearest, written
from rthyb_rt.config.lines import KeyLines
from rthyb_rt.config.lines import Path as KeyPath
from rthyb_rt.config.linkframes import frames_are_known, frames_of_link, shared_links
from rthyb_rt.config.mapfile import MAP_SCHEMA, MapFile
from rthyb_rt.config.placing import SourceText
from rthyb_rt.config.prescribed_history import CyclesHistory, History, RandomHistory, with_file
from rthyb_rt.config.rigfile import RIG_SCHEMA, LinkTable, RigFile, assumable, kinds
from rthyb_rt.config.structures import FROM_FILE, WRITTEN_OUT, MatrixFile
from rthyb_rt.config.testfile import TEST_SCHEMA, GroundMotionTable, Numerical, RfcTable, TestFile
from rthyb_rt.errors import InputError, Problem

_Model = TypeVar("_Model", TestFile, RigFile, AxesRig, BaselineFile, MapFile, CampaignFile)

MAX_BYTES = 10 * 10**6

_SCHEMAS: dict[type[Table], str] = {
    TestFile: TEST_SCHEMA, RigFile: RIG_SCHEMA, AxesRig: RIG_SCHEMA,
    BaselineFile: BASELINE_SCHEMA, MapFile: MAP_SCHEMA, CampaignFile: CAMPAIGN_SCHEMA,
}  # fmt: skip

_PACKAGE = Path(__file__).resolve().parents[1]
_SYNTAX_LINE = re.compile(r" \(at (?:line (\d+), column \d+|end of document)\)$")
_TWICE = re.compile(r"Cannot (overwrite a value|declare .* twice)$")

# Tables in which an override of one key replaces the alternatives to it.
_EXCLUSIVE: dict[KeyPath, tuple[Alternatives, ...]] = {
    ("numerical",): Numerical.choices,
    ("ground_motion",): GroundMotionTable.choices,
    ("controller", "rfc"): RfcTable.choices,
    ("history",): (*CyclesHistory.choices, *RandomHistory.choices),
}


def load_test(path: str | Path, overrides: Mapping[str, str] | None = None) -> TestFile:
    """Read a test file.

    A ``rig`` or ``ground_motion.record`` that names a file beside the test file (or, if it comes
    from an override, in the working directory) is returned as an absolute path.

    Args:
        path: the TOML file, or the name of a test that comes with the program.
        overrides: dotted key -> value as typed after ``--set``, for this file only
            (see `split_overrides`).

    Raises:
        InputError: with all errors in the file and the overrides.
    """
    overrides, path = overrides or {}, find_test(path)
    test = parse_test(read_text(path, "test"), str(path), overrides)

    def found(value: str | None, key: str) -> str | None:
        if value is None or not _is_file(place := _place_of(value, key, path, overrides)):
            return value
        return str(place.resolve())

    motion = test.ground_motion
    record = found(motion.record, "ground_motion.record")
    return test.model_copy(
        update={
            "rig": found(test.rig, "rig"),
            "ground_motion": motion.model_copy(update={"record": record}),
            "numerical": _with_places(
                _with_matrices(test, Path(path).parent, overrides), Path(path).parent, overrides
            ),
            "history": _with_steps(test.history, str(path), overrides),
        }
    )


def _place_of(value: str, key: str, path: Path, overrides: Mapping[str, str]) -> Path:
    """Return where a test looks for a file: beside its own, or in the working directory."""
    return (Path() if key in overrides else path.parent) / value


def _with_steps(given: History | None, path: str, overrides: Mapping[str, str]) -> History | None:
    """Read the CSV file of amplitudes and cycles that a history names.

    Raises:
        InputError: with the errors in the file.
    """
    if not isinstance(given, CyclesHistory) or given.file is None:
        return given
    from_override = any(key.startswith("history") for key in overrides)
    return with_file(given, Path() if from_override else Path(path).parent)


def _with_matrices(test: TestFile, folder: Path, overrides: Mapping[str, str]) -> Numerical:
    """Read the file of matrices that a test names, so that the test is complete.

    Raises:
        InputError: with the errors in the file, and where the test names it.
    """
    numerical = test.numerical
    given = numerical.matrices
    if not isinstance(given, MatrixFile) or given.data is not None:
        return numerical
    # NumPy and SciPy are slow to import.
    from rthyb_rt.config import matrixfile
    from rthyb_rt.core import CoreError

    from_override = any(key.startswith("numerical.matrices") for key in overrides)
    try:
        data = matrixfile.read(given, Path() if from_override else folder)
    except CoreError as error:
        raise InputError(str(error), test.source.place(("numerical", "matrices"))) from error
    read = given.model_copy(update={"data": data.packed()})
    return numerical.model_copy(update={"matrices": read})


def _with_places(numerical: Numerical, folder: Path, overrides: Mapping[str, str]) -> Numerical:
    """Return a copy with the path of the user's library or FMU resolved beside the test file."""
    for table in ("library", "fmu"):
        given = getattr(numerical, table)
        if given is not None:
            from_override = any(key.startswith(f"numerical.{table}") for key in overrides)
            file = str(((Path() if from_override else folder) / given.file).resolve())
            numerical = numerical.model_copy(
                update={table: given.model_copy(update={"file": file})}
            )
    return numerical


def load_rig(path: str | Path, overrides: Mapping[str, str] | None = None) -> RigFile:
    """Read a rig file; arguments and errors as for `load_test`.

    Keys of overrides may have the prefix ``rig.``, as on the command line of a test. A DBC file
    beside the rig file (or, from an override, in the working directory) is returned as an absolute
    path; if cantools is installed, it is read to check it and the load of the bus.
    """
    overrides = overrides or {}
    text = read_text(path, "rig")
    rig = parse_rig(text, str(path), overrides)
    return rig.model_copy(update={"link": _with_dbc(rig.link, ("link",), text, path, overrides)})


def load_any_rig(path: str | Path, overrides: Mapping[str, str] | None = None) -> RigFile | AxesRig:
    """Read a rig file with one axis or several; arguments and errors as for `load_rig`.

    In keys of overrides an axis is named: ``rig.axis.left.actuator.kp_per_s``. The file of a plant
    is read as well.
    """
    overrides = overrides or {}
    text = read_text(path, "rig")
    rig = parse_any_rig(text, str(path), overrides)
    if isinstance(rig, RigFile):
        link = _with_dbc(rig.link, ("link",), text, path, overrides)
        return rig.model_copy(update={"link": link})
    axes = []
    for i, axis in enumerate(rig.axis):
        place: KeyPath = ("axis", i, "link")
        link = _with_dbc(axis.link, place, text, path, overrides, f"axis.{axis.name}.link")
        axes.append(axis.model_copy(update={"link": link}))
    update: dict[str, Any] = {"axis": axes}
    if rig.plant is not None and rig.plant.file is not None:
        given = {_override_path(AxesRig, key) for key in overrides}
        folder = Path() if ("plant", "file") in given else Path(path).parent
        where = f"{path}:{KeyLines(text).find(('plant', 'file'))}: plant.file"
        update["plant"] = _read_plant(rig.plant, folder, len(axes), where)
    rig = rig.model_copy(update=update)
    faults = shared_links(rig)
    if faults:
        lines = KeyLines(text)
        raise InputError(
            Problem(f"{path}:{lines.find(('axis', i, 'link'))}: axis.{rig.names[i]}.link", message)
            for i, message in faults
        )
    return rig


def with_some_stiffness(path: str | Path, overrides: Mapping[str, str]) -> dict[str, str]:
    """Return overrides that give k_e to a rig of one axis without one, for what does not use it.

    Args:
        path: the rig file.
        overrides: as for `load_rig`.
    """
    k_e, found = "elastic_stiffness_n_per_m", dict(overrides)
    try:
        raw = tomllib.loads(read_text(path, "rig"))
    except (InputError, ValueError, RecursionError):
        return found  # reported when the file is read
    table = raw.get("rig")
    missing = isinstance(table, dict) and k_e not in table and "axis" not in raw
    if missing and not any(key.endswith(k_e) for key in overrides):
        # Any value will do.
        found[f"rig.{k_e}"] = "1"
    return found


def _read_plant(plant: Plant, folder: Path, axes: int, where: str) -> Plant:
    """Return a plant with the matrices of its file, checked like those in a rig file.

    Raises:
        InputError: with the file and its errors.
    """
    assert plant.file is not None
    path = folder / plant.file
    from rthyb_rt.config import plantfile

    values = {**plantfile.read(path, where), "stroke_m": plant.stroke_m}
    try:
        return Plant.model_validate(values)
    except ValidationError as error:
        raise InputError(
            Problem(f"{where}: {path}: {'.'.join(str(p) for p in fault['loc'])}",
                    str(fault["ctx"]["text"]))
            for fault in error.errors(include_url=False, include_input=False)
        ) from None  # fmt: skip


def _with_dbc(
    link: LinkTable | None, place: KeyPath, text: str, path: str | Path,
    overrides: Mapping[str, str], name: str = "link",
) -> LinkTable | None:  # fmt: skip
    """Return a link with the absolute path of its DBC file, which is read and checked.

    Raises:
        InputError: with the errors in the DBC file.
    """
    if link is None or link.dbc is None:
        return link
    raw = _toml(text, str(path))
    given = {_by_name(raw, _override_path(RigFile, key)): key for key in overrides}
    folder = Path() if (*place, "dbc") in given else Path(path).parent
    link = link.model_copy(update={"dbc": str((folder / link.dbc).resolve())})
    fault = _dbc_fault(link)
    if fault is not None:
        key, message = fault
        blamed = given.get((*place, key)) or given.get((*place, "dbc")) or given.get(place)
        line = KeyLines(text).find((*place, key))
        raise InputError(message, f"--set {blamed}" if blamed else f"{path}:{line}: {name}.{key}")
    return link


def load_both(
    test_path: str | Path | None, rig: str | None, settings: Iterable[str]
) -> tuple[TestFile, RigFile]:
    """Read a test file and the rig file that goes with it, with one axis.

    Args:
        test_path: the test file; None: the built-in test.
        rig: path or name of the rig; None: the one that the test names.
        settings: ``key=value`` as given with ``--set``.

    Raises:
        InputError: with the errors of both files.
    """
    return _load_both(test_path, rig, settings, load_rig)


def load_any_both(
    test_path: str | Path | None, rig: str | None, settings: Iterable[str]
) -> tuple[TestFile, RigFile | AxesRig]:
    """Read both files, the rig with one axis or several; otherwise like `load_both`."""
    return _load_both(test_path, rig, settings, load_any_rig)


_Rig = TypeVar("_Rig", bound=RigFile | AxesRig)


def _load_both(
    test_path: str | Path | None, rig: str | None, settings: Iterable[str],
    load: Callable[[Path, dict[str, str]], _Rig],
) -> tuple[TestFile, _Rig]:  # fmt: skip
    test_settings, rig_settings = split_overrides(settings)
    problems: list[Problem] = []
    test: TestFile | None = None
    rig_file: _Rig | None = None
    test_path = find_test(test_path) if test_path else builtin_test_path()
    try:
        test = load_test(test_path, test_settings)
    except InputError as error:
        problems += error.problems
    try:
        if rig:
            rig_file = load(find_rig(rig), rig_settings)
        elif test is not None:
            rig_file = load(rig_of_test(test, test_path, test_settings), rig_settings)
        elif named := _rig_of_faulty(Path(test_path), test_settings):
            rig_file = load(named, rig_settings)
    except InputError as error:
        problems += error.problems
    if test is None or rig_file is None:
        raise InputError(problems)
    return test, rig_file


def _rig_of_faulty(path: Path, overrides: Mapping[str, str]) -> Path | None:
    """Return the file of the rig that a test file with errors names; None if it names none."""
    try:
        name = overrides.get("rig") or documents.toml(read_text(path, "test")).get("rig")
    except (InputError, ValueError, RecursionError):
        return None
    if not isinstance(name, str):
        return None
    place = _place_of(name, "rig", path, overrides)
    return place if _is_file(place) else shipped("rig").get(name)


def _dbc_fault(link: LinkTable) -> tuple[str, str] | None:
    """Return the key of a link that is incompatible with its DBC file, and the reason.

    Raises:
        InputError: with all errors in the DBC file itself.
    """
    assert link.dbc is not None
    if not _is_file(Path(link.dbc)):
        return (
            "dbc",
            f"found {written(link.dbc)}; no such file; a relative path is relative to the folder "
            "of the rig file",
        )
    if not frames_are_known(link):
        return None
    frames = frames_of_link(link)
    if any(frame.fd for frame in frames) and not link.fd:
        return "fd", "found false, but the DBC file has CAN FD frames; set fd = true"
    if link.bitrate is None:
        return None
    fault = busload.bus_fault(frames, link.bitrate, link.data_bitrate, rate_hz=link.sample_rate_hz)
    return None if fault is None else ("bitrate", fault)


def parse_test(
    text: str,
    source: str = "test",
    overrides: Mapping[str, str] | None = None,
    wording: Wording = ON_COMMAND_LINE,
) -> TestFile:
    """Check the text of a test file.

    Args:
        text: content of the file.
        source: its name in messages.
        overrides: dotted key -> value as typed after ``--set``.
        wording: how messages refer to an override.

    Raises:
        InputError: with all errors of text and overrides.
    """
    return _parse(TestFile, TEST_SCHEMA, text, source, overrides or {}, wording=wording)


def parse_rig(
    text: str,
    source: str = "rig",
    overrides: Mapping[str, str] | None = None,
    wording: Wording = ON_COMMAND_LINE,
) -> RigFile:
    """Check the text of a rig file with one axis; arguments and errors as for `parse_test`."""
    raw = _toml(text, source)
    if "axis" in raw:
        names = ", ".join(_axis_names(raw)) or "several"
        raise InputError(
            f"found [[axis]]: this rig has several axes ({names}), but a rig with one axis is "
            "needed here",
            f"{source}:{KeyLines(text).find(('axis',))}",
        )
    return _parse(RigFile, RIG_SCHEMA, text, source, overrides or {}, raw, wording=wording)


def parse_any_rig(
    text: str,
    source: str = "rig",
    overrides: Mapping[str, str] | None = None,
    wording: Wording = ON_COMMAND_LINE,
) -> RigFile | AxesRig:
    """Check the text of a rig file with one axis or several; otherwise like `parse_test`."""
    raw, given = _toml(text, source), overrides or {}
    if "axis" in raw:
        return _parse(AxesRig, RIG_SCHEMA, text, source, given, raw, wording=wording)
    return _parse(RigFile, RIG_SCHEMA, text, source, given, raw, wording=wording)


def has_axes(path: str | Path) -> bool:
    """Return whether a rig file has several axes; raises ``InputError`` if it is not TOML."""
    return "axis" in _toml(read_text(path, "rig"), str(path))


def _axis_names(raw: Mapping[str, Any]) -> list[str]:
    tables = raw.get("axis")
    found = [one.get("name") for one in tables if isinstance(one, dict)] if isinstance(
        tables, list) else []  # fmt: skip
    return [name for name in found if isinstance(name, str)]


_NAMED: Final = ("axis", "sensor")
"""Lists of a rig file for several axes whose tables have names."""


def _by_name(raw: Mapping[str, Any], path: KeyPath) -> KeyPath:
    """Return a place in which an axis or sensor is named by its number instead of its name."""
    if len(path) < 2 or path[0] not in _NAMED or not isinstance(path[1], str):
        return path
    tables = raw.get(str(path[0]))
    for number, one in enumerate(tables if isinstance(tables, list) else []):
        if isinstance(one, dict) and one.get("name") == path[1]:
            return (path[0], number, *path[2:])
    return path


def _shown(raw: Mapping[str, Any], place: KeyPath) -> str:
    """Return a place as shown in messages: an axis or sensor by its name, if it has one."""
    parts = list(place)
    if len(parts) > 1 and parts[0] in _NAMED and isinstance(parts[1], int):
        tables = raw.get(str(parts[0]))
        own = tables[parts[1]] if isinstance(tables, list) and parts[1] < len(tables) else None
        name = own.get("name") if isinstance(own, dict) else None
        if isinstance(name, str) and name:
            parts[1] = name
    return ".".join(str(part) for part in parts)


def check_values(model: type[_Model], values: Mapping[str, Any], source: str) -> _Model:
    """Check the values of a file that exists only in memory, table by table as in TOML.

    Args:
        model: model of the file.
        values: key -> value, a table being a mapping of its own; without ``schema``.
        source: its name in messages.

    Raises:
        InputError: with all errors, each with its key and what is allowed there.
    """
    raw = {"schema": _SCHEMAS[model], **values}
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        problems = []
        for fault in error.errors(include_url=False, include_input=False):
            name = ".".join(str(part) for part in _key_path(fault["loc"], raw))
            where = f"{source}: {name}" if name else source
            problems.append(Problem(where, str(fault["ctx"]["text"])))
        raise InputError(problems) from None


def parse_baseline(text: str, source: str = "baseline") -> tuple[BaselineFile, list[str]]:
    """Check the text of a baseline file; ``source`` is its name in messages.

    Returns:
        The file, and the keys in it that are not used here. Laboratories keep more in such a file
        than the diagnosis reads; a key that resembles a known one is taken for a typing error.

    Raises:
        InputError: with all errors, each with its line and what is allowed there.
    """
    raw = _toml(text, source)
    strange: list[str] = []
    if raw.get("schema") == BASELINE_SCHEMA:
        _set_aside(raw, BaselineFile, "", strange)
    return _parse(BaselineFile, BASELINE_SCHEMA, text, source, {}, raw), strange


def schema_of(text: str, source: str) -> object:
    """Return the schema that a TOML text states, or None.

    Raises:
        InputError: the text is not TOML; with the line.
    """
    return _toml(text, source).get("schema")


def parse_map(text: str, source: str = "mapping") -> MapFile:
    """Check the text of a mapping file; ``source`` is its name in messages."""
    return _parse(MapFile, MAP_SCHEMA, text, source, {})


def parse_campaign(text: str, source: str = "campaign") -> CampaignFile:
    """Check the text of a campaign file; ``source`` is its name in messages."""
    return _parse(CampaignFile, CAMPAIGN_SCHEMA, text, source, {})


def _set_aside(table: dict[str, Any], model: type[Table], prefix: str, strange: list[str]) -> None:
    """Remove the keys from a table that a model does not have and that resemble none it has."""
    fields = {info.alias or name: info for name, info in model.model_fields.items()}
    for key in list(table):
        if key not in fields:
            if not nearest(key, list(fields)):
                del table[key]
                inside = [name for name in fields if key in name]
                hint = f" (did you mean {inside[0]}?)" if inside else ""
                strange.append(f"{prefix}{key}{hint}")
        elif isinstance(table[key], dict):
            for part in (fields[key].annotation, *get_args(fields[key].annotation)):
                if isinstance(part, type) and issubclass(part, Table):
                    _set_aside(table[key], part, f"{prefix}{key}.", strange)


def split_overrides(settings: Iterable[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Divide ``key=value`` settings into those of the test file and those of the rig file.

    ``rig.actuator.kp_per_s=60`` belongs to the rig file; ``rig=NAME`` selects the rig and belongs
    to the test file. A later setting of the same key replaces an earlier one.

    Raises:
        InputError: a setting has no ``=`` or no key.
    """
    test: dict[str, str] = {}
    rig: dict[str, str] = {}
    problems = []
    for setting in settings:
        key, equals, value = setting.partition("=")
        key = key.strip()
        if not equals or not key:
            problems.append(
                Problem(
                    "--set", f"found {written(setting)}; must be KEY=VALUE, such as controller.w1=3"
                )
            )
        else:
            (rig if key.startswith("rig.") else test)[key] = value.strip()
    if problems:
        raise InputError(problems)
    return test, rig


def json_schema(kind: Literal["test", "rig", "baseline", "map", "campaign"]) -> dict[str, Any]:
    """Return the JSON schema of one type of file, for editors that complete TOML."""
    models: dict[str, type[Table]] = {
        "test": TestFile, "rig": RigFile, "baseline": BaselineFile, "map": MapFile,
        "campaign": CampaignFile,
    }  # fmt: skip
    schema = models[kind].model_json_schema()
    if kind == "rig":
        # A file with [[axis]] has several axes; what both kinds have is described once.
        several = AxesRig.model_json_schema()
        parts = {**several.pop("$defs"), **schema.pop("$defs")}
        names = {**schema["properties"], **several["properties"]}
        schema = {
            "title": "Rig file",
            "type": "object",
            "properties": {name: {} for name in names},
            "required": ["schema", "rig"],
            "if": {"required": ["axis"]},
            "then": several,
            "else": schema,
            "$defs": parts,
        }
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def builtin_test_path() -> Path:
    """Return the default test file: Section 5, T = 0.5 s."""
    return _shipped("examples") / "section5-T0.5.toml"


def shipped_rig(name: str) -> Path:
    """Return the file of a rig that comes with the program.

    Raises:
        InputError: no rig has this name; the message lists the names.
    """
    return _named("rig", name)


def shipped_test(name: str) -> Path:
    """Return the file of a test that comes with the program; errors as for `shipped_rig`."""
    return _named("test", name)


def shipped(kind: Literal["rig", "test"]) -> dict[str, Path]:
    """Return the files that come with the program, by name."""
    folder = _shipped({"rig": "rigs", "test": "examples"}[kind])
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def test_as_model(name_or_path: str) -> str:
    """Return the file of a shipped test for its name; anything else as it is.

    As a model, a test is its rig and its numerical part; a rig of the same name goes before it.
    """
    if Path(name_or_path).exists() or name_or_path in shipped("rig"):
        return name_or_path
    return str(shipped("test").get(name_or_path, name_or_path))


def _named(kind: Literal["rig", "test"], name: str) -> Path:
    files = shipped(kind)
    if name in files:
        return files[name]
    known = ", ".join(files) or "none"
    other: Literal["rig", "test"] = "test" if kind == "rig" else "rig"
    hint = f" (it is a {other})" if name in shipped(other) else nearest(name, list(files))
    raise InputError(
        f"found {written(name)}; no file and no {kind} of that name{hint}; "
        f"give the path of a {kind} file, or the name of one that comes with the program: {known}",
        where=kind,
    )


def find_test(name_or_path: str | Path) -> Path:
    """Return the file of a test given by path or by the name of a shipped one.

    Raises:
        InputError: no test has this name; a path is returned whether the file exists or not.
    """
    return find("test", name_or_path)


def find(kind: Literal["rig", "test"], name_or_path: str | os.PathLike[str]) -> Path:
    """Return a file given by path, or by the name of a shipped one; errors as for `find_test`."""
    path = Path(name_or_path)
    if path.is_file() or path.suffix == ".toml" or len(path.parts) > 1:
        return path
    return _named(kind, str(name_or_path))


def find_rig(name_or_path: str | None) -> Path:
    """Return the file of a rig given by path or by the name of a shipped one.

    Raises:
        InputError: no rig is given, or none is found.
    """
    if name_or_path is None:
        raise InputError(
            'the test names no rig; add rig = "NAME" to the test file or use --rig RIG.toml',
            where="rig",
        )
    return Path(name_or_path) if _is_file(Path(name_or_path)) else shipped_rig(name_or_path)


def rig_of_test(
    test: TestFile, path: str | Path, overrides: Mapping[str, str] | None = None
) -> Path:
    """Return the file of the rig that a test names.

    Args:
        test: the test that `load_test` returned for the other two.
        path: the test file.
        overrides: dotted key -> value as typed after ``--set``.

    Raises:
        InputError: the test names no rig, or one that does not exist; with the line of the test
            file.
    """
    try:
        return find_rig(test.rig)
    except InputError as error:
        if "rig" in (overrides or {}):
            where = "--set rig"
        else:
            where = f"{path}:{KeyLines(read_text(path, 'test')).find(('rig',))}: rig"
        raise InputError(Problem(where, problem.message) for problem in error.problems) from None


def _shipped(what: str) -> Path:
    """Return the folder of shipped files: package data of a wheel, or the repository's own."""
    packaged = _PACKAGE / "_hw" / what
    if packaged.is_dir():
        return packaged
    return _PACKAGE.parent / {"rigs": "hw/rigs", "examples": "examples"}[what]


def _is_file(path: Path) -> bool:
    """Return whether a path is not a folder; a device or a pipe is rejected when it is read."""
    try:
        return path.exists() and not path.is_dir()
    except (OSError, ValueError):
        return False


def read_text(path: str | Path, kind: str) -> str:
    """Return the text of a ``kind`` ("test" or "rig") file.

    Raises:
        InputError: there is no regular file of at most 10 MB, or it is not UTF-8.
    """
    try:
        # Reading a pipe would block, and a device may be endless.
        if not stat.S_ISREG(Path(path).stat().st_mode):
            raise InputError(
                f"cannot be read (not a regular file); give the path of a {kind} file",
                str(path),
            )
        with Path(path).open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise InputError(
            f"no such file; give the path of a {kind} file{_shipped_as(path, kind)}", str(path)
        ) from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(
            f"cannot be read ({reason}); give the path of a readable {kind} file", str(path)
        ) from None
    if len(data) > MAX_BYTES:
        raise InputError(
            f"is larger than {MAX_BYTES // 10**6} MB, the limit for a {kind} file; give the path "
            f"of a {kind} file",
            str(path),
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"byte {data[error.start]:#04x} is not UTF-8 text; save the file as UTF-8",
            f"{path}:{line}",
        ) from None


def _shipped_as(path: str | Path, kind: str) -> str:
    """Return a hint if a shipped file has the name of a path that does not exist."""
    name = Path(path).stem
    if kind not in ("test", "rig") or name not in shipped("test" if kind == "test" else "rig"):
        return ""
    return f", or {name} without .toml for the {kind} that comes with the program"


def _table_at(raw: Any, path: KeyPath) -> Any:
    """Return what a file has at a place; None: nothing."""
    for part in path:
        try:
            raw = raw[part]
        except (KeyError, IndexError, TypeError):
            return None
    return raw


def _state(raw: dict[str, Any], given: Collection[KeyPath]) -> None:
    """Remove from the list of a rig's assumed values, in place, those that an override states.

    Args:
        raw: the file with all overrides.
        given: places of the overrides.
    """
    rig = raw.get("rig")
    listed = rig.get("assumed") if isinstance(rig, dict) else None
    if not (isinstance(rig, dict) and isinstance(listed, list)) or ("rig", "assumed") in given:
        return
    stated = [_shown(raw, path) for path in given]
    # Another kind of actuator has none of the former keys.
    stated += [
        _shown(raw, path[:-1])
        for path in given
        if path[-2:] == ("actuator", "kind") and not assumable(_table_at(raw, path[:-1]))
    ]
    rig["assumed"] = [
        key
        for key in listed
        if not any(key == one or str(key).startswith(f"{one}.") for one in stated)
    ]


def _parse(
    model: type[_Model], schema: str, text: str, source: str, overrides: Mapping[str, str],
    raw: dict[str, Any] | None = None, wording: Wording = ON_COMMAND_LINE,
) -> _Model:  # fmt: skip
    raw = _toml(text, source) if raw is None else raw
    if isinstance(raw.get("schema"), str) and raw["schema"] != schema:
        raise InputError(
            _schema_message(raw["schema"], schema), f"{source}:{KeyLines(text).find(('schema',))}"
        )
    problems: list[Problem] = []
    given: dict[KeyPath, str] = {}
    for key, value in overrides.items():
        path = _by_name(raw, _override_path(model, key))
        complaint = _override(raw, path, value, set(given), wording)
        if complaint:
            problems.append(Problem(wording.place(key), complaint))
        else:
            given[path] = key
    _state(raw, given)
    # Tables whose kind was changed, and those whose other keys do not match it.
    new_kinds: dict[KeyPath, int | str] = {
        key[:-1]: key[-1]
        for key in given
        if key[-1] in ("kind", "element") and {"actuator", "specimen", "history"} & set(key[:3])
    }
    unfit: set[KeyPath] = set()
    placed: list[tuple[int, Problem]] = []
    try:
        result = model.model_validate(raw)
    except ValidationError as error:
        lines = KeyLines(text)
        for fault in error.errors(include_url=False, include_input=False):
            place: KeyPath = _key_path(fault["loc"], raw)
            message = str(fault["ctx"]["text"])
            if place[:-1] in new_kinds and message.startswith(("unknown key", "missing")):
                unfit.add(place[:-1])
                continue
            names: tuple[str, ...] = fault["ctx"]["involved"]
            involved: list[KeyPath] = [place[:-1] + tuple(each.split(".")) for each in names]
            culprit = _override_to_blame(place, involved, given, lines)
            if culprit:
                at = _by_name(raw, _override_path(model, culprit))
                name = ".".join(str(part) for part in place[len(at) :])
                if message.startswith("missing") and place[: len(at)] != at:
                    name = _shown(raw, place)
                problems.append(
                    Problem(wording.place(culprit), f"{name}: {message}" if name else message)
                )
            else:
                line = lines.find(place)
                name = _shown(raw, place)
                where = f"{source}:{line}: {name}" if name else f"{source}:{line}"
                placed.append((line, Problem(where, message)))
    changed: KeyPath
    for changed in sorted(unfit, key=str):
        name = given[(*changed, new_kinds[changed])]
        problems.append(Problem(wording.place(name), _kind_message(raw, changed, name, wording)))
    problems = [problem for _, problem in sorted(placed, key=lambda pair: pair[0])] + problems
    if problems:
        raise InputError(problems)
    if isinstance(result, WholeFile):
        return result.read_from(SourceText(source, text, given, wording))
    return result


def _kind_message(raw: dict[str, Any], path: KeyPath, override: str, wording: Wording) -> str:
    """Return how to change the kind of a table, with the keys that the new kind needs."""
    values: Any = raw
    for part in path:
        values = values[part]
    name, tag = override.rpartition(".")[::2]
    kind = values[tag]
    (model,) = (
        model
        for model in (*kinds(), *get_args(History))
        if tag in model.model_fields and kind in get_args(model.model_fields[tag].annotation)
    )
    needed = {
        key: written(values[key]) if key in values else "..."
        for key, info in model.model_fields.items()
        if info.is_required()
    }
    return (
        f"{written(kind)} has different keys from those in the file; set the whole table: "
        f"{wording.whole(name, needed)} (allowed: {', '.join(model.model_fields)})"
    )


def _override_to_blame(
    path: KeyPath, involved: list[KeyPath], given: dict[KeyPath, str], lines: KeyLines
) -> str | None:
    """Return the ``--set`` key that caused an error at a place, if any."""
    for key in involved:
        if key in given:
            return given[key]
    # A table given as a whole replaces that of the file with all its keys.
    for size in range(len(path), 0, -1):
        if path[:size] in given:
            return given[path[:size]]
    for size in range(len(path), 0, -1):
        part = path[:size]
        if lines.has(part):
            return None
        for key, name in given.items():
            if key[:size] == part:
                return name
    return None


def _schema_message(found: str, wanted: str) -> str:
    kinds = {
        TEST_SCHEMA: "a test file",
        RIG_SCHEMA: "a rig file",
        BASELINE_SCHEMA: "a baseline file",
        MAP_SCHEMA: "a mapping file",
        CAMPAIGN_SCHEMA: "a campaign file",
    }
    if found in kinds:
        return f"this is {kinds[found]}, and {kinds[wanted]} (schema = {written(wanted)}) is needed"
    return (
        f"found schema = {written(found)}; {kinds[wanted]} starts with schema = {written(wanted)}"
    )


def _toml(text: str, source: str) -> dict[str, Any]:
    try:
        return documents.toml(text)
    except RecursionError:
        raise InputError("not valid TOML: nested too deeply", source) from None
    except ValueError as error:
        match = _SYNTAX_LINE.search(str(error))
        rows = text.splitlines() or [""]
        line = int(match[1]) if match and match[1] else len(rows)
        what = str(error)[: match.start()] if match else str(error)
        row = rows[min(line, len(rows)) - 1].strip()
        how = "keys are written as key = value, text in double quotes"
        if _TWICE.match(what):
            what, how = "the key or table is given twice", "keep only one of them"
        raise InputError(
            f"not valid TOML: {what}; found {written(row)}; {how}",
            f"{source}:{line}",
        ) from None


def _override_path(model: type[Table], key: str) -> KeyPath:
    """Return the place that a ``--set`` key refers to; a rig's key may have the prefix ``rig.``."""
    parts: list[str | int] = [int(part) if part.isdecimal() else part for part in key.split(".")]
    of_rig = model in (RigFile, AxesRig)
    if of_rig and len(parts) > 1 and parts[0] == "rig" and parts[1] in model.model_fields:
        parts = parts[1:]
    return tuple(parts)


def _override(
    raw: dict[str, Any], path: KeyPath, text: str, given: set[KeyPath], wording: Wording
) -> str | None:
    """Put an override into the values of a file; return the error message if it has no place."""
    if "" in path:
        return "the key has an empty part; keys are written as controller.w1"
    place: Any = raw
    for depth, part in enumerate(path):
        last = depth == len(path) - 1
        name = ".".join(str(key) for key in path[:depth])
        if isinstance(place, list):
            if not isinstance(part, int) or part >= len(place):
                named = [
                    str(one["name"]) for one in place if isinstance(one, dict) and "name" in one
                ]
                by_name = f" ({', '.join(named)})" if name in _NAMED and named else ""
                has = f"the entries 0 to {len(place) - 1}{by_name}" if place else "no entries"
                hint = "" if isinstance(part, int) or by_name else (
                    f"; it is a list of tables: give the whole list, {name} = [{{ ... }}], or the "
                    f"number of an entry, {name}.0.{part}"
                )  # fmt: skip
                return f"{name} has {has}; found {written(part)}{hint}"
            if last:
                place[part] = _override_value(text)
            place = place[part]
        elif isinstance(place, dict):
            key = str(part)
            if last:
                _drop_alternatives(place, path, given)
                place[key] = _override_value(text)
            place = place.setdefault(key, {})
        else:
            return (
                f"{name} is {written(place)}, which has no keys; set the whole value: "
                f"{wording.whole(name, {str(part): text})}"
            )
    return None


def _drop_alternatives(table: dict[str, Any], path: KeyPath, given: set[KeyPath]) -> None:
    """Let a period from the command line replace the mass in the file, and so on."""
    for choice in _EXCLUSIVE.get(path[:-1], ()):
        if path[-1] in choice.keys:
            for key in choice.keys:
                if (*path[:-1], key) not in given:
                    table.pop(key, None)


def _override_value(text: str) -> Any:
    """Read a value as TOML; anything else is taken as text, so that names need no quotes."""
    try:
        values = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    value = values["value"]
    plain = isinstance(value, (str, bool, int, float, list, dict))
    return value if plain and len(values) == 1 else text


def _key_path(loc: tuple[int | str, ...], raw: dict[str, Any]) -> KeyPath:
    """Return the keys of the file for a place in the models, without the names of union members.

    A short form, such as a limit given as a number, ends the path.
    """
    path: list[int | str] = []
    place: Any = raw
    tag_seen = False
    for part in loc:
        if part in (WRITTEN_OUT, FROM_FILE):
            continue
        tags = (place.get("kind"), place.get("element")) if isinstance(place, dict) else ()
        if part in tags and not tag_seen:
            tag_seen = True
            continue
        if path and not isinstance(place, (dict, list)):
            break
        tag_seen = False
        path.append(part)
        if isinstance(place, dict):
            place = place.get(str(part), {})
        elif isinstance(part, int) and part < len(place):
            place = place[part]
    return tuple(path)
