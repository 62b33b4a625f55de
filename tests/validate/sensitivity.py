"""How much each threshold of the table matters: every one moved, answers counted that change.

    python tests/validate/sensitivity.py [--seed 20261] [--count 10] [--page docs/...md]
                                         [--rows | --unmeasured]

Cases of both generators in turn. Each is diagnosed in this process once. Where the diagnosis reads
a threshold for the first time, the process forks: a child goes on from there with 0.7 times its
value, another one with 1.4 times (a whole number one less and one more), while the parent waits;
what a case does not read is not tried. So a threshold that decides at the end costs no more than
the end. Minutes a case; what was stopped goes on at the case at which it was, in --out.
--rows: nothing is diagnosed. The page gets the table as it is now; of a threshold that it has with
another value, or does not have, it says that its sensitivity has not been measured.
--unmeasured: only those thresholds are moved of which --page says so. The page keeps its other
rows, and gets theirs, each with the number of these cases that use it, when all cases are done.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prove import generate, scoring

from rthyb_rt.diagnose import engine, outcome, reading, words
from rthyb_rt.diagnose.policy import POLICY, Policy, ThresholdEntry, entries
from rthyb_rt.errors import RthybError
from validate import second
from validate.proof import PROGRAM, ROOT, digest

FACTORS = (0.7, 1.4)
KINDS = ("single", "null", "pair", "unknown", "ambiguous", "cancel")
COLUMNS = 9
UNMEASURED = ["not measured"] * 3
Value = float | int | tuple[float, ...]
Answer = dict[str, Any]
Moves = dict[str, dict[str, Answer]]


# ---- the table ---------------------------------------------------------------------------------


def moved(value: Value, factor: float) -> Value:
    """A threshold that is so many times as large; a whole number is one off, and one at least."""
    if isinstance(value, tuple):
        return tuple(factor * v for v in value)
    if isinstance(value, int):
        return max(value + (1 if factor > 1.0 else -1), 1)
    return factor * value


class Tried(Policy):
    """The table that forks where an entry is read for the first time.

    Class attributes:
        waiting: entries that have not been read.
        found: what came of each that has, by factor.
        end: where a child writes its answer to; None in the parent.
    """

    waiting: ClassVar[set[str]] = set()
    found: ClassVar[Moves] = {}
    end: ClassVar[int | None] = None

    def __getattribute__(self, name: str) -> Any:
        if name in Tried.waiting:
            Tried.waiting.discard(name)
            value = super().__getattribute__(name)
            Tried.found[name] = {}
            for factor in FACTORS:
                read, write = os.pipe()
                if (child := os.fork()) == 0:
                    Tried.waiting, Tried.end = set(), write
                    object.__setattr__(self, name, moved(value, factor))
                    break
                os.close(write)
                with os.fdopen(read) as said:
                    Tried.found[name][str(factor)] = json.loads(said.read() or _NOTHING)
                os.waitpid(child, 0)
        return super().__getattribute__(name)


_NOTHING = '{"verdict": "failed", "error": "no answer"}'


def tried(ask: Callable[[], Answer], names: set[str]) -> tuple[Answer, Moves]:
    """An answer with the table as it is, and those with each entry moved that it has read."""
    Tried.waiting, Tried.found = set(names), {}
    object.__setattr__(POLICY, "__class__", Tried)
    try:
        answer = ask()
    except (RthybError, ValueError, ArithmeticError, LookupError) as error:
        # Also what a law far from where it was meant to be runs into.
        answer = {"verdict": "failed", "error": f"{type(error).__name__}: {error}"}
    except BaseException:
        if Tried.end is not None:
            os._exit(1)
        raise
    finally:
        object.__setattr__(POLICY, "__class__", Policy)
    if Tried.end is not None:
        with os.fdopen(Tried.end, "w") as told:
            told.write(json.dumps(answer, default=float))
        os._exit(0)
    # As a child's has come, rounded by nothing but JSON.
    return json.loads(json.dumps(answer, default=float)), Tried.found


# ---- one case ----------------------------------------------------------------------------------


def answered(folder: Path) -> Answer:
    """The answer to one case, and the sentence for it."""
    model = reading.read_model(folder / "baseline.toml")
    found = engine.diagnose(reading.read_case(folder / "recording.csv", model))
    done = outcome.finish(found, None, None).answer
    return {**done, "sentence": words.sentence(found, done)}


def decided(answer: Answer) -> str:
    """What of an answer names something: the verdict, the effects, what fits alike."""
    sets = sorted(sorted(s) for s in answer.get("ambiguous_with") or ())
    return json.dumps([answer["verdict"], sorted(answer.get("effects") or ()), sets])


def compared(folder: Path, what: str, names: set[str]) -> dict[str, Any]:
    """What came of one case with each of these thresholds moved."""
    began = time.monotonic()
    plain, found = tried(lambda: answered(folder), names)
    right: dict[str, bool] = {}

    def judged(answer: Answer) -> bool:
        key = decided(answer)
        if key not in right:
            right[key] = scoring.score(folder, answer, None).right
        return right[key]

    rows = {
        name: {
            factor: {
                "changed": decided(now) != decided(plain), "right": judged(now),
                "same": json.dumps(now) == json.dumps(plain), "verdict": now["verdict"],
            }
            for factor, now in answers.items()
        }
        for name, answers in found.items()
    }  # fmt: skip
    return {
        "what": what, "right": judged(plain), "verdict": plain["verdict"], "entries": rows,
        "names": sorted(names), "seconds": time.monotonic() - began,
    }  # fmt: skip


# ---- all cases, the page -----------------------------------------------------------------------


def cases(seed: int, count: int, out: Path) -> Iterator[tuple[str, Path]]:
    """Which kind of which generator, and the folder, of each case: the generators take turns."""
    for i in range(count):
        number, kind = divmod(i // 2, len(KINDS))
        kind = KINDS[kind]
        if i % 2 == 0:
            folder = out / "first" / kind
            names = [n for n, _ in generate.generate(seed, number + 1, folder, [kind], jobs=1)]
            yield f"first generator, {kind}", folder / sorted(names)[number]
        else:
            level = second.LEVELS[i // 2 % len(second.LEVELS)]
            *_, last = second.generate(kind, level, seed, number + 1, out / "second")
            yield f"second generator, {kind} (level: {level})", last


def cell(rows: list[tuple[bool, dict[str, Any]]]) -> str:
    """What a threshold's move did to some cases, each with whether it was right before."""
    changed = [(before, r) for before, r in rows if r["changed"]]
    lost = sum(before and not r["right"] for before, r in changed)
    won = sum(r["right"] and not before for before, r in changed)
    numbers = sum(not r["changed"] and not r["same"] for _, r in rows)
    said = str(len(changed))
    if lost or won:
        said += f" ({', '.join(f'{n} {w}' for n, w in ((lost, 'lost'), (won, 'corrected')) if n)})"
    return f"{said}; {numbers}" if numbers else said


