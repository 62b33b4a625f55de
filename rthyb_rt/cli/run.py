"""``rthyb run``: runs a hybrid test."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rthyb_rt.cli import interrupts, run_axes, terminal
from rthyb_rt.cli.connecting import clock_of, opened_link
from rthyb_rt.cli.folders import publish, refuse_taken, report_beside, staged
from rthyb_rt.cli.inputs import JsonOption, RigOption, SetOption, load_any, note_unused
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt import config
    from rthyb_rt.analysis.summary import Summary
    from rthyb_rt.config import AxesRig, RigFile
    from rthyb_rt.core.loop import Clock, Fault
    from rthyb_rt.lab.experiment import Progress, Setup
    from rthyb_rt.lab.realtime import Session
    from rthyb_rt.record.recording import RecordedTest

SCHEMA = "rthyb-run/1"
LIMIT_TRIP = 6
UNPUNCTUAL = 7


def run(
    test: Annotated[
        Path | None,
        typer.Argument(
            metavar="TEST.toml",
            help="Test file, or name of a shipped test. Default: the built-in test (Section 5, "
            "T = 0.5 s, El Centro).",
            show_default=False,
        ),
    ] = None,
    rig: RigOption = None,
    settings: SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the files of this run, instead of runs/TEST-UTC.",
            show_default=False,
        ),
    ] = None,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime",
            help="Run in real time over the rig file's [link]; if it has none, on a virtual "
            "rig in a separate process.",
        ),
    ] = False,
    clock: Annotated[
        Literal["host", "link", "stepped"] | None,
        typer.Option(
            help="Source of the clock, instead of link.clock: this PC, the drive, or none (one "
            "tick after another).",
            show_default=False,
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND[:KEY=NUMBER,...]",
            help="Fault to simulate on the virtual rig, such as drop:p=0.02,from=5,to=8 (times "
            "in seconds of the test). Can be repeated; for the kinds, of which power-cut needs a "
            "rig of its own, see `rthyb rig --help`.",
            show_default=False,
        ),
    ] = None,
    no_report: Annotated[
        bool, typer.Option("--no-report", help="Do not write the HTML report.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a hybrid test and write its recording and report.

    By default the test runs on the virtual rig that the rig file describes, as fast as the PC
    allows. With --realtime it runs on the equipment at the other end of the rig file's link.
    Recording, report and the complete settings are written to a new folder; the test.toml in it
    can be run again as it is.

    During a real-time test, Ctrl-C brings the specimen to rest and keeps the recording; a second
    Ctrl-C trips.

    \b
    Examples:
      rthyb run
      rthyb run my-test.toml --rig my-rig.toml
      rthyb run my-test.toml --set ground_motion.pga_g=0.1 --set controller.type=robust
      rthyb run my-test.toml --set rig.actuator.delay_samples=12 --json
      rthyb run my-test.toml --fault drop:p=0.02,from=5,to=8 --fault silence:from=12
      rthyb run my-test.toml --rig my-rig.toml --realtime

    The exit code is 6 if a limit or a trip ended the test, and 7 if this PC did not keep time well
    enough. Recording and report are written in both cases.
    """
    from rthyb_rt import config
    from rthyb_rt.analysis import summary
    from rthyb_rt.lab import axes_experiment, experiment, storing, virtual_time
    from rthyb_rt.record import recording

    if clock is not None and not realtime:
        raise typer.BadParameter("needs --realtime", param_hint="--clock")
    if fault and realtime:
        raise typer.BadParameter(
            "applies only to the virtual rig without --realtime; over a link, give it to `rthyb "
            "rig`",
            param_hint="--fault",
        )
    started = datetime.datetime.now(datetime.UTC)
    test_file, rig_file = load_any(test, rig, settings)
    note_unused(test_file, settings)
    axes = rig_file.names if isinstance(rig_file, config.AxesRig) else ()
    mishaps = _mishaps(fault, axes, config.Rate(test_file.test.sample_rate_hz)) if fault else ()
    if isinstance(rig_file, config.AxesRig):
        of_all = axes_experiment.prepare(test_file, rig_file, real_time=realtime or bool(mishaps))
        _tell_notes(of_all, realtime=realtime)
        facts = _commissioned(rig or test_file.rig, rig_file) if realtime else {}

        def conduct(
            setup: Setup, progress: Progress, keep: Callable[[RecordedTest], Path]
        ) -> tuple[RecordedTest, Path]:
            if realtime:
                return _run_live(setup, clock, progress, keep, facts)
            return _run_faulty(setup, mishaps, progress, keep)

        conducted = conduct if realtime or mishaps else None
        run_axes.run(of_all, out, conducted, report=not no_report, as_json=as_json)
        return
    setup = experiment.prepare(test_file, rig_file, real_time=realtime or bool(mishaps))
    _tell_notes(setup, realtime=realtime)
    facts = _commissioned(rig or test_file.rig, rig_file) if realtime else {}
    refuse_taken(out)
    target = out or Path("runs") / f"{test_file.test.name}-{started:%Y%m%dT%H%M%SZ}"
    with staged(target) as stage:

        def keep(rec: RecordedTest) -> Path:
            # A completed test is always saved; and HDF5's callbacks would swallow a Ctrl-C.
            with interrupts.held():
                storing.store(stage, setup, rec)
                return publish(stage, target, numbered=out is None)

        with terminal.progress("Testing", setup.ticks, setup.derived.fs_hz) as progress:
            if realtime:
                rec, folder = _run_live(setup, clock, progress, keep, facts)
            elif mishaps:
                rec, folder = _run_faulty(setup, mishaps, progress, keep)
            else:
                rec = virtual_time.run(setup, progress)
        if not realtime and not mishaps:
            folder = keep(rec)
    result = summary.summarize(rec)
    file = terminal.people(as_json)
    _print_result(setup, result, folder / recording.FILE_NAME, as_json)
    file.flush()
    report = None if no_report else report_beside(rec, folder)
    if report is not None:
        print(f"Report     {report}", file=file)
    if as_json:
        terminal.print_json(_document(result, folder, report))
    status = _status(result)
    if status:
        raise typer.Exit(status)


