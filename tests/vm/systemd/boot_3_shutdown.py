"""The PC after it was shut down in the middle of a test."""

from __future__ import annotations

from realtime_bench import STALLED, STATE, until
from vm.systemd import lab as labs
from vm.systemd.lab import RUNS, SERVICE, shown

from rthyb_rt import realtime, recording
from rthyb_rt.service.recorder import read_index


def test_shutdown_has_brought_the_specimen_to_rest_and_its_recording_is_whole() -> None:
    run_id = labs.kept()["run_id"]
    (entry,) = [entry for entry in read_index(RUNS) if entry["run_id"] == run_id]
    rec = recording.open_run(RUNS / entry["folder"])
    cause = rec.meta["real_time"]["cause"]
    assert entry["missing_rows"] == []
    assert realtime.replay(rec).identical
    if cause not in STALLED:
        assert rec.meta["end_reason"] == "stopped by the operator"
        assert (rec.samples["state"][-1], rec.samples["x_num_m"][-1]) == (STATE["IDLE"], 0.0)


def test_service_comes_up_in_idle_without_its_drive() -> None:
    until(lambda: shown(SERVICE, "ActiveState") == "active", SERVICE)
    assert shown(SERVICE, "StatusText") == "IDLE"