def value_text(value: Value) -> str:
    """A value as it stands in the table."""
    if isinstance(value, tuple):
        return ", ".join(f"{v:g}" for v in value)
    return f"{value:g}"


def row_of(name: str, entry: ThresholdEntry, measured: list[str]) -> str:
    """One row of the page: what the table says of a threshold, then what was measured."""
    parts = [
        f"`{name}`", value_text(getattr(POLICY, name)), entry.unit, entry.origin,
        entry.meaning, entry.basis, *measured,
    ]  # fmt: skip
    return f"| {' | '.join(p.replace('|', chr(92) + '|') for p in parts)} |"


def line(name: str, entry: ThresholdEntry, results: list[dict[str, Any]]) -> str:
    """One row of the page as these cases have it."""
    read = [(r["right"], r["entries"][name]) for r in results if name in r["entries"]]
    moves = [
        cell([(before, row[str(f)]) for before, row in read]) if read else "–" for f in FACTORS
    ]
    return row_of(name, entry, [str(len(read)), *moves])


def with_rows(page: str) -> str:
    """A page with the rows of the table as it is now, and what was measured of each.

    What was measured of a threshold with another value says nothing of the one it has now.
    """
    known, text, first = measured_before(page)
    rows = [row_of(n, e, told_of(known, n)) for n, e in entries().items()]
    return "\n".join([*text[:first], *rows, *text[first:]]) + "\n"


def measured_before(page: str) -> tuple[dict[tuple[str, str], list[str]], list[str], int]:
    """What a page says was measured, by threshold and value; its other lines; its first row."""
    known: dict[tuple[str, str], list[str]] = {}
    text, first = [], 0
    for old in page.splitlines():
        cells = [c.strip() for c in re.split(r"(?<!\\)\|", old)[1:-1]]
        if len(cells) == COLUMNS and cells[0].startswith("`"):
            known[cells[0].strip("`"), cells[1]] = cells[-3:]
            first = first or len(text)
        else:
            text.append(old)
    return known, text, first


def told_of(known: dict[tuple[str, str], list[str]], name: str) -> list[str]:
    """What was measured of a threshold with its present value."""
    return known.get((name, value_text(getattr(POLICY, name))), UNMEASURED)


def unmeasured(page: str) -> set[str]:
    """The thresholds of whose present value a page says that nothing has been measured."""
    known, *_ = measured_before(page)
    at = {n: told_of(known, n) for n in entries()}
    return {n for n, told in at.items() if told == UNMEASURED}


