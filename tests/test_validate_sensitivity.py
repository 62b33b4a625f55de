"""Thresholds moved one at a time: what is tried, its reference, and the counts on the page."""

from __future__ import annotations

from typing import Any

import pytest
from validate.sensitivity import Tried, cell, decided, line, moved, tried

from rthyb_rt.diagnose.policy import POLICY, Policy, entries


@pytest.mark.parametrize(
    ("value", "factor", "then"),
    [
        (9.0, 0.7, 6.3),
        (-0.1, 1.4, -0.14),
        (4, 0.7, 3),
        (4, 1.4, 5),
        (1, 0.7, 1),
        ((0.0, 0.1), 1.4, (0.0, 0.14)),
    ],
)
def test_a_threshold_is_moved_by_its_part(value: Any, factor: float, then: Any) -> None:
    assert moved(value, factor) == pytest.approx(then)


def asked() -> dict[str, Any]:
    """An answer that one threshold decides, one changes in its numbers, and one does not change."""
    named = POLICY.same_evidence > 8.0
    assert POLICY.least_rows > 0
    return {
        "verdict": "explained" if named else "unknown",
        "effects": ["gap"] if named else [],
        "fit": POLICY.left_naive,
    }


def test_each_threshold_that_is_read_is_moved_and_no_other() -> None:
    plain, found = tried(asked, set(entries()))
    assert plain == {"verdict": "explained", "effects": ["gap"], "fit": 0.35}
    assert set(found) == {"same_evidence", "least_rows", "left_naive"}
    assert found["same_evidence"]["0.7"]["verdict"] == "unknown"
    assert found["same_evidence"]["1.4"] == plain
    assert found["left_naive"]["1.4"]["fit"] == pytest.approx(0.49)
    assert found["least_rows"] == {"0.7": plain, "1.4": plain}


def test_the_table_is_as_before() -> None:
    tried(asked, set(entries()))
    assert type(POLICY) is Policy
    assert Policy() == POLICY
    assert Tried.end is None


def test_what_cannot_be_answered_is_said_so() -> None:
    def fails() -> dict[str, Any]:
        if POLICY.active_part > 0.3:
            raise ValueError("too large")
        return {"verdict": "none"}

    plain, found = tried(fails, {"active_part"})
    assert plain == {"verdict": "none"}
    assert found["active_part"]["1.4"]["verdict"] == "failed"


def test_an_answer_is_what_it_names() -> None:
    one = {"verdict": "ambiguous", "effects": ["a"], "ambiguous_with": [["a", "b"], ["c"]]}
    other = {"verdict": "ambiguous", "effects": ["a"], "ambiguous_with": [["c"], ["b", "a"]]}
    assert decided({**one, "fit": 1.0}) == decided(other)
    assert decided({**one, "verdict": "explained"}) != decided(one)


def row(changed: bool, right: bool, same: bool) -> dict[str, Any]:
    return {"changed": changed, "right": right, "same": same, "verdict": "explained"}


def test_answers_that_change_are_counted_with_what_they_cost() -> None:
    assert cell([(True, row(False, True, True))]) == "0"
    assert cell([(True, row(True, False, False)), (False, row(True, True, False))]) == (
        "2 (1 lost, 1 corrected)"
    )
    assert cell([(True, row(False, True, False)), (True, row(True, True, False))]) == "1; 1"


def test_the_page_says_how_many_cases_read_a_threshold() -> None:
    name = "same_evidence"
    results = [
        {"right": True, "entries": {name: {"0.7": row(True, False, False), "1.4": row(0, 1, 1)}}},
        {"right": True, "entries": {}},
    ]
    text = line(name, entries()[name], results)
    assert text.startswith("| `same_evidence` | 9 | chi-squared | physics |")
    assert text.endswith("| 1 | 1 (1 lost) | 0 |")
    text = line("left_naive", entries()["left_naive"], results)
    assert text.endswith("| 0 | – | – |")
