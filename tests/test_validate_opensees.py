"""The specimens of OpenSees with which the diagnosis is validated, and how answers are scored."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kernels import opensees as required
from prove import scoring
from scipy import signal
from validate import opensees, opensees_scored, page
from validate.opensees_materials import MATERIALS

K, PEAK_M, H = 1e6, 0.01, 1.0 / 4096
BESIDE = ("slider beside a spring", "dashpot", "damper", "damper on a brace")
"""Specimens whose model states the spring alone, beside which there is something from the first."""


def moved(seconds: float = 6.0) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(0.0, seconds, H)
    return t, PEAK_M * np.sin(2 * np.pi * 1.3 * t) * np.clip(t, 0.0, 1.0) ** 3


def test_opensees_makes_the_force_of_a_relaxation_of_closed_form() -> None:
    required()
    t, x = moved()
    km, c = 6e5, 9e3

    def brace(ops: Any) -> None:
        ops.uniaxialMaterial("Elastic", 2, K)
        ops.uniaxialMaterial("ViscousDamper", 3, km, c, 1.0)
        ops.uniaxialMaterial("Parallel", 1, 2, 3)

    expected = K * x + signal.lsim(signal.TransferFunction([c, 0.0], [c / km, 1.0]), x, t)[1]
    found = opensees.forces(brace, x, H)
    assert np.std(found - expected) < 1e-3 * np.std(expected - K * x)


@pytest.mark.parametrize("number", range(len(MATERIALS)))
def test_each_specimen_of_opensees_begins_with_the_stiffness_that_is_stated(
    number: int, tmp_path: Path
) -> None:
    required()
    one, known, (run, held) = opensees.make(number, 0)
    assert one.material is MATERIALS[number]
    assert run.x[0] == run.f[0] == held.f[0] == 0.0
    if one.material.name not in BESIDE:
        few = np.abs(run.x) < 1e-2 * np.max(np.abs(run.x))
        first = slice(None, int(np.argmin(few)))
        v = np.gradient(run.x, run.columns["t"][1])
        off = (run.f - known["k"] * run.x - one.c * v)[first]
        assert np.linalg.norm(off) < 0.1 * np.linalg.norm(run.f[first])
    assert known["family"] == "ground" or abs(run.x[-1]) < 1e-3 * one.peak_m
    opensees.write(number, 0, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        "answer.json", "baseline.toml", "heldout_input.csv", "heldout_truth.csv", "recording.csv",
    }  # fmt: skip


def answered(
    folder: Path, verdict: str, *names: str, also: tuple[str, ...] = ()
) -> opensees_scored.Row:
    folder.mkdir(exist_ok=True)
    truth = {"material": "slider", "verdict": "explained", "accepted": [["coulomb"], ["lugre"]]}
    (folder / "answer.json").write_text(json.dumps(truth))
    x = np.linspace(0.0, 1.0, 5)
    rows = "\n".join(f"{v:g},{v:g},{v:g}" for v in x)
    (folder / "heldout_truth.csv").write_text(f"t,x,f\n{rows}\n")
    equal = [list(names), list(also)] if also else []
    said = {"verdict": verdict, "effects": list(names), "ambiguous_with": equal}
    return opensees_scored.score(folder, scoring.Said(said, {"f": x + 0.1}, 2.0))


def test_a_specimen_is_named_rightly_by_any_name_of_its_law_and_by_no_other(tmp_path: Path) -> None:
    assert answered(tmp_path, "explained", "lugre").right
    assert answered(tmp_path, "ambiguous", "viscous", also=("coulomb",)).right
    wrong = answered(tmp_path, "explained", "coulomb", "viscous")
    assert not wrong.right
    assert wrong.wrong_name
    refused = answered(tmp_path, "unknown")
    assert not refused.right
    assert not refused.wrong_name
    assert refused.error == pytest.approx(0.1 / np.std(np.linspace(0.0, 1.0, 5)))


def test_the_page_has_a_line_for_each_material_and_one_for_all(tmp_path: Path) -> None:
    rows = [answered(tmp_path, "explained", "lugre"), answered(tmp_path, "unknown")]
    results = page.Results(opensees=rows)
    lines = page._opensees(results).splitlines()
    assert lines[2].startswith("| slider | 2 | 1 | 0 | 0.283 | unknown")
    assert lines[3].startswith("| all | 2 | 1 (")
    assert results.failed() == []


def test_opensees_moves_a_body_on_a_shaken_ground_as_the_linear_equation_has_it() -> None:
    required()
    elastic = next(m for m in MATERIALS if m.verdict == "none")
    one = opensees.Specimen(elastic, K, PEAK_M, 1.5, 0, mass_kg=K / 90.0, c=500.0)
    t, _ = moved()
    ag = np.sin(2.0 * np.pi * t) * np.minimum(t, 1.0)
    system = signal.TransferFunction([-one.mass_kg], [one.mass_kg, one.c, K])
    expected = signal.lsim(system, ag, t)[1]
    x, a = opensees.response(one, one.built(1.0), ag, H)
    assert np.std(x - expected) < 1e-3 * np.std(expected)
    force = K * x + one.c * np.gradient(x, H)
    assert np.std(one.mass_kg * (a + ag) + force) < 1e-3 * np.std(force)


def test_opensees_moves_a_body_on_a_damper_without_a_slope_at_rest() -> None:
    required()
    damper = next(m for m in MATERIALS if m.name == "damper")
    t, _ = moved(3.0)
    ag = np.sin(2.0 * np.pi * t) * np.minimum(t, 1.0)
    for numbers in range(4):
        one = opensees.Specimen(damper, K, PEAK_M, 1.5, numbers, mass_kg=K / 90.0, c=500.0)
        assert np.isfinite(opensees.response(one, one.built(0.1), ag, H)).all()
