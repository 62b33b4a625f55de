"""Concealed cases of the second generator, each made by its seed.

python tests/validate/second.py --seed 7 --kind single --count 60 --out DIR [--level hard]
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from validate import drawn, folders, inseparable, recipes
from validate.recipes import KINDS, Case, Plan
from validate.rig import Redraw
from validate.signals import Rng

TRIES = 24  # draws of numbers for one plan before another plan is made
LEVELS = ("normal", "hard")
SLEEPING = ("stopper", "hysteresis", "quantisation", "rate_limit")


def _family(names: tuple[str, ...], rng: Rng) -> str:
    """A family in which all of these can show."""
    if any(n in drawn.ACTUATOR for n in names) or "pinching" in names:
        return str(rng.choice(["drive", "loop"]))
    if any(n in drawn.SENSOR for n in names):
        return str(rng.choice(["drive", "drive", "ground", "loop", "loop"]))
    return str(rng.choice(["drive", "drive", "ground", "ground", "forced", "loop", "loop"]))


def _several(count: int, rng: Rng) -> tuple[str, ...]:
    """Names that are not kin and of which one at most is of the actuator."""
    weighed = [n for n in drawn.CATALOGUE if n != "quantisation"]
    while True:
        names = tuple(map(str, rng.choice(weighed, count, replace=False)))
        kin = any(len(set(names) & group) > 1 for group in recipes.KIN)
        if not kin and sum(n in drawn.ACTUATOR for n in names) <= 1:
            return names


def plan(kind: str, level: str, turn: int, rng: Rng) -> Plan:
    """What case number `turn` of a kind is to be: names take turns, the rest is drawn."""
    groups: list[str] = []
    if kind == "ambiguous":
        name, test = inseparable.RECIPES[turn % len(inseparable.RECIPES)]
        f0 = rng.uniform(0.4, 0.8) if test == "triangle" else rng.uniform(1.5, 3.5)
        return Plan(kind, level, (name,), "drive", groups, test, f0)
    if kind == "single":
        names = (list(drawn.CATALOGUE)[turn % len(drawn.CATALOGUE)],)
    elif kind in ("pair", "triple"):
        names = _several(2 if kind == "pair" else 3, rng)
    elif kind == "cancel":
        names = recipes.CANCELLING[turn % len(recipes.CANCELLING)]
    elif kind == "dormant":
        names = (SLEEPING[turn % len(SLEEPING)],)
    elif kind == "unknown":
        names = (drawn.STRANGERS[turn % len(drawn.STRANGERS)],)
    else:
        names = ()
    family = _family(names, rng)
    if kind == "cancel" and family == "forced":
        family = "ground"
    sensed = any(n in drawn.SENSOR for n in names)
    if kind == "single" and family == "ground" and not sensed and rng.random() < 0.25:
        groups.append("no_cell")
    fading = kind == "single" and set(names) <= set(recipes.FADING)
    if fading and family in ("drive", "loop") and rng.random() < 0.25:
        groups.append("onset")
    often = 0.15 if level == "normal" else 0.35
    if not set(names) & set(recipes.HISTORY) and rng.random() < often:
        groups.append("mid_start")
    return Plan(kind, level, names, family, groups)


def make(kind: str, level: str, seed: int, number: int, refused: Counter[str]) -> Case:
    """Case `number` of a kind; what was drawn in vain is counted by its reason."""
    rng = np.random.default_rng([seed, KINDS.index(kind), LEVELS.index(level), number])
    maker = inseparable.inseparable if kind == "ambiguous" else recipes.MAKERS[kind]
    turn = number + seed % 97
    for attempt in range(40):
        # A name that will not come gives way to the next.
        wanted = plan(kind, level, turn + attempt, rng)
        for _ in range(TRIES):
            try:
                with np.errstate(over="ignore", invalid="ignore"):  # a body that runs away
                    return maker(wanted, rng)
            except Redraw as why:
                refused[f"{'+'.join(wanted.names)} ({wanted.family}): {why}"] += 1
    raise SystemExit(f"no case of {kind} could be made of seed {seed}, number {number}")


def generate(
    kind: str, level: str, seed: int, count: int, out: Path, refused: Counter[str] | None = None
) -> Iterator[Path]:
    """Case folders, written where they are not there yet."""
    counted: Counter[str] = Counter() if refused is None else refused
    for number in range(count):
        folder = out / f"s{seed % 100000:05d}_{kind}_{level}_{number:03d}"
        if not (folder / "answer.json").exists():  # it is written last
            folders.write(make(kind, level, seed, number, counted), folder)
        yield folder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--kind", required=True, choices=[*KINDS, *(k + "s" for k in KINDS), "all"])
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--level", choices=LEVELS, default="normal")
    parser.add_argument(
        "--refused", action="store_true", help="say what was drawn in vain, and why"
    )
    args = parser.parse_args()
    kinds = KINDS if args.kind == "all" else [k for k in KINDS if args.kind in (k, k + "s")]
    refused: Counter[str] = Counter()
    for kind in kinds:
        for folder in generate(kind, args.level, args.seed, args.count, args.out, refused):
            print(folder, flush=True)
    if args.refused:
        for why, times in refused.most_common():
            print(f"{times:5d}  {why}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
