"""Wording of messages about changes of a file: as written after ``--set``, or in Python."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Wording:
    """The words of messages about a changed value, as formats.

    Attributes:
        where: a place, with ``{key}``.
        table: the change of a whole table, with ``{key}`` and ``{inner}``.
        pair: a key in that table, with ``{key}`` and ``{value}``.
    """

    where: str
    table: str
    pair: str

    def place(self, key: str) -> str:
        """Return the place of a changed key."""
        return self.where.format(key=key)

    def whole(self, key: str, values: Mapping[str, str]) -> str:
        """Return how to replace a whole table by keys with values in TOML notation."""
        inner = ", ".join(self.pair.format(key=k, value=v) for k, v in values.items())
        return self.table.format(key=key, inner=inner)


ON_COMMAND_LINE: Final = Wording("--set {key}", "--set '{key}={{ {inner} }}'", "{key} = {value}")
IN_PYTHON: Final = Wording("with_: {key}", 'with_({{"{key}": {{{inner}}}}})', '"{key}": {value}')
