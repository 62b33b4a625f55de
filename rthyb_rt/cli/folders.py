"""The folder that a command fills: it appears whole or not at all, and overwrites nothing."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.errors import InputError, RthybError

if TYPE_CHECKING:
    from rthyb_rt.record.recording import Recording

_TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)
_STAGE = re.compile(r"\..+\.(\d{1,9})\.part", re.DOTALL)


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
            f"{out} already exists; choose a new folder, so that no run is lost", param_hint="--out"
        )


def _unwritable(folder: Path, error: OSError) -> RthybError:
    return RthybError(
        f"cannot be written ({error.strerror or error}); check permissions and free space, or "
        "choose another folder with --out",
        where=str(folder),
    )


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Give a hidden folder beside the target; what was not published is gone afterwards.

    So are the hidden folders of commands that were killed.
    """
    _sweep(target.parent)
    stage = target.with_name(f".{target.name}.{os.getpid()}.part")
    lock: int | None = None
    made = [folder for folder in (target.parent, *target.parent.parents) if not folder.exists()]
    try:
        stage.mkdir(parents=True)
        lock = _locked(stage)
        yield stage
    except OSError as error:
        refused = _unwritable(target.parent, error)
        # Where the ring is that still has the test, for one.
        for note in getattr(error, "__notes__", ()):
            refused.add_note(note)
        raise refused from error
    finally:
        if lock is not None:
            os.close(lock)
        shutil.rmtree(stage, ignore_errors=True)
        for folder in made:
            _remove_if_empty(folder)


def _sweep(parent: Path) -> None:
    """Remove the hidden folders of processes that are no more.

    A lock tells that a process lives that cannot be seen from here, such as in a container.
    """
    for folder in parent.glob(".*.part"):
        match = _STAGE.fullmatch(folder.name)
        if match is None or not folder.is_dir() or _lives(int(match[1])):
            continue
        lock = _locked(folder)
        if lock is not None:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(lock)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _locked(folder: Path) -> int | None:
    """Lock a folder until the returned descriptor is closed; None where that cannot be had."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


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
            with interrupts.held():
                stage.rename(place)
                interrupts.wrote(place)
            return place
        except OSError as error:
            if not numbered or error.errno not in _TAKEN:
                raise
        number += 1


def report_beside(rec: Recording, folder: Path) -> Path | None:
    """Write the report of a run beside its recording, or say which packages it needs."""
    from rthyb_rt.report import write_report

    path = folder / "report.html"
    try:
        write_report(rec, path)
    except InputError as error:
        terminal.tell(f"no report was written: {error}, then: rthyb report {folder}")
        return None
    return path