def with_measured(page: str, results: list[dict[str, Any]], seed: int, state: str) -> str:
    """A page with rows for the thresholds that it lacked, and on which cases they were measured."""
    known, text, first = measured_before(page)
    new = set(results[0]["names"])
    rows = [
        line(n, e, results) if n in new
        else row_of(n, e, told_of(known, n))
        for n, e in entries().items()
    ]  # fmt: skip
    right = sum(r["right"] for r in results)
    runs = sum(len(row) for r in results for row in r["entries"].values())
    said = (
        f"{', '.join(f'`{n}`' for n in entries() if n in new)} were measured later, with "
        f"{len(results)} other cases of both generators, {right} of them answered correctly (state "
        f"`{state}`, seed {seed}): {runs} diagnoses."
    )
    return "\n".join([*text[:first], *rows, *text[first:], "", *wrapped(said)]) + "\n"


def wrapped(said: str) -> list[str]:
    """A paragraph of the page."""
    return textwrap.wrap(said, 100, break_long_words=False, break_on_hyphens=False)


def written(results: list[dict[str, Any]], seed: int, state: str) -> str:
    """The page."""
    lines = [line(name, entry, results) for name, entry in entries().items()]
    said = [f"| {r['what']} | {'right' if r['right'] else 'wrong'} | {r['verdict']} |"
            for r in results]  # fmt: skip
    runs = sum(len(row) for r in results for row in r["entries"].values())
    changed = sum(m["changed"] for r in results for row in r["entries"].values()
                  for m in row.values())  # fmt: skip
    rows, kinds = "\n".join(lines), "\n".join(said)
    right = sum(r["right"] for r in results)
    return f"""# Thresholds of the diagnosis

Written by `make validate-policy`. State of the program: `{state}` (hash of its sources),
seed {seed}.

All thresholds that determine the answer are in one frozen table, `rthyb_rt/diagnose/policy.py`.
Their origin is "physics" (sensors, the interchange format or the statistics of noise), "numerics"
(the accuracy of computed motions and forces), "calibrated" (found on the recordings named) or
"judgement" (chosen by the authors).

The sensitivity was determined with only {len(results)} cases: a threshold that changes no answer
here may still matter in other cases, especially if few of these cases use it. The cases are listed
below; {right} of them are answered correctly. Each was diagnosed again with each threshold that it
uses at 0.7 and 1.4 times its value (integers: one less and one more): {runs} diagnoses, {changed}
with another verdict or other effects. The last two columns give the number of these changed
answers; in parentheses, how many correct ones were lost or wrong ones corrected; after the
semicolon, the answers in which only numbers change (parameters, intervals, time windows, errors).
A dash: no case uses the threshold. "Not measured": the threshold, or its value, is newer than these
figures.

| threshold | value | unit | origin | decides | basis | used in | × 0.7 | × 1.4 |
|---|---|---|---|---|---|---|---|---|
{rows}

| case | answer | verdict |
|---|---|---|
{kinds}
"""


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=20261)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "policy")
    parser.add_argument("--page", type=Path)
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--rows", action="store_true", help="only the rows of --page, unmeasured")
    how.add_argument("--unmeasured", action="store_true", help="only what --page has not measured")
    return parser.parse_args()


def main() -> int:
    args = options()
    before = args.page.read_text() if args.page and args.page.exists() else ""
    if args.rows and args.page:
        args.page.write_text(with_rows(before))
        return 0
    names = unmeasured(before) if args.unmeasured else set(entries())
    state = digest(*PROGRAM)
    some = "moved" if len(names) == len(entries()) else "some"
    kept = args.out / f"{some}-{state}" / str(args.seed)
    kept.mkdir(parents=True, exist_ok=True)
    made = args.out / f"cases-{digest('tests/prove', 'tests/validate')[:8]}"
    results = []
    warnings.simplefilter("ignore")  # of a law far beyond where it was meant to be
    for i, (what, folder) in enumerate(cases(args.seed, args.count, made)):
        path = kept / f"{'-'.join(folder.relative_to(made).parts)}.json"
        if not path.exists():
            print(f"{i + 1} of {args.count}: {what}", file=sys.stderr, flush=True)
            with np.errstate(all="ignore"):
                made_of = json.dumps(compared(folder, what, names))
            path.write_text(made_of)
        done = json.loads(path.read_text())
        results.append(done)
        if args.page and not args.unmeasured:
            args.page.write_text(written(results, args.seed, state))
    if args.page and args.unmeasured:
        args.page.write_text(with_measured(before, results, args.seed, state))
    if not args.page:
        print(written(results, args.seed, state))
    return 0


if __name__ == "__main__":
    sys.exit(main())
