"""Structures of many degrees of freedom in the test file: storeys, matrices from a file.

Files of matrices are read by `rthyb_rt.config.matrixfile`; the structure is built from the keys by
`rthyb_rt.config.sparse_structure`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import Field, GetJsonSchemaHandler, StrictBool
from pydantic_core import CoreSchema, PydanticCustomError

from rthyb_rt.config.fields import (
    SLUG,
    SOME_TEXT,
    Alternatives,
    Condition,
    Count,
    Range,
    Reader,
    Table,
    explained,
    written,
)
from rthyb_rt.config.limits import ForceLimit, Limit
from rthyb_rt.config.numerical import TakenOut
from rthyb_rt.config.own_tables import INTERFACES
from rthyb_rt.config.rigfile import SpecimenElement

MOST_STOREYS: Final = 500
MOST_TERMS: Final = 16
MOST_RECORDED: Final = 20
"""Largest number of recorded quantities; control law and virtual rig also need channels."""
DAMPED_MODES: Final = 64
WRITTEN_OUT: Final = "written out"
FROM_FILE: Final = "from a file"
"""The forms of ``[numerical.matrices]``; as part of an error's place, they cannot be keys."""


@dataclass(frozen=True)
class Each(Reader):
    """A number for all storeys, or a list with one for each, the lowest first.

    Attributes:
        one: field of each number.
    """

    one: Range

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.one.allowed()}; or a list with one value for each storey, from the lowest"

    def read(self, value: object) -> float | list[float]:
        """Return the number or the numbers; raise an explained error if they are invalid."""
        if not isinstance(value, list):
            return self.one.read(value)
        if not 1 <= len(value) <= MOST_STOREYS:
            raise explained(f"found {written(value)}; {self.allowed()}")
        return [self._entry(item, i) for i, item in enumerate(value)]

    def _entry(self, item: object, i: int) -> float:
        try:
            return self.one.read(item)
        except PydanticCustomError as error:
            text = str((error.context or {})["text"])
            raise explained(f"number {i + 1}: {text}") from None

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe both forms."""
        one = self.one.__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [one, {"type": "array", "items": one}], "description": self.one.what}


@dataclass(frozen=True)
class Counts(Reader):
    """Different whole numbers; a single number is short for a list of one.

    Attributes:
        one: field of each number.
        most: maximum number of entries.
    """

    one: Count
    most: int

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"must be a list of 1 to {self.most} different numbers; {self.one.allowed()}"

    def read(self, value: object) -> list[int]:
        """Return the numbers; raise an explained error if they are invalid."""
        items = value if isinstance(value, list) else [value]
        if not 1 <= len(items) <= self.most:
            raise explained(f"found {written(value)}; {self.allowed()}")
        found = [self.one.read(item) for item in items]
        if len(set(found)) < len(found):
            raise explained(f"found a number twice in {found}; {self.allowed()}")
        return found

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe both forms."""
        one = self.one.__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [one, {"type": "array", "items": one, "maxItems": self.most}]}


