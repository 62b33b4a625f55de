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
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rthyb_rt.campaign import pools

_PART = re.compile(r"(<!-- generated: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def arguments(parts: Iterable[str]) -> argparse.Namespace:
    """Return ``jobs`` and ``only`` of the command line."""
    given = argparse.ArgumentParser()
    given.add_argument("--jobs", type=int, default=pools.processors())
    given.add_argument("--only", choices=(*parts, "none"))
    return given.parse_args()


def keep(path: Path, part: str, document: Mapping[str, Any]) -> None:
    """Keep the document of a part beside those of the others."""
    path.parent.mkdir(exist_ok=True)
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    path.write_text(json.dumps({**before, part: document}), encoding="utf-8")


def renew(page: Path, made: Mapping[str, str]) -> None:
    """Write what stands between the markers of a page, by name."""
    text = page.read_text(encoding="utf-8")
    text = _PART.sub(lambda part: f"{part[1]}{made.get(part[2], '')}{part[3]}", text)
    page.write_text(text, encoding="utf-8")
