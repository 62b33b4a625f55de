"""The table of thresholds: frozen, told, and each of them read where a diagnosis decides."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest
from validate import sensitivity

import rthyb_rt.diagnose
from rthyb_rt.diagnose.policy import POLICY, entries, of_size

FOLDER = Path(rthyb_rt.diagnose.__file__).parent
FILES = {
    path.relative_to(FOLDER).as_posix(): path.read_text()
    for path in FOLDER.rglob("*.py")
    if path.name != "policy.py"
}
SOURCES = list(FILES.values())

INLINE = {
    "actuation.py late_zero": "rows that a mean is taken of",
    "actuation.py least": "where a fit ends",
    "findings.py force_found": "length of a list",
    "estimate.py _legs": "rows that a line is taken of",
    "gaps.py filled": "rows that a cubic takes",
    "spectral.py of": "rows to either side of a transform",
    "noise_level.py step_of": "half way between one step and two",
    "noise_level.py white_noise": "rows that a median is taken of",
    "freebody.py _least": "where a fit ends",
    "lateness.py settled": "where a fit ends",
    "residual_laws.py force_unit": "the unit in which an axis is labelled",
    "mapping.py _missing": "length of a list",
    "moving.py sensor_colour": "lines that a level is taken of",
    "noise.py __init__": "rows that a spectrum is taken of",
    "noise.py _faded": "half a row: whether there is one",
    "noise.py colour_of": "lines that a level is taken of",
    "noise.py power": "rows that a spectrum is taken of",
    "noise.py red_of": "lines that a level is taken of",
    "predict.py _descended": "where a fit ends",
    "predict.py continues": "half a row: which one it is",
    "predict.py moved_by": "where an iteration ends",
    "predict.py nrmse": "rows that an error is taken of",
    "reading.py _filled_in": "rows that a cubic takes",
    "reading.py _means_nothing": "an exponent",
    "refinement.py inflation": "rows that a correlation is taken of",
    "refinement.py refine": "where a fit ends",
    "channel_sizes.py _far": "a base of logarithms",
    "table.py _is_units": "length of a unit",
    "table.py _parted": "length of a list",
    "why.py _percent": "digits of a number",
    "why.py count": "digits of a number",
    "words.py _plain": "digits of a number",
    "words.py _when": "length of a list",
    "words.py _explained": "digits of a number",
}
"""Comparisons with a number of their own outside the table, by function, and why none of them
decides what is said."""


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
    read = {name for text in SOURCES for name in re.findall(r"\b(?:POLICY|policy)\.(\w+)", text)}
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


def test_no_threshold_stands_outside_the_table() -> None:
    """Numbers in comparisons but for small counts, guards of a division, and what is listed.

    What makes a law stands with the law: effects/.
    """
    found = {
        f"{name} {function}"
        for name, text in FILES.items()
        if not name.startswith("effects/")
        for function in _comparing(ast.parse(text))
    }
    assert found == set(INLINE)


def _comparing(tree: ast.AST, function: str = "") -> Iterator[str]:
    """Give the function of each comparison with a number of its own."""
    for node in ast.iter_child_nodes(tree):
        inner = node.name if isinstance(node, ast.FunctionDef) else function
        if isinstance(node, ast.Compare) and any(map(_telling, ast.walk(node))):
            yield function
        yield from _comparing(node, inner)


def _telling(node: ast.AST) -> bool:
    if not isinstance(node, ast.Constant) or not isinstance(node.value, (int, float)):
        return False
    return node.value not in (0, 1, 2, 3) and 1e-9 < node.value < 1e300


def test_the_page_of_thresholds_has_each_with_its_value() -> None:
    """A reader of the page decides by it; `sensitivity.py --rows` writes what has changed."""
    page = (Path(__file__).resolve().parents[1] / "docs" / "diagnosis-policy.md").read_text()
    told = dict(re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", page, re.M))
    assert told == {name: sensitivity.value_text(getattr(POLICY, name)) for name in entries()}


def test_rows_of_the_page_keep_what_was_measured_of_a_threshold_that_is_as_it_was() -> None:
    page = (
        "before\n| `same_evidence` | 9 | ? | ? | ? | ? | 3 | 1 (1 lost) | 0 |\n"
        "| `twin_evidence` | 77 | ? | ? | ? | ? | 3 | 1 (1 lost) | 0 |\n| `gone` | 1 | ? | ? | ? "
        "| ? | 3 | 0 | 0 |\nafter\n"
    )
    rows = sensitivity.with_rows(page).splitlines()
    assert (rows[0], rows[-1], len(rows)) == ("before", "after", len(entries()) + 2)
    by_name = {row.split("`")[1]: row for row in rows[1:-1]}
    assert by_name["same_evidence"].endswith("| 3 | 1 (1 lost) | 0 |")
    # What was measured of another value says nothing of this one.
    assert by_name["twin_evidence"].endswith("| not measured | not measured | not measured |")
    assert sensitivity.with_rows("\n".join(rows) + "\n").splitlines() == rows
