"""The page that the proof leaves behind, and the floors that its figures set for a short run."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from prove import scoring
from scipy.stats import betabinom

from validate import opensees_scored, own_rigs, real, timed

FIRST, NORMAL, HARD = "first generator", "second generator, normal", "second generator, hard"
OWN = "shipped rigs"
HYDRAULIC = ("actuator-end", "specimen")
CHANCE = 0.01
"""How often a short run may fall below its floor where nothing has changed."""


@dataclass
class Results:
    """All that was asked: answers of the tool and of the comparison, by source."""

    rows: dict[str, list[scoring.Row]] = field(default_factory=dict)
    rivals: dict[str, list[scoring.Row]] = field(default_factory=dict)
    own: list[own_rigs.Row] = field(default_factory=list)
    real: list[real.Row] = field(default_factory=list)
    opensees: list[opensees_scored.Row] = field(default_factory=list)
    no_opensees: str = ""  # why there are no recordings of its specimens
    no_real: str = ""  # why the recordings that judge were not there
    times: dict[str, list[float]] = field(default_factory=dict)

    def counts(self) -> dict[str, tuple[int, int]]:
        """Cases and right answers of each source."""
        found = {n: (len(rows), sum(r.right for r in rows)) for n, rows in self.rows.items()}
        if self.own:
            found[OWN] = len(self.own), sum(r.right for r in self.own)
        return found

    def failed(self) -> list[str]:
        """Cases that got no answer at all."""
        rows = [r for rows in self.rows.values() for r in rows]
        return (
            [f"{r.id}: {r.failure}" for r in rows if r.verdict == "failed"]
            + [f"{r.rig} {r.label}" for r in self.own if r.verdict == "failed"]
            + [r.name for r in self.opensees if r.said.startswith("failed")]
        )


def spread(share: float, count: int) -> tuple[float, float]:
    """95 % interval of a share of so many cases (Wilson 1927)."""
    z2 = 1.96**2
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = math.sqrt(z2 * (share * (1 - share) + z2 / (4 * count)) / count) / (1 + z2 / count)
    low, high = max(middle - half, 0.0), min(middle + half, 1.0)
    return min(low, share), max(high, share)  # at 0 and 1, but for rounding


def floor(cases: int, right: int, asked: int) -> int:
    """Right answers of so many that no more than CHANCE of runs fall below, given those before.

    The share is known from the cases before only as well as they are many: beta-binomial.
    """
    return int(betabinom(asked, right + 1, cases - right + 1).ppf(CHANCE))


def measured(page: Path) -> dict[str, tuple[int, int]]:
    """Cases and right answers of each source, from a page as it was written."""
    line = re.compile(r"^\| ([^|]+) \| (\d+) \| (\d+) \|", re.MULTILINE)
    text = page.read_text().split("## All cases")[1].split("\n## ")[0]
    return {name: (int(cases), int(right)) for name, cases, right in line.findall(text)}


# ---- what was asked for ------------------------------------------------------------------------


TELLING = 20
"""Cases from which a figure is said to be met: were the share below .86, chance would show all of
twenty right once in twenty times."""


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}".rstrip("0").rstrip(".")


def _judged(what: str, value: float, count: int, low: float, high: float) -> str:
    """A line of the table: wanted is a share between low and high."""
    wanted = f">= {low:g}" if high >= 1 else f"<= {high:g}" if low <= 0 else f"{low:g} to {high:g}"
    if not count:
        return f"| {what} | 0 | - | - | {wanted} | not asked |"
    a, b = spread(value, count)
    verdict = "missed" if b < low or a > high else "open"
    if low <= value <= high and count >= TELLING:
        verdict = "met"
    return f"| {what} | {count} | {_number(value)} | {a:.2f} to {b:.2f} | {wanted} | {verdict} |"


# First generator, then the second one at either level: figure, least, most.
WANTED_FIRST = (
    ("single effect, correct name first", 0.98, 1.0),
    ("pairs, exact set", 0.93, 1.0),
    ("cancelling pairs, exact set", 0.90, 1.0),
    ("false alarms with a correct model", 0.0, 0.0),
    ("outside the catalogue: reported as unknown", 1.0, 1.0),
    ("not separable: reported with all candidates", 1.0, 1.0),
)
WANTED_SECOND = (
    ("single effect, correct name first", 0.85, 1.0),
    ("single effect, correct name among first two", 0.92, 1.0),
    ("pairs, exact set", 0.85, 1.0),
    ("triples, exact set", 0.70, 1.0),
    ("false alarms with a correct model", 0.0, 0.01),
    ("false alarms with an effect that never acts", 0.0, 0.01),
    ("outside the catalogue: reported as unknown", 0.90, 1.0),
    ("not separable: reported with all candidates", 0.85, 1.0),
)
WANTED_OF_NUMBERS = (
    ("95 % intervals that contain the true value", 0.92, 0.98),
    ("parameters within 10 % of the true value", 0.95, 1.0),
)


def _wanted_rows(results: Results) -> Iterable[str]:
    own = results.own
    hydraulic = [r for r in own if r.rig in HYDRAULIC]
    for what, rows in ((OWN, own), (f"{OWN}, the hydraulic one", hydraulic)):
        yield _judged(f"{what}: named exactly", *scoring.share(r.right for r in rows), 0.95, 1.0)
    closed = scoring.share(r.closed < own_rigs.CLOSED for r in own)
    yield _judged(f"{OWN}: closed loop within 3 %", *closed, 0.97, 1.0)
    for source, wanted in ((FIRST, WANTED_FIRST), (NORMAL, WANTED_SECOND), (HARD, WANTED_SECOND)):
        lines = {n.what: n for n in scoring.table(results.rows.get(source, []))}
        for what, low, high in wanted + WANTED_OF_NUMBERS:
            found = lines[what]
            yield _judged(f"{source}: {what}", found.value, found.count, low, high)
    passed = scoring.share(r.passed for r in results.real)
    real = "real recordings: correctly named, held-out error within target"
    yield _judged(real, *passed, 1.0, 1.0)


TIMES = ((timed.USUAL, 5.0), (timed.HYDRAULIC, 15.0), (timed.LONG, 60.0), (timed.STICKING, 15.0))


def _wanted(results: Results) -> str:
    head = "| figure | cases | measured | 95 % interval | target | |\n|---|---|---|---|---|---|\n"
    return head + "\n".join(_wanted_rows(results)) + "\n"


def _times(results: Results) -> str:
    lines = ["| time for | recordings | median | longest | target |", "|---|---|---|---|---|"]
    for what, most in TIMES:
        values = results.times.get(what, [])
        found = f"{np.median(values):.1f} s | {max(values):.1f} s" if values else "- | -"
        lines.append(f"| {what} | {len(values)} | {found} | <= {most:g} s |")
    return "\n".join(lines) + "\n"


# ---- the rest ----------------------------------------------------------------------------------


def _figures(results: Results, solver: str) -> str:
    """Every figure of both generators, the comparison beside it; cases in brackets."""
    columns: dict[str, list[scoring.Line]] = {}
    for source, rows in results.rows.items():
        for name, answered in ((source, rows), (solver, results.rivals.get(source, []))):
            column = name if name == source else f"{solver} ({source})"
            columns[column] = scoring.table(answered) + scoring.overall(answered)
    lines = ["| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for at in zip(*columns.values(), strict=True):
        cells = (f"{_number(n.value)} ({n.count})" if n.count else "-" for n in at)
        lines.append(f"| {at[0].what} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _all(results: Results) -> str:
    lines = [
        "| source | cases | correct | wrong name | share | 95 % interval |",
        "|---|---|---|---|---|---|",
    ]
    for source, (cases, right) in results.counts().items():
        rows = results.rows.get(source)
        wrong = "-" if rows is None else str(sum(r.wrong_name for r in rows))
        a, b = spread(right / cases, cases)
        share = _number(right / cases)
        lines.append(f"| {source} | {cases} | {right} | {wrong} | {share} | {a:.2f} to {b:.2f} |")
    return "\n".join(lines) + "\n"


def _own(results: Results) -> str:
    lines = [
        "| rig | cases | named exactly | or among equally good sets | closed loop within 3 % |",
        "|---|---|---|---|---|",
    ]
    for rig in dict.fromkeys(r.rig for r in results.own):
        rows = [r for r in results.own if r.rig == rig]
        right, among = sum(r.right for r in rows), sum(r.among for r in rows)
        closed = sum(r.closed < own_rigs.CLOSED for r in rows)
        lines.append(f"| {rig} | {len(rows)} | {right} | {among} | {closed} |")
    missed = [
        f"* {r.rig}, {r.label}: {r.verdict} {' or '.join('+'.join(s) for s in r.said) or '-'}"
        for r in results.own
        if not r.right
    ]
    return "\n".join(lines) + "\n\nNot named exactly:\n\n" + "\n".join(missed or ["* none"]) + "\n"


def _real(results: Results, solver: str) -> str:
    lines = [
        "| recording | answer | as given | known physics | target | predicted | ratio to the known "
        f"physics | {solver} | |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in results.real:
        what = "passed" if r.passed else "wrong" if not r.named else "error too large"
        lines.append(
            f"| {r.name} | {r.said} | {r.naive:.1f} | {r.known:.2f} | <= {r.limit:.2f} "
            f"| {_number(r.error)} | {_number(r.ratio)} | {_number(r.rival)} | {what} |"
        )
    lines += ["", "Known physics of these recordings, from their `answer.json`:", ""]
    lines += [f"* `{r.name}`: {r.physics}" for r in results.real]
    return "\n".join(lines) + "\n"


def _opensees(results: Results) -> str:
    lines = [
        "| material | cases | correct | wrong name | held-out error | answered instead |",
        "|---|---|---|---|---|---|",
    ]
    for name in sorted({r.material for r in results.opensees}):
        rows = [r for r in results.opensees if r.material == name]
        right, wrong = sum(r.right for r in rows), sum(r.wrong_name for r in rows)
        error = _number(float(np.nanmedian([r.error for r in rows])))
        instead = "; ".join(r.said for r in rows if not r.right) or "-"
        lines.append(f"| {name} | {len(rows)} | {right} | {wrong} | {error} | {instead} |")
    rows = results.opensees
    if rows:
        right, wrong = sum(r.right for r in rows), sum(r.wrong_name for r in rows)
        a, b = spread(right / len(rows), len(rows))
        lines.append(f"| all | {len(rows)} | {right} ({a:.2f} to {b:.2f}) | {wrong} | | |")
    return "\n".join(lines) + "\n"


def _instead(results: Results) -> str:
    lines = ["| source | truth | cases | correct | answered instead |", "|---|---|---|---|---|"]
    for source, rows in results.rows.items():
        for true, counts in sorted(scoring.confusion(rows).items()):
            wrong = ", ".join(f"{k} ({n})" for k, n in counts.most_common() if k != "right")
            if wrong:
                total = sum(counts.values())
                lines.append(f"| {source} | {true} | {total} | {counts['right']} | {wrong} |")
    return "\n".join(lines) + "\n"


def written(results: Results, state: str, solver: str) -> str:
    """The whole page; `state` says of which program, with which seed and how many cases a kind."""
    return f"""# Validation of the diagnosis

