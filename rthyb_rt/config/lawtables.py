"""The keys of ``[controller]`` that control laws need, derived from the tables of the laws."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, TypeVar

from pydantic import AfterValidator, Field, create_model
from pydantic_core import PydanticCustomError

from rthyb_rt.config.fields import Range, Table
from rthyb_rt.config.own_tables import PYTHON
from rthyb_rt.config.rate import STANDARD
from rthyb_rt.core.laws import LAWS, LawDescription, Parameter, parameters

_T = TypeVar("_T", bound=Table)

DEFAULT_LAW: Final = "paper"
RESPONSE: Final = "identified.frequency_hz"
"""Key of the rig file that a law's setting names if it is fitted to the identified response."""
DELAY: Final = "identified.delay_s"
COEFFICIENTS: Final = tuple(f"b{j}" for j in range(6))
"""Last part of the keys of the coefficients of a fitted inverse; they belong together."""


TABLES: Final[dict[type[Table], str]] = {}
"""The tables created by `extended`, with the prefix of their keys up to the last dot."""


def range_of(p: Parameter) -> Range:
    """Return the field for the key of a parameter."""
    return Range(p.unit, p.low, p.high, p.meaning, open_low=p.open_low, open_high=p.open_high)


def extended(
    base: type[_T], name: str, table: str, sections: Mapping[str, type[Table]] | None = None
) -> type[_T]:
    """Return a table extended by the keys that control laws need in it.

    Args:
        base: table with the keys that belong to no law.
        name: name of the class.
        table: prefix of the keys up to their last point, ``""`` for [controller] itself.
        sections: tables within this one that exist already; all others that a law needs are
            created.
    """
    fields: dict[str, Any] = {}
    for key, users in parameters().items():
        prefix, _, last = key.rpartition(".")
        first = users[0][1]
        if prefix == table:
            bounds = Annotated[float, range_of(first)]
            # With a default from the rig, the file need not give it.
            absent = first.default is None or first.rig_key is not None
            fields[last] = (bounds | None, None) if absent else (bounds, first.default)
        elif not table and prefix not in fields and prefix not in (sections or {}):
            fields[prefix] = (Annotated[_table_of(prefix) | None, AfterValidator(_said)], None)
    for key, model in (sections or {}).items():
        fields[key] = (model, Field(default_factory=model))
    made: type[_T] = create_model(name, __base__=base, __module__=base.__module__, **fields)
    TABLES[made] = table
    return made


@functools.cache
def _table_of(prefix: str) -> type[Table]:
    """Return the table of the laws' keys with a prefix."""
    return extended(Table, prefix.title().replace("_", ""), prefix)


def _said(table: _T | None) -> _T | None:
    """Return the table of a law, or None if it is empty, which is equivalent."""
    if table is None or all(value is None for _, value in table):
        return None
    return table


def setting(table: Table, key: str) -> float | None:
    """Return a [controller] table's value for a law's parameter, else its default, else None."""
    place: Any = table
    for part in key.split("."):
        place = getattr(place, part, None)
    if place is not None:
        return float(place)
    found = parameters().get(key)
    return found[0][1].default if found else None


def unused(used: Sequence[str], settings: Sequence[str]) -> list[str]:
    """Return what settings are not used because they belong to control laws not chosen.

    Args:
        used: names of the laws of the test.
        settings: ``key=value`` as given with ``--set``.
    """
    if not set(used) <= set(LAWS):
        return []  # of the user's own, whose settings are not in the table of this program
    known, found = parameters(), []
    for setting in settings:
        place = setting.partition("=")[0].strip()
        of = [law.name for law, _ in known.get(place.removeprefix("controller."), ())]
        if place.startswith("controller.") and of and not set(of) & set(used):
            found.append(
                f"--set {place} is not used: it belongs to the control law {' or '.join(of)}, and "
                f"controller.type is {' and '.join(used)}"
            )
    return found


def with_settings(table: _T, values: Mapping[str, float]) -> _T:
    """Return a [controller] table with the given settings of laws written out, by their keys."""
    own = {key: value for key, value in values.items() if "." not in key}
    inner: dict[str, dict[str, float]] = {}
    for key, value in values.items():
        prefix, _, last = key.rpartition(".")
        if prefix:
            inner.setdefault(prefix, {})[last] = value
    for prefix, given in inner.items():
        section = getattr(table, prefix)
        own[prefix] = (
            type(table).model_validate({prefix: given}).__getattribute__(prefix)
            if section is None
            else section.model_copy(update=given)
        )
    return table.model_copy(update=own)


