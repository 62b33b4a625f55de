"""`make test` with a stand-in for Python that notes its calls and fails in one part."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PYTHON = """#!/bin/sh
echo "$*" >> "$CALLS"
case "$*" in *"$FAILING"*) exit 1;; esac
"""


@pytest.mark.parametrize(
    ("failing", "named", "runs"),
    [
        ("nothing of this", "", 3),
        ("-m not alone", "Failed: scenarios in virtual time", 4),
        ("-m alone", "Failed: scenarios on the clock", 4),
        ("tests/test_speed.py", "Failed: computing times", 4),
        ("-m pytest -m", "", 5),
        ("pytest", "Failed: scenarios in virtual time, scenarios on the clock, computing times", 6),
    ],
)
def test_a_failure_in_one_part_does_not_hide_the_others(
    failing: str, named: str, runs: int, tmp_path: Path
) -> None:
    """What has failed runs once more; if it then passes, as in the fifth case, nothing failed."""
    make = shutil.which("make")
    assert make is not None
    python = tmp_path / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    calls = tmp_path / "calls"
    done = subprocess.run(
        [make, "--no-print-directory", "test", f"BIN={tmp_path}", "TEST_READY="],
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin", "CALLS": str(calls), "FAILING": failing},
        capture_output=True,
        text=True,
        check=False,
    )
    made = calls.read_text().splitlines()
    assert sum("--last-failed" not in call for call in made) == 3
    assert len(made) == runs
    assert (done.returncode != 0) == bool(named)
    said = [line for line in done.stdout.splitlines() if line.startswith("Failed:")]
    assert said == ([named] if named else [])
