"""``rthyb diagnose``: what does the model leave out?"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import JsonOption
from rthyb_rt.errors import InputError, RthybError

if TYPE_CHECKING:
    from rthyb_rt.diagnose.engine import Diagnosis

MISMATCH = 8


def diagnose(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="CSV file, or folder or recording.h5 of a run.",
            show_default=False,
        ),
    ],
    model: Annotated[
        Path,
        typer.Option(
            "--model",
            metavar="MODEL.toml",
            show_default=False,
            help="What the lab believes: a baseline file (rthyb-baseline/1), a rig or a test file.",
        ),
    ],
    heldout: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            show_default=False,
            help="A second recording, to judge the answer by.",
        ),
    ] = None,
    predict: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            show_default=False,
            help="Inputs of a second recording; its force and displacement go to --out.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="PRED.csv", help="Where the prediction goes.", show_default=False),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            show_default=False,
            help="Write report.html, diagnosis.json and augmented.toml there.",
        ),
    ] = None,
    self_check: Annotated[
        bool,
        typer.Option(
            "--self-check",
            help="Hide a known effect in this very recording and see whether it is found again.",
        ),
    ] = False,
    effect: Annotated[
        list[Path] | None,
        typer.Option(
            "--effect",
            metavar="FILE.py",
            show_default=False,
            help="Python file that registers an effect of your own; more than one may be given.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what physics a model leaves out, and where.

    The recording is cut at its signals: the command against the displacement gives what the
    actuator does otherwise, the displacement against the force what the specimen does. Exit code 0
    says that nothing is missing, 8 any other answer, 3 that the data allow none. A recording of
    this program is then simulated again with the loop closed, with the model as given and with
    what was found.

    \b
    Examples:
      rthyb diagnose recording.csv --model baseline.toml --report runs/diagnosis
      rthyb diagnose runs/my-test-20260301T101500Z --model rig.toml
      rthyb diagnose recording.csv --model baseline.toml --effect magnet.py
    """
    # Its products are long and narrow: shared between cores they take four times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from rthyb_rt.diagnose import effects, engine, reading
    from rthyb_rt.diagnose.outcome import finish

    if (predict is None) != (out is None):
        raise typer.BadParameter("--predict and --out belong together", param_hint="--predict")
    if report is not None:
        _writable(report)
    for path in effect or ():
        effects.load(path)
    lab = reading.read_model(model)
    case = reading.read_case(recording, lab)
    second = reading.read_case(heldout, lab, judged=False) if heldout else None
    if second is not None and not second.channels.keys() & {"x_meas", "f_meas"}:
        raise InputError(
            f"{heldout}: holds no x_meas, fx_meas or fy_meas that the model could be held against; "
            "a recording of the commands alone goes to --predict"
        )
    wanted = reading.read_case(predict, lab, judged=False) if predict else None
    with terminal.sections("Diagnosing") as bar:
        done = [0]

        def step(part: str) -> None:
            done[0] += 1
            bar(min(done[0], 39), 40, part)

        found = engine.diagnose(case, step)
        step("held out")
        outcome = finish(found, second, wanted)
        checks = None
        if self_check:
            from rthyb_rt.diagnose.power import self_check as check

            checks = check(found, step)
    if out is not None and outcome.prediction is not None:
        _write_prediction(out, outcome.prediction)
        interrupts.wrote(out)
    answer = outcome.answer | ({"self_check": checks} if checks is not None else {})
    if report is not None:
        from rthyb_rt.diagnose.page import write_report

        for path in write_report(report, found, outcome, checks, model):
            interrupts.wrote(path)
    _tell(found, answer, terminal.people(as_json))
    if as_json:
        terminal.print_json(answer)
    if found.verdict != "none":
        raise typer.Exit(MISMATCH)


def _writable(folder: Path) -> None:
    """Refuse a folder that cannot be made or written before a minute's work is lost to it."""
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        why = "may not be written to" if there.is_dir() else "is a file and no folder"
        raise RthybError(f"{why}; give --report another folder", where=str(there))


def _write_prediction(path: Path, prediction: Any) -> None:
    import numpy as np

    from rthyb_rt.recording import replacing

    table = np.column_stack([prediction.t, prediction.f, prediction.x])
    with replacing(path) as temporary:
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header="t,f,x", comments="")


def _tell(found: Diagnosis, answer: dict[str, Any], file: Any) -> None:
    from rthyb_rt.diagnose import words

    print(words.sentence(found, answer), file=file)
    rows = []
    named = {n for group in (found.effects, *found.ambiguous_with) for n in group}
    for c in found.candidates:
        if c.name in named and found.verdict != "unknown":
            for name, value in c.params.items():
                interval = words.interval_text(name, c.ci95.get(name))
                text = words.value_text(name, value).replace(" = ", "\0", 1).split("\0")
                rows.append(
                    (f"{c.name} {text[0]}", text[1], f"95 %: {interval}" if interval else "")
                )
    rows += words.loop_rows(answer)
    if rows:
        print("", file=file)
        terminal.print_table(rows, file)
    checks = words.check_rows(answer.get("self_check"))
    if checks:
        print("\nHidden in this recording:", file=file)
        terminal.print_table([(name, text, "") for name, text in checks], file)
    elif "self_check" in answer:
        print("Nothing can be hidden in a recording without a measured force.", file=file)
    for note in found.notes:
        print(f"Note: {note}", file=file)
    following = words.next_text(found)
    if following:
        print(f"Next experiment: {following}", file=file)
