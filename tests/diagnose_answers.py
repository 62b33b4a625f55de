"""Helpers for checking an answer of the diagnosis."""

from __future__ import annotations

from pathlib import Path

import diagnose_cases as cases
import numpy as np

from rthyb_rt import cli
from rthyb_rt.diagnose import engine, reading


def diagnosed(folder: Path, columns: dict[str, np.ndarray], model: str | None = None):
    recording, toml = cases.write(folder, columns, model)
    return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


def found(d, name: str, key: str) -> float:
    return next(c for c in d.candidates if c.name == name).params[key]


def holds(d, name: str, key: str, truth: float) -> bool:
    low, high = next(c for c in d.candidates if c.name == name).ci95[key]
    return low <= truth <= high


def run(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments])
