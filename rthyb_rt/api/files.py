"""Test and rig as immutable objects, created from files, names or keywords; written as TOML."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, Literal, Self, TypeVar

import numpy as np

from rthyb_rt import config
from rthyb_rt.api import read_only
from rthyb_rt.config import AxesRig, RigFile, TestFile
from rthyb_rt.config.fields import Table, nearest, with_extension, written
from rthyb_rt.config.own_tables import PYTHON
from rthyb_rt.documents import flat
from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.core.own import Own

Place = str | os.PathLike[str]
"""How messages refer to a file in Python."""

_File = TypeVar("_File", bound=TestFile | RigFile | AxesRig)
RIG: Final = "rig"


def path_of(given: object, where: str, what: str, instead: str = "") -> Path:
    """Return an argument as a path.

    Args:
        given: the argument.
        where: the function or argument, for messages.
        what: what the path refers to, such as "the folder of a run".
        instead: what may be given instead of a path, such as "a recording".

    Raises:
        InputError: it is not a path.
    """
    if isinstance(given, (str, os.PathLike)) and os.fspath(given) not in ("", b""):
        path = os.fspath(given)
        if isinstance(path, str):
            return Path(path)
    or_else = f"{instead}, or " if instead else ""
    raise InputError(
        f"found {in_words(given)}; give {or_else}the path of {what} as a string or a Path", where
    )


def in_words(given: object) -> str:
    """Return what was given, for a message: an object of this program by its kind and name."""
    if isinstance(given, (Test, Rig)):
        return f'the {given._kind} "{given.name}"'
    kind = type(given)
    if kind.__module__.startswith(f"{__package__}."):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        return f"{article} {kind.__name__.lower()}"
    if isinstance(given, type):
        return f"the class {given.__name__}"
    return "nothing (None)" if given is None else written(given)


def plain(value: Any) -> Any:
    """Return a value as stored in a file: NumPy scalars and paths become plain Python values.

    An object of a user-defined class is represented by its class and its settings.

    Raises:
        InputError: its class cannot be imported by name, or its settings cannot be represented in a
            file.
    """
    if isinstance(value, type) and hasattr(value, "_made_of_own"):
        raise InputError(
            f"found the class {value.__name__}; give an instance, {value.__name__}(...), with its "
            "settings",
            value.__name__,
        )
    if hasattr(type(value), "_made_of_own"):
        return _of_own(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if not isinstance(key, str):
                raise InputError(
                    f"found {written(key)} as the name of a key; a key is a string as in the file, "
                    'such as "w1", or dotted, "controller.w1"',
                    "keys",
                )
            if hasattr(type(inner), "_made_of_own"):
                _require_place(inner, key)
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        for inner in value:
            if hasattr(type(inner), "_made_of_own"):
                _require_element(inner)
        return [plain(inner) for inner in value]
    return value


def _require_element(made: Own) -> None:
    """Refuse an object of a user's class in a list, unless it is an element.

    Raises:
        InputError: with what it is, and where it belongs.
    """
    from rthyb_rt.core.own import Element

    if not isinstance(made, Element):
        _require_place(made, "specimen")


def _require_place(made: Own, key: str) -> None:
    """Refuse an object of a user's class at a key that is not its own.

    Raises:
        InputError: with what it is, and where it belongs.
    """
    from rthyb_rt.core.own import ControlLaw, Element, NumericalPart

    last = key.rpartition(".")[2]
    if last in (PYTHON, "class"):
        raise _own_too_deep(made, key)
    for kind, place, form in (
        (ControlLaw, "controller", "as controller={0}(...)"),
        (NumericalPart, "numerical", "as numerical={0}(...)"),
        (
            Element,
            "",
            'in a list: rig.with_(specimen=[{0}(...)]), or rig={{"specimen": [{0}(...)]}}',
        ),
    ):
        if isinstance(made, kind) and last != place:
            name = type(made).__name__
            raise InputError(
                f"found an object of {name}, which is {kind.what}; give it {form.format(name)}",
                key,
            )


def _own_too_deep(made: Own, key: str) -> InputError:
    """Return the error for an object that is given as a key of the table that it stands for."""
    from rthyb_rt.core.own import ControlLaw, Element

    name = type(made).__name__
    form = f"numerical={name}(...)"
    if isinstance(made, (ControlLaw, Element)):
        law = isinstance(made, ControlLaw)
        form = f"controller={name}(...)" if law else f"specimen=[{name}(...)]"
    return InputError(
        f"found an object of {name} below the key {key}; it stands for its whole table: {form}",
        name,
    )


def _of_own(made: Own) -> dict[str, Any]:
    """Return the table that represents a user-defined object in a file."""
    from rthyb_rt.core import CoreError
    from rthyb_rt.core.own import ControlLaw, Element, spelled

    try:
        table = spelled(made).plain()
    except CoreError as error:
        raise InputError(str(error), type(made).__name__) from error
    if isinstance(made, ControlLaw):
        return {"type": PYTHON, PYTHON: table}
    return {"element": PYTHON, **table} if isinstance(made, Element) else {PYTHON: table}


def _changes(given: Mapping[str, Any] | None, tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `with_` by dotted key, with the keys of tables listed separately."""
    if given is not None and not isinstance(given, Mapping):
        raise InputError(
            f"found {written(given)}; changes are a dict of dotted keys, "
            'with_({"controller.w1": 3}), or tables by keyword, with_(controller={"w1": 3})',
            "with_",
        )
    return {**plain(given or {}), **dict(flat(plain(tables)))}


