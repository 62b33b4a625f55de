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
            help="Rig file, or the name of a shipped rig, that becomes /etc/rthyb/rig.toml, unless "
            "there is one.",
            show_default=False,
        ),
    ] = None,
    root: Annotated[
        Path, typer.Option(metavar="DIR", help="Write below that folder, and start nothing.")
    ] = Path("/"),
    uninstall: Annotated[
        bool, typer.Option("--uninstall", help="Take the files away; rig and recordings stay.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Install units, groups and rules of the service.

    The service runs as user rthyb, without any capability. Who is in group rthyb may look, hold
    and stop, who is in rthyb-operator may do everything. It is neither enabled nor started here.

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
