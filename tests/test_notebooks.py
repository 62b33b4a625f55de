"""The notebooks of the guide run from their first cell to their last in an empty folder."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "docs" / "notebooks").glob("*.ipynb"))
by_notebook = pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(notebook: Path) -> list[dict[str, Any]]:
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def executed(notebook: Path, folder: Path) -> Any:
    """Run all cells in a kernel of its own; an error in one of them is raised."""
    nbclient = pytest.importorskip("nbclient", reason="runs notebooks")
    nbformat = pytest.importorskip("nbformat", reason="runs notebooks")
    pytest.importorskip("ipykernel", reason="runs notebooks")
    book = nbformat.read(notebook, as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(book, timeout=120, resources=resources).execute()
    return book


def text_of(cell: Any) -> str:
    """Return all that a cell has printed and shown."""
    parts = []
    for output in cell.outputs:
        parts.append(output.get("text", ""))
        parts += [str(value) for value in output.get("data", {}).values()]
    return "\n".join(parts)


def test_there_are_notebooks() -> None:
    assert "first-test" in [path.stem for path in NOTEBOOKS]


@by_notebook
def test_notebook_is_kept_without_outputs(notebook: Path) -> None:
    for cell in code_cells(notebook):
        assert cell["outputs"] == []
        assert cell["execution_count"] is None


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_first_test_runs_as_it_stands_and_shows_verdict_figures_and_messages(
    tmp_path: Path,
) -> None:
    (notebook,) = [path for path in NOTEBOOKS if path.stem == "first-test"]
    book = executed(notebook, tmp_path)
    shown = [text_of(cell) for cell in book.cells if cell.cell_type == "code"]
    whole = "\n".join(shown)
    assert "The specimen followed the command within" in whole
    assert "<svg" in whole
    assert whole.count("<figure ") >= 4
    assert "tracking  0.09" in whole
    assert "limit 15 kN" in whole
    assert 'with_: numerical.mass_kg: found "4220 N" (that is a force)' in whole
    assert "the rig file has 666.4 kN/m" in whole
    assert shown[-1].strip() == "True"
    assert len(list(tmp_path.glob("runs/*/report.html"))) == 1  # named by time: it can run again


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_stability_map_shows_every_run_and_no_run_below_the_critical_delay_was_ended(
    tmp_path: Path,
) -> None:
    (notebook,) = [path for path in NOTEBOOKS if path.stem == "stability-map"]
    book = executed(notebook, tmp_path)
    shown = [text_of(cell) for cell in book.cells if cell.cell_type == "code"]
    assert "<Sweep stability-map-sweep: 60 runs, " in shown[1]
    assert ", 0 failed>" in shown[1]
    assert "'3.3'" in shown[3]  # of T = 0.5 s, as the first notebook has it
    assert any(
        "image/png" in out.get("data", {}) for cell in book.cells for out in cell.get("outputs", [])
    )
    count, beyond = shown[-1].split()
    assert int(count) >= 10
    assert beyond == "True"


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_diagnosis_of_a_csv_names_the_friction_and_the_column_that_is_not_there(
    tmp_path: Path,
) -> None:
    (notebook,) = [path for path in NOTEBOOKS if path.stem == "diagnosis"]
    book = executed(notebook, tmp_path)
    shown = [text_of(cell) for cell in book.cells if cell.cell_type == "code"]
    assert shown[0].strip().startswith("Time [ms],Accel [m/s^2],Target [mm]")
    assert shown[2].strip() == "explained ['coulomb']"
    assert "'LVDT 1' converted from mm" in shown[3].replace("&#x27;", "'")
    assert "<svg" in shown[3]
    assert "compared at" not in shown[3]  # one rate, though its times are rounded
    assert "did you mean 'LVDT 1'?" in shown[4]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_a_control_law_of_ones_own_learns_the_delay_and_its_error_names_its_line(
    tmp_path: Path,
) -> None:
    (notebook,) = [path for path in NOTEBOOKS if path.stem == "own-control-law"]
    book = executed(notebook, tmp_path)
    shown = [text_of(cell) for cell in book.cells if cell.cell_type == "code"]
    assert "alpha from 8.2 to 17.2 samples" in shown[2]
    assert "<svg" in shown[3]
    assert 'class = "__main__:Slope"' in shown[5]
    errors = dict(re.findall(r"rate +(\d+) per s: tracking ([\d.]+) %", shown[5]))
    assert float(errors["0"]) > 5.0 * float(errors["5"])
    assert "ZeroDivisionError in: return super().lead" in shown[6]
    assert shown[-1].strip() == "True"
