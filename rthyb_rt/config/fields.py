"""Building blocks of the configuration models: ranges with units, strings, and tables.

Every message says what was found, what is allowed and, if it is not obvious, what to do.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ModelWrapValidatorHandler,
    PrivateAttr,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import (
    CoreSchema,
    ErrorDetails,
    InitErrorDetails,
    PydanticCustomError,
    core_schema,
)

from rthyb_rt import units
from rthyb_rt.config.lines import Path as KeyPath
from rthyb_rt.config.placing import NOWHERE, SourceText
from rthyb_rt.errors import InputError

_EXPLAINED = "explained"


def written(value: object) -> str:
    """Return a value in TOML notation, short enough for a message."""
    if isinstance(value, str):
        return json.dumps(value if len(value) <= 60 else value[:57] + "...", ensure_ascii=False)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, (list, tuple)):
        return f"a list of {len(value)}"
    text = str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _short(number: float) -> str:
    return re.sub(r"e([+-])0?", lambda match: "e" + match[1].strip("+"), f"{number:g}")


def nearest(name: str, known: list[str]) -> str:
    """Return `` (did you mean "x"?)`` for a misspelt name, or nothing when none is near."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f' (did you mean "{close[0]}"?)' if close else ""


def with_extension(
    path: Path, names: Sequence[str], rule: str = "must be", instead: str = ""
) -> Path:
    """Return the path of a file to write, whose name says what it contains.

    Args:
        path: the file.
        names: file name extensions that are allowed.
        rule, instead: words of the message before and after them.

    Raises:
        InputError: it has another extension.
    """
    if path.suffix.lower() not in names:
        raise InputError(
            f"found the file name extension {written(path.suffix)}; {rule} {' or '.join(names)}"
            f"{instead}",
            str(path),
        )
    return path


def explained(text: str, involved: tuple[str, ...] = ()) -> PydanticCustomError:
    """Return the error of a message that is already complete.

    ``involved`` names the keys of the same table, or of tables in it, that are involved.
    """
    return PydanticCustomError(_EXPLAINED, "{text}", {"text": text, "involved": involved})


class Reader(ABC):
    """The values that a field accepts; pydantic validates with `read`."""

    @abstractmethod
    def read(self, value: object) -> Any:
        """Return the value in the form of the field; raise an explained error if it is invalid."""

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Validate with `read`."""
        return core_schema.no_info_plain_validator_function(self.read)


@dataclass(frozen=True)
class Range(Reader):
    """A finite number in the field's own unit, or a string with a unit that is converted to it.

    Attributes:
        unit: the field's unit, the one in its name; empty for a ratio or a plain number.
        low: smallest value allowed.
        high: largest value allowed.
        what: description of the number, in a few words.
        remedy: what to do if it is missing or wrong, unless the range says so.
        open_low, open_high: whether the bound itself is excluded.
    """

    unit: str
    low: float
    high: float
    what: str
    remedy: str = ""
    open_low: bool = False
    open_high: bool = False

    def allowed(self, kind: str = "") -> str:
        """Return what is allowed, in words; ``kind`` names the quantity (``"a length "``)."""
        low = "above" if self.open_low else "from"
        to = (", below" if self.open_high else ", up to") if self.open_low else " to"
        to = " to below" if self.open_high and not self.open_low else to
        limits = f"{low} {_short(self.low)}{to} {_short(self.high)} {self.unit}"
        text = f"{self.what} must be {kind}{limits}".rstrip()
        return f"{text}; {self.remedy}" if self.remedy else text

    def read(self, value: object) -> float:
        """Return the number in the field's unit; raise an explained error if it is invalid."""
        number = math.nan
        fault = ""
        if isinstance(value, str):
            try:
                number = units.convert(value, self.unit)
            except units.UnitError as error:
                fault = f" ({error})"
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                number = math.inf
        above = self.low < number if self.open_low else self.low <= number
        below = number < self.high if self.open_high else number <= self.high
        if not fault and above and below:
            return number
        quantity = units.dimension_name(self.unit)
        # "the mass must be from ...", not "the mass must be a mass from ...".
        named = quantity.partition(" ")[2] in self.what
        kind = f"{quantity} " if fault and not named else ""
        raise explained(f"found {written(value)}{fault}; {self.allowed(kind)}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the number, and the string with a unit that is also accepted."""
        low = "exclusiveMinimum" if self.open_low else "minimum"
        high = "exclusiveMaximum" if self.open_high else "maximum"
        number = {"type": "number", low: self.low, high: self.high}
        text = {"type": "string", "pattern": r"^\s*[+\-]?[0-9.]"}
        unit = f" [{self.unit}]" if self.unit else ""
        return {"anyOf": [number, text], "description": self.what + unit}


@dataclass(frozen=True)
class Count(Reader):
    """A whole number.

    Attributes:
        low: smallest value allowed.
        high: largest value allowed.
        what: what is counted.
    """

    low: int
    high: int
    what: str

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.what} must be a whole number from {self.low} to {self.high}"

    def read(self, value: object) -> int:
        """Return the number; raise an explained error if it is invalid."""
        whole = isinstance(value, int) and not isinstance(value, bool)
        if isinstance(value, int) and whole and self.low <= value <= self.high:
            return value
        raise explained(f"found {written(value)}; {self.allowed()}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the whole number."""
        return {
            "type": "integer",
            "minimum": self.low,
            "maximum": self.high,
            "description": self.what,
        }


@dataclass(frozen=True)
class Point(Reader):
    """Two coordinates, m; strings with a unit are accepted.

    Attributes:
        what: description of the point.
        one: field of each coordinate.
    """

    what: str
    one: Range

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.what} must be [x, y]; {self.one.allowed()}"

    def read(self, value: object) -> list[float]:
        """Return x and y; raise an explained error if they are invalid."""
        if not isinstance(value, list) or len(value) != 2:
            raise explained(f"found {written(value)}; {self.allowed()}")
        return [self.one.read(v) for v in value]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the pair."""
        return {"type": "array", "minItems": 2, "maxItems": 2, "description": self.what}


@dataclass(frozen=True)
class Text(Reader):
    """A string of a given form.

    Attributes:
        what: description of the string.
        pattern: regular expression of the whole string.
        form: the form in words.
    """

    what: str
    pattern: str = r"[\s\S]*"
    form: str = "text in quotes"

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.what} must be {self.form}"

    def read(self, value: object) -> str:
        """Return the string; raise an explained error if it is invalid."""
        if isinstance(value, str) and re.fullmatch(self.pattern, value):
            try:
                value.encode()
            except UnicodeEncodeError:
                raise explained(f"found bytes that are not UTF-8; {self.allowed()}") from None
            return value
        raise explained(f"found {written(value)}; {self.allowed()}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the string."""
        return {"type": "string", "pattern": f"^{self.pattern}$", "description": self.what}


