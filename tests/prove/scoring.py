"""Answers of a tool beside the truth: the table of the proof and its confusion table."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Answer = dict[str, Any]
Prediction = dict[str, np.ndarray] | None
Tool = Callable[[Path], tuple[Answer, Prediction]]

LOCAL = 0.6  # an effect acts locally if its windows cover less than this of the recording
LOCATED = 0.5  # IoU from which an unknown effect counts as located
WORTH = 0.02  # held-out error of the base model from which its reduction can be asked for


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file by name; empty fields are NaN."""
    with path.open() as file:
        names = next(csv.reader(file))
    table = np.genfromtxt(path, delimiter=",", skip_header=1, ndmin=2)
    return {n.strip(): table[:, i] for i, n in enumerate(names)}


# ---- tools -------------------------------------------------------------------------------------


def said_by(call: list[str], seconds: float) -> Answer:
    """What a command prints as JSON. Anything else counts as an answer without a verdict."""
    try:
        done = subprocess.run(call, capture_output=True, text=True, timeout=seconds, check=False)
        return dict(json.loads(done.stdout))
    except subprocess.TimeoutExpired:
        return {"verdict": "failed", "error": f"no answer in {seconds:.0f} s"}
    except json.JSONDecodeError:
        told = (done.stderr or done.stdout)[-800:]
        return {"verdict": "failed", "error": f"exit {done.returncode}: {told}"}


def command_line(program: list[str], seconds: float = 300.0) -> Tool:
    """The tool as a stranger calls it."""

    def run(folder: Path) -> tuple[Answer, Prediction]:
        out = folder / "pred.csv"
        out.unlink(missing_ok=True)
        call = [*program, "diagnose", str(folder / "recording.csv")]
        call += ["--model", str(folder / "baseline.toml"), "--json"]
        if (folder / "heldout_input.csv").exists():
            call += ["--predict", str(folder / "heldout_input.csv"), "--out", str(out)]
        return said_by(call, seconds), read_csv(out) if out.exists() else None

    return run


class Said(NamedTuple):
    """An answer, its prediction, and the time that it took."""

    answer: Answer
    prediction: Prediction
    seconds: float


def kept(tool: Tool, label: str) -> Callable[[Path], Said]:
    """The tool with its answers kept beside the cases, under a label for the state of the tool."""

    def ask(folder: Path) -> Said:
        answer, table = folder / f"{label}.json", folder / f"{label}.csv"
        if not answer.exists():
            began = time.monotonic()
            said, found = tool(folder)
            seconds = time.monotonic() - began
            if found is not None:
                rows = np.column_stack(list(found.values()))
                np.savetxt(table, rows, "%.9g", ",", header=",".join(found), comments="")
            done = json.dumps({"seconds": seconds, "answer": said}, default=float)
            answer.write_text(done)  # last: what was stopped before is asked again
        told = json.loads(answer.read_text())
        return Said(told["answer"], read_csv(table) if table.exists() else None, told["seconds"])

    return ask


def oracle(folder: Path) -> tuple[Answer, Prediction]:
    """The truth handed back in the tool's words: every score of it must be perfect."""
    if folder.name.startswith("next_"):
        a = json.loads((folder.parent / "answer.json").read_text())
        return {"verdict": "explained", "effects": [e["name"] for e in a["effects"]]}, None
    a = json.loads((folder / "answer.json").read_text())
    effects = a["effects"] if told(a) else []
    sets = [list(s) for s in sorted(map(sorted, true_sets(a)))]
    candidates = [
        {
            "name": e["name"],
            "params": e["params"],
            "ci95": {k: [v - abs(v) * 0.01, v + abs(v) * 0.01] for k, v in e["params"].items()},
        }
        for e in effects
    ]
    answer = {
        "schema": "rthyb-diagnose/1",
        "verdict": a["verdict"],
        "effects": [e["name"] for e in effects],
        "candidates": candidates,
        "ambiguous_with": sets if a["verdict"] == "ambiguous" else [],
        "localisation": {
            "channel": a["effects"][0]["channel"] if a["effects"] else "force",
            "time_windows": [w for e in a["effects"] for w in e["windows"]],
        },
        "next_experiment": {"kind": a["next_experiment"][0]} if a["next_experiment"] else None,
    }
    truth = read_csv(folder / "heldout_truth.csv")
    return answer, {n: truth[n] for n in ("t", "f", "x")}