@dataclass(frozen=True)
class Terms(Reader):
    """Degrees of freedom with weights: a label, or a table of labels and weights.

    Stored as a list of pairs, which is also accepted.
    """

    what: str

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return (
            f'{self.what} must be a label, "7.x", or a table of 1 to {MOST_TERMS} labels and '
            'weights, { "8.x" = 1, "7.x" = -1 }'
        )

    def read(self, value: object) -> list[list[Any]]:
        """Return label and weight of each; raise an explained error if they are invalid."""
        pairs: list[Any] = [[value, 1.0]] if isinstance(value, str) else []
        if isinstance(value, dict):
            pairs = [list(item) for item in value.items()]
        elif isinstance(value, list):
            pairs = value
        if not 1 <= len(pairs) <= MOST_TERMS:
            raise explained(f"found {written(value)}; {self.allowed()}")
        return [self._pair(pair, value) for pair in pairs]

    def _pair(self, pair: object, value: object) -> list[Any]:
        if not (isinstance(pair, (list, tuple)) and len(pair) == 2 and isinstance(pair[0], str)):
            raise explained(f"found {written(value)}; {self.allowed()}")
        label, weight = pair
        number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
        if not label or not number or not 1e-6 <= abs(weight) <= 1e6:
            raise explained(
                f"found the weight {written(weight)} of {written(label)}; the magnitude of a "
                "weight must be from 1e-6 to 1e6"
            )
        return [label, float(weight)]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the forms."""
        table = {"type": "object", "additionalProperties": {"type": "number"}}
        return {
            "anyOf": [{"type": "string"}, table, {"type": "array"}],
            "description": self.what,
        }


def _one_each(what: str) -> Any:
    def test(count: int, values: float | list[float] | None) -> str | None:
        if not isinstance(values, list) or len(values) == count:
            return None
        return (
            f"found {len(values)} numbers for {count} storeys; must be {count}, from the lowest "
            f"storey up, or one {what} for all"
        )

    return test


def _storeys_there(count: int, specimen: list[int]) -> str | None:
    if max(specimen) <= count:
        return None
    return f"found storey {max(specimen)} of {count}; must be one of 1 to {count}, 1 the lowest"


def _weighs_on_height(p_delta: bool, height_m: float | list[float] | None) -> str | None:
    if not p_delta or height_m is not None:
        return None
    return "found true without a height; give height_m, one for all storeys or one for each"


class Storeys(Table):
    """A shear building: storeys one above another, each with a mass; the lowest is on the ground.

    The specimen is one storey, or with several axes as many as there are axes: its stiffness is
    taken from the rig and not from ``stiffness_n_per_m``. With ``p_delta``, the weight above a
    storey over its height is a negative stiffness.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("mass_kg", ("count", "mass_kg"), _one_each("mass")),
        Condition("stiffness_n_per_m", ("count", "stiffness_n_per_m"), _one_each("stiffness")),
        Condition("height_m", ("count", "height_m"), _one_each("height")),
        Condition("specimen", ("count", "specimen"), _storeys_there),
        Condition("p_delta", ("p_delta", "height_m"), _weighs_on_height),
    )

    count: Annotated[int, Count(1, MOST_STOREYS, "the number of storeys")]
    mass_kg: Annotated[float | list[float], Each(Range("kg", 1e-3, 1e9, "the mass of a storey"))]
    stiffness_n_per_m: Annotated[
        float | list[float], Each(Range("N/m", 1e-3, 1e12, "the stiffness of a storey"))
    ]
    height_m: (
        Annotated[float | list[float], Each(Range("m", 0.1, 100, "the height of a storey"))] | None
    ) = None
    p_delta: StrictBool = False
    specimen: Annotated[
        list[int], Counts(Count(1, MOST_STOREYS, "the storey in the laboratory"), INTERFACES)
    ] = Field(default_factory=lambda: [1])

    def each(self, key: Literal["mass_kg", "stiffness_n_per_m", "height_m"]) -> list[float]:
        """Return the values of a key for every storey, from the lowest."""
        value = getattr(self, key)
        return list(value) if isinstance(value, list) else [float(value)] * self.count


class MatrixFiles(Table):
    """Files that contain one matrix each, Matrix Market or CSV."""

    mass: Annotated[str, SOME_TEXT]
    stiffness: Annotated[str, SOME_TEXT]
    damping: Annotated[str, SOME_TEXT] | None = None
    labels: Annotated[str, SOME_TEXT] | None = None
    influence: Annotated[str, SOME_TEXT] | None = None


