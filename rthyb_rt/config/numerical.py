"""A numerical part given by matrices: `[numerical.matrices]` of the test file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError

from rthyb_rt.config.fields import (
    Alternatives,
    Condition,
    Count,
    Range,
    Reader,
    Table,
    explained,
    written,
)
from rthyb_rt.core.sizes import DENSE_MAX

MOST_DEGREES: Final = DENSE_MAX
SYMMETRY: Final = 1e-9
"""Allowed relative difference of two entries that should be equal: rounding in print."""


@dataclass(frozen=True)
class Numbers(Reader):
    """A list of numbers, each accepted as by `Range`.

    Attributes:
        each: field of each number.
        what: description of the list.
    """

    each: Range
    what: str

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        unit = f" [{self.each.unit}]" if self.each.unit else ""
        return f"{self.what} must be a list of 1 to {MOST_DEGREES} numbers{unit}"

    def read(self, value: object) -> list[float]:
        """Return the numbers; raise an explained error if they are invalid."""
        if not isinstance(value, list) or not 1 <= len(value) <= MOST_DEGREES:
            raise explained(f"found {written(value)}; {self.allowed()}")
        return [_entry(self.each, item, f"number {i + 1}") for i, item in enumerate(value)]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the list."""
        item = self.each.__get_pydantic_json_schema__(schema, handler)
        return {"type": "array", "items": item, "maxItems": MOST_DEGREES, "description": self.what}


@dataclass(frozen=True)
class Square(Reader):
    """A symmetric matrix as a list of rows; a plain list of numbers is its diagonal.

    Attributes:
        each: field of each entry.
        what: description of the matrix.
        positive: whether it must be positive definite, like the masses.
    """

    each: Range
    what: str
    positive: bool = False

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return (
            f"{self.what} must be a symmetric matrix [{self.each.unit}] of 1 to {MOST_DEGREES} "
            "rows, [[...], [...]], or the list of its diagonal"
        )

    def read(self, value: object) -> list[list[float]]:
        """Return the rows; raise an explained error if they are invalid."""
        if not isinstance(value, list) or not 1 <= len(value) <= MOST_DEGREES:
            raise explained(f"found {written(value)}; {self.allowed()}")
        if not any(isinstance(row, list) for row in value):
            value = [
                [item if i == j else 0.0 for j in range(len(value))] for i, item in enumerate(value)
            ]
        rows = [self._row(row, i, len(value)) for i, row in enumerate(value)]
        self._check_symmetry(rows)
        if self.positive:
            self._check_positive(rows)
        return rows

    def _row(self, row: object, i: int, n: int) -> list[float]:
        if not isinstance(row, list) or len(row) != n:
            found = f"has {len(row)} numbers" if isinstance(row, list) else f"is {written(row)}"
            raise explained(
                f"row {i + 1} {found}; with {n} rows each must have {n} numbers; {self.allowed()}"
            )
        return [
            _entry(self.each, item, f"row {i + 1}, column {j + 1}") for j, item in enumerate(row)
        ]

    def _check_symmetry(self, rows: list[list[float]]) -> None:
        for i, row in enumerate(rows):
            for j in range(i):
                other = rows[j][i]
                if abs(row[j] - other) > SYMMETRY * max(abs(row[j]), abs(other)):
                    raise explained(
                        f"found {row[j]:g} in row {i + 1}, column {j + 1} and {other:g} in row "
                        f"{j + 1}, column {i + 1}; the matrix must be symmetric: the two must be "
                        "equal"
                    )

    def _check_positive(self, rows: list[list[float]]) -> None:
        for i, row in enumerate(rows):
            if not row[i] > 0.0:
                raise explained(
                    f"found {row[i]:g} {self.each.unit} in row {i + 1}, column {i + 1}; every "
                    "degree of freedom must have a mass above 0: eliminate those without mass by "
                    "static condensation (do not merely delete their rows and columns)"
                )
        if least_pivot(rows) <= 0.0:
            raise explained(
                "found a matrix for which some motion of the structure has no mass or a "
                "negative one; it must be positive definite: check for off-diagonal entries "
                "that are too large"
            )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe both forms."""
        item = self.each.__get_pydantic_json_schema__(schema, handler)
        row = {"type": "array", "items": item, "maxItems": MOST_DEGREES}
        return {
            "anyOf": [row, {"type": "array", "items": row, "maxItems": MOST_DEGREES}],
            "description": self.what,
        }


def least_pivot(rows: Sequence[Sequence[float]]) -> float:
    """Return Cholesky's smallest squared pivot over the largest entry; above 0: definite."""
    a = [list(row) for row in rows]
    scale = max(abs(v) for row in a for v in row) or 1.0
    least = math.inf
    for k in range(len(a)):
        least = min(least, a[k][k] / scale)
        if least <= 1e-12:
            return min(least, 0.0)
        for i in range(k + 1, len(a)):
            factor = a[i][k] / a[k][k]
            for j in range(k, len(a)):
                a[i][j] -= factor * a[k][j]
    return least


