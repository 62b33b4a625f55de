"""The proof of the diagnosis: fresh concealed cases, the tool's answers, the table in docs/.

    python tests/prove/prove.py [--count 320] [--jobs 2] [--out docs/diagnosis-proof.md]

The seed is the hash of the tracked trees of the diagnosis and the core: a change of either brings
other cases. The tool is called on its command line only.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prove import generate, scoring, stlsq

ROOT = Path(__file__).resolve().parents[2]
TREES = ("rthyb_rt/diagnose", "csrc")


def tree_hash() -> str:
    """SHA-256 of what git tracks under the diagnosis and the core: modes, blobs and paths."""
    call = ["git", "ls-files", "-s", *TREES]
    listed = subprocess.run(call, cwd=ROOT, capture_output=True, check=True).stdout
    if not listed:
        raise SystemExit(f"git tracks no file under {' or '.join(TREES)}")
    return hashlib.sha256(listed).hexdigest()


def changed() -> bool:
    """Whether those trees differ from what git tracks: the table then names no published state."""
    call = ["git", "status", "--porcelain", *TREES]
    return bool(subprocess.run(call, cwd=ROOT, capture_output=True, check=True).stdout)


def ask(tool: scoring.Tool, folders: list[Path], jobs: int, what: str) -> list[scoring.Row]:
    """Every case put to the tool, answers scored in the order of the folders."""

    def one(folder: Path) -> scoring.Row:
        began = time.monotonic()
        said, prediction = tool(folder)
        seconds = time.monotonic() - began
        row = scoring.score(folder, said, prediction)
        row.seconds = seconds
        scoring.resolve(row, tool, folder, said)
        return row

    rows = []
    with ThreadPoolExecutor(jobs) as pool:
        for i, row in enumerate(pool.map(one, folders), 1):
            rows.append(row)
            print(f"\r{what} {i}/{len(folders)} {row.id:<14}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return rows


def recordings(tool: scoring.Tool, folder: Path) -> str:
    """Held-out errors on the real recordings under `folder`, one line each; '' without any."""
    lines, physics = [], []
    for case in sorted(p.parent for p in folder.glob("*/answer.json")):
        known = json.loads((case / "answer.json").read_text())
        if "nrmse_heldout_known" not in known:
            continue
        with tempfile.TemporaryDirectory() as copy:
            said, prediction = tool(Path(shutil.copytree(case, Path(copy) / case.name)))
        channel = "x" if "channel x" in known["metric"] else "f"
        first = int(known["metric"].split("rows from ")[1].split()[0])
        held = scoring.read_csv(case / "heldout.csv")
        true = held[f"{channel}_meas"][first:]
        error = float("nan")
        if prediction is not None and prediction[channel].size == first + true.size:
            miss = prediction[channel][first:] - true
            error = 100 * float(np.sqrt(np.nanmean(miss**2)) / np.nanstd(true))
        effects = ", ".join(said.get("effects") or []) or "-"
        lines.append(
            f"| {case.name} | {said.get('verdict')}: {effects} "
            f"| {known['nrmse_heldout_naive']:.1f} | {known['nrmse_heldout_known']:.2f} "
            f"| {error:.2f} |"
        )
        physics.append(f"* `{case.name}`: {known['known_model']}")
    if not lines:
        return ""
    head = (
        "## Real recordings\n\n"
        "Held-out NRMSE in per cent of the standard deviation: of the model as given, of the best "
        "model\nof the known physics, and of what the diagnosis predicts.\n\n"
        "| recording | answer | as given | known physics | predicted |\n"
        "|---|---|---|---|---|\n"
    )
    known_physics = "\n\nWhat is known of them, from their `answer.json`:\n\n" + "\n".join(physics)
    return head + "\n".join(lines) + known_physics + "\n"


def page(
    digest: str, seed: int, folders: list[Path], results: dict[str, list[scoring.Row]], real: str
) -> str:
    """The document that the proof leaves behind."""
    answers = [json.loads((f / "answer.json").read_text()) for f in folders]
    kinds = Counter(a["kind"] for a in answers)
    families = Counter(a["family"] for a in answers)
    noises = Counter(a["noise"] for a in answers)
    rows = next(iter(results.values()))
    seconds = sorted(r.seconds for r in rows)
    state = " The trees have changes that are not committed." if changed() else ""

    def listed(counts: Counter[str]) -> str:
        return ", ".join(f"{n} {k}" for k, n in counts.most_common())

    return f"""# Proof of the diagnosis

Written by `make prove`. Cases are drawn anew for every state of the program: hash of the tracked
diagnosis and core trees `{digest[:16]}`, seed {seed}.{state}

{len(folders)} cases: {listed(kinds)}; {listed(families)}; noise {listed(noises)}.
The generator (`tests/prove`) shares no force law, integrator or parameter convention with the
program; it simulates at 16 steps a sample and judges by regression, before a case is used, that its
answer can be known. Median time of an answer {seconds[len(seconds) // 2]:.1f} s.

{scoring.markdown(results)}
{real}"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=320)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, help="instead of the hash, to look at other cases")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "diagnosis-proof.md")
    parser.add_argument("--keep", type=Path, help="folder for the cases and answers")
    parser.add_argument("--tool", default=str(Path(sys.executable).with_name("rthyb")))
    parser.add_argument("--kinds", nargs="*")
    parser.add_argument("--recordings", type=Path, default=ROOT / "tests" / "data" / "diagnosis")
    args = parser.parse_args()
    digest = tree_hash()
    seed = args.seed if args.seed is not None else int(digest[:8], 16)
    with tempfile.TemporaryDirectory() as scratch:
        out = args.keep or Path(scratch)
        for i, (name, _) in enumerate(
            generate.generate(seed, args.count, out, args.kinds, args.jobs), 1
        ):
            print(f"\rcases {i}/{args.count} {name:<14}", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)
        folders = sorted(p.parent for p in out.glob(f"p{seed % 100000:05d}_*/answer.json"))
        tool = scoring.command_line([args.tool])
        results = {"rthyb": ask(tool, folders, args.jobs, "rthyb")}
        results[stlsq.SOLVER] = ask(stlsq.diagnose, folders, 1, stlsq.SOLVER)
        real = recordings(tool, args.recordings)
        text = page(digest, seed, folders, results, real)
        if args.keep:
            lines = [json.dumps(r.__dict__, default=str) for r in results["rthyb"]]
            (out / "answers.jsonl").write_text("\n".join(lines) + "\n")
    args.out.write_text(text)
    print(text)
    failed = [r for r in results["rthyb"] if r.verdict == "failed"]
    if failed:
        print(f"{len(failed)} cases without an answer, first: {failed[0].failure}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
