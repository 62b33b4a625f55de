"""``rthyb diagnose``: what physics does the model leave out?"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.inputs import AxisOption, JsonOption
from rthyb_rt.errors import InputError, RthybError

if TYPE_CHECKING:
    from rthyb_rt.diagnose.axes import OfAxis
    from rthyb_rt.diagnose.case import Case
    from rthyb_rt.diagnose.mapping import Wish
    from rthyb_rt.diagnose.outcome import Outcome
    from rthyb_rt.diagnose.result import DiagnosisResult

MISMATCH = 8

RecordingArgument = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        help="CSV file, folder of a run, or its recording.h5 file.",
        show_default=False,
    ),
]
ModelOption = Annotated[
    str,
    typer.Option(
        "--model",
        metavar="MODEL.toml",
        show_default=False,
        help="Model to compare with: a baseline file (rthyb-baseline/1), a rig or test file, "
        "or the name of a shipped rig or test.",
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        metavar='CHANNEL="COLUMN [UNIT]"',
        show_default=False,
        help="Column of the CSV file that holds a channel, and its unit; a minus sign before "
        "the column inverts it. Or a mapping file. Can be repeated.",
    ),
]
HeldoutOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        show_default=False,
        help="Second recording on which the answer is validated.",
    ),
]
PredictOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        show_default=False,
        help="Inputs of a second recording; the predicted force and displacement are written "
        "to --out.",
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option(metavar="PRED.csv", help="File for the prediction.", show_default=False),
]
ReportOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        show_default=False,
        help="Folder for report.html, diagnosis.json and augmented.toml.",
    ),
]
SelfCheckOption = Annotated[
    bool,
    typer.Option(
        "--self-check",
        help="Add a known effect to this recording and see whether it is found.",
    ),
]
EffectOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--effect",
        metavar="FILE.py",
        show_default=False,
        help="Python file that registers an effect of your own. Can be repeated.",
    ),
]
WhyOption = Annotated[
    bool,
    typer.Option(
        "--why",
        help="Show how well every set of effects fits and why it was rejected, and what the "
        "answer is based on.",
    ),
]


@dataclass(frozen=True)
class _Asked:
    """Input and options of a diagnosis.

    Attributes:
        second: a recording for validating the answer, or None.
        wanted: inputs for a prediction, or None.
        report: whether a page with the ledger is written.
    """

    case: Case
    second: Case | None
    wanted: Case | None
    self_check: bool = False
    why: bool = False
    report: bool = False


@dataclass(frozen=True)
class _Answered:
    """Results: the diagnosis, the conclusions from it, the self-check, the ledger."""

    found: DiagnosisResult
    outcome: Outcome
    checks: list[dict[str, Any]] | None
    reasons: dict[str, Any]


def diagnose(
    recording: RecordingArgument,
    model: ModelOption,
    columns: MapOption = None,
    heldout: HeldoutOption = None,
    predict: PredictOption = None,
    out: OutOption = None,
    report: ReportOption = None,
    self_check: SelfCheckOption = False,
    effect: EffectOption = None,
    why: WhyOption = False,
    axis: AxisOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find out what physics a model leaves out, and where.

    The recording is split at the recorded signals: command against measured displacement shows
    what the actuator does differently from the model, displacement against force what the specimen
    does. A recording of this program is also simulated again in closed loop, once with the given
    model and once with the effects found. In a recording of several axes, each axis is diagnosed
    separately, given the measured motion of the others; --axis selects one. The exit code is 0 if
    nothing is missing, 3 if the data do not allow an answer, and 8 otherwise.

    \b
    Examples:
      rthyb diagnose recording.csv --model baseline.toml --report runs/diagnosis
      rthyb diagnose runs/my-test-20260301T101500Z --model rig.toml
      rthyb diagnose recording.csv --model baseline.toml --effect magnet.py
      rthyb diagnose lab.txt --model baseline.toml --map x_meas="LVDT 1 [mm]"
      rthyb diagnose runs/two-actuator-frame-20260301T101500Z --model two-axis-frame --axis upper
    """
    # Its matrix products are long and narrow: on several cores they take four times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from rthyb_rt import config
    from rthyb_rt.diagnose import effects, mapping, reading
    from rthyb_rt.diagnose.axes import chosen

    if (predict is None) != (out is None):
        raise typer.BadParameter(
            "--predict and --out must be given together", param_hint="--predict"
        )
    if report is not None:
        _writable(report)
    for path in effect or ():
        effects.load(path)
    wishes = mapping.read_wishes(columns or ())
    model_path = reading.find_model(config.test_as_model(model))
    axes = chosen(recording, reading.axes_of(recording), model_path, axis, "--axis")
    if len(axes) > 1 and predict is not None:
        raise typer.BadParameter(
            f"a prediction covers one axis; choose it with --axis {axes[0].name}",
            param_hint="--predict",
        )
    done = []
    for of in axes or (None,):
        asked = _asked(recording, model_path, of, wishes, heldout, predict)
        parts = _answered(replace(asked, self_check=self_check, why=why, report=report is not None))
        done.append(parts)
    prediction = done[0].outcome.prediction
    if out is not None and prediction is not None:
        _write_prediction(out, prediction)
        interrupts.wrote(out)
    if report is not None:
        _write_report(report, done, model_path)
    _print_all(done, why=why, as_json=as_json)
    if any(one.found.verdict != "none" for one in done):
        raise typer.Exit(MISMATCH)


