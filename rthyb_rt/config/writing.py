"""The resolved configuration as TOML text."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

from rthyb_rt.config.fields import Table


def dump(table: Table) -> str:
    """Return a test or rig with every default written out, as TOML that reads back equal.

    Keys whose value is absent are left out. The text ends with a newline.
    """
    return "\n".join(_table_lines((), table.model_dump(by_alias=True))).strip() + "\n"


def _table_lines(
    path: tuple[str, ...], table: Mapping[str, object], header: str = ""
) -> Iterator[str]:
    """Write the plain values first: after a sub-table they would belong to that one."""
    plain = {k: v for k, v in table.items() if not isinstance(v, dict) and not _is_tables(v)}
    lines = [f"{key} = {_value(value)}" for key, value in plain.items() if value is not None]
    if header and lines:
        yield f"\n{header}"
    yield from lines
    for key, value in table.items():
        inner = (*path, key)
        name = ".".join(inner)
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
        # JSON's escapes are TOML's, but for DEL, which TOML wants escaped as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(value)
