"""Build tests/bench/bench_core.c of a checkout with the core's own flags, and run it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any


def build(checkout: Path, folder: Path) -> Path:
    """Build the driver of a checkout into a folder and return its path; raise SystemExit."""
    sources = checkout / "csrc"
    if not (sources / "CMakeLists.txt").exists():
        raise SystemExit(
            f"found no csrc/CMakeLists.txt in {checkout}; give the folder of a checkout of this "
            "program"
        )
    path = os.pathsep.join((os.environ.get("PATH", os.defpath), str(Path(sys.executable).parent)))
    for command in (
        ["cmake", "-S", sources, "-B", folder, "-DRTHYB_PYTHON=OFF", "-DRTHYB_BENCH=ON"],
        ["cmake", "--build", folder],
    ):
        done = subprocess.run(
            command, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise SystemExit(
                f"the C driver of {checkout} was not built:\n{done.stdout}{done.stderr}"
            )
    return folder / "bench_core"


def rows(driver: Path, *group: str) -> list[dict[str, Any]]:
    """Run a driver and return its rows; with the group "sample" it stops after these."""
    out = subprocess.run([driver, *group], capture_output=True, text=True, check=True)
    found: list[dict[str, Any]] = json.loads(out.stdout)["rows"]
    return found
