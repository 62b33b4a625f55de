"""Two recordings whose answers take long: one of ten minutes, and one of a body that sticks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from prove import answers, bench, effects, folders, prepare
from prove.prepare import Wanted

USUAL, HYDRAULIC = "case of the first generator (about 15 s)", "hydraulic rig (30 s, 30 s held out)"
LONG, STICKING = "recording of 600 s", "a body with stick-slip, 15 s"
LONG_S, SHORT_S = 600.0, 15.0
STICKS = 0.6
"""Friction over the largest load of a linear body: it stands still for much of the record."""


def recorded(family: str, seconds: float, friction: float, seed: int, folder: Path) -> Path:
    """Write a recording in which dry friction, as a share of the force, is what is missing."""
    if (folder / "baseline.toml").exists():  # it is written last
        return folder
    rng = np.random.default_rng(seed)
    wanted = Wanted("single", family, ("coulomb",), excitation="random")
    lab = prepare.draw_lab(wanted, rng)
    test = bench.plan_test(lab, "random", seconds, rng)
    plain = prepare.scaled_run(lab, test, 0.006, seed, 0.0)
    size = np.std(plain.f_true) if family == "drive" else lab.mass * np.max(np.abs(plain.ag))
    missing = [effects.Missing("coulomb", {"Fc_N": friction * float(size)}, {}, "Fc_N")]
    lab = effects.install(lab, missing)
    run = bench.perform(lab, test, rng)
    lab = prepare.set_noise(lab, wanted, run, rng)
    case = answers.Case(wanted, lab, run, run, "random", missing, {}, rng)
    columns = folders.recorded(case, run, True)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recording.csv").write_text(folders.table(list(columns), list(columns.values())))
    (folder / "baseline.toml").write_text(folders.baseline_text(case))
    return folder


def generate(seed: int, count: int, out: Path) -> Iterator[Path]:
    """Yield so many recordings of either sort."""
    for number in range(count):
        yield recorded("drive", LONG_S, 0.05, seed + number, out / f"long_{number}")
        yield recorded("ground", SHORT_S, STICKS, seed + number, out / f"sticking_{number}")


def what(folder: Path) -> str:
    """Return the sort of a recording."""
    return LONG if folder.name.startswith("long") else STICKING