# ---- one case ----------------------------------------------------------------------------------


@dataclass
class Row:
    """What one answer was worth. None: the question does not arise for this case."""

    id: str
    kind: str
    family: str
    names: tuple[str, ...]
    groups: tuple[str, ...]
    verdict: str
    said: tuple[str, ...]
    first: bool | None = None
    among_two: bool | None = None
    exact: bool | None = None
    alarm: bool | None = None
    unknown: bool | None = None
    located: bool | None = None
    ambiguous: bool | None = None
    next_right: bool | None = None
    resolved: bool | None = None
    errors: dict[str, float] = field(default_factory=dict)
    covered: dict[str, bool] = field(default_factory=dict)
    reduction: float | None = None
    iou: float | None = None
    failure: str = ""
    possible: frozenset[str] = frozenset()  # names that no one could call wrong

    @property
    def right(self) -> bool:
        """Named right in the sense of its kind."""
        checks = (self.first if len(self.names) == 1 else self.exact, self.unknown, self.ambiguous)
        return all(c for c in checks if c is not None) and not self.alarm

    @property
    def wrong_name(self) -> bool:
        """A name was given that is not in the truth."""
        named = self.verdict == "explained" and not set(self.said) <= self.possible
        return named and not self.right

    @property
    def cost(self) -> int:
        """A wrong name counts twice, a refusal to name or a set that lacks one once."""
        return 0 if self.right else 2 if self.wrong_name else 1


def true_sets(answer: Answer) -> set[frozenset[str]]:
    """`ambiguous` of an answer as sets: plain names are sets of one."""
    return {frozenset([s] if isinstance(s, str) else s) for s in answer["ambiguous"]}


def told(truth: Answer) -> bool:
    """Whether its effects can be named: not where they never act, or are in no catalogue."""
    return truth["verdict"] in ("explained", "ambiguous")


def overlap(a: Iterable[Iterable[float]], b: Iterable[Iterable[float]]) -> float:
    """Intersection over union of two lists of [start, end], s."""

    def union(spans: Iterable[Iterable[float]]) -> list[tuple[float, float]]:
        out: list[tuple[float, float]] = []
        for p, q in sorted((float(p), float(q)) for p, q in spans):
            if out and p <= out[-1][1]:
                out[-1] = (out[-1][0], max(out[-1][1], q))
            else:
                out.append((p, q))
        return out

    one, two = union(a), union(b)
    total = sum(q - p for p, q in one) + sum(q - p for p, q in two)
    common = sum(max(0.0, min(q, s) - max(p, r)) for p, q in one for r, s in two)
    return common / (total - common) if total > common else 0.0


def score(folder: Path, said: Answer, prediction: Prediction) -> Row:
    """Compare an answer with the truth of the case in `folder`."""
    truth = json.loads((folder / "answer.json").read_text())
    effects = truth["effects"]
    names = tuple(e["name"] for e in effects)
    verdict = str(said.get("verdict", "failed"))
    named = tuple(said.get("effects") or ())
    ranked = [c.get("name") for c in said.get("candidates") or []]
    place = said.get("localisation") or {}
    row = Row(
        folder.name, truth["kind"], truth["family"], names, tuple(truth.get("groups", ())), verdict,
        named, failure=str(said.get("error", "")),
        possible=frozenset().union(*true_sets(truth), names if told(truth) else ()),
    )  # fmt: skip
    if truth["verdict"] == "none":
        row.alarm = verdict != "none"
    elif truth["verdict"] == "unknown":
        row.unknown = verdict == "unknown" and not named
    elif truth["verdict"] == "ambiguous":
        sets = {frozenset(s) for s in said.get("ambiguous_with") or ()}
        row.ambiguous = verdict == "ambiguous" and sets == true_sets(truth)
        kind = (said.get("next_experiment") or {}).get("kind")
        row.next_right = verdict == "ambiguous" and kind in truth["next_experiment"]
    else:
        _score_explained(row, truth, said, verdict, named, ranked)
        row.reduction = reduction(folder, truth, prediction)
    if effects and truth["verdict"] in ("explained", "unknown"):
        windows = [w for e in effects for w in e["windows"]]
        iou = overlap(windows, place.get("time_windows") or [])
        channel = {e["channel"] for e in effects}
        if row.unknown is not None:
            row.located = bool(row.unknown) and place.get("channel") in channel and iou >= LOCATED
        if covered_share(folder, windows) < LOCAL and row.right:
            row.iou = iou
    return row