class MatrixFile(Table):
    """A structure given by matrices from a file: mass, stiffness, damping, labels, influence.

    ``file`` is an .npz or .mat file, ``files`` names one file per matrix. ``data`` is their
    content, as the program stores it in a recording. ``direction`` selects one of several influence
    vectors. With ``specimen`` the matrices are those of the whole structure.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (Alternatives(("file", "files"), required=True),)

    file: Annotated[str, SOME_TEXT] | None = None
    files: MatrixFiles | None = None
    data: Annotated[str, SOME_TEXT] | None = None
    direction: Annotated[str, SOME_TEXT] | None = None
    specimen: TakenOut | None = None


def _few_for_rayleigh(form: str, modes: list[int], ratio: float | list[float]) -> str | None:
    if form == "modal":
        if not isinstance(ratio, list) or len(ratio) == len(modes):
            return None
        return f"found {len(ratio)} ratios for {len(modes)} modes; give one for each, or for all"
    if len(modes) > 2:
        return (
            f"found {len(modes)} modes; Rayleigh damping is given at one or two modes: name "
            'those, or use form = "modal"'
        )
    if isinstance(ratio, list) and len(ratio) not in (1, len(modes)):
        return f"found {len(ratio)} ratios for {len(modes)} modes; give one for each, or for all"
    return None


class Damping(Table):
    """Damping ratios of modes of the whole structure, elastic; modes are numbered from 1.

    Rayleigh damping has the given ratios in one mode (mass-proportional) or two, and larger ones
    beyond; modal damping has them in the given modes, and none in the others.
    """

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("modes", ("form", "modes", "ratio"), _few_for_rayleigh),
    )

    ratio: Annotated[float | list[float], Each(Range("", 0, 1, "the damping ratio"))]
    modes: Annotated[
        list[int], Counts(Count(1, DAMPED_MODES, "the number of a mode"), DAMPED_MODES)
    ]
    form: Literal["rayleigh", "modal"] = "rayleigh"

    @property
    def ratios(self) -> list[float]:
        """The ratio of each of the modes."""
        if isinstance(self.ratio, list):
            return self.ratio * (len(self.modes) if len(self.ratio) == 1 else 1)
        return [self.ratio] * len(self.modes)


def _no_mass(law: SpecimenElement) -> str | None:
    if law.element not in ("inertia", "second_mode"):
        return None
    return f'found "{law.element}"; enter a mass in the masses of the structure'


class Nonlinear(Table):
    """An element between storeys, or between degrees of freedom of the matrices.

    ``storeys``: in each of these storeys, instead of its stiffness; with ``beside``, in parallel.
    ``dof``: between this and the ground; ``between``: between two, with the deformation second
    minus first.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("storeys", "dof", "between"), required=True),
    )
    checks: ClassVar[tuple[Condition, ...]] = (Condition("law", ("law",), _no_mass),)

    storeys: (
        Annotated[list[int], Counts(Count(1, MOST_STOREYS, "the storey"), MOST_STOREYS)] | None
    ) = None
    dof: Annotated[str, SOME_TEXT] | None = None
    between: list[Annotated[str, SOME_TEXT]] | None = Field(
        default=None, min_length=2, max_length=2
    )
    beside: StrictBool = False
    law: Annotated[SpecimenElement, Field(discriminator="element")]


class _PlaceLimit(Limit):
    """A limit on the position of an interface direction, m."""

    value: Annotated[float, Range("m", 1e-6, 100, "the limit")]


class _TurnLimit(Limit):
    """A limit on a rotation of the interface, rad."""

    value: Annotated[float, Range("rad", 1e-6, 3.2, "the limit")]


class _MomentLimit(Limit):
    """A limit on a moment at the interface, N m."""

    value: Annotated[float, Range("N m", 1e-3, 1e10, "the limit")]


class InterfaceLimits(Table):
    """Limits of a direction of the interface, in addition to those of the axes.

    A rotation has ``position_rad`` and ``moment_n_m``, other directions ``position_m`` and
    ``force_n``.
    """

    position_m: _PlaceLimit | None = None
    force_n: ForceLimit | None = None
    position_rad: _TurnLimit | None = None
    moment_n_m: _MomentLimit | None = None

    def of_kind(self, turns: bool) -> tuple[Limit | None, Limit | None]:
        """Return the limits on position and force for a rotation, or for a translation."""
        if turns:
            return self.position_rad, self.moment_n_m
        return self.position_m, self.force_n


class Interface(Table):
    """What the actuators move in the structure: a storey's drift, or degrees of freedom.

    One for each direction named in the rig's kinematics, with its name; with one axis, any name.
    ``number`` is that of an interface of your own numerical part, from 1.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("storey", "dof", "number"), required=True),
    )

    name: Annotated[str, SLUG] = "x"
    storey: Annotated[int, Count(1, MOST_STOREYS, "the storey")] | None = None
    dof: Annotated[list[list[Any]], Terms("the degree of freedom")] | None = None
    number: Annotated[int, Count(1, INTERFACES, "the number of the interface")] | None = None
    limits: InterfaceLimits = Field(default_factory=InterfaceLimits)
