"""Write concealed cases: tests/prove/generate.py --seed S --count N --out DIR [--kinds ...]"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prove import plans


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kinds", nargs="*", default=None, help=", ".join(plans.MIX))
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    began = time.monotonic()
    done = 0
    for name, what in generate(args.seed, args.count, args.out, args.kinds, args.jobs):
        done += 1
        print(f"\r{done}/{args.count} {name} {what:<60.60}", end="", file=sys.stderr, flush=True)
    print(f"\n{done} cases in {time.monotonic() - began:.0f} s: {args.out}", file=sys.stderr)
    return 0


def generate(
    seed: int, count: int, out: Path, kinds: list[str] | None = None, jobs: int = 2
) -> Iterator[tuple[str, str]]:
    """Yield (name, what it is) of each case as it is written."""
    wanted = plans.schedule(seed, count, kinds)
    if jobs <= 1:
        for i, w in enumerate(wanted):
            yield plans.build(seed, i, w, out)
        return
    with ProcessPoolExecutor(jobs) as pool:
        waiting = [pool.submit(plans.build, seed, i, w, out) for i, w in enumerate(wanted)]
        for future in as_completed(waiting):
            yield future.result()


if __name__ == "__main__":
    sys.exit(main())
