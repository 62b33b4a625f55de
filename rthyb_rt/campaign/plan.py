"""The runs of a campaign: every combination that its file describes, numbered."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import itertools
import json
import math
import re
import shlex
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from rthyb_rt import __version__, config, core
from rthyb_rt.analysis import several_axes, summary
from rthyb_rt.analysis.several_axes import AxesSummary
from rthyb_rt.config import AxesRig, RigFile
from rthyb_rt.config.campaignfile import MOST_RUNS, CampaignFile, Draws, Scalar, Spread, beside
from rthyb_rt.config.lines import KeyLines
from rthyb_rt.config.loading import load_any_both
from rthyb_rt.documents import flat
from rthyb_rt.errors import InputError, Problem
from rthyb_rt.lab import axes_experiment, virtual_time
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import RecordedTest

Row = dict[str, Any]
"""Result of one run: ``case``, its chosen and drawn values, ``ending``, measures."""

COMPLETED, STOPPED, FAILED = "completed", "stopped", "failed"
"""A run reached its end; a limit or a trip ended it; it could not be carried out."""

NOISE_SEED: Final = "rig.seed"
FILES: Final = ("test", "rig")
"""Keys that name a file instead of one of its values."""
_MODULE_AND_CLASS: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
_LEFT_OUT: Final = (
    "test_name",
    "end_reason",
    "interrupted",
    "clock",
    "final_state",
    "ended_by",
    "live",
)


class Measure(NamedTuple):
    """A figure that is reported for each group: its name in the rows, and its label and unit."""

    name: str
    label: str
    unit: str
    factor: float


MEASURES: Final = (
    Measure("tracking_nrmse", "Tracking error", "%", 100.0),
    Measure("response_nrmse", "Response error", "%", 100.0),
    Measure("energy_error_relative", "Energy error", "%", 100.0),
    Measure("peak_measured_m", "Peak displacement", "mm", 1e3),
)
"""Measures of a test on one axis; the page draws the second over the first."""


def measures_of(rig: RigFile | AxesRig) -> tuple[Measure, ...]:
    """Return the figures reported for each group; with several axes, those of every direction."""
    if not isinstance(rig, AxesRig):
        return MEASURES
    return tuple(
        Measure(f"directions.{name}.{kind}_nrmse", f"{name}: {kind} error", "%", 100.0)
        for name in rig.directions
        for kind in ("tracking", "response")
    )


@dataclass(frozen=True)
class PlannedRun:
    """One run: how it is prepared, recorded and evaluated, in any process.

    Attributes:
        number: from 0, in the order of the campaign.
        chosen: its values from the lists, by key.
        drawn: number of its plant; 0: that of the file; -1: the campaign draws no plants.
        repeat: number of its noise, from 0.
        test: test file; "" for the built-in one.
        rig: rig file or name; "" for that of the test.
        settings: ``key=value``, as after ``--set``.
    """

    number: int
    chosen: dict[str, Scalar]
    drawn: int
    repeat: int
    test: str
    rig: str
    settings: tuple[str, ...]

    def command(self) -> str:
        """Return the command line that repeats this run."""
        words = ["rthyb", "run"]
        words += [shlex.quote(self.test)] if self.test else []
        words += ["--rig", shlex.quote(self.rig)] if self.rig else []
        for setting in self.settings:
            words += ["--set", shlex.quote(setting)]
        return " ".join(words)

    def identity(self) -> Row:
        """Return the part of its row that identifies the run."""
        row: Row = {"case": self.number, **self.chosen}
        if self.drawn >= 0:
            row["drawn"] = self.drawn
        row["repeat"] = self.repeat
        return row

    def prepared(self) -> Setup:
        """Return the prepared run.

        Raises:
            InputError: with the errors in its files and settings.
        """
        return axes_experiment.prepare_any(*self._files())

    def _files(self) -> tuple[config.TestFile, RigFile | AxesRig]:
        test = Path(self.test) if self.test else None
        return load_any_both(test, self.rig or None, self.settings)

    def recorded(self, setup: Setup) -> RecordedTest:
        """Carry it out in virtual time."""
        return virtual_time.run(setup)

    def measured(self, setup: Setup, rec: RecordedTest) -> Row:
        """Return ``ending``, ``cause`` and measures: those of ``rthyb run --json``.

        Those of an axis or a direction begin with its name, ``axes.upper.tracking_nrmse``. A
        value that is not a number is None.
        """
        found = several_axes.summarize_any(rec)
        measures = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in flat(found.as_json())
            if name not in _LEFT_OUT and isinstance(value, (bool, int, float, type(None)))
        }
        return ended(rec, found) | measures


def ended(rec: RecordedTest, found: summary.Summary | AxesSummary | None = None) -> Row:
    """Return how a run ended: ``ending``, and ``cause`` in words.

    Args:
        rec: recording of the run.
        found: its measures, if they are already known.
    """
    if rec.meta["end_reason"] == "completed":
        return {"ending": COMPLETED, "cause": ""}
    if rec.axis_names:
        return {"ending": STOPPED, "cause": str(rec.meta["end_reason"])}
    own = found if isinstance(found, summary.Summary) else summary.summarize(rec)
    return {"ending": STOPPED, "cause": own.ending}


@dataclass(frozen=True)
class Plan:
    """All runs of a campaign.

    Attributes:
        name: name of the campaign.
        keep: the runs whose recordings and settings are kept.
        cases: the runs, by number.
        fingerprint: fingerprint of the runs, the files that they read, and the core.
        measures: measures that are reported for each group.
        notes: values that a rig file omits.
    """

    name: str
    keep: str
    cases: tuple[PlannedRun, ...]
    fingerprint: str
    measures: tuple[Measure, ...] = MEASURES
    notes: tuple[str, ...] = ()


def of(file: CampaignFile, path: Path) -> Plan:
    """Return the runs of a campaign that varies a test.

    Args:
        file: the campaign.
        path: path of its file.

    Raises:
        InputError: with every error of the first test or rig, or with a key that they do not have.
    """
    count = _count(file)
    if count > MOST_RUNS:
        raise InputError(
            f"found {count} runs; a campaign may have at most {MOST_RUNS}: shorten a list, or "
            "split it into two campaigns",
            str(path),
        )
    cases = tuple(_cases(file, path))
    _, rig = cases[0]._files()
    about = file.campaign
    return Plan(
        about.name, about.keep, cases, fingerprint(cases), measures_of(rig), _omitted(cases)
    )


def _omitted(cases: Sequence[PlannedRun]) -> tuple[str, ...]:
    """Return the notes on values that the rigs of a campaign omit, each once."""
    notes: dict[str, None] = {}
    seen = set()
    for case in cases:
        # The value of a key does not change which others are omitted, unless it is a whole table.
        changed = frozenset(
            setting if "{" in setting or ".kind=" in setting else setting.partition("=")[0]
            for setting in case.settings
        )
        if (case.test, case.rig, changed) in seen:
            continue
        seen.add((case.test, case.rig, changed))
        with contextlib.suppress(InputError):  # that run will say so itself
            notes |= dict.fromkeys(config.omitted(case._files()[1]))
    return tuple(notes)


def _count(file: CampaignFile) -> int:
    count = file.noise_seeds
    for values in file.over.values():
        count *= len(values)
    for table in file.together:
        count *= len(next(iter(table.values()), (None,)))
    if file.draws is not None:
        count *= file.draws.count + file.draws.nominal
    return count


def _choices(file: CampaignFile) -> Iterator[dict[str, Scalar]]:
    """Yield the values of each combination of the lists; the last list changes fastest."""
    axes: list[list[dict[str, Scalar]]] = []
    for key, values in file.over.items():
        axes.append([{key: value} for value in values])
    axes += [
        [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]
        for table in file.together
    ]
    for parts in itertools.product(*axes):
        yield {key: value for part in parts for key, value in part.items()}


def _cases(file: CampaignFile, path: Path) -> Iterator[PlannedRun]:
    number = 0
    for chosen in _choices(file):
        test, rig = (str(chosen.get(which, getattr(file.campaign, which) or "")) for which in FILES)
        test, rig = (beside(path, name) if name else "" for name in (test, rig))
        given = [f"{key}={_toml(value)}" for key, value in chosen.items() if key not in FILES]
        if number == 0 or file.draws is not None:
            # The first run is read here, so that an error is reported before the pool is made.
            base = _read(path, test, rig, given)
        plants = _plants(file.draws, base, path) if file.draws is not None else [(-1, ())]
        for (drawn, factors), repeat in itertools.product(plants, range(file.noise_seeds)):
            noise = (f"{NOISE_SEED}={repeat + 1}",) if file.noise_seeds > 1 else ()
            yield PlannedRun(number, chosen, drawn, repeat, test, rig, (*given, *factors, *noise))
            number += 1


def _read(path: Path, test: str, rig: str, given: Sequence[str]) -> dict[str, Any]:
    """Return the values of both files by table, those of the rig under ``rig``."""
    try:
        test_file, rig_file = load_any_both(Path(test) if test else None, rig or None, given)
    except InputError as error:
        raise InputError(_placed(problem, path) for problem in error.problems) from error
    return {**test_file.model_dump(by_alias=True), "rig": rig_file.model_dump(by_alias=True)}


def _placed(problem: Problem, path: Path) -> Problem:
    """Return an error about a setting with the place of that setting in the campaign file."""
    before, option, key = problem.where.partition("--set ")
    if before or not option:
        return problem
    lines = KeyLines(config.read_text(path, "campaign"))
    for table in (("over", key), ("together", 0, key), ("draws", "spread", key)):
        line = lines.find(table)
        if line > lines.find(table[:-1]):
            return Problem(f"{path}:{line}: {key}", problem.message)
    return Problem(f"{path}: {key}", problem.message)


def _plants(draws: Draws, base: dict[str, Any], path: Path) -> list[tuple[int, tuple[str, ...]]]:
    """Return number and settings of each plant; the same seed gives the same plants."""
    own = {key: _number(base, key, path) for key in draws.spread}
    plants: list[tuple[int, tuple[str, ...]]] = [(0, ())] if draws.nominal else []
    for n in range(1, draws.count + 1):
        # Each plant has its own random stream, so that further plants do not change the first.
        random = np.random.default_rng([draws.seed, n])
        settings = tuple(
            f"{key}={own[key] * _factor(spread, random)!r}" for key, spread in draws.spread.items()
        )
        plants.append((n, settings))
    return plants


def _factor(spread: Spread, random: np.random.Generator) -> float:
    if spread.std is not None:
        return float(1.0 + spread.std * random.standard_normal())
    return float(random.uniform(spread.low or 0.0, spread.high or 0.0))


def _number(base: dict[str, Any], key: str, path: Path) -> float:
    """Return the value that both files have at a dotted key."""
    place: Any = base
    for part in key.split("."):
        if isinstance(place, dict):
            place = place.get(part)
        elif isinstance(place, (list, tuple)):
            place = _member(place, part)
        else:
            place = None
    if isinstance(place, bool) or not isinstance(place, (int, float)):
        raise InputError(
            f"[draws] multiplies the value of {key} in the file by a random factor, but the file "
            "has no number there; add one to the file, or list the key's values in [over]",
            f"{path}: draws.spread",
        )
    return float(place)


def _member(places: Sequence[Any], part: str) -> Any:
    """Return the entry of a list by number from 0, or by name, as for axes; None if missing."""
    if part.isdecimal():
        return places[int(part)] if int(part) < len(places) else None
    named = (one for one in places if isinstance(one, dict) and one.get("name") == part)
    return next(named, None)


def program() -> str:
    """Return what distinguishes one computing program from another: version, sources of the core.

    Control laws are a part of the core, whoever wrote them.
    """
    return f"{__version__} {core.build_facts()['core_sources']}"


def fingerprint(cases: Sequence[PlannedRun]) -> str:
    """Return the fingerprint of a campaign, including its files and the program.

    A file counts with its name and content, not with its folder, so that a campaign that was moved
    together with its files resumes where it is now.
    """
    named = {name for case in cases for name in (case.test, case.rig)}
    named |= {setting.partition("=")[2] for case in cases for setting in case.settings}
    named |= {text for case in cases for text in case.chosen.values() if isinstance(text, str)}
    contents = {path: _content(path) for path in files_read(named)}
    known = {text: contents[path] for text in named if text and (path := _file(Path(), text))}
    about = [_without_folders(asdict(case), known) for case in cases]
    digest = hashlib.sha256(json.dumps(about).encode())
    digest.update(program().encode())
    for content in sorted(contents.values()):
        digest.update(content.encode())
    return digest.hexdigest()


def _content(path: Path) -> str:
    return f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}"


def _without_folders(case: dict[str, Any], known: dict[str, str]) -> dict[str, Any]:
    """Return the parts of a case, with the content of each file that it names in place of its path.

    Args:
        case: its parts.
        known: name and content of files, by the texts that name them.
    """
    chosen = {key: known.get(str(value), value) for key, value in case["chosen"].items()}
    settings = []
    for setting in case["settings"]:
        key, equals, value = setting.partition("=")
        settings.append(f"{key}{equals}{known.get(value, value)}")
    named = {which: known.get(case[which], case[which]) for which in FILES}
    return {**case, **named, "chosen": chosen, "settings": settings}


def files_read(named: Iterable[str]) -> list[Path]:
    """Return the files that tests and rigs are read from, and those that these name, in order.

    Ground motions, matrices, identified responses, libraries: every value that is the path of a
    file. Modules with classes in Python count as well, but not what they import.

    Args:
        named: paths, names and other values, of which those count that are files.
    """
    found: set[Path] = set()
    waiting = [(Path(), value) for value in named if value]
    while waiting:
        folder, value = waiting.pop()
        path = _file(folder, value)
        if path is None or path in found:
            continue
        found.add(path)
        if path.suffix == ".toml":
            with contextlib.suppress(tomllib.TOMLDecodeError, UnicodeDecodeError):
                waiting += [(path.parent, one) for one in _texts(tomllib.loads(path.read_text()))]
    return sorted(found)


def _file(folder: Path, value: str) -> Path | None:
    """Return the file that a value names, or None."""
    try:
        if _MODULE_AND_CLASS.fullmatch(value):
            module = importlib.util.find_spec(value.partition(":")[0])
            value = "" if module is None else module.origin or ""
        path = (folder / value).resolve()
        return path if path.is_file() else None
    except Exception:  # a text that can be no path, or whatever a user's package raises
        return None


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _texts(one)


def _toml(value: Scalar) -> str:
    """Return a value in the form that `--set` accepts."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else repr(value)
