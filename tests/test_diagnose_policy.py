"""The table of thresholds: frozen, told, and each of them read where a diagnosis decides."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest

import rthyb_rt.diagnose
from rthyb_rt.diagnose.policy import POLICY, entries, of_size

SOURCES = [
    path.read_text()
    for path in Path(rthyb_rt.diagnose.__file__).parent.rglob("*.py")
    if path.name != "policy.py"
]


def test_the_table_cannot_be_written_to() -> None:
    with pytest.raises(FrozenInstanceError):
        # The type checker refuses it as well, which is not what is asked here.
        POLICY.same_evidence = 1.0  # type: ignore[misc]


def test_each_threshold_says_what_it_is() -> None:
    for name, entry in entries().items():
        assert entry.unit, name
        assert entry.basis, name
        assert entry.origin in ("physics", "numerics", "calibrated", "judgement"), name
        assert entry.meaning.endswith("."), name


def test_each_threshold_is_read() -> None:
    read = {name for text in SOURCES for name in re.findall(r"\bPOLICY\.(\w+)", text)}
    assert read == set(entries())


def test_thresholds_are_read_at_the_moment_that_they_decide() -> None:
    """A copy made when a module, a class or a default is made would not follow the table."""
    for tree in map(ast.parse, SOURCES):
        early = list(_early(tree))
        assert not [n for part in early for n in ast.walk(part) if _reads(n)]


def _early(tree: ast.AST) -> Iterator[ast.AST]:
    """Give what of a module runs when it is imported."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield from (d for d in (*node.args.defaults, *node.args.kw_defaults) if d is not None)
        elif isinstance(node, ast.ClassDef):
            yield from _early(node)
        elif not isinstance(node, (ast.Import, ast.ImportFrom)):
            yield node


def _reads(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and node.id == "POLICY"


def test_a_set_of_more_effects_has_the_last_value() -> None:
    values = (0.05, 0.015, 0.008)
    assert [of_size(values, size) for size in (1, 2, 3, 4)] == [0.05, 0.015, 0.008, 0.008]