def faults(
    keys: Mapping[str, Any],
) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
    """Yield errors in the combination of the chosen law's settings, once each is valid on its own.

    Each error is the place below [controller], the message, and the other keys involved.
    """
    if keys.get("type") == PYTHON:
        return
    law = LAWS.get(str(keys.get("type", DEFAULT_LAW)), LAWS[DEFAULT_LAW])
    values = _values(law, keys)
    if values is None:
        return
    partial = _partial_inverse(law, keys)
    if partial is not None:
        yield partial
        return
    found = law.complaint(values, STANDARD.period_s)
    if found is None:
        return
    key, text = found
    prefix = key.rpartition(".")[0]
    words = set(re.findall(r"\w+", text))
    others = [
        p.key
        for p in law.parameters
        if p.key != key and p.key.rpartition(".")[2] in words and p.key.startswith(prefix)
    ]
    if any(_only_the_rig_knows(law, one, keys) for one in (key, *others)):
        return
    beside = [one.removeprefix(f"{prefix}." if prefix else "") for one in others]
    yield tuple(key.split(".")), _with_its_key(text, key, others, keys), tuple(beside)


def coefficients_of(law: LawDescription) -> tuple[str, ...]:
    """Return the keys of the coefficients of a law's fitted inverse, below [controller]."""
    return tuple(
        p.key
        for p in law.parameters
        if p.rig_key == RESPONSE and p.key.rpartition(".")[2] in COEFFICIENTS
    )


def _partial_inverse(
    law: LawDescription, keys: Mapping[str, Any]
) -> tuple[tuple[str, ...], str, tuple[str, ...]] | None:
    """Return an error if some coefficients of an inverse are given and others are not.

    The missing ones cannot be fitted: each depends on all others.
    """
    all_of_them = coefficients_of(law)
    given = [key for key in all_of_them if _at(keys, key) is not None]
    if not given or len(given) == len(all_of_them):
        return None
    missing = ", ".join(key.rpartition(".")[2] for key in all_of_them if key not in given)
    text = (
        f"found {', '.join(key.rpartition('.')[2] for key in given)} without {missing}; the "
        "coefficients of the inverse belong together: give all six, as in the resolved test file "
        "of a run, or none, so that they are fitted to what rthyb identify has found"
    )
    return tuple(given[0].split(".")), text, ()


def _only_the_rig_knows(law: LawDescription, key: str, keys: Mapping[str, Any]) -> bool:
    """Return whether a setting is the delay of the rig; it is checked once the rig is read."""
    found = law.parameter(key)
    return found is not None and found.rig_key == DELAY and _at(keys, key) is None


def _with_its_key(text: str, key: str, others: Sequence[str], keys: Mapping[str, Any]) -> str:
    """Return a complaint that names the setting whose value it begins with, where that is needed.

    An error is reported at the setting that the user has changed, which may be another of those
    that contradict each other; without its key, the value would be taken for that of the other.
    """
    given = _at(keys, key) is not None
    if given and all(_at(keys, other) is None for other in others):
        return text
    named = f"found {key.rpartition('.')[2]} = "
    if given:
        return re.sub(r"^found ", named, text)
    return re.sub(r"^found ([^;]*);", rf"{named}\1, its default;", text)


def _at(keys: Mapping[str, Any], key: str) -> Any:
    """Return the value of a key with points below [controller], or None."""
    place: Any = keys
    for part in key.split("."):
        place = place.get(part) if isinstance(place, Mapping) else None
    return place


def _values(law: LawDescription, keys: Mapping[str, Any]) -> list[float] | None:
    """Return all settings, NaN for those that only the rig knows; None if one is not valid."""
    values = []
    for p in law.parameters:
        place = _at(keys, p.key)
        if place is None:
            values.append(math.nan if p.default is None else p.default)
            continue
        try:
            values.append(range_of(p).read(place))
        except PydanticCustomError:
            return None
    return values
