"""Errors that a user can act on: what was found, where, what is allowed and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Problem:
    """One error in the user's input.

    Attributes:
        where: file, line and key as an editor understands them (``test.toml:12: controller.w1``).
        message: the value found, what is allowed, and the remedy.
    """

    where: str
    message: str

    def __str__(self) -> str:
        """Return the error as one line, ``where: message``."""
        return f"{self.where}: {self.message}" if self.where else self.message


class RthybError(Exception):
    """Any failure that the command line reports as one message, without a traceback.

    Args:
        message: what was found, what is allowed, and the remedy.
        where: the file or folder concerned, if any.

    Attributes:
        exit_code: exit status of the command line for this kind of failure.
        problems: the errors, never empty.
    """

    exit_code = 1

    def __init__(self, message: str = "", *, where: str = "") -> None:
        self.problems = [Problem(where, message)]
        super().__init__(str(self.problems[0]))


class InputError(RthybError):
    """A configuration or input file that cannot be used.

    Args:
        problems: every error found; a single `Problem` or a plain message is also accepted.
        where: place of the error if ``problems`` is a plain message.

    Attributes:
        problems: the errors in the order of the file, never empty.
    """

    exit_code = 3

    def __init__(self, problems: Iterable[Problem] | Problem | str, where: str = "") -> None:
        if isinstance(problems, str):
            self.problems = [Problem(where, problems)]
        elif isinstance(problems, Problem):
            self.problems = [problems]
        else:
            self.problems = list(problems)
        Exception.__init__(self, *self.problems)

    def __str__(self) -> str:
        """Return one line per error."""
        return "\n".join(str(problem) for problem in self.problems)