def _status(result: Summary) -> int:
    """Return the exit status: a stop by the operator is a regular end of a real-time test."""
    from rthyb_rt.lab.realtime import TIMING_CAUSES

    if result.end_reason == "completed":
        return 0
    if result.live is not None:
        if result.live.cause in TIMING_CAUSES:
            return UNPUNCTUAL
        if result.final_state != "TRIPPED" and result.live.cause in ("operator", "none"):
            return 0
    return LIMIT_TRIP


def _tell_notes(setup: Setup, *, realtime: bool) -> None:
    """Print the notes on a test, and what is known of the stability of its loop.

    Raises:
        InputError: in real time, the loop is unstable and the rig is real.
    """
    from rthyb_rt.analysis import loop_stability

    # In virtual time an unstable loop is not refused: seeing it diverge may be the purpose.
    remarks = loop_stability.demand(setup) if realtime else loop_stability.remarks_of(setup)
    for note in (*setup.notes, *remarks):
        terminal.tell(f"note: {note}")


def _commissioned(name: str | None, rig: RigFile | AxesRig) -> dict[str, Any]:
    """Return the commissioning facts for the recording; refuse a rig that lacks them."""
    from rthyb_rt import config
    from rthyb_rt.rig.commissioning import certificate

    return certificate.demand(rig, config.find_rig(name))


# ---- in real time -------------------------------------------------------------------------------


