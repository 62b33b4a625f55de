"""The paper's studies: every accepted band holds, and the tables say what the rows say."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import util

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rthyb_rt import core, studies
from rthyb_rt.errors import InputError
from rthyb_rt.studies import estimator, inelastic, stability, table_tests
from rthyb_rt.studies.results import (
    Study,
    StudyRow,
    band_text,
    grouped,
    tables,
    value_text,
)


def section(paper: list[Study], key: str) -> Study:
    return next(study for study in paper if study.key == key)


def value(study: Study, quantity: str, case: str = "", group: str = "") -> float:
    (row,) = (
        row
        for row in study.rows
        if row.quantity == quantity and row.case == case and group in row.group
    )
    return row.value


# --- bands ------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("key", studies.SECTIONS)
def test_every_accepted_band_is_met(paper: list[Study], key: str) -> None:
    study = section(paper, key)
    assert [(row.group, row.case, row.quantity, row.value) for row in study.missed] == []


def test_no_band_got_lost(paper: list[Study]) -> None:
    wanted = {"2.1": 10, "4.1": 10, "4.2": 21, "5": 28}
    if inelastic.tcu068() is None:
        wanted["4.2"] = 8
    assert {study.key: len(study.banded) for study in paper} == wanted


def test_all_values_are_numbers(paper: list[Study]) -> None:
    strange = [row for study in paper for row in study.rows if not math.isfinite(row.value)]
    if inelastic.tcu068() is not None:
        assert strange == []


def test_every_study_tells_what_the_paper_leaves_open(paper: list[Study]) -> None:
    for study in paper:
        assert study.ambiguities
        assert study.panels
        assert len({panel.key for panel in study.panels}) == len(study.panels)


# --- what the paper claims, by other means than the bands ----------------------------------------


def test_grid_decision_agrees_with_numpy_roots_at_random_weightings() -> None:
    rng = np.random.default_rng(5)
    for w1, w2 in rng.uniform(-8.0, 8.0, (200, 2)):
        largest = np.abs(np.roots([w1, w2, 1.0])).max()
        assert_allclose(stability.largest_pole(np.array(w1), np.array(w2)), largest, rtol=1e-9)
        assert core.plc_is_stable(w1, w2) == (largest < 1.0)


def test_linear_sweep_runs_from_a_tenth_to_ten_hertz() -> None:
    from scipy.signal import chirp

    x = estimator.sweep()
    t = np.arange(x.size) / core.FS_HZ
    expected = 1e-3 * chirp(t, 0.1, 120.0, 10.0, phi=-90)
    assert_allclose(x, expected, atol=1e-12)


def test_logarithmic_sweep_is_the_one_of_scipy() -> None:
    from scipy.signal import chirp

    x = estimator.sweep(logarithmic=True)
    t = np.arange(x.size) / core.FS_HZ
    expected = 1e-3 * chirp(t, 0.1, 120.0, 10.0, method="logarithmic", phi=-90)
    assert_allclose(x, expected, atol=1e-9)


def test_free_decay_loses_what_forward_euler_takes() -> None:
    omega = math.sqrt(inelastic.K_N_PER_M / inelastic.MASS_KG)
    # Damping ratio of x'' + 2 zeta w x' + w^2 x stepped with forward Euler: zeta - w h / 2.
    zeta = inelastic.DAMPING_N_S_PER_M / (2 * inelastic.MASS_KG * omega)
    lost = omega / core.FS_HZ / 2
    assert_allclose(inelastic.free_decay_ratio("forward-euler"), zeta - lost, atol=2e-5)
    assert_allclose(inelastic.free_decay_ratio("central-difference"), zeta, atol=2e-5)


def test_longest_stable_delay_without_compensation_follows_horiuchi() -> None:
    # The delay acts as damping -k tau: stable while tau < c / k.
    samples = inelastic.DAMPING_N_S_PER_M / inelastic.K_N_PER_M * core.FS_HZ
    found = inelastic.largest_stable_delay("central-difference", False, range(8))
    assert found == math.floor(samples)


@pytest.mark.skipif(inelastic.tcu068() is None, reason="TCU068 is in the package pyslammer")
def test_force_compensation_holds_the_response_while_the_estimate_grows(paper: list[Study]) -> None:
    study = section(paper, "4.2")
    (difference,) = (panel for panel in study.panels if panel.key == "difference-4-2")
    plc, both = (np.abs(curve.y[: round(12 * core.FS_HZ)]).max() for curve in difference.curves)
    assert both < 0.2 * plc


def test_controllers_stand_side_by_side_in_every_section_that_tests_them(
    paper: list[Study],
) -> None:
    for key in ("4.1", "4.2", "5"):
        wide = [
            table
            for table in tables(section(paper, key))
            if "ontrollers side by side" in table.title
        ]
        assert wide
        for table in wide:
            assert table.cases == ("none", "paper", "robust", "alpha-beta")


def test_robust_controller_keeps_the_delay_within_what_the_paper_saw(paper: list[Study]) -> None:
    study = section(paper, "5")
    for head in ("T = 0.5 s: controllers", "T = 1 s: controllers"):
        assert value(study, "Smallest delay estimate", "robust", head) >= 16.0
        assert value(study, "Largest delay estimate", "robust", head) <= 19.0


def test_delay_outside_what_the_paper_saw_is_shown_and_is_no_missed_band(
    paper: list[Study],
) -> None:
    study = section(paper, "5")
    rows = [row for row in study.rows if row.quantity == "Smallest delay estimate"]
    printed = [row for row in rows if row.case == "paper"]
    assert len(printed) == 2
    assert all(row.value < 16.0 and row.as_stated is False for row in printed)
    assert all(row.inside is None for row in rows)
    assert all(row.as_stated for row in rows if row.case == "robust")


def test_uncompensated_test_must_end_when_it_was_seen_to_end(paper: list[Study]) -> None:
    study = section(paper, "5")
    rows = [row for row in study.rows if row.quantity.startswith("Time at which")]
    assert {(row.low, row.high) for row in rows} == {(2.1, 4.1), (9.4, 11.4)}
    assert replace(rows[0], value=39.0).inside is False


def test_table_5_1_has_the_periods_it_names() -> None:
    for structure in table_tests.STRUCTURES:
        period = 2 * math.pi * math.sqrt(structure.mass_kg / 666400.0)
        assert_allclose(period, structure.period_s, rtol=2e-3)


# --- running ------------------------------------------------------------------------------------


def test_progress_names_each_section_and_the_end() -> None:
    seen: list[tuple[int, int, str]] = []
    found = studies.run("2.1", progress=lambda *step: seen.append(step))
    assert [study.key for study in found] == ["2.1"]
    assert seen == [(0, 1, "Section 2.1"), (1, 1, "done")]


def test_without_tcu068_el_centro_runs_and_no_band_depends_on_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(util, "find_spec", lambda name: None)
    study = inelastic.study()
    assert "TCU068 EW is not on this machine" in study.notice
    assert "elcentro" in study.text
    assert {row.group for row in study.banded} == {
        "Elastic structure without ground motion, for each integrator"
    }
    assert study.missed == []


def test_record_that_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match="no such file"):
        studies.run("4.2", "nowhere.csv")


# --- rows and tables ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "low", "high", "inside"),
    [
        (1.0, None, None, None),
        (1.0, 1.0, 1.0, True),
        (1.1, None, 1.0, False),
        (0.9, 1.0, None, False),
        (math.nan, None, 1.0, False),
        (math.nan, 0.0, None, False),
    ],
)
def test_band_decides(
    number: float, low: float | None, high: float | None, inside: bool | None
) -> None:
    assert StudyRow("q", number, low=low, high=high).inside is inside


@pytest.mark.parametrize(
    ("row", "value", "band"),
    [
        (StudyRow("q", 3.0, low=2, high=4), "3", "2 – 4"),
        (StudyRow("q", 12.3160, low=11, high=13), "12.32", "11 – 13"),
        (StudyRow("q", -0.012345, high=0.25), "−0.01235", "≤ 0.25"),
        (StudyRow("q", 55.749, low=50), "55.75", "≥ 50"),
        (StudyRow("q", 0.0, low=0, high=0), "0", "0"),
        (StudyRow("q", math.nan), "–", ""),
        (StudyRow("q", math.inf), "∞", ""),
        (StudyRow("q", 1.0053, low=1.0053 - 1e-3, high=1.0053 + 1e-3), "1.005", "1.0043 – 1.0063"),
    ],
)
def test_numbers_are_written_for_people(row: StudyRow, value: str, band: str) -> None:
    assert value_text(row) == value
    assert band_text(row) == band


def test_cases_become_columns_and_gaps_stay_gaps() -> None:
    rows = grouped(
        "g", [StudyRow("error", 1.0, "mm", paper="small"), StudyRow("delay", 2.0, "s")], "a"
    )
    rows += grouped("g", [StudyRow("error", 3.0, "mm", paper="small")], "b")
    rows += grouped("alone", [StudyRow("peak", 4.0)])
    wide, plain = tables(Study("0", "t", "", tuple(rows), ()))
    assert wide.cases == ("a", "b")
    assert [(line.quantity, line.unit, line.paper) for line in wide.lines] == [
        ("error", "mm", "small"),
        ("delay", "s", ""),
    ]
    assert [cell.value if cell else None for cell in wide.lines[1].cells] == [2.0, None]
    assert plain.cases == ()
    assert not plain.has_units
    assert not plain.has_statements


def test_no_figure_hides_another_in_the_tables(paper: list[Study]) -> None:
    for study in paper:
        shown = [
            cell for table in tables(study) for line in table.lines for cell in line.cells if cell
        ]
        assert sorted(map(repr, shown)) == sorted(map(repr, study.rows))
        assert all(cell.unit == line.unit for table in tables(study) for line in table.lines
                   for cell in line.cells if cell)  # fmt: skip