def _without(values: dict[str, Any], key: str, own: str) -> None:
    """Remove a key from the values of a file, in which it is called ``own``.

    Raises:
        InputError: there is no such key.
    """
    *tables, last = own.split(".")
    place: Any = values
    for part in tables:
        place = place.get(part) if isinstance(place, dict) else None
    if not isinstance(place, dict) or last not in place:
        known = list(place) if isinstance(place, dict) else []
        allowed = f"; keys there are: {', '.join(known)}" if known else ""
        raise InputError(
            f"found None, which removes a key, but there is no such key"
            f"{nearest(last, known)}{allowed}",
            config.IN_PYTHON.place(key),
        )
    place[last] = None


class _Document(Generic[_File]):
    """Common base of test and rig."""

    _kind: ClassVar[Literal["test", "rig"]]
    _model: ClassVar[type[Table]]
    _file: _File
    _origin: str

    def __getitem__(self, key: str) -> Any:
        """Return the value of a dotted key, such as ``"numerical.mass_kg"``.

        A table or a list refuses every change, since `with_` returns a changed copy.

        Raises:
            InputError: there is no such key; the message lists the keys of that table.
        """
        place: Any = self._file.model_dump(by_alias=True)
        for depth, part in enumerate(str(key).split(".")):
            inside = place.get(part, ...) if isinstance(place, dict) else ...
            if isinstance(place, list) and part.isdecimal() and int(part) < len(place):
                inside = place[int(part)]
            if inside is ...:
                known = list(place) if isinstance(place, dict) else []
                table = ".".join(str(key).split(".")[:depth]) or f"a {self._kind} file"
                raise InputError(
                    f"no such key{nearest(part, known)}; {table} has: "
                    f"{', '.join(known) or 'no keys'}",
                    f"{self._kind}[{written(key)}]",
                )
            place = inside
        return read_only.of(place, self._kind, str(key))

    __iter__ = None
    """Without it, Python would ask for the keys 0, 1 and so on."""

    def __contains__(self, key: object) -> bool:
        """Return whether there is a dotted key, such as ``"numerical.mass_kg"``."""
        try:
            self[str(key)]
        except InputError:
            return False
        return True

    if not TYPE_CHECKING:  # otherwise every attribute would be known to mypy

        def __getattr__(self, name: str) -> Any:
            """Refuse an unknown attribute; the name of a table, with how it is read."""
            if name.startswith("_"):  # asked for by copy, pickle and notebooks
                raise AttributeError(name)
            if name in self:
                raise AttributeError(f'a value is read by its key, {self._kind}["{name}"]')
            known = [one for one in dir(type(self)) if one[0] != "_"]
            raise AttributeError(f"a {self._kind} has no attribute {name}{nearest(name, known)}")

    if not TYPE_CHECKING:  # otherwise every attribute would be known to mypy

        def __setattr__(self, name: str, value: Any) -> None:
            """Refuse every change: `with_` returns a changed copy."""
            if not name.startswith("_"):
                raise AttributeError(self._unchangeable(f"{self._kind}.{name}", name))
            super().__setattr__(name, value)

    def __setitem__(self, key: str, value: Any) -> None:
        """Refuse every change: `with_` returns a changed copy."""
        raise TypeError(self._unchangeable(f"{self._kind}[{written(key)}]", str(key)))

    def _unchangeable(self, what: str, key: str) -> str:
        """Return the message for a change of a key or table; ``what`` is how it was written."""
        kind = self._kind
        if key == "name":
            key = f"{kind}.name"
        tables = [info.alias or name for name, info in type(self._file).model_fields.items()]
        form = f'{{"{key}": ...}}' if "." in key else f"{key}={{...}}"
        if key.split(".")[0] in tables:
            return (
                f"{what} cannot be set, because a {kind} never changes; {kind}.with_({form}) "
                "returns a changed copy"
            )
        return (
            f"{what} cannot be set{nearest(key.split('.')[0], tables)}; {kind}.with_(...) returns "
            f"a copy with changes of {', '.join(name for name in tables if name != 'schema')}"
        )

    def to_toml(self) -> str:
        """Return the file as TOML, including all defaults; reading it gives an equal object."""
        return config.dump(self._file)

    def save(self, path: Place) -> Path:
        """Write the result of `to_toml` to a file atomically; an existing file is replaced.

        Raises:
            InputError: the argument is not a path, or its file name does not end in .toml.
            RthybError: it cannot be written.
        """
        from rthyb_rt.record.recording import replacing

        what = f"the {self._kind} file to write, {self._kind}.toml"
        target = with_extension(path_of(path, "save", what), (".toml",))
        with replacing(target) as temporary:
            temporary.write_text(self.to_toml(), encoding="utf-8")
        return target

    def __eq__(self, other: object) -> bool:
        """Return whether both have the same content, regardless of their origin."""
        if not isinstance(other, type(self)):
            return NotImplemented
        return self._file == other._file

    def __hash__(self) -> int:
        return hash(self.to_toml())

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of the files supplied with the program."""
        return list(config.shipped(cls._kind))

    @classmethod
    def _made(cls, file: _File, origin: str) -> Self:
        made = cls.__new__(cls)
        made._file, made._origin = file, origin
        return made

    @staticmethod
    def _own_key(key: str) -> str:
        """Return a key as in the file."""
        return key

    def _changed(self, changes: Mapping[str, Any], parse: Callable[..., _File]) -> _File:
        """Return the file with changes by dotted key; None removes a key."""
        values = self._file.model_dump(by_alias=True)
        gone = [key for key, value in changes.items() if value is None]
        problems: list[Problem] = []
        for key in gone:
            try:
                _without(values, key, self._own_key(key))
            except InputError as error:
                problems += error.problems
        if problems:
            raise InputError(problems)
        if not any(self._own_key(key) == "rig.assumed" for key in changes):
            config.remove_omitted(self._file, values)
        given = {key: config.inline(value) for key, value in changes.items() if key not in gone}
        return parse(config.dump_values(values), self._origin, given, config.IN_PYTHON)


def _source(kind: Literal["test", "rig"], given: object) -> Path:
    """Return the file for a path or a name."""
    if not isinstance(given, (str, os.PathLike)):
        raise InputError(
            f"found {_instead(kind, given)}; give the path of a {kind} file or the name of one "
            f"that comes with the program; tables are given by keyword, {kind.capitalize()}("
            f"{kind}={{...}})",
            kind.capitalize(),
        )
    return config.find(kind, given)


def _instead(kind: Literal["test", "rig"], given: object) -> str:
    """Return what was given instead of a test or rig, and what it has of the kind that is wanted.

    A test, a rig and a recording are easily taken for one another, as arguments of `run` are.
    """
    name = type(given).__name__
    if isinstance(given, (Test, Rig)) and given._kind == kind:
        return (
            f'the {kind} "{given.name}", which is a {type(given).__name__} already; use it as it '
            f"is, or a changed copy, {kind}.with_(...)"
        )
    if isinstance(given, (Test, Rig)):
        found = f'the {given._kind} "{given.name}", but a {kind} is needed here'
        of_test = "; test.rig is its rig" if kind == "rig" else "; the test comes before the rig"
        return found + of_test
    if name == "Recording" and hasattr(given, kind):
        return f"a recording, but a {kind} is needed here; recording.{kind} is the one it ran with"
    return written(given)


def _nothing(kind: Literal["test", "rig"], example: str) -> InputError:
    names = ", ".join(config.shipped(kind))
    return InputError(
        f"no argument was given; give the path of a {kind} file, the name of one that comes with "
        f"the program ({names}), or its tables as keyword arguments: {example}",
        kind.capitalize(),
    )


class Rig(_Document[RigFile | AxesRig]):
    """A rig: actuator, specimen and sensors, with one axis or several.

    Args:
        source: path of a rig file, or the name of a supplied one (`Rig.names`).
        tables: tables of the file by keyword, each a dict with the keys of the file, such as
            ``actuator={"delay_samples": 12}``. Numbers are in the unit of the key; strings include
            a unit. Without a source, they define the whole rig; otherwise they are changes as in
            `with_`.

    Raises:
        InputError: the file is invalid; the message lists all errors with place and allowed values.

    Examples:
        >>> rig = Rig("delay-10-elastic").with_({"actuator.delay_samples": 12})
    """

    _kind = "rig"
    _model = RigFile
    _place: str | None = None

    def __init__(self, source: Place | None = None, /, **tables: Any) -> None:
        if source is None and not tables:
            raise _nothing("rig", 'Rig(rig={"name": "mine"}, actuator={...}, specimen=[...])')
        if source is None:
            values = plain(tables)
            self._file = (
                config.check_values(AxesRig, values, "Rig")
                if "axis" in tables
                else config.check_values(RigFile, values, "Rig")
            )
            self._origin = "Rig"
            return
        path = _source("rig", source)
        self._file, self._origin = config.load_any_rig(path), str(path)
        if tables:
            self._file = self.with_(**tables)._file
        else:
            self._place = str(path.resolve()) if path == Path(source) else os.fspath(source)

    @property
    def place(self) -> str | None:
        """Path or name from which it was read; None if it was changed or created from keywords."""
        return self._place

    @property
    def name(self) -> str:
        """Name of the rig."""
        return self._file.rig.name

    def with_(self, changes: Mapping[str, Any] | None = None, /, **tables: Any) -> Rig:
        """Return a changed copy.

        Args:
            changes: values by dotted key; a dict replaces the whole table, and None removes the
                key.
            tables: tables by keyword; only the keys given are changed.

        Raises:
            InputError: the changes are invalid; the message lists all errors.

        Examples:
            >>> Rig("delay-10-elastic").with_(actuator={"delay_samples": 12})["actuator.kind"]
            'pure-delay'
        """
        changed = self._changed(_changes(changes, tables), config.parse_any_rig)
        return self._made(changed, self._origin)

    @staticmethod
    def _own_key(key: str) -> str:
        """Return a key without the prefix ``rig.``, which changes of a test's rig have."""
        inner = key.removeprefix(f"{RIG}.")
        known = (*RigFile.model_fields, *AxesRig.model_fields)
        return inner if inner.split(".")[0] in known else key

    @classmethod
    def from_toml(cls, text: str, source: str = "rig") -> Rig:
        """Return a rig from the text of a rig file; ``source`` is its name in messages.

        Raises:
            InputError: the text is invalid; the message lists all errors with their lines.
        """
        _require_text(text, "Rig.from_toml", "rig")
        return cls._made(config.parse_any_rig(text, source), source)

    def __repr__(self) -> str:
        if isinstance(self._file, AxesRig):
            return f"<Rig {self.name}: axes {', '.join(self._file.names)}>"
        actuator = self._file.actuator.kind
        elements = ", ".join(element.element for element in self._file.specimen)
        return f"<Rig {self.name}: {actuator} actuator, specimen {elements}>"