def covered_share(folder: Path, windows: list[list[float]]) -> float:
    """How much of the recording the windows cover."""
    total = sum(q - p for p, q in windows)
    with (folder / "recording.csv").open("rb") as file:
        file.seek(-min(400, file.seek(0, 2)), 2)
        last = float(file.read().splitlines()[-1].split(b",")[0])
    return total / last


def _score_explained(
    row: Row, truth: Answer, said: Answer, verdict: str, named: tuple[str, ...], ranked: list[Any]
) -> None:
    true_names = set(row.names)
    if len(true_names) == 1:
        (name,) = true_names
        row.first = verdict == "explained" and ranked[:1] == [name] and name in named
        row.among_two = verdict in ("explained", "ambiguous") and name in ranked[:2]
    row.exact = verdict == "explained" and set(named) == true_names
    by_name = {c.get("name"): c for c in reversed(said.get("candidates") or [])}
    for effect in truth["effects"]:
        candidate = by_name.get(effect["name"])
        if candidate is None or effect["name"] not in named:
            continue
        for key in effect.get("scored", effect["params"]):
            true = effect["params"][key]
            found = (candidate.get("params") or {}).get(key)
            label = f"{effect['name']}.{key}"
            if found is None:
                row.errors[label] = math.inf
                continue
            size = abs(true - 1) if key == "gain" else abs(true)
            row.errors[label] = abs(found - true) / size
            interval = (candidate.get("ci95") or {}).get(key)
            if interval:
                row.covered[label] = interval[0] <= true <= interval[1]


def resolve(row: Row, tool: Tool, folder: Path, said: Answer) -> None:
    """Have the tool look at the experiment that it asked for, where that one separates."""
    if row.kind != "ambiguous" or not any(folder.glob("next_*")):
        return
    follow = folder / f"next_{(said.get('next_experiment') or {}).get('kind')}"
    row.resolved = False
    if row.next_right and follow.is_dir():
        then, _ = tool(follow)
        row.resolved = then.get("verdict") == "explained" and then.get("effects") == list(row.names)


def reduction(folder: Path, truth: Answer, prediction: Prediction) -> float | None:
    """Share of the base model's held-out error that the answer took away, worst channel first.

    A free motion is judged by its displacement, else every channel with an effect. Rounding leaves
    nothing to reduce, and an error below WORTH is inside the tolerances.
    """
    held = read_csv(folder / "heldout_truth.csv")
    if truth["family"] in ("ground", "forced") and truth["effects"][0]["name"] not in _CELL:
        channels = {"disp"}
    else:
        channels = {e["channel"] for e in truth["effects"] if e["name"] != "quantisation"}
    results = []
    for channel in channels:
        column = {"force": "f", "disp": "x"}[channel]
        true, base = held[column], held[f"{column}_base"]
        before = math.sqrt(float(np.mean((base - true) ** 2))) / float(np.std(true))
        if before < WORTH:
            continue
        guess = None if prediction is None else prediction.get(column)
        if guess is None or guess.size != true.size:
            results.append(0.0)
            continue
        after = math.sqrt(float(np.nanmean((guess - true) ** 2))) / float(np.std(true))
        results.append(1 - after / before if np.isfinite(after) else -1.0)
    return min(results) if results else None


_CELL = ("bias", "drift", "hum", "time_skew", "crosstalk", "quantisation")


# ---- the table ---------------------------------------------------------------------------------


def share(values: Iterable[bool | None]) -> tuple[float, int]:
    known = [bool(v) for v in values if v is not None]
    return (sum(known) / len(known) if known else math.nan), len(known)


@dataclass
class Line:
    """A figure and the number of cases that it rests on; `is_share`: counted, not averaged."""

    what: str
    value: float
    count: int
    is_share: bool = True


