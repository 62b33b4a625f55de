"""``rthyb live``: a running or recorded test in the browser."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.ctl import place
from rthyb_rt.cli.inputs import JsonOption
from rthyb_rt.errors import RthybError

if TYPE_CHECKING:
    from rthyb_rt.live.server import LiveServer

SCHEMA = "rthyb-live/1"
PORT = 8717


def live(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="SOURCE",
            help="Recording, folder of a run, ring of a real-time test, or folder of rings. "
            "Default: the service, else the newest ring.",
            show_default=False,
        ),
    ] = None,
    port: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, max=65535, help="Port on 127.0.0.1; 0 chooses a free one."
        ),
    ] = PORT,
    operator: Annotated[
        bool,
        typer.Option(
            "--operator",
            help="Add a second address whose page can also zero, arm, start, resume and reset.",
        ),
    ] = False,
    url_file: Annotated[
        Path | None,
        typer.Option(
            "--url-file",
            metavar="FILE",
            help="Write the addresses to FILE, readable by owner and group, instead of "
            "printing them.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show a test in the browser, running or recorded.

    The page is available on this PC only, at an address with a random token; to view it from
    elsewhere use ssh -L. It reads the telemetry ring, loads nothing from the internet, and has
    buttons to hold and stop the test, with the permissions that you have at the service. It is not
    an emergency stop.

    \b
    Examples:
      rthyb live
      rthyb live runs/section5-t0.5-20261121T111534Z
      ssh -L 8717:127.0.0.1:8717 lab-pc rthyb live
    """
    missing = [name for name in ("starlette", "uvicorn", "websockets") if not _there(name)]
    if missing:
        raise RthybError(
            f"the live view needs {' and '.join(missing)}: pip install 'rthyb-rt[live]'"
        )
    import secrets

    from rthyb_rt.live.guard import Tokens
    from rthyb_rt.live.server import LiveServer
    from rthyb_rt.live.sources import open_source
    from rthyb_rt.service import systemd

    found = open_source(source, place(None))
    tokens = Tokens(operate=secrets.token_urlsafe(24) if operator else None)

    def ready() -> None:
        _print_address(server, url_file, as_json)
        systemd.notify("READY=1")

    try:
        server = LiveServer(found, tokens, port, ready)
        with systemd.logging_to_stderr(), interrupts.on_interrupt(server.stop):
            server.run()
    finally:
        found.close()


def _there(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def _print_address(server: LiveServer, url_file: Path | None, as_json: bool) -> None:
    """Print the address of the page, or write it to a file that not everyone can read."""
    from rthyb_rt.record.recording import replacing

    addresses = {"look": server.url, "operator": server.operator_url}
    if url_file is not None:
        with replacing(url_file) as temporary:
            temporary.touch(0o600)
            lines = [address for address in addresses.values() if address is not None]
            temporary.write_text("\n".join(lines) + "\n", encoding="ascii")
            temporary.chmod(0o640)
    elif as_json:
        document = {"schema": SCHEMA, "port": server.port, "url": server.url}
        terminal.print_json(document | {"operator_url": server.operator_url})
    else:
        print(f"Live view  {server.url}")
        if server.operator_url is not None:
            print(f"Operator   {server.operator_url}")
        print("Ctrl-C ends the view; the test continues.", flush=True)
    if as_json:
        import sys

        sys.stdout.flush()