class Test(_Document[TestFile]):
    """A test: ground motion, numerical part, compensation and limits.

    Args:
        source: path of a test file, or the name of a supplied one (`Test.names`).
        rig: a `Rig`, or the path or name of one, or changes to tables of the rig given in the file,
            as in `with_`; by default, the rig given in the file.
        tables: tables of the file by keyword, each a dict with the keys of the file, such as
            ``numerical={"period_s": "500 ms"}``. Numbers are in the unit of the key; strings
            include a unit. Without a source, they define the whole test; otherwise they are changes
            as in `with_`.

    Raises:
        InputError: the file is invalid; the message lists all errors with place and allowed values.

    Examples:
        >>> test = Test("section5-T0.5").with_(ground_motion={"pga_g": "0.06 g"})
        >>> test["ground_motion.pga_g"]
        0.06
    """

    __test__ = False
    _kind = "test"
    _model = TestFile
    _rig: Rig | None = None

    def __init__(
        self,
        source: Place | None = None,
        /,
        rig: Rig | Place | Mapping[str, Any] | None = None,
        **tables: Any,
    ) -> None:
        if source is None and not tables:
            raise _nothing("test", 'Test(test={"name": "mine"}, numerical={...}, rig="NAME")')
        if source is None:
            self._file = config.check_values(TestFile, plain(tables), "Test")
            self._origin = "Test"
        else:
            path = _source("test", source)
            self._file, self._origin = config.load_test(path), str(path)
            if tables:
                self._file = self.with_(**tables)._file
        if isinstance(rig, Mapping):
            # Without a file there is no rig to change, so that the tables are those of a whole one.
            self._take(Rig(**rig) if source is None else self.with_(rig=rig).rig)
        elif rig is not None:
            self._take(as_rig(rig))

    @property
    def name(self) -> str:
        """Name of the test."""
        return self._file.test.name

    @property
    def rig(self) -> Rig:
        """The rig of the test.

        Raises:
            InputError: the test has no rig, or its rig does not exist.
        """
        if self._rig is not None:
            return self._rig
        if self._file.rig is None:
            raise InputError(
                f'the test "{self.name}" names no rig; give one, test.with_(rig="NAME") or '
                f"run(test, rig), of: {', '.join(Rig.names())}; or a rig file, or a Rig",
                "rig",
            )
        return Rig(config.find_rig(self._file.rig))

    def with_(
        self,
        changes: Mapping[str, Any] | None = None,
        /,
        rig: Rig | Place | Mapping[str, Any] | None = None,
        **tables: Any,
    ) -> Test:
        """Return a changed copy.

        Args:
            changes: values by dotted key; a dict replaces the whole table, and None removes the
                key. Keys that begin with ``rig.`` change the rig.
            rig: another rig, or changes to tables of the present one.
            tables: tables by keyword; only the keys given are changed.

        Raises:
            InputError: the changes are invalid; the message lists all errors.

        Examples:
            >>> Test("section5-T0.5").with_({"controller.type": "robust"})["controller.type"]
            'robust'
        """
        given = _changes(changes, tables)
        _refuse_tables_of_rig(given)
        if RIG in given and rig is not None:
            raise InputError(
                f"found two rigs, {written(str(given[RIG]))} in the dict and the argument rig; "
                "give one of them",
                "with_",
            )
        if isinstance(given.get(RIG), Mapping):
            rig = given.pop(RIG)
        other = given.pop(RIG, None) if isinstance(given.get(RIG), (str, Rig)) else rig
        of_rig = {key: given.pop(key) for key in list(given) if key.startswith(f"{RIG}.")}
        if isinstance(other, Mapping):
            of_rig |= {f"{RIG}.{key}": value for key, value in flat(plain(other))}
            other = None
        problems: list[Problem] = []
        made, changed = self, self._rig if other is None else as_rig(other)
        try:
            made = self._made(self._changed(given, config.parse_test), self._origin)
        except InputError as error:
            problems += error.problems
        try:
            if of_rig:
                base = changed or self.rig
                changed = base.with_(of_rig)
        except InputError as error:
            problems += error.problems
        if problems:
            raise InputError(problems)
        return made if changed is None else made._take(changed)

    @classmethod
    def from_toml(cls, text: str, rig: Rig | Place | None = None, source: str = "test") -> Test:
        """Return a test from the text of a test file; ``source`` is its name in messages.

        Raises:
            InputError: the text is invalid; the message lists all errors with their lines.
        """
        _require_text(text, "Test.from_toml", "test")
        made = cls._made(config.parse_test(text, source), source)
        return made if rig is None else made._take(as_rig(rig))

    def _take(self, rig: Rig) -> Self:
        """Replace the rig named in the file, by its path if it has one."""
        self._rig = None if rig.place else rig
        self._file = self._file.model_copy(update={RIG: rig.place})
        return self

    def __eq__(self, other: object) -> bool:
        """Return whether both are the same test on the same rig."""
        if not isinstance(other, Test):
            return NotImplemented
        mine, its = (one._file.model_copy(update={RIG: None}) for one in (self, other))
        if mine != its:
            return False
        if self._rig is None and other._rig is None and self._file.rig == other._file.rig:
            return True
        try:
            return self.rig == other.rig
        except InputError:
            return False

    def __hash__(self) -> int:
        return hash(config.dump(self._file.model_copy(update={RIG: None})))

    def __repr__(self) -> str:
        motion, part, history = self._file.ground_motion, self._file.numerical, self._file.history
        at = f" at {motion.pga_g:.3g} g" if motion.pga_g is not None else ""
        structure = "matrices"
        if part.period_s is not None:
            structure = f"{part.period_s:g} s"
        elif part.mass_kg is not None:
            structure = f"{part.mass_kg:g} kg"
        rig = self._rig.name if self._rig is not None else Path(self._file.rig or "no rig").stem
        about = f"{Path(motion.record).stem}{at}, {structure}"
        if history is not None:
            about = history.title
        return f"<Test {self.name}: {about}, controller {self._file.controller.type}, on {rig}>"