def table(rows: list[Row]) -> list[Line]:
    """Every figure of a set of answers."""
    by: dict[str, list[Row]] = defaultdict(list)
    for r in rows:
        by[r.kind].append(r)
    plain = [r for r in by["single"] if not r.groups or set(r.groups) <= {"nan"}]
    quiet = by["null"] + by["dormant"]
    special = [r for r in by["single"] if set(r.groups) & {"no_cell", "faint", "onset"}]

    def line(what: str, values: Iterable[bool | None]) -> Line:
        return Line(what, *share(values))

    def mean(what: str, values: Iterable[float | None], of: Callable[..., float]) -> Line:
        known = [v for v in values if v is not None]
        return Line(what, float(of(known)) if known else math.nan, len(known), False)

    lines = [
        line("single effect, correct name first", (r.first for r in plain)),
        line("single effect, correct name among first two", (r.among_two for r in plain)),
        line("single effect, exact set", (r.exact for r in plain)),
        line("pairs, exact set", (r.exact for r in by["pair"])),
        line("triples, exact set", (r.exact for r in by["triple"])),
        line("cancelling pairs, exact set", (r.exact for r in by["cancel"])),
        line("false alarms with a correct model", (r.alarm for r in by["null"])),
        line("false alarms with a channel offset of 0.1 ms",
             (r.alarm for r in quiet if "offset" in r.groups)),
        line("false alarms with an effect that never acts", (r.alarm for r in by["dormant"])),
        line("outside the catalogue: reported as unknown", (r.unknown for r in by["unknown"])),
        line("outside the catalogue: reported and located", (r.located for r in by["unknown"])),
        line("not separable: reported with all candidates", (r.ambiguous for r in by["ambiguous"])),
        line("not separable: correct next experiment", (r.next_right for r in by["ambiguous"])),
        line(
            "not separable: resolved by that experiment",
            (r.resolved for r in by["ambiguous"]),
        ),
        line("parameters within 10 % of the true value",
             (e <= 0.1 for r in rows for e in r.errors.values())),
        line("95 % intervals that contain the true value",
             (c for r in rows for c in r.covered.values())),
        mean("median reduction of the held-out error", (r.reduction for r in rows), np.median),
        mean("mean IoU of time windows, local effects", (r.iou for r in rows), np.mean),
    ]  # fmt: skip
    for group, what in (
        ("no_cell", "base-driven without load cell, correctly named"),
        ("faint", "share of the signal under 1 %, correctly named"),
        ("onset", "onset during the recording, correctly named"),
    ):
        lines.append(line(what, (r.first for r in special if group in r.groups)))
    return lines


def overall(rows: list[Row]) -> list[Line]:
    """What does not go by kind."""
    return [
        Line("all cases, judged by the criterion for their kind", *share(r.right for r in rows)),
        Line("all cases, wrongly named", *share(r.wrong_name for r in rows)),
        Line("cost of a case: wrong name 2, refusal 1",
             float(np.mean([r.cost for r in rows])) if rows else math.nan, len(rows), False),
    ]  # fmt: skip


SETS = {"pair": "a pair", "cancel": "a cancelling pair", "triple": "three effects"}


def confusion(rows: list[Row]) -> dict[str, Counter[str]]:
    """For each true answer: how often what was said. Right answers are counted as 'right'."""
    out: dict[str, Counter[str]] = defaultdict(Counter)
    for r in rows:
        true = {"null": "nothing", "dormant": "dormant"}.get(r.kind) or "+".join(sorted(r.names))
        if r.kind in ("ambiguous", "unknown"):
            true = f"{r.kind}: {true}"
        true = SETS.get(r.kind, true)
        said = "right" if r.right else "+".join(r.said) or r.verdict
        if not r.right and r.verdict == "ambiguous":
            said = "ambiguous"
        if r.kind in SETS and not r.right:
            said = _set_fault(r)
        out[true][said] += 1
    return out


def _set_fault(r: Row) -> str:
    """How a set of effects is wrong."""
    missed, extra = set(r.names) - set(r.said), set(r.said) - set(r.names)
    if r.verdict != "explained":
        return r.verdict
    if missed and extra:
        return "other"
    return "not all of them" if missed else "one more"
