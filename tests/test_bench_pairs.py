"""Two checkouts timed in turn: the ratio of each pair, and what is no checkout."""

from __future__ import annotations

import importlib
import subprocess
from pathlib import Path
from typing import Any

import pytest

BENCH = Path(__file__).parent / "bench"


@pytest.fixture
def pairs(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("pairs")


def test_a_machine_that_becomes_slower_does_not_make_a_version_slower(pairs: Any) -> None:
    """It takes 3 % more each run; one version takes 8 % more than the other one with one law."""
    runs: list[str] = []

    def of(version: str, paper_ns: float) -> Any:
        def run() -> dict[str, float]:
            runs.append(version)
            slower = 1.03 ** len(runs)
            return {"paper": paper_ns * slower, "none": 25.0 * slower, version: 1.0}

        return run

    paper, none = pairs.compare(of("here", 37.8), of("there", 35.0), 9)
    assert "".join(name[0] for name in runs) == 9 * "htth"
    assert (paper.name, none.name) == ("paper", "none")
    assert paper.ratio == pytest.approx(1.08)
    assert none.ratio == pytest.approx(1.0)
    assert (none.least, none.most) == pytest.approx((1.0, 1.0))
    lines = pairs.table([paper, none]).splitlines()
    assert lines[1].startswith("paper")
    assert lines[1].endswith("over 1.05")
    assert lines[2].endswith("ok")


def test_versions_without_a_law_in_common_are_not_compared(pairs: Any) -> None:
    with pytest.raises(SystemExit, match="times none of the laws paper; compare with"):
        pairs.compare(lambda: {"paper": 1.0}, lambda: {"older": 1.0}, 1)


def test_a_folder_that_is_no_checkout_is_told(pairs: Any, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"no csrc/CMakeLists\.txt in .*folder of a checkout"):
        pairs.run_of(tmp_path)
    done = subprocess.run(
        ["make", "--no-print-directory", "bench-pairs", "READY="],
        cwd=BENCH.parents[1], capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert "Name the folder of the other checkout: make bench-pairs WITH=../older" in done.stdout


@pytest.mark.long
def test_the_same_checkout_twice_takes_the_same_time(pairs: Any) -> None:
    root = BENCH.parents[1]
    run = pairs.run_of(root)
    found = pairs.compare(run, run, 3)
    assert {one.name for one in found} == {"paper", "robust", "alpha-beta", "none"}
    for one in found:
        assert 0.7 < one.ratio < 1.4
        assert one.here_ns > 1.0
