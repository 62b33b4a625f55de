"""Common functions for documents of nested tables."""

from __future__ import annotations

import copy
import functools
import math
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any


def toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    The last few texts are kept, because thousands of runs of a campaign read the same files; each
    caller has a copy of its own.

    Raises:
        tomllib.TOMLDecodeError: the text is not TOML.
        RecursionError: it is nested too deeply.
    """
    return copy.deepcopy(_tables(text))


def toml_if_valid(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text, as `toml` does; none if it is not TOML.

    For the files in a recording, which may be damaged or of another version.
    """
    try:
        return toml(text)
    except tomllib.TOMLDecodeError:
        return {}


@functools.lru_cache(maxsize=8)
def _tables(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def flat(tables: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys and the values of nested tables; an empty table is a value."""
    for key, value in tables.items():
        if isinstance(value, Mapping) and value:
            yield from ((f"{key}.{inner}", found) for inner, found in flat(value))
        else:
            yield key, value


def finite(value: Any) -> Any:
    """Return a copy of a document with None for each number that JSON cannot represent."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
