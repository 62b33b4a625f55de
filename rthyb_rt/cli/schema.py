"""``rthyb schema``: what a test file or a rig file may hold, for editors."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from rthyb_rt.cli import terminal


class Kind(StrEnum):
    """The two kinds of files."""

    TEST = "test"
    RIG = "rig"


def schema(
    kind: Annotated[Kind, typer.Argument(help="Which of the two files.", show_default=False)],
) -> None:
    """Print the JSON schema of test or rig files.

    An editor that knows it completes keys and marks faults while you write.

    \b
    Example:
      rthyb schema test > rthyb-test.schema.json
    """
    from rthyb_rt import config

    terminal.print_json(config.json_schema(kind.value))
