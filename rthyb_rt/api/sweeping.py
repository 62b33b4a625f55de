"""Parameter sweeps of a test on all processors or a cluster: the campaign engine in Python."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from rthyb_rt.api import files
from rthyb_rt.api.files import Place, Rig, Test, in_words, plain
from rthyb_rt.api.messages import in_python, require_progress
from rthyb_rt.api.recordings import Recording, extra, open_recording
from rthyb_rt.api.tables import html_table
from rthyb_rt.campaign import campaign_tables, given, plan, pools, whole_campaign
from rthyb_rt.campaign.groups import group
from rthyb_rt.campaign.plan import FAILED, STOPPED, Measure, Row
from rthyb_rt.config.campaignfile import CampaignFile
from rthyb_rt.config.fields import nearest, written
from rthyb_rt.errors import InputError, Problem, RthybError

if TYPE_CHECKING:
    from pandas import DataFrame

Progress = Callable[[int, int], None]
"""Called with the number of runs done and the total number."""
_CALLED: Final = "sweep"
_NO_MEASURES: Final = ("case", "drawn", "repeat", "ending", "cause", "folder", "report")
_WORDS_HERE: Final = {
    "with --out": "with out",
    "--cluster": "client",
    rf"{_CALLED}: campaign\.": f"{_CALLED}: ",
    f"{_CALLED}: noise_seeds": f"{_CALLED}: repeat_seeds",
    r"add the table \[spread\]": "give the standard deviation of each key that is drawn, "
    'draws={"count": 20, "spread": {"rig.actuator.delay_samples": 0.05}}',
}
"""Terms in messages of the campaign engine, and their equivalents here."""


class Sweep:
    """Result of a sweep: one row per run, and statistics for each combination of values.

    Attributes:
        name: name of the sweep.
        folder: its folder, with the table, the HTML page, and the recordings of some runs.
        rows: rows by run number: the values of the parameters, ``ending``, ``cause``, and the
            numerical measures under the names used in `Recording.measures`.
        paths: its files by kind.
        notes: values that a rig file omits, and files that were not written and how to obtain
            them.
    """

    def __init__(self, found: whole_campaign.Campaign, folder: Path) -> None:
        self.name, self.folder = found.plan.name, folder
        self.rows: list[Row] = found.rows
        self.paths, self.notes = dict(found.paths), found.notes
        self._keys = list(found.plan.cases[0].chosen)
        self._measures = found.plan.measures

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def failed(self) -> list[Row]:
        """Rows of the runs that could not be carried out; ``cause`` gives the reason."""
        return [row for row in self.rows if row["ending"] == FAILED]

    @property
    def stopped(self) -> list[Row]:
        """Rows of the runs that were ended by a limit or a trip, which ``cause`` names."""
        return [row for row in self.rows if row["ending"] == STOPPED]

    def statistics(self, *measures: str) -> list[Row]:
        """Return one row per combination of values, with statistics over its completed runs.

        Args:
            measures: names of columns; none given: those on the campaign's page.

        Returns:
            Values of the parameters; the counts ``runs``, ``completed``, ``stopped``, ``failed``;
            and for the magnitude of each measure ``NAME_mean``, ``NAME_std`` (sample standard
            deviation; None for a single run), ``NAME_median`` and ``NAME_worst``. Statistics are
            None if no run was completed.

        Raises:
            InputError: there is no such measure; the message lists those that exist.
        """
        known = [name for name in self._columns() if name not in (*self._keys, *_NO_MEASURES)]
        given_names: tuple[object, ...] = measures
        for name in given_names:
            if not isinstance(name, str):
                raise InputError(
                    f"no measure {in_words(name)}; measures are: {', '.join(known)}; give them "
                    f"one by one, statistics({written(known[0])}, ...)",
                    "statistics",
                )
            if name not in known:
                raise InputError(
                    f"no measure {written(name)}{nearest(str(name), known)}; measures are: "
                    f"{', '.join(known)}",
                    "statistics",
                )
        wanted = [Measure(name, name, "", 1.0) for name in measures] or list(self._measures)
        return campaign_tables.statistics(group(self.rows, self._keys, wanted), wanted)

    def _columns(self) -> list[str]:
        return list(dict.fromkeys(name for row in self.rows for name in row))

    def to_pandas(self) -> DataFrame:
        """Return the rows as a DataFrame, indexed by run number.

        Raises:
            InputError: pandas is not installed.
        """
        table: DataFrame = extra("pandas", "to_pandas").DataFrame(self.rows).set_index("case")
        return table

    def recording(self, case: int) -> Recording:
        """Open the recording of a run.

        Args:
            case: number of the run.

        Raises:
            InputError: it was not kept; the message lists those that were.
        """
        kept = {row["case"]: row["folder"] for row in self.rows if row.get("folder")}
        wanted: object = case  # from a notebook it may be anything
        if isinstance(wanted, bool) or not isinstance(wanted, Integral):
            raise InputError(
                f"found {in_words(case)}; give the number of a run, as in the column case: "
                "recording(0)",
                "recording",
            )
        if case not in kept:
            listed = ", ".join(map(str, kept)) or "none"
            raise InputError(
                f"the recording of run {case} was not kept; those kept are: {listed}; "
                'sweep(..., keep="all") keeps all of them',
                str(self.folder),
            )
        return open_recording(self.folder / kept[int(case)])

    def __repr__(self) -> str:
        stopped, failed = len(self.stopped), len(self.failed)
        completed = len(self.rows) - stopped - failed
        return (
            f"<Sweep {self.name}: {len(self.rows)} runs, {completed} completed, "
            f"{stopped} stopped, {failed} failed>"
        )

    def _repr_html_(self) -> str:
        from html import escape

        rows = self.statistics()
        lines = [f"<p>{escape(repr(self)[1:-1])}</p>"]
        lines.append(html_table([list(row.values()) for row in rows], list(rows[0])))
        early = [*self.failed, *self.stopped]
        lines += [
            f"<p>Run {row['case']} {row['ending']}: {escape(str(row['cause']))}</p>"
            for row in early[:5]
        ]
        return "".join(lines)


def sweep(
    test: Test | Place | None = None,
    over: Mapping[str, Iterable[Any]] | None = None,
    *,
    rig: Rig | Place | None = None,
    together: Sequence[Mapping[str, Iterable[Any]]] = (),
    draws: Mapping[str, Any] | None = None,
    repeat_seeds: int = 1,
    name: str | None = None,
    out: Place | None = None,
    keep: Literal["nothing", "tripped", "all"] = "tripped",
    jobs: int | None = None,
    client: Any = None,
    progress: Progress | None = None,
) -> Sweep:
    """Run a test in virtual time for all combinations of lists of values.

    The result of each run is saved when it ends: if the sweep is interrupted and called again, it
    continues where it stopped. A run that cannot be carried out is marked as failed in its row and
    does not affect the others.

    Args:
        test: a test, or the path or name of one; None: the built-in test.
        over: lists of values by dotted key of the test, or of the rig with the prefix ``rig.``. The
            keys ``rig`` and ``test`` take rigs and tests, or their paths or names.
        rig: a rig, or the path or name of one; None: the rig of the test.
        together: lists by key that vary together, one dict per group of keys.
        draws: plants with parameters drawn at random around the rig's values, as in the table
            ``[draws]`` of a campaign file: ``{"count": 20, "seed": 1, "spread":
            {"rig.actuator.delay_samples": 0.05}}``.
        repeat_seeds: number of repetitions of each run, each with a different noise seed.
        name: name of the sweep; None: the name of the test with ``-sweep`` appended.
        out: folder; None: ``runs/NAME``.
        keep: the runs whose recording and report are kept.
        jobs: number of processes; None: one per processor.
        client: a `distributed.Client`, or the address of a Dask scheduler, whose workers are used
            instead; they must have the same version of the program, and access ``out`` by the same
            path.
        progress: called after each run; None: a progress line on a terminal.

    Raises:
        InputError: the lists or the first run are invalid, or the folder contains something else.
        RthybError: the folder cannot be written.

    Examples:
        >>> short = Test("section5-T0.5", ground_motion={"duration_s": 2})
        >>> found = sweep(short, {"controller.type": ["paper", "robust"]}, out="laws", jobs=1)
        >>> found
        <Sweep section5-t0.5-sweep: 2 runs, 2 completed, 0 stopped, 0 failed>
    """
    _require(jobs, progress, client)
    if isinstance(together, (Mapping, str)) or not isinstance(together, Iterable):
        raise InputError(
            f"found {written(together)}; give a list of dicts, whose lists vary together, "
            'together=[{"controller.w1": [3, 4], "controller.w2": [2, 2.5]}]',
            f"{_CALLED}: together",
        )
    base = files.as_test(test)
    base = base if rig is None else base.with_(rig=files.as_rig(rig))
    called = name or f"{base.name}-{_CALLED}"
    parts: dict[str, str] = {}
    values: dict[str, Any] = {
        "campaign": {"name": called, "test": "test.toml", "keep": keep},
        "noise_seeds": plain(repeat_seeds),
        "over": _lists({} if over is None else over, parts, "over"),
        "together": [_lists(table, parts, "together") for table in together],
        "draws": plain(draws or {}),
    }
    parts |= _written(base, {key: value for key, value in values.items() if value not in ({}, [])})
    where = Path("runs") / called if out is None else out
    folder = files.path_of(where, f"{_CALLED}: out", "the folder of the sweep").resolve()
    try:
        planned = given.plan_of(folder, parts)
        found = whole_campaign.conduct(
            planned, folder, jobs=jobs or pools.processors(), cluster=client,
            progress=progress or _line(called),
        )  # fmt: skip
    except RthybError as error:
        raise in_python(error, _WORDS_HERE) from None
    swept = Sweep(found, folder)
    if test is None and not any("test" in table for table in (over or {}, *together)):
        swept.notes = (files.BUILT_IN, *swept.notes)
    return swept


def _require(jobs: object, progress: object, client: object) -> None:
    """Refuse a number of processes, a function for the progress, or a cluster that is none.

    Raises:
        InputError: with what was found.
    """
    if jobs is not None and (isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1):
        raise InputError(
            f"found {written(jobs)}; the number of processes must be a whole number from 1, or "
            "None for one per processor",
            f"{_CALLED}: jobs",
        )
    require_progress(progress, _CALLED)
    if client is not None and not isinstance(client, str) and not hasattr(client, "scheduler"):
        raise InputError(
            f"found {written(client)}; give a distributed.Client, or the address of a scheduler, "
            'client="tcp://lab:8786"',
            f"{_CALLED}: client",
        )


def _lists(over: Any, parts: dict[str, str], argument: str) -> dict[str, Any]:
    """Return the values by key as in a campaign file; files that they name are put into ``parts``.

    ``argument`` is the name of the argument, for messages.

    Raises:
        InputError: they are not lists by key, or a rig is given where none is allowed.
    """
    if not isinstance(over, Mapping):
        example = '{"controller.type": ["paper", "robust"]}'
        example = f"[{example}]" if argument == "together" else example
        raise InputError(
            f"found {written(over)}; give a dict of lists by dotted key, {argument}={example}",
            f"{_CALLED}: {argument}",
        )

    def value(key: str, one: Any) -> Any:
        if not isinstance(one, (Rig, Test)):
            return plain(one)
        if not isinstance(one, Rig if key == files.RIG else Test):
            raise InputError(
                f"found {one!r}; give a rig with the key rig, and a test with the key test",
                f"{_CALLED}: {argument}.{key}",
            )
        file = f"{one.name}.toml"
        text = files.toml_given(one) if isinstance(one, Rig) else one.to_toml()
        if parts.setdefault(file, text) != text:
            file = f"{one.name}-{len(parts)}.toml"
            parts[file] = text
        return file

    lists = {}
    for key, found in over.items():
        if not isinstance(key, str) or isinstance(found, Mapping):
            what = f"{written(key)} as a key" if not isinstance(key, str) else "a table"
            raise InputError(
                f"found {what}; a key is dotted, as in the file, and has a list of values: "
                f'{argument}={{"controller.w1": [3, 3.5]}}',
                f"{_CALLED}: {argument}.{key}",
            )
        single = isinstance(found, (str, bool, int, float, Rig, Test)) or not isinstance(
            found, Iterable
        )
        lists[str(key)] = [value(str(key), one) for one in ([found] if single else found)]
    return lists


def _written(base: Test, values: dict[str, Any]) -> dict[str, str]:
    """Return the files of a sweep by name: test, rig, and the campaign over them.

    Raises:
        InputError: with what is wrong in the values, or in the first run.
    """
    try:
        campaign, parts = given.texts(
            files.file_of_test(base), files.file_of_rig(base.rig), values, _CALLED
        )
    except InputError as error:
        raise in_python(error, _WORDS_HERE) from None
    _try_first(base, campaign)
    return parts


def _try_first(base: Test, campaign: CampaignFile) -> None:
    """Reject values for which the first run has an error, before anything is written.

    Raises:
        InputError: with the keys of the sweep.
    """
    first = {key: found[0] for key, found in campaign.over.items() if key not in plan.FILES}
    first |= {key: found[0] for table in campaign.together for key, found in table.items()}
    if "test" in campaign.over or files.RIG in campaign.over:
        return
    try:
        base.with_(first)
    except InputError as error:
        raise InputError(
            Problem(p.where.replace("with_: ", f"{_CALLED}: over."), p.message)
            for p in error.problems
        ) from None


def _line(name: str) -> Progress:
    """Return a function that shows progress in one line on a terminal, and nothing elsewhere."""
    if not sys.stderr.isatty():
        return lambda done, whole: None

    def tell(done: int, whole: int) -> None:
        print(f"\r{name}: {done} of {whole} runs", end="\n" if done == whole else "",
              file=sys.stderr, flush=True)  # fmt: skip

    return tell
