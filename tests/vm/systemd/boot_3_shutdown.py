"""The PC after it was shut down in the middle of a test."""

from __future__ import annotations

import pytest
import stalls
from realtime_bench import STATE, require_calm, until
from vm.systemd import lab as labs
from vm.systemd.lab import RUNS, SERVICE, shown

from rthyb_rt.lab import realtime
from rthyb_rt.record import recording
from rthyb_rt.service.ring_recorder import read_index


def test_shutdown_has_brought_the_specimen_to_rest_and_its_recording_is_whole() -> None:
    run_id = labs.run_in_motion()
    (entry,) = [entry for entry in read_index(RUNS) if entry["run_id"] == run_id]
    rec = recording.open_run(RUNS / entry["folder"])
    assert entry["missing_rows"] == []
    assert realtime.replay(rec).identical
    try:
        require_calm(rec)
    except stalls.Stalled as stalled:
        lates = stalls.read(stalls.noted(boot="2"))
        seen = stalls.proof(lates, stalled.cause, stalled.from_s, stalled.to_s)
        if not seen:
            pytest.fail(f"{stalled.cause}, and the machine did not stall")
        raise stalls.NotRun(f"{stalled.cause} in the shutdown: {seen}") from stalled
    assert rec.meta["end_reason"] == "stopped by the operator"
    assert (rec.samples["state"][-1], rec.samples["x_num_m"][-1]) == (STATE["IDLE"], 0.0)


def test_service_comes_up_in_idle_without_its_drive() -> None:
    until(lambda: shown(SERVICE, "ActiveState") == "active", SERVICE)
    labs.assert_idle_unless_stalled()
