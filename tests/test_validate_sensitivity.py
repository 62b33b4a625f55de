"""Thresholds moved one at a time: what is tried, its reference, and the counts on the page."""

from __future__ import annotations

from typing import Any

import pytest
from validate.sensitivity import (
    UNMEASURED,
    Tried,
    cell,
    decided,
    line,
    moved,
    row_of,
    tried,
    unmeasured,
    with_measured,
)

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


PAGE = "\n".join(
    [
        "# Thresholds",
        "",
        "| threshold | value | unit | origin | decides | basis | used in | × 0.7 | × 1.4 |",
        "|---|---|---|---|---|---|---|---|---|",
        *(row_of(n, e, ["5", "0", "1"]) for n, e in entries().items()),
        "",
        "The cases.",
        "",
    ]
)


def test_what_a_page_has_not_measured_is_measured_later_and_the_rest_stays() -> None:
    name, other = "same_evidence", "left_naive"
    new = [row_of(n, entries()[n], UNMEASURED) for n in (name, other)]
    old = [row_of(n, entries()[n], ["5", "0", "1"]) for n in (name, other)]
    page = PAGE.replace(old[0], new[0]).replace(old[1], new[1])
    assert unmeasured(PAGE) == set()
    assert unmeasured(page) == {name, other}
    assert unmeasured("") == set(entries())
    # Of another value nothing is known.
    text = f"| {POLICY.same_evidence:g} |"
    assert unmeasured(PAGE.replace(old[0], old[0].replace(text, "| 1e9 |"))) == {name}
    move = {"changed": True, "right": False, "same": False, "verdict": "unknown"}
    results = [
        {
            "right": True, "names": [name, other],
            "entries": {name: {"0.7": move, "1.4": {**move, "changed": False, "same": True}}},
        }
    ]  # fmt: skip
    later = with_measured(page, results, 7, "abcd")
    assert unmeasured(later) == set()
    assert row_of(name, entries()[name], ["1", "1 (1 lost)", "0"]) in later
    assert row_of(other, entries()[other], ["0", "–", "–"]) in later
    kept = [row for row in PAGE.splitlines() if row.startswith("| `") and row not in old]
    assert all(row in later for row in kept)
    assert "The cases." in later
    assert "seed 7): 2 diagnoses." in later.replace("\n", " ")
