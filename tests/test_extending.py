"""The recipes of the guide, carried out as they stand there: no more files than they say."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rthyb_rt.benchmark import campaigns
from rthyb_rt.campaign import whole_campaign
from rthyb_rt.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "extending.md"
_BLOCK = re.compile(r"^```(?:c|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PATH = re.compile(r"(?:csrc|tests)/\w+\.\w+")

pytestmark = pytest.mark.long


def recipe() -> dict[str, str]:
    """The files that the page has its reader write, by the path in their first line."""
    files = {}
    for match in _BLOCK.finditer(PAGE.read_text(encoding="utf-8")):
        path = _PATH.search(match[1].splitlines()[0])
        assert path is not None
        files[path[0]] = match[1]
    return files


def of_built(folder: Path, code: str, *arguments: str) -> dict[str, Any]:
    """Return how Python runs with the program that was built, and not with this checkout's."""
    paths = [folder / "built", sysconfig.get_path("purelib"), folder / "tests"]
    code = f"import sys; sys.path[:0] = {[str(path) for path in paths]!r}\n{code}"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-S", "-c", code, *arguments]
    return {"args": command, "cwd": folder, "env": environment}


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the program that was built, to its end."""
    return subprocess.run(
        **of_built(folder, *arguments),
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the program with the recipe's files in it, built."""
    folder = tmp_path_factory.mktemp("extended")
    for name in ("csrc", "rthyb_rt", "hw", "examples", "systemd", "tests"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.so")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    for path, text in recipe().items():
        assert not (folder / path).exists(), f"{path} is there already"
        (folder / path).write_text(text, encoding="utf-8")
    command = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run(
        [sys.executable, *command, "--target", str(folder / "built"), str(folder)],
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_a_control_law_is_two_files() -> None:
    assert list(recipe()) == ["csrc/law_slope.c", "tests/test_law_slope.py"]


def test_the_law_of_the_guide_passes_its_scenarios_and_those_of_every_law(built: Path) -> None:
    run_pytest = (
        "import pytest, rthyb_rt; assert 'built' in rthyb_rt.__file__, rthyb_rt.__file__\n"
        "sys.exit(pytest.main(sys.argv[1:]))"
    )
    own = ["tests/test_law_slope.py", "tests/test_laws.py"]
    done = python(built, run_pytest, "-q", "-p", "no:cacheprovider", "-k", "slope or law", *own)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    counted = re.search(r"(\d+) passed", done.stdout)
    assert "failed" not in done.stdout
    assert counted is None or int(counted[1]) > 20


def test_the_program_takes_it_by_its_name(built: Path) -> None:
    call = "from rthyb_rt import cli; sys.exit(cli.main(sys.argv[1:]))"
    shown = python(built, call, "compare-laws", "--law", "slope", "--law", "ats")
    assert shown.returncode == 0, shown.stderr
    assert {line.split()[0] for line in shown.stdout.splitlines()[2:]} == {"ats", "slope"}
    of_all = python(
        built,
        call,
        *["benchmark", "rths", "--rate", "1024", "--case", "1", "--plants", "0"],
        "--json",
    )
    assert "slope" in {run["entrant"] for run in json.loads(of_all.stdout)["runs"]}
    wrong = python(
        built, call, "run", "--set", "controller.type=slope", "--set", "controller.slope.delay_s=2"
    )
    assert wrong.returncode == 3
    assert "the initial delay must be" in wrong.stderr


CAMPAIGN = """
schema = "rthyb-campaign/1"
[campaign]
name = "with-a-law-of-ours"
[over]
"controller.type" = ["slope", "ats"]
"test.duration_s" = [2, 3]
"""


def test_a_campaign_has_it_in_its_processes_and_in_the_workers_of_a_cluster(
    built: Path, tmp_path: Path
) -> None:
    """Two fresh processes of this machine, then two of a Dask cluster: the same rows."""
    pytest.importorskip("distributed")
    (tmp_path / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    call = "from rthyb_rt import cli; sys.exit(cli.main(sys.argv[1:]))"
    command = ("campaign", str(tmp_path / "campaign.toml"), "--json", "--out")
    alone = python(built, call, *command, str(tmp_path / "alone"), "--jobs", "2")
    assert alone.returncode == 0, alone.stderr
    rows = json.loads(alone.stdout)["rows"]
    assert [row["controller.type"] for row in rows] == ["slope", "slope", "ats", "ats"]
    assert {row["ending"] for row in rows} == {"completed"}
    with cluster_of(built) as address:
        there = python(built, call, *command, str(tmp_path / "there"), "--cluster", address)
        assert there.returncode == 0, there.stderr
        assert json.loads(there.stdout)["rows"] == rows


def test_workers_that_have_it_not_are_refused_before_anything_runs(
    built: Path, tmp_path: Path
) -> None:
    """And the other way round: a cluster with a user-defined law, a PC without."""
    pytest.importorskip("distributed")
    (tmp_path / "campaign.toml").write_text(CAMPAIGN.replace('"slope", ', ""), encoding="utf-8")
    plan = campaigns.read(tmp_path / "campaign.toml")
    with (
        cluster_of(built) as address,
        pytest.raises(InputError, match="not every worker has the same rthyb_rt"),
    ):
        whole_campaign.conduct(plan, tmp_path / "out", cluster=address)
    assert (tmp_path / "out" / "rows.jsonl").read_text(encoding="utf-8") == ""


@contextmanager
def cluster_of(built: Path) -> Iterator[str]:
    """Give the address of two Dask workers, processes that have the program that was built."""
    code = (
        "import distributed, rthyb_rt\n"
        "if __name__ == '__main__':\n"
        "    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True,\n"
        "                                  dashboard_address=None) as cluster:\n"
        "        print(cluster.scheduler_address, flush=True)\n"
        "        sys.stdin.read()\n"
    )
    with subprocess.Popen(
        **of_built(built, code), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.stdin.close()
            process.wait(60)


def test_the_c_of_the_guide_is_formatted_and_free_of_warnings(built: Path) -> None:
    source = built / "csrc" / "law_slope.c"
    flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
    done = subprocess.run(
        ["gcc", *flags, "-c", str(source), "-o", str(built / "slope.o")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
