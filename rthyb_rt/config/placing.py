"""Locations of the values of a file, for errors found only when files are combined.

Errors within one file are reported with their line while it is read
(`rthyb_rt.config.loading`). Conflicts between test and rig, or between a test and its
matrices, are found later and only by key. A file that was read keeps its text, and so the
line of every key.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, ParamSpec, TypeVar

from rthyb_rt.config.changes import ON_COMMAND_LINE, Wording
from rthyb_rt.config.lines import KeyLines
from rthyb_rt.config.lines import Path as KeyPath
from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.config.fields import WholeFile

_P = ParamSpec("_P")
_R = TypeVar("_R")


@dataclass(frozen=True)
class SourceText:
    """The text from which the values of a file were read; ignored when files are compared.

    Attributes:
        path: path of the file; empty for values that come from no file.
        text: content of the file.
        given: key of each value that was given beside the file, and its name there.
        wording: how messages refer to such a value.
    """

    path: str = field(default="", compare=False)
    text: str = field(default="", compare=False, repr=False)
    given: Mapping[KeyPath, str] = field(default_factory=dict, compare=False, repr=False)
    wording: Wording = field(default=ON_COMMAND_LINE, compare=False, repr=False)

    def has(self, path: KeyPath) -> bool:
        """Return whether the text or the given values contain a key, or a table of that name."""
        return _lines(self.text).has(path) or any(key[: len(path)] == path for key in self.given)

    def place(self, path: KeyPath) -> str:
        """Return the location of a key: an option, or file, line and key."""
        for size in range(len(path), 0, -1):
            if path[:size] in self.given:
                within = [self.given[path[:size]], *map(str, path[size:])]
                return self.wording.place(".".join(within))
        lines = _lines(self.text)
        line = f":{lines.find(path)}" if lines.has(path[:1]) else ""
        return f"{self.path}{line}: {'.'.join(map(str, path))}"


@functools.lru_cache(maxsize=16)
def _lines(text: str) -> KeyLines:
    return KeyLines(text)


NOWHERE: Final = SourceText()
"""The source of values that come from no file."""


def placing(work: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function so that its errors have the file and line of their keys.

    A location that is a key of a file among the arguments becomes file, line and key. If several
    files have the key, the one that contains it is used, or else the first argument.
    """

    @functools.wraps(work)
    def placed(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            return work(*args, **kwargs)
        except InputError as error:
            # Imported here, because that module imports this one.
            from rthyb_rt.config.fields import WholeFile, has_key

            given = (*args, *kwargs.values())
            files = [each for each in given if isinstance(each, WholeFile)]
            error.problems = [_placed(problem, files, has_key) for problem in error.problems]
            error.args = tuple(error.problems)
            raise

    return placed


def _placed(
    problem: Problem, files: list[WholeFile], has_key: Callable[[type, KeyPath], bool]
) -> Problem:
    path: KeyPath = tuple(int(one) if one.isdecimal() else one for one in problem.where.split("."))
    able = [file.source for file in files if file.source.path and has_key(type(file), path)]
    for size in range(len(path), 0, -1):
        for source in able:
            if source.has(path[:size]):
                return Problem(source.place(path), problem.message)
    return Problem(able[0].place(path), problem.message) if able else problem
