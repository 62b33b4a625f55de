"""Arguments that several commands have in common, and reading the files that they name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig, RigFile, TestFile

RigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="RIG.toml",
        help="Rig file or name of a shipped rig, instead of the one named in the test file.",
        show_default=False,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override one value of the test file, or of the rig file if KEY begins with rig. "
        "Can be repeated.",
        show_default=False,
    ),
]
RigSetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override one value of the rig file. Can be repeated.",
        show_default=False,
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Write JSON to stdout; human-readable text goes to stderr.")
]
LimitedRigArgument = Annotated[
    str,
    typer.Argument(
        metavar="RIG",
        help="Rig file or name of a shipped rig; it must limit position and force.",
        show_default=False,
    ),
]
AxisOption = Annotated[
    str | None,
    typer.Option(
        "--axis",
        metavar="NAME",
        help="The axis, on a rig of several axes.",
        show_default=False,
    ),
]
RecordingArgument = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING", help="Folder of a run, or its recording.h5 file.", show_default=False
    ),
]


def load(
    test_path: Path | None, rig: str | None, settings: list[str] | None
) -> tuple[TestFile, RigFile]:
    """Read the test file and the rig file with their overrides, see `config.load_both`.

    Raises:
        InputError: lists the errors of both files.
    """
    from rthyb_rt import config

    return config.load_both(test_path, rig, settings or ())


def load_any(
    test_path: Path | None, rig: str | None, settings: list[str] | None
) -> tuple[TestFile, RigFile | AxesRig]:
    """Read both files, with a rig of one axis or of several; otherwise as `load`."""
    from rthyb_rt import config

    return config.load_any_both(test_path, rig, settings or ())


def note_unused(test: TestFile, settings: list[str] | None) -> None:
    """Name settings on stderr that belong to a control law which the test does not use.

    In a file they may stand ready for another run; on the command line they are mistakes.
    """
    from rthyb_rt.cli import terminal
    from rthyb_rt.config import lawtables

    laws = dict.fromkeys([test.controller.type, *(one.type for one in test.controller.axis)])
    for text in lawtables.unused(list(laws), settings or ()):
        terminal.tell(f"note: {text}")
