"""Tables and lists of a test or a rig, which can be read but not changed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NoReturn

_OF_TABLE: Final = (
    "__setitem__", "__delitem__", "__ior__", "update", "setdefault", "pop", "popitem", "clear",
)  # fmt: skip
_OF_LIST: Final = (
    "__setitem__", "__delitem__", "__iadd__", "__imul__", "append", "extend", "insert", "remove",
    "pop", "clear", "sort", "reverse",
)  # fmt: skip


def of(value: Any, kind: str, key: str) -> Any:
    """Return a value of a file; in place of a table or a list one that refuses every change.

    A change of a copy would be lost without a word.

    Args:
        value: as read from the file.
        kind: "test" or "rig".
        key: its dotted key.
    """
    if isinstance(value, dict):
        return ReadOnlyTable(
            {name: of(inner, kind, f"{key}.{name}") for name, inner in value.items()}, kind, key
        )
    if isinstance(value, list):
        items = [of(inner, kind, f"{key}.{i}") for i, inner in enumerate(value)]
        return ReadOnlyList(items, kind, key)
    return value


class ReadOnlyTable(dict[str, Any]):
    """A table of a test or a rig: a dict that refuses every change; its `copy` is a plain dict."""

    def __init__(self, values: dict[str, Any], kind: str, key: str) -> None:
        super().__init__(values)
        self._kind, self._key = kind, key

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        """Be copied and pickled as a plain dict."""
        return dict, (dict(self),)


class ReadOnlyList(list[Any]):
    """A list of a test or a rig: it refuses every change; ``[*it, more]`` is a plain list."""

    def __init__(self, values: list[Any], kind: str, key: str) -> None:
        super().__init__(values)
        self._kind, self._key = kind, key

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        """Be copied and pickled as a plain list."""
        return list, (list(self),)


def _refuse(name: str) -> Callable[..., NoReturn]:
    def method(self: ReadOnlyTable | ReadOnlyList, *given: Any, **_: Any) -> NoReturn:
        kind, key = self._kind, self._key
        changed = f'{kind}["{key}"]'
        if name == "__setitem__" and isinstance(self, ReadOnlyTable):
            changed, key = f'{changed}["{given[0]}"]', f"{key}.{given[0]}"
        raise TypeError(
            f"{changed} cannot be changed, because a {kind} never changes; "
            f'{kind}.with_({{"{key}": ...}}) returns a changed copy'
        )

    method.__name__ = name
    method.__doc__ = "Refuse the change; raises ``TypeError`` that names ``with_``."
    return method


for _class, _names in ((ReadOnlyTable, _OF_TABLE), (ReadOnlyList, _OF_LIST)):
    for _name in _names:
        setattr(_class, _name, _refuse(_name))