def _asked(
    recording: Path,
    model: Path,
    of: OfAxis | None,
    wishes: list[Wish],
    heldout: Path | None,
    predict: Path | None,
) -> _Asked:
    """Read the input of a diagnosis, and print the assumptions about it."""
    from rthyb_rt.diagnose import reading

    own = reading.read_model(model) if of is None else of.model
    case = reading.read_case(recording, own, wishes=wishes, of=of)
    _print_assumptions(case.notes)
    second = _judge(heldout, case, wishes, of) if heldout else None
    wanted = _second(predict, case, wishes, of) if predict else None
    return _Asked(case, second, wanted)


def _print_all(done: list[_Answered], *, why: bool, as_json: bool) -> None:
    """Print every answer; as JSON, a single answer, or those of all axes by name."""
    from rthyb_rt.diagnose.page import AXES_SCHEMA

    file, answers = terminal.people(as_json), {}
    for number, one in enumerate(done):
        answer = one.outcome.answer
        answer = answer | ({"self_check": one.checks} if one.checks is not None else {})
        if why:
            answer["why"] = one.reasons
        axis = one.found.case.axis
        if len(done) > 1:
            print(("\n" if number else "") + f"Axis {axis}", file=file)
        _print_answer(one.found, answer, file, one.outcome)
        answers[axis] = answer
    if as_json:
        whole = {"schema": AXES_SCHEMA, "axes": answers}
        terminal.print_json(whole if len(done) > 1 else answers.popitem()[1])


def _answered(asked: _Asked) -> _Answered:
    """Diagnose, and carry out whatever else was requested, with a progress bar."""
    from rthyb_rt.diagnose import engine
    from rthyb_rt.diagnose.outcome import finish

    with terminal.sections("Diagnosing") as bar:
        done = [0]

        def step(part: str) -> None:
            done[0] += 1
            bar(min(done[0], 39), 40, part)

        found = engine.diagnose(asked.case, step)
        step("held out")
        outcome = finish(found, asked.second, asked.wanted)
        checks = None
        if asked.self_check:
            from rthyb_rt.diagnose.power import self_check

            checks = self_check(found, step)
        reasons = _reasons(found, step) if asked.why or asked.report else {}
    return _Answered(found, outcome, checks, reasons)


def _judge(path: Path, case: Case, wishes: list[Wish], of: OfAxis | None) -> Case:
    """Return a second recording for validating the answer."""
    second = _second(path, case, wishes, of)
    if not second.channels.keys() & {"x_meas", "f_meas"}:
        raise InputError(
            f"{path}: has no x_meas, fx_meas or fy_meas to compare with the model; for a "
            "recording of the commands alone use --predict"
        )
    return second


