"""The recipes of the guide, carried out as they stand there: no more files than they say."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

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


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the program that was built, and not with this checkout's."""
    paths = [folder / "built", sysconfig.get_path("purelib"), folder / "tests"]
    code = f"import sys; sys.path[:0] = {[str(path) for path in paths]!r}\n{arguments[0]}"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-S", "-c", code, *arguments[1:]],
        cwd=folder,
        env=environment,
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
    assert "the first delay must be" in wrong.stderr


def test_the_c_of_the_guide_is_formatted_and_free_of_warnings(built: Path) -> None:
    source = built / "csrc" / "law_slope.c"
    flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
    done = subprocess.run(
        ["gcc", *flags, "-c", str(source), "-o", str(built / "slope.o")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
