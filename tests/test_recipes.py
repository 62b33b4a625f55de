"""The recipes of the guide for parts built into the program: all of their files and no others.

Every kind that there is was added by its recipe. So a file of a recipe names all of them, and a
file that names all of them belongs to the recipe: a place where a kind is missing fails, and so
does a new place that every kind must be added to.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import get_args

import pytest

from rthyb_rt.config.rigfile import LinkKind
from rthyb_rt.core import settings
from rthyb_rt.diagnose import catalogue, effects

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "tools"))

PLACEHOLDER = "*"
CLASSES = "rthyb_rt/diagnose/effects/"
_IN_BRACKETS = re.compile(r"\([^()]*\)")
_PATH = re.compile(r"`([\w.-]+/[\w./*-]*)`")


def recipe(part: str) -> tuple[int, list[str]]:
    """Return how many files the page counts for a part, and which it lists."""
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| {part} \| (\d+) \| (.*?) \|", page, re.MULTILINE)
    steps = _IN_BRACKETS.sub("", row[1]).split(";")
    # What is edited comes before the colon; the text after it may name tools.
    return int(row[0]), [path for step in steps for path in _PATH.findall(step.partition(":")[0])]


def spellings(name: str) -> re.Pattern[str]:
    """Return a pattern of a name as in files, in C, and of a class in Python."""
    in_c = "RTHYB_" + re.sub(r"\W", "_", name).upper()
    a_class = "".join(part.title() for part in re.split(r"\W|_", name))
    return re.compile(rf"(?<!\w)(?:{re.escape(name)}|{in_c}|{a_class}(?:Element)?)(?!\w)")


@cache
def text(path: str) -> str:
    """Return a file, or all files of a folder; empty if it is not text."""
    if (ROOT / path).is_dir():
        return "\n".join(text(f"{path}{one.name}") for one in sorted((ROOT / path).glob("*.py")))
    try:
        return (ROOT / path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return ""


def listed(*folders: str) -> list[str]:
    """Return the sources and pages below some folders."""
    paths = subprocess.run(
        ["git", "ls-files", *folders], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    return [path for path in paths if path.endswith((".c", ".h", ".py", ".md"))]


def that_name_all(names: Sequence[str], *folders: str) -> set[str]:
    """Return the files below some folders in which every name occurs."""
    patterns = [spellings(name) for name in names]
    return {path for path in listed(*folders) if all(one.search(text(path)) for one in patterns)}


ELEMENTS = list(settings.ELEMENT_PARAMS)
ACTUATORS = list(get_args(settings.ServoKind))
LINKS = list(get_args(LinkKind))
EFFECTS = list(catalogue.entries())
PARTS = {
    "specimen element in C": ELEMENTS,
    "actuator": ACTUATORS,
    "link of another kind": LINKS,
    "effect in the catalogue of the diagnosis": EFFECTS,
}


@pytest.mark.parametrize("part", PARTS)
def test_a_recipe_counts_the_files_that_it_lists_and_each_names_every_kind(part: str) -> None:
    count, paths = recipe(part)
    assert len(set(paths)) == len(paths) == count
    for path in paths:
        if PLACEHOLDER in path:
            continue
        assert (ROOT / path).exists(), path
        # A kind's own test, in a file for it, is described by one that has been written.
        if re.search(rf"as (?:in )?`{re.escape(path)}`", text("docs/extending.md")):
            continue
        # Effects of the actuator are no classes of the folder; the catalogue has them as well.
        names = [one for one in PARTS[part] if path != CLASSES or one in effects.catalogue()]
        missing = [name for name in names if not spellings(name).search(text(path))]
        assert not missing, f"{path} lacks {', '.join(missing)}"


def edited(part: str, keep: Callable[[str], bool]) -> set[str]:
    """Return the files of a recipe that exist before it is followed, of a kind."""
    return {path for path in recipe(part)[1] if keep(path)}


def test_no_other_file_names_every_element() -> None:
    assert that_name_all(ELEMENTS, "csrc", "rthyb_rt", "docs", "tests") == edited(
        "specimen element in C", bool
    )


def test_no_other_file_of_the_program_names_every_actuator() -> None:
    assert that_name_all(ACTUATORS, "csrc", "rthyb_rt", "docs") == edited(
        "actuator", lambda path: not path.startswith("tests/")
    )


def test_no_other_file_names_every_effect() -> None:
    assert that_name_all(EFFECTS, "csrc", "rthyb_rt", "docs", "tests") == edited(
        "effect in the catalogue of the diagnosis",
        lambda path: path.endswith((".py", ".md")) and not path.startswith("tests/"),
    )


NUMERICAL = "numerical part in C"
MATRICES = {"dense": "DenseConfig", "sparse": "SparseConfig"}
"""Numerical parts that are matrices, with the class of their settings: they have every place."""
HANDED_ON = "rthyb_rt/config/", "rthyb_rt/lab/", "docs/", "tests/test_"
"""A part is known there by the keys of a test, by exception, and by its equation."""


def that_name_both_matrices(paths: Sequence[str]) -> set[str]:
    """Return the files in which two numerical parts have a place each."""
    patterns = [
        re.compile(
            rf"\bRTHYB_NUMERICAL_{kind.upper()}\b|\brthyb_{kind}_(?:ops|config)\b|\b{name}\b"
        )
        for kind, name in MATRICES.items()
    ]
    return {path for path in paths if all(one.search(text(path)) for one in patterns)}


def test_a_numerical_part_has_a_place_in_each_file_of_its_recipe_and_in_no_other() -> None:
    count, paths = recipe(NUMERICAL)
    assert len(set(paths)) == len(paths) == count
    here = [path for path in paths if PLACEHOLDER not in path]
    assert all((ROOT / path).is_file() for path in here)
    placed = {path for path in here if not path.startswith(HANDED_ON)}
    assert that_name_both_matrices(here) >= placed
    assert that_name_both_matrices(listed("csrc", "rthyb_rt")) == {
        p for p in placed if not p.startswith("tests/")
    }
    (own,) = (path for path in paths if PLACEHOLDER in path)
    for kind in MATRICES:
        assert (ROOT / own.replace(PLACEHOLDER, kind)).is_file()


def test_the_operations_of_a_numerical_part_are_those_of_its_header() -> None:
    page = (
        text("docs/extending.md").partition("### A numerical part in C\n")[2].partition("\n## ")[0]
    )
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|", page, re.MULTILINE)
    body = re.findall(
        r"typedef struct \{(.*?)\} rthyb_numerical_ops;", text("csrc/numerical.h"), re.DOTALL
    )
    assert [name for name, _ in rows] == re.findall(r"\(\*(\w+)\)", body[0])
    # The core asks for an operation that a kind need not have, before it calls it.
    asked = re.findall(r"ops->(\w+)(?: \?|\)\n)", text("csrc/numerical.c"))
    assert [name for name, called in rows if "optional" in called] == asked


def test_every_effect_has_its_picture() -> None:
    pytest.importorskip("matplotlib", reason="the pictures of the catalogue")
    import effect_pages

    _, paths = recipe("effect in the catalogue of the diagnosis")
    (picture,) = (path for path in paths if PLACEHOLDER in path)
    for name in EFFECTS:
        own = picture.replace(PLACEHOLDER, effect_pages.file_name(name))
        assert (ROOT / own).is_file(), own


def test_a_file_is_only_found_by_whole_names() -> None:
    """What the tests above rest on: a kind within the name of another is not that kind."""
    assert spellings("gap").search('"gap",')
    assert spellings("gap").search("RTHYB_GAP,")
    assert spellings("gap").search("class GapElement(Table):")
    assert not spellings("gap").search("gap_uneven RTHYB_GAP_FRICTION GapUnevenElement")
    assert spellings("servo-valve").search("case RTHYB_SERVO_VALVE:")
    assert not spellings("first-order").search("first order")
