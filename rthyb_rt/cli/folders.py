"""Output folders of commands: they appear complete or not at all, and overwrite nothing."""

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
    from rthyb_rt.record.recording import RecordedTest

_TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)
_STAGE = re.compile(r"\..+\.(\d{1,9})\.part", re.DOTALL)


def refuse_taken(out: Path | None) -> None:
    """Refuse a folder that is not empty, so that nothing is overwritten."""
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
    """Yield a hidden folder beside the target; it is deleted afterwards unless it was published.

    Hidden folders of commands that were killed are deleted as well.
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
        # For example the ring that still contains the test.
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
    """Delete the hidden folders of processes that have ended.

    A lock protects the folder of a process that is invisible here, such as one in a container.
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
    """Lock a folder until the returned descriptor is closed; None if that is not possible."""
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
    """Move the folder to its final place; a second run in the same second gets a number."""
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


def report_beside(rec: RecordedTest, folder: Path) -> Path | None:
    """Write the report of a run beside its recording, or print which packages it needs."""
    from rthyb_rt.report import write_report

    path = folder / "report.html"
    try:
        write_report(rec, path)
    except InputError as error:
        terminal.tell(f"no report was written: {error}, then: rthyb report {folder}")
        return None
    return path
