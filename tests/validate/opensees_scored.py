"""Answers about specimens of OpenSees, compared with what the specimens are made of."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from prove import scoring

from validate.signals import rms


@dataclass(frozen=True)
class Row:
    """What was said of a specimen; `error`: of the predicted force, over its deviation."""

    name: str
    material: str
    said: str
    right: bool
    named: bool
    error: float
    seconds: float

    @property
    def wrong_name(self) -> bool:
        return self.named and not self.right


def score(folder: Path, said: scoring.Said) -> Row:
    """Compare an answer with what the specimen is made of."""
    truth = json.loads((folder / "answer.json").read_text())
    verdict = str(said.answer.get("verdict", "failed"))
    names = tuple(sorted(said.answer.get("effects") or ()))
    sets = {names, *(tuple(sorted(s)) for s in said.answer.get("ambiguous_with") or ())}
    accepted = {tuple(s) for s in truth["accepted"]}
    right = verdict == truth["verdict"] and (not accepted or names in accepted)
    if verdict == "ambiguous":
        right = bool(sets & accepted)
    error = np.nan
    if said.prediction is not None and said.prediction.get("f") is not None:
        f = scoring.read_csv(folder / "heldout_truth.csv")["f"]
        error = rms(said.prediction["f"] - f) / float(np.std(f))
    told = " or ".join(sorted("+".join(s) for s in sets if s))
    return Row(
        folder.name, truth["material"], f"{verdict}: {told or '-'}", right,
        verdict in ("explained", "ambiguous"), float(error), said.seconds,
    )  # fmt: skip
