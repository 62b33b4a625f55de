"""A test that is kept: its recording, and the settings as they were used."""

from __future__ import annotations

from pathlib import Path

from rthyb_rt import config
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record import recording
from rthyb_rt.record.recording import Recording


def keep(folder: Path, setup: Setup, rec: Recording) -> None:
    """Write recording, test and rig into a folder that is there; the test names the rig beside it.

    Raises:
        RthybError: the recording cannot be written.
        OSError: a settings file cannot.
    """
    recording.write(folder / recording.FILE_NAME, rec)
    test = config.dump(setup.test.model_copy(update={"rig": "rig.toml"}))
    (folder / "test.toml").write_text(test, encoding="utf-8")
    (folder / "rig.toml").write_text(rec.rig_toml, encoding="utf-8")
