"""What the pages of the benchmarks share: runs that are kept part by part, and marked places.

A page is renewed between its markers

    <!-- generated: NAME -->  ...  <!-- end -->

``--only PART`` does the runs of one part anew and takes the others from what is kept, ``--only
none`` draws from that alone.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rthyb_rt.campaign import pools

Outcome = TypeVar("Outcome")

_PART = re.compile(r"(<!-- generated: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def arguments(parts: Iterable[str]) -> argparse.Namespace:
    """Return ``jobs`` and ``only`` of the command line."""
    given = argparse.ArgumentParser()
    given.add_argument("--jobs", type=int, default=pools.processors())
    given.add_argument("--only", choices=(*parts, "none"))
    return given.parse_args()


def measure(path: Path, part: str, runs: int, work: Callable[[], Mapping[str, Any]]) -> None:
    """Do so many runs of a part, and keep its document beside those of the others."""
    begun = time.monotonic()
    document = work()
    print(f"{part}: {runs} runs in {time.monotonic() - begun:.0f} s", flush=True)
    path.parent.mkdir(exist_ok=True)
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    path.write_text(json.dumps({**before, part: document}), encoding="utf-8")


def kept(
    path: Path, outcome: Callable[[dict[str, Any]], Outcome], facts_of: str
) -> tuple[dict[str, list[Outcome]], dict[str, Any]]:
    """Return what is kept, by part, each run as ``outcome`` makes it, and the facts of one part."""
    document = json.loads(path.read_text(encoding="utf-8"))
    found = {part: [outcome(one) for one in content["runs"]] for part, content in document.items()}
    return found, document[facts_of]["facts"]


def facts_text(facts: Mapping[str, Any]) -> str:
    """Return what the figures depend on, as a paragraph."""
    return (
        f"rthyb {facts['rthyb']} (sources of the core `{facts['core_sources'][:16]}`, "
        f"{facts['compiler']}, {facts['architecture']}), Python {facts['python']}, NumPy "
        f"{facts['numpy']}, {facts['processor']}, {facts['date']}.\n"
    )


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]], texts: int) -> str:
    """Return a table; all columns after so many of text are numbers."""
    rule = ["---"] * texts + ["--:"] * (len(heads) - texts)
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, rule, *rows)) + "\n"


def renew(page: Path, made: Mapping[str, str]) -> None:
    """Write what stands between the markers of a page, by name."""
    text = page.read_text(encoding="utf-8")
    text = _PART.sub(lambda part: f"{part[1]}{made.get(part[2], '')}{part[3]}", text)
    page.write_text(text, encoding="utf-8")
