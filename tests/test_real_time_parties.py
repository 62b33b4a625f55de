"""What `make bench` and `make validate-realtime` measure with still begins, counts and ends.

Their figures belong to a quiet machine; that they can be taken belongs to every test run.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from proof.parties import FLAGS, STATE, Parties, Plan

pytestmark = pytest.mark.alone


def test_four_seconds_of_the_whole_tick_beside_a_drive_is_recorded_and_its_allocations_are_counted(
    tmp_path: Path,
) -> None:
    run = Parties(Plan("short", 4.0, count_allocations=True), tmp_path).start().finish()
    assert run.facts["allocations_counted"]
    assert run.facts["allocations"] == 0
    assert run.facts["counts"]["executed"] > 0
    assert len(run.log) > 0  # the drive was there
    assert run.rows["state"].max() >= STATE["ZEROED"]
    assert (run.rows["flags"] & FLAGS["fresh"]).any()
