"""Conversion of messages of the command line to Python terms."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Mapping
from typing import Final

import numpy as np

from rthyb_rt.config.fields import written
from rthyb_rt.errors import InputError, Problem, RthybError

MAP_WORDS: Final = {r'--map (\w+)="([^"]*)"': r'columns={"\1": "\2"}'}
"""How a column is assigned to a channel, on the command line and here."""


def map_options(columns: Mapping[str, str] | str | os.PathLike[str] | None) -> list[str]:
    """Return columns by channel, or the path of a mapping file, as values for ``--map``.

    Raises:
        InputError: it is neither.
    """
    if columns is None:
        return []
    if isinstance(columns, Mapping):
        return [f"{channel}={column}" for channel, column in columns.items()]
    if not isinstance(columns, (str, os.PathLike)):
        raise InputError(
            f"found {written(columns)}; give a dict of columns by channel, "
            'columns={"x_meas": "LVDT 1 [mm]"}, or the path of a mapping file',
            "columns",
        )
    return [os.fspath(columns)]


def require_progress(
    progress: object,
    where: str,
    form: str = "two numbers, how many are done and of how many: "
    "progress=lambda done, whole: print(done, whole)",
    takes: int = 2,
) -> None:
    """Refuse what cannot be called to show progress.

    Args:
        progress: the argument; None is allowed.
        where: the function to which it was given.
        form: of what it is a function, with an example.
        takes: number of values with which it is called.

    Raises:
        InputError: it cannot be called, or not with that many values.
    """
    if progress is None:
        return
    found = written(progress)
    if callable(progress):
        try:
            signature = inspect.signature(progress)
        except (TypeError, ValueError):  # of some functions in C Python knows no signature
            return
        try:
            signature.bind(*range(takes))
        except TypeError:
            found = f"a function of {signature}"
        else:
            return
    raise InputError(f"found {found}; give a function of {form}", f"{where}: progress")


def require_flag(given: object, where: str, instead: str = "") -> None:
    """Refuse what is neither True nor False.

    Args:
        given: the argument.
        where: the function and the argument.
        instead: what may have been meant, for the message.

    Raises:
        InputError: it is neither.
    """
    if not isinstance(given, (bool, np.bool_)):
        hint = f"; {instead}" if instead else ""
        raise InputError(f"found {written(given)}; must be True or False{hint}", where)


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