def _run_live(
    setup: Setup,
    clock: Clock | None,
    progress: Progress,
    keep: Callable[[RecordedTest], Path],
    facts: dict[str, Any],
) -> tuple[RecordedTest, Path]:
    """Run the test over the rig's link or on a separate virtual rig; return where it is saved."""
    from rthyb_rt.lab import realtime

    link = setup.rig.link
    clock = clock or clock_of(setup.rig_file)
    operator = realtime.Operator()
    kept: list[Path] = []
    opening = opened_link(setup.rig_file, clock, setup.rate)
    with opening as (opened, before_tick), interrupts.on_interrupt(operator.stop):
        rec = realtime.run(
            setup,
            opened,
            clock=clock,
            before_tick=before_tick,
            progress=progress,
            operator=operator,
            require_realtime=link is not None and link.require_realtime,
            warn=lambda text: terminal.tell(f"warning: {text}"),
            save=lambda rec: kept.append(keep(rec)),
            facts=facts,
            # No other operator could be in charge of a separate virtual rig.
            resets=link is None,
            answered=_print_ring,
            zeroed=_print_tare,
        )
    return rec, kept[0]


def _mishaps(texts: list[str], axes: Sequence[str], rate: config.Rate) -> tuple[Fault, ...]:
    from rthyb_rt.rig import virtual_rig

    try:
        return virtual_rig.parse_mishaps(texts, axes, rate)
    except InputError as error:
        raise typer.BadParameter(str(error), param_hint="--fault") from error


def _run_faulty(
    setup: Setup,
    mishaps: tuple[Fault, ...],
    progress: Progress,
    keep: Callable[[RecordedTest], Path],
) -> tuple[RecordedTest, Path]:
    """Run the test on a virtual rig with the given faults; return where it is saved."""
    from rthyb_rt.lab import realtime
    from rthyb_rt.rig import virtual_rig

    operator = realtime.Operator()
    kept: list[Path] = []
    with interrupts.on_interrupt(operator.stop):
        rec = virtual_rig.run_faulty(
            setup,
            mishaps,
            progress=progress,
            operator=operator,
            warn=lambda text: terminal.tell(f"warning: {text}"),
            save=lambda rec: kept.append(keep(rec)),
        )
    return rec, kept[0]


def _print_ring(session: Session) -> None:
    path = session.run.ring.path
    terminal.tell(f"telemetry ring {path}; if this process dies: rthyb recover {path}")


def _print_tare(session: Session) -> None:
    terminal.tell(f"zeroed: {session.tare_in_words()}")


# ---- the result ---------------------------------------------------------------------------------


def _print_result(setup: Setup, result: Summary, recording: Path, as_json: bool) -> None:
    from rthyb_rt.analysis import summary
    from rthyb_rt.analysis.notices import omission_notices

    file = terminal.people(as_json)
    print(f"{setup.test.test.name} on {setup.rig.rig.name}: {_motion(setup)}\n", file=file)
    # What the rig file omits was told before the test.
    told = omission_notices(result.setup.omitted)
    notices = [notice for notice in summary.notices(result) if notice not in told]
    table = summary.table(result)
    terminal.print_result(notices, table, summary.verdict(result), file)
    print(f"\nRecording  {recording}", file=file)


def _motion(setup: Setup) -> str:
    if setup.plan is not None:
        return setup.motion.name
    return f"{setup.motion.name}, PGA {setup.motion.pga_g:.3g} g"


def _document(result: Summary, folder: Path, report: Path | None) -> dict[str, Any]:
    from rthyb_rt.analysis import summary

    measures = result.as_json()
    identity = {
        key: measures.pop(key)
        for key in ("test_name", "end_reason", "ended_by", "attention", "setup")
    }
    return {
        "schema": SCHEMA,
        **identity,
        "ending": result.ending,
        "notices": [notice._asdict() for notice in summary.notices(result)],
        "measures": measures,
        "paths": {
            "folder": str(folder),
            "recording": str(folder / "recording.h5"),
            "report": str(report) if report else None,
            "test": str(folder / "test.toml"),
            "rig": str(folder / "rig.toml"),
        },
    }
