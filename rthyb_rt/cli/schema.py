"""``rthyb schema``: JSON schemas of test, rig, baseline, mapping and campaign files."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from rthyb_rt.cli import terminal


class Kind(StrEnum):
    """The kinds of files."""

    TEST = "test"
    RIG = "rig"
    BASELINE = "baseline"
    MAP = "map"
    CAMPAIGN = "campaign"


def schema(
    kind: Annotated[Kind, typer.Argument(help="Kind of file.", show_default=False)],
) -> None:
    """Print the JSON schema of one kind of file.

    An editor that uses it completes keys and marks errors while you type.

    \b
    Example:
      rthyb schema test > rthyb-test.schema.json
    """
    from rthyb_rt import config

    terminal.print_json(config.json_schema(kind.value))
