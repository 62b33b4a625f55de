"""``rthyb install-service``: installation of the service in a system with systemd."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption
from rthyb_rt.errors import RthybError

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig, RigFile
    from rthyb_rt.config.rigfile import LinkTable

SCHEMA = "rthyb-install/1"


def install_service(
    rig: Annotated[
        str | None,
        typer.Option(
            "--rig",
            metavar="RIG",
            help="Rig file or name of a shipped rig to copy to /etc/rthyb/rig.toml, unless "
            "that file exists.",
            show_default=False,
        ),
    ] = None,
    root: Annotated[
        Path, typer.Option(metavar="DIR", help="Install below DIR and run no system command.")
    ] = Path("/"),
    uninstall: Annotated[
        bool,
        typer.Option("--uninstall", help="Remove the files; the rig file and the recordings stay."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Install the service: systemd units, groups and rules.

    The service runs as user rthyb without any capability. Members of group rthyb may watch, hold
    and stop; members of rthyb-operator may do everything. This command neither enables nor starts
    the service.

    \b
    Examples:
      sudo rthyb install-service --rig my-rig.toml
      sudo systemctl enable --now rthyb-recorder rthyb
      sudo systemctl enable --now rthyb-live
    """
    from rthyb_rt import config
    from rthyb_rt.service import installing

    if installing.needs_root(root):
        raise RthybError("the files belong to root: sudo rthyb install-service")
    here = root == Path("/")
    if uninstall:
        there = any((root / place).exists() for place in installing.PLACES.values())
        problems = installing.carry_out(installing.REMOVING) if here and there else []
        files = installing.remove(root)
        problems += installing.carry_out(installing.REMOVED) if here and there else []
    else:
        source = None if rig is None else config.find_rig(rig)
        text, dbc = (None, []) if source is None else _portable(config.load_any_rig(source))
        files = installing.install(root, installing.program(), text, dbc)
        if source is not None and root / installing.RIG in files:
            files += _carried(source, root / installing.RIG)
        problems = installing.carry_out(installing.INSTALLED) if here else []
    file = terminal.people(as_json)
    for path in files:
        print(f"{'Removed' if uninstall else 'Wrote'} {path}", file=file)
    for problem in problems:
        terminal.tell(f"warning: {problem}")
    if not uninstall and rig is not None and root / installing.RIG not in files:
        terminal.tell(f"warning: {root / installing.RIG} already exists and was left unchanged")
    if not uninstall:
        print(
            "\nNext: add users to the groups (usermod -aG rthyb,rthyb-operator NAME), then "
            "systemctl enable --now rthyb-recorder rthyb",
            file=file,
        )
    if as_json:
        terminal.print_json(
            {"schema": SCHEMA, "files": [str(path) for path in files], "problems": problems}
        )


def _portable(rig: RigFile | AxesRig) -> tuple[str, list[Path]]:
    """Return the text of a rig file that refers to its DBC files by name, and their present paths.

    The service has no access to home folders.
    """
    from rthyb_rt import config

    dbc: dict[Path, None] = {}

    def beside(link: LinkTable | None) -> LinkTable | None:
        if link is None or link.dbc is None:
            return link
        path = Path(link.dbc)
        dbc[path] = None
        return link.model_copy(update={"dbc": path.name})

    if isinstance(rig, config.AxesRig):
        axes = [own.model_copy(update={"link": beside(own.link)}) for own in rig.axis]
        moved: RigFile | AxesRig = rig.model_copy(update={"axis": axes})
    else:
        moved = rig.model_copy(update={"link": beside(rig.link)})
    return config.dump(moved), list(dbc)


def _carried(source: Path, target: Path) -> list[Path]:
    """Copy the certificates of the rig beside its new file, where the service can read them."""
    from rthyb_rt import config
    from rthyb_rt.rig.commissioning import certificate

    rig = config.load_any_rig(source)
    certificate.carry(rig, source, target)
    places = [(own, axis, certificate.place(target, axis)) for own, axis in certificate.each(rig)]
    return [
        path
        for own, axis, path in places
        if path.exists() and certificate.find(own, target, axis)[0] is not None
    ]
