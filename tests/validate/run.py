"""The second generator's cases put to the tool, and the table of what it said, by kind.

    python tests/validate/run.py --seed 7 --count 12 --out DIR [--jobs 1] [--level normal hard]

Cases and answers stay in DIR, so that a run that was stopped goes on where it was. The tool is
called on its command line only; tests/prove/scoring.py scores. Of the misses a wrong name counts
twice, a refusal to name once.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prove import scoring

from validate import second
from validate.recipes import KINDS

ANSWER = "said.json"


@dataclass
class Scored:
    """A case as it was answered."""

    row: scoring.Row
    truth: dict[str, Any]
    said: dict[str, Any]

    @property
    def right(self) -> bool:
        """Named right in the sense of its kind; of several effects, all and no other."""
        row = self.row
        if self.truth["verdict"] == "explained":
            return bool(row.first if len(row.names) == 1 else row.exact)
        checks = (row.unknown, row.ambiguous)
        return not row.alarm and all(c for c in checks if c is not None)

    @property
    def wrong_name(self) -> bool:
        """A name was given that is not in the truth."""
        acting = self.truth["verdict"] in ("explained", "ambiguous")
        possible = set(self.row.names) if acting else set()
        possible |= {name for members in self.truth["ambiguous"] for name in members}
        return (
            not self.right
            and self.row.verdict == "explained"
            and not set(self.row.said) <= possible
        )

    @property
    def cost(self) -> int:
        return 0 if self.right else 2 if self.wrong_name else 1


def ask(tool: scoring.Tool, folder: Path) -> None:
    """The tool's answer to a case, kept beside it."""
    kept = folder / ANSWER
    if kept.exists():
        return
    began = time.monotonic()
    said, _ = tool(folder)
    kept.write_text(json.dumps({"seconds": time.monotonic() - began, "answer": said}))


def scored(folder: Path) -> Scored:
    """A case and its kept answer, scored."""
    kept = json.loads((folder / ANSWER).read_text())
    prediction = folder / "pred.csv"
    found = scoring.read_csv(prediction) if prediction.exists() else None
    row = scoring.score(folder, kept["answer"], found)
    row.seconds = kept["seconds"]
    return Scored(row, json.loads((folder / "answer.json").read_text()), kept["answer"])


def _percent(values: Iterable[bool | None]) -> str:
    share, count = scoring.share(values)
    return f"{100 * share:.0f} % of {count}" if count else "-"


def _held_out(results: list[Scored]) -> str:
    values = [r.row.reduction for r in results if r.row.reduction is not None]
    return f"{np.median(values):.3f} of {len(values)}" if values else "-"


def table(results: list[Scored]) -> str:
    """Markdown: a line for each kind and level, then what does not go by kind."""
    lines = [
        "| kind | level | cases | right | of first two | wrong name | refused | cost a case "
        "| seconds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        for level in second.LEVELS:
            here = [r for r in results if (r.truth["kind"], r.truth["tier"]) == (kind, level)]
            if not here:
                continue
            wrong = sum(r.wrong_name for r in here)
            refused = sum(not r.right and not r.wrong_name for r in here)
            lines.append(
                f"| {kind} | {level} | {len(here)} | {_percent(r.right for r in here)} "
                f"| {_percent(r.row.among_two for r in here)} | {wrong} | {refused} "
                f"| {np.mean([r.cost for r in here]):.2f} "
                f"| {np.median([r.row.seconds for r in here]):.1f} |"
            )
    errors = [e for r in results for e in r.row.errors.values()]
    covered = [c for r in results for c in r.row.covered.values()]
    plain = [r for r in results if r.truth["kind"] == "single"]
    lines += [
        "",
        f"* parameters within 10 % of the truth: {_percent(e <= 0.1 for e in errors)}",
        f"* 95 % intervals that hold the truth: {_percent(covered)}",
        f"* median reduction of the held-out error: {_held_out(results)}",
        f"* unknown, said and located: {_percent(r.row.located for r in results)}",
        f"* not separable, right next experiment: {_percent(r.row.next_right for r in results)}",
        f"* median time of an answer: {np.median([r.row.seconds for r in results]):.1f} s",
    ]
    lines += [
        f"* single, {group}: {_percent(r.right for r in plain if group in r.truth['groups'])}"
        for group in ("onset", "mid_start", "no_cell", "nan")
    ]
    decided = [r for r in results if r.truth["family"] in ("drive", "loop")]
    for what, white in (("white", True), ("coloured", False)):
        here = [r for r in decided if (r.truth["noises"]["x"]["colour"] == "white") is white]
        lines.append(f"* driven or in a loop, {what} noise on x: {_percent(r.right for r in here)}")
    return "\n".join(lines) + "\n"


def misses(results: list[Scored]) -> str:
    """What was the truth and what was said, a line for each case that was not right."""
    lines = []
    for r in results:
        if r.right:
            continue
        truth, row = r.truth, r.row
        forms = " + ".join(f"{e['name']} [{e['form']}]" for e in truth["effects"]) or "nothing"
        if truth["ambiguous"]:
            forms += f", equal: {truth['ambiguous']}"
        told = "+".join(row.said)
        if row.verdict == "ambiguous":
            told = str(r.said.get("ambiguous_with"))
        lines.append(
            f"* {row.id} ({truth['family']}, {'/'.join(truth['groups']) or 'plain'}, noise "
            f"{truth['noise']}): {forms}; said {row.verdict} {told} {row.failure[:100]}"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=12, help="cases of each kind and level")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--level", nargs="*", choices=second.LEVELS, default=["normal"])
    parser.add_argument("--jobs", type=int, default=1, help="one of them makes the cases")
    parser.add_argument("--tool", default=str(Path(sys.executable).with_name("rthyb")))
    args = parser.parse_args()
    tool = scoring.command_line([args.tool])
    wanted = [(level, kind) for level in args.level for kind in args.kinds]
    folders: list[Path] = []
    with ThreadPoolExecutor(max(args.jobs - 1, 1)) as pool:
        asked = []
        for level, kind in wanted:
            for folder in second.generate(kind, level, args.seed, args.count, args.out):
                folders.append(folder)
                asked.append(pool.submit(ask, tool, folder))
                if args.jobs == 1:
                    asked[-1].result()
                print(f"\r{len(folders)} {folder.name:<40}", end="", file=sys.stderr, flush=True)
        for one in asked:
            one.result()
    print(file=sys.stderr)
    results = [scored(f) for f in folders]
    text = table(results) + "\n## Misses\n\n" + misses(results)
    (args.out / "table.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
