"""The table of figures at the end of ``make proof``, and build/proof.json."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable
from typing import Any

import pytest
from proof.parties import ROOT

from rthyb_rt.lab import punctuality

FIGURES: list[dict[str, Any]] = []
OUTCOMES: dict[str, str] = {}

Note = Callable[..., None]


@pytest.fixture(scope="session")
def note() -> Note:
    """Add a figure to the table: group, name, measured value, unit, and allowed range in words."""

    def add(group: str, name: str, measured: Any, unit: str = "", allowed: str = "") -> None:
        FIGURES.append(
            {"group": group, "name": name, "measured": measured, "unit": unit, "allowed": allowed}
        )

    return add


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Record the result of each proof."""
    if report.when == "call" or report.failed:
        OUTCOMES[report.nodeid.partition("::")[2]] = report.outcome


def _said(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the table and write the file."""
    if not FIGURES:
        return
    width = max(len(f"{f['group']}: {f['name']}") for f in FIGURES)
    terminalreporter.write_sep("=", "figures")
    for f in FIGURES:
        name, value = f"{f['group']}: {f['name']}", f"{_said(f['measured'])} {f['unit']}"
        terminalreporter.write_line(f"{name:{width}}  {value:>16}  {f['allowed']}".rstrip())
    document = {
        "schema": "rthyb-proof/1",
        "created_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": punctuality.machine_facts(),
        "proofs": OUTCOMES,
        "figures": FIGURES,
    }
    path = ROOT / "build" / "proof.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    terminalreporter.write_line(f"\n{path.relative_to(ROOT)}")
