"""User-defined parts in test and rig files: a shared library, an FMU, a class in Python."""

from __future__ import annotations

import re
from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final

from pydantic import Field, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError

from rthyb_rt.config.fields import (
    SOME_TEXT,
    Condition,
    Names,
    Range,
    Reader,
    Table,
    Text,
    explained,
    written,
)
from rthyb_rt.core.sizes import COUPLED_MAX

if TYPE_CHECKING:
    from rthyb_rt.core import ElementConfig
    from rthyb_rt.core.own import OwnClass

PYTHON: Final = "python"
"""The type of a control law, or the kind of an element, that is a class in Python."""
MOST_SETTINGS: Final = 256
INTERFACES: Final = COUPLED_MAX
"""Largest number of directions that actuators move; it equals the number of axes."""
_NAME: Final = re.compile(r"[A-Za-z_][\w.\[\],]{0,127}")
_CLASS: Final = Text(
    "the class",
    r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*",
    'the name of a module and of a class in it, "my_parts:Oscillator"',
)


class _NamedValues(Reader):
    """A table of up to `MOST_SETTINGS` names and values, in the order of the file."""

    what: str

    def read(self, value: object) -> dict[str, Any]:
        """Return the values; raise an explained error if one of them is invalid."""
        if not isinstance(value, dict) or len(value) > MOST_SETTINGS:
            raise explained(f"found {written(value)}; {self.allowed()}")
        return {name: self._one(name, given) for name, given in value.items()}

    @abstractmethod
    def allowed(self) -> str:
        """Return what is allowed, in words."""

    @abstractmethod
    def _one(self, name: object, given: object) -> Any:
        """Return one value; raise an explained error if it or its name is invalid."""

    @abstractmethod
    def _form_of_one(self) -> dict[str, Any]:
        """Return the JSON schema of one value."""

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the table."""
        one = self._form_of_one()
        return {"type": "object", "additionalProperties": one, "description": self.what}


@dataclass(frozen=True)
class NamedParameters(_NamedValues):
    """Numbers by name for a library or an FMU."""

    what: str = "the parameters"
    form: ClassVar[str] = "table of names and numbers"

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return (
            f"{self.what} must be a table of up to {MOST_SETTINGS} names and numbers, "
            "{ mass_kg = 4220 }"
        )

    def _one(self, name: object, given: object) -> float:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise explained(f"found the name {written(name)}; {self.allowed()}")
        try:
            return Range("", -1e18, 1e18, name).read(given)
        except PydanticCustomError as error:
            raise explained(str((error.context or {})["text"])) from None

    def _form_of_one(self) -> dict[str, Any]:
        return {"type": "number"}


@dataclass(frozen=True)
class Settings(_NamedValues):
    """Arguments of a class: numbers, strings, true, false, or lists of these."""

    what: str = "the settings"
    form: ClassVar[str] = "table of arguments"

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return (
            f"{self.what} must be a table of up to {MOST_SETTINGS} arguments of the class, each a "
            "number, a string, true, false, or a list of these"
        )

    def _one(self, name: object, given: object) -> Any:
        items = given if isinstance(given, list) else [given]
        plain = all(isinstance(item, (bool, int, float, str)) for item in items)
        if not isinstance(name, str) or not name.isidentifier() or not plain:
            raise explained(f"found {written(name)} = {written(given)}; {self.allowed()}")
        return given

    def _form_of_one(self) -> dict[str, Any]:
        one = {"type": ["number", "string", "boolean"]}
        return {"anyOf": [one, {"type": "array", "items": one}]}


@dataclass(frozen=True)
class OnePerInterface(Reader):
    """The name of a variable, or a list with one for each interface."""

    what: str
    form: ClassVar[str] = "name, or list of different names"

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return (
            f"{self.what} must be the name of a variable, or, with several interfaces, a list of "
            f"up to {INTERFACES} different names in the order of their numbers"
        )

    def read(self, value: object) -> str | list[str]:
        """Return the name or the names; raise an explained error if they are invalid."""
        if isinstance(value, str):
            return SOME_TEXT.read(value)
        if isinstance(value, list) and value:
            return Names(self.what, INTERFACES).read(value)
        raise explained(f"found {written(value)}; {self.allowed()}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe both forms."""
        one = {"type": "string", "minLength": 1}
        several = {"type": "array", "items": one, "minItems": 1, "maxItems": INTERFACES}
        return {"anyOf": [one, several], "description": self.what}


def _as_many(force: str | list[str], displacement: str | list[str]) -> str | None:
    given, asked = (len(names) if isinstance(names, list) else 1 for names in (displacement, force))
    if given == asked:
        return None
    return f"found {given} outputs for {asked} forces; each interface needs one of both"


class LibraryFile(Table):
    """A user-defined numerical part in a shared library (``rthyb_library.h``).

    ``parameters`` are those that the library requires, by name.
    """

    file: Annotated[str, SOME_TEXT]
    parameters: Annotated[dict[str, float], NamedParameters()] = Field(default_factory=dict)


class FmuFile(Table):
    """A numerical part in an FMU for co-simulation, FMI 2 or 3, by the names of its variables.

    ``force`` and ``ground_acceleration`` are inputs, ``displacement`` is an output; with several
    interfaces, ``force`` and ``displacement`` are lists. ``record`` names further variables to
    record. ``parameters`` are start values.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("displacement", ("force", "displacement"), _as_many),
    )

    file: Annotated[str, SOME_TEXT]
    force: Annotated[str | list[str], OnePerInterface("the input for the force")]
    displacement: Annotated[str | list[str], OnePerInterface("the output with the displacement")]
    ground_acceleration: Annotated[str, SOME_TEXT] | None = None
    parameters: Annotated[dict[str, float], NamedParameters()] = Field(default_factory=dict)
    record: Annotated[list[str], Names("the quantities to record", 20)] = Field(
        default_factory=list
    )


class PythonClass(Table):
    """A class in Python, for tests in virtual time, and the arguments with which it is created."""

    class_: Annotated[str, _CLASS] = Field(alias="class")
    settings: Annotated[dict[str, Any], Settings()] = Field(default_factory=dict)

    @property
    def own(self) -> OwnClass:
        """The class as the core represents it."""
        # NumPy, which it needs, is slow to import.
        from rthyb_rt.core.own import OwnClass

        return OwnClass.of_plain({"class": self.class_, "settings": self.settings})


def core_element(item: Table) -> ElementConfig:
    """Return a ``[[specimen]]`` table, or a law between storeys, as an element of the core."""
    from rthyb_rt import core

    if isinstance(item, PythonClass):
        return core.ElementConfig(PYTHON, (), item.own)
    values = item.model_dump()
    kind = values.pop("element")
    absent = dict.fromkeys(core.ELEMENT_ABSENT.get(kind, ()), 0.0)
    given = {key: values[key] for key in core.ELEMENT_PARAMS[kind] if values[key] is not None}
    return core.element(kind, **(absent | given))
