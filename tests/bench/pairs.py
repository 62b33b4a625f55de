"""Compare the time of a sample with that of another checkout, by alternating pairs of runs.

A sample is all that the controller computes from a pair of readings to its command, and its record,
on a structure of one degree of freedom with one axis, for several control laws. Both drivers are
built with the flags of their own checkout and run in turn, so that a slow moment of the machine
meets both.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import driver

ROOT = Path(__file__).resolve().parents[2]
MOST = 1.05
"""Largest ratio of the times that counts as equal."""

Times = dict[str, float]
Run = Callable[[], Times]


@dataclass(frozen=True)
class Compared:
    """One kind of controller.

    Attributes:
        name: the control law.
        here_ns: median time of a sample in this checkout, of all runs.
        there_ns: likewise in the other one.
        ratio: median of the ratios of the pairs, here over there.
        least: the smallest of these ratios.
        most: the largest one.
    """

    name: str
    here_ns: float
    there_ns: float
    ratio: float
    least: float
    most: float


def compare(here: Run, there: Run, pairs: int) -> list[Compared]:
    """Run both in turn and compare what both have timed.

    A pair is here, there, there, here: what becomes slower or faster all the time meets both alike.

    Args:
        here: runs the driver of this checkout; gives times of a sample by control law, ns.
        there: the same of the other one.
        pairs: number of pairs, at least 1.
    """
    own: list[Times] = []
    other: list[Times] = []
    for _ in range(pairs):
        first, one, another, last = here(), there(), there(), here()
        own.append(_mean(first, last))
        other.append(_mean(one, another))
    names = [name for name in own[0] if name in other[0]]
    if not names:
        raise SystemExit(
            f"the other checkout times none of the laws {', '.join(own[0])}; compare with a "
            "version that does"
        )
    found = []
    for name in names:
        ratios = [ours[name] / theirs[name] for ours, theirs in zip(own, other, strict=True)]
        found.append(
            Compared(
                name,
                statistics.median(times[name] for times in own),
                statistics.median(times[name] for times in other),
                statistics.median(ratios),
                min(ratios),
                max(ratios),
            )
        )
    return found


def _mean(one: Times, another: Times) -> Times:
    return {name: math.sqrt(one[name] * another[name]) for name in one if name in another}


def table(found: list[Compared]) -> str:
    """Return the lines of the table."""
    lines = [f"{'a sample, 1 DOF, 1 axis':24} {'here':>9} {'there':>9} {'ratio':>7}  of the pairs"]
    for c in found:
        verdict = "ok" if c.ratio <= MOST else f"over {MOST:g}"
        lines.append(
            f"{c.name:24} {c.here_ns:6.1f} ns {c.there_ns:6.1f} ns {c.ratio:7.3f}  "
            f"{c.least:.3f} to {c.most:.3f}  {verdict}"
        )
    return "\n".join(lines)


def run_of(checkout: Path) -> Run:
    """Build the driver of a checkout, below build/ of this one, and return how to run it."""
    name = hashlib.sha256(str(checkout).encode()).hexdigest()[:8]
    built = driver.build(checkout, ROOT / "build" / "bench-pairs" / name)

    def run() -> Times:
        timed = driver.rows(built, "sample")
        return {row["name"]: row["median_ns"] for row in timed if row["group"] == "sample"}

    return run


def main() -> None:
    """Build, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path, help="folder of the other checkout")
    parser.add_argument("--pairs", type=int, default=9, help="pairs, of two runs each (default 9)")
    given = parser.parse_args()
    if given.pairs < 1:
        parser.error(f"found --pairs {given.pairs}; it must be at least 1")
    there, here = run_of(given.other.resolve()), run_of(ROOT)
    print(table(compare(here, there, given.pairs)))


if __name__ == "__main__":
    main()
