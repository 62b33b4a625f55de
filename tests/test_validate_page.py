"""The proof of the diagnosis: what its figures mean, what floors they set, and what is kept."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prove import scoring
from scipy.stats import binom
from validate import own_rigs, page, proof, real, timed

ROW = scoring.Row("", "pair", "drive", ("coulomb", "viscous"), (), "explained", ())


def answered(*said: str, verdict: str = "explained") -> scoring.Row:
    names = frozenset(ROW.names)
    exact = verdict == "explained" and set(said) == names
    return replace(ROW, verdict=verdict, said=said, exact=exact, possible=names)


def test_a_wrong_name_costs_twice_what_a_refusal_costs() -> None:
    assert answered("coulomb", "viscous").cost == 0
    assert answered(verdict="unknown").cost == 1
    assert answered("coulomb").cost == 1
    assert answered("coulomb", "maxwell").cost == 2
    alarm = scoring.Row("", "null", "drive", (), (), "explained", ("gap",), alarm=True)
    assert alarm.cost == 2


@pytest.mark.parametrize(("share", "count"), [(0.9, 60), (0.5, 6), (1.0, 6), (0.0, 200)])
def test_a_share_lies_1_96_deviations_from_the_ends_of_its_interval(
    share: float, count: int
) -> None:
    low, high = page.spread(share, count)
    assert low <= share <= high
    for end in (low, high):
        if 0 < end < 1:
            sigma = np.sqrt(end * (1 - end) / count)
            assert abs(share - end) == pytest.approx(1.96 * sigma)


def test_a_floor_is_below_what_chance_leaves_and_follows_the_number_of_cases() -> None:
    assert page.floor(6000, 5400, 60) == binom.ppf(page.CHANCE, 60, 0.9)
    # Of a share that few cases have shown, less can be asked.
    assert page.floor(10, 9, 60) < page.floor(60, 54, 60) < page.floor(6000, 5400, 60)


def results() -> page.Results:
    rows = [answered("coulomb", "viscous"), answered("coulomb", "maxwell")]
    own = own_rigs.Row("specimen", "single", "single:cubic", "explained", [["cubic"]], True, True,
                       0.01)  # fmt: skip
    recording = real.Row("damper", "explained: gap", True, 59.0, 14.0, 18.0, 15.0, 40.0, 3.0, "gap")
    return page.Results(
        {page.FIRST: rows, page.NORMAL: rows[:1], page.HARD: rows[1:]}, {}, [own], [recording],
        times={page.TIMES[0][0]: [2.0, 3.0, 9.0]},
    )  # fmt: skip


def test_the_page_holds_the_counts_that_the_floors_are_made_of(tmp_path: Path) -> None:
    text = page.written(results(), "State.", "STLSQ")
    (tmp_path / "page.md").write_text(text)
    assert page.measured(tmp_path / "page.md") == results().counts()
    assert (
        "| damper | explained: gap | 59.0 | 14.00 | <= 18.00 | 15 | 1.071 | 40 | passed |" in text
    )
    assert "| 3 | 3.0 s | 9.0 s | <= 5 s |" in text
    assert "pairs, exact set | 2 | 0.5 | 0.09 to 0.91 | >= 0.93 | missed |" in text


def test_the_page_in_docs_sets_a_floor_for_every_source_of_the_short_run() -> None:
    before = page.measured(proof.PAGE)
    assert set(before) == {page.FIRST, page.NORMAL, page.HARD, page.OWN}
    assert all(0 < right <= cases for cases, right in before.values())


def test_what_is_below_its_floor_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    before = dict.fromkeys(results().counts(), (60, 57))
    replaced = results()
    assert not proof.held(replaced, before | {page.FIRST: (4, 2), page.HARD: (4, 2)})
    replaced.rows[page.FIRST] = [answered(verdict="unknown")] * 10
    below, whole = proof.held(replaced, before | {page.HARD: (4, 2)})
    assert below.startswith("first generator: 0 of 10 right, at least 7 wanted")
    assert whole.startswith("all of them: 2 of 13 right")
    assert "shipped rigs: 1 of 1 right" in capsys.readouterr().out


def test_an_answer_is_kept_until_the_program_is_another(tmp_path: Path) -> None:
    asked = []

    def tool(folder: Path) -> tuple[scoring.Answer, scoring.Prediction]:
        asked.append(folder)
        t = np.array([0.0, 0.5, 1.0])
        return {"verdict": "none"}, {"t": t, "f": 3 * t}

    for label in ("one", "one", "other"):
        said = scoring.kept(tool, label)(tmp_path)
        assert said.answer == {"verdict": "none"}
        np.testing.assert_array_equal(said.prediction["f"], [0.0, 1.5, 3.0])
    assert len(asked) == 2


def test_a_run_that_was_stopped_has_a_page_of_what_it_has_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = "proof.py --kept --seed 7 --sources second --level hard --kinds null --out"
    monkeypatch.setattr(sys, "argv", [*call.split(), str(tmp_path)])
    stopped = proof.Proof(proof.options())
    out = stopped.folder("second")
    for number, has_answer in enumerate((True, False, True)):
        folder = out / f"s00007_null_hard_{number:03d}"
        folder.mkdir(parents=True)
        if has_answer:
            said = {"seconds": 1.0, "answer": {"verdict": "none", "effects": []}}
            (folder / f"said-{stopped.state}.json").write_text(json.dumps(said))
    asked: list[str] = []
    monkeypatch.setattr(stopped, "_both", lambda *args: asked.extend(f.name for f in args[2]))
    stopped.second(page.Results())
    assert asked == ["s00007_null_hard_000", "s00007_null_hard_002"]


def test_the_state_is_that_of_the_sources_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(proof, "ROOT", tmp_path)
    found = []
    for name, text in (("a.py", "1"), ("a.py", "2"), ("b.c", "2"), ("c.txt", "2")):
        (tmp_path / "tree").mkdir(exist_ok=True)
        (tmp_path / "tree" / name).write_text(text)
        found.append(proof.digest("tree"))
    assert len(set(found[:3])) == 3
    assert found[2] == found[3]


def test_a_recording_passes_by_name_and_by_error(tmp_path: Path) -> None:
    truth = {
        "effects": ["gap"], "also_acceptable": ["coulomb"], "nrmse_heldout_naive": 50.0,
        "nrmse_heldout_known": 10.0, "pass_heldout_nrmse": 12.0, "known_model": "gap",
        "metric": "100*rms(pred-meas)/std(meas), channel f, rows from 2 of heldout.csv",
    }  # fmt: skip
    (tmp_path / "answer.json").write_text(json.dumps(truth))
    true = np.array([9.0, 9.0, 1.0, -1.0, 1.0, -1.0])
    lines = "\n".join(f"{i},{f}" for i, f in enumerate(true))
    (tmp_path / "heldout.csv").write_text(f"t,f_meas\n{lines}\n")

    def row(names: list[str], off: float, verdict: str = "explained") -> real.Row:
        answer = {"verdict": verdict, "effects": names}
        found = {"f": true * (1 + off) + [5, 5, 0, 0, 0, 0]}
        return real.score(tmp_path, scoring.Said(answer, found, 1.0), None)

    assert row(["gap", "coulomb"], 0.11).passed
    assert row(["gap"], 0.11).ratio == pytest.approx(1.1)
    assert not row(["gap"], 0.13).passed
    assert not row(["gap", "maxwell"], 0.11).passed
    assert not row([], 0.11, "unknown").passed


def test_what_is_timed_has_its_length_and_sticks(tmp_path: Path) -> None:
    folder = timed.recorded("ground", timed.SHORT_S, timed.STICKS, 3, tmp_path)
    recording = scoring.read_csv(folder / "recording.csv")
    assert recording["t"][-1] == pytest.approx(timed.SHORT_S, abs=0.01)
    still = np.abs(np.gradient(recording["x_meas"])) < 3e-6
    assert np.mean(still) > 0.3
