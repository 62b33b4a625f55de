"""Recordings of other laboratories: what is said of them beside the physics known of them."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from prove import scoring


def copies(source: Path, out: Path) -> list[Path]:
    """Folders to be asked about: the recordings may lie where nothing can be written."""
    cases = sorted(p.parent for p in source.glob("*/answer.json"))
    known = [c for c in cases if "nrmse_heldout_known" in (c / "answer.json").read_text()]
    return [Path(shutil.copytree(c, out / c.name, dirs_exist_ok=True)) for c in known]


def error(folder: Path, truth: dict[str, Any], prediction: scoring.Prediction) -> float:
    """Held-out NRMSE, per cent, in the channel and from the row that the answer's figure has."""
    channel = "x" if "channel x" in truth["metric"] else "f"
    first = int(truth["metric"].split("rows from ")[1].split()[0])
    true = scoring.read_csv(folder / "heldout.csv")[f"{channel}_meas"][first:]
    guess = None if prediction is None else prediction.get(channel)
    if guess is None or guess.size != first + true.size:
        return math.nan
    miss = guess[first:] - true
    return 100 * float(np.sqrt(np.nanmean(miss**2)) / np.nanstd(true))


@dataclass
class Row:
    """What was said of a recording; errors in per cent of the held-out signal."""

    name: str
    said: str
    named: bool
    naive: float
    known: float
    limit: float
    error: float
    rival: float
    seconds: float
    physics: str

    @property
    def ratio(self) -> float:
        """Error over that of the best model of the known physics."""
        return self.error / self.known

    @property
    def passed(self) -> bool:
        return self.named and self.error <= self.limit


def score(folder: Path, said: scoring.Said, rival: scoring.Said | None) -> Row:
    """Compare an answer with what is known; `rival`: the comparison's answer to the same.

    Named right: the verdict is that of the known physics, and no name is outside of what the answer
    has or accepts. A recording without a limit of its own has that of the known physics.
    """
    truth = json.loads((folder / "answer.json").read_text())
    answer = said.answer
    verdict, names = str(answer.get("verdict", "failed")), answer.get("effects") or []
    accepted = {*truth["effects"], *truth.get("also_acceptable", ())}
    verdicts = {"explained"} if truth["effects"] else {"none"}
    if not truth["effects"] and names:
        verdicts = {"explained"}  # by what is accepted beside nothing
    named = verdict in verdicts and set(names) <= accepted
    known = truth["nrmse_heldout_known"]
    return Row(
        folder.name, f"{verdict}: {', '.join(names) or '-'}", named, truth["nrmse_heldout_naive"],
        known, truth.get("pass_heldout_nrmse", known), error(folder, truth, said.prediction),
        math.nan if rival is None else error(folder, truth, rival.prediction), said.seconds,
        truth["known_model"],
    )  # fmt: skip
