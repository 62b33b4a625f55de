"""The page of the reproduced paper: whole, self-contained, and honest about a missed band."""

from __future__ import annotations

import json
import re
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from rthyb_rt.errors import InputError
from rthyb_rt.studies.results import Curve, Panel, Study, StudyRow, band_text, value_text
from rthyb_rt.studies.studies_page import document, render, write_page

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def page(paper: list[Study]) -> str:
    return render(paper)


def small(*rows: StudyRow, **changes: object) -> Study:
    t = np.linspace(0.0, 1.0, 50)
    panel = Panel("p", "A curve", "time, s", "x, mm", (Curve("x", t, np.sin(6 * t)),))
    study = Study("9.9", "Small", "A study.", rows, (panel,), ("Nothing is open.",))
    return replace(study, **changes)  # type: ignore[arg-type]


def text_of(page: str) -> str:
    class Words(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.words: list[str] = []

        def handle_data(self, data: str) -> None:
            self.words.append(data)

    words = Words()
    words.feed(re.sub(r"<(style|svg).*?</\1>", "", page, flags=re.DOTALL))
    return " ".join(" ".join(words.words).replace("\N{NO-BREAK SPACE}", " ").split())


@pytest.mark.long
def test_page_asks_nothing_of_the_network(page: str) -> None:
    assert re.findall(r'\b(?:src|href)="(?!#)', page) == []
    assert not re.search(r"@import|url\((?!#)", page)
    assert "default-src 'none'" in page


def test_ids_are_unique_and_every_reference_has_its_target(page: str) -> None:
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    wanted = set(re.findall(r"url\(#([^)]+)\)", page)) | set(re.findall(r'href="#([^"]+)"', page))
    assert wanted <= set(ids)


def test_every_row_and_band_is_on_the_page(paper: list[Study], page: str) -> None:
    text = text_of(page)
    for study in paper:
        assert f"{study.key} {study.title}" in text
        for row in study.rows:
            assert row.quantity in text
            assert row.group in text
            assert value_text(row) in text
            assert band_text(row) in text
            assert row.paper in text
        for open_point in study.ambiguities:
            assert open_point in text


def test_every_panel_is_a_drawing_without_broken_numbers(paper: list[Study], page: str) -> None:
    drawings = [ET.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]
    assert len(drawings) == sum(len(study.panels) for study in paper)
    for drawing in drawings:
        paths = [path.get("d", "") for path in drawing.iter("{http://www.w3.org/2000/svg}path")]
        assert any(path.count("L") > 2 for path in paths)
        assert not any("nan" in path or "inf" in path or "e+" in path for path in paths)
    numbers = re.findall(r"<b>Figure (\d+)\.", page)
    assert numbers == [str(n) for n in range(1, len(drawings) + 1)]


def test_page_is_small(page: str) -> None:
    assert len(page.encode()) < 2_000_000


def test_all_bands_met_is_said_first(paper: list[Study], page: str) -> None:
    bands = sum(len(study.banded) for study in paper)
    assert f"{bands} of {bands} accepted bands are met." in text_of(page)
    assert "all bands met" in text_of(page)
    assert '<td class="number miss">' not in page


@pytest.mark.parametrize("case", ["", "PLC"])
def test_missed_band_is_named_on_top_and_marked_by_sign_and_word(case: str) -> None:
    rows = (
        StudyRow("Peak", 2.5, "mm", 1.0, 2.0, "about 1.5", "Tests", case),
        StudyRow("Delay", 1.5, "s", 1.0, 2.0, "", "Tests", case),
    )
    page = render([small(*rows)])
    text = text_of(page)
    assert "1 of 2 accepted bands are met; 1 is missed." in text
    where = "Tests, PLC" if case else "Tests"
    assert f"✗ Section 9.9, {where}: Peak 2.500 mm, accepted: 1 – 2" in text
    assert text.count("✗ missed") == 2  # the legend explains the sign, the table uses it
    assert "bands missed" in text


def test_value_that_is_no_number_is_a_missed_band_and_null_in_json(tmp_path: Path) -> None:
    study = small(StudyRow("Peak", float("nan"), "mm", 1.0, 2.0), StudyRow("Ratio", float("inf")))
    write_page([study], tmp_path)
    found = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert [row["value"] for row in found["rows"]] == [None, None]
    assert [row["inside"] for row in found["rows"]] == [False, None]
    assert found["missed"] == 1


def test_notice_of_a_study_stands_above_its_tables() -> None:
    page = text_of(render([small(StudyRow("Peak", 1.0), notice="Run without the record.")]))
    assert page.index("Run without the record.") < page.index("Peak")


def test_results_hold_every_row_with_its_place(paper: list[Study], tmp_path: Path) -> None:
    found = document(paper)
    assert found["schema"] == "rthyb-reproduce/1"
    assert len(found["rows"]) == sum(len(study.rows) for study in paper)
    assert set(found["rows"][0]) == {
        "section", "group", "case", "quantity", "value", "unit", "band", "inside", "paper",
        "as_stated",
    }  # fmt: skip
    places = [(r["section"], r["group"], r["case"], r["quantity"]) for r in found["rows"]]
    assert len(set(places)) == len(places)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_titles_cannot_break_out_of_the_page() -> None:
    page = render([small(StudyRow("<b>bold</b>", 1.0), title="<script>alert(1)</script>")])
    assert "<script>alert" not in page
    assert "<b>bold" not in page


def test_page_without_matplotlib_names_the_remedy_and_leaves_the_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "rthyb_rt.studies.studies_figures", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"needs matplotlib.*pip install 'rthyb-rt\[report\]'"):
        write_page([small(StudyRow("Peak", 1.0))], tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["results.json"]


def test_short_window_of_a_long_test_is_drawn_as_it_was() -> None:
    t = np.arange(40 * 1024) / 1024.0
    curve = Curve("", t, np.sin(2 * np.pi * 50.0 * t))
    panel = Panel("short", "Short", "time, s", "y", (curve,), x_range=(2.0, 2.5))
    from rthyb_rt.studies.studies_figures import draw_all

    (plate,) = draw_all(small(StudyRow("Peak", 1.0), panels=(panel,)))
    path = max(re.findall(r' d="([^"]*)"', plate.svg), key=len)
    assert len(re.findall(r"[ML]", path)) > 300
