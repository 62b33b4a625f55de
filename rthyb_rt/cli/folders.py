"""The folder that a command fills: it appears whole or not at all, and overwrites nothing."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from rthyb_rt.errors import RthybError

_TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)


def refuse_taken(out: Path | None) -> None:
    """Let an empty folder be filled, but nothing be overwritten."""
    if out is None:
        return
    try:
        taken = out.exists() and (not out.is_dir() or any(out.iterdir()) or out.samefile(Path()))
    except OSError as error:
        raise _unwritable(out, error) from error
    if taken:
        raise typer.BadParameter(
            f"{out} exists already; name a new folder, so that no run is lost", param_hint="--out"
        )


def _unwritable(folder: Path, error: OSError) -> RthybError:
    return RthybError(
        f"{folder}: cannot be written ({error.strerror or error}); check permissions and space, "
        "or name another folder with --out"
    )


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Give a hidden folder beside the target; what was not published is gone afterwards."""
    stage = target.with_name(f".{target.name}.{os.getpid()}.part")
    made = [folder for folder in (target.parent, *target.parent.parents) if not folder.exists()]
    try:
        stage.mkdir(parents=True)
        yield stage
    except OSError as error:
        raise _unwritable(target.parent, error) from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        for folder in made:
            _remove_if_empty(folder)


def _remove_if_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except OSError:
        return


def publish(stage: Path, target: Path, *, numbered: bool) -> Path:
    """Move the folder to its place; the second run of one second gets a number behind its name."""
    number = 1
    while True:
        place = target if number == 1 else target.with_name(f"{target.name}-{number}")
        try:
            stage.rename(place)
            return place
        except OSError as error:
            if not numbered or error.errno not in _TAKEN:
                raise
        number += 1
