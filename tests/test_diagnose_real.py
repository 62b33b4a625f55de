"""What the diagnosis says of recordings that other laboratories made."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from prove import scoring

RECORDINGS = Path(__file__).parent / "data" / "diagnosis"
QUICK = "steel_coupon_1"


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(p.parent.name, marks=() if p.parent.name == QUICK else pytest.mark.long)
        for p in sorted(RECORDINGS.glob("*/answer.json"))
    ],
)
def test_known_physics_of_a_real_recording_is_named_and_foretells_the_rest(
    name: str, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(RECORDINGS / name, tmp_path / name))
    known = json.loads((folder / "answer.json").read_text())
    said, prediction = scoring.command_line([str(Path(sys.executable).with_name("rthyb"))])(folder)

    assert said["verdict"] == ("explained" if known["effects"] else "none"), said
    # What is known of it comes first; that it is all, nobody has measured.
    assert [c["name"] for c in said["candidates"]][: len(known["effects"])] == known["effects"]
    assert bool(said["effects"]) == bool(known["effects"])

    # A loop hardens by a part of its own spring, never by more, nor by less than nothing.
    for candidate in said["candidates"]:
        assert 0.0 <= candidate["params"].get("alpha", 0.0) < 1.0

    # As the figure in the answer was taken: rows from, and channel, are said there.
    channel = "x" if "channel x" in known["metric"] else "f"
    first = int(known["metric"].split("rows from ")[1].split()[0])
    truth = scoring.read_csv(folder / "heldout.csv")[f"{channel}_meas"][first:]
    miss = prediction[channel][first:] - truth
    error = 100.0 * np.sqrt(np.nanmean(miss**2)) / np.nanstd(truth)
    assert error <= known["nrmse_heldout_known"]


SHARED = Path(__file__).resolve().parents[2] / "shared" / "diagnosis" / "real-open"


@pytest.mark.long
@pytest.mark.skipif(not SHARED.is_dir(), reason="the shared recordings are not on this machine")
@pytest.mark.parametrize(
    "name", sorted(p.parent.name for p in SHARED.glob("*/answer.json")) or ["none"]
)
def test_shared_recordings_are_named_and_foretold_as_well_as_by_their_known_physics(
    name: str, tmp_path: Path
) -> None:
    folder = SHARED / name
    known = json.loads((folder / "answer.json").read_text())
    out = tmp_path / "pred.csv"
    run = subprocess.run(
        [
            str(Path(sys.executable).with_name("rthyb")), "diagnose", folder / "recording.csv",
            "--model", folder / "baseline.toml", "--json",
            "--predict", folder / "heldout_input.csv", "--out", out,
        ],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    said = json.loads(run.stdout)

    assert (said["verdict"] == "none") == (not known["effects"])
    assert said["verdict"] != "unknown"
    assert set(said["effects"]) <= {*known["effects"], *known["also_acceptable"]}
    channel = "x" if "channel x" in known["metric"] else "f"
    first = int(known["metric"].split("rows from ")[1].split()[0])
    truth = scoring.read_csv(folder / "heldout.csv")[f"{channel}_meas"][first:]
    miss = scoring.read_csv(out)[channel][first:] - truth
    error = 100.0 * np.sqrt(np.nanmean(miss**2)) / np.nanstd(truth)
    print(f"{name}: {error:.2f}, {error / known['nrmse_heldout_known']:.2f} of the known physics")
    assert error <= known["pass_heldout_nrmse"]


def test_a_steel_coupon_recorded_from_mid_test_yields_behind_no_spring_that_pushes(
    tmp_path: Path,
) -> None:
    """With a gap in a spring of minus 44 times the stated one, a smooth loop seemed to fit better.

    The second test, whose history is not recorded, is foretold within the limit of the whole one.
    """
    folder = Path(shutil.copytree(RECORDINGS / QUICK, tmp_path / QUICK))
    head, *rows = (folder / "recording.csv").read_text().splitlines()
    late = [head, *rows[int(0.4 * len(rows)) :]]
    (folder / "recording.csv").write_text("\n".join(late) + "\n")
    known = json.loads((folder / "answer.json").read_text())
    said, prediction = scoring.command_line([str(Path(sys.executable).with_name("rthyb"))])(folder)
    assert (said["verdict"], said["effects"]) == ("explained", ["hysteresis"])
    truth = scoring.read_csv(folder / "heldout.csv")["f_meas"]
    miss = prediction["f"] - truth
    error = 100.0 * np.sqrt(np.nanmean(miss**2)) / np.nanstd(truth)
    assert error <= known.get("pass_heldout_nrmse", 1.2 * known["nrmse_heldout_known"])
