"""The program ``rthyb`` and its commands, one module each, registered here."""

from __future__ import annotations

import os
from typing import Annotated

import typer
import typer.completion

from rthyb_rt.cli import (
    benchmark,
    campaign,
    check,
    commission,
    compare,
    compare_laws,
    ctl,
    diagnose,
    effects,
    export,
    identify,
    import_opensees,
    install_service,
    jitter,
    jog,
    live,
    recorder,
    recover,
    replay,
    report,
    reproduce,
    reset,
    rig,
    run,
    schema,
    serve,
    sweep,
)

app = typer.Typer(
    name="rthyb",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    # Plain help: it takes a third of the time of rich's, and keeps the layout written here.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
if "_RTHYB_COMPLETE" in os.environ:
    # Loaded only when a shell requests completions, so that other calls do not pay for it.
    typer.completion.completion_init()  # type: ignore[attr-defined]
app.command()(run.run)
app.command()(sweep.sweep)
app.command()(campaign.campaign)
app.command()(check.check)
app.command()(identify.identify)
app.command(context_settings=jog.CONTEXT)(jog.jog)
app.command()(commission.commission)
app.command()(reset.reset)
app.command()(reproduce.reproduce)
app.add_typer(benchmark.benchmark)
app.command()(compare.compare)
app.command("compare-laws")(compare_laws.compare_laws)
app.command("import-opensees")(import_opensees.import_opensees)
app.command()(diagnose.diagnose)
app.command()(effects.effects)
app.command()(replay.replay)
app.command()(recover.recover)
app.command()(rig.rig)
app.command()(serve.serve)
app.add_typer(ctl.ctl)
app.command()(recorder.recorder)
app.command()(live.live)
app.command()(install_service.install_service)
app.command()(export.export)
app.command()(report.report)
app.command()(jitter.jitter)
app.command()(schema.schema)


def _version(wanted: bool) -> None:
    if wanted:
        from rthyb_rt import __version__, core

        facts = core.build_facts()
        print(
            f"rthyb {__version__} (core {facts['core_version']}, compiler {facts['compiler']}, "
            f"{facts['architecture']})"
        )
        raise typer.Exit


@app.callback()
def _rthyb(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            help="Show the versions of the program, its core and the compiler.",
            callback=_version,
            is_eager=True,
        ),
    ] = False,
) -> None:
    """Real-time hybrid testing: part of the structure is real, the rest is computed.

    A test file describes the test, a rig file the equipment. Without real equipment, `rthyb run`
    uses a virtual rig.

    \b
    Getting started:
      rthyb run                          run the built-in test on a virtual shaking table
      rthyb check my-test.toml           check a test and show its stability margins
      rthyb run my-test.toml             run it; recording and report go to runs/
      rthyb run my-test.toml --realtime  run it in real time, 1024 samples per second

    \b
    Exit codes:
      0  success                         6  a limit or a fault ended the test
      2  invalid command line            7  this PC does not keep time well enough
      3  error in a file or on a link    8  a difference was found
      4  no service is running         130  interrupted (128 + n: by signal n)
      5  refused in this state           1  any other error
    """