def _refuse_tables_of_rig(changes: Mapping[str, Any]) -> None:
    """Refuse tables of a rig among the changes of a test, which the rig has below ``rig``.

    Raises:
        InputError: with the key as it should be.
    """
    of_test = {info.alias or name for name, info in TestFile.model_fields.items()}
    problems = [
        Problem(
            config.IN_PYTHON.place(key),
            f"{key.split('.')[0]} is a table of the rig, not of the test: give it below rig, "
            f'with_({{"rig.{key}": ...}})',
        )
        for key in changes
        if key.split(".")[0] in {*RigFile.model_fields, *AxesRig.model_fields} - of_test
    ]
    if problems:
        raise InputError(problems)


def _require_text(text: object, where: str, kind: str) -> None:
    """Refuse what is not the text of a file.

    Raises:
        InputError: with what was found.
    """
    if not isinstance(text, str):
        raise InputError(
            f"found {in_words(text)}; give the text of a {kind} file as a string, such as "
            f'Path("{kind}.toml").read_text(); {kind.capitalize()}(path) reads a file',
            where,
        )


def as_rig(given: Rig | Place) -> Rig:
    """Return a rig given as an object, a path or a name.

    Raises:
        InputError: it is none of these, or its file is invalid.
    """
    return given if isinstance(given, Rig) else Rig(given)


