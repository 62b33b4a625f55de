"""Tests in virtual time (`rthyb run`)."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rthyb_rt.api import files
from rthyb_rt.api.files import Place, Rig, Test
from rthyb_rt.api.messages import require_flag, require_progress
from rthyb_rt.api.recordings import Recording
from rthyb_rt.core.pending import OwnCodeError
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import axes_experiment, experiment, storing, virtual_time

Progress = Callable[[int, int], None]
"""Called with the number of samples done and the total number."""


def prepared(test: Test | Place | None, rig: Rig | Place | None) -> experiment.Setup:
    """Return a test prepared for running; arguments and errors as for `run`."""
    found = files.as_test(test)
    on = found.rig if rig is None else files.as_rig(rig)
    return axes_experiment.prepare_any(files.file_of_test(found), files.file_of_rig(on))


def run(
    test: Test | Place | None = None,
    rig: Rig | Place | None = None,
    *,
    out: Place | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> Recording:
    """Run a hybrid test in virtual time, on the virtual rig described by the rig file.

    If a limit ends the test, this is not an error: `Recording.completed` is then False, and
    `Recording.ending` states the cause. To run a test in real time, use ``rthyb run --realtime``.

    Args:
        test: a test, or the path or name of one; None: the built-in test.
        rig: a rig, or the path or name of one; None: the rig of the test.
        out: folder for recording, settings and report; must be new or empty. None: write nothing.
        report: whether to write the report as well, if matplotlib is installed.
        progress: called at intervals with the samples done and the total.

    Raises:
        InputError: the test, rig or ground motion is invalid (the message lists all errors), or the
            folder is not empty.
        RthybError: the test cannot be started, or the folder cannot be written.
        Exception: any exception raised by your own numerical part, control law or element.

    Examples:
        >>> rec = run("section5-T0.5")
        >>> rec.completed
        True
    """
    require_progress(progress, "run")
    require_flag(report, "run: report", "recording.report(path) writes the report to a path")
    folder = None if out is None else _free(files.path_of(out, "run: out", "a new folder"))
    try:
        setup = prepared(test, rig)
        raw = virtual_time.run(setup, progress)
    except OwnCodeError as error:
        # An exception raised by a user's class keeps its own type, file and line.
        raise error.original from None
    rec = Recording(raw, folder, (*((files.BUILT_IN,) if test is None else ()), *setup.notes))
    if folder is not None:
        with _whole(folder) as stage:
            storing.store(stage, setup, raw)
            if report:
                try:
                    rec.report(stage / "report.html")
                except InputError as error:
                    rec.notes += (f"no report was written: {error}",)
    return rec


def _free(folder: Path) -> Path:
    """Return the folder if it is new or empty.

    Raises:
        InputError: the folder is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "already exists; give a new folder as out, so that no run is lost", str(folder)
        )
    return folder


@contextmanager
def _whole(folder: Path) -> Iterator[Path]:
    """Yield a hidden folder next to `folder`; rename it to `folder` if the block succeeds.

    Raises:
        RthybError: it cannot be written; nothing is left behind.
    """
    # Named as by the command line, which removes those that a killed process has left.
    stage = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        stage.mkdir(parents=True)
        yield stage
        stage.rename(folder)
    except OSError as error:
        raise RthybError(
            f"cannot be written ({error.strerror or error}); check permissions and free space, or "
            "give another folder as out",
            where=str(folder),
        ) from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)
