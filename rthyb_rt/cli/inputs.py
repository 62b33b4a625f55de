"""The arguments that several commands share, and the files behind them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.config import RigFile, TestFile

RigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="RIG.toml",
        help="Rig file, or the name of a shipped rig, instead of the one that the test names.",
        show_default=False,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change one value of the test file, or of the rig file with rig. before the key. "
        "Can be repeated.",
        show_default=False,
    ),
]
RigSetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change one value of the rig file. Can be repeated.",
        show_default=False,
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="JSON on stdout, text for people on stderr.")
]
LimitedRigArgument = Annotated[
    str,
    typer.Argument(
        metavar="RIG",
        help="Rig file, or the name of a shipped rig, with limits on position and force.",
        show_default=False,
    ),
]
RecordingArgument = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING", help="Folder of a run, or its recording.h5.", show_default=False
    ),
]


def load(
    test_path: Path | None, rig: str | None, settings: list[str] | None
) -> tuple[TestFile, RigFile]:
    """Read the test file and the rig file with their overrides.

    Args:
        test_path: the test file; None takes the built-in test.
        rig: path or name of the rig; None takes the one that the test names.
        settings: ``key=value`` as given with ``--set``.

    Raises:
        InputError: with the faults of both files.
    """
    from rthyb_rt import config

    test_settings, rig_settings = config.split_overrides(settings or ())
    problems: list[Problem] = []
    test = rig_file = None
    test_path = test_path or config.builtin_test_path()
    try:
        test = config.load_test(test_path, test_settings)
    except InputError as error:
        problems += error.problems
    try:
        if rig:
            rig_file = config.load_rig(config.find_rig(rig), rig_settings)
        # A faulty test file does not say reliably which rig it means.
        elif test is not None:
            named = config.rig_of_test(test, test_path, test_settings)
            rig_file = config.load_rig(named, rig_settings)
    except InputError as error:
        problems += error.problems
    if test is None or rig_file is None:
        raise InputError(problems)
    return test, rig_file