SLUG = Text(
    "a name",
    r"[a-z0-9][a-z0-9._-]{0,63}",
    "up to 64 characters of a-z 0-9 . _ - in quotes, starting with a letter or digit (it becomes "
    "the name of a folder)",
)
SOME_TEXT = Text("the value", r"\S[\s\S]*", "text in quotes, not empty")


@dataclass(frozen=True)
class Sign(Reader):
    """1 or -1.

    Attributes:
        what: what has the sign.
    """

    what: str

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.what} must be 1 or -1"

    def read(self, value: object) -> int:
        """Return the sign; raise an explained error if it is invalid."""
        if isinstance(value, (int, float)) and not isinstance(value, bool) and value in (1, -1):
            return int(value)
        raise explained(f"found {written(value)}; {self.allowed()}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the two numbers."""
        return {"enum": [1, -1], "description": self.what}


@dataclass(frozen=True)
class OneOf(Reader):
    """One of a few words, which are the keys of a table.

    Attributes:
        words: the words.
    """

    words: tuple[str, ...]

    def read(self, value: object) -> str:
        """Return the word; raise an explained error if it is invalid."""
        if isinstance(value, str) and value in self.words:
            return value
        raise explained(_one_of(value, list(self.words)))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the words."""
        return {"enum": list(self.words)}


@dataclass(frozen=True)
class Names(Reader):
    """A list of different strings.

    Attributes:
        what: description of the strings.
        most: maximum number of strings.
    """

    what: str
    most: int

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.what} must be a list of up to {self.most} different strings"

    def read(self, value: object) -> list[str]:
        """Return the strings; raise an explained error if they are invalid."""
        texts = isinstance(value, list) and all(isinstance(v, str) and v.strip() for v in value)
        if isinstance(value, list) and texts and len(value) <= self.most:
            if len(set(value)) == len(value):
                return value
            twice = next(v for v in value if value.count(v) > 1)
            raise explained(f"found {written(twice)} twice; {self.allowed()}")
        raise explained(f"found {written(value)}; {self.allowed()}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the list."""
        item = {"type": "string", "minLength": 1}
        return {"type": "array", "items": item, "maxItems": self.most, "description": self.what}


@dataclass(frozen=True)
class Alternatives:
    """Alternative keys of a table, of which only one may be given.

    Attributes:
        keys: the keys.
        required: whether one of them must be given.
    """

    keys: tuple[str, ...]
    required: bool


@dataclass(frozen=True)
class Condition:
    """A condition on several keys of a table, checked if all of them are valid.

    Attributes:
        key: the key that the message names.
        needs: the keys whose values are passed to the test, in this order.
        test: returns the error message, or None.
    """

    key: str
    needs: tuple[str, ...]
    test: Callable[..., str | None]


class Table(BaseModel):
    """A table of a configuration file: immutable, no unknown keys, all errors reported at once."""

    # What checks a table is built when a file first has it: a command reads few of the many kinds.
    model_config = ConfigDict(
        extra="forbid", frozen=True, protected_namespaces=(), defer_build=True
    )

    choices: ClassVar[tuple[Alternatives, ...]] = ()
    checks: ClassVar[tuple[Condition, ...]] = ()
    foreign: ClassVar[dict[str, str]] = {}
    """Keys of another kind of file, each with what to do instead of using it here."""

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Return the full form of a table that may also be written in a short form."""
        return data

    def settle(self) -> None:
        """Replace alternative inputs by the single form that the rest of the program reads."""

    @classmethod
    def further_faults(
        cls, keys: dict[str, Any]
    ) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
        """Yield errors that involve several keys, in addition to `checks`.

        Each consists of the place below this table, the message, and the keys that are involved.
        """
        yield from ()

    @model_validator(mode="wrap")
    @classmethod
    def _explain_all(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        data = cls.expand(data)
        keys = data if isinstance(data, dict) else {}
        table: Self | None = None
        found: list[InitErrorDetails] = []
        try:
            table = handler(data)
        except ValidationError as error:
            found = [cls._explained(fault) for fault in error.errors(include_url=False)]
        failed = {str(fault["loc"][0]) for fault in found if fault["loc"]}
        for loc, text in cls._choice_faults(keys):
            found.append({"type": explained(text, loc), "loc": loc, "input": data})
        for check, text in cls._check_faults(table, keys, failed):
            error_type = explained(text, check.needs)
            found.append({"type": error_type, "loc": (check.key,), "input": data})
        for loc, text, needs in cls.further_faults(keys):
            found.append({"type": explained(text, needs), "loc": loc, "input": data})
        if table is None or found:
            raise ValidationError.from_exception_data(cls.__name__, found)
        table.settle()
        return table

    @classmethod
    def _explained(cls, fault: ErrorDetails) -> InitErrorDetails:
        """Return an error with its final place and message; those of inner tables have theirs."""
        if fault["type"] == _EXPLAINED:
            ctx = fault["ctx"]
            error_type = explained(ctx["text"], ctx["involved"])
            # The place of a key that is wrong itself ends in "[key]".
            loc = tuple(part for part in fault["loc"] if part != "[key]")
            return {"type": error_type, "loc": loc, "input": fault["input"]}
        loc, text = cls._explain(fault["type"], fault["loc"], fault["input"], fault)
        return {"type": explained(text), "loc": loc, "input": fault["input"]}

    @classmethod
    def _explain(
        cls, kind: str, loc: tuple[int | str, ...], value: object, fault: ErrorDetails
    ) -> tuple[tuple[int | str, ...], str]:
        """Return place and message of an error found by pydantic."""
        key = str(loc[0]) if loc else ""
        fields = {info.alias or name: info for name, info in cls.model_fields.items()}
        if kind == "extra_forbidden":
            known = list(fields)
            if key in cls.foreign:
                return loc, f"not available here: {cls.foreign[key]}"
            return loc, f"unknown key{nearest(key, known)}; allowed here: {', '.join(known)}"
        info = fields.get(key)
        if kind == "missing" and info is not None:
            return loc, f"missing; {_allowed(info, key)}"
        if kind in ("union_tag_invalid", "union_tag_not_found") and info is not None:
            tag = str(fault["ctx"]["discriminator"]).strip("'")
            keys, known = value if isinstance(value, dict) else {}, _tags(info.annotation, tag)
            said = _one_of(keys.get(tag), known)
            for other in ("type", "kind", "element", "name"):
                if other != tag and tag not in keys and keys.get(other) in known:
                    said = f"missing; found {other} = {written(keys[other])}: call that key {tag}"
            return (*loc, tag), said
        if kind == "literal_error" and info is not None:
            return loc, _one_of(value, _literals(info.annotation))
        allowed = {
            "bool_type": "must be true or false",
            "list_type": "must be a list",
            "too_short": _at_least(fault.get("ctx", {}).get("min_length", 1)),
            "too_long": f"must have at most {fault.get('ctx', {}).get('max_length')} entries",
            "model_type": "must be a table of keys and values",
            "dict_type": "must be a table of keys and values",
            "model_attributes_type": "must be a table of keys and values",
        }.get(kind, str(fault["msg"]))
        return loc, f"found {written(value)}; {allowed}"

    @classmethod
    def _choice_faults(cls, keys: dict[str, Any]) -> Iterator[tuple[tuple[str, ...], str]]:
        for choice in cls.choices:
            given = [key for key in choice.keys if keys.get(key) is not None]
            names = ", ".join(choice.keys)
            if len(given) > 1:
                yield (given[1],), f"{' and '.join(given)} are both given; keep only one of {names}"
            elif choice.required and not given:
                yield (), f"missing; give exactly one of {names}"

    @classmethod
    def _check_faults(
        cls, table: Self | None, keys: dict[str, Any], failed: set[str]
    ) -> Iterator[tuple[Condition, str]]:
        for check in cls.checks:
            missing = {
                k for k in check.needs if k not in keys and cls.model_fields[k].is_required()
            }
            if failed.intersection(check.needs) or (table is None and missing):
                continue
            if table is not None:
                values = [getattr(table, key) for key in check.needs]
            else:
                values = [_read_field(cls.model_fields[key], keys, key) for key in check.needs]
            complaint = check.test(*values)
            if complaint:
                yield check, complaint


class WholeFile(Table):
    """A configuration file, which remembers the text from which it was read."""

    _source: SourceText = PrivateAttr(default=NOWHERE)

    @property
    def source(self) -> SourceText:
        """The text from which the values come."""
        return self._source

    def read_from(self, source: SourceText) -> Self:
        """Return the same file with this text as its origin."""
        file = self.model_copy()
        file._source = source
        return file


def has_key(annotation: Any, path: KeyPath) -> bool:
    """Return whether values of a type can have a key.

    What looks like a key may not be one: a file may be named like a table, as in `test.at2`, and an
    error that already has its line begins with such a name.
    """
    if not path:
        return True
    if isinstance(path[0], int):
        # An index into a list, which does not appear in its type.
        return has_key(annotation, path[1:])
    if typing.get_origin(annotation) is dict:
        return has_key(typing.get_args(annotation)[1], path[1:])
    for part in _parts(annotation):
        if part is Any:
            return True
        if isinstance(part, type) and issubclass(part, BaseModel):
            fields = {info.alias or name: info for name, info in part.model_fields.items()}
            if path[0] in fields and has_key(fields[path[0]].annotation, path[1:]):
                return True
    return False


def _read_field(info: FieldInfo, keys: dict[str, Any], key: str) -> Any:
    """Return the value of a valid field of a table that has errors elsewhere."""
    if key not in keys:
        return info.get_default(call_default_factory=True)
    return TypeAdapter[Any](info.rebuild_annotation()).validate_python(keys[key])


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield the parts of Annotated, unions and lists."""
    if typing.get_origin(annotation) is Literal:
        yield annotation
        return
    arguments = typing.get_args(annotation)
    if not arguments:
        yield annotation
    for argument in arguments:
        yield from _parts(argument)


def _literals(annotation: Any) -> list[str]:
    literals = (part for part in _parts(annotation) if typing.get_origin(part) is Literal)
    return [str(name) for part in literals for name in typing.get_args(part)]


def _tables(annotation: Any) -> list[type[Table]]:
    """Return the tables among the parts of an annotation."""
    parts = (part for part in _parts(annotation) if isinstance(part, type))
    return [part for part in parts if issubclass(part, Table)]


def _tags(annotation: Any, key: str) -> list[str]:
    return [
        name
        for table in _tables(annotation)
        for name in _literals(table.model_fields[key].annotation)
    ]


def _at_least(count: int) -> str:
    return "at least one is needed" if count == 1 else f"at least {count} are needed"


def _one_of(value: object, names: list[str]) -> str:
    quoted = ", ".join(f'"{name}"' for name in names)
    if value is None:
        return f"missing; must be one of {quoted}"
    return f"found {written(value)}{nearest(str(value), names)}; must be one of {quoted}"


def _allowed(info: FieldInfo, key: str) -> str:
    """Return the values that a required field accepts, in words."""
    for limits in info.metadata:
        allowed = getattr(limits, "allowed", None)
        if allowed is not None:
            return str(allowed())
    names = _literals(info.annotation)
    if names:
        return "must be " + " or ".join(f'{key} = "{name}"' for name in names)
    if typing.get_origin(info.annotation) is list:
        return f"add at least one table [[{key}]]"
    if typing.get_origin(info.annotation) is dict and not _tables(info.annotation):
        return f"add {key} = {{ name = value, ... }}"
    return f"add the table [{key}]"
