"""Common functions for documents of nested tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any


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
