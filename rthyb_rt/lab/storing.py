"""Storing a test: its recording, and the settings that were used."""

from __future__ import annotations

from pathlib import Path

from rthyb_rt import config
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record import recording
from rthyb_rt.record.recording import RecordedTest


def store(folder: Path, setup: Setup, rec: RecordedTest) -> None:
    """Write recording, test and rig to an existing folder; the test refers to that rig file.

    Raises:
        RthybError: the recording cannot be written.
        OSError: a settings file cannot be written.
    """
    recording.write(folder / recording.FILE_NAME, rec)
    test = config.dump(setup.test.model_copy(update={"rig": "rig.toml"}))
    (folder / "test.toml").write_text(test, encoding="utf-8")
    (folder / "rig.toml").write_text(rec.rig_toml, encoding="utf-8")
