"""``rthyb sweep``: one test over lists of values, without a campaign file."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import campaign as campaigns
from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import JsonOption, RigOption, SetOption, load_any, note_unused
from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.campaign.plan import Plan

_CALLED = "sweep"
_FILES = ("test", "rig")
_WORDS = {
    rf"^{_CALLED}: over\.": "--over ",
    rf"^{_CALLED}: noise_seeds$": "--repeat-seeds",
    rf"^{_CALLED}: campaign\.": "--",
    r"^--set ": "--over ",
}
"""Places in messages, and the options to which they correspond."""


def sweep(
    over: Annotated[
        list[str],
        typer.Option(
            metavar="KEY=V1,V2,...",
            help="Values of one key, as for --set. Can be repeated; all combinations are run.",
            show_default=False,
        ),
    ],
    test: Annotated[
        Path | None,
        typer.Argument(
            metavar="TEST.toml",
            help="Test file, or name of a shipped test. Default: the built-in test.",
            show_default=False,
        ),
    ] = None,
    rig: RigOption = None,
    settings: SetOption = None,
    repeat_seeds: Annotated[
        int,
        typer.Option(metavar="N", help="Repeat each run with noise from N seeds, 1 to 100000."),
    ] = 1,
    name: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Name of the sweep, instead of TEST-sweep.",
                     show_default=False),
    ] = None,
    keep: Annotated[
        str,
        typer.Option(metavar="WHICH", help="Recordings to keep: nothing, tripped or all."),
    ] = "tripped",
    out: campaigns.OutOption = None,
    jobs: campaigns.JobsOption = None,
    cluster: campaigns.ClusterOption = None,
    dry_run: campaigns.DryRunOption = False,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Run one test over lists of values, in virtual time.

    Every value is combined with every value of the other lists, on all processors. Every run is
    saved as soon as it ends: after Ctrl-C or a power failure, the same command resumes where it
    stopped. The table and the page give median and worst case over the seeds, and which runs ended
    early and why; statistics.csv also has mean and standard deviation. `rthyb compare` compares
    the runs that were kept.

    \b
    Examples:
      rthyb sweep my-test.toml --over numerical.period_s=0.3,0.5,0.8 --repeat-seeds 5
      rthyb sweep --over controller.type=paper,robust --over ground_motion.pga_g=0.02,0.04
      rthyb sweep my-test.toml --over rig=delay-10-elastic,first-order-5hz --keep all

    The exit code is 6 if a limit or a trip ended a run, or if a run could not be carried out.
    """
    from rthyb_rt.campaign import given

    campaigns.refuse_both(jobs, cluster)
    test_file, rig_file = load_any(test, rig, settings)
    if not any(one.partition("=")[0].strip() == "controller.type" for one in over):
        note_unused(test_file, settings)
    called = name or f"{test_file.test.name}-{_CALLED}"
    values = {
        "campaign": {"name": called, "keep": keep},
        "noise_seeds": repeat_seeds,
        "over": _lists(over),
    }
    try:
        campaign, parts = given.texts(test_file, rig_file, values, _CALLED)
        _try_first(test, rig, settings or [], campaign.over)
    except InputError as error:
        raise _in_options(error) from None
    folder = out or Path("runs") / called
    interrupts.wrote(folder)
    if dry_run:
        campaigns.print_plan(_only_planned(parts), terminal.people(as_json), as_json)
        return
    campaigns.carry_out(given.plan_of(folder.resolve(), parts), folder, jobs, cluster, as_json)


def _lists(options: Sequence[str]) -> dict[str, list[Any]]:
    """Return the values of each key.

    Raises:
        InputError: lists every option that is not a list, or that repeats a key.
    """
    lists: dict[str, list[Any]] = {}
    problems = []
    for option in options:
        key, equals, text = option.partition("=")
        key = key.strip()
        words = [word.strip() for word in text.split(",")]
        if not equals or not key or not all(words):
            problems.append(
                Problem(
                    "--over",
                    f'found "{option}"; must be KEY=V1,V2,..., as in '
                    "numerical.period_s=0.3,0.5; quote values that contain spaces: "
                    '"ground_motion.pga_g=0.02 g,0.04 g"',
                )
            )
        elif key in lists:
            problems.append(Problem(f"--over {key}", "occurs twice; give all its values at once"))
        else:
            lists[key] = [_value(key, word) for word in words]
    if problems:
        raise InputError(problems)
    return lists


def _value(key: str, word: str) -> Any:
    """Return a value as in a campaign file: a number if it is one, otherwise text."""
    if key in _FILES:
        # Relative paths would refer to the folder of the sweep.
        return str(Path(word).resolve()) if Path(word).is_file() else word
    try:
        found = tomllib.loads(f"x = {word}")["x"]
    except tomllib.TOMLDecodeError:
        return word
    return found if isinstance(found, (bool, int, float, str)) else word


def _try_first(
    test: Path | None, rig: str | None, settings: Sequence[str], over: dict[str, Any]
) -> None:
    """Refuse values with which the first run has an error, before anything is written.

    Raises:
        InputError: refers to the keys of the sweep.
    """
    if any(key in over for key in _FILES):
        return
    load_any(test, rig, [*settings, *(f"{key}={_text(found[0])}" for key, found in over.items())])


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value)


def _in_options(error: InputError) -> InputError:
    """Return an error that refers to the options of this command."""
    from rthyb_rt.api.messages import in_python

    found = in_python(error, _WORDS)
    return InputError(found.problems)


def _only_planned(parts: dict[str, str]) -> Plan:
    """Return the runs without storing the files that they read."""
    import tempfile

    from rthyb_rt.campaign import given

    with tempfile.TemporaryDirectory(prefix="rthyb-") as folder:
        return given.plan_of(Path(folder) / "sweep", parts)