def _second(path: Path, case: Case, wishes: list[Wish], of: OfAxis | None) -> Case:
    """Return a second recording; assumptions about its columns are printed on stderr."""
    from rthyb_rt.diagnose.reading import read_case

    second = read_case(path, case.model, judged=False, wishes=wishes, beside=case, of=of)
    _print_assumptions([f"{path}: {note}" for note in second.notes])
    return second


def _print_assumptions(notes: list[str]) -> None:
    """Report on stderr, before the work, what the file does not state and is assumed."""
    for note in notes:
        if "read as" in note or "assumed to be" in note:
            print(f"rthyb: {note}", file=sys.stderr)


def _writable(folder: Path) -> None:
    """Refuse a folder that cannot be written, before a minute of work is lost."""
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        why = "is not writable" if there.is_dir() else "is a file, not a folder"
        raise RthybError(f"{why}; choose another folder with --report", where=str(there))


def _write_report(folder: Path, done: list[_Answered], model: Path) -> None:
    from rthyb_rt.diagnose import page

    parts = [page.PagePart(one.found, one.outcome, one.checks, one.reasons) for one in done]
    if len(parts) > 1:
        paths = page.write_axes_report(folder, parts, model)
    else:
        (one,) = parts
        paths = page.write_report(folder, one.d, one.outcome, one.checks, model, one.reasons)
    for path in paths:
        interrupts.wrote(path)


def _write_prediction(path: Path, prediction: Any) -> None:
    import numpy as np

    from rthyb_rt.record.recording import replacing

    table = np.column_stack([prediction.t, prediction.f, prediction.x])
    with replacing(path) as temporary:
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header="t,f,x", comments="")


def _reasons(found: DiagnosisResult, step: Any) -> dict[str, Any]:
    from rthyb_rt.diagnose import why

    step("reasons")
    return why.to_json(found)


def _print_answer(
    found: DiagnosisResult, answer: dict[str, Any], file: Any, outcome: Outcome
) -> None:
    from rthyb_rt.diagnose import words
    from rthyb_rt.diagnose.why import lines

    print(words.sentence(found, answer), file=file)
    rows: list[tuple[str, str, str]] = []
    laws: list[tuple[str, str, str]] = []
    named = {n for group in (found.effects, *found.ambiguous_with) for n in group}
    for c in found.candidates:
        if c.name in named and found.verdict != "unknown":
            for name, value in c.params.items():
                interval = words.interval_text(name, c.ci95.get(name))
                text = words.value_text(name, value).replace(" = ", "\0", 1).split("\0")
                rows.append(
                    (f"{c.name} {text[0]}", text[1], f"95 %: {interval}" if interval else "")
                )
            if words.law_text(c):
                laws.append((f"{c.name} law", words.law_text(c), ""))
    rows += words.loop_rows(answer)
    if rows:
        print("", file=file)
        terminal.print_table(rows, file)
    if laws:
        print("", file=file)
        terminal.print_table(laws, file)
    checks = words.check_rows(answer.get("self_check"))
    if checks:
        print("\nHidden in this recording:", file=file)
        terminal.print_table([(name, text, "") for name, text in checks], file)
    elif "self_check" in answer:
        print("Nothing can be hidden in a recording without a measured force.", file=file)
    limits = words.unheld(found, outcome) + words.driving_notes(found)
    limits += words.loop_notes(found, answer)
    closing = words.heldout_lines(found) + [f"Note: {note}" for note in (*found.notes, *limits)]
    following = words.next_text(found)
    if following:
        closing.append(f"Next experiment: {following}")
    for line in ([""] if closing and (rows or checks) else []) + closing:
        print(line, file=file)
    if "why" in answer:
        print("", file=file)
        for line in lines(answer["why"], min(terminal.width(file), 120)):
            print(line, file=file)
