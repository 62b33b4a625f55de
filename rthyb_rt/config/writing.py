"""The resolved configuration as TOML text."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from rthyb_rt.config.fields import Table


def dump(table: Table) -> str:
    """Return a test or rig with every default written out, as TOML that reads back equal.

    Absent keys are omitted. Values of a rig that nobody stated are written, and listed as
    ``rig.assumed``, so that they stay known as such. The text ends with a newline.
    """
    values = table.model_dump(by_alias=True)
    assumed = getattr(table, "assumed", None)
    if assumed is not None:
        # A changed copy of a rig still has the list of the file that it was read from.
        values["rig"]["assumed"] = list(assumed) or None
    return dump_values(values)


def dump_given(table: Table) -> str:
    """Return a file like `dump`, but without the values that its rig took from another rig.

    Whatever reads it states them again: see `rthyb_rt.config.deriving.omitted`.
    """
    values = table.model_dump(by_alias=True)
    remove_omitted(table, values)
    return dump_values(values)


def remove_omitted(table: Table, values: dict[str, Any]) -> None:
    """Remove from the values of a rig file, in place, those that it took from another rig."""
    if hasattr(table, "assumed"):
        values["rig"].pop("assumed", None)
    axes = zip(getattr(table, "axis", ()), values.get("axis", ()), strict=True)
    for inner, own in [(table, values), *axes]:
        for key in getattr(getattr(inner, "actuator", None), "omitted", ()):
            own["actuator"].pop(key, None)


def dump_values(values: Mapping[str, object]) -> str:
    """Return the values of a file as TOML, table by table; otherwise like `dump`."""
    return "\n".join(_table_lines((), values)).strip() + "\n"


def inline(value: object) -> str:
    """Return one value as TOML, with tables in braces."""
    return _value(value)


def _table_lines(
    path: tuple[str, ...], table: Mapping[str, object], header: str = ""
) -> Iterator[str]:
    """Return a table's lines, plain values first: after a sub-table they would belong to it."""
    plain = {k: v for k, v in table.items() if not isinstance(v, dict) and not _is_tables(v)}
    lines = [f"{_key(k)} = {_value(value)}" for k, value in plain.items() if value is not None]
    if header and lines:
        yield f"\n{header}"
    yield from lines
    for key, value in table.items():
        inner = (*path, key)
        name = ".".join(_key(part) for part in inner)
        if isinstance(value, dict):
            yield from _table_lines(inner, value, f"[{name}]")
        elif isinstance(value, list) and _is_tables(value):
            for row in value:
                yield from _table_lines(inner, row, f"[[{name}]]")


def _is_tables(value: object) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are valid in TOML, except that TOML also requires DEL to be escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, Mapping):
        pairs = (f"{_key(key)} = {_value(inner)}" for key, inner in value.items())
        return "{ " + ", ".join(pairs) + " }"
    return repr(value)


def _key(key: object) -> str:
    """Return a key in TOML notation, bare if possible."""
    return _quoted(str(key))


@functools.lru_cache(maxsize=1024)
def _quoted(text: str) -> str:
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else _value(text)
