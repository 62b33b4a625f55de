"""Conversion of messages of the command line to Python terms."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Final

from rthyb_rt.errors import InputError, Problem, RthybError

MAP_WORDS: Final = {r'--map (\w+)="([^"]*)"': r'columns={"\1": "\2"}'}
"""How a column is assigned to a channel, on the command line and here."""


def map_options(columns: Mapping[str, str] | str | os.PathLike[str] | None) -> list[str]:
    """Return columns by channel, or the path of a mapping file, as values for ``--map``."""
    if columns is None:
        return []
    if isinstance(columns, Mapping):
        return [f"{channel}={column}" for channel, column in columns.items()]
    return [os.fspath(columns)]


def in_python(error: RthybError, words: Mapping[str, str]) -> RthybError:
    """Return an error with options and keys replaced by Python terms.

    Args:
        error: the error.
        words: patterns in its messages and places, and their replacements.
    """
    problems = []
    for problem in error.problems:
        where, message = problem.where, problem.message
        for called, here in words.items():
            where, message = re.sub(called, here, where), re.sub(called, here, message)
        problems.append(Problem(where, message))
    if isinstance(error, InputError):
        return InputError(problems)
    return RthybError(problems[0].message, where=problems[0].where)