def _entry(each: Range, value: object, where: str) -> float:
    """Read one number; an error names its position."""
    try:
        return each.read(value)
    except PydanticCustomError as error:
        text = str((error.context or {})["text"])
        raise explained(f"{where}: {text}") from None


@dataclass(frozen=True)
class Place(Reader):
    """A degree of freedom, by its label or its number from 1."""

    what: str
    form: ClassVar[str] = "label, or number from 1"

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.what} must be one of the labels, or a number from 1"

    def read(self, value: object) -> int | str:
        """Return label or number; raise an explained error if it is invalid."""
        whole = isinstance(value, int) and not isinstance(value, bool)
        if isinstance(value, int) and whole and 1 <= value <= MOST_DEGREES:
            return value
        if isinstance(value, str) and value:
            return value
        raise explained(f"found {written(value)}; {self.allowed()}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe both forms."""
        number = {"type": "integer", "minimum": 1, "maximum": MOST_DEGREES}
        return {"anyOf": [number, {"type": "string", "minLength": 1}], "description": self.what}


@dataclass(frozen=True)
class Labels(Reader):
    """A name for each degree of freedom."""

    what: str = "the labels"
    form: ClassVar[str] = "list of different strings"

    def allowed(self) -> str:
        """Return what is allowed, in words."""
        return f"{self.what} must be a list of 1 to {MOST_DEGREES} different strings, none empty"

    def read(self, value: object) -> list[str]:
        """Return the names; raise an explained error if they are invalid."""
        texts = isinstance(value, list) and all(isinstance(v, str) and v.strip() for v in value)
        if isinstance(value, list) and texts and 1 <= len(value) <= MOST_DEGREES:
            twice = [v for v in value if value.count(v) > 1]
            if not twice:
                return value
            raise explained(f"found {written(twice[0])} twice; {self.allowed()}")
        raise explained(f"found {written(value)}; {self.allowed()}")

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the list."""
        item = {"type": "string", "minLength": 1}
        return {"type": "array", "items": item, "maxItems": MOST_DEGREES, "description": self.what}


class TakenOut(Table):
    """Known properties of the specimen, if the matrices are those of the whole structure.

    They are subtracted from the matrices at the interface. Default stiffness: the rig's k_e.
    """

    mass_kg: Annotated[float, Range("kg", 0, 1e9, "the specimen's mass")] = 0.0
    damping_n_s_per_m: Annotated[float, Range("N s/m", 0, 1e12, "the specimen's damping")] = 0.0
    stiffness_n_per_m: (
        Annotated[float, Range("N/m", 0, 1e12, "the specimen's stiffness")] | None
    ) = None


def _same_size(what: str) -> Callable[[list[Any], list[Any] | None], str | None]:
    def test(masses: list[Any], other: list[Any] | None) -> str | None:
        if other is None or len(other) == len(masses):
            return None
        n = len(masses)
        return f"found {len(other)} {what}; must be {n}: m_kg has {n} degrees of freedom"

    return test


def _ratios_fit(masses: list[Any], ratios: list[float] | None) -> str | None:
    if ratios is None or len(ratios) in (1, len(masses)):
        return None
    n = len(masses)
    return f"found {len(ratios)} ratios; must be {n}, one for each mode, or one for all of them"


def _is_there(masses: list[Any], labels: list[str] | None, interface: int | str) -> str | None:
    n = len(masses)
    names = labels or []
    if interface in names or (isinstance(interface, int) and interface <= n):
        return None
    known = ", ".join(f'"{name}"' for name in names)
    number = f"a number from 1 to {n}"
    allowed = f"one of {known}, or {number}" if names else f"{number}: there are no labels"
    return f"found {written(interface)}; must be {allowed}"


def _keeps_mass(
    masses: list[list[float]], labels: list[str] | None, interface: int | str, out: TakenOut | None
) -> str | None:
    if out is None or _is_there(masses, labels, interface) is not None:
        return None
    at = index_of(interface, labels)
    left = [list(row) for row in masses]
    left[at][at] -= out.mass_kg
    if least_pivot(left) > 0.0:
        return None
    return (
        f"found a mass of {out.mass_kg:g} kg to be subtracted from {masses[at][at]:g} kg at the "
        "interface; the mass that remains to be computed must be above 0"
    )


def index_of(interface: int | str, labels: list[str] | None) -> int:
    """Return the index of the interface's degree of freedom, from 0."""
    if isinstance(interface, int):
        return interface - 1
    return (labels or []).index(interface)


class Matrices(Table):
    """A linear numerical part of up to eight degrees of freedom, by its matrices.

    Without ``specimen`` they are those of the numerical part alone, and the ground motion acts on
    their masses; with it they are the whole structure's. ``damping_ratios`` refer to the modes of
    the whole structure with an elastic specimen.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("c_n_s_per_m", "damping_ratios"), required=True),
    )
    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("k_n_per_m", ("m_kg", "k_n_per_m"), _same_size("rows")),
        Condition("c_n_s_per_m", ("m_kg", "c_n_s_per_m"), _same_size("rows")),
        Condition("influence", ("m_kg", "influence"), _same_size("numbers")),
        Condition("labels", ("m_kg", "labels"), _same_size("labels")),
        Condition("damping_ratios", ("m_kg", "damping_ratios"), _ratios_fit),
        Condition("interface", ("m_kg", "labels", "interface"), _is_there),
        Condition("specimen", ("m_kg", "labels", "interface", "specimen"), _keeps_mass),
    )

    m_kg: Annotated[
        list[list[float]], Square(Range("kg", -1e9, 1e9, "a mass"), "the masses", positive=True)
    ]
    k_n_per_m: Annotated[
        list[list[float]], Square(Range("N/m", -1e12, 1e12, "a stiffness"), "the stiffnesses")
    ]
    c_n_s_per_m: (
        Annotated[
            list[list[float]], Square(Range("N s/m", -1e12, 1e12, "a damping"), "the dampings")
        ]
        | None
    ) = None
    damping_ratios: (
        Annotated[
            list[float], Numbers(Range("", 0, 2, "a damping ratio"), "the ratios of the modes")
        ]
        | None
    ) = None
    influence: (
        Annotated[
            list[float],
            Numbers(
                Range("", -1e3, 1e3, "an influence"),
                "displacements of the degrees of freedom for a unit displacement of the ground",
            ),
        ]
        | None
    ) = None
    labels: Annotated[list[str], Labels()] | None = None
    interface: Annotated[int | str, Place("the interface with the specimen")] = 1
    integrator: Literal["cr", "rk4"] = "cr"
    force_delay_samples: Annotated[int, Count(0, 1, "the delay of the force in samples")] = 0
    specimen: TakenOut | None = None

    @property
    def at(self) -> int:
        """Index of the interface's degree of freedom, from 0."""
        return index_of(self.interface, self.labels)
