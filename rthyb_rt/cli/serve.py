"""``rthyb serve``: the daemon of a rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rthyb_rt.cli.connecting import clock_of, load_axes_rig, load_rig, opened_link

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig, RigFile


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
            help="Control socket, instead of control.sock beside the rings.",
            show_default=False,
        ),
    ] = None,
    rings: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the rings, in memory, instead of /run/rthyb or the user's own.",
            show_default=False,
        ),
    ] = None,
    runs: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the recordings.")] = Path(
        "runs"
    ),
    recorder: Annotated[
        Literal["own", "service", "none"],
        typer.Option(
            help="Which process records: one started by this service, the recorder service, or "
            "none."
        ),
    ] = "own",
    metrics: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File to write in Prometheus text format every 5 s.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Run the service of a rig, for many tests.

    Opens the rig's link and holds the drive at its position, in state IDLE; on a rig of several
    axes, all links and drives. Tests are sent to the control socket by `rthyb ctl`, one after
    another; between tests the drive stays under control.
    Ctrl-C or SIGTERM brings everything to rest and ends the service; a second signal trips. SIGHUP
    reloads the limits of the rig file.

    Permissions depend on groups: members of rthyb may watch, hold and stop; members of
    rthyb-operator, root and the user who started the service may do everything.

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

    def read_rig() -> RigFile | AxesRig:
        found = load_axes_rig(rig, None)
        return load_rig(rig, None)[0] if found is None else found[0]

    def demand(found: RigFile | AxesRig) -> dict[str, Any]:
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


def _requires_realtime(rig: RigFile | AxesRig) -> bool:
    """Return whether real-time privileges are required: for a real rig they are by default.

    For several axes, whether any of them requires them.
    """
    from rthyb_rt.config import AxesRig

    links = [axis.link for axis in rig.axis] if isinstance(rig, AxesRig) else [rig.link]
    return any(
        link.require_realtime if "require_realtime" in link.model_fields_set else not link.virtual
        for link in links
        if link is not None
    )
