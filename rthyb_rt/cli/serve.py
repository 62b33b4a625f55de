"""``rthyb serve``: the daemon of a rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rthyb_rt.cli.connecting import clock_of, load_rig, opened_link

if TYPE_CHECKING:
    from rthyb_rt.config import RigFile


def serve(
    rig: Annotated[
        str,
        typer.Argument(
            metavar="RIG", help="Rig file, or the name of a shipped rig.", show_default=False
        ),
    ],
    socket: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="The control socket, instead of control.sock beside the rings.",
            show_default=False,
        ),
    ] = None,
    rings: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the rings, in memory, instead of /run/rthyb or the user's own.",
            show_default=False,
        ),
    ] = None,
    runs: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder that the recordings go to.")
    ] = Path("runs"),
    recorder: Annotated[
        Literal["own", "service", "none"],
        typer.Option(help="Who records: a process of its own, another service, or nobody."),
    ] = "own",
    metrics: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write Prometheus' text format there, every 5 s.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Run many tests on one rig, driven by `rthyb ctl`.

    It opens the rig's link and keeps the drive where it stands, in state IDLE. Tests come through
    the control socket, one after another, and the drive is never let go in between. Ctrl-C or
    SIGTERM brings what moves to rest and ends it; a second one trips. SIGHUP reads the limits of
    the rig file again.

    Who may do what is decided by groups: rthyb may look, hold and stop, rthyb-operator may do
    everything, and so may root and who has started it.

    \b
    Examples:
      rthyb serve my-rig.toml --runs runs
      rthyb ctl load my-test.toml
    """
    from rthyb_rt import config
    from rthyb_rt.record import ring
    from rthyb_rt.rig.commissioning import certificate
    from rthyb_rt.service import systemd
    from rthyb_rt.service.daemon import Daemon, Options

    path = config.find_rig(rig)

    def read_rig() -> RigFile:
        return load_rig(rig, None)[0]

    def demand(found: RigFile) -> dict[str, Any]:
        return certificate.demand(found, path)

    rig_file = read_rig()
    demand(rig_file)
    folder = ring.claim(rings or ring.default_folder())
    options = Options(
        socket=socket or folder / "control.sock",
        rings=folder,
        runs=runs,
        recorder=recorder,
        require_realtime=_requires_realtime(rig_file),
        metrics=metrics,
    )
    clock = clock_of(rig_file)
    with (
        systemd.logging_to_stderr(),
        opened_link(rig_file, clock) as (opened, before_tick),
    ):
        daemon = Daemon(
            rig_file,
            opened,
            clock,
            options,
            demand=demand,
            read_rig=read_rig,
            before_tick=before_tick,
        )
        status = daemon.run()
    if status:
        raise typer.Exit(status)


def _requires_realtime(rig: RigFile) -> bool:
    """Return what the rig file says; a service for a rig that is real asks for it unasked."""
    link = rig.link
    if link is None:
        return False
    if "require_realtime" in link.model_fields_set:
        return link.require_realtime
    return not link.virtual
