"""What a search comes upon only after it has ranked its sets, in cases of the first generator."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from prove import plans

from rthyb_rt.diagnose import engine, reading

SEED = 621300805


def answered(kind: str, index: int, folder: Path):
    """Return the answer to one of ten cases of a kind, and what was put in."""
    wish = plans.schedule(SEED, 10, [kind])[index]
    name, _ = plans.build(SEED, index, wish, folder)
    truth = json.loads((folder / name / "answer.json").read_text())
    model = reading.read_model(folder / name / "baseline.toml")
    d = engine.diagnose(reading.read_case(folder / name / "recording.csv", model))
    return d, sorted(e["name"] for e in truth["effects"])


@pytest.mark.long
def test_friction_and_a_late_cell_are_found_although_only_larger_sets_had_both(
    tmp_path: Path,
) -> None:
    """The pair is refined to see what a third effect adds to it, and is then better than any."""
    d, names = answered("cancel", 4, tmp_path)
    assert (d.verdict, sorted(d.effects)) == ("explained", names)
    assert names == ["coulomb", "time_skew"]


@pytest.mark.long
def test_a_weak_dashpot_that_begins_is_found_although_only_noise_is_left(tmp_path: Path) -> None:
    """Fitted throughout the test, it differs before and after, and a late cell fits as well."""
    d, names = answered("onset", 4, tmp_path)
    assert names == ["viscous"]
    assert d.effects == names or names in [sorted(s) for s in d.ambiguous_with]


@pytest.mark.long
def test_a_local_bump_of_a_spring_is_not_made_of_three_others(tmp_path: Path) -> None:
    d, _ = answered("unknown", 4, tmp_path)
    assert d.verdict == "unknown"
