"""``rthyb diagnose``: what does the model leave out?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import JsonOption

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
    as_json: JsonOption = False,
) -> None:
    """Say what physics a model leaves out, and where.

    The recording is cut at its signals: the command against the displacement gives what the
    actuator does otherwise, the displacement against the force what the specimen does. Exit code 0
    says that nothing is missing, 8 any other answer, 3 that the data allow none.

    \b
    Examples:
      rthyb diagnose recording.csv --model baseline.toml --report runs/diagnosis
      rthyb diagnose runs/my-test-20260301T101500Z --model rig.toml
    """
    from rthyb_rt.diagnose import engine, reading
    from rthyb_rt.diagnose.outcome import finish

    if (predict is None) != (out is None):
        raise typer.BadParameter("--predict and --out belong together", param_hint="--predict")
    lab = reading.read_model(model)
    case = reading.read_case(recording, lab)
    second = reading.read_case(heldout, lab, judged=False) if heldout else None
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

            step("self-check")
            checks = check(found)
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


def _write_prediction(path: Path, prediction: Any) -> None:
    import numpy as np

    from rthyb_rt.recording import replacing

    table = np.column_stack([prediction.t, prediction.f, prediction.x])
    with replacing(path) as temporary:
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header="t,f,x", comments="")


def _tell(found: Diagnosis, answer: dict[str, Any], file: Any) -> None:
    from rthyb_rt.diagnose.words import interval_text, sentence

    print(sentence(found, answer), file=file)
    rows = []
    named = set(found.effects)
    for c in found.candidates:
        if c.name in named and found.verdict != "unknown":
            for name, value in c.params.items():
                rows.append((f"{c.name} {name}", f"{value:.4g}", interval_text(c.ci95.get(name))))
    if rows:
        print("", file=file)
        terminal.print_table(rows, file)
    for note in found.notes:
        print(f"Note: {note}", file=file)
    if answer.get("next_experiment"):
        nxt = answer["next_experiment"]
        print(f"Next experiment: {nxt['kind'].replace('_', ' ')}; {nxt['why']}", file=file)