def rig_to_identify(given: Rig | Place) -> Rig:
    """Return a rig like `as_rig`; a file may lack the elastic stiffness, which is to be found."""
    if isinstance(given, Rig):
        return given
    path = _source("rig", given)
    return Rig._made(config.load_any_rig(path, config.with_some_stiffness(path, {})), str(path))


BUILT_IN: Final = (
    "no test was given, so the built-in one was used: Section 5 of the paper, T = 0.5 s, El Centro"
)
"""Note on a test that was not given."""


def as_test(given: Test | Place | None) -> Test:
    """Return a test given as an object, a path or a name; None: the built-in test, see `BUILT_IN`.

    Raises:
        InputError: it is none of these, or its file is invalid.
    """
    if given is None:
        return Test(config.builtin_test_path())
    return given if isinstance(given, Test) else Test(given)


def file_of_test(test: Test) -> TestFile:
    """Return the validated file of a test."""
    return test._file


def file_of_rig(rig: Rig) -> RigFile | AxesRig:
    """Return the validated file of a rig."""
    return rig._file


def toml_given(rig: Rig) -> str:
    """Return a rig as TOML without the values of another rig that stand for those it omits."""
    return config.dump_given(rig._file)


def origin_of(rig: Rig) -> str | None:
    """Return the file from which a rig was read; None if there is none."""
    return rig._origin if Path(rig._origin).is_file() else None
