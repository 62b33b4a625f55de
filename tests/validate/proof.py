"""The proof of the diagnosis: its sources of cases, and the page in docs/ that it writes.

    python tests/validate/proof.py [--seed 7] [--count 60] [--jobs 2] [--page docs/...md]
        [--sources times first second own real opensees] [--kinds single pair]
        [--level normal hard] [--kept]

Cases stay in --out under the hash of what makes them, answers beside them under the hash of the
program: a run that was stopped goes on, and a changed program is asked anew. Without a seed that
hash gives it, so that a changed program gets other cases. The tool is called on its command line
only. --short: a fixed few cases, held against what the page says. --kept: the page of what has been
answered so far, for a run that was stopped; its cases come kind by kind, so that the last kinds may
have fewer.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prove import generate, plans, scoring, stlsq

from validate import (
    opensees,
    opensees_materials,
    opensees_scored,
    own_rigs,
    page,
    real,
    recipes,
    second,
    timed,
)

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "diagnosis-proof.md"
OPEN = ROOT.parent / "shared" / "diagnosis" / "real-open"
SHIPPED = ROOT / "tests" / "data" / "diagnosis"
SOURCES = ("times", "first", "second", "own", "real", "opensees")
SHORT_SEED = 20260
SHORT: dict[str, tuple[str, ...]] = {
    "first": ("single", "pair", "cancel", "null", "onset"),
    "second": ("single", "null", "dormant", "unknown"),
    "own": ("single",),
}
"""Kinds of the short run by source, one case of each (in the shipped rigs, of each rig): what takes
two processors two minutes. Of the second generator the normal level alone: of so few cases at a
share of a half no floor is left."""
PROGRAM = ("rthyb_rt", "csrc")
LOOKING_ON = (
    "opensees_scored.py", "page.py", "proof.py", "real.py", "scoring.py", "sensitivity.py",
    "stlsq.py",
)  # fmt: skip
"""Of the folders of the generators, what makes no case."""
REPEATS = 5
"""Recordings of each sort whose answers are timed, at most; before all others, one at a time."""


def digest(*trees: str) -> str:
    """SHA-256 of the sources under these folders as they are on the disk, eight bytes of it."""
    made = hashlib.sha256()
    for tree in trees:
        for path in sorted((ROOT / tree).rglob("*")):
            if path.suffix in (".py", ".c", ".h") and path.name not in LOOKING_ON:
                made.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return made.hexdigest()[:16]


class Proof:
    """One run: where it keeps its cases, how many it makes, and whom it asks."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.state = digest(*PROGRAM)
        self.seed = int(self.state[:8], 16) if args.seed is None else args.seed
        self.cases = digest("tests/prove", "tests/validate")[:8]
        self.tool = scoring.kept(scoring.command_line([args.tool]), f"said-{self.state}")
        self.repeats = min(REPEATS, args.count)
        rival = hashlib.sha256(Path(stlsq.__file__).read_bytes()).hexdigest()[:8]
        self.own_tool = scoring.kept(own_rigs.tool(args.tool), f"said-{self.state}")
        self.rival = scoring.kept(self._tried, f"{stlsq.SOLVER.replace(' ', '-')}-{rival}")

    @staticmethod
    def _tried(folder: Path) -> tuple[scoring.Answer, scoring.Prediction]:
        try:
            with warnings.catch_warnings():  # it says where it takes every term out
                warnings.simplefilter("ignore")
                return stlsq.diagnose(folder)
        except (KeyError, ValueError, np.linalg.LinAlgError) as error:
            return {"verdict": "failed", "error": str(error)}, None

    def folder(self, source: str) -> Path:
        return Path(self.args.out) / f"{source}-{self.cases}" / str(self.seed)

    def ask(
        self,
        folders: Iterable[Path],
        what: str,
        asked: Callable[[Path], scoring.Said] | None = None,
    ) -> list[Path]:
        """Have every case answered while the next ones are made; return their folders."""
        asked = asked or self.tool
        done: list[Path] = []
        with ThreadPoolExecutor(self.args.jobs) as pool:
            waiting = []
            for folder in folders:
                done.append(folder)
                waiting.append(pool.submit(asked, folder))
                print(f"\r{what}: {len(done)} made ", end="", file=sys.stderr, flush=True)
            for i, one in enumerate(waiting, 1):
                one.result()
                print(
                    f"\r{what}: {i} of {len(done)} answered ", end="", file=sys.stderr, flush=True
                )
        print(file=sys.stderr)
        return done

    def rows(self, folders: list[Path], asked: Callable[[Path], scoring.Said]) -> list[scoring.Row]:
        """Answers scored; what the next experiment of a case says is asked here."""
        found = []
        for folder in folders:
            said = asked(folder)
            row = scoring.score(folder, said.answer, said.prediction)
            scoring.resolve(row, lambda f: asked(f)[:2], folder, said.answer)
            found.append(row)
        return found

    def first(self, results: page.Results) -> None:
        def made() -> Iterator[Path]:
            for kind in self._kinds("first", plans.MIX):
                out = self.folder("first") / kind
                if self.args.kept:
                    yield from self._answered(out.glob("*"))
                    continue
                for name, _ in generate.generate(self.seed, self.args.count, out, [kind], jobs=1):
                    yield out / name

        self._both(results, page.FIRST, made())

    def second(self, results: page.Results) -> None:
        out, count = self.folder("second"), self.args.count
        for level in self.args.level:
            folders = (
                folder
                for kind in self._kinds("second", recipes.KINDS)
                for folder in (
                    self._answered(out.glob(f"*_{kind}_{level}_*"))
                    if self.args.kept
                    else second.generate(kind, level, self.seed, count, out)
                )
            )
            self._both(results, page.NORMAL if level == "normal" else page.HARD, folders)

    def _answered(self, folders: Iterable[Path]) -> Iterator[Path]:
        """Return, in order, the cases that this state of the program has answered."""
        said = f"said-{self.state}.json"
        return (folder for folder in sorted(folders) if (folder / said).exists())

    def _kinds(self, source: str, known: Iterable[str]) -> list[str]:
        wanted = SHORT[source] if self.args.short else self.args.kinds
        return [k for k in known if k in (wanted or known)]

    def _both(self, results: page.Results, source: str, folders: Iterable[Path]) -> None:
        done = self.ask(folders, source)
        results.rows[source] = self.rows(done, self.tool)
        if not self.args.short:
            results.rivals[source] = self.rows(done, self.rival)

    def own(self, results: page.Results) -> None:
        kinds = SHORT["own"] if self.args.short else self.args.kinds
        cases = own_rigs.chosen(self.seed, self.args.count, kinds)
        places = {self._own_folder(case): case for case in cases}
        if self.args.kept:
            places = {folder: places[folder] for folder in self._answered(places)}
        made = (own_rigs.make(case, folder) for folder, case in places.items())
        said = [(f, self.own_tool(f)) for f in self.ask(made, page.OWN, self.own_tool)]
        results.own = [own_rigs.score(f, s.answer) for f, s in said]

    def _own_folder(self, case: own_rigs.Case) -> Path:
        """Of the recording of a shipped rig: by the program that records it, too."""
        name = f"{case.rig}_{case.label.replace(':', '_')}_{case.seed}"
        return self.folder("own") / self.state / name

    def real(self, results: page.Results) -> None:
        source = Path(self.args.recordings)
        if not source.is_dir():
            results.no_real = f"Only those that this repository holds: {source.name} is not there."
            source = SHIPPED
        folders = self.ask(real.copies(source, Path(self.args.out) / "real"), "real recordings")
        results.real = [real.score(f, self.tool(f), self.rival(f)) for f in folders]

    def opensees(self, results: page.Results) -> None:
        """One case of each material, several times over where more are asked for."""
        if not opensees.installed():
            results.no_opensees = "None here: openseespy cannot be loaded."
            print(f"OpenSees: {results.no_opensees}", file=sys.stderr)
            return
        out = self.folder("opensees")
        count = max(self.args.count, len(opensees_materials.MATERIALS))
        made = opensees.generate(self.seed, count, out)
        folders = self.ask(self._answered(out.glob("*")) if self.args.kept else made, "OpenSees")
        results.opensees = [opensees_scored.score(f, self.tool(f)) for f in folders]

    def times(self, results: page.Results) -> None:
        """One at a time, before all others: what is timed has the machine for itself."""
        for folder in self._timed_cases():
            results.times.setdefault(timed.USUAL, []).append(self.tool(folder).seconds)
        for folder in self._timed_runs():
            results.times.setdefault(timed.HYDRAULIC, []).append(self.own_tool(folder).seconds)
        out = self.folder("times")
        made = timed.generate(self.seed, self.repeats, out)
        for folder in self._answered(out.glob("*")) if self.args.kept else made:
            results.times.setdefault(timed.what(folder), []).append(self.tool(folder).seconds)

    def _timed_cases(self) -> Iterator[Path]:
        """The first few single effects of the first generator."""
        out = self.folder("first") / "single"
        if self.args.kept:
            yield from islice(self._answered(out.glob("*")), self.repeats)
            return
        for name, _ in generate.generate(self.seed, self.repeats, out, ["single"], jobs=1):
            yield out / name

    def _timed_runs(self) -> Iterator[Path]:
        """A few recordings of hydraulic rigs, from all kinds of what is hidden in them."""
        cases = own_rigs.chosen(self.seed, self.args.count, self.args.kinds)
        cases = [case for case in cases if case.rig in page.HYDRAULIC]
        folders = {self._own_folder(c): c for c in cases[:: max(len(cases) // self.repeats, 1)]}
        if self.args.kept:
            yield from self._answered(folders)
            return
        for folder in islice(folders, self.repeats):
            yield own_rigs.make(folders[folder], folder)

    def said(self) -> str:
        """Which program was asked, with which cases."""
        call = ["git", "describe", "--always", "--dirty", "--exclude=*"]
        commit = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False).stdout
        return (
            f"State of the program: `{self.state}` (hash of its sources; commit\n"
            f"`{commit.strip() or 'unknown'}`), seed {self.seed}, {self.args.count} cases of each "
            f"kind at most. Times\nare those of {os.cpu_count()} processors, one answer at a time."
        )


def held(results: page.Results, before: dict[str, tuple[int, int]]) -> list[str]:
    """Say how each source stands to its floor; return what is below.

    One case may always go the other way: of cases that stay the same, one is no sample. All of
    them together are held as well: of a few of one source there may be no floor.
    """
    below, found = [], results.counts()
    rows = [(source, *found[source], *before[source]) for source in found]
    rows.append(("all of them", *(sum(row[i] for row in rows) for i in range(1, 5))))
    for source, asked, right, cases, were in rows:
        least = min(page.floor(cases, were, asked), asked - 1)
        line = (
            f"{source}: {right} of {asked} right, at least {least} wanted: the page has {were} of "
            f"{cases}, and by chance so few fall below once in {1 / page.CHANCE:.0f}"
        )
        print(line)
        if right < least:
            below.append(line)
    return below


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, help="instead of the one that the program's hash gives")
    parser.add_argument("--count", type=int, default=60, help="cases of each kind and level")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "validate")
    parser.add_argument("--page", type=Path, help="where the page goes; else it is printed")
    parser.add_argument("--sources", nargs="*", choices=SOURCES, default=SOURCES)
    parser.add_argument("--kinds", nargs="*", default=())
    parser.add_argument("--level", nargs="*", choices=second.LEVELS, default=second.LEVELS)
    parser.add_argument("--recordings", type=Path, default=OPEN)
    parser.add_argument("--kept", action="store_true", help="only what has been answered already")
    parser.add_argument("--short", action="store_true", help="a fixed few cases, against the page")
    parser.add_argument("--tool", default=str(Path(sys.executable).with_name("rthyb")))
    args = parser.parse_args()
    if args.short:
        args.seed, args.count, args.sources = SHORT_SEED, 1, tuple(SHORT)
        args.level = second.LEVELS[:1]
    return args


def main() -> int:
    args = options()
    proof, results = Proof(args), page.Results()
    for source in args.sources:
        getattr(proof, source)(results)
    failed = results.failed()
    if failed:
        print(f"{len(failed)} cases without an answer, first: {failed[0]}", file=sys.stderr)
    if args.short:
        return 1 if held(results, page.measured(PAGE)) or failed else 0
    text = page.written(results, proof.said(), stlsq.SOLVER)
    if args.page:
        args.page.write_text(text)
    print(text)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
