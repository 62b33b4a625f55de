"""`make test` and the pass of CI with stand-ins that note their calls and fail in one part."""

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


TOOLS = ("cat", "cksum", "expr", "find", "grep", "make", "sed", "sh", "sort", "uname")


@pytest.mark.parametrize(
    ("user", "said"),
    [
        (0, "gfortran could not be installed: see above"),
        (1000, "Install gfortran: sudo apt-get install gfortran"),
    ],
)
def test_no_fortran_compiler_and_none_to_be_had_is_told(
    user: int, said: str, tmp_path: Path
) -> None:
    for tool in TOOLS:
        (tmp_path / tool).symlink_to(str(shutil.which(tool)))
    for name, does in {"id": f"echo {user}", "apt-get": "echo no network >&2; exit 100"}.items():
        script(tmp_path / name, does)
    done = subprocess.run(
        ["make", "--no-print-directory", "gfortran"],
        cwd=ROOT, env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert done.stdout.splitlines()[-1] == said
    assert ("no network" in done.stderr) == (user == 0)


@pytest.mark.parametrize(
    ("failing", "passes", "runs"),
    [("nothing", True, True), ("gfortran", True, False), ("test-fortran", False, True)],
)
def test_ci_passes_where_no_fortran_compiler_can_be_had_and_says_so(
    failing: str, passes: bool, runs: bool, tmp_path: Path
) -> None:
    (tmp_path / ".ci").mkdir()
    (tmp_path / "bin").mkdir()
    shutil.copy(ROOT / ".ci" / "run", tmp_path / ".ci" / "run")
    script(tmp_path / "bin" / "make", 'echo "$*" >> "$CALLS"; test "$2" != "$FAILING"')
    script(tmp_path / "bin" / "sleep", "true")
    calls = tmp_path / "calls"
    done = subprocess.run(
        [tmp_path / ".ci" / "run"],
        env={
            "PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin", "CALLS": str(calls), "FAILING": failing
        },
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    made = [line.split()[1] for line in calls.read_text().splitlines()]
    assert (done.returncode == 0) == passes, done.stdout
    assert made.count("test-fortran") == runs
    assert made.count("test-aarch64") == passes
    assert ("make test-fortran left out: there is no gfortran" in done.stdout) == (not runs)


def script(path: Path, does: str) -> None:
    """Write a program of the shell."""
    path.write_text(f"#!/bin/sh\n{does}\n")
    path.chmod(0o755)
