"""The rooms of the Python package: who may know whom."""

from __future__ import annotations

import ast
import graphlib
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

import rthyb_rt

PACKAGE = Path(rthyb_rt.__file__).parent
ROOMS = tuple(sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py")))
IMPORTS = (ast.ImportFrom, ast.Import)
SHARED = tuple(sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__"))


def _outside_typing(tree: ast.Module) -> list[ast.ImportFrom | ast.Import]:
    """Return the imports that run: those for the type checker alone tie nothing together."""
    typing = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    return [n for n in ast.walk(tree) if isinstance(n, IMPORTS) and n not in typing]


def _known_to(path: Path) -> set[str]:
    """Return the dotted names of the package that a module imports."""
    found: set[str] = set()
    for node in _outside_typing(ast.parse(path.read_text(encoding="utf-8"))):
        assert isinstance(node, ast.Import) or not node.level, f"{path}: relative import"
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("rthyb_rt.")}


def _room(dotted: str) -> str:
    return dotted.split(".")[1]


def _rooms_known() -> dict[str, set[str]]:
    known: dict[str, set[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).parts
        if len(parts) > 1:
            others = {_room(name) for name in _known_to(path)} - {parts[0]}
            known.setdefault(parts[0], set()).update(others & set(ROOMS))
    return known


def test_no_two_rooms_need_each_other() -> None:
    known = _rooms_known()
    assert {"api", "cli", "comparing", "core", "diagnose", "lab"} <= set(known)
    try:
        tuple(graphlib.TopologicalSorter(known).static_order())
    except graphlib.CycleError as error:
        pytest.fail(f"these rooms need each other: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize("name", SHARED)
def test_what_all_rooms_share_knows_no_room(name: str) -> None:
    assert not {_room(found) for found in _known_to(PACKAGE / f"{name}.py")} & set(ROOMS)


def test_the_core_knows_no_other_room() -> None:
    assert _rooms_known()["core"] == set()


def _touches_cffi(path: Path) -> bool:
    """Return whether a module imports cffi or the compiled core, even for the type checker."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, IMPORTS):
            found.update(*(alias.name.split(".") for alias in node.names))
        if isinstance(node, ast.ImportFrom):
            found.update((node.module or "").split("."))
    return not found.isdisjoint({"_core", "ffi", "cffi", "_cffi_backend"})


def test_only_the_core_touches_cffi() -> None:
    touching = {path.parent for path in PACKAGE.rglob("*.py") if _touches_cffi(path)}
    assert touching == {PACKAGE / "core"}


def test_the_core_is_used_without_the_library_of_the_recordings() -> None:
    code = (
        "import sys, rthyb_rt.core, rthyb_rt.core.loop, rthyb_rt.core.ticker; "
        "sys.exit('h5py' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def _repeated(names: Iterable[str]) -> dict[str, int]:
    return {name: n for name, n in sorted(Counter(names).items()) if n > 1}


def test_a_module_name_stands_for_one_thing() -> None:
    names = (path.stem for path in PACKAGE.rglob("*.py") if not path.stem.startswith("__"))
    assert not _repeated(names)


def test_a_class_name_stands_for_one_thing() -> None:
    names = (
        node.name
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert not _repeated(names)


HEADERS = sorted((PACKAGE.parent / "csrc").glob("rthyb_*.h"))
MOST_LINES = 250


@pytest.mark.skipif(not HEADERS, reason="the sources of the core are not beside the package")
def test_every_part_of_the_contract_is_short_and_stands_alone(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    for header in HEADERS:
        text = header.read_text(encoding="utf-8")
        assert text.count("\n") < MOST_LINES, header.name
        if compiler:
            source = tmp_path / "alone.c"
            source.write_text(f'#include "{header.name}"\n')
            command = [compiler, "-std=c11", "-fsyntax-only", f"-I{header.parent}", str(source)]
            subprocess.run(command, check=True)
