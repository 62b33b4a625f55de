"""The line number of each key of a TOML text, for messages.

`tomllib` returns values without positions. This scanner reads a text that `tomllib` has accepted
and records the line of every key, table and array element; it does not validate anything.
"""

from __future__ import annotations

import re
import tomllib
from bisect import bisect_right

Path = tuple[str | int, ...]
"""Keys and array indices from the top of the file: ``("specimen", 0, "k_n_per_m")``."""

_BLANK = re.compile(r"(?:[\s,]|#[^\n]*)*")
_KEY = re.compile(r"""[ \t]*([A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')[ \t]*(\.?)""")
_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}|'
    r"'''.*?'{3,5}|"
    r'"(?:[^"\\\n]|\\.)*"|'
    r"'[^'\n]*'",
    re.S,
)
_SCALAR = re.compile(r"[^,\]}\n#]+")


class KeyLines:
    """Line numbers of the keys of one TOML text.

    Args:
        text: a text that `tomllib.loads` accepts.

    Attributes:
        lines: line (from 1) of each key, table header and array element that is written out.
    """

    def __init__(self, text: str) -> None:
        self.lines: dict[Path, int] = {}
        # One character per line end: offsets remain correct for the scan below.
        self._text = text.replace("\r\n", "\n")
        self._ends = [match.start() for match in re.finditer("\n", self._text)]
        self._at = 0
        self._array_sizes: dict[Path, int] = {}
        self._scan()

    def find(self, path: Path) -> int:
        """Return the line of a key, or of the nearest table around it that is written out."""
        for size in range(len(path), 0, -1):
            if path[:size] in self.lines:
                return self.lines[path[:size]]
            inside = self._lines_inside(path[:size])
            if inside:
                return min(inside)
        return 1

    def has(self, path: Path) -> bool:
        """Return whether the text has a key, or keys inside a table of that name."""
        return bool(self._lines_inside(path))

    def _lines_inside(self, path: Path) -> list[int]:
        return [line for key, line in self.lines.items() if key[: len(path)] == path]

    def _note(self, path: Path) -> None:
        self.lines.setdefault(path, bisect_right(self._ends, self._at - 1) + 1)

    def _scan(self) -> None:
        table: Path = ()
        while self._skip_blank():
            if self._text.startswith("[[", self._at):
                table = self._array_table()
            elif self._text[self._at] == "[":
                start = self._at
                self._at += 1
                table = self._inside_arrays(self._key())
                self._at, end = start, self._at + 1
                self._note(table)
                self._at = end
            else:
                self._pair(table)

    def _array_table(self) -> Path:
        start = self._at
        self._at += 2
        parts = self._key()
        end = self._at + 2
        array = (*self._inside_arrays(parts[:-1]), parts[-1])
        index = self._array_sizes.get(array, 0)
        self._array_sizes[array] = index + 1
        self._at = start
        self._note(array)
        self._note((*array, index))
        self._at = end
        return (*array, index)

    def _inside_arrays(self, parts: Path) -> Path:
        path: Path = ()
        for part in parts:
            path = (*path, part)
            if path in self._array_sizes:
                path = (*path, self._array_sizes[path] - 1)
        return path

    def _pair(self, table: Path) -> None:
        start = self._at
        path = (*table, *self._key())
        end = self._at + 1
        self._at = start
        self._note(path)
        self._at = end
        self._value(path)

    def _value(self, path: Path) -> None:
        self._skip_blank()
        opening = self._text[self._at]
        if opening == "[":
            self._at += 1
            index = 0
            while self._skip_blank() and self._text[self._at] != "]":
                self._note((*path, index))
                self._value((*path, index))
                index += 1
            self._at += 1
        elif opening == "{":
            self._at += 1
            while self._skip_blank() and self._text[self._at] != "}":
                self._pair(path)
            self._at += 1
        else:
            match = (_STRING if opening in "\"'" else _SCALAR).match(self._text, self._at)
            self._at = match.end() if match else len(self._text)

    def _key(self) -> Path:
        """Read a dotted key and stop at the ``=`` or ``]`` after it."""
        parts: list[str] = []
        more = True
        while more and (match := _KEY.match(self._text, self._at)):
            written = match[1]
            if written[0] in "\"'":
                written = str(tomllib.loads(f"key = {written}")["key"])
            parts.append(written)
            more = match[2] == "."
            self._at = match.end()
        return tuple(parts)

    def _skip_blank(self) -> bool:
        """Advance to the next significant character; false at the end of the text."""
        match = _BLANK.match(self._text, self._at)
        if match:
            self._at = match.end()
        return self._at < len(self._text)