Written by `make validate-diagnosis`. {state}

Two generators produce the cases, each with its own laws, integrator, noise and criteria for what
can be identified: `tests/prove`, and `tests/validate` with coloured noise, incorrect data sheets
and other forms of the laws. Neither shares code with the program. In addition, there are virtual
tests on the shipped rigs with hidden effects, recordings of specimens that OpenSees computes, and
real recordings from other laboratories.
Each figure is based on the number of cases next to it; the 95 % interval of a share is Wilson's.
`met`: the figure meets its target, with at least twenty cases; `open`: there are too few cases to
confirm or exclude it; `missed`: the cases exclude it.

## Targets

{_wanted(results)}
{_times(results)}
## All cases

{_all(results)}
## Figures by kind

Cases in brackets. {solver}: sequentially thresholded regression (SINDy) on the same recordings.

{_figures(results, solver)}
## Effects hidden in the shipped rigs

{_own(results)}
## Real recordings

Held-out NRMSE in per cent of the standard deviation: for the model as given, for the best model of
the known physics, and for the prediction. {results.no_real}

{_real(results, solver)}
## Specimens of OpenSees

Materials of OpenSees (`openseespy`), driven by a machine or, one in three, below a body on a moving
ground, whose motion OpenSees integrates. The model has their initial stiffness alone, and the mass
and the dashpot of the body. Held-out error: median, relative to the standard deviation of the
force. {results.no_opensees}

{_opensees(results)}
## Wrong answers

{_instead(results)}"""
