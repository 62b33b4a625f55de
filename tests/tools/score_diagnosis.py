"""Print the diagnosis of folders with known answers: python score_diagnosis.py FOLDER..."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from rthyb_rt.diagnose import engine, reading, result


def right(d: result.DiagnosisResult, answer: dict[str, Any]) -> bool:
    """Return whether verdict and names equal the answer's."""
    verdict = answer.get("verdict")
    if verdict is not None and d.verdict != verdict:
        return False
    names = sorted(e if isinstance(e, str) else e["name"] for e in answer["effects"])
    if verdict == "ambiguous":
        sets = sorted(sorted([s] if isinstance(s, str) else s) for s in answer["ambiguous"])
        return sorted(map(sorted, d.ambiguous_with)) == sets
    return verdict in ("none", "unknown") or sorted(d.effects) == names


def main() -> int:
    """Score every folder given; the exit status is the number of wrong answers."""
    wrong = 0
    for folder in map(Path, sys.argv[1:]):
        answer = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
        model = reading.read_model(folder / "baseline.toml")
        began = time.monotonic()
        d = engine.diagnose(reading.read_case(folder / "recording.csv", model))
        ok = right(d, answer)
        wrong += not ok
        truth = [e if isinstance(e, str) else e["name"] for e in answer["effects"]]
        said = d.ambiguous_with or d.effects
        print(
            f"{'ok ' if ok else 'BAD'} {folder.name:20} {model.family:7} {answer.get('verdict')} "
            f"{truth} -> {d.verdict} {said}  {time.monotonic() - began:.1f} s"
        )
    return wrong


if __name__ == "__main__":
    sys.exit(main())
