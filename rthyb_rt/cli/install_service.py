"""``rthyb install-service``: the service into a system with systemd."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import terminal
from rthyb_rt.cli.inputs import JsonOption
from rthyb_rt.errors import RthybError

if TYPE_CHECKING:
    from rthyb_rt.config import RigFile

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

    The service runs as user rthyb without any capability. Members of group rthyb may look, hold
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
        text, dbc = (None, None) if source is None else _portable(config.load_rig(source))
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
        terminal.tell(f"warning: {root / installing.RIG} was there already, and is left as it was")
    if not uninstall:
        print(
            "\nNext: put users into the groups (usermod -aG rthyb,rthyb-operator NAME), then "
            "systemctl enable --now rthyb-recorder rthyb",
            file=file,
        )
    if as_json:
        terminal.print_json(
            {"schema": SCHEMA, "files": [str(path) for path in files], "problems": problems}
        )


def _portable(rig: RigFile) -> tuple[str, Path | None]:
    """Return the text of a rig file whose DBC file lies beside it, and where that is now.

    The service sees nobody's home.
    """
    from rthyb_rt import config

    if rig.link is None or rig.link.dbc is None:
        return config.dump(rig), None
    dbc = Path(rig.link.dbc)
    link = rig.link.model_copy(update={"dbc": dbc.name})
    return config.dump(rig.model_copy(update={"link": link})), dbc


def _carried(source: Path, target: Path) -> list[Path]:
    """Put what is known of the rig's commissioning beside its new file, for the service to read."""
    from rthyb_rt import config
    from rthyb_rt.rig.commissioning import certificate

    rig = config.load_rig(source)
    certificate.carry(rig, source, target)
    path = certificate.place(target)
    if not path.exists() or certificate.find(rig, target)[0] is None:
        return []
    return [path]
