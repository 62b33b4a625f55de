"""The PC after its power failed in the middle of a test; in another it is told to shut down."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from realtime_bench import STATE, until
from vm.systemd import lab as labs
from vm.systemd.lab import RECORDER, RUNS, SERVICE, Lab, shown

from rthyb_rt import core
from rthyb_rt.record import recording
from rthyb_rt.record.recording import BLOCK_ROWS, FILE_NAME
from rthyb_rt.service.ring_recorder import read_index


def test_service_is_back_by_itself_in_idle() -> None:
    for unit in (RECORDER, SERVICE):
        until(lambda unit=unit: shown(unit, "ActiveState") == "active", unit)
    made = Lab("after-power")
    after = made.await_service()
    assert (after["state"], after["test"], after["run_id"]) == ("IDLE", None, "")
    assert labs.RIG.read_text(encoding="utf-8") == labs.rig_text()
    made.close()


def test_recording_of_the_test_that_lost_its_power_is_finished_and_readable() -> None:
    run_id, kept = labs.run_in_motion(), labs.kept()
    folder = RUNS / Path(kept["folder"]).name
    until((folder / FILE_NAME).is_file, "the recording")
    with h5py.File(folder / FILE_NAME, "r") as file:
        rows = file["samples"][:]
    rec = recording.read(folder / FILE_NAME)
    assert rec.meta["end_reason"] == "its process ended early; the ring is gone"
    np.testing.assert_array_equal(rows["tick"], np.arange(rows.size))
    assert rows["state"][-1] == STATE["RUNNING"]
    # On the disk every second, in blocks.
    assert rows.size >= kept["rows"] - core.FS_HZ - 2 * BLOCK_ROWS
    (entry,) = [entry for entry in read_index(RUNS) if entry["run_id"] == run_id]
    assert entry["rows"] == rows.size
    print(f"{kept['rows']} rows were seen before the cut, {rows.size} are there after it")


def test_shutdown_while_a_test_runs(request: pytest.FixtureRequest) -> None:
    """The next boot looks at what is left."""
    labs.end_boot_in_motion(request, "off", 600, dict)
